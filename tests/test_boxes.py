"""Reading and writing of boxes: accepted input, and error messages of one line."""

import copy
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from hostile_files import KITTI, npy, npy_header, refusal
from hypothesis import given, settings, strategies as st

import lidarpose
from lidarpose.errors import InputError
from lidarpose.geometry import axis_angle_to_matrix
from lidarpose.io.boxes import Boxes, read_boxes
from lidarpose.sample import Box

PERSON = {"center": [10.0, -2.0, 0.5], "size": [0.6, 0.7, 1.8], "yaw": 0.3, "id": "a"}

meters = st.floats(-1e6, 1e6)
people = st.lists(
    st.fixed_dictionaries(
        {
            "center": st.lists(meters, min_size=3, max_size=3),
            "size": st.lists(st.floats(1e-3, 99), min_size=3, max_size=3),
        },
        optional={
            "yaw": st.none() | st.floats(-7, 7),
            "id": st.none() | st.text() | st.integers(),
            "track": st.none() | st.text() | st.integers(),
            "category": st.text(),
        },
    ),
    max_size=4,
)


def _id_of(person):
    return next((person[key] for key in ("id", "track") if person.get(key) is not None), None)


def _have_own_ids(people):
    ids = [_id_of(person) for person in people if _id_of(person) is not None]
    return len(set(ids)) == len(ids)


@pytest.mark.long
@settings(max_examples=80, deadline=None)
@given(people=people.filter(_have_own_ids), bare=st.booleans(), bom=st.booleans())
def test_read_boxes_gives_equal_boxes_from_file_and_structure(tmp_path_factory, people, bare, bom):
    path = tmp_path_factory.mktemp("boxes", numbered=True) / "boxes.json"
    content = people if bare else {"people": people, "frame": "lidar"}
    path.write_text(json.dumps(content), encoding="utf-8-sig" if bom else "utf-8")
    before = copy.deepcopy(content)
    for boxes in (read_boxes(path), read_boxes(str(path)), read_boxes(content)):
        assert len(boxes) == len(people)
        for box, person in zip(boxes, people, strict=True):
            np.testing.assert_array_equal(box.center, person["center"])
            np.testing.assert_array_equal(box.size, person["size"])
            assert box.yaw == (person.get("yaw") or 0.0)
            assert box.id == _id_of(person)
    assert content == before


def test_read_boxes_accepts_arrays_and_numpy_numbers():
    (box,) = read_boxes(
        [{"center": np.array([1, 2, 3]), "size": (np.float32(1), 2, np.int64(3)), "yaw": np.float64(1)}]
    )
    assert box.center.tolist() == [1, 2, 3] and box.size.tolist() == [1, 2, 3] and box.yaw == 1


def test_boxes_save_and_read_round_trip(tmp_path):
    box = Box(center=[1.0, -2.0, 0.25], size=[0.6, 0.7, 1.8], yaw=0.3, id=0, score=np.float32(0.75), mounted=True)
    for boxes in ([box], []):
        Boxes(boxes, source="a.pcd", warnings=["odd"], detector="1").save(tmp_path / "boxes.json")
        read = read_boxes(tmp_path / "boxes.json")
        assert [vars(b) | {"center": 0, "size": 0} for b in read] == [vars(b) | {"center": 0, "size": 0} for b in boxes]
        assert all((b.center == box.center).all() and (b.size == box.size).all() for b in read)
    assert json.loads((tmp_path / "boxes.json").read_text())["warnings"] == ["odd"]


def test_boxes_slice_saves_same_document(tmp_path):
    found = Boxes([Box(center=[i, 0, 0], size=[1, 1, 2], id=i) for i in range(3)], source="a.pcd", detector="1")
    found[1:].save(tmp_path / "boxes.json")
    whole = found.to_dict()
    assert json.loads((tmp_path / "boxes.json").read_text()) == whole | {"people": whole["people"][1:]}
    assert found[1].id == 1 and found[-1] is found[2]


def test_read_boxes_takes_up_only_from_own_files():
    ours = Boxes([], up="0.1,0.2,0.97").to_dict()
    assert read_boxes(ours).up == "0.1,0.2,0.97" and read_boxes({"people": []}).up == "z"
    assert read_boxes({"people": [], "up": [0, 0, 9]}).up == "z"
    for up in ("w", [0, 1, 0], None, "0,0,0"):
        assert "up: expected z, y, x" in refusal(read_boxes, ours | {"up": up})


