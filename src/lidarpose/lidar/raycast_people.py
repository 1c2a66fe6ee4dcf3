"""Casts of many people of one topology, packed, on as many cores as wanted. The letters are `raycast`'s; B people."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from lidarpose.errors import InputError
from lidarpose.lidar.hits import Hits
from lidarpose.lidar.raycast import beams_of
from lidarpose.lidar.raycast_input import as_culled, as_mesh, as_points, check_margin, read_only
from lidarpose.lidar.raycast_scan import scan_chunk
from lidarpose.lidar.sensor import Sensor

# shares of the work per thread, as people differ in cost by their distance; and at most so many people in a share,
# whose hits then fit in memory that is used again
_SHARES, _MOST = 4, 16


@dataclass(frozen=True, kw_only=True)
class PeopleHits:
    """What a sensor saw of each of B people, one after the other; person i's hits are [start[i], start[i + 1]).

    points (n, 3) float32 m in the sensor's frame; face, column, ring (n,) int32 as in `Hits`; start (B + 1,); windows
    (B, 4): column0, columns, row0, rows.
    """

    points: np.ndarray
    face: np.ndarray
    column: np.ndarray
    ring: np.ndarray
    start: np.ndarray
    windows: np.ndarray

    def __len__(self) -> int:
        return len(self.windows)

    def of(self, i: int) -> Hits:
        """Person i's."""
        own = slice(self.start[i], self.start[i + 1])
        column0, columns, row0, rows = self.windows[i].tolist()
        return Hits(
            points=self.points[own],
            face=self.face[own],
            column=self.column[own],
            ring=self.ring[own],
            columns=columns,
            rows=rows,
            column0=column0,
            row0=row0,
        )


def scan_people(
    vertices: np.ndarray,
    faces: np.ndarray,
    sensor: Sensor,
    *,
    extra: tuple[np.ndarray, np.ndarray] | None = None,
    margin: float = 0.0,
    cull: bool | np.ndarray | None = None,
    threads: int = 1,
) -> PeopleHits:
    """`raycast.scan` of each of B people alone: the same hits, with one call for all.

    vertices (B, V, 3) m in the sensor's frame; faces (F, 3), the same for all. extra: vertices (B, X, 3) and faces
    (G, 3) of what stands around each, such as a quad of ground; its faces are numbered on from F, and the window is
    about the person alone. cull: as in `scan`, the mask (F + G,). threads: how many cores to use; the interpreter's
    lock is released, so callers may bring threads of their own. Raises InputError.
    """
    if sensor.heads:
        raise InputError(f"{sensor.name} has beams of several origins: cast people one by one, with scan")
    vertices = _people("vertices", vertices)
    count = vertices.shape[1]
    extra_vertices, extra_faces = (vertices[:, :0], np.zeros((0, 3), np.int32)) if extra is None else extra
    extra_vertices = _people("the vertices of extra", extra_vertices)
    if len(extra_vertices) != len(vertices):
        raise InputError(f"extra must have as many people as vertices, {len(vertices)}, got {len(extra_vertices)}")
    faces = as_mesh(np.zeros((count, 3)), faces)[1]
    extra_faces = as_mesh(np.zeros((extra_vertices.shape[1], 3)), extra_faces)[1]
    faces = read_only(np.concatenate([faces, extra_faces + np.int32(count)]))
    check_margin(margin)
    if threads < 1:
        raise InputError(f"threads must be at least 1, got {threads}")
    culled, beams = as_culled(cull, faces), beams_of(sensor)
    people = len(vertices)
    chunks = max(-(-people // _MOST), min(people, _SHARES * threads if threads > 1 else 1))
    bounds = [people * i // max(1, chunks) for i in range(chunks + 1)]

    def cast(i: int):
        return scan_chunk(vertices, extra_vertices, faces, culled, beams, float(margin), bounds[i], bounds[i + 1])

    if threads == 1 or chunks <= 1:
        done = [cast(i) for i in range(chunks)]
    else:
        with ThreadPoolExecutor(threads) as pool:
            done = list(pool.map(cast, range(chunks)))
    for *_, fault in done:
        if fault >= 0:
            as_points(f"vertices of person {fault}", vertices[fault])
            as_points(f"extra vertices of person {fault}", extra_vertices[fault])
    if len(done) == 1:
        points, face, column, ring, hits, windows, _ = done[0]
    else:
        done = done or [scan_chunk(vertices, extra_vertices, faces, culled, beams, float(margin), 0, 0)]
        points, face, column, ring, hits, windows = (np.concatenate(part) for part in list(zip(*done, strict=True))[:6])
    return PeopleHits(
        points=points,
        face=face,
        column=column,
        ring=ring,
        start=np.concatenate([[0], np.cumsum(hits)]),
        windows=windows,
    )


def _people(name: str, vertices: np.ndarray) -> np.ndarray:
    """(B, V, 3) float32 or float64, C-contiguous, read-only; the values are not looked at."""
    try:
        vertices = np.asarray(vertices)
        if vertices.dtype not in (np.float32, np.float64):
            vertices = vertices.astype(np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{name} must be a (B, V, 3) array of numbers, got {type(vertices).__name__}") from None
    if vertices.ndim != 3 or vertices.shape[2] != 3:
        raise InputError(f"{name} must be (B, V, 3), got {vertices.shape}")
    return read_only(vertices)
