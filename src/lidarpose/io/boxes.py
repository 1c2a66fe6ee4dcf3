"""A detector's boxes from JSON: `{"people": [{"center": [x, y, z], "size": [l, w, h], "yaw": r, "id": ...}]}`."""

import difflib
import json
import math
import os

import numpy as np

from lidarpose.errors import InputError
from lidarpose.io.files import file_error, read_bytes
from lidarpose.sample import FARTHEST, Box, box_id

# nobody writes more than two full turns in radians; 30, 90 or 180 are degrees
_MAX_YAW = 4 * math.pi

_MAX_SHOWN = 60

_FORM = '{"people": [{"center": [x, y, z], "size": [l, w, h]}]}'


def read_boxes(source: str | os.PathLike | dict | list) -> list[Box]:
    """The people's boxes of a JSON file, or of the same structure already loaded.

    `source` holds `{"people": [...]}` or the bare list. Each entry needs `center` [x, y, z] m and `size` [length,
    width, height] m; `yaw` rad about z is 0 where it is absent; the id is `id`, else `track`, else None. Other keys
    are ignored. The frame is that of the points. No people is legal.

    Raises InputError, one line that names the file, the entry (counted from 0, as in JSON paths) and the key.
    """
    if isinstance(source, dict | list):
        name, content = "boxes", source
    else:
        name, content = source, _load_json(source)
    if isinstance(content, dict):
        if "people" not in content and {"center", "size"} <= content.keys():
            raise file_error(name, f"expected {_FORM}, got one box alone: put it in a list, [{{...}}]")
        if "people" not in content:
            raise file_error(name, f'expected a list under the key "people", {_keys(content, "people")}')
        content = content["people"]
    if not isinstance(content, list):
        raise file_error(name, f'expected {{"people": [...]}} or a list of people, got {_show(content)}')
    return [_box(entry, name, f"people[{i}]") for i, entry in enumerate(content)]


def _load_json(path: str | os.PathLike) -> object:
    data = read_bytes(path, expected="a JSON file of boxes")
    try:
        return json.loads(data.decode("utf-8-sig"))
    except json.JSONDecodeError as error:
        start = error.doc.lstrip()[:1]
        if start and start not in "{[":
            # a table of another tool, as KITTI's labels or CSV
            raise file_error(path, f"expected JSON {_FORM}, got text: write the boxes so") from None
        where = f"line {error.lineno}, column {error.colno}"
        raise file_error(path, f"is not JSON: {error.msg} at {where}; correct it there") from None
    except UnicodeDecodeError as error:
        raise file_error(
            path, f"expected JSON in UTF-8, got byte {error.start} that is not; save it as UTF-8"
        ) from None
    except (ValueError, RecursionError) as error:
        raise file_error(path, f"cannot be read as JSON ({error}); expected a list of boxes") from None


def _box(entry: object, name: object, where: str) -> Box:
    if not isinstance(entry, dict):
        raise file_error(name, f'{where}: expected {{"center": [x, y, z], "size": [l, w, h]}}, got {_show(entry)}')
    center = _triple(entry, "center", name, where, meaning="[x, y, z]")
    size = _triple(entry, "size", name, where, meaning="[length, width, height]")
    if min(size) <= 0:
        raise file_error(name, f"{where}.size: expected positive metres [length, width, height], got {_show(size)}")
    yaw = entry.get("yaw")
    yaw = 0.0 if yaw is None else _number(yaw)
    if yaw is None:
        raise file_error(name, f"{where}.yaw: expected a finite number in radians, got {_show(entry['yaw'])}")
    if abs(yaw) > _MAX_YAW:
        raise file_error(name, f"{where}.yaw: expected radians, got {yaw:g}; if it is in degrees, multiply by pi / 180")
    return Box(center=center, size=size, yaw=yaw, id=_id(entry, name, where))


def _triple(entry: dict, key: str, name: object, where: str, *, meaning: str) -> list[float]:
    if key not in entry:
        raise file_error(name, f'{where}: expected the key "{key}" {meaning} in metres, {_keys(entry, key)}')
    value = entry[key]
    try:
        numbers = [_number(v) for v in value] if not isinstance(value, str | bytes | dict) else [None]
    except TypeError:
        numbers = [None]
    if len(numbers) != 3 or None in numbers:
        raise file_error(name, f"{where}.{key}: expected three finite numbers {meaning} in metres, got {_show(value)}")
    return numbers


def _number(value: object) -> float | None:
    """The value as a float that a place or an angle may have, else None. Truth values and texts are no numbers."""
    if isinstance(value, bool | np.bool_ | str | bytes):
        return None
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        return None
    return number if abs(number) < FARTHEST else None


def _id(entry: dict, name: object, where: str) -> str | int | None:
    for key in ("id", "track"):
        value = entry.get(key)
        try:
            found = box_id(value)
        except InputError:
            raise file_error(name, f"{where}.{key}: expected text or a whole number, got {_show(value)}") from None
        if found is not None:
            return found
    return None


def _keys(entry: dict, wanted: str) -> str:
    """What the entry has instead of the wanted key, with the nearest spelling."""
    if not entry:
        return "got {}"
    names = [str(key) for key in entry]
    near = difflib.get_close_matches(wanted, names, n=1, cutoff=0.6)
    hint = f"; rename {near[0]!r}" if near else ""
    return f"got the keys {_cut(', '.join(names))}{hint}"


def _show(value: object) -> str:
    try:
        return _cut(json.dumps(value))
    except (TypeError, ValueError):
        return _cut(repr(value))


def _cut(text: str) -> str:
    return text if len(text) <= _MAX_SHOWN else text[: _MAX_SHOWN - 3] + "..."
