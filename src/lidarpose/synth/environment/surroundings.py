"""The surroundings of a person: things near them, an occluder in front of them, the ground they stand on.

Everything is in the level frame at the sensor (sensor at the origin, x forward, y left, z up); the person stands at
feet (3,) m. The `config` is a `scene.SceneConfig`: its probabilities `clutter` and `occluder` are scaled by `hard`.
Uniform numbers are drawn as vectors, since a call of a random generator costs as much as a mesh.
"""

from functools import cache
from math import atan2, cos, hypot, log, pi, sin, sqrt, tan

import numpy as np

from lidarpose.synth.environment import mesh as shapes
from lidarpose.synth.environment.mesh import Mesh, shape
from lidarpose.synth.scene import STEEPEST, SceneConfig

# Paper: a square of ground of half width 1 m; other scenes have one that extends beyond any crop
_PAPER_HALF = 1.0
_WILD_HALF = 3.0
# shares of grounds with a curb at the feet, with a rough surface, and with grass, for clutter 1 at full difficulty
_KERB, _ROUGH, _GRASS = 0.35, 0.45, 0.15
# range of `kind` for walls and cars, and the share of all directions around the person, centered on the direction away
# from the sensor, in which they may stand
_WALLS, _BESIDE = (0.50, 0.70), 0.62
# minimum distance of an occluder of the legs from the feet, m
_BEFORE = 0.6
# number of cells of a rough ground along a side, and standard deviation of its height, m
_CELLS = 7
_ROUGHNESS = 0.018


def surroundings(config: SceneConfig, feet: np.ndarray, radius: float, rng: np.random.Generator) -> list[Mesh]:
    """Things near a person who stands at feet (3,) m and reaches `radius` m to the sides; none of them is a person.

    With probability clutter * hard there are one to three, with their near sides 5 to 60 cm beyond the person's reach,
    or luggage that touches the body. Things that would reach the sensor are left out.
    """
    if rng.random() >= config.clutter * config.hard:
        return []
    draws = rng.random((1 + int(3 * rng.random()), 8)).tolist()
    meshes = [_place_thing(feet, radius, draw, rng) for draw in draws]
    return [mesh for mesh in meshes if mesh is not None]


def _place_thing(feet: np.ndarray, radius: float, draw: list[float], rng: np.random.Generator) -> Mesh | None:
    kind, angle_draw, gap_draw, shift, a, b, c, yaw = draw
    angle, gap = (2 * angle_draw - 1) * pi, radius + 0.05 + 0.55 * gap_draw
    if _WALLS[0] <= kind < _WALLS[1]:
        # beside or behind the person; in front they would occlude everything
        angle = atan2(feet[1], feet[0]) + _BESIDE * angle
    if kind < 0.16:
        # hand luggage, parcels and other small things that touch the body
        mesh = shapes.box((0.12 + 0.38 * a, 0.12 + 0.18 * b, 0.12 + 0.38 * c))
        distance = (0.6 + 0.4 * gap_draw) * radius
        position = (feet[0] + distance * cos(angle), feet[1] + distance * sin(angle), feet[2] + 0.9 * shift)
        return mesh.moved(position, 2 * pi * yaw)
    mesh, depth, length, yaw_range = _draw_thing(kind, a, b, c, yaw, rng)
    # the near side is at the gap; the length is roughly perpendicular to the direction from the person, and shifted
    gap += depth
    lateral_offset = (shift - 0.5) * 0.7 * length
    x = feet[0] + gap * cos(angle) - lateral_offset * sin(angle)
    y = feet[1] + gap * sin(angle) + lateral_offset * cos(angle)
    if hypot(x, y) < depth + length / 2 + 0.3:
        return None
    return mesh.moved((x, y, feet[2]), angle + pi + yaw_range * (2 * yaw - 1))


