"""`PoseNet`: a point-transformer U-Net over voxels whose joint anchors collect features at every density level.

Legend: B people, F / M / N rows of the fine, mid and coarse level (padded), J joints, C channels, W heatmap bins.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from lidarpose.models.config import BIN, NetworkConfig
from lidarpose.models.layers import (
    PLACE_FEATURES,
    REACH,
    Block,
    Convolution,
    Exchange,
    FeedForward,
    JointHead,
    PersonHead,
    RotaryEmbedding,
    VoteHead,
    decode,
    key_bias,
    membership,
)
from lidarpose.models.onnx import output_names
from lidarpose.models.voxelize import VoxelLevel
from lidarpose.skeleton import skeleton

# features of a fine voxel besides its position: offset in the cell (3), deviation (3), log counts of itself, its parent
# and its grandparent (3)
VOXEL_FEATURES = 9
VIEW_FEATURES = 5


@dataclass(frozen=True, kw_only=True)
class Batch:
    """The network's inputs: the tables of a `voxelize.VoxelPyramid` as tensors."""

    fine: VoxelLevel[Tensor]
    mid: VoxelLevel[Tensor]
    coarse: VoxelLevel[Tensor]
    deviation: Tensor
    offset: Tensor
    view: Tensor

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray | Tensor], device: torch.device | str = "cpu") -> "Batch":
        """From `VoxelPyramid.arrays`; names that are not fields of a batch are ignored."""

        def tensors(kind: type, prefix: str = "") -> dict[str, Any]:
            names = [field.name for field in fields(kind) if prefix + field.name in arrays]
            return {name: torch.as_tensor(arrays[prefix + name]).to(device) for name in names}

        levels: dict[str, Any] = {
            name: VoxelLevel(**tensors(VoxelLevel, f"{name}.")) for name in ("fine", "mid", "coarse")
        }
        return cls(**levels, **tensors(cls))


@dataclass(frozen=True, kw_only=True)
class Targets:
    """Training targets.

    joints (B, J, 3) m in the person's frame; known (B, J) bool: false without ground truth, for a dataset that labels
    only some of the skeleton's joints; visible (B, J): 1 if some point lies near the joint, 0 if none does, NaN if
    unknown, see `train.augment.visible_joints`; part (B, F) int64, the majority part of each fine voxel's points, -1
    for padding or unknown; person (B, 2): 1 if the crop shows a person, and if it shows a second one, 0 if not, NaN if
    unknown.
    """

    joints: Tensor
    known: Tensor
    visible: Tensor
    part: Tensor
    person: Tensor

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray], device: torch.device | str = "cpu") -> "Targets":
        return cls(**{field.name: torch.as_tensor(arrays[field.name]).to(device) for field in fields(cls)})


@dataclass(frozen=True, kw_only=True)
class Outputs:
    """Raw results in the person's frame.

    vote (B, J, 3) m; heatmap (B, J, 3, W) logits centered on the vote, or on the origin if the network has no votes
    (vote is then zero), (B, J, 1, 0) without heatmaps; part (B, N, P) logits of each fine voxel, 0 = background;
    confidence (B, J) logit of an error under 10 cm; log_spread (B, J) log of the expected error in m; visible (B, J)
    logit of the joint being visible; level_joints: one (B, J, 3) m per coarser level, predicted from its anchors;
    has_votes: whether the network votes; person (B, 2) logits of a person and of a second one in the crop, if the
    network predicts them.
    """

    vote: Tensor
    heatmap: Tensor
    part: Tensor
    confidence: Tensor
    log_spread: Tensor
    visible: Tensor
    level_joints: tuple[Tensor, ...]
    has_votes: bool = True
    person: Tensor | None = None

    def joints(self) -> Tensor:
        """(B, J, 3) m: the vote plus the heatmap's offset."""
        return self.vote + decode(self.heatmap) if self.heatmap.shape[-1] else self.vote


