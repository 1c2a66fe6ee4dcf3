"""Frames and frame sources, the common interface of all kinds of recordings."""

import os
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Protocol

import numpy as np

from lidarpose.errors import InputError, LidarPoseError, MissingExtra, check_finite, check_int
from lidarpose.geometry import is_rotation, nearest_rotation, vector_of
from lidarpose.io.files import FormatError, file_error, one_line, shorten

# frames per second if a source has no times
DEFAULT_RATE = 10.0
# s; seconds since 1970 have a float64 resolution of 0.2 microseconds
_ROUNDING = 1e-6
# s, three thousand years: larger times are milliseconds, microseconds or nanoseconds since 1970
_LATEST = 1e11


@dataclass(frozen=True, kw_only=True, eq=False)
class Sweep:
    """The points of one sensor revolution, as the reader of a format decodes them.

    Args:
        points: (n, 3) m in the recording's frame, usually the sensor's; rows that are NaN or 0, 0, 0 are missing
            returns.
        T_world_sensor: (4, 4) m, or None if the sensor pose is unknown; the world's z axis points up.
        origin: (3,) m, the sensor position in the points' frame; None if unknown or not stated.
        is_origin_unknown: whether None means unknown. Otherwise `predict_recording` assumes 0, 0, 0 as for point files.
        ring: (n,) the beam of each point, or None.
        point_times: (n,) s from any zero, when each point was measured, or None.
        warnings: lines about this frame.
    """

    points: np.ndarray
    T_world_sensor: np.ndarray | None = None
    origin: np.ndarray | None = None
    ring: np.ndarray | None = None
    point_times: np.ndarray | None = None
    warnings: tuple[str, ...] = ()
    is_origin_unknown: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame(Sweep):
    """One frame of a source: a `Sweep` without the rows of missing returns, and its position in the source.

    Args:
        points: (n, 3) float64 m, finite. In frames that users create, `predict_recording` drops missing returns.
        index: its number in the source, from 0; damaged frames count.
        id: its name in the source, e.g. the stem of its file.
        time: s; computed from `index` and the rate if the source has no times.

    `T_world_sensor` and `origin` are copied, and a rotation that is off by up to 1 % is made exact.

    Raises:
        InputError: `T_world_sensor` is not a rigid transform (4, 4), `origin` not a position, or `index` or `time` not
            a finite number, or `time` not in seconds.
    """

    index: int
    id: str
    time: float | None = None

    def __repr__(self) -> str:
        time = "" if self.time is None else f", t={self.time} s"
        return f"Frame({self.index}, {self.id!r}, {len(self.points):,} points{time})"

    def __post_init__(self):
        object.__setattr__(self, "index", check_int("Frame.index", self.index, least=0))
        if self.time is not None:
            check_finite("Frame.time", self.time)
            if abs(self.time) > _LATEST:
                problem = f"expected seconds, got {self.time:g}"
                raise InputError(f"Frame.time: {problem}: divide milliseconds by 1e3, nanoseconds by 1e9")
            object.__setattr__(self, "time", float(self.time))
        if self.origin is not None:
            origin = vector_of(self.origin)
            if origin is None:
                problem = f"expected three numbers, meters, got {shorten(repr(self.origin), 60)}"
                raise InputError(f"Frame.origin: {problem}: give is_origin_unknown=True if it is not known")
            object.__setattr__(self, "origin", origin)
        if self.T_world_sensor is None:
            return
        try:
            T = np.array(self.T_world_sensor, float)
        except (TypeError, ValueError):
            T = np.zeros(0)
        is_finite = T.shape == (4, 4) and np.isfinite(T).all()
        if not (is_finite and is_rotation(T[:3, :3]) and np.allclose(T[3], [0, 0, 0, 1])):
            actual = shorten(repr(np.round(T, 3).tolist()), 90)
            raise InputError(
                "Frame.T_world_sensor: expected (4, 4), a rotation and a position in meters over 0 0 0 1, got "
                f"{actual}: give None if the sensor's pose is not known"
            )
        T[:3, :3] = nearest_rotation(T[:3, :3])
        object.__setattr__(self, "T_world_sensor", T)


@dataclass(frozen=True, kw_only=True)
class DamagedFrame:
    """A frame that cannot be read. error: the reason, on one line. The frames after it are still read."""

    index: int
    id: str
    time: float | None = None
    error: str


# ---- interface of the readers of each format


