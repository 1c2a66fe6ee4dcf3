"""The ground under a scan: a map of heights from the lowest points of cells, and the up direction of a tilted cloud.

Of each cell of 1 m the lowest 10 cm that hold company; the plane that most of these share is taken off; what stands
above a cone around its neighbors (car roofs, tables, wall tops) or lies alone below (mirrored returns) is dropped;
holes are filled from coarser and coarser means, so the plane goes on where nothing was seen.
"""

from dataclasses import dataclass, replace

import numpy as np

from lidarpose.geometry import rotation_between

# sizes in m: of a cell, of the bins in which its lowest points are looked for
CELL, _BIN = 1.0, 0.1
# cells an axis; points farther from the middle are left out
_MOST_CELLS = 1024
# a floor may rise by so much a meter over the shared plane, and lie so high above its neighbors besides
_CONE_SLOPE, _CONE_ROOM, _CONE_REACH = 0.12, 0.12, 24
# the same within some m of the sensor
_OWN_SLOPE, _OWN_REACH = 0.04, 4.0
# a cell has support where so many of the cells within 2 m lie at its height, to so many m and so many m a meter
_SUPPORT, _SUPPORT_ROOM, _SUPPORT_SLOPE = 3, 0.1, 0.15
# or where it lies this near the shared plane
_NEAR_PLANE = 0.25
# slopes of the plane: the steepest, and the width of the bins in which the commonest is looked for
_STEEPEST, _SLOPE_BIN = 0.9, 0.06
# how many cells the plane counts for where a hole is filled
_PLANE_WEIGHT = 0.5
# there is a ground where at least so many cells, and this share of all cells with points, belong to it
_LEAST_CELLS, _LEAST_SHARE = 6, 0.2
# a cloud whose plane leans more is tilted rather than on a slope, degrees
TILTED = 10.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Ground:
    """Heights (X, Y) float32 m of the ground at the centers of cells; corner (2,) m: of the first cell; cell m."""

    corner: np.ndarray
    heights: np.ndarray
    cell: float = CELL

    def at(self, xy: np.ndarray) -> np.ndarray:
        """Height (n,) float32 m of the ground at xy (n, 2) m: bilinear, outside as at the border."""
        rows, columns = self.heights.shape
        at_x, at_y = (
            np.clip((np.asarray(xy)[:, i] - (self.corner[i] + self.cell / 2)) / self.cell, 0, count - 1).astype(
                np.float32
            )
            for i, count in enumerate((rows, columns))
        )
        i, j = (np.minimum(at.astype(np.int32), max(n - 2, 0)) for at, n in ((at_x, rows), (at_y, columns)))
        u, v = at_x - i, at_y - j
        flat = self.heights.ravel()
        first = i * columns + j
        down, right = (columns if rows > 1 else 0), (1 if columns > 1 else 0)
        near = flat[first] * (1 - v) + flat[first + right] * v
        far = flat[first + down] * (1 - v) + flat[first + down + right] * v
        return near * (1 - u) + far * u


@dataclass(frozen=True, kw_only=True, eq=False)
class _Floors:
    """Heights (X, Y) m of the lowest points of cells, NaN where there are none; corner (2,) m."""

    corner: np.ndarray
    heights: np.ndarray

    def positions(self) -> tuple[np.ndarray, np.ndarray]:
        """x (X, 1) and y (1, Y) m of the centers."""
        x, y = (self.corner[i] + CELL * (np.arange(n) + 0.5) for i, n in enumerate(self.heights.shape))
        return x[:, None], y[None]


