"""One person's result: what its JSON says and where its picture draws."""

import numpy as np

import lidarpose.viz.draw as picture
from lidarpose.geometry import UP_AXES
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


def test_a_picture_s_box_is_about_the_person(monkeypatch):
    drawn = []
    monkeypatch.setattr(picture, "draw_people", lambda panels, path=None, *, title="": drawn.extend(panels))
    for up, R in UP_AXES.items():
        middle = np.array([6.0, 1.0, -0.5])
        points = middle + np.random.default_rng(0).normal(0, 0.2, (60, 3))
        box = Box(center=R.T @ middle, size=[1, 1, 2])
        PersonPose(pose=None, skeleton=SMPL24, points=points @ R, box=box, up=up).picture()
        np.testing.assert_allclose(drawn[-1].points, points)
        np.testing.assert_allclose(drawn[-1].box.center, middle)
