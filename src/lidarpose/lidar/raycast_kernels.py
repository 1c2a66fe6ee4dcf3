"""The compiled loops of `raycast`, which explains the algorithm and the letters. No Python object crosses them: they
run outside the interpreter's lock and may be called from many threads.
"""

import numpy as np

from lidarpose.errors import MissingExtra

try:
    from numba import njit
except ImportError as error:  # pragma: no cover - numba is an optional extra
    raise MissingExtra("casting rays", "synth") from error

# vertices with |y/x| or |z/x| above this are not projected: beyond it float64 loses more than 14 - 2 digits
_STEEP = 100.0
# triangles wider than this in Y are not dropped by row; narrower ones by a bound that follows from it, see `raster`
_NARROW = 0.04
_SAG = 1 / np.cos(_NARROW / 2) - 1
# slack of the row bounds against rounding; crossings are good to 1e-13
_ROUNDING = 1e-9
_TABLE_BINS = 8192
# what is less than this ahead of the sensor's axis, m, counts as behind it, and what is nearer is not hit
_AXIS = 1e-9
_LOW = 0xFFFFFFFF

_compiled = njit(nogil=True, cache=True, error_model="numpy")


@_compiled
def _table(values):
    """Sorted values with an inf behind them, and their look-up table: no value before `lut[bin(t)]` reaches t.

    bin() is monotone in floating point, so a value in an earlier bin than t's is certainly < t. `single`: no bin
    holds two values, so one comparison finishes the search.
    """
    n = len(values)
    span = values[n - 1] - values[0]
    gap = span
    for i in range(n - 1):
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
    return padded, lut, scale, float(bins), single


@_compiled
def _find(t, padded, lut, scale, bins, single):
    """The number of values below t, which may be inf."""
    i = np.uintp(lut[np.uintp(min(max((t - padded[0]) * scale, 0.0), bins))])
    if single:
        return i + np.uintp(padded[i] < t)
    while padded[i] < t:
        i += np.uintp(1)
    return i


@_compiled
def _find_all(t, padded, lut, scale, bins, single, found):
    """found[i] = the number of values below t[i]: `_find` without branches, for the processor's vectors."""
    low = padded[0]
    for i in range(len(t)):
        first = np.uintp(lut[np.uintp(min(max((t[i] - low) * scale, 0.0), bins))])
        found[i] = np.int32(first) + np.int32(padded[first] < t[i])
    if not single:
        for i in range(len(t)):
            while padded[found[i]] < t[i]:
                found[i] += 1


