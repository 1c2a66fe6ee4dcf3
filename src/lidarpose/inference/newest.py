"""The newest of several scans in one cloud, by the times of the points."""

import numpy as np

from lidarpose.inference.inputs import distinct, is_few, usable_rows

# s; most sensors measure a person anew every tenth of a second
_ONE_SCAN = 0.09
# points are of one scan if more than this share of them is within that time
_NEARLY_ALL = 0.8
# edge of the cells that show where a scan has points, m, the minimum number of points in one, and the share of these
# cells in which the newest of several whole scans has points, too: of a slow scan, the newest points are a sector
_CELL, _LEAST_IN_CELL, _COVERED = 2.0, 10, 0.8


def newest_points(points: np.ndarray, point_times: np.ndarray | None) -> np.ndarray | None:
    """Those of a person's points (n, 3) m that were measured within `_ONE_SCAN` of the newest; None if these are nearly
    all, or too few for a pose, or if the times (n,) s are unknown. Duplicates and rows that are no returns are left
    out."""
    if point_times is None:
        return None
    rows, _ = usable_rows(points)
    if rows is not None:
        points, point_times = points[rows], point_times[rows]
    is_newest = _newest(point_times)
    if is_newest is None or is_few(points[is_newest]):
        return None
    return distinct(points[is_newest])


def newest_scan(points: np.ndarray, point_times: np.ndarray | None) -> np.ndarray | None:
    """Which of points (n, 3) m are of the newest of several whole scans, (n,) bool; None if they are of one scan, of a
    map, or have no times (n,) s."""
    is_newest = None if point_times is None else _newest(point_times)
    if is_newest is None:
        return None
    cells = np.floor(points / _CELL).astype(np.int64)
    _, cell_of_point, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    is_covered = np.zeros(len(counts), bool)
    is_covered[cell_of_point[is_newest]] = True
    is_filled = counts >= _LEAST_IN_CELL
    return is_newest if is_filled.any() and is_covered[is_filled].mean() >= _COVERED else None


def _newest(point_times: np.ndarray) -> np.ndarray | None:
    """Which points were measured within `_ONE_SCAN` of the newest, (n,) bool; None if these are nearly all."""
    is_newest = point_times > point_times.max(initial=-np.inf) - _ONE_SCAN
    return None if np.count_nonzero(is_newest) > _NEARLY_ALL * len(point_times) else is_newest
