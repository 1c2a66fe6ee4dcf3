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

from lidarpose.data.readers.base import Skipped, as_cloud, numbers, wrong_root
from lidarpose.data.readers.smpl_joints import SmplJoints, smpl_item
from lidarpose.errors import InputError
from lidarpose.geometry import rotation_about
from lidarpose.io.files import file_error
from lidarpose.io.pickles import load_pickle
from lidarpose.sample import LabeledSample
from lidarpose.skeleton import SMPL24

_SUFFIX = "_labels.pkl"
_EXPECTED = "SEQUENCE/SEQUENCE_labels.pkl"
_GET = "www.lidarhumanmotion.net/data-sloper4d (a form)"
# a quaternion is no rotation where its length is further from 1
_UNIT = 0.01


class Sloper4D:
    """Reads SLOPER4D. A part is a sequence. smpl: the user's SMPL model or models, see `SmplJoints`."""

    name = "sloper4d"
    skeleton = SMPL24.name

    def __init__(self, *, smpl: str | Path | None = None):
        self._smpl = SmplJoints(smpl, self.name)
        self.about = {
            "frame": "level frame at the sensor: its heading is x, z is the world's up; m",
            "settings": {"smpl": self._smpl.digests},
            "licence": "CC BY-NC-SA 4.0; the dataset by a form on its page",
            "get": _GET,
            "notes": [
                "Clouds and poses are in the world's frame on disk. Here they are moved to the sensor by lidar_traj of "
                "the frame and turned by its heading only, so that they stay level; roll and pitch of the head "
                "are left out.",
                "opt_pose and opt_trans are read, and pose and trans where they are missing; source tells which, and "
                "whose SMPL body. The released DAPT code reads pose and trans, with the neutral body for everybody.",
                "center_trans is SMPL's trans, which the released DAPT evaluation centers on.",
                "Clouds are of a subset of the frames. Those under 10 points, which LiDAR-HMR and DAPT leave out, are "
                "kept; empty ones are skipped.",
                "Frames beyond total_frames are skipped, as the authors' loader does.",
                "All joints count as seen; the labels come from a suit. There are no boxes.",
            ],
        }

    def parts(self, root: Path) -> list[str]:
        """The sequences. Raises InputError where there are no labels, or two of one name."""
        names = [path.name.removesuffix(_SUFFIX) for path in _files(root)]
        if not names:
            there = ", ".join(sorted(path.name for path in root.iterdir())[:6]) or "nothing"
            raise wrong_root(root, "SLOPER4D", _EXPECTED, f"got {there}", _GET)
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise file_error(root, f"has {twice}{_SUFFIX} twice: move one of them away")
        return sorted(names)

    def read(self, root: Path, part: str) -> Iterator[LabeledSample | Skipped]:
        """The person of a sequence, frame by frame."""
        path = next(path for path in _files(root) if path.name == part + _SUFFIX)
        labels = _labels(path)
        kind = self._smpl.kind(labels.gender)
        joints = self._smpl(labels.betas, labels.pose, labels.trans, labels.gender)
        body = labels.gender if kind == "any" else f"{labels.gender} by the {kind} body"
        for index, frame in enumerate(labels.frames):
            where = f"{part}/{frame}"
            cloud = labels.clouds.get(frame)
            if index >= labels.total:
                yield Skipped(reason="frame beyond total_frames", where=where)
            elif cloud is None:
                yield Skipped(reason="labels without a cloud", where=where)
            elif not isinstance(cloud, np.ndarray):
                yield Skipped(reason="cloud cannot be read", where=f"{where}: {cloud}")
            elif not len(cloud):
                yield Skipped(reason="empty cloud", where=where)
            elif index >= len(labels.pose) or not labels.good[index]:
                yield Skipped(reason="cloud without a pose", where=where)
            elif index >= len(labels.position):
                yield Skipped(reason="cloud without the LiDAR's place", where=where)
            elif not np.isfinite(labels.position[index]).all() or not np.isfinite(labels.heading[index]):
                yield Skipped(reason="cloud without the LiDAR's place", where=where)
            else:
                yield _item(labels, index, cloud, joints[index], f"sloper4d/{labels.which}, {body}", part)
        for frame in sorted(labels.clouds.keys() - set(labels.frames)):
            yield Skipped(reason="cloud of a frame without labels", where=f"{part}/{frame}")


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


def _labels(path: Path) -> _Labels:
    content = load_pickle(path)
    if not isinstance(content, dict) or not isinstance(content.get("second_person"), dict):
        old = isinstance(content, dict) and "SMPL_info" in content
        got = "those of a release before 1.0 (SMPL_info)" if old else "others"
        raise file_error(path, f"expected labels of SLOPER4D 1.0, with second_person, got {got}: get them at {_GET}")
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


def _item(
    labels: _Labels, index: int, cloud: np.ndarray, joints: np.ndarray, source: str, part: str
) -> LabeledSample | Skipped:
    R_sensor_world = rotation_about("z", -labels.heading[index])
    points, joints, trans = (
        (x - labels.position[index]) @ R_sensor_world.T for x in (cloud, joints, labels.trans[index])
    )
    frame = labels.frames[index]
    return smpl_item(
        points,
        joints,
        sequence=part,
        frame=frame,
        frame_id=f"{part}/{frame}",
        track="second_person",
        time=float(labels.time[index]),
        source=source,
        centers={"trans": trans},
    )
