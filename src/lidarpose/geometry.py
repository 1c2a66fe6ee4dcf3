"""Rotations, spherical coordinates, up axes and similarity alignment, in numpy.

Frames are right-handed, x forward, y left, z up; lengths in meters, angles in radians. Rotation matrices act on
column vectors: `rotated = R @ v`, for rows `points @ R.T`.
"""

import reprlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from lidarpose.errors import InputError


def axis_angle_to_matrix(vector: np.ndarray) -> np.ndarray:
    """Rodrigues' formula. vector (..., 3): axis times angle in radians. Returns (..., 3, 3)."""
    vector = np.asarray(vector, float)
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(vector / np.maximum(angle[..., 0], 1e-12), -1, 0)
    o = np.zeros_like(x)
    cross = np.stack([np.stack([o, -z, y], -1), np.stack([z, o, -x], -1), np.stack([-y, x, o], -1)], -2)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)


def rotation_vector(matrix: np.ndarray) -> np.ndarray:
    """The inverse of `axis_angle_to_matrix` for angles up to pi. (..., 3, 3) -> (..., 3) rad."""
    m = np.asarray(matrix)
    skew = np.stack([m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]], -1)
    sine = np.linalg.norm(skew, axis=-1, keepdims=True) / 2
    angle = np.arctan2(sine, (np.trace(m, axis1=-2, axis2=-1)[..., None] - 1) / 2)
    axis = unit(skew)
    # a rotation by 180 degrees has no skew part: R = 2 a a^T - 1, so the columns of R + 1 are along the axis; take the
    # one with the largest diagonal entry
    is_half_turn = (sine < 1e-3) & (angle > 1)
    if is_half_turn.any():
        square = (m + np.swapaxes(m, -1, -2)) / 2 + np.eye(3)
        largest_column = np.diagonal(square, axis1=-2, axis2=-1).argmax(-1)
        half_turn_axis = unit(np.take_along_axis(square, largest_column[..., None, None], -1)[..., 0])
        axis = np.where(
            is_half_turn,
            np.where((half_turn_axis * skew).sum(-1, keepdims=True) < 0, -half_turn_axis, half_turn_axis),
            axis,
        )
    return axis * angle


def rotation_about(axis: str, angle: np.ndarray | float) -> np.ndarray:
    """Rotation by `angle` (...) radians about the axis "x", "y" or "z", right-handed. Returns (..., 3, 3)."""
    angle = np.asarray(angle, float)
    c, s = np.cos(angle), np.sin(angle)
    i = "xyz".index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    matrix = np.zeros(angle.shape + (3, 3))
    matrix[..., i, i] = 1
    matrix[..., j, j] = matrix[..., k, k] = c
    matrix[..., k, j] = s
    matrix[..., j, k] = -s
    return matrix


def rotation_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The smallest rotation from direction a to direction b. a, b (..., 3), any length > 0. Returns (..., 3, 3)."""
    a, b = unit(a), unit(b)
    c = (a * b).sum(-1)
    axis = np.cross(a, b)
    s = np.linalg.norm(axis, axis=-1)
    # opposite directions: any axis perpendicular to a is valid
    perpendicular = np.cross(a, np.where(np.abs(a[..., :1]) < 0.9, [1.0, 0, 0], [0, 1.0, 0]))
    axis = np.where((s < 1e-9)[..., None], unit(perpendicular), axis / np.maximum(s, 1e-12)[..., None])
    return axis_angle_to_matrix(axis * np.arctan2(s, c)[..., None])


def transform_points(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    """points (..., 3) m transformed by a rigid transform T (4, 4)."""
    return points @ T[:3, :3].T + T[:3, 3]


def rigid_transform(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """The transform T (4, 4) of a rotation R (3, 3) and a translation t (3,) m."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def inverse_transform(T: np.ndarray) -> np.ndarray:
    """The inverse of a rigid transform T (4, 4)."""
    return rigid_transform(T[:3, :3].T, -T[:3, :3].T @ T[:3, 3])


