"""`predict` for files: a sweep with boxes, or a crop of one person."""

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from lidarpose.errors import InputError
from lidarpose.geometry import UP_AXES, rotation_from_up
from lidarpose.inference.inputs import as_origin, flat_axis, lies, only_returns, unit_warning
from lidarpose.inference.predictor import Predictor, load
from lidarpose.inference.results import PersonPose, Poses
from lidarpose.io.boxes import read_boxes
from lidarpose.io.files import file_error
from lidarpose.io.point_cloud import Cloud, read_points
from lidarpose.models.bundled import DEFAULT
from lidarpose.sample import FARTHEST, MIN_POINTS, Box

# a file of less than this across is taken for a crop, m
CROP_SIZE = 4.0
# looks at each person of a file, where nobody says how many: nobody waits for milliseconds here
TTA = 4
# no LiDAR sees a person from farther away, m
_FARTHEST_PERSON = 500.0
# boxes so much less tall than wide have their sizes in another order
_TALL_TO_WIDE = 0.8
# heights above a box's center, in its own height: the ground, and of who stands on the center the chest and the top; at
# most this share of the points is elsewhere, and so few tell nothing
_GROUND, _CHEST, _TOP = -0.1, 0.75, 1.1
_ELSEWHERE, _FEWEST = 0.05, 20


