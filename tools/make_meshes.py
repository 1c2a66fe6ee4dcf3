"""Builds the fixed meshes of props and street furniture that the package ships.

    python tools/make_meshes.py [--out src/lidarpose/synth/assets/meshes.npz]

All have few triangles and are closed, but for those that stand on a `prism`; each is in its own frame: x forward, y
left, z up; in meters, or of unit size if they are scaled when used (see `lidarpose.synth.environment.mesh.shape`). The
file is the same on any machine with the same numpy.
"""

import argparse
from pathlib import Path

import numpy as np

from lidarpose.synth.environment.mesh import Mesh, box, boxes, union
from lidarpose.synth.props.mounts import CRANK, FRONT_AXLE, NECK, REAR_AXLE
from lidarpose.synth.props.prop import rod_rows

OUT = Path(__file__).parents[1] / "src/lidarpose/synth/assets/meshes.npz"


# --- hulls


def hull(outlines: list, tips: tuple[float, float] | None = None) -> Mesh:
    """A closed surface through outlines (K, 3), each counter-clockwise seen from above, from the lowest to the highest,
    with a fan at both ends around the outline's center, whose height may be set by `tips`."""
    outlines = [np.asarray(outline, float) for outline in outlines]
    sides = len(outlines[0])
    ends = [outlines[0].mean(0), outlines[-1].mean(0)]
    if tips:
        ends = [np.array([*end[:2], z]) for end, z in zip(ends, tips, strict=True)]
    vertices = np.concatenate([*outlines, ends])
    k = np.arange(sides)
    n = (k + 1) % sides
    faces = []
    for a in range(0, sides * (len(outlines) - 1), sides):
        faces += [np.stack([a + k, a + n, a + sides + n], 1), np.stack([a + k, a + sides + n, a + sides + k], 1)]
    a, low, high = sides * (len(outlines) - 1), len(vertices) - 2, len(vertices) - 1
    faces += [np.stack([0 * k + low, n, k], 1), np.stack([0 * k + high, a + k, a + n], 1)]
    return outwards(Mesh(vertices.astype(np.float32), np.concatenate(faces).astype(np.int32)))


