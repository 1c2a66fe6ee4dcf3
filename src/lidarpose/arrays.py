"""What other libraries hand over, as numpy arrays; indices at equal steps."""

from typing import Any

import numpy as np


def to_numpy(value: Any) -> Any:
    """A torch tensor as a numpy array, wherever it lies and whether or not in a graph; a masked array as floats, NaN
    where it is masked; anything else as it is."""
    if isinstance(value, np.ma.MaskedArray):
        return np.ma.filled(value.astype(float), np.nan)
    # open files have a detach of their own
    if not (hasattr(value, "detach") and hasattr(value, "cpu")):
        return value
    tensor = value.detach().cpu()
    try:
        return tensor.numpy()
    except TypeError:
        # numpy has no bfloat16 and nothing shorter
        return tensor.float().numpy()


def evenly_spaced(count: int, limit: int) -> np.ndarray:
    """Indices of at most `limit` of `count` things at equal steps, the first and the last among them."""
    return np.arange(count) if count <= limit else np.linspace(0, count - 1, limit).round().astype(int)
