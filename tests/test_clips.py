"""Motion: cutting, resampling, windows and pairs; the steadiness of retargeting."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_files import joints_of

from lidarpose.body.mocap import motion, retarget
from lidarpose.body.pose_prior import sampling
from lidarpose.errors import InputError
from lidarpose.geometry import axis_angle_to_matrix, rotation_about
from lidarpose.skeleton import SMPL24

J = {name: i for i, name in enumerate(SMPL24.joints)}


def a_motion(lengths=(8, 1, 13), fps=20.0, seed=0):
    """Clips in which every bone turns evenly about an axis of its own and the pelvis goes straight."""
    rng = np.random.default_rng(seed)
    rotations, translation = [], []
    for n in lengths:
        time = np.arange(n)[:, None, None] / fps
        turn = axis_angle_to_matrix(rng.normal(0, 1, (1, 24, 3)) * time)
        rotations.append(axis_angle_to_matrix(rng.normal(0, 0.5, (24, 3))) @ turn)
        translation.append(rng.normal(size=3) + time[:, 0] * rng.normal(size=3))
    return motion.Motion(
        rotations=np.concatenate(rotations).astype(np.float32),
        translation=np.concatenate(translation).astype(np.float32),
        names=tuple(f"{k:03d}_01" for k in range(len(lengths))),
        start=np.cumsum(lengths) - lengths,
        length=np.array(lengths),
        fps=fps,
        source="test",
    )


def test_even_turns_stay_even_at_another_rate():
    """The clips of `a_motion` at 20, 50 and 10 frames a second are the same curves."""
    one = a_motion((9, 21))
    for hz, lengths in ((50.0, (21, 51)), (10.0, (5, 11)), (20.0, (9, 21))):
        found = one.resampled(hz)
        assert found.fps == hz and tuple(found.length) == lengths and found.names == one.names
        back = a_motion((9, 21))
        for c in range(2):
            a, b = found.frames(c), back.frames(c)
            np.testing.assert_allclose(found.rotations[a][0], back.rotations[b][0], atol=1e-6)
            np.testing.assert_allclose(found.rotations[a][-1], back.rotations[b][-1], atol=1e-5)
            np.testing.assert_allclose(found.translation[a][-1], back.translation[b][-1], atol=1e-5)
            steps = np.swapaxes(found.rotations[a][:-1], -1, -2) @ found.rotations[a][1:]
            np.testing.assert_allclose(steps, np.broadcast_to(steps[0], steps.shape), atol=1e-4)
            np.testing.assert_allclose(np.diff(found.translation[a], 2, axis=0), 0, atol=1e-5)


@settings(max_examples=40, deadline=None)
@given(
    lengths=st.lists(st.integers(0, 9), max_size=4),
    fps=st.sampled_from([10.0, 29.97, 120.0]),
    hz=st.floats(1, 200),
    frames=st.integers(1, 6),
    dt=st.integers(0, 50).map(lambda n: n / 100),
)
def test_cuts_stay_inside_their_clips(lengths, fps, hz, frames, dt):
    lengths = np.array(lengths, int)
    empty = motion.Motion(
        rotations=np.zeros((0, 24, 3, 3), np.float32), translation=np.zeros((0, 3), np.float32),
        names=(), start=np.zeros(0, int), length=np.zeros(0, int), fps=fps, source="",
    )  # fmt: skip
    one = a_motion(lengths, fps) if len(lengths) else empty
    found = one.resampled(hz)
    assert len(found.rotations) == found.length.sum() and (found.length >= (lengths > 0)).all()
    assert ((found.length - 1) / hz <= (lengths - 1) / fps + 1e-5)[lengths > 0].all()
    product = found.rotations @ np.swapaxes(found.rotations, -1, -2)
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), atol=1e-5)
    windows = one.windows(frames)
    assert windows.shape == (sum(len(range(n - frames + 1)) for n in lengths if n >= frames), frames)
    clip_of = np.repeat(np.arange(len(lengths)), lengths)
    assert (clip_of[windows] == clip_of[windows][:, :1]).all() and (np.diff(windows, axis=1) == 1).all()
    pairs = one.pairs(dt)
    assert len(pairs[0]) == sum(max(0, n - int(np.ceil(dt * fps - 1e-5))) for n in lengths)
    np.testing.assert_allclose(retarget.heading(pairs[0]), 0, atol=1e-5)


def test_pairs_are_what_happens_next():
    """A person who turns and walks ahead: seen from the first pose, the second is turned and in front."""
    angle = np.linspace(0.5, 2.0, 31)
    rotations = np.broadcast_to(np.eye(3), (31, 24, 3, 3)).copy()
    rotations[:, 0] = rotation_about("z", angle)
    way = np.cumsum(np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1) * 0.05, 0)
    one = motion.Motion(
        rotations=rotations.astype(np.float32), translation=way.astype(np.float32),
        names=("a",), start=np.array([0]), length=np.array([31]), fps=30.0, source="",
    )  # fmt: skip
    poses, moved, step = one.pairs(0.1)
    assert len(poses) == 28 and moved.dtype == step.dtype == np.float32
    np.testing.assert_allclose(retarget.heading(moved), 0.15, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(step, axis=-1), 0.15, atol=1e-3)
    assert (step[:, 0] > 0.14).all() and (step[:, 1] > 0).all()
    np.testing.assert_allclose(one.pairs(0)[1], retarget.without_yaw(one.rotations), atol=1e-6)
    windows = one.windows(16)
    turned, moved = motion.facing_x(one.rotations[windows], one.translation[windows])
    np.testing.assert_allclose(retarget.heading(turned[:, 0]), 0, atol=1e-5)
    np.testing.assert_allclose(moved[:, 0], 0, atol=1e-6)
    np.testing.assert_allclose(retarget.heading(turned[:, -1]), 0.75, atol=1e-5)
    assert (moved[:, -1, 0] > 0.5).all()


def test_a_subject_whose_number_goes_on_is_another_one():
    """CMU's subjects go from 01 to 144: who trains on 10 must not meet 102, who is kept for judging."""
    names = ("1_01", "10_01", "102_03", "walk01", "02/02_01")
    at, each = np.arange(len(names)), np.ones(len(names), int)
    some = motion.Clips(joints=np.zeros((5, 24, 3), np.float32), names=names, start=at, length=each, fps=30.0)
    assert some.of("10").names == ("10_01",) and some.of("1").names == ("1_01",)
    assert some.of(("walk", "02")).names == ("walk01", "02/02_01")
    with pytest.raises(InputError, match="no clip starts with '0'"):
        some.of("0")


