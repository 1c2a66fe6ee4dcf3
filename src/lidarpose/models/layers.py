"""The network's layers: rotary positions, position- and density-aware attention, exchange, pooling, joint heads.

Legend: B people, N rows (padded), K keys (padded), C channels, H heads, D channels per head, P rotated pairs per head,
J joints, W heatmap bins.
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
# half width of a heatmap's range, meters: "window" is centered on the vote, "full" on the person's center
REACH = {"window": 0.36, "full": 1.2}


class DropPath(nn.Module):
    """Stochastic depth: in training drops the branch (B, ...) of each of the B entries with a probability, and scales
    the others up to preserve the mean."""

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
    """Sines and cosines of the positions (B, N, 3) m of rows, shared by position features and rotary attention."""

    def __init__(self, position: Tensor):
        # by scalars: a tensor made from them would be copied to a GPU, which a CUDA graph cannot record
        phase = torch.stack([position * (2 * torch.pi / w) for w in WAVELENGTHS], -1)
        self.position = position
        self.sin, self.cos = phase.sin(), phase.cos()
        self._shared: dict[tuple[int, int], tuple[Tensor, Tensor]] = {}

    def features(self) -> Tensor:
        """(B, N, PLACE_FEATURES): the coordinates, their sines and their cosines."""
        return torch.cat([self.position, self.sin.flatten(-2), self.cos.flatten(-2)], -1)

    def rotate(self, x: Tensor, frequencies: Tensor) -> Tensor:
        """Rotary encoding of x (B, N, H, D): P pairs of each head are rotated by the row's phases.

        The dot product of two rotated vectors depends on their positions only through the difference in meters. The
        remaining D - 2 P channels do not depend on position.
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
    """(H, 1, P / 3) rad/m for heads of `width` channels, P = 3 * (width // 6): heads cycle through the wavelengths."""
    count = width // 6
    frequencies = [2 * torch.pi / WAVELENGTHS[k % len(WAVELENGTHS)] for k in range(heads * count)]
    return torch.tensor(frequencies).view(heads, 1, count)


def key_bias(valid: Tensor, dtype: torch.dtype) -> Tensor:
    """valid (B, K) bool -> (B, 1, 1, K), 0 for a valid key and a large negative number for padding.

    A person without any valid key attends uniformly to padding: the result is finite, and the caller discards it.
    """
    return torch.where(valid, 0.0, -1e4).to(dtype)[:, None, None, :]


def attend(query: Tensor, key: Tensor, value: Tensor, mask: Tensor | None = None, *, dropout: float = 0.0) -> Tensor:
    """torch's scaled_dot_product_attention; under autocast on a CPU in float32, since its gradient in bfloat16 takes
    five times as long there."""
    if query.device.type == "cpu" and torch.is_autocast_enabled("cpu"):
        mask = mask if mask is None or mask.dtype == torch.bool else mask.float()
        with torch.autocast("cpu", enabled=False):
            return attend(query.float(), key.float(), value.float(), mask, dropout=dropout)
    return F.scaled_dot_product_attention(query, key, value, attn_mask=mask, dropout_p=dropout)


class Attention(nn.Module):
    """Query, key, value and output layers of multi-head attention with rotary positions."""

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
    """Multi-head self-attention among all rows (B, N, C) of a person, with rotary positions."""

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
    """Attention of queries (B, J, C) to the voxels (B, K, E) of a level, by content, position and density.

    Each head multiplies the weight of a voxel by (its number of points) ** density, with one learned exponent per head:
    0 weights all voxels equally, 1 weights all points equally.
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
        # written out, since the fused kernels give no gradient to a bias; cheap for few queries
        weight = (query @ key.transpose(-2, -1) + (bias + density_bias)).softmax(-1).to(keys.dtype)
        # weights sum to 1, so the mean of the values is the value of the mean: no value per voxel is needed
        mean_keys = (weight.flatten(1, 2) @ keys).unflatten(1, (self.heads, -1))
        values = self.value.weight.unflatten(0, (self.heads, -1))
        output = (mean_keys @ values.mT).transpose(1, 2).flatten(-2) + self.value.bias
        return self.out(output)


class FeedForward(nn.Sequential):
    """Linear, SiLU, Linear: C -> ratio C -> C. SiLU costs a quarter of GELU on a CPU."""

    def __init__(self, channels: int, ratio: int = 2):
        super().__init__(nn.Linear(channels, ratio * channels), nn.SiLU(), nn.Linear(ratio * channels, channels))


class Block(nn.Module):
    """A pre-norm transformer block over the voxels of one level, with attention among all rows of a person."""

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
    """Multi-density exchange: anchors (B, J, C), one per joint, attend to voxels (B, K, E), then to each other.

    Paper: A_{m-1} = MDE_m(A_m, f_m), from the coarsest level to the finest. Deviations: pre-norm; the bottleneck is
    read too (the released code begins one level above it); attention to voxels also depends on density, and through
    rotary encoding on the voxel's position relative to the anchor's current estimate of its joint; anchors keep one
    width, so the keys are projected to it.
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
        anchor_places: RotaryEmbedding,
        voxels: Tensor,
        places: RotaryEmbedding,
        log_count: Tensor,
        bias: Tensor,
    ) -> Tensor:
        voxels = self.norm_voxels(voxels)
        anchors = anchors + self.cross(self.norm_cross(anchors), anchor_places, voxels, places, log_count, bias)
        anchors = anchors + self.among(self.norm_self(anchors), None, None)
        return anchors + self.feed(self.norm_feed(anchors))


