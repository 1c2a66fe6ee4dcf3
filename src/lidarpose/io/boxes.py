"""Boxes around people: detector output as JSON, arrays of seven numbers per box, and KITTI labels with calibration.

JSON is `{"people": [{"center": [x, y, z], "size": [l, w, h], "yaw": r, "id": ...}]}` or only the list. An entry may
also be a row [x, y, z, l, w, h, yaw]. `Boxes` writes this JSON.
"""

import difflib
import json
import math
import os
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, SupportsIndex, overload

import numpy as np

from lidarpose.arrays import to_numpy
from lidarpose.errors import InputError
from lidarpose.geometry import UP_AXES, rotation_from_up
from lidarpose.io.atomic import check_suffix, write_atomic
from lidarpose.io.files import FormatError, file_error, lined_json, read_bytes, shorten
from lidarpose.io.npz import load_array
from lidarpose.sample import FARTHEST, Box, box_id

if TYPE_CHECKING:
    from lidarpose.inference.results import Poses

# no yaw in radians exceeds two full turns; values such as 30, 90 or 180 are degrees
_MAX_YAW = 4 * math.pi

_FORM = '{"people": [{"center": [x, y, z], "size": [l, w, h]}]}'

# KITTI's classes of people; a cyclist's box includes the bicycle
_KITTI_PEOPLE = ("Pedestrian", "Person_sitting", "Cyclist")
# tolerance on the orthogonality of a calibration's rotations: the files store seven digits
_ROTATION_TOLERANCE = 1e-3

_Content = dict | list | tuple | np.ndarray | Box

SCHEMA = "lidarpose.boxes/1"


class Boxes(list[Box]):
    """The boxes around the people in a scan: a list of `Box`, detections in order of descending score.

    source: the file; warnings: lines about the scan; detector: the version of the detector, if the boxes are
    detections; up: the scan's up axis or direction, see `rotation_from_up`, by default that of the boxes, or z if no
    box has one; has_up: whether it is stated, not this default.
    """

    def __init__(
        self,
        boxes: Iterable[Box] = (),
        *,
        source: str | None = None,
        warnings: Iterable[str] = (),
        detector: str = "",
        up: str | None = None,
    ):
        boxes = list(boxes)
        if others := [type(box).__name__ for box in boxes if not isinstance(box, Box)]:
            raise InputError(f"Boxes: expected objects of type Box, got {others[0]}: convert with lidarpose.read_boxes")
        self.has_up = up is not None or any(box.up is not None for box in boxes)
        up = _common_up(boxes) if up is None else up
        # each box stores the up axis too, so that a box taken out of this list keeps it
        super().__init__(box.with_up(up) for box in boxes)
        self.source, self.warnings, self.detector, self.up = source, tuple(warnings), detector, up

    @overload
    def __getitem__(self, index: SupportsIndex) -> Box: ...

    @overload
    def __getitem__(self, index: slice) -> "Boxes": ...

    def __getitem__(self, index):
        item = super().__getitem__(index)
        if not isinstance(index, slice):
            return item
        up = self.up if self.has_up else None
        return Boxes(item, source=self.source, warnings=self.warnings, detector=self.detector, up=up)

    def to_dict(self) -> dict:
        """The document of the schema lidarpose.boxes/1, which `read_boxes` reads."""
        people = [{"id": box.id, **box.place_dict(), "score": box.score, "mounted": box.mounted} for box in self]
        return {
            "schema": SCHEMA,
            "source": self.source,
            "frame": "input",
            "unit": "m",
            "up": self.up,
            "detector": self.detector,
            "people": people,
            "warnings": list(self.warnings),
        }

    def to_json(self) -> str:
        """`to_dict` as JSON, one line per person."""
        return lined_json(self.to_dict(), "people") + "\n"

    def save(self, path: str | os.PathLike) -> None:
        """Writes `to_json` to a .json file atomically."""
        check_suffix(path, ".json")
        write_atomic(path, self.to_json())


