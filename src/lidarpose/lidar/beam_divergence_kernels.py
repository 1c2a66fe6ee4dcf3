"""The compiled loops of `divergence`, which explains them. As in `raycast_scan`, remove the __pycache__ when
`raycast_kernels` has changed."""

import numpy as np

from lidarpose.lidar.raycast_kernels import compiled, raster
from lidarpose.lidar.raycast_scan import collect, sector_columns, window_of

# no beam beyond the zenith
_ZENITH = np.pi / 2 - 1e-6


@compiled
def strongest(distance, weights, order, pulse, farthest):
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
def merge_echoes(distance, face, weights, pulse, farthest):
    """Range (N,) float32 and face (N,) of beams of sub-beams (N, K)."""
    count, subs = distance.shape
    merged, merged_face = np.empty(count, np.float32), np.full(count, -1, np.int32)
    order = np.empty(subs, np.int64)
    for i in range(count):
        merged[i], k = strongest(distance[i], weights, order, pulse, farthest)
        if k >= 0:
            merged_face[i] = face[i, k]
    return merged, merged_face


@compiled
def scan_diverging(vertices, faces, culled, window_vertices, beams, margin, offsets, weights, pulse):
    """As `raycast_scan.scan_mesh`, with sub-beams at offsets (S,) in azimuth and elevation of weights (S, S)."""
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
                    vertices, faces, culled, center + offsets[a], tan[:count], cos[:count], row_tan[:n],
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
            range_, sub = strongest(distance, flat, order, pulse, beams.farthest)
            if sub >= 0:
                # as if the beam's axis had met it
                tangent = beams.tangents[row0 + r]
                merged[k, r] = scale[k] * np.sqrt(1 + tangent * tangent) / range_
                merged_face[k, r] = face[sub // subs, k, r * subs + sub % subs]
    return collect(merged, merged_face, scale, beams, column0, row0), window
