"""From a sample to an `Example`: crop, center, turn, mirror, scale, dropout and clutter points.

All steps except the crop happen in the person's own frame. Legend: n points.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from lidarpose.errors import check_name
from lidarpose.eval.protocols import jittered, released_view
from lidarpose.geometry import axis_angle_to_matrix, rotation_about, rotation_vector
from lidarpose.models.voxelize import view_features
from lidarpose.sample import FEWEST_OF_SECOND, LabeledSample, Pose, Sample, center_of
from lidarpose.skeleton import BODY26, SMPL24
from lidarpose.synth.noise import half_space_keep, jitter, noise_clusters, random_keep

# share of samples that are centered on an estimated pelvis, as in a second pass, instead of like a user's cloud; and
# the standard deviation of that estimate, m
PELVIS_CENTERED, PELVIS_ERROR = 0.5, 0.06
# the same standard deviation for a crop without a person, m
_OBJECT_ERROR = 0.15
# how often the sensor position is withheld from the network
BLIND = 0.3
# a joint is visible if a point of the body's surface is within this distance, m: hips are 12 cm below the surface
VISIBLE_RADIUS = 0.18
# part of a point whose part is unknown
UNKNOWN_PART = -1
# a sample that would have fewer points after the crop is not cropped
LEAST_POINTS = 5
# by what LiDARCap's training script divides points
_NORMALIZED_SCALE = 1.2
# maximum number of clutter points per cluster
_CLUTTER = 60
# the same for synthetic samples, and the range of the standard deviation of their noise, m
_MOST_CLUTTER, _NOISE = 200, (0.005, 0.08)
_PELVIS = BODY26.index("pelvis")
_HIPS = [BODY26.index("left_hip"), BODY26.index("right_hip")]
FLIP_PART = np.array([-1, 0, *(1 + np.array(SMPL24.flip))], np.int16)
_Sample = TypeVar("_Sample", bound=Sample)


@dataclass(frozen=True, kw_only=True)
class Example:
    """One person in their own frame, z up, as a training example.

    points (n, 3) float32 m; part (n,) int: 0 = background, 1 + j = the bone of SMPL-24's joint j, -1 = unknown; joints
    (26, 3) float32 m of body26, NaN if unlabeled; visible (26,) float32: 1 visible, 0 not, NaN unknown; view (5,):
    `voxelize.view_features`; seed: for random draws when the example is collated; person (2,) float32: whether the crop
    shows a person, and a second person, 1, 0 or NaN if unknown; scale: factor by which the augmentation multiplied all
    lengths.
    """

    points: np.ndarray
    part: np.ndarray
    joints: np.ndarray
    visible: np.ndarray
    view: np.ndarray
    seed: int
    person: np.ndarray = field(default_factory=lambda: np.full(2, np.nan, np.float32))
    scale: float = 1.0

    @property
    def frames(self) -> tuple["Example", ...]:
        """The frames, here one; a clip has several."""
        return (self,)

    @property
    def size(self) -> int:
        """Number of occupied 10 cm cells, a proxy for the number of voxels."""
        return _cells(self.points)


@dataclass(frozen=True, kw_only=True)
class ClipExample:
    """T frames of one person, each about its own center; rotations (T, 24, 3) as in `Sample`; clouds: by name (person,
    background, neighbors) the frames' points (n, 3) float32 m about the same centers."""

    frames: tuple[Example, ...]
    rotations: np.ndarray
    clouds: dict[str, tuple[np.ndarray, ...]]

    @property
    def points(self) -> np.ndarray:
        """Points (n, 3) m of all frames."""
        return np.concatenate([frame.points for frame in self.frames])

    @property
    def size(self) -> int:
        return _cells(self.points)


def _cells(points: np.ndarray) -> int:
    # one integer per cell: seven times as fast as unique rows
    x, y, z = np.floor(points * 10).astype(np.int64).T
    return len(np.unique((x << 42) + (y << 21) + z))


