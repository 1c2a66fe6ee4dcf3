"""Formats whose header describes the position of x, y and z: PCD of any version, and the vertices of PLY.

https://pointclouds.org/documentation/tutorials/pcd_file_format.html, http://paulbourke.net/dataformats/ply/
"""

import math
import re
from collections.abc import Sequence

import numpy as np

from lidarpose.io.files import FormatError, check_unpacked, shorten
from lidarpose.io.text import PickColumns, check_bytes, decode, parse_count, parse_rows, pick_xyz

_PCD_TYPES = ("f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8")
_PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"int64": "i8", "uint64": "u8", "float16": "f2", "float32": "f4", "float64": "f8", "float": "f4", "double": "f8"},
}
_BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


def _columns(data: bytes, num_points: int, types: Sequence[str], starts: Sequence[int], steps: Sequence[int]):
    """c columns (n, c) float64 from bytes: of each the type, the byte offset of the first value, and the stride to the
    next one."""
    layouts = zip(types, starts, steps, strict=True)
    columns = (np.ndarray(num_points, kind, data, start, step) for kind, start, step in layouts)
    return np.stack([column.astype(np.float64) for column in columns], axis=-1)


def parse_pcd(data: bytes, pick: PickColumns = pick_xyz) -> tuple[np.ndarray, tuple[str, ...]]:
    """The picked columns (n, c) and the field names; raises FormatError."""
    header, encoding, start = _pcd_header(data)
    names = tuple(header.get("FIELDS") or header.get("COLUMNS") or ())
    # older versions of the format have no COUNT, the oldest no SIZE and TYPE
    defaults = {"SIZE": "4", "TYPE": "F", "COUNT": "1"}
    sizes, types, count_words = (header.get(key, [word] * len(names)) for key, word in defaults.items())
    if not len(sizes) == len(types) == len(count_words) == len(names):
        actual = f"{len(names)} fields, {len(sizes)} sizes, {len(types)} types and {len(count_words)} counts"
        raise FormatError("a PCD header with as many SIZE, TYPE, COUNT as FIELDS", actual, "export it again")
    counts = [parse_count(c, "COUNT") for c in count_words]
    formats = [t.lower() + s for t, s in zip(types, sizes, strict=True)]
    for text in set(formats) - set(_PCD_TYPES):
        raise FormatError("PCD TYPE F, I or U with SIZE 1, 2, 4 or 8", f"{shorten(text)!r}", "export it again")
    size_keys = ("POINTS",) if "POINTS" in header else ("WIDTH", "HEIGHT")
    num_points = math.prod(parse_count(" ".join(header.get(key, ())), key) for key in size_keys)
    picked = pick(names)
    if any(counts[i] != 1 for i in picked):
        raise FormatError("expected COUNT 1 for x, y and z in the PCD header: export the points without features")
    if encoding not in ("ascii", "binary", "binary_compressed"):
        raise FormatError("PCD DATA ascii, binary or binary_compressed", f"{encoding!r}", "export it again")
    if not num_points:
        return np.empty((0, len(picked))), names
    if encoding == "ascii":
        cells = [sum(counts[:i]) for i in picked]
        return parse_rows(decode(data[start:]), num_points, cells, sum(counts)), names
    widths = [int(s) * c for s, c in zip(sizes, counts, strict=True)]
    offsets, row_size = [sum(widths[:i]) for i in picked], sum(widths)
    if encoding == "binary":
        check_bytes(data, start, num_points * row_size, num_points)
        starts, steps = [start + offset for offset in offsets], [row_size] * len(picked)
    else:
        # stored field by field: all x, then all y
        data = _decompress(data, start, num_points * row_size, num_points)
        starts, steps = [num_points * offset for offset in offsets], [widths[i] for i in picked]
    return _columns(data, num_points, [f"<{formats[i]}" for i in picked], starts, steps), names


def viewpoint_notes(data: bytes) -> tuple[str, ...]:
    """A note for the user if a PCD header states another sensor position than 0, 0, 0. It is not used, since some
    programs store the points relative to it, and others do not."""
    header, _, _ = _pcd_header(data)
    try:
        position = np.array(header.get("VIEWPOINT", [])[:3], float)
    except ValueError:
        return ()
    if len(position) < 3 or not np.isfinite(position).all() or not position.any():
        return ()
    text = ",".join(f"{value:g}" for value in position)
    return (f"the header's VIEWPOINT is not used: if the sensor is there in the points' frame, --sensor-origin {text}",)


