"""Tables of the pose prior: the angles of a pose, their limits, activities and what arms do.

All numbers are degrees. Sources: ranges of motion after AAOS and the CDC's normal joint ranges; activities by
observation. An activity is a range between two poses (`start`, `end`) and a spread of each angle about it.
"""

from dataclasses import dataclass

import numpy as np

# Angles are from the shipped body's rest pose, whose legs stand 20 cm apart at the ankles.
# trunk: tilt, bend and nod forward, roll and side to the right-hand turn about x, yaw and twist to the left.
# legs: flexion, abduction, outward turn, knee flexion, dorsiflexion. arms: raised forward and outward from hanging,
# turned inward, elbow flexion. In the tables of activities `hip` is the thigh from the vertical and `ankle` is added
# to the angle that keeps the foot flat.
_LEG = ("hip", "abd", "rot", "knee", "ankle")
ARM_ANGLES = ("raise", "out", "in", "elbow")
_TRUNK = ("tilt", "roll", "yaw", "bend", "side", "twist", "nod", "neck_side", "neck_twist")
ANGLES = (
    *_TRUNK,
    *(f"left_{name}" for name in _LEG),
    *(f"right_{name}" for name in _LEG),
    *(f"left_{name}" for name in ARM_ANGLES),
    *(f"right_{name}" for name in ARM_ANGLES),
)

_RANGES = {
    "tilt": (-95, 100), "roll": (-95, 95), "yaw": (-30, 30),
    "bend": (-30, 80), "side": (-35, 35), "twist": (-45, 45),
    "nod": (-45, 50), "neck_side": (-35, 35), "neck_twist": (-70, 70),
    "hip": (-30, 130), "abd": (-25, 50), "rot": (-40, 45), "knee": (0, 150), "ankle": (-50, 25),
    "raise": (-60, 175), "out": (-30, 130), "in": (-90, 80), "elbow": (0, 148),
}  # fmt: skip
LIMITS = np.array([_RANGES[name.removeprefix("left_").removeprefix("right_")] for name in ANGLES], float).T

