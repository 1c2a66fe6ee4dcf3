"""People of whole synthesized scans, cropped like detected people, together with nearby people and things.

People of `synth.generator` stand alone or beside one other person; these stand in crowds, at walls, in rooms, among
things.

Legend: P people of a scan, n points.
"""

from dataclasses import dataclass, replace

import numpy as np

from lidarpose.errors import InputError
from lidarpose.eval.protocols import jittered
from lidarpose.geometry import rows_near
from lidarpose.inference.verification import AROUND, box_about, inside_column
from lidarpose.models.voxelize import view_features
from lidarpose.sample import Box, Pose, center_of
from lidarpose.skeleton import BODY26
from lidarpose.train.augment import (
    BLIND,
    PELVIS_CENTERED,
    PELVIS_ERROR,
    UNKNOWN_PART,
    Example,
    make_example,
    second_person_label,
    visible_joints,
)
from lidarpose.train.detector.candidate_source import scene_to_search

# how a person is cropped: by a box about a pose, by the column about a detection, or by a labeled box; probabilities
_CUTS, _CHANCES = ("pose box", "column", "labeled box"), (0.6, 0.15, 0.25)
# errors of boxes about poses: standard deviation of the center along x, y and z, m, and how often it is three times
# that; standard deviation and mean of the logarithm of the edges (below zero: poses with low confidence are narrow)
_CENTER, _FAR, _EDGE, _MEAN_EDGE = np.array([0.06, 0.06, 0.03]), 0.15, 0.15, np.array([-0.12, -0.1, -0.03])
# standard deviation of a detection's center in x and y, m
_DETECTION = 0.12
# augmentation of a person: how often points are dropped, and the minimum share that stays; the largest change of scale;
# the standard deviation of each point, m
_LOSS, _LEAST_KEPT, _SCALE, _NOISE = 0.5, 0.3, 0.08, 0.004
# minimum number of a person's own points, in a scan and in a crop; maximum number of points kept about a person
LEAST_POINTS, _MOST_POINTS = 10, 6000
# number of scans that are tried until one has people, and the distance between their numbers
_TRIES, _STRIDE = 16, 2**24
_PELVIS = BODY26.index("pelvis")
_FLIP = list(BODY26.flip)


@dataclass(frozen=True, kw_only=True, eq=False)
class ScanPeople:
    """The people with at least `LEAST_POINTS` points in a scan, z up.

    clouds: P arrays (n, 3) float32 m, the points about each person; owners: P arrays (n,) int8, 1 for the person's own
    points, 0 for those of things, -1 for those of other people; boxes: labeled ones; joints (P, 26, 3) m; neighbors
    (P,) m: horizontal distance to the nearest other pelvis; origin (3,) m: the sensor, None if unknown.
    """

    clouds: list[np.ndarray]
    owners: list[np.ndarray]
    boxes: list[Box]
    joints: np.ndarray
    neighbors: np.ndarray
    origin: np.ndarray | None


def populated_scan(seed: int, number: int) -> ScanPeople:
    """The people of a scene, or of another scene if it has none. Raises InputError if `_TRIES` scenes have none."""
    for attempt in range(_TRIES):
        people = scan_people(seed, number + attempt * _STRIDE)
        if people.boxes:
            return people
    raise InputError(f"{_TRIES} scenes of seed {seed}, from number {number} on, have no people: change the seed")


def draw_person(scan: ScanPeople, rng: np.random.Generator) -> Example:
    """A random person of a scan, with a random augmentation."""
    return person_example(scan, int(rng.integers(len(scan.boxes))), rng)


