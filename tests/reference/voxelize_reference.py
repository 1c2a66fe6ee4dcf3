"""Slow reference implementation of `voxelize`, with dictionaries of voxels and loops over people and points."""

from collections import defaultdict

import numpy as np

from lidarpose.models.voxelize import WINDOW, VoxelLevel, VoxelPyramid

Cell = tuple[int, int, int]


def voxelize_reference(
    points: np.ndarray,
    lengths: np.ndarray,
    *,
    grid: float,
    max_voxels: int,
    view: np.ndarray | None = None,
    seeds: np.ndarray | None = None,
    neighbors: bool = False,
) -> VoxelPyramid:
    """Same arguments and result as `voxelize`; with `seeds` the same random numbers are drawn."""
    fine, mid, coarse = [], [], []
    start = 0
    for b, length in enumerate(lengths):
        voxels: dict[Cell, list[int]] = defaultdict(list)
        for m in range(start, start + length):
            if all(abs(x) < WINDOW for x in points[m]):
                voxels[tuple(int(np.floor(x / grid)) for x in points[m])].append(m)
        start += length
        cells = _thinned(sorted(voxels), max_voxels, None if seeds is None else seeds[b])
        fine.append({cell: voxels[cell] for cell in cells})
        mid.append(_merged(fine[-1]))
        coarse.append(_merged(mid[-1]))

    shape = (len(lengths), max([1, *map(len, fine)]))
    deviation, offset = np.zeros((*shape, 3), np.float32), np.zeros((*shape, 3), np.float32)
    point_voxel = np.full(len(points), -1)
    for b, voxels in enumerate(fine):
        for n, (cell, members) in enumerate(voxels.items()):
            inside = points[members].astype(float)
            deviation[b, n] = inside.std(0)
            offset[b, n] = inside.mean(0) / grid - cell - 0.5
            point_voxel[members] = b * shape[1] + n
    return VoxelPyramid(
        fine=_level(points, fine, mid),
        mid=_level(points, mid, coarse, neighbors),
        coarse=_level(points, coarse, None, neighbors),
        deviation=deviation,
        offset=offset,
        view=np.zeros((len(lengths), 5), np.float32) if view is None else view.astype(np.float32),
        point_voxel=point_voxel,
    )


def _thinned(cells: list[Cell], most: int, seed: int | None) -> list[Cell]:
    if len(cells) <= most:
        return cells
    if seed is None:
        return [cells[k * len(cells) // most] for k in range(most)]
    return [cells[k] for k in sorted(np.random.default_rng(seed).choice(len(cells), most, replace=False))]


def _merged(voxels: dict[Cell, list[int]]) -> dict[Cell, list[int]]:
    """Merges voxels into cells of twice the size, sorted by cell."""
    wider: dict[Cell, list[int]] = defaultdict(list)
    for cell, members in voxels.items():
        wider[_parent(cell)] += members
    return dict(sorted(wider.items()))


def _parent(cell: Cell) -> Cell:
    return tuple(x // 2 for x in cell)


def _level(points: np.ndarray, people: list[dict], parents: list[dict] | None, neighbors: bool = False) -> VoxelLevel:
    shape = (len(people), max([1, *map(len, people)]))
    position, log_count = np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32)
    valid, parent = np.zeros(shape, bool), np.zeros(shape, np.int64)
    for b, voxels in enumerate(people):
        for n, (cell, members) in enumerate(voxels.items()):
            position[b, n] = points[members].astype(float).mean(0)
            log_count[b, n] = np.log(len(members))
            valid[b, n] = True
            if parents is not None:
                parent[b, n] = list(parents[b]).index(_parent(cell))
    around = _around(people, shape) if neighbors else None
    return VoxelLevel(position=position, log_count=log_count, valid=valid, parent=parent, neighbors=around)


def _around(people: list[dict], shape: tuple[int, int]) -> np.ndarray:
    """Indices of the voxels in the 27 cells around each voxel."""
    rows = np.full((*shape, 27), shape[1])
    for b, voxels in enumerate(people):
        number = {cell: n for n, cell in enumerate(voxels)}
        for (x, y, z), n in number.items():
            cells = [(x + i, y + j, z + k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)]
            rows[b, n] = [number.get(cell, shape[1]) for cell in cells]
    return rows
