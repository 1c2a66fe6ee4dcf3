"""Captured poses and clips among the synthesized people."""

from dataclasses import replace

import numpy as np
import pytest
from motion_files import joints_of

from lidarpose.body.mocap.motion import Motion
from lidarpose.body.rig import clothing
from lidarpose.geometry import rotation_about
from lidarpose.skeleton import BODY26, SMPL24
from lidarpose.synth import bodies
from lidarpose.synth.bodies import PoseBank, draw_bodies, draw_moving_bodies
from lidarpose.synth.generator import Generator
from lidarpose.synth.scene import SCENES

SEED = 11
JOINTS = {name: i for i, name in enumerate(BODY26.joints)}


def motion(frames=40, fps=10.0, jump=0.0, turn=0.0, names=("001_01",)):
    """Somebody with the left arm raised ahead who goes to where the first pose's left is at 1 m/s and turns at `turn`
    rad/s; every 0.8 s they jump."""
    rotations = np.tile(np.eye(3, dtype=np.float32), (frames, 24, 1, 1))
    for name, by in (("left_shoulder", ("z", -1.2)), ("right_shoulder", ("x", 1.2)), ("left_elbow", ("z", -0.5))):
        rotations[:, SMPL24.index(name)] = rotation_about(*by)
    way = np.zeros((frames, 3), np.float32)
    time = np.arange(frames) / fps
    rotations[:, 0] = rotation_about("z", turn * time)
    way[:, 1] = time
    way[:, 2] = 0.95 + jump * (np.round(time * 10) % 8 == 4)
    length = np.full(len(names), frames // len(names))
    return Motion(
        rotations=rotations, translation=way, names=names, length=length, fps=fps,
        source="test",
    )  # fmt: skip


def test_captured_people_are_varied_by_their_mirror_image(monkeypatch):
    monkeypatch.setattr(bodies, "_VARIATION", 0.0)
    bank = PoseBank.of_motion(motion())
    both = np.stack([bank.rotations, bank.moved], 1)
    varied, (way,) = bodies._vary(both, np.random.default_rng(0), bank.step[:, None])
    known = joints_of(bank.rotations[:1])[0]
    across = known[list(SMPL24.flip)] * [1, -1, 1]
    assert np.abs(known - across).max() > 0.3
    mirrored = 0
    for k in range(len(varied)):
        for frame in range(2):
            p = joints_of(varied[k, frame][None])[0]
            off = [np.abs(p - there).max() for there in (known, across)]
            assert min(off) < 0.03
        # who is mirrored goes right
        np.testing.assert_allclose(way[k, 0], [0, -0.1 if off[1] < off[0] else 0.1, 0], atol=1e-5)
        mirrored += off[1] < off[0]
    assert 0.2 < mirrored / len(varied) < 0.8


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_poses_are_captured_as_often_as_asked_for(share):
    bank = PoseBank.of_motion(motion())
    drawn = draw_bodies(bank, share, 120, SEED, 0)
    captured = np.array(drawn.kinds) == "captured"
    # the prior's own kind after captured motion has that name too
    prior = np.array(draw_bodies(None, 0.0, 120, SEED, 0).kinds) == "captured"
    # children's steps are shorter
    step = np.array([drawn.moved(row)[1][0] for row in range(120)]) - drawn.joints[:, 0]
    aside = (np.abs(step[:, 0]) < 1e-3) & (np.abs(np.abs(step[:, 1]) - 0.09) < 0.05)
    assert aside.mean() == pytest.approx(share, abs=0.12) and captured[aside].all()
    if share == 0:
        np.testing.assert_array_equal(captured, prior)


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_clips_are_captured_as_often_as_asked_for_and_jumps_leave_the_ground(share):
    # four times as many frames a second as a clip has
    bank = PoseBank.of_motion(motion(frames=160, fps=40.0, jump=0.5))
    for seed in range(3):
        somebody = draw_moving_bodies(bank, share, 1, 9, np.random.default_rng(seed))[0]
        aside = np.abs(np.diff(somebody.joints[:, 0, 1]))
        high = somebody.vertices[..., 2].min(1)
        if share:
            assert somebody.kinds[0] == "captured" and ((aside > 0.04) & (aside < 0.14)).all()
            # one frame in eight, less what a taller body may rise
            assert 1 <= (high > 0.4).sum() <= 2 and np.abs(high[high < 0.4]).max() < 1e-4
        else:
            assert not ((aside > 0.04) & (aside < 0.14)).all()
        # where a frame ends the next one begins
        np.testing.assert_array_equal(somebody.moved(0)[0], somebody.vertices[1])
        np.testing.assert_array_equal(somebody.moved(0)[1], somebody.joints[1])


def test_captured_clips_are_played_faster_and_slower():
    bank = PoseBank.of_motion(motion(frames=60))
    own = bank.clip(9, np.random.default_rng(0))
    np.testing.assert_array_equal(own[0], bank.clip(9, np.random.default_rng(0), tempo=0.0)[0])
    pace = np.linalg.norm(np.diff(own[1][:, :2], axis=0), axis=1).mean()
    speeds = []
    for seed in range(60):
        rotations, place = bank.clip(9, np.random.default_rng(seed), tempo=0.4)
        assert rotations.shape == (9, 24, 3, 3) and place.shape == (9, 3)
        np.testing.assert_allclose(
            rotations @ rotations.swapaxes(-1, -2), np.broadcast_to(np.eye(3), rotations.shape), atol=1e-5
        )
        steps = np.linalg.norm(np.diff(place[:, :2], axis=0), axis=1)
        # somebody who moves evenly still does
        np.testing.assert_allclose(steps, steps.mean(), rtol=1e-3)
        speeds.append(steps.mean() / pace)
    assert np.exp(-0.41) < min(speeds) < 0.75 and 1.3 < max(speeds) < np.exp(0.41)
    # as long as the whole clip: nothing is left to play faster
    whole = bank.clips.length[0]
    assert all(len(bank.clip(whole, np.random.default_rng(seed), tempo=0.4)[0]) == whole for seed in range(8))
    moved = {draw_moving_bodies(bank, 1.0, 1, 8, np.random.default_rng(2), tempo=t)[0].joints[-1, 0, 1] for t in (0, 1)}
    assert len(moved) == 2


@pytest.mark.parametrize("turn", [0.8, -0.8])
def test_a_clip_s_boxes_turn_with_the_person(turn):
    bank = PoseBank.of_motion(motion(turn=turn))
    for seed in range(3):
        somebody = draw_moving_bodies(bank, 1.0, 1, 8, np.random.default_rng(seed))[0]
        across = somebody.joints[:, JOINTS["left_hip"], :2] - somebody.joints[:, JOINTS["right_hip"], :2]
        facing = np.arctan2(-across[:, 0], across[:, 1])
        assert abs(facing[-1] - facing[0]) == pytest.approx(0.7 * abs(turn), abs=0.05)
        np.testing.assert_allclose(somebody.heading, facing, atol=0.15)
        np.testing.assert_allclose(np.array(somebody.heading) - facing, somebody.heading[0] - facing[0], atol=0.03)
        for frame in range(8):
            local = somebody.vertices[frame] @ rotation_about("z", somebody.heading[frame])
            np.testing.assert_allclose(somebody.extent[frame][0], local.min(0), atol=1e-5)
            np.testing.assert_allclose(somebody.extent[frame][1], local.max(0), atol=1e-5)


def test_a_bank_is_of_the_subjects_asked_for(monkeypatch):
    both = motion(frames=40, names=("001_01", "002_01"))
    monkeypatch.setattr(bodies, "load_motion", lambda path: both)
    assert PoseBank.from_clips("x").clips.names == both.names
    one = PoseBank.from_clips("x", ("002",))
    assert one.clips.names == ("002_01",) and len(one.rotations) == 19


def test_people_without_clothes_wear_none(monkeypatch):
    bare, dressed = (Generator(scene=replace(SCENES["paper"], clothes=share))._bodies(SEED, 0) for share in (0.0, 1.0))
    assert np.abs(dressed.vertices - bare.vertices).max() > 0.01
    np.testing.assert_array_equal(bare.joints[..., :2], dressed.joints[..., :2])
    monkeypatch.setattr(bodies, "clothing", lambda rng, count, rig: clothing(rng, count) * 0)
    np.testing.assert_array_equal(Generator(scene=SCENES["paper"])._bodies(SEED, 0).vertices, bare.vertices)
