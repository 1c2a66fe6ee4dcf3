"""From anchors and voxels to joints: votes, heatmaps in a window around the vote, parts, confidence.

Legend: B people, N fine voxels (padded), J joints, C channels, W heatmap bins.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

# half width of the heatmap's window around the vote, and the width of a bin, in metres
WINDOW, BIN = 0.36, 0.03
BINS = round(2 * WINDOW / BIN)
# half width of the decoding window around the mode, in bins
DECODE = 3


@dataclass(frozen=True, kw_only=True)
class Outputs:
    """Raw results in the person's frame. vote (B, J, 3) m; heatmap (B, J, 3, W) logits around the vote; part (B, N, P)
    logits of each fine voxel, 0 = not body; confidence (B, J) logit of an error under 10 cm; log_spread (B, J) log of
    the expected error in m; level_joints: one (B, J, 3) m a coarser level, read off its anchors."""

    vote: Tensor
    heatmap: Tensor
    part: Tensor
    confidence: Tensor
    log_spread: Tensor
    level_joints: tuple[Tensor, ...]

    def joints(self) -> Tensor:
        """(B, J, 3) m: the vote plus the heatmap's offset."""
        return self.vote + decode(self.heatmap)


def bin_centers(device: torch.device | None = None) -> Tensor:
    """(W,) m: offsets from the vote at the middle of each bin."""
    return (torch.arange(BINS, device=device) + 0.5) * BIN - WINDOW


def decode(logits: Tensor) -> Tensor:
    """logits (..., W) -> (...) m: expectation of the softmax within `DECODE` bins of its mode.

    A mean over all bins would fall between the two peaks of a left/right doubt; the window keeps to one of them.
    """
    mode = logits.argmax(-1, keepdim=True)
    near = (torch.arange(BINS, device=logits.device) - mode).abs() <= DECODE
    weight = torch.softmax(logits.masked_fill(~near, -1e4), -1)
    return (weight * bin_centers(logits.device)).sum(-1)


def encode(offset: Tensor, sigma: float) -> Tensor:
    """offset (...) m from the vote -> (..., W): a Gaussian of `sigma` m over the bins, normalised to sum 1."""
    distance = (offset[..., None] - bin_centers(offset.device)) / sigma
    return torch.softmax(-0.5 * distance**2, -1)


class VoteHead(nn.Module):
    """Every voxel votes for every joint: its position plus an offset, weighted by a softmax over the voxels.

    Offsets begin at zero, so an untrained head already puts joints among the points.
    """

    def __init__(self, channels: int, joints: int):
        super().__init__()
        self.query = nn.Linear(channels, channels)
        self.key = nn.Linear(channels, channels)
        self.offset = nn.Linear(channels, 3 * joints)
        self.residual = nn.Linear(channels, 3)
        for layer in (self.offset, self.residual):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, anchors: Tensor, voxels: Tensor, position: Tensor, bias: Tensor) -> tuple[Tensor, Tensor]:
        """Returns vote (B, J, 3) m and what the voters felt, (B, J, C)."""
        scale = voxels.shape[-1] ** -0.5
        weight = torch.softmax(self.query(anchors) @ self.key(voxels).transpose(1, 2) * scale + bias[:, 0], -1)
        offset = self.offset(voxels).unflatten(-1, (-1, 3))
        moved = (weight.transpose(1, 2)[..., None] * offset).sum(1)
        return weight @ position + moved + self.residual(anchors), weight @ voxels


class JointHead(nn.Module):
    """Heatmaps, confidence and spread of each joint from its anchor, what its voters felt, and where it stands."""

    def __init__(self, channels: int):
        super().__init__()
        self.norm = nn.LayerNorm(2 * channels)
        self.hidden = nn.Sequential(nn.Linear(2 * channels + 3, 2 * channels), nn.GELU(approximate="tanh"))
        self.heatmap = nn.Linear(2 * channels, 3 * BINS)
        self.certainty = nn.Linear(2 * channels, 2)

    def forward(self, anchors: Tensor, felt: Tensor, vote: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Returns heatmap (B, J, 3, W), confidence (B, J), log_spread (B, J)."""
        hidden = self.hidden(torch.cat([self.norm(torch.cat([anchors, felt], -1)), vote.detach()], -1))
        confidence, log_spread = self.certainty(hidden).unbind(-1)
        return self.heatmap(hidden).unflatten(-1, (3, BINS)), confidence, log_spread
