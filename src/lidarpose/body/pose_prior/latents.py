"""The random variables of a pose of the prior, and how they change over time.

All latents except the activity itself drift: a gait's phase advances, the position between the two ends of an
activity's range swings to and fro, and each angle's noise sways a little. All changes are smooth and 0 at t = 0.

Captured poses are drawn from a mixture of Gaussians over the angles of a pose, fitted by tools/fit_motion.py. Its
features (27, degrees) are `ANGLES` with each shoulder's three angles replaced by the rotation vector from a hanging
arm, which is smooth in the usual range of arms. The mixture was fitted to subjects 2 and 5 of the CMU Graphics Lab
Motion Capture Database (mocap.cs.cmu.edu, NSF EIA-0196217); no pose of it is stored.
"""

from dataclasses import dataclass, fields, replace
from functools import cache
from importlib import resources

import numpy as np

from lidarpose.body.pose_prior import activities
from lidarpose.body.pose_prior.activities import ANGLES, KIND_PACE, KINDS, LIMITS, shoulder_angles, shoulder_matrix
from lidarpose.geometry import axis_angle_to_matrix

_CAPTURED, _FALL, _CYCLE = (KINDS.index(name) for name in ("captured", "fall", "cycle"))
# probability that both arms do the same thing, and maximum deviation between paired arms, as a fraction of the range
_PAIRED_ARMS, _PAIR_SPREAD = 0.45, 0.15
# sway of an angle: fraction of its noise's range, and limits of its frequency, Hz
_SWAY, _SWAY_SLOW, _SWAY_FAST = 0.06, 0.15, 0.5
# captured poses: mean speed of the angle that changes most between two poses, degrees/s
_CAPTURED_RATE = 90.0
# traveling people: relative variation of the pace, maximum turn rate, rad/s, and frequency of both variations, Hz
_HURRY, _TURN, _DRIFT = 0.08, 0.35, 0.17
# a fall from standing to the ground, s: a body tips over in about 1 s (inverted pendulum of a person's height)
_FALL_TIME = 1.1


# strides per second: minimum, and increase for the longest stride; a bicycle's cranks turn at its activity's pace
_CADENCES = np.array([activities.TABLES["gaits"].get(name, {}).get("cadence", (0.0, 0.0)) for name in KINDS])
_CADENCES[_CYCLE] = KIND_PACE[_CYCLE] / (2 * np.pi), 0.0
_CUMULATIVE_ODDS = np.cumsum(activities.ARM_ODDS, 1)


