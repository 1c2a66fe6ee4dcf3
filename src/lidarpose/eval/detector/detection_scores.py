"""Detections against labeled people: matching, recall at false positives per scan, average precision, calibration.

Recall is reported at operating points: the lowest score threshold at which a detector has at most a given number of
false positives per scan, averaged over all scans, as in FROC curves. Intervals are percentile bootstraps over scans;
the threshold is recomputed in each bootstrap draw.
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
from lidarpose.inference.predictor import Predictor
from lidarpose.inference.scan import rows_inside
from lidarpose.sample import Box
from lidarpose.skeleton import BODY26, HUMAN15

# a detection finds a person if their centers are at most this far apart in x and y, m
MATCH_RADIUS = 0.5
# people with fewer points need not be found, and detections of them are not false positives
LEAST_POINTS = 10
# operating points: false positives per scan. People count as missed, and false positives are analyzed, at REFERENCE
FALSE_PER_SCAN = (0.3, 1.0, 3.0, 10.0)
REFERENCE = 1.0
POINT_EDGES = (LEAST_POINTS, 20, 50, np.inf)
# conditions: another person or a thing within this distance, m, and people below this height, m
_COMPANY, _TOUCHING, _LOW = 1.0, 0.3, 1.4
CONDITIONS = ("person within 1 m", "thing within 0.3 m", "under 1.4 m tall", "none of these")
# columns that describe a whole scan
OF_SCAN = ("sensor", "kind", "height", "tilt")
INDOORS = ("room", "corridor", "hall")
_REPEATS, _BINS = 1000, 10
# the calibration error counts scores from here on: most candidates score about 0 and would hide it
_LEAST_SCORE = 0.1
# what a detection shows
PERSON, FALSE, NEITHER = "person", "false", "neither"

# points (n, 3) m and the sensor's origin -> boxes with scores 0 to 1
Detect = Callable[[np.ndarray, np.ndarray | None], tuple[Sequence[Box], np.ndarray]]


def match(centers: np.ndarray, scores: np.ndarray, people: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """(D,) the person that each detection finds, or -1, one to one.

    By falling score, each detection takes the nearest person within `MATCH_RADIUS` that is not taken yet. People that
    are not wanted are taken only if no wanted person is in reach.

    Args:
        centers: (D, 2) m.
        scores: (D,).
        people: (P, 2) m.
        wanted: (P,) bool, people that the detector is expected to find.
    """
    of_person = np.full(len(centers), -1)
    distance = np.linalg.norm(centers[:, None] - people[None], axis=-1)
    distance[distance > MATCH_RADIUS] = np.inf
    for d in np.argsort(-scores, kind="stable"):
        for distances in (np.where(wanted, distance[d], np.inf), distance[d]):
            if len(people) and np.isfinite(distances.min()):
                of_person[d] = distances.argmin()
                distance[:, of_person[d]] = np.inf
                break
    return of_person


# ---- one scan


def score_scan(
    number: int, scan: LabeledScan, boxes: Sequence[Box], scores: np.ndarray, *, max_range: float
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Tables of the scan's wanted people and of its detections, one row each. People not found have the score -inf."""
    origin = np.zeros(2) if scan.origin is None else scan.origin[:2]
    positions, centers = (
        np.array([box.center[:2] for box in box_list]).reshape(-1, 2) for box_list in (scan.boxes, boxes)
    )
    distance, detection_distance = (np.linalg.norm(xy - origin, axis=1) for xy in (positions, centers))
    is_wanted = scan.is_person & (scan.num_points >= LEAST_POINTS) & (distance <= max_range)
    # a labeled person without any point must not excuse a false positive
    visible_positions = np.where((scan.num_points > 0)[:, None], positions, np.inf)
    of_person = match(centers, scores, visible_positions, is_wanted)
    is_match = np.append(is_wanted, False)[of_person]
    detection = np.full(len(positions), -1)
    detection[of_person[of_person >= 0]] = np.flatnonzero(of_person >= 0)
    scan_columns = {"scan": number} | {name: getattr(scan, name) for name in OF_SCAN}
    people = pd.DataFrame(
        scan_columns
        | {"person": np.arange(len(positions)), "points": scan.num_points, "distance": distance}
        | {"mounted": scan.mounted, "detection": detection, "score": np.append(scores, -np.inf)[detection]}
        | {"activity": list(scan.activities or [""] * len(positions))}
        | _conditions(scan, positions)
    )
    status = np.where(is_match, PERSON, np.where((of_person >= 0) | (detection_distance > max_range), NEITHER, FALSE))
    detections = pd.DataFrame(
        scan_columns
        | {
            "detection": np.arange(len(boxes)),
            "score": scores,
            "distance": detection_distance,
            "status": status.astype(object),
        }
        | {"mounted": is_match & np.append(scan.mounted, False)[of_person], "thing": _things(scan, boxes)}
        | {"said_mounted": np.array([bool(box.mounted) for box in boxes], bool)}
    )
    return people[is_wanted], detections


