"""Converts people's points to integer tables: voxels, levels, neighbors, patches. Numpy only.

Legend: B people, n points of a cloud, M voxels of all people at a level, concatenated, T taps of a kernel, P pairs of
neighbors, W children at most, N voxels per person at most, Q patches, K voxels per patch at most, O curves.

Paper (via Point Transformer V3): points of a large cloud are sorted along a curve and cut into patches, within which
attention is full.

Voxels are in Z-order within each person, at every level: the order of points never matters, and the children of a
parent are adjacent in memory. A person without points gets one voxel at the center: every level then has a row for
every person, and the other people in the batch are not affected.
"""

from dataclasses import dataclass
from typing import Any, Generic

import numpy as np

from lidarpose.errors import InputError, check_name
from lidarpose.models.dapt.dapt_config import CELL_BITS, DaptConfig
from lidarpose.models.voxelize import Array

# bits per axis of a neighbor's cell: one more, so that a step across the edge hits no cell
_WIDE = CELL_BITS + 1
_MOST_PEOPLE = 1 << (63 - 3 * _WIDE)
# table layouts for convolutions and attention: see `build_tables`
LAYOUTS = ("ragged", "padded")


@dataclass(frozen=True, kw_only=True)
class Neighbors(Generic[Array]):
    """The occupied cells around each voxel; taps in the order of a kernel's (x, y, z) offsets, without the middle tap.

    ragged: source (P,) rows of the neighbors, tap by tap; counts (T,) pairs of each tap (0 for the middle one); target
    (P,) the rows that they are neighbors of. padded: table (M, T) rows, M for an empty cell. Fields of the other layout
    are None.
    """

    source: Array | None = None
    target: Array | None = None
    counts: Array | None = None
    table: Array | None = None


@dataclass(frozen=True, kw_only=True)
class Level(Generic[Array]):
    """Voxels of one width.

    lengths (B,): voxels of each person, at least 1; near: neighbors of 3 x 3 x 3; parent (M,): row of the next level,
    None at the last; children (M', W): rows of this level under each row of the next, padded with the first, None at
    the last; slots (B, N): rows of each person, padded with the first; valid (B, N) bool.

    Patches: sequence (O, M) rows in the order of each curve, O = 1 if no person exceeds the patch; patch_lengths (Q,):
    number of voxels of each consecutive patch; in the padded layout patch_slots (O, Q, K) rows, patch_valid (Q, K),
    None if all are valid, and patch_place (O, M), the index of each row among the Q * K.
    """

    lengths: Array
    near: Neighbors[Array]
    parent: Array | None
    children: Array | None
    slots: Array
    valid: Array
    sequence: Array
    patch_lengths: Array
    patch_slots: Array | None = None
    patch_valid: Array | None = None
    patch_place: Array | None = None


@dataclass(frozen=True, kw_only=True)
class Tables(Generic[Array]):
    """The network's inputs for a batch of people, as numpy arrays or torch tensors.

    features (M, 3) float32 m: the kept point of each voxel of level 0; stem: its neighbors of 5 x 5 x 5; levels, fine
    to coarse; kept (M,): index of the kept point among all points, -1 for the placeholder of a person without points;
    point_voxel (all points,): each point's row of level 0.
    """

    features: Array
    stem: Neighbors[Array]
    levels: tuple[Level[Array], ...]
    kept: Array
    point_voxel: Array


def build_tables(
    clouds: list[np.ndarray], config: DaptConfig, *, layout: str = "ragged", rng: np.random.Generator | None = None
) -> Tables[np.ndarray]:
    """Tables of people's clouds, each (n, 3) m in its person's frame; n may be 0.

    layout: "ragged", pair lists and one patch after the other, for CPUs; "padded", gather tables and one block of
    patches, for accelerators; results are the same. The point nearest the center of each voxel is kept. Curves change
    from block to block in the configuration's order, or with `rng` in a random order, as in training. Cells are floor(p
    / grid); with `config.grid_from_minimum` the cloud's own minimum is subtracted, so that an outlier decides which
    voxels share a parent. Raises InputError for clouds wider than the range of cell indices, and for more people than a
    batch can hold.
    """
    check_name("layout", layout, LAYOUTS)
    if not 1 <= len(clouds) < _MOST_PEOPLE:
        raise InputError(f"a batch holds 1 to {_MOST_PEOPLE - 1} people, got {len(clouds)}: split it")
    has_points = [len(cloud) > 0 for cloud in clouds]
    # a placeholder, which neighbors and parents treat like a real voxel
    clouds = [np.asarray(cloud, np.float32) if len(cloud) else np.zeros((1, 3), np.float32) for cloud in clouds]
    lengths = np.array([len(cloud) for cloud in clouds], np.int64)
    points, person = np.concatenate(clouds), np.repeat(np.arange(len(clouds), dtype=np.int64), lengths)
    is_point = np.repeat(has_points, lengths)
    cells = _cells(points, lengths, config)
    key = person << (3 * _WIDE) | z_order(cells)

    rows, point_voxel = _one_a_voxel(key, points, config.grid)
    key, cells = key[rows], cells[rows]
    levels: list[Level[np.ndarray]] = []
    stem = _neighbors(key, cells, 2, 0, layout)
    bits = 0
    # the last level has no next level
    for stride in (*config.strides, 1):
        shift = stride.bit_length() - 1
        parent_key, starts, parent = _grouped(key >> (3 * shift))
        is_last = len(levels) == len(config.strides)
        levels.append(
            Level(
                near=_neighbors(key, cells, 1, bits, layout),
                parent=None if is_last else parent,
                children=None if is_last else _spread(starts, len(key)),
                **_people(key >> (3 * (_WIDE - bits)), len(clouds), cells, config, layout, rng),
            )
        )
        key, cells, bits = parent_key, cells[starts] >> shift, bits + shift
    return Tables(
        features=points[rows],
        stem=stem,
        levels=tuple(levels),
        kept=np.where(is_point, np.cumsum(is_point) - 1, -1)[rows],
        point_voxel=point_voxel[is_point],
    )


