"""Detections against labeled people: matching, recall by false people a scan, average precision, calibration.

Recall is stated at operating points: the lowest score at which a detector has at most so many false people a scan, over
all scans, as in FROC curves. Intervals are percentile bootstraps over scans; the score is found anew in every draw.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from lidarpose.errors import InputError
from lidarpose.eval.detector.labeled_scans import LabeledScan, ScanSet
from lidarpose.eval.metrics import aggregate
from lidarpose.eval.metrics.joint_errors import joint_errors
from lidarpose.inference.checks import rows_inside
from lidarpose.inference.predictor import Predictor
from lidarpose.sample import Box
from lidarpose.skeleton import BODY26, HUMAN15

# a person is found by a detection whose center is so near in x and y, m
MATCH_RADIUS = 0.5
# people of fewer points are neither wanted nor false
LEAST_POINTS = 10
# operating points: false people a scan; the middle one decides what is missed, and poses
FALSE_PER_SCAN = (0.3, 1.0, 3.0, 10.0)
REFERENCE = 1.0
POINT_EDGES = (LEAST_POINTS, 20, 50, np.inf)
DISTANCE_EDGES = (0.0, 10.0, 20.0, 30.0, np.inf)
# conditions: another person or a thing so near, m, and people who are less tall, m
_COMPANY, _TOUCHING, _LOW = 1.0, 0.3, 1.4
_REPEATS, _BINS = 1000, 10
# what a detection is of
PERSON, FALSE, NEITHER = "person", "false", "neither"

# points (n, 3) m and the sensor's origin -> boxes with scores 0 to 1
Detect = Callable[[np.ndarray, np.ndarray | None], tuple[Sequence[Box], np.ndarray]]


def match(centers: np.ndarray, scores: np.ndarray, people: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """(D,) of each detection the person that it finds, or -1, one to one.

    By falling score, each takes the nearest person within `MATCH_RADIUS` whom none has taken, one who is not wanted
    only where there is none who is.

    Args:
        centers: (D, 2) m. scores: (D,). people: (P, 2) m. wanted: (P,) bool.
    """
    of_person = np.full(len(centers), -1)
    distance = np.linalg.norm(centers[:, None] - people[None], axis=-1)
    distance[distance > MATCH_RADIUS] = np.inf
    for d in np.argsort(-scores, kind="stable"):
        for near in (np.where(wanted, distance[d], np.inf), distance[d]):
            if len(people) and np.isfinite(near.min()):
                of_person[d] = near.argmin()
                distance[:, of_person[d]] = np.inf
                break
    return of_person


# ---- one scan


def score_scan(
    number: int, scan: LabeledScan, boxes: Sequence[Box], scores: np.ndarray, *, max_range: float
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Rows of the scan's wanted people, and of its detections."""
    origin = np.zeros(2) if scan.origin is None else scan.origin[:2]
    people = np.array([box.center[:2] for box in scan.boxes]).reshape(-1, 2)
    centers = np.array([box.center[:2] for box in boxes]).reshape(-1, 2)
    far, distance = (np.linalg.norm(at - origin, axis=1) for at in (centers, people))
    wanted = scan.is_person & (scan.num_points >= LEAST_POINTS) & (distance <= max_range)
    of_person = match(centers, scores, people, wanted)
    finds = np.append(wanted, False)[of_person]
    status = np.where(finds, PERSON, np.where((of_person >= 0) | (far > max_range), NEITHER, FALSE))
    detection_of = {int(p): d for d, p in enumerate(of_person) if p >= 0}
    conditions = _conditions(scan, people)
    where = {"scan": number, "sensor": scan.sensor, "kind": scan.kind}
    people_rows = [
        where
        | {"person": p, "points": int(scan.num_points[p]), "distance": float(distance[p]), "condition": conditions[p]}
        | {"mounted": bool(scan.mounted[p]), "detection": detection_of.get(p, -1)}
        | {"score": float(scores[detection_of[p]]) if p in detection_of else -np.inf}
        for p in np.flatnonzero(wanted).tolist()
    ]
    things = _things(scan, [box for box, is_of in zip(boxes, status, strict=True) if is_of == FALSE])
    detection_rows = [
        where
        | {"detection": d, "score": float(scores[d]), "status": str(status[d])}
        | {"mounted": bool(finds[d] and scan.mounted[of_person[d]])}
        | {"thing": next(things) if status[d] == FALSE else "", "distance": float(far[d])}
        for d in range(len(boxes))
    ]
    return people_rows, detection_rows


