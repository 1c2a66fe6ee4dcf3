"""From points to integer tables: voxels at three sizes, their parents, and a padded layout. Numpy only.

Legend: B people, M points of all people one after the other, F / M / C in names: fine, mid, coarse level.

The grid's origin is the person's own center, never the cloud's minimum: one stray point cannot move the voxels of the
others (the released DAPT code subtracts the minimum). A parent is the child's index shifted right, as in its pooling.
"""

from dataclasses import dataclass, fields
from typing import Generic, TypeVar

import numpy as np

from lidarpose.errors import InputError

# of a level: numpy's, or torch's tensors
Array = TypeVar("Array")

# half width of the window around the center that reaches the network, meters: arm span plus a step
WINDOW = 2.0
# bits an axis of a voxel index: 2 * WINDOW / 0.04 m < 2 ** 7
_BITS = 8


@dataclass(frozen=True, kw_only=True)
class VoxelLevel(Generic[Array]):
    """Voxels of one size, padded to the most a person has.

    position (B, N, 3) float32 m: mean of the points inside, in the person's frame; log_count (B, N) float32: log of the
    number of points; valid (B, N) bool; parent (B, N) int64: index into the next coarser level (0 where padded);
    neighbors (B, N, 27) int64, where asked for: rows of the 3 x 3 x 3 cells around, N where there is no voxel.
    """

    position: Array
    log_count: Array
    valid: Array
    parent: Array
    neighbors: Array | None = None


@dataclass(frozen=True, kw_only=True)
class VoxelPyramid:
    """All that the network reads of a batch of people, as arrays.

    deviation (B, F, 3) m: standard deviation of the points inside each fine voxel; offset (B, F, 3): mean of the points
    from the voxel's center, in voxels; view (B, 5): unit vector to the sensor, log of the range in meters, 1 if the
    sensor's position is known (else all zero); point_voxel (M,): row of the padded (B * F) fine level of every point,
    -1 for a point outside the window or thinned away.
    """

    fine: VoxelLevel[np.ndarray]
    mid: VoxelLevel[np.ndarray]
    coarse: VoxelLevel[np.ndarray]
    deviation: np.ndarray
    offset: np.ndarray
    view: np.ndarray
    point_voxel: np.ndarray

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays by dotted name ("fine.position"), for tensors, ONNX inputs and tests."""
        out: dict[str, np.ndarray] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, VoxelLevel):
                tables = {f"{field.name}.{f.name}": getattr(value, f.name) for f in fields(value)}
                out |= {name: table for name, table in tables.items() if table is not None}
            else:
                out[field.name] = value
        return out


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
    """Voxels of people, at three sizes.

    A person of more than `max_voxels` fine voxels keeps that many. Every person of at least one point inside the window
    has at least one voxel at every level; one of none has only padding. Twin: `voxelize_reference` of the tests.

    Args:
        points: (M, 3) m, each in its person's frame; people one after the other.
        lengths: (B,) points of each person.
        grid: edge of a fine voxel in meters; the mid and coarse ones are 2 and 4 times as wide.
        max_voxels: fine voxels a person at the most.
        view: (B, 5), see `view_features`.
        seeds: (B,) whole numbers: the voxels that are kept are random ones, by the person's own seed; None: evenly
            spread ones.
        neighbors: also make the tables of the mid and coarse level that convolutions read.

    Raises InputError for a grid too fine for the voxel index.
    """
    if WINDOW / grid > 1 << (_BITS - 1):
        raise InputError(f"grid must be at least {WINDOW / (1 << (_BITS - 1)):.4f} m, got {grid}")
    people = len(lengths)
    kept, key, voxel_of_point, count = _fine_voxels(points, lengths, grid, max_voxels, seeds)
    xyz = points[kept].astype(np.float64)
    mean = _segment_sum(voxel_of_point, xyz, len(key)) / count[:, None]
    square = _segment_sum(voxel_of_point, xyz**2, len(key)) / count[:, None]
    deviation = np.sqrt(np.maximum(square - mean**2, 0))
    # from the voxel's own cell: a mean on its border may round into the next one
    offset = mean / grid - _cells(key) - 0.5

    levels, slots = _levels(key, mean, count, people, neighbors)
    point_voxel = np.full(len(points), -1)
    point_voxel[kept] = slots.row[voxel_of_point]
    return VoxelPyramid(
        fine=levels[0],
        mid=levels[1],
        coarse=levels[2],
        deviation=slots.pad(deviation.astype(np.float32)),
        offset=slots.pad(offset.astype(np.float32)),
        view=np.zeros((people, 5), np.float32) if view is None else view.astype(np.float32),
        point_voxel=point_voxel,
    )


def view_features(center: np.ndarray, sensor_origin: np.ndarray | None) -> np.ndarray:
    """(5,) for `VoxelPyramid.view`: unit vector from `center` to the sensor, log range, known; zeros for None."""
    if sensor_origin is None:
        return np.zeros(5, np.float32)
    toward = np.asarray(sensor_origin, float) - center
    distance = max(float(np.linalg.norm(toward)), 0.1)
    return np.array([*(toward / distance), np.log(distance), 1.0], np.float32)


class _Slots:
    """Where the sorted rows of one level go in the padded block."""

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
    points: np.ndarray, lengths: np.ndarray, grid: float, most: int, seeds: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Indices (K,) of the points that count, sorted keys (V,) of their voxels, the voxel (K,) of each point, and how
    many points (V,) each voxel has."""
    people = len(lengths)
    kept = np.flatnonzero((np.abs(points) < WINDOW).all(1))
    person = np.repeat(np.arange(people), lengths)[kept]
    cell = np.floor(points[kept] / grid).astype(np.int64) + (1 << (_BITS - 1))
    key = ((person << _BITS | cell[:, 0]) << _BITS | cell[:, 1]) << _BITS | cell[:, 2]
    voxel_key, voxel_of_point, count = np.unique(key, return_inverse=True, return_counts=True)
    chosen = _thin(voxel_key >> (3 * _BITS), people, most, seeds)
    if chosen is None:
        return kept, voxel_key, voxel_of_point, count
    number = np.full(len(voxel_key), -1)
    number[chosen] = np.arange(len(chosen))
    voxel_of_point = number[voxel_of_point]
    left = voxel_of_point >= 0
    return kept[left], voxel_key[chosen], voxel_of_point[left], count[chosen]


