"""The pose prior: what people's bodies do, drawn at random from a table of activities.

A pose is 27 angles (`ANGLES`, degrees, the same sign on both sides of the body), made from a few latents: a kind of
activity, a kind of arm for each side, where between the two ends of its range the activity stands, noise, and for
gaits a phase. The angles are kept inside the joints' ranges, arms are pushed out of the trunk, left and right are
exchanged in half of the poses, and one matrix product turns the angles into Euler angles of the 24 bones.

Frame of the result: x forward, y left, z up, facing +x, in the rest pose of `rig` (T-pose, every bone's axes along
the body's).
"""

from dataclasses import dataclass, replace

import numpy as np

from lidarpose.body.activities import (
    ANGLES,
    ARM_ANGLES,
    ARM_NAMES,
    ARMS,
    ARMS_OF_KIND,
    KINDS,
    LIMITS,
    OWN_ARMS,
    SHARES,
    TABLE,
)
from lidarpose.body.angles import mirror_angles, rotations_from_angles
from lidarpose.body.captured import captured_angles
from lidarpose.body.gait import gait_angles
from lidarpose.body.retarget import mean_adult_joints, without_yaw
from lidarpose.errors import InputError, unknown_name
from lidarpose.skeleton import SMPL24

_A = {name: i for i, name in enumerate(ANGLES)}
_ARM = {side: slice(_A[f"{side}_raise"], _A[f"{side}_elbow"] + 1) for side in ("left", "right")}
_CAPTURED = KINDS.index("captured")
_GAITS = tuple(KINDS.index(name) for name in ("walk", "run"))

# how often both arms do the same thing, and how far a paired arm strays from the other, as a share of its range
_PAIRED_ARMS, _PAIR_SPREAD = 0.45, 0.15


@dataclass(frozen=True, kw_only=True)
class PosePrior:
    """Drawn poses. rotations (n, 24, 3, 3) float32, local, facing +x; kind (n,) indices into `KINDS`."""

    rotations: np.ndarray
    kind: np.ndarray


@dataclass(frozen=True, kw_only=True)
class _Latents:
    """Everything random about n poses; moving `phase` alone makes a gait walk on."""

    kind: np.ndarray  # (n,) into KINDS
    arm: np.ndarray  # (n, 2) into ARM_NAMES, left and right; 0 = the activity's own
    where: np.ndarray  # (n, 3) in [0, 1]: place in the range of the activity and of either arm
    noise: np.ndarray  # (n, 27) in [-1, 1]
    phase: np.ndarray  # (n,) in [0, 1): 0 is the left heel's strike
    style: np.ndarray  # (n, 8) in [0, 1]: the gait's parameters
    mirror: np.ndarray  # (n,) bool
    captured: np.ndarray  # (m, 27) degrees: the angles of the m poses whose kind is "captured"


def sample_rotations(rng: np.random.Generator, n: int, *, mix: dict[str, float] | None = None) -> PosePrior:
    """n poses from the prior.

    mix gives the shares of the kinds (names of `KINDS`, any positive weights); by default people as a sensor beside
    a road or at work sees them. The root leans and tilts but has no yaw (`retarget.heading` is 0).
    Raises InputError for a negative n or a mix with unknown names or without weight.
    """
    if n < 0:
        raise InputError(f"n must be 0 or more poses, got {n}")
    latents = _draw(rng, n, _shares(mix))
    return PosePrior(rotations=without_yaw(rotations_from_angles(_angles(latents))), kind=latents.kind)


def clip(rng: np.random.Generator, frames: int, hz: float, *, kind: str = "walk") -> np.ndarray:
    """One person walking or running on: rotations (frames, 24, 3, 3) float32, `hz` frames a second, facing +x."""
    if kind not in ("walk", "run"):
        raise unknown_name("gait", kind, ("walk", "run"))
    if frames < 0 or hz <= 0:
        raise InputError(f"a clip needs frames >= 0 and hz > 0, got {frames} and {hz}")
    one = _draw(rng, 1, _shares({kind: 1.0}))
    # strides a second: comfortable walking 0.75-1.05 (Perry), running 1.2-1.5
    cadence = {"walk": 0.75 + 0.3 * one.style[0, 0], "run": 1.2 + 0.3 * one.style[0, 0]}[kind]
    many = {name: np.repeat(value, frames, 0) for name, value in vars(one).items()}
    phase = (one.phase + np.arange(frames) * cadence / hz) % 1
    return rotations_from_angles(_angles(replace(_Latents(**many), phase=phase)))


def sample_poses(n: int, seed: int) -> np.ndarray:
    """n poses of the default mix on the mean adult: (n, 24, 3) float32 m, SMPL's order, z up, facing +x."""
    from lidarpose.body.rig import forward_kinematics

    rotations = sample_rotations(np.random.default_rng(seed), n).rotations
    return forward_kinematics(SMPL24.parents, mean_adult_joints()[None], rotations, np.zeros((n, 3)))[1].astype(
        np.float32
    )


