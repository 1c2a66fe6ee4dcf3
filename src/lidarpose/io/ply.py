"""PLY files, whose vertices trimesh decodes once the header is checked and cut down to them.

trimesh takes no faces of mixed sizes, upper-case names, repeated names or old Mac line ends, and lets short or wrong
text through; so it gets a header of the vertices alone and exactly their rows.
Format: http://paulbourke.net/dataformats/ply/
"""

import io
import re
import warnings

import numpy as np

from lidarpose.io.headers import Problem, need_bytes, parse_count, pick_xyz, shorten
from lidarpose.io.text import decode, number_lines, wrong_line

# bytes of a number; the names are those that trimesh knows
_TYPE_SIZES = {
    **{"char": 1, "uchar": 1, "short": 2, "ushort": 2, "int": 4, "uint": 4, "float": 4, "double": 8},
    **{"int8": 1, "uint8": 1, "int16": 2, "uint16": 2, "int32": 4, "uint32": 4, "int64": 8, "uint64": 8},
    **{"float16": 2, "float32": 4, "float64": 8},
}
_ENCODINGS = ("ascii", "binary_little_endian", "binary_big_endian")


def parse_ply(data: bytes) -> tuple[np.ndarray, tuple[str, ...], tuple[str, ...]]:
    """x y z (n, 3) of the vertices, the names of their properties, and no warnings; raises Problem."""
    encoding, elements, start = _read_header(data)
    skip_lines = 0
    for name, num_points, properties in elements:
        odd = next((kind for _, kind in properties if kind not in _TYPE_SIZES), None)
        if odd and (name == "vertex" or encoding != "ascii"):
            came = f"{shorten(odd)!r} in {shorten(name)}"
            raise Problem(
                f"expected PLY vertices of plain numbers, before any list, got {came}: export the points alone"
            )
        row_size = sum(_TYPE_SIZES.get(kind, 0) for _, kind in properties)
        if name == "vertex":
            break
        skip_lines += num_points
        start += 0 if encoding == "ascii" else num_points * row_size
    else:
        raise Problem("expected a PLY element 'vertex', got none: export the points")
    names = tuple(name for name, _ in properties)
    pick = pick_xyz(names)
    if not num_points:
        return np.empty((0, 3)), names, ()

    lines: list[str] = []
    kinds = [kind for _, kind in properties]
    if encoding == "ascii":
        lines = number_lines(decode(data[start:]), num_points, skip=skip_lines)
        body = "\n".join(lines).encode()
        # text may have more digits than the type that the header gives it
        kinds = ["double"] * len(kinds)
    else:
        need_bytes(data, start, num_points * row_size, num_points)
        body = data[start : start + num_points * row_size]
    try:
        points = _decode(_plain_header(kinds, pick, num_points, encoding) + body)
        if points.shape != (num_points, 3) or points.dtype.kind not in "fiu":
            raise ValueError(f"got {points.dtype} of the shape {points.shape}")
    except MemoryError:
        raise
    except Exception as error:
        raise wrong_line(lines, pick, error) from None
    return points, names, ()


def _read_header(data: bytes) -> tuple[str, list[tuple[str, int, list[tuple[str, str]]]], int]:
    """(encoding, elements, where the body starts); an element is its name, its number of rows and its properties."""
    start = re.match(rb"ply[ \t]*(\r\n|\n|\r)", data)
    if start is None:
        raise Problem(f"expected a PLY header, got {shorten(repr(data[:16]))}: is it another format?")
    # with the first line's kind of line end, since binary rows may begin with a byte that looks like one
    end = re.compile(rb"[\r\n]end_header[ \t]*" + start.group(1)).search(data)
    if end is None:
        raise Problem("expected a PLY header with an end_header line, got none: it is cut off, export it again")
    encoding, elements = "", []
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
                raise Problem(f"expected a PLY header line, got {shorten(line)!r}: export it again")
    if encoding not in _ENCODINGS:
        raise Problem(f"expected a PLY format of {', '.join(_ENCODINGS)}, got {shorten(encoding)!r}: export it again")
    return encoding, elements, end.end()


def _plain_header(kinds: list[str], pick: list[int], num_points: int, encoding: str) -> bytes:
    """The header of the vertices alone, with names that trimesh gives no other meaning."""
    names = [f"column_{i}" for i in range(len(kinds))]
    for axis, i in zip("xyz", pick, strict=True):
        names[i] = axis
    properties = "".join(f"property {kind} {name}\n" for kind, name in zip(kinds, names, strict=True))
    return f"ply\nformat {encoding} 1.0\nelement vertex {num_points}\n{properties}end_header\n".encode()


def _decode(data: bytes) -> np.ndarray:
    from trimesh.exchange.ply import load_ply

    with warnings.catch_warnings():
        # numpy's parser, which trimesh calls, only warns where it stops within a line: 1.5 2,5 would become 1.5 2
        warnings.filterwarnings("error", message="string or file could not be read")
        return load_ply(io.BytesIO(data), skip_materials=True)["vertices"]