@_compiled
def raster(vertices, faces, center, column_tan, column_cos, row_tan, column_index, row_index, inverse_x, face):
    """Casts columns of tan, cos(azimuth - center), sorted, within +-46 deg, and rows of tan(elevation), sorted.

    Writes 1/x in the frame that looks along `center`, and the face, at [column_index, row_index] of the two grids
    wherever a hit is nearer than what they hold.
    """
    count = len(vertices)
    c, s = np.cos(center), np.sin(center)
    # what is read together is kept together: Y, Z, I of a vertex; its column, lower and upper row
    P, B = np.empty((count, 4)), np.empty((count, 4), np.int32)
    up, down, right = np.empty(count), np.empty(count), np.empty(count)
    ahead = np.empty(count, np.bool_)
    beside = 0
    for i in range(count):
        x = c * vertices[i, 0] + s * vertices[i, 1]
        y = c * vertices[i, 1] - s * vertices[i, 0]
        z = vertices[i, 2]
        projected = (x > _AXIS) & (x * _STEEP > abs(y)) & (x * _STEEP > abs(z))
        beside += not projected
        ahead[i] = projected
        inverse = 1 / (x if projected else 1.0)
        right[i] = y * inverse
        P[i, 0] = y * inverse
        P[i, 1] = z * inverse
        P[i, 2] = inverse
        # an arc of a great circle of azimuth width D rises at most by 1 / cos(D / 2) over its higher end
        t = z * inverse / np.sqrt(1 + right[i] * right[i])
        up[i] = t + max(t, 0.0) * _SAG + _ROUNDING
        down[i] = t + min(t, 0.0) * _SAG - _ROUNDING
    padded_c, lut_c, scale_c, bins_c, single_c = _table(column_tan)
    padded_r, lut_r, scale_r, bins_r, single_r = _table(row_tan)
    _find_all(right, padded_c, lut_c, scale_c, bins_c, single_c, B[:, 0])
    _find_all(down, padded_r, lut_r, scale_r, bins_r, single_r, B[:, 1])
    _find_all(up, padded_r, lut_r, scale_r, bins_r, single_r, B[:, 2])

    kept = np.empty(len(faces) + 1, np.int32)
    n = np.uintp(0)
    for f in range(len(faces)):
        a, b, d = np.uintp(faces[f, 0]), np.uintp(faces[f, 1]), np.uintp(faces[f, 2])
        crosses = (B[a, 0] != B[b, 0]) | (B[b, 0] != B[d, 0])
        reaches = min(B[a, 1], B[b, 1], B[d, 1]) < max(B[a, 2], B[b, 2], B[d, 2])
        wide = max(P[a, 0], P[b, 0], P[d, 0]) - min(P[a, 0], P[b, 0], P[d, 0]) > _NARROW
        kept[n] = f
        n += np.uintp(crosses & (reaches | wide))
    for m in range(n):
        f = kept[m]
        a, b, d = np.int64(faces[f, 0]), np.int64(faces[f, 1]), np.int64(faces[f, 2])
        if beside and not (ahead[a] and ahead[b] and ahead[d]):
            continue
        # sorted from right to left, by keys of column and vertex
        a, b, d = a | np.int64(B[a, 0]) << 32, b | np.int64(B[b, 0]) << 32, d | np.int64(B[d, 0]) << 32
        first, last = min(a, b, d), max(a, b, d)
        middle = a ^ b ^ d ^ first ^ last
        turn = np.uintp(middle >> 32)
        a, b, d = np.uintp(first & _LOW), np.uintp(middle & _LOW), np.uintp(last & _LOW)
        for k in range(np.uintp(first >> 32), np.uintp(last >> 32)):
            line = column_tan[k]
            u = (line - P[a, 0]) / (P[d, 0] - P[a, 0])
            t0, i0 = (P[a, 1] + u * (P[d, 1] - P[a, 1])) * column_cos[k], P[a, 2] + u * (P[d, 2] - P[a, 2])
            p, q = a if k < turn else b, b if k < turn else d
            u = (line - P[p, 0]) / (P[q, 0] - P[p, 0])
            t1, i1 = (P[p, 1] + u * (P[q, 1] - P[p, 1])) * column_cos[k], P[p, 2] + u * (P[q, 2] - P[p, 2])
            end = max(t0, t1)
            r = _find(min(t0, t1), padded_r, lut_r, scale_r, bins_r, single_r)
            while padded_r[r] < end:
                value = i0 + (padded_r[r] - t0) / (t1 - t0) * (i1 - i0)
                column, row = np.uintp(column_index[k]), np.uintp(row_index[r])
                if value > inverse_x[column, row]:
                    inverse_x[column, row] = value
                    face[column, row] = f
                r += np.uintp(1)
    if beside:
        _raster_beside(
            vertices, faces, c, s, ahead, P, B, column_tan, column_cos, padded_r,
            lut_r, scale_r, bins_r, single_r, column_index, row_index, inverse_x, face,
        )  # fmt: skip


@_compiled
def _raster_beside(
    vertices, faces, c, s, ahead, P, B, column_tan, column_cos, row_tan,
    lut_r, scale_r, bins_r, single_r, column_index, row_index, inverse_x, face,
):  # fmt: skip
    """The part of `raster` for triangles with a vertex that is not `ahead`: slower, right for any triangle.

    Crossings of edges between vertices ahead are computed as in `raster`, so the two fit without holes.
    """
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
            first += (B[i, 0] > 0) if ahead[i] else (y[j] - column_tan[0] * x[j] > 0)
            last += (B[i, 0] > columns - 1) if ahead[i] else (y[j] - column_tan[columns - 1] * x[j] > 0)
        # a vertex's side changes at most once over the columns
        if first == last and (first == 0 or first == 3) or max(x[0], x[1], x[2]) <= 0:
            continue
        for k in range(columns):
            total = 0
            for j in range(3):
                i = faces[f, j]
                left[j] = (k < B[i, 0]) if ahead[i] else (y[j] - column_tan[k] * x[j] > 0)
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
                    if end_x[e] > _AXIS:
                        end_i[e] = 1 / end_x[e]
                        end_t[e] = end_z[e] * end_i[e] * column_cos[k]
            if end_x[0] <= _AXIS and end_x[1] <= _AXIS:
                continue
            near, far = (0, 1) if end_x[0] > _AXIS else (1, 0)
            r = np.int64(_find(end_t[near], row_tan, lut_r, scale_r, bins_r, single_r))
            if end_x[far] > _AXIS:
                stop = np.int64(_find(end_t[far], row_tan, lut_r, scale_r, bins_r, single_r))
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
                if value > inverse_x[column_index[k], row_index[r]] and value * _AXIS < 1 + abs(row_tan[r]):
                    inverse_x[column_index[k], row_index[r]] = value
                    face[column_index[k], row_index[r]] = f
                r += 1


