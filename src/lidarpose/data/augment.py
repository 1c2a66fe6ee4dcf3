"""What happens to points after the cast, each a small pure function of (points, ..., rng).

Legend: n points; parts are 0 for what is not body, 1 + j for the bone of SMPL-24's joint j.
"""

import numpy as np


def range_noise(points: np.ndarray, ring: np.ndarray, *, sigma: float, bias: float, rng) -> np.ndarray:
    """points (n, 3) m from a sensor at the origin, moved along their beams.

    sigma: standard deviation of a single range in metres, symmetric (the released code adds 0 to 2 cm, always
    outwards); bias: standard deviation of an error that all points of a ring share.
    """
    distance = np.linalg.norm(points, axis=1, keepdims=True)
    of_ring = rng.normal(0, bias, int(ring.max(initial=-1)) + 1)
    error = rng.normal(0, sigma, len(points)) + of_ring[ring]
    return points * (1 + error[:, None] / np.maximum(distance, 1e-3))


def grazing_keep(points: np.ndarray, normals: np.ndarray, *, strength: float, rng) -> np.ndarray:
    """(n,) bool: returns that survive; a beam that grazes a surface is lost with probability up to `strength`."""
    beam = points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-6)
    grazing = 1 - np.abs((beam * normals).sum(1))
    return rng.random(len(points)) >= strength * grazing**4


def noise_clusters(center: np.ndarray, *, most: int, rng) -> np.ndarray:
    """(k, 3) m: up to two blobs of stray points about `center`, as the paper's stability study adds them.

    Each has 0 to `most` points within 0.3 m of a place up to 0.4 m (0.8 m in height) from the center.
    """
    blobs = []
    for _ in range(rng.integers(1, 3)):
        count = int(rng.integers(0, most + 1))
        place = center + rng.uniform(-1, 1, 3) * [0.4, 0.4, 0.8]
        direction = rng.normal(size=(count, 3))
        direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-9)
        blobs.append(place + direction * rng.uniform(0, 0.3, (count, 1)))
    return np.concatenate(blobs)


def part_removal(part: np.ndarray, *, rng) -> np.ndarray:
    """(n,) bool: keeps all but the points of one body part that is present, drawn at random."""
    present = np.unique(part[part > 0])
    return np.ones(len(part), bool) if len(present) == 0 else part != rng.choice(present)


def jitter(points: np.ndarray, *, sigma: float, clip: float, rng) -> np.ndarray:
    """points (n, 3) m, each moved by a normal step of `sigma` m an axis, cut at +-`clip` m."""
    return points + np.clip(rng.normal(0, sigma, points.shape), -clip, clip)
