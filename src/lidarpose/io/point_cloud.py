"""Point clouds from files: PCD, PLY, LAS, raw float32, NumPy and text.

The suffix, in upper or lower case, determines the format. Coordinates are not changed (meters are assumed, nothing is
rotated or scaled). They are float64, since float32 rounds map coordinates such as UTM to half a meter. A column with
the times of the points is read, too; others are listed in `Cloud.fields` and otherwise ignored.

The sizes in a header are checked against the file before numpy, pandas or LZF decode it. A parser takes a file's bytes
and a function that picks columns by their names, and returns these columns (n, 3 or 4) and all names; it raises
`FormatError`, to which `read_points` adds the file name.
"""

import os
import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from lidarpose.errors import MissingExtra, check_int
from lidarpose.io.files import FormatError, file_error, read_bytes, shorten
from lidarpose.io.las import parse_las
from lidarpose.io.npz import load_array, member_header, open_npz, unpack
from lidarpose.io.pcd_ply import parse_pcd, parse_ply, viewpoint_notes
from lidarpose.io.point_times import times_of_column
from lidarpose.io.text import (
    FEW_ROWS,
    PickColumns,
    is_image,
    is_transposed,
    numbered,
    parse_text,
    pick_xyz,
    pick_xyz_and_time,
)

KITTI_FIELDS = ("x", "y", "z", "intensity")
NUSCENES_FIELDS = ("x", "y", "z", "intensity", "ring")

# meters; no coordinate on Earth is larger (earth-centered ones reach 6.4e6), but most misread bytes are
_MAX_PLAUSIBLE = 1e7
# if more than this share of the rows exceeds `_MAX_PLAUSIBLE`, raw bytes are not float32 rows
_MAX_IMPLAUSIBLE_SHARE = 0.01
# beams are numbered from 0; no LiDAR has more
_MAX_BEAMS = 256
# raw bytes are read as rows of another number of columns if that decreases the mean logarithm of the columns' standard
# deviations by this much. In synthetic sweeps and people of 20 and more rows, the decrease is 0.5 or more if the other
# number is right, and below 0.05 if it is wrong
_NARROWER = 0.4
# rows of six values have x, y, z, intensity, beam and time, or x, y, z and colors; considered from 20 rows on
_SIX, _FEWEST_ROWS = 6, 20
# m; no LiDAR has a longer range; added to each column's standard deviation, as if constant columns had noise
_FAR, _NARROWEST = 1e3, 1e-3