@dataclass(frozen=True, kw_only=True)
class Augmentation:
    """Probabilities and magnitudes of the changes of a sample.

    released: crop and center as in the released code, else by a box and by the points; box: probability of a crop by
    the box with a detector's errors (those of the protocol clean), else there is no crop; pelvis_centered: probability
    that the center is an estimated pelvis; cut: probability that part of the cloud is cut off by a plane; turn:
    probability of a turn about z by up to `angle` rad; scale: sizes range from 1 - scale to 1 + scale; flip:
    probability of a mirror, independently along x and along y; jitter: standard deviation of each coordinate, m,
    clipped at four times that; drop: probability that a fifth of the points is dropped; strays: probability of clusters
    of clutter points.
    """

    released: bool = False
    box: float = 0.0
    pelvis_centered: float = PELVIS_CENTERED
    cut: float = 0.0
    turn: float = 0.0
    angle: float = np.pi
    scale: float = 0.0
    flip: float = 0.0
    jitter: float = 0.0
    drop: float = 0.0
    strays: float = 0.0


AUGMENTATIONS = {
    "none": Augmentation(),
    "turn": Augmentation(turn=1.0),
    # the paper names no augmentations; these are of the released fine-tuning, whose HumanM3 box is made from the joints
    "paper": Augmentation(released=True, turn=0.5, scale=0.1, flip=0.3, jitter=0.005, drop=0.5),
    # LiDAR-HMR's for PRN and LPFormer; its shift is omitted: it moves points and center together, so it has no effect
    # on points about the center
    "lidarhmr": Augmentation(pelvis_centered=0.0, turn=1.0, angle=np.pi / 4, scale=0.2),
    "default": Augmentation(box=0.9, cut=0.15, turn=1.0, scale=0.1, flip=0.5, jitter=0.005, drop=0.5, strays=0.15),
}


def augmentation(name: str) -> Augmentation:
    """A named augmentation: one of `AUGMENTATIONS`."""
    check_name("augmentation", name, AUGMENTATIONS)
    return AUGMENTATIONS[name]


def example(sample: Sample, rng: np.random.Generator, *, pelvis_centered: float = PELVIS_CENTERED) -> Example:
    """A training example of a synthetic sample with known pose and parts.

    The center is that of the points, or an estimated pelvis with probability `pelvis_centered`. The sensor, at the
    origin of the sample's frame, is withheld with probability `BLIND`.
    """
    assert sample.pose is not None and sample.part is not None
    center = sample.center
    if rng.random() < pelvis_centered:
        center = sample.pose.joints[_PELVIS] + rng.normal(0, PELVIS_ERROR, 3)
    origin = None if rng.random() < BLIND else np.zeros(3)
    points, joints = sample.points - center, sample.pose.joints - center
    visible = visible_joints(joints, points[sample.part > 0]).astype(np.float32)
    return make_example(rng, points, joints, part=sample.part, visible=visible, view=view_features(center, origin))


def people_in(sample: Sample) -> np.ndarray:
    """`Example.person` of a synthetic sample. A second person with only a few points is labeled unknown."""
    return np.array([1, second_person_label(sample.second_person_points or 0, len(sample.points))], np.float32)


def second_person_label(others: int, count: int) -> float:
    """Whether a crop of `count` points, `others` of them on other people, shows a second person: 0, 1 or NaN."""
    is_clear = not 0 < others < max(FEWEST_OF_SECOND, 0.1 * count)
    return float(others > 0) if is_clear else np.nan


def object_example(sample: Sample, rng: np.random.Generator, *, pelvis_centered: float = PELVIS_CENTERED) -> Example:
    """A training example of a crop without a person: about the points' center, or with probability `pelvis_centered`
    about a point where a pelvis might have been estimated."""
    center = sample.center
    if rng.random() < pelvis_centered:
        center = center + rng.normal(0, _OBJECT_ERROR, 3)
    origin = None if rng.random() < BLIND else np.zeros(3)
    return make_example(
        rng,
        sample.points - center,
        np.full((len(BODY26), 3), np.nan),
        part=np.full(len(sample.points), UNKNOWN_PART),
        visible=np.full(len(BODY26), np.nan, np.float32),
        view=view_features(center, origin),
        person=np.zeros(2, np.float32),
    )


