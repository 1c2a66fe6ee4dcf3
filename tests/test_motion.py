"""The pose prior, retargeting and clips."""

import importlib.util
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from motion_files import joints_of

from lidarpose.body import rig
from lidarpose.body.mocap import motion, retarget
from lidarpose.body.pose_prior import activities, joint_angles, latents, mixture, sampling
from lidarpose.errors import InputError
from lidarpose.geometry import rotation_about
from lidarpose.skeleton import SMPL24

_SPEC = importlib.util.spec_from_file_location("fit_motion", Path(__file__).parents[1] / "tools/fit_motion.py")
fit = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(fit)
J = {name: i for i, name in enumerate(SMPL24.joints)}
MAIN = [J[n] for n in SMPL24.joints if not n.endswith(("foot", "hand"))]


def drawn(n=1500, seed=0, **mix):
    return sampling.sample_rotations(np.random.default_rng(seed), n, mix=mix or None)


def latents_of(n, seed, **mix):
    """The mix's latents, as they are drawn before anything is drawn anew."""
    rng = np.random.default_rng(seed)
    return latents.draw_latents(rng, rng.choice(len(activities.KINDS), n, p=sampling._kind_shares(mix or None)))


def angle_at(joints, a, b, c):
    """Degrees between the bones a -> b and b -> c."""
    u, v = joints[:, J[b]] - joints[:, J[a]], joints[:, J[c]] - joints[:, J[b]]
    cosine = (u * v).sum(-1) / np.linalg.norm(u, axis=-1) / np.linalg.norm(v, axis=-1)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(0, 90))
def test_rotations_are_rotations_without_yaw(seed, n):
    prior = drawn(n, seed)
    assert prior.rotations.shape == (n, 24, 3, 3) and prior.rotations.dtype == np.float32
    assert prior.kind.shape == (n,)
    product = prior.rotations @ np.swapaxes(prior.rotations, -1, -2)
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(prior.rotations), 1, atol=1e-5)
    np.testing.assert_allclose(retarget.heading(prior.rotations), 0, atol=1e-5)


def test_the_same_generator_gives_the_same_poses():
    a, b, c = drawn(50, 7), drawn(50, 7), drawn(50, 8)
    np.testing.assert_array_equal(a.rotations, b.rotations)
    assert np.abs(a.rotations - c.rotations).max() > 0.1


def test_euler_angles_against_the_product_of_three_rotations():
    euler = np.random.default_rng(0).uniform(-3, 3, (40, 3))
    reference = rotation_about("y", euler[:, 0]) @ rotation_about("x", euler[:, 1]) @ rotation_about("z", euler[:, 2])
    np.testing.assert_allclose(joint_angles._from_euler(euler), reference, atol=1e-12)


def test_angles_come_back_from_rotations():
    drawn_angles = sampling._angles(latents_of(1000, 3)).angles
    rotations = joint_angles.rotations_from_angles(drawn_angles)
    again = joint_angles.rotations_from_angles(fit.angles_from_rotations(rotations))
    # where an arm points straight out, raise and inward turn are not told apart, but the pose is the same
    np.testing.assert_allclose(again, rotations, atol=0.02)


def test_hinges_bend_one_way_and_not_too_far():
    prior = drawn(4000, 1)
    for side, sign in (("left", 1), ("right", -1)):
        knee = prior.rotations[:, J[f"{side}_knee"]]
        bend = np.degrees(np.arctan2(knee[:, 0, 2], knee[:, 0, 0]))
        assert bend.min() > -0.1 and bend.max() < 151
        np.testing.assert_allclose(knee[:, 1], np.broadcast_to([0, 1, 0], knee[:, 1].shape), atol=1e-5)
        elbow = prior.rotations[:, J[f"{side}_elbow"]]
        bend = np.degrees(np.arctan2(-sign * elbow[:, 1, 0], elbow[:, 0, 0]))
        assert bend.min() > -0.1 and bend.max() < 151
        thigh = prior.rotations[:, J[f"{side}_hip"]] @ [0, 0, -1.0]
        flexion = np.degrees(np.arctan2(thigh[:, 0], -thigh[:, 2]))[thigh[:, 2] < -0.3]
        assert flexion.min() > -31