def test_read_boxes_ignores_scores_of_other_detectors():
    for score in (12.5, -1, "high", None, math.nan, [1], True):
        assert read_boxes([{**PERSON, "score": score, "mounted": "no"}])[0].score is None
    assert read_boxes([{**PERSON, "score": 1}])[0].score == 1.0
    for score in (1.5, "0.5", math.nan):
        with pytest.raises(InputError, match="Box.score must be a probability"):
            Box(center=[0, 0, 0], size=[1, 1, 1], score=score)


def test_read_boxes_accepts_no_people():
    assert read_boxes([]) == read_boxes({"people": []}) == []


ROW = [10.0, -2.0, 0.5, 0.6, 0.7, 1.8, 0.3]


def fields(box):
    return [*box.center.tolist(), *box.size.tolist(), box.yaw]


def test_read_boxes_accepts_rows_of_seven_numbers(tmp_path, monkeypatch):
    rows = np.array([ROW, [1, 2, 3, 0.5, 0.6, 1.7, -1]])
    (tmp_path / "boxes.npy").write_bytes(npy(rows))
    (tmp_path / "boxes.json").write_text(json.dumps(rows.tolist()))
    (tmp_path / "people.json").write_text(json.dumps({"people": rows.tolist()}))
    files = [tmp_path / name for name in ("boxes.npy", "boxes.json", "people.json")]
    tensor = torch.tensor(rows, requires_grad=True)
    for source in (rows, rows.astype("f4"), rows.tolist(), tensor, {"people": rows}, tuple(rows), *files):
        boxes = read_boxes(source)
        np.testing.assert_allclose([fields(box) for box in boxes], rows, rtol=1e-6)
        assert [box.id for box in boxes] == [None, None]
    assert read_boxes(np.empty((0, 7))) == []
    monkeypatch.chdir(tmp_path)
    Path("boxes").write_text("[]")
    assert read_boxes("boxes") == []


def test_read_boxes_accepts_mixed_entries():
    box = Box(center=[1, 2, 3], size=[1, 1, 2], id="b")
    (alone,) = read_boxes(box)
    mixed = read_boxes([PERSON, box, ROW, np.array(ROW)])
    assert alone is box and mixed[1] is box
    assert fields(mixed[0]) == fields(mixed[2]) == fields(mixed[3]) == ROW


def rotation(axis, angle):
    return axis_angle_to_matrix(angle * np.eye(3)["xyz".index(axis)])


@pytest.mark.parametrize("tracking", [False, True])
def test_read_boxes_converts_kitti_labels_to_lidar_frame(tmp_path, tracking):
    """The label is written from boxes in the LiDAR's frame by the forward transform."""
    # the camera looks forward: its x, y, z are -y, -z, x of the LiDAR, slightly rotated
    R_cam_velo = rotation("x", 0.02) @ np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0.0]])
    t_cam_velo = np.array([0.03, -0.08, -0.27])
    rectify = rotation("y", 0.01) @ rotation("z", -0.008)
    rows = np.array(
        [[12.0, 3.0, -0.8, 0.6, 0.7, 1.8, 0.4], [7, -2, -0.7, 1.8, 0.6, 1.7, -2.5], [5, 0, -1, 0.8, 0.8, 1.2, 3]]
    )
    lines = ["Car 0 0 0 1 2 3 4 1.5 1.6 4 1 2 3 0", "DontCare -1 -1 -10 1 2 3 4 -1 -1 -1 -1000 -1000 -1000 -10"]
    for kind, (x, y, z, length, width, height, yaw) in zip(
        ("Pedestrian", "Cyclist", "Person_sitting"), rows, strict=True
    ):
        foot = rectify @ (R_cam_velo @ [x, y, z] + t_cam_velo) + [0, height / 2, 0]
        ahead = rectify @ R_cam_velo @ [np.cos(yaw), np.sin(yaw), 0]
        values = [height, width, length, *foot, np.arctan2(-ahead[2], ahead[0])]
        lines.append(
            f"{kind} 0 0 0 1 2 3 4 " + " ".join(f"{value:.6f}" for value in values) + " 0.9" * (kind == "Cyclist")
        )
    for folder in ("label_2", "calib"):
        (tmp_path / folder).mkdir()
    label, calib = tmp_path / "label_2" / "000001.txt", tmp_path / "calib" / "000001.txt"
    label.write_text("\n".join(lines) + "\n")
    names = ("R_rect", "Tr_velo_cam") if tracking else ("R0_rect:", "Tr_velo_to_cam:")
    matrices = (rectify, np.column_stack([R_cam_velo, t_cam_velo]))
    texts = [f"{n} {' '.join(f'{v:.9e}' for v in m.ravel())}" for n, m in zip(names, matrices, strict=True)]
    calib.write_text("P0: 1 0 0\n" + "\n".join(texts) + "\n")
    boxes = read_boxes(label)
    # the vertical axes of camera and LiDAR differ: 4 cm and a degree at most
    np.testing.assert_allclose([fields(box) for box in boxes], rows, atol=0.04)
    np.testing.assert_allclose([box.size for box in boxes], rows[:, 3:6], atol=1e-6)
    np.testing.assert_allclose([box.center for box in boxes], rows[:, :3], atol=1e-5)
    # only result files have scores
    assert [(box.score, box.mounted) for box in boxes] == [(None, False), (0.9, True), (None, False)]
    assert [fields(box) for box in read_boxes(label, calib=calib)] == [fields(box) for box in boxes]

    for text, words in (
        (texts[0], ["expected Tr_velo_to_cam: with 12 numbers, got R"]),
        (texts[0].replace("e", "x") + "\n" + texts[1], ["expected R0_rect: with 9 numbers"]),
        (texts[1] + "\n" + names[0] + " 1 1 0 0 1 0 0 0 1", ["expected a rotation as R0_rect"]),
    ):
        calib.write_text(text)
        refusal(read_boxes, label, words=[f"{calib}: ", *words])
    for empty in ("\n".join(lines[:2]), "", " \n"):
        label.write_text(empty)
        assert read_boxes(label, calib=tmp_path / "none.txt") == []


