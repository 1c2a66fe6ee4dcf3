"""Detection of people in whole scans, mostly with a detector without weights: boxes, frames, odd input, commands."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from fake_detector import FakeDetector

import lidarpose
from lidarpose.cli import main
from lidarpose.errors import InputError
from lidarpose.eval.detector.labeled_scans import heldout_scans
from lidarpose.geometry import UP_AXES, rotation_about, rotation_from_up
from lidarpose.inference import detection, inputs, single_scan, verification
from lidarpose.inference.known_places import KnownPlaces
from lidarpose.inference.result_panels import panels_of
from lidarpose.inference.scan import Scan
from lidarpose.lidar.raycast import scan
from lidarpose.models.detector.candidates import SceneIndex
from lidarpose.models.detector.detector import Detector, rows_that_matter
from lidarpose.recording.predict_recording import FramePredictor
from lidarpose.sample import Box, Pose
from lidarpose.skeleton import BODY26
from lidarpose.synth.bodies import draw_bodies
from lidarpose.synth.detection_scene import detection_scene
from lidarpose.synth.environment.mesh import Mesh, box, quad, union

# feet of three single people and of two close to each other, m
PLACES = np.array([[6.0, 1.0], [-4.0, 5.0], [2.0, -8.0], [5.0, -4.0], [5.0, -3.4]])


@pytest.fixture(scope="module")
def model():
    return lidarpose.load("tiny", tta=1)


@pytest.fixture(autouse=True)
def fake(monkeypatch):
    detector = FakeDetector()
    monkeypatch.setattr(detection, "_detector", lambda: detector)
    return detector


@pytest.fixture(scope="module")
def scene():
    """Points (n, 3) m and joints (5, 26, 3) m of people on flat ground with a wall, seen by an OS1-64."""
    sensor = lidarpose.sensor("os1-64")
    bodies = draw_bodies(None, captured=0.0, count=40, seed=1, block=0, moving=False)
    standing = [i for i, kind in enumerate(bodies.kinds) if kind in ("stand", "idle", "walk")][: len(PLACES)]
    floor = -sensor.height
    feet = np.column_stack([PLACES, np.full(len(PLACES), floor)]).astype(np.float32)
    people = [Mesh(bodies.vertices[i], bodies.faces).moved(at) for i, at in zip(standing, feet, strict=True)]
    wall = box((0.3, 20.0, 4.0)).moved((-9.0, 0.0, floor))
    everything = union([*people, wall, quad(30.0, np.zeros(2)).moved((0.0, 0.0, floor))])
    points = scan(everything.vertices, everything.faces, sensor).points.astype(float)
    return points, bodies.joints[standing] + feet[:, None]


@pytest.fixture
def file(scene, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.save("sweep.npy", scene[0])
    return "sweep.npy"


def alone(points):
    """Which of the points (n, 3) m are not on people."""
    return np.min(np.linalg.norm(points[:, None, :2] - PLACES, axis=2), axis=1) > 1


def found_at(centers, joints):
    """For which of the people (P, 26, 3) one of the centers (D, 3) is within 0.3 m, seen from above."""
    middles = joints[:, :, :2].mean(1)
    return [bool((np.linalg.norm(np.reshape(centers, (-1, 3))[:, :2] - at, axis=1) < 0.3).any()) for at in middles]


def test_detect_finds_all_people(scene):
    points, joints = scene
    boxes = lidarpose.detect(points)
    assert found_at([found.center for found in boxes], joints) == [True] * len(PLACES)
    assert len(boxes) == len(PLACES) and boxes.warnings == ()
    scores = [found.score for found in boxes]
    assert scores == sorted(scores, reverse=True) and all(0.5 <= score <= 1 for score in scores)
    assert [found.id for found in boxes] == list(range(len(boxes)))
    # upright and of plausible size
    for found in boxes:
        assert 1.4 < found.size[2] < 2.4 and (found.size[:2] < 1.6).all()


def test_predict_of_file_equals_predict_with_detected_boxes(model, scene, file):
    poses = lidarpose.predict(file, model=model)
    assert len(poses) == len(PLACES) and found_at(poses.to_numpy()[:, 0], scene[1]) == [True] * len(PLACES)
    assert all(person.score == person.box.score for person in poses)
    assert {"read", "find", "load", "crop", "predict", "per_person"} == set(poses.timing_ms)
    # saved boxes are exact: joints are bitwise equal
    lidarpose.detect(file).save("people.json")
    poses.save("poses.json")
    for boxes in ("people.json", "poses.json", lidarpose.detect(file)):
        again = lidarpose.predict(file, boxes=boxes, model=model)
        np.testing.assert_array_equal(again.to_numpy(), poses.to_numpy())
        assert [person.score for person in again] == [person.score for person in poses]
    in_memory = model.predict(scene[0], find=True)
    np.testing.assert_array_equal(in_memory.to_numpy(), poses.to_numpy())


def test_detect_ignores_duplicated_points(scene, monkeypatch):
    points, _ = scene
    rng = np.random.default_rng(0)
    copies = np.concatenate([points, points[rng.permutation(len(points))[: len(points) // 2]]])
    boxes, again = lidarpose.detect(points), lidarpose.detect(copies)
    for one, other in zip(boxes, again, strict=True):
        np.testing.assert_array_equal(one.center, other.center)
        assert one.score == other.score
    # poses in boxes do not depend on them either
    poses, same = lidarpose.predict(points, boxes=boxes), lidarpose.predict(copies, boxes=boxes)
    np.testing.assert_allclose(same.to_numpy(), poses.to_numpy(), atol=1e-4)
    assert [person.num_points for person in same] == [person.num_points for person in poses]
    # nor does which points a large scan is thinned to
    monkeypatch.setattr(detection, "_MOST_AROUND", len(points) // 2)
    thinned, of_copies = (
        detection.detect_places(detection.Scan(points=cloud, origin=np.zeros(3)), detection.Search()).scan.points
        for cloud in (points, copies)
    )
    np.testing.assert_array_equal(of_copies, thinned)
    # few copies are kept, and an empty scan stays empty
    few = np.concatenate([points, points[:5]])
    assert inputs.distinct(few) is few and len(inputs.distinct(np.zeros((0, 3)))) == 0


def test_detect_options_limit_people(scene):
    points, _ = scene
    boxes = lidarpose.detect(points)
    best = lidarpose.detect(points, max_people=2)
    assert [found.score for found in best] == [found.score for found in boxes[:2]]
    bound = boxes[1].score
    assert len(lidarpose.detect(points, min_score=bound)) == sum(found.score >= bound for found in boxes)
    near = lidarpose.detect(points, max_range=6.7)
    assert near and all(np.hypot(*found.center[:2]) < 7 for found in near)
    everybody = [found.score for found in lidarpose.detect(points, min_score=0)]
    assert everybody[: len(boxes)] == [found.score for found in boxes]


def test_detect_merges_duplicate_detections(scene, fake, monkeypatch):
    """Two people 0.6 m apart remain two."""
    boxes = lidarpose.detect(scene[0])
    detect = FakeDetector.detect

    def twice(self, *args, **more):
        once = detect(self, *args, **more)
        every = {
            name: np.concatenate([value, value]) for name, value in vars(once).items() if isinstance(value, np.ndarray)
        }
        every["centers"][len(once) :] += [0.05, -0.05, 0.02]
        return replace(once, **every)

    monkeypatch.setattr(FakeDetector, "detect", twice)
    assert len(lidarpose.detect(scene[0])) == len(boxes) == len(PLACES)


@pytest.mark.long
@pytest.mark.parametrize("up", ["-y", "x", "0.26,0,0.97"])
def test_detect_with_up_gives_same_people(model, scene, up, tmp_path):
    points, joints = scene
    R_level_input = rotation_from_up(up)
    np.save(tmp_path / "a.npy", points @ R_level_input)
    boxes = lidarpose.detect(points @ R_level_input, up=up)
    assert found_at([R_level_input @ found.center for found in boxes], joints) == [True] * len(PLACES)
    poses = lidarpose.predict(tmp_path / "a.npy", up=up, model=model)
    level = lidarpose.detect(points)
    # rounding may move a point to another voxel
    off = np.abs(poses.to_numpy() @ R_level_input.T - model.predict(points, boxes=level).to_numpy())
    assert off.mean() < 0.01 and off.max() < 0.15
    again = lidarpose.predict(tmp_path / "a.npy", up=up, boxes=boxes, model=model)
    if up in UP_AXES:
        np.testing.assert_array_equal(again.to_numpy(), poses.to_numpy())
    for found, person in zip(boxes, poses, strict=True):
        # in a tilted frame a box is larger, and still contains the person
        own = points if up not in UP_AXES else (points @ R_level_input) @ UP_AXES[up].T
        inside = replace(found, center=UP_AXES[up] @ found.center) if up in UP_AXES else found
        held = inside.contains(own if up in UP_AXES else points @ R_level_input).sum()
        assert held >= person.num_points
    assert poses.picture()


def test_predict_warns_of_tilted_sensor(model, scene):
    points, joints = scene
    tilt = rotation_about("y", np.radians(20.0))
    poses = model.predict(points @ tilt.T, find=True)
    (warning,) = (warning for warning in poses.warnings if "leans by" in warning)
    assert "leans by 20 degrees" in warning or "leans by 19" in warning
    # the suggested up axis is the tilted one
    direction, _, level_advice = warning.partition("--up ")[2].partition(", or, ")
    assert level_advice == "if the ground slopes, give --up z"
    suggested = np.array([float(value) for value in direction.split(",")])
    assert np.linalg.norm(suggested) == pytest.approx(1, abs=2e-3) and suggested @ tilt[:, 2] > np.cos(np.radians(2))
    assert sum(found_at(poses.to_numpy()[:, 0] @ tilt, joints)) >= 4


def test_given_up_axis_is_exact(scene, fake):
    """The ground then slopes, and the sensor is level; a camera's y axis may still be tilted."""
    sloped = scene[0] @ np.array([[1, 0, 0.25], [0, 1, 0], [0, 0, 1]])
    for up in ("z", (0, 0, 1), "0,0,1"):
        assert lidarpose.detect(sloped, up=up).warnings == ()
        np.testing.assert_allclose(fake.calls[-1]["points"].mean(0), sloped.mean(0), atol=0.5)
    for up, points in ((None, sloped), ("-y", sloped @ UP_AXES["-y"])):
        (warning,) = lidarpose.detect(points, up=up).warnings
        assert "the ground leans by 14 degrees" in warning and ("--up z" in warning) == (up is None)
    # in recordings alike
    searches = [FramePredictor(up=up)._search for up in ("z", None, "-y")]
    assert [search.exact_up for search in searches] == [True, False, False]
    assert not FramePredictor()._search.exact_up


