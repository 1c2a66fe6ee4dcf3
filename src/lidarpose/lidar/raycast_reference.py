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
    vertices: np.ndarray,
    faces: np.ndarray,
    directions: np.ndarray,
    *,
    moved: np.ndarray | None = None,
    time: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """As `raycast.cast_ray_list`: range (N,) float32 m and face (N,) int32 of rays along directions (N, 3)."""
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
    """As `divergence` merges the sub-beams (N, K) of beams: range (N,) float32 m and face (N,) int32."""
    merged, merged_face = np.full(len(distance), np.inf, np.float32), np.full(len(distance), -1, np.int32)
    for i, one in enumerate(distance):
        met = np.flatnonzero(np.isfinite(one))
        met = met[np.argsort(one[met], kind="stable")]
        echoes = np.split(met, np.flatnonzero(np.diff(one[met]) > pulse) + 1)
        power = [(weights[echo] / one[echo] ** 2).sum() for echo in echoes]
        if max(power) * range_max**2 >= 1:
            echo = echoes[int(np.argmax(power))]
            merged[i] = np.average(one[echo], weights=weights[echo] / one[echo] ** 2)
            merged_face[i] = face[i, echo[0]]
    return merged, merged_face
