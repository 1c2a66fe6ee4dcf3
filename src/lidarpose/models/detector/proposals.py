"""Places where a person may stand: columns that hold more points above the ground than what is around them.

Points 0.3-2.1 m above the ground are counted on a grid of 10 cm. Peaks of the smoothed counts, drawn to the mean of
the points around them, give one kind of candidate; peaks of the finer counts of each column's upper end, where two
people side by side are still apart, give another. Nothing is clustered, so a person at a wall or a hedge has a
candidate as good as one in the open.
"""

from collections.abc import Iterator

import numpy as np

from lidarpose.models.detector.ground import Ground

# m: of a cell; heights above ground that count; a tile of the grid, and how much tiles overlap
CELL = 0.1
LOW, HIGH = 0.3, 2.1
_TILE, _OVERLAP = 64.0, 1.0
# what a candidate must have: points, the height of its top over the ground, and from its lowest to its highest point
LEAST_POINTS = 5
_LEAST_TOP, _LEAST_PART, _LEAST_EXTENT = 0.6, 0.45, 0.25
# a head or shoulder that looks over something may be as low as this where its top is that high over the ground, m
_LEAST_HEAD, _HEAD_TOP = 0.08, 1.1
# cells to each side: of the surroundings that a peak tops, of the mean shift, of a candidate's column, of the grid
_PEAK, _SHIFT, _COLUMN, _MARGIN = 3, 4, 3, 16
_SHIFTS = 2
# of heads: points so far below the highest point within 0.3 m belong to it, m
_HEAD = 0.3
_TALLEST = 2.05
# a column is dropped this near to a stronger one, and a head this near to any, m
_APART, _HEADS_APART = 0.3, 0.3


def propose(points: np.ndarray, ground: Ground, *, limit: int = 600, heights: np.ndarray | None = None) -> np.ndarray:
    """Centers (K, 3) m of columns that may be people: x, y, and z of the ground there; the strongest first.

    Args:
        points: (n, 3) m, z up.
        ground: under them.
        limit: the most that are returned.
        heights: (n,) m of the points above the ground, where they are known.
    """
    if heights is None:
        heights = heights_above(points, ground)
    band = (heights > LOW) & (heights < HIGH)
    xy, heights = np.asarray(points)[band, :2], heights[band]
    tile_xy, strengths = [np.zeros((0, 2))], [np.zeros(0)]
    for corner, inner, rows in _tiles(xy):
        tile_centers, tile_strength = _peaks(xy[rows] - corner, heights[rows])
        tile_centers = tile_centers + corner
        own = ((tile_centers >= inner[0]) & (tile_centers < inner[1])).all(1)
        tile_xy.append(tile_centers[own])
        strengths.append(tile_strength[own])
    xy = np.concatenate(tile_xy)[np.argsort(-np.concatenate(strengths), kind="stable")[:limit]]
    return np.concatenate([xy, ground.at(xy)[:, None]], 1)


def heights_above(points: np.ndarray, ground: Ground) -> np.ndarray:
    """Heights (n,) float32 m of points (n, 3) m above the ground."""
    points = np.asarray(points)
    return (points[:, 2] - ground.at(points[:, :2])).astype(np.float32)


def _tiles(xy: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray | slice]]:
    """(corner, bounds (2, 2) of what is its own, rows) of tiles with points in them: bounded grids for any extent."""
    if not len(xy):
        return
    start = np.floor(xy.min(0) / CELL) * CELL - _OVERLAP
    if (xy.max(0) - start < 1.5 * _TILE).all():
        yield start, np.array([[-np.inf] * 2, [np.inf] * 2]), slice(None)
        return
    tile = np.floor((xy - start) / _TILE).astype(np.int64)
    for i, j in np.unique(tile, axis=0):
        low = start + np.array([i, j]) * _TILE
        inside = ((xy >= low - _OVERLAP) & (xy < low + _TILE + _OVERLAP)).all(1)
        yield low - _OVERLAP, np.stack([low, low + _TILE]), np.flatnonzero(inside)


