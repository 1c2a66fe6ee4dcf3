"""Synthesized bodies from captured poses and clips."""

from dataclasses import replace

import numpy as np
import pytest
from motion_files import joints_of

from lidarpose.body.mocap.motion import Motion
from lidarpose.body.pose_prior.clearance import cleared
from lidarpose.body.rig import clothing, load_rig, mean_adult_joints
from lidarpose.errors import InputError
from lidarpose.geometry import rotation_about
from lidarpose.skeleton import BODY26, SMPL24
from lidarpose.synth import bodies
from lidarpose.synth.bodies import PoseBank, draw_bodies, draw_moving_bodies
from lidarpose.synth.generator import Generator
from lidarpose.synth.scene import SCENES

SEED = 11
JOINTS = {name: i for i, name in enumerate(BODY26.joints)}


def motion(frames=40, fps=10.0, jump=0.0, turn=0.0, names=("001_01",)):
    """Motion of a person with the left arm raised forward, who moves along y at 1 m/s, turns at `turn` rad/s and jumps
    `jump` m every 0.8 s."""
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


def test_vary_mirrors_captured_poses(monkeypatch):
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
        # mirrored people move to the right
        np.testing.assert_allclose(way[k, 0], [0, -0.1 if off[1] < off[0] else 0.1, 0], atol=1e-5)
        mirrored += off[1] < off[0]
    assert 0.2 < mirrored / len(varied) < 0.8


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_draw_bodies_uses_requested_share_of_captured_poses(share):
    bank = PoseBank.of_motion(motion())
    drawn = draw_bodies(bank, share, 120, SEED, 0)
    captured = np.array(drawn.kinds) == "captured"
    # the prior has a kind of the same name, fitted to captured motion
    prior = np.array(draw_bodies(None, 0.0, 120, SEED, 0).kinds) == "captured"
    # children's steps are shorter
    step = np.array([drawn.moved(row)[1][0] for row in range(120)]) - drawn.joints[:, 0]
    aside = (np.abs(step[:, 0]) < 1e-3) & (np.abs(np.abs(step[:, 1]) - 0.09) < 0.05)
    assert aside.mean() == pytest.approx(share, abs=0.12) and captured[aside].all()
    # their steps of 0.1 m are scaled with the length of their legs
    ratio = bodies._leg_length(drawn.joints) / bodies._leg_length(mean_adult_joints()[None])
    np.testing.assert_allclose(np.abs(step[aside & ~prior, 1]), 0.1 * ratio[aside & ~prior], rtol=0.01)
    if share == 0:
        np.testing.assert_array_equal(captured, prior)


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_draw_moving_bodies_captured_share_and_jumps(share):
    # four times the frame rate of a clip
    bank = PoseBank.of_motion(motion(frames=160, fps=40.0, jump=0.5))
    for seed in range(3):
        somebody = draw_moving_bodies(bank, share, 1, 9, np.random.default_rng(seed))[0]
        aside = np.abs(np.diff(somebody.joints[:, 0, 1]))
        high = somebody.vertices[..., 2].min(1)
        if share:
            assert somebody.kinds[0] == "captured" and ((aside > 0.04) & (aside < 0.14)).all()
            # one frame in eight is a jump, whose height depends on the body
            assert 1 <= (high > 0.4).sum() <= 2 and np.abs(high[high < 0.4]).max() < 1e-4
        else:
            assert not ((aside > 0.04) & (aside < 0.14)).all()
        # a frame ends with the pose of the next frame
        np.testing.assert_array_equal(somebody.moved(0)[0], somebody.vertices[1])
        np.testing.assert_array_equal(somebody.moved(0)[1], somebody.joints[1])


def test_generator_clip_rejects_motion_shorter_than_a_clip():
    generator = Generator(scene="wild", bank=PoseBank.of_motion(motion(frames=10)), captured=1.0)
    with pytest.raises(InputError, match=r"no clip lasts 16 frames, 1.5 s: give longer motion, or lower captured"):
        generator.clip(0, 0)


