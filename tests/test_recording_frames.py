"""Recordings of moving sensors, with irregular times or another up axis; columns of the result tables."""

import json
from itertools import pairwise

import numpy as np
import pandas
import pytest
from walking_people import FRAMES, boxes_of, moving_source, places_in_world, walking_clouds, world_pose

import lidarpose
from lidarpose.body.rig import mean_adult_joints
from lidarpose.cli import main
from lidarpose.geometry import UP_AXES, inverse_transform, rigid_transform, rotation_about
from lidarpose.inference.known_places import KnownPlaces
from lidarpose.inference.predictor import Predictor
from lidarpose.inference.results import PersonPose, Poses
from lidarpose.inference.scan import Scan
from lidarpose.io.sources.frame import Frame
from lidarpose.recording import output, result_files
from lidarpose.recording.coordinates import FixedFrame
from lidarpose.recording.known_people import KnownPeople
from lidarpose.recording.predict_recording import FramePredictor
from lidarpose.recording.steady_tracks import smoothed_lines
from lidarpose.sample import Box, Pose
from lidarpose.skeleton import SMPL24


@pytest.fixture(scope="module")
def model():
    return lidarpose.load("tiny", tta=1)


@pytest.fixture(autouse=True)
def one_model(model, monkeypatch):
    """The same loaded network for every command."""
    monkeypatch.setattr("lidarpose.inference.predictor.load", lambda *_, **__: model)


def written(source, path, model, *, world=False, **options):
    """The lines that `write_recording` writes for people in given boxes."""
    predictor = FramePredictor(model=model, **options)
    output.write_recording(source, predictor, path, command={}, world=world)
    return [json.loads(line) for line in open(path)]


def assert_where_people_are(lines, tolerance=0.25):
    """Both people are at their true positions in lines in the world frame."""
    assert len(lines) == FRAMES
    for k, line in enumerate(lines):
        assert line["coordinates"] == "world"
        places = [np.mean(person["joints"], 0)[:2] for person in line["people"]]
        offsets = np.linalg.norm(np.array(places)[:, None] - places_in_world(k), axis=-1)
        assert offsets.shape == (2, 2) and offsets.min(1).max() < tolerance and set(offsets.argmin(1)) == {0, 1}


# ---- moving sensors


@pytest.mark.parametrize("options", [{}, {"track": True}, {"live": True}], ids=["frames", "smoothed", "live"])
def test_moving_sensor_poses_are_in_world_frame(options, model, tmp_path):
    source = moving_source(walking_clouds())
    lines = written(source, tmp_path / "a.jsonl", model, world=True, boxes=boxes_of(FRAMES), **options)
    assert_where_people_are(lines)
    centers = [[person["box"]["center"][:2] for person in line["people"]] for line in lines]
    for k, frame_centers in enumerate(centers):
        offsets = np.linalg.norm(np.array(frame_centers)[:, None] - places_in_world(k), axis=-1)
        assert offsets.min(1).max() < 0.01
    if options:
        # tracked poses move smoothly from frame to frame
        tracks = [{person["track"]: np.mean(person["joints"], 0) for person in line["people"]} for line in lines]
        steps = np.array([[now[id] - before[id] for id in (0, 1)] for before, now in pairwise(tracks)])
        assert np.linalg.norm(steps, axis=-1).max() < 0.2


def test_world_option_prints_lines_in_world_frame(monkeypatch, tmp_path, capsys):
    clouds = walking_clouds()
    monkeypatch.setattr("lidarpose.io.sources.open_source", lambda *_, **__: moving_source(clouds))
    boxes = [
        {"frame": k, "people": [{"center": box.center.tolist(), "size": box.size.tolist()} for box in boxes]}
        for k, boxes in boxes_of(FRAMES).items()
    ]
    (tmp_path / "boxes.json").write_text(json.dumps(boxes))
    words = ["predict", str(tmp_path), "--boxes", str(tmp_path / "boxes.json"), "--out", "-", "-q"]
    assert main([*words, "--world"]) == 0
    assert_where_people_are([json.loads(line) for line in capsys.readouterr().out.splitlines()])
    assert main(words) == 0
    assert all("coordinates" not in json.loads(line) for line in capsys.readouterr().out.splitlines())