# without NaN in them, minima and maxima may be taken in any order
@njit(nogil=True, cache=True, error_model="numpy", fastmath={"nnan", "nsz"})
def bounds(vertices):
    """Mean azimuth, and the vertices' least and greatest azimuth relative to it and elevation, rad."""
    east = north = 0.0
    for i in range(len(vertices)):
        east += vertices[i, 0]
        north += vertices[i, 1]
    center = np.arctan2(north, east)
    c, s = np.cos(center), np.sin(center)
    left, right, low, high, ahead = np.inf, -np.inf, np.inf, -np.inf, np.inf
    for i in range(len(vertices)):
        x = c * vertices[i, 0] + s * vertices[i, 1]
        y = c * vertices[i, 1] - s * vertices[i, 0]
        ahead = min(ahead, x * _STEEP - abs(y), x - _AXIS)
        inverse = 1 / (x if x > _AXIS else 1.0)
        # squared, with its sign
        slope = vertices[i, 2] * abs(vertices[i, 2]) / (x * x + y * y if x > _AXIS else 1.0)
        left, right = min(left, y * inverse), max(right, y * inverse)
        low, high = min(low, slope), max(high, slope)
    if ahead > 0:
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


@_compiled
def collect(inverse_x, face, scale, first, step, shift, row_tan, range_min, range_max):
    """The hits of a window, packed: points (n, 3), face, column and row (n,)."""
    columns, rows = inverse_x.shape
    n = 0
    for k in range(columns):
        for r in range(rows):
            n += inverse_x[k, r] > 0
    points = np.empty((n, 3), np.float32)
    hit, column, row = np.empty(n, np.int32), np.empty(n, np.int32), np.empty(n, np.int32)
    lift = np.sqrt(1 + row_tan * row_tan)
    per_ring = scale.shape[1] > 1
    n = 0
    for k in range(columns):
        azimuth = first + k * step + (0.0 if per_ring else shift[0])
        c, s = np.cos(azimuth), np.sin(azimuth)
        for r in range(rows):
            if inverse_x[k, r] <= 0:
                continue
            if per_ring:
                c, s = np.cos(azimuth + shift[r]), np.sin(azimuth + shift[r])
            horizontal = scale[k, r if per_ring else 0] / inverse_x[k, r]
            distance = horizontal * lift[r]
            if distance < range_min or distance > range_max:
                continue
            points[n, 0] = horizontal * c
            points[n, 1] = horizontal * s
            points[n, 2] = horizontal * row_tan[r]
            hit[n] = face[k, r]
            column[n] = k
            row[n] = r
            n += 1
    return points[:n], hit[:n], column[:n], row[:n]


