"""Recordings of all kinds as frames: folders of point files, datasets in their original layout, bags and packets.

`open_source` detects the format of a path. The reader of that format creates a `Recording`, whose frames are decoded
one at a time when a `FrameSource` is iterated.
"""

import glob
import os
import re
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path

from lidarpose.errors import InputError, check_int
from lidarpose.io.files import common_folder, file_error, listed
from lidarpose.io.point_cloud import RECORDINGS, SUFFIXES
from lidarpose.io.sources.folders import is_result, list_folder, natural_key, open_files, scan_files
from lidarpose.io.sources.frame import ChainedRecording, DamagedFrame, Frame, FrameSource, ReadingOptions, Recording
from lidarpose.io.sources.kitti import open_kitti
from lidarpose.io.sources.nuscenes import open_nuscenes

__all__ = ["RECORDINGS", "DamagedFrame", "Frame", "FrameSource", "is_single_scan", "open_source"]

# for each suffix in `RECORDINGS`, the module whose `open_recording(path, options)` reads it
_READERS = {".mcap": "rosbag", ".bag": "rosbag", ".db3": "rosbag", ".pcap": "captures", ".pcapng": "captures"}
_READERS |= {".lvx": "lvx", ".lvx2": "lvx"}
# the start time in the name of a part of a ROS 1 recording
_DATE = re.compile(r"_\d{4}(-\d\d){5}(?=_\d+\.bag$)")


def open_source(
    paths: str | os.PathLike | Sequence[str | os.PathLike],
    *,
    columns: int | None = None,
    topic: str | None = None,
    meta: str | os.PathLike | None = None,
    rate: float | None = None,
    start: float | None = None,
    end: float | None = None,
    every: int = 1,
) -> FrameSource:
    """Opens files, folders, patterns or recordings as frames in chronological order.

    Each point file is one frame. They are sorted by the numbers in their names, so that frame_2 is before frame_10.
    Names that end in seconds since 1970, or in milli-, micro- or nanoseconds, give the frames' times.

    Args:
        paths: one or several of: point files, folders of them, patterns such as "drive/*.pcd", recordings (.mcap .bag
            .db3 .pcap .lvx .lvx2, folders of ROS 2 bags), folders of KITTI and nuScenes. Several recordings are
            concatenated.
        columns: values per row of .bin files, see `read_points`.
        topic: the topic to read if a recording has several with points; for nuScenes, the scene.
        meta: the JSON file of an Ouster sensor; None for the file next to the recording with the same stem.
        rate: frames per second if there are no times, replacing times from file names; 10 by default.
        start: s from the first frame.
        end: s from the first frame.
        every: read only every n-th frame.

    Returns:
        The frames, with one in memory at a time; they can be iterated repeatedly.

    Raises:
        InputError: the path does not exist, or nothing in it has points.
        MissingExtra: the format needs the extra `recordings`.
    """
    if columns is not None:
        columns = check_int("columns", columns, least=3, hint=" (x y z first)")
    matched_paths = [path for path_or_pattern in listed(paths) for path in matching_paths(path_or_pattern)]
    if not matched_paths:
        raise file_error("source", "expected files, folders or recordings, got none")
    name = str(matched_paths[0]) if len(matched_paths) == 1 else common_folder(matched_paths) or "several disks"
    meta_path = None if meta is None else Path(meta)
    options = ReadingOptions(columns=columns, topic=topic, meta=meta_path, name_times=rate is None)
    return FrameSource(_open_all(name, matched_paths, options), rate=rate, start=start, end=end, every=every)


def is_single_scan(paths: str | os.PathLike | Sequence[str | os.PathLike]) -> bool:
    """Whether `paths` is a single point file or a missing file, i.e. one scan instead of frames."""
    path_list = listed(paths)
    if len(path_list) != 1 or os.path.isdir(path_list[0]):
        return False
    is_pattern = glob.has_magic(os.fspath(path_list[0])) and not os.path.exists(path_list[0])
    return not is_pattern and Path(path_list[0]).suffix.lower() not in RECORDINGS


