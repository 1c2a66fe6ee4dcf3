"""Whether confidence means what it says, and whether it ranks hits before misses."""

import numpy as np
from numpy.typing import ArrayLike

from lidarpose.errors import InputError, check_int
from lidarpose.eval.metrics.joint_errors import as_flags, as_numbers


def calibration_error(confidence: ArrayLike, hit: ArrayLike, *, bins: int = 10) -> float:
    """Expected calibration error, 0 to 1: mean distance of confidence (n,) and share of hits (n,), over equal bins; NaN
    of nothing.

    Args:
        confidence: (n,) 0 to 1. hit: (n,) bool or 0/1.

    Raises:
        InputError: for NaN and other values: leave out what is not known.
    """
    bins = check_int("bins", bins, least=1)
    confidence = _without_nan("confidence", confidence)
    if not ((confidence >= 0) & (confidence <= 1)).all():
        raise InputError(f"confidence must be within 0 and 1, got {confidence.min():g} to {confidence.max():g}")
    hit = as_flags("hit", hit, confidence.shape, of="confidence")
    if not len(confidence):
        return float("nan")
    index = np.minimum((confidence * bins).astype(int), bins - 1)
    stated = np.bincount(index, confidence, bins)
    true = np.bincount(index, hit, bins)
    return float(np.abs(stated - true).sum() / len(confidence))


def auroc(score: ArrayLike, hit: ArrayLike) -> float:
    """Area under the ROC curve, 0 to 1, of scores (n,) for hits (n,): how well the score ranks hits before misses.

    Args:
        score: (n,) any numbers, more is surer. hit: (n,) bool or 0/1.

    Raises:
        InputError: for NaN, which has no rank, and where there are not both hits and misses.
    """
    score = _without_nan("score", score)
    hit = as_flags("hit", hit, score.shape, of="score")
    positives, negatives = int(hit.sum()), int((~hit).sum())
    if not positives or not negatives:
        raise InputError(f"AUROC needs hits and misses, got {positives} hits and {negatives} misses")
    _, inverse, counts = np.unique(score, return_inverse=True, return_counts=True)
    # ties share the mean of their ranks
    rank = (np.cumsum(counts) - (counts - 1) / 2)[inverse]
    return float((rank[hit].sum() - positives * (positives + 1) / 2) / (positives * negatives))


def _without_nan(name: str, values: ArrayLike) -> np.ndarray:
    values = as_numbers(name, values)
    if values.ndim != 1:
        raise InputError(f"{name} must be (n,), got {values.shape}: pass values.ravel()")
    if unknown := int(np.isnan(values).sum()):
        raise InputError(
            f"{name} must hold numbers, got NaN in {unknown} of {len(values)}: leave these and their hits out"
        )
    return values
