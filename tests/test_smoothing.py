"""Smoothing of poses over time: the smoother, the live filter, and clips of one person."""

import json
from dataclasses import replace

import numpy as np
import pandas
import pytest

from lidarpose.errors import InputError
from lidarpose.inference.inputs import clip_times
from lidarpose.inference.predictor import _with_frame_values, load
from lidarpose.inference.results import PersonPose
from lidarpose.sample import Pose
from lidarpose.skeleton import SKELETONS, SMPL24, Skeleton
from lidarpose.tracking.bones import lengths_of, rigid_bones
from lidarpose.tracking.clip import TrackPoses
from lidarpose.tracking.facing import swapped_frames
from lidarpose.tracking.live import LiveFilter, filter_track
from lidarpose.tracking.motion_model import SCALES, KalmanState, learn_process_noise, pooled, smooth_joints
from lidarpose.tracking.smoothing import likely_hit, smooth, with_facing_corrected


def rest_pose(skeleton):
    """(J, 3) m: a standing person of the skeleton, facing +x."""
    from lidarpose.body.rig import mean_adult_joints

    joints = mean_adult_joints()
    head = joints[SMPL24.index("head")]
    joints = np.concatenate([joints, [head + [0.11, 0, 0.06], head + [0, 0, 0.1]]])
    return joints[[SKELETONS["body26"].index(name) for name in skeleton.joints]]


@pytest.fixture(scope="module")
def walker():
    """Function that returns true joints of a person who walks along a curve, and a track of noisy poses."""

    def made(skeleton=SMPL24, frames=40, noise=0.05, seed=0):
        rng = np.random.default_rng(seed)
        times = np.arange(frames) / 10
        angle = 0.3 * times
        turn = np.stack([np.cos(angle), -np.sin(angle), 0 * angle, np.sin(angle), np.cos(angle), 0 * angle], -1)
        turn = np.concatenate([turn, np.broadcast_to([0, 0, 1], (frames, 3))], -1).reshape(frames, 3, 3)
        place = np.stack([4 * np.sin(angle), 4 - 4 * np.cos(angle), 0 * angle], -1) + [10, 3, -1]
        true = np.einsum("tij,kj->tki", turn, rest_pose(skeleton)) + place[:, None]
        spread = rng.uniform(0.5, 1.5, true.shape[:2]) * noise
        joints = true + rng.normal(size=true.shape) * spread[..., None] / 1.6
        known = {"visible": np.full(spread.shape, 0.9), "confidence": np.full(spread.shape, 0.8)}
        return true, TrackPoses(times=times, joints=joints, spread=spread, skeleton=skeleton, **known)

    return made


@pytest.fixture(scope="module")
def people_in_motion():
    """True joints and noisy tracks of 40 synthesized clips; half of the error is the same in all frames of a clip."""
    from lidarpose.synth.generator import Generator

    generator, rng, clips = Generator(scene="wild", measure=False), np.random.default_rng(3), []
    for index in range(40):
        true = np.stack([person.sample.pose.to(SMPL24).joints for person in generator.clip(31, index)])
        spread = rng.uniform(0.03, 0.09, true.shape[1:2]) * rng.uniform(0.8, 1.2, true.shape[:2])
        noise = (rng.normal(size=true.shape[1:]) + rng.normal(size=true.shape)) / np.sqrt(2)
        joints = true + noise * spread[..., None] / 1.6
        times = np.arange(len(true)) / 10
        clips.append((true, TrackPoses(times=times, joints=joints, spread=spread, skeleton=SMPL24)))
    return clips


def test_smooth_joints_matches_dense_solve(walker):
    """Forward-backward filtering gives the least-squares solution for any time steps."""
    from reference.smoothing_reference import smooth_joints_reference

    rng = np.random.default_rng(1)
    times = np.cumsum(rng.uniform(0.05, 0.3, 12))
    joints, precision = rng.normal(size=(12, 3, 3)), rng.uniform(50, 500, (12, 3))
    precision[4:6] = 0
    process_noise = rng.uniform(0.01, 1, (12, 3))
    for fast, slow in zip(
        smooth_joints(times, joints, precision, process_noise),
        smooth_joints_reference(times, joints, precision, process_noise),
        strict=True,
    ):
        np.testing.assert_allclose(fast, slow, rtol=1e-6, atol=1e-8)