def estimate_ground(points: np.ndarray, origin: np.ndarray | None = None) -> Ground | None:
    """The ground under points (n, 3) m, z up.

    Args:
        points: (n, 3) m, any order; what lies more than 512 m from the middle is left out.
        origin: (3,) m, the sensor, where it is known: the middle; else the points' median.

    Returns:
        The ground, or None where there is none: too few cells whose lowest points form a surface.
    """
    floors = _lowest(points, origin)
    if floors is None:
        return None
    plane = _common_plane(floors)
    if plane is None:
        return None
    slope, height = plane[:2], plane[2]
    if np.abs(slope).max() > _SLOPE_BIN:
        # the lowest points of a cell lie at its lower side: look again along the plane
        points = np.asarray(points)
        flat = np.column_stack([points[:, :2], points[:, 2] - points[:, :2] @ slope])
        floors = _lowest(flat, origin) or floors
    else:
        x, y = floors.positions()
        floors = replace(floors, heights=floors.heights - (slope[0] * x + slope[1] * y))
    rest = floors.heights - height
    is_floor = _is_supported(rest) | (np.abs(rest) < _NEAR_PLANE)
    x, y = floors.positions()
    is_floor &= _is_low(np.where(is_floor, rest, np.nan), _CONE_SLOPE)
    if origin is not None:
        # what carries the sensor has a hole around it, in which a steeper cone reaches over hood and roof
        near = np.hypot(x - origin[0], y - origin[1]) < _OWN_REACH
        is_floor &= ~near | _is_low(np.where(is_floor, rest, np.nan), _OWN_SLOPE)
    if not _is_ground(is_floor, floors.heights):
        return None
    heights = _fill(np.where(is_floor, rest, np.nan)) + (slope[0] * x + slope[1] * y + height)
    return Ground(corner=floors.corner, heights=heights.astype(np.float32))


def without_ground(points: np.ndarray, origin: np.ndarray | None = None) -> Ground:
    """A stand-in where `estimate_ground` gives None: the lowest points within 2 m. points (n, 3) m."""
    floors = _lowest(points, origin, least=1)
    if floors is None:
        return Ground(corner=np.zeros(2), heights=np.zeros((1, 1), np.float32))
    heights = np.where(np.isnan(floors.heights), np.inf, floors.heights)
    heights = _spread_minimum(heights, 0.0, 2)
    middle = np.median(heights[np.isfinite(heights)])
    heights = _fill(np.where(np.isfinite(heights), heights - middle, np.nan)) + middle
    return Ground(corner=floors.corner, heights=heights.astype(np.float32))


def estimate_up(points: np.ndarray, origin: np.ndarray | None = None) -> np.ndarray | None:
    """The up direction (3,) of a cloud tilted by up to some 40 degrees; None where it is level to `TILTED` degrees.

    A level cloud on a slope and a tilted one on a plane look alike: a plane that leans less than `TILTED` is a slope.
    points (n, 3) m, z about up. None too where there is no ground to tell by.
    """
    up = np.array([0.0, 0.0, 1.0])
    middle = np.zeros(3) if origin is None else np.asarray(origin, float)
    for _ in range(3):
        leveled = (points - middle) @ rotation_between(up, np.array([0.0, 0.0, 1.0])).T
        floors = _lowest(leveled, np.zeros(3) if origin is not None else None)
        plane = None if floors is None else _common_plane(floors)
        if plane is None:
            return None
        normal = np.array([-plane[0], -plane[1], 1.0]) @ rotation_between(up, np.array([0.0, 0.0, 1.0]))
        normal /= np.linalg.norm(normal)
        moved, up = np.arccos(np.clip(normal @ up, -1, 1)), normal
        if moved < np.radians(2):
            break
    return up if np.degrees(np.arccos(np.clip(up[2], -1, 1))) > TILTED else None


