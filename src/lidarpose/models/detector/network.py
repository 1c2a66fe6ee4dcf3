"""`DetectorNet`: whether there is a person at a candidate, and where. Fast enough for hundreds of candidates per scan.

Legend: K candidates, C channels.
"""

import torch
from torch import Tensor, nn

from lidarpose.models.detector.detector_config import OUTPUTS, DetectorConfig

# channels of the last map that the head reads cell by cell
_PLACED = 8
# initial prediction of a person's height, m
_HEIGHT = 1.7
# initial gain of a block's second convolution
_GAIN = 0.1


class _Block(nn.Module):
    """A 3 x 3 convolution that halves the map, then a residual one that is close to the identity at first."""

    def __init__(self, in_channels: int, out_channels: int):
        super().__init__()
        self.down = nn.Conv2d(in_channels, out_channels, 3, stride=2, padding=1)
        self.same = nn.Conv2d(out_channels, out_channels, 3, padding=1)
        self.gain = nn.Parameter(torch.full((out_channels, 1, 1), _GAIN))

    def forward(self, x: Tensor) -> Tensor:
        x = torch.relu(self.down(x))
        return torch.relu(x + self.gain * self.same(x))


class _Branch(nn.Module):
    """Maps (K, C, H, W) -> features (K, F): the maximum of each channel, and some channels cell by cell."""

    def __init__(self, shape: tuple[int, int, int], stem: int, *levels: int):
        super().__init__()
        in_channels, rows, columns = shape
        layers: list[nn.Module] = []
        if stem:
            # vertical structure first: the input's channels are slices of height
            layers += [nn.Conv2d(in_channels, stem, 1), nn.ReLU()]
            in_channels = stem
        for out_channels in levels:
            layers.append(_Block(in_channels, out_channels))
            in_channels, rows, columns = out_channels, -(-rows // 2), -(-columns // 2)
        self.layers = nn.Sequential(*layers)
        self.placed = nn.Conv2d(in_channels, _PLACED, 1)
        self.features = in_channels + _PLACED * rows * columns

    def forward(self, x: Tensor) -> Tensor:
        x = self.layers(x)
        return torch.cat([x.amax((2, 3)), torch.relu(self.placed(x)).flatten(1)], 1)


class DetectorNet(nn.Module):
    """Inputs of candidates -> (K, 6), see `OUTPUTS`. No batch statistics: outputs do not depend on other candidates."""

    def __init__(self, config: DetectorConfig):
        super().__init__()
        self.config = config
        stem, *levels = config.channels
        self.fine = _Branch(config.fine, stem, *levels)
        self.range_view = _Branch(config.range_view, 0, *config.coarse_channels)
        self.context = _Branch(config.context, 0, *config.coarse_channels)
        features = sum(branch.features for branch in (self.fine, self.range_view, self.context)) + config.scalars
        self.hidden = nn.Linear(features, config.hidden)
        self.last = nn.Linear(config.hidden, len(OUTPUTS))
        for module in self.modules():
            if isinstance(module, nn.Conv2d | nn.Linear):
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
                module.bias = nn.Parameter(torch.zeros(len(module.weight)))
        nn.init.normal_(self.last.weight, std=0.01)
        with torch.no_grad():
            # people are rare, and most are of usual height
            self.last.bias.copy_(torch.tensor([-2.0, 0.0, 0.0, 0.0, _HEIGHT, -2.0]))

    def forward(self, fine: Tensor, range_view: Tensor, context: Tensor, scalars: Tensor) -> Tensor:
        branches = [self.fine(fine), self.range_view(range_view), self.context(context), scalars]
        return self.last(torch.relu(self.hidden(torch.cat(branches, 1))))
