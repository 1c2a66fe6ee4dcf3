"""HumanM3 (Fan et al. 2023): several people in outdoor scenes, seen by four LiDARs whose clouds were fused.

    ROOT/{train,test}/SEQUENCE/[one more folder/]
        pointcloud/000012.pcd       everything around, world frame, z up, m
        pose_calib/0012.json        {track: 15 x [x, y, z]}, or 12.json
        smpl_estimated/0012.json    fits to the joints, not read
    or ROOT/{train,test}.pkl        the authors' database: {"db": [{"pcd": path, "info": [one a camera]}]}

The joints are `human15`, in its order. The database has everybody once a camera; here once. There is no box: one is
made from the labelled joints, which the center "joints_box" tells, and crops the points.
Sources: soullessrobot/Human-M3-Dataset lib/dataset/human_m3.py, guidodumont/SMPLify-3D datasets/humanm3.py.
"""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from lidarpose.data.readers.base import Skipped, find_below, numbered, numbers, read_cloud, read_json, wrong_root
from lidarpose.errors import InputError
from lidarpose.io.files import file_error
from lidarpose.io.pickles import load_pickle
from lidarpose.sample import SEEN, UNLABELED, Box, LabeledSample, Pose, center_of
from lidarpose.skeleton import HUMAN15

# frames a second of the fused clouds
_FPS = 10.0
# the box of a person: that of the joints, this much larger on each side, m
_BOX_MARGIN = 0.2
# and the points are those in a box this much larger still, m: what a detector's box lets in
_POINT_MARGIN = 0.3
# what lies at the root
_SPLITS = ("train", "test")
# how many folders below the root a sequence may lie
_DEEPEST = 3
_EXPECTED = (
    "{train,test}/SEQUENCE/pointcloud/000000.pcd and pose_calib/0000.json, or the database train.pkl or test.pkl"
)
_GET = "ivg.au.tsinghua.edu.cn/dataset/Human_M3 (registration)"


class HumanM3:
    """Reads HumanM3's folders, or where there are none the authors' database. A part is a sequence or a database."""

    name = "humanm3"
    skeleton = HUMAN15.name
    about = {
        "frame": "world: x, y on the ground, z up, m, about an origin that is nobody's; four LiDARs fused",
        "sensor_known": False,
        "licence": "Human-M3's DATA_LICENSE: non-commercial research, no redistribution",
        "get": _GET,
        "notes": [
            "The place of the four LiDARs is not told, so points stay in the world's frame and distance is null.",
            "Points are fused from non-repetitive scans: there are no rings.",
            "There are no boxes; box is that of the labelled joints +-0.2 m, yaw 0, and points are those within 0.3 m "
            "of it, ground and other people included. It leaks the pose: do not center on it unless to compare.",
            "Joints 7 and 8 are neck and head; the released DAPT configuration names them head and nose, and its table "
            "for mirroring leaves the ankles where they are. Here left and right are told by name.",
            "All joints are labelled as seen: nothing is known of what hides them.",
            "smpl_estimated is a fit to the same joints and is not read.",
            "time counts frames at 10 Hz, since the release has none; of the database it is not known.",
        ],
    }

    def parts(self, root: Path) -> list[str]:
        """Sequences as paths below the root, or the databases where none is complete. Raises InputError where there
        is neither, and where only some sequences have labels and clouds."""
        databases = [f"{name}.pkl" for name in sorted(_SPLITS) if (root / f"{name}.pkl").is_file()]
        below = [path.parent for name in _SPLITS for path in sorted(root.glob(f"*/{name}")) if path.is_dir()]
        if below and not databases and not any((root / name).is_dir() for name in _SPLITS):
            raise file_error(root, f"is a folder above HumanM3's root, which is likely {below[0]}: name that")
        found, half = [], ""
        for folder in sorted(self._folders(root, _DEEPEST)):
            missing = [name for name in ("pointcloud", "pose_calib") if not (folder / name).is_dir()]
            if not missing:
                found.append(folder.relative_to(root).as_posix())
            elif len(missing) == 1:
                half = half or f"{folder} without {missing[0]}"
        if found and not half:
            return found
        if found:
            raise file_error(root, f"has {half}: get that folder too, or move its sequence away")
        if databases:
            return databases
        there = half or ", ".join(sorted(path.name for path in root.iterdir())[:6]) or "nothing"
        raise wrong_root(root, "HumanM3", _EXPECTED, f"got {there}", _GET)

    def _folders(self, folder: Path, depth: int) -> Iterator[Path]:
        yield folder
        if depth and not (folder / "pose_calib").is_dir() and not (folder / "pointcloud").is_dir():
            for below in folder.iterdir():
                if below.is_dir():
                    yield from self._folders(below, depth - 1)

    def read(self, root: Path, part: str) -> Iterator[LabeledSample | Skipped]:
        """Everybody in a sequence by frame, or in a database in its order."""
        return self._read_database(root, part) if part.endswith(".pkl") else self._read_folder(root, part)

    def _read_folder(self, root: Path, part: str) -> Iterator[LabeledSample | Skipped]:
        folder = root / part
        clouds = numbered(folder / "pointcloud", ".pcd")
        labels = numbered(folder / "pose_calib", ".json")
        first = min(labels, default=0)
        for frame in sorted(labels.keys() | clouds.keys()):
            where = f"{part}/{frame}"
            if frame not in labels:
                yield Skipped(reason="cloud without labels", where=where)
                continue
            if len(labels[frame]) > 1 or len(clouds.get(frame, ())) > 1:
                names = ", ".join(path.name for path in [*labels[frame], *clouds.get(frame, ())])
                yield Skipped(reason="several files of one frame", where=f"{where}: {names}")
                continue
            try:
                bodies = read_json(labels[frame][0], "people's joints")
            except InputError as error:
                yield Skipped(reason="labels cannot be read", where=str(error))
                continue
            if frame not in clouds:
                yield from (Skipped(reason="labels without a cloud", where=f"{where}/{track}") for track in bodies)
                continue
            people = {}
            for track in sorted(bodies, key=_by_number):
                try:
                    people[track] = numbers(labels[frame][0], bodies[track], (15, 3), f"joints of {track}")
                except InputError as error:
                    yield Skipped(reason="not 15 joints", where=str(error))
            yield from _people(clouds[frame][0], people, part, frame, (frame - first) / _FPS)

    def _read_database(self, root: Path, part: str) -> Iterator[LabeledSample | Skipped]:
        content = load_pickle(root / part)
        if not isinstance(content, dict) or not isinstance(content.get("db"), list):
            raise file_error(root / part, 'is not HumanM3\'s database: expected {"db": [...]}, made by its own code')
        for number, entry in enumerate(content["db"]):
            where = f"{part}: entry {number}"
            try:
                people = _without_copies(entry["info"], where)
                path = find_below(root, str(entry["pcd"]))
            except (InputError, TypeError, KeyError) as error:
                yield Skipped(reason="entry of another form", where=f"{where}: {error!r}")
                continue
            if path is None:
                yield Skipped(reason="labels without a cloud", where=f"{where}: {entry['pcd']}")
                continue
            sequence = path.relative_to(root).parent.parent.as_posix()
            frame = int(path.stem) if re.fullmatch("[0-9]{1,12}", path.stem) else number
            yield from _people(path, people, sequence, frame, float("nan"))


