"""Predictions for folders and recordings: people and tracks per frame, and result files that can be resumed."""

import errno
import json
import os
import threading
import time
from dataclasses import replace
from functools import partial
from itertools import islice, product
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pandas
import pytest
from hypothesis import given, strategies as st
from walking_people import FRAMES, PLACES, STEPS, moving_source, walking_clouds

import lidarpose
from lidarpose import Box, Boxes, InputError
from lidarpose.body.rig import mean_adult_joints
from lidarpose.cli import main
from lidarpose.geometry import UP_AXES, rigid_transform, rotation_about, rotation_from_up
from lidarpose.inference.results import PersonPose, Poses
from lidarpose.io.sources import open_source
from lidarpose.io.sources.frame import Frame, FrameSource, IndexedRecording, LazyFrame, Sweep
from lidarpose.recording import output, page, picture, result_files
from lidarpose.recording.coordinates import in_world
from lidarpose.recording.frame_boxes import FrameBoxes
from lidarpose.recording.predict_recording import FramePoses, FramePredictor, _one_ahead
from lidarpose.sample import Pose, facing
from lidarpose.skeleton import SMPL24
from lidarpose.viz.bird_eye import draw_scan_and_people

DAMAGED = 4
STATED_SKELETON = {"name": "smpl24", "joints": list(SMPL24.joints), "bones": [list(bone) for bone in SMPL24.bones]}


@pytest.fixture(scope="module")
def clouds():
    return walking_clouds()


@pytest.fixture(scope="module")
def drive(clouds, tmp_path_factory):
    """A folder of frames, one of them damaged."""
    folder = tmp_path_factory.mktemp("recordings") / "drive"
    folder.mkdir()
    for k, points in enumerate(clouds):
        np.save(folder / f"frame_{k + 5}.npy", points)
    (folder / f"frame_{DAMAGED + 5}.npy").write_bytes(b"not an array")
    return folder


@pytest.fixture(scope="module")
def model():
    return lidarpose.load("tiny", tta=1)


@pytest.fixture(scope="module", autouse=True)
def one_model(model):
    """The same loaded network for every command."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lidarpose.inference.predictor.load", lambda *_, **__: model)
        yield


@pytest.fixture(scope="module")
def folder(drive):
    return drive.parent


@pytest.fixture(scope="module")
def tracked(drive, folder):
    """The lines of the folder with tracks, written without interruption, and their file."""
    return run(drive, "--track", "--out", folder / "whole.jsonl"), folder / "whole.jsonl"


def run(*words, status=0):
    """Runs `lidarpose predict` and returns the lines of the file after --out."""
    words = [str(word) for word in ("predict", *words)]
    assert main([*words, "--quiet"]) == status
    path = words[words.index("--out") + 1]
    return [json.loads(line) for line in open(path, "rb")] if status == 0 else None


def places(line):
    """Positions of people by track: the mean of their joints, (3,) m."""
    return {person["track"]: np.mean(person["joints"], 0) for person in line["people"] if person["joints"]}


def test_result_has_one_line_per_frame_sorted_by_number(tracked):
    lines, _ = tracked
    assert [line["frame"] for line in lines] == list(range(FRAMES))
    assert [line["id"] for line in lines] == [f"frame_{k + 5}" for k in range(FRAMES)]
    assert [line["time"] for line in lines] == pytest.approx(np.arange(FRAMES) / 10)
    own = {"frame", "id", "time", "T_world_sensor", "error", "people", "skeleton", "model", "source", "unit"}
    assert all(own <= set(line) and "timing_ms" not in line for line in lines)
    assert lines[DAMAGED]["people"] == [] and ".npy" in lines[DAMAGED]["error"]


def test_tracks_follow_walking_people(tracked):
    lines = [line for k, line in enumerate(tracked[0]) if k != DAMAGED]
    assert [set(places(line)) for line in lines] == [{0, 1}] * len(lines)
    first, last = places(lines[0]), places(lines[-1])
    for at, step in zip(PLACES, STEPS, strict=True):
        track = min(first, key=lambda id: np.hypot(*(first[id][:2] - at)))
        moved = (last[track] - first[track])[:2]
        assert np.hypot(*(first[track][:2] - at)) < 0.25 and np.hypot(*(moved - step * (FRAMES - 1))) < 0.1
        velocities = [person["velocity"] for line in lines for person in line["people"] if person["track"] == track]
        # unknown at the first sighting
        assert velocities[0] is None and np.linalg.norm(velocities[-1] - np.append(step, 0) * 10) < 0.5
    for person in (person for line in lines for person in line["people"]):
        assert person["id"] == person["track"] and person["filled"] is False
        assert len(person["joints"]) == len(person["spread"]) == 24 and person["num_points"] > 50


def test_untracked_frame_equals_prediction_of_single_file(drive, folder, clouds, model):
    lines = run(drive, "--every", 3, "--end", 0.4, "--out", folder / "plain.jsonl")
    assert [line["frame"] for line in lines] == [0, 3]
    alone = lidarpose.predict(drive / "frame_8.npy", model=model).to_dict()
    assert [person | {"track": None, "velocity": None, "filled": False} for person in alone["people"]] == lines[1][
        "people"
    ]
    assert lines[1]["people"][0]["score"] > 0.8


def test_first_tracked_frame_equals_prediction_of_single_file(drive, model):
    """People who are not known yet get all passes of the network."""
    first, second = islice(lidarpose.predict_recording(drive, track=True, model=model), 2)
    for frame, is_known in ((first, False), (second, True)):
        alone = lidarpose.predict(drive / f"{frame.id}.npy", model=model)
        assert len(frame.poses) == len(alone) == 2
        assert np.array_equal(frame.poses.to_numpy(), alone.to_numpy()) != is_known


@pytest.mark.parametrize("flag", ["--track", "--live"])
def test_killed_command_resumes_to_same_file(flag, drive, folder, tracked, monkeypatch, capsys):
    words, path = (drive, flag, "--out", folder / f"killed{flag}.jsonl"), folder / f"killed{flag}.jsonl.part"
    whole = tracked[1] if flag == "--track" else folder / "live.jsonl"
    if flag == "--live":
        run(drive, flag, "--out", whole)
    predict, posed = FramePredictor._predicted, []

    def killed(self, frame, prepared):
        if len(posed) == 3:
            raise KeyboardInterrupt
        posed.append(frame.index)
        return predict(self, frame, prepared)

    monkeypatch.setattr(FramePredictor, "_predicted", killed)
    run(*words, status=130)
    error = capsys.readouterr().err
    assert f"stopped: the finished frames are in {path}, and the same command resumes" in error
    # append a complete line that is not in the predictor's state, and an incomplete line
    with open(path, "ab") as file:
        file.write(path.read_bytes().splitlines()[0] + b'\n{"schema": "lidar')
    assert not (folder / f"killed{flag}.jsonl").exists()
    monkeypatch.setattr(FramePredictor, "_predicted", lambda self, *of: posed.append(of[0].index) or predict(self, *of))
    run(*words)
    assert posed == list(range(FRAMES))
    assert (folder / f"killed{flag}.jsonl").read_bytes() == whole.read_bytes()
    assert not list(folder.glob("killed*.part*"))


def test_stopped_command_keeps_unfinished_file_only_with_frames(drive, tmp_path, monkeypatch, capsys):
    def stop(*_, **__):
        raise KeyboardInterrupt

    words = (drive, "--end", 0.1, "--track", "--out", tmp_path / "a.jsonl")
    for owner, name, is_kept in ((FramePredictor, "_predicted", False), (output, "smoothed_lines", True)):
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, stop)
            run(*words, status=130)
        assert ("a.jsonl.part, and the same command resumes" in capsys.readouterr().err) is is_kept
        assert bool(list(tmp_path.iterdir())) is is_kept
    assert len(run(*words)) == 2


def test_unfinished_file_of_other_command_is_not_resumed(drive, folder, monkeypatch, capsys):
    def stop(self, *of):
        raise KeyboardInterrupt

    out = folder / "other.jsonl"
    with monkeypatch.context() as patch:
        predict = FramePredictor._predicted
        patch.setattr(FramePredictor, "_predicted", lambda self, *of: (stop if of[0].index else predict)(self, *of))
        run(drive, "--end", 0.2, "--out", out, status=130)
    part = Path(f"{out}.part")
    finished = part.read_bytes()
    # an invalid command leaves the unfinished file unchanged and creates no file
    run(drive, "--end", 0.2, "--skeleton", "coco", "--out", out, status=2)
    run(drive, "--start", 100, "--out", out, status=2)
    assert "has no frames between start and end" in capsys.readouterr().err
    assert part.read_bytes() == finished
    for options in (("--end", 0.2, "--skeleton", "coco"), ("--start", 100)):
        run(drive, *options, "--out", folder / "wrong.jsonl", status=2)
    assert not list(folder.glob("wrong*"))
    capsys.readouterr()
    assert main(["predict", str(drive), "--end", "0.2", "--max-people", "1", "--out", str(out)]) == 0
    assert "from another command (max_people): starting over" in capsys.readouterr().err
    assert [len(json.loads(line)["people"]) for line in open(out)] == [1, 1, 1]


def test_unfinished_file_of_other_frames_raises(drive, folder, monkeypatch, tmp_path, capsys):
    steps = FramePredictor(crop=True, model=lidarpose.load("tiny", tta=1))
    frame = Frame(points=np.ones((9, 3)), index=0, id="gone", time=0.0)
    with output.PartFile(tmp_path / "a.jsonl", {}) as part:
        part.append(next(steps.predict_all(iter([frame]))), steps.state(), 0)
        written = part.path.read_bytes()
        # opening it a second time fails, with the same command and with another
        for command in ({}, {"min_score": 0.1}):
            with pytest.raises(InputError, match=r"a.jsonl.part: another lidarpose process is writing it"):
                output.PartFile(tmp_path / "a.jsonl", command)
        assert part.path.read_bytes() == written
    recording = IndexedRecording(name="made", ids=["here"], times=None, read=lambda i: Sweep(points=np.ones((9, 3))))
    with pytest.raises(InputError, match=r"a.jsonl.part: was made from other frames, the last one gone: remove it"):
        output.write_recording(FrameSource(recording), steps, tmp_path / "a.jsonl", command={})


def test_unfinished_file_of_changed_points_raises(tmp_path, model, monkeypatch):
    """A folder may have been exported again with the same file names."""
    crop, predict = np.random.default_rng(0).normal(scale=0.3, size=(99, 3)), FramePredictor._predicted

    def write(points):
        recording = IndexedRecording(name="made", ids=list("ab"), times=None, read=lambda i: Sweep(points=points))
        steps = FramePredictor(crop=True, model=model)
        output.write_recording(FrameSource(recording), steps, tmp_path / "a.jsonl", command={})

    def stop_at_second(self, frame, prepared):
        if frame.index:
            raise KeyboardInterrupt
        return predict(self, frame, prepared)

    with monkeypatch.context() as patch:
        patch.setattr(FramePredictor, "_predicted", stop_at_second)
        with pytest.raises(KeyboardInterrupt):
            write(crop)
    with pytest.raises(InputError, match=r"a.jsonl.part: was made from other frames, the last one a: remove it"):
        write(crop + 50)
    write(crop)


@pytest.fixture
def stopped(drive, folder, monkeypatch):
    """Function that runs a command on the folder, stops it after the first frame, and returns the given words."""
    predict = FramePredictor._predicted

    def stop_at_second(self, *of):
        if of[0].index:
            raise KeyboardInterrupt
        return predict(self, *of)

    def stop(*words):
        with monkeypatch.context() as patch:
            patch.setattr(FramePredictor, "_predicted", stop_at_second)
            run(drive, *words, status=130)
        return words

    return stop


def test_resume_with_html_keeps_finished_frames(stopped, drive, tmp_path, capsys):
    words = stopped("--end", 0.2, "--out", tmp_path / "a.jsonl")
    assert main(["predict", str(drive), *map(str, words), "--html"]) == 0
    assert "1 frames are in" in capsys.readouterr().err
    assert (tmp_path / "a.html").is_file() and len((tmp_path / "a.jsonl").read_bytes().splitlines()) == 3


@pytest.mark.parametrize("form", ["file", "folder"])
def test_changed_boxes_file_restarts_prediction(form, stopped, drive, tmp_path, capsys):
    """Poses made with the old boxes are not kept."""
    path = boxes = tmp_path / "boxes.json"
    if form == "folder":
        boxes = tmp_path / "boxes"
        boxes.mkdir()
        path = boxes / "0.json"
    entry = {"people": [{"center": [4.1, 1.5, 0], "size": [1, 1, 2]}]}
    content = entry if form == "folder" else [{"frame": 0} | entry]
    path.write_text(json.dumps(content))
    words = stopped("--end", 0.2, "--boxes", boxes, "--out", tmp_path / "a.jsonl")
    stat = path.stat()
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns + 10**9))
    assert main(["predict", str(drive), *map(str, words)]) == 0
    assert "from another command (files changed): starting over" in capsys.readouterr().err


def test_resume_with_result_in_folder_of_boxes_keeps_finished_frames(stopped, drive, tmp_path, capsys):
    """The command's own unfinished files are no change of the boxes, and neither is stating the default of --every."""
    (tmp_path / "0.json").write_text(json.dumps({"people": [{"center": [4.1, 1.5, 0], "size": [1, 1, 2]}]}))
    for name in ("a.jsonl", "results/a.jsonl"):
        words = stopped("--end", 0.2, "--boxes", tmp_path, "--out", tmp_path / name)
        assert main(["predict", str(drive), *map(str, words), "--every", "1"]) == 0
        assert "1 frames are in" in capsys.readouterr().err