@_compiled
def ray_list(vertices, faces, directions):
    """Range (N,) float32 and face (N,) of unit directions (N, 3): rays are binned on the six sides of a cube."""
    count = len(directions)
    best = np.full(count, np.inf)
    face = np.full(count, -1, np.int32)
    cube = np.empty(count, np.int8)
    for i in range(count):
        axis = 0
        for j in range(1, 3):
            if abs(directions[i, j]) > abs(directions[i, axis]):
                axis = j
        cube[i] = 2 * axis + (directions[i, axis] < 0)
    u, v, cell = np.empty(count), np.empty(count), np.empty(count, np.int64)
    w, p, q = np.empty(3), np.empty(3), np.empty(3)
    for side in range(6):
        axis, sign = side // 2, 1.0 - 2.0 * (side % 2)
        across, along = (axis + 1) % 3, (axis + 2) % 3
        n = 0
        u0, u1, v0, v1 = np.inf, -np.inf, np.inf, -np.inf
        for i in range(count):
            if cube[i] == side:
                u[i] = directions[i, across] / (sign * directions[i, axis])
                v[i] = directions[i, along] / (sign * directions[i, axis])
                u0, u1, v0, v1 = min(u0, u[i]), max(u1, u[i]), min(v0, v[i]), max(v1, v[i])
                n += 1
        if n == 0:
            continue
        grid = int(min(max(np.sqrt(n / 2.0), 1.0), 256.0))
        scale_u, scale_v = grid / max(u1 - u0, 1e-9), grid / max(v1 - v0, 1e-9)
        start = np.zeros(grid * grid + 1, np.int64)
        for i in range(count):
            if cube[i] == side:
                a, b = min(int((u[i] - u0) * scale_u), grid - 1), min(int((v[i] - v0) * scale_v), grid - 1)
                cell[i] = a * grid + b
                start[cell[i] + 1] += 1
        for b in range(grid * grid):
            start[b + 1] += start[b]
        order, filled = np.empty(n, np.int64), start.copy()
        for i in range(count):
            if cube[i] == side:
                order[filled[cell[i]]] = i
                filled[cell[i]] += 1
        for f in range(len(faces)):
            ahead = True
            low_u, high_u, low_v, high_v = np.inf, -np.inf, np.inf, -np.inf
            for j in range(3):
                i = faces[f, j]
                w[j] = sign * vertices[i, axis]
                p[j], q[j] = vertices[i, across], vertices[i, along]
                ahead &= (w[j] > _AXIS) & (w[j] * _STEEP > abs(p[j])) & (w[j] * _STEEP > abs(q[j]))
                inverse = 1 / (w[j] if w[j] > _AXIS else 1.0)
                low_u, high_u = min(low_u, p[j] * inverse), max(high_u, p[j] * inverse)
                low_v, high_v = min(low_v, q[j] * inverse), max(high_v, q[j] * inverse)
            if max(w[0], w[1], w[2]) <= 0:
                continue
            if not ahead:
                low_u, high_u, low_v, high_v = u0, u1, v0, v1
            low_u, high_u, low_v, high_v = low_u - _ROUNDING, high_u + _ROUNDING, low_v - _ROUNDING, high_v + _ROUNDING
            if high_u < u0 or low_u > u1 or high_v < v0 or low_v > v1:
                continue
            a0 = int(min(max((low_u - u0) * scale_u, 0.0), grid - 1.0))
            a1 = int(min(max((high_u - u0) * scale_u, 0.0), grid - 1.0))
            b0 = int(min(max((low_v - v0) * scale_v, 0.0), grid - 1.0))
            b1 = int(min(max((high_v - v0) * scale_v, 0.0), grid - 1.0))
            for a in range(a0, a1 + 1):
                for m in range(start[a * grid + b0], start[a * grid + b1 + 1]):
                    i = order[m]
                    # the corners as seen along the ray (Woop, Benthin and Wald 2013): equal for all triangles of a
                    # corner, and an edge's function changes just its sign when the edge is turned, so no ray slips
                    # between triangles
                    x0, x1, x2 = p[0] - u[i] * w[0], p[1] - u[i] * w[1], p[2] - u[i] * w[2]
                    y0, y1, y2 = q[0] - v[i] * w[0], q[1] - v[i] * w[1], q[2] - v[i] * w[2]
                    e0, e1, e2 = x2 * y1 - y2 * x1, x0 * y2 - y0 * x2, x1 * y0 - y1 * x0
                    if (e0 >= 0 and e1 >= 0 and e2 >= 0) or (e0 <= 0 and e1 <= 0 and e2 <= 0):
                        total = e0 + e1 + e2
                        if total != 0:
                            depth = (e0 * w[0] + e1 * w[1] + e2 * w[2]) / total
                            if _AXIS < depth < best[i]:
                                best[i] = depth
                                face[i] = f
    for i in range(count):
        best[i] /= abs(directions[i, cube[i] // 2])
    return best.astype(np.float32), face
