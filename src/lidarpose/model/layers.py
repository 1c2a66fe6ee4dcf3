"""The network's bricks: places as sines, attention that knows where and how dense, feed-forward, pooling.

Legend: B people, N rows (padded), K keys (padded), C channels, H heads, D channels a head, P rotated pairs a head.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

# wavelengths in metres of the position features and the rotary encoding: from a fine voxel to twice a person's height
WAVELENGTHS = (0.15, 0.25, 0.4, 0.65, 1.05, 1.7, 2.7, 4.4)
PLACE_FEATURES = 3 + 6 * len(WAVELENGTHS)


class Places:
    """Where rows (B, N, 3) m stand, as sines and cosines that position features and rotary attention share."""

    def __init__(self, position: Tensor):
        scale = position.new_tensor([2 * torch.pi / w for w in WAVELENGTHS])
        phase = position[..., None] * scale
        self.position = position
        self.sin, self.cos = phase.sin(), phase.cos()
        self._shared: dict[tuple[int, int], tuple[Tensor, Tensor]] = {}

    def features(self) -> Tensor:
        """(B, N, PLACE_FEATURES): the coordinates, their sines and their cosines."""
        return torch.cat([self.position, self.sin.flatten(-2), self.cos.flatten(-2)], -1)

    def turn(self, x: Tensor) -> Tensor:
        """Rotary encoding of x (B, N, H, D): P = 3 * (D // 6) pairs of each head turn by the row's phases.

        The product of two turned vectors depends on the difference of their places in metres alone. Heads share out the
        wavelengths; the D - 2 P channels that are left see no place.
        """
        heads, width = x.shape[-2:]
        each = width // 6
        sin, cos = self._waves(heads, each)
        a, b, rest = x.split([3 * each, 3 * each, width - 6 * each], -1)
        return torch.cat([a * cos - b * sin, a * sin + b * cos, rest], -1)

    def _waves(self, heads: int, each: int) -> tuple[Tensor, Tensor]:
        """Sines and cosines (B, N, H, P) for a layout of heads, shared by all layers that read these rows."""
        if (heads, each) not in self._shared:
            pick = torch.arange(heads * each, device=self.sin.device) % len(WAVELENGTHS)
            sin, cos = (
                wave[..., pick].unflatten(-1, (heads, each)).movedim(-3, -2).flatten(-2)
                for wave in (self.sin, self.cos)
            )
            self._shared[heads, each] = sin, cos
        return self._shared[heads, each]


def key_bias(valid: Tensor, dtype: torch.dtype) -> Tensor:
    """valid (B, K) bool -> (B, 1, 1, K), 0 for a key to read and a large negative number for padding.

    A person without any valid key attends to its padding evenly: finite, and discarded by the caller.
    """
    return torch.where(valid, 0.0, -1e4).to(dtype)[:, None, None, :]


class SelfAttention(nn.Module):
    """Multi-head self-attention of rows (B, N, C), all of a person's to all, with rotary places."""

    def __init__(self, channels: int, heads: int):
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(channels, channels)
        self.key = nn.Linear(channels, channels)
        self.value = nn.Linear(channels, channels)
        self.out = nn.Linear(channels, channels)

    def forward(self, rows: Tensor, places: Places | None, bias: Tensor | None) -> Tensor:
        query, key, value = (
            layer(rows).unflatten(-1, (self.heads, -1)) for layer in (self.query, self.key, self.value)
        )
        if places is not None:
            query, key = places.turn(query), places.turn(key)
        query, key, value = (x.transpose(1, 2) for x in (query, key, value))
        mixed = F.scaled_dot_product_attention(query, key, value, attn_mask=bias)
        return self.out(mixed.transpose(1, 2).flatten(-2))


class CrossAttention(nn.Module):
    """Attention of queries (B, J, C) to the voxels (B, K, E) of a level: by content, by place and by density.

    A head's weight of a voxel is multiplied by (its number of points) ** density, a learned exponent a head: 0 reads
    voxels alike, 1 reads points alike.
    """

    def __init__(self, channels: int, heads: int, key_channels: int):
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(channels, channels)
        self.key = nn.Linear(key_channels, channels)
        self.value = nn.Linear(key_channels, channels)
        self.out = nn.Linear(channels, channels)
        self.density = nn.Parameter(torch.linspace(0, 1, heads))

    def forward(
        self, queries: Tensor, query_places: Places, keys: Tensor, places: Places, log_count: Tensor, bias: Tensor
    ) -> Tensor:
        query = self.query(queries).unflatten(-1, (self.heads, -1))
        query = (query_places.turn(query) * query.shape[-1] ** -0.5).transpose(1, 2)
        key = places.turn(self.key(keys).unflatten(-1, (self.heads, -1))).transpose(1, 2)
        value = self.value(keys).unflatten(-1, (self.heads, -1)).transpose(1, 2)
        dense = self.density[:, None, None].to(bias.dtype) * log_count[:, None, None, :]
        # few queries: written out, since the fused kernels give no gradient to a bias
        logits = query @ key.transpose(-2, -1) + (bias + dense)
        mixed = logits.softmax(-1).to(value.dtype) @ value
        return self.out(mixed.transpose(1, 2).flatten(-2))


class FeedForward(nn.Sequential):
    """Linear, SiLU, Linear: C -> ratio C -> C. SiLU for a quarter of GELU's cost on a CPU."""

    def __init__(self, channels: int, ratio: int = 2):
        super().__init__(nn.Linear(channels, ratio * channels), nn.SiLU(), nn.Linear(ratio * channels, channels))


class Block(nn.Module):
    """A pre-norm transformer block over the voxels of one level, attention over all of a person's rows."""

    def __init__(self, channels: int, heads: int):
        super().__init__()
        self.norm_attention = nn.LayerNorm(channels)
        self.attention = SelfAttention(channels, heads)
        self.norm_feed = nn.LayerNorm(channels)
        self.feed = FeedForward(channels)

    def forward(self, rows: Tensor, places: Places, bias: Tensor) -> Tensor:
        rows = rows + self.attention(self.norm_attention(rows), places, bias)
        return rows + self.feed(self.norm_feed(rows))


class Convolution(nn.Module):
    """A residual submanifold convolution, 3 x 3 x 3, of rows (B, N, C) by a table of neighbours (B, N, 27).

    The table holds row numbers, N where a cell is empty. After Point Transformer V3's conditional position encoding.
    """

    def __init__(self, channels: int):
        super().__init__()
        self.norm = nn.LayerNorm(channels)
        self.mix = nn.Linear(27 * channels, channels)

    def forward(self, rows: Tensor, neighbours: Tensor) -> Tensor:
        people, n, channels = rows.shape
        padded = F.pad(self.norm(rows), (0, 0, 0, 1))
        index = neighbours.flatten(1)[..., None].expand(-1, -1, channels)
        return rows + self.mix(padded.gather(1, index).view(people, n, 27 * channels))


def membership(parent: Tensor, valid: Tensor, parents: int, dtype: torch.dtype) -> Tensor:
    """parent (B, N) int, valid (B, N) -> (B, parents, N): 1 where row n belongs to the parent voxel.

    Pooling and unpooling are products with this matrix: on rows of a few hundred voxels that is several times faster
    on a CPU than scattering, has the same gradient on every device, and exports.
    """
    index = torch.arange(parents, device=parent.device)
    return ((parent[:, None, :] == index[:, None]) & valid[:, None, :]).to(dtype)
