"""Walking and running: angles of a stride as functions of its phase, with feet that stay where they stand.

The angles of hip, knee and ankle follow published curves of the stride. A curve scaled to a person's step and noise
does not quite keep its foot on the ground, so each leg's ankle is then moved, within its own plane, onto the path of a
foot that rolls over a fixed place while the hips go ahead at one speed and rise and fall a little.

Phase 0 is the heel strike of the leg. Metres are those of the mean adult.
"""

from dataclasses import dataclass

import numpy as np

from lidarpose.body.pose_prior.activities import ANGLES

_A = {name: i for i, name in enumerate(ANGLES)}

# sagittal angles, degrees: phase, hip flexion from the vertical, knee flexion, ankle dorsiflexion. Level walking
# (Perry, Gait Analysis; events of the stride) and running (after Novacheck 1998, The biomechanics of running)
_WALK = np.array(
    [
        [0.00, 24.0, 4.0, 0.0],
        [0.12, 20.0, 18.0, -6.0],
        [0.31, 2.0, 6.0, 5.0],
        [0.50, -16.0, 8.0, 10.0],
        [0.62, -8.0, 38.0, -14.0],
        [0.75, 16.0, 62.0, -5.0],
        [0.87, 27.0, 26.0, 0.0],
    ]
)
_RUN = np.array(
    [
        [0.00, 27.0, 16.0, 4.0],
        [0.14, 18.0, 36.0, 16.0],
        [0.28, -3.0, 28.0, 14.0],
        [0.40, -20.0, 16.0, -14.0],
        [0.55, -8.0, 64.0, -14.0],
        [0.70, 24.0, 96.0, 0.0],
        [0.86, 42.0, 56.0, 4.0],
    ]
)
_HARMONICS = 3  # seven events and seven coefficients: the curve runs through them all
# strides a second, least and how much more with the longest stride: comfortable walking 0.75-1.05 (Perry), running
# 1.2-1.5; behind a pram or a trolley a little slower (chosen)
CADENCE = {"walk": (0.75, 0.3), "run": (1.25, 0.25), "push": (0.7, 0.25)}
_ARM_LAG = 0.03  # of a stride: the arms trail the legs a little


@dataclass(frozen=True, kw_only=True)
class _Style:
    """What a gait is besides its curves.

    stance: share of the stride from a heel strike for which a foot bears the body, until the other one lands, or takes
    off; behind: how far behind the place that the curves say a foot stands, m: runners land less far ahead; lowest:
    phase of the hips' lowest place, which comes twice in a stride; rise: how far they rise from their mean, m, in steps
    of full length: walkers stride over a straight leg (Perry: 4 cm in all), runners sink while they stand and fly.
    pitch: of the foot that stands: toes up at the heel strike, degrees in steps of full length; phases at which it lies
    flat and leaves the ground with the heel; toes down at the end of the stance, degrees; the power by which it rises.
    The rest are (least, how much more) of the parameters of `gait`: the swing of the arms and the elbows in degrees.
    """

    stance: float
    behind: float
    lowest: float
    rise: float
    pitch: tuple[float, float, float, float, float]
    length: tuple[float, float]
    lift: tuple[float, float]
    crouch: float
    swing: tuple[float, float]
    elbow: tuple[float, float]
    elbow_swing: tuple[float, float]


_STYLES = {
    "walk": _Style(
        stance=0.5, behind=0.0, lowest=0.05, rise=0.018, pitch=(18.0, 0.08, 0.28, 24.0, 1.5),
        length=(0.45, 0.9), lift=(0.8, 0.4), crouch=16.0,
        swing=(4.0, 30.0), elbow=(6.0, 40.0), elbow_swing=(3.0, 14.0),
    ),
    "run": _Style(
        stance=0.35, behind=0.07, lowest=0.185, rise=0.024, pitch=(10.0, 0.06, 0.14, 38.0, 1.5),
        length=(0.6, 0.5), lift=(0.8, 0.35), crouch=8.0,
        swing=(20.0, 30.0), elbow=(55.0, 50.0), elbow_swing=(10.0, 15.0),
    ),
    "push": _Style(
        stance=0.5, behind=0.03, lowest=0.05, rise=0.014, pitch=(16.0, 0.08, 0.28, 22.0, 1.5),
        length=(0.35, 1.0), lift=(0.8, 0.4), crouch=16.0,
        swing=(0.0, 2.0), elbow=(0.0, 0.0), elbow_swing=(0.0, 3.0),
    ),
}  # fmt: skip
GAITS = tuple(_STYLES)
_RUN_INDEX = GAITS.index("run")
# share of the stride over which a foot leaves its place and comes to the next
_LEAVE, _LAND = 0.14, 0.12
_TRAIL = 0.08  # of a stride: so long a foot that leaves stays where it was
_FIRST = 1.7  # it is over its place before it comes down, and goes on only once it is lifted: by this factor

