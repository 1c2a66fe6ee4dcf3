"""The ground under a map: a height map of blocks, each with a plane of its own.

Over hundreds of meters the ground leaves any one plane, to which `estimate_ground` returns where nothing is observed,
as behind walls and cars.
"""

import numpy as np

from lidarpose.models.detector.ground import CELL, Ground, estimate_ground, fill_holes

# points that extend farther than this along x or y are a map, not a scan, m
_MAP = 400.0
# side of a block, and the margin in which its neighbors' points are used, too, m
_BLOCK, _MARGIN = 64, 48
# as `near` of `estimate_ground`, m: no sensor is in the middle of a block, but perhaps a roof
_NEAR = 20.0
# maximum extent of the height map, m: beyond it, the ground has the height of its border
MOST_EXTENT = 4096


def ground_under(points: np.ndarray, origin: np.ndarray | None) -> Ground | None:
    """The ground under a scan or a map, points (n, 3) m. Arguments and result: as for `estimate_ground`."""
    if origin is not None or not len(points) or np.ptp(points[:, :2], axis=0).max() < _MAP:
        return estimate_ground(points, origin)
    low, high = (f(points[:, :2], axis=0).astype(float) for f in (np.min, np.max))
    middle = (low + high) / 2
    low = np.floor(np.maximum(low, middle - MOST_EXTENT / 2) / CELL) * CELL
    shape = np.ceil((np.minimum(high, middle + MOST_EXTENT / 2) - low) / CELL).astype(int).clip(min=1)
    heights = np.full(shape, np.nan, np.float32)
    for i in range(0, shape[0], _BLOCK):
        row_points = points[_is_within(points[:, 0], low[0] + i * CELL)]
        for j in range(0, shape[1], _BLOCK):
            ground = estimate_ground(row_points[_is_within(row_points[:, 1], low[1] + j * CELL)], near=_NEAR)
            if ground is not None:
                block = heights[i : i + _BLOCK, j : j + _BLOCK]
                x = low[0] + CELL * (i + np.arange(block.shape[0]) + 0.5)
                y = low[1] + CELL * (j + np.arange(block.shape[1]) + 0.5)
                block[:] = ground.at(np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)).reshape(block.shape)
    if np.isnan(heights).all():
        return None
    level = np.nanmedian(heights)
    return Ground(corner=low, heights=(fill_holes(heights - level) + level).astype(np.float32))


def _is_within(values: np.ndarray, start: float) -> np.ndarray:
    """(n,) bool: coordinates (n,) m in the block from `start` on, or in its margin."""
    return (values >= start - _MARGIN) & (values < start + _BLOCK + _MARGIN)
