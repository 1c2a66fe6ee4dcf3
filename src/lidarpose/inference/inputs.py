"""Input validation and cleaning: from a user's point cloud to the points of one person."""

import os
import reprlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from numbers import Integral, Real
from typing import Any

import numpy as np

from lidarpose.arrays import to_numpy
from lidarpose.errors import InputError, counted
from lidarpose.geometry import vector_of
from lidarpose.io.files import FormatError, one_line
from lidarpose.io.point_cloud import Cloud
from lidarpose.io.point_times import as_point_times
from lidarpose.io.text import is_image, is_transposed, pick_xyz
from lidarpose.sample import CLIP_FRAMES, FARTHEST, MIN_POINTS, clip_windows, within_reach

# frames per second of a clip without times
CLIP_RATE = 10.0
# people with more points are thinned: no sensor records that many, and the voxels do not need them
MAX_POINTS = 50_000

# rounding of coordinates, m, from which people are not recognized; number of points from which the magnitude of a large
# scan's coordinates is estimated
_COARSE, _LOOKED_AT = 0.1, 100_000
# maximum fraction of duplicate points that may remain
_FEW_COPIES = 0.01


@dataclass(frozen=True, kw_only=True, eq=False)
class Clips:
    """Which of N clouds are consecutive frames of the same person, for networks that read clips.

    Args:
        windows: (C, 16) int, rows of the clouds. A row may repeat within its window but is in no other window.
        background, neighbors: (N,) clouds (n, 3) m around the person of each frame, as in `Sample`, in the frame of the
            clouds; None for none.
    """

    windows: np.ndarray
    background: Sequence[np.ndarray] | None = None
    neighbors: Sequence[np.ndarray] | None = None

    @classmethod
    def of_run(cls, count: int, **clouds: Sequence[np.ndarray]) -> "Clips":
        """Clips of `count` clouds that are all frames of one person, in temporal order."""
        return cls(windows=clip_windows(np.arange(count)), **clouds)

    def checked(self, count: int) -> "Clips":
        """The validated clips of `count` clouds. Raises InputError unless each cloud is in exactly one window and
        `background` and `neighbors` have one cloud per frame."""
        windows = np.asarray(self.windows, object)
        is_table = windows.ndim == 2 and windows.shape[1] == CLIP_FRAMES
        is_table = is_table and all(isinstance(row, Integral) for row in windows.flat)
        rows = [row for window in windows for row in set(window)] if is_table else []
        if not is_table or sorted(rows) != list(range(count)):
            raise InputError(
                f"clips: expected windows of {CLIP_FRAMES} rows, with each of the {count} clouds in one window, as "
                f"in Clips.of_run({count}), got {reprlib.repr(windows.tolist())}"
            )
        surroundings = {}
        for name in ("background", "neighbors"):
            if (clouds := getattr(self, name)) is None:
                continue
            if len(clouds) != count:
                raise InputError(f"clips: expected as many clouds of {name} as clouds, {count}, got {len(clouds)}")
            surroundings[name] = [as_points(cloud, f"{name}[{i}]") for i, cloud in enumerate(clouds)]
        return replace(self, windows=windows.astype(int), **surroundings)

    def around(self, rows: np.ndarray) -> dict[str, list[np.ndarray]]:
        """The clouds `background` and `neighbors` of the given rows, by name; empty clouds where there are none."""
        clouds = {"background": self.background, "neighbors": self.neighbors}
        return {
            name: [np.zeros((0, 3)) if person_clouds is None else np.asarray(person_clouds[row], float) for row in rows]
            for name, person_clouds in clouds.items()
        }

    def mapped(self, change: Callable[[list[np.ndarray]], list[np.ndarray]]) -> "Clips":
        """The same clips with `change` applied to `background` and `neighbors`."""
        rows = np.arange(1 + self.windows.max())
        surroundings = self.around(rows)
        return replace(self, background=change(surroundings["background"]), neighbors=change(surroundings["neighbors"]))

    def usable(self, keep: np.ndarray) -> "Clips":
        """The windows with only the rows to keep (N,) bool. Each dropped row is replaced by the next kept row of its
        window, or the last one; windows without kept rows are removed."""
        windows = []
        for window in self.windows:
            positions = np.flatnonzero(keep[window])
            if len(positions):
                windows.append(
                    window[positions[np.searchsorted(positions, np.arange(CLIP_FRAMES)).clip(0, len(positions) - 1)]]
                )
        return replace(self, windows=np.array(windows, int).reshape(-1, CLIP_FRAMES))

    def batches(self, count: int) -> Iterator[tuple[np.ndarray, "Clips"]]:
        """Yields batches of `count` windows: the rows (n,) of their clouds, and the clips of these rows only."""
        for start in range(0, len(self.windows), count):
            rows, local_rows = np.unique(self.windows[start : start + count], return_inverse=True)
            yield rows, Clips(windows=local_rows.reshape(-1, CLIP_FRAMES), **self.around(rows))


