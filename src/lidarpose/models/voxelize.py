"""Converts points to integer tables: voxels of three sizes, their parents, and a padded layout. Numpy only.

Legend: B people, M points of all people concatenated, F / M / C in names: fine, mid, coarse level.

The grid's origin is the person's center, not the cloud's minimum, so one stray point cannot shift the voxels of the
other points (the released DAPT code subtracts the minimum). A parent's index is the child's index shifted right, as in
DAPT's pooling.
"""

from dataclasses import dataclass, fields
from typing import Generic, TypeVar

import numpy as np

from lidarpose.errors import InputError

# array type of a level: a numpy array or a torch tensor
Array = TypeVar("Array")

# half width of the window around the center that reaches the network, meters: arm span plus a step
WINDOW = 2.0
# bits per axis of a voxel index: 2 * WINDOW / 0.04 m < 2 ** 7
_BITS = 8
# index of the cell at the person's center
_HALF = 1 << (_BITS - 1)


@dataclass(frozen=True, kw_only=True)
class VoxelLevel(Generic[Array]):
    """Voxels of one size, padded to the largest number of voxels of a person in the batch.

    position (B, N, 3) float32 m: mean of the points inside, in the person's frame; log_count (B, N) float32: log of the
    number of points; valid (B, N) bool; parent (B, N) int64: index into the next coarser level (0 for padding);
    neighbors (B, N, 27) int64, if requested: rows of the surrounding 3 x 3 x 3 cells, N for an empty cell.
    """

    position: Array
    log_count: Array
    valid: Array
    parent: Array
    neighbors: Array | None = None


@dataclass(frozen=True, kw_only=True)
class VoxelPyramid:
    """All network inputs for a batch of people, as arrays.

    deviation (B, F, 3) m: standard deviation of the points inside each fine voxel; offset (B, F, 3): mean of the points
    relative to the voxel's center, in voxels; view (B, 5): unit vector to the sensor, log of the range in meters, 1 if
    the sensor position is known (else all zero); point_voxel (M,): row of each point's voxel in the padded fine level,
    flattened to B * F; -1 for a point outside the window or in a voxel dropped by subsampling.
    """

    fine: VoxelLevel[np.ndarray]
    mid: VoxelLevel[np.ndarray]
    coarse: VoxelLevel[np.ndarray]
    deviation: np.ndarray
    offset: np.ndarray
    view: np.ndarray
    point_voxel: np.ndarray

    def arrays(self) -> dict[str, np.ndarray]:
        """The network's inputs by dotted name ("fine.position"): all fields but `point_voxel`."""
        arrays: dict[str, np.ndarray] = {}
        for name in ("fine", "mid", "coarse"):
            level = getattr(self, name)
            arrays |= {f"{name}.{f.name}": getattr(level, f.name) for f in fields(VoxelLevel)}
        arrays |= {"deviation": self.deviation, "offset": self.offset, "view": self.view}
        return {name: array for name, array in arrays.items() if array is not None}


def voxelize(
    points: np.ndarray,
    lengths: np.ndarray,
    *,
    grid: float,
    max_voxels: int,
    view: np.ndarray | None = None,
    seeds: np.ndarray | None = None,
    neighbors: bool = False,
) -> VoxelPyramid:
    """Voxelizes people at three sizes.

    A person with more than `max_voxels` fine voxels is subsampled to that many. Every person with at least one point
    inside the window has at least one voxel at every level; a person without any has only padding. The tests hold a
    reference implementation, `voxelize_reference`.

    Args:
        points: (M, 3) m, each in its person's frame; the points of all people concatenated.
        lengths: (B,) number of points of each person.
        grid: edge of a fine voxel in meters; mid and coarse voxels are 2 and 4 times as wide.
        max_voxels: maximum number of fine voxels per person.
        view: (B, 5), see `view_features`.
        seeds: (B,) integers: each person's voxels are subsampled at random with that person's seed; None: at even
            intervals.
        neighbors: also build the neighbor tables of the mid and coarse level, which convolutions read.

    Raises InputError for a grid too fine for the voxel index.
    """
    if WINDOW / grid > _HALF:
        raise InputError(f"grid must be at least {WINDOW / _HALF:.4f} m, got {grid}")
    lengths = np.asarray(lengths)
    rows, key, voxel_of_point, count = _fine_voxels(points, lengths, grid, max_voxels, seeds)
    xyz = points[rows].astype(np.float64)
    mean = _segment_sum(voxel_of_point, xyz, len(key)) / count[:, None]
    mean_square = _segment_sum(voxel_of_point, xyz**2, len(key)) / count[:, None]
    deviation = np.sqrt(np.maximum(mean_square - mean**2, 0))
    # relative to the voxel's own cell: a mean on its border may round into the next cell
    offset = mean / grid - (np.stack(_axes(key), 1) - _HALF) - 0.5

    (fine, mid, coarse), slots = _levels(key, mean, count, len(lengths), neighbors)
    point_voxel = np.full(len(points), -1)
    point_voxel[rows] = slots.row[voxel_of_point]
    return VoxelPyramid(
        fine=fine,
        mid=mid,
        coarse=coarse,
        deviation=slots.pad(deviation.astype(np.float32)),
        offset=slots.pad(offset.astype(np.float32)),
        view=np.zeros((len(lengths), 5), np.float32) if view is None else view.astype(np.float32),
        point_voxel=point_voxel,
    )