# (start, end, spread) of angles an activity does not name
_DEFAULT = {
    "tilt": (0, 6, 4), "roll": (0, 0, 3), "yaw": (0, 0, 0),
    "bend": (-4, 8, 6), "side": (0, 0, 5), "twist": (0, 0, 10),
    "nod": (-4, 18, 10), "neck_side": (0, 0, 8), "neck_twist": (0, 0, 45),
    "hip": (0, 0, 4), "abd": (-1, 3, 4), "rot": (0, 14, 10), "knee": (4, 14, 6), "ankle": (0, 0, 4),
    "raise": (-12, 12, 10), "out": (8, 22, 8), "in": (0, 24, 16), "elbow": (8, 40, 14),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Activity:
    """A kind of pose. share of the default mix; angles: name -> (start, end, spread), a name without a side is both
    sides'; arms: kinds of arm -> weight; flat_foot: feet follow the floor; upright: thighs are from the vertical."""

    share: float
    angles: dict[str, tuple[float, float, float]]
    arms: dict[str, float]
    flat_foot: float = 1.0
    upright: float = 1.0


_USUAL_ARMS = {
    "own": 0.40, "front": 0.14, "phone": 0.06, "carry": 0.06, "reach": 0.09, "high": 0.03, "side": 0.05,
    "hip": 0.05, "back": 0.03, "folded": 0.05, "free": 0.04,
}  # fmt: skip
_WALKING_ARMS = {
    "own": 0.74, "front": 0.05, "phone": 0.05, "carry": 0.05, "reach": 0.03, "side": 0.02, "hip": 0.01,
    "back": 0.02, "folded": 0.01, "free": 0.02,
}  # fmt: skip
_WORKING_ARMS = {"own": 0.15, "low": 0.35, "front": 0.15, "reach": 0.15, "knee": 0.10, "phone": 0.02, "free": 0.08}
_WIDE_ARMS = {"free": 0.42, "side": 0.13, "high": 0.10, "reach": 0.15, "front": 0.12, "own": 0.08}

ACTIVITIES = {
    "idle": Activity(
        share=0.14,
        angles={"tilt": (-3, 8, 5), "hip": (-2, 8, 7), "knee": (3, 22, 9), "abd": (-5, 5, 5), "roll": (0, 0, 5)},
        arms=_USUAL_ARMS,
    ),
    "walk": Activity(
        share=0.30,
        angles={
            "tilt": (0, 7, 5), "hip": (0, 0, 4), "knee": (2, 4, 3), "ankle": (0, 0, 5), "abd": (-6, 1.5, 3.5),
            "rot": (0, 10, 8), "side": (0, 0, 4), "twist": (0, 0, 6), "raise": (-14, 2, 8), "out": (10, 24, 6),
            "in": (0, 24, 16), "elbow": (0, 0, 6), "neck_twist": (0, 0, 40),
        },
        arms=_WALKING_ARMS,
        flat_foot=0.0,
    ),
    "run": Activity(
        share=0.06,
        angles={
            "tilt": (4, 14, 6), "bend": (0, 14, 8), "hip": (4, 12, 8), "knee": (4, 10, 8), "ankle": (-6, 2, 8),
            "abd": (-8, -1, 4), "raise": (-16, 4, 10), "out": (10, 30, 8), "in": (10, 45, 16), "elbow": (0, 10, 10),
        },
        arms={"own": 0.9, "free": 0.04, "side": 0.03, "reach": 0.03},
        flat_foot=0.0,
    ),
    "sit": Activity(
        share=0.08,
        angles={
            "tilt": (-18, 14, 8), "bend": (-6, 24, 10), "hip": (76, 96, 8), "knee": (50, 112, 12), "abd": (2, 22, 8),
            "rot": (-8, 8, 10),
        },
        arms={"own": 0.1, "knee": 0.35, "front": 0.2, "phone": 0.08, "reach": 0.1, "folded": 0.07, "free": 0.1},
    ),
    "crouch": Activity(
        share=0.06,
        angles={"tilt": (10, 42, 12), "bend": (4, 36, 10), "hip": (20, 104, 9), "knee": (36, 136, 9),
                "abd": (4, 18, 8), "nod": (-25, 5, 10)},
        arms=_WORKING_ARMS,
    ),
    "bend": Activity(
        share=0.06,
        angles={"tilt": (8, 62, 12), "bend": (10, 50, 12), "hip": (2, -12, 8), "knee": (6, 24, 12),
                "abd": (0, 10, 6), "nod": (-25, 20, 12), "twist": (0, 0, 24)},
        arms=_WORKING_ARMS,
    ),
    "kneel": Activity(
        share=0.03,
        # the rear knee is on the ground, so the front thigh is level or steeper
        angles={"tilt": (-2, 22, 9), "bend": (0, 26, 10), "left_hip": (88, 112, 5), "left_knee": (88, 116, 7),
                "right_hip": (-6, 46, 6), "right_knee": (84, 134, 6), "right_ankle": (-70, -140, 12),
                "abd": (2, 16, 7)},
        arms=_WORKING_ARMS,
    ),
    "step": Activity(
        share=0.04,
        angles={"tilt": (2, 18, 8), "bend": (0, 14, 8), "left_hip": (20, 78, 12), "left_knee": (30, 92, 14),
                "right_hip": (-22, 8, 10), "right_knee": (4, 30, 12), "abd": (-5, 5, 6)},
        arms=_USUAL_ARMS,
    ),
    "cycle": Activity(
        share=0.03,
        angles={"tilt": (8, 40, 6), "bend": (6, 30, 8), "left_hip": (62, 18, 6), "left_knee": (96, 28, 6),
                "right_hip": (18, 62, 6), "right_knee": (28, 96, 6), "abd": (-4, 0, 3), "rot": (0, 4, 4),
                "nod": (-35, -8, 8), "twist": (0, 0, 4), "raise": (42, 84, 8), "out": (2, 14, 4), "in": (0, 20, 8),
                "elbow": (4, 40, 8)},
        arms={"own": 0.9, "front": 0.05, "side": 0.05},
        flat_foot=0.7,
    ),
    "push": Activity(
        share=0.02,
        angles={"tilt": (4, 24, 8), "left_hip": (10, 36, 8), "left_knee": (12, 40, 10), "right_hip": (-26, 2, 8),
                "right_knee": (6, 26, 10), "raise": (24, 74, 10), "out": (0, 14, 6), "in": (0, 20, 8),
                "elbow": (10, 80, 10)},
        arms={"own": 1.0},
        flat_foot=0.7,
    ),
    "lie": Activity(
        share=0.02,
        angles={"tilt": (-92, -60, 20), "roll": (0, 0, 30), "bend": (-6, 24, 10), "hip": (-6, 60, 22),
                "knee": (0, 90, 24), "ankle": (-35, -5, 10), "abd": (0, 22, 8)},
        arms={"own": 0.4, "side": 0.2, "front": 0.2, "free": 0.2},
        flat_foot=0.0,
        upright=0.0,
    ),
    "sport": Activity(
        share=0.05,
        angles={"tilt": (-2, 24, 14), "roll": (0, 0, 14), "bend": (-10, 24, 14), "side": (0, 0, 18),
                "twist": (0, 0, 30), "left_hip": (-20, 40, 26), "right_hip": (40, -20, 26), "knee": (8, 60, 34),
                "abd": (2, 26, 14), "rot": (-6, 20, 16), "ankle": (-14, 0, 12)},
        arms=_WIDE_ARMS,
        flat_foot=0.6,
    ),
    # the angles come from `captured`: working, exercising, dancing people
    "captured": Activity(share=0.15, angles={}, arms={"own": 1.0}, flat_foot=0.0, upright=0.0),
}  # fmt: skip
KINDS = tuple(ACTIVITIES)
SHARES = np.array([a.share for a in ACTIVITIES.values()]) / sum(a.share for a in ACTIVITIES.values())

# what an arm does, in the order of ARM_ANGLES: start, end, spread. "own" leaves the arm to the activity.
_ARM_TABLE = {
    "own": ((0, 0, 0, 0), (0, 0, 0, 0), (0, 0, 0, 0)),
    "front": ((-6, 8, 10, 60), (44, 22, 50, 110), (12, 10, 16, 18)),
    "phone": ((20, 4, 0, 118), (60, 34, 40, 145), (12, 10, 16, 8)),
    "carry": ((-14, 6, 0, 2), (12, 20, 20, 26), (6, 6, 12, 8)),
    "reach": ((40, 0, 0, 5), (105, 30, 30, 60), (14, 16, 20, 14)),
    "high": ((120, 0, -20, 4), (168, 30, 30, 70), (10, 14, 16, 14)),
    "side": ((-5, 40, -40, 4), (20, 98, 20, 60), (16, 12, 24, 16)),
    "hip": ((-28, 32, 56, 72), (-8, 52, 76, 104), (6, 8, 8, 10)),
    "back": ((-46, 6, 30, 20), (-26, 26, 70, 70), (8, 8, 10, 12)),
    "folded": ((16, 6, 48, 84), (38, 18, 74, 112), (8, 6, 6, 8)),
    "knee": ((18, 4, 0, 14), (52, 22, 34, 70), (10, 8, 12, 14)),
    "low": ((20, 0, 0, 4), (88, 20, 24, 50), (16, 12, 16, 14)),
    "free": ((-30, 10, -50, 8), (130, 80, 60, 100), (50, 36, 40, 46)),
}
ARM_NAMES = tuple(_ARM_TABLE)
OWN_ARMS = ARM_NAMES.index("own")
ARMS = tuple(np.array(table, float) for table in zip(*_ARM_TABLE.values(), strict=True))


@dataclass(frozen=True, kw_only=True)
class _Table:
    """The activities as arrays: (K, 27) start, end and spread; (K,) flat_foot and upright."""

    start: np.ndarray
    end: np.ndarray
    spread: np.ndarray
    flat_foot: np.ndarray
    upright: np.ndarray


def _table() -> _Table:
    rows = np.empty((len(ACTIVITIES), len(ANGLES), 3))
    for k, activity in enumerate(ACTIVITIES.values()):
        for i, name in enumerate(ANGLES):
            plain = name.removeprefix("left_").removeprefix("right_")
            rows[k, i] = activity.angles.get(name, activity.angles.get(plain, _DEFAULT[plain]))
    flat, upright = (np.array([getattr(a, f) for a in ACTIVITIES.values()]) for f in ("flat_foot", "upright"))
    return _Table(start=rows[..., 0], end=rows[..., 1], spread=rows[..., 2], flat_foot=flat, upright=upright)


TABLE = _table()


def _arms_of_kind() -> np.ndarray:
    weights = np.array([[a.arms.get(name, 0.0) for name in ARM_NAMES] for a in ACTIVITIES.values()])
    return weights / weights.sum(1, keepdims=True)


ARMS_OF_KIND = _arms_of_kind()
