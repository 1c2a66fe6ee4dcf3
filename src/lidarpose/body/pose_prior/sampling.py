"""The pose prior: human poses drawn at random from a table of activities.

A pose is 27 angles (`ANGLES`, degrees, the same sign on both sides of the body), computed from a few latents: a kind of
activity, a kind of arm pose for each side, the position between the two ends of the activity's range, noise, and for
gaits a phase. `latents` defines how they change over time. The angles are then processed as follows:

1. They are clipped to the joints' ranges; left and right are swapped in half of the poses.
2. Arms are moved out of the trunk.
3. Standing people are set on both feet and balanced (`constraints.balanced`).
4. People on the floor are fitted to it (`constraints.fitted_to_floor`).
5. One matrix product converts the angles to Euler angles of the 24 bones.
6. Bodies that intersect themselves (`constraints.self_collision`), or whose supporting parts do not rest on the ground
   (`constraints.hovering`), are replaced by spare ones.

Frame of the result: x forward, y left, z up, facing +x, in the rest pose of `rig` (T-pose, every bone's axes along
the body's).
"""

from dataclasses import dataclass

import numpy as np

from lidarpose.body.pose_prior import activities, constraints
from lidarpose.body.pose_prior.activities import (
    ANGLE_INDEX,
    ANGLES,
    KINDS,
    LIMITS,
    mirror_angles,
    rotations_from_angles,
)
from lidarpose.body.pose_prior.gait import GAITS, Stride, add_stride
from lidarpose.body.pose_prior.latents import Latents, draw_latents
from lidarpose.body.rig import forward_kinematics, heading, mean_adult_joints, without_yaw
from lidarpose.errors import InputError, check_finite, check_int, check_name
from lidarpose.geometry import rotation_about
from lidarpose.skeleton import SMPL24

_ARM = {side: slice(ANGLE_INDEX[f"{side}_raise"], ANGLE_INDEX[f"{side}_elbow"] + 1) for side in ("left", "right")}
_BOTH_ARMS = np.r_[_ARM["left"], _ARM["right"]]
_ARM_LIMITS = LIMITS[:, _ARM["left"]]
_CAPTURED, _RUN, _CYCLE, _FALL = (KINDS.index(name) for name in ("captured", "run", "cycle", "fall"))
_NO_LEG = np.array([not name.endswith(("hip", "knee", "ankle")) for name in ANGLES])
_GAIT = np.array([GAITS.index(name) if name in GAITS else -1 for name in KINDS])
_TRAVELS = tuple(KINDS.index(name) for name in (*GAITS, "cycle"))
_EARLY_FALL = 0.15  # clips of falls begin in this first fraction of the fall
# distance traveled per turn of a bicycle's cranks, m: minimum and range (city gears)
_GEAR = (3.2, 1.8)
_HIPS_DOWN = 0.095  # m from the pelvis down to the hips' middle
_MOMENT = 0.05  # s: maximum time step for integrating a body's displacement over the ground
# a body is rejected if its parts overlap by more than this depth, m, or if its support is more than this gap above the
# ground, m; clips are checked at this interval, s
_MOST_DEPTH, _MOST_GAP, _CHECK_EVERY = 0.02, 0.06, 0.2
# a clip is rejected as often as any of this many independent poses
_CLIP_POSES = 2.5
# spare samples that replace rejected ones: fraction of n for poses and for clips, plus a constant number
_SPARES, _CLIP_SPARES, _LEAST_SPARES = 0.3, 0.8, 3

# collision model of arm and trunk, m, mean adult: an upright elliptic cylinder around the spine with half the trunk's
# depth and width plus the arm's radius; distance of the shoulder from the spine; lengths of the arm's bones
_TRUNK_DEPTH, _TRUNK_WIDTH, _SHOULDER = 0.15, 0.17, 0.18
_UPPER_ARM, _FOREARM = 0.27, 0.25
_FOREARM_POINTS = np.array([0.5, 1.0, 1.25])[:, None]  # as fractions of the forearm: its middle, the wrist, the hand
# angles (ARM_ANGLES) added in each try to move an arm out of the trunk, and the number of tries
_FREE_ARM, _TRIES = np.array([16.0, 6.0, -16.0, 0.0]), 3


@dataclass(frozen=True, kw_only=True)
class DrawnPoses:
    """Drawn poses. rotations (n, 24, 3, 3) float32, local, facing +x; kind (n,) indices into `KINDS`; moved
    (n, 24, 3, 3) float32, the local rotations dt seconds later, and step (n, 3) float32 m, the displacement of the root
    until then, both in the axes of `rotations`. With dt = 0, moved equals rotations and step is 0."""

    rotations: np.ndarray
    kind: np.ndarray
    moved: np.ndarray
    step: np.ndarray


