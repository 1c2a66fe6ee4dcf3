"""Things that stand where people stand, and that a detector may mistake for people (false positives).

Each stands on the origin, with its front along +x and its length along y; sizes in meters. `THINGS` has their names,
their weights outdoors and indoors, and which of them are held out from training. Builders take uniform numbers (8,) and
a random generator.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from math import pi

import numpy as np

from lidarpose.synth.environment import mesh as shapes, plants
from lidarpose.synth.environment.facades import window_bars
from lidarpose.synth.environment.mesh import Mesh, at, box_at, post, shape, union, union_of

Uniforms = np.ndarray
Builder = Callable[[Uniforms, np.random.Generator], Mesh]


@dataclass(frozen=True)
class Thing:
    """A kind of thing: its builder, its weights outdoors and indoors, and whether it is held out from training."""

    build: Builder
    outdoors: float = 0.0
    indoors: float = 0.0
    left_out: bool = False


def _bars(u: Uniforms, rng: np.random.Generator) -> Mesh:
    """A barred opening in a piece of wall."""
    width, sill = 0.8 + u[0], 0.3 + 0.7 * u[1]
    wall = shapes.wall(width + 0.8, 2.4 + u[2], thick=0.25, opening=(-width / 2, width / 2, sill, sill + 1.3))
    return union([wall, at(window_bars(width, 1.3, rng), 0.1, 0, sill)])


def _wall_end(u: Uniforms, rng: np.random.Generator) -> Mesh:
    """A short wall seen from its end, or a corner of two walls."""
    height, length = 1.2 + 1.8 * u[0], 0.5 + 2.5 * u[1]
    wall = box_at((length, 0.15 + 0.3 * u[2], height), -length / 2)
    if u[3] < 0.4:
        side = 1 if u[4] < 0.5 else -1
        return union([wall, box_at((0.2, 0.4 + u[5], height), 0, side * (0.2 + u[5] / 2))])
    # a post at the end, with a cap
    return union_of(wall, u[3] < 0.7 and box_at((0.3, 0.3, height + 0.1)))


def _cabinet(u: Uniforms, rng: np.random.Generator) -> Mesh:
    """A street cabinet for power or telephone: a plinth, a body, a roof."""
    depth, width, height = 0.25 + 0.3 * u[0], 0.4 + 0.9 * u[1] ** 2, 0.9 + 0.9 * u[2]
    return union_of(
        box_at((depth, width, 0.15)),
        box_at((0.94 * depth, 0.96 * width, height - 0.15), 0, 0, 0.15),
        u[3] < 0.6 and box_at((depth + 0.06, width + 0.06, 0.05), 0, 0, height),
        u[4] < 0.3 and box_at((depth, 0.5 * width + 0.2, 0.7 * height), 0, 0.75 * width + 0.15),
    )


def _pillar(u: Uniforms, rng: np.random.Generator) -> Mesh:
    """A round or rectangular pillar, some with a base."""
    half, height = 0.1 + 0.22 * u[0], 1.6 + 2.4 * u[1]
    mesh = post(half, height) if u[2] < 0.5 else box_at((2 * half, 2 * half * (0.6 + 0.8 * u[5]), height))
    return union_of(mesh, u[3] < 0.4 and box_at((2.6 * half, 2.6 * half, 0.15 + 0.6 * u[4] ** 2)))


# --- street furniture and other objects


def _bollard(u: Uniforms, rng: np.random.Generator) -> Mesh:
    half, height = 0.05 + 0.12 * u[0], 0.5 + 0.8 * u[1]
    mesh = post(half, height) if u[2] < 0.7 else box_at((2 * half, 2 * half, height))
    return union_of(mesh, u[3] < 0.4 and at(shape("ball", 1.15 * half, 1.15 * half, 1.1 * half), z=height))


def _pole(u: Uniforms, rng: np.random.Generator) -> Mesh:
    """A lamp post, a flagpole, a post with a box on it."""
    radius, height = 0.025 + 0.1 * u[0] ** 2, 1.5 + 6 * u[1]
    foot = u[2] < 0.3 and post(1.7 * radius, 0.8 + 0.5 * u[3])
    # a box, a bin or a parking meter at chest height
    box = u[4] < 0.35 and box_at((0.2 + 0.2 * u[5], 0.25 + 0.2 * u[6], 0.3 + 0.5 * u[7]), 0.1, 0, 0.6 + 0.7 * u[3])
    return union_of(post(radius, height), foot, box)


def _sign(u: Uniforms, rng: np.random.Generator) -> Mesh:
    if u[0] < 0.55:
        return shapes.sign(1.7 + 1.2 * u[1], 0.35 + 0.5 * u[2])
    if u[0] < 0.8:
        # a board on two feet
        width, height = 0.5 + 0.8 * u[1], 1.0 + 1.0 * u[2]
        board = box_at((0.04, width, 0.75 * height), 0, 0, 0.25 * height)
        return union([board, post(0.03, height, 0, width / 2), post(0.03, height, 0, -width / 2)])
    # an advertising column or a stele
    return box_at((0.12 + 0.3 * u[1] ** 2, 0.5 + 0.6 * u[2], 1.3 + 1.1 * u[3]))


def _bin(u: Uniforms, rng: np.random.Generator) -> Mesh:
    if u[0] < 0.6:
        return shape("wheeled bin", 0.5 + 0.3 * u[1], 0.45 + 0.35 * u[2], 0.9 + 0.4 * u[3])
    if u[0] < 0.85:
        return post(0.18 + 0.12 * u[1], 0.7 + 0.4 * u[2])
    return box_at((0.8 + 0.5 * u[1], 1.2 + 0.8 * u[2], 1.1 + 0.4 * u[3]))


def _bench(u: Uniforms, rng: np.random.Generator) -> Mesh:
    return shape("bench" if u[0] < 0.65 else "bench without back", 1.0, 1.2 + 0.8 * u[1])


def _chair(u: Uniforms, rng: np.random.Generator) -> Mesh:
    """A single chair, a stack, or an office chair with a high back."""
    chair = shape("chair", 0.9 + 0.3 * u[0], 0.42 + 0.15 * u[1], 0.43 + 0.06 * u[2])
    if u[3] < 0.15:
        return union([at(chair, z=0.09 * k) for k in range(2 + int(4 * u[4]))])
    return union_of(chair, u[3] < 0.35 and box_at((0.08, 0.45, 0.4), -0.2, 0, 0.8))


def _table(u: Uniforms, rng: np.random.Generator) -> Mesh:
    length, depth, height = 0.6 + 1.4 * u[0], 0.5 + 0.5 * u[1], 0.7 + 0.4 * u[2] ** 3
    # a screen, a case or a pile on it
    size = (0.05 + 0.3 * u[4], 0.3 + 0.3 * u[5], 0.2 + 0.4 * u[6])
    return union_of(
        shape("table", depth, length, height), u[3] < 0.4 and box_at(size, 0, length * (u[7] - 0.5) / 2, height)
    )


def _cart(u: Uniforms, rng: np.random.Generator) -> Mesh:
    if u[0] < 0.4:
        return at(shape("trolley"), -0.45)
    if u[0] < 0.65:
        return at(shape("pram"), -0.5)
    # a cage or a luggage cart
    depth, width, height = 0.6 + 0.3 * u[1], 0.5 + 0.3 * u[2], 0.9 + 0.8 * u[3]
    sides = [at(shapes.lattice_fence(width, height, 0.12, 0.02), side * depth / 2) for side in (-1, 1)]
    load = box_at((depth, width, 0.5 * height * u[4]), 0, 0, 0.2)
    return union([box_at((depth, width, 0.06), 0, 0, 0.15), load, *sides])


def _bicycle(u: Uniforms, rng: np.random.Generator) -> Mesh:
    """One parked bicycle, or a few side by side."""
    size = 0.9 + 0.2 * u[0]
    bicycle = union([shape("bicycle"), box_at((0.04, 0.56, 0.035), 0.52, 0, 1.02)]).scaled((size,) * 3)
    bicycle = union_of(bicycle, u[1] < 0.3 and box_at((0.3, 0.35, 0.25), -0.4 if u[2] < 0.5 else 0.7, 0, 0.75))
    count = 1 + int(4 * max(0.0, u[3] - 0.5))
    return union([at(bicycle, 0.05 * k, 0.45 * k + 0.05 * u[4], yaw=0.1 * (u[5] - 0.5)) for k in range(count)])


def moped() -> Mesh:
    """A scooter facing +x, with the middle of its seat 0.75 m above the origin and its foot board at 0.28 m."""
    return union_of(
        at(shape("ball", 0.23, 0.06, 0.23), 0.85, 0, 0.23),
        at(shape("ball", 0.23, 0.07, 0.23), -0.35, 0, 0.23),
        box_at((0.5, 0.3, 0.08), 0.42, 0, 0.2),
        box_at((0.75, 0.3, 0.38), -0.15, 0, 0.3),
        box_at((0.7, 0.26, 0.07), -0.1, 0, 0.68),
        box_at((0.08, 0.42, 0.55)).placed([[1, 0, 0], [0, 1, 0], [-0.2, 0, 1]], (0.76, 0, 0.3)),
        box_at((0.14, 0.16, 0.2), 0.64, 0, 0.85),
        box_at((0.04, 0.62, 0.04), 0.58, 0, 1.0),
        box_at((0.16, 0.1, 0.5), 0.85, 0, 0.15),
    )


def _moped(u: Uniforms, rng: np.random.Generator) -> Mesh:
    mesh = moped().scaled((0.9 + 0.2 * u[0], 1.0, 0.9 + 0.2 * u[1]))
    # a top box or a wind screen
    extra = box_at((0.35, 0.38, 0.35), -0.6, 0, 0.75) if u[3] < 0.6 else box_at((0.04, 0.45, 0.5), 0.66, 0, 0.95)
    return union_of(mesh, u[2] < 0.35 and extra)


def _cone(u: Uniforms, rng: np.random.Generator) -> Mesh:
    height = 0.4 + 0.6 * u[0]
    return shape("traffic cone", 0.9 * height, 0.9 * height, height)


def _sacks(u: Uniforms, rng: np.random.Generator) -> Mesh:
    """Sacks, boxes or cases in a heap."""
    parts, top = [], 0.0
    for _ in range(1 + int(5 * u[0])):
        a, b, c, d, e = rng.random(5)
        size = (0.3 + 0.4 * a, 0.3 + 0.5 * b, 0.2 + 0.4 * c)
        bottom = top if u[1] < 0.5 else 0.0
        placement = {"x": 0.4 * (d - 0.5), "y": (0.3 if u[1] < 0.5 else 1.0) * (e - 0.5), "z": bottom, "yaw": pi * d}
        half = np.array(size) / 2
        part = box_at(size) if u[2] < 0.5 else at(shape("ball", *half), z=half[2] * 0.9)
        parts.append(at(part, **placement))
        top = min(top + 0.85 * size[2], 1.5)
    return union(parts)


def _fence(u: Uniforms, rng: np.random.Generator) -> Mesh:
    length, height = 1.5 + 5 * u[0], 0.7 + 1.2 * u[1]
    if u[2] < 0.35:
        return shapes.rail_fence(length, height, 2 + int(3 * u[3]))
    if u[2] < 0.8:
        return shapes.lattice_fence(length, height, 0.08 + 0.14 * u[3], 0.015 + 0.06 * u[4])
    # boards between posts
    return union([box_at((0.04, length, height - 0.1), 0, 0, 0.1), shapes.rail_fence(length, height + 0.05, 1)])


def car(u: Uniforms, rng: np.random.Generator) -> Mesh:
    """A car, a van or a truck, heading along +x."""
    if u[0] < 0.75:
        return shape("car", 3.6 + 1.3 * u[1], 1.65 + 0.25 * u[2], 1.38 + 0.35 * u[3])
    if u[0] < 0.95:
        return shape("van", 4.4 + 1.6 * u[1], 1.85 + 0.25 * u[2], 1.8 + 0.9 * u[3])
    return union([box_at((6 + 3 * u[1], 2.4, 2.2 + u[2]), 0, 0, 0.8), box_at((5, 2.2, 0.5), 0, 0, 0.3)])


def _car_corner(u: Uniforms, rng: np.random.Generator) -> Mesh:
    """The corner of a car or a van between occluders that hide the rest, so that only a strip is visible."""
    vehicle, occluder = car(0.9 * u, rng), box_at((0.15, 2.0 + 2 * u[4], 1.6 + 0.8 * u[5]))
    gap = 0.25 + 0.5 * u[6]
    low, high = vehicle.vertices.min(0), vehicle.vertices.max(0)
    lateral_offset = (2.0 + 2 * u[4]) / 2
    vehicle = at(vehicle, -(high[0] if u[7] < 0.5 else -low[0]), (u[3] - 0.5) * high[1] * 2)
    return union([vehicle, at(occluder, 0.8, gap + lateral_offset), at(occluder, 0.8, -lateral_offset)])


# --- indoors


def _shelf(u: Uniforms, rng: np.random.Generator) -> Mesh:
    """A shelf: uprights, boards and the things on them."""
    depth, length, height = 0.3 + 0.3 * u[0], 0.7 + 1.8 * u[1], 1.2 + 1.2 * u[2]
    levels = 3 + int(3 * u[3])
    centers = [(0, side * length / 2, 0) for side in (-1, 1)]
    sizes = [(depth, 0.03, height)] * 2
    for k in range(levels):
        z = 0.05 + k * (height - 0.1) / (levels - 1)
        centers.append((0, 0, z))
        sizes.append((depth, length, 0.025))
        for y in rng.uniform(-0.45, 0.45, 3) * length:
            centers.append((0, y, z + 0.02))
            sizes.append((depth * 0.8, 0.1 + 0.3 * rng.random(), 0.1 + 0.2 * rng.random()))
    if u[4] < 0.5:
        centers.append((-depth / 2, 0, 0))
        sizes.append((0.01, length, height))
    return shapes.boxes(np.array(centers), np.array(sizes))


def _cupboard(u: Uniforms, rng: np.random.Generator) -> Mesh:
    depth, width, height = 0.35 + 0.3 * u[0], 0.5 + 1.2 * u[1], 0.8 + 1.4 * u[2]
    door = u[3] < 0.35 and box_at((0.5, 0.02, height), depth / 2 + 0.25, width / 2)
    case = u[4] < 0.3 and box_at((0.3, 0.4, 0.3), 0, width * (u[5] - 0.5) / 2, height)
    return union_of(box_at((depth, width, height)), door, case)


def _door(u: Uniforms, rng: np.random.Generator) -> Mesh:
    """An open door leaf with a piece of its frame."""
    leaf = box_at((0.04, 0.85, 2.0), 0, 0.42).moved((0, 0, 0), 1.5 * u[0])
    return union([leaf, box_at((0.12, 0.08, 2.1), 0, -0.05)])


def _floor_lamp(u: Uniforms, rng: np.random.Generator) -> Mesh:
    """A floor lamp, a coat stand, a music stand, a screen on a stand."""
    height = 1.2 + 0.7 * u[0]
    shade = u[2] < 0.4 and post(0.12 + 0.12 * u[3], 0.25, 0, 0, height - 0.1)
    screen = 0.4 <= u[2] < 0.7 and box_at((0.05, 0.5 + 0.5 * u[3], 0.35 + 0.3 * u[4]), 0, 0, height - 0.3)
    return union_of(post(0.015 + 0.01 * u[1], height), post(0.14, 0.03), shade, screen)


# --- pieces


def _fragment(u: Uniforms, rng: np.random.Generator) -> Mesh:
    """A person-sized or smaller piece of no particular thing: a plate, foliage, a corner, some posts or boxes."""
    height, width = 0.5 + 1.4 * u[0], 0.15 + 0.6 * u[1]
    if u[2] < 0.3:
        piece = box_at((0.05, width, height))
    elif u[2] < 0.5:
        piece = shapes.foliage((width, width, height), 40 + int(70 * u[3]), 0.1, rng)
    elif u[2] < 0.7:
        half = box_at((0.05, width, height), 0, width / 2)
        piece = union([half, half.moved((0, 0, 0), 1.2 + 0.6 * u[3])])
    elif u[2] < 0.85:
        piece = union([post(0.05, height * (0.4 + 0.6 * rng.random()), 0, width * rng.random()) for _ in range(4)])
    else:
        piece = union([box_at(0.15 + 0.35 * rng.random(3), *(rng.random(3) * [width, width, height])) for _ in "abc"])
    return at(piece, z=0.7 * max(0.0, u[4] - 0.6))


def _floating(u: Uniforms, rng: np.random.Generator) -> Mesh:
    """A thing that hangs, or stands on legs too thin to be scanned: a sign, a lamp, a banner, a branch, a machine."""
    z, height, width = 0.35 + 1.1 * u[0], 0.3 + 0.9 * u[1], 0.2 + 0.7 * u[2]
    if u[3] < 0.5:
        return box_at((0.04 + 0.3 * u[4] ** 2, width, height), 0, 0, z)
    return at(shapes.foliage((width, width, height), 60, 0.1, rng), z=z)


def _mannequin(u: Uniforms, rng: np.random.Generator) -> Mesh:
    """A thing as tall and wide as a person, of a few rough parts: a column, a wrapped pile, a dummy without limbs."""
    height, width = 1.3 + 0.6 * u[0], 0.3 + 0.3 * u[1]
    if u[2] < 0.4:
        edges, parts = [0.0, *np.sort(rng.uniform(0.1, 0.9, 2)) * height, height], []
        for low, high in pairwise(edges):
            size = (width * (0.5 + 0.5 * rng.random()), width * (0.6 + 0.4 * rng.random()), high - low)
            parts.append(box_at(size, 0, 0, low))
        return union(parts)
    if u[2] < 0.7:
        return at(shape("ball", width / 2, width / 2, height / 2), z=height / 2)
    return union([post(width / 2 * (0.7 + 0.3 * u[3]), height * (0.6 + 0.3 * u[4])), box_at((0.1, width, height))])


THINGS: dict[str, Thing] = {
    "wall end": Thing(_wall_end, 1.0, 0.6),
    "window bars": Thing(_bars, 0.5, 0.1),
    "cabinet": Thing(_cabinet, 1.0, 0.4, left_out=True),
    "pillar": Thing(_pillar, 1.0, 1.5, left_out=True),
    "tree": Thing(plants.tree, 1.2),
    "young tree": Thing(plants.young_tree, 1.0),
    "low crown": Thing(plants.low_crown, 1.0),
    "staked tree": Thing(plants.staked_tree, 1.2, left_out=True),
    "hedge": Thing(plants.hedge, 1.0),
    "hedge at wall": Thing(plants.hedge_at_wall, 1.0, 0.2, left_out=True),
    "bush": Thing(plants.bush, 1.0),
    "bollard": Thing(_bollard, 1.0, 0.1),
    "pole": Thing(_pole, 1.2, 0.2),
    "sign": Thing(_sign, 1.2, 0.5),
    "bin": Thing(_bin, 1.0, 0.5),
    "bench": Thing(_bench, 0.6, 0.4),
    "chair": Thing(_chair, 0.5, 2.0),
    "table": Thing(_table, 0.4, 1.5),
    "cart": Thing(_cart, 0.5, 0.5),
    "bicycle": Thing(_bicycle, 0.8, 0.1),
    "moped": Thing(_moped, 0.8),
    "traffic cone": Thing(_cone, 0.4, 0.1),
    "sacks": Thing(_sacks, 0.8, 0.8),
    "fence": Thing(_fence, 0.8),
    "car": Thing(car, 0.4),
    "car corner": Thing(_car_corner, 0.5),
    "shelf": Thing(_shelf, 0.1, 1.2),
    "cupboard": Thing(_cupboard, 0.0, 1.2),
    "door": Thing(_door, 0.1, 0.8),
    "pot plant": Thing(plants.pot_plant, 0.3, 0.8),
    "floor lamp": Thing(_floor_lamp, 0.1, 0.8),
    "fragment": Thing(_fragment, 0.6, 0.3),
    "floating piece": Thing(_floating, 0.5, 0.3),
    "mannequin": Thing(_mannequin, 0.2, 0.0, left_out=True),
}
# other objects that points may lie on
STRUCTURES = ("ground", "facade", "wall", "ceiling", "belongings", "own vehicle", "screen")
KINDS = (*THINGS, *STRUCTURES)


def draw_thing(name: str, rng: np.random.Generator) -> Mesh:
    """A thing of `THINGS`."""
    return THINGS[name].build(rng.random(8), rng)
