"""Boxes of detected people, from their poses."""

import numpy as np
import pytest

from lidarpose.inference.verification import box_about
from lidarpose.sample import Pose
from lidarpose.skeleton import HUMAN15

# facing +x, left is +y, m
STANDING = {
    "pelvis": (0, 0, 0.95), "neck": (0, 0, 1.45), "head": (0.05, 0, 1.6),
    "hip": (0, 0.1, 0.9), "knee": (0.02, 0.1, 0.5), "ankle": (0, 0.1, 0.08),
    "shoulder": (0, 0.2, 1.4), "elbow": (0, 0.3, 1.15), "wrist": (0.1, 0.32, 0.9),
}  # fmt: skip


def standing(yaw, place):
    """Pose of a standing person with heading `yaw` rad at place (3,) m."""
    joints = []
    for name in HUMAN15.joints:
        side, _, part = name.partition("_")
        x, y, z = STANDING[part if part in STANDING else name]
        joints.append((x, -y if side == "right" else y, z))
    c, s = np.cos(yaw), np.sin(yaw)
    return Pose(joints=np.array(joints) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + place, skeleton=HUMAN15)


@pytest.mark.parametrize("yaw", [-3.0, -1.2, 0.0, 0.4, 2.5])
def test_box_about_encloses_pose_and_has_its_heading(yaw):
    place = np.array([7.0, -3.0, -1.7])
    pose = standing(yaw, place)
    box = box_about(pose, np.inf)
    assert abs(np.angle(np.exp(1j * (box.yaw - yaw)))) < 1e-3
    # 0.15 m of margin around the joints: (depth, width, height)
    np.testing.assert_allclose(box.size, [0.1 + 0.3, 0.64 + 0.3, 1.52 + 0.3], atol=1e-3)
    assert box.contains(pose.joints).all() and box.center[2] == pytest.approx(-1.7 + 0.84 + 0.03, abs=1e-3)
    # the box is narrower next to another person
    np.testing.assert_allclose(box_about(pose, 0.6).size[:2], box.size[:2] - 0.1, atol=1e-3)
