"""What the rays of a pattern return: `raycast.scan` for sensors without rings.

Legend: V vertices, F faces, M vertices of the body.
"""

import numpy as np

from lidarpose.lidar.hits import Hits
from lidarpose.lidar.ray_pattern import RayPattern, Rays
from lidarpose.lidar.raycast import cast_ray_list
from lidarpose.lidar.raycast_scan import bounds


def scan_pattern(
    vertices: np.ndarray,
    faces: np.ndarray,
    pattern: RayPattern,
    frame: int,
    *,
    moved: np.ndarray | None = None,
    body_vertices: int | None = None,
    margin: float = 0.0,
) -> Hits:
    """What the rays of a frame meet, of those that pass a body within `margin` rad.

    vertices (V, 3) m in the sensor's frame when the frame begins, faces (F, 3); moved (V, 3) m: where the vertices are
    when it ends (None: they stand still). body_vertices: how many of the first vertices are the body (None: all).
    Returns `Hits`, ordered by azimuth: ring is the ray's line, column its number in the frame; columns and rows
    are 0. A hit outside the pattern's range limits returns nothing. Raises InputError.
    """
    rays = pattern.frame(frame)
    body = vertices[:body_vertices]
    if moved is not None and len(body):
        body = np.concatenate([body, moved[:body_vertices]])
    picked = _near(rays, body, margin)
    time = rays.time[picked] if moved is not None else None
    distance, face = cast_ray_list(vertices, faces, rays.directions[picked], moved=moved, time=time)
    # no hit is infinitely far
    seen = np.flatnonzero((distance >= pattern.range_min) & (distance <= pattern.range_max))
    index = picked[seen]
    return Hits(
        points=(rays.directions[index] * distance[seen, None]).astype(np.float32),
        face=face[seen],
        column=index.astype(np.int32),
        ring=rays.line[index],
        columns=0,
        rows=0,
        column0=0,
        row0=0,
    )


def _near(rays: Rays, body: np.ndarray, margin: float) -> np.ndarray:
    """Numbers, ascending, of the rays inside the window of azimuths and elevations that holds a body (M, 3)."""
    if not len(body):
        return np.zeros(0, np.int64)
    center, left, right, low, high = bounds(np.ascontiguousarray(body, np.float64))
    left, right = left - margin, right + margin
    if right - left >= 2 * np.pi:
        picked = np.arange(len(rays.azimuth))
    else:
        start = np.mod(center + left + np.pi, 2 * np.pi) - np.pi
        stop = start + right - left
        a, b = np.searchsorted(rays.azimuth, start, "left"), np.searchsorted(rays.azimuth, stop, "right")
        picked = np.arange(a, b)
        if stop > np.pi:
            picked = np.concatenate([np.arange(np.searchsorted(rays.azimuth, stop - 2 * np.pi, "right")), picked])
    elevation = rays.elevation[picked]
    return picked[(elevation >= low - margin) & (elevation <= high + margin)]
