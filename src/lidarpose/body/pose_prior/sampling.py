"""The pose prior: what people's bodies do, drawn at random from a table of activities.

A pose is 27 angles (`ANGLES`, degrees, the same sign on both sides of the body), made from a few latents: a kind of
activity, a kind of arm for each side, where between the two ends of its range the activity stands, noise, and for
gaits a phase; `latents` says how they go on in time. The angles are kept inside the joints' ranges, left and right are
exchanged in half of the poses, arms are pushed out of the trunk, standing people are set on both feet and balanced
(`balance`), one matrix product turns the angles into Euler angles of the 24 bones, and bodies that pass through
themselves (`solid`) are replaced by spare ones.

Frame of the result: x forward, y left, z up, facing +x, in the rest pose of `rig` (T-pose, every bone's axes along
the body's).
"""

from dataclasses import dataclass

import numpy as np

from lidarpose.body.mocap.retarget import heading, mean_adult_joints, without_yaw
from lidarpose.body.pose_prior.activities import (
    ANGLES,
    ARM_ANGLES,
    ARM_NAMES,
    ARMS,
    CAPTURED_ARMS,
    KINDS,
    LIMITS,
    OWN_ARMS,
    SHARES,
    TABLE,
)
from lidarpose.body.pose_prior.balance import settled
from lidarpose.body.pose_prior.capsules import body_frames, capsule_ends, depths, undersides
from lidarpose.body.pose_prior.gait import GAITS, strides
from lidarpose.body.pose_prior.ground_contact import pinned, sole_points, walked
from lidarpose.body.pose_prior.joint_angles import mirror_angles, rotations_from_angles
from lidarpose.body.pose_prior.latents import Latents, draw_latents
from lidarpose.errors import InputError, check_finite, check_name, whole
from lidarpose.geometry import rotation_about
from lidarpose.skeleton import SMPL24

_A = {name: i for i, name in enumerate(ANGLES)}
_ARM = {side: slice(_A[f"{side}_raise"], _A[f"{side}_elbow"] + 1) for side in ("left", "right")}
_BOTH_ARMS = np.r_[_ARM["left"], _ARM["right"]]
_ARM_LIMITS = LIMITS[:, _ARM["left"]]
_CAPTURED, _RUN, _CYCLE, _FALL = (KINDS.index(name) for name in ("captured", "run", "cycle", "fall"))
_NO_LEG = np.array([not name.endswith(("hip", "knee", "ankle")) for name in ANGLES])
_GAIT = np.array([GAITS.index(name) if name in GAITS else -1 for name in KINDS])
_GOING = tuple(KINDS.index(name) for name in (*GAITS, "cycle"))
_STILL_UP = 0.15  # clips of falls begin early in them
# what a turn of a bicycle's cranks makes, m: least, and how much more (city gears)
_GEAR = (3.2, 1.8)
_HIPS_DOWN = 0.095  # m from the pelvis down to the hips' middle
_MOMENT = 0.05  # s: bodies roll over the ground in steps of at most this
# bodies whose parts are deeper in each other than this, m, are refused; clips are looked at every so many seconds
_TOUCH, _LOOK_EVERY = 0.02, 0.2
# share of the poses of a kind that are, measured; of a clip's some moment is, as if it were so many poses
_OFTEN = {
    "idle": 0.08, "walk": 0.04, "run": 0.09, "sit": 0.20, "crouch": 0.30, "bend": 0.10, "kneel": 0.22, "step": 0.08,
    "push": 0.03, "lie": 0.06, "sport": 0.05, "captured": 0.26,
}  # fmt: skip
_TANGLED, _LONGER = np.array([_OFTEN.get(name, 0.01) for name in KINDS]), 2.5
# people drawn to stand in for the refused: shares of all, of poses and of clips, and at least so many
_SPARES, _CLIP_SPARES, _LEAST_SPARES = 0.3, 0.8, 3


@dataclass(frozen=True, kw_only=True)
class PosePrior:
    """Drawn poses. rotations (n, 24, 3, 3) float32, local, facing +x; kind (n,) indices into `KINDS`; moved
    (n, 24, 3, 3) float32 the local rotations dt seconds later, step (n, 3) float32 m the way of the root until then,
    both in the axes of `rotations`. With dt = 0 nothing has moved."""

    rotations: np.ndarray
    kind: np.ndarray
    moved: np.ndarray
    step: np.ndarray


@dataclass(frozen=True, kw_only=True)
class DrawnClips:
    """People in motion. rotations (n, F, 24, 3, 3) float32, local, the first frame facing +x; translation (n, F, 3)
    float32 m, the way of the pelvis since the first frame on flat ground (z: on the mean adult); clearance (n, F)
    float32 m, how far the lowest point is above the ground (`contact.stand`); kind (n,) indices into `KINDS`."""

    rotations: np.ndarray
    translation: np.ndarray
    clearance: np.ndarray
    kind: np.ndarray