def _lowest(points: np.ndarray, origin: np.ndarray | None, *, least: int = 2) -> _Floors | None:
    """Of each cell the mean of the lowest bin that, with the next, holds `least` points."""
    if not len(points):
        return None
    x, y, z = (np.asarray(points)[:, i] for i in range(3))
    middle = np.array([np.median(x), np.median(y)]) if origin is None else np.asarray(origin, float)[:2]
    reach = _MOST_CELLS / 2 * CELL
    inside = (np.abs(x - middle[0]) < reach) & (np.abs(y - middle[1]) < reach)
    # heights that no ground around has
    low, high = np.quantile(z[inside][:: max(1, len(z) // 20_000)], [0.002, 0.98]) if inside.any() else (0, 0)
    inside &= (z >= low - 3) & (z <= high + 1)
    if not inside.all():
        x, y, z = x[inside], y[inside], z[inside]
    if not len(x):
        return None
    corner = np.floor(np.array([x.min(), y.min()], float) / CELL) * CELL
    i, j = ((values - start) * (1 / CELL) for values, start in ((x, corner[0]), (y, corner[1])))
    i, j = i.astype(np.int64), j.astype(np.int64)
    shape = (int(i.max()) + 1, int(j.max()) + 1)
    bottom = float(z.min())
    level = ((z - bottom) * (1 / _BIN)).astype(np.int64)
    levels = int(level.max()) + 2
    order_key = (i * shape[1] + j) * levels + level
    order = np.argsort(order_key)
    order_key = order_key[order]
    first = np.flatnonzero(np.concatenate([[True], order_key[1:] != order_key[:-1]]))
    key, count = order_key[first], np.diff(np.append(first, len(order_key)))
    total = np.add.reduceat(z[order].astype(float), first)
    # the next bin of the same cell; the topmost bin of a cell is never filled, so keys of two cells do not touch
    has_next = np.append(key[1:] == key[:-1] + 1, False)
    above = np.where(has_next, np.append(count[1:], 0), 0)
    enough = count + above >= least
    key, mean = key[enough], (total / count)[enough]
    if not len(key):
        return None
    cell, lowest = np.unique(key // levels, return_index=True)
    heights = np.full(shape, np.nan)
    heights.flat[cell] = mean[lowest]
    return _Floors(corner=corner, heights=heights)


def _common_plane(floors: _Floors) -> np.ndarray | None:
    """(a, b, c) of the plane z = a x + b y + c that most floors share; None where floors share none."""
    h = floors.heights
    slopes = []
    for lag in (2, 4):
        if min(h.shape) <= lag:
            continue
        for sign_x, sign_y in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            part = h[::sign_x, ::sign_y]
            corner = part[:-lag, :-lag]
            along = np.stack([sign_x * (part[lag:, :-lag] - corner), sign_y * (part[:-lag, lag:] - corner)], -1)
            slopes.append(along[np.isfinite(along).all(-1)] / (lag * CELL))
    slope = np.concatenate(slopes) if slopes else np.zeros((0, 2))
    slope = slope[(np.abs(slope) < _STEEPEST).all(1)]
    if len(slope) < 3:
        return None
    bins = 2 * round(_STEEPEST / _SLOPE_BIN)
    row, column = ((slope + _STEEPEST) * (bins / (2 * _STEEPEST))).astype(np.int64).T
    counts = np.bincount(row * bins + column, minlength=bins * bins).reshape(bins, bins).astype(float)
    smooth = _box_sum(counts, 1)
    peak = (np.array(np.unravel_index(smooth.argmax(), smooth.shape)) + 0.5) * (2 * _STEEPEST / bins) - _STEEPEST
    x, y = (np.broadcast_to(values, h.shape)[np.isfinite(h)] for values in floors.positions())
    z = h[np.isfinite(h)]
    plane = np.array([*peak, _lowest_mode(z - peak[0] * x - peak[1] * y)])
    basis = np.stack([x, y, np.ones_like(x)], 1)
    for room in (0.6, 0.35, 0.25, 0.25):
        near = np.abs(z - basis @ plane) < room
        if near.sum() < 4:
            return None
        # a weak pull to the plane so far where cells lie on a line
        middle = basis[near].mean(0) * [1, 1, 0]
        centered = basis[near] - middle
        change = np.linalg.solve(
            centered.T @ centered + np.diag([1.0, 1.0, 1e-6]), centered.T @ (z - basis @ plane)[near]
        )
        plane = plane + change - [0, 0, change[:2] @ middle[:2]]
    return plane


def _lowest_mode(values: np.ndarray) -> float:
    """The lowest height that is nearly as common as the commonest."""
    step = 0.2
    start = values.min()
    counts = np.bincount(((values - start) / step).astype(np.int64))
    smooth = np.convolve(counts, [1, 1], "full")[1:] if len(counts) > 1 else counts
    return float(start + step * (np.flatnonzero(smooth >= 0.6 * smooth.max())[0] + 1))


def _is_supported(heights: np.ndarray) -> np.ndarray:
    """Cells (X, Y) of whose neighbors within 2 m `_SUPPORT` lie at their height."""
    padded = np.pad(heights, 2, constant_values=np.nan)
    support = np.zeros(heights.shape, np.int64)
    rows, columns = heights.shape
    for i in range(-2, 3):
        for j in range(-2, 3):
            if i or j:
                other = padded[2 + i : 2 + i + rows, 2 + j : 2 + j + columns]
                support += np.abs(other - heights) < _SUPPORT_ROOM + _SUPPORT_SLOPE * CELL * np.hypot(i, j)
    return support >= _SUPPORT


def _is_low(heights: np.ndarray, slope: float) -> np.ndarray:
    """Cells (X, Y) that no neighbor's cone lies below."""
    known = np.where(np.isnan(heights), np.inf, heights)
    cone = _spread_minimum(known, slope * CELL, _CONE_REACH)
    return known <= cone + _CONE_ROOM


def _spread_minimum(heights: np.ndarray, rise: float, reach: int) -> np.ndarray:
    """The least of heights (X, Y) plus `rise` times the distance in cells, up to `reach` cells away."""
    lowest = heights.copy()
    for _ in range(reach):
        before = lowest.copy()
        for axis_rise, (to, start) in (
            (rise, (np.s_[1:], np.s_[:-1])),
            (rise, (np.s_[:-1], np.s_[1:])),
            (rise, (np.s_[:, 1:], np.s_[:, :-1])),
            (rise, (np.s_[:, :-1], np.s_[:, 1:])),
            (1.4142 * rise, (np.s_[1:, 1:], np.s_[:-1, :-1])),
            (1.4142 * rise, (np.s_[1:, :-1], np.s_[:-1, 1:])),
            (1.4142 * rise, (np.s_[:-1, 1:], np.s_[1:, :-1])),
            (1.4142 * rise, (np.s_[:-1, :-1], np.s_[1:, 1:])),
        ):
            np.minimum(lowest[to], before[start] + axis_rise, out=lowest[to])
        if np.array_equal(lowest, before):
            break
    return lowest


def _is_ground(is_floor: np.ndarray, heights: np.ndarray) -> bool:
    seen = np.count_nonzero(np.isfinite(heights))
    return bool(is_floor.sum() >= max(_LEAST_CELLS, _LEAST_SHARE * seen))


def _fill(heights: np.ndarray) -> np.ndarray:
    """Heights (X, Y) with NaN filled by means of ever larger squares around, in which 0 counts as one cell more."""
    known = np.isfinite(heights)
    values, weight = np.where(known, heights, 0.0), known.astype(float)
    filled, reach = heights.copy(), 1
    while np.isnan(filled).any():
        count = _box_sum(weight, reach)
        empty = np.isnan(filled) & (count > 0.5)
        filled[empty] = _box_sum(values, reach)[empty] / (count[empty] + _PLANE_WEIGHT)
        reach *= 2
    return filled


def _box_sum(values: np.ndarray, reach: int) -> np.ndarray:
    """Sums (X, Y) over the squares that reach `reach` cells to each side."""
    for axis in (0, 1):
        size = values.shape[axis]
        sums = np.concatenate([np.zeros_like(values.take([0], axis)), np.cumsum(values, axis)], axis)
        high, low = np.minimum(np.arange(size) + reach + 1, size), np.maximum(np.arange(size) - reach, 0)
        values = sums.take(high, axis) - sums.take(low, axis)
    return values
