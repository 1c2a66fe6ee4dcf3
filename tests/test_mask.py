"""The laser-level mask."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidarpose.synth.mask import laser_mask


@settings(max_examples=80, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 90), st.integers(1, 70), st.floats(0, 1))
def test_the_mask_is_made_of_square_patches_of_the_paper_s_size(seed, columns, rows, keep):
    mask = laser_mask(columns, rows, keep=keep, rng=np.random.default_rng(seed))
    assert mask.shape == (columns, rows) and mask.dtype == bool
    patch = max(min(columns, rows) // 8, 1)
    kept = total = 0
    for i in range(0, columns, patch):
        for j in range(0, rows, patch):
            cell = mask[i : i + patch, j : j + patch]
            assert cell.all() or not cell.any()
            kept += cell.any()
            total += 1
    assert kept == int(total * keep)


def test_the_mask_keeps_about_its_share_of_the_beams():
    rng = np.random.default_rng(5)
    for columns, rows in ((77, 61), (39, 27), (20, 9), (5, 30)):
        share = np.mean([laser_mask(columns, rows, keep=0.6, rng=rng).mean() for _ in range(300)])
        assert share == pytest.approx(0.6, abs=0.02)


def test_the_mask_of_a_window_without_beams_is_empty():
    assert laser_mask(0, 0, keep=0.6, rng=np.random.default_rng(0)).shape == (0, 0)
