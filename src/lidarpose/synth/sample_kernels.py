"""Sensor noise, cropping and centering of a person's points, compiled: the generator does them for every person.

Slow twins: `Box.contains`, `sample.center_of`, and `lose_returns_reference` in tests/reference.
"""

import numpy as np

from lidarpose.errors import MissingExtra
from lidarpose.sample import CENTER_CELL, Box, center_of

try:
    from numba import njit
except ImportError as error:  # pragma: no cover - numba is an optional extra
    raise MissingExtra("synthesis", "synth") from error

# makers' range limits hold for targets that reflect about 80 percent; clothes at 20 percent are seen half as far
REACH = 0.5


@njit(nogil=True, cache=True)
def range_errors(ring, normals, sigma, bias):
    """(n,) float32 m: sigma times a normal of its own and bias times that of its ring (n,); normals (n + rings,)."""
    error = np.empty(len(ring), np.float32)
    for i in range(len(ring)):
        error[i] = sigma * normals[i] + bias * normals[len(ring) + ring[i]]
    return error


@njit(nogil=True, cache=True, error_model="numpy")
def lose_returns(points, face, vertices, faces, keep, error, chance, dropout, intensity_dropout, reach):
    """The returns (k, 3) float32 m that come back, and their indices (k,).

    A return of points (n, 3) m, which lies on face (n,) of faces (F, 3), counts where keep (n,) and where its chance
    (n,), uniform, is above the probability that it is lost at random (`dropout`) or because it is weak
    (`intensity_dropout` times the probability below); it moves along its beam by error (n,) m.

    The power that comes back from a matt surface larger than the beam goes with cos(incidence) / range^2 (the LiDAR
    range equation for extended Lambertian targets). At `reach` m, half of what faces the sensor comes back; clothes
    differ in reflectivity, which makes the step soft: 1 / (1 + power^2) is lost, power 1 there. What a face without
    area returns is weak.
    """
    kept = np.empty(len(points), np.int64)
    moved = np.empty((len(points), 3), np.float32)
    n = 0
    for i in range(len(points)):
        if not keep[i]:
            continue
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        squared = x * x + y * y + z * z
        lost = dropout
        if intensity_dropout > 0:
            a, b, c = faces[face[i], 0], faces[face[i], 1], faces[face[i], 2]
            ux = np.float64(vertices[b, 0]) - vertices[a, 0]
            uy = np.float64(vertices[b, 1]) - vertices[a, 1]
            uz = np.float64(vertices[b, 2]) - vertices[a, 2]
            vx = np.float64(vertices[c, 0]) - vertices[a, 0]
            vy = np.float64(vertices[c, 1]) - vertices[a, 1]
            vz = np.float64(vertices[c, 2]) - vertices[a, 2]
            nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
            # 1 / (1 + power^2) with power = |n . p| reach^2 / (|n| |p|^3), without its roots
            dark = max(nx * nx + ny * ny + nz * nz, 1e-30) * max(squared, 1e-6) ** 3
            lit = (nx * x + ny * y + nz * z) ** 2 * reach**4
            lost = 1 - (1 - dropout) * (1 - intensity_dropout * dark / (dark + lit))
        if chance[i] < lost:
            continue
        scale = 1 + error[i] / max(np.sqrt(squared), 1e-3)
        moved[n, 0] = x * scale
        moved[n, 1] = y * scale
        moved[n, 2] = z * scale
        kept[n] = i
        n += 1
    return moved[:n], kept[:n]


# cells farther from the first than this many along an axis are left to the twin: one number a cell could overflow
_FAR = 1 << 20


def crop_points(
    points: np.ndarray, ring: np.ndarray, part: np.ndarray, box: Box
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Those of points (n, 3) float32 m, with their ring (n,) and part (n,), that `box.contains`."""
    return _crop(points, ring, part, box.center, box.size, np.cos(box.yaw), np.sin(box.yaw))


def center_of_cells(points: np.ndarray) -> np.ndarray:
    """`sample.center_of` of points (n, 3) float32 m, n >= 1."""
    center, near = _center(points)
    return center if near else center_of(points)


@njit(nogil=True, cache=True)
def _crop(points, ring, part, center, size, c, s):
    x, y, z = points[:, 0] - center[0], points[:, 1] - center[1], points[:, 2] - center[2]
    inside = (np.abs(c * x + s * y) <= size[0] / 2) & (np.abs(c * y - s * x) <= size[1] / 2)
    inside &= np.abs(z) <= size[2] / 2
    return points[inside], ring[inside], part[inside]


@njit(nogil=True, cache=True)
def _center(points):
    """The center, and whether all cells are near enough to each other to be numbered."""
    count = len(points)
    cell, number, along = np.empty(count, np.int64), np.zeros(count, np.int64), np.empty(count, np.int64)
    low, center = np.empty(3, np.int64), np.empty(3)
    for a in range(3):
        for i in range(count):
            cell[i] = np.int64(np.floor(np.float64(points[i, a]) / CENTER_CELL))
        low[a] = cell.min()
        if cell.max() - low[a] >= _FAR:
            return center, False
        for i in range(count):
            number[i] = (number[i] << 20) | (cell[i] - low[a])
    number.sort()
    n = 0
    for i in range(count):
        if i == 0 or number[i] != number[n - 1]:
            number[n] = number[i]
            n += 1
    for a in range(3):
        for i in range(n):
            along[i] = (number[i] >> (40 - 20 * a)) & (_FAR - 1)
        along[:n].sort()
        center[a] = ((along[(n - 1) // 2] + along[n // 2]) / 2 + low[a] + 0.5) * CENTER_CELL
    return center, True
