"""Plain triangle meshes for scenes: quads, boxes, prisms, lofts, and their union.

A mesh of a kind is built once with unit size and then scaled: every person of the generator draws some.
"""

from dataclasses import dataclass
from functools import lru_cache
from math import cos, sin

import numpy as np


@dataclass(frozen=True)
class Mesh:
    """Triangles.

    Args:
        vertices: (V, 3) float32 m.
        faces: (F, 3) int32.
        part: (F,) uint8 of the body that a face belongs to, 0: not the person; None: all 0.
        later: (V, 3) m, the vertices when the sensor's frame ends; None: they stand still.
    """

    vertices: np.ndarray
    faces: np.ndarray
    part: np.ndarray | None = None
    later: np.ndarray | None = None

    def moved(self, translation: np.ndarray, yaw: float = 0.0) -> "Mesh":
        """Turned by `yaw` rad about z, then moved by `translation` (3,) m."""
        vertices = self.vertices
        if yaw:
            c, s = cos(yaw), sin(yaw)
            vertices = vertices @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]], np.float32)
        return Mesh(vertices + np.asarray(translation, np.float32), self.faces, self.part)

    def scaled(self, size: tuple[float, float, float] | np.ndarray) -> "Mesh":
        """Stretched along x, y and z."""
        return Mesh(self.vertices * np.asarray(size, np.float32), self.faces, self.part)

    def placed(self, rows: list, origin: list) -> "Mesh":
        """In another frame: rows (3, 3) say where x, y and z go, then `origin` (3,) m is added."""
        return Mesh(self.vertices @ np.array(rows, np.float32) + np.array(origin, np.float32), self.faces, self.part)


def union(meshes: list[Mesh]) -> Mesh:
    """All meshes as one; their faces stand one mesh after the other."""
    faces, start, part, later = [], 0, None, None
    for mesh in meshes:
        faces.append(mesh.faces + np.int32(start) if start else mesh.faces)
        start += len(mesh.vertices)
    vertices = np.concatenate([m.vertices for m in meshes]).astype(np.float32, copy=False)
    if any(m.part is not None for m in meshes):
        part = np.concatenate([np.zeros(len(m.faces), np.uint8) if m.part is None else m.part for m in meshes])
    if any(m.later is not None for m in meshes):
        later = np.concatenate([m.vertices if m.later is None else m.later for m in meshes])
    return Mesh(vertices, np.concatenate(faces).astype(np.int32, copy=False), part, later)


QUAD_FACES = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
_BOX_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)], np.float32)
_BOX_FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4]]
    + [[1, 5, 7], [1, 7, 3]],
    np.int32,
)


def quad(half: float, slope: np.ndarray) -> Mesh:
    """A square of half width `half` m about the origin, its height slope (2,) times x and y."""
    x, y = half * float(slope[0]), half * float(slope[1])
    corners = [[-half, -half, -x - y], [half, -half, x - y], [half, half, x + y], [-half, half, y - x]]
    return Mesh(np.array(corners, np.float32), QUAD_FACES)


def box(size: np.ndarray) -> Mesh:
    """A box of size (3,) m standing on the origin."""
    return Mesh(_BOX_CORNERS * np.asarray(size, np.float32), _BOX_FACES)


def boxes(middle: np.ndarray, size: np.ndarray) -> Mesh:
    """k boxes in one mesh: middle (k, 3) of their lower faces and size (k, 3), m."""
    middle, size = np.asarray(middle, np.float32), np.asarray(size, np.float32)
    vertices = _BOX_CORNERS * size[:, None] + middle[:, None]
    return Mesh(vertices.reshape(-1, 3), repeated(len(middle), 8, "box"))


_PIECES = {"box": _BOX_FACES, "quad": QUAD_FACES, "triangle": np.array([[0, 1, 2]], np.int32)}


@lru_cache(maxsize=512)
def repeated(count: int, corners: int, piece: str) -> np.ndarray:
    """Faces of `count` like pieces (box, quad or triangle), each with vertices of its own; read-only."""
    starts = np.arange(count, dtype=np.int32)[:, None, None] * np.int32(corners)
    faces = (_PIECES[piece] + starts).reshape(-1, 3)
    faces.setflags(write=False)
    return faces


def prism(radius: float, height: float, sides: int = 7) -> Mesh:
    """An upright prism of `sides` faces standing on the origin: a pole, a trunk, a bin. Open at the bottom."""
    return _unit_prism(sides, 1.0).scaled((radius, radius, height))


def cone(radius: float, height: float, sides: int = 8, top: float = 0.15) -> Mesh:
    """As a prism, `top` times as wide at the top as at the bottom."""
    return _unit_prism(sides, top).scaled((radius, radius, height))


@lru_cache
def _unit_prism(sides: int, top: float) -> Mesh:
    angle = np.arange(sides) * (2 * np.pi / sides)
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    levels = [np.column_stack([ring * wide, np.full(sides, z)]) for z, wide in ((0.0, 1.0), (1.0, top))]
    vertices = np.concatenate(levels + [[[0, 0, 1.0]]])
    k = np.arange(sides)
    n = (k + 1) % sides
    rows = ((k, n, n + sides), (k, n + sides, k + sides), (k + sides, n + sides, 0 * k + 2 * sides))
    faces = np.concatenate([np.stack(row, 1) for row in rows])
    return _fixed(vertices, faces)


def loft(stations: tuple[tuple[float, float, float, float, float], ...]) -> Mesh:
    """A closed hull through cross-sections along x: stations (x, half width at the bottom, half width at the top,
    bottom, top), x ascending. Built once for each tuple; its arrays are read-only."""
    return _loft(tuple(stations))


@lru_cache
def _loft(stations: tuple) -> Mesh:
    vertices = np.array([[[x, -b, low], [x, b, low], [x, t, top], [x, -t, top]] for x, b, t, low, top in stations])
    faces = [[0, 2, 1], [0, 3, 2]]
    for first in range(0, 4 * (len(stations) - 1), 4):
        for k in range(4):
            a, b = first + k, first + (k + 1) % 4
            faces += [[a, b, b + 4], [a, b + 4, a + 4]]
    last = 4 * (len(stations) - 1)
    faces += [[last, last + 1, last + 2], [last, last + 2, last + 3]]
    return _fixed(vertices.reshape(-1, 3), np.array(faces))


def _fixed(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    mesh = Mesh(vertices.astype(np.float32), faces.astype(np.int32))
    mesh.vertices.setflags(write=False)
    mesh.faces.setflags(write=False)
    return mesh
