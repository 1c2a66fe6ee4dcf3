"""Outdoor surroundings beyond the free space around the sensor: roads with vehicles, roadside objects, houses.

Used in training alone, and only with kinds of `things.THINGS` that are not held out from training.
"""

from functools import cache, partial
from math import pi

import numpy as np

from lidarpose.synth.environment import mesh as shapes
from lidarpose.synth.environment.facades import facade
from lidarpose.synth.environment.mesh import Mesh, shape, union
from lidarpose.synth.environment.site import Site
from lidarpose.synth.environment.things import draw_thing

# half the length of roads and rows of houses, minimum distance of vehicles from the sensor, and minimum gap between an
# added object and those already there, m
_REACH, _NEAREST, _GAP = 42.0, 3.5, 0.4
# triangles of the unit car whose middle is above the first height are windows, except those entirely above the second
_SILL, _ROOF = 0.7, 0.85


@cache
def _is_window() -> np.ndarray:
    """(F,) bool: which faces of the mesh "car" are windows."""
    unit = shape("car")
    heights = unit.vertices[unit.faces][..., 2]
    return (heights.mean(1) > _SILL) & (heights.min(1) < _ROOF)


def with_windows(car_mesh: Mesh, rng: np.random.Generator) -> Mesh:
    """A mesh "car", at any position and yaw, with all, some or none of its window faces removed, and with a dashboard,
    a steering wheel, seats and perhaps occupants inside. Any other mesh is returned unchanged."""
    is_window, unit = _is_window(), shape("car")
    if len(car_mesh.faces) != len(is_window):
        return car_mesh
    is_open = is_window & (rng.random(len(is_window)) < rng.choice([0.0, 0.5, 1.0]))
    # images of the unit car's x, y and z axes; the last row is that of its origin
    rows = np.linalg.lstsq(np.column_stack([unit.vertices, np.ones(len(unit.vertices))]), car_mesh.vertices)[0]
    length, width, height = np.linalg.norm(rows[:3], axis=1)
    side = rng.choice([-0.22, 0.22]) * width
    dashboard = shapes.box((0.35, 0.85 * width, 0.1)).moved((0.2 * length, 0, 0.56 * height))
    wheel = shape("ball", 0.04, 0.18, 0.18).moved((0.15 * length, side, 0.64 * height))
    parts = [dashboard, wheel]
    for x, y in ((0.06, 0.22), (0.06, -0.22), (-0.16, 0.22), (-0.16, -0.22)):
        x, y, z = x * length, y * width, 0.62 * height
        parts.append(shapes.box((0.1, 0.45, 0.24 * height)).moved((x - 0.15, y, z)))
        if rng.random() < 0.3:
            parts.append(shapes.box((0.22, 0.42, 0.12 * height)).moved((x, y, z)))
            parts.append(shape("ball", 0.1, 0.09, 0.12).moved((x, y, 0.82 * height)))
    inside = union(parts).placed(rows[:3] / [[length], [width], [height]], rows[3])
    return union([Mesh(car_mesh.vertices, car_mesh.faces[~is_open]), inside])


def _post(rng: np.random.Generator) -> Mesh:
    """A post or a mast with plates, boxes and balls on it: signs, bins, meters, flowers, a traffic light."""
    u = rng.random(3)
    radius, height = 0.03 + 0.09 * u[0] ** 2, 1.4 + 3.5 * u[1]
    parts = [shape("pole", radius, radius, height)]
    for _ in range(rng.integers(1, 5)):
        size, z, angle = 0.12 + 0.6 * rng.random(3) ** 1.5, rng.uniform(0.3, min(height, 3.0)), rng.uniform(-pi, pi)
        if u[2] < 0.4:
            # plates face one way
            size[0], angle = 0.02, 0.0
        part = shapes.box(size) if rng.random() < 0.7 else shape("ball", *size / 2)
        distance = radius + size[0] / 2
        parts.append(part.moved((distance * np.cos(angle), distance * np.sin(angle), z), angle))
    return union(parts)


def _clump(rng: np.random.Generator) -> Mesh:
    """Bushes that touch each other."""
    positions = np.cumsum(rng.normal(0, 0.55, (rng.integers(2, 5), 2)), axis=0)
    return union([draw_thing("bush", rng).moved((*position, 0)) for position in positions])


