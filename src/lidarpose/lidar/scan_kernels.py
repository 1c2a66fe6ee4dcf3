"""The compiled pipeline from a mesh to the packed hits of a spinning sensor: window, sectors, cast, echoes, points.

The symbols are explained in `raycast`; S sub-beams along a side of a beam's footprint. All kernels release the GIL.
Numba does not invalidate its cache of this module when `raycast_kernels` changes: delete __pycache__ then.
"""

from typing import NamedTuple

import numpy as np

from lidarpose.lidar.raycast_kernels import AXIS, STEEP, compiled, njit, raster

# a sector spans at most this much azimuth, so that tan(a) stays near 1
SECTOR = np.radians(92.0)

_MOST = np.int64(2**63 - 1)
# sub-beams are clamped to the zenith and the nadir
_ZENITH = np.pi / 2 - 1e-6


class Beams(NamedTuple):
    """A spinning sensor in the form that compiled code reads; angles in rad. Built by `raycast._compiled_beams`.

    tangents, shifts (E,): tan(elevation) and azimuth shift of the rings; group_shift (G,): the distinct shifts;
    group_ring (E,): the rings, group by group, ascending; group_start (G + 1,): start of each group in group_ring;
    half_tan, half_cos: tan and cos of 0, 1, 2, ... half azimuth steps, up to half of a sector of `sector` columns;
    start, step: azimuth of column 0 and between columns; columns per turn; nearest, farthest: range limits, m.
    """

    tangents: np.ndarray
    shifts: np.ndarray
    group_shift: np.ndarray
    group_ring: np.ndarray
    group_start: np.ndarray
    half_tan: np.ndarray
    half_cos: np.ndarray
    sector: int
    start: float
    step: float
    columns: int
    nearest: float
    farthest: float


@compiled
def _ordered(value):
    """An integer that orders like the value: minima of integers can be vectorized."""
    bits = np.float64(value).view(np.int64)
    return bits ^ ((bits >> 63) & _MOST)


@compiled
def _number(ordered):
    """The inverse of `_ordered`."""
    return np.int64(ordered ^ ((ordered >> 63) & _MOST)).view(np.float64)


# fastmath allows sums in any order
@njit(nogil=True, cache=True, error_model="numpy", fastmath={"nsz", "reassoc"})
def bounds(vertices):
    """Mean azimuth, minimum and maximum azimuth relative to it, minimum and maximum elevation of the vertices, rad."""
    flat, east, north = vertices.reshape(-1), 0.0, 0.0
    for i in range(len(vertices)):
        east += flat[np.uintp(3 * i)]
        north += flat[np.uintp(3 * i + 1)]
    center = np.arctan2(north, east)
    c, s = np.cos(center), np.sin(center)
    left, right, low, high, ahead_margin = _MOST, -_MOST, _MOST, -_MOST, _MOST
    for i in range(len(vertices)):
        vx, vy, vz = flat[np.uintp(3 * i)], flat[np.uintp(3 * i + 1)], flat[np.uintp(3 * i + 2)]
        x, y = c * vx + s * vy, c * vy - s * vx
        ahead_margin = min(ahead_margin, _ordered(min(x * STEEP - abs(y), x - AXIS)))
        azimuth = _ordered(y * (1 / (x if x > AXIS else 1.0)))
        # squared slope with the slope's sign
        slope = _ordered(vz * abs(vz) / (x * x + y * y if x > AXIS else 1.0))
        left, right = min(left, azimuth), max(right, azimuth)
        low, high = min(low, slope), max(high, slope)
    if ahead_margin > 0:
        left, right, low, high = _number(left), _number(right), _number(low), _number(high)
        low, high = np.sign(low) * np.sqrt(abs(low)), np.sign(high) * np.sqrt(abs(high))
        return center, np.arctan(left), np.arctan(right), np.arctan(low), np.arctan(high)
    left, right, low, high = np.inf, -np.inf, np.inf, -np.inf
    for i in range(len(vertices)):
        x = c * vertices[i, 0] + s * vertices[i, 1]
        y = c * vertices[i, 1] - s * vertices[i, 0]
        azimuth = np.arctan2(y, x)
        elevation = np.arctan2(vertices[i, 2], np.sqrt(x * x + y * y))
        left, right = min(left, azimuth), max(right, azimuth)
        low, high = min(low, elevation), max(high, elevation)
    if right - left >= np.pi:
        # the mesh surrounds the sensor: faces may extend over the zenith and behind the sensor
        return center, -np.pi, np.pi, -np.pi / 2, np.pi / 2
    return center, left, right, low, high


