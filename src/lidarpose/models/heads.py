"""From anchors and voxels to joints: votes, heatmaps about them, parts, confidence, visibility.

Legend: B people, N fine voxels (padded), J joints, C channels, W heatmap bins.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from lidarpose.models.config import BIN
from lidarpose.models.decode import HALF_WIDTH

# half the width of a heatmap's range: about the vote, or about the person's center; metres
REACH = {"window": 0.36, "full": 1.2}


@dataclass(frozen=True, kw_only=True)
class Outputs:
    """Raw results in the person's frame.

    vote (B, J, 3) m; heatmap (B, J, 3, W) logits about the vote, or about the origin where the network has no votes
    (vote is then zero), W = 0 where it has no heatmaps; part (B, N, P) logits of each fine voxel, 0 = not body;
    confidence (B, J) logit of an error under 10 cm; log_spread (B, J) log of the expected error in m; visible (B, J)
    logit of the joint being seen; level_joints: one (B, J, 3) m a coarser level, read off its anchors; has_votes:
    whether the network votes at all.
    """

    vote: Tensor
    heatmap: Tensor
    part: Tensor
    confidence: Tensor
    log_spread: Tensor
    visible: Tensor
    level_joints: tuple[Tensor, ...]
    has_votes: bool = True

    def joints(self) -> Tensor:
        """(B, J, 3) m: the vote plus the heatmap's offset."""
        return self.vote + decode(self.heatmap) if self.heatmap.shape[-1] else self.vote


def bin_centers(bins: int, device: torch.device | None = None) -> Tensor:
    """(W,) m: offsets from the heatmap's origin at the middle of each bin."""
    return _offset(torch.arange(bins, device=device), bins)


def _offset(at: Tensor, bins: int) -> Tensor:
    """at (...) bins -> (...) m from the heatmap's origin, which is the middle of all bins."""
    return (at + 0.5 - bins / 2) * BIN


def decode(logits: Tensor) -> Tensor:
    """logits (..., W) -> (...) m from the heatmap's origin: `mean_bin` as a length."""
    return _offset(mean_bin(logits), logits.shape[-1])


def mean_bin(logits: Tensor) -> Tensor:
    """logits (..., W) -> (...) bins: expectation of the softmax within `HALF_WIDTH` bins of its mode, fewer at an edge.

    A mean over all bins would fall between the two peaks of a left/right doubt; the window keeps to one of them. It has
    as many bins on either side of the mode: a window that an edge cuts would lean inwards. Computed in float32, since
    half types cannot tell bins of the hundreds apart. Twin in numpy, for whoever has no torch: `decode.window`.
    """
    bins = logits.shape[-1]
    mode = logits.argmax(-1, keepdim=True)
    reach = torch.minimum(mode, bins - 1 - mode).clamp(max=HALF_WIDTH)
    index = torch.arange(bins, device=logits.device)
    # finite: a softmax's gradient at -inf may not be a number
    weight = logits.float().masked_fill((index - mode).abs() > reach, -1e4).softmax(-1)
    return (weight * index).sum(-1)


def encode(offset: Tensor, sigma: float, bins: int) -> Tensor:
    """offset (...) m from the heatmap's origin -> (..., W): a Gaussian of `sigma` m over the bins, of sum 1."""
    distance = (offset[..., None] - bin_centers(bins, offset.device)) / sigma
    return torch.softmax(-0.5 * distance**2, -1)


class VoteHead(nn.Module):
    """Every voxel votes for every joint: its position plus an offset, weighted by a softmax over the voxels.

    A voxel's offset is linear in its features, so the weighted mean of offsets is the offset of the weighted mean: no
    voxel's own is ever needed. Offsets begin at zero, so an untrained head already puts joints among the points.
    """

    def __init__(self, channels: int, voxel_channels: int, joints: int):
        super().__init__()
        self.query = nn.Linear(channels, voxel_channels)
        self.key = nn.Linear(voxel_channels, voxel_channels)
        self.offset = nn.Parameter(torch.zeros(joints, voxel_channels, 3))
        self.residual = nn.Linear(channels, 3)
        nn.init.zeros_(self.residual.weight)
        nn.init.zeros_(self.residual.bias)

    def forward(self, anchors: Tensor, voxels: Tensor, position: Tensor, bias: Tensor) -> tuple[Tensor, Tensor]:
        """Returns vote (B, J, 3) m and what the voters felt, (B, J, C)."""
        query = self.query(anchors) * voxels.shape[-1] ** -0.5
        weight = torch.softmax(query @ self.key(voxels).transpose(1, 2) + bias[:, 0], -1)
        felt = weight @ voxels
        return weight @ position + (felt[:, :, None] @ self.offset).squeeze(2) + self.residual(anchors), felt


class JointHead(nn.Module):
    """Heatmaps, confidence, spread and visibility of each joint from its anchor, what its voters felt, and its vote."""

    def __init__(self, channels: int, voxel_channels: int, bins: int):
        super().__init__()
        self.bins = bins
        wide = channels + voxel_channels
        self.norm = nn.LayerNorm(wide)
        self.hidden = nn.Sequential(nn.Linear(wide + 3, 2 * channels), nn.SiLU())
        self.heatmap = nn.Linear(2 * channels, 3 * bins) if bins else None
        self.certainty = nn.Linear(2 * channels, 3)

    def forward(self, anchors: Tensor, felt: Tensor, vote: Tensor) -> tuple[Tensor, ...]:
        """Returns heatmap (B, J, 3, W), of no bins (B, J, 1, 0); confidence, log_spread, visible (B, J)."""
        hidden = self.hidden(torch.cat([self.norm(torch.cat([anchors, felt], -1)), vote.detach()], -1))
        certainty = self.certainty(hidden).unbind(-1)
        if self.heatmap is None:
            return hidden[..., None, :0], *certainty
        return self.heatmap(hidden).unflatten(-1, (3, self.bins)), *certainty
