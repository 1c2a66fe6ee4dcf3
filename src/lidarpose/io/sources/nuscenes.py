"""nuScenes in its original layout: the sweeps of its LiDAR, scene by scene, with sensor poses.

Source: Caesar et al., nuScenes: A Multimodal Dataset for Autonomous Driving, CVPR 2020, and the schema of its
development kit.
"""

from pathlib import Path
from typing import Any

import numpy as np

from lidarpose.errors import InputError, check_name
from lidarpose.geometry import quaternion_to_matrix, rigid_transform
from lidarpose.io.files import file_error, read_bytes, read_json, shorten
from lidarpose.io.point_cloud import NUSCENES_FIELDS
from lidarpose.io.sources.frame import IndexedRecording, ReadingOptions, Sweep

_CHANNEL = "LIDAR_TOP"
_TABLES = ("sample_data", "sample", "scene", "ego_pose", "calibrated_sensor", "sensor")


def open_nuscenes(folder: Path, options: ReadingOptions) -> IndexedRecording | None:
    """Opens the sweeps of one scene (topic), or of all scenes in chronological order; None if it is not nuScenes.

    folder: the folder of the data, or, if that has several versions, the folder of one version's tables (v1.0-mini,
    ...).
    """
    if (folder / "sample_data.json").is_file():
        root, versions = folder.absolute().parent, [folder]
    else:
        root, versions = folder, sorted(path.parent for path in folder.glob("v1.0-*/sample_data.json"))
    if not versions:
        return None
    if len(versions) > 1:
        names = ", ".join(path.name for path in versions)
        raise file_error(folder, f"expected one version of nuScenes, got {names}: give the folder of one")
    try:
        sweeps = _sweeps(versions[0], options.topic)
    except InputError:
        raise
    except (LookupError, TypeError, ValueError, ArithmeticError) as error:
        raise file_error(versions[0], f"not nuScenes tables ({shorten(str(error))}): download them again") from None
    file_names = {f"{part}/{_CHANNEL}": _names(root / part / _CHANNEL) for part in ("samples", "sweeps")}
    present_sweeps = [
        sweep for sweep in sweeps if sweep["file"].name in file_names.get(sweep["file"].parent.as_posix(), ())
    ]
    if not present_sweeps:
        raise file_error(root, f"holds none of the {len(sweeps)} sweeps in {versions[0].name}: unpack its files there")
    num_missing = len(sweeps) - len(present_sweeps)
    notes = [f"{num_missing} of {len(sweeps)} sweeps in its tables are not on the disk"] if num_missing else []
    notes += options.ignored("meta")

    def read(i: int) -> Sweep:
        if present_sweeps[i]["T_world_sensor"] is None:
            raise file_error(present_sweeps[i]["file"], "its pose in the tables is damaged: download them again")
        rows = _rows(root / present_sweeps[i]["file"])
        ring = rows[:, 4].astype(int) if np.isfinite(rows[:, 4]).all() else None
        return Sweep(
            points=rows[:, :3], ring=ring, T_world_sensor=present_sweeps[i]["T_world_sensor"], origin=np.zeros(3)
        )

    ids, times = ([sweep[name] for sweep in present_sweeps] for name in ("id", "time"))
    return IndexedRecording(name=str(root), ids=ids, times=times, read=read, warnings=notes)


def _sweeps(version: Path, scene: str | None) -> list[dict[str, Any]]:
    """The id, file, time in s and pose (None if damaged) of each sweep, in order."""
    tables = {name: read_json(version / f"{name}.json", expected="a nuScenes table") for name in _TABLES}
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
            sweep["T_world_sensor"] = _pose(by_token["ego_pose"].get(row["ego_pose_token"]), mount)
            sweeps.append(sweep | {"time": row["timestamp"] / 1e6})
    if not sweeps:
        raise file_error(version, f"expected sweeps of {_CHANNEL} in sample_data.json, got none: download it again")
    # scenes overlap in time if two cars drove at once
    scene_starts: dict[str, float] = {}
    for sweep in sweeps:
        scene_starts[sweep["scene"]] = min(sweep["time"], scene_starts.get(sweep["scene"], np.inf))
    return sorted(sweeps, key=lambda sweep: (scene_starts[sweep["scene"]], sweep["scene"], sweep["time"]))


def _pose(*rows: Any) -> np.ndarray | None:
    """(4, 4), the product of the rows' transforms, each a translation in m and a quaternion w, x, y, z; None if a row
    is missing or damaged."""
    pose = np.eye(4)
    for row in rows:
        try:
            quaternion, translation = np.array(row["rotation"], float), np.array(row["translation"], float)
            if not 0.5 < np.linalg.norm(quaternion) < 2 or not np.isfinite(translation).all():
                return None
            pose = pose @ rigid_transform(quaternion_to_matrix(quaternion), translation)
        except (LookupError, TypeError, ValueError):
            return None
    return pose


def _rows(path: Path) -> np.ndarray:
    """(n, 5) float32: x, y, z, intensity, ring."""
    data = read_bytes(path, expected="a nuScenes sweep")
    size = 4 * len(NUSCENES_FIELDS)
    if len(data) % size:
        raise file_error(path, f"is cut off: {len(data)} bytes is not a multiple of {size}; copy it again")
    return np.frombuffer(data, "<f4").reshape(-1, len(NUSCENES_FIELDS))


def _names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()} if folder.is_dir() else set()
