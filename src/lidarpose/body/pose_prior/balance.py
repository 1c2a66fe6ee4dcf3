"""People who stand or kneel: both feet on the floor, the weight over them.

Corrections are continuous in the pose, so they may be made moment by moment. Angles (n, 27) in degrees, in the order
of `activities.ANGLES`; lengths in meters, of the mean adult.
"""

from functools import cache

import numpy as np

from lidarpose.body.mocap.retarget import mean_adult_joints
from lidarpose.body.pose_prior.activities import ANGLE_INDEX, KINDS, LIMITS
from lidarpose.body.pose_prior.contact import body_frames, mass_center, sole_points
from lidarpose.body.pose_prior.joint_angles import rotations_from_angles
from lidarpose.skeleton import SMPL24

# kinds that stand on both feet or on a foot and a knee, and keep their balance
STATIC = ("idle", "crouch", "bend", "kneel")
_STATIC = np.array([name in STATIC for name in KINDS])
_KNEEL = KINDS.index("kneel")
_HIP, _KNEE, _ANKLE, _ABD = (
    np.array([ANGLE_INDEX[f"{side}_{name}"] for side in ("left", "right")]) for name in ("hip", "knee", "ankle", "abd")
)
_LEGS = np.array([[SMPL24.index(f"{side}_{name}") for side in ("left", "right")] for name in ("hip", "knee", "ankle")])
_KNEE_RADIUS = 0.055  # m, of the shipped body in front of the joint
_MARGIN = 0.03  # m: the center of mass stays so far inside the feet's outline
# a point bears nothing once it is so high above the lowest one, m, and counts for less this steeply
_TOUCHING, _FADE = 0.03, 4.0
# directions in which the outline of the feet is taken
_AROUND = np.stack([f(np.arange(16) * np.pi / 8) for f in (np.cos, np.sin)]).astype(np.float32)
# how far the center of mass goes when a kneeling body's trunk leans, m a radian: 2/3 of the mass, 0.4 m up
_TRUNK_LEAN = 0.27


def balanced(angles: np.ndarray, kind: np.ndarray) -> np.ndarray:
    """The poses (n, 27) with those of the static kinds on both feet (or a foot and a knee) and in balance.

    The body leans about its ankles (kneeling: its trunk about the hips) until its center of mass is over the outline
    of what it stands on; the leg that reaches lower bends more, or the front leg of a kneeling body reaches to the
    ground. One linear step, whose error is millimeters.
    """
    rows = np.flatnonzero(_STATIC[kind])
    if not len(rows):
        return angles
    part, kneel = angles[rows], kind[rows] == _KNEEL
    rotations = rotations_from_angles(part)
    joints = body_frames(rotations)[1]
    points = _ground_points(rotations, joints)
    center = mass_center(joints)
    lean = _lean(part, overhang(center, _bearing_points(part, points, kneel)), center, joints, kneel)
    # the lean changes the feet's heights too: the soles stay level to the front
    points[:, :8, 2] -= np.repeat(joints[:, _LEGS[2], 0], 4, 1) * lean[:, :1]
    points[:, :8, 2] -= (points[:, :8, 1] - np.repeat(joints[:, _LEGS[0], 1], 4, 1)) * lean[:, 1:]
    _level_feet(part, joints, points, kneel)
    angles = angles.copy()
    angles[rows] = np.clip(part, LIMITS[0], LIMITS[1])
    return angles


def overhang(center: np.ndarray, points: np.ndarray, margin: float = _MARGIN) -> np.ndarray:
    """center (n, 3) of mass, points (n, P, 3) that may bear it -> (n, 2) m: the way the center must go for it to lie
    `margin` inside the outline of the lowest points; 0 where it does."""
    height = points[..., 2] - points[..., 2].min(1, keepdims=True)
    light = _FADE * np.maximum(height - _TOUCHING, 0)
    flat = points[..., :2]
    share = np.exp(-light / 0.05)[..., None]
    middle = (share * flat).sum(1) / share.sum(1)
    outline = (flat @ _AROUND - light[..., None]).max(1)
    room, wide = outline - center[:, :2] @ _AROUND, outline - middle @ _AROUND
    share = np.clip((margin - room) / np.maximum(wide - room, 1e-4), 0, 1).max(1)
    return share[:, None] * (middle - center[:, :2])


