"""Predictions -> rows of metrics: the mean and interval of each metric for each group of people or joints.

Everything in scores.json can be recomputed from poses.parquet. The random generator of a row's interval is seeded with
the row's name, so no row depends on which other rows are reported. How to add a metric: CONTRIBUTING.md.
"""

import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from lidarpose.data.clips import GAP
from lidarpose.errors import InputError
from lidarpose.eval.metrics import aggregate, keypoints
from lidarpose.eval.metrics.aggregate import Score, joint_groups, mean
from lidarpose.eval.metrics.joint_errors import (
    PCK3,
    PCK5,
    TORSO,
    acceleration_errors,
    aligned_errors,
    joint_hits,
    root_aligned_errors,
)
from lidarpose.eval.predictions import Predictions
from lidarpose.eval.scores import RELEASED, MetricRow, Setting, number
from lidarpose.sample import CONFIDENCE_RADIUS, FEWEST_OF_SECOND, HIDDEN, SEEN, UNLABELED

# with fewer points than PLENTY the facing is often ambiguous, with fewer than FEW nearly always
PLENTY, FEW = 100, 20
_REPEATS = 1000
# edges of the groups of joints by the number of points near them
_NEARBY_EDGES = (0, 1, 5, 20, np.inf)
# frames count as evenly spaced if two steps in time differ by less than this fraction
_EVEN = 0.2
# joints of each half of the body, without sides. Source: Haque et al. 2016, where the torso is in neither
ITOP_HALVES = {"upper": ("head_center", "neck", "shoulder", "elbow", "hand"), "lower": ("hip", "knee", "foot")}


# ---- metrics


def facing_flipped(predictions: Predictions) -> np.ndarray:
    """(N,) percent: 100 if the predicted facing, by hips and shoulders seen from above, is more than 90 degrees off the
    true one, else 0; NaN if these joints are not labeled or there is no pose."""
    skeleton = predictions.skeleton
    names = [(f"left_{joint}", f"right_{joint}") for joint in ("hip", "shoulder")]
    pairs = np.array(
        [(skeleton.index(a), skeleton.index(b)) for a, b in names if a in skeleton.joints and b in skeleton.joints], int
    )
    if not len(pairs):
        return np.full(len(predictions), np.nan)
    is_labeled = np.all(predictions.labeled[:, pairs.ravel()], axis=1)
    # (N, 2): from right to left as seen from above, summed over hips and shoulders
    predicted_left, true_left = (
        np.where(is_labeled[:, None, None], joints[:, pairs[:, 0]] - joints[:, pairs[:, 1]], 0).sum(1)[:, :2]
        for joints in (predictions.filled, predictions.true)
    )
    return np.where(is_labeled, 100.0 * ((predicted_left * true_left).sum(1) < 0), np.nan)


def _root_errors(p: Predictions) -> np.ndarray:
    names = set(p.skeleton.joints)
    if "pelvis" not in names and not names >= {"left_hip", "right_hip"}:
        return np.full(p.true.shape[:2], np.nan)
    return root_aligned_errors(p.filled, p.true, p.labeled, skeleton=p.skeleton)


def _pck(p: Predictions, threshold: float, torso: float = TORSO) -> np.ndarray:
    return joint_hits(p.filled, p.true, p.labeled, threshold=threshold, torso=torso)


def _pck_box(p: Predictions, threshold: float) -> np.ndarray:
    return keypoints.box_hits(p.filled, p.true, _box_size(p), p.labeled, threshold=threshold)


def _oks_precision(p: Predictions) -> np.ndarray:
    sigmas = keypoints.oks_sigmas(p.skeleton)
    return keypoints.oks_hits(keypoints.oks(p.filled, p.true, _box_size(p), p.labeled, sigmas=sigmas))


def _box_size(p: Predictions) -> np.ndarray:
    # people without a box are not in the section "boxes"
    return np.where(p.boxed[:, None], p.box[:, 3:6], 1.0)


