"""Proposes positions of people: columns that hold more points above the ground than their surroundings.

Points 0.3-2.1 m above the ground are counted on a grid of 10 cm. Peaks of the smoothed counts, shifted to the mean of
the points around them, give one kind of candidate. Peaks of the counts at each column's upper end, where two people
side by side are still separate, give another. Both separate two people who stand 0.3 m apart. Nothing is clustered, so
a person at a wall or a hedge gets as good a candidate as one in the open. Finally, columns that are almost never a
person are dropped, by features of each column and the two rings around it.
"""

import threading
from collections.abc import Iterator
from functools import cache
from itertools import product

import numpy as np

from lidarpose.models import weights_file
from lidarpose.models.detector.ground import Ground

# m: size of a cell; heights above ground that count; a tile of the grid, and the overlap of tiles
CELL = 0.1
LOW, HIGH = 0.3, 2.1
_TILE, _OVERLAP = 64.0, 1.0
# minimum of a candidate: points; height of its top above the ground, m, and the same for a person cut off by the field
# of view; extent from its lowest to its highest point, m
LEAST_POINTS = 5
_LEAST_TOP, _LEAST_PART, _LEAST_EXTENT = 0.6, 0.45, 0.25
# minimum extent of a head or shoulder visible above an occluder, and minimum height of its top above the ground, m
_LEAST_HEAD, _HEAD_TOP = 0.08, 1.1
# counts are summed over this many cells to each side
_SUMMED = 1
# radii in cells of the disc and the two rings around it that give a column's features, and the number of features
_RINGS, FEATURES = (3, 6, 9), 13
# cells to each side: of a peak's neighborhood, of the mean shift, of a candidate's column, of the grid's margin
_PEAK, _SHIFT, _COLUMN, _MARGIN = 2, 2, 3, 16
_SHIFTS = 2
# points up to this far below the highest point within 0.3 m belong to a head, m
_HEAD = 0.3
_TALLEST = 2.05
# the lowest height of an empty cell, m
_EMPTY = np.float32(HIGH + 1)
# a column nearer than this to a head or to a stronger column is dropped, m
_APART = 0.3

# logit threshold of columns. At a threshold of 0, three in a thousand of the people who have columns lose all of them,
# as do the people in the middle of a row, since rows of people are rare in training
_LEAST_LOGIT = -0.75
_MOST = 600

# number of points whose heights are looked up at once
_PIECE = 16_384

_kept = threading.local()


def propose(points: np.ndarray, ground: Ground, *, heights: np.ndarray | None = None, areas: float = 1.0) -> np.ndarray:
    """Centers (K, 3) m of columns that may be people, likeliest first: x, y, and z of the ground.

    Args:
        points: (n, 3) m, z up.
        ground: under the points.
        heights: (n,) m of the points above the ground, if already computed.
        areas: how many scans the points may extend over: of each, at most `_MOST` columns are returned.
    """
    xy, features = columns(points, heights_above(points, ground) if heights is None else heights)
    logit = _likeness(features)
    order = np.argsort(-logit, kind="stable")
    xy = xy[order[logit[order] > _LEAST_LOGIT][: round(_MOST * areas)]]
    return np.concatenate([xy, ground.at(xy)[:, None]], 1)