def test_frame_of_few_points_does_not_make_a_recording_one_of_crops(model):
    """The first turn of a sensor may be cut short."""
    rng = np.random.default_rng(0)
    few, enough, none = rng.random((30, 3)), rng.random((300, 3)), np.zeros((0, 3))
    ground = rng.uniform((-20, -20, -1.8), (20, 20, -1.7), (2000, 3))
    stray = np.concatenate([few, [[0.5, 9.0, 0.5]]])

    def frames_of(clouds):
        return [Frame(index=k, id=str(k), points=points) for k, points in enumerate(clouds)]

    def people(clouds, predictor=None):
        predictor = predictor or FramePredictor(model=model)
        return [len(frame.poses) for frame in predictor.predict_all(iter(frames_of(clouds)))]

    assert people([few, ground]) == [1, 0]
    # a crop with enough points decides, and crops may be small, empty or have a stray point
    assert people([enough, ground]) == [1, 1]
    assert people([few, stray, few, none]) == [1, 1, 1, 1]
    # resumed runs go on in the same way
    for later in (ground, stray, none):
        begun, resumed = FramePredictor(model=model), FramePredictor(model=model)
        (one,) = people([few], begun)
        resumed.restore(json.loads(json.dumps(begun.state())))
        assert [one, *people([later], resumed)] == people([few, later])


def test_fixed_frame_reuses_last_pose_if_missing():
    T = world_pose(3)
    fixed = FixedFrame("z")
    np.testing.assert_array_equal(fixed.from_sensor(T.tolist()), T)
    np.testing.assert_array_equal(fixed.from_sensor(None), T)
    # frames before the first pose: the frame does not jump when it comes
    late = FixedFrame("z")
    np.testing.assert_array_equal(late.from_sensor(None), np.eye(4))
    np.testing.assert_allclose(late.from_sensor(T.tolist()), np.eye(4), atol=1e-9)
    again = FixedFrame("z")
    again.restore(json.loads(json.dumps(late.state())))
    step = inverse_transform(T) @ world_pose(5)
    for frame in (late, again):
        np.testing.assert_allclose(frame.from_sensor(world_pose(5)), step, atol=1e-9)
    # without any pose, only the up axis is rotated to z
    y_up = FixedFrame("y").from_sensor(None)
    np.testing.assert_allclose(y_up[:3, :3] @ [0, 1, 0], [0, 0, 1], atol=1e-12)


# ---- another axis up


@pytest.mark.long
@pytest.mark.parametrize("live", [False, True])
def test_tracks_do_not_depend_on_up_axis(live, model):
    frames = {}
    for up in ("z", "-y"):
        source = moving_source(walking_clouds(), up=up)
        frames[up] = list(lidarpose.predict_recording(source, up=up, track=True, live=live, model=model))
    R_level_input = UP_AXES["-y"]
    for z_up, y_down in zip(frames["z"], frames["-y"], strict=True):
        assert [person.id for person in z_up.poses] == [person.id for person in y_down.poses] and len(z_up.poses) == 2
        for one, other in zip(z_up.poses, y_down.poses, strict=True):
            np.testing.assert_allclose(other.joints @ R_level_input.T, one.joints, atol=2e-3)
            np.testing.assert_allclose(other.points @ R_level_input.T, one.points, atol=2e-3)
            np.testing.assert_allclose(R_level_input @ other.box.center, one.box.center, atol=2e-3)
            assert abs(np.angle(np.exp(1j * (other.box.yaw - one.box.yaw)))) < 0.01
            # `mounted` stays False for people known from earlier frames
            assert one.box.mounted is other.box.mounted is False


# ---- times and origins


def test_time_gap_ends_tracks_and_frame_origin_is_used(model, monkeypatch):
    """Tracks end at a gap in the times. The predictor gets the origin of each frame."""
    times = 1.7e9 + np.array([0, 0.1, 0.25, 0.3, 9.0, 9.1, 9.2])
    origins, predict_in = [], Predictor.predict_in

    def noted(self, clouds, origin, *arguments, **options):
        origins.append(origin)
        return predict_in(self, clouds, origin, *arguments, **options)

    monkeypatch.setattr(Predictor, "predict_in", noted)
    source = moving_source(walking_clouds(), times=times)
    frames = list(lidarpose.predict_recording(source, boxes=boxes_of(FRAMES), track=True, model=model))
    assert [frame.time for frame in frames] == times.tolist()
    assert [{person.id for person in frame.poses} for frame in frames] == [{0, 1}] * 4 + [{2, 3}] * 3
    expected_origins = [frame.origin for frame in source.frames()]
    assert len({tuple(origin) for origin in expected_origins}) == FRAMES
    np.testing.assert_allclose(origins, expected_origins)


