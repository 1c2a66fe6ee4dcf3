"""`detect`: the people in a whole scan. The detector scores places where somebody may stand; the network `tiny` poses
the best of them, and how sure it is of a pose goes into the score.

Legend: D detections, V those that were posed.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from numbers import Real
from typing import TYPE_CHECKING, Any

import numpy as np

from lidarpose.errors import InputError, check_int
from lidarpose.geometry import rotation_from_up
from lidarpose.inference.backend import Backend, OnnxBackend, estimates
from lidarpose.inference.background import is_static, read_background
from lidarpose.inference.checks import flat_along_another_axis, scan_unit_warning, unlikely_origin
from lidarpose.inference.inputs import as_origin, as_points, only_returns
from lidarpose.inference.scan import Scan, read_scan, up_text
from lidarpose.inference.tta import TTATransform, apply
from lidarpose.io.boxes import Boxes
from lidarpose.models import weights_path
from lidarpose.models.decode import decoder
from lidarpose.models.detector.detector import Detections, Detector
from lidarpose.models.detector.ground import estimate_up
from lidarpose.sample import MIN_POINTS, Box, Pose
from lidarpose.viz.person_view import facing

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

# how far from the sensor people are searched, m
MAX_RANGE = 40.0
# detections that are posed, and how many at once, of like size: a batch costs as much as if all were its largest
_POSED, _BATCH = 40, 16
# a scan of more points is thinned: what is farther away than this beyond the range first, m
_MOST_POINTS, _BEYOND = 1_500_000, 15.0
_CHUNK = 4_000_000
# points that tell how far a scan reaches
_ENOUGH = 25_000
# and which way is up
_ENOUGH_FOR_UP = 250_000
# what is posed: a column so wide, and so far below and above the detection's box, m
_COLUMN, _BELOW, _ABOVE = 0.6, 0.15, 0.25
# points around a detection that its final box may hold, m to each side
_AROUND = 2.5
# a box is so much larger than the joints on each side, m, beside another person no more than this; it ends half way to
# the next person, less half a body
_ROOM, _LEAST_ROOM, _HALF_BODY = 0.15, 0.1, 0.25
# of two people whose pelvises are nearer than this the less certain one is the same person, m
_SAME_PERSON = 0.3
# less of a scan on its background, as a share, and it is the background of something else
_LEAST_STATIC = 0.2
# what the final score is made of, by detection: the scorer's logit; means over the joints of confidence and of the log
# of spread, m; log of 1 + the points of the column; probability that the person is mounted
FEATURES = ("logit", "confidence", "log_spread", "log_points", "mounted")
# weights of the features and of products with "mounted", for a detector without its own
_WEIGHTS = {
    "bias": -1.5 * np.log(10),
    "logit": 1.0,
    "log_spread": -1.5,
    "mounted": 1.5 * np.log(10),
    "mounted_log_spread": 1.5,
}
# what joints can be at best, and the fewest and most points, between which a score is bounded before anybody is posed:
# the least mean spread of a person's joints seen is 0.022 m
_CONFIDENCES, _LOG_SPREADS, _LOG_POINTS = (0.0, 1.0), (np.log(0.012), 0.0), (np.log1p(MIN_POINTS), np.log1p(1e5))
# a detection so near to where somebody is expected is that person, m, if no other is expected within the second
# distance
_EXPECTED, _ALONE = 0.5, 1.0
# who is expected may have moved by so much out of the box, m
_MOVED = 0.15
# a place that held nobody is not looked at again for a while: a score below this share of the least, and a distance, m
_NOBODY, _SAME_PLACE = 1 / 3, 0.3
# the least score where a track is expected
WEAK_SCORE = 0.1
# decimals of meters in boxes, as they are written
_DECIMALS = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class Search:
    """How people are searched for, see `detect`. background (k, 3) m: static points in the scan's frame; detector: None
    for the bundled one."""

    max_range: float = MAX_RANGE
    min_score: float | None = None
    max_people: int | None = None
    background: np.ndarray | None = None
    detector: Detector | None = None

    def __post_init__(self):
        if not _is_number(self.max_range) or not 0 < self.max_range < np.inf:
            raise InputError(f"range: expected meters, more than 0, got {self.max_range!r}")
        if self.min_score is not None and not (_is_number(self.min_score) and 0 <= self.min_score <= 1):
            raise InputError(f"min score: expected a probability from 0 to 1, got {self.min_score!r}")
        if self.max_people is not None:
            check_int("max people", self.max_people, least=1)


@dataclass(frozen=True, kw_only=True, eq=False)
class KnownPlaces:
    """What the frames before say of a scan, in its frame.

    boxes: of the K people who need no verification, where they are expected, with the scores they had when they were
    verified; pelvises (K, 3) m; tracks (M, 3) m: where anybody is expected, the K first, within reach (M,) m: who is
    not found there is searched for among detections of `WEAK_SCORE` or more; rejected (R, 3) m: places of detections
    that were nobody.
    """

    boxes: Sequence[Box]
    pelvises: np.ndarray
    tracks: np.ndarray
    reach: np.ndarray
    rejected: np.ndarray


def detect(
    points: "str | os.PathLike | ArrayLike",
    *,
    sensor_origin: "np.ndarray | Sequence[float] | str | None" = None,
    up: str | Sequence[float] = "z",
    columns: int | None = None,
    max_range: float | None = None,
    min_score: float | None = None,
    max_people: int | None = None,
    background: "str | os.PathLike | Sequence | ArrayLike | None" = None,
) -> Boxes:
    """The people in a whole scan, surest first, as boxes that `predict` takes.

    Args:
        points: a point file, or (n, 3+) m in any frame.
        sensor_origin: (x, y, z) m in that frame, or "unknown"; None means 0, 0, 0.
        up: what is up there, as in `predict`.
        columns: values a row of a .bin file.
        max_range: how far from the sensor people are searched, m, level, None for 40; of an unknown sensor everywhere.
        min_score: people with a lower score are left out; None for the detector's own, at which about one false person
            a scan is found.
        max_people: only so many, the surest.
        background: what stands still about a sensor that does not move, and is not searched: a file or array (k, 3) m
            of static points (see `learn_background`), or several scans or a folder of them, of which it is learned.

    Returns:
        `Boxes` in the frame of the points, each with `score`, the probability that it is a person, and `mounted`,
        whether the person rides or sits in a wheelchair; `warnings` say what looks wrong about the scan.

    Raises:
        InputError: a file that cannot be read, or an option of another type.
    """
    rotation_from_up(up)
    search = search_options(min_score, max_range, max_people, background, columns)
    origin = np.zeros(3) if sensor_origin is None else as_origin(sensor_origin)
    scan = Scan(points=np.zeros((0, 3)), origin=origin, up=up_text(up))
    if isinstance(points, str | os.PathLike):
        scan = read_scan(scan, points, columns)
    else:
        cloud, notes = only_returns(as_points(points))
        scan = replace(scan, points=cloud, warnings=tuple(notes))
    searched = find_people(scan, search)
    return Boxes(searched.boxes or [], source=searched.source, warnings=searched.warnings, detector=detector_version())


def search_options(
    min_score: float | None, max_range: float | None, max_people: int | None, background: Any, columns: int | None
) -> Search:
    """A search with its background read; max_range None: the default. Raises InputError."""
    max_range = MAX_RANGE if max_range is None else max_range
    search = Search(max_range=max_range, min_score=min_score, max_people=max_people)
    return search if background is None else replace(search, background=read_background(background, columns=columns))


def find_people(scan: Scan, search: Search, known: KnownPlaces | None = None) -> Scan:
    """The scan with the boxes of the people in it, surest first, `found_rows`, and what looks wrong among its warnings;
    without the place of a sensor that cannot have been there, and with the direction that turned out to be up.

    known: of a recording's frames before; with it the scan has `pelvises`, `verified` and `rejected`, too.
    """
    return verify_people(detect_places(scan, search), search, known)


@dataclass(frozen=True, kw_only=True, eq=False)
class Places:
    """A scan in which people were detected, but not verified: as given, and as it is searched; its points in the level
    frame (n, 3) m; the detections there, None of a scan without points."""

    given: Scan
    scan: Scan
    level: np.ndarray
    detections: Detections | None


def detect_places(scan: Scan, search: Search) -> Places:
    """The first half of `find_people`, which depends on no other frame."""
    count = len(scan.points)
    given, notes = _thinned(scan, search)
    scan, warnings = given, [*scan.warnings, *notes]
    if len(scan.points) < MIN_POINTS:
        scan = replace(scan, warnings=(*warnings, f"under {MIN_POINTS} points"))
        return Places(given=given, scan=scan, level=scan.points, detections=None)
    level = _leveled(scan)
    # what else looks odd follows from wrong axes or units
    some = slice(None, None, -(-len(level) // _ENOUGH))
    few = replace(scan, points=scan.points[some])
    if wrong := flat_along_another_axis(few) or scan_unit_warning(level[some], count):
        warnings.append(wrong)
    origin = None if scan.origin is None else scan.R_level_input @ scan.origin
    up = estimate_up(_near(level, origin, search), origin)
    if up is not None:
        degrees = np.degrees(np.arccos(np.clip(up[2] / np.linalg.norm(up), -1, 1)))
        warnings.append(f"the ground leans by {degrees:.0f} degrees, which is taken for a tilt of the sensor (up)")
        scan = replace(scan, up=up_text(up @ scan.R_level_input))
        level = _leveled(scan)
        origin = None if scan.origin is None else scan.R_level_input @ scan.origin
    if origin is not None and (warning := unlikely_origin(level, origin)):
        warnings += [] if wrong else [warning]
        scan, origin = replace(scan, origin=None), None
    moving = None
    if search.background is not None:
        moving = ~is_static(scan.points, search.background)
        if (share := 1 - moving.mean()) < _LEAST_STATIC:
            warnings.append(
                f"only {share:.0%} of the points lie on the background: is it of this sensor, in this frame?"
            )
    detector = search.detector or _detector()
    detections = detector.detect(level, origin, max_range=search.max_range, limit=_POSED, moving=moving)
    if not (detections.has_ground or wrong):
        warnings.append("no ground was found, and people are searched without it: is the up axis right?")
    scan = replace(scan, warnings=tuple(warnings))
    return Places(given=given, scan=scan, level=level, detections=detections)


def verify_people(places: Places, search: Search, known: KnownPlaces | None = None) -> Scan:
    """The second half of `find_people`."""
    scan, given = places.scan, places.given
    if places.detections is None:
        return replace(scan, boxes=[], found_rows=[])
    # the boxes of a frame that leans are larger than their people: these are looked for anew
    leans = not np.allclose(given.R_boxes_input, scan.R_level_input)
    origin = None if scan.origin is None else scan.R_level_input @ scan.origin
    here = None if known is None or leans else _level(known, scan)
    people = _verified(places.detections, places.level, origin, search, here)
    boxes = [_in_input(box, scan, given) for box in people.boxes]
    searched = replace(scan, boxes=boxes, found_rows=people.rows)
    if known is None:
        return searched
    return replace(
        searched,
        pelvises=people.pelvises @ scan.R_level_input,
        verified=people.verified,
        rejected=people.rejected @ scan.R_level_input,
    )


def least_score(search: Search) -> float:
    """The score below which detections are left out."""
    if search.min_score is not None:
        return search.min_score
    return float((search.detector or _detector()).header["default_score"])


def detector_version() -> str:
    """Of the bundled detector."""
    return str(_detector().header["version"])


@cache
def _detector() -> Detector:
    return Detector()


@cache
def _verifier() -> Backend:
    return OnnxBackend(weights_path("tiny").with_suffix(".onnx"))


# ---- the scan


def _thinned(scan: Scan, search: Search) -> tuple[Scan, list[str]]:
    """The scan with at most `_MOST_POINTS` points, those near the sensor where its place is known, and a note."""
    points, count = scan.points, len(scan.points)
    if count <= _MOST_POINTS:
        return scan, []
    # masks, not rows: of 10^8 points these alone would take a gigabyte
    inside, starts = np.ones(count, bool), range(0, count, _CHUNK)
    if scan.origin is not None:
        reach = search.max_range + _BEYOND
        for start in starts:
            piece = slice(start, start + _CHUNK)
            inside[piece] = np.linalg.norm(points[piece] - scan.origin, axis=1) < reach
        if not inside.any():
            inside[:] = True
    number, notes = np.count_nonzero(inside), []
    if number <= _MOST_POINTS:
        rows = np.flatnonzero(inside)
    else:
        # drawn in equal shares: a fixed step would keep single beams of organized clouds
        step = np.random.default_rng(0).random(_MOST_POINTS)
        drawn = ((np.arange(_MOST_POINTS) + step) * (number / _MOST_POINTS)).astype(np.int64)
        ends = np.cumsum([0, *(np.count_nonzero(inside[start : start + _CHUNK]) for start in starts)])
        pieces = np.split(drawn, np.searchsorted(drawn, ends[1:-1]))
        rows = np.concatenate(
            [
                start + np.flatnonzero(inside[start : start + _CHUNK])[own - end]
                for start, own, end in zip(starts, pieces, ends[:-1], strict=True)
            ]
        )
        notes = [f"thinned from {number:,} to {len(rows):,} points to search them: give one scan at a time, or a part"]
    return replace(scan, points=points[rows]), notes


def _leveled(scan: Scan) -> np.ndarray:
    """The scan's points (n, 3) m in the level frame, one axis after the other in memory."""
    R_level_input = scan.R_level_input
    columns = np.ascontiguousarray(scan.points.T)
    return (columns if np.array_equal(R_level_input, np.eye(3)) else R_level_input @ columns).T


