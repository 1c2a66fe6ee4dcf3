"""What looks wrong about an input and its answers: independent checks, each a line for the user or None.

A check of boxes is a function of (`Scan`, `Poses` in the level frame), asked where there are boxes; to add one, write
it and append it to `SCAN_CHECKS`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from lidarpose.errors import first_names
from lidarpose.geometry import rows_near
from lidarpose.inference.results import Poses
from lidarpose.sample import MIN_POINTS, Box, Pose

if TYPE_CHECKING:
    from lidarpose.inference.scan import Scan

# bounds of what a person measures in other units, taken for meters
_LARGEST_IN_CENTIMETERS, _SMALLEST_IN_OTHER_UNITS, _LARGEST_IN_KILOMETERS = 500, 20, 0.02
# a person with the ground around is at most so many times as wide as tall
_WIDEST = 4
# no LiDAR sees a person from farther away, m
FARTHEST_PERSON = 500.0
# boxes so much less tall than wide have their sizes in another order
_TALL_TO_WIDE = 0.8
# heights above a box's center, in its own height: the ground, and the chest and the top of a person who stands on the
# center; at most this share of the points is elsewhere, and so few tell nothing
_GROUND, _CHEST, _TOP = -0.1, 0.75, 1.1
_ELSEWHERE, _FEWEST = 0.05, 20
# a network that is shown something of another size or upside down predicts a person of human size all the same, but
# expects larger errors, m: benchmarks/plausibility.py measures how often these bounds warn
_UNSURE, _UNSURE_OF_SIZE, _UNSURE_OF_GIANT = 0.08, 0.1, 0.05
# of fewer points it is unsure anyway
_FEWEST_UPSIDE_DOWN = 20
# nobody's points reach over so much height, m, percents of the highest and lowest points left out
_TALLEST, _GIANT, _TRIMMED = 2.2, 3.0, (3, 97)
# the spread of a pose upside down, as a share of that as given, from which on the input is upside down
_CLEARLY_SURER = 0.6
# a crop that is so far across is no crop of one person, m
_WIDEST_CROP = 20.0
# a crop shows nobody below, and two people above this probability
_NOBODY, _TWO = 0.05, 0.5
# a half turn about x
UPSIDE_DOWN = np.array([1.0, -1.0, -1.0])
# joints that every skeleton has
_TRUNK = ("left_shoulder", "right_shoulder", "left_hip", "right_hip")
# points of a whole person, less than so far across, that lies spread at least so far along, m, and so many times as far
# as upwards: so spread 97 of 100 synthetic people who were laid down, and none that stood
_TIGHT, _LONG, _LONG_TO_TALL = 2.0, 0.25, 1.5
# a sweep's extent leaves out the farthest percents, and so many points tell it; level, it is so long, m, and so many
# times what it is upright
_MOST, _ENOUGH, _STREET, _FLATTER = (10, 90), 25_000, 10.0, 3.0
# a scan that is so long and has so few points a square meter is in other units, and in millimeters from so far on; a
# whole room is larger than the smallest, m
_LONGEST_SCAN, _SPARSEST, _LONG_IN_MILLIMETERS, _SMALLEST_SCAN = 500.0, 0.1, 10_000.0, 0.5
# a sensor is not so far from the nearest point, m, along the ground and in space, as a drone's is; of the points so
# near, m, some percents lie lower than it by more
_FAR_OUT, _FAR_AWAY, _BELOW_SENSOR, _LOWEST, _LEAST_HEIGHT = 25.0, 60.0, 15.0, 5, 0.2


# ---- one person


def unit_warning(size: np.ndarray, *, what: str) -> str | None:
    """What is likely wrong where a person's extent `size` (3,), z up, is no person's in meters."""
    height, largest = float(size[2]), float(size.max())
    if 0 < largest < _LARGEST_IN_KILOMETERS:
        return f"{what} is {largest:.2g} m in size: are the units kilometers? multiply all coordinates by 1000"
    # a few returns may all lie at one height, and a whole street is large, but far wider than tall
    if height < _SMALLEST_IN_OTHER_UNITS or height < largest / _WIDEST:
        return None
    unit, factor = ("millimeters", 1000) if height > _LARGEST_IN_CENTIMETERS else ("centimeters", 100)
    return f"{what} is {height:,.0f} m tall: are the units {unit}? divide all coordinates by {factor}"


def oversize_warning(points: np.ndarray, pose: Pose) -> str | None:
    """A person's points are in other units than meters, or hold far more than a person.

    Args:
        points: (n, 3) m, z up, of the whole crop.
        pose: the person's.
    """
    width = float(np.ptp(points[:, :2], axis=0).max())
    if width > _WIDEST_CROP:
        return (
            f"the points reach over {width:,.0f} m, and one person was looked for near their middle: expected a crop "
            "of one person: give the people's boxes, or crop closer"
        )
    low, high = np.percentile(points[:, 2], _TRIMMED)
    bound = _UNSURE_OF_SIZE if high - low < _GIANT else _UNSURE_OF_GIANT
    if high - low < _TALLEST or pose.spread is None or pose.spread.mean() < bound:
        return None
    return (
        f"the points are {high - low:.1f} m tall, taller than a person: expected meters, perhaps they are in feet or "
        "another unit, or the crop holds more than a person"
    )


def person_count_warning(pose: Pose, *, in_box: bool = False, is_scored: bool = False) -> str | None:
    """The points show nobody, or more people than the one whose pose it is.

    in_box: a box says who is meant; is_scored: and by its score whether somebody is there.
    """
    if not is_scored and pose.person is not None and pose.person < _NOBODY:
        return f"the points look unlike a person (person {float(pose.person):.2f}): perhaps nobody is there"
    if pose.second_person is not None and pose.second_person > _TWO:
        if in_box:
            return "the points look like two people: the pose is of the one nearer to the center of the box"
        return "the points look like two people, and the pose is of one of them: a box about somebody says who is meant"
    return None


def looks_unsure(pose: Pose, points: np.ndarray) -> bool:
    """Whether it is worth looking at the person, of points (n, 3), upside down too."""
    return len(points) >= _FEWEST_UPSIDE_DOWN and pose.spread is not None and bool(pose.spread.mean() > _UNSURE)


def upside_down_warning(pose: Pose, turned: Pose | None) -> str | None:
    """The pose is far less certain than the pose of the points turned upside down."""
    if turned is None or pose.spread is None or turned.spread is None:
        return None
    if turned.spread.mean() > _CLEARLY_SURER * pose.spread.mean():
        return None
    return "upside down the person is found with more certainty: does the up axis point down? try up -z"


def is_lying(pose: Pose, points: np.ndarray) -> bool:
    """The trunk of a pose, z up, is nearer to level than to upright, or its points (n, 3) m are.

    A network that has seen few people lie draws a person standing in points that lie.
    """
    if len(points) and (np.ptp(points[:, :2], axis=0) < _TIGHT).all():
        spread = points.std(0)
        if spread[:2].max() > max(_LONG, _LONG_TO_TALL * spread[2]):
            return True
    joints = {name: pose.joints[pose.skeleton.index(name)] for name in _TRUNK}
    trunk = joints["left_shoulder"] + joints["right_shoulder"] - joints["left_hip"] - joints["right_hip"]
    return bool(abs(trunk[2]) < np.sin(np.radians(35)) * np.linalg.norm(trunk))


# ---- boxes


def box_units(scan: Scan, people: Poses) -> str | None:
    """All boxes, or some of them, have sizes of other units than meters."""
    boxes = scan.boxes or []
    warnings = [(str(person.id), unit_warning(box.size, what="it")) for person, box in zip(people, boxes, strict=True)]
    warnings = [(name, warning) for name, warning in warnings if warning]
    if 2 * len(warnings) > len(boxes):
        return unit_warning(np.median([box.size for box in boxes], axis=0), what="a person's box") or warnings[0][1]
    if not warnings:
        return None
    return f"box {first_names([name for name, _ in warnings])} is unlike the others: {warnings[0][1]}"


def empty_boxes(scan: Scan, people: Poses) -> str | None:
    """No box holds enough points: boxes and points are of different frames or units."""
    if any(person.num_points >= MIN_POINTS for person in people):
        return None
    low, high = scan.points.min(0), scan.points.max(0)
    centers = np.array([box.center for box in scan.boxes or []])
    return (
        f"no box holds {MIN_POINTS} points: expected boxes and points in one frame and in meters; points reach "
        f"from {_place(low)} to {_place(high)}, centers of boxes from {_place(centers.min(0))} to "
        f"{_place(centers.max(0))}"
    )


def wide_boxes(scan: Scan, people: Poses) -> str | None:
    """Boxes are wider than tall: their sizes are in another order."""
    sizes = np.array([box.size for box in scan.boxes or []])
    width, height = np.median(sizes[:, :2].max(1)), np.median(sizes[:, 2])
    if height >= _TALL_TO_WIDE * width:
        return None
    return f"boxes are wider ({width:.1f} m) than tall ({height:.1f} m): size is length, width, height"


def boxes_at_feet(scan: Scan, people: Poses) -> str | None:
    """People begin at the centers of their boxes: the centers are at the feet."""
    boxes, points = scan.level_boxes(), scan.box_points()
    heights = _heights(boxes, points, scan.rows)
    if (heights < _GROUND).sum() > _ELSEWHERE * len(heights):
        return None
    raised_boxes = [replace(box, center=box.center + [0, 0, box.size[2]]) for box in boxes]
    raised_heights = 1 + _heights(raised_boxes, points, rows_inside(raised_boxes, points))
    # a ceiling leaves room above the box, a tree goes on above the head
    trunk_count, sky_count = (raised_heights < _CHEST).sum(), (raised_heights > _TOP).sum()
    if trunk_count < max(_FEWEST, len(heights) / 4) or sky_count > _ELSEWHERE * len(raised_heights):
        return None
    return "people stand in the upper half of their boxes and above: is center at the feet? add half the height"


SCAN_CHECKS: tuple[Callable[[Scan, Poses], str | None], ...] = (box_units, empty_boxes, wide_boxes, boxes_at_feet)


# ---- the scan


def check_scan(scan: Scan, people: Poses) -> list[str]:
    """The warnings of all checks. people: in the level frame, in the order of the scan's clouds."""
    if not len(scan.points):
        return []
    # boxes that were found are nobody's fault, and the axes were looked at before
    is_given = scan.detected_rows is None
    warnings = {check: check(scan, people) for check in SCAN_CHECKS if scan.boxes and is_given}
    # one wrong axis is one warning, and people who are cut short by their boxes only seem to lie
    axis = flat_along_another_axis(scan) if is_given else None
    if not (axis or warnings.get(wide_boxes) or warnings.get(boxes_at_feet)):
        axis = all_lying(scan, people)
    return [warning for warning in (*warnings.values(), axis) if warning]