def is_rotation(R: np.ndarray) -> bool:
    """Whether a finite matrix R (3, 3) is a rotation to 1 %, the accuracy of external calibrations and poses."""
    # check the entries first: products of very large ones overflow
    return bool(np.abs(R).max() < 1.01 and np.abs(R @ R.T - np.eye(3)).max() < 0.01 and np.linalg.det(R) > 0)


def nearest_rotation(R: np.ndarray) -> np.ndarray:
    """The rotation (3, 3) nearest to R (3, 3), which `is_rotation` accepts; R itself if it is one to 1e-9."""
    if np.abs(R @ R.T - np.eye(3)).max() < 1e-9:
        return R
    u, _, vt = np.linalg.svd(R)
    return u @ vt


def quaternion_to_matrix(quaternion: np.ndarray) -> np.ndarray:
    """The rotation matrix (3, 3) of a quaternion (4,) w, x, y, z of any length > 0."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(np.roll(quaternion, -1)).as_matrix()


def unit(vector: np.ndarray) -> np.ndarray:
    """vector (..., 3) scaled to length 1; a zero vector stays zero."""
    vector = np.asarray(vector, float)
    return vector / np.maximum(np.linalg.norm(vector, axis=-1, keepdims=True), 1e-12)


def to_spherical(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """points (..., 3) -> range (...) m, azimuth (...) rad in [-pi, pi], elevation (...) rad above the xy plane."""
    points = np.asarray(points, float)
    x, y, z = np.moveaxis(points, -1, 0)
    return np.linalg.norm(points, axis=-1), np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))


def from_spherical(distance: np.ndarray, azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """The inverse of `to_spherical`; the three broadcast. Returns (..., 3) m."""
    horizontal = distance * np.cos(elevation)
    x, y, z = np.broadcast_arrays(
        horizontal * np.cos(azimuth), horizontal * np.sin(azimuth), distance * np.sin(elevation)
    )
    return np.stack([x, y, z], -1)


# up axis of an input -> R_level_input, whose rows are x, y, z of the level frame in coordinates of the input.
# Right-handed; forward is kept if the convention has a usual one (y up: z towards the viewer, as in graphics; x up: z
# forward; -y up: z forward and x to the right, as in cameras; -z up: x forward, as in aircraft)
UP_AXES = {
    "z": np.eye(3),
    "y": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    "x": np.array([[0.0, 0, 1], [0, -1, 0], [1, 0, 0]]),
    "-z": np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]),
    "-y": np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]),
    "-x": np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
}


def rotation_from_up(up: str | Sequence[float]) -> np.ndarray:
    """The rotation R_level_input (3, 3) from an input with the given up axis to the level frame (z up).

    Args:
        up: an axis, "z", "y" or "x", with a minus sign if it points down; or a direction of any length > 0 in the
            coordinates of the input, three numbers or "x,y,z", which the smallest possible rotation aligns with z.

    Raises:
        InputError: not an axis or a direction.
    """
    if isinstance(up, str) and up in UP_AXES:
        return UP_AXES[up]
    direction = vector_of(up)
    if direction is None or not np.abs(direction).max() > 0:
        raise InputError(f"up: expected {', '.join(UP_AXES)} or a direction x,y,z, got {reprlib.repr(up)}")
    return rotation_between(direction / np.abs(direction).max(), np.array([0.0, 0.0, 1.0]))


def up_text(up: str | Sequence[float]) -> str:
    """An up axis or direction as text that `rotation_from_up` reads."""
    return up if isinstance(up, str) else ",".join(repr(float(value)) for value in up)


def upright_axis(up: str | Sequence[float]) -> str:
    """The axis, a key of `UP_AXES`, that is nearest to the up direction; see `rotation_from_up`."""
    return nearest_axis(rotation_from_up(up)[2])


def nearest_axis(direction: np.ndarray) -> str:
    """The axis, a key of `UP_AXES`, that is nearest to a direction (3,)."""
    axis = int(np.abs(direction).argmax())
    return "-" * bool(direction[axis] < 0) + "xyz"[axis]


def rotation_of_boxes(up: str | Sequence[float]) -> np.ndarray:
    """The rotation R_boxes_input (3, 3) from an input to the frame in which its boxes are upright along z. In the input
    they are upright along the axis nearest to the up direction; see `rotation_from_up`."""
    return UP_AXES[upright_axis(up)]


def axes_from_above(up: str | Sequence[float]) -> tuple[str, str]:
    """Names of the input's axes that point right and up in a picture from above."""
    right, upward = map(nearest_axis, rotation_from_up(up)[:2])
    if isinstance(up, str) and up in UP_AXES:
        return right, upward
    # turned far, both are nearest to one axis, which then names neither
    is_named = right[-1] != upward[-1]
    return (f"{right} turned level", f"{upward} turned level") if is_named else ("across", "along")


