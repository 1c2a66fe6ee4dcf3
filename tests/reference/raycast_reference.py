"""Slow reference implementations of `lidarpose.lidar`: each ray against each triangle in float64 (Moeller and Trumbore
1997)."""

import numpy as np

from lidarpose.lidar.raycast import Hits
from lidarpose.lidar.sensor import Sensor, Window

_RAYS_AT_ONCE = 256


def cast_rays_reference(
    vertices: np.ndarray, faces: np.ndarray, azimuth: np.ndarray, elevation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Same as `raycast.cast_rays`: range (A, E) float32 m, inf for no hit, and face (A, E) int32, -1 for no hit."""
    azimuth, elevation = np.meshgrid(np.asarray(azimuth, float), np.asarray(elevation, float), indexing="ij")
    directions = np.stack(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], -1
    )
    distance, face = cast_ray_list_reference(vertices, faces, directions.reshape(-1, 3))
    return distance.reshape(azimuth.shape), face.reshape(azimuth.shape)


def cast_ray_list_reference(
    vertices: np.ndarray,
    faces: np.ndarray,
    directions: np.ndarray,
    *,
    moved: np.ndarray | None = None,
    time: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Same as `raycast.cast_ray_list`: range (N,) float32 m and face (N,) int32 of rays along directions (N, 3)."""
    corners = np.asarray(vertices, float)[np.asarray(faces)]
    directions = np.asarray(directions, float)
    directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    distance = np.full(len(directions), np.inf, np.float32)
    face = np.full(len(directions), -1, np.int32)
    if not len(corners):
        return distance, face
    for start in range(0, len(directions), _RAYS_AT_ONCE):
        rays = slice(start, start + _RAYS_AT_ONCE)
        d = directions[rays, None]
        at_time = corners[None]
        if moved is not None:
            later = np.asarray(moved, float)[np.asarray(faces)]
            at_time = corners + np.asarray(time, float)[rays, None, None, None] * (later - corners)
        a, b, c = np.moveaxis(at_time, 2, 0)
        along, up = b - a, c - a
        across = np.cross(d, up)
        volume = (across * along).sum(-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = -(across * a).sum(-1) / volume
            turned = np.cross(-a, along)
            v = (d * turned).sum(-1) / volume
            t = (up * turned).sum(-1) / volume
            hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (volume != 0)
        t = np.where(hit, t, np.inf)
        nearest = t.argmin(1)
        distance[rays] = t[np.arange(len(t)), nearest]
        face[rays] = np.where(np.isfinite(distance[rays]), nearest, -1)
    return distance, face


def merge_echoes_reference(
    distance: np.ndarray, face: np.ndarray, weights: np.ndarray, *, pulse: float, range_max: float
) -> tuple[np.ndarray, np.ndarray]:
    """Merges sub-beams (N, K) into beams like `scan_kernels`: range (N,) float32 m and face (N,) int32."""
    merged, merged_face = np.full(len(distance), np.inf, np.float32), np.full(len(distance), -1, np.int32)
    for i, ranges in enumerate(distance):
        met = np.flatnonzero(np.isfinite(ranges))
        met = met[np.argsort(ranges[met], kind="stable")]
        echoes = np.split(met, np.flatnonzero(np.diff(ranges[met]) > pulse) + 1)
        power = [(weights[echo] / ranges[echo] ** 2).sum() for echo in echoes]
        if max(power) * range_max**2 >= 1:
            echo = echoes[int(np.argmax(power))]
            merged[i] = np.average(ranges[echo], weights=weights[echo] / ranges[echo] ** 2)
            merged_face[i] = face[i, echo[0]]
    return merged, merged_face


def window_reference(vertices: np.ndarray, sensor: Sensor, *, margin: float = 0.0) -> Window:
    """Smallest beam window that contains vertices (V, 3) m, extended by `margin` rad on each side. Paper: Eq. 3."""
    if not len(vertices):
        return Window(column0=0, columns=0, row0=0, rows=0)
    x, y, z = np.asarray(vertices, float).T
    middle = np.arctan2(y.sum(), x.sum())
    azimuth = (np.arctan2(y, x) - middle + np.pi) % (2 * np.pi) - np.pi
    elevation = np.arctan2(z, np.hypot(x, y))
    left, right, low, high = azimuth.min(), azimuth.max(), elevation.min(), elevation.max()
    if right - left >= np.pi:
        left, right, low, high = -np.pi, np.pi, -np.pi / 2, np.pi / 2
    return sensor.window(middle + left - margin, middle + right + margin, low - margin, high + margin)


def window_of(hits: Hits) -> Window:
    """The beam window of `Hits`."""
    return Window(column0=hits.column0, columns=hits.columns, row0=hits.row0, rows=hits.rows)


def window_rays(hits: Hits, sensor: Sensor) -> np.ndarray:
    """Unit directions (columns, rows, 3) of the beams of the window of `Hits`."""
    a = sensor.azimuths(window_of(hits))
    e = np.broadcast_to(sensor.elevations[hits.row0 : hits.row0 + hits.rows], a.shape)
    return np.stack([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)], -1)


def window_ranges(hits: Hits) -> tuple[np.ndarray, np.ndarray]:
    """The window of `Hits` as an image: range (columns, rows) float32 m, inf for no hit, and face int32, -1."""
    distance = np.full((hits.columns, hits.rows), np.inf, np.float32)
    face = np.full(distance.shape, -1, np.int32)
    distance[hits.column, hits.ring - hits.row0] = np.linalg.norm(hits.points.astype(float), axis=1)
    face[hits.column, hits.ring - hits.row0] = hits.face
    return distance, face