def test_repeated_or_decreasing_times_lose_no_frames(model, tmp_path):
    times = [0.0, 0.1, 0.1, 0.05, 0.2, 0.3, 0.4]
    source = moving_source(walking_clouds(), times=times)
    lines = written(source, tmp_path / "a.jsonl", model, world=True, boxes=boxes_of(FRAMES), track=True)
    assert [line["time"] for line in lines] == times
    assert_where_people_are(lines)


def walker(times, rng):
    """One pose per time of a person who walks along x, with noise of 3 cm per joint and axis."""
    for time in times:
        joints = mean_adult_joints() + [1.2 * time, 0, 0] + rng.normal(scale=0.03, size=(24, 3))
        yield Pose(joints=joints, skeleton=SMPL24, spread=np.full(24, 0.05))


def steady_rows(times, damaged=()):
    """Indices of the frames whose pose is changed by smoothing, for a person at the given times."""
    lines = [
        {"time": time, "T_world_sensor": None, "error": None, "up": "z", "people": []}
        | ({"error": "damaged"} if k in damaged else {"people": [{"track": 0} | person_values(pose)]})
        for k, (time, pose) in enumerate(zip(times, walker(times, np.random.default_rng(0)), strict=True))
    ]
    people = [line["people"] for line in smoothed_lines(lambda: iter(lines), "z", SMPL24)]
    return [k for k in range(len(times)) if people[k] and people[k][0]["joints"] != lines[k]["people"][0]["joints"]]


def person_values(pose):
    return {"joints": pose.joints.tolist(), "spread": pose.spread.tolist(), "visible": [], "confidence": []}


def test_wrong_times_only_disable_smoothing_of_their_frames():
    times = (np.arange(20) / 10).tolist()
    rows = list(range(20))
    assert steady_rows(times) == rows
    # a damaged frame with the time of another clock, a valid frame with such a time, and a clock that restarts
    wrong = [*times[:9], 1.7e9, *times[10:]]
    assert steady_rows(wrong, damaged=[9]) == rows[:9] + rows[10:]
    assert steady_rows(wrong) == steady_rows(times[:10] * 2) == rows
    # two swapped frames: one of them is not smoothed
    assert steady_rows([*times[:9], times[10], times[9], *times[11:]]) == rows[:10] + rows[11:]
    # both frames after a later one are not smoothed
    assert steady_rows([*times[:9], times[11], times[9], times[10], *times[12:]]) == rows[:10] + rows[12:]
    # people are not filled in in damaged frames
    assert steady_rows(times, damaged=[9]) == rows[:9] + rows[10:]


def test_smoothed_lines_of_flipped_and_unposed_frames_are_consistent():
    rng, lines, flip = np.random.default_rng(0), [], list(SMPL24.flip)
    for k, pose in enumerate(walker(np.arange(12) / 10, rng)):
        is_flipped = k == 5
        joints = pose.joints[flip] if is_flipped else pose.joints
        box = {"center": [1.2 * k / 10, 0, 0.9], "size": [0.6, 0.6, 1.8], "yaw": 3.1 if is_flipped else 0.0}
        person = {"track": 0, "score": 0.9, "box": box, "warnings": [], "out_of_range": ["left_hand"] * is_flipped}
        facing = [-1.0, 0.0, 0.0] if is_flipped else [1.0, 0.0, 0.0]
        person |= {"joints": joints.tolist(), "spread": [0.05] * 24, "visible": [], "confidence": [], "facing": facing}
        if k == 8:
            person |= {"joints": None, "spread": [], "warnings": ["no pose: under 5 points", "other"], "facing": None}
        lines.append({"time": k / 10, "T_world_sensor": None, "error": None, "up": "z", "people": [person]})
    people = [line["people"][0] for line in smoothed_lines(lambda: iter(lines), "z", SMPL24)]
    assert all(p["facing"][0] > 0.9 for p in people)
    # boxes of the user are not turned, nor those that already agree with the smoothed pose
    given = list(smoothed_lines(lambda: iter(lines), "z", SMPL24, are_boxes_given=True))
    assert given[5]["people"][0]["box"]["yaw"] == 3.1
    turned = json.loads(json.dumps(lines))
    turned[5]["people"][0]["box"]["yaw"] = 0.3
    assert list(smoothed_lines(lambda: iter(turned), "z", SMPL24))[5]["people"][0]["box"]["yaw"] == 0.3
    left, right = (
        np.array([p["joints"] for p in people])[:, SMPL24.index(f"{side}_hip"), 1] for side in ("left", "right")
    )
    assert (left > right).all()
    assert people[5]["out_of_range"] == ["right_hand"] and abs(people[5]["box"]["yaw"]) < 0.1
    assert (
        people[8]["filled"] and people[8]["warnings"] == ["other"] and people[8]["box"] == lines[8]["people"][0]["box"]
    )
    assert lines[5]["people"][0]["box"]["yaw"] == 3.1


