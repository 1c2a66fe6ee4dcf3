"""A user's SMPL body stored as the shipped one is, for what takes a `Rig`: the posing kernels.

Clothes, garments and the generator know the shipped body alone.

n people, V vertices, S shape coefficients. Lengths in metres, house frame.
"""

import numpy as np

from lidarpose.body.rig import Rig
from lidarpose.body.smpl import SmplBody, on_smpl
from lidarpose.errors import InputError
from lidarpose.skeleton import SMPL24

# coefficients are units of the training people's deviations; people beyond this many are left out
_MOST_DEVIATIONS = 2.5
# kg/m3, of a person with air in the lungs
_DENSITY = 980.0
_WEIGHTS = 4


def rig_of(body: SmplBody, rng: np.random.Generator, *, people: int = 512, coefficients: int = 10) -> Rig:
    """`body` as a `Rig` with its first shape coefficients and a table of `people` shapes drawn from `rng`.

    Left out: shapes that depend on the pose (`SmplBody.pose_house` has them), all but the four strongest weights of a
    vertex, fingers, jaw and eyes, which stay with hand and head. The file knows neither sex nor age: the table says
    female and 40 years for everybody; stature is that of the rest pose, BMI is from the mesh's volume.
    """
    if people < 1 or coefficients < 1:
        raise InputError(f"a rig needs people and coefficients of 1 or more, got {people} and {coefficients}")
    count = min(coefficients, body.shape_count)
    # rest bodies of no shape and of each coefficient alone: what is between them is a morph
    vertices, joints = _at_rest(body, np.eye(count + 1, count, -1))
    shapes = np.clip(rng.normal(size=(people, count)), -_MOST_DEVIATIONS, _MOST_DEVIATIONS)
    weight_index, weight = _strongest(body)
    morphs = vertices[1:] - vertices[0]
    sizes = [_size(body.faces, vertices[0] + np.tensordot(row, morphs, 1)) for row in shapes]
    height, volume = np.array(sizes).T
    return Rig(
        faces=body.faces.copy(),
        face_part=body.face_part.copy(),
        weight_index=weight_index,
        weight=weight,
        parents=np.array(SMPL24.parents, np.int32),
        template=vertices[0].copy(),
        morphs=morphs,
        joint_template=joints[0].copy(),
        joint_morphs=joints[1:] - joints[0],
        coefficients=shapes.astype(np.float32),
        sex=np.full(people, "female"),
        age=np.full(people, 40, np.float32),
        height=height.astype(np.float32),
        bmi=(_DENSITY * volume / height**2).astype(np.float32),
    )


def _at_rest(body: SmplBody, betas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """T-posed vertices (n, V, 3) and joints (n, 26, 3), the pelvis at the origin."""
    still = np.broadcast_to(np.eye(3), (len(betas), len(SMPL24), 3, 3))
    return body.pose_house(betas, still, np.zeros((len(betas), 3)))


def _strongest(body: SmplBody) -> tuple[np.ndarray, np.ndarray]:
    """Joints (V, 4) int32 of SMPL24 and weights (V, 4) float32, strongest first, unused ones 0."""
    grouped = on_smpl(body.weights, body.parents)
    index = np.argsort(-grouped, 1, kind="stable")[:, :_WEIGHTS]
    weight = np.maximum(np.take_along_axis(grouped, index, 1), 0)
    weight /= weight.sum(1, keepdims=True)
    return np.ascontiguousarray(np.where(weight > 0, index, 0), np.int32), weight.astype(np.float32)


def _size(faces: np.ndarray, vertices: np.ndarray) -> tuple[float, float]:
    """Stature m and volume m3."""
    a, b, c = np.moveaxis(vertices[faces].astype(float), 1, 0)
    return float(np.ptp(vertices[:, 2])), float((np.cross(a, b) * c).sum() / 6)
