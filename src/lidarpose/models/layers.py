"""The network's layers: rotary positions, attention that knows where and how dense, exchange, pooling, joint heads.

Legend: B people, N rows (padded), K keys (padded), C channels, H heads, D channels a head, P rotated pairs a head, J
joints, W heatmap bins.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarpose.models.config import BIN
from lidarpose.models.decode import HALF_WIDTH

# wavelengths in meters of the position features and the rotary encoding: from a fine voxel to twice a person's height
WAVELENGTHS = (0.15, 0.25, 0.4, 0.65, 1.05, 1.7, 2.7, 4.4)
PLACE_FEATURES = 3 + 6 * len(WAVELENGTHS)
# half the width of a heatmap's range: about the vote, or about the person's center; meters
REACH = {"window": 0.36, "full": 1.2}


class DropPath(nn.Module):
    """Stochastic depth: in training drops the branch (B, ...) of some of B with a probability, and scales the others up
    to keep the mean."""

    def __init__(self, probability: float):
        super().__init__()
        self.probability = probability

    def forward(self, branch: Tensor) -> Tensor:
        if not self.training or self.probability == 0:
            return branch
        keep_probability = 1 - self.probability
        one_each = branch.flatten(1)[:, :1].view(-1, *(1,) * (branch.dim() - 1))
        return branch * (torch.rand_like(one_each) < keep_probability) / keep_probability


class RotaryEmbedding:
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

    def rotate(self, x: Tensor, frequencies: Tensor) -> Tensor:
        """Rotary encoding of x (B, N, H, D): P pairs of each head are rotated by the row's phases.

        The product of two rotated vectors depends on the difference of their places in meters alone. The D - 2 P
        channels that are left see no place.
        """
        sin, cos = self._phases(frequencies)
        pairs = sin.shape[-1]
        a, b, rest = x.split([pairs, pairs, x.shape[-1] - 2 * pairs], -1)
        return torch.cat([a * cos - b * sin, a * sin + b * cos, rest], -1)

    def _phases(self, frequencies: Tensor) -> tuple[Tensor, Tensor]:
        """Sines and cosines (B, N, H, P) for a layout of heads, shared by all layers that read these rows."""
        layout = frequencies.shape[0], frequencies.shape[2]
        if layout not in self._shared:
            phase = (self.position[..., None, :, None] * frequencies).flatten(-2)
            self._shared[layout] = phase.sin(), phase.cos()
        return self._shared[layout]


def head_frequencies(heads: int, width: int) -> Tensor:
    """(H, 1, P / 3) rad/m for heads of `width` channels, P = 3 * (width // 6): heads share out the wavelengths."""
    count = width // 6
    frequencies = [2 * torch.pi / WAVELENGTHS[k % len(WAVELENGTHS)] for k in range(heads * count)]
    return torch.tensor(frequencies).view(heads, 1, count)


def key_bias(valid: Tensor, dtype: torch.dtype) -> Tensor:
    """valid (B, K) bool -> (B, 1, 1, K), 0 for a key to read and a large negative number for padding.

    A person without any valid key attends to its padding evenly: finite, and discarded by the caller.
    """
    return torch.where(valid, 0.0, -1e4).to(dtype)[:, None, None, :]


def attend(query: Tensor, key: Tensor, value: Tensor, mask: Tensor | None = None, *, dropout: float = 0.0) -> Tensor:
    """torch's scaled_dot_product_attention, always in float32 on a CPU: its gradient in bfloat16 takes five times as
    long there."""
    if query.device.type == "cpu" and torch.is_autocast_enabled("cpu"):
        mask = mask if mask is None or mask.dtype == torch.bool else mask.float()
        with torch.autocast("cpu", enabled=False):
            return attend(query.float(), key.float(), value.float(), mask, dropout=dropout)
    return F.scaled_dot_product_attention(query, key, value, attn_mask=mask, dropout_p=dropout)


class Attention(nn.Module):
    """Queries, keys, values and outputs of multi-head attention with rotary places."""

    frequencies: Tensor

    def __init__(self, channels: int, heads: int, key_channels: int):
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(channels, channels)
        self.key = nn.Linear(key_channels, channels)
        self.value = nn.Linear(key_channels, channels)
        self.out = nn.Linear(channels, channels)
        self.register_buffer("frequencies", head_frequencies(heads, channels // heads), persistent=False)


class SelfAttention(Attention):
    """Multi-head self-attention of rows (B, N, C), all of a person's to all, with rotary places."""

    def __init__(self, channels: int, heads: int):
        super().__init__(channels, heads, channels)

    def forward(self, rows: Tensor, places: RotaryEmbedding | None, bias: Tensor | None) -> Tensor:
        query, key, value = (
            layer(rows).unflatten(-1, (self.heads, -1)) for layer in (self.query, self.key, self.value)
        )
        if places is not None:
            query, key = places.rotate(query, self.frequencies), places.rotate(key, self.frequencies)
        query, key, value = (x.transpose(1, 2) for x in (query, key, value))
        output = attend(query, key, value, bias)
        return self.out(output.transpose(1, 2).flatten(-2))


class CrossAttention(Attention):
    """Attention of queries (B, J, C) to the voxels (B, K, E) of a level: by content, by place and by density.

    A head's weight of a voxel is multiplied by (its number of points) ** density, a learned exponent a head: 0 reads
    voxels alike, 1 reads points alike.
    """

    def __init__(self, channels: int, heads: int, key_channels: int):
        super().__init__(channels, heads, key_channels)
        self.density = nn.Parameter(torch.linspace(0, 1, heads))

    def forward(
        self,
        queries: Tensor,
        query_places: RotaryEmbedding,
        keys: Tensor,
        places: RotaryEmbedding,
        log_count: Tensor,
        bias: Tensor,
    ) -> Tensor:
        query = self.query(queries).unflatten(-1, (self.heads, -1))
        query = (query_places.rotate(query, self.frequencies) * query.shape[-1] ** -0.5).transpose(1, 2)
        key = places.rotate(self.key(keys).unflatten(-1, (self.heads, -1)), self.frequencies).transpose(1, 2)
        density_bias = self.density[:, None, None].to(bias.dtype) * log_count[:, None, None, :]
        # few queries: written out, since the fused kernels give no gradient to a bias
        weight = (query @ key.transpose(-2, -1) + (bias + density_bias)).softmax(-1).to(keys.dtype)
        # weights sum to 1, so the mean of the values is the value of the mean: no voxel's own is needed
        mean_keys = (weight.flatten(1, 2) @ keys).unflatten(1, (self.heads, -1))
        values = self.value.weight.unflatten(0, (self.heads, -1))
        output = (mean_keys @ values.mT).transpose(1, 2).flatten(-2) + self.value.bias
        return self.out(output)


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

    def forward(self, rows: Tensor, places: RotaryEmbedding, bias: Tensor) -> Tensor:
        rows = rows + self.attention(self.norm_attention(rows), places, bias)
        return rows + self.feed(self.norm_feed(rows))


class Exchange(nn.Module):
    """Multi-density exchange: anchors (B, J, C), a learned vector a joint, read voxels (B, K, E), then each other.

    Paper: A_{m-1} = MDE_m(A_m, f_m), from the coarsest level to the finest. Deviations: pre-norm; the bottleneck is
    read too (the released code begins one level above it); voxels are read by place, rotary and relative to where the
    anchor believes its joint to be, and by density; anchors keep one width, so it is the keys that are brought to it.
    """

    def __init__(self, channels: int, heads: int, voxel_channels: int):
        super().__init__()
        self.norm_cross = nn.LayerNorm(channels)
        self.norm_voxels = nn.LayerNorm(voxel_channels)
        self.cross = CrossAttention(channels, heads, voxel_channels)
        self.norm_self = nn.LayerNorm(channels)
        self.among = SelfAttention(channels, heads)
        self.norm_feed = nn.LayerNorm(channels)
        self.feed = FeedForward(channels)

    def forward(
        self,
        anchors: Tensor,
        believed: RotaryEmbedding,
        voxels: Tensor,
        places: RotaryEmbedding,
        log_count: Tensor,
        bias: Tensor,
    ) -> Tensor:
        voxels = self.norm_voxels(voxels)
        anchors = anchors + self.cross(self.norm_cross(anchors), believed, voxels, places, log_count, bias)
        anchors = anchors + self.among(self.norm_self(anchors), None, None)
        return anchors + self.feed(self.norm_feed(anchors))


class Convolution(nn.Module):
    """A residual submanifold convolution, 3 x 3 x 3, of rows (B, N, C) by a table of neighbors (B, N, 27).

    The table holds row numbers, N where a cell is empty. After Point Transformer V3's conditional position encoding,
    but that neighbors are seen through `narrow` channels: its cost is theirs.
    """

    def __init__(self, channels: int, narrow: int):
        super().__init__()
        self.norm = nn.LayerNorm(channels)
        self.narrow = nn.Linear(channels, narrow, bias=False)
        self.mix = nn.Linear(27 * narrow, channels)

    def forward(self, rows: Tensor, neighbors: Tensor) -> Tensor:
        people, n, _ = rows.shape
        padded_rows = F.pad(self.narrow(self.norm(rows)), (0, 0, 0, 1)).flatten(0, 1)
        # by row numbers of the whole batch: along dim 1 the gradient of gather is far slower on a CPU
        start = (n + 1) * torch.arange(people, device=rows.device)
        index = (neighbors + start[:, None, None]).flatten()
        return rows + self.mix(padded_rows.index_select(0, index).view(people, n, -1))


def membership(parent: Tensor, valid: Tensor, parents: int, dtype: torch.dtype) -> Tensor:
    """parent (B, N) int, valid (B, N) -> (B, parents, N): 1 where row n belongs to the parent voxel.

    Pooling and unpooling are products with this matrix: on rows of a few hundred voxels that is several times faster
    on a CPU than scattering, has the same gradient on every device, and exports.
    """
    index = torch.arange(parents, device=parent.device)
    return ((parent[:, None, :] == index[:, None]) & valid[:, None, :]).to(dtype)


# ---- from anchors and voxels to joints


def bin_centers(bins: int, device: torch.device | None = None) -> Tensor:
    """(W,) m: offsets from the heatmap's origin at the middle of each bin."""
    return _offset(torch.arange(bins, device=device), bins)


def _offset(position: Tensor, bins: int) -> Tensor:
    """position (...) bins -> (...) m from the heatmap's origin, which is the middle of all bins."""
    return (position + 0.5 - bins / 2) * BIN


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
        """Returns vote (B, J, 3) m and the voters' mean features, (B, J, C)."""
        query = self.query(anchors) * voxels.shape[-1] ** -0.5
        weight = torch.softmax(query @ self.key(voxels).transpose(1, 2) + bias[:, 0], -1)
        features = weight @ voxels
        vote = weight @ position + (features[:, :, None] @ self.offset).squeeze(2) + self.residual(anchors)
        return vote, features


class JointHead(nn.Module):
    """Heatmaps, confidence, spread and visibility of each joint: from its anchor, its voters' features, its vote."""

    def __init__(self, channels: int, voxel_channels: int, bins: int):
        super().__init__()
        self.bins = bins
        width = channels + voxel_channels
        self.norm = nn.LayerNorm(width)
        self.hidden = nn.Sequential(nn.Linear(width + 3, 2 * channels), nn.SiLU())
        self.heatmap = nn.Linear(2 * channels, 3 * bins) if bins else None
        self.certainty = nn.Linear(2 * channels, 3)

    def forward(self, anchors: Tensor, voter_features: Tensor, vote: Tensor) -> tuple[Tensor, ...]:
        """Returns heatmap (B, J, 3, W), of no bins (B, J, 1, 0); confidence, log_spread, visible (B, J)."""
        features = self.norm(torch.cat([anchors, voter_features], -1))
        hidden = self.hidden(torch.cat([features, vote.detach()], -1))
        certainty = self.certainty(hidden).unbind(-1)
        if self.heatmap is None:
            return hidden[..., None, :0], *certainty
        return self.heatmap(hidden).unflatten(-1, (3, self.bins)), *certainty


class PersonHead(nn.Module):
    """Whether a crop shows a person, and a second one: from the means of anchors and voxels and what the joints' head
    says of every joint. detach_inputs: no gradient reaches its inputs, which are the joints' alone."""

    detach_inputs = True

    def __init__(self, channels: int, voxel_channels: int, joints: int):
        super().__init__()
        self.norm = nn.LayerNorm(channels + voxel_channels)
        self.hidden = nn.Sequential(nn.Linear(channels + voxel_channels + 3 * joints, 64), nn.SiLU())
        self.out = nn.Linear(64, 2)

    def forward(self, anchors: Tensor, voxels: Tensor, valid: Tensor, certainty: Sequence[Tensor]) -> Tensor:
        """anchors (B, J, C), voxels (B, N, F), valid (B, N), certainty: confidence, log_spread, visible (B, J) ->
        (B, 2) logits."""
        weight = valid.to(voxels.dtype)[..., None]
        mean = (voxels * weight).sum(1) / weight.sum(1).clamp(min=1)
        inputs = [torch.cat([anchors.mean(1), mean], -1), *certainty]
        if self.detach_inputs:
            inputs = [value.detach() for value in inputs]
        return self.out(self.hidden(torch.cat([self.norm(inputs[0]), *inputs[1:]], -1)))