def read_boxes(source: "str | os.PathLike | _Content | Poses", *, calib: str | os.PathLike | None = None) -> Boxes:
    """Reads the boxes around people, in the frame of the points, in meters and radians.

    Args:
        source: a file, its content, or boxes. A file is JSON, a .npy array (n, 7), or a KITTI label file
            (`label_2/N.txt`, of which pedestrians, sitting people and cyclists are read and transformed to the LiDAR
            frame). Content is `{"people": [...]}` or only the list. Each entry is a `Box`, a row
            [x, y, z, l, w, h, yaw] or a dict with the keys `center` [x, y, z], `size` [length, width, height] and `yaw`
            about z (0 if absent). The box's id is `id`, else `track`, else None. `score` (0 to 1), `mounted` (true or
            false) and `up` are read if their values are valid; other keys are ignored. For a pose, as `predict` writes
            it, its `box` is read, and for `Poses` the boxes of all people. An array or tensor (n, 7) holds such rows.
        calib: KITTI's calibration file; None for `../calib/N.txt` relative to the folder of the label file.

    Returns:
        A `Box` for each entry, in order, and the scan's up axis `up`, which `detect` and `predict` write. There may be
        no people.

    Raises:
        InputError: one line that names the file, the entry (counted from 0, as in JSON paths) and the key. Two entries
            with the same id are an error, since results are identified by it.
    """
    source = to_numpy(source)
    if hasattr(source, "columns") and hasattr(source, "to_numpy"):
        raise InputError("boxes: expected rows or a file, got a table: give table[[x, y, z, l, w, h, yaw]].to_numpy()")
    if hasattr(source, "people"):
        poses: Any = source
        people = [p.to_dict() if p.box is None else replace(p.box, id=p.id) for p in poses.people]
        source = {"schema": SCHEMA, "up": poses.up, "people": people}
    try:
        content = source if isinstance(source, _Content) else _load_file(source, calib)
        boxes = [_box(entry, f"people[{i}]") for i, entry in enumerate(_entries(content))]
        first_index: dict[str, int] = {}
        for i, box in enumerate(boxes):
            # tables and `poses["1"]` do not distinguish 1 from "1"
            if box.id is not None and first_index.setdefault(str(box.id), i) != i:
                actual = f"{_show(box.id)}, which people[{first_index[str(box.id)]}] also has"
                raise FormatError(f"people[{i}].id: expected a unique id, got {actual}: change or omit one of the two")
        up = _up(content)
    except FormatError as problem:
        raise file_error("boxes" if isinstance(source, _Content) else source, problem) from None
    return Boxes(boxes, up=up)


def _up(content: object) -> str | None:
    """The up axis that a lidarpose document states, None for any other content."""
    up: object
    if isinstance(content, Boxes):
        up = content.up if content.has_up else None
        if up is None:
            return None
    elif isinstance(content, dict) and str(content.get("schema")).startswith("lidarpose."):
        up = content.get("up", "z")
    else:
        return None
    with suppress(InputError):
        if isinstance(up, str):
            rotation_from_up(up)
            return up
    raise FormatError(f'up: expected {", ".join(UP_AXES)} or a direction "x,y,z", got {_show(up)}')


def _common_up(boxes: Sequence[Box]) -> str:
    """The up axis of the boxes that have one, z if none has one. Raises InputError if they differ."""
    directions = sorted({box.up for box in boxes if box.up is not None})
    if len(directions) > 1:
        names = ", ".join(directions)
        raise file_error("boxes", f"expected boxes with the same up axis, got {names}: give the boxes of one scan")
    return directions[0] if directions else "z"


def _entries(content: object) -> list | tuple:
    if isinstance(content, Box):
        return [content]
    if isinstance(content, dict):
        if "people" not in content and {"center", "size"} <= content.keys():
            raise FormatError(_FORM, "one box alone", "put it in a list, [{...}]")
        if "people" not in content:
            raise FormatError(f'expected a list under the key "people", {_keys(content, "people")}')
        content = content["people"]
    content = content.tolist() if isinstance(content, np.ndarray) else content
    if not isinstance(content, list | tuple):
        raise FormatError('{"people": [...]} or a list of people', _show(content), "write the boxes in this form")
    if _as_numbers(content, 7) is not None:
        raise FormatError(_FORM, "one row of numbers", "put it in a list, [row]")
    return content


