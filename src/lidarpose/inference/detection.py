"""Finds the people in a whole scan. The detector scores candidate positions, the verifier classifies the best
of them, and the default pose network poses the verified people to fit their boxes.

Legend: D detections.
"""

import os
import reprlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np

from lidarpose.errors import InputError, check_int, is_number
from lidarpose.geometry import UP_AXES, nearest_axis, rotation_about, up_text, upright_axis
from lidarpose.inference.background import is_static, read_background
from lidarpose.inference.checks import flat_along_another_axis, scan_unit_warning, unlikely_origin
from lidarpose.inference.inputs import distinct_rows, hashes
from lidarpose.inference.known_places import KnownPlaces
from lidarpose.inference.scan import Scan, rows_inside
from lidarpose.inference.verification import rounded, verified
from lidarpose.models.detector.detector import MAX_RANGE, Detections, Detector
from lidarpose.models.detector.ground import estimate_up
from lidarpose.models.detector.map_ground import MOST_EXTENT
from lidarpose.sample import FARTHEST, MIN_POINTS, Box

# maximum number of detections that are verified and posed
MOST_POSED = 60
# maximum number of points with an unknown and with a known sensor position; scans with more are thinned. Points more
# than `_BEYOND` m beyond the range are dropped first. Points processed per chunk, and bins of the distance histogram
_MOST_POINTS, _MOST_AROUND, _BEYOND = 1_500_000, 400_000, 15.0
_CHUNK, _DISTANCES = 1_000_000, 4096
# maximum number of points of which duplicates are removed before they are thinned
_MOST_SORTED = 4_000_000
# number of points used to estimate the up direction
_ENOUGH_FOR_UP = 250_000
# minimum fraction of a scan's points on its background; below it, the background belongs to another sensor or frame
LEAST_STATIC = 0.2
# a sensor lower than this above the ground around it, m, is the origin of another frame; distances, m, and number of
# directions at which the ground is looked up
_LEAST_HEIGHT, _AROUND, _DIRECTIONS = 0.18, (2.0, 4.0, 6.0, 8.0), 16
# if more than this share of the points lies beyond the range, the sensor may be elsewhere; number of points for it
_MOST_BEYOND, _ENOUGH_FOR_SHARE = 0.5, 20_000


@dataclass(frozen=True, kw_only=True, eq=False)
class Search:
    """Settings of people detection, see `detect`. background (k, 3) m: static points in the scan's frame; detector:
    None for the bundled one; exact_up: the scan's up direction is exact, so that the sensor is not tilted even if the
    ground leans."""

    max_range: float = MAX_RANGE
    min_score: float | None = None
    max_people: int | None = None
    background: np.ndarray | None = None
    detector: Detector | None = None
    exact_up: bool = False

    def __post_init__(self):
        if not is_number(self.max_range) or not 0 < self.max_range <= FARTHEST:
            actual = reprlib.repr(self.max_range)
            expected = f"expected meters, more than 0 and at most {FARTHEST:g}"
            raise InputError(f"max_range (--range): {expected}, got {actual}")
        if self.min_score is not None and not (is_number(self.min_score) and 0 <= self.min_score <= 1):
            raise InputError(f"min_score (--min-score): expected a probability from 0 to 1, got {self.min_score!r}")
        if self.max_people is not None:
            check_int("max_people", self.max_people, least=1)


def search_options(
    min_score: Any,
    max_range: Any,
    max_people: Any,
    background: Any,
    columns: int | None,
    topic: str | None = None,
    meta: str | os.PathLike | None = None,
    up: str | Sequence[float] | None = None,
) -> Search:
    """Validates the options of a search and reads its background. max_range: None for the default; up: the up axis if
    the user gives one. Raises InputError."""
    # accept arrays with zero dimensions as numbers
    min_score, max_range, max_people = (
        value.item() if getattr(value, "shape", None) == () else value for value in (min_score, max_range, max_people)
    )
    max_range = MAX_RANGE if max_range is None else max_range
    # a direction, or z, says that the scan is level; the y axis of a camera may still be tilted
    is_other_axis = isinstance(up, str) and up in UP_AXES and up != "z"
    exact_up = up is not None and not is_other_axis
    search = Search(max_range=max_range, min_score=min_score, max_people=max_people, exact_up=exact_up)
    if background is None:
        return search
    return replace(search, background=read_background(background, columns=columns, topic=topic, meta=meta))