def test_tilted_scan_uses_places_of_earlier_frames(scene, monkeypatch):
    """Its boxes are not reused, but people near tracks may have low scores."""
    up, given = "0.342,0,0.94", []
    monkeypatch.setattr(detection, "verified", lambda *of: given.append(of[6]) or verification.verified(*of))
    scan = detection.Scan(points=scene[0] @ rotation_from_up(up), up=up, origin=np.zeros(3))
    search = detection.search_options(None, None, None, None, None, None, None, up=up)
    places = detection.detect_places(scan, search)
    known = KnownPlaces(
        boxes=[Box(center=(5, 0, 0), size=(1, 1, 2))],
        pelvises=np.zeros((1, 3)),
        tracks=np.array([[5.0, 0, 0], [0, 6, 0]]),
        reach=np.ones(2),
        rejected=np.zeros((0, 3)),
    )
    verified_scan = detection.verify_people(places, search, known)
    assert given[0].boxes == [] and len(given[0].pelvises) == 0
    assert len(verified_scan.pelvises) == len(verified_scan.boxes) > 0
    np.testing.assert_allclose(given[0].tracks, known.tracks @ rotation_from_up(up).T)


@pytest.mark.long
@pytest.mark.parametrize("axis", ["z", "-y"])
def test_boxes_of_tilted_scan_store_up_axis(model, scene, tmp_path, axis):
    tilt = rotation_about("y", np.radians(20.0))
    path = tmp_path / "sweep.npy"
    points = scene[0] @ tilt.T @ UP_AXES[axis]
    np.save(path, points)
    up = None if axis == "z" else axis
    searched = lidarpose.predict(path, model=model, up=up)
    boxes = lidarpose.detect(path, up=up)
    assert searched.up == boxes.up and len(boxes.up.split(",")) == 3 and boxes[:2].up == boxes.up
    boxes.save(tmp_path / "sweep.boxes.json")
    searched.save(tmp_path / "sweep.poses.json")
    # the up axis is taken from the boxes
    for given in (boxes, tmp_path / "sweep.boxes.json", tmp_path / "sweep.poses.json"):
        again = lidarpose.predict(path, boxes=given, model=model)
        assert again.up == searched.up
        errors = np.linalg.norm(again.to_numpy() - searched.to_numpy(), axis=-1).mean(1)
        assert len(again) == len(searched) and np.median(errors) < 0.03
    np.testing.assert_array_equal(model.predict(points, boxes=boxes).to_numpy(), again.to_numpy())
    # a given up axis is used, unless it contradicts that of the boxes
    assert lidarpose.predict(path, boxes=boxes, up=axis, model=model).up == axis
    with pytest.raises(InputError, match="the up axis of the boxes is"):
        lidarpose.predict(path, boxes=boxes, up="x", model=model)


