"""The newest of several scans in one cloud, by the times of the points."""

import numpy as np

from lidarpose.inference.inputs import distinct, is_few, usable_rows

# s; most sensors measure a person anew every tenth of a second
_ONE_SCAN = 0.09
# points are of one scan if more than this share of them is newest
_NEARLY_ALL = 0.8
# s; longer clouds are maps
_LONGEST = 2.0
# number of points from which a single scan is recognized
_ENOUGH = 10_000
# width of sectors about the sensor, rad: a spinning sensor measures each of them at another time. Narrow, since in the
# sector where a turn begins, half of the points are a turn older
_SECTOR = np.radians(0.5)
# size of cells of directions in azimuth and elevation, rad, and the minimum number of points in one that counts
_CELL, _LEAST_IN_CELL = np.radians(3.0), 10
# share of the newest of a person's points that lie in directions of older ones, too: in a single scan, none does
_MEASURED_AGAIN = 0.2


def newest_scan(points: np.ndarray, point_times: np.ndarray | None, origin: np.ndarray | None) -> np.ndarray | None:
    """Which points of a whole scan are of the newest of several scans.

    In each sector about the sensor these are the points measured within `_ONE_SCAN` of the newest one there, so that a
    turn of a spinning sensor is whole wherever it begins.

    Args:
        points: (n, 3) m, z up.
        point_times: (n,) s, None if unknown.
        origin: (3,) m, the sensor position, None if unknown.

    Returns:
        (n,) bool; None for a single scan, a map, or if times or sensor are unknown.
    """
    if point_times is None or origin is None or not len(points) or _duration(point_times) > _LONGEST:
        return None
    # a part of the points is enough to recognize a single scan, and saves most of the time
    for step in (len(points) // _ENOUGH + 1, 1):
        part = points[::step]
        azimuth, elevation = _directions(part - origin, forward=np.array([1.0, 0.0]))
        is_newest = _newest_of_sectors(azimuth, point_times[::step])
        if (share := is_newest.mean()) > _NEARLY_ALL:
            return None
    row, column = (((angle + np.pi) / _CELL).astype(np.int64) for angle in (elevation, azimuth))
    cell = row * (column.max() + 1) + column
    is_filled = np.bincount(cell) >= _LEAST_IN_CELL
    is_covered = np.bincount(cell, is_newest) > 0
    # the newest of several scans has points in nearly all directions (two thirds from a fast car), the newest part of a
    # slow one in about as many as its share of the points
    is_whole = is_filled.any() and is_covered[is_filled].mean() > (1 + share) / 2
    return is_newest if is_whole else None


def _newest_of_sectors(azimuth: np.ndarray, point_times: np.ndarray) -> np.ndarray:
    """Which points were measured within `_ONE_SCAN` of the newest one in their sector, (n,) bool; azimuth (n,) rad."""
    sector = ((azimuth + np.pi) / _SECTOR).astype(np.int64)
    newest_time = np.full(sector.max() + 1, -np.inf, np.float32)
    np.maximum.at(newest_time, sector, point_times)
    return point_times > newest_time[sector] - _ONE_SCAN


def newest_points(points: np.ndarray, point_times: np.ndarray | None, origin: np.ndarray | None) -> np.ndarray | None:
    """Those of the points of one person that were measured within `_ONE_SCAN` of the newest. Duplicates and rows that
    are no returns are left out.

    Args: as in `newest_scan`.

    Returns:
        (m, 3) m; None for a single scan, for too few points for a pose, or if times or sensor are unknown.
    """
    if point_times is None or origin is None:
        return None
    rows, _ = usable_rows(points)
    if rows is not None:
        points, point_times = points[rows], point_times[rows]
    if not len(points) or _duration(point_times) > _LONGEST:
        return None
    is_newest = point_times > point_times.max() - _ONE_SCAN
    if is_newest.all():
        return None
    # of a single scan that begins at the person, or is slow, the newest points are beside the older ones
    offset = points - origin
    for angle in _directions(offset, forward=offset.mean(0)):
        older, newest = angle[~is_newest], angle[is_newest]
        if ((newest > older.min()) & (newest < older.max())).mean() < _MEASURED_AGAIN:
            return None
    return newest_of_person(points, is_newest)


def newest_of_person(points: np.ndarray, is_newest: np.ndarray) -> np.ndarray | None:
    """The newest of a person's points (n, 3) m; None if these are nearly all, or too few for a pose."""
    if not len(points) or is_newest.mean() > _NEARLY_ALL or is_few(points[is_newest]):
        return None
    return distinct(points[is_newest])


def _duration(point_times: np.ndarray) -> float:
    """Seconds between the first and the last point that has a time, but for one in a thousand each."""
    times = point_times[np.isfinite(point_times)]
    first, last = np.quantile(times, (0.001, 0.999)) if len(times) else (0.0, np.inf)
    return float(last - first)


def _directions(offset: np.ndarray, forward: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth from `forward` (2+,) and elevation, both (n,) rad, of offsets (n, 3) m from the sensor."""
    x, y, z = offset.T
    azimuth = np.arctan2(forward[0] * y - forward[1] * x, forward[0] * x + forward[1] * y)
    return azimuth, np.arctan2(z, np.hypot(x, y))