@dataclass(frozen=True)
class Metric:
    """A metric that is a mean over people or joints. values: Predictions -> (N, J) or (N,), NaN where there is nothing
    to score; sections: where it is reported, see `_groups`; average: see `mean`."""

    values: Callable[[Predictions], np.ndarray]
    unit: str
    sections: tuple[str, ...]
    average: str = "person"


_EVERYWHERE = ("all", "joints", "conditions", "spans")
METRICS = {
    "mpjpe": Metric(Predictions.errors, "mm", _EVERYWHERE),
    "root_mpjpe": Metric(_root_errors, "mm", ("all",)),
    "pa_mpjpe": Metric(lambda p: aligned_errors(p.filled, p.true, p.labeled), "mm", _EVERYWHERE),
    "pck3": Metric(partial(_pck, threshold=PCK3), "%", ("all", "joints")),
    "pck5": Metric(partial(_pck, threshold=PCK5), "%", ("all", "joints")),
    "turned_round": Metric(facing_flipped, "%", ("dense",)),
    **{
        f"pck_box@{threshold:g}": Metric(partial(_pck_box, threshold=threshold), "%", ("boxes",), "joint")
        for threshold in keypoints.PCK_THRESHOLDS
    },
    "oks_ap": Metric(_oks_precision, "%", ("boxes",)),
    "pck_10cm": Metric(partial(_pck, threshold=CONFIDENCE_RADIUS, torso=1.0), "%", ("itop",), "joint"),
}


def _pem(p: Predictions, setting: Setting) -> Score | None:
    """Waymo's PEM. People are predicted in their own labeled boxes, so there are no false positives; people without a
    pose are missed. Hidden labels do not count, as in Waymo's rules."""
    if not _has_waymo_boxes(p, setting):
        return None
    frames: dict[tuple, list[int]] = {}
    for k in np.flatnonzero(p.boxed).tolist():
        frames.setdefault((p.sequence[k], p.frame[k]), []).append(k)
    frame_rows = [np.array(rows) for rows in frames.values()]
    columns = (p.true, p.box, p.labels == SEEN)
    pred = [p.pred[rows][p.posed[rows]] for rows in frame_rows]
    result = keypoints.pem(pred, *([column[rows] for rows in frame_rows] for column in columns))
    joints = result.matched + result.missed + result.extra
    people = result.people + result.people_missed
    return Score(result.pem, people=people, joints=joints, skipped=result.people_excused)


def _of_confidence(p: Predictions, setting: Setting, metric: Callable) -> Score | None:
    """Confidence against hits, pooled over all labeled joints; None if there is none or it cannot be ranked."""
    error = p.errors()
    is_stated = ~np.isnan(error) & ~np.isnan(p.confidence)
    is_hit = error[is_stated] < 1e3 * CONFIDENCE_RADIUS
    if not is_stated.any() or (metric is aggregate.auroc and is_hit.all() == is_hit.any()):
        return None
    is_counted = is_stated.any(1)
    value = 100 * metric(p.confidence[is_stated].astype(float), is_hit)
    return Score(value, people=is_counted.sum(), joints=is_stated.sum(), skipped=(p.posed & ~is_counted).sum())


def _p95(p: Predictions, setting: Setting) -> Score | None:
    """The 95th percentile of the people's mean errors."""
    error = p.errors()
    is_labeled = ~np.isnan(error)
    has_label = is_labeled.any(1)
    if not has_label.any():
        return None
    value = np.percentile(np.nanmean(error[has_label], axis=1), 95)
    return Score(value, people=has_label.sum(), joints=is_labeled.sum(), skipped=(p.posed & ~has_label).sum())


# metrics that pool all people, without an interval: (Predictions, Setting) -> Score or None, unit
SUMMARIES: dict[str, tuple[Callable[[Predictions, Setting], Score | None], str]] = {
    "pem": (_pem, "mm"),
    "mpjpe_p95": (_p95, "mm"),
    "calibration_error": (partial(_of_confidence, metric=aggregate.calibration_error), "%"),
    "auroc": (partial(_of_confidence, metric=aggregate.auroc), "%"),
}


