"""nuScenes as it lies on disk: the sweeps of its LiDAR, scene by scene, with the sensor's poses.

Source: Caesar et al., nuScenes: A Multimodal Dataset for Autonomous Driving, CVPR 2020, and the schema of its
development kit.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose.errors import InputError, check_name
from lidarpose.io.files import file_error, read_bytes, shorten
from lidarpose.io.point_cloud import NUSCENES_FIELDS
from lidarpose.io.sources.frame import IndexedRecording, Sweep

_CHANNEL = "LIDAR_TOP"
_TABLES = ("sample_data", "sample", "scene", "ego_pose", "calibrated_sensor", "sensor")


def open_nuscenes(folder: Path, scene: str | None = None) -> IndexedRecording | None:
    """The sweeps of one scene, or of all in the order of time; None for a folder that is not nuScenes'.

    folder: the data's, or that of its tables (v1.0-mini, ...) where it has several.
    """
    if (folder / "sample_data.json").is_file():
        root, versions = folder.absolute().parent, [folder]
    else:
        root, versions = folder, sorted(path.parent for path in folder.glob("v1.0-*/sample_data.json"))
    if not versions:
        return None
    if len(versions) > 1:
        names = ", ".join(path.name for path in versions)
        raise file_error(folder, f"expected one version of nuScenes, got {names}: name the folder of one")
    try:
        sweeps = _sweeps(versions[0], scene)
    except InputError:
        raise
    except (LookupError, TypeError, ValueError, ArithmeticError, RecursionError) as error:
        raise file_error(versions[0], f"its tables are not nuScenes' ({shorten(str(error))}): download again") from None
    there = {f"{part}/{_CHANNEL}": _names(root / part / _CHANNEL) for part in ("samples", "sweeps")}
    kept = [sweep for sweep in sweeps if sweep["file"].name in there.get(sweep["file"].parent.as_posix(), ())]
    if not kept:
        raise file_error(root, f"holds none of the {len(sweeps)} sweeps in {versions[0].name}: unpack its files there")
    warnings = []
    if len(kept) < len(sweeps):
        warnings.append(f"{len(sweeps) - len(kept)} of {len(sweeps)} sweeps in its tables are not on the disk")

    def read(i: int) -> Sweep:
        path = root / kept[i]["file"]
        rows = _rows(path)
        return Sweep(
            points=rows[:, :3],
            ring=rows[:, 4].astype(int) if np.isfinite(rows[:, 4]).all() else None,
            T_world_sensor=kept[i]["T_world_ego"] @ kept[i]["T_ego_sensor"],
            origin=np.zeros(3),
        )

    return IndexedRecording(
        name=str(root),
        ids=[sweep["id"] for sweep in kept],
        times=[sweep["time"] for sweep in kept],
        read=read,
        warnings=warnings,
    )


def _sweeps(version: Path, scene: str | None) -> list[dict[str, Any]]:
    """Of each sweep its id, file, time in s and poses, in order."""
    tables = {
        name: json.loads(read_bytes(version / f"{name}.json", expected="a table of nuScenes")) for name in _TABLES
    }
    sample_data = tables.pop("sample_data")
    by_token = {name: {row["token"]: row for row in rows} for name, rows in tables.items()}
    if scene is not None:
        check_name("scene", scene, sorted(row["name"] for row in tables["scene"]))
    sweeps = []
    for row in sample_data:
        mount = by_token["calibrated_sensor"][row["calibrated_sensor_token"]]
        if by_token["sensor"][mount["sensor_token"]]["channel"] != _CHANNEL:
            continue
        name = by_token["scene"][by_token["sample"][row["sample_token"]]["scene_token"]]["name"]
        if scene in (None, name):
            sweep = {"scene": name, "id": f"{name}/{row['timestamp']}", "file": Path(row["filename"])}
            poses = {"T_world_ego": _pose(by_token["ego_pose"][row["ego_pose_token"]]), "T_ego_sensor": _pose(mount)}
            sweeps.append(sweep | poses | {"time": row["timestamp"] / 1e6})
    if not sweeps:
        raise file_error(version, f"expected sweeps of {_CHANNEL} in sample_data.json, got none: download it again")
    # scenes may overlap where two cars drove at once
    begin: dict[str, float] = {}
    for sweep in sweeps:
        begin[sweep["scene"]] = min(sweep["time"], begin.get(sweep["scene"], np.inf))
    return sorted(sweeps, key=lambda sweep: (begin[sweep["scene"]], sweep["scene"], sweep["time"]))


def _pose(row: dict[str, Any]) -> np.ndarray:
    """(4, 4) of a translation in m and a quaternion w, x, y, z."""
    quaternion = np.array(row["rotation"], float)
    if not 0.5 < np.linalg.norm(quaternion) < 2:
        raise ValueError("a rotation that is none")
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    T = np.eye(4)
    T[:3, :3] += 2 * (w * cross + cross @ cross)
    T[:3, 3] = row["translation"]
    if not np.isfinite(T).all():
        raise ValueError("a place that is none")
    return T


def _rows(path: Path) -> np.ndarray:
    """(n, 5) float32: x, y, z, intensity, ring."""
    data = read_bytes(path, expected="a sweep of nuScenes")
    size = 4 * len(NUSCENES_FIELDS)
    if len(data) % size:
        raise file_error(path, f"is cut off: {len(data)} bytes do not divide by {size}; copy it again")
    return np.frombuffer(data, "<f4").reshape(-1, len(NUSCENES_FIELDS))


def _names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()} if folder.is_dir() else set()
