"""LiDARHuman26M (LiDARCap, Li et al. 2022): one person, 12 to 24 m away, scanned by a static LiDAR.

    ROOT/labels/3d/pose/7/000001.json       beta (10), pose (72) rad, trans (3) m: SMPL, neutral
    ROOT/labels/3d/segment/7/000001.ply     the person's points, m, in the LiDAR's frame, like pose and trans
    ROOT/pointclouds/7/000001.pcd           whole scans, for the person's surroundings; optional

Joints are SMPL's, so the user's SMPL file is needed. The LiDAR looks down on the people, and its frame is tilted as
mounted, so each sequence is turned level by one rotation. Source: the dataset's page, AutoCONFIG/Neighborhood-enhanced-
LidarCap sample/gen_dataset.py; jingyi-zhang/ASC_Lidar_human process.py, which makes the labels in the raw frame.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose.body.mocap.leveling import leveling
from lidarpose.body.mocap.smpl_poses import LIDARHUMAN26M_FPS
from lidarpose.data.readers import base
from lidarpose.data.readers.base import Reader, Skipped, SmplJoints
from lidarpose.errors import InputError
from lidarpose.io.files import file_error
from lidarpose.sample import LabeledSample, within_reach
from lidarpose.skeleton import SMPL24

POSE_FOLDER, _SEGMENT, _SCANS = "labels/3d/pose", "labels/3d/segment", "pointclouds"


class LidarHuman26M(Reader):
    """Reads LiDARHuman26M. A part is a sequence. smpl: the user's SMPL model, see `SmplJoints`; level: turn each
    sequence so that z is up, see `leveling`."""

    name = "lidarhuman26m"
    skeleton = SMPL24.name

    def __init__(self, *, smpl: str | Path | None = None, level: bool = True):
        self._smpl = SmplJoints(smpl, self.name)
        self._level = level
        super().__init__(smpl=self._smpl.digests[self._smpl.kind("neutral")], level=level)
        if not level:
            note = "it stands still, z up as far as it was mounted level"
            self.about["frame"] = f"the LiDAR's own, as in the release: {note}"

    def parts(self, root: Path) -> list[str]:
        """The sequences, by number. Raises InputError if poses or clouds are missing altogether."""
        for name in (POSE_FOLDER, _SEGMENT):
            if not (root / name).is_dir():
                raise self.wrong_root(root, f"got no {name}")
        names = {path.name for folder in (POSE_FOLDER, _SEGMENT) for path in (root / folder).iterdir() if path.is_dir()}
        if not names:
            raise self.wrong_root(root, f"got no sequence in {POSE_FOLDER}")
        return sorted(names, key=lambda name: (int(name) if name.isdecimal() else -1, name))

    def read(self, root: Path, part: str) -> Iterator[LabeledSample | Skipped]:
        """The person of a sequence, frame by frame."""
        poses = base.numbered(root / POSE_FOLDER / part, ".json")
        labels, label_errors = {}, {}
        for frame, paths in poses.items():
            try:
                labels[frame] = _labels(paths[0])
            except InputError as error:
                label_errors[frame] = str(error)
        joints, turn = {}, None
        if labels:
            betas, pose, trans = (np.stack(rows) for rows in zip(*labels.values(), strict=True))
            people = self._smpl(betas, pose, trans)
            joints = dict(zip(labels, people, strict=True))
            # out-of-range people are skipped later and must not affect the others
            turn = leveling(people[within_reach(people).all(-1)]) if self._level else None
        segments = base.numbered(root / _SEGMENT / part, ".ply")
        scans = {frame: paths[0] for frame, paths in base.numbered(root / _SCANS / part, ".pcd").items()}
        clouds = base.SceneClouds(scans, lambda frame: base.read_cloud(segments[frame][0]), segments)
        for pair in base.paired(poses, segments, f"{part}/{{:06d}}"):
            if isinstance(pair, Skipped):
                yield pair
                continue
            frame, _, cloud = pair
            if frame in label_errors:
                yield Skipped("labels cannot be read", label_errors[frame])
            elif cloud is None:
                yield Skipped("labels without a cloud", f"{part}/{frame:06d}")
            else:
                time = (frame - min(poses)) / LIDARHUMAN26M_FPS
                R = np.eye(3) if turn is None else turn
                rotations = base.turned_pose(labels[frame][1], R)
                frame_fields = {"sequence": part, "frame": frame, "frame_id": f"{part}/{cloud.stem}", "time": time}
                yield _sample(cloud, clouds, joints[frame], labels[frame][2], turn, **frame_fields, rotations=rotations)


def _labels(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """betas (10,), pose (72,) rad and trans (3,) m."""
    content = base.read_object(path, "SMPL's beta, pose and trans")
    missing_keys = [key for key in ("beta", "pose", "trans") if key not in content]
    if missing_keys:
        raise file_error(path, f"expected beta, pose and trans, got no {', '.join(missing_keys)}")
    sizes = {"beta": 10, "pose": 72, "trans": 3}
    beta, pose, trans = (base.numbers(path, content[key], (size,), key) for key, size in sizes.items())
    return beta, pose, trans


def _sample(
    path: Path, clouds: base.SceneClouds, joints: np.ndarray, trans: np.ndarray, turn: np.ndarray | None, **fields: Any
) -> LabeledSample | Skipped:
    """The sample of a frame. clouds: the whole scans; turn: R_level_sensor, None to keep the sensor's frame; fields:
    others of the sample, already turned."""
    try:
        points = base.read_cloud(path)
    except InputError as error:
        return Skipped("cloud cannot be read", str(error))
    if not len(points):
        return Skipped("empty cloud", fields["frame_id"])
    fields |= clouds.around(fields["frame"], points, np.eye(3) if turn is None else turn)
    source = "lidarhuman26m"
    if turn is not None:
        points, joints, trans = (x @ turn.T for x in (points, joints, trans))
        source += f", turned level by {np.degrees(np.arccos(np.clip(turn[2, 2], -1, 1))):.0f} deg"
    fields |= {"track": "0", "source": source, "centers": {"trans": trans}, "translation": trans}
    return base.labeled_sample(points, joints, **fields)
