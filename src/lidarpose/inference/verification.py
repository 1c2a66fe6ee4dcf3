"""Which detections are people: a small network says so of each. Those that are are posed by the default network, and
boxes are drawn about their poses.

Legend: D detections.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from lidarpose.geometry import distance_to_segments, rotation_about, rows_near
from lidarpose.inference.backend import Backend, Raw, bundled_backend, estimates
from lidarpose.inference.known_places import KnownPlaces
from lidarpose.inference.tta import IDENTITY, apply
from lidarpose.models import DEFAULT, VERIFIER
from lidarpose.models.decode import decoder, sigmoid
from lidarpose.models.detector.detector import Detections
from lidarpose.sample import MIN_POINTS, Box, Pose, facing_yaw

# rows (m,) of a scan's points that are on nobody, and where people are (K, 2) m -> who else is beside them
DetectBeside = Callable[[np.ndarray, np.ndarray], Detections]

# what is posed: a column so wide, and so far below and above the detection's box, m
_COLUMN, _BELOW, _ABOVE = 0.6, 0.15, 0.25
# points around a detection that its final box may hold, m to each side
AROUND = 2.5
# a box is so much larger than the joints on each side, m, beside another person no more than this; it ends half way to
# the next person, less half a body
_ROOM, _LEAST_ROOM, _HALF_BODY = 0.15, 0.1, 0.25
# of two people whose pelvises are nearer than this the less certain one is the same person, m; nearer than the second
# distance, the less certain one is posed once more, by the points in the box alone
_SAME_PERSON, _CLOSE = 0.3, 0.8
# places that are posed for each person that is asked for at most: some are the same person
_PLACES = 2
# so is who shares more than this with surer people, of the points in the box
_SHARED = 0.9
# what the final score is made of, by detection: the scorer's logit; the verifier's log odds of a person; log of 1 + the
# points of the column
FEATURES = ("logit", "verifier", "log_points")
# their weights for a detector without its own
_FALLBACK_WEIGHTS = {"logit": 0.5, "verifier": 0.5}
# log odds beyond this say hardly more: they count only by this share
_MOST_ODDS, _BEYOND_MOST = 6.0, 0.01
# the fewest and most points, between which a score is bounded before anybody is verified
_LOG_POINTS = (np.log1p(MIN_POINTS), np.log1p(1e5))
# whose points are left out where others are looked for beside them: people of at least this score, points so near to
# their bones, m
_SURE_SCORE, _BODY = 0.5, 0.18
# who is expected may have moved by so much out of the box, m
_MOVED = 0.15
# a place is known to hold nobody below this share of the least score
_NOBODY = 1 / 3
# decimals of meters in boxes, as they are written
_DECIMALS = 4


def _bundled(name: str) -> Backend:
    return bundled_backend(name)


def verification_features(detections: Detections, points: np.ndarray, origin: np.ndarray | None) -> np.ndarray:
    """What the final score of detections in points (n, 3) m, level, from a sensor at origin (3,) or None is made of:
    (D, 3) in the order of `FEATURES`, NaN of fewer than 5 points."""
    near_rows = rows_near(detections.centers, points, AROUND)
    return Crops(detections, dict(enumerate(points[rows] for rows in near_rows)), origin).verdicts()[0]


def final_score(features: np.ndarray, header: dict) -> np.ndarray:
    """features (D, 3) -> (D,) in [0, 1]: the probability that a detection is a person, by the detector's header; 0 of
    what could not be verified."""
    verification = header.get("verification") or {}
    logit = final_logit(features, header)
    calibration = verification.get("calibration") or header.get("calibration")
    # of a network that is not calibrated yet as it comes
    probability = sigmoid(logit) if calibration is None else np.interp(logit, *calibration)
    # as boxes state it
    return np.nan_to_num(probability).round(_DECIMALS)


def final_logit(features: np.ndarray, header: dict) -> np.ndarray:
    """features (D, 3) -> (D,): what the final score rises with, which ends at some probability."""
    verification = header.get("verification") or {}
    # the scores of detectors before 0.3 were of poses
    weights = verification if "verifier" in verification else _FALLBACK_WEIGHTS
    return features @ [weights.get(name, 0.0) for name in FEATURES] + weights.get("bias", 0.0)


def surest_rows(scores: np.ndarray, pelvises: np.ndarray, logits: np.ndarray) -> list[int]:
    """Of detections with scores (D,) and pelvises (D, 3) m, NaN where there is none, the rows of different people, the
    surest first; of equal scores by logits (D,)."""
    rows: list[int] = []
    for i in _surest_first(scores, logits).tolist():
        is_same = (np.linalg.norm(pelvises[rows] - pelvises[i], axis=1) < _SAME_PERSON).any()
        if not is_same and not np.isnan(pelvises[i]).any():
            rows.append(i)
    return rows


def _surest_first(scores: np.ndarray, logits: np.ndarray) -> np.ndarray:
    """(D,): rows by falling score, of equal ones by logits."""
    return np.lexsort((-logits, -scores))


def inside_column(points: np.ndarray, center: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Which points (n, 3) m are posed of a detection with this center and box size (3,) m: (n,) bool."""
    height = points[:, 2] - center[2]
    is_inside = (height > -size[2] / 2 - _BELOW) & (height < size[2] / 2 + _ABOVE)
    return is_inside & (np.hypot(*(points[:, :2] - center[:2]).T) < _COLUMN)


