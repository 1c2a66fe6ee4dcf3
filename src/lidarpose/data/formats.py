"""Point clouds from files: PCD, PLY, raw float32, NumPy and text.

The suffix, in any case, says the format. Coordinates stay as they are in the file (metres are assumed, nothing is
turned or scaled), in float64, since float32 rounds map coordinates such as UTM's to half a metre. Columns other than
x, y and z are named in `Cloud.fields` and otherwise ignored.

Headers are checked against the size of the file before anything is allocated; the bodies are plain rows, which numpy
and pandas decode, but for PCD's LZF compression. A parser takes a file's bytes and returns its x y z (n, 3), the
names of its columns and warnings; it raises `_Problem`, to which `read_points` adds the file's name.
"""

import io
import math
import os
import re
import warnings
import zipfile
from dataclasses import dataclass

import numpy as np

from lidarpose.data.files import file_error, read_bytes
from lidarpose.errors import InputError

KITTI_FIELDS = ("x", "y", "z", "intensity")
NUSCENES_FIELDS = ("x", "y", "z", "intensity", "ring")

# metres; no coordinate on Earth is larger (earth-centred ones reach 6.4e6), misread bytes mostly are
_MAX_PLAUSIBLE = 1e7
# share of the rows beyond that at which raw bytes are taken for something else than float32 rows
_MAX_IMPLAUSIBLE_SHARE = 0.01
# beams are numbered from 0; no LiDAR has more
_MAX_BEAMS = 256
# an LZF back reference of 3 bytes stands for at most 264 bytes: http://oldhome.schmorp.de/marc/liblzf.html
_LZF_MAX_RATIO = 264 / 3
# characters of a file or of a library's message that an error shows
_MAX_SHOWN = 80

# the first bytes of what users rename by mistake, with the remedy; long enough never to be float32 coordinates
_FOREIGN = (
    (re.compile(rb"\x1f\x8b\x08[\x00-\x1f]"), "is gzip-compressed: unpack it first (gunzip)"),
    (re.compile(rb"PK\x03\x04"), "is a zip archive: unpack it first"),
    (re.compile(rb"BZh[1-9]1AY&SY"), "is bzip2-compressed: unpack it first (bunzip2)"),
    (re.compile(rb"\xfd7zXZ\x00"), "is xz-compressed: unpack it first (unxz)"),
    (re.compile(rb"\x28\xb5\x2f\xfd"), "is zstd-compressed: unpack it first (unzstd)"),
    (re.compile(rb"\x89PNG\r\n\x1a\n"), "is a PNG picture: expected a point cloud; name the cloud's own file"),
    (
        re.compile(rb"\xff\xd8\xff[\xdb\xe0\xe1\xee]"),
        "is a JPEG picture: expected a point cloud; name the cloud's file",
    ),
    (re.compile(rb"LASF"), "is a LAS or LAZ file: convert it to .ply or .pcd first"),
    (re.compile(rb"\x89HDF\r\n\x1a\n"), "is an HDF5 file: save the points as .npy first"),
    (
        re.compile(rb"(?i)\s*<(!doctype html|html|\?xml)"),
        "is a web page or XML: expected a point cloud; download it anew",
    ),
    (re.compile(rb"version https://git-lfs"), "is a Git LFS pointer, not the data: run `git lfs pull`"),
)
_MAGIC = {
    ".npy": re.compile(rb"\x93NUMPY"),
    ".ply": re.compile(rb"ply[ \t]*[\r\n]"),
    ".pcd": re.compile(rb"# \.PCD v"),
    # a zip archive whose first file is an array
    ".npz": re.compile(rb"PK\x03\x04.{26}[^/]{1,200}?\.npy", re.DOTALL),
}

_PCD_TYPES = ("f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8")
_PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"int64": "i8", "uint64": "u8", "float": "f4", "double": "f8", "float16": "f2", "float32": "f4", "float64": "f8"},
}
_PLY_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}

# what stands in text for a value that is not there, in the usual exports
_MISSING = ("", "na", "n/a", "nan", "-nan", "+nan", "null", "none", "<na>")


