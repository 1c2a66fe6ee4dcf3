"""The body as capsules and soles: self-collision, contact with the ground, and where the mass is.

n poses on the mean adult, C capsules, Q pairs. Frame: x forward, y left, z up, the pelvis at the origin. Meters.
"""

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


# the sole seen from the ankle joint, m: heel, inner and outer ball, toes; the left foot's, measured on the shipped mesh
_SOLE = np.array([[-0.05, 0.0, -0.077], [0.10, -0.045, -0.077], [0.10, 0.045, -0.077], [0.19, -0.01, -0.074]])
_LEGS = np.array([[_J[f"{side}_{name}"] for name in ("hip", "knee", "ankle")] for side in ("left", "right")])
# a point bears weight within about this height of the lowest one, m
_BEARING = 0.008


def _capsules() -> tuple[np.ndarray, ...]:
    """Joint (C,), ends (C, 2, 3) and radius (C,) m of the capsules; pairs (Q, 2) that could collide."""
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
    joint, *ends, radius = (np.array(column) for column in zip(*table.values(), strict=True))
    return joint, np.stack(ends, 1).astype(np.float32), radius.astype(np.float32), np.array(pairs)


_JOINT, _ENDS, _RADIUS, _PAIRS = _capsules()


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


def capsule_ends(rotations: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """The capsules' ends (n, C, 2, 3) m of posed bodies, from `body_frames`."""
    return joints[:, _JOINT, None] + _ENDS @ np.swapaxes(rotations[:, _JOINT], -1, -2)


def undersides(ends: np.ndarray) -> np.ndarray:
    """ends (n, C, 2, 3) -> (n, 2 C, 3) m: the lowest point of the ball at each end of each capsule."""
    low = ends - _RADIUS[:, None, None] * np.array([0, 0, 1], np.float32)
    return low.reshape(len(ends), 2 * len(_JOINT), 3)


def self_collision(ends: np.ndarray) -> np.ndarray:
    """How deep parts that should not touch are in each other, (n, Q) m, negative where they are apart."""
    a, b = ends[:, _PAIRS[:, 0]], ends[:, _PAIRS[:, 1]]
    return _RADIUS[_PAIRS].sum(1) - _segment_distance(a, b)


def mass_center(joints: np.ndarray) -> np.ndarray:
    """joints (n, 24, 3) -> (n, 3) m. Segments after de Leva 1996, Adjustments to Zatsiorsky-Seluyanov's segment
    inertia parameters."""
    return np.einsum("j,njk->nk", _MASS_OF_JOINTS, joints)


def _segment_distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Least distance (...) of segments a and b (..., 2, 3): nearest points of the lines, clamped (Ericson,
    Real-Time Collision Detection, 5.1.9)."""
    start, other = a[..., 0, :], b[..., 0, :]
    u, v, w = a[..., 1, :] - start, b[..., 1, :] - other, start - other
    ones = np.ones(3, np.float32)
    uu, vv, uv, uw, vw = ((x * y) @ ones for x, y in ((u, u), (v, v), (u, v), (u, w), (v, w)))
    s = np.clip((uv * vw - uw * vv) / np.maximum(uu * vv - uv * uv, 1e-9), 0, 1)
    t = np.clip((uv * s + vw) / vv, 0, 1)
    s = np.clip((uv * t - uw) / uu, 0, 1)
    apart = w + s[..., None] * u - t[..., None] * v
    return np.sqrt((apart * apart) @ ones)


@cache
def _leg_offsets() -> tuple[np.ndarray, ...]:
    """Of the left and the right leg, float32 m: from the pelvis to the hip, from the hip to the knee, from the knee to
    the ankle, each (2, 3), and from the ankle to the sole's points (2, 4, 3)."""
    rest = mean_adult_joints()
    hip, knee, ankle = (rest[_LEGS[:, k]] for k in range(3))
    sole = np.stack([_SOLE, _SOLE * [1, -1, 1]])
    return tuple(np.asarray(v, np.float32) for v in (hip, knee - hip, ankle - knee, sole))


def sole_points(rotations: np.ndarray) -> np.ndarray:
    """rotations (n, 24, 3, 3) -> (n, 2, 4, 3) float32 m: heel, inner and outer ball and toes of the left and the right
    foot, seen from the pelvis; the foot is stiff."""
    to_hip, to_knee, to_ankle, sole = _leg_offsets()
    root = rotations[:, None, 0]
    thigh = root @ rotations[:, _LEGS[:, 0]]
    shank = thigh @ rotations[:, _LEGS[:, 1]]
    foot = shank @ rotations[:, _LEGS[:, 2]]
    ankle = (root @ to_hip[..., None] + thigh @ to_knee[..., None] + shank @ to_ankle[..., None])[..., 0]
    return ankle[:, :, None] + sole @ np.swapaxes(foot, -1, -2)


def bearing(points: np.ndarray) -> np.ndarray:
    """points (..., P, 3) of a body -> (..., P): shares of the weight by height, the lowest most; they sum to 1."""
    height = points[..., 2]
    share = np.exp((height.min(-1, keepdims=True) - height) / np.float32(_BEARING))
    return share / share.sum(-1, keepdims=True)


def planted_way(points: np.ndarray) -> np.ndarray:
    """The way (n, T, 3) m of the body if the points that bear it do not slide; z is 0.

    points (n, T, P, 3) m seen from the pelvis in axes that do not turn, T close moments; the way starts at 0.
    """
    share = bearing(points)
    share = (share[:, 1:] + share[:, :-1]) / 2
    way = np.zeros((*points.shape[:2], 3), points.dtype)
    np.cumsum(-np.einsum("ntp,ntpk->ntk", share, np.diff(points[..., :2], axis=1)), 1, out=way[:, 1:, :2])
    return way


def walked_way(pace: np.ndarray, strides: np.ndarray, course: np.ndarray) -> np.ndarray:
    """The way (n, T, 2) m over the ground of people who make `pace` (n, T) m a stride, have made `strides` (n, T) and
    head for `course` (n, T) rad."""
    way = np.zeros((*pace.shape, 2))
    middle = (course[:, 1:] + course[:, :-1]) / 2
    step = (pace[:, 1:] + pace[:, :-1]) / 2 * np.diff(strides, axis=1)
    np.cumsum(step[..., None] * np.stack([np.cos(middle), np.sin(middle)], -1), 1, out=way[:, 1:])
    return way


def ground_offset(lowest: np.ndarray, clearance: np.ndarray | float = 0.0) -> np.ndarray:
    """Height m of the pelvis above flat ground, of bodies whose lowest vertex is at z = `lowest` (...) m seen from the
    pelvis and `clearance` (...) m above the ground: 0 for who stands, more for a runner between two steps."""
    return np.asarray(clearance) - np.asarray(lowest)
