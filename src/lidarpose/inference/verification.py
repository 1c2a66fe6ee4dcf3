"""Which detections are people: each is posed by the default network. How sure it is of the pose, and whether it sees a
person at all, goes into the score.

Legend: D detections.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product

import numpy as np

from lidarpose.geometry import Strips, rotation_about
from lidarpose.inference.backend import Backend, OnnxBackend, estimates
from lidarpose.inference.tta import TTATransform, apply
from lidarpose.models import DEFAULT, weights_path
from lidarpose.models.decode import decoder, sigmoid
from lidarpose.models.detector.detector import Detections
from lidarpose.sample import MIN_POINTS, Box, Pose, facing

# what poses detections
VERIFIER = DEFAULT
# detections that are posed at once, of like size: a batch costs as much as if all were its largest
_BATCH = 16
# what is posed: a column so wide, and so far below and above the detection's box, m
_COLUMN, _BELOW, _ABOVE = 0.6, 0.15, 0.25
# points around a detection that its final box may hold, m to each side
_AROUND = 2.5
# a box is so much larger than the joints on each side, m, beside another person no more than this; it ends half way to
# the next person, less half a body
_ROOM, _LEAST_ROOM, _HALF_BODY = 0.15, 0.1, 0.25
# of two people whose pelvises are nearer than this the less certain one is the same person, m
_SAME_PERSON = 0.3
# what the final score is made of, by detection: the scorer's logit; means over the joints of confidence and of the log
# of spread, m; log of 1 + the points of the column; probability that the person is mounted; log odds that the network
# sees a person, 0 of a network that does not say
FEATURES = ("logit", "confidence", "log_spread", "log_points", "mounted", "person")
# those that mean something else where the person is mounted: riders are posed badly
_OF_MOUNTED = ("confidence", "log_spread", "person")
# weights of the features and of products with "mounted", for a detector without its own
_FALLBACK_WEIGHTS = {
    "bias": -1.5 * np.log(10),
    "logit": 1.0,
    "log_spread": -1.5,
    "mounted": 1.5 * np.log(10),
    "mounted_log_spread": 1.5,
}
# log odds beyond this say no more
_MOST_ODDS = 6.0
# what joints can be at best, the fewest and most points, and the odds, between which a score is bounded before anybody
# is posed: the least mean spread of a person's joints seen is 0.022 m
_CONFIDENCES, _LOG_SPREADS, _LOG_POINTS = (0.0, 1.0), (np.log(0.012), 0.0), (np.log1p(MIN_POINTS), np.log1p(1e5))
_ODDS = (-_MOST_ODDS, _MOST_ODDS)
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

    def level(self, R_level_input: np.ndarray) -> "KnownPlaces":
        """In the scan's level frame."""
        level_points = {name: getattr(self, name) @ R_level_input.T for name in ("pelvises", "tracks", "rejected")}
        return replace(
            self, boxes=[replace(box, center=R_level_input @ box.center) for box in self.boxes], **level_points
        )


@cache
def _verifier() -> Backend:
    return OnnxBackend(weights_path(VERIFIER).with_suffix(".onnx"))


def verification_features(
    detections: Detections, points: np.ndarray, origin: np.ndarray | None
) -> tuple[np.ndarray, Pose]:
    """What the final score of detections in points (n, 3) m, level, from a sensor at origin (3,) or None is made of,
    with poses by the bundled default network.

    Returns:
        features (D, 6) in the order of `FEATURES`, and the poses, joints (D, 26, 3) m in the frame of the points; of
        fewer than 5 points they are NaN.
    """
    detection_rows = np.arange(len(detections))
    clouds = [points[rows] for rows in _rows_near(detections.centers, points)]
    return _posed(detections, detection_rows, clouds, origin, _verifier())


def final_score(features: np.ndarray, header: dict) -> np.ndarray:
    """features (D, 6) -> (D,) in [0, 1]: the probability that a detection is a person, by the detector's header."""
    verification = header.get("verification") or {}
    weights = verification if "logit" in verification else _FALLBACK_WEIGHTS
    logit = np.full(len(features), float(weights.get("bias", 0.0)))
    for name, values in score_terms(features).items():
        logit += weights.get(name, 0.0) * values
    calibration = verification.get("calibration") or header.get("calibration")
    # of a network that is not calibrated yet as it comes
    probability = sigmoid(logit) if calibration is None else np.interp(logit, *calibration)
    return np.nan_to_num(probability)


def score_terms(features: np.ndarray) -> dict[str, np.ndarray]:
    """What the logit of the final score is linear in, by name (D,): features (D, 6), and products with "mounted"."""
    terms = dict(zip(FEATURES, features.T, strict=True))
    return terms | {f"mounted_{name}": terms["mounted"] * terms[name] for name in _OF_MOUNTED}