# ---- groups of people and joints


def _groups(section: str, p: Predictions, setting: Setting) -> Iterator[tuple[str, str, np.ndarray, np.ndarray | None]]:
    """Yields (group, of, rows (N,) bool, joint indices or None for all) of a section of the report."""
    all_rows = np.ones(len(p), bool)
    if section == "all":
        yield "all", "all", all_rows, None
    elif section == "dense":
        has_facing = ~np.isnan(facing_flipped(p))
        is_dense, is_sparse = p.points >= PLENTY, (p.points >= FEW) & (p.points < PLENTY)
        for of, rows in ((f"{PLENTY} and more", is_dense), (f"{FEW} to {PLENTY}", is_sparse)):
            if has_facing[rows].any():
                yield "points", of, rows, None
    elif section == "joints":
        for name, joints in joint_groups(p.skeleton).items():
            if name != "all":
                yield "joints", name, all_rows, joints
    elif section == "conditions":
        for title in ("condition", "poses", "family", "sensor"):
            values = getattr(p, title)
            for of in np.unique(values[values != ""]).tolist():
                yield title, of, values == of, None
        yield "plain", "upright, whole, uncluttered, 100 points", p.plain, None
    elif section == "spans":
        hidden_shares = p.hidden if not np.isnan(p.hidden).all() else hidden_share(p.labels)
        spans = {"distance, m": (p.distance, aggregate.DISTANCE_EDGES), "points": (p.points, aggregate.POINT_EDGES)}
        for title, (values, edges) in (spans | {"hidden share": (hidden_shares, aggregate.OCCLUSION_EDGES)}).items():
            for of, rows in aggregate.span_rows(values, edges).items():
                yield title, of, rows, None
    elif section == "itop" and setting.kind == "itop":
        yield "all", "all", all_rows, None
        for half, stems in ITOP_HALVES.items():
            names = [name for name in p.skeleton.joints if name.removeprefix("left_").removeprefix("right_") in stems]
            if names:
                yield "body", half, all_rows, np.array([p.skeleton.index(name) for name in names])
        for j, name in enumerate(p.skeleton.joints):
            yield "joint", name, all_rows, np.array([j])
    elif section == "boxes" and _has_waymo_boxes(p, setting) and (p.boxed & p.posed).any():
        yield "all", "all", p.boxed, None


def _has_waymo_boxes(p: Predictions, setting: Setting) -> bool:
    """Whether Waymo's own metrics apply: there are labeled boxes, and each joint has a sigma."""
    try:
        keypoints.oks_sigmas(p.skeleton)
    except InputError:
        return False
    return setting.kind == "waymo" and bool(p.boxed.any())


def hidden_share(labels: np.ndarray) -> np.ndarray:
    """labels (n, J) -> (n,): the share of each person's labeled joints that are hidden; all NaN if no joint at all is
    labeled as hidden, since such labels do not record occlusion."""
    if not (labels == HIDDEN).any():
        return np.full(len(labels), np.nan)
    count = (labels != UNLABELED).sum(1)
    return np.where(count > 0, (labels == HIDDEN).sum(1) / np.maximum(count, 1), np.nan)


# ---- the rows


def metric_rows(predictions: Predictions, setting: Setting, *, dapt_compat: bool = False) -> tuple[MetricRow, ...]:
    """The rows of a dataset's people; dapt_compat: also rows with the released code's arithmetic."""
    people = predictions.select(~predictions.moving)
    rows = [*_mean_rows(people, setting, ("all", "dense", "joints", "conditions", "spans", "boxes", "itop"))]
    rows += _nearby_rows(people, setting)
    for name, (summary, unit) in SUMMARIES.items():
        if (score := summary(people, setting)) is not None:
            rows.append(_row(score, setting, name, unit=unit, no_pose=int((~people.posed).sum())))
    rows += _acceleration(predictions, setting)
    return tuple([*rows, *_dapt_compat_rows(people, setting)] if dapt_compat else rows)


