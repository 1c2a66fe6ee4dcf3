"""The user's own SMPL, SMPL+H or SMPL-X file as a body: shapes, pose-dependent shapes and linear blend skinning.

Frames: In SMPL's frame y is up; at rest the body stands in a T-pose and faces +z, with its left along +x. In the level
frame z is up; the body of `body.rig` faces +x. With C = R_level_smpl, local rotations are R_smpl = C^-1 R_level C.

n people, V vertices, F faces, J joints (24 for SMPL, 52 for SMPL+H, 55 for SMPL-X), S shape coefficients.
Model: Loper et al. 2015, SMPL; equation numbers below refer to that paper.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path

import numpy as np

from lidarpose.body.rig import Rig, forward_kinematics
from lidarpose.errors import InputError
from lidarpose.geometry import UP_AXES, axis_angle_to_matrix, rotation_vector
from lidarpose.io.files import file_error
from lidarpose.io.npz import read_npz
from lidarpose.io.pickles import Unread, load_pickle
from lidarpose.skeleton import SMPL24

_R_LEVEL_SMPL = UP_AXES["y"]
_KEYS = ("v_template", "shapedirs", "posedirs", "J_regressor", "weights", "kintree_table", "f")
# the models share the joints before this index; then come the hands, and in SMPL-X the jaw and the eyes
_SHARED = SMPL24.index("left_hand")
_HEAD = SMPL24.index("head")
_HANDS = {SMPL24.index(f"{side}_wrist"): SMPL24.index(f"{side}_hand") for side in ("left", "right")}
# (J, S) of SMPL-X files -> number of shape coefficients; the remaining ones are facial expressions
_EXPRESSIONS = {(55, 400): 300, (55, 20): 10}
# tolerance for the sum of a vertex's weights and of a joint's regressor, which files store rounded
_SUM_TOLERANCE = 1e-2
# plausible heights, m; others mean that the unit is not meters
_HEIGHTS = (0.3, 3.0)


def smpl_axis_angles(rotations: np.ndarray, R_world_level: np.ndarray) -> np.ndarray:
    """Poses (n, 24, 3, 3) of `body.rig` as SMPL's axis-angles (n, 24, 3) rad in the world frame."""
    local = _R_LEVEL_SMPL.T @ np.asarray(rotations, float) @ _R_LEVEL_SMPL
    local[:, 0] = R_world_level @ _R_LEVEL_SMPL @ local[:, 0]
    return rotation_vector(local)


