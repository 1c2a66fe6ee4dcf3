"""The interface of dataset readers, and functions that readers of raw files share.

A dataset's raw files consist of parts that are read independently (a sequence, a segment, a file). Parts are
distributed over processes, and each is written as one shard. Information about each dataset is in data/datasets.json.
"""

import json
import os
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.resources import files
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from lidarpose.body.rig import forward_kinematics
from lidarpose.body.smpl import load_body
from lidarpose.data.clips import SCANS, static_points, window_points, without_person
from lidarpose.errors import InputError
from lidarpose.geometry import axis_angle_to_matrix, rotation_vector
from lidarpose.io.files import FRAME_NUMBER, content_digest, file_error, read_json
from lidarpose.io.point_cloud import read_points
from lidarpose.sample import FARTHEST, SEEN, UNLABELED, Box, LabeledSample, Pose, center_of, within_reach
from lidarpose.skeleton import SMPL24, Skeleton

# margin on each side of the box about the joints of people without a labeled box, m
_BOX_MARGIN = 0.2
# additional margin of the box that crops their points, m: as loose as a detector's box
POINT_MARGIN = 0.3
# names of the published files: SMPL_MALE.pkl, basicmodel_m_lbs_10_207_0_v1.1.0.pkl, basicModel_f_lbs_...
_NAMES = {
    "neutral": r"smpl_neutral|basicmodel_neutral_lbs.*",
    "male": r"smpl_male|basicmodel_m_lbs.*",
    "female": r"smpl_female|basicmodel_f_lbs.*",
}
_GET = (
    "register at smpl.is.tue.mpg.de, download SMPL for Python v1.1.0, which has the neutral body, "
    "and give --smpl with its .pkl or .npz, or with a folder of SMPL_NEUTRAL, SMPL_MALE and SMPL_FEMALE"
)
# reason for skipping the people of a part after an error in it
BAD_REST = "the rest of a part cannot be read"


@dataclass(frozen=True)
class Skipped:
    """An item that was left out. reason: the same text for the same reason; where: its location."""

    reason: str
    where: str


class Reader(ABC):
    """Reads a dataset's raw files. about: information stored with a prepared dataset: the frame of its points, its
    license, its quirks, and the `settings` that determine its content."""

    name: ClassVar[str]
    skeleton: ClassVar[str]

    def __init__(self, **settings: Any):
        info = _datasets()[self.name]
        self.about = {key: value for key, value in info.items() if key not in ("title", "expected")}
        self.about["settings"] = settings

    @abstractmethod
    def parts(self, root: Path) -> list[str]:
        """Names of the parts, sorted. Raises InputError, one line, if the root is incomplete."""

    def check(self, root: Path, part: str) -> None:  # noqa: B027
        """Raises InputError, one line, if a part cannot be read; called before anything is written."""

    @abstractmethod
    def read(self, root: Path, part: str) -> Iterator[LabeledSample | Skipped]:
        """All people of a part, in a fixed order."""

    def wrong_root(self, root: Path, got: str = "") -> InputError:
        """The error for a folder that is not the dataset's root. got: what was found, by default the first entries."""
        info, got = _datasets()[self.name], got or f"got {entries(root)}"
        problem = f"is not the root of {info['title']}: expected {info['expected']}, {got}"
        return file_error(root, f"{problem}; get it at {info['get']}")


@cache
def _datasets() -> dict[str, dict[str, Any]]:
    return json.loads((files("lidarpose.data") / "datasets.json").read_text("utf-8"))


def entries(folder: Path) -> str:
    """The first file names in a folder, for messages."""
    return ", ".join(sorted(path.name for path in folder.iterdir())[:6]) or "nothing"


def numbered(folder: Path, suffix: str) -> dict[int, list[Path]]:
    """The numbered files of a folder, with any number of digits: number -> its files, in order."""
    files: dict[int, list[Path]] = {}
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if path.suffix.lower() == suffix and FRAME_NUMBER.fullmatch(path.stem):
            files.setdefault(int(path.stem), []).append(path)
    return dict(sorted(files.items()))


def paired(
    labels: dict[int, list[Path]], clouds: dict[int, list[Path]], where: str
) -> Iterator[tuple[int, Path, Path | None] | Skipped]:
    """The frames of numbered label files and clouds: number, labels, cloud or None. Clouds without labels and frames
    with duplicate files are skipped. where: a format string for the frame number."""
    for frame in sorted(labels.keys() | clouds.keys()):
        paths = labels.get(frame, []), clouds.get(frame, [])
        if not paths[0]:
            yield Skipped("cloud without labels", where.format(frame))
        elif max(map(len, paths)) > 1:
            names = ", ".join(path.name for path in (*paths[0], *paths[1]))
            yield Skipped("several files of one frame", f"{where.format(frame)}: {names}")
        else:
            yield frame, paths[0][0], paths[1][0] if paths[1] else None


