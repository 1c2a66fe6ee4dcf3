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

What turns its back to the sensor is behind something of the same mesh if the mesh is closed: `cull` leaves it out,
which changes nothing but the time. A closed mesh that may hold the sensor is not culled.

Letters: V vertices, F faces, C columns, R rows of a window, A azimuths, E elevations, N rays, n hits.
"""

from weakref import WeakKeyDictionary

import numpy as np

from lidarpose.errors import InputError
from lidarpose.lidar.hits import Hits
from lidarpose.lidar.multi_origin import scan_heads
from lidarpose.lidar.raycast_input import (
    as_angles,
    as_culled,
    as_directions,
    as_faces,
    as_mesh,
    as_points,
    as_times,
    as_vertices,
    check_faces,
    check_margin,
    read_only,
)
from lidarpose.lidar.raycast_kernels import raster
from lidarpose.lidar.raycast_rays import ray_list
from lidarpose.lidar.raycast_scan import BAD_FACES, BAD_VERTICES, SECTOR, Beams, bounds, cast_grid, scan_checked
from lidarpose.lidar.sensor import Sensor, Window

_BEAMS: WeakKeyDictionary[Sensor, Beams] = WeakKeyDictionary()


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
                vertices, faces, as_culled(None, faces), center, np.tan(relative), np.cos(relative), table,
                picked, rows, inverse_x, face,
            )  # fmt: skip
    return _ranges(inverse_x, scale, 1 / np.cos(elevation)), face


def cast_window(
    vertices: np.ndarray, faces: np.ndarray, sensor: Sensor, window: Window, *, cull: bool | np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The nearest hits of a window of a spinning sensor's beams.

    vertices (V, 3) m in the sensor's frame, faces (F, 3); cull: as in `scan`. Returns range (C, R) float32 m, inf for
    no hit, and face (C, R) int32, -1 for no hit: C, R are window.columns, window.rows. The sensor's range limits are
    not applied; all beams leave from the origin, whatever its origin_heights. Raises InputError.
    """
    vertices, faces = as_mesh(vertices, faces)
    inverse_x, face, scale = cast_grid(
        vertices, faces, as_culled(cull, faces), beams_of(sensor),
        window.column0, window.columns, window.row0, window.rows,
    )  # fmt: skip
    return _ranges(inverse_x, scale, 1 / np.cos(sensor.elevations[window.row0 : window.row0 + window.rows])), face


def scan(
    vertices: np.ndarray,
    faces: np.ndarray,
    sensor: Sensor,
    *,
    window_vertices: np.ndarray | None = None,
    margin: float = 0.0,
    cull: bool | np.ndarray | None = None,
) -> Hits:
    """What the sensor sees inside the smallest window of beams that holds a body. Paper: Eq. 3.

    vertices (V, 3) m in the sensor's frame, faces (F, 3): the body, and whatever may hide it or stand behind it.
    window_vertices (M, 3): the body alone (all vertices if not given); margin rad widens the window on each side.
    cull: the faces, all (True) or a mask (F,), of closed meshes whose faces are counter-clockwise seen from outside
    (see `is_closed`): the same hits, sooner. Other faces count from both sides.
    A beam whose nearest hit is outside the sensor's range limits returns nothing. A sensor inside a mesh sees it from
    inside. Nothing is random. The heads of a sensor with several origins are cast one by one. Raises InputError.

    The window holds vertices, not edges: as seen from the sensor, the upper edge of a near wall rises above its two
    ends. A coarse mesh needs a `margin`, or a finer one as `window_vertices`.
    """
    if sensor.heads:
        return scan_heads(
            lambda v, head, w: scan(v, faces, head, window_vertices=w, margin=margin, cull=cull),
            vertices,
            sensor,
            window_vertices,
        )
    given = vertices, faces, window_vertices
    vertices, faces = as_vertices("vertices", vertices), as_faces(faces, len(vertices))
    window_vertices = vertices if window_vertices is None else as_vertices("window_vertices", window_vertices)
    check_margin(margin)
    (hits, window), fault = scan_checked(
        vertices, faces, as_culled(cull, faces), window_vertices, beams_of(sensor), float(margin)
    )
    if fault == BAD_VERTICES:
        as_points("vertices", given[0])
        as_points("window_vertices", given[2])
    elif fault == BAD_FACES:
        as_mesh(*given[:2])
    points, face, column, ring = hits
    column0, columns, row0, rows = window
    return Hits(
        points=points, face=face, column=column, ring=ring, columns=columns, rows=rows, column0=column0, row0=row0
    )


def beams_of(sensor: Sensor) -> Beams:
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


def is_closed(faces: np.ndarray) -> bool:
    """Whether every edge joins exactly two faces (F, 3), which run along it in opposite directions.

    Such a mesh has an inside. Whether its faces look outwards, as `cull` needs, is for the caller to know.
    """
    faces = np.asarray(faces)
    check_faces(faces)
    a = faces.astype(np.int64)
    b = np.roll(a, -1, axis=1)
    most = int(a.max(initial=0)) + 1
    there, back = np.sort((a * most + b).reshape(-1)), np.sort((b * most + a).reshape(-1))
    return len(a) > 0 and bool((a != b).all() and (np.diff(there) > 0).all() and (there == back).all())


def find_window(vertices: np.ndarray, sensor: Sensor, *, margin: float = 0.0) -> Window:
    """The smallest window of the sensor's beams that holds the vertices (V, 3) m, `margin` rad wider on each side.

    Paper: Eq. 3 (no margin). A body around the sensor gets the whole turn. Long edges may rise above it, see `scan`.
    Raises InputError.
    """
    vertices = as_points("vertices", vertices)
    check_margin(margin)
    if not len(vertices):
        return Window(column0=0, columns=0, row0=0, rows=0)
    center, left, right, low, high = bounds(vertices)
    return sensor.window(center + left - margin, center + right + margin, low - margin, high + margin)


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


def _ranges(inverse_x: np.ndarray, scale: np.ndarray, lift: np.ndarray) -> np.ndarray:
    """1/x in the sectors' frames -> range (C, R) float32: x / (cos a cos e)."""
    with np.errstate(divide="ignore"):
        return (scale[:, None] * lift / inverse_x).astype(np.float32)