def _draw_thing(
    kind: float, a: float, b: float, c: float, d: float, rng: np.random.Generator
) -> tuple[Mesh, float, float, float]:
    """A mesh, half its depth and its length, m, and the maximum of its random rotation, rad."""
    if kind < 0.32:
        radius = 0.02 + 0.16 * a * a
        return shape("pole", radius, radius, 0.8 + 2.7 * b), radius, 0.0, 0.0
    if kind < 0.40:
        size = 0.45 + 0.35 * a
        return shape("wheeled bin", size, size, 0.8 + 0.4 * b), size / 2, size, 0.2
    if kind < _WALLS[0]:
        return shapes.box((0.2 + 0.4 * a, 0.2 + 0.7 * b, 0.2 + 0.9 * c)), 0.1 + 0.2 * a, 0.3, 0.3
    if kind < 0.60:
        return _draw_wall(a, b, c)
    if kind < _WALLS[1]:
        return _draw_car(a, b, c)
    if kind < 0.76:
        length = 1.2 + 2 * a
        if b < 0.5:
            return shapes.rail_fence(length, 0.8 + 0.4 * c, 2), 0.03, length, 0.05
        return shapes.lattice_fence(length, 0.8 + 1.0 * c, 0.10 + 0.10 * b, 0.02 + 0.04 * c), 0.03, length, 0.05
    if kind < 0.88:
        bush = (0.4 + 0.6 * a, 0.5 + 1.5 * b, 0.4 + 1.4 * c)
        return shapes.foliage(bush, 50 + int(70 * b), 0.07 + 0.08 * d, rng), bush[0] / 2, bush[1], 0.2
    if kind < 0.92:
        length = 1.2 + 0.8 * a
        return shape("bench" if b < 0.6 else "bench without back", 1.0, length), 0.22, length, 0.3
    if kind < 0.96:
        length, depth = 0.8 + 0.9 * a, 0.3 + 0.15 * b
        return shape("table", 2 * depth, length, 0.7 + 0.35 * c * c), depth, length, 0.2
    if kind < 0.98:
        return shapes.sign(1.6 + 1.0 * a, 0.4 + 0.4 * b), 0.05, 0.3, 1.0
    height = 0.45 + 0.35 * a
    return shape("traffic cone", height, height, height), 0.12, 0.0, 1.0


def _draw_wall(a: float, b: float, c: float) -> tuple[Mesh, float, float, float]:
    length, height = 1.0 + 3.0 * a, 0.5 + 2.5 * b
    opening = (-0.25 * length, (0.5 * c) * length, 0.0 if c < 0.1 else 0.9, 0.85 * height)
    wall = shapes.wall(length, height, thick=0.15, opening=opening if height > 1.8 and c < 0.4 else None)
    return wall, 0.08, length, 0.15


def _draw_car(a: float, b: float, c: float) -> tuple[Mesh, float, float, float]:
    """A car or a van with its side, front or back toward the person."""
    width = 1.65 + 0.25 * a
    if c < 0.75:
        length, mesh = 3.7 + b, shape("car", 3.7 + b, width, 1.4 + 0.3 * a)
    else:
        length, width = 4.6 + b, width + 0.2
        mesh = shape("van", length, width, 1.9 + 0.4 * a)
    if b < 0.35:
        # seen from its end
        return mesh, length / 2, width, 0.15
    return mesh.moved((0, 0, 0), pi / 2), width / 2, length, 0.1