@dataclass(frozen=True, kw_only=True)
class Latents:
    """Everything random about n poses.

    kind (n,) into KINDS; arm (n, 2) into ARM_NAMES, left and right, 0 = the activity's own; where (n, 3) in [0, 1]:
    position in the ranges of the activity and of the two arms; noise (n, 27) in about [-1, 1]; phase (n,) strides, 0 is
    the left heel's strike; style (n, 8) in [0, 1]: the gait's parameters; mirror (n,) bool; tempo (n, 4) in [0, 1]:
    pace, initial direction of the swing, curve of the path, change of speed; captured (n, 2, 27) degrees: for poses
    that are captured or have a captured arm, the current angles and those of the pose they move to; else 0.
    """

    kind: np.ndarray
    arm: np.ndarray
    where: np.ndarray
    noise: np.ndarray
    phase: np.ndarray
    style: np.ndarray
    mirror: np.ndarray
    tempo: np.ndarray
    captured: np.ndarray

    def __len__(self) -> int:
        return len(self.kind)

    def take(self, rows: np.ndarray) -> "Latents":
        """The poses at the indices `rows` (k,), in that order."""
        return Latents(**{field.name: getattr(self, field.name)[rows] for field in fields(self)})

    def at(self, t: np.ndarray) -> "Latents":
        """The same people t (n,) seconds later. Call this only on latents as drawn, not on results of `at`."""
        t = np.broadcast_to(np.asarray(t, float), self.kind.shape)
        pace_factor = np.where(self.kind == _CYCLE, 1.0, 0.7 + 0.6 * self.tempo[:, 0])
        pace = np.concatenate([KIND_PACE[self.kind][:, None], activities.ARM_PACE[self.arm]], 1) * pace_factor[:, None]
        # swing between the ends from the current position; half of the people swing back first
        start_phase = np.arccos(np.clip(1 - 2 * self.where, -1, 1)) * np.where(self.tempo[:, 1:2] < 0.5, 1, -1)
        where = (1 - np.cos(start_phase + pace * t[:, None])) / 2
        is_falling = self.kind == _FALL
        where[is_falling, 0] = np.clip(self.where[is_falling, 0] + t[is_falling] / _FALL_TIME, 0, 1)
        return replace(
            self,
            where=where,
            noise=self.noise + _SWAY * self._sway(t),
            phase=self.phase + self.strides(t),
            captured=self._captured(t),
        )

    def strides(self, t: np.ndarray) -> np.ndarray:
        """Strides, or turns of a bicycle's cranks, completed by t (n,) or (n, T) s; 0 for kinds that do not travel.

        The pace varies by `_HURRY`.
        """
        base_cadence, extra_cadence = _CADENCES[self.kind].T
        cadence, start_phase = base_cadence + extra_cadence * self.style[:, 0], 2 * np.pi * self.tempo[:, 3]
        if np.ndim(t) == 2:
            cadence, start_phase = cadence[:, None], start_phase[:, None]
        rate = 2 * np.pi * _DRIFT
        return cadence * (t + _HURRY / rate * (np.sin(start_phase + rate * t) - np.sin(start_phase)))

    def course(self, times: np.ndarray) -> np.ndarray:
        """Heading (n, T) rad of traveling people at times (T,) s, 0 at t = 0: paths are slightly curved."""
        max_turn_rate = _TURN * (2 * self.tempo[:, 2] - 1)
        rate, start_phase = 2 * np.pi * _DRIFT, 7 * np.pi * self.tempo[:, 3]
        return (max_turn_rate / rate)[:, None] * (
            np.sin(start_phase[:, None] + rate * times) - np.sin(start_phase)[:, None]
        )

    def _sway(self, t: np.ndarray) -> np.ndarray:
        """Slow swing (n, 27) of each angle, 0 at t = 0; its frequency and phase are derived from the noise."""
        rate = 2 * np.pi * (_SWAY_SLOW + (_SWAY_FAST - _SWAY_SLOW) * np.mod(self.noise * 17.0, 1.0))
        start_phase = 2 * np.pi * np.mod(self.noise * 29.0, 1.0)
        return np.sin(start_phase + rate * t[:, None]) - np.sin(start_phase)

    def _captured(self, t: np.ndarray) -> np.ndarray:
        start, end = self.captured[:, 0], self.captured[:, 1]
        # the maximum speed of a cosine is pi / 2 times its mean speed
        rate = np.pi * _CAPTURED_RATE / np.maximum(np.abs(end - start).max(1, initial=0), 20.0)
        share = (1 - np.cos(rate * (0.6 + 0.4 * self.tempo[:, 0]) * t)) / 2
        return np.stack([start + share[:, None] * (end - start), end], 1)