def as_points(points: Any, what: str = "points") -> np.ndarray:
    """Converts anything array-like (n, 3+), or a table or record array with columns x, y, z, to (n, 3) float64.

    Raises InputError for other shapes or types; n = 0 is legal.
    """
    if isinstance(points, str | os.PathLike):
        raise InputError(f"{what} must be an (n, 3) array, got a path: use lidarpose.predict({str(points)!r})")
    if isinstance(points, list | tuple) and points and isinstance(points[0], str | os.PathLike):
        raise InputError(
            f"{what}: expected one file or array, got a list of {counted(len(points), 'path')}: one call per file, or "
            "lidarpose.predict_recording for frames of a recording"
        )
    if isinstance(points, list | tuple) and points and getattr(points[0], "ndim", 0) > 1:
        raise InputError(
            f"{what} must be one (n, 3) array, got a list of {len(points)}: one call per scan, or "
            "lidarpose.load().predict([...]) for crops"
        )
    is_records = getattr(getattr(points, "dtype", None), "names", None) is not None
    points = _by_name(points, what)
    try:
        # `to_numpy` sets masked values to NaN, which are dropped later
        array = np.asarray(to_numpy(points))
    except (ValueError, TypeError) as error:
        raise InputError(f"{what} must be an (n, 3) array of numbers, got rows of unequal length ({error})") from None
    if array.shape == (0,):
        return np.empty((0, 3))
    if array.dtype == object and array.ndim == 0:
        frame = ", its points are in .points" if hasattr(points, "points") else ""
        raise InputError(f"{what} must be an (n, 3) array of numbers, got {type(points).__name__}{frame}")
    if array.dtype == object:
        if array.ndim != 2 or not all(isinstance(value, Real) for value in array.ravel().tolist()):
            raise InputError(
                f"{what} must be an (n, 3) array of numbers, got {type(points).__name__} of objects, not all numbers, "
                f"shape {array.shape}: give columns of numbers only, and many people as a list of arrays"
            )
        try:
            array = array.astype(float)
        except OverflowError as error:
            raise InputError(
                f"{what} must be an (n, 3) array of numbers below {FARTHEST:g} m, got a larger one ({error})"
            ) from None
    if array.dtype.kind not in "fiu":
        raise InputError(f"{what} must be an (n, 3) array of numbers, got {array.dtype} of shape {array.shape}")
    looks_transposed, looks_depth = is_transposed(array.shape), is_image(array.shape)
    if array.ndim == 3 and array.shape[2] >= 3:
        # may be a scan organized by beams or several people: only the caller knows
        one_scan = "ravel()" if is_records else f"reshape(-1, {array.shape[2]})"
        raise InputError(
            f"expected (n, 3 or more) {what}, got {array.shape}: one scan is points.{one_scan}, several people "
            "list(points)"
        )
    if array.ndim != 2 or array.shape[1] < 3 or looks_transposed or looks_depth:
        remedy = ": give points.T" if looks_transposed else ""
        remedy = ": convert the depth image to points" if looks_depth else remedy
        raise InputError(f"{what} must be (n, 3) or (n, 3 + more) with x, y, z first, got shape {array.shape}{remedy}")
    return array[:, :3].astype(np.float64)


