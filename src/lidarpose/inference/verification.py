"""Verification of detections: a small network classifies each detection as a person or not. People are then posed by
the default network, and boxes are fitted to their poses.

Legend: D detections.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from lidarpose.geometry import distance_to_segments, rotation_about, rows_near
from lidarpose.inference.backend import bundled_backend
from lidarpose.inference.estimator import PoseEstimator
from lidarpose.inference.known_places import KnownPlaces
from lidarpose.inference.tta import IDENTITY, apply
from lidarpose.models import DEFAULT, VERIFIER
from lidarpose.models.decode import sigmoid
from lidarpose.models.detector.detector import Detections
from lidarpose.sample import MIN_POINTS, Box, Pose, facing_yaw

# rows (m,) of a scan's points that are not on people, and positions of these people (K, 2) m -> detections beside them
DetectBeside = Callable[[np.ndarray, np.ndarray], Detections]

# the column of points that is verified and posed: radius, and margins below and above the detection's box, m
_COLUMN, _BELOW, _ABOVE = 0.6, 0.15, 0.25
# half width, m, of the region around a detection from which its final box may take points
AROUND = 2.5
# margin of a box around the joints on each side, m, and its minimum next to another person; next to one, the margin is
# half the distance minus half a body
_ROOM, _LEAST_ROOM, _HALF_BODY = 0.15, 0.1, 0.25
# if two pelvises are nearer than this, m, the lower-scoring detection is a duplicate; if nearer than the second
# distance, the lower-scoring person is posed again using only the points in its box
_SAME_PERSON, _CLOSE = 0.3, 0.8
# detections posed per requested person if `max_people` is given: some are duplicates
_PLACES = 2
# a detection is a duplicate, too, if more than this fraction of its box's points is on bodies of higher-scoring ones
_SHARED = 0.75
# or more than this fraction is in boxes of known people
_SHARED_KNOWN = 0.9
# features of the final score of a detection: the detector's logit, the verifier's log odds of a person, and log of
# 1 + the number of points in the column
FEATURES = ("logit", "verifier", "log_points")
# their weights for a detector whose header has none
_FALLBACK_WEIGHTS = {"logit": 0.5, "verifier": 0.5}
# log odds beyond `_MOST_ODDS` carry little more information: the excess is scaled by `_BEYOND_MOST`
_MOST_ODDS, _BEYOND_MOST = 6.0, 0.01
# minimum and maximum of the feature `log_points`, for the upper bound of scores before verification
_LOG_POINTS = (np.log1p(MIN_POINTS), np.log1p(1e5))
# when people beside others are searched for, the points of these others are removed: minimum score of these others,
# and maximum distance of their points from the bones, m
_SURE_SCORE, _BODY = 0.5, 0.18
# distance, m, by which a known person may have moved out of the expected box
_MOVED = 0.15
# detections below this fraction of the score threshold are remembered as rejected
_NOBODY = 1 / 3
# decimals of the numbers in boxes, as they are written to files
_DECIMALS = 4


def verification_features(detections: Detections, points: np.ndarray, origin: np.ndarray | None) -> np.ndarray:
    """Features (D, 3) of the final score of detections in points (n, 3) m in the level frame, in the order of
    `FEATURES`. origin (3,) m: sensor position, None if unknown. The verifier's log odds are NaN for fewer than 5
    points."""
    near_rows = rows_near(detections.centers, points, AROUND)
    return Crops(detections, dict(enumerate(points[rows] for rows in near_rows)), origin).verdicts()[0]


def final_score(features: np.ndarray, header: dict) -> np.ndarray:
    """features (D, 3) -> (D,) in [0, 1]: the probability that a detection is a person, with the weights and calibration
    of the detector's header; 0 for detections that were not verified."""
    verification = header.get("verification") or {}
    logit = final_logit(features, header)
    calibration = verification.get("calibration") or header.get("calibration")
    # without calibration, the plain sigmoid
    probability = sigmoid(logit) if calibration is None else np.interp(logit, *calibration)
    # rounded as in boxes
    return np.nan_to_num(probability).round(_DECIMALS)


def final_logit(features: np.ndarray, header: dict) -> np.ndarray:
    """features (D, 3) -> (D,): the logit of the final score, which still ranks detections where the calibrated score
    saturates."""
    verification = header.get("verification") or {}
    # detectors before 0.3 have weights for other features, taken from poses
    weights = verification if "verifier" in verification else _FALLBACK_WEIGHTS
    return features @ [weights.get(name, 0.0) for name in FEATURES] + weights.get("bias", 0.0)


