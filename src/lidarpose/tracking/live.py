"""Online smoothing of a person's poses: `LiveFilter` uses the past only."""

from dataclasses import replace
from typing import Any

import numpy as np

from lidarpose.sample import Pose
from lidarpose.skeleton import Skeleton, skeleton as skeleton_of
from lidarpose.tracking.bones import keep_lengths, length_statistics, lengths_of, rigid_bones
from lidarpose.tracking.clip import TrackPoses
from lidarpose.tracking.motion_model import SCALES, KalmanState, pooled, scale_probabilities_after, usual_process_noise
from lidarpose.tracking.smoothing import (
    LEAST_FRAMES,
    MAX_GAP,
    frame_weights,
    known_spread,
    likely_hit,
    precisions,
    steady_spread,
)

# standard deviation of the joints' initial velocities, m/s; a small one steadies the first frames
_SPEED = 1.0
# degrees of freedom of the t-distribution that weights frames: more than in `smooth`, since a deviation may be real
_FREEDOM = 2.0


class LiveFilter:
    """Smooths one person's poses frame by frame: `update` takes a frame's pose and returns the smoothed one.

    The model is that of `smooth`, but it only looks back, and a flipped frame is not corrected but gets little weight.
    skeleton: of all the poses.
    """

    def __init__(self, skeleton: Skeleton):
        self.skeleton = skeleton
        self._usual, self._bones = usual_process_noise(skeleton), rigid_bones(skeleton)
        self._time: float | None = None
        self._seen: float | None = None
        self._frames = 0
        self._arrays = {
            "origin": np.zeros(3),
            "scale_probabilities": np.full((len(SCALES), len(skeleton)), 1 / len(SCALES)),
            "precision_sum": np.zeros(len(skeleton)),
            "bones": np.zeros((len(self._bones), 2)),
        }
        self._state = KalmanState.unknown((len(SCALES), len(skeleton)), _SPEED)

    def update(self, time: float, pose: Pose | None) -> Pose | None:
        """The smoothed pose at `time` s, which must be later than in the last call; pose: as predicted, None if the
        person was not seen. Returns None before the first pose, and if no pose was seen for `MAX_GAP` s."""
        step = 0.0 if self._time is None else time - self._time
        if self._seen is not None and time - self._seen > MAX_GAP:
            # after a long gap the person may be anywhere
            self.__init__(self.skeleton)  # type: ignore[misc]
            step = 0.0
        self._time = time
        if pose is None:
            if self._seen is None:
                return None
            self._state = self._state.predicted(step, SCALES[:, None] * self._usual)
            joints, spread = self._estimate()
            values: dict[str, Any] = {"confidence": likely_hit(spread), "visible": np.zeros(len(spread))}
            return Pose(joints=joints, skeleton=self.skeleton, spread=spread, **values)
        if self._seen is None:
            self._arrays["origin"] = pose.joints.mean(0)
        frame_spread = None if pose.spread is None else pose.spread[None]
        spread = known_spread(frame_spread, np.ones(1, bool), len(self._usual))[0]
        self._add(step, pose.joints - self._arrays["origin"], spread)
        self._seen = time
        joints, spread = self._estimate()
        return replace(pose, joints=joints, spread=spread)

    def _add(self, step: float, joints: np.ndarray, spread: np.ndarray) -> None:
        """Updates the filter with a frame's joints (J, 3) m, relative to the origin, and their spread (J,) m."""
        arrays, precision = self._arrays, precisions(spread)
        forecast = self._state.predicted(step, SCALES[:, None] * self._usual)
        if self._frames >= LEAST_FRAMES:
            mean = (arrays["scale_probabilities"][..., None] * forecast.position).sum(0)
            variance = (arrays["scale_probabilities"] * forecast.variance).sum(0)
            precision = precision * frame_weights(joints - mean, 1 / (1 / precision + variance), _FREEDOM)
        self._state, log_likelihood = forecast.updated(joints, precision)
        arrays["scale_probabilities"] = scale_probabilities_after(
            arrays["scale_probabilities"], step, pooled(log_likelihood)
        )
        arrays["precision_sum"] = arrays["precision_sum"] + spread**-2
        arrays["bones"] = arrays["bones"] + length_statistics(joints, spread**2, self._bones)
        self._frames += 1

    def _estimate(self) -> tuple[np.ndarray, np.ndarray]:
        """The smoothed joints (J, 3) m and their spread (J,) m."""
        probabilities = self._arrays["scale_probabilities"]
        mean = (probabilities[..., None] * self._state.position).sum(0)
        variance = (probabilities * self._state.variance).sum(0)
        if self._frames >= LEAST_FRAMES and len(self._bones):
            lengths = lengths_of(self._arrays["bones"], self._bones, self.skeleton)
            mean = keep_lengths(mean, variance, self._bones, lengths)
        return mean + self._arrays["origin"], steady_spread(variance, self._arrays["precision_sum"] / self._frames)

    def state(self) -> dict[str, Any]:
        """The complete state of the filter, for JSON; `from_state` restores it."""
        return {
            "skeleton": self.skeleton.name,
            "time": self._time,
            "seen": self._seen,
            "frames": self._frames,
            "arrays": {name: value.tolist() for name, value in self._arrays.items()},
            "kalman_state": {name: value.tolist() for name, value in vars(self._state).items()},
        }

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> "LiveFilter":
        """The filter restored from a `state`."""
        live_filter = cls(skeleton_of(state["skeleton"]))
        live_filter._time, live_filter._seen, live_filter._frames = state["time"], state["seen"], state["frames"]
        live_filter._arrays = {name: np.array(value) for name, value in state["arrays"].items()}
        live_filter._state = KalmanState(**{name: np.array(value) for name, value in state["kalman_state"].items()})
        return live_filter


def filter_track(track: TrackPoses) -> list[Pose | None]:
    """The smoothed pose of each frame of a track, from that frame and those before."""
    live_filter = LiveFilter(track.skeleton)
    return [live_filter.update(float(time), pose) for time, pose in zip(track.times, track.poses(), strict=True)]
