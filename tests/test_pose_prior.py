"""The pose prior: single poses, clips, balance, contact with the ground, self-collision."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from motion_files import J, check_rotations, joints_of
from scripts import load_script

from lidarpose.body import rig
from lidarpose.body.pose_prior import activities, constraints, gait, latents, sampling
from lidarpose.body.pose_prior.activities import mirror_angles, rotations_from_angles
from lidarpose.body.pose_prior.constraints import body_frames, capsule_ends, self_collision, sole_points
from lidarpose.errors import InputError
from lidarpose.geometry import axis_angle_to_matrix, rotation_about
from lidarpose.skeleton import SMPL24

fit = load_script("tools/fit_motion.py")
A, KINDS = activities.ANGLE_INDEX, activities.KINDS
SIDES = (("left", 1), ("right", -1))
HZ = 40.0
UNUSUAL = [name for name, weight in zip(KINDS, activities.UNUSUAL, strict=True) if weight]
ON_FLOOR = [name for name in UNUSUAL if "rests_on" in activities.TABLES["activities"][name]]


def drawn(n=1500, seed=0, **mix):
    return sampling.sample_rotations(np.random.default_rng(seed), n, mix=mix or None)


def latents_of(n, seed, **mix):
    """The mix's latents as drawn, before any are replaced."""
    rng = np.random.default_rng(seed)
    return latents.draw_latents(rng, rng.choice(len(KINDS), n, p=sampling._kind_shares(mix or None)))


def raw_angles(n, seed, **mix):
    return sampling._angles(latents_of(n, seed, **mix)).angles


@cache
def clips(kind, n=12, frames=80, hz=HZ, seed=0):
    return sampling.sample_clips(np.random.default_rng(seed), n, frames=frames, hz=hz, mix={kind: 1})


def placed(drawn):
    """Joints (n, F, 24, 3) and soles (n, F, 8, 3) of the mean adult, placed by the clip, with the ground at 0."""
    n, frames = drawn.rotations.shape[:2]
    flat = drawn.rotations.reshape(-1, 24, 3, 3)
    soles = sole_points(flat).reshape(n, frames, 8, 3)
    joints = body_frames(flat)[1].reshape(n, frames, 24, 3)
    way = drawn.translation[:, :, None]
    ground = drawn.clearance[:, 0] - soles[:, 0, :, 2].min(1)
    up = [0, 0, 1] * ground[:, None, None, None]
    return joints + way + up, soles + way + up


# draws


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(0, 60), frames=st.integers(0, 7))
def test_sample_rotations_and_clips_shapes(seed, n, frames):
    prior = drawn(n, seed)
    assert prior.rotations.shape == (n, 24, 3, 3) and prior.kind.shape == (n,)
    check_rotations(prior.rotations)
    np.testing.assert_allclose(rig.heading(prior.rotations), 0, atol=1e-5)
    n = n // 8
    clip = sampling.sample_clips(np.random.default_rng(seed), n, frames=frames)
    assert clip.rotations.shape == (n, frames, 24, 3, 3) and (clip.clearance >= 0).all()
    assert clip.translation.shape == (n, frames, 3) and clip.clearance.shape == (n, frames)
    check_rotations(clip.rotations)
    if frames:
        np.testing.assert_allclose(rig.heading(clip.rotations[:, 0]), 0, atol=1e-5)
        np.testing.assert_array_equal(clip.translation[:, 0], 0)


def test_sample_poses_is_deterministic():
    poses, other = sampling.sample_poses(40, 3), sampling.sample_poses(40, 4)
    assert poses.shape == (40, 24, 3) and poses.dtype == np.float32 and np.abs(poses - other).max() > 0.1
    np.testing.assert_array_equal(poses, sampling.sample_poses(40, 3))
    np.testing.assert_allclose(poses, joints_of(drawn(40, 3).rotations), atol=1e-5)
    np.testing.assert_allclose(poses[:, 0], 0, atol=1e-6)
    assert (np.linalg.norm(poses, axis=-1) < 1.6).all()