def test_clips_are_chosen_and_joined():
    one, two = a_motion((4, 2, 6), 20.0), a_motion((7,), 10.0, seed=1)
    chosen = one.of(("002", "000"))
    assert chosen.names == ("000_01", "002_01") and tuple(chosen.start) == (0, 4)
    np.testing.assert_array_equal(chosen.rotations, np.concatenate([one.rotations[:4], one.rotations[6:]]))
    with pytest.raises(InputError, match="no clip starts with '9': there are 000, 001, 002"):
        one.of("9")
    both = motion.join([one, two], source="both")
    assert both.fps == 10 and tuple(both.length) == (2, 1, 3, 7) and both.source == "both"
    np.testing.assert_array_equal(both.rotations[both.frames(3)], two.rotations)
    np.testing.assert_allclose(both.rotations[both.frames(2)], one.rotations[[6, 8, 10]], atol=1e-6)


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda m: m.resampled(0), "above 0, got 0"),
        (lambda m: m.resampled(np.nan), "above 0"),
        (lambda m: motion.Motion(**{**vars(m), "fps": np.inf}), "frames a second"),
        (lambda m: motion.Motion(**{**vars(m), "translation": m.translation[1:]}), re.escape("(21, 3)")),
        (lambda m: motion.Motion(**{**vars(m), "rotations": m.rotations * np.nan}), "finite"),
    ],
)
def test_what_is_wrong_with_a_motion_is_said(call, message):
    with pytest.raises(InputError, match=message):
        call(a_motion())


# retargeting