def baseline_rows(predictions: Predictions, setting: Setting) -> tuple[MetricRow, ...]:
    """The rows of a baseline: over all people, and MPJPE by condition."""
    people = predictions.select(~predictions.moving)
    by_condition = _mean_rows(people, setting, ("conditions",), metrics=("mpjpe",))
    return (*_mean_rows(people, setting, ("all", "dense")), *by_condition)


def _mean_rows(
    p: Predictions, setting: Setting, sections: Sequence[str], metrics: Sequence[str] = ()
) -> Iterator[MetricRow]:
    tables: dict[str, np.ndarray] = {}
    for section in sections:
        for group, of, rows, joints in _groups(section, p, setting):
            clusters = p.sequence[rows] if setting.clusters else None
            no_pose = int((~p.posed[rows]).sum())
            for name in (metrics or METRICS) if rows.any() else ():
                if section in METRICS[name].sections:
                    if name not in tables:
                        tables[name] = METRICS[name].values(p)
                    table = tables[name][rows] if joints is None else tables[name][rows][:, joints]
                    yield _mean_row(table, setting, name, METRICS[name], group, of, clusters=clusters, no_pose=no_pose)


def _nearby_rows(p: Predictions, setting: Setting) -> Iterator[MetricRow]:
    """MPJPE of joints, each counting once, by the number of points near the true joint."""
    errors, metric = p.errors(), replace(METRICS["mpjpe"], average="joint")
    for of, is_inside in aggregate.span_rows(p.nearby, _NEARBY_EDGES).items():
        is_scored = is_inside & ~np.isnan(errors)
        rows = is_scored.any(1)
        if rows.any():
            table = np.where(is_scored, errors, np.nan)[rows]
            clusters = p.sequence[rows] if setting.clusters else None
            yield _mean_row(table, setting, "mpjpe", metric, "points near the joint", of, clusters=clusters)


def _mean_row(
    table: np.ndarray, setting: Setting, figure: str, metric: Metric, group: str, of: str, *, clusters=None, no_pose=0
) -> MetricRow:
    """The mean of a table (n, J) or (n,) as a row, with its interval, see `Interval.stated`."""
    name = f"{setting.method}/{figure}/{group}/{of}"
    rng = np.random.default_rng([setting.seed, zlib.crc32(name.encode())])
    low, high = aggregate.interval(table, rng, metric.average, clusters=clusters, repeats=_REPEATS).stated
    score = mean(table, metric.average)
    score.skipped -= no_pose
    return _row(score, setting, figure, unit=metric.unit, group=group, of=of, low=low, high=high, no_pose=no_pose)


def _row(
    score: Score, setting: Setting, figure: str, *, group: str = "all", of: str = "all", **other_fields: Any
) -> MetricRow:
    """A score as a row; other_fields: of `MetricRow`."""
    counts: dict[str, Any] = {name: int(getattr(score, name)) for name in ("people", "joints", "skipped")}
    setting_values = {name: getattr(setting, name) for name in ("method", "protocol", "centring", "split", "limit")}
    return MetricRow(figure=figure, group=group, of=of, value=number(score), **counts | setting_values | other_fields)


def _dapt_compat_rows(p: Predictions, setting: Setting) -> Iterator[MetricRow]:
    """The released code's arithmetic on people with a pose; docs/evaluate.md lists the differences."""
    posed_people = p.select(p.posed)
    if not len(posed_people):
        return
    tables = {name: METRICS[name].values(posed_people) for name in ("mpjpe", "pck3", "pck5")}
    # its alignment uses all joints, so it is undefined if a joint is not labeled
    if not np.isnan(posed_people.true).any():
        tables["pa_mpjpe"] = aligned_errors(posed_people.pred, posed_people.true, dapt_compat=True)
    for metric, table in tables.items():
        is_pck, unit = metric.startswith("pck"), METRICS[metric].unit
        for name, joints in joint_groups(p.skeleton).items():
            if name == "all" or not is_pck:
                score = mean(table[:, joints], empty=np.nan if is_pck else 0.0)
                score.skipped = 0
                group = "all" if name == "all" else "joints"
                options: dict[str, Any] = {"unit": unit, "no_pose": len(p) - len(posed_people), "arithmetic": RELEASED}
                yield _row(score, setting, metric, group=group, of=name, **options)


