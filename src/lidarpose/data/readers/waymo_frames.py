"""Waymo's frames, independent of the file format: range images to points, keypoints and boxes to people.

Frames of reference: a laser's own (x along its azimuth 0, z up); the vehicle's (x forward, y left, z up) at the time of
the frame's pose, in which boxes and keypoints are labeled; the world's. Lengths in meters, angles in radians. H rows
and W columns of a range image, n points, J = 14 joints.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from lidarpose.data.readers.base import Skipped, labeled_sample
from lidarpose.errors import InputError
from lidarpose.geometry import from_spherical, is_rotation, transform_points
from lidarpose.sample import HIDDEN, SEEN, UNLABELED, Box, LabeledSample, within_reach
from lidarpose.skeleton import WAYMO14

# number of the laser on the roof
TOP = 1
# margin of the labeled box within which points are kept, m on each side
MARGIN = 0.2

# KeypointType -> the joint of WAYMO14; 19, the forehead, exists only in camera labels
_JOINTS = {
    kind: WAYMO14.index(name)
    for first, side in ((5, "left"), (13, "right"))
    for kind, name in enumerate((f"{side}_{joint}" for joint in "shoulder elbow wrist hip knee ankle".split()), first)
} | {1: WAYMO14.index("nose"), 20: WAYMO14.index("head_center")}
_KINDS = {1: "vehicle", 2: "pedestrian", 3: "sign", 4: "cyclist"}

# reasons for skipping a person, in both versions of the dataset
BAD_LABEL = "label in another format"
BAD_IMAGE = "range image cannot be read"
BAD_FRAME = "frame cannot be read"


def is_image(sizes: Sequence[int | None], count: int) -> bool:
    """Whether a range image of `count` values can have these sizes: rows, columns, channels."""
    # with Python's integers: the product of damaged sizes may overflow to 0 in 64 bits
    known_sizes = [size for size in sizes if size is not None]
    return len(sizes) == len(known_sizes) == 3 and min(known_sizes) >= 1 and count == math.prod(known_sizes)


def transform(values: Iterable[float] | None, what: str) -> np.ndarray:
    """16 numbers, row-major -> T (4, 4), a rigid transform. Raises InputError for anything else."""
    try:
        matrix = np.array([] if values is None else values, float)
    except (TypeError, ValueError):
        raise InputError(f"{what} must be 16 numbers, a 4 x 4 transform, got something else") from None
    if matrix.shape != (16,) or not np.isfinite(matrix).all():
        raise InputError(f"{what} must be 16 numbers, a 4 x 4 transform, got {np.isfinite(matrix).sum()}")
    matrix = matrix.reshape(4, 4)
    if not is_rotation(matrix[:3, :3]) or np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise InputError(f"{what} must be a rotation and a translation, got another matrix")
    return matrix


@dataclass(frozen=True, kw_only=True, eq=False)
class Calibration:
    """A laser's calibration. T_vehicle_laser (4, 4); inclinations (H,) rad, lowest beam first as on disk, or None: H
    beams evenly spaced from low to high, rad."""

    laser: int
    T_vehicle_laser: np.ndarray
    inclinations: np.ndarray | None
    low: float | None
    high: float | None

    def __post_init__(self):
        if self.inclinations is None and None in (self.low, self.high):
            raise InputError(f"has no beam inclinations of laser {self.laser}")

    def rows(self, height: int) -> np.ndarray:
        """(H,) rad: the inclination of each row of a range image. The table is reversed: row 0 is its last beam. Raises
        InputError if the table has another length."""
        beams = self.inclinations
        if beams is None:
            low, high = float(self.low or 0), float(self.high or 0)
            beams = low + (np.arange(height) + 0.5) / height * (high - low)
        if len(beams) != height or not np.isfinite(beams).all():
            raise InputError(f"laser {self.laser} has {len(beams)} inclinations, its range image {height} rows")
        return beams[::-1]


def points_of_image(
    image: np.ndarray, calibration: Calibration, pixel_poses: np.ndarray | None, T_world_vehicle: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """A range image (H, W) m -> points (n, 3) float64 m in the vehicle's frame, and their rows (n,).

    Pixels without a return are 0. pixel_poses (H, W, 6): roll, pitch, yaw, x, y, z of the vehicle in the world at the
    time of each pixel, None for no motion compensation; with them, points are transformed to the vehicle's frame at
    T_world_vehicle (4, 4). Both returns of a laser share the poses. Raises InputError if sizes do not fit.
    """
    height, width = image.shape
    # NaN and infinity are not returns, either
    row, column = np.nonzero((image > 0) & (image < np.inf))
    T = calibration.T_vehicle_laser
    # columns cover the azimuths of the vehicle's axes, not of the laser's own
    azimuth = ((width - column - 0.5) / width * 2 - 1) * np.pi - np.arctan2(T[1, 0], T[0, 0])
    points = from_spherical(image[row, column].astype(float), azimuth, calibration.rows(height)[row])
    points = transform_points(T, points)
    if pixel_poses is None:
        return points, row
    if pixel_poses.shape != (height, width, 6):
        raise InputError(f"pixel poses are {pixel_poses.shape}, the range image is {height} x {width}")
    roll, pitch, yaw, *shift = pixel_poses[row, column].astype(float).T
    x, y, z = points.T
    # about x, then y, then z
    y, z = _turned(y, z, roll)
    z, x = _turned(z, x, pitch)
    x, y = _turned(x, y, yaw)
    world_points = np.stack([x + shift[0], y + shift[1], z + shift[2]])
    return np.linalg.solve(T_world_vehicle[:3, :3], world_points - T_world_vehicle[:3, 3, None]).T, row


def _turned(a: np.ndarray, b: np.ndarray, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    c, s = np.cos(angle), np.sin(angle)
    return c * a - s * b, s * a + c * b


@dataclass(frozen=True, kw_only=True, eq=False)
class LabeledPerson:
    """A person with keypoints in one frame, in the vehicle's frame. joints (14, 3) m, NaN if not labeled, and their
    labels (14,); kind: Waymo's type of the box; counted: number of points in the box according to the label."""

    track: str
    joints: np.ndarray
    labels: np.ndarray
    box: Box
    kind: int
    counted: int | None


