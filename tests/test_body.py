"""The bundled body model: mesh, joints, shapes and posing."""

from importlib import resources

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from reference.rig import add_folds_reference, pose_bodies_reference, vertex_normals_reference

from lidarpose.body import rig as body_rig
from lidarpose.body.rig import MAX_CLOTHING, clothing, forward_kinematics, load_rig, pose_bodies, sample_people
from lidarpose.body.rig_kernels import dress_people, fold_clothing, vertex_normals
from lidarpose.errors import InputError
from lidarpose.geometry import axis_angle_to_matrix, rotation_about
from lidarpose.skeleton import BODY26, SMPL24

J = BODY26.index


@pytest.fixture(scope="module")
def rig():
    return load_rig()


@pytest.fixture(scope="module")
def mean_adult(rig):
    return rig.rest(rig.coefficients[rig.age >= 18].mean(0, keepdims=True))


@pytest.fixture(scope="module")
def some(rig):
    return rig.rest(sample_people(np.random.default_rng(1), 6).coefficients)


def volume(rig, vertices):
    a, b, c = np.moveaxis(vertices[:, rig.faces].astype(float), 2, 0)
    return (np.cross(a, b) * c).sum((1, 2)) / 6


def normals_of(rig, vertices):
    normals = np.empty_like(vertices)
    for mesh, out in zip(vertices, normals, strict=True):
        vertex_normals(rig.faces, mesh, out)
    return normals


def random_rotations(seed, n, spread=0.6):
    return axis_angle_to_matrix(np.random.default_rng(seed).normal(0, spread, (n, 24, 3)))


def posed(rig, rest, **flexed):
    """`rest` with named joints rotated: joint=(axis, degrees)."""
    rotations = np.broadcast_to(np.eye(3), (len(rest.vertices), 24, 3, 3)).copy()
    for joint, (axis, degrees) in flexed.items():
        rotations[:, SMPL24.index(joint)] = rotation_about(axis, np.radians(degrees))
    return pose_bodies(rig, rest, rotations, np.zeros((len(rotations), 3)))


def test_body_asset_is_small_and_read_only(rig):
    assert len(resources.files("lidarpose.body").joinpath("assets/body.npz").read_bytes()) <= 400_000
    assert load_rig() is rig
    with pytest.raises(ValueError, match="read-only"):
        rig.template[0] = 0


def test_mesh_is_one_closed_surface_wound_outwards(rig):
    edges = np.concatenate([rig.faces[:, [0, 1]], rig.faces[:, [1, 2]], rig.faces[:, [2, 0]]])
    count = len(rig.template)
    directed = edges[:, 0].astype(np.int64) * count + edges[:, 1]
    reverse = edges[:, 1].astype(np.int64) * count + edges[:, 0]
    assert len(np.unique(directed)) == len(directed), "two faces run along an edge in the same direction"
    assert set(directed.tolist()) == set(reverse.tolist()), "an edge has a face on one side only"
    assert sorted(np.unique(rig.faces)) == list(range(count))
    # the Euler characteristic of one closed surface without handles is 2
    assert count - len(edges) // 2 + len(rig.faces) == 2
    assert 2000 <= len(rig.faces) <= 3000


def test_rig_weights_and_parts_are_consistent(rig):
    np.testing.assert_allclose(rig.weight.sum(1), 1, atol=1e-6)
    assert (np.diff(rig.weight, axis=1) <= 0).all(), "the kernel stops at the first zero"
    np.testing.assert_allclose(rig.dense_weight.sum(1), 1, atol=1e-6)
    assert set(rig.face_part) <= set(range(1, 25))
    np.testing.assert_array_equal(rig.face_part, 1 + rig.dense_weight[rig.faces].sum(1).argmax(1))
    middle = rig.template[rig.faces].mean(1)
    for name in SMPL24.joints:
        here = middle[rig.face_part == 1 + SMPL24.index(name)]
        assert len(here) >= 8, name
        if name.startswith(("left_", "right_")):
            side = 1 if name.startswith("left_") else -1
            assert (side * here[:, 1] > -0.01).all(), name
        nearest = np.linalg.norm(here.mean(0) - rig.joint_template[:24], axis=-1)
        assert nearest[SMPL24.index(name)] < 0.28, name
    assert middle[rig.face_part == 1 + J("head"), 2].min() > middle[rig.face_part == 1 + J("spine2"), 2].max()
    assert middle[rig.face_part == 1 + J("left_hand"), 1].min() > 0.5


