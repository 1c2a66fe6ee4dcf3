"""Results of people: JSON, tables, pictures, ids."""

import io
from dataclasses import replace

import numpy as np
import pandas
import pytest
from matplotlib.axes import Axes

import lidarpose.viz.bird_eye as bird_eye
import lidarpose.viz.draw as picture
from lidarpose.geometry import UP_AXES, rotation_from_up, rotation_of_boxes
from lidarpose.inference.result_panels import panels_of
from lidarpose.inference.results import PersonPose, Poses
from lidarpose.sample import Box, Pose
from lidarpose.skeleton import SMPL24


def test_person_pose_to_dict_matches_pose():
    rng = np.random.default_rng(0)
    told = {name: rng.random(24) for name in ("confidence", "spread", "visible")}
    pose = Pose(joints=rng.normal(size=(24, 3)), skeleton=SMPL24, in_range=rng.random(24) < 0.5, **told)
    box = Box(center=[1, 2, 3], size=[0.6, 0.7, 1.8], yaw=0.3)
    entry = PersonPose(pose=pose, skeleton=SMPL24, points=np.zeros((7, 3)), box=box).to_dict()
    for name, digits in (("joints", 4), ("confidence", 3), ("spread", 4), ("visible", 3)):
        np.testing.assert_array_equal(entry[name], np.round(getattr(pose, name), digits))
    assert entry["box"] == {"center": [1, 2, 3], "size": [0.6, 0.7, 1.8], "yaw": 0.3}
    assert entry["score"] is entry["mounted"] is None


def test_person_pose_has_score_of_its_box():
    box = Box(center=[1, 2, 3], size=[0.6, 0.7, 1.8], score=0.87654, mounted=False)
    pose = Pose(joints=np.zeros((24, 3)), skeleton=SMPL24)
    person = PersonPose(pose=pose, skeleton=SMPL24, points=np.zeros((7, 3)), box=box)
    assert person.score == 0.87654
    assert person.to_dict()["score"] == 0.8765 and person.to_dict()["mounted"] is False
    table = person.to_dataframe()
    assert table.columns[-1] == "mounted" and not table["mounted"].any()
    assert (table["score"] == 0.87654).all()
    assert table["person_probability"].isna().all() and table["second_person"].isna().all()


def test_poses_to_dataframe_has_person_probability():
    pose = Pose(joints=np.zeros((24, 3)), skeleton=SMPL24, person=0.25, second_person=0.75)
    person = PersonPose(pose=pose, skeleton=SMPL24, points=np.zeros((7, 3)))
    table = Poses(people=(person, person), skeleton=SMPL24).to_dataframe()
    assert (table["person_probability"] == 0.25).all() and (table["second_person"] == 0.75).all()
    assert table["person"].tolist() == [0] * 24 + [1] * 24


def test_poses_to_csv_keeps_carriage_returns_of_ids():
    pose = Pose(joints=np.zeros((24, 3)), skeleton=SMPL24)
    people = [PersonPose(pose=pose, skeleton=SMPL24, points=np.zeros((7, 3)), id=id) for id in ("a\rb", "c\n", "d")]
    poses = Poses(people=tuple(people), skeleton=SMPL24)
    table = pandas.read_csv(io.StringIO(poses.to_csv()))
    assert table["id"].tolist() == ["a\rb"] * 24 + ["c\n"] * 24 + ["d"] * 24 and table["score"].isna().all()
    assert '"' not in poses[2:].to_csv()


def test_picture_is_upright_for_any_up_axis(monkeypatch):
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
            # a box in a tilted frame is not upright
            assert drawn[-1].box is None


def test_scan_from_above_keeps_given_boxes():
    """Tilted or not, of people without points or a pose, with their headings and the names of the cards."""
    scan, forward, center = np.zeros((9, 3)), np.array([np.cos(2), np.sin(2), 0]), np.array([6.0, 1.0, -0.5])
    for up in ("z", "-y", "0,0.05,1", "0.1,-1,0.3"):
        R_level_input, R_boxes_input = rotation_from_up(up), rotation_of_boxes(up)
        x, y, _ = R_boxes_input @ R_level_input.T @ forward
        box = Box(center=R_level_input.T @ center, size=[0.8, 0.6, 1.8], yaw=np.arctan2(y, x))
        person = PersonPose(pose=None, skeleton=SMPL24, points=np.zeros((0, 3)), box=box, id=7, up=up)
        (drawn,) = panels_of(Poses(people=(person,), skeleton=SMPL24, up=up, scan=scan))[1].boxes
        np.testing.assert_allclose(drawn.center, center, atol=1e-12)
        assert (drawn.yaw, drawn.id) == (pytest.approx(2), 7)


