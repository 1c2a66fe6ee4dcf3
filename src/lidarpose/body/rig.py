"""The shipped body: a mesh with SMPL's joint tree, its shapes, and how a pose moves it.

The rest pose is a T-pose that faces +x: arms along +-y with the palms down, legs down, feet along +x, and the pelvis
at the origin. All bone frames are the house frame at rest, so a pose is 24 local rotations R_j and the position of
the pelvis:

    G_j = G_parent @ R_j        p_j = p_parent + G_parent @ (rest_j - rest_parent)

Flexing a hip (thigh forwards) is a negative rotation about y, flexing a knee a positive one.

n people, V vertices, F faces, S shape coefficients. Lengths in metres, house frame (x forward, y left, z up).
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cache
from importlib import resources

import numpy as np

from lidarpose.errors import InputError
from lidarpose.skeleton import BODY26, SMPL24

# the points behind SMPL's 24 joints that the head carries
HEAD_POINTS = tuple(range(len(SMPL24), len(BODY26)))
HEAD = SMPL24.index("head")


@dataclass(frozen=True, kw_only=True)
class Rig:
    """The body as stored. Arrays are read-only, C-contiguous.

    faces (F, 3) int32, counter-clockwise seen from outside; face_part (F,) uint8 = 1 + SMPL joint (0 is "not body");
    weight_index, weight (V, 4) int32, float32: the joints that move a vertex, strongest first, unused ones 0;
    parents (24,) int32; template (V, 3) and morphs (S, V, 3) m, m a unit of coefficient; joint_template (26, 3) and
    joint_morphs (S, 26, 3) likewise, in BODY26's order. The table of N sampled people: coefficients (N, S),
    sex (N,) "female" or "male", age (N,) years, height (N,) m, bmi (N,) kg/m2.
    """

    faces: np.ndarray
    face_part: np.ndarray
    weight_index: np.ndarray
    weight: np.ndarray
    parents: np.ndarray
    template: np.ndarray
    morphs: np.ndarray
    joint_template: np.ndarray
    joint_morphs: np.ndarray
    coefficients: np.ndarray
    sex: np.ndarray
    age: np.ndarray
    height: np.ndarray
    bmi: np.ndarray

    def __post_init__(self):
        for field in fields(self):
            getattr(self, field.name).flags.writeable = False

    @property
    def dense_weight(self) -> np.ndarray:
        """(V, 24) float32: how much each joint moves each vertex; rows sum to 1."""
        dense = np.zeros((len(self.weight), len(SMPL24)), np.float32)
        np.add.at(dense, (np.arange(len(dense))[:, None], self.weight_index), self.weight)
        return dense

    def rest(self, coefficients: np.ndarray) -> "RestBody":
        """The T-posed bodies of shape coefficients (n, S); zeros are the table's mean person."""
        coefficients = np.asarray(coefficients, np.float32)
        count = len(self.morphs)
        if coefficients.ndim != 2 or coefficients.shape[1] != count:
            raise InputError(f"shape coefficients must be (n, {count}), got {coefficients.shape}")
        both = []
        for template, morphs in ((self.template, self.morphs), (self.joint_template, self.joint_morphs)):
            flat = coefficients @ morphs.reshape(count, -1)
            both.append(template + flat.reshape(-1, *template.shape))
        return RestBody(vertices=both[0], joints=both[1])


@dataclass(frozen=True, kw_only=True)
class RestBody:
    """T-posed bodies, pelvis at the origin: vertices (n, V, 3), joints (n, 26, 3) in BODY26's order, float32 m."""

    vertices: np.ndarray
    joints: np.ndarray

    @property
    def lowest(self) -> np.ndarray:
        """(n,) z of the soles: standing upright, the pelvis is -lowest above the ground."""
        return self.vertices[..., 2].min(-1)


@cache
def load_rig() -> Rig:
    """The shipped body; read once."""
    with resources.files(__package__).joinpath("assets/body.npz").open("rb") as file:
        stored = dict(np.load(file, allow_pickle=False))
    for name in ("template", "morphs", "joint_template", "joint_morphs", "coefficients", "age", "height", "bmi"):
        stored[name] = np.ascontiguousarray(stored[name], np.float32)
    stored["weight"] = stored["weight"].astype(np.float32) / np.float32(255)
    for name in ("faces", "weight_index"):
        stored[name] = np.ascontiguousarray(stored[name], np.int32)
    stored["sex"] = np.where(stored.pop("female"), "female", "male")
    return Rig(parents=np.array(SMPL24.parents, np.int32), **stored)


