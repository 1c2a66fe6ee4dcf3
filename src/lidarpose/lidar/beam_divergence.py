"""Beams with a width: what a LiDAR returns whose beam lights a spot, not a point.

A beam becomes sub_beams x sub_beams rays over its footprint. The footprint's power is Gaussian across, 1/e^2 of the
middle's at half the divergence, as makers state it. What the rays meet comes back as echoes:
    1. Surfaces nearer together in range than the pulse resolves, c tau / 2 for a pulse of tau seconds, are one echo,
       whose range is the mean of theirs weighted by the power they return: at an edge, a point in mid-air.
    2. Power returned falls with the square of the range (LiDAR equation of an extended diffuse target, Wagner et al.
       2006); how bright a surface is and how it is turned is left aside.
    3. The strongest echo is the beam's return ("strongest return", the usual mode of spinning sensors), if it is as
       strong as a whole beam's from the sensor's greatest range. It lies on the beam's axis. There
       are no second returns.
So silhouettes grow by up to half the divergence, thin things are seen from farther, edges are smeared.

Letters as in `raycast`; S sub-beams along a side, K = S * S of a beam. A change in `raycast_kernels` or `raycast_scan`
does not renew what is cached of this module: remove its __pycache__ after one.
"""

from typing import Any

import numpy as np

from lidarpose.errors import InputError
from lidarpose.lidar.raycast import Hits, compiled_beams, scan, scan_multi_origin
from lidarpose.lidar.raycast_input import as_mesh, as_points, check_margin
from lidarpose.lidar.raycast_kernels import compiled, raster
from lidarpose.lidar.raycast_scan import collect, sector_columns, window_of
from lidarpose.lidar.sensor import Sensor

# m: c tau / 2 of a pulse of 5 ns, as spinning sensors send it
PULSE = 0.75
_MOST_SUB_BEAMS = 15
# rad: a lamp, not a LiDAR
_WIDEST = 0.1
# no beam beyond the zenith
_ZENITH = np.pi / 2 - 1e-6


def scan_divergent(
    vertices: np.ndarray,
    faces: np.ndarray,
    sensor: Sensor,
    *,
    divergence: float,
    sub_beams: int = 3,
    pulse: float = PULSE,
    window_vertices: np.ndarray | None = None,
    margin: float = 0.0,
) -> Hits:
    """`raycast.scan` with beams of a width. Takes about sub_beams times as long.

    A hit's face is that of the nearest surface in the returned echo. The window reaches half the divergence farther
    than without. In azimuth the footprint is that at the horizon.

    Args:
        divergence: full, rad; 0.0015 to 0.003 for most sensors; 0 is `scan` itself.
        sub_beams: along a side of the footprint.
        pulse: m, how far apart in range two echoes must be to be told apart.
        vertices, faces, sensor, window_vertices, margin: as in `scan`.

    Raises InputError.
    """
    _check(divergence, sub_beams, pulse)
    if divergence == 0:
        return scan(vertices, faces, sensor, window_vertices=window_vertices, margin=margin)
    if sensor.origins:
        options: dict[str, Any] = {"divergence": divergence, "sub_beams": sub_beams, "pulse": pulse, "margin": margin}
        return scan_multi_origin(
            lambda v, single, w: scan_divergent(v, faces, single, window_vertices=w, **options),
            vertices,
            sensor,
            window_vertices,
        )
    check_margin(margin)
    vertices, faces = as_mesh(vertices, faces)
    window_vertices = vertices if window_vertices is None else as_points("window_vertices", window_vertices)
    offsets, weights = footprint(divergence, sub_beams)
    packed, window = _scan_divergent(
        vertices,
        faces,
        window_vertices,
        compiled_beams(sensor),
        margin + divergence / 2,
        offsets,
        weights,
        float(pulse),
    )
    return Hits.from_arrays(packed, window)


def footprint(divergence: float, sub_beams: int) -> tuple[np.ndarray, np.ndarray]:
    """Offsets (S,) rad of the sub-beams in azimuth and in elevation, and the power (S, S) in each, in all 1."""
    offsets = ((np.arange(sub_beams) + 0.5) / sub_beams - 0.5) * divergence
    across = np.exp(-2 * (offsets / (divergence / 2)) ** 2)
    weights = across[:, None] * across
    return offsets, weights / weights.sum()


def _check(divergence: float, sub_beams: int, pulse: float) -> None:
    if not 0 <= divergence <= _WIDEST:
        raise InputError(f"divergence must be between 0 and {_WIDEST} rad, got {divergence}: is it in mrad?")
    if sub_beams != int(sub_beams) or not 1 <= sub_beams <= _MOST_SUB_BEAMS:
        raise InputError(f"sub_beams must be a whole number from 1 to {_MOST_SUB_BEAMS}, got {sub_beams}")
    if not 0 <= pulse < np.inf:
        raise InputError(f"pulse must be a length >= 0 m, got {pulse}")