def test_kitti_label_in_root_folder_has_no_calibration(monkeypatch):
    monkeypatch.setattr("lidarpose.io.boxes.read_bytes", lambda *_, **__: KITTI)
    with pytest.raises(InputError, match="expected its calibration at /calib/label.txt"):
        read_boxes("/label.txt")


def changed(**changes):
    """Two people, the second with changes; a value of ... removes the key."""
    person = {key: value for key, value in {**PERSON, **changes}.items() if value is not ...}
    return {"people": [PERSON, person]}


BAD = {
    "one box alone": (PERSON, ["got one box alone: put it in a list"]),
    "no people": ({"peoples": [], "frame": "a"}, ['"people"', "peoples, frame", "rename 'peoples'"]),
    "empty": ({}, ['"people"', "{}"]),
    "people a number": ({"people": 3}, ["got 3"]),
    "people an object": ({"people": PERSON}, ["list of people", "center"]),
    "entry a number": ([PERSON, 3], ["people[1]", "got 3"]),
    "no center": (changed(center=...), ["people[1]", '"center"', "[x, y, z]", "size, yaw, id"]),
    "centre": (changed(center=..., centre=[1, 2, 3]), ["people[1]", "rename 'centre'"]),
    "no size": (changed(size=...), ["people[1]", '"size"', "[length, width, height]"]),
    "text in center": (changed(center=[1, "2", 3]), ["people[1].center", '[1, "2", 3]']),
    "text as center": (changed(center="123"), ["people[1].center", '"123"']),
    "boolean in center": (changed(center=[1, True, 3]), ["people[1].center", "[1, true, 3]"]),
    "numpy boolean": (changed(center=[1, np.True_, 3]), ["people[1].center"]),
    "two numbers": (changed(center=[1, 2]), ["people[1].center", "[1, 2]"]),
    "four numbers": (changed(size=[1, 2, 3, 4]), ["people[1].size", "[1, 2, 3, 4]"]),
    "a number": (changed(size=1), ["people[1].size", "got 1"]),
    "null": (changed(size=None), ["people[1].size", "null"]),
    "object": (changed(center={"x": 1, "y": 2, "z": 3}), ["people[1].center", '"x"']),
    "pose of a crop": ({"people": [{"id": 0, "box": None}]}, ["people[0].box", "got null", "has no box"]),
    "pose, id": ({"people": [{"id": 1.5, "box": PERSON}]}, ["people[0].id", "whole number"]),
    "pose": ({"people": [{"id": 0, "box": {"center": [0, 0]}}]}, ["people[0].box.center", "three finite numbers"]),
    "nested": (changed(center=[[1, 2, 3]]), ["people[1].center"]),
    "nan": (changed(center=[1, math.nan, 3]), ["people[1].center", "finite", "NaN"]),
    "infinite": (changed(size=[1, math.inf, 3]), ["people[1].size", "finite"]),
    "beyond floats": (changed(center=[1, 10**400, 3]), ["people[1].center"]),
    "negative size": (changed(size=[1, -2, 3]), ["people[1].size", "positive", "[1.0, -2.0, 3.0]"]),
    "zero size": (changed(size=[1, 0, 3]), ["people[1].size", "positive"]),
    "text as yaw": (changed(yaw="north"), ["people[1].yaw", "radians", '"north"']),
    "boolean yaw": (changed(yaw=False), ["people[1].yaw", "false"]),
    "nan yaw": (changed(yaw=math.nan), ["people[1].yaw", "NaN"]),
    "degrees": (changed(yaw=90), ["people[1].yaw", "got 90", "pi / 180"]),
    "id twice": (changed(), ["people[1].id", 'got "a", which people[0] also has']),
    "ids of one text": ([{**PERSON, "id": 1}, {**PERSON, "id": "1"}], ["people[1].id", 'got "1", which people[0]']),
    "seven with text": ([ROW, [1, 2, 3, 4, 5, "6", 7]], ["people[1].size"]),
    "six numbers": ([ROW[:6]], ["people[0]", "[x, y, z, l, w, h, yaw]"]),
    "row alone": (ROW, ["got one row of numbers: put it in a list, [row]"]),
    "array of one row": (np.array(ROW), ["put it in a list, [row]"]),
    "array of nothing": (np.array(3.0), ["list of people", "got 3.0"]),
    "list as id": (changed(id=[1]), ["people[1].id", "[1]"]),
    "boolean id": (changed(id=True), ["people[1].id", "true"]),
    "fraction as track": (changed(id=None, track=1.5), ["people[1].track", "1.5"]),
}