class PoseNet(nn.Module):
    """Maps people, voxelized into a `Batch`, to raw `Outputs`. A pure function of the batch's tensors."""

    def __init__(self, config: NetworkConfig):
        super().__init__()
        self.config = config
        self.skeleton = skeleton(config.skeleton)
        joints = len(self.skeleton)
        fine, mid, coarse = config.channels
        width, heads = mid, mid // config.head_channels
        encoder, bottleneck, decoder = config.blocks

        self.stem = _Stem(fine)
        self.down_mid, self.down_coarse = _Down(fine, mid), _Down(mid, coarse)
        self.encoder = _Stage(mid, config.head_channels, encoder, config.convolution)
        self.bottleneck = _Stage(coarse, config.head_channels, bottleneck, config.convolution)
        self.decoder = _Stage(mid, config.head_channels, decoder, config.convolution)
        self.up_mid, self.up_fine = nn.Linear(coarse, mid), nn.Linear(mid, fine)
        self.fine_norm, self.fine_feed = nn.LayerNorm(fine), FeedForward(fine)

        self.anchors = nn.Parameter(torch.randn(joints, width) * 0.02)
        self.anchor_view = nn.Linear(VIEW_FEATURES, width)
        self.exchanges = nn.ModuleList(Exchange(width, heads, channels) for channels in (coarse, mid, fine))
        self.level_joints = nn.ModuleList(nn.Linear(width, 3) for _ in range(2))

        self.vote = None if config.heatmap == "full" else VoteHead(width, fine, joints)
        bins = round(2 * REACH[config.heatmap] / BIN) if config.heatmap in REACH else 0
        self.joint = JointHead(width, fine if self.vote is not None else 0, bins)
        self.part = nn.Linear(fine, config.parts)
        self.person = PersonHead(width, fine, joints) if config.person else None

    def forward(self, batch: Batch) -> Outputs:
        fine, mid, coarse = batch.fine, batch.mid, batch.coarse
        dtype = batch.view.dtype
        fine_bias, mid_bias, coarse_bias = (key_bias(level.valid, dtype) for level in (fine, mid, coarse))
        fine_places, mid_places, coarse_places = (RotaryEmbedding(level.position) for level in (fine, mid, coarse))
        mid_of_fine = membership(fine.parent, fine.valid, mid.valid.shape[1], dtype)
        coarse_of_mid = membership(mid.parent, mid.valid, coarse.valid.shape[1], dtype)

        fine_rows = self.stem(self._features(batch, fine_places, mid_of_fine, coarse_of_mid), batch.view)
        mid_rows = self.down_mid(fine_rows, mid_of_fine, mid_places)
        mid_rows = self.encoder(mid_rows, mid_places, mid_bias, mid.neighbors)
        coarse_rows = self.down_coarse(mid_rows, coarse_of_mid, coarse_places)
        coarse_rows = self.bottleneck(coarse_rows, coarse_places, coarse_bias, coarse.neighbors)

        anchors = self.anchors + self.anchor_view(batch.view)[:, None]
        anchor_places = RotaryEmbedding(torch.zeros_like(anchors[..., :3]))
        anchors = self.exchanges[0](anchors, anchor_places, coarse_rows, coarse_places, coarse.log_count, coarse_bias)
        coarse_joints = self.level_joints[0](anchors)

        mid_rows = mid_rows + coarse_of_mid.transpose(1, 2) @ self.up_mid(coarse_rows)
        mid_rows = self.decoder(mid_rows, mid_places, mid_bias, mid.neighbors)
        anchor_places = RotaryEmbedding(coarse_joints.detach())
        anchors = self.exchanges[1](anchors, anchor_places, mid_rows, mid_places, mid.log_count, mid_bias)
        mid_joints = self.level_joints[1](anchors)

        fine_rows = fine_rows + mid_of_fine.transpose(1, 2) @ self.up_fine(mid_rows)
        fine_rows = fine_rows + self.fine_feed(self.fine_norm(fine_rows))
        anchor_places = RotaryEmbedding(mid_joints.detach())
        anchors = self.exchanges[2](anchors, anchor_places, fine_rows, fine_places, fine.log_count, fine_bias)

        vote, voter_features = torch.zeros_like(mid_joints), anchors[..., :0]
        if self.vote is not None:
            vote, voter_features = self.vote(anchors, fine_rows, fine.position, fine_bias)
        heatmap, *certainty = self.joint(anchors, voter_features, vote)
        confidence, log_spread, visible = certainty
        person = None if self.person is None else self.person(anchors, fine_rows, fine.valid, certainty)
        return Outputs(
            vote=vote,
            heatmap=heatmap,
            part=self.part(fine_rows),
            confidence=confidence,
            log_spread=log_spread,
            visible=visible,
            level_joints=(coarse_joints, mid_joints),
            has_votes=self.vote is not None,
            person=person,
        )

    def _features(self, batch: Batch, places: RotaryEmbedding, mid_of_fine: Tensor, coarse_of_mid: Tensor) -> Tensor:
        """(B, F, ...): position, mean and spread of the points inside, and density at three scales."""
        coarse_count = coarse_of_mid.transpose(1, 2) @ batch.coarse.log_count[..., None]
        parents = torch.cat([batch.mid.log_count[..., None], coarse_count], -1)
        density = torch.cat([batch.fine.log_count[..., None], mid_of_fine.transpose(1, 2) @ parents], -1)
        # deviations inside a cell are a few centimeters, so they are scaled to order one
        return torch.cat([places.features(), batch.offset, batch.deviation / self.config.grid, density], -1)