def test_draw_moving_bodies_mixes_sources_in_any_order():
    bank = PoseBank.of_motion(motion(frames=60))
    kinds = [somebody.kinds[0] for somebody in draw_moving_bodies(bank, 0.5, 24, 2, np.random.default_rng(0))]
    is_captured = [kind == "captured" for kind in kinds]
    # captured ones are not all first; a kind of the prior is also called so
    assert not all(is_captured[:8]) and any(is_captured[:8]) and any(is_captured[16:])


def test_pose_bank_clip_tempo_changes_speed():
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
        # constant speed stays constant
        np.testing.assert_allclose(steps, steps.mean(), rtol=1e-3)
        speeds.append(steps.mean() / pace)
    assert np.exp(-0.41) < min(speeds) < 0.75 and 1.3 < max(speeds) < np.exp(0.41)
    # a request for the whole clip cannot be sped up
    whole = bank.clips.length[0]
    assert all(len(bank.clip(whole, np.random.default_rng(seed), tempo=0.4)[0]) == whole for seed in range(8))
    moved = {draw_moving_bodies(bank, 1.0, 1, 8, np.random.default_rng(2), tempo=t)[0].joints[-1, 0, 1] for t in (0, 1)}
    assert len(moved) == 2


@pytest.mark.parametrize("turn", [0.8, -0.8])
def test_moving_body_boxes_turn_with_person(turn):
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


def test_pose_bank_from_clips_selects_subjects(monkeypatch):
    both = motion(frames=40, names=("001_01", "002_01"))
    monkeypatch.setattr(bodies, "load_motion", lambda path: both)
    assert PoseBank.from_clips("x").clips.names == both.names
    one = PoseBank.from_clips("x", ("002",))
    assert one.clips.names == ("002_01",) and len(one.rotations) == 19


def test_generator_without_clothes_gives_bare_bodies(monkeypatch):
    bare, dressed = (Generator(scene=replace(SCENES["paper"], clothes=share))._bodies(SEED, 0) for share in (0.0, 1.0))
    assert np.abs(dressed.vertices - bare.vertices).max() > 0.01
    np.testing.assert_array_equal(bare.joints[..., :2], dressed.joints[..., :2])
    monkeypatch.setattr(bodies, "clothing", lambda rng, count, rig: clothing(rng, count) * 0)
    np.testing.assert_array_equal(Generator(scene=SCENES["paper"])._bodies(SEED, 0).vertices, bare.vertices)


def folded_arms(frames=12):
    """Motion of a person with folded arms, whose hands and wrists are inside the belly of most bodies."""
    someone = motion(frames=frames)
    for side, sign in (("left", 1), ("right", -1)):
        down = -sign * (1.35 + 0.05 * np.sin(np.arange(frames)))
        someone.rotations[:, SMPL24.index(f"{side}_shoulder")] = rotation_about("x", down)
        # the forearms are level in front of the belly
        across = rotation_about("x", sign * 1.35) @ rotation_about("z", -sign * (np.pi - 0.45))
        someone.rotations[:, SMPL24.index(f"{side}_elbow")] = across
    return someone


def wrists_inside(body, rows):
    """Depth (rows, 2) m of the wrists behind the front of the trunk at their height, positive inside."""
    depths = []
    trunk = np.isin(body.face_part, [1 + SMPL24.index(name) for name in ("pelvis", "spine1", "spine2", "spine3")])
    for row in rows:
        points = body.vertices[row][np.unique(body.faces[trunk])]
        for side in ("left", "right"):
            wrist = body.joints[row, JOINTS[f"{side}_wrist"]]
            near = np.abs(points[:, 1:] - wrist[1:]).max(1) < 0.06
            depths.append(points[near, 0].max() - wrist[0] if near.any() else 0.0)
    return np.array(depths).reshape(-1, 2)