def scan_people(seed: int, number: int) -> ScanPeople:
    """The people of scene `number` of `synth.detection_scene`, leveled as for the detector."""
    scene, origin = scene_to_search(seed, number, "train")
    pelvises = scene.joints[:, _PELVIS, :2].astype(float)
    rng = np.random.default_rng([seed, number])
    rows, clouds, owners = [], [], []
    centers = np.array([box.center for box in scene.boxes]).reshape(-1, 3)
    all_near_rows = rows_near(centers, scene.points, AROUND)
    for row, near_rows in enumerate(all_near_rows):
        if len(near_rows) > _MOST_POINTS:
            near_rows = np.sort(rng.permutation(near_rows)[:_MOST_POINTS])
        person = scene.person[near_rows]
        if (person == row).sum() >= LEAST_POINTS:
            rows.append(row)
            clouds.append(scene.points[near_rows])
            owners.append(np.where(person == row, 1, np.where(person >= 0, -1, 0)).astype(np.int8))
    distances = np.linalg.norm(pelvises[rows, None] - pelvises, axis=-1)
    distances[np.arange(len(rows)), rows] = np.inf
    return ScanPeople(
        clouds=clouds,
        owners=owners,
        boxes=[scene.boxes[row] for row in rows],
        joints=scene.joints[rows],
        neighbors=distances.min(1, initial=np.inf),
        origin=origin,
    )


def person_example(scan: ScanPeople, person: int, rng: np.random.Generator) -> Example:
    """A person of a scan as a training example. The center is that of the crop's points, or that of the box if other
    people are in the crop, or a perturbed pelvis."""
    joints = scan.joints[person].astype(float)
    is_inside, box_center = _cut(scan, person, rng)
    points, owner = scan.clouds[person][is_inside].astype(float), scan.owners[person][is_inside]
    if rng.random() < _LOSS:
        is_kept = rng.random(len(points)) < rng.uniform(_LEAST_KEPT, 1)
        if (owner[is_kept] == 1).sum() >= LEAST_POINTS:
            points, owner = points[is_kept], owner[is_kept]
    center = box_center if (owner < 0).any() else center_of(points)
    if rng.random() < PELVIS_CENTERED:
        center = joints[_PELVIS] + rng.normal(0, PELVIS_ERROR, 3)
    view = view_features(center, None if rng.random() < BLIND else scan.origin)
    points, joints = points - center, joints - center
    visible = visible_joints(joints, points[owner == 1]).astype(np.float32)
    part = np.where(owner == 1, UNKNOWN_PART, 0)
    if rng.random() < 0.5:
        mirror = np.array([1, -1, 1])
        points, joints = points * mirror, (joints * mirror)[_FLIP]
        view[1], visible = -view[1], visible[_FLIP]
    scale = rng.uniform(1 - _SCALE, 1 + _SCALE)
    points = scale * points + rng.normal(0, _NOISE, points.shape)
    example = make_example(rng, points, scale * joints, part=part, visible=visible, view=view, scale=scale)
    others = second_person_label(int((owner < 0).sum()), len(owner))
    return replace(example, person=np.array([1, others], np.float32))


def _cut(scan: ScanPeople, person: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Which points about a person are in the crop, (n,) bool, and the crop's center (3,) m, which tells the network
    which person to pose."""
    cloud, owner, box = scan.clouds[person], scan.owners[person], scan.boxes[person]
    cut = rng.choice(_CUTS, p=_CHANCES)
    if cut == "pose box":
        pose_box = box_about(Pose(joints=scan.joints[person].astype(float), skeleton=BODY26), scan.neighbors[person])
        factor = 3.0 if rng.random() < _FAR else 1.0
        cut_box = replace(
            pose_box,
            center=pose_box.center + factor * rng.normal(0, _CENTER),
            size=pose_box.size * np.exp(rng.normal(_MEAN_EDGE, _EDGE)),
        )
        is_inside, center = cut_box.contains(cloud), cut_box.center
    elif cut == "column":
        center = box.center + np.append(rng.normal(0, _DETECTION, 2), 0)
        is_inside = inside_column(cloud, center, box.size)
    else:
        cut_box = jittered(box, rng)
        is_inside, center = cut_box.contains(cloud), cut_box.center
    if (owner[is_inside] == 1).sum() < LEAST_POINTS:
        # the crop holds too few of the person's points
        is_inside, center = (owner == 1) | box.contains(cloud), box.center
    return is_inside, center
