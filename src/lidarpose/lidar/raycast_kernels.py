"""The compiled loops of `raycast`, which explains the algorithm and the letters. No Python object crosses them: they
run outside the interpreter's lock and may be called from many threads.

Loops over vertices, faces and pairs read flat arrays by unsigned numbers: only then does the compiler know the step
between elements, and that no index is negative, and use the processor's vectors. That halves the time.
"""

from typing import NamedTuple

import numpy as np

from lidarpose.errors import MissingExtra

try:
    from numba import njit
except ImportError as error:  # pragma: no cover - numba is an optional extra
    raise MissingExtra("casting rays", "synth") from error

# vertices with |y/x| or |z/x| above this are not projected: beyond it float64 loses more than 14 - 2 digits
STEEP = 100.0
# triangles wider than this in Y are not dropped by row; narrower ones by a bound that follows from it, see `raster`
_NARROW = 0.04
_SAG = 1 / np.cos(_NARROW / 2) - 1
# slack of the row bounds against rounding; crossings are good to 1e-13
ROUNDING = 1e-9
_TABLE_BINS = 8192
# what is less than this ahead of the sensor's axis, m, counts as behind it, and what is nearer is not hit
AXIS = 1e-9
_LOW = 0xFFFFFFFF
# of a vertex's column and rows in its key
_BITS = 21
_MASK = (1 << _BITS) - 1
# pairs of triangle and column that are worked on at a time, to stay near the processor
_BLOCK = 1024
# far above what rounding does to a triangle's orientation
_EDGE_ON = 1e-9

compiled = njit(nogil=True, cache=True, error_model="numpy")


class Table(NamedTuple):
    """Sorted values with an inf behind them, and their look-up table: no value before `lut[bin(t)]` reaches t.

    bin() is monotone in floating point, so a value in an earlier bin than t's is certainly < t. `single`: no bin
    holds two values, so one comparison finishes the search.
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
    padded[:n] = values
    padded[n] = np.inf
    return Table(padded, lut, values[0], scale, float(bins), single)


@compiled
def _find(t, table):
    """The number of values below t, which may be inf."""
    i = _find_single(t, table.values, table.lut, table.low, table.scale, table.bins)
    if not table.single:
        while table.values[i] < t:
            i += np.uintp(1)
    return i


@compiled
def _find_single(t, values, lut, low, scale, bins):
    """`_find` if no bin holds two values, else at most that: without branches, for the processor's vectors."""
    i = np.uintp(lut[np.uintp(np.int32(min(max((t - low) * scale, 0.0), bins)))])
    return i + np.uintp(values[i] < t)


@compiled
def _projected(vertices, c, s, P):
    """Fills P (V, 4) with Y, Z, I, T of vertices turned by an angle of cosine c and sine s.

    Returns how many are not ahead; theirs mean nothing.
    """
    given, P, beside = vertices.reshape(-1), P.reshape(-1), 0
    for i in range(len(vertices)):
        east, north, z = given[np.uintp(3 * i)], given[np.uintp(3 * i + 1)], given[np.uintp(3 * i + 2)]
        x = c * east + s * north
        y = c * north - s * east
        ahead = (x > AXIS) & (x * STEEP > abs(y)) & (x * STEEP > abs(z))
        beside += not ahead
        inverse = 1 / (x if ahead else 1.0)
        right, up = y * inverse, z * inverse
        P[np.uintp(4 * i)] = right
        P[np.uintp(4 * i + 1)] = up
        P[np.uintp(4 * i + 2)] = inverse
        P[np.uintp(4 * i + 3)] = up / np.sqrt(1 + right * right)
    return beside


