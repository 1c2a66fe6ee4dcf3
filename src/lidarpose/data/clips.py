"""Clips: consecutive frames of a person, and the surroundings of the person, for networks that read both.

Legend: n points of a cloud, N samples.
"""

from collections import defaultdict
from collections.abc import Hashable, Iterable, Sequence

import numpy as np

from lidarpose.geometry import to_spherical

# margin of the angular window about a person, rad, and maximum number of its points that are kept. Source: NE
MARGIN, MOST = np.radians(1.0), 512
# a step between frames that exceeds the smallest step by more than this factor ends a run
GAP = 1.5
# cell size of a map, m; a cell is static if it is occupied in at least this many scans; number of scans used
_CELL, _LEAST, SCANS = 0.1, 3, 24
# cell size for finding a person's points in a scan, m
_OWN = 0.05


# ---- consecutive frames


def consecutive(tracks: Sequence[Hashable], frames: Sequence[int]) -> list[np.ndarray]:
    """Runs of samples of one track with consecutive frames, as rows (n,) in order of time.

    tracks, frames (N,): each sample's track and frame number; the usual step is the smallest one of a track; a gap ends
    a run.
    """
    rows = defaultdict(list)
    for row, track in enumerate(tracks):
        rows[track].append(row)
    runs = []
    for track_rows in rows.values():
        ordered_rows = np.array(sorted(track_rows, key=lambda row: frames[row]))
        steps = np.diff(np.array([frames[row] for row in ordered_rows], float))
        usual_step = steps[steps > 0].min(initial=np.inf)
        runs += np.split(ordered_rows, np.flatnonzero(steps > GAP * usual_step) + 1)
    return runs


# ---- surroundings of a person


def window_points(points: np.ndarray, person: np.ndarray) -> np.ndarray:
    """(k, 3) float32 m: those of the points (n, 3) m that are in the window of azimuth and elevation about a person's
    points (m, 3); at most `MOST`, evenly picked; none for a person without points. The sensor is the origin."""
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
    """Azimuth relative to `center_azimuth`, and elevation of points, (n,) rad."""
    _, azimuth, elevation = to_spherical(points)
    return (azimuth - center_azimuth + np.pi) % (2 * np.pi) - np.pi, elevation


def without_person(points: np.ndarray, person: np.ndarray) -> np.ndarray:
    """A scan's points (n, 3) m without a person's points (m, 3), which were cropped from it and may be rounded."""
    return points[~np.isin(_cells(points, _OWN), _cells(person, _OWN))]


def static_points(scans: Iterable[np.ndarray]) -> np.ndarray:
    """A map (k, 3) m of the static points in scans (n, 3) m, which share one frame and have moving people removed: one
    point of every 10 cm cell that is occupied in at least three scans."""
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
    """(n,) int64: the number of each point's cell; cells 2^21 edges apart share a number."""
    x, y, z = (np.floor(np.asarray(points, float) / edge).astype(np.int64) & 0x1FFFFF).T
    return x << 42 | y << 21 | z
