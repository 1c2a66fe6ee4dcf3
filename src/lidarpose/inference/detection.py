"""`detect`: the people in a whole scan. The detector scores places where somebody may stand, the verifier says which of
the best are people, and the default network poses these.

Legend: D detections.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from numbers import Real
from typing import TYPE_CHECKING, Any

import numpy as np

from lidarpose.errors import InputError, check_int, counted
from lidarpose.geometry import UP_AXES, rotation_about, rotation_from_up, up_text
from lidarpose.inference.background import is_static, read_background
from lidarpose.inference.checks import flat_along_another_axis, flat_axis, scan_unit_warning, unlikely_origin
from lidarpose.inference.inputs import as_origin
from lidarpose.inference.known_places import KnownPlaces
from lidarpose.inference.scan import Scan, read_scan
from lidarpose.inference.verification import rounded, verified
from lidarpose.io.boxes import Boxes
from lidarpose.models.detector.detector import MAX_RANGE, Detections, Detector
from lidarpose.models.detector.ground import estimate_up
from lidarpose.sample import MIN_POINTS, Box

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

# detections that may be verified, and posed
MOST_POSED = 60
# a scan of more points is thinned, of an unknown sensor and of a known one; what is farther away than this beyond the
# range goes first, m; points looked at in one go, and bins of their distances
_MOST_POINTS, _MOST_AROUND, _BEYOND = 1_500_000, 400_000, 15.0
_CHUNK, _DISTANCES = 1_000_000, 4096
# a smaller share of points that are copies of others changes nothing
_FEW_COPIES = 0.01
# points that tell which way is up
_ENOUGH_FOR_UP = 250_000
# less of a scan on its background, as a share, and it is the background of something else
_LEAST_STATIC = 0.2


@dataclass(frozen=True, kw_only=True, eq=False)
class Search:
    """How people are searched for, see `detect`. background (k, 3) m: static points in the scan's frame; detector: None
    for the bundled one."""

    max_range: float = MAX_RANGE
    min_score: float | None = None
    max_people: int | None = None
    background: np.ndarray | None = None
    detector: Detector | None = None

    def __post_init__(self):
        if not _is_number(self.max_range) or not 0 < self.max_range < np.inf:
            raise InputError(f"range: expected meters, more than 0, got {self.max_range!r}")
        if self.min_score is not None and not (_is_number(self.min_score) and 0 <= self.min_score <= 1):
            raise InputError(f"min score: expected a probability from 0 to 1, got {self.min_score!r}")
        if self.max_people is not None:
            check_int("max people", self.max_people, least=1)


def detect(
    points: "str | os.PathLike | ArrayLike",
    *,
    sensor_origin: "np.ndarray | Sequence[float] | str | None" = None,
    up: str | Sequence[float] | None = "z",
    columns: int | None = None,
    max_range: float | None = None,
    min_score: float | None = None,
    max_people: int | None = None,
    background: "str | os.PathLike | Sequence | ArrayLike | None" = None,
) -> Boxes:
    """The people in a whole scan, surest first, as boxes that `predict` takes.

    Args:
        points: a point file, or (n, 3+) m in any frame.
        sensor_origin: (x, y, z) m in that frame, or "unknown"; None means 0, 0, 0.
        up: what is up there, as in `predict`; None means z.
        columns: values a row of a .bin file.
        max_range: how far from the sensor people are searched, m, level, None for 40; of an unknown sensor everywhere.
        min_score: people with a lower score are left out; None for the detector's own, at which about one false person
            a scan is found.
        max_people: only so many, the surest.
        background: what stands still about a sensor that does not move, and is not searched: a file or array (k, 3) m
            of static points (see `learn_background`), or several scans or a folder of them, of which it is learned.

    Returns:
        `Boxes` in the frame of the points, each with `score`, the probability that it is a person, and `mounted`,
        whether the person rides or sits in a wheelchair; `warnings` say what looks wrong about the scan, and `up` is
        what is up after all, of a tilted sensor a direction.

    Raises:
        InputError: a file that cannot be read, or an option of another type.
    """
    up = "z" if up is None else up
    rotation_from_up(up)
    search = search_options(min_score, max_range, max_people, background, columns)
    origin = np.zeros(3) if sensor_origin is None else as_origin(sensor_origin)
    scan = Scan(points=np.zeros((0, 3)), origin=origin, up=up_text(up))
    result = search_alone(read_scan(scan, points, columns), search)
    return Boxes(
        result.boxes or [],
        source=result.source,
        warnings=result.warnings,
        detector=detector_version(),
        up=result.up,
    )


def search_options(
    min_score: Any,
    max_range: Any,
    max_people: Any,
    background: Any,
    columns: int | None,
    topic: str | None = None,
    meta: str | os.PathLike | None = None,
) -> Search:
    """A search with its background read; max_range None: the default. Raises InputError."""
    # arrays without axes are numbers too
    min_score, max_range, max_people = (
        value.item() if getattr(value, "shape", None) == () else value for value in (min_score, max_range, max_people)
    )
    max_range = MAX_RANGE if max_range is None else max_range
    search = Search(max_range=max_range, min_score=min_score, max_people=max_people)
    if background is None:
        return search
    return replace(search, background=read_background(background, columns=columns, topic=topic, meta=meta))


def find_people(scan: Scan, search: Search) -> Scan:
    """The scan with the boxes of the people in it, surest first, `detected_rows`, and what looks wrong among its
    warnings; without the place of a sensor that cannot have been there, and with the direction that is up after all."""
    return verify_people(detect_places(scan, search), search)


def search_alone(scan: Scan, search: Search) -> Scan:
    """`find_people` of a scan that is no frame of a recording, with `other_up_axis` where nobody is found."""
    places = detect_places(scan, search)
    result = verify_people(places, search)
    if result.boxes or not (hint := other_up_axis(places, search)):
        return result
    # what else looks odd follows from the axis
    return replace(result, warnings=(*scan.warnings, hint))


def other_up_axis(places: "DetectedScan", search: Search) -> str | None:
    """A scan in which nobody was found -> a line for the user where people are found with another axis up."""
    input_scan, detections = places.given, places.detections
    if detections is None or detections.has_ground and flat_axis(places.scan.points) == input_scan.upright_axis:
        # outdoors: the axis is right
        return None
    if scan_unit_warning(places.level, len(input_scan.points)) and not flat_along_another_axis(places.scan):
        # in other units nobody is found with any axis up
        return None
    other_axes = [up for up in UP_AXES if up != input_scan.up]
    boxes = {up: find_people(replace(input_scan, up=up), search).boxes or [] for up in other_axes}
    best_axis = max(other_axes, key=lambda up: sum(box.score or 0.0 for box in boxes[up]))
    if not boxes[best_axis]:
        return None
    people = counted(len(boxes[best_axis]), "person", "people")
    return f"nobody is found with up {input_scan.up}, but {people} with up {best_axis}: try up {best_axis}"


@dataclass(frozen=True, kw_only=True, eq=False)
class DetectedScan:
    """A scan in which people were detected, but not verified: as given, and as it is searched; its points in the level
    frame (n, 3) m; the detections there, None of a scan without points; moving (n,) bool, where a background is known.
    """

    given: Scan
    scan: Scan
    level: np.ndarray
    detections: Detections | None
    moving: np.ndarray | None = None


def detect_places(scan: Scan, search: Search) -> DetectedScan:
    """The first half of `find_people`, which depends on no other frame."""
    full_scan, count = scan, len(scan.points)
    input_scan, notes = _thinned(scan, search)
    input_scan = replace(input_scan, points=_distinct(input_scan.points))
    scan, warnings = input_scan, [*scan.warnings, *notes]
    if len(scan.points) < MIN_POINTS:
        scan = replace(scan, warnings=(*warnings, f"under {MIN_POINTS} points"))
        return DetectedScan(given=input_scan, scan=scan, level=scan.points, detections=None)
    level = _leveled(scan)
    # what else looks odd follows from wrong axes or units
    if frame_warning := flat_along_another_axis(scan):
        warnings.append(frame_warning)
    origin = None if scan.origin is None else scan.R_level_input @ scan.origin
    up = estimate_up(_near(level, origin, search), origin)
    if up is not None:
        degrees = np.degrees(np.arccos(np.clip(up[2] / np.linalg.norm(up), -1, 1)))
        direction = np.round(up @ scan.R_level_input, 3)
        warnings.append(
            f"the ground leans by {degrees:.0f} degrees, which is taken for a tilt of the sensor: say it by "
            f"up={','.join(f'{value:g}' for value in direction)}"
        )
        scan = replace(scan, up=up_text(up @ scan.R_level_input))
        level = _leveled(scan)
        origin = None if scan.origin is None else scan.R_level_input @ scan.origin
    # level: a scan that leans is as tall as one in other units
    if not frame_warning and (frame_warning := scan_unit_warning(level, count)):
        warnings.append(frame_warning)
    if origin is not None and (warning := unlikely_origin(level, origin)):
        # from the beginning: of an unknown sensor other points are kept, and what is up is told by others
        scan_warnings = full_scan.warnings if frame_warning else (*full_scan.warnings, warning)
        return replace(detect_places(replace(full_scan, origin=None, warnings=scan_warnings), search), given=input_scan)
    is_moving = None
    if search.background is not None:
        is_moving = ~is_static(scan.points, search.background)
        if (static_share := 1 - is_moving.mean()) < _LEAST_STATIC:
            warnings.append(
                f"only {static_share:.0%} of the points lie on the background: is it of this sensor, in this frame?"
            )
        elif not is_moving.any():
            warnings.append(
                "all points lie on the background, so nobody is looked for: was it learned from this scan alone? "
                "record for ten seconds or more"
            )
    detector = search.detector or _detector()
    detections = detector.detect(level, origin, max_range=search.max_range, limit=MOST_POSED, moving=is_moving)
    if not (detections.has_ground or frame_warning):
        warnings.append("no ground was found, and people are searched without it: is the up axis right?")
    scan = replace(scan, warnings=tuple(warnings))
    return DetectedScan(given=input_scan, scan=scan, level=level, detections=detections, moving=is_moving)


def verify_people(places: DetectedScan, search: Search, known: KnownPlaces | None = None) -> Scan:
    """The second half of `find_people`. known: of a recording's frames before; with it the scan has `pelvises`,
    `verified` and `rejected`, too."""
    scan, input_scan, detections = places.scan, places.given, places.detections
    if detections is None:
        return replace(scan, boxes=[], detected_rows=[])
    # the boxes of a frame that leans are larger than their people: these are looked for anew
    is_tilted = not np.allclose(input_scan.R_boxes_input, scan.R_level_input)
    origin = None if scan.origin is None else scan.R_level_input @ scan.origin
    known_level = None if known is None or is_tilted else known.level(scan.R_level_input)
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
    if known is None:
        return result
    return replace(
        result,
        pelvises=people.pelvises @ scan.R_level_input,
        verified=people.verified,
        rejected=people.rejected @ scan.R_level_input,
    )


def least_score(search: Search) -> float:
    """The score below which detections are left out."""
    if search.min_score is not None:
        return search.min_score
    return float((search.detector or _detector()).header["default_score"])


def detector_version() -> str:
    """Of the bundled detector."""
    return str(_detector().header["version"])


@cache
def _detector() -> Detector:
    return Detector()


# ---- the scan


def _thinned(scan: Scan, search: Search) -> tuple[Scan, list[str]]:
    """The scan with about `_MOST_AROUND` points, and a note where more than what is dense is thinned.

    Around a sensor what is beyond the range goes, and of what is nearer than some distance so much that nobody has
    fewer points than a person has who stands there. Of an unknown sensor `_MOST_POINTS` stay, drawn evenly.
    """
    points, origin, count = scan.points, scan.origin, len(scan.points)
    if count <= (_MOST_POINTS if origin is None else _MOST_AROUND):
        return scan, []
    # in pieces: of 10^8 points a row of numbers more would take a gigabyte
    pieces = [slice(start, start + _CHUNK) for start in range(0, count, _CHUNK)]
    squared_reach, num_searched, squared_dense_range = (search.max_range + _BEYOND) ** 2, count, None
    if origin is not None:
        histogram = sum(
            np.histogram(_squared(points[piece], origin), _DISTANCES, (0, squared_reach))[0] for piece in pieces
        )
        if (num_in_range := int(np.sum(histogram))) >= MIN_POINTS:
            num_searched, squared_dense_range = num_in_range, _dense_below(np.asarray(histogram), squared_reach)
    rng, kept_rows = np.random.default_rng(0), []
    for piece in pieces:
        share: np.ndarray | float = _MOST_POINTS / count
        if origin is not None and squared_dense_range is not None:
            squared = _squared(points[piece], origin)
            share = np.where(squared < squared_reach, squared / squared_dense_range, 0.0)
        kept_rows.append(piece.start + np.flatnonzero(rng.random(len(points[piece])) < share))
    rows, notes = np.concatenate(kept_rows), []
    if len(rows) < num_searched and (squared_dense_range is None or squared_dense_range > search.max_range**2):
        notes = [
            f"thinned from {num_searched:,} to {len(rows):,} points to search them: give one scan at a time, or a part"
        ]
    return replace(scan, points=points[rows]), notes


def _distinct(points: np.ndarray) -> np.ndarray:
    """Points (n, 3) m without copies: a second return is mostly the first one again, and the detector counts points."""
    factors = (0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9)
    keys = np.zeros(len(points), np.uint64)
    for axis, factor in zip(np.ascontiguousarray(points.T, np.float64).view(np.uint64), factors, strict=True):
        # the upper bits are the ones that differ
        keys = (keys ^ axis ^ (axis >> np.uint64(29))) * np.uint64(factor)
    ordered = np.sort(keys)
    if np.count_nonzero(ordered[1:] == ordered[:-1]) <= _FEW_COPIES * len(points):
        return points
    return points[np.sort(np.unique(keys, return_index=True)[1])]


def _squared(points: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """(n,) m2: squared distances of points (n, 3) from origin (3,)."""
    offset = points - origin
    return np.einsum("ni,ni->n", offset, offset)


def _dense_below(histogram: np.ndarray, squared_reach: float) -> float:
    """The squared distance, m2, up to which points stay in proportion to their own, so that `_MOST_AROUND` stay.

    histogram: of all squared distances up to `squared_reach`, m2.
    """
    edges = np.linspace(0, squared_reach, len(histogram) + 1)
    weighted_counts = np.cumsum(histogram * (edges[1:] + edges[:-1]) / 2)
    kept_counts = weighted_counts / edges[1:] + histogram.sum() - np.cumsum(histogram)
    valid_bins = np.flatnonzero(kept_counts <= _MOST_AROUND)
    return float(edges[1 + valid_bins[0]] if len(valid_bins) else weighted_counts[-1] / _MOST_AROUND)


def _leveled(scan: Scan) -> np.ndarray:
    """The scan's points (n, 3) m in the level frame, one axis after the other in memory."""
    R_level_input = scan.R_level_input
    columns = np.ascontiguousarray(scan.points.T)
    return (columns if np.array_equal(R_level_input, np.eye(3)) else R_level_input @ columns).T


