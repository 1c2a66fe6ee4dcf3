"""Baseline networks for speed comparisons: the package's first draft, a plain transformer over groups, a PointNet++.

Legend: B people, N points (padded), G groups or centers, K points per group, M voxels of all people at a level, W
maximum number of them under one parent, C channels, J joints.

Each has `prepare(clouds)`, which computes the geometry of people's clouds (n, 3) m around their centers without
gradients, and `forward`, which computes joints (B, J, 3) m in the person's frame from it. The result for a person does
not depend on the other people in the batch. The networks are for comparing cost: none has been tuned for accuracy.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarpose.models.layers import FeedForward, RotaryEmbedding, SelfAttention, head_frequencies, key_bias
from lidarpose.models.voxelize import VoxelLevel, voxelize
from lidarpose.skeleton import BODY26

JOINTS = len(BODY26)


def about(make: Callable[[int], nn.Module], parameters: int, *, widths: range) -> nn.Module:
    """`make(width)` for the width whose number of parameters is closest to `parameters`.

    Raises ValueError if no width comes within a tenth.
    """

    def off(width: int) -> float:
        with torch.device("meta"):
            return abs(count(make(width)) / parameters - 1)

    best_width = min(widths, key=off)
    if off(best_width) > 0.1:
        raise ValueError(f"no width of {widths} comes within a tenth of {parameters:,} parameters")
    return make(best_width)


def count(network: nn.Module) -> int:
    """Number of parameters of a network."""
    return sum(value.numel() for value in network.parameters())


# --- the draft: a Point Transformer U-Net on ragged rows -------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class DraftLevel:
    """Voxels of one size, concatenated over all people.

    position (M, 3) m; slot (M,): row among the padded B * N; valid (B, N) bool; children (M', W): rows of this level
    under each voxel of the next level, padded by repeating the first child, and parent (M,): row of the next level;
    both None at the coarsest level.
    """

    position: Tensor
    slot: Tensor
    valid: Tensor
    children: Tensor | None
    parent: Tensor | None


@dataclass(frozen=True, kw_only=True)
class DraftTables:
    """The input of `Draft`: features (M, 7) of the fine voxels, and the levels from fine to coarse."""

    features: Tensor
    levels: tuple[DraftLevel, ...]


class Draft(nn.Module):
    """The package's first draft of a backbone, which its networks should be faster than.

    Voxels of 4, 8 and 16 cm; linear stem; attention among all voxels of a person with rotary position encoding, no
    convolution; an exchange (a stock post-norm decoder layer) after each decoder level. Rows are ragged, and padded
    only for attention.
    """

    GRID, MOST = 0.04, 1024
    # channels per head, 12 of which the rotary encoding rotates
    HEAD = 16
    # channels of encoder and decoder, for about a third of the draft's parameters, a fifth more, and the measured draft
    WIDTHS = (((32, 48, 96), (48, 48)), ((64, 96, 176), (64, 96)), ((48, 96, 144), (64, 96)))

    def __init__(
        self,
        encoder: tuple[int, ...] = WIDTHS[-1][0],
        decoder: tuple[int, ...] = WIDTHS[-1][1],
        depths: tuple[int, ...] = (1, 2, 2),
        decoder_depths: tuple[int, ...] = (1, 1),
    ):
        super().__init__()
        self.stem = nn.Sequential(nn.Linear(7, encoder[0]), nn.LayerNorm(encoder[0]), nn.GELU())
        self.encoder = nn.ModuleList(_stage(c, n) for c, n in zip(encoder, depths, strict=True))
        self.pool = nn.ModuleList(nn.Linear(a, b) for a, b in zip(encoder, encoder[1:], strict=False))
        self.pool_norm = nn.ModuleList(nn.LayerNorm(c) for c in encoder[1:])
        self.decoder = nn.ModuleList(_stage(c, n) for c, n in zip(decoder, decoder_depths, strict=True))
        widths = (*decoder, encoder[-1])
        self.up = nn.ModuleList(_aligned(widths[s + 1], c) for s, c in enumerate(decoder))
        self.skip = nn.ModuleList(_aligned(encoder[s], c) for s, c in enumerate(decoder))
        self.anchors = nn.Parameter(torch.randn(JOINTS, decoder[-1]) * 0.02)
        self.anchor = nn.ModuleList(nn.Linear(decoder[min(s + 1, len(decoder) - 1)], c) for s, c in enumerate(decoder))
        self.exchange = nn.ModuleList(
            nn.TransformerDecoderLayer(c, 4, 4 * c, dropout=0.0, batch_first=True) for c in decoder
        )
        self.head = nn.Sequential(nn.Linear(decoder[0], decoder[0]), nn.GELU(), nn.Linear(decoder[0], 3))

    @classmethod
    def of_parameters(cls, parameters: int) -> "Draft":
        """The draft with the `WIDTHS` that give about `parameters` parameters."""
        return about(lambda k: cls(*cls.WIDTHS[k]), parameters, widths=range(len(cls.WIDTHS)))

    def prepare(self, clouds: list[np.ndarray]) -> DraftTables:
        lengths = np.array([len(cloud) for cloud in clouds])
        tables = voxelize(np.concatenate(clouds), lengths, grid=self.GRID, max_voxels=self.MOST)
        levels = (tables.fine, tables.mid, tables.coarse)
        rows = tables.fine.valid
        features = np.concatenate(
            [tables.fine.position[rows], tables.offset[rows], tables.fine.log_count[rows][:, None]], 1
        )
        ragged_levels = (_ragged(level, coarser) for level, coarser in zip(levels, (*levels[1:], None), strict=True))
        return DraftTables(features=torch.from_numpy(features), levels=tuple(ragged_levels))

    def forward(self, tables: DraftTables) -> Tensor:
        """Joints (B, J, 3) m."""
        levels = tables.levels
        places = [RotaryEmbedding(level.position) for level in levels]
        biases = [_bias(level.valid, tables.features.dtype) for level in levels]
        rows, skips = self.stem(tables.features), []
        for s, level in enumerate(levels):
            if s:
                rows = F.gelu(self.pool_norm[s - 1](self.pool[s - 1](rows)[levels[s - 1].children].amax(1)))
            for block in self.encoder[s]:
                rows = block(rows, places[s], level, biases[s])
            skips.append(rows)
        anchors = self.anchors.expand(levels[0].valid.shape[0], -1, -1)
        for s in reversed(range(len(levels) - 1)):
            level = levels[s]
            rows = self.skip[s](skips[s]) + self.up[s](rows)[level.parent]
            for block in self.decoder[s]:
                rows = block(rows, places[s], level, biases[s])
            # a person without voxels attends to a row of zeros, since attention with all keys masked gives NaN
            is_empty = ~level.valid
            is_empty[:, 0] = False
            anchors = self.exchange[s](self.anchor[s](anchors), _padded(rows, level), memory_key_padding_mask=is_empty)
        return self.head(anchors)


class _RaggedBlock(nn.Module):
    """A pre-norm transformer block over ragged rows (M, C)."""

    def __init__(self, channels: int, heads: int):
        super().__init__()
        self.heads = heads
        self.norm_attention, self.norm_feed = nn.LayerNorm(channels), nn.LayerNorm(channels)
        self.qkv, self.out = nn.Linear(channels, 3 * channels), nn.Linear(channels, channels)
        self.feed = nn.Sequential(nn.Linear(channels, 4 * channels), nn.GELU(), nn.Linear(4 * channels, channels))
        self.register_buffer("frequencies", head_frequencies(heads, channels // heads), persistent=False)

    def forward(self, rows: Tensor, places: RotaryEmbedding, level: DraftLevel, bias: Tensor | None) -> Tensor:
        query, key, value = self.qkv(self.norm_attention(rows)).unflatten(-1, (3, self.heads, -1)).unbind(1)
        query, key, value = (
            _padded(x.flatten(1), level).unflatten(-1, (self.heads, -1)).transpose(1, 2)
            for x in (places.rotate(query, self.frequencies), places.rotate(key, self.frequencies), value)
        )
        mixed = F.scaled_dot_product_attention(query, key, value, attn_mask=bias)
        rows = rows + self.out(mixed.transpose(1, 2).flatten(2).flatten(0, 1)[level.slot])
        return rows + self.feed(self.norm_feed(rows))


def _stage(channels: int, depth: int) -> nn.ModuleList:
    return nn.ModuleList(_RaggedBlock(channels, channels // Draft.HEAD) for _ in range(depth))


def _aligned(channels: int, out_channels: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(channels, out_channels), nn.LayerNorm(out_channels), nn.GELU())


def _bias(valid: Tensor, dtype: torch.dtype) -> Tensor | None:
    """`key_bias`, None if all people have the same number of voxels."""
    return None if valid.all() else key_bias(valid, dtype)


def _padded(rows: Tensor, level: DraftLevel) -> Tensor:
    """rows (M, C) -> (B, N, C), zero in padding."""
    people, max_voxels = level.valid.shape
    if rows.shape[0] == people * max_voxels:
        return rows.unflatten(0, (people, max_voxels))
    return (
        rows.new_zeros(people * max_voxels, rows.shape[1])
        .index_copy(0, level.slot, rows)
        .unflatten(0, (people, max_voxels))
    )


def _ragged(level: VoxelLevel, coarser: VoxelLevel | None) -> DraftLevel:
    """A padded level of a voxel pyramid as ragged rows; coarser: the next level."""
    children = parent = None
    if coarser is not None:
        lengths = coarser.valid.sum(1)
        start = np.cumsum(lengths) - lengths
        parent = (level.parent + start[:, None])[level.valid]
        # a person's voxels are not sorted by parent, so the children are sorted first
        order = np.argsort(parent, kind="stable")
        child_count = np.bincount(parent, minlength=lengths.sum())
        first_child = np.cumsum(child_count) - child_count
        nth = np.arange(child_count.max(initial=1))
        children = (
            order[first_child[:, None] + np.where(nth < child_count[:, None], nth, 0)] if len(order) else order[:, None]
        )
    return DraftLevel(
        position=torch.from_numpy(level.position[level.valid]),
        slot=torch.from_numpy(np.flatnonzero(level.valid)),
        valid=torch.from_numpy(level.valid),
        children=None if children is None else torch.from_numpy(children),
        parent=None if parent is None else torch.from_numpy(parent),
    )


# --- a plain transformer over groups of points -----------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Groups:
    """Centers of people's clouds and the points around each center.

    center (B, G, 3) m; center_valid (B, G) bool: false for centers in excess of the person's distinct points; index
    (B, G, K): the neighbors' rows among the N; relative (B, G, K, 3) m: neighbors relative to their center; valid
    (B, G, K) bool.
    """

    center: Tensor
    center_valid: Tensor
    index: Tensor
    relative: Tensor
    valid: Tensor


class GroupedViT(nn.Module):
    """A plain transformer over groups: farthest-point centers, whose nearest points a small PointNet encodes.

    Follows Point-BERT and Point-MAE: 64 groups of 32 points; pre-norm blocks; a perceptron predicts joints from the
    tokens' mean and maximum.
    """

    GROUPS, NEIGHBORS = 64, 32
    HEADS, DEPTH, POINT = 4, 4, 64

    def __init__(self, channels: int):
        super().__init__()
        c = self.POINT
        self.first = nn.Sequential(nn.Linear(3, c), nn.ReLU(), nn.Linear(c, c))
        self.second = nn.Sequential(nn.Linear(2 * c, 2 * c), nn.ReLU(), nn.Linear(2 * c, channels))
        self.place = nn.Sequential(nn.Linear(3, c), nn.GELU(), nn.Linear(c, channels))
        self.blocks = nn.ModuleList(_PlainBlock(channels, self.HEADS) for _ in range(self.DEPTH))
        self.norm = nn.LayerNorm(channels)
        self.head = nn.Sequential(nn.Linear(2 * channels, 2 * channels), nn.GELU(), nn.Linear(2 * channels, 3 * JOINTS))

    @classmethod
    def of_parameters(cls, parameters: int) -> "GroupedViT":
        return about(cls, parameters, widths=range(32, 640, 8))

    @torch.no_grad()
    def prepare(self, clouds: list[np.ndarray]) -> Groups:
        return grouped(*padded(clouds), centers=self.GROUPS, neighbors=self.NEIGHBORS)

    def forward(self, groups: Groups) -> Tensor:
        """Joints (B, J, 3) m."""
        points = self.first(groups.relative)
        group_maximum = _largest(points, groups.valid, 2)
        points = torch.cat([points, group_maximum[:, :, None].expand_as(points)], -1)
        tokens = _largest(self.second(points), groups.valid, 2) + self.place(groups.center)
        bias = _bias(groups.center_valid, tokens.dtype)
        for block in self.blocks:
            tokens = block(tokens, bias)
        tokens = self.norm(tokens)
        weight = groups.center_valid.to(tokens.dtype)[..., None]
        mean = (tokens * weight).sum(1) / weight.sum(1).clamp(min=1)
        pooled = torch.cat([mean, _largest(tokens, groups.center_valid, 1)], -1)
        return self.head(pooled).unflatten(-1, (JOINTS, 3))


class _PlainBlock(nn.Module):
    """A pre-norm transformer block over tokens (B, G, C), with a perceptron four times as wide."""

    def __init__(self, channels: int, heads: int):
        super().__init__()
        self.norm_attention, self.norm_feed = nn.LayerNorm(channels), nn.LayerNorm(channels)
        self.attention, self.feed = SelfAttention(channels, heads), FeedForward(channels, 4)

    def forward(self, tokens: Tensor, bias: Tensor | None) -> Tensor:
        tokens = tokens + self.attention(self.norm_attention(tokens), None, bias)
        return tokens + self.feed(self.norm_feed(tokens))


# --- PointNet++ ------------------------------------------------------------------------------------------------------


class PointNet2(nn.Module):
    """Set abstraction as in PointNet++ (single scale): points to centers, to fewer centers, to one vector, to joints.

    Widths keep PointNet++'s proportions (the original has width 64). One layer norm per set replaces its batch norms,
    which cost as much as the matrix products on a CPU. The nearest points of each ball are taken.
    """

    # centers, points per center, radius in meters
    SETS = ((128, 32, 0.2), (32, 32, 0.5))

    def __init__(self, width: int):
        super().__init__()
        w = width
        self.sets = nn.ModuleList([_perceptron(3, w, w, 2 * w), _perceptron(3 + 2 * w, 2 * w, 2 * w, 4 * w)])
        self.norms = nn.ModuleList([nn.LayerNorm(2 * w), nn.LayerNorm(4 * w)])
        self.whole = _perceptron(3 + 4 * w, 4 * w, 8 * w, 16 * w)
        self.head = _perceptron(16 * w, 8 * w, 4 * w, 3 * JOINTS)

    @classmethod
    def of_parameters(cls, parameters: int) -> "PointNet2":
        return about(cls, parameters, widths=range(8, 192, 2))

    @torch.no_grad()
    def prepare(self, clouds: list[np.ndarray]) -> tuple[Groups, ...]:
        points, valid = padded(clouds)
        sets = []
        for centers, neighbors, radius in self.SETS:
            sets.append(grouped(points, valid, centers=centers, neighbors=neighbors, radius=radius))
            points, valid = sets[-1].center, sets[-1].center_valid
        return tuple(sets)

    def forward(self, sets: tuple[Groups, ...]) -> Tensor:
        """Joints (B, J, 3) m."""
        rows = None
        for groups, perceptron, norm in zip(sets, self.sets, self.norms, strict=True):
            features = groups.relative
            if rows is not None:
                index = groups.index.flatten(1)[..., None].expand(-1, -1, rows.shape[-1])
                features = torch.cat([features, rows.gather(1, index).unflatten(1, groups.index.shape[1:])], -1)
            rows = norm(_largest(perceptron(features), groups.valid, 2))
        last = sets[-1]
        rows = self.whole(torch.cat([last.center, rows], -1))
        return self.head(_largest(rows, last.center_valid, 1)).unflatten(-1, (JOINTS, 3))


def _perceptron(*widths: int) -> nn.Sequential:
    """Linear layers with ReLU between them, none after the last."""
    layers = []
    for channels, out_channels in zip(widths, widths[1:], strict=False):
        layers += [nn.Linear(channels, out_channels), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


# --- geometry of points ----------------------------------------------------------------------------------------------


def padded(clouds: list[np.ndarray]) -> tuple[Tensor, Tensor]:
    """Clouds (n, 3) m -> points (B, N, 3) float32, valid (B, N) bool."""
    max_points = max((len(cloud) for cloud in clouds), default=0)
    points, valid = (
        np.zeros((len(clouds), max(max_points, 1), 3), np.float32),
        np.zeros((len(clouds), max(max_points, 1)), bool),
    )
    for k, cloud in enumerate(clouds):
        points[k, : len(cloud)], valid[k, : len(cloud)] = cloud, True
    return torch.from_numpy(points), torch.from_numpy(valid)


def farthest(points: Tensor, valid: Tensor, centers: int) -> tuple[Tensor, Tensor]:
    """points (B, N, 3), valid (B, N) -> index (B, G), fresh (B, G) bool.

    Farthest-point sampling that starts at each person's first point; fresh: false if no distinct point was left.
    """
    people = torch.arange(len(points))
    distance = torch.where(valid, torch.inf, -1.0)
    value, last = distance.max(1)
    index, fresh = [last], [value > 0]
    for _ in range(1, centers):
        square = (points - points[people, last][:, None]).square().sum(-1)
        distance = torch.minimum(distance, square)
        value, last = distance.max(1)
        index.append(last)
        fresh.append(value > 0)
    return torch.stack(index, 1), torch.stack(fresh, 1)


def grouped(points: Tensor, valid: Tensor, *, centers: int, neighbors: int, radius: float = float("inf")) -> Groups:
    """points (B, N, 3) m, valid (B, N) -> farthest-point centers and their nearest points within `radius` m."""
    index, fresh = farthest(points, valid, centers)
    center = points.gather(1, index[..., None].expand(-1, -1, 3))
    # distances from differences instead of matrix products, which are less accurate far from the origin
    distance = torch.cdist(center, points, compute_mode="donot_use_mm_for_euclid_dist")
    distance = distance.masked_fill(~valid[:, None], torch.inf)
    distances, indices = distance.topk(min(neighbors, points.shape[1]), largest=False)
    neighbor_points = points.gather(1, indices.flatten(1)[..., None].expand(-1, -1, 3)).unflatten(1, indices.shape[1:])
    return Groups(
        center=center,
        center_valid=fresh,
        index=indices,
        relative=neighbor_points - center[:, :, None],
        valid=(distances <= radius) & distances.isfinite(),
    )


def _largest(values: Tensor, valid: Tensor, axis: int) -> Tensor:
    """Maximum over `axis` of values (..., C) where valid (...); a large negative number if none is valid."""
    return values.masked_fill(~valid[..., None], -1e4).amax(axis)
