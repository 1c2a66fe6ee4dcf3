"""Spinning LiDAR sensors: their beams, and a window of them.

A sensor's columns lie `azimuth_step` apart and start at azimuth -pi; its rings are numbered from the lowest. Sensor
frame: x forward, y left, z up, the origin is where the beams meet.
"""

import os
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np

from lidarpose.errors import InputError, unknown_name
from lidarpose.geometry import rotation_about
from lidarpose.lidar.pattern import PATTERNS, RayPattern


@dataclass(frozen=True, kw_only=True)
class Window:
    """A block of beams: columns [column0, column0 + columns), modulo the turn, and rows [row0, row0 + rows)."""

    column0: int
    columns: int
    row0: int
    rows: int


@dataclass(frozen=True, kw_only=True, eq=False)
class Sensor:
    """A spinning LiDAR.

    elevations (E,) rad, ascending (two lasers may share one); azimuth_step rad divides the turn; azimuth_offsets (E,)
    rad: a ring's beam leaves at its column's azimuth plus this (None: all rings in line); range_min, range_max m:
    nearer and farther surfaces return nothing; range_sigma m: standard deviation of the range; dropout: share of
    returns lost at random; height m above the ground; tilt rad about y, positive looks down; origin_heights (E,) m:
    how far above the sensor's origin a ring's beams leave, for stacks of several heads (None: all from the origin).

    Offsets are split into whole columns, which only say when a beam fires, and the rest, which says where: columns
    are numbered by azimuth, as in an image whose rows have been shifted into line.
    """

    name: str
    elevations: np.ndarray
    azimuth_step: float
    azimuth_offsets: np.ndarray | None = None
    range_min: float = 0.5
    range_max: float = 100.0
    range_sigma: float = 0.02
    # measured on people in real sweeps: 2.5 percent of the steps along a ring are missing
    dropout: float = 0.025
    height: float = 1.7
    tilt: float = 0.0
    origin_heights: np.ndarray | None = None

    def __post_init__(self):
        elevations = _frozen("elevations", self.elevations)
        if not len(elevations):
            raise InputError("Sensor.elevations must hold at least one ring, got none")
        if (np.abs(elevations) >= np.pi / 2).any():
            raise InputError(
                f"Sensor.elevations must be within +-pi/2 rad, got {elevations.min():.4g} to {elevations.max():.4g}: "
                "are they degrees?"
            )
        if (np.diff(elevations) < 0).any():
            raise InputError("Sensor.elevations must ascend: sort them, and the azimuth offsets with them")
        object.__setattr__(self, "elevations", elevations)
        if self.azimuth_offsets is not None:
            offsets = _frozen("azimuth_offsets", self.azimuth_offsets)
            if offsets.shape != elevations.shape:
                raise InputError(f"Sensor.azimuth_offsets must be {elevations.shape}, one a ring, got {offsets.shape}")
            object.__setattr__(self, "azimuth_offsets", offsets)
        if self.origin_heights is not None:
            heights = _frozen("origin_heights", self.origin_heights)
            if heights.shape != elevations.shape:
                raise InputError(f"Sensor.origin_heights must be {elevations.shape}, one a ring, got {heights.shape}")
            object.__setattr__(self, "origin_heights", heights)
        for field in ("azimuth_step", "range_min", "range_max", "range_sigma", "dropout", "height", "tilt"):
            if not np.isfinite(getattr(self, field)):
                raise InputError(f"Sensor.{field} must be a finite number, got {getattr(self, field)}")
        turn = 2 * np.pi / self.azimuth_step if self.azimuth_step > 0 else 0
        if turn < 1 or abs(turn - round(turn)) > 1e-3:
            raise InputError(f"Sensor.azimuth_step must divide 2 pi, got {self.azimuth_step} rad, {turn:.4f} a turn")
        if not 0 <= self.range_min < self.range_max:
            raise InputError(f"Sensor ranges must be 0 <= min < max, got {self.range_min} m and {self.range_max} m")
        if self.range_sigma < 0 or not 0 <= self.dropout < 1:
            raise InputError(
                f"Sensor.range_sigma must be >= 0 m and dropout in [0, 1), got {self.range_sigma} and {self.dropout}"
            )

    @cached_property
    def columns(self) -> int:
        """Columns in a turn."""
        return round(2 * np.pi / self.azimuth_step)

    @property
    def rows(self) -> int:
        """Rings."""
        return len(self.elevations)

    @property
    def azimuth_start(self) -> float:
        """Azimuth of column 0, rad."""
        return -np.pi

    @cached_property
    def tangents(self) -> np.ndarray:
        """(E,) tan(elevations)."""
        return np.tan(self.elevations)

    @cached_property
    def azimuth_shifts(self) -> np.ndarray:
        """(E,) rad: what is left of the azimuth offsets after whole columns, at most half a step."""
        if self.azimuth_offsets is None:
            return np.zeros(self.rows)
        columns = self.azimuth_offsets / self.azimuth_step
        rest = columns - np.round(columns)
        # a thousandth of a step is below any calibration
        return np.where(np.abs(rest) < 1e-3, 0.0, rest) * self.azimuth_step

    @cached_property
    def shift_groups(self) -> tuple[tuple[float, np.ndarray], ...]:
        """Pairs (shift rad, ascending rings that have it)."""
        shifts, ring = np.unique(self.azimuth_shifts.round(9), return_inverse=True)
        return tuple((float(shift), np.flatnonzero(ring == i)) for i, shift in enumerate(shifts))

    @cached_property
    def heads(self) -> tuple[tuple[float, "Sensor", np.ndarray], ...]:
        """(height m, the sensor of its rings alone, their numbers) of each origin; none if all beams share one."""
        if self.origin_heights is None:
            return ()
        found = []
        for height in np.unique(self.origin_heights):
            rings = np.flatnonzero(self.origin_heights == height)
            offsets = None if self.azimuth_offsets is None else self.azimuth_offsets[rings]
            head = replace(self, elevations=self.elevations[rings], azimuth_offsets=offsets, origin_heights=None)
            found.append((float(height), head, rings))
        return tuple(found)

    @property
    def T_sensor_from_ground(self) -> np.ndarray:
        """(4, 4): from the level frame on the ground below the sensor (z = 0 is the ground) to the sensor's frame."""
        transform = np.eye(4)
        transform[:3, :3] = rotation_about("y", -self.tilt)
        transform[:3, 3] = transform[:3, :3] @ [0, 0, -self.height]
        return transform

    def window(self, left: float, right: float, low: float, high: float) -> Window:
        """The beams with azimuth in [left, right] and elevation in [low, high], rad; left <= right, unwrapped."""
        first = int(np.ceil((left - self.azimuth_start - self.azimuth_shifts.max()) / self.azimuth_step))
        last = int(np.floor((right - self.azimuth_start - self.azimuth_shifts.min()) / self.azimuth_step))
        count = max(0, last - first + 1)
        if count >= self.columns:
            first, count = 0, self.columns
        row0, end = np.searchsorted(self.elevations, low), np.searchsorted(self.elevations, high, side="right")
        return Window(column0=first % self.columns, columns=count, row0=int(row0), rows=max(0, int(end) - int(row0)))

    def azimuths(self, window: Window) -> np.ndarray:
        """(C, R) rad: azimuth of each beam of a window, not wrapped at the seam."""
        columns = self.azimuth_start + (window.column0 + np.arange(window.columns)) * self.azimuth_step
        return columns[:, None] + self.azimuth_shifts[window.row0 : window.row0 + window.rows]


