"""Distances between predicted and true joints. Metres in, millimetres or percent out. Works on plain arrays of anyone's
poses.

    n people, J joints, T frames
    pred, true (n, J, 3) m in one frame; any leading shape, (J, 3) too, and nested lists
    visible (n, J) bool or 0/1: which joints have a label; a joint whose truth is NaN has none

A figure is the mean of a table (n, J) of joints, see `scores.mean`; the tables are public too, for groups, slices and
intervals. legacy=True: the arithmetic of the paper's released code, faults included; docs/metrics.md says which.
"""

import numpy as np

from lidarpose.errors import InputError, whole
from lidarpose.eval.metrics.aggregate import Score, checked_average, mean
from lidarpose.eval.metrics.arrays import checked_poses, flags, numbers
from lidarpose.geometry import similarity_align

# the released code's length of a torso, m, the same for everybody; it comes from LiDARCap
TORSO = 0.5127067
# a similarity has 7 unknowns; two joints always fit
LEAST_ALIGNED = 3


def mpjpe(
    pred: np.ndarray,
    true: np.ndarray,
    visible: np.ndarray | None = None,
    legacy: bool = False,
    *,
    average: str = "person",
) -> Score:
    """Mean per-joint position error in millimetres, not aligned.

    average: "person" or "joint", see `scores.mean`. legacy: people without a label count as free of error.
    """
    return mean(joint_errors(pred, true, visible), _average(average, legacy), empty=0.0 if legacy else None)


def pa_mpjpe(
    pred: np.ndarray,
    true: np.ndarray,
    visible: np.ndarray | None = None,
    legacy: bool = False,
    *,
    average: str = "person",
) -> Score:
    """`mpjpe` after each person's prediction was moved onto the truth by its best similarity (Procrustes).

    The similarity is that of the labelled joints; people with fewer than three are skipped. legacy: that of all joints,
    labelled or not, and for two or three people at once that of their transposed arrays.
    """
    table = aligned_errors(pred, true, visible, legacy)
    return mean(table, _average(average, legacy), empty=0.0 if legacy else None)


def pck(
    pred: np.ndarray,
    true: np.ndarray,
    visible: np.ndarray | None = None,
    legacy: bool = False,
    *,
    threshold: float = 0.3,
    torso: float = TORSO,
    average: str = "person",
) -> Score:
    """Percentage of correct keypoints: joints nearer to the truth than threshold times torso, metres.

    PCK-3 is threshold 0.3 (15.4 cm), PCK-5 is 0.5 (25.6 cm). legacy: NaN as soon as one person has no label.
    """
    table = joint_hits(pred, true, visible, threshold=threshold, torso=torso)
    return mean(table, _average(average, legacy), empty=np.nan if legacy else None)


def acceleration_error(
    pred: np.ndarray,
    true: np.ndarray,
    rate: float,
    visible: np.ndarray | None = None,
    *,
    average: str = "person",
) -> Score:
    """Mean distance of predicted and true acceleration of joints, in mm/s^2; `rate` in frames a second.

    pred, true (n, T, J, 3) m, T frames evenly apart, T of 3 or more; visible (n, T, J). Accelerations are second
    differences times rate^2; rate=1 gives mm per frame^2, the figure that most papers print. One counts where the joint
    is labelled in all its three frames. average "person" is over sequences here, and `people` counts sequences.
    """
    return mean(acceleration_errors(pred, true, rate, visible), average)


# ---- tables


def joint_errors(pred: np.ndarray, true: np.ndarray, visible: np.ndarray | None = None) -> np.ndarray:
    """(n, J) mm: each joint's distance from the truth, NaN where it has no label."""
    pred, true, labelled = checked_poses(pred, true, visible)
    return _distances(pred, true, labelled)


def aligned_errors(
    pred: np.ndarray, true: np.ndarray, visible: np.ndarray | None = None, legacy: bool = False
) -> np.ndarray:
    """`joint_errors` after the best similarity of each person's labelled joints (Umeyama 1991, no reflections); NaN for
    everything of people with fewer than three. legacy: as in `pa_mpjpe`."""
    pred, true, labelled = checked_poses(pred, true, visible)
    if legacy:
        if np.isnan(true).any():
            raise InputError("legacy alignment takes every joint, labelled or not: true must hold no NaN")
        # the released code asks the number of people whether the array is transposed
        turned = len(pred) in (2, 3)
        pair = (np.swapaxes(pred, 1, 2), np.swapaxes(true, 1, 2)) if turned else (pred, true)
        moved = similarity_align(*pair)
        return _distances(np.swapaxes(moved, 1, 2) if turned else moved, true, labelled)
    labelled &= (labelled.sum(1) >= LEAST_ALIGNED)[:, None]
    # joints without a label go to the middle of the others, where they neither move nor turn anything
    count = np.maximum(labelled.sum(1), 1)[:, None, None]
    filled = [
        np.where(known, joints, np.where(known, joints, 0.0).sum(1, keepdims=True) / count)
        for known, joints in ((labelled[..., None], pred), (labelled[..., None], true))
    ]
    return _distances(similarity_align(*filled), true, labelled)