def occluder(config: SceneConfig, feet: np.ndarray, tall: float, rng: np.random.Generator) -> Mesh | None:
    """With probability occluder * hard, an object between the sensor and a person `tall` m high at feet (3,) m, who
    stays visible beside, above or through it; else None.

    It stands on the person's ground at 0.5 to 0.85 of their distance; an object that occludes the legs, such as a
    parapet, may stand right in front of them. Nearer objects appear larger, so sizes are chosen for the person's
    distance and scaled down.
    """
    if rng.random() >= config.occluder * config.hard:
        return None
    distance_draw, kind, hide_draw, side_draw, a, b, c = rng.random(7).tolist()
    share = 0.5 + 0.35 * distance_draw
    distance = max(hypot(feet[0], feet[1]), 1e-6)
    heading = atan2(feet[1], feet[0])
    if kind < 0.55:
        # occludes the legs up to a share of the height: its top is on the beam to that height
        share = min(0.5 + 0.47 * distance_draw, 1 - _BEFORE / max(distance, 2 * _BEFORE))
        top = share * (feet[2] + tall * (0.15 + 0.40 * hide_draw)) - feet[2]
        mesh = _low(max(top, 0.1), share, a, b, c, rng)
        return mesh.moved((feet[0] * share, feet[1] * share, feet[2]), heading + 0.5 * (side_draw - 0.5))
    if kind < 0.8:
        # occludes one side, from an edge between a hand's breadth beyond the middle and the shoulder
        edge = (-0.05 + 0.30 * hide_draw) * share
        mesh, half_width = _tall(distance, share, tall, a, b, c, rng)
        lateral_offset = edge + half_width if side_draw < 0.5 else -(edge + half_width)
    else:
        # occludes a strip
        mesh, lateral_offset = _strip(share, tall, a, b, c, rng), (side_draw + hide_draw - 1) * 0.5 * share
    position = (
        feet[0] * share - lateral_offset * feet[1] / distance,
        feet[1] * share + lateral_offset * feet[0] / distance,
        feet[2],
    )
    return mesh.moved(position, heading)


def _low(top: float, share: float, a: float, b: float, c: float, rng: np.random.Generator) -> Mesh:
    """A car's hood, a parapet, a hedge or a fence, `top` m high."""
    if a < 0.35:
        return shape("bonnet", min(0.5 + 0.5 * b, share), 1.7, top)
    if a < 0.55:
        return shapes.box((0.3, (1.0 + 2.0 * b) * share, top))
    if a < 0.75:
        return shapes.foliage((0.4, (1.2 + 1.5 * b) * share, 1.1 * top), 90 + int(30 * c), 0.06 + 0.08 * c, rng)
    if a < 0.88:
        return shapes.rail_fence(3.0 * share, top, 2 + int(2 * c))
    # a fence that beams pass through may be taller
    return shapes.lattice_fence(2.4 * share, top * (1 + b), 0.10 + 0.08 * b, 0.02 + 0.03 * c)


def _tall(
    distance: float, share: float, person_height: float, a: float, b: float, c: float, rng: np.random.Generator
) -> tuple[Mesh, float]:
    """A mesh with an edge that occludes one side of a person: a wall, a van or a hedge higher than the person, or a
    parked car; and its half width."""
    clearance = distance * min(share, 1 - share)
    if a < 0.3 and clearance > 1.2:
        width = 1.7 + 0.2 * b
        # seen from its end: the person stands beside it
        if clearance > 2.8:
            mesh = shape("car", 3.8 + c, width, 1.45) if b < 0.5 else shape("van", 4.6 + c, width, 2.0 + 0.4 * c)
            return mesh, width / 2
        return shape("van", 1.6, 1.6 + c, 2.2).moved((0, 0, 0), pi / 2), 0.8
    if a < 0.5:
        width = 0.8 + 0.6 * b
        return shapes.foliage((0.5, width, person_height + 0.3 + c), 120, 0.10 + 0.10 * b, rng), 0.45 * width
    return shapes.box((0.2, 1.5, person_height + 2)), 0.75


def _strip(share: float, person_height: float, a: float, b: float, c: float, rng: np.random.Generator) -> Mesh:
    """A pole, a trunk, a signpost, a hanging branch or a pillar."""
    radius = (0.03 + 0.17 * b * b) * share
    if a < 0.6:
        return shape("pole", radius, radius, person_height + 2)
    if a < 0.7:
        return shapes.sign(1.3 + 0.8 * c, 0.35 * share + 0.2 * b)
    if a < 0.85:
        # its lower end is between the hips and the head
        mesh = shapes.foliage((0.4, 0.6 * share + 0.4 * b, 1.0), 60 + int(60 * c), 0.08 + 0.06 * b, rng)
        stem = shape("pole", 0.02, 0.02, 0.6)
        return shapes.union([stem, mesh.moved((0, 0, 0.55 + 0.5 * c))])
    return shapes.box((0.3, (0.15 + 0.25 * b) * share, person_height + 2))