@dataclass(frozen=True, kw_only=True)
class DrawnClips:
    """People in motion. rotations (n, F, 24, 3, 3) float32, local, the first frame facing +x; translation (n, F, 3)
    float32 m, displacement of the pelvis since the first frame on flat ground (z for the mean adult); clearance (n, F)
    float32 m, height of the lowest point above the ground; kind (n,) indices into `KINDS`."""

    rotations: np.ndarray
    translation: np.ndarray
    clearance: np.ndarray
    kind: np.ndarray


def sample_rotations(
    rng: np.random.Generator, n: int, *, mix: dict[str, float] | None = None, dt: float = 0.0
) -> DrawnPoses:
    """Draws n poses from the prior and, if dt > 0, those dt seconds later. The first poses do not depend on dt.

    Args:
        mix: Weights of the kinds by name (`KINDS`), not necessarily normalized; by default the mix of people at a road
            or a workplace.

    Returns:
        Poses whose root may tilt and roll but has no yaw (`rig.heading` is 0).

    Raises:
        InputError: For a negative n or dt, and for a mix with unknown names or no positive weight.
    """
    n = check_int("n", n, least=0)
    if not 0 <= dt < np.inf:
        raise InputError(f"dt must be seconds, 0 or more, got {dt}")
    latents, rotations = _draw_people(rng, n, _kind_shares(mix), np.zeros(1))
    if dt == 0:
        rotations = without_yaw(rotations[:, 0])
        return DrawnPoses(rotations=rotations, kind=latents.kind, moved=rotations, step=np.zeros((n, 3), np.float32))
    motion = _motion(latents, np.linspace(0, dt, 1 + int(np.ceil(dt / _MOMENT))))
    return DrawnPoses(
        rotations=motion.rotations[:, 0],
        kind=motion.kind,
        moved=motion.rotations[:, -1],
        step=motion.translation[:, -1],
    )


def sample_clips(
    rng: np.random.Generator, n: int, *, frames: int, hz: float = 10.0, mix: dict[str, float] | None = None
) -> DrawnClips:
    """Draws n people in motion, `frames` frames at `hz` frames per second; mix as in `sample_rotations`.

    Raises:
        InputError: For a negative n or frames, hz <= 0, or an invalid mix.
    """
    n, frames = check_int("n", n, least=0), check_int("frames", frames, least=0)
    if not 0 < hz < np.inf:
        raise InputError(f"clips need hz > 0, got {hz}")
    duration = max(0, frames - 1) / hz
    latents, _ = _draw_people(rng, n, _kind_shares(mix), np.arange(0, duration + _CHECK_EVERY, _CHECK_EVERY))
    substeps = max(1, int(np.ceil(1 / (hz * _MOMENT))))
    motion = _motion(latents, np.linspace(0, duration, max(0, frames - 1) * substeps + 1))
    rotations, translation, clearance = (
        value[:, ::substeps][:, :frames] for value in (motion.rotations, motion.translation, motion.clearance)
    )
    return DrawnClips(rotations=rotations, translation=translation, clearance=clearance, kind=motion.kind)


def sample_poses(n: int, seed: int) -> np.ndarray:
    """Draws n poses of the default mix on the mean adult.

    Returns:
        (n, 24, 3) float32 m, SMPL's joints in SMPL's order, z up, facing +x, the pelvis at the origin.

    Raises:
        InputError: Unless n and seed are whole numbers of 0 or more.
    """
    n = check_int("n", n, least=0)
    rotations = sample_rotations(np.random.default_rng(check_int("seed", seed, least=0)), n).rotations
    joints = forward_kinematics(SMPL24.parents, mean_adult_joints()[None], rotations, np.zeros((n, 3)))[1]
    return joints.astype(np.float32)


def _kind_shares(mix: dict[str, float] | None) -> np.ndarray:
    if mix is None:
        return activities.SHARES
    for name, weight in mix.items():
        check_name("kind of pose", name, KINDS)
        check_finite(f"the mix's weight of {name}", weight)
    shares = np.array([float(mix.get(name, 0)) for name in KINDS])
    if (shares < 0).any() or not shares.any():
        raise InputError(f"a mix needs weights of 0 or more and one above 0, got {mix}")
    # the sum of large weights may overflow
    shares /= shares.max()
    return shares / shares.sum()


