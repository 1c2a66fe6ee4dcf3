"""The shape of the detector's network, and of what it reads. No torch, no numpy here."""

from dataclasses import dataclass
from typing import ClassVar

from lidarpose.models.config import Config

# inputs of the network in their order, see `render.render`
INPUTS = ("fine", "range_view", "context", "scalars")
# the name of what it gives (K, 6), and its columns: logit of a person; true center minus candidate in the view frame,
# m; feet above the estimated ground, m; height, m; logit of somebody who rides or sits in a wheelchair
OUTPUT = "scores"
OUTPUTS = ("logit", "dx", "dy", "foot", "height", "mounted")


@dataclass(frozen=True, kw_only=True)
class DetectorConfig(Config):
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

    @property
    def layers(self) -> int:
        """A lower bound of the tensors."""
        return 2

    def shapes(self, candidates: int) -> dict[str, tuple[int, ...]]:
        """The shape of each of `INPUTS` for so many candidates."""
        input_shapes = (self.fine, self.range_view, self.context, (self.scalars,))
        return {name: (candidates, *shape) for name, shape in zip(INPUTS, input_shapes, strict=True)}