def view_features(center: np.ndarray, sensor_origin: np.ndarray | None) -> np.ndarray:
    """(5,) for `VoxelPyramid.view`: unit vector from `center` to the sensor, log range, 1; all zeros for None."""
    if sensor_origin is None:
        return np.zeros(5, np.float32)
    to_sensor = np.asarray(sensor_origin, float) - center
    distance = max(float(np.linalg.norm(to_sensor)), 0.1)
    return np.array([*(to_sensor / distance), np.log(distance), 1.0], np.float32)


class _Slots:
    """Positions of one level's sorted rows in the padded block."""

    def __init__(self, person: np.ndarray, people: int):
        lengths = np.bincount(person, minlength=people)
        start = np.cumsum(lengths) - lengths
        self.shape = (people, max(int(lengths.max(initial=0)), 1))
        self.slot = np.arange(len(person)) - start[person]
        self.row = person * self.shape[1] + self.slot

    def pad(self, values: np.ndarray, fill: int = 0) -> np.ndarray:
        out = np.full((self.shape[0] * self.shape[1],) + values.shape[1:], fill, values.dtype)
        out[self.row] = values
        return out.reshape(self.shape + values.shape[1:])


def _fine_voxels(
    points: np.ndarray, lengths: np.ndarray, grid: float, max_voxels: int, seeds: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Indices (K,) of the points used, sorted keys (V,) of their voxels, the voxel (K,) of each point, and the number
    of points (V,) per voxel."""
    rows = np.flatnonzero((np.abs(points) < WINDOW).all(1))
    person = np.repeat(np.arange(len(lengths)), lengths)[rows]
    x, y, z = np.floor(points[rows] / grid).astype(np.int64).T + _HALF
    key, voxel, count = np.unique(_key(person, x, y, z), return_inverse=True, return_counts=True)
    voxel_counts = np.bincount(key >> (3 * _BITS), minlength=len(lengths))
    if voxel_counts.max(initial=0) <= max_voxels:
        return rows, key, voxel, count
    start = np.cumsum(voxel_counts) - voxel_counts
    kept_voxels = np.concatenate([start[b] + _thinned(n, max_voxels, seeds, b) for b, n in enumerate(voxel_counts)])
    new_index = np.full(len(key), -1)
    new_index[kept_voxels] = np.arange(len(kept_voxels))
    voxel = new_index[voxel]
    has_voxel = voxel >= 0
    return rows[has_voxel], key[kept_voxels], voxel[has_voxel], count[kept_voxels]


def _thinned(count: int, max_voxels: int, seeds: np.ndarray | None, person: int) -> np.ndarray:
    """Indices of the voxels of a person that remain after subsampling, in ascending order."""
    if count <= max_voxels:
        return np.arange(count)
    if seeds is None:
        return np.arange(max_voxels) * count // max_voxels
    return np.sort(np.random.default_rng(seeds[person]).choice(count, max_voxels, replace=False))


def _levels(
    key: np.ndarray, mean: np.ndarray, count: np.ndarray, people: int, neighbors: bool
) -> tuple[list[VoxelLevel], _Slots]:
    """The three levels above fine voxels with sorted keys (V,), and the slots of the fine level."""
    levels: list[VoxelLevel] = []
    fine_slots = slots = _Slots(key >> (3 * _BITS), people)
    total = mean * count[:, None]
    for level in range(3):
        parent = slot_of_parent = np.zeros(len(key), np.int64)
        if level < 2:
            x, y, z = _axes(key)
            parent_key, parent = np.unique(_key(key >> (3 * _BITS), x >> 1, y >> 1, z >> 1), return_inverse=True)
            parent_slots = _Slots(parent_key >> (3 * _BITS), people)
            slot_of_parent = parent_slots.slot[parent]
        levels.append(
            VoxelLevel(
                position=slots.pad((total / count[:, None] if level else mean).astype(np.float32)),
                log_count=slots.pad(np.log(count).astype(np.float32)),
                valid=slots.pad(np.ones(len(key), bool)),
                parent=slots.pad(slot_of_parent),
                neighbors=slots.pad(_neighbors(key, slots), slots.shape[1]) if neighbors and level else None,
            )
        )
        if level < 2:
            total, count = _segment_sum(parent, total, len(parent_key)), np.bincount(parent, count, len(parent_key))
            key, slots = parent_key, parent_slots
    return levels, fine_slots


def _key(person: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """One integer per person and cell, which sorts by person, then x, y, z."""
    return ((person << _BITS | x) << _BITS | y) << _BITS | z


def _axes(key: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x, y and z of `_key`."""
    mask = (1 << _BITS) - 1
    return key >> (2 * _BITS) & mask, key >> _BITS & mask, key & mask


def _neighbors(key: np.ndarray, slots: _Slots) -> np.ndarray:
    """(V, 27) int: slots of the voxels around each voxel, x slowest; the padded width for an empty cell."""
    # cell indices never reach either end of their bit range, so a step cannot overflow into another axis
    steps = _key(np.zeros(1, np.int64), *np.mgrid[:3, :3, :3].reshape(3, 27)) - _key(*np.array([0, 1, 1, 1]))
    neighbor_key = key[:, None] + steps
    row = np.minimum(np.searchsorted(key, neighbor_key), max(len(key) - 1, 0))
    return np.where(key[row] == neighbor_key, slots.slot[row], slots.shape[1]) if len(key) else neighbor_key


def _segment_sum(segment: np.ndarray, values: np.ndarray, size: int) -> np.ndarray:
    return np.stack([np.bincount(segment, values[:, k], size) for k in range(values.shape[1])], 1)
