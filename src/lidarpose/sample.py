"""Data types shared by all packages: a person's points (`Sample`), joint positions (`Pose`), a bounding box (`Box`).

All are frozen, keyword-only and validated on construction. They compare by identity, since they hold arrays. Lengths
are in meters, angles in radians, z is up.
"""

from dataclasses import dataclass, field, replace
from numbers import Integral, Real
from typing import Any

import numpy as np

from lidarpose.errors import InputError
from lidarpose.geometry import rotation_from_up, up_text
from lidarpose.skeleton import SMPL24, Skeleton, as_skeleton

# maximum absolute coordinate, m: none on Earth is larger, and arithmetic on larger ones could overflow
FARTHEST = 1e9
# maximum error of a correct joint, m; confidence is the probability of an error below it
CONFIDENCE_RADIUS = 0.1
# minimum number of points for a pose
MIN_POINTS = 5
# minimum number of points of a second person for a crop to count as showing two people
FEWEST_OF_SECOND = 15
# probability of a person below which a crop shows none; probability of a second person above which it shows two
_NOBODY, _TWO = 0.05, 0.5
UNLIKE_A_PERSON = "unlike a person"
# frames per clip. Source: LiDARCap; NE, whose layers have this size
CLIP_FRAMES = 16
# optional values of a pose per joint
PER_JOINT = ("confidence", "spread", "visible", "in_range")
# optional values of a pose per person
PER_PERSON = ("person", "second_person")
# columns of result tables, which have one row per joint of each person; the column "person" numbers people, so the
# value `person` has another name here
JOINT_COLUMNS = ("joint", "x", "y", "z", *PER_JOINT, "person_probability", "second_person", "score", "mounted")
# joint labels: not labeled (position NaN), labeled but hidden or uncertain, labeled and visible
UNLABELED, HIDDEN, SEEN = 0, 1, 2


def within_reach(points: np.ndarray) -> np.ndarray:
    """points (..., 3) m -> (...) bool: whether a point is usable, neither NaN nor beyond `FARTHEST`."""
    return (np.abs(points) < FARTHEST).all(-1)


def clip_windows(run: np.ndarray, *, following: int = 0) -> np.ndarray:
    """Splits the rows (n,) of a run into clips (c, `CLIP_FRAMES` + following). The first `CLIP_FRAMES` columns do not
    overlap; `following` further rows follow each clip. Rows beyond the end repeat the last row. Source: LiDARCap."""
    rows = np.arange(0, len(run), CLIP_FRAMES)[:, None] + np.arange(CLIP_FRAMES + following)
    return run[np.minimum(rows, len(run) - 1)]


@dataclass(frozen=True, kw_only=True, eq=False)
class Pose:
    """3D joint positions of one or many people, with optional uncertainties.

    Args:
        joints: (..., J, 3) m, joint positions.
        skeleton: a `Skeleton`, or its name.
        confidence: (..., J) in [0, 1], probability that the joint is within 10 cm of the ground truth.
        spread: (..., J) m, expected distance between the joint and the ground truth.
        visible: (..., J) in [0, 1], probability that a point of the body lies within 18 cm of the joint.
        in_range: (..., J) bool, False if the joint lies at the end of the network's output range and may be farther out
            than predicted.
        person: (...) in [0, 1], probability that the cloud shows a person.
        second_person: (...) in [0, 1], probability that the cloud shows a second person as well.
        frame: name of the coordinate frame of the joints.

    Raises:
        InputError: arrays of the wrong shape or type, or an unknown skeleton.
    """

    joints: np.ndarray
    skeleton: Skeleton
    confidence: np.ndarray | None = None
    spread: np.ndarray | None = None
    visible: np.ndarray | None = None
    in_range: np.ndarray | None = None
    person: np.ndarray | None = None
    second_person: np.ndarray | None = None
    frame: str = "input"

    def __post_init__(self):
        object.__setattr__(self, "skeleton", as_skeleton(self.skeleton))
        count = len(self.skeleton)
        _as_arrays(self, "joints", *PER_JOINT, *PER_PERSON)
        if self.joints.ndim < 2 or self.joints.shape[-2:] != (count, 3):
            raise InputError(
                f"Pose.joints of {self.skeleton.name} must be (..., {count}, 3), got {tuple(self.joints.shape)}"
            )
        for names, shape, what in (
            (PER_JOINT, self.joints.shape[:-1], "joint"),
            (PER_PERSON, self.joints.shape[:-2], "person"),
        ):
            for name, value in known_values(self, *names).items():
                if value.shape != shape:
                    raise InputError(f"Pose.{name} must be {shape}, one per {what}, got {value.shape}")
        if self.in_range is not None and self.in_range.dtype != bool:
            raise InputError(f"Pose.in_range must be true or false for each joint, got {self.in_range.dtype}")

    def to(self, skeleton: Skeleton | str) -> "Pose":
        """Converts the pose to another skeleton by selecting joints by name.

        Args:
            skeleton: a `Skeleton`, or its name.

        Raises:
            InputError: an unknown skeleton, or a skeleton with a joint that this pose lacks.
        """
        skeleton = as_skeleton(skeleton)
        indices = self.skeleton.map_to(skeleton)
        joint_values = {name: value[..., indices] for name, value in known_values(self, *PER_JOINT).items()}
        return replace(self, joints=self.joints[..., indices, :], skeleton=skeleton, **joint_values)


