"""Clips of the pose prior: people who go on with what they do."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidarpose.body.mocap import retarget
from lidarpose.body.pose_prior import activities, contact, gait, latents, sampling
from lidarpose.body.pose_prior.contact import sole_points
from lidarpose.errors import InputError
from lidarpose.skeleton import SMPL24

J = {name: i for i, name in enumerate(SMPL24.joints)}
HZ = 40.0


@cache
def clips(kind, n=12, frames=80, hz=HZ, seed=0):
    return sampling.sample_clips(np.random.default_rng(seed), n, frames=frames, hz=hz, mix={kind: 1})


def placed(drawn):
    """Joints (n, F, 24, 3) and soles (n, F, 8, 3) of the mean adult where the clip puts them, the ground at 0."""
    n, frames = drawn.rotations.shape[:2]
    flat = drawn.rotations.reshape(-1, 24, 3, 3)
    soles = sole_points(flat).reshape(n, frames, 8, 3)
    joints = contact.body_frames(flat)[1].reshape(n, frames, 24, 3)
    way = drawn.translation[:, :, None]
    ground = drawn.clearance[:, 0] - soles[:, 0, :, 2].min(1)
    return joints + way + [0, 0, 1] * ground[:, None, None, None], soles + way + [0, 0, 1] * ground[:, None, None, None]


@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(0, 9), frames=st.integers(0, 7))
def test_shapes_and_rotations(seed, n, frames):
    drawn = sampling.sample_clips(np.random.default_rng(seed), n, frames=frames)
    assert drawn.rotations.shape == (n, frames, 24, 3, 3) and drawn.rotations.dtype == np.float32
    assert drawn.translation.shape == (n, frames, 3) and drawn.clearance.shape == (n, frames)
    product = drawn.rotations @ np.swapaxes(drawn.rotations, -1, -2)
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), atol=1e-5)
    if frames:
        np.testing.assert_allclose(retarget.heading(drawn.rotations[:, 0]), 0, atol=1e-5)
        np.testing.assert_array_equal(drawn.translation[:, 0], 0)
    assert (drawn.clearance >= 0).all()


@pytest.mark.parametrize("kind", activities.KINDS)
def test_people_move_as_fast_as_people(kind):
    joints, _ = placed(clips(kind))
    speed = np.linalg.norm(np.diff(joints, axis=1), axis=-1) * HZ
    assert speed.max() < 10
    acceleration = np.linalg.norm(np.diff(joints[:, ::2], n=2, axis=1), axis=-1) * (HZ / 2) ** 2
    # a runner's foot is stopped in a few hundredths of a second; heads and hips are carried softly
    assert np.percentile(acceleration, 99) < 130
    assert np.percentile(acceleration[:, :, [J["pelvis"], J["head"]]], 99) < (40 if kind != "fall" else 80)
    assert speed.max() > 0.01  # nobody is a statue


@pytest.mark.parametrize(
    "kind, most",
    [("idle", 0.01), ("crouch", 0.02), ("bend", 0.02), ("step", 0.03), ("kneel", 0.02), ("sport", 0.05)]
    + [("captured", 0.04), ("walk", 0.03), ("push", 0.03), ("run", 0.04)],
)
def test_feet_that_stand_do_not_slide(kind, most):
    """The lowest sole point of a frame that is low in the next one, too, went hardly anywhere."""
    _, soles = placed(clips(kind, n=20, hz=10.0, frames=24))
    low = soles[..., 2].argmin(2)[:, :-1, None, None]
    here, there = (np.take_along_axis(part, low, 2)[:, :, 0] for part in (soles[:, :-1], soles[:, 1:]))
    stays = (here[..., 2] < 0.005) & (there[..., 2] < 0.005)
    slid = np.linalg.norm((there - here)[..., :2], axis=-1)[stays]
    assert len(slid) > 20 and np.percentile(slid, 95) < most


def test_no_foot_goes_through_the_ground_and_somebody_is_always_on_it():
    for kind in ("walk", "idle", "bend", "step"):
        _, soles = placed(clips(kind))
        low = soles[..., 2].min(2)
        assert np.abs(low).max() < 0.02, kind
    _, soles = placed(clips("run"))
    low = soles[..., 2].min(2)
    assert low.min() > -0.02 and 0.02 < low.max() < 0.15
    assert 0.05 < (low > 0.01).mean() < 0.5  # in flight


def test_hips_do_not_bob():
    """Walkers' hips rise and fall by a few centimeters, cyclists' not at all, standing people's by millimeters."""
    for kind, most in (("walk", 0.09), ("idle", 0.03), ("cycle", 0.005)):
        z = clips(kind).translation[..., 2]
        assert np.ptp(z, axis=1).max() < most, kind


def test_walkers_go_ahead_at_the_speed_of_their_strides():
    drawn = clips("walk", n=40)
    speed = np.linalg.norm(np.diff(drawn.translation[..., :2], axis=1), axis=-1) * HZ
    assert 0.8 < np.median(speed) < 1.5 and speed.min() > 0.1 and speed.max() < 2.5
    assert (drawn.translation[:, -1, 0] > 0.3).all()
    runs = clips("run", n=40)
    assert 2.0 < np.median(np.linalg.norm(np.diff(runs.translation[..., :2], axis=1), axis=-1)) * HZ < 4.0
    # the way and the hips turn together
    way = np.diff(drawn.translation[..., :2], axis=1)
    course = np.unwrap(np.arctan2(way[..., 1], way[..., 0]), axis=1)
    assert np.abs(course[:, -1] - course[:, 0]).max() > 0.15
    facing = np.unwrap([retarget.heading(r) for r in drawn.rotations], axis=1)[:, 1:]
    assert np.abs((facing - course) - (facing - course).mean(1, keepdims=True)).max() < 0.3