def test_sample_rotations_follows_mix():
    assert set(drawn(300, 0, sit=1, walk=3).kind) == {KINDS.index("sit"), KINDS.index("walk")}
    counts = np.bincount(drawn(20000, 0).kind, minlength=len(KINDS)) / 20000
    np.testing.assert_allclose(counts, activities.SHARES, atol=0.015)
    np.testing.assert_array_equal(drawn(40, walk=1e308, run=1e308).rotations, drawn(40, walk=1, run=1).rotations)


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda rng: drawn(3, 0, wakl=1), "did you mean walk"),
        (lambda rng: drawn(3, 0, walk=0), "above 0"),
        (lambda rng: drawn(-1), "n must be a whole number of at least 0"),
        *((lambda rng, w=w: drawn(2, walk=w), "weight of walk must be a finite number") for w in (np.inf, np.nan, "a")),
        (lambda rng: sampling.sample_rotations(rng, 1, dt=-0.1), "0 or more"),
        (lambda rng: sampling.sample_poses(3, -1), "seed must be a whole number"),
        (lambda rng: sampling.sample_poses(2.5, 0), "n must be a whole number"),
        (lambda rng: sampling.sample_clips(rng, -1, frames=3), "n must"),
        (lambda rng: sampling.sample_clips(rng, 1, frames=-3), "frames must"),
        (lambda rng: sampling.sample_clips(rng, 1, frames=3, hz=0.0), "hz > 0"),
        (lambda rng: sampling.sample_clips(rng, 1, frames=2, mix={"wakl": 1}), "did you mean walk"),
    ],
)
def test_sampling_rejects_bad_arguments(call, message):
    with pytest.raises(InputError, match=message):
        call(np.random.default_rng(0))


def test_latents_take_selects_people():
    people, rows = latents_of(300, 0), np.random.default_rng(0).permutation(300)[:80]
    np.testing.assert_array_equal(sampling._angles(people.take(rows)).angles, sampling._angles(people).angles[rows])


# angles and rotations


def test_from_euler_matches_product_of_rotations():
    euler = np.random.default_rng(0).uniform(-3, 3, (40, 3))
    reference = rotation_about("y", euler[:, 0]) @ rotation_about("x", euler[:, 1]) @ rotation_about("z", euler[:, 2])
    np.testing.assert_allclose(activities._from_euler(euler), reference, atol=1e-12)


@pytest.mark.parametrize(
    "back", [fit.angles_from_rotations, lambda rotations: latents.from_features(fit.to_features(rotations))]
)
def test_angles_from_rotations_round_trip(back):
    rotations = rotations_from_angles(raw_angles(1000, 3))
    # if an arm points straight out, raise and inward turn are ambiguous, but the pose is the same
    np.testing.assert_allclose(rotations_from_angles(back(rotations)), rotations, atol=0.02)


def test_mirror_angles_gives_mirror_image():
    angles = raw_angles(200, 6)
    mirrored = mirror_angles(angles)
    assert (mirrored >= activities.LIMITS[0]).all() and (mirrored <= activities.LIMITS[1]).all()
    p, q = (joints_of(rotations_from_angles(a)) for a in (angles, mirrored))
    np.testing.assert_allclose(q, p[:, SMPL24.flip] * [1, -1, 1], atol=0.02)
    np.testing.assert_allclose(mirror_angles(mirrored), angles)
    mean = joints_of(drawn(6000, 9).rotations).mean(0)
    np.testing.assert_allclose(mean, mean[list(SMPL24.flip)] * [1, -1, 1], atol=0.03)


def test_prior_bends_knees_and_elbows_within_limits():
    prior = drawn(4000, 1)
    for side, sign in SIDES:
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


