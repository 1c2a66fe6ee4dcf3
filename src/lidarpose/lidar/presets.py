"""The sensors that ship, by name, and the user's own by file."""

import os
from functools import cache
from typing import Any

import numpy as np

from lidarpose.errors import unknown_name
from lidarpose.lidar.ray_pattern import PATTERNS, RayPattern
from lidarpose.lidar.sensor import Sensor
from lidarpose.lidar.sensor_file import load_sensor


def _degrees(text: str) -> np.ndarray:
    return np.radians(np.array(text.split(), float))


def _turn(columns: int) -> float:
    return 2 * np.pi / columns


# Velodyne VLP-32C manual, elevation of the 32 lasers
_VLP_32C = _degrees(
    """-25 -15.639 -11.31 -8.843 -7.254 -6.148 -5.333 -4.667 -4 -3.667 -3.333 -3 -2.667 -2.333 -2 -1.667 -1.333 -1
    -0.667 -0.333 0 0.333 0.667 1 1.333 1.667 2.333 3.333 4.667 7 10.333 15"""
)

# Hesai's default correction of the Pandar64, lowest laser first: elevation, and azimuth offset, there clockwise
_PANDAR64 = _degrees(
    """-24.897 -18.889 -13.93 -12.974 -12.006 -11.032 -9.885 -9.06 -8.059 -7.063 -6.061 -5.898 -5.726 -5.565 -5.391
    -5.229 -5.057 -4.892 -4.72 -4.558 -4.385 -4.221 -4.05 -3.884 -3.712 -3.548 -3.375 -3.21 -3.04 -2.873 -2.7 -2.536
    -2.365 -2.198 -2.028 -1.86 -1.688 -1.522 -1.351 -1.184 -1.013 -0.845 -0.675 -0.508 -0.337 -0.169 0 0.169 0.337
    0.508 0.675 0.846 1.013 1.184 1.351 1.522 1.688 1.86 2.028 3.04 5.057 8.059 11.032 14.882"""
)
_PANDAR64_OFFSETS = -_degrees("-1.042 " * 10 + "-3.125 -5.208 5.208 3.125 1.042 -1.042 " * 8 + "-1.042 " * 6)

_AV2_ORDER = np.argsort(np.concatenate([_VLP_32C, -_VLP_32C]), kind="stable")


def _spinning(name: str, elevations: np.ndarray, columns: int, **fields: Any) -> Sensor:
    """A sensor of elevations rad and so many columns a turn."""
    return Sensor(name=name, elevations=elevations, azimuth_step=_turn(columns), **fields)


# Range noise is the makers' typical one-sigma figure or the middle of theirs; heights are those of the usual mount.
_SENSORS = (
    *PATTERNS,
    # Paper: implementation details (64 lines, 2650 angles); the fan and the height are the released code's. Its
    # 2650 azimuths run from -pi to +pi with both ends, so 2649 of them differ.
    _spinning("dapt64", np.radians(np.linspace(-10, 10, 64)), 2649, range_sigma=0.01, dropout=0.0, height=0.5),
    # Waymo Open Dataset (arXiv:1912.04838, table 2): 64 rings over -17.6..+2.4 deg, 2650 columns. Even spacing is
    # a stand-in: the true inclinations are in each segment's calibration.
    _spinning("waymo-top", np.radians(np.linspace(-17.6, 2.4, 64)), 2650, range_max=75.0, height=2.0),
    # Velodyne VLP-16 manual: 16 rings 2 deg apart; 0.2 deg at 10 Hz; +-3 cm
    _spinning("vlp-16", np.radians(np.arange(-15.0, 16, 2)), 1800, height=0.7),
    # +-3 cm; 0.2 deg at 10 Hz. Its lasers stand 1.4 and 4.2 deg to either side: 7 and 21 whole columns.
    _spinning("vlp-32c", _VLP_32C, 1800, range_min=1.0, range_max=200.0, height=1.8),
    # Velodyne HDL-32E manual: 32 rings 4/3 deg apart from -30.67 to +10.67; 0.16 deg at 10 Hz; +-2 cm
    _spinning("hdl-32e", np.radians(np.linspace(-92 / 3, 32 / 3, 32)), 2250, range_min=1.0, height=1.8),
    # Velodyne HDL-64E manual: upper block 1/3 deg apart from +2 down, lower block 1/2 deg apart to -24.33;
    # 0.1728 deg at 10 Hz. Nominal: each unit has its own table (one published calibration, an S2.1's, reaches from
    # -24.8 to +5.0 deg), and its two blocks have origins 10 cm apart.
    _spinning(
        "hdl-64e",
        np.radians(np.concatenate([np.linspace(-24.33, -8.83, 32), np.linspace(-8.83 + 0.5, 2, 32)])),
        2083,
        range_min=0.9,
        range_max=120.0,
        height=1.73,
    ),
    # Ouster OS1, OS0 and OS2, uniform. Beams of a column leave in four azimuth groups 8 columns of 1024 apart:
    # whole columns, so they shift when a beam fires, not where it points. Real units deviate by some 0.01 deg.
    _spinning("os1-64", np.radians(np.linspace(-22.5, 22.5, 64)), 1024, range_max=120.0, height=1.5),
    _spinning("os1-128", np.radians(np.linspace(-22.5, 22.5, 128)), 2048, range_max=120.0, height=1.5),
    _spinning("os0-128", np.radians(np.linspace(-45, 45, 128)), 2048, range_min=0.3, range_max=50.0, height=1.5),
    _spinning("os2-128", np.radians(np.linspace(-11.25, 11.25, 128)), 2048, range_min=1.0, range_max=240.0, height=1.8),
    # Hesai's default correction file; 0.2 deg at 10 Hz
    _spinning(
        "pandar64", _PANDAR64, 1800, azimuth_offsets=_PANDAR64_OFFSETS, range_min=0.3, range_max=200.0, height=1.8
    ),
    # Argoverse 2 (Wilson et al. 2021): two VLP-32C stacked on the roof, one upside down: rings at the table's
    # angles and at their negatives. In its sweeps the second one's beams meet 11 cm below the first's, and the
    # ground lies 2 m below. That its columns lie half a step further is a stand-in for a free phase.
    _spinning(
        "av2",
        np.concatenate([_VLP_32C, -_VLP_32C])[_AV2_ORDER],
        1800,
        azimuth_offsets=np.repeat([0.0, _turn(3600)], 32)[_AV2_ORDER],
        origin_heights=np.repeat([0.0, -0.11], 32)[_AV2_ORDER],
        range_min=1.0,
        range_max=200.0,
        height=2.0,
    ),
)
SENSORS: dict[str, Sensor | RayPattern] = {sensor.name: sensor for sensor in _SENSORS}


