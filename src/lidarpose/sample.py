"""What packages hand on: a person's points (`Sample`), a skeleton in space (`Pose`), a detector's `Box`.

All are frozen, keyword-only and validated when built, and equal to nothing but themselves, since they hold arrays.
Lengths in meters, angles in radians, z up.
"""

from dataclasses import dataclass, field, replace
from numbers import Integral, Real
from typing import Any

import numpy as np

from lidarpose.errors import InputError
from lidarpose.geometry import rotation_from_up, up_text
from lidarpose.skeleton import SMPL24, Skeleton, as_skeleton

# no coordinate on Earth is larger, m; arithmetic on what is would overflow
FARTHEST = 1e9
# a joint nearer to the truth than this is a hit, m: what confidence is the probability of
CONFIDENCE_RADIUS = 0.1
# fewer points than this say nothing about a pose
MIN_POINTS = 5
# points of a second person from which on a crop is said to show two
FEWEST_OF_SECOND = 15
# frames of a clip. Source: LiDARCap; NE, whose layers hold as many
CLIP_FRAMES = 16
# what a pose may say of each joint
PER_JOINT = ("confidence", "spread", "visible", "in_range")
# and once a person
PER_PERSON = ("person", "second_person")
# tables of results have a row for each joint of each person, who has a number in the column "person"
JOINT_COLUMNS = ("joint", "x", "y", "z", *PER_JOINT, "person_probability", "second_person", "score", "mounted")
# the label of a joint: not labeled (its position is NaN), labeled though hidden or uncertain, labeled and seen
UNLABELED, HIDDEN, SEEN = 0, 1, 2


def within_reach(points: np.ndarray) -> np.ndarray:
    """points (..., 3) m -> (...) bool: where arithmetic can work with them, neither NaN nor beyond `FARTHEST`."""
    return (np.abs(points) < FARTHEST).all(-1)


def clip_windows(run: np.ndarray, *, following: int = 0) -> np.ndarray:
    """A run's rows (n,) as clips (c, `CLIP_FRAMES`) that do not overlap, each with so many rows that follow; what lies
    behind the last row is filled with it. Source: LiDARCap."""
    rows = np.arange(0, len(run), CLIP_FRAMES)[:, None] + np.arange(CLIP_FRAMES + following)
    return run[np.minimum(rows, len(run) - 1)]


