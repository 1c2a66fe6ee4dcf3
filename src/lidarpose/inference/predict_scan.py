"""`predict`: poses of the people in a file or an array. Steps for one scan: read, detect, load the network, pose."""

import inspect
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from lidarpose.errors import InputError
from lidarpose.geometry import UP_AXES, rotation_from_up, up_text
from lidarpose.inference.checks import scan_unit_warning
from lidarpose.inference.detection import DetectedScan, Search, search_options, verify_people
from lidarpose.inference.inputs import as_origin
from lidarpose.inference.known_places import KnownPlaces
from lidarpose.inference.pose_scan import pose_scan
from lidarpose.inference.predictor import Predictor, load
from lidarpose.inference.results import Poses
from lidarpose.inference.scan import Scan, read_scan
from lidarpose.inference.single_scan import search_alone
from lidarpose.io.boxes import Boxes, read_boxes
from lidarpose.io.files import read_bytes
from lidarpose.models import BUNDLED, DEFAULT
from lidarpose.sample import Box
from lidarpose.skeleton import Skeleton

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

# an input smaller than this is treated as a crop of one person, m
CROP_SIZE = 4.0
# a smaller one with more points is a whole scan if the unit seems wrong
_MANY_POINTS = 5000
# the options of `predict` that choose detection
_SEARCH_OPTIONS = "min_score, max_range (--range), max_people and background"
# maximum difference of equal up directions, as unit vectors: `detect` rounds them to three decimals
_SAME_UP = 2e-3
# maximum difference of up directions along the same axis: 45 degrees, the limit for tilted scans
SAME_AXIS = 0.77


def predict(
    path: "str | os.PathLike | ArrayLike",
    *,
    boxes: "str | os.PathLike | dict | Box | list | tuple | np.ndarray | Poses | None" = None,
    calib: str | os.PathLike | None = None,
    crop: bool = False,
    find: bool | None = None,
    min_score: float | None = None,
    max_range: float | None = None,
    max_people: int | None = None,
    background: "str | os.PathLike | Sequence | np.ndarray | None" = None,
    sensor_origin: "np.ndarray | Sequence[float] | str | None" = None,
    skeleton: str | Skeleton | None = None,
    up: str | Sequence[float] | None = None,
    columns: int | None = None,
    point_times: "ArrayLike | None" = None,
    model: "Predictor | str | os.PathLike | Callable[[], Predictor]" = DEFAULT,
    progress: bool = False,
) -> Poses:
    """Predicts the poses of all people in a point file or an array, in the coordinate frame of the input.

    People come from `boxes`, from detection (`find`), or the input is a crop of one person (`crop`). If none of these
    is given, people are detected if an option of detection is given, or if the input is at least 4 m across or looks
    like a whole scan in kilometers. Any other input is treated as a crop.

    Args:
        path: path of a point file, or points (n, 3+) m in any frame.
        boxes: boxes of the people in the input: anything that `read_boxes` takes, such as a JSON file, a KITTI label,
            rows, or one or several `Box`. Height and yaw refer to the up axis, or to the axis nearest to it if `up` is
            a direction; length and width are horizontal.
        calib: calibration file of a KITTI label. None means `../calib/N.txt` relative to the label.
        crop: whether the input is a crop of one person.
        find: whether to detect people, regardless of the size of the input. None means as above.
        min_score: score threshold of detection, see `detect`. This and the following three options are for detection
            only: they are rejected with `boxes`, `crop` or `find=False`.
        max_range: maximum horizontal distance of detected people from the sensor, m. None means 40.
        max_people: maximum number of detected people, see `detect`.
        background: static background that is not searched, see `detect`.
        sensor_origin: (x, y, z) m, the sensor position in the frame of the input, or "unknown". None means unknown for
            a crop and 0, 0, 0 otherwise.
        skeleton: skeleton of the result, or its name. None means smpl24, or the network's own skeleton if the network
            lacks joints of smpl24.
        up: up axis of the input: "z", "y" or "x", with a minus sign if it points down ("-y" for cameras); or, for a
            tilted sensor, the up direction (x, y, z) or "x,y,z" in the frame of the input. None means the up axis
            stated by `boxes`, as `detect` and `predict` write it, otherwise z, or, if the ground leans, the direction
            in which it does. A given z or direction is exact.
        columns: number of values per row of a .bin file.
        point_times: (n,) s from any zero, when each point of an array was measured. A file's own are read from its
            columns, see "Times of points" in docs/use.md. If the points are of several scans, people are searched for
            in the newest and their poses are those of that time; without times they are blurred by motion. This needs
            the sensor position. The paper's networks do not use times.
        model: a `Predictor`; or the name or path of weights, loaded with the default settings of `load`; or a function
            without arguments that returns a `Predictor`, called when it is needed. Bundled networks are loaded once and
            cached; files are loaded in each call, since they may have changed.
        progress: whether to show a progress bar.

    Returns:
        `Poses` of the people in the order of the boxes; detected people have the order of their scores, highest first.
        It is empty if no people are detected. An array without points is not an error; its result has no poses.

    Raises:
        InputError: input that cannot be read or options that exclude each other; the message says what to do.
    """
    options = (min_score, max_range, max_people, background)
    is_searched = any(option is not None for option in options)
    check_choice(boxes, crop, find or is_searched, calib, find=find)
    start = time.perf_counter()
    input_boxes = None if boxes is None else read_boxes(boxes, calib=calib)
    given_up = up
    if up is None:
        up = "z" if input_boxes is None else input_boxes.up
    rotation_from_up(up)
    if input_boxes is not None:
        # boxes of a tilted scan state its up direction, which may differ from the given axis
        check_up(input_boxes, up, most=SAME_AXIS)
    scan = Scan(points=np.zeros((0, 3)), boxes=input_boxes, origin=as_origin(sensor_origin), up=up_text(up))
    scan = read_scan(scan, path, columns, point_times)
    if find is None:
        find = is_searched or boxes is None and not crop and (not len(scan.points) or is_whole(scan))
    if sensor_origin is None and (find or boxes is not None):
        scan = replace(scan, origin=np.zeros(3))
    read_end = time.perf_counter()
    search = search_options(*options, columns, up=given_up)
    # the network is loaded only after the input has been read
    _, poses = predict_scan(
        scan, lambda: predictor_of(model), search=search if find else None, skeleton=skeleton, progress=progress
    )
    return replace(poses, timing_ms={"read": (read_end - start) * 1e3} | poses.timing_ms)