def test_knees_point_forward_and_hands_reach_in_front():
    """Signs, seen in space: a bent knee leads its ankle, a bent elbow lifts the hand forward."""
    bent = np.zeros((1, 27))
    name = {n: i for i, n in enumerate(activities.ANGLES)}
    for side in ("left", "right"):
        bent[:, name[f"{side}_knee"]] = bent[:, name[f"{side}_elbow"]] = 80
        bent[:, name[f"{side}_abd"]] = bent[:, name[f"{side}_out"]] = 15
    p = joints_of(joint_angles.rotations_from_angles(bent))[0]
    for side, left in (("left", 1), ("right", -1)):
        assert p[J[f"{side}_ankle"], 0] < p[J[f"{side}_knee"], 0] - 0.2
        assert p[J[f"{side}_wrist"], 0] > p[J[f"{side}_elbow"], 0] + 0.15
        assert left * p[J[f"{side}_knee"], 1] > left * p[J[f"{side}_hip"], 1] + 0.05
        assert left * p[J[f"{side}_elbow"], 1] > left * p[J[f"{side}_shoulder"], 1] + 0.03
    bent[:] = 0
    for positive, joint in (
        ("bend", "neck"),
        ("tilt", "neck"),
        ("left_hip", "left_knee"),
        ("right_raise", "right_wrist"),
    ):
        forward = bent.copy()
        forward[:, name[positive]] = 40
        q, r = (
            joints_of(joint_angles.rotations_from_angles(forward))[0],
            joints_of(joint_angles.rotations_from_angles(bent))[0],
        )
        assert q[J[joint], 0] > r[J[joint], 0] + 0.1, positive


@pytest.mark.parametrize("kind", ["idle", "walk"])
def test_standing_people_stand(kind):
    p = joints_of(drawn(800, 2, **{kind: 1}).rotations)
    pelvis = p[:, J["pelvis"], 2]
    feet = p[:, [J["left_ankle"], J["right_ankle"]], 2]
    assert (p[:, J["head"], 2] > pelvis + 0.4).all()
    assert (feet.min(1) < pelvis - 0.6).all() and (feet < pelvis[:, None] - 0.3).all()
    width = p[:, J["left_ankle"], 1] - p[:, J["right_ankle"], 1]
    assert 0.10 < np.median(width) < 0.35 and (width > -0.15).mean() > 0.99
    for side in ("left", "right"):  # toes point ahead
        assert (p[:, J[f"{side}_foot"], 0] > p[:, J[f"{side}_ankle"], 0] - 0.06).mean() > 0.98
        assert np.median(angle_at(p, f"{side}_hip", f"{side}_knee", f"{side}_ankle")) < 40


def test_standing_people_are_in_balance():
    p = joints_of(drawn(600, 3, idle=1).rotations)
    middle = 0.5 * p[:, J["spine2"]] + 0.2 * p[:, J["neck"]] + 0.3 * p[:, [J["left_hip"], J["right_hip"]]].mean(1)
    feet = p[:, [J[f"{s}_{n}"] for s in ("left", "right") for n in ("ankle", "foot")]].mean(1)
    assert np.median(np.abs(middle - feet)[:, 0]) < 0.12


def test_arms_swing_against_the_legs():
    walkers = latents_of(24, 4, walk=1)
    walkers = replace(walkers, arm=np.full((24, 2), activities.OWN_ARMS), captured=np.zeros((24, 2, 27)))
    for walk in sampling._motion(walkers, np.arange(60) / 40).rotations:
        p = joints_of(walk)
        for side, across in (("left", "right"), ("right", "left")):
            arm = (p[:, J[f"{side}_elbow"]] - p[:, J[f"{side}_shoulder"]])[:, 0]
            for leg, sign in ((side, -1), (across, 1)):
                ankle = (p[:, J[f"{leg}_ankle"]] - p[:, J["pelvis"]])[:, 0]
                assert sign * np.corrcoef(arm, ankle)[0, 1] > 0.6
    p = joints_of(drawn(2000, 5, walk=1).rotations)
    arms = (p[:, J["left_elbow"]] - p[:, J["right_elbow"]])[:, 0]
    legs = (p[:, J["left_ankle"]] - p[:, J["right_ankle"]])[:, 0]
    assert np.corrcoef(arms, legs)[0, 1] < -0.3


