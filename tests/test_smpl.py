"""SMPL models: the published equations on a synthetic model, coordinate frames, part labels, and invalid files."""

import json
import pickle

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from lidarpose.body.mocap.smpl_poses import load_betas
from lidarpose.body.rig import load_rig, pose_bodies
from lidarpose.body.smpl import load_body
from lidarpose.errors import InputError
from lidarpose.geometry import UP_AXES, axis_angle_to_matrix, rotation_about
from lidarpose.skeleton import BODY26, SMPL24
from lidarpose.synth.bodies import smpl_rig
from lidarpose.synth.shard_job import SynthesisJob

J = BODY26.index
R_LEVEL_SMPL = UP_AXES["y"]
HEAD, LEFT_WRIST, RIGHT_WRIST = (J(name) for name in ("head", "left_wrist", "right_wrist"))
# parents of the joints after SMPL's first 22: 15 per hand in SMPL-H; in SMPL-X jaw and eyes come before them
_HANDS = [LEFT_WRIST, 22, 23, LEFT_WRIST, 25, 26, LEFT_WRIST, 28, 29, LEFT_WRIST, 31, 32, LEFT_WRIST, 34, 35]


def tree(joints: int) -> list[int]:
    if joints == 24:
        return list(SMPL24.parents)
    extra = joints - 52
    left = [p if p == LEFT_WRIST else p + extra for p in _HANDS]
    right = [RIGHT_WRIST if p == LEFT_WRIST else p + 15 for p in left]
    return list(SMPL24.parents[:22]) + [HEAD] * extra + left + right


def synthetic(joints: int = 24, shapes: int = 10, seed: int = 0) -> dict:
    """A model in SMPL's layout and frame: mesh and weights of the shipped body, random shapes."""
    rng, rig = np.random.default_rng(seed), load_rig()
    template = rig.template.astype(float) @ R_LEVEL_SMPL + [0, 0.1, 0]
    count = len(template)
    weights = np.zeros((count, joints))
    weights[:, :22] = rig.dense_weight[:, :22]
    for hand, start in ((22, 22 + (joints == 55) * 3), (23, 23 if joints == 24 else joints - 15)):
        fingers = [start] if joints == 24 else list(range(start, start + 15))
        weights[:, fingers] += rig.dense_weight[:, hand, None] / len(fingers)
    if joints == 55:
        for face in (22, 23, 24):
            weights[:, face] += 0.02 * weights[:, HEAD]
        weights[:, HEAD] *= 0.94
    weights /= weights.sum(1, keepdims=True)
    # joints are means of the vertices that they move, so they lie within the body
    regressor = np.where(weights > 0.2, weights, 0) + 1e-6 * weights
    regressor /= regressor.sum(0)
    parents = np.array(tree(joints), np.int64)
    parents[0] = 2**32 - 1
    return {
        "v_template": template,
        "shapedirs": rng.normal(0, 0.01, (count, 3, shapes)),
        "posedirs": rng.normal(0, 0.002, (count, 3, 9 * (joints - 1))),
        "J_regressor": regressor.T.copy(),
        "weights": weights,
        "kintree_table": np.stack([parents, np.arange(joints)]).astype(np.uint32),
        "f": rig.faces.astype(np.uint32),
        "bs_style": "lbs",
    }


@pytest.fixture(scope="module")
def bodies(tmp_path_factory):
    folder = tmp_path_factory.mktemp("smpl")
    models = {joints: synthetic(joints, shapes) for joints, shapes in ((24, 10), (52, 16), (55, 20))}
    for joints, model in models.items():
        np.savez(folder / f"{joints}.npz", **model)
    return {joints: (load_body(folder / f"{joints}.npz"), model) for joints, model in models.items()}


@pytest.fixture
def body(bodies):
    return bodies[24][0]


def published(model, betas, rotations, translation):
    """Loper et al. 2015, Eqs. 2-10, with dense sums and 4 x 4 matrices, one person."""
    number = len(model["weights"][0])
    parents = [int(p) if p < number else -1 for p in model["kintree_table"][0]]
    shaped = model["v_template"] + np.einsum("vcb,b->vc", model["shapedirs"][..., : len(betas)], betas)
    joints = np.einsum("jv,vc->jc", model["J_regressor"], shaped)
    feature = np.concatenate([(r - np.eye(3)).ravel() for r in rotations[1:]])
    posed = shaped + np.einsum("vcp,p->vc", model["posedirs"], feature)
    world, relative = [], []
    for j, parent in enumerate(parents):
        local, away = np.eye(4), np.eye(4)
        local[:3, :3] = rotations[j]
        local[:3, 3] = joints[j] - (joints[parent] if parent >= 0 else 0)
        away[:3, 3] = -joints[j]
        world.append(local if parent < 0 else world[parent] @ local)
        relative.append(world[j] @ away)
    skin = np.einsum("vj,jab->vab", model["weights"], np.stack(relative))
    homogeneous = np.concatenate([posed, np.ones((len(posed), 1))], 1)
    vertices = np.einsum("vab,vb->va", skin, homogeneous)[:, :3]
    return vertices + translation, np.stack([g[:3, 3] for g in world]) + translation


