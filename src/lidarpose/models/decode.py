"""From 1D heatmaps to positions: the decoders, for whoever has logits as an array. Numpy only.

Legend: ... leading axes (people, joints, axes of space), W bins.

A decoder takes logits (..., W) and says where bin 0 lies (`low`) and how far apart bins are (`step`), in meters:
position = low + index * step. That serves both conventions of bins. The released DAPT code puts a bin at its left edge,
index = (position - lo) * bins / (hi - lo), so low = lo and step = (hi - lo) / bins. A heatmap whose bins are known by
their middles has low = lo + step / 2.
"""

from collections.abc import Callable

import numpy as np

from lidarpose.errors import InputError, check_name

# half width of `window`, and of its twins in torch, about the mode, in bins
HALF_WIDTH = 3
# the released code's blur before `dark`: kernel and deviation, in bins (the kernel from 20 * its sigma of 2 bins)
_TAPS, _SIGMA = 11, 2.0
# what it clips the blurred logits to before their logarithm, and the refinement it does not believe, in bins
_CLIP, _MOST = (1e-3, 50.0), 0.5

Decoder = Callable[..., np.ndarray]


def argmax(logits: np.ndarray, *, low: float | np.ndarray, step: float | np.ndarray) -> np.ndarray:
    """logits (..., W) -> (...) m: the peak's bin.

    Paper: "Heatmap decoder for joints", the peak mapped back through range and bins. Raises InputError for no bins.
    """
    return low + _checked(logits).argmax(-1) * step


def dark(logits: np.ndarray, *, low: float | np.ndarray, step: float | np.ndarray) -> np.ndarray:
    """logits (..., W) -> (...) m: the released code's refinement of the peak (DARK, Zhang et al. 2020), to the letter.

    It blurs the raw logits, where DARK blurs probabilities, and takes the logarithm of what is clipped to be positive,
    so that the peak of a parabola through the logarithms is off where logits are noisy: kept to reproduce published
    figures, `window` is better. Steps of more than half a bin are dropped. Raises InputError for no bins.
    """
    logits = _checked(logits)
    mode = logits.argmax(-1)
    bins = logits.shape[-1]
    half_width = _TAPS // 2
    kernel = np.exp(-0.5 * (np.arange(-half_width, half_width + 1) / _SIGMA) ** 2)
    kernel /= kernel.sum()
    # only the five bins about the mode are asked for; beyond an edge its own value is repeated
    window_bins = np.clip(mode[..., None] + np.arange(-2, 3), 0, bins - 1)
    padded = np.pad(logits, [(0, 0)] * (logits.ndim - 1) + [(half_width, half_width)])
    taps = window_bins[..., None] + np.arange(_TAPS)
    values = np.take_along_axis(padded, taps.reshape(*mode.shape, 5 * _TAPS), -1).reshape(taps.shape) @ kernel
    m2, m1, zero, p1, p2 = np.moveaxis(np.log(np.clip(values, *_CLIP)), -1, 0)
    slope = 0.5 * (p1 - m1)
    curvature = 1e-9 + 0.25 * (p2 - 2 * zero + m2)
    offset = slope / curvature
    return low + (mode - np.where(np.abs(offset) > _MOST, 0, offset)) * step


def window(logits: np.ndarray, *, low: float | np.ndarray, step: float | np.ndarray) -> np.ndarray:
    """logits (..., W) -> (...) m: the mean position under the softmax of the bins within `HALF_WIDTH` of the mode.

    A mean over all bins would fall between the two peaks of a left/right doubt. The window has as many bins on either
    side: one that an edge cuts would lean inwards, so near an edge it is narrower. Raises InputError for no bins.
    """
    logits = _checked(logits)
    bins = logits.shape[-1]
    mode = logits.argmax(-1)[..., None]
    half_width = np.minimum(np.minimum(mode, bins - 1 - mode), HALF_WIDTH)
    index = np.arange(bins)
    weight = np.exp(logits - np.take_along_axis(logits, mode, -1)) * (np.abs(index - mode) <= half_width)
    return low + (weight * index).sum(-1) / weight.sum(-1) * step


def sigmoid(logit: np.ndarray) -> np.ndarray:
    """logit (...) -> (...) float64 in [0, 1]: a probability from its log odds."""
    return 0.5 * (1 + np.tanh(np.asarray(logit, float) / 2))


def out_of_range(logits: np.ndarray) -> np.ndarray:
    """logits (..., W) -> (...) bool: the mode lies in an outermost bin, so the truth may lie beyond the heatmap."""
    logits = _checked(logits)
    mode = logits.argmax(-1)
    return (mode == 0) | (mode == logits.shape[-1] - 1)


DECODERS: dict[str, Decoder] = {"argmax": argmax, "dark": dark, "window": window}


def decoder(name: str) -> Decoder:
    """A decoder by name: argmax, dark or window. Raises InputError for another."""
    check_name("decoder", name, DECODERS)
    return DECODERS[name]


def _checked(logits: np.ndarray) -> np.ndarray:
    logits = np.asarray(logits, np.float64)
    if logits.ndim == 0 or logits.shape[-1] == 0:
        raise InputError(f"a heatmap needs at least one bin on its last axis, got logits of shape {logits.shape}")
    return logits