def surest_rows(scores: np.ndarray, pelvises: np.ndarray, logits: np.ndarray) -> list[int]:
    """Rows of detections of different people, highest score first; equal scores are ordered by logits (D,). Detections
    without a pelvis (D, 3) m, which is NaN then, and duplicates are left out."""
    rows: list[int] = []
    for i in _surest_first(scores, logits).tolist():
        is_same = (np.linalg.norm(pelvises[rows] - pelvises[i], axis=1) < _SAME_PERSON).any()
        if not is_same and not np.isnan(pelvises[i]).any():
            rows.append(i)
    return rows


def _surest_first(scores: np.ndarray, logits: np.ndarray) -> np.ndarray:
    """(D,): rows by descending score; equal scores by descending logit."""
    return np.lexsort((-logits, -scores))


def inside_column(points: np.ndarray, center: np.ndarray, size: np.ndarray) -> np.ndarray:
    """points (n, 3) m -> (n,) bool: in the column of a detection with this center and box size (3,) m."""
    height = points[:, 2] - center[2]
    is_inside = (height > -size[2] / 2 - _BELOW) & (height < size[2] / 2 + _ABOVE)
    return is_inside & (np.hypot(*(points[:, :2] - center[:2]).T) < _COLUMN)


class Crops:
    """The columns of points around detections. Those with at least `MIN_POINTS` points are run through networks."""

    def __init__(self, detections: Detections, clouds: Mapping[int, np.ndarray], origin: np.ndarray | None):
        """clouds: points (n, 3) m near each detection, by row; origin (3,) m: sensor position, None if unknown."""
        self.detections, self.origin = detections, origin
        self.columns = [np.zeros((0, 3))] * len(detections)
        for i, cloud in clouds.items():
            self.columns[i] = cloud[inside_column(cloud, detections.centers[i], detections.sizes[i])]

    def verdicts(self) -> tuple[np.ndarray, np.ndarray]:
        """Runs the verifier. Returns features (D, 3), see `FEATURES`, and the probability (D,) that the person rides or
        sits in a wheelchair; the verifier's values are NaN for too few points."""
        logits = np.full((len(self.detections), 2), np.nan)
        backend, centers = bundled_backend(VERIFIER), self.detections.centers
        enough = [i for i, column in enumerate(self.columns) if len(column) >= MIN_POINTS]
        # a batch costs as much as if all its clouds were as large as the largest
        rows = sorted(enough, key=lambda i: len(self.columns[i]))
        for start in range(0, len(rows), backend.batch):
            batch = rows[start : start + backend.batch]
            columns = [self.columns[i] for i in batch]
            logits[batch] = backend.run(*apply(IDENTITY, columns, centers[batch], self.origin)).person
        odds = np.clip(logits[:, 0], -_MOST_ODDS, _MOST_ODDS) + _BEYOND_MOST * logits[:, 0]
        log_points = np.log1p([len(column) for column in self.columns])
        return np.column_stack([self.detections.logit, odds, log_points]), sigmoid(logits[:, 1])


def _posed(clouds: list[np.ndarray], centers: np.ndarray, origin: np.ndarray | None, rows: np.ndarray) -> Pose:
    """Poses of the given rows (C,) of clouds (n, 3) m around centers (D, 3) m by the default network: joints
    (D, 26, 3) m, NaN for other rows and for too few points. As in `predict`, the first pass finds the pelvis; here it
    is about the detection instead of the middle of the points, which may be those of another person."""
    estimator = PoseEstimator(bundled_backend(DEFAULT))
    joints = np.full((len(centers), len(estimator.skeleton), 3), np.nan)
    posed_rows = [row for row in rows.tolist() if len(clouds[row]) >= MIN_POINTS]
    poses = estimator.poses([clouds[row] for row in posed_rows], origin, first_centers=centers[posed_rows])
    for row, pose in zip(posed_rows, poses, strict=True):
        if pose is not None:
            joints[row] = pose.joints
    return Pose(joints=joints, skeleton=estimator.skeleton)


def _highest_score(detections: Detections, header: dict) -> np.ndarray:
    """(D,): upper bound of `final_score` for any output of the verifier."""
    odds = _MOST_ODDS + 1
    columns = (np.broadcast_arrays(detections.logit, odds, log_points) for log_points in _LOG_POINTS)
    return np.max([final_score(np.stack(own, -1), header) for own in columns], axis=0)


