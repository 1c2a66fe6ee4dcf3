"""Shipped sensors by name, and user-defined sensors from files with tables of beams.

File formats: angles in degrees, lasers in any order (they are sorted by elevation, together with their offsets).
Manufacturers count azimuths clockwise as seen from above; this package and azimuth_offset(s) count counter-clockwise:

    JSON of an Ouster sensor     beam_altitude_angles, beam_azimuth_angles, lidar_mode; at the top level or, from newer
                                 firmware, in sections (beam_intrinsics, config_params, ...); 1024 columns if no mode
                                 is given
    JSON list                    elevations
    JSON object                  elevations_deg, and optionally azimuth_offsets_deg, columns, range_min, range_max,
                                 range_sigma, dropout, height, tilt_deg, name
    CSV                          a column of elevations, or columns with a header: elevation and azimuth_offset, or
                                 azimuth (clockwise, as in Hesai's correction files); other columns are ignored,
                                 unless no offset is found and one seems to be an azimuth (an error)
"""

import csv
import json
import math
import os
import re
import reprlib
import sys
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose.errors import InputError, unknown_name
from lidarpose.io.files import file_error, read_bytes
from lidarpose.lidar.ray_pattern import PATTERNS, RayPattern
from lidarpose.lidar.sensor import Sensor


def _degrees(text: str) -> np.ndarray:
    return np.radians(np.array(text.split(), float))


def _turn(columns: int) -> float:
    return 2 * np.pi / columns


# Velodyne VLP-32C manual, elevation of the 32 lasers
_VLP_32C = _degrees(
    """-25 -15.639 -11.31 -8.843 -7.254 -6.148 -5.333 -4.667 -4 -3.667 -3.333 -3 -2.667 -2.333 -2 -1.667 -1.333 -1
    -0.667 -0.333 0 0.333 0.667 1 1.333 1.667 2.333 3.333 4.667 7 10.333 15"""
)

# Hesai's default correction of the Pandar64, lowest laser first: elevation, and azimuth offset (clockwise in the file)
_PANDAR64 = _degrees(
    """-24.897 -18.889 -13.93 -12.974 -12.006 -11.032 -9.885 -9.06 -8.059 -7.063 -6.061 -5.898 -5.726 -5.565 -5.391
    -5.229 -5.057 -4.892 -4.72 -4.558 -4.385 -4.221 -4.05 -3.884 -3.712 -3.548 -3.375 -3.21 -3.04 -2.873 -2.7 -2.536
    -2.365 -2.198 -2.028 -1.86 -1.688 -1.522 -1.351 -1.184 -1.013 -0.845 -0.675 -0.508 -0.337 -0.169 0 0.169 0.337
    0.508 0.675 0.846 1.013 1.184 1.351 1.522 1.688 1.86 2.028 3.04 5.057 8.059 11.032 14.882"""
)
_PANDAR64_OFFSETS = -_degrees("-1.042 " * 10 + "-3.125 -5.208 5.208 3.125 1.042 -1.042 " * 8 + "-1.042 " * 6)

_AV2_ORDER = np.argsort(np.concatenate([_VLP_32C, -_VLP_32C]), kind="stable")


def _spinning(name: str, elevations: np.ndarray, columns: int, **fields: Any) -> Sensor:
    """A sensor with elevations, rad, and the number of columns per turn."""
    return Sensor(name=name, elevations=elevations, azimuth_step=_turn(columns), **fields)


