"""Captured motion: clips files, cutting, resampling, windows and pairs; retargeting of joint positions."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from motion_files import MAIN, J, check_rotations, joints_of

from lidarpose.body.mocap import motion, retarget
from lidarpose.body.pose_prior import sampling
from lidarpose.body.rig import forward_kinematics, heading, mean_adult_joints, without_yaw
from lidarpose.errors import InputError
from lidarpose.geometry import axis_angle_to_matrix, rotation_about, rotation_vector
from lidarpose.skeleton import SMPL24


def a_motion(lengths=(8, 1, 13), fps=20.0, seed=0):
    """Clips in which each bone rotates at a constant rate about its own axis and the pelvis moves straight."""
    rng = np.random.default_rng(seed)
    rotations, translation = [np.zeros((0, 24, 3, 3))], [np.zeros((0, 3))]
    for n in lengths:
        time = np.arange(n)[:, None, None] / fps
        turn = axis_angle_to_matrix(rng.normal(0, 1, (1, 24, 3)) * time)
        rotations.append(axis_angle_to_matrix(rng.normal(0, 0.5, (24, 3))) @ turn)
        translation.append(rng.normal(size=3) + time[:, 0] * rng.normal(size=3))
    rotations, translation = (np.concatenate(rows).astype(np.float32) for rows in (rotations, translation))
    names = tuple(f"{k:03d}_01" for k in range(len(lengths)))
    shared = dict(names=names, length=np.array(lengths, int), fps=fps, source="test")
    return motion.Motion(rotations=rotations, translation=translation, **shared)


def still(n=1, **turns):
    """The rest pose n times, with named joints rotated."""
    rotations = np.broadcast_to(np.eye(3), (n, 24, 3, 3)).copy()
    for joint, turn in turns.items():
        rotations[:, J[joint]] = turn
    return rotations


def stored(tmp_path, **changes):
    joints = np.random.default_rng(0).normal(size=(10, 24, 3)).astype(np.float32)
    content = dict(
        joints=joints, clip=np.array(["002_01", "005_01", "002_02"]), clip_start=np.array([0, 4, 6]),
        clip_length=np.array([4, 2, 4]), fps=np.float64(10), joint_names=np.array(SMPL24.joints),
    ) | changes  # fmt: skip
    np.savez_compressed(tmp_path / "clips.npz", **{k: v for k, v in content.items() if v is not None})
    return tmp_path / "clips.npz", joints


# clips files


def test_load_clips_reads_clips(tmp_path):
    path, joints = stored(tmp_path)
    read_joints, names, length, fps = motion.load_clips(path)
    np.testing.assert_array_equal(read_joints, joints)
    assert names == ("002_01", "005_01", "002_02") and tuple(length) == (4, 2, 4) and fps == 10
    # clips may be in any order and share frames
    apart = motion.load_clips(stored(tmp_path, clip_start=np.array([5, 1, 5]))[0])[0]
    np.testing.assert_array_equal(apart, joints[[5, 6, 7, 8, 1, 2, 5, 6, 7, 8]])


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"fps": None}, "fps is missing"),
        ({"joints": np.zeros((10, 23, 3))}, re.escape("(frames, 24, 3)")),
        ({"joints": np.full((10, 24, 3), np.nan)}, "finite"),
        ({"joints": np.full((10, 24, 3), "x")}, "joints must be numbers"),
        ({"clip_length": np.array([4, 2])}, "clip_length"),
        ({"clip_length": np.array([4, 2, 5])}, "inside the 10 frames, got up to frame 11"),
        ({"clip_start": np.array([-1, 4, 6])}, "inside the 10 frames"),
        ({"clip_start": np.array([0.0, 4, 6])}, "whole number"),
        ({"fps": np.array(0.0)}, "above 0"),
        ({"fps": np.array([1.0, 2.0])}, "one number"),
        ({"joint_names": np.array(SMPL24.joints[::-1])}, "SMPL's order"),
        ({"clip": np.array(["a", None, {}], dtype=object)}, "plain arrays"),
    ],
)
def test_load_clips_rejects_invalid_files(tmp_path, changes, message):
    path, _ = stored(tmp_path, **changes)
    with pytest.raises(InputError, match=f"clips.npz: .*{message}"):
        motion.load_clips(path)


@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(at=st.integers(0, 2**20), bit=st.integers(0, 7), keep=st.integers(0, 2**20))
def test_load_clips_of_damaged_files_raises_only_input_error(tmp_path, at, bit, keep):
    path, _ = stored(tmp_path)
    data = bytearray(path.read_bytes())
    data[at % len(data)] ^= 1 << bit
    path.write_bytes(data if keep % 2 else data[: keep % len(data)])
    try:
        motion.load_clips(path)
    except InputError as error:
        assert "clips.npz" in str(error)


@pytest.mark.parametrize("kind", [np.uint8, np.int8, np.uint64, np.int32])
def test_load_clips_accepts_any_integer_dtype(tmp_path, kind):
    """In int8, 120 + 120 overflows to -16."""
    clips = dict(clip=np.array(["a", "b"]), clip_start=np.array([0, 120], kind), clip_length=np.array([120] * 2, kind))
    joints = np.random.default_rng(0).normal(size=(240, 24, 3)).astype(np.float32)
    read_joints, _, length, _ = motion.load_clips(stored(tmp_path, joints=joints, **clips)[0])
    np.testing.assert_array_equal(read_joints, joints)
    assert length.tolist() == [120, 120]
    with pytest.raises(InputError, match="inside the 200 frames, got up to frame 240"):
        motion.load_clips(stored(tmp_path, joints=np.zeros((200, 24, 3), np.float32), **clips)[0])


# motion


def test_resampled_keeps_constant_rotation_rates():
    """The clips of `a_motion` are the same curves at 20, 50 and 10 frames per second."""
    even = a_motion((9, 21))
    for hz, lengths in ((50.0, (21, 51)), (10.0, (5, 11)), (20.0, (9, 21))):
        other = even.resampled(hz)
        assert other.fps == hz and tuple(other.length) == lengths and other.names == even.names
        for c in range(2):
            a, b = other.frames(c), even.frames(c)
            for end in (0, -1):
                np.testing.assert_allclose(other.rotations[a][end], even.rotations[b][end], atol=1e-5)
                np.testing.assert_allclose(other.translation[a][end], even.translation[b][end], atol=1e-5)
            steps = np.swapaxes(other.rotations[a][:-1], -1, -2) @ other.rotations[a][1:]
            np.testing.assert_allclose(steps, np.broadcast_to(steps[0], steps.shape), atol=1e-4)
            np.testing.assert_allclose(np.diff(other.translation[a], 2, axis=0), 0, atol=1e-5)


@settings(max_examples=40, deadline=None)
@given(
    lengths=st.lists(st.integers(0, 9), max_size=4),
    fps=st.sampled_from([10.0, 29.97, 120.0]),
    hz=st.floats(1, 200),
    frames=st.integers(1, 6),
    dt=st.integers(0, 50).map(lambda n: n / 100),
)
def test_resampled_windows_and_pairs_stay_inside_clips(lengths, fps, hz, frames, dt):
    drawn = a_motion(lengths, fps)
    lengths, other = drawn.length, drawn.resampled(hz)
    assert len(other.rotations) == other.length.sum() and (other.length >= (lengths > 0)).all()
    assert ((other.length - 1) / hz <= (lengths - 1) / fps + 1e-5)[lengths > 0].all()
    check_rotations(other.rotations)
    windows = drawn.windows(frames)
    assert windows.shape == (sum(max(0, n - frames + 1) for n in lengths), frames)
    clip_of = np.repeat(np.arange(len(lengths)), lengths)
    assert (clip_of[windows] == clip_of[windows][:, :1]).all() and (np.diff(windows, axis=1) == 1).all()
    poses = drawn.pairs(dt)[0]
    assert len(poses) == sum(max(0, n - int(np.ceil(dt * fps - 1e-5))) for n in lengths)
    np.testing.assert_allclose(heading(poses), 0, atol=1e-5)


def test_pairs_give_pose_and_step_after_interval():
    """A person turns and walks forward: relative to the first pose, the second is rotated and in front."""
    angle = np.linspace(0.5, 2.0, 31)
    way = np.cumsum(np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1) * 0.05, 0).astype(np.float32)
    rotations = still(31, pelvis=rotation_about("z", angle)).astype(np.float32)
    shared = dict(names=("a",), length=np.array([31]), fps=30.0, source="")
    walk = motion.Motion(rotations=rotations, translation=way, **shared)
    poses, moved, step = walk.pairs(0.1)
    assert len(poses) == 28 and moved.dtype == step.dtype == np.float32
    np.testing.assert_allclose(heading(moved), 0.15, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(step, axis=-1), 0.15, atol=1e-3)
    assert (step[:, 0] > 0.14).all() and (step[:, 1] > 0).all()
    np.testing.assert_allclose(walk.pairs(0)[1], without_yaw(walk.rotations), atol=1e-6)
    windows = walk.windows(16)
    turned, moved = motion.facing_x(walk.rotations[windows], walk.translation[windows])
    np.testing.assert_allclose(heading(turned[:, 0]), 0, atol=1e-5)
    np.testing.assert_allclose(moved[:, 0], 0, atol=1e-6)
    np.testing.assert_allclose(heading(turned[:, -1]), 0.75, atol=1e-5)
    assert (moved[:, -1, 0] > 0.5).all()


def test_motion_of_matches_whole_subject_names():
    """CMU has subjects 01 to 144: training on 10 must not include 102, which is kept for evaluation."""
    names = ("1_01", "10_01", "102_03", "walk01", "02/02_01")
    clips = replace(a_motion([1] * 5), names=names)
    assert clips.of("10").names == ("10_01",) and clips.of("1").names == ("1_01",)
    assert clips.of(("walk", "02")).names == ("walk01", "02/02_01")
    with pytest.raises(InputError, match="no clip starts with '0': there are 02/02, 1, 10, 102, walk01"):
        clips.of("0")


def test_motion_of_selects_clips_and_join_concatenates():
    a, b = a_motion((4, 2, 6), 20.0), a_motion((7,), 10.0, seed=1)
    chosen = a.of(("002", "000"))
    assert len(chosen) == 2 and chosen.names == ("000_01", "002_01") and tuple(chosen.start) == (0, 4)
    assert a.of("001").names == ("001_01",)
    np.testing.assert_array_equal(chosen.rotations, np.concatenate([a.rotations[:4], a.rotations[6:]]))
    both = motion.join([a, b], source="both")
    assert both.fps == 10 and tuple(both.length) == (2, 1, 3, 7) and both.source == "both"
    np.testing.assert_array_equal(both.rotations[both.frames(3)], b.rotations)
    np.testing.assert_allclose(both.rotations[both.frames(2)], a.rotations[[6, 8, 10]], atol=1e-6)


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda m: m.resampled(0), "above 0, got 0"),
        (lambda m: m.resampled(np.nan), "above 0"),
        (lambda m: motion.Motion(**{**vars(m), "fps": np.inf}), "frames per second"),
        (lambda m: motion.Motion(**{**vars(m), "translation": m.translation[1:]}), re.escape("(21, 3)")),
        (lambda m: motion.Motion(**{**vars(m), "rotations": m.rotations * np.nan}), "finite"),
    ],
)
def test_motion_rejects_invalid_values(call, message):
    with pytest.raises(InputError, match=message):
        call(a_motion())


# retargeting


@pytest.mark.parametrize("yaw", [0.0, 2.5])
def test_retarget_positions_recovers_own_poses(yaw):
    rotations = sampling.sample_rotations(np.random.default_rng(11), 1500).rotations
    rotations[:, 0] = rotation_about("z", yaw) @ rotations[:, 0]
    joints = joints_of(rotations)
    back = retarget.retarget_positions(joints + [3.0, -2, 1])
    error = np.linalg.norm(joints_of(back) - joints, axis=-1)[:, MAIN]
    assert error.mean() < 0.01 and error.mean(0).max() < 0.02 and np.percentile(error, 99.5) < 0.05
    turn = heading(back) - heading(rotations)
    assert np.median(np.abs((turn + np.pi) % (2 * np.pi) - np.pi)) < 0.02
    np.testing.assert_allclose(heading(without_yaw(back)), 0, atol=1e-5)


def test_retarget_positions_keeps_limb_directions_of_other_body():
    rotations = sampling.sample_rotations(np.random.default_rng(12), 300).rotations
    rest = mean_adult_joints() * [1.0, 1.2, 0.8] * 0.9
    p = forward_kinematics(SMPL24.parents, rest[None], rotations, np.zeros((300, 3)))[1]
    q = joints_of(retarget.retarget_positions(p))
    for start, end in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist")):
        for side in ("left", "right"):
            a, b = (x[:, J[f"{side}_{end}"]] - x[:, J[f"{side}_{start}"]] for x in (p, q))
            cosine = (a * b).sum(-1) / np.linalg.norm(a, axis=-1) / np.linalg.norm(b, axis=-1)
            np.testing.assert_allclose(cosine, 1, atol=1e-4)


def test_retarget_positions_of_rest_pose_and_straight_limbs():
    straight = mean_adult_joints().copy()
    np.testing.assert_allclose(retarget.retarget_positions(straight[None]), still(), atol=0.04)
    for side, sign in (("left", 1), ("right", -1)):  # every limb exactly straight, feet along the shanks
        limbs = ("hip knee ankle foot", (0, 0, -0.3)), ("shoulder elbow wrist hand", (0, 0.25 * sign, 0))
        for chain, step in limbs:
            first, *others = (J[f"{side}_{name}"] for name in chain.split())
            straight[others] = straight[first] + np.arange(1, 4)[:, None] * np.array(step)
    rotations = retarget.retarget_positions(straight[None])
    assert np.isfinite(rotations).all()
    for name in ("left_hip", "right_hip", "left_knee", "right_shoulder", "left_elbow"):
        assert np.trace(rotations[0, J[name]]) > 2.8, name


def test_retarget_positions_of_overextended_knee():
    """A knee that is 15 degrees past straight bends by -15 degrees, and the thigh is not rotated by half a turn."""
    over = rotation_about("y", np.radians(-15))
    joints = joints_of(still(left_knee=over, right_knee=over))
    back = retarget.retarget_positions(joints)
    assert all(np.trace(back[0, J[name]]) > 2.8 for name in ("left_hip", "right_hip"))
    np.testing.assert_allclose(joints_of(back), joints, atol=0.01)


def arm(bend, twist):
    """Joints of the rest pose, the left upper arm rotated about its axis by `twist`, the elbow bent by `bend` (n,)."""
    turns = dict(left_shoulder=rotation_about("y", twist), left_elbow=rotation_about("z", -bend))
    return joints_of(still(len(bend), **turns))


def steps_of(rotations):
    """Degrees between the rotations of consecutive frames."""
    rotations = rotations.astype(float)
    turn = rotation_vector(np.swapaxes(rotations[:-1], -1, -2) @ rotations[1:])
    return np.degrees(np.linalg.norm(turn, axis=-1))


@pytest.mark.parametrize("twist", [0.0, 1.5, 2.6, 2.9])
def test_retarget_positions_is_smooth_while_elbow_bends(twist):
    """The upper arm rotates in small steps while the bend grows, for any initial twist."""
    upper = retarget.retarget_positions(arm(np.linspace(0.0, 2.9, 300), twist))[:, J["left_shoulder"]]
    assert steps_of(upper).max() < 20
    # with a clear bend, the twist is that of the arm
    plain = rotation_vector(upper[120:])
    np.testing.assert_allclose(plain, np.broadcast_to([0, twist, 0], plain.shape), atol=0.05)


def test_retarget_positions_of_folded_elbow_and_sideways_wrist():
    # the sine of a bend near 180 degrees is small, but the joint is not straight
    back = retarget.retarget_positions(arm(np.radians([60.0, 172.0]), 1.2))[:, J["left_shoulder"]]
    np.testing.assert_allclose(back[0], back[1], atol=0.02)
    # a wrist bent sideways points along the axis of the elbow, which then does not determine the hand; slightly off,
    # so that the hand passes beside the axis and not through it
    across = rotation_about("z", 0.02) @ rotation_about("x", np.linspace(1.2, 1.9, 60))
    joints = joints_of(still(60, left_elbow=rotation_about("z", -1.0), left_wrist=across))
    assert steps_of(retarget.retarget_positions(joints)[:, J["left_wrist"]]).max() < 5


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_retarget_positions_of_random_joints_gives_rotations(seed):
    rng = np.random.default_rng(seed)
    check_rotations(retarget.retarget_positions(rng.normal(0, 10 ** rng.uniform(-2, 2), (4, 24, 3))), atol=1e-4)