def _cells(points: np.ndarray, lengths: np.ndarray, config: DaptConfig) -> np.ndarray:
    """(M, 3) int64 in [0, 2**CELL_BITS)."""
    cells = np.floor(points / config.grid)
    if not np.isfinite(cells).all():
        raise InputError("points must be finite numbers of meters, got NaN or infinity: drop those points first")
    middle = 1 << (CELL_BITS - 1)
    if config.grid_from_minimum:
        low = np.minimum.reduceat(cells, np.cumsum(lengths) - lengths)
        cells = cells - np.repeat(low, lengths, axis=0)
    else:
        cells = cells + middle
    if not (cells.min() >= 0 and cells.max() < 2 * middle):
        reach = middle * config.grid
        limit = f"lie within {reach:.0f} m of their person"
        if config.grid_from_minimum:
            limit = f"span {2 * reach:.0f} m at most"
        raise InputError(f"points must {limit}, got some beyond: crop to one person")
    return cells.astype(np.int64)


def _one_a_voxel(key: np.ndarray, points: np.ndarray, grid: float) -> tuple[np.ndarray, np.ndarray]:
    """Indices (M,) of one point per voxel, in order of the keys, and each point's voxel."""
    order = np.argsort(key, kind="stable")
    _, starts, voxel = _grouped(key[order])
    if len(starts) < len(key):
        # the point nearest the center of a voxel comes first; coordinates break ties, whatever the input order
        offset = (points / grid - np.floor(points / grid) - 0.5).astype(np.float64)
        order = np.lexsort((*points.T, (offset**2).sum(1), key))
    point_voxel = np.empty(len(key), np.int64)
    point_voxel[order] = voxel
    return order[starts], point_voxel


