"""Where detection scenes take place: streets, open places, paths, rooms, corridors and car parks.

A layout is drawn in its own frame, whose z = 0 is flat ground. It consists of named meshes, the free areas where people
and things may stand, and the sensor's position. The layouts of `LEFT_OUT` are held out from training.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import pi
from typing import Any

import numpy as np

from lidarpose.synth.environment import mesh as shapes
from lidarpose.synth.environment.facades import facade
from lidarpose.synth.environment.mesh import Mesh, grid, shape
from lidarpose.synth.environment.things import car, draw_thing

Item = tuple[str, Mesh]
# half the length of rows of buildings, cars and plants outdoors, m
_REACH = 45.0


@dataclass(frozen=True, kw_only=True)
class Layout:
    """A place.

    Args:
        items: kinds (names of `things.KINDS`) and meshes; ground is one of them.
        areas: (x min, x max, y min, y max, z) of free ground, m.
        sensor: x, y and the ground's z there, m.
        ahead: directions in which a sensor that does not rotate may point, rad.
        indoors: True: indoor things are drawn, and the ground has no slope.
        ceiling: height, m; inf outdoors.
        by_car: whether the sensor may be on a car.
        things: factor on the number of things that are added.
        road: for streets, the ground is at z = 0 for |y| up to this, m, and at the z of the first area beyond it; None
            for other places.
    """

    items: list[Item]
    areas: list[tuple[float, float, float, float, float]]
    sensor: tuple[float, float, float]
    ahead: tuple[float, ...] = (0.0, pi)
    indoors: bool = False
    ceiling: float = np.inf
    by_car: bool = False
    things: float = 1.0
    road: float | None = None


_XS = np.concatenate([np.linspace(-70, -42, 5), np.arange(-38, 39, 2.5), np.linspace(42, 70, 5)])


def _field(rng: np.random.Generator, rough: float) -> Mesh:
    """Open ground whose height has a standard deviation of `rough` m."""
    return grid(_XS, _XS, rng.normal(0, rough, (len(_XS), len(_XS))) if rough else 0.0)


# --- outdoors


def street(rng: np.random.Generator) -> Layout:
    """A road between two sidewalks one curb higher, with fronts behind them and cars parked at the curbs."""
    road = rng.uniform(2.6, 5.5) if rng.random() < 0.6 else rng.uniform(5, 11)
    kerb = rng.choice([0.0, rng.uniform(0.06, 0.16)], p=[0.15, 0.85])
    front = road + rng.uniform(1.5, 5.0) * rng.choice([1.0, 1.8])
    inner = np.linspace(-road, road, 5)
    ys = np.concatenate([[-70, -40, -20, -front, -road - 0.02], inner, [road + 0.02, front, 20, 40, 70]])
    heights = np.where(np.abs(ys) > road + 0.01, kerb, 0.0)
    items: list[Item] = [("ground", grid(_XS, ys, heights[None]))]
    for side in (-1, 1):
        items += _fronts(side, front, kerb, rng)
        items += _parked(side, road, rng)
    areas = [(-40.0, 40.0, 0.2 - front, -road - 0.3, kerb), (-40.0, 40.0, road + 0.3, front - 0.2, kerb)]
    areas.append((-40.0, 40.0, -road + 2.0, road - 2.0, 0.0))
    is_on_road = rng.random() < 0.6
    y = rng.uniform(-1, 1) * (road - 2.0) if is_on_road else rng.choice([-1, 1]) * rng.uniform(road + 0.5, front - 0.5)
    sensor = (0.0, y, 0.0 if is_on_road else kerb)
    return Layout(items=items, areas=areas, sensor=sensor, by_car=is_on_road, road=road)


def _fronts(side: int, front: float, z: float, rng: np.random.Generator) -> list[Item]:
    """Houses, garden walls, hedges, fences and gaps behind a sidewalk."""
    items: list[Item] = []
    x, yaw = -_REACH, -side * pi / 2
    while x < _REACH:
        kind, length = rng.random(), rng.uniform(4, 13)
        y = side * (front + rng.choice([0.0, rng.uniform(0, 3)], p=[0.7, 0.3]))
        middle = (x + length / 2, y, z)
        if kind < 0.62:
            for name, mesh in facade(length, rng.uniform(2.6, 8), rng):
                items.append((name, mesh.moved(middle, yaw)))
        elif kind < 0.75:
            for k in range(max(1, int(length / 3))):
                items.append(("hedge", draw_thing("hedge", rng).moved((x + 3 * k + 1.5, y, z), yaw)))
        elif kind < 0.83:
            items.append(("wall", shapes.wall(length, rng.uniform(0.5, 2.2), thick=0.25).moved(middle, yaw)))
        elif kind < 0.93:
            items.append(("fence", draw_thing("fence", rng).moved(middle, yaw)))
        x += length + (0 if kind < 0.5 else rng.uniform(0.3, 2.5))
    return items


def _parked(side: int, road: float, rng: np.random.Generator) -> list[Item]:
    """Cars parked parallel or perpendicular to the curb, with gaps in which people and house corners are visible."""
    items: list[Item] = []
    is_across, car_share = rng.random() < 0.2, rng.choice([0.0, 0.35, 0.75], p=[0.25, 0.45, 0.3])
    x = -_REACH + 5 * rng.random()
    while x < _REACH:
        u = rng.random(8)
        vehicle = car(u, rng)
        length = float(np.ptp(vehicle.vertices[:, 0]))
        if rng.random() < car_share:
            yaw = (pi / 2 if is_across else 0.0 if side < 0 else pi) + rng.normal(0, 0.04)
            y = side * (road + (0.5 - length / 2 if is_across else -1.05 + 0.2 * u[7]))
            items.append(("car", vehicle.moved((x + (1.2 if is_across else length / 2), y, 0.0), yaw)))
        x += (2.3 if is_across else length) + rng.uniform(0.5, 2.0)
    return items


def square(rng: np.random.Generator) -> Layout:
    """An open place with some houses, cars and trees."""
    items: list[Item] = [("ground", _field(rng, rng.choice([0.0, 0.02])))]
    for turn in np.flatnonzero(rng.random(4) < 0.45) * (pi / 2):
        distance, y = rng.uniform(9, 38), -_REACH
        while y < _REACH:
            length = rng.uniform(5, 15)
            if rng.random() < 0.8:
                for name, mesh in facade(length, rng.uniform(2.8, 10), rng):
                    # faces the middle of the square
                    items.append(
                        (name, mesh.moved((0, 0, 0), pi).moved((distance, y + length / 2, 0)).moved((0, 0, 0), turn))
                    )
            y += length
    for _ in range(rng.integers(0, 3)):
        x, y, turn = *rng.uniform(-25, 25, 2), rng.uniform(-pi, pi)
        for k in range(rng.integers(2, 8)):
            vehicle = car(rng.random(8), rng)
            if rng.random() < 0.8:
                position = (x - 2.6 * k * np.sin(turn), y + 2.6 * k * np.cos(turn), 0)
                items.append(("car", vehicle.moved(position, turn + (pi if rng.random() < 0.5 else 0))))
    for _ in range(rng.integers(0, 9)):
        items.append(("tree", draw_thing("tree", rng).moved((*rng.uniform(-35, 35, 2), 0))))
    area = (-38.0, 38.0, -38.0, 38.0, 0.0)
    return Layout(items=items, areas=[area], sensor=(0, 0, 0), ahead=(0.0,), by_car=rng.random() < 0.5)


def path(rng: np.random.Generator) -> Layout:
    """A path with hedges, trees, bushes and fences on both sides."""
    half, rough = rng.uniform(0.8, 3.5), rng.choice([0.0, 0.03, 0.08])
    items: list[Item] = [("ground", _field(rng, rough))]
    for side in (-1, 1):
        names, weights = ("hedge", "tree", "bush", "fence", "young tree", "low crown"), rng.random(6) ** 2
        x = -_REACH
        while x < _REACH:
            name = str(rng.choice(names, p=weights / weights.sum()))
            y = side * (half + rng.uniform(0.5, 1.2) + (rng.exponential(2.5) if name not in ("hedge", "fence") else 0))
            yaw = -side * pi / 2 + rng.normal(0, 0.1)
            items.append((name, draw_thing(name, rng).moved((x, y, 0), yaw)))
            x += rng.uniform(1.0, 5.5)
    if rng.random() < 0.4:
        # a wood
        for _ in range(rng.integers(10, 40)):
            x, y = rng.uniform(-38, 38), rng.choice([-1, 1]) * rng.uniform(half + 2, 30)
            items.append(("tree", draw_thing("tree", rng).moved((x, y, 0))))
    areas = [(-40.0, 40.0, -half, half, 0.0)] * 3 + [(-35.0, 35.0, -18.0, 18.0, 0.0)]
    return Layout(items=items, areas=areas, sensor=(0, rng.uniform(-half, half), 0))


# --- indoors


def _walls(width: float, length: float, height: float, rng: np.random.Generator, *, windows: float = 0.5) -> list[Item]:
    """Four walls with doorways and windows, floor and ceiling; the inside is (width, length) about the origin."""
    items: list[Item] = [("ground", grid(np.array([-width, width]), np.array([-length, length])))]
    items.append(("ceiling", grid(np.array([-width, width]), np.array([-length, length]), height)))
    for turn, wall_length, distance in (
        (0, length, width / 2),
        (1, width, length / 2),
        (2, length, width / 2),
        (3, width, length / 2),
    ):
        bays = max(1, int(wall_length / 2.5))
        bay = wall_length / bays
        for k in range(bays):
            u, opening = rng.random(3), None
            if u[0] < 0.15:
                opening = (-0.45, 0.45, 0.0, 2.05)
            elif u[0] < 0.15 + windows * 0.5:
                opening = (-0.3 * bay, 0.35 * bay, 0.9, min(2.2, height - 0.2))
            wall = shapes.wall(bay, height, thick=0.2, opening=opening)
            wall = wall.moved((distance + 0.1, (k + 0.5) * bay - wall_length / 2, 0)).moved((0, 0, 0), turn * pi / 2)
            items.append(("wall", wall))
    if rng.random() < 0.5:
        for _ in range(rng.integers(2, 9)):
            x, y = (rng.random(2) - 0.5) * [width - 1, length - 1]
            items.append(("ceiling", shapes.box((0.2, 1.2, 0.08)).moved((x, y, height - 0.1 - 0.4 * rng.random()))))
    return items


def _against_walls(width: float, length: float, rng: np.random.Generator) -> list[Item]:
    """Shelves, cupboards, tables, doors and chairs along the walls, and tables with chairs in the room."""
    items: list[Item] = []
    count = int(rng.integers(2, int(5 + (width + length) / 3)))
    for name in map(str, rng.choice(["shelf", "cupboard", "table", "door", "chair"], count)):
        mesh, turn = draw_thing(name, rng), int(rng.integers(4))
        wall_distance, wall_length = (width / 2, length) if turn % 2 == 0 else (length / 2, width)
        position = (
            -wall_distance - float(mesh.vertices[:, 0].min()) + 0.03,
            (rng.random() - 0.5) * wall_length * 0.85,
            0,
        )
        items.append((name, mesh.moved(position).moved((0, 0, 0), turn * pi / 2)))
    for _ in range(int(rng.integers(0, int(2 + width * length / 12)))):
        x, y, turn = (rng.random() - 0.5) * (width - 2), (rng.random() - 0.5) * (length - 2), rng.choice([0.0, pi / 2])
        depth, table_length = rng.uniform(0.6, 1.0), rng.uniform(0.8, 2.2)
        items.append(("table", shape("table", depth, table_length, 0.74).moved((x, y, 0), turn)))
        for k in range(rng.integers(0, 6)):
            # faces the table
            position = (-depth / 2 - rng.uniform(0.1, 0.5), (rng.random() - 0.5) * table_length, 0)
            chair = draw_thing("chair", rng).moved(position).moved((0, 0, 0), pi * (k % 2))
            items.append(("chair", chair.moved((x, y, 0), turn)))
    return items


def room(rng: np.random.Generator) -> Layout:
    """An office, a classroom or a living room."""
    return _room(rng.uniform(3.5, 12), rng.uniform(4, 18), rng)


def small_room(rng: np.random.Generator) -> Layout:
    """A bedroom, a kitchen or a one-person office."""
    return replace(_room(rng.uniform(2.5, 4.5), rng.uniform(3, 6), rng), things=0.5)


def _room(width: float, length: float, rng: np.random.Generator) -> Layout:
    height = rng.uniform(2.3, 4.0)
    items = _walls(width, length, height, rng) + _against_walls(width, length, rng)
    x, y = (rng.random(2) - 0.5) * [width - 1, length - 1]
    if rng.random() < 0.5:
        y = -length / 2 + 0.4
    return _indoors(items, (width, length, height), (0.3, 0.3), (x, y), float(np.arctan2(-y, -x)))


def _indoors(
    items: list[Item],
    size: tuple[float, float, float],
    margin: tuple[float, float],
    sensor: tuple[float, float],
    ahead: float,
    **fields: Any,
) -> Layout:
    """A room of size (width, length, height) centered on the origin, free except for a margin at its walls."""
    width, length, height = size
    area = (margin[0] - width / 2, width / 2 - margin[0], margin[1] - length / 2, length / 2 - margin[1], 0.0)
    room = Layout(items=items, areas=[area], sensor=(*sensor, 0), ahead=(ahead,), indoors=True, ceiling=height)
    return replace(room, **fields)


def car_park(rng: np.random.Generator) -> Layout:
    """Rows of cars under a low ceiling with beams."""
    width, length, height = rng.uniform(15, 34), rng.uniform(20, 44), rng.uniform(2.2, 3.2)
    items = _walls(width, length, height, rng, windows=0.1)
    for y in np.arange(-length / 2 + 3, length / 2, rng.uniform(4, 8)):
        items.append(("ceiling", shapes.box((width, 0.35, 0.3)).moved((0, y, height - 0.3))))
    lanes = []
    for x in np.arange(-width / 2 + 2.6, width / 2 - 2, rng.uniform(7.5, 9)):
        lanes.append(
            (max(x + 2.6, -width / 2 + 0.5), min(x + 5.0, width / 2 - 0.5), -length / 2 + 1, length / 2 - 1, 0.0)
        )
        car_share = rng.uniform(0.1, 0.9)
        for y in np.arange(-length / 2 + 2, length / 2 - 2, 2.5):
            if rng.random() < car_share:
                vehicle = shape("car", *rng.uniform([3.6, 1.65, 1.4], [4.9, 1.9, 1.75]))
                items.append(("car", vehicle.moved((x + rng.normal(0, 0.15), y, 0), rng.choice([0.0, pi]))))
    lanes = [lane for lane in lanes if lane[1] - lane[0] > 1.0]
    x, y = (lanes[0][0] + lanes[0][1]) / 2, rng.uniform(-0.5, 0.5) * length
    hall = _indoors(items, (width, length, height), (0.5, 0.5), (x, y * 0.8), pi / 2 if y < 0 else -pi / 2, things=0.5)
    return replace(hall, areas=[*lanes, *hall.areas])


def corridor(rng: np.random.Generator) -> Layout:
    """A long corridor with niches, doors and glass; held out from training."""
    width, length, height = rng.uniform(1.7, 4.0), rng.uniform(14, 38), rng.uniform(2.3, 3.2)
    items: list[Item] = [("ground", grid(np.array([-9.0, 9.0]), np.array([-length, length])))]
    items.append(("ceiling", grid(np.array([-9.0, 9.0]), np.array([-length, length]), height)))
    for side in (-1, 1):
        for name, mesh in facade(length, height, rng, bars=0.0, niches=0.5):
            name = "wall" if name == "facade" else name
            items.append((name, mesh.moved((side * width / 2, 0, 0), 0 if side < 0 else pi)))
        end = shapes.wall(width, height, opening=(-0.4, 0.4, 0, 2.05) if rng.random() < 0.5 else None)
        items.append(("wall", end.moved((0, side * length / 2, 0), pi / 2)))
    for y in rng.uniform(-0.45, 0.45, rng.integers(0, 8)) * length:
        name = str(rng.choice(["chair", "cupboard", "bin", "pot plant", "cart", "bench"]))
        side = rng.choice([-1, 1])
        items.append((name, draw_thing(name, rng).moved((side * (width / 2 - 0.35), y, 0), 0 if side < 0 else pi)))
    y = rng.uniform(-0.48, 0.48) * length
    sensor = (0.3 * width * (rng.random() - 0.5), y)
    return _indoors(items, (width, length, height), (0.3, 0.4), sensor, pi / 2 if y < 0 else -pi / 2, things=0.5)


def hall(rng: np.random.Generator) -> Layout:
    """A hall or a shop: an L-shaped room with half-height partitions and rows of shelves; held out from training."""
    width, length, height = rng.uniform(9, 26), rng.uniform(12, 36), rng.uniform(3.0, 7.0)
    items = _walls(width, length, height, rng)
    # a block cuts off a corner
    block = rng.uniform(0.2, 0.45, 2) * [width, length]
    items.append(("wall", shapes.box((*block, height)).moved(((width - block[0]) / 2, (length - block[1]) / 2, 0))))
    for _ in range(rng.integers(1, 7)):
        x, y, turn = (rng.random() - 0.5) * width * 0.8, (rng.random() - 0.5) * length * 0.8, rng.choice([0.0, pi / 2])
        if rng.random() < 0.5:
            partition = shapes.wall(rng.uniform(1.2, 4), rng.uniform(1.1, 1.9), thick=0.06)
            items.append(("wall", partition.moved((x, y, 0), turn)))
        else:
            for k in range(rng.integers(1, 6)):
                position = np.array([np.cos(turn + pi / 2), np.sin(turn + pi / 2)]) * 1.1 * k + [x, y]
                if (np.abs(position) < [width / 2 - 0.5, length / 2 - 0.5]).all():
                    items.append(("shelf", draw_thing("shelf", rng).moved((*position, 0), turn)))
    x, y = -width / 2 + rng.uniform(0.5, width / 2), -length / 2 + rng.uniform(0.5, length / 2)
    return _indoors(items, (width, length, height), (0.4, 0.4), (x, y), float(np.arctan2(-y, -x)))


LAYOUTS: dict[str, Callable[[np.random.Generator], Layout]] = {
    kind.__name__.replace("_", " "): kind for kind in (street, square, path, room, small_room, car_park, corridor, hall)
}
LEFT_OUT = ("corridor", "hall")
