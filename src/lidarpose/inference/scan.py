"""A scan with people: points, and boxes unless it is a crop of one person; reading and cropping."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from lidarpose.errors import InputError, check_int
from lidarpose.geometry import rotation_from_up, rotation_of_boxes, rows_near, upright_axis
from lidarpose.inference.inputs import as_points, own_times, rounding_warning, usable_rows
from lidarpose.inference.newest import newest_of_person, newest_scan
from lidarpose.io.files import file_error
from lidarpose.io.point_cloud import Cloud, read_points
from lidarpose.io.point_times import as_point_times
from lidarpose.sample import FARTHEST, Box

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


@dataclass(frozen=True, kw_only=True, eq=False)
class Scan:
    """A scan whose people are to be posed, in the input frame.

    points (n, 3) m; boxes: of the people, None for a crop of one person; origin: sensor position (3,) m, None if
    unknown; up: up axis or direction of the input, see `rotation_from_up`; warnings: from reading; source: a name for
    reports. Boxes are upright along the input's up axis, or along the axis nearest to it if `up` is a direction.
    After detection, detected_rows holds for each box the rows (k,) of the person's points, which the enlarged box of a
    tilted scan does not determine. In recordings, pelvises (N, 3) m: approximate pelvis positions of the people in the
    boxes; verified (N,) bool: whether the box was verified in this scan; rejected (R, 3) m: positions of detections
    that the verifier rejected; point_times (n,) s: when each point was measured, relative to any time, None if unknown;
    is_newest (n,) bool: in a cloud of several scans, which points are of the newest.
    """

    points: np.ndarray
    boxes: list[Box] | None = None
    origin: np.ndarray | None = None
    up: str = "z"
    warnings: tuple[str, ...] = ()
    source: str | None = None
    detected_rows: list[np.ndarray] | None = None
    pelvises: np.ndarray | None = None
    verified: np.ndarray | None = None
    rejected: np.ndarray | None = None
    point_times: np.ndarray | None = None
    is_newest: np.ndarray | None = None

    @cached_property
    def R_level_input(self) -> np.ndarray:
        return rotation_from_up(self.up)

    @property
    def level_origin(self) -> np.ndarray | None:
        """The sensor position (3,) m in the level frame; None if it is unknown."""
        return None if self.origin is None else self.R_level_input @ self.origin

    @property
    def upright_axis(self) -> str:
        """The axis of the input that is nearest to vertical, "x", "y" or "z"."""
        return upright_axis(self.up)[-1]

    @property
    def R_boxes_input(self) -> np.ndarray:
        return rotation_of_boxes(self.up)

    def level_boxes(self) -> list[Box]:
        """The boxes rotated to z up, in the frame of `box_points`."""
        return [replace(box, center=self.R_boxes_input @ box.center) for box in self.boxes or []]

    def box_points(self) -> np.ndarray:
        """The points (n, 3) m in the frame in which the boxes are upright along z."""
        return _turned(self.points, self.R_boxes_input)

    @cached_property
    def rows(self) -> list[np.ndarray]:
        """For each box, the rows of the points inside it."""
        if self.detected_rows is not None:
            return self.detected_rows
        return rows_inside(self.level_boxes(), self.box_points())

    def with_points_of(self, rows: np.ndarray | None) -> Scan:
        """The scan with only these rows of its points; None keeps all."""
        if rows is None:
            return self
        arrays = {name: getattr(self, name) for name in ("points", "point_times", "is_newest")}
        return replace(self, **{name: array[rows] for name, array in arrays.items() if array is not None})

    def with_newest(self) -> Scan:
        """The scan with `is_newest` computed from the times of its points, which are dropped."""
        if self.point_times is None:
            return self
        is_newest = newest_scan(_turned(self.points, self.R_level_input), self.point_times, self.level_origin)
        return replace(self, point_times=None, is_newest=is_newest)

    def newest_clouds(self) -> list[np.ndarray | None] | None:
        """The newest points of each person in the level frame, see `newest_of_person`; None for a single scan."""
        if self.is_newest is None:
            return None
        clouds = [newest_of_person(self.points[rows], self.is_newest[rows]) for rows in self.rows]
        return [None if cloud is None else _turned(cloud, self.R_level_input) for cloud in clouds]

    def clouds(self) -> list[np.ndarray]:
        """The points of each person in the level frame (z up); for a crop, all points."""
        # rotate only the points of people, not the whole scan
        clouds = [self.points] if self.boxes is None else [self.points[rows] for rows in self.rows]
        return [_turned(cloud, self.R_level_input) for cloud in clouds]


def _turned(points: np.ndarray, R: np.ndarray) -> np.ndarray:
    """points (n, 3) rotated by R; the input itself if R is the identity, which saves much time for whole scans."""
    return points if np.array_equal(R, np.eye(3)) else points @ R.T


def read_scan(
    scan: Scan, points: str | os.PathLike | ArrayLike, columns: int | None, point_times: ArrayLike | None = None
) -> Scan:
    """The scan with the valid points of a file or an array (n, 3+) m, when they were measured, the file's name, and
    warnings from reading. point_times: (n,) s, of an array.

    Raises InputError for a file without valid points.
    """
    if not isinstance(points, str | os.PathLike):
        if columns is not None:
            check_int("columns", columns, least=3, hint=" (x y z first)")
        return scan_of_array(scan, points, point_times)
    if point_times is not None:
        problem = "point_times are for arrays, a file has its own"
        raise InputError(f"{problem}: omit them, or give the points as an array")
    source = os.fsdecode(points)
    cloud = read_points(source, columns=columns)
    scan = replace(_with_cloud(scan, cloud), source=source)
    if not len(scan.points):
        problem = (
            f"only coordinates beyond {FARTHEST:,.0f} m" if cloud.points.any() else "only 0,0,0, which are not returns"
        )
        raise file_error(source, f"expected points in meters, got {problem}: export it again")
    return scan


def scan_of_array(scan: Scan, points: ArrayLike, point_times: ArrayLike | None = None) -> Scan:
    """The scan with the valid points of an array (n, 3+) m or a `Cloud`, when they were measured, and warnings.
    point_times: (n,) s; None means those of a `Cloud`."""
    array = as_points(points)
    times = own_times(points) if point_times is None else point_times
    return _with_cloud(scan, Cloud(points=array, point_times=as_point_times(times, len(array))))


def _with_cloud(scan: Scan, cloud: Cloud) -> Scan:
    """The scan with the valid points of a cloud."""
    rows, notes = usable_rows(cloud.points)
    scan = replace(scan, points=cloud.points, point_times=cloud.point_times).with_points_of(rows)
    notes += filter(None, [rounding_warning(scan.points)])
    return replace(scan, warnings=(*cloud.warnings, *notes))


def rows_inside(boxes: list[Box], points: np.ndarray) -> list[np.ndarray]:
    """points (n, 3) m, z up -> for each `Box`, the rows (k,) of the points inside it, ascending."""
    centers = np.array([box.center for box in boxes]).reshape(-1, 3)
    # twice the distance from the center to a corner, for any yaw
    reach = np.array([np.hypot(*box.size[:2]) for box in boxes])
    near_rows = rows_near(centers, points, reach)
    return [rows[box.contains(points[rows])] for box, rows in zip(boxes, near_rows, strict=True)]