def test_mean_adult_joints_match_smpl(mean_adult):
    at = dict(zip(BODY26.joints, mean_adult.joints[0], strict=True))
    apart = lambda a, b: np.linalg.norm(at[a] - at[b])  # noqa: E731
    assert np.abs(at["pelvis"]).max() == 0
    assert np.linalg.norm((at["left_hip"] + at["right_hip"]) / 2) == pytest.approx(0.095, abs=0.01)
    assert apart("left_hip", "right_hip") == pytest.approx(0.15, abs=0.01)
    assert apart("left_shoulder", "right_shoulder") == pytest.approx(0.37, abs=0.01)
    heights = [at[j][2] for j in ("left_foot", "left_ankle", "left_knee", "left_hip", "pelvis", "spine1", "spine2")]
    heights += [at[j][2] for j in ("spine3", "left_collar", "neck", "head", "head_center")]
    assert (np.diff(heights) > 0).all()


def test_rest_pose_is_t_pose_facing_x(rig, mean_adult):
    joints = mean_adult.joints[0]
    for side, sign in (("left", 1), ("right", -1)):
        arm = joints[[J(f"{side}_{j}") for j in ("shoulder", "elbow", "wrist", "hand")]]
        assert np.abs(np.diff(arm[:, [0, 2]], axis=0)).max() < 2e-3
        assert (sign * np.diff(arm[:, 1]) > 0.05).all()
        leg = joints[[J(f"{side}_{j}") for j in ("knee", "ankle")]]
        assert np.abs(np.diff(leg[:, 1])) < 2e-3
        foot = joints[J(f"{side}_foot")] - joints[J(f"{side}_ankle")]
        assert foot[0] > 0.1 and abs(foot[1]) < 2e-3
    assert joints[J("nose"), 0] > joints[J("head_center"), 0] + 0.08
    # palms down: hands are flat, wider along x than thick along z
    hand = mean_adult.vertices[0][rig.dense_weight[:, [J("left_wrist"), J("left_hand")]].sum(1) > 0.9]
    assert np.ptp(hand[:, 0]) > 1.3 * np.ptp(hand[:, 2])


def test_rest_bodies_are_symmetric(rig, some):
    mirrored = some.joints[:, BODY26.flip] * [1, -1, 1]
    assert np.abs(mirrored - some.joints).max() < 0.01
    faces = rig.faces
    for vertices in some.vertices[:3]:
        other = vertices * np.float32([1, -1, 1])
        middle = np.concatenate([vertices, vertices[faces].mean(1)])
        gap = np.linalg.norm(other[:, None] - middle, axis=-1).min(1)
        # distance to the nearest vertex or center of a face: a few cm where faces are large
        assert np.median(gap) < 0.012 and gap.max() < 0.06


