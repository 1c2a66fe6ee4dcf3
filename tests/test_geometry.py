"""Properties of rotations, spherical coordinates, up axes and alignment."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays

from lidarpose.errors import InputError
from lidarpose.geometry import (
    UP_AXES,
    axis_angle_to_matrix,
    distance_to_segments,
    from_spherical,
    inverse_transform,
    is_rotation,
    quaternion_to_matrix,
    rigid_transform,
    rotation_about,
    rotation_between,
    rotation_from_up,
    rows_near,
    similarity_align,
    to_spherical,
    transform_points,
    unit,
    upright_axis,
)

quick = settings(max_examples=60, deadline=None)
coordinate = st.floats(-50, 50, allow_subnormal=False)
vectors = arrays(float, (5, 3), elements=coordinate)
angles = st.floats(-10, 10, allow_subnormal=False)


def assert_rotation(matrix, atol=1e-9):
    identity = np.broadcast_to(np.eye(3), matrix.shape)
    np.testing.assert_allclose(matrix @ np.swapaxes(matrix, -1, -2), identity, atol=atol)
    np.testing.assert_allclose(np.linalg.det(matrix), 1, atol=atol)


@quick
@given(vectors)
def test_axis_angle_to_matrix_rotates_about_axis(vector):
    vector = vector * 0.2
    matrix = axis_angle_to_matrix(vector)
    assert_rotation(matrix)
    np.testing.assert_allclose((matrix @ vector[..., None])[..., 0], vector, atol=1e-8)
    np.testing.assert_allclose(axis_angle_to_matrix(-vector), np.swapaxes(matrix, -1, -2), atol=1e-9)
    angle = np.linalg.norm(vector, axis=-1)
    np.testing.assert_allclose(np.trace(matrix, axis1=-2, axis2=-1), 1 + 2 * np.cos(angle), atol=1e-9)


@quick
@given(st.sampled_from("xyz"), angles, angles)
def test_rotation_about_composes_and_matches_axis_angle(axis, a, b):
    matrix = rotation_about(axis, a)
    assert_rotation(matrix)
    np.testing.assert_allclose(matrix @ rotation_about(axis, b), rotation_about(axis, a + b), atol=1e-9)
    along = np.eye(3)["xyz".index(axis)]
    np.testing.assert_allclose(matrix, axis_angle_to_matrix(along * a), atol=1e-9)


@pytest.mark.parametrize(("axis", "a", "b"), ["zxy", "xyz", "yzx"])
def test_rotation_about_is_right_handed(axis, a, b):
    a, b = (np.eye(3)["xyz".index(name)] for name in (a, b))
    np.testing.assert_allclose(rotation_about(axis, np.pi / 2) @ a, b, atol=1e-12)
    assert rotation_about(axis, np.zeros((2, 4))).shape == (2, 4, 3, 3)


directions = vectors.filter(lambda v: (np.linalg.norm(v, axis=-1) > 1e-3).all())


@quick
@given(directions, directions)
def test_rotation_between_maps_first_to_second_direction(a, b):
    matrix = rotation_between(a, b)
    assert_rotation(matrix)
    np.testing.assert_allclose((matrix @ unit(a)[..., None])[..., 0], unit(b), atol=1e-6)
    # the smallest such rotation: its angle is the angle between the two
    cosine = (np.trace(matrix, axis1=-2, axis2=-1) - 1) / 2
    np.testing.assert_allclose(cosine, (unit(a) * unit(b)).sum(-1), atol=1e-6)


@pytest.mark.parametrize("a", [[1.0, 0, 0], [0, 0, -2.0], [0.6, 0.8, 0], [0.95, 0.1, 0.3]])
def test_rotation_between_opposite_and_equal_directions(a):
    a = np.array(a)
    opposite, same = rotation_between(a, -3 * a), rotation_between(a, 2 * a)
    assert_rotation(opposite)
    np.testing.assert_allclose(opposite @ a, -a, atol=1e-9)
    np.testing.assert_allclose(same, np.eye(3), atol=1e-9)


@quick
@given(vectors)
def test_unit_and_spherical_round_trip(points):
    distance, azimuth, elevation = to_spherical(points)
    np.testing.assert_allclose(np.linalg.norm(unit(points), axis=-1)[distance > 1e-9], 1, atol=1e-12)
    assert (distance >= 0).all() and (np.abs(azimuth) <= np.pi).all() and (np.abs(elevation) <= np.pi / 2).all()
    np.testing.assert_allclose(from_spherical(distance, azimuth, elevation), points, atol=1e-9)


def test_spherical_conventions():
    distance, azimuth, elevation = to_spherical([[0, 2, 0], [0, 0, 3], [1, 0, -1], [-1, 0, 0]])
    np.testing.assert_allclose(distance, [2, 3, np.sqrt(2), 1])
    np.testing.assert_allclose(azimuth, [np.pi / 2, 0, 0, np.pi])
    np.testing.assert_allclose(elevation, [0, np.pi / 2, -np.pi / 4, 0])
    assert from_spherical(2.0, np.zeros((4, 1)), np.zeros((1, 3))).shape == (4, 3, 3)
    np.testing.assert_array_equal(unit(np.zeros(3)), np.zeros(3))


@pytest.mark.parametrize("up", UP_AXES)
def test_rotation_from_up_maps_axis_to_z(up):
    rotation = rotation_from_up(up)
    np.testing.assert_array_equal(rotation @ rotation.T, np.eye(3))
    assert np.linalg.det(rotation) == pytest.approx(1)
    sign = -1 if up[0] == "-" else 1
    np.testing.assert_array_equal(rotation @ np.eye(3)["xyz".index(up[-1])], [0, 0, sign])
    # forward is x of an input with z up or down, else its z
    np.testing.assert_array_equal(rotation @ np.eye(3)["xyz".index("x" if up[-1] == "z" else "z")], [1, 0, 0])


def test_rotation_from_up_known_and_invalid_axes():
    np.testing.assert_array_equal(rotation_from_up("z"), np.eye(3))
    # camera frame: z forward, x right, y down
    np.testing.assert_array_equal(rotation_from_up("-y"), np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]))
    for wrong in ("Z", None, 3, (1, 2), (0, 0, 0), (0, np.nan, 1), "1,2", "a,b,c", ["x", "y", "z"]):
        with pytest.raises(InputError, match="a direction x,y,z, got"):
            rotation_from_up(wrong)


@given(st.lists(st.floats(-1e3, 1e3), min_size=3, max_size=3).filter(lambda v: np.abs(v).max() > 1e-3))
def test_rotation_from_up_is_smallest_for_direction(direction):
    rotation = rotation_from_up(direction)
    up = unit(np.array(direction))
    np.testing.assert_allclose(rotation @ up, [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    assert np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1)) == pytest.approx(np.arccos(up[2]), abs=1e-6)
    np.testing.assert_array_equal(rotation_from_up(",".join(map(repr, direction))), rotation)


# a batch axis of 3 could be mistaken for x, y, z
@pytest.mark.parametrize("batch", [1, 2, 3, 4, 5])
@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), joints=st.sampled_from([3, 4, 14]))
def test_similarity_align_is_least_squares_without_reflection(batch, joints, seed):
    rng = np.random.default_rng(seed)
    rotation = axis_angle_to_matrix(rng.normal(0, 2, (batch, 3)))
    scale, shift = np.exp(rng.normal(0, 0.7, batch)), rng.normal(0, 5, (batch, 1, 3))
    source = rng.normal(size=(batch, joints, 3))

    def moved(points):
        return scale[:, None, None] * points @ np.swapaxes(rotation, -1, -2) + shift

    np.testing.assert_allclose(similarity_align(source, moved(source)), moved(source), atol=1e-6)
    np.testing.assert_allclose(similarity_align(source[0], moved(source)[0]), moved(source)[0], atol=1e-6)
    # for a mirror image, the best fit without constraint is a reflection
    source = rng.normal(size=(batch, 9, 3))
    target = moved(source * [1, -1, 1]) + rng.normal(0, 0.1, source.shape)
    aligned = similarity_align(source, target)
    s, a = source - source.mean(1, keepdims=True), aligned - aligned.mean(1, keepdims=True)
    for k in range(batch):
        linear = np.linalg.lstsq(s[k], a[k], rcond=None)[0]
        assert np.linalg.det(linear) > -1e-12
        gram = linear.T @ linear
        np.testing.assert_allclose(gram, np.eye(3) * gram[0, 0], atol=1e-8)
    best = ((aligned - target) ** 2).sum((1, 2))
    for _ in range(20):
        turn = axis_angle_to_matrix(rng.normal(0, 0.05, (batch, 3)))
        other = a @ np.swapaxes(turn, -1, -2) * (1 + rng.normal(0, 0.02)) + aligned.mean(1, keepdims=True)
        assert (((other - target) ** 2).sum((1, 2)) >= best - 1e-9).all()


def test_similarity_align_keeps_input_and_accepts_equal_points():
    source, target = np.ones((2, 5, 3)), np.random.default_rng(0).normal(size=(2, 5, 3))
    kept = source.copy(), target.copy()
    aligned = similarity_align(source, target)
    assert np.isfinite(aligned).all()
    np.testing.assert_allclose(aligned, np.broadcast_to(target.mean(1, keepdims=True), target.shape), atol=1e-9)
    np.testing.assert_array_equal(source, kept[0])
    np.testing.assert_array_equal(target, kept[1])


@given(st.integers(0, 1000))
def test_rigid_transforms_and_quaternions(seed):
    rng = np.random.default_rng(seed)
    axis_angle, t, points = rng.normal(size=3), rng.normal(size=3) * 100, rng.normal(size=(5, 3))
    R = axis_angle_to_matrix(axis_angle)
    T = rigid_transform(R, t)
    np.testing.assert_allclose(transform_points(T, points), points @ R.T + t)
    np.testing.assert_allclose(inverse_transform(T) @ T, np.eye(4), atol=1e-12)
    half = np.linalg.norm(axis_angle) / 2
    quaternion = np.array([np.cos(half), *(np.sin(half) * unit(axis_angle))])
    np.testing.assert_allclose(quaternion_to_matrix(-7 * quaternion), R, atol=1e-12)


@pytest.mark.parametrize(
    ("factor", "is_one"), [(1.0, True), (1.004, True), (1.02, False), (-1.0, False), (1e300, False)]
)
def test_is_rotation_rejects_scales_and_mirrors(factor, is_one):
    R = axis_angle_to_matrix(np.array([0.3, -1.2, 0.5]))
    assert is_rotation(factor * R) is is_one
    assert not is_rotation(R @ np.diag([1, 1, -1])) and not is_rotation(np.zeros((3, 3)))


@quick
@given(
    points=arrays(float, st.tuples(st.integers(0, 40), st.just(3)), elements=coordinate),
    centers=arrays(float, st.tuples(st.integers(0, 4), st.just(2)), elements=coordinate),
    reach=st.one_of(st.floats(0.1, 20), st.lists(st.floats(0.1, 1e6), min_size=4, max_size=4)),
    scale=st.sampled_from([1.0, 1e5]),
)
def test_rows_near_matches_brute_force(points, centers, reach, scale):
    points, centers, reach = scale * points, scale * centers, np.broadcast_to(reach, 4)[: len(centers)]
    for center, own_reach, rows in zip(centers, reach, rows_near(centers, points, reach), strict=True):
        assert rows.tolist() == np.flatnonzero((np.abs(points[:, :2] - center) < own_reach).all(1)).tolist()


@quick
@given(seed=st.integers(0, 2**32 - 1))
def test_distance_to_segments_matches_brute_force(seed):
    rng = np.random.default_rng(seed)
    points, starts, ends = rng.normal(size=(20, 3)), rng.normal(size=(5, 3)), rng.normal(size=(5, 3))
    # a segment of zero length
    ends[0] = starts[0]
    along = (starts + np.linspace(0, 1, 2001)[:, None, None] * (ends - starts)).reshape(-1, 3)
    brute = np.linalg.norm(points[:, None] - along, axis=-1).min(1)
    distance = distance_to_segments(points, starts, ends)
    assert (distance <= brute + 1e-12).all() and (brute - distance < 2e-3).all()


@pytest.mark.parametrize(("up", "axis"), [("-y", "-y"), ("0.3,0,0.9", "z"), ("0.3,-0.9,0.1", "-y"), ((-2, 1, 0), "-x")])
def test_upright_axis_is_nearest_axis(up, axis):
    assert upright_axis(up) == axis