def test_picture_of_tilted_scan_shows_facing(model, scene):
    tilt = rotation_about("y", np.radians(20.0)) @ rotation_about("z", 2.5)
    poses = model.predict(scene[0] @ tilt.T, find=True)
    _, above = panels_of(poses)
    assert len(above.boxes) == len(poses) >= 4
    for drawn, person in zip(above.boxes, poses, strict=True):
        # the left hip is left of the arrow
        R_level_input = rotation_from_up(poses.up)
        hips = [R_level_input @ person.joints[person.skeleton.index(f"{side}_hip")] for side in ("left", "right")]
        assert (hips[0] - hips[1])[:2] @ [-np.sin(drawn.yaw), np.cos(drawn.yaw)] > 0
        assert drawn.contains(person.points @ R_level_input.T).all()


@pytest.mark.parametrize("up", ["y", "-y", "x"])
def test_boxes_of_tilted_scan_have_correct_yaw(scene, up):
    level = lidarpose.detect(scene[0])
    tilt = rotation_about("y", np.radians(20.0))
    boxes = lidarpose.detect(scene[0] @ tilt.T @ UP_AXES[up], up=up)
    off = []
    for found in boxes:
        near = min(level, key=lambda other: np.linalg.norm(tilt @ other.center - UP_AXES[up] @ found.center))
        forward = tilt @ [np.cos(near.yaw), np.sin(near.yaw), 0]
        off.append(np.abs((found.yaw - np.arctan2(forward[1], forward[0]) + np.pi) % (2 * np.pi) - np.pi))
    assert len(boxes) >= 4 and np.median(off) < np.radians(25)


@pytest.mark.long
@pytest.mark.parametrize(("factor", "word"), [(1000, "millimeters"), (100, "centimeters"), (0.001, "kilometers")])
def test_detect_warns_of_wrong_units(scene, factor, word):
    (warning,) = lidarpose.detect(scene[0] * factor).warnings
    assert word in warning


def test_detect_does_not_take_tilted_scan_for_wrong_units(scene):
    """Although the scan is tall in the frame of its sensor."""
    x, y = np.meshgrid(np.arange(-45.0, 45, 0.5), np.arange(-15.0, 15, 0.5))
    road = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, -1.5)])
    street = np.concatenate([scene[0], *[road] * 3]) @ rotation_about("y", np.radians(30.0)).T
    (warning,) = lidarpose.detect(street).warnings
    assert "leans by" in warning


def test_predict_does_not_take_scan_in_kilometers_for_crop(model):
    rng = np.random.default_rng(0)
    street = rng.uniform((-200, -200, -2), (200, 200, 1), (6000, 3)) / 1000
    poses = lidarpose.predict(street, model=model)
    assert not len(poses) and "multiply all coordinates by 1000" in poses.warnings[0]
    assert len(lidarpose.predict(street[:5000], model=model)) == 1


def test_detect_does_not_take_single_person_for_kilometers():
    standing = np.random.default_rng(0).normal([8, 0, 0], [0.08, 0.12, 0.4], (500, 3))
    assert not any("kilometers" in warning for warning in lidarpose.detect(standing).warnings)


def test_detect_warns_of_wrong_up_axis(scene):
    # no person is detected with any up axis
    empty = scene[0][alone(scene[0])]
    (warning,) = lidarpose.detect(empty @ UP_AXES["y"]).warnings
    assert "probably not the input's up axis: try --up y" in warning
    (warning,) = lidarpose.detect(empty * [1, -1, -1], sensor_origin="unknown").warnings
    assert "no ground was found" in warning and "up axis" in warning


@pytest.mark.long
@pytest.mark.parametrize("up", ["y", "-y", "x", "-x"])
def test_detect_suggests_up_axis_that_finds_people(scene, file, up):
    near = scene[0][np.abs(scene[0][:, :2]).max(1) < 6]
    for points in (scene[0], near):
        boxes = lidarpose.detect(points @ UP_AXES[up])
        (warning,) = boxes.warnings
        number = len(lidarpose.detect(points @ UP_AXES[up], up=up))
        assert not boxes and number >= 3
        assert warning == f"no people found with up z, but {number} people with up {up}: try --up {up}"
    np.save(file, near @ UP_AXES[up])
    assert lidarpose.predict(file).warnings == (warning,)


def test_detect_suggests_no_up_axis_without_people(scene, fake):
    empty = scene[0][alone(scene[0])]
    # with ground below, it may only be upside down
    assert lidarpose.detect(empty).warnings == () and len(fake.calls) == 2
    # in a room the up axis is ambiguous, so all are tried
    near = empty[np.abs(empty[:, :2]).max(1) < 6]
    assert lidarpose.detect(near).warnings == () and len(fake.calls) >= 6


def test_detect_suggests_no_axis_whose_ground_leans_onto_another(scene, monkeypatch):
    """A search along the wrong axis finds the same people if it takes the sensor for tilted."""
    empty = scene[0][alone(scene[0])]
    near = empty[np.abs(empty[:, :2]).max(1) < 6]
    person = Box(center=np.zeros(3), size=np.ones(3), score=0.9)
    people = {"y": [person] * 3, "-x": [person] * 2}

    def find(scan, search):
        return replace(scan, boxes=people.get(scan.up, []), up="-1,0.01,0.02" if scan.up == "y" else scan.up)

    monkeypatch.setattr(single_scan, "find_people", find)
    (warning,) = lidarpose.detect(near).warnings
    assert warning == "no people found with up z, but 2 people with up -x: try --up -x"


@pytest.mark.parametrize(
    ("given", "direction", "advice"),
    [
        ("z", [0.1, 0.0, 1.0], "the sensor is assumed to be tilted: confirm it with --up 0.1,0,0.995"),
        ("z", [1.0, 0.0, -0.1], "another axis points up: try --up x"),
        ("y", [0.0, 0.6, 0.8], "another axis points up: try it without --up"),
    ],
)
def test_ground_that_leans_onto_another_axis_names_it(scene, monkeypatch, given, direction, advice):
    scan = detection.Scan(points=scene[0], origin=np.zeros(3), up=given)
    up = scan.R_level_input @ direction / np.linalg.norm(direction)
    monkeypatch.setattr(detection, "estimate_up", lambda *_: up)
    warnings = detection.detect_places(scan, detection.Search()).scan.warnings
    assert any("the ground leans by" in warning and advice in warning for warning in warnings)


