"""Point files as frames: which files of a folder are read, in which order, and the times in their names."""

import os
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from lidarpose.errors import LidarPoseError
from lidarpose.io.files import common_folder, file_error, shorten
from lidarpose.io.point_cloud import SUFFIXES, read_points
from lidarpose.io.sources.frame import IndexedRecording, ReadingOptions, Sweep

# text files may be notes, tables or labels: they are read as points only if the folder has no other points
_TEXT = (".csv", ".txt", ".xyz", ".asc", ".pts")
# the number of columns of .bin files is taken from the first readable one among at most this many
_MOST_TRIED = 10

# a name that ends in seconds since 1970, with or without a fraction, or in milli-, micro- or nanoseconds
_TIME = re.compile(r"(.*\D|)(\d{10}|\d{13}|\d{16}|\d{19})(?:(?<!\d{11})([._])(\d{1,9}))?")
# 2001 to 2033; 16 digits that are a date and time give larger values
_FIRST_TIME, _LAST_TIME = 1e9, 2e9


def is_result(path: Path) -> bool:
    """Whether a file has the name of a table of joints, as `lidarpose predict` writes it."""
    return path.name.endswith(".poses.csv")


def natural_key(path: str | os.PathLike) -> tuple:
    """A sort key for names by the numbers in them: frame_2 before frame_10."""
    name = os.fspath(path)
    parts = re.split(r"([0-9]+)", name)
    return [int(part) if i % 2 else part.lower() for i, part in enumerate(parts)], name


def list_folder(folder: Path) -> list[Path]:
    """The entries of a folder except hidden ones, in natural order. Raises InputError."""
    try:
        return sorted((path for path in folder.iterdir() if not path.name.startswith(".")), key=natural_key)
    except OSError as error:
        raise file_error(folder, f"cannot be listed ({error.strerror or error}); check its permissions") from None


def scan_files(folder: Path, other: Sequence[str] = ()) -> tuple[list[Path], list[str]]:
    """The point files of a folder in natural order, and warnings.

    Tables of poses that `lidarpose predict` wrote are not point files. Files with a suffix in `other` are taken if the
    folder has no point files except text, and text files if it has no others. Of text files, and of scans that are
    present in several formats, only those of the most frequent suffix are taken.

    Raises InputError, which describes the folder's content, if there are no such files.
    """
    entries = list_folder(folder)
    suffixes = {path: path.suffix.lower() for path in entries if path.is_file() and not is_result(path)}
    kinds = ([s for s in SUFFIXES if s not in _TEXT], other, _TEXT)
    groups = [[path for path, suffix in suffixes.items() if suffix in kind] for kind in kinds]
    files = next(filter(None, groups), [])
    if not files:
        raise file_error(folder, f"expected point files ({' '.join((*SUFFIXES, *other))}), got {describe(entries)}")
    # of two equally frequent suffixes .npy is last: such files may be boxes
    counts = sorted(Counter(suffixes[path] for path in files).items(), key=lambda item: (-item[1], item[0] == ".npy"))
    left_out = Counter(suffixes[path] for path in groups[1] if files is groups[0]).most_common()
    if files is groups[2] or len({scan_id(path) for path in files}) < len(files):
        counts, left_out = counts[:1], counts[1:] + left_out
    warnings = []
    if left_out:
        names, other_names = (" and ".join(f"{n} {suffix}" for suffix, n in each) for each in (counts, left_out))
        warnings = [f"only its {names} files are read, not {other_names}: give a pattern to read those"]
    suffixes_read = {suffix for suffix, _ in counts}
    return [path for path in files if suffixes[path] in suffixes_read], warnings


def describe(entries: Sequence[Path]) -> str:
    """A description of a folder's content for an error message."""
    if not entries:
        return "an empty folder"
    folders = [path.name for path in entries if path.is_dir()]
    kinds = Counter(path.suffix.lower() or "without a suffix" for path in entries if path.name not in folders)
    parts = [f"{count} {kind}" for kind, count in kinds.most_common(5)]
    if folders:
        parts.append(f"{len(folders)} folders ({shorten(', '.join(folders), 60)}; give one of them)")
    return f"a folder with {', '.join(parts)}"


def open_files(name: str, paths: Sequence[Path], options: ReadingOptions) -> IndexedRecording:
    """Opens point files as one frame each, in natural order, or in chronological order if their names are clearly
    times. If `columns` is not given, it is taken from the first readable .bin file."""
    paths, times = in_order(paths)
    suffixes = sorted({path.suffix.lower() for path in paths})
    warnings = [f"mixes {', '.join(suffixes)} files: one sensor is assumed"] if len(suffixes) > 1 else []
    warnings += options.ignored("topic", "meta")
    columns = options.columns
    if columns is None and ".bin" in suffixes:
        columns, notes = _columns_of([path for path in paths if path.suffix.lower() == ".bin"])
        warnings += notes
    ids = [scan_id(path) for path in paths]
    if len(set(ids)) < len(ids):
        folder = common_folder(path.parent for path in paths)
        ids = [os.path.relpath(path, folder) if folder else os.path.abspath(path) for path in paths]

    def read(i: int) -> Sweep:
        cloud = read_points(paths[i], columns=columns)
        return Sweep(points=cloud.points, point_times=cloud.point_times, warnings=cloud.warnings)

    return IndexedRecording(
        name=name, ids=ids, times=times if options.name_times else None, read=read, warnings=warnings
    )


def scan_id(path: Path) -> str:
    """A file's name without its suffix; .pcd.bin is one suffix."""
    return path.stem.removesuffix(".pcd") if path.suffix.lower() == ".bin" else path.stem


def in_order(paths: Sequence[Path]) -> tuple[list[Path], list[float] | None]:
    """Paths in natural order, and None; or paths in chronological order, and their times in s since 1970, if the names
    are clearly times."""
    sorted_paths = sorted(paths, key=natural_key)
    matches = [_TIME.fullmatch(scan_id(path)) for path in sorted_paths]
    parts = [match.groups() for match in matches if match]
    # in 1700000000_5 and 1700000000_10 the last part may be nanoseconds or a decimal fraction
    if len(parts) < len(sorted_paths) or len({len(part) for *_, mark, part in parts if mark == "_"}) > 1:
        return sorted_paths, None
    seconds = [_seconds(digits, part or "") for _, digits, _, part in parts]
    # sorted by value: 1700000000.5 is later than 1700000000.25, although 5 is before 25 in natural order
    rows = sorted(range(len(sorted_paths)), key=lambda row: (natural_key(parts[row][0]), seconds[row]))
    times = [seconds[row] for row in rows]
    is_rising = all(earlier < later for earlier, later in zip(times, times[1:], strict=False))
    if not is_rising or not _FIRST_TIME <= times[0] <= times[-1] <= _LAST_TIME:
        return sorted_paths, None
    return [sorted_paths[row] for row in rows], times


def _seconds(digits: str, fraction: str) -> float:
    return float(f"{digits[:10]}.{digits[10:]}{fraction}")


def _columns_of(paths: Sequence[Path]) -> tuple[int | None, list[str]]:
    """The values per row of raw float32 files, and warnings about the guess, from the first readable file."""
    for path in paths[:_MOST_TRIED]:
        try:
            cloud = read_points(path)
        except LidarPoseError:
            continue
        return len(cloud.fields), [line for line in cloud.warnings if line.startswith("read as rows")]
    return None, []
