"""Feet on the ground, weight over them, and no part of a body inside another."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidarpose.body import rig
from lidarpose.body.mocap import retarget
from lidarpose.body.pose_prior import activities, balance, contact, joint_angles, latents, sampling
from lidarpose.geometry import axis_angle_to_matrix
from lidarpose.skeleton import SMPL24


def drawn(kind, n=600, seed=0):
    return sampling.sample_rotations(np.random.default_rng(seed), n, mix={kind: 1}).rotations


def test_frames_are_forward_kinematics():
    rotations = sampling.sample_rotations(np.random.default_rng(0), 200).rotations
    turned, joints = contact.body_frames(rotations)
    rest = retarget.mean_adult_joints()[None]
    slow_turned, slow_joints = rig.forward_kinematics(SMPL24.parents, rest, rotations, np.zeros((200, 3)))
    np.testing.assert_allclose(turned, slow_turned, atol=1e-5)
    np.testing.assert_allclose(joints, slow_joints, atol=1e-5)


def test_soles_are_the_meshs():
    """The lowest of a foot's points is where the shipped body's lowest vertex is."""
    body = rig.load_rig()
    mean = body.coefficients[body.age >= 18].mean(0, keepdims=True)
    rotations = drawn("walk", 60)
    rest = body.rest(np.repeat(mean, 60, 0))
    vertices = rig.pose_bodies(body, rest, rotations, np.zeros((60, 3)))[0]
    points = contact.sole_points(rotations).reshape(60, 8, 3)
    np.testing.assert_allclose(points[..., 2].min(1), vertices[..., 2].min(1), atol=0.012)


@pytest.mark.parametrize("kind", balance.STATIC)
def test_standing_and_kneeling_people_are_in_balance(kind):
    rotations = drawn(kind)
    joints = contact.body_frames(rotations)[1]
    points = balance._ground_points(rotations, joints)
    off = np.linalg.norm(balance.overhang(contact.mass_center(joints), points, 0.0), axis=1)
    assert (off > 0.005).mean() < 0.01


@pytest.mark.parametrize("kind, usual, most", [("idle", 0.003, 0.01), ("crouch", 0.015, 0.06), ("bend", 0.01, 0.03)])
def test_both_feet_are_on_the_ground(kind, usual, most):
    low = contact.sole_points(drawn(kind))[..., 2].min(2)
    apart = np.abs(low[:, 0] - low[:, 1])
    assert np.percentile(apart, 95) < usual and np.percentile(apart, 99) < most


def test_what_balance_changes():
    """Without it bending people topple; others keep their angles."""
    rng = np.random.default_rng(1)
    kind = np.repeat([activities.KINDS.index("bend"), activities.KINDS.index("sport")], 200)
    angles = sampling._angles(latents.draw_latents(rng, kind)).angles
    before = angles.copy()
    after = balance.balanced(angles, kind)
    np.testing.assert_array_equal(angles, before)
    np.testing.assert_array_equal(after[200:], before[200:])

    def off(angles):
        rotations = joint_angles.rotations_from_angles(angles[:200])
        joints = contact.body_frames(rotations)[1]
        points = balance._ground_points(rotations, joints)
        return np.linalg.norm(balance.overhang(contact.mass_center(joints), points, 0.0), axis=1)

    assert (off(before) > 0.01).mean() > 0.4 and (off(after) > 0.01).mean() < 0.02


def test_overhang_of_a_square():
    square = np.array([[[x, y, 0.0] for x in (-0.1, 0.1) for y in (-0.1, 0.1)]])
    raised = square + [0.0, 0, 1]
    for at, margin, want in (((0.05, 0.0), 0.0, 0.0), ((0.15, 0.0), 0.0, -0.05), ((0.15, 0.0), 0.02, -0.07)):
        center = np.array([[*at, 1.0]])
        np.testing.assert_allclose(balance.overhang(center, square, margin), [[want, 0]], atol=1e-6)
        # what hangs in the air above bears nothing
        both = np.concatenate([square, raised + [1.0, 0, 0]], 1)
        np.testing.assert_allclose(balance.overhang(center, both, margin)[0], [want, 0], atol=2e-3)


def test_the_center_of_mass_of_the_rest_pose():
    """Of a standing adult 55 to 58 % of the height, arms up a little more; the shares sum to one."""
    joints = retarget.mean_adult_joints()[None]
    height = contact.mass_center(joints)[0, 2] + 0.97
    assert 0.55 < height / 1.70 < 0.61
    np.testing.assert_allclose(contact.mass_center(joints + [1.0, 2, 3]) - contact.mass_center(joints), [[1, 2, 3]])


# self-penetration


def apart_reference(a, b, steps=400):
    """Least distance of two segments, on a grid of points of them."""
    t = np.linspace(0, 1, steps)[:, None]
    p, q = (s[0] + t * (s[1] - s[0]) for s in (a, b))
    return np.linalg.norm(p[:, None] - q, axis=-1).min()


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_distances_of_segments(seed):
    a, b = np.random.default_rng(seed).normal(size=(2, 2, 3))
    found = contact._segment_distance(a[None].astype(np.float32), b[None].astype(np.float32))[0]
    assert abs(found - apart_reference(a, b)) < 0.02


def test_a_hand_in_the_belly_is_deep_and_the_rest_pose_is_free():
    rest = np.repeat(np.eye(3, dtype=np.float32)[None, None], 24, 1)
    assert contact.self_collision(contact.capsule_ends(*contact.body_frames(rest))).max() < 0
    bent = rest.copy()
    shoulder, elbow = SMPL24.index("left_shoulder"), SMPL24.index("left_elbow")
    bent[0, shoulder] = axis_angle_to_matrix(np.array([-1.4, 0, 0]))
    bent[0, elbow] = axis_angle_to_matrix(np.array([0, 0, -0.3]))
    bent[0, elbow] = axis_angle_to_matrix(np.array([-1.5, 0, 0])) @ bent[0, elbow]
    assert contact.self_collision(contact.capsule_ends(*contact.body_frames(bent))).max() > 0.05


def test_few_bodies_pass_through_themselves():
    rotations = sampling.sample_rotations(np.random.default_rng(3), 5000).rotations
    depth = contact.self_collision(contact.capsule_ends(*contact.body_frames(rotations))).max(1)
    assert (depth > 0.02).mean() < 0.01
    rng = np.random.default_rng(3)
    raw = sampling._angles(
        latents.draw_latents(rng, rng.choice(len(activities.KINDS), 5000, p=activities.SHARES))
    ).angles
    ends = contact.capsule_ends(*contact.body_frames(joint_angles.rotations_from_angles(raw)))
    assert (contact.self_collision(ends).max(1) > 0.02).mean() > 0.05  # so there is something to do


def test_what_does_not_slide_carries_the_body():
    """A point that stays on the ground while the pelvis goes over it says how far it went."""
    t = np.linspace(0, 1, 11)
    planted = np.stack([0.3 - t, 0.1 + 0 * t, -1 + 0 * t], -1)
    swinging = np.stack([t, -0.1 + 0 * t, -0.9 + 0 * t], -1)
    way = contact.planted_way(np.stack([planted, swinging], 1)[None])
    np.testing.assert_allclose(way[0], np.stack([t, 0 * t, 0 * t], -1), atol=1e-4)


def test_the_ground_offset_is_the_height_over_the_lowest_vertex():
    np.testing.assert_allclose(contact.ground_offset(np.array([-0.9, -0.8]), np.array([0.0, 0.03])), [0.9, 0.83])
    assert contact.ground_offset(-0.97) == 0.97