class _Problem(Exception):
    """What is wrong with a file and what to do, without the file's name. Never leaves this module."""


@dataclass(frozen=True, kw_only=True)
class Cloud:
    """A point cloud as read from a file.

    points (n, 3) float64, x y z in the file's own frame and unit, all finite, n > 0; num_dropped, the rows left out
    because a coordinate was NaN, infinite or missing; fields, the names of all the file's columns; warnings, lines
    for the user.
    """

    points: np.ndarray
    num_dropped: int = 0
    fields: tuple[str, ...] = ("x", "y", "z")
    warnings: tuple[str, ...] = ()


def read_points(path: str | os.PathLike, *, columns: int | None = None) -> Cloud:
    """Reads a point cloud; the suffix says the format.

    .pcd (ascii, binary, binary_compressed), .ply (the vertices; ascii, binary of either byte order), .npy ((n, 3+) or
    records with x, y, z), .npz (`points`, else `xyz`, else its only (n, 3+) array), .csv .xyz .txt (with or without a
    header; commas, semicolons, tabs or blanks; # starts a comment), .bin (rows of `columns` float32).

    columns: values a row of a .bin, x y z first; other formats ignore it. Where it is None, rows have 4 (KITTI) or,
    where the size or a column of beam numbers says so, 5 (nuScenes), which a warning tells; `.pcd.bin`, nuScenes' own
    suffix, means 5.

    Raises InputError of one line that names the file, what was expected, what came and what to do.
    """
    if columns is not None and (isinstance(columns, bool) or not isinstance(columns, int) or columns < 3):
        raise InputError(f"columns must be a whole number of at least 3 (x y z first), got {columns!r}")
    data = read_bytes(path, expected=f"a point cloud ({' '.join(SUFFIXES)})")
    name = os.path.basename(os.fsdecode(path)).lower()
    suffix = os.path.splitext(name)[1]
    try:
        _refuse_foreign(data, suffix)
        # numpy warns of bytes that are no valid numbers; they are dropped and counted below
        with np.errstate(all="ignore"):
            if suffix == ".bin":
                columns = 5 if columns is None and name.endswith(".pcd.bin") else columns
                points, fields, notes = _parse_bin(data, columns)
            else:
                points, fields, notes = _PARSERS[suffix](data)
            points = np.ascontiguousarray(points, dtype=np.float64)
            finite = np.isfinite(points).all(axis=1)
        num_dropped = len(points) - int(finite.sum())
        if not len(points):
            raise _Problem("has no points; expected at least one: was it saved completely?")
        if num_dropped == len(points):
            raise _Problem(f"expected finite x, y, z, got NaN or infinity in all {num_dropped} points: export it again")
    except _Problem as problem:
        raise file_error(path, problem) from None
    except MemoryError:
        raise file_error(path, "does not fit in memory; split it first") from None
    except Exception as error:
        reason = _shorten(f"{type(error).__name__}: {error}")
        raise file_error(path, f"cannot be read as a {suffix} file ({reason}); export it again") from None
    if num_dropped:
        notes = (*notes, f"dropped {num_dropped} of {len(points)} points that were NaN, infinite or incomplete")
        points = points[finite]
    return Cloud(points=points, num_dropped=num_dropped, fields=tuple(fields), warnings=tuple(notes))


def _refuse_foreign(data: bytes, suffix: str) -> None:
    """Refuses content that is plainly something else than the suffix says, and suffixes nobody here can read."""
    for other, pattern in _MAGIC.items():
        if pattern.match(data):
            if other != suffix:
                raise _Problem(
                    f"expected a {suffix or 'known'} file, got a {other} file's content: rename it to {other}"
                )
            return
    for pattern, problem in _FOREIGN:
        if pattern.match(data):
            raise _Problem(problem)
    if suffix not in SUFFIXES:
        raise _Problem(f"expected one of {' '.join(SUFFIXES)}, got the suffix {suffix!r}: convert or rename the file")


def _shorten(text: str, limit: int = _MAX_SHOWN) -> str:
    text = " ".join(text.split())
    return text if len(text) <= limit else text[: limit - 3] + "..."


