"""`detect`: the people in a whole scan. The detector scores places where somebody may stand; the default network poses
the best of them, and how sure it is of a pose goes into the score.

Legend: D detections, V those that were posed.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from numbers import Real
from typing import TYPE_CHECKING, Any

import numpy as np

from lidarpose.errors import InputError, check_int
from lidarpose.geometry import UP_AXES, rotation_about, rotation_from_up
from lidarpose.inference.background import is_static, read_background
from lidarpose.inference.checks import flat_along_another_axis, flat_axis, scan_unit_warning, unlikely_origin
from lidarpose.inference.inputs import as_origin, as_points, only_returns
from lidarpose.inference.scan import Scan, read_scan, up_text
from lidarpose.inference.verification import KnownPlaces, rounded, verified
from lidarpose.io.boxes import Boxes
from lidarpose.models.detector.detector import Detections, Detector
from lidarpose.models.detector.ground import estimate_up
from lidarpose.sample import MIN_POINTS, Box

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

# how far from the sensor people are searched, m
MAX_RANGE = 40.0
# detections that may be posed
MOST_POSED = 40
# a scan of more points is thinned, of an unknown sensor and of a known one; what is farther away than this beyond the
# range goes first, m; points looked at in one go, and bins of their distances
_MOST_POINTS, _MOST_AROUND, _BEYOND = 1_500_000, 400_000, 15.0
_CHUNK, _DISTANCES = 1_000_000, 4096
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
    up: str | Sequence[float] = "z",
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
        up: what is up there, as in `predict`.
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
    rotation_from_up(up)
    search = search_options(min_score, max_range, max_people, background, columns)
    origin = np.zeros(3) if sensor_origin is None else as_origin(sensor_origin)
    scan = Scan(points=np.zeros((0, 3)), origin=origin, up=up_text(up))
    if isinstance(points, str | os.PathLike):
        scan = read_scan(scan, points, columns)
    else:
        cloud, notes = only_returns(as_points(points))
        scan = replace(scan, points=cloud, warnings=tuple(notes))
    searched = search_alone(scan, search)
    return Boxes(
        searched.boxes or [],
        source=searched.source,
        warnings=searched.warnings,
        detector=detector_version(),
        up=searched.up,
    )


def search_options(
    min_score: float | None, max_range: float | None, max_people: int | None, background: Any, columns: int | None
) -> Search:
    """A search with its background read; max_range None: the default. Raises InputError."""
    max_range = MAX_RANGE if max_range is None else max_range
    search = Search(max_range=max_range, min_score=min_score, max_people=max_people)
    return search if background is None else replace(search, background=read_background(background, columns=columns))


def find_people(scan: Scan, search: Search, known: KnownPlaces | None = None) -> Scan:
    """The scan with the boxes of the people in it, surest first, `detected_rows`, and what looks wrong among its
    warnings; without the place of a sensor that cannot have been there, and with the direction that is up after all.

    known: of a recording's frames before; with it the scan has `pelvises`, `verified` and `rejected`, too.
    """
    return verify_people(detect_places(scan, search), search, known)


def search_alone(scan: Scan, search: Search) -> Scan:
    """`find_people` of a scan that is no frame of a recording, with `other_up_axis` where nobody is found."""
    places = detect_places(scan, search)
    searched = verify_people(places, search)
    if searched.boxes or not (hint := other_up_axis(places, search)):
        return searched
    # what else looks odd follows from the axis
    return replace(searched, warnings=(*scan.warnings, hint))


def other_up_axis(places: "Places", search: Search) -> str | None:
    """A scan in which nobody was found -> a line for the user where people are found with another axis up."""
    given, detections = places.given, places.detections
    if detections is None or detections.has_ground and flat_axis(places.scan.points) == given.upright_axis:
        # outdoors: the axis is right
        return None
    others = [up for up in UP_AXES if up != given.up]
    boxes = {up: find_people(replace(given, up=up), search).boxes or [] for up in others}
    best = max(others, key=lambda up: sum(box.score or 0.0 for box in boxes[up]))
    if not (number := len(boxes[best])):
        return None
    people = "a person" if number == 1 else f"{number} people"
    return f"nobody is found with up {given.up}, but {people} with up {best}: try up {best}"


@dataclass(frozen=True, kw_only=True, eq=False)
class Places:
    """A scan in which people were detected, but not verified: as given, and as it is searched; its points in the level
    frame (n, 3) m; the detections there, None of a scan without points."""

    given: Scan
    scan: Scan
    level: np.ndarray
    detections: Detections | None


def detect_places(scan: Scan, search: Search) -> Places:
    """The first half of `find_people`, which depends on no other frame."""
    whole, count = scan, len(scan.points)
    given, notes = _thinned(scan, search)
    scan, warnings = given, [*scan.warnings, *notes]
    if len(scan.points) < MIN_POINTS:
        scan = replace(scan, warnings=(*warnings, f"under {MIN_POINTS} points"))
        return Places(given=given, scan=scan, level=scan.points, detections=None)
    level = _leveled(scan)
    # what else looks odd follows from wrong axes or units
    # what else looks odd follows from wrong axes or units
    if wrong := flat_along_another_axis(scan):
        warnings.append(wrong)
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
    if not wrong and (wrong := scan_unit_warning(level, count)):
        warnings.append(wrong)
    if origin is not None and (warning := unlikely_origin(level, origin)):
        # from the beginning: of an unknown sensor other points are kept, and what is up is told by others
        own = whole.warnings if wrong else (*whole.warnings, warning)
        return replace(detect_places(replace(whole, origin=None, warnings=own), search), given=given)
    moving = None
    if search.background is not None:
        moving = ~is_static(scan.points, search.background)
        if (share := 1 - moving.mean()) < _LEAST_STATIC:
            warnings.append(
                f"only {share:.0%} of the points lie on the background: is it of this sensor, in this frame?"
            )
        elif not moving.any():
            warnings.append(
                "all points lie on the background, so nobody is looked for: was it learned from this scan alone? "
                "record for ten seconds or more"
            )
    detector = search.detector or _detector()
    detections = detector.detect(level, origin, max_range=search.max_range, limit=MOST_POSED, moving=moving)
    if not (detections.has_ground or wrong):
        warnings.append("no ground was found, and people are searched without it: is the up axis right?")
    scan = replace(scan, warnings=tuple(warnings))
    return Places(given=given, scan=scan, level=level, detections=detections)


def verify_people(places: Places, search: Search, known: KnownPlaces | None = None) -> Scan:
    """The second half of `find_people`."""
    scan, given = places.scan, places.given
    if places.detections is None:
        return replace(scan, boxes=[], detected_rows=[])
    # the boxes of a frame that leans are larger than their people: these are looked for anew
    leans = not np.allclose(given.R_boxes_input, scan.R_level_input)
    origin = None if scan.origin is None else scan.R_level_input @ scan.origin
    here = None if known is None or leans else known.level(scan.R_level_input)
    header = (search.detector or _detector()).header
    people = verified(places.detections, places.level, origin, header, least_score(search), search.max_people, here)
    boxes = [_in_input(box, scan, given) for box in people.boxes]
    searched = replace(scan, boxes=boxes, detected_rows=people.rows)
    if known is None:
        return searched
    return replace(
        searched,
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
    reach, number, dense = (search.max_range + _BEYOND) ** 2, count, None
    if origin is not None:
        by_distance = sum(np.histogram(_squared(points[piece], origin), _DISTANCES, (0, reach))[0] for piece in pieces)
        if (around := int(np.sum(by_distance))) >= MIN_POINTS:
            number, dense = around, _dense_below(np.asarray(by_distance), reach)
    rng, parts = np.random.default_rng(0), []
    for piece in pieces:
        share: np.ndarray | float = _MOST_POINTS / count
        if origin is not None and dense is not None:
            squared = _squared(points[piece], origin)
            share = np.where(squared < reach, squared / dense, 0.0)
        parts.append(piece.start + np.flatnonzero(rng.random(len(points[piece])) < share))
    rows, notes = np.concatenate(parts), []
    if len(rows) < number and (dense is None or dense > search.max_range**2):
        notes = [f"thinned from {number:,} to {len(rows):,} points to search them: give one scan at a time, or a part"]
    return replace(scan, points=points[rows]), notes


def _squared(points: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """(n,) m2: squared distances of points (n, 3) from origin (3,)."""
    away = points - origin
    return np.einsum("ni,ni->n", away, away)


def _dense_below(by_distance: np.ndarray, reach: float) -> float:
    """The squared distance, m2, up to which points stay in proportion to their own, so that `_MOST_AROUND` stay.

    by_distance: histogram of all squared distances up to reach, m2.
    """
    edges = np.linspace(0, reach, len(by_distance) + 1)
    inside = np.cumsum(by_distance * (edges[1:] + edges[:-1]) / 2)
    number = inside / edges[1:] + by_distance.sum() - np.cumsum(by_distance)
    enough = np.flatnonzero(number <= _MOST_AROUND)
    return float(edges[1 + enough[0]] if len(enough) else inside[-1] / _MOST_AROUND)


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
        near = np.flatnonzero(squared < (search.max_range + _BEYOND) ** 2)
        rows = near if len(near) else rows
    rows = rows[:: -(-len(rows) // _ENOUGH_FOR_UP)]
    return np.stack([values[rows] for values in points.T]).T


def _in_input(box: Box, scan: Scan, given: Scan) -> Box:
    """A level box as a box of the input, along the axis that `given` says is up. In a frame that leans it is larger, so
    that it still holds the person."""
    R_boxes_level = given.R_boxes_input @ scan.R_level_input.T
    center, size, yaw = R_boxes_level @ box.center, box.size, box.yaw
    if not np.allclose(R_boxes_level, np.eye(3)):
        # the level frame of a tilted sensor is turned about its up axis, too, where the input's is not z
        forward = R_boxes_level @ [np.cos(box.yaw), np.sin(box.yaw), 0]
        yaw = float(np.arctan2(forward[1], forward[0]))
        size = np.abs(rotation_about("z", yaw).T @ R_boxes_level @ rotation_about("z", box.yaw)) @ box.size
    center = given.R_boxes_input.T @ center
    return rounded(replace(box, center=center, size=size, yaw=yaw))


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)
