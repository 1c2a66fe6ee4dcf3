import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidarpose.errors import InputError
from lidarpose.models.dapt.space_filling_curves import CURVES, MAX_BITS, curve, dilated, hilbert, z_order


def cube(bits):
    return np.stack(np.meshgrid(*[np.arange(1 << bits)] * 3, indexing="ij"), -1).reshape(-1, 3)


def z_order_reference(cell):
    code = 0
    for bit in range(MAX_BITS):
        for axis, value in enumerate(cell):
            code |= (int(value) >> bit & 1) << (3 * bit + 2 - axis)
    return code


@pytest.mark.parametrize("code", [z_order, hilbert])
@pytest.mark.parametrize("bits", [1, 2, 3, 4])
def test_codes_number_the_cells_of_a_cube(code, bits):
    assert sorted(code(cube(bits), bits)) == list(range(8**bits))


@pytest.mark.parametrize("bits", [1, 2, 3, 4])
def test_hilbert_steps_to_a_neighbor(bits):
    cells = cube(bits)[np.argsort(hilbert(cube(bits), bits))]
    assert (np.abs(np.diff(cells, axis=0)).sum(1) == 1).all()
    assert (cells[0] == 0).all()


@pytest.mark.parametrize("code", [z_order, hilbert])
@pytest.mark.parametrize("bits", [2, 3, 4])
def test_a_parent_has_its_childrens_code_without_three_bits(code, bits):
    assert (code(cube(bits), bits) >> 3 == code(cube(bits) >> 1, bits - 1)).all()


@given(st.lists(st.tuples(*[st.integers(0, (1 << MAX_BITS) - 1)] * 3), min_size=1, max_size=20))
def test_z_order_is_bits_taken_in_turn(cells):
    assert z_order(np.array(cells), MAX_BITS).tolist() == [z_order_reference(cell) for cell in cells]


@settings(max_examples=30)
@given(st.integers(2, MAX_BITS), st.integers(0, 2**31))
def test_hilbert_of_large_cubes(bits, seed):
    # where the cube is too large to go through: distinct codes in range, and neighbors in code are neighbors in space
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


def test_trans_exchanges_x_and_y():
    cells = np.random.default_rng(0).integers(0, 99, (50, 3))
    for name in ("z", "hilbert"):
        assert (curve(f"{name}-trans")(cells) == curve(name)(cells[:, [1, 0, 2]])).all()
        assert (curve(f"{name}-trans")(cells) != curve(name)(cells)).any()
    assert len({tuple(CURVES[name](cells)) for name in CURVES}) == 4


def test_no_cells_have_no_codes():
    assert z_order(np.zeros((0, 3), int)).shape == hilbert(np.zeros((0, 3), int)).shape == (0,)


def test_bad_input():
    for cells in ([[0, 0, 8]], [[0, -1, 0]]):
        with pytest.raises(InputError, match=r"must lie in \[0, 8\)"):
            hilbert(np.array(cells), 3)
    with pytest.raises(InputError, match="bits must be 1 to 17, got 18"):
        z_order(np.zeros((1, 3), int), 18)
    with pytest.raises(InputError, match="unknown curve 'hilbrt': did you mean hilbert"):
        curve("hilbrt")
