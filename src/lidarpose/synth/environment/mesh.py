"""Triangle meshes for scenes: primitives, their union, and objects of streets and rooms.

Objects have few triangles, but correct outlines, which is what a LiDAR sees. All stand on the origin, with their front
along +x and their length, if any, along y; sizes in meters. Functions with an rng return random shapes, all others
depend only on sizes. A shipped mesh is loaded once at unit size and then scaled, since every person draws some.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib import resources
from math import cos, sin

import numpy as np

Vector = Sequence[float] | np.ndarray


@dataclass(frozen=True)
class Mesh:
    """Triangles.

    Args:
        vertices: (V, 3) float32 m.
        faces: (F, 3) int32.
        part: (F,) uint8, body part that a face belongs to, 0: not the person; None: all 0.
        later: (V, 3) m, the vertices at the end of the sensor's frame; None: they do not move.
    """

    vertices: np.ndarray
    faces: np.ndarray
    part: np.ndarray | None = None
    later: np.ndarray | None = None

    def moved(self, translation: Vector, yaw: float = 0.0) -> "Mesh":
        """The mesh rotated by `yaw` rad about z, then translated by `translation` (3,) m."""
        c, s = cos(yaw), sin(yaw)
        R, t = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]], np.float32), np.asarray(translation, np.float32)
        return self.mapped(lambda vertices: (vertices @ R if yaw else vertices) + t)

    def scaled(self, size: Vector) -> "Mesh":
        """The mesh scaled along x, y and z."""
        return self.mapped(lambda vertices: vertices * np.asarray(size, np.float32))

    def placed(self, rows: Sequence, origin: Sequence) -> "Mesh":
        """The mesh in another frame: rows (3, 3) are the images of x, y and z, then `origin` (3,) m is added."""
        R, t = np.array(rows, np.float32), np.array(origin, np.float32)
        return self.mapped(lambda vertices: vertices @ R + t)

    def mapped(self, function: Callable[[np.ndarray], np.ndarray]) -> "Mesh":
        """The mesh with a function applied to its vertices (V, 3) m, and to those of `later`."""
        later = None if self.later is None else function(self.later)
        return Mesh(function(self.vertices), self.faces, self.part, later)


def union(meshes: list[Mesh]) -> Mesh:
    """All meshes as one, vertices and faces concatenated in order."""
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


def union_of(*parts: Mesh | bool) -> Mesh:
    """The union of the parts that are meshes; others are False."""
    return union([part for part in parts if isinstance(part, Mesh)])


def at(mesh: Mesh, x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> Mesh:
    """The mesh rotated by `yaw` rad about z, then moved to x, y, z, m."""
    return mesh.moved((x, y, z), yaw)


QUAD_FACES = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
_BOX_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)], np.float32)
_BOX_FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4]]
    + [[1, 5, 7], [1, 7, 3]],
    np.int32,
)


def quad(half: float, slope: Vector) -> Mesh:
    """A square of half width `half` m around the origin, with z = slope (2,) times (x, y)."""
    x, y = half * float(slope[0]), half * float(slope[1])
    corners = [[-half, -half, -x - y], [half, -half, x - y], [half, half, x + y], [-half, half, y - x]]
    return Mesh(np.array(corners, np.float32), QUAD_FACES)


def grid(xs: np.ndarray, ys: np.ndarray, z: np.ndarray | float = 0.0) -> Mesh:
    """A grid of quads at heights z (X, Y) or at one height, m."""
    count = (len(xs), len(ys))
    vertices = np.stack([*np.meshgrid(xs, ys, indexing="ij"), np.broadcast_to(z, count)], -1).reshape(-1, 3)
    number = np.arange(len(vertices)).reshape(count)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], -2).reshape(-1, 3)
    return Mesh(vertices.astype(np.float32), faces.astype(np.int32))


def box(size: Vector) -> Mesh:
    """A box of size (3,) m standing on the origin."""
    return Mesh(_BOX_CORNERS * np.asarray(size, np.float32), _BOX_FACES)


def box_at(size: Vector, *position: float) -> Mesh:
    """A box of size (3,) m standing on x, y, z, m; omitted ones are 0."""
    return at(box(size), *position)


def boxes(middle: np.ndarray, size: np.ndarray) -> Mesh:
    """k boxes in one mesh: middle (k, 3) of their lower faces and size (k, 3), m."""
    middle, size = np.asarray(middle, np.float32), np.asarray(size, np.float32)
    vertices = _BOX_CORNERS * size[:, None] + middle[:, None]
    return Mesh(vertices.reshape(-1, 3), repeated(len(middle), 8, "box"))


_PIECES = {"box": _BOX_FACES, "quad": QUAD_FACES, "triangle": np.array([[0, 1, 2]], np.int32)}


@lru_cache(maxsize=512)
def repeated(count: int, corners: int, piece: str) -> np.ndarray:
    """Faces of `count` equal pieces (box, quad or triangle), each with its own `corners` vertices; read-only."""
    starts = np.arange(count, dtype=np.int32)[:, None, None] * np.int32(corners)
    faces = (_PIECES[piece] + starts).reshape(-1, 3)
    faces.setflags(write=False)
    return faces


# --- shipped meshes


def shape(name: str, x: float = 1.0, y: float = 1.0, z: float = 1.0) -> Mesh:
    """A fixed mesh of `tools/make_meshes.py`, scaled. "car" and "van" (heading along +x), "table", "wheeled bin",
    "traffic cone" (height 1) and "bonnet" have unit size; "pole" has radius 1 and height 1; "bench" and "bench without
    back" have length 1 along y."""
    return shipped_meshes()[name].scaled((x, y, z))


