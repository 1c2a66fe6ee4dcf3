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
    "tilt": (-1, 5, 4), "roll": (0, 0, 3), "yaw": (0, 0, 0),
    "bend": (-5, 7, 6), "side": (0, 0, 5), "twist": (0, 0, 10),
    "nod": (-5, 15, 10), "neck_side": (0, 0, 8), "neck_twist": (0, 0, 45),
    "hip": (0, 0, 4), "abd": (-3, 2, 4), "rot": (0, 14, 10), "knee": (4, 14, 6), "ankle": (0, 0, 4),
    "raise": (-12, 12, 10), "out": (4, 20, 8), "in": (0, 24, 16), "elbow": (8, 40, 14),
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
    "own": 0.40, "front": 0.14, "phone": 0.06, "carry": 0.06, "reach": 0.08, "wave": 0.03, "high": 0.03, "side": 0.04,
    "hip": 0.05, "back": 0.03, "folded": 0.05, "free": 0.04, "as_captured": 0.12,
}  # fmt: skip
_WALKING_ARMS = {
    "own": 0.64, "front": 0.05, "phone": 0.04, "carry": 0.05, "reach": 0.02, "wave": 0.01, "side": 0.02, "hip": 0.01,
    "back": 0.01, "folded": 0.01, "free": 0.02, "as_captured": 0.12,
}  # fmt: skip
_WORKING_ARMS = {"own": 0.15, "low": 0.35, "front": 0.15, "reach": 0.15, "knee": 0.10, "phone": 0.02, "free": 0.08}
_WIDE_ARMS = {
    "free": 0.26, "side": 0.10, "high": 0.08, "reach": 0.10, "front": 0.08, "low": 0.04, "own": 0.04,
    "as_captured": 0.30,
}  # fmt: skip

