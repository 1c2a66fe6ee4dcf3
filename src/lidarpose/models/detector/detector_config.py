"""The shape of the detector's network, and of what it reads. No torch, no numpy here."""

from dataclasses import asdict, dataclass
from typing import Any, ClassVar

from lidarpose.errors import check_int
from lidarpose.models.config import MOST, check_counts

# inputs of the network in their order, see `render.render`
INPUTS = ("fine", "range_view", "context", "scalars")
# the name of what it gives (K, 6), and its columns: logit of a person; true center minus candidate in the view frame,
# m; feet above the estimated ground, m; height, m; logit of somebody who rides or sits in a wheelchair
OUTPUT = "scores"
OUTPUTS = ("logit", "dx", "dy", "foot", "height", "mounted")


@dataclass(frozen=True, kw_only=True)
class DetectorConfig:
    """Inputs and widths of a `DetectorNet`.

    fine, range_view, context: channels, rows and columns of what it reads; scalars: numbers beside; channels: of the
    three levels of the fine branch; coarse_channels: of the two levels of the others; hidden: of the last layer.
    """

    kind: ClassVar[str] = "detector"
    name: ClassVar[str] = "detector"
    joints: ClassVar[tuple[str, ...]] = ()

    fine: tuple[int, int, int] = (28, 24, 24)
    range_view: tuple[int, int, int] = (4, 28, 24)
    context: tuple[int, int, int] = (4, 20, 20)
    scalars: int = 4
    channels: tuple[int, int, int] = (32, 48, 96)
    coarse_channels: tuple[int, int] = (24, 48)
    hidden: int = 128

    def __post_init__(self):
        for name in ("fine", "range_view", "context", "channels"):
            object.__setattr__(self, name, check_counts(name, getattr(self, name), 3))
        object.__setattr__(self, "coarse_channels", check_counts("coarse_channels", self.coarse_channels, 2))
        for name in ("scalars", "hidden"):
            object.__setattr__(self, name, check_int(name, getattr(self, name), least=1, most=MOST))

    @property
    def layers(self) -> int:
        """A lower bound of the tensors."""
        return 2

    def shapes(self, candidates: int) -> dict[str, tuple[int, ...]]:
        """The shape of each of `INPUTS` for so many candidates."""
        own: dict[str, tuple[int, ...]] = {
            "fine": self.fine,
            "range_view": self.range_view,
            "context": self.context,
            "scalars": (self.scalars,),
        }
        return {name: (candidates, *own[name]) for name in INPUTS}

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)
