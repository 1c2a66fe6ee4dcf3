"""Props: things and clothes that are attached to a body's joints, and the frames they hang in.

A prop knows where its mesh is for a pose: it is asked again for the next pose, so what is carried moves along. Bodies
stand on z = 0; frames are the body's own.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lidarpose.skeleton import BODY26
from lidarpose.synth.environment.mesh import Mesh
from lidarpose.synth.props.garments import Point, heading

JOINT = {name: i for i, name in enumerate(BODY26.joints)}
PELVIS = JOINT["pelvis"]
HANDS = (JOINT["left_hand"], JOINT["right_hand"])
Points = list[Point]
# where a frame is: rows say where the prop's x, y and z go, then its origin
Rows = tuple[list, list]


@dataclass(frozen=True, kw_only=True)
class Prop:
    """name; mesh in the prop's own frame (for clothes: where it was when drawn); where: joints, 26 lists of x, y, z,
    -> the vertices (V, 3) m there; face_part (F,) uint8 = 1 + SMPL joint for clothes, None for things, which are not
    the person; lift m: how far the body stands above the ground for it, as a cyclist does."""

    name: str
    mesh: Mesh
    where: Callable[[Points], np.ndarray]
    face_part: np.ndarray | None = None
    lift: float = 0.0

    def place(self, joints: np.ndarray) -> Mesh:
        """The mesh for a pose: joints (26, 3) m in BODY26's order."""
        return Mesh(self.where(joints.tolist()), self.mesh.faces)


def fixed(name: str, mesh: Mesh, frame: Callable[[Points], Rows], **more: object) -> Prop:
    """A prop that keeps its shape."""

    def where(points: Points) -> np.ndarray:
        return mesh.placed(*frame(points)).vertices

    return Prop(name=name, mesh=mesh, where=where, **more)


def upright(points: Points, size: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> list:
    """Rows: ahead, left, up, each as long as `size`."""
    x, y = heading(points)
    a, b, c = size
    return [[a * x, a * y, 0.0], [-b * y, b * x, 0.0], [0.0, 0.0, c]]


def ahead_of_pelvis(points: Points, joint: int) -> float:
    """How far a joint is ahead of the pelvis, m."""
    x, y = heading(points)
    pelvis, at = points[PELVIS], points[joint]
    return (at[0] - pelvis[0]) * x + (at[1] - pelvis[1]) * y


def middle(a: Point, b: Point) -> Point:
    return [(p + q) / 2 for p, q in zip(a, b, strict=True)]
