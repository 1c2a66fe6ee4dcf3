"""The compiled loops of `raycast`, which explains the algorithm and the symbols. They use no Python objects, release
the GIL and may be called from many threads.

Loops over vertices, faces and pairs index flat arrays with unsigned integers: only then does the compiler know the
stride and that no index is negative, and vectorizes the loop. That halves the time.

Compilation dominates the first call. Therefore every kernel is compiled for one type of each array (see the checks in
`raycast`), and NumPy expressions such as slice assignment, `max()` and `searchsorted()` are written as loops: numba
takes longer to compile one such expression, with its error messages, than most of these functions.
"""

from typing import NamedTuple

import numpy as np

from lidarpose.errors import MissingExtra

try:
    from numba import njit
except ImportError as error:  # pragma: no cover - numba is an optional extra
    raise MissingExtra("casting rays", "synth") from error

# vertices with |y/x| or |z/x| above this are not projected: beyond it, float64 would lose too many digits
STEEP = 100.0
# tolerance for rounding; crossings are accurate to 1e-13
ROUNDING = 1e-9
_TABLE_BINS = 8192
# points less than this ahead of the sensor's axis, m, count as behind it; nearer surfaces are not hit
AXIS = 1e-9
_LOW = 0xFFFFFFFF
# number of (triangle, column) pairs per batch, to stay in the CPU cache
_BLOCK = 1024

compiled = njit(nogil=True, cache=True, error_model="numpy")


class Table(NamedTuple):
    """Sorted values followed by inf, and their look-up table: all values before index `lut[bin(t)]` are below t.

    bin() is monotone in floating point, so a value in an earlier bin than t's is certainly < t. `single`: no bin
    holds two values, so one comparison completes the search.
    """

    values: np.ndarray
    lut: np.ndarray
    low: float
    scale: float
    bins: float
    single: bool


@compiled
def _table(values):
    n = len(values)
    span = values[n - 1] - values[0]
    gap = span
    for i in range(n - 1):
        # rings may share an elevation
        if values[i + 1] > values[i]:
            gap = min(gap, values[i + 1] - values[i])
    bins = 1
    if gap > 0 and span > 0:
        bins = int(min(1.05 * span / gap + 2, _TABLE_BINS))
    scale = bins / span if span > 0 else 0.0
    if not np.isfinite(scale):
        scale = 0.0
    lut = np.zeros(bins + 2, np.int32)
    for i in range(n):
        lut[int(min(max((values[i] - values[0]) * scale, 0.0), bins)) + 1] += 1
    single = True
    for b in range(bins + 1):
        single = single and lut[b + 1] < 2
        lut[b + 1] += lut[b]
    padded = np.empty(n + 1)
    for i in range(n):
        padded[i] = values[i]
    padded[n] = np.inf
    return Table(padded, lut, values[0], scale, float(bins), single)


@compiled
def _find(t, table):
    """The number of values below t, which may be inf."""
    i = np.uintp(table.lut[np.uintp(np.int32(min(max((t - table.low) * table.scale, 0.0), table.bins)))])
    while table.values[i] < t:
        i += np.uintp(1)
    return i


@compiled
def _find_all(t, table):
    """(n,) int32: `_find` for each of t (n,), without branches if the table is `single`."""
    count = np.empty(len(t), np.int32)
    values, lut, low, scale, bins = table.values, table.lut, table.low, table.scale, table.bins
    for m in range(len(t)):
        i = np.uintp(lut[np.uintp(np.int32(min(max((t[m] - low) * scale, 0.0), bins)))])
        count[m] = i + np.uintp(values[i] < t[m])
    if not table.single:
        for m in range(len(t)):
            count[m] = _find(t[m], table)
    return count


