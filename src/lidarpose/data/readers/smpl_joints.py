"""SMPL's 24 joints from its parameters, by the user's own model files: what datasets without joints need; and the
people that they make."""

import re
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose.body.rig import forward_kinematics
from lidarpose.body.smpl import load_body
from lidarpose.data.readers.base import Skipped, entries
from lidarpose.errors import InputError
from lidarpose.geometry import axis_angle_to_matrix
from lidarpose.io.files import content_digest, file_error
from lidarpose.sample import FARTHEST, SEEN, LabeledSample, Pose, center_of, within_reach
from lidarpose.skeleton import SMPL24

# what the published files are called: SMPL_MALE.pkl, basicmodel_m_lbs_10_207_0_v1.1.0.pkl, basicModel_f_lbs_...
_NAMES = {
    "neutral": r"smpl_neutral|basicmodel_neutral_lbs.*",
    "male": r"smpl_male|basicmodel_m_lbs.*",
    "female": r"smpl_female|basicmodel_f_lbs.*",
}
_GET = (
    "register at smpl.is.tue.mpg.de, download SMPL for Python v1.1.0, which has the neutral body, "
    "and give --smpl with its .pkl or .npz, or with a folder of SMPL_NEUTRAL, SMPL_MALE and SMPL_FEMALE"
)


class SmplJoints:
    """The joints of SMPL bodies in any pose. The neutral model, or the only one, is read at once, others when needed.

    path: the user's SMPL, one file for everybody, or a folder with a file for each gender, by their published names.
    Raises InputError where it is None, missing, a folder without a neutral body, or where that is no SMPL; the
    dataset's name is told.
    """

    def __init__(self, path: str | Path | None, dataset: str):
        if path is None:
            raise InputError(f"{dataset} has SMPL poses and no joints, so it needs SMPL's own file: {_GET}")
        path = Path(path)
        if path.is_dir():
            self.files = _in_folder(path)
            if "neutral" not in self.files:
                raise file_error(path, f"expected SMPL_NEUTRAL.pkl or .npz, got {entries(path)}: {_GET}")
        elif not path.is_file():
            raise file_error(path, f"no such file; expected SMPL's own: {_GET}")
        else:
            self.files = {"any": path}
        # what becomes joints at rest: the mean's (24, 3) and the shapes' (24, 3, betas)
        self._models: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        self._model(self.kind("neutral"))

    def kind(self, gender: str) -> str:
        """Which model a gender gets: "any" where one file is for everybody, else its own, else the neutral one."""
        return "any" if "any" in self.files else gender if gender in self.files else "neutral"

    def _model(self, kind: str) -> tuple[np.ndarray, np.ndarray]:
        if kind not in self._models:
            body = load_body(self.files[kind])
            if (count := len(body.parents)) != len(SMPL24):
                problem = f"expected SMPL, with 24 joints, got {count} (SMPL+H, SMPL-X?): {_GET}"
                raise file_error(self.files[kind], problem)
            shapes = np.einsum("jv,vcs->jcs", body.regressor, body.shapes, optimize=True)
            self._models[kind] = body.regressor @ body.template, shapes
        return self._models[kind]

    def __call__(self, betas: np.ndarray, pose: np.ndarray, trans: np.ndarray, gender: str = "neutral") -> np.ndarray:
        """Joints (n, 24, 3) float64 m. betas (n or 1, <= 300); pose (n, 72) axis-angles rad, the root first; trans
        (n, 3) m, added to everything, so that the pelvis is at its rest position plus trans."""
        mean, shapes = self._model(self.kind(gender))
        if (count := betas.shape[-1]) > shapes.shape[-1]:
            path = self.files[self.kind(gender)]
            raise file_error(path, f"has {shapes.shape[-1]} shapes, the labels {count}: give the full model")
        rest = mean + np.moveaxis(shapes[..., :count] @ betas.T, -1, 0)
        rotations = axis_angle_to_matrix(pose.reshape(len(pose), -1, 3))
        return forward_kinematics(SMPL24.parents, rest, rotations, rest[:, 0] + trans)[1]

    @cached_property
    def digests(self) -> dict[str, str]:
        """By kind, what tells one file from another."""
        return {kind: content_digest(path, expected="SMPL")[:12] for kind, path in self.files.items()}


def smpl_sample(points: np.ndarray, joints: np.ndarray, **labels: Any) -> LabeledSample | Skipped:
    """The sample of points (n, 3) m and SMPL's joints (24, 3) m, which all count as seen; labels: the other fields of
    `LabeledSample`. Skipped where the parameters put joints out of reach."""
    if not within_reach(joints).all():
        where = f"{labels['frame_id']}/{labels['track']}: beyond {FARTHEST:g} m"
        return Skipped("joints out of reach", where)
    points = points.astype(np.float32)
    return LabeledSample(
        points=points,
        center=center_of(points),
        pose=Pose(joints=joints.astype(np.float32), skeleton=SMPL24, frame="sensor"),
        joint_labels=np.full(len(SMPL24), SEEN, np.uint8),
        **labels,
    )


def _in_folder(folder: Path) -> dict[str, Path]:
    found: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        for gender, names in _NAMES.items():
            if path.suffix.lower() in (".pkl", ".npz") and re.fullmatch(names, path.stem.lower()):
                found.setdefault(gender, path)
    return found