def test_late_frame_does_not_reset_live_filter():
    def live_joints(times):
        """By time of the frame: joints from the live filter, and the input pose."""
        known = KnownPeople(up="z", least_score=0.5, live=True)
        joints = {}
        for time, pose in zip(times, walker(times, np.random.default_rng(1)), strict=True):
            person = PersonPose(pose=pose, skeleton=SMPL24, points=np.zeros((0, 3)), warnings=(), model={})
            poses = Poses(people=(person,), skeleton=SMPL24, model={})
            joints[time] = known.update(time, Scan(points=np.zeros((5, 3))), poses, np.eye(4))[0].pose.joints, pose
        return joints

    times = (np.arange(30) / 10).tolist()
    joints = live_joints([*times[:20], times[21], times[20], *times[22:]])
    steady, seen = joints[times[20]]
    assert np.array_equal(steady, seen.joints)
    errors = [
        np.linalg.norm(steady - mean_adult_joints() - [1.2 * time, 0, 0], axis=-1).mean()
        for time, (steady, _) in joints.items()
    ]
    assert np.mean(errors[22:]) < 0.7 * np.linalg.norm(np.full(3, 0.03))


# ---- people known from earlier frames


def test_known_places_match_detections_and_set_thresholds():
    """Two tracked people, one of whom needs no verification, and two rejected positions."""
    box = Box(center=np.array([5.0, 0.0, 1.0]), size=np.array([0.6, 0.6, 1.8]), score=0.9)
    known = KnownPlaces(
        boxes=[box],
        pelvises=np.array([[5.0, 0.0, 1.0]]),
        tracks=np.array([[5.0, 0.0, 1.0], [9.0, 0.0, 1.0]]),
        reach=np.array([0.5, 0.5]),
        rejected=np.array([[0.0, 7.0, 1.0], [9.1, 0.0, 1.0]]),
    )
    centers = np.array([[5.2, 0.0, 0.9], [5.05, 0.1, 0.9], [9.3, 0.0, 1.0], [0.2, 7.0, 1.0], [0.4, 7.0, 1.0]])
    assert known.index_of(centers, np.ones(5, bool)).tolist() == [-1, 0, -1, -1, -1]
    # only detections marked as sure are matched to a known person
    assert known.index_of(centers, np.array([1, 0, 1, 1, 1], bool)).tolist() == [0, -1, -1, -1, -1]
    # no detection matches the second track: near it, a low score is enough, even at a rejected position
    assert known.least_scores(centers, np.array([-1, 0, -1, -1, -1]), 0.5).tolist() == [0.5, 0.5, 0.1, np.inf, 0.5]
    moved = known.level(UP_AXES["y"])
    np.testing.assert_allclose(moved.rejected, known.rejected @ UP_AXES["y"].T)
    np.testing.assert_allclose(moved.boxes[0].center, UP_AXES["y"] @ box.center)


def test_rejected_positions_are_kept_in_world_frame():
    people = KnownPeople(up="z", least_score=0.5, live=False)
    T = world_pose(1)
    people._rejected = np.array([[*(T[:3, :3] @ [4.0, 1.0, 0.0] + T[:3, 3]), 10.0]])
    np.testing.assert_allclose(people.expected(10.5, T).rejected, [[4.0, 1.0, 0.0]], atol=1e-9)
    later = people.expected(10.5, world_pose(2)).rejected
    assert np.linalg.norm(later - [4.0, 1.0, 0.0]) > 0.5
    assert not len(people.expected(20.0, T).rejected)