def _by_name(points: Any, what: str) -> Any:
    """The columns x, y and z of a table (pandas, polars) or record array, in any position; other inputs unchanged."""
    names = getattr(getattr(points, "dtype", None), "names", None) or getattr(points, "columns", None)
    if names is None or not len(names) or not all(isinstance(name, str) for name in names):
        return points
    try:
        columns = [points[names[i]] for i in pick_xyz(names)]
        return (np.ma if isinstance(points, np.ma.MaskedArray) else np).stack(columns, -1)
    except (FormatError, ValueError) as problem:
        # two columns with the same name are ambiguous
        raise InputError(f"{what}: {problem}") from None


def clip_times(times: Any, count: int) -> np.ndarray:
    """Times (T,) s of `count` frames; None means ten per second. Raises InputError unless they strictly increase."""
    if times is None:
        return np.arange(count) / CLIP_RATE
    try:
        seconds = np.asarray(times)
        # reject dates and time differences, which would be read as seconds whatever their unit
        is_date = seconds.dtype.kind in "mM" or not all(isinstance(time, Real) for time in seconds.ravel().tolist())
        seconds = np.full(0, np.nan) if is_date else seconds.astype(float)
    except (TypeError, ValueError, OverflowError):
        seconds = np.full(0, np.nan)
    if seconds.shape != (count,) or not (np.isfinite(seconds).all() and (np.diff(seconds) > 0).all()):
        raise InputError(
            f"times: expected {count} finite numbers of seconds, one per cloud, each later than the one before, "
            f"got {reprlib.repr(times)}"
        )
    return seconds


def own_times(points: Any) -> np.ndarray | None:
    """The times of the points of a `Cloud`, which are relative to the newest; None for arrays."""
    return points.point_times if isinstance(points, Cloud) else None


def times_of_clouds(inputs: Sequence, clouds: list[np.ndarray], point_times: Any) -> list[np.ndarray | None]:
    """When the points of each cloud were measured: as given by the user, or of a `Cloud`. Raises InputError."""
    if point_times is None:
        return [own_times(points) for points in inputs]
    if not isinstance(point_times, list | tuple) or len(point_times) != len(clouds):
        raise InputError(
            f"point_times: expected a list with the times of each of {len(clouds)} clouds or None, got "
            f"{reprlib.repr(point_times)}"
        )
    triples = zip(inputs, clouds, point_times, strict=True)
    return [
        own_times(points) if times is None else as_point_times(times, len(cloud), f"point_times[{i}]")
        for i, (points, cloud, times) in enumerate(triples)
    ]


def as_origin(value: object) -> np.ndarray | None:
    """The sensor position (3,) m from three numbers or "x,y,z"; None for None or "unknown". Raises InputError."""
    if value is None or isinstance(value, str) and value.strip() == "unknown":
        return None
    origin = vector_of(value)
    if origin is None or not (np.abs(origin) < FARTHEST).all():
        raise InputError(one_line(f"sensor origin: expected x,y,z in meters or unknown, got {value!r}"))
    return origin


