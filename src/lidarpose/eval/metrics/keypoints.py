"""The Waymo Open Dataset's pose metrics: PCK by box size, object keypoint similarity (OKS), the Pose Estimation Metric.

Definitions: docs/pose_estimation_metric.md and keypoint_metrics.py of github.com/waymo-research/waymo-open-dataset,
commits 419b532 and 7275bc1 (pose challenge, 2023). Its means over joints pool the labeled joints of all people, so
average="joint" is the default. Meters in; millimeters or percent out.
"""

from collections.abc import Sequence
from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import linear_sum_assignment

from lidarpose.errors import InputError
from lidarpose.eval.metrics.aggregate import Score, as_flags, as_numbers, check_positive, mean
from lidarpose.eval.metrics.joint_errors import checked_poses, joint_errors
from lidarpose.skeleton import WAYMO14, Skeleton, as_skeleton

# spread of each joint in units of the box's scale: twice COCO's sigmas; head_center is derived by the same method
SIGMAS = {"nose": 0.052, "head_center": 0.158, "shoulder": 0.158, "elbow": 0.144, "wrist": 0.124}
SIGMAS |= {"hip": 0.214, "knee": 0.174, "ankle": 0.178}
OKS_THRESHOLDS = (0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95)
PCK_THRESHOLDS = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5)
# cost of a missed or extra keypoint, and maximum distance of a match, m
PENALTY = 0.25
# a point nearer to a box than this counts as inside, m
_WITHIN = 1e-5


def oks_sigmas(of: Skeleton | str = WAYMO14) -> np.ndarray:
    """(J,) Waymo's sigmas for a skeleton's joints. Raises InputError if Waymo has none for a joint."""
    of = as_skeleton(of)
    sigmas = [SIGMAS.get(name.removeprefix("left_").removeprefix("right_")) for name in of.joints]
    if None in sigmas:
        missing_names = ", ".join(name for name, sigma in zip(of.joints, sigmas, strict=True) if sigma is None)
        raise InputError(f"Waymo has no sigma for {missing_names} of {of.name}: pick waymo14's joints, or give sigmas")
    return np.array(sigmas)


def box_hits(
    pred: ArrayLike,
    true: ArrayLike,
    size: ArrayLike,
    visible: ArrayLike | None = None,
    *,
    threshold: float = 0.2,
    sigmas: ArrayLike | None = None,
) -> np.ndarray:
    """(n, J) percent: 100 if a joint is within threshold times its box's scale of the truth, else 0; NaN without a
    label.

    Args:
        size: (n, 3) m.
        sigmas: (J,) additional factors per joint, which Waymo's code applies but its text does not mention.
    """
    check_positive("threshold", threshold)
    error = joint_errors(pred, true, visible)
    reach = threshold * _box_scale(size, len(error)) * 1e3
    if sigmas is not None:
        reach = reach * _checked_sigmas(sigmas, error.shape[1])
    return np.where(np.isnan(error), np.nan, 100.0 * (error <= reach))


def pck_box(
    pred: ArrayLike,
    true: ArrayLike,
    size: ArrayLike,
    visible: ArrayLike | None = None,
    *,
    threshold: float = 0.2,
    sigmas: ArrayLike | None = None,
    average: str = "joint",
) -> Score:
    """Percentage of joints within `threshold` times the cube root of their person's box volume: see `box_hits`."""
    return mean(box_hits(pred, true, size, visible, threshold=threshold, sigmas=sigmas), average)