ACTIVITIES = {
    "idle": Activity(
        share=0.14,
        angles={"tilt": (-3, 6, 5), "hip": (-2, 8, 7), "knee": (3, 22, 9), "abd": (-3.5, 5, 4.5), "roll": (0, 0, 5)},
        arms=_USUAL_ARMS,
    ),
    "walk": Activity(
        share=0.30,
        angles={
            "tilt": (-4, 10, 5), "bend": (-5, 8, 6), "nod": (-4, 16, 9), "hip": (0, 0, 4), "knee": (2, 4, 3),
            "ankle": (0, 0, 5), "abd": (-5, 1, 3), "rot": (0, 10, 8), "side": (0, 0, 4), "twist": (0, 0, 6),
            "raise": (-14, 2, 8), "out": (3, 16, 6), "in": (0, 24, 16), "elbow": (0, 0, 6), "neck_twist": (0, 0, 40),
        },
        arms=_WALKING_ARMS,
        flat_foot=0.0,
    ),
    "run": Activity(
        share=0.11,
        angles={
            "tilt": (4, 14, 6), "bend": (0, 14, 8), "hip": (4, 12, 8), "knee": (4, 10, 8), "ankle": (-6, 2, 8),
            "abd": (-4, 1, 3), "raise": (-16, 4, 10), "out": (14, 32, 8), "in": (-2, 30, 14), "elbow": (0, 10, 10),
        },
        arms={"own": 0.70, "front": 0.04, "free": 0.04, "side": 0.03, "reach": 0.03, "as_captured": 0.16},
        flat_foot=0.0,
    ),
    "sit": Activity(
        share=0.07,
        angles={
            "tilt": (-18, 14, 8), "bend": (-6, 24, 10), "hip": (76, 96, 8), "knee": (50, 112, 12), "abd": (2, 22, 8),
            "rot": (-8, 8, 10),
        },
        arms={"own": 0.1, "knee": 0.35, "front": 0.2, "phone": 0.08, "reach": 0.1, "folded": 0.07, "free": 0.1},
    ),
    "crouch": Activity(
        share=0.05,
        angles={"tilt": (10, 42, 12), "bend": (4, 36, 10), "hip": (20, 104, 9), "knee": (36, 136, 9),
                "abd": (4, 18, 8), "nod": (-25, 5, 10)},
        arms=_WORKING_ARMS,
    ),
    "bend": Activity(
        share=0.05,
        angles={"tilt": (8, 62, 12), "bend": (10, 50, 12), "hip": (2, -12, 8), "knee": (6, 24, 12),
                "abd": (0, 10, 6), "nod": (-25, 20, 12), "twist": (0, 0, 24)},
        arms=_WORKING_ARMS,
    ),
    "kneel": Activity(
        share=0.025,
        # the rear knee is on the ground, so the front thigh is level or steeper
        angles={"tilt": (-2, 22, 9), "bend": (0, 26, 10), "left_hip": (88, 112, 5), "left_knee": (88, 116, 7),
                "right_hip": (-6, 34, 6), "right_knee": (98, 138, 6), "right_ankle": (-88, -132, 10),
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
    # behind a pram, a trolley or a wheelchair: the legs are those of a walk
    "push": Activity(
        share=0.02,
        angles={"tilt": (3, 20, 6), "hip": (2, 10, 4), "knee": (2, 6, 3), "ankle": (0, 0, 5), "abd": (-6, 1.5, 3.5),
                "rot": (0, 10, 8), "twist": (0, 0, 4), "raise": (24, 70, 8), "out": (0, 14, 5), "in": (0, 20, 8),
                "elbow": (10, 80, 8)},
        arms={"own": 0.94, "phone": 0.03, "carry": 0.03},
        flat_foot=0.0,
    ),
    "lie": Activity(
        share=0.015,
        angles={"tilt": (-95, -72, 10), "roll": (0, 0, 30), "bend": (-6, 18, 8), "hip": (-6, 48, 14),
                "knee": (0, 84, 20), "ankle": (-35, -5, 10), "abd": (0, 22, 8)},
        arms={"own": 0.45, "side": 0.15, "front": 0.25, "reach": 0.15},  # none goes through the floor
        flat_foot=0.0,
        upright=0.0,
    ),
    # ball games, exercise: lunges and wide low stances, arms out, up and at a ball
    "sport": Activity(
        share=0.08,
        angles={"tilt": (-2, 26, 14), "roll": (0, 0, 14), "bend": (-10, 24, 14), "side": (0, 0, 18),
                "twist": (0, 0, 32), "left_hip": (-20, 44, 26), "right_hip": (44, -20, 26), "knee": (8, 66, 34),
                "abd": (2, 30, 14), "rot": (-6, 22, 16), "ankle": (-14, 0, 12)},
        arms=_WIDE_ARMS,
        flat_foot=0.6,
    ),
    # from standing to lying on the front, turned more or less to a side
    "fall": Activity(
        share=0.01,
        angles={"tilt": (2, 82, 14), "roll": (0, 0, 30), "bend": (0, 10, 12), "hip": (6, 26, 16),
                "knee": (12, 56, 20), "ankle": (0, -20, 10), "abd": (2, 14, 8), "nod": (0, -25, 10),
                "raise": (10, 100, 24), "out": (10, 50, 20)},
        arms={"own": 0.6, "reach": 0.2, "free": 0.2},
        flat_foot=0.3,
        upright=0.0,
    ),
    # the angles come from `captured`: working, exercising, dancing people
    "captured": Activity(share=0.33, angles={}, arms={"own": 1.0}, flat_foot=0.0, upright=0.0),
}  # fmt: skip
KINDS = tuple(ACTIVITIES)
SHARES = np.array([a.share for a in ACTIVITIES.values()]) / sum(a.share for a in ACTIVITIES.values())

# what an arm does, in the order of ARM_ANGLES: start, end, spread. "own" leaves the arm to the activity, "as_captured"
# is an arm of another pose after captured motion.
_ARM_TABLE = {
    "own": ((0, 0, 0, 0), (0, 0, 0, 0), (0, 0, 0, 0)),
    "front": ((-6, 8, 10, 60), (44, 22, 50, 110), (12, 10, 16, 18)),
    "phone": ((20, 4, 0, 118), (60, 34, 40, 145), (12, 10, 16, 8)),
    "carry": ((-14, 6, 0, 2), (12, 20, 20, 26), (6, 6, 12, 8)),
    "reach": ((40, 0, 0, 5), (105, 30, 30, 60), (14, 16, 20, 14)),
    "high": ((120, 0, -20, 4), (168, 30, 30, 70), (10, 14, 16, 14)),
    "wave": ((-8, 42, -88, 58), (18, 74, -66, 124), (10, 10, 6, 8)),
    "side": ((-5, 40, -40, 4), (20, 98, 20, 60), (16, 12, 24, 16)),
    "hip": ((-28, 32, 56, 72), (-8, 52, 76, 104), (6, 8, 8, 10)),
    "back": ((-46, 6, 30, 20), (-26, 26, 70, 70), (8, 8, 10, 12)),
    "folded": ((16, 6, 48, 84), (38, 18, 74, 112), (8, 6, 6, 8)),
    "knee": ((24, 4, 0, 14), (58, 22, 30, 66), (8, 8, 12, 12)),
    "low": ((20, 0, 0, 4), (88, 20, 24, 50), (16, 12, 16, 14)),
    "as_captured": ((0, 0, 0, 0), (0, 0, 0, 0), (0, 0, 0, 0)),
    "free": ((-30, 10, -50, 8), (130, 80, 60, 100), (50, 36, 40, 46)),
}
# how fast people go to and fro between the ends of an activity's and of an arm's range, rad/s (chosen by eye; a crank
# turns 60 times a minute); what is not named keeps its place and sways
PACE = {
    "walk": 0.4, "run": 0.6, "push": 0.4, "idle": 0.4, "sit": 0.3, "crouch": 1.4, "bend": 1.5, "kneel": 0.5,
    "step": 2.4, "cycle": 6.3, "lie": 0.2, "sport": 2.8,
}  # fmt: skip
ARM_PACE = {
    "own": 0.6, "front": 0.6, "phone": 0.3, "carry": 0.3, "reach": 1.4, "high": 1.2, "wave": 8.0, "side": 1.2,
    "hip": 0.2, "back": 0.2, "folded": 0.2, "knee": 0.3, "low": 1.2, "free": 2.5,
}  # fmt: skip

ARM_NAMES = tuple(_ARM_TABLE)
OWN_ARMS, CAPTURED_ARMS = ARM_NAMES.index("own"), ARM_NAMES.index("as_captured")
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
