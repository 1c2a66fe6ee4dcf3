"""When each point was measured: from the columns of a file, or as given by the user.

Times are (n,) float32 s relative to the newest point, so 0 or negative; -inf for a point without a time.
"""

import reprlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from lidarpose.errors import InputError

# names of columns with the time of each point, in order of preference. Drivers of Ouster write t, of Livox offset_time
# or timestamp, of Velodyne time, of Hesai and Robosense timestamp; VeloView adjustedtime; LAS gps_time
_NAMES = ("t", "offset_time", "adjustedtime", "time", "timestamp", "gps_time")
_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}
# units of whole numbers that do not count from 1970, by name
_WHOLE_UNITS = {"t": 1e-9, "offset_time": 1e-9, "adjustedtime": 1e-6}
# other columns of Livox's driver, whose timestamp is in ns
_LIVOX = {"tag", "line"}
# larger numbers count from 1970: microseconds, then nanoseconds; numbers from the third on are no seconds
_MICROSECONDS, _NANOSECONDS, _NO_SECONDS = 1e14, 1e17, 1e11
# s; times that are rounded more coarsely do not separate scans
_FINEST = 0.01


def time_column(names: Sequence[str]) -> int | None:
    """The position of the column with the points' times among column names, None if there is none."""
    plain_names = [_name_and_unit(name)[0] for name in names]
    return next((plain_names.index(name) for name in _NAMES if name in plain_names), None)


def _name_and_unit(name: str) -> tuple[str, str | None]:
    """ "TIMESTAMP (ns)" -> ("timestamp", "ns")."""
    name, _, unit = name.strip().lower().rstrip("])").replace("[", "(").partition("(")
    return name.strip(), unit or None


@np.errstate(all="ignore")
def times_of_column(values: np.ndarray, names: Sequence[str]) -> np.ndarray | None:
    """Times from the values (n,) of the column at `time_column(names)`; None if the unit is unknown or too coarse, or
    if all points have the same time."""
    column = time_column(names)
    is_finite = np.isfinite(values)
    if column is None or not is_finite.any() or np.ptp(values[is_finite]) == 0:
        return None
    finite_values = values[is_finite]
    scale = _unit(finite_values, names, column)
    if scale is None:
        return None
    largest = np.abs(finite_values).max()
    is_rounded = np.array_equal(finite_values.astype(np.float32), finite_values)
    if is_rounded and scale * np.spacing(np.float32(largest)) > _FINEST:
        return None
    return _relative(values * scale)


def _unit(values: np.ndarray, names: Sequence[str], column: int) -> float | None:
    """The unit, s, of the finite values of a column of times; None if it is unknown."""
    name, unit = _name_and_unit(names[column])
    if unit is not None:
        return _UNITS.get(unit)
    largest, is_whole = np.abs(values).max(), not (values % 1).any()
    if is_whole and name in _WHOLE_UNITS:
        return _WHOLE_UNITS[name]
    if {other.lower() for other in names} >= _LIVOX and name == "timestamp":
        return 1e-9
    if largest >= _MICROSECONDS:
        return 1e-6 if largest < _NANOSECONDS else 1e-9
    # whole numbers may count scans, milliseconds, or anything else
    return None if is_whole or largest >= _NO_SECONDS else 1.0


def as_point_times(times: Any, count: int, what: str = "point_times") -> np.ndarray | None:
    """Times given by the user, (n,) s from any zero, for `count` points; None stays None.

    Raises InputError unless there is a number for each point, and for 32-bit times that are too large to separate
    scans. NaN is a point without a time.
    """
    if times is None:
        return None
    try:
        array = np.asarray(times)
        # dates and time differences would be read as seconds, whatever their unit
        seconds = array.astype(float) if array.dtype.kind in "fiu" else np.full(0, np.nan)
    except (TypeError, ValueError):
        seconds = np.full(0, np.nan)
    if seconds.shape != (count,):
        actual = f"{times.dtype} of shape {times.shape}" if hasattr(times, "dtype") else reprlib.repr(times)
        raise InputError(f"{what}: expected {count} numbers of seconds, one per point, got {actual}")
    is_finite = np.isfinite(seconds)
    # of times relative to the newest, only the oldest are rounded so
    smallest = np.abs(seconds[is_finite]).min() if is_finite.any() else 0.0
    if array.dtype == np.float32 and (step := np.spacing(np.float32(smallest))) > _FINEST:
        problem = f"float32 seconds from {smallest:.3g} on are rounded to {step:.2g} s"
        raise InputError(f"{what}: {problem}: give float64, or seconds from the first point")
    return _relative(seconds)


def _relative(seconds: np.ndarray) -> np.ndarray:
    """seconds (n,) from any zero -> (n,) float32 relative to the newest."""
    is_finite = np.isfinite(seconds)
    newest = seconds[is_finite].max(initial=-np.inf)
    relative = np.full(len(seconds), -np.inf, np.float32)
    with np.errstate(over="ignore"):
        relative[is_finite] = seconds[is_finite] - newest
    return relative
