"""The Waymo Open Dataset's pose metrics: PCK by box size, object keypoint similarity (OKS), the Pose Estimation Metric.

Definitions: docs/pose_estimation_metric.md and keypoint_metrics.py of github.com/waymo-research/waymo-open-dataset,
commits 419b532 and 7275bc1 (pose challenge, 2023). Its means over joints are over everybody's labelled joints at once,
so average="joint" is the default. Metres in; millimetres or percent out.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidarpose.errors import InputError
from lidarpose.eval.metrics.aggregate import Score, mean
from lidarpose.eval.metrics.arrays import checked_poses, flags, numbers
from lidarpose.eval.metrics.joint_errors import joint_errors
from lidarpose.eval.metrics.matching import keypoint_costs, match_people
from lidarpose.skeleton import WAYMO14, Skeleton, skeleton

# spread of each joint in units of the box's scale; twice COCO's sigmas, the head's center by the same method
SIGMAS = {
    "nose": 0.052,
    "head_center": 0.158,
    "shoulder": 0.158,
    "elbow": 0.144,
    "wrist": 0.124,
    "hip": 0.214,
    "knee": 0.174,
    "ankle": 0.178,
}
OKS_THRESHOLDS = (0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95)
PCK_THRESHOLDS = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5)
# cost of a keypoint that is missed or made up, and farthest distance of a match, m
PENALTY = 0.25


def oks_sigmas(of: Skeleton | str = WAYMO14) -> np.ndarray:
    """(J,) Waymo's sigmas for a skeleton's joints; raises InputError where Waymo has none for a joint."""
    of = skeleton(of) if isinstance(of, str) else of
    kinds = [name.removeprefix("left_").removeprefix("right_") for name in of.joints]
    without = [name for name, kind in zip(of.joints, kinds, strict=True) if kind not in SIGMAS]
    if without:
        raise InputError(
            f"Waymo has no sigma for {', '.join(without)} of {of.name}: pick waymo14's joints, or give sigmas"
        )
    return np.array([SIGMAS[kind] for kind in kinds])


def box_scale(size: np.ndarray, people: int) -> np.ndarray:
    """size (n, 3) m, length, width and height of each person's box -> (n,) m: the cube root of its volume."""
    size = numbers("size", size).reshape(-1, 3) if np.size(size) == 3 else numbers("size", size)
    if size.shape != (people, 3):
        raise InputError(f"size must be ({people}, 3), length, width and height of each person's box, got {size.shape}")
    if not (np.isfinite(size) & (size > 0)).all():
        raise InputError("size must be positive and finite, metres")
    return np.cbrt(size.prod(1))


def box_hits(
    pred: np.ndarray,
    true: np.ndarray,
    size: np.ndarray,
    visible: np.ndarray | None = None,
    *,
    threshold: float = 0.2,
    sigmas: Sequence[float] | None = None,
) -> np.ndarray:
    """(n, J) percent: 100 where a joint is within threshold times its box's scale of the truth, else 0; NaN without
    label. size (n, 3) m; sigmas (J,): times these, too, which Waymo's code does and its text does not."""
    if not (np.isscalar(threshold) and np.isfinite(threshold) and threshold > 0):
        raise InputError(f"threshold must be a positive number, got {threshold!r}")
    error = joint_errors(pred, true, visible)
    reach = threshold * box_scale(size, len(error))[:, None] * 1e3
    if sigmas is not None:
        reach = reach * _checked_sigmas(sigmas, error.shape[1])
    return np.where(np.isnan(error), np.nan, 100.0 * (error <= reach))


def pck_box(
    pred: np.ndarray,
    true: np.ndarray,
    size: np.ndarray,
    visible: np.ndarray | None = None,
    *,
    threshold: float = 0.2,
    sigmas: Sequence[float] | None = None,
    average: str = "joint",
) -> Score:
    """Percentage of joints within `threshold` times the cube root of their person's box volume: see `box_hits`."""
    return mean(box_hits(pred, true, size, visible, threshold=threshold, sigmas=sigmas), average)