def outwards(mesh: Mesh) -> Mesh:
    """The mesh with faces counter-clockwise seen from outside."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces].astype(float), 1, 0)
    inside_out = (np.cross(a, b) * c).sum() < 0
    return Mesh(mesh.vertices, np.ascontiguousarray(mesh.faces[:, ::-1])) if inside_out else mesh


def layers(*rows: tuple[float, list | np.ndarray]) -> list[np.ndarray]:
    """Outlines (K, 3) from heights and outlines (K, 2)."""
    return [np.column_stack([outline, np.full(len(outline), z)]) for z, outline in rows]


def rectangle(x0: float, x1: float, half: float) -> np.ndarray:
    return np.array([(x0, half), (x1, half), (x1, -half), (x0, -half)])


def turned(rings: tuple, sides: int, *, tips: tuple[float, float] | None = None) -> Mesh:
    """A closed surface of revolution around the z axis through rings (z, radius), from the lowest; `tips`: z of its two
    ends, by default in the planes of the first and last ring."""
    turn = 2 * np.pi * np.arange(sides) / sides
    outlines = [np.stack([r * np.cos(turn), r * np.sin(turn), np.full(sides, z)], 1) for z, r in rings]
    return hull(outlines, tips or (rings[0][0], rings[-1][0]))


def loft(*stations: tuple[float, float, float, float, float]) -> Mesh:
    """A closed hull through cross-sections along x: stations (x, half width at the bottom, half width at the top,
    bottom, top), x ascending."""
    vertices = np.array([[[x, -b, low], [x, b, low], [x, t, top], [x, -t, top]] for x, b, t, low, top in stations])
    faces = [[0, 2, 1], [0, 3, 2]]
    for first in range(0, 4 * (len(stations) - 1), 4):
        for k in range(4):
            a, b = first + k, first + (k + 1) % 4
            faces += [[a, b, b + 4], [a, b + 4, a + 4]]
    last = 4 * (len(stations) - 1)
    faces += [[last, last + 1, last + 2], [last, last + 2, last + 3]]
    return Mesh(vertices.reshape(-1, 3).astype(np.float32), np.array(faces, np.int32))


def prism(sides: int, *, top: float = 1.0) -> Mesh:
    """An upright prism of radius and height 1 on the origin, open at the bottom; the top is `top` times as wide."""
    angle = np.arange(sides) * (2 * np.pi / sides)
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    levels = [np.column_stack([ring * scale, np.full(sides, z)]) for z, scale in ((0.0, 1.0), (1.0, top))]
    vertices = np.concatenate(levels + [[[0, 0, 1.0]]])
    k = np.arange(sides)
    n = (k + 1) % sides
    rows = ((k, n, n + sides), (k, n + sides, k + sides), (k + sides, n + sides, 0 * k + 2 * sides))
    faces = np.concatenate([np.stack(row, 1) for row in rows])
    return Mesh(vertices.astype(np.float32), faces.astype(np.int32))


# --- rods, wheels


def tube(sides: int) -> Mesh:
    """An upright prism of radius 1 from 0 to 1, closed."""
    return turned(((0.0, 1.0), (1.0, 1.0)), sides)


def rod(start: tuple, end: tuple, radius: float = 0.015) -> Mesh:
    """A three-sided `tube` between two points (x, y, z)."""
    return tube(3).placed(*rod_rows(start, end, radius))


def disc_wheels(radius: float, x: tuple, half: float, wide: float, *, sides: int = 5) -> Mesh:
    """Small solid wheels around the y axis, on the ground, two at each x."""
    disc = tube(sides).scaled((radius, radius, wide))
    turn = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], np.float32)
    wheel = Mesh(disc.vertices @ turn + np.float32([0, wide / 2, radius]), disc.faces)
    return union([wheel.moved((wheel_x, side * half, 0)) for wheel_x in x for side in (-1, 1)])


def rim(radius: float, half: float, *, sides: int) -> Mesh:
    """An open wheel around the y axis: a closed ring with the tread outside and two flanks."""
    turn = 2 * np.pi * np.arange(sides) / sides
    circle = np.stack([np.cos(turn), 0 * turn, np.sin(turn)], 1)
    offset = np.array([0, half, 0])
    rings = [circle * radius - offset, circle * radius + offset, circle * (radius - 0.045)]
    k = np.arange(sides)
    n = (k + 1) % sides
    faces = []
    for a, b in ((0, sides), (sides, 2 * sides), (2 * sides, 0)):
        faces += [np.stack([a + k, b + n, a + n], 1), np.stack([a + k, b + k, b + n], 1)]
    return Mesh(np.concatenate(rings).astype(np.float32), np.concatenate(faces).astype(np.int32))


def blocks(*rows: tuple[tuple, tuple]) -> Mesh:
    """Boxes from (center of the lower face, size)."""
    return boxes(*(np.array(column, float) for column in zip(*rows, strict=True)))


# --- street furniture: standing on the origin, front along +x


def car_wheels(tall: float) -> Mesh:
    return blocks(*(((x, y, 0.0), (0.14, 0.12, tall)) for x in (-0.31, 0.31) for y in (-0.43, 0.43)))


def street_furniture() -> dict[str, Mesh]:
    seat = [((0, 0, 0.40), (0.42, 1.0, 0.06)), ((0, -0.42, 0), (0.38, 0.05, 0.4)), ((0, 0.42, 0), (0.38, 0.05, 0.4))]
    table = [((0, 0, 0.95), (1, 1, 0.05))]
    table += [((x, y, 0.0), (0.06, 0.04, 0.95)) for x in (-0.44, 0.44) for y in (-0.46, 0.46)]
    tub = loft((-0.45, 0.35, 0.45, 0.0, 0.93), (0.35, 0.35, 0.45, 0.0, 0.93))
    # shapes of passenger cars in units of length, width and height: sill, hood and trunk at 0.25 to 0.7 of the height,
    # inclined windows, a roof narrower than the doors
    car_body = loft(
        (-0.50, 0.40, 0.42, 0.25, 0.60),
        (-0.46, 0.48, 0.48, 0.15, 0.68),
        (0.20, 0.50, 0.50, 0.13, 0.66),
        (0.44, 0.48, 0.46, 0.15, 0.55),
        (0.50, 0.38, 0.38, 0.20, 0.45),
    )
    cabin = loft(
        (-0.42, 0.44, 0.38, 0.62, 0.70),
        (-0.30, 0.46, 0.38, 0.62, 0.97),
        (0.02, 0.46, 0.38, 0.62, 1.00),
        (0.22, 0.46, 0.42, 0.62, 0.66),
    )
    van_body = loft(
        (-0.50, 0.48, 0.46, 0.15, 0.97),
        (0.22, 0.50, 0.46, 0.13, 1.00),
        (0.36, 0.50, 0.45, 0.13, 0.60),
        (0.50, 0.42, 0.40, 0.15, 0.42),
    )
    # rounded in front, as high as the lower edge of the windshield
    bonnet = loft(
        (-0.5, 0.48, 0.45, 0.0, 1.0),
        (0.3, 0.49, 0.45, 0.0, 0.88),
        (0.47, 0.46, 0.40, 0.0, 0.70),
        (0.5, 0.40, 0.38, 0.1, 0.55),
    )
    return {
        "wheeled bin": union([tub, box((1.0, 1.0, 0.07)).moved((0, 0, 0.93))]),
        # in meters across, unit length along y
        "bench": blocks(*seat, ((-0.22, 0, 0.52), (0.05, 1.0, 0.34))),
        "bench without back": blocks(*seat),
        "table": blocks(*table),
        # on a square foot, half as wide as it is high
        "traffic cone": union([prism(8, top=0.15).scaled((0.2, 0.2, 1.0)), box((0.5, 0.5, 0.05))]),
        "pole": prism(7),
        "sign post": prism(5),
        "car": union([car_body, cabin, car_wheels(0.42)]),
        "van": union([van_body, car_wheels(0.3)]),
        "bonnet": bonnet,
    }


# --- props that people carry, wear and ride


def bag() -> Mesh:
    """A bag of size 1 that hangs from the origin: wider below, with the handles in the top quarter."""
    body = np.array([(-0.5, -0.5, -1), (0.5, -0.5, -1), (0.5, 0.5, -1), (-0.5, 0.5, -1)])
    return hull([body, body * [0.92, 0.7, 0] + [0, 0, -0.28], body * [0.25, 0.1, 0]])


def pack() -> Mesh:
    """A rucksack of size 1 on the origin, with the flat side that touches the back at x = 0, rounded behind."""
    rows = []
    for z, deep, wide in ((0.0, 0.8, 0.9), (0.12, 1.0, 1.0), (0.6, 0.95, 1.0), (0.9, 0.6, 0.85), (1.0, 0.25, 0.6)):
        half = wide / 2
        outline = [(0, half), (-0.7 * deep, 0.9 * half), (-deep, 0.5 * half)]
        rows.append((z, outline + [(x, -y) for x, y in reversed(outline)]))
    return hull(layers(*rows))


def ball() -> Mesh:
    """A ball of radius 1 around the origin."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, 6)[1:-1]
    return turned(tuple((float(np.sin(a)), float(np.cos(a))) for a in angles), 8, tips=(-1.0, 1.0))


