"""A sensor's table of beams from the user's file.

Files, angles in degrees, in any order of lasers (they are sorted by elevation, their offsets with them). Makers count
azimuths clockwise as seen from above, this package counter-clockwise, and so do azimuth_offset(s):

    JSON of an Ouster sensor     beam_altitude_angles, beam_azimuth_angles, lidar_mode; at the top or, as newer
                                 firmware writes it, in sections (beam_intrinsics, config_params, ...); without a
                                 mode it is taken to have 1024 columns
    JSON list                    elevations
    JSON object                  elevations_deg, and optionally azimuth_offsets_deg, columns, range_min, range_max,
                                 range_sigma, dropout, height, tilt_deg, name
    CSV                          a column of elevations, or columns with a header: elevation and azimuth_offset, or
                                 azimuth (clockwise, as in Hesai's correction files); others are ignored, but not
                                 such as seem to be angles
"""

import csv
import json
import math
import os
import re
import reprlib
import sys
from pathlib import Path

import numpy as np

from lidarpose.errors import InputError, unknown_name
from lidarpose.io.files import file_error, read_bytes
from lidarpose.lidar.sensor import Sensor

# columns a turn where a file does not say: 0.2 degrees
_COLUMNS = 1800
_OUSTER_COLUMNS = 1024
_EXPECTED = "a sensor's table (.json, .csv)"
# tables take some kilobytes
_MOST_BYTES = 2**24
_NUMBERS = ("range_min", "range_max", "range_sigma", "dropout", "height", "tilt_deg")
_KEYS = ("elevations_deg", "azimuth_offsets_deg", "columns", "name", *_NUMBERS)
# a CSV's columns, - and blanks read as _; the last ones are clockwise
_ELEVATIONS = ("elevation", "elevation_deg", "elevations", "elevations_deg", "vertical", "altitude")
_OFFSETS = ("azimuth_offset", "azimuth_offset_deg", "azimuth_offsets", "azimuth_offsets_deg")
_CLOCKWISE = ("azimuth", "azimuth_deg", "horizontal")


def load_sensor(path: str | Path) -> Sensor:
    """The sensor that a file describes; forms of files above. Raises InputError that says what is wrong."""
    data = read_bytes(path, expected=_EXPECTED)
    path = Path(os.fsdecode(path))
    if len(data) > _MOST_BYTES:
        raise file_error(path, f"has {len(data) / 2**20:.0f} MiB, too much for {_EXPECTED}: is it a recording?")
    text = data.decode("utf-8-sig", "replace")
    fields = _from_json(path, text) if path.suffix.lower() == ".json" else _from_csv(path, text)
    elevations = _angles(path, "elevations", fields.pop("elevations"))
    if not len(elevations):
        raise file_error(path, "holds no elevations; expected one a laser, in degrees")
    if np.abs(elevations).max() >= 90:
        raise file_error(path, f"elevations must be within +-90 degrees, got {np.abs(elevations).max():g}")
    # a fan of under 2.3 degrees with more than one laser is in radians
    if len(elevations) > 3 and np.ptp(elevations) < 2.3 and np.abs(elevations).max() < 1.6:
        raise file_error(path, f"elevations reach over {np.ptp(elevations):g}: they seem to be radians, give degrees")
    order = np.argsort(elevations, kind="stable")
    offsets, clockwise = fields.pop("offsets", None), fields.pop("clockwise", False)
    if offsets is not None:
        offsets = _angles(path, "azimuth offsets", offsets)
        if offsets.shape != elevations.shape:
            raise file_error(path, f"has {len(elevations)} elevations and {len(offsets)} azimuth offsets")
        offsets = np.radians(-offsets[order] if clockwise else offsets[order])
    columns = fields.pop("columns", _COLUMNS)
    if isinstance(columns, bool) or not isinstance(columns, int) or not 1 <= columns <= 100_000:
        raise file_error(path, f"columns must be a whole number of columns a turn, got {columns!r}")
    try:
        return Sensor(
            name=str(fields.pop("name", path.stem)),
            elevations=np.radians(elevations[order]),
            azimuth_offsets=offsets,
            azimuth_step=2 * np.pi / columns,
            **fields,
        )
    except InputError as error:
        raise file_error(path, str(error)) from None


def _angles(path: Path, name: str, values: object) -> np.ndarray:
    """(n,) finite degrees."""
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
    """Fields as `load_sensor` reads them: elevations, offsets (both in degrees), clockwise, columns, and those of
    `Sensor`."""
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise file_error(path, f"is not JSON ({error})") from None
    if isinstance(content, list):
        return {"elevations": content}
    if isinstance(content, dict) and "elevations_deg" in content:
        return _own_form(path, content)
    # newer metadata of Ouster has sections
    sections = [content, *content.values()] if isinstance(content, dict) else []
    sections = [section for section in sections if isinstance(section, dict)]
    beams = next((section for section in sections if "beam_altitude_angles" in section), None)
    if beams is None:
        raise file_error(path, "holds no beams; expected beam_altitude_angles, elevations_deg or a list of degrees")
    modes = [str(section[key]) for key in ("lidar_mode", "columns_per_frame") for section in sections if key in section]
    # 1024x10, MODE_1024x10, or a count alone
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
    if unknown := next((key for key in content if key not in _KEYS), None):
        raise file_error(path, str(unknown_name("key", unknown, _KEYS)))
    fields = {"elevations": content["elevations_deg"], "offsets": content.get("azimuth_offsets_deg")}
    fields |= {key: content[key] for key in ("columns", "name") if key in content}
    for key in _NUMBERS:
        if key not in content:
            continue
        value = content[key]
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise file_error(path, f"{key} must be a number, got {value!r}")
        # beyond what a float holds: 1e999, or a whole number of 400 digits
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
    """Fields as `load_sensor` reads them."""
    try:
        rows = [[cell.strip() for cell in row] for row in csv.reader(text.splitlines()) if any(c.strip() for c in row)]
    except csv.Error as error:
        raise file_error(path, f"is not CSV ({error})") from None
    rows = [row for row in rows if not row[0].startswith("#")]
    if not rows:
        raise file_error(path, "holds no rows; expected one a laser")
    header = [cell.lower() for cell in rows[0]]
    elevation, offset, offset_name = 0, None, None
    if any(cell and not _is_number(cell) for cell in header):
        rows = rows[1:]
        names = {re.sub("[ -]", "_", cell.split("(")[0].strip()): k for k, cell in enumerate(header)}
        elevation_name = next((name for name in _ELEVATIONS if name in names), None)
        offset_name = next((name for name in (*_OFFSETS, *_CLOCKWISE) if name in names), None)
        offset = names[offset_name] if offset_name else None
        if elevation_name is None:
            raise file_error(path, f"has no column named elevation, got {', '.join(header)}")
        elevation = names[elevation_name]
        # beams without their offsets would be another sensor
        if offset is None and (unknown := next((n for n in names if re.search("azimuth|offset|horiz", n)), None)):
            raise file_error(path, f"unknown column {unknown!r}: name it azimuth_offset, or azimuth if clockwise")
    elif len(rows[0]) > 1:
        raise file_error(path, f"has {len(rows[0])} columns and no header; name them: elevation, azimuth")
    try:
        offsets = None if offset is None else [float(row[offset]) for row in rows]
        elevations = [float(row[elevation]) for row in rows]
    except (ValueError, IndexError):
        raise file_error(path, "must hold a number of degrees in every row") from None
    return {"elevations": elevations, "offsets": offsets, "clockwise": offset_name in _CLOCKWISE}


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