def _pick_xyz(names) -> list[int]:
    """The positions of x, y and z among column names, in any case."""
    low = [name.strip().lower() for name in names]
    if not {"x", "y", "z"} <= set(low):
        came = _shorten(" ".join(names)) or "none"
        raise _Problem(f"expected columns x, y and z, got {came}: export or rename x, y, z")
    return [low.index(axis) for axis in "xyz"]


def _numbered(columns: int) -> tuple[str, ...]:
    return ("x", "y", "z", *(f"column_{i}" for i in range(4, columns + 1)))


def _need(data: bytes, start: int, size: int, count: int) -> None:
    if len(data) - start < size:
        raise _Problem(
            f"is cut off: expected {size} bytes for {count} points, got {max(len(data) - start, 0)}; copy it again"
        )


def _count(text: str, what: str) -> int:
    if not re.fullmatch(r"[0-9]{1,18}", text):
        raise _Problem(f"expected a whole number as the header's {what}, got {_shorten(text)!r}: export it again")
    return int(text)


def _columns(data: bytes, start: int, count: int, dtype: np.dtype) -> np.ndarray:
    """The first three fields of `count` packed rows, (count, 3) float64."""
    _need(data, start, count * dtype.itemsize, count)
    rows = np.frombuffer(data, dtype, count, start)
    return np.stack([rows[name].astype(np.float64) for name in dtype.names[:3]], axis=-1)


def _xyz_dtype(pick: list[int], formats: list[str], offsets: list[int], row_size: int) -> np.dtype:
    """A row of which only x, y and z are looked at; the names of other fields may be anything, even twice the same."""
    at = {"formats": [formats[i] for i in pick], "offsets": [offsets[i] for i in pick]}
    return np.dtype({"names": ["x", "y", "z"], "itemsize": row_size, **at})


# ---- PCD: https://pointclouds.org/documentation/tutorials/pcd_file_format.html


def _parse_pcd(data: bytes):
    if not re.match(rb"\s*(#|VERSION|FIELDS|COLUMNS)", data):
        raise _Problem(f"expected a PCD header, got {_shorten(repr(data[:16]))}: is it another format?")
    end = re.search(rb"^DATA[ \t]+(\w+)[ \t]*\r?\n", data, re.MULTILINE)
    if end is None:
        raise _Problem("expected a PCD header with a DATA line, got none: it is cut off or damaged, export it again")
    header: dict[str, list[str]] = {}
    for line in data[: end.start()].decode("utf-8", "replace").splitlines():
        if line.strip() and not line.lstrip().startswith("#"):
            key, *values = line.split()
            header[key.upper()] = values
    names = tuple(header.get("FIELDS") or header.get("COLUMNS") or ())
    # the older versions of the format leave out COUNT
    sizes, types, counts = (header.get(key, ["1"] * len(names)) for key in ("SIZE", "TYPE", "COUNT"))
    if not len(sizes) == len(types) == len(counts) == len(names):
        came = f"{len(names)} fields, {len(sizes)} sizes, {len(types)} types and {len(counts)} counts"
        raise _Problem(
            f"expected a PCD header with as many SIZE, TYPE and COUNT as FIELDS, got {came}: export it again"
        )
    counts = [_count(c, "COUNT") for c in counts]
    formats = [t.lower() + s for t, s in zip(types, sizes, strict=True)]
    for text in set(formats) - set(_PCD_TYPES):
        raise _Problem(f"expected PCD TYPE F, I or U with SIZE 1, 2, 4 or 8, got {_shorten(text)!r}: export it again")
    if "POINTS" in header:
        count = _count(" ".join(header["POINTS"]), "POINTS")
    else:
        count = math.prod(_count(" ".join(header.get(key, ())), key) for key in ("WIDTH", "HEIGHT"))
    pick = _pick_xyz(names)
    if any(counts[i] != 1 for i in pick):
        raise _Problem("expected COUNT 1 for x, y and z in the PCD header: export the points without features")

    kind, body = end.group(1).decode().lower(), data[end.end() :]
    formats = ["<" + text for text in formats]
    sizes = [int(s) * c for s, c in zip(sizes, counts, strict=True)]
    offsets = [sum(sizes[:i]) for i in range(len(names))]
    if not count:
        points = np.empty((0, 3))
    elif kind == "ascii":
        points = _parse_rows(_decode(body), [sum(counts[:i]) for i in pick], num_rows=count)
    elif kind == "binary":
        points = _columns(body, 0, count, _xyz_dtype(pick, formats, offsets, sum(sizes)))
    elif kind == "binary_compressed":
        content = _decompress(body, count * sum(sizes), count)
        # there the fields lie one after the other, each with all its points
        parts = [np.frombuffer(content, formats[i], count, count * offsets[i]) for i in pick]
        points = np.stack([part.astype(np.float64) for part in parts], axis=-1)
    else:
        raise _Problem(f"expected PCD DATA ascii, binary or binary_compressed, got {kind!r}: export it again")
    return points, names, ()


