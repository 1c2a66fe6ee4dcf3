"""What every reader of a dataset yields and offers, and what readers of raw files share.

A dataset's raw files fall into parts, each read on its own (a sequence, a segment, a file): that is what processes
share out, and what is written as one shard. What is known of each dataset is in data/datasets.json.
"""

import json
import os
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
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

# of people without a labeled box, it is that of their joints, this much larger on each side, m
_BOX_MARGIN = 0.2
# and their points are those in a box this much larger still, m: what a detector's box lets in
POINT_MARGIN = 0.3
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
# why the people of a part after a fault in it are left out
BAD_REST = "the rest of a part cannot be read"


@dataclass(frozen=True)
class Skipped:
    """What was left out: reason, the same words for the same reason, and where."""

    reason: str
    where: str


class Reader(ABC):
    """Reads a dataset's raw files. about: what is recorded with a prepared dataset: the frame of its points, its
    licence, its quirks, and the `settings` that decide its content."""

    name: ClassVar[str]
    skeleton: ClassVar[str]

    def __init__(self, **settings: Any):
        info = _datasets()[self.name]
        self.about = {key: value for key, value in info.items() if key not in ("title", "expected")}
        self.about["settings"] = settings

    @abstractmethod
    def parts(self, root: Path) -> list[str]:
        """Names of what can be read on its own, sorted. Raises InputError, one line, where the root is incomplete."""

    def check(self, root: Path, part: str) -> None:  # noqa: B027
        """Raises InputError, one line, where a part cannot be read, before anything is written."""

    @abstractmethod
    def read(self, root: Path, part: str) -> Iterator[LabeledSample | Skipped]:
        """Everybody in one part, in an order that never changes."""

    def wrong_root(self, root: Path, got: str = "") -> InputError:
        """The error for a folder that is not the dataset's root. got: by default what is in the folder."""
        info, got = _datasets()[self.name], got or f"got {entries(root)}"
        problem = f"is not the root of {info['title']}: expected {info['expected']}, {got}"
        return file_error(root, f"{problem}; get it at {info['get']}")


@cache
def _datasets() -> dict[str, dict[str, Any]]:
    return json.loads((files("lidarpose.data") / "datasets.json").read_text("utf-8"))


def entries(folder: Path) -> str:
    """The first names in a folder, for messages."""
    return ", ".join(sorted(path.name for path in folder.iterdir())[:6]) or "nothing"


def numbered(folder: Path, suffix: str) -> dict[int, list[Path]]:
    """The files of a folder that are numbered, whatever the number of digits: number -> its files, in order."""
    files: dict[int, list[Path]] = {}
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if path.suffix.lower() == suffix and FRAME_NUMBER.fullmatch(path.stem):
            files.setdefault(int(path.stem), []).append(path)
    return dict(sorted(files.items()))


def paired(
    labels: dict[int, list[Path]], clouds: dict[int, list[Path]], where: str
) -> Iterator[tuple[int, Path, Path | None] | Skipped]:
    """The frames of numbered label files and clouds: number, labels, cloud or None. Skipped are clouds without labels
    and frames of which a file is there twice. where: a format of the frame's number."""
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
    """A JSON file that holds an object. Raises InputError where it does not."""
    content = read_json(path, expected=expected)
    if not isinstance(content, dict):
        raise file_error(path, f"expected {expected}, got {type(content).__name__}")
    return content


def numbers(path: object, value: object, shape: tuple[int, ...], what: str, *, finite: bool = True) -> np.ndarray:
    """The value as float64 of a shape, -1 for any length; a flat list will do. Raises InputError otherwise.

    finite: refuse NaN and infinity. path and what: for the message.
    """
    if value is None:
        raise file_error(path, f"{what} is missing; expected numbers {shape}")
    try:
        array = np.asarray(value, float)
        array = array if array.ndim == len(shape) else array.reshape(shape)
    except (TypeError, ValueError, OverflowError):
        raise file_error(path, f"{what} must be numbers {shape}, got other things or rows of unequal length") from None
    if any(n not in (-1, m) for n, m in zip(shape, array.shape, strict=True)):
        raise file_error(path, f"{what} must be {shape}, got {array.shape}")
    if finite and not np.isfinite(array).all():
        raise file_error(path, f"{what} has values that are no numbers")
    return array


def read_cloud(path: Path) -> np.ndarray:
    """x y z (n, 3) float64 of a file, without points out of reach; n = 0 where it says itself that it holds none.
    Raises InputError."""
    try:
        points = read_points(path).points
        return points[within_reach(points)]
    except InputError:
        # written for a person who was not seen; a file that is cut off says more points than it has
        if _says_empty(path):
            return np.zeros((0, 3))
        raise