@compiled
def _projected(vertices, c, s, P, Y):
    """Fills P (V * 3) with Y, Z, I of vertices rotated by the angle with cosine c and sine s, and Y (V,) with Y again.

    Returns the number of vertices that are not ahead; their values are meaningless.
    """
    flat, beside_count = vertices.reshape(-1), 0
    for i in range(len(vertices)):
        east, north, z = flat[np.uintp(3 * i)], flat[np.uintp(3 * i + 1)], flat[np.uintp(3 * i + 2)]
        x = c * east + s * north
        y = c * north - s * east
        is_ahead = (x > AXIS) & (x * STEEP > abs(y)) & (x * STEEP > abs(z))
        beside_count += not is_ahead
        inverse = 1 / (x if is_ahead else 1.0)
        Y[np.uintp(i)] = y * inverse
        P[np.uintp(3 * i)] = y * inverse
        P[np.uintp(3 * i + 1)] = z * inverse
        P[np.uintp(3 * i + 2)] = inverse
    return beside_count


@compiled
def _crossing(faces, column):
    """Ascending indices of the faces whose corners do not all lie between the same two columns."""
    corners, is_crossing = faces.reshape(-1), np.empty(len(faces), np.bool_)
    for f in range(len(faces)):
        a = column[np.uintp(corners[np.uintp(3 * f)])]
        b = column[np.uintp(corners[np.uintp(3 * f + 1)])]
        d = column[np.uintp(corners[np.uintp(3 * f + 2)])]
        is_crossing[f] = (a != b) | (b != d)
    return _picked(is_crossing)


@compiled
def _picked(mask):
    """The indices at which the mask is true."""
    indices = np.empty(len(mask) + 1, np.int32)
    n = np.uintp(0)
    for i in range(len(mask)):
        indices[n] = i
        n += np.uintp(mask[i])
    return indices[:n]


@compiled
def raster(vertices, faces, center, column_tan, column_cos, row_tan, column_index, row_index, inverse_x, face):
    """Casts columns of tan, cos(azimuth - center), sorted, within +-46 deg, and rows of tan(elevation), sorted.

    Where a hit is nearer than the grids' current entry, writes 1/x in the frame whose x axis points along `center`, and
    the face, at [column_index, row_index] of `inverse_x` and `face`.
    """
    c, s = np.cos(center), np.sin(center)
    # values that are read together are interleaved
    P, Y = np.empty(3 * len(vertices)), np.empty(len(vertices))
    beside_count = _projected(vertices, c, s, P, Y)
    column, rows = _find_all(Y, _table(column_tan)), _table(row_tan)
    is_ahead = _ahead(vertices, c, s) if beside_count else np.empty(0, np.bool_)
    lines = np.empty(2 * len(column_tan))
    for k in range(len(column_tan)):
        lines[2 * k], lines[2 * k + 1] = column_tan[k], column_cos[k]
    pairs = np.empty(8 * (_BLOCK + len(column_tan)), np.int32)
    n = 0
    for f in _crossing(faces, column):
        a, b, d = np.int64(faces[f, 0]), np.int64(faces[f, 1]), np.int64(faces[f, 2])
        if beside_count and not (is_ahead[a] and is_ahead[b] and is_ahead[d]):
            continue
        # sort the corners from right to left: by column, then by vertex
        a, b, d = a | np.int64(column[a]) << 32, b | np.int64(column[b]) << 32, d | np.int64(column[d]) << 32
        first, last = min(a, b, d), max(a, b, d)
        middle = a ^ b ^ d ^ first ^ last
        split = middle >> 32
        a, b, d = first & _LOW, middle & _LOW, last & _LOW
        for k in range(first >> 32, last >> 32):
            pairs[np.uintp(n)], pairs[np.uintp(n + 1)] = a, d
            pairs[np.uintp(n + 2)], pairs[np.uintp(n + 3)] = a if k < split else b, b if k < split else d
            pairs[np.uintp(n + 4)], pairs[np.uintp(n + 5)] = k, f
            n += 8
        if n >= 8 * _BLOCK:
            _fill(pairs[:n], P, lines, rows, column_index, row_index, inverse_x, face)
            n = 0
    _fill(pairs[:n], P, lines, rows, column_index, row_index, inverse_x, face)
    if beside_count:
        _raster_beside(
            vertices, faces, c, s, is_ahead, P, column, column_tan, column_cos, rows, column_index, row_index,
            inverse_x, face,
        )  # fmt: skip


