"""The static background around a stationary sensor, learned from a recording, in which no people are searched for."""

import os
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from lidarpose.arrays import evenly_spaced
from lidarpose.errors import InputError, counted
from lidarpose.inference.inputs import as_points, only_returns
from lidarpose.io.files import FormatError, file_error, listed
from lidarpose.io.point_cloud import read_points
from lidarpose.io.sources import is_single_scan, open_source
from lidarpose.io.sources.frame import ChainedRecording, LazyFrame

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

# edge of a voxel, m; a point fills the 2 x 2 x 2 voxels nearest to it, since noise moves it into a neighbor
_VOXEL = 0.15
# a voxel is static if this fraction of the scans occupy it in each part of the recording, so that a person who stood
# there for a while and left is not static
_SHARE, _PARTS = 0.5, 3
# number of scans that are read; more do not improve the result
_MOST_SCANS = 60
# with fewer scans, most people are part of the background
_FEW_SCANS = 5
# number of voxels on each axis
_SPAN = 1 << 20


def learn_background(
    scans: "str | os.PathLike | Sequence[str | os.PathLike | ArrayLike]",
    *,
    columns: int | None = None,
    topic: str | None = None,
    meta: str | os.PathLike | None = None,
) -> np.ndarray:
    """Learns the static points around a stationary sensor from a recording, for `background` of `detect` and `predict`.

    Damaged scans of a recording or folder are skipped with a warning.

    Args:
        scans: one or several point files or arrays (n, 3) m in temporal order, or anything that `open_source` takes.
            Of more than 60 scans, 60 evenly spaced ones are read.
        columns: number of values per row of .bin files, see `read_points`.
        topic, meta: options for recordings, see `open_source`.

    Returns:
        (n, 3) m, points in the frame of the scans, at the places where at least half of the scans in each third of the
        recording have points; for a single scan, wherever it has points.

    Raises:
        InputError: no scans, no readable scan, or an unreadable file among those listed.
    """
    sources = _sources(scans, columns, topic, meta)
    if len(sources) < _FEW_SCANS:
        few = counted(len(sources), "scan")
        warnings.warn(
            f"background: learned from {few}, so people in them become background: give ten seconds or more",
            stacklevel=2,
        )
    grid: _Grid | None = None
    problems: list[InputError] = []
    static_voxels, eighths = None, np.zeros(0, np.int64)
    for rows in np.array_split(np.arange(len(sources)), min(_PARTS, len(sources))):
        scan_voxels = []
        for row in rows:
            try:
                points = _points(sources[row], columns)
            except InputError as problem:
                # scans that were listed one by one must all be readable
                if not isinstance(sources[row], LazyFrame):
                    raise
                problems.append(problem)
                continue
            if not len(points):
                # no place for the grid, but one more scan in which no voxel is occupied
                scan_voxels.append(np.zeros(0, np.int64))
                continue
            grid = grid or _Grid(points)
            scan_eighths = grid.eighths(points)
            eighths = _ascending(np.concatenate([eighths, scan_eighths]))
            scan_voxels.append(grid.voxels(scan_eighths))
        if not scan_voxels:
            continue
        voxels, counts = np.unique(np.concatenate(scan_voxels), return_counts=True)
        frequent_voxels = voxels[counts >= _SHARE * len(scan_voxels)]
        static_voxels = (
            frequent_voxels
            if static_voxels is None
            else np.intersect1d(static_voxels, frequent_voxels, assume_unique=True)
        )
    if static_voxels is None:
        raise InputError(f"background: none of {counted(len(sources), 'scan')} can be read, the first: {problems[0]}")
    if problems:
        left_out = f"{len(problems)} of {counted(len(sources), 'scan')} left out"
        warnings.warn(f"background: {left_out}, the first: {problems[0]}", stacklevel=2)
    if grid is None:
        return np.zeros((0, 3))
    return grid.middles(eighths[np.isin(_packed(_unpacked(eighths) // 2), static_voxels)])


def read_background(
    source: Any, *, columns: int | None = None, topic: str | None = None, meta: str | os.PathLike | None = None
) -> np.ndarray:
    """Static points (n, 3) m: read from a point file or array, or learned from a recording or several scans."""
    if hasattr(source, "shape") or isinstance(source, str | os.PathLike) and is_single_scan(source):
        return _points(source, columns)
    return learn_background(source, columns=columns, topic=topic, meta=meta)


def is_static(points: np.ndarray, background: np.ndarray) -> np.ndarray:
    """points (n, 3) m, background (k, 3) m in the same frame -> (n,) bool: whether a point lies on the background."""
    grid = _Grid(background)
    voxels, point_voxels = grid.voxels(grid.eighths(background)), _packed(grid.index(points) // 2)
    if not len(voxels):
        return np.zeros(len(points), bool)
    return voxels[np.searchsorted(voxels, point_voxels).clip(0, len(voxels) - 1)] == point_voxels


class _Grid:
    """A voxel grid around the median of points (n, 3) m. Voxels, and their eighths, are identified by integers. Points
    outside the grid are assigned to its border."""

    def __init__(self, points: np.ndarray):
        middle = np.median(points, axis=0) if len(points) else np.zeros(3)
        self.corner = (np.floor(middle / _VOXEL) - _SPAN // 2) * _VOXEL

    def index(self, points: np.ndarray) -> np.ndarray:
        """points (n, 3) -> (n, 3) int64: grid indices of eighths; divided by 2 they are those of voxels."""
        return np.floor((points - self.corner) / (_VOXEL / 2)).clip(0, 2 * _SPAN - 1).astype(np.int64)

    def eighths(self, points: np.ndarray) -> np.ndarray:
        """The eighths occupied by points (n, 3), ascending."""
        return _ascending(_packed(self.index(points)))

    def voxels(self, eighths: np.ndarray) -> np.ndarray:
        """The voxels that touch any of the eighths, ascending: 2 x 2 x 2 per eighth."""
        low = (_unpacked(eighths) - 1) // 2
        neighbors = [_packed((low + np.array(offset)).clip(0, _SPAN - 1)) for offset in np.ndindex(2, 2, 2)]
        return _ascending(np.concatenate(neighbors))

    def middles(self, eighths: np.ndarray) -> np.ndarray:
        """(n, 3) m: the centers of eighths."""
        return (_unpacked(eighths) + 0.5) * (_VOXEL / 2) + self.corner


def _ascending(numbers: np.ndarray) -> np.ndarray:
    """The unique numbers in ascending order. np.unique hashes integers, which takes ten times as long."""
    numbers = np.sort(numbers)
    return numbers[np.diff(numbers, prepend=numbers[:1] - 1) > 0]


def _packed(index: np.ndarray) -> np.ndarray:
    x, y, z = index.T
    return x << 42 | y << 21 | z


def _unpacked(number: np.ndarray) -> np.ndarray:
    return np.stack([number >> 42, number >> 21 & 0x1FFFFF, number & 0x1FFFFF], -1)


def _sources(scans: Any, columns: int | None, topic: str | None, meta: str | os.PathLike | None) -> list:
    """At most `_MOST_SCANS` evenly spaced scans, each readable by `_points`."""
    # one array is one scan, not a list of rows
    is_array = getattr(scans, "ndim", None) == 2 or getattr(getattr(scans, "dtype", None), "names", None)
    sources = [scans] if is_array else listed(scans)
    if not sources:
        raise InputError("background: expected a file of static points or scans of one recording, got none")
    if not any(isinstance(source, str | os.PathLike) and not is_single_scan(source) for source in sources):
        return [sources[row] for row in evenly_spaced(len(sources), _MOST_SCANS)]
    recording = open_source(sources, columns=columns, topic=topic, meta=meta).recording
    # `ChainedRecording` turns a truncated end into a damaged frame
    recording = ChainedRecording(recording.name, [recording])
    count = sum(1 for _ in recording.lazy_frames()) if recording.count is None else recording.count
    rows = set(evenly_spaced(count, _MOST_SCANS).tolist())
    return [frame for row, frame in enumerate(recording.lazy_frames()) if row in rows]


def _points(source: Any, columns: int | None) -> np.ndarray:
    if isinstance(source, LazyFrame):
        try:
            return only_returns(source.read().points)[0]
        except FormatError as problem:
            raise file_error(source.id, problem) from None
    if isinstance(source, str | os.PathLike):
        return only_returns(read_points(source, columns=columns).points)[0]
    return only_returns(as_points(source, "background"))[0]