@dataclass(frozen=True, kw_only=True)
class ReadingOptions:
    """How recordings are read: columns, topic, meta as in `open_source`; name_times: whether file names give times."""

    columns: int | None = None
    topic: str | None = None
    meta: Path | None = None
    name_times: bool = True

    def ignored(self, *names: str) -> list[str]:
        """A warning if options of these names are given, for a format that has no use for them."""
        given = [name for name in names if getattr(self, name) is not None]
        return [f"options that this kind of source does not have are ignored: {', '.join(given)}"] if given else []


@dataclass(frozen=True, eq=False)
class LazyFrame:
    """A frame that is not decoded yet: its name, its time in s if recorded, and `read`, which decodes it and raises
    InputError or FormatError if it is damaged."""

    id: str
    time: float | None
    read: Callable[[], Sweep]


class Recording(Protocol):
    """A file or folder as the reader of its format opens it: frames not yet decoded, which can be iterated repeatedly.

    `name` is the name of the file or folder, `count` the number of frames if it is known before reading; `warnings`
    are lines about the whole recording, some only known after iterating. An InputError after the first frame ends the
    recording there, and becomes a damaged frame.
    """

    @property
    def name(self) -> str: ...

    @property
    def count(self) -> int | None: ...

    @property
    def warnings(self) -> Sequence[str]: ...

    def lazy_frames(self, first: int = 0) -> Iterator[LazyFrame]: ...


@dataclass(kw_only=True, eq=False)
class IndexedRecording:
    """A recording whose frames can be read in any order.

    ids: of all frames; times: s, of all frames, None if not recorded; read(i) decodes frame i.
    """

    name: str
    ids: Sequence[str]
    times: Sequence[float] | None
    read: Callable[[int], Sweep]
    warnings: list[str] = field(default_factory=list)

    @property
    def count(self) -> int:
        return len(self.ids)

    def lazy_frames(self, first: int = 0) -> Iterator[LazyFrame]:
        for i in range(first, len(self.ids)):
            yield LazyFrame(self.ids[i], None if self.times is None else float(self.times[i]), partial(self.read, i))


class ChainedRecording:
    """Several recordings, one after the other. Frame ids begin with the recording's path in the folder `name`; times
    are dropped unless all recordings have them. A recording that breaks off ends with a damaged frame, after which the
    next recording follows."""

    def __init__(self, name: str, parts: Sequence[Recording], warnings: Sequence[str] = ()):
        self.name = name
        self.parts = parts
        self._warnings = warnings
        self._has_times = all(map(_has_times, parts))

    @property
    def warnings(self) -> list[str]:
        return [*self._warnings, *(f"{part.name}: {line}" for part in self.parts for line in part.warnings)]

    @property
    def count(self) -> int | None:
        counts = [part.count for part in self.parts]
        return None if None in counts else sum(filter(None, counts))

    def lazy_frames(self, first: int = 0) -> Iterator[LazyFrame]:
        for part in self.parts:
            if first:
                length = sum(1 for _ in self._frames(part)) if part.count is None else part.count
                if first >= length:
                    first -= length
                    continue
            prefix = Path(os.path.relpath(part.name, self.name)).as_posix()
            for frame in self._frames(part, first):
                yield LazyFrame(f"{prefix}/{frame.id}", frame.time if self._has_times else None, frame.read)
            first = 0

    def _frames(self, part: Recording, first: int = 0) -> Iterator[LazyFrame]:
        try:
            yield from part.lazy_frames(first)
        except InputError as error:
            yield LazyFrame("end", None, partial(_refuse, error))


def _has_times(part: Recording) -> bool:
    """Whether the recording's frames have times; True if it has no readable first frame."""
    try:
        first_frame = next(part.lazy_frames(0), None)
    except InputError:
        return True
    return first_frame is None or first_frame.time is not None


def _refuse(error: InputError) -> Sweep:
    raise error


# ---- public source