def _peaks(xy: np.ndarray, heights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centers (K, 2) m and strengths (K,) of a tile's candidates. xy (n, 2) m from its corner, heights (n,) m."""
    cell = (xy * (1 / CELL)).astype(np.int32) + _MARGIN
    width = int(cell[:, 1].max()) + _MARGIN + 1
    size = (int(cell[:, 0].max()) + _MARGIN + 1) * width
    flat = cell[:, 0] * width + cell[:, 1]
    count = np.bincount(flat, minlength=size).astype(np.float32)
    top, bottom = np.zeros(size, np.float32), np.full(size, HIGH + 1, np.float32)
    np.maximum.at(top, flat, heights)
    np.minimum.at(bottom, flat, heights)

    body = _shifted(_maxima(_smoothed(_smoothed(count, width), width), width), count, width)
    occupied = np.flatnonzero(count)
    highest = np.zeros(size, np.float32)
    highest[occupied] = top[occupied[:, None] + _disc(_COLUMN, width)].max(1)
    # nobody's head reaches through the band: a wall
    highest[highest > _TALLEST] = np.inf
    is_head = heights > highest[flat] - _HEAD
    heads = np.bincount(flat[is_head], minlength=size).astype(np.float32)
    head = _positions(_maxima(_smoothed(heads, width), width), width)

    centers = np.concatenate([body, head])
    column = (centers.astype(np.int32) @ [width, 1])[:, None] + _disc(_COLUMN, width)
    points, highest, lowest = count[column].sum(1), top[column].max(1), bottom[column].min(1)
    is_tall = highest - lowest > _LEAST_EXTENT
    is_tall |= (highest - lowest > _LEAST_HEAD) & (highest > _HEAD_TOP) & (points >= 2 * LEAST_POINTS)
    enough = (points >= LEAST_POINTS) & (highest > _LEAST_TOP) & is_tall
    # cut off by the field of view
    enough |= (points >= 6 * LEAST_POINTS) & (highest > _LEAST_PART) & (highest - lowest > _LEAST_HEAD)
    is_body = np.arange(len(centers)) < len(body)
    centers, points, is_body = centers[enough], points[enough], is_body[enough]
    # where two are equally strong, the order of places: not that of the points
    order = np.lexsort((centers[:, 1], centers[:, 0], -points, is_body))
    order = order[_apart(centers[order], np.where(is_body, _APART, _HEADS_APART)[order])]
    return (centers[order] - _MARGIN) * CELL, points[order]


def _smoothed(values: np.ndarray, width: int) -> np.ndarray:
    """Sums over squares of 3 x 3 cells of a flat grid (size,) with empty margins."""
    for step in (1, width):
        total = values.copy()
        total[step:] += values[:-step]
        total[:-step] += values[step:]
        values = total
    return values


def _maxima(values: np.ndarray, width: int) -> np.ndarray:
    """Flat cells that hold something and are the maximum of the square around them."""
    inner = values[width:-width]
    highest = (
        (inner > 0) & (inner >= values[width - 1 : -width - 1]) & (inner >= values[width + 1 : -width + 1 or None])
    )
    highest &= (inner >= values[: -2 * width]) & (inner >= values[2 * width :])
    cells = np.flatnonzero(highest) + width
    return cells[values[cells] >= values[cells[:, None] + _square(_PEAK, width)].max(1)]


def _shifted(cells: np.ndarray, count: np.ndarray, width: int) -> np.ndarray:
    """Positions (K, 2) in cells of flat cells after a few steps to the mean of the points around them."""
    position = _positions(cells, width)
    offset = _offsets(_SHIFT)
    for _ in range(_SHIFTS):
        start = position.astype(np.int32)
        away = start[:, None] + 0.5 + offset - position[:, None]
        weight = count[(start @ [width, 1])[:, None] + offset @ [width, 1]] * ((away**2).sum(-1) < (_SHIFT + 0.5) ** 2)
        position = position + (weight[..., None] * away).sum(1) / np.maximum(weight.sum(1), 1e-9)[:, None]
    return position


def _positions(cells: np.ndarray, width: int) -> np.ndarray:
    """Middles (K, 2) in cells of flat cells (K,)."""
    return np.stack([cells // width, cells % width], 1) + 0.5


def _offsets(reach: int) -> np.ndarray:
    side = np.arange(-reach, reach + 1)
    return np.stack(np.meshgrid(side, side, indexing="ij"), -1).reshape(-1, 2)


def _square(reach: int, width: int) -> np.ndarray:
    """Steps (N,) from a flat cell to those of the square around it."""
    return _offsets(reach) @ [width, 1]


def _disc(reach: int, width: int) -> np.ndarray:
    """Steps (N,) from a flat cell to those of the disc around it."""
    offset = _offsets(reach)
    return offset[(offset**2).sum(1) <= (reach + 0.3) ** 2] @ [width, 1]


def _apart(centers: np.ndarray, room: np.ndarray) -> np.ndarray:
    """Rows of positions (K, 2) in cells that have `room` (K,) m to all earlier ones that stay."""
    # half a cell is exact enough
    cells = (centers * 2).astype(np.int64)
    reaches = np.rint(room * (2 / CELL)).astype(int)
    most = int(reaches.max(initial=0))
    discs = {reach: np.hypot(*np.indices((2 * reach + 1,) * 2) - reach) < reach for reach in set(reaches.tolist())}
    taken = np.zeros(cells.max(0, initial=0) + 2 * most + 1, bool)
    rows = []
    for row, ((i, j), reach) in enumerate(zip((cells + most).tolist(), reaches.tolist(), strict=True)):
        around = taken[i - reach : i + reach + 1, j - reach : j + reach + 1]
        if not (around & discs[reach]).any():
            rows.append(row)
            taken[i, j] = True
    return np.array(rows, np.int64)