def oks(
    pred: ArrayLike,
    true: ArrayLike,
    size: ArrayLike,
    visible: ArrayLike | None = None,
    *,
    sigmas: ArrayLike | None = None,
) -> np.ndarray:
    """(n,) object keypoint similarity in [0, 1]; NaN for people without a labeled joint.

    The mean over a person's labeled joints of exp(-d^2 / (2 (sigma s)^2)), with d the joint's distance to the truth, s
    the cube root of the box's volume and sigma the joint's own. size (n, 3) m; sigmas (J,): by default Waymo's for
    waymo14.
    """
    error = joint_errors(pred, true, visible) / 1e3
    if sigmas is None:
        if error.shape[1] != len(WAYMO14):
            raise InputError(f"OKS of {error.shape[1]} joints needs sigmas, such as oks_sigmas(skeleton)")
        sigmas = oks_sigmas()
    spread = _box_scale(size, len(error)) * _checked_sigmas(sigmas, error.shape[1])
    is_labeled = ~np.isnan(error)
    similarity = np.where(is_labeled, np.exp(-(np.where(is_labeled, error, 0) ** 2) / (2 * spread**2)), 0)
    count = is_labeled.sum(1)
    return np.where(count > 0, similarity.sum(1) / np.maximum(count, 1), np.nan)


def oks_hits(similarity: ArrayLike, thresholds: ArrayLike = OKS_THRESHOLDS) -> np.ndarray:
    """OKS (n,) -> (n,) percent: the share of the thresholds that each exceeds; NaN stays NaN. With one threshold, the
    precision at it."""
    similarity, thresholds = as_numbers("similarity", similarity), np.atleast_1d(as_numbers("thresholds", thresholds))
    if similarity.ndim != 1 or not thresholds.size:
        raise InputError(f"similarity must be (people,) and thresholds one or more, got {similarity.shape}")
    percent = 100.0 * (np.nan_to_num(similarity)[:, None] > thresholds).mean(1)
    return np.where(np.isnan(similarity), np.nan, percent)


def oks_ap(
    pred: ArrayLike,
    true: ArrayLike,
    size: ArrayLike,
    visible: ArrayLike | None = None,
    *,
    sigmas: ArrayLike | None = None,
    thresholds: ArrayLike = OKS_THRESHOLDS,
) -> Score:
    """Percent: the share of people whose OKS exceeds a threshold, averaged over the thresholds. Waymo's OKS-AP is this
    precision of matched people; it does not rank by confidence."""
    return mean(oks_hits(oks(pred, true, size, visible, sigmas=sigmas), thresholds))


def _box_scale(size: ArrayLike, people: int) -> np.ndarray:
    """size (n, 3) m, length, width and height of each person's box -> (n, 1) m: the cube root of the volume."""
    size = as_numbers("size", size)
    size = size.reshape(1, 3) if size.size == 3 else size
    if size.shape != (people, 3):
        raise InputError(f"size must be ({people}, 3), length, width and height of each person's box, got {size.shape}")
    if not (np.isfinite(size) & (size > 0)).all():
        raise InputError("size must be positive and finite, meters")
    return np.cbrt(size.prod(1))[:, None]


def _checked_sigmas(sigmas: ArrayLike, joints: int) -> np.ndarray:
    sigmas = as_numbers("sigmas", sigmas)
    if sigmas.shape != (joints,) or not (np.isfinite(sigmas) & (sigmas > 0)).all():
        raise InputError(f"sigmas must be ({joints},) positive numbers, one per joint, got {sigmas.shape}")
    return sigmas


# ---- PEM


