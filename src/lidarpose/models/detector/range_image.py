"""A range image of a scan: nearest and farthest return and their number by direction, from which views are cut."""

from math import pi

import numpy as np

# a view: rows and columns (the network's slices and cells), size of a cell, m, and bottom of the lowest row, m
SLICES, SIDE, CELL, BOTTOM = 28, 24, 0.1, -0.5
# channels of a view, and the range beyond the candidate at which its encoding saturates, m
RANGE_CHANNELS, _FAR = 4, 4.0
# rows of the range image's finest level, from straight down to straight up; size of its cells, rad; number of coarser
# levels, each with cells of twice the size
_ROWS = 1024
_ANGLE, _LEVELS = pi / _ROWS, 5


def log_bytes(count: np.ndarray) -> np.ndarray:
    """.125 log2(1 + count) as bytes, 255 for values of 1 and more."""
    return np.minimum(np.log2(1.0 + count) * (0.125 * 255), 255).astype(np.uint8)


_COUNT_BYTES = log_bytes(np.arange(256))


class RangeImage:
    """Nearest and farthest range and number of returns by direction, in levels of increasingly coarse cells."""

    def __init__(self, points: np.ndarray, origin: np.ndarray):
        """points (n, 3) m, origin (3,) m: sensor position."""
        x, y, z = ((points[:, i] - origin[i]).astype(np.float32) for i in range(3))
        distance = np.sqrt(x * x + y * y)
        column = ((np.arctan2(y, x) + np.float32(pi)) * np.float32(1 / _ANGLE)).astype(np.int32)
        row = (np.arctan2(z, distance) * np.float32(1 / _ANGLE) + np.float32(_ROWS // 2)).astype(np.int32)
        # empty rows at the top and bottom are cut off, in whole cells of the coarsest level
        coarsest = 2**_LEVELS
        self._first = int(row.min(initial=_ROWS)) // coarsest * coarsest
        self._rows = max(int(row.max(initial=0)) // coarsest * coarsest + coarsest - self._first, coarsest)
        self._columns = 2 * _ROWS
        cells = (row - self._first) * self._columns + np.minimum(column, self._columns - 1)
        # the levels, one after the other, then one cell without returns
        sizes = [self._rows * self._columns >> 2 * number for number in range(_LEVELS + 1)]
        self._starts = np.cumsum([0, *sizes], dtype=np.int32)
        size = self._starts[-1] + 1
        self._near, self._far = np.full(size, np.inf, np.float32), np.zeros(size, np.float32)
        count = np.zeros(size, np.int32)
        np.minimum.at(self._near, cells, distance)
        np.maximum.at(self._far, cells, distance)
        np.add.at(count, cells, np.int32(1))
        for image, reduce in ((self._near, np.minimum), (self._far, np.maximum), (count, np.add)):
            levels = np.split(image, self._starts[1:])
            for number, (fine, coarse) in enumerate(zip(levels[:-2], levels[1:-1], strict=True)):
                rows = fine.reshape(-1, 2, self._columns >> number)
                rows = reduce(rows[:, 0], rows[:, 1])
                reduce(rows[:, ::2], rows[:, 1::2], out=coarse.reshape(len(rows), -1))
        # counts saturate at 255
        self._count = np.minimum(count, 255).astype(np.uint8)

    def views(self, centers: np.ndarray, yaw: np.ndarray, distance: np.ndarray, margin: int) -> np.ndarray:
        """Views (K, 4, 28 + 2 margin, 24 + 2 margin) uint8 of centers (K, 3) m from the sensor; see `Candidates`."""
        rows, columns = SLICES + 2 * margin, SIDE + 2 * margin
        height = (np.arange(rows) - margin + 0.5) * CELL + BOTTOM
        lateral = (np.arange(columns) - margin + 0.5) * CELL - SIDE * CELL / 2
        azimuth = (yaw[:, None] + np.arctan2(lateral, distance[:, None]) + pi) % (2 * pi)
        column = np.minimum((azimuth / _ANGLE).astype(np.int32), self._columns - 1)[:, None]
        slant = np.sqrt(lateral**2 + distance[:, None] ** 2).astype(np.float32)[:, None]
        tangent = (centers[:, 2:] + height).astype(np.float32)[:, :, None] / slant
        row = (np.arctan(tangent) * np.float32(1 / _ANGLE) + np.float32(_ROWS // 2)).astype(np.int32) - self._first
        # the level whose cells are closest in size to the view's
        level = np.floor(np.log2(CELL / distance / _ANGLE) + 0.5)
        level = np.clip(level, 0, _LEVELS - 1).astype(np.int32)[:, None, None]
        cells = self._at(level, row, column)
        count = self._count[cells]
        views = np.empty((len(centers), RANGE_CHANNELS, rows, columns), np.uint8)
        views[:, 0] = _range_bytes(self._near[cells] - slant)
        views[:, 1] = _range_bytes(self._far[cells] - slant)
        views[:, 2] = _COUNT_BYTES[count]
        views[:, 3] = _COUNT_BYTES[self._count[self._at(level + 1, row, column)]]
        views[:, :2] *= count[:, None] > 0
        return views

    def _at(self, level: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Flat cells of levels (K, 1, 1) at rows (K, H, 1 or W) and columns (K, 1, W) of the finest level."""
        cells = self._starts[level] + (row >> level) * (self._columns >> level) + (column >> level)
        cells[(row < 0) | (row >= self._rows)] = self._starts[-1]
        return cells


def _range_bytes(meters: np.ndarray) -> np.ndarray:
    """-4 to 4 m as 1 to 255; 0 is left for cells without returns."""
    return np.clip(meters * (127 / _FAR) + 128, 1, 255).astype(np.uint8)
