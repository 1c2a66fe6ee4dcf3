"""Feet and ground: where the soles are, and how far feet that do not slide carry the body.

n poses on the mean adult. Frame: x forward, y left, z up, the pelvis at the origin. Metres.
"""

from functools import cache

import numpy as np

from lidarpose.body.mocap.retarget import mean_adult_joints
from lidarpose.skeleton import SMPL24

# the sole seen from the ankle joint, m: heel, inner and outer ball, toes; the left foot's, measured on the shipped mesh
_SOLE = np.array([[-0.05, 0.0, -0.077], [0.10, -0.045, -0.077], [0.10, 0.045, -0.077], [0.19, -0.01, -0.074]])
_LEGS = np.array([[SMPL24.index(f"{side}_{name}") for name in ("hip", "knee", "ankle")] for side in ("left", "right")])
# a sole's point bears weight within about this height of the lowest one, m
_BEARING = 0.008


@cache
def _offsets() -> tuple[np.ndarray, ...]:
    """Of the left and the right leg, float32 m: from the pelvis to the hip, from the hip to the knee, from the knee to
    the ankle, each (2, 3), and from the ankle to the sole's points (2, 4, 3)."""
    rest = mean_adult_joints()
    hip, knee, ankle = (rest[_LEGS[:, k]] for k in range(3))
    sole = np.stack([_SOLE, _SOLE * [1, -1, 1]])
    return tuple(np.asarray(v, np.float32) for v in (hip, knee - hip, ankle - knee, sole))


def sole_points(rotations: np.ndarray) -> np.ndarray:
    """rotations (n, 24, 3, 3) -> (n, 2, 4, 3) float32 m: heel, inner and outer ball and toes of the left and the right
    foot, seen from the pelvis; the foot is stiff."""
    to_hip, to_knee, to_ankle, sole = _offsets()
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


def pinned(points: np.ndarray) -> np.ndarray:
    """The way (n, T, 3) m of the body if the points that bear it do not slide; z is 0.

    points (n, T, P, 3) m seen from the pelvis in axes that do not turn, T close moments; the way starts at 0.
    """
    share = bearing(points)
    share = (share[:, 1:] + share[:, :-1]) / 2
    way = np.zeros((*points.shape[:2], 3), points.dtype)
    np.cumsum(-np.einsum("ntp,ntpk->ntk", share, np.diff(points[..., :2], axis=1)), 1, out=way[:, 1:, :2])
    return way


def walked(pace: np.ndarray, strides: np.ndarray, course: np.ndarray) -> np.ndarray:
    """The way (n, T, 2) m over the ground of people who make `pace` (n, T) m a stride, have made `strides` (n, T) and
    head for `course` (n, T) rad."""
    way = np.zeros((*pace.shape, 2))
    middle = (course[:, 1:] + course[:, :-1]) / 2
    step = (pace[:, 1:] + pace[:, :-1]) / 2 * np.diff(strides, axis=1)
    np.cumsum(step[..., None] * np.stack([np.cos(middle), np.sin(middle)], -1), 1, out=way[:, 1:])
    return way


def stand(lowest: np.ndarray, clearance: np.ndarray | float = 0.0) -> np.ndarray:
    """How high the pelvis goes above flat ground, m: with its lowest vertex, seen from the pelvis at `lowest` (...) m,
    `clearance` (...) m above the ground (`motion.DrawnClips`): 0 for who stands, more for a runner between two steps.
    Add to all z of a body whose pelvis is at 0."""
    return np.asarray(clearance) - np.asarray(lowest)