class Crops:
    """The columns about detections, of which those of `MIN_POINTS` and more are run through networks."""

    def __init__(self, detections: Detections, clouds: Mapping[int, np.ndarray], origin: np.ndarray | None):
        """clouds: by rows of `detections`, the points (n, 3) m near each; origin (3,) m: the sensor, None: unknown."""
        self.detections, self.origin = detections, origin
        self.columns = [np.zeros((0, 3))] * len(detections)
        for i, cloud in clouds.items():
            self.columns[i] = cloud[inside_column(cloud, detections.centers[i], detections.sizes[i])]

    def verdicts(self) -> tuple[np.ndarray, np.ndarray]:
        """features (D, 3), see `FEATURES`, and by the verifier the probability that whoever is there rides or sits in a
        wheelchair (D,); of too few points NaN."""
        logits = np.full((len(self.detections), 2), np.nan)
        centers, all_rows = self.detections.centers, np.arange(len(self.detections))
        for rows, raw in _run(self.columns, centers, self.origin, all_rows, _bundled(VERIFIER)):
            logits[rows] = raw.person
        odds = np.clip(logits[:, 0], -_MOST_ODDS, _MOST_ODDS) + _BEYOND_MOST * logits[:, 0]
        log_points = np.log1p([len(column) for column in self.columns])
        return np.column_stack([self.detections.logit, odds, log_points]), sigmoid(logits[:, 1])

    def poses(self, rows: np.ndarray) -> Pose:
        """By the default network, joints (D, 26, 3) m; NaN of all but the rows (C,), and of too few points."""
        return _posed(self.columns, self.detections.centers, self.origin, rows)


def _posed(clouds: list[np.ndarray], centers: np.ndarray, origin: np.ndarray | None, rows: np.ndarray) -> Pose:
    """Clouds (n, 3) m about centers (D, 3) m by the default network: joints (D, 26, 3) m, NaN of all but the rows (C,),
    and of too few points."""
    backend = _bundled(DEFAULT)
    skeleton = backend.header.skeleton
    joints = np.full((len(centers), len(skeleton), 3), np.nan)
    for batch, raw in _run(clouds, centers, origin, rows, backend):
        joints[batch] = estimates(raw, decoder("window"), skeleton).joints + centers[batch][:, None]
    return Pose(joints=joints, skeleton=skeleton)


def _run(
    clouds: list[np.ndarray], centers: np.ndarray, origin: np.ndarray | None, rows: np.ndarray, backend: Backend
) -> Iterator[tuple[list[int], Raw]]:
    """Batches of those among the rows that have enough points, and what a network says of them."""
    enough = (i for i in rows.tolist() if len(clouds[i]) >= MIN_POINTS)
    ordered = sorted(enough, key=lambda i: len(clouds[i]))
    for start in range(0, len(ordered), backend.batch):
        batch = ordered[start : start + backend.batch]
        yield batch, backend.run(*apply(IDENTITY, [clouds[i] for i in batch], centers[batch], origin))


def _highest_score(detections: Detections, header: dict) -> np.ndarray:
    """(D,): what `final_score` can be at most, whatever the verifier says."""
    odds = _MOST_ODDS + 1
    columns = (np.broadcast_arrays(detections.logit, odds, log_points) for log_points in _LOG_POINTS)
    return np.max([final_score(np.stack(own, -1), header) for own in columns], axis=0)