@dataclass(frozen=True, kw_only=True, eq=False)
class Pose:
    """Joints in space, of one person or of many.

    joints (..., J, 3) m; confidence (..., J) in [0, 1], the probability that the joint is within 10 cm;
    spread (..., J) m, the expected distance between the joint and the truth; visible (..., J) in [0, 1], the
    probability that a point of the body lies within 18 cm of the joint; in_range (..., J) bool, False where the joint
    may lie farther out than it says, since it was found at the end of what the network can tell; person, second_person
    (...) in [0, 1], the probabilities that the cloud shows a person, and a second one besides; frame names the frame of
    the joints. The skeleton may be given by its name.
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
        for name in PER_JOINT:
            value = getattr(self, name)
            if value is not None and value.shape != self.joints.shape[:-1]:
                raise InputError(f"Pose.{name} must be {self.joints.shape[:-1]}, one a joint, got {value.shape}")
        for name in PER_PERSON:
            value = getattr(self, name)
            if value is not None and value.shape != self.joints.shape[:-2]:
                raise InputError(f"Pose.{name} must be {self.joints.shape[:-2]}, one a person, got {value.shape}")
        if self.in_range is not None and self.in_range.dtype != bool:
            raise InputError(f"Pose.in_range must be true or false for each joint, got {self.in_range.dtype}")

    def to(self, skeleton: Skeleton | str) -> "Pose":
        """The same pose with the joints of another skeleton, or of that of a name, picked by their names."""
        skeleton = as_skeleton(skeleton)
        indices = self.skeleton.map_to(skeleton)
        values = {name: getattr(self, name) for name in PER_JOINT}
        joint_values: dict[str, Any] = {
            name: None if value is None else value[..., indices] for name, value in values.items()
        }
        return replace(self, joints=self.joints[..., indices, :], skeleton=skeleton, **joint_values)


def facing(pose: Pose | None) -> np.ndarray | None:
    """Where a person looks, on the ground: (3,) of length 1 with z = 0.

    Taken from the left-right axis of hips and shoulders, by name. None without a pose, or where the axis is unknown
    or stands upright, as of somebody who lies on the side.
    """
    if pose is None:
        return None
    names = pose.skeleton.joints
    axis = np.zeros(3)
    for joint in ("hip", "shoulder"):
        if f"left_{joint}" in names and f"right_{joint}" in names:
            right_to_left = pose.joints[names.index(f"left_{joint}")] - pose.joints[names.index(f"right_{joint}")]
            if np.isfinite(right_to_left).all():
                axis = axis + right_to_left
    length = np.hypot(axis[0], axis[1])
    if length < 0.3 * np.linalg.norm(axis) or length < 0.02:
        return None
    return np.array([axis[1], -axis[0], 0.0]) / length


def facing_yaw(pose: Pose | None) -> float:
    """The angle about z, rad, of where a person looks, 0 where `facing` knows none."""
    forward = facing(pose)
    return 0.0 if forward is None else float(np.arctan2(forward[1], forward[0]))


@dataclass(frozen=True, kw_only=True, eq=False)
class Box:
    """A person's box: center (3,) m, size (length, width, height) m, yaw rad about z. It may only crop.

    score: the probability that it is a person, None where nobody says; mounted: whether the person rides, or sits in a
    wheelchair, None where nobody says; up: what is up in the scan, see `rotation_from_up`, None for z.
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
            # numpy's numbers are none for JSON
            object.__setattr__(self, "score", float(self.score))
        if self.mounted is not None:
            if not isinstance(self.mounted, bool | np.bool_):
                raise InputError(f"Box.mounted must be true, false or None, got {self.mounted!r}")
            object.__setattr__(self, "mounted", bool(self.mounted))
        if self.up is not None:
            rotation_from_up(self.up)
            object.__setattr__(self, "up", up_text(self.up))

    def to_dict(self) -> dict[str, Any]:
        """center, size and yaw, and up where it is not z, as JSON holds them."""
        place = {"center": self.center.tolist(), "size": self.size.tolist(), "yaw": float(self.yaw)}
        return place if self.up in (None, "z") else place | {"up": self.up}

    def contains(self, points: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """points (n, 3+) m -> (n,) bool: inside the box grown by `margin` m on each side. Raises InputError."""
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
    """A box's id as JSON can hold it. Raises InputError for what is neither text nor a whole number, numpy's too."""
    if isinstance(given, Integral) and not isinstance(given, bool):
        return int(given)
    if given is None or isinstance(given, str):
        return given
    raise InputError(f"Box.id must be text or a whole number, got {given!r}")


@dataclass(frozen=True, kw_only=True, eq=False)
class Sample:
    """One person as a LiDAR saw it.

    points (n, 3) float32 m in the sensor's frame, n = 0 is legal; center (3,) m, the origin of the person's own
    frame, which has the sensor's axes; part (n,) uint8, 0 = background, 1 + j = the bone of SMPL-24's joint j;
    ring (n,) int, the beam; pose in the sensor's frame; source tells where the sample came from; second_person_points:
    how many points are somebody else's, None where that is not known.

    What networks of clips need besides: rotations (24, 3) rad, axis-angles of SMPL's joints, each relative to its
    parent, the pelvis' from SMPL's rest frame (y up, facing +z) to the sensor's; translation (3,) m, SMPL's trans as a
    point of the sensor's frame, of synthesized bodies the pelvis; background (b, 3) float32 m, what stands still in the
    person's window of azimuth and elevation, +-1 degree; neighbors (k, 3) float32 m, the frame's other points in it.
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
    rotations: np.ndarray | None = None
    translation: np.ndarray | None = None
    background: np.ndarray | None = None
    neighbors: np.ndarray | None = None

    @property
    def conditions(self) -> tuple[str, ...]:
        """Of a synthetic sample that is not one scan of an upright sensor around one person, what it is instead, as its
        source says after scene and sensor: merged, accumulated, integrated, inverted, sparse, crowded."""
        words = self.source.split("/")
        return tuple(words[3].split("+")) if words[0] == "synth" and len(words) > 3 else ()

    def __post_init__(self):
        _as_arrays(self, "points", "center", "part", "ring", "rotations", "translation", "background", "neighbors")
        if self.points.ndim != 2 or self.points.shape[1] != 3 or self.points.dtype != np.float32:
            raise InputError(f"Sample.points must be (n, 3) float32, got {self.points.shape} {self.points.dtype}")
        if self.center.shape != (3,):
            raise InputError(f"Sample.center must be (3,), got {self.center.shape}")
        for name in ("part", "ring"):
            value = getattr(self, name)
            if value is not None and value.shape != (len(self.points),):
                raise InputError(f"Sample.{name} must be ({len(self.points)},), one a point, got {value.shape}")
        if self.rotations is not None and self.rotations.shape != (len(SMPL24), 3):
            raise InputError(f"Sample.rotations must be ({len(SMPL24)}, 3), got {self.rotations.shape}")
        for name in ("background", "neighbors"):
            value = getattr(self, name)
            if value is not None and (value.ndim != 2 or value.shape[1] != 3):
                raise InputError(f"Sample.{name} must be (n, 3), got {value.shape}")


@dataclass(frozen=True, kw_only=True)
class PersonInfo:
    """What is known of a synthetic person besides the sample; NaN, "" and False where nothing was measured.

    sensor: name; kind: what the person does, a name of `body.pose_prior.activities.KINDS`; distance m; visible: returns
    of body and clothes, as a share (at most 1) of those that the body alone has without any loss: what range or slant
    lost counts as hidden too; height_seen: share of the body's height between its lowest and highest return; clutter:
    share of the points that are neither body nor ground; upright: stands or walks.
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
        """Upright, whole and uncluttered, most of the height seen."""
        return bool(is_plain(self.upright, self.visible, self.clutter) and self.height_seen > 0.85)


def is_plain(upright, visible, clutter):
    """Bools for arrays (N,) or one person's, as in `PersonInfo`: upright, whole, uncluttered. NaN is not plain."""
    return upright & (visible > 0.8) & (clutter < 0.05)


@dataclass(frozen=True, kw_only=True, eq=False)
class LabeledSample(Sample):
    """A sample of a dataset: what its reader yields, a shard stores, fine-tuning learns from and evaluation scores.

    Of `Sample` the pose is required: joints (J, 3) m of the dataset's own skeleton, NaN where a joint is not labeled.
    joint_labels (J,) uint8: `UNLABELED`, `HIDDEN` or `SEEN`; sequence, frame, track: where it comes from; time: seconds
    since the sequence's beginning, NaN if unknown; centers: other origins that published protocols use, (3,) m by
    name ("trans", "box", "joints_box"); sensor_known: whether the origin of the frame is the sensor; split: "train",
    "val", "test" or None; info: of a synthetic person, None of a real one.
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

    def __post_init__(self):
        super().__post_init__()
        if self.pose is None or self.joint_labels.shape != (len(self.pose.skeleton),):
            raise InputError(f"LabeledSample needs a pose and a label per joint, got {self.joint_labels.shape} labels")
        if (np.isnan(self.pose.joints).any(-1) != (self.joint_labels == UNLABELED)).any():
            raise InputError("LabeledSample: a joint is NaN exactly where its label is UNLABELED")

    @property
    def joints(self) -> np.ndarray:
        """(J, 3) m, those of the pose."""
        return self.pose.joints

    @property
    def skeleton(self) -> Skeleton:
        return self.pose.skeleton

    @property
    def distance(self) -> float:
        """Of the person from the sensor, m; NaN where it is not known."""
        if self.info is not None:
            return self.info.distance
        # as precise as shards store it, so that a score is the same from memory and from a file
        return float(np.float32(np.linalg.norm(self.center))) if self.sensor_known else np.nan

    @property
    def sample(self) -> "LabeledSample":
        """The sample itself: what readers yielded until 0.2 held it beside its labels."""
        return self


def _as_arrays(self: Pose | Sample, *names: str) -> None:
    """What was given as lists becomes arrays; arrays stay what they are. Raises InputError for what is no numbers."""
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


# edge of the cells in which a cloud's density is evened out before its center is taken, meters
CENTER_CELL = 0.1


def center_of(points: np.ndarray) -> np.ndarray:
    """points (n, 3) m, n >= 1 -> (3,) m: the median of the occupied 10 cm cells on each axis.

    The origin of a person's own frame where nothing better is known. Cells make it independent of the density, the
    median of a few stray points. No box, no root joint: nothing that a user's file does not hold.
    """
    cells = np.floor(np.asarray(points, float) / CENTER_CELL).astype(np.int64)
    low = cells.min(0)
    x, y, z = (cells - low).T
    if max(x.max(), y.max(), z.max()) >= 1 << 20:
        # strays kilometers away: one number a cell would overflow
        return (np.median(np.unique(cells, axis=0), axis=0) + 0.5) * CENTER_CELL
    # one number a cell: far faster to make unique than rows
    number = np.sort(x << 40 | y << 20 | z)
    number = number[np.diff(number, prepend=-1) > 0]
    x, y, z = number >> 40, number >> 20 & 0xFFFFF, number & 0xFFFFF
    # np.median's care for NaN and axes costs more than the medians
    middle = [(v[(len(v) - 1) // 2] + v[len(v) // 2]) / 2 for v in (x, np.sort(y), np.sort(z))]
    return (np.array(middle) + low + 0.5) * CENTER_CELL