def sample_rotations(
    rng: np.random.Generator, n: int, *, mix: dict[str, float] | None = None, dt: float = 0.0
) -> PosePrior:
    """n poses from the prior, and with dt > 0 what they are dt seconds later.

    mix gives the shares of the kinds (names of `KINDS`, any positive weights); by default people as a sensor beside
    a road or at work sees them. The root leans and tilts but has no yaw (`retarget.heading` is 0). The poses do not
    depend on dt. Raises InputError for a negative n or dt or a mix with unknown names or without weight.
    """
    n = whole("n", n, least=0)
    if not 0 <= dt < np.inf:
        raise InputError(f"dt must be seconds, 0 or more, got {dt}")
    latents, rotations = _drawn(rng, n, _shares(mix), np.zeros(1))
    if dt == 0:
        rotations = without_yaw(rotations[:, 0])
        return PosePrior(rotations=rotations, kind=latents.kind, moved=rotations, step=np.zeros((n, 3), np.float32))
    motion = _motion(latents, np.linspace(0, dt, 1 + int(np.ceil(dt / _MOMENT))))
    return PosePrior(
        rotations=motion.rotations[:, 0], kind=latents.kind, moved=motion.rotations[:, -1], step=motion.way[:, -1]
    )


def sample_clips(
    rng: np.random.Generator, n: int, *, frames: int, hz: float = 10.0, mix: dict[str, float] | None = None
) -> DrawnClips:
    """n people who go on with what they do, `frames` moments at `hz` a second; mix as in `sample_rotations`.

    Raises InputError for a negative n or frames, hz <= 0, or a wrong mix.
    """
    n, frames = whole("n", n, least=0), whole("frames", frames, least=0)
    if not 0 < hz < np.inf:
        raise InputError(f"clips need hz > 0, got {hz}")
    last = max(0, frames - 1) / hz
    latents, _ = _drawn(rng, n, _shares(mix), np.arange(0, last + _LOOK_EVERY, _LOOK_EVERY))
    between = max(1, int(np.ceil(1 / (hz * _MOMENT))))
    motion = _motion(latents, np.linspace(0, last, max(0, frames - 1) * between + 1))
    rotations, way, clearance = (
        value[:, ::between][:, :frames] for value in (motion.rotations, motion.way, motion.clearance)
    )
    return DrawnClips(rotations=rotations, translation=way, clearance=clearance, kind=latents.kind)


@dataclass(frozen=True, kw_only=True)
class _Stride:
    """angles (n, 27) degrees; pace (n,) m a stride or a turn of the cranks, 0 for who does not go; height (n,) m of the
    hips above the ground, 0 for who does not walk."""

    angles: np.ndarray
    pace: np.ndarray
    height: np.ndarray


def _drawn(rng: np.random.Generator, n: int, shares: np.ndarray, times: np.ndarray) -> tuple[Latents, np.ndarray]:
    """n people who do not pass through themselves at times (T,) s, the kinds in the shares (K,); and their rotations
    (n, T, 24, 3, 3) with the yaw they have.

    Spares are drawn along, of the kinds that are often refused; each stands in for somebody who is. Where there are
    too few of them, the last stay as they are.
    """
    tangled = 1 - (1 - _TANGLED) ** (1 if len(times) == 1 else _LONGER)
    missed = shares * tangled / (1 - tangled)
    spare = int(np.ceil(n * (_SPARES if len(times) == 1 else _CLIP_SPARES))) + _LEAST_SPARES if n else 0
    kind = np.concatenate([rng.choice(len(KINDS), k, p=p) for k, p in ((n, shares), (spare, missed / missed.sum()))])
    latents = draw_latents(rng, kind)
    if len(times) > 1:
        latents.where[kind == _FALL, 0] *= _STILL_UP
    rotations = _poses(latents, times)[0]
    touches = _depth(rotations) > _TOUCH
    chosen, refused, free = np.arange(n), np.flatnonzero(touches[:n]), n + np.flatnonzero(~touches[n:])
    chosen[refused[: len(free)]] = free[: len(refused)]
    return latents.take(chosen), rotations[chosen]


def _depth(rotations: np.ndarray) -> np.ndarray:
    """rotations (n, T, 24, 3, 3) -> (n,) m: how deep each body's parts are in each other at the worst moment."""
    ends = capsule_ends(*body_frames(rotations.reshape(-1, 24, 3, 3)))
    return depths(ends).max(1).reshape(rotations.shape[:2]).max(1, initial=-np.inf)


