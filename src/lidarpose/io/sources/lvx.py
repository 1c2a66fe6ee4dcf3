"""Recordings of Livox Viewer, .lvx (version 1.1) and .lvx2 (version 2.0), as frames of a tenth of a second.

Formats: Livox, LVX Specifications 1.1.0.0 and LVX2 Specifications 2.0.0.0; all numbers are little-endian.
"""

import os
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np

from lidarpose.geometry import rigid_transform, rotation_about, transform_points
from lidarpose.io.files import FormatError, file_error, unreadable
from lidarpose.io.sources.frame import IndexedRecording, ReadingOptions, Sweep

_SIGNATURE, _MAGIC = b"livox_tech", 0xAC0EA767
# duration that frames are joined to, s: one alone, of 50 ms, has few points on a person
DURATION = 0.1
# headers: of the file (signature, version, magic number), of the recording (duration of a frame, ms, number of devices)
# and of a frame (its offset, that of the next frame, its number)
_PUBLIC, _PRIVATE, _FRAME = struct.Struct("<16s4BI"), struct.Struct("<IB"), struct.Struct("<3q")
# more bytes than any frame has, and types of time stamps that are nanoseconds
_MOST_BYTES, _NANOSECONDS = 2**24, (0, 1, 2)


def _cartesian(kind: str, size: int) -> np.dtype:
    """Points of `size` bytes that begin with x, y, z."""
    return np.dtype({"names": ["xyz"], "formats": [(kind, 3)], "offsets": [0], "itemsize": size})


def _spherical(depth: int, angles: int, size: int) -> np.dtype:
    """Points of `size` bytes: depth, mm, and angles from the z axis and about it, 0.01 degrees, at these offsets."""
    offsets = [depth, angles, angles + 2]
    return np.dtype(
        {"names": ["r", "theta", "phi"], "formats": ["<u4", "<u2", "<u2"], "offsets": offsets, "itemsize": size}
    )


def _header(size: int, **fields: tuple[str, int]) -> np.dtype:
    """A header of `size` bytes. fields: kind and offset of each."""
    kinds, offsets = zip(*fields.values(), strict=True)
    return np.dtype({"names": list(fields), "formats": list(kinds), "offsets": list(offsets), "itemsize": size})


@dataclass(frozen=True, kw_only=True)
class Version:
    """A version of the format. device, package: their headers; layouts: of points, by data type, None for other data;
    counts: points of a package by data type; empty if a package states its bytes."""

    device: np.dtype
    package: np.dtype
    layouts: dict[int, np.dtype | None]
    counts: dict[int, int]


# of several returns the first
VERSIONS = {
    1: Version(
        device=_header(59, id=("u1", 32), is_used=("u1", 34), pose=("6<f4", 35)),
        package=_header(19, device=("u1", 0), stamp_type=("u1", 9), kind=("u1", 10), stamp=("<u8", 11)),
        layouts={
            **{0: _cartesian("<i4", 13), 1: _spherical(0, 4, 9), 2: _cartesian("<i4", 14), 3: _spherical(0, 4, 10)},
            **{4: _cartesian("<i4", 28), 5: _spherical(4, 0, 16), 6: None},
            **{7: _cartesian("<i4", 42), 8: _spherical(4, 0, 22)},
        },
        counts={0: 100, 1: 100, 2: 96, 3: 96, 4: 48, 5: 48, 6: 1, 7: 30, 8: 30},
    ),
    2: Version(
        device=_header(63, id=("<u4", 32), is_used=("u1", 38), pose=("6<f4", 39)),
        package=_header(
            27, device=("<u4", 1), stamp_type=("u1", 6), stamp=("<u8", 7), kind=("u1", 17), bytes=("<u4", 18)
        ),
        layouts={0: None, 1: _cartesian("<i4", 14), 2: _cartesian("<i2", 8), 3: _spherical(0, 4, 10)},
        counts={},
    ),
}
# bytes of a package of measurements of motion
_IMU_BYTES = 24


def open_recording(path: Path, options: ReadingOptions) -> IndexedRecording:
    """Opens a recording of one or several sensors.

    If the file says that a sensor's pose is to be used, its points are in the frame of that pose, else in the sensor's
    own. Raises InputError if the file is not one, or of another version.
    """
    try:
        with open(path, "rb") as file:
            recording = _open(path, file)
    except OSError as error:
        raise unreadable(path, error) from None
    recording.warnings += options.ignored("topic", "meta")
    return recording


