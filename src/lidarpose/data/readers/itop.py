"""ITOP (Haque et al. 2016): one person in a room, seen by a depth camera from the side or from the ceiling.

    ROOT/ITOP_{side,top}_{train,test}_labels.h5
        id (n,)                             b"PP_FFFFF": person, frame
        is_valid (n,)                       1 where a human checked the labels
        real_world_coordinates (n, 15, 3)   joints, m
        visible_joints (n, 15)              1 where the camera sees the joint
    ROOT/ITOP_{side,top}_{train,test}_point_cloud.h5
        id (n,); data (n, 76800, 3)         all points of the depth image, m

The axes are the camera's: x right, y up, z away from it. In the side view, the person is segmented from the room
without labels (`person_of_room`); for the top view no such method is published, so a box about the labeled joints crops
the points.
Sources: iballester/spike const/skeleton_joints.py and utils/preprocess_itop.py.
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from lidarpose.data.readers import base
from lidarpose.data.readers.base import Reader, Skipped
from lidarpose.errors import InputError, needs_extra
from lidarpose.io.files import file_error, one_line
from lidarpose.sample import HIDDEN, SEEN, UNLABELED, LabeledSample
from lidarpose.skeleton import ITOP14

PARTS = ("side/test", "side/train", "top/test", "top/train")
# the HDF5 datasets of a file, and their shapes without the first dimension, the number of frames
_DATASETS: dict[str, dict[str, tuple[int, ...]]] = {
    "labels": {"id": (), "is_valid": (), "real_world_coordinates": (15, 3), "visible_joints": (15,)},
    "point_cloud": {"id": (), "data": (76800, 3)},
}
# the largest file has 39,795; more than this means a damaged header
_MOST_FRAMES = 1_000_000
# index of the torso among the 15 joints
_TORSO = 8
# from the camera's axes to those of the level frame: a reflection, since x right, y up, z away is left-handed
_R_LEVEL_CAMERA = {
    "side": np.array([[0.0, 0, 1], [-1, 0, 0], [0, 1, 0]]),
    "top": np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, -1]]),
}
# minimum number of frames to tell whether x is right or left
_LEAST_FRAMES = 100
# region of people in the side view: low and high x, y, z in the camera's axes, m. Source: SPiKE, as for the following
_REGION = np.array([[-0.85, -1.7, 1.85], [0.95, 1.0, 3.7]])
# the floor is in the lowest 10 of 100 equal height bins
_FLOOR_STEPS, _STEPS = 10, 100
# cell size of clusters: points in neighboring cells are connected, m (SPiKE: DBSCAN with 0.15 m; here, connected points
# can be about twice as far apart)
_CELL = 0.075
# smaller clusters are noise
_LEAST_POINTS = 10
# other clusters are kept within this distance of the largest one, m
_NEAR = 0.2


class Itop(Reader):
    """Reads ITOP's HDF5 files. A part is a pair of them: "side/test", "top/train"."""

    name = "itop"
    skeleton = ITOP14.name

    def parts(self, root: Path) -> list[str]:
        """The parts with at least one file. Raises InputError if there are none."""
        parts = [part for part in PARTS if any(_path(root, part, kind).is_file() for kind in _DATASETS)]
        if not parts:
            raise self.wrong_root(root)
        return parts

    def check(self, root: Path, part: str) -> None:
        """Raises InputError if a file of the pair is missing or damaged, and if the two have different frames;
        MissingExtra without h5py."""
        with _opened(root, part):
            pass

    def read(self, root: Path, part: str) -> Iterator[LabeledSample | Skipped]:
        """The person of each frame whose labels were checked, in the order of the file."""
        view = part.split("/")[0]
        with _opened(root, part) as (labels, clouds):
            path = labels.filename
            joints = base.numbers(path, labels["real_world_coordinates"][:], (-1, 15, 3), "joints", finite=False)
            # infinite values become NaN
            joints = np.where(np.isfinite(joints), joints, np.nan)
            is_valid, is_visible = labels["is_valid"][:] > 0, labels["visible_joints"][:] > 0
            R_level_camera, source = _R_LEVEL_CAMERA[view], f"itop/{view}"
            if is_mirrored(np.delete(joints[is_valid] @ R_level_camera.T, _TORSO, 1)):
                R_level_camera, source = R_level_camera * np.array([-1.0, 1, 1]), f"{source}, x left"
            for k, name in enumerate(_ids(labels)):
                where = f"{part}/{name}"
                person, _, frame = name.partition("_")
                if not is_valid[k]:
                    yield Skipped("labels not checked by a human", where)
                elif not (person.isdecimal() and frame.isdecimal()):
                    yield Skipped("id in another format", where)
                else:
                    try:
                        cloud = base.as_cloud(clouds.filename, clouds["data"][k])
                    except (InputError, OSError) as error:
                        yield Skipped("cloud cannot be read", one_line(f"{where}: {error}"))
                        continue
                    yield _sample(
                        cloud,
                        np.delete(joints[k], _TORSO, 0),
                        np.delete(is_visible[k], _TORSO),
                        R_level_camera,
                        source=source,
                        sequence=f"{view}/{person}",
                        frame=int(frame),
                        frame_id=where,
                    )


