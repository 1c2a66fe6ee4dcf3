"""Decoders from 1D heatmaps to positions, for logits as arrays. Numpy only.

Legend: ... leading axes (people, joints, axes of space), W bins.

A decoder takes logits (..., W), the position of bin 0 (`low`) and the spacing of bins (`step`), in meters:
position = low + index * step. This covers both conventions for bins. The released DAPT code places a bin at its left
edge, index = (position - lo) * bins / (hi - lo), so low = lo and step = (hi - lo) / bins. For a heatmap whose bins are
given by their centers, low = lo + step / 2.
"""

from collections.abc import Callable

import numpy as np

from lidarpose.errors import InputError, check_name

# half width of `window` and of its torch equivalents around the mode, in bins
HALF_WIDTH = 3
# the released code's blur before `dark`: kernel size and deviation, in bins (the kernel from 20 * its sigma of 2 bins)
_TAPS, _SIGMA = 11, 2.0
# range to which it clips the blurred logits before the logarithm, and the largest refinement that it accepts, in bins
_CLIP, _MOST = (1e-3, 50.0), 0.5

Decoder = Callable[..., np.ndarray]


def argmax(logits: np.ndarray, *, low: float | np.ndarray, step: float | np.ndarray) -> np.ndarray:
    """logits (..., W) -> (...) m: position of the bin with the peak.

    Paper: "Heatmap decoder for joints", the peak mapped back through range and bins. Raises InputError without bins.
    """
    return low + _checked(logits).argmax(-1) * step


def dark(logits: np.ndarray, *, low: float | np.ndarray, step: float | np.ndarray) -> np.ndarray:
    """logits (..., W) -> (...) m: the released code's exact refinement of the peak (DARK, Zhang et al. 2020).

    It blurs the raw logits, while DARK blurs probabilities, and takes the logarithm after clipping to positive values.
    The peak of a parabola through these logarithms is therefore wrong for noisy logits. Use it to reproduce published
    figures; `window` is more accurate. Refinements of more than half a bin are dropped. Raises InputError without bins.
    """
    logits = _checked(logits)
    mode = logits.argmax(-1)
    bins = logits.shape[-1]
    half_width = _TAPS // 2
    kernel = np.exp(-0.5 * (np.arange(-half_width, half_width + 1) / _SIGMA) ** 2)
    kernel /= kernel.sum()
    # only the five bins around the mode are needed; beyond an edge, the value of the edge bin is repeated
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

    If left and right are ambiguous, a mean over all bins would fall between the two peaks. The window is symmetric
    about the mode, and thus narrower near an edge: a window truncated at the edge would bias the mean inwards. Raises
    InputError without bins.
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
    """logits (..., W) -> (...) bool: the mode is an outermost bin, so the true position may lie outside the heatmap."""
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