def oks(
    pred: np.ndarray,
    true: np.ndarray,
    size: np.ndarray,
    visible: np.ndarray | None = None,
    *,
    sigmas: Sequence[float] | None = None,
) -> np.ndarray:
    """(n,) object keypoint similarity in [0, 1]; NaN for people without a labelled joint.

    The mean over a person's labelled joints of exp(-d^2 / (2 (sigma s)^2)): d the distance, s the cube root of the
    box's volume, sigma the joint's own. size (n, 3) m; sigmas (J,): Waymo's for the joints of waymo14 by default.
    """
    error = joint_errors(pred, true, visible) / 1e3
    if sigmas is None:
        if error.shape[1] != len(WAYMO14):
            raise InputError(f"OKS of {error.shape[1]} joints needs sigmas, such as oks_sigmas(skeleton)")
        sigmas = oks_sigmas()
    spread = box_scale(size, len(error))[:, None] * _checked_sigmas(sigmas, error.shape[1])
    known = ~np.isnan(error)
    alike = np.where(known, np.exp(-(np.where(known, error, 0) ** 2) / (2 * spread**2)), 0)
    count = known.sum(1)
    return np.where(count > 0, alike.sum(1) / np.maximum(count, 1), np.nan)


def oks_hits(similarity: np.ndarray, thresholds: Sequence[float] = OKS_THRESHOLDS) -> np.ndarray:
    """OKS (n,) -> (n,) percent: the share of the thresholds that it is above; NaN stays. One threshold: P at it."""
    similarity, thresholds = numbers("similarity", similarity), np.atleast_1d(numbers("thresholds", thresholds))
    if similarity.ndim != 1 or not thresholds.size:
        raise InputError(f"similarity must be (people,) and thresholds one or more, got {similarity.shape}")
    above = 100.0 * (np.nan_to_num(similarity)[:, None] > thresholds).mean(1)
    return np.where(np.isnan(similarity), np.nan, above)


def oks_ap(
    pred: np.ndarray,
    true: np.ndarray,
    size: np.ndarray,
    visible: np.ndarray | None = None,
    *,
    sigmas: Sequence[float] | None = None,
    thresholds: Sequence[float] = OKS_THRESHOLDS,
) -> Score:
    """Percent: the share of people whose OKS is above a threshold, averaged over the thresholds. Waymo's OKS-AP is this
    precision of matched people; it ranks nothing by confidence."""
    return mean(oks_hits(oks(pred, true, size, visible, sigmas=sigmas), thresholds))


@dataclass(frozen=True, kw_only=True)
class Pem:
    """The Pose Estimation Metric and what it is made of.

    pem: mm; matched_error: mm, mean of the matched keypoints' distances, each at most the penalty; both NaN where there
    is nothing. Keypoints: matched, missed (labelled, not predicted), extra (predicted, not labelled). People: people
    matched, people_missed, people_extra, people_excused, who were predicted in the box of somebody without labels.
    """

    pem: float
    matched_error: float
    matched: int
    missed: int
    extra: int
    people: int
    people_missed: int
    people_extra: int
    people_excused: int


