"""The compiled loops of `raycast.cast_ray_list`: rays of any direction against triangles that may move.

All kernels release the GIL. Numba does not invalidate its cache of this module when `raycast_kernels` changes: delete
__pycache__ then.
"""

import numpy as np

from lidarpose.lidar.raycast_kernels import AXIS, ROUNDING, STEEP, compiled

# cells per ray, so that most cells are empty and most triangles need no test; maximum number of cells along a side
_CELLS_A_RAY, _MOST_CELLS = 4.0, 256.0
# tolerance for rounding at the edges of a side
_SLACK = 1.0 + 1e-6


@compiled
def ray_list(vertices, faces, directions, shift, time):
    """Range (N,) float32 and face (N,) of unit directions (N, 3): rays are binned on the six sides of a cube.

    shift (V, 3): displacement of the vertices from time 0 to 1; time (N,) of the rays; both None if nothing moves.
    """
    count = len(directions)
    best_depth = np.full(count, np.inf)
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
    dw, dp, dq = np.zeros(3), np.zeros(3), np.zeros(3)
    cells = np.empty(4 * len(vertices), np.int32)
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
        grid = int(min(max(np.sqrt(_CELLS_A_RAY * n), 1.0), _MOST_CELLS))
        scale_u, scale_v = grid / max(u1 - u0, 1e-9), grid / max(v1 - v0, 1e-9)
        start = np.zeros(grid * grid + 1, np.int64)
        for i in range(count):
            if cube[i] == side:
                a, b = min(int((u[i] - u0) * scale_u), grid - 1), min(int((v[i] - v0) * scale_v), grid - 1)
                cell[i] = a * grid + b
                start[cell[i] + 1] += 1
        for b in range(grid * grid):
            start[b + 1] += start[b]
        order, next_slot = np.empty(n, np.int64), start.copy()
        for i in range(count):
            if cube[i] == side:
                order[next_slot[cell[i]]] = i
                next_slot[cell[i]] += 1
        _cells(vertices, shift, axis, sign, u0, v0, scale_u, scale_v, grid, cells)
        for f in range(len(faces)):
            i0, i1, i2 = 4 * np.int64(faces[f, 0]), 4 * np.int64(faces[f, 1]), 4 * np.int64(faces[f, 2])
            # the cells that the triangle may cover: from a0, b0 to a1, b1
            a0 = max(min(cells[np.uintp(i0)], cells[np.uintp(i1)], cells[np.uintp(i2)]), 0)
            b0 = max(min(cells[np.uintp(i0 + 1)], cells[np.uintp(i1 + 1)], cells[np.uintp(i2 + 1)]), 0)
            a1 = min(max(cells[np.uintp(i0 + 2)], cells[np.uintp(i1 + 2)], cells[np.uintp(i2 + 2)]), grid - 1)
            b1 = min(max(cells[np.uintp(i0 + 3)], cells[np.uintp(i1 + 3)], cells[np.uintp(i2 + 3)]), grid - 1)
            ray_count = 0
            if b0 <= b1:
                for a in range(a0, a1 + 1):
                    ray_count += start[a * grid + b1 + 1] - start[a * grid + b0]
            if not ray_count:
                continue
            max_depth = -np.inf
            low_p, high_p, low_q, high_q = np.inf, -np.inf, np.inf, -np.inf
            for j in range(3):
                i = faces[f, j]
                w[j] = sign * vertices[i, axis]
                p[j], q[j] = vertices[i, across], vertices[i, along]
                max_depth = max(max_depth, w[j])
                low_p, high_p = min(low_p, p[j]), max(high_p, p[j])
                low_q, high_q = min(low_q, q[j]), max(high_q, q[j])
                if shift is not None:
                    dw[j] = sign * shift[i, axis]
                    dp[j], dq[j] = shift[i, across], shift[i, along]
                    max_depth = max(max_depth, w[j] + dw[j])
                    low_p, high_p = min(low_p, p[j] + dp[j]), max(high_p, p[j] + dp[j])
                    low_q, high_q = min(low_q, q[j] + dq[j]), max(high_q, q[j] + dq[j])
            # rays of this side go at most as far sideways as ahead: a triangle farther to the side cannot be hit
            least_aside = max(low_p, -high_p, low_q, -high_q)
            if max_depth <= 0 or max_depth * _SLACK < least_aside:
                continue
            w0, w1, w2 = w[0], w[1], w[2]
            p0, p1, p2 = p[0], p[1], p[2]
            q0, q1, q2 = q[0], q[1], q[2]
            for a in range(a0, a1 + 1):
                for m in range(start[a * grid + b0], start[a * grid + b1 + 1]):
                    i = order[m]
                    if shift is not None:
                        t = time[i]
                        w0, w1, w2 = w[0] + t * dw[0], w[1] + t * dw[1], w[2] + t * dw[2]
                        p0, p1, p2 = p[0] + t * dp[0], p[1] + t * dp[1], p[2] + t * dp[2]
                        q0, q1, q2 = q[0] + t * dq[0], q[1] + t * dq[1], q[2] + t * dq[2]
                    # the corners in the ray's coordinates (Woop, Benthin and Wald 2013): equal for all triangles that
                    # share a corner. Reversing an edge only changes the sign of its edge function, so no ray slips
                    # between triangles
                    x0, x1, x2 = p0 - u[i] * w0, p1 - u[i] * w1, p2 - u[i] * w2
                    y0, y1, y2 = q0 - v[i] * w0, q1 - v[i] * w1, q2 - v[i] * w2
                    e0, e1, e2 = x2 * y1 - y2 * x1, x0 * y2 - y0 * x2, x1 * y0 - y1 * x0
                    if (e0 >= 0 and e1 >= 0 and e2 >= 0) or (e0 <= 0 and e1 <= 0 and e2 <= 0):
                        total = e0 + e1 + e2
                        if total != 0:
                            depth = (e0 * w0 + e1 * w1 + e2 * w2) / total
                            if AXIS < depth < best_depth[i]:
                                best_depth[i] = depth
                                face[i] = f
    for i in range(count):
        best_depth[i] /= abs(directions[i, cube[i] // 2])
    return best_depth.astype(np.float32), face


@compiled
def _cells(vertices, shift, axis, sign, u0, v0, scale_u, scale_v, grid, cells):
    """Fills cells (V * 4) with the range of cells of a cube side in which a vertex is from time 0 to 1: first and last
    along u and v, in the order u, v, u, v; -1 or `grid` beyond the side's rays, all cells if it is not ahead."""
    across, along = (axis + 1) % 3, (axis + 2) % 3
    for i in range(len(vertices)):
        w, p, q = sign * vertices[i, axis], vertices[i, across], vertices[i, along]
        is_ahead = (w > AXIS) & (w * STEEP > abs(p)) & (w * STEEP > abs(q))
        inverse = 1 / (w if is_ahead else 1.0)
        low_u, low_v = p * inverse, q * inverse
        high_u, high_v = low_u, low_v
        if shift is not None:
            # a straight path that is entirely ahead is also straight on the cube's side, so its ends bound it
            w, p, q = w + sign * shift[i, axis], p + shift[i, across], q + shift[i, along]
            is_ahead_later = (w > AXIS) & (w * STEEP > abs(p)) & (w * STEEP > abs(q))
            inverse = 1 / (w if is_ahead_later else 1.0)
            low_u, high_u = min(low_u, p * inverse), max(high_u, p * inverse)
            low_v, high_v = min(low_v, q * inverse), max(high_v, q * inverse)
            is_ahead &= is_ahead_later
        low_u, high_u, low_v, high_v = low_u - ROUNDING, high_u + ROUNDING, low_v - ROUNDING, high_v + ROUNDING
        cells[4 * i] = np.int32(min(max((low_u - u0) * scale_u, -1.0), float(grid))) if is_ahead else -1
        cells[4 * i + 1] = np.int32(min(max((low_v - v0) * scale_v, -1.0), float(grid))) if is_ahead else -1
        cells[4 * i + 2] = np.int32(min(max((high_u - u0) * scale_u, -1.0), float(grid))) if is_ahead else grid
        cells[4 * i + 3] = np.int32(min(max((high_v - v0) * scale_v, -1.0), float(grid))) if is_ahead else grid