def origin_warning(scan: Scan) -> str | None:
    """The sensor is farther from the boxes than a LiDAR sees people."""
    if scan.origin is None or not scan.boxes:
        return None
    distance = float(np.median([np.linalg.norm(box.center - scan.origin) for box in scan.boxes]))
    if distance < FARTHEST_PERSON:
        return None
    position = ",".join(f"{value:g}" for value in scan.origin)
    return (
        f"the sensor at {position} is {distance:,.0f} m from the people, so its place is taken as unknown: "
        "give it in the points' own frame and in meters (sensor_origin)"
    )


def scan_unit_warning(points: np.ndarray, count: int) -> str | None:
    """What is likely wrong where the points (n, 3) of a whole scan of `count` points, z up, are not in meters."""
    extent = _extent(points)
    width, largest = float(extent[:2].max()), float(extent.max())
    if largest < _SMALLEST_SCAN:
        return f"the points reach over {largest:.2g} m: are the units kilometers? multiply all coordinates by 1000"
    if width > _LONGEST_SCAN and count < _SPARSEST * width**2:
        unit, factor = ("millimeters", 1000) if width > _LONG_IN_MILLIMETERS else ("centimeters", 100)
        return f"the points reach over {width:,.0f} m: are the units {unit}? divide all coordinates by {factor}"
    return unit_warning(extent, what="the scan")


