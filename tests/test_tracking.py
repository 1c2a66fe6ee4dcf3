"""Tracking of people: assignment, ids, predicted positions, and states."""

import json

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from lidarpose import Box, InputError
from lidarpose.tracking.assignment import assign
from lidarpose.tracking.tracker import POSITION_SD, SPEED_CHANGE, SPEED_SD, Tracker

SEEDS = st.integers(0, 2**32 - 1)


def person(x, y=0.0, yaw=0.0, score=None):
    return Box(center=(x, y, 0.9), size=(0.6, 0.6, 1.75), yaw=yaw, score=score)


def crowd(rng, people, frames, drop=0.3):
    """Yields (time, boxes) at 10 Hz of people who walk and are often not detected."""
    start, velocity = rng.uniform(-8, 8, (people, 2)), rng.normal(0, 1, (people, 2))
    for frame in range(frames):
        places = start + velocity * frame / 10 + rng.normal(0, 0.05, (people, 2))
        yield frame / 10, [person(*place, yaw=rng.uniform(-3, 3)) for place in places if rng.random() > drop]


# ---- assignment


def test_assign_makes_only_pairs_of_negative_cost():
    costs = np.array([[-1.0, -3.0, np.inf], [np.inf, -2.5, np.inf], [2.0, np.inf, 5.0]])
    rows, columns = assign(costs)
    assert list(zip(rows, columns, strict=True)) == [(0, 0), (1, 1)]


# ---- ids


@given(seed=SEEDS)
@settings(max_examples=20, deadline=None)
def test_track_ids_start_at_0_and_are_never_reused(seed):
    tracker, known = Tracker(max_gap=0.3), set()
    for time, boxes in crowd(np.random.default_rng(seed), 6, 30, drop=0.6):
        ids = tracker.update(time, boxes)
        assert len(set(ids)) == len(ids) == len(boxes)
        new = sorted(set(ids) - known)
        assert new == list(range(len(known), len(known) + len(new)))
        known |= set(new)


@given(seed=SEEDS)
@settings(max_examples=20, deadline=None)
def test_tracker_ignores_order_of_boxes(seed):
    rng = np.random.default_rng(seed)
    tracker, other, names = Tracker(), Tracker(), {}
    for time, boxes in crowd(rng, 6, 20):
        order = rng.permutation(len(boxes))
        ids, theirs = tracker.update(time, boxes), other.update(time, [boxes[i] for i in order])
        # new people get ids in the order of their boxes
        for k, i in enumerate(order):
            assert names.setdefault(ids[i], theirs[k]) == theirs[k]
    assert len(set(names.values())) == len(names)


@pytest.mark.parametrize("hz", [2, 10, 30])
def test_crossing_people_keep_their_ids(hz):
    rng, tracker = np.random.default_rng(0), Tracker()
    for time in np.arange(0, 6, 1 / hz):
        places = np.array([[1.3 * (time - 3), 0.25], [-1.3 * (time - 3), -0.25], [0.5, 1.4 * (time - 3)]])
        places[2, 0] += 2  # crosses both paths
        assert tracker.update(time, [person(*place) for place in places + rng.normal(0, 0.04, (3, 2))]) == [0, 1, 2]


@pytest.mark.parametrize("gap, known", [(1.9, True), (2.5, False)])
def test_person_unseen_for_two_seconds_keeps_id(gap, known):
    tracker, speed = Tracker(), 1.2
    for time in np.arange(0, 2, 0.1):
        assert tracker.update(time, [person(speed * time), person(speed * time, 6)]) == [0, 1]
    for time in np.arange(2, 1.9 + gap - 0.05, 0.1):
        assert tracker.update(time, [person(speed * time, 6)]) == [1]
    assert {state.id for state in tracker.predicted(1.9 + gap)} == ({0, 1} if known else {1})
    ids = tracker.update(1.9 + gap, [person(speed * (1.9 + gap)), person(speed * (1.9 + gap), 6)])
    assert ids == ([0, 1] if known else [2, 1])


