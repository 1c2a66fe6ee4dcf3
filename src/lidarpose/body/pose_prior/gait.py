"""Walking and running: joint angles as functions of the stride's phase, with feet that do not slide.

The angles of hip, knee and ankle follow published curves of the stride. Once scaled to a person's stride and noise, the
curves do not quite keep the foot on the ground. Therefore each leg's ankle is moved, within the leg's plane, onto the
path of a foot that rolls over a fixed place while the hips advance at constant speed and rise and fall a little.

Phase 0 is the heel strike of the leg. Lengths in meters are those of the mean adult.
"""

from dataclasses import dataclass

import numpy as np
from numpy import ndarray

from lidarpose.body.pose_prior.activities import ANGLE_INDEX, TABLES
from lidarpose.body.pose_prior.constraints import leg_angles

_GAITS = TABLES["gaits"]
GAITS = tuple(_GAITS)
_RUN = GAITS.index("run")
_HARMONICS = 3  # seven events and seven coefficients: the curve passes through all events
_ARM_LAG = 0.03  # fraction of a stride by which the arms trail the legs
# fraction of the stride in which a foot leaves its place, and in which it reaches the next one
_LEAVE, _LAND = 0.14, 0.12
_TRAIL = 0.08  # fraction of a stride after the stance in which a leaving foot's target stays in place
_FIRST = 1.7  # gain of horizontal contact: a foot is above its place before it lands, and advances only once lifted

# the mean adult's leg in its plane: lengths of thigh and shank, m; half the distance between the hips, m; angles of
# thigh and shank from the vertical at rest, rad (`rig.mean_adult_joints`); heel and toes from the ankle (x, z), m
_THIGH, _SHANK, _HALF_HIPS = 0.390, 0.410, 0.075
_THIGH_REST, _SHANK_REST = 0.023, -0.076
_HEEL, _TOES = (-0.05, -0.077), (0.19, -0.075)
# maximum hip-ankle distance of any leg, and of a leg that bears the body, m
_STRAIGHT, _STRETCHED = 0.9985 * (_THIGH + _SHANK), 0.995 * (_THIGH + _SHANK)
_TOE_CLEAR = 0.022  # minimum height of a swinging foot, m
_SIDES = np.array([1.0, -1.0])  # left, right


def _basis(phase: ndarray) -> ndarray:
    """Fourier basis (..., 7) at phase (...)."""
    angle = 2 * np.pi * np.arange(1, _HARMONICS + 1) * phase[..., None]
    return np.concatenate([np.ones((*phase.shape, 1)), np.cos(angle), np.sin(angle)], -1)


def _table(name: str) -> ndarray:
    return np.array([gait[name] for gait in _GAITS.values()])


_COEFFICIENTS = np.stack([np.linalg.solve(_basis(curve[:, 0]), curve[:, 1:]) for curve in _table("curve")])
_STANCE, _BEHIND, _LOWEST, _RISE, _PITCH = map(_table, ("stance", "behind", "lowest", "rise", "pitch"))
_RANGES = {name: _table(name) for name in ("length", "lift", "swing", "elbow", "elbow_swing")}
_CROUCH = _table("crouch")
# phases of the stance at which a stride's pace and height are measured, (3, 7), and the curves there, (3, 7, 3)
_GRID = _STANCE[:, None] * np.linspace(0, 1, 7)
_GRID_CURVES = _basis(_GRID) @ _COEFFICIENTS
_LEG_COLUMNS, _ABD, _ROT, _RAISE, _ELBOW = (
    np.array([[ANGLE_INDEX[f"{side}_{name}"] for side in ("left", "right")] for name in names]).squeeze()
    for names in (("hip", "knee", "ankle"), ("abd",), ("rot",), ("raise",), ("elbow",))
)


@dataclass(frozen=True, kw_only=True)
class Stride:
    """angles (n, 27) degrees; pace (n,) m per stride in the direction of travel, 0 for people who stay in place; height
    (n,) m of the middle of the hips above the ground, 0 for people without a gait."""

    angles: ndarray
    pace: ndarray
    height: ndarray


