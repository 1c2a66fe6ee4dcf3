"""The network's bricks: position features, attention over padded rows, feed-forward, pooling between levels.

Legend: B people, N rows (padded), K keys (padded), C channels, H heads.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

# wavelengths in metres of the position features: from a fine voxel to a person's height
WAVELENGTHS = (0.15, 0.3, 0.6, 1.2, 2.4)
POSITION_FEATURES = 3 + 6 * len(WAVELENGTHS)


def position_features(position: Tensor) -> Tensor:
    """position (..., 3) m -> (..., POSITION_FEATURES): the coordinates, and sines and cosines at `WAVELENGTHS`."""
    scale = position.new_tensor([2 * torch.pi / w for w in WAVELENGTHS])
    phase = (position[..., None, :] * scale[:, None]).flatten(-2)
    return torch.cat([position, phase.sin(), phase.cos()], -1)


def key_bias(valid: Tensor, dtype: torch.dtype) -> Tensor:
    """valid (B, K) bool -> (B, 1, 1, K), 0 for a key to read and a large negative number for padding.

    A person without any valid key attends to its padding evenly: finite, and discarded by the caller.
    """
    return torch.where(valid, 0.0, -1e4).to(dtype)[:, None, None, :]


class Attention(nn.Module):
    """Multi-head attention of rows (B, N, C) to keys (B, K, C); self-attention when both are the same rows."""

    def __init__(self, channels: int, heads: int):
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(channels, channels)
        self.key_value = nn.Linear(channels, 2 * channels)
        self.out = nn.Linear(channels, channels)

    def forward(self, rows: Tensor, keys: Tensor, bias: Tensor | None) -> Tensor:
        people, n, channels = rows.shape
        query = self.query(rows).view(people, n, self.heads, -1).transpose(1, 2)
        key, value = self.key_value(keys).view(people, keys.shape[1], 2, self.heads, -1).permute(2, 0, 3, 1, 4)
        mixed = F.scaled_dot_product_attention(query, key, value, attn_mask=bias)
        return self.out(mixed.transpose(1, 2).reshape(people, n, channels))


class FeedForward(nn.Sequential):
    """Linear, GELU, Linear: C -> ratio C -> C."""

    def __init__(self, channels: int, ratio: int = 2):
        super().__init__(
            nn.Linear(channels, ratio * channels), nn.GELU(approximate="tanh"), nn.Linear(ratio * channels, channels)
        )


class Block(nn.Module):
    """A pre-norm transformer block over the voxels of one level, attention over all of a person's rows."""

    def __init__(self, channels: int, heads: int):
        super().__init__()
        self.norm_attention = nn.LayerNorm(channels)
        self.attention = Attention(channels, heads)
        self.norm_feed = nn.LayerNorm(channels)
        self.feed = FeedForward(channels)

    def forward(self, rows: Tensor, bias: Tensor) -> Tensor:
        normed = self.norm_attention(rows)
        rows = rows + self.attention(normed, normed, bias)
        return rows + self.feed(self.norm_feed(rows))


def membership(parent: Tensor, valid: Tensor, parents: int) -> Tensor:
    """parent (B, N) int, valid (B, N) -> (B, parents, N) float: 1 where row n belongs to the parent voxel.

    Pooling and unpooling are products with this matrix: on rows of a few hundred voxels that is several times faster
    on a CPU than scattering, has the same gradient on every device, and exports.
    """
    index = torch.arange(parents, device=parent.device)
    return ((parent[:, None, :] == index[:, None]) & valid[:, None, :]).to(torch.get_default_dtype())