# suffixes of files with many scans
RECORDINGS = (".mcap", ".bag", ".db3", ".pcap", ".pcapng", ".lvx", ".lvx2")
# first bytes of other formats that users rename by mistake, with the remedy; too long to occur as float32 coordinates
_FOREIGN = {
    rb"\x1f\x8b\x08[\x00-\x1f]": "is gzip-compressed: unpack it first (gunzip)",
    rb"PK\x03\x04": "is a zip archive: unpack it first",
    rb"BZh[1-9]1AY&SY": "is bzip2-compressed: unpack it first (bunzip2)",
    rb"\xfd7zXZ\x00": "is xz-compressed: unpack it first (unxz)",
    rb"\x28\xb5\x2f\xfd": "is zstd-compressed: unpack it first (unzstd)",
    rb"\x89PNG\r\n\x1a\n": "is a PNG picture: expected a point cloud; give the point cloud's file",
    rb"\xff\xd8\xff[\xdb\xe0\xe1\xee]": "is a JPEG picture: expected a point cloud; give the point cloud's file",
    rb"\x89HDF\r\n\x1a\n": "is an HDF5 file: save the points as .npy first",
    rb"(?i)\s*<(!doctype html|html|\?xml)": "is a web page or XML: expected a point cloud; download it again",
    rb"version https://git-lfs": "is a Git LFS pointer, not the data: run `git lfs pull`",
}
# what to do with files of other formats
_CONVERTED = {".lvx3": "export it with Livox Viewer as .las or .csv"}
_CONVERTED |= {".json": "give a point file; boxes are given by --boxes"}
_CONVERTED |= {".osf": "convert it (ouster-cli source FILE.osf save FILE.pcap)"}
_CONVERTED |= dict.fromkeys((".e57", ".ptx", ".fls"), "export it as .las or .ply (CloudCompare does)")
_MAGIC = {
    ".npy": rb"\x93NUMPY",
    ".ply": rb"ply[ \t]*[\r\n]",
    ".pcd": rb"# \.PCD v",
    ".las": rb"LASF",
    # a zip archive whose first file is an array
    ".npz": rb"(?s)PK\x03\x04.{26}[^/]{1,200}?\.npy",
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Cloud:
    """A point cloud as read from a file.

    points: (n, 3) float64, x y z in the file's own frame and unit, all finite, n > 0; num_dropped: number of rows
    dropped because a coordinate was NaN, infinite or missing; fields: names of all columns of the file; warnings:
    lines for the user; point_times: (n,) float32 s, when each point was measured relative to the newest, None if the
    file does not tell.
    """

    points: np.ndarray
    num_dropped: int = 0
    fields: tuple[str, ...] = ("x", "y", "z")
    warnings: tuple[str, ...] = ()
    point_times: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        return f"Cloud({len(self):,} points, columns {' '.join(self.fields)})"

    def __array__(self, dtype=None, copy=None) -> np.ndarray:
        """The points, so that the cloud itself can be passed to `predict`."""
        return np.array(self.points, dtype, copy=copy)


def read_points(path: str | os.PathLike, *, columns: int | None = None) -> Cloud:
    """Reads a point cloud; the suffix determines the format.

    .pcd (ascii, binary, binary_compressed), .ply (the vertices; ascii, binary of either byte order), .las, .laz (all
    point formats), .npy ((n, 3+) or records with x, y, z), .npz (`points`, else `xyz`, else its only (n, 3+) array),
    .csv .xyz .txt .asc .pts (with or without a header; commas, semicolons, tabs or blanks; # starts a comment), .bin
    (rows of `columns` float32). Points that are NaN or infinite are dropped with a warning; `predict` and `detect` also
    drop those beyond 1e9 m and, if there is more than one of them, at 0,0,0.

    Args:
        columns: values per row of a .bin file, x y z first; other formats ignore it. With None, rows have 4 values
            (KITTI) or, if the file size or the values indicate it, 5 (nuScenes), 3 or 6, which a warning reports;
            `.pcd.bin`, nuScenes' own suffix, means 5.

    Raises:
        InputError: one line that names the file, what was expected, what was found and the remedy, also for a file
            without any finite point. MissingExtra: .laz without the extra `recordings`.
    """
    if columns is not None:
        columns = check_int("columns", columns, least=3, hint=" (x y z first)")
    if isinstance(path, str | os.PathLike) and os.path.isdir(path):
        remedy = "give a file in it, or read all of it with lidarpose predict, in Python with predict_recording"
        raise file_error(path, FormatError("one point cloud", "a folder", remedy))
    data = read_bytes(path, expected=f"a point cloud ({' '.join(SUFFIXES)})")
    name = os.path.basename(os.fsdecode(path)).lower()
    suffix = os.path.splitext(name)[1]
    try:
        _refuse_foreign(data, suffix)
        # silences warnings about invalid numbers, which are dropped and counted below, and about files of Python 2
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            notes: tuple[str, ...] = ()
            if suffix == ".bin":
                columns = 5 if columns is None and name.endswith(".pcd.bin") else columns
                values, fields, notes = _parse_bin(data, columns)
            else:
                values, fields = _parsed(_PARSERS[suffix], data)
                notes = viewpoint_notes(data) if suffix == ".pcd" else ()
            points = np.ascontiguousarray(values[:, :3], dtype=np.float64)
            times = times_of_column(values[:, 3], fields) if values.shape[1] > 3 else None
            is_finite = np.isfinite(points).all(axis=1)
        num_dropped = len(points) - int(is_finite.sum())
        if not len(points):
            raise FormatError("has no points; expected at least one: was it saved completely?")
        if num_dropped == len(points):
            raise FormatError("finite x, y, z", f"NaN or infinity in all {num_dropped} points", "export it again")
    except FormatError as problem:
        raise file_error(path, problem) from None
    except MissingExtra:
        raise
    except MemoryError:
        raise file_error(path, "does not fit in memory; split it first") from None
    except Exception as error:
        reason = shorten(f"{type(error).__name__}: {error}")
        raise file_error(path, f"cannot be read as a {suffix} file ({reason}); export it again") from None
    if num_dropped:
        notes = (*notes, f"dropped {num_dropped} of {len(points)} points that were NaN, infinite or incomplete")
        points, times = points[is_finite], None if times is None else times[is_finite]
    return Cloud(points=points, num_dropped=num_dropped, fields=tuple(fields), warnings=tuple(notes), point_times=times)


def _parsed(parse: Callable, data: bytes) -> tuple[np.ndarray, Sequence[str]]:
    """The columns of a file: x, y, z, and the points' times unless they are no numbers."""
    try:
        return parse(data, pick_xyz_and_time)
    except (FormatError, ValueError):
        return parse(data, pick_xyz)


def _refuse_foreign(data: bytes, suffix: str) -> None:
    """Raises FormatError for content that clearly has another format than the suffix, and for unsupported suffixes."""
    for content_suffix, pattern in _MAGIC.items():
        if re.match(pattern, data):
            if content_suffix != suffix.replace(".laz", ".las"):
                raise FormatError(
                    f"a {suffix or 'known'} file",
                    f"a {content_suffix} file's content",
                    f"rename it to {content_suffix}",
                )
            return
    for pattern, problem in _FOREIGN.items():
        if re.match(pattern, data):
            raise FormatError(problem)
    if suffix in RECORDINGS:
        raise FormatError(
            "one scan", f"a recording ({suffix})", "read it with lidarpose predict, in Python with predict_recording"
        )
    if suffix not in SUFFIXES:
        remedy = _CONVERTED.get(suffix, "convert or rename the file")
        raise FormatError(f"one of {' '.join(SUFFIXES)}", f"the suffix {suffix!r}", remedy)


# ---- raw float32 rows


def _parse_bin(data: bytes, columns: int | None):
    # printable bytes alone do not suffice, since a few float32 may be printable: 837282 is " jLI"
    if re.fullmatch(rb"[\t\r\n -~]+", data[:1024]) and re.search(rb"[0-9][\s,;]+[-+.]?[0-9]", data[:1024]):
        raise FormatError("raw float32 rows", "text", "rename it to .txt or .csv")
    notes: tuple[str, ...] = ()
    if columns is None:
        columns, notes = _guess_columns(data)
    if len(data) % (4 * columns):
        fitting_columns = [str(c) for c in range(3, 9) if len(data) % (4 * c) == 0]
        remedy = (
            f"give the number of values per row (--columns {' or '.join(fitting_columns)})"
            if fitting_columns
            else "it is cut off or not raw float32, copy it again"
        )
        actual = f"{len(data)} bytes, which is not a multiple of {4 * columns}"
        raise FormatError(f"rows of {columns} float32 (x y z first)", actual, remedy)
    points = np.frombuffer(data, "<f4").reshape(-1, columns)[:, :3].astype(np.float64)
    share = float((np.isfinite(points) & (np.abs(points) > _MAX_PLAUSIBLE)).any(axis=1).mean())
    if share > _MAX_IMPLAUSIBLE_SHARE:
        actual = f"{share:.0%} of rows beyond {_MAX_PLAUSIBLE:g} m"
        raise FormatError(
            f"rows of {columns} float32 in meters", actual, "is it another format, or another number of columns?"
        )
    return points, {4: KITTI_FIELDS, 5: NUSCENES_FIELDS}.get(columns) or numbered(columns), notes


def _guess_columns(data: bytes) -> tuple[int, tuple[str, ...]]:
    """(values per row, warnings): KITTI's 4 unless the size or the content indicates nuScenes' 5, 3, or 6."""
    four, five = len(KITTI_FIELDS), len(NUSCENES_FIELDS)
    candidates = [columns for columns in (four, five, 3) if len(data) % (4 * columns) == 0]
    if len(data) % (4 * _SIX) == 0 and len(data) >= 4 * _SIX * _FEWEST_ROWS:
        candidates.append(_SIX)
    guess = four if four in candidates or five not in candidates else five
    reason, alternative = "the size is a multiple of 5 values and not of 4" if guess == five else "", four
    values = np.frombuffer(data[: len(data) // 4 * 4], "<f4")
    if five in candidates:
        # a fifth value that is always a beam number is not a coincidence: misaligned meters are not whole numbers
        ring = values.reshape(-1, five)[:, -1]
        if ((ring >= 0) & (ring < _MAX_BEAMS) & (ring == np.floor(ring))).all() and ring.any():
            guess, candidates, reason = five, [five], "every fifth value is a beam number"
    if candidates and guess not in candidates:
        # neither 4 nor 5 divides the size; the columns of cut off rows of 4 or 5 would be narrower than those of 3 or 6
        widths = {columns: _width(values, columns) for columns in (*candidates, four, five)}
        narrowest = min(widths, key=widths.__getitem__)
        if narrowest in candidates and widths[narrowest] < min(widths[four], widths[five]) - _NARROWER:
            guess, alternative = narrowest, _SIX if narrowest == 3 else 3
            reason = f"the size is a multiple of {guess} values and not of 4"
    elif len(candidates) > 1:
        widths = {columns: _width(values, columns) for columns in candidates}
        narrowest = min(candidates, key=widths.__getitem__)
        if widths[narrowest] < widths[guess] - _NARROWER:
            guess, reason = narrowest, f"rows of {guess} would mix up its columns"
        elif narrowest != guess:
            reason, alternative = f"nothing clearly indicates rows of {narrowest}", narrowest
    if not reason:
        return guess, ()
    names = {four: " (KITTI)", five: " (nuScenes)"}
    remedy = f"give --columns {alternative}{names.get(alternative, '')} if that is wrong"
    return guess, (f"read as rows of {guess} float32{names.get(guess, '')}, since {reason}; {remedy}",)


def _width(values: np.ndarray, columns: int) -> float:
    """Mean logarithm of the standard deviations of the columns of values (n,) in rows of `columns`, without an
    incomplete last row. It is smallest for the right number of columns, since any other number mixes x, y, z and the
    rest in all columns. Infinite if no value is a number."""
    rows = values[: len(values) // columns * columns].reshape(-1, columns)
    spread = np.nanstd(np.clip(rows, -_FAR, _FAR), axis=0, dtype=np.float64)
    width = float(np.nan_to_num(np.log(spread + _NARROWEST).mean(), nan=np.inf))
    # rows of 3 read as rows of 6 have columns of the same spread, so 6 needs a clear advantage over 3
    return width + _NARROWER if columns == _SIX else width


# ---- NumPy


def _parse_npy(data: bytes, pick: PickColumns):
    return _points_of(load_array(data), "the array", pick)


def _parse_npz(data: bytes, pick: PickColumns):
    """Reads the array `points`, else `xyz`, else the only array with the shape of points."""
    with open_npz(data) as (archive, members):
        keys = [key for key in ("points", "xyz") if key in members]
        for key, member in members.items() if not keys else ():
            shape, dtype = member_header(archive, member)
            if (len(shape) == 2 and shape[1] >= 3 and dtype.kind in "fiu") or (dtype.names and len(shape) == 1):
                keys.append(key)
        if not keys or len(keys) > 1 and keys[0] not in ("points", "xyz"):
            actual = shorten(", ".join(members)) or "no array"
            raise FormatError("'points', 'xyz' or a single (n, 3+) array", actual, "save it with points=")
        (content,) = unpack(archive, [members[keys[0]]], len(data))
        return _points_of(load_array(content), f"the array {shorten(keys[0])!r}", pick)


def _points_of(array: np.ndarray, label: str, pick: PickColumns):
    if array.dtype.names:
        names = array.dtype.names
        parts = [array[names[i]] for i in pick(names)]
        if any(part.ndim != 1 or part.dtype.kind not in "fiu" for part in parts):
            raise FormatError(f"(n,) records with numbers x, y, z in {label}", array.shape, "save (n, 3) floats")
        return np.stack([part.astype(np.float64) for part in parts], axis=-1), names
    if array.dtype.kind not in "fiu":
        raise FormatError(f"numbers in {label}", f"dtype {array.dtype}", "save a float array")
    if array.ndim != 2 or array.shape[1] < 3 or is_transposed(array.shape) or is_image(array.shape):
        remedy = "save x, y and z of each point" if array.ndim == 2 else "save a row for each point"
        if array.ndim == 2 and 3 <= array.shape[0] <= FEW_ROWS:
            remedy = "save its transpose, points.T"
        elif is_image(array.shape):
            remedy = "convert the pixels of a depth image to points"
        elif array.ndim > 2 and array.shape[-1] >= 3:
            remedy = f"save points.reshape(-1, {array.shape[-1]})"
        raise FormatError(f"{label} to have the shape (n, 3+)", array.shape, remedy)
    return array[:, :3].astype(np.float64), numbered(array.shape[1])


_PARSERS = {
    ".pcd": parse_pcd,
    ".ply": parse_ply,
    ".las": parse_las,
    ".laz": parse_las,
    ".npy": _parse_npy,
    ".npz": _parse_npz,
    ".csv": parse_text,
    ".xyz": parse_text,
    ".txt": parse_text,
    ".asc": parse_text,
    ".pts": parse_text,
}
SUFFIXES = (*_PARSERS, ".bin")