def test_shapes_have_flat_soles_and_correct_height_and_volume(rig):
    rest = rig.rest(rig.coefficients)
    assert np.abs(volume(rig, rest.vertices) * 980 / rig.height**2 / rig.bmi - 1).max() < 0.12
    np.testing.assert_allclose(np.ptp(rest.vertices[..., 2], axis=1), rig.height, atol=0.02)
    soles = rest.vertices[..., 2].min(1)
    feet = {s: rig.dense_weight[:, [J(f"{s}_ankle"), J(f"{s}_foot")]].sum(1) > 0.5 for s in ("left", "right")}
    for side in feet.values():
        foot = rest.vertices[:, side]
        assert np.abs(foot[..., 2].min(1) - soles).max() < 0.012
        # heel and ball both touch the ground
        for half in (foot[..., 0] < 0.0, foot[..., 0] > 0.08):
            lowest = np.where(half, foot[..., 2], np.inf).min(1)
            assert (lowest - soles).max() < 0.03


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**31), st.floats(0, 1.5))
def test_body_kernels_equal_references(seed, spread):
    rig = load_rig()
    rng = np.random.default_rng(seed)
    rest = rig.rest(sample_people(rng, 3).coefficients)
    rotations, move = random_rotations(seed, 3, spread), rng.normal(0, 5, (3, 3))
    fast, slow = (f(rig, rest, rotations, move) for f in (pose_bodies, pose_bodies_reference))
    for a, b in zip(fast, slow, strict=True):
        assert a.dtype == b.dtype == np.float32
        np.testing.assert_allclose(a, b, atol=1e-5)
    normals = vertex_normals_reference(rig.faces, fast[0])
    # rounding of float32 in thin triangles: directions agree to a fraction of a degree
    assert ((normals_of(rig, fast[0]) * normals).sum(-1) > 1 - 1e-4).all()
    offset = rng.uniform(0, 0.03, normals.shape[:2]).astype(np.float32)
    clothed, low, high = fast[0].copy(), *np.empty((2, 3, 3), np.float32)
    dress_people(rig.faces, clothed, offset, low, high)
    np.testing.assert_allclose(clothed, fast[0] + offset[..., None] * normals, atol=1e-3)
    np.testing.assert_array_equal([low, high], [clothed.min(1), clothed.max(1)])
    direction, phase = rng.normal(0, 3, (3, 4, 3)).astype(np.float32), rng.random((3, 4)).astype(np.float32)
    folded = add_folds_reference(rig.template, direction, phase, offset)
    fold_clothing(rig.template, direction, phase, body_rig.FOLD_GAIN, offset)
    np.testing.assert_allclose(offset, folded, atol=1e-6)


def test_pose_bodies_is_rigid_and_follows_forward_kinematics(rig, some):
    for posed_body, rest in zip(posed(rig, some), (some.vertices, some.joints), strict=True):
        np.testing.assert_allclose(posed_body, rest, atol=1e-6)
    rotations, move = random_rotations(5, 6, 1.0), np.random.default_rng(5).normal(0, 3, (6, 3))
    turn = rotation_about("z", 1.1) @ rotation_about("x", 0.4)
    turned = rotations.copy()
    turned[:, 0] = turn @ rotations[:, 0]
    before, after = pose_bodies(rig, some, rotations, np.zeros((6, 3))), pose_bodies(rig, some, turned, move)
    for a, b in zip(before, after, strict=True):
        np.testing.assert_allclose(a @ turn.T + move[:, None], b, atol=1e-5)
    expected = forward_kinematics(SMPL24.parents, some.joints[:, :24], turned, move)[1]
    np.testing.assert_allclose(after[1][:, :24], expected, atol=1e-5)
    a, b = np.array(BODY26.bones).T
    length = [np.linalg.norm(j[:, a] - j[:, b], axis=-1) for j in (after[1], some.joints)]
    np.testing.assert_allclose(*length, atol=1e-5)


def test_pose_bodies_rejects_other_shapes(rig):
    rest, eye = rig.rest(np.zeros((1, rig.coefficients.shape[1]))), np.broadcast_to(np.eye(3), (2, 24, 3, 3))
    for rotations, translation in ((eye, np.zeros((2, 3))), (eye[:1], np.zeros(3)), (eye[:1, :23], np.zeros((1, 3)))):
        with pytest.raises(InputError, match=r"1 bodies need rotations \(1, 24, 3, 3\) and translation \(1, 3\)"):
            pose_bodies(rig, rest, rotations, translation)


def test_pose_bodies_bends_joints_in_expected_directions(rig, mean_adult):
    rest = mean_adult.joints[0]
    _, (sitting,) = posed(rig, mean_adult, left_hip=("y", -90), left_knee=("y", 90))
    assert sitting[J("left_knee"), 0] > rest[J("left_hip"), 0] + 0.3
    assert sitting[J("left_ankle"), 2] < sitting[J("left_knee"), 2] - 0.3
    _, (hanging,) = posed(rig, mean_adult, left_shoulder=("x", -80), right_shoulder=("x", 80))
    assert hanging[J("left_wrist"), 2] < 0.1 and hanging[J("right_wrist"), 2] < 0.1
    _, (bent,) = posed(rig, mean_adult, left_elbow=("z", -90), right_elbow=("z", 90))
    assert bent[J("left_wrist"), 0] > 0.2 and bent[J("right_wrist"), 0] > 0.2