def test_detect_suggests_opposite_up_axis(scene):
    """Also where the ceiling is taken for the ground, and where a few false people are found."""
    points = scene[0] * [1, -1, -1]
    (*_, warning) = lidarpose.detect(points).warnings
    number = len(lidarpose.detect(points, up="-z"))
    assert number >= 4 and f"but {number} people with up -z: try --up -z" in warning
    places = detection.detect_places(detection.Scan(points=points, origin=np.zeros(3)), detection.Search())
    few = [Box(center=np.zeros(3), size=np.ones(3), score=0.9)]
    hint = single_scan._opposite_up(places, detection.Search(), few)
    assert hint == f"1 found with up z, but {number} people with up -z: try --up -z"
    # a maximum number of people limits the result, not the trial
    (*_, warning) = lidarpose.detect(points, max_people=1).warnings
    assert f"{number} people with up -z: try --up -z" in warning
    # the axis that is suggested may also be positive
    (*_, warning) = lidarpose.detect(scene[0], up="-z").warnings
    assert warning.endswith("people with up z: try --up z")
    # not if as many are found as given
    assert single_scan._opposite_up(places, detection.Search(), few * 6) is None


def test_detect_does_not_suggest_axis_for_single_person(scene, monkeypatch):
    """One person may be false."""
    single = [Box(center=np.zeros(3), size=np.ones(3), score=0.99)]
    near = scene[0][alone(scene[0]) & (np.abs(scene[0][:, :2]).max(1) < 6)]
    places = detection.detect_places(detection.Scan(points=near, origin=np.zeros(3)), detection.Search())
    for boxes, is_sure in ((single, False), (single * 2, True)):
        monkeypatch.setattr(single_scan, "find_people", lambda scan, search, b=boxes: replace(scan, boxes=b))
        hint = single_scan._other_up_axis(places, detection.Search())
        assert (hint is not None) == is_sure


def test_detect_suggests_feet_that_find_people(scene):
    boxes = lidarpose.detect(scene[0] / 0.3048)
    (warning,) = boxes.warnings
    assert not boxes
    assert warning == "no people found in meters, but 5 if the units are feet: multiply all coordinates by 0.3048"


def test_detect_with_feet_scales_sensor_position_and_background(scene):
    at = np.array([20.0, 0, 0])
    static = scene[0][alone(scene[0]) | (np.linalg.norm(scene[0][:, :2] - PLACES[0], axis=1) < 1)]
    (warning,) = lidarpose.detect((scene[0] + at) / 0.3048, sensor_origin=at / 0.3048).warnings
    assert "5 if the units are feet" in warning
    (warning,) = lidarpose.detect(scene[0] / 0.3048, background=static / 0.3048).warnings
    assert "4 if the units are feet" in warning


def test_detect_does_not_suggest_feet_for_low_sensor(scene):
    """A sensor that is 2.5 above the ground is in meters, at any height of the map."""
    low = np.array([0, 0, 2.5 - lidarpose.sensor("os1-64").height / 0.3048])
    for way in (np.zeros(3), np.array([0, 0, 5000.0])):
        assert lidarpose.detect(scene[0] / 0.3048 + way, sensor_origin=low + way).warnings == ()


def test_detect_reports_range_without_sensor(scene):
    (warning,) = lidarpose.detect(scene[0], sensor_origin="unknown", max_range=20).warnings
    assert warning == "the sensor position is unknown, so max_range (--range) is not applied"