def pem(
    pred: Sequence[np.ndarray],
    true: Sequence[np.ndarray],
    boxes: Sequence[np.ndarray],
    visible: Sequence[np.ndarray] | None = None,
    *,
    predicted: Sequence[np.ndarray] | None = None,
    penalty: float = PENALTY,
) -> Pem:
    """Waymo's PEM over frames: the mean, over all keypoints of all frames, of the matched ones' distances and of
    `penalty` for each one that is missed or made up.

    One entry a frame: pred (P, J, 3) m, the people that were found, their number free; true (G, J, 3) m; boxes (G, 7)
    of the true people: center, (length, width, height), yaw; visible (G, J): labelled and not occluded; predicted
    (P, J): False where a joint is not claimed, by default all are. Matching is `matching.match_people`'s.
    """
    if not (np.isscalar(penalty) and np.isfinite(penalty) and penalty > 0):
        raise InputError(f"penalty must be a positive distance in metres, got {penalty!r}")
    columns = {"pred": pred, "true": true, "boxes": boxes, "visible": visible, "predicted": predicted}
    lengths = {name: len(value) for name, value in columns.items() if value is not None}
    if len(set(lengths.values())) != 1:
        raise InputError(f"PEM needs one entry a frame of everything, got {lengths}")
    sums = np.zeros(4)
    tally = np.zeros(4, int)
    for k in range(lengths["pred"]):
        frame = {name: None if value is None else value[k] for name, value in columns.items()}
        try:
            found, people = _frame(**frame, penalty=penalty)
        except InputError as error:
            raise InputError(f"frame {k}: {error}") from None
        sums += found
        tally += people
    total, matched, missed, extra = sums
    count = matched + missed + extra
    return Pem(
        pem=float((total + penalty * (missed + extra)) / count * 1e3) if count else np.nan,
        matched_error=float(total / matched * 1e3) if matched else np.nan,
        matched=int(matched),
        missed=int(missed),
        extra=int(extra),
        people=int(tally[0]),
        people_missed=int(tally[1]),
        people_extra=int(tally[2]),
        people_excused=int(tally[3]),
    )


def _frame(pred, true, boxes, visible, predicted, penalty) -> tuple[tuple[float, ...], tuple[int, ...]]:
    """Sum of matched distances m, keypoints matched, missed, extra; people matched, missed, extra, excused."""
    pred, true = (_people(name, value) for name, value in (("pred", pred), ("true", true)))
    joints = {len(people[0]) for people in (pred, true) if len(people)}
    if not joints:
        return (0.0, 0, 0, 0), (0, 0, 0, 0)
    if len(joints) > 1:
        raise InputError(f"pred and true must have the same joints, got {pred.shape} and {true.shape}")
    (count,) = joints
    pred, true = pred.reshape(-1, count, 3), true.reshape(-1, count, 3)
    pred, _, _ = checked_poses(pred, pred, None)
    _, true, labelled = checked_poses(np.zeros_like(true), true, visible if len(true) else None)
    given = predicted is not None and len(pred)
    predicted = flags("predicted", predicted, pred.shape[:2]) if given else np.ones(pred.shape[:2], bool)
    boxes = numbers("boxes", boxes)
    boxes = boxes.reshape(0, 7) if not boxes.size else boxes
    if boxes.shape != (len(true), 7) or not np.isfinite(boxes).all() or not (boxes[:, 3:6] > 0).all():
        raise InputError(
            f"boxes must be ({len(true)}, 7), center, positive (length, width, height) and yaw, got {boxes.shape}"
        )
    matches = match_people(pred, true, boxes, predicted, labelled, penalty=penalty)
    g, p = matches.pairs.T
    cost = keypoint_costs(pred[p], true[g], predicted[p], labelled[g], penalty)
    both = predicted[p] & labelled[g]
    missed = (labelled[g] & ~predicted[p]).sum() + labelled[matches.missed].sum()
    extra = (predicted[p] & ~labelled[g]).sum() + predicted[matches.extra].sum()
    people = (len(matches.pairs), len(matches.missed), len(matches.extra), len(matches.excused))
    return (float(cost[both].sum()), int(both.sum()), int(missed), int(extra)), people


def _people(name: str, value: np.ndarray) -> np.ndarray:
    value = numbers(name, value)
    if value.size and (value.ndim != 3 or value.shape[-1] != 3):
        raise InputError(f"{name} must be (people, joints, 3), got {value.shape}")
    return value if value.size else np.empty((0, 0, 3))


def _checked_sigmas(sigmas: Sequence[float], joints: int) -> np.ndarray:
    sigmas = numbers("sigmas", sigmas)
    if sigmas.shape != (joints,) or not (np.isfinite(sigmas) & (sigmas > 0)).all():
        raise InputError(f"sigmas must be ({joints},) positive numbers, one a joint, got {sigmas.shape}")
    return sigmas