def _open(path: Path, file: BinaryIO) -> IndexedRecording:
    head = file.read(_PUBLIC.size + _PRIVATE.size)
    if len(head) < _PUBLIC.size + _PRIVATE.size or not head.startswith(_SIGNATURE):
        raise file_error(path, "expected a recording of Livox Viewer, got something else: export it again")
    _, major, *minor, magic = _PUBLIC.unpack_from(head)
    duration, num_devices = _PRIVATE.unpack_from(head, _PUBLIC.size)
    version = VERSIONS.get(major)
    if version is None or (major, minor[0]) == (1, 0):
        problem = f"expected a recording of version 1.1 or 2.0, got {'.'.join(map(str, (major, *minor)))}"
        raise file_error(path, f"{problem}: open it in Livox Viewer and export it as .las or .csv")
    table = file.read(version.device.itemsize * num_devices)
    devices = np.frombuffer(table, version.device, len(table) // version.device.itemsize)
    poses = {int(device["id"]): device["pose"].astype(float) for device in devices if device["is_used"]}
    if magic != _MAGIC or duration < 1 or not np.isfinite(list(poses.values())).all():
        raise file_error(path, "is damaged in its first bytes: export it again")
    places, is_whole = _frame_places(file)
    length = 1e-3 * duration * len(places)
    warnings = [] if is_whole else [f"ends after {length:.2f} s, within a damaged or cut off frame"]
    if 0 < (without := num_devices - len(poses)) and num_devices > 1:
        warnings.append(f"{without} of {num_devices} sensors have no pose in use, so their points may overlap")
    joined = max(round(1e3 * DURATION / duration), 1)
    groups = [places[k : k + joined] for k in range(0, len(places), joined)]
    start = _start_time(file, version, places)
    return IndexedRecording(
        name=str(path),
        ids=[f"{k:06d}" for k in range(len(groups))],
        times=[start + 1e-3 * duration * joined * k for k in range(len(groups))],
        read=partial(_read, path, version, {key: _pose(*pose) for key, pose in poses.items()}, num_devices, groups),
        warnings=warnings,
    )


def _pose(roll: float, pitch: float, yaw: float, *xyz: float) -> np.ndarray:
    """T_file_sensor (4, 4) of angles in degrees and a position in m."""
    turns = (rotation_about(axis, np.radians(angle)) for axis, angle in (("z", yaw), ("y", pitch), ("x", roll)))
    return rigid_transform(np.linalg.multi_dot(list(turns)), np.array(xyz))


def _frame_places(file: BinaryIO) -> tuple[list[tuple[int, int]], bool]:
    """(start, end) of each frame's packages, and whether the file ends with a frame. Frames are chained by offsets."""
    start = file.tell()
    size = file.seek(0, os.SEEK_END)
    places: list[tuple[int, int]] = []
    while start + _FRAME.size <= size:
        file.seek(start)
        current, following, _ = _FRAME.unpack(file.read(_FRAME.size))
        if current != start:
            return places, False
        start += _FRAME.size
        if not start <= following <= size:
            places.append((start, min(size, start + _MOST_BYTES)))
            return places, False
        places.append((start, min(following, start + _MOST_BYTES)))
        start = following
    return places, start == size


def _start_time(file: BinaryIO, version: Version, places: Sequence[tuple[int, int]]) -> float:
    """The time stamp of the first package, s; 0 if it is not in nanoseconds."""
    for start, end in places:
        if end - start >= version.package.itemsize:
            file.seek(start)
            header = np.frombuffer(file.read(version.package.itemsize), version.package)[0]
            return 1e-9 * float(header["stamp"]) if header["stamp_type"] in _NANOSECONDS else 0.0
    return 0.0


def _read(
    path: Path,
    version: Version,
    poses: dict[int, np.ndarray],
    num_devices: int,
    groups: Sequence[Sequence[tuple[int, int]]],
    i: int,
) -> Sweep:
    clouds, warnings = [np.zeros((0, 3))], set()
    with open(path, "rb") as file:
        for start, end in groups[i]:
            file.seek(start)
            data = file.read(end - start)
            position = 0
            while position + version.package.itemsize <= len(data):
                header = np.frombuffer(data, version.package, 1, position)[0]
                position += version.package.itemsize
                layout, num_bytes = _content(version, header)
                package = data[position : position + num_bytes]
                position += num_bytes
                if len(package) < num_bytes:
                    warnings.add("a package is cut off")
                if layout is not None:
                    points = decode_points(np.frombuffer(package, layout, len(package) // layout.itemsize))
                    # a missing return stays 0, 0, 0
                    T = poses.get(int(header["device"]), np.eye(4))
                    clouds.append(transform_points(T, points[points.any(1)]))
    origins = [T[:3, 3] for T in poses.values()] or [np.zeros(3)]
    return Sweep(
        points=np.concatenate(clouds),
        origin=origins[0] if num_devices == 1 else None,
        is_origin_unknown=num_devices != 1,
        warnings=tuple(sorted(warnings)),
    )


def _content(version: Version, header: np.void) -> tuple[np.dtype | None, int]:
    """Layout and number of bytes of a package's data. Raises FormatError for an unknown type."""
    kind = int(header["kind"])
    if kind not in version.layouts:
        raise FormatError("a package of points", f"one of type {kind}", "export the recording as .las")
    layout = version.layouts[kind]
    if not version.counts:
        return layout, int(header["bytes"])
    return layout, version.counts[kind] * (_IMU_BYTES if layout is None else layout.itemsize)


def decode_points(rows: np.ndarray) -> np.ndarray:
    """(n, 3) m of rows of a layout of `VERSIONS`; 0, 0, 0 for missing returns."""
    if "xyz" in (rows.dtype.names or ()):
        # of 32 bits in mm, of 16 bits in cm
        return rows["xyz"] * (1e-3 if rows["xyz"].dtype.itemsize == 4 else 1e-2)
    theta, phi = np.radians(rows["theta"] * 1e-2), np.radians(rows["phi"] * 1e-2)
    directions = [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]
    return rows["r"][:, None] * 1e-3 * np.stack(directions, 1)
