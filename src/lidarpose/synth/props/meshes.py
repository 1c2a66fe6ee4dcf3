"""The meshes of what people carry, wear and ride, built once: closed, few triangles, each in a frame of its own.

x is ahead, y left, z up; metres, or 1 where the user of a mesh scales it.
"""

from functools import lru_cache
from math import hypot, pi

import numpy as np

from lidarpose.synth.environment.mesh import Mesh, box, boxes, union


@lru_cache
def unit_box() -> Mesh:
    """1 x 1 x 1, standing on the origin."""
    return box((1.0, 1.0, 1.0))


@lru_cache
def tube(sides: int = 5) -> Mesh:
    """An upright prism of radius 1 from 0 to 1, closed."""
    return _turned(((0.0, 1.0), (1.0, 1.0)), sides)


@lru_cache
def bag() -> Mesh:
    """A bag of size 1 hanging from the origin: wider below, its handles the topmost quarter."""
    body = np.array([(-0.5, -0.5, -1), (0.5, -0.5, -1), (0.5, 0.5, -1), (-0.5, 0.5, -1)])
    top = body * [0.92, 0.7, 0] + [0, 0, -0.28]
    handles = body * [0.25, 0.1, 0]
    return _hull([body, top, handles])


@lru_cache
def pack() -> Mesh:
    """A rucksack of size 1 that stands on the origin, its flat side to the back at x = 0, round behind."""
    rings = []
    for z, deep, wide in ((0.0, 0.8, 0.9), (0.12, 1.0, 1.0), (0.6, 0.95, 1.0), (0.9, 0.6, 0.85), (1.0, 0.25, 0.6)):
        half = wide / 2
        outline = [(0, half), (-0.7 * deep, 0.9 * half), (-deep, 0.5 * half)]
        outline += [(-deep, -0.5 * half), (-0.7 * deep, -0.9 * half), (0, -half)]
        rings.append(np.array([(x, y, z) for x, y in outline]))
    return _hull(rings)


@lru_cache
def ball() -> Mesh:
    """Of radius 1 about the origin."""
    around = np.linspace(-pi / 2, pi / 2, 6)[1:-1]
    return _turned(tuple((float(np.sin(a)), float(np.cos(a))) for a in around), 8, tips=(-1.0, 1.0))


@lru_cache
def umbrella() -> Mesh:
    """Open: from the hand at the origin to 1 up; the canopy's diameter is 1, its rim at 0.72."""
    shaft = tube(4).scaled((0.008, 0.008, 0.95))
    rings = ((0.745, 0.47), (0.72, 0.5), (0.86, 0.33), (0.95, 0.12))
    return union([shaft, _turned(rings, 8, tips=(0.84, 1.0))])


@lru_cache
def suitcase() -> Mesh:
    """On wheels, pulled: the hand at (0, 0, 1), wheels at the origin, the case's height 0.68, its bar above."""
    case = box((0.28, 0.42, 0.62)).moved((-0.14, 0, 0.06))
    sides = [box((0.02, 0.02, 0.34)).moved((-0.02, y, 0.66)) for y in (-0.13, 0.13)]
    return union([case, *sides, box((0.03, 0.28, 0.03)).moved((-0.02, 0, 0.98)), _wheels(0.05, (-0.04,), 0.17, 0.04)])


@lru_cache
def pram() -> Mesh:
    """Its handle at x = 0 and z = 1, the rest ahead of it; wheels on the ground."""
    basket = np.array([(0.30, 0.18), (1.0, 0.18), (1.0, -0.18), (0.30, -0.18)])
    rings = [np.column_stack([basket * s + [(1 - s) * 0.65, 0], np.full(4, z)]) for z, s in ((0.48, 0.75), (0.78, 1.1))]
    hood = np.array([(0.30, 0.2), (0.62, 0.2), (0.62, -0.2), (0.30, -0.2)])
    folded = [
        np.column_stack([hood * [w, 1] + [0.3 * (1 - w), 0], np.full(4, z)]) for z, w in ((0.76, 1.2), (1.05, 0.7))
    ]
    rods = []
    for y in (-0.24, 0.24):
        rods += [rod((0.0, y, 1.0), (0.98, y, 0.13)), rod((0.8, y, 0.5), (0.2, y, 0.13))]
    handle = box((0.03, 0.5, 0.03)).moved((0, 0, 0.985))
    return union([_hull(rings), _hull(folded), *rods, handle, _wheels(0.13, (0.2, 0.98), 0.26, 0.04, sides=4)])


