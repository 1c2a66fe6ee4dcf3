"""Slow NumPy reference implementations of the compiled body kernels. Arguments as in `lidarpose.body`."""

import numpy as np

from lidarpose.body.rig import FOLD_GAIN, forward_kinematics
from lidarpose.skeleton import BODY26, SMPL24

HEAD = SMPL24.index("head")
HEAD_POINTS = tuple(range(len(SMPL24), len(BODY26)))  # joints after SMPL's 24; they move with the head


def pose_bodies_reference(rig, rest, rotations, translation):
    """Linear blend skinning: each vertex is moved by the weighted sum of its bones' transforms."""
    rotations, translation = np.float32(rotations), np.float32(translation)
    rest_joints = rest.joints[:, : len(SMPL24)]
    turned, position = forward_kinematics(rig.parents, rest_joints, rotations, translation)
    shift = position - (turned @ rest_joints[..., None])[..., 0]
    blend = (turned[:, rig.weight_index] * rig.weight[..., None, None]).sum(2)
    offset = (shift[:, rig.weight_index] * rig.weight[..., None]).sum(2)
    vertices = (blend @ rest.vertices[..., None])[..., 0] + offset
    carried = rest.joints[:, HEAD_POINTS] @ np.swapaxes(turned[:, HEAD], -1, -2) + shift[:, None, HEAD]
    return vertices, np.concatenate([position, carried], 1)


def vertex_normals_reference(faces, vertices):
    """(n, V, 3) unit normals: area-weighted means over the faces around a vertex."""
    a, b, c = np.moveaxis(vertices[:, faces], 2, 0)
    normals = np.zeros_like(vertices)
    cross = np.cross(b - a, c - a)
    for corner in faces.T:
        np.add.at(normals, (slice(None), corner), cross)
    return normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-20)


def add_folds_reference(template, direction, phase, offset):
    """Offset (n, V) modulated by parabolic waves; see `rig_kernels.fold_clothing`."""
    turns = direction @ template.T + phase[..., None]
    u = turns - np.floor(turns) - np.float32(0.5)
    return offset * (1 + FOLD_GAIN * (8 * u * (1 - 2 * np.abs(u))).sum(1))
