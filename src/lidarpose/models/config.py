"""The sizes of the network: one dial, the rest derived."""

from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

from lidarpose.errors import InputError, check_int, check_name
from lidarpose.skeleton import skeleton

# heatmaps in a window about each joint's vote; over the whole person, as the paper's; or votes alone
HEATMAPS = ("window", "full", "none")
# width of a heatmap's bin, m
BIN = 0.03
# of any width, far above what anybody trains: a damaged file's header is to ask for nothing larger
MOST = 16_384


def check_counts(name: str, value: Any, count: int, *, least: int = 1, levels: str = "") -> tuple[int, ...]:
    """So many whole numbers from `least` to `MOST`, as a tuple. Raises InputError for anything else; levels: what they
    are of."""
    if isinstance(value, list | tuple) and len(value) == count:
        with suppress(InputError):
            return tuple(check_int(name, number, least=least, most=MOST) for number in value)
    raise InputError(f"{name} must be {count} whole numbers{levels} from {least} to {MOST}, got {value!r}")


def is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def check_grid(grid: Any) -> None:
    """Raises InputError unless `grid` is an edge of a voxel."""
    if not (is_number(grid) and grid > 0):
        raise InputError(f"grid must be a positive number of meters, got {grid!r}")


@dataclass(frozen=True, kw_only=True)
class NetworkConfig:
    """Widths and depths of a `PoseNet`.

    channels: of the fine, mid and coarse level; head_channels: a head of attention; blocks: attention blocks (mid
    encoder, coarse, mid decoder); grid: edge of a fine voxel in meters (mid and coarse: 2 and 4 times); max_voxels:
    fine voxels a person at the most; parts: body parts and 0; heatmap: one of `HEATMAPS`; convolution: channels
    of the submanifold convolutions before the blocks of the mid and coarse level, 0 for none; person: whether it says
    if a crop shows a person, and a second one.
    """

    kind: ClassVar[str] = "pose"

    size: str
    channels: tuple[int, int, int]
    head_channels: int
    blocks: tuple[int, int, int]
    grid: float = 0.06
    max_voxels: int = 384
    skeleton: str = "body26"
    parts: int = 25
    heatmap: str = "window"
    convolution: int = 0
    person: bool = False

    def __post_init__(self):
        # false in files of before it was a number
        if self.convolution is False:
            object.__setattr__(self, "convolution", 0)
        for name, least in (("head_channels", 1), ("max_voxels", 1), ("parts", 1), ("convolution", 0)):
            object.__setattr__(self, name, check_int(name, getattr(self, name), least=least, most=MOST))
        for name, least, levels in (
            ("channels", 1, "fine, mid, coarse"),
            ("blocks", 0, "mid encoder, coarse, mid decoder"),
        ):
            counts = check_counts(name, getattr(self, name), 3, least=least, levels=f" ({levels})")
            object.__setattr__(self, name, counts)
        if any(width % self.head_channels for width in self.channels[1:]):
            raise InputError(
                f"channels of the mid and coarse level must divide by head_channels, got {self.channels} "
                f"and {self.head_channels}"
            )
        if not isinstance(self.person, bool):
            raise InputError(f"person must be true or false, got {self.person!r}")
        check_grid(self.grid)
        check_name("heatmap", self.heatmap, HEATMAPS)
        skeleton(self.skeleton)

    @property
    def name(self) -> str:
        return self.size

    @property
    def joints(self) -> tuple[str, ...]:
        return skeleton(self.skeleton).joints

    @property
    def layers(self) -> int:
        """Blocks of all levels."""
        return sum(self.blocks)

    def to_dict(self) -> dict:
        return asdict(self)


SIZES = {
    "tiny": NetworkConfig(size="tiny", channels=(48, 64, 96), head_channels=32, blocks=(1, 1, 1), convolution=12),
    "small": NetworkConfig(size="small", channels=(64, 96, 160), head_channels=32, blocks=(2, 2, 2), convolution=12),
    "base": NetworkConfig(
        size="base",
        channels=(96, 192, 288),
        head_channels=24,
        blocks=(2, 3, 2),
        grid=0.04,
        max_voxels=512,
        convolution=16,
    ),
}


def preset(size: str) -> NetworkConfig:
    """The configuration of a named size."""
    check_name("network size", size, SIZES)
    return SIZES[size]
