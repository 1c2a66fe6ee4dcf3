"""Space-filling curves: codes of integer cells such that cells near on the curve are near in space. Numpy only.

Legend: n cells, b bits an axis.

Paper (via Point Transformer V3): points of a large cloud are put in the order of a curve and cut into patches, within
which attention is full. Z-order also is the order in which this package keeps voxels: a parent's code is the child's
without its last three bits, so that the children of a parent stand together at every level.
"""

from collections.abc import Callable

import numpy as np

from lidarpose.errors import InputError, check_name

# bits an axis that a code holds: three of them and a batch number fit in an int64
MAX_BITS = 17


def z_order(cells: np.ndarray, bits: int = 16) -> np.ndarray:
    """cells (n, 3) whole numbers in [0, 2**bits) -> (n,) int64 Z-order (Morton) codes, x the most significant.

    Raises InputError for a cell outside.
    """
    x, y, z = _checked(cells, bits)
    return dilated(x) << 2 | dilated(y) << 1 | dilated(z)


def hilbert(cells: np.ndarray, bits: int = 16) -> np.ndarray:
    """cells (n, 3) whole numbers in [0, 2**bits) -> (n,) int64 positions on a Hilbert curve through the cube.

    Consecutive positions are neighboring cells. Method: Skilling 2004, "Programming the Hilbert curve": the axes are
    turned into the transposed Gray code in place. Raises InputError for a cell outside.
    """
    axes = list(_checked(cells, bits))
    for bit in range(bits - 1, 0, -1):
        low = (1 << bit) - 1
        for k in range(3):
            # where the bit is set the lower bits of x are inverted, elsewhere exchanged with those of axis k
            is_set = (axes[k] >> bit & 1).astype(bool)
            exchanged = np.where(is_set, 0, (axes[0] ^ axes[k]) & low)
            axes[0] = axes[0] ^ np.where(is_set, low, exchanged)
            # for k = 0 nothing is exchanged: x ^ x is 0
            axes[k] = axes[k] ^ exchanged
    axes[1] = axes[1] ^ axes[0]
    axes[2] = axes[2] ^ axes[1]
    flip = np.zeros_like(axes[0])
    for bit in range(bits - 1, 0, -1):
        flip ^= np.where(axes[2] >> bit & 1, (1 << bit) - 1, 0)
    x, y, z = (axis ^ flip for axis in axes)
    return dilated(x) << 2 | dilated(y) << 1 | dilated(z)


def dilated(values: np.ndarray) -> np.ndarray:
    """Whole numbers under 2**`MAX_BITS` (int64) with two zero bits put before each of their bits."""
    values = (values | values << 32) & 0x1F00000000FFFF
    values = (values | values << 16) & 0x1F0000FF0000FF
    values = (values | values << 8) & 0x100F00F00F00F00F
    values = (values | values << 4) & 0x10C30C30C30C30C3
    return (values | values << 2) & 0x1249249249249249


CURVES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "z": z_order,
    "z-trans": lambda cells: z_order(cells[:, [1, 0, 2]]),
    "hilbert": hilbert,
    "hilbert-trans": lambda cells: hilbert(cells[:, [1, 0, 2]]),
}


def curve(name: str) -> Callable[[np.ndarray], np.ndarray]:
    """A curve by name: cells (n, 3) of 16 bits an axis -> (n,) int64 codes; "-trans" exchanges x and y."""
    check_name("curve", name, CURVES)
    return CURVES[name]


def _checked(cells: np.ndarray, bits: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    cells = np.asarray(cells, np.int64)
    if not 1 <= bits <= MAX_BITS:
        raise InputError(f"bits must be 1 to {MAX_BITS}, got {bits}")
    if cells.size and not (cells.min() >= 0 and cells.max() < 1 << bits):
        raise InputError(f"cells must lie in [0, {1 << bits}), got {cells.min()} to {cells.max()}: shift them first")
    return cells[:, 0], cells[:, 1], cells[:, 2]
