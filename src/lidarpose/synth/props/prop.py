"""A prop of a person: a mesh attached to a body's joints.

A prop computes its vertices from the joints of a pose, so it moves with the body from pose to pose. Bodies stand on
z = 0. A `Frame` places a prop in the body's own frame: three rows, the images of the prop's x, y and z axes, and its
origin.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import hypot
from typing import Any

import numpy as np

from lidarpose.synth.environment.mesh import Mesh
from lidarpose.synth.props.garments import JOINT, Point, Points, heading

PELVIS = JOINT["pelvis"]
HANDS = (JOINT["left_hand"], JOINT["right_hand"])
Frame = Callable[[Points], tuple[Sequence, Sequence]]


@dataclass(frozen=True, kw_only=True)
class Prop:
    """A thing or a garment of a person.

    Args:
        name: as in `carried.CARRIED` and `mounts.RIDES`, or "skirt" or "hat".
        mesh: in the prop's own frame; for clothes and bicycles, its shape in the pose for which it was drawn.
        where: joints, 26 lists of x, y, z -> the vertices (V, 3) m for that pose.
        face_part: (F,) uint8 = 1 + SMPL joint for clothes; None for things, which are not part of the person.
        lift: height of the body's lowest point above the ground with this prop, as for a cyclist, m.
    """

    name: str
    mesh: Mesh
    where: Callable[[Points], np.ndarray]
    face_part: np.ndarray | None = None
    lift: float = 0.0

    def place(self, joints: np.ndarray) -> Mesh:
        """The mesh for a pose: joints (26, 3) m in BODY26's order."""
        return Mesh(self.where(joints.tolist()), self.mesh.faces)


def rigid_prop(name: str, mesh: Mesh, frame: Frame, **more: Any) -> Prop:
    """A prop that keeps its shape."""
    return Prop(name=name, mesh=mesh, where=lambda points: mesh.placed(*frame(points)).vertices, **more)


def upright(points: Points, size: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> list:
    """Rows of a frame: forward, left and up, with the lengths `size`."""
    x, y = heading(points)
    a, b, c = size
    return [[a * x, a * y, 0.0], [-b * y, b * x, 0.0], [0.0, 0.0, c]]


def rod_rows(start: tuple, end: tuple, radius: float) -> tuple[list, list]:
    """Rows (3, 3) and an origin that put the mesh "tube" or "rod" between two points (x, y, z)."""
    dx, dy, dz = (b - a for a, b in zip(start, end, strict=True))
    length = max((dx * dx + dy * dy + dz * dz) ** 0.5, 1e-6)
    flat_length = hypot(dx, dy)
    side_axis = (-dy / flat_length, dx / flat_length, 0.0) if flat_length > 1e-3 * length else (0.0, 1.0, 0.0)
    x, y, z = side_axis
    second_axis = (
        z * dy / length - y * dz / length,
        x * dz / length - z * dx / length,
        y * dx / length - x * dy / length,
    )
    return [[radius * a for a in side_axis], [radius * a for a in second_axis], [dx, dy, dz]], list(start)


def ahead_of_pelvis(points: Points, point: Point) -> float:
    """Distance by which a point is ahead of the pelvis, m."""
    x, y = heading(points)
    return (point[0] - points[PELVIS][0]) * x + (point[1] - points[PELVIS][1]) * y
