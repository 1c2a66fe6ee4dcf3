"""Captured motion: clips files of joint positions, and `Motion`, the bone rotations that all formats are converted to.

A clips file is an npz with `joints` (F, 24, 3) m, z up, all clips concatenated; `clip` (C,), their names; `clip_start`
and `clip_length` (C,) frames; `fps`, frames per second; and optionally `joint_names` (24,) to check the order.
`body.mocap` reads this and the usual formats of motion capture.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from typing import Any

import numpy as np

from lidarpose.body.rig import heading, without_yaw
from lidarpose.errors import InputError
from lidarpose.geometry import axis_angle_to_matrix, rotation_about, rotation_vector
from lidarpose.io.files import file_error
from lidarpose.io.npz import read_npz
from lidarpose.skeleton import SMPL24

_KEYS = ("joints", "clip", "clip_start", "clip_length", "fps")
# number of frames interpolated at once, to limit memory
_BLOCK = 4096
# with a larger fraction of unusable frames, the whole clip counts as corrupted
_MOST_DROPPED = 0.2
# people stand along an axis if the mean component of their trunks' directions along it exceeds this
_UPRIGHT = 0.7


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Captured motion as rotations of the body: F frames of several clips, which follow each other.

    names and length (C,) of the clips; fps frames per second; rotations (F, 24, 3, 3) float32, local, in the rest frame
    of `body.rig`, any heading; translation (F, 3) float32 m, the pelvis, z up; source: format and path of its file;
    dropped: number of unusable frames that were dropped.
    """

    names: tuple[str, ...]
    length: np.ndarray
    fps: float
    rotations: np.ndarray
    translation: np.ndarray
    source: str
    dropped: int = 0

    def __post_init__(self):
        frames = int(self.length.sum())
        for name, row_shape in (("rotations", (24, 3, 3)), ("translation", (3,))):
            array = getattr(self, name)
            if array.shape != (frames, *row_shape):
                expected = f"(frames, {', '.join(map(str, row_shape))}), {frames} frames"
                raise InputError(f"{name} must be {expected}, got {array.shape}")
            if not np.isfinite(array).all():
                raise InputError(f"{name} must be finite; drop the frames that are not")
        if not 0 < self.fps < np.inf:
            raise InputError(f"fps must be frames per second, above 0, got {self.fps}")

    def __len__(self) -> int:
        return len(self.names)

    @property
    def start(self) -> np.ndarray:
        """First frame (C,) of each clip."""
        return np.cumsum(self.length) - self.length

    def frames(self, clip: int) -> slice:
        """The frames of one clip, as a slice of the arrays."""
        return slice(int(self.start[clip]), int(self.start[clip] + self.length[clip]))

    def of(self, subjects: str | Iterable[str]) -> "Motion":
        """The clips whose names start with one of `subjects`; "002" does not match "0021_03". Raises InputError for a
        subject without clips."""
        subjects = (subjects,) if isinstance(subjects, str) else tuple(subjects)
        for subject in subjects:
            if not any(is_of(name, subject) for name in self.names):
                subject_list = ", ".join(sorted({name.partition("_")[0] for name in self.names}))
                raise InputError(f"no clip starts with {subject!r}: there are {subject_list}")
        clip_mask = np.array([any(is_of(name, subject) for subject in subjects) for name in self.names], bool)
        frame_mask = np.repeat(clip_mask, self.length)
        arrays = {"rotations": self.rotations[frame_mask], "translation": self.translation[frame_mask]}
        names = tuple(name for name, is_selected in zip(self.names, clip_mask, strict=True) if is_selected)
        return replace(self, **arrays, names=names, length=self.length[clip_mask])

    def resampled(self, hz: float) -> "Motion":
        """The same clips with `hz` frames per second. A clip keeps its first frame and loses less than one new frame at
        its end. Rotations are interpolated along the shortest arc, the pelvis linearly."""
        if not 0 < hz < np.inf:
            raise InputError(f"hz must be frames per second, above 0, got {hz}")
        if hz == self.fps:
            return self
        # the 1e-6 keeps the last frame despite rounding errors, as from 30 to 10 frames per second
        length = np.array([int((n - 1) / self.fps * hz + 1e-6) + 1 if n else 0 for n in self.length.tolist()], int)
        fractional_frames = [s + np.arange(n) * (self.fps / hz) for s, n in zip(self.start, length, strict=True)]
        last_frame = np.repeat(self.start + self.length - 1, length)
        rotations, translation = self._between(np.concatenate([*fractional_frames, np.zeros(0)]), last_frame)
        return replace(self, rotations=rotations, translation=translation, length=length, fps=float(hz))

    def window_starts(self, frames: int) -> np.ndarray:
        """First frames (n,) of the windows of `frames` frames, see `windows`."""
        frame, last_frame = self._last_frames()
        return frame[frame + frames - 1 <= last_frame]

    def windows(self, frames: int) -> np.ndarray:
        """Frame indices of all windows of `frames` frames: (n, frames) int. No window crosses the end of a clip.

        Index the same motion: `motion.rotations[motion.resampled(10).windows(16)]` would mix frame rates.
        """
        return self.window_starts(frames)[:, None] + np.arange(frames)

    def cut(self, frames: np.ndarray) -> "Motion":
        """One clip of the frames (n,), such as a row of `windows`."""
        arrays = {"rotations": self.rotations[frames], "translation": self.translation[frames]}
        return replace(self, **arrays, names=("",), length=np.array([len(frames)]))

    def pairs(self, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """All pairs of poses of the same clip that are `dt` >= 0 seconds apart.

        Returns:
            The first poses (n, 24, 3, 3), facing +x; the poses `dt` later (n, 24, 3, 3) and the displacement of the
            pelvis between them (n, 3) m, both in the axes of the first pose; float32.
        """
        frame, last_frame = self._with_later(dt)
        later_rotations, translation = self._between(frame + dt * self.fps, last_frame)
        first_rotations = self.rotations[frame]
        inverse_yaw = rotation_about("z", -heading(first_rotations))
        step = (inverse_yaw @ (translation - self.translation[frame])[..., None])[..., 0]
        later_rotations[:, 0] = inverse_yaw @ later_rotations[:, 0]
        return without_yaw(first_rotations), later_rotations, step.astype(np.float32)

    def places(self, dt: float) -> np.ndarray:
        """Recorded places (n, 3) float32 of the first poses of `pairs`: the pelvis's x and y m, and the heading rad."""
        frame, _ = self._with_later(dt)
        return np.column_stack([self.translation[frame, :2], heading(self.rotations[frame])]).astype(np.float32)

    def _with_later(self, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """Frames (n,) whose clip lasts at least `dt` s longer, and the last frame (n,) of each one's clip."""
        frame, last_frame = self._last_frames()
        has_later = frame + dt * self.fps <= last_frame + 1e-6
        return frame[has_later], last_frame[has_later]

    def _last_frames(self) -> tuple[np.ndarray, np.ndarray]:
        """All frames (F,), and the last frame (F,) of each one's clip."""
        return np.arange(len(self.rotations)), np.repeat(self.start + self.length - 1, self.length)

    def _between(self, fractional_frame: np.ndarray, last_frame: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rotations (n, 24, 3, 3) and translation (n, 3) at `fractional_frame` (n,), at most at `last_frame` (n,)."""
        frame = np.minimum((fractional_frame + 1e-6).astype(int), last_frame)
        next_frame = np.minimum(frame + 1, last_frame)
        weight = np.clip(fractional_frame - frame, 0, 1)[:, None]
        weight[weight < 1e-5] = 0
        rotations, translation = self.rotations[frame], self.translation[frame]
        interpolated_rows = np.flatnonzero(weight[:, 0])
        for block in np.array_split(interpolated_rows, len(interpolated_rows) // _BLOCK + 1):
            a, b = self.rotations[frame[block]].astype(float), self.rotations[next_frame[block]].astype(float)
            rotation_vectors = rotation_vector(np.swapaxes(a, -1, -2) @ b)
            rotations[block] = a @ axis_angle_to_matrix(weight[block, None] * rotation_vectors)
            translation[block] += weight[block] * (self.translation[next_frame[block]] - translation[block])
        return rotations, translation


def join(motions: Sequence[Motion], *, source: str) -> Motion:
    """All clips of one or more motions, at the lowest of their rates."""
    motions = [motion.resampled(min(m.fps for m in motions)) for motion in motions]
    return Motion(
        rotations=np.concatenate([m.rotations for m in motions]),
        translation=np.concatenate([m.translation for m in motions]),
        names=tuple(name for m in motions for name in m.names),
        length=np.concatenate([m.length for m in motions]),
        fps=motions[0].fps,
        source=source,
        dropped=sum(m.dropped for m in motions),
    )


def facing_x(rotations: np.ndarray, translation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Clips (n, F, 24, 3, 3) and (n, F, 3), such as those of `Motion.windows`, turned about z and moved so that each
    begins above the origin, at its own z, and faces +x."""
    inverse_yaw = rotation_about("z", -heading(rotations[:, 0]))[:, None]
    rotations = np.array(rotations)
    rotations[:, :, 0] = inverse_yaw @ rotations[:, :, 0]
    displacement = translation - translation[:, :1] * [1, 1, 0]
    return rotations, (inverse_yaw @ displacement[..., None])[..., 0].astype(np.float32)


def load_clips(path: str | PathLike) -> tuple[np.ndarray, tuple[str, ...], np.ndarray, float]:
    """Reads a clips file: joints (F, 24, 3) float32 m, names and lengths (C,) of the clips, and frames per second. The
    layout is at the top of this module. Raises InputError for any other layout."""
    arrays, _ = read_npz(path, (*_KEYS, "joint_names"), expected="an npz file of clips")
    missing_keys = [key for key in _KEYS if key not in arrays]
    if missing_keys:
        raise file_error(path, f"clips need {', '.join(_KEYS)}; {', '.join(missing_keys)} is missing")
    joints, clip, start, length, fps = (arrays[key] for key in _KEYS)
    joint_names = arrays.get("joint_names")
    if joint_names is not None and tuple(map(str, np.ravel(joint_names))) != SMPL24.joints:
        raise file_error(path, f"joint_names must be SMPL's 24 in SMPL's order, got {', '.join(map(str, joint_names))}")
    if fps.size != 1 or fps.dtype.kind not in "iuf":
        raise file_error(path, f"fps must be one number, got {fps.tolist()}")
    if joints.dtype.kind not in "iuf" or joints.shape[1:] != (24, 3):
        raise file_error(path, f"joints must be numbers (frames, 24, 3), got {joints.dtype} {joints.shape}")
    for key, value in (("clip_start", start), ("clip_length", length)):
        if value.shape != (clip.size,) or value.dtype.kind not in "iu":
            raise file_error(
                path, f"{key} needs one whole number per clip, ({clip.size}), got {value.dtype} {value.shape}"
            )
    # start + length could overflow in narrow or unsigned types
    start, length = start.astype(np.int64), length.astype(np.int64)
    if ((start < 0) | (length < 0) | (start > len(joints) - length)).any():
        expected = f"inside the {len(joints)} frames, got up to frame {(start + length).max()}"
        raise file_error(path, f"clips must lie {expected}")
    spans = [np.arange(s, s + n) for s, n in zip(start, length, strict=True)]
    frames = np.concatenate([*spans, np.zeros(0, int)]).astype(int)
    joints = joints.astype(np.float32)[frames]
    if not np.isfinite(joints).all():
        raise file_error(path, "joints must be finite; drop the frames that are not")
    rate = float(fps.item())
    if not 0 < rate < np.inf:
        raise file_error(path, f"fps must be frames per second, above 0, got {rate}")
    names = (name.decode("utf-8", "replace") if isinstance(name, bytes) else str(name) for name in np.ravel(clip))
    return joints, tuple(names), length, rate


def standing_axis(trunk: np.ndarray) -> str | None:
    """The axis along which people stand, such as "-y", from the unit vectors (F, 3) of their trunks; None if they do
    not stand."""
    if not len(trunk):
        return None
    mean = trunk.mean(0)
    axis = int(np.abs(mean).argmax())
    return None if abs(mean[axis]) <= _UPRIGHT else ("-" if mean[axis] < 0 else "") + "xyz"[axis]


def usable_clips(
    path: object,
    names: Sequence[str],
    length: Sequence[int] | np.ndarray,
    good: np.ndarray,
    fps: float,
    number: np.ndarray | None = None,
) -> dict[str, Any]:
    """Cuts clips at unusable frames, so that no motion jumps over a gap.

    Args:
        names, length: Names and lengths of the clips, which follow each other.
        good: (F,) bool, usable frames.
        fps: Frames per second of the recording.
        number: (F,) frame numbers in the recording, by default without gaps.

    Returns:
        names, length, fps and dropped of the `Motion` of the usable frames; the pieces of a clip after the first are
        named NAME#2 and so on.

    Raises:
        InputError: For an invalid frame rate, no frames, or a clip with too many unusable frames.
    """
    if not 0 < fps < np.inf:
        raise file_error(path, f"the frame rate must be above 0, got {fps}; give load_motion fps=")
    number = np.arange(len(good)) if number is None else number
    pieces: list[tuple[str, int]] = []
    for name, end, count in zip(names, np.cumsum(length), length, strict=True):
        frames = slice(end - count, end)
        bad_count = count - int(good[frames].sum())
        if bad_count > _MOST_DROPPED * count:
            raise file_error(
                path,
                f"{bad_count} of {count} frames have values that are not finite or bones without length "
                f"(at most {_MOST_DROPPED:.0%} can be left out); repair the recording",
            )
        gaps = np.flatnonzero(np.diff(number[frames][good[frames]]) != 1) + 1
        for k, piece in enumerate(np.diff([0, *gaps, count - bad_count]) if count else ()):
            pieces.append((name if k == 0 else f"{name}#{k + 1}", int(piece)))
    if not pieces:
        raise file_error(path, "has no frames of motion")
    piece_names, counts = zip(*pieces, strict=True)
    return {"names": piece_names, "length": np.array(counts), "fps": float(fps), "dropped": int((~good).sum())}


def is_of(name: str, subject: str) -> bool:
    """Whether a clip's name starts with `subject`. A prefix of a longer number does not match: 102_03 is not of 10, nor
    10_01 of 1."""
    return name.startswith(subject) and not (subject[-1:].isdigit() and name[len(subject) :][:1].isdigit())
