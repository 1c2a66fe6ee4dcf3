"""`predict` for files: a sweep with boxes, or a crop of one person."""

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from lidarpose.errors import InputError
from lidarpose.geometry import rotation_from_up
from lidarpose.inference.inputs import as_origin, only_returns, unit_warning
from lidarpose.inference.predictor import Predictor, load
from lidarpose.inference.results import Poses
from lidarpose.inference.scan import Scan, pose_scan
from lidarpose.io.boxes import read_boxes
from lidarpose.io.files import file_error
from lidarpose.io.point_cloud import Cloud, read_points
from lidarpose.models import DEFAULT
from lidarpose.sample import FARTHEST, Box

# a file of less than this across is taken for a crop, m
CROP_SIZE = 4.0


def predict(
    path: str | os.PathLike,
    *,
    boxes: str | os.PathLike | dict | Box | list | tuple | np.ndarray | None = None,
    crop: bool = False,
    sensor_origin: tuple[float, float, float] | str | None = None,
    skeleton: str | None = None,
    up: str | Sequence[float] = "z",
    columns: int | None = None,
    model: Predictor | str | os.PathLike | Callable[[], Predictor] = DEFAULT,
    progress: bool = False,
) -> Poses:
    """Poses of the people in a point file, in the file's own frame.

    boxes: whatever `read_boxes` takes (a JSON file, a KITTI label, rows, a `Box` or several), their length and width
    level, their height and yaw along and about the up axis (the file's z where `up` is a direction); crop: the file is
    one person already. With
    neither, a file of less than 4 m across is taken as a crop and anything else asks for boxes. sensor_origin:
    (x, y, z) m in the file's frame, or "unknown"; None means 0, 0, 0 with boxes and unknown for a crop. skeleton: a
    name, or None for smpl24, or for the network's own where it has other joints. up: the file's up axis, "z", "y" or
    "x", with a minus where it points down ("-y": cameras), or for a sensor mounted askew the direction that is up,
    (x, y, z) or "x,y,z" in the file's frame. columns: values a row of a .bin; model: a predictor, what `load` takes
    (with its defaults), or a function that gives the predictor when it is needed. Raises
    InputError, one line that says what to do.
    """
    if boxes is not None and crop:
        raise InputError("expected boxes or a crop, got both: a crop is one person already, so leave the boxes away")
    if not isinstance(path, str | os.PathLike):
        kind = type(path).__name__
        raise InputError(
            f"expected the path of a point file, got {kind}: for points use lidarpose.load().predict(points)"
        )
    started = time.perf_counter()
    rotation_from_up(up)
    scan = Scan(
        points=np.zeros((0, 3)),
        boxes=None if boxes is None else read_boxes(boxes),
        origin=np.zeros(3) if sensor_origin is None and boxes is not None else as_origin(sensor_origin),
        up=up if isinstance(up, str) else ",".join(repr(float(value)) for value in up),
        source=os.fsdecode(path),
    )
    cloud = _only_returns(path, read_points(path, columns=columns))
    scan = replace(scan, points=cloud.points, warnings=tuple(cloud.warnings))
    if scan.boxes is None and not crop:
        _check_crop_size(path, scan.clouds()[0])
    read = time.perf_counter()
    # loaded once the input has proved readable
    predictor = model if isinstance(model, Predictor) else model() if callable(model) else load(model)
    loaded = time.perf_counter()
    poses = pose_scan(scan, predictor, skeleton=skeleton, progress=progress)
    timing = {"read": (read - started) * 1e3, "load": (loaded - read) * 1e3}
    return replace(poses, timing_ms=timing | poses.timing_ms)


def _only_returns(path: str | os.PathLike, cloud: Cloud) -> Cloud:
    points, notes = only_returns(cloud.points)
    if not len(points):
        problem = f"none within {FARTHEST:g} m" if cloud.points.any() else "only 0,0,0, which are no returns"
        raise file_error(path, f"expected points in metres, got {problem}: export it again")
    dropped = len(cloud.points) - len(points)
    return replace(cloud, points=points, num_dropped=cloud.num_dropped + dropped, warnings=(*cloud.warnings, *notes))


def _check_crop_size(path: str | os.PathLike, points: np.ndarray) -> None:
    """Raises InputError for a file, z up, that is too large for one person."""
    size = np.ptp(points, axis=0)
    if size.max() < CROP_SIZE:
        return
    unit = unit_warning(size, what="it")
    raise InputError(
        f"{os.fsdecode(path)}: expected one person, less than {CROP_SIZE:.0f} m across, got {size.max():,.1f} m: "
        "give the people's boxes, or say that it is a crop all the same" + (f"; {unit}" if unit else "")
    )