def columns(points: np.ndarray, heights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All columns: positions (K, 2) m, and features of each and its surroundings (K, `FEATURES`).

    points (n, 3) m; heights (n,) m: of the points above the ground.
    """
    points = np.asarray(points)
    band_rows = np.flatnonzero((heights > LOW) & (heights < HIGH))
    # separate arrays, since numpy reduces long rows faster than pairs
    x, y, heights = points[band_rows, 0], points[band_rows, 1], heights[band_rows]
    places, features = [np.zeros((0, 2))], [np.zeros((0, FEATURES), np.float32)]
    for corner, bounds, rows in _tiles(x, y):
        tile_x, tile_y = x[rows] - corner[0], y[rows] - corner[1]
        if not _is_dense_somewhere(tile_x, tile_y):
            continue
        tile_places, tile_features = _peaks(tile_x, tile_y, heights[rows])
        tile_places = tile_places + corner
        is_inside = ((tile_places >= bounds[0]) & (tile_places < bounds[1])).all(1)
        places.append(tile_places[is_inside])
        features.append(tile_features[is_inside])
    return np.concatenate(places), np.concatenate(features)


@cache
def _weights() -> dict[str, np.ndarray]:
    """The layers of a small perceptron, and the logit below which almost no column is a person."""
    with np.load(weights_file("proposals.npz"), allow_pickle=False) as file:
        return dict(file)


def _likeness(features: np.ndarray) -> np.ndarray:
    """Logits (K,) of features (K, `FEATURES`): low for columns that are almost never a person, as in most of a wall."""
    w = _weights()
    hidden = np.maximum((features - w["mean"]) / w["deviation"] @ w["hidden_weight"] + w["hidden_bias"], 0)
    return hidden @ w["weight"] + w["bias"] - w["least"]


def heights_above(points: np.ndarray, ground: Ground) -> np.ndarray:
    """Heights (n,) float32 m of points (n, 3) m above the ground."""
    points, heights = np.asarray(points), np.empty(len(points), np.float32)
    # in pieces that fit the processor's cache
    for start in range(0, len(points), _PIECE):
        piece = points[start : start + _PIECE]
        heights[start : start + _PIECE] = piece[:, 2] - ground.at(piece[:, :2])
    return heights


def _tiles(x: np.ndarray, y: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray | slice]]:
    """(corner, bounds (2, 2) without overlap, rows) of each tile with points: limits the grid size for any extent."""
    if not len(x):
        return
    start = np.floor(np.array([x.min(), y.min()], float) / CELL) * CELL - _OVERLAP
    if max(x.max() - start[0], y.max() - start[1]) < 1.5 * _TILE:
        yield start, np.array([[-np.inf] * 2, [np.inf] * 2]), slice(None)
        return
    position = np.stack([x, y], 1) - start
    tile = np.floor(position / _TILE).astype(np.int64)
    # (i, j, row) of each point in its own tile, and in the neighboring tiles that it is near to
    entries = [np.column_stack([tile, np.arange(len(x))])]
    for shift in product((-_OVERLAP, 0, _OVERLAP), repeat=2):
        near_tile = np.floor((position + shift) / _TILE).astype(np.int64)
        near_rows = np.flatnonzero((near_tile != tile).any(1))
        entries.append(np.column_stack([near_tile[near_rows], near_rows]))
    table = np.concatenate(entries)
    table = table[np.lexsort(table.T[::-1])]
    # near a corner, several shifts give the same tile
    table = table[np.append(True, np.diff(table, axis=0).any(1))]
    ends = np.flatnonzero(np.diff(table[:, :2], axis=0).any(1)) + 1
    for tile_table in np.split(table, ends):
        low = start + tile_table[0, :2] * _TILE
        yield low - _OVERLAP, np.stack([low, low + _TILE]), tile_table[:, 2]


def _is_dense_somewhere(x: np.ndarray, y: np.ndarray) -> bool:
    """Whether any column can have `LEAST_POINTS`: it is less than 1 m wide, so 2 x 2 cells of 1 m contain it.

    x, y (n,) m, at least 0. In a subsampled map of kilometers, most tiles have no such column.
    """
    row, column = (values.astype(np.int64) for values in (x, y))
    shape = int(row.max()) + 2, int(column.max()) + 2
    counts = np.bincount(row * shape[1] + column, minlength=shape[0] * shape[1]).reshape(shape)
    pairs = counts[1:] + counts[:-1]
    return bool((pairs[:, 1:] + pairs[:, :-1]).max() >= LEAST_POINTS)


def _peaks(x: np.ndarray, y: np.ndarray, heights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions (K, 2) m and features of a tile's columns. x, y (n,) m from its corner, heights (n,) m."""
    row, column = ((values * (1 / CELL)).astype(np.int32) + _MARGIN for values in (x, y))
    width = int(column.max()) + _MARGIN + 1
    point_cells = row * width + column
    # per cell: number of points; highest point, m; distance of the lowest point below `_EMPTY`, m; a working grid
    count, top, depth, grid = _grids(4, (int(row.max()) + _MARGIN + 1) * width)
    np.add.at(count, point_cells, np.float32(1))
    np.maximum.at(top, point_cells, heights)
    np.maximum.at(depth, point_cells, _EMPTY - heights)

    occupied_cells = np.flatnonzero(count > 0)
    _smooth(grid, occupied_cells, count[occupied_cells], width)
    body_centers = _shifted(_maxima(grid, width), count, width)
    max_height = top[occupied_cells]
    for step in _disc(_COLUMN, width):
        np.maximum(max_height, top[occupied_cells + step], out=max_height)
    # a column that reaches the end of the band is a wall, not a head
    max_height[max_height > _TALLEST] = np.inf
    grid[occupied_cells] = max_height - _HEAD
    is_head = heights > grid[point_cells]
    grid[:] = 0
    np.add.at(grid, point_cells[is_head], np.float32(1))
    occupied_cells = occupied_cells[grid[occupied_cells] > 0]
    head_counts = grid[occupied_cells]
    grid[occupied_cells] = 0
    _smooth(grid, occupied_cells, head_counts, width)
    head_centers = _positions(_maxima(grid, width), width)

    centers = np.concatenate([body_centers, head_centers])
    cells = _disc(_COLUMN, width)[:, None] + centers.astype(np.int32) @ [width, 1]
    point_count, max_height, min_height = count[cells].sum(0), top[cells].max(0), _EMPTY - depth[cells].max(0)
    is_tall = max_height - min_height > _LEAST_EXTENT
    is_tall |= (max_height - min_height > _LEAST_HEAD) & (max_height > _HEAD_TOP) & (point_count >= 2 * LEAST_POINTS)
    is_valid = (point_count >= LEAST_POINTS) & (max_height > _LEAST_TOP) & is_tall
    # or a person cut off by the field of view
    is_valid |= (point_count >= 6 * LEAST_POINTS) & (max_height > _LEAST_PART) & (max_height - min_height > _LEAST_HEAD)
    is_body = np.arange(len(centers)) < len(body_centers)
    centers, point_count, is_body = centers[is_valid], point_count[is_valid], is_body[is_valid]
    # equally strong columns are ordered by position, so the order of the points does not matter
    order = np.lexsort((centers[:, 1], centers[:, 0], -point_count, is_body))
    grid[:] = 0
    order = order[_apart(centers[order], grid.view(bool).reshape(-1, 2 * width))]
    centers = centers[order]
    return (centers - _MARGIN) * CELL, _features(centers.astype(np.int32) @ [width, 1], count, top, depth, width)


def _grids(number: int, size: int) -> np.ndarray:
    """Zeros (number, size) float32 in memory that the thread reuses: allocation takes longer than everything else."""
    if number * size > len(getattr(_kept, "memory", ())):
        _kept.memory = np.empty(number * size, np.float32)
    grids = _kept.memory[: number * size].reshape(number, size)
    grids[:] = 0
    return grids


def _features(cells: np.ndarray, count: np.ndarray, top: np.ndarray, depth: np.ndarray, width: int) -> np.ndarray:
    """Features of flat cells (K,) and the rings around them, from grids of counts, heights and depths."""
    offset = _offsets(_RINGS[-1])
    square_distance = (offset**2).sum(1)
    # the disc first, then ring by ring
    order = np.argsort(square_distance, kind="stable")
    ends = np.searchsorted(square_distance[order], [(radius + 0.3) ** 2 for radius in _RINGS])
    offset = offset[order[: ends[-1]]]
    rings = [slice(start, end) for start, end in zip([0, *ends[:-1]], ends, strict=True)]
    ring_cells = (offset @ [width, 1])[:, None] + cells
    cell_counts, cell_tops = count[ring_cells], top[ring_cells]
    occupancy = (cell_counts > 0).astype(np.float32)
    features = [np.log1p(cell_counts[ring].sum(0)) for ring in rings]
    features += [occupancy[ring].mean(0) for ring in rings]
    features += [cell_tops[ring].max(0) for ring in rings]
    features += [_EMPTY - depth[ring_cells[ring]].max(0) for ring in rings[:2]]
    # length and width of the occupied area, cells
    occupied_count = np.maximum(occupancy.sum(0), 1)
    x, y = offset.T.astype(np.float32)
    mean_x, mean_y = x @ occupancy / occupied_count, y @ occupancy / occupied_count
    xx, yy = (x * x) @ occupancy / occupied_count - mean_x**2, (y * y) @ occupancy / occupied_count - mean_y**2
    xy = (x * y) @ occupancy / occupied_count - mean_x * mean_y
    spread = np.sqrt((xx - yy) ** 2 / 4 + xy**2)
    features += [np.sqrt(np.maximum((xx + yy) / 2 + sign * spread, 0)) for sign in (1, -1)]
    return np.stack(features, 1).astype(np.float32)


def _smooth(grid: np.ndarray, cells: np.ndarray, values: np.ndarray, width: int) -> None:
    """Adds values (n,) at distinct flat cells (n,) to the square around each in a grid (size,)."""
    for step in _square(_SUMMED, width):
        grid[cells + step] += values


def _maxima(grid: np.ndarray, width: int) -> np.ndarray:
    """Flat cells that are not empty and are the maximum of the square around them."""
    cells = np.flatnonzero(grid > 0)
    for step in (-1, 1, -width, width):
        cells = cells[grid[cells] >= grid[cells + step]]
    return cells[grid[cells] >= grid[_square(_PEAK, width)[:, None] + cells].max(0)]


def _shifted(cells: np.ndarray, count: np.ndarray, width: int) -> np.ndarray:
    """Positions (K, 2) in cells of flat cells (K,), after a few steps to the mean of the points around them."""
    position = _positions(cells, width).astype(np.float32)
    offset = _offsets(_SHIFT).astype(np.float32).T[..., None]
    steps = _square(_SHIFT, width)[:, None]
    for _ in range(_SHIFTS):
        start = position.astype(np.int32)
        center_offset = start + np.float32(0.5) - position
        x, y = offset[0] + center_offset[:, 0], offset[1] + center_offset[:, 1]
        weight = count[steps + (start[:, 0] * width + start[:, 1])]
        weight *= x * x + y * y < (_SHIFT + 0.5) ** 2
        weight_sum = np.maximum(weight.sum(0), 1e-9)
        position[:, 0] += (weight * x).sum(0) / weight_sum
        position[:, 1] += (weight * y).sum(0) / weight_sum
    return position


def _positions(cells: np.ndarray, width: int) -> np.ndarray:
    """Centers (K, 2) in cells of flat cells (K,)."""
    return np.stack([cells // width, cells % width], 1) + 0.5


def _offsets(reach: int) -> np.ndarray:
    side = np.arange(-reach, reach + 1)
    return np.stack(np.meshgrid(side, side, indexing="ij"), -1).reshape(-1, 2)


def _square(reach: int, width: int) -> np.ndarray:
    """Steps (N,) from a flat cell to the cells of the square around it."""
    return _offsets(reach) @ [width, 1]


def _disc(reach: int, width: int) -> np.ndarray:
    """Steps (N,) from a flat cell to the cells of the disc around it."""
    offset = _offsets(reach)
    return offset[(offset**2).sum(1) <= (reach + 0.3) ** 2] @ [width, 1]


def _apart(centers: np.ndarray, is_blocked: np.ndarray) -> np.ndarray:
    """Rows of positions (K, 2) in cells, strongest first, that are `_APART` from all stronger rows that remain.

    is_blocked: False for each half cell, which is precise enough.
    """
    reach = round(2 * _APART / CELL)
    disc = (_offsets(reach) ** 2).sum(1).reshape(2 * reach + 1, -1) < reach**2
    rows = []
    for row, (i, j) in enumerate((centers * 2).astype(np.int64).tolist()):
        if not is_blocked[i, j]:
            rows.append(row)
            is_blocked[i - reach : i + reach + 1, j - reach : j + reach + 1] |= disc
    return np.array(rows, np.int64)