def test_distant_box_starts_new_track():
    tracker = Tracker()
    for time in np.arange(0, 1, 0.1):
        tracker.update(time, [person(1.2 * time)])
    # after a second unseen, too far for a running person
    assert tracker.update(2.0, [person(2.4 - 6.0)]) == [1]


# ---- predicted positions


def test_predicted_extrapolates_walking_people():
    rng, tracker = np.random.default_rng(1), Tracker()
    assert tracker.predicted(0.0) == []
    for time in np.arange(0, 3, 0.1):
        yaw = np.pi - 0.1 + rng.normal(0, 0.2)  # wraps
        tracker.update(time, [person(1.4 * time + rng.normal(0, 0.05), yaw=np.angle(np.exp(1j * yaw)))])
    soon, later = tracker.predicted(3.0)[0], tracker.predicted(4.0)[0]
    assert (soon.id, later.id) == (0, 0) and soon.age == pytest.approx(0.1) and later.age == pytest.approx(1.1)
    np.testing.assert_allclose(soon.center, [4.2, 0, 0.9], atol=0.1)
    np.testing.assert_allclose(later.center, [5.6, 0, 0.9], atol=0.4)
    np.testing.assert_allclose(soon.size, [0.6, 0.6, 1.75])
    assert abs(np.angle(np.exp(1j * (soon.yaw - np.pi + 0.1)))) < 0.15
    assert 0 < soon.position_sd < 0.15 < later.position_sd
    np.testing.assert_allclose(soon.velocity, [1.4, 0, 0], atol=0.2)
    assert tracker.predicted(10.0) == []


def test_low_score_box_is_predicted_after_second_detection():
    tracker = Tracker()
    assert tracker.update(0.0, [person(0, score=0.3), person(5, score=0.95), person(9)]) == [0, 1, 2]
    assert [(state.id, state.velocity) for state in tracker.predicted(0.1)] == [(1, None), (2, None)]
    assert tracker.update(0.1, [person(0, score=0.3)]) == [0]
    assert [state.id for state in tracker.predicted(0.2)] == [0, 1, 2]
    # seen again after a second, without frames in between or with one
    assert tracker.update(1.1, [person(-6, score=0.3)]) == [3]
    assert tracker.update(2.1, [person(-6, score=0.3), person(-12, score=0.3)]) == [3, 4]
    assert tracker.update(2.6, []) == [] and tracker.update(3.1, [person(-12, score=0.3)]) == [5]


# ---- times and states


def test_tracker_counts_times_that_jump_back():
    tracker = Tracker()
    for time in (0.0, 0.1, 0.2, 0.15, 0.3):
        assert tracker.update(time, [person(time)]) == [0]
    assert tracker.jumps_back == 1
    # late frames do not slow tracks down: of every pair of frames, the second comes first
    swapped = Tracker()
    for time in (k ^ 1 for k in range(40)):
        assert swapped.update(time / 10, [person(0.14 * time)]) == [0]
    (state,) = swapped.predicted(3.95)
    assert state.center[0] == pytest.approx(5.53, abs=0.15) and state.velocity[0] == pytest.approx(1.4, abs=0.1)
    # a second recording starts
    assert tracker.update(-60.0, [person(0.3)]) == [1] and tracker.jumps_back == 2
    assert tracker.update(-59.9, [person(0.3)]) == [1]
    # extreme times
    assert tracker.update(1e308, [person(0.3)]) == [2] and tracker.predicted(-1e308)[0].id == 2
    assert tracker.update(-1e308, [person(0.3)]) == [3] and tracker.predicted(1e308) == []
    with pytest.raises(InputError, match="time must be a finite number"):
        tracker.update(np.nan, [])
    with pytest.raises(InputError, match="max_gap must be"):
        Tracker(max_gap=0)