def vector_of(given: Any) -> np.ndarray | None:
    """Three finite numbers or the text "x,y,z" as (3,) float64; None for anything else."""
    try:
        vector = np.array([float(value) for value in (given.split(",") if isinstance(given, str) else given)])
    except (TypeError, ValueError, OverflowError):
        return None
    return vector if vector.shape == (3,) and np.isfinite(vector).all() else None


def distance_to_segments(points: np.ndarray, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """points (n, 3), segments from starts (S, 3) to ends (S, 3), S >= 1 -> (n,): distance to the nearest segment."""
    direction = ends - starts
    square_length = np.maximum((direction**2).sum(1), 1e-12)
    nearest = np.full(len(points), np.inf)
    # one segment at a time to save memory: there may be many points
    for start, along, square in zip(starts, direction, square_length, strict=True):
        offset = points - start
        share = np.clip(offset @ along / square, 0, 1)
        np.minimum(nearest, ((offset - share[:, None] * along) ** 2).sum(1), out=nearest)
    return np.sqrt(nearest)


# width of a strip, m; strip numbers have 16 bits, which sort in linear time, and the last strip holds all other points
_STRIP, _LAST_STRIP = 2.5, 65_535


def rows_near(centers: np.ndarray, points: np.ndarray, reach: float | np.ndarray) -> list[np.ndarray]:
    """For each of centers (K, 2+) m, the rows (k,) of points (n, 3) m within `reach` m in x and in y, ascending.

    reach: one number, or (K,) one per center. Points are first sorted into strips along x, so that not every center has
    to be compared with millions of points.
    """
    x, y = points[:, 0], points[:, 1]
    start = x.min() if len(x) else 0.0
    strip = np.minimum((x - start) / _STRIP, _LAST_STRIP).astype(np.uint16)
    order = np.argsort(strip, kind="stable")
    ends = np.concatenate([[0], np.cumsum(np.bincount(strip, minlength=_LAST_STRIP + 1))])
    rows = []
    for center, own_reach in zip(centers[:, :2], np.broadcast_to(reach, len(centers)), strict=True):
        low, high = (center[0] + side * own_reach for side in (-1, 1))
        first, last = np.clip((np.array([low, high]) - start) / _STRIP, 0, _LAST_STRIP).astype(int)
        near_rows = order[ends[first] : ends[last + 1]]
        near_rows = near_rows[np.abs(y[near_rows] - center[1]) < own_reach]
        rows.append(np.sort(near_rows[np.abs(x[near_rows] - center[0]) < own_reach]))
    return rows


def similarity_align(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Aligns `source` to `target` with the best rotation, translation and scale (Umeyama 1991).

    source, target (..., J, 3) m. Returns (..., J, 3): `source` after the least-squares similarity transform of each
    set, without reflections.
    """
    source, target = np.asarray(source, float), np.asarray(target, float)
    source_mean, target_mean = source.mean(-2, keepdims=True), target.mean(-2, keepdims=True)
    s, t = source - source_mean, target - target_mean
    u, d, vt = np.linalg.svd(np.swapaxes(t, -1, -2) @ s)
    sign = np.ones(d.shape)
    sign[..., -1] = np.where(np.linalg.det(u @ vt) < 0, -1.0, 1.0)
    rotation = (u * sign[..., None, :]) @ vt
    scale = (d * sign).sum(-1) / np.maximum((s**2).sum((-1, -2)), 1e-12)
    return scale[..., None, None] * s @ np.swapaxes(rotation, -1, -2) + target_mean
