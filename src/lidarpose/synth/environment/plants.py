"""Trees, bushes and hedges; builders take uniform numbers (8,) and a random generator, as those of `things`."""

from dataclasses import replace
from math import cos, pi, sin

import numpy as np

from lidarpose.synth.environment import mesh as shapes
from lidarpose.synth.environment.mesh import Mesh, at, box_at, post, shape, union, union_of

# `Mesh.part` of leaves, which beams penetrate a little
LEAVES = 1


def _leaves(mesh: Mesh) -> Mesh:
    return replace(mesh, part=np.full(len(mesh.faces), LEAVES, np.uint8))


def crown(size: tuple[float, float, float], rng: np.random.Generator, *, dense: float = 1.0) -> Mesh:
    """An irregular crown of leaves that stands on the origin: one or several balls."""
    count = 1 + int(2.5 * rng.random() + (max(size) > 2))
    balls = []
    for _ in range(count):
        share = rng.uniform(0.55, 1.0, 3) if count > 1 else np.ones(3)
        offset = (1 - share) * (rng.random(3) - [0.5, 0.5, 0])
        leaf = max(0.05, 0.09 * max(size)) * rng.uniform(0.7, 1.3)
        ball = shapes.foliage(share * size, int(min(120, 70 + 50 * dense)), leaf, rng)
        balls.append(_leaves(ball).moved(offset * size))
        if rng.random() < 0.6 * dense:
            # a dense core that no beam passes
            half = 0.3 * share * size
            balls.append(shape("ball", *half).moved(offset * size + [0, 0, share[2] * size[2] / 2]))
    return union(balls)


def _clipped(size: tuple[float, float, float], rng: np.random.Generator) -> Mesh:
    """A clipped hedge: a box with sides of leaves and a dense core."""
    depth, length, height = size
    leaf = 0.1
    count = int(min(260, 22 * (2 * length * height + 2 * depth * height + depth * length)))
    positions = rng.random((count, 3)) * [depth, length, height] - [depth / 2, length / 2, 0]
    # projected onto a side, which is drawn with probability proportional to its area
    area = np.array([length * height, length * height, depth * height, depth * height, depth * length])
    side = rng.choice(5, count, p=area / area.sum())
    for number, (axis, value) in enumerate(
        ((0, depth / 2), (0, -depth / 2), (1, length / 2), (1, -length / 2), (2, height))
    ):
        positions[side == number, axis] = value
    positions += rng.normal(0, 0.04, positions.shape)
    leaves = positions[:, None] + rng.normal(0, leaf, (count, 3, 3))
    leaves[..., 2] = np.maximum(leaves[..., 2], 0)
    core = box_at((max(depth - 0.25, 0.05), max(length - 0.2, 0.05), max(height - 0.15, 0.1)))
    shell = Mesh(leaves.reshape(-1, 3).astype(np.float32), shapes.repeated(count, 3, "triangle"))
    return union([_leaves(shell), core])


def hedge(u: np.ndarray, rng: np.random.Generator) -> Mesh:
    size = (0.35 + 0.6 * u[0], 0.5 + 4.5 * u[1] ** 2, 0.6 + 1.5 * u[2])
    if u[3] < 0.8:
        return _clipped(size, rng)
    plants = []
    for k in range(max(1, int(size[1] / 0.8))):
        plant = shapes.foliage((size[0] + 0.3, 1.2, size[2] * rng.uniform(0.7, 1.1)), 110, 0.1, rng)
        plants.append(at(_leaves(plant), 0, 0.8 * k))
    return union(plants)


def hedge_at_wall(u: np.ndarray, rng: np.random.Generator) -> Mesh:
    """A hedge, a climber or a pot plant close to a wall."""
    length = 1.0 + 3.5 * u[4]
    plant = hedge(u, rng) if u[5] < 0.6 else crown((0.4 + 0.3 * u[0], 0.4 + 0.5 * u[1], 1.0 + 0.9 * u[2]), rng)
    low, high = plant.vertices.min(0), plant.vertices.max(0)
    wall = box_at((0.2, length, 0.8 + 2.2 * u[6]))
    return union([at(plant, y=-(low[1] + high[1]) / 2), at(wall, low[0] - 0.12)])


def bush(u: np.ndarray, rng: np.random.Generator) -> Mesh:
    width = 0.4 + 1.2 * u[0]
    return crown((width, width * (0.7 + 0.6 * u[1]), 0.5 + 1.4 * u[2]), rng)


def tree(u: np.ndarray, rng: np.random.Generator) -> Mesh:
    """A trunk and a crown above head height."""
    trunk_height, width = 2.0 + 1.2 * u[0], 2.0 + 3.0 * u[1]
    radius = 0.08 + 0.25 * u[2] ** 2
    top = at(crown((width, width, 2 + 2.5 * u[3]), rng), z=trunk_height)
    # suckers at the foot
    suckers = u[4] < 0.3 and shapes.foliage((0.6, 0.6, 0.3 + 0.7 * u[5]), 70, 0.06, rng)
    return union_of(post(radius, trunk_height + 0.8), top, suckers)


def young_tree(u: np.ndarray, rng: np.random.Generator) -> Mesh:
    """A thin trunk and a small crown that starts low."""
    trunk_height, width, height = 0.7 + 1.3 * u[0], 0.4 + 1.0 * u[1], 1.0 + 1.8 * u[3]
    top = at(crown((width, width, height), rng, dense=0.3), z=trunk_height)
    return union([post(0.012 + 0.035 * u[2], trunk_height + height * 0.6), top])


def low_crown(u: np.ndarray, rng: np.random.Generator) -> Mesh:
    """A trunk with a crown down to knee or hip height: thuja, spruce, an old shrub."""
    trunk_height, width, height = 0.1 + 1.0 * u[0], 0.6 + 2.2 * u[1], 1.6 + 3.0 * u[2]
    return union(
        [post(0.05 + 0.15 * u[3], trunk_height + 0.6 * height), at(crown((width, width, height), rng), z=trunk_height)]
    )


def staked_tree(u: np.ndarray, rng: np.random.Generator) -> Mesh:
    """A young tree tied to one to three stakes."""
    parts, count, stake_height = [young_tree(u, rng)], 1 + int(3 * u[4]), 0.9 + 0.9 * u[5]
    distance = 0.12 + 0.25 * u[6]
    for k in range(count):
        angle = 2 * pi * (k / count + u[7])
        parts.append(post(0.025 + 0.02 * u[6], stake_height, distance * cos(angle), distance * sin(angle)))
        if count > 1:
            bar = box_at(
                (0.04, 1.6 * distance, 0.07), distance * cos(angle) / 2, distance * sin(angle) / 2, 0.92 * stake_height
            )
            parts.append(bar)
    return union_of(*parts, u[0] < 0.3 and post(0.08 + 0.06 * u[1], 0.9 + 0.5 * u[2]))


def pot_plant(u: np.ndarray, rng: np.random.Generator) -> Mesh:
    """A pot plant."""
    pot_height, width = 0.25 + 0.35 * u[0], 0.3 + 0.6 * u[1]
    return union(
        [post(0.5 * pot_height, pot_height), at(crown((width, width, 0.4 + 1.1 * u[2]), rng, dense=0.5), z=pot_height)]
    )