@compiled
def _keys(P, columns, rows):
    """(V,): column << 2 * _BITS | lower row << _BITS | upper row of vertices P (V * 4), in tables of columns and rows.

    The upper row may be too high, never too low.
    """
    count = len(P) // 4
    keys, bins = np.empty(count, np.int64), np.empty(2 * count, np.int32)
    line, lut_c, low_c, scale_c, bins_c = columns.values, columns.lut, columns.low, columns.scale, columns.bins
    row, lut_r, low_r, scale_r, bins_r = rows.values, rows.lut, rows.low, rows.scale, rows.bins
    # an arc of a great circle of azimuth width D rises at most by 1 / cos(D / 2) over its higher end
    for i in range(count):
        t = P[np.uintp(4 * i + 3)]
        down = t + min(t, 0.0) * _SAG - ROUNDING
        bins[np.uintp(2 * i)] = np.int32(min(max((P[np.uintp(4 * i)] - low_c) * scale_c, 0.0), bins_c))
        bins[np.uintp(2 * i + 1)] = np.int32(min(max((down - low_r) * scale_r, 0.0), bins_r))
    last = np.uintp(len(row) - 1)
    for i in range(count):
        y, t = P[np.uintp(4 * i)], P[np.uintp(4 * i + 3)]
        up, down = t + max(t, 0.0) * _SAG + ROUNDING, t + min(t, 0.0) * _SAG - ROUNDING
        column = np.uintp(lut_c[np.uintp(bins[np.uintp(2 * i)])])
        lower = np.uintp(lut_r[np.uintp(bins[np.uintp(2 * i + 1)])])
        column, lower = column + np.uintp(line[column] < y), lower + np.uintp(row[lower] < down)
        upper = lower + np.uintp(row[lower] < up)
        upper = last if row[upper] < up else upper
        keys[i] = np.int64(column) << 2 * _BITS | np.int64(lower) << _BITS | np.int64(upper)
    if columns.single and rows.single:
        return keys
    for i in range(count):
        t = P[4 * i + 3]
        up, down = t + max(t, 0.0) * _SAG + ROUNDING, t + min(t, 0.0) * _SAG - ROUNDING
        column, lower, upper = _find(P[4 * i], columns), _find(down, rows), _find(up, rows)
        keys[i] = np.int64(column) << 2 * _BITS | np.int64(lower) << _BITS | np.int64(upper)
    return keys


@compiled
def _reaching(faces, keys, columns):
    """The faces that cross a column and may reach a row, ascending; none is left out that does."""
    count = len(columns.values) - 1
    widest = 0.0
    for k in range(count - 1):
        widest = max(widest, columns.values[k + 1] - columns.values[k])
    # so many columns apart, or beyond the first or last, may be too wide to be dropped by row
    narrow = min(int(_NARROW / widest) - 1, count) if widest > 0 else 0
    corners = faces.reshape(-1)
    crossing, n = np.empty(len(faces) + 1, np.int32), np.uintp(0)
    for f in range(len(faces)):
        a = keys[np.uintp(corners[np.uintp(3 * f)])]
        b = keys[np.uintp(corners[np.uintp(3 * f + 1)])]
        d = keys[np.uintp(corners[np.uintp(3 * f + 2)])]
        crossing[n] = f
        n += np.uintp((a ^ b | b ^ d) >> 2 * _BITS != 0)
    reaching, kept = crossing, np.uintp(0)
    for m in range(n):
        f = 3 * np.int64(crossing[m])
        a = keys[np.uintp(corners[np.uintp(f)])]
        b = keys[np.uintp(corners[np.uintp(f + 1)])]
        d = keys[np.uintp(corners[np.uintp(f + 2)])]
        first, last = min(a, b, d) >> 2 * _BITS, max(a, b, d) >> 2 * _BITS
        lower = min(a >> _BITS & _MASK, b >> _BITS & _MASK, d >> _BITS & _MASK)
        upper = max(a & _MASK, b & _MASK, d & _MASK)
        reaching[kept] = crossing[m]
        kept += np.uintp((lower < upper) | (last - first >= narrow) | (first == 0) | (last == count))
    return reaching[:kept]


@compiled
def _picked(wanted):
    """The numbers of those wanted."""
    picked = np.empty(len(wanted) + 1, np.int32)
    n = np.uintp(0)
    for i in range(len(wanted)):
        picked[n] = i
        n += np.uintp(wanted[i])
    return picked[:n]