@settings(max_examples=8, deadline=None)
@given(st.sampled_from([24, 52, 55]), st.integers(0, 10**6), st.integers(0, 10))
def test_smpl_pose_matches_published_equations(bodies, joints, seed, coefficients):
    body, model = bodies[joints]
    rng = np.random.default_rng(seed)
    betas, turns = rng.normal(size=(2, coefficients)), rng.normal(0, 0.7, (2, joints, 3))
    move = rng.normal(0, 3, (2, 3))
    vertices, places = body.pose(betas, turns, move)
    for form in (axis_angle_to_matrix(turns), turns.reshape(2, -1)):
        np.testing.assert_allclose(body.pose(betas, form, move)[0], vertices, atol=1e-12)
    for i in range(2):
        expected = published(model, betas[i], axis_angle_to_matrix(turns[i]), move[i])
        np.testing.assert_allclose(vertices[i], expected[0], atol=1e-6)
        np.testing.assert_allclose(places[i], expected[1], atol=1e-6)


def test_shape_count_excludes_expressions(bodies):
    # half of the coefficients of an old SMPL-X model are expressions of the face
    assert [bodies[j][0].shape_count for j in (24, 52, 55)] == [10, 16, 10]
    assert not bodies[24][0].weights.flags.writeable


def test_24_rotations_pose_larger_smpl_models(bodies):
    """Rotations of the hands turn all fingers at their bases; fingers, jaw and eyes are otherwise at rest."""
    rng = np.random.default_rng(3)
    turns = rng.normal(0, 0.5, (2, 24, 3))
    for joints in (52, 55):
        body, _ = bodies[joints]
        whole = np.zeros((2, joints, 3))
        whole[:, :22] = turns[:, :22]
        for wrist, hand in ((LEFT_WRIST, 22), (RIGHT_WRIST, 23)):
            whole[:, np.flatnonzero(np.array(tree(joints)) == wrist)] = turns[:, hand, None]
        for a, b in zip(body.pose(np.zeros((2, 3)), turns), body.pose(np.zeros((2, 3)), whole), strict=True):
            np.testing.assert_array_equal(a, b)


def test_pose_level_converts_to_level_frame(bodies):
    rng = np.random.default_rng(4)
    turns, move = axis_angle_to_matrix(rng.normal(0, 0.5, (3, 24, 3))), rng.normal(0, 3, (3, 3))
    at_rest, origin = np.broadcast_to(np.eye(3), (3, 24, 3, 3)), np.zeros((3, 3))
    for joints in (24, 55):
        body, _ = bodies[joints]
        betas = rng.normal(size=(3, 10))
        vertices, joints26 = body.pose_level(betas, turns, move)
        assert vertices.dtype == joints26.dtype == np.float32 and joints26.shape == (3, 26, 3)
        np.testing.assert_allclose(joints26[:, 0], move, atol=1e-6)
        own = body.pose(betas, R_LEVEL_SMPL.T @ turns @ R_LEVEL_SMPL)
        level = [(points - own[1][:, :1]) @ R_LEVEL_SMPL.T + move[:, None] for points in own]
        np.testing.assert_allclose(vertices, level[0], atol=1e-5)
        np.testing.assert_allclose(joints26[:, :22], level[1][:, :22], atol=1e-5)
        # nose and head center move rigidly with the head
        still, rest = body.pose_level(betas, at_rest, origin)
        apart = [np.linalg.norm(j[:, J("nose")] - j[:, J("head_center")], axis=-1) for j in (rest, joints26)]
        np.testing.assert_allclose(*apart, atol=1e-5)
        assert (rest[:, J("nose"), 0] > rest[:, J("head_center"), 0] + 0.05).all()
        assert (rest[:, J("left_hand"), 1] > 0.4).all() and (rest[:, J("left_foot"), 2] < -0.6).all()
        _, mean = body.pose_level(np.zeros((1, 0)), at_rest[:1], origin[:1])
        assert abs(mean[0, J("head_center"), 1]) < 0.01
    # facing +x, left at +y, head up
    turn, turns = rotation_about("z", np.pi / 2), at_rest[:1].copy()
    turns[0, 0] = turn
    np.testing.assert_allclose(body.pose_level(betas[:1], turns, origin[:1])[0][0], still[0] @ turn.T, atol=1e-5)


