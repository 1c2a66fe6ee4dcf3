"""Detection in a single scan: `lidarpose.detect`, and the likely reason if no people are found."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from lidarpose.errors import counted
from lidarpose.geometry import UP_AXES, rotation_from_up, up_text, upright_axis
from lidarpose.inference.checks import flat_along_another_axis, flat_axis, scan_unit_warning
from lidarpose.inference.detection import (
    LEAST_STATIC,
    DetectedScan,
    Search,
    detect_places,
    detector_version,
    find_people,
    search_options,
    verify_people,
)
from lidarpose.inference.inputs import as_origin
from lidarpose.inference.scan import Scan, read_scan
from lidarpose.io.boxes import Boxes
from lidarpose.sample import Box

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

# one foot, m; a sensor lower than this above the ground, m, is not in feet
_FOOT, _LOW_SENSOR = 0.3048, 3.0
# sum of the scores of people who are found with another up axis, from which it is suggested: one person may be false
_SURE = 1.2


def detect(
    points: str | os.PathLike | ArrayLike,
    *,
    sensor_origin: np.ndarray | Sequence[float] | str | None = None,
    up: str | Sequence[float] | None = None,
    columns: int | None = None,
    max_range: float | None = None,
    min_score: float | None = None,
    max_people: int | None = None,
    background: str | os.PathLike | Sequence | ArrayLike | None = None,
    point_times: ArrayLike | None = None,
) -> Boxes:
    """Detects the people in a whole scan and returns their boxes, highest score first, ready for `predict`.

    Args:
        points: path of a point file, or points (n, 3+) m in any frame.
        sensor_origin: (x, y, z) m, the sensor position in the frame of the points, or "unknown". None means 0, 0, 0.
        up: up axis of the scan, as in `predict`. None means z, or, if the ground leans, the direction in which it does.
        columns: number of values per row of a .bin file.
        max_range: maximum horizontal distance of people from the sensor, m. None means 40. Ignored if the sensor
            position is unknown.
        min_score: score threshold. None means the detector's default, at which most scans have no false positive; 0.5
            finds more people, mainly indoors.
        max_people: maximum number of people; those with the highest scores are returned.
        background: static background of a stationary sensor, in which no people are searched for: a file or an array
            (k, 3) m of static points, see `learn_background`; or several scans or a folder of scans, from which the
            background is learned.
        point_times: (n,) s, as in `predict`. If the points are of several scans, only the newest is searched: in all of
            them a moving person is many.

    Returns:
        `Boxes` in the frame of the points. Each box has `score`, the probability that it contains a person, calibrated
        on synthesized scenes (in real scans, scores of 0.3 to 0.8 are less often people), and `mounted`, whether the
        person rides or sits in a wheelchair. `Boxes.warnings` lists problems with the scan.
        `Boxes.up` is the up axis of the scan, or a direction if the sensor was found to be tilted.

    Raises:
        InputError: a file that cannot be read, or an invalid option.
    """
    up_direction = "z" if up is None else up
    rotation_from_up(up_direction)
    search = search_options(min_score, max_range, max_people, background, columns, up=up)
    origin = np.zeros(3) if sensor_origin is None else as_origin(sensor_origin)
    scan = Scan(points=np.zeros((0, 3)), origin=origin, up=up_text(up_direction))
    result = search_alone(read_scan(scan, points, columns, point_times), search)
    return Boxes(
        result.boxes or [], source=result.source, warnings=result.warnings, detector=detector_version(), up=result.up
    )


def search_alone(scan: Scan, search: Search) -> Scan:
    """`find_people` for a single scan. If no people are found, it adds `why_nobody`."""
    places = detect_places(scan, search)
    result = verify_people(places, search)
    if not result.boxes:
        return replace(result, warnings=why_nobody(places, search, result.warnings))
    if places.detections is not None and not places.detections.has_ground:
        # a scan that is upside down may have a few false people
        hint = _opposite_up(places, search, result.boxes)
        return replace(result, warnings=(*result.warnings, hint)) if hint else result
    return result


def why_nobody(places: DetectedScan, search: Search, warnings: tuple[str, ...]) -> tuple[str, ...]:
    """The warnings of a scan without people, with a likely reason: another up axis, feet, a sensor far
    from its points, or the background."""
    if places.detections is None:
        return warnings
    if places.far_warning is not None:
        # in feet most points are beyond the range, too
        hint = _feet(places, search)
        return (*(warning for warning in warnings if warning != places.far_warning), hint) if hint else warnings
    other_axis = flat_along_another_axis(places.scan)
    # in wrong units, no people are found with any up axis
    is_scaled = scan_unit_warning(places.level, len(places.given.points)) is not None
    if (other_axis or not is_scaled) and (hint := _other_up_axis(places, search)):
        # other warnings of the search would follow from the wrong axis
        return (*places.given.warnings, hint)
    if other_axis:
        return warnings
    hint = None if is_scaled else _feet(places, search)
    hint = hint or _much_background(places)
    return (*warnings, hint) if hint else warnings


def _other_up_axis(places: DetectedScan, search: Search) -> str | None:
    """A warning for the user if people are found with another up axis."""
    input_scan, detections = places.given, places.detections
    if detections is None:
        return None
    other_axes = [up for up in UP_AXES if up != input_scan.up]
    if detections.has_ground and flat_axis(places.scan.points) == input_scan.upright_axis:
        # outdoors: the axis is right, but the scan may be upside down
        other_axes = [_opposite(input_scan)]
    everyone = replace(search, max_people=None)
    boxes = {up: _people_along(up, input_scan, everyone) for up in other_axes}
    best_axis = max(other_axes, key=lambda up: _sum_of_scores(boxes[up]))
    if _sum_of_scores(boxes[best_axis]) < _SURE:
        return None
    people = counted(len(boxes[best_axis]), "person", "people")
    return f"no people found with up {input_scan.up}, but {people} with up {best_axis}: try --up {best_axis}"


def _opposite_up(places: DetectedScan, search: Search, boxes: Sequence[Box]) -> str | None:
    """A warning for the user if far more people are found upside down."""
    up, everyone = _opposite(places.given), replace(search, max_people=None)
    if search.max_people is not None:
        boxes = find_people(places.given, everyone).boxes or []
    other_boxes = _people_along(up, places.given, everyone)
    if _sum_of_scores(other_boxes) < max(_SURE, 2 * _sum_of_scores(boxes)):
        return None
    people = counted(len(other_boxes), "person", "people")
    return f"{len(boxes)} found with up {places.given.up}, but {people} with up {up}: try --up {up}"


def _people_along(up: str, scan: Scan, search: Search) -> Sequence[Box]:
    """The boxes of people in the scan with another up axis; none if its ground leans onto a third axis, with which the
    boxes are the same."""
    result = find_people(replace(scan, up=up), search)
    return (result.boxes or []) if upright_axis(result.up) == up else []


def _opposite(scan: Scan) -> str:
    """The axis that points the other way than the up axis nearest to the scan's."""
    axis = upright_axis(scan.up)
    return axis[1:] if axis.startswith("-") else f"-{axis}"