def augmented(sample: LabeledSample, kind: Augmentation, rng: np.random.Generator) -> Example:
    """A training example of a stored sample with the joints of body26. Missing labels stay missing."""
    sample, center = _view(sample, kind, rng)
    origin = np.zeros(3) if sample.sensor_known and rng.random() >= BLIND else None
    view = view_features(center, origin)
    part, visible = part_and_visible(sample)
    points, joints = sample.points - center, sample.joints - center
    yaw = rng.uniform(-kind.angle, kind.angle)
    R = rotation_about("z", yaw if rng.random() < kind.turn else 0.0)
    scale = 1 + kind.scale * rng.uniform(-1, 1)
    R = R * scale
    is_mirrored = rng.random(2) < kind.flip
    R = np.diag([*np.where(is_mirrored, -1.0, 1.0), 1.0]) @ R
    if is_mirrored.sum() == 1:
        flip = list(BODY26.flip)
        joints, visible, part = joints[flip], visible[flip], FLIP_PART[part + 1]
    points, joints, direction = points @ R.T, joints @ R.T, view[:3] @ R.T
    view = np.concatenate([direction / max(float(np.linalg.norm(direction)), 1e-9), view[3:]]).astype(np.float32)
    if rng.random() < kind.drop:
        keep_mask = random_keep(len(points), share=0.2, rng=rng)
        points, part = points[keep_mask], part[keep_mask]
    if kind.jitter:
        points = jitter(points, sigma=kind.jitter, clip=4 * kind.jitter, rng=rng)
    if rng.random() < kind.strays:
        points, part = _with_clutter(points, part, np.zeros(3), _CLUTTER, rng)
    return replace(make_example(rng, points, joints, part=part, visible=visible, view=view), scale=scale)


def clip_example(
    samples: Sequence[Sample],
    rng: np.random.Generator,
    *,
    trans_center: bool = False,
    pelvis_centered: float = PELVIS_CENTERED,
    turn: bool = False,
    normalize: bool = False,
) -> ClipExample:
    """A training example of a clip: frames of one person, with rotations and the joints of body26.

    The centers are those of the points, or with probability `pelvis_centered` estimated pelvises; trans_center: they
    are SMPL's trans, if known; turn: all frames are turned about z by one random angle; normalize: points of people are
    then shifted and scaled, see `LidarcapConfig.normalize_in_training`, and joints are not.
    """
    is_about_pelvis = rng.random() < pelvis_centered
    R = rotation_about("z", rng.uniform(-np.pi, np.pi)) if turn else np.eye(3)
    frames, clouds = [], []
    clip_height = np.concatenate([sample.points[:, 2] for sample in samples]).mean() if normalize else 0.0
    for sample in samples:
        assert sample.pose is not None
        joints, center = sample.pose.joints, sample.center
        if trans_center and sample.translation is not None:
            center = sample.translation
        elif is_about_pelvis:
            center = joints[_PELVIS] + rng.normal(0, PELVIS_ERROR, 3)
        origin, scale = center, 1.0
        if normalize:
            origin, scale = np.append(sample.points[:, :2].mean(0), clip_height), _NORMALIZED_SCALE
        points = (sample.points - origin) @ R.T / scale
        part, visible = np.full(len(points), UNKNOWN_PART), np.full(len(joints), np.nan, np.float32)
        view = view_features(center, None)
        frames.append(make_example(rng, points, (joints - center) @ R.T, part=part, visible=visible, view=view))
        other_clouds = (
            np.zeros((0, 3)) if cloud is None else (cloud - center) @ R.T
            for cloud in (sample.background, sample.neighbors)
        )
        clouds.append((points, *other_clouds))
    rotations = np.stack([np.asarray(sample.rotations) for sample in samples])
    if turn:
        rotations[:, 0] = rotation_vector(R @ axis_angle_to_matrix(rotations[:, 0]))
    return ClipExample(
        frames=tuple(frames),
        rotations=rotations,
        clouds=dict(zip(("person", "background", "neighbors"), zip(*clouds, strict=True), strict=True)),
    )


def make_example(rng: np.random.Generator, points: np.ndarray, joints: np.ndarray, **arrays: Any) -> Example:
    """An `Example` of points (n, 3) and joints (26, 3) m in the person's frame; arrays: its other fields."""
    seed = int(rng.integers(2**31))
    return Example(points=points.astype(np.float32), joints=joints.astype(np.float32), seed=seed, **arrays)


