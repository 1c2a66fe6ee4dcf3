"""Cropping and centering compiled: numpy's calls on a few hundred points cost more than the work. Twins:
`Box.contains` and `sample.center_of`."""

import numpy as np

from lidarpose.errors import MissingExtra
from lidarpose.sample import CENTER_CELL, Box, center_of

try:
    from numba import njit
except ImportError as error:  # pragma: no cover - numba is an optional extra
    raise MissingExtra("synthesis", "synth") from error

# cells farther from the first than this many along an axis are left to the twin: one number a cell could overflow
_FAR = 1 << 20


def crop_points(
    points: np.ndarray, ring: np.ndarray, part: np.ndarray, box: Box
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Those of points (n, 3) float32 m, with their ring (n,) and part (n,), that `box.contains`."""
    return _crop(points, ring, part, box.center, box.size, np.cos(box.yaw), np.sin(box.yaw))


def center_of_cells(points: np.ndarray) -> np.ndarray:
    """`sample.center_of` of points (n, 3) float32 m, n >= 1."""
    center, near = _center(points)
    return center if near else center_of(points)


@njit(nogil=True, cache=True)
def _crop(points, ring, part, center, size, c, s):
    n = 0
    inside = np.empty(len(points), np.bool_)
    for i in range(len(points)):
        x, y, z = points[i, 0] - center[0], points[i, 1] - center[1], points[i, 2] - center[2]
        inside[i] = abs(c * x + s * y) <= size[0] / 2 and abs(c * y - s * x) <= size[1] / 2 and abs(z) <= size[2] / 2
        n += inside[i]
    kept, of_ring, of_part = np.empty((n, 3), points.dtype), np.empty(n, ring.dtype), np.empty(n, part.dtype)
    n = 0
    for i in range(len(points)):
        if inside[i]:
            kept[n, 0], kept[n, 1], kept[n, 2] = points[i, 0], points[i, 1], points[i, 2]
            of_ring[n], of_part[n] = ring[i], part[i]
            n += 1
    return kept, of_ring, of_part


@njit(nogil=True, cache=True)
def _center(points):
    """The center, and whether all cells are near enough to each other to be numbered."""
    count = len(points)
    cell = np.empty((count, 3), np.int64)
    low = np.empty(3, np.int64)
    high = np.empty(3, np.int64)
    center = np.empty(3)
    for a in range(3):
        for i in range(count):
            cell[i, a] = np.int64(np.floor(np.float64(points[i, a]) / CENTER_CELL))
            low[a] = min(low[a], cell[i, a]) if i else cell[i, a]
            high[a] = max(high[a], cell[i, a]) if i else cell[i, a]
        if high[a] - low[a] >= _FAR:
            return center, False
    number = np.empty(count, np.int64)
    for i in range(count):
        number[i] = ((cell[i, 0] - low[0]) << 40) | ((cell[i, 1] - low[1]) << 20) | (cell[i, 2] - low[2])
    number.sort()
    n = 0
    for i in range(count):
        if i == 0 or number[i] != number[n - 1]:
            number[n] = number[i]
            n += 1
    along = np.empty(n, np.int64)
    for a in range(3):
        for i in range(n):
            along[i] = (number[i] >> (40 - 20 * a)) & (_FAR - 1)
        if a:
            along.sort()
        center[a] = ((along[(n - 1) // 2] + along[n // 2]) / 2 + low[a] + 0.5) * CENTER_CELL
    return center, True