class Convolution(nn.Module):
    """A residual submanifold convolution, 3 x 3 x 3, of rows (B, N, C) by a table of neighbors (B, N, 27).

    The table holds row numbers, N for an empty cell. Follows Point Transformer V3's conditional position encoding,
    except that neighbors are first projected to `narrow` channels, which determine the cost.
    """

    def __init__(self, channels: int, narrow: int):
        super().__init__()
        self.norm = nn.LayerNorm(channels)
        self.narrow = nn.Linear(channels, narrow, bias=False)
        self.mix = nn.Linear(27 * narrow, channels)

    def forward(self, rows: Tensor, neighbors: Tensor) -> Tensor:
        people, n, _ = rows.shape
        padded_rows = F.pad(self.narrow(self.norm(rows)), (0, 0, 0, 1)).flatten(0, 1)
        # indexes rows of the flattened batch: the gradient of a gather along dim 1 is far slower on a CPU
        start = (n + 1) * torch.arange(people, device=rows.device)
        index = (neighbors + start[:, None, None]).flatten()
        return rows + self.mix(padded_rows.index_select(0, index).view(people, n, -1))


def membership(parent: Tensor, valid: Tensor, parents: int, dtype: torch.dtype) -> Tensor:
    """parent (B, N) int, valid (B, N) -> (B, parents, N): 1 where row n belongs to the parent voxel.

    Pooling and unpooling are products with this matrix: for a few hundred voxels per person that is several times
    faster on a CPU than scattering, has the same gradient on every device, and can be exported.
    """
    index = torch.arange(parents, device=parent.device)
    return ((parent[:, None, :] == index[:, None]) & valid[:, None, :]).to(dtype)


# ---- from anchors and voxels to joints


def bin_centers(bins: int, device: torch.device | None = None) -> Tensor:
    """(W,) m: offset of each bin's center from the heatmap's origin."""
    return _offset(torch.arange(bins, device=device), bins)


def _offset(position: Tensor, bins: int) -> Tensor:
    """position (...) bins -> (...) m from the heatmap's origin, which is the center of its range."""
    return (position + 0.5 - bins / 2) * BIN


def decode(logits: Tensor) -> Tensor:
    """logits (..., W) -> (...) m from the heatmap's origin: `mean_bin` in meters."""
    return _offset(mean_bin(logits), logits.shape[-1])


def mean_bin(logits: Tensor) -> Tensor:
    """logits (..., W) -> (...) bins: expectation of the softmax within `HALF_WIDTH` bins of its mode, fewer at an edge.

    If left and right are ambiguous, a mean over all bins would fall between the two peaks; the window stays at one of
    them. It is symmetric about the mode, since a window truncated at an edge would bias the mean inwards. Computed in
    float32, since half types cannot distinguish bin indices in the hundreds. Equivalent in numpy: `decode.window`.
    """
    bins = logits.shape[-1]
    mode = logits.argmax(-1, keepdim=True)
    reach = torch.minimum(mode, bins - 1 - mode).clamp(max=HALF_WIDTH)
    index = torch.arange(bins, device=logits.device)
    # finite, since the gradient of a softmax at -inf may be NaN
    weight = logits.float().masked_fill((index - mode).abs() > reach, -1e4).softmax(-1)
    return (weight * index).sum(-1)


def encode(offset: Tensor, sigma: float, bins: int) -> Tensor:
    """offset (...) m from the heatmap's origin -> (..., W): a Gaussian of `sigma` m over the bins, with sum 1."""
    distance = (offset[..., None] - bin_centers(bins, offset.device)) / sigma
    return torch.softmax(-0.5 * distance**2, -1)


class VoteHead(nn.Module):
    """Every voxel votes for every joint: its position plus an offset, weighted by a softmax over the voxels.

    A voxel's offset is linear in its features, so the weighted mean of offsets is the offset of the weighted mean: no
    offset per voxel is needed. Offsets are initialized to zero, so an untrained head already places joints among the
    points.
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
        """Returns the vote (B, J, 3) m and the voters' mean features (B, J, C)."""
        query = self.query(anchors) * voxels.shape[-1] ** -0.5
        weight = torch.softmax(query @ self.key(voxels).transpose(1, 2) + bias[:, 0], -1)
        features = weight @ voxels
        vote = weight @ position + (features[:, :, None] @ self.offset).squeeze(2) + self.residual(anchors)
        return vote, features


class JointHead(nn.Module):
    """Heatmaps, confidence, spread and visibility of each joint, from its anchor, its voters' features and its vote."""

    def __init__(self, channels: int, voxel_channels: int, bins: int):
        super().__init__()
        self.bins = bins
        width = channels + voxel_channels
        self.norm = nn.LayerNorm(width)
        self.hidden = nn.Sequential(nn.Linear(width + 3, 2 * channels), nn.SiLU())
        self.heatmap = nn.Linear(2 * channels, 3 * bins) if bins else None
        self.certainty = nn.Linear(2 * channels, 3)

    def forward(self, anchors: Tensor, voter_features: Tensor, vote: Tensor) -> tuple[Tensor, ...]:
        """Returns heatmap (B, J, 3, W), or (B, J, 1, 0) without bins; confidence, log_spread, visible (B, J)."""
        features = self.norm(torch.cat([anchors, voter_features], -1))
        hidden = self.hidden(torch.cat([features, vote.detach()], -1))
        certainty = self.certainty(hidden).unbind(-1)
        if self.heatmap is None:
            return hidden[..., None, :0], *certainty
        return self.heatmap(hidden).unflatten(-1, (3, self.bins)), *certainty


class PersonHead(nn.Module):
    """Whether a crop shows a person, and whether it shows a second one: from the mean anchor, the mean voxel and the
    certainties that `JointHead` predicts for every joint. detach_inputs: no gradient flows into its inputs, so the
    joint losses alone train them."""

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