# ---- tables


def line_of(frame, people):
    return {
        "frame": frame,
        "id": f"scan {frame}",
        "time": frame / 10,
        "people": people,
        "skeleton": {"joints": ["pelvis", "nose"]},
    }


def person_of(number, **changes):
    """A person whose values are all different."""
    values = np.arange(12) / 100 + number
    person = {"id": f"p{number}", "track": number, "filled": number % 2 == 1, "mounted": number % 2 == 0}
    person |= {"joints": [values[:3].tolist(), values[3:6].tolist()], "confidence": values[6:8].tolist()}
    person |= {"spread": values[8:10].tolist(), "visible": values[10:12].tolist(), "out_of_range": ["nose"]}
    person |= {"person": 0.9, "second_person": 0.2, "score": 0.7}
    return person | changes


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_tables_have_all_values_of_all_frames(suffix, tmp_path, monkeypatch):
    if suffix == "parquet":
        pytest.importorskip("pyarrow")
    lines = [line_of(k, [person_of(2 * k), person_of(2 * k + 1)] if k else []) for k in range(5)]
    read = pandas.read_csv if suffix == "csv" else pandas.read_parquet
    tables = []
    # the first block of rows has no people
    for rows in (200, 1, 2):
        monkeypatch.setattr(result_files, "_ROWS_OF", rows)
        result_files.write_result(tmp_path / f"{rows}.{suffix}", lines)
        tables.append(read(tmp_path / f"{rows}.{suffix}"))
    for table in tables[1:]:
        pandas.testing.assert_frame_equal(table, tables[0])
    table = tables[0]
    assert len(table) == 2 * 2 * 4
    row = table[(table.track == 5) & (table.joint == "nose")].iloc[0]
    expected = {"frame": 2, "frame_id": "scan 2", "time": 0.2, "person": 1, "id": "p5", "filled": True}
    expected |= {"x": 5.03, "y": 5.04, "z": 5.05, "confidence": 5.07, "spread": 5.09, "visible": 5.11}
    expected |= {"in_range": False, "person_probability": 0.9, "second_person": 0.2, "score": 0.7, "mounted": False}
    assert {name: row[name] for name in expected} == pytest.approx(expected)
    assert bool(table[(table.track == 5) & (table.joint == "pelvis")].iloc[0].in_range)


def test_known_people_close_together_are_detected_again():
    boxes = [Box(center=(x, 0, 1), size=(0.6, 0.6, 1.8), score=0.9) for x in (5.0, 5.8, 9.0)]
    places = np.array([box.center for box in boxes])
    known = KnownPlaces(boxes=boxes, pelvises=places, tracks=places, reach=np.full(3, 0.5), rejected=np.zeros((0, 3)))
    # also where only a detection's height differs
    assert known.index_of(places + [0, 0, 0.6], np.ones(3, bool)).tolist() == [-1, -1, 2]
    # a low threshold stays
    assert known.least_scores(places, np.array([-1, -1, 2]), 0.05).tolist() == [0.05] * 3


def test_known_person_at_a_rejected_place_stays():
    box = Box(center=(5, 0, 1), size=(0.6, 0.6, 1.8), score=0.9)
    places = box.center[None]
    known = KnownPlaces(boxes=[box], pelvises=places, tracks=places, reach=np.array([0.5]), rejected=places)
    assert known.least_scores(np.repeat(places, 2, 0), np.array([0, -1]), 0.5).tolist() == [0.5, np.inf]


def seen(known, time, *, score=0.9, verified=True):
    """Adds a frame with a person at (5, 0)."""
    box = Box(center=(5, 0, 1), size=(0.6, 0.6, 1.8), score=score, mounted=False)
    pelvis = np.array([5, 0, 1.0])
    person = PersonPose(pose=None, skeleton=SMPL24, points=np.zeros((0, 3)), box=box, pelvis=pelvis)
    scan = Scan(points=np.zeros((5, 3)), boxes=[box], pelvises=pelvis[None], verified=np.array([verified]))
    known.update(time, scan, Poses(people=(person,), skeleton=SMPL24), np.eye(4))


