"""What the casters accept: checks of their arguments, each with an InputError that says what is wrong.

Arrays come out in one type each, so that compiled code is compiled once.
"""

from typing import Any

import numpy as np

from lidarpose.errors import InputError
from lidarpose.sample import FARTHEST


def as_points(name: str, values: Any) -> np.ndarray:
    """A copy (n, 3) float64, C-contiguous, finite; writable, as what compiled code makes."""
    values = _as_floats(name, values, "an (n, 3) array of numbers")
    if values.ndim != 2 or values.shape[1] != 3:
        raise InputError(f"{name} must be (n, 3), got {values.shape}")
    if values.size and not (values.max() < FARTHEST and values.min() > -FARTHEST):
        bad = int((~(np.abs(values) < FARTHEST).all(1)).sum())
        raise InputError(f"{name} must be finite and below {FARTHEST:.0e} m, but {bad} of {len(values)} are not")
    return values


def as_vertices(name: str, values: np.ndarray) -> np.ndarray:
    """(n, 3) float32 or float64, C-contiguous, read-only; the values are not looked at."""
    if not isinstance(values, np.ndarray) or values.dtype not in (np.float32, np.float64) or values.ndim != 2:
        values = as_points(name, values)
    elif values.shape[1] != 3:
        raise InputError(f"{name} must be (n, 3), got {values.shape}")
    return read_only(values)


def as_mesh(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A copy of vertices (V, 3) float64, and faces (F, 3) int32 that index them, read-only; C-contiguous."""
    vertices = as_points("vertices", vertices)
    faces = as_faces(faces, len(vertices))
    _check_range(faces, len(vertices))
    return vertices, faces


def as_faces(faces: np.ndarray, count: int) -> np.ndarray:
    """faces (F, 3) as int32, C-contiguous, read-only. The values of those that were int32 are not looked at."""
    faces = np.asarray(faces)
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
        raise InputError(f"faces must be (F, 3) integers, got {faces.shape} {faces.dtype}")
    if faces.dtype != np.int32:
        _check_range(faces, count)
        faces = faces.astype(np.int32)
    return read_only(faces)


def read_only(values: np.ndarray) -> np.ndarray:
    """The values, C-contiguous, in a form of which compiled code needs to know but one."""
    values = np.ascontiguousarray(values).view()
    values.flags.writeable = False
    return values


def check_margin(margin: float) -> None:
    """margin rad is a finite angle."""
    if not np.isfinite(margin):
        raise InputError(f"margin must be a finite angle in radians, got {margin}")


def as_directions(directions: np.ndarray) -> np.ndarray:
    """(N, 3) float64, each of length 1."""
    directions = as_points("directions", directions)
    length = np.linalg.norm(directions, axis=1)
    if (length == 0).any():
        raise InputError(f"directions must be longer than 0, but number {int(np.argmin(length))} is zero")
    return directions / length[:, None]


def as_times(time: np.ndarray, count: int) -> np.ndarray:
    """A copy (count,) float64 in [0, 1]."""
    time = _as_floats("time", time, f"({count},) numbers, one a ray")
    if time.shape != (count,):
        raise InputError(f"time must be ({count},), one a ray, got {time.shape}")
    outside = np.flatnonzero(~((time >= 0) & (time <= 1)))
    if len(outside):
        raise InputError(
            f"time must be within 0 and 1, the ends of the motion, got {time[outside[0]]} for ray {outside[0]}"
        )
    return time


def as_angles(name: str, values: np.ndarray) -> np.ndarray:
    """A copy (n,) float64, finite."""
    expected = "a list of finite angles in radians"
    values = _as_floats(name, values, expected)
    if values.ndim != 1 or not np.isfinite(values).all():
        raise InputError(f"{name} must be {expected}, got shape {values.shape}")
    return values


def _as_floats(name: str, values: np.ndarray, expected: str) -> np.ndarray:
    try:
        return np.array(values, np.float64, order="C")
    except (TypeError, ValueError):
        raise InputError(f"{name} must be {expected}, got {type(values).__name__}") from None


def _check_range(faces: np.ndarray, count: int) -> None:
    if faces.size and (faces.min() < 0 or faces.max() >= count):
        raise InputError(f"faces must index the {count} vertices from 0, got {faces.min()} to {faces.max()}")