def ground(config: SceneConfig, feet: np.ndarray, rng: np.random.Generator) -> Mesh:
    """The ground around the feet (3,) m. Paper: a square of half width 1 m with a normally distributed tilt in a random
    direction.

    Else a square of half width 3 m. Depending on `clutter` and `hard`, it may have a curb (the person on either level),
    a rough surface, which is not above the soles at the feet, or grass around the ankles.
    """
    u, v, kind, heading_draw, a, b, c = rng.random(7).tolist()
    # a standard normal from two uniform numbers: Box and Muller 1958
    normal, heading = sqrt(-2 * log(1 - u)) * cos(2 * pi * v), (2 * heading_draw - 1) * pi
    tilt = tan(min(max(config.slope * normal, -STEEPEST), STEEPEST))
    slope = (tilt * cos(heading), tilt * sin(heading))
    if config.follows_paper:
        return shapes.quad(_PAPER_HALF, slope).moved(feet)
    share_scale = config.clutter * config.hard
    if kind < _KERB * share_scale:
        return _kerb(slope, a, b, c).moved(feet)
    kind -= _KERB * share_scale
    if kind < _ROUGH * share_scale:
        return _rough(slope, a, rng).moved(feet)
    kind -= _ROUGH * share_scale
    if kind < _GRASS * share_scale:
        lawn = shapes.grass(0.5 + 0.3 * a, 0.05 + 0.15 * b, 40 + int(40 * c), rng)
        lawn.vertices[:, 2] += lawn.vertices[:, :2] @ np.array(slope, np.float32)
        return shapes.union([shapes.quad(_WILD_HALF, slope), lawn]).moved(feet)
    return shapes.quad(_WILD_HALF, slope).moved(feet)


def _kerb(slope: tuple[float, float], a: float, b: float, c: float) -> Mesh:
    """Two levels with an edge 0.2 to 0.9 m from the feet; the level at the feet is 0."""
    turn, edge = 2 * pi * a, 0.2 + 0.7 * b
    step = (0.04 + 0.14 * abs(2 * c - 1)) * (1 if c < 0.5 else -1)
    half = _WILD_HALF
    strip = [[-half, -half, 0], [edge, -half, 0], [edge, half, 0], [-half, half, 0]]
    riser = [[edge, -half, 0], [edge, -half, step], [edge, half, step], [edge, half, 0]]
    beyond = [[edge, -half, step], [half, -half, step], [half, half, step], [edge, half, step]]
    kerb = Mesh(np.array(strip + riser + beyond, np.float32), shapes.repeated(3, 4, "quad")).moved((0, 0, 0), turn)
    kerb.vertices[:, 2] += kerb.vertices[:, :2] @ np.array(slope, np.float32)
    return kerb


def _rough(slope: tuple[float, float], a: float, rng: np.random.Generator) -> Mesh:
    """A height field with a finer grid toward the feet, where the heights are at most 0."""
    flat_vertices, faces, scale, is_at_feet = _grid()
    vertices = flat_vertices.copy()
    height = rng.standard_normal(len(flat_vertices), np.float32) * np.float32(_ROUGHNESS * (0.5 + a))
    # the soles must not be buried
    np.minimum(height, 0, out=height, where=is_at_feet)
    vertices[:, 2] = height * scale + flat_vertices[:, :2] @ np.array(slope, np.float32)
    return Mesh(vertices, faces)


@cache
def _grid() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Flat vertices ((cells + 1)^2, 3), denser near the middle; faces, two triangles per cell; the scale of each
    vertex's height, 1 at the feet; which vertices are under or beside the feet."""
    coordinates = np.linspace(-1, 1, _CELLS + 1)
    coordinates = _WILD_HALF * np.sign(coordinates) * np.abs(coordinates) ** 1.7
    plane = shapes.grid(coordinates, coordinates)
    vertices = plane.vertices
    return vertices, plane.faces, 1 + 0.4 * np.abs(vertices[:, :2]).sum(1), np.hypot(*vertices[:, :2].T) < 0.6