def _draw_people(rng: np.random.Generator, n: int, shares: np.ndarray, times: np.ndarray) -> tuple[Latents, np.ndarray]:
    """Draws n people, the kinds with probabilities `shares` (K,), who do not intersect themselves and rest on the
    ground at times (T,) s. Returns their latents and rotations (n, T, 24, 3, 3) including yaw.

    Spare people are drawn as well, mostly of kinds that are often rejected, and replace the rejected people. If there
    are too few spares, the last rejected people are kept.
    """
    is_clip = len(times) > 1
    refused_share = 1 - (1 - activities.SELF_COLLISION) ** (_CLIP_POSES if is_clip else 1)
    spare_shares = shares * refused_share / (1 - refused_share)
    spare_count = int(np.ceil(n * (_CLIP_SPARES if is_clip else _SPARES))) + _LEAST_SPARES if n else 0
    groups = (n, shares), (spare_count, spare_shares / spare_shares.sum())
    kind = np.concatenate([rng.choice(len(KINDS), count, p=p) for count, p in groups])
    latents = draw_latents(rng, kind)
    if is_clip:
        latents.where[kind == _FALL, 0] *= _EARLY_FALL
    rotations = _poses(latents, times)[0]
    is_invalid = _violates_constraints(rotations, kind)
    rows, refused_rows, spare_rows = np.arange(n), np.flatnonzero(is_invalid[:n]), n + np.flatnonzero(~is_invalid[n:])
    rows[refused_rows[: len(spare_rows)]] = spare_rows[: len(refused_rows)]
    return latents.take(rows), rotations[rows]


def _violates_constraints(rotations: np.ndarray, kind: np.ndarray) -> np.ndarray:
    """rotations (n, T, 24, 3, 3) of the kinds (n,) -> (n,) bool: at some time, body parts overlap too much or a
    supporting part is above the ground."""
    ends = constraints.capsule_ends(*constraints.body_frames(rotations.reshape(-1, 24, 3, 3)))
    is_invalid = constraints.self_collision(ends).max(1) > _MOST_DEPTH
    is_invalid |= constraints.hovering(ends, np.repeat(kind, rotations.shape[1])) > _MOST_GAP
    return is_invalid.reshape(rotations.shape[:2]).any(1)


def _poses(latents: Latents, times: np.ndarray) -> tuple[np.ndarray, Stride]:
    """Rotations (n, T, 24, 3, 3) at times (T,) s including yaw, and the strides (n T)."""
    n, moments = len(latents), len(times)
    if moments > 1 or times[0] != 0:
        latents = latents.take(np.repeat(np.arange(n), moments)).at(np.tile(times, n))
    stride = _angles(latents)
    angles = constraints.balanced(_free_arms(stride.angles, moments), latents.kind)
    angles = constraints.fitted_to_floor(angles, latents.kind)
    return rotations_from_angles(angles).reshape(n, moments, 24, 3, 3), stride


def _motion(latents: Latents, times: np.ndarray) -> DrawnClips:
    """The people at times (T,) s, facing +x at the first time, which is 0."""
    n, moments = len(latents), len(times)
    rotations, stride = _poses(latents, times)
    inverse_yaw = rotation_about("z", -heading(rotations[:, 0])).astype(np.float32)
    rotations[:, :, 0] = inverse_yaw[:, None] @ rotations[:, :, 0]
    flat_rotations = rotations.reshape(-1, 24, 3, 3)
    capsules = constraints.undersides(constraints.capsule_ends(*constraints.body_frames(flat_rotations)))
    points = np.concatenate([constraints.sole_points(flat_rotations).reshape(len(flat_rotations), 8, 3), capsules], 1)
    points = points.reshape(n, moments, points.shape[1], 3)
    displacement = constraints.planted_displacement(points)
    is_traveling = np.isin(latents.kind, _TRAVELS)
    if is_traveling.any():
        course = latents.course(times)[is_traveling]
        pace = stride.pace.reshape(n, moments)[is_traveling]
        path = constraints.walked_displacement(
            pace, latents.strides(np.broadcast_to(times, (n, moments)))[is_traveling], course
        )
        displacement[is_traveling, :, :2] = path @ np.swapaxes(inverse_yaw[is_traveling, :2, :2], -1, -2)
        rotations[is_traveling, :, 0] = rotation_about("z", course).astype(np.float32) @ rotations[is_traveling, :, 0]
    lowest_height = points[..., 2].min(2)
    # a runner's hips follow the gait's height in the flight phase, too; a cyclist's keep their height
    hip_height = stride.height.reshape(n, moments) + _HIPS_DOWN * flat_rotations[:, 0, 2, 2].reshape(n, moments)
    is_running, is_cycling = latents.kind == _RUN, latents.kind == _CYCLE
    clearance = np.where(is_running[:, None], np.maximum(hip_height + lowest_height, 0), 0)
    clearance[is_cycling] = lowest_height[is_cycling] - lowest_height[is_cycling].min(1, keepdims=True)
    height = clearance - lowest_height
    displacement[..., 2] = height - height[:, :1]
    translation, clearance = displacement.astype(np.float32), clearance.astype(np.float32)
    return DrawnClips(rotations=rotations, translation=translation, clearance=clearance, kind=latents.kind)


