"""Exact LiDAR returns of triangle meshes, by rasterizing triangles onto the columns of beams.

The sensor is at the origin. A beam of azimuth a and elevation e has the direction (cos a cos e, sin a cos e, sin e).
A column consists of all beams of one azimuth: a half plane that cuts a triangle in a segment. The segment covers the
rows between the elevations of its ends. No tree is built, as fewer beams hit a body than it has triangles.

A sector of columns (at most a quarter turn) is cast as follows:
    1. Vertices are rotated so that +x points to the sector's middle, and projected to Y = y/x, Z = z/x, I = 1/x. Lines
       stay lines and I is affine over a triangle, so interpolating I gives the exact hit.
    2. Columns are lines Y = tan(a); on a column, rows are T = tan(e) with T = Z cos(a). Finding the first column
       right of a vertex or the first row above a crossing is one table look-up.
    3. Triangles that cross no column are dropped.
    4. Two edges of a triangle cross a column. A crossing is computed from the edge alone, from its right to its left
       end, so both triangles of an edge get the same number. Rows are half-open intervals between crossings, so a
       closed mesh has no holes and no beam is counted twice. The largest I wins.
Vertices beside or behind the sensor have no Y and Z: crossings of edges that end there are computed in x, y, z.

A LiDAR beam illuminates a spot, not a point. A beam with a divergence is split into S x S rays over its footprint.
Their power has a Gaussian profile, 1/e^2 of the maximum at half the divergence, as manufacturers specify it. The rays
return echoes:
    1. Surfaces closer together in range than the pulse resolves, c tau / 2 for a pulse of tau seconds, form one echo.
       Its range is the mean of theirs, weighted by the returned power: at an edge, a point in mid-air.
    2. The returned power falls with the square of the range (LiDAR equation of an extended diffuse target, Wagner et
       al. 2006); reflectivity and incidence angle are ignored.
    3. The strongest echo is the beam's return ("strongest return", the usual mode of spinning sensors), if it is at
       least as strong as a full beam's echo from the sensor's maximum range. It lies on the beam's axis. There are no
       second returns.
So silhouettes grow by up to half the divergence, thin objects are visible from farther away, and edges are smeared.

Legend: V vertices, F faces, C columns, R rows of a window, A azimuths, E elevations, N rays, n hits.
"""

from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from lidarpose.errors import InputError
from lidarpose.lidar.ray_list_kernels import ray_list
from lidarpose.lidar.ray_pattern import RayPattern, Rays
from lidarpose.lidar.raycast_kernels import raster
from lidarpose.lidar.scan_kernels import SECTOR, Beams, bounds, scan_window, sub_tangents
from lidarpose.lidar.sensor import Sensor
from lidarpose.sample import FARTHEST

# m: c tau / 2 of a pulse of 5 ns, typical of spinning sensors
PULSE = 0.75
_MOST_SUB_BEAMS = 15
# rad: no LiDAR has a wider beam
_WIDEST = 0.1
_BEAMS: WeakKeyDictionary[Sensor, Beams] = WeakKeyDictionary()


@dataclass(frozen=True, kw_only=True)
class Hits:
    """The returns of a sensor inside a window of beams, ordered by column, then ring.

    points (n, 3) float32 m in the sensor's frame; face (n,) int32; column (n,) int32, counted from the window's first
    column, so it is continuous across +-pi; ring (n,) int32, index of the sensor's ring, 0 is the lowest; columns,
    rows: the window's size; column0, row0: its start; `(column + column0) % sensor.columns` is the sensor's column.
    """

    points: np.ndarray
    face: np.ndarray
    column: np.ndarray
    ring: np.ndarray
    columns: int
    rows: int
    column0: int
    row0: int


