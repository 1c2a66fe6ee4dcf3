"""The base class of network configurations, and the configuration and named sizes of the package's own network."""

import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import MISSING, Field, asdict, dataclass, field, fields
from typing import Any, ClassVar, get_args

from lidarpose.errors import InputError, check_int, check_name
from lidarpose.models import VERIFIER
from lidarpose.skeleton import BODY26, Skeleton, skeleton

# heatmaps in a window around each joint's vote; over the whole person, as in the paper; or votes without heatmaps
HEATMAPS = ("window", "full", "none")
# width of a heatmap's bin, m
BIN = 0.03
# upper limit of any width, far above any trained network: the header of a damaged file must not request more
MOST = 16_384


def check_counts(name: str, value: Any, count: int, *, least: int = 1, levels: str = "") -> tuple[int, ...]:
    """`count` integers from `least` to `MOST`, as a tuple. Raises InputError for anything else; levels: what the
    entries stand for, for the message."""
    if isinstance(value, list | tuple) and len(value) == count:
        with suppress(InputError):
            return tuple(check_int(name, number, least=least, most=MOST) for number in value)
    raise InputError(f"{name} must be {count} whole numbers{levels} from {least} to {MOST}, got {value!r}")


def is_number(value: object) -> bool:
    """Whether a value is a finite number; integers of a file can be larger than any float."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def at_least(least: int, default: Any = MISSING, *, levels: str = "") -> Any:
    """A field of integers from `least` on; levels: what the entries of a tuple stand for, for messages."""
    return field(default=default, metadata={"least": least, "levels": levels})


def probability(default: float) -> Any:
    """A field for a number from 0 to below 1."""
    return field(default=default, metadata={"probability": True})


@dataclass(frozen=True, kw_only=True)
class Config:
    """The configuration of a network. Its fields are checked by their declarations: integers from 1 (see `at_least`) to
    `MOST`, numbers above 0 (see `probability`), booleans; lists become tuples. Raises InputError for anything else."""

    kind: ClassVar[str] = ""

    @property
    def poses(self) -> bool:
        """Whether the network predicts joints."""
        return bool(getattr(self, "joints", ()))

    @property
    def columns(self) -> list[int]:
        """Index of each of the network's joints in body26."""
        return [BODY26.index(joint) for joint in getattr(self, "joints", ())]

    def order_in(self, skeleton: Skeleton) -> list[int]:
        """Index of each joint of a skeleton among the network's joints, which must include them all."""
        joints = getattr(self, "joints", ())
        return [joints.index(joint) for joint in skeleton.joints]

    def __post_init__(self):
        for f in fields(self):
            object.__setattr__(self, f.name, _checked(f, _as_tuple(getattr(self, f.name))))

    def to_dict(self) -> dict[str, Any]:
        """Plain values for a file's header; the constructor accepts them, also after a JSON round trip."""
        return asdict(self)

    @staticmethod
    def renamed(entries: dict[str, Any]) -> dict[str, Any]:
        """A file's entries under their current names."""
        return entries


def _as_tuple(value: Any) -> Any:
    return tuple(map(_as_tuple, value)) if isinstance(value, list | tuple) else value


def _checked(f: Field, value: Any) -> Any:
    """A setting, checked by its field's declaration; the configuration class checks tuples of free length itself."""
    least, type_args = f.metadata.get("least", 1), get_args(f.type)
    if f.type is int:
        return check_int(f.name, value, least=least, most=MOST)
    if type_args and set(type_args) == {int}:
        return check_counts(f.name, value, len(type_args), least=least, levels=f.metadata.get("levels", ""))
    checks: dict[Any, tuple[Callable[[Any], bool], str]] = {
        bool: (lambda flag: isinstance(flag, bool), "true or false"),
        str: (lambda text: isinstance(text, str), "text"),
        float: (lambda number: is_number(number) and number > 0, "a positive number of meters"),
    }
    if f.metadata.get("probability"):
        checks[float] = (lambda number: is_number(number) and 0 <= number < 1, "a probability below 1")
    is_valid, expected = checks.get(f.type, (lambda _: True, ""))
    if not is_valid(value):
        raise InputError(f"{f.name} must be {expected}, got {value!r}")
    return value


def check_joints(joints: Any) -> None:
    """Raises InputError unless `joints` are distinct joint names of body26."""
    if not isinstance(joints, tuple) or not joints or len(set(joints)) != len(joints):
        raise InputError(f"joints must be joint names, each once, got {joints!r}")
    for joint in joints:
        BODY26.index(joint)


@dataclass(frozen=True, kw_only=True)
class NetworkConfig(Config):
    """Widths and depths of a `PoseNet`.

    channels: of the fine, mid and coarse level; head_channels: channels per attention head; blocks: attention blocks
    (mid encoder, coarse, mid decoder); grid: edge of a fine voxel in meters (mid and coarse: 2 and 4 times as wide);
    max_voxels: maximum number of fine voxels per person; parts: number of part classes, including 0 for background;
    heatmap: one of `HEATMAPS`; convolution: channels of the submanifold convolutions before the blocks of the mid and
    coarse level, 0 for none; person: whether the network predicts if a crop shows a person, and if a second one.
    """

    kind: ClassVar[str] = "pose"

    size: str
    channels: tuple[int, int, int] = at_least(1, levels=" (fine, mid, coarse)")
    head_channels: int
    blocks: tuple[int, int, int] = at_least(0, levels=" (mid encoder, coarse, mid decoder)")
    grid: float = 0.06
    max_voxels: int = 384
    skeleton: str = "body26"
    parts: int = 25
    heatmap: str = "window"
    convolution: int = at_least(0, 0)
    person: bool = False

    def __post_init__(self):
        # False in old files, in which this setting was a boolean
        if self.convolution is False:
            object.__setattr__(self, "convolution", 0)
        super().__post_init__()
        if any(width % self.head_channels for width in self.channels[1:]):
            problem = "channels of the mid and coarse level must be divisible by head_channels"
            raise InputError(f"{problem}, got {self.channels} and {self.head_channels}")
        check_name("heatmap", self.heatmap, HEATMAPS)
        skeleton(self.skeleton)

    @property
    def name(self) -> str:
        return self.size

    @property
    def poses(self) -> bool:
        """Whether the network was trained to predict joints."""
        return self.size != VERIFIER

    @property
    def joints(self) -> tuple[str, ...]:
        return skeleton(self.skeleton).joints

    @property
    def min_tensors(self) -> int:
        """Number of blocks at all levels."""
        return sum(self.blocks)


SIZES = {
    "tiny": NetworkConfig(size="tiny", channels=(48, 64, 96), head_channels=32, blocks=(1, 1, 1), convolution=12),
    "small": NetworkConfig(size="small", channels=(64, 96, 160), head_channels=32, blocks=(2, 2, 2), convolution=12),
    "base": NetworkConfig(size="base", channels=(96, 192, 288), head_channels=32, blocks=(2, 3, 2), convolution=12),
}