def error(joints, true):
    """Mean distance, and mean distance of second differences, mm."""
    off = joints - true
    return [1e3 * np.linalg.norm(v, axis=-1).mean() for v in (off, np.diff(off, 2, axis=0))]


ARM = Skeleton(name="arm", joints=("pelvis", "right_shoulder", "right_elbow", "right_wrist"), parents=(-1, 0, 1, 2))


@pytest.mark.parametrize("skeleton", [*SKELETONS.values(), ARM], ids=[*SKELETONS, "arm"])
def test_smoothing_reduces_error_and_jitter(walker, skeleton):
    true, track = walker(skeleton)
    before, steady = error(track.joints, true), error(smooth(track).joints, true)
    assert steady[0] < 0.7 * before[0] and steady[1] < 0.15 * before[1]
    live = error(np.stack([pose.joints for pose in filter_track(track)]), true)
    assert live[0] < before[0] and live[1] < 0.5 * before[1]


@pytest.mark.parametrize("speed", [10.0, -25.0])
def test_smoothing_works_for_moving_sensor(walker, speed):
    """In the coordinates of a sensor that drives and brakes, smoothed poses are still at the person."""
    true, track = walker()
    way = np.outer(speed * track.times - 0.5 * np.sign(speed) * 2.5 * track.times**2, [1, 0, 0])[:, None]
    moved = replace(track, joints=track.joints + way)
    before = error(moved.joints, true + way)
    steady = error(smooth(moved).joints, true + way)
    assert steady[0] < 0.8 * before[0] and steady[1] < 0.2 * before[1]
    live = error(np.stack([pose.joints for pose in filter_track(moved)]), true + way)
    assert live[0] < 1.1 * before[0] and live[1] < 0.75 * before[1]


@pytest.mark.parametrize("skeleton", SKELETONS.values(), ids=SKELETONS)
def test_smoothing_corrects_left_right_swaps(walker, skeleton):
    true, track = walker(skeleton)
    joints, spread, confidence = track.joints.copy(), track.spread.copy(), track.confidence.copy()
    turned = [3, 4, 5, 12, 20, 21, 22, 23, 24, 39]
    for values in (joints, spread):
        values[turned] = values[turned][:, list(skeleton.flip)]
    confidence[turned] = 0.6
    steady = smooth(replace(track, joints=joints, spread=spread, confidence=confidence))
    np.testing.assert_allclose(steady.joints, smooth(track).joints, atol=1e-9)


@pytest.mark.parametrize("gap", [1.0, 3600.0])
def test_smoothing_allows_turn_within_gap(gap):
    rng, standing = np.random.default_rng(0), rest_pose(SMPL24)
    facing = np.array([1.0] * 8 + [-1.0] * 4)
    times = np.concatenate([np.arange(8) / 10, 0.7 + gap + np.arange(4) / 10])
    true = standing * np.stack([facing, facing, np.ones(12)], 1)[:, None]
    joints = true + rng.normal(0, 0.02, true.shape)
    track = TrackPoses(times=times, joints=joints, skeleton=SMPL24, spread=np.full((12, 24), 0.03))
    assert np.linalg.norm(smooth(track).joints - true, axis=-1).mean() < 0.03


def test_smoothing_follows_hopping_person():
    rng, times = np.random.default_rng(0), np.arange(60) / 10
    true = rest_pose(SMPL24) + np.stack([0 * times, 0 * times, 0.1 * np.sin(2 * np.pi * 1.5 * times)], 1)[:, None]
    joints = true + rng.normal(0, 0.03 / 1.6, true.shape)
    track = TrackPoses(times=times, joints=joints, skeleton=SMPL24, spread=np.full((60, 24), 0.03))
    before, after = (np.linalg.norm(values - true, axis=-1).mean() for values in (joints, smooth(track).joints))
    assert after < before


