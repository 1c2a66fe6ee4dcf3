"""KITTI recordings in their original layout: raw drives, and sequences of the odometry benchmark and SemanticKITTI.

Sources: Geiger et al., Vision meets Robotics: The KITTI Dataset, IJRR 2013, and the development kits of both.
"""

import re
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lidarpose.errors import LidarPoseError
from lidarpose.geometry import inverse_transform, is_rotation, rigid_transform, rotation_about
from lidarpose.io.files import read_bytes
from lidarpose.io.point_cloud import KITTI_FIELDS, read_points
from lidarpose.io.sources.folders import scan_files
from lidarpose.io.sources.frame import IndexedRecording, ReadingOptions, Sweep

# m; the Earth's radius in the development kit of the raw data
_EARTH_RADIUS = 6378137.0


def open_kitti(folder: Path, options: ReadingOptions) -> IndexedRecording | None:
    """Opens a raw drive or an odometry sequence, or the folder of scans in one; None for any other folder.

    The world's z axis points up. For a drive, the axes are east, north and up from its start; for a sequence, the
    world is the sensor's first frame.
    """
    folder = folder.absolute()
    for drive in (folder, *folder.parents[:2]):
        scans = drive / "velodyne_points" / "data"
        if scans in (folder, folder / "velodyne_points" / "data", folder / "data") and scans.is_dir():
            return _open_drive(drive, options)
    for sequence in (folder, folder.parent):
        if sequence / "velodyne" in (folder, folder / "velodyne") and (sequence / "velodyne").is_dir():
            if any((sequence / name).is_file() for name in ("calib.txt", "times.txt", "poses.txt")):
                return _open_sequence(sequence, options)
    return None


def _open_drive(drive: Path, options: ReadingOptions) -> IndexedRecording:
    files, notes = scan_files(drive / "velodyne_points" / "data")
    rows = _numbers(files)
    stamps = _timestamps(drive / "velodyne_points" / "timestamps.txt")
    times = _frame_times(stamps, rows, "velodyne_points/timestamps.txt", notes)
    calib_folder = next((path for path in (drive, drive.parent) if (path / "calib_imu_to_velo.txt").is_file()), drive)
    entries = _calibration(calib_folder / "calib_imu_to_velo.txt")
    poses = None
    if [len(entries.get(key, ())) for key in "RT"] == [9, 3]:
        T_velo_imu = rigid_transform(entries["R"].reshape(3, 3), entries["T"])
        poses = _Oxts(drive / "oxts", inverse_transform(T_velo_imu), stamps)
    if poses is None or not poses.is_there:
        poses = None
        notes.append("the sensor's poses are not known: oxts or calib_imu_to_velo.txt is missing or damaged")

    def T_world_velo(i: int) -> np.ndarray | None:
        return None if poses is None else poses.T_world_velo(rows[i])

    return _recording(drive, files, times, notes, T_world_velo, options)


def _open_sequence(sequence: Path, options: ReadingOptions) -> IndexedRecording:
    files, notes = scan_files(sequence / "velodyne")
    rows = _numbers(files)
    stamps = _table(sequence / "times.txt", 1)
    times = _frame_times(None if stamps is None else stamps[:, 0], rows, "times.txt", notes)
    tables = (sequence / "poses.txt", sequence.parent.parent / "poses" / f"{sequence.name}.txt")
    poses = _table(next((path for path in tables if path.is_file()), tables[0]), 12)
    row = _calibration(sequence / "calib.txt").get("Tr", np.zeros(0))
    if poses is None or len(row) != 12:
        notes.append("the sensor's poses are not known: poses.txt, or Tr of calib.txt, is missing or damaged")
        return _recording(sequence, files, times, notes, lambda i: None, options)
    T_cam_velo = _transform(row)

    def T_world_velo(i: int) -> np.ndarray | None:
        if not 0 <= rows[i] < len(poses):
            return None
        return inverse_transform(T_cam_velo) @ _transform(poses[rows[i]]) @ T_cam_velo

    return _recording(sequence, files, times, notes, T_world_velo, options)


def _recording(
    folder: Path, files: Sequence[Path], times, notes: list[str], T_world_velo, options: ReadingOptions
) -> IndexedRecording:
    notes += options.ignored("topic", "meta")

    def read(i: int) -> Sweep:
        cloud = read_points(files[i], columns=options.columns or len(KITTI_FIELDS))
        pose = T_world_velo(i)
        pose = pose if pose is not None and np.isfinite(pose).all() and is_rotation(pose[:3, :3]) else None
        lines = cloud.warnings if pose is not None else (*cloud.warnings, "the sensor's pose is not known")
        return Sweep(points=cloud.points, T_world_sensor=pose, origin=np.zeros(3), warnings=lines)

    return IndexedRecording(name=str(folder), ids=[path.stem for path in files], times=times, read=read, warnings=notes)


