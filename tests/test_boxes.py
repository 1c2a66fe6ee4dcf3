"""Boxes from JSON: what is accepted, and one line for each mistake."""

import copy
import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidarpose.errors import InputError
from lidarpose.io.boxes import read_boxes

PERSON = {"center": [10.0, -2.0, 0.5], "size": [0.6, 0.7, 1.8], "yaw": 0.3, "id": "a"}

metres = st.floats(-1e6, 1e6)
people = st.lists(
    st.fixed_dictionaries(
        {
            "center": st.lists(metres, min_size=3, max_size=3),
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


@settings(max_examples=80, deadline=None)
@given(people=people, bare=st.booleans(), bom=st.booleans())
def test_file_and_structure_agree(tmp_path_factory, people, bare, bom):
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
            ids = [person[key] for key in ("id", "track") if person.get(key) is not None]
            assert box.id == (ids[0] if ids else None)
    assert content == before


def test_arrays_and_numpy_numbers_are_numbers():
    (box,) = read_boxes(
        [{"center": np.array([1, 2, 3]), "size": (np.float32(1), 2, np.int64(3)), "yaw": np.float64(1)}]
    )
    assert box.center.tolist() == [1, 2, 3] and box.size.tolist() == [1, 2, 3] and box.yaw == 1


def test_nobody_is_legal():
    assert read_boxes([]) == read_boxes({"people": []}) == []


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
    "list as id": (changed(id=[1]), ["people[1].id", "[1]"]),
    "boolean id": (changed(id=True), ["people[1].id", "true"]),
    "fraction as track": (changed(id=None, track=1.5), ["people[1].track", "1.5"]),
}


def one_line(error, *words):
    message = str(error)
    assert message.isprintable() and len(message) < 400 and "Error:" not in message
    for word in words:
        assert word in message, message


@pytest.mark.parametrize("case", BAD)
def test_bad_structure(case):
    content, words = BAD[case]
    with pytest.raises(InputError) as caught:
        read_boxes(content)
    one_line(caught.value, "boxes: ", *words)


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
        (b"Pedestrian 0 0 -0.2 712 143 810 307 1.89 0.48 1.2 1.84 1.47 8.41 0.01\n", ["got text"]),
        (b'{"people": "\xe4"}', ["UTF-8"]),
        (b"[" * 100_000, ["JSON"]),
        (b"[" + b"9" * 5000 + b"]", ["JSON"]),
        (b'"people"', ["list of people"]),
        (b"null", ["list of people", "null"]),
        (b'[{"center": [1, NaN, 2], "size": [1, 1, 1]}]', ["people[0].center", "finite"]),
        (b'[{"center": [1, 2, 3], "size": [1, 1, 1], "id": {"\\n": 2}}]', ["people[0].id"]),
    ],
)
def test_bad_files(tmp_path, content, words):
    path = tmp_path / "boxes.json"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_boxes(path)
    one_line(caught.value, f"{path}: ", *words)


def test_bad_paths(tmp_path):
    for path, word in (
        (tmp_path / "gone.json", "no such file"),
        (tmp_path, "folder"),
        (3, "expected the path"),
        (None, "path"),
    ):
        with pytest.raises(InputError) as caught:
            read_boxes(path)
        one_line(caught.value, word)