# the mean adult's leg in its plane: lengths of thigh and shank m, and how far their bones stand out of the vertical at
# rest, rad (`retarget.mean_adult_joints`); half the distance of the hips; heel and toes from the ankle (x, z)
_THIGH, _SHANK, _HALF_HIPS = 0.390, 0.410, 0.075
_THIGH_REST, _SHANK_REST = 0.023, -0.076
_HEEL, _TOES = (-0.05, -0.077), (0.19, -0.075)
# a leg never stretches further, and no further than that where it bears the body
_STRAIGHT, _STRETCHED = 0.9985 * (_THIGH + _SHANK), 0.995 * (_THIGH + _SHANK)
_TOE_CLEAR = 0.022  # a swinging foot's least height, m
_SIDES = np.array([1.0, -1.0])  # left, right


def _basis(phase: np.ndarray) -> np.ndarray:
    """Fourier basis (..., 7) at phase (...)."""
    turns = 2 * np.pi * np.arange(1, _HARMONICS + 1) * phase[..., None]
    return np.concatenate([np.ones((*phase.shape, 1)), np.cos(turns), np.sin(turns)], -1)


_COEFFICIENTS = np.stack([np.linalg.solve(_basis(table[:, 0]), table[:, 1:]) for table in (_WALK, _RUN, _WALK)])


def _table(name: str) -> np.ndarray:
    return np.array([getattr(style, name) for style in _STYLES.values()])


_STANCE, _BEHIND, _LOWEST, _RISE = (_table(name) for name in ("stance", "behind", "lowest", "rise"))
_PITCH = _table("pitch")
# phases of a stance at which a stride's speed and height are found, (3, 7), and the curves there, (3, 7, 3)
_GRID = _STANCE[:, None] * np.linspace(0, 1, 7)
_GRID_CURVES = _basis(_GRID) @ _COEFFICIENTS
_LEG_COLUMNS, _ABD, _ROT, _RAISE, _ELBOW = (
    np.array([[_A[f"{side}_{name}"] for side in ("left", "right")] for name in names]).squeeze()
    for names in (("hip", "knee", "ankle"), ("abd",), ("rot",), ("raise",), ("elbow",))
)


def stride_curves(phase: np.ndarray, gait: np.ndarray) -> np.ndarray:
    """phase (n, P) in strides, any number, gait (n,) into `GAITS` -> (n, P, 3) degrees: hip and knee flexion, ankle
    dorsiflexion."""
    return _basis(phase) @ _COEFFICIENTS[gait]


@dataclass(frozen=True, kw_only=True)
class Strides:
    """angles (n, 27) degrees; pace (n,) m a stride along the way the body walks; height (n,) m of the hips' middle
    above the ground."""

    angles: np.ndarray
    pace: np.ndarray
    height: np.ndarray


