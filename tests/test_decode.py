from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st

from lidarpose.errors import InputError
from lidarpose.models import decode
from lidarpose.models.dapt.dapt_config import named_config

ORACLE = np.load(Path(__file__).parent / "parity" / "dapt_tiny.npz")
WAYMO = named_config("waymo")


def gaussian(at, bins, sigma=2.0):
    """Logits whose softmax is a Gaussian centered on `at`, in bins."""
    return -0.5 * ((np.arange(bins) - np.asarray(at)[..., None]) / sigma) ** 2


def dark_reference(logits):
    """Index of the refined peak of one heatmap as in the released code, bin by bin."""
    bins, mode = len(logits), int(np.argmax(logits))
    taps = np.exp(-0.5 * (np.arange(-5, 6) / 2.0) ** 2)
    taps /= taps.sum()
    blurred = [sum(taps[k] * logits[i + k - 5] for k in range(11) if 0 <= i + k - 5 < bins) for i in range(bins)]
    heights = np.log(np.clip(blurred, 1e-3, 50))
    heights = [heights[0]] * 2 + list(heights) + [heights[-1]] * 2
    at = mode + 2
    slope = 0.5 * (heights[at + 1] - heights[at - 1])
    curvature = 1e-9 + 0.25 * (heights[at + 2] - 2 * heights[at] + heights[at - 2])
    offset = slope / curvature
    return mode if abs(offset) > 0.5 else mode - offset


@pytest.mark.parametrize("axis", range(3))
def test_argmax_and_dark_equal_released_decoders(axis):
    logits = ORACLE[f"logits_{'xyz'[axis]}"]
    low, step = WAYMO.low[axis], WAYMO.step[axis]
    index = ORACLE["argmax"][..., axis]
    lo, hi = WAYMO.ranges[axis]
    peak, dark = (decode.decoder(name)(logits, low=low, step=step) for name in ("argmax", "dark"))
    # the released formula
    np.testing.assert_allclose(peak, index / logits.shape[-1] * (hi - lo) + lo, rtol=0, atol=1e-12)
    assert (np.rint((peak - low) / step) == index).all()
    np.testing.assert_allclose(dark, ORACLE["dark"][..., axis], rtol=0, atol=1e-4)
    # the comparison of dark is meaningful only if it moves the peak
    assert np.abs(dark - peak).max() > 0.2 * step


@given(st.lists(st.integers(-40, 120), min_size=1, max_size=40))
def test_dark_equals_reference(halves):
    logits = np.array(halves) / 2
    got = decode.dark(logits, low=0.0, step=1.0)
    np.testing.assert_allclose(got, dark_reference(logits), rtol=0, atol=1e-6)


@given(st.integers(1, 40), st.data())
def test_window_is_unbiased_near_edges(bins, data):
    at = data.draw(st.floats(0, bins - 1))
    # a peak at the center of a bin is exact everywhere; other peaks are accurate to about a third of a bin
    middle = round(at)
    assert decode.window(gaussian(middle, bins), low=0.0, step=1.0) == pytest.approx(middle, abs=1e-9)
    assert decode.window(gaussian(at, bins), low=0.0, step=1.0) == pytest.approx(at, abs=0.51)
    inside = min(at, bins - 1 - at) >= decode.HALF_WIDTH + 1
    if inside:
        assert decode.window(gaussian(at, bins), low=0.0, step=1.0) == pytest.approx(at, abs=0.35)


def test_window_beats_argmax_and_uses_highest_of_two_peaks():
    at = np.random.default_rng(0).uniform(5, 66, 500)
    peak, window = (np.abs(f(gaussian(at, 72), low=0.0, step=1.0) - at).mean() for f in (decode.argmax, decode.window))
    assert window < 0.6 * peak
    two = np.logaddexp(gaussian(20, 72) + 0.1, gaussian(50, 72))
    assert decode.window(two, low=0.0, step=1.0) == pytest.approx(20, abs=0.01)


@pytest.mark.parametrize("mode, bins", [(5, [2, 3, 4, 5, 6, 7, 8]), (2, [0, 1, 2, 3, 4]), (10, [9, 10, 11]), (0, [0])])
def test_window_averages_three_bins_on_each_side(mode, bins):
    logits = np.random.default_rng(1).normal(size=12)
    logits[mode] = 5
    weight = np.exp(logits[bins])
    assert decode.window(logits, low=0.0, step=1.0) == pytest.approx((weight * bins).sum() / weight.sum())


@pytest.mark.parametrize("name", decode.DECODERS)
def test_decoders_support_bins_by_left_edge_and_center(name):
    logits = gaussian(np.array([[10.0, 3.0], [0.0, 23.0]]), 24)
    find = decode.decoder(name)
    index = find(logits, low=0.0, step=1.0)
    assert index.shape == (2, 2)
    # bins given by their left edges, 24 in [-0.36, 0.36), or by their centers
    np.testing.assert_allclose(find(logits, low=-0.36, step=0.03), -0.36 + index * 0.03, atol=1e-12)
    middles = (np.arange(24) + 0.5) * 0.03 - 0.36
    np.testing.assert_allclose(find(logits, low=middles[0], step=0.03)[0, 0], middles[10], atol=1e-9)
    # arrays of low and step, one value per axis
    low = np.array([1.0, 5.0])
    np.testing.assert_allclose(find(logits, low=low, step=np.array([1.0, 2.0])), low + index * [1, 2], atol=1e-12)


@pytest.mark.parametrize("name", decode.DECODERS)
def test_decoders_accept_few_bins_and_float16(name):
    find = decode.decoder(name)
    for bins in (1, 2, 3):
        assert np.isfinite(find(np.eye(4, bins), low=0.0, step=1.0)).all()
        assert find(np.zeros((0, 14, bins)), low=0.0, step=1.0).shape == (0, 14)
    logits = (gaussian([30.0, 2.0], 72) * 50).astype(np.float16)
    np.testing.assert_allclose(find(logits, low=0.0, step=1.0), [30, 2], atol=0.01)


@pytest.mark.parametrize("constant", [-1e4, 1e3, 1e4])
def test_window_is_invariant_to_constant_offset(constant):
    logits = gaussian([7.3, 12.0], 24)
    moved = decode.window(logits + constant, low=0.0, step=1.0)
    np.testing.assert_allclose(moved, decode.window(logits, low=0.0, step=1.0), atol=1e-9)


def test_sigmoid_inverts_log_odds():
    odds = np.array([0.01, 0.5, 1, 3, 99])
    np.testing.assert_allclose(decode.sigmoid(np.log(odds)), odds / (1 + odds))
    assert decode.sigmoid(np.array([-1e4, 1e4])).tolist() == [0, 1]


def test_out_of_range_detects_peaks_at_end_bins():
    logits = gaussian(np.array([[0.0, 1.0], [70.0, 71.0]]), 72)
    assert decode.out_of_range(logits).tolist() == [[True, False], [False, True]]


def test_decoders_reject_bad_input():
    with pytest.raises(InputError, match="unknown decoder 'darc': did you mean dark"):
        decode.decoder("darc")
    for logits in (np.zeros((3, 0)), np.float64(1)):
        for find in (*decode.DECODERS.values(), lambda x, **_: decode.out_of_range(x)):
            with pytest.raises(InputError, match="at least one bin"):
                find(logits, low=0.0, step=1.0)