def _load_file(path: str | os.PathLike, calib: str | os.PathLike | None) -> object:
    # KITTI's label of a scan without objects is empty
    is_label = str(path).lower().endswith(".txt")
    data = read_bytes(path, expected="a file of boxes", may_be_empty=is_label)
    if is_label and not data.strip():
        return []
    if data.startswith(b"\x93NUMPY"):
        return load_array(data)
    try:
        text = data.decode("utf-8-sig")
        return _read_kitti(path, text, calib) if _is_kitti(text) else json.loads(text)
    except InputError:
        # raised while reading the calibration
        raise
    except json.JSONDecodeError as error:
        start = error.doc.lstrip()[:1]
        if start and start not in "{[":
            # a table from another tool, e.g. CSV
            raise FormatError(f"JSON {_FORM} or a KITTI label", "text", "write the boxes in this form") from None
        where = f"line {error.lineno}, column {error.colno}"
        raise FormatError(f"is not JSON: {error.msg} at {where}; correct it there") from None
    except UnicodeDecodeError as error:
        expected = "boxes as JSON in UTF-8, .npy rows or a KITTI label"
        raise FormatError(expected, f"an invalid byte at {error.start}", "give the file of the boxes") from None
    except (ValueError, RecursionError) as error:
        raise FormatError(f"cannot be read as JSON ({error}); expected a list of boxes") from None


# ---- KITTI: https://www.cvlibs.net/datasets/kitti/eval_object.php, readme.txt of the development kit


def _is_kitti(text: str) -> bool:
    """Whether the first line has the values of a KITTI label: class, truncation, occlusion, angle, 4 of the image box,
    7 of the 3D box, and in a result file a score."""
    words = text.lstrip().partition("\n")[0].split()
    return len(words) in (15, 16) and _parse_numbers(words[1:], len(words) - 1) is not None


def _read_kitti(path: str | os.PathLike, text: str, calib: str | os.PathLike | None) -> list[dict]:
    """An entry in the LiDAR frame for each person in a label file, with the score that a result file has."""
    people = []
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if not words or words[0] not in _KITTI_PEOPLE:
            continue
        values = _parse_numbers(words[8:15], 7)
        if values is None:
            raise FormatError(
                f"expected a KITTI label of 15 values on line {number}, got {shorten(line)!r}: correct it"
            )
        scores = _parse_numbers(words[15:16], 1)
        people.append((values, scores[0] if scores else None, words[0] == "Cyclist"))
    if not people:
        return []
    if calib is None:
        calib = Path(os.path.abspath(os.fsdecode(path))).parent.parent / "calib" / Path(os.fsdecode(path)).name
        if not calib.is_file():
            raise FormatError(
                f"is a KITTI label: expected its calibration at {calib}, got none: "
                "put it there or give its path as --calib (calib=)"
            )
    R_rect_velo, t_rect_velo = _read_calibration(calib)
    entries = []
    for (height, width, length, x, y, z, rotation_y), score, is_mounted in people:
        # the camera's y axis points down, and a label's location is the center of the box's bottom face
        center = R_rect_velo.T @ (np.array([x, y - height / 2, z]) - t_rect_velo)
        forward = R_rect_velo.T @ np.array([math.cos(rotation_y), 0, -math.sin(rotation_y)])
        yaw = math.atan2(forward[1], forward[0])
        box = {"center": center.tolist(), "size": [length, width, height], "yaw": yaw}
        entries.append(box | {"score": score, "mounted": is_mounted})
    return entries


def _read_calibration(path: str | os.PathLike) -> tuple[np.ndarray, np.ndarray]:
    """R (3, 3) and t (3,) m from the LiDAR frame to the frame of the rectified camera 0, in which labels are given."""
    text = read_bytes(path, expected="KITTI's calibration").decode("utf-8", "replace")
    lines = {words[0].rstrip(":"): words[1:] for words in map(str.split, text.splitlines()) if words}
    matrices = []
    for keys, shape in ((("R0_rect", "R_rect"), (3, 3)), (("Tr_velo_to_cam", "Tr_velo_cam"), (3, 4))):
        values = _parse_numbers([word for key in keys for word in lines.get(key, ())], math.prod(shape))
        if values is None:
            actual = shorten(", ".join(lines)) or "nothing"
            raise file_error(path, f"expected {keys[0]}: with {math.prod(shape)} numbers, got {actual}: copy it again")
        matrix = np.array(values).reshape(shape)
        if np.abs(matrix[:, :3] @ matrix[:, :3].T - np.eye(3)).max() > _ROTATION_TOLERANCE:
            raise file_error(path, f"expected a rotation as {keys[0]}, got another matrix: copy it again")
        matrices.append(matrix)
    R_rect_cam, T_cam_velo = matrices
    return R_rect_cam @ T_cam_velo[:, :3], R_rect_cam @ T_cam_velo[:, 3]


