"""`read_poses`: saved poses read back."""

from dataclasses import replace

import numpy as np
import pytest

import lidarpose
from lidarpose.errors import InputError
from lidarpose.geometry import rotation_from_up
from lidarpose.inference.result_panels import panels_of
from lidarpose.inference.results import PersonPose, Poses
from lidarpose.sample import Box, Pose
from lidarpose.skeleton import SKELETONS, WAYMO14, Skeleton
from lidarpose.viz.person_view import describe, missing_pose


def test_read_poses_restores_saved_results(tmp_path):
    skeleton = SKELETONS["human15"]
    rng = np.random.default_rng(0)
    pose = Pose(
        joints=rng.normal(size=(15, 3)).round(4),
        skeleton=skeleton,
        confidence=rng.random(15).round(3),
        spread=rng.random(15).round(4),
        visible=rng.random(15).round(3),
        in_range=np.arange(15) > 2,
        person=np.float64(0.5),
        second_person=np.float64(0.25),
    )
    box = Box(center=np.ones(3), size=np.array([1.0, 1, 2]), yaw=0.5, id="a", score=0.75, mounted=True)
    shared = {"skeleton": skeleton, "model": {"weights": "small"}, "up": "y"}
    people = (
        PersonPose(pose=pose, points=np.zeros((7, 3)), id="a", box=box, warnings=("odd",), **shared),
        PersonPose(pose=None, points=np.zeros((2, 3)), id=1, **shared),
    )
    poses = Poses(people=people, source="scan.pcd", warnings=("far",), timing_ms={"read": 1.5}, **shared)
    poses.save(tmp_path / "x.poses.json")
    result = lidarpose.read_poses(tmp_path / "x.poses.json")
    assert result.to_dict() == poses.to_dict() == lidarpose.read_poses(poses.to_dict()).to_dict()
    assert result.skeleton is skeleton and [person.num_points for person in result] == [7, 2]
    assert result["a"].box.score == 0.75 and result["a"].out_of_range == list(skeleton.joints[:3])
    np.testing.assert_array_equal(result.to_numpy(), poses.to_numpy())
    # lines of recordings have velocities
    line = poses.to_dict()
    line["people"][0]["velocity"] = [1.0, 0.5, 0.0]
    np.testing.assert_array_equal(lidarpose.read_poses(line)["a"].velocity, [1.0, 0.5, 0.0])
    # points are not stored, but results without them can be drawn: with their numbers, without invented distances
    assert result.picture() and not len(result[0].points)
    far, near = panels_of(result)[0]
    assert describe(far) == f"7 points · confidence {pose.confidence.mean():.2f}" and not missing_pose(far)
    assert describe(near) == "2 points" and missing_pose(near) == "no pose: under 5 points"
    # of points that are not distinct there is no pose, either
    (same,), _ = panels_of(replace(result, people=(replace(result[1], stored_points=9),)))
    assert describe(same) == "9 points" and missing_pose(same) == "no pose"


def test_read_poses_restores_skeleton_of_user():
    joints = ("pelvis", "neck", "left_hip", "right_hip")
    skeleton = Skeleton(name="stick", joints=joints, parents=(-1, 0, 0, 0), extra_bones=((2, 3),))
    pose = Pose(joints=np.zeros((4, 3)), skeleton=skeleton)
    person = PersonPose(pose=pose, points=np.zeros((9, 3)), skeleton=skeleton)
    result = lidarpose.read_poses(Poses(people=(person,), skeleton=skeleton).to_dict())
    assert result.skeleton == skeleton and result[0].confidence is None and result[0].in_range is None
    # a skeleton with the name and joints of the package's own, but another tree
    other = Skeleton(name="waymo14", joints=WAYMO14.joints, parents=(-1,) + (0,) * 13)
    person = PersonPose(pose=Pose(joints=np.zeros((14, 3)), skeleton=other), points=np.zeros((9, 3)), skeleton=other)
    assert lidarpose.read_poses(Poses(people=(person,), skeleton=other).to_dict()).skeleton == other


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "expected poses, JSON of the schema lidarpose.poses/1, got something else"),
        ("[]", "got a document without it: give a file that lidarpose predict wrote"),
        ('{"schema": "lidarpose.boxes/1", "people": []}', "got the schema lidarpose.boxes/1"),
        ('{"schema": "lidarpose.poses/1"}', "got a damaged document (without 'skeleton')"),
    ],
)
def test_read_poses_rejects_other_files(content, message, tmp_path):
    path = tmp_path / "x.json"
    path.write_text(content)
    with pytest.raises(InputError) as error:
        lidarpose.read_poses(path)
    assert message in str(error.value) and "x.json" in str(error.value) and "\n" not in str(error.value)


def test_read_poses_reports_wrong_values(tmp_path):
    skeleton = SKELETONS["human15"]
    person = PersonPose(
        pose=Pose(joints=np.zeros((15, 3)), skeleton=skeleton), points=np.zeros((9, 3)), skeleton=skeleton
    )
    document = Poses(people=(person,), skeleton=skeleton).to_dict()
    document["people"][0]["joints"] = [[0, 0]]
    with pytest.raises(InputError, match=r"damaged document \(Pose.joints of human15"):
        lidarpose.read_poses(document)
    bones = document["skeleton"] | {"name": "mine", "bones": [[0, 99]]}
    for changes, reason in (
        ({"skeleton": bones}, "index out of range"),
        ({"up": "q"}, "up: expected"),
        ({"up": 7}, "up:"),
    ):
        with pytest.raises(InputError, match=rf"damaged document \(.*{reason}.*write it again"):
            lidarpose.read_poses(document | {"people": []} | changes)
    lines = tmp_path / "drive.poses.jsonl"
    lines.write_text("{}\n{}\n")
    with pytest.raises(InputError, match=r"one document per line: call it with each line"):
        lidarpose.read_poses(lines)


def test_read_poses_names_missing_file(tmp_path):
    with pytest.raises(InputError, match=r"^\S*nope.json: no such file; expected a file of poses"):
        lidarpose.read_poses(tmp_path / "nope.json")


@pytest.mark.parametrize("up", ["z", "y", "-x", "0.1,0,1"])
def test_box_taken_out_of_a_result_keeps_the_up_axis(up):
    rng, R_level_input = np.random.default_rng(0), rotation_from_up(up)
    box = Box(center=np.array([5.0, 1.0, 0.0]) @ R_level_input, size=np.array([1.0, 1.0, 2.0]), yaw=0.3)
    points = (rng.normal(size=(200, 3)) * [0.15, 0.15, 0.4] + [5, 1, 0]) @ R_level_input
    poses = lidarpose.predict(points, boxes=[box], up=up)
    for result in (poses, lidarpose.read_poses(poses.to_dict())):
        assert [person.box.up for person in result] == [None if up == "z" else up]
    again = lidarpose.predict(points, boxes=[person.box for person in poses])
    assert again.up == up
    np.testing.assert_allclose(again.to_numpy(), poses.to_numpy(), atol=1e-5)