def _poses(latents: Latents, times: np.ndarray) -> tuple[np.ndarray, _Stride]:
    """Rotations (n, T, 24, 3, 3) at times (T,) s with the yaw they have, and what strides say (n T)."""
    moments = len(times)
    many = latents if moments == 1 and times[0] == 0 else latents.repeated(moments).at(np.tile(times, len(latents)))
    stride = _angles(many)
    angles = settled(_freed(stride.angles, moments), many.kind)
    return rotations_from_angles(angles).reshape(len(latents), moments, 24, 3, 3), stride


@dataclass(frozen=True, kw_only=True)
class _Motion:
    """rotations (n, T, 24, 3, 3), way (n, T, 3) m and clearance (n, T) m: see `DrawnClips`."""

    rotations: np.ndarray
    way: np.ndarray
    clearance: np.ndarray


def _motion(latents: Latents, times: np.ndarray) -> _Motion:
    """The people at times (T,) s, facing +x at the first, which is 0."""
    n, moments = len(latents), len(times)
    rotations, stride = _poses(latents, times)
    turn = rotation_about("z", -heading(rotations[:, 0])).astype(np.float32)
    rotations[:, :, 0] = turn[:, None] @ rotations[:, :, 0]
    if moments == 1:
        return _Motion(rotations=rotations, way=np.zeros((n, 1, 3), np.float32), clearance=np.zeros((n, 1), np.float32))
    flat = rotations.reshape(-1, 24, 3, 3)
    balls = undersides(capsule_ends(*body_frames(flat)))
    points = np.concatenate([sole_points(flat).reshape(len(flat), 8, 3), balls], 1)
    points = points.reshape(n, moments, points.shape[1], 3)
    way = pinned(points)
    goes = np.isin(latents.kind, _GOING)
    if goes.any():
        course = latents.course(times)[goes]
        pace = stride.pace.reshape(n, moments)[goes]
        ahead = walked(pace, latents.strides(np.broadcast_to(times, (n, moments)))[goes], course)
        way[goes, :, :2] = ahead @ np.swapaxes(turn[goes, :2, :2], -1, -2)
        rotations[goes, :, 0] = rotation_about("z", course).astype(np.float32) @ rotations[goes, :, 0]
    low = points[..., 2].min(2)
    # a runner's hips go on between two steps, a cyclist's stay where they are
    hips = stride.height.reshape(n, moments) + _HIPS_DOWN * flat[:, 0, 2, 2].reshape(n, moments)
    runs, cycles = latents.kind == _RUN, latents.kind == _CYCLE
    clearance = np.where(runs[:, None], np.maximum(hips + low, 0), 0)
    clearance[cycles] = low[cycles] - low[cycles].min(1, keepdims=True)
    height = clearance - low
    way[..., 2] = height - height[:, :1]
    return _Motion(rotations=rotations, way=way.astype(np.float32), clearance=clearance.astype(np.float32))


def sample_poses(n: int, seed: int) -> np.ndarray:
    """n poses of the default mix on the mean adult: (n, 24, 3) float32 m, SMPL's order, z up, facing +x.

    Raises InputError unless n and seed are whole numbers of 0 or more.
    """
    from lidarpose.body.rig import forward_kinematics

    n = whole("n", n, least=0)
    rotations = sample_rotations(np.random.default_rng(whole("seed", seed, least=0)), n).rotations
    return forward_kinematics(SMPL24.parents, mean_adult_joints()[None], rotations, np.zeros((n, 3)))[1].astype(
        np.float32
    )


def _shares(mix: dict[str, float] | None) -> np.ndarray:
    if mix is None:
        return SHARES
    for name, weight in mix.items():
        check_name("kind of pose", name, KINDS)
        check_finite(f"the mix's weight of {name}", weight)
    shares = np.array([float(mix.get(name, 0)) for name in KINDS])
    if (shares < 0).any() or not shares.any():
        raise InputError(f"a mix needs weights of 0 or more and one above 0, got {mix}")
    # a sum of large ones may be infinite
    shares /= shares.max()
    return shares / shares.sum()


