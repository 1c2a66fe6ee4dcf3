"""Plain triangle meshes for scenes: quads, boxes, prisms, and their union."""

from dataclasses import dataclass

import numpy as np

from lidarpose.geometry import rotation_about


@dataclass(frozen=True)
class Mesh:
    """vertices (V, 3) float32 m, faces (F, 3) int32."""

    vertices: np.ndarray
    faces: np.ndarray

    def moved(self, translation: np.ndarray, yaw: float = 0.0) -> "Mesh":
        """Turned by `yaw` rad about z, then moved by `translation` (3,) m."""
        turned = self.vertices @ rotation_about("z", yaw).T.astype(np.float32) if yaw else self.vertices
        return Mesh(turned + np.asarray(translation, np.float32), self.faces)


def union(meshes: list[Mesh]) -> Mesh:
    """All meshes as one; their faces stand one mesh after the other."""
    starts = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    faces = np.concatenate([m.faces + start for m, start in zip(meshes, starts, strict=True)]).astype(np.int32)
    return Mesh(np.concatenate([m.vertices for m in meshes]).astype(np.float32), faces)


_QUAD_FACES = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
_BOX_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)], np.float32)
_BOX_FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4]]
    + [[1, 5, 7], [1, 7, 3]],
    np.int32,
)


def quad(half: float, slope: np.ndarray) -> Mesh:
    """A square of half width `half` m about the origin, its height slope (2,) times x and y."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float) * half
    return Mesh(np.column_stack([corners, corners @ slope]).astype(np.float32), _QUAD_FACES)


def box(size: np.ndarray) -> Mesh:
    """A box of size (3,) m standing on the origin."""
    corners = (_BOX_CORNERS + np.array([0, 0, 0.5], np.float32)) * np.asarray(size, np.float32)
    return Mesh(corners, _BOX_FACES)


def prism(radius: float, height: float, sides: int = 7) -> Mesh:
    """An upright prism of `sides` faces standing on the origin: a pole, a trunk, a bin. Open at the bottom."""
    angle = np.arange(sides) * (2 * np.pi / sides)
    ring = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
    vertices = np.concatenate([np.column_stack([ring, np.full(sides, z)]) for z in (0.0, height)] + [[[0, 0, height]]])
    k = np.arange(sides)
    n = (k + 1) % sides
    faces = np.concatenate(
        [
            np.stack(f, 1)
            for f in ((k, n, n + sides), (k, n + sides, k + sides), (k + sides, n + sides, 0 * k + 2 * sides))
        ]
    )
    return Mesh(vertices.astype(np.float32), faces.astype(np.int32))
