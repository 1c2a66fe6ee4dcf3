"""The pose prior's tables as arrays, from assets/pose_prior.toml, which documents them; and the conversion of a pose's
27 angles (`ANGLES`) to rotations of the body's 24 bones.

K kinds of activity, A kinds of arm. All angles are degrees.
"""

import tomllib
from importlib import resources

import numpy as np

from lidarpose.geometry import rotation_about
from lidarpose.skeleton import SMPL24

TABLES = tomllib.loads(resources.files("lidarpose.body").joinpath("assets/pose_prior.toml").read_text("utf-8"))
_ACTIVITIES, _ARMS = TABLES["activities"].values(), TABLES["arms"].values()

_TRUNK = ("tilt", "roll", "yaw", "bend", "side", "twist", "nod", "neck_side", "neck_twist")
_LEG = ("hip", "abd", "rot", "knee", "ankle")
ARM_ANGLES = ("raise", "out", "in", "elbow")
ANGLES = (*_TRUNK, *(f"{side}_{name}" for part in (_LEG, ARM_ANGLES) for side in ("left", "right") for name in part))
ANGLE_INDEX = {name: i for i, name in enumerate(ANGLES)}
# the same names without sides
_PLAIN = [name.removeprefix("left_").removeprefix("right_") for name in ANGLES]
# minimum and maximum, (2, 27)
LIMITS = np.array([TABLES["angles"][name]["limits"] for name in _PLAIN], float).T

KINDS = tuple(TABLES["activities"])
ARM_NAMES = tuple(TABLES["arms"])
OWN_ARMS, CAPTURED_ARMS = ARM_NAMES.index("own"), ARM_NAMES.index("as_captured")


def _angle(activity: dict, name: str, plain_name: str) -> list[float]:
    angles = activity.get("angles", {})
    return angles.get(name, angles.get(plain_name, TABLES["angles"][plain_name]["default"]))


def _arm_odds(activity: dict) -> list[float]:
    weights = activity["arms"]
    weights = TABLES["arm_mixes"][weights] if isinstance(weights, str) else weights
    return [weights.get(name, 0.0) for name in ARM_NAMES]


# shares of the default mix (K,)
SHARES = np.array([activity.get("share", 0.0) for activity in _ACTIVITIES])
SHARES = SHARES / sum(activity.get("share", 0.0) for activity in _ACTIVITIES)
# relative weights of the unusual kinds (K,)
UNUSUAL = np.array([activity.get("unusual", 0.0) for activity in _ACTIVITIES])
# start, end and spread of each kind's angles, (3, K, 27)
KIND_RANGES = np.array([[_angle(a, *names) for names in zip(ANGLES, _PLAIN, strict=True)] for a in _ACTIVITIES], float)
KIND_RANGES = np.ascontiguousarray(np.moveaxis(KIND_RANGES, -1, 0))
# to what degree feet are relative to the floor, and thighs relative to the vertical, in [0, 1], (K,)
FLAT_FOOT = np.array([activity.get("flat_foot", 1.0) for activity in _ACTIVITIES])
UPRIGHT = np.array([activity.get("upright", 1.0) for activity in _ACTIVITIES])
# fraction of a kind's poses that intersect themselves or do not rest on their supporting parts (K,)
SELF_COLLISION = np.array([activity.get("self_collision", 0.01) for activity in _ACTIVITIES])
# probabilities of the kinds of arm in each kind of activity, (K, A)
ARM_ODDS = np.array([_arm_odds(activity) for activity in _ACTIVITIES])
ARM_ODDS /= ARM_ODDS.sum(1, keepdims=True)
# start, end and spread of ARM_ANGLES of each kind of arm, (3, A, 4)
ARM_RANGES = np.array([[arm[name] for arm in _ARMS] for name in ("start", "end", "spread")], float)
# angular frequency of the swing between the two ends of the range, rad/s, (K,) and (A,)
KIND_PACE = np.array([activity.get("pace", 0.0) for activity in _ACTIVITIES])
ARM_PACE = np.array([arm.get("pace", 0.0) for arm in _ARMS])

_J = {name: i for i, name in enumerate(SMPL24.joints)}
_SIDES = (("left", 1.0), ("right", -1.0))

# scapulohumeral rhythm: above 45 degrees of elevation the collar takes part of the arm's angle
_COLLAR_FROM, _COLLAR_SHARE = 45.0, 0.15
_SHOULDERS = np.array([_J["left_shoulder"], _J["right_shoulder"]])
_COLLAR_LIFTS = 3 * np.array([_J["left_collar"], _J["right_collar"]]) + 1
_LIFT_SIGNS = np.array([1, -1], np.float32)
_RAISED_OUT = np.array([[ANGLE_INDEX[f"{side}_raise"], ANGLE_INDEX[f"{side}_out"]] for side, _ in _SIDES])
_INWARD = np.array([ANGLE_INDEX[f"{side}_in"] for side, _ in _SIDES])


def unusual_mix(share: float) -> dict[str, float] | None:
    """The default mix with a `share` in [0, 1] of people in unusual poses; None if the share is 0."""
    weights = (1 - share) * SHARES + share * UNUSUAL / UNUSUAL.sum()
    return dict(zip(KINDS, weights.tolist(), strict=True)) if share else None


