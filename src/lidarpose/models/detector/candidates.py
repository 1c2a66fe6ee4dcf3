"""What the detector's network sees of a candidate: the points there, what the sensor sees past it, and what is around.

The view frame of a candidate: x away from the sensor, level, y left, z up from the ground at the candidate's center;
of an unknown sensor, x and y are the level frame's. Inputs, K candidates first:

    fine (K, 28, 24, 24): slices of 10 cm from -0.5 to 2.3 m, cells of 10 cm: .5 + .125 log2(1 + points), 0 if empty
    range_view (K, 4, 28, 24): directions, as a picture of 2.4 x 2.8 m at the candidate's distance, rows from below,
        columns from the right to the left: nearest and farthest return beyond the candidate (m / 4, to +-1), how many
        returns there are, and how many around, .125 log2(1 + returns)
    context (K, 4, 20, 20): 10 x 10 m from above, x first: highest point above the ground (m / 4, to 1), share of the
        heights 0.3-2.1 m that hold points, .125 log2(1 + points), the same of points near the ground
    scalars (K, 4): log of the distance, height of the sensor above the ground there (m / 4), log of the number of
        points, 1 where the sensor is known; without a sensor, range_view and the first two are 0
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import pi

import numpy as np

from lidarpose.models.detector.ground import Ground
from lidarpose.models.detector.proposals import heights_above
from lidarpose.models.detector.range_image import BOTTOM, CELL, RANGE_CHANNELS, SIDE, SLICES, RangeImage, log_bytes

# cells of a margin to each side of a stored range view, so that it can be moved and scaled
_MARGIN = 3
# context: channels, cells of a side, their size m, what height is 1
CONTEXT_CHANNELS, CONTEXT_SIDE, CONTEXT_CELL, _TALL = 4, 20, 0.5, 4.0
# points of a candidate lie within this, and so far above and below the slices, m
RADIUS, _ROOM = 1.75, 0.2
# heights above the ground at which points are looked at, m
_USED = (-1.2, 3.2)
# the most that are kept, and the unit they are kept in, m
_MOST_POINTS, _UNIT = 1000, 5e-4
# points lie sorted by cells of this size, m, in tables of at most so many cells
_INDEX_CELL, _MOST_INDEX_CELLS = 0.5, 4_000_000
# of which each keeps at most so many points, and points that are looked at in one go
_MOST_IN_CELL, _MOST_AT_ONCE = 10_000, 4_000_000
# candidates that are drawn at a time
_CHUNK = 64
_LEAST_DISTANCE = 0.5
# heights above the ground: of the slices whose filling is counted, and what is near the ground, m
_BAND, _BAND_SLICES, _NEAR_GROUND = (0.3, 2.1), 6, 0.2


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidate:
    """A place where a person may stand, ready to be drawn: small, so that many can be kept.

    center (3,) m, level frame: x, y, and z of the ground; yaw rad of the view frame's x; distance m from the sensor
    and its height m above the ground there, None if unknown; count: points within `RADIUS` at a person's heights, of
    which `packed` (n, 3) int16 holds up to 1000 in units of 0.5 mm; range_view (4, 34, 30) and context (4, 20, 20)
    uint8: as drawn, before augmentation.
    """

    center: np.ndarray
    yaw: float
    distance: float | None
    sensor_height: float | None
    count: int
    packed: np.ndarray
    range_view: np.ndarray
    context: np.ndarray

    @property
    def points(self) -> np.ndarray:
        """Points (n, 3) float32 m in the view frame."""
        return self.packed * np.float32(_UNIT)


@dataclass(frozen=True, kw_only=True)
class Augmentation:
    """How a candidate is changed in training. Of points in the view frame, in this order: mirror, turn, scale, shift.

    turn rad about z; mirror: y to -y; scale; shift (2,) m; keep: share of points; noise m: standard deviation along
    x, away from the sensor; drop_origin: as if the sensor was unknown; seed of what is drawn for each point.
    """

    turn: float = 0.0
    mirror: bool = False
    scale: float = 1.0
    shift: tuple[float, float] = (0.0, 0.0)
    keep: float = 1.0
    noise: float = 0.0
    drop_origin: bool = False
    seed: int = 0

    def apply(self, points: np.ndarray) -> np.ndarray:
        """points (n, 2) or (n, 3) m mirrored, turned, scaled and shifted."""
        moved = np.array(points, float)
        moved[:, :2] = moved[:, :2] @ self._matrix().T + self.shift
        moved[:, 2:] *= self.scale
        return moved

    def _matrix(self) -> np.ndarray:
        """(2, 2) of x and y."""
        c, s = self.scale * np.cos(self.turn), self.scale * np.sin(self.turn)
        return np.array([[c, -s], [s, c]]) * [1, -1 if self.mirror else 1]


def draw_augmentation(rng: np.random.Generator, *, drop_origin: float = 0.15) -> Augmentation:
    """A random augmentation; in a share `drop_origin` the sensor is dropped, and the turn is any instead of small."""
    is_dropped = bool(rng.random() < drop_origin)
    return Augmentation(
        turn=float(rng.uniform(-pi, pi) if is_dropped else rng.normal(0, 0.1)),
        mirror=bool(rng.random() < 0.5),
        scale=float(rng.uniform(0.92, 1.08)),
        shift=tuple(rng.uniform(-0.1, 0.1, 2).tolist()),
        keep=float(rng.uniform(0.25, 1.0) if rng.random() < 0.6 else 1.0),
        noise=float(rng.uniform(0, 0.025)),
        drop_origin=is_dropped,
        seed=int(rng.integers(2**63)),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Cuts:
    """K candidates as arrays, see `Candidate`: `distance` is 0 where the sensor is unknown, xyz (3, n) int16 holds the
    points of all, `sizes` (K,) of each, and the range views have as many cells of a margin as they were cut with."""

    distance: np.ndarray
    sensor_height: np.ndarray
    count: np.ndarray
    sizes: np.ndarray
    xyz: np.ndarray
    range_views: np.ndarray
    contexts: np.ndarray


class SceneIndex:
    """A scan prepared once, from which candidates are cut.

    Args:
        points: (n, 3) m, z up.
        ground: under them.
        origin: (3,) m, the sensor, or None where it is unknown.
        heights: (n,) m of the points above the ground, where they are known.
    """

    def __init__(
        self, points: np.ndarray, ground: Ground, origin: np.ndarray | None, *, heights: np.ndarray | None = None
    ):
        points = np.asarray(points)
        if heights is None:
            heights = heights_above(points, ground)
        self.origin = None if origin is None else np.asarray(origin, float)
        columns = points.T
        self._corner = np.array(
            [np.floor(values.min(initial=np.inf)) if len(points) else 0.0 for values in columns[:2]]
        )
        extent = (
            [np.floor(values.max(initial=0)) for values in columns[:2]] - self._corner + 1
            if len(points)
            else np.ones(2)
        )
        # a wide map has larger cells instead of a larger table
        self._cell = max(_INDEX_CELL, float(np.sqrt(extent.prod() / _MOST_INDEX_CELLS)))
        self._shape = tuple(int(n) for n in extent // self._cell + 2)
        # relative to the corner, float32 holds millimeters of the widest map
        x, y = ((columns[i] - self._corner[i]).astype(np.float32) for i in (0, 1))
        row, column = ((values * np.float32(1 / self._cell)).astype(np.int32) for values in (x, y))
        flat = row * self._shape[1] + column
        self._maps = _draw_maps(flat, heights, self._shape)
        # what lies high above everybody is context alone
        used = np.flatnonzero((heights > _USED[0]) & (heights < _USED[1]))
        z = columns[2].astype(np.float32)
        # in an order of their own: thinned in the file's, beam after beam, whole beams would go
        used = used[np.argsort(_scrambled(x[used], y[used], z[used]), kind="stable")]
        cells = flat[used]
        # very dense cells are thinned, so that no candidate costs more than so much
        chosen, count = _thinned(np.bincount(cells, minlength=self._shape[0] * self._shape[1]), _MOST_IN_CELL)
        self._order = used[_order(cells)][chosen]
        self._x, self._y, self._z = x[self._order], y[self._order], z[self._order]
        self._start = np.concatenate([[0], np.cumsum(count)])
        self._image = None if self.origin is None else RangeImage(points, self.origin)

    def rows(self, centers: np.ndarray, radius: float = 0.35) -> list[np.ndarray]:
        """Of each of centers (K, 2 or 3) m the rows of the scan's points at a person's heights within `radius` m."""
        if not len(centers):
            return []
        near, _, count = self._near(np.asarray(centers, float), radius)
        return np.split(self._order[near], np.cumsum(count)[:-1])

    def candidates(self, centers: np.ndarray) -> list[Candidate]:
        """The candidates at centers (K, 3) m: x, y, and z of the ground there."""
        return [candidate for piece in self._pieces(centers) for candidate in self._candidates(piece)]

    def inputs(self, centers: np.ndarray) -> Iterator[dict[str, np.ndarray]]:
        """What `render` makes of the candidates at centers (K, 3) m, some at a time, until the next are asked for."""
        # in memory that each piece uses again: to get as much anew takes longer than all else
        fine = np.empty((min(len(centers), _CHUNK), SLICES, SIDE, SIDE), np.float32)
        return (_rendered(self._cuts(piece, 0), None, fine[: len(piece)]) for piece in self._pieces(centers))

    def yaws(self, centers: np.ndarray) -> np.ndarray:
        """Of the view frames' x at centers (K, 2 or 3) m, (K,) rad."""
        if self.origin is None:
            return np.zeros(len(centers))
        return np.arctan2(centers[:, 1] - self.origin[1], centers[:, 0] - self.origin[0])

    def _pieces(self, centers: np.ndarray) -> Iterator[np.ndarray]:
        """Centers (K, 3) m, some at a time: together they have no more than so many points to look at."""
        centers = np.asarray(centers, float)
        for start in range(0, len(centers), _CHUNK):
            piece = centers[start : start + _CHUNK]
            number = self._runs(piece[:, :2] - self._corner, RADIUS)[2].sum()
            yield from np.array_split(piece, min(len(piece), 1 + 2 * number // _MOST_AT_ONCE))

    def _candidates(self, centers: np.ndarray) -> list[Candidate]:
        cuts, yaw = self._cuts(centers, _MARGIN), self.yaws(centers)
        packed, ends = np.ascontiguousarray(cuts.xyz.T), np.cumsum(cuts.sizes)
        is_known = self.origin is not None
        return [
            Candidate(
                center=centers[k],
                yaw=float(yaw[k]),
                distance=float(cuts.distance[k]) if is_known else None,
                sensor_height=float(cuts.sensor_height[k]) if is_known else None,
                count=int(cuts.count[k]),
                packed=packed[ends[k] - cuts.sizes[k] : ends[k]].copy(),
                # copies: a candidate that is kept does not hold those of all others
                range_view=cuts.range_views[k].copy(),
                context=cuts.contexts[k].copy(),
            )
            for k in range(len(centers))
        ]

    def _cuts(self, centers: np.ndarray, margin: int) -> _Cuts:
        """Candidates at centers (K, 3) m, their range views with so many cells of a margin."""
        yaw, distance, sensor_height = self.yaws(centers), np.zeros(len(centers)), np.zeros(len(centers))
        ranges = np.zeros((len(centers), RANGE_CHANNELS, SLICES + 2 * margin, SIDE + 2 * margin), np.uint8)
        if self._image is not None and self.origin is not None:
            away = centers - self.origin
            distance, sensor_height = np.maximum(np.hypot(away[:, 0], away[:, 1]), _LEAST_DISTANCE), -away[:, 2]
            ranges = self._image.views(away, yaw, distance, margin)
        _, (x, y, z), count = self._near(centers, RADIUS, (BOTTOM - _ROOM, BOTTOM + SLICES * CELL + _ROOM))
        chosen, sizes = _thinned(count, _MOST_POINTS)
        x, y, z = x[chosen], y[chosen], z[chosen]
        c, s = (np.repeat(values.astype(np.float32), sizes) for values in (np.cos(yaw), np.sin(yaw)))
        xyz = np.stack([x * c + y * s, y * c - x * s, z])
        xyz *= np.float32(1 / _UNIT)
        return _Cuts(
            distance=distance,
            sensor_height=sensor_height,
            count=count,
            sizes=sizes,
            xyz=np.rint(xyz, out=xyz).astype(np.int16),
            range_views=ranges,
            contexts=self._context(centers, yaw),
        )

    def _near(
        self, centers: np.ndarray, radius: float, heights: tuple[float, float] | None = None
    ) -> tuple[np.ndarray, list[np.ndarray], np.ndarray]:
        """Points within `radius` and between heights of centers (K, 2 or 3) m, one center's after the other's.

        Returns their sorted rows (m,), where they lie from their center, x, y and with heights z (m,) float32 m, and
        how many each has (K,).
        """
        owner, start, size = self._runs(centers[:, :2] - self._corner, radius)
        row = np.arange(size.sum()) + np.repeat(start - (np.cumsum(size) - size), size)
        sizes = np.bincount(owner, size, minlength=len(centers)).astype(np.int64)
        middle = (centers - [*self._corner, 0.0][: centers.shape[1]]).astype(np.float32).T
        x, y = (values[row] - np.repeat(own, sizes) for values, own in zip((self._x, self._y), middle, strict=False))
        inside = np.flatnonzero(x * x + y * y < np.float32(radius**2))
        local = [x, y]
        if heights is not None:
            z = self._z[row[inside]] - np.repeat(middle[2], sizes)[inside]
            between = (z > heights[0]) & (z < heights[1])
            inside, local = inside[between], [x, y, z[between]]
        local[:2] = x[inside], y[inside]
        return row[inside], local, np.diff(np.searchsorted(inside, np.cumsum(sizes)), prepend=0)

    def _runs(self, place: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Runs of sorted rows in the cells around places (K, 2) m from the corner: (owner, first row, length)."""
        low = np.floor((place - radius) / self._cell).astype(np.int64)
        high = np.floor((place + radius) / self._cell).astype(np.int64)
        low, high = np.maximum(low, 0), np.minimum(high, np.array(self._shape) - 1)
        # one for each row of the square of cells: its points lie one after the other
        lines = np.maximum(high[:, 0] - low[:, 0] + 1, 0)
        lines[(high < low).any(1)] = 0
        owner = np.repeat(np.arange(len(place)), lines)
        line = np.arange(len(owner)) - np.repeat(np.cumsum(lines) - lines, lines)
        base = (low[owner, 0] + line) * self._shape[1]
        start, end = self._start[base + low[owner, 1]], self._start[base + high[owner, 1] + 1]
        return owner, start, end - start

    def _context(self, centers: np.ndarray, yaw: np.ndarray) -> np.ndarray:
        """Contexts (K, 4, 20, 20) uint8, nearest cells of the maps."""
        side = (np.arange(CONTEXT_SIDE) - (CONTEXT_SIDE - 1) / 2) * CONTEXT_CELL
        x, y = np.repeat(side, CONTEXT_SIDE), np.tile(side, CONTEXT_SIDE)
        c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
        place = centers[:, :2] - self._corner
        i = np.floor((place[:, :1] + c * x - s * y) / self._cell).astype(np.int64)
        j = np.floor((place[:, 1:] + s * x + c * y) / self._cell).astype(np.int64)
        inside = (i >= 0) & (j >= 0) & (i < self._shape[0]) & (j < self._shape[1])
        # outside is the cell after the last, which is empty
        cells = self._maps[np.where(inside, i * self._shape[1] + j, len(self._maps) - 1)]
        values = np.moveaxis(cells.view(np.uint8).reshape(*inside.shape, CONTEXT_CHANNELS), -1, 1)
        return np.ascontiguousarray(values).reshape(-1, CONTEXT_CHANNELS, CONTEXT_SIDE, CONTEXT_SIDE)


def _thinned(count: np.ndarray, most: int) -> tuple[slice | np.ndarray, np.ndarray]:
    """Which rows stay where groups of `count` (K,) rows, one after the other, keep `most` each; how many each keeps.

    Every so manieth row stays of a group that has too many.
    """
    if count.max(initial=0) <= most:
        return slice(None), count
    number = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    share = np.repeat(np.minimum(1.0, most / np.maximum(count, 1)), count)
    chosen = np.floor((number + 1) * share) > np.floor(number * share)
    ends = np.concatenate([[0], np.cumsum(chosen)])[np.cumsum(count)]
    return np.flatnonzero(chosen), np.diff(ends, prepend=0)


def _scrambled(*columns: np.ndarray) -> np.ndarray:
    """(n,) uint16 without pattern, of each row of columns (n,) float32 the same wherever it stands."""
    factors = (0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D)
    mixed = sum(values.view(np.uint32) * np.uint32(factor) for values, factor in zip(columns, factors, strict=True))
    return (np.asarray(mixed) >> 16).astype(np.uint16)


def _order(cells: np.ndarray) -> np.ndarray:
    """Rows that sort flat cells (n,), those of one cell in their own order: by 16 bits at a time, which is linear."""
    order = np.argsort((cells & 0xFFFF).astype(np.uint16), kind="stable")
    if len(cells) and cells.max() > 0xFFFF:
        order = order[np.argsort((cells >> 16)[order].astype(np.uint16), kind="stable")]
    return order


def _draw_maps(cells: np.ndarray, heights: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The context's channels of points in flat cells (n,), heights (n,) m: four bytes (cells + 1,) each, the last 0."""
    size = shape[0] * shape[1]
    highest, count, near = np.zeros((3, size + 1), np.float32)
    filled = np.zeros(size + 1, np.uint8)
    np.maximum.at(highest, cells, heights)
    np.add.at(count, cells, np.float32(1))
    np.add.at(near, cells[np.abs(heights) < _NEAR_GROUND], np.float32(1))
    band = np.flatnonzero((heights > _BAND[0]) & (heights < _BAND[1]))
    level = ((heights[band] - _BAND[0]) * (_BAND_SLICES / (_BAND[1] - _BAND[0]))).astype(np.uint8)
    np.bitwise_or.at(filled, cells[band], np.left_shift(np.uint8(1), np.minimum(level, _BAND_SLICES - 1)))
    maps = np.empty((size + 1, CONTEXT_CHANNELS), np.uint8)
    maps[:, 0] = np.minimum(highest * (255 / _TALL), 255)
    maps[:, 1] = np.bitwise_count(filled) * (255 / _BAND_SLICES)
    maps[:, 2], maps[:, 3] = log_bytes(count), log_bytes(near)
    return maps.view(np.uint32).ravel()


def render(
    candidates: Sequence[Candidate], augmentations: Sequence[Augmentation] | None = None
) -> dict[str, np.ndarray]:
    """The network's inputs, float32: see the module. augmentations: one for each candidate, or None for none."""
    side = (SLICES + 2 * _MARGIN, SIDE + 2 * _MARGIN)
    empty = np.zeros((0, RANGE_CHANNELS, *side), np.uint8), np.zeros((0, 4, CONTEXT_SIDE, CONTEXT_SIDE), np.uint8)
    cuts = _Cuts(
        distance=np.array([c.distance or 0.0 for c in candidates]),
        sensor_height=np.array([c.sensor_height or 0.0 for c in candidates]),
        count=np.array([c.count for c in candidates], np.int64),
        sizes=np.array([len(c.packed) for c in candidates], np.int64),
        xyz=np.concatenate([np.zeros((0, 3), np.int16), *(c.packed for c in candidates)]).T,
        range_views=np.stack([c.range_view for c in candidates]) if candidates else empty[0],
        contexts=np.stack([c.context for c in candidates]) if candidates else empty[1],
    )
    return _rendered(cuts, augmentations)


def _rendered(
    cuts: _Cuts, changes: Sequence[Augmentation] | None, fine: np.ndarray | None = None
) -> dict[str, np.ndarray]:
    """fine: memory (K, 28, 24, 24) float32 for that input."""
    known = cuts.distance > 0
    if changes is not None:
        known &= ~np.array([a.drop_origin for a in changes], bool)
    points, owner, count = _moved_points(cuts, changes)
    scalars = np.zeros((len(known), 4), np.float32)
    scalars[:, 0] = np.log(np.where(known, cuts.distance, 1.0))
    scalars[:, 1] = known * cuts.sensor_height / 4
    scalars[:, 2] = np.log1p(count)
    scalars[:, 3] = known
    # of a place with more points than are kept, those stand for all
    weight = cuts.count / np.maximum(cuts.sizes, 1)
    return {
        "fine": _fine(points, owner, weight, fine),
        "range_view": _range_views(cuts.range_views, known, changes),
        "context": _contexts(cuts.contexts, changes),
        "scalars": scalars,
    }


def _moved_points(cuts: _Cuts, changes: Sequence[Augmentation] | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(points (3, n) float32 m, owner (n,), counts (K,) of all points within `RADIUS`)."""
    points = cuts.xyz * np.float32(_UNIT)
    owner = np.repeat(np.arange(len(cuts.sizes)), cuts.sizes)
    if changes is None:
        return points, owner, cuts.count
    draws = []
    for size, change in zip(cuts.sizes.tolist(), changes, strict=True):
        rng = np.random.default_rng(change.seed)
        draws.append(np.stack([rng.random(size, np.float32), rng.standard_normal(size, np.float32) * change.noise]))
    chance, noise = np.concatenate([np.zeros((2, 0), np.float32), *draws], axis=1)
    kept = chance < np.array([a.keep for a in changes], np.float32)[owner]
    points, owner, noise = points[:, kept], owner[kept], noise[kept]
    points[0] += noise
    matrix = np.array([a._matrix() for a in changes], np.float32).reshape(-1, 2, 2)[owner]
    shift = np.array([a.shift for a in changes], np.float32).reshape(-1, 2)[owner]
    x, y = (matrix[:, i, 0] * points[0] + matrix[:, i, 1] * points[1] + shift[:, i] for i in (0, 1))
    z = points[2] * np.array([a.scale for a in changes], np.float32)[owner]
    return np.stack([x, y, z]), owner, cuts.count * np.array([a.keep for a in changes])


def _fine(points: np.ndarray, owner: np.ndarray, weight: np.ndarray, fine: np.ndarray | None) -> np.ndarray:
    """(K, 28, 24, 24) of points (3, n) m, of whose owners (n,) each stands for `weight` (K,) points."""
    shape = (len(weight), SLICES, SIDE, SIDE)
    first = np.array([[SIDE // 2], [SIDE // 2], [-BOTTOM / CELL]], np.float32)
    j, k, i = np.floor(points * np.float32(1 / CELL) + first).astype(np.int64)
    # as unsigned numbers, what is below 0 is large
    inside = np.logical_and.reduce([at.view(np.uint64) < n for at, n in zip((i, j, k), shape[1:], strict=True)])
    flat = (((owner * SLICES + i) * SIDE + j) * SIDE + k)[inside]
    fine = np.empty(shape, np.float32) if fine is None else fine
    fine[:] = 0
    cells = fine.reshape(-1)
    np.add.at(cells, flat, np.float32(1))
    cells[flat] = 0.5 + 0.125 * np.log2(1 + cells[flat] * weight[owner[inside]])
    return fine


def _range_views(stored: np.ndarray, known: np.ndarray, changes: Sequence[Augmentation] | None) -> np.ndarray:
    views = np.zeros((len(known), RANGE_CHANNELS, SLICES, SIDE), np.float32)
    if not known.any():
        return views
    stored = stored[known]
    if changes is None:
        margin = (stored.shape[3] - SIDE) // 2
        stored = stored[:, :, margin : margin + SLICES, margin : margin + SIDE]
    else:
        chosen = [change for change, is_known in zip(changes, known, strict=True) if is_known]
        scale = np.array([a.scale for a in chosen])[:, None]
        sign = np.array([-1.0 if a.mirror else 1.0 for a in chosen])[:, None]
        shift = np.array([a.shift[1] for a in chosen])[:, None]
        height = ((np.arange(SLICES) + 0.5) * CELL + BOTTOM) / scale
        lateral = sign * (((np.arange(SIDE) + 0.5) * CELL - SIDE * CELL / 2) - shift) / scale
        i = np.floor((height - BOTTOM) / CELL).astype(np.int64) + _MARGIN
        j = np.floor((lateral + SIDE * CELL / 2) / CELL).astype(np.int64) + _MARGIN
        i, j = np.clip(i, 0, stored.shape[2] - 1), np.clip(j, 0, stored.shape[3] - 1)
        stored = stored[np.arange(len(stored))[:, None, None], :, i[:, :, None], j[:, None, :]]
        stored = np.moveaxis(stored, -1, 1)
        stored = _lost(stored, chosen)
    ranges = (stored[:, :2] - np.float32(128)) / np.float32(127)
    ranges[stored[:, :2] == 0] = 0
    views[known, :2], views[known, 2:] = ranges, stored[:, 2:] / np.float32(255)
    return views


def _lost(stored: np.ndarray, changes: Sequence[Augmentation]) -> np.ndarray:
    """Range views of which only a share of the returns is kept: a cell is empty where all of its returns are lost."""
    keep = np.array([a.keep for a in changes])[:, None, None]
    count = np.exp2(stored[:, 2] / (0.125 * 255)) - 1
    chance = np.stack([np.random.default_rng([a.seed, 1]).random(stored.shape[2:], np.float32) for a in changes])
    stays = chance >= (1 - keep) ** count
    stored[:, :3] *= stays[:, None]
    fewer = np.log2(keep) * (0.125 * 255)
    stored[:, 2:] = np.where(stored[:, 2:] > 0, np.maximum(stored[:, 2:] + fewer[:, None], 1), 0)
    return stored


def _contexts(stored: np.ndarray, changes: Sequence[Augmentation] | None) -> np.ndarray:
    if changes is not None and len(stored):
        side = (np.arange(CONTEXT_SIDE) - (CONTEXT_SIDE - 1) / 2) * CONTEXT_CELL
        to = np.stack(np.meshgrid(side, side, indexing="ij"), -1).reshape(-1, 2)
        inverse = np.linalg.inv(np.array([a._matrix() for a in changes]))
        shift = np.array([a.shift for a in changes])[:, None]
        source = (to - shift) @ np.swapaxes(inverse, 1, 2)
        i, j = np.moveaxis(np.floor(source / CONTEXT_CELL).astype(np.int64) + CONTEXT_SIDE // 2, -1, 0)
        i, j = np.clip(i, 0, CONTEXT_SIDE - 1), np.clip(j, 0, CONTEXT_SIDE - 1)
        stored = np.moveaxis(stored[np.arange(len(stored))[:, None], :, i, j], -1, 1)
        stored = stored.reshape(-1, CONTEXT_CHANNELS, CONTEXT_SIDE, CONTEXT_SIDE)
    return stored * np.float32(1 / 255)


def suppress(rows: Sequence[np.ndarray], strength: np.ndarray, *, most_shared: float = 0.5) -> np.ndarray:
    """Indices of the candidates that stay, the strongest first, where of two that share points the weaker goes.

    rows: of each candidate (K) the rows of its points; strength (K,). A candidate goes that shares more than
    `most_shared` of the points of the one of the two that has fewer, with a stronger one that stays. Two people side by
    side share few points however near they stand. A candidate without points shares none.
    """
    sizes = np.array([len(own) for own in rows], np.int64)
    order = np.argsort(-np.asarray(strength), kind="stable")
    rank = np.empty(len(rows), np.int64)
    rank[order] = np.arange(len(rows))
    # all pairs of owners of a point, the points' owners lying side by side, the strongest first
    row = np.concatenate([np.zeros(0, np.int64), *rows])
    owner = np.repeat(rank, sizes)
    sorting = np.lexsort((owner, row))
    row, owner = row[sorting], owner[sorting]
    pairs, lag = [np.zeros(0, np.int64)], 1
    while (shared := row[lag:] == row[:-lag]).any():
        pairs.append(owner[:-lag][shared] * len(rows) + owner[lag:][shared])
        lag += 1
    pair, count = np.unique(np.concatenate(pairs), return_counts=True)
    stronger, weaker = np.divmod(pair, max(len(rows), 1))
    sizes = sizes[order]
    is_same = count > most_shared * np.minimum(sizes[stronger], sizes[weaker])
    stays = np.ones(len(rows), bool)
    # in the order of the stronger one: whether it stays is known when its pairs come
    for first, second in zip(stronger[is_same].tolist(), weaker[is_same].tolist(), strict=True):
        if stays[first]:
            stays[second] = False
    return order[stays]