def test_a_fall_ends_on_the_ground():
    joints, _ = placed(clips("fall", n=20, frames=80))
    assert (joints[:, 0, J["head"], 2] > 1.0).all() and np.median(joints[:, -1, J["head"], 2]) < 0.6


def test_faster_clips_show_the_same_motion():
    slow, fast = (
        sampling.sample_clips(np.random.default_rng(3), 20, frames=f, hz=h) for f, h in ((6, 5.0), (11, 10.0))
    )
    np.testing.assert_array_equal(slow.kind, fast.kind)
    np.testing.assert_allclose(fast.rotations[:, ::2], slow.rotations, atol=1e-5)
    goes = np.isin(slow.kind, [activities.KINDS.index(k) for k in ("walk", "run", "push", "cycle")])
    np.testing.assert_allclose(fast.translation[goes, ::2, :2], slow.translation[goes, :, :2], atol=1e-2)


def test_moved_poses_are_those_of_the_pose_itself_later():
    still, moved = (sampling.sample_rotations(np.random.default_rng(5), 200, dt=dt) for dt in (0.0, 0.1))
    np.testing.assert_allclose(moved.rotations, still.rotations, atol=1e-6)
    np.testing.assert_array_equal(moved.kind, still.kind)
    np.testing.assert_array_equal(still.moved, still.rotations)
    assert not still.step.any()
    hands = [contact.body_frames(r)[1] for r in (moved.rotations, moved.moved)]
    far = np.linalg.norm(hands[1] - hands[0], axis=-1).max(1)
    assert 0.001 < np.median(far) < 0.2 and far.max() < 1.0
    walk = sampling.sample_rotations(np.random.default_rng(5), 200, mix={"walk": 1}, dt=0.1)
    assert 0.07 < np.median(walk.step[:, 0]) < 0.15
    # a foot on the ground stays there while the body goes on
    here, there = sole_points(walk.rotations).reshape(200, 8, 3), sole_points(walk.moved).reshape(200, 8, 3)
    low = here[..., 2].argmin(1)
    i = np.arange(200)
    at, later = here[i, low], there[i, low] + walk.step
    stays = np.abs(later[:, 2] - at[:, 2]) < 0.005
    assert stays.mean() > 0.3 and np.percentile(np.linalg.norm((later - at)[stays, :2], axis=1), 90) < 0.03


def test_a_stride_takes_and_comes_round():
    """Hips and knees of a stride are periodic, and the knee bends most in the swing."""
    phase = np.linspace(0, 1, 40, endpoint=False)
    base, style = np.zeros((40, 27)), np.full((40, 8), 0.5)
    walk = np.full(40, gait.GAITS.index("walk"))
    one, next_one = gait.add_stride(walk, phase, style, base), gait.add_stride(walk, phase + 3, style, base)
    np.testing.assert_allclose(one.angles, next_one.angles, atol=1e-9)
    knee = one.angles[:, sampling.ANGLES.index("left_knee")]
    assert 0.6 < phase[knee.argmax()] < 0.85 and knee.max() > 45 and knee[(phase > 0.2) & (phase < 0.4)].max() < 30
    assert np.ptp(one.pace) < 1e-9 and 0.7 < one.pace[0] < 1.8


def test_latents_are_taken_together():
    rng = np.random.default_rng(0)
    drawn = latents.draw_latents(rng, rng.choice(len(activities.KINDS), 300, p=activities.SHARES))
    rows = rng.permutation(300)[:80]
    np.testing.assert_array_equal(sampling._angles(drawn.take(rows)).angles, sampling._angles(drawn).angles[rows])


def test_few_clips_pass_through_themselves_and_the_mix_is_kept():
    drawn = sampling.sample_clips(np.random.default_rng(1), 800, frames=6)
    ends = contact.capsule_ends(*contact.body_frames(drawn.rotations.reshape(-1, 24, 3, 3)))
    assert (contact.self_collision(ends).max(1) > 0.02).mean() < 0.02
    shares = np.bincount(drawn.kind, minlength=len(activities.KINDS)) / 800
    np.testing.assert_allclose(shares, activities.SHARES, atol=0.045)


def test_wrong_clips_are_refused():
    rng = np.random.default_rng(0)
    for n, frames, hz, message in ((-1, 3, 10.0, "n must"), (1, -3, 10.0, "frames must"), (1, 3, 0.0, "hz > 0")):
        with pytest.raises(InputError, match=message):
            sampling.sample_clips(rng, n, frames=frames, hz=hz)
    with pytest.raises(InputError, match="did you mean walk"):
        sampling.sample_clips(rng, 1, frames=2, mix={"wakl": 1})
    with pytest.raises(InputError, match="0 or more"):
        sampling.sample_rotations(rng, 1, dt=-0.1)