def _decompress(body: bytes, size: int, count: int) -> bytes:
    """The bytes of a binary_compressed body: its packed size, its unpacked size, LZF."""
    import lzf

    _need(body, 0, 8, count)
    packed, unpacked = (int(n) for n in np.frombuffer(body, "<u4", 2))
    _need(body, 8, packed, count)
    if unpacked != size or unpacked > packed * _LZF_MAX_RATIO:
        came = f"a compressed part of {packed} bytes for {unpacked}"
        raise _Problem(f"expected {size} bytes for the {count} points of the header, got {came}: export it again")
    content = lzf.decompress(body[8 : 8 + packed], unpacked)
    if content is None or len(content) != size:
        raise _Problem("expected LZF-compressed points, got damaged ones: copy or export it again")
    return content


# ---- PLY: http://paulbourke.net/dataformats/ply/


def _parse_ply(data: bytes):
    start = re.match(rb"ply[ \t]*(\r\n|\n|\r)", data)
    if start is None:
        raise _Problem(f"expected a PLY header, got {_shorten(repr(data[:16]))}: is it another format?")
    # with the first line's kind of line end, since binary rows may begin with a byte that looks like one
    end = re.compile(rb"[\r\n]end_header[ \t]*" + start.group(1)).search(data)
    if end is None:
        raise _Problem("expected a PLY header with an end_header line, got none: it is cut off, export it again")
    encoding, elements = "", []
    for line in data[: end.start()].decode("utf-8", "replace").splitlines()[1:]:
        match line.split():
            case ["format", kind, *_]:
                encoding = kind
            case ["element", name, number]:
                elements.append((name, _count(number, f"number of {name}"), []))
            case ["property", *kind, name] if elements and kind:
                elements[-1][2].append((name, " ".join(kind)))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise _Problem(f"expected a PLY header line, got {_shorten(line)!r}: export it again")
    if encoding not in _PLY_ORDERS:
        raise _Problem(
            f"expected a PLY format of {', '.join(_PLY_ORDERS)}, got {_shorten(encoding)!r}: export it again"
        )

    position, lines_before = end.end(), 0
    for name, count, properties in elements:
        odd = next((kind for _, kind in properties if kind not in _PLY_TYPES), None)
        if odd and (name == "vertex" or encoding != "ascii"):
            came = f"{_shorten(odd)!r} in {_shorten(name)}"
            raise _Problem(
                f"expected PLY vertices of plain numbers, before any list, got {came}: export the points alone"
            )
        formats = [_PLY_ORDERS[encoding] + _PLY_TYPES.get(kind, "u1") for _, kind in properties]
        sizes = [np.dtype(f).itemsize for f in formats]
        if name == "vertex":
            break
        position += count * sum(sizes)
        lines_before += count
    else:
        raise _Problem("expected a PLY element 'vertex', got none: export the points")
    names = tuple(n for n, _ in properties)
    pick = _pick_xyz(names)
    if not count:
        points = np.empty((0, 3))
    elif encoding == "ascii":
        points = _parse_rows(_decode(data[end.end() :]), pick, num_rows=count, skip_rows=lines_before)
    else:
        offsets = [sum(sizes[:i]) for i in range(len(names))]
        points = _columns(data, position, count, _xyz_dtype(pick, formats, offsets, sum(sizes)))
    return points, names, ()