def test_rotations_from_angles_has_expected_signs():
    """A bent knee is ahead of its ankle, and a bent elbow moves the hand forward."""
    bent = np.zeros((1, 27))
    for name, angle in (("knee", 80), ("elbow", 80), ("abd", 15), ("out", 15)):
        bent[:, [A[f"{side}_{name}"] for side, _ in SIDES]] = angle
    p = joints_of(rotations_from_angles(bent))[0]
    for side, left in SIDES:
        assert p[J[f"{side}_ankle"], 0] < p[J[f"{side}_knee"], 0] - 0.2
        assert p[J[f"{side}_wrist"], 0] > p[J[f"{side}_elbow"], 0] + 0.15
        assert left * p[J[f"{side}_knee"], 1] > left * p[J[f"{side}_hip"], 1] + 0.05
        assert left * p[J[f"{side}_elbow"], 1] > left * p[J[f"{side}_shoulder"], 1] + 0.03
    for angle, joint in (("bend", "neck"), ("tilt", "neck"), ("left_hip", "left_knee"), ("right_raise", "right_wrist")):
        angles = np.zeros((2, 27))
        angles[1, A[angle]] = 40
        still, moved = joints_of(rotations_from_angles(angles))[:, J[joint], 0]
        assert moved > still + 0.1, angle


# activities


@pytest.mark.parametrize("kind", ["idle", "walk"])
def test_prior_idle_and_walk_stand_upright(kind):
    p = joints_of(drawn(800, 2, **{kind: 1}).rotations)
    pelvis, feet = p[:, J["pelvis"], 2], p[:, [J["left_ankle"], J["right_ankle"]], 2]
    assert (p[:, J["head"], 2] > pelvis + 0.4).all()
    assert (feet.min(1) < pelvis - 0.6).all() and (feet < pelvis[:, None] - 0.3).all()
    width = p[:, J["left_ankle"], 1] - p[:, J["right_ankle"], 1]
    assert 0.10 < np.median(width) < 0.35 and (width > -0.15).mean() > 0.99
    for side, _ in SIDES:  # toes point ahead, legs are straight
        assert (p[:, J[f"{side}_foot"], 0] > p[:, J[f"{side}_ankle"], 0] - 0.06).mean() > 0.98
        hip, knee, ankle = (p[:, J[f"{side}_{name}"]] for name in ("hip", "knee", "ankle"))
        thigh, shank = (v / np.linalg.norm(v, axis=-1, keepdims=True) for v in (knee - hip, ankle - knee))
        assert np.median((thigh * shank).sum(-1)) > np.cos(np.radians(40))


def test_prior_walk_swings_arms_opposite_to_legs():
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
    arms, legs = ((p[:, J[f"left_{name}"]] - p[:, J[f"right_{name}"]])[:, 0] for name in ("elbow", "ankle"))
    assert np.corrcoef(arms, legs)[0, 1] < -0.3


def test_add_stride_is_periodic():
    """Angles of a stride are periodic, and the knee bends most in the swing phase."""
    phase = np.linspace(0, 1, 40, endpoint=False)
    base, style, walk = np.zeros((40, 27)), np.full((40, 8), 0.5), np.full(40, gait.GAITS.index("walk"))
    stride, later = (gait.add_stride(walk, phase + k, style, base) for k in (0, 3))
    np.testing.assert_allclose(stride.angles, later.angles, atol=1e-9)
    knee = stride.angles[:, A["left_knee"]]
    assert 0.6 < phase[knee.argmax()] < 0.85 and knee.max() > 45 and knee[(phase > 0.2) & (phase < 0.4)].max() < 30
    assert np.ptp(stride.pace) < 1e-9 and 0.7 < stride.pace[0] < 1.8


def test_prior_captured_poses_are_upright():
    rng = np.random.default_rng(0)
    assert [latents.captured_angles(rng, n).shape for n in (500, 0)] == [(500, 2, 27), (0, 2, 27)]
    p = joints_of(drawn(500, 15, captured=1).rotations)
    assert (p[:, J["neck"], 2] > p[:, J["pelvis"], 2]).mean() > 0.95
    assert Path(rig.__file__).with_name("assets").joinpath("motion_prior.npz").stat().st_size < 60_000


