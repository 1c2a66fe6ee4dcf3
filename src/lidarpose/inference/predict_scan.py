"""`predict`: the people of a file or an array. The steps of one scan: read, search, load, pose."""

import inspect
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from lidarpose.errors import InputError
from lidarpose.geometry import UP_AXES, rotation_from_up, up_text
from lidarpose.inference.detection import DetectedScan, Search, search_alone, search_options, verify_people
from lidarpose.inference.inputs import as_origin
from lidarpose.inference.known_places import KnownPlaces
from lidarpose.inference.predictor import Predictor, load
from lidarpose.inference.results import Poses
from lidarpose.inference.scan import Scan, pose_scan, read_scan
from lidarpose.io.boxes import Boxes, read_boxes
from lidarpose.models import BUNDLED, DEFAULT
from lidarpose.sample import Box
from lidarpose.skeleton import Skeleton

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

# a file of less than this across is taken for a crop, m
CROP_SIZE = 4.0
# of directions that are up: `detect` states them to three decimals
_SAME_UP = 2e-3
# and of the same axis, as far as scans are leveled: 45 degrees
_SAME_AXIS = 0.77


def predict(
    path: "str | os.PathLike | ArrayLike",
    *,
    boxes: "str | os.PathLike | dict | Box | list | tuple | np.ndarray | Poses | None" = None,
    calib: str | os.PathLike | None = None,
    crop: bool = False,
    find: bool = False,
    min_score: float | None = None,
    max_range: float | None = None,
    max_people: int | None = None,
    background: "str | os.PathLike | Sequence | np.ndarray | None" = None,
    sensor_origin: "np.ndarray | Sequence[float] | str | None" = None,
    skeleton: str | Skeleton | None = None,
    up: str | Sequence[float] | None = None,
    columns: int | None = None,
    model: "Predictor | str | os.PathLike | Callable[[], Predictor]" = DEFAULT,
    progress: bool = False,
) -> Poses:
    """Poses of the people in a point file or in an array, in its own frame.

    Args:
        path: a point file, or the points themselves, (n, 3+) m in any frame; "the file" below is either.
        boxes: whatever `read_boxes` takes (a JSON file, a KITTI label, rows, a `Box` or several), their length and
            width level, their height and yaw along and about the up axis, or the axis nearest to a direction `up`.
        calib: of a KITTI label, None for `../calib/N.txt` beside it.
        crop: the file is one person already.
        find: people are searched for, with min_score, max_range (None: 40 m), max_people and background as in `detect`.
            Without boxes, crop and find a file of less than 4 m across is taken as a crop, any other is searched.
        sensor_origin: (x, y, z) m in the file's frame, or "unknown"; None means unknown for a crop and 0, 0, 0 else.
        skeleton: one, or its name; None for smpl24, or for the network's own where it has other joints.
        up: the file's up axis, "z", "y" or "x", with a minus where it points down ("-y": cameras), or for a sensor
            mounted askew the direction that is up, (x, y, z) or "x,y,z" in the file's frame. None: as `detect` and
            `predict` wrote into a file of boxes, else z.
        columns: values a row of a .bin.
        model: a predictor, what `load` takes (with its defaults), or a function that gives the predictor when needed.
            Bundled networks are loaded once and kept by name; a file is loaded anew, since it may have changed.

    Raises:
        InputError: one line that says what to do. An array without points is no error: nobody is in it.
    """
    options = (min_score, max_range, max_people, background)
    check_choice(boxes, crop, find or any(option is not None for option in options), calib)
    start = time.perf_counter()
    input_boxes = None if boxes is None else read_boxes(boxes, calib=calib)
    if up is None:
        up = "z" if input_boxes is None else input_boxes.up
    rotation_from_up(up)
    if input_boxes is not None:
        # of a tilted scan boxes say how it was leveled, which is still the same axis
        check_up(input_boxes, up, most=_SAME_AXIS)
    scan = Scan(points=np.zeros((0, 3)), boxes=input_boxes, origin=as_origin(sensor_origin), up=up_text(up))
    scan = read_scan(scan, path, columns)
    find = find or boxes is None and not crop and (not len(scan.points) or is_wide(scan))
    if not find and any(option is not None for option in options):
        note = f"taken as one person, since under {CROP_SIZE:g} m across, and not searched: find looks for people"
        scan = replace(scan, warnings=(*scan.warnings, note))
    if sensor_origin is None and (find or boxes is not None):
        scan = replace(scan, origin=np.zeros(3))
    read_end = time.perf_counter()
    search = search_options(*options, columns)
    # loaded once the input has proved readable
    _, poses = predict_scan(
        scan, lambda: predictor_of(model), search=search if find else None, skeleton=skeleton, progress=progress
    )
    return replace(poses, timing_ms={"read": (read_end - start) * 1e3} | poses.timing_ms)


