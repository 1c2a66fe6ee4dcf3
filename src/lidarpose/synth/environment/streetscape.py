"""What stands in a street: road, pavements, house fronts, hedges, parked cars, trees and furniture.

The street's own frame: x along the street, y across it, z = 0 the road.
"""

from dataclasses import dataclass
from math import pi

import numpy as np

from lidarpose.lidar.ray_pattern import RayPattern
from lidarpose.lidar.sensor import Sensor
from lidarpose.synth.environment import mesh as shapes
from lidarpose.synth.environment.mesh import Mesh, shape

# furniture stands so far behind the kerb, m
RAIL = 0.45
# half of the street's length that is built, m
_LENGTH = 45.0


@dataclass(frozen=True, kw_only=True)
class StreetPlan:
    """Sizes in m, in the street's frame: the sensor stands on (0, sensor_y), the road reaches from -road to road, the
    pavements on to +-front, `kerb` high; height of the sensor above the road; turn rad of the street about it; ahead:
    people are on the x > 0 side, where a sensor that does not turn looks."""

    road: float
    front: float
    kerb: float
    sensor_y: float
    height: float
    turn: float
    ahead: bool


def draw_plan(device: Sensor | RayPattern, rng: np.random.Generator) -> StreetPlan:
    a, b, c, d, e, f, g = rng.random(7)
    road = 2.8 + 1.7 * a
    front = road + 2.2 + 2.3 * b
    kerb = 0.08 + 0.08 * c
    # on the road as a car, or on a pavement as a robot or a tripod
    on_road = d < 0.6
    sensor_y = (2 * e - 1) * (road - 2.0) if on_road else (road + front) / 2 * (1 if e < 0.5 else -1)
    height = device.height + 0.15 * (2 * g - 1) + (0 if on_road else kerb)
    ahead = isinstance(device, RayPattern) and device.azimuths[1] - device.azimuths[0] < 2 * pi - 1e-3
    turn = (2 * f - 1) * (0.3 if ahead else pi)
    return StreetPlan(road=road, front=front, kerb=kerb, sensor_y=sensor_y, height=height, turn=turn, ahead=ahead)


def scenery(plan: StreetPlan, rng: np.random.Generator) -> list[Mesh]:
    """All that stands still, in the street's frame moved so that the sensor is the origin."""
    meshes = [_ground(plan)]
    for side in (-1, 1):
        meshes += _front(plan, side, rng)
        meshes += _row(plan, side, rng)
    shift = np.array([0, -plan.sensor_y, -plan.height])
    moved = [mesh.moved(shift) for mesh in meshes]
    # the sensor is not in a car
    clear = [m for m in moved[1:] if np.hypot(*m.vertices[:, :2].T).min() > 1.2 and not _around(m)]
    return moved[:1] + clear


def _around(mesh: Mesh) -> bool:
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    return bool((low[:2] < 1.0).all() and (high[:2] > -1.0).all())


def _ground(plan: StreetPlan) -> Mesh:
    """The road, two risers, two pavements."""
    strips = []
    for y0, z0, y1, z1 in (
        (-plan.road, 0.0, plan.road, 0.0),
        (plan.road, 0.0, plan.road, plan.kerb),
        (-plan.road, plan.kerb, -plan.road, 0.0),
        (plan.road, plan.kerb, plan.front + 12, plan.kerb),
        (-plan.front - 12, plan.kerb, -plan.road, plan.kerb),
    ):
        corners = [[-_LENGTH, y0, z0], [_LENGTH, y0, z0], [_LENGTH, y1, z1], [-_LENGTH, y1, z1]]
        strips.append(Mesh(np.array(corners, np.float32), shapes.QUAD_FACES))
    return shapes.union(strips)


