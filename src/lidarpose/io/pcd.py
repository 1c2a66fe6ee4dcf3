"""PCD files, decoded by pypcd4 once the header is checked and written anew.

pypcd4 refuses legal headers (no COUNT or POINTS, older versions, fields of the same name) and lets a short body
through, so it gets a plain header of the same rows, whose size has been checked against the file.
Format: https://pointclouds.org/documentation/tutorials/pcd_file_format.html
"""

import io
import math
import re

import numpy as np

from lidarpose.io.headers import Problem, need_bytes, parse_count, pick_xyz, shorten
from lidarpose.io.text import decode, number_lines, wrong_line

_TYPES = ("f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8")
_KINDS = ("ascii", "binary", "binary_compressed")
# an LZF back reference of 3 bytes stands for at most 264 bytes: http://oldhome.schmorp.de/marc/liblzf.html
_LZF_MAX_RATIO = 264 / 3


def parse_pcd(data: bytes) -> tuple[np.ndarray, tuple[str, ...], tuple[str, ...]]:
    """x y z (n, 3), the names of the fields, and no warnings; raises Problem."""
    header, kind, start = _read_header(data)
    names = tuple(header.get("FIELDS") or header.get("COLUMNS") or ())
    # the older versions of the format leave out COUNT
    sizes, types, counts = (header.get(key, ["1"] * len(names)) for key in ("SIZE", "TYPE", "COUNT"))
    if not len(sizes) == len(types) == len(counts) == len(names):
        came = f"{len(names)} fields, {len(sizes)} sizes, {len(types)} types and {len(counts)} counts"
        raise Problem(f"expected a PCD header with as many SIZE, TYPE and COUNT as FIELDS, got {came}: export it again")
    counts = [parse_count(c, "COUNT") for c in counts]
    formats = [t.lower() + s for t, s in zip(types, sizes, strict=True)]
    for text in set(formats) - set(_TYPES):
        raise Problem(f"expected PCD TYPE F, I or U with SIZE 1, 2, 4 or 8, got {shorten(text)!r}: export it again")
    if "POINTS" in header:
        num_points = parse_count(" ".join(header["POINTS"]), "POINTS")
    else:
        num_points = math.prod(parse_count(" ".join(header.get(key, ())), key) for key in ("WIDTH", "HEIGHT"))
    pick = pick_xyz(names)
    if any(counts[i] != 1 for i in pick):
        raise Problem("expected COUNT 1 for x, y and z in the PCD header: export the points without features")
    if kind not in _KINDS:
        raise Problem(f"expected PCD DATA ascii, binary or binary_compressed, got {kind!r}: export it again")
    if not num_points:
        return np.empty((0, 3)), names, ()

    size = num_points * sum(int(s) * c for s, c in zip(sizes, counts, strict=True))
    lines: list[str] = []
    at = [sum(counts[:i]) for i in pick]
    if kind == "ascii":
        lines = number_lines(decode(data[start:]), num_points)
        num_cells = len(lines[0].split())
        # also keeps pypcd4 from making a column for each of an absurd COUNT
        if num_cells != sum(counts):
            raise wrong_line(lines, at, f"{num_cells} values a row for {sum(counts)} in the header")
        body = "\n".join(lines).encode()
        # text may have more digits than the type that the header gives it
        formats = ["f8"] * len(formats)
    else:
        if kind == "binary":
            need_bytes(data, start, size, num_points)
        else:
            _check_compressed(data, start, size, num_points)
        body = data[start:]
    try:
        points = _decode(_plain_header(formats, counts, pick, num_points, kind) + body)
    except MemoryError:
        raise
    except Exception as error:
        if kind == "binary_compressed":
            raise Problem("expected LZF-compressed points, got damaged ones: copy or export it again") from None
        raise wrong_line(lines, at, error) from None
    if len(points) != num_points:
        # loadtxt passes over a line that starts with #
        raise wrong_line(lines, at, f"{len(points)} of {num_points}")
    return points, names, ()


def _read_header(data: bytes) -> tuple[dict[str, list[str]], str, int]:
    """(values by key, encoding, where the body starts)."""
    if not re.match(rb"\s*(#|VERSION|FIELDS|COLUMNS)", data):
        raise Problem(f"expected a PCD header, got {shorten(repr(data[:16]))}: is it another format?")
    end = re.search(rb"^DATA[ \t]+(\w+)[ \t]*\r?\n", data, re.MULTILINE)
    if end is None:
        raise Problem("expected a PCD header with a DATA line, got none: it is cut off or damaged, export it again")
    header = {}
    for line in data[: end.start()].decode("utf-8", "replace").splitlines():
        if line.strip() and not line.lstrip().startswith("#"):
            key, *values = line.split()
            header[key.upper()] = values
    return header, end.group(1).decode().lower(), end.end()


def _plain_header(formats: list[str], counts: list[int], pick: list[int], num_points: int, kind: str) -> bytes:
    """The header of the same rows as pypcd4 takes it: all keys, unique names, no field without values."""
    # pypcd4 itself would draw names for `_` from Python's global random state
    names = [f"column_{i}" for i in range(len(formats))]
    for axis, i in zip("xyz", pick, strict=True):
        names[i] = axis
    kept = [i for i in range(len(formats)) if counts[i]]
    lines = (
        "VERSION 0.7",
        " ".join(["FIELDS", *(names[i] for i in kept)]),
        " ".join(["SIZE", *(formats[i][1:] for i in kept)]),
        " ".join(["TYPE", *(formats[i][0].upper() for i in kept)]),
        " ".join(["COUNT", *(str(counts[i]) for i in kept)]),
        f"WIDTH {num_points}\nHEIGHT 1\nPOINTS {num_points}\nDATA {kind}\n",
    )
    return "\n".join(lines).encode()


def _decode(data: bytes) -> np.ndarray:
    from pypcd4 import PointCloud

    return PointCloud.from_fileobj(io.BytesIO(data)).numpy(("x", "y", "z"))


def _check_compressed(data: bytes, start: int, size: int, num_points: int) -> None:
    """Refuses a body (packed size, unpacked size, LZF) that is cut off or would unpack to something else."""
    need_bytes(data, start, 8, num_points)
    packed, unpacked = (int(n) for n in np.frombuffer(data, "<u4", 2, start))
    need_bytes(data, start + 8, packed, num_points)
    if unpacked != size or unpacked > packed * _LZF_MAX_RATIO:
        came = f"a compressed part of {packed} bytes for {unpacked}"
        raise Problem(f"expected {size} bytes for the {num_points} points of the header, got {came}: export it again")
