"""How joints move: every joint's velocity drifts at random, and how fast it drifts is learned from the track itself.

Each joint is a Kalman filter of position and velocity whose acceleration is white noise (an integrated Wiener process,
whose smoother is a cubic smoothing spline), the same on x, y and z. Its strength is one of `SCALES` times the joint's
usual one: filters of all scales run side by side, and what they foretell of the next frame says which one holds.

Legend: T frames, S scales, J joints.
"""

from dataclasses import dataclass

import numpy as np

from lidarpose.skeleton import Skeleton

# strength of the white noise of acceleration, m^2/s^3, by words in the joint's name: medians of captured motion
_STRENGTHS = {"hand": 0.4, "wrist": 0.25, "elbow": 0.07, "foot": 0.06, "ankle": 0.055, "nose": 0.08, "head": 0.07}
_TRUNK = 0.035
SCALES = 10.0 ** np.arange(-2.0, 2.1, 0.5)
# how long a scale holds, s
_SCALE_TIME = 20.0
# how far a joint's scale is that of the whole body: the weight of the other joints' evidence
_SHARED = 0.05
# standard deviation of velocities before the first frame, m/s: anything, where the frames to come will tell
_ANY_SPEED = 5.0
# a position that is not known, variance m^2
_ANYWHERE = 1e4


def strengths(skeleton: Skeleton) -> np.ndarray:
    """(J,) m^2/s^3: the usual strength of each joint."""
    return np.array(
        [next((value for word, value in _STRENGTHS.items() if word in name), _TRUNK) for name in skeleton.joints]
    )


@dataclass
class Belief:
    """Position (..., 3) m and velocity (..., 3) m/s, and their covariance on each axis (..., ) m^2, m^2/s, m^2/s^2."""

    position: np.ndarray
    velocity: np.ndarray
    variance: np.ndarray
    covariance: np.ndarray
    velocity_variance: np.ndarray

    @classmethod
    def unknown(cls, shape: tuple[int, ...], speed: float = _ANY_SPEED) -> "Belief":
        """Of joints that may be anywhere, moving about that fast, m/s."""
        zeros = np.zeros(shape)
        vector = np.zeros((*shape, 3))
        return cls(vector, vector, zeros + _ANYWHERE, zeros, zeros + speed**2)

    def predicted(self, step: float, strength: np.ndarray) -> "Belief":
        """`step` s later."""
        covariance = self.covariance + step * self.velocity_variance
        return Belief(
            self.position + step * self.velocity,
            self.velocity,
            self.variance + step * (self.covariance + covariance) + strength * step**3 / 3,
            covariance + strength * step**2 / 2,
            self.velocity_variance + strength * step,
        )

    def updated(self, joints: np.ndarray, precision: np.ndarray) -> tuple["Belief", np.ndarray]:
        """After joints (J, 3) m were seen with precision (J,) 1/m^2, 0 for not at all; and the log likelihood (...)."""
        gain = precision / (1 + self.variance * precision)
        offset = joints - self.position
        by_position, by_velocity = (gain * self.variance)[..., None], (gain * self.covariance)[..., None]
        belief = Belief(
            self.position + by_position * offset,
            self.velocity + by_velocity * offset,
            self.variance * (1 - by_position[..., 0]),
            self.covariance * (1 - by_position[..., 0]),
            self.velocity_variance - by_velocity[..., 0] * self.covariance,
        )
        likelihood = -0.5 * gain * (offset**2).sum(-1) - 1.5 * np.log1p(self.variance * precision)
        return belief, likelihood