def strides(gait: np.ndarray, phase: np.ndarray, style: np.ndarray, base: np.ndarray) -> Strides:
    """The angles of people who walk, run or push: those of their activities' tables, base (n, 27), and a stride on top.

    gait (n,) into `GAITS`; phase (n,) in strides, 0 at the left heel's strike; style (n, 8) in [0, 1]: length of the
    stride, lift of the knee, swing of the arms, bend of the elbow, its swing, crouch, turn of the hips, asymmetry of
    the arms. Thighs are from the vertical.
    """
    length, lift, swing, elbow, elbow_swing, crouch, turn, uneven = style.T
    # walkers with long steps swing their arms far and most bend their elbows little
    runs = gait == _RUN_INDEX
    swing = np.where(runs, swing, swing * (0.4 + 0.6 * (0.35 + length)))
    elbow = np.where(runs, elbow, elbow**1.5)
    length, lift, swing, elbow, elbow_swing = (
        _RANGES[name][gait, 0] + _RANGES[name][gait, 1] * value
        for name, value in zip(_RANGES, (length, lift, swing, elbow, elbow_swing), strict=True)
    )
    crouch = _CROUCH[gait] * crouch**1.3
    turning, rolling = 2 * np.pi * phase, 2 * np.pi * (phase + 0.05)
    # the hips turn with the leading leg and drop over the swinging one, the chest turns against them
    yaw = -(2 + 5 * turn) * length * np.cos(turning)
    roll = (1 + 3 * turn) * np.sin(rolling)
    sway = 1.5 * np.sin(rolling - 0.2 * np.pi)  # the hips go over the standing leg
    hip_shift = _HALF_HIPS * np.radians(np.stack([yaw, roll]))[..., None] * _SIDES

    own = phase[:, None] + np.array([0.0, 0.5])
    late, weight = _stance(gait, own % 1)
    legs = _legs(gait, own, late, weight, length, lift, crouch, base)
    rise = (
        -_RISE[gait, None]
        * length[:, None] ** 2
        * np.cos(4 * np.pi * (np.column_stack([phase, _GRID[gait]]) - _LOWEST[gait, None]))
    )
    pace, height, center = _pace(gait, legs, rise[:, 1:])
    height = height + rise[:, 0]
    hip, knee, ankle = _planted(gait, late, weight, legs, center, pace, height, hip_shift)

    angles = base.copy()
    angles[:, _LEG_COLUMNS] = np.stack([hip, knee, ankle], 1)
    # legs stay in their planes whatever the hips do
    angles[:, _ABD] -= _SIDES * ((roll + sway)[:, None] + yaw[:, None] * np.sin(np.radians(hip)))
    angles[:, _ROT] -= _SIDES * yaw[:, None]
    forward = -np.cos(2 * np.pi * (own - _ARM_LAG))  # against the leg of the same side
    angles[:, _RAISE] += swing[:, None] * (1 + 0.5 * _SIDES * (uneven[:, None] - 0.5)) * forward
    angles[:, _ELBOW] += elbow[:, None] + elbow_swing[:, None] * (forward + 1) / 2
    angles[:, _A["yaw"]] += yaw
    angles[:, _A["twist"]] -= 1.8 * yaw
    angles[:, _A["roll"]] += roll
    angles[:, _A["side"]] -= roll
    return Strides(angles=angles, pace=pace, height=height)


_RANGES = {name: _table(name) for name in ("length", "lift", "swing", "elbow", "elbow_swing")}
_CROUCH = _table("crouch")