def inside_column(points: np.ndarray, center: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Which points (n, 3) m are posed of a detection with this center and box size (3,) m: (n,) bool."""
    height = points[:, 2] - center[2]
    is_inside = (height > -size[2] / 2 - _BELOW) & (height < size[2] / 2 + _ABOVE)
    return is_inside & (np.hypot(*(points[:, :2] - center[:2]).T) < _COLUMN)


def _posed(
    detections: Detections, rows: np.ndarray, clouds: list[np.ndarray], origin: np.ndarray | None, backend: Backend
) -> tuple[np.ndarray, Pose]:
    """As `verification_features`, of the detections in `rows` (C,) and the points (n, 3) m near each of these; of
    the others what comes from points is NaN."""
    columns = [np.zeros((0, 3))] * len(detections)
    for i, cloud in zip(rows.tolist(), clouds, strict=True):
        columns[i] = cloud[inside_column(cloud, detections.centers[i], detections.sizes[i])]
    posed_rows = sorted(
        (i for i, column in enumerate(columns) if len(column) >= MIN_POINTS), key=lambda i: len(columns[i])
    )
    skeleton = backend.header.skeleton
    joints = np.full((len(columns), len(skeleton), 3), np.nan)
    confidence, spread = np.full((2, *joints.shape[:2]), np.nan)
    odds = np.full(len(columns), np.nan)
    for start in range(0, len(posed_rows), _BATCH):
        batch = posed_rows[start : start + _BATCH]
        clouds, view = apply(TTATransform(), [columns[i] for i in batch], detections.centers[batch], origin)
        raw = backend.run(clouds, view)
        pose = estimates(raw, decoder("window"), skeleton)
        joints[batch] = pose.joints + detections.centers[batch][:, None]
        confidence[batch], spread[batch] = pose.confidence, pose.spread
        odds[batch] = 0 if raw.person is None else np.clip(raw.person[:, 0], -_MOST_ODDS, _MOST_ODDS)
    log_points = np.log1p([len(column) for column in columns])
    with np.errstate(invalid="ignore"):
        features = (detections.logit, confidence.mean(1), np.log(spread).mean(1), log_points, detections.mounted, odds)
    poses = Pose(joints=joints, skeleton=skeleton, confidence=confidence, spread=spread)
    return np.stack(features, -1).reshape(-1, len(FEATURES)), poses


def _highest_score(detections: Detections, header: dict) -> np.ndarray:
    """(D,): what `final_score` can be at most, whatever the pose. The score's logit is linear in what is unknown."""
    highest_scores = np.zeros(len(detections))
    for confidence, log_spread, log_points, odds in product(_CONFIDENCES, _LOG_SPREADS, _LOG_POINTS, _ODDS):
        pose_features = np.broadcast_to([confidence, log_spread, log_points], (len(detections), 3))
        columns = (detections.logit, pose_features, detections.mounted, np.full(len(detections), odds))
        highest_scores = np.maximum(highest_scores, final_score(np.column_stack(columns), header))
    return highest_scores


@dataclass(frozen=True, kw_only=True, eq=False)
class People:
    """N people, level, surest first: boxes, rows of their points, pelvises (N, 3) m, verified (N,) bool; rejected
    (R, 3) m: detections that were nobody."""

    boxes: list[Box]
    rows: list[np.ndarray]
    pelvises: np.ndarray
    verified: np.ndarray
    rejected: np.ndarray


def verified(
    detections: Detections,
    points: np.ndarray,
    origin: np.ndarray | None,
    header: dict,
    least_score: float,
    max_people: int | None = None,
    known: KnownPlaces | None = None,
) -> People:
    """The people among the detections, surest first, in boxes about their poses; of known people about where they are
    expected.

    Args:
        points: (n, 3) m, level, from a sensor at origin (3,) or None.
        header: the detector's.
        least_score: people of a lower score are left out; near where tracks are expected, `WEAK_SCORE` is enough.
    """
    highest_scores = _highest_score(detections, header)
    known_index, thresholds = np.full(len(detections), -1), np.full(len(detections), least_score)
    if known is not None:
        known_index = _expected(detections, highest_scores >= least_score, known)
        thresholds = _least_scores(detections, known_index, least_score, known)
    possible_rows = np.flatnonzero(highest_scores >= thresholds)
    near_rows = dict(zip(possible_rows.tolist(), _rows_near(detections.centers[possible_rows], points), strict=True))
    posed_rows = possible_rows[known_index[possible_rows] < 0]
    features, poses = _posed(
        detections, posed_rows, [points[near_rows[i]] for i in posed_rows.tolist()], origin, _verifier()
    )
    scores = final_score(features, header)
    pelvises = poses.joints[:, poses.skeleton.index("pelvis")].copy()
    rejected = detections.centers[posed_rows][scores[posed_rows] < _NOBODY * least_score]
    if known is not None:
        known_rows = np.flatnonzero(known_index >= 0)
        scores[known_rows] = [known.boxes[k].score for k in known_index[known_rows].tolist()]
        pelvises[known_rows] = known.pelvises[known_index[known_rows]]
    person_rows: list[int] = []
    for i in np.argsort(-scores, kind="stable").tolist():
        is_new = not (np.linalg.norm(pelvises[person_rows] - pelvises[i], axis=1) < _SAME_PERSON).any()
        if scores[i] >= thresholds[i] and is_new and not np.isnan(pelvises[i]).any():
            person_rows.append(i)
    boxes: list[Box] = []
    rows: list[np.ndarray] = []
    kept_rows: list[int] = []
    for i in person_rows:
        if known is not None and known_index[i] >= 0:
            box = known.boxes[known_index[i]]
            crop_box, mounted = replace(box, size=box.size + 2 * _MOVED), box.mounted
        else:
            distances = [
                np.hypot(*(pelvises[k] - pelvises[i])[:2]) for k in person_rows if k != i and scores[k] >= least_score
            ]
            nearest_distance = min(distances, default=np.inf)
            box = crop_box = _box_about(Pose(joints=poses.joints[i], skeleton=poses.skeleton), nearest_distance)
            mounted = bool(detections.mounted[i] > 0.5)
        is_inside = crop_box.contains(points[near_rows[i]])
        if is_inside.sum() < MIN_POINTS or len(boxes) == max_people:
            continue
        boxes.append(replace(box, id=len(boxes), score=round(float(scores[i]), _DECIMALS), mounted=mounted))
        rows.append(near_rows[i][is_inside])
        kept_rows.append(i)
    return People(
        boxes=boxes, rows=rows, pelvises=pelvises[kept_rows], verified=known_index[kept_rows] < 0, rejected=rejected
    )


def _least_scores(
    detections: Detections, known_index: np.ndarray, least_score: float, known_places: KnownPlaces
) -> np.ndarray:
    """(D,): what a detection's score must be: less where a known person is missed, infinite where it turned out to be
    nobody."""
    thresholds = np.full(len(detections), least_score)
    is_missed = ~np.isin(np.arange(len(known_places.tracks)), known_index)
    is_near = (_apart(detections.centers, known_places.tracks[is_missed]) < known_places.reach[is_missed]).any(1)
    thresholds[is_near] = min(least_score, WEAK_SCORE)
    is_nobody = (_apart(detections.centers, known_places.rejected) < _SAME_PLACE).any(1)
    thresholds[is_nobody & ~is_near & (known_index < 0)] = np.inf
    return thresholds


def _expected(detections: Detections, is_sure: np.ndarray, known_places: KnownPlaces) -> np.ndarray:
    """Of each detection, those that are sure enough, which known person it is: (D,) int, -1: none."""
    known_index = np.full(len(detections), -1)
    sure_rows = np.flatnonzero(is_sure)
    if len(sure_rows) and known_places.boxes:
        distances = _apart(detections.centers[sure_rows], known_places.tracks[: len(known_places.boxes)])
        is_alone = (_apart(known_places.tracks, known_places.tracks) < _ALONE).sum(0)[: len(known_places.boxes)] == 1
        nearest_rows = distances.argmin(0)
        for k in np.flatnonzero(is_alone & (distances.min(0) < _EXPECTED)):
            known_index[sure_rows[nearest_rows[k]]] = k
    return known_index


def _apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Level distances of a (A, 2+) from b (B, 2+): (A, B) m."""
    return np.linalg.norm(a[:, None, :2] - b[None, :, :2], axis=-1)


def _box_about(pose: Pose, nearest_distance: float) -> Box:
    """The box of a person by the pose, joints (J, 3) m; nearest_distance: to the next person, m, who is to be kept
    out."""
    forward = facing(pose)
    yaw = 0.0 if forward is None else float(np.arctan2(forward[1], forward[0]))
    R_level_local = rotation_about("z", yaw)
    local_joints = pose.joints @ R_level_local
    margin = max(_LEAST_ROOM, min(_ROOM, nearest_distance / 2 - _HALF_BODY))
    # soles are nearer to the lowest joint than the top of the head to the highest
    low, high = local_joints.min(0) - [margin, margin, 0.8 * _ROOM], local_joints.max(0) + [margin, margin, 1.2 * _ROOM]
    return rounded(Box(center=R_level_local @ ((low + high) / 2), size=high - low, yaw=yaw))


def rounded(box: Box) -> Box:
    """As it is written: a file of boxes crops the same points."""
    center, size = box.center.round(_DECIMALS), box.size.round(_DECIMALS)
    return replace(box, center=center, size=size, yaw=round(box.yaw, _DECIMALS))


def _rows_near(centers: np.ndarray, points: np.ndarray) -> list[np.ndarray]:
    """Of each center the rows (k,) of the points (n, 3) m about it, ascending."""
    strips, rows = Strips(points[:, 0]), []
    for x, y in centers[:, :2]:
        near_rows = strips.rows(x - _AROUND, x + _AROUND)
        near_rows = near_rows[np.abs(points[near_rows, 1] - y) < _AROUND]
        rows.append(np.sort(near_rows[np.abs(points[near_rows, 0] - x) < _AROUND]))
    return rows
