"""HumanM3 (Fan et al. 2023): several people in outdoor scenes, seen by four LiDARs whose clouds were fused.

    ROOT/{train,test}/SEQUENCE/[one more folder/]
        pointcloud/000012.pcd       whole scans, world frame, z up, m
        pose_calib/0012.json        {track: 15 x [x, y, z]}, or 12.json
        smpl_estimated/0012.json    fits to the joints, not read
    or ROOT/{train,test}.pkl        the authors' database: {"db": [{"pcd": path, "info": [one per camera]}]}

The joints are `human15`, in its order. The database lists each person once per camera; duplicates are merged here.
There is no box: one is made from the labeled joints and crops the points; its center is "joints_box".
Sources: soullessrobot/Human-M3-Dataset lib/dataset/human_m3.py, guidodumont/SMPLify-3D datasets/humanm3.py.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from lidarpose.data.readers import base
from lidarpose.data.readers.base import Reader, Skipped
from lidarpose.errors import InputError
from lidarpose.io.files import FRAME_NUMBER, file_error
from lidarpose.io.pickles import load_pickle
from lidarpose.sample import LabeledSample
from lidarpose.skeleton import HUMAN15

# frames per second of the fused clouds
_FPS = 10.0
# folders or databases in the root
_SPLITS = ("train", "test")
_FOLDERS = ("pointcloud", "pose_calib")
# maximum depth of a sequence's folder below the root
_DEEPEST = 3


class HumanM3(Reader):
    """Reads HumanM3's folders, or without them the authors' database. A part is a sequence or a database."""

    name = "humanm3"
    skeleton = HUMAN15.name

    def parts(self, root: Path) -> list[str]:
        """Sequences as paths below the root, or the databases if no sequence is complete. Raises InputError if there is
        neither, and if only some sequences have both labels and clouds."""
        databases = [f"{name}.pkl" for name in sorted(_SPLITS) if (root / f"{name}.pkl").is_file()]
        nested_folders = [path.parent for name in _SPLITS for path in sorted(root.glob(f"*/{name}")) if path.is_dir()]
        if nested_folders and not databases and not any((root / name).is_dir() for name in _SPLITS):
            raise file_error(
                root, f"is a folder above HumanM3's root, which is likely {nested_folders[0]}: give that folder"
            )
        sequences, incomplete_sequence = [], ""
        for folder in sorted(_folders(root, _DEEPEST)):
            missing_folders = [name for name in _FOLDERS if not (folder / name).is_dir()]
            if not missing_folders:
                sequences.append(folder.relative_to(root).as_posix())
            elif len(missing_folders) == 1 or (
                folder != root and folder.parent.name in _SPLITS and not _has_sequence(folder)
            ):
                incomplete_sequence = incomplete_sequence or f"{folder} without {' and '.join(missing_folders)}"
        # if the root were below the folder of a split, the split would be unknown
        split_folder = root.parent if sequences == ["."] else root
        if sequences and split_folder.name in _SPLITS and not any((root / name).is_dir() for name in _SPLITS):
            raise file_error(root, f"lies in HumanM3's root, which is likely {split_folder.parent}: give that folder")
        if sequences and incomplete_sequence:
            raise file_error(root, f"has {incomplete_sequence}: add what is missing, or move that sequence elsewhere")
        if not sequences and not databases:
            raise self.wrong_root(root, f"got {incomplete_sequence or base.entries(root)}")
        return sequences or databases

    def read(self, root: Path, part: str) -> Iterator[LabeledSample | Skipped]:
        """All people of a sequence by frame, or of a database in its order."""
        return _read_database(root, part) if part.endswith(".pkl") else _read_sequence(root, part)


def _has_sequence(folder: Path) -> bool:
    return any((path / name).is_dir() for path in _folders(folder, 1) for name in _FOLDERS)


def _folders(folder: Path, depth: int) -> Iterator[Path]:
    yield folder
    if depth and not any((folder / name).is_dir() for name in _FOLDERS):
        for child in folder.iterdir():
            if child.is_dir():
                yield from _folders(child, depth - 1)


def _read_sequence(root: Path, part: str) -> Iterator[LabeledSample | Skipped]:
    labels = base.numbered(root / part / "pose_calib", ".json")
    first_frame = min(labels, default=0)
    for pair in base.paired(labels, base.numbered(root / part / "pointcloud", ".pcd"), f"{part}/{{}}"):
        if isinstance(pair, Skipped):
            yield pair
            continue
        frame, path, cloud = pair
        try:
            bodies = base.read_object(path, "people's joints")
        except InputError as error:
            yield Skipped("labels cannot be read", str(error))
            continue
        if cloud is None:
            yield from (Skipped("labels without a cloud", f"{part}/{frame}/{track}") for track in bodies)
            continue
        people = {}
        for track in sorted(bodies, key=lambda track: (int(track) if track.isdecimal() else -1, track)):
            try:
                joints = base.numbers(path, bodies[track], (15, 3), f"joints of {track}", finite=False)
                # unlabeled joints are null
                people[track] = np.where(np.isfinite(joints), joints, np.nan)
            except InputError as error:
                yield Skipped("not 15 joints", str(error))
        yield from _people(cloud, people, part, frame, (frame - first_frame) / _FPS)


def _read_database(root: Path, part: str) -> Iterator[LabeledSample | Skipped]:
    content = load_pickle(root / part)
    if not isinstance(content, dict) or not isinstance(content.get("db"), list):
        raise file_error(root / part, 'is not HumanM3\'s database: expected {"db": [...]}, made by its own code')
    for number, entry in enumerate(content["db"]):
        where = f"{part}: entry {number}"
        try:
            people = _without_copies(entry["info"], where)
            path = base.find_below(root, str(entry["pcd"]))
        except (ValueError, TypeError, LookupError, AttributeError) as error:
            yield Skipped("entry in another format", f"{where}: {error!r}")
            continue
        if path is None:
            yield Skipped("labels without a cloud", f"{where}: {entry['pcd']}")
            continue
        sequence = path.relative_to(root).parent.parent.as_posix()
        frame = int(path.stem) if FRAME_NUMBER.fullmatch(path.stem) else number
        yield from _people(path, people, sequence, frame, float("nan"))


def _without_copies(info: list[dict], where: str) -> dict[str, np.ndarray]:
    """Joints (15, 3) of each person in a frame, merged over cameras, which have copies of the same people; NaN if no
    camera marks the joint as visible."""
    people: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}
    for camera in info:
        joints = base.numbers(where, camera["joints_3d"], (-1, 15, 3), "joints_3d")
        visibility = np.ones(joints.shape)
        if camera.get("joints_3d_vis") is not None:
            visibility = base.numbers(where, camera["joints_3d_vis"], joints.shape, "joints_3d_vis")
        for person, is_visible in zip(joints, np.all(visibility > 0, axis=-1), strict=True):
            _, was_visible = people.get(person.tobytes(), (None, False))
            people[person.tobytes()] = person, is_visible | was_visible
    return {
        str(k): np.where(is_visible[:, None], person, np.nan) for k, (person, is_visible) in enumerate(people.values())
    }


def _people(
    path: Path, people: dict[str, np.ndarray], sequence: str, frame: int, time: float
) -> Iterator[LabeledSample | Skipped]:
    frame_id = f"{sequence}/{frame}"
    if not people:
        yield Skipped("frame without people", frame_id)
        return
    try:
        cloud = base.read_cloud(path)
    except InputError as error:
        # all people of the frame are skipped
        yield from (Skipped("cloud cannot be read", f"{error} ({track})") for track in people)
        return
    for track, joints in people.items():
        where, labeled_joints = f"{frame_id}/{track}", joints[~np.isnan(joints).any(-1)]
        if not len(labeled_joints):
            yield Skipped("no joint is labeled", where)
            continue
        try:
            box = base.box_of_joints(labeled_joints, track)
        except InputError as error:
            yield Skipped("joints out of range", f"{where}: {error}")
            continue
        points = cloud[box.contains(cloud, base.POINT_MARGIN)]
        if not len(points):
            yield Skipped("no points in the box", where)
            continue
        yield base.labeled_sample(
            points,
            joints,
            HUMAN15,
            box=box,
            source="humanm3",
            sequence=sequence,
            frame=frame,
            track=track,
            time=time,
            centers={"joints_box": box.center},
            sensor_known=False,
        )