def predictor_of(model: "Predictor | str | os.PathLike | Callable[[], Predictor]") -> "Predictor":
    """What `predict` takes as its model, ready to use. Raises InputError for anything else."""
    if isinstance(model, str) and model in BUNDLED:
        return _bundled(model)
    predictor: object = model
    if isinstance(model, str | os.PathLike):
        predictor = load(model)
    # a network of torch can be called too
    elif callable(model) and not hasattr(model, "forward") and _needs_nothing(model):
        predictor = model()
    if not isinstance(predictor, Predictor):
        raise InputError(
            "model: expected a predictor, weights by name or path, or a function without arguments that gives a "
            f"predictor, got {type(predictor).__name__}: make one by lidarpose.load"
        )
    return predictor


@lru_cache(maxsize=len(BUNDLED))
def _bundled(name: str) -> Predictor:
    return load(name)


def _needs_nothing(function: Callable) -> bool:
    try:
        inspect.signature(function).bind()
    except TypeError:
        return False
    return True


def predict_scan(
    scan: "Scan | DetectedScan",
    model: "Callable[[], Predictor]",
    *,
    search: "Search | None" = None,
    known: "KnownPlaces | None" = None,
    skeleton: str | Skeleton | None = None,
    progress: bool = False,
) -> tuple[Scan, Poses]:
    """The steps of one scan: people are searched for where `search` is given, else they are the scan's boxes or its
    crop; then everybody is posed.

    Args:
        scan: or a frame of a recording in which people were detected already.
        model: loads the network, once people were searched for.
        known: as of `find_people`.

    Returns:
        The scan as it was searched, and the poses, whose `timing_ms` has "find", "load", "crop" and "predict".
    """
    start = time.perf_counter()
    times = {}
    if search is not None:
        scan = search_alone(scan, search) if isinstance(scan, Scan) else verify_people(scan, search, known)
        times["find"] = time.perf_counter() - start
    assert isinstance(scan, Scan)
    search_end = time.perf_counter()
    predictor = model()
    times["load"] = time.perf_counter() - search_end
    poses = pose_scan(scan, predictor, skeleton=skeleton, progress=progress)
    return scan, replace(poses, timing_ms={name: seconds * 1e3 for name, seconds in times.items()} | poses.timing_ms)


def is_wide(scan: Scan) -> bool:
    """Whether the scan is larger than a crop of one person."""
    # a map of 10^8 points is not turned for nothing
    upright_points = scan.points if scan.up in UP_AXES else scan.clouds()[0]
    return bool(np.ptp(upright_points, axis=0).max() >= CROP_SIZE)


def check_up(boxes: Boxes, up: str | Sequence[float], *, most: float = _SAME_UP) -> None:
    """Raises InputError where boxes say that something else is up than was given. most: how far both directions may be
    apart, as unit vectors."""
    difference = rotation_from_up(boxes.up)[2] - rotation_from_up(up)[2]
    if boxes.up != "z" and np.linalg.norm(difference) > most:
        raise InputError(f"the boxes say that up is {boxes.up}, not {up_text(up)}: give up {boxes.up}")


def check_choice(boxes: object, crop: bool, searched: bool, calib: object) -> None:
    """Raises InputError where it is said in two ways who is in the file, and for a calibration of no boxes."""
    if calib is not None and boxes is None:
        raise InputError("calib is for boxes that are a KITTI label: expected boxes too, got none: name the label")
    if boxes is not None and crop:
        raise InputError("expected boxes or a crop, got both: a crop is one person already, so leave the boxes away")
    if searched and (boxes is not None or crop):
        options = "find, min score, range, max people and background"
        raise InputError(f"{options} are for people who are searched for: leave them away with boxes or a crop")