@compiled
def raster(vertices, faces, culled, center, column_tan, column_cos, row_tan, column_index, row_index, inverse_x, face):
    """Casts columns of tan, cos(azimuth - center), sorted, within +-46 deg, and rows of tan(elevation), sorted.

    Writes 1/x in the frame that looks along `center`, and the face, at [column_index, row_index] of the two grids
    wherever a hit is nearer than what they hold. culled (F,): faces of closed meshes, which may be left out where
    they turn their backs; empty: none.
    """
    c, s = np.cos(center), np.sin(center)
    # what is read together is kept together
    P = np.empty((len(vertices), 4))
    beside, flat = _projected(vertices, c, s, P), P.reshape(-1)
    columns, rows = _table(column_tan), _table(row_tan)
    keys = _keys(flat, columns, rows)
    ahead = _ahead(vertices, c, s) if beside else np.empty(0, np.bool_)
    kept = _reaching(faces, keys, columns)
    if len(culled) and not (beside and _may_surround(faces, culled, ahead)):
        kept = _front(faces, culled, flat, kept)
    lines = np.empty(2 * len(column_tan))
    lines[::2], lines[1::2] = column_tan, column_cos
    pairs = np.empty(8 * (_BLOCK + len(column_tan)), np.int32)
    n = 0
    for f in kept:
        a, b, d = np.int64(faces[f, 0]), np.int64(faces[f, 1]), np.int64(faces[f, 2])
        if beside and not (ahead[a] and ahead[b] and ahead[d]):
            continue
        # sorted from right to left, by column and vertex
        a, b, d = a | keys[a] >> 2 * _BITS << 32, b | keys[b] >> 2 * _BITS << 32, d | keys[d] >> 2 * _BITS << 32
        first, last = min(a, b, d), max(a, b, d)
        middle = a ^ b ^ d ^ first ^ last
        turn = middle >> 32
        a, b, d = first & _LOW, middle & _LOW, last & _LOW
        for k in range(first >> 32, last >> 32):
            pairs[np.uintp(n)], pairs[np.uintp(n + 1)] = a, d
            pairs[np.uintp(n + 2)], pairs[np.uintp(n + 3)] = a if k < turn else b, b if k < turn else d
            pairs[np.uintp(n + 4)], pairs[np.uintp(n + 5)] = k, f
            n += 8
        if n >= 8 * _BLOCK:
            _fill(pairs[:n], flat, lines, rows, column_index, row_index, inverse_x, face)
            n = 0
    _fill(pairs[:n], flat, lines, rows, column_index, row_index, inverse_x, face)
    if beside:
        _raster_beside(
            vertices, faces, c, s, ahead, P, keys, column_tan, column_cos, rows, column_index, row_index,
            inverse_x, face,
        )  # fmt: skip


@compiled
def _fill(pairs, P, lines, rows, column_index, row_index, inverse_x, face):
    """Casts the beams between the crossings of triangles with columns.

    pairs (n * 8): of each, the ends of either edge that crosses the column, a, d and p, q, the column and the face;
    P (V * 4); lines (C * 2): tan and cos of the columns.
    """
    count = len(pairs) // 8
    ends, start = np.empty(4 * count), np.empty(count, np.int32)
    for m in range(count):
        a, d = 4 * np.int64(pairs[np.uintp(8 * m)]), 4 * np.int64(pairs[np.uintp(8 * m + 1)])
        p, q = 4 * np.int64(pairs[np.uintp(8 * m + 2)]), 4 * np.int64(pairs[np.uintp(8 * m + 3)])
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
    values, lut, low, scale, bins = rows.values, rows.lut, rows.low, rows.scale, rows.bins
    for m in range(count):
        lower = min(ends[np.uintp(4 * m)], ends[np.uintp(4 * m + 2)])
        start[m] = np.int32(_find_single(lower, values, lut, low, scale, bins))
    if not rows.single:
        for m in range(count):
            start[m] = np.int32(_find(min(ends[4 * m], ends[4 * m + 2]), rows))
    met = np.empty(count, np.bool_)
    for m in range(count):
        met[m] = values[np.uintp(start[m])] < max(ends[np.uintp(4 * m)], ends[np.uintp(4 * m + 2)])
    for m in _picked(met):
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
    """(V,) bool: which vertices are projected by `_projected`."""
    ahead = np.empty(len(vertices), np.bool_)
    for i in range(len(vertices)):
        x = c * vertices[i, 0] + s * vertices[i, 1]
        y = c * vertices[i, 1] - s * vertices[i, 0]
        ahead[i] = (x > AXIS) & (x * STEEP > abs(y)) & (x * STEEP > abs(vertices[i, 2]))
    return ahead


@compiled
def _may_surround(faces, culled, ahead):
    """Whether a closed mesh may hold the sensor: one that does has vertices behind any plane through it."""
    for f in range(len(faces)):
        if culled[f] and not (ahead[faces[f, 0]] and ahead[faces[f, 1]] and ahead[faces[f, 2]]):
            return True
    return False