def smooth_joints(
    times: np.ndarray, joints: np.ndarray, precision: np.ndarray, strength: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The best path (T, J, 3) m and its variance (T, J) m^2 on each axis, from all frames (Rauch, Tung and Striebel).

    times (T,) s; joints (T, J, 3) m, precision (T, J) 1/m^2, 0 where not seen; strength (T, J), that of the time before
    each frame.
    """
    belief = Belief.unknown(joints.shape[1:2])
    steps = np.diff(times, prepend=times[0])
    beliefs, forecasts = [], []
    for step, frame_joints, weight, drift in zip(steps, joints, precision, strength, strict=True):
        forecast = belief.predicted(step, drift)
        belief, _ = forecast.updated(frame_joints, weight)
        beliefs.append(belief)
        forecasts.append(forecast)
    positions, variances = np.empty(joints.shape), np.empty(joints.shape[:2])
    for row in range(len(times))[::-1]:
        if row < len(times) - 1:
            belief = _backward(beliefs[row], forecasts[row + 1], belief, steps[row + 1])
        positions[row], variances[row] = belief.position, belief.variance
    return positions, variances


def _backward(belief: Belief, forecast: Belief, next_belief: Belief, step: float) -> Belief:
    """What is believed of a frame, once the frame after it, forecast from it, is known."""
    determinant = forecast.variance * forecast.velocity_variance - forecast.covariance**2
    # the rows of (covariance with the next frame) (forecast's covariance)^-1
    gains = []
    for to_position, to_velocity in (
        (belief.variance + step * belief.covariance, belief.covariance),
        (belief.covariance + step * belief.velocity_variance, belief.velocity_variance),
    ):
        gains.append(
            (
                (to_position * forecast.velocity_variance - to_velocity * forecast.covariance) / determinant,
                (to_velocity * forecast.variance - to_position * forecast.covariance) / determinant,
            )
        )
    (a, b), (c, d) = gains
    position_change, velocity_change = (
        next_belief.position - forecast.position,
        next_belief.velocity - forecast.velocity,
    )
    variance_change = next_belief.variance - forecast.variance
    covariance_change = next_belief.covariance - forecast.covariance
    velocity_variance_change = next_belief.velocity_variance - forecast.velocity_variance
    return Belief(
        belief.position + a[..., None] * position_change + b[..., None] * velocity_change,
        belief.velocity + c[..., None] * position_change + d[..., None] * velocity_change,
        belief.variance + a * a * variance_change + 2 * a * b * covariance_change + b * b * velocity_variance_change,
        belief.covariance
        + a * c * variance_change
        + (a * d + b * c) * covariance_change
        + b * d * velocity_variance_change,
        belief.velocity_variance
        + c * c * variance_change
        + 2 * c * d * covariance_change
        + d * d * velocity_variance_change,
    )


def learn_strength(times: np.ndarray, joints: np.ndarray, precision: np.ndarray, usual: np.ndarray) -> np.ndarray:
    """(T, J) m^2/s^3: how strongly each joint's velocity drifts about each frame. usual (J,): see `strengths`."""
    belief = Belief.unknown((len(SCALES), joints.shape[1]))
    steps = np.diff(times, prepend=times[0])
    drift = SCALES[:, None] * usual
    likelihoods = np.empty((len(times), *drift.shape))
    for row, step in enumerate(steps):
        belief, likelihoods[row] = belief.predicted(step, drift).updated(joints[row], precision[row])
    evidence = shared(likelihoods)
    # how the scales follow each other is a hidden Markov chain: forward, then backward
    forward, backward = np.empty_like(evidence), np.empty_like(evidence)
    odds = np.full(drift.shape, 1 / len(SCALES))
    for row, step in enumerate(steps):
        odds = forward[row] = odds_after(odds, step, evidence[row])
    odds = np.ones(drift.shape)
    for row in range(len(times))[::-1]:
        backward[row] = odds
        if row:
            odds = _normalized(odds * np.exp(evidence[row] - evidence[row].max(0)))
            odds = _mixed(odds, steps[row])
    return usual * np.exp((_normalized(forward * backward, 1) * np.log(SCALES)[:, None]).sum(1))


def shared(likelihoods: np.ndarray) -> np.ndarray:
    """Log likelihoods (..., J) of a joint with a share of all the others'."""
    return (1 - _SHARED) * likelihoods + _SHARED * likelihoods.sum(-1, keepdims=True)


def odds_after(odds: np.ndarray, step: float, evidence: np.ndarray) -> np.ndarray:
    """Odds (S, J) of the scales `step` s later, with the evidence (S, J) of that frame."""
    return _normalized(_mixed(odds, step) * np.exp(evidence - evidence.max(0)))


def _mixed(odds: np.ndarray, step: float) -> np.ndarray:
    """Any scale may follow after a while."""
    stay_probability = np.exp(-step / _SCALE_TIME)
    return stay_probability * odds + (1 - stay_probability) * odds.mean(0)


def _normalized(odds: np.ndarray, axis: int = 0) -> np.ndarray:
    return odds / np.maximum(odds.sum(axis, keepdims=True), 1e-300)
