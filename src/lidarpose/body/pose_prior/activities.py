"""The pose prior's tables as arrays: angles, activities and arms, from assets/pose_prior.toml, which documents them.

K kinds of activity, A kinds of arm. All angles are degrees.
"""

import tomllib
from importlib import resources

import numpy as np

TABLES = tomllib.loads(resources.files("lidarpose.body").joinpath("assets/pose_prior.toml").read_text("utf-8"))
_ACTIVITIES, _ARMS = TABLES["activities"].values(), TABLES["arms"].values()

_TRUNK = ("tilt", "roll", "yaw", "bend", "side", "twist", "nod", "neck_side", "neck_twist")
_LEG = ("hip", "abd", "rot", "knee", "ankle")
ARM_ANGLES = ("raise", "out", "in", "elbow")
ANGLES = (*_TRUNK, *(f"{side}_{name}" for part in (_LEG, ARM_ANGLES) for side in ("left", "right") for name in part))
ANGLE_INDEX = {name: i for i, name in enumerate(ANGLES)}
# the same names without sides
_PLAIN = [name.removeprefix("left_").removeprefix("right_") for name in ANGLES]
# least and most, (2, 27)
LIMITS = np.array([TABLES["angles"][name]["limits"] for name in _PLAIN], float).T

KINDS = tuple(TABLES["activities"])
ARM_NAMES = tuple(TABLES["arms"])
OWN_ARMS, CAPTURED_ARMS = ARM_NAMES.index("own"), ARM_NAMES.index("as_captured")


def _angle(activity: dict, name: str, plain: str) -> list[float]:
    angles = activity.get("angles", {})
    return angles.get(name, angles.get(plain, TABLES["angles"][plain]["default"]))


def _arm_odds(activity: dict) -> list[float]:
    weights = activity["arms"]
    weights = TABLES["arm_mixes"][weights] if isinstance(weights, str) else weights
    return [weights.get(name, 0.0) for name in ARM_NAMES]


# shares of the default mix (K,)
SHARES = np.array([activity["share"] for activity in _ACTIVITIES])
SHARES = SHARES / sum(activity["share"] for activity in _ACTIVITIES)
# start, end and spread of each kind's angles, (3, K, 27)
KIND_RANGES = np.array([[_angle(a, *names) for names in zip(ANGLES, _PLAIN, strict=True)] for a in _ACTIVITIES], float)
KIND_RANGES = np.ascontiguousarray(np.moveaxis(KIND_RANGES, -1, 0))
# feet follow the floor, thighs are from the vertical: shares, (K,)
FLAT_FOOT = np.array([activity.get("flat_foot", 1.0) for activity in _ACTIVITIES])
UPRIGHT = np.array([activity.get("upright", 1.0) for activity in _ACTIVITIES])
# how often a kind's poses pass through themselves (K,)
SELF_COLLISION = np.array([activity.get("self_collision", 0.01) for activity in _ACTIVITIES])
# chances of the kinds of arm in each kind of activity, (K, A)
ARM_ODDS = np.array([_arm_odds(activity) for activity in _ACTIVITIES])
ARM_ODDS /= ARM_ODDS.sum(1, keepdims=True)
# start, end and spread of ARM_ANGLES of each kind of arm, (3, A, 4)
ARM_RANGES = np.array([[arm[name] for arm in _ARMS] for name in ("start", "end", "spread")], float)
# how fast people go to and fro between the ends of their range, rad/s, (K,) and (A,)
KIND_PACE = np.array([activity.get("pace", 0.0) for activity in _ACTIVITIES])
ARM_PACE = np.array([arm.get("pace", 0.0) for arm in _ARMS])