def unlikely_origin(points: np.ndarray, origin: np.ndarray) -> str | None:
    """A sensor at origin (3,) m cannot have seen the points (n, 3) m of a whole scan, z up."""
    distance = np.hypot(*(points[:, :2] - origin[:2]).T)
    near_heights = points[distance < _BELOW_SENSOR, 2]
    nearest_distance = np.hypot(distance, points[:, 2] - origin[2]).min()
    if distance.min() > _FAR_OUT or nearest_distance > _FAR_AWAY:
        problem = f"is {nearest_distance:,.0f} m from the nearest point"
    elif len(near_heights) and np.percentile(near_heights, _LOWEST) > origin[2] - _LEAST_HEIGHT:
        problem = "has no ground below it"
    else:
        return None
    return f"the sensor {problem}, so its place is taken as unknown: give it in the points' own frame (sensor origin)"


def flat_axis(points: np.ndarray) -> str | None:
    """points (n, 3) m of a whole sweep -> the axis that they hardly extend along, "x", "y" or "z": its up axis.

    None where no axis stands out, as in a small room.
    """
    extent = _extent(points)
    axis = int(np.argmin(extent))
    other_extents = np.delete(extent, axis)
    return "xyz"[axis] if other_extents.min() > max(_STREET, _FLATTER * extent[axis]) else None