def test_printing_rejects_boxes_of_other_frames(drive, tmp_path, capsys):
    (tmp_path / "b.json").write_text('[{"frame": "elsewhere", "people": []}]')
    assert main(["predict", str(drive), "--end", "0.1", "--boxes", str(tmp_path / "b.json"), "--out", "-"]) == 2
    assert "has boxes of frames elsewhere, but this recording has other frames" in capsys.readouterr().err


def test_boxes_state_up_axis_of_recording(clouds, tmp_path, capsys):
    """Results of `predict --up y`, and of tilted scans, are boxes without `--up`."""
    R_tilted_level = rotation_about("x", np.radians(12.0))
    for name, R, up in (("turned", rotation_from_up("y").T, ["--up", "y"]), ("tilted", R_tilted_level, [])):
        (tmp_path / name).mkdir()
        for k, cloud in enumerate(clouds[:2]):
            np.save(tmp_path / name / f"{k}.npy", cloud @ R.T)
        found, posed = tmp_path / f"{name}.jsonl", tmp_path / f"{name}-2.jsonl"
        first = run(tmp_path / name, *up, "--out", found)
        lines = [json.loads(line) for line in found.read_text().splitlines()]
        again = run(tmp_path / name, "--boxes", found, "--track", "--out", posed)
        assert [line["error"] for line in again] == [None, None] and all(line["people"] for line in first)
        assert [line["up"] for line in again] == [line["up"] for line in lines]
        assert name == "turned" or any("," in line["up"] for line in lines)
        for line, other in zip(lines, again, strict=True):
            for person, posed_person in zip(line["people"], other["people"], strict=True):
                np.testing.assert_allclose(posed_person["joints"], person["joints"], atol=0.2)


def test_boxes_with_other_up_axis_are_rejected(drive, tmp_path, capsys):
    people = [{"center": [4.1, 0, 1.5], "size": [1, 1, 2]}]
    entry = {"schema": "lidarpose.boxes/1", "people": people, "up": "y"}
    (tmp_path / "b.json").write_text(json.dumps([{"frame": k} | entry for k in range(2)]))
    words = ["predict", str(drive), "--end", "0.1", "--boxes", str(tmp_path / "b.json"), "--out"]
    assert main([*words, str(tmp_path / "o.jsonl"), "--up", "z"]) == 2
    assert "the up axis of the boxes is y, not z: give --up y" in capsys.readouterr().err
    for up in ([], ["--up", "y"]):
        assert main([*words, str(tmp_path / "o.jsonl"), *up]) == 0


def test_frame_without_points_gives_no_pose_and_no_error(clouds, model, tmp_path, capsys):
    feet = PLACES[0]
    crop = clouds[0][(np.abs(clouds[0][:, :2] - feet) < 0.7).all(1)]
    np.save(tmp_path / "0.npy", crop)
    np.save(tmp_path / "1.npy", np.zeros((9, 3)))
    boxes = {k: [Box(center=np.array([*feet, 0.0]), size=np.array([1.0, 1, 2]))] for k in range(2)}
    for options in ({"crop": True}, {"boxes": boxes}, {}):
        frames = list(lidarpose.predict_recording(tmp_path, model=model, **options))
        assert [frame.error for frame in frames] == [None, None]
        assert [person.has_pose for person in frames[1].poses] == [False]
    assert not model.predict(np.zeros((0, 3)), boxes=boxes[0])[0].has_pose


def test_undecodable_file_names_are_escaped_in_tables(clouds, tmp_path):
    name = os.fsdecode(b"\xff0.npy")
    np.save(tmp_path / name, clouds[0])
    for suffix in ("csv", "parquet"):
        assert main(["predict", str(tmp_path), "--out", str(tmp_path / f"out.{suffix}"), "--quiet"]) == 0
    table = pandas.read_csv(tmp_path / "out.csv")
    assert set(table["frame_id"]) == {"\\udcff0"} == set(pandas.read_parquet(tmp_path / "out.parquet")["frame_id"])


