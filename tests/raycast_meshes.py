"""Meshes for the tests of ray casting, as vertices (V, 3) m and faces (F, 3), and the comparison of hits."""

import numpy as np


def sphere(rings: int = 16, radius: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """A closed sphere: rings of 2 * rings vertices and two poles."""
    around = 2 * rings
    polar = np.pi * np.arange(1, rings) / rings
    angle = np.pi * np.arange(around) / rings
    grid = np.stack(
        np.broadcast_arrays(
            np.sin(polar)[:, None] * np.cos(angle), np.sin(polar)[:, None] * np.sin(angle), np.cos(polar)[:, None]
        ),
        -1,
    ).reshape(-1, 3)
    vertices = radius * np.concatenate([grid, [[0, 0, 1], [0, 0, -1]]])
    top, bottom = len(grid), len(grid) + 1
    faces = []
    for j in range(around):
        k = (j + 1) % around
        faces.append((top, j, k))
        faces.append((bottom, (rings - 2) * around + k, (rings - 2) * around + j))
        for i in range(rings - 2):
            a, b = i * around, (i + 1) * around
            faces += [(a + j, b + j, b + k), (a + j, b + k, a + k)]
    return vertices, np.array(faces)


def body(rng: np.random.Generator, rings: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """A closed, bumpy, self-occluding mesh of a person's size around the origin."""
    vertices, faces = sphere(rings)
    bumps = 1 + 0.3 * np.sin(vertices @ rng.normal(0, 4, (3, 3))).sum(1, keepdims=True) / 3
    return vertices * bumps * [0.3, 0.4, 0.9], faces


def soup(rng: np.random.Generator, count: int, spread: float, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Separate random triangles around the sensor."""
    vertices = rng.normal(0, spread, (count, 1, 3)) + rng.normal(0, size, (count, 3, 3))
    return vertices.reshape(-1, 3), np.arange(3 * count).reshape(count, 3)


def join(*meshes):
    sizes = np.cumsum([0] + [len(v) for v, _ in meshes])
    return np.concatenate([v for v, _ in meshes]), np.concatenate(
        [f + n for (_, f), n in zip(meshes, sizes, strict=False)]
    )


def ground(half: float, z: float, x: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    corners = np.array([[x - half, -half, z], [x + half, -half, z], [x + half, half, z], [x - half, half, z]])
    return corners, np.array([[0, 1, 2], [0, 2, 3]])


def assert_same(got, want):
    """Assert equal hits (range float32, face int32) and ranges; faces may differ only at ties."""
    distance, face = got
    expected, expected_face = want
    assert distance.dtype == np.float32 and face.dtype == np.int32 and distance.shape == expected.shape
    hit = np.isfinite(expected)
    assert (np.isfinite(distance) & ~hit).sum() == 0, "extra hits"
    assert (~np.isfinite(distance) & hit).sum() == 0, "missed hits"
    assert ((face >= 0) == hit).all()
    error = np.abs(distance[hit] - expected[hit])
    assert (error <= 1e-4).all(), f"ranges differ by up to {error.max()} m"
    other = face[hit] != expected_face[hit]
    assert (error[other] <= 1e-5).all()
    assert other.mean() < 0.01 if other.size > 200 else other.sum() <= 2
