"""Shapes of things that stand about in streets and rooms, as a LiDAR sees them: few triangles, right outlines.

All stand on the origin, their front along +x, their length along y where they have one; sizes in metres. What is
called with an rng is random in shape, all else is a function of its sizes. Legend: V vertices, F faces.
"""

from functools import lru_cache

import numpy as np

from lidarpose.synth.environment.mesh import Mesh, box, boxes, cone, loft, prism, repeated, union


def pole(radius: float, height: float) -> Mesh:
    """A lamp post, a trunk, a bollard."""
    return prism(radius, height)


def wheeled_bin(size: float, height: float) -> Mesh:
    """A wheeled bin: a square tub with a lid that stands over."""
    return _unit_wheeled_bin().scaled((size, size, height))


@lru_cache
def _unit_wheeled_bin() -> Mesh:
    tub = loft(((-0.45, 0.35, 0.45, 0.0, 0.93), (0.35, 0.35, 0.45, 0.0, 0.93)))
    return union([tub, box(np.array([1.0, 1.0, 0.07])).moved(np.array([0, 0, 0.93]))])


def wall(length: float, height: float, *, thick: float = 0.2, opening: tuple | None = None) -> Mesh:
    """A wall along y. opening: (from, to, sill, top) of a window or a door, the first two in y, all in metres."""
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
    return boxes(np.array(middle), np.array([(thick, wide, tall) for _, _, wide, tall in pieces]))


def bench(length: float, *, back: bool = True) -> Mesh:
    """A bench of `length` m along y: a seat 0.45 m high, two legs, a back."""
    mesh = _unit_bench(back)
    return mesh.scaled((1.0, length, 1.0))


@lru_cache
def _unit_bench(back: bool) -> Mesh:
    middle = [(0, 0, 0.40), (0, -0.42, 0), (0, 0.42, 0)]
    size = [(0.42, 1.0, 0.06), (0.38, 0.05, 0.4), (0.38, 0.05, 0.4)]
    if back:
        middle.append((-0.22, 0, 0.52))
        size.append((0.05, 1.0, 0.34))
    return boxes(np.array(middle), np.array(size))


def table(deep: float, length: float, height: float) -> Mesh:
    """A table: a top and four legs."""
    return _unit_table().scaled((deep, length, height))


@lru_cache
def _unit_table() -> Mesh:
    legs = [(x, y, 0.0) for x in (-0.44, 0.44) for y in (-0.46, 0.46)]
    return boxes(np.array([(0, 0, 0.95)] + legs), np.array([(1, 1, 0.05)] + [(0.06, 0.04, 0.95)] * 4))


def sign(height: float, wide: float) -> Mesh:
    """A traffic sign: a plate `wide` m across, facing +x, on a post of `height` m."""
    plate = np.array([0.02, wide, wide])
    return union([prism(0.03, height, 5), box(plate).moved(np.array([0.04, 0, height - wide]))])


def traffic_cone(height: float) -> Mesh:
    """A cone on its square foot, half as wide as it is high."""
    return _unit_cone().scaled((height, height, height))


@lru_cache
def _unit_cone() -> Mesh:
    return union([cone(0.2, 1.0), box(np.array([0.5, 0.5, 0.05]))])


# outlines of passenger cars in units of length, width and height: the sill, the bonnet and the boot at 0.25 to 0.7 of
# the height, glass that leans, a roof narrower than the doors. Stations: x, half width below and above, bottom, top
_CAR_BODY = (
    (-0.50, 0.40, 0.42, 0.25, 0.60),
    (-0.46, 0.48, 0.48, 0.15, 0.68),
    (0.20, 0.50, 0.50, 0.13, 0.66),
    (0.44, 0.48, 0.46, 0.15, 0.55),
    (0.50, 0.38, 0.38, 0.20, 0.45),
)
_CAR_CABIN = (
    (-0.42, 0.44, 0.38, 0.62, 0.70),
    (-0.30, 0.46, 0.38, 0.62, 0.97),
    (0.02, 0.46, 0.38, 0.62, 1.00),
    (0.22, 0.46, 0.42, 0.62, 0.66),
)
_VAN_BODY = (
    (-0.50, 0.48, 0.46, 0.15, 0.97),
    (0.22, 0.50, 0.46, 0.13, 1.00),
    (0.36, 0.50, 0.45, 0.13, 0.60),
    (0.50, 0.42, 0.40, 0.15, 0.42),
)
_WHEELS = tuple((x, y) for x in (-0.31, 0.31) for y in (-0.43, 0.43))


def car(length: float, wide: float, height: float) -> Mesh:
    """A passenger car that heads along +x, on four wheels."""
    return _unit_car().scaled((length, wide, height))


@lru_cache
def _unit_car() -> Mesh:
    return union([loft(_CAR_BODY), loft(_CAR_CABIN), _wheels(0.42)])


