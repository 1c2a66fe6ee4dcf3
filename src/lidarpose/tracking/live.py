"""A person's poses made steady as frames come: `LiveFilter` knows the past only."""

from dataclasses import replace
from typing import Any

import numpy as np

from lidarpose.sample import Pose
from lidarpose.skeleton import Skeleton
from lidarpose.skeleton import skeleton as skeleton_of
from lidarpose.tracking.clip import TrackPoses
from lidarpose.tracking.motion_model import SCALES, Belief, odds_after, shared, strengths
from lidarpose.tracking.smoothing import MAX_GAP, frame_weights, known_spread, likely_hit, precisions, steady_spread

_BELIEF = ("position", "velocity", "variance", "covariance", "velocity_variance")


class LiveFilter:
    """One person's poses, made steady frame by frame: `update` takes a frame's pose and gives the steady one.

    The model is that of `smooth`, of which this is the half that looks back. skeleton: of all the poses.
    """

    def __init__(self, skeleton: Skeleton):
        self.skeleton = skeleton
        self._usual = strengths(skeleton)
        self._time: float | None = None
        self._seen: float | None = None
        self._origin = np.zeros(3)
        self._belief = Belief.unknown((len(SCALES), len(skeleton)))
        self._certainty, self._frames = np.zeros(len(skeleton)), 0
        self._odds = np.full((len(SCALES), len(skeleton)), 1 / len(SCALES))

    def update(self, time: float, pose: Pose | None) -> Pose | None:
        """The steady pose at `time` s, later than the last one's; pose: as predicted, None where the person was not
        seen. None before the first pose, and once nothing was seen for `MAX_GAP` s."""
        step = 0.0 if self._time is None else time - self._time
        self._time = time
        if self._seen is None:
            if pose is None:
                return None
            self._origin = pose.joints.mean(0)
        elif time - self._seen > MAX_GAP:
            # whoever comes back may be anywhere
            self.__init__(self.skeleton)  # type: ignore[misc]
            return self.update(time, pose)
        forecast = self._belief.predicted(step, SCALES[:, None] * self._usual)
        if pose is None:
            self._belief = forecast
            joints, spread = self._estimate()
            return Pose(
                joints=joints,
                skeleton=self.skeleton,
                spread=spread,
                confidence=likely_hit(spread),
                visible=np.zeros(len(spread)),
            )
        joints = pose.joints - self._origin
        given = None if pose.spread is None else pose.spread[None]
        spread = known_spread(given, np.ones(1, bool), len(self._usual))[0]
        precision = precisions(spread)
        if self._seen is not None:
            mean = (self._odds[..., None] * forecast.position).sum(0)
            variance = (self._odds * forecast.variance).sum(0)
            precision = precision * frame_weights(joints - mean, 1 / (1 / precision + variance))
        self._belief, likelihood = forecast.updated(joints, precision)
        self._odds = odds_after(self._odds, step, shared(likelihood))
        self._seen = time
        self._certainty = self._certainty + spread**-2
        self._frames += 1
        joints, spread = self._estimate()
        return replace(pose, joints=joints, spread=spread)

    def _estimate(self) -> tuple[np.ndarray, np.ndarray]:
        """Joints (J, 3) m and their spread (J,) m."""
        mean = (self._odds[..., None] * self._belief.position).sum(0)
        variance = (self._odds * self._belief.variance).sum(0)
        return mean + self._origin, steady_spread(variance, self._certainty / self._frames)

    def state(self) -> dict[str, Any]:
        """All it knows as JSON holds it; `from_state` goes on from there."""
        return {
            "skeleton": self.skeleton.name,
            "time": self._time,
            "seen": self._seen,
            "origin": self._origin.tolist(),
            "odds": self._odds.tolist(),
            "certainty": self._certainty.tolist(),
            "frames": self._frames,
            **{name: getattr(self._belief, name).tolist() for name in _BELIEF},
        }

    @classmethod
    def from_state(cls, state: dict[str, Any], skeleton: Skeleton | None = None) -> "LiveFilter":
        """The filter of a `state`; skeleton: only where it is none of lidarpose's own."""
        live = cls(skeleton_of(state["skeleton"]) if skeleton is None else skeleton)
        live._time, live._seen = state["time"], state["seen"]
        live._origin, live._odds = np.array(state["origin"]), np.array(state["odds"])
        live._certainty, live._frames = np.array(state["certainty"]), state["frames"]
        live._belief = Belief(**{name: np.array(state[name]) for name in _BELIEF})
        return live


def follow(track: TrackPoses) -> list[Pose | None]:
    """The steady pose of each frame of a track, from that frame and those before."""
    live = LiveFilter(track.skeleton)
    return [live.update(float(time), pose) for time, pose in zip(track.times, track.poses(), strict=True)]
