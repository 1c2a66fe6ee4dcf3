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

from dataclasses import dataclass

import numpy as np

from lidarpose.errors import InputError
from lidarpose.lidar.raycast_kernels import bounds, collect, raster, ray_list
from lidarpose.lidar.sensor import Sensor, Window

# a sector spans at most this much azimuth, so that tan(a) stays near 1
_SECTOR = np.radians(92.0)
# beyond any scene, and its powers are still finite
_FARTHEST = 1e9


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


def cast_rays(
    vertices: np.ndarray, faces: np.ndarray, azimuth: np.ndarray, elevation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The nearest hits of a grid of beams from the origin; faces count from both sides.

    vertices (V, 3) m, x forward, y left, z up; faces (F, 3) indices; azimuth (A,) and elevation (E,) rad in any
    order, |elevation| <= pi/2. Returns range (A, E) float32 m, inf where nothing is hit, and face (A, E) int32, -1
    where nothing is hit. Meshes may be open, degenerate, or surround the sensor. Raises InputError.
    """
    vertices, faces = _mesh(vertices, faces)
    azimuth, elevation = _angles("azimuth", azimuth), _angles("elevation", elevation)
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
            raster(vertices, faces, center, np.tan(relative), np.cos(relative), table, picked, rows, inverse_x, face)
    return _ranges(inverse_x, scale, 1 / np.cos(elevation)), face


def cast_window(
    vertices: np.ndarray, faces: np.ndarray, sensor: Sensor, window: Window
) -> tuple[np.ndarray, np.ndarray]:
    """The nearest hits of a window of a spinning sensor's beams.

    vertices (V, 3) m in the sensor's frame, faces (F, 3). Returns range (C, R) float32 m, inf for no hit, and face
    (C, R) int32, -1 for no hit: C, R are window.columns, window.rows. The sensor's range limits are not applied.
    """
    vertices, faces = _mesh(vertices, faces)
    inverse_x, face, scale = _cast(vertices, faces, sensor, window)
    lift = 1 / np.cos(sensor.elevations[window.row0 : window.row0 + window.rows])
    if scale.shape[1] == 1:
        return _ranges(inverse_x, scale[:, 0], lift), face
    with np.errstate(divide="ignore"):
        return (scale * lift / inverse_x).astype(np.float32), face


def scan(
    vertices: np.ndarray,
    faces: np.ndarray,
    sensor: Sensor,
    *,
    window_vertices: np.ndarray | None = None,
    margin: float = 0.0,
) -> Hits:
    """What the sensor sees inside the smallest window of beams that holds a body. Paper: Eq. 3.

    vertices (V, 3) m in the sensor's frame, faces (F, 3): the body, and whatever may hide it or stand behind it.
    window_vertices (M, 3): the body alone (all vertices if not given); margin rad widens the window on each side.
    A beam whose nearest hit is outside the sensor's range limits returns nothing. Nothing is random. Raises InputError.
    """
    vertices, faces = _mesh(vertices, faces)
    window = find_window(vertices if window_vertices is None else window_vertices, sensor, margin=margin)
    inverse_x, face, scale = _cast(vertices, faces, sensor, window)
    shift = sensor.azimuth_shifts[window.row0 : window.row0 + window.rows]
    tangents = sensor.tangents[window.row0 : window.row0 + window.rows]
    first = sensor.azimuth_start + window.column0 * sensor.azimuth_step
    points, face, column, ring = collect(
        inverse_x, face, scale, first, sensor.azimuth_step, shift, tangents, sensor.range_min, sensor.range_max
    )
    return Hits(
        points=points,
        face=face,
        column=column,
        ring=ring + np.int32(window.row0),
        columns=window.columns,
        rows=window.rows,
        column0=window.column0,
        row0=window.row0,
    )


def find_window(vertices: np.ndarray, sensor: Sensor, *, margin: float = 0.0) -> Window:
    """The smallest window of the sensor's beams that holds the vertices (V, 3) m, `margin` rad wider on each side.

    Paper: Eq. 3 (no margin). A body around the sensor gets the whole turn. Raises InputError.
    """
    vertices = _points("vertices", vertices)
    if not np.isfinite(margin):
        raise InputError(f"margin must be a finite angle in radians, got {margin}")
    if not len(vertices):
        return Window(column0=0, columns=0, row0=0, rows=0)
    center, left, right, low, high = bounds(vertices)
    return sensor.window(center + left - margin, center + right + margin, low - margin, high + margin)


def cast_ray_list(vertices: np.ndarray, faces: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nearest hits of any rays from the origin: for scan patterns without columns, such as rosettes.

    vertices (V, 3) m, faces (F, 3), directions (N, 3) of any length > 0. Returns range (N,) float32 m, inf for no
    hit, and face (N,) int32, -1 for no hit. Faces count from both sides. Raises InputError.
    """
    vertices, faces = _mesh(vertices, faces)
    directions = _points("directions", directions)
    length = np.linalg.norm(directions, axis=1)
    if (length == 0).any():
        raise InputError(f"directions must be longer than 0, but number {int(np.argmin(length))} is zero")
    return ray_list(vertices, faces, directions / length[:, None])


def _points(name: str, values: np.ndarray) -> np.ndarray:
    try:
        values = np.ascontiguousarray(values, np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{name} must be an (n, 3) array of numbers, got {type(values).__name__}") from None
    if values.ndim != 2 or values.shape[1] != 3:
        raise InputError(f"{name} must be (n, 3), got {values.shape}")
    if values.size and not (values.max() < _FARTHEST and values.min() > -_FARTHEST):
        bad = int((~(np.abs(values) < _FARTHEST).all(1)).sum())
        raise InputError(f"{name} must be finite and below {_FARTHEST:.0e} m, but {bad} of {len(values)} are not")
    return values


def _mesh(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = _points("vertices", vertices), np.asarray(faces)
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
        raise InputError(f"faces must be (F, 3) integers, got {faces.shape} {faces.dtype}")
    if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise InputError(f"faces must index the {len(vertices)} vertices from 0, got {faces.min()} to {faces.max()}")
    return vertices, np.ascontiguousarray(faces, np.int32)


def _angles(name: str, values: np.ndarray) -> np.ndarray:
    values = np.asarray(values, np.float64)
    if values.ndim != 1 or not np.isfinite(values).all():
        raise InputError(f"{name} must be a list of finite angles in radians, got shape {values.shape}")
    return values


def _sectors(turned: np.ndarray) -> list[np.ndarray]:
    """Index lists that split sorted azimuths in [0, 2 pi) into sectors, starting after the widest gap."""
    gaps = np.diff(turned, append=turned[0] + 2 * np.pi)
    order = np.roll(np.arange(len(turned)), -(int(np.argmax(gaps)) + 1))
    ahead = np.mod(turned[order] - turned[order[0]], 2 * np.pi)
    sectors, start = [], 0
    while start < len(order):
        stop = int(np.searchsorted(ahead, ahead[start] + _SECTOR, side="right"))
        sectors.append(order[start:stop])
        start = stop
    return sectors


def _ranges(inverse_x: np.ndarray, scale: np.ndarray, lift: np.ndarray) -> np.ndarray:
    """1/x in the sectors' frames -> range (C, R) float32: x / (cos a cos e)."""
    with np.errstate(divide="ignore"):
        return (scale[:, None] * lift / inverse_x).astype(np.float32)


def _cast(
    vertices: np.ndarray, faces: np.ndarray, sensor: Sensor, window: Window
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """1/x (C, R) in the sectors' frames, face (C, R) and 1/cos(a) of the beams (C, 1) or (C, R)."""
    inverse_x = np.zeros((window.columns, window.rows))
    face = np.full((window.columns, window.rows), -1, np.int32)
    groups = sensor.shift_groups
    scale = np.ones((window.columns, 1 if len(groups) == 1 else window.rows))
    per_sector = max(1, int(_SECTOR / sensor.azimuth_step))
    for shift, rings in groups:
        rings = rings[(rings >= window.row0) & (rings < window.row0 + window.rows)]
        if not len(rings):
            continue
        table = sensor.tangents[rings]
        rows = rings - window.row0
        for start in range(0, window.columns, per_sector):
            columns = np.arange(start, min(start + per_sector, window.columns))
            middle = (columns[0] + columns[-1]) / 2
            center = sensor.azimuth_start + (window.column0 + middle) * sensor.azimuth_step + shift
            relative = (columns - middle) * sensor.azimuth_step
            cosine = np.cos(relative)
            secant = 1 / cosine[:, None]
            if len(groups) == 1:
                scale[columns] = secant
            else:
                scale[columns[:, None], rows] = secant
            raster(vertices, faces, center, np.tan(relative), cosine, table, columns, rows, inverse_x, face)
    return inverse_x, face, scale