def _by_number(track: str) -> tuple[int, str]:
    return (int(track) if track.isdecimal() else -1, track)


def _without_copies(info: list[dict], where: str) -> dict[str, np.ndarray]:
    """Joints (15, 3) of everybody in a frame, NaN where no camera says visible: each has copies of the same people."""
    found: dict[bytes, np.ndarray] = {}
    visible: dict[bytes, np.ndarray] = {}
    for camera in info:
        joints = numbers(where, camera["joints_3d"], (-1, 15, 3), "joints_3d")
        seen = np.ones(joints.shape)
        if camera.get("joints_3d_vis") is not None:
            seen = numbers(where, camera["joints_3d_vis"], joints.shape, "joints_3d_vis")
        for person, there in zip(joints, (seen > 0).all(-1), strict=True):
            key = person.tobytes()
            found.setdefault(key, person)
            visible[key] = visible.get(key, False) | there
    return {str(k): np.where(visible[key][:, None], joints, np.nan) for k, (key, joints) in enumerate(found.items())}


def _people(
    path: Path, people: dict[str, np.ndarray], sequence: str, frame: int, time: float
) -> Iterator[LabeledSample | Skipped]:
    if not people:
        yield Skipped(reason="frame without people", where=f"{sequence}/{frame}")
        return
    try:
        cloud = read_cloud(path)
    except InputError as error:
        # everybody in it is lost
        yield from (Skipped(reason="cloud cannot be read", where=f"{error} ({track})") for track in people)
        return
    for track, joints in people.items():
        frame_id = f"{sequence}/{frame}"
        labeled = ~np.isnan(joints).any(-1)
        if not labeled.any():
            yield Skipped(reason="no joint is labelled", where=f"{frame_id}/{track}")
            continue
        low, high = joints[labeled].min(0), joints[labeled].max(0)
        try:
            box = Box(center=(low + high) / 2, size=high - low + 2 * _BOX_MARGIN, id=track)
        except InputError as error:
            yield Skipped(reason="joints out of reach", where=f"{frame_id}/{track}: {error}")
            continue
        points = cloud[box.contains(cloud, _POINT_MARGIN)]
        if not len(points):
            yield Skipped(reason="no points in the box", where=f"{frame_id}/{track}")
            continue
        points = points.astype(np.float32)
        yield LabeledSample(
            points=points,
            center=center_of(points),
            pose=Pose(joints=joints.astype(np.float32), skeleton=HUMAN15, frame="sensor"),
            box=box,
            source="humanm3",
            frame_id=frame_id,
            joint_labels=np.where(labeled, SEEN, UNLABELED).astype(np.uint8),
            sequence=sequence,
            frame=frame,
            track=track,
            time=time,
            centers={"joints_box": box.center},
            sensor_known=False,
        )