def read_object(path: Path, expected: str) -> dict:
    """The object in a JSON file. Raises InputError if it holds something else."""
    content = read_json(path, expected=expected)
    if not isinstance(content, dict):
        raise file_error(path, f"expected {expected}, got {type(content).__name__}")
    return content


def numbers(path: object, value: object, shape: tuple[int, ...], what: str, *, finite: bool = True) -> np.ndarray:
    """The value as a float64 array of a shape, -1 for any length; a flat list is reshaped. Raises InputError otherwise.

    finite: reject NaN and infinity. path, what: for the message.
    """
    if value is None:
        raise file_error(path, f"{what} is missing; expected numbers {shape}")
    try:
        array = np.asarray(value, float)
        array = array if array.ndim == len(shape) else array.reshape(shape)
    except (TypeError, ValueError, OverflowError):
        raise file_error(path, f"{what} must be numbers {shape}, got other data or rows of unequal length") from None
    if any(n not in (-1, m) for n, m in zip(shape, array.shape, strict=True)):
        raise file_error(path, f"{what} must be {shape}, got {array.shape}")
    if finite and not np.isfinite(array).all():
        raise file_error(path, f"{what} has values that are not finite")
    return array


def read_cloud(path: Path) -> np.ndarray:
    """x y z (n, 3) float64 of a file, without out-of-range points; n = 0 if its header states that it has no points.
    Raises InputError if it cannot be read."""
    try:
        points = read_points(path).points
        return points[within_reach(points)]
    except InputError:
        # such files are written for people without points; a truncated file states more points than it has
        if _says_empty(path):
            return np.zeros((0, 3))
        raise


def as_cloud(path: object, value: object) -> np.ndarray:
    """x y z (n, 3) float64 of an array or a flat list, without NaN and out-of-range points. Raises InputError for rows
    of another length, which would be read shifted. path: for the message."""
    if isinstance(value, np.ndarray) and value.ndim > 2:
        raise file_error(path, f"a cloud must be (n, 3), got {value.shape}")
    points = numbers(path, value, (-1, 3), "a cloud", finite=False)
    return points[within_reach(points)]


def find_below(root: Path, path: str) -> Path | None:
    """The file in the root that matches the longest tail of a path from another machine, None if there is none."""
    names = [name for name in re.split(r"[/\\]", path) if name not in ("", ".", "..")]
    for k in range(len(names)):
        # isfile is also False for a name that is invalid on disk
        if os.path.isfile(root / Path(*names[k:])):
            return root / Path(*names[k:])
    return None


def _says_empty(path: Path) -> bool:
    with suppress(OSError):
        # opening a pipe would block
        if os.path.isfile(path):
            with open(path, "rb") as file:
                return re.search(rb"^(element vertex|POINTS) +0\s*$", file.read(4096), re.MULTILINE) is not None
    return False


# ---- datasets of SMPL parameters: joints from the user's own model files


class SmplJoints:
    """The joints of SMPL bodies in any pose. The neutral or only model is read immediately, others when needed.

    path: the user's SMPL, one file for all people, or a folder with a file for each gender, by their published names.
    Raises InputError if it is None, missing, a folder without a neutral body, or not SMPL; the dataset's name is in the
    message.
    """

    def __init__(self, path: str | Path | None, dataset: str):
        if path is None:
            raise InputError(f"{dataset} has SMPL poses and no joints, so it needs an SMPL model: {_GET}")
        path = Path(path)
        if path.is_dir():
            self.files = _in_folder(path)
            if "neutral" not in self.files:
                raise file_error(path, f"expected SMPL_NEUTRAL.pkl or .npz, got {entries(path)}: {_GET}")
        elif not path.is_file():
            raise file_error(path, f"no such file; expected an SMPL model: {_GET}")
        else:
            self.files = {"any": path}
        # by kind, joints at rest: of the mean body (24, 3), and their shape directions (24, 3, betas)
        self._models: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        self._model(self.kind("neutral"))

    def kind(self, gender: str) -> str:
        """The model for a gender: "any" if one file is for all people, else the gender's own, else "neutral"."""
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
        (n, 3) m, added to all joints, so that the pelvis is at its rest position plus trans."""
        mean, shapes = self._model(self.kind(gender))
        if (count := betas.shape[-1]) > shapes.shape[-1]:
            path = self.files[self.kind(gender)]
            raise file_error(
                path, f"has {shapes.shape[-1]} shape coefficients, the labels {count}: give the full model"
            )
        rest_joints = mean + np.moveaxis(shapes[..., :count] @ betas.T, -1, 0)
        rotations = axis_angle_to_matrix(pose.reshape(len(pose), -1, 3))
        return forward_kinematics(SMPL24.parents, rest_joints, rotations, rest_joints[:, 0] + trans)[1]

    @cached_property
    def digests(self) -> dict[str, str]:
        """By kind, a digest of the model file."""
        return {kind: content_digest(path, expected="SMPL")[:12] for kind, path in self.files.items()}


def turned_pose(pose: np.ndarray, R_to_world: np.ndarray) -> np.ndarray:
    """SMPL's pose (72,) rad in a world turned by R_to_world (3, 3), in the form of `Sample.rotations`."""
    rotations = pose.reshape(-1, 3).astype(np.float32)
    rotations[0] = rotation_vector(R_to_world @ axis_angle_to_matrix(pose[:3]))
    return rotations