@dataclass(frozen=True, kw_only=True)
class Pem:
    """The Pose Estimation Metric and its parts.

    pem: mm; matched_error: mm, mean distance of the matched keypoints, each at most the penalty; both NaN without
    keypoints. Keypoints: matched, missed (labeled, not predicted), extra (predicted, not labeled). People: people
    matched, people_missed, people_extra, people_excused: predictions in the box of a person without labels.
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
    pred: Sequence[ArrayLike],
    true: Sequence[ArrayLike],
    boxes: Sequence[ArrayLike],
    visible: Sequence[ArrayLike] | None = None,
    *,
    predicted: Sequence[ArrayLike] | None = None,
    penalty: float = PENALTY,
) -> Pem:
    """Waymo's PEM over frames: the mean over all keypoints of all frames, where a matched keypoint counts its distance
    and a missed or extra one counts `penalty`.

    Args: one entry per frame:
        pred: (P, J, 3) m, the predicted people, any number.
        true: (G, J, 3) m.
        boxes: (G, 7) of the true people: center, (length, width, height), yaw.
        visible: (G, J) labeled and not occluded.
        predicted: (P, J) False where a joint is not predicted; by default all are.
        penalty: m. Matching is done by `match_people`.
    """
    check_positive("penalty", penalty)
    columns = {"pred": pred, "true": true, "boxes": boxes, "visible": visible, "predicted": predicted}
    lengths = {name: len(value) for name, value in columns.items() if value is not None}
    if len(set(lengths.values())) != 1:
        raise InputError(f"PEM needs one entry per frame in every argument, got {lengths}")
    totals = np.zeros(8)
    for k in range(lengths["pred"]):
        frame = {name: None if value is None else value[k] for name, value in columns.items()}
        try:
            totals += _frame_totals(**frame, penalty=penalty)
        except InputError as error:
            raise InputError(f"frame {k}: {error}") from None
    distance, matched, missed, extra = totals[:4].tolist()
    count = matched + missed + extra
    names = ("matched", "missed", "extra", "people", "people_missed", "people_extra", "people_excused")
    return Pem(
        pem=(distance + penalty * (missed + extra)) / count * 1e3 if count else np.nan,
        matched_error=distance / matched * 1e3 if matched else np.nan,
        **dict(zip(names, totals[1:].astype(int).tolist(), strict=True)),
    )


def _frame_totals(pred, true, boxes, visible, predicted, penalty: float) -> np.ndarray:
    """(8,): sum of matched distances m; keypoints matched, missed, extra; people matched, missed, extra, excused."""
    pred, true = _people("pred", pred), _people("true", true)
    counts = {len(people[0]) for people in (pred, true) if len(people)}
    if not counts:
        return np.zeros(8)
    if len(counts) > 1:
        raise InputError(f"pred and true must have the same joints, got {pred.shape} and {true.shape}")
    (joints,) = counts
    pred, true = pred.reshape(-1, joints, 3), true.reshape(-1, joints, 3)
    checked_poses(pred, pred, None)
    _, true, labeled = checked_poses(np.zeros_like(true), true, visible if len(true) else None)
    all_predicted = np.ones(pred.shape[:2], bool)
    predicted = (
        all_predicted if predicted is None or not len(pred) else as_flags("predicted", predicted, all_predicted.shape)
    )
    boxes = as_numbers("boxes", boxes)
    boxes = boxes.reshape(0, 7) if not boxes.size else boxes
    if boxes.shape != (len(true), 7) or not np.isfinite(boxes).all() or not (boxes[:, 3:6] > 0).all():
        raise InputError(
            f"boxes must be ({len(true)}, 7), center, positive (length, width, height) and yaw, got {boxes.shape}"
        )
    matches = match_people(pred, true, boxes, predicted, labeled, penalty=penalty)
    g, p = matches.pairs.T
    cost = keypoint_costs(pred[p], true[g], predicted[p], labeled[g], penalty)
    is_matched = predicted[p] & labeled[g]
    missed = (labeled[g] & ~predicted[p]).sum() + labeled[matches.missed].sum()
    extra = (predicted[p] & ~labeled[g]).sum() + predicted[matches.extra].sum()
    return np.array([cost[is_matched].sum(), is_matched.sum(), missed, extra, *map(len, astuple(matches))])


def _people(name: str, value: ArrayLike) -> np.ndarray:
    value = as_numbers(name, value)
    if value.size and (value.ndim != 3 or value.shape[-1] != 3):
        raise InputError(f"{name} must be (people, joints, 3), got {value.shape}")
    return value if value.size else np.empty((0, 0, 3))


# ---- matching


@dataclass(frozen=True)
class Matches:
    """Matches of one frame: pairs (k, 2) of (true, predicted) rows; missed: true rows with labels and no prediction;
    extra: predicted rows without a person; excused: predicted rows matched to people without labels, which are not
    scored."""

    pairs: np.ndarray
    missed: np.ndarray
    extra: np.ndarray
    excused: np.ndarray


def match_people(
    pred: np.ndarray,
    true: np.ndarray,
    boxes: np.ndarray,
    predicted: np.ndarray,
    labeled: np.ndarray,
    *,
    penalty: float = PENALTY,
) -> Matches:
    """Matches the predictions of one frame with its people.

    pred (P, J, 3), true (G, J, 3) m, boxes (G, 7) of the people: center, (length, width, height), yaw; predicted
    (P, J), labeled (G, J) bool. First, each person without labels excuses at most one prediction that has keypoints in
    the person's box and is not near any label, such that the number of these keypoints is largest. Then the other
    predictions and the labeled people are matched with the smallest sum of mean keypoint costs, among pairs with a
    predicted keypoint within `penalty` meters of the box.
    """
    has_label = np.any(labeled, axis=1)
    distance = np.where(predicted[None], distance_to_boxes(pred, boxes), np.inf)
    # (G, P, J)
    is_near = np.linalg.norm(pred[None] - np.where(labeled[..., None], true, np.inf)[:, None], axis=-1) < penalty
    is_near_label = (is_near & predicted[None]).any((0, 2))
    num_inside = np.where(~has_label[:, None] & ~is_near_label, (distance < _WITHIN).sum(-1), 0)
    rows, columns = linear_sum_assignment(-num_inside)
    excused = columns[num_inside[rows, columns] > 0]

    is_free = np.any(predicted, axis=1)
    is_free[excused] = False
    people, candidates = np.flatnonzero(has_label), np.flatnonzero(is_free)
    cost = keypoint_costs(
        pred[None, candidates], true[people, None], predicted[None, candidates], labeled[people, None], penalty
    )
    # joints that are neither labeled nor predicted cost nothing, so that the mean is over all J
    total = np.nan_to_num(cost).mean(-1)
    total[distance[np.ix_(people, candidates)].min(-1, initial=np.inf) > penalty] = penalty
    rows, columns = linear_sum_assignment(total)
    is_match = total[rows, columns] < penalty
    pairs = np.stack([people[rows[is_match]], candidates[columns[is_match]]], -1)
    missed, extra = np.setdiff1d(people, pairs[:, 0]), np.setdiff1d(candidates, pairs[:, 1])
    return Matches(pairs, missed, extra, np.sort(excused))


def keypoint_costs(
    pred: np.ndarray, true: np.ndarray, predicted: np.ndarray, labeled: np.ndarray, penalty: float
) -> np.ndarray:
    """(..., J) m: a joint's distance, at most `penalty`, if it is labeled and predicted; `penalty` if it is only one of
    the two; NaN if it is neither. The arguments broadcast."""
    offset = np.where(labeled[..., None], pred - np.where(labeled[..., None], true, 0), 0)
    distance = np.minimum(np.linalg.norm(offset, axis=-1), penalty)
    return np.where(predicted & labeled, distance, np.where(predicted | labeled, penalty, np.nan))


def distance_to_boxes(points: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """points (..., 3) m, boxes (B, 7): center, (length, width, height), yaw -> (B, ...) m, 0 inside."""
    tail = (len(boxes),) + (1,) * (points.ndim - 1)
    x, y, z = np.moveaxis(points[None] - boxes[:, :3].reshape(*tail, 3), -1, 0)
    c, s = np.cos(boxes[:, 6]).reshape(tail), np.sin(boxes[:, 6]).reshape(tail)
    local = np.stack([c * x + s * y, c * y - s * x, z], -1)
    return np.linalg.norm(np.maximum(np.abs(local) - boxes[:, 3:6].reshape(*tail, 3) / 2, 0), axis=-1)