def find_people(scan: Scan, search: Search) -> Scan:
    """Detects and verifies the people in a scan.

    Returns the scan with their boxes, highest score first, with `detected_rows` and with warnings about the scan.
    `origin` is None if the given sensor position is impossible, and `up` is corrected if the scan is tilted.
    """
    return verify_people(detect_places(scan, search), search)


@dataclass(frozen=True, kw_only=True, eq=False)
class DetectedScan:
    """A scan with detections that are not yet verified.

    given: the scan as given, thinned; scan: the scan as it was searched; level (n, 3) m: its points in the level frame;
    detections: in the level frame, None for a scan without points; moving (n,) bool: points off the background, None
    without a background; far_warning: that of `_far_from_most`, one of the scan's warnings; older: the points that are
    not of the newest scan, which was searched alone, None if there is one scan.
    """

    given: Scan
    scan: Scan
    level: np.ndarray
    detections: Detections | None
    moving: np.ndarray | None = None
    far_warning: str | None = None
    older: Scan | None = None


def detect_places(scan: Scan, search: Search) -> DetectedScan:
    """The first half of `find_people`, which does not depend on other frames of a recording. Of several scans in one
    cloud, the newest is searched: in all of them a moving person is many."""
    scan = scan.with_newest()
    if (is_newest := scan.is_newest) is not None:
        counts = f"{np.count_nonzero(is_newest):,} of {len(scan.points):,} points"
        note = f"the points are of several scans by their times: people are searched for in the newest, {counts}"
        newest = replace(scan.with_points_of(is_newest), is_newest=None, warnings=(*scan.warnings, note))
        return replace(detect_places(newest, search), older=scan.with_points_of(~is_newest))
    full_scan, count = scan, len(scan.points)
    if _MOST_AROUND < count <= _MOST_SORTED:
        # before the points are thinned: copies are kept or dropped together
        scan = scan.with_points_of(distinct_rows(scan.points))
    input_scan, notes = _thinned(scan, search)
    input_scan = input_scan.with_points_of(distinct_rows(input_scan.points))
    scan, warnings = input_scan, [*scan.warnings, *notes]
    if len(scan.points) < MIN_POINTS:
        scan = replace(scan, warnings=(*warnings, f"under {MIN_POINTS} points"))
        return DetectedScan(given=input_scan, scan=scan, level=scan.points, detections=None)
    level = _leveled(scan)
    # a warning of wrong axes or units suppresses others that would only follow from it
    if frame_warning := flat_along_another_axis(scan):
        warnings.append(frame_warning)
    origin = scan.level_origin
    up = None if search.exact_up else estimate_up(_near(level, origin, search), origin)
    if up is not None:
        degrees = np.degrees(np.arccos(np.clip(up[2] / np.linalg.norm(up), -1, 1)))
        # zero is added, since -0 would be shown
        direction = np.round(up @ scan.R_level_input, 3) + 0.0
        if (axis := nearest_axis(direction)) != upright_axis(scan.up):
            # --up z would be exact
            option = "it without --up" if axis == "z" else f"--up {axis}"
            remedy = f"another axis points up: try {option}"
        else:
            remedy = f"the sensor is assumed to be tilted: confirm it with --up {','.join(f'{v:g}' for v in direction)}"
            remedy += ", or, if the ground slopes, give --up z" if scan.up == "z" else ""
        warnings.append(f"the ground leans by {degrees:.0f} degrees, so {remedy}")
        scan = replace(scan, up=up_text(up @ scan.R_level_input))
        level = _leveled(scan)
        origin = scan.level_origin
    # check units in the level frame: a tilted scan is as tall as one in wrong units
    if not frame_warning and (frame_warning := scan_unit_warning(level, count)):
        warnings.append(frame_warning)

    def with_unknown_sensor(warning: str) -> DetectedScan:
        # start again: with an unknown sensor, thinning keeps other points, and other points determine the up direction
        scan_warnings = full_scan.warnings if frame_warning else (*full_scan.warnings, warning)
        return replace(detect_places(replace(full_scan, origin=None, warnings=scan_warnings), search), given=input_scan)

    if origin is not None and (warning := unlikely_origin(level, origin)):
        return with_unknown_sensor(warning)
    far_warning = None if origin is None or frame_warning else _far_from_most(full_scan, scan, search)
    if far_warning is not None:
        warnings.append(far_warning)
    if origin is None and not frame_warning:
        # without stray points, which the detector leaves out, too
        reach = np.quantile(level[:: 1 + len(level) // 20_000, :2], (0.001, 0.999), axis=0)
        if np.ptp(reach, axis=0).max() > MOST_EXTENT:
            problem = f"the scan extends over more than {MOST_EXTENT / 1e3:.0f} km"
            warnings.append(f"{problem}, beyond which people are hardly found: give parts of it")
    if origin is None and search.max_range != MAX_RANGE:
        warnings.append("the sensor position is unknown, so max_range (--range) is not applied")
    is_moving = None
    if search.background is not None:
        is_moving = ~is_static(scan.points, search.background)
        if (static_share := 1 - is_moving.mean()) < LEAST_STATIC:
            warnings.append(
                f"only {static_share:.0%} of the points lie on the background: is the background "
                "from this sensor and in this frame?"
            )
    detector = search.detector or _detector()
    detections = detector.detect(level, origin, max_range=search.max_range, limit=MOST_POSED, moving=is_moving)
    if origin is not None and (warning := _on_ground(detections, origin)):
        return with_unknown_sensor(warning)
    if not (detections.has_ground or frame_warning):
        warnings.append("no ground was found, so people are detected without it: is the up axis correct?")
    scan = replace(scan, warnings=tuple(warnings))
    return DetectedScan(
        given=input_scan, scan=scan, level=level, detections=detections, moving=is_moving, far_warning=far_warning
    )


def _far_from_most(full_scan: Scan, scan: Scan, search: Search) -> str | None:
    """A warning for the user if most points of the scan before it was thinned lie beyond the range of the sensor. scan:
    the same, with the up axis and the sensor's position as they are assumed."""
    if search.max_range < MAX_RANGE:
        return None
    points = full_scan.points[:: 1 + len(full_scan.points) // _ENOUGH_FOR_SHARE]
    offset = (points - scan.origin) @ scan.R_level_input[:2].T
    share = np.mean((offset**2).sum(1) > search.max_range**2)
    if share < _MOST_BEYOND:
        return None
    return (
        f"{share:.0%} of the points are more than {search.max_range:g} m from the sensor, where people are not "
        "searched: give the sensor's position in the points' own frame (--sensor-origin), or unknown, or a larger "
        "--range"
    )


def _on_ground(detections: Detections, origin: np.ndarray) -> str | None:
    """A warning for the user if the sensor at origin (3,) m, level, is at the height of the ground around it."""
    if not detections.has_ground:
        return None
    turns = np.arange(_DIRECTIONS) * (2 * np.pi / _DIRECTIONS)
    circle = np.stack([np.cos(turns), np.sin(turns)], 1)
    places = origin[:2] + np.concatenate([radius * circle for radius in _AROUND])
    height = float(origin[2] - detections.base - np.median(detections.ground.at(places)))
    if height > _LEAST_HEIGHT:
        return None
    return (
        f"the sensor is not above the ground ({height:+.2f} m), so its position is treated as unknown: "
        "give it in the points' own frame (--sensor-origin)"
    )


def verify_people(places: DetectedScan, search: Search, known: KnownPlaces | None = None) -> Scan:
    """The second half of `find_people`. known: people and rejected positions from earlier frames of a recording; with
    it, the returned scan also has `pelvises`, `verified` and `rejected`."""
    scan, input_scan, detections = places.scan, places.given, places.detections
    if detections is None:
        return replace(scan, boxes=[], detected_rows=[])
    if known is not None and not np.allclose(input_scan.R_boxes_input, scan.R_level_input):
        # boxes of a tilted scan are larger than the people in them and cannot be reused, so people are detected again
        known = replace(known, boxes=[], pelvises=np.zeros((0, 3)))
    origin = scan.level_origin
    known_level = None if known is None else known.level(scan.R_level_input)
    detector = search.detector or _detector()
    detect_beside = partial(detector.detect_beside, places.level, origin, detections.ground, moving=places.moving)
    people = verified(
        detections,
        places.level,
        origin,
        detector.header,
        least_score(search),
        search.max_people,
        known_level,
        detect_beside,
    )
    boxes = [_in_input(box, scan, input_scan) for box in people.boxes]
    result = replace(scan, boxes=boxes, detected_rows=people.rows)
    if places.older is not None:
        result = _with_older(result, places.older, people.boxes)
    if known is None:
        return result
    return replace(
        result,
        pelvises=people.pelvises @ scan.R_level_input,
        verified=people.verified,
        rejected=people.rejected @ scan.R_level_input,
    )


def _with_older(scan: Scan, older: Scan, level_boxes: list[Box]) -> Scan:
    """The searched scan with the points of older scans appended, and those in the boxes of people added to theirs. The
    boxes are in the level frame."""
    older_rows = rows_inside(level_boxes, older.points @ scan.R_level_input.T)
    count = len(scan.points)
    assert scan.detected_rows is not None
    rows = [np.append(rows, count + more) for rows, more in zip(scan.detected_rows, older_rows, strict=True)]
    points = np.concatenate([scan.points, older.points])
    return replace(scan, points=points, is_newest=np.arange(len(points)) < count, detected_rows=rows)


def least_score(search: Search) -> float:
    """The score threshold of a search."""
    if search.min_score is not None:
        return search.min_score
    return float((search.detector or _detector()).header["default_score"])


def detector_version() -> str:
    """The version of the bundled detector."""
    return str(_detector().header["version"])


@cache
def _detector() -> Detector:
    return Detector()


# ---- the scan


def _thinned(scan: Scan, search: Search) -> tuple[Scan, list[str]]:
    """The scan thinned to about `_MOST_AROUND` points, with a warning if points are thinned over the whole range.

    With a known sensor, points beyond the range are dropped, and points nearer than some distance are thinned so that
    people there keep as many points as a person at that distance has. With an unknown sensor, `_MOST_POINTS` points are
    drawn uniformly.
    """
    points, origin, count = scan.points, scan.origin, len(scan.points)
    if count <= (_MOST_POINTS if origin is None else _MOST_AROUND):
        return scan, []
    # in chunks: for 10^8 points, another array of one number per point would take a gigabyte
    pieces = [slice(start, start + _CHUNK) for start in range(0, count, _CHUNK)]
    squared_reach, num_searched, squared_dense_range = (search.max_range + _BEYOND) ** 2, count, None
    if origin is not None:
        # geometric, so that a large range does not put all points into the first bins
        edges = np.append(0.0, np.geomspace(0.01, squared_reach, _DISTANCES))
        histogram = sum(np.histogram(_squared(points[piece], origin), edges)[0] for piece in pieces)
        if (num_in_range := int(np.sum(histogram))) >= MIN_POINTS:
            num_searched, squared_dense_range = num_in_range, _dense_below(np.asarray(histogram), edges)
    kept_rows = []
    for piece in pieces:
        share: np.ndarray | float = _MOST_POINTS / count
        if origin is not None and squared_dense_range is not None:
            squared = _squared(points[piece], origin)
            share = np.where(squared < squared_reach, squared / squared_dense_range, 0.0)
        # by the coordinates in mm, so that neither the order of the points nor their rounding decides
        chance = hashes(np.rint(points[piece] * 1e3) + 0.0) / 2.0**64
        kept_rows.append(piece.start + np.flatnonzero(chance < share))
    rows, notes = np.concatenate(kept_rows), []
    if len(rows) < num_searched and (squared_dense_range is None or squared_dense_range > search.max_range**2):
        notes = [
            f"thinned from {num_searched:,} to {len(rows):,} points for detection: give one scan at a time, or a "
            "part of it"
        ]
    return scan.with_points_of(rows), notes


def _squared(points: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """(n,) m2: squared distances of points (n, 3) from origin (3,)."""
    offset = points - origin
    return np.einsum("ni,ni->n", offset, offset)


def _dense_below(histogram: np.ndarray, edges: np.ndarray) -> float:
    """The squared distance, m2, below which points are kept with a probability proportional to their squared distance,
    so that `_MOST_AROUND` points remain.

    histogram: counts of the squared distances of all points in the bins between `edges`, m2.
    """
    weighted_counts = np.cumsum(histogram * (edges[1:] + edges[:-1]) / 2)
    kept_counts = weighted_counts / edges[1:] + histogram.sum() - np.cumsum(histogram)
    valid_bins = np.flatnonzero(kept_counts <= _MOST_AROUND)
    return float(edges[1 + valid_bins[0]] if len(valid_bins) else weighted_counts[-1] / _MOST_AROUND)


def _leveled(scan: Scan) -> np.ndarray:
    """The scan's points (n, 3) m in the level frame, column-major in memory."""
    R_level_input = scan.R_level_input
    columns = np.ascontiguousarray(scan.points.T)
    return (columns if np.array_equal(R_level_input, np.eye(3)) else R_level_input @ columns).T


def _near(points: np.ndarray, origin: np.ndarray | None, search: Search) -> np.ndarray:
    """A subsample of points (n, 3) m within the range of the search, for the estimate of the up direction."""
    rows = np.arange(len(points))
    if origin is not None:
        squared = (points[:, 0] - origin[0]) ** 2 + (points[:, 1] - origin[1]) ** 2
        near_rows = np.flatnonzero(squared < (search.max_range + _BEYOND) ** 2)
        rows = near_rows if len(near_rows) else rows
    rows = rows[:: -(-len(rows) // _ENOUGH_FOR_UP)]
    return np.stack([values[rows] for values in points.T]).T


def _in_input(box: Box, scan: Scan, input_scan: Scan) -> Box:
    """A box in the level frame as a box in the input frame, upright along the up axis of `input_scan`. If the scan is
    tilted, the box is enlarged so that it still contains the person."""
    R_boxes_level = input_scan.R_boxes_input @ scan.R_level_input.T
    center, size, yaw = R_boxes_level @ box.center, box.size, box.yaw
    if not np.allclose(R_boxes_level, np.eye(3)):
        # if the input's up axis is not z, the level frame of a tilted sensor is also rotated about its up axis
        forward = R_boxes_level @ [np.cos(box.yaw), np.sin(box.yaw), 0]
        yaw = float(np.arctan2(forward[1], forward[0]))
        size = np.abs(rotation_about("z", yaw).T @ R_boxes_level @ rotation_about("z", box.yaw)) @ box.size
    center = input_scan.R_boxes_input.T @ center
    return rounded(replace(box, center=center, size=size, yaw=yaw))