# ---- raw float32 rows


def _parse_bin(data: bytes, columns: int | None):
    if re.fullmatch(rb"[\t\r\n -~]+", data[:1024]):
        raise _Problem("expected raw float32 rows, got text: rename it to .txt or .csv")
    notes = ()
    if columns is None:
        columns, notes = _guess_columns(data)
    if len(data) % (4 * columns):
        fits = next((c for c in (4, 5, 6, 3, 7, 8) if len(data) % (4 * c) == 0), None)
        remedy = (
            f"give columns={fits} if rows have {fits} values"
            if fits
            else "it is cut off or not raw float32, copy it again"
        )
        came = f"{len(data)} bytes, which do not divide by {4 * columns}"
        raise _Problem(f"expected rows of {columns} float32 (x y z first), got {came}: {remedy}")
    points = np.frombuffer(data, "<f4").reshape(-1, columns)[:, :3].astype(np.float64)
    share = float((np.isfinite(points) & (np.abs(points) > _MAX_PLAUSIBLE)).any(axis=1).mean())
    if share > _MAX_IMPLAUSIBLE_SHARE:
        came = f"{share:.0%} of rows beyond {_MAX_PLAUSIBLE:g} m"
        raise _Problem(f"expected rows of {columns} float32 in metres, got {came}: another format, or give columns=")
    return points, {4: KITTI_FIELDS, 5: NUSCENES_FIELDS}.get(columns) or _numbered(columns), notes


def _guess_columns(data: bytes) -> tuple[int, tuple[str, ...]]:
    """(values a row, warnings): KITTI's 4 but where the size or the content speaks for nuScenes' 5."""
    four, five = len(KITTI_FIELDS), len(NUSCENES_FIELDS)
    if len(data) % (4 * five):
        return four, ()
    # where both divide: a fifth value that is always a beam number is no accident, misaligned metres are not whole
    ring = np.frombuffer(data, "<f4").reshape(-1, five)[:, -1]
    beams = bool(((ring >= 0) & (ring < _MAX_BEAMS) & (ring == np.floor(ring))).all() and ring.any())
    if len(data) % (4 * four) == 0 and not beams:
        return four, ()
    why = "every fifth value is a beam number" if beams else "the size divides by 5 values and not by 4"
    return five, (f"read as rows of 5 float32 (nuScenes), since {why}; give columns=4 (KITTI) if that is wrong",)


# ---- NumPy: https://numpy.org/doc/stable/reference/generated/numpy.lib.format.html


def _parse_npy(data: bytes):
    return _points_of(_load_array(data), "the array")


def _parse_npz(data: bytes):
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            key, content = _choose_array(archive)
    except (_Problem, MemoryError):
        raise
    except Exception as error:
        reason = _shorten(str(error))
        raise _Problem(
            f"expected a NumPy .npz archive, got a damaged or cut off one ({reason}): save it again"
        ) from None
    return _points_of(_load_array(content), f"the array {_shorten(key)!r}")


def _choose_array(archive: zipfile.ZipFile) -> tuple[str, bytes]:
    """(name, .npy content) of the array of points: `points`, else `xyz`, else the only one of their shape."""
    keys = {name.removesuffix(".npy"): name for name in archive.namelist() if name.endswith(".npy")}
    named = [key for key in ("points", "xyz") if key in keys]
    if not named:
        for key, name in keys.items():
            with archive.open(name) as member:
                shape, _, dtype = _array_header(member)
            if (len(shape) == 2 and shape[1] >= 3 and dtype.kind in "fiu") or (dtype.names and len(shape) == 1):
                named.append(key)
        if len(named) != 1:
            came = _shorten(", ".join(keys)) or "no array"
            raise _Problem(f"expected 'points', 'xyz' or one (n, 3+) array alone, got {came}: save it with points=")
    return named[0], archive.read(keys[named[0]])


