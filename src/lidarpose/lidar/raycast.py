"""Exact LiDAR returns of triangle meshes, by rasterizing triangles onto the columns of beams.

The sensor stands at the origin. A beam of azimuth a and elevation e points to (cos a cos e, sin a cos e, sin e).
A column is all beams of one azimuth: a half plane, which cuts a triangle in a segment, and the segment covers the
rows between the elevations of its ends. No tree is built: one body is seen by fewer beams than it has triangles.

How a sector of columns (at most a quarter turn) is cast:
    1. Vertices are turned so that the sector looks along +x and projected to Y = y/x, Z = z/x, I = 1/x. Lines stay
       lines and I is affine over a triangle, so interpolating I gives the exact hit.
    2. Columns are lines Y = tan(a); on a column, rows are T = tan(e) with T = Z cos(a). Finding the first column
       right of a vertex or the first row above a crossing is one table look-up.
    3. Triangles that cross no column or reach no row are dropped.
    4. Two edges of a triangle cross a column. A crossing is computed from the edge alone, from its right to its left
       end, so both triangles of an edge get the same number, rows are half-open intervals between crossings: a
       closed mesh has no holes and no beam is counted twice. The largest I wins.
Vertices beside or behind the sensor have no Y and Z: edges that end there are crossed in x, y, z instead.

Letters: V vertices, F faces, C columns, R rows of a window, A azimuths, E elevations, N rays, n hits.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np

from lidarpose.errors import InputError
from lidarpose.lidar.ray_pattern import RayPattern, Rays
from lidarpose.lidar.raycast_input import (
    as_angles,
    as_directions,
    as_faces,
    as_mesh,
    as_points,
    as_times,
    as_vertices,
    check_margin,
    read_only,
)
from lidarpose.lidar.raycast_kernels import raster, ray_list
from lidarpose.lidar.raycast_scan import BAD_FACES, BAD_VERTICES, SECTOR, Beams, bounds, scan_checked
from lidarpose.lidar.sensor import Sensor

_BEAMS: WeakKeyDictionary[Sensor, Beams] = WeakKeyDictionary()


@dataclass(frozen=True, kw_only=True)
class Hits:
    """What a sensor saw through a window, ordered by column, then ring.

    points (n, 3) float32 m in the sensor's frame; face (n,) int32; column (n,) int32 counted from the window's first,
    so it runs on over the +-pi seam; ring (n,) int32, the sensor's own number, 0 the lowest; columns, rows: the
    window's size; column0, row0: where it starts, `(column + column0) % sensor.columns` is the sensor's column.
    """

    points: np.ndarray
    face: np.ndarray
    column: np.ndarray
    ring: np.ndarray
    columns: int
    rows: int
    column0: int
    row0: int

    @classmethod
    def from_arrays(cls, packed: tuple[np.ndarray, ...], window: tuple[int, int, int, int]) -> "Hits":
        """From what compiled scans return: points, face, column, ring; column0, columns, row0, rows."""
        points, face, column, ring = packed
        column0, columns, row0, rows = window
        return cls(
            points=points, face=face, column=column, ring=ring, columns=columns, rows=rows, column0=column0, row0=row0
        )


def cast_rays(
    vertices: np.ndarray, faces: np.ndarray, azimuth: np.ndarray, elevation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The nearest hits of a grid of beams from the origin; faces count from both sides.

    vertices (V, 3) m, x forward, y left, z up; faces (F, 3) indices; azimuth (A,) and elevation (E,) rad in any
    order, |elevation| <= pi/2. Returns range (A, E) float32 m, inf where nothing is hit, and face (A, E) int32, -1
    where nothing is hit. Meshes may be open, degenerate, or surround the sensor. Raises InputError.
    """
    vertices, faces = as_mesh(vertices, faces)
    azimuth, elevation = as_angles("azimuth", azimuth), as_angles("elevation", elevation)
    if (np.abs(elevation) > np.pi / 2).any():
        raise InputError(
            f"elevation must be within +-pi/2 rad, got up to {np.abs(elevation).max():.4g}: are they degrees?"
        )
    inverse_x = np.zeros((len(azimuth), len(elevation)))
    face = np.full(inverse_x.shape, -1, np.int32)
    scale = np.empty(len(azimuth))
    if inverse_x.size:
        rows = np.argsort(elevation, kind="stable")
        table = np.tan(elevation[rows])
        turned = np.mod(azimuth, 2 * np.pi)
        columns = np.argsort(turned, kind="stable")
        for part in _sectors(turned[columns]):
            picked = columns[part]
            start = turned[picked[0]]
            ahead = np.mod(turned[picked] - start, 2 * np.pi)
            center = start + ahead[-1] / 2
            relative = ahead - ahead[-1] / 2
            scale[picked] = 1 / np.cos(relative)
            raster(
                vertices, faces, center, np.tan(relative), np.cos(relative), table,
                picked, rows, inverse_x, face,
            )  # fmt: skip
    # x / (cos a cos e) of x in the sectors' frames
    with np.errstate(divide="ignore"):
        distance = scale[:, None] * (1 / np.cos(elevation)) / inverse_x
    return distance.astype(np.float32), face


