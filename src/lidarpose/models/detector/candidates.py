"""Candidates: positions where a person may stand, their points, the sensor's view past them, and the surroundings.

`render` makes the network's inputs from them and describes these.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lidarpose.models.detector.ground import Ground
from lidarpose.models.detector.proposals import heights_above
from lidarpose.models.detector.range_image import BOTTOM, CELL, RANGE_CHANNELS, SIDE, SLICES, RangeImage, log_bytes

# margin on each side of a stored range view, in cells, so that the view can be shifted and scaled
MARGIN = 3
# context: channels, cells per side, size of a cell, m, and height that is encoded as 1, m
CONTEXT_CHANNELS, CONTEXT_SIDE, CONTEXT_CELL, _TALL = 4, 20, 0.5, 4.0
# points of a candidate: maximum distance, and margin above and below the slices, m
RADIUS, _ROOM = 1.75, 0.2
# heights above the ground between which points are used, m
_USED = (-1.2, 3.2)
# maximum number of points per candidate that are stored for training, and that are processed at once; unit of their
# coordinates, m
_MOST_STORED, _MOST_POINTS, UNIT = 1000, 20_000, 5e-4
# size of the cells by which points are sorted, m, and maximum number of cells in the table
_INDEX_CELL, _MOST_INDEX_CELLS = 0.5, 4_000_000
# maximum number of points kept per cell, and of points processed at once
_MOST_IN_CELL, _MOST_AT_ONCE = 10_000, 4_000_000
# candidates that are rendered at a time
CHUNK = 64
_LEAST_DISTANCE = 0.5
# heights above the ground: band whose filled slices are counted, m; number of slices; limit of "near the ground", m
_BAND, _BAND_SLICES, _NEAR_GROUND = (0.3, 2.1), 6, 0.2
# number of ones in each byte; numpy can count them from 2.0 on
_BIT_COUNTS = np.array([byte.bit_count() for byte in range(256)], np.uint8)


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidates:
    """K positions where a person may stand, ready to be rendered: small, so that many can be stored.

    centers (K, 3) m, level frame: x, y, and z of the ground; yaw (K,) rad of the view frames' x axes; distance (K,) m
    from the sensor; sensor_height (K,) m of the sensor above the ground at the candidate, both 0 if unknown; count
    (K,): points within `RADIUS` at the heights of a person, of which xyz (3, n) int16 holds up to 1,000 per candidate
    if they are stored, else 20,000, in the view frame, in units of 0.5 mm, concatenated, `sizes` (K,) of each;
    range_views (K, 4, 34, 30) and contexts (K, 4, 20, 20) uint8: as rendered, before augmentation.
    """

    centers: np.ndarray
    yaw: np.ndarray
    distance: np.ndarray
    sensor_height: np.ndarray
    count: np.ndarray
    sizes: np.ndarray
    xyz: np.ndarray
    range_views: np.ndarray
    contexts: np.ndarray

    def __len__(self) -> int:
        return len(self.centers)

    def take(self, rows: np.ndarray) -> "Candidates":
        """The candidates of the given rows."""
        ends = np.cumsum(self.sizes)
        columns = [np.zeros(0, int), *(np.arange(ends[k] - self.sizes[k], ends[k]) for k in rows)]
        arrays = {name: values[rows] for name, values in vars(self).items() if name != "xyz"}
        return Candidates(**arrays, xyz=self.xyz[:, np.concatenate(columns)])


class SceneIndex:
    """A scan, prepared once, from which candidates are cut.

    Args:
        points: (n, 3) m, z up.
        ground: under the points.
        origin: (3,) m, sensor position, or None if unknown.
        heights: (n,) m of the points above the ground, if already computed.
    """

    def __init__(
        self, points: np.ndarray, ground: Ground, origin: np.ndarray | None, *, heights: np.ndarray | None = None
    ):
        points = np.asarray(points)
        if heights is None:
            heights = heights_above(points, ground)
        self.ground, self.origin = ground, None if origin is None else np.asarray(origin, float)
        columns = points.T
        bounds = np.floor([[values.min(), values.max()] for values in columns[:2]]) if len(points) else np.zeros((2, 2))
        self._corner = bounds[:, 0]
        extent = bounds[:, 1] - bounds[:, 0] + 1
        # a wide map has larger cells instead of a larger table
        self._cell = max(_INDEX_CELL, float(np.sqrt(extent.prod() / _MOST_INDEX_CELLS)))
        self._shape = tuple(int(n) for n in extent // self._cell + 2)
        # relative to the corner, float32 resolves millimeters even in the widest map
        x, y = ((columns[i] - self._corner[i]).astype(np.float32) for i in (0, 1))
        row, column = ((values * np.float32(1 / self._cell)).astype(np.int32) for values in (x, y))
        all_cells = row * self._shape[1] + column
        self._maps = _draw_maps(all_cells, heights, self._shape)
        # points high above any person are used for the context alone
        used_rows = np.flatnonzero((heights > _USED[0]) & (heights < _USED[1]))
        z = columns[2].astype(np.float32)
        # in pseudo-random order: subsampling in the file's order, beam by beam, would drop whole beams
        used_rows = used_rows[_order(_scrambled(x[used_rows], y[used_rows], z[used_rows]))]
        cells = all_cells[used_rows]
        # very dense cells are subsampled, which limits the cost of each candidate
        selection, count = _thinned(np.bincount(cells, minlength=self._shape[0] * self._shape[1]), _MOST_IN_CELL)
        sorted_rows = used_rows[_order(cells)][selection]
        self._x, self._y, self._z = x[sorted_rows], y[sorted_rows], z[sorted_rows]
        self._start = np.concatenate([[0], np.cumsum(count)])
        self._image = None if self.origin is None else RangeImage(points, self.origin)

    def candidates(self, centers: np.ndarray) -> Candidates:
        """Candidates at centers (K, 3) m: x, y, and z of the ground there."""
        parts = list(self.pieces(centers, MARGIN)) or [self._cut(np.zeros((0, 3)), MARGIN)]
        columns = {name: [vars(part)[name] for part in parts] for name in vars(parts[0])}
        return Candidates(**{name: np.concatenate(arrays, axis=int(name == "xyz")) for name, arrays in columns.items()})

    def pieces(self, centers: np.ndarray, margin: int = 0) -> Iterator[Candidates]:
        """Candidates at centers (K, 3) m, in pieces of at most `CHUNK` with a limited number of points to process.

        Their range views have a margin of the given number of cells.
        """
        centers = np.asarray(centers, float)
        for start in range(0, len(centers), CHUNK):
            piece = centers[start : start + CHUNK]
            point_count = self._runs(piece[:, :2] - self._corner)[2].sum()
            for part in np.array_split(piece, min(len(piece), 1 + 2 * point_count // _MOST_AT_ONCE)):
                yield self._cut(part, margin)

    def yaws(self, centers: np.ndarray) -> np.ndarray:
        """(K,) rad: yaw of the view frames' x axes at centers (K, 2 or 3) m."""
        if self.origin is None:
            return np.zeros(len(centers))
        return np.arctan2(centers[:, 1] - self.origin[1], centers[:, 0] - self.origin[0])

    def _cut(self, centers: np.ndarray, margin: int) -> Candidates:
        yaw, distance, sensor_height = self.yaws(centers), np.zeros(len(centers)), np.zeros(len(centers))
        range_views = np.zeros((len(centers), RANGE_CHANNELS, SLICES + 2 * margin, SIDE + 2 * margin), np.uint8)
        if self._image is not None and self.origin is not None:
            offset = centers - self.origin
            distance, sensor_height = np.maximum(np.hypot(offset[:, 0], offset[:, 1]), _LEAST_DISTANCE), -offset[:, 2]
            range_views = self._image.views(offset, yaw, distance, margin)
        x, y, z, count = self._near(centers)
        # candidates with a margin are those that are stored
        selection, sizes = _thinned(count, _MOST_STORED if margin else _MOST_POINTS)
        x, y, z = x[selection], y[selection], z[selection]
        c, s = (np.repeat(values.astype(np.float32), sizes) for values in (np.cos(yaw), np.sin(yaw)))
        xyz = np.stack([x * c + y * s, y * c - x * s, z])
        xyz *= np.float32(1 / UNIT)
        return Candidates(
            centers=centers,
            yaw=yaw,
            distance=distance,
            sensor_height=sensor_height,
            count=count,
            sizes=sizes,
            xyz=np.rint(xyz, out=xyz).astype(np.int16),
            range_views=range_views,
            contexts=self._context(centers, yaw),
        )

    def _near(self, centers: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Points within `RADIUS` of centers (K, 3) m and at the heights of the slices, grouped by center.

        Returns their positions relative to the center, x, y, z (m,) float32 m, and the number per center (K,).
        """
        owner, start, size = self._runs(centers[:, :2] - self._corner)
        row = np.arange(size.sum()) + np.repeat(start - (np.cumsum(size) - size), size)
        sizes = np.bincount(owner, size, minlength=len(centers)).astype(np.int64)
        center_x, center_y, center_z = (centers - [*self._corner, 0.0]).astype(np.float32).T
        x, y = self._x[row] - np.repeat(center_x, sizes), self._y[row] - np.repeat(center_y, sizes)
        inside_index = np.flatnonzero(x * x + y * y < np.float32(RADIUS**2))
        z = self._z[row[inside_index]] - np.repeat(center_z, sizes)[inside_index]
        is_between = (z > BOTTOM - _ROOM) & (z < BOTTOM + SLICES * CELL + _ROOM)
        inside_index, z = inside_index[is_between], z[is_between]
        count = np.diff(np.searchsorted(inside_index, np.cumsum(sizes)), prepend=0)
        return x[inside_index], y[inside_index], z, count

    def _runs(self, place: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Runs of sorted rows in the cells around positions (K, 2) m from the corner: owner, first row, length."""
        low = np.floor((place - RADIUS) / self._cell).astype(np.int64)
        high = np.floor((place + RADIUS) / self._cell).astype(np.int64)
        low, high = np.maximum(low, 0), np.minimum(high, np.array(self._shape) - 1)
        # one run for each row of the square of cells, since its points are consecutive
        row_counts = np.maximum(high[:, 0] - low[:, 0] + 1, 0)
        row_counts[(high < low).any(1)] = 0
        owner = np.repeat(np.arange(len(place)), row_counts)
        row = np.arange(len(owner)) - np.repeat(np.cumsum(row_counts) - row_counts, row_counts)
        base = (low[owner, 0] + row) * self._shape[1]
        start, end = self._start[base + low[owner, 1]], self._start[base + high[owner, 1] + 1]
        return owner, start, end - start

    def _context(self, centers: np.ndarray, yaw: np.ndarray) -> np.ndarray:
        """Contexts (K, 4, 20, 20) uint8, from the nearest cells of the maps."""
        side = (np.arange(CONTEXT_SIDE) - (CONTEXT_SIDE - 1) / 2) * CONTEXT_CELL
        x, y = np.repeat(side, CONTEXT_SIDE), np.tile(side, CONTEXT_SIDE)
        c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
        place = centers[:, :2] - self._corner
        i = np.floor((place[:, :1] + c * x - s * y) / self._cell).astype(np.int64)
        j = np.floor((place[:, 1:] + s * x + c * y) / self._cell).astype(np.int64)
        is_inside = (i >= 0) & (j >= 0) & (i < self._shape[0]) & (j < self._shape[1])
        # positions outside read the cell after the last, which is empty
        cells = self._maps[np.where(is_inside, i * self._shape[1] + j, len(self._maps) - 1)]
        values = np.moveaxis(cells.view(np.uint8).reshape(*is_inside.shape, CONTEXT_CHANNELS), -1, 1)
        return np.ascontiguousarray(values).reshape(-1, CONTEXT_CHANNELS, CONTEXT_SIDE, CONTEXT_SIDE)


def _thinned(count: np.ndarray, limit: int) -> tuple[slice | np.ndarray, np.ndarray]:
    """Subsamples consecutive groups of `count` (K,) rows to `limit` each: remaining rows, and their number per group.

    Of a group with too many rows, rows at regular intervals remain.
    """
    if count.max(initial=0) <= limit:
        return slice(None), count
    rank = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    share = np.repeat(np.minimum(1.0, limit / np.maximum(count, 1)), count)
    is_kept = np.floor((rank + 1) * share) > np.floor(rank * share)
    ends = np.concatenate([[0], np.cumsum(is_kept)])[np.cumsum(count)]
    return np.flatnonzero(is_kept), np.diff(ends, prepend=0)


def _scrambled(*columns: np.ndarray) -> np.ndarray:
    """(n,) uint32 pseudo-random numbers that depend only on the values of each row of columns (n,) float32."""
    factors = (0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D)
    hashes = sum(values.view(np.uint32) * np.uint32(factor) for values, factor in zip(columns, factors, strict=True))
    return np.asarray(hashes)


def _order(cells: np.ndarray) -> np.ndarray:
    """Rows that sort integers (n,) below 2**32, such as flat cells, stably: by 16 bits at a time, in linear time."""
    order = np.argsort((cells & 0xFFFF).astype(np.uint16), kind="stable")
    if len(cells) and cells.max() > 0xFFFF:
        order = order[np.argsort((cells >> 16)[order].astype(np.uint16), kind="stable")]
    return order


def _draw_maps(cells: np.ndarray, heights: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The context's channels of points in flat cells (n,), heights (n,) m: four bytes (cells + 1,) each, the last 0."""
    size = shape[0] * shape[1]
    highest, count, near_count = np.zeros((3, size + 1), np.float32)
    slice_bits = np.zeros(size + 1, np.uint8)
    np.maximum.at(highest, cells, heights)
    np.add.at(count, cells, np.float32(1))
    np.add.at(near_count, cells[np.abs(heights) < _NEAR_GROUND], np.float32(1))
    band = np.flatnonzero((heights > _BAND[0]) & (heights < _BAND[1]))
    level = ((heights[band] - _BAND[0]) * (_BAND_SLICES / (_BAND[1] - _BAND[0]))).astype(np.uint8)
    np.bitwise_or.at(slice_bits, cells[band], np.left_shift(np.uint8(1), np.minimum(level, _BAND_SLICES - 1)))
    maps = np.empty((size + 1, CONTEXT_CHANNELS), np.uint8)
    maps[:, 0] = np.minimum(highest * (255 / _TALL), 255)
    maps[:, 1] = _BIT_COUNTS[slice_bits] * (255 / _BAND_SLICES)
    maps[:, 2], maps[:, 3] = log_bytes(count), log_bytes(near_count)
    return maps.view(np.uint32).ravel()


def suppress_near(centers: np.ndarray, strength: np.ndarray, radius: float) -> np.ndarray:
    """Indices of the candidates that remain, strongest first: of two nearer than `radius`, the weaker is suppressed.

    centers: (K, 2 or 3) m, of which x and y are used; strength (K,); radius m.
    """
    order = np.argsort(-np.asarray(strength), kind="stable")
    x, y = np.asarray(centers, float)[order, :2].T
    # pairs of candidates that are near in x, each with those that follow it
    by_x, rows = np.argsort(x), np.arange(len(order))
    counts = np.maximum(np.searchsorted(x[by_x], x[by_x] + 1.001 * radius) - rows - 1, 0)
    first = np.repeat(rows, counts)
    second = first + 1 + np.arange(len(first)) - np.repeat(np.cumsum(counts) - counts, counts)
    pairs = np.sort([by_x[first], by_x[second]], axis=0)
    pairs = pairs[:, np.diff(x[pairs], axis=0)[0] ** 2 + np.diff(y[pairs], axis=0)[0] ** 2 < radius**2]
    is_kept = np.ones(len(order), bool)
    # sorted by the stronger candidate, so that it is known whether that one remains
    for stronger, weaker in pairs[:, np.lexsort(pairs[::-1])].T.tolist():
        if is_kept[stronger]:
            is_kept[weaker] = False
    return order[is_kept]
