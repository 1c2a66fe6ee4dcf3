"""Test-time augmentation: poses predicted under several transforms are averaged.

A transform rotates the person by a multiple of 90 degrees, mirrors it, and shifts the voxel grid. The predictions
differ slightly because points fall into other voxels; their mean is more accurate than each of them.

Legend: B people, J joints.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lidarpose.errors import check_int
from lidarpose.models.voxelize import view_features
from lidarpose.sample import PER_JOINT, PER_PERSON, Pose, known_values

# a prediction is weighted by its mean confidence to this power, so that one of four with a flipped heading is outvoted
_POWER = 8
_QUARTERS = ((1, 0), (0, 1), (-1, 0), (0, -1))


@dataclass(frozen=True)
class TTATransform:
    """A transform of a person: `turns` rotations by 90 degrees about z, then optionally mirroring of y, around a center
    shifted by `shift` (3,) m."""

    turns: int = 0
    mirrored: bool = False
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def R_view_person(self) -> np.ndarray:
        cosine, sine = _QUARTERS[self.turns]
        turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]], float)
        return np.diag([1, -1, 1]) @ turn if self.mirrored else turn


IDENTITY, MIRRORED = TTATransform(), TTATransform(0, True)
# all shifts differ in where they put the edges of fine voxels (6 cm). Rotated transforms come last: networks are
# trained on people of all headings, but only in the sensor's frame
TRANSFORMS = (
    IDENTITY,
    TTATransform(0, True, (0.05, -0.04, 0.03)),
    TTATransform(0, False, (0.03, 0.08, -0.04)),
    TTATransform(0, True, (0.07, -0.02, 0.04)),
    TTATransform(2, True, (-0.05, -0.07, -0.03)),
    TTATransform(1, False, (-0.08, 0.03, 0.05)),
    TTATransform(3, True, (-0.02, 0.05, -0.05)),
    TTATransform(2, False, (0.02, -0.05, 0.02)),
)


def tta_transforms(count: int) -> tuple[TTATransform, ...]:
    """The first `count` transforms, starting with the identity. Raises InputError for zero or too many."""
    return TRANSFORMS[: check_int("tta", count, least=1, most=len(TRANSFORMS))]


def apply(
    transform: TTATransform, clouds: list[np.ndarray], centers: np.ndarray, origin: np.ndarray | None
) -> tuple[list[np.ndarray], np.ndarray]:
    """Transforms clouds (n, 3) m around centers (B, 3). Returns the clouds and their view features (B, 5) from a sensor
    at origin (3,), None if unknown."""
    R, shifted_centers = transform.R_view_person, centers + transform.shift
    view = np.stack([view_features(center, origin) for center in shifted_centers])
    view[:, :3] = view[:, :3] @ R.T
    return [(points - center) @ R.T for points, center in zip(clouds, shifted_centers, strict=True)], view


def invert(poses: Pose, transform: TTATransform) -> Pose:
    """Transforms poses of B people, predicted under the transform, back to the persons' own frames."""
    poses = replace(poses, joints=poses.joints @ transform.R_view_person + transform.shift)
    if not transform.mirrored:
        return poses
    flip = np.array(poses.skeleton.flip)
    values = known_values(poses, "joints", *PER_JOINT)
    return replace(poses, **{name: value[:, flip] for name, value in values.items()})


def average(poses: list[Pose], factors: Sequence[float] | None = None) -> Pose:
    """The mean of several predictions for B people or for one, weighted per person by confidence if the network
    predicts it. factors: by which the weights of each prediction are multiplied."""
    if len(poses) == 1:
        return poses[0]
    names = known_values(poses[0], "joints", *PER_JOINT, *PER_PERSON)
    stacks = {name: np.stack([getattr(pose, name) for pose in poses]).astype(float) for name in names}
    weight = np.ones(stacks["joints"].shape[:-2])
    if "confidence" in stacks:
        weight = stacks["confidence"].mean(-1) ** _POWER
        # equal weights if all confidences are zero
        weight = np.where(weight.sum(0) > 0, weight, 1.0)
    if factors is not None:
        weight = (weight.T * factors).T

    def mean(stack: np.ndarray) -> np.ndarray:
        weights = weight.reshape(weight.shape + (1,) * (stack.ndim - weight.ndim))
        return np.average(stack, 0, np.broadcast_to(weights, stack.shape))

    values: dict[str, Any] = {name: mean(stack) for name, stack in stacks.items()}
    if "in_range" in values:
        # majority vote
        values["in_range"] = values["in_range"] > 0.5
    return replace(poses[0], **values)
