"""Distances between predicted and true joints. Metres in, millimetres out. Works on plain arrays of anyone's poses."""

import numpy as np

from lidarpose.errors import InputError
from lidarpose.geometry import similarity_align


def mpjpe(pred: np.ndarray, true: np.ndarray) -> float:
    """Mean per-joint position error in millimetres; pred, true (..., J, 3) m, in one frame, not aligned."""
    pred, true = _checked(pred, true)
    return float(np.linalg.norm(pred - true, axis=-1).mean() * 1e3)


def pa_mpjpe(pred: np.ndarray, true: np.ndarray) -> float:
    """`mpjpe` after each person's prediction was moved onto the truth by its best similarity (Procrustes)."""
    pred, true = _checked(pred, true)
    return mpjpe(similarity_align(pred, true), true)


def calibration_error(confidence: np.ndarray, hit: np.ndarray, *, bins: int = 10) -> float:
    """Expected calibration error: mean distance of stated confidence (n,) and share of hits (n,), over equal bins."""
    index = np.minimum((np.asarray(confidence) * bins).astype(int), bins - 1)
    count = np.bincount(index, minlength=bins)
    stated = np.bincount(index, confidence, bins)
    true = np.bincount(index, np.asarray(hit, float), bins)
    return float(np.abs(stated - true).sum() / max(count.sum(), 1))


def auroc(score: np.ndarray, hit: np.ndarray) -> float:
    """Area under the ROC curve of scores (n,) for hits (n,) bool: how well the score ranks hits before misses."""
    score, hit = np.asarray(score, float), np.asarray(hit, bool)
    positives, negatives = int(hit.sum()), int((~hit).sum())
    if not positives or not negatives:
        raise InputError(f"AUROC needs hits and misses, got {positives} hits and {negatives} misses")
    values, inverse, counts = np.unique(score, return_inverse=True, return_counts=True)
    # ties share the mean of their ranks
    last = np.cumsum(counts)
    rank = (last - (counts - 1) / 2)[inverse]
    return float((rank[hit].sum() - positives * (positives + 1) / 2) / (positives * negatives))


def _checked(pred: np.ndarray, true: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    pred, true = np.asarray(pred, float), np.asarray(true, float)
    if pred.shape != true.shape or pred.ndim < 2 or pred.shape[-1] != 3:
        raise InputError(f"pred and true must both be (..., joints, 3), got {pred.shape} and {true.shape}")
    return pred, true