def _corner(rng: np.random.Generator) -> Mesh:
    """A corner of a house or a yard: two walls, one of them possibly with piers that project from it."""
    u, (length, other_length) = rng.random(4), rng.uniform(0.8, 6.0, 2)
    height, thickness = 1.0 + 3.5 * u[0], 0.2 + 0.3 * u[1]
    centers = [(0, length / 2, 0), (-other_length / 2, 0, 0)]
    sizes = [(thickness, length, height), (other_length, thickness, height)]
    for y in np.arange(0.3, length, rng.uniform(0.8, 2.5)) if u[2] < 0.5 else ():
        centers.append((thickness / 2, y, 0))
        sizes.append((0.15 + 0.5 * u[3], 0.25 + 0.3 * u[3], height * rng.uniform(0.7, 1.0)))
    return shapes.boxes(np.array(centers), np.array(sizes))


# roadside objects: names of `things.KINDS`, probabilities, and builders
_ROADSIDE = (
    ("pole", 0.5, _post),
    ("bush", 0.15, _clump),
    ("wall end", 0.2, _corner),
    ("car", 0.15, partial(draw_thing, "car")),
)


def _put(site: Site, name: str, mesh: Mesh, position: tuple[float, float], nearest: float) -> None:
    """Adds a mesh at a position unless an object is within `_GAP` m of it, or the sensor within `nearest` m."""
    mesh = mesh.moved((*position, site.level(np.array(position))))
    low, high = mesh.vertices[:, :2].min(0) - _GAP, mesh.vertices[:, :2].max(0) + _GAP
    is_overlapping = np.all((low < site.low[:, 2:4]) & (site.low[:, :2] < high), axis=1)
    if not is_overlapping.any() and np.hypot(*np.maximum(np.maximum(low, -high), 0)) >= nearest:
        site.add(name, mesh)


def _add_road(site: Site, offset: float, turn: int, rng: np.random.Generator) -> None:
    """Vehicles in a row along x, or y if `turn` is odd, `offset` m to the side of the sensor."""
    position, mean_gap = -_REACH + 12 * rng.random(), rng.choice([2.0, 8.0, 25.0])
    heading = pi * rng.integers(2) + turn * pi / 2
    while position < _REACH:
        mesh = draw_thing("car", rng).moved((0, 0, 0), heading + rng.normal(0, 0.05))
        _put(site, "car", mesh, (offset, position) if turn % 2 else (position, offset), _NEAREST)
        position += 5.0 + rng.exponential(mean_gap)


def _add_houses(site: Site, turn: int, rng: np.random.Generator) -> None:
    """A row of house fronts that face the sensor, on one of four sides."""
    distance, position = rng.uniform(14, _REACH), -_REACH
    while position < _REACH:
        length = rng.uniform(6, 16)
        if rng.random() < 0.75:
            for name, mesh in facade(length, rng.uniform(2.8, 9), rng):
                mesh = mesh.moved((0, 0, 0), pi).moved((distance + rng.exponential(0.5), position + length / 2, 0))
                site.add(name, mesh.moved((0, 0, 0), turn * pi / 2))
        position += length


def add_surroundings(site: Site, place: str, rng: np.random.Generator) -> None:
    """Adds roads, roadside objects and houses around an outdoor place, a name of `layouts.LAYOUTS`."""
    turn = int(rng.integers(4))
    if place == "street":
        low, high = site.areas[-1, 2:4]
        for offset in rng.uniform(low, high, rng.integers(0, 3)):
            _add_road(site, offset, 0, rng)
    else:
        for side in range(rng.integers(0, 3)):
            _add_houses(site, turn + side, rng)
        for side in range(rng.integers(0, 3)):
            _add_road(site, rng.choice([-1, 1]) * rng.uniform(6, 36), turn + side, rng)
    for row in rng.choice(len(_ROADSIDE), rng.integers(2, 14), p=[share for _, share, _ in _ROADSIDE]):
        name, _, build = _ROADSIDE[row]
        mesh = build(rng).moved((0, 0, 0), rng.uniform(-pi, pi))
        spot = site.spot(rng.uniform(6, 40), 0.4, rng, seen=True)
        _put(site, name, mesh, (spot[0], spot[1]), 1.0)