def _near(points: np.ndarray, origin: np.ndarray | None, search: Search) -> np.ndarray:
    """Enough of the points (n, 3) m that may lie under the people searched for."""
    rows = np.arange(len(points))
    if origin is not None:
        squared = (points[:, 0] - origin[0]) ** 2 + (points[:, 1] - origin[1]) ** 2
        near_rows = np.flatnonzero(squared < (search.max_range + _BEYOND) ** 2)
        rows = near_rows if len(near_rows) else rows
    rows = rows[:: -(-len(rows) // _ENOUGH_FOR_UP)]
    return np.stack([values[rows] for values in points.T]).T


def _in_input(box: Box, scan: Scan, input_scan: Scan) -> Box:
    """A level box as a box of the input, along the axis that `input_scan` says is up. In a frame that leans it is
    larger, so that it still holds the person."""
    R_boxes_level = input_scan.R_boxes_input @ scan.R_level_input.T
    center, size, yaw = R_boxes_level @ box.center, box.size, box.yaw
    if not np.allclose(R_boxes_level, np.eye(3)):
        # the level frame of a tilted sensor is turned about its up axis, too, where the input's is not z
        forward = R_boxes_level @ [np.cos(box.yaw), np.sin(box.yaw), 0]
        yaw = float(np.arctan2(forward[1], forward[0]))
        size = np.abs(rotation_about("z", yaw).T @ R_boxes_level @ rotation_about("z", box.yaw)) @ box.size
    center = input_scan.R_boxes_input.T @ center
    return rounded(replace(box, center=center, size=size, yaw=yaw))


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)