def test_face_part_matches_shipped_body(bodies):
    for body, _ in bodies.values():
        # labels of the shipped body are from weights before rounding and a mesh before decimation
        assert (body.face_part == load_rig().face_part).mean() > 0.94 and body.face_part.dtype == np.uint8


def test_load_body_reads_pickle(tmp_path, body):
    model = synthetic()
    path = tmp_path / "model.pkl"
    path.write_bytes(pickle.dumps(model, 2))
    same = load_body(path)
    for name in ("template", "shapes", "pose_shapes", "weights", "regressor", "parents", "faces", "face_part"):
        np.testing.assert_array_equal(getattr(same, name), getattr(body, name))


WRONG = [
    ({"weights": None}, "not a body model of the SMPL family: weights missing; it has J_regressor"),
    ({"v_template": np.zeros((5, 2))}, r"needs v_template \(V, 3\), .* got \(5, 2\)"),
    ({"v_template": np.full((1206, 3), np.nan)}, "v_template has values that are not finite"),
    ({"weights": np.zeros((5, 24))}, r"weights must be \(\d+, 24\) .* got \(5, 24\)"),
    ({"weights": np.zeros((0, 24))}, r"weights must be"),
    ({"shapedirs": np.zeros((5, 3, 10))}, r"shapedirs must be \(V, 3, S\) .* got \(5, 3, 10\)"),
    ({"posedirs": np.zeros((5, 3, 207))}, r"posedirs must be \(\d+, 3, 207\)"),
    ({"J_regressor": np.zeros((24, 5))}, r"J_regressor must be \(24, \d+\) .* got \(24, 5\)"),
    ({"J_regressor": "a text"}, "J_regressor must be an array of numbers"),
    ({"kintree_table": np.zeros((2, 20))}, r"20 joints"),
    *(
        ({"kintree_table": tree + np.zeros((2, 24))}, "must begin with SMPL's joints")
        for tree in (0, 0.5, [np.arange(24) - 1, np.arange(24)])
    ),
    *(({"f": np.array([[0, 1, bad]])}, "f must be indices of vertices, 0 to") for bad in (10**6, -1)),
    ({"f": np.zeros((0, 3))}, r"f must be \(F, 3\)"),
]


@pytest.mark.parametrize(("change", "line"), WRONG, ids=[f"{next(iter(c))}-{i}" for i, (c, _) in enumerate(WRONG)])
def test_load_body_rejects_invalid_models(tmp_path, change, line):
    model = {key: value for key, value in (synthetic() | change).items() if value is not None}
    np.savez(tmp_path / "m.npz", **model)
    (tmp_path / "m.pkl").write_bytes(pickle.dumps(model))
    for name in ("m.npz", "m.pkl"):
        with pytest.raises(InputError, match=line) as caught:
            load_body(tmp_path / name)
        assert "\n" not in str(caught.value) and name in str(caught.value)