def _stance(gait: np.ndarray, phase: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """phase (n, 2) in [0, 1) of the legs -> phase since the heel strike, below 0 for a foot about to land, and how much
    the place on the ground holds the foot, in [0, 1]."""
    stance = _STANCE[gait, None]
    late = np.where(phase > (1 + stance) / 2, phase - 1, phase)
    return late, _smooth(1 - (late - stance) / _LEAVE) * _smooth(1 + late / _LAND)


def _standing_pitch(gait: np.ndarray, late: np.ndarray, length: np.ndarray) -> np.ndarray:
    """The pitch (n, ...), degrees, of a foot on the ground: lands on its heel, lies flat, rises on its toes."""
    shape = (-1,) + (1,) * (late.ndim - 1)
    land, flat, rise, leave, up = (value.reshape(shape) for value in _PITCH[gait].T)
    lands = land * np.clip(1 - late / flat, 0, 1)
    leaves = np.maximum((late - rise) / (_STANCE[gait].reshape(shape) - rise), 0)
    return length * (lands - leave * np.minimum(leaves, 1.3) ** up)


def _legs(
    gait: np.ndarray,
    phase: np.ndarray,
    late: np.ndarray,
    weight: np.ndarray,
    length: np.ndarray,
    lift: np.ndarray,
    crouch: np.ndarray,
    base: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Hip, knee and the foot's pitch (toes up), each (n, 2, 1 + 7) rad: of both legs, now, at phase (n, 2), and at the
    phases of their stance in `_GRID`."""
    length, lift, crouch = (value[:, None, None] for value in (length, lift, crouch))
    grid = np.broadcast_to(_GRID_CURVES[gait, None], (len(phase), 2, 7, 3))
    curves = np.concatenate([stride_curves(phase, gait)[:, :, None], grid], 2)
    own_hip, own_knee, own_ankle = np.moveaxis(base[:, _LEG_COLUMNS], 1, 0)[..., None]
    hip = length * (curves[..., 0] - 4) + 4 + 0.45 * crouch + own_hip
    # slow steps bend the knee less
    knee = curves[..., 1] * lift * np.clip(0.45 + 0.55 * length, 0, 1.4) + crouch + own_knee
    ankle = curves[..., 2] * np.clip(length, 0.5, 1.2) + 0.5 * crouch + own_ankle
    grid = np.broadcast_to(_GRID[gait, None], (len(phase), 2, 7))
    standing = _standing_pitch(gait, np.concatenate([late[..., None], grid], 2), length)
    held = np.concatenate([weight[..., None], np.ones(grid.shape)], 2)
    pitch = hip - knee + ankle
    return np.radians(hip), np.radians(knee), np.radians(pitch + held * (standing - pitch))


def _ankle(hip: np.ndarray, knee: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x and z m of the ankle seen from its hip joint, for angles in rad."""
    thigh, shank = hip + _THIGH_REST, hip - knee + _SHANK_REST
    return _THIGH * np.sin(thigh) + _SHANK * np.sin(shank), -_THIGH * np.cos(thigh) - _SHANK * np.cos(shank)


def _roll_off(pitch: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x and z m of the ankle above the place its foot stands on, the foot rolling over its heel and its toes."""
    c, s = np.cos(pitch), np.sin(pitch)
    heel = _HEEL[0] * c - _HEEL[1] * s, _HEEL[0] * s + _HEEL[1] * c
    toes = _TOES[0] * c - _TOES[1] * s, _TOES[0] * s + _TOES[1] * c
    return np.where(pitch > 0, _HEEL[0] - heel[0], _TOES[0] - toes[0]), -np.minimum(heel[1], toes[1])


def _pace(gait: np.ndarray, legs: tuple, rise: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pace (n,) m a stride and mean height (n,) m of the hips, as the legs' curves at the phases of `_GRID` say, and
    where each foot stands, (n, 2) m ahead of its hip in the middle of its stance.

    The hips, which are `rise` (n, 7) m above their mean at these phases, are no higher than both legs reach.
    """
    hip, knee, pitch = (value[..., 1:] for value in legs)
    grid = (_GRID - _GRID.mean(1, keepdims=True))[gait]
    x, z = _ankle(hip, knee)
    roll_x, roll_z = _roll_off(pitch)
    stands = x - roll_x
    slope = (stands * grid[:, None]).sum(2) / (grid**2).sum(1)[:, None]
    pace = np.maximum(-slope.mean(1), 0.0)
    center = stands.mean(2) - _BEHIND[gait, None]
    x = center[..., None] + roll_x - (pace[:, None] * grid)[:, None]
    highest = np.sqrt(np.maximum(_STRETCHED**2 - x**2, 0.2)) + roll_z - rise[:, None]
    return pace, np.minimum((roll_z - z).mean((1, 2)), highest.min((1, 2))), center


def _planted(
    gait: np.ndarray,
    late: np.ndarray,
    weight: np.ndarray,
    legs: tuple,
    center: np.ndarray,
    pace: np.ndarray,
    height: np.ndarray,
    shift: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Hip, knee and ankle angles (n, 2), degrees, of the legs with the feet where they belong; late, weight: `_stance`.

    shift (2, n, 2) m: how far the pelvis's own turns bring a leg's hip joint back and up.
    """
    hip, knee, pitch = (value[..., 0] for value in legs)
    x, z = _ankle(hip, knee)
    roll_x, roll_z = _roll_off(pitch)
    stance = _STANCE[gait, None]
    target = center + roll_x - pace[:, None] * (np.minimum(late, stance + _TRAIL) - stance / 2) + shift[0]
    ground = roll_z - height[:, None] - shift[1]
    x = x + _smooth(_FIRST * weight) * (target - x)
    z = np.maximum(z + weight * (ground - z), ground + _TOE_CLEAR * (1 - weight))
    reach = np.hypot(x, z)
    short = np.minimum(1, _STRAIGHT / reach)
    x, z, reach = x * short, z * short, reach * short
    bend = np.arccos(np.clip((reach**2 - _THIGH**2 - _SHANK**2) / (2 * _THIGH * _SHANK), -1, 1))
    thigh = np.arctan2(x, -z) + np.arctan2(_SHANK * np.sin(bend), _THIGH + _SHANK * np.cos(bend))
    hip, knee = thigh - _THIGH_REST, bend - _THIGH_REST + _SHANK_REST
    return np.degrees(hip), np.degrees(knee), np.degrees(pitch - hip + knee)


def _smooth(x: np.ndarray) -> np.ndarray:
    x = np.clip(x, 0, 1)
    return x * x * (3 - 2 * x)