def _sample(
    cloud: np.ndarray, joints: np.ndarray, is_visible: np.ndarray, R_level_camera: np.ndarray, **fields: Any
) -> LabeledSample | Skipped:
    """The person in a cloud (n, 3) m with joints (14, 3) m, both in the camera's axes; fields: others of the sample."""
    is_labeled, frame_id = np.isfinite(joints).all(-1), fields["frame_id"]
    if not is_labeled.any():
        return Skipped("no joint is labeled", frame_id)
    joints = np.where(is_labeled[:, None], joints, np.nan) @ R_level_camera.T
    if fields["sequence"].startswith("side"):
        points = person_of_room(cloud) @ R_level_camera.T
        if not len(points):
            return Skipped("no person stands out from the room", frame_id)
    else:
        try:
            box = base.box_of_joints(joints[is_labeled], "0")
        except InputError as error:
            return Skipped("joints out of range", f"{frame_id}: {error}")
        points = cloud @ R_level_camera.T
        points = points[box.contains(points, base.POINT_MARGIN)]
        if not len(points):
            return Skipped("no points in the box", frame_id)
        fields |= {"box": box, "centers": {"joints_box": box.center}}
    joint_labels = np.where(is_labeled, np.where(is_visible, SEEN, HIDDEN), UNLABELED).astype(np.uint8)
    return base.labeled_sample(points, joints, ITOP14, joint_labels=joint_labels, track="0", **fields)


def is_mirrored(joints: np.ndarray) -> bool:
    """joints (n, 14, 3) m of itop14 -> whether the data is mirrored: forearms point backward on average, given which
    side is labeled left. False for fewer than 100 people with all joints."""
    joints = joints[np.isfinite(joints).all((1, 2))]
    if len(joints) < _LEAST_FRAMES:
        return False
    left, right = (
        {name: joints[:, ITOP14.index(f"{side}_{name}")] for name in ("shoulder", "hip", "elbow", "hand")}
        for side in ("left", "right")
    )
    middle = {name: (left[name] + right[name]) / 2 for name in left}
    # the cross product of a person's left and up directions points forward
    forward = np.cross(left["shoulder"] - right["shoulder"], middle["shoulder"] - middle["hip"])
    return bool(((middle["hand"] - middle["elbow"]) * forward).sum(-1).mean() < 0)


# ---- files


def _path(root: Path, part: str, kind: str) -> Path:
    return root / f"ITOP_{part.replace('/', '_')}_{kind}.h5"


def _ids(file: Any) -> list[str]:
    return [name.decode("ascii", "replace") if isinstance(name, bytes) else str(name) for name in file["id"][:]]


