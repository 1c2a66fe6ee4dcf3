"""`Example`: one person as a step of training shows them, and how a sample becomes one."""

from dataclasses import dataclass

import numpy as np

from lidarpose.models.voxelize import view_features
from lidarpose.sample import Sample
from lidarpose.skeleton import BODY26

# half of the people are centered as a user's cloud is, half about a guess of the pelvis, as in a second pass
REFINED, PELVIS_ERROR = 0.5, 0.06
# how often the sensor's place is kept from the network
BLIND = 0.3
# a joint of which the body's surface is seen within this distance is visible, m: hips lie 12 cm deep
SEEN = 0.18
# part of a point of which nothing is known
UNKNOWN_PART = -1


@dataclass(frozen=True, kw_only=True)
class Example:
    """One person in their own frame, z up.

    points (n, 3) float32 m; part (n,) int: 0 = not body, 1 + j = the bone of SMPL-24's joint j, -1 = not known; joints
    (26, 3) float32 m of body26, NaN where there is no label; visible (26,) float32: 1 seen, 0 not, NaN not known;
    view (5,): `plan.view_features`; seed: of what is drawn when the example is collated.
    """

    points: np.ndarray
    part: np.ndarray
    joints: np.ndarray
    visible: np.ndarray
    view: np.ndarray
    seed: int


def example(sample: Sample, rng: np.random.Generator, *, refined: float = REFINED) -> Example:
    """A synthetic person, pose and parts known, about one of two kinds of center, with or without the sensor's place.

    refined: how often about a guess of the pelvis. The sensor stands at the origin of the sample's frame.
    """
    center = sample.center
    if rng.random() < refined:
        center = sample.pose.joints[BODY26.index("pelvis")] + rng.normal(0, PELVIS_ERROR, 3)
    origin = None if rng.random() < BLIND else np.zeros(3)
    points, joints = sample.points - center, sample.pose.joints - center
    return Example(
        points=points.astype(np.float32),
        part=sample.part,
        joints=joints.astype(np.float32),
        visible=seen(joints, points[sample.part > 0]).astype(np.float32),
        view=view_features(center, origin),
        seed=int(rng.integers(2**31)),
    )


def seen(joints: np.ndarray, points: np.ndarray) -> np.ndarray:
    """joints (J, 3) m, points (n, 3) m on the body -> (J,) bool: some point lies within `SEEN` of the joint."""
    if not len(points):
        return np.zeros(len(joints), bool)
    square = (joints**2).sum(1)[:, None] + (points**2).sum(1) - 2 * joints @ points.T
    return square.min(1) < SEEN**2
