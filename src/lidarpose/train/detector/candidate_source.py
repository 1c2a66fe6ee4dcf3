"""Training data of the detector: candidates of synthesized scans, each scan shown several times.

Making scans is the slowest part, so a scan's candidates are cached for a while and shown `uses` times, each time drawn
anew from its points with another augmentation. Everything is a function of an example's number: a process that does not
have a scan, as after `--resume`, makes it again.

Legend: K candidates, P people of a scan.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from math import pi
from typing import Any, Generic, TypeVar

import numpy as np

from lidarpose.geometry import rotation_between
from lidarpose.models.detector.candidates import Candidates, SceneIndex
from lidarpose.models.detector.detector import BEYOND, MAX_RANGE
from lidarpose.models.detector.ground import estimate_ground, estimate_up, without_ground
from lidarpose.models.detector.proposals import heights_above, propose
from lidarpose.models.detector.render import CandidateAugmentation
from lidarpose.synth.detection_scene import DetectionScene, detection_scene
from lidarpose.synth.scene import RandomStream

# thresholds of a candidate's distance in x and y to a person's center, m. Up to the first, a candidate is a positive;
# up to the second, only the one nearest to the person is. Beyond the second it is a negative; others are ignored
POSITIVE, IGNORED = 0.35, 0.5
# candidates of people with fewer points are ignored: neither positives nor negatives
LEAST_POINTS = 5
# how often a scan's sensor position is unknown from the beginning, and how often it is dropped for a candidate
BLIND, DROP_ORIGIN = 0.08, 0.08
# negatives of a scan that are shown at a time; the objective learns from the hardest of them
NEGATIVES = 64
# scans to validate on
VALIDATION = 30
# `Labels.person` of negatives and of ignored candidates
NOBODY, IGNORE = -1, -2
# margin of boxes around the body on each side, m
_MARGIN = 0.05

SceneT = TypeVar("SceneT")
ExampleT = TypeVar("ExampleT")


@dataclass(frozen=True, kw_only=True)
class Labels:
    """Ground truth of K candidates.

    person (K,) int: index into the scene's boxes, `NOBODY` or `IGNORE`. The rest holds for positives: center (K, 2):
    the person's center, x and y in the view frame about the candidate, m; foot (K,): the person's lowest point above
    the ground at the candidate, m; height (K,) m; mounted (K,) bool. Arrays are float32 unless stated.
    """

    person: np.ndarray
    center: np.ndarray
    foot: np.ndarray
    height: np.ndarray
    mounted: np.ndarray

    def take(self, rows: np.ndarray) -> "Labels":
        return Labels(**{name: value[rows] for name, value in vars(self).items()})


@dataclass(frozen=True, kw_only=True)
class DetectorExample:
    """Candidates of a scan with their labels, and the augmentation applied to them, if any."""

    candidates: Candidates
    labels: Labels
    augmentation: CandidateAugmentation | None = None

    @property
    def size(self) -> int:
        return len(self.candidates)


def labels_of(candidates: Candidates, scene: DetectionScene) -> Labels:
    """Ground truth of the candidates of a scene."""
    count, centers, yaw = len(candidates), candidates.centers, candidates.yaw
    center, foot, height = np.zeros((count, 2), np.float32), np.zeros(count, np.float32), np.zeros(count, np.float32)
    person, mounted = np.full(count, NOBODY), np.zeros(count, bool)
    if count and scene.boxes:
        true_centers = np.stack([box.center for box in scene.boxes])
        half_height = np.array([box.size[2] / 2 for box in scene.boxes]) - _MARGIN
        offset = true_centers[None, :, :2] - centers[:, None, :2]
        distance = np.linalg.norm(offset, axis=-1)
        nearest_box, rows = distance.argmin(1), np.arange(count)
        point_counts = np.bincount(scene.person[scene.person >= 0], minlength=len(scene.boxes))
        min_distance = distance[rows, nearest_box]
        person[min_distance <= IGNORED] = IGNORE
        is_near = (min_distance <= POSITIVE) | ((min_distance <= IGNORED) & (distance.argmin(0)[nearest_box] == rows))
        is_found = is_near & (point_counts[nearest_box] >= LEAST_POINTS)
        person[is_found] = nearest_box[is_found]
        x, y = offset[rows, nearest_box].T
        center[:, 0] = np.cos(yaw) * x + np.sin(yaw) * y
        center[:, 1] = np.cos(yaw) * y - np.sin(yaw) * x
        foot[:] = true_centers[nearest_box, 2] - half_height[nearest_box] - centers[:, 2]
        height[:] = 2 * half_height[nearest_box]
        mounted[:] = scene.mounted[nearest_box]
    return Labels(person=person, center=center, foot=foot, height=height, mounted=mounted)


def draw_augmentation(rng: np.random.Generator, count: int) -> CandidateAugmentation:
    """A random augmentation for each of `count` candidates; in a share `DROP_ORIGIN` the sensor position is dropped and
    the turn is arbitrary instead of small."""
    rows = []
    for _ in range(count):
        is_dropped = rng.random() < DROP_ORIGIN
        row: dict[str, Any] = {
            "turn": rng.uniform(-pi, pi) if is_dropped else rng.normal(0, 0.1),
            "mirror": rng.random() < 0.5,
        }
        row |= {"scale": rng.uniform(0.92, 1.08), "shift": rng.uniform(-0.1, 0.1, 2)}
        row |= {"keep": rng.uniform(0.25, 1.0) if rng.random() < 0.6 else 1.0, "noise": rng.uniform(0, 0.025)}
        rows.append(row | {"drop_origin": is_dropped, "seed": rng.integers(2**63)})
    return CandidateAugmentation(**{name: np.array([row[name] for row in rows]) for name in (rows[0] if rows else ())})


def transform_labels(labels: Labels, augmentation: CandidateAugmentation) -> Labels:
    """The labels of candidates after an augmentation."""
    scale = np.asarray(augmentation.scale, np.float32)
    center = augmentation.apply(labels.center).astype(np.float32)
    return replace(labels, center=center, foot=labels.foot * scale, height=labels.height * scale)


@dataclass(frozen=True, kw_only=True)
class SceneSource(Generic[SceneT, ExampleT]):
    """Shows each scene of `detection_scene` of a seed `uses` times, with `lag` scenes between two uses.

    Scene j is first shown as example uses * j. While no scene is old enough yet, a newer one is shown instead.
    load_scene(seed, number): the training data of a scene; draw_example(scan, rng): draws an example from it.
    """

    seed: int
    uses: int
    lag: int
    load_scene: Callable[[int, int], SceneT]
    draw_example: Callable[[SceneT, np.random.Generator], ExampleT]

    def __getstate__(self) -> dict:
        return {name: value for name, value in vars(self).items() if name != "_kept"}

    @cached_property
    def _kept(self) -> dict[int, SceneT]:
        """The scans cached in this process by their numbers."""
        return {}

    def example(self, index: int) -> ExampleT:
        newest_scene, use = divmod(index, self.uses)
        number = newest_scene - use * self.lag
        scan = self._scan(newest_scene // (use + 1) if number < 0 else number, newest_scene)
        return self.draw_example(scan, np.random.default_rng([self.seed, RandomStream.CANDIDATES, index]))

    def _scan(self, number: int, newest_scene: int) -> SceneT:
        scans = self._kept
        if number not in scans:
            for old_number in [old_number for old_number in scans if old_number < newest_scene - self.uses * self.lag]:
                del scans[old_number]
            scans[number] = self.load_scene(self.seed, number)
        return scans[number]


def draw_candidates(scan: DetectorExample, rng: np.random.Generator) -> DetectorExample:
    """Candidates of a scan: all positives and some negatives."""
    person = scan.labels.person
    negatives = np.flatnonzero(person == NOBODY)
    negatives = rng.choice(negatives, min(NEGATIVES, len(negatives)), replace=False)
    rows = np.concatenate([np.flatnonzero(person >= 0), np.sort(negatives)])
    augmentation = draw_augmentation(rng, len(rows))
    labels = transform_labels(scan.labels.take(rows), augmentation)
    return DetectorExample(candidates=scan.candidates.take(rows), labels=labels, augmentation=augmentation)


def scan_example(seed: int, number: int, *, family: str = "train") -> DetectorExample:
    """All candidates of a scene, found as in any scan: a tilted scene is leveled first."""
    scene, origin = scene_to_search(seed, number, family)
    points = scene.points[_distance(scene.points, scene) < MAX_RANGE + BEYOND]
    ground = estimate_ground(points, origin) or without_ground(points, origin)
    heights = heights_above(points, ground)
    centers = propose(points, ground, heights=heights)
    centers = centers[_distance(centers, scene) < MAX_RANGE]
    candidates = SceneIndex(points, ground, origin, heights=heights).candidates(centers)
    return DetectorExample(candidates=candidates, labels=labels_of(candidates, scene))


def scene_to_search(seed: int, number: int, family: str) -> tuple[DetectionScene, np.ndarray | None]:
    """A scene as the detector receives it, and its sensor position (3,) m, None if unknown."""
    scene = detection_scene(seed, number, family=family)
    rng = np.random.default_rng([seed, RandomStream.CANDIDATES, number, 1])
    is_blind = rng.random() < BLIND
    scene = as_detected(scene, None if is_blind else scene.origin)
    return scene, None if is_blind else scene.origin


def validation_scans(seed: int) -> list[DetectorExample]:
    """All candidates of `VALIDATION` scans of the family "heldout"."""
    return [scan_example(seed, number, family="heldout") for number in range(VALIDATION)]


def as_detected(scene: DetectionScene, origin: np.ndarray | None) -> DetectionScene:
    """The scene as the detector receives it: leveled if it is tilted. origin (3,) m: the sensor, None if unknown."""
    up = estimate_up(scene.points, origin)
    return scene if up is None else leveled(scene, up)


def leveled(scene: DetectionScene, up: np.ndarray) -> DetectionScene:
    """The scene turned so that `up` (3,) points up; boxes keep their margins below and above the turned joints."""
    R_level_scene = rotation_between(up, np.array([0.0, 0.0, 1.0]))
    joints = scene.joints @ R_level_scene.T.astype(np.float32)
    boxes = []
    for box, old_z, new_z in zip(scene.boxes, scene.joints[..., 2], joints[..., 2], strict=True):
        low = new_z.min() - old_z.min() + box.center[2] - box.size[2] / 2
        high = new_z.max() - old_z.max() + box.center[2] + box.size[2] / 2
        center = np.array([*(R_level_scene @ box.center)[:2], (low + high) / 2])
        boxes.append(replace(box, center=center, size=np.array([*box.size[:2], high - low])))
    return replace(
        scene,
        points=(scene.points @ R_level_scene.T).astype(np.float32),
        origin=R_level_scene @ scene.origin,
        boxes=tuple(boxes),
        joints=joints,
        up=R_level_scene @ scene.up,
    )


def _distance(points: np.ndarray, scene: DetectionScene) -> np.ndarray:
    """Horizontal distances (n,) m of points (n, 3) from the sensor of a scene."""
    return np.hypot(points[:, 0] - scene.origin[0], points[:, 1] - scene.origin[1])
