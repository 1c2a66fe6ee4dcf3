"""Which prediction belongs to which person: Waymo's matcher by keypoint errors, and the assignment beneath it.

Source: the Waymo Open Dataset's docs/pose_estimation_metric.md and its keypoint_metrics.py, 2023.
"""

from dataclasses import dataclass

import numpy as np

from lidarpose.errors import InputError

# nearer than this to a box counts as within it, m
_WITHIN = 1e-5


@dataclass(frozen=True, kw_only=True)
class Matches:
    """Of one frame: pairs (k, 2) of (true, predicted) rows; missed: true rows with labels that nobody predicted; extra:
    predicted rows of nobody; excused: predicted rows of people without labels, which neither help nor harm."""

    pairs: np.ndarray
    missed: np.ndarray
    extra: np.ndarray
    excused: np.ndarray


def assign(cost: np.ndarray) -> np.ndarray:
    """The assignment of least total cost: cost (n, m) finite -> (min(n, m), 2) of (row, column), rows rising.

    The Hungarian method (Kuhn 1955) by shortest augmenting paths (Jonker & Volgenant 1987).
    """
    cost = np.asarray(cost, float)
    if cost.ndim != 2 or not np.isfinite(cost).all():
        raise InputError(f"costs must be (rows, columns) of finite numbers, got shape {cost.shape}")
    if cost.shape[0] > cost.shape[1]:
        swapped = assign(cost.T)[:, ::-1]
        return swapped[np.argsort(swapped[:, 0])]
    n, m = cost.shape
    row_price, column_price = np.zeros(n), np.zeros(m)
    row_of = np.full(m, -1)
    for start in range(n):
        # Dijkstra over columns: reduced costs are never negative
        length, before = np.full(m, np.inf), np.full(m, -1)
        settled = np.zeros(m, bool)
        row, here, reached = start, -1, 0.0
        while True:
            onward = reached + cost[row] - row_price[row] - column_price
            shorter = ~settled & (onward < length)
            length[shorter], before[shorter] = onward[shorter], here
            here = int(np.argmin(np.where(settled, np.inf, length)))
            reached = length[here]
            settled[here] = True
            if row_of[here] < 0:
                break
            row = row_of[here]
        passed = settled & (row_of >= 0)
        row_price[start] += reached
        row_price[row_of[passed]] += reached - length[passed]
        column_price[passed] -= reached - length[passed]
        while here >= 0:
            row_of[here] = row_of[before[here]] if before[here] >= 0 else start
            here = before[here]
    columns = np.flatnonzero(row_of >= 0)
    pairs = np.stack([row_of[columns], columns], -1)
    return pairs[np.argsort(pairs[:, 0])]


def distance_to_boxes(points: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """points (..., 3) m, boxes (B, 7): center, (length, width, height), yaw -> (B, ...) m, 0 inside."""
    points, boxes = np.asarray(points, float), np.asarray(boxes, float)
    tail = (len(boxes),) + (1,) * (points.ndim - 1)
    offset = points[None] - boxes[:, :3].reshape(*tail, 3)
    c, s = np.cos(boxes[:, 6]).reshape(tail), np.sin(boxes[:, 6]).reshape(tail)
    x, y, z = np.moveaxis(offset, -1, 0)
    local = np.stack([c * x + s * y, c * y - s * x, z], -1)
    return np.linalg.norm(np.maximum(np.abs(local) - boxes[:, 3:6].reshape(*tail, 3) / 2, 0), axis=-1)


def keypoint_costs(
    pred: np.ndarray, true: np.ndarray, predicted: np.ndarray, labelled: np.ndarray, penalty: float
) -> np.ndarray:
    """(..., J) m: a joint's distance, at most `penalty`, where it is labelled and predicted; `penalty` where it is only
    one of both; NaN where it is neither. The arguments broadcast."""
    away = np.where(labelled[..., None], pred - np.where(labelled[..., None], true, 0), 0)
    near = np.minimum(np.linalg.norm(away, axis=-1), penalty)
    return np.where(predicted & labelled, near, np.where(predicted | labelled, penalty, np.nan))


def match_people(
    pred: np.ndarray,
    true: np.ndarray,
    boxes: np.ndarray,
    predicted: np.ndarray,
    labelled: np.ndarray,
    *,
    penalty: float = 0.25,
) -> Matches:
    """Matches the predictions of one frame with its people.

    pred (P, J, 3), true (G, J, 3) m, boxes (G, 7) of the people: center, (length, width, height), yaw; predicted
    (P, J), labelled (G, J) bool. First, people without labels take away the predictions that lie in their boxes and
    near nobody else's labels, as many keypoints as possible. Then predictions and labelled people are matched so that
    the sum of the mean keypoint costs is least, among pairs with a predicted keypoint within `penalty` metres of the
    box.
    """
    present = predicted.any(1)
    has_label = labelled.any(1)
    apart = np.where(predicted[None], distance_to_boxes(pred, boxes), np.inf)
    # (G, P, J)
    near = np.linalg.norm(pred[None] - np.where(labelled[..., None], true, np.inf)[:, None], axis=-1) < penalty
    claimed = (near & predicted[None]).any((0, 2))
    inside = np.where(~has_label[:, None] & ~claimed, (apart < _WITHIN).sum(-1), 0)
    excused = np.array([p for g, p in assign(-inside.astype(float)) if inside[g, p] > 0], int)

    free = present.copy()
    free[excused] = False
    judged, candidates = np.flatnonzero(has_label), np.flatnonzero(free)
    cost = keypoint_costs(
        pred[None, candidates], true[judged, None], predicted[None, candidates], labelled[judged, None], penalty
    )
    # joints that neither has count as free of error, so that the mean is over all J
    total = np.nan_to_num(cost).mean(-1)
    total[apart[np.ix_(judged, candidates)].min(-1, initial=np.inf) > penalty] = penalty
    pairs = np.array([(g, p) for g, p in assign(total) if total[g, p] < penalty], int).reshape(-1, 2)
    pairs = np.stack([judged[pairs[:, 0]], candidates[pairs[:, 1]]], -1)
    return Matches(
        pairs=pairs,
        missed=np.setdiff1d(judged, pairs[:, 0]),
        extra=np.setdiff1d(candidates, pairs[:, 1]),
        excused=np.sort(excused),
    )