def matching_paths(path: str | os.PathLike) -> list[Path]:
    """The paths that match a path or pattern, in natural order. Raises InputError if there are none."""
    if not isinstance(path, str | os.PathLike):
        raise InputError(f"expected paths, got {type(path).__name__} among them: give files or folders")
    if os.path.exists(path):
        return [Path(path)]
    pattern = os.fspath(path)
    paths = sorted(map(Path, glob.glob(pattern, recursive=True)), key=natural_key)
    # as in a folder, results and files of other formats, such as labels, are left out
    is_read = {p: p.suffix.lower() in (*SUFFIXES, *RECORDINGS) and not is_result(p) for p in paths}
    paths = [p for p in paths if p.is_dir() or is_read[p]] or paths
    # a/** matches folders and the files in them, which would be read twice
    read_folders = {folder for p in paths if not p.is_dir() for folder in p.parents}
    paths = [p for p in paths if p not in read_folders]
    if not paths:
        problem = "no file matches the pattern" if glob.has_magic(pattern) else "no such file or folder"
        raise file_error(path, f"{problem}; expected point files, a folder of them or a recording: check the path")
    return paths


def _open_all(name: str, paths: Sequence[Path], options: ReadingOptions) -> Recording:
    """Opens all point files together as one recording, and every other path as a recording of its own."""
    for path in paths:
        if path.is_fifo():
            raise file_error(path, "expected a file or folder, got a pipe; save it as a file first")
    files = [path for path in paths if not path.is_dir() and path.suffix.lower() not in RECORDINGS]
    parts: list[Recording] = [open_files(name, files, options)] if files else []
    problems: list[InputError] = []
    recordings = sorted(set(paths) - set(files), key=natural_key)
    if not files and _are_parts(recordings):
        # if a part is damaged, the parts are opened one by one below, without it
        with suppress(InputError):
            return import_module("lidarpose.io.sources.rosbag").open_parts(name, recordings, options)
    for path in recordings:
        try:
            parts.append(_open_folder(path, options) if path.is_dir() else _open_recording(path, options))
        except InputError as problem:
            problems.append(problem)
    if not parts:
        raise problems[0]
    if len(parts) == 1 and not problems:
        return parts[0]
    return ChainedRecording(name, parts, [f"left out: {problem}" for problem in problems])


def _are_parts(paths: Sequence[Path]) -> bool:
    """Whether the paths are one ROS recording that the recorder split: NAME_0, NAME_1, and so on."""
    if len(paths) < 2 or _READERS.get(suffix := paths[0].suffix) != "rosbag":
        return False
    names = [_DATE.sub("", str(path)) for path in paths]
    first_name = names[0].removesuffix(f"_0{suffix}")
    return names == [f"{first_name}_{k}{suffix}" for k in range(len(names))]


def _open_folder(folder: Path, options: ReadingOptions) -> Recording:
    # rosbag2 writes metadata.yaml, but a folder of scans may have a file of this name, too
    entries = list_folder(folder)
    suffixes = {path.suffix.lower() for path in entries}
    is_bag = any(_READERS.get(suffix) == "rosbag" for suffix in suffixes) or not suffixes & set(SUFFIXES)
    if is_bag and any(path.name == "metadata.yaml" for path in entries):
        return _open_recording(folder, options, "rosbag")
    dataset = open_kitti(folder, options) or open_nuscenes(folder, options)
    if dataset is not None:
        return dataset
    files, warnings = scan_files(folder, RECORDINGS)
    if files[0].suffix.lower() in RECORDINGS:
        return _open_all(str(folder), files, options)
    recording = open_files(str(folder), files, options)
    recording.warnings += warnings
    return recording


def _open_recording(path: Path, options: ReadingOptions, reader: str | None = None) -> Recording:
    module = import_module(f"lidarpose.io.sources.{reader or _READERS[path.suffix.lower()]}")
    return module.open_recording(path, options)