def acceleration_errors(
    pred: np.ndarray, true: np.ndarray, rate: float, visible: np.ndarray | None = None
) -> np.ndarray:
    """(n, (T - 2) J) mm/s^2: distance of predicted and true acceleration, see `acceleration_error`; NaN where none."""
    pred, true, labelled = checked_poses(pred, true, visible, trailing=("frames", "joints", "3"))
    if pred.shape[1] < 3:
        raise InputError(f"acceleration needs sequences of 3 frames or more, got {pred.shape[1]}")
    if not (np.isfinite(rate) and rate > 0):
        raise InputError(f"rate must be a positive number of frames a second, got {rate}")
    away = np.where(labelled[..., None], pred - true, 0.0)
    known = labelled[:, :-2] & labelled[:, 1:-1] & labelled[:, 2:]
    error = np.linalg.norm(away[:, :-2] - 2 * away[:, 1:-1] + away[:, 2:], axis=-1) * rate**2 * 1e3
    return np.where(known, error, np.nan).reshape(len(error), -1)


def joint_hits(
    pred: np.ndarray,
    true: np.ndarray,
    visible: np.ndarray | None = None,
    *,
    threshold: float = 0.3,
    torso: float = TORSO,
) -> np.ndarray:
    """(n, J) percent: 100 where a joint is nearer to the truth than threshold * torso, m, else 0; NaN without label."""
    for name, value in (("threshold", threshold), ("torso", torso)):
        if not (np.isscalar(value) and np.isfinite(value) and value > 0):
            raise InputError(f"{name} must be a positive number, got {value!r}")
    error = joint_errors(pred, true, visible)
    return np.where(np.isnan(error), np.nan, 100.0 * (error < threshold * torso * 1e3))


def _distances(pred: np.ndarray, true: np.ndarray, labelled: np.ndarray) -> np.ndarray:
    away = np.where(labelled[..., None], pred - true, 0.0)
    return np.where(labelled, np.linalg.norm(away, axis=-1) * 1e3, np.nan)


# ---- confidence


def calibration_error(confidence: np.ndarray, hit: np.ndarray, *, bins: int = 10) -> float:
    """Expected calibration error, 0 to 1: mean distance of stated confidence (n,) and share of hits (n,), over equal
    bins; NaN of nothing.

    confidence: 0 to 1; hit: bool or 0/1. Raises InputError for NaN and other values: leave out what is not known.
    """
    bins = whole("bins", bins, least=1)
    confidence = _known("confidence", confidence)
    if not ((confidence >= 0) & (confidence <= 1)).all():
        raise InputError(f"confidence must be within 0 and 1, got {confidence.min():g} to {confidence.max():g}")
    hit = flags("hit", hit, confidence.shape, of="confidence")
    if not len(confidence):
        return float("nan")
    index = np.minimum((confidence * bins).astype(int), bins - 1)
    stated = np.bincount(index, confidence, bins)
    true = np.bincount(index, hit, bins)
    return float(np.abs(stated - true).sum() / len(confidence))


def auroc(score: np.ndarray, hit: np.ndarray) -> float:
    """Area under the ROC curve, 0 to 1, of scores (n,) for hits (n,): how well the score ranks hits before misses.

    score: any numbers, more is surer; hit: bool or 0/1. Raises InputError for NaN, which has no rank, and where there
    are not both hits and misses.
    """
    score = _known("score", score)
    hit = flags("hit", hit, score.shape, of="score")
    positives, negatives = int(hit.sum()), int((~hit).sum())
    if not positives or not negatives:
        raise InputError(f"AUROC needs hits and misses, got {positives} hits and {negatives} misses")
    values, inverse, counts = np.unique(score, return_inverse=True, return_counts=True)
    # ties share the mean of their ranks
    last = np.cumsum(counts)
    rank = (last - (counts - 1) / 2)[inverse]
    return float((rank[hit].sum() - positives * (positives + 1) / 2) / (positives * negatives))


def _known(name: str, values: np.ndarray) -> np.ndarray:
    """(n,) floats without NaN."""
    values = numbers(name, values)
    if values.ndim != 1:
        raise InputError(f"{name} must be (n,), got {values.shape}: pass values.ravel()")
    if unknown := int(np.isnan(values).sum()):
        raise InputError(
            f"{name} must hold numbers, got NaN in {unknown} of {len(values)}: leave these and their hits out"
        )
    return values


def _average(average: str, legacy: bool) -> str:
    if legacy and checked_average(average) != "person":
        raise InputError('legacy=True averages over people, as the released code does: pass average="person"')
    return average