def _front(plan: StreetPlan, side: int, rng: np.random.Generator) -> list[Mesh]:
    """House fronts with doors and windows, hedges, fences and gaps, one after the other behind a pavement."""
    meshes, x = [], -_LENGTH
    while x < _LENGTH:
        a, b, c, d = rng.random(4).tolist()
        long = 4.0 + 6.0 * a
        y = side * (plan.front + 0.2 + (1.5 * b if c > 0.6 else 0.1 * b))
        middle = (x + long / 2, y, plan.kerb)
        if c < 0.6:
            bays = max(1, int(long / 2.5))
            wide = long / bays
            for bay in range(bays):
                sill, top = (0.0, 2.1) if (bay + int(10 * d)) % 3 == 0 else (0.9, 2.2)
                opening = (-0.25 * wide, 0.25 * wide, sill, top)
                front = shapes.wall(wide, 3.5 + 3 * d, thick=0.3, opening=opening)
                meshes.append(front.moved((x + (bay + 0.5) * wide, y, plan.kerb), pi / 2))
            # rooms end somewhere
            meshes.append(shapes.box((long, 0.1, 3.5)).moved((middle[0], y + side * (1.5 + 3 * d), plan.kerb)))
        elif c < 0.75:
            for k in range(int(long)):
                bush = shapes.foliage((1.3, 0.9, 0.9 + d), 120, 0.11, rng)
                meshes.append(bush.moved((x + k + 0.5, y, plan.kerb)))
        elif c < 0.9:
            fence = shapes.rail_fence(long, 1.0, 3) if d < 0.4 else shapes.lattice_fence(long, 0.8 + d, 0.14, 0.04)
            meshes.append(fence.moved(middle, pi / 2))
        x += long + (0 if c < 0.6 else 0.5 + d)
    return meshes


def _row(plan: StreetPlan, side: int, rng: np.random.Generator) -> list[Mesh]:
    """Parked cars at the kerb and furniture on the pavement beside it."""
    meshes, x = [], -_LENGTH + 4 * rng.random()
    parked = rng.random() < 0.8
    while parked and x < _LENGTH - 6:
        a, b, c, d = rng.random(4).tolist()
        long = 3.7 + 1.2 * a
        if b < 0.6:
            ahead = 0.0 if side < 0 else pi
            car = shape("car", long, 1.8, 1.45 + 0.2 * c) if c < 0.8 else shape("van", long + 1, 2.0, 2.0 + 0.4 * d)
            meshes.append(car.moved((x + long / 2, side * (plan.road - 1.05), 0.0), ahead + 0.04 * (d - 0.5)))
        x += long + 1.6 + 1.5 * d
    x = -_LENGTH + 6 * rng.random()
    while x < _LENGTH:
        a, b, c, d = rng.random(4).tolist()
        place, inwards = (x, side * (plan.road + RAIL), plan.kerb), -side * pi / 2
        if a < 0.25:
            meshes.append(shape("pole", 0.05 + 0.06 * b, 0.05 + 0.06 * b, 5.0).moved(place))
        elif a < 0.5:
            # a tree: trunk and crown
            crown = shapes.foliage((2.2 + b, 2.2 + b, 2.0), 120, 0.28, rng)
            meshes += [
                shape("pole", 0.10 + 0.10 * c, 0.10 + 0.10 * c, 2.6).moved(place),
                crown.moved((x, place[1], plan.kerb + 2.2)),
            ]
        elif a < 0.62:
            meshes.append(shapes.sign(2.0 + 0.6 * b, 0.5).moved(place, inwards))
        elif a < 0.75:
            meshes.append(shape("wheeled bin", 0.5 + 0.2 * b, 0.5 + 0.2 * b, 1.0 + 0.1 * c).moved(place, 2 * pi * d))
        elif a < 0.82:
            meshes.append(shape("bench", 1.0, 1.6).moved(place, inwards))
        elif a < 0.9:
            meshes.append(shapes.foliage((0.8, 0.8, 0.7 + b), 100, 0.1, rng).moved(place))
        else:
            meshes.append(shape("traffic cone", 0.6, 0.6, 0.6).moved((x, side * (plan.road - 0.3), 0.0)))
        x += 3.0 + 7.0 * d
    return meshes