@pytest.mark.parametrize("flexed", [dict(left_hip=("y", -90), left_knee=("y", 90)), dict(left_shoulder=("x", -80))])
def test_pose_bodies_keeps_most_of_volume(rig, some, flexed):
    vertices, _ = posed(rig, some, **flexed)
    assert (np.abs(volume(rig, vertices) / volume(rig, some.vertices) - 1) < 0.06).all()


def test_vertex_normals_point_outward(rig, some):
    normals = normals_of(rig, some.vertices)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-5)
    assert (volume(rig, some.vertices + 0.005 * normals) > 1.05 * volume(rig, some.vertices)).all()


def test_sample_people_matches_population_statistics(rig):
    people, again = (sample_people(np.random.default_rng(3), 4000) for _ in range(2))
    adult = people.age >= 18
    assert 0.09 < 1 - adult.mean() < 0.15
    for sex, height in (("male", 1.74), ("female", 1.615)):
        here = adult & (people.sex == sex)
        assert 0.40 < here.mean() < 0.48
        assert people.height[here].mean() == pytest.approx(height, abs=0.02)
        low, middle, high = np.percentile(people.bmi[here], [5, 50, 95])
        assert 17 < low < 20 and 23 < middle < 26 and 29 < high < 36
    assert 0.9 < people.height.min() and people.height.max() < 2.1
    assert len(np.unique(people.coefficients, axis=0)) == 4000
    np.testing.assert_array_equal(people.coefficients, again.coefficients)
    probability, neighbors = body_rig._sampling_table()
    assert (rig.sex[neighbors] == rig.sex[:, None]).all() and probability.sum() == pytest.approx(1)
    rest = rig.rest(people.coefficients[:200])
    np.testing.assert_allclose(np.ptp(rest.vertices[..., 2], axis=1), people.height[:200], atol=0.02)


def test_clothing_thickness_is_plausible_and_smooth(rig):
    worn = clothing(np.random.default_rng(4), 400)
    np.testing.assert_array_equal(worn, clothing(np.random.default_rng(4), 400))
    assert worn.shape == (400, len(rig.template)) and worn.dtype == np.float32
    assert worn.min() >= 0 and worn.max() <= MAX_CLOTHING
    dense = rig.dense_weight
    torso = dense[:, [J(j) for j in ("pelvis", "spine1", "spine2", "spine3")]].sum(1) > 0.9
    means = worn[:, torso].mean(1)
    assert 0.012 < means.mean() < 0.02
    assert (means < 0.006).mean() > 0.03 and (means > 0.024).mean() > 0.05
    hands = dense[:, [J("left_hand"), J("right_hand")]].sum(1) > 0.9
    face = (dense[:, J("head")] > 0.9) & (rig.template[:, 0] > rig.joint_template[J("head_center"), 0] + 0.07)
    assert worn[:, hands].mean() < 0.001 and worn[:, face].mean() < 0.004
    # along an edge the thickness changes by far less than its value
    step = np.abs(worn[:, rig.faces[:, 0]] - worn[:, rig.faces[:, 1]])
    assert np.median(step) < 0.002
    # folds are wider than 15 cm: within a quarter of the shortest wave the thickness changes little, without spikes
    trunk = np.flatnonzero(dense[:, [J(j) for j in ("spine1", "spine2", "spine3")]].sum(1) > 0.9)
    apart = np.linalg.norm(rig.template[trunk, None] - rig.template[None, trunk], axis=-1)
    a, b = np.nonzero((apart > 0) & (apart < 0.025))
    assert np.abs(worn[:, trunk[a]] - worn[:, trunk[b]]).mean() < 0.15 * worn[:, trunk].mean()
