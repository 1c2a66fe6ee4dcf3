"""The configuration of the detector's network and the shapes of its inputs. No torch, no numpy here."""

from dataclasses import dataclass
from typing import ClassVar

from lidarpose.models.config import Config

# inputs of the network in their order, see `render.render`
INPUTS = ("fine", "range_view", "context", "scalars")
# name of the network's output (K, 6), and its columns: logit of a person; true center minus candidate in the view
# frame, m; feet above the estimated ground, m; height, m; logit of a person who rides or sits in a wheelchair
OUTPUT = "scores"
OUTPUTS = ("logit", "dx", "dy", "foot", "height", "mounted")


@dataclass(frozen=True, kw_only=True)
class DetectorConfig(Config):
    """Inputs and widths of a `DetectorNet`.

    fine, range_view, context: channels, rows and columns of each input; scalars: number of scalar inputs; channels: of
    the stem and the two levels of the fine branch; coarse_channels: of the two levels of the other branches; hidden:
    width of the hidden layer.
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
    def min_tensors(self) -> int:
        """A lower bound of the number of tensors."""
        return 2

    def shapes(self, candidates: int) -> dict[str, tuple[int, ...]]:
        """The shape of each of `INPUTS` for the given number of candidates."""
        input_shapes = (self.fine, self.range_view, self.context, (self.scalars,))
        return {name: (candidates, *shape) for name, shape in zip(INPUTS, input_shapes, strict=True)}