def as_cloud(path: object, value: object) -> np.ndarray:
    """x y z (n, 3) float64 of an array or a flat list, without points out of reach or that are no numbers. Raises
    InputError, since rows of another length would be read shifted. path: for the message."""
    if isinstance(value, np.ndarray) and value.ndim > 2:
        raise file_error(path, f"a cloud must be (n, 3), got {value.shape}")
    points = numbers(path, value, (-1, 3), "a cloud", finite=False)
    return points[within_reach(points)]


def find_below(root: Path, path: str) -> Path | None:
    """The cloud that a path of another machine means: the longest end of it that is in the root."""
    names = [name for name in re.split(r"[/\\]", path) if name not in ("", ".", "..")]
    for k in range(len(names)):
        # False, too, for a name that no disk can hold
        if os.path.isfile(root / Path(*names[k:])):
            return root / Path(*names[k:])
    return None


def _says_empty(path: Path) -> bool:
    with suppress(OSError):
        # a pipe would be waited for
        if os.path.isfile(path):
            with open(path, "rb") as file:
                return re.search(rb"^(element vertex|POINTS) +0\s*$", file.read(4096), re.MULTILINE) is not None
    return False


# ---- datasets of SMPL parameters: their joints, by the user's own model files


class SmplJoints:
    """The joints of SMPL bodies in any pose. The neutral model, or the only one, is read at once, others when needed.

    path: the user's SMPL, one file for everybody, or a folder with a file for each gender, by their published names.
    Raises InputError where it is None, missing, a folder without a neutral body, or where that is no SMPL; the
    dataset's name is in the message.
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
        rest_joints = mean + np.moveaxis(shapes[..., :count] @ betas.T, -1, 0)
        rotations = axis_angle_to_matrix(pose.reshape(len(pose), -1, 3))
        return forward_kinematics(SMPL24.parents, rest_joints, rotations, rest_joints[:, 0] + trans)[1]

    @cached_property
    def digests(self) -> dict[str, str]:
        """By kind, what tells one file from another."""
        return {kind: content_digest(path, expected="SMPL")[:12] for kind, path in self.files.items()}


def turned_pose(pose: np.ndarray, R_to_world: np.ndarray) -> np.ndarray:
    """SMPL's pose (72,) rad in a world turned by R_to_world (3, 3), as `Sample.rotations` has it."""
    rotations = pose.reshape(-1, 3).astype(np.float32)
    rotations[0] = rotation_vector(R_to_world @ axis_angle_to_matrix(pose[:3]))
    return rotations


class SceneClouds:
    """The whole scans of a sequence, where they are there, and the map of what stands still in them.

    paths: frame -> its file; people: frame -> points (n, 3) m of the person, in the coordinates of the scans.
    """

    def __init__(self, paths: dict[int, Path], people: Callable[[int], np.ndarray]):
        self._paths, self._people = paths, people

    def _others(self, frame: int) -> np.ndarray | None:
        """The scan without the person; None where it cannot be read."""
        try:
            return without_person(read_cloud(self._paths[frame]), self._people(frame))
        except (KeyError, InputError):
            return None

    @cached_property
    def _static(self) -> np.ndarray:
        frames = sorted(self._paths)
        indices = np.unique(np.linspace(0, len(frames) - 1, SCANS).astype(int)).tolist()
        return static_points(scan for k in indices if (scan := self._others(frames[k])) is not None)

    def around(self, frame: int, R_sensor_scan: np.ndarray, origin: np.ndarray | None = None) -> dict[str, Any]:
        """The fields background and neighbors of a frame's sample, in a frame turned by R_sensor_scan (3, 3) about the
        sensor at origin (3,), by default 0; none where there is no scan."""
        scan = self._others(frame)
        if scan is None:
            return {}
        origin = np.zeros(3) if origin is None else origin
        person, scan, static_map = ((x - origin) @ R_sensor_scan.T for x in (self._people(frame), scan, self._static))
        return {"background": window_points(static_map, person), "neighbors": window_points(scan, person)}


def box_of_joints(joints: np.ndarray, id: str) -> Box:
    """The box of a person's labeled joints (n, 3) m, n >= 1. Raises InputError where they are out of reach."""
    low, high = joints.min(0), joints.max(0)
    return Box(center=(low + high) / 2, size=high - low + 2 * _BOX_MARGIN, id=id)


def labeled_sample(
    points: np.ndarray, joints: np.ndarray, tree: Skeleton = SMPL24, **labels: Any
) -> LabeledSample | Skipped:
    """The sample of points (n, 3) m and joints (J, 3) m of a skeleton, NaN where not labeled; labels: the other fields
    of `LabeledSample`, by default all joints that are there count as seen and the frame is SEQUENCE/FRAME. Skipped
    where a joint is out of reach."""
    labels.setdefault("frame_id", f"{labels['sequence']}/{labels['frame']}")
    is_labeled = ~np.isnan(joints).any(-1)
    if not within_reach(joints[is_labeled]).all():
        return Skipped("joints out of reach", f"{labels['frame_id']}/{labels['track']}: beyond {FARTHEST:g} m")
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
