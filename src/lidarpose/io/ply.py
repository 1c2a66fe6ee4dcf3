"""The vertices of PLY files: http://paulbourke.net/dataformats/ply/"""

import re

import numpy as np

from lidarpose.io.files import FormatError, shorten
from lidarpose.io.text import check_bytes, decode, parse_count, parse_rows, pick_xyz

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"int64": "i8", "uint64": "u8", "float16": "f2", "float32": "f4", "float64": "f8", "float": "f4", "double": "f8"},
}
_BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


def parse_ply(data: bytes) -> tuple[np.ndarray, tuple[str, ...], tuple[str, ...]]:
    """x y z (n, 3) of the vertices, the names of their properties, and no warnings; raises FormatError."""
    encoding, elements, body_start = _read_header(data)
    start, skip_lines = body_start, 0
    for name, num_points, properties in elements:
        odd = next((kind for _, kind in properties if kind not in _TYPES), None)
        if odd and (name == "vertex" or encoding != "ascii"):
            came = f"{shorten(odd)!r} in {shorten(name)}"
            raise FormatError("PLY vertices of plain numbers, before any list", came, "export the points alone")
        widths = [np.dtype(_TYPES[kind]).itemsize if kind in _TYPES else 0 for _, kind in properties]
        if name == "vertex":
            break
        skip_lines += num_points
        start += num_points * sum(widths)
    else:
        raise FormatError("a PLY element 'vertex'", "none", "export the points")
    names = tuple(name for name, _ in properties)
    pick = pick_xyz(names)
    if not num_points:
        return np.empty((0, 3)), names, ()
    if encoding == "ascii":
        return parse_rows(decode(data[body_start:]), num_points, pick, len(names), skip=skip_lines), names, ()
    check_bytes(data, start, num_points * sum(widths), num_points)
    types = [_BYTE_ORDERS[encoding] + _TYPES[kind] for _, kind in properties]
    points = np.empty((num_points, 3))
    for axis, i in enumerate(pick):
        points[:, axis] = np.ndarray(num_points, types[i], data, start + sum(widths[:i]), sum(widths))
    return points, names, ()


def _read_header(data: bytes) -> tuple[str, list[tuple[str, int, list[tuple[str, str]]]], int]:
    """(encoding, elements, where the body starts); an element is its name, its number of rows and its properties."""
    start = re.match(rb"ply[ \t]*(\r\n|\n|\r)", data)
    if start is None:
        raise FormatError("a PLY header", f"{shorten(repr(data[:16]))}", "is it another format?")
    # with the first line's kind of line end, since binary rows may begin with a byte that looks like one
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
