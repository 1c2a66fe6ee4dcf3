"""The compiled way from a mesh to the packed hits of a spinning sensor: window, sectors, cast, points. See `raycast`.

Everything here may be called from other compiled code, and runs outside the interpreter's lock. A change in
`raycast_kernels` does not renew what is cached of this module: remove its __pycache__ after one.
"""

from typing import NamedTuple

import numpy as np

from lidarpose.lidar.raycast_kernels import AXIS, STEEP, compiled, njit, raster
from lidarpose.sample import FARTHEST

# a sector spans at most this much azimuth, so that tan(a) stays near 1
SECTOR = np.radians(92.0)

_MOST = np.int64(2**63 - 1)
# what `scan_checked` found
GOOD, BAD_VERTICES, BAD_FACES = 0, 1, 2


class Beams(NamedTuple):
    """A spinning sensor as compiled code reads it; angles in rad. Built by `raycast.compiled_beams`.

    elevations, tangents, shifts (E,): of the rings; group_shift (G,): the different shifts; group_ring (E,): the
    rings, group by group, ascending; group_start (G + 1,): where each group starts in it; half_tan, half_cos: of
    0, 1, 2, ... half steps of azimuth, as far as a sector of `sector` columns reaches from its middle; start, step:
    azimuth of column 0 and between columns; columns in a turn; nearest, farthest m.
    """

    elevations: np.ndarray
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
    """A whole number that orders as the value does: the least of whole numbers is found many at a time."""
    bits = np.float64(value).view(np.int64)
    return bits ^ ((bits >> 63) & _MOST)


@compiled
def _number(ordered):
    """The value of `_ordered`."""
    return np.int64(ordered ^ ((ordered >> 63) & _MOST)).view(np.float64)


# sums may be taken in any order
@njit(nogil=True, cache=True, error_model="numpy", fastmath={"nsz", "reassoc"})
def bounds(vertices):
    """Mean azimuth, and the vertices' least and greatest azimuth relative to it and elevation, rad."""
    flat, east, north = vertices.reshape(-1), 0.0, 0.0
    for i in range(len(vertices)):
        east += flat[np.uintp(3 * i)]
        north += flat[np.uintp(3 * i + 1)]
    center = np.arctan2(north, east)
    c, s = np.cos(center), np.sin(center)
    left, right, low, high, ahead = _MOST, -_MOST, _MOST, -_MOST, _MOST
    for i in range(len(vertices)):
        vx, vy, vz = flat[np.uintp(3 * i)], flat[np.uintp(3 * i + 1)], flat[np.uintp(3 * i + 2)]
        x, y = c * vx + s * vy, c * vy - s * vx
        ahead = min(ahead, _ordered(min(x * STEEP - abs(y), x - AXIS)))
        azimuth = _ordered(y * (1 / (x if x > AXIS else 1.0)))
        # squared, with its sign
        slope = _ordered(vz * abs(vz) / (x * x + y * y if x > AXIS else 1.0))
        left, right = min(left, azimuth), max(right, azimuth)
        low, high = min(low, slope), max(high, slope)
    if ahead > 0:
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
        # around the sensor: between vertices, faces may reach over the zenith and behind
        return center, -np.pi, np.pi, -np.pi / 2, np.pi / 2
    return center, left, right, low, high


@compiled
def window_of(vertices, beams, margin):
    """column0, columns, row0, rows of the smallest window that holds the vertices, `margin` rad wider on each side."""
    if not len(vertices):
        return 0, 0, 0, 0
    center, left, right, low, high = bounds(vertices)
    left, right, low, high = center + left - margin, center + right + margin, low - margin, high + margin
    least = most = beams.shifts[0]
    for shift in beams.shifts:
        least, most = min(least, shift), max(most, shift)
    first = int(np.ceil((left - beams.start - most) / beams.step))
    last = int(np.floor((right - beams.start - least) / beams.step))
    count = max(0, last - first + 1)
    if count >= beams.columns:
        first, count = 0, beams.columns
    row0 = end = 0
    for elevation in beams.elevations:
        row0 += elevation < low
        end += elevation <= high
    return first % beams.columns, count, row0, max(0, end - row0)