def forward_kinematics(
    parents: Sequence[int], rest_joints: np.ndarray, rotations: np.ndarray, translation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Global rotations (n, J, 3, 3) and positions (n, J, 3) of a tree whose parents precede their children.

    rest_joints (n or 1, J, 3) m; rotations (n, J, 3, 3) local; translation (n, 3) m, where the root goes.
    J = len(parents).
    """
    rotations, translation = np.asarray(rotations), np.asarray(translation)
    turned = np.empty_like(rotations)
    position = np.empty(rotations.shape[:-1], np.result_type(rest_joints, rotations, translation))
    for j, parent in enumerate(parents):
        if parent < 0:
            turned[:, j], position[:, j] = rotations[:, j], translation
        else:
            turned[:, j] = turned[:, parent] @ rotations[:, j]
            bone = (rest_joints[:, j] - rest_joints[:, parent])[..., None]
            position[:, j] = position[:, parent] + (turned[:, parent] @ bone)[..., 0]
    return turned, position


def pose_bodies(
    rig: Rig, rest: RestBody, rotations: np.ndarray, translation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, V, 3) and joints (n, 26, 3) float32 m of posed bodies, by linear blend skinning.

    rotations (n, 24, 3, 3) local, translation (n, 3) m, the pelvis. One core, no threads: callers spread people
    themselves. Without numba the reference answers. Twin: `pose_bodies_reference`.
    """
    rotations, translation = _checked(rest, rotations, translation)
    try:
        from lidarpose.body.rig_kernels import pose_people
    except ImportError:
        return pose_bodies_reference(rig, rest, rotations, translation)
    vertices, joints = np.empty_like(rest.vertices), np.empty_like(rest.joints)
    pose_people(
        rest.vertices, rest.joints, rotations, translation, rig.parents, rig.weight_index, rig.weight, vertices, joints
    )
    return vertices, joints


def pose_bodies_reference(
    rig: Rig, rest: RestBody, rotations: np.ndarray, translation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """`pose_bodies` as the formula reads: every vertex moves with the weighted sum of its bones' motions."""
    rotations, translation = _checked(rest, rotations, translation)
    rest_joints = rest.joints[:, : len(SMPL24)]
    turned, position = forward_kinematics(rig.parents, rest_joints, rotations, translation)
    shift = position - (turned @ rest_joints[..., None])[..., 0]
    blend = (turned[:, rig.weight_index] * rig.weight[..., None, None]).sum(2)
    offset = (shift[:, rig.weight_index] * rig.weight[..., None]).sum(2)
    vertices = (blend @ rest.vertices[..., None])[..., 0] + offset
    carried = rest.joints[:, HEAD_POINTS] @ np.swapaxes(turned[:, HEAD], -1, -2) + shift[:, None, HEAD]
    return vertices, np.concatenate([position, carried], 1)


def vertex_normals(faces: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """(n, V, 3) unit normals that point outwards: area-weighted means over the faces around a vertex.

    faces (F, 3) int32, vertices (n, V, 3) float32. Without numba the reference answers.
    """
    vertices = np.ascontiguousarray(vertices, np.float32)
    try:
        from lidarpose.body.rig_kernels import normals_of_people
    except ImportError:
        return vertex_normals_reference(faces, vertices)
    normals = np.empty_like(vertices)
    normals_of_people(faces, vertices, normals)
    return normals


def vertex_normals_reference(faces: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """`vertex_normals` in numpy."""
    a, b, c = np.moveaxis(vertices[:, faces], 2, 0)
    normals = np.zeros_like(vertices)
    cross = np.cross(b - a, c - a)
    for corner in faces.T:
        np.add.at(normals, (slice(None), corner), cross)
    return normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-20)


def _checked(rest: RestBody, rotations: np.ndarray, translation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    count = len(rest.vertices)
    rotations = np.ascontiguousarray(rotations, np.float32)
    translation = np.ascontiguousarray(translation, np.float32)
    if rotations.shape != (count, len(SMPL24), 3, 3) or translation.shape != (count, 3):
        raise InputError(
            f"{count} bodies need rotations ({count}, 24, 3, 3) and translation ({count}, 3), "
            f"got {rotations.shape} and {translation.shape}"
        )
    return rotations, translation