@pytest.mark.parametrize("skeleton", SKELETONS.values(), ids=SKELETONS)
def test_smoothing_keeps_bone_lengths(walker, skeleton):
    true, track = walker(skeleton)
    bones = rigid_bones(skeleton)
    names = {tuple(skeleton.joints[end] for end in bone) for bone in bones}
    assert {("left_hip", "left_knee"), ("right_shoulder", "right_elbow"), ("left_hip", "right_hip")} <= names
    steady = smooth(track).joints
    lengths, exact = (np.linalg.norm(j[:, bones[:, 0]] - j[:, bones[:, 1]], axis=-1) for j in (steady, true))
    assert np.abs(lengths - lengths.mean(0)).max() < 0.005 and np.abs(lengths - exact).mean() < 0.02


def test_smoothing_fills_and_marks_unseen_frames(walker):
    true, track = walker(frames=60)
    joints = track.joints.copy()
    # gaps of 0.8 s, 2.9 s, and at the end
    for gap in (slice(5, 13), slice(20, 49), slice(54, 60)):
        joints[gap] = np.nan
    given = TrackPoses(
        times=track.times, joints=joints, spread=track.spread, visible=track.visible, skeleton=track.skeleton
    )
    steady = smooth(given)
    # the long gap is filled only within half a second of its ends
    far = [25 <= i < 44 or i == 59 for i in range(60)]
    assert [pose is None for pose in steady.poses()] == far
    assert steady.filled.tolist() == [bool(np.isnan(joints[i]).any()) and not far[i] for i in range(60)]
    assert np.linalg.norm(steady.joints[5:13] - true[5:13], axis=-1).mean() < 0.1
    assert steady.spread[9].mean() > 1.5 * steady.spread[[3, 15]].mean()
    assert (steady.visible[5:13] == 0).all() and (steady.visible[:5] == 0.9).all()
    live = filter_track(given)
    assert live[12] is not None and live[20] is not None and live[48] is None and live[49] is not None
    assert live[10].spread.mean() > 2 * live[4].spread.mean()
    assert (live[10].visible == 0).all()
    np.testing.assert_allclose(live[10].confidence, likely_hit(live[10].spread))
    # confidence of filled frames follows from their spread; that of other frames is unchanged
    steady = smooth(replace(given, confidence=track.confidence))
    np.testing.assert_allclose(steady.confidence[5:13], likely_hit(steady.spread[5:13]))
    assert (steady.confidence[:5] == 0.8).all()


@pytest.mark.parametrize(("gap", "is_filled"), [(19, True), (20, False)])
def test_smooth_fills_gaps_up_to_max_gap(walker, gap, is_filled):
    _, track = walker(frames=60)
    joints = track.joints.copy()
    joints[20 : 20 + gap] = np.nan
    # frame 29 is 0.9 s or more from both ends of the gap
    assert smooth(replace(track, joints=joints)).filled[29] == is_filled


def test_likely_hit_matches_sampled_distances():
    rng = np.random.default_rng(0)
    for spread in (0.05, 0.12):
        distance = np.linalg.norm(rng.normal(size=(200_000, 2)), axis=1)
        share = (distance * spread / distance.mean() < 0.1).mean()
        assert likely_hit(np.array(spread)) == pytest.approx(share, abs=0.005)


def test_smoothing_is_robust_to_outlier_frame(walker):
    true, track = walker()
    joints = track.joints.copy()
    joints[20] += [1.0, 0, 0]
    off = replace(track, joints=joints)
    assert error(smooth(off).joints, true)[0] < 1.1 * error(smooth(track).joints, true)[0]
    live = np.stack([pose.joints for pose in filter_track(off)])
    assert np.linalg.norm(live[20] - true[20], axis=-1).mean() < 0.2


def test_smoothed_spread_keeps_common_error():
    times = np.arange(100) / 10
    joints = np.broadcast_to(rest_pose(SMPL24), (100, 24, 3))
    track = TrackPoses(times=times, joints=joints, skeleton=SMPL24, spread=np.full((100, 24), 0.05))
    for steady, most in ((smooth(track).pose(50), 0.05), (filter_track(track)[99], 0.06)):
        assert 0.8 * 0.05 < steady.spread.min() and steady.spread.max() < most