@cache
def shipped_meshes() -> dict[str, Mesh]:
    """All shipped meshes by name, loaded once; read-only."""
    with resources.files("lidarpose.synth").joinpath("assets/meshes.npz").open("rb") as file:
        arrays = dict(np.load(file, allow_pickle=False))
    names = [key.removesuffix("/faces") for key in arrays if key.endswith("/faces")]
    meshes = {name: Mesh(arrays[f"{name}/vertices"], arrays[f"{name}/faces"].astype(np.int32)) for name in names}
    for mesh in meshes.values():
        mesh.vertices.setflags(write=False)
        mesh.faces.setflags(write=False)
    return meshes


# --- meshes built from a few sizes each


def post(radius: float, height: float, *position: float) -> Mesh:
    """A round post standing on x, y, z, m; omitted ones are 0."""
    return at(shape("pole", radius, radius, height), *position)


def wall(length: float, height: float, *, thick: float = 0.2, opening: tuple | None = None) -> Mesh:
    """A wall along y. opening: (y min, y max, z of the sill, z of the top) of a window or a door, m."""
    if opening is None:
        return box(np.array([thick, length, height]))
    left, right, sill, top = opening
    half = length / 2
    pieces = [
        ((-half + left) / 2, 0.0, left + half, height),
        ((right + half) / 2, 0.0, half - right, height),
        ((left + right) / 2, top, right - left, height - top),
    ]
    if sill > 0:
        pieces.append(((left + right) / 2, 0.0, right - left, sill))
    middle = [(0.0, y, z) for y, z, _, _ in pieces]
    return boxes(
        np.array(middle), np.array([(thick, piece_width, piece_height) for _, _, piece_width, piece_height in pieces])
    )


def sign(height: float, wide: float) -> Mesh:
    """A traffic sign: a plate `wide` m across, facing +x, on a post of `height` m."""
    plate = np.array([0.02, wide, wide])
    return union([shape("sign post", 0.03, 0.03, height), box(plate).moved(np.array([0.04, 0, height - wide]))])


def rail_fence(length: float, height: float, rails: int) -> Mesh:
    """Posts at most 1.5 m apart along y, and `rails` horizontal bars; beams pass between them."""
    post_count = max(2, int(np.ceil(length / 1.5)) + 1)
    post_y = np.linspace(-length / 2, length / 2, post_count)
    middle, size = np.zeros((post_count + rails, 3)), np.empty((post_count + rails, 3))
    middle[:post_count, 1] = post_y
    size[:post_count] = (0.06, 0.06, height)
    middle[post_count:, 2] = (np.arange(rails) + 0.6) * (height / (rails + 0.2)) - 0.02
    size[post_count:] = (0.04, length, 0.05)
    return boxes(middle, size)


