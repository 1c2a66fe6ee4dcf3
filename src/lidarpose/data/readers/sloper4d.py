"""SLOPER4D (Dai et al. 2023), release 1.0: one person followed by another who carries a LiDAR on the head.

    ROOT/SEQUENCE/SEQUENCE_labels.pkl
        frame_num               (n,) the frames that are labelled; total_frames: those with pictures
        first_person            lidar_traj (n, 9): frame, x y z m, quaternion x y z w, time s
        second_person           opt_pose or pose (n, 72) rad, opt_trans or trans (n, 3) m, beta (10), gender;
                                point_clouds, a list of (k, 3) m in the world's frame, and point_frame, whose they are;
                                rows that are no numbers are no points

Joints are SMPL's, so the user's SMPL file is needed. Pickles are read without running them.
Source: climbingdaily/SLOPER4D src/data_loader.py, guidodumont/SMPLify-3D datasets/sloper4d.py.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidarpose.data.readers.base import Reader, Skipped, SmplJoints, as_cloud, numbers, smpl_sample
from lidarpose.errors import InputError
from lidarpose.geometry import rotation_about
from lidarpose.io.files import file_error
from lidarpose.io.pickles import load_pickle
from lidarpose.sample import LabeledSample
from lidarpose.skeleton import SMPL24

_SUFFIX = "_labels.pkl"
# a quaternion is no rotation where its length is further from 1
_UNIT = 0.01


class Sloper4D(Reader):
    """Reads SLOPER4D. A part is a sequence. smpl: the user's SMPL model or models, see `SmplJoints`."""

    name = "sloper4d"
    skeleton = SMPL24.name

    def __init__(self, *, smpl: str | Path | None = None):
        self._smpl = SmplJoints(smpl, self.name)
        super().__init__(smpl=self._smpl.digests)

    def parts(self, root: Path) -> list[str]:
        """The sequences. Raises InputError where there are no labels, or two of one name."""
        names = sorted(path.name.removesuffix(_SUFFIX) for path in _files(root))
        if not names:
            raise self.wrong_root(root)
        if twice := [name for name in names if names.count(name) > 1]:
            raise file_error(root, f"has {twice[0]}{_SUFFIX} twice: move one of them away")
        return names

    def read(self, root: Path, part: str) -> Iterator[LabeledSample | Skipped]:
        """The person of a sequence, frame by frame."""
        path = next(path for path in _files(root) if path.name == part + _SUFFIX)
        labels = _labels(path)
        kind = self._smpl.kind(labels.gender)
        joints = self._smpl(labels.betas, labels.pose, labels.trans, labels.gender)
        body = labels.gender if kind == "any" else f"{labels.gender} by the {kind} body"
        for index, frame in enumerate(labels.frames):
            where, cloud = f"{part}/{frame}", labels.clouds.get(frame)
            if reason := labels.problem(index, cloud):
                yield Skipped(reason, f"{where}: {cloud}" if reason == "cloud cannot be read" else where)
                continue
            R_sensor_world = rotation_about("z", -labels.heading[index])
            points, own, trans = (
                (x - labels.position[index]) @ R_sensor_world.T for x in (cloud, joints[index], labels.trans[index])
            )
            yield smpl_sample(
                points,
                own,
                sequence=part,
                frame=frame,
                frame_id=where,
                track="second_person",
                time=float(labels.time[index]),
                source=f"sloper4d/{labels.which}, {body}",
                centers={"trans": trans},
            )
        for frame in sorted(labels.clouds.keys() - set(labels.frames)):
            yield Skipped("cloud of a frame without labels", f"{part}/{frame}")


def _files(root: Path) -> list[Path]:
    """Label files in the root, its folders and theirs; the root may be a sequence itself."""
    return sorted(path for depth in ("", "*/", "*/*/") for path in root.glob(f"{depth}*{_SUFFIX}"))


@dataclass(frozen=True, kw_only=True)
class _Labels:
    """A sequence. frames (n,); total: those to use; pose (n, 72) and trans (n, 3) with good (n,), whether they are
    numbers; which of the poses; betas (1, 10); clouds by frame, (k, 3) or what is wrong; position (n, 3) m and heading
    (n,) rad of the LiDAR; time (n,) s."""

    frames: list[int]
    total: int
    pose: np.ndarray
    trans: np.ndarray
    good: np.ndarray
    which: str
    betas: np.ndarray
    gender: str
    clouds: dict[int, np.ndarray | str]
    position: np.ndarray
    heading: np.ndarray
    time: np.ndarray

    def problem(self, index: int, cloud: np.ndarray | str | None) -> str:
        """Why the frame of this index is left out, "" if it is not."""
        if index >= self.total:
            return "frame beyond total_frames"
        if cloud is None:
            return "labels without a cloud"
        if isinstance(cloud, str):
            return "cloud cannot be read"
        if not len(cloud):
            return "empty cloud"
        if index >= len(self.pose) or not self.good[index]:
            return "cloud without a pose"
        if index >= len(self.position) or not np.isfinite([*self.position[index], self.heading[index]]).all():
            return "cloud without the LiDAR's place"
        return ""