@pytest.mark.parametrize("case", BAD)
def test_read_boxes_rejects_bad_structure(case):
    content, words = BAD[case]
    refusal(read_boxes, content, words=["boxes: ", *words])


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", ["is empty"]),
        (b"\n", ["is not JSON", "line 2, column 1"]),
        (b'{"people": [\n  {"center": [1, 2 3]}\n]}', ["is not JSON", "line 2, column 20"]),
        (b'{"people": [{"center": [1', ["is not JSON", "line 1, column 26"]),
        (
            b"center,size\n1,2\n",
            ['expected JSON {"people": [{"center": [x, y, z], "size"', "got text: write the boxes"],
        ),
        (b"Pedestrian 0 0 -0.2 712 143 810 307 1.89 0.48 1.2 1.84 1.47 8.41\n", ["got text"]),
        (KITTI, ["is a KITTI label: expected its calibration at", "calib/boxes.json", "put it there or give its path"]),
        (KITTI.replace(b" 8.41", b" nan"), ["got text"]),
        (KITTI + KITTI.replace(b" 8.41", b" far"), ["15 values on line 2, got 'Pedestrian 0 0 -0.2"]),
        (npy(np.zeros((2, 8))), ["people[0]", "[x, y, z, l, w, h, yaw]"]),
        (npy(np.zeros((2, 7))), ["people[0].size", "positive"]),
        (npy(np.zeros((2, 7)))[:-1], ["cut off"]),
        (npy_header((2**70, 0)), ["an array (n, 3+), got the shape"]),
        (b'{"people": "\xe4"}', ["UTF-8"]),
        (b"[" * 100_000, ["JSON"]),
        (b"[" + b"9" * 5000 + b"]", ["JSON"]),
        (b'"people"', ["list of people"]),
        (b"null", ["list of people", "null"]),
        (b'[{"center": [1, NaN, 2], "size": [1, 1, 1]}]', ["people[0].center", "finite"]),
        (b'[{"center": [1, 2, 3], "size": [1, 1, 1], "id": {"\\n": 2}}]', ["people[0].id"]),
    ],
)
def test_read_boxes_rejects_bad_files(tmp_path, content, words):
    path = tmp_path / "boxes.json"
    path.write_bytes(content)
    refusal(read_boxes, path, words=[f"{path}: ", *words])


def test_read_boxes_rejects_bad_paths(tmp_path):
    for path, word in (
        (tmp_path / "gone.json", "no such file"),
        (tmp_path, "folder"),
        (3, "expected the path"),
        (None, "path"),
    ):
        refusal(read_boxes, path, words=[word])


