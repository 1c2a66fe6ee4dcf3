"""`predict` for files: a sweep with boxes, or a crop of one person."""

import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from lidarpose.data.boxes import read_boxes
from lidarpose.data.formats import Cloud, read_points
from lidarpose.errors import InputError
from lidarpose.geometry import rotation_from_up
from lidarpose.infer.people import lies, unit_warning
from lidarpose.infer.predictor import Predictor, load
from lidarpose.infer.results import PersonPose, Poses
from lidarpose.sample import Box, Pose

# a file of less than this across is taken for a crop, m
CROP_SIZE = 4.0


def predict(
    path: str | os.PathLike,
    *,
    boxes: str | os.PathLike | dict | list | None = None,
    crop: bool = False,
    sensor_origin: tuple[float, float, float] | str | None = None,
    skeleton: str = "smpl24",
    up: str = "z",
    columns: int | None = None,
    model: Predictor | Callable[[], Predictor] = load,
    progress: bool = False,
) -> Poses:
    """Poses of the people in a point file, in the file's own frame.

    boxes: a JSON file or its content, see `data.boxes`; crop: the file is one person already. With neither, a file of
    less than 4 m across is taken as a crop and anything else asks for boxes. sensor_origin: (x, y, z) m in the file's
    frame, or "unknown"; None means 0, 0, 0 with boxes and unknown for a crop. up: the file's up axis; columns: values
    a row of a .bin; model: a predictor, or what makes one once the input has proved
    readable. Raises InputError, one line that says what to do.
    """
    if boxes is not None and crop:
        raise InputError("expected boxes or a crop, got both: a crop is one person already, so leave the boxes away")
    started = time.perf_counter()
    R_house_input = rotation_from_up(up)
    cloud = read_points(path, columns=columns)
    read = time.perf_counter()
    found = None if boxes is None else read_boxes(boxes)
    if found is None and not crop:
        _check_crop_size(path, cloud)
    origin = _origin(sensor_origin, known=found is not None)
    points = cloud.points @ R_house_input.T
    if found is None:
        clouds = [points]
    else:
        housed = [replace(box, center=R_house_input @ box.center) for box in found]
        clouds = [points[box.contains(points)] for box in housed]
    model = model if isinstance(model, Predictor) else model()
    loaded = time.perf_counter()
    raw = model.predict(
        clouds, sensor_origin=None if origin is None else R_house_input @ origin, skeleton=skeleton, progress=progress
    )
    done = time.perf_counter()
    people = [_in_input(person, R_house_input) for person in raw]
    people = [_named(person, i, found, cloud) for i, person in enumerate(people)]
    warnings = _input_warnings(raw, found, up) + (() if found is None else cloud.warnings)
    return Poses(
        people=tuple(people),
        skeleton=raw.skeleton,
        source=os.fspath(path) if isinstance(path, str) else str(Path(path)),
        model=raw.model,
        warnings=warnings,
        timing_ms={
            "read": (read - started) * 1e3,
            "load": (loaded - read) * 1e3,
            "predict": (done - loaded) * 1e3,
            "per_person": (done - loaded) * 1e3 / max(len(people), 1),
        },
    )


def _check_crop_size(path, cloud: Cloud) -> None:
    size = float(np.ptp(cloud.points, axis=0).max())
    if size < CROP_SIZE:
        return
    hint = f"; {unit}" if (unit := unit_warning(size, what="it")) and size < 5000 and len(cloud.points) < 20_000 else ""
    raise InputError(
        f"{path}: is {size:,.1f} m across, so more than one person; expected --boxes BOXES.json with the people in it, "
        f"or --crop if it is one person all the same{hint}"
    )


def _origin(given, *, known: bool) -> np.ndarray | None:
    """The sensor's place in the input's frame, None = unknown."""
    if given is None:
        return np.zeros(3) if known else None
    if isinstance(given, str):
        if given == "unknown":
            return None
        given = given.split(",")
    try:
        origin = np.array([float(value) for value in given])
    except (TypeError, ValueError):
        origin = np.zeros(0)
    if origin.shape != (3,) or not np.isfinite(origin).all():
        raise InputError(f"sensor origin: expected x,y,z in metres or unknown, got {','.join(map(str, given))!r}")
    return origin


def _in_input(person: PersonPose, R_house_input: np.ndarray) -> PersonPose:
    pose: Pose | None = person.pose
    if pose is not None:
        pose = replace(pose, joints=pose.joints @ R_house_input)
    return replace(person, pose=pose, points=person.points @ R_house_input)


def _named(person: PersonPose, index: int, boxes: list[Box] | None, cloud: Cloud) -> PersonPose:
    if boxes is None:
        return replace(person, id=index, warnings=(*cloud.warnings, *person.warnings))
    box = boxes[index]
    return replace(person, id=index if box.id is None else box.id, box=box)


def _input_warnings(people: Poses, boxes: list[Box] | None, up: str) -> tuple[str, ...]:
    """What is likely wrong with units or axes, judged by all people together. `people` in the house's frame."""
    warnings = []
    if boxes:
        tallest = float(np.median([box.size.max() for box in boxes]))
        if warning := unit_warning(tallest, what="a person's box"):
            warnings.append(warning)
    poses = [person.pose for person in people if person.pose is not None]
    if poses and all(map(lies, poses)):
        others = " or ".join(f"--up {axis}" for axis in "zyx" if axis != up)
        who = "the person lies" if len(poses) == 1 else f"all {len(poses)} people lie"
        warnings.append(f"{who} down: if that is wrong, {up} is not the input's up axis: try {others}")
    return tuple(warnings)
