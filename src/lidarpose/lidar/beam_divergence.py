"""Beams with a width: what a LiDAR returns whose beam lights a spot, not a point.

A beam becomes sub_beams x sub_beams rays over its footprint. The footprint's power is Gaussian across, 1/e^2 of the
middle's at half the divergence, as makers state it. What the rays meet comes back as echoes:
    1. Surfaces nearer together in range than the pulse resolves, c tau / 2 for a pulse of tau seconds, are one echo,
       whose range is the mean of theirs weighted by the power they return: at an edge, a point in mid-air.
    2. Power returned falls with the square of the range (LiDAR equation of an extended diffuse target, Wagner et al.
       2006); how bright a surface is and how it is turned is left aside.
    3. The strongest echo is the beam's return ("strongest return", the usual mode of spinning sensors), if it is as
       strong as a whole beam's from the sensor's greatest range. It lies on the beam's axis.
So silhouettes grow by up to half the divergence, thin things are seen from farther, edges are smeared.
"""

import numpy as np

from lidarpose.errors import InputError
from lidarpose.geometry import unit
from lidarpose.lidar.beam_divergence_kernels import merge_echoes, scan_diverging
from lidarpose.lidar.hits import Hits
from lidarpose.lidar.multi_origin import scan_heads
from lidarpose.lidar.raycast import beams_of, cast_ray_list, scan
from lidarpose.lidar.raycast_input import as_culled, as_directions, as_mesh, as_points, as_times, check_margin
from lidarpose.lidar.sensor import Sensor

# m: c tau / 2 of a pulse of 5 ns, as spinning sensors send it
PULSE = 0.75
_MOST_SUB_BEAMS = 15
# rad: a lamp, not a LiDAR
_WIDEST = 0.1


def scan_wide(
    vertices: np.ndarray,
    faces: np.ndarray,
    sensor: Sensor,
    *,
    divergence: float,
    sub_beams: int = 3,
    pulse: float = PULSE,
    window_vertices: np.ndarray | None = None,
    margin: float = 0.0,
    cull: bool | np.ndarray | None = None,
) -> Hits:
    """`raycast.scan` with beams of a full divergence in rad, 0.0015 to 0.003 for most sensors; 0 is `scan` itself.

    A hit's face is that of the nearest surface in the returned echo. The window reaches half the divergence farther
    than without. In azimuth the footprint is that at the horizon. Takes about sub_beams times as long. pulse m: how
    far apart in range two echoes must be to be told apart. The rest is as in `scan`. Raises InputError.
    """
    _check(divergence, sub_beams, pulse)
    if divergence == 0:
        return scan(vertices, faces, sensor, window_vertices=window_vertices, margin=margin, cull=cull)
    if sensor.heads:
        more = {"divergence": divergence, "sub_beams": sub_beams, "pulse": pulse, "margin": margin, "cull": cull}
        return scan_heads(
            lambda v, head, w: scan_wide(v, faces, head, window_vertices=w, **more), vertices, sensor, window_vertices
        )
    check_margin(margin)
    vertices, faces = as_mesh(vertices, faces)
    window_vertices = vertices if window_vertices is None else as_points("window_vertices", window_vertices)
    offsets, weights = footprint(divergence, sub_beams)
    (points, face, column, ring), (column0, columns, row0, rows) = scan_diverging(
        vertices, faces, as_culled(cull, faces), window_vertices, beams_of(sensor), margin + divergence / 2,
        offsets, weights, float(pulse),
    )  # fmt: skip
    return Hits(
        points=points, face=face, column=column, ring=ring, columns=columns, rows=rows, column0=column0, row0=row0
    )


def cast_wide_ray_list(
    vertices: np.ndarray,
    faces: np.ndarray,
    directions: np.ndarray,
    *,
    divergence: float,
    sub_beams: int = 3,
    pulse: float = PULSE,
    range_max: float = np.inf,
    moved: np.ndarray | None = None,
    time: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """`raycast.cast_ray_list` with beams of a full divergence in rad: range (N,) float32 m and face (N,) int32.

    range_max m: a whole beam's return from there is the weakest that is seen. Takes about sub_beams^2 times as long.
    The rest is as in `scan_wide`. Raises InputError.
    """
    _check(divergence, sub_beams, pulse)
    if not range_max > 0:
        raise InputError(f"range_max must be greater than 0 m, got {range_max}")
    if divergence == 0:
        return cast_ray_list(vertices, faces, directions, moved=moved, time=time)
    offsets, weights = footprint(divergence, sub_beams)
    directions = as_directions(directions)
    rays = spread(directions, offsets)
    time = None if time is None else np.repeat(as_times(time, len(directions)), rays.shape[1])
    distance, face = cast_ray_list(vertices, faces, rays.reshape(-1, 3), moved=moved, time=time)
    return merge_echoes(
        distance.reshape(rays.shape[:2]).astype(float), face.reshape(rays.shape[:2]), weights.reshape(-1),
        float(pulse), float(range_max),
    )  # fmt: skip


def footprint(divergence: float, sub_beams: int) -> tuple[np.ndarray, np.ndarray]:
    """Offsets (S,) rad of the sub-beams in azimuth and in elevation, and the power (S, S) in each, in all 1."""
    offsets = ((np.arange(sub_beams) + 0.5) / sub_beams - 0.5) * divergence
    across = np.exp(-2 * (offsets / (divergence / 2)) ** 2)
    weights = across[:, None] * across
    return offsets, weights / weights.sum()


def spread(directions: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Directions (N, S * S, 3) of the sub-beams at offsets (S,) rad around beams along directions (N, 3)."""
    directions = unit(directions)
    left = unit(np.stack([-directions[:, 1], directions[:, 0], np.zeros(len(directions))], -1))
    # straight up or down
    left = np.where((left == 0).all(1, keepdims=True), [0.0, 1.0, 0.0], left)
    up = np.cross(directions, left)
    side, rise = (step.reshape(-1, 1) for step in np.meshgrid(np.tan(offsets), np.tan(offsets), indexing="ij"))
    return directions[:, None] + left[:, None] * side + up[:, None] * rise


def _check(divergence: float, sub_beams: int, pulse: float) -> None:
    if not 0 <= divergence <= _WIDEST:
        raise InputError(f"divergence must be between 0 and {_WIDEST} rad, got {divergence}: is it in mrad?")
    if sub_beams != int(sub_beams) or not 1 <= sub_beams <= _MOST_SUB_BEAMS:
        raise InputError(f"sub_beams must be a whole number from 1 to {_MOST_SUB_BEAMS}, got {sub_beams}")
    if not 0 <= pulse < np.inf:
        raise InputError(f"pulse must be a length >= 0 m, got {pulse}")
