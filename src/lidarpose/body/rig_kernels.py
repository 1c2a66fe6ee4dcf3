"""The compiled inner loops of `rig`: importing this module needs numba.

All arrays are float32 and C-contiguous. Every kernel runs on one core and releases the GIL, so threads can pose people
in parallel. Slow reference implementations: tests/reference/rig.py.
"""

import numba
import numpy as np

from lidarpose.skeleton import SMPL24

# compile-time constants
_HEAD = SMPL24.index("head")
_JOINTS = len(SMPL24)
# float32 sums may be reordered and fused for vectorization: differences stay at rounding level
_jit = numba.njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz", "arcp"})


@_jit
def pose_people(rest_vertices, rest_joints, rotations, translation, parents, weight_index, weight, vertices, joints):
    """Poses n people sequentially: rest_vertices (n, V, 3), rest_joints (n, 26, 3), rotations (n, 24, 3, 3) and
    translation (n, 3) -> fills vertices (n, V, 3) and joints (n, 26, 3)."""
    # rows of [G | p - G rest]: the transform that a bone applies to a point of the rest pose
    motion = np.empty((_JOINTS, 12), np.float32)
    for i in range(rotations.shape[0]):
        for j in range(_JOINTS):
            p = parents[j]
            for a in range(3):
                if p < 0:
                    joints[i, j, a] = translation[i, a]
                    for b in range(3):
                        motion[j, 4 * a + b] = rotations[i, j, a, b]
                else:
                    joints[i, j, a] = motion[p, 4 * a + 3]
                    for c in range(3):
                        joints[i, j, a] += motion[p, 4 * a + c] * rest_joints[i, j, c]
                    for b in range(3):
                        motion[j, 4 * a + b] = (
                            motion[p, 4 * a] * rotations[i, j, 0, b]
                            + motion[p, 4 * a + 1] * rotations[i, j, 1, b]
                            + motion[p, 4 * a + 2] * rotations[i, j, 2, b]
                        )
            for a in range(3):
                motion[j, 4 * a + 3] = joints[i, j, a] - (
                    motion[j, 4 * a] * rest_joints[i, j, 0]
                    + motion[j, 4 * a + 1] * rest_joints[i, j, 1]
                    + motion[j, 4 * a + 2] * rest_joints[i, j, 2]
                )
        for k in range(_JOINTS, rest_joints.shape[1]):
            for a in range(3):
                joints[i, k, a] = (
                    motion[_HEAD, 4 * a] * rest_joints[i, k, 0]
                    + motion[_HEAD, 4 * a + 1] * rest_joints[i, k, 1]
                    + motion[_HEAD, 4 * a + 2] * rest_joints[i, k, 2]
                    + motion[_HEAD, 4 * a + 3]
                )
        for v in range(rest_vertices.shape[1]):
            x, y, z = rest_vertices[i, v, 0], rest_vertices[i, v, 1], rest_vertices[i, v, 2]
            px, py, pz = np.float32(0), np.float32(0), np.float32(0)
            for k in range(weight_index.shape[1]):
                w = weight[v, k]
                if w == 0:
                    break
                m = motion[weight_index[v, k]]
                px += w * (m[0] * x + m[1] * y + m[2] * z + m[3])
                py += w * (m[4] * x + m[5] * y + m[6] * z + m[7])
                pz += w * (m[8] * x + m[9] * y + m[10] * z + m[11])
            vertices[i, v, 0] = px
            vertices[i, v, 1] = py
            vertices[i, v, 2] = pz


@_jit
def vertex_normals(faces, vertices, normals):
    """Fills normals (V, 3) with the outward unit normals of one mesh, area-weighted over the faces at each vertex:
    faces (F, 3) int32, vertices (V, 3)."""
    normals[:] = 0
    for f in range(faces.shape[0]):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, az = vertices[i, 0], vertices[i, 1], vertices[i, 2]
        bx, by, bz = vertices[j, 0] - ax, vertices[j, 1] - ay, vertices[j, 2] - az
        cx, cy, cz = vertices[k, 0] - ax, vertices[k, 1] - ay, vertices[k, 2] - az
        nx, ny, nz = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
        for v in (i, j, k):
            normals[v, 0] += nx
            normals[v, 1] += ny
            normals[v, 2] += nz
    for v in range(normals.shape[0]):
        size = np.sqrt(normals[v, 0] ** 2 + normals[v, 1] ** 2 + normals[v, 2] ** 2)
        scale = np.float32(1) / max(size, np.float32(1e-20))
        for a in range(3):
            normals[v, a] *= scale


@_jit
def dress_people(faces, vertices, offset, low, high):
    """Moves vertices (n, V, 3) in place by offset (n, V) m along their normals, and fills low and high (n, 3) with the
    minimum and maximum x, y, z of the result."""
    normals = np.empty(vertices.shape[1:], np.float32)
    for i in range(vertices.shape[0]):
        vertex_normals(faces, vertices[i], normals)
        for a in range(3):
            low[i, a], high[i, a] = np.inf, -np.inf
        for v in range(vertices.shape[1]):
            for a in range(3):
                value = vertices[i, v, a] + offset[i, v] * normals[v, a]
                vertices[i, v, a] = value
                low[i, a], high[i, a] = min(low[i, a], value), max(high[i, a], value)


@_jit
def fold_clothing(template, direction, phase, gain, offset):
    """Multiplies offset (n, V) in place by 1 + gain times the sum of each person's waves at template (V, 3) m.

    Each of the W waves has a wave vector direction (n, W, 3) in periods per meter and a phase (n, W) in periods. Its
    shape is a sine approximated by parabolas.
    """
    for i in range(offset.shape[0]):
        for v in range(offset.shape[1]):
            total = np.float32(0)
            for w in range(direction.shape[1]):
                t = (
                    direction[i, w, 0] * template[v, 0]
                    + direction[i, w, 1] * template[v, 1]
                    + direction[i, w, 2] * template[v, 2]
                    + phase[i, w]
                )
                u = t - np.floor(t) - np.float32(0.5)
                total += np.float32(8) * u * (np.float32(1) - np.float32(2) * abs(u))
            offset[i, v] *= np.float32(1) + gain * total