def _array_header(file) -> tuple[tuple[int, ...], bool, np.dtype]:
    """(shape, Fortran order, dtype) of a .npy stream, which is left at its first value."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # files of Python 2 are as good as others
            version = np.lib.format.read_magic(file)
            # version 3 differs from 2 by the characters that field names may have
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            return read(file)
    except Exception as error:
        reason = _shorten(str(error))
        raise _Problem(
            f"expected a NumPy .npy header, got another or a damaged one ({reason}): save it again"
        ) from None


def _load_array(data: bytes) -> np.ndarray:
    """The array in a .npy file's bytes; nothing is unpickled, and the size is checked before the values are read."""
    file = io.BytesIO(data)
    shape, fortran, dtype = _array_header(file)
    if dtype.hasobject:
        raise _Problem("expected an array of numbers, got dtype object: save a float array with numpy.save")
    if any(n < 0 for n in shape):
        raise _Problem(f"expected an array (n, 3+), got the shape {shape}: save it again")
    count = math.prod(shape)
    _need(data, file.tell(), count * dtype.itemsize, shape[0] if shape else 1)
    if not count:
        return np.empty(shape, dtype)
    return np.frombuffer(data, dtype, count, file.tell()).reshape(shape, order="F" if fortran else "C")


def _points_of(array: np.ndarray, what: str):
    if array.dtype.names:
        names = array.dtype.names
        parts = [array[names[i]] for i in _pick_xyz(names)]
        if any(part.ndim != 1 or part.dtype.kind not in "fiu" for part in parts):
            raise _Problem(
                f"expected (n,) records with numbers x, y, z in {what}, got {array.shape}: save (n, 3) floats"
            )
        return np.stack([part.astype(np.float64) for part in parts], axis=-1), names, ()
    if array.dtype.kind not in "fiu":
        raise _Problem(f"expected numbers in {what}, got dtype {array.dtype}: save a float array")
    if array.ndim != 2 or array.shape[1] < 3:
        remedy = "save a row for each point"
        if array.ndim == 2 and 3 <= array.shape[0] <= 5:
            remedy = "save its transpose, points.T"
        elif array.ndim > 2 and array.shape[-1] >= 3:
            remedy = f"save points.reshape(-1, {array.shape[-1]})"
        raise _Problem(f"expected {what} to have the shape (n, 3+), got {array.shape}: {remedy}")
    return array[:, :3].astype(np.float64), _numbered(array.shape[1]), ()


# ---- text


def _parse_text(data: bytes):
    text = _decode(data)
    skip, comment, first = 0, "", ""
    lines = io.StringIO(text)
    for line in lines:
        first = line.split("#")[0].strip()
        if first:
            break
        comment = line.lstrip("# \t").strip() or comment
        skip += 1
    else:
        raise _Problem("has no points; expected lines of x y z: was it saved completely?")

    separator, decimal = _separator(first)
    # CloudCompare marks its header by slashes
    names = _split(first.removeprefix("//").strip(), separator)
    has_header = not all(_is_number(cell, decimal) for cell in names)
    if has_header:
        if not {"x", "y", "z"} <= {name.lower() for name in names}:
            raise _Problem(
                f"expected numbers, or a header with x, y and z, on line {skip + 1}, got {_shorten(first)!r}: "
                "export or rename x, y, z"
            )
        row = next((r for r in (line.split("#")[0].strip() for line in lines) if r), "")
        decimal = "," if separator != "," and "," in row else "."
    elif len(names) < 3:
        came = f"{len(names)} on line {skip + 1}, {_shorten(first)!r}"
        raise _Problem(f"expected at least 3 columns x y z, got {came}: export x, y and z")
    else:
        names = _names_above(comment, len(names))
    # lines that are blank but for a comment would count as rows without values
    text = re.sub(r"(?m)^[ \t]+$", "", re.sub(r"[ \t]*#.*", "", text))
    style = {"separator": separator, "decimal": decimal}
    return _parse_rows(text, _pick_xyz(names), skip_rows=skip + has_header, **style), tuple(names), ()