def _pcd_header(data: bytes) -> tuple[dict[str, list[str]], str, int]:
    """(values by key, encoding, where the body starts)."""
    if not re.match(rb"\s*(#|VERSION|FIELDS|COLUMNS)", data):
        raise FormatError("a PCD header", f"{shorten(repr(data[:16]))}", "is it another format?")
    end = re.search(rb"^DATA[ \t]+(\w+)[ \t]*\r?\n", data, re.MULTILINE)
    if end is None:
        raise FormatError("a PCD header with a DATA line", "none", "it is cut off or damaged, export it again")
    lines = [line.split() for line in data[: end.start()].decode("utf-8", "replace").splitlines()]
    header = {line[0].upper(): line[1:] for line in lines if line and not line[0].startswith("#")}
    return header, end.group(1).decode().lower(), end.end()


def _decompress(data: bytes, start: int, size: int, num_points: int) -> bytes:
    """The `size` decompressed bytes of an LZF body, which begins with its packed and its unpacked size (uint32)."""
    from lzf import decompress

    check_bytes(data, start, 8, num_points)
    packed_size, unpacked_size = (int(n) for n in np.frombuffer(data, "<u4", 2, start))
    check_bytes(data, start + 8, packed_size, num_points)
    if unpacked_size != size:
        actual = f"{packed_size} compressed bytes that announce {unpacked_size}"
        raise FormatError(f"{size} bytes for {num_points} points of the header", actual, "export it again")
    check_unpacked(packed_size, unpacked_size)
    try:
        body = decompress(data[start + 8 : start + 8 + packed_size], unpacked_size)
    except ValueError:
        body = None
    if body is None or len(body) != size:
        raise FormatError("LZF-compressed points", "damaged ones", "copy or export it again")
    return body


def parse_ply(data: bytes, pick: PickColumns = pick_xyz) -> tuple[np.ndarray, tuple[str, ...]]:
    """The picked columns (n, c) of the vertices and their property names; raises FormatError."""
    encoding, elements, body_start = _ply_header(data)
    start, skip_lines = body_start, 0
    for name, num_points, properties in elements:
        unknown_type = next((kind for _, kind in properties if kind not in _PLY_TYPES), None)
        if unknown_type and (name == "vertex" or encoding != "ascii"):
            actual = f"{shorten(unknown_type)!r} in {shorten(name)}"
            raise FormatError("PLY vertices of plain numbers, before any list", actual, "export the points alone")
        types = [_BYTE_ORDERS[encoding] + _PLY_TYPES.get(kind, "u1") for _, kind in properties]
        widths = [np.dtype(kind).itemsize for kind in types]
        if name == "vertex":
            break
        skip_lines += num_points
        start += num_points * sum(widths)
    else:
        raise FormatError("a PLY element 'vertex'", "none", "export the points")
    names = tuple(name for name, _ in properties)
    picked = pick(names)
    if not num_points:
        return np.empty((0, len(picked))), names
    if encoding == "ascii":
        return parse_rows(decode(data[body_start:]), num_points, picked, len(names), skip=skip_lines), names
    check_bytes(data, start, num_points * sum(widths), num_points)
    starts = [start + sum(widths[:i]) for i in picked]
    return _columns(data, num_points, [types[i] for i in picked], starts, [sum(widths)] * len(picked)), names


def _ply_header(data: bytes) -> tuple[str, list[tuple[str, int, list[tuple[str, str]]]], int]:
    """(encoding, elements, where the body starts); an element is its name, its number of rows and its properties."""
    start = re.match(rb"ply[ \t]*(\r\n|\n|\r)", data)
    if start is None:
        raise FormatError("a PLY header", f"{shorten(repr(data[:16]))}", "is it another format?")
    # requires the line ending of the first line, since binary rows may begin with a byte that looks like a line ending
    end = re.compile(rb"[\r\n]end_header[ \t]*" + start.group(1)).search(data)
    if end is None:
        raise FormatError("a PLY header with an end_header line", "none", "it is cut off, export it again")
    encoding = ""
    elements: list[tuple[str, int, list[tuple[str, str]]]] = []
    for line in data[: end.start()].decode("utf-8", "replace").splitlines()[1:]:
        match line.split():
            case ["format", kind, *_]:
                encoding = kind
            case ["element", name, number]:
                elements.append((name, parse_count(number, f"number of {name}"), []))
            case ["property", *kind, name] if elements and kind:
                elements[-1][2].append((name, " ".join(kind)))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise FormatError("a PLY header line", f"{shorten(line)!r}", "export it again")
    if encoding not in _BYTE_ORDERS:
        expected = ", ".join(_BYTE_ORDERS)
        raise FormatError(f"a PLY format of {expected}", f"{shorten(encoding)!r}", "export it again")
    return encoding, elements, end.end()
