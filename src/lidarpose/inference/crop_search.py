"""Searches a crop that is wider than a person for the person: candidate clouds, and the pose that is selected."""

from dataclasses import replace

import numpy as np

from lidarpose.sample import MIN_POINTS, Pose, center_of

# a crop wider than this, m, may contain more than one person, so candidates are searched in it; if its pose is unsure,
# in a crop wider than the second value
WIDE, WIDE_IF_UNSURE = 2.0, 1.3
# maximum distance of candidates from the middle of the crop, and size of the grid cells, m
_SEARCH, _CELL = 10.0, 0.1
# height range from above the ground to a raised hand, m
_ABOVE_GROUND, _REACH = 0.25, 2.3
# inner and outer radius in cells: the column contains a trunk; the ring is emptier around a person than beside a wall
_COLUMN, _RING = (0.0, 2.0), (3.5, 5.0)
# weight of the heights filled in the ring, subtracted from the heights filled in the column
_RING_WEIGHT = 0.5
# number of columns per crop, minimum distance between them, m, and radius around each that contains the person, m
_COLUMNS, _APART, _AROUND = 3, 0.6, 0.75
# minimum confidence of a candidate pose, as a fraction of the highest confidence; poses nearer than this, m, are of the
# same person
_SURE, _SAME = 0.6, 0.3
# mean confidence below which the pose of a crop is unsure
UNSURE = 0.65


def candidates(points: np.ndarray, width: float = WIDE) -> list[np.ndarray]:
    """points (n, 3) m, z up, n >= 1 -> candidate clouds (k, 3) for the person, the first of which contains all points.

    A crop narrower than `width` m has only this candidate. In a wider crop with ground and clutter, upright columns
    that are filled at many heights and have free space around them are candidates too. The network's confidence then
    decides between the candidates.
    """
    if (np.ptp(points[:, :2], axis=0) < width).all():
        return [points]
    near_points = points[(np.abs(points - np.median(points, axis=0))[:, :2] < _SEARCH).all(1)]
    if len(near_points) < MIN_POINTS:
        return [points]
    ground = np.percentile(near_points[:, 2], 2)
    upper_points = near_points[(near_points[:, 2] > ground + _ABOVE_GROUND) & (near_points[:, 2] < ground + _REACH)]
    if len(upper_points) < MIN_POINTS:
        return [points]
    corner = upper_points.min(0)
    cells = ((upper_points - corner) / _CELL).astype(int)
    grid = np.zeros(cells.max(0) + 1, bool)
    grid[tuple(cells.T)] = True
    score = _heights(grid, *_COLUMN) - _RING_WEIGHT * _heights(grid, *_RING)
    places = np.argwhere(grid.any(2))
    score = score[tuple(places.T)]
    places = corner[:2] + (places + 0.5) * _CELL
    clouds = [points]
    for _ in range(_COLUMNS):
        best_index = int(np.argmax(score))
        if np.isneginf(score[best_index]):
            break
        column_points = upper_points[_distance(upper_points, places[best_index]) < _AROUND / 2]
        middle = center_of(column_points)[:2] if len(column_points) else places[best_index]
        # drop what is above the person, such as trees
        cloud = points[(_distance(points, middle) < _AROUND) & (points[:, 2] < ground + _REACH)]
        if len(cloud) >= MIN_POINTS:
            clouds.append(cloud)
        score[_distance(places, places[best_index]) < _APART] = -np.inf
    return clouds


def _heights(grid: np.ndarray, inner: float, outer: float) -> np.ndarray:
    """grid (X, Y, Z) bool -> (X, Y): number of heights at which any cell `inner` to `outer` cells away is filled."""
    reach = int(outer)
    x, y, _ = grid.shape
    padded_grid = np.pad(grid, ((reach, reach), (reach, reach), (0, 0)))
    is_filled = np.zeros_like(grid)
    for i in range(2 * reach + 1):
        for j in range(2 * reach + 1):
            if inner <= np.hypot(i - reach, j - reach) <= outer:
                is_filled |= padded_grid[i : i + x, j : j + y]
    return is_filled.sum(2)


def _distance(points: np.ndarray, place: np.ndarray) -> np.ndarray:
    """(n,) m: horizontal distance of points (n, 2+) from place (2,)."""
    return np.hypot(points[:, 0] - place[0], points[:, 1] - place[1])


def mean_confidence(pose: Pose) -> float:
    """The mean over joints, 0 if the network does not predict it."""
    return 0.0 if pose.confidence is None else float(pose.confidence.mean())


def select_pose(answers: list[tuple[Pose, np.ndarray]], box_center: np.ndarray | None) -> tuple[Pose, np.ndarray]:
    """Selects the pose of the intended person among the poses of a crop's candidates, the first of which is the whole
    cloud.

    This is the most confident pose; with a box, the most confident pose of the person nearest to the box center. Other
    people among the candidates raise `second_person` of the selected pose. Without confidence, the first pose is
    selected.
    """
    confidences = [mean_confidence(pose) for pose, _ in answers]
    if len(answers) == 1 or not any(confidences):
        return answers[0]
    middles = np.stack([pose.joints[list(pose.skeleton.middle)].mean(0)[:2] for pose, _ in answers])
    is_confident = np.array(confidences) > _SURE * max(confidences)
    is_eligible = is_confident
    if box_center is not None:
        distances = np.where(is_confident, np.linalg.norm(middles - box_center[:2], axis=1), np.inf)
        is_eligible = is_confident & (np.linalg.norm(middles - middles[distances.argmin()], axis=1) < _SAME)
    best_row = int(np.where(is_eligible, confidences, -1.0).argmax())
    pose, part = answers[best_row]
    if pose.second_person is None or pose.person is None:
        return pose, part
    is_beside = np.linalg.norm(middles - middles[best_row], axis=1) > _SAME
    other_probabilities = [
        other_pose.person
        for (other_pose, _), is_other in zip(answers, is_beside & is_confident, strict=True)
        if is_other
    ]
    return replace(pose, second_person=np.max([pose.second_person, *other_probabilities])), part