@dataclass(frozen=True, kw_only=True, eq=False)
class VerifiedPeople:
    """N people in the level frame, highest score first.

    boxes; rows: of their points; pelvises (N, 3) m; logits (N,): of the final scores, NaN for known people; verified
    (N,) bool: False for known people; rejected (R, 3) m: centers of rejected detections.
    """

    boxes: list[Box]
    rows: list[np.ndarray]
    pelvises: np.ndarray
    logits: np.ndarray
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
    detect_beside: DetectBeside | None = None,
) -> VerifiedPeople:
    """Verifies detections and returns the people among them, highest score first, with boxes fitted to their poses.
    Known people keep their expected boxes.

    Args:
        detections: in the level frame.
        points: (n, 3) m in the level frame.
        origin: (3,) m, sensor position, None if unknown.
        header: the header of the detector.
        least_score: score threshold; near expected tracks, `WEAK_SCORE` is the threshold.
        max_people: maximum number of people.
        known: people and rejected positions from earlier frames of a recording.
        detect_beside: detects further people beside others, who were merged with them in the first detection.
    """
    highest_scores = _highest_score(detections, header)
    known_index, thresholds = np.full(len(detections), -1), np.full(len(detections), least_score)
    if known is not None:
        known_index = known.index_of(detections.centers, highest_scores >= least_score)
        thresholds = known.least_scores(detections.centers, known_index, least_score)
    possible_rows = np.flatnonzero(highest_scores >= thresholds)
    # detections of expected people are neither verified nor posed
    posed_from = thresholds if detect_beside is None else np.minimum(thresholds, _SURE_SCORE)
    posed_from = np.where(known_index < 0, posed_from, np.inf)
    places = _score_detections(detections, points, origin, header, posed_from, max_people, possible_rows)
    is_nobody = places.scores[possible_rows] < _NOBODY * least_score
    rejected = detections.centers[possible_rows[is_nobody & (known_index[possible_rows] < 0)]]
    known_boxes: dict[int, Box] = {}
    if known is not None:
        known_rows = np.flatnonzero(known_index >= 0)
        known_boxes = {row: known.boxes[known_index[row]] for row in known_rows.tolist()}
        places.scores[known_rows] = [box.score for box in known_boxes.values()]
        places.pelvises[known_rows] = known.pelvises[known_index[known_rows]]
    if detect_beside is not None:
        places = _add_people_beside(places, known_boxes, points, origin, header, least_score, max_people, detect_beside)
        thresholds = np.append(thresholds, np.full(len(places.scores) - len(thresholds), least_score))
    places.pelvises[places.scores < thresholds] = np.nan
    people = _distinct_people(places, points, origin, header.get("default_score", least_score), known_boxes)
    people = people[:max_people]
    kept_rows = [row for row, _, _ in people]
    return VerifiedPeople(
        boxes=[replace(box, id=number) for number, (_, box, _) in enumerate(people)],
        rows=[own_rows for _, _, own_rows in people],
        pelvises=places.pelvises[kept_rows],
        logits=places.logits[kept_rows],
        verified=np.array([row not in known_boxes for row in kept_rows], bool),
        rejected=rejected,
    )


# row of the detection, box, and rows of the points in the box
_FittedBox = tuple[int, Box, np.ndarray]


@dataclass(frozen=True, kw_only=True, eq=False)
class _ScoredDetections:
    """Results for D detections: scores and logits (D,), see `final_score` and `final_logit`; mounted (D,): the
    probability; joints (D, J, 3) and pelvises (D, 3) m, NaN for detections that are not posed; near_rows: for each
    detection, the rows of the points around it. Detections that are not verified have score 0 and logit NaN."""

    scores: np.ndarray
    logits: np.ndarray
    mounted: np.ndarray
    joints: np.ndarray
    pelvises: np.ndarray
    near_rows: list[np.ndarray]

    def joined(self, other: "_ScoredDetections", other_rows: np.ndarray) -> "_ScoredDetections":
        """Appends other detections, made in a subset of the points. other_rows (m,): the rows of this subset."""
        near_rows = self.near_rows + [other_rows[rows] for rows in other.near_rows]
        arrays = {
            name: np.concatenate([values, getattr(other, name)])
            for name, values in vars(self).items()
            if name != "near_rows"
        }
        return _ScoredDetections(**arrays, near_rows=near_rows)


