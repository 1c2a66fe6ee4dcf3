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
    for own in rows.values():
        ordered = np.array(sorted(own, key=lambda row: frames[row]))
        steps = np.diff([frames[row] for row in ordered])
        runs += np.split(ordered, np.flatnonzero(steps > _GAP * np.median(steps)) + 1) if len(steps) else [ordered]
    return runs


# ---- what stands about a person


def window_points(points: np.ndarray, person: np.ndarray) -> np.ndarray:
    """(k, 3) float32 m, at most `MOST`, evenly picked: those of the points (n, 3) m that are in the window of azimuth
    and elevation about a person's points (m, 3); none for a person without points. The sensor is the origin."""
    if not len(points) or not len(person):
        return np.zeros((0, 3), np.float32)
    x, y, _ = person.mean(0)
    middle = np.arctan2(y, x)
    inside = np.ones(len(points), bool)
    for own, other in zip(_angles(person, middle), _angles(points, middle), strict=True):
        inside &= (other >= own.min() - MARGIN) & (other <= own.max() + MARGIN)
    chosen = np.flatnonzero(inside)
    if len(chosen) > MOST:
        chosen = chosen[np.arange(MOST) * len(chosen) // MOST]
    return points[chosen].astype(np.float32)


def _angles(points: np.ndarray, middle: float) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth from the direction `middle`, and elevation of points, (n,) rad."""
    _, azimuth, elevation = to_spherical(points)
    return (azimuth - middle + np.pi) % (2 * np.pi) - np.pi, elevation


def without_person(points: np.ndarray, person: np.ndarray) -> np.ndarray:
    """A scan's points (n, 3) m without a person's (m, 3), which were cut out of it and perhaps rounded."""
    return points[~np.isin(_cells(points, _OWN), _cells(person, _OWN))]


def static_points(scans: Iterable[np.ndarray]) -> np.ndarray:
    """A map (k, 3) m of what stands still in scans (n, 3) m of one frame of coordinates, moving people cut out: a point
    of every cell of 10 cm that is occupied in three scans or more."""
    cells, points = [], []
    for scan in scans:
        own, first = np.unique(_cells(scan, _CELL), return_index=True)
        cells.append(own)
        points.append(scan[first])
    if not cells:
        return np.zeros((0, 3))
    _, first, count = np.unique(np.concatenate(cells), return_index=True, return_counts=True)
    return np.concatenate(points)[first[count >= _LEAST]]


def _cells(points: np.ndarray, edge: float) -> np.ndarray:
    """(n,) int64: the number of a point's cell, the same for cells 2^21 edges apart."""
    x, y, z = (np.floor(np.asarray(points, float) / edge).astype(np.int64) & 0x1FFFFF).T
    return x << 42 | y << 21 | z
