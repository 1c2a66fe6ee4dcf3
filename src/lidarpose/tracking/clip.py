"""One person's poses over time: the input and output of smoothing."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from lidarpose.errors import InputError
from lidarpose.sample import Pose, known_values
from lidarpose.skeleton import Skeleton

# optional values per joint of a track
_PER_JOINT = ("spread", "visible", "confidence")


@dataclass(frozen=True, kw_only=True, eq=False)
class TrackPoses:
    """One person over T frames, in a fixed coordinate frame (z up).

    times (T,) s, increasing; joints (T, J, 3) m, NaN where the person was not seen; spread (T, J) m, the expected
    distance between joint and truth, or None; visible, confidence (T, J) in [0, 1] or None; filled (T,) bool: frames
    whose joints were filled in from the frames before and after, none by default; swapped (T,) bool: frames in which
    left and right were exchanged, none by default.
    """

    times: np.ndarray
    joints: np.ndarray
    skeleton: Skeleton
    spread: np.ndarray | None = None
    visible: np.ndarray | None = None
    confidence: np.ndarray | None = None
    filled: np.ndarray | None = None
    swapped: np.ndarray | None = None

    def __post_init__(self):
        shape = (len(self.times), len(self.skeleton))
        if self.joints.shape != (*shape, 3):
            raise InputError(f"TrackPoses.joints must be {(*shape, 3)}, got {self.joints.shape}")
        for name, value in known_values(self, *_PER_JOINT).items():
            if value.shape != shape:
                raise InputError(f"TrackPoses.{name} must be {shape}, one per joint, got {value.shape}")
        if not (np.isfinite(self.times).all() and (np.diff(self.times) > 0).all()):
            raise InputError("TrackPoses.times must be finite seconds, each later than the one before")
        for name in ("filled", "swapped"):
            if getattr(self, name) is None:
                object.__setattr__(self, name, np.zeros(len(self.times), bool))

    def __len__(self) -> int:
        return len(self.times)

    @property
    def seen(self) -> np.ndarray:
        """(T,) bool: frames with joints."""
        return np.isfinite(self.joints).all((1, 2))

    @classmethod
    def of_poses(cls, times: np.ndarray, poses: list[Pose | None], skeleton: Skeleton) -> "TrackPoses":
        """From one pose per frame, None where the person was not seen."""
        seen_poses = [pose for pose in poses if pose is not None]
        values: dict[str, Any] = {}
        for name in ("joints", *_PER_JOINT):
            if name != "joints" and (not seen_poses or any(getattr(pose, name) is None for pose in seen_poses)):
                continue
            values[name] = np.full((len(poses), len(skeleton)) + (3,) * (name == "joints"), np.nan)
            for row, pose in enumerate(poses):
                if pose is not None:
                    values[name][row] = getattr(pose, name)
        return cls(times=np.asarray(times, float), skeleton=skeleton, **values)

    def pose(self, row: int) -> Pose | None:
        """The pose of a frame, None without joints."""
        if not np.isfinite(self.joints[row]).all():
            return None
        frame_values = {name: value[row] for name, value in known_values(self, *_PER_JOINT).items()}
        return Pose(joints=self.joints[row], skeleton=self.skeleton, **frame_values)

    def poses(self) -> list[Pose | None]:
        """The pose of each frame."""
        return [self.pose(row) for row in range(len(self))]