def _near(points: np.ndarray, origin: np.ndarray | None, search: Search) -> np.ndarray:
    """Enough of the points (n, 3) m that may lie under the people searched for."""
    rows = np.arange(len(points))
    if origin is not None:
        squared = (points[:, 0] - origin[0]) ** 2 + (points[:, 1] - origin[1]) ** 2
        near = np.flatnonzero(squared < (search.max_range + _BEYOND) ** 2)
        rows = near if len(near) else rows
    rows = rows[:: -(-len(rows) // _ENOUGH_FOR_UP)]
    return np.stack([values[rows] for values in points.T]).T


def _in_input(box: Box, scan: Scan, given: Scan) -> Box:
    """A level box as a box of the input, along the axis that `given` says is up. In a frame that leans it is larger, so
    that it still holds the person."""
    R_boxes_level = given.R_boxes_input @ scan.R_level_input.T
    center, size = R_boxes_level @ box.center, box.size
    if not np.allclose(R_boxes_level, np.eye(3)):
        c, s = np.cos(box.yaw), np.sin(box.yaw)
        R_level_own = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        size = np.abs(R_level_own.T @ R_boxes_level @ R_level_own) @ box.size
    center = given.R_boxes_input.T @ center
    return _rounded(replace(box, center=center, size=size))


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


# ---- the final score


def verification_features(
    detections: Detections, points: np.ndarray, origin: np.ndarray | None, backend: Backend | None = None
) -> tuple[np.ndarray, Pose]:
    """What the final score of detections in points (n, 3) m, level, from a sensor at origin (3,) or None is made of.

    Args:
        backend: what poses people; by default the bundled `tiny`.

    Returns:
        features (D, 5) in the order of `FEATURES`, and the poses, joints (D, 26, 3) m in the frame of the points; of
        fewer than 5 points they are NaN.
    """
    every = np.arange(len(detections))
    clouds = [points[rows] for rows in _rows_near(detections.centers, points)]
    return _posed(detections, every, clouds, origin, backend or _verifier())


def final_score(features: np.ndarray, header: dict) -> np.ndarray:
    """features (D, 5) -> (D,) in [0, 1]: the probability that a detection is a person, by the detector's header."""
    verification = header.get("verification") or {}
    weights = verification if "logit" in verification else _WEIGHTS
    value = dict(zip(FEATURES, features.T, strict=True))
    value |= {f"mounted_{name}": value["mounted"] * value[name] for name in ("confidence", "log_spread")}
    logit = np.full(len(features), float(weights.get("bias", 0.0)))
    for name, values in value.items():
        logit += weights.get(name, 0.0) * values
    logits, probabilities = verification.get("calibration") or header["calibration"]
    return np.nan_to_num(np.interp(logit, logits, probabilities))


def _posed(
    detections: Detections, chosen: np.ndarray, clouds: list[np.ndarray], origin: np.ndarray | None, backend: Backend
) -> tuple[np.ndarray, Pose]:
    """As `verification_features`, of the chosen detections (C,) and the points (n, 3) m near each of these; of the
    others what comes from points is NaN."""
    columns = [np.zeros((0, 3))] * len(detections)
    for i, cloud in zip(chosen.tolist(), clouds, strict=True):
        center, size = detections.centers[i], detections.sizes[i]
        above = cloud[:, 2] - center[2]
        inside = (above > -size[2] / 2 - _BELOW) & (above < size[2] / 2 + _ABOVE)
        columns[i] = cloud[inside & (np.hypot(*(cloud[:, :2] - center[:2]).T) < _COLUMN)]
    known = sorted((i for i, column in enumerate(columns) if len(column) >= MIN_POINTS), key=lambda i: len(columns[i]))
    skeleton = backend.header.skeleton
    joints = np.full((len(columns), len(skeleton), 3), np.nan)
    confidence, spread = np.full((2, *joints.shape[:2]), np.nan)
    for start in range(0, len(known), _BATCH):
        batch = known[start : start + _BATCH]
        clouds, view = apply(TTATransform(), [columns[i] for i in batch], detections.centers[batch], origin)
        pose = estimates(backend.run(clouds, view), decoder("window"), skeleton)
        joints[batch] = pose.joints + detections.centers[batch][:, None]
        confidence[batch], spread[batch] = pose.confidence, pose.spread
    points = np.log1p([len(column) for column in columns])
    with np.errstate(invalid="ignore"):
        features = (detections.logit, confidence.mean(1), np.log(spread).mean(1), points, detections.mounted)
    poses = Pose(joints=joints, skeleton=skeleton, confidence=confidence, spread=spread)
    return np.stack(features, -1).reshape(-1, len(FEATURES)), poses


def _highest_score(detections: Detections, header: dict) -> np.ndarray:
    """(D,): what `final_score` can be at most, whatever the pose. The score's logit is linear in what is unknown."""
    highest = np.zeros(len(detections))
    for unknown in product(_CONFIDENCES, _LOG_SPREADS, _LOG_POINTS):
        columns = [detections.logit, *(np.full(len(detections), value) for value in unknown), detections.mounted]
        highest = np.maximum(highest, final_score(np.stack(columns, -1), header))
    return highest


@dataclass(frozen=True, kw_only=True, eq=False)
class _People:
    """N people, level, surest first: boxes, rows of their points, pelvises (N, 3) m, verified (N,) bool; rejected
    (R, 3) m: detections that were nobody."""

    boxes: list[Box]
    rows: list[np.ndarray]
    pelvises: np.ndarray
    verified: np.ndarray
    rejected: np.ndarray


def _verified(
    detections: Detections,
    points: np.ndarray,
    origin: np.ndarray | None,
    search: Search,
    known: KnownPlaces | None = None,
) -> _People:
    """The people among the detections, surest first, in boxes about their poses; of known people about where they are
    expected."""
    header = (search.detector or _detector()).header
    usual = least_score(search)
    least = np.full(len(detections), usual)
    highest = _highest_score(detections, header)
    expected = np.full(len(detections), -1)
    if known is not None:
        expected = _expected(detections, highest >= usual, known)
        is_missed = ~np.isin(np.arange(len(known.tracks)), expected)
        is_near = (_apart(detections.centers, known.tracks[is_missed]) < known.reach[is_missed]).any(1)
        least[is_near] = min(usual, WEAK_SCORE)
        is_nobody = (_apart(detections.centers, known.rejected) < _SAME_PLACE).any(1)
        least[is_nobody & ~is_near & (expected < 0)] = np.inf
    possible = np.flatnonzero(highest >= least)
    near = dict(zip(possible.tolist(), _rows_near(detections.centers[possible], points), strict=True))
    posed = possible[expected[possible] < 0]
    features, poses = _posed(detections, posed, [points[near[i]] for i in posed.tolist()], origin, _verifier())
    scores = final_score(features, header)
    pelvis = poses.joints[:, poses.skeleton.index("pelvis")].copy()
    rejected = detections.centers[posed][scores[posed] < _NOBODY * usual]
    if known is not None:
        spared = np.flatnonzero(expected >= 0)
        scores[spared] = [known.boxes[k].score for k in expected[spared].tolist()]
        pelvis[spared] = known.pelvises[expected[spared]]
    chosen: list[int] = []
    for i in np.argsort(-scores, kind="stable"):
        is_new = not (np.linalg.norm(pelvis[chosen] - pelvis[i], axis=1) < _SAME_PERSON).any()
        if scores[i] >= least[i] and is_new and not np.isnan(pelvis[i]).any():
            chosen.append(int(i))
    boxes: list[Box] = []
    rows: list[np.ndarray] = []
    shown: list[int] = []
    for i in chosen:
        if known is not None and expected[i] >= 0:
            box = known.boxes[expected[i]]
            cropped, mounted = replace(box, size=box.size + 2 * _MOVED), box.mounted
        else:
            others = [np.hypot(*(pelvis[k] - pelvis[i])[:2]) for k in chosen if k != i and scores[k] >= usual]
            alone = min(others, default=np.inf)
            box = cropped = _box_about(Pose(joints=poses.joints[i], skeleton=poses.skeleton), alone)
            mounted = bool(detections.mounted[i] > 0.5)
        inside = cropped.contains(points[near[i]])
        if inside.sum() < MIN_POINTS or len(boxes) == search.max_people:
            continue
        boxes.append(replace(box, id=len(boxes), score=round(float(scores[i]), _DECIMALS), mounted=mounted))
        rows.append(near[i][inside])
        shown.append(i)
    return _People(boxes=boxes, rows=rows, pelvises=pelvis[shown], verified=expected[shown] < 0, rejected=rejected)


def _expected(detections: Detections, is_sure: np.ndarray, known: KnownPlaces) -> np.ndarray:
    """Of each detection, those that are sure enough, which known person it is: (D,) int, -1: none."""
    expected = np.full(len(detections), -1)
    sure = np.flatnonzero(is_sure)
    if len(sure) and known.boxes:
        away = _apart(detections.centers[sure], known.tracks[: len(known.boxes)])
        is_alone = (_apart(known.tracks, known.tracks) < _ALONE).sum(0)[: len(known.boxes)] == 1
        nearest = away.argmin(0)
        for k in np.flatnonzero(is_alone & (away.min(0) < _EXPECTED)):
            expected[sure[nearest[k]]] = k
    return expected


def _apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Level distances of a (A, 2+) from b (B, 2+): (A, B) m."""
    return np.linalg.norm(a[:, None, :2] - b[None, :, :2], axis=-1)


def _level(known: KnownPlaces, scan: Scan) -> KnownPlaces:
    """In the scan's level frame."""
    R_level_input = scan.R_level_input
    return replace(
        known,
        boxes=[replace(box, center=R_level_input @ box.center) for box in known.boxes],
        pelvises=known.pelvises @ R_level_input.T,
        tracks=known.tracks @ R_level_input.T,
        rejected=known.rejected @ R_level_input.T,
    )


def _box_about(pose: Pose, alone: float) -> Box:
    """The box of a person by the pose, joints (J, 3) m; alone m: distance to the next person, who is to be kept out."""
    forward = facing(pose)
    yaw = 0.0 if forward is None else float(np.arctan2(forward[1], forward[0]))
    c, s = np.cos(yaw), np.sin(yaw)
    R_level_own = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    own = pose.joints @ R_level_own
    beside = max(_LEAST_ROOM, min(_ROOM, alone / 2 - _HALF_BODY))
    # soles are nearer to the lowest joint than the top of the head to the highest
    low, high = own.min(0) - [beside, beside, 0.8 * _ROOM], own.max(0) + [beside, beside, 1.2 * _ROOM]
    return _rounded(Box(center=R_level_own @ ((low + high) / 2), size=high - low, yaw=yaw))


def _rounded(box: Box) -> Box:
    """As it is written: a file of boxes crops the same points."""
    center, size = box.center.round(_DECIMALS), box.size.round(_DECIMALS)
    return replace(box, center=center, size=size, yaw=round(box.yaw, _DECIMALS))


def _rows_near(centers: np.ndarray, points: np.ndarray) -> list[np.ndarray]:
    """Of each center the rows (k,) of the points (n, 3) m about it, ascending."""
    # sorted by strips along x; of maps of more strips the last one holds the rest
    start = points[:, 0].min(initial=0)
    strip = np.minimum((points[:, 0] - start) / _AROUND, 65_535).astype(np.uint16)
    order = np.argsort(strip, kind="stable")
    ends = np.concatenate([[0], np.cumsum(np.bincount(strip, minlength=65_536))])
    rows = []
    for x, y in centers[:, :2]:
        first, last = np.clip([(x - _AROUND - start) / _AROUND, (x + _AROUND - start) / _AROUND], 0, 65_535).astype(int)
        near = order[ends[first] : ends[last + 1]]
        near = near[np.abs(points[near, 1] - y) < _AROUND]
        rows.append(np.sort(near[np.abs(points[near, 0] - x) < _AROUND]))
    return rows
