"""The body as capsules: what may not pass through what, where it touches the ground, and where its weight is.

n poses on the mean adult, C capsules, Q pairs. Frame: x forward, y left, z up, the pelvis at the origin. Metres.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from lidarpose.body.mocap.retarget import mean_adult_joints
from lidarpose.skeleton import SMPL24

# capsule: joint that carries it, its two ends seen from the joint at rest (T-pose), radius; m, measured on the shipped
# mesh's mean adult. Trunk and head lie across, of the left limbs the right ones are the mirror image. Upper arms and
# thighs leave out the half that touches the trunk in every pose.
_TRUNK = {
    "pelvis": ("pelvis", (0.0, -0.08, -0.05), (0.0, 0.08, -0.05), 0.100),
    "belly": ("spine1", (0.05, -0.05, 0.03), (0.05, 0.05, 0.03), 0.098),
    "ribs": ("spine3", (0.055, -0.06, 0.02), (0.055, 0.06, 0.02), 0.102),
    "head": ("head", (0.022, 0.0, 0.03), (0.022, 0.0, 0.11), 0.082),
}
_LIMBS = {
    "upper_arm": ("shoulder", (0.0, 0.12, 0.0), (0.0, 0.25, 0.0), 0.042),
    "forearm": ("elbow", (0.0, 0.02, 0.0), (0.0, 0.231, 0.0), 0.032),
    "hand": ("wrist", (0.01, 0.03, -0.015), (0.01, 0.10, -0.02), 0.032),
    "thigh": ("hip", (0.015, 0.02, -0.14), (0.01, 0.02, -0.38), 0.062),
    "shank": ("knee", (-0.03, 0.0, -0.06), (-0.035, 0.005, -0.36), 0.048),
    "foot": ("ankle", (-0.02, 0.0, -0.045), (0.16, 0.0, -0.05), 0.036),
}
# what could touch what on a moving body: (a, b), limbs of one side with the same side's, and with the other side's
_SAME_SIDE = (
    ("forearm", "pelvis"), ("forearm", "belly"), ("forearm", "ribs"), ("forearm", "head"), ("hand", "pelvis"),
    ("hand", "belly"), ("hand", "ribs"), ("hand", "head"), ("hand", "upper_arm"), ("forearm", "thigh"),
    ("hand", "thigh"), ("hand", "shank"), ("upper_arm", "head"), ("upper_arm", "belly"),
)  # fmt: skip
_ACROSS = (
    ("forearm", "forearm"), ("hand", "hand"), ("thigh", "thigh"), ("shank", "shank"), ("foot", "foot"),
    ("hand", "forearm"), ("hand", "upper_arm"), ("hand", "thigh"), ("forearm", "thigh"), ("hand", "shank"),
    ("thigh", "shank"), ("shank", "foot"), ("thigh", "foot"),
)  # fmt: skip
# shares of the body's mass and where on a segment its center is: de Leva 1996, means of women and men; the trunk's
# three parts on our joints
_MASS = (
    (0.068, "head", "head", 0.0), (0.13, "pelvis", "spine1", 0.0), (0.155, "spine1", "spine2", 0.8),
    (0.157, "spine3", "neck", 0.4), *((share, f"{side}_{a}", f"{side}_{b}", at) for side in ("left", "right")
    for share, a, b, at in (
        (0.0263, "shoulder", "elbow", 0.576), (0.0150, "elbow", "wrist", 0.457), (0.0059, "wrist", "hand", 0.7),
        (0.1447, "hip", "knee", 0.385), (0.0457, "knee", "ankle", 0.443), (0.0133, "ankle", "foot", 0.5))),
)  # fmt: skip
_J = {name: i for i, name in enumerate(SMPL24.joints)}


@dataclass(frozen=True, kw_only=True)
class _Capsules:
    """joint (C,), ends (C, 2, 3) and radius (C,) float32 m; pairs (Q, 2) and how near their axes may come, (Q,) m."""

    joint: np.ndarray
    ends: np.ndarray
    radius: np.ndarray
    pairs: np.ndarray
    near: np.ndarray


def _capsules() -> _Capsules:
    table = {name: (_J[joint], a, b, radius) for name, (joint, a, b, radius) in _TRUNK.items()}
    for side, sign in (("left", 1), ("right", -1)):
        for name, (joint, a, b, radius) in _LIMBS.items():
            mirrored = [(x, sign * y, z) for x, y, z in (a, b)]
            table[f"{side}_{name}"] = (_J[f"{side}_{joint}"], *mirrored, radius)
    names = {name: i for i, name in enumerate(table)}
    pairs = []
    for side, other in (("left", "right"), ("right", "left")):
        pairs += [(names[f"{side}_{a}"], names[b if b in _TRUNK else f"{side}_{b}"]) for a, b in _SAME_SIDE]
        pairs += [(names[f"{side}_{a}"], names[f"{other}_{b}"]) for a, b in _ACROSS if side == "left" or a != b]
    joint, *ends, radius = zip(*table.values(), strict=True)
    radius, pairs = np.array(radius, np.float32), np.array(pairs)
    return _Capsules(
        joint=np.array(joint),
        ends=np.stack([np.array(e, np.float32) for e in ends], 1),
        radius=radius,
        pairs=pairs,
        near=radius[pairs].sum(1),
    )


_CAPSULES = _capsules()


def _mass_of_joints() -> np.ndarray:
    share = np.zeros(24, np.float32)
    for mass, a, b, at in _MASS:
        share[_J[a]] += mass * (1 - at)
        share[_J[b]] += mass * at
    return share / share.sum()


_MASS_OF_JOINTS = _mass_of_joints()


def _levels() -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """The joints of each depth of the tree below the root, and their parents."""
    parents = np.array(SMPL24.parents)
    depth = np.zeros(24, int)
    for joint, parent in enumerate(SMPL24.parents[1:], 1):
        depth[joint] = depth[parent] + 1
    rows = [np.flatnonzero(depth == d) for d in range(1, depth.max() + 1)]
    return tuple((row, parents[row]) for row in rows)


_LEVELS = _levels()


@cache
def _bones() -> np.ndarray:
    """(24, 3, 1) float32 m: from each joint's parent to it at rest."""
    rest = mean_adult_joints()
    parents = np.array(SMPL24.parents)
    parents[0] = 0  # the root is at the origin
    return np.ascontiguousarray((rest - rest[parents])[..., None], np.float32)