# Range noise is the manufacturer's typical one-sigma figure or the middle of its range; heights are of usual mounts.
_SENSORS = (
    *PATTERNS,
    # Paper: implementation details (64 lines, 2650 angles); elevations and height are the released code's. Its
    # 2650 azimuths run from -pi to +pi inclusive, so 2649 of them are distinct.
    _spinning("dapt64", np.radians(np.linspace(-10, 10, 64)), 2649, range_sigma=0.01, dropout=0.0, height=0.5),
    # Waymo Open Dataset (arXiv:1912.04838, table 2): 64 rings over -17.6..+2.4 deg, 2650 columns. Even spacing is
    # an approximation: the true inclinations are in each segment's calibration.
    _spinning("waymo-top", np.radians(np.linspace(-17.6, 2.4, 64)), 2650, range_max=75.0, height=2.0),
    # Velodyne VLP-16 manual: 16 rings 2 deg apart; 0.2 deg at 10 Hz; +-3 cm
    _spinning("vlp-16", np.radians(np.arange(-15.0, 16, 2)), 1800, height=0.7),
    # +-3 cm; 0.2 deg at 10 Hz. Azimuth offsets of its lasers are 1.4 and 4.2 deg to either side: 7 and 21 columns.
    _spinning("vlp-32c", _VLP_32C, 1800, range_min=1.0, range_max=200.0, height=1.8),
    # Velodyne HDL-32E manual: 32 rings 4/3 deg apart from -30.67 to +10.67; 0.16 deg at 10 Hz; +-2 cm
    _spinning("hdl-32e", np.radians(np.linspace(-92 / 3, 32 / 3, 32)), 2250, range_min=1.0, height=1.8),
    # Velodyne HDL-64E manual: upper block 1/3 deg apart from +2 down, lower block 1/2 deg apart to -24.33;
    # 0.1728 deg at 10 Hz. Nominal: each unit has its own table (one published calibration, of an S2.1, ranges from
    # -24.8 to +5.0 deg), and the origins of its two blocks are 10 cm apart.
    _spinning(
        "hdl-64e",
        np.radians(np.concatenate([np.linspace(-24.33, -8.83, 32), np.linspace(-8.83 + 0.5, 2, 32)])),
        2083,
        range_min=0.9,
        range_max=120.0,
        height=1.73,
    ),
    # Ouster OS1, OS0 and OS2, uniform. A column's beams form four azimuth groups, 8 columns of 1024 apart: these
    # are whole columns, so they change when a beam fires, not where it points. Real units deviate by about 0.01 deg.
    _spinning("os1-64", np.radians(np.linspace(-22.5, 22.5, 64)), 1024, range_max=120.0, height=1.5),
    _spinning("os1-128", np.radians(np.linspace(-22.5, 22.5, 128)), 2048, range_max=120.0, height=1.5),
    _spinning("os0-128", np.radians(np.linspace(-45, 45, 128)), 2048, range_min=0.3, range_max=50.0, height=1.5),
    _spinning("os2-128", np.radians(np.linspace(-11.25, 11.25, 128)), 2048, range_min=1.0, range_max=240.0, height=1.8),
    # Hesai's default correction file; 0.2 deg at 10 Hz
    _spinning(
        "pandar64", _PANDAR64, 1800, azimuth_offsets=_PANDAR64_OFFSETS, range_min=0.3, range_max=200.0, height=1.8
    ),
    # Argoverse 2 (Wilson et al. 2021): two VLP-32C stacked on the roof, one upside down: rings at the table's
    # angles and at their negatives. In its sweeps, the second one's origin is 11 cm below the first's, and the ground
    # is 2 m below. Both rotate in the same direction with opposite headings, so one passes a person half a turn after
    # the other. The second one's offset of half a column is a stand-in for an arbitrary phase.
    _spinning(
        "av2",
        np.concatenate([_VLP_32C, -_VLP_32C])[_AV2_ORDER],
        1800,
        azimuth_offsets=np.repeat([0.0, _turn(3600)], 32)[_AV2_ORDER],
        origin_heights=np.repeat([0.0, -0.11], 32)[_AV2_ORDER],
        ring_lags=np.repeat([0.0, 0.5], 32)[_AV2_ORDER],
        range_min=1.0,
        range_max=200.0,
        height=2.0,
    ),
)
SENSORS: dict[str, Sensor | RayPattern] = {sensor.name: sensor for sensor in _SENSORS}


def sensor(name: str | os.PathLike) -> Sensor | RayPattern:
    """A shipped sensor by name, or the sensor of a .json or .csv file (`load_sensor`), which is read again if it has
    changed: a `Sensor`, or a `RayPattern` if it does not spin. For an unknown name, raises an InputError that lists
    the nearest names."""
    name = os.fspath(name) if isinstance(name, os.PathLike) else str(name)
    if name in SENSORS:
        return SENSORS[name]
    if name.lower().endswith((".json", ".csv")):
        return _of_file(name, *_stamp(name))
    raise unknown_name("sensor", name, SENSORS)


@cache
def _of_file(path: str, *stamp: object) -> Sensor:
    """`load_sensor`, cached per stamp, because generators request the sensor for every person."""
    return load_sensor(path)


def _stamp(path: str) -> tuple[object, ...]:
    """Identifies a file and its version; empty if the file cannot be accessed."""
    try:
        stat = os.stat(path)
    except (OSError, ValueError):
        # reading the file will raise the error
        return ()
    return stat.st_dev, stat.st_ino, stat.st_size, stat.st_mtime_ns


# source of a sensor's beams: manufacturer's table, paper, or nominal, the manufacturer's field of view in equal steps
_SOURCES = {"dapt64": "paper", "waymo-top": "nominal", "hdl-64e": "nominal", "av2": "maker", "depth-camera": "typical"}


