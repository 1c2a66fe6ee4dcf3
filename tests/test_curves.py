"""Space-filling curves: one code per cell, codes of parents and children, neighbors in code and in space."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from lidarpose.models.dapt.dapt_config import CURVES
from lidarpose.models.dapt.voxel_tables import curve, dilated, hilbert, z_order

# bits per axis: those of a cell, and one more for a step across the edge
BITS = 17


def cube(bits):
    return np.stack(np.meshgrid(*[np.arange(1 << bits)] * 3, indexing="ij"), -1).reshape(-1, 3)


def z_order_reference(cell):
    code = 0
    for bit in range(BITS):
        for axis, value in enumerate(cell):
            code |= (int(value) >> bit & 1) << (3 * bit + 2 - axis)
    return code


@pytest.mark.parametrize("bits", [1, 2, 3, 4])
def test_curves_number_all_cells_and_hilbert_visits_neighbors(bits):
    cells = cube(bits)
    assert sorted(z_order(cells)) == sorted(hilbert(cells, bits)) == list(range(8**bits))
    path = cells[np.argsort(hilbert(cells, bits))]
    assert (np.abs(np.diff(path, axis=0)).sum(1) == 1).all() and (path[0] == 0).all()
    # the code of a parent is that of its children without three bits
    assert (z_order(cells) >> 3 == z_order(cells >> 1)).all()
    assert bits == 1 or (hilbert(cells, bits) >> 3 == hilbert(cells >> 1, bits - 1)).all()


@given(st.lists(st.tuples(*[st.integers(0, (1 << BITS) - 1)] * 3), min_size=1, max_size=20))
def test_z_order_interleaves_bits(cells):
    assert z_order(np.array(cells)).tolist() == [z_order_reference(cell) for cell in cells]


@settings(max_examples=30)
@given(st.integers(2, BITS), st.integers(0, 2**31))
def test_hilbert_visits_neighbors_in_large_cubes(bits, seed):
    # the cube is too large to enumerate: codes are distinct and in range, and neighbors in code are neighbors in space
    cells = np.random.default_rng(seed).integers(0, 1 << bits, (200, 3))
    codes = hilbert(cells, bits)
    assert len(np.unique(codes)) == len(np.unique(cells, axis=0)) and codes.min() >= 0 and codes.max() < 8**bits
    around = np.concatenate([cells + step for step in np.concatenate([np.eye(3, dtype=int), -np.eye(3, dtype=int)])])
    owner = np.tile(np.arange(200), 6)
    inside = ((around >= 0) & (around < 1 << bits)).all(1)
    steps = np.abs(hilbert(around[inside], bits) - codes[owner[inside]])
    following = np.bincount(owner[inside][steps == 1], minlength=200)
    ends = (codes == 0) | (codes == 8**bits - 1)
    assert (following == np.where(ends, 1, 2)).all()


def test_dilated_puts_two_zeros_before_each_bit():
    assert dilated(np.array([0b0, 0b1, 0b101, 0b111])).tolist() == [0, 1, 0b1000001, 0b1001001]


def test_curve_selects_curve_by_name():
    cells = np.random.default_rng(0).integers(0, 99, (50, 3))
    for name, code in (("z", z_order), ("hilbert", hilbert)):
        assert (curve(name, cells) == code(cells)).all()
        assert (curve(f"{name}-trans", cells) == code(cells[:, [1, 0, 2]])).all()
    assert len({tuple(curve(name, cells)) for name in CURVES}) == 4
    assert z_order(cells[:0]).shape == hilbert(cells[:0]).shape == (0,)