def test_load_body_rejects_invalid_weights_sizes_and_files(tmp_path):
    model = synthetic()
    weights = model["weights"]
    headless = np.where(np.arange(24) == HEAD, 0, weights)
    headless[:, HEAD - 1] += weights[:, HEAD]
    for name, change in {
        "double": {"weights": weights * 2}, "less": {"weights": weights - 0.5}, "zero": {"weights": weights * 0},
        "headless": {"weights": headless}, "centimeters": {"v_template": 100 * model["v_template"]},
        "objects": {"J_regressor": np.array([{}, {}], dtype=object)},
    }.items():  # fmt: skip
        np.savez(tmp_path / f"{name}.npz", **model | change)
    (tmp_path / "broken.npz").write_bytes(b"PK\x03\x04 broken")
    np.save(tmp_path / "array.npy", np.zeros(3))
    (tmp_path / "list.pkl").write_bytes(pickle.dumps([1]))
    for name, message in (
        *((f"{name}.npz", "sum to 1") for name in ("double", "less", "zero")),
        ("headless.npz", "no vertex .* head"), ("centimeters.npz", "expected meters"),
        ("none.npz", "no such file"), ("array.npy", "expected a body model of the SMPL family"),
        *((f"{name}.npz", "plain arrays") for name in ("broken", "objects")),
        ("list.pkl", "a dict of SMPL's arrays, got list"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=message):
            load_body(tmp_path / name)


EYE = np.broadcast_to(np.eye(3), (2, 24, 3, 3))


@pytest.mark.parametrize(
    "betas, rotations, translation, message",
    [
        (np.zeros((2, 11)), EYE, None, r"betas must be finite, \(n, up to 10\)"),
        (np.full((2, 3), np.nan), EYE, None, "betas must be finite"),
        (np.zeros((2, 3)), EYE[:1], None, "rotations must be finite"),
        (np.zeros((2, 3)), np.zeros((2, 21, 3)), None, "rotations must be finite"),
        (np.zeros((2, 3)), np.zeros((2, 24, 4)), None, "rotations must be finite"),
        (np.zeros((2, 3)), "a text", None, "rotations must be an array of numbers"),
        (np.zeros((2, 3)), EYE, np.zeros(3), r"translation must be finite, \(2, 3\)"),
        (np.zeros((2, 3)), EYE, np.full((2, 3), np.nan), "translation must be finite"),
        (np.zeros((2, 3)), EYE, "a text", "translation must be an array of numbers"),
        ("a text", EYE, None, "betas must be an array of numbers"),
        (np.zeros((0, 3)), np.zeros((0, 72)), np.zeros((1, 3)), r"translation must be finite, \(0, 3\)"),
    ],
)
def test_smpl_pose_rejects_invalid_arguments(body, betas, rotations, translation, message):
    with pytest.raises(InputError, match=message):
        body.pose(betas, rotations, translation)
    if isinstance(rotations, np.ndarray) and rotations.ndim == 4:
        with pytest.raises(InputError, match=message):
            body.pose_house(betas, rotations, np.zeros((2, 3)) if translation is None else translation)


# ---- SMPL as the body of synthesis


@pytest.mark.parametrize("betas, message", [([[0.0], [np.nan]], "must be finite"), (np.zeros((0, 10)), "at least one")])
def test_rig_rejects_invalid_betas(body, betas, message):
    with pytest.raises(InputError, match=f"betas .*{message}"):
        body.rig(betas)


@pytest.mark.parametrize("joints", [24, 52])
def test_rig_matches_smpl_without_pose_shapes(tmp_path, joints):
    model = synthetic(joints)
    model["posedirs"] *= 0
    # vertices of the published files have at most four weights
    assert (np.count_nonzero(model["weights"][:, :22], axis=1) <= 4).all()
    np.savez(tmp_path / "body.npz", **model)
    body, rng = load_body(tmp_path / "body.npz"), np.random.default_rng(5)
    betas = rng.normal(size=(3, 10))
    rotations = axis_angle_to_matrix(rng.normal(0, 0.4, (3, 24, 3)))
    place = rng.normal(size=(3, 3))
    rig = body.rig(betas)
    vertices, found = pose_bodies(rig, rig.rest(betas), rotations, place)
    due, expected = body.pose_level(betas, rotations, place)
    np.testing.assert_allclose(vertices, due, atol=2e-5)
    np.testing.assert_allclose(found, expected, atol=2e-5)
    assert set(np.unique(rig.face_part)) == set(range(1, 25)) or joints == 52


def test_synthesis_uses_body_of_user_and_shapes_of_motion(tmp_path):
    np.savez(tmp_path / "body.npz", **synthetic())
    poses = tmp_path / "pose" / "7"
    poses.mkdir(parents=True)
    shapes = np.round(np.random.default_rng(2).normal(size=(2, 10)), 3)
    for k in range(30):
        frame = {"pose": [np.pi / 2, 0, 0] + [0.0] * 69, "trans": [0, 8 + 0.01 * k, 0], "beta": shapes[k % 2].tolist()}
        (poses / f"{k:06d}.json").write_text(json.dumps(frame))
    np.testing.assert_array_equal(load_betas(tmp_path / "pose"), np.unique(shapes, axis=0))
    made, shipped = (
        SynthesisJob(what="people", count=4, scene="paper", motion=str(poses), captured=1.0, body=body).generator()
        for body in (str(tmp_path / "body.npz"), None)
    )
    np.testing.assert_allclose(np.unique(made.rig.coefficients, axis=0), np.unique(shapes, axis=0), atol=1e-6)
    bones = [np.linalg.norm(np.diff(g.person(1, 0).sample.pose.joints[[1, 4]], axis=0)) for g in (made, shipped)]
    due = made.rig.rest(made.rig.coefficients).joints
    lengths = np.linalg.norm(due[:, 1] - due[:, 4], axis=1)
    assert np.abs(lengths - bones[0]).min() < 1e-4 and np.abs(lengths - bones[1]).min() > 1e-4


def test_motion_without_shapes_gives_random_shapes(tmp_path):
    np.savez(tmp_path / "body.npz", **synthetic())
    np.savez(tmp_path / "motion.npz", poses=np.zeros((4, 72)), trans=np.zeros((4, 3)), betas=["a"])
    assert load_betas(tmp_path / "motion.npz").shape == (0, 10)
    rig = smpl_rig(tmp_path / "body.npz", tmp_path / "motion.npz")
    assert rig.coefficients.shape == (256, 10) and 0.7 < rig.coefficients.std() < 1.1
    with pytest.raises(InputError, match="expected a body model of the SMPL family, .npz or .pkl"):
        SynthesisJob(what="people", count=4, body=str(tmp_path / "body.txt")).generator()