@lru_cache
def cart() -> Mesh:
    """A shopping trolley or a hand cart with a load: its handle at x = 0 and z = 1, 0.9 long and 0.5 wide."""
    low = np.array([(0.2, 0.2), (0.9, 0.2), (0.9, -0.2), (0.2, -0.2)])
    high = np.array([(0.08, 0.26), (0.95, 0.26), (0.95, -0.26), (0.08, -0.26)])
    load = _hull([np.column_stack([low, np.full(4, 0.45)]), np.column_stack([high, np.full(4, 0.92)])])
    bed = box((0.85, 0.46, 0.05)).moved((0.52, 0, 0.16))
    rods = [rod((0.12, y, 0.18), (0.0, y, 1.0)) for y in (-0.24, 0.24)]
    handle = box((0.035, 0.5, 0.035)).moved((0, 0, 0.98))
    return union([load, bed, *rods, handle, _wheels(0.07, (0.16, 0.88), 0.22, 0.035)])


@lru_cache
def chair() -> Mesh:
    """A seat as high and wide as 1 that one sits on above the origin, its legs, and a back half as high again."""
    middle = [(0.05, 0, 0.9), (-0.2, 0, 1.0)] + [(x, y, 0) for x in (-0.17, 0.24) for y in (-0.45, 0.45)]
    size = [(0.46, 1.0, 0.1), (0.04, 1.0, 0.95)] + [(0.035, 0.08, 0.9)] * 4
    return boxes(np.array(middle), np.array(size))


@lru_cache
def bench() -> Mesh:
    """As `chair`: a seat without back on two supports."""
    middle, size = (
        [(0.05, 0, 0.88), (0.05, -0.4, 0), (0.05, 0.4, 0)],
        [(0.4, 1.0, 0.12), (0.3, 0.06, 0.88), (0.3, 0.06, 0.88)],
    )
    return boxes(np.array(middle), np.array(size))


@lru_cache
def wheelchair() -> Mesh:
    """One sits 0.5 above the origin; without its foot rests."""
    flat = [((0.06, 0, 0.45), (0.46, 0.44, 0.05)), ((-0.2, 0, 0.5), (0.04, 0.44, 0.42))]
    for y in (-0.235, 0.235):
        flat += [((0.06, y, 0.68), (0.34, 0.05, 0.035)), ((-0.2, y, 0.2), (0.03, 0.03, 0.75))]
        flat += [((-0.27, y, 0.94), (0.15, 0.03, 0.03)), ((0.28, y, 0.14), (0.03, 0.03, 0.55))]
    middle, size = (np.array(x) for x in zip(*flat, strict=True))
    wheels = [rim(0.3, 0.025, sides=10).moved((-0.08, y, 0.3)) for y in (-0.3, 0.3)]
    return union([boxes(middle, size), *wheels, _wheels(0.08, (0.32,), 0.235, 0.03, sides=6)])


# of the bicycle, on the ground, the saddle above the origin: where (x, z) its parts are
SADDLE, CRANK, REAR, FRONT, NECK = (0.0, 0.97), (0.17, 0.28), (-0.29, 0.34), (0.77, 0.34), (0.6, 0.84)


@lru_cache
def bicycle() -> Mesh:
    """Frame, saddle and wheels; bars and pedals depend on the rider."""
    seat, head, low = (0.03, 0.78), (0.59, 0.82), (0.63, 0.7)
    tubes = [((0.0, 0.94), CRANK), (CRANK, REAR), (REAR, seat), (seat, head), (CRANK, low), (NECK, FRONT)]
    parts = [rod((ax, 0.0, az), (bx, 0.0, bz), 0.018) for (ax, az), (bx, bz) in tubes]
    saddle = [np.array([(-0.13, 0.08, z), (0.15, 0.02, z), (0.15, -0.02, z), (-0.13, -0.08, z)]) for z in (0.92, 0.97)]
    parts += [_hull(saddle), *(rim(0.34, 0.02, sides=11).moved((x, 0, z)) for x, z in (REAR, FRONT))]
    return union(parts)


