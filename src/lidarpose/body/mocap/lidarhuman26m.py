"""LiDARHuman26M: a folder with one JSON file a frame, labels/3d/pose/<sequence>/<frame>.json.

A file holds `pose` (72) rad, SMPL's axis-angles, root first, `trans` (3) m in the frame of the sensor, and `beta`
(10), which is not used. Source: the data set's page (LiDARCap, Li et al. 2022) and the loaders published with it.
"""

import json
import os
import re
from pathlib import Path

import numpy as np

from lidarpose.body.mocap.motion import Motion
from lidarpose.body.mocap.smpl_poses import smpl_motion
from lidarpose.io.files import file_error, read_bytes

# frames a second of the LiDAR that the labels belong to
LIDARHUMAN26M_FPS = 10.0
_NUMBER = re.compile("[0-9]{1,12}")


def pose_files(folder: Path) -> list[Path]:
    """The JSON files of a folder that are numbered as frames are, in the order of their numbers."""
    found = [path for path in folder.glob("*.json") if _NUMBER.fullmatch(path.stem)]
    return sorted(found, key=lambda path: int(path.stem))


def load_pose_json(path: str | os.PathLike, *, up: str | None = None, fps: float | None = None) -> Motion:
    """The motion of a folder of numbered pose files, or of a single file; z is up unless `up` says otherwise. A number
    that is missing ends a clip."""
    path = Path(path)
    files = pose_files(path) if path.is_dir() else [path]
    if not files:
        raise file_error(path, "holds no numbered JSON file such as 000001.json")
    poses, trans = zip(*(_read(file) for file in files), strict=True)
    number = np.array([int(file.stem) for file in files]) if path.is_dir() else None
    return smpl_motion(
        path,
        np.array(poses),
        np.array(trans),
        name=path.stem,
        fps=fps or LIDARHUMAN26M_FPS,
        up=up,
        kind="LiDARHuman26M",
        number=number,
    )


def _read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    data = read_bytes(path, expected="a JSON file with pose and trans")
    try:
        content = json.loads(data.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise file_error(path, f"is not JSON ({error}); was it copied completely?") from None
    if not isinstance(content, dict) or not {"pose", "trans"} <= content.keys():
        found = ", ".join(sorted(content)[:8]) if isinstance(content, dict) else type(content).__name__
        raise file_error(path, f"expected pose (72 numbers) and trans (3), got {found or 'nothing'}")
    parts = []
    for key, size in (("pose", 72), ("trans", 3)):
        try:
            value = np.asarray(content[key], dtype=float).ravel()
        except (TypeError, ValueError, OverflowError):
            raise file_error(path, f"{key} must be {size} numbers") from None
        if value.shape != (size,):
            raise file_error(path, f"{key} must be {size} numbers, got {value.size}")
        parts.append(value)
    return parts[0], parts[1]