class _Oxts:
    """Poses from the drive's GPS and inertial unit: one small file per frame, read together with the frame."""

    def __init__(self, folder: Path, T_imu_velo: np.ndarray, stamps: np.ndarray | None):
        self.folder = folder
        self.T_imu_velo = T_imu_velo
        self.stamps = stamps
        imu_stamps = _timestamps(folder / "timestamps.txt")
        # set for unsynchronized drives, whose poses are matched by the nearest time
        self.own = (
            imu_stamps if imu_stamps is not None and stamps is not None and len(imu_stamps) != len(stamps) else None
        )
        files = sorted((folder / "data").glob("[0-9]*.txt"))
        first_values = _table(files[0], 30) if files else None
        self.is_there = first_values is not None
        if first_values is not None:
            self.digits = len(files[0].stem)
            # Mercator's projection with the scale of the first latitude
            self.scale = np.cos(np.radians(first_values[0, 0]))
            self.start = self._position(first_values[0])

    def _position(self, values: np.ndarray) -> np.ndarray:
        latitude, longitude = np.radians(values[:2])
        # damaged values give a non-finite position
        with np.errstate(all="ignore"):
            north = np.log(np.tan(np.pi / 4 + latitude / 2))
        return np.array([*(self.scale * _EARTH_RADIUS * np.array([longitude, north])), values[2]])

    def T_world_velo(self, row: int) -> np.ndarray | None:
        if self.own is not None and self.stamps is not None:
            if row >= len(self.stamps) or not np.isfinite([self.stamps[row], self.own.sum()]).all():
                return None
            row = int(np.abs(self.own - self.stamps[row]).argmin())
        values = _table(self.folder / "data" / f"{row:0{self.digits}}.txt", 30)
        if values is None:
            return None
        roll, pitch, yaw = values[0, 3:6]
        R = rotation_about("z", yaw) @ rotation_about("y", pitch) @ rotation_about("x", roll)
        return rigid_transform(R, self._position(values[0]) - self.start) @ self.T_imu_velo


def _numbers(files: Sequence[Path]) -> list[int]:
    """The frame number of each file: if scans are missing, the tables still have lines for them."""
    if all(re.fullmatch("[0-9]+", path.stem) for path in files):
        return [int(path.stem) for path in files]
    return list(range(len(files)))


def _frame_times(stamps: np.ndarray | None, rows: Sequence[int], name: str, notes: list[str]) -> np.ndarray | None:
    """The times (n,) s of frames, or None and a warning."""
    if stamps is not None and max(rows) < len(stamps) and np.isfinite(stamps[rows]).all():
        return stamps[rows]
    notes.append(f"{name} is missing, damaged or too short: the frames' times are not known")
    return None


def _timestamps(path: Path) -> np.ndarray | None:
    """Lines such as "2011-09-26 13:02:25.594360375" as s since 1970; NaN for empty ones; None for a damaged file."""
    lines = [line.strip() or "NaT" for line in (_text(path) or "?").strip().split("\n")]
    try:
        # numpy only warns about text that looks like a time zone
        with warnings.catch_warnings(action="error"):
            moments = np.array(lines, "datetime64[ns]")
    except (ValueError, Warning):
        return None
    return (moments - np.datetime64(0, "ns")) / np.timedelta64(1, "s")


def _table(path: Path, columns: int) -> np.ndarray | None:
    """(n, columns) finite numbers, or None if the file has other content."""
    text = _text(path)
    try:
        table = np.array([line.split() for line in (text or "").splitlines() if line.strip()], float)
    except ValueError:
        return None
    return table if table.ndim == 2 and table.shape[1] == columns and np.isfinite(table).all() else None


def _calibration(path: Path) -> dict[str, np.ndarray]:
    """The numbers of a file with lines "KEY: numbers", by key."""
    entries = {}
    for line in (_text(path) or "").splitlines():
        key, _, values = line.partition(":")
        try:
            numbers = np.array(values.split(), float)
        except ValueError:
            continue
        if np.isfinite(numbers).all():
            entries[key.strip()] = numbers
    return entries


def _transform(values: np.ndarray) -> np.ndarray:
    """The transform (4, 4) from its first three rows (12,)."""
    return rigid_transform(values.reshape(3, 4)[:, :3], values.reshape(3, 4)[:, 3])


def _text(path: Path) -> str | None:
    try:
        return read_bytes(path, expected="a KITTI file").decode("utf-8", "replace")
    except LidarPoseError:
        return None