def flat_along_another_axis(scan: Scan) -> str | None:
    """The points of the whole scan hardly extend along another axis than the one said to be up."""
    axis = flat_axis(scan.points)
    if axis is None or axis == scan.upright_axis:
        return None
    return f"the points extend least along {axis}, so {scan.up} is hardly the input's up axis: try {_option(axis)}"


def all_lying(scan: Scan, people: Poses) -> str | None:
    """Everybody lies down, as where another axis is up. people: in the level frame."""
    posed_people = [(person.pose, person.points) for person in people if person.pose is not None]
    if not posed_people or not all(is_lying(pose, points) for pose, points in posed_people):
        return None
    other_options = ", or ".join(_option(axis) for axis in "zyx" if axis != scan.upright_axis)
    subject = "the person lies" if len(posed_people) == 1 else f"all {len(posed_people)} people lie"
    return f"{subject} down: if that is wrong, {scan.up} is not the input's up axis: try {other_options}"


def rows_inside(boxes: list[Box], points: np.ndarray) -> list[np.ndarray]:
    """points (n, 3) m, z up -> of each `Box` the rows (k,) of the points in it, ascending."""
    centers = np.array([box.center for box in boxes]).reshape(-1, 3)
    # twice what a corner reaches, whatever the yaw
    reach = np.array([np.hypot(*box.size[:2]) for box in boxes])
    near_rows = rows_near(centers, points, reach)
    return [rows[box.contains(points[rows])] for box, rows in zip(boxes, near_rows, strict=True)]


def _heights(boxes: list[Box], points: np.ndarray, rows: list[np.ndarray]) -> np.ndarray:
    """(k,): how high above the centers of their boxes, in those boxes' heights, points lie."""
    return np.concatenate(
        [(points[box_rows, 2] - box.center[2]) / box.size[2] for box, box_rows in zip(boxes, rows, strict=True)]
    )


def _extent(points: np.ndarray) -> np.ndarray:
    """(3,) m: how far most of a scan's points (n, 3) m reach along each axis, by enough of them."""
    low, high = np.percentile(points[:: -(-len(points) // _ENOUGH)], _MOST, axis=0)
    return high - low


def _place(point: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.1f}" for value in point) + ")"


def _option(axis: str) -> str:
    return "up y, or up -y where y points down (cameras)" if axis == "y" else f"up {axis}"
