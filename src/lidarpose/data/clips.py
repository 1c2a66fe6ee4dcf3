"""Clips: frames of a person that follow each other, and what stands about the person, for networks that read both.

Legend: n points of a cloud, N samples.
"""

from collections import defaultdict
from collections.abc import Hashable, Iterable, Sequence

import numpy as np

from lidarpose.geometry import to_spherical

# how far the window about a person reaches beyond the person, rad, and how many of its points are kept. Source: NE
MARGIN, MOST = np.radians(1.0), 512
# a step between frames of more than this many usual ones ends a run
_GAP = 1.5
# edge of a map's cells, m; which are static where they are occupied in so many of so many scans
_CELL, _LEAST, SCANS = 0.1, 3, 24
# points this close to a person's belong to them, m
_OWN = 0.05


# ---- frames that follow each other


def consecutive(tracks: Sequence[Hashable], frames: Sequence[int]) -> list[np.ndarray]:
    """Runs of samples of one track whose frames follow each other, as rows (n,) in order of time.

    tracks, frames (N,): whose sample it is, and its number, whatever the step; a gap ends a run.
    """
    rows = defaultdict(list)
    for row, track in enumerate(tracks):
        rows[track].append(row)
    runs = []
    for track_rows in rows.values():
        ordered_rows = np.array(sorted(track_rows, key=lambda row: frames[row]))
        steps = np.diff([frames[row] for row in ordered_rows])
        runs += (
            np.split(ordered_rows, np.flatnonzero(steps > _GAP * np.median(steps)) + 1)
            if len(steps)
            else [ordered_rows]
        )
    return runs


# ---- what stands about a person


def window_points(points: np.ndarray, person: np.ndarray) -> np.ndarray:
    """(k, 3) float32 m, at most `MOST`, evenly picked: those of the points (n, 3) m that are in the window of azimuth
    and elevation about a person's points (m, 3); none for a person without points. The sensor is the origin."""
    if not len(points) or not len(person):
        return np.zeros((0, 3), np.float32)
    x, y, _ = person.mean(0)
    center_azimuth = np.arctan2(y, x)
    is_inside = np.ones(len(points), bool)
    for person_angles, point_angles in zip(
        _angles(person, center_azimuth), _angles(points, center_azimuth), strict=True
    ):
        is_inside &= (point_angles >= person_angles.min() - MARGIN) & (point_angles <= person_angles.max() + MARGIN)
    indices = np.flatnonzero(is_inside)
    if len(indices) > MOST:
        indices = indices[np.arange(MOST) * len(indices) // MOST]
    return points[indices].astype(np.float32)


def _angles(points: np.ndarray, center_azimuth: float) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth from the direction `center_azimuth`, and elevation of points, (n,) rad."""
    _, azimuth, elevation = to_spherical(points)
    return (azimuth - center_azimuth + np.pi) % (2 * np.pi) - np.pi, elevation


def without_person(points: np.ndarray, person: np.ndarray) -> np.ndarray:
    """A scan's points (n, 3) m without a person's (m, 3), which were cut out of it and perhaps rounded."""
    return points[~np.isin(_cells(points, _OWN), _cells(person, _OWN))]


def static_points(scans: Iterable[np.ndarray]) -> np.ndarray:
    """A map (k, 3) m of what stands still in scans (n, 3) m of one frame of coordinates, moving people cut out: a point
    of every cell of 10 cm that is occupied in three scans or more."""
    cells, points = [], []
    for scan in scans:
        scan_cells, first_rows = np.unique(_cells(scan, _CELL), return_index=True)
        cells.append(scan_cells)
        points.append(scan[first_rows])
    if not cells:
        return np.zeros((0, 3))
    _, first_rows, count = np.unique(np.concatenate(cells), return_index=True, return_counts=True)
    return np.concatenate(points)[first_rows[count >= _LEAST]]


def _cells(points: np.ndarray, edge: float) -> np.ndarray:
    """(n,) int64: the number of a point's cell, the same for cells 2^21 edges apart."""
    x, y, z = (np.floor(np.asarray(points, float) / edge).astype(np.int64) & 0x1FFFFF).T
    return x << 42 | y << 21 | z