@compiled
def sub_tangents(elevations, offsets):
    """(E, S) tan(elevation) of the sub-beams at offsets (S,) rad from elevations (E,) rad."""
    tangents = np.empty((len(elevations), len(offsets)))
    for ring in range(len(elevations)):
        for b in range(len(offsets)):
            tangents[ring, b] = np.tan(min(max(elevations[ring] + offsets[b], -_ZENITH), _ZENITH))
    return tangents


@compiled
def _cast_grid(vertices, faces, beams, window, offsets, tangents):
    """1/x in the sectors' frames and face, both (S, C, R * S), and 1/cos(azimuth - the sector's middle) (C,).

    Sub-columns, at azimuth offsets (S,) rad, have their own axis; sub-rows, with tangents (E, S), share the rows' axis.
    """
    column0, columns, row0, rows = window
    subs = len(offsets)
    inverse_x = np.zeros((subs, columns, rows * subs))
    face = np.full((subs, columns, rows * subs), -1, np.int32)
    scale = np.ones(columns)
    max_columns = min(columns, beams.sector)
    tan, cos, index = np.empty(max_columns), np.empty(max_columns), np.empty(max_columns, np.int64)
    row_tan, row_index = np.empty(rows * subs), np.empty(rows * subs, np.int64)
    for g in range(len(beams.group_shift)):
        n = 0
        for ring in beams.group_ring[beams.group_start[g] : beams.group_start[g + 1]]:
            if row0 <= ring < row0 + rows:
                for b in range(subs):
                    # insertion sort: sub-rows are almost sorted, as only those of neighboring rows interleave
                    i = n
                    while i > 0 and row_tan[i - 1] > tangents[ring, b]:
                        row_tan[i], row_index[i] = row_tan[i - 1], row_index[i - 1]
                        i -= 1
                    row_tan[i], row_index[i] = tangents[ring, b], (ring - row0) * subs + b
                    n += 1
        if not n:
            continue
        for start in range(0, columns, beams.sector):
            count = min(beams.sector, columns - start)
            for k in range(count):
                half = 2 * k - (count - 1)
                tan[k] = beams.half_tan[half] if half >= 0 else -beams.half_tan[-half]
                cos[k] = beams.half_cos[abs(half)]
                scale[start + k] = 1 / cos[k]
                index[k] = start + k
            center = beams.start + (column0 + start + (count - 1) / 2) * beams.step + beams.group_shift[g]
            for a in range(subs):
                raster(
                    vertices, faces, center + offsets[a], tan[:count], cos[:count], row_tan[:n], index[:count],
                    row_index, inverse_x[a], face[a],
                )  # fmt: skip
    return inverse_x, face, scale