def add_stride(gait: ndarray, phase: ndarray, style: ndarray, base: ndarray) -> Stride:
    """Adds a stride to the activity's angles of people who walk, run or push.

    Args:
        gait: (n,) into `GAITS`.
        phase: (n,) in strides, 0 at the left heel's strike.
        style: (n, 8) in [0, 1]: stride length, knee lift, arm swing, elbow flexion, elbow swing, crouch, turn of the
            hips, asymmetry of the arms.
        base: (n, 27) degrees, thighs relative to the vertical.
    """
    length, lift, swing, elbow, elbow_swing, crouch, turn, asymmetry = style.T
    # walkers with long strides swing their arms far; most walkers bend their elbows little
    is_running = gait == _RUN
    swing = np.where(is_running, swing, swing * (0.4 + 0.6 * (0.35 + length)))
    elbow = np.where(is_running, elbow, elbow**1.5)
    length, lift, swing, elbow, elbow_swing = (
        _RANGES[name][gait, 0] + _RANGES[name][gait, 1] * value
        for name, value in zip(_RANGES, (length, lift, swing, elbow, elbow_swing), strict=True)
    )
    crouch = _CROUCH[gait] * crouch**1.3
    turn_phase, roll_phase = 2 * np.pi * phase, 2 * np.pi * (phase + 0.05)
    # the hips turn with the leading leg and drop on the swing side; the chest turns the opposite way
    yaw = -(2 + 5 * turn) * length * np.cos(turn_phase)
    roll = (1 + 3 * turn) * np.sin(roll_phase)
    sway = 1.5 * np.sin(roll_phase - 0.2 * np.pi)  # the hips shift over the stance leg
    hip_shift = _HALF_HIPS * np.radians(np.stack([yaw, roll]))[..., None] * _SIDES

    leg_phase = phase[:, None] + np.array([0.0, 0.5])
    stance = _stance(gait, leg_phase % 1)
    legs = _legs(gait, leg_phase, stance, length, lift, crouch, base)
    cycle = np.cos(4 * np.pi * (np.column_stack([phase, _GRID[gait]]) - _LOWEST[gait, None]))
    rise = -_RISE[gait, None] * length[:, None] ** 2 * cycle
    pace, height, center = _pace_and_height(gait, legs, rise[:, 1:])
    height = height + rise[:, 0]
    hip, knee, ankle = _place_feet(gait, stance, legs, center, pace, height, hip_shift)

    angles = base.copy()
    angles[:, _LEG_COLUMNS] = np.stack([hip, knee, ankle], 1)
    # compensate for the motion of the hips, so that the legs stay in their planes
    angles[:, _ABD] -= _SIDES * ((roll + sway)[:, None] + yaw[:, None] * np.sin(np.radians(hip)))
    angles[:, _ROT] -= _SIDES * yaw[:, None]
    arm_swing = -np.cos(2 * np.pi * (leg_phase - _ARM_LAG))  # against the leg of the same side
    angles[:, _RAISE] += swing[:, None] * (1 + 0.5 * _SIDES * (asymmetry[:, None] - 0.5)) * arm_swing
    angles[:, _ELBOW] += elbow[:, None] + elbow_swing[:, None] * (arm_swing + 1) / 2
    for name, change in (("yaw", yaw), ("twist", -1.8 * yaw), ("roll", roll), ("side", -roll)):
        angles[:, ANGLE_INDEX[name]] += change
    return Stride(angles=angles, pace=pace, height=height)


def _stance(gait: ndarray, phase: ndarray) -> tuple[ndarray, ndarray]:
    """phase (n, 2) in [0, 1) of the legs -> phase since the heel strike, below 0 for a foot about to land, and contact
    of the foot with its place on the ground, in [0, 1]."""
    stance_end = _STANCE[gait, None]
    since_strike = np.where(phase > (1 + stance_end) / 2, phase - 1, phase)
    return since_strike, _smooth(1 - (since_strike - stance_end) / _LEAVE) * _smooth(1 + since_strike / _LAND)


def _standing_pitch(gait: ndarray, stance_phase: ndarray, length: ndarray) -> ndarray:
    """Pitch (n, ...), degrees, of a foot on the ground: it lands on its heel, lies flat, then rises on its toes."""
    shape = (-1,) + (1,) * (stance_phase.ndim - 1)
    landing_pitch, flat_phase, rise_phase, leaving_pitch, exponent = (value.reshape(shape) for value in _PITCH[gait].T)
    landing = landing_pitch * np.clip(1 - stance_phase / flat_phase, 0, 1)
    rise_progress = np.maximum((stance_phase - rise_phase) / (_STANCE[gait].reshape(shape) - rise_phase), 0)
    return length * (landing - leaving_pitch * np.minimum(rise_progress, 1.3) ** exponent)


def _legs(
    gait: ndarray, phase: ndarray, stance: tuple, length: ndarray, lift: ndarray, crouch: ndarray, base: ndarray
) -> tuple[ndarray, ndarray, ndarray]:
    """Hip and knee angles and the foot's pitch (positive with toes up), each (n, 2, 1 + 7) rad, of both legs: first at
    phase (n, 2), then at the stance phases of `_GRID`. stance: result of `_stance`."""
    stance_phase, contact = stance
    length, lift, crouch = (value[:, None, None] for value in (length, lift, crouch))
    grid = np.broadcast_to(_GRID_CURVES[gait, None], (len(phase), 2, 7, 3))
    curves = np.concatenate([(_basis(phase) @ _COEFFICIENTS[gait])[:, :, None], grid], 2)
    base_hip, base_knee, base_ankle = np.moveaxis(base[:, _LEG_COLUMNS], 1, 0)[..., None]
    hip = length * (curves[..., 0] - 4) + 4 + 0.45 * crouch + base_hip
    # the knee bends less in short strides
    knee = curves[..., 1] * lift * np.clip(0.45 + 0.55 * length, 0, 1.4) + crouch + base_knee
    ankle = curves[..., 2] * np.clip(length, 0.5, 1.2) + 0.5 * crouch + base_ankle
    grid = np.broadcast_to(_GRID[gait, None], (len(phase), 2, 7))
    standing_pitch = _standing_pitch(gait, np.concatenate([stance_phase[..., None], grid], 2), length)
    contact = np.concatenate([contact[..., None], np.ones(grid.shape)], 2)
    pitch = hip - knee + ankle
    return np.radians(hip), np.radians(knee), np.radians(pitch + contact * (standing_pitch - pitch))


