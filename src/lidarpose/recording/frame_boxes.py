"""Boxes of people in many frames: a folder with one file per frame, or one JSON or JSONL file with frame numbers."""

import json
import os
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from numbers import Integral
from pathlib import Path
from typing import Any

from lidarpose.errors import InputError
from lidarpose.geometry import upright_axis
from lidarpose.io.boxes import Boxes, read_boxes
from lidarpose.io.files import FRAME_NUMBER, file_error, read_bytes, shorten
from lidarpose.io.sources import DamagedFrame, Frame
from lidarpose.io.sources.folders import list_folder

_FORM = '{"frame": 0, "people": [{"center": [x, y, z], "size": [l, w, h]}]}'
_SUFFIXES = (".npy", ".txt", ".json")


class FrameBoxes:
    """The boxes of the people in a recording, by frame.

    Args:
        given: a folder of files named like the frames (`ID.json`, `ID.npy`, KITTI's `ID.txt`, or `ID.boxes.json` and
            `ID.poses.json`, as `lidarpose detect` and `predict` name them), or all by the frames' numbers; of one
            frame's files JSON is read, else `.txt`, since the others may be the scans; or a file of JSON lines or a
            JSON list of `{"frame": 0, "people": [...]}`, where the frame is its number (an integer) or its id (text);
            or a mapping from frame numbers or ids to anything that `read_boxes` takes. Ids that are integers are
            compared by value.
        calib: KITTI calibration, see `read_boxes`.

    Raises:
        InputError: the message names the file and what was expected.
    """

    def __init__(self, given: "str | os.PathLike | Mapping[Any, Any]", *, calib: str | os.PathLike | None = None):
        self._name: object = "boxes" if isinstance(given, Mapping) else given
        self._read = partial(read_boxes, calib=calib)
        # by number (int) or id (str)
        self._by_frame: dict[int | str, Any] = {}
        # whether the boxes of frames are matched by "id" or by "number"; None before the first frame with boxes
        self.matched_by: str | None = None
        if isinstance(given, Mapping):
            self._by_frame = {
                int(frame) if isinstance(frame, Integral) else str(frame): boxes for frame, boxes in given.items()
            }
        elif not isinstance(given, str | os.PathLike):
            kind = type(given).__name__
            raise InputError(f"boxes of a recording: expected a folder, a file or a dict by frame, got {kind}")
        elif os.path.isdir(given):
            self._by_frame = _files_by_frame(Path(given))
        else:
            self._by_frame = _by_frame(given)
        if not self._by_frame:
            raise file_error(
                self._name, f"expected boxes for each frame, files named like the frames or {_FORM}, got none"
            )
        # by the value of ids that are integers
        self._by_value = {_value(key): key for key in self._by_frame if isinstance(key, str)}
        self._by_value.pop(None, None)

    def of(self, frame: Frame | DamagedFrame) -> Boxes | None:
        """The boxes of a frame, None if none are given. Raises InputError for boxes that cannot be read."""
        id, number = str(frame.id), frame.index
        keys: dict[str, int | str | None] = {
            "id": id if id in self._by_frame else self._by_value.get(_value(id)),
            "number": number if number in self._by_frame else self._by_value.get(number),
        }
        # decided once: the number of one frame may be the id of another
        self.matched_by = self.matched_by or next((way for way, key in keys.items() if key is not None), None)
        if self.matched_by == "number" and keys["id"] not in (None, keys["number"]):
            problem = f"has boxes for the id of frame {id}, but those of earlier frames were found by number"
            raise file_error(self._name, f"{problem}: name all frames by their ids, or all by their numbers")
        key = None if self.matched_by is None else keys[self.matched_by]
        if key is None:
            return None
        try:
            return self._read(self._by_frame[key])
        except InputError as error:
            boxes = self._by_frame[key]
            raise error if isinstance(boxes, str | os.PathLike) else file_error(f"frame {key}", error) from None

    def up_axis(self) -> str:
        """The axis nearest to the up direction that the first boxes state; z if they state none. Boxes that cannot be
        read are left to `of`."""
        for content in self._by_frame.values():
            with suppress(InputError):
                return upright_axis(self._read(content).up)
        return "z"

    def check_used(self, last: str) -> None:
        """Raises InputError if none of the frames had boxes, which means that the boxes belong to another recording.
        last: id of the last frame."""
        if self.matched_by is None:
            ids = shorten(", ".join(map(str, list(self._by_frame)[:3])))
            raise file_error(
                self._name, f"has boxes of frames {ids}, but this recording has other frames, the last one {last}"
            )


def _value(id: str) -> int | None:
    """The value of an id that is an integer."""
    return int(id) if FRAME_NUMBER.fullmatch(id) else None


def _files_by_frame(folder: Path) -> dict[int | str, Any]:
    """The files of a folder by frame id. Raises InputError for two of one frame."""
    paths = [path for path in list_folder(folder) if path.suffix.lower() in _SUFFIXES]
    by_frame: dict[int | str, Any] = {}
    # those that are more likely boxes take the place of others, which may be the scans
    for path in sorted(paths, key=lambda path: _SUFFIXES.index(path.suffix.lower())):
        id = path.stem.removesuffix(".boxes").removesuffix(".poses")
        other = by_frame.get(id)
        if other is not None and path.suffix.lower() == other.suffix.lower():
            problem = f"expected one file of boxes per frame, got {other.name} and {path.name}"
            raise file_error(folder, f"{problem}: move one elsewhere")
        by_frame[id] = path
    return by_frame


def _by_frame(path: str | os.PathLike) -> dict[int | str, Any]:
    """The entries of a file by frame number or id."""
    data = read_bytes(path, expected="a folder or a file of boxes")
    try:
        text = data.decode("utf-8-sig")
        try:
            content = json.loads(text)
        except json.JSONDecodeError:
            content = [json.loads(line) for line in text.splitlines() if line.strip()]
    except (UnicodeDecodeError, ValueError, RecursionError) as error:
        raise file_error(path, f"expected JSON or JSON lines, {_FORM} each, got something else ({error})") from None
    entries = content.get("frames", [content]) if isinstance(content, dict) else content
    by_frame: dict[int | str, Any] = {}
    for i, entry in enumerate(entries if isinstance(entries, list) else [entries]):
        frame = entry.get("frame") if isinstance(entry, dict) else None
        # documents of one scan state their coordinate frame under this key
        is_scan = frame == "input" and "schema" in entry
        if is_scan or isinstance(frame, bool) or not isinstance(frame, str | int) or "people" not in entry:
            excerpt = shorten(json.dumps(entry), 60)
            raise file_error(
                path, f"expected one entry per frame, {_FORM}, got {excerpt} as entry {i}: one box file is one scan"
            )
        if frame in by_frame:
            raise file_error(path, f"expected each frame once, got {frame!r} twice: put its people into one entry")
        if entry.get("coordinates") == "world":
            problem = f"boxes in the sensor frame, got coordinates 'world' in entry {i}"
            raise file_error(path, f"expected {problem}: write the result without --world")
        if isinstance(entry["people"], list):
            # results with tracks contain people who were not seen
            is_unseen = [isinstance(p, dict) and bool(p.get("filled")) and not p.get("box") for p in entry["people"]]
            entry = entry | {"people": [p for p, unseen in zip(entry["people"], is_unseen, strict=True) if not unseen]}
        by_frame[frame] = entry
    return by_frame
