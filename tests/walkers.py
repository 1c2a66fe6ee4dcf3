"""Helpers for tests of scenes: a moving box-shaped body, volumes of meshes, and distances to bones."""

from dataclasses import replace

import numpy as np

from lidarpose.geometry import rotation_about
from lidarpose.synth.bodies import Bodies
from lidarpose.synth.environment.mesh import box

HEADINGS, STEP = (0.0, 1.2, -2.0), 1.5


def goer(still=False):
    """A box 0.3 m deep, 0.9 m wide and 1.7 m tall that moves along x and turns; joints along its left-right axis."""
    mesh = box((0.3, 0.9, 1.7))
    headings = (0.0,) * 3 if still else HEADINGS
    vertices, joints, extent = [], [], []
    for frame, heading in enumerate(headings):
        turn, way = rotation_about("z", heading).T, np.array([0.0 if still else STEP * frame, 0, 0])
        vertices.append((mesh.vertices @ turn + way).astype(np.float32))
        joints.append((np.linspace([0, -0.4, 0.1], [0, 0.4, 1.6], 26) @ turn + way).astype(np.float32))
        local = vertices[-1] @ rotation_about("z", heading)
        extent.append((local.min(0).tolist(), local.max(0).tolist()))
    return Bodies(
        vertices=np.array(vertices), joints=np.array(joints), rotations=np.tile(np.eye(3), (3, 24, 1, 1)),
        heading=headings, extent=tuple(extent),
        moved=lambda frame: (vertices[frame], joints[frame]), kinds=("walk",) * 3, faces=mesh.faces,
        face_part=np.full(12, 3, np.uint8),
    )  # fmt: skip


def strider(step):
    """The same body, at the same place in all frames, moving by `step` (3,) m within each frame."""
    still, way = goer(still=True), np.array(step, np.float32)
    return replace(still, moved=lambda frame: (still.vertices[frame] + way, still.joints[frame] + way))


def piece_volumes(mesh):
    """The volume of each connected piece, negative if its faces point inwards."""
    piece = np.arange(len(mesh.vertices))
    for _ in range(len(piece)):
        least = piece.copy()
        for k in range(3):
            np.minimum.at(least, mesh.faces[:, k], piece[mesh.faces].min(1))
        if (least == piece).all():
            break
        piece = least
    corners = mesh.vertices.astype(float)
    volumes = []
    for number in np.unique(piece):
        faces = mesh.faces[piece[mesh.faces[:, 0]] == number]
        a, b, c = np.moveaxis(corners[faces] - corners[piece == number].mean(0), 1, 0)
        volumes.append((np.cross(a, b) * c).sum() / 6)
    return volumes


def bone_distance(points, joints, bones):
    """(n, bones) distances of points (n, 3) to segments."""
    a, b = joints[[p for p, _ in bones]], joints[[c for _, c in bones]]
    along = b - a
    t = ((points[:, None] - a) * along).sum(-1) / np.maximum((along**2).sum(-1), 1e-9)
    return np.linalg.norm(points[:, None] - a - np.clip(t, 0, 1)[..., None] * along, axis=-1)