def _ankle(hip: ndarray, knee: ndarray) -> tuple[ndarray, ndarray]:
    """x and z m of the ankle relative to its hip joint, for angles in rad."""
    thigh, shank = hip + _THIGH_REST, hip - knee + _SHANK_REST
    return _THIGH * np.sin(thigh) + _SHANK * np.sin(shank), -_THIGH * np.cos(thigh) - _SHANK * np.cos(shank)


def _roll_off(pitch: ndarray) -> tuple[ndarray, ndarray]:
    """x and z m of the ankle relative to the place on which its foot stands and rolls over heel and toes."""
    c, s = np.cos(pitch), np.sin(pitch)
    heel = _HEEL[0] * c - _HEEL[1] * s, _HEEL[0] * s + _HEEL[1] * c
    toes = _TOES[0] * c - _TOES[1] * s, _TOES[0] * s + _TOES[1] * c
    return np.where(pitch > 0, _HEEL[0] - heel[0], _TOES[0] - toes[0]), -np.minimum(heel[1], toes[1])


def _pace_and_height(gait: ndarray, legs: tuple, rise: ndarray) -> tuple[ndarray, ndarray, ndarray]:
    """Pace (n,) m per stride and mean height (n,) m of the hips, from the legs' curves at the phases of `_GRID`, and
    the position (n, 2) m of each foot ahead of its hip at mid-stance.

    The hips are `rise` (n, 7) m above their mean at these phases. They are no higher than both legs reach.
    """
    hip, knee, pitch = (value[..., 1:] for value in legs)
    grid = (_GRID - _GRID.mean(1, keepdims=True))[gait]
    x, z = _ankle(hip, knee)
    roll_x, roll_z = _roll_off(pitch)
    foot_position = x - roll_x
    slope = (foot_position * grid[:, None]).sum(2) / (grid**2).sum(1)[:, None]
    pace = np.maximum(-slope.mean(1), 0.0)
    center = foot_position.mean(2) - _BEHIND[gait, None]
    x = center[..., None] + roll_x - (pace[:, None] * grid)[:, None]
    max_height = np.sqrt(np.maximum(_STRETCHED**2 - x**2, 0.2)) + roll_z - rise[:, None]
    return pace, np.minimum((roll_z - z).mean((1, 2)), max_height.min((1, 2))), center


def _place_feet(
    gait: ndarray, stance: tuple, legs: tuple, center: ndarray, pace: ndarray, height: ndarray, shift: ndarray
) -> tuple[ndarray, ndarray, ndarray]:
    """Hip, knee and ankle angles (n, 2), degrees, that put the feet in their places; stance: result of `_stance`.

    shift (2, n, 2) m: displacement of a leg's hip joint, backward and upward, by the rotation of the pelvis.
    """
    stance_phase, contact = stance
    hip, knee, pitch = (value[..., 0] for value in legs)
    x, z = _ankle(hip, knee)
    roll_x, roll_z = _roll_off(pitch)
    stance_end = _STANCE[gait, None]
    target = (
        center + roll_x - pace[:, None] * (np.minimum(stance_phase, stance_end + _TRAIL) - stance_end / 2) + shift[0]
    )
    ground = roll_z - height[:, None] - shift[1]
    x = x + _smooth(_FIRST * contact) * (target - x)
    z = np.maximum(z + contact * (ground - z), ground + _TOE_CLEAR * (1 - contact))
    reach = np.hypot(x, z)
    shortening = np.minimum(1, _STRAIGHT / reach)
    x, z, reach = x * shortening, z * shortening, reach * shortening
    bend, fold = leg_angles(reach, _THIGH, _SHANK)
    thigh = np.arctan2(x, -z) + fold
    hip, knee = thigh - _THIGH_REST, bend - _THIGH_REST + _SHANK_REST
    return np.degrees(hip), np.degrees(knee), np.degrees(pitch - hip + knee)


def _smooth(x: ndarray) -> ndarray:
    x = np.clip(x, 0, 1)
    return x * x * (3 - 2 * x)