@lru_cache
def rim(radius: float, half: float, *, sides: int) -> Mesh:
    """A wheel about the y axis that one sees through: a ring with the tread outside and two flanks, closed."""
    turn = 2 * pi * np.arange(sides) / sides
    circle = np.stack([np.cos(turn), 0 * turn, np.sin(turn)], 1)
    aside = np.array([0, half, 0])
    rings = [circle * radius - aside, circle * radius + aside, circle * (radius - 0.045)]
    k = np.arange(sides)
    n = (k + 1) % sides
    faces = []
    for a, b in ((0, sides), (sides, 2 * sides), (2 * sides, 0)):
        faces += [np.stack([a + k, b + n, a + n], 1), np.stack([a + k, b + k, b + n], 1)]
    return Mesh(np.concatenate(rings).astype(np.float32), np.concatenate(faces).astype(np.int32))


@lru_cache
def hat(brim: float) -> Mesh:
    """A cap or a helmet (brim 0) or a hat for a head of half length and half width 1, its edge at z = 0."""
    rings = [(0.0, 1.0), (0.55, 0.95), (0.95, 0.6)]
    if brim:
        rings = [(-0.06, 1 + brim), (0.03, 1 + brim), (0.06, 1.0), *rings[1:]]
    return _turned(tuple(rings), 10, tips=(rings[0][0], 1.05))


def rod_rows(start: tuple, end: tuple, radius: float) -> tuple[list, list]:
    """Rows (3, 3) and an origin that put `tube` between two points (x, y, z)."""
    dx, dy, dz = (b - a for a, b in zip(start, end, strict=True))
    long = max((dx * dx + dy * dy + dz * dz) ** 0.5, 1e-6)
    flat = hypot(dx, dy)
    aside = (-dy / flat, dx / flat, 0.0) if flat > 1e-3 * long else (0.0, 1.0, 0.0)
    x, y, z = aside
    over = (z * dy / long - y * dz / long, x * dz / long - z * dx / long, y * dx / long - x * dy / long)
    return [[radius * a for a in aside], [radius * a for a in over], [dx, dy, dz]], list(start)


def rod(start: tuple, end: tuple, radius: float = 0.015) -> Mesh:
    """A three-sided `tube` between two points (x, y, z)."""
    return tube(3).placed(*rod_rows(start, end, radius))


def _wheels(radius: float, x: tuple, half: float, wide: float, *, sides: int = 5) -> Mesh:
    """Small solid wheels about the y axis, on the ground, two at each x."""
    disc = tube(sides).scaled((radius, radius, wide))
    turn = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], np.float32)
    upright = Mesh(disc.vertices @ turn + np.float32([0, wide / 2, radius]), disc.faces)
    return union([upright.moved((at, side * half, 0)) for at in x for side in (-1, 1)])


def _turned(rings: tuple, sides: int, *, tips: tuple | None = None) -> Mesh:
    """A closed surface about the z axis through rings (z, radius), from the lowest; `tips`: z of its two ends, by
    default in the planes of the first and last ring."""
    turn = 2 * pi * np.arange(sides) / sides
    outlines = [np.stack([r * np.cos(turn), r * np.sin(turn), np.full(sides, z)], 1) for z, r in rings]
    return _hull(outlines, tips or (rings[0][0], rings[-1][0]))


def _hull(outlines: list, tips: tuple | None = None) -> Mesh:
    """A closed surface through outlines (K, 3), each counter-clockwise seen from above, from the lowest to the highest,
    with a fan at both ends, about the ends' middles or at the heights `tips`."""
    outlines = [np.asarray(o, float) for o in outlines]
    sides = len(outlines[0])
    ends = [outlines[0].mean(0), outlines[-1].mean(0)]
    if tips:
        ends = [np.array([*e[:2], z]) for e, z in zip(ends, tips, strict=True)]
    vertices = np.concatenate([*outlines, ends])
    k = np.arange(sides)
    n = (k + 1) % sides
    faces = []
    for a in range(0, sides * (len(outlines) - 1), sides):
        faces += [np.stack([a + k, a + n, a + sides + n], 1), np.stack([a + k, a + sides + n, a + sides + k], 1)]
    a, low, high = sides * (len(outlines) - 1), len(vertices) - 2, len(vertices) - 1
    faces += [np.stack([0 * k + low, n, k], 1), np.stack([0 * k + high, a + k, a + n], 1)]
    mesh = Mesh(vertices.astype(np.float32), np.concatenate(faces).astype(np.int32))
    return _outwards(mesh)


def _outwards(mesh: Mesh) -> Mesh:
    """The mesh with faces counter-clockwise seen from outside."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces].astype(float), 1, 0)
    inside_out = (np.cross(a, b) * c).sum() < 0
    return Mesh(mesh.vertices, np.ascontiguousarray(mesh.faces[:, ::-1])) if inside_out else mesh