@compiled
def _fill(pairs, P, lines, rows, column_index, row_index, inverse_x, face):
    """Casts the beams between the crossings of triangles with columns.

    pairs (n * 8): for each pair, the end vertices a, d and p, q of the two edges that cross the column, the column and
    the face; P (V * 3); lines (C * 2): tan and cos of the columns.
    """
    count = len(pairs) // 8
    ends, lower = np.empty(4 * count), np.empty(count)
    for m in range(count):
        a, d = 3 * np.int64(pairs[np.uintp(8 * m)]), 3 * np.int64(pairs[np.uintp(8 * m + 1)])
        p, q = 3 * np.int64(pairs[np.uintp(8 * m + 2)]), 3 * np.int64(pairs[np.uintp(8 * m + 3)])
        k = 2 * np.int64(pairs[np.uintp(8 * m + 4)])
        line, cosine = lines[np.uintp(k)], lines[np.uintp(k + 1)]
        ay, az, ai = P[np.uintp(a)], P[np.uintp(a + 1)], P[np.uintp(a + 2)]
        py, pz, pi = P[np.uintp(p)], P[np.uintp(p + 1)], P[np.uintp(p + 2)]
        u = (line - ay) / (P[np.uintp(d)] - ay)
        ends[np.uintp(4 * m)] = (az + u * (P[np.uintp(d + 1)] - az)) * cosine
        ends[np.uintp(4 * m + 1)] = ai + u * (P[np.uintp(d + 2)] - ai)
        u = (line - py) / (P[np.uintp(q)] - py)
        ends[np.uintp(4 * m + 2)] = (pz + u * (P[np.uintp(q + 1)] - pz)) * cosine
        ends[np.uintp(4 * m + 3)] = pi + u * (P[np.uintp(q + 2)] - pi)
        lower[m] = min(ends[np.uintp(4 * m)], ends[np.uintp(4 * m + 2)])
    start, values = _find_all(lower, rows), rows.values
    has_hit = np.empty(count, np.bool_)
    for m in range(count):
        has_hit[m] = values[np.uintp(start[m])] < max(ends[np.uintp(4 * m)], ends[np.uintp(4 * m + 2)])
    for m in _picked(has_hit):
        t0, i0, t1, i1 = ends[4 * m], ends[4 * m + 1], ends[4 * m + 2], ends[4 * m + 3]
        end, column = max(t0, t1), np.uintp(column_index[pairs[8 * m + 4]])
        r = np.uintp(start[m])
        while values[r] < end:
            value = i0 + (values[r] - t0) / (t1 - t0) * (i1 - i0)
            row = np.uintp(row_index[r])
            if value > inverse_x[column, row]:
                inverse_x[column, row] = value
                face[column, row] = pairs[8 * m + 5]
            r += np.uintp(1)


@compiled
def _ahead(vertices, c, s):
    """(V,) bool: whether `_projected` projects a vertex."""
    is_ahead = np.empty(len(vertices), np.bool_)
    for i in range(len(vertices)):
        x = c * vertices[i, 0] + s * vertices[i, 1]
        y = c * vertices[i, 1] - s * vertices[i, 0]
        is_ahead[i] = (x > AXIS) & (x * STEEP > abs(y)) & (x * STEEP > abs(vertices[i, 2]))
    return is_ahead


