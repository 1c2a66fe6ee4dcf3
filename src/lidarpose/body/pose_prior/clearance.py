"""Moves limbs out of their own body: motion recorded from other people does not account for a body's girth.

The body is modeled by capsules, as in `constraints`: trunk, head and thighs are measured on each person's mesh and
clothes; forearms, hands and shanks are placed about their bones. Arms turn at shoulder and elbow, legs at the hip, by
the smallest necessary angle.

n people, F frames, C capsules. Meters; local rotations as in `rig`.
"""

from functools import cache

import numpy as np

from lidarpose.body.pose_prior.constraints import between_segments, body_frames, capsule_ends, self_collision
from lidarpose.body.rig import RestBody, Rig
from lidarpose.geometry import axis_angle_to_matrix
from lidarpose.skeleton import SMPL24

_J = {name: i for i, name in enumerate(SMPL24.joints)}
_PARENTS = np.maximum(SMPL24.parents, 0)
_SIDES = ("left", "right")
# obstacles of the limbs: the joint that carries a capsule, the capsule's axis (1: y, across the trunk; 2: z), and the
# range of heights in which it is measured, m above the joint on the mean person
_SOLID = [
    ("pelvis", 1, -0.125, -0.055), ("pelvis", 1, -0.055, 0.015), ("spine1", 1, -0.075, -0.005),
    ("spine1", 1, 0.005, 0.075), ("spine2", 1, -0.045, 0.025), ("spine3", 1, -0.005, 0.065),
    ("spine3", 1, 0.055, 0.125), ("head", 2, 0.02, 0.12),
    *((f"{side}_hip", 2, *heights) for heights in ((-0.16, -0.04), (-0.34, -0.16)) for side in _SIDES),
]  # fmt: skip
# limbs, left before right: the joints at the ends of the bone, and the radius as a fraction of its length
_BONES = [
    (f"{side}_{a}", f"{side}_{b}", share)
    for a, b, share in (("elbow", "wrist", 0.09), ("wrist", "hand", 0.2), ("knee", "ankle", 0.09)) for side in _SIDES
]  # fmt: skip
_FOREARMS, _HANDS, _SHANKS = (len(_SOLID) + 2 * k + np.arange(2) for k in range(3))
_IS_TRUNK = np.array([axis == 1 for _, axis, *_ in _SOLID])
_CARRIER = np.array([_J[name] for name, *_ in _SOLID])
_BONE_ENDS = np.array([[_J[a], _J[b]] for a, b, _ in _BONES])
_BONE_RADIUS = np.array([share for *_, share in _BONES], np.float32)
# left arm, right arm, left leg, right leg: the two joints at which it turns, and their relative compliance
_TURNS = np.array(
    [[_J[f"{side}_{name}"] for name in names] for names in (("shoulder", "elbow"), ("hip", "knee")) for side in _SIDES]
)
_READY = np.array([[1.0, 0.5], [1.0, 0.5], [1.0, 0.0], [1.0, 0.0]], np.float32)[..., None]
# pairs (limb, obstacle) of each of the four, and the limits of its slice of `_PAIRS`
_ARM_PAIRS = [[(a[side], b) for a in (_FOREARMS, _HANDS) for b in range(len(_SOLID))] for side in (0, 1)]
_PAIRS = np.array([*_ARM_PAIRS[0], *_ARM_PAIRS[1], _SHANKS, _SHANKS[::-1]])
_SLICES = np.cumsum([0, len(_ARM_PAIRS[0]), len(_ARM_PAIRS[1]), 1, 1])
# depth by which flesh and cloth yield, and minimum depth of a contact, m
_GIVES, _CONTACT = 0.01, 0.004
# maximum number of steps, damping, m^2, and maximum step, rad
_STEPS, _DAMPING, _LONGEST = 6, 1e-3, 0.35
# number of times that a clip's step is averaged with those of the neighboring frames
_EVEN = 4


@cache
def _extremes(rig: Rig) -> np.ndarray:
    """Indices (2, 3, regions) of the vertices with the minimum and the maximum x, y and z in each region of `_SOLID`,
    on the mean person."""
    weight, extremes = rig.dense_weight, []
    in_arm = weight[:, [_J[f"{side}_{name}"] for side in _SIDES for name in ("shoulder", "elbow", "wrist", "hand")]]
    for name, axis, low, high in _SOLID:
        height = rig.template[:, 2] - rig.joint_template[_J[name], 2]
        is_part = in_arm.sum(1) < 0.4 if axis == 1 else weight.argmax(1) == _J[name]
        is_inside = (is_part & (low < height) & (height < high))[:, None]
        extremes.append([np.where(is_inside, sign * rig.template, np.inf).argmin(0) for sign in (1, -1)])
    return np.moveaxis(np.array(extremes), 0, -1)


