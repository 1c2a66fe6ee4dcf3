"""Pictures of a training run: validation people, true and predicted."""

import numpy as np

from lidarpose.sample import Pose
from lidarpose.skeleton import BODY26, Skeleton
from lidarpose.train.example import Example
from lidarpose.viz.draw import Panel, draw_people


def draw_examples(people: list[Example], joints: np.ndarray, skeleton: Skeleton, title: str) -> bytes:
    """A PNG of people in their own frames with predicted joints (N, 26, 3) m of body26, drawn in `skeleton`."""
    panels = []
    for one, found in zip(people, joints, strict=True):
        error = np.nanmean(np.linalg.norm(found - one.joints, axis=-1)) * 1e3
        panels.append(
            Panel(
                points=one.points,
                pose=_pose(found, skeleton),
                truth=_pose(one.joints, skeleton),
                label=f"{len(one.points)} points, {error:.0f} mm",
            )
        )
    return draw_people(panels, title=title)


def _pose(joints: np.ndarray, skeleton: Skeleton) -> Pose | None:
    """joints (26, 3) of body26, or None where the skeleton's are not all known."""
    own = joints[BODY26.map_to(skeleton)]
    return None if np.isnan(own).any() else Pose(joints=own, skeleton=skeleton)
