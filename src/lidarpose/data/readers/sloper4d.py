"""SLOPER4D (Dai et al. 2023), release 1.0: one person, followed by another with a head-mounted LiDAR.

    ROOT/SEQUENCE/SEQUENCE_labels.pkl
        frame_num               (n,) the labeled frames; total_frames: the number of frames with pictures
        first_person            lidar_traj (n, 9): frame, x y z m, quaternion x y z w, time s
        second_person           opt_pose or pose (n, 72) rad, opt_trans or trans (n, 3) m, beta (10), gender;
                                point_clouds, a list of (k, 3) m in the world frame, and point_frame, their frame
                                numbers; NaN rows are dropped
    ROOT/SEQUENCE/lidar_data/lidar_frames_rot/1641234567_123.pcd
                            whole scans in the world frame, by time; optional

Joints are SMPL's, so the user's SMPL file is needed. Pickles are read without running them.
Source: climbingdaily/SLOPER4D src/data_loader.py, guidodumont/SMPLify-3D datasets/sloper4d.py.
"""

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np

from lidarpose.data.readers.base import (
    Reader,
    SceneClouds,
    Skipped,
    SmplJoints,
    as_cloud,
    labeled_sample,
    numbers,
    turned_pose,
)
from lidarpose.errors import InputError
from lidarpose.geometry import rotation_about
from lidarpose.io.files import file_error
from lidarpose.io.pickles import load_pickle
from lidarpose.sample import LabeledSample
from lidarpose.skeleton import SMPL24

_SUFFIX = "_labels.pkl"
_SCANS = "lidar_data/lidar_frames_rot"
# maximum time difference between a frame and its scan, s: the LiDAR's frames are 50 ms apart
_SAME_TIME = 0.02
# a quaternion whose length differs from 1 by more than this is not a rotation
_UNIT = 0.01


class Sloper4D(Reader):
    """Reads SLOPER4D. A part is a sequence. smpl: the user's SMPL model or models, see `SmplJoints`."""

    name = "sloper4d"
    skeleton = SMPL24.name

    def __init__(self, *, smpl: str | Path | None = None):
        self._smpl = SmplJoints(smpl, self.name)
        super().__init__(smpl=self._smpl.digests)

    def parts(self, root: Path) -> list[str]:
        """The sequences. Raises InputError if there are no labels, or two with the same name."""
        names = sorted(path.name.removesuffix(_SUFFIX) for path in _files(root))
        if not names:
            raise self.wrong_root(root)
        if duplicates := [name for name in names if names.count(name) > 1]:
            raise file_error(root, f"has {duplicates[0]}{_SUFFIX} twice: move one of them elsewhere")
        return names

    def read(self, root: Path, part: str) -> Iterator[LabeledSample | Skipped]:
        """The person of a sequence, frame by frame."""
        path = next(path for path in _files(root) if path.name == part + _SUFFIX)
        content, person, walker = _content(path)
        pose, trans, pose_name = _poses(path, person)
        clouds, repeated_frames = _clouds(path, person)
        frames = numbers(path, content.get("frame_num"), (-1,), "frame_num").astype(int).tolist()
        total = content.get("total_frames")
        total = len(frames) if total is None else int(numbers(path, total, (), "total_frames"))
        trajectory = numbers(path, walker.get("lidar_traj"), (-1, 9), "first_person's lidar_traj", finite=False)
        position, heading = trajectory[:, 1:4], _heading(trajectory[:, 4:8])
        betas = numbers(path, numbers(path, person.get("beta"), (-1,), "beta")[:10], (10,), "beta")[None]
        gender = str(person.get("gender", "neutral")).lower()
        kind = self._smpl.kind(gender)
        body = f"{gender} by the {'given' if kind == 'any' else kind} body"
        has_pose = np.isfinite(pose).all(1) & np.isfinite(trans).all(1)
        pose, trans = (np.where(has_pose[:, None], x, 0.0) for x in (pose, trans))
        has_place = np.isfinite(position).all(1) & np.isfinite(heading)
        joints = self._smpl(betas, pose, trans, gender)
        paths = _scans(path.parent, dict(zip(frames, trajectory[:, 8].tolist(), strict=False)))
        people = {frame: cloud for frame, cloud in clouds.items() if not isinstance(cloud, str)}
        scans = SceneClouds(paths, people.__getitem__, people)
        for index, frame in enumerate(frames):
            where, cloud = f"{part}/{frame}", clouds.get(frame)
            if index >= total:
                yield Skipped("frame beyond total_frames", where)
            elif cloud is None:
                yield Skipped("labels without a cloud", where)
            elif isinstance(cloud, str):
                yield Skipped("cloud cannot be read", f"{where}: {cloud}")
            elif not len(cloud):
                yield Skipped("empty cloud", where)
            elif index >= len(pose) or not has_pose[index]:
                yield Skipped("cloud without a pose", where)
            elif index >= len(trajectory) or not has_place[index]:
                yield Skipped("cloud without the LiDAR's position", where)
            else:
                R_sensor_world = rotation_about("z", -heading[index])
                points, sensor_joints, center = (
                    (x - position[index]) @ R_sensor_world.T for x in (cloud, joints[index], trans[index])
                )
                yield labeled_sample(
                    points,
                    sensor_joints,
                    sequence=part,
                    frame=frame,
                    frame_id=where,
                    track="second_person",
                    time=float(trajectory[index, 8] - trajectory[0, 8]),
                    source=f"sloper4d/{pose_name}, {body}",
                    centers={"trans": center},
                    rotations=turned_pose(pose[index], R_sensor_world),
                    translation=center,
                    **scans.around(frame, cloud, R_sensor_world, position[index]),
                )
        yield from (
            Skipped("cloud of a frame without labels", f"{part}/{frame}")
            for frame in sorted(clouds.keys() - set(frames))
        )
        yield from (Skipped("another cloud of the same frame", f"{part}/{frame}") for frame in repeated_frames)