def _shares(mix: dict[str, float] | None) -> np.ndarray:
    if mix is None:
        return SHARES
    for name in mix:
        if name not in KINDS:
            raise unknown_name("kind of pose", name, KINDS)
    shares = np.array([float(mix.get(name, 0)) for name in KINDS])
    if (shares < 0).any() or not shares.sum() > 0:
        raise InputError(f"a mix needs weights of 0 or more and one above 0, got {mix}")
    return shares / shares.sum()


def _pick(rng: np.random.Generator, cumulative: np.ndarray) -> np.ndarray:
    """One index for each row of cumulative shares (n, K)."""
    return (rng.random((len(cumulative), 1)) >= cumulative[:, :-1]).sum(1)


def _draw(rng: np.random.Generator, n: int, shares: np.ndarray) -> _Latents:
    kind = rng.choice(len(KINDS), n, p=shares)
    odds = np.cumsum(ARMS_OF_KIND, 1)[kind]
    arm = np.stack([_pick(rng, odds), _pick(rng, odds)], 1)
    where = rng.random((n, 3))
    paired = rng.random(n) < _PAIRED_ARMS
    arm[paired, 1] = arm[paired, 0]
    stray = where[:, 1] + _PAIR_SPREAD * rng.uniform(-1, 1, n)
    where[paired, 2] = np.clip(stray, 0, 1)[paired]
    # the sum of two uniform numbers: most near the middle, none far out
    noise = rng.uniform(-0.5, 0.5, (2, n, len(ANGLES))).sum(0)
    return _Latents(
        kind=kind,
        arm=arm,
        where=where,
        noise=noise,
        phase=rng.random(n),
        style=rng.random((n, 8)),
        mirror=rng.random(n) < 0.5,
        captured=captured_angles(rng, int((kind == _CAPTURED).sum())),
    )


def _angles(latents: _Latents) -> np.ndarray:
    """The poses' angles (n, 27), degrees, inside the joints' ranges."""
    kind = latents.kind
    start, end, spread = TABLE.start[kind], TABLE.end[kind], TABLE.spread[kind]
    angles = start + latents.where[:, :1] * (end - start) + spread * latents.noise
    for gait in _GAITS:
        rows = np.flatnonzero(kind == gait)
        if len(rows):
            angles[rows] += gait_angles(KINDS[gait], latents.phase[rows], latents.style[rows])

    angles[kind == _CAPTURED] = latents.captured

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
    angles = np.clip(angles, LIMITS[0], LIMITS[1])
    for side in ("left", "right"):
        _push_arm_out(angles[:, _ARM[side]])
    return np.where(latents.mirror[:, None], mirror_angles(angles), angles)


# the trunk as an arm sees it from its shoulder, m, mean adult: an upright ellipse around the spine, half its depth and
# width with the arm's own radius added; the arm's bones
_TRUNK_DEPTH, _TRUNK_WIDTH, _SHOULDER = 0.15, 0.17, 0.18
_UPPER_ARM, _FOREARM = 0.27, 0.25
# shoulder angles (ARM_ANGLES) added at each of the tries to free an arm
_FREE_ARM, _TRIES = np.array([12.0, 4.0, -12.0, 0.0]), 5


def _push_arm_out(arm: np.ndarray) -> None:
    """Moves arms (n, 4), in place, forwards, outwards and out of their inward turn until forearms leave the trunk."""
    rows = np.arange(len(arm))
    for _ in range(_TRIES):
        rows = rows[_in_trunk(arm[rows])]
        if not len(rows):
            break
        behind = arm[rows, :1] < -20  # hands on the back go further back
        arm[rows] += np.where(behind, _FREE_ARM * [-0.5, 1.5, -1, 0], _FREE_ARM)
    np.clip(arm, *(limit[_ARM["left"]] for limit in LIMITS), out=arm)


def _in_trunk(arm: np.ndarray) -> np.ndarray:
    """arm (n, 4) degrees -> (n,) bool: the forearm's middle or the hand is inside the trunk. In left-arm signs."""
    raised, out, inward, elbow = np.radians(arm.T)
    cr, sr, co, so, ci, si = np.cos(raised), np.sin(raised), np.cos(out), np.sin(out), np.cos(inward), np.sin(inward)
    # columns of R_y(-raised) R_x(out - 90) R_y(inward): the arm's y runs along it, its x is the way the elbow bends
    along = np.stack([sr * co, so, -cr * co], -1)
    forward = np.stack([cr * ci + sr * so * si, -co * si, sr * ci - cr * so * si], -1)
    bones = np.sin(elbow)[:, None] * forward + np.cos(elbow)[:, None] * along
    inside = np.zeros(len(arm), bool)
    for share in (0.5, 1.0, 1.25):
        x, y, z = (_UPPER_ARM * along + share * _FOREARM * bones).T
        # over the shoulders there is no trunk; the arm starts at its side
        inside |= ((x / _TRUNK_DEPTH) ** 2 + ((y + _SHOULDER) / _TRUNK_WIDTH) ** 2 < 1) & (z < 0.02)
    return inside


__all__ = ["ANGLES", "ARM_ANGLES", "ARM_NAMES", "KINDS", "PosePrior", "clip", "mirror_angles"]
__all__ += ["rotations_from_angles", "sample_poses", "sample_rotations"]