class SceneClouds:
    """The whole scans of a sequence, if available, and the map of their static points.

    paths: frame -> its file; people: frame -> points (n, 3) m of the person, in the frame of the scans; people_frames:
    those for which `people` has points.
    """

    def __init__(self, paths: dict[int, Path], people: Callable[[int], np.ndarray], people_frames: Iterable[int]):
        self._paths, self._people, self._people_frames = paths, people, people_frames

    def _others(self, frame: int, person: np.ndarray | None = None) -> np.ndarray | None:
        """The scan without the person; None if it cannot be read. person: its points, None to obtain them."""
        try:
            return without_person(read_cloud(self._paths[frame]), self._people(frame) if person is None else person)
        except (KeyError, InputError):
            return None

    @cached_property
    def _static(self) -> np.ndarray:
        frames = sorted(set(self._paths) & set(self._people_frames))
        if not frames:
            return static_points(())
        indices = np.unique(np.linspace(0, len(frames) - 1, SCANS).astype(int)).tolist()
        return static_points(scan for k in indices if (scan := self._others(frames[k])) is not None)

    def around(
        self, frame: int, person: np.ndarray, R_sensor_scan: np.ndarray, origin: np.ndarray | None = None
    ) -> dict[str, Any]:
        """The fields background and neighbors of the sample of a frame's person, points (n, 3) m, turned by
        R_sensor_scan (3, 3) about the sensor at origin (3,) m, by default 0. Without a scan of the frame there are no
        neighbors, without any scan no background."""
        clouds = {"background": self._static, "neighbors": self._others(frame, person)}
        if clouds["neighbors"] is None and not len(self._static):
            return {}
        origin = np.zeros(3) if origin is None else origin
        person = (person - origin) @ R_sensor_scan.T
        return {
            name: window_points((cloud - origin) @ R_sensor_scan.T, person)
            for name, cloud in clouds.items()
            if cloud is not None
        }


def box_of_joints(joints: np.ndarray, id: str) -> Box:
    """The box of a person's labeled joints (n, 3) m, n >= 1. Raises InputError if they are out of range."""
    low, high = joints.min(0), joints.max(0)
    return Box(center=(low + high) / 2, size=high - low + 2 * _BOX_MARGIN, id=id)


def labeled_sample(
    points: np.ndarray, joints: np.ndarray, tree: Skeleton = SMPL24, **labels: Any
) -> LabeledSample | Skipped:
    """The sample of points (n, 3) m and joints (J, 3) m of a skeleton, NaN if not labeled; `Skipped` if a joint is out
    of range.

    labels: the other fields of `LabeledSample`; by default labeled joints are `SEEN` and frame_id is SEQUENCE/FRAME.
    """
    labels.setdefault("frame_id", f"{labels['sequence']}/{labels['frame']}")
    is_labeled = ~np.isnan(joints).any(-1)
    if not within_reach(joints[is_labeled]).all():
        return Skipped("joints out of range", f"{labels['frame_id']}/{labels['track']}: beyond {FARTHEST:g} m")
    points = points.astype(np.float32)
    labels.setdefault("joint_labels", np.where(is_labeled, SEEN, UNLABELED).astype(np.uint8))
    pose = Pose(joints=joints.astype(np.float32), skeleton=tree, frame="sensor")
    return LabeledSample(points=points, center=center_of(points), pose=pose, **labels)


def _in_folder(folder: Path) -> dict[str, Path]:
    models: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        for gender, names in _NAMES.items():
            if path.suffix.lower() in (".pkl", ".npz") and re.fullmatch(names, path.stem.lower()):
                models.setdefault(gender, path)
    return models