def test_detect_warns_of_sensor_far_from_most_points(scene, monkeypatch):
    """The origin of a map, say, with people beyond the range: nothing else is suggested."""
    way = np.stack(np.broadcast_arrays(np.arange(0, 45, 0.1), 0.3, -1.5), 1)
    moved = np.concatenate([scene[0] + [60, 0, 0], way])
    (warning,) = lidarpose.detect(moved).warnings
    assert "of the points are more than 40 m from the sensor, where people are not searched" in warning
    assert lidarpose.detect(moved, sensor_origin=(60, 0, 0)).warnings == ()
    # also where the points beyond the range are dropped before the search
    monkeypatch.setattr(detection, "_MOST_AROUND", len(moved) // 2)
    assert any(line.startswith(warning[:30]) for line in lidarpose.detect(moved).warnings)
    monkeypatch.undo()
    # in feet most points of a street are beyond 40, too
    street = np.concatenate([scene[0], *[scene[0][alone(scene[0])] * [s, s, 1] for s in (2.0, 2.5, 3.0)]])
    (hint,) = lidarpose.detect(street / 0.3048).warnings
    assert "if the units are feet" in hint
    # a smaller range is the user's wish
    assert lidarpose.detect(scene[0], max_range=1.0).warnings == ()


def test_detect_takes_sensor_on_ground_for_another_frame(scene, fake):
    """As of the base of a vehicle, z = 0 on the ground, with a ditch near by."""
    points, joints = scene
    ditch = np.random.default_rng(0).uniform((-10, -10, -1.9), (-7, -7, -1.9), (len(points) // 5, 3))
    moved = np.array([0, 0, 1.45])
    boxes = lidarpose.detect(np.concatenate([points, ditch]) + moved)
    assert any("not above the ground" in line for line in boxes.warnings)
    assert fake.calls[-1]["origin"] is None
    assert sum(found_at([found.center - moved for found in boxes], joints)) >= 4


def test_detect_replaces_implausible_sensor_origin_by_unknown(scene, fake):
    points, joints = scene
    height = np.array([0, 0, 1.8])
    for moved, problem in ((np.array([5e5, 5e6, -3e3]), "nearest point"), (height, "no ground below it")):
        boxes = lidarpose.detect(points + moved)
        assert any(problem in warning and "treated as unknown" in warning for warning in boxes.warnings), problem
        assert fake.calls[-1]["origin"] is None
        assert sum(found_at([found.center - moved for found in boxes], joints)) >= 4
        assert lidarpose.detect(points + moved, sensor_origin=moved).warnings == ()
        np.testing.assert_allclose(fake.calls[-1]["origin"], moved)
    assert lidarpose.detect(points, sensor_origin="unknown").warnings == ()
    assert fake.calls[-1]["origin"] is None
    # a drone at 40 m, and an implausible height
    assert lidarpose.detect(points, sensor_origin=(0, 0, 40)).warnings == ()
    (warning,) = lidarpose.detect(points, sensor_origin=(0, 0, 100)).warnings
    assert "m from the nearest point" in warning and fake.calls[-1]["origin"] is None


def test_detect_of_scans_without_people_is_empty(model):
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(-20, 20, (20_000, 2)), rng.normal(-1.7, 0.01, 20_000)])
    line = np.column_stack([np.linspace(-30, 30, 500), np.zeros((500, 2))])
    for points in (
        np.zeros((0, 3)),
        np.ones((1, 3)),
        np.ones((3, 3)) * 9,
        np.zeros((50, 3)),
        floor,
        line,
        rng.normal(0, 30, (300, 3)),
    ):
        assert lidarpose.detect(points) == []
        assert len(model.predict(points, find=True)) == 0


def test_find_people_thins_large_maps(scene, monkeypatch):
    points, _ = scene
    far = np.random.default_rng(0).uniform((100, 100, -2), (900, 900, 2), (20_000, 3))
    wide = np.concatenate([far, points])
    monkeypatch.setattr(detection, "_CHUNK", 777)
    monkeypatch.setattr(detection, "_MOST_POINTS", len(wide) // 2)
    # evenly, if the sensor is unknown
    unknown = detection.find_people(detection.Scan(points=wide), detection.Search())
    assert abs(len(unknown.points) - len(wide) / 2) < 500 and any("thinned" in line for line in unknown.warnings)
    # around a known sensor, points out of range are dropped first, without a warning
    known = detection.Scan(points=wide, origin=np.zeros(3))
    monkeypatch.setattr(detection, "_MOST_AROUND", len(points))
    searched = detection.find_people(known, detection.Search())
    np.testing.assert_array_equal(searched.points, points[np.linalg.norm(points, axis=1) < 55])
    # then dense regions are thinned, and far people keep all points
    monkeypatch.setattr(detection, "_MOST_AROUND", len(points) // 2)
    searched = detection.find_people(known, detection.Search())
    assert abs(len(searched.points) - len(points) / 2) < 500 and searched.warnings == () and len(searched.boxes) >= 4
    distance, kept = np.linalg.norm(points, axis=1), np.linalg.norm(searched.points, axis=1)
    assert (kept > 15).sum() == ((distance > 15) & (distance < 55)).sum() > 1000
    assert 0 < (kept < 6).sum() < 0.4 * (distance < 6).sum()
    # whatever the order of the points
    order = np.random.default_rng(1).permutation(len(wide))
    (one, _), (other, _) = (
        detection._thinned(detection.Scan(points=cloud, origin=np.zeros(3)), detection.Search())
        for cloud in (wide, wide[order])
    )
    assert set(map(tuple, one.points)) == set(map(tuple, other.points)) and len(one.points) < len(points)
    # also if the range is far larger than the scan
    away = detection._thinned(detection.Scan(points=points, origin=np.zeros(3)), detection.Search(max_range=1e6))
    assert abs(len(away[0].points) - len(points) / 2) < 500 and away[1] == []
    # a sensor far away from all points is not used as the center
    monkeypatch.setattr(detection, "_MOST_POINTS", len(wide))
    away = detection._thinned(detection.Scan(points=points, origin=np.full(3, 1e5)), detection.Search())
    assert len(away[0].points) == len(points) and away[1] == []
    # with a warning if people keep few points
    monkeypatch.setattr(detection, "_MOST_AROUND", 200)
    assert any("thinned" in line for line in detection.find_people(known, detection.Search()).warnings)


def test_detect_searches_whole_map_around_implausible_origin(scene, fake, monkeypatch):
    """With and without thinning; the up axis is checked as for an unknown sensor."""
    points, _ = scene
    moved, bare = np.array([70.0, 0, 1.5]), np.array([-70.0, 0, 1.5])
    empty = points[points[:, 2] < -1.45]
    wide = np.concatenate([points + moved, empty + bare, empty + [0, 0, 1.5]])
    monkeypatch.setattr(detection, "_MOST_POINTS", len(wide) - 1000)
    boxes = lidarpose.detect(wide)
    assert any("no ground below it" in warning for warning in boxes.warnings)
    assert any("thinned" in warning for warning in boxes.warnings) and len(boxes) >= 4
    # a single point at the origin does not make it plausible
    lidarpose.detect(np.concatenate([wide + [5e5, 5e6, 0], np.zeros((1, 3))]))
    assert fake.calls[-1]["origin"] is None and len(fake.calls[-1]["points"]) > 1000
    tilted = points @ rotation_about("y", np.radians(20.0)).T + [5e5, 5e6, 0]
    assert any("leans by" in warning for warning in lidarpose.detect(tilted).warnings)


# ---- the final score


def test_final_score_uses_weights_of_header():
    features = np.array([[2.0, 1.5, 5.0], [np.nan, 0.5, 4.0], [1.0, np.nan, 4.0]])
    header = {"verification": {"bias": 0.5, "logit": 1.5, "verifier": 2.0, "log_points": 0.1}}
    header["verification"]["calibration"] = [[0.0, 10.0], [0.0, 1.0]]
    np.testing.assert_allclose(verification.final_score(features, header), [(0.5 + 3 + 3 + 0.5) / 10, 0, 0])
    # older weights, for other features than those of a verifier, are ignored
    header = {"calibration": [[-10.0, 10.0], [0.0, 1.0]], "verification": {"bias": 9.0, "logit": 1.0, "person": 1.0}}
    np.testing.assert_allclose(verification.final_score(features[:1], header), 0.5 + 1.75 / 20)


def test_final_score_without_calibration_is_network_score(scene, fake, monkeypatch):
    """This is the case in `lidarpose evaluate detector --detector` after an export."""
    features = np.array([[-2.0, -2, 4], [0, 0, 4], [3, 3, 4], [np.nan, 1, 4]])
    scores = verification.final_score(features, {})
    np.testing.assert_allclose(scores, [*(1 / (1 + np.exp(-features[:3, 0]))), 0], atol=1e-4)
    monkeypatch.setattr(fake, "header", {"version": "raw"})
    searched = detection.find_people(detection.Scan(points=scene[0]), detection.Search(min_score=0.0, detector=fake))
    assert len(searched.boxes) >= len(PLACES)


# ---- background


@pytest.mark.long
def test_detect_excludes_background(scene, tmp_path, fake):
    """People keep their points close to the background, and a person in the background is not detected."""
    points, joints = scene
    decoy = points[np.linalg.norm(points[:, :2] - PLACES[0], axis=1) < 0.8]
    rest = points[np.linalg.norm(points[:, :2] - PLACES[0], axis=1) >= 0.8]
    empty = rest[np.min(np.linalg.norm(rest[:, None, :2] - PLACES[None], axis=2), axis=1) > 0.6]
    static = np.concatenate([empty, decoy])
    np.save(tmp_path / "static.npy", static)
    (tmp_path / "recording").mkdir()
    for i in range(4):
        np.save(tmp_path / "recording" / f"{i}.npy", static + np.random.default_rng(i).normal(0, 0.01, static.shape))
    plain = lidarpose.detect(points, min_score=0.0)
    scans = [tmp_path / "recording" / f"{i}.npy" for i in range(4)]
    for given in (static, tmp_path / "static.npy", tmp_path / "recording", scans, [np.load(path) for path in scans]):
        boxes = lidarpose.detect(points, background=given)
        assert found_at([found.center for found in boxes], joints) == [False] + [True] * 4
        assert boxes.warnings == () and len(fake.calls[-1]["points"]) == len(points)
        assert len(lidarpose.detect(points, background=given, min_score=0.0)) < len(plain)
    poses = lidarpose.predict(tmp_path / "recording" / "0.npy", background=tmp_path / "static.npy", model="tiny")
    assert len(poses) == 0
    other = lidarpose.detect(points, background=static + [0, 0, 9.0])
    assert any("from this sensor" in warning for warning in other.warnings) and len(other) == len(PLACES)
    itself = lidarpose.detect(points, background=points)
    assert len(itself) == 0 and "on which 100% of the points lie" in itself.warnings[0]


# ---- errors and commands


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"min_score": 2}, "min_score .--min-score.: expected a probability"),
        ({"min_score": "high"}, "min_score"),
        ({"max_range": 0}, "max_range .--range.: expected meters"),
        ({"max_range": np.nan}, "max_range .--range.: expected meters"),
        ({"max_range": 1e200}, "max_range .--range.: expected meters, more than 0 and at most 1e\\+09, got 1e\\+200"),
        ({"max_range": 10**400}, "max_range .--range.: expected meters"),
        ({"max_people": 0}, "max_people must be a whole number"),
        ({"sensor_origin": "here"}, "sensor origin"),
        ({"up": "w"}, "up: expected"),
        ({"background": []}, "background: expected"),
        ({"background": "nowhere.pcd"}, "nowhere.pcd: no such file"),
    ],
)
def test_detect_rejects_invalid_options(scene, options, words):
    with pytest.raises(InputError, match=words):
        lidarpose.detect(scene[0], **options)
    # also for a file of one person, in which no detection takes place
    if options.keys() & {"min_score", "max_range", "max_people", "background"}:
        with pytest.raises(InputError, match=words):
            lidarpose.predict(np.random.default_rng(0).uniform(0, 1, (50, 3)), **options, model="tiny")


