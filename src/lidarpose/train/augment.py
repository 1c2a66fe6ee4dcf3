"""Stored people shown anew each time: crop, center, turn, mirror, scale, loss and strays.

All happens in the person's own frame but for the crop. Legend: n points.
"""

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from lidarpose.data.dapt_crops import released_view
from lidarpose.errors import check_name
from lidarpose.eval.protocols import jittered
from lidarpose.geometry import rotation_about
from lidarpose.models.voxelize import view_features
from lidarpose.sample import LabeledSample, Sample, center_of
from lidarpose.skeleton import BODY26, SMPL24
from lidarpose.synth.noise import half_space_keep, jitter, noise_clusters, random_keep
from lidarpose.train.example import BLIND, PELVIS_ERROR, REFINED, Example, seen

# a person of fewer points after the crop is shown whole
LEAST_POINTS = 5
# largest number of strays in a blob
_STRAYS = 60
# of a synthetic person's, and steps on their coordinates, m
_MOST_STRAYS, _NOISE = 200, (0.005, 0.08)
_Sample = TypeVar("_Sample", bound=Sample)
_FLIP_PART = np.array([-1, 0, *(1 + np.array(SMPL24.flip))], np.int16)


@dataclass(frozen=True, kw_only=True)
class Augmentation:
    """How often what happens to a person.

    released: crop and center as the released code's, else by a box and by the points; box: probability that a box has a
    detector's errors, those of the protocol clean, else it crops nothing; refined: that the center is a guess of the
    pelvis; cut: probability that part of the cloud is cut off by a plane; turn: of a turn about
    z by any angle; scale: sizes from 1 - scale to 1 + scale; flip: of a mirror, across x and across y on their own;
    jitter: standard deviation of each coordinate, m, cut at four times that; drop: probability that a fifth of the
    points is lost; strays: of blobs of stray points.
    """

    released: bool = False
    box: float = 0.0
    refined: float = REFINED
    cut: float = 0.0
    turn: float = 0.0
    scale: float = 0.0
    flip: float = 0.0
    jitter: float = 0.0
    drop: float = 0.0
    strays: float = 0.0


AUGMENTATIONS = {
    "none": Augmentation(),
    # Paper: none are named; those of the released fine-tuning. Its box of HumanM3 knows the joints
    "paper": Augmentation(released=True, turn=0.5, scale=0.1, flip=0.3, jitter=0.005, drop=0.5),
    "default": Augmentation(box=0.9, cut=0.15, turn=1.0, scale=0.1, flip=0.5, jitter=0.005, drop=0.5, strays=0.15),
}


def augmentation(name: str) -> Augmentation:
    """A named augmentation: none, paper or default."""
    check_name("augmentation", name, AUGMENTATIONS)
    return AUGMENTATIONS[name]


def augmented(person: LabeledSample, kind: Augmentation, rng: np.random.Generator) -> Example:
    """A stored person as a step of training shows them. Labels that are missing stay missing."""
    person, center = _view(person, kind, rng)
    origin = np.zeros(3) if person.sensor_known and rng.random() >= BLIND else None
    view = view_features(center, origin)
    points, joints, part = person.points - center, person.joints - center, person.part
    visible = person.pose.visible
    R = _turn(kind, rng) * (1 + kind.scale * rng.uniform(-1, 1))
    mirrors = rng.random(2) < kind.flip
    R = np.diag([*np.where(mirrors, -1.0, 1.0), 1.0]) @ R
    if mirrors.sum() == 1:
        flip = list(BODY26.flip)
        joints, visible, part = joints[flip], visible[flip], _FLIP_PART[part + 1]
    points, joints = points @ R.T, joints @ R.T
    toward = view[:3] @ R.T
    view = np.concatenate([toward / max(np.linalg.norm(toward), 1e-9), view[3:]]).astype(np.float32)
    if rng.random() < kind.drop:
        kept = random_keep(len(points), share=0.2, rng=rng)
        points, part = points[kept], part[kept]
    if kind.jitter:
        points = jitter(points, sigma=kind.jitter, clip=4 * kind.jitter, rng=rng)
    if rng.random() < kind.strays:
        stray = noise_clusters(np.zeros(3), most=_STRAYS, rng=rng)
        points = np.concatenate([points, stray])
        part = np.concatenate([part, np.zeros(len(stray), part.dtype)])
    return Example(
        points=points.astype(np.float32),
        part=part,
        joints=joints.astype(np.float32),
        visible=visible,
        view=view,
        seed=int(rng.integers(2**31)),
    )