def body_frames(rotations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """rotations (n, 24, 3, 3) local -> global rotations (n, 24, 3, 3) and joints (n, 24, 3) m of the mean adult.

    `rig.forward_kinematics` a level of the tree at a time, float32.
    """
    # rotation and bone in one 3 x 4 matrix: half the products
    local = np.empty((len(rotations), 24, 3, 4), np.float32)
    local[..., :3], local[..., 3:] = rotations, _bones()
    frames = local.copy()
    for rows, parents in _LEVELS:
        parent = frames[:, parents]
        frame = parent[..., :3] @ local[:, rows]
        frame[..., 3] += parent[..., 3]
        frames[:, rows] = frame
    return frames[..., :3], frames[..., 3]


def capsule_ends(turned: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """The capsules' ends (n, C, 2, 3) m of posed bodies (`body_frames`)."""
    c = _CAPSULES
    return joints[:, c.joint, None] + c.ends @ np.swapaxes(turned[:, c.joint], -1, -2)


def undersides(ends: np.ndarray) -> np.ndarray:
    """ends (n, C, 2, 3) -> (n, 2 C, 3) m: the lowest point of the ball at each end of each capsule."""
    low = ends - _CAPSULES.radius[:, None, None] * np.array([0, 0, 1], np.float32)
    return low.reshape(len(ends), 2 * len(_CAPSULES.joint), 3)


def depths(ends: np.ndarray) -> np.ndarray:
    """How deep parts that should not touch are in each other, (n, Q) m, negative where they are apart."""
    c = _CAPSULES
    a, b = ends[:, c.pairs[:, 0]], ends[:, c.pairs[:, 1]]
    return c.near - _segments_apart(a, b)


def mass_center(joints: np.ndarray) -> np.ndarray:
    """joints (n, 24, 3) -> (n, 3) m. Segments after de Leva 1996, Adjustments to Zatsiorsky-Seluyanov's segment
    inertia parameters."""
    return np.einsum("j,njk->nk", _MASS_OF_JOINTS, joints)


def _segments_apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Least distance (...) of segments a and b (..., 2, 3): nearest points of the lines, clamped (Ericson,
    Real-Time Collision Detection, 5.1.9)."""
    start, other = a[..., 0, :], b[..., 0, :]
    u, v, w = a[..., 1, :] - start, b[..., 1, :] - other, start - other
    uu, vv, uv, uw, vw = ((x * y) @ _ONES for x, y in ((u, u), (v, v), (u, v), (u, w), (v, w)))
    s = np.clip((uv * vw - uw * vv) / np.maximum(uu * vv - uv * uv, 1e-9), 0, 1)
    t = np.clip((uv * s + vw) / vv, 0, 1)
    s = np.clip((uv * t - uw) / uu, 0, 1)
    apart = w + s[..., None] * u - t[..., None] * v
    return np.sqrt((apart * apart) @ _ONES)


_ONES = np.ones(3, np.float32)