def predict(
    path: str | os.PathLike,
    *,
    boxes: str | os.PathLike | dict | Box | Sequence[Box | dict] | None = None,
    crop: bool = False,
    sensor_origin: tuple[float, float, float] | str | None = None,
    skeleton: str | None = None,
    up: str | Sequence[float] = "z",
    columns: int | None = None,
    model: Predictor | str | os.PathLike | Callable[[], Predictor] = DEFAULT,
    progress: bool = False,
) -> Poses:
    """Poses of the people in a point file, in the file's own frame.

    boxes: a JSON file, its content (see `io.boxes`), a `Box` or several, their length and width level, their height and
    yaw along and about the up axis (the file's z where `up` is a direction); crop: the file is one person already. With
    neither, a file of less than 4 m across is taken as a crop and anything else asks for boxes. sensor_origin:
    (x, y, z) m in the file's frame, or "unknown"; None means 0, 0, 0 with boxes and unknown for a crop. skeleton: a
    name, or None for smpl24, or for the network's own where it has other joints. up: the file's up axis, "z", "y" or
    "x", with a minus where it points down ("-y": cameras), or for a sensor mounted askew the direction that is up,
    (x, y, z) or "x,y,z" in the file's frame. columns: values a row of a .bin; model: a predictor, what `load` takes
    (each person is then looked at `TTA` times), or a function that gives the predictor when it is needed. Raises
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
    R_house_input = rotation_from_up(up)
    up = up if isinstance(up, str) else ",".join(repr(float(value)) for value in up)
    # boxes stand along the file's own axis
    R_boxes_input = UP_AXES.get(up, UP_AXES["z"])
    origin = np.zeros(3) if sensor_origin is None and boxes is not None else as_origin(sensor_origin)
    found = None if boxes is None else _boxes(boxes)
    cloud = _only_returns(path, read_points(path, columns=columns))
    read = time.perf_counter()
    points = cloud.points @ R_house_input.T
    if found is None:
        if not crop:
            _check_crop_size(path, points)
        clouds = [points]
    else:
        housed, within = (
            [replace(box, center=R_boxes_input @ box.center) for box in found],
            cloud.points @ R_boxes_input.T,
        )
        inside = _inside(housed, within)
        clouds = [points[rows] for rows in inside]
    warnings = list(cloud.warnings)
    if origin is not None and found and (warning := _origin_warning(origin, found)):
        warnings.append(warning)
        origin = None
    # loaded once the input has proved readable
    predictor = model if isinstance(model, Predictor) else model() if callable(model) else load(model, tta=TTA)
    loaded = time.perf_counter()
    raw = predictor.predict(
        clouds, sensor_origin=None if origin is None else R_house_input @ origin, skeleton=skeleton, progress=progress
    )
    done = time.perf_counter()
    cut_short = []
    if found:
        warnings += _box_warnings(raw, found, cloud)
        cut_short = list(filter(None, (_wide_warning(found), _foot_warning(housed, within, inside))))
        warnings += cut_short
    # who is cut short only seems to lie
    lying = None if cut_short else _lying_warning(raw, up, R_house_input)
    if warning := _flat_warning(cloud, up, R_house_input) or lying:
        warnings.append(warning)
    people = [_in_input(person, R_house_input, up) for person in raw]
    if found is None:
        # a crop's warnings are its person's
        people = [replace(people[0], id=0, warnings=(*cloud.warnings, *people[0].warnings))]
        warnings = warnings[len(cloud.warnings) :]
    else:
        people = [
            replace(person, id=i if box.id is None else box.id, box=box)
            for i, (person, box) in enumerate(zip(people, found, strict=True))
        ]
    seen = sum(person.pose is not None for person in people)
    return Poses(
        people=tuple(people),
        skeleton=raw.skeleton,
        source=os.fsdecode(path),
        model=raw.model,
        warnings=tuple(warnings),
        timing_ms={
            "read": (read - started) * 1e3,
            "load": (loaded - read) * 1e3,
            "predict": (done - loaded) * 1e3,
            "per_person": (done - loaded) * 1e3 / max(seen, 1),
        },
        up=up,
    )


def _boxes(given: object) -> list[Box]:
    if isinstance(given, Box):
        return [given]
    if isinstance(given, tuple):
        given = list(given)
    if isinstance(given, list) and any(isinstance(box, Box) for box in given):
        return [box if isinstance(box, Box) else read_boxes([box])[0] for box in given]
    return read_boxes(given)


def _inside(boxes: list[Box], points: np.ndarray) -> list[np.ndarray]:
    """points (n, 3) m, z up -> of each box the rows (k,) of the points in it, ascending.

    Sorted along x once, so that no box has to look at all of millions of points.
    """
    order = np.argsort(points[:, 0])
    x = points[order, 0]
    found = []
    for box in boxes:
        # twice what a corner reaches, whatever the yaw
        reach = np.hypot(*box.size[:2])
        first, last = np.searchsorted(x, (box.center[0] - reach, box.center[0] + reach))
        near = np.sort(order[first:last])
        found.append(near[box.contains(points[near])])
    return found


def _only_returns(path: object, cloud: Cloud) -> Cloud:
    points, notes = only_returns(cloud.points)
    if not len(points):
        found = f"none within {FARTHEST:g} m" if cloud.points.any() else "only 0,0,0, which are no returns"
        raise file_error(path, f"expected points in metres, got {found}: export it again")
    dropped = len(cloud.points) - len(points)
    return replace(cloud, points=points, num_dropped=cloud.num_dropped + dropped, warnings=(*cloud.warnings, *notes))


def _check_crop_size(path: object, points: np.ndarray) -> None:
    """Raises InputError for a file, z up, that is too large for one person."""
    size = np.ptp(points, axis=0)
    if size.max() < CROP_SIZE:
        return
    unit = unit_warning(size, what="it")
    raise InputError(
        f"{os.fsdecode(path)}: expected one person, less than {CROP_SIZE:.0f} m across, got {size.max():,.1f} m: "
        "give the people's boxes (--boxes BOXES.json), or say that it is a crop all the same (--crop)"
        + (f"; {unit}" if unit else "")
    )


def _origin_warning(origin: np.ndarray, boxes: list[Box]) -> str | None:
    distance = float(np.median([np.linalg.norm(box.center - origin) for box in boxes]))
    if distance < _FARTHEST_PERSON:
        return None
    at = ",".join(f"{value:g}" for value in origin)
    return (
        f"the sensor at {at} is {distance:,.0f} m from the people, so its place is taken as unknown: "
        "give it in the file's own frame and in metres (--sensor-origin)"
    )


def _box_warnings(people: Poses, boxes: list[Box], cloud: Cloud) -> list[str]:
    """What is likely wrong with units or frames, judged by all boxes together."""
    warnings = []
    if warning := unit_warning(np.median([box.size for box in boxes], axis=0), what="a person's box"):
        warnings.append(warning)
    if all(person.num_points < MIN_POINTS for person in people):
        low, high = cloud.points.min(0), cloud.points.max(0)
        centers = np.array([box.center for box in boxes])
        warnings.append(
            f"no box holds {MIN_POINTS} points: expected boxes and points in one frame and in metres; points reach "
            f"from {_place(low)} to {_place(high)}, centers of boxes from {_place(centers.min(0))} to "
            f"{_place(centers.max(0))}"
        )
    return warnings


def _wide_warning(boxes: list[Box]) -> str | None:
    wide = np.median([box.size[:2].max() for box in boxes])
    tall = np.median([box.size[2] for box in boxes])
    if tall >= _TALL_TO_WIDE * wide:
        return None
    return f"boxes are wider ({wide:.1f} m) than tall ({tall:.1f} m): size is length, width, height"


def _foot_warning(boxes: list[Box], points: np.ndarray, inside: list[np.ndarray]) -> str | None:
    """What is likely wrong where people begin at the centers of their boxes. points (n, 3) m, z up; inside: the rows
    that each box holds."""
    heights = _heights(boxes, points, inside)
    if (heights < _GROUND).sum() > _ELSEWHERE * len(heights):
        return None
    upon = [replace(box, center=box.center + [0, 0, box.size[2]]) for box in boxes]
    above = 1 + _heights(upon, points, _inside(upon, points))
    # a ceiling leaves room above the box, a tree goes on above the head
    trunk, sky = (above < _CHEST).sum(), (above > _TOP).sum()
    if trunk < max(_FEWEST, len(heights) / 4) or sky > _ELSEWHERE * len(above):
        return None
    return "people stand in the upper half of their boxes and above: is center at the feet? add half the height"


def _heights(boxes: list[Box], points: np.ndarray, inside: list[np.ndarray]) -> np.ndarray:
    """(k,): how high above the centers of their boxes, in those boxes' heights, points lie."""
    return np.concatenate(
        [(points[rows, 2] - box.center[2]) / box.size[2] for box, rows in zip(boxes, inside, strict=True)]
    )