@pytest.mark.long
def test_predict_does_not_overwrite_input_files(clouds, tmp_path, capsys):
    np.savetxt(tmp_path / "0.csv", clouds[0], fmt="%.3f", delimiter=",")
    before = (tmp_path / "0.csv").read_bytes()
    for source in (tmp_path, tmp_path / "*.csv"):
        assert main(["predict", str(source), "--format", "csv", "--out", str(tmp_path / "0.csv")]) == 2
        assert "0.csv" in capsys.readouterr().err
    (tmp_path / "deep/er").mkdir(parents=True)
    for name, source in (("deep/er/1.csv", "**/1.csv"), ("a[1].csv", "a[1].csv")):
        (tmp_path / name).write_bytes(before)
        words = ["predict", str(tmp_path / source), "--format", "csv", "--out", str(tmp_path / name)]
        assert main(words) == 2 and "is also an input file" in capsys.readouterr().err
        assert (tmp_path / name).read_bytes() == before
        (tmp_path / name).unlink()
    assert (tmp_path / "0.csv").read_bytes() == before
    # results of an earlier command may be overwritten
    for _ in range(2):
        words = ["predict", str(tmp_path), "--out", f"{tmp_path}/", "--picture", "--html", "--quiet"]
        assert main(words) == 0, capsys.readouterr().err
    assert {path.suffix for path in tmp_path.iterdir() if path.is_file()} == {".csv", ".jsonl", ".png", ".html"}


