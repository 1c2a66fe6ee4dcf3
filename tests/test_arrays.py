"""Evenly spaced indices. Arrays of other libraries are tested with the functions that accept them."""

import numpy as np
from hypothesis import given, strategies as st

from lidarpose.arrays import evenly_spaced


@given(st.integers(0, 500), st.integers(1, 600))
def test_evenly_spaced(count, limit):
    indices = evenly_spaced(count, limit).tolist()
    assert len(indices) == min(count, limit)
    if count <= limit:
        assert indices == list(range(count))
    elif limit > 1:
        assert indices[0] == 0 and indices[-1] == count - 1
        steps = np.diff(indices)
        assert steps.max() - steps.min() <= 1
