"""The slow twin of `raycast`: every ray against every triangle, in float64 (Moeller and Trumbore 1997)."""

import numpy as np

_RAYS_AT_ONCE = 256


def cast_rays_reference(
    vertices: np.ndarray, faces: np.ndarray, azimuth: np.ndarray, elevation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """As `raycast.cast_rays`: range (A, E) float32 m, inf for no hit, and face (A, E) int32, -1 for no hit."""
    azimuth, elevation = np.meshgrid(np.asarray(azimuth, float), np.asarray(elevation, float), indexing="ij")
    directions = np.stack(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], -1
    )
    distance, face = cast_ray_list_reference(vertices, faces, directions.reshape(-1, 3))
    return distance.reshape(azimuth.shape), face.reshape(azimuth.shape)


def cast_ray_list_reference(
    vertices: np.ndarray, faces: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """As `raycast.cast_ray_list`: range (N,) float32 m and face (N,) int32 of rays along directions (N, 3)."""
    a, b, c = np.moveaxis(np.asarray(vertices, float)[np.asarray(faces)], 1, 0)
    directions = np.asarray(directions, float)
    directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    distance = np.full(len(directions), np.inf, np.float32)
    face = np.full(len(directions), -1, np.int32)
    if not len(a):
        return distance, face
    along, up = b - a, c - a
    for start in range(0, len(directions), _RAYS_AT_ONCE):
        d = directions[start : start + _RAYS_AT_ONCE, None]
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
        rays = slice(start, start + _RAYS_AT_ONCE)
        distance[rays] = t[np.arange(len(t)), nearest]
        face[rays] = np.where(np.isfinite(distance[rays]), nearest, -1)
    return distance, face