def test_frames_of_relative_and_absolute_paths_have_different_names(clouds, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a/000.npy", "b/000.npy"):
        (tmp_path / name).parent.mkdir()
        np.save(tmp_path / name, clouds[0])
    frames = open_source(["a/000.npy", tmp_path / "b/000.npy"])
    assert {frame.id for frame in frames} == {os.path.join("a", "000.npy"), os.path.join("b", "000.npy")}
    # Windows has no common folder of two drives
    monkeypatch.setattr(os.path, "commonpath", Mock(side_effect=ValueError))
    frames = open_source(["a/000.npy", "b/000.npy"])
    assert [frame.id for frame in frames] == [str(tmp_path / name / "000.npy") for name in "ab"]


def test_table_of_joints_is_not_read_as_points(clouds, tmp_path, capsys):
    path = tmp_path / "all.csv"
    np.save(tmp_path / "a.npy", clouds[0])
    assert main(["predict", str(tmp_path / "a.npy"), "--crop", "--format", "csv", "--out", str(path), "--quiet"]) == 0
    assert main(["predict", str(path)]) == 2
    assert "expected points, got a table of joints, as lidarpose predict writes it" in capsys.readouterr().err


def test_csv_and_parquet_have_one_row_per_person_and_joint(tracked, tmp_path):
    pytest.importorskip("pyarrow")
    lines, _ = tracked
    made = []
    for name, read in (("a.csv", pandas.read_csv), ("a.parquet", pandas.read_parquet)):
        result_files.write_result(tmp_path / name, lines)
        made.append(read(tmp_path / name))
    csv, parquet = made
    assert set(csv.coordinates) == set(parquet.coordinates) == {"sensor"}
    people = [(line, person) for line in lines for person in line["people"]]
    assert len(csv) == len(parquet) == 24 * len(people)
    line, person = people[-1]
    row = parquet.iloc[-24]
    assert (row.frame, row.frame_id, row.track, row.joint) == (line["frame"], line["id"], person["track"], "pelvis")
    assert [row.x, row.y, row.z] == person["joints"][0] and row.spread == person["spread"][0]
    np.testing.assert_allclose(csv[["x", "y", "z", "confidence"]], parquet[["x", "y", "z", "confidence"]])
    assert [row.velocity_x, row.velocity_y, row.velocity_z] == person["velocity"]
    assert lidarpose.read_poses(line)[-1].velocity.tolist() == person["velocity"]
    # as older versions wrote it
    older = {key: value for key, value in person.items() if key != "velocity"}
    assert lidarpose.read_poses(line | {"people": [older]})[0].velocity is None
    # the world frame is known for some frames only
    moved = [in_world(line | {"T_world_sensor": np.eye(4).tolist()}) if line["frame"] % 2 else line for line in lines]
    result_files.write_result(tmp_path / "world.csv", moved)
    world = pandas.read_csv(tmp_path / "world.csv")
    assert (world.coordinates == np.where(world.frame % 2, "world", "sensor")).all()
    # the columns exist even if no frame has people
    result_files.write_result(tmp_path / "none.parquet", [line | {"people": []} for line in lines])
    none = pandas.read_parquet(tmp_path / "none.parquet")
    assert len(none) == 0 and list(none.columns) == list(parquet.columns) and none.dtypes.equals(parquet.dtypes)


# ---- Python API


def test_tracks_of_moving_sensor_use_world_frame(clouds, model):
    frames = list(lidarpose.predict_recording(moving_source(clouds), track=True, model=model))
    assert [{person.id for person in frame.poses} for frame in frames] == [{0, 1}] * FRAMES
    first = {person.id: person.joints.mean(0) for person in frames[0].poses}
    for frame in frames:
        line = in_world(frame.to_dict())
        assert line["coordinates"] == "world"
        for track, at in places(line).items():
            start = first[track] @ frames[0].T_world_sensor[:3, :3].T + frames[0].T_world_sensor[:3, 3]
            assert np.hypot(*(at - start)[:2]) < 0.1 * FRAMES + 0.2


@pytest.mark.parametrize("up", UP_AXES)
def test_in_world_converts_box_heading(up):
    """The yaw of a box is about the input's up axis; in the world frame it is about z."""
    R_level_input, R_world_level = UP_AXES[up], rotation_about("z", 0.4)
    T_world_sensor = rigid_transform(R_world_level @ R_level_input, np.array([1.0, 2.0, 3.0]))
    box = {"center": [4.0, 5.0, 6.0], "size": [0.5, 0.6, 1.8], "yaw": 0.3}
    person = {"joints": None, "box": box, "velocity": [1, 2, 3], "facing": None}
    line = in_world(
        {"T_world_sensor": T_world_sensor.tolist(), "people": [person], "up": up, "skeleton": STATED_SKELETON}, up
    )
    (person,), moved = line["people"], line["people"][0]["box"]
    assert line["up"] == "z" and person["facing"] is None
    np.testing.assert_allclose(person["velocity"], R_world_level @ R_level_input @ [1, 2, 3], atol=1e-4)
    assert abs(moved["yaw"] - 0.7) < 1e-9
    np.testing.assert_allclose(moved["center"], R_world_level @ R_level_input @ [4, 5, 6] + [1, 2, 3], atol=1e-4)


@given(st.floats(-0.4, 0.4), st.floats(-3, 3))
def test_facing_in_world_is_that_of_the_joints(tilt, yaw):
    """Also where the sensor is out of level: its horizontal is not the world's."""
    T_world_sensor = rigid_transform(rotation_about("x", tilt) @ rotation_about("z", yaw), np.array([1.0, 2.0, 3.0]))
    joints = mean_adult_joints()
    own = facing(Pose(joints=joints, skeleton=SMPL24))
    person = {"joints": joints.tolist(), "box": None, "facing": own.tolist()}
    line = {"T_world_sensor": T_world_sensor.tolist(), "people": [person], "up": "z", "skeleton": STATED_SKELETON}
    (moved,) = in_world(line)["people"]
    expected = facing(Pose(joints=np.array(moved["joints"]), skeleton=SMPL24))
    np.testing.assert_allclose(moved["facing"], expected, atol=1e-3)
    assert moved["facing"][2] == 0 and np.linalg.norm(moved["facing"]) == pytest.approx(1, abs=1e-3)


def test_recording_of_crops_without_search(clouds, model):
    frames = [Frame(index=k, id=str(k), points=cloud) for k, cloud in enumerate(clouds[:2])]
    results = list(lidarpose.predict_recording(iter(frames), find=False, model=model))
    assert [[person.box for person in frame.poses] for frame in results] == [[None], [None]]
    with pytest.raises(InputError, match="options of the detection: omit them with find=False"):
        lidarpose.predict_recording(iter(frames), find=False, min_score=0.5, model=model)


def test_first_frame_suggests_up_axis(clouds, model, tmp_path):
    for k, points in enumerate(clouds[:3]):
        np.save(tmp_path / f"{k}.npy", points @ UP_AXES["-y"])
    first, *others = lidarpose.predict_recording(tmp_path, model=model)
    assert not len(first.poses) and any(line.endswith("try --up -y") for line in first.poses.warnings)
    assert not any("no people found" in line for frame in others for line in frame.poses.warnings)
    frames = list(lidarpose.predict_recording(tmp_path, model=model, up="-y"))
    assert [len(frame.poses) for frame in frames] == [2, 2, 2]


def test_known_people_are_not_verified_again(clouds, model, monkeypatch):
    from lidarpose.inference import detection, verification

    posed, verified = [], detection.verified

    class Crops(verification.Crops):
        def __init__(self, detections, clouds, origin):
            posed[-1].append(detections.centers[list(clouds), :2])
            super().__init__(detections, clouds, origin)

    monkeypatch.setattr(verification, "Crops", Crops)
    monkeypatch.setattr(detection, "verified", lambda *given: posed.append([]) or verified(*given))
    frames = list(lidarpose.predict_recording(moving_source(clouds), track=True, model=model))
    assert len(posed[0][0]) >= 2
    for places, frame in zip(map(np.concatenate, posed[2:]), frames[2:], strict=True):
        # at most one position beside a person, and neither of the two people
        people = np.array([person.joints[0, :2] for person in frame.poses])
        assert len(people) == 2 and len(places) <= 1
        assert (np.linalg.norm(places[:, None] - people, axis=-1) > 0.3).all()
    scores = [{person.id: person.score for person in frame.poses} for frame in frames]
    assert all(line == scores[-1] for line in scores[2:])


@pytest.mark.parametrize("name", ["waymo14", "ankles"])
def test_tracked_joints_do_not_depend_on_skeleton(name, clouds, model):
    """Known people are centered on the network's pelvis, which skeletons may lack."""
    ankles = lidarpose.Skeleton(name="ankles", joints=("left_ankle", "right_ankle"), parents=(-1, 0))
    frames = [
        lidarpose.predict_recording(moving_source(clouds[:4]), model=model, track=True, skeleton=skeleton)
        for skeleton in (ankles if name == "ankles" else name, None)
    ]
    for own, default in zip(*frames, strict=True):
        assert own.error is None and sorted(person.id for person in own.poses) == [0, 1]
        for person, expected in zip(own.poses, default.poses, strict=True):
            for joint in ("left_ankle", "right_ankle"):
                np.testing.assert_array_equal(
                    person.joints[person.skeleton.index(joint)], expected.joints[expected.skeleton.index(joint)]
                )


def test_folder_of_crops_gives_one_track(clouds, folder, model):
    crops = folder / "crops"
    crops.mkdir()
    for k, points in enumerate(clouds):
        feet = PLACES[0] + k * STEPS[0]
        np.save(crops / f"{k}.npy", points[(np.abs(points[:, :2] - feet) < 0.7).all(1)])
    lines = run(crops, "--crop", "--track", "--out", folder / "crops.jsonl")
    assert [[person["track"] for person in line["people"]] for line in lines] == [[0]] * FRAMES
    way = np.array([places(line)[0] for line in lines])
    assert np.linalg.norm(np.diff(way, axis=0) - [*STEPS[0], 0], axis=1).max() < 0.05
    # without --crop the first frame decides
    frame = next(lidarpose.predict_recording(crops, model=model))
    assert [person.box for person in frame.poses] == [None]


def test_hidden_people_are_filled_in(clouds, folder, model, monkeypatch):
    boxes = {}
    for k in range(FRAMES):
        at = PLACES + k * STEPS
        people = [{"center": [*place, -0.9], "size": [1, 1, 2.1]} for place in at]
        boxes[k] = people[:1] if 2 <= k < 5 else people
    source = moving_source(clouds)
    still = FrameSource(replace(source.recording, read=lambda i: Sweep(points=clouds[i])))
    steps = FramePredictor(boxes=boxes, track=True, model=model)
    output.write_recording(still, steps, folder / "filled.jsonl", command={})
    lines = [json.loads(line) for line in open(folder / "filled.jsonl")]
    assert [[person["filled"] for person in line["people"]] for line in lines[1:6]] == [
        [False, False], [False, True], [False, True], [False, True], [False, False]
    ]  # fmt: skip
    hidden = lines[3]["people"][1]
    assert hidden["box"] is None and hidden["num_points"] == 0
    assert np.hypot(*(np.mean(hidden["joints"], 0)[:2] - PLACES[1] - 3 * STEPS[1])) < 0.25
    assert len(hidden["spread"]) == 24 and np.mean(hidden["visible"]) == 0


# ---- boxes of many frames


@pytest.mark.parametrize("names", [("a", "b"), (0, 1)])
@pytest.mark.parametrize("form", ["boxes", "poses", "list", "lines"])
def test_frame_boxes_match_frames_by_name_or_number(form, names, tmp_path):
    people = [{"center": [1, 2, 3], "size": [1, 1, 2]}]
    entries = [{"frame": names[0], "people": []}, {"frame": names[1], "people": people}]
    path = tmp_path / "boxes.json"
    if form in ("boxes", "poses"):
        path = tmp_path / "boxes"
        path.mkdir()
        (path / f"{names[0]}.json").write_text(json.dumps({"people": []}))
        (path / f"{names[1]}.{form}.json").write_text(json.dumps({"people": people}))
    else:
        path.write_text("\n".join(map(json.dumps, entries)) if form == "lines" else json.dumps(entries))
    boxes = FrameBoxes(path)
    frames = [Frame(points=np.zeros((0, 3)), index=k, id=id) for k, id in enumerate("abc")]
    assert boxes.of(frames[0]) == [] and boxes.of(frames[2]) is None
    (box,) = boxes.of(frames[1])
    assert isinstance(box, Box) and box.center.tolist() == [1, 2, 3]
    boxes.check_used("c")


def test_frame_boxes_prefer_json_and_refuse_two_files_of_a_frame(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((50, 3)))
    for x, name in enumerate(("a.boxes.json", "b.json")):
        (tmp_path / name).write_text(json.dumps({"people": [{"center": [x, 0, 0], "size": [1, 1, 2]}]}))
    boxes = FrameBoxes(tmp_path)
    for k, id in enumerate("ab"):
        (box,) = boxes.of(Frame(points=np.zeros((0, 3)), index=k, id=id))
        assert box.center[0] == k
    (tmp_path / "b.poses.json").write_bytes((tmp_path / "b.json").read_bytes())
    with pytest.raises(InputError, match="expected one file of boxes per frame, got b.json and b.poses.json: move"):
        FrameBoxes(tmp_path)
    # a label beside a scan
    (tmp_path / "b.poses.json").unlink()
    np.save(tmp_path / "c.npy", np.zeros((50, 3)))
    (tmp_path / "c.txt").write_text("")
    assert FrameBoxes(tmp_path).of(Frame(points=np.zeros((0, 3)), index=2, id="c")) == []


def test_frame_boxes_do_not_confuse_numbers_and_names(tmp_path):
    """Files 1.pcd to 3.pcd have the numbers 0 to 2."""
    entries = [{"frame": k, "people": [{"center": [k, 0, 0], "size": [1, 1, 2]}]} for k in range(3)]
    entries[1]["people"].append({"box": None, "filled": True, "joints": []})
    (tmp_path / "o.jsonl").write_text("\n".join(map(json.dumps, entries)))
    by_number = {k: [entry["people"][0]] for k, entry in enumerate(entries)}
    for boxes in map(FrameBoxes, (tmp_path / "o.jsonl", by_number)):
        for k in range(3):
            (box,) = boxes.of(Frame(points=np.zeros((0, 3)), index=k, id=str(k + 1)))
            assert box.center[0] == k
    (tmp_path / "w.jsonl").write_text(json.dumps(entries[0] | {"coordinates": "world"}))
    with pytest.raises(InputError, match="write the result without --world"):
        FrameBoxes(tmp_path / "w.jsonl")


def numbered(ids):
    """An empty frame of each id, and boxes at x = n by name, for names n."""
    frames = [Frame(points=np.zeros((0, 3)), index=k, id=id) for k, id in enumerate(ids)]
    return frames, lambda names: FrameBoxes({name: [[int(name), 0, 0, 1, 1, 2, 0]] for name in names})


@given(first=st.integers(0, 30), count=st.integers(1, 30), zeros=st.tuples(st.integers(0, 6), st.integers(0, 6)))
def test_frame_boxes_compare_ids_as_integers(first, count, zeros):
    values = range(first, first + count)
    frames, boxes_by = numbered([f"{n:0{zeros[0]}d}" for n in values])
    boxes = boxes_by(f"{n:0{zeros[1]}d}" for n in values)
    assert [boxes.of(frame)[0].center[0] for frame in frames] == list(values)


def test_frame_boxes_refuse_ids_after_numbers():
    frames, boxes_by = numbered(["07", "08", "09"])
    boxes = boxes_by(["0", "2", "9"])
    assert boxes.of(frames[0])[0].center[0] == 0 and boxes.of(frames[1]) is None
    with pytest.raises(InputError, match="boxes: has boxes for the id of frame 09, but .* found by number: name all"):
        boxes.of(frames[2])
    # the other way around, a frame without boxes does not get those of another one
    boxes = boxes_by(["7", "1"])
    assert boxes.of(frames[0])[0].center[0] == 7 and boxes.of(frames[1]) is None


@pytest.mark.parametrize(
    "content, problem",
    [
        ('{"people": []}', 'expected one entry per frame, {"frame": 0'),
        ('[{"frame": 1, "people": []}, {"frame": 1, "people": []}]', "got 1 twice"),
        ("x", "expected JSON or JSON lines"),
        ("[]", "expected boxes for each frame"),
    ],
)
def test_predict_rejects_boxes_without_frames(content, problem, drive, tmp_path, capsys):
    (tmp_path / "b.json").write_text(content)
    assert main(["predict", str(drive), "--boxes", str(tmp_path / "b.json"), "--out", str(tmp_path / "o.jsonl")]) == 2
    error = capsys.readouterr().err
    assert problem in error and "b.json" in error and error.count("\n") == 1
    assert not list(tmp_path.glob("o.jsonl*"))


# ---- the command line


def test_predict_command_writes_files_and_summary(drive, folder, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["predict", f"{drive}/frame_*.npy", "--start", "0.3", "--format", "csv", "--picture", "--track"]) == 0
    said = capsys.readouterr().err
    assert "4 frames, 6 poses, 2 tracks, 1 damaged -> drive.poses.csv and drive.poses.png" in said
    assert "warning: 1 damaged, first frame 4 (frame_9): " in said
    assert {path.name for path in tmp_path.iterdir()} == {"drive.poses.csv", "drive.poses.png"}
    assert (tmp_path / "drive.poses.png").read_bytes().startswith(b"\x89PNG")
    assert main(["predict", str(drive), "--end", "0.1", "--live", "--out", "-"]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line["frame"] for line in lines] == [0, 1] and lines[1]["people"][0]["track"] == 0
    # a page for printed results
    assert main(["predict", str(drive), "--end", "0.1", "--out", "-", "--html"]) == 0
    assert "2 frames, 4 poses -> drive.poses.html" in capsys.readouterr().err
    assert (tmp_path / "drive.poses.html").is_file()


def test_source_warnings_are_printed_with_picture_option(clouds, tmp_path, monkeypatch, capsys):
    source = moving_source(clouds, times=[0.0, 0.2, 0.1, *np.arange(3, FRAMES) / 10])
    monkeypatch.setattr("lidarpose.io.sources.open_source", lambda *_, **__: source)
    assert main(["predict", "made", "--track", "--picture", "--out", str(tmp_path / "a.jsonl")]) == 0
    assert "warning: moving: time jumps back 1 times" in capsys.readouterr().err


def test_folder_without_readable_scans_is_an_error(tmp_path, capsys):
    for name in "ab":
        (tmp_path / f"{name}.pcd").write_bytes(b"garbage")
    assert main(["predict", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "none of 2 frames can be read, the first: " in capsys.readouterr().err
    assert main(["predict", str(tmp_path), "--out", "-"]) == 2
    assert "none of 2 frames can be read" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_joint_tables_are_not_scans_and_unknown_world_warns(clouds, tmp_path, capsys):
    for k in range(2):
        np.savetxt(tmp_path / f"{k}.csv", clouds[k], fmt="%.3f", delimiter=",")
    words = ["--world", "--format", "csv", "--out", str(tmp_path)]
    for source in (tmp_path, tmp_path / "*.csv"):
        assert main(["predict", str(source), *words]) == 0
        output = capsys.readouterr()
        assert "2 frames, 4 poses" in output.out + output.err
        assert "the sensor's pose in the world is unknown in 2 of 2 frames" in output.err
    assert len(list(tmp_path.glob("*.poses.csv"))) == 1


def test_summary_merges_warnings_that_differ_in_numbers():
    """Example: the direction of a tilted sensor varies slightly about an axis."""
    summary = output.Summary()
    for up in ("-0.342,0.003,0.94", "-0.341,-0.002,0.94", "-0.342,0,0.94", "0.342,0.003,-0.94"):
        summary.add(
            {"people": [], "error": None, "warnings": [f"the ground leans by 20 degrees: confirm it with --up {up}"]}
        )
    (line,) = summary.warning_lines(8)
    assert line.startswith("4 frames: ") and line.endswith("--up -0.342,0.003,0.94")
    summary.add({"people": [], "error": None, "warnings": ["under 5 points"]})
    assert len(summary.warning_lines(8)) == 2


def test_summary_counts_tracks_with_poses():
    people = [{"track": id, "joints": joints, "warnings": []} for id, joints in ((0, [[0, 0, 0]]), (1, None))]
    summary = output.Summary()
    summary.add({"people": people, "error": None, "warnings": []})
    assert summary.poses == 1 and summary.tracks == {0}


@pytest.mark.long
def test_picture_of_single_frame_shows_people(drive, tmp_path, monkeypatch):
    drawn, above = [], []

    def draw(scan, people, **words):
        above.append(scan)
        drawn.extend(people)
        return draw_scan_and_people(scan, people, **words)

    monkeypatch.setattr(picture, "draw_scan_and_people", draw)
    command = ["predict", str(drive), "--track", "--picture", "--out", str(tmp_path / "a.jsonl")]
    assert main([*command, "--end", "0.1"]) == 0 and not drawn
    assert main([*command, "--end", "0.05"]) == 0
    (line,) = (json.loads(text) for text in open(tmp_path / "a.jsonl"))
    assert len(drawn) == len(line["people"]) == 2
    # the view from above has the ids of the cards; for two frames it has only the tracks
    assert [len(panel.tracks) for panel in above] == [2, 2] and above[0].poses is None
    assert [box.id for box in above[1].boxes] == [person["id"] for person in line["people"]]
    np.testing.assert_allclose(above[1].poses.joints, [person["joints"] for person in line["people"]], atol=1e-9)
    for panel, person in zip(drawn, line["people"], strict=True):
        assert panel.label == f"{person['id']} · score {person['score']:.2f}"
        np.testing.assert_allclose(panel.pose.joints, person["joints"], atol=1e-9)
        assert abs(len(panel.points) - person["num_points"]) <= 2 and panel.box.contains(panel.points).all()


class CountingRecording:
    """A recording of 40 frames that can only be read from its beginning; counts the frames that are passed and
    decoded."""

    name, count, warnings = "counting", None, ()

    def __init__(self):
        self.passed = self.decoded = 0

    def lazy_frames(self, first=0):
        for k in range(40):
            self.passed += 1
            if k >= first:
                yield LazyFrame(str(k), k / 10, partial(self.decode, k))

    def decode(self, k):
        self.decoded += 1
        return Sweep(points=np.full((5, 3), k + 1.0), T_world_sensor=np.eye(4))


def test_picture_and_page_read_their_frames_in_one_pass(monkeypatch):
    monkeypatch.setattr(page, "_MOST_FRAMES", 4)
    views = picture.TrajectoryPicture(), page.RecordingPage()
    for k, view in product(range(36), views):
        pose = {"T_world_sensor": np.eye(4).tolist(), "time": k / 10, "up": "z"}
        view.add(pose | {"error": None, "frame": k, "people": []})
    for read, shown in ((views[0]._points, 8), (partial(views[1].render, skeleton=SMPL24, title=""), 3)):
        recording = CountingRecording()
        source = FrameSource(recording)
        recording.passed = 0
        result = read(source)
        assert recording.decoded == shown and recording.passed <= 37
        assert shown != 8 or result[::5, 0].tolist() == [1, 6, 11, 16, 21, 26, 31, 36]


def page_data(path):
    """The data embedded in a page."""
    return json.loads(path.read_text("utf-8").split('id="data">')[1].split("</script>")[0])


def test_recording_page_contains_all_frames(drive, tmp_path):
    assert main(["predict", str(drive), "--track", "--html", "--out", str(tmp_path / "a.jsonl")]) == 0
    lines = [json.loads(text) for text in open(tmp_path / "a.jsonl")]
    lines = [line for line in lines if line["error"] is None]
    text, data = (tmp_path / "a.html").read_text("utf-8"), page_data(tmp_path / "a.html")
    (scan,) = data["scans"]
    assert f'max="{len(lines) - 1}"' in text and not data["people"] and not scan["poses"]
    assert len(scan["frames"]) == len(lines) and 30 <= scan["step"] <= 1000
    nearest = np.inf
    for shown, line in zip(scan["frames"], lines, strict=True):
        assert [pose["name"] for pose in shown["poses"]] == [str(person["track"]) for person in line["people"]]
        assert shown["label"].startswith(f"{line['time']:.2f} s")
        # bones of unsure joints are drawn faintly
        for pose, person in zip(shown["poses"], line["people"], strict=True):
            assert pose["confidence"] == pytest.approx(person["confidence"] or [1] * len(pose["joints"]))
        joints = [np.array(pose["joints"]) for pose in shown["poses"]]
        for own in joints:
            points = np.reshape(shown["points"], (-1, 3))
            nearest = min(nearest, np.linalg.norm(points[:, None] - own, axis=-1).min())
    assert nearest < 100
    # the static points contain no people
    still = np.reshape(scan["points"], (-1, 3))
    pelvis = np.array([pose["joints"][0] for pose in scan["frames"][-1]["poses"]])
    assert len(still) and np.linalg.norm(still[:, None] - pelvis, axis=-1).min() > 300
    heads = text.replace(' class="number"', "")
    assert all(f"<th scope=col>{name}</th>" in heads for name in ("track", "from, s", "to, s", "way, m"))


def test_recording_page_of_crops_moves_points_with_the_person():
    """A crop is one person without a box: all of its points are the person's, none are surroundings."""
    view = page.RecordingPage()
    frames = [np.full((5, 3), k + 1.0) for k in range(3)]
    for k in range(3):
        joints = (np.zeros((24, 3)) + k + 1).tolist()
        person = {"id": 0, "track": 7, "joints": joints, "box": None, "confidence": None, "filled": False}
        # times of a clock
        pose = {"T_world_sensor": None, "time": 1.7e9 + k / 10, "up": "z"}
        view.add(pose | {"error": None, "frame": k, "people": [person]})
    text = view.render(FrameSource(Crops(frames)), SMPL24, title="").decode()
    (scan,) = json.loads(text.split('id="data">')[1].split("</script>")[0])["scans"]
    assert not scan["points"] and [len(frame["points"]) for frame in scan["frames"]] == [15] * 3
    assert [frame["points"][:3] for frame in scan["frames"]] == [f["poses"][0]["joints"][0] for f in scan["frames"]]
    # the page counts from the first frame
    assert [frame["label"].split(",")[0] for frame in scan["frames"]] == ["0.00 s", "0.10 s", "0.20 s"]
    assert "1700000000" not in text and ">0.2<" in text


class Crops:
    """A recording of clouds at 10 Hz."""

    name, warnings = "crops", ()

    def __init__(self, clouds):
        self.clouds, self.count = clouds, len(clouds)

    def lazy_frames(self, first=0):
        for k in range(first, self.count):
            yield LazyFrame(str(k), k / 10, lambda k=k: Sweep(points=self.clouds[k], T_world_sensor=None))


def test_csv_keeps_ids_with_line_breaks(tmp_path):
    ids = ["a\rb", "a\nb", "a\r\nb", "\r", 'a"b', "a,b", "7", "c"]
    pose = Pose(joints=np.ones((24, 3)), skeleton=SMPL24)
    for k, id in enumerate(ids):
        result_files.write_result(tmp_path / f"{k}.csv", [line_of({"pose": pose, "id": id}, {"pose": pose, "id": "x"})])
        table = pandas.read_csv(tmp_path / f"{k}.csv", dtype={"id": str})
        assert table.id.tolist() == [id] * 24 + ["x"] * 24
        assert table.filled.dtype == bool and table.frame.dtype == int and table.track.isna().all()
    # quotes only where they are needed
    assert '"' not in (tmp_path / "7.csv").read_text()


def line_of(*people, frame=0, T_world_sensor=None, is_tracked=False, up="z", **values):
    """A line of a recording with people as arguments of `PersonPose`."""
    poses = [PersonPose(**{"pose": None, "skeleton": SMPL24, "points": np.zeros((9, 3)), "up": up} | p) for p in people]
    poses = Poses(people=tuple(poses), skeleton=SMPL24, up=up, **values)
    about = {"index": frame, "id": str(frame), "time": frame / 10, "is_tracked": is_tracked}
    return FramePoses(poses=poses, T_world_sensor=T_world_sensor, **about).to_dict()


def drawn_of(lines, clouds, monkeypatch):
    """The `ScanPanel` and the cards that the picture of lines over the points of their frames draws."""
    drawn, view = [], picture.TrajectoryPicture()
    monkeypatch.setattr(picture, "draw_scan_and_people", lambda scan, people, **_: drawn.append((scan, people)) or b"")
    for line in lines:
        view.add(json.loads(json.dumps(line)))
    view.draw(FrameSource(Crops(clouds)), title="")
    return drawn[0]


def test_picture_of_recordings_names_axes_and_counts_poses(monkeypatch):
    """As the picture of one scan; the distance of a crop is not known."""
    frames = [np.random.default_rng(0).normal(size=(9, 3))] * 3
    pose = Pose(joints=np.ones((24, 3)), skeleton=SMPL24)
    box = Box(center=[1.0, 0, 9], size=[1, 1, 2])
    moving, _ = drawn_of([line_of({"pose": pose}, up="-y", frame=k) for k in range(3)], frames, monkeypatch)
    in_world, _ = drawn_of(
        [line_of({"pose": pose, "box": box}, up="-y", T_world_sensor=np.eye(4))], frames, monkeypatch
    )
    assert moving.axes == ("z", "-x") and moving.label == "3 poses in 3 frames"
    assert in_world.axes == ("x", "y") and in_world.label == "1 person in 1 frame"
    scan, (card,) = drawn_of([line_of({"pose": pose})], frames, monkeypatch)
    assert scan.sensor is None and np.isnan(card.distance)


@pytest.mark.parametrize("is_world", [False, True])
@pytest.mark.parametrize("frames", [1, 2])
def test_picture_shows_sensor_at_given_position(is_world, frames, monkeypatch):
    """Also where the points are in another frame than the sensor's, moved once more by a known pose."""
    T = rigid_transform(np.eye(3), np.array([100.0, 0, 0])) if is_world else None
    person = {"pose": Pose(joints=np.full((24, 3), 20.0), skeleton=SMPL24)}
    person["box"] = Box(center=[20, 20, 20], size=[1, 1, 2])
    lines = [line_of(person, frame=k, T_world_sensor=T, origin=np.array([20.0, 5, 20])) for k in range(frames)]
    for convert in (lambda line: line, in_world):
        scan, cards = drawn_of(map(convert, lines), [np.full((9, 3), 20.0)] * frames, monkeypatch)
        assert scan.sensor == pytest.approx([120 if is_world else 20, 5])
        assert [card.distance for card in cards] == pytest.approx([15] * (frames == 1))
    lines = [line | {"sensor_origin": None} for line in lines]
    scan, cards = drawn_of(lines, [np.full((9, 3), 20.0)] * frames, monkeypatch)
    assert scan.sensor is None and all(np.isnan(card.distance) for card in cards)


def test_picture_and_page_of_tilted_sensor_are_level(monkeypatch):
    """As the picture of one scan: without the box, which is larger than the person, and with the person's points."""
    rng = np.random.default_rng(0)
    level = np.concatenate([rng.uniform(-0.2, 0.2, (40, 3)) * [1, 1, 4], [[0.7, 0.7, -0.8]] * 9, [[9.0, 0, 0]] * 9])
    R_level_input = rotation_from_up("0.3,0,0.95")
    pose = Pose(joints=np.linspace([0, 0, -0.8], [0, 0, 0.8], 24) @ R_level_input, skeleton=SMPL24)
    person = {"pose": pose, "box": Box(center=[0, 0, 0], size=[2, 2, 2], score=0.7, id=0), "points": level[:40]}
    lines = [line_of(person, frame=k, up="0.3,0,0.95", origin=np.array([0.3, 0, 0.95])) for k in range(2)]
    scan, (card,) = drawn_of(lines[:1], [level @ R_level_input], monkeypatch)
    assert scan.axes == ("x turned level", "y turned level") and card.box is None and card.label == "score 0.70"
    np.testing.assert_allclose(card.points, level[:40], atol=1e-9)
    np.testing.assert_allclose(card.pose.joints[:, :2], 0, atol=1e-4)
    np.testing.assert_allclose(scan.points, level, atol=1e-9)
    scan, _ = drawn_of(lines, [level @ R_level_input] * 2, monkeypatch)
    assert scan.axes == ("x turned level", "y turned level")
    np.testing.assert_allclose(scan.points, level, atol=1e-9)
    np.testing.assert_allclose(scan.sensor, [0, 0], atol=1e-4)
    view = page.RecordingPage()
    view.add(lines[0])
    text = view.render(FrameSource(Crops([level @ R_level_input])), SMPL24, title="").decode()
    (scan,) = json.loads(text.split('id="data">')[1].split("</script>")[0])["scans"]
    joints = np.array(scan["frames"][0]["poses"][0]["joints"])
    assert np.ptp(joints, axis=0).tolist() == [0, 0, 1600] and len(scan["frames"][0]["points"]) == 3 * 40


def test_picture_of_tracks_has_arrows_where_people_face(monkeypatch):
    """A tracked crop has no box that tells its heading."""
    joints = np.zeros((24, 3))
    joints[SMPL24.index("left_hip")], joints[SMPL24.index("right_hip")] = [-0.1, 0, 0], [0.1, 0, 0]
    facing, unknown = (Pose(joints=values, skeleton=SMPL24) for values in (joints, np.zeros((24, 3))))
    for pose in (facing, unknown):
        lines = [line_of({"pose": one, "id": 0}, frame=k, is_tracked=True) for k, one in enumerate((facing, pose))]
        scan, _ = drawn_of(lines, [np.zeros((9, 3))] * 2, monkeypatch)
        assert scan.headings == [pose is facing] and scan.boxes[0].yaw == pytest.approx(np.pi / 2 * (pose is facing))
    turned = [replace(scan, boxes=[replace(scan.boxes[0], yaw=yaw, id=None)]) for yaw in (0.0, np.pi)]
    pictures = [draw_scan_and_people(replace(panel, headings=[k]), []) for panel in turned for k in (False, True)]
    assert pictures[0] == pictures[2] and pictures[1] != pictures[3]


def test_cards_of_single_frame_state_doubts(monkeypatch):
    pose = Pose(joints=np.zeros((24, 3)), skeleton=SMPL24, person=np.array(0.9), second_person=np.array(0.8))
    nobody = replace(pose, person=np.array(0.01))
    for box in (None, Box(center=[0, 0, 0], size=[1, 1, 2])):
        _, cards = drawn_of(
            [line_of({"pose": pose, "box": box}, {"pose": nobody, "box": box})], [np.zeros((9, 3))], monkeypatch
        )
        assert [card.note for card in cards] == ["two people?", "unlike a person"]


def test_page_keeps_surroundings_where_smoothing_added_people():
    """A person who was added in a frame has no box there, and does not take the points of all others."""
    view, points = page.RecordingPage(), np.concatenate([np.ones((9, 3)), np.full((99, 3), 8.0)])
    pose = Pose(joints=np.ones((24, 3)), skeleton=SMPL24)
    line = line_of({"pose": pose, "id": 0, "box": Box(center=[1, 1, 1], size=[1, 1, 2])}, is_tracked=True)
    line["people"].append(line["people"][0] | {"id": 1, "track": 1, "box": None, "num_points": 0, "filled": True})
    view.add(line)
    text = view.render(FrameSource(Crops([points])), SMPL24, title="").decode()
    (scan,) = json.loads(text.split('id="data">')[1].split("</script>")[0])["scans"]
    assert len(scan["points"]) == 3 * 99 and len(scan["frames"][0]["points"]) == 3 * 9


def test_recording_page_limits_number_of_frames(drive, tmp_path, monkeypatch):
    monkeypatch.setattr(page, "_MOST_FRAMES", 2)
    assert main(["predict", str(drive), "--html", "--out", str(tmp_path / "a.jsonl")]) == 0
    lines = [json.loads(text) for text in open(tmp_path / "a.jsonl")]
    times = [line["time"] for line in lines if line["error"] is None]
    labels = [frame["label"].split(",")[0] for frame in page_data(tmp_path / "a.html")["scans"][0]["frames"]]
    # every fourth frame: every second of the six would exceed the limit
    assert labels == [f"{time:.2f} s" for time in times[::4]] and len(labels) == 2


@pytest.mark.parametrize(
    "words, problem",
    [
        (["DRIVE", "DRIVE/.."], "run the command for each folder"),
        (["DRIVE", "--track", "--out", "-"], "use --live"),
        (["DRIVE", "--out", "a.json"], "expected a folder or a file .jsonl or .csv or .parquet, got .json"),
        (["DRIVE", "--crop", "--boxes", "b.json"], "got both"),
        (["DRIVE", "--every", "0"], "every must be"),
        (["DRIVE", "--start", "9"], "has no frames between start and end"),
        (["DRIVE", "--start", "9", "--out", "-"], "has no frames between start and end"),
        (["no*.pcd"], "no file matches the pattern"),
        (["DRIVE", "--calib", "c.txt"], "calib is for boxes"),
        (["DRIVE", "--format", "csv", "--out", "-"], "--out - prints lines of JSON, not csv"),
    ],
)
def test_predict_rejects_invalid_options_in_one_line(words, problem, drive, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["predict", *(word.replace("DRIVE", str(drive)) for word in words)]) == 2
    error = capsys.readouterr().err
    assert problem in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def damaged_states(path, state_path):
    """Contents of an unfinished file and its state after a power cut or a disk error."""
    lines, state = path.read_bytes(), json.loads(state_path.read_text())
    yield lines[:-300] + bytes(300), state
    yield lines[:300] + bytes(300) + lines[600:], state
    yield lines[:-1], state
    damaged = {"last": (None, [1]), "bytes": (-4, -1, 0, "7"), "frames": (9,), "state": ([],), "command": (["c"], None)}
    for key, values in damaged.items():
        for value in values:
            yield lines, state | {key: value}


def test_damaged_unfinished_file_is_restarted(drive, stopped, tmp_path):
    out, fresh = tmp_path / "a.jsonl", tmp_path / "fresh.jsonl"
    words = stopped("--end", 0.2, "--out", out)
    path, state_path = tmp_path / "a.jsonl.part", tmp_path / "a.jsonl.part.json"
    lines, state = path.read_bytes(), json.loads(state_path.read_text())
    for damaged_lines, damaged_state in list(damaged_states(path, state_path)):
        path.write_bytes(damaged_lines)
        state_path.write_text(json.dumps(damaged_state))
        with output.PartFile(out, state["command"]) as part:
            assert part.frames == 0 and not list(part.lines())
    path.write_bytes(lines)
    state_path.write_text(json.dumps(state))
    with output.PartFile(out, state["command"]) as part:
        assert part.frames == 1
    path.write_bytes(lines[:-300] + bytes(300))
    assert run(drive, *words) == run(drive, "--end", 0.2, "--out", fresh)


def test_full_disk_error_names_file(tmp_path, monkeypatch):
    steps = FramePredictor(crop=True, model=lidarpose.load("tiny", tta=1))
    frame = Frame(points=np.ones((9, 3)), index=0, id="a", time=0.0)
    with output.PartFile(tmp_path / "a.jsonl", {}) as part:
        poses = next(steps.predict_all(iter([frame])))

        def full(*_):
            raise OSError(errno.ENOSPC, "No space left on device")

        monkeypatch.setattr(output.os, "replace", full)
        with pytest.raises(InputError, match=r"a.jsonl.part: cannot write .*No space left"):
            part.append(poses, steps.state(), 0)
    assert not list(tmp_path.glob("*.new"))


def test_impossible_sensor_pose_fails_only_its_frame(clouds, model):
    boxes = {k: [[*place, 0, 1, 1, 2, 0] for place in PLACES] for k in range(3)}
    places = [np.eye(4) for _ in range(3)]
    places[1][0, 3] = 1e12
    recording = IndexedRecording(
        name="made", ids=list("abc"), times=None, read=lambda i: Sweep(points=clouds[i], T_world_sensor=places[i])
    )
    frames = list(lidarpose.predict_recording(FrameSource(recording), boxes=boxes, track=True, model=model))
    assert [frame.error is None for frame in frames] == [True, False, True]
    assert "Box.center" in frames[1].error and len(frames[2].poses) == 2


@pytest.mark.parametrize("source", [None, 5, np.zeros((9, 3)), [np.zeros((9, 3))]])
def test_predict_recording_rejects_invalid_sources(source, model):
    with pytest.raises(InputError, match="expected (one or more paths|paths)"):
        lidarpose.predict_recording(source, model=model)


def test_predict_recording_rejects_unknown_option():
    with pytest.raises(TypeError, match="predict_recording.. got an unexpected keyword argument 'min_scor'"):
        lidarpose.predict_recording("nowhere", min_scor=0.5)


# ---- frames of a live sensor


def fed(clouds, buffer=None):
    """Frames of clouds; with `buffer`, all frames share this array, which is overwritten."""
    for k, cloud in enumerate(clouds):
        if buffer is not None:
            buffer[:] = cloud
        yield lidarpose.Frame(points=cloud if buffer is None else buffer, index=k, id=str(k), time=k / 10)


def test_live_frames_are_predicted_one_by_one(model):
    rng = np.random.default_rng(0)
    clouds = [rng.normal((5, 0, 0), (0.2, 0.2, 0.5), (99, 3)) for _ in range(3)]
    expected = [model.predict(cloud).joints for cloud in clouds]
    buffer = np.zeros((99, 3), np.float64)
    for frames in (fed(clouds), list(fed(clouds)), fed(clouds, buffer)):
        results = list(lidarpose.predict_recording(frames, crop=True, model=model, up=None))
        assert [result.id for result in results] == ["0", "1", "2"]
        for result, cloud, joints in zip(results, clouds, expected, strict=True):
            np.testing.assert_array_equal(result.poses[0].points, cloud)
            np.testing.assert_allclose(result.poses[0].joints, joints, atol=1e-6)


def test_scan_is_copied_from_reused_buffer(model, monkeypatch):
    buffer = np.zeros((400, 3), np.float64)
    clouds = [np.full((400, 3), k) + np.arange(1200).reshape(400, 3) / 100 for k in (1.0, 2.0, 3.0)]
    results = list(lidarpose.predict_recording(fed(clouds, buffer), find=True, model=model))
    for result, cloud in zip(results, clouds, strict=True):
        np.testing.assert_array_equal(result.poses.scan, cloud)


def test_frames_copy_sensor_poses_and_make_rotations_exact():
    T = np.eye(4)
    T[:3, :3] = 1.004 * rotation_about("z", 0.3)
    origin = np.zeros(3)
    frame = Frame(points=np.zeros((0, 3)), index=0, id="a", T_world_sensor=T, origin=origin)
    T[0, 3] = origin[0] = 7.0
    np.testing.assert_allclose(frame.T_world_sensor[:3, :3], rotation_about("z", 0.3), atol=1e-12)
    assert repr(frame) == "Frame(0, 'a', 0 points)"
    assert repr(replace(frame, time=1.7e9 + 0.2)) == "Frame(0, 'a', 0 points, t=1700000000.2 s)"
    assert frame.T_world_sensor[0, 3] == frame.origin[0] == 0.0


@pytest.mark.parametrize(
    "stated, option, expected",
    [
        ({}, None, [0, 0, 0]),
        ({"is_origin_unknown": True}, None, None),
        ({"is_origin_unknown": True}, (1, 2, 3), [1, 2, 3]),
        ({"origin": (4, 5, 6)}, None, [4, 5, 6]),
    ],
)
def test_unknown_sensor_position_stays_unknown(model, stated, option, expected):
    frame = Frame(points=np.ones((9, 3)), index=0, id="0", **stated)
    boxes = {0: [[1, 1, 1, 1, 1, 2, 0]]}
    (result,) = lidarpose.predict_recording([frame], model=model, boxes=boxes, sensor_origin=option)
    assert (None if result.poses.origin is None else result.poses.origin.tolist()) == expected
    assert result.to_dict()["sensor_origin"] == expected


def test_first_frame_of_paths_has_warnings_about_source(model, tmp_path):
    for name in "ab":
        np.save(tmp_path / f"{name}.npy", np.random.default_rng(0).normal(scale=0.3, size=(99, 3)))
    first, second = lidarpose.predict_recording(tmp_path, crop=True, model=model)
    assert "has no times: read as 10 frames per second" in first.poses.warnings[0] and not second.poses.warnings


def test_predict_recording_checks_generators_and_their_options(model, tmp_path):
    np.save(tmp_path / "a.npy", np.random.default_rng(0).normal(scale=0.3, size=(99, 3)))
    assert len(list(lidarpose.predict_recording(tmp_path.glob("*.npy"), crop=True, model=model))) == 1
    with pytest.raises(InputError, match="expected paths or frames, got ndarray: make a lidarpose.Frame"):
        lidarpose.predict_recording(iter([np.zeros((9, 3))]), model=model)
    reading = ({"columns": 4}, {"topic": "/x"}, {"meta": "none.json"})
    for option in ({"every": 2}, {"start": 1.0}, {"end": 1.0}, {"rate": 5.0}, *reading):
        for source in (fed([np.ones((9, 3))]), lidarpose.open_source(tmp_path)):
            with pytest.raises(InputError, match=f"^{next(iter(option))} is for paths, got frames"):
                lidarpose.predict_recording(source, model=model, **option)


@pytest.mark.parametrize(
    "T", [np.eye(3), 2 * np.eye(4), np.full((4, 4), np.nan), np.diag([1, 1, -1, 1]), "pose", [[1]]]
)
def test_frame_rejects_pose_that_is_not_rigid(T):
    with pytest.raises(InputError, match=r"^Frame.T_world_sensor: expected \(4, 4\)[^\n]*: give None"):
        lidarpose.Frame(points=np.zeros((0, 3)), index=0, id="0", T_world_sensor=T)
    frame = lidarpose.Frame(points=np.zeros((0, 3)), index=0, id="0", T_world_sensor=np.eye(4).tolist())
    np.testing.assert_array_equal(frame.T_world_sensor, np.eye(4))


@pytest.mark.parametrize(
    "wrong",
    [
        {"origin": (0, 0)}, {"origin": "unknown"}, {"origin": [0, 0, np.nan]}, {"index": 0.5}, {"index": -1},
        {"time": "a"}, {"time": np.nan}, {"time": 1.7e18}, {"time": np.datetime64("2026-01-01T00:00:00")},
    ],
)  # fmt: skip
def test_frame_rejects_invalid_position_index_and_time(wrong):
    (name,) = wrong
    with pytest.raises(InputError, match=rf"^Frame\.{name}[^\n]*$"):
        lidarpose.Frame(points=np.zeros((0, 3)), **({"index": 0, "id": "0"} | wrong))


def test_results_of_frames_with_numpy_values_are_json(model):
    frame = lidarpose.Frame(points=np.zeros((0, 3)), index=np.int64(3), id="3", time=np.float32(0.5), origin=(0, 0, 1))
    (result,) = lidarpose.predict_recording([frame], model=model)
    line = json.loads(json.dumps(result.to_dict()))
    assert (line["frame"], line["time"]) == (3, 0.5) and frame.origin.tolist() == [0, 0, 1]


def test_close_does_not_wait_for_next_frame(model):
    cloud, is_over = np.random.default_rng(0).normal(scale=0.3, size=(99, 3)), threading.Event()

    def endless():
        yield from fed([cloud])
        is_over.wait(60)

    others = threading.enumerate()
    frames = lidarpose.predict_recording(endless(), crop=True, model=model)
    next(frames)
    start = time.perf_counter()
    frames.close()
    assert time.perf_counter() - start < 20
    # nor does the interpreter wait without a limit at its end, and no thread is left when the frame comes
    (thread,) = (thread for thread in threading.enumerate() if thread not in others)
    assert thread.daemon
    is_over.set()
    thread.join(20)
    assert not thread.is_alive()


def test_end_of_program_waits_for_frame_being_read(monkeypatch):
    ends, read, is_over = [], [], threading.Event()
    monkeypatch.setattr("atexit.register", ends.append)

    def frames(pause):
        yield 1
        pause(0.1)
        read.append(2)

    # the loop may still be open, for example in a traceback
    slow, endless = (_one_ahead(frames(pause)) for pause in (time.sleep, lambda _: is_over.wait(60)))
    assert next(slow) == 1
    ends[0]()
    assert read == [2]
    monkeypatch.setattr("lidarpose.recording.predict_recording._MAX_WAIT", 0.01)
    assert next(endless) == 1
    ends[1]()
    assert read == [2]
    is_over.set()


def test_boxes_of_unknown_frames_raise_at_the_end(model):
    boxes = {"b": [[0, 0, 0, 1, 1, 2, 0]]}
    frames = lidarpose.predict_recording(fed([np.ones((9, 3))]), boxes=boxes, model=model)
    with pytest.raises(InputError, match="has boxes of frames b, but this recording has other frames, the last one 0"):
        list(frames)


def test_boxes_of_one_scan_are_rejected_for_recording(tmp_path, model):
    path = tmp_path / "a.boxes.json"
    Boxes([Box(center=np.zeros(3), size=np.ones(3))]).save(path)
    with pytest.raises(InputError, match="a.boxes.json: expected one entry per frame.*one box file is one scan"):
        next(iter(lidarpose.predict_recording(fed([np.ones((9, 3))]), boxes=path, model=model)))


def test_tracks_are_smoothed_at_the_end_unless_live(model, tmp_path, monkeypatch):
    crop, asked = np.random.default_rng(0).normal((5, 0, 0), (0.2, 0.2, 0.5), (99, 3)), []
    monkeypatch.setattr(output, "smoothed_lines", lambda lines, *_, **given: asked.append(given) or lines())
    box = Box(center=(5, 0, 0), size=(1, 1, 2), score=0.1)
    for options in ({}, {"live": True}, {"track": True}, {"boxes": {0: [box]}, "track": True}):
        predictor = FramePredictor(model=model, crop="boxes" not in options, **options)
        output.write_recording(FrameSource(Crops([crop])), predictor, tmp_path / "a.jsonl", command={})
    assert asked == [{"are_boxes_given": False}, {"are_boxes_given": True}]


def test_given_boxes_of_any_score_are_tracked_at_ten_frames_a_second(model):
    """If frames have no times."""
    cloud = np.random.default_rng(0).normal((5, 0, 0), (0.2, 0.2, 0.5), (99, 3))
    steps = [np.array([0.1 * k, 0, 0]) for k in range(8)]
    boxes = {k: [Box(center=step + [5, 0, 0], size=(1, 1, 2), score=0.1)] for k, step in enumerate(steps)}
    frames = [Frame(index=k, id=str(k), points=cloud + step, warnings=(f"w{k}",)) for k, step in enumerate(steps)]
    *_, last = lidarpose.predict_recording(frames, boxes=boxes, track=True, model=model)
    assert [person.id for person in last.poses] == [0] and "w7" in last.poses.warnings
    assert last.poses[0].velocity[0] == pytest.approx(1.0, abs=0.2)


def test_summary_keeps_the_first_error():
    summary = output.Summary()
    for k in range(3):
        summary.add({"people": [], "error": f"no {k}", "warnings": [], "frame": k, "id": "a"})
    assert summary.warning_lines(1) == ["3 damaged, first frame 0 (a): no 0"] and summary.in_world == 0


def test_page_lists_ways_and_durations():
    view = page.RecordingPage()
    for k in range(3):
        pose = Pose(joints=np.full((24, 3), [0.5 * k, 0.0, 1.0]), skeleton=SMPL24)
        view.add(line_of({"pose": pose, "id": 0}, frame=2 * k, is_tracked=True))
    assert view._tracks[0].way == pytest.approx(1.0) and view._step() == pytest.approx(200)


def test_page_gives_people_with_boxes_their_points_where_their_pose_was_filled_in():
    view, points = page.RecordingPage(), np.concatenate([np.ones((9, 3)), np.full((99, 3), 8.0)])
    pose = Pose(joints=np.ones((24, 3)), skeleton=SMPL24)
    line = line_of({"pose": pose, "id": 0, "box": Box(center=[1, 1, 1], size=[1, 1, 2])}, is_tracked=True)
    line["people"][0]["filled"] = True
    view.add(line)
    text = view.render(FrameSource(Crops([points])), SMPL24, title="").decode()
    (scan,) = json.loads(text.split('id="data">')[1].split("</script>")[0])["scans"]
    assert len(scan["points"]) == 3 * 99 and len(scan["frames"][0]["points"]) == 3 * 9


def test_paths_are_those_of_the_middle_of_people(monkeypatch):
    drawn, view = [], picture.TrajectoryPicture()
    monkeypatch.setattr(picture, "draw_scan_and_people", lambda scan, people, **_: drawn.append(scan) or b"")
    for k in range(2):
        pose = Pose(joints=np.linspace([k, 1.0, 0.0], [k + 0.4, 2.0, 1.8], 24), skeleton=SMPL24)
        view.add(line_of({"pose": pose, "id": 3}, frame=k, is_tracked=True))
    view.draw(FrameSource(Crops([np.zeros((9, 3))] * 2)), title="")
    np.testing.assert_allclose(drawn[0].tracks, [[[0.2, 1.5, 0.9], [1.2, 1.5, 0.9]]], atol=1e-4)