def _frozen(name: str, values: np.ndarray) -> np.ndarray:
    values = np.array(values, float)
    if values.ndim != 1 or not np.isfinite(values).all():
        raise InputError(f"Sensor.{name} must be a list of finite angles in radians, got shape {values.shape}")
    values.setflags(write=False)
    return values


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

# Range noise is the makers' typical one-sigma figure or the middle of theirs; heights are those of the usual mount.
SENSORS: dict[str, Sensor | RayPattern] = {
    sensor.name: sensor
    for sensor in (
        *PATTERNS,
        # Paper: implementation details (64 lines, 2650 angles); the fan and the height are the released code's. Its
        # 2650 azimuths run from -pi to +pi with both ends, so 2649 of them differ.
        Sensor(
            name="dapt64",
            elevations=np.radians(np.linspace(-10, 10, 64)),
            azimuth_step=_turn(2649),
            range_sigma=0.01,
            dropout=0.0,
            height=0.5,
        ),
        # Waymo Open Dataset (arXiv:1912.04838, table 2): 64 rings over -17.6..+2.4 deg, 2650 columns. Even spacing is
        # a stand-in: the true inclinations are in each segment's calibration.
        Sensor(
            name="waymo-top",
            elevations=np.radians(np.linspace(-17.6, 2.4, 64)),
            azimuth_step=_turn(2650),
            range_max=75.0,
            height=2.0,
        ),
        # Velodyne VLP-16 manual: 16 rings 2 deg apart; 0.2 deg at 10 Hz; +-3 cm
        Sensor(name="vlp-16", elevations=np.radians(np.arange(-15.0, 16, 2)), azimuth_step=_turn(1800), height=0.7),
        # +-3 cm; 0.2 deg at 10 Hz. Its lasers stand 1.4 and 4.2 deg to either side: 7 and 21 whole columns.
        Sensor(
            name="vlp-32c",
            elevations=_VLP_32C,
            azimuth_step=_turn(1800),
            range_min=1.0,
            range_max=200.0,
            height=1.8,
        ),
        # Velodyne HDL-32E manual: 32 rings 4/3 deg apart from -30.67 to +10.67; 0.16 deg at 10 Hz; +-2 cm
        Sensor(
            name="hdl-32e",
            elevations=np.radians(np.linspace(-92 / 3, 32 / 3, 32)),
            azimuth_step=_turn(2250),
            range_min=1.0,
            range_max=100.0,
            height=1.8,
        ),
        # Velodyne HDL-64E manual: upper block 1/3 deg apart from +2 down, lower block 1/2 deg apart to -24.33;
        # 0.1728 deg at 10 Hz. Nominal: each unit has its own table (one published calibration, an S2.1's, reaches from
        # -24.8 to +5.0 deg), and its two blocks have origins 10 cm apart.
        Sensor(
            name="hdl-64e",
            elevations=np.radians(np.concatenate([np.linspace(-24.33, -8.83, 32), np.linspace(-8.83 + 0.5, 2, 32)])),
            azimuth_step=_turn(2083),
            range_min=0.9,
            range_max=120.0,
            height=1.73,
        ),
        # Ouster OS1, OS0 and OS2, uniform. Beams of a column leave in four azimuth groups 8 columns of 2048 apart:
        # whole columns, so they shift when a beam fires, not where it points. Real units deviate by some 0.01 deg.
        Sensor(
            name="os1-64",
            elevations=np.radians(np.linspace(-22.5, 22.5, 64)),
            azimuth_step=_turn(1024),
            range_max=120.0,
            height=1.5,
        ),
        Sensor(
            name="os1-128",
            elevations=np.radians(np.linspace(-22.5, 22.5, 128)),
            azimuth_step=_turn(2048),
            range_max=120.0,
            height=1.5,
        ),
        Sensor(
            name="os0-128",
            elevations=np.radians(np.linspace(-45, 45, 128)),
            azimuth_step=_turn(2048),
            range_min=0.3,
            range_max=50.0,
            height=1.5,
        ),
        Sensor(
            name="os2-128",
            elevations=np.radians(np.linspace(-11.25, 11.25, 128)),
            azimuth_step=_turn(2048),
            range_min=1.0,
            range_max=240.0,
            height=1.8,
        ),
        # Hesai's default correction file; 0.2 deg at 10 Hz
        Sensor(
            name="pandar64",
            elevations=_PANDAR64,
            azimuth_step=_turn(1800),
            azimuth_offsets=_PANDAR64_OFFSETS,
            range_min=0.3,
            range_max=200.0,
            height=1.8,
        ),
        # Argoverse 2 (Wilson et al. 2021): two VLP-32C stacked on the roof, one upside down: rings at the table's
        # angles and at their negatives. In its sweeps the second one's beams meet 11 cm below the first's, and the
        # ground lies 2 m below. That its columns lie half a step further is a stand-in for a free phase.
        Sensor(
            name="av2",
            elevations=np.concatenate([_VLP_32C, -_VLP_32C])[_AV2_ORDER],
            azimuth_step=_turn(1800),
            azimuth_offsets=np.repeat([0.0, _turn(3600)], 32)[_AV2_ORDER],
            origin_heights=np.repeat([0.0, -0.11], 32)[_AV2_ORDER],
            range_min=1.0,
            range_max=200.0,
            height=2.0,
        ),
    )
}


def sensor(name: str | os.PathLike) -> Sensor | RayPattern:
    """A named sensor, or that of a .json or .csv file (`tables.load_sensor`), which is read once; an unknown name
    raises an InputError that lists the nearest ones."""
    name = os.fspath(name) if isinstance(name, os.PathLike) else str(name)
    if name in SENSORS:
        return SENSORS[name]
    if name.lower().endswith((".json", ".csv")):
        return _of_file(name)
    raise unknown_name("sensor", name, SENSORS)


@cache
def _of_file(path: str) -> Sensor:
    """Read once: generators ask for every person."""
    from lidarpose.lidar.tables import load_sensor

    return load_sensor(path)