@dataclass(frozen=True, kw_only=True)
class SmplBody:
    """A body of the SMPL family. Arrays are read-only, meters, SMPL's frame.

    template (V, 3); shapes (V, 3, S), per unit of coefficient; pose_shapes (V, 3, 9 (J - 1)); regressor (J, V):
    joints from the vertices at rest; weights (V, J), rows sum to 1; parents (J,), -1 for the root; faces (F, 3) int32;
    face_part (F,) uint8 = 1 + SMPL joint, as in `body.rig`: fingers count as hands, jaw and eyes as the head; source:
    the file.
    """

    template: np.ndarray
    shapes: np.ndarray
    pose_shapes: np.ndarray
    regressor: np.ndarray
    weights: np.ndarray
    parents: np.ndarray
    faces: np.ndarray
    face_part: np.ndarray
    source: str

    def __post_init__(self):
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                value.flags.writeable = False

    @property
    def shape_count(self) -> int:
        """S, the maximum number of shape coefficients."""
        return self.shapes.shape[-1]

    def rest(self, betas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """T-posed vertices (n, V, 3) and joints (n, J, 3) m for shape coefficients betas (n, <= S), in SMPL's frame.

        Source: Loper et al. 2015, Eq. 8 and 10.
        """
        betas = self._checked_betas(betas)
        vertices = self.template + np.moveaxis(self.shapes[..., : betas.shape[1]] @ betas.T, -1, 0)
        return vertices, self.regressor @ vertices

    def pose(
        self, betas: np.ndarray, rotations: np.ndarray, translation: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Poses the model as published, in SMPL's frame.

        Args:
            betas: (n, <= S) shape coefficients.
            rotations: Local rotations, as matrices (n, 24 or J, 3, 3), axis-angles (n, 24 or J, 3) or flattened
                axis-angles (n, 72 or 3 J) rad. If 24 rotations are given for SMPL+H or SMPL-X, the hands' rotations
                turn all fingers at their bases; the face and the other finger joints stay at rest.
            translation: (n, 3) m, by default 0, added to all points: the pelvis goes to its rest position plus
                `translation`.

        Returns:
            Vertices (n, V, 3) and joints (n, J, 3), float64 m.

        Raises:
            InputError: For other shapes and for values that are not finite.
        """
        vertices, joints = self.rest(betas)
        rotations = self._all_rotations(rotations, len(vertices))
        root = joints[:, 0] + self._checked_translation(translation, len(vertices))
        return self._posed(vertices, joints, rotations, root)[:2]

    def pose_level(
        self, betas: np.ndarray, rotations: np.ndarray, translation: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Poses the model in the level frame (x forward, y left, z up), as `body.rig.pose_bodies` does.

        Args:
            betas: (n, <= S) shape coefficients.
            rotations: (n, 24, 3, 3) local, in the rest frame of `body.rig`.
            translation: (n, 3) m, position of the pelvis.

        Returns:
            Vertices (n, V, 3) and joints (n, 26, 3), float32 m, the joints in BODY26's order. `nose` is the foremost
            vertex of the head at rest, `head_center` the middle of its leftmost and rightmost vertices (the ears); both
            move with the head. The hands of SMPL+H and SMPL-X are the mean of the finger bases without the thumb.

        Raises:
            InputError: For other shapes and for values that are not finite.
        """
        vertices, joints = self.rest(betas)
        rotations = _as_floats("rotations", rotations)
        if rotations.shape[1:] != (24, 3, 3):
            raise InputError(f"rotations must be ({len(vertices)}, 24, 3, 3), got {rotations.shape}")
        local_rotations = self._all_rotations(_R_LEVEL_SMPL.T @ rotations @ _R_LEVEL_SMPL, len(vertices))
        root = self._checked_translation(translation, len(vertices)) @ _R_LEVEL_SMPL
        nose, ears = self._head_vertices
        points = np.stack([vertices[:, nose], vertices[:, ears].mean(1)], 1) - joints[:, None, _HEAD]
        posed_vertices, positions, global_rotations = self._posed(vertices, joints, local_rotations, root)
        head_points = positions[:, None, _HEAD] + points @ np.swapaxes(global_rotations[:, _HEAD], -1, -2)
        body26 = np.concatenate([positions[:, :_SHARED], self._hands(positions), head_points], 1)
        return tuple((x @ _R_LEVEL_SMPL.T).astype(np.float32) for x in (posed_vertices, body26))

    # alias: the name before version 0.3
    pose_house = pose_level

    def rig(self, betas: np.ndarray) -> Rig:
        """The body as a `Rig` for synthesis, with betas (n, <= S) as its table of people. Each vertex has at most four
        bones, and there are no pose-dependent shapes."""
        betas = self._checked_betas(betas)
        if not len(betas):
            raise InputError("betas must have a row for each person, at least one, got none")
        count = betas.shape[1]
        joint_weights = on_smpl(self.weights, self.parents)
        index = np.argsort(-joint_weights, 1, kind="stable")[:, :4]
        weight = np.take_along_axis(joint_weights, index, 1)
        level_shapes = [
            self._level_rest(shape) for shape in (self.template, *np.moveaxis(self.shapes[..., :count], -1, 0))
        ]
        # index 0 is the template, the others are the changes of vertices and joints per unit of coefficient
        vertices, joints = (
            np.ascontiguousarray(np.stack(arrays), np.float32) for arrays in zip(*level_shapes, strict=True)
        )
        return Rig(
            faces=self.faces.copy(),
            face_part=self.face_part.copy(),
            weight_index=np.ascontiguousarray(np.where(weight > 0, index, 0), np.int32),
            weight=np.ascontiguousarray(weight / weight.sum(1, keepdims=True), np.float32),
            parents=np.array(SMPL24.parents, np.int32),
            template=vertices[0].copy(),
            morphs=vertices[1:].copy(),
            joint_template=joints[0].copy(),
            joint_morphs=joints[1:].copy(),
            coefficients=betas.astype(np.float32),
            **{name: np.zeros(0) for name in ("sex", "age", "height", "bmi")},
        )

    def _level_rest(self, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rest vertices (V, 3), or a shape's offsets of them, in the level frame relative to the pelvis, and the
        corresponding joints of BODY26 (26, 3); linear in the vertices."""
        joints = self.regressor @ vertices
        nose, ears = self._head_vertices
        head_points = np.stack([vertices[nose], vertices[ears].mean(0)])
        body26 = np.concatenate([joints[:_SHARED], self._hands(joints[None])[0], head_points])
        return (vertices - joints[0]) @ _R_LEVEL_SMPL.T, (body26 - joints[0]) @ _R_LEVEL_SMPL.T

    def _posed(
        self, vertices: np.ndarray, joints: np.ndarray, rotations: np.ndarray, root: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices (n, V, 3), joints (n, J, 3) and the joints' global rotations; Eq. 9 and 2 to 4."""
        global_rotations, positions = forward_kinematics(self.parents, joints, rotations, root)
        pose_features = (rotations[:, 1:] - np.eye(3)).reshape(len(rotations), -1)
        translations = positions - (global_rotations @ joints[..., None])[..., 0]
        # each bone's transform as (R | t), so that one product blends rotation and translation
        motion = np.concatenate([global_rotations, translations[..., None]], -1).reshape(
            len(positions), len(self.parents), 12
        )
        posed_vertices = np.empty_like(vertices)
        # one person at a time, to limit the memory of the blended transforms
        for i, rest_vertices in enumerate(vertices):
            blend = (self.weights @ motion[i]).reshape(-1, 3, 4)
            rest_vertices = rest_vertices + self.pose_shapes @ pose_features[i]
            posed_vertices[i] = (blend[..., :3] @ rest_vertices[..., None])[..., 0] + blend[..., 3]
        return posed_vertices, positions, global_rotations

    def _checked_betas(self, betas: np.ndarray) -> np.ndarray:
        betas = _as_floats("betas", betas)
        if betas.ndim != 2 or betas.shape[1] > self.shape_count or not np.isfinite(betas).all():
            raise InputError(f"betas must be finite, (n, up to {self.shape_count}), got {betas.shape}")
        return betas

    @staticmethod
    def _checked_translation(translation: np.ndarray | None, count: int) -> np.ndarray:
        translation = np.zeros((count, 3)) if translation is None else _as_floats("translation", translation)
        if translation.shape != (count, 3) or not np.isfinite(translation).all():
            raise InputError(f"translation must be finite, ({count}, 3), got {translation.shape}")
        return translation

    def _all_rotations(self, rotations: np.ndarray, count: int) -> np.ndarray:
        """Matrices (n, J, 3, 3) from any form of rotations that `pose` accepts."""
        rotations = _as_floats("rotations", rotations)
        joint_count = len(self.parents)
        if rotations.shape in ((count, 72), (count, 3 * joint_count)):
            rotations = rotations.reshape(count, rotations.shape[1] // 3, 3)
        if rotations.shape in ((count, 24, 3), (count, joint_count, 3)):
            rotations = axis_angle_to_matrix(rotations)
        if rotations.shape not in ((count, 24, 3, 3), (count, joint_count, 3, 3)) or not np.isfinite(rotations).all():
            raise InputError(
                f"rotations must be finite, ({count}, {joint_count} or 24, 3, 3) or axis-angles "
                f"({count}, {joint_count} or 24, 3), got {rotations.shape}"
            )
        if rotations.shape[1] == joint_count:
            return rotations
        all_rotations = np.broadcast_to(np.eye(3), (count, joint_count, 3, 3)).copy()
        all_rotations[:, :_SHARED] = rotations[:, :_SHARED]
        for wrist, hand in _HANDS.items():
            all_rotations[:, self._fingers(wrist)] = rotations[:, hand, None]
        return all_rotations

    def _hands(self, joints: np.ndarray) -> np.ndarray:
        """Hand positions (n, 2, 3) from joints (n, J, 3): the mean of the finger bases without the thumb."""
        fingers = [self._fingers(wrist) for wrist in _HANDS]
        # the thumb is the last finger of SMPL+H and SMPL-X
        return np.stack([joints[:, bases[:-1] if len(bases) > 1 else bases].mean(1) for bases in fingers], 1)

    def _fingers(self, wrist: int) -> np.ndarray:
        return np.flatnonzero(self.parents == wrist)

    @cached_property
    def _head_vertices(self) -> tuple[int, np.ndarray]:
        """Indices of the nose's vertex and of the two ears' vertices; shapes move them with the head."""
        head = np.flatnonzero(on_smpl(self.weights, self.parents).argmax(1) == _HEAD)
        x, _, z = self.template[head].T
        return int(head[z.argmax()]), head[[x.argmax(), x.argmin()]]


def _as_floats(name: str, value: object) -> np.ndarray:
    try:
        return np.asarray(value, float)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{name} must be an array of numbers") from None


def load_body(path: str | os.PathLike) -> SmplBody:
    """Reads a user's body model: SMPL, SMPL+H or SMPL-X, .pkl or .npz. No code in the file is executed.

    Raises:
        InputError: For a missing or corrupted file, a missing key, inconsistent array shapes, non-finite values, a
            joint tree other than SMPL's, and units other than meters.
    """
    suffix = Path(os.fspath(path)).suffix.lower() if isinstance(path, str | os.PathLike) else ""
    if suffix == ".npz":
        # SMPL-X files also hold pickled Python objects, which are not read
        arrays, names = read_npz(path, _KEYS, expected="an SMPL .npz")
    elif suffix == ".pkl":
        arrays = load_pickle(path)
        if not isinstance(arrays, dict):
            raise file_error(path, f"expected a dict of SMPL's arrays, got {type(arrays).__name__}")
        names = sorted(map(str, arrays))
    else:
        raise file_error(path, "expected a body model of the SMPL family, .npz or .pkl")
    missing_keys = [key for key in _KEYS if key not in arrays]
    if missing_keys:
        name_list = ", ".join(names[:12]) or "nothing"
        raise file_error(
            path, f"is not a body model of the SMPL family: {', '.join(missing_keys)} missing; it has {name_list}"
        )
    return _body(path, arrays)


def _body(path: object, content: Mapping) -> SmplBody:
    arrays = {key: _numbers(path, key, content[key]) for key in _KEYS}
    template, shapes, pose_shapes, regressor, weights, tree, faces = (arrays[key] for key in _KEYS)
    if template.ndim != 2 or template.shape[1] != 3 or tree.ndim != 2 or len(tree) != 2:
        raise file_error(path, f"needs v_template (V, 3), kintree_table (2, J), got {template.shape}, {tree.shape}")
    vertex_count, joint_count = len(template), tree.shape[1]
    shape_count = shapes.shape[-1] if shapes.ndim == 3 else 0
    expected = {
        "shapedirs": (vertex_count, 3, shape_count),
        "posedirs": (vertex_count, 3, 9 * (joint_count - 1)),
        "J_regressor": (joint_count, vertex_count),
        "weights": (vertex_count, joint_count),
        "f": (len(faces) if faces.ndim else 0, 3),
    }
    for key, shape in expected.items():
        if arrays[key].shape != shape or not arrays[key].size:
            shape_text = "(V, 3, S)" if key == "shapedirs" else "(F, 3)" if key == "f" else shape
            raise file_error(
                path,
                f"{key} must be {shape_text} for {vertex_count} vertices, {joint_count} joints; "
                f"got {arrays[key].shape}",
            )
    parents = _parents(path, tree)
    if (faces != np.round(faces)).any() or faces.min() < 0 or faces.max() >= vertex_count:
        raise file_error(path, f"f must be indices of vertices, 0 to {vertex_count - 1}")
    for key, rows in (("weights", weights), ("J_regressor", regressor)):
        if np.abs(rows.sum(1) - 1).max() > _SUM_TOLERANCE:
            raise file_error(path, f"the rows of {key} must sum to 1; was the file changed?")
    height = np.ptp(template[:, 1])
    if not _HEIGHTS[0] < height < _HEIGHTS[1]:
        raise file_error(path, f"v_template is {height:.3g} high along y; expected meters, y up")
    joint_weights = on_smpl(weights, parents)
    if not (joint_weights.argmax(1) == _HEAD).any():
        raise file_error(path, "no vertex belongs to the head; was the file changed?")
    faces = faces.astype(np.int32)
    return SmplBody(
        template=template,
        # float32 halves the memory; the values are small, so the error is nanometers
        shapes=shapes[..., : _EXPRESSIONS.get((joint_count, shape_count), shape_count)].astype(np.float32),
        pose_shapes=pose_shapes.astype(np.float32),
        regressor=regressor,
        weights=weights,
        parents=parents,
        faces=faces,
        face_part=(1 + joint_weights[faces].sum(1).argmax(1)).astype(np.uint8),
        source=str(path),
    )


def _numbers(path: object, key: str, value: object) -> np.ndarray:
    """A C-contiguous float64 copy of a numeric array; a copy, so that the caller's array stays writable."""
    if isinstance(value, Unread):
        raise file_error(path, f"{key} is a {value.name} that holds no numbers: get the model as npz")
    # nested lists are refused: lists that repeat references to one list could expand without bound
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiub":
        raise file_error(path, f"{key} must be an array of numbers, got {type(value).__name__}: get the model as npz")
    array = value.astype(float, order="C")
    if not np.isfinite(array).all():
        raise file_error(path, f"{key} has values that are not finite; was the file copied completely?")
    return array


def _parents(path: object, tree: np.ndarray) -> np.ndarray:
    """Parents (J,) from the first row of kintree_table; the root's parent is stored as -1 cast to any unsigned type."""
    joint_count = tree.shape[1]
    parents = np.where(np.arange(joint_count) == 0, -1, np.clip(tree[0], -1, joint_count)).astype(int)
    is_ordered = joint_count >= 24 and (parents[1:] >= 0).all() and (parents < np.arange(joint_count)).all()
    has_hands = is_ordered and all((parents[_SHARED:] == wrist).any() for wrist in _HANDS)
    if not is_ordered or tuple(parents[:_SHARED]) != SMPL24.parents[:_SHARED] or not has_hands:
        raise file_error(path, f"kintree_table must begin with SMPL's joints and have hands, got {joint_count} joints")
    return parents


def on_smpl(weights: np.ndarray, parents: np.ndarray) -> np.ndarray:
    """Weights (V, J) -> SMPL's (V, 24): joints below a wrist are added to its hand, joints below the head to it."""
    smpl_joint = np.empty(len(parents), int)
    for j, parent in enumerate(parents):
        smpl_joint[j] = j if j < _SHARED else _HANDS.get(smpl_joint[parent], smpl_joint[parent])
    smpl_weights = np.zeros((len(weights), len(SMPL24)))
    np.add.at(smpl_weights.T, smpl_joint, weights.T)
    return smpl_weights
