"""Networks that each lack one component, for `ablations.py`."""

from dataclasses import replace

import torch
from torch import Tensor, nn

from lidarpose.models.config import NetworkConfig
from lidarpose.models.layers import Exchange, RotaryEmbedding
from lidarpose.models.posenet import Batch, PoseNet

LEVELS = ("coarse", "mid", "fine")


class Unread(nn.Module):
    """An exchange whose anchors attend only to each other, not to voxels."""

    def __init__(self, exchange: Exchange):
        super().__init__()
        self.norm_self, self.among = exchange.norm_self, exchange.among
        self.norm_feed, self.feed = exchange.norm_feed, exchange.feed

    def forward(
        self,
        anchors: Tensor,
        anchor_places: RotaryEmbedding,
        voxels: Tensor,
        places: RotaryEmbedding,
        log_count: Tensor,
        bias: Tensor,
    ) -> Tensor:
        anchors = anchors + self.read(voxels, bias)
        anchors = anchors + self.among(self.norm_self(anchors), None, None)
        return anchors + self.feed(self.norm_feed(anchors))

    def read(self, voxels: Tensor, bias: Tensor) -> Tensor | float:
        return 0.0


class Pooled(Unread):
    """An exchange that gives all anchors the same input: mean and maximum of the level's voxels."""

    def __init__(self, exchange: Exchange, voxel_channels: int):
        super().__init__(exchange)
        self.norm_voxels = exchange.norm_voxels
        self.mix = nn.Linear(2 * voxel_channels, exchange.feed[0].in_features)

    def read(self, voxels: Tensor, bias: Tensor) -> Tensor:
        valid = bias[:, 0, 0, :, None] == 0
        rows = self.norm_voxels(voxels)
        mean = (rows * valid).sum(1) / valid.sum(1).clamp(min=1)
        maximum = rows.masked_fill(~valid, -1e4).amax(1)
        return self.mix(torch.cat([mean, maximum], -1))[:, None]


def pooled(config: NetworkConfig) -> PoseNet:
    """A network that predicts joints from pooled features instead of anchors with attention to the voxels."""
    network = PoseNet(config)
    fine, mid, coarse = config.channels
    levels = zip(network.exchanges, (coarse, mid, fine), strict=True)
    network.exchanges = nn.ModuleList(Pooled(exchange, channels) for exchange, channels in levels)
    return network


def reading(*levels: str):
    """A factory of networks whose anchors attend only to the voxels of these levels."""

    def make_network(config: NetworkConfig) -> PoseNet:
        network = PoseNet(config)
        pairs = zip(LEVELS, network.exchanges, strict=True)
        network.exchanges = nn.ModuleList(
            exchange if level in levels else Unread(exchange) for level, exchange in pairs
        )
        return network

    return make_network


class Uncounted(PoseNet):
    """A network that does not get the number of points of the voxels."""

    def forward(self, batch: Batch):
        blank = {
            name: replace(level, log_count=torch.zeros_like(level.log_count))
            for name, level in (("fine", batch.fine), ("mid", batch.mid), ("coarse", batch.coarse))
        }
        return super().forward(replace(batch, **blank))


class Unplaced(PoseNet):
    """A network that does not get the direction and distance of the sensor."""

    def forward(self, batch: Batch):
        return super().forward(replace(batch, view=torch.zeros_like(batch.view)))