def van(length: float, wide: float, height: float) -> Mesh:
    """A van that heads along +x."""
    return _unit_van().scaled((length, wide, height))


@lru_cache
def _unit_van() -> Mesh:
    return union([loft(_VAN_BODY), _wheels(0.3)])


def _wheels(tall: float) -> Mesh:
    middle = [(x, y, 0.0) for x, y in _WHEELS]
    return boxes(np.array(middle), np.array([(0.14, 0.12, tall)] * 4))


def bonnet(wide: float, height: float, deep: float = 1.0) -> Mesh:
    """The front of a car as it is seen over: rounded in front (+x), `height` m at the windscreen's foot."""
    return loft(_BONNET).scaled((deep, wide, height))


_BONNET = (
    (-0.5, 0.48, 0.45, 0.0, 1.0),
    (0.3, 0.49, 0.45, 0.0, 0.88),
    (0.47, 0.46, 0.40, 0.0, 0.70),
    (0.5, 0.40, 0.38, 0.1, 0.55),
)


def rail_fence(length: float, height: float, rails: int) -> Mesh:
    """Posts 1.5 m apart or less along y, and `rails` bars between them: beams pass between."""
    posts = max(2, int(np.ceil(length / 1.5)) + 1)
    at = np.linspace(-length / 2, length / 2, posts)
    middle, size = np.zeros((posts + rails, 3)), np.empty((posts + rails, 3))
    middle[:posts, 1] = at
    size[:posts] = (0.06, 0.06, height)
    middle[posts:, 2] = (np.arange(rails) + 0.6) * (height / (rails + 0.2)) - 0.02
    size[posts:] = (0.04, length, 0.05)
    return boxes(middle, size)


def lattice_fence(length: float, height: float, pitch: float, slat: float) -> Mesh:
    """Upright slats `slat` m wide every `pitch` m along y, and two thin rails: what stands behind shows through."""
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


# leaves of a cloud of foliage, drawn once: unit balls of triangles
_LEAF_BALLS = 8
_LEAVES = 120


def foliage(size: np.ndarray, leaves: int, leaf: float, rng: np.random.Generator) -> Mesh:
    """A bush or a hedge: `leaves` (at most 120) triangles of about `leaf` m in an ellipsoid of size (3,) m that
    stands on the origin; some beams pass."""
    pick, turn, flip = rng.random(3).tolist()
    center, shape = _leaf_balls()[int(pick * _LEAF_BALLS)]
    c, s = np.cos(2 * np.pi * turn), np.sin(2 * np.pi * turn)
    turned = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1 if flip < 0.5 else -1]], np.float32)
    half = np.asarray(size, np.float32) / 2
    # a leaf may not stick out of the ellipsoid by more than itself, nor into the ground
    vertices = ((center[:leaves] @ turned) * half)[:, None] + shape[:leaves] * np.float32(leaf)
    vertices[..., 2] = np.maximum(vertices[..., 2] + half[2], 0)
    return Mesh(vertices.reshape(-1, 3), repeated(min(leaves, _LEAVES), 3, "triangle"))


@lru_cache
def _leaf_balls() -> list[tuple[np.ndarray, np.ndarray]]:
    """Centers (120, 3) in the unit ball, denser at the rim as leaves are, and shapes (120, 3, 3) of about 1 m."""
    balls = []
    for number in range(_LEAF_BALLS):
        rng = np.random.default_rng([number, 120])
        center = rng.normal(size=(_LEAVES, 3))
        center *= (rng.random((_LEAVES, 1)) ** 0.25) / np.linalg.norm(center, axis=1, keepdims=True)
        shape = rng.normal(0, 0.7, (_LEAVES, 3, 3))
        balls.append((center.astype(np.float32), (shape - shape.mean(1, keepdims=True)).astype(np.float32)))
    return balls


def grass(radius: float, height: float, blades: int, rng: np.random.Generator) -> Mesh:
    """`blades` upright thin triangles on a disc of `radius` m, up to `height` m high."""
    angle, far, tall, lean, wide = rng.random((5, blades))
    far = radius * np.sqrt(far)
    angle = angle * (2 * np.pi)
    foot = np.stack([far * np.cos(angle), far * np.sin(angle)], 1)
    across = np.stack([np.sin(7 * angle), np.cos(7 * angle)], 1) * (0.008 + 0.03 * wide[:, None])
    vertices = np.zeros((blades, 3, 3), np.float32)
    vertices[:, 0, :2] = foot - across
    vertices[:, 1, :2] = foot + across
    vertices[:, 2, :2] = foot + (lean[:, None] - 0.5) * 0.1
    vertices[:, 2, 2] = height * (0.4 + 0.6 * tall)
    return Mesh(vertices.reshape(-1, 3), repeated(blades, 3, "triangle"))
