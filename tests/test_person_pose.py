"""One person's result: what its JSON says and where its picture draws."""

import numpy as np

import lidarpose.viz.draw as picture
from lidarpose.geometry import UP_AXES, rotation_from_up
from lidarpose.inference.results import PersonPose
from lidarpose.sample import Box, Pose
from lidarpose.skeleton import SMPL24


def test_json_says_what_the_pose_says():
    rng = np.random.default_rng(0)
    told = {name: rng.random(24) for name in ("confidence", "spread", "visible")}
    pose = Pose(joints=rng.normal(size=(24, 3)), skeleton=SMPL24, in_range=rng.random(24) < 0.5, **told)
    box = Box(center=[1, 2, 3], size=[0.6, 0.7, 1.8], yaw=0.3)
    entry = PersonPose(pose=pose, skeleton=SMPL24, points=np.zeros((7, 3)), box=box).to_dict()
    for name, digits in (("joints", 4), ("confidence", 3), ("spread", 4), ("visible", 3)):
        np.testing.assert_array_equal(entry[name], np.round(getattr(pose, name), digits))
    assert entry["box"] == {"center": [1, 2, 3], "size": [0.6, 0.7, 1.8], "yaw": 0.3}


def test_pictures_stand_upright_whatever_the_axes(monkeypatch):
    drawn = []
    monkeypatch.setattr(picture, "draw_people", lambda panels, path=None, *, title="": drawn.extend(panels) or b"")
    rng = np.random.default_rng(0)
    center = np.array([6.0, 1.0, -0.5])
    points, joints = center + rng.normal(0, 0.2, (60, 3)), center + rng.normal(0, 0.2, (24, 3))
    for up in (*UP_AXES, "0.26,0,0.97"):
        R = rotation_from_up(up)
        pose, box = Pose(joints=joints @ R, skeleton=SMPL24), Box(center=R.T @ center, size=[1, 1, 2])
        PersonPose(pose=pose, skeleton=SMPL24, points=points @ R, box=box, up=up).picture()
        np.testing.assert_allclose(drawn[-1].points, points)
        np.testing.assert_allclose(drawn[-1].pose.joints, joints)
        if up in UP_AXES:
            np.testing.assert_allclose(drawn[-1].box.center, center)
        else:
            # a box of a frame that leans is not upright
            assert drawn[-1].box is None
