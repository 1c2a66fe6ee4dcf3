"""`DetectorNet`: is there a person at a candidate, and where exactly. Small enough for hundreds of candidates a scan.

Legend: K candidates, C channels.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from lidarpose.models.detector.detector_config import OUTPUTS, DetectorConfig

# channels whose place in the last map matters to the head
_PLACED = 8
# standard deviation of a stem's input is far below 1: empty cells are 0
_HEIGHT = 1.7
# how much of a block's second convolution is added in the beginning
_GAIN = 0.1


class _Block(nn.Module):
    """A 3 x 3 convolution that halves the map, then a residual one that begins as the identity."""

    def __init__(self, in_channels: int, out_channels: int):
        super().__init__()
        self.down = nn.Conv2d(in_channels, out_channels, 3, stride=2, padding=1)
        self.same = nn.Conv2d(out_channels, out_channels, 3, padding=1)
        self.gain = nn.Parameter(torch.full((out_channels, 1, 1), _GAIN))

    def forward(self, x: Tensor) -> Tensor:
        x = torch.relu(self.down(x))
        return torch.relu(x + self.gain * self.same(x))


class _Branch(nn.Module):
    """Maps (K, C, H, W) -> features (K, F): the largest of each channel, and some channels cell by cell."""

    def __init__(self, shape: tuple[int, int, int], stem: int, *levels: int):
        super().__init__()
        in_channels, rows, columns = shape
        layers: list[nn.Module] = []
        if stem:
            # vertical structure first: rows of the input are channels
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
    """Candidates' inputs -> (K, 6), see `OUTPUTS`. Without batch statistics: a candidate's answer is its own."""

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
            # people are rare, and of usual height
            self.last.bias.copy_(torch.tensor([-2.0, 0.0, 0.0, 0.0, _HEIGHT, -2.0]))

    def forward(self, fine: Tensor, range_view: Tensor, context: Tensor, scalars: Tensor) -> Tensor:
        branches = [self.fine(fine), self.range_view(range_view), self.context(context), scalars]
        return self.last(torch.relu(self.hidden(torch.cat(branches, 1))))


# ---- units that never answer, as high rates leave them behind: drawn anew, and read by zero until training finds a use


@torch.no_grad()
def revive(network: DetectorNet, inputs: Sequence[Tensor]) -> int:
    """Draws the units anew that are zero for every one of these candidates, in place; answers stay as they are.

    inputs: as `DetectorNet.forward` takes them, of many candidates. What is drawn comes from torch's global generator.
    Returns how many units there were.
    """
    active: dict[nn.Module, Tensor] = {}
    blocks = [module for module in network.modules() if isinstance(module, _Block)]
    watched = [*blocks, *(block.down for block in blocks), *(b.placed for b in _branches(network)), network.hidden]

    def note(module: nn.Module, _: object, out: Tensor) -> None:
        active[module] = (out.transpose(0, 1).flatten(1) > 0).any(1)

    hooks = [module.register_forward_hook(note) for module in watched]
    network(*inputs)
    for hook in hooks:
        hook.remove()
    for block in blocks:
        # what only the block's second convolution reads is of use too
        active[block] |= active.pop(block.down)
    column = 0
    for branch in _branches(network):
        blocks = [layer for layer in branch.layers if isinstance(layer, _Block)]
        for block, reader in zip(blocks, [*(block.down for block in blocks[1:]), branch.placed], strict=True):
            dead = ~active[block]
            block.same.weight[:, dead] = 0
            reader.weight[:, dead] = 0
            block.gain[dead] = _GAIN
            for layer in (block.down, block.same):
                _draw_anew(layer, dead)
        width = len(active[blocks[-1]])
        network.hidden.weight[:, column : column + width][:, ~active[blocks[-1]]] = 0
        dead = ~active[branch.placed]
        _draw_anew(branch.placed, dead)
        cells = dead.repeat_interleave((branch.features - width) // _PLACED)
        network.hidden.weight[:, column + width : column + branch.features][:, cells] = 0
        column += branch.features
    dead = ~active[network.hidden]
    _draw_anew(network.hidden, dead)
    network.last.weight[:, dead] = 0
    return sum(int((~units).sum()) for units in active.values())


def _branches(network: DetectorNet) -> tuple[_Branch, ...]:
    return network.fine, network.range_view, network.context


def _draw_anew(layer: nn.Conv2d | nn.Linear, rows: Tensor) -> None:
    new_weight = nn.init.kaiming_normal_(torch.empty_like(layer.weight), nonlinearity="relu")
    layer.weight[rows] = new_weight[rows]
    assert layer.bias is not None
    layer.bias[rows] = 0