def disturbed(one: _Sample, *, strays: float, noise: float, rng: np.random.Generator) -> _Sample:
    """A synthetic person whose points are worse than a sensor's: with probability `strays` blobs of stray points, which
    no box has cut, and with probability `noise` normal steps of 0.5 to 8 cm on every coordinate.

    Paper: the disturbances of its stability study, of any size. The center is that of what is there now.
    """
    points, part = one.points, one.part
    chance = rng.random(2)
    if chance[0] < strays:
        most = min(_MOST_STRAYS, _STRAYS // 3 + len(points))
        blobs = noise_clusters(one.center, most=most, rng=rng)
        points = np.concatenate([points, blobs.astype(np.float32)])
        part = np.concatenate([part, np.zeros(len(blobs), part.dtype)])
    if chance[1] < noise:
        sigma = np.exp(rng.uniform(*np.log(_NOISE)))
        points = jitter(points, sigma=sigma, clip=2 * sigma, rng=rng).astype(np.float32)
    if points is one.points:
        return one
    # strays come from no ring
    return replace(one, points=points, part=part, ring=None, center=center_of(points))


def _view(person: LabeledSample, kind: Augmentation, rng: np.random.Generator) -> tuple[LabeledSample, np.ndarray]:
    """The person's crop and its center (3,) m."""
    if kind.released:
        kept, center = released_view(person.points, person.joints, person.centers, person.box)
        return _kept(person, kept), person.center if center is None else center
    keep = np.ones(len(person.points), bool)
    if person.box is not None and rng.random() < kind.box:
        keep &= jittered(person.box, rng).contains(person.points)
    if rng.random() < kind.cut:
        keep &= half_space_keep(person.points, most=0.4, rng=rng)
    person = _kept(person, keep)
    center = center_of(person.points)
    root = _root(person.joints)
    if root is not None and rng.random() < kind.refined:
        center = root + rng.normal(0, PELVIS_ERROR, 3)
    return person, center


def _kept(person: LabeledSample, keep: np.ndarray) -> LabeledSample:
    if keep.all() or keep.sum() < LEAST_POINTS:
        return person
    # a joint whose points are all gone is not seen any more
    gone = _near(person, np.ones_like(keep)) & ~_near(person, keep)
    visible = np.where(gone & (person.pose.visible == 1), np.float32(0), person.pose.visible)
    pose = replace(person.pose, visible=visible)
    return replace(person, points=person.points[keep], part=person.part[keep], pose=pose)


def _near(person: LabeledSample, keep: np.ndarray) -> np.ndarray:
    """(26,) bool: some point of the body, or of which nothing is known, lies near the joint; keep (n,): which count."""
    return seen(person.joints, person.points[keep & (person.part != 0)])


def _root(joints: np.ndarray) -> np.ndarray | None:
    """The pelvis, or half way between the hips where it is not labelled; what a second pass centers on."""
    pelvis = joints[BODY26.index("pelvis")]
    hips = joints[[BODY26.index("left_hip"), BODY26.index("right_hip")]].mean(0)
    return next((place for place in (pelvis, hips) if not np.isnan(place).any()), None)


def _turn(kind: Augmentation, rng: np.random.Generator) -> np.ndarray:
    yaw = rng.uniform(-np.pi, np.pi)
    return rotation_about("z", yaw if rng.random() < kind.turn else 0.0)
