"""PCD files of any version: https://pointclouds.org/documentation/tutorials/pcd_file_format.html"""

import math
import re

import numpy as np

from lidarpose.io.files import FormatError, check_unpacked, shorten
from lidarpose.io.text import check_bytes, decode, parse_count, parse_rows, pick_xyz

_TYPES = ("f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8")


def parse_pcd(data: bytes) -> tuple[np.ndarray, tuple[str, ...], tuple[str, ...]]:
    """x y z (n, 3), the names of the fields, and no warnings; raises FormatError."""
    header, encoding, start = _read_header(data)
    names = tuple(header.get("FIELDS") or header.get("COLUMNS") or ())
    # the older versions of the format leave out COUNT
    sizes, types, count_words = (header.get(key, ["1"] * len(names)) for key in ("SIZE", "TYPE", "COUNT"))
    if not len(sizes) == len(types) == len(count_words) == len(names):
        came = f"{len(names)} fields, {len(sizes)} sizes, {len(types)} types and {len(count_words)} counts"
        raise FormatError("a PCD header with as many SIZE, TYPE, COUNT as FIELDS", came, "export it again")
    counts = [parse_count(c, "COUNT") for c in count_words]
    formats = [t.lower() + s for t, s in zip(types, sizes, strict=True)]
    for text in set(formats) - set(_TYPES):
        raise FormatError("PCD TYPE F, I or U with SIZE 1, 2, 4 or 8", f"{shorten(text)!r}", "export it again")
    size_keys = ("POINTS",) if "POINTS" in header else ("WIDTH", "HEIGHT")
    num_points = math.prod(parse_count(" ".join(header.get(key, ())), key) for key in size_keys)
    pick = pick_xyz(names)
    if any(counts[i] != 1 for i in pick):
        raise FormatError("expected COUNT 1 for x, y and z in the PCD header: export the points without features")
    if encoding not in ("ascii", "binary", "binary_compressed"):
        raise FormatError("PCD DATA ascii, binary or binary_compressed", f"{encoding!r}", "export it again")
    if not num_points:
        return np.empty((0, 3)), names, ()
    if encoding == "ascii":
        cells = [sum(counts[:i]) for i in pick]
        return parse_rows(decode(data[start:]), num_points, cells, sum(counts)), names, ()

    widths = [int(s) * c for s, c in zip(sizes, counts, strict=True)]
    offsets, row_size = [sum(widths[:i]) for i in pick], sum(widths)
    if encoding == "binary":
        check_bytes(data, start, num_points * row_size, num_points)
        offsets, strides = [start + offset for offset in offsets], [row_size] * 3
    else:
        # field by field: all x, then all y
        data = _decompress(data, start, num_points * row_size, num_points)
        offsets, strides = [num_points * offset for offset in offsets], [widths[i] for i in pick]
    points = np.empty((num_points, 3))
    for axis, (i, offset, stride) in enumerate(zip(pick, offsets, strides, strict=True)):
        points[:, axis] = np.ndarray(num_points, f"<{formats[i]}", data, offset, stride)
    return points, names, ()


def _read_header(data: bytes) -> tuple[dict[str, list[str]], str, int]:
    """(values by key, encoding, where the body starts)."""
    if not re.match(rb"\s*(#|VERSION|FIELDS|COLUMNS)", data):
        raise FormatError("a PCD header", f"{shorten(repr(data[:16]))}", "is it another format?")
    end = re.search(rb"^DATA[ \t]+(\w+)[ \t]*\r?\n", data, re.MULTILINE)
    if end is None:
        raise FormatError("a PCD header with a DATA line", "none", "it is cut off or damaged, export it again")
    header = {}
    for line in data[: end.start()].decode("utf-8", "replace").splitlines():
        if line.strip() and not line.lstrip().startswith("#"):
            key, *values = line.split()
            header[key.upper()] = values
    return header, end.group(1).decode().lower(), end.end()


def _decompress(data: bytes, start: int, size: int, num_points: int) -> bytes:
    """The `size` bytes of an LZF body, which begins with its packed and its unpacked size (uint32)."""
    from lzf import decompress

    check_bytes(data, start, 8, num_points)
    packed, unpacked = (int(n) for n in np.frombuffer(data, "<u4", 2, start))
    check_bytes(data, start + 8, packed, num_points)
    if unpacked != size:
        came = f"a compressed part of {packed} bytes for {unpacked}"
        raise FormatError(f"{size} bytes for {num_points} points of the header", came, "export it again")
    check_unpacked(packed, unpacked)
    try:
        body = decompress(data[start + 8 : start + 8 + packed], unpacked)
    except ValueError:
        body = None
    if body is None or len(body) != size:
        raise FormatError("LZF-compressed points", "damaged ones", "copy or export it again")
    return body