def test_a_mirrored_pose_is_the_mirror_image():
    one = sampling._angles(latents_of(200, 6)).angles
    mirrored = joint_angles.mirror_angles(one)
    assert (mirrored >= activities.LIMITS[0]).all() and (mirrored <= activities.LIMITS[1]).all()
    p, q = (joints_of(joint_angles.rotations_from_angles(a)) for a in (one, mirrored))
    np.testing.assert_allclose(q, p[:, SMPL24.flip] * [1, -1, 1], atol=0.02)
    np.testing.assert_allclose(joint_angles.mirror_angles(mirrored), one)


def test_both_sides_are_alike_on_average():
    p = joints_of(drawn(6000, 9).rotations)
    mean = p.mean(0)
    np.testing.assert_allclose(mean, mean[list(SMPL24.flip)] * [1, -1, 1], atol=0.03)


def test_hands_stay_out_of_the_trunk():
    prior = drawn(3000, 10)
    p = joints_of(prior.rotations)
    # the chest's frame is that of spine3
    turned = rig.forward_kinematics(
        SMPL24.parents, retarget.mean_adult_joints()[None], prior.rotations, np.zeros((3000, 3))
    )[0][:, J["spine3"]]
    shoulders = p[:, [J["left_shoulder"], J["right_shoulder"]]].mean(1)
    inside = []
    for side in ("left", "right"):
        hand = np.einsum("nji,nj->ni", turned, p[:, J[f"{side}_wrist"]] - shoulders)
        inside.append((np.abs(hand[:, 0]) < 0.06) & (np.abs(hand[:, 1]) < 0.10) & (hand[:, 2] < -0.05))
    assert np.mean(inside) < 0.01


def test_the_mix_is_obeyed_and_checked():
    assert set(drawn(300, 0, sit=1, walk=3).kind) == {activities.KINDS.index("sit"), activities.KINDS.index("walk")}
    counts = np.bincount(drawn(20000, 0).kind, minlength=len(activities.KINDS)) / 20000
    np.testing.assert_allclose(counts, activities.SHARES, atol=0.015)
    with pytest.raises(InputError, match="did you mean walk"):
        drawn(3, 0, wakl=1)
    with pytest.raises(InputError, match="above 0"):
        drawn(3, 0, walk=0)
    with pytest.raises(InputError, match="n must be a whole number of at least 0"):
        drawn(-1)
    for weight in (np.inf, np.nan, "a"):
        with pytest.raises(InputError, match="the mix's weight of walk must be a finite number"):
            drawn(2, walk=weight)
    np.testing.assert_array_equal(drawn(40, walk=1e308, run=1e308).rotations, drawn(40, walk=1, run=1).rotations)


def test_sample_poses():
    a, b = sampling.sample_poses(40, 3), sampling.sample_poses(40, 3)
    assert a.shape == (40, 24, 3) and a.dtype == np.float32
    np.testing.assert_array_equal(a, b)
    np.testing.assert_allclose(a[:, 0], 0, atol=1e-6)
    assert (np.linalg.norm(a, axis=-1) < 1.6).all()
    for n, seed, message in ((3, -1, "seed must be a whole number"), (2.5, 0, "n must be a whole number")):
        with pytest.raises(InputError, match=message):
            sampling.sample_poses(n, seed)


def test_kneeling_people_have_a_knee_on_the_ground():
    p = joints_of(drawn(300, 14, kneel=1).rotations)
    knee = p[:, [J["left_knee"], J["right_knee"]], 2].min(1)
    # a knee joint is 5 cm above the floor, an ankle joint 8 cm
    assert np.median(np.abs(knee - p[:, [J["left_ankle"], J["right_ankle"]], 2].min(1))) < 0.08


# the mixture after captured motion


def test_features_come_back_as_the_same_pose():
    rotations = joint_angles.rotations_from_angles(sampling._angles(latents_of(500, 2)).angles)
    again = joint_angles.rotations_from_angles(mixture.from_features(fit.to_features(rotations)))
    np.testing.assert_allclose(again, rotations, atol=0.02)


def test_captured_poses_are_people_upright():
    drawn_angles = mixture.captured_angles(np.random.default_rng(0), 500)
    assert drawn_angles.shape == (500, 2, 27) and mixture.captured_angles(np.random.default_rng(0), 0).shape == (
        0,
        2,
        27,
    )
    p = joints_of(drawn(500, 15, captured=1).rotations)
    assert (p[:, J["neck"], 2] > p[:, J["pelvis"], 2]).mean() > 0.95
    assert Path(mixture.__file__).parents[1].joinpath("assets/motion_prior.npz").stat().st_size < 60_000


