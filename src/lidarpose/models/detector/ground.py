"""The ground under a scan: a height map from the lowest points of cells, and the up axis of a tilted cloud.

The height of each cell of 1 m comes from its lowest 10 cm of points that are not isolated. The plane shared by most
cells is subtracted. Cells above a cone around their neighbors (car roofs, tables, wall tops) and isolated points below
(mirrored returns) are dropped. Holes are filled from increasingly coarse means, so that the plane continues where
nothing was observed.
"""

from dataclasses import dataclass, replace

import numpy as np

from lidarpose.geometry import rotation_between

# sizes in m: of a cell, and of the height bins for its lowest points
CELL, _BIN = 1.0, 0.1
# how many times isolated points below the other points of their cell are skipped
_MOST_ALONE = 4
# cells per axis; points farther from the middle are ignored
_MOST_CELLS = 1024
# cone above which a cell is not ground: slope relative to the shared plane, additional height, m, and reach, cells
_CONE_SLOPE, _CONE_ROOM, _CONE_REACH = 0.12, 0.12, 16
# the cone's slope near the sensor, and the distance up to which it applies, m
_OWN_SLOPE, _OWN_REACH = 0.04, 4.0
# a cell is supported if this many cells within 2 m are at its height; the tolerance, m, and its increase with distance
_SUPPORT, _SUPPORT_ROOM, _SUPPORT_SLOPE = 3, 0.1, 0.15
# or if it is nearer than this to the shared plane, m
_NEAR_PLANE = 0.25
# cells more than this below the plane, m, are not ground if at most this many of them are within the cone's reach
_DEEP, _PATCH = 0.5, 9
# a cell is level if at least this many of the cells up to some cells away in each axis are at its height, m
_MANY_LEVEL, _LEVEL_REACH, _LEVEL = 12, 3, 0.2
# least share of the cells far below the plane that are level if they are a lower ground
_LEVEL_SHARE = 0.1
# slopes of the plane: the maximum, and the width of the bins for finding the most common one
_STEEPEST, _SLOPE_BIN = 0.9, 0.06
# distance from the sensor at which a cell has half its weight for the plane, m; minimum depth of its cells below the
# sensor, m, which is also the maximum height of the fitted plane above the sensor
_NEAR, _BELOW_SENSOR = 10.0, 0.1
# number of the most common slopes that are tried, and the slope that halves a plane's score
_SLOPES, _COMMON_SLOPE = 6, 0.5
# a tilt is accepted if at least this number and share of cells lie on its plane, and at most this share below it
_TILT_CELLS, _TILT_SHARE, _TILT_BELOW = 20, 0.4, 0.1
# points between these depths below the ground, m, lower it if they are at least this many: fewer may be mirrored ones
_LEAST_DEPTH, _MOST_DEPTH, _SOLID = 0.15, 1.5, 5
# number of cells that the plane counts for when a hole is filled
_PLANE_WEIGHT = 0.5
# a ground exists if at least this number of cells belong to it, and this share of all cells below the sensor, or, if
# the sensor is unknown, of all cells up to this height above the plane, m
_LEAST_CELLS, _LEAST_SHARE, _TALL = 6, 0.2, 2.0
# a cloud whose plane is inclined by more than this is tilted, not on a slope, degrees
TILTED = 10.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Ground:
    """Heights (X, Y) float32 m of the ground at cells' centers; corner (2,) m: of the first cell."""

    corner: np.ndarray
    heights: np.ndarray

    def at(self, xy: np.ndarray) -> np.ndarray:
        """Height (n,) float32 m of the ground at xy (n, 2) m: bilinear; outside the map, the height at its border."""
        (rows, columns), xy = self.heights.shape, np.asarray(xy)
        x, y = (
            np.clip((xy[:, i] - (self.corner[i] + CELL / 2)) / CELL, 0, count - 1).astype(np.float32)
            for i, count in enumerate((rows, columns))
        )
        i, j = (np.minimum(position.astype(np.int32), max(n - 2, 0)) for position, n in ((x, rows), (y, columns)))
        u, v = x - i, y - j
        flat_heights = self.heights.ravel()
        index = i * columns + j
        row_step, column_step = (columns if rows > 1 else 0), (1 if columns > 1 else 0)
        near = flat_heights[index] * (1 - v) + flat_heights[index + column_step] * v
        far = flat_heights[index + row_step] * (1 - v) + flat_heights[index + row_step + column_step] * v
        return near * (1 - u) + far * u