def sensor(name: str | os.PathLike) -> Sensor | RayPattern:
    """A named sensor, or that of a .json or .csv file (`sensor_file.load_sensor`), which is read again once it has
    changed: a `Sensor`, or a `RayPattern` for what does not spin. An unknown name raises an InputError that lists the
    nearest ones."""
    name = os.fspath(name) if isinstance(name, os.PathLike) else str(name)
    if name in SENSORS:
        return SENSORS[name]
    if name.lower().endswith((".json", ".csv")):
        return _of_file(name, *_stamp(name))
    raise unknown_name("sensor", name, SENSORS)


@cache
def _of_file(path: str, *stamp: object) -> Sensor:
    """Read once as long as its stamp stays: generators ask for every person."""
    return load_sensor(path)


def _stamp(path: str) -> tuple[object, ...]:
    """What tells a file from another of its name, or from itself after a change."""
    try:
        stat = os.stat(path)
    except (OSError, ValueError):
        # reading it says why
        return ()
    return stat.st_dev, stat.st_ino, stat.st_size, stat.st_mtime_ns


# where the beams of a sensor come from: its maker's table, a paper, or the maker's field of view in equal steps
_SOURCES = {"dapt64": "paper", "waymo-top": "nominal", "hdl-64e": "nominal", "av2": "maker", "depth-camera": "typical"}


def listing() -> list[str]:
    """Lines of a table of the sensors that ship: name, kind, beams (rings x columns, or rays a frame), field of view,
    ranges, usual height, and where its beams come from."""
    rows = [("sensor", "kind", "beams", "azimuth", "elevation deg", "range m", "height m", "source")]
    for name in sorted(SENSORS):
        device = SENSORS[name]
        low, high = np.degrees([device.elevations[0], device.elevations[-1]])
        if isinstance(device, RayPattern):
            count = len(device.frame(0).azimuth)
            kind = "rosette" if device.duration else "camera"
            beams = f"{count:,} in {device.duration * 1e3:.0f} ms" if device.duration else f"{count:,} pixels"
            wide = np.degrees(device.azimuths[1] - device.azimuths[0])
        else:
            kind, beams, wide = "spinning", f"{device.rows} x {device.columns}", 360.0
        source = _SOURCES.get(name, "nominal" if name.startswith("os") else "maker")
        ranges = f"{device.range_min:g}-{device.range_max:g}"
        elevation = f"{low:+.1f} to {high:+.1f}"
        rows.append((name, kind, beams, f"{wide:.4g}", elevation, ranges, f"{device.height:g}", source))
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return ["  ".join(f"{cell:<{w}}" for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]