@compiled
def _collect(inverse_x, face, scale, beams, column0, row0):
    """The packed hits of a window within the sensor's range limits: points (n, 3), face, column and ring (n,)."""
    columns, rows = inverse_x.shape
    n = 0
    for k in range(columns):
        for r in range(rows):
            n += inverse_x[k, r] > 0
    points = np.empty((n, 3), np.float32)
    hit_face, column, ring = np.empty(n, np.int32), np.empty(n, np.int32), np.empty(n, np.int32)
    if not n:
        return points, hit_face, column, ring
    per_ring = len(beams.group_shift) > 1
    first_azimuth = beams.start + column0 * beams.step
    n = 0
    for k in range(columns):
        azimuth = first_azimuth + k * beams.step + (0.0 if per_ring else beams.shifts[row0])
        c, s = np.cos(azimuth), np.sin(azimuth)
        for r in range(rows):
            if inverse_x[k, r] <= 0:
                continue
            if per_ring:
                c, s = np.cos(azimuth + beams.shifts[row0 + r]), np.sin(azimuth + beams.shifts[row0 + r])
            tangent = beams.tangents[row0 + r]
            horizontal = scale[k] / inverse_x[k, r]
            distance = horizontal * np.sqrt(1 + tangent * tangent)
            if distance < beams.nearest or distance > beams.farthest:
                continue
            points[n, 0] = horizontal * c
            points[n, 1] = horizontal * s
            points[n, 2] = horizontal * tangent
            hit_face[n] = face[k, r]
            column[n] = k
            ring[n] = row0 + r
            n += 1
    return points[:n], hit_face[:n], column[:n], ring[:n]


@compiled
def strongest_echo(distance, weights, order, pulse, farthest):
    """Range of the strongest echo of K sub-beams and index of its nearest sub-beam; inf and -1 if there is no echo.

    distance (K,) m, inf for sub-beams without a hit; weights (K,) sum to 1; order (K,) is overwritten.
    """
    n = 0
    for k in range(len(distance)):
        if distance[k] == np.inf:
            continue
        # insertion sort by range: few values, often already sorted
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
            sub_beam_power = weights[order[end]] / (r * r)
            power += sub_beam_power
            sum_range += sub_beam_power * r
            end += 1
        if power > best:
            best, best_range, best_face = power, sum_range / power, order[start]
        start = end
    if best * farthest * farthest < 1:
        return np.inf, -1
    return best_range, best_face


@compiled
def _merge_echoes(inverse_x, face, scale, beams, row0, tangents, weights, pulse):
    """1/x and face (C, R) of the beams' returns, as if hit by the beams' axes; inputs as returned by `_cast_grid`."""
    subs, columns, rows = len(weights), len(scale), inverse_x.shape[2] // len(weights)
    merged_inverse_x, merged_face = np.zeros((columns, rows)), np.full((columns, rows), -1, np.int32)
    distance, flat_weights = np.empty(subs * subs), weights.copy().reshape(-1)
    order = np.empty(subs * subs, np.int64)
    for k in range(columns):
        for r in range(rows):
            has_hit = False
            for a in range(subs):
                for b in range(subs):
                    sub_inverse_x, tangent = inverse_x[a, k, r * subs + b], tangents[row0 + r, b]
                    has_hit |= sub_inverse_x > 0
                    distance[a * subs + b] = (
                        scale[k] * np.sqrt(1 + tangent * tangent) / sub_inverse_x if sub_inverse_x > 0 else np.inf
                    )
            if not has_hit:
                continue
            range_, sub = strongest_echo(distance, flat_weights, order, pulse, beams.farthest)
            if sub >= 0:
                tangent = beams.tangents[row0 + r]
                merged_inverse_x[k, r] = scale[k] * np.sqrt(1 + tangent * tangent) / range_
                merged_face[k, r] = face[sub // subs, k, r * subs + sub % subs]
    return merged_inverse_x, merged_face


@compiled
def scan_window(vertices, faces, beams, window, offsets, tangents, weights, pulse):
    """Points (n, 3), face, column and ring (n,) that the beams of a window (column0, columns, row0, rows) return.

    vertices (V, 3) float64, faces (F, 3) int32; sub-beams at azimuth offsets (S,) rad with tangents (E, S) and weights
    (S, S); pulse m as in `raycast.scan`. A single sub-beam is the beam's axis.
    """
    column0, _, row0, _ = window
    cast_inverse_x, cast_face, scale = _cast_grid(vertices, faces, beams, window, offsets, tangents)
    inverse_x, face = cast_inverse_x[0], cast_face[0]
    if len(offsets) > 1:
        inverse_x, face = _merge_echoes(cast_inverse_x, cast_face, scale, beams, row0, tangents, weights, pulse)
    return _collect(inverse_x, face, scale, beams, column0, row0)