@compiled
def strongest_echo(distance, weights, order, pulse, farthest):
    """Range and number of the nearest sub-beam of the strongest echo of sub-beams (K,), inf and -1 for none.

    distance (K,) m, inf where nothing is met; weights (K,) in all 1; order (K,) is overwritten.
    """
    n = 0
    for k in range(len(distance)):
        if distance[k] == np.inf:
            continue
        # by range: few and often in order
        i = n
        while i > 0 and distance[order[i - 1]] > distance[k]:
            order[i] = order[i - 1]
            i -= 1
        order[i] = k
        n += 1
    best, best_range, best_face = 0.0, np.inf, -1
    start = 0
    while start < n:
        power, sum_range, end = 0.0, 0.0, start
        while end < n and (end == start or distance[order[end]] - distance[order[end - 1]] <= pulse):
            r = distance[order[end]]
            received = weights[order[end]] / (r * r)
            power += received
            sum_range += received * r
            end += 1
        if power > best:
            best, best_range, best_face = power, sum_range / power, order[start]
        start = end
    if best * farthest * farthest < 1:
        return np.inf, -1
    return best_range, best_face


@compiled
def _scan_divergent(vertices, faces, window_vertices, beams, margin, offsets, weights, pulse):
    """As `raycast_scan.scan_checked` of checked arrays: sub-beams at offsets (S,) in azimuth and elevation, of weights
    (S, S)."""
    window = window_of(window_vertices, beams, margin)
    column0, columns, row0, rows = window
    subs = len(offsets)
    # sub-columns apart, sub-rows together with the rows
    inverse_x = np.zeros((subs, columns, rows * subs))
    face = np.full((subs, columns, rows * subs), -1, np.int32)
    scale, merged, merged_face = np.ones(columns), np.zeros((columns, rows)), np.full((columns, rows), -1, np.int32)
    most = min(columns, beams.sector)
    tan, cos, index = np.empty(most), np.empty(most), np.empty(most, np.int64)
    row_tan, row_index = np.empty(rows * subs), np.empty(rows * subs, np.int64)
    lift = np.empty(rows * subs)
    for g in range(len(beams.group_shift)):
        n = 0
        for ring in beams.group_ring[beams.group_start[g] : beams.group_start[g + 1]]:
            if row0 <= ring < row0 + rows:
                for b in range(subs):
                    row = (ring - row0) * subs + b
                    row_tan[n] = np.tan(min(max(beams.elevations[ring] + offsets[b], -_ZENITH), _ZENITH))
                    row_index[n] = row
                    lift[row] = np.sqrt(1 + row_tan[n] * row_tan[n])
                    n += 1
        if not n:
            continue
        # the sub-rows of rows that are near one another mix: almost in order as they are
        for m in range(1, n):
            tangent, row, i = row_tan[m], row_index[m], m
            while i > 0 and row_tan[i - 1] > tangent:
                row_tan[i], row_index[i] = row_tan[i - 1], row_index[i - 1]
                i -= 1
            row_tan[i], row_index[i] = tangent, row
        for start in range(0, columns, beams.sector):
            count = sector_columns(beams, start, columns, index, tan, cos, scale)
            center = beams.start + (column0 + start + (count - 1) / 2) * beams.step + beams.group_shift[g]
            for a in range(subs):
                raster(
                    vertices, faces, center + offsets[a], tan[:count], cos[:count], row_tan[:n],
                    index[:count], row_index, inverse_x[a], face[a],
                )  # fmt: skip
    distance, flat = np.empty(subs * subs), weights.copy().reshape(-1)
    order = np.empty(subs * subs, np.int64)
    for k in range(columns):
        for r in range(rows):
            met = False
            for a in range(subs):
                for b in range(subs):
                    near = inverse_x[a, k, r * subs + b]
                    met |= near > 0
                    distance[a * subs + b] = scale[k] * lift[r * subs + b] / near if near > 0 else np.inf
            if not met:
                continue
            range_, sub = strongest_echo(distance, flat, order, pulse, beams.farthest)
            if sub >= 0:
                # as if the beam's axis had met it
                tangent = beams.tangents[row0 + r]
                merged[k, r] = scale[k] * np.sqrt(1 + tangent * tangent) / range_
                merged_face[k, r] = face[sub // subs, k, r * subs + sub % subs]
    return collect(merged, merged_face, scale, beams, column0, row0), window