def lattice_fence(length: float, height: float, pitch: float, slat: float) -> Mesh:
    """Upright slats `slat` m wide every `pitch` m along y, and two thin rails; beams pass between them."""
    count = max(2, int(length / pitch))
    y = (np.arange(count) - (count - 1) / 2) * pitch
    vertices = np.zeros((count + 2, 4, 3), np.float32)
    half = np.array([-1, 1, 1, -1]) * (slat / 2)
    vertices[:count, :, 1] = y[:, None] + half
    vertices[:count, 2:, 2] = height
    vertices[count:, 1:3, 1] = length / 2
    vertices[count:, ::3, 1] = -length / 2
    for row, z in ((count, 0.15), (count + 1, 0.9)):
        vertices[row, :2, 2] = z * height
        vertices[row, 2:, 2] = z * height + 0.04
    return Mesh(vertices.reshape(-1, 3), repeated(count + 2, 4, "quad"))


# numbers of precomputed unit balls of leaf triangles, and of leaves in each
_LEAF_BALLS = 8
_LEAVES = 120


def foliage(size: Vector, leaves: int, leaf: float, rng: np.random.Generator) -> Mesh:
    """A bush or a hedge: `leaves` (at most 120) triangles of about `leaf` m in an ellipsoid of size (3,) m that
    stands on the origin; some beams pass through."""
    pick, turn, flip = rng.random(3).tolist()
    center, leaf_shape = _leaf_balls()[int(pick * _LEAF_BALLS)]
    c, s = np.cos(2 * np.pi * turn), np.sin(2 * np.pi * turn)
    rotation = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1 if flip < 0.5 else -1]], np.float32)
    half = np.asarray(size, np.float32) / 2
    # a leaf sticks out of the ellipsoid by no more than its own size, and not below the ground
    vertices = ((center[:leaves] @ rotation) * half)[:, None] + leaf_shape[:leaves] * np.float32(leaf)
    vertices[..., 2] = np.maximum(vertices[..., 2] + half[2], 0)
    return Mesh(vertices.reshape(-1, 3), repeated(min(leaves, _LEAVES), 3, "triangle"))


@lru_cache
def _leaf_balls() -> list[tuple[np.ndarray, np.ndarray]]:
    """Centers (120, 3) in the unit ball, denser near its surface like leaves, and shapes (120, 3, 3) of about 1 m."""
    balls = []
    for number in range(_LEAF_BALLS):
        rng = np.random.default_rng([number, 120])
        center = rng.normal(size=(_LEAVES, 3))
        center *= (rng.random((_LEAVES, 1)) ** 0.25) / np.linalg.norm(center, axis=1, keepdims=True)
        shape = rng.normal(0, 0.7, (_LEAVES, 3, 3))
        balls.append((center.astype(np.float32), (shape - shape.mean(1, keepdims=True)).astype(np.float32)))
    return balls


def grass(radius: float, height: float, blades: int, rng: np.random.Generator) -> Mesh:
    """`blades` thin upright triangles on a disk of `radius` m, up to `height` m high."""
    angle, distance, height_draw, lean_draw, width_draw = rng.random((5, blades))
    distance = radius * np.sqrt(distance)
    angle = angle * (2 * np.pi)
    foot = np.stack([distance * np.cos(angle), distance * np.sin(angle)], 1)
    half_blade = np.stack([np.sin(7 * angle), np.cos(7 * angle)], 1) * (0.008 + 0.03 * width_draw[:, None])
    vertices = np.zeros((blades, 3, 3), np.float32)
    vertices[:, 0, :2] = foot - half_blade
    vertices[:, 1, :2] = foot + half_blade
    vertices[:, 2, :2] = foot + (lean_draw[:, None] - 0.5) * 0.1
    vertices[:, 2, 2] = height * (0.4 + 0.6 * height_draw)
    return Mesh(vertices.reshape(-1, 3), repeated(blades, 3, "triangle"))