def _labels(path: Path) -> _Labels:
    content = load_pickle(path)
    if not isinstance(content, dict) or not isinstance(content.get("second_person"), dict):
        old = isinstance(content, dict) and "SMPL_info" in content
        got = "those of a release before 1.0 (SMPL_info)" if old else "others"
        get = "get them at www.lidarhumanmotion.net/data-sloper4d (a form)"
        raise file_error(path, f"expected labels of SLOPER4D 1.0, with second_person, got {got}: {get}")
    person, walker = content["second_person"], content.get("first_person")
    pose, trans, which = _poses(path, person)
    frames = [int(n) for n in numbers(path, content.get("frame_num"), (-1,), "frame_num")]
    walker = walker if isinstance(walker, dict) else {}
    way = numbers(path, walker.get("lidar_traj"), (-1, 9), "first_person's lidar_traj", finite=False)
    good = np.isfinite(pose).all(1) & np.isfinite(trans).all(1)
    total = content.get("total_frames")
    total = len(frames) if total is None else int(numbers(path, total, (), "total_frames"))
    return _Labels(
        frames=frames,
        total=total,
        pose=np.where(good[:, None], pose, 0.0),
        trans=np.where(good[:, None], trans, 0.0),
        good=good,
        which=which,
        betas=numbers(path, numbers(path, person.get("beta"), (-1,), "beta")[:10], (10,), "beta")[None],
        gender=str(person.get("gender", "neutral")).lower(),
        clouds=_clouds(path, person),
        position=way[:, 1:4],
        heading=_heading(way[:, 4:8]),
        time=way[:, 8] - way[0, 8] if len(way) else np.zeros(0),
    )


def _poses(path: Path, person: dict) -> tuple[np.ndarray, np.ndarray, str]:
    """pose (n, 72), trans (n, 3) and the name of the former; the refined ones where they are."""
    for prefix in ("opt_", ""):
        names = [f"{prefix}pose", f"{prefix}trans"]
        if all(person.get(name) is not None for name in names):
            pose, trans = (
                numbers(path, person[name], (-1, size), name, finite=False)
                for name, size in zip(names, (72, 3), strict=True)
            )
            if len(pose) != len(trans):
                raise file_error(path, f"{names[0]} has {len(pose)} frames and {names[1]} {len(trans)}")
            return pose, trans, names[0]
    raise file_error(path, f"second_person has no pose and trans, got {', '.join(map(str, person))[:80]}")


def _clouds(path: Path, person: dict) -> dict[int, np.ndarray | str]:
    clouds, frames = person.get("point_clouds"), person.get("point_frame")
    if clouds is None or frames is None:
        raise file_error(path, "second_person has no point_clouds and point_frame: labels of another release?")
    if not isinstance(clouds, list | tuple | np.ndarray) or isinstance(clouds, np.ndarray) and not clouds.ndim:
        raise file_error(path, f"point_clouds should be a list of clouds, got {type(clouds).__name__}")
    frames = numbers(path, frames, (-1,), "point_frame").astype(int).tolist()
    if len(clouds) != len(frames):
        raise file_error(path, f"has {len(clouds)} point_clouds of {len(frames)} frames (point_frame)")
    found: dict[int, np.ndarray | str] = {}
    for frame, cloud in zip(frames, clouds, strict=True):
        try:
            # rows that are no numbers are left out, as the authors' loaders do
            found[frame] = as_cloud(path, cloud)
        except InputError as error:
            found[frame] = str(error)
    return found


def _heading(quaternion: np.ndarray) -> np.ndarray:
    """quaternion (n, 4) x y z w -> (n,) rad: where the turned x axis points, seen from above; NaN for no rotation."""
    x, y, z, w = quaternion.T
    unit = np.abs(np.linalg.norm(quaternion, axis=1) - 1) < _UNIT
    return np.where(unit, np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z)), np.nan)