def cast_rays(
    vertices: np.ndarray, faces: np.ndarray, azimuth: np.ndarray, elevation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The nearest hits of a grid of beams from the origin; faces are two-sided.

    vertices (V, 3) m, x forward, y left, z up; faces (F, 3) indices; azimuth (A,) and elevation (E,) rad in any
    order, |elevation| <= pi/2. Returns range (A, E) float32 m, inf where nothing is hit, and face (A, E) int32, -1
    where nothing is hit. Meshes may be open, degenerate, or surround the sensor. Raises InputError.
    """
    vertices, faces = _as_mesh(vertices, faces)
    azimuth, elevation = _as_angles("azimuth", azimuth), _as_angles("elevation", elevation)
    if (np.abs(elevation) > np.pi / 2).any():
        raise InputError(
            f"elevation must be within +-pi/2 rad, got up to {np.abs(elevation).max():.4g}: are they degrees?"
        )
    inverse_x = np.zeros((len(azimuth), len(elevation)))
    face = np.full(inverse_x.shape, -1, np.int32)
    scale = np.empty(len(azimuth))
    if inverse_x.size:
        rows = np.argsort(elevation, kind="stable")
        tangents = np.tan(elevation[rows])
        wrapped_azimuth = np.mod(azimuth, 2 * np.pi)
        columns = np.argsort(wrapped_azimuth, kind="stable")
        for sector in _sectors(wrapped_azimuth[columns]):
            sector_columns = columns[sector]
            start = wrapped_azimuth[sector_columns[0]]
            azimuth_from_start = np.mod(wrapped_azimuth[sector_columns] - start, 2 * np.pi)
            center = start + azimuth_from_start[-1] / 2
            azimuth_from_center = azimuth_from_start - azimuth_from_start[-1] / 2
            scale[sector_columns] = 1 / np.cos(azimuth_from_center)
            raster(
                vertices, faces, center, np.tan(azimuth_from_center), np.cos(azimuth_from_center), tangents,
                sector_columns, rows, inverse_x, face,
            )  # fmt: skip
    # x / (cos a cos e), with x in the sectors' frames
    with np.errstate(divide="ignore"):
        distance = scale[:, None] * (1 / np.cos(elevation)) / inverse_x
    return distance.astype(np.float32), face


def _sectors(azimuths: np.ndarray) -> list[np.ndarray]:
    """Lists of indices that split sorted azimuths in [0, 2 pi) into sectors, starting after the widest gap."""
    gaps = np.diff(azimuths, append=azimuths[0] + 2 * np.pi)
    order = np.roll(np.arange(len(azimuths)), -(int(np.argmax(gaps)) + 1))
    azimuth_from_start = np.mod(azimuths[order] - azimuths[order[0]], 2 * np.pi)
    sectors, start = [], 0
    while start < len(order):
        stop = int(np.searchsorted(azimuth_from_start, azimuth_from_start[start] + SECTOR, side="right"))
        sectors.append(order[start:stop])
        start = stop
    return sectors


# --- spinning sensors


def scan(
    vertices: np.ndarray,
    faces: np.ndarray,
    sensor: Sensor,
    *,
    divergence: float = 0.0,
    sub_beams: int = 3,
    pulse: float = PULSE,
    window_vertices: np.ndarray | None = None,
    margin: float = 0.0,
    moved: np.ndarray | None = None,
) -> Hits:
    """Scans inside the smallest window of beams that contains a body. Paper: Eq. 3 (no margin).

    A beam whose nearest hit is outside the sensor's range limits returns nothing. A sensor inside a mesh sees it from
    inside. Faces are two-sided. Nothing is random.

    The window contains vertices, not edges: seen from the sensor, the upper edge of a near wall rises above its two
    ends. A coarse mesh needs a `margin`, or a finer mesh as `window_vertices`. For a body around the sensor, the window
    is the whole turn.

    With a divergence, casting takes about sub_beams times as long. A hit's face is then that of the nearest surface in
    the returned echo, the window is wider by half the divergence on each side, and the footprint in azimuth is that at
    the horizon.

    Args:
        vertices: (V, 3) m in the sensor's frame: the body, and objects that may occlude it or be behind it.
        faces: (F, 3) indices.
        sensor: a spinning sensor; one with several origins is cast origin by origin.
        divergence: full divergence of a beam, rad; 0.0015 to 0.003 for most sensors; 0 casts only the beam's axis.
        sub_beams: number of sub-beams along a side of the footprint.
        pulse: m, minimum difference in range at which two echoes are separate.
        window_vertices: (M, 3) m, the body alone; by default all vertices.
        margin: rad by which the window is wider on each side.
        moved: (V, 3) m, positions of the vertices when the rings with the largest of the sensor's `ring_lags` pass
            them, and `vertices` those for the first rings, linear in between; None means no motion. The window only
            covers `window_vertices`: include both positions there.

    Raises:
        InputError: For invalid arguments.
    """
    if not 0 <= divergence <= _WIDEST:
        raise InputError(f"divergence must be between 0 and {_WIDEST} rad, got {divergence}: is it in mrad?")
    if sub_beams != int(sub_beams) or not 1 <= sub_beams <= _MOST_SUB_BEAMS:
        raise InputError(f"sub_beams must be a whole number from 1 to {_MOST_SUB_BEAMS}, got {sub_beams}")
    if not 0 <= pulse < np.inf:
        raise InputError(f"pulse must be a length >= 0 m, got {pulse}")
    if not np.isfinite(margin):
        raise InputError(f"margin must be a finite angle in radians, got {margin}")
    vertices, faces = _as_mesh(vertices, faces)
    body = vertices if window_vertices is None else _as_points("window_vertices", window_vertices)
    if sensor.origins:
        options: dict[str, Any] = {"divergence": divergence, "sub_beams": sub_beams, "pulse": pulse, "margin": margin}
        way = np.zeros(3) if moved is None else _as_moved(moved, vertices) - vertices
        parts = []
        for height, share, origin_sensor, _ in sensor.origins:
            origin = np.array([0, 0, height])
            place = vertices + share * way - origin
            parts.append(scan(place, faces, origin_sensor, window_vertices=body - origin, **options))
        return _join_origins(sensor, parts)
    window = (0, 0, 0, 0)
    if len(body):
        center, left, right, low, high = bounds(body)
        margin += divergence / 2
        beam_window = sensor.window(center + left - margin, center + right + margin, low - margin, high + margin)
        window = beam_window.column0, beam_window.columns, beam_window.row0, beam_window.rows
    offsets, weights, tangents = np.zeros(1), np.ones((1, 1)), sensor.tangents[:, None]
    if divergence:
        offsets, weights = footprint(divergence, sub_beams)
        tangents = sub_tangents(sensor.elevations, offsets)
    points, face, column, ring = scan_window(
        vertices, faces, _compiled_beams(sensor), window, offsets, tangents, weights, float(pulse)
    )
    column0, columns, row0, rows = window
    return Hits(
        points=points, face=face, column=column, ring=ring, columns=columns, rows=rows, column0=column0, row0=row0
    )


def footprint(divergence: float, sub_beams: int) -> tuple[np.ndarray, np.ndarray]:
    """Offsets (S,) rad of the sub-beams in azimuth and in elevation, and their powers (S, S), which sum to 1."""
    offsets = ((np.arange(sub_beams) + 0.5) / sub_beams - 0.5) * divergence
    profile = np.exp(-2 * (offsets / (divergence / 2)) ** 2)
    weights = profile[:, None] * profile
    return offsets, weights / weights.sum()


def _join_origins(sensor: Sensor, parts: list[Hits]) -> Hits:
    """Merges the hits of the `Sensor.origins` into one window, ordered by column, then ring."""
    # first columns of all origins relative to that of the first origin
    turn_columns, base_column = sensor.columns, parts[0].column0
    starts = [(part.column0 - base_column + turn_columns // 2) % turn_columns - turn_columns // 2 for part in parts]
    first_column = min(starts)
    points, column, ring, window_rings = [], [], [], []
    for part, start, (height, _, _, rings) in zip(parts, starts, sensor.origins, strict=True):
        points.append(part.points + np.array([0, 0, height], np.float32))
        column.append(part.column + np.int32(start - first_column))
        ring.append(rings[part.ring].astype(np.int32))
        window_rings.append(rings[part.row0 : part.row0 + part.rows])
    rows = np.concatenate(window_rings)
    row0, end = (int(rows.min()), int(rows.max()) + 1) if len(rows) else (0, 0)
    all_columns, all_rings = np.concatenate(column), np.concatenate(ring)
    order = np.lexsort([all_rings, all_columns])
    return Hits(
        points=np.concatenate(points)[order],
        face=np.concatenate([part.face for part in parts])[order],
        column=all_columns[order],
        ring=all_rings[order],
        columns=min(
            max(start - first_column + part.columns for part, start in zip(parts, starts, strict=True)), turn_columns
        ),
        rows=end - row0,
        column0=(base_column + first_column) % turn_columns,
        row0=row0,
    )


def _compiled_beams(sensor: Sensor) -> Beams:
    """A sensor for the compiled code of `scan_kernels`; cached."""
    if sensor not in _BEAMS:
        shifts, rings = zip(*sensor.shift_groups, strict=True)
        sector = min(max(1, int(SECTOR / sensor.azimuth_step)), sensor.columns)
        half_steps = np.arange(sector) / 2 * sensor.azimuth_step
        _BEAMS[sensor] = Beams(
            tangents=sensor.tangents,
            shifts=sensor.azimuth_shifts,
            group_shift=np.array(shifts),
            group_ring=np.concatenate(rings),
            group_start=np.cumsum([0, *map(len, rings)]),
            half_tan=np.tan(half_steps),
            half_cos=np.cos(half_steps),
            sector=sector,
            start=float(sensor.azimuth_start),
            step=float(sensor.azimuth_step),
            columns=sensor.columns,
            nearest=float(sensor.range_min),
            farthest=float(sensor.range_max),
        )
    return _BEAMS[sensor]


# --- rays of any direction


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
    """The hits of those rays of a frame that pass a body within `margin` rad.

    vertices (V, 3) m in the sensor's frame at the start of the frame, faces (F, 3); moved (V, 3) m: the vertices at the
    end of the frame (None: no motion). body_vertices: the number of leading vertices that are the body (None: all).
    Returns `Hits`, ordered by azimuth: ring is the ray's line, column its index in the frame; columns and rows
    are 0. A hit outside the pattern's range limits returns nothing. Raises InputError.
    """
    rays = pattern.frame(frame)
    body = vertices[:body_vertices]
    if moved is not None and len(body):
        body = np.concatenate([body, moved[:body_vertices]])
    ray_indices = _rays_near(rays, body, margin)
    time = rays.time[ray_indices] if moved is not None else None
    distance, face = cast_ray_list(vertices, faces, rays.directions[ray_indices], moved=moved, time=time)
    # rays without a hit have the distance inf
    hit_rows = np.flatnonzero((distance >= pattern.range_min) & (distance <= pattern.range_max))
    index = ray_indices[hit_rows]
    return Hits(
        points=(rays.directions[index] * distance[hit_rows, None]).astype(np.float32),
        face=face[hit_rows],
        column=index.astype(np.int32),
        ring=rays.line[index],
        columns=0,
        rows=0,
        column0=0,
        row0=0,
    )


def _rays_near(rays: Rays, body: np.ndarray, margin: float) -> np.ndarray:
    """Ascending indices of the rays inside the window of azimuths and elevations that contains a body (M, 3)."""
    if not len(body):
        return np.zeros(0, np.int64)
    center, left, right, low, high = bounds(np.ascontiguousarray(body, np.float64))
    left, right = left - margin, right + margin
    if right - left >= 2 * np.pi:
        ray_indices = np.arange(len(rays.azimuth))
    else:
        start = np.mod(center + left + np.pi, 2 * np.pi) - np.pi
        stop = start + right - left
        a, b = np.searchsorted(rays.azimuth, start, "left"), np.searchsorted(rays.azimuth, stop, "right")
        ray_indices = np.arange(a, b)
        if stop > np.pi:
            ray_indices = np.concatenate(
                [np.arange(np.searchsorted(rays.azimuth, stop - 2 * np.pi, "right")), ray_indices]
            )
    elevation = rays.elevation[ray_indices]
    return ray_indices[(elevation >= low - margin) & (elevation <= high + margin)]


def cast_ray_list(
    vertices: np.ndarray,
    faces: np.ndarray,
    directions: np.ndarray,
    *,
    moved: np.ndarray | None = None,
    time: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """The nearest hits of arbitrary rays from the origin: for scan patterns without columns, such as rosettes.

    vertices (V, 3) m at time 0, faces (F, 3), directions (N, 3) of any length > 0. moved (V, 3) m: the vertices at
    time 1 (None: no motion). Vertices move on straight lines, and each ray is cast at its own time (N,) in [0, 1].
    Returns range (N,) float32 m, inf for no hit, and face (N,) int32, -1 for no hit. Faces are two-sided. Raises
    InputError.
    """
    vertices, faces = _as_mesh(vertices, faces)
    directions = _as_points("directions", directions)
    length = np.linalg.norm(directions, axis=1)
    if (length == 0).any():
        raise InputError(f"directions must be longer than 0, but number {int(np.argmin(length))} is zero")
    directions = directions / length[:, None]
    if time is not None:
        time = _as_times(time, len(directions))
    if moved is None:
        return ray_list(vertices, faces, directions, None, None)
    if time is None:
        raise InputError("moved vertices need the rays' times: pass time (N,) in [0, 1]")
    return ray_list(vertices, faces, directions, _as_moved(moved, vertices) - vertices, time)


# --- argument checks: each array is converted to one type, so that the kernels are compiled only once


def _as_points(name: str, values: Any) -> np.ndarray:
    """A finite, C-contiguous copy (n, 3) float64; writable, like the arrays that compiled code creates."""
    values = _as_floats(name, values, "an (n, 3) array of numbers")
    if values.ndim != 2 or values.shape[1] != 3:
        raise InputError(f"{name} must be (n, 3), got {values.shape}")
    if values.size and not (values.max() < FARTHEST and values.min() > -FARTHEST):
        bad_count = int((~(np.abs(values) < FARTHEST).all(1)).sum())
        raise InputError(f"{name} must be finite and below {FARTHEST:.0e} m, but {bad_count} of {len(values)} are not")
    return values


def _as_mesh(vertices: Any, faces: Any) -> tuple[np.ndarray, np.ndarray]:
    """Copies of vertices (V, 3) float64 and faces (F, 3) int32 that index them."""
    vertices, faces = _as_points("vertices", vertices), np.asarray(faces)
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
        raise InputError(f"faces must be (F, 3) integers, got {faces.shape} {faces.dtype}")
    if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise InputError(f"faces must index the {len(vertices)} vertices from 0, got {faces.min()} to {faces.max()}")
    return vertices, np.array(faces, np.int32, order="C")


def _as_moved(moved: Any, vertices: np.ndarray) -> np.ndarray:
    """A copy (V, 3) float64 of `moved`, the new positions of `vertices` (V, 3)."""
    moved = _as_points("moved", moved)
    if moved.shape != vertices.shape:
        raise InputError(f"moved must have the shape of the vertices, {vertices.shape}, got {moved.shape}")
    return moved


def _as_times(time: np.ndarray, count: int) -> np.ndarray:
    """A copy (count,) float64 in [0, 1]."""
    time = _as_floats("time", time, f"({count},) numbers, one per ray")
    if time.shape != (count,):
        raise InputError(f"time must be ({count},), one per ray, got {time.shape}")
    outside_indices = np.flatnonzero(~((time >= 0) & (time <= 1)))
    if len(outside_indices):
        raise InputError(
            f"time must be within 0 and 1, the ends of the motion, got {time[outside_indices[0]]} "
            f"for ray {outside_indices[0]}"
        )
    return time


def _as_angles(name: str, values: np.ndarray) -> np.ndarray:
    """A copy (n,) float64, finite."""
    expected = "a list of finite angles in radians"
    values = _as_floats(name, values, expected)
    if values.ndim != 1 or not np.isfinite(values).all():
        raise InputError(f"{name} must be {expected}, got shape {values.shape}")
    return values


def _as_floats(name: str, values: np.ndarray, expected: str) -> np.ndarray:
    try:
        return np.array(values, np.float64, order="C")
    except (TypeError, ValueError):
        raise InputError(f"{name} must be {expected}, got {type(values).__name__}") from None