def test_people_with_long_ids_are_numbered_in_scan():
    pose, box = Pose(joints=np.zeros((24, 3)), skeleton=SMPL24), Box(center=np.zeros(3), size=[1, 1, 2])
    people = [PersonPose(pose=pose, skeleton=SMPL24, points=np.zeros((9, 3)), id=f"walker_{k}", box=box) for k in "ab"]
    poses = Poses(people=tuple(people), skeleton=SMPL24, scan=np.zeros((9, 3)))
    cards, scan = panels_of(poses)
    assert [box.id for box in scan.boxes] == [1, 2] and scan.names == ["1", "2"]
    assert [card.label for card in cards] == ["1: walker_a", "2: walker_b"]
    cards, _ = panels_of(replace(poses, people=(replace(people[0], id=None), replace(people[1], id="2"), people[0])))
    assert [card.label for card in cards] == ["1", "2", "3: walker_a"]
    # short ids are drawn, and a single one, however long; cards alone have the ids
    named = replace(poses, people=tuple(replace(person, id=person.id[-3:]) for person in people))
    for given in (named, replace(poses, people=tuple(people[:1])), replace(poses, scan=None)):
        cards, scan = panels_of(given)
        assert [card.label for card in cards] == [person.id for person in given.people]
        assert scan is None or scan.names == [box.id for box in scan.boxes] == [card.label for card in cards]


@pytest.mark.long
def test_picture_of_scan_has_view_from_above(monkeypatch, tmp_path):
    """With z up for any up axis, with the sensor if its origin is known, and above the people's panels."""
    panels = []
    draw = bird_eye.draw_scans
    monkeypatch.setattr(bird_eye, "draw_scans", lambda given, **more: panels.extend(given) or draw(given, **more))
    rng = np.random.default_rng(0)
    center, origin = np.array([6.0, 1.0, -0.5]), np.array([1.0, 2.0, 3.0])
    scan = rng.uniform((-9, -9, -2), (9, 9, 2), (500, 3))
    points, joints = center + rng.normal(0, 0.2, (60, 3)), center + rng.normal(0, 0.2, (24, 3))
    for up in ("z", "-y", "0.26,0,0.97"):
        R = rotation_from_up(up)
        pose, box = Pose(joints=joints @ R, skeleton=SMPL24), Box(center=R.T @ center, size=[1, 1, 2], score=0.9)
        person = PersonPose(pose=pose, skeleton=SMPL24, points=points @ R, box=box, id=7, up=up)
        poses = Poses(people=(person,), skeleton=SMPL24, up=up, scan=scan @ R, origin=R.T @ origin)
        sheet = poses.picture(tmp_path / "sheet.png")
        assert sheet == (tmp_path / "sheet.png").read_bytes()
        panel = panels.pop()
        np.testing.assert_allclose(panel.points, scan)
        np.testing.assert_allclose(panel.poses.joints, joints[None])
        np.testing.assert_allclose(panel.sensor, origin[:2])
        assert np.abs(panel.boxes[0].center - center).max() < 1e-9
    named = replace(person, box=replace(person.box, id=7))
    few = replace(person, pose=None, points=np.zeros((0, 3)), box=replace(person.box, id=None), id=8)
    written, annotate = [], Axes.annotate
    monkeypatch.setattr(Axes, "annotate", lambda ax, text, *a, **b: written.append(text) or annotate(ax, text, *a, **b))
    replace(poses, people=(named, few), up="z").picture()
    assert panels.pop().label == "2 people, 1 with a pose"
    assert {"7", "8"} <= set(written)
    replace(poses, people=(replace(named, id="0123456789abcdef"),), up="z").picture()
    assert max(map(len, written)) == bird_eye.LONGEST_NAME and panels.pop()
    # without a known sensor position no distance is shown
    unplaced = replace(poses, people=(person,), origin=None)
    assert np.isnan(panels_of(unplaced)[0][0].distance)
    alone = Poses(people=(), skeleton=SMPL24, scan=scan, source="a.pcd").picture()
    assert len(alone) < len(sheet) and panels[-1].sensor is None and panels[-1].label == "no people"


def test_person_pose_html_matches_poses_html(tmp_path):
    person = PersonPose(pose=None, skeleton=SMPL24, points=np.zeros((9, 3)))
    assert person.html(tmp_path / "a.html", title="one") == person.alone().html(title="one")


def test_poses_without_ids_cannot_be_indexed_by_id():
    people = PersonPose(pose=None, skeleton=SMPL24, points=np.zeros((9, 3))).alone()
    with pytest.raises(KeyError, match="ids are not set"):
        people["None"]