# ---- person probabilities


def person_rows(p: Predictions, objects: np.ndarray, others: np.ndarray, setting: Setting) -> Iterator[MetricRow]:
    """AUROC of a network's person probabilities: crops of people against objects, and of two people against one.

    Args:
        p: people.
        objects: (K,) the predicted probability of a person for each object.
        others: (N,) number of points on a second person; crops with only a few such points are left out.
    """
    is_clear = (others == 0) | (others >= FEWEST_OF_SECOND)
    rankings = {
        # a crop without a pose counts as a prediction of no person
        "person_auroc": (
            np.append(np.where(p.posed, p.person, 0), objects).astype(np.float32),
            np.arange(len(p) + len(objects)) < len(p),
        ),
        "second_person_auroc": (p.second_person[is_clear], others[is_clear] > 0),
    }
    for figure, (probability, is_true) in rankings.items():
        is_stated = ~np.isnan(probability)
        if len(np.unique(is_true[is_stated])) == 2:
            value = 100 * aggregate.auroc(probability[is_stated].astype(float), is_true[is_stated])
            yield _row(Score(value, people=int(is_stated.sum())), setting, figure, unit="%")


# ---- motion


def triples(p: Predictions) -> np.ndarray:
    """(T, 3) rows: three successive, evenly spaced frames of one person in one sequence, each with a pose."""
    tracks = [f"{sequence}\0{track}" for sequence, track in zip(p.sequence, p.track, strict=True)]
    _, owner = np.unique(tracks, return_inverse=True)
    order = np.lexsort((p.frame, owner))
    if len(order) < 3:
        return np.empty((0, 3), int)
    rows = np.stack([order[:-2], order[1:-1], order[2:]], 1)
    first_step, second_step = np.diff(p.time[rows], axis=1).T
    with np.errstate(invalid="ignore"):
        # a step from the end of one track to the beginning of the next is excluded
        is_even = (
            (owner[rows] == owner[rows[:, :1]]).all(1)
            & (first_step > 0)
            & (np.abs(second_step - first_step) < _EVEN * first_step)
        )
        # the steps between frame numbers must be the smallest of the sequence, so that no frame is skipped. Steps in
        # time do not show that: clocks jitter, and next to one short step all others would be too long
        _, sequence = np.unique(p.sequence, return_inverse=True)
        pairs = np.stack([order[:-1], order[1:]], 1)
        pair_step = np.diff(p.frame[pairs], axis=1)[:, 0]
        is_step = (owner[pairs[:, 0]] == owner[pairs[:, 1]]) & (pair_step > 0)
        step = np.full(int(sequence.max()) + 1, np.inf)
        np.minimum.at(step, sequence[pairs[is_step, 0]], pair_step[is_step])
        is_even &= (np.diff(p.frame[rows], axis=1) < GAP * step[sequence[rows[:, :1]]]).all(1)
    return rows[is_even & p.posed[rows].all(1)]


def _acceleration(p: Predictions, setting: Setting) -> Iterator[MetricRow]:
    """Acceleration error over all triples of successive frames, in mm per frame squared."""
    # people drawn by a limit are not successive frames
    rows = triples(p) if setting.limit is None else np.empty((0, 3), int)
    if len(rows):
        table = acceleration_errors(p.filled[rows], p.true[rows], 1.0, p.labeled[rows])
        metric, clusters = Metric(lambda _: table, "mm/frame²", ("all",)), p.sequence[rows[:, 0]]
        yield _mean_row(table, setting, "acceleration", metric, "all", "frames in a row", clusters=clusters)