class FrameSource:
    """The frames of a recording, optionally within a time range and only every n-th: in order, one in memory at a time,
    iterable repeatedly.

    Args:
        rate: frames per second if frames have no times; 10 by default.
        start, end: s from the first frame. The first frame past `end` ends the source.
        every: read only frames whose index is a multiple of this.

    Raises:
        InputError: an option has an invalid value, or the recording has no frames.
    """

    def __init__(
        self,
        recording: Recording,
        *,
        rate: float | None = None,
        start: float | None = None,
        end: float | None = None,
        every: int = 1,
    ):
        for name, value in (("rate", rate), ("start", start), ("end", end)):
            if value is not None:
                check_finite(name, value)
        if rate is not None and rate <= 0:
            raise InputError(f"rate must be positive, in frames per second, got {rate!r}")
        first = start or 0
        if end is not None and end <= first:
            raise InputError(f"end must be later than start, in seconds from the first frame, got {first!r} to {end!r}")
        self.name = recording.name
        self.recording = recording
        self.rate = rate or DEFAULT_RATE
        self.start, self.end = start, end
        self.every = check_int("every", every, least=1)
        first_frame = next(recording.lazy_frames(), None)
        if first_frame is None:
            raise file_error(recording.name, "has no frames; expected at least one: was it recorded completely?")
        self._first_time = first_frame.time
        self._notes: list[str] = []
        if first_frame.time is not None and abs(first_frame.time) > _LATEST:
            self._first_time = None
            self._notes.append(f"has times that are not seconds: read as {self.rate:g} frames per second")
        elif first_frame.time is None and recording.count != 1 and rate is None:
            rate_hint = "change it with rate, on the command line --rate"
            self._notes.append(f"has no times: read as {DEFAULT_RATE:g} frames per second ({rate_hint})")
        self._num_back = 0

    @property
    def count(self) -> int | None:
        """Number of frames, including damaged ones; None if it is unknown before reading."""
        count = self.recording.count
        if count is None or self.start is None and self.end is None:
            return None if count is None else -(-count // self.every)
        times = np.arange(count) / self.rate if self._first_time is None else getattr(self.recording, "times", None)
        if times is None:
            return None
        places = [self._place(time) for time in times]
        # the first frame past the end ends the source
        places = places[: places.index(1) if 1 in places else None]
        return places[:: self.every].count(0)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Lines about the source as a whole, for the part read so far."""
        jump_notes = (
            [f"time jumps back {self._num_back} times: the order of the recording is kept"] if self._num_back else []
        )
        return (*self.recording.warnings, *self._notes, *jump_notes)

    def __iter__(self) -> Iterator[Frame | DamagedFrame]:
        return self.frames()

    def _place(self, time: float) -> int:
        """-1 for a time before the range that is read, 0 in it, 1 after it."""
        elapsed = time - (self._first_time or 0.0)
        if self.end is not None and elapsed > self.end + _ROUNDING:
            return 1
        return -1 if self.start is not None and elapsed < self.start - _ROUNDING else 0

    def frames(self, first: int = 0, *, only: Collection[int] | None = None) -> Iterator[Frame | DamagedFrame]:
        """The frames from index `first` on, or of the indices `only`, without decoding others."""
        last = None if only is None else max(only, default=-1)
        self._num_back = 0
        last_time = -np.inf
        index = first - 1
        try:
            for index, lazy_frame in enumerate(self.recording.lazy_frames(first), first):
                if last is not None and index > last:
                    return
                time = index / self.rate if self._first_time is None else lazy_frame.time
                if time is not None:
                    self._num_back += time < last_time
                    last_time = time
                    if (place := self._place(time)) > 0:
                        return
                    if place < 0:
                        continue
                if index % self.every == 0 and (only is None or index in only):
                    yield _read(lazy_frame, index, time)
        except LidarPoseError as error:
            if index < 0 or isinstance(error, MissingExtra):
                raise
            yield DamagedFrame(index=index + 1, id="", error=f"the recording ends here: {error}")


def _read(lazy_frame: LazyFrame, index: int, time: float | None) -> Frame | DamagedFrame:
    try:
        sweep = lazy_frame.read()
        points = np.asarray(sweep.points, np.float64)
        # false for NaN, infinity and 0, 0, 0
        distance = np.abs(points) @ np.ones(3)
        is_return = (distance > 0) & (distance < np.inf)
        per_point = {name: value for name in ("ring", "point_times") if (value := getattr(sweep, name)) is not None}
        returns = {name: value[is_return] for name, value in ({"points": points} | per_point).items()}
        return Frame(**vars(sweep) | returns, index=index, id=lazy_frame.id, time=time)
    except MissingExtra:
        raise
    except Exception as error:
        is_explained = isinstance(error, LidarPoseError | FormatError)
        reason = str(error) if is_explained else f"cannot be read ({shorten(f'{type(error).__name__}: {error}')})"
        return DamagedFrame(index=index, id=lazy_frame.id, time=time, error=one_line(reason))