@dataclass(frozen=True, kw_only=True, eq=False)
class _Floors:
    """Heights (X, Y) m of cells' lowest points, NaN without any; counts (X, Y) of these points; corner (2,) m."""

    corner: np.ndarray
    heights: np.ndarray
    counts: np.ndarray

    def positions(self) -> tuple[np.ndarray, np.ndarray]:
        """x (X, 1) and y (1, Y) m of the cells' centers."""
        x, y = (self.corner[i] + CELL * (np.arange(n) + 0.5) for i, n in enumerate(self.heights.shape))
        return x[:, None], y[None]


def estimate_ground(points: np.ndarray, origin: np.ndarray | None = None, *, near: float = _NEAR) -> Ground | None:
    """The ground under points (n, 3) m, z up.

    Args:
        points: (n, 3) m, in any order; points more than 512 m from the middle are ignored.
        origin: (3,) m, sensor position, which is the middle; if None, the points' median is.
        near: distance from the middle at which a cell has half its weight for the shared plane, m.

    Returns:
        The ground, or None if the lowest points of too few cells form a surface.
    """
    floors = _lowest(points, origin)
    if floors is None:
        return None
    plane = _common_plane(floors, origin, near)
    if plane is None:
        return None
    slope, height = plane[:2], plane[2]
    if np.abs(slope).max() > _SLOPE_BIN:
        # on a slope, the lowest points of a cell lie at its lower side: repeat relative to the plane
        points = np.asarray(points)
        leveled_points = np.column_stack([points[:, :2], points[:, 2] - points[:, :2] @ slope])
        floors = _lowest(leveled_points, origin) or floors
    else:
        x, y = floors.positions()
        floors = replace(floors, heights=floors.heights - (slope[0] * x + slope[1] * y))
    residual = floors.heights - height
    is_near_plane = np.abs(residual) < _NEAR_PLANE
    # the cell itself is counted, too
    is_floor = (_similar_count(residual, 2, _SUPPORT_ROOM, _SUPPORT_SLOPE) > _SUPPORT) | is_near_plane
    is_deep, is_terrace = is_floor & (residual < -_DEEP), np.zeros(residual.shape, bool)
    if is_deep.any():
        # a small patch far below, as a mirrored floor or a stairwell, is not the ground
        is_floor &= ~is_deep | (_box_sum(is_deep.astype(float), _CONE_REACH) > _PATCH)
        # a wide level area beside a drop is above the cone of what lies below, but it is the ground, unless hardly any
        # of that is level, as in a scan that is upside down
        is_level = _similar_count(residual, _LEVEL_REACH, _LEVEL, 0.0) >= _MANY_LEVEL
        if is_level[is_deep].mean() > _LEVEL_SHARE:
            is_terrace = is_floor & is_near_plane & is_level
    x, y = floors.positions()
    is_floor &= _is_low(np.where(is_floor, residual, np.nan), _CONE_SLOPE)
    if origin is not None:
        # the vehicle that carries the sensor hides the ground around it: the steeper cone would accept hood and roof
        is_near = np.hypot(x - origin[0], y - origin[1]) < _OWN_REACH
        is_floor &= ~is_near | _is_low(np.where(is_floor, residual, np.nan), _OWN_SLOPE)
    is_floor |= is_terrace
    # cells below the sensor, both heights without the slope; if the sensor is unknown, cells that are not tall
    is_low = residual < _TALL if origin is None else floors.heights < origin[2] - origin[:2] @ slope
    is_seen = np.isfinite(residual) & is_low
    if is_floor.sum() < max(_LEAST_CELLS, _LEAST_SHARE * is_seen.sum()):
        return None
    residual = np.where(is_floor, residual, np.nan)
    surface = fill_holes(residual)
    # nothing can stand below the ground: for example a person's feet where no ground is visible
    depth = surface - (floors.heights - height)
    is_lower = ~is_floor & (depth > _LEAST_DEPTH) & (depth < _MOST_DEPTH) & (floors.counts >= _SOLID)
    if is_lower.any():
        surface = fill_holes(np.where(is_lower, floors.heights - height, residual))
    heights = surface + (slope[0] * x + slope[1] * y + height)
    return Ground(corner=floors.corner, heights=heights.astype(np.float32))