def clean(points: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Drops invalid points of (n, 3) m as `only_returns` does and thins the rest to `MAX_POINTS`. Returns the points
    and a message for each change."""
    points, notes = _finite_returns(points)
    if len(points) > MAX_POINTS:
        notes.append(
            f"thinned from {len(points)} to {MAX_POINTS} points: crop closer to the person if the crop contains others"
        )
        points = points[np.arange(MAX_POINTS) * len(points) // MAX_POINTS]
    return points, notes


def distinct(points: np.ndarray) -> np.ndarray:
    """Points (n, 3) m without duplicates, see `distinct_rows`."""
    rows = distinct_rows(points)
    return points if rows is None else points[rows]


def distinct_rows(points: np.ndarray) -> np.ndarray | None:
    """The rows of points (n, 3) m without duplicates, if there are more than a few, else None: second returns mostly
    repeat the first, and networks count points."""
    keys = hashes(points)
    ordered = np.sort(keys)
    if np.count_nonzero(ordered[1:] == ordered[:-1]) <= _FEW_COPIES * len(points):
        return None
    return np.sort(np.unique(keys, return_index=True)[1])


def hashes(points: np.ndarray) -> np.ndarray:
    """(n,) uint64, evenly distributed numbers that depend only on the coordinates of each of points (n, 3)."""
    factors = (0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9)
    keys = np.zeros(len(points), np.uint64)
    for axis, factor in zip(np.ascontiguousarray(points.T, np.float64).view(np.uint64), factors, strict=True):
        # the upper bits are the ones that differ
        keys = (keys ^ axis ^ (axis >> np.uint64(29))) * np.uint64(factor)
    return keys


def rounding_warning(points: np.ndarray) -> str | None:
    """A warning if points (n, 3) m are rounded too coarsely to show a person, as large map coordinates in 16 or 32 bits
    are."""
    if not len(points):
        return None
    # a quantile ignores stray points; a subsample suffices for a large map
    some = points[:: max(len(points) // _LOOKED_AT, 1)]
    magnitude = np.quantile(np.abs(some), 0.9)
    for bits, kind in ((16, np.float16), (32, np.float32)):
        with np.errstate(all="ignore"):
            step, is_rounded = float(np.spacing(kind(magnitude))), np.array_equal(some.astype(kind), some)
        # whole numbers are not rounded to 16 bits, but in another unit
        if step >= _COARSE and is_rounded and (bits == 32 or (some % 1).any()):
            return (
                f"coordinates are rounded to {step:g} m, the precision of {bits}-bit floats at this magnitude: "
                "subtract an offset before saving"
            )
    return None


def only_returns(points: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Drops rows of points (n, 3) m that are not finite, too large or not returns. Returns the points and a message for
    each kind of dropped rows and for rounded coordinates."""
    points, notes = _finite_returns(points)
    return points, [*notes, *filter(None, [rounding_warning(points)])]


def _finite_returns(points: np.ndarray) -> tuple[np.ndarray, list[str]]:
    rows, notes = usable_rows(points)
    return points if rows is None else points[rows], notes


def usable_rows(points: np.ndarray) -> tuple[np.ndarray | None, list[str]]:
    """The rows (n,) bool of points (n, 3) m that are finite, not too large and returns, None if all are; and a message
    for each kind of other rows."""
    notes = []
    is_usable = within_reach(points)
    if num_dropped := int((~is_usable).sum()):
        notes.append(f"dropped {num_dropped} of {len(points)} points that were NaN, infinite or beyond {FARTHEST:g} m")
    # organized clouds fill pixels without a return with 0, 0, 0; a single zero may be a point of a centered cloud
    is_zero = ~points.any(1)
    if (num_zeros := int(is_zero.sum())) > 1:
        notes.append(f"dropped {num_zeros} of {len(points)} points at 0,0,0, which are not returns")
        is_usable &= ~is_zero
    return (is_usable, notes) if notes else (None, [])


def is_few(points: np.ndarray) -> bool:
    """Whether points (n, 3) have fewer than `MIN_POINTS` distinct positions."""
    for _ in range(MIN_POINTS):
        if not len(points):
            return True
        points = points[(points != points[0]).any(1)]
    return False


def is_many(points) -> bool:
    """Whether the input is a list of clouds rather than one cloud. A list of points is one cloud."""
    return isinstance(points, list | tuple) and (len(points) == 0 or not _is_row(points[0]))


def _is_row(value) -> bool:
    """Whether the value is one point: a flat list or array of numbers. Ragged values are not; empty values are
    clouds."""
    if isinstance(value, list | tuple):
        is_flat = not any(isinstance(entry, list | tuple) or getattr(entry, "ndim", 0) for entry in value)
    else:
        # an array of records is a cloud
        is_flat = getattr(value, "ndim", 0) == 1 and not getattr(getattr(value, "dtype", None), "names", None)
    return is_flat and len(value) > 0