def _angles(latents: Latents) -> _Stride:
    """The poses' angles (n, 27), degrees, inside the joints' ranges; arms may be in the trunk."""
    kind = latents.kind
    start, end, spread = TABLE.start[kind], TABLE.end[kind], TABLE.spread[kind]
    # the cranks of a bicycle move the legs alone
    place = np.where((kind == _CYCLE)[:, None] & _NO_LEG, latents.style[:, 1:2], latents.where[:, :1])
    angles = start + place * (end - start) + spread * latents.noise
    pace, height = np.zeros((2, len(kind)))
    rows = np.flatnonzero(_GAIT[kind] >= 0)
    if len(rows):
        made = strides(_GAIT[kind[rows]], latents.phase[rows], latents.style[rows], angles[rows])
        angles[rows], pace[rows], height[rows] = made.angles, made.pace, made.height
    rows = kind == _CYCLE
    pace[rows] = _GEAR[0] + _GEAR[1] * latents.style[rows, 0]

    captured = np.zeros_like(angles)
    captured[latents.from_capture] = latents.captured[:, 0]
    angles[kind == _CAPTURED] = captured[kind == _CAPTURED]

    # the table gives thighs from the vertical and feet from the floor: turn both into angles of the joints
    for side in ("left", "right"):
        hip, knee, ankle = (_A[f"{side}_{name}"] for name in ("hip", "knee", "ankle"))
        angles[:, ankle] += TABLE.flat_foot[kind] * (angles[:, knee] - angles[:, hip])
        angles[:, hip] += TABLE.upright[kind] * angles[:, _A["tilt"]]

    for column, side in enumerate(("left", "right")):
        part = _ARM[side]
        rows = np.flatnonzero(latents.arm[:, column] != OWN_ARMS)
        start, end, spread = (table[latents.arm[rows, column]] for table in ARMS)
        where = latents.where[rows, 1 + column, None]
        angles[rows, part] = start + where * (end - start) + spread * latents.noise[rows, part]
        rows = np.flatnonzero(latents.arm[:, column] == CAPTURED_ARMS)
        angles[rows, part] = captured[rows, part]
    angles = np.clip(angles, LIMITS[0], LIMITS[1])
    angles = np.where(latents.mirror[:, None], mirror_angles(angles), angles)
    return _Stride(angles=angles, pace=pace, height=height)


# the trunk as an arm sees it from its shoulder, m, mean adult: an upright ellipse around the spine, half its depth and
# width with the arm's own radius added; the arm's bones
_TRUNK_DEPTH, _TRUNK_WIDTH, _SHOULDER = 0.15, 0.17, 0.18
_UPPER_ARM, _FOREARM = 0.27, 0.25
# shoulder angles (ARM_ANGLES) added at each of the tries to free an arm
_FREE_ARM, _TRIES = np.array([16.0, 6.0, -16.0, 0.0]), 3


def _freed(angles: np.ndarray, moments: int) -> np.ndarray:
    """angles (n * moments, 27) with arms moved forwards, outwards and out of their inward turn until the forearms of
    each person's first moment leave the trunk; all moments by as much."""
    arm = angles[::moments, _BOTH_ARMS].reshape(-1, 4)
    rows = np.arange(len(arm))
    added = np.zeros_like(arm)
    for _ in range(_TRIES):
        rows = rows[_in_trunk(np.clip(arm[rows] + added[rows], *_ARM_LIMITS))]
        if not len(rows):
            break
        behind = arm[rows, :1] < -20  # hands on the back go further back
        added[rows] += np.where(behind, _FREE_ARM * [-0.5, 1.5, -1, 0], _FREE_ARM)
    angles[:, _BOTH_ARMS] = np.clip(
        angles[:, _BOTH_ARMS] + np.repeat(added.reshape(-1, 8), moments, 0), *np.tile(_ARM_LIMITS, 2)
    )
    return angles


_REACHES = np.array([0.5, 1.0, 1.25])[:, None]  # of the forearm: its middle, the wrist, the hand


def _in_trunk(arm: np.ndarray) -> np.ndarray:
    """arm (n, 4) degrees -> (n,) bool: the forearm's middle or the hand is inside the trunk. In left-arm signs."""
    rad = np.radians(arm)
    (cr, co, ci, ce), (sr, so, si, se) = np.cos(rad).T, np.sin(rad).T
    # columns of R_y(-raised) R_x(out - 90) R_y(inward): the arm's y runs along it, its x is the way the elbow bends
    crso, srso = cr * so, sr * so
    x = _UPPER_ARM * sr * co + _FOREARM * _REACHES * (se * (cr * ci + srso * si) + ce * sr * co)
    y = _UPPER_ARM * so + _FOREARM * _REACHES * (ce * so - se * co * si)
    z = -_UPPER_ARM * cr * co + _FOREARM * _REACHES * (se * (sr * ci - crso * si) - ce * cr * co)
    # over the shoulders there is no trunk; the arm starts at its side
    return (((x / _TRUNK_DEPTH) ** 2 + ((y + _SHOULDER) / _TRUNK_WIDTH) ** 2 < 1) & (z < 0.02)).any(0)


__all__ = ["ANGLES", "ARM_ANGLES", "ARM_NAMES", "KINDS", "DrawnClips", "PosePrior", "mirror_angles"]
__all__ += ["rotations_from_angles", "sample_clips", "sample_poses", "sample_rotations"]