def rotations_from_angles(angles: np.ndarray) -> np.ndarray:
    """angles (n, 27) degrees, in the order of `ANGLES` -> local rotations (n, 24, 3, 3) float32."""
    angles = np.asarray(angles, np.float32)
    euler = angles @ EULER_FROM_ANGLES + _AT_ZERO
    euler[:, _COLLAR_LIFTS] += _LIFT_SIGNS * collar_lift(angles[:, _RAISED_OUT])
    rotations = _from_euler(np.radians(euler.reshape(len(angles), 24, 3)))
    inward = np.radians(angles[:, _INWARD])
    inward_rotation = np.zeros((len(angles), 2, 3, 3), np.float32)
    inward_rotation[..., 0, 0] = inward_rotation[..., 2, 2] = np.cos(inward)
    inward_rotation[..., 0, 2] = np.sin(inward)
    inward_rotation[..., 2, 0] = -inward_rotation[..., 0, 2]
    inward_rotation[..., 1, 1] = 1
    rotations[:, _SHOULDERS] = rotations[:, _SHOULDERS] @ inward_rotation
    return rotations


def shoulder_angles(matrix: np.ndarray, sign: float) -> np.ndarray:
    """Shoulder rotations (n, 3, 3), sign 1 for the left and -1 for the right -> (n, 3) degrees: raise, out, in."""
    # R_y(-raise) R_x(sign (out - 90)) R_y(in): the middle row and column hold the angles
    out = np.arcsin(np.clip(matrix[:, 1, 1], -1, 1))
    raised = np.arctan2(sign * matrix[:, 0, 1], -sign * matrix[:, 2, 1])
    inward = np.arctan2(-sign * matrix[:, 1, 0], sign * matrix[:, 1, 2])
    return np.degrees(np.stack([raised, out, inward], -1))


def shoulder_matrix(arm: np.ndarray, sign: float) -> np.ndarray:
    """The inverse of `shoulder_angles`: arm (n, 3) degrees -> rotations (n, 3, 3)."""
    raised, out, inward = np.radians(arm).T
    return rotation_about("y", -raised) @ rotation_about("x", sign * (out - np.pi / 2)) @ rotation_about("y", inward)


def collar_lift(arm: np.ndarray) -> np.ndarray:
    """Upward rotation (...) degrees of the collar, for an arm's raise and out (..., 2) degrees."""
    elevation = np.degrees(np.arccos(np.clip(np.cos(np.radians(arm)).prod(-1), -1, 1)))
    return _COLLAR_SHARE * np.clip(elevation - _COLLAR_FROM, 0, None)


def _from_euler(euler: np.ndarray) -> np.ndarray:
    """(..., 3) rad about y, x, z -> R_y R_x R_z (..., 3, 3): twist first, then sideways, then forward."""
    (ca, cb, cc), (sa, sb, sc) = (np.moveaxis(f(euler), -1, 0) for f in (np.cos, np.sin))
    matrix = np.empty(euler.shape + (3,), euler.dtype)
    sbsc, sbcc = sb * sc, sb * cc
    matrix[..., 0, 0] = ca * cc + sa * sbsc
    matrix[..., 0, 1] = sa * sbcc - ca * sc
    matrix[..., 0, 2] = sa * cb
    matrix[..., 1, 0] = cb * sc
    matrix[..., 1, 1] = cb * cc
    matrix[..., 1, 2] = -sb
    matrix[..., 2, 0] = ca * sbsc - sa * cc
    matrix[..., 2, 1] = sa * sc + ca * sbcc
    matrix[..., 2, 2] = ca * cb
    return matrix


def _euler_map() -> tuple[np.ndarray, np.ndarray]:
    """The linear map from `ANGLES` to 24 x (y, x, z) Euler angles, (27, 72), and its value at zero (72,), degrees."""
    matrix, zero = np.zeros((len(ANGLES), 24, 3), np.float32), np.zeros((24, 3), np.float32)
    y, x, z = 0, 1, 2
    # angles about y, x and z, and the joints over which they are distributed evenly
    joints_by_angles = {
        ("tilt", "roll", "yaw"): ("pelvis",),
        ("bend", "side", "twist"): ("spine1", "spine2", "spine3"),
        ("nod", "neck_side", "neck_twist"): ("neck", "head"),
    }
    for names, joints in joints_by_angles.items():
        for axis, name in enumerate(names):
            matrix[ANGLE_INDEX[name], [_J[joint] for joint in joints], axis] = 1 / len(joints)
    for side, sign in _SIDES:
        for name, joint, axis, gain in (
            ("hip", "hip", y, -1), ("abd", "hip", x, sign), ("rot", "hip", z, sign), ("knee", "knee", y, 1),
            ("ankle", "ankle", y, -1), ("raise", "shoulder", y, -1), ("out", "shoulder", x, sign),
            ("elbow", "elbow", z, -sign),
        ):  # fmt: skip
            matrix[ANGLE_INDEX[f"{side}_{name}"], _J[f"{side}_{joint}"], axis] = gain
        zero[_J[f"{side}_shoulder"], x] = -90 * sign  # from the T-pose to a hanging arm
    return matrix.reshape(len(ANGLES), 72), zero.reshape(72)


EULER_FROM_ANGLES, _AT_ZERO = _euler_map()


def _mirror() -> tuple[np.ndarray, np.ndarray]:
    other_side = {"left": "right_", "right": "left_"}
    parts = [name.partition("_") for name in ANGLES]
    index = [ANGLE_INDEX[other_side[a] + c if a in other_side else a + b + c] for a, b, c in parts]
    odd_angles = ("roll", "yaw", "side", "twist", "neck_side", "neck_twist")
    return np.array(index), np.array([-1.0 if name in odd_angles else 1.0 for name in ANGLES])


_MIRROR_INDEX, _MIRROR_SIGN = _mirror()


def mirror_angles(angles: np.ndarray) -> np.ndarray:
    """Swaps left and right: angles (n, 27) -> (n, 27)."""
    return angles[:, _MIRROR_INDEX] * _MIRROR_SIGN