def _score_detections(
    detections: Detections,
    points: np.ndarray,
    origin: np.ndarray | None,
    header: dict,
    posed_from: np.ndarray,
    max_people: int | None,
    rows: np.ndarray,
) -> _ScoredDetections:
    """Verifies the detections of the given rows and poses those with scores of at least `posed_from` (D,). Detections
    for which that is infinite are not verified."""
    near_rows = [np.zeros(0, int)] * len(detections)
    for row, own_rows in zip(rows.tolist(), rows_near(detections.centers[rows], points, AROUND), strict=True):
        near_rows[row] = own_rows
    new_rows = rows[np.isfinite(posed_from[rows])]
    crops = Crops(detections, {i: points[near_rows[i]] for i in new_rows.tolist()}, origin)
    features, mounted = crops.verdicts()
    scores, logits = final_score(features, header), final_logit(features, header)
    posed_rows = new_rows[scores[new_rows] >= posed_from[new_rows]]
    if max_people is not None:
        posed_rows = posed_rows[_surest_first(scores[posed_rows], logits[posed_rows])][: _PLACES * max_people]
    poses = _posed(crops.columns, detections.centers, origin, posed_rows)
    pelvises = poses.joints[:, poses.skeleton.index("pelvis")].copy()
    return _ScoredDetections(
        scores=scores, logits=logits, mounted=mounted, joints=poses.joints, pelvises=pelvises, near_rows=near_rows
    )


def _add_people_beside(
    places: _ScoredDetections,
    known_boxes: dict[int, Box],
    points: np.ndarray,
    origin: np.ndarray | None,
    header: dict,
    least_score: float,
    max_people: int | None,
    detect_beside: DetectBeside,
) -> _ScoredDetections:
    """Appends detections beside confident people, made in the points that remain without the points on these
    people."""
    sure_pelvises = np.where(places.scores[:, None] >= _SURE_SCORE, places.pelvises, np.nan)
    people = _fit_boxes(replace(places, pelvises=sure_pelvises), points, _SURE_SCORE, known_boxes)
    posed_rows = [row for row, _, _ in people if row not in known_boxes]
    if not posed_rows:
        return places
    other_rows = np.flatnonzero(~_on_people(places, people, points, known_boxes))
    hidden = detect_beside(other_rows, places.pelvises[posed_rows, :2])
    posed_from = np.full(len(hidden), least_score)
    rows = np.flatnonzero(_highest_score(hidden, header) >= posed_from)
    hidden_places = _score_detections(hidden, points[other_rows], origin, header, posed_from, max_people, rows)
    return places.joined(hidden_places, other_rows)


def _on_people(
    places: _ScoredDetections, people: list[_FittedBox], points: np.ndarray, known_boxes: dict[int, Box]
) -> np.ndarray:
    """(n,) bool: whether a point is on the body of one of the people from `_fit_boxes`, or in the box of a known
    one."""
    is_body = np.zeros(len(points), bool)
    for row, _, own_rows in people:
        is_known = row in known_boxes
        is_body[own_rows if is_known else _body_rows(places.near_rows[row], points, places.joints[row])] = True
    return is_body


