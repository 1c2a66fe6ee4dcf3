"""Training data of the verifier: the bundled detector's detections in synthesized scans, both people and false
positives.

Legend: K detections of a scan.
"""

from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np

from lidarpose.geometry import rows_near
from lidarpose.inference.detection import MOST_POSED
from lidarpose.inference.tta import IDENTITY, apply
from lidarpose.inference.verification import AROUND, inside_column
from lidarpose.models.detector.detector import MAX_RANGE, Detector
from lidarpose.sample import MIN_POINTS
from lidarpose.train.detector.candidate_source import IGNORE, NOBODY, scene_to_search

# a detection nearer to a person than the first distance is a detection of that person; one farther than the second from
# all people, with at most this share of its points on people, is a false positive; others are ignored. Distances in m
_OWN, _OTHER, _NOBODYS = 0.35, 0.7, 0.02
_MOST_POINTS = 1024
# augmentation of a crop: minimum share of its points that stay, largest change of scale, and standard deviations of the
# noise of each point and of the shift of the whole crop, m
_KEPT, _SCALE, _NOISE, _SHIFT = 0.6, 0.07, 0.005, 0.05
# scans to validate on
VALIDATION = 60


@dataclass(frozen=True, kw_only=True, eq=False)
class CropExample:
    """The points of detections of a scan.

    clouds: K arrays (n, 3) m about the detection's center; view (K, 5), see `VoxelPyramid`; person (K,) int: the
    person's index in the scene, or `NOBODY`; mounted (K,) bool: the person rides or sits in a wheelchair; num_others
    (K,) int: number of points on other people; seed: for thinning voxels.
    """

    clouds: list[np.ndarray]
    view: np.ndarray
    person: np.ndarray
    mounted: np.ndarray
    num_others: np.ndarray
    seed: int

    @property
    def size(self) -> int:
        return len(self.clouds)


def draw_crops(scan: CropExample, rng: np.random.Generator) -> CropExample:
    """All crops of a scan, with a random augmentation."""
    seed, is_mirrored = int(rng.integers(2**31)), rng.random(scan.size) < 0.5
    mirror = np.where(is_mirrored, -1, 1)
    view = scan.view.copy()
    view[:, 1] *= mirror
    clouds = []
    for cloud, side in zip(scan.clouds, mirror.tolist(), strict=True):
        is_kept = rng.random(len(cloud)) < rng.uniform(_KEPT, 1)
        points = cloud[is_kept] if is_kept.sum() >= MIN_POINTS else cloud
        points = points * ([1, side, 1] * rng.uniform(1 - _SCALE, 1 + _SCALE, 1))
        clouds.append(points + rng.normal(0, _NOISE, points.shape) + rng.normal(0, _SHIFT, 3))
    return replace(scan, clouds=clouds, view=view, seed=seed)


@cache
def _detector() -> Detector:
    return Detector(threads=1)


def scan_crops(seed: int, number: int, *, family: str = "train") -> CropExample:
    """The crops of a scene's detections as the verifier receives them, of people and of false positives."""
    scene, origin = scene_to_search(seed, number, family)
    detections = _detector().detect(scene.points, origin, max_range=MAX_RANGE, limit=MOST_POSED)
    counts = np.bincount(scene.person[scene.person >= 0], minlength=len(scene.boxes))
    visible_people = np.flatnonzero(counts >= MIN_POINTS)
    centers = np.array([scene.boxes[row].center[:2] for row in visible_people]).reshape(-1, 2)
    rng = np.random.default_rng([seed, number])
    clouds, kept_centers, person, num_others = [], [], [], []
    near_rows = rows_near(detections.centers, scene.points, AROUND)
    for center, size, near in zip(detections.centers, detections.sizes, near_rows, strict=True):
        rows = near[inside_column(scene.points[near], center, size)]
        if len(rows) < MIN_POINTS:
            continue
        label = _label(np.hypot(*(centers - center[:2]).T), visible_people, scene.person[rows])
        if label == IGNORE:
            continue
        if len(rows) > _MOST_POINTS:
            rows = rng.permutation(rows)[:_MOST_POINTS]
        owner = scene.person[rows]
        num_others.append(int(((owner >= 0) & (owner != label)).sum()))
        clouds.append(scene.points[rows])
        kept_centers.append(center)
        person.append(label)
    view = np.zeros((0, 5), np.float32)
    if clouds:
        clouds, view = apply(IDENTITY, clouds, np.array(kept_centers), origin)
    labels = np.array(person, int)
    return CropExample(
        clouds=[cloud.astype(np.float32) for cloud in clouds],
        view=view,
        person=labels,
        mounted=np.append(scene.mounted, False)[labels],
        num_others=np.array(num_others, int),
        seed=number,
    )


def _label(distances: np.ndarray, visible_people: np.ndarray, owner: np.ndarray) -> int:
    """The person's index, `NOBODY` or `IGNORE`. distances (P,) m of a detection from people; owner (n,): the person
    that each of its points is on, -1 for none."""
    if distances.min(initial=np.inf) < _OWN:
        return int(visible_people[distances.argmin()])
    is_nobody = distances.min(initial=np.inf) > _OTHER and (owner >= 0).mean() <= _NOBODYS
    return NOBODY if is_nobody else IGNORE


def validation_crops(seed: int) -> list[CropExample]:
    """The crops of `VALIDATION` scans of the family "heldout"."""
    return list(map(partial(scan_crops, seed, family="heldout"), range(VALIDATION)))