def add_disturbances(sample: _Sample, *, strays: float, noise: float, rng: np.random.Generator) -> _Sample:
    """A corrupted synthetic sample: with probability `strays` clusters of clutter points, which no box has cropped, and
    with probability `noise` Gaussian noise with a standard deviation of 0.5 to 8 cm on every coordinate.

    Paper: the corruptions of its stability study, with random magnitudes. The center is recomputed from the new points,
    except in a crop of two people, where it tells which of them is the sample's.
    """
    points, part = sample.points, sample.part
    assert part is not None
    chance = rng.random(2)
    if chance[0] < strays:
        max_clutter = min(_MOST_CLUTTER, _CLUTTER // 3 + len(points))
        points, part = _with_clutter(points, part, sample.center, max_clutter, rng)
        points = points.astype(np.float32)
    if chance[1] < noise:
        sigma = np.exp(rng.uniform(*np.log(_NOISE)))
        points = jitter(points, sigma=sigma, clip=2 * sigma, rng=rng).astype(np.float32)
    if points is sample.points:
        return sample
    # clutter points have no ring and no time
    return replace(sample, points=points, part=part, ring=None, point_times=None, center=_own_center(sample, points))


def _own_center(sample: Sample, points: np.ndarray) -> np.ndarray:
    """The center (3,) m of points of a sample; in a crop of two people the sample's center, which tells whose it is."""
    return sample.center if "crowded" in sample.conditions else center_of(points)


def _with_clutter(
    points: np.ndarray, part: np.ndarray, center: np.ndarray, max_clutter: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    clutter = noise_clusters(center, most=max_clutter, rng=rng)
    return np.concatenate([points, clutter]), np.concatenate([part, np.zeros(len(clutter), part.dtype)])


def visible_joints(joints: np.ndarray, points: np.ndarray) -> np.ndarray:
    """joints (J, 3) m, points (n, 3) m on the body -> (J,) bool: a point is within `VISIBLE_RADIUS` of the joint."""
    if not len(points):
        return np.zeros(len(joints), bool)
    # about a point of the body: far from the sensor, the squares below would differ by less than float32 resolves
    joints, points = joints - points[0], points - points[0]
    square_distance = (joints**2).sum(1)[:, None] + (points**2).sum(1) - 2 * joints @ points.T
    return square_distance.min(1) < VISIBLE_RADIUS**2


def _view(sample: LabeledSample, kind: Augmentation, rng: np.random.Generator) -> tuple[LabeledSample, np.ndarray]:
    """The cropped sample and its center (3,) m."""
    if kind.released:
        keep_mask, center = released_view(sample.points, sample.joints, sample.centers, sample.box)
        return _cropped(sample, keep_mask), sample.center if center is None else center
    keep_mask = np.ones(len(sample.points), bool)
    if sample.box is not None and rng.random() < kind.box:
        keep_mask &= jittered(sample.box, rng).contains(sample.points)
    if rng.random() < kind.cut:
        keep_mask &= half_space_keep(sample.points, most=0.4, rng=rng)
    sample = _cropped(sample, keep_mask)
    center = _own_center(sample, sample.points)
    # if the pelvis is not labeled, the midpoint of the hips, which a second pass centers on
    pelvis = sample.joints[_PELVIS]
    root = sample.joints[_HIPS].mean(0) if np.isnan(pelvis).any() else pelvis
    if not np.isnan(root).any() and rng.random() < kind.pelvis_centered:
        center = root + rng.normal(0, PELVIS_ERROR, 3)
    return sample, center


def _cropped(sample: LabeledSample, keep_mask: np.ndarray) -> LabeledSample:
    if keep_mask.all() or keep_mask.sum() < LEAST_POINTS:
        return sample
    part, visible = part_and_visible(sample)
    # a joint that lost all its nearby points is no longer visible; points of unknown part count as body
    is_body = part != 0
    was_visible = visible_joints(sample.joints, sample.points[is_body])
    is_lost = was_visible & ~visible_joints(sample.joints, sample.points[keep_mask & is_body])
    visible = np.where(is_lost & (visible == 1), np.float32(0), visible)
    pose = Pose(joints=sample.joints, visible=visible, skeleton=BODY26, frame="sensor")
    return replace(sample, points=sample.points[keep_mask], part=part[keep_mask], pose=pose)


def part_and_visible(sample: LabeledSample) -> tuple[np.ndarray, np.ndarray]:
    """part (n,) and visible (26,), which samples of an `InMemoryDataset` always have."""
    part, visible = sample.part, sample.pose.visible
    assert part is not None and visible is not None
    return part, visible