def without_ground(points: np.ndarray, origin: np.ndarray | None = None) -> Ground:
    """A substitute if `estimate_ground` gives None: the lowest points nearby. points (n, 3) m."""
    floors = _lowest(points, origin, least=1)
    if floors is None:
        return Ground(corner=np.zeros(2), heights=np.zeros((1, 1), np.float32))
    heights = np.where(np.isnan(floors.heights), np.inf, floors.heights)
    heights = _spread_minimum(heights, 0.0, 2)
    median = np.median(heights[np.isfinite(heights)])
    heights = fill_holes(np.where(np.isfinite(heights), heights - median, np.nan)) + median
    return Ground(corner=floors.corner, heights=heights.astype(np.float32))


def estimate_up(points: np.ndarray, origin: np.ndarray | None = None) -> np.ndarray | None:
    """The up axis (3,) of a cloud tilted by up to about 40 degrees; None if it is level to within `TILTED` degrees.

    A level cloud on a slope and a tilted cloud on a plane look the same: a plane inclined by less than `TILTED` is
    taken for a slope. points (n, 3) m, z roughly up. Also None if there is no ground to estimate the axis from.
    """
    upright = np.array([0.0, 0.0, 1.0])
    up, residual, R_level_input = upright, np.zeros(0), np.eye(3)
    if not len(points):
        return None
    middle = np.median(points, axis=0) if origin is None else np.asarray(origin, float)
    center = None if origin is None else np.zeros(3)
    centered_points = np.stack([points[:, i] - middle[i] for i in range(3)])
    leveled_points = centered_points
    for _ in range(3):
        floors = _lowest(leveled_points.T, center)
        plane = None if floors is None else _common_plane(floors, center)
        if floors is None or plane is None:
            return None
        x, y = floors.positions()
        residual = (floors.heights - (plane[0] * x + plane[1] * y + plane[2]))[np.hypot(x, y) < 2 * _NEAR]
        normal = np.array([-plane[0], -plane[1], 1.0]) @ R_level_input
        normal /= np.linalg.norm(normal)
        angle, up = np.arccos(np.clip(normal @ up, -1, 1)), normal
        if np.arccos(np.clip(up[2], -1, 1)) < np.radians(TILTED):
            return None
        if angle < np.radians(2):
            break
        R_level_input = rotation_between(up, upright)
        leveled_points = R_level_input @ centered_points
    residual = residual[np.isfinite(residual)]
    inliers = np.count_nonzero(np.abs(residual) < _NEAR_PLANE)
    if inliers < max(_TILT_CELLS, _TILT_SHARE * len(residual)) or np.mean(residual < -2 * _NEAR_PLANE) > _TILT_BELOW:
        return None
    return up


