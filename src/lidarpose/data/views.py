"""The same person seen from another side: a sample turned about the sensor's axis, or in a mirror. Samples to samples.

Points, pose, parts, center and box move together; nothing of the sample given changes.
"""

from dataclasses import replace

import numpy as np

from lidarpose.geometry import rotation_about
from lidarpose.sample import PER_JOINT, Box, Pose, Sample
from lidarpose.skeleton import SMPL24

# the plane x = 0 or y = 0 is as good as any other: turning the mirror turns the image
MIRROR = np.diag([1.0, -1.0, 1.0])


def turned(sample: Sample, yaw: float) -> Sample:
    """The sample turned about the sensor's z axis by `yaw` rad, counter-clockwise from above."""
    moved = _moved(sample, rotation_about("z", yaw))
    return replace(moved, box=moved.box and replace(moved.box, yaw=moved.box.yaw + yaw))


def mirrored(sample: Sample) -> Sample:
    """The sample in a mirror, y to -y: left joints and parts become right ones and the other way round.

    The released code's table for HumanM3 leaves the ankles where they are; here left and right are told by name.
    """
    moved = _moved(sample, MIRROR)
    pose = moved.pose
    if pose is not None:
        flip = list(pose.skeleton.flip)
        changed = {name: value[..., flip] for name in PER_JOINT if (value := getattr(pose, name)) is not None}
        pose = replace(pose, joints=pose.joints[..., flip, :], **changed)
    part = None if moved.part is None else np.array([0, *(1 + np.array(SMPL24.flip))], moved.part.dtype)[moved.part]
    return replace(moved, pose=pose, part=part, box=moved.box and replace(moved.box, yaw=-moved.box.yaw))


def _moved(sample: Sample, R: np.ndarray) -> Sample:
    """Points, joints and centers under a rotation or reflection R (3, 3) about the sensor; the box's yaw as it was."""
    pose: Pose | None = sample.pose
    box: Box | None = sample.box
    return replace(
        sample,
        points=(sample.points @ R.T).astype(np.float32),
        center=R @ sample.center,
        pose=pose and replace(pose, joints=pose.joints @ R.T),
        box=box and replace(box, center=R @ box.center),
    )
