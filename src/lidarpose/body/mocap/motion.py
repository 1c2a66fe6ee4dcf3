"""Captured motion: the joint positions a user has, and the bones' rotations that every source of motion becomes.

A file of clips is an npz with `joints` (F, 24, 3) m, z up, all clips one after the other, `clip` (C,) their names,
`clip_start` and `clip_length` (C,), `fps` frames a second, and optionally `joint_names` (24,) to check the order.
`body.mocap` reads this and the usual formats of motion capture.
"""

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lidarpose.body.mocap.retarget import heading, rotation_vector, without_yaw
from lidarpose.errors import InputError
from lidarpose.geometry import axis_angle_to_matrix, rotation_about
from lidarpose.io.files import file_error
from lidarpose.skeleton import SMPL24

_KEYS = ("joints", "clip", "clip_start", "clip_length", "fps")
# frames that are interpolated at once, to bound the memory
_BLOCK = 4096


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
        _check_cuts(self, len(self.joints))

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, clip: int) -> np.ndarray:
        """The joints (length, 24, 3) of one clip."""
        return self.joints[self.start[clip] : self.start[clip] + self.length[clip]]

    def of(self, subjects: str | Iterable[str]) -> "Clips":
        """The clips whose names start with one of `subjects`, such as "002", which "0021_03" does not. Raises
        InputError for one without."""
        chosen, frames, start = _chosen(self, subjects)
        return replace(
            self,
            joints=self.joints[frames],
            names=tuple(self.names[c] for c in chosen),
            start=start,
            length=self.length[chosen],
        )


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Captured motion as the body plays it.

    rotations (F, 24, 3, 3) float32, local, in the rest frame of `body.rig`, any heading; translation (F, 3) float32 m,
    the pelvis, z up; clip c, named names[c], is the frames start[c] to start[c] + length[c], one every 1 / fps s;
    source: what it was read from; dropped: frames that were left out for values that are no numbers.
    """

    rotations: np.ndarray
    translation: np.ndarray
    names: tuple[str, ...]
    start: np.ndarray
    length: np.ndarray
    fps: float
    source: str
    dropped: int = 0

    def __post_init__(self):
        frames = len(self.rotations)
        if self.rotations.shape != (frames, 24, 3, 3) or self.translation.shape != (frames, 3):
            raise InputError(
                "motion needs rotations (frames, 24, 3, 3) and translation (frames, 3), "
                f"got {self.rotations.shape} and {self.translation.shape}"
            )
        if not (np.isfinite(self.rotations).all() and np.isfinite(self.translation).all()):
            raise InputError("motion needs finite rotations and translation; drop the frames without")
        _check_cuts(self, frames)

    def __len__(self) -> int:
        return len(self.names)

    def frames(self, clip: int) -> slice:
        """The frames of one clip, to cut `rotations` and `translation` with."""
        return slice(int(self.start[clip]), int(self.start[clip] + self.length[clip]))

    def of(self, subjects: str | Iterable[str]) -> "Motion":
        """The clips whose names start with one of `subjects`, such as "002", which "0021_03" does not. Raises
        InputError for one without."""
        chosen, frames, start = _chosen(self, subjects)
        return replace(
            self,
            rotations=self.rotations[frames],
            translation=self.translation[frames],
            names=tuple(self.names[c] for c in chosen),
            start=start,
            length=self.length[chosen],
        )

    def poses(self) -> np.ndarray:
        """The poses (F, 24, 3, 3) of all frames, each turned about z to face +x."""
        return without_yaw(self.rotations)

    def resampled(self, hz: float) -> "Motion":
        """The same clips with `hz` frames a second: a clip keeps its first frame and loses less than a frame at its
        end. Between frames, rotations are turned evenly (the short way) and the pelvis goes straight."""
        if not 0 < hz < np.inf:
            raise InputError(f"hz must be frames a second, above 0, got {hz}")
        if hz == self.fps:
            return self
        # the small number keeps the last frame where rounding would lose it, as from 30 to 10 frames a second
        length = np.array([int((n - 1) / self.fps * hz + 1e-6) + 1 if n else 0 for n in self.length.tolist()], int)
        when = [c + np.arange(n) * (self.fps / hz) for c, n in zip(self.start, length, strict=True)]
        last = np.repeat(self.start + np.maximum(self.length, 1) - 1, length)
        rotations, translation = self._between(np.concatenate([*when, np.zeros(0)]), last)
        return replace(
            self,
            rotations=rotations,
            translation=translation,
            start=np.cumsum(length) - length,
            length=length,
            fps=float(hz),
        )

    def windows(self, frames: int, *, step: int = 1) -> np.ndarray:
        """Which frames make clips of `frames`: (n, frames) int, every `step`-th start, none across the end of a clip.

        `motion.rotations[motion.resampled(10).windows(16)]` would mix rates: cut the motion that was resampled.
        """
        if frames < 1 or step < 1:
            raise InputError(f"windows need frames >= 1 and step >= 1, got {frames} and {step}")
        first = [s + np.arange(0, n - frames + 1, step) for s, n in zip(self.start, self.length, strict=True)]
        return np.concatenate([*first, np.zeros(0, int)]).astype(int)[:, None] + np.arange(frames)

    def pairs(self, dt: float) -> "Moves":
        """All poses that have one `dt` seconds later in their clip, with that one. dt >= 0."""
        if not 0 <= dt < np.inf:
            raise InputError(f"dt must be 0 s or more, got {dt}")
        ahead = dt * self.fps
        ends = np.repeat(self.start + self.length - 1, self.length)
        frame = np.concatenate([np.arange(self.frames(c).start, self.frames(c).stop) for c in range(len(self))] or [[]])
        frame = frame.astype(int)
        kept = frame + ahead <= ends + 1e-6
        frame, ends = frame[kept], ends[kept]
        later, way = self._between(frame + ahead, ends)
        first = self.rotations[frame]
        back = rotation_about("z", -heading(first))
        step = (back @ (way - self.translation[frame])[..., None])[..., 0]
        later[:, 0] = back @ later[:, 0]
        return Moves(rotations=without_yaw(first), moved=later, step=step.astype(np.float32))

    def _between(self, when: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rotations (n, 24, 3, 3) and translation (n, 3) at frames `when` (n,), not whole, up to their clip's last."""
        frame = np.minimum((when + 1e-6).astype(int), last)
        after = np.minimum(frame + 1, last)
        share = np.clip(when - frame, 0, 1)[:, None]
        share[share < 1e-5] = 0
        rotations, translation = self.rotations[frame], self.translation[frame]
        mixed = np.flatnonzero(share[:, 0])
        for block in np.array_split(mixed, len(mixed) // _BLOCK + 1):
            a, b = self.rotations[frame[block]].astype(float), self.rotations[after[block]].astype(float)
            turn = rotation_vector((np.swapaxes(a, -1, -2) @ b).reshape(-1, 3, 3)).reshape(-1, 24, 3)
            rotations[block] = a @ axis_angle_to_matrix(share[block, None] * turn)
            translation[block] += share[block] * (self.translation[after[block]] - translation[block])
        return rotations, translation


@dataclass(frozen=True, kw_only=True)
class Moves:
    """Poses and where they are a moment later. rotations (n, 24, 3, 3) float32, local, facing +x; moved
    (n, 24, 3, 3) float32 and step (n, 3) float32 m, the way of the pelvis, both in the axes of `rotations`."""

    rotations: np.ndarray
    moved: np.ndarray
    step: np.ndarray


def join(motions: Iterable[Motion], *, source: str) -> Motion:
    """All clips of several motions at one rate, the lowest of theirs. Raises InputError where there is none."""
    motions = list(motions)
    if not motions:
        raise InputError(f"{source}: no motion to join")
    motions = [motion.resampled(min(m.fps for m in motions)) for motion in motions]
    before = np.cumsum([0] + [len(m.rotations) for m in motions[:-1]])
    return Motion(
        rotations=np.concatenate([m.rotations for m in motions]),
        translation=np.concatenate([m.translation for m in motions]),
        names=tuple(name for m in motions for name in m.names),
        start=np.concatenate([m.start + b for m, b in zip(motions, before, strict=True)]),
        length=np.concatenate([m.length for m in motions]),
        fps=motions[0].fps,
        source=source,
        dropped=sum(m.dropped for m in motions),
    )


def facing_x(rotations: np.ndarray, translation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Clips (n, F, 24, 3, 3) and (n, F, 3) turned about z and moved, so that each begins over the origin (its z is
    kept) and faces +x. Cut them with `Motion.windows`."""
    back = rotation_about("z", -heading(rotations[:, 0]))[:, None]
    turned = np.array(rotations)
    turned[:, :, 0] = back @ turned[:, :, 0]
    way = translation - translation[:, :1] * [1, 1, 0]
    return turned, (back @ way[..., None])[..., 0].astype(np.float32)


@contextmanager
def archive(path: str | os.PathLike) -> Iterator[None]:
    """Around the reading of an npz: InputError, naming the file, for all that goes wrong there."""
    try:
        yield
    except InputError:
        raise
    except FileNotFoundError:
        raise file_error(path, "no such file") from None
    except MemoryError:
        raise file_error(path, "does not fit in memory; split it first") from None
    except Exception as error:  # numpy and zlib raise many kinds for a broken archive
        raise file_error(path, f"not an npz of plain arrays ({error}); was it copied completely?") from None


def load_clips(path: str | Path) -> Clips:
    """Reads a clips file (its layout is at the top of this module). Raises InputError where it is another."""
    with archive(path), np.load(path, allow_pickle=False) as file:
        missing = [key for key in _KEYS if key not in file]
        if missing:
            raise InputError(f"{path}: clips need {', '.join(_KEYS)}; {', '.join(missing)} is missing")
        stored = {key: file[key] for key in file.files if key in (*_KEYS, "joint_names")}
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


def _check_cuts(clips: Clips | Motion, frames: int) -> None:
    """Raises InputError unless the clips lie inside the frames and have a rate."""
    for name in ("start", "length"):
        value = getattr(clips, name)
        if value.shape != (len(clips.names),) or value.dtype.kind not in "iu":
            raise InputError(
                f"clip_{name} needs one whole number a clip, ({len(clips.names)}), got {value.dtype} {value.shape}"
            )
        # in narrow or unsigned numbers an end could overflow
        object.__setattr__(clips, name, value.astype(np.int64))
    ends = clips.start + clips.length
    if len(ends) and (min(clips.start.min(), clips.length.min()) < 0 or ends.max() > frames):
        raise InputError(f"clips must lie inside the {frames} frames, got up to frame {ends.max()}")
    if not 0 < clips.fps < np.inf:
        raise InputError(f"fps must be frames a second, above 0, got {clips.fps}")


def _chosen(clips: Clips | Motion, subjects: str | Iterable[str]) -> tuple[list[int], np.ndarray, np.ndarray]:
    """Which clips start with one of `subjects`, which frames those are, and where each clip starts among them."""
    subjects = (subjects,) if isinstance(subjects, str) else tuple(subjects)
    for subject in subjects:
        if not any(_is_of(name, subject) for name in clips.names):
            known = ", ".join(sorted({name.partition("_")[0] for name in clips.names}))
            raise InputError(f"no clip starts with {subject!r}: there are {known}")
    chosen = [c for c, name in enumerate(clips.names) if any(_is_of(name, subject) for subject in subjects)]
    frames = [np.arange(clips.start[c], clips.start[c] + clips.length[c]) for c in chosen]
    length = clips.length[chosen]
    return chosen, np.concatenate([*frames, np.zeros(0, int)]).astype(int), np.cumsum(length) - length


def _is_of(name: str, subject: str) -> bool:
    """Whether a clip's name starts with a subject's. A number that goes on is another one: 102_03 is not of 10, nor
    10_01 of 1."""
    return name.startswith(subject) and not (subject[-1:].isdigit() and name[len(subject) :][:1].isdigit())
