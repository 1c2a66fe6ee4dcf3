"""How joints move: each joint's velocity drifts at random, at a rate that is learned from the track itself.

Each joint is a Kalman filter of position and velocity whose acceleration is white noise (an integrated Wiener process,
whose smoother is a cubic smoothing spline), the same on x, y and z. Its density is one of `SCALES` times the joint's
usual one: filters of all scales run in parallel, and how well each predicts the next frame tells which scale holds.

Legend: T frames, S scales, J joints.
"""

from dataclasses import dataclass

import numpy as np

from lidarpose.skeleton import Skeleton

# spectral density of the white noise of acceleration, m^2/s^3, by words in the joint's name: medians of captured motion
_PROCESS_NOISE = {"hand": 0.4, "wrist": 0.25, "elbow": 0.07, "foot": 0.06, "ankle": 0.055, "nose": 0.08, "head": 0.07}
_TRUNK = 0.035
SCALES = 10.0 ** np.arange(-2.0, 2.1, 0.5)
# time constant with which the scale changes, s
_SCALE_TIME = 20.0
# coupling of a joint's scale to the whole body: the weight of the other joints' log likelihoods
_SHARED = 0.05
# standard deviation of velocities before the first frame, m/s: large, since later frames determine the velocity
_ANY_SPEED = 5.0
# variance of an unknown position, m^2
_ANYWHERE = 1e4


def usual_process_noise(skeleton: Skeleton) -> np.ndarray:
    """(J,) m^2/s^3: the usual density of each joint's process noise."""
    return np.array(
        [next((value for word, value in _PROCESS_NOISE.items() if word in name), _TRUNK) for name in skeleton.joints]
    )


@dataclass
class KalmanState:
    """Position (..., 3) m and velocity (..., 3) m/s, and their covariance on each axis (..., ) m^2, m^2/s, m^2/s^2."""

    position: np.ndarray
    velocity: np.ndarray
    variance: np.ndarray
    covariance: np.ndarray
    velocity_variance: np.ndarray

    @classmethod
    def unknown(cls, shape: tuple[int, ...], speed: float = _ANY_SPEED) -> "KalmanState":
        """The state of joints at an unknown position, with velocities of standard deviation `speed` m/s."""
        zeros = np.zeros(shape)
        vector = np.zeros((*shape, 3))
        return cls(vector, vector, zeros + _ANYWHERE, zeros, zeros + speed**2)

    def predicted(self, step: float, process_noise: np.ndarray) -> "KalmanState":
        """The state predicted for `step` s later."""
        covariance = self.covariance + step * self.velocity_variance
        return KalmanState(
            self.position + step * self.velocity,
            self.velocity,
            self.variance + step * (self.covariance + covariance) + process_noise * step**3 / 3,
            covariance + process_noise * step**2 / 2,
            self.velocity_variance + process_noise * step,
        )

    def updated(self, joints: np.ndarray, precision: np.ndarray) -> tuple["KalmanState", np.ndarray]:
        """The state after an observation of joints (J, 3) m with precision (J,) 1/m^2, 0 if not observed; and its log
        likelihood (...)."""
        gain = precision / (1 + self.variance * precision)
        offset = joints - self.position
        by_position, by_velocity = (gain * self.variance)[..., None], (gain * self.covariance)[..., None]
        state = KalmanState(
            self.position + by_position * offset,
            self.velocity + by_velocity * offset,
            self.variance * (1 - by_position[..., 0]),
            self.covariance * (1 - by_position[..., 0]),
            self.velocity_variance - by_velocity[..., 0] * self.covariance,
        )
        log_likelihood = -0.5 * gain * (offset**2).sum(-1) - 1.5 * np.log1p(self.variance * precision)
        return state, log_likelihood