def scan(
    vertices: np.ndarray,
    faces: np.ndarray,
    sensor: Sensor,
    *,
    window_vertices: np.ndarray | None = None,
    margin: float = 0.0,
) -> Hits:
    """What the sensor sees inside the smallest window of beams that holds a body. Paper: Eq. 3 (no margin).

    A beam whose nearest hit is outside the sensor's range limits returns nothing. A sensor inside a mesh sees it from
    inside. Faces count from both sides. Nothing is random.

    The window holds vertices, not edges: as seen from the sensor, the upper edge of a near wall rises above its two
    ends. A coarse mesh needs a `margin`, or a finer one as `window_vertices`. A body around the sensor gets the whole
    turn.

    Args:
        vertices: (V, 3) m in the sensor's frame: the body, and whatever may hide it or stand behind it.
        faces: (F, 3) indices.
        sensor: a spinning sensor; one with several origins is cast origin by origin.
        window_vertices: (M, 3) m, the body alone; all vertices if not given.
        margin: rad that the window is wider on each side.

    Raises InputError.
    """
    if sensor.origins:
        return scan_multi_origin(
            lambda v, single, w: scan(v, faces, single, window_vertices=w, margin=margin),
            vertices,
            sensor,
            window_vertices,
        )
    given = vertices, faces, window_vertices
    vertices, faces = as_vertices("vertices", vertices), as_faces(faces, len(vertices))
    window_vertices = vertices if window_vertices is None else as_vertices("window_vertices", window_vertices)
    check_margin(margin)
    packed, window, fault = scan_checked(vertices, faces, window_vertices, compiled_beams(sensor), float(margin))
    if fault == BAD_VERTICES:
        as_points("vertices", given[0])
        as_points("window_vertices", given[2])
    elif fault == BAD_FACES:
        as_mesh(*given[:2])
    return Hits.from_arrays(packed, window)