def _conditions(scan: LabeledScan, positions: np.ndarray) -> dict[str, np.ndarray]:
    """Conditions that may make people hard to find, each (P,) bool; those of things only if these are labeled."""
    distance = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
    # a person is also within this distance of themselves
    has_company = (distance[:, scan.is_person] < _COMPANY).sum(1) > 1
    is_low = np.array([box.size[2] < _LOW for box in scan.boxes], bool)
    if scan.thing is None:
        return {CONDITIONS[0]: has_company, CONDITIONS[2]: is_low}
    # larger to the sides, but shortened at both ends to leave out the ground and the ceiling
    margin = [2 * _TOUCHING, 2 * _TOUCHING, -2 * _TOUCHING]
    grown_boxes = [replace(box, size=np.maximum(box.size + margin, 0.1)) for box in scan.boxes]
    is_touching = np.array([(scan.thing[rows] >= 0).any() for rows in rows_inside(grown_boxes, scan.points)], bool)
    return dict(zip(CONDITIONS, (has_company, is_touching, is_low, ~(has_company | is_touching | is_low)), strict=True))


def _things(scan: LabeledScan, boxes: Sequence[Box]) -> list[str]:
    """The kind of thing that most points of each box lie on; "" if the scan has no such labels."""
    if scan.thing is None or scan.person is None:
        return [""] * len(boxes)
    names = np.array([*scan.things, "ground or building"], object)[scan.thing]
    names[scan.person >= 0] = "part of a person"
    box_rows = rows_inside(list(boxes), scan.points)
    return [pd.Series(names[rows]).mode().iloc[0] if len(rows) else "no points" for rows in box_rows]


# ---- all scans


@dataclass(frozen=True, kw_only=True, eq=False)
class DetectorResult:
    """A detector's scores on one set of scans.

    changed: number of scans that differ from the frozen ones; people, detections: tables as of `score_scan`, people
    with pose errors `mpjpe_found` and `mpjpe_given`, mm; boxes: the detections of each scan; rows: the metrics;
    thresholds: operating point -> the lowest score that passes; reliability: for each bin of the score, the mean score,
    the share of people and the number of detections; things: counts of what false positives lie on, at `REFERENCE`.
    """

    dataset: str
    scans: int
    changed: int
    people: pd.DataFrame
    detections: pd.DataFrame
    boxes: Sequence[Sequence[Box]]
    rows: list[dict[str, Any]]
    thresholds: dict[str, float]
    reliability: list[dict[str, float]]
    things: dict[str, int]


