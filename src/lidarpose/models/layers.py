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

    def turn(self, x: Tensor, scale: Tensor) -> Tensor:
        """Rotary encoding of x (B, N, H, D): P pairs of each head turn by the row's phases, `scale` as `wave_numbers`.

        The product of two turned vectors depends on the difference of their places in metres alone. The D - 2 P
        channels that are left see no place.
        """
        sin, cos = self._waves(scale)
        pairs = sin.shape[-1]
        a, b, rest = x.split([pairs, pairs, x.shape[-1] - 2 * pairs], -1)
        return torch.cat([a * cos - b * sin, a * sin + b * cos, rest], -1)

    def _waves(self, scale: Tensor) -> tuple[Tensor, Tensor]:
        """Sines and cosines (B, N, H, P) for a layout of heads, shared by all layers that read these rows."""
        layout = scale.shape[0], scale.shape[2]
        if layout not in self._shared:
            phase = (self.position[..., None, :, None] * scale).flatten(-2)
            self._shared[layout] = phase.sin(), phase.cos()
        return self._shared[layout]


def wave_numbers(heads: int, width: int) -> Tensor:
    """(H, 1, P / 3) rad/m for heads of `width` channels, P = 3 * (width // 6): heads share out the wavelengths."""
    each = width // 6
    numbers = [2 * torch.pi / WAVELENGTHS[k % len(WAVELENGTHS)] for k in range(heads * each)]
    return torch.tensor(numbers).view(heads, 1, each)


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
        self.register_buffer("scale", wave_numbers(heads, channels // heads), persistent=False)

    def forward(self, rows: Tensor, places: Places | None, bias: Tensor | None) -> Tensor:
        query, key, value = (
            layer(rows).unflatten(-1, (self.heads, -1)) for layer in (self.query, self.key, self.value)
        )
        if places is not None:
            query, key = places.turn(query, self.scale), places.turn(key, self.scale)
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
        self.register_buffer("scale", wave_numbers(heads, channels // heads), persistent=False)

    def forward(
        self, queries: Tensor, query_places: Places, keys: Tensor, places: Places, log_count: Tensor, bias: Tensor
    ) -> Tensor:
        query = self.query(queries).unflatten(-1, (self.heads, -1))
        query = (query_places.turn(query, self.scale) * query.shape[-1] ** -0.5).transpose(1, 2)
        key = places.turn(self.key(keys).unflatten(-1, (self.heads, -1)), self.scale).transpose(1, 2)
        dense = self.density[:, None, None].to(bias.dtype) * log_count[:, None, None, :]
        # few queries: written out, since the fused kernels give no gradient to a bias
        weight = (query @ key.transpose(-2, -1) + (bias + dense)).softmax(-1).to(keys.dtype)
        # weights sum to 1, so the mean of the values is the value of the mean: no voxel's own is needed
        mean = (weight.flatten(1, 2) @ keys).unflatten(1, (self.heads, -1))
        values = self.value.weight.unflatten(0, (self.heads, -1))
        mixed = (mean @ values.mT).transpose(1, 2).flatten(-2) + self.value.bias
        return self.out(mixed)


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

    The table holds row numbers, N where a cell is empty. After Point Transformer V3's conditional position encoding,
    but that neighbours are seen through `narrow` channels: its cost is theirs.
    """

    def __init__(self, channels: int, narrow: int):
        super().__init__()
        self.norm = nn.LayerNorm(channels)
        self.narrow = nn.Linear(channels, narrow, bias=False)
        self.mix = nn.Linear(27 * narrow, channels)

    def forward(self, rows: Tensor, neighbours: Tensor) -> Tensor:
        people, n, _ = rows.shape
        padded = F.pad(self.narrow(self.norm(rows)), (0, 0, 0, 1)).flatten(0, 1)
        # by row numbers of the whole batch: along dim 1 the gradient of gather is far slower on a CPU
        start = (n + 1) * torch.arange(people, device=rows.device)
        index = (neighbours + start[:, None, None]).flatten()
        return rows + self.mix(padded.index_select(0, index).view(people, n, -1))


def membership(parent: Tensor, valid: Tensor, parents: int, dtype: torch.dtype) -> Tensor:
    """parent (B, N) int, valid (B, N) -> (B, parents, N): 1 where row n belongs to the parent voxel.

    Pooling and unpooling are products with this matrix: on rows of a few hundred voxels that is several times faster
    on a CPU than scattering, has the same gradient on every device, and exports.
    """
    index = torch.arange(parents, device=parent.device)
    return ((parent[:, None, :] == index[:, None]) & valid[:, None, :]).to(dtype)