class ArrayModule(nn.Module):
    """A network as a function of a pyramid's arrays in the order of `names`, which returns the outputs in the order of
    `output_names`."""

    def __init__(self, network: PoseNet, names: tuple[str, ...]):
        super().__init__()
        self.network = network
        self.names = names
        self.outputs = output_names(network.config)

    def forward(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        outputs = self.network(Batch.from_arrays(dict(zip(self.names, tensors, strict=True)), tensors[0].device))
        return tuple(getattr(outputs, name) for name in self.outputs)


class _Stem(nn.Module):
    """Maps the features of fine voxels and of the view to the first hidden features."""

    def __init__(self, channels: int):
        super().__init__()
        self.voxel = nn.Linear(PLACE_FEATURES + VOXEL_FEATURES, 2 * channels)
        # equal for all voxels of a person, so it is projected once and added instead of concatenated
        self.view = nn.Linear(VIEW_FEATURES, 2 * channels, bias=False)
        self.act = nn.SiLU()
        self.out = nn.Linear(2 * channels, channels)

    def forward(self, features: Tensor, view: Tensor) -> Tensor:
        return self.out(self.act(self.voxel(features) + self.view(view)[:, None]))


class _Down(nn.Module):
    """Pools voxels of one level to their parents: the children's mean, plus a function of the parent's position."""

    def __init__(self, channels: int, out_channels: int):
        super().__init__()
        self.norm = nn.LayerNorm(channels)
        self.mix = nn.Linear(channels, out_channels)
        self.place = nn.Linear(PLACE_FEATURES, out_channels)

    def forward(self, rows: Tensor, member: Tensor, places: RotaryEmbedding) -> Tensor:
        mean = (member @ rows) / member.sum(-1, keepdim=True).clamp(min=1)
        return self.mix(self.norm(mean)) + self.place(places.features())


class _Stage(nn.Module):
    """The blocks of one level, with a convolution before each block if configured."""

    def __init__(self, channels: int, head_channels: int, count: int, convolution: int):
        super().__init__()
        self.blocks = nn.ModuleList(Block(channels, channels // head_channels) for _ in range(count))
        convolutions = count if convolution else 0
        self.convolutions = nn.ModuleList(Convolution(channels, convolution) for _ in range(convolutions))

    def forward(self, rows: Tensor, places: RotaryEmbedding, bias: Tensor, neighbors: Tensor | None) -> Tensor:
        for k, block in enumerate(self.blocks):
            if self.convolutions:
                rows = self.convolutions[k](rows, neighbors)
            rows = block(rows, places, bias)
        return rows