def test_predict_rejects_detection_options_with_boxes_or_crop(model, file, fake, scene):
    for given in ({"boxes": []}, {"crop": True}):
        for option in ({"find": True}, {"min_score": 0.5}, {"max_people": 1}, {"background": file}, {"max_range": 9.0}):
            with pytest.raises(InputError, match="options of the detection: omit them with boxes or a crop"):
                lidarpose.predict(file, **given, **option, model=model)
    with pytest.raises(InputError, match="find is an option of the detection: omit it with boxes"):
        model.predict(scene[0], boxes=[], find=True)
    # a small file is one person unless find or an option of detection is given
    near = scene[0][np.linalg.norm(scene[0][:, :2] - PLACES[0], axis=1) < 1.5]
    np.save("small.npy", near)
    assert lidarpose.predict("small.npy", model=model)[0].box is None and not fake.calls
    # options of detection imply find
    for option in ({"min_score": 0.5}, {"max_range": 9}):
        assert "find" in lidarpose.predict("small.npy", **option, model=model).timing_ms
        with pytest.raises(InputError, match="options of the detection: omit them with find=False"):
            lidarpose.predict("small.npy", **option, find=False, model=model)
    assert lidarpose.predict(file, find=False, model=model)[0].box is None
    assert lidarpose.predict("small.npy", find=True, sensor_origin="unknown", model=model)[0].box is not None


def test_detect_and_predict_commands(file, capsys, fake, tmp_path):
    assert main(["detect", file]) == 0
    assert capsys.readouterr().err.strip() == "5 people found -> sweep.boxes.json"
    document = json.loads((tmp_path / "sweep.boxes.json").read_text())
    assert document["schema"] == "lidarpose.boxes/1" and document["source"] == file
    assert set(document["people"][0]) == {"id", "center", "size", "yaw", "score", "mounted"}
    assert main(["detect", file, "--out", "-", "--max-people", "1", "--range", "20", "--min-score", "0.1"]) == 0
    assert len(json.loads(capsys.readouterr().out)["people"]) == 1
    fast = ["--weights", "tiny", "--tta", "1"]
    assert main(["predict", file, *fast, "--picture"]) == 0
    assert "5 of 5 people" in capsys.readouterr().err
    searched = json.loads((tmp_path / "sweep.poses.json").read_text())["people"]
    assert (tmp_path / "sweep.poses.png").stat().st_size > 50_000
    assert main(["predict", file, *fast, "--boxes", "sweep.boxes.json"]) == 0
    given = json.loads((tmp_path / "sweep.poses.json").read_text())["people"]
    assert given == searched and given[0]["score"] == document["people"][0]["score"]
    np.save("static.npy", np.load(file))
    capsys.readouterr()
    assert main(["predict", file, *fast, "--background", "static.npy", "--picture", "--sensor-origin", "0,0,0.1"]) == 0
    warning, line = capsys.readouterr().err.strip().splitlines()
    assert "no people found off the background" in warning
    # the warning states the cause, so there is no further advice
    assert line == "no people found -> sweep.poses.json and sweep.poses.png"
    assert json.loads((tmp_path / "sweep.poses.json").read_text())["people"] == []
    for wrong, words in (
        (["detect", file, "--out", "boxes.csv"], "a folder or a file .json, got .csv"),
        (["detect", file, "--out", file], "got .npy"),
        (["detect", "none.pcd"], "no such file"),
        (["detect", file, "--min-score", "7"], "probability"),
        (["predict", file, "--boxes", "sweep.boxes.json", "--find"], "find, min_score, max_range"),
    ):
        assert main(wrong) == 2
        error = capsys.readouterr().err
        assert words in error and error.count("\n") == 1


# ---- with the bundled detector

REAL = Path(__file__).parents[2] / "shared" / "data" / "real"


@pytest.fixture
def bundled(monkeypatch):
    monkeypatch.setattr(detection, "_detector", cache(Detector))


def test_bundled_detector_finds_and_poses_people(bundled, scene, file, model):
    points, joints = scene
    poses = lidarpose.predict(file, model=model)
    assert sum(found_at(poses.to_numpy()[:, 0], joints)) >= 4 and len(poses) <= 6
    assert 0 < detection._detector().header["default_score"] < 1
    # only the wall and the ground
    assert len(lidarpose.detect(points[alone(points)])) <= 1