def _levels(
    key: np.ndarray, mean: np.ndarray, count: np.ndarray, people: int, neighbors: bool
) -> tuple[list[VoxelLevel], _Slots]:
    """The three levels over fine voxels of sorted keys (V,), and where the fine ones lie."""
    keys, means, counts, parents = [key], [mean], [count], []
    total = mean * count[:, None]
    for _ in range(2):
        key, parent = np.unique(_parent(keys[-1]), return_inverse=True)
        total = _segment_sum(parent, total, len(key))
        keys.append(key)
        counts.append(np.bincount(parent, counts[-1], len(key)))
        means.append(total / counts[-1][:, None])
        parents.append(parent)
    slots = [_Slots(key >> (3 * _BITS), people) for key in keys]
    levels = []
    for k, own in enumerate(slots):
        parent = slots[k + 1].slot[parents[k]] if k < 2 else np.zeros(len(keys[k]), np.int64)
        near = own.pad(_neighbors(keys[k], own), own.shape[1]) if neighbors and k > 0 else None
        levels.append(
            VoxelLevel(
                position=own.pad(means[k].astype(np.float32)),
                log_count=own.pad(np.log(counts[k]).astype(np.float32)),
                valid=own.pad(np.ones(len(keys[k]), bool)),
                parent=own.pad(parent),
                neighbors=near,
            )
        )
    return levels, slots[0]


def _cells(key: np.ndarray) -> np.ndarray:
    """(V, 3) int: the cell of each fine voxel, that of the origin's corner being 0."""
    return np.stack([key >> shift & (1 << _BITS) - 1 for shift in (2 * _BITS, _BITS, 0)], 1) - (1 << (_BITS - 1))


def _neighbors(key: np.ndarray, slots: _Slots) -> np.ndarray:
    """(V, 27) int: slots of the voxels around each, x slowest; the padded width where there is none."""
    # cells reach neither end of their bits: no step runs over into another axis
    steps = np.array([[-1], [0], [1]]) * np.array([1 << (2 * _BITS), 1 << _BITS, 1])
    wanted = key[:, None] + (steps[:, None, None, 0] + steps[:, None, 1] + steps[:, 2]).ravel()
    place = np.minimum(np.searchsorted(key, wanted), max(len(key) - 1, 0))
    return np.where(key[place] == wanted, slots.slot[place], slots.shape[1]) if len(key) else wanted


def _parent(key: np.ndarray) -> np.ndarray:
    """Keys of voxels twice as wide: every axis' index shifted right by one, the person kept."""
    axis = (1 << _BITS) - 1
    x, y, z = key >> (2 * _BITS) & axis, key >> _BITS & axis, key & axis
    return ((key >> (3 * _BITS) << _BITS | x >> 1) << _BITS | y >> 1) << _BITS | z >> 1


def _segment_sum(segment: np.ndarray, values: np.ndarray, size: int) -> np.ndarray:
    return np.stack([np.bincount(segment, values[:, k], size) for k in range(values.shape[1])], 1)


def _thin(person: np.ndarray, people: int, most: int, seeds: np.ndarray | None) -> np.ndarray | None:
    """Indices of the voxels to keep, in order, or None where nobody has more than `most`."""
    lengths = np.bincount(person, minlength=people)
    if lengths.max(initial=0) <= most:
        return None
    start = np.cumsum(lengths) - lengths
    keep = []
    for b in range(people):
        if lengths[b] <= most:
            pick = np.arange(lengths[b])
        elif seeds is None:
            pick = np.arange(most) * lengths[b] // most
        else:
            pick = np.sort(np.random.default_rng(seeds[b]).choice(lengths[b], most, replace=False))
        keep.append(start[b] + pick)
    return np.concatenate(keep)