def _decode(data: bytes) -> str:
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise _Problem("expected text in UTF-8, got UTF-16: save it as UTF-8")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise _Problem(f"expected text in UTF-8, got other bytes at {error.start}: save it as UTF-8") from None
    if "\x00" in text:
        raise _Problem("expected text, got zero bytes: is it another format?")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _parse_rows(
    text: str,
    columns: list[int],
    *,
    num_rows: int | None = None,
    skip_rows: int = 0,
    separator: str | None = None,
    decimal: str = ".",
) -> np.ndarray:
    """The columns at three positions as (n, 3) float64; missing values are NaN.

    num_rows: how many rows must be there, None for all; skip_rows: lines to leave out at the start; separator None is
    any run of blanks.
    """
    import pandas as pd

    start = 0
    for _ in range(skip_rows):
        start = text.find("\n", start) + 1
        if not start:
            break
    # a row takes two characters at least, which bounds what a header may claim before anything is allocated
    if (skip_rows and not start and num_rows) or (num_rows and 2 * num_rows > len(text) - start + 1):
        raise _Problem(f"is cut off: expected {num_rows} points, got less text than that; export it again")
    body = text[start:] if start or not skip_rows else ""
    try:
        frame = pd.read_csv(
            io.StringIO(body),
            header=None,
            sep=separator or r"\s+",
            usecols=sorted(columns),
            dtype=np.float64,
            skipinitialspace=True,
            nrows=num_rows,
            decimal=decimal,
            na_values=list(_MISSING),
            engine="c",
        )
    except pd.errors.EmptyDataError:
        return np.empty((0, 3))
    except ValueError as error:
        for number, line in enumerate(body.splitlines(), skip_rows + 1):
            cells = _split(line.strip(), separator)
            if line.strip() and not all(i < len(cells) and _is_number(cells[i], decimal) for i in columns):
                came = f"{_shorten(line)!r} on line {number}{' of the points' if num_rows else ''}"
                raise _Problem(f"expected numbers for x, y and z, got {came}: correct that line") from None
        raise _Problem(f"expected rows of numbers ({_shorten(str(error))}): export it again") from None
    if num_rows and len(frame) < num_rows:
        raise _Problem(f"is cut off: expected {num_rows} points, got {len(frame)}; copy or export it again")
    return frame[columns].to_numpy(np.float64)


def _split(line: str, separator: str | None) -> list[str]:
    return [cell.strip().strip("\"'").strip() for cell in line.split(separator)]


def _separator(line: str) -> tuple[str | None, str]:
    """(what separates the cells of a line, None for blanks; the decimal mark)."""
    if ";" in line:
        return ";", "," if "," in line else "."
    # 1,5 2,5 3,5 has its commas within the numbers, 1, 2, 3 after them
    words = line.split()
    if "," in line and len(words) >= 3 and all(re.fullmatch(r"[-+]?\d+(,\d+)?([eE][-+]?\d+)?", w) for w in words):
        return None, ","
    if "," in line:
        return ",", "."
    return ("\t" if line.count("\t") >= 2 else None), "."


def _is_number(cell: str, decimal: str) -> bool:
    if cell.lower() in _MISSING:
        return True
    try:
        float(cell.replace(decimal, "."))
    except ValueError:
        return False
    return "_" not in cell


def _names_above(comment: str, count: int) -> tuple[str, ...]:
    """Column names from the comment above the numbers where it names as many with x, y and z, else the usual ones."""
    for separator in (None, ",", ";"):
        names = _split(comment, separator)
        if len(names) == count and {"x", "y", "z"} <= {name.lower() for name in names}:
            return tuple(names)
    return _numbered(count)


_PARSERS = {
    ".pcd": _parse_pcd,
    ".ply": _parse_ply,
    ".npy": _parse_npy,
    ".npz": _parse_npz,
    ".csv": _parse_text,
    ".xyz": _parse_text,
    ".txt": _parse_text,
}
SUFFIXES = (*_PARSERS, ".bin")