def score_detector(
    detect: Detect,
    scans: ScanSet,
    *,
    max_range: float = 40.0,
    default_score: float | None = None,
    predictor: Predictor | None = None,
    sensor_unknown: bool = False,
    seed: int = 0,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> DetectorResult:
    """Searches all scans for people and scores the detections.

    Args:
        detect: see `Detect`; it should return boxes of all scores, low ones too.
        max_range: people farther from the sensor, m, need not be found, and detections there are not false positives.
        default_score: a score threshold to report as the operating point "default".
        sensor_unknown: do not pass the sensor's position to the detector.
        predictor: predicts poses of matched people, in detected and in labeled boxes, where joints are labeled.
        seed: of the intervals.
    """
    scan_results: list[tuple] = []
    progress(0, len(scans.loaders))
    for number, load in enumerate(scans.loaders):
        scan = load()
        origin = None if sensor_unknown else scan.origin
        boxes, scores = detect(scan.points, origin)
        people, detections = score_scan(number, scan, boxes, np.asarray(scores, float), max_range=max_range)
        if predictor is not None and scan.joints is not None:
            people = people.assign(**_pose_errors(people, scan, boxes, predictor, origin))
        scan_info = {name: getattr(scan, name) for name in (*OF_SCAN, "changed")}
        scan_results.append((people, detections, boxes, scan_info))
        progress(number + 1, len(scans.loaders))
    *tables, all_boxes, rows_about = zip(*scan_results, strict=True)
    people, detections = (pd.concat(parts, ignore_index=True) for parts in tables)
    if people.empty:
        raise InputError(f"{scans.name} has no people of {LEAST_POINTS} or more points within {max_range:g} m")
    rng = np.random.default_rng(seed)
    table = pd.DataFrame(rows_about)
    rows, thresholds = _figures(people, detections, table, rng, default_score)
    for at in (f"{REFERENCE:g}", "default"):
        rows += _pose_rows(people, at, thresholds[at], rng) if at in thresholds else []
    counted_detections = detections[detections.status != NEITHER].assign(people=lambda table: table.status == PERSON)
    likely = counted_detections[counted_detections.score >= _LEAST_SCORE]
    error = 100 * aggregate.calibration_error(likely.score, likely.people) if len(likely) else None
    rows.append(_row("calibration_error", value=error, unit="%", count=len(likely)))
    bins = counted_detections.groupby(np.minimum((counted_detections.score * _BINS).astype(int), _BINS - 1))
    reliability = bins.agg(score=("score", "mean"), people=("people", "mean"), detections=("people", "size"))
    false_people = detections[(detections.status == FALSE) & (detections.score >= thresholds[f"{REFERENCE:g}"])]
    return DetectorResult(
        dataset=scans.name,
        scans=len(table),
        changed=int(table.changed.sum()),
        people=people,
        detections=detections,
        boxes=all_boxes,
        rows=rows,
        thresholds=thresholds,
        reliability=reliability.round(4).to_dict("records"),
        things=false_people.thing[false_people.thing != ""].value_counts().to_dict(),
    )


def _row(figure: str, at: str = "", group: str = "all", of: str = "all", **values: Any) -> dict[str, Any]:
    """A metric as written to the file. at: operating point; count: number of people, scans or detections behind it."""
    row = {"figure": figure, "at": at, "group": group, "of": of, "low": None, "high": None} | values
    return row | {name: None if row[name] is None else round(float(row[name]), 4) for name in ("value", "low", "high")}


def _figures(
    people: pd.DataFrame,
    detections: pd.DataFrame,
    scans: pd.DataFrame,
    rng: np.random.Generator,
    default_score: float | None,
) -> tuple[list[dict[str, Any]], dict[str, float]]:
    """Rows of recall, false positives per scan and average precision with intervals; and operating point -> score
    threshold."""
    count = len(scans)
    # weight of each scan: 1 in the first row, then the number of times that each bootstrap draw contains it
    weights = np.vstack([np.ones(count), rng.multinomial(count, np.full(count, 1 / count), size=_REPEATS)])
    false_people = detections[detections.status == FALSE].sort_values("score", ascending=False, kind="stable")
    operating_bounds = {f"{budget:g}": exclusive_thresholds(false_people, weights, budget) for budget in FALSE_PER_SCAN}
    if default_score is not None:
        operating_bounds["default"] = np.full(len(weights), np.nextafter(default_score, -1))
    groups = [group for group in _groups_of_people(people) if group[2].any() or group[0] == "all"]
    masks = np.array([mask for _, _, mask in groups], float)
    person_weights = weights[:, people.scan]
    total = person_weights @ masks.T
    rows: list[dict[str, Any]] = []
    thresholds: dict[str, float] = {}
    for at, bounds in operating_bounds.items():
        # just above the score of the first false positive that exceeds the budget
        thresholds[at] = max(0.0, float(np.nextafter(bounds[0], 1)))
        hits = (people.score.to_numpy() > bounds[:, None]) * person_weights
        # draws without a person of a group are NaN
        with np.errstate(invalid="ignore"):
            recall = 100 * (hits @ masks.T) / total
        for (group, of, mask), draws in zip(groups, recall.T, strict=True):
            ends = _with_interval(draws, people.scan[mask].nunique())
            rows.append(_row("recall", at, group, of, **ends, unit="%", count=int(mask.sum())))
        rows += _false_rows(at, false_people[false_people.score > bounds[0]], scans)
        rows += _mounted_rows(at, detections[(detections.status == PERSON) & (detections.score > bounds[0])])
    people_on_foot = people[~people.mounted]
    counted_detections = detections[(detections.status == FALSE) | (detections.status == PERSON) & ~detections.mounted]
    precision = 100 * average_precision(counted_detections, people_on_foot, weights)
    rows.append(_row("average_precision", **_with_interval(precision, count), unit="%", count=len(people_on_foot)))
    return rows, thresholds | ({} if default_score is None else {"default": default_score})


def exclusive_thresholds(false: pd.DataFrame, weights: np.ndarray, budget: float) -> np.ndarray:
    """(R,) for each row of weights (R, scans), the lowest bound above which at most `budget` false detections per scan
    score; -1 if all may. false: sorted by falling score."""
    scores, scan = np.append(false.score.to_numpy(float), -1.0), false.scan.to_numpy(int)
    max_false = budget * weights.sum(1) + 1e-9
    return np.array(
        [
            scores[np.searchsorted(np.cumsum(scan_weights[scan]), m, side="right")]
            for scan_weights, m in zip(weights, max_false, strict=True)
        ]
    )


def average_precision(detections: pd.DataFrame, people: pd.DataFrame, weights: np.ndarray) -> np.ndarray:
    """(R,) for weights (R, scans): area under the precision-recall curve, 0 to 1, with precision made non-increasing;
    NaN without people."""
    detections = detections.sort_values("score", ascending=False, kind="stable")
    scan, is_match = detections.scan.to_numpy(int), (detections.status == PERSON).to_numpy()
    # equal scores pass a threshold together
    is_last = ~detections.score.duplicated(keep="last").to_numpy()
    areas = np.full(len(weights), np.nan)
    for row, num_people in enumerate(weights[:, people.scan.to_numpy(int)].sum(1)):
        detection_weights = weights[row][scan]
        hits, count = np.cumsum(detection_weights * is_match)[is_last], np.cumsum(detection_weights)[is_last]
        precision = np.maximum.accumulate((hits / np.maximum(count, 1))[::-1])[::-1]
        areas[row] = (np.diff(hits, prepend=0) * precision).sum() / num_people if num_people else np.nan
    return areas


def _with_interval(draws: np.ndarray, units: int) -> dict[str, Any]:
    """The value, which comes first in `draws`, and its interval, see `Interval.stated`; the value is None if NaN."""
    if np.isnan(draws[0]):
        return {"value": None}
    low, high = np.nanquantile(draws[1:], (0.025, 0.975))
    ends = aggregate.Interval(low=low, high=high, level=0.95, units=units, repeats=_REPEATS).stated
    return {"value": draws[0], "low": ends[0], "high": ends[1]}


def _groups_of_people(people: pd.DataFrame) -> Iterator[tuple[str, str, np.ndarray]]:
    """Yields group, subgroup and mask of rows: people on foot by every known attribute; mounted people separately."""
    is_on_foot, points = ~people.mounted.to_numpy(), people.points.to_numpy()
    for prefix, mask in (("", is_on_foot), ("mounted, ", ~is_on_foot)):
        yield f"{prefix}all", "all", mask
        for name, rows in aggregate.span_rows(points, POINT_EDGES).items():
            yield f"{prefix}points", name, mask & rows
    for suffix, mask in (("", is_on_foot), (", 50 points and more", is_on_foot & (points >= 50))):
        for column in (*OF_SCAN, "activity"):
            for name in sorted(set(people[column]) - {""}):
                yield f"{column}{suffix}", name, mask & (people[column] == name).to_numpy()
        # the user's labels may have a kind of this name
        if "indoors" not in set(people.kind):
            yield f"kind{suffix}", "indoors", mask & people.kind.isin(INDOORS).to_numpy()
        for name in (name for name in CONDITIONS if name in people):
            yield f"condition{suffix}", name, mask & people[name].to_numpy(bool)
        for name, rows in aggregate.span_rows(people.distance.to_numpy(), aggregate.DISTANCE_EDGES).items():
            yield f"distance, m{suffix}", name, mask & rows


def _false_rows(at: str, false_people: pd.DataFrame, scans: pd.DataFrame) -> Iterator[dict[str, Any]]:
    """False positives per scan: the mean of all scans, the worst scan, and means by each column of `OF_SCAN`."""
    counts = false_people.scan.value_counts().reindex(scans.index, fill_value=0)
    yield _row("false_people", at, value=counts.mean(), unit="a scan", count=len(scans))
    yield _row("false_people", at, "worst", "scan", value=counts.max(), unit="a scan", count=1)
    for column in OF_SCAN:
        for name, group_counts in counts.groupby(scans[column]):
            if name:
                yield _row(
                    "false_people", at, column, name, value=group_counts.mean(), unit="a scan", count=len(group_counts)
                )


# ---- poses


def _pose_errors(
    people: pd.DataFrame, scan: LabeledScan, boxes: Sequence[Box], predictor: Predictor, origin: np.ndarray | None
) -> dict[str, np.ndarray]:
    """Errors of poses in detected and in labeled boxes, mm, NaN without a pose."""
    assert scan.joints is not None
    matched_people = people[people.detection >= 0]
    sources = {
        "mpjpe_found": [boxes[k] for k in matched_people.detection],
        "mpjpe_given": [scan.boxes[k] for k in matched_people.person],
    }
    true = scan.joints[matched_people.person][:, BODY26.map_to(HUMAN15)]
    errors = {name: np.full(len(people), np.nan) for name in sources}
    for name, source_boxes in sources.items():
        crops = [replace(box, id=None) for box in source_boxes]
        sensor_origin = "unknown" if origin is None else origin
        poses = predictor.predict(scan.points, boxes=crops, sensor_origin=sensor_origin, skeleton=HUMAN15.name)
        errors[name][people.detection >= 0] = [
            joint_errors(person.joints[None], joints[None]).mean() if person.has_pose else np.nan
            for person, joints in zip(poses, true, strict=True)
        ]
    return errors


def _pose_rows(people: pd.DataFrame, at: str, threshold: float, rng: np.random.Generator) -> Iterator[dict[str, Any]]:
    """MPJPE of people found at an operating point with a pose in both boxes, and the mean difference."""
    if "mpjpe_found" not in people:
        return
    posed_people = people[(people.score >= threshold) & people.mpjpe_found.notna() & people.mpjpe_given.notna()]
    for name in ("mpjpe_found", "mpjpe_given", "mpjpe_difference") if len(posed_people) else ():
        values = (
            posed_people.mpjpe_found - posed_people.mpjpe_given if name == "mpjpe_difference" else posed_people[name]
        )
        low, high = aggregate.interval(values, rng, clusters=posed_people.scan.to_numpy()).stated
        yield _row(name, at, value=values.mean(), low=low, high=high, unit="mm", count=len(posed_people))


def _mounted_rows(at: str, matches: pd.DataFrame) -> Iterator[dict[str, Any]]:
    """The share of matched people whose detected box is marked as mounted, for mounted people and people on foot."""
    for group, people in (("mounted", matches[matches.mounted]), ("on foot", matches[~matches.mounted])):
        value = 100 * people.said_mounted.mean() if len(people) else None
        yield _row("said_mounted", at, group, value=value, unit="%", count=len(people))