def _conditions(scan: LabeledScan, people: np.ndarray) -> list[tuple[str, ...]]:
    """What may make each person hard to find."""
    apart = np.linalg.norm(people[:, None] - people[None], axis=-1) + 1e9 * np.eye(len(people))
    touching = np.zeros(len(people), bool)
    if scan.thing is not None:
        wide = [replace(box, size=box.size + [2 * _TOUCHING, 2 * _TOUCHING, 0]) for box in scan.boxes]
        touching = np.array([(scan.thing[rows] >= 0).any() for rows in rows_inside(wide, scan.points)], bool)
    conditions = []
    for p, box in enumerate(scan.boxes):
        has = {
            f"person within {_COMPANY:g} m": bool((apart[p] < _COMPANY).any()),
            f"thing within {_TOUCHING:g} m": bool(touching[p]),
            f"under {_LOW:g} m tall": bool(box.size[2] < _LOW),
        }
        conditions.append(tuple(name for name, holds in has.items() if holds) or ("none of these",))
    return conditions


def _things(scan: LabeledScan, boxes: Sequence[Box]) -> Iterator[str]:
    """What most points of each box lie on; "" where the scan does not say."""
    for rows in rows_inside(list(boxes), scan.points):
        if scan.thing is None:
            yield ""
            continue
        names = np.array([*scan.things, "ground or building"], object)[scan.thing[rows]]
        if scan.person is not None:
            names[scan.person[rows] >= 0] = "part of a person"
        yield str(pd.Series(names).mode().iloc[0]) if len(rows) else "no points"


# ---- all scans


@dataclass(frozen=True, kw_only=True, eq=False)
class DetectorResult:
    """A detector on one set of scans.

    scans: name, sensor, kind of each; people, detections: rows as of `score_scan`, with pose errors `mpjpe_found` and
    `mpjpe_given`, mm; boxes: of each scan's detections; rows: the figures; thresholds: operating point -> score;
    things: what false people are, at the reference point.
    """

    dataset: str
    scans: pd.DataFrame
    people: pd.DataFrame
    detections: pd.DataFrame
    boxes: Sequence[Sequence[Box]]
    rows: list[dict[str, Any]]
    thresholds: dict[str, float]
    reliability: list[dict[str, float]]
    things: list[dict[str, Any]]

    def row(self, figure: str, at: str = "", group: str = "all", of: str = "all") -> dict[str, Any]:
        """The row of a figure. Raises InputError where there is none."""
        wanted = {"figure": figure, "at": at, "group": group, "of": of}
        for row in self.rows:
            if wanted.items() <= row.items():
                return row
        raise InputError(f"{self.dataset} has no row {', '.join(wanted.values())}")

    def to_dict(self) -> dict[str, Any]:
        counts = {"scans": len(self.scans), "people": len(self.people), "mounted": int(self.people.mounted.sum())}
        shown = {"thresholds": self.thresholds, "reliability": self.reliability, "false by thing": self.things}
        return {"dataset": self.dataset, **counts, **shown, "rows": self.rows}