def draw_latents(rng: np.random.Generator, kind: np.ndarray) -> Latents:
    """Draws the latents of poses of the kinds (n,), indices into KINDS."""
    n = len(kind)
    arm = (rng.random((n, 2, 1)) >= _CUMULATIVE_ODDS[kind][:, None, :-1]).sum(2)
    where = rng.random((n, 3))
    is_paired = rng.random(n) < _PAIRED_ARMS
    arm[is_paired, 1] = arm[is_paired, 0]
    paired_position = where[:, 1] + _PAIR_SPREAD * rng.uniform(-1, 1, n)
    where[is_paired, 2] = np.clip(paired_position, 0, 1)[is_paired]
    # triangular distribution: most values near 0, none beyond 1
    noise = rng.random((2, n, len(ANGLES))).sum(0) - 1
    phase, style, mirror, tempo = rng.random(n), rng.random((n, 8)), rng.random(n) < 0.5, rng.random((n, 4))
    captured = np.zeros((n, 2, len(ANGLES)))
    uses_captured = (kind == _CAPTURED) | (arm == activities.CAPTURED_ARMS).any(1)
    captured[uses_captured] = np.clip(captured_angles(rng, int(uses_captured.sum())), *LIMITS)
    return Latents(
        kind=kind, arm=arm, where=where, noise=noise, phase=phase, style=style, mirror=mirror, tempo=tempo,
        captured=captured,
    )  # fmt: skip


_FIRST_ARM_ANGLE = {side: ANGLES.index(f"{side}_raise") for side in ("left", "right")}
# columns of each shoulder's three angles, and the side's sign
SHOULDERS = tuple((slice(i, i + 3), sign) for i, sign in zip(_FIRST_ARM_ANGLE.values(), (1.0, -1.0), strict=True))
# scale of the drawn deviations: its ridge term and few components make the fit wider than the captured motion
_SPREAD = 0.75
# probability that an arm is taken from another pose, which covers the poses of unseen subjects better
_OTHER_ARM = 0.4
_ARMS = tuple(np.arange(i, i + len(activities.ARM_ANGLES)) for i in _FIRST_ARM_ANGLE.values())
# indices of a Cholesky factor's entries
LOWER = np.tril_indices(len(ANGLES))


def captured_angles(rng: np.random.Generator, n: int) -> np.ndarray:
    """Draws n pairs of poses, each from one component of the mixture: angles (n, 2, 27), degrees, in the order of
    `ANGLES`; limits are not applied. The first of a pair is distributed as the mixture; motion goes to the second."""
    cumulative_weights, means, roots = _mixture()
    component = np.searchsorted(cumulative_weights, rng.random(n))
    normal = rng.standard_normal((n, 2, len(ANGLES)))
    features = means[component, None] + _SPREAD * normal @ np.swapaxes(roots[component], -1, -2)
    pair_index = np.arange(2)
    for shift, arm in enumerate(_ARMS, 1):
        rows = np.flatnonzero(rng.random(n) < _OTHER_ARM)
        features[np.ix_(rows, pair_index, arm)] = features[np.ix_((rows + shift) % n, pair_index, arm)]
    return from_features(features.reshape(-1, len(ANGLES))).reshape(n, 2, len(ANGLES))


def from_features(features: np.ndarray) -> np.ndarray:
    """Features of the mixture (n, 27) -> angles (n, 27), degrees."""
    angles = np.array(features, float)
    for columns, sign in SHOULDERS:
        angles[:, columns] = shoulder_angles(
            axis_angle_to_matrix(np.radians(angles[:, columns])) @ hanging_arm(sign), sign
        )
    return angles


def hanging_arm(sign: float) -> np.ndarray:
    """(3, 3): the shoulder's rotation from the T-pose to a hanging arm, sign 1 for the left and -1 for the right."""
    return shoulder_matrix(np.zeros((1, 3)), sign)[0]


@cache
def _mixture() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cumulative weights (K,), means (K, 27) and Cholesky factors (K, 27, 27), degrees."""
    with resources.files("lidarpose.body").joinpath("assets/motion_prior.npz").open("rb") as file:
        arrays = dict(np.load(file, allow_pickle=False))
    weights = arrays["weights"].astype(float)
    roots = np.zeros((len(weights), len(ANGLES), len(ANGLES)))
    roots[:, *LOWER] = arrays["roots"]
    cumulative_weights = np.cumsum(weights / weights.sum())
    cumulative_weights[-1] = 1.0
    return cumulative_weights, arrays["means"].astype(float), roots