@compiled
def _front(faces, culled, P, kept):
    """Those of `kept` that are not culled, or not for certain seen from behind. P (V * 4)."""
    front, corners = np.empty(len(kept), np.bool_), faces.reshape(-1)
    for m in range(len(kept)):
        f = 3 * np.int64(kept[m])
        a, b = 4 * np.int64(corners[np.uintp(f)]), 4 * np.int64(corners[np.uintp(f + 1)])
        d = 4 * np.int64(corners[np.uintp(f + 2)])
        y, z = P[np.uintp(a)], P[np.uintp(a + 1)]
        # counter-clockwise in Y to the left, Z up, is clockwise as the sensor sees it; edge-on ones stay
        one = (P[np.uintp(b)] - y) * (P[np.uintp(d + 1)] - z)
        other = (P[np.uintp(d)] - y) * (P[np.uintp(b + 1)] - z)
        front[m] = one - other <= _EDGE_ON * (abs(one) + abs(other))
    for m in range(len(kept)):
        front[m] |= not culled[kept[m]]
    picked = _picked(front)
    for m in range(len(picked)):
        picked[m] = kept[picked[m]]
    return picked


@compiled
def _raster_beside(
    vertices, faces, c, s, ahead, P, keys, column_tan, column_cos, table, column_index, row_index, inverse_x, face
):  # fmt: skip
    """The part of `raster` for triangles with a vertex that is not `ahead`: slower, right for any triangle.

    Crossings of edges between vertices ahead are computed as in `raster`, so the two fit without holes.
    """
    row_tan = table.values
    columns, rows = len(column_tan), len(row_tan) - 1
    x, y, z = np.empty(3), np.empty(3), np.empty(3)
    left = np.empty(3, np.bool_)
    end_t, end_i, end_x, end_z = np.empty(2), np.empty(2), np.empty(2), np.empty(2)
    for f in range(len(faces)):
        if ahead[faces[f, 0]] and ahead[faces[f, 1]] and ahead[faces[f, 2]]:
            continue
        first = last = 0
        for j in range(3):
            i = faces[f, j]
            x[j] = c * vertices[i, 0] + s * vertices[i, 1]
            y[j] = c * vertices[i, 1] - s * vertices[i, 0]
            z[j] = vertices[i, 2]
            first += ((keys[i] >> 2 * _BITS) > 0) if ahead[i] else (y[j] - column_tan[0] * x[j] > 0)
            last += ((keys[i] >> 2 * _BITS) > columns - 1) if ahead[i] else (y[j] - column_tan[columns - 1] * x[j] > 0)
        # a vertex's side changes at most once over the columns
        if first == last and (first == 0 or first == 3) or max(x[0], x[1], x[2]) <= 0:
            continue
        for k in range(columns):
            total = 0
            for j in range(3):
                i = faces[f, j]
                left[j] = (k < (keys[i] >> 2 * _BITS)) if ahead[i] else (y[j] - column_tan[k] * x[j] > 0)
                total += left[j]
            if total == 0 or total == 3:
                continue
            alone = 0
            for j in range(3):
                if left[j] == (total == 1):
                    alone = j
            for e in range(2):
                p = alone
                q = (alone + 1 + e) % 3
                if left[p]:
                    p, q = q, p
                a, b = faces[f, p], faces[f, q]
                if ahead[a] and ahead[b]:
                    u = (column_tan[k] - P[a, 0]) / (P[b, 0] - P[a, 0])
                    end_i[e] = P[a, 2] + u * (P[b, 2] - P[a, 2])
                    end_t[e] = (P[a, 1] + u * (P[b, 1] - P[a, 1])) * column_cos[k]
                    end_x[e] = 1 / end_i[e]
                    end_z[e] = (P[a, 1] + u * (P[b, 1] - P[a, 1])) * end_x[e]
                else:
                    # of the sign that the side was found by, or an edge in the column's plane might cross nowhere
                    before = (P[a, 0] - column_tan[k]) * x[p] if ahead[a] else y[p] - column_tan[k] * x[p]
                    after = (P[b, 0] - column_tan[k]) * x[q] if ahead[b] else y[q] - column_tan[k] * x[q]
                    u = before / (before - after)
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
            # the segment passes over or under the sensor, so it covers the rows up to the zenith or the nadir
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