def _files(root: Path) -> list[Path]:
    """Label files in the root and up to two folders below it; the root may be a sequence itself."""
    return sorted(path for depth in ("", "*/", "*/*/") for path in root.glob(f"{depth}*{_SUFFIX}"))


def _content(path: Path) -> tuple[dict, dict, dict]:
    """All labels, those of the scanned person, and those of the person who carries the LiDAR."""
    content = load_pickle(path)
    if not isinstance(content, dict) or not isinstance(content.get("second_person"), dict):
        is_old = isinstance(content, dict) and "SMPL_info" in content
        actual = "those of a release before 1.0 (SMPL_info)" if is_old else "others"
        remedy = "get them at www.lidarhumanmotion.net/data-sloper4d (a form)"
        raise file_error(path, f"expected labels of SLOPER4D 1.0, with second_person, got {actual}: {remedy}")
    walker = content.get("first_person")
    return content, content["second_person"], walker if isinstance(walker, dict) else {}


def _scans(folder: Path, times: dict[int, float]) -> dict[int, Path]:
    """Frame -> its whole scan: files are named by times in s, with _ instead of the decimal point."""
    files: dict[float, Path] = {}
    for path in sorted((folder / _SCANS).glob("*.pcd")):
        with suppress(ValueError):
            files[float(path.stem.replace("_", "."))] = path
    stamps = np.array(sorted(files))
    nearest_stamps = {
        frame: float(stamps[np.abs(stamps - time).argmin()]) for frame, time in times.items() if len(stamps)
    }
    return {frame: files[stamp] for frame, stamp in nearest_stamps.items() if abs(stamp - times[frame]) < _SAME_TIME}


def _poses(path: Path, person: dict) -> tuple[np.ndarray, np.ndarray, str]:
    """pose (n, 72), trans (n, 3) and the name of the pose entry; the refined ones if available."""
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


def _clouds(path: Path, person: dict) -> tuple[dict[int, np.ndarray | str], list[int]]:
    """Frame -> its first cloud (k, 3) m, or a description of the error; and the frame of each further cloud."""
    clouds, frames = person.get("point_clouds"), person.get("point_frame")
    if clouds is None or frames is None:
        raise file_error(path, "second_person has no point_clouds and point_frame: labels from another release?")
    if not isinstance(clouds, list | tuple | np.ndarray) or isinstance(clouds, np.ndarray) and not clouds.ndim:
        raise file_error(path, f"point_clouds should be a list of clouds, got {type(clouds).__name__}")
    frames = numbers(path, frames, (-1,), "point_frame").astype(int).tolist()
    if len(clouds) != len(frames):
        raise file_error(path, f"has {len(clouds)} point_clouds for {len(frames)} frames (point_frame)")
    by_frame: dict[int, np.ndarray | str] = {}
    repeated_frames = []
    for frame, cloud in zip(frames, clouds, strict=True):
        if frame in by_frame:
            repeated_frames.append(frame)
            continue
        try:
            # NaN rows are dropped, as in the authors' loaders
            by_frame[frame] = as_cloud(path, cloud)
        except InputError as error:
            by_frame[frame] = str(error)
    return by_frame, repeated_frames


def _heading(quaternion: np.ndarray) -> np.ndarray:
    """quaternion (n, 4) x y z w -> (n,) rad: yaw of the rotated x axis; NaN if the quaternion is not a rotation."""
    x, y, z, w = quaternion.T
    is_unit = np.abs(np.linalg.norm(quaternion, axis=1) - 1) < _UNIT
    return np.where(is_unit, np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z)), np.nan)