@given(seed=SEEDS, cut=st.integers(0, 14))
@settings(max_examples=20, deadline=None)
def test_tracker_resumes_from_state(seed, cut):
    tracker, frames = Tracker(max_gap=1.0), list(crowd(np.random.default_rng(seed), 4, 15, drop=0.5))
    for time, boxes in frames[:cut]:
        tracker.update(time, boxes)
    again = Tracker.from_state(json.loads(json.dumps(tracker.state())))
    for time, boxes in frames[cut:]:
        assert again.update(time, boxes) == tracker.update(time, boxes)
    assert again.state() == tracker.state()


def test_weak_boxes_continue_tracks_but_start_none():
    tracker = Tracker()
    assert tracker.update(0.0, [person(0, score=0.9)], [person(5, score=0.3)]) == [0, -1]
    assert tracker.update(0.1, [], [person(5, score=0.3), person(0.1, score=0.2)]) == [-1, 0]
    assert tracker.update(0.2, [person(5, score=0.9)], [person(0.2, score=0.2)]) == [1, 0]
    # strong boxes are assigned first
    assert tracker.update(0.3, [person(0.32, score=0.9)], [person(0.3, score=0.2)]) == [0, -1]


def test_weak_boxes_alone_continue_tracks_only_for_a_while():
    """They may show something else that stands where a person was last seen."""
    tracker = Tracker(max_gap=1.0)
    for k in range(3):
        assert tracker.update(0.1 * k, [person(0, score=0.9)]) == [0]
    ids = [tracker.update(0.3 + 0.1 * k, [], [person(0, score=0.2)])[0] for k in range(20)]
    state = tracker.state()
    del state["tracks"]["weak_age"]
    assert Tracker.from_state(state).predicted(2.3) == tracker.predicted(2.3)
    # seen last at 0.2 s
    assert ids == [0] * 14 + [-1] * 6 and not tracker.predicted(2.2)
    assert tracker.update(2.3, [person(0, score=0.9)]) == [1]


def test_tracker_matches_textbook_kalman_filter():
    rng, tracker = np.random.default_rng(2), Tracker()
    sd, speed, change = np.diag(POSITION_SD**2), SPEED_SD**2, SPEED_CHANGE**2
    mean, covariance = None, np.diag([*POSITION_SD**2, *speed])
    last = 0.0
    for time in np.cumsum(rng.uniform(0.02, 0.6, 20)):
        place = np.array([1.2 * time, -0.4 * time, 0.9]) + rng.normal(0, 0.1, 3)
        assert tracker.update(time, [Box(center=place, size=(1, 1, 2))]) == [0]
        if mean is None:
            mean = np.array([*place, 0, 0, 0])
        else:
            dt = time - last
            move = np.eye(6) + dt * np.eye(6, k=3)
            noise = np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.diag(change))
            mean, covariance = move @ mean, move @ covariance @ move.T + noise
            gain = covariance[:, :3] @ np.linalg.inv(covariance[:3, :3] + sd)
            mean, covariance = mean + gain @ (place - mean[:3]), covariance - gain @ covariance[:3]
        last = time
        expected = tracker.predicted(time)[0]
        np.testing.assert_allclose(expected.center, mean[:3], atol=1e-9)
        assert expected.position_sd == pytest.approx(np.sqrt(covariance[0, 0]))


def test_weak_box_on_detected_person_is_not_another_track():
    tracker = Tracker()
    for time in (0.0, 0.1, 0.2):
        assert tracker.update(time, [person(0, score=0.9), person(0.7, score=0.9)]) == [0, 1]
    assert tracker.update(0.3, [person(0, score=0.9)], [person(0.35, score=0.4)]) == [0, -1]
    assert tracker.update(0.4, [person(0, score=0.9)], [person(0.75, score=0.4)]) == [0, 1]


def test_weak_box_of_person_without_id_joins_no_track():
    tracker = Tracker()
    for time in (0.0, 0.1, 0.2, 0.3):
        assert tracker.update(time, [person(0, score=0.9)], [person(0.8, score=0.5)]) == [0, -1]
    # the first person is hidden
    assert tracker.update(0.4, [], [person(0.8, score=0.5)]) == [-1]
    assert [state.id for state in tracker.predicted(0.5)] == [0]
    assert tracker.update(0.5, [person(0.8, score=0.9)]) == [1]