def known_values(record: object, *names: str) -> dict[str, Any]:
    """The values of a record that are not None, by name."""
    values = {name: getattr(record, name) for name in names}
    return {name: value for name, value in values.items() if value is not None}


def facing(pose: Pose | None, up: str = "z") -> np.ndarray | None:
    """The horizontal heading of a person: (3,) of length 1, perpendicular to the up axis of the pose's frame.

    Computed from the left-right axis of hips and shoulders, by name. None without a pose, or if this axis is unknown or
    vertical, as for a person lying on the side. up: as in `rotation_from_up`.
    """
    if pose is None:
        return None
    names = pose.skeleton.joints
    axis, R_level_pose = np.zeros(3), rotation_from_up(up)
    for joint in ("hip", "shoulder"):
        if f"left_{joint}" in names and f"right_{joint}" in names:
            right_to_left = pose.joints[names.index(f"left_{joint}")] - pose.joints[names.index(f"right_{joint}")]
            if np.isfinite(right_to_left).all():
                axis = axis + R_level_pose @ right_to_left
    length = np.hypot(axis[0], axis[1])
    if length < 0.3 * np.linalg.norm(axis) or length < 0.02:
        return None
    return R_level_pose.T @ np.array([axis[1], -axis[0], 0.0]) / length


def person_note(pose: Pose | None, *, is_scored: bool = False) -> str | None:
    """What is doubtful about the person of a pose, in a few words for pictures, None for nothing.

    is_scored: whether the box has a score, so that the existence of the person is not questioned.
    """
    if pose is None:
        return None
    if not is_scored and pose.person is not None and pose.person < _NOBODY:
        return UNLIKE_A_PERSON
    return "two people?" if pose.second_person is not None and pose.second_person > _TWO else None


def facing_yaw(pose: Pose | None) -> float:
    """The yaw of a person's heading, rad about z; 0 if `facing` is None."""
    forward = facing(pose)
    return 0.0 if forward is None else float(np.arctan2(forward[1], forward[0]))