def predictor_of(model: "Predictor | str | os.PathLike | Callable[[], Predictor]") -> "Predictor":
    """The predictor for the argument `model` of `predict`. Raises InputError for an unsupported argument."""
    if isinstance(model, str) and model in BUNDLED:
        return _bundled(model)
    predictor: object = model
    if isinstance(model, str | os.PathLike):
        predictor = load(model)
    # torch modules are callable too: reject them
    elif callable(model) and not hasattr(model, "forward") and _needs_nothing(model):
        predictor = model()
    if not isinstance(predictor, Predictor):
        raise InputError(
            "model: expected a predictor, weights by name or path, or a function without arguments that returns "
            f"a predictor, got {type(predictor).__name__}: make one with lidarpose.load"
        )
    return predictor


_bundled = lru_cache(maxsize=len(BUNDLED))(load)


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
    """Processes one scan: detects people if `search` is given, otherwise uses the boxes or the crop of the scan; then
    predicts all poses.

    Args:
        scan: a scan, or a frame of a recording with detections that are not yet verified.
        model: returns the network; called after the search.
        search: settings of the search; None for a scan with boxes or a crop.
        known: people and rejected positions from earlier frames, see `verify_people`.
        skeleton: skeleton of the result.
        progress: whether to show a progress bar.

    Returns:
        The scan with the results of the search, and the poses, whose `timing_ms` has "find", "load", "crop" and
        "predict".
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


def is_whole(scan: Scan) -> bool:
    """Whether the scan is larger than a crop of one person, or has more points and is too small in meters."""
    # do not rotate a map of 10^8 points unless needed
    upright_points = scan.points if scan.up in UP_AXES else scan.clouds()[0]
    if np.ptp(upright_points, axis=0).max() >= CROP_SIZE:
        return True
    return len(upright_points) > _MANY_POINTS and scan_unit_warning(upright_points, len(upright_points)) is not None


def check_up(boxes: Boxes, up: str | Sequence[float], *, most: float = _SAME_UP) -> None:
    """Raises InputError if the up axis stated by boxes differs from the given one. most: maximum difference of the
    directions, as unit vectors."""
    difference = rotation_from_up(boxes.up)[2] - rotation_from_up(up)[2]
    # boxes along z may belong to a tilted scan
    most = SAME_AXIS if boxes.up == "z" else most
    if boxes.has_up and np.linalg.norm(difference) > most:
        raise InputError(f"the up axis of the boxes is {boxes.up}, not {up_text(up)}: give --up {boxes.up}")


def check_choice(boxes: object, crop: bool, searched: bool, calib: Any, *, find: bool | None = None) -> None:
    """Raises InputError if more than one of boxes, crop and search is given, a calibration without boxes, or options of
    the search with find=False."""
    if calib is not None and boxes is None:
        raise InputError("calib is for boxes from a KITTI label: expected boxes too, got none: give the label")
    if calib is not None:
        # also if the boxes do not need it
        read_bytes(calib, expected="KITTI's calibration")
    if boxes is not None and crop:
        raise InputError("expected boxes or a crop, got both: a crop contains one person, so omit the boxes")
    if searched and (boxes is not None or crop):
        raise InputError(f"find, {_SEARCH_OPTIONS} are options of the detection: omit them with boxes or a crop")
    if find is False and searched:
        raise InputError(f"{_SEARCH_OPTIONS} are options of the detection: omit them with find=False")