def listing() -> list[str]:
    """Lines of a table of the shipped sensors: name, kind, beams (rings x columns, or rays per frame), field of view,
    range limits, usual height, and source of the beams."""
    rows = [("sensor", "kind", "beams", "azimuth", "elevation deg", "range m", "height m", "source")]
    for name in sorted(SENSORS):
        device = SENSORS[name]
        low, high = np.degrees([device.elevations[0], device.elevations[-1]])
        if isinstance(device, RayPattern):
            count = len(device.frame(0).azimuth)
            kind = "rosette" if device.duration else "camera"
            beams = f"{count:,} in {device.duration * 1e3:.0f} ms" if device.duration else f"{count:,} pixels"
            field_of_view = np.degrees(device.field_of_view)
        else:
            kind, beams, field_of_view = "spinning", f"{device.rows} x {device.columns}", 360.0
        source = _SOURCES.get(name, "nominal" if name.startswith("os") else "maker")
        ranges = f"{device.range_min:g}-{device.range_max:g}"
        elevation = f"{low:+.1f} to {high:+.1f}"
        rows.append((name, kind, beams, f"{field_of_view:.4g}", elevation, ranges, f"{device.height:g}", source))
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return ["  ".join(f"{cell:<{w}}" for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]


# --- user-defined tables of beams

# default number of columns per turn of a file: 0.2 degrees
_COLUMNS = 1800
_OUSTER_COLUMNS = 1024
_EXPECTED = "a sensor's table (.json, .csv)"
# tables have some kilobytes
_MOST_BYTES = 2**24
_NUMBERS = ("range_min", "range_max", "range_sigma", "dropout", "height", "tilt_deg")
_KEYS = ("elevations_deg", "azimuth_offsets_deg", "columns", "name", *_NUMBERS)
# names of a CSV's columns, with - and blanks replaced by _; those of `_CLOCKWISE` count clockwise
_ELEVATIONS = ("elevation", "elevation_deg", "elevations", "elevations_deg", "vertical", "altitude")
_OFFSETS = ("azimuth_offset", "azimuth_offset_deg", "azimuth_offsets", "azimuth_offsets_deg")
_CLOCKWISE = ("azimuth", "azimuth_deg", "horizontal")


def load_sensor(path: str | Path) -> Sensor:
    """Reads a sensor from a file; formats at the top of this module. Raises InputError that describes the problem."""
    data = read_bytes(path, expected=_EXPECTED)
    path = Path(os.fsdecode(path))
    if len(data) > _MOST_BYTES:
        raise file_error(path, f"has {len(data) / 2**20:.0f} MiB, too much for {_EXPECTED}: is it a recording?")
    text = data.decode("utf-8-sig", "replace")
    fields = _from_json(path, text) if path.suffix.lower() == ".json" else _from_csv(path, text)
    elevations = _angles(path, "elevations", fields.pop("elevations"))
    if not len(elevations):
        raise file_error(path, "has no elevations; expected one per laser, in degrees")
    if np.abs(elevations).max() >= 90:
        raise file_error(path, f"elevations must be within +-90 degrees, got {np.abs(elevations).max():g}")
    # more than three lasers within less than 2.3 degrees are assumed to be in radians
    if len(elevations) > 3 and np.ptp(elevations) < 2.3 and np.abs(elevations).max() < 1.6:
        raise file_error(path, f"elevations span {np.ptp(elevations):g}: they seem to be in radians, give degrees")
    order = np.argsort(elevations, kind="stable")
    offsets, clockwise = fields.pop("offsets", None), fields.pop("clockwise", False)
    if offsets is not None:
        offsets = _angles(path, "azimuth offsets", offsets)
        if offsets.shape != elevations.shape:
            raise file_error(path, f"has {len(elevations)} elevations and {len(offsets)} azimuth offsets")
        offsets = np.radians(-offsets[order] if clockwise else offsets[order])
    name = str(fields.pop("name", path.stem))
    if "/" in name:
        raise file_error(path, f"the sensor's name must not contain '/', got {name!r}")
    columns = fields.pop("columns", _COLUMNS)
    if isinstance(columns, bool) or not isinstance(columns, int) or not 1 <= columns <= 100_000:
        raise file_error(path, f"columns must be a whole number of columns per turn, got {columns!r}")
    try:
        return Sensor(
            name=name,
            elevations=np.radians(elevations[order]),
            azimuth_offsets=offsets,
            azimuth_step=2 * np.pi / columns,
            **fields,
        )
    except InputError as error:
        raise file_error(path, str(error)) from None


def _angles(path: Path, name: str, values: object) -> np.ndarray:
    """Finite angles (n,), degrees."""
    try:
        angles = np.array(values, float)
    except (TypeError, ValueError, OverflowError):
        raise file_error(path, f"{name} must be a list of numbers in degrees") from None
    expected = f"{name} must be a list of finite numbers in degrees"
    if angles.ndim != 1:
        raise file_error(path, f"{expected}, got shape {angles.shape}")
    if not np.isfinite(angles).all():
        raise file_error(path, f"{expected}, but number {int(np.argmin(np.isfinite(angles)))} is not finite")
    return angles


def _from_json(path: Path, text: str) -> dict:
    """Fields for `load_sensor`: elevations, offsets (both in degrees), clockwise, columns, and fields of `Sensor`."""
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise file_error(path, f"is not JSON ({error})") from None
    if isinstance(content, list):
        return {"elevations": content}
    if isinstance(content, dict) and "elevations_deg" in content:
        return _own_form(path, content)
    # newer Ouster metadata has sections
    sections = [content, *content.values()] if isinstance(content, dict) else []
    sections = [section for section in sections if isinstance(section, dict)]
    beams = next((section for section in sections if "beam_altitude_angles" in section), None)
    if beams is None:
        raise file_error(path, "has no beams; expected beam_altitude_angles, elevations_deg or a list of degrees")
    modes = [str(section[key]) for key in ("lidar_mode", "columns_per_frame") for section in sections if key in section]
    # 1024x10, MODE_1024x10, or only the number of columns
    columns = [int(match[1]) for mode in modes if (match := re.search("([0-9]{3,5})(x|$)", mode))]
    if modes and not columns:
        raise file_error(path, f"expected a lidar_mode such as 1024x10, got {reprlib.repr(modes[0])}")
    return {
        "elevations": beams["beam_altitude_angles"],
        "offsets": beams.get("beam_azimuth_angles"),
        "clockwise": True,
        "columns": columns[0] if columns else _OUSTER_COLUMNS,
    }


def _own_form(path: Path, content: dict) -> dict:
    if unknown_key := next((key for key in content if key not in _KEYS), None):
        raise file_error(path, str(unknown_name("key", unknown_key, _KEYS)))
    fields = {"elevations": content["elevations_deg"], "offsets": content.get("azimuth_offsets_deg")}
    fields |= {key: content[key] for key in ("columns", "name") if key in content}
    for key in _NUMBERS:
        if key not in content:
            continue
        value = content[key]
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise file_error(path, f"{key} must be a number, got {value!r}")
        # out of a float's range: 1e999, or an integer of 400 digits
        if not abs(value) <= sys.float_info.max:
            raise file_error(path, f"{key} must be a finite number, got {reprlib.repr(value)}")
        fields[key] = float(value)
    if fields.get("height", 1) <= 0:
        raise file_error(path, f"height must be above 0 m, the ground, got {fields['height']:g}")
    tilt = fields.pop("tilt_deg", 0.0)
    if abs(tilt) > 90:
        raise file_error(path, f"tilt_deg must be within +-90 degrees, got {tilt:g}")
    return fields | {"tilt": math.radians(tilt)}


def _from_csv(path: Path, text: str) -> dict:
    """Fields for `load_sensor`."""
    try:
        rows = [[cell.strip() for cell in row] for row in csv.reader(text.splitlines()) if any(c.strip() for c in row)]
    except csv.Error as error:
        raise file_error(path, f"is not CSV ({error})") from None
    rows = [row for row in rows if not row[0].startswith("#")]
    if not rows:
        raise file_error(path, "has no rows; expected one per laser")
    header = [cell.lower() for cell in rows[0]]
    elevation_column, offset_column, offset_name = 0, None, None
    if any(cell and not _is_number(cell) for cell in header):
        rows = rows[1:]
        column_by_name = {re.sub("[ -]", "_", cell.split("(")[0].strip()): k for k, cell in enumerate(header)}
        elevation_name = next((name for name in _ELEVATIONS if name in column_by_name), None)
        offset_name = next((name for name in (*_OFFSETS, *_CLOCKWISE) if name in column_by_name), None)
        offset_column = column_by_name[offset_name] if offset_name else None
        if elevation_name is None:
            raise file_error(path, f"has no column named elevation, got {', '.join(header)}")
        elevation_column = column_by_name[elevation_name]
        # dropping the beams' azimuth offsets would change the sensor
        if offset_column is None and (
            unknown_column := next((n for n in column_by_name if re.search("azimuth|offset|horiz", n)), None)
        ):
            raise file_error(
                path, f"unknown column {unknown_column!r}: name it azimuth_offset, or azimuth if clockwise"
            )
    elif len(rows[0]) > 1:
        raise file_error(path, f"has {len(rows[0])} columns and no header; name them: elevation, azimuth")
    try:
        offsets = None if offset_column is None else [float(row[offset_column]) for row in rows]
        elevations = [float(row[elevation_column]) for row in rows]
    except (ValueError, IndexError):
        raise file_error(path, "must hold a number of degrees in every row") from None
    return {"elevations": elevations, "offsets": offsets, "clockwise": offset_name in _CLOCKWISE}


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