def _angles(latents: Latents) -> Stride:
    """The poses' angles (n, 27), degrees, clipped to the joints' ranges; arms may still be in the trunk."""
    kind, captured_angles = latents.kind, latents.captured[:, 0]
    start, end, spread = activities.KIND_RANGES[:, kind]
    # the cranks of a bicycle move only the legs
    range_fraction = np.where((kind == _CYCLE)[:, None] & _NO_LEG, latents.style[:, 1:2], latents.where[:, :1])
    angles = start + range_fraction * (end - start) + spread * latents.noise
    pace, height = np.zeros((2, len(kind)))
    rows = np.flatnonzero(_GAIT[kind] >= 0)
    if len(rows):
        stride = add_stride(_GAIT[kind[rows]], latents.phase[rows], latents.style[rows], angles[rows])
        angles[rows], pace[rows], height[rows] = stride.angles, stride.pace, stride.height
    is_cycling = kind == _CYCLE
    pace[is_cycling] = _GEAR[0] + _GEAR[1] * latents.style[is_cycling, 0]
    angles[kind == _CAPTURED] = captured_angles[kind == _CAPTURED]

    # the table gives thighs relative to the vertical and feet relative to the floor: convert both to joint angles
    for side in ("left", "right"):
        hip, knee, ankle = (ANGLE_INDEX[f"{side}_{name}"] for name in ("hip", "knee", "ankle"))
        angles[:, ankle] += activities.FLAT_FOOT[kind] * (angles[:, knee] - angles[:, hip])
        angles[:, hip] += activities.UPRIGHT[kind] * angles[:, ANGLE_INDEX["tilt"]]

    for column, arm_columns in enumerate(_ARM.values()):
        arm = latents.arm[:, column]
        rows = np.flatnonzero(arm != activities.OWN_ARMS)
        start, end, spread = activities.ARM_RANGES[:, arm[rows]]
        arm_fraction = latents.where[rows, 1 + column, None]
        angles[rows, arm_columns] = start + arm_fraction * (end - start) + spread * latents.noise[rows, arm_columns]
        rows = np.flatnonzero(arm == activities.CAPTURED_ARMS)
        angles[rows, arm_columns] = captured_angles[rows, arm_columns]
    angles = np.clip(angles, LIMITS[0], LIMITS[1])
    angles = np.where(latents.mirror[:, None], mirror_angles(angles), angles)
    return Stride(angles=angles, pace=pace, height=height)


def _free_arms(angles: np.ndarray, moments: int) -> np.ndarray:
    """angles (n * moments, 27) with the arms moved forward and outward, and with less inward turn, until the forearms
    at each person's first moment are outside the trunk. All moments of a person get the same correction."""
    arm_angles = angles[::moments, _BOTH_ARMS].reshape(-1, 4)
    rows = np.arange(len(arm_angles))
    correction = np.zeros_like(arm_angles)
    for _ in range(_TRIES):
        rows = rows[_in_trunk(np.clip(arm_angles[rows] + correction[rows], *_ARM_LIMITS))]
        is_behind = arm_angles[rows, :1] < -20  # hands behind the back are moved further back
        correction[rows] += np.where(is_behind, _FREE_ARM * [-0.5, 1.5, -1, 0], _FREE_ARM)
    angles[:, _BOTH_ARMS] = np.clip(
        angles[:, _BOTH_ARMS] + np.repeat(correction.reshape(-1, 8), moments, 0), *np.tile(_ARM_LIMITS, 2)
    )
    return angles


def _in_trunk(arm_angles: np.ndarray) -> np.ndarray:
    """Whether the forearm's middle, the wrist or the hand is inside the trunk, (n,) bool; arm_angles (n, 4) degrees,
    with the signs of a left arm."""
    rad = np.radians(arm_angles)
    (cr, co, ci, ce), (sr, so, si, se) = np.cos(rad).T, np.sin(rad).T
    # columns of R_y(-raised) R_x(out - 90) R_y(inward): y is along the arm, the elbow bends toward x
    crso, srso = cr * so, sr * so
    x = _UPPER_ARM * sr * co + _FOREARM * _FOREARM_POINTS * (se * (cr * ci + srso * si) + ce * sr * co)
    y = _UPPER_ARM * so + _FOREARM * _FOREARM_POINTS * (ce * so - se * co * si)
    z = -_UPPER_ARM * cr * co + _FOREARM * _FOREARM_POINTS * (se * (sr * ci - crso * si) - ce * cr * co)
    # there is no trunk above the shoulders; the arm starts at the trunk's side
    return (((x / _TRUNK_DEPTH) ** 2 + ((y + _SHOULDER) / _TRUNK_WIDTH) ** 2 < 1) & (z < 0.02)).any(0)