@pytest.mark.skipif(not REAL.is_dir(), reason="needs real sweeps")
@pytest.mark.parametrize("sweep", ["sweep_0.pcd", "sweep_1.bin", "sweep_2.ply"])
def test_bundled_detector_finds_people_in_real_sweeps(bundled, sweep):
    path = REAL / sweep
    points = lidarpose.read_points(path).points
    labels = [box for box in lidarpose.read_boxes(path.with_suffix(".json")) if np.hypot(*box.center[:2]) < 40]
    labels = [box for box in labels if box.contains(points).sum() >= 50]
    boxes = lidarpose.detect(path)
    centers = np.array([box.center[:2] for box in boxes]).reshape(-1, 2)
    found = sum(bool((np.linalg.norm(centers - box.center[:2], axis=1) < 0.5).any()) for box in labels)
    # at most one person is missed, and few detections have no label
    assert found >= len(labels) - 1 and len(boxes) - found <= 5 and boxes.warnings == ()


def test_verified_skips_candidates_below_min_score(monkeypatch):
    scene = detection_scene(5, 5)
    points, origin = scene.points, scene.origin
    detections = Detector(threads=1).detect(points, origin, limit=60)
    header = {"verification": {"bias": -1.0, "logit": 1.0, "verifier": 0.5, "log_points": 0.1}}
    pose, posed_rows = verification._posed, []
    monkeypatch.setattr(verification, "_posed", lambda *of: posed_rows.append(of[-1]) or pose(*of))
    features = verification.verification_features(detections, points, origin)
    scores, logits = verification.final_score(features, header), verification.final_logit(features, header)
    assert features.shape == (len(detections), 3)
    highest = verification._highest_score(detections, header)
    assert (highest >= scores).all() and 2 <= (scores >= 0.6).sum() < (highest >= 0.6).sum() < len(detections)
    people = verification.verified(detections, points, origin, header, 0.6)
    posed, *again = posed_rows
    assert set(posed) == set(np.flatnonzero(scores >= 0.6))
    # only people close to one with a higher score are posed again
    assert all(0 < len(rows) < len(posed) for rows in again) and len(again) <= 1
    # by logits, because several scores are 1
    own = [np.nanargmin(np.abs(logits - logit)) for logit in people.logits]
    np.testing.assert_allclose(people.logits, logits[own])
    np.testing.assert_allclose([box.score for box in people.boxes], scores[own])
    assert len(people.boxes) >= 2 and (np.diff([box.score for box in people.boxes]) <= 0).all()
    # additional people with lower scores do not change the boxes of others
    more = verification.verified(detections, points, origin, header | {"default_score": 0.6}, 0.05).boxes
    assert len(more) > len(people.boxes)
    for own, same in zip(people.boxes, more, strict=False):
        assert (own.score, *own.center, *own.size) == (same.score, *same.center, *same.size)
    # verified detections below a third of the score threshold are rejected
    nobody = detections.centers[(highest >= 0.6) & (scores < 0.2)]
    np.testing.assert_array_equal(people.rejected, nobody)
    # known people are not verified again and their positions are not rejected
    own = [people.pelvises[:1], people.boxes[0].center[None], np.array([0.5])]
    known = KnownPlaces(
        boxes=people.boxes[:1],
        **dict(zip(("pelvises", "tracks", "reach"), own, strict=True)),
        rejected=np.zeros((0, 3)),
    )
    again = verification.verified(detections, points, origin, header, 0.6, known=known)
    # of the person beside the known one, nearly all points are in the known box
    assert sorted(again.verified) == [False] + [True] * (len(people.boxes) - 2) and len(nobody)
    assert {tuple(place) for place in again.rejected} <= {tuple(place) for place in nobody}
    # for max_people=1, the two highest-scoring detections are posed
    posed_rows.clear()
    (alone,) = verification.verified(detections, points, origin, header, 0.6, 1).boxes
    assert sorted(posed_rows[0]) == sorted(np.lexsort((-logits, -np.nan_to_num(scores)))[:2])
    np.testing.assert_array_equal(alone.center, people.boxes[0].center)


def test_verified_counts_max_people_without_repeats(monkeypatch):
    scene = detection_scene(5, 5)
    given = Detector(threads=1).detect(scene.points, scene.origin, limit=60), scene.points, scene.origin, {}, 0.5
    everybody = verification.verified(*given).boxes
    surest = []

    def without_surest(people, *others):
        surest[:] = surest or [people[0][0]]
        return [person for person in people if person[0] != surest[0]]

    monkeypatch.setattr(verification, "_without_repeats", without_surest)
    (only,) = verification.verified(*given, 1).boxes
    np.testing.assert_array_equal(only.center, everybody[1].center)


def test_detector_results_are_independent_of_threads():
    scene = detection_scene(5, 5)
    alone, spread = (Detector(threads=n).detect(scene.points, scene.origin, limit=40) for n in (1, 3))
    for name in ("centers", "sizes", "logit", "score", "mounted"):
        np.testing.assert_allclose(getattr(spread, name), getattr(alone, name), atol=1e-4)
    # no candidates
    assert len(Detector(threads=3).detect(np.zeros((0, 3)), scene.origin)) == 0


@pytest.fixture(scope="module")
def hidden():
    """A scene in which person 6, 0.8 m from another, has no detection, as if the two were merged."""
    scene = heldout_scans().loaders[170]()
    detector = Detector(threads=1)
    detections = detector.detect(scene.points, scene.origin, limit=60)
    distance = np.linalg.norm(detections.centers[:, :2] - scene.boxes[6].center[:2], axis=1)
    rows = np.flatnonzero(distance > 0.45)
    arrays = {name: values[rows] for name, values in vars(detections).items() if isinstance(values, np.ndarray)}
    return scene, detector, replace(detections, **arrays)


def test_verified_detects_person_beside_another(hidden):
    scene, detector, detections = hidden
    rows_asked = []

    def detect_beside(rows, people):
        rows_asked.append((rows, people))
        return detector.detect_beside(scene.points, scene.origin, detections.ground, rows, people)

    def is_detected(people):
        centers = np.array([box.center[:2] for box in people.boxes])
        return np.linalg.norm(centers - scene.boxes[6].center[:2], axis=1).min() < 0.3

    given = detections, scene.points.astype(float), scene.origin, detector.header, 0.8
    alone = verification.verified(*given)
    people = verification.verified(*given, detect_beside=detect_beside)
    ((rows, places),) = rows_asked
    assert is_detected(people) and not is_detected(alone)
    # no other person is lost, and points on detected people are not searched again
    assert {tuple(box.center) for box in alone.boxes} <= {tuple(box.center) for box in people.boxes}
    assert scene.num_points[6] > 100 and len(places) >= len(alone.boxes)
    left = np.isin(np.arange(len(scene.points)), rows)
    assert left[scene.person == 6].mean() > 0.7 and left[scene.person < 0].mean() > 0.99
    assert [box.id for box in people.boxes] == list(range(len(people.boxes)))
    # scores do not depend on min_score: a lower one only adds people
    more = verification.verified(*given[:-1], 0.3, detect_beside=detect_beside)
    assert {tuple(box.center) for box in people.boxes} <= {tuple(box.center) for box in more.boxes}


