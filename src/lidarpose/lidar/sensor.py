"""Spinning LiDAR sensors: their beams, and windows of beams.

A sensor's columns are `azimuth_step` apart and start at azimuth -pi; its rings are numbered from the lowest. Sensor
frame: x forward, y left, z up, with the origin at the intersection of the beams.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from lidarpose.errors import InputError, check_finite

_ANGLES = "angles in radians"


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

    elevations (E,) rad, ascending (two lasers may share one); azimuth_step rad, must divide 2 pi; azimuth_offsets (E,)
    rad: azimuth of a ring's beam relative to its column (None: 0 for all rings); range_min, range_max m: nearer and
    farther surfaces return nothing; range_sigma m: standard deviation of the range; dropout: fraction of returns
    dropped at random; height m above the ground; tilt rad about y, positive is downward; origin_heights (E,) m: height
    of a ring's origin above the sensor's, for stacks of several sensors (None: 0 for all rings); ring_lags (E,) in
    [0, 1): delay, as a fraction of a turn, with which a ring passes an azimuth after the first rings, for stacks of
    sensors with different headings (None: no delay); turn_time s: duration of a turn.

    Offsets are split into whole columns, which only change when a beam fires, and a remainder, which changes its
    direction. Columns are numbered by azimuth, as in a destaggered range image.
    """

    name: str
    elevations: np.ndarray
    azimuth_step: float
    azimuth_offsets: np.ndarray | None = None
    range_min: float = 0.5
    range_max: float = 100.0
    range_sigma: float = 0.02
    # measured on people in real sweeps: 2.5 percent of the returns along a ring are missing
    dropout: float = 0.025
    height: float = 1.7
    tilt: float = 0.0
    origin_heights: np.ndarray | None = None
    ring_lags: np.ndarray | None = None
    turn_time: float = 0.1

    def __repr__(self) -> str:
        return f"Sensor({self.name!r}, {self.rows} rings, {self.columns} columns)"

    def __post_init__(self):
        elevations = _frozen("elevations", self.elevations, _ANGLES)
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
        kinds = (
            ("azimuth_offsets", _ANGLES),
            ("origin_heights", "heights in meters"),
            ("ring_lags", "fractions of a turn"),
        )
        for name, kind in kinds:
            if getattr(self, name) is None:
                continue
            values = _frozen(name, getattr(self, name), kind)
            if values.shape != elevations.shape:
                raise InputError(f"Sensor.{name} must be {elevations.shape}, one per ring, got {values.shape}")
            object.__setattr__(self, name, values)
        if self.ring_lags is not None and not 0 <= self.ring_lags.min() <= self.ring_lags.max() < 1:
            raise InputError(
                f"Sensor.ring_lags must be in [0, 1), got {self.ring_lags.min():g} to {self.ring_lags.max():g}"
            )
        check_finite("Sensor.turn_time", self.turn_time)
        if self.turn_time <= 0:
            raise InputError(f"Sensor.turn_time must be above 0 s, got {self.turn_time}")
        check_finite("Sensor.azimuth_step", self.azimuth_step)
        column_count = 2 * np.pi / self.azimuth_step if self.azimuth_step > 0 else 0
        if column_count < 1 or abs(column_count - round(column_count)) > 1e-3:
            raise InputError(
                f"Sensor.azimuth_step must divide 2 pi, got {self.azimuth_step} rad, {column_count:.4f} per turn"
            )
        check_limits(self)

    @cached_property
    def columns(self) -> int:
        """Number of columns per turn."""
        return round(2 * np.pi / self.azimuth_step)

    @property
    def rows(self) -> int:
        """Number of rings."""
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
        """(E,) rad: remainder of the azimuth offsets after whole columns, at most half a step."""
        if self.azimuth_offsets is None:
            return np.zeros(self.rows)
        columns = self.azimuth_offsets / self.azimuth_step
        remainder = columns - np.round(columns)
        # a thousandth of a step is below any calibration
        return np.where(np.abs(remainder) < 1e-3, 0.0, remainder) * self.azimuth_step

    @cached_property
    def shift_groups(self) -> tuple[tuple[float, np.ndarray], ...]:
        """Pairs (shift rad, ascending indices of the rings with this shift)."""
        shifts, ring = np.unique(self.azimuth_shifts.round(9), return_inverse=True)
        return tuple((float(shift), np.flatnonzero(ring == i)) for i, shift in enumerate(shifts))

    @cached_property
    def lag(self) -> float:
        """Delay of the last rings after the first ones at the same azimuth, as a fraction of a turn."""
        return 0.0 if self.ring_lags is None else float(np.ptp(self.ring_lags))

    @cached_property
    def origins(self) -> tuple[tuple[float, float, "Sensor", np.ndarray], ...]:
        """(height m, fraction of `lag`, sensor with only these rings, indices of the rings) for each group of rings
        with the same origin and lag; empty if all rings are in one group."""
        if self.origin_heights is None and not self.lag:
            return ()
        heights = np.zeros(self.rows) if self.origin_heights is None else self.origin_heights
        delays = np.zeros(self.rows) if self.ring_lags is None else self.ring_lags - self.ring_lags.min()
        origins = []
        for height, delay in np.unique(np.stack([heights, delays], 1), axis=0):
            rings = np.flatnonzero((heights == height) & (delays == delay))
            offsets = None if self.azimuth_offsets is None else self.azimuth_offsets[rings]
            origin_sensor = replace(
                self, elevations=self.elevations[rings], azimuth_offsets=offsets, origin_heights=None, ring_lags=None
            )
            origins.append((float(height), float(delay / (self.lag or 1)), origin_sensor, rings))
        return tuple(origins)

    def window(self, left: float, right: float, low: float, high: float) -> Window:
        """The beams with azimuth in [left, right] and elevation in [low, high], rad; left <= right, unwrapped."""
        first_column = int(np.ceil((left - self.azimuth_start - self.azimuth_shifts.max()) / self.azimuth_step))
        last_column = int(np.floor((right - self.azimuth_start - self.azimuth_shifts.min()) / self.azimuth_step))
        count = max(0, last_column - first_column + 1)
        if count >= self.columns:
            first_column, count = 0, self.columns
        row0, end = np.searchsorted(self.elevations, low), np.searchsorted(self.elevations, high, side="right")
        return Window(
            column0=first_column % self.columns, columns=count, row0=int(row0), rows=max(0, int(end) - int(row0))
        )

    def azimuths(self, window: Window) -> np.ndarray:
        """(C, R) rad: azimuth of each beam of a window, not wrapped at +-pi."""
        columns = self.azimuth_start + (window.column0 + np.arange(window.columns)) * self.azimuth_step
        return columns[:, None] + self.azimuth_shifts[window.row0 : window.row0 + window.rows]


def check_limits(sensor: Any) -> None:
    """Raises InputError for invalid range limits, noise, dropout or mounting of a `Sensor` or `RayPattern`."""
    kind = type(sensor).__name__
    for field in ("range_min", "range_max", "range_sigma", "dropout", "height", "tilt"):
        check_finite(f"{kind}.{field}", getattr(sensor, field))
    if not 0 <= sensor.range_min < sensor.range_max:
        raise InputError(f"{kind} ranges must be 0 <= min < max, got {sensor.range_min} m and {sensor.range_max} m")
    if sensor.range_sigma < 0 or not 0 <= sensor.dropout < 1:
        raise InputError(
            f"{kind}.range_sigma must be >= 0 m and dropout in [0, 1), got {sensor.range_sigma} and {sensor.dropout}"
        )


def _frozen(name: str, values: np.ndarray, kind: str) -> np.ndarray:
    try:
        values = np.array(values, float)
    except (TypeError, ValueError):
        raise InputError(f"Sensor.{name} must be a list of finite {kind}, got {values!r}") from None
    if values.ndim != 1 or not np.isfinite(values).all():
        raise InputError(f"Sensor.{name} must be a list of finite {kind}, got shape {values.shape}")
    values.setflags(write=False)
    return values
