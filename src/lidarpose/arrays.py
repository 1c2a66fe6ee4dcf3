"""Conversion of other libraries' arrays to numpy, and evenly spaced indices."""

from typing import Any

import numpy as np


def to_numpy(value: Any) -> Any:
    """Converts a torch tensor, on any device and with or without gradients, to a numpy array; a masked array to floats
    with NaN for masked values; returns anything else unchanged."""
    if isinstance(value, np.ma.MaskedArray):
        return np.ma.filled(value.astype(float), np.nan)
    # open files also have a method `detach`
    if not (hasattr(value, "detach") and hasattr(value, "cpu")):
        return value
    tensor = value.detach().cpu()
    try:
        return tensor.numpy()
    except TypeError:
        # numpy has neither bfloat16 nor shorter float types
        return tensor.float().numpy()


def evenly_spaced(count: int, limit: int) -> np.ndarray:
    """At most `limit` evenly spaced indices of `count` items, including the first and the last."""
    return np.arange(count) if count <= limit else np.linspace(0, count - 1, limit).round().astype(int)