def score_detector(
    detect: Detect,
    scans: ScanSet,
    *,
    max_range: float = 40.0,
    default_score: float | None = None,
    predictor: Predictor | None = None,
    seed: int = 0,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> DetectorResult:
    """Looks for people in all scans and scores what is found.

    Args:
        detect: see `Detect`; its boxes should come with all scores, low ones too.
        max_range: people farther from the sensor, m, are neither wanted nor false.
        default_score: also an operating point, "default".
        predictor: poses matched people in found and in labeled boxes, where joints are known.
        seed: of the intervals.
    """
    people_rows: list[dict[str, Any]] = []
    detection_rows: list[dict[str, Any]] = []
    about: list[dict[str, str]] = []
    found: list[Sequence[Box]] = []
    for number, load in enumerate(scans.loaders):
        progress(number, len(scans.loaders))
        scan = load()
        boxes, scores = detect(scan.points, scan.origin)
        own_people, own_detections = score_scan(number, scan, boxes, np.asarray(scores, float), max_range=max_range)
        if predictor is not None and scan.joints is not None:
            _add_pose_errors(own_people, scan, boxes, predictor)
        people_rows += own_people
        detection_rows += own_detections
        found.append(boxes)
        about.append({"name": scan.name, "sensor": scan.sensor, "kind": scan.kind})
    progress(len(scans.loaders), len(scans.loaders))
    if not people_rows:
        raise InputError(f"{scans.name} has nobody of {LEAST_POINTS} points and more within {max_range:g} m")
    people, table = pd.DataFrame(people_rows), pd.DataFrame(about)
    columns = ["scan", "sensor", "kind", "detection", "score", "status", "mounted", "thing", "distance"]
    detections = pd.DataFrame(detection_rows, columns=columns).astype({"score": float, "scan": int, "mounted": bool})
    rng = np.random.default_rng(seed)
    rows, thresholds = figures(people, detections, table, rng, default_score)
    rows += pose_rows(people, thresholds[f"{REFERENCE:g}"], rng)
    judged = detections[detections.status != NEITHER]
    error = aggregate.calibration_error(judged.score, judged.status == PERSON)
    rows.append(_row("calibration_error", value=100 * error, unit="%", count=len(judged)))
    false = detections[(detections.status == FALSE) & (detections.score >= thresholds[f"{REFERENCE:g}"])]
    things = [{"thing": name, "false": count} for name, count in false.thing.value_counts().items() if name]
    return DetectorResult(
        dataset=scans.name,
        scans=table,
        people=people,
        detections=detections,
        boxes=found,
        rows=rows,
        thresholds=thresholds,
        reliability=_reliability(judged),
        things=things,
    )


def _row(figure: str, at: str = "", group: str = "all", of: str = "all", **values: Any) -> dict[str, Any]:
    """A figure as it stands in the file. at: operating point; count: people, scans or detections that it is of."""
    row = {"figure": figure, "at": at, "group": group, "of": of, "low": None, "high": None} | values
    return row | {name: None if row[name] is None else round(float(row[name]), 4) for name in ("value", "low", "high")}


def figures(
    people: pd.DataFrame,
    detections: pd.DataFrame,
    scans: pd.DataFrame,
    rng: np.random.Generator,
    default_score: float | None,
) -> tuple[list[dict[str, Any]], dict[str, float]]:
    """Recall, false people a scan and average precision with intervals; operating point -> score."""
    count = len(scans)
    weights = np.vstack([np.ones(count, int), rng.multinomial(count, np.full(count, 1 / count), size=_REPEATS)])
    false = detections[detections.status == FALSE].sort_values("score", ascending=False, kind="stable")
    rows: list[dict[str, Any]] = []
    thresholds: dict[str, float] = {}
    groups = list(_groups_of_people(people))
    masks = np.array([mask for _, _, mask in groups], float)
    person_weights = weights[:, people.scan]
    total = person_weights @ masks.T
    spread_over = [people.scan[mask].nunique() for _, _, mask in groups]
    points = {f"{budget:g}": exclusive_thresholds(false, weights, budget) for budget in FALSE_PER_SCAN}
    if default_score is not None:
        points["default"] = np.full(len(weights), np.nextafter(default_score, -1))
    for at, above in points.items():
        higher = detections.score[detections.score > above[0]]
        thresholds[at] = float(higher.min()) if len(higher) else 1.0
        hits = (people.score.to_numpy()[None] > above[:, None]) * person_weights
        with np.errstate(invalid="ignore"):
            recall = 100 * (hits @ masks.T) / total
        for k, (group, of, mask) in enumerate(groups):
            rows.append(
                _row("recall", at, group, of, **_stated(recall[:, k], spread_over[k]), unit="%", count=int(mask.sum()))
            )
        rows += _false_rows(at, false[false.score > above[0]], scans)
    on_foot = people[~people.mounted]
    judged = detections[(detections.status == FALSE) | (detections.status == PERSON) & ~detections.mounted]
    precision = 100 * np.array([average_precision(judged, on_foot, own) for own in weights])
    rows.append(_row("average_precision", **_stated(precision, count), unit="%", count=len(on_foot)))
    return rows, thresholds


def exclusive_thresholds(false: pd.DataFrame, weights: np.ndarray, budget: float) -> np.ndarray:
    """(R,) of each row of weights (R, scans) the lowest bound that at most `budget` false detections a scan, sorted by
    falling score, lie above; -1 where all may."""
    scores, scan = np.append(false.score.to_numpy(float), -1.0), false.scan.to_numpy(int)
    return np.array(
        [scores[np.searchsorted(np.cumsum(w[scan]), budget * w.sum() + 1e-9, side="right")] for w in weights]
    )


def average_precision(detections: pd.DataFrame, people: pd.DataFrame, weights: np.ndarray) -> float:
    """Area under precision over recall, precision made falling, 0 to 1; weights (scans,)."""
    order = np.argsort(-detections.score.to_numpy(), kind="stable")
    score, own = detections.score.to_numpy()[order], weights[detections.scan.to_numpy()[order]]
    hits = np.cumsum(own * (detections.status == PERSON).to_numpy()[order])
    count, wanted = np.cumsum(own), weights[people.scan.to_numpy()].sum()
    if not wanted or not len(score):
        return float("nan") if not wanted else 0.0
    # equal scores come together
    last = np.append(score[1:] != score[:-1], True) & (count > 0)
    precision = np.maximum.accumulate((hits[last] / count[last])[::-1])[::-1]
    return float((np.diff(hits[last] / wanted, prepend=0) * precision).sum())


def _stated(draws: np.ndarray, units: int) -> dict[str, Any]:
    """The value, which comes first, and the ends of its interval; None of too few scans."""
    value: dict[str, Any] = {"value": None if np.isnan(draws[0]) else float(draws[0])}
    if units >= aggregate.LEAST_UNITS and value["value"] is not None:
        value |= dict(zip(("low", "high"), np.nanquantile(draws[1:], (0.025, 0.975)).tolist(), strict=True))
    return value


def _groups_of_people(people: pd.DataFrame) -> Iterator[tuple[str, str, np.ndarray]]:
    """Group, of what of it, and whose rows: people on foot by all that is known of them, mounted ones apart."""
    on_foot, points = ~people.mounted.to_numpy(), people.points.to_numpy()
    spans = aggregate.span_rows(points, POINT_EDGES)
    yield "all", "all", on_foot
    for who, some in (("points", on_foot), ("mounted, points", ~on_foot)):
        for name, rows in spans.items():
            yield who, name, some & rows
    yield "mounted", "all", ~on_foot
    for least, some in (("", on_foot), (", 50 points and more", on_foot & (points >= 50))):
        for column in ("sensor", "kind"):
            for name in sorted(set(people[column]) - {""}):
                yield f"{column}{least}", name, some & (people[column] == name).to_numpy()
        for name in sorted({name for names in people.condition for name in names}):
            yield f"condition{least}", name, some & people.condition.map(lambda names, n=name: n in names).to_numpy()
        for name, rows in aggregate.span_rows(people.distance.to_numpy(), DISTANCE_EDGES).items():
            yield f"distance, m{least}", name, some & rows


def _false_rows(at: str, false: pd.DataFrame, scans: pd.DataFrame) -> Iterator[dict[str, Any]]:
    """False people a scan: of all, of the worst scan, by sensor and kind of scene."""
    yield _row("false_people", at, value=len(false) / len(scans), unit="a scan", count=len(scans))
    worst = false.scan.value_counts().max() if len(false) else 0
    yield _row("false_people", at, "worst", "scan", value=worst, unit="a scan", count=1)
    for column in ("sensor", "kind"):
        for name, own in scans[column].value_counts().sort_index().items():
            if name:
                mean = (false[column] == name).sum() / own
                yield _row("false_people", at, column, name, value=mean, unit="a scan", count=int(own))


def _reliability(judged: pd.DataFrame) -> list[dict[str, float]]:
    """By bins of the score: its mean, the share of people, and how many detections."""
    bins = np.minimum((judged.score * _BINS).astype(int), _BINS - 1)
    return [
        {"score": round(float(some.score.mean()), 4), "people": round(float((some.status == PERSON).mean()), 4)}
        | {"detections": len(some)}
        for _, some in judged.groupby(bins)
    ]


# ---- poses


def _add_pose_errors(
    people: list[dict[str, Any]], scan: LabeledScan, boxes: Sequence[Box], predictor: Predictor
) -> None:
    """Errors of the poses in found and in labeled boxes, mm, NaN without a pose."""
    assert scan.joints is not None
    matched = [row for row in people if row["detection"] >= 0]
    true = scan.joints[[row["person"] for row in matched]][:, BODY26.map_to(HUMAN15)]
    sources = {
        "mpjpe_found": [boxes[row["detection"]] for row in matched],
        "mpjpe_given": [scan.boxes[row["person"]] for row in matched],
    }
    origin = "unknown" if scan.origin is None else scan.origin
    for name, own in sources.items():
        if not matched:
            continue
        crops = [Box(center=box.center, size=box.size, yaw=box.yaw) for box in own]
        poses = predictor.predict(scan.points, boxes=crops, sensor_origin=origin, skeleton=HUMAN15.name)
        for row, person, joints in zip(matched, poses, true, strict=True):
            errors = joint_errors(person.joints[None], joints[None]) if person.has_pose else np.array([np.nan])
            row[name] = float(errors.mean())


def pose_rows(people: pd.DataFrame, threshold: float, rng: np.random.Generator) -> list[dict[str, Any]]:
    """MPJPE of people found at the reference point who have a pose in both boxes, and the mean difference."""
    if "mpjpe_found" not in people:
        return []
    both = people[(people.score >= threshold) & people.mpjpe_found.notna() & people.mpjpe_given.notna()]
    columns = {"mpjpe_found": both.mpjpe_found, "mpjpe_given": both.mpjpe_given}
    columns["mpjpe_difference"] = both.mpjpe_found - both.mpjpe_given
    rows = []
    for name, values in columns.items():
        if len(both):
            drawn = aggregate.interval(values.to_numpy(), rng, clusters=both.scan.to_numpy())
            ends: dict[str, Any] = dict(zip(("low", "high"), drawn.stated, strict=True))
            rows.append(_row(name, f"{REFERENCE:g}", value=values.mean(), unit="mm", count=len(both), **ends))
    return rows