def test_smoothing_limits_tiny_spread():
    rng, times = np.random.default_rng(0), np.arange(10) / 10
    joints = rest_pose(SMPL24) + rng.normal(0, 0.01, (10, 24, 3))
    for spread in (0.0, 1e-9):
        track = TrackPoses(times=times, joints=joints, skeleton=SMPL24, spread=np.full((10, 24), spread))
        steady = smooth(track)
        assert np.linalg.norm(steady.joints - joints, axis=-1).max() < 0.1 and (steady.spread > 1e-3).all()
        assert all(np.isfinite(pose.joints).all() for pose in filter_track(track))


def test_lengths_of_bones_are_equal_for_left_and_right():
    bones = rigid_bones(SMPL24)
    total = np.random.default_rng(0).uniform(1, 2, (len(bones), 2))
    names = [tuple(SMPL24.joints[end] for end in bone) for bone in bones]
    lengths = dict(zip(names, lengths_of(total, bones, SMPL24), strict=True))
    for name, length in lengths.items():
        other = tuple(SMPL24.joints[SMPL24.flip[SMPL24.index(end)]] for end in name)
        rows = [k for k, ends in enumerate(names) if set(ends) in (set(name), set(other))]
        assert length == pytest.approx(np.sqrt(total[rows, 0].sum() / total[rows, 1].sum()))


def test_live_filter_keeps_bone_lengths(walker):
    _, track = walker(frames=60)
    bones = rigid_bones(track.skeleton)
    before, live = track.joints[30:], np.stack([pose.joints for pose in filter_track(track)[30:]])
    before, live = (
        np.linalg.norm(j[:, bones[:, 0]] - j[:, bones[:, 1]], axis=-1).std(0).mean() for j in (before, live)
    )
    assert live < 0.15 * before


def test_learn_process_noise_matches_enumeration():
    """The enumeration sums over all sequences of scales."""
    rng = np.random.default_rng(0)
    times, usual = np.array([0.0, 0.2, 3.0, 3.4]), np.array([0.04, 0.4])
    joints = np.cumsum(rng.normal(0, 0.3, (4, 2, 3)), 0)
    precision = rng.uniform(200, 800, (4, 2))
    state, steps, likelihood = KalmanState.unknown((len(SCALES), 2)), np.diff(times, prepend=0.0), np.empty((4, 9, 2))
    for row, step in enumerate(steps):
        state, likelihood[row] = state.predicted(step, SCALES[:, None] * usual).updated(joints[row], precision[row])
    likelihood = np.exp(pooled(likelihood) - pooled(likelihood).max(1, keepdims=True))
    expected = np.empty((4, 2))
    for j in range(2):
        course = likelihood[0, :, j] / 9
        for row in range(1, 4):
            stay = np.exp(-steps[row] / 20)
            change = stay * np.eye(9) + (1 - stay) / 9
            course = course[..., None] * change * likelihood[row, :, j]
        for row in range(4):
            share = course.sum(tuple(k for k in range(4) if k != row))
            expected[row, j] = np.log(SCALES) @ share / share.sum()
    np.testing.assert_allclose(learn_process_noise(times, joints, precision, usual), usual * np.exp(expected))


@pytest.mark.parametrize("sign", [1, -1])
def test_facing_correction_follows_walking_direction(walker, sign):
    true, track = walker()
    flip = list(track.skeleton.flip)
    # the same walk forward or backward in time
    track = replace(track, joints=track.joints[::sign].copy(), confidence=np.zeros(track.spread.shape))
    joints = with_facing_corrected(track).joints
    np.testing.assert_array_equal(joints, track.joints if sign > 0 else track.joints[:, flip])


def test_facing_correction_follows_confident_frames():
    joints = np.broadcast_to(rest_pose(SMPL24), (10, 24, 3)).copy()
    confidence = np.full((10, 24), 0.1)
    confidence[:3] = 0.9
    joints[:3] = joints[:3, list(SMPL24.flip)]
    track = TrackPoses(
        times=np.arange(10) / 10, joints=joints, skeleton=SMPL24, spread=np.full((10, 24), 0.05), confidence=confidence
    )
    np.testing.assert_array_equal(with_facing_corrected(track).joints, np.broadcast_to(joints[0], joints.shape))