def _lowest(points: np.ndarray, origin: np.ndarray | None, *, least: int = 2) -> _Floors | None:
    """Mean height per cell of its lowest 10 cm of points that, with the next 10 cm, are at least `least` points."""
    if not len(points):
        return None
    x, y, z = (np.asarray(points)[:, i] for i in range(3))
    middle = np.array([np.median(x), np.median(y)]) if origin is None else np.asarray(origin, float)[:2]
    reach = _MOST_CELLS / 2 * CELL
    is_inside = (np.abs(x - middle[0]) < reach) & (np.abs(y - middle[1]) < reach)
    # removes heights that the ground in this area cannot have
    low, high = np.quantile(z[is_inside][:: max(1, len(z) // 20_000)], [0.002, 0.98]) if is_inside.any() else (0, 0)
    is_inside &= (z >= low - 3) & (z <= high + 1)
    if not is_inside.all():
        x, y, z = x[is_inside], y[is_inside], z[is_inside]
    if not len(x):
        return None
    corner = np.floor(np.array([x.min(), y.min()], float) / CELL) * CELL
    i, j = (((values - start) * (1 / CELL)).astype(np.int32) for values, start in ((x, corner[0]), (y, corner[1])))
    shape = (int(i.max()) + 1, int(j.max()) + 1)
    cell = i * shape[1] + j
    heights, counts = np.full(shape[0] * shape[1], np.nan), np.zeros(shape[0] * shape[1], np.int64)
    for _ in range(_MOST_ALONE):
        lowest = np.full(heights.size, np.inf)
        np.minimum.at(lowest, cell, z)
        relative_z = z - lowest[cell]
        point_counts = np.bincount(cell[relative_z < 2 * _BIN], minlength=heights.size)
        has_floor = point_counts >= least
        is_lowest = (relative_z < _BIN) & has_floor[cell]
        z_sum = np.bincount(cell[is_lowest], z[is_lowest], minlength=heights.size)
        lowest_counts = np.bincount(cell[is_lowest], minlength=heights.size)
        heights[has_floor] = (z_sum / np.maximum(lowest_counts, 1))[has_floor]
        counts[has_floor] = point_counts[has_floor]
        # isolated points are skipped, and the next higher points of their cell are tried
        is_higher = ~has_floor[cell] & (relative_z >= 2 * _BIN)
        cell, z = cell[is_higher], z[is_higher]
        if not len(z):
            break
    if not counts.any():
        return None
    return _Floors(corner=corner, heights=heights.reshape(shape), counts=counts.reshape(shape))


def _common_plane(floors: _Floors, origin: np.ndarray | None, near: float = _NEAR) -> np.ndarray | None:
    """(a, b, c) of the plane z = a x + b y + c that most cells share, weighted toward near cells.

    None if no plane is shared. near: as for `estimate_ground`. If the sensor position `origin` (3,) m is known, the
    plane passes below it, with a tolerance of `_BELOW_SENSOR`.
    """
    h = floors.heights
    x, y = (np.broadcast_to(values, h.shape) for values in floors.positions())
    middle = np.array([np.nanmedian(np.where(np.isfinite(h), v, np.nan)) for v in (x, y)]) if origin is None else origin
    x, y = x - middle[0], y - middle[1]
    weight = 1 / (1 + (x**2 + y**2) / near**2)
    max_height = np.inf if origin is None else origin[2] - _BELOW_SENSOR
    planes, weights = [np.zeros((0, 3))], [np.zeros(0)]
    for lag in (2, 4):
        for sign_x, sign_y in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            z, u, v, w = (values[::sign_x, ::sign_y] for values in (h, x, y, weight))
            corner = np.s_[:-lag, :-lag]
            a, b = z[lag:, :-lag] - z[corner], z[:-lag, lag:] - z[corner]
            a, b = sign_x * a / (lag * CELL), sign_y * b / (lag * CELL)
            plane = np.stack([a, b, z[corner] - a * u[corner] - b * v[corner]], -1)
            # also False if a cell is unknown
            is_valid = (np.abs(plane[..., :2]) < _STEEPEST).all(-1) & (plane[..., 2] < max_height)
            planes.append(plane[is_valid])
            weights.append(w[corner][is_valid])
    planes_all, weights_all = np.concatenate(planes), np.concatenate(weights)
    if len(planes_all) < 3:
        return None
    bins = 2 * round(_STEEPEST / _SLOPE_BIN)
    # rounding may give the end of the last bin
    row, column = ((planes_all[:, :2] + _STEEPEST) * (bins / (2 * _STEEPEST))).astype(np.int64).clip(max=bins - 1).T
    counts = _box_sum(np.bincount(row * bins + column, weights_all, minlength=bins * bins).reshape(bins, bins), 1)
    top_bins = np.argsort(-counts, axis=None)[: _SLOPES * 9 : 9]
    peaks = np.stack(np.unravel_index(top_bins[counts.flat[top_bins] > 0], counts.shape), 1)
    slopes = np.concatenate([(peaks + 0.5) * (2 * _STEEPEST / bins) - _STEEPEST, np.zeros((1, 2))])
    is_known = np.isfinite(h)
    x, y, z, weight = x[is_known], y[is_known], h[is_known], weight[is_known]
    basis = np.stack([x, y, np.ones_like(x)], 1)
    scores, candidate_planes = [], []
    for slope in slopes:
        residual = z - basis[:, :2] @ slope
        is_below = residual < max_height
        if is_below.any():
            candidate_planes.append(np.array([*slope, _lowest_mode(residual[is_below], weight[is_below])]))
            residual = residual - candidate_planes[-1][2]
            # many cells below a plane indicate that it is not the ground
            scores.append(weight[np.abs(residual) < _NEAR_PLANE].sum() - weight[residual < -2 * _NEAR_PLANE].sum())
            scores[-1] /= 1 + slope @ slope / _COMMON_SLOPE**2
    if not scores:
        return None
    plane = candidate_planes[int(np.argmax(scores))]
    for tolerance in (0.6, 0.35, 0.25, 0.25):
        residual = z - basis @ plane
        inlier_weight = np.where(np.abs(residual) < tolerance, weight, 0.0)
        if np.count_nonzero(inlier_weight) < 4:
            return None
        # a weak pull toward the current plane, for cells that lie on a line
        ridge = np.diag([1.0, 1.0, 1e-6])
        plane = plane + np.linalg.solve(
            (basis * inlier_weight[:, None]).T @ basis + ridge, basis.T @ (inlier_weight * residual)
        )
    if plane[2] > max_height + 2 * _BELOW_SENSOR:
        return None
    return plane - [0, 0, plane[:2] @ middle[:2]]


def _lowest_mode(values: np.ndarray, weights: np.ndarray) -> float:
    """The lowest height that is nearly as common as the most common one."""
    step = 0.2
    start = values.min()
    counts = np.bincount(((values - start) / step).astype(np.int64), weights)
    pair_counts = np.convolve(counts, [1, 1], "full")[1:] if len(counts) > 1 else counts
    return float(start + step * (np.flatnonzero(pair_counts >= 0.6 * pair_counts.max())[0] + 1))


def _similar_count(heights: np.ndarray, reach: int, room: float, slope: float) -> np.ndarray:
    """(X, Y): how many of the cells up to `reach` away in each axis, the cell itself included, are at a cell's height
    within `room` m, and `slope` m more for each meter of distance. 0 for unknown cells."""
    padded = np.pad(heights, reach, constant_values=np.nan)
    count = np.zeros(heights.shape, np.int64)
    rows, columns = heights.shape
    for i in range(-reach, reach + 1):
        for j in range(-reach, reach + 1):
            neighbor = padded[reach + i : reach + i + rows, reach + j : reach + j + columns]
            count += np.abs(neighbor - heights) < room + slope * CELL * np.hypot(i, j)
    return count


def _is_low(heights: np.ndarray, slope: float) -> np.ndarray:
    """Cells (X, Y) that are not above the cone of any neighbor."""
    finite_heights = np.where(np.isnan(heights), np.inf, heights)
    cone = _spread_minimum(finite_heights, slope * CELL, _CONE_REACH)
    return finite_heights <= cone + _CONE_ROOM


def _spread_minimum(heights: np.ndarray, rise: float, reach: int) -> np.ndarray:
    """The minimum over nearby cells of heights (X, Y) plus `rise` times the distance in cells.

    Steps of 1, 2, 4, ... up to `reach` cells in eight directions reach every cell nearby, on a path that is little
    longer than the straight one.
    """
    lowest = heights.copy()
    step = 1
    while step <= reach:
        start_heights, straight, diagonal = lowest.copy(), rise * step, rise * step * np.sqrt(2)
        for i in (-step, 0, step):
            for j in (-step, 0, step):
                dst = tuple(np.s_[max(k, 0) : n + min(k, 0)] for k, n in zip((i, j), heights.shape, strict=True))
                src = tuple(np.s_[max(-k, 0) : n + min(-k, 0)] for k, n in zip((i, j), heights.shape, strict=True))
                if step < min(heights.shape):
                    np.minimum(lowest[dst], start_heights[src] + (diagonal if i and j else straight), out=lowest[dst])
        step *= 2
    return lowest


def fill_holes(heights: np.ndarray) -> np.ndarray:
    """Heights (X, Y) with NaN filled by means of ever larger squares, in which 0 counts as `_PLANE_WEIGHT` cells."""
    is_known = np.isfinite(heights)
    values, weight = np.where(is_known, heights, 0.0), is_known.astype(float)
    filled_heights, reach = heights.copy(), 1
    while np.isnan(filled_heights).any():
        count = _box_sum(weight, reach)
        is_fillable = np.isnan(filled_heights) & (count > 0.5)
        filled_heights[is_fillable] = _box_sum(values, reach)[is_fillable] / (count[is_fillable] + _PLANE_WEIGHT)
        reach *= 2
    return filled_heights


def _box_sum(values: np.ndarray, reach: int) -> np.ndarray:
    """Sums (X, Y) over the squares that extend `reach` cells to each side."""
    for axis in (0, 1):
        size = values.shape[axis]
        sums = np.concatenate([np.zeros_like(values.take([0], axis)), np.cumsum(values, axis)], axis)
        high, low = np.minimum(np.arange(size) + reach + 1, size), np.maximum(np.arange(size) - reach, 0)
        values = sums.take(high, axis) - sums.take(low, axis)
    return values
