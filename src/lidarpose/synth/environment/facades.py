"""Fronts of buildings, with relief."""

import numpy as np

from lidarpose.synth.environment import mesh as shapes
from lidarpose.synth.environment.mesh import Mesh, at, post


def facade(
    length: float, height: float, rng: np.random.Generator, *, bars: float = 0.2, niches: float = 0.25
) -> list[tuple[str, Mesh]]:
    """A front along y with its face at x = 0 and relief: recessed windows, some with bars, niches and doorways,
    pilasters, drainpipes, ledges; open windows show a room behind."""
    centers, sizes, rods = [], [], []

    def block(y: float, width: float, low: float, high: float, front_x: float, depth: float) -> None:
        """A box that extends backward from x = front_x."""
        centers.append((front_x - depth / 2, y, low))
        sizes.append((depth, width, high - low))

    thickness, y = rng.uniform(0.15, 0.5), -length / 2
    sill, top = rng.uniform(0.5, 1.1), rng.uniform(1.9, 2.6)
    while y < length / 2 - 0.3:
        bay_width = min(rng.uniform(0.8, 2.6), length / 2 - y)
        kind, opening_draw, depth_draw, u, v = rng.random(5)
        center, opening = y + bay_width / 2, bay_width * (0.45 + 0.35 * opening_draw)
        if kind < 0.3 or height < 2.8:
            block(center, bay_width, 0, height, 0, thickness)
            if u < 0.25:
                rods.append(post(0.04 + 0.03 * v, height, 0.07, center))
        elif kind < 0.3 + niches:
            # a doorway or a niche
            niche_depth = 0.15 + 1.0 * depth_draw * depth_draw
            for side in (-1, 1):
                block(center + side * (bay_width + opening) / 4, (bay_width - opening) / 2, 0, height, 0, niche_depth)
            block(center, opening, 2.0 + 0.5 * u, height, 0, niche_depth)
            block(center, opening, 0, 2.6, -niche_depth, 0.05)
            if v < 0.4:
                block(center, opening, 0, 0.1 + 0.3 * u, -0.1, niche_depth)
        elif kind < 0.88:
            block(center, bay_width, 0, sill, 0, thickness)
            block(center, bay_width, top, height, 0, thickness)
            for side in (-1, 1):
                block(center + side * (bay_width + opening) / 4, (bay_width - opening) / 2, sill, top, 0, thickness)
            if u < 0.7:
                block(center, opening, sill, top, -thickness * (0.3 + 0.6 * depth_draw), 0.03)
            block(center, opening + 0.1, sill - 0.06, sill, 0.08, 0.1)
            if v < bars:
                rods.append(at(window_bars(opening, top - sill, rng), 0.03, center, sill))
        else:
            # a pilaster or a corner of a projection
            projection = 0.08 + 0.5 * depth_draw * depth_draw
            block(center, bay_width, 0, height, 0, thickness)
            block(center, 0.25 + 0.5 * u, 0, height, projection, projection + 0.05)
        y += bay_width
    if rng.random() < 0.4:
        block(0, length, height * 0.6, height * 0.6 + 0.2, 0.15, 0.2)
    # the back wall of the rooms
    block(0, length, 0, height, -1.5 - 3 * rng.random(), 0.1)
    front = shapes.boxes(np.array(centers), np.array(sizes))
    return [("facade", front)] + [("window bars" if len(rod.faces) > 30 else "pole", rod) for rod in rods]


def window_bars(width: float, height: float, rng: np.random.Generator) -> Mesh:
    count = max(3, int(width / rng.uniform(0.09, 0.16)))
    middle, size = np.zeros((count + 2, 3)), np.empty((count + 2, 3))
    middle[:count, 1] = (np.arange(count) + 0.5) * (width / count) - width / 2
    size[:count] = (0.02, 0.02, height)
    middle[count:, 2], size[count:] = (0.1 * height, 0.85 * height), (0.02, width, 0.03)
    return shapes.boxes(middle, size)