@contextmanager
def _opened(root: Path, part: str) -> Iterator[tuple[Any, Any]]:
    """Labels and clouds of a part, checked except for their values. Raises InputError, MissingExtra without h5py."""
    with needs_extra("reading ITOP"):
        import h5py
    paths = [_path(root, part, kind) for kind in _DATASETS]
    with ExitStack() as stack:
        files, ids = [], []
        for path, shapes in zip(paths, _DATASETS.values(), strict=True):
            if not path.is_file():
                raise file_error(path, "is missing: get it from zenodo.org/records/3932973 and unpack it with gunzip")
            try:
                files.append(stack.enter_context(h5py.File(path, "r")))
                actual_shapes = {name: getattr(files[-1].get(name), "shape", None) for name in shapes}
                ids.append(
                    _ids(files[-1])
                    if actual_shapes["id"] is not None and actual_shapes["id"] <= (_MOST_FRAMES,)
                    else []
                )
            # the exceptions that h5py raises for damaged files
            except (OSError, KeyError, RuntimeError, TypeError, ValueError) as error:
                problem = f"cannot be read as HDF5 ({one_line(str(error))}); was it downloaded and unpacked completely?"
                raise file_error(path, problem) from None
            for name, shape in shapes.items():
                if actual_shapes[name] != (expected_shape := (len(ids[-1]), *shape)):
                    raise file_error(path, f"expected {name} of shape {expected_shape}, got {actual_shapes[name]}")
        if ids[0] != ids[1]:
            raise file_error(paths[1], f"has other frames than {paths[0].name}: get both again")
        yield files[0], files[1]


# ---- the person in the side view's room


def person_of_room(points: np.ndarray) -> np.ndarray:
    """points (n, 3) m in the camera's axes, y up -> those of the person (k, 3), k = 0 if no person is found.

    Uses no labels and follows SPiKE's preprocessing: crop a fixed region of the room, remove the floor, keep the
    largest cluster and the clusters around, in front of and below it. Clusters are connected cells; SPiKE uses DBSCAN.
    """
    points = points[((points >= _REGION[0]) & (points <= _REGION[1])).all(1)]
    points = points[points[:, 1] >= _floor(points[:, 1])]
    if not len(points):
        return points
    cluster = _clusters(points)
    counts = np.bincount(cluster)
    largest_cluster = points[cluster == counts.argmax()]
    low, high = largest_cluster.min(0) - _NEAR, largest_cluster.max(0) + _NEAR
    # extended up and toward the camera, for raised and outstretched arms
    low[2], high[1] = _REGION[0, 2], high[1] + _NEAR
    is_around = _all_inside(points, cluster, low, high)
    # detached shins and feet: not beside the largest cluster, and at any depth below it
    low[0], high[0], low[1] = low[0] + _NEAR, high[0] - _NEAR, -np.inf
    is_person = (is_around | _all_inside(points, cluster, low, high)) & (counts >= _LEAST_POINTS)
    return points[is_person[cluster]]


def _all_inside(points: np.ndarray, cluster: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """(clusters,) bool: whether all points of a cluster lie within the limits."""
    return np.bincount(cluster, ((points < low) | (points > high)).any(1)) == 0


def _floor(heights: np.ndarray) -> float:
    """The height m below which points are floor, -inf if no floor is visible: then the lowest tenth of the height range
    has no more points than the other tenths have on average."""
    counts, edges = np.histogram(heights, bins=_STEPS)
    lowest_counts = counts[:_FLOOR_STEPS]
    if lowest_counts.sum() <= _FLOOR_STEPS * counts.mean():
        return -np.inf
    counts_above = lowest_counts[lowest_counts.argmax() :]
    return float(edges[lowest_counts.argmax() + (counts_above < counts_above.mean()).argmax()])


def _clusters(points: np.ndarray) -> np.ndarray:
    """points (n, 3) m, n >= 1 -> (n,) int, equal for points whose cells are connected, including by a corner."""
    cell = tuple(np.floor((points - points.min(0)) / _CELL).astype(int).T)
    is_filled = np.zeros([index.max() + 1 for index in cell], bool)
    is_filled[cell] = True
    return ndimage.label(is_filled, np.ones((3, 3, 3)))[0][cell]
