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
from lidarpose.io.files import FormatError, file_error
from lidarpose.io.sources.frame import IndexedRecording, ReadingOptions, Sweep

_SIGNATURE, _MAGIC = b"livox_tech", 0xAC0EA767
# duration that frames are joined to, s: one alone, of 50 ms, has few points on a person
DURATION = 0.1
# headers: of the file (signature, version, magic number), of the recording (duration of a frame, ms, number of devices)
# and of a frame (its offset, that of the next frame, its number)
_PUBLIC, _PRIVATE, _FRAME = struct.Struct("<16s4BI"), struct.Struct("<IB"), struct.Struct("<3q")


def _cartesian(kind: str, size: int) -> np.dtype:
    """Points of `size` bytes that begin with x, y, z."""
    return np.dtype({"names": ["xyz"], "formats": [(kind, 3)], "offsets": [0], "itemsize": size})


def _spherical(depth: int, angles: int, size: int) -> np.dtype:
    """Points of `size` bytes: depth, mm, and angles from the z axis and about it, 0.01 degrees, at these offsets."""
    offsets = [depth, angles, angles + 2]
    return np.dtype(
        {"names": ["r", "theta", "phi"], "formats": ["<u4", "<u2", "<u2"], "offsets": offsets, "itemsize": size}
    )


@dataclass(frozen=True, kw_only=True)
class Version:
    """A version of the format. device, package: their headers, whose fields are named below; layouts: of points, by
    data type, None for other data; counts: points of a package by data type; empty if a package states its bytes."""

    device: struct.Struct
    package: struct.Struct
    layouts: dict[int, np.dtype | None]
    counts: dict[int, int]


# of several returns the first
VERSIONS = {
    1: Version(
        # serial numbers, index, type, whether the pose is used, roll, pitch, yaw, x, y, z
        device=struct.Struct("<32xBxB6f"),
        # device, data type
        package=struct.Struct("<B9xB8x"),
        layouts={
            **{0: _cartesian("<i4", 13), 1: _spherical(0, 4, 9), 2: _cartesian("<i4", 14), 3: _spherical(0, 4, 10)},
            **{4: _cartesian("<i4", 28), 5: _spherical(4, 0, 16), 6: None},
            **{7: _cartesian("<i4", 42), 8: _spherical(4, 0, 22)},
        },
        counts={0: 100, 1: 100, 2: 96, 3: 96, 4: 48, 5: 48, 6: 1, 7: 30, 8: 30},
    ),
    2: Version(
        device=struct.Struct("<32xI2xB6f"),
        # device, data type, bytes of data
        package=struct.Struct("<xI12xBI5x"),
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
    with open(path, "rb") as file:
        head = file.read(_PUBLIC.size + _PRIVATE.size)
        if len(head) < _PUBLIC.size + _PRIVATE.size or not head.startswith(_SIGNATURE):
            raise file_error(path, "expected a recording of Livox Viewer, got something else: export it again")
        _, major, *minor, magic = _PUBLIC.unpack_from(head)
        duration, num_devices = _PRIVATE.unpack_from(head, _PUBLIC.size)
        number = ".".join(map(str, (major, *minor)))
        version = VERSIONS.get(major)
        if version is None or (major, minor[0]) == (1, 0) or magic != _MAGIC:
            problem = f"expected a recording of version 1.1 or 2.0, got {number}"
            raise file_error(path, f"{problem}: open it in Livox Viewer and export it as .las or .csv")
        size = version.device.size
        table = file.read(size * num_devices)
        devices = [version.device.unpack_from(table, k * size) for k in range(len(table) // size)]
        places, warnings = _frame_places(file)
    if duration < 1:
        raise file_error(path, "states no duration of its frames: export it again")
    joined = max(round(1e3 * DURATION / duration), 1)
    groups = [places[k : k + joined] for k in range(0, len(places), joined)]
    if not np.isfinite([values for _, is_used, *values in devices if is_used]).all():
        raise file_error(path, "states a sensor's pose that is no number: export it again")
    poses = {device: _pose(*values) for device, is_used, *values in devices if is_used}
    return IndexedRecording(
        name=str(path),
        ids=[f"{k:06d}" for k in range(len(groups))],
        times=[1e-3 * duration * joined * k for k in range(len(groups))],
        read=partial(_read, path, version, poses, num_devices, groups),
        warnings=warnings,
    )


def _pose(roll: float, pitch: float, yaw: float, *xyz: float) -> np.ndarray:
    """T_file_sensor (4, 4) of angles in degrees and a position in m."""
    turns = (rotation_about(axis, np.radians(angle)) for axis, angle in (("z", yaw), ("y", pitch), ("x", roll)))
    return rigid_transform(np.linalg.multi_dot(list(turns)), np.array(xyz))


def _frame_places(file: BinaryIO) -> tuple[list[tuple[int, int]], list[str]]:
    """(start, end) of each frame's packages, and warnings. Frames are chained by their offsets."""
    start = file.tell()
    size = file.seek(0, os.SEEK_END)
    places: list[tuple[int, int]] = []
    while start + _FRAME.size <= size:
        file.seek(start)
        current, following, _ = _FRAME.unpack(file.read(_FRAME.size))
        if current != start:
            return places, [f"frame {len(places)} is damaged: the recording ends there"]
        # the last frame may state no next one
        end = following if start + _FRAME.size < following <= size else size
        places.append((start + _FRAME.size, end))
        start = end
    return places, []


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
            while position + version.package.size <= len(data):
                device, kind, *length = version.package.unpack_from(data, position)
                if kind not in version.layouts:
                    raise FormatError("a package of points", f"one of type {kind}", "export the recording as .las")
                layout = version.layouts[kind]
                itemsize = _IMU_BYTES if layout is None else layout.itemsize
                num_bytes = length[0] if length else version.counts[kind] * itemsize
                position += version.package.size
                package = data[position : position + num_bytes]
                position += num_bytes
                if len(package) < num_bytes:
                    warnings.add("a package is cut off")
                if layout is not None:
                    rows = np.frombuffer(package, layout, len(package) // itemsize)
                    points = decode_points(rows)
                    # a missing return stays 0, 0, 0
                    is_return = points.any(1)
                    T = poses.get(device, np.eye(4))
                    clouds.append(transform_points(T, points[is_return]))
    origins = [T[:3, 3] for T in poses.values()] or [np.zeros(3)]
    origin = origins[0] if num_devices == 1 else None
    return Sweep(points=np.concatenate(clouds), origin=origin, warnings=tuple(sorted(warnings)))


def decode_points(rows: np.ndarray) -> np.ndarray:
    """(n, 3) m of rows of a layout of `VERSIONS`; 0, 0, 0 for missing returns."""
    if "xyz" in (rows.dtype.names or ()):
        # of 32 bits in mm, of 16 bits in cm
        return rows["xyz"] * (1e-3 if rows["xyz"].dtype.itemsize == 4 else 1e-2)
    theta, phi = np.radians(rows["theta"] * 1e-2), np.radians(rows["phi"] * 1e-2)
    directions = [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]
    return rows["r"][:, None] * 1e-3 * np.stack(directions, 1)
