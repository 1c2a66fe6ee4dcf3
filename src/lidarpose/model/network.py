"""`PoseNet`: a point-transformer U-Net over voxels whose joint anchors gather evidence at every density level.

Legend: B people, F / M / N rows of the fine, mid and coarse level (padded), J joints, C channels.
"""

import torch
from torch import Tensor, nn

from lidarpose.model.batch import Batch, LevelTensors
from lidarpose.model.exchange import Exchange
from lidarpose.model.heads import JointHead, Outputs, VoteHead
from lidarpose.model.layers import (
    POSITION_FEATURES,
    Block,
    FeedForward,
    key_bias,
    membership,
    position_features,
)
from lidarpose.model.presets import NetworkConfig
from lidarpose.skeleton import skeleton

# what a fine voxel knows besides its place: offset in the cell (3), deviation (3), log counts of itself and its parents
VOXEL_FEATURES = 9
VIEW_FEATURES = 5


class PoseNet(nn.Module):
    """Points of people, planned into a `Batch`, to raw `Outputs`. A pure function of the batch's tensors."""

    def __init__(self, config: NetworkConfig):
        super().__init__()
        self.config = config
        self.skeleton = skeleton(config.skeleton)
        c, heads = config.channels, config.heads
        encoder, bottleneck, decoder = config.blocks

        self.stem = nn.Sequential(
            nn.Linear(POSITION_FEATURES + VOXEL_FEATURES + VIEW_FEATURES, 2 * c),
            nn.GELU(approximate="tanh"),
            nn.Linear(2 * c, c),
        )
        self.down_mid, self.down_coarse = _Down(c), _Down(c)
        self.encoder = nn.ModuleList(Block(c, heads) for _ in range(encoder))
        self.bottleneck = nn.ModuleList(Block(c, heads) for _ in range(bottleneck))
        self.decoder = nn.ModuleList(Block(c, heads) for _ in range(decoder))
        self.up_mid, self.up_fine = nn.Linear(c, c), nn.Linear(c, c)
        self.fine_norm, self.fine_feed = nn.LayerNorm(c), FeedForward(c)

        self.anchors = nn.Parameter(torch.randn(len(self.skeleton), c) * 0.02)
        self.anchor_view = nn.Linear(VIEW_FEATURES, c)
        self.exchanges = nn.ModuleList(Exchange(c, heads) for _ in range(3))
        self.level_joints = nn.ModuleList(nn.Linear(c, 3) for _ in range(2))

        self.vote = VoteHead(c, len(self.skeleton))
        self.joint = JointHead(c)
        self.part = nn.Linear(c, config.parts)

    def forward(self, batch: Batch) -> Outputs:
        fine, mid, coarse = batch.fine, batch.mid, batch.coarse
        fine_bias, mid_bias, coarse_bias = (key_bias(level.valid, batch.view.dtype) for level in (fine, mid, coarse))
        mid_of_fine = membership(fine.parent, fine.valid, mid.valid.shape[1])
        coarse_of_mid = membership(mid.parent, mid.valid, coarse.valid.shape[1])

        fine_rows = self.stem(self._features(batch, mid_of_fine, coarse_of_mid))
        mid_rows = self.down_mid(fine_rows, mid_of_fine, mid)
        for block in self.encoder:
            mid_rows = block(mid_rows, mid_bias)
        coarse_rows = self.down_coarse(mid_rows, coarse_of_mid, coarse)
        for block in self.bottleneck:
            coarse_rows = block(coarse_rows, coarse_bias)

        anchors = self.anchors + self.anchor_view(batch.view)[:, None]
        anchors = self.exchanges[0](anchors, coarse_rows, coarse_bias)
        level_joints = [self.level_joints[0](anchors)]

        mid_rows = mid_rows + coarse_of_mid.transpose(1, 2) @ self.up_mid(coarse_rows)
        for block in self.decoder:
            mid_rows = block(mid_rows, mid_bias)
        anchors = self.exchanges[1](anchors, mid_rows, mid_bias)
        level_joints.append(self.level_joints[1](anchors))

        fine_rows = fine_rows + mid_of_fine.transpose(1, 2) @ self.up_fine(mid_rows)
        fine_rows = fine_rows + self.fine_feed(self.fine_norm(fine_rows))
        anchors = self.exchanges[2](anchors, fine_rows, fine_bias)

        vote, felt = self.vote(anchors, fine_rows, fine.position, fine_bias)
        heatmap, confidence, log_spread = self.joint(anchors, felt, vote)
        return Outputs(
            vote=vote,
            heatmap=heatmap,
            part=self.part(fine_rows),
            confidence=confidence,
            log_spread=log_spread,
            level_joints=tuple(level_joints),
        )

    def _features(self, batch: Batch, mid_of_fine: Tensor, coarse_of_mid: Tensor) -> Tensor:
        """(B, F, ...): place, spread of the points inside, density at three scales, and the view of the sensor."""
        fine = batch.fine
        coarse_count = coarse_of_mid.transpose(1, 2) @ batch.coarse.log_count[..., None]
        parents = torch.cat([batch.mid.log_count[..., None], coarse_count], -1)
        density = torch.cat([fine.log_count[..., None], mid_of_fine.transpose(1, 2) @ parents], -1)
        view = batch.view[:, None].expand(-1, fine.valid.shape[1], -1)
        # deviations inside a cell are a few centimetres: brought to order one
        return torch.cat(
            [position_features(fine.position), batch.offset, batch.deviation / self.config.grid, density, view], -1
        )


class _Down(nn.Module):
    """Voxels of one level to their parents: the mean of the children, and where the parent lies."""

    def __init__(self, channels: int):
        super().__init__()
        self.norm = nn.LayerNorm(channels)
        self.mix = nn.Linear(channels, channels)
        self.place = nn.Linear(POSITION_FEATURES, channels)

    def forward(self, rows: Tensor, member: Tensor, level: LevelTensors) -> Tensor:
        mean = (member @ rows) / member.sum(-1, keepdim=True).clamp(min=1)
        return self.mix(self.norm(mean)) + self.place(position_features(level.position))