def scan_multi_origin(
    scan: Callable[[np.ndarray, Sensor, np.ndarray], Hits],
    vertices: np.ndarray,
    sensor: Sensor,
    window_vertices: np.ndarray | None,
) -> Hits:
    """The hits of a sensor whose beams leave from several origins, ordered by column, then ring, in one window.

    scan(vertices, sensor, window_vertices) casts the beams of one origin (`Sensor.origins`).
    """
    vertices = as_points("vertices", vertices)
    window_vertices = vertices if window_vertices is None else as_points("window_vertices", window_vertices)
    parts, ring_numbers = [], []
    for height, single, rings in sensor.origins:
        origin = np.array([0, 0, height])
        hits = scan(vertices - origin, single, window_vertices - origin)
        parts.append(replace(hits, points=hits.points + np.array([0, 0, height], np.float32)))
        ring_numbers.append(rings)
    # columns of all origins counted from the first one of any
    turn, base = sensor.columns, parts[0].column0
    starts = [(part.column0 - base + turn // 2) % turn - turn // 2 for part in parts]
    first = min(starts)
    column = np.concatenate([p.column + np.int32(start - first) for p, start in zip(parts, starts, strict=True)])
    ring = np.concatenate([rings[p.ring].astype(np.int32) for p, rings in zip(parts, ring_numbers, strict=True)])
    order = np.lexsort([ring, column])
    ends = [start - first + part.columns for part, start in zip(parts, starts, strict=True)]
    inside = [rings[p.row0 : p.row0 + p.rows] for p, rings in zip(parts, ring_numbers, strict=True) if p.rows]
    low, high = (min(r[0] for r in inside), max(r[-1] for r in inside)) if inside else (0, -1)
    return Hits(
        points=np.concatenate([p.points for p in parts])[order],
        face=np.concatenate([p.face for p in parts])[order],
        column=column[order],
        ring=ring[order],
        columns=min(max(ends), turn),
        rows=int(high - low + 1),
        column0=(base + first) % turn,
        row0=int(low),
    )


def scan_pattern(
    vertices: np.ndarray,
    faces: np.ndarray,
    pattern: RayPattern,
    frame: int,
    *,
    moved: np.ndarray | None = None,
    body_vertices: int | None = None,
    margin: float = 0.0,
) -> Hits:
    """What the rays of a frame meet, of those that pass a body within `margin` rad.

    vertices (V, 3) m in the sensor's frame when the frame begins, faces (F, 3); moved (V, 3) m: where the vertices are
    when it ends (None: they stand still). body_vertices: how many of the first vertices are the body (None: all).
    Returns `Hits`, ordered by azimuth: ring is the ray's line, column its number in the frame; columns and rows
    are 0. A hit outside the pattern's range limits returns nothing. Raises InputError.
    """
    rays = pattern.frame(frame)
    body = vertices[:body_vertices]
    if moved is not None and len(body):
        body = np.concatenate([body, moved[:body_vertices]])
    picked = _rays_near(rays, body, margin)
    time = rays.time[picked] if moved is not None else None
    distance, face = cast_ray_list(vertices, faces, rays.directions[picked], moved=moved, time=time)
    # no hit is infinitely far
    seen = np.flatnonzero((distance >= pattern.range_min) & (distance <= pattern.range_max))
    index = picked[seen]
    return Hits(
        points=(rays.directions[index] * distance[seen, None]).astype(np.float32),
        face=face[seen],
        column=index.astype(np.int32),
        ring=rays.line[index],
        columns=0,
        rows=0,
        column0=0,
        row0=0,
    )


def _rays_near(rays: Rays, body: np.ndarray, margin: float) -> np.ndarray:
    """Numbers, ascending, of the rays inside the window of azimuths and elevations that holds a body (M, 3)."""
    if not len(body):
        return np.zeros(0, np.int64)
    center, left, right, low, high = bounds(np.ascontiguousarray(body, np.float64))
    left, right = left - margin, right + margin
    if right - left >= 2 * np.pi:
        picked = np.arange(len(rays.azimuth))
    else:
        start = np.mod(center + left + np.pi, 2 * np.pi) - np.pi
        stop = start + right - left
        a, b = np.searchsorted(rays.azimuth, start, "left"), np.searchsorted(rays.azimuth, stop, "right")
        picked = np.arange(a, b)
        if stop > np.pi:
            picked = np.concatenate([np.arange(np.searchsorted(rays.azimuth, stop - 2 * np.pi, "right")), picked])
    elevation = rays.elevation[picked]
    return picked[(elevation >= low - margin) & (elevation <= high + margin)]


def cast_ray_list(
    vertices: np.ndarray,
    faces: np.ndarray,
    directions: np.ndarray,
    *,
    moved: np.ndarray | None = None,
    time: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """The nearest hits of any rays from the origin: for scan patterns without columns, such as rosettes.

    vertices (V, 3) m at time 0, faces (F, 3), directions (N, 3) of any length > 0. moved (V, 3) m: where the vertices
    are at time 1 (None: where they were); they move on straight lines, and a ray meets the triangles as they stand
    at its own time (N,) in [0, 1]. Returns range (N,) float32 m, inf for no hit, and face (N,) int32, -1 for no hit.
    Faces count from both sides. Raises InputError.
    """
    vertices, faces = as_mesh(vertices, faces)
    directions = as_directions(directions)
    if time is not None:
        time = as_times(time, len(directions))
    if moved is None:
        return ray_list(vertices, faces, directions, None, None)
    if time is None:
        raise InputError("moved vertices need the rays' times: pass time (N,) in [0, 1]")
    moved = as_points("moved", moved)
    if moved.shape != vertices.shape:
        raise InputError(f"moved must hold the vertices once more, {vertices.shape}, got {moved.shape}")
    return ray_list(vertices, faces, directions, moved - vertices, time)


def compiled_beams(sensor: Sensor) -> Beams:
    """A sensor for the compiled code of `raycast_scan`; made once."""
    beams = _BEAMS.get(sensor)
    if beams is None:
        groups = sensor.shift_groups
        sector = min(max(1, int(SECTOR / sensor.azimuth_step)), sensor.columns)
        half_steps = np.arange(sector) / 2 * sensor.azimuth_step
        arrays = {
            "elevations": sensor.elevations,
            "tangents": sensor.tangents,
            "shifts": sensor.azimuth_shifts,
            "group_shift": np.array([shift for shift, _ in groups]),
            "group_ring": np.concatenate([rings for _, rings in groups]),
            "group_start": np.cumsum([0] + [len(rings) for _, rings in groups]),
            "half_tan": np.tan(half_steps),
            "half_cos": np.cos(half_steps),
        }
        beams = _BEAMS[sensor] = Beams(
            **{name: read_only(values) for name, values in arrays.items()},
            sector=sector,
            start=float(sensor.azimuth_start),
            step=float(sensor.azimuth_step),
            columns=sensor.columns,
            nearest=float(sensor.range_min),
            farthest=float(sensor.range_max),
        )
    return beams


def _sectors(turned: np.ndarray) -> list[np.ndarray]:
    """Index lists that split sorted azimuths in [0, 2 pi) into sectors, starting after the widest gap."""
    gaps = np.diff(turned, append=turned[0] + 2 * np.pi)
    order = np.roll(np.arange(len(turned)), -(int(np.argmax(gaps)) + 1))
    ahead = np.mod(turned[order] - turned[order[0]], 2 * np.pi)
    sectors, start = [], 0
    while start < len(order):
        stop = int(np.searchsorted(ahead, ahead[start] + SECTOR, side="right"))
        sectors.append(order[start:stop])
        start = stop
    return sectors