@compiled
def sector_columns(beams, start, columns, index, tan, cos, scale):
    """How many columns from `start` on share a sector; their numbers are written into index, their tangents and cosines
    from its middle into tan and cos, 1/cos into scale[start:]."""
    count = min(beams.sector, columns - start)
    for k in range(count):
        half = 2 * k - (count - 1)
        tan[k] = beams.half_tan[half] if half >= 0 else -beams.half_tan[-half]
        cos[k] = beams.half_cos[abs(half)]
        scale[start + k] = 1 / cos[k]
        index[k] = start + k
    return count


@compiled
def cast_grid(vertices, faces, beams, column0, columns, row0, rows):
    """1/x (C, R) in the sectors' frames, face (C, R), 1/cos(azimuth - the sector's middle) (C,) of a window."""
    inverse_x = np.zeros((columns, rows))
    face = np.full((columns, rows), -1, np.int32)
    scale = np.ones(columns)
    most = min(columns, beams.sector)
    tan, cos, index = np.empty(most), np.empty(most), np.empty(most, np.int64)
    row_tan, row_index = np.empty(rows), np.empty(rows, np.int64)
    for g in range(len(beams.group_shift)):
        n = 0
        for ring in beams.group_ring[beams.group_start[g] : beams.group_start[g + 1]]:
            if row0 <= ring < row0 + rows:
                row_tan[n], row_index[n] = beams.tangents[ring], ring - row0
                n += 1
        if not n:
            continue
        for start in range(0, columns, beams.sector):
            count = sector_columns(beams, start, columns, index, tan, cos, scale)
            center = beams.start + (column0 + start + (count - 1) / 2) * beams.step + beams.group_shift[g]
            raster(
                vertices, faces, center, tan[:count], cos[:count], row_tan[:n], index[:count], row_index,
                inverse_x, face,
            )  # fmt: skip
    return inverse_x, face, scale


@compiled
def collect(inverse_x, face, scale, beams, column0, row0):
    """The hits of a window within the sensor's range, packed: points (n, 3), face, column and ring (n,)."""
    columns, rows = inverse_x.shape
    n = 0
    for k in range(columns):
        for r in range(rows):
            n += inverse_x[k, r] > 0
    points = np.empty((n, 3), np.float32)
    hit, column, ring = np.empty(n, np.int32), np.empty(n, np.int32), np.empty(n, np.int32)
    if not n:
        return points, hit, column, ring
    per_ring = len(beams.group_shift) > 1
    first = beams.start + column0 * beams.step
    n = 0
    for k in range(columns):
        azimuth = first + k * beams.step + (0.0 if per_ring else beams.shifts[row0])
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
            hit[n] = face[k, r]
            column[n] = k
            ring[n] = row0 + r
            n += 1
    return points[:n], hit[:n], column[:n], ring[:n]


@compiled
def _copy_checked(vertices, copy):
    """Fills copy (V, 3) float64 with the vertices. Returns whether all are finite and near enough."""
    given, taken, good = vertices.reshape(-1), copy.reshape(-1), 0
    for i in range(len(given)):
        taken[i] = given[i]
        good += abs(given[i]) < FARTHEST
    return good == len(given)


@compiled
def _faces_within(faces, count):
    """Whether all faces (F, 3) int32 index `count` vertices."""
    corners, most = faces.reshape(-1), np.uint32(0)
    for i in range(len(corners)):
        # below zero is far above
        most = max(most, np.uint32(corners[i]))
    return not len(corners) or most < count


@compiled
def scan_checked(vertices, faces, window_vertices, beams, margin):
    """points, face, column, ring; the window (column0, columns, row0, rows); and GOOD or what is wrong with the mesh.

    As `raycast.scan`: vertices (V, 3), window_vertices (M, 3) of any float type; faces (F, 3) int32. Of a bad mesh
    nothing is cast.
    """
    copy, window_copy = np.empty(vertices.shape), np.empty(window_vertices.shape)
    fault = GOOD
    if not _copy_checked(vertices, copy) or not _copy_checked(window_vertices, window_copy):
        fault = BAD_VERTICES
    elif not _faces_within(faces, len(vertices)):
        fault = BAD_FACES
    if fault:
        copy, window_copy, faces = copy[:0], window_copy[:0], faces[:0]
    window = window_of(window_copy, beams, margin)
    inverse_x, face, scale = cast_grid(copy, faces, beams, *window)
    return collect(inverse_x, face, scale, beams, window[0], window[2]), window, fault
