"""Waymo's metrics: OKS, PCK by box size, PEM and its matching."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from lidarpose import metrics
from lidarpose.errors import InputError
from lidarpose.eval.metrics.keypoints import distance_to_boxes, match_people
from lidarpose.sample import Box
from lidarpose.skeleton import BODY26, WAYMO14

quick = settings(max_examples=40, deadline=None)
seeds = st.integers(0, 2**32 - 1)
J = len(WAYMO14)
SIZE = (1.0, 1.0, 2.0)


def people(*places, seed=0):
    """Joints (n, J, 3) m of a person at each place along x, and boxes (n, 7) of SIZE about these places."""
    body = np.random.default_rng(seed).uniform(-0.3, 0.3, (J, 3))
    center = np.array([[x, 0.0, 1.0] for x in places]).reshape(-1, 3)
    boxes = np.concatenate([center, np.broadcast_to(SIZE, center.shape), np.zeros((len(center), 1))], 1)
    return center[:, None] + body, boxes


# ---- OKS and PCK by box


def test_oks_sigmas_match_published_values():
    sigmas = dict(zip(WAYMO14.joints, metrics.oks_sigmas(), strict=True))
    assert sigmas["nose"] == 0.052 and sigmas["left_hip"] == sigmas["right_hip"] == 0.214
    assert sigmas["head_center"] == sigmas["left_shoulder"] == 0.158 and sigmas["right_wrist"] == 0.124
    with pytest.raises(InputError, match="no sigma for pelvis, .* of body26"):
        metrics.oks_sigmas(BODY26)
    poses, size = np.zeros((2, 15, 3)), np.ones((2, 3))
    with pytest.raises(InputError, match="OKS of 15 joints needs sigmas"):
        metrics.oks(poses, poses, size)
    assert (metrics.oks(poses, poses, size, sigmas=[0.1] * 15) == 1).all()


@quick
@given(seeds)
def test_oks_matches_loop(seed):
    rng = np.random.default_rng(seed)
    true = rng.normal(size=(4, J, 3))
    pred = true + rng.normal(size=true.shape) * 0.1
    size, visible = rng.uniform(0.5, 2, (4, 3)), rng.random((4, J)) < 0.5
    visible[3] = False
    found = metrics.oks(pred, true, size, visible)
    sigmas = metrics.oks_sigmas()
    for i in range(4):
        scale = (size[i, 0] * size[i, 1] * size[i, 2]) ** (1 / 3)
        terms = [
            np.exp(-np.sum((pred[i, j] - true[i, j]) ** 2) / (2 * (sigmas[j] * scale) ** 2))
            for j in range(J)
            if visible[i, j]
        ]
        assert found[i] == pytest.approx(np.mean(terms) if terms else np.nan, nan_ok=True)


def test_oks_and_oks_ap_at_error_of_one_sigma():
    true, boxes = people(0, 5)
    size = boxes[:, 3:6]
    off = metrics.oks_sigmas() * 2 ** (1 / 3)
    pred = true.copy()
    pred[0, :, 1] += off
    np.testing.assert_allclose(metrics.oks(pred, true, size), [np.exp(-0.5), 1])
    # 0.6065 is above three of the ten thresholds
    assert metrics.oks_ap(pred, true, size) == pytest.approx((30 + 100) / 2)
    assert metrics.oks_ap(pred, true, size, thresholds=[0.65]) == 50
    # the score must be above the threshold, not equal
    assert metrics.oks_ap(true, true, size, thresholds=[1.0]) == 0
    assert metrics.oks_ap(true, true, size) == 100
    score = metrics.oks_ap(pred, true, size, np.stack([np.ones(J), np.zeros(J)]))
    assert score == pytest.approx(30) and (score.people, score.skipped) == (1, 1)
    table = metrics.oks_hits(metrics.oks(pred, true, size))
    assert metrics.by_span(table, [3, 30], (0, 10, 40))["10 to 40"].score == 100


def test_pck_box_matches_documented_example():
    # a box of 1 x 1 x 2 m has scale 1.26 m; 0.2 of it are 25 cm
    true, boxes = people(0)
    pred = true.copy()
    pred[0, :7, 0] += 0.2519
    pred[0, 7:, 0] += 0.2521
    assert metrics.pck_box(pred, true, boxes[:, 3:6]) == 50
    assert metrics.pck_box(pred, true, SIZE, threshold=0.3) == 100
    # joints at the threshold count
    one = np.zeros((1, 1, 3))
    assert metrics.pck_box(one + [0.25, 0, 0], one, (1, 1, 1), threshold=0.25) == 100
    # as in Waymo's code: the threshold times the sigma of each joint
    pred = true.copy()
    pred[0, :, 1] += 0.2 * 2 ** (1 / 3) * 0.15
    sigmas = metrics.oks_sigmas()
    share = 100 * np.mean(sigmas > 0.15)
    assert metrics.pck_box(pred, true, SIZE, sigmas=sigmas) == pytest.approx(share) and 0 < share < 100
    # averaged over joints, as in Waymo's code
    true, boxes = people(0, 5)
    pred, visible = true.copy(), np.ones((2, J))
    pred[1] += 1
    visible[1, 1:] = 0
    assert metrics.pck_box(pred, true, boxes[:, 3:6], visible) == pytest.approx(100 * J / (J + 1))
    assert metrics.pck_box(pred, true, boxes[:, 3:6], visible, average="person") == 50


@pytest.mark.parametrize("metric", [metrics.pck_box, metrics.oks, metrics.oks_ap])
@pytest.mark.parametrize(
    "size, sigmas, message",
    [
        (np.ones((2, 7)), None, r"size must be \(2, 3\), length, width and height .* got \(2, 7\)"),
        (np.zeros((2, 3)), None, "size must be positive"),
        (np.ones((2, 3)), [0.1] * 13, r"sigmas must be \(14,\) positive"),
    ],
)
def test_box_metrics_reject_invalid_sizes_and_sigmas(metric, size, sigmas, message):
    true, _ = people(0, 5)
    with pytest.raises(InputError, match=message):
        metric(true, true, size, sigmas=sigmas)


# ---- matching


@quick
@given(seeds)
def test_distance_to_boxes_matches_box_contains(seed):
    rng = np.random.default_rng(seed)
    box = np.concatenate([rng.normal(size=3), rng.uniform(0.5, 2, 3), rng.uniform(-4, 4, 1)])
    points = box[:3] + rng.normal(size=(50, 3)) * 1.5
    found = distance_to_boxes(points, box[None])[0]
    house = Box(center=box[:3], size=box[3:6], yaw=box[6])
    np.testing.assert_array_equal(found == 0, house.contains(points))
    # the box grown by the distance just contains the point; no point of a ball with this radius is in the box
    for point, distance in zip(points, found, strict=True):
        assert house.contains(point[None], distance + 1e-9)[0]
        around = rng.normal(size=(20, 3))
        around *= 0.999 * distance / np.linalg.norm(around, axis=1, keepdims=True)
        assert distance == 0 or not house.contains(point + around).any()


@quick
@given(seeds, st.integers(0, 3), st.integers(0, 3))
def test_match_people_minimizes_cost(seed, found, there):
    rng = np.random.default_rng(seed)
    true, boxes = people(*rng.uniform(0, 0.4, there), seed=seed)
    pred, _ = people(*rng.uniform(0, 0.4, found), seed=seed)
    labeled, predicted = rng.random((there, J)) < 0.7, rng.random((found, J)) < 0.9
    labeled[:, 0] = predicted[:, 0] = True
    matches = match_people(pred, true, boxes, predicted, labeled)

    def cost(g, p):
        total = 0.0
        for j in range(J):
            if labeled[g, j] and predicted[p, j]:
                total += min(np.linalg.norm(true[g, j] - pred[p, j]), 0.25)
            elif labeled[g, j] or predicted[p, j]:
                total += 0.25
        return min(total / J, 0.25)

    # an unmatched person costs as much as a match at the penalty
    size = min(there, found)
    best = min(
        sum(cost(g, p) for g, p in zip(some, order, strict=True))
        for some in permutations(range(there), size)
        for order in permutations(range(found), size)
    )
    paid = sum(cost(g, p) for g, p in matches.pairs) + 0.25 * (size - len(matches.pairs))
    assert paid == pytest.approx(best)
    assert sorted([*matches.pairs[:, 0], *matches.missed]) == list(range(there))
    assert sorted([*matches.pairs[:, 1], *matches.extra]) == list(range(found)) and not len(matches.excused)


# ---- PEM


def test_pem_of_one_frame_matches_manual_result():
    # one match with an error of 10 cm, one miss, one false positive far away, one in the box of an unlabeled person
    true, boxes = people(0, 5, 10)
    pred, _ = people(0, 10, 20)
    pred[0, :, 2] += 0.1
    visible = np.ones((3, J))
    visible[2] = 0
    found = metrics.pem([pred], [true], [boxes], [visible])
    assert found.pem == pytest.approx((J * 100 + 2 * J * 250) / (3 * J))
    assert found.matched_error == pytest.approx(100)
    assert (found.matched, found.missed, found.extra) == (J, J, J)
    assert (found.people, found.people_missed, found.people_extra, found.people_excused) == (1, 1, 1, 1)


def test_pem_pools_keypoints_of_all_frames():
    true, boxes = people(0, 1, 2, 7)
    exact = metrics.pem([true[::-1]] * 3, [true] * 3, [boxes] * 3)
    assert exact.pem == 0 and exact.matched == 3 * 4 * J and not exact.missed + exact.extra
    true, boxes = people(0)
    pred, empty = true + [0, 0, 0.05], np.empty((0, J, 3))
    found = metrics.pem([pred, empty, pred], [true, true, empty], [boxes, boxes, np.empty((0, 7))])
    assert found.pem == pytest.approx((50 + 250 + 250) / 3)
    assert (found.matched, found.missed, found.extra) == (J, J, J)
    # frames without people may be empty lists
    ones = np.ones((1, J))
    found = metrics.pem([true, []], [[], true], [[], boxes], [[], ones], predicted=[ones, []])
    assert found.pem == 250 and (found.missed, found.extra) == (J, J)
    nothing = metrics.pem([[]], [[]], [[]])
    assert np.isnan([nothing.pem, nothing.matched_error]).all()


def test_pem_counts_unlabeled_and_missing_joints():
    true, boxes = people(0)
    pred, visible, predicted = true.copy(), np.ones((1, J)), np.ones((1, J))
    pred[0, 0, 0] += 3.0
    visible[0, [1, 3]] = predicted[0, [2, 3]] = 0
    found = metrics.pem([pred], [true], [boxes], [visible], predicted=[predicted])
    # a large error costs no more than a miss; joints neither labeled nor predicted cost nothing
    assert found.pem == pytest.approx(3 * 250 / (J - 1)) and found.matched_error == pytest.approx(250 / (J - 3))
    assert (found.matched, found.missed, found.extra) == (J - 3, 1, 1)
    dear = metrics.pem([pred], [true], [boxes], [visible], predicted=[predicted], penalty=0.5)
    assert dear.pem == pytest.approx(3 * 500 / (J - 1))
    # a prediction without predicted joints is ignored
    found = metrics.pem([true], [true], [boxes], predicted=[np.zeros((1, J))])
    assert (found.missed, found.extra, found.people_extra) == (J, 0, 0)


def test_pem_does_not_excuse_predictions_of_labeled_people():
    # an unlabeled person stands at the same place: predictions near a label are kept for its person
    true, boxes = people(0, 0)
    visible = np.ones((2, J))
    visible[1] = 0
    found = metrics.pem([true[:1]], [true], [boxes], [visible])
    assert found.pem == 0 and (found.people, found.people_excused) == (1, 0)
    # each unlabeled person excuses at most one prediction
    away, _ = people(10, 10)
    whose, boxes = people(10)
    found = metrics.pem([away], [whose], [boxes], [np.zeros((1, J))])
    assert (found.people_excused, found.people_extra, found.extra) == (1, 1, J)
    # predictions near the box without keypoints inside are not excused
    found = metrics.pem([whose + [0.9, 0, 0]], [whose], [boxes], [np.zeros((1, J))])
    assert (found.people_excused, found.people_extra, found.extra) == (0, 1, J)


def test_pem_does_not_match_far_from_the_box():
    true, boxes = people(0)
    # a shifted box: keypoints agree, but none of them is within 25 cm of it
    boxes[:, 0] += 2
    found = metrics.pem([true], [true], [boxes])
    assert found.pem == pytest.approx(250) and (found.people_missed, found.people_extra) == (1, 1)
    # by the nearest keypoint, 24 or 26 cm in front of the box
    for gap, people_matched in ((0.24, 1), (0.26, 0)):
        boxes[:, 0] = true[0, :, 0].max() + gap + SIZE[0] / 2
        assert metrics.pem([true], [true], [boxes]).people == people_matched


def test_pem_ignores_joints_that_are_not_predicted():
    true, boxes = people(0, 10)
    visible, predicted = np.ones((2, J)), np.ones((1, J))
    visible[1] = predicted[0, 0] = 0

    def matched(pred, true=true, boxes=boxes, visible=visible):
        return metrics.pem([pred], [true], [boxes], [visible], predicted=[predicted])

    # only the first joint is not predicted; it lies at the label of another person
    pred = true[1:].copy()
    pred[0, 0] = true[0, 0]
    found = matched(pred)
    assert (found.people_excused, found.people_missed, found.extra) == (1, 1, 0)
    # it lies in the box of an unlabeled person
    pred = true[1:] + [5, 0, 0]
    pred[0, 0] = true[1, 0]
    found = matched(pred)
    assert (found.people_excused, found.people_missed, found.extra) == (0, 1, J - 1)
    # it is the only joint near the box
    pred, moved = true[:1].copy(), boxes[:1].copy()
    moved[0, 0] = pred[0, 0, 0] = 2
    found = matched(pred, true[:1], moved, visible[:1])
    assert (found.people, found.people_missed, found.people_extra) == (0, 1, 1)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"true": []}, "one entry per frame in every argument"),
        ({"pred": [np.zeros((1, 13, 3))]}, "frame 0: pred and true must have the same joints"),
        ({"pred": [np.zeros((J, 3))]}, r"frame 0: pred must be \(people, joints, 3\)"),
        ({"pred": [np.full((1, J, 3), np.nan)]}, "frame 0: pred must be finite"),
        ({"boxes": [np.zeros((1, 7))]}, r"frame 0: boxes must be \(1, 7\)"),
        ({"boxes": [np.ones((2, 7))]}, r"frame 0: boxes must be \(1, 7\)"),
        ({"visible": [np.ones((2, J))]}, r"frame 0: visible must be \(1, 14\)"),
        ({"predicted": [np.ones((1, 2))]}, r"frame 0: predicted must be \(1, 14\)"),
        ({"penalty": 0.0}, "penalty must be a positive"),
    ],
)
def test_pem_rejects_invalid_frames(change, message):
    true, boxes = people(0)
    with pytest.raises(InputError, match=message):
        metrics.pem(**({"pred": [true], "true": [true], "boxes": [boxes]} | change))
