"""Plausibility checks of inputs and results: independent functions, each returning a warning for the user or None.

A check of boxes is a function of (`Scan`, `Poses` in the level frame), called for scans with boxes. To add one, write
it and append it to `SCAN_CHECKS`.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from lidarpose.errors import first_names
from lidarpose.inference.results import Poses
from lidarpose.inference.scan import Scan, rows_inside
from lidarpose.sample import MIN_POINTS, UNLIKE_A_PERSON, Box, Pose, person_note

# bounds on the extent of a person given in other units but read as meters
_LARGEST_IN_CENTIMETERS, _SMALLEST_IN_OTHER_UNITS, _LARGEST_IN_KILOMETERS = 500, 20, 0.02
# maximum ratio of width to height of a crop of a person with the ground around
_WIDEST = 4
# maximum distance at which a LiDAR sees a person, m
FARTHEST_PERSON = 500.0
# boxes with a lower ratio of height to width have their sizes in another order
_TALL_TO_WIDE = 0.8
# heights above a box's center, relative to the box height: the ground, and the chest and the top of a person who stands
# at the center; maximum fraction of points outside these heights, and minimum number of points for the check
_GROUND, _CHEST, _TOP = -0.1, 0.75, 1.1
_ELSEWHERE, _FEWEST = 0.05, 20
# for points of another size or upside down, a network still predicts a person of human size, but with a larger spread:
# spreads, m, above which points are suspicious; benchmarks/plausibility.py measures how often these bounds warn
_UNSURE, _UNSURE_OF_SIZE, _UNSURE_OF_GIANT = 0.08, 0.1, 0.05
# with fewer points the pose is uncertain in any case
_FEWEST_UPSIDE_DOWN = 20
# extents in height, m, that exceed a person, and that clearly do; percentiles of height between which it is measured
_TALLEST, _GIANT, _TRIMMED = 2.2, 3.0, (3, 97)
# maximum spread of the pose of the turned points, relative to the pose of the given points, at which the input counts
# as upside down
_CLEARLY_SURER = 0.6
# a wider crop is not a crop of one person, m
_WIDEST_CROP = 20.0
# rotation by 180 degrees about x, as a factor per axis
UPSIDE_DOWN = np.array([1.0, -1.0, -1.0])
# joints from which the direction of the trunk is computed
_TRUNK = ("left_shoulder", "right_shoulder", "left_hip", "right_hip")
# thresholds for lying people: the points are less than `_TIGHT` m across; their level standard deviation is at least
# `_LONG` m and `_LONG_TO_TALL` times the vertical one. This holds for 97 of 100 synthetic people who were laid down,
# and for none who stood
_TIGHT, _LONG, _LONG_TO_TALL = 2.0, 0.25, 1.5
# a sweep's extent: the percentiles between which it is measured and the number of points that suffice; minimum level
# extent, m, and minimum ratio of level to vertical extent
_MOST, _ENOUGH, _STREET, _FLATTER = (10, 90), 25_000, 10.0, 3.0
# a scan that is longer than this, m, and has fewer points per square meter is in other units: in millimeters if longer
# than the third value, m; the last value is the minimum size of a scan, m
_LONGEST_SCAN, _SPARSEST, _LONG_IN_MILLIMETERS, _SMALLEST_SCAN = 500.0, 0.1, 10_000.0, 0.5
# maximum distance of a sensor from the nearest point, m, along the ground and, for drones, in space; of the points
# within `_BELOW_SENSOR` m, the given percentile of height must be at least `_LEAST_HEIGHT` m below the sensor
_FAR_OUT, _FAR_AWAY, _BELOW_SENSOR, _LOWEST, _LEAST_HEIGHT = 25.0, 60.0, 15.0, 5, 0.2


# ---- one person


def unit_warning(size: np.ndarray, *, what: str) -> str | None:
    """The extent `size` (3,) of a person, z up, is implausible in meters: suggests the likely unit."""
    height, largest = float(size[2]), float(size.max())
    if 0 < largest < _LARGEST_IN_KILOMETERS:
        return f"{what} is {largest:.2g} m in size: are the units kilometers? multiply all coordinates by 1000"
    # a few returns may all be at one height; a whole street is large, but far wider than tall
    if height < _SMALLEST_IN_OTHER_UNITS or height < largest / _WIDEST:
        return None
    unit, factor = ("millimeters", 1000) if height > _LARGEST_IN_CENTIMETERS else ("centimeters", 100)
    return f"{what} is {height:,.0f} m tall: are the units {unit}? divide all coordinates by {factor}"


def oversize_warning(points: np.ndarray, pose: Pose) -> str | None:
    """The points of a person are not in meters, or contain far more than a person.

    Args:
        points: (n, 3) m, z up, the whole crop.
        pose: the pose of the person.
    """
    width = float(np.ptp(points[:, :2], axis=0).max())
    if width > _WIDEST_CROP:
        return (
            f"the points extend over {width:,.0f} m, and one pose was estimated near their middle: expected a crop "
            "of one person: search for people (--find, in Python find=True), give their boxes, or crop closer"
        )
    low, high = np.percentile(points[:, 2], _TRIMMED)
    bound = _UNSURE_OF_SIZE if high - low < _GIANT else _UNSURE_OF_GIANT
    if high - low < _TALLEST or pose.spread is None or pose.spread.mean() < bound:
        return None
    return (
        f"the points are {high - low:.1f} m tall, taller than a person: expected meters, perhaps they are in feet or "
        "another unit, or the crop contains more than one person"
    )


def person_count_warning(pose: Pose, *, in_box: bool = False, is_scored: bool = False) -> str | None:
    """The points do not show a person, or show a second one.

    in_box: whether the crop comes from a box, which selects the person; is_scored: whether the box has a score, so that
    the existence of the person is not questioned.
    """
    note = person_note(pose, is_scored=is_scored)
    if note == UNLIKE_A_PERSON:
        return f"the points look unlike a person (person {float(pose.person or 0):.2f}): perhaps there is no person"
    if note and in_box:
        return "the points look like two people: the pose is of the one nearer to the center of the box"
    return note and "the points look like two people, and the pose is of one of them: give a box to choose one"


def looks_unsure(pose: Pose, points: np.ndarray) -> bool:
    """Whether the pose of points (n, 3) is uncertain enough to try them upside down as well."""
    return len(points) >= _FEWEST_UPSIDE_DOWN and pose.spread is not None and bool(pose.spread.mean() > _UNSURE)


def upside_down_warning(pose: Pose, turned: Pose | None) -> str | None:
    """The pose has a far larger spread than `turned`, the pose of the same points upside down."""
    if turned is None or pose.spread is None or turned.spread is None:
        return None
    if turned.spread.mean() > _CLEARLY_SURER * pose.spread.mean():
        return None
    return "the pose is more certain upside down: does the up axis point down? try --up -z, or the opposite of --up"


def is_lying(pose: Pose, points: np.ndarray) -> bool:
    """Whether the person lies: the trunk of the pose, z up, or the distribution of the points (n, 3) m is close to
    horizontal.

    The points are tested too, since a network trained on few lying people predicts a standing pose for them.
    """
    if len(points) and (np.ptp(points[:, :2], axis=0) < _TIGHT).all():
        spread = points.std(0)
        if spread[:2].max() > max(_LONG, _LONG_TO_TALL * spread[2]):
            return True
    if not set(_TRUNK) <= set(pose.skeleton.joints):
        return False
    joints = {name: pose.joints[pose.skeleton.index(name)] for name in _TRUNK}
    trunk = joints["left_shoulder"] + joints["right_shoulder"] - joints["left_hip"] - joints["right_hip"]
    return bool(abs(trunk[2]) < np.sin(np.radians(35)) * np.linalg.norm(trunk))


# ---- boxes


def box_units(scan: Scan, people: Poses) -> str | None:
    """The sizes of all or some boxes are not in meters."""
    boxes = scan.boxes or []
    warnings = [(str(person.id), unit_warning(box.size, what="it")) for person, box in zip(people, boxes, strict=True)]
    warnings = [(name, warning) for name, warning in warnings if warning]
    if are_boxes_in_other_units(boxes):
        return unit_warning(np.median([box.size for box in boxes], axis=0), what="a person's box") or warnings[0][1]
    if not warnings:
        return None
    return f"box {first_names([name for name, _ in warnings])} is unlike the others: {warnings[0][1]}"


def are_boxes_in_other_units(boxes: list[Box]) -> bool:
    """Whether the sizes of most boxes are not in meters."""
    return 2 * sum(unit_warning(box.size, what="it") is not None for box in boxes) > len(boxes)


def empty_boxes(scan: Scan, people: Poses) -> str | None:
    """No box contains enough points: boxes and points are in different frames or units."""
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
    """Boxes are wider than tall: their sizes are in the wrong order."""
    sizes = np.array([box.size for box in scan.boxes or []])
    width, height = np.median(sizes[:, :2].max(1)), np.median(sizes[:, 2])
    if height >= _TALL_TO_WIDE * width:
        return None
    return f"boxes are wider ({width:.1f} m) than tall ({height:.1f} m): size is length, width, height"


def boxes_at_feet(scan: Scan, people: Poses) -> str | None:
    """The points of people start at the centers of their boxes: the centers are at the feet."""
    boxes, points = scan.level_boxes(), scan.box_points()
    heights = _heights(boxes, points, scan.rows)
    if (heights < _GROUND).sum() > _ELSEWHERE * len(heights):
        return None
    raised_boxes = [replace(box, center=box.center + [0, 0, box.size[2]]) for box in boxes]
    raised_heights = 1 + _heights(raised_boxes, points, rows_inside(raised_boxes, points))
    # points above the raised boxes rule this out: a tree continues above the head, while a ceiling leaves a gap above
    # the box
    trunk_count, sky_count = (raised_heights < _CHEST).sum(), (raised_heights > _TOP).sum()
    if trunk_count < max(_FEWEST, len(heights) / 4) or sky_count > _ELSEWHERE * len(raised_heights):
        return None
    return "people are in the upper half of their boxes and above: is center at the feet? add half the height"


SCAN_CHECKS: tuple[Callable[[Scan, Poses], str | None], ...] = (box_units, empty_boxes, wide_boxes, boxes_at_feet)


# ---- the scan


def check_scan(scan: Scan, people: Poses) -> list[str]:
    """Runs all checks and returns their warnings. people: in the level frame, in the order of `Scan.clouds`."""
    if not len(scan.points):
        return []
    # detected boxes need no check, and detection has already checked the axes
    is_given = scan.detected_rows is None
    # other problems of boxes in wrong units follow from the units
    checks = (box_units,) if are_boxes_in_other_units(scan.boxes or []) else SCAN_CHECKS
    warnings = {check: check(scan, people) for check in checks if scan.boxes and is_given}
    # warn of a wrong axis only once; people who are cut off by wrong boxes only appear to lie
    axis = flat_along_another_axis(scan) if is_given else None
    if not (axis or warnings.get(wide_boxes) or warnings.get(boxes_at_feet)):
        axis = all_lying(scan, people)
    return [warning for warning in (*warnings.values(), axis) if warning]


def origin_warning(scan: Scan) -> str | None:
    """The sensor is farther from the boxes than a LiDAR can see people."""
    if scan.origin is None or not scan.boxes or are_boxes_in_other_units(scan.boxes):
        return None
    distance = float(np.median([np.linalg.norm(box.center - scan.origin) for box in scan.boxes]))
    if distance < FARTHEST_PERSON:
        return None
    position = ",".join(f"{value:g}" for value in scan.origin)
    return (
        f"the sensor at {position} is {distance:,.0f} m from the people, so its position is treated as unknown: "
        "give it in the points' own frame and in meters (--sensor-origin)"
    )


def scan_unit_warning(points: np.ndarray, count: int) -> str | None:
    """The points (n, 3) of a whole scan, z up, are not in meters. count: number of points, also if some were thinned
    out."""
    extent = _extent(points)
    width, largest = float(extent[:2].max()), float(extent.max())
    if largest < _SMALLEST_SCAN:
        return f"the points extend over {largest:.2g} m: are the units kilometers? multiply all coordinates by 1000"
    is_flat = extent[2] < largest / _WIDEST
    if is_flat and width > _LONGEST_SCAN and count < _SPARSEST * width**2:
        unit, factor = (
            ("millimeters", 1000) if width > _LONG_IN_MILLIMETERS else ("centimeters", "100 (inches by 39.37)")
        )
        return f"the points extend over {width:,.0f} m: are the units {unit}? divide all coordinates by {factor}"
    return unit_warning(extent, what="the scan")


def unlikely_origin(points: np.ndarray, origin: np.ndarray) -> str | None:
    """A sensor at origin (3,) m cannot have recorded the points (n, 3) m of a whole scan, z up."""
    distance = np.hypot(*(points[:, :2] - origin[:2]).T)
    near_heights = points[distance < _BELOW_SENSOR, 2]
    nearest_distance = np.hypot(distance, points[:, 2] - origin[2]).min()
    if distance.min() > _FAR_OUT or nearest_distance > _FAR_AWAY:
        problem = f"is {nearest_distance:,.0f} m from the nearest point"
    elif len(near_heights) and np.percentile(near_heights, _LOWEST) > origin[2] - _LEAST_HEIGHT:
        problem = "has no ground below it"
    else:
        return None
    remedy = "give it in the points' own frame (--sensor-origin)"
    return f"the sensor {problem}, so its position is treated as unknown: {remedy}"


def flat_axis(points: np.ndarray) -> str | None:
    """points (n, 3) m of a whole sweep -> "x", "y" or "z", the axis with by far the smallest extent: the up axis.

    None if no axis stands out, as in a small room.
    """
    extent = _extent(points)
    axis = int(np.argmin(extent))
    other_extents = np.delete(extent, axis)
    return "xyz"[axis] if other_extents.min() > max(_STREET, _FLATTER * extent[axis]) else None


def flat_along_another_axis(scan: Scan) -> str | None:
    """The points of the whole scan have by far the smallest extent along an axis other than the given up axis."""
    axis = flat_axis(scan.points)
    if axis is None or axis == scan.upright_axis:
        return None
    return (
        f"the points extend least along {axis}, so {scan.up} is probably not the input's up axis: try {_option(axis)}"
    )


def all_lying(scan: Scan, people: Poses) -> str | None:
    """All people lie, which suggests another up axis. people: in the level frame."""
    posed_people = [(person.pose, person.points) for person in people if person.pose is not None]
    if not posed_people or not all(is_lying(pose, points) for pose, points in posed_people):
        return None
    other_options = ", or ".join(_option(axis) for axis in "zyx" if axis != scan.upright_axis)
    subject = "the person lies" if len(posed_people) == 1 else f"all {len(posed_people)} people lie"
    return f"{subject} down: if that is wrong, {scan.up} is not the input's up axis: try {other_options}"


def _heights(boxes: list[Box], points: np.ndarray, rows: list[np.ndarray]) -> np.ndarray:
    """(k,): heights of the points inside boxes above the box centers, relative to the box heights."""
    return np.concatenate(
        [(points[box_rows, 2] - box.center[2]) / box.size[2] for box, box_rows in zip(boxes, rows, strict=True)]
    )


def _extent(points: np.ndarray) -> np.ndarray:
    """(3,) m: extent along each axis between the percentiles `_MOST` of a scan's points (n, 3) m, subsampled."""
    low, high = np.percentile(points[:: -(-len(points) // _ENOUGH)], _MOST, axis=0)
    return high - low


def _place(point: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.1f}" for value in point) + ")"


def _option(axis: str) -> str:
    return "--up y, or --up -y where y points down (cameras)" if axis == "y" else f"--up {axis}"
