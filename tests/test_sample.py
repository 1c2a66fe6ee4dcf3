"""Sample, Pose, Box, and the center of a cloud."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from lidarpose.errors import InputError
from lidarpose.geometry import rotation_about
from lidarpose.sample import (
    HIDDEN,
    SEEN,
    UNLABELED,
    Box,
    LabeledSample,
    PersonInfo,
    Pose,
    Sample,
    center_of,
    facing,
    facing_yaw,
)
from lidarpose.skeleton import BODY26, HUMAN15, SMPL24, WAYMO14

quick = settings(max_examples=60, deadline=None)
seeds = st.integers(0, 2**32 - 1)


def contains_slowly(box, points, margin):
    """A point is inside if it lies between all three pairs of opposite faces."""
    cos, sin = np.cos(box.yaw), np.sin(box.yaw)
    axes = zip(([cos, sin, 0], [-sin, cos, 0], [0, 0, 1]), box.size, strict=True)
    return np.all([np.abs(points @ axis - box.center @ axis) <= size / 2 + margin for axis, size in axes], 0)


@quick
@given(seeds, st.floats(-7, 7), st.floats(0, 0.5))
def test_box_contains_matches_reference(seed, yaw, margin):
    rng = np.random.default_rng(seed)
    box = Box(center=rng.normal(0, 3, 3), size=rng.uniform(0.2, 2, 3), yaw=yaw)
    points = box.center + rng.uniform(-1.5, 1.5, (200, 3))
    np.testing.assert_array_equal(box.contains(points, margin), contains_slowly(box, points, margin))
    # further columns, such as intensity, are ignored
    wide = np.column_stack([points, rng.normal(size=(200, 2))])
    np.testing.assert_array_equal(box.contains(wide, margin), box.contains(points, margin))


def test_box_contains_respects_yaw():
    box = Box(center=[0, 0, 0], size=[4, 1, 2], yaw=np.pi / 2)
    assert box.contains(np.array([[0, 1.9, 0], [1.9, 0, 0], [0.4, 0, 0.9]])).tolist() == [True, False, True]
    assert box.contains(np.zeros((0, 3))).shape == (0,)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"center": [0, 0]}, "center must be three finite"),
        ({"center": [0, 0, np.nan]}, "center must be three finite"),
        ({"center": ["a", "b", "c"]}, "center must be three finite"),
        ({"center": None}, "center must be three finite"),
        ({"size": [1, 1, 0]}, "size must be positive"),
        ({"size": [1, -1, 1]}, "size must be positive"),
        ({"size": [[1, 1, 1]]}, "size must be three finite"),
        ({"size": [1, [2, 3], 1]}, "size must be three finite"),
        ({"yaw": np.inf}, "yaw must be a finite"),
        ({"yaw": "north"}, "yaw must be a finite"),
        ({"yaw": None}, "yaw must be a finite"),
        ({"yaw": [0.1]}, "yaw must be a finite"),
        ({"score": -0.1}, "score must be a probability"),
        ({"score": 1.1}, "score must be a probability"),
    ],
)
def test_box_rejects_invalid_values(change, message):
    with pytest.raises(InputError, match=message) as caught:
        Box(**{"center": [0, 0, 0], "size": [1, 1, 2], "yaw": 0.0} | change)
    assert "\n" not in str(caught.value)


def test_box_copies_its_input():
    center = np.zeros(3)
    box = Box(center=center, size=[1, 1, 1])
    center[0] = 5
    np.testing.assert_array_equal(box.center, 0)


def pose(skeleton=BODY26, shape=(), **more):
    joints = np.random.default_rng(0).normal(size=(*shape, len(skeleton), 3))
    return Pose(joints=joints, skeleton=skeleton, **more)


@pytest.mark.parametrize("shape", [(), (2,), (3, 4)])
@pytest.mark.parametrize("other", [SMPL24, HUMAN15, WAYMO14, BODY26], ids=lambda s: s.name)
def test_pose_to_skeleton_maps_joints_by_name(shape, other):
    rng = np.random.default_rng(1)
    confidence, spread = rng.random((2, *shape, 26))
    full = pose(shape=shape, confidence=confidence, spread=spread, frame="sensor")
    part = full.to(other)
    assert part.skeleton is other and part.frame == "sensor"
    assert part.joints.shape == (*shape, len(other), 3)
    for name in other.joints:
        i, j = BODY26.index(name), other.index(name)
        np.testing.assert_array_equal(part.joints[..., j, :], full.joints[..., i, :])
        np.testing.assert_array_equal(part.confidence[..., j], confidence[..., i])
        np.testing.assert_array_equal(part.spread[..., j], spread[..., i])
    assert pose(shape=shape).to(other).confidence is None


def test_pose_and_sample_accept_lists():
    joints = np.arange(78.0).reshape(26, 3)
    made = Pose(joints=joints.tolist(), skeleton=BODY26, confidence=[0.5] * 26, in_range=[True] * 26)
    np.testing.assert_array_equal(made.joints, joints)
    assert made.confidence.shape == (26,) and made.in_range.dtype == bool
    assert Sample(**SAMPLE | {"center": [0, 0, 1]}).center.shape == (3,)


SAMPLE = {"points": np.zeros((4, 3), np.float32), "center": np.zeros(3)}


@pytest.mark.parametrize(
    ("make", "message"),
    [
        *[
            (lambda joints=joints: Pose(joints=joints, skeleton=BODY26), message)
            for joints, message in (
                (np.zeros((24, 3)), r"must be \(\.\.\., 26, 3\), got \(24, 3\)"),
                (np.zeros(3), "must be"),
                *[(bad, "Pose.joints must be an array of numbers") for bad in ("joints", ["a"] * 26, [[1.0], [2, 3]])],
            )
        ],
        (lambda: pose(confidence=np.zeros(25)), "confidence must be"),
        (lambda: pose(shape=(2,), spread=np.zeros(26)), "spread must be"),
        (lambda: pose(in_range=np.ones(26)), "in_range must be true or false"),
        (lambda: pose(SMPL24).to(WAYMO14), "smpl24 has no nose"),
        *[
            (lambda change=change: Sample(**SAMPLE | change), message)
            for change, message in (
                ({"points": np.zeros((4, 3))}, "float32"),
                ({"points": np.zeros((4, 4), np.float32)}, r"\(n, 3\)"),
                ({"points": np.zeros(3, np.float32)}, r"\(n, 3\)"),
                ({"center": np.zeros((1, 3))}, "center"),
                ({"part": np.zeros(3, np.uint8)}, "part must be"),
                ({"ring": np.zeros((4, 1), int)}, "ring must be"),
            )
        ],
    ],
)
def test_pose_and_sample_reject_wrong_shapes(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_sample_may_be_empty_and_is_frozen():
    Sample(points=np.zeros((0, 3), np.float32), center=np.zeros(3), part=np.zeros(0, np.uint8))
    with pytest.raises(AttributeError):
        Sample(**SAMPLE).center = np.ones(3)


@pytest.mark.parametrize(
    "make",
    [lambda: Box(center=[0, 0, 0], size=[1, 1, 2]), lambda: pose(), lambda: Sample(**SAMPLE)],
    ids=["box", "pose", "sample"],
)
def test_array_classes_compare_by_identity(make):
    one, other = make(), make()
    assert one == one and one != other and one in [other, one] and len({one, other}) == 2


def cloud(rng, n=150):
    """Points well inside their 10 cm cells, so that rounding never moves one to the next cell."""
    cells = rng.integers(-15, 15, (n, 3))
    return (cells + rng.uniform(0.1, 0.9, (n, 3))) * 0.1


@quick
@given(seeds)
def test_center_of_ignores_density_and_order_and_translates(seed):
    rng = np.random.default_rng(seed)
    points = cloud(rng)
    center = center_of(points)
    # one part of the body with more points
    np.testing.assert_allclose(center_of(np.concatenate([points, points[:40].repeat(30, 0)])), center, atol=1e-12)
    np.testing.assert_allclose(center_of(rng.permutation(points)), center, atol=1e-12)
    shift = rng.integers(-400, 400, 3) * 0.1
    np.testing.assert_allclose(center_of(points + shift), center + shift, atol=1e-9)


@quick
@given(seeds)
def test_center_of_matches_median_of_cells(seed):
    points = cloud(np.random.default_rng(seed), 60)
    cells = {tuple(int(np.floor(c / 0.1)) for c in point) for point in points}
    expected = [(np.median([cell[k] for cell in cells]) + 0.5) * 0.1 for k in range(3)]
    np.testing.assert_allclose(center_of(points), expected, atol=1e-9)


def test_center_of_is_robust_to_stray_points():
    rng = np.random.default_rng(0)
    points = cloud(rng)
    for far in (10.0, 1e3, 1e6, 1e9):
        strays = np.array([[far, far, far], [-far, far, -far]])
        assert np.abs(center_of(np.concatenate([points, strays])) - center_of(points)).max() <= 0.1 + 1e-9
        # the density of points has no effect
        dense = np.concatenate([points, strays, points[:1].repeat(500, 0)])
        np.testing.assert_allclose(center_of(dense), center_of(np.concatenate([points, strays])), atol=1e-9)


def test_center_of_single_point_is_cell_center():
    np.testing.assert_allclose(center_of(np.array([[0.26, -0.01, 10.04]])), [0.25, -0.05, 10.05])


def test_box_contains_rejects_invalid_points():
    box = Box(center=[0, 0, 0], size=[1, 1, 2])
    assert box.contains(np.zeros((2, 4))).tolist() == [True, True]
    # faces belong to the box
    assert box.contains(np.array([[0.5, 0.5, 1], [-0.5, -0.5, -1], [0, 0, 1.001]])).tolist() == [True, True, False]
    for wrong in (np.zeros(3), np.zeros((4, 2)), np.zeros((2, 3, 3)), "points", [[1, 2, 3], [1, 2]]):
        with pytest.raises(InputError, match=r"^Box.contains: expected points \(n, 3\) m, got shape"):
            box.contains(wrong)


def with_axis(hips, shoulders=(0.0, 0.0, 0.0)):
    """A pose whose left hip and shoulder lie by these vectors, m, from the right ones."""
    joints = np.zeros((len(BODY26), 3))
    for part, right_to_left in (("hip", hips), ("shoulder", shoulders)):
        joints[BODY26.index(f"left_{part}")] = right_to_left
    return Pose(joints=joints, skeleton=BODY26)


@quick
@given(st.floats(-3.1, 3.1), st.floats(-1.2, 1.2))
def test_facing_is_perpendicular_to_left_right_axis(yaw, lean):
    R = rotation_about("z", yaw) @ rotation_about("x", lean)
    pose = with_axis(R @ [0, 0.2, 0], R @ [0, 0.4, 0])
    np.testing.assert_allclose(facing(pose), [np.cos(yaw), np.sin(yaw), 0], atol=1e-9)
    assert facing_yaw(pose) == pytest.approx(yaw)


def test_facing_is_none_for_vertical_or_short_axis():
    # 15 degrees from the vertical, and a very short axis
    for axis in ([0, np.sin(np.radians(15)), np.cos(np.radians(15))], [0, 0.015, 0]):
        assert facing(with_axis(axis)) is None and facing_yaw(with_axis(axis)) == 0
    assert facing(None) is None
    # 20 degrees from the vertical, and the hips of a child
    for axis in ([0, np.sin(np.radians(20)), np.cos(np.radians(20))], [0, 0.05, 0]):
        np.testing.assert_allclose(facing(with_axis(axis)), [1, 0, 0])


@pytest.mark.parametrize(
    ("change", "is_plain"),
    [
        ({}, True),
        ({"upright": False}, False),
        ({"visible": 0.75}, False),
        ({"clutter": 0.1}, False),
        ({"height_seen": 0.8}, False),
        ({"visible": np.nan}, False),
    ],
)
def test_person_info_plain(change, is_plain):
    info = {"upright": True, "visible": 0.9, "clutter": 0.02, "height_seen": 0.9} | change
    assert PersonInfo(**info).plain is is_plain


def labeled(labels, joints, **more):
    pose = Pose(joints=joints, skeleton=HUMAN15)
    return LabeledSample(**SAMPLE | more, pose=pose, joint_labels=np.array(labels, np.uint8))


def test_labeled_sample_requires_nan_exactly_at_unlabeled_joints():
    joints = np.zeros((15, 3))
    joints[3] = np.nan
    labels = [SEEN] * 14 + [HIDDEN]
    labels[3] = UNLABELED
    labeled(labels, joints)
    for wrong in (labels[:3] + [SEEN] + labels[4:], [UNLABELED] + labels[1:]):
        with pytest.raises(InputError, match="a joint must be NaN exactly where its label is UNLABELED"):
            labeled(wrong, joints)


def test_labeled_sample_distance():
    joints, labels = np.zeros((15, 3)), [SEEN] * 15
    assert labeled(labels, joints, center=np.array([3.0, 0.0, 4.0])).distance == 5
    assert np.isnan(labeled(labels, joints, sensor_known=False).distance)
    assert labeled(labels, joints, info=PersonInfo(distance=7.0)).distance == 7
