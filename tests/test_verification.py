"""Boxes of people who were found, by their poses, and the points and scores that detections are judged by."""

from types import SimpleNamespace

import numpy as np
import pytest

from lidarpose.inference import verification
from lidarpose.inference.verification import Crops, box_about, inside_column
from lidarpose.models.detector.detector import Detections
from lidarpose.sample import Pose
from lidarpose.skeleton import HUMAN15

# facing +x, left is +y, m
STANDING = {
    "pelvis": (0, 0, 0.95), "neck": (0, 0, 1.45), "head": (0.05, 0, 1.6),
    "hip": (0, 0.1, 0.9), "knee": (0.02, 0.1, 0.5), "ankle": (0, 0.1, 0.08),
    "shoulder": (0, 0.2, 1.4), "elbow": (0, 0.3, 1.15), "wrist": (0.1, 0.32, 0.9),
}  # fmt: skip


def standing(yaw, place):
    """Somebody who faces `yaw` rad at place (3,) m."""
    joints = []
    for name in HUMAN15.joints:
        side, _, part = name.partition("_")
        x, y, z = STANDING[part if part in STANDING else name]
        joints.append((x, -y if side == "right" else y, z))
    c, s = np.cos(yaw), np.sin(yaw)
    return Pose(joints=np.array(joints) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + place, skeleton=HUMAN15)


@pytest.mark.parametrize("yaw", [-3.0, -1.2, 0.0, 0.4, 2.5])
def test_a_box_is_about_a_pose_and_faces_as_it_does(yaw):
    place = np.array([7.0, -3.0, -1.7])
    pose = standing(yaw, place)
    box = box_about(pose, np.inf)
    assert abs(np.angle(np.exp(1j * (box.yaw - yaw)))) < 1e-3
    # from 0.15 m around the joints: (deep, wide, tall)
    np.testing.assert_allclose(box.size, [0.1 + 0.3, 0.64 + 0.3, 1.52 + 0.3], atol=1e-3)
    assert box.contains(pose.joints).all() and box.center[2] == pytest.approx(-1.7 + 0.84 + 0.03, abs=1e-3)
    # beside somebody the box is narrower
    np.testing.assert_allclose(box_about(pose, 0.6).size[:2], box.size[:2] - 0.1, atol=1e-3)


def test_a_column_is_wider_at_the_top_than_at_the_bottom():
    center, size = np.array([5.0, 2.0, 1.0]), np.array([0.8, 0.8, 1.8])
    sides = [[0.59, 0, 0], [0, -0.59, 0], [0.61, 0, 0], [0.5, 0.5, 0]]
    heights = [[0, 0, -0.9 - 0.14], [0, 0, -0.9 - 0.16], [0, 0, 0.9 + 0.24], [0, 0, 0.9 + 0.26]]
    is_inside = inside_column(center + np.array(sides + heights), center, size)
    assert is_inside.tolist() == [True, True, False, False, True, False, True, False]


def detections_at(*places):
    count = len(places)
    sizes, logit = np.full((count, 3), [0.8, 0.8, 1.8]), np.arange(float(count))
    return Detections(
        centers=np.array(places), sizes=sizes, logit=logit, score=logit, mounted=logit, ground=None, has_ground=True
    )


def test_features_are_odds_that_hardly_grow_beyond_six_and_the_number_of_points(monkeypatch):
    """The verifier is asked about the columns with five points or more."""
    places = [(5.0, 0.0, 1.0), (9.0, 0.0, 1.0), (13.0, 0.0, 1.0)]
    clouds = {
        k: np.repeat([place], count, axis=0) for k, (place, count) in enumerate(zip(places, (9, 4, 20), strict=True))
    }
    outputs = {9: [20.0, 0.0], 20: [-2.0, np.log(3)]}

    class Verifier:
        batch = 8

        def run(self, clouds, view):
            return SimpleNamespace(person=np.array([outputs[len(cloud)] for cloud in clouds]))

    monkeypatch.setattr(verification, "_bundled", lambda name: Verifier())
    features, mounted = Crops(detections_at(*places), clouds, None).verdicts()
    np.testing.assert_allclose(features[:, 0], [0, 1, 2])
    np.testing.assert_allclose(features[:, 1], [6 + 0.2, np.nan, -2 - 0.02])
    np.testing.assert_allclose(features[:, 2], np.log([10, 5, 21]))
    np.testing.assert_allclose(mounted, [0.5, np.nan, 0.75])
    # no output of the verifier scores more than is thought possible
    header = {"verification": {"bias": -1.0, "logit": 1.0, "verifier": 0.5, "log_points": 0.1}}
    highest = verification._highest_score(detections_at(*places), header)
    for odds in (-6.5, 0.0, 6.5):
        for log_points in np.log1p([5, 100, 1e5]):
            possible = np.column_stack([np.arange(3.0), np.full(3, odds), np.full(3, log_points)])
            assert (verification.final_score(possible, header) <= highest).all()
