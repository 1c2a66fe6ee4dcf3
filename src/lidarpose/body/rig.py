"""The shipped body: a mesh with SMPL's joint tree, its shapes, and how a pose moves it.

The rest pose is a T-pose that faces +x: arms along +-y with the palms down, legs down, feet along +x, and the pelvis
at the origin. All bone frames are the level frame (x forward, y left, z up) at rest, so a pose is 24 local rotations
R_j and the position of the pelvis:

    G_j = G_parent @ R_j        p_j = p_parent + G_parent @ (rest_j - rest_parent)

Flexing a hip (thigh forwards) is a negative rotation about y, flexing a knee a positive one.

n people, V vertices, F faces, S shape coefficients. Lengths in meters.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cache
from importlib import resources

import numpy as np

from lidarpose.skeleton import SMPL24


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
        """The T-posed bodies of shape coefficients (n, S); zeros are the mean person of the table."""
        coefficients = np.asarray(coefficients, np.float32)

        def shaped(template: np.ndarray, morphs: np.ndarray) -> np.ndarray:
            return template + (coefficients @ morphs.reshape(len(morphs), -1)).reshape(-1, *template.shape)

        return RestBody(
            vertices=shaped(self.template, self.morphs), joints=shaped(self.joint_template, self.joint_morphs)
        )


@dataclass(frozen=True, kw_only=True)
class RestBody:
    """T-posed bodies, pelvis at the origin: vertices (n, V, 3), joints (n, 26, 3) in BODY26's order, float32 m."""

    vertices: np.ndarray
    joints: np.ndarray


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
    parents: Sequence[int] | np.ndarray, rest_joints: np.ndarray, rotations: np.ndarray, translation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Global rotations and joint positions of a kinematic tree.

    Args:
        parents: J indices, -1 for the root; parents precede their children.
        rest_joints: (n or 1, J, 3) m.
        rotations: (n, J, 3, 3), local.
        translation: (n, 3) m, where the root goes.

    Returns:
        Global rotations (n, J, 3, 3) and positions (n, J, 3) m.
    """
    rotations, translation = np.asarray(rotations), np.asarray(translation)
    global_rotations = np.empty_like(rotations)
    positions = np.empty(rotations.shape[:-1], np.result_type(rest_joints, rotations, translation))
    for j, parent in enumerate(parents):
        if parent < 0:
            global_rotations[:, j], positions[:, j] = rotations[:, j], translation
        else:
            global_rotations[:, j] = global_rotations[:, parent] @ rotations[:, j]
            bone = (rest_joints[:, j] - rest_joints[:, parent])[..., None]
            positions[:, j] = positions[:, parent] + (global_rotations[:, parent] @ bone)[..., 0]
    return global_rotations, positions


def pose_bodies(
    rig: Rig, rest: RestBody, rotations: np.ndarray, translation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Poses bodies by linear blend skinning, on one core: callers spread people over threads themselves.

    Args:
        rotations: (n, 24, 3, 3) local rotations.
        translation: (n, 3) m, where the pelvis goes.

    Returns:
        Vertices (n, V, 3) and joints (n, 26, 3) in BODY26's order, float32 m.

    Raises:
        ModuleNotFoundError: without numba.
    """
    from lidarpose.body.rig_kernels import pose_people

    rotations, translation = (np.ascontiguousarray(a, np.float32) for a in (rotations, translation))
    vertices, joints = np.empty_like(rest.vertices), np.empty_like(rest.joints)
    pose_people(
        rest.vertices, rest.joints, rotations, translation, rig.parents, rig.weight_index, rig.weight, vertices, joints
    )
    return vertices, joints