def _place(point: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.1f}" for value in point) + ")"


def _flat_warning(cloud: Cloud, up: str, R_house_input: np.ndarray) -> str | None:
    flat = flat_axis(cloud.points)
    if flat is None or flat == _axis(R_house_input):
        return None
    return f"the points extend least along {flat}, so {up} is hardly the input's up axis: try {_option(flat)}"


def _lying_warning(people: Poses, up: str, R_house_input: np.ndarray) -> str | None:
    """`people` in the house's frame, into which R_house_input turns by `up`."""
    found = [person for person in people if person.pose is not None]
    if not found or not all(lies(person.pose, person.points) for person in found):
        return None
    others = ", or ".join(_option(other) for other in "zyx" if other != _axis(R_house_input))
    who = "the person lies" if len(found) == 1 else f"all {len(found)} people lie"
    return f"{who} down: if that is wrong, {up} is not the input's up axis: try {others}"


def _axis(R_house_input: np.ndarray) -> str:
    """The input's axis that is nearest to upright."""
    return "xyz"[int(np.abs(R_house_input[2]).argmax())]


def _option(axis: str) -> str:
    return "--up y, or --up -y where y points down (cameras)" if axis == "y" else f"--up {axis}"


def _in_input(person: PersonPose, R_house_input: np.ndarray, up: str) -> PersonPose:
    pose = person.pose and replace(person.pose, joints=person.pose.joints @ R_house_input)
    return replace(person, pose=pose, points=person.points @ R_house_input, up=up)
