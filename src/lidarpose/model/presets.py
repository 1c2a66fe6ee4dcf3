"""The sizes of the network: one dial, the rest derived."""

from dataclasses import asdict, dataclass

from lidarpose.errors import InputError, unknown_name
from lidarpose.skeleton import skeleton


@dataclass(frozen=True, kw_only=True)
class NetworkConfig:
    """Widths and depths. grid: edge of a fine voxel in metres (mid and coarse: 2 and 4 times); max_voxels: fine voxels
    a person at the most; blocks: attention blocks (mid encoder, coarse, mid decoder); parts: body parts and 0."""

    size: str
    channels: int
    heads: int
    blocks: tuple[int, int, int]
    grid: float = 0.06
    max_voxels: int = 384
    skeleton: str = "body26"
    parts: int = 25

    def __post_init__(self):
        for name in ("channels", "heads", "max_voxels", "parts"):
            value = getattr(self, name)
            if not isinstance(value, int) or value < 1:
                raise InputError(f"{name} must be a whole number of at least 1, got {value!r}")
        if self.channels % self.heads:
            raise InputError(f"channels must divide by heads, got {self.channels} and {self.heads}")
        blocks = self.blocks
        counts = list(blocks) if isinstance(blocks, list | tuple) else []
        if len(counts) != 3 or not all(isinstance(count, int) and count >= 0 for count in counts):
            raise InputError(f"blocks must be three whole numbers (mid encoder, coarse, mid decoder), got {blocks!r}")
        if not isinstance(self.grid, int | float) or not self.grid > 0:
            raise InputError(f"grid must be a positive number of metres, got {self.grid!r}")
        skeleton(self.skeleton)
        object.__setattr__(self, "blocks", tuple(counts))

    def to_dict(self) -> dict:
        return asdict(self)


SIZES = {
    "tiny": NetworkConfig(size="tiny", channels=64, heads=4, blocks=(1, 1, 1)),
}


def preset(size: str) -> NetworkConfig:
    """The configuration of a named size."""
    if size not in SIZES:
        raise unknown_name("network size", size, SIZES)
    return SIZES[size]