def arm(bend, twist):
    """The rest pose with the left upper arm turned about itself by `twist` (n,) and the elbow bent by `bend` (n,)."""
    rotations = np.broadcast_to(np.eye(3), (len(bend), 24, 3, 3)).copy()
    rotations[:, J["left_shoulder"]] = rotation_about("y", twist)
    rotations[:, J["left_elbow"]] = rotation_about("z", -bend)
    return joints_of(rotations)


@pytest.mark.parametrize("twist", [0.0, 1.5, 2.6, 2.9])
def test_an_elbow_that_bends_more_and_more_does_not_flip(twist):
    """The upper arm turns over while the bend grows, in steps, however far it was turned."""
    bend = np.linspace(0.0, 2.9, 300)
    found = retarget.retarget_positions(arm(bend, np.full(300, twist)))[:, J["left_shoulder"]].astype(float)
    steps = np.linalg.norm(retarget.rotation_vector(np.swapaxes(found[:-1], -1, -2) @ found[1:]), axis=-1)
    assert np.degrees(steps.max()) < 20
    # and once the bend is plain, the twist is the arm's
    plain = retarget.rotation_vector(found[120:])
    np.testing.assert_allclose(plain, np.broadcast_to([0, twist, 0], plain.shape), atol=0.05)


def test_a_folded_joint_keeps_its_axis():
    """The sine of a bend near 180 degrees is small, but the joint is not straight."""
    found = retarget.retarget_positions(arm(np.radians([60.0, 172.0]), np.array([1.2, 1.2])))
    np.testing.assert_allclose(found[0, J["left_shoulder"]], found[1, J["left_shoulder"]], atol=0.02)


def test_a_hand_across_the_elbows_axis_does_not_flip():
    """A wrist bent sideways points along the axis of the elbow, where that axis says nothing about the hand."""
    side = np.linspace(1.2, 1.9, 60)
    rotations = np.broadcast_to(np.eye(3), (60, 24, 3, 3)).copy()
    rotations[:, J["left_elbow"]] = rotation_about("z", np.full(60, -1.0))
    # a hair off, so that the hand passes beside the axis and not through it
    rotations[:, J["left_wrist"]] = rotation_about("z", 0.02) @ rotation_about("x", side)
    found = retarget.retarget_positions(joints_of(rotations))[:, J["left_wrist"]].astype(float)
    steps = np.linalg.norm(retarget.rotation_vector(np.swapaxes(found[:-1], -1, -2) @ found[1:]), axis=-1)
    assert np.degrees(steps.max()) < 5


def test_an_overstretched_knee_is_not_a_thigh_turned_round():
    """A knee that is 15 degrees past straight bends by -15 degrees; the thigh keeps its direction."""
    rotations = np.broadcast_to(np.eye(3), (1, 24, 3, 3)).copy()
    for side in ("left", "right"):
        rotations[:, J[f"{side}_knee"]] = rotation_about("y", np.radians(-15))
    found = retarget.retarget_positions(joints_of(rotations))
    for name in ("left_hip", "right_hip"):
        assert np.trace(found[0, J[name]]) > 2.8
    np.testing.assert_allclose(joints_of(found), joints_of(rotations), atol=0.01)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_retargeting_anything_gives_rotations(seed):
    rng = np.random.default_rng(seed)
    joints = rng.normal(0, 10 ** rng.uniform(-2, 2), (4, 24, 3))
    found = retarget.retarget_positions(joints)
    product = found @ np.swapaxes(found, -1, -2)
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), atol=1e-4)
    np.testing.assert_allclose(np.linalg.det(found), 1, atol=1e-4)


def test_a_bone_without_length_is_named():
    joints = joints_of(sampling.sample_rotations(np.random.default_rng(0), 3).rotations)
    joints[1, J["left_knee"]] = joints[1, J["left_hip"]]
    with pytest.raises(InputError, match="left_hip -> left_knee has no length in frame 1"):
        retarget.retarget_positions(joints)
    length, which = retarget.shortest_bone(joints)
    assert which[1] == "left_hip -> left_knee" and length[1] == 0 and (length[[0, 2]] > 0.05).all()
