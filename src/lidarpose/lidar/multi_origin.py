"""Casts of sensors whose beams leave from several origins, one above the other: each head is cast alone."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from lidarpose.lidar.hits import Hits
from lidarpose.lidar.raycast_input import as_points
from lidarpose.lidar.sensor import Sensor


def scan_heads(
    scan: Callable[[np.ndarray, Sensor, np.ndarray], Hits],
    vertices: np.ndarray,
    sensor: Sensor,
    window_vertices: np.ndarray | None,
) -> Hits:
    """The hits of all heads of a sensor (`Sensor.heads`), ordered by column, then ring, in one window.

    scan(vertices, sensor, window_vertices) casts one head as `raycast.scan` does.
    """
    vertices = as_points("vertices", vertices)
    window_vertices = vertices if window_vertices is None else as_points("window_vertices", window_vertices)
    parts, numbers = [], []
    for height, head, rings in sensor.heads:
        down = np.array([0, 0, height])
        hits = scan(vertices - down, head, window_vertices - down)
        parts.append(replace(hits, points=hits.points + np.float32([0, 0, height])))
        numbers.append(rings)
    # columns of all heads counted from the first one of any
    turn, base = sensor.columns, parts[0].column0
    starts = [(part.column0 - base + turn // 2) % turn - turn // 2 for part in parts]
    first = min(starts)
    column = np.concatenate([p.column + np.int32(start - first) for p, start in zip(parts, starts, strict=True)])
    ring = np.concatenate([rings[p.ring].astype(np.int32) for p, rings in zip(parts, numbers, strict=True)])
    order = np.lexsort([ring, column])
    ends = [start - first + part.columns for part, start in zip(parts, starts, strict=True)]
    inside = [rings[p.row0 : p.row0 + p.rows] for p, rings in zip(parts, numbers, strict=True) if p.rows]
    low, high = (min(r[0] for r in inside), max(r[-1] for r in inside)) if inside else (0, -1)
    return replace(
        parts[0],
        points=np.concatenate([p.points for p in parts])[order],
        face=np.concatenate([p.face for p in parts])[order],
        column=column[order],
        ring=ring[order],
        columns=min(max(ends), turn),
        rows=int(high - low + 1),
        column0=(base + first) % turn,
        row0=int(low),
    )