def test_selected_boxes_keep_up_axis():
    tilted = Boxes([Box(center=[5, 0, 0], size=[1, 1, 2], id=id) for id in "ab"], up="-y")
    for some in (
        [box for box in tilted if box.id == "a"],
        tilted.copy(),
        tilted + [],
        sorted(tilted, key=lambda b: b.id),
    ):
        assert read_boxes(some).up == "-y" and "up" not in read_boxes(some).to_dict()["people"][0]
    other = Box(center=[9, 0, 0], size=[1, 1, 2])
    assert read_boxes([other]).up == read_boxes(Boxes([other])).up == "z" and other.up is None
    for some in (
        tilted[0],
        {"people": [tilted[0]]},
        np.array([tilted[0]], object),
        [*tilted, other],
        Boxes(list(tilted)),
    ):
        assert read_boxes(some).up == "-y"
    with pytest.raises(InputError, match=r"boxes with the same up axis, got -y, x: give the boxes of one scan"):
        read_boxes([*tilted, Box(center=[9, 0, 0], size=[1, 1, 2], up="x")])
    with pytest.raises(InputError, match="expected boxes with the same up axis"):
        Boxes([*tilted, Box(center=[9, 0, 0], size=[1, 1, 2], up="x")])
    assert Box(center=[9, 0, 0], size=[1, 1, 2], up=[0, 1, 0]).up == "0.0,1.0,0.0"
    with pytest.raises(InputError, match="up: expected z"):
        Box(center=[9, 0, 0], size=[1, 1, 2], up="upwards")


def test_box_mounted_is_true_false_or_none():
    box = Box(center=[0, 0, 0], size=[1, 1, 1], mounted=np.bool_(True))
    assert box.mounted is True and json.loads(Boxes([box]).to_json())["people"][0]["mounted"] is True
    entry = {"center": [0, 0, 0], "size": [1, 1, 1]}
    assert [read_boxes([entry | {"mounted": m}])[0].mounted for m in (np.bool_(False), "yes", 1)] == [False, None, None]
    with pytest.raises(InputError, match=r"Box.mounted must be true, false or None, got 'yes'"):
        Box(center=[0, 0, 0], size=[1, 1, 1], mounted="yes")


def test_read_boxes_accepts_bfloat16_and_rejects_open_files(tmp_path):
    rows = torch.tensor([[5.0, 0, 0, 1, 1, 2, 0]], dtype=torch.bfloat16, requires_grad=True)
    assert read_boxes(rows)[0].center.tolist() == [5, 0, 0]
    (tmp_path / "b.json").write_text("[]")
    with open(tmp_path / "b.json") as file:
        with pytest.raises(InputError, match="expected the path of a file of boxes"):
            read_boxes(file)
        assert file.read() == "[]"


def test_to_dict_gives_up_per_box_or_once_per_document(tmp_path):
    (box,) = boxes = Boxes([Box(center=[0, 0, 0], size=[1, 1, 2])], up="-y")
    assert box.to_dict()["up"] == "-y" and "up" not in boxes.to_dict()["people"][0]
    assert read_boxes([box.to_dict()]).up == read_boxes(boxes.to_dict()).up == "-y"
    assert "up" not in Box(center=[0, 0, 0], size=[1, 1, 2]).to_dict()
    # other values of `up`, written by other tools, are ignored
    assert read_boxes([box.to_dict() | {"up": True}]).up == "z"
    with pytest.raises(InputError, match="b.txt: is written as JSON"):
        boxes.save(tmp_path / "b.txt")


def test_boxes_rejects_rows():
    with pytest.raises(InputError, match=r"expected objects of type Box, got list: convert with lidarpose.read_boxes"):
        Boxes([[0, 0, 0, 1, 1, 2, 0]])


def test_box_to_dict_keeps_known_values():
    box = Box(center=np.zeros(3), size=np.ones(3), yaw=0.5, id="a", score=0.75, mounted=False, up="y")
    assert vars(read_boxes([box.to_dict()])[0]).keys() == vars(box).keys()
    result = read_boxes([box.to_dict()])[0]
    assert (result.id, result.score, result.mounted, result.up) == ("a", 0.75, False, "y")
    assert Box(center=np.zeros(3), size=np.ones(3)).to_dict().keys() == {"center", "size", "yaw"}


def test_stated_up_axis_is_checked():
    boxes = read_boxes({"schema": "lidarpose.boxes/1", "up": "z", "people": [[0, 0, 0, 1, 1, 2, 0]]})
    assert boxes.has_up and boxes[:1].has_up and read_boxes(boxes).has_up
    assert not read_boxes([[0, 0, 0, 1, 1, 2, 0]]).has_up
    points = np.random.default_rng(0).normal(0, 0.3, (60, 3))
    with pytest.raises(InputError, match="the up axis of the boxes is z, not y"):
        lidarpose.predict(points, boxes=boxes, up="y")
    # rows do not state an axis
    assert len(lidarpose.predict(points, boxes=[[0, 0, 0, 1, 1, 2, 0]], up="y", model="tiny")) == 1