def test_the_fit_finds_a_known_mixture(tmp_path):
    rng = np.random.default_rng(0)
    far = rng.normal(size=(2, 27)) * 40
    which = rng.random(1500) < 0.3
    features = far[which.astype(int)] + rng.normal(size=(1500, 27)) * 6
    weights, means, covariances = fit.fit_mixture(features, 2, rng)
    order = np.argsort(-weights)
    np.testing.assert_allclose(weights[order], [0.7, 0.3], atol=0.05)
    np.testing.assert_allclose(means[order], far, atol=1.5)
    assert np.linalg.eigvalsh(covariances).min() > fit._RIDGE * 0.9
    fit.save_mixture(tmp_path / "mixture.npz", weights, means, covariances)
    stored = np.load(tmp_path / "mixture.npz")
    assert stored["roots"].shape == (2, 27 * 28 // 2)


# retargeting


@pytest.mark.parametrize("yaw", [0.0, 2.5])
def test_retargeting_own_poses_gives_them_back(yaw):
    rotations = drawn(1500, 11).rotations
    rotations[:, 0] = rotation_about("z", yaw) @ rotations[:, 0]
    p = joints_of(rotations)
    found = retarget.retarget_positions(p + [3.0, -2, 1])
    error = np.linalg.norm(joints_of(found) - p, axis=-1)
    assert error[:, MAIN].mean() < 0.01 and error[:, MAIN].mean(0).max() < 0.02
    assert np.percentile(error[:, MAIN], 99.5) < 0.05
    turn = retarget.heading(found) - retarget.heading(rotations)
    assert np.median(np.abs((turn + np.pi) % (2 * np.pi) - np.pi)) < 0.02
    np.testing.assert_allclose(retarget.heading(retarget.without_yaw(found)), 0, atol=1e-5)


def test_retargeting_another_body_keeps_the_directions_of_its_limbs():
    rotations = drawn(300, 12).rotations
    rest = retarget.mean_adult_joints() * [1.0, 1.2, 0.8] * 0.9
    p = rig.forward_kinematics(SMPL24.parents, rest[None], rotations, np.zeros((300, 3)))[1]
    q = joints_of(retarget.retarget_positions(p))
    for start, end in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist")):
        for side in ("left", "right"):
            a, b = (x[:, J[f"{side}_{end}"]] - x[:, J[f"{side}_{start}"]] for x in (p, q))
            cosine = (a * b).sum(-1) / np.linalg.norm(a, axis=-1) / np.linalg.norm(b, axis=-1)
            np.testing.assert_allclose(cosine, 1, atol=1e-4)


def test_straight_limbs_and_the_rest_pose():
    rest = retarget.mean_adult_joints()
    found = retarget.retarget_positions(rest[None])
    np.testing.assert_allclose(found[0], np.broadcast_to(np.eye(3), (24, 3, 3)), atol=0.04)
    stretched = rest.copy()  # every limb exactly straight, feet along the shanks
    for side in ("left", "right"):
        for chain, step in (
            (("hip", "knee", "ankle", "foot"), (0, 0, -0.3)),
            (("shoulder", "elbow", "wrist", "hand"), (0, 0.25 if side == "left" else -0.25, 0)),
        ):
            for k, name in enumerate(chain[1:], 1):
                stretched[J[f"{side}_{name}"]] = stretched[J[f"{side}_{chain[0]}"]] + k * np.array(step)
    found = retarget.retarget_positions(stretched[None])
    assert np.isfinite(found).all()
    for name in ("left_hip", "right_hip", "left_knee", "right_shoulder", "left_elbow"):
        assert np.trace(found[0, J[name]]) > 2.8, name


def test_retargeting_says_what_is_wrong():
    with pytest.raises(InputError, match=re.escape("(n, 24, 3)")):
        retarget.retarget_positions(np.zeros((24, 3)))
    broken = np.repeat(retarget.mean_adult_joints()[None], 2, 0)
    broken[1, 4, 0] = np.nan
    with pytest.raises(InputError, match="finite"):
        retarget.retarget_positions(broken)
    assert retarget.retarget_positions(np.zeros((0, 24, 3))).shape == (0, 24, 3, 3)


# clips


def stored(tmp_path, **changes):
    joints = np.random.default_rng(0).normal(size=(10, 24, 3)).astype(np.float32)
    content = dict(
        joints=joints, clip=np.array(["002_01", "005_01", "002_02"]), clip_start=np.array([0, 4, 6]),
        clip_length=np.array([4, 2, 4]), fps=np.float64(10), joint_names=np.array(SMPL24.joints),
    )  # fmt: skip
    content |= changes
    path = tmp_path / "clips.npz"
    np.savez(path, **{k: v for k, v in content.items() if v is not None})
    return path, joints


def test_clips_are_read_and_selected(tmp_path):
    path, joints = stored(tmp_path)
    loaded = motion.load_clips(path)
    assert len(loaded) == 3 and loaded.fps == 10 and loaded.names == ("002_01", "005_01", "002_02")
    np.testing.assert_array_equal(loaded.joints[loaded.frames(1)], joints[4:6])
    chosen = loaded.of(["002"])
    assert chosen.names == ("002_01", "002_02")
    np.testing.assert_array_equal(chosen.joints, joints[[0, 1, 2, 3, 6, 7, 8, 9]])
    np.testing.assert_array_equal(chosen.joints[chosen.frames(1)], joints[6:10])
    assert loaded.of("005").names == ("005_01",)
    with pytest.raises(InputError, match="'009': there are 002, 005"):
        loaded.of("009")


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"fps": None}, "fps is missing"),
        ({"joints": np.zeros((10, 23, 3))}, re.escape("(frames, 24, 3)")),
        ({"joints": np.full((10, 24, 3), np.nan)}, "finite"),
        ({"clip_length": np.array([4, 2])}, "clip_length"),
        ({"clip_length": np.array([4, 2, 5])}, "10 frames"),
        ({"clip_start": np.array([0.0, 4, 6])}, "whole number"),
        ({"fps": np.array(0.0)}, "above 0"),
        ({"fps": np.array([1.0, 2.0])}, "one number"),
        ({"joint_names": np.array(SMPL24.joints[::-1])}, "SMPL's order"),
        ({"clip": np.array(["a", None, {}], dtype=object)}, "plain arrays"),
    ],
)
def test_a_wrong_clips_file_is_named(tmp_path, changes, message):
    path, _ = stored(tmp_path, **changes)
    with pytest.raises(InputError, match=message):
        motion.load_clips(path)


