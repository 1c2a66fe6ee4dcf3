"""What happens to the returns of a cast before they are cropped, compiled: the generator does it for every person."""

import numpy as np

from lidarpose.errors import MissingExtra
from lidarpose.synth.noise import REACH

try:
    from numba import njit
except ImportError as error:  # pragma: no cover - numba is an optional extra
    raise MissingExtra("synthesis", "synth") from error


def spoil(
    points: np.ndarray,
    face: np.ndarray,
    vertices: np.ndarray,
    faces: np.ndarray,
    ring: np.ndarray,
    *,
    keep: np.ndarray | None = None,
    sigma: float,
    bias: float,
    dropout: float,
    weak: float,
    range_max: float,
    one_sided: float = 0.0,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """The returns that come back, with the errors of their ranges.

    points (n, 3) float32 m of a sensor at the origin, face (n,) indices of faces (F, 3), vertices (V, 3) m of the same
    frame, ring (n,); keep (n,) bool: what is left of them so far. sigma m: standard deviation of a range, symmetric;
    bias m: of an error that a ring's points share; dropout, weak, range_max m: see `synth.noise.spoil_reference`;
    one_sided m: range errors uniform in [0, one_sided) besides, as in the released code.
    Returns points (k, 3) float32 m and their indices (k,).
    """
    count = len(points)
    # the last of the normals are the rings'
    normals = rng.standard_normal(count + int(ring.max(initial=-1)) + 1, np.float32)
    chance = rng.random(count, np.float32)
    outwards = one_sided * rng.random(count, np.float32) if one_sided else None
    error = range_errors(ring, normals, sigma, bias)
    if outwards is not None:
        error += outwards
    keep = np.ones(count, np.bool_) if keep is None else keep
    return spoil_points(points, face, vertices, faces, keep, error, chance, dropout, weak, REACH * range_max)


@njit(nogil=True, cache=True)
def range_errors(ring, normals, sigma, bias):
    """(n,) float32 m: sigma times a normal of its own and bias times that of its ring (n,); normals (n + rings,)."""
    error = np.empty(len(ring), np.float32)
    for i in range(len(ring)):
        error[i] = sigma * normals[i] + bias * normals[len(ring) + ring[i]]
    return error


@njit(nogil=True, cache=True, error_model="numpy")
def spoil_points(points, face, vertices, faces, keep, error, chance, dropout, weak, reach):
    """As `synth.noise.spoil_reference`, with the faces' normals found on the way; what a face without area returns
    is weak."""
    kept = np.empty(len(points), np.int64)
    moved = np.empty((len(points), 3), np.float32)
    n = 0
    for i in range(len(points)):
        if not keep[i]:
            continue
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        squared = x * x + y * y + z * z
        lost = dropout
        if weak > 0:
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
            lost = 1 - (1 - dropout) * (1 - weak * dark / (dark + lit))
        if chance[i] < lost:
            continue
        scale = 1 + error[i] / max(np.sqrt(squared), 1e-3)
        moved[n, 0] = x * scale
        moved[n, 1] = y * scale
        moved[n, 2] = z * scale
        kept[n] = i
        n += 1
    return moved[:n], kept[:n]