def _parse_numbers(words: list[str], count: int) -> list[float] | None:
    """The words as `count` finite numbers, else None."""
    try:
        return _as_numbers(map(float, words), count)
    except ValueError:
        return None


# ---- one entry


def _box(entry: object, where: str) -> Box:
    if isinstance(entry, Box):
        return entry
    entry = entry.tolist() if isinstance(entry, np.ndarray) else entry
    if isinstance(entry, list | tuple) and len(entry) == 7:
        entry = {"center": entry[:3], "size": entry[3:6], "yaw": entry[6]}
    if not isinstance(entry, dict):
        expected = '{"center": [x, y, z], "size": [l, w, h]} or [x, y, z, l, w, h, yaw]'
        raise FormatError(f"{where}: expected {expected}, got {_show(entry)}")
    id = _id(entry, where)
    if "box" in entry and "center" not in entry:
        # an entry of a pose result, whose box is nested
        if not isinstance(entry["box"], dict):
            raise FormatError(
                f"{where}.box: expected a box, got {_show(entry['box'])}: a cloud of one person has no box"
            )
        entry, where = entry | entry["box"], f"{where}.box"
    center = _triple(entry, "center", where, meaning="[x, y, z]")
    size = _triple(entry, "size", where, meaning="[length, width, height]")
    if min(size) <= 0:
        raise FormatError(f"{where}.size: expected positive meters [length, width, height], got {_show(size)}")
    yaw = entry.get("yaw")
    yaw = 0.0 if yaw is None else _number(yaw)
    if yaw is None:
        raise FormatError(f"{where}.yaw: expected a finite number in radians, got {_show(entry['yaw'])}")
    if abs(yaw) > _MAX_YAW:
        raise FormatError(f"{where}.yaw: expected radians, got {yaw:g}; if it is in degrees, multiply by pi / 180")
    # scores of other detectors may have any scale; nothing depends on them, so that invalid ones are ignored
    score = _number(entry.get("score"))
    up = None
    with suppress(InputError):
        if isinstance(entry.get("up"), str):
            rotation_from_up(entry["up"])
            up = entry["up"]
    mounted = entry.get("mounted")
    return Box(
        center=np.array(center),
        size=np.array(size),
        yaw=yaw,
        id=id,
        score=score if score is not None and 0 <= score <= 1 else None,
        mounted=bool(mounted) if isinstance(mounted, bool | np.bool_) else None,
        up=up,
    )


def _triple(entry: dict, key: str, where: str, *, meaning: str) -> list[float]:
    if key not in entry:
        raise FormatError(f'{where}: expected the key "{key}" {meaning} in meters, {_keys(entry, key)}')
    value = entry[key]
    numbers = _as_numbers(value, 3)
    if numbers is None:
        raise FormatError(f"{where}.{key}: expected three finite numbers {meaning} in meters, got {_show(value)}")
    return numbers


def _as_numbers(values: Any, count: int) -> list[float] | None:
    """The `count` finite numbers of any iterable except text and dicts, else None."""
    try:
        values = [_number(value) for value in values] if not isinstance(values, str | bytes | dict) else []
    except TypeError:
        return None
    return values if len(values) == count and None not in values else None


def _number(value: Any) -> float | None:
    """The value as a float in the range of coordinates and angles, else None. Booleans and text are not numbers."""
    if isinstance(value, bool | np.bool_ | str | bytes):
        return None
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        return None
    return number if abs(number) < FARTHEST else None


def _id(entry: dict, where: str) -> str | int | None:
    for key in ("id", "track"):
        value = entry.get(key)
        try:
            id = box_id(value)
        except InputError:
            raise FormatError(f"{where}.{key}: expected text or a whole number, got {_show(value)}") from None
        if id is not None:
            return id
    return None


def _keys(entry: dict, expected_key: str) -> str:
    """The keys that the entry has instead of the expected one, with the closest spelling as a hint."""
    if not entry:
        return "got {}"
    names = [str(key) for key in entry]
    matches = difflib.get_close_matches(expected_key, names, n=1, cutoff=0.6)
    hint = f"; rename {matches[0]!r}" if matches else ""
    return f"got the keys {shorten(', '.join(names), 60)}{hint}"


def _show(value: object) -> str:
    try:
        return shorten(json.dumps(value), 60)
    except (TypeError, ValueError):
        return shorten(repr(value), 60)
