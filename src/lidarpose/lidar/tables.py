"""A sensor's table of beams from the user's file, and the list of the sensors that ship.

Files, angles in degrees, in any order of lasers (they are sorted by elevation, their offsets with them):

    JSON of an Ouster sensor     beam_altitude_angles, beam_azimuth_angles, lidar_mode; at the top or in sections
    JSON list                    elevations
    JSON object                  elevations_deg, and optionally azimuth_offsets_deg, columns, range_min, range_max,
                                 range_sigma, dropout, height, tilt_deg, name
    CSV                          a column of elevations, or columns with a header: elevation, azimuth (as in Hesai's
                                 correction files), others are ignored
"""

import csv
import io
import json
from pathlib import Path

import numpy as np

from lidarpose.data.files import file_error, read_bytes
from lidarpose.errors import InputError
from lidarpose.lidar.pattern import RayPattern
from lidarpose.lidar.sensor import SENSORS, Sensor

# columns a turn where a file does not say: 0.2 degrees
_COLUMNS = 1800
_EXPECTED = "a sensor's table (.json, .csv)"
_OWN_KEYS = ("range_min", "range_max", "range_sigma", "dropout", "height")


def load_sensor(path: str | Path) -> Sensor:
    """The sensor that a file describes; forms of files above. Raises InputError that says what is wrong."""
    path = Path(path)
    text = read_bytes(path, expected=_EXPECTED).decode("utf-8-sig", "replace")
    fields = _from_json(path, text) if path.suffix.lower() == ".json" else _from_csv(path, text)
    elevations = _numbers(path, "elevations", fields.pop("elevations"))
    offsets = fields.pop("offsets", None)
    if not len(elevations):
        raise file_error(path, "holds no elevations; expected one a laser, in degrees")
    if np.abs(elevations).max() >= 90:
        raise file_error(path, f"elevations must be within +-90 degrees, got {np.abs(elevations).max():g}")
    # a fan of under 2.3 degrees with more than one laser is in radians
    if len(elevations) > 3 and np.ptp(elevations) < 2.3 and np.abs(elevations).max() < 1.6:
        raise file_error(path, f"elevations reach over {np.ptp(elevations):g}: they seem to be radians, give degrees")
    order = np.argsort(elevations, kind="stable")
    if offsets is not None:
        offsets = _numbers(path, "azimuth offsets", offsets)
        if offsets.shape != elevations.shape:
            raise file_error(path, f"has {len(elevations)} elevations and {len(offsets)} azimuth offsets")
        offsets = np.radians(offsets[order])
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
    except (InputError, TypeError) as error:
        raise file_error(path, str(error)) from None


def _numbers(path: Path, name: str, values: object) -> np.ndarray:
    try:
        numbers = np.array(values, float)
    except (TypeError, ValueError, OverflowError):
        raise file_error(path, f"{name} must be a list of numbers in degrees") from None
    if numbers.ndim != 1 or not np.isfinite(numbers).all():
        raise file_error(path, f"{name} must be a list of finite numbers in degrees, got shape {numbers.shape}")
    return numbers


def _from_json(path: Path, text: str) -> dict:
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise file_error(path, f"is not JSON ({error})") from None
    if isinstance(found, list):
        return {"elevations": found}
    if isinstance(found, dict):
        if "elevations_deg" in found:
            fields = {"elevations": found["elevations_deg"], "offsets": found.get("azimuth_offsets_deg")}
            fields |= {key: found[key] for key in (*_OWN_KEYS, "columns", "name") if key in found}
            for key in _OWN_KEYS:
                if key in fields and (isinstance(fields[key], bool) or not isinstance(fields[key], int | float)):
                    raise file_error(path, f"{key} must be a number, got {fields[key]!r}")
            if "tilt_deg" in found:
                fields["tilt"] = float(np.radians(_numbers(path, "tilt_deg", [found["tilt_deg"]])[0]))
            return fields
        # newer metadata has sections
        sections = [found, *(value for value in found.values() if isinstance(value, dict))]
        beams = next((s for s in sections if "beam_altitude_angles" in s), None)
        if beams is not None:
            fields = {"elevations": beams["beam_altitude_angles"], "offsets": beams.get("beam_azimuth_angles")}
            mode = next((s["lidar_mode"] for s in sections if isinstance(s.get("lidar_mode"), str)), "")
            if mode.partition("x")[0].isdigit():
                fields["columns"] = int(mode.partition("x")[0])
            return fields
    raise file_error(path, "holds no beams; expected beam_altitude_angles, elevations_deg or a list of degrees")


def _from_csv(path: Path, text: str) -> dict:
    try:
        rows = [[cell.strip() for cell in row] for row in csv.reader(io.StringIO(text)) if any(c.strip() for c in row)]
    except csv.Error as error:
        raise file_error(path, f"is not CSV ({error})") from None
    rows = [row for row in rows if not row[0].startswith("#")]
    if not rows:
        raise file_error(path, "holds no rows; expected one a laser")
    header = [cell.lower() for cell in rows[0]]
    if any(cell and not _is_number(cell) for cell in header):
        rows = rows[1:]
        named = {cell.split("(")[0].strip(): k for k, cell in enumerate(header)}
        up = next((named[n] for n in ("elevation", "elevation_deg", "vertical", "altitude") if n in named), None)
        off = next((named[n] for n in ("azimuth", "azimuth_offset", "azimuth_deg", "horizontal") if n in named), None)
        if up is None:
            raise file_error(path, f"has no column named elevation, got {', '.join(header)}")
    elif len(rows[0]) == 1:
        up, off = 0, None
    else:
        raise file_error(path, f"has {len(rows[0])} columns and no header; name them: elevation, azimuth")
    try:
        fields = {"elevations": [float(row[up]) for row in rows]}
        if off is not None:
            fields["offsets"] = [float(row[off]) for row in rows]
    except (ValueError, IndexError):
        raise file_error(path, "must hold a number of degrees in every row") from None
    return fields


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def listing() -> list[str]:
    """Lines of a table of the sensors that ship: name, beams, field of view, ranges, usual height."""
    rows = [("sensor", "beams", "azimuth", "elevation deg", "range m", "height m")]
    for name in sorted(SENSORS):
        device = SENSORS[name]
        low, high = np.degrees([device.elevations[0], device.elevations[-1]])
        if isinstance(device, RayPattern):
            count = len(device.frame(0).azimuth)
            beams = f"{count:,} in {device.duration * 1e3:.0f} ms" if device.duration else f"{count:,} pixels"
            wide = np.degrees(device.azimuths[1] - device.azimuths[0])
        else:
            beams, wide = f"{device.rows} x {device.columns}", 360.0
        ranges = f"{device.range_min:g}-{device.range_max:g}"
        rows.append((name, beams, f"{wide:.4g}", f"{low:+.1f} to {high:+.1f}", ranges, f"{device.height:g}"))
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return ["  ".join(f"{cell:<{w}}" for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]