def test_fit_mixture_recovers_known_mixture(tmp_path):
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
    assert np.load(tmp_path / "mixture.npz")["roots"].shape == (2, 27 * 28 // 2)


# clips


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_clips_have_human_speed_and_acceleration(kind):
    joints, _ = placed(clips(kind))
    speed = np.linalg.norm(np.diff(joints, axis=1), axis=-1) * HZ
    assert 0.01 < speed.max() < 10  # there is motion
    acceleration = np.linalg.norm(np.diff(joints[:, ::2], n=2, axis=1), axis=-1) * (HZ / 2) ** 2
    # a runner's foot stops within a few hundredths of a second; heads and hips accelerate less
    assert np.percentile(acceleration, 99) < 130
    assert np.percentile(acceleration[:, :, [J["pelvis"], J["head"]]], 99) < (40 if kind != "fall" else 80)


@pytest.mark.parametrize(
    "kind, most",
    [("idle", 0.01), ("crouch", 0.02), ("bend", 0.02), ("step", 0.03), ("kneel", 0.02), ("sport", 0.05)]
    + [("captured", 0.04), ("walk", 0.03), ("push", 0.03), ("run", 0.04)],
)
def test_clips_standing_feet_do_not_slide(kind, most):
    """The lowest sole point of a frame hardly moves if it is low in the next frame, too."""
    _, soles = placed(clips(kind, n=20, hz=10.0, frames=24))
    low = soles[..., 2].argmin(2)[:, :-1, None, None]
    here, there = (np.take_along_axis(part, low, 2)[:, :, 0] for part in (soles[:, :-1], soles[:, 1:]))
    stays = (here[..., 2] < 0.005) & (there[..., 2] < 0.005)
    slid = np.linalg.norm((there - here)[..., :2], axis=-1)[stays]
    assert len(slid) > 20 and np.percentile(slid, 95) < most


def test_clips_feet_stay_above_ground_and_hips_steady():
    # hips rise and fall by a few centimeters in walking, not at all in cycling
    for kind, most in (("walk", 0.09), ("idle", 0.03), ("cycle", 0.005)):
        assert np.ptp(clips(kind).translation[..., 2], axis=1).max() < most, kind
    low = {kind: placed(clips(kind))[1][..., 2].min(2) for kind in ("walk", "idle", "bend", "step", "run")}
    run = low.pop("run")
    assert all(np.abs(heights).max() < 0.02 for heights in low.values())
    assert run.min() > -0.02 and 0.02 < run.max() < 0.15
    assert 0.05 < (run > 0.01).mean() < 0.5  # flight phases


def test_clips_walk_and_run_with_plausible_speed_and_heading():
    walk, run = (clips(kind, n=40).translation[..., :2] for kind in ("walk", "run"))
    speed, run_speed = (np.linalg.norm(np.diff(way, axis=1), axis=-1) * HZ for way in (walk, run))
    assert 0.8 < np.median(speed) < 1.5 and speed.min() > 0.1 and speed.max() < 2.5
    assert 2.0 < np.median(run_speed) < 4.0 and (walk[:, -1, 0] > 0.3).all()
    # path and hips turn together
    x, y = np.moveaxis(np.diff(walk, axis=1), -1, 0)
    course = np.unwrap(np.arctan2(y, x), axis=1)
    assert np.abs(course[:, -1] - course[:, 0]).max() > 0.15
    facing = np.unwrap([rig.heading(r) for r in clips("walk", n=40).rotations], axis=1)[:, 1:]
    assert np.abs((facing - course) - (facing - course).mean(1, keepdims=True)).max() < 0.3


def test_clips_fall_ends_on_ground():
    head = placed(clips("fall", n=20, frames=80))[0][:, :, J["head"], 2]
    assert (head[:, 0] > 1.0).all() and np.median(head[:, -1]) < 0.6


def test_sample_clips_motion_does_not_depend_on_rate():
    slow, fast = (
        sampling.sample_clips(np.random.default_rng(3), 20, frames=f, hz=h) for f, h in ((6, 5.0), (11, 10.0))
    )
    np.testing.assert_array_equal(slow.kind, fast.kind)
    np.testing.assert_allclose(fast.rotations[:, ::2], slow.rotations, atol=1e-5)
    travels = np.isin(slow.kind, [KINDS.index(k) for k in ("walk", "run", "push", "cycle")])
    np.testing.assert_allclose(fast.translation[travels, ::2, :2], slow.translation[travels, :, :2], atol=1e-2)


def test_sample_rotations_moved_is_pose_after_dt():
    still, moved = (sampling.sample_rotations(np.random.default_rng(5), 200, dt=dt) for dt in (0.0, 0.1))
    np.testing.assert_allclose(moved.rotations, still.rotations, atol=1e-6)
    np.testing.assert_array_equal(moved.kind, still.kind)
    np.testing.assert_array_equal(still.moved, still.rotations)
    assert not still.step.any()
    before, after = (body_frames(r)[1] for r in (moved.rotations, moved.moved))
    far = np.linalg.norm(after - before, axis=-1).max(1)
    assert 0.001 < np.median(far) < 0.2 and far.max() < 1.0
    # moved and step are the second frame of a clip, whose standing feet do not slide
    walk = sampling.sample_rotations(np.random.default_rng(5), 200, mix={"walk": 1}, dt=0.1)
    assert 0.07 < np.median(walk.step[:, 0]) < 0.15
    here, there = sole_points(walk.rotations), sole_points(walk.moved) + walk.step[:, None, None]
    assert np.median(np.linalg.norm((there - here)[..., :2], axis=-1).min((1, 2))) < 0.02


# balance and the ground


def test_body_frames_match_forward_kinematics():
    rotations, rest = drawn(200).rotations, rig.mean_adult_joints()[None]
    slow = rig.forward_kinematics(SMPL24.parents, rest, rotations, np.zeros((200, 3)))
    for a, b in zip(body_frames(rotations), slow, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


def test_sole_points_match_mesh():
    """The lowest sole point has the height of the shipped body's lowest vertex."""
    body, rotations = rig.load_rig(), drawn(60, walk=1).rotations
    rest = body.rest(np.repeat(body.coefficients[body.age >= 18].mean(0, keepdims=True), 60, 0))
    vertices = rig.pose_bodies(body, rest, rotations, np.zeros((60, 3)))[0]
    lowest = sole_points(rotations).reshape(60, 8, 3)[..., 2].min(1)
    np.testing.assert_allclose(lowest, vertices[..., 2].min(1), atol=0.012)


def out_of_balance(rotations):
    """Distance (n,) m of the center of mass from the area that supports the body."""
    joints = body_frames(rotations)[1]
    points = constraints._ground_points(rotations, joints)
    return np.linalg.norm(constraints.overhang(constraints.mass_center(joints), points, 0.0), axis=1)


@pytest.mark.parametrize("kind", constraints.STATIC)
def test_prior_static_poses_are_balanced_on_both_feet(kind):
    rotations = drawn(600, **{kind: 1}).rotations
    off = out_of_balance(rotations)
    if kind in UNUSUAL:
        # a few are not balanced because of joint limits
        low = sole_points(rotations)[..., 2].min(2)
        assert (off > 0.02).mean() < 0.05 and (np.abs(low[:, 0] - low[:, 1]) > 0.03).mean() < 0.05
        return
    assert (off > 0.005).mean() < 0.01
    if kind == "kneel":
        joints = joints_of(rotations)
        # a knee joint is 5 cm above the floor, an ankle joint 8 cm
        knee, ankle = (joints[:, [J[f"left_{name}"], J[f"right_{name}"]], 2].min(1) for name in ("knee", "ankle"))
        assert np.median(np.abs(knee - ankle)) < 0.08
    else:
        usual, most = {"idle": (0.003, 0.01), "crouch": (0.015, 0.06), "bend": (0.01, 0.03)}[kind]
        low = sole_points(rotations)[..., 2].min(2)
        apart = np.abs(low[:, 0] - low[:, 1])
        assert np.percentile(apart, 95) < usual and np.percentile(apart, 99) < most


def test_balanced_changes_only_static_poses():
    """Bending people are not balanced without it; angles of other activities are kept."""
    kind = np.repeat([KINDS.index("bend"), KINDS.index("sport")], 200)
    angles = sampling._angles(latents.draw_latents(np.random.default_rng(1), kind)).angles
    before = angles.copy()
    after = constraints.balanced(angles, kind)
    np.testing.assert_array_equal(angles, before)
    np.testing.assert_array_equal(after[200:], before[200:])
    off = [(out_of_balance(rotations_from_angles(a[:200])) > 0.01).mean() for a in (before, after)]
    assert off[0] > 0.4 and off[1] < 0.02


def test_overhang_of_square():
    square = np.array([[[x, y, 0.0] for x in (-0.1, 0.1) for y in (-0.1, 0.1)]])
    for at, margin, want in (((0.05, 0.0), 0.0, 0.0), ((0.15, 0.0), 0.0, -0.05), ((0.15, 0.0), 0.02, -0.07)):
        center = np.array([[*at, 1.0]])
        np.testing.assert_allclose(constraints.overhang(center, square, margin), [[want, 0]], atol=1e-6)
        # points in the air above do not support the body
        both = np.concatenate([square, square + [1.0, 0, 1]], 1)
        np.testing.assert_allclose(constraints.overhang(center, both, margin)[0], [want, 0], atol=2e-3)


def test_mass_center_of_rest_pose():
    """At 55 to 58 % of a standing adult's height, slightly more with raised arms; the shares sum to one."""
    joints = rig.mean_adult_joints()[None]
    assert 0.55 < (constraints.mass_center(joints)[0, 2] + 0.97) / 1.70 < 0.61
    np.testing.assert_allclose(
        constraints.mass_center(joints + [1.0, 2, 3]) - constraints.mass_center(joints), [[1, 2, 3]]
    )


# self-collision


def segment_distance_reference(a, b, steps=400):
    """Smallest distance of two segments, from a grid of points on each."""
    t = np.linspace(0, 1, steps)[:, None]
    p, q = (s[0] + t * (s[1] - s[0]) for s in (a, b))
    return np.linalg.norm(p[:, None] - q, axis=-1).min()


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_segment_distance_matches_reference(seed):
    a, b = np.random.default_rng(seed).normal(size=(2, 2, 3))
    fast = constraints._segment_distance(a[None].astype(np.float32), b[None].astype(np.float32))[0]
    assert abs(fast - segment_distance_reference(a, b)) < 0.02


def depth(rotations):
    return self_collision(capsule_ends(*body_frames(rotations))).max(1)


def test_self_collision_of_hand_in_belly_and_rest_pose():
    pose = np.repeat(np.eye(3, dtype=np.float32)[None, None], 24, 1)
    assert depth(pose) < 0
    pose[0, J["left_shoulder"]] = axis_angle_to_matrix(np.array([-1.4, 0, 0]))
    pose[0, J["left_elbow"]] = rotation_about("x", -1.5) @ rotation_about("z", -0.3)
    assert depth(pose) > 0.05


def test_prior_rarely_has_self_collisions():
    assert (depth(drawn(5000, 3).rotations) > 0.02).mean() < 0.01
    assert (depth(rotations_from_angles(raw_angles(5000, 3))) > 0.02).mean() > 0.05  # raw draws do have collisions
    clip = sampling.sample_clips(np.random.default_rng(1), 800, frames=6)
    assert (depth(clip.rotations.reshape(-1, 24, 3, 3)) > 0.02).mean() < 0.02
    np.testing.assert_allclose(np.bincount(clip.kind, minlength=len(KINDS)) / 800, activities.SHARES, atol=0.045)


def test_prior_keeps_hands_out_of_trunk():
    rotations, p = body_frames(drawn(3000, 10).rotations)
    shoulders = p[:, [J["left_shoulder"], J["right_shoulder"]]].mean(1)
    # the chest's frame is that of spine3
    hands = [np.einsum("nji,nj->in", rotations[:, J["spine3"]], p[:, J[f"{s}_wrist"]] - shoulders) for s, _ in SIDES]
    assert np.mean([(np.abs(x) < 0.06) & (np.abs(y) < 0.10) & (z < -0.05) for x, y, z in hands]) < 0.01


# unusual poses


@pytest.mark.long
def test_unusual_mix_has_given_share():
    assert activities.unusual_mix(0.0) is None and set(UNUSUAL) == set(BY_HAND)
    assert not activities.SHARES[[KINDS.index(name) for name in UNUSUAL]].any()
    share = np.bincount(drawn(20000, 0, **activities.unusual_mix(0.3)).kind, minlength=len(KINDS)) / 20000
    want = 0.7 * activities.SHARES + 0.3 * activities.UNUSUAL / activities.UNUSUAL.sum()
    np.testing.assert_allclose(share, want, atol=0.015)
    assert all(drawn(50, kind, **activities.unusual_mix(1.0)).kind.min() >= KINDS.index("squat") for kind in range(3))


@pytest.mark.long
@pytest.mark.parametrize("kind", UNUSUAL)
def test_unusual_poses_satisfy_constraints(kind):
    rotations = drawn(1500, 4, **{kind: 1}).rotations
    angles = fit.angles_from_rotations(rotations)
    legs = [A[f"{side}_{name}"] for side, _ in SIDES for name in ("hip", "abd", "rot", "knee", "ankle")]
    low, high = activities.LIMITS[:, legs]
    assert (angles[:, legs] > low - 1).all() and (angles[:, legs] < high + 1).all()
    ends = capsule_ends(*body_frames(rotations))
    assert (self_collision(ends).max(1) > 0.02).mean() < 0.01
    gap = constraints.hovering(ends, np.full(len(rotations), KINDS.index(kind)))
    assert (gap > 0.06).mean() < 0.01 and (kind in ON_FLOOR or not gap.any())
    head, pelvis = body_frames(rotations)[1][:, [J["head"], J["pelvis"]], 2].T
    height = np.stack([head, pelvis]) - constraints.undersides(ends)[..., 2].min(1)
    if kind.startswith("lie_"):
        assert np.percentile(height[1], 95) < 0.3 and (kind == "lie_down" or np.percentile(height[0], 95) < 0.45)
    elif kind not in (*ON_FLOOR, "get_down"):
        assert height[1].min() > 0.25
    # the constraint changes raw draws of activities on the floor only
    people = latents_of(300, 4, **{kind: 1})
    raw = constraints.balanced(sampling._free_arms(sampling._angles(people).angles, 1), people.kind)
    changed = np.abs(constraints.fitted_to_floor(raw, people.kind) - raw).max(1)
    assert (changed > 1).mean() > 0.5 if kind in ON_FLOOR else not changed.any()


@pytest.mark.parametrize("kind", constraints.ON_ONE_FOOT)
def test_prior_balances_on_one_foot(kind):
    rotations = drawn(600, 2, **{kind: 1}).rotations
    assert (out_of_balance(rotations) > 0.02).mean() < 0.02
    low = np.sort(sole_points(rotations)[..., 2].min(2), axis=1)
    assert np.median(low[:, 1] - low[:, 0]) > 0.12


# a pose of each activity set by hand, degrees, and a distance (mm, mean of the joints): the nearest of 6,000 draws of
# the activity is closer, all draws of other activities are farther
BY_HAND = {
    "squat": ({"hip": 92, "knee": 142, "ankle": 25, "abd": 24, "rot": 12, "raise": 85, "out": 8, "elbow": 10}, 105),
    "kick": ({"tilt": -14, "left_hip": 84, "left_knee": 14, "right_knee": 30, "right_hip": 6, "raise": 30, "elbow": 115,
              "twist": 24}, 120),
    "box": ({"tilt": 8, "left_hip": 42, "left_knee": 36, "right_hip": -4, "right_knee": 30, "left_raise": 86,
             "left_elbow": 14, "right_raise": 40, "right_elbow": 126, "out": 10, "in": 16, "twist": -16}, 76),
    "knee_raise": ({"bend": 30, "left_hip": 122, "left_knee": 112, "right_raise": 58, "right_elbow": 132, "twist": 36,
                    "right_knee": 12}, 90),
    "stoop": ({"tilt": 24, "bend": 48, "left_hip": 84, "left_knee": 76, "right_hip": 46, "right_knee": 92, "ankle": 14,
               "raise": 84, "out": 14, "elbow": 14}, 74),
    "reach_down": ({"tilt": 66, "bend": 38, "left_hip": 94, "left_knee": 32, "right_hip": 72, "right_knee": 20,
                    "left_raise": 92, "right_raise": -20, "right_out": 20}, 120),
    "hop": ({"tilt": 32, "bend": 26, "hip": 74, "knee": 78, "ankle": 10, "raise": -52, "out": 14, "elbow": 20}, 64),
    "throw": ({"tilt": -4, "bend": -8, "left_hip": 22, "left_knee": 20, "right_hip": -12, "right_knee": 20,
               "raise": 125, "out": 20, "elbow": 85}, 70),
    "swing": ({"abd": 18, "knee": 8, "raise": 160, "out": 40, "elbow": 14}, 76),
    "sneak": ({"tilt": 18, "bend": 26, "left_hip": 74, "left_knee": 72, "right_hip": 12, "right_knee": 34, "nod": -22,
               "left_out": 14, "left_elbow": 24, "right_raise": 10, "right_out": 14, "right_elbow": 80}, 76),
    "sit_floor": ({"tilt": -18, "bend": 24, "hip": 96, "knee": 44, "abd": 10, "raise": -32, "out": 18, "elbow": 9}, 40),
    "get_down": ({"tilt": 8, "bend": 46, "left_hip": 98, "right_hip": 88, "knee": 118, "ankle": 25, "left_raise": 46,
                  "right_raise": 10, "out": 30, "left_abd": 16}, 80),
    "lie_down": ({"tilt": -70, "bend": 18, "hip": 38, "knee": 42, "abd": 8, "raise": -12, "out": 18, "elbow": 20}, 90),
    "lie_side": ({"tilt": -18, "roll": 83, "bend": 18, "hip": 52, "knee": 60, "raise": 60, "elbow": 60}, 160),
    "lie_front": ({"tilt": 89, "knee": 12, "ankle": -44, "abd": 8, "raise": 8, "out": 16, "elbow": 12}, 120),
    "kneel_both": ({"tilt": 14, "bend": 12, "hip": 40, "knee": 106, "ankle": -50, "abd": 6, "raise": 28, "out": 16,
                    "elbow": 18}, 72),
    "all_fours": ({"tilt": 78, "bend": 5, "hip": 78, "knee": 74, "ankle": -50, "raise": 82, "out": 6, "elbow": 9}, 120),
}  # fmt: skip


@cache
def unusual_draws():
    prior = drawn(6000, 7, **activities.unusual_mix(1.0))
    return joints_of(prior.rotations), prior.kind


@pytest.mark.parametrize("kind", BY_HAND)
def test_unusual_draws_cover_poses_by_hand(kind):
    by_hand, most = BY_HAND[kind]
    angles = np.zeros((1, 27))
    for name, angle in by_hand.items():
        angles[0, [i for i, full in enumerate(activities.ANGLES) if name in (full, full.partition("_")[2])]] = angle
    target = joints_of(rotations_from_angles(angles))
    joints, kinds = unusual_draws()
    apart = 1e3 * np.linalg.norm(joints - target, axis=-1).mean(1)
    own = kinds == KINDS.index(kind)
    assert apart[own].min() < most < apart[~own].min()