def test_detect_beside_searches_only_near_given_people(hidden):
    scene, detector, detections = hidden
    people = scene.joints[:3, 0, :2].astype(float)
    rows = np.arange(len(scene.points))
    given = scene.points, scene.origin, detections.ground, rows
    beside = detector.detect_beside(*given, people)
    distance = np.linalg.norm(beside.centers[:, None, :2] - people, axis=-1).min(1)
    assert 0 < len(beside) < len(detections) and distance.max() < 0.85 + 0.6
    # without people, and without moving points
    assert not len(detector.detect_beside(*given, people[:0]))
    assert not len(detector.detect_beside(*given, people, moving=np.zeros(len(rows), bool)))


@pytest.mark.parametrize("is_known", [True, False])
def test_rows_that_matter_give_same_candidates_as_all_points(hidden, is_known):
    scene, _, detections = hidden
    origin = scene.origin if is_known else None
    # the last place is closer to the sensor than the width of a view
    places = np.concatenate([scene.joints[:4, 0].astype(float), scene.origin[None] + [0.9, 0.4, -1.0]])
    places[:, 2] = detections.ground.at(places[:, :2])
    for part in (places, places[:1], places[:0]):
        rows = rows_that_matter(scene.points, origin, part)
        all_of_it, some = (
            SceneIndex(points, detections.ground, origin).candidates(part)
            for points in (scene.points, scene.points[rows])
        )
        for name in ("count", "range_views", "contexts", "sizes"):
            np.testing.assert_array_equal(getattr(all_of_it, name), getattr(some, name), err_msg=name)
        assert len(rows) < len(scene.points) or len(part) > 1


def test_surest_rows_keeps_higher_score_of_close_pelvises():
    pelvises = np.array([[0.0, 0, 0], [0.25, 0, 0], [0.5, 0, 0], [np.nan, 0, 0], [5, 0, 0]])
    none = np.zeros(5)
    assert verification.surest_rows(np.array([0.5, 0.9, 0.4, 1.0, 0.1]), pelvises, none) == [1, 4]
    # a person close only to a removed one stays
    assert verification.surest_rows(np.array([0.9, 0.8, 0.7, 1.0, 0.1]), pelvises, none) == [0, 2, 4]
    # equal scores are ordered by their logits
    ties = np.array([1.0, 2.0, np.nan, 0.0, 0.0])
    assert verification.surest_rows(np.array([0.9, 0.9, 0.9, 0.9, 0.1]), pelvises, ties) == [1, 4]
    assert verification.surest_rows(np.zeros(0), np.zeros((0, 3)), np.zeros(0)) == []


def test_without_repeats_removes_second_box_of_one_person(monkeypatch):
    """Boxes close to one with a higher score are posed again with their own points; their pelvis then decides."""
    pelvises = np.array([[0.0, 0, 0], [0.5, 0, 0], [1.0, 0, 0], [5, 0, 0]])
    own = {0: [9.0, 9, 9], 1: [0.2, 0, 0], 2: [0.45, 0, 0], 3: [9.0, 9, 9]}
    asked = []

    def posed(clouds, centers, origin, rows):
        asked.append(centers[rows, 0].tolist())
        joints = np.repeat([[own[int(cloud[0, 0])]] for cloud in clouds], len(BODY26), axis=1)
        return Pose(joints=joints, skeleton=BODY26)

    monkeypatch.setattr(verification, "_posed", posed)
    points = np.repeat(np.arange(4.0), 3).reshape(4, 3)
    people = [(k, Box(center=pelvises[k], size=np.ones(3)), np.array([k])) for k in range(4)]
    places = SimpleNamespace(pelvises=pelvises)
    kept = verification._without_repeats(people, places, points, None)
    # the third is posed at the place of the second, which was removed
    assert [row for row, _, _ in kept] == [0, 2, 3] and asked == [[0.5, 1.0]]
    assert verification._without_repeats(people[3:], places, points, None) == people[3:] and len(asked) == 1
    assert verification._without_repeats([], places, points, None) == []


def test_detect_accepts_numpy_numbers_as_options(model, scene, fake):
    expected = lidarpose.detect(scene[0], max_range=20.0)
    for options in ({"max_range": np.array(20.0)}, {"max_range": np.float32(20), "up": None}):
        assert [box.score for box in lidarpose.detect(scene[0], **options)] == [box.score for box in expected]
    with pytest.raises(InputError, match="columns must be a whole number of at least 3"):
        lidarpose.detect(scene[0], columns=2)


def test_likely_reasons_for_nobody(monkeypatch):
    """Another axis, also where a scan along the wrong one looks as if in other units; feet only if the units fit."""
    given = SimpleNamespace(points=np.zeros((0, 3)), warnings=("read",))
    places = SimpleNamespace(detections=(), far_warning=None, scan=None, level=None, given=given, moving=None)
    monkeypatch.setattr(single_scan, "_feet", lambda *_: "feet")
    found = []
    for hint in ("axis", None):
        monkeypatch.setattr(single_scan, "_other_up_axis", lambda *_, hint=hint: hint)
        for other, unit in ((None, None), ("y", None), ("y", "mm"), (None, "mm")):
            monkeypatch.setattr(single_scan, "flat_along_another_axis", lambda *_, other=other: other)
            monkeypatch.setattr(single_scan, "scan_unit_warning", lambda *_, unit=unit: unit)
            found.append(single_scan.why_nobody(places, detection.Search(), ("searched",)))
    axis, nothing = ("read", "axis"), ("searched",)
    assert found == [axis, axis, axis, nothing, ("searched", "feet"), nothing, nothing, nothing]


def test_opposite_axis_is_suggested_only_if_it_finds_far_more(monkeypatch):
    person = Box(center=np.zeros(3), size=np.ones(3), score=0.9)
    places = SimpleNamespace(given=Scan(points=np.zeros((0, 3))))
    monkeypatch.setattr(single_scan, "find_people", lambda scan, search: replace(scan, boxes=[person] * 3))
    assert single_scan._opposite_up(places, detection.Search(), [person]) is not None
    assert single_scan._opposite_up(places, detection.Search(), [person] * 2) is None
    # of how many there are, `max_people` shows one
    assert single_scan._opposite_up(places, detection.Search(max_people=1), [person]) is None