@dataclass(frozen=True, kw_only=True, eq=False)
class Box:
    """The 3D bounding box of a person, upright along the up axis. It only crops points; networks do not read it.

    Args:
        center: (3,) m.
        size: (length, width, height) m.
        yaw: rotation about the up axis, rad.
        id: text or a whole number, None if the box has none.
        score: probability that the box contains a person, None if unknown.
        mounted: whether the person rides or sits in a wheelchair, None if unknown.
        up: up axis or direction of the scan, see `rotation_from_up`. None means z.

    Raises:
        InputError: a value of the wrong type or outside its range.
    """

    center: np.ndarray
    size: np.ndarray
    yaw: float = 0.0
    id: str | int | None = None
    score: float | None = None
    mounted: bool | None = None
    up: str | None = None

    def __post_init__(self):
        for name in ("center", "size"):
            raw_value = getattr(self, name)
            try:
                value = np.array(raw_value, float)
            except (TypeError, ValueError):
                raise InputError(f"Box.{name} must be three finite numbers in meters, got {raw_value!r}") from None
            if value.shape != (3,) or not (np.abs(value) < FARTHEST).all():
                raise InputError(
                    f"Box.{name} must be three finite numbers in meters, below {FARTHEST:g}, got {value.tolist()}"
                )
            object.__setattr__(self, name, value)
        if (self.size <= 0).any():
            raise InputError(f"Box.size must be positive (length, width, height), got {self.size.tolist()}")
        if not isinstance(self.yaw, Real) or not np.isfinite(self.yaw):
            raise InputError(f"Box.yaw must be a finite number in radians, got {self.yaw!r}")
        object.__setattr__(self, "id", box_id(self.id))
        if self.score is not None:
            if not isinstance(self.score, Real) or not 0 <= self.score <= 1:
                raise InputError(f"Box.score must be a probability from 0 to 1, got {self.score!r}")
            # JSON cannot encode numpy numbers
            object.__setattr__(self, "score", float(self.score))
        if self.mounted is not None:
            if not isinstance(self.mounted, bool | np.bool_):
                raise InputError(f"Box.mounted must be true, false or None, got {self.mounted!r}")
            object.__setattr__(self, "mounted", bool(self.mounted))
        if self.up is not None:
            rotation_from_up(self.up)
            object.__setattr__(self, "up", up_text(self.up))

    def to_dict(self) -> dict[str, Any]:
        """The values of the box that are known, as JSON values; `read_boxes` reads a list of such dicts."""
        values = {"id": self.id, "score": self.score, "mounted": self.mounted, "up": self.up}
        return self.place_dict() | {name: value for name, value in values.items() if value is not None}

    def with_up(self, up: str) -> "Box":
        """The box with this up axis, so that it keeps it on its own; z is not stated."""
        return self if (self.up or "z") == up else replace(self, up=up)

    def place_dict(self) -> dict[str, Any]:
        """center, size and yaw as JSON values."""
        return {"center": self.center.tolist(), "size": self.size.tolist(), "yaw": float(self.yaw)}

    def contains(self, points: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """Whether points lie inside the box.

        Args:
            points: (n, 3+) m, in the frame of the box, with z up.
            margin: distance, m, by which the box is enlarged on each side.

        Returns:
            (n,) bool.

        Raises:
            InputError: points of another shape or type.
        """
        try:
            array = np.asarray(points, float)
        except (TypeError, ValueError):
            array = np.full((), np.nan)
        if array.ndim != 2 or array.shape[1] < 3:
            raise InputError(f"Box.contains: expected points (n, 3) m, got shape {array.shape}: give rows of x, y, z")
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        x, y, z = (array[:, :3] - self.center).T
        length, width, height = self.size / 2 + margin
        return (np.abs(c * x + s * y) <= length) & (np.abs(c * y - s * x) <= width) & (np.abs(z) <= height)


def box_id(given: object) -> str | int | None:
    """A box id as JSON can encode it: text, int or None. Raises InputError for other types than text and whole numbers
    (numpy's included)."""
    if isinstance(given, Integral) and not isinstance(given, bool):
        return int(given)
    if given is None or isinstance(given, str):
        return given
    raise InputError(f"Box.id must be text or a whole number, got {given!r}")


# additional fields of `Sample` for networks that read clips
_CLIP_FIELDS = ("rotations", "translation", "background", "neighbors")


@dataclass(frozen=True, kw_only=True, eq=False)
class Sample:
    """One person as recorded by a LiDAR.

    points (n, 3) float32 m in the sensor frame, n = 0 is legal; center (3,) m, the origin of the person's own frame,
    which has the axes of the sensor frame; part (n,) uint8, 0 = background, 1 + j = the bone of SMPL-24's joint j;
    ring (n,) int, the beam, -1 for none; pose in the sensor frame; box of the person; source: where the sample comes
    from; frame_id: name of its frame; second_person_points: number of points on other people, None if unknown;
    point_times (n,) float32 s: when each point of a cloud of several scans was measured, relative to the pose, None for
    a single scan or if unknown.

    Additional values for networks that read clips: rotations (24, 3) rad, axis-angles of SMPL's joints, each relative
    to its parent, the pelvis' from SMPL's rest frame (y up, facing +z) to the sensor frame; translation (3,) m, SMPL's
    trans as a point in the sensor frame, for synthesized bodies the pelvis; background (b, 3) float32 m, the static
    points in the person's window of azimuth and elevation, extended by 1 degree on each side; neighbors (k, 3) float32
    m, the other points of the frame in this window.
    """

    points: np.ndarray
    center: np.ndarray
    part: np.ndarray | None = None
    ring: np.ndarray | None = None
    pose: Pose | None = None
    box: Box | None = None
    source: str = ""
    frame_id: str = ""
    second_person_points: int | None = None
    point_times: np.ndarray | None = None
    rotations: np.ndarray | None = None
    translation: np.ndarray | None = None
    background: np.ndarray | None = None
    neighbors: np.ndarray | None = None

    @property
    def conditions(self) -> tuple[str, ...]:
        """How a synthetic sample deviates from a single scan of one person by an upright sensor, as listed in `source`
        after scene and sensor: merged, accumulated, integrated, inverted, sparse, crowded."""
        words = self.source.split("/")
        return tuple(words[3].split("+")) if words[0] == "synth" and len(words) > 3 else ()

    def __post_init__(self):
        _as_arrays(self, "points", "center", "part", "ring", "point_times", *_CLIP_FIELDS)
        if self.points.ndim != 2 or self.points.shape[1] != 3 or self.points.dtype != np.float32:
            raise InputError(f"Sample.points must be (n, 3) float32, got {self.points.shape} {self.points.dtype}")
        if self.center.shape != (3,):
            raise InputError(f"Sample.center must be (3,), got {self.center.shape}")
        for name in ("part", "ring", "point_times"):
            value = getattr(self, name)
            if value is not None and value.shape != (len(self.points),):
                raise InputError(f"Sample.{name} must be ({len(self.points)},), one per point, got {value.shape}")
        if self.rotations is not None and self.rotations.shape != (len(SMPL24), 3):
            raise InputError(f"Sample.rotations must be ({len(SMPL24)}, 3), got {self.rotations.shape}")
        for name in ("background", "neighbors"):
            value = getattr(self, name)
            if value is not None and (value.ndim != 2 or value.shape[1] != 3):
                raise InputError(f"Sample.{name} must be (n, 3), got {value.shape}")


@dataclass(frozen=True, kw_only=True)
class PersonInfo:
    """Measurements of a synthetic person besides the sample; NaN, "" and False if not measured.

    sensor: name; kind: activity, a name of `body.pose_prior.activities.KINDS`; distance: horizontal, from the sensor,
    m; visible: number of returns from body and clothes, as a fraction (at most 1) of the returns from the body alone
    without any loss, so that returns lost to range or slant count as hidden too; height_seen: fraction of the body
    height between its lowest and highest return, above 1 if noise or motion raise or lower returns; clutter: fraction
    of points that are neither body nor ground; upright: whether the person stands or walks.
    """

    sensor: str = ""
    kind: str = ""
    distance: float = np.nan
    visible: float = np.nan
    height_seen: float = np.nan
    clutter: float = np.nan
    upright: bool = False

    @property
    def plain(self) -> bool:
        """Whether the person is upright, fully visible and uncluttered, with most of the height seen."""
        return bool(is_plain(self.upright, self.visible, self.clutter) and self.height_seen > 0.85)


def is_plain(upright, visible, clutter):
    """Whether people are upright, fully visible and uncluttered, for arrays (N,) or single values of `PersonInfo`.
    False for NaN."""
    return upright & (visible > 0.8) & (clutter < 0.05)


@dataclass(frozen=True, kw_only=True, eq=False)
class LabeledSample(Sample):
    """A labeled sample of a dataset, as used by readers, shards, fine-tuning and evaluation.

    pose is required: joints (J, 3) m in the dataset's own skeleton, NaN for joints that are not labeled;
    joint_labels (J,) uint8: `UNLABELED`, `HIDDEN` or `SEEN`; sequence, frame, track: where it comes from; time: seconds
    since the start of the sequence, NaN if unknown; centers: other origins used by published protocols, (3,) m by name
    ("trans", "box", "joints_box"); sensor_known: whether the origin of the frame is the sensor; split: "train", "val",
    "test" or None; info: measurements of a synthetic person, None for a real one.
    """

    pose: Pose
    joint_labels: np.ndarray
    sequence: str = ""
    frame: int = 0
    track: str = "0"
    time: float = np.nan
    centers: dict[str, np.ndarray] = field(default_factory=dict)
    sensor_known: bool = True
    split: str | None = None
    info: PersonInfo | None = None

    def __repr__(self) -> str:
        origin = f"{self.sequence!r}, frame {self.frame}, track {self.track!r}"
        return f"LabeledSample({origin}, {len(self.points):,} points)"

    def __post_init__(self):
        super().__post_init__()
        if self.pose is None or self.joint_labels.shape != (len(self.pose.skeleton),):
            raise InputError(f"LabeledSample needs a pose and a label per joint, got {self.joint_labels.shape} labels")
        if (np.isnan(self.pose.joints).any(-1) != (self.joint_labels == UNLABELED)).any():
            raise InputError("LabeledSample: a joint must be NaN exactly where its label is UNLABELED")

    @property
    def joints(self) -> np.ndarray:
        """(J, 3) m: joint positions of the pose."""
        return self.pose.joints

    @property
    def skeleton(self) -> Skeleton:
        return self.pose.skeleton

    @property
    def distance(self) -> float:
        """Distance from the sensor, m: horizontal for a synthetic person, else of the center in 3D; NaN if unknown."""
        if self.info is not None:
            return self.info.distance
        # rounded as in shards, so that scores are the same from memory and from a file
        return float(np.float32(np.linalg.norm(self.center))) if self.sensor_known else np.nan

    @property
    def sample(self) -> "LabeledSample":
        """The sample itself. Until version 0.2, readers yielded objects with a separate `sample`."""
        return self


def _as_arrays(self: Pose | Sample, *names: str) -> None:
    """Converts the named fields to arrays, unless they already are. Raises InputError for values that are not
    numbers."""
    for name in names:
        value = getattr(self, name)
        if value is None or isinstance(value, np.ndarray):
            continue
        try:
            array = np.asarray(value)
        except (TypeError, ValueError):
            array = np.empty(0, object)
        if array.dtype.kind not in "fiub":
            raise InputError(f"{type(self).__name__}.{name} must be an array of numbers, got {type(value).__name__}")
        object.__setattr__(self, name, array)


# edge length, m, of the cells that even out a cloud's density before its center is computed
CENTER_CELL = 0.1


def center_of(points: np.ndarray) -> np.ndarray:
    """points (n, 3) m, n >= 1 -> (3,) m: the median of the occupied 10 cm cells on each axis.

    The default origin of a person's own frame. Cells make it independent of the point density, and the median makes it
    robust against a few stray points. It needs neither a box nor a root joint, which a user's file may not contain.
    """
    cells = np.floor(np.asarray(points, float) / CENTER_CELL).astype(np.int64)
    low = cells.min(0)
    x, y, z = (cells - low).T
    if max(x.max(), y.max(), z.max()) >= 1 << 20:
        # stray points kilometers away: packing a cell into one integer would overflow
        return (np.median(np.unique(cells, axis=0), axis=0) + 0.5) * CENTER_CELL
    # one integer per cell: finding unique integers is far faster than finding unique rows
    number = np.sort(x << 40 | y << 20 | z)
    number = number[np.diff(number, prepend=-1) > 0]
    x, y, z = number >> 40, number >> 20 & 0xFFFFF, number & 0xFFFFF
    # np.median is slow here: its handling of NaN and axes costs more than the medians
    middle = [(v[(len(v) - 1) // 2] + v[len(v) // 2]) / 2 for v in (x, np.sort(y), np.sort(z))]
    return (np.array(middle) + low + 0.5) * CENTER_CELL