def umbrella() -> Mesh:
    """An open umbrella, from the hand at the origin to z = 1; the canopy has diameter 1, its rim is at z = 0.72."""
    shaft = tube(4).scaled((0.008, 0.008, 0.95))
    canopy = turned(((0.745, 0.47), (0.72, 0.5), (0.86, 0.33), (0.95, 0.12)), 8, tips=(0.84, 1.0))
    return union([shaft, canopy])


def suitcase() -> Mesh:
    """A pulled suitcase: the hand at (0, 0, 1), wheels at the origin, the case up to z = 0.68, with a bar above."""
    case = box((0.28, 0.42, 0.62)).moved((-0.14, 0, 0.06))
    sides = [box((0.02, 0.02, 0.34)).moved((-0.02, y, 0.66)) for y in (-0.13, 0.13)]
    handle = box((0.03, 0.28, 0.03)).moved((-0.02, 0, 0.98))
    return union([case, *sides, handle, disc_wheels(0.05, (-0.04,), 0.17, 0.04)])


def pram() -> Mesh:
    """A pram with the handle at x = 0 and z = 1 and the rest in front of it; wheels on the ground."""
    basket, hood = rectangle(0.30, 1.0, 0.18), rectangle(0.30, 0.62, 0.2)
    body = hull(layers(*((z, basket * s + [(1 - s) * 0.65, 0]) for z, s in ((0.48, 0.75), (0.78, 1.1)))))
    hood_mesh = hull(layers(*((z, hood * [w, 1] + [0.3 * (1 - w), 0]) for z, w in ((0.76, 1.2), (1.05, 0.7)))))
    rods = []
    for y in (-0.24, 0.24):
        rods += [rod((0.0, y, 1.0), (0.98, y, 0.13)), rod((0.8, y, 0.5), (0.2, y, 0.13))]
    handle = box((0.03, 0.5, 0.03)).moved((0, 0, 0.985))
    return union([body, hood_mesh, *rods, handle, disc_wheels(0.13, (0.2, 0.98), 0.26, 0.04, sides=4)])