def test_people_are_known_until_they_must_be_verified_again():
    known = KnownPeople(up="z", least_score=0.5, live=False)
    for k in range(5):
        seen(known, k / 10)
        assert len(known.expected(k / 10 + 0.1, np.eye(4)).boxes) == 1
    # unseen for over half a second
    assert [len(known.expected(time, np.eye(4)).boxes) for time in (0.8, 1.0)] == [1, 0]
    assert len(known.expected(1.0, np.eye(4)).tracks) == 1
    # seen, but not verified, for 1.6 s
    for k in range(5, 25):
        seen(known, k / 10, verified=False)
        assert len(known.expected(k / 10 + 0.1, np.eye(4)).boxes) == (k / 10 + 0.1 < 2.0 - 1e-6), k
    # of a low score
    seen(known, 2.5, score=0.3)
    assert not known.expected(2.6, np.eye(4)).boxes and len(known.expected(2.6, np.eye(4)).tracks) == 1


def test_weak_detections_start_no_tracks():
    known = KnownPeople(up="z", least_score=0.5, live=False)
    box = Box(center=(5, 0, 1), size=(0.6, 0.6, 1.8), score=0.2)
    person = PersonPose(pose=None, skeleton=SMPL24, points=np.zeros((0, 3)), box=box)
    scan, poses = Scan(points=np.zeros((5, 3)), boxes=[box]), Poses(people=(person,), skeleton=SMPL24)
    assert [len(known.update(k / 10, scan, poses, np.eye(4))) for k in range(3)] == [0, 0, 0]


def test_velocity_is_along_the_axes_of_the_sensor():
    known, T = (
        KnownPeople(up="z", least_score=0.5, live=False),
        rigid_transform(rotation_about("z", np.pi / 2), np.zeros(3)),
    )
    known.fixed.from_sensor(T)
    for k in range(20):
        # walks along the world's x
        box = Box(center=T[:3, :3].T @ [3 + 0.1 * k, 2, 1], size=(0.6, 0.6, 1.8), score=0.9)
        person = PersonPose(pose=None, skeleton=SMPL24, points=np.zeros((0, 3)), box=box)
        scan, poses = Scan(points=np.zeros((5, 3)), boxes=[box]), Poses(people=(person,), skeleton=SMPL24)
        (person,) = known.update(k / 10, scan, poses, T)
    np.testing.assert_allclose(person.velocity, [0, -1, 0], atol=0.05)


def test_rejected_positions_of_another_clock_are_forgotten():
    """A clock that was set back would else hide people there for long."""
    known = KnownPeople(up="z", least_score=0.5, live=False)
    known._rejected = np.array([[4.0, 1.0, 0.0, 1000.0]])
    restored = KnownPeople(up="z", least_score=0.5, live=False)
    restored.restore(json.loads(json.dumps(known.state())))
    assert len(restored.expected(1000.5, np.eye(4)).rejected) == 1
    assert not len(restored.expected(10.0, np.eye(4)).rejected)


def test_added_people_have_the_id_of_their_track():
    times = np.arange(10) / 10
    lines = [
        {"time": time, "T_world_sensor": None, "error": None, "up": "z", "people": [{"track": 3} | person_values(pose)]}
        for time, pose in zip(times, walker(times, np.random.default_rng(0)), strict=True)
    ]
    lines[5]["people"] = []
    (added,) = list(smoothed_lines(lambda: iter(lines), "z", SMPL24))[5]["people"]
    assert added["filled"] and added["id"] == added["track"] == 3


def test_axes_are_the_worlds_if_the_first_pose_is_known():
    T = rigid_transform(np.eye(3), np.ones(3))
    first, late = FixedFrame("-y"), FixedFrame("-y")
    late.from_sensor(None)
    for fixed in (first, late):
        fixed.from_sensor(T)
    assert first.axes == ("x", "y") and late.axes == FixedFrame("-y").axes == ("z", "-x")


def test_tables_have_no_in_range_without_values_of_joints(tmp_path):
    person = person_of(0, confidence=[], spread=[], visible=[], out_of_range=[])
    result_files.write_result(tmp_path / "a.csv", [line_of(0, [person])])
    assert pandas.read_csv(tmp_path / "a.csv").in_range.isna().all()