@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(at=st.integers(0, 2**20), bit=st.integers(0, 7), keep=st.integers(0, 2**20))
def test_a_damaged_clips_file_is_read_or_told(tmp_path, at, bit, keep):
    path, joints = stored(tmp_path)
    content = {name: value for name, value in np.load(path).items()}
    np.savez_compressed(path, **content)
    data = bytearray(path.read_bytes())
    data[at % len(data)] ^= 1 << bit
    path.write_bytes(data if keep % 2 else data[: keep % len(data)])
    try:
        motion.load_clips(path)
    except InputError as error:
        assert "clips.npz" in str(error)


@pytest.mark.parametrize("kind", [np.uint8, np.int8, np.uint64, np.int32])
def test_cuts_of_any_whole_numbers(tmp_path, kind):
    """200 + 200 is 144 in a byte."""
    joints = np.zeros((240, 24, 3), np.float32)
    start, length = (0, 120), (120, 120)
    path, _ = stored(
        tmp_path, joints=joints, clip=np.array(["a", "b"]), clip_start=np.array(start, kind),
        clip_length=np.array(length, kind),
    )  # fmt: skip
    loaded = motion.load_clips(path)
    assert [len(loaded.joints[loaded.frames(k)]) for k in range(2)] == [120, 120]
    path, _ = stored(
        tmp_path, joints=joints[:100], clip=np.array(["a"]), clip_start=np.array([100], kind),
        clip_length=np.array([120], kind),
    )  # fmt: skip
    with pytest.raises(InputError, match="inside the 100 frames, got up to frame 220"):
        motion.load_clips(path)


def test_not_a_clips_file(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        motion.load_clips(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("hello")
    with pytest.raises(InputError, match="not an npz"):
        motion.load_clips(tmp_path / "text.npz")
    np.save(tmp_path / "one.npy", np.zeros(3))
    with pytest.raises(InputError, match="not an npz"):
        motion.load_clips(tmp_path / "one.npy")
