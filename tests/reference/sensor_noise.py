"""Slow reference implementation of `synth.noise_kernels.lose_returns`."""

import numpy as np

from lidarpose.synth.simulate import REACH

# lower limit of distances in denominators, m
_NEAREST = 1e-3


def intensity_loss(points, normals, *, range_max):
    """(n,) probability that a return of points (n, 3) m with unit normals (n, 3) is too weak to be seen; see
    `lose_returns`, whose reach is `REACH * range_max` m."""
    beam = points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-6)
    cosine = np.abs((beam * normals).sum(1))
    power = cosine * (REACH * range_max) ** 2 / np.maximum((points**2).sum(1), _NEAREST**2)
    return 1 / (1 + power**2)


def lose_returns_reference(points, normals, keep, error, chance, *, dropout, intensity_dropout, range_max):
    """points (n, 3) m, normals (n, 3) unit, keep (n,) bool, error (n,) m, chance (n,) in [0, 1) -> the kept points
    (k, 3) with their errors, and their indices (k,)."""
    lost = 1 - (1 - dropout) * (1 - intensity_dropout * intensity_loss(points, normals, range_max=range_max))
    kept = np.flatnonzero(keep & (chance >= lost))
    distance = np.linalg.norm(points[kept], axis=1)
    return points[kept] * (1 + error[kept] / np.maximum(distance, _NEAREST))[:, None], kept