@compiled
def _raster_beside(
    vertices, faces, c, s, is_ahead, P, column, column_tan, column_cos, table, column_index, row_index, inverse_x, face
):  # fmt: skip
    """The part of `raster` for triangles with a vertex that is not ahead: slower, but correct for any triangle.

    Crossings of edges between two vertices ahead are computed as in `raster`, so that there are no holes in between.
    """
    row_tan = table.values
    columns, rows = len(column_tan), len(row_tan) - 1
    x, y, z = np.empty(3), np.empty(3), np.empty(3)
    is_left = np.empty(3, np.bool_)
    end_t, end_i, end_x, end_z = np.empty(2), np.empty(2), np.empty(2), np.empty(2)
    for f in range(len(faces)):
        if is_ahead[faces[f, 0]] and is_ahead[faces[f, 1]] and is_ahead[faces[f, 2]]:
            continue
        first = last = 0
        for j in range(3):
            i = faces[f, j]
            x[j] = c * vertices[i, 0] + s * vertices[i, 1]
            y[j] = c * vertices[i, 1] - s * vertices[i, 0]
            z[j] = vertices[i, 2]
            first += (column[i] > 0) if is_ahead[i] else (y[j] - column_tan[0] * x[j] > 0)
            last += (column[i] > columns - 1) if is_ahead[i] else (y[j] - column_tan[columns - 1] * x[j] > 0)
        # a vertex's side changes at most once over the columns
        if first == last and (first == 0 or first == 3) or max(x[0], x[1], x[2]) <= 0:
            continue
        for k in range(columns):
            left_count = 0
            for j in range(3):
                i = faces[f, j]
                is_left[j] = (k < column[i]) if is_ahead[i] else (y[j] - column_tan[k] * x[j] > 0)
                left_count += is_left[j]
            if left_count == 0 or left_count == 3:
                continue
            lone_corner = 0
            for j in range(3):
                if is_left[j] == (left_count == 1):
                    lone_corner = j
            for e in range(2):
                p = lone_corner
                q = (lone_corner + 1 + e) % 3
                if is_left[p]:
                    p, q = q, p
                a, b = faces[f, p], faces[f, q]
                if is_ahead[a] and is_ahead[b]:
                    u = (column_tan[k] - P[3 * a]) / (P[3 * b] - P[3 * a])
                    end_i[e] = P[3 * a + 2] + u * (P[3 * b + 2] - P[3 * a + 2])
                    end_t[e] = (P[3 * a + 1] + u * (P[3 * b + 1] - P[3 * a + 1])) * column_cos[k]
                    end_x[e] = 1 / end_i[e]
                    end_z[e] = (P[3 * a + 1] + u * (P[3 * b + 1] - P[3 * a + 1])) * end_x[e]
                else:
                    # the signs must agree with `is_left`, or an edge in the column's plane might have no crossing
                    distance_p = (P[3 * a] - column_tan[k]) * x[p] if is_ahead[a] else y[p] - column_tan[k] * x[p]
                    distance_q = (P[3 * b] - column_tan[k]) * x[q] if is_ahead[b] else y[q] - column_tan[k] * x[q]
                    u = distance_p / (distance_p - distance_q)
                    end_x[e] = x[p] + u * (x[q] - x[p])
                    end_z[e] = z[p] + u * (z[q] - z[p])
                    if end_x[e] > AXIS:
                        end_i[e] = 1 / end_x[e]
                        end_t[e] = end_z[e] * end_i[e] * column_cos[k]
            if end_x[0] <= AXIS and end_x[1] <= AXIS:
                continue
            near, far = (0, 1) if end_x[0] > AXIS else (1, 0)
            r = np.int64(_find(end_t[near], table))
            if end_x[far] > AXIS:
                stop = np.int64(_find(end_t[far], table))
                if stop < r:
                    r, stop = stop, r
                while r < stop:
                    u = (row_tan[r] - end_t[near]) / (end_t[far] - end_t[near])
                    value = end_i[near] + u * (end_i[far] - end_i[near])
                    if value > inverse_x[column_index[k], row_index[r]]:
                        inverse_x[column_index[k], row_index[r]] = value
                        face[column_index[k], row_index[r]] = f
                    r += 1
                continue
            # the segment passes above or below the sensor, so it covers the rows up to the zenith or down to the nadir
            dx, dz = end_x[far] - end_x[near], end_z[far] - end_z[near]
            height = end_z[near] - end_x[near] / dx * dz
            if height == 0:
                continue
            stop = rows
            if height < 0:
                r, stop = 0, r
            area = end_x[near] * end_z[far] - end_x[far] * end_z[near]
            while r < stop:
                value = (dz - row_tan[r] / column_cos[k] * dx) / area
                if value > inverse_x[column_index[k], row_index[r]] and value * AXIS < 1 + abs(row_tan[r]):
                    inverse_x[column_index[k], row_index[r]] = value
                    face[column_index[k], row_index[r]] = f
                r += 1