def _body_rows(rows: np.ndarray, points: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Those of the given rows of points (n, 3) m that are near the bones of joints (J, 3) m."""
    starts, ends = np.array(bundled_backend(DEFAULT).header.skeleton.bones).T
    near_points, low, high = points[rows], joints.min(0) - _BODY, joints.max(0) + _BODY
    # a cheap test first: it leaves far fewer points
    rows = rows[((near_points > low) & (near_points < high)).all(1)]
    return rows[distance_to_segments(points[rows], joints[starts], joints[ends]) < _BODY]


def _distinct_people(
    places: _ScoredDetections,
    points: np.ndarray,
    origin: np.ndarray | None,
    neighbor_score: float,
    known_boxes: dict[int, Box],
) -> list[_FittedBox]:
    """The people from `_fit_boxes` without duplicates. Pelvises of all other detections become NaN, and boxes that were
    shrunk to exclude them are fitted again."""
    while True:
        num_fitted = len(surest_rows(places.scores, places.pelvises, places.logits))
        people = _fit_boxes(places, points, neighbor_score, known_boxes)
        people = _without_repeats(people, places, points, origin)
        if len(people) == num_fitted:
            return people
        places.pelvises[np.setdiff1d(np.arange(len(places.pelvises)), [row for row, _, _ in people])] = np.nan


def _without_repeats(
    people: list[_FittedBox], places: _ScoredDetections, points: np.ndarray, origin: np.ndarray | None
) -> list[_FittedBox]:
    """The people from `_fit_boxes` without duplicates: a person next to a higher-scoring one is dropped if the pose of
    the points in its own box coincides with the higher-scoring one. The remaining points of a person may look like a
    second person beside the first."""
    pelvises = places.pelvises[[row for row, _, _ in people]].reshape(-1, 3)
    distance = np.linalg.norm(pelvises[:, None] - pelvises[None], axis=-1)
    # near any higher-scoring person
    close = np.flatnonzero(np.tril(distance < _CLOSE, -1).any(1))
    if not len(close):
        return people
    clouds, centers = [points[own_rows] for _, _, own_rows in people], np.array([box.center for _, box, _ in people])
    own_poses = _posed(clouds, centers, origin, close)
    own_pelvises = own_poses.joints[:, own_poses.skeleton.index("pelvis")]
    is_repeated = np.zeros(len(people), bool)
    for k in close:
        surer = np.flatnonzero(~is_repeated[:k])
        is_repeated[k] = (np.linalg.norm(pelvises[surer] - own_pelvises[k], axis=1) < _SAME_PERSON).any()
    return [person for person, is_gone in zip(people, is_repeated, strict=True) if not is_gone]


def _fit_boxes(
    places: _ScoredDetections, points: np.ndarray, neighbor_score: float, known_boxes: dict[int, Box]
) -> list[_FittedBox]:
    """Fits boxes to the distinct people among detections with a pelvis, highest score first.

    neighbor_score: a box is shrunk to exclude neighbors with at least this score or with a score not lower than its
    own; known_boxes: expected boxes of known people, by row.
    """
    scores, pelvises = places.scores, places.pelvises
    skeleton = bundled_backend(DEFAULT).header.skeleton
    person_rows = surest_rows(scores, pelvises, places.logits)
    # points on the bodies of people, and in the boxes of known people, whose joints are not estimated again
    is_body, is_known = np.zeros((2, len(points)), bool)
    people: list[_FittedBox] = []
    for i in person_rows:
        if i in known_boxes:
            box = known_boxes[i]
            crop_box, is_mounted = replace(box, size=box.size + 2 * _MOVED), box.mounted
        else:
            neighbors = [k for k in person_rows if k != i and scores[k] >= min(scores[i], neighbor_score)]
            distances = [np.hypot(*(pelvises[k] - pelvises[i])[:2]) for k in neighbors]
            pose = Pose(joints=places.joints[i], skeleton=skeleton)
            box = crop_box = box_about(pose, min(distances, default=np.inf))
            is_mounted = bool(places.mounted[i] > 0.5)
        own_rows = places.near_rows[i][crop_box.contains(points[places.near_rows[i]])]
        if len(own_rows) < MIN_POINTS:
            continue
        if is_body[own_rows].mean() > _SHARED or is_known[own_rows].mean() > _SHARED_KNOWN:
            continue
        if i in known_boxes:
            is_known[own_rows] = True
        else:
            # points in the box, but not on the body, may be those of a second person in contact with this one
            is_body[_body_rows(own_rows, points, places.joints[i])] = True
        people.append((i, replace(box, score=float(scores[i]), mounted=is_mounted), own_rows))
    return people


def box_about(pose: Pose, nearest_distance: float) -> Box:
    """The box of a person around its pose, joints (J, 3) m. nearest_distance: m, to the nearest person to exclude."""
    yaw = facing_yaw(pose)
    R_level_local = rotation_about("z", yaw)
    local_joints = pose.joints @ R_level_local
    margin = max(_LEAST_ROOM, min(_ROOM, nearest_distance / 2 - _HALF_BODY))
    # the soles are nearer to the lowest joint than the top of the head is to the highest joint
    low, high = local_joints.min(0) - [margin, margin, 0.8 * _ROOM], local_joints.max(0) + [margin, margin, 1.2 * _ROOM]
    return rounded(Box(center=R_level_local @ ((low + high) / 2), size=high - low, yaw=yaw))


def rounded(box: Box) -> Box:
    """The box rounded as it is written, so that a file of boxes crops the same points."""
    center, size = box.center.round(_DECIMALS), box.size.round(_DECIMALS)
    return replace(box, center=center, size=size, yaw=round(box.yaw, _DECIMALS))
