"""Motion clips a user has as joint positions.

The file is an npz with `joints` (F, 24, 3) m, z up, all clips one after the other, `clip` (C,) their names,
`clip_start` and `clip_length` (C,), `fps` frames a second, and optionally `joint_names` (24,) to check the order.
"""

import zipfile
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lidarpose.errors import InputError
from lidarpose.skeleton import SMPL24

_KEYS = ("joints", "clip", "clip_start", "clip_length", "fps")


@dataclass(frozen=True, kw_only=True)
class Clips:
    """Captured motion. joints (F, 24, 3) float32 m, SMPL's joints, z up; clip c, named names[c], is the frames
    start[c] to start[c] + length[c]; fps in frames a second."""

    joints: np.ndarray
    names: tuple[str, ...]
    start: np.ndarray
    length: np.ndarray
    fps: float

    def __post_init__(self):
        if self.joints.ndim != 3 or self.joints.shape[1:] != (24, 3):
            raise InputError(f"clips need joints (frames, 24, 3), SMPL's joints in metres, got {self.joints.shape}")
        if not np.isfinite(self.joints).all():
            raise InputError("clips need finite joints; drop the frames with missing ones")
        for name in ("start", "length"):
            value = getattr(self, name)
            if value.shape != (len(self.names),) or value.dtype.kind not in "iu":
                raise InputError(
                    f"clip_{name} needs one whole number a clip, ({len(self.names)}), got {value.dtype} {value.shape}"
                )
        ends = self.start + self.length
        if len(ends) and (min(self.start.min(), self.length.min()) < 0 or ends.max() > len(self.joints)):
            raise InputError(f"clips must lie inside the {len(self.joints)} frames, got up to frame {ends.max()}")
        if not self.fps > 0:
            raise InputError(f"fps must be frames a second, above 0, got {self.fps}")

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, clip: int) -> np.ndarray:
        """The joints (length, 24, 3) of one clip."""
        return self.joints[self.start[clip] : self.start[clip] + self.length[clip]]

    def of(self, subjects: str | Iterable[str]) -> "Clips":
        """The clips whose names start with one of `subjects`, such as "002". Raises InputError for one without."""
        subjects = (subjects,) if isinstance(subjects, str) else tuple(subjects)
        for subject in subjects:
            if not any(name.startswith(subject) for name in self.names):
                known = ", ".join(sorted({name.partition("_")[0] for name in self.names}))
                raise InputError(f"no clip starts with {subject!r}: there are {known}")
        chosen = [c for c, name in enumerate(self.names) if name.startswith(subjects)]
        length = self.length[chosen]
        parts = [self[c] for c in chosen]
        return replace(
            self,
            joints=np.concatenate(parts) if parts else self.joints[:0],
            names=tuple(self.names[c] for c in chosen),
            start=np.cumsum(length) - length,
            length=length,
        )


def load_clips(path: str | Path) -> Clips:
    """Reads a clips file (its layout is at the top of this module). Raises InputError where it is another."""
    try:
        with np.load(path, allow_pickle=False) as file:
            missing = [key for key in _KEYS if key not in file]
            if missing:
                raise InputError(f"{path}: clips need {', '.join(_KEYS)}; {', '.join(missing)} is missing")
            stored = {key: file[key] for key in file.files if key in (*_KEYS, "joint_names")}
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except InputError:
        raise
    except (OSError, ValueError, AttributeError, TypeError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: not an npz of plain arrays ({error})") from None
    order = stored.get("joint_names")
    if order is not None and tuple(map(str, np.ravel(order))) != SMPL24.joints:
        raise InputError(f"{path}: joint_names must be SMPL's 24 in SMPL's order, got {', '.join(map(str, order))}")
    if stored["fps"].size != 1 or stored["fps"].dtype.kind not in "iuf":
        raise InputError(f"{path}: fps must be one number, got {stored['fps'].tolist()}")
    if stored["joints"].dtype.kind not in "iuf":
        raise InputError(f"{path}: joints must be numbers, got {stored['joints'].dtype}")
    try:
        return Clips(
            joints=stored["joints"].astype(np.float32),
            names=tuple(map(str, np.ravel(stored["clip"]))),
            start=stored["clip_start"],
            length=stored["clip_length"],
            fps=float(stored["fps"].item()),
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