@dataclass(frozen=True, kw_only=True, eq=False)
class VerifiedPeople:
    """N people, level, surest first: boxes, rows of their points, pelvises (N, 3) m, verified (N,) bool, logits (N,),
    which scores rise with, NaN of known people; rejected (R, 3) m: detections that were nobody."""

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
    """The people among the detections, surest first, in boxes about their poses; of known people about where they are
    expected.

    Args:
        points: (n, 3) m, level, from a sensor at origin (3,) or None.
        header: the detector's.
        least_score: people of a lower score are left out; near where tracks are expected, `WEAK_SCORE` is enough.
        detect_beside: also looks for people beside others, whom it had taken for one with them.
    """
    highest_scores = _highest_score(detections, header)
    known_index, thresholds = np.full(len(detections), -1), np.full(len(detections), least_score)
    if known is not None:
        known_index = known.index_of(detections.centers, highest_scores >= least_score)
        thresholds = known.least_scores(detections.centers, known_index, least_score)
    possible_rows = np.flatnonzero(highest_scores >= thresholds)
    # who is expected needs neither verdict nor pose
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
    people = _fit_boxes(places, points, header.get("default_score", least_score), max_people, known_boxes)
    people = _without_repeats(people, places, points, origin)
    kept_rows = [row for row, _, _ in people]
    return VerifiedPeople(
        boxes=[replace(box, id=number) for number, (_, box, _) in enumerate(people)],
        rows=[own_rows for _, _, own_rows in people],
        pelvises=places.pelvises[kept_rows],
        logits=places.logits[kept_rows],
        verified=np.array([row not in known_boxes for row in kept_rows], bool),
        rejected=rejected,
    )


# of a person: the row of the detection, the box, and rows of the points in it
_FittedBox = tuple[int, Box, np.ndarray]


@dataclass(frozen=True, kw_only=True, eq=False)
class _ScoredDetections:
    """What is known of D detections: scores and logits (D,), see `final_score`, NaN where they were not looked at;
    mounted (D,), the probability; joints (D, J, 3) and pelvises (D, 3) m, NaN of who is not posed; near_rows: of each
    the rows of the points about it."""

    scores: np.ndarray
    logits: np.ndarray
    mounted: np.ndarray
    joints: np.ndarray
    pelvises: np.ndarray
    near_rows: list[np.ndarray]

    def joined(self, other: "_ScoredDetections", other_rows: np.ndarray) -> "_ScoredDetections":
        """These, then the others, which know the points of some rows alone."""
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
    """Verifies the detections of some rows, and poses those whose scores are at least `posed_from` (D,); where that is
    infinite nobody is verified."""
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
    poses = crops.poses(posed_rows)
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
    """The places, and then those beside sure people, of what is left without these people's points."""
    sure_pelvises = np.where(places.scores[:, None] >= _SURE_SCORE, places.pelvises, np.nan)
    people = _fit_boxes(replace(places, pelvises=sure_pelvises), points, _SURE_SCORE, None, known_boxes)
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
    """(n,) bool: which points are on the bodies of people, as of `_fit_boxes`, or in the boxes of known ones."""
    is_body = np.zeros(len(points), bool)
    starts, ends = np.array(_bundled(DEFAULT).header.skeleton.bones).T
    for row, _, own_rows in people:
        if row not in known_boxes:
            own_rows, joints = places.near_rows[row], places.joints[row]
            near_points, low, high = points[own_rows], joints.min(0) - _BODY, joints.max(0) + _BODY
            # far fewer than those about a person
            own_rows = own_rows[((near_points > low) & (near_points < high)).all(1)]
            distance = distance_to_segments(points[own_rows], joints[starts], joints[ends])
            own_rows = own_rows[distance < _BODY]
        is_body[own_rows] = True
    return is_body


def _without_repeats(
    people: list[_FittedBox], places: _ScoredDetections, points: np.ndarray, origin: np.ndarray | None
) -> list[_FittedBox]:
    """The people as of `_fit_boxes`, without those whom the points in their boxes alone show where a surer one is: what
    is left of somebody's points may look like one more beside them."""
    pelvises = places.pelvises[[row for row, _, _ in people]].reshape(-1, 3)
    distance = np.linalg.norm(pelvises[:, None] - pelvises[None], axis=-1)
    # to the nearest surer one
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
    places: _ScoredDetections,
    points: np.ndarray,
    neighbor_score: float,
    max_people: int | None,
    known_boxes: dict[int, Box],
) -> list[_FittedBox]:
    """The different people of places that have a pelvis, the surest first; neighbor_score: people of this score, and
    those who are as sure as oneself, are kept out of the own box; known_boxes: by row, where known people are expected.
    """
    scores, pelvises = places.scores, places.pelvises
    skeleton = _bundled(DEFAULT).header.skeleton
    person_rows = surest_rows(scores, pelvises, places.logits)
    is_owned = np.zeros(len(points), bool)
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
        if len(own_rows) < MIN_POINTS or is_owned[own_rows].mean() > _SHARED or len(people) == max_people:
            continue
        is_owned[own_rows] = True
        people.append((i, replace(box, score=float(scores[i]), mounted=is_mounted), own_rows))
    return people


def box_about(pose: Pose, nearest_distance: float) -> Box:
    """The box of a person by the pose, joints (J, 3) m; nearest_distance: to the next person, m, who is to be kept
    out."""
    yaw = facing_yaw(pose)
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
