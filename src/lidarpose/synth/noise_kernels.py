"""Selects the returns of a scan that a sensor loses; compiled, as it runs for every synthetic person.

Slow twin: `lose_returns_reference` in tests/reference.
"""

import numpy as np

from lidarpose.lidar.raycast_kernels import compiled


@compiled
def lose_returns(points, face, vertices, faces, keep, error, chance, dropout, intensity_dropout, reach):
    """The returns (k, 3) float32 m that are not lost, and their indices (k,).

    Each of points (n, 3) m lies on face (n,), an index into faces (F, 3). It is returned if keep (n,) is True and its
    uniform chance (n,) is at least the probability that it is lost at random (`dropout`) or because it is weak
    (`intensity_dropout` times the probability below). It is moved along its beam by error (n,) m.

    The power returned from a matte surface larger than the beam is proportional to cos(incidence) / range^2 (the LiDAR
    range equation for extended Lambertian targets); it is 1 for a surface facing the sensor at `reach` m. A return is
    weak with probability 1 / (1 + power^2), a soft threshold since clothes differ in reflectivity: half of the returns
    of a surface facing the sensor at `reach` m are weak. A face without area has power 0.
    """
    return_index = np.empty(len(points), np.int64)
    moved_points = np.empty((len(points), 3), np.float32)
    n = 0
    for i in range(len(points)):
        if not keep[i]:
            continue
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        squared_range = x * x + y * y + z * z
        loss_probability = dropout
        if intensity_dropout > 0:
            a, b, c = faces[face[i], 0], faces[face[i], 1], faces[face[i], 2]
            ux = np.float64(vertices[b, 0]) - vertices[a, 0]
            uy = np.float64(vertices[b, 1]) - vertices[a, 1]
            uz = np.float64(vertices[b, 2]) - vertices[a, 2]
            vx = np.float64(vertices[c, 0]) - vertices[a, 0]
            vy = np.float64(vertices[c, 1]) - vertices[a, 1]
            vz = np.float64(vertices[c, 2]) - vertices[a, 2]
            nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
            # 1 / (1 + power^2) with power = |n . p| reach^2 / (|n| |p|^3), without computing the roots
            dark = max(nx * nx + ny * ny + nz * nz, 1e-30) * max(squared_range, 1e-6) ** 3
            lit = (nx * x + ny * y + nz * z) ** 2 * reach**4
            loss_probability = 1 - (1 - dropout) * (1 - intensity_dropout * dark / (dark + lit))
        if chance[i] < loss_probability:
            continue
        scale = 1 + error[i] / max(np.sqrt(squared_range), 1e-3)
        moved_points[n, 0] = x * scale
        moved_points[n, 1] = y * scale
        moved_points[n, 2] = z * scale
        return_index[n] = i
        n += 1
    return moved_points[:n], return_index[:n]