def trolley() -> Mesh:
    """A shopping trolley or a loaded hand cart with the handle at x = 0 and z = 1, 0.9 long and 0.5 wide."""
    load = hull(layers((0.45, rectangle(0.2, 0.9, 0.2)), (0.92, rectangle(0.08, 0.95, 0.26))))
    bed = box((0.85, 0.46, 0.05)).moved((0.52, 0, 0.16))
    rods = [rod((0.12, y, 0.18), (0.0, y, 1.0)) for y in (-0.24, 0.24)]
    handle = box((0.035, 0.5, 0.035)).moved((0, 0, 0.98))
    return union([load, bed, *rods, handle, disc_wheels(0.07, (0.16, 0.88), 0.22, 0.035)])


def wheelchair() -> Mesh:
    """A wheelchair without footrests; its seat is 0.5 above the origin."""
    panels = [((0.06, 0, 0.45), (0.46, 0.44, 0.05)), ((-0.2, 0, 0.5), (0.04, 0.44, 0.42))]
    for y in (-0.235, 0.235):
        panels += [((0.06, y, 0.68), (0.34, 0.05, 0.035)), ((-0.2, y, 0.2), (0.03, 0.03, 0.75))]
        panels += [((-0.27, y, 0.94), (0.15, 0.03, 0.03)), ((0.28, y, 0.14), (0.03, 0.03, 0.55))]
    wheels = [rim(0.3, 0.025, sides=10).moved((-0.08, y, 0.3)) for y in (-0.3, 0.3)]
    return union([blocks(*panels), *wheels, disc_wheels(0.08, (0.32,), 0.235, 0.03, sides=6)])


def bicycle() -> Mesh:
    """A bicycle on the ground with the saddle above the origin: frame, saddle and wheels. Handlebars and pedals are not
    included, since they depend on the rider."""
    seat, head, low = (0.03, 0.78), (0.59, 0.82), (0.63, 0.7)
    tubes = [
        ((0.0, 0.94), CRANK),
        (CRANK, REAR_AXLE),
        (REAR_AXLE, seat),
        (seat, head),
        (CRANK, low),
        (NECK, FRONT_AXLE),
    ]
    parts = [rod((ax, 0.0, az), (bx, 0.0, bz), 0.018) for (ax, az), (bx, bz) in tubes]
    saddle = [(-0.13, 0.08), (0.15, 0.02), (0.15, -0.02), (-0.13, -0.08)]
    wheels = [rim(0.34, 0.02, sides=11).moved((x, 0, z)) for x, z in (REAR_AXLE, FRONT_AXLE)]
    return union([*parts, hull(layers((0.92, saddle), (0.97, saddle))), *wheels])


def props() -> dict[str, Mesh]:
    legs = [((x, y, 0), (0.035, 0.08, 0.9)) for x in (-0.17, 0.24) for y in (-0.45, 0.45)]
    crown = ((0.55, 0.95), (0.95, 0.6))
    return {
        "box": box((1.0, 1.0, 1.0)),
        "tube": tube(5),
        "rod": tube(3),
        "bag": bag(),
        "pack": pack(),
        "ball": ball(),
        "umbrella": umbrella(),
        "suitcase": suitcase(),
        "pram": pram(),
        "trolley": trolley(),
        # a seat of width 1 at height 1 above the origin, with legs, and a back up to 1.95
        "chair": blocks(((0.05, 0, 0.9), (0.46, 1.0, 0.1)), ((-0.2, 0, 1.0), (0.04, 1.0, 0.95)), *legs),
        # the same without a back, on two supports
        "seat": blocks(((0.05, 0, 0.88), (0.4, 1.0, 0.12)), *(((0.05, y, 0), (0.3, 0.06, 0.88)) for y in (-0.4, 0.4))),
        "wheelchair": wheelchair(),
        "bicycle": bicycle(),
        # for a head of half length 1 and half width 1, with the edge at z = 0
        "cap": turned(((0.0, 1.0), *crown), 10, tips=(0.0, 1.05)),
        "hat": turned(((-0.06, 1.5), (0.03, 1.5), (0.06, 1.0), *crown), 10, tips=(-0.06, 1.05)),
    }


def meshes() -> dict[str, Mesh]:
    return street_furniture() | props()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=OUT)
    out = parser.parse_args().out
    arrays = {}
    for name, mesh in meshes().items():
        arrays |= {f"{name}/vertices": mesh.vertices, f"{name}/faces": mesh.faces.astype(np.uint8)}
    out.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(out, **arrays)
    print(f"{len(arrays) // 2} meshes, {out.stat().st_size / 1e3:.0f} kB -> {out}")


if __name__ == "__main__":
    main()