@pytest.mark.long
@pytest.mark.parametrize("gap", [4, 8, 12])
def test_spread_of_filled_joints_matches_error(people_in_motion, gap):
    """Grouped by the number of frames to the nearest seen frame. Spread must be large enough for fast hands, too."""
    first = (16 - gap) // 2
    spread, error = ([[] for _ in range(gap // 2)] for _ in range(2))
    for true, track in people_in_motion:
        joints = track.joints.copy()
        joints[first : first + gap] = np.nan
        steady = smooth(replace(track, joints=joints))
        off = np.linalg.norm(steady.joints - true, axis=-1)
        for k in range(gap):
            assert steady.filled[first + k]
            spread[min(k, gap - 1 - k)].append(steady.spread[first + k])
            error[min(k, gap - 1 - k)].append(off[first + k])
    for stated, actual in zip(spread, error, strict=True):
        assert 0.95 < np.mean(stated) / np.mean(actual) < 1.4
        # also for single joints, not only on average
        assert 0.5 < (np.array(actual) < np.array(stated)).mean() < 0.9


def test_live_filter_resumes_from_state(walker):
    _, track = walker()
    whole, poses = filter_track(track), track.poses()
    begun = LiveFilter(track.skeleton)
    for t in range(20):
        begun.update(track.times[t], poses[t])
    again = LiveFilter.from_state(json.loads(json.dumps(begun.state())))
    for t in range(20, 40):
        np.testing.assert_array_equal(again.update(track.times[t], poses[t]).joints, whole[t].joints)


def test_smoothing_of_one_and_of_no_pose(walker):
    _, track = walker(frames=1)
    assert np.abs(smooth(track).joints - track.joints).max() < 1e-3
    nobody = TrackPoses.of_poses(np.arange(3.0), [None] * 3, SMPL24)
    assert smooth(nobody).poses() == filter_track(nobody) == [None] * 3


def test_track_poses_rejects_times_that_do_not_increase():
    with pytest.raises(InputError, match="later than the one before"):
        TrackPoses.of_poses(np.array([0.0, 0.0]), [None, None], SMPL24)


# ---- clips of clouds


@pytest.fixture(scope="module")
def clouds():
    from lidarpose.synth.generator import Generator

    people = Generator(scene="wild", measure=False).clip(3, 0, frames=8, hard=0.0)
    return [person.sample.points for person in people]


def test_predict_clip_smooths_poses_of_clouds(clouds):
    model = load("tiny", tta=1)
    given = [*clouds[:4], np.zeros((0, 3)), *clouds[5:]]
    steady = model.predict_clip(given, sensor_origin=(0, 0, 0), skeleton="human15")
    assert len(steady) == 8 and [person.id for person in steady] == list(range(8))
    assert steady[4].has_pose and steady[4].num_points == 0 and "filled in" in steady[4].warnings[0]
    assert steady[0].num_points == len(clouds[0]) and steady.skeleton.name == "human15"
    each = model.predict(given, sensor_origin=(0, 0, 0), skeleton="human15")
    assert not np.allclose(steady[3].joints, each[3].joints)
    first = model.predict_clip(given[:3], sensor_origin=(0, 0, 0), live=True)
    same = model.predict_clip(given, sensor_origin=(0, 0, 0), live=True)
    # joints out of range are those of the frames
    assert all((a.in_range == b.in_range).all() for a, b in zip(steady, each, strict=True) if b.has_pose)
    assert all(person.in_range is not None for person in same if person.num_points)
    # the track is smoothed, or filtered if live, with the given times
    own = [person.pose for person in each]
    for seconds in (None, np.cumsum([0.0, 0.1, 0.4, 0.1, 0.1, 0.3, 0.1, 0.1])):
        times = np.arange(8) / 10 if seconds is None else seconds
        track = TrackPoses.of_poses(times, own, each.skeleton)
        for is_live, wanted in ((False, smooth(track).poses()), (True, filter_track(track))):
            clip = model.predict_clip(given, seconds, sensor_origin=(0, 0, 0), skeleton="human15", live=is_live)
            np.testing.assert_allclose(clip.to_numpy(), [pose.joints for pose in wanted], atol=1e-5)
    with pytest.raises(InputError, match="times: expected 8 finite numbers"):
        model.predict_clip(given, np.zeros(8), sensor_origin=(0, 0, 0))
    # later clouds change only the rounding, because of another batch size
    np.testing.assert_allclose(first.to_numpy(), same.to_numpy()[:3], rtol=0, atol=1e-6)
    assert len(model.predict_clip([])) == 0


@pytest.mark.parametrize("live", [False, True])
def test_predict_clip_keeps_person_probabilities(clouds, live):
    model = load("small")
    given = [*clouds[:3], np.zeros((0, 3)), *clouds[4:6]]
    each = model.predict(given, sensor_origin=(0, 0, 0))
    steady = model.predict_clip(given, sensor_origin=(0, 0, 0), live=live)
    for k, (own, person) in enumerate(zip(each, steady, strict=True)):
        assert (person.person, person.second_person) == (own.person, own.second_person)
        assert (person.person is None) == (k == 3) and person.has_pose


def test_frame_values_of_swapped_pose_are_of_other_side():
    in_range = np.array([not name.startswith("left_") for name in SMPL24.joints])
    pose = Pose(joints=np.zeros((24, 3)), skeleton=SMPL24, in_range=in_range, person=np.float64(0.25))
    person = PersonPose(pose=pose, skeleton=SMPL24, points=np.zeros((9, 3)))
    steady = Pose(joints=np.ones((24, 3)), skeleton=SMPL24)
    for is_swapped, side in ((False, "left_"), (True, "right_")):
        values = _with_frame_values(person, steady, is_swapped)
        assert values.person == 0.25 and (values.joints == 1).all()
        assert values.in_range.tolist() == [not name.startswith(side) for name in SMPL24.joints]


def test_clip_times_defaults_and_rejects_invalid_times():
    assert clip_times(None, 3).tolist() == [0, 0.1, 0.2] and clip_times((0, 0.5, 7), 3).tolist() == [0, 0.5, 7]
    dates = [np.arange(3).astype(kind) for kind in ("M8[ms]", "m8[s]")]
    dates.append(pandas.Series(pandas.date_range("2024", periods=3, tz="UTC")))
    for times in ([0, 1], [0, 1, 1], [0, 1, np.nan], [0, 1, 10**400], "abc", *dates):
        with pytest.raises(InputError, match="3 finite numbers"):
            clip_times(times, 3)


def test_smoothing_splits_track_at_long_gap(walker):
    _, track = walker(frames=24)
    later = replace(track, times=track.times + np.where(np.arange(24) < 12, 0, 86_400.0))
    halves = [
        smooth(replace(track, **{n: v[rows] for n, v in vars(track).items() if isinstance(v, np.ndarray)}))
        for rows in (slice(12), slice(12, 24))
    ]
    apart = np.concatenate([half.joints for half in halves])
    # bone lengths are estimated from all frames
    assert np.abs(smooth(later).joints - apart).max() < 0.06
    minute = replace(track, times=track.times + np.where(np.arange(24) < 12, 0, 60.0))
    np.testing.assert_allclose(smooth(later).joints, smooth(minute).joints, atol=1e-3)


@pytest.mark.parametrize("heading", [0.0, 1.0, 2.5, -2.0])
def test_facing_correction_follows_straight_walk(heading):
    """In any direction, and sidesteps to either side say nothing."""
    turn = np.array([[np.cos(heading), np.sin(heading), 0], [-np.sin(heading), np.cos(heading), 0], [0, 0, 1]])
    times, variance = np.arange(10) / 10, np.full((10, 24), 0.01)
    for step, is_swapped in (([1, 0.2, 0], False), ([-1, 0.2, 0], True), ([1, -0.2, 0], False), ([-1, -0.2, 0], True)):
        joints = (rest_pose(SMPL24) + np.outer(times, step)[:, None]) @ turn
        assert (swapped_frames(times, joints, variance, np.zeros((10, 24)), SMPL24) == is_swapped).all()


def test_smoothing_is_exact_far_from_the_origin(walker):
    """As in map coordinates."""
    _, track = walker(frames=10)
    moved = replace(track, joints=track.joints + [4e5, 5e6, 0])
    for smoothed in (lambda own: smooth(own).poses(), filter_track):
        for here, there in zip(smoothed(track), smoothed(moved), strict=True):
            np.testing.assert_allclose(there.joints - [4e5, 5e6, 0], here.joints, atol=1e-4)