def smooth_joints(
    times: np.ndarray, joints: np.ndarray, precision: np.ndarray, process_noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The smoothed path (T, J, 3) m and its variance (T, J) m^2 on each axis, from all frames (Rauch, Tung, Striebel).

    times (T,) s; joints (T, J, 3) m, precision (T, J) 1/m^2, 0 where not seen; process_noise (T, J) m^2/s^3, for the
    time before each frame.
    """
    state = KalmanState.unknown(joints.shape[1:2])
    steps = np.diff(times, prepend=times[0])
    states, forecasts = [], []
    for step, frame_joints, weight, frame_noise in zip(steps, joints, precision, process_noise, strict=True):
        forecast = state.predicted(step, frame_noise)
        state, _ = forecast.updated(frame_joints, weight)
        states.append(state)
        forecasts.append(forecast)
    positions, variances = np.empty(joints.shape), np.empty(joints.shape[:2])
    for row in range(len(times))[::-1]:
        if row < len(times) - 1:
            state = _backward(states[row], forecasts[row + 1], state, steps[row + 1])
        positions[row], variances[row] = state.position, state.variance
    return positions, variances


def _backward(state: KalmanState, forecast: KalmanState, next_state: KalmanState, step: float) -> KalmanState:
    """The smoothed state of a frame, from its forecast of the next frame and that frame's smoothed state."""
    determinant = forecast.variance * forecast.velocity_variance - forecast.covariance**2
    # the rows of (covariance with the next frame) (forecast's covariance)^-1
    gains = []
    for to_position, to_velocity in (
        (state.variance + step * state.covariance, state.covariance),
        (state.covariance + step * state.velocity_variance, state.velocity_variance),
    ):
        gains.append(
            (
                (to_position * forecast.velocity_variance - to_velocity * forecast.covariance) / determinant,
                (to_velocity * forecast.variance - to_position * forecast.covariance) / determinant,
            )
        )
    (a, b), (c, d) = gains
    position_change, velocity_change = (
        next_state.position - forecast.position,
        next_state.velocity - forecast.velocity,
    )
    variance_change = next_state.variance - forecast.variance
    covariance_change = next_state.covariance - forecast.covariance
    velocity_variance_change = next_state.velocity_variance - forecast.velocity_variance
    return KalmanState(
        state.position + a[..., None] * position_change + b[..., None] * velocity_change,
        state.velocity + c[..., None] * position_change + d[..., None] * velocity_change,
        state.variance + a * a * variance_change + 2 * a * b * covariance_change + b * b * velocity_variance_change,
        state.covariance
        + a * c * variance_change
        + (a * d + b * c) * covariance_change
        + b * d * velocity_variance_change,
        state.velocity_variance
        + c * c * variance_change
        + 2 * c * d * covariance_change
        + d * d * velocity_variance_change,
    )


def learn_process_noise(times: np.ndarray, joints: np.ndarray, precision: np.ndarray, usual: np.ndarray) -> np.ndarray:
    """(T, J) m^2/s^3: the process noise, or velocity drift, of each joint around each frame. usual (J,): see
    `usual_process_noise`."""
    state = KalmanState.unknown((len(SCALES), joints.shape[1]))
    steps = np.diff(times, prepend=times[0])
    process_noise = SCALES[:, None] * usual
    log_likelihoods = np.empty((len(times), *process_noise.shape))
    for row, step in enumerate(steps):
        state, log_likelihoods[row] = state.predicted(step, process_noise).updated(joints[row], precision[row])
    log_likelihood = pooled(log_likelihoods)
    # the scales form a hidden Markov chain: forward pass, then backward pass
    forward, backward = np.empty_like(log_likelihood), np.empty_like(log_likelihood)
    probabilities = np.full(process_noise.shape, 1 / len(SCALES))
    for row, step in enumerate(steps):
        probabilities = forward[row] = scale_probabilities_after(probabilities, step, log_likelihood[row])
    probabilities = np.ones(process_noise.shape)
    for row in range(len(times))[::-1]:
        backward[row] = probabilities
        if row:
            probabilities = _normalized(probabilities * np.exp(log_likelihood[row] - log_likelihood[row].max(0)))
            probabilities = _after_transition(probabilities, steps[row])
    return usual * np.exp((_normalized(forward * backward, 1) * np.log(SCALES)[:, None]).sum(1))


def pooled(log_likelihoods: np.ndarray) -> np.ndarray:
    """Log likelihoods (..., J) of the joints, each with a share of all the others'."""
    return (1 - _SHARED) * log_likelihoods + _SHARED * log_likelihoods.sum(-1, keepdims=True)


def scale_probabilities_after(probabilities: np.ndarray, step: float, log_likelihood: np.ndarray) -> np.ndarray:
    """Probabilities (S, J) of the scales `step` s later, updated with the log likelihood (S, J) of that frame."""
    return _normalized(_after_transition(probabilities, step) * np.exp(log_likelihood - log_likelihood.max(0)))


def _after_transition(probabilities: np.ndarray, step: float) -> np.ndarray:
    """Probabilities (S, J) of the scales `step` s later: over time a scale may change to any other."""
    stay_probability = np.exp(-step / _SCALE_TIME)
    return stay_probability * probabilities + (1 - stay_probability) * probabilities.mean(0)


def _normalized(probabilities: np.ndarray, axis: int = 0) -> np.ndarray:
    return probabilities / np.maximum(probabilities.sum(axis, keepdims=True), 1e-300)