def _sum_of_scores(boxes: Sequence[Box]) -> float:
    return sum(box.score or 0.0 for box in boxes)


def _feet(places: DetectedScan, search: Search) -> str | None:
    """A warning for the user if people are found with feet as the unit. Only where the sensor is higher above the
    ground than most, since a third of a scan in meters may have something of a person's shape."""
    scan, origin, detections = places.given, places.scan.level_origin, places.detections
    if detections is None:
        return None
    if origin is not None and origin[2] - detections.base - detections.ground.at(origin[None, :2]) < _LOW_SENSOR:
        return None
    feet = replace(scan, points=scan.points * _FOOT, origin=None if scan.origin is None else scan.origin * _FOOT)
    background = None if search.background is None else search.background * _FOOT
    boxes = find_people(feet, replace(search, background=background)).boxes
    if not boxes:
        return None
    return f"no people found in meters, but {len(boxes)} if the units are feet: multiply all coordinates by {_FOOT}"


def _much_background(places: DetectedScan) -> str | None:
    """A warning for the user that people may be part of the background."""
    if places.moving is None or (static_share := 1 - places.moving.mean()) < LEAST_STATIC:
        return None
    return (
        f"no people found off the background, on which {static_share:.0%} of the points lie: if people are missing, "
        "learn the background from ten seconds or more"
    )