def test_low_score_box_moves_track_less():
    moved = []
    for score in (1.0, 0.2):
        tracker = Tracker()
        for time in (0.0, 0.1, 0.2):
            tracker.update(time, [person(0)])
        tracker.update(0.3, [person(0.3, score=score)])
        moved.append(tracker.predicted(0.3)[0].center[0])
    assert 0.15 < moved[0] < 0.3 and moved[1] < 0.5 * moved[0]


@pytest.mark.parametrize(("squared", "id"), [(15.9, 0), (16.7, 1)])
def test_tracker_gates_boxes_by_mahalanobis_distance(squared, id):
    tracker = Tracker()
    for time in np.arange(40) / 50:
        tracker.update(time, [person(0)])
    expected = tracker.predicted(0.8)[0]
    deviation = np.sqrt(expected.position_sd**2 + POSITION_SD[0] ** 2)
    assert tracker.update(0.8, [person(expected.center[0] + deviation * np.sqrt(squared))]) == [id]


@pytest.mark.parametrize(("distance", "id"), [(5.0, 0), (7.0, 1)])
def test_tracker_rejects_unlikely_boxes_of_uncertain_tracks(distance, id):
    tracker = Tracker()
    assert tracker.update(0.0, [person(0)]) == [0] and tracker.update(2.0, [person(distance)]) == [id]


def test_tracker_smooths_heading_and_size():
    tracker = Tracker()
    times = [0.0, 0.01, 0.02, 0.03, 1.03, 1.23, 3.2]
    heading, size = np.array([1.0, 0.0]), np.array([0.5, 0.5, 1.7])
    for k, time in enumerate(times):
        yaw, own_size = 0.4 * k, np.array([0.5 + 0.1 * k, 0.5, 1.7 - 0.05 * k])
        tracker.update(time, [Box(center=(0, 0, 0.9), size=own_size, yaw=yaw)])
        if k:
            # the mean of all boxes so far, or a filter with a time constant of 0.5 s
            weight = max(1 / (k + 1), 1 - np.exp(-(time - times[k - 1]) / 0.5))
            heading = heading + weight * (np.array([np.cos(yaw), np.sin(yaw)]) - heading)
            size = size + weight * (own_size - size)
        expected = tracker.predicted(time)[0]
        np.testing.assert_allclose(expected.size, size)
        assert expected.yaw == pytest.approx(np.arctan2(heading[1], heading[0]))


def test_update_rejects_invalid_boxes_without_change():
    tracker, other = Tracker(), Tracker()
    for each in (tracker, other):
        assert each.update(0.0, [person(0)]) == [0]
    for boxes in (np.zeros((2, 7)), None, 5, [[1, 2, 3]]):
        with pytest.raises(InputError, match="expected a list of Box, got"):
            tracker.update(1.9, boxes)
    assert tracker.state() == other.state()
    # any iterable of boxes is accepted
    assert tracker.update(0.1, (person(0.05) for _ in range(1))) == [0]


@pytest.mark.parametrize(
    "state",
    [
        {},
        None,
        {"max_gap": 2.0, "tracks": []},
        Tracker().state() | {"tracks": {"id": []}},
        Tracker().state() | {"time": "x"},
        Tracker().state() | {"next_id": None},
        Tracker().state() | {"tracks": Tracker().state()["tracks"] | {"age": [1.0]}},
        Tracker().state() | {"tracks": Tracker().state()["tracks"] | {"id": [10**400]}},
    ],
)
def test_from_state_rejects_invalid_state(state):
    with pytest.raises(InputError, match="^expected the state of a tracker, got .*: give what Tracker.state"):
        Tracker.from_state(state)


def test_weak_box_below_detected_person_is_a_duplicate():
    """Its height does not matter."""
    tracker = Tracker()
    low = Box(center=(0.1, 0, 0.2), size=(0.6, 0.6, 1.0), score=0.4)
    assert tracker.update(0.0, [person(0, score=0.9)], [low]) == [0, -1]
    assert len(tracker._tracks) == 1