class Problem(NamedTuple):
    """The reason why a person, or all people of a frame, are left out, with details."""

    reason: str
    why: str = ""
    track: str = ""


def person(
    track: str,
    keypoints: Iterable[tuple[int, tuple[float, float, float], bool]],
    box: tuple[float, ...] | np.ndarray | None,
    kind: int = 0,
    counted: int | None = None,
) -> LabeledPerson | Problem:
    """A person from labels. keypoints: (type, x y z, whether occluded) each, in any order; types that the skeleton does
    not have are ignored; box: center, size (length, width, height) and heading, 7 numbers."""
    joints, labels = np.full((len(WAYMO14), 3), np.nan), np.full(len(WAYMO14), UNLABELED, np.uint8)
    for keypoint, position, is_hidden in keypoints:
        if keypoint in _JOINTS and within_reach(np.asarray(position)):
            joints[_JOINTS[keypoint]] = position
            labels[_JOINTS[keypoint]] = HIDDEN if is_hidden else SEEN
    if box is None:
        return Problem("keypoints without a box", track=track)
    if (labels == UNLABELED).all():
        return Problem("no joint is labeled", track=track)
    try:
        labeled_box = Box(center=np.asarray(box[:3]), size=np.asarray(box[3:6]), yaw=box[6], id=track)
    except InputError as error:
        return Problem(BAD_LABEL, str(error), track)
    return LabeledPerson(track=track, joints=joints, labels=labels, box=labeled_box, kind=kind, counted=counted)


@dataclass(kw_only=True, eq=False)
class Frame:
    """A frame and the people labeled in it, to which range images are added one by one, in any order.

    sequence; timestamp (us); start: timestamp of the sequence's first frame; calibrations by laser; T_world_vehicle
    (4, 4), None if missing.
    """

    sequence: str
    timestamp: int
    start: int
    people: list[LabeledPerson | Problem]
    calibrations: dict[int, Calibration]
    T_world_vehicle: np.ndarray | None = None
    _problem: Problem | None = None
    # (laser, return) -> points and rings in the box of each person
    _crops: dict[tuple[int, int], list[tuple[np.ndarray, np.ndarray]]] = field(default_factory=dict)

    @property
    def wanted(self) -> bool:
        """Whether range images are still needed."""
        return self._problem is None and any(isinstance(person, LabeledPerson) for person in self.people)

    def fail(self, reason: str, why: str = "") -> None:
        """Leaves out all people of the frame; the first reason is kept."""
        self._problem = self._problem or Problem(reason, why)

    def add(self, laser: int, which: int, image: np.ndarray, pixel_poses: np.ndarray | None) -> None:
        """Adds return number `which` of a laser: range image (H, W) m and its pixel poses (H, W, 6), None for none."""
        if not self.wanted or (laser, which) in self._crops:
            return
        try:
            if self.T_world_vehicle is None:
                return self.fail("no vehicle pose of the frame")
            if laser == TOP and pixel_poses is None:
                return self.fail("no pixel poses of the top laser")
            if laser not in self.calibrations:
                return self.fail(BAD_IMAGE, f"laser {laser} has no calibration")
            points, row = points_of_image(image, self.calibrations[laser], pixel_poses, self.T_world_vehicle)
        except InputError as error:
            return self.fail(BAD_IMAGE, str(error))
        # the lowest beam is ring 0; only the top laser's rows are kept
        ring = len(image) - 1 - row if laser == TOP else np.full(len(row), -1)
        crops = self._crops[laser, which] = []
        for person in self.people:
            selection = person.box.contains(points, MARGIN) if isinstance(person, LabeledPerson) else slice(0)
            crops.append((points[selection], ring[selection]))

    def samples(self) -> Iterator[LabeledSample | Skipped]:
        """All people, in the order of their tracks; called after all images were added."""
        if self.wanted and not any(laser == TOP for laser, _ in self._crops):
            self.fail("no range image of the frame")
        for k, person in sorted(enumerate(self.people), key=lambda pair: pair[1].track):
            where = f"{self.sequence}/{self.timestamp}/{person.track}"
            problem = self._problem
            if isinstance(person, Problem):
                problem = person
            elif problem is None:
                points, ring = map(
                    np.concatenate, zip(*(self._crops[key][k] for key in sorted(self._crops)), strict=True)
                )
                if len(points):
                    yield self._sample(person, points, ring)
                    continue
                count_text = "" if person.counted is None else f"the label counts {person.counted}"
                problem = Problem("no points in the box", count_text)
            yield Skipped(problem.reason, f"{where}: {problem.why}" if problem.why else where)

    def _sample(self, person: LabeledPerson, points: np.ndarray, ring: np.ndarray) -> LabeledSample | Skipped:
        # the sensor is at the origin
        origin = self.calibrations[TOP].T_vehicle_laser[:3, 3]
        box = replace(person.box, center=person.box.center - origin)
        return labeled_sample(
            points - origin,
            person.joints - origin,
            WAYMO14,
            ring=ring.astype(np.int32),
            box=box,
            source=f"waymo/{_KINDS.get(person.kind, 'unknown')}",
            joint_labels=person.labels,
            sequence=self.sequence,
            frame=self.timestamp,
            track=person.track,
            time=(self.timestamp - self.start) / 1e6,
            centers={"box": box.center},
        )