def fitted_capsules(rig: Rig, people: RestBody, clothes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ends (n, S, 2, 3) m of the capsules of `_SOLID`, relative to the joints that carry them, and radii (n, C) m of
    all capsules, for people at rest with clothing offsets (n, V) m."""
    rows = _extremes(rig)
    low, high = (people.vertices[:, row.T, np.arange(3)] for row in rows)
    center, half = (low + high) / 2, (high - low) / 2
    # a trunk capsule takes its radius from the trunk's depth alone; thighs and head are nearly round
    radius = np.where(_IS_TRUNK, half[..., 0], (half[..., 0] + half[..., 1]) / 2)
    reach = np.zeros_like(half)
    reach[:, _IS_TRUNK, 1] = np.maximum(half[..., 1] - radius, 0.01)[:, _IS_TRUNK]
    reach[:, ~_IS_TRUNK, 2] = half[:, ~_IS_TRUNK, 2]
    center -= people.joints[:, _CARRIER]
    bones = people.joints[:, _BONE_ENDS[:, 1]] - people.joints[:, _BONE_ENDS[:, 0]]
    bone_radius = _BONE_RADIUS * np.linalg.norm(bones, axis=-1)
    ends = np.stack([center - reach, center + reach], 2)
    return ends, np.concatenate([radius + clothes[:, rows].mean((1, 2)), bone_radius], 1)


def cleared(
    rig: Rig, people: RestBody, clothes: np.ndarray, rotations: np.ndarray, rows: np.ndarray, *, is_clip: bool
) -> np.ndarray:
    """Moves forearms and hands out of trunk, head and thighs, and shanks out of each other.

    Args:
        rig, people, clothes: n people at rest, with clothing offsets (n, V) m.
        rotations: (n, F, 24, 3, 3), local.
        rows: Indices of the people to correct; the others are unchanged.
        is_clip: If true, each frame is corrected, smoothly in time; else all frames get the first one's correction.

    Returns:
        (n, F, 24, 3, 3) float32.
    """
    bones = (people.joints[:, : len(SMPL24)] - people.joints[:, _PARENTS])[..., None]
    body = bones, *fitted_capsules(rig, people, clothes)
    rotations = np.array(rotations, np.float32)
    frames = rotations.shape[1] if is_clip else 1
    for _ in range(_STEPS):
        step = _step(rotations[rows, :frames].reshape(-1, 24, 3, 3), *(np.repeat(v[rows], frames, 0) for v in body))
        step = step.reshape(len(rows), frames, *step.shape[1:])
        is_moved = step.any((1, 2, 3, 4))
        if not is_moved.any():
            break
        rows, step = rows[is_moved], step[is_moved]
        for _ in range(_EVEN if is_clip else 0):
            padded = np.concatenate([step[:, :1], step, step[:, -1:]], 1)
            step = (padded[:, :-2] + 2 * padded[:, 1:-1] + padded[:, 2:]) / 4
        turn = axis_angle_to_matrix(step).astype(np.float32)
        poses = rotations[rows]
        poses[:, :, _TURNS] = turn @ poses[:, :, _TURNS]
        rotations[rows] = poses
    return rotations


def _step(rotations: np.ndarray, bones: np.ndarray, ends: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Rotation vectors (m, 4, 2, 3) rad at `_TURNS`, in the parent bone's frame, that move the deepest capsule of each
    limb out of its obstacle; rotations (m, 24, 3, 3)."""
    global_rotations, joints = body_frames(rotations, bones)
    ends = np.concatenate([capsule_ends(global_rotations, joints, _CARRIER, ends), joints[:, _BONE_ENDS]], 1)
    depth = self_collision(ends, radius, _PAIRS) - _GIVES
    deepest = np.stack([a + depth[:, a:b].argmax(1) for a, b in zip(_SLICES, _SLICES[1:], strict=False)], 1)
    depth = np.take_along_axis(depth, deepest, 1)
    step = np.zeros((len(depth), *_TURNS.shape, 3), np.float32)
    row, limb = np.nonzero(depth > _CONTACT)
    a, b = (ends[row, capsule] for capsule in _PAIRS[deepest[row, limb]].T)
    way, share = between_segments(a, b)
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-6)
    lever = (a[:, 0] + share[:, None] * (a[:, 1] - a[:, 0]))[:, None] - joints[row[:, None], _TURNS[limb]]
    jacobian = np.cross(lever, way[:, None]) * _READY[limb]
    turn = jacobian * (depth[row, limb] / ((jacobian**2).sum((1, 2)) + _DAMPING))[:, None, None] * _READY[limb]
    turn *= np.minimum(1, _LONGEST / np.maximum(np.linalg.norm(turn, axis=-1, keepdims=True), 1e-6))
    above = global_rotations[row[:, None], _PARENTS[_TURNS[limb]]]
    step[row, limb] = (turn[..., None, :] @ above)[..., 0, :]
    return step
