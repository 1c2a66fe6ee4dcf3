"""Test-time augmentation: several looks at one person, and one answer from all of them.

A look turns the person by a quarter, mirrors them, and shifts the grid of voxels. A network's answers differ a little
from look to look, where a point falls into another voxel; their mean is better than any of them.

Legend: B people, J joints.
"""

from dataclasses import dataclass, replace

import numpy as np

from lidarpose.errors import whole
from lidarpose.inference.backend import Estimates
from lidarpose.models.voxelize import view_features
from lidarpose.sample import PER_JOINT
from lidarpose.skeleton import Skeleton

# a look counts by its mean confidence to this power: who is turned round in one of four is outvoted
_POWER = 8
_NAMES = ("joints", *PER_JOINT)
_QUARTERS = ((1, 0), (0, 1), (-1, 0), (0, -1))


@dataclass(frozen=True)
class Look:
    """How a person is shown: turned by so many quarters about z, then mirrored across y, about a center that is shifted
    (3,) m."""

    turns: int = 0
    mirrored: bool = False
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def R_shown_person(self) -> np.ndarray:
        cosine, sine = _QUARTERS[self.turns]
        turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]], float)
        return np.diag([1, -1, 1]) @ turn if self.mirrored else turn


# no two shifts put the edges of fine voxels (6 cm) in the same place
LOOKS = (
    Look(),
    Look(2, True, (0.03, 0.08, -0.04)),
    Look(1, False, (-0.08, 0.03, 0.05)),
    Look(3, True, (0.05, -0.04, 0.03)),
    Look(2, False, (-0.05, -0.07, -0.03)),
    Look(0, True, (0.07, -0.02, 0.04)),
    Look(3, False, (-0.02, 0.05, -0.05)),
    Look(1, True, (0.02, -0.05, 0.02)),
)


def looks_of(count: int) -> tuple[Look, ...]:
    """The first so many looks; the very first shows the person as they are. Raises InputError for none or too many."""
    return LOOKS[: whole("tta", count, least=1, most=len(LOOKS))]


def shown(
    look: Look, clouds: list[np.ndarray], centers: np.ndarray, origin: np.ndarray | None
) -> tuple[list[np.ndarray], np.ndarray]:
    """Clouds (n, 3) m about centers (B, 3) as the look shows them, and their view features (B, 5) from a sensor at
    origin (3,) or None."""
    R, middle = look.R_shown_person, centers + look.shift
    view = np.stack([view_features(center, origin) for center in middle])
    view[:, :3] = view[:, :3] @ R.T
    return [(points - center) @ R.T for points, center in zip(clouds, middle, strict=True)], view


def brought_back(found: Estimates, look: Look, skeleton: Skeleton) -> Estimates:
    """What a network of this skeleton says of people shown so, about their own centers."""
    found = replace(found, joints=found.joints @ look.R_shown_person + look.shift)
    if not look.mirrored:
        return found
    flip = np.array(skeleton.flip)
    values = {name: getattr(found, name) for name in _NAMES}
    return replace(found, **{name: None if value is None else value[:, flip] for name, value in values.items()})


def averaged(found: list[Estimates]) -> Estimates:
    """One answer: the mean of all, each person's looks weighted by their confidence where the network tells it."""
    if len(found) == 1:
        return found[0]
    values = {name: [getattr(one, name) for one in found] for name in _NAMES}
    joints = np.stack(values["joints"])
    weight = np.ones(joints.shape[:2])
    if values["confidence"][0] is not None:
        weight = np.stack(values["confidence"]).mean(-1) ** _POWER
        # of whom no look is sure at all, all looks count the same
        weight = np.where(weight.sum(0) > 0, weight, 1.0)

    def mean(stack: list[np.ndarray] | list[None]) -> np.ndarray | None:
        if stack[0] is None:
            return None
        rows = np.stack(stack).astype(float)
        return np.average(rows, 0, weight.reshape(weight.shape + (1,) * (rows.ndim - 2)) * np.ones_like(rows))

    out = {name: mean(values[name]) for name in _NAMES}
    # out of range where most looks say so
    out["in_range"] = None if out["in_range"] is None else out["in_range"] > 0.5
    return Estimates(**out)
