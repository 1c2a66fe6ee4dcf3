"""Facts of a synthesized person."""

import numpy as np
import pytest

from lidarpose.body.pose_prior.activities import KINDS
from lidarpose.data.synthetic_info import person_info
from lidarpose.sample import Pose, Sample
from lidarpose.skeleton import BODY26


def test_clutter_is_what_stands_above_the_ground_and_is_not_the_body():
    z = np.array([-1.6, -1.55, -1.0, -0.5, -1.0, -0.2, -0.7, -1.58], np.float32)
    part = np.array([0, 0, 0, 0, 1, 2, 3, 4], np.uint8)
    points = np.stack([0 * z + 5, 0 * z, z], 1)
    pose = Pose(joints=np.zeros((26, 3)), skeleton=BODY26)
    sample = Sample(points=points, center=np.zeros(3), part=part, pose=pose)
    facts = person_info(sample, sensor="a", kind=KINDS[0], distance=5.0, alone=8, soles=-1.6, tall=1.84)
    assert facts.clutter == 2 / 8 and facts.visible == 4 / 8 and facts.height_seen == pytest.approx(0.75)