def _ground_points(rotations: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """(n, 10, 3) m: the soles' points, left foot first, and the undersides of the knees."""
    knees = joints[:, _LEGS[1]] - np.array([0, 0, _KNEE_RADIUS], np.float32)
    return np.concatenate([sole_points(rotations).reshape(len(joints), 8, 3), knees], 1)


def _bearing_points(part: np.ndarray, points: np.ndarray, kneel: np.ndarray) -> np.ndarray:
    """The points that will bear the body when it is level: of one that kneels both soles and the knee behind."""
    rows = np.flatnonzero(kneel)
    points = points.copy()
    points[rows, :, 2] = 0
    points[rows, 8 + part[rows][:, _HIP].argmax(1), 2] = 1
    return points


@cache
def _lengths() -> tuple[float, float]:
    rest = mean_adult_joints()[_LEGS[:, 0]]
    thigh, shank = np.linalg.norm(np.diff(rest, axis=0), axis=1)
    return float(thigh), float(shank)


def _level_feet(part: np.ndarray, joints: np.ndarray, points: np.ndarray, kneel: np.ndarray) -> None:
    """Bends legs, in place, so that both feet, or the front foot and the other knee, are equally low."""
    thigh, shank = _lengths()
    low = np.stack([points[:, :4, 2].min(1), points[:, 4:8, 2].min(1)], 1)
    up = low.max(1, keepdims=True) - low
    i = np.flatnonzero(kneel)
    if len(i):
        front = part[i][:, _HIP].argmax(1)
        rear = 1 - front
        floor = points[i, 8 + rear, 2]
        up[i] = 0
        up[i, front] = floor - low[i, front]
        # the toes behind touch the floor beside the knee
        part[i, _KNEE[rear]] += np.degrees((floor - low[i, rear]) / shank)
    leg = joints[:, _LEGS[2]] - joints[:, _LEGS[0]]
    reach = np.linalg.norm(leg, axis=-1)
    steep = np.maximum(-leg[..., 2] / reach, 0.5)
    knee, fold = _triangle(reach, thigh, shank)
    new_knee, new_fold = _triangle(np.clip(reach - up / steep, 0.3, 0.9985 * (thigh + shank)), thigh, shank)
    knee, fold = np.where(up != 0, new_knee - knee, 0), np.where(up != 0, new_fold - fold, 0)
    part[:, _KNEE] += knee
    part[:, _HIP] += fold
    part[:, _ANKLE] += knee - fold


def _triangle(reach: np.ndarray, thigh: float, shank: float) -> tuple[np.ndarray, np.ndarray]:
    """Bend of the knee and angle between thigh and the line from hip to ankle, degrees, at a reach m."""
    bend = np.arccos(np.clip((reach**2 - thigh**2 - shank**2) / (2 * thigh * shank), -1, 1))
    return np.degrees(bend), np.degrees(np.arctan2(shank * np.sin(bend), thigh + shank * np.cos(bend)))


def _lean(part: np.ndarray, way: np.ndarray, center: np.ndarray, joints: np.ndarray, kneel: np.ndarray) -> np.ndarray:
    """Leans bodies, in place, so that their centers of mass go `way` (n, 2) m. Returns how far legs turn, (n, 2) rad,
    forwards with the body and to the left under it."""
    height = np.maximum(center[:, 2] - joints[:, _LEGS[2], 2].min(1), 0.3)
    forward, left = way[:, 0] / np.where(kneel, _TRUNK_LEAN, height), way[:, 1] / height
    degrees = np.degrees(forward)
    part[:, ANGLE_INDEX["tilt"]] += degrees
    # the body turns about its ankles, or the trunk about the hips
    part[:, _ANKLE] += np.where(kneel, 0, degrees)[:, None]
    part[:, _HIP] += np.where(kneel, degrees, 0)[:, None]
    part[:, _ABD] += np.degrees(left)[:, None] * np.array([-1, 1])
    return np.stack([np.where(kneel, 0, forward), left], 1)