def _grouped(key: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sorted keys (n,) -> the distinct keys (m,), the start of each (m,), and the number of each key's group (n,)."""
    is_start = np.diff(key, prepend=-1) > 0
    starts = np.flatnonzero(is_start)
    return key[starts], starts, np.cumsum(is_start) - 1


def _spread(starts: np.ndarray, rows: int) -> np.ndarray:
    """(m, W) rows of groups that begin at `starts` and end where the next begins, padded with the first row."""
    lengths = np.diff(starts, append=rows)
    column = np.arange(lengths.max())
    return starts[:, None] + np.where(column < lengths[:, None], column, 0)


def _neighbors(key: np.ndarray, cells: np.ndarray, reach: int, bits: int, layout: str) -> Neighbors:
    """Neighbors within `reach` cells per axis of rows whose sorted `key` is shortened by `bits` bits per axis."""
    side = 2 * reach + 1
    taps, rows = side**3, len(key)
    axis_bits = _WIDE - bits
    # for each axis: the bits of every shifted cell, at their positions in the code
    x, y, z = (
        np.stack([dilated(cells[:, k] + step & (1 << axis_bits) - 1) << 2 - k for step in range(-reach, reach + 1)])
        for k in range(3)
    )
    half_taps = np.arange(taps // 2)
    codes: np.ndarray = x[half_taps // side**2] | y[half_taps // side % side] | z[half_taps % side]
    codes |= key >> (3 * axis_bits) << (3 * axis_bits)
    candidate_rows = np.searchsorted(key, codes.ravel())
    candidate_rows[candidate_rows == rows] = 0
    pairs = np.flatnonzero(key[candidate_rows] == codes.ravel())
    # the second half of the taps mirrors the first half: the same pairs, seen from the neighbor
    tap, target, source = pairs // rows, pairs % rows, candidate_rows[pairs]
    if layout == "padded":
        table = np.full((rows, taps), rows)
        table[target, tap] = source
        table[source, taps - 1 - tap] = target
        return Neighbors(table=table)
    counts = np.bincount(tap, minlength=taps // 2)
    mirror_order = np.argsort(-tap, kind="stable")
    return Neighbors(
        source=np.concatenate([source, target[mirror_order]]),
        target=np.concatenate([target, source[mirror_order]]),
        counts=np.concatenate([counts, [0], counts[::-1]]),
    )


def _people(
    person: np.ndarray, people: int, cells: np.ndarray, config: DaptConfig, layout: str, rng: np.random.Generator | None
) -> dict[str, Any]:
    """The fields of a `Level` that say which rows belong to each person, and which rows attend to each other."""
    lengths = np.bincount(person, minlength=people)
    starts = np.cumsum(lengths) - lengths
    slots = _spread(starts, len(person))
    entries = {"lengths": lengths, "slots": slots, "valid": np.arange(slots.shape[1]) < lengths[:, None]}
    if lengths.max() <= config.patch:
        sequence, patch_lengths = np.arange(len(person))[None], lengths
    else:
        orders = list(config.orders) if rng is None else rng.permutation(config.orders)
        sequence = np.stack([np.lexsort((curve(str(order), cells), person)) for order in orders])
        # ends of each person's full patches, and of the remainder
        ends = [np.append(np.arange(config.patch, n, config.patch), n) for n in lengths]
        patch_lengths = np.concatenate([np.diff(end, prepend=0) for end in ends])
    entries |= {"sequence": sequence, "patch_lengths": patch_lengths}
    if layout == "ragged":
        return entries
    patch_starts = np.cumsum(patch_lengths) - patch_lengths
    places = _spread(patch_starts, len(person))
    valid = np.arange(places.shape[1]) < patch_lengths[:, None]
    place = np.empty_like(sequence)
    np.put_along_axis(place, sequence, np.flatnonzero(valid)[None], 1)
    return entries | {
        "patch_slots": sequence[:, places],
        "patch_valid": None if valid.all() else valid,
        "patch_place": place,
    }


# ---- space-filling curves: cells that are close on the curve are close in space


def z_order(cells: np.ndarray) -> np.ndarray:
    """cells (n, 3), of up to 17 bits per axis -> (n,) int64 Z-order (Morton) codes, x the most significant.

    A parent's code is the child's code without its last three bits.
    """
    x, y, z = dilated(cells.T)
    return x << 2 | y << 1 | z


def hilbert(cells: np.ndarray, bits: int = CELL_BITS) -> np.ndarray:
    """cells (n, 3) integers in [0, 2**bits) -> (n,) int64 positions on a Hilbert curve through the cube.

    Consecutive positions are neighboring cells. Method: Skilling 2004, "Programming the Hilbert curve": the axes are
    turned into the transposed Gray code in place.
    """
    axes = list(cells.T)
    for bit in range(bits - 1, 0, -1):
        mask = (1 << bit) - 1
        for k in range(3):
            # where the bit is set, the lower bits of x are inverted; elsewhere they are exchanged with those of axis k
            is_set = (axes[k] >> bit & 1).astype(bool)
            swap_bits = np.where(is_set, 0, (axes[0] ^ axes[k]) & mask)
            axes[0] = axes[0] ^ np.where(is_set, mask, swap_bits)
            # for k = 0 nothing is exchanged: x ^ x is 0
            axes[k] = axes[k] ^ swap_bits
    axes[1] = axes[1] ^ axes[0]
    axes[2] = axes[2] ^ axes[1]
    flip = np.zeros_like(axes[0])
    for bit in range(bits - 1, 0, -1):
        flip ^= np.where(axes[2] >> bit & 1, (1 << bit) - 1, 0)
    return z_order(np.stack(axes, 1) ^ flip[:, None])


def dilated(values: np.ndarray) -> np.ndarray:
    """Integers (int64) of up to 17 bits with two zero bits inserted before each of their bits."""
    values = (values | values << 32) & 0x1F00000000FFFF
    values = (values | values << 16) & 0x1F0000FF0000FF
    values = (values | values << 8) & 0x100F00F00F00F00F
    values = (values | values << 4) & 0x10C30C30C30C30C3
    return (values | values << 2) & 0x1249249249249249


def curve(name: str, cells: np.ndarray) -> np.ndarray:
    """cells (n, 3) -> (n,) int64 codes along a curve of `CURVES`; "-trans" exchanges x and y."""
    code = hilbert if name.startswith("hilbert") else z_order
    return code(cells[:, [1, 0, 2]] if name.endswith("-trans") else cells)