def test_clear_limbs_moves_captured_arms_out_of_body():
    bank = PoseBank.of_motion(folded_arms())
    before, after = (draw_bodies(bank, 1.0, 60, SEED, 0, clear_limbs=on) for on in (False, True))
    inside, left = (wrists_inside(people, range(60)).max(1) for people in (before, after))
    assert (inside > 0.04).mean() > 0.5 and (left > 0.04).mean() < 0.05
    # other joints stay, except for the height of the soles
    hidden = [JOINTS[f"{side}_{name}"] for side in ("left", "right") for name in ("elbow", "wrist", "hand")]
    others = np.setdiff1d(np.arange(26), hidden)
    np.testing.assert_allclose(after.joints[:, others], before.joints[:, others], atol=0.06)
    moved = np.linalg.norm(after.joints - before.joints, axis=-1)[:, hidden]
    assert (moved < 0.3).all()
    # arms stay folded: hands are in front of the trunk and within the thickness of a hand
    wrists = after.joints[:, [JOINTS["left_wrist"], JOINTS["right_wrist"]]]
    assert (wrists[..., 0].min(1) > before.joints[:, JOINTS["spine1"], 0]).all() and np.median(left) > -0.06
    # the motion within a frame stays the same
    for row in range(5):
        way = [people.moved(row)[1] - people.joints[row] for people in (before, after)]
        np.testing.assert_allclose(way[0], way[1], atol=0.03)


def test_clear_limbs_keeps_poses_without_contact():
    # one arm forward and one hanging, both away from the body
    bank = PoseBank.of_motion(motion())
    before, after = (draw_bodies(bank, 0.5, 60, SEED, 0, clear_limbs=on) for on in (False, True))
    same = np.abs(after.joints - before.joints).max((1, 2)) == 0
    assert same.mean() > 0.7
    # poses of the prior are not changed
    prior = np.isnan(before.places[:, 0])
    assert same[prior].all() and 0.3 < prior.mean() < 0.7


def test_clear_limbs_keeps_clips_smooth():
    bank = PoseBank.of_motion(folded_arms(40))
    hands = [JOINTS[f"{side}_hand"] for side in ("left", "right")]
    for seed in range(3):
        before, after = (
            draw_moving_bodies(bank, 1.0, 2, 9, np.random.default_rng(seed), clear_limbs=on)[0] for on in (False, True)
        )
        shift = (after.joints - after.joints[:, :1] - (before.joints - before.joints[:, :1]))[:, hands]
        assert np.abs(np.diff(shift, axis=0)).max() < 0.05
        assert (wrists_inside(after, range(9)) < 0.04).all()


def test_cleared_separates_shanks():
    rig = load_rig()
    people = rig.rest(np.zeros((2, rig.coefficients.shape[1])))
    pose = np.tile(np.eye(3, dtype=np.float32), (2, 1, 24, 1, 1))
    for side, sign in (("left", 1), ("right", -1)):
        pose[0, :, SMPL24.index(f"{side}_hip")] = rotation_about("x", -sign * 0.1)
    after = cleared(rig, people, np.zeros(people.vertices.shape[:2], np.float32), pose, np.arange(2), is_clip=False)
    ankle = [
        joints_of(poses[:, 0])[0, [SMPL24.index("left_ankle"), SMPL24.index("right_ankle")], 1]
        for poses in (pose, after)
    ]
    assert ankle[0][0] - ankle[0][1] < 0.05 < 0.055 < ankle[1][0] - ankle[1][1] < 0.1
    np.testing.assert_array_equal(after[1], pose[1])


def test_clear_limbs_is_enabled_only_in_wide_scene():
    assert {name for name, scene in SCENES.items() if scene.clear_limbs} == {"wide"}
    bank = PoseBank.of_motion(folded_arms())
    off, on = (
        Generator(scene=replace(SCENES["wild"], clear_limbs=share), bank=bank, captured=1.0)._bodies(SEED, 0)
        for share in (0.0, 1.0)
    )
    wide = Generator(scene=replace(SCENES["wide"], unusual=0.0), bank=bank, captured=1.0)._bodies(SEED, 0)
    np.testing.assert_array_equal(on.joints, wide.joints)
    assert np.abs(on.joints - off.joints).max() > 0.05
