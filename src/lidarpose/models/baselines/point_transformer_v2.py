"""Point Transformer V2 as LiDAR-HMR's pose network uses it: a U-Net of grouped vector attention over 16 neighbors.

Rows of all people are concatenated: M rows, with the person of each in `person`.
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from lidarpose.models.baselines.point_ops import nearest_neighbors

# channels, groups of attention and grid (m) of the encoder's stages, and of the decoder's, fine to coarse
EMBEDDING, EMBEDDING_GROUPS, EMBEDDING_NEIGHBORS = 48, 6, 8
ENCODER, ENCODER_GROUPS, ENCODER_DEPTH = (16, 32, 64, 128), (2, 4, 8, 16), 2
DECODER, DECODER_GROUPS, DECODER_DEPTH = (48, 96, 192, 384), (6, 12, 24, 48), 1
GRID = (0.06, 0.12, 0.24, 0.48)
NEIGHBORS = 16


@dataclass(frozen=True, kw_only=True)
class Rows:
    """Points of B people: xyz (M, 3) m; person (M,) in ascending order; count (B,) points of each person."""

    xyz: Tensor
    person: Tensor
    count: Tensor

    def neighbors(self, count: int) -> Tensor:
        """(M, count) numbers of each row's nearest rows of the same person, itself first; -1 for a missing neighbor."""
        start = (self.count.cumsum(0) - self.count).tolist()
        index = [
            nearest_neighbors(xyz[None], xyz.new_ones(1, len(xyz), dtype=torch.bool), count)[0]
            for xyz in self.xyz.split(self.count.tolist())
        ]
        return torch.cat([torch.where(rows >= 0, rows + first, -1) for rows, first in zip(index, start, strict=True)])

    def pooled(self, grid: float) -> tuple["Rows", Tensor]:
        """Cells of `grid` m, counted from each person's minimum, as rows at their points' mean; each row's cell."""
        low = segment_reduce(self.xyz, self.person, len(self.count), "amin")
        cell = ((self.xyz - low[self.person]) / grid).floor().long()
        # sorted by (person, x, y, z): one number per row, since torch.unique of rows is slow on CPUs
        x, y, z = cell.amax(0) + 1
        key = ((self.person * x + cell[:, 0]) * y + cell[:, 1]) * z + cell[:, 2]
        _, inverse = torch.unique(key, return_inverse=True)
        cells = int(inverse.max()) + 1
        person = self.person.new_zeros(cells).scatter_(0, inverse, self.person)
        xyz = segment_reduce(self.xyz, inverse, cells, "mean")
        return Rows(xyz=xyz, person=person, count=torch.bincount(person, minlength=len(self.count))), inverse


def segment_reduce(values: Tensor, segment: Tensor, segments: int, reduce: str) -> Tensor:
    """values (M, C), grouped by `segment` (M,) -> (segments, C); 0 for a segment without rows."""
    zeros = values.new_zeros(segments, values.shape[1])
    return zeros.scatter_reduce(0, segment[:, None].expand_as(values), values, reduce, include_self=False)


def linear_norm(in_channels: int, out_channels: int, *, bias: bool) -> nn.Sequential:
    return nn.Sequential(nn.Linear(in_channels, out_channels, bias=bias), nn.BatchNorm1d(out_channels), nn.ReLU())


class PointTransformerV2(nn.Module):
    """xyz of each row -> features (M, 48) of each row; divisor, missing_in_softmax: see `PrnConfig`."""

    def __init__(self, divisor: int = 1, missing_in_softmax: bool = False):
        super().__init__()
        embedding, *encoder = (width // divisor for width in (EMBEDDING, *ENCODER))
        decoder = [width // divisor for width in DECODER]
        self.embedding = linear_norm(3, embedding, bias=False)
        self.block = Block(embedding, EMBEDDING_GROUPS)
        widths = (embedding, *encoder)
        self.down = nn.ModuleList(linear_norm(widths[s], widths[s + 1], bias=False) for s in range(len(GRID)))
        self.encoder = _stages(encoder, ENCODER_GROUPS, ENCODER_DEPTH)
        coarse = (*decoder[1:], encoder[-1])
        self.up = nn.ModuleList(linear_norm(c, width, bias=True) for c, width in zip(coarse, decoder, strict=True))
        self.skip = nn.ModuleList(linear_norm(s, width, bias=True) for s, width in zip(widths, decoder, strict=False))
        self.decoder = _stages(decoder, DECODER_GROUPS, DECODER_DEPTH)
        for module in self.modules():
            if isinstance(module, GroupedVectorAttention):
                module.missing_in_softmax = missing_in_softmax

    def forward(self, rows: Rows) -> Tensor:
        # neighbors are sorted by distance, so the first columns are a smaller neighborhood
        tables = [rows.neighbors(NEIGHBORS)]
        x = self.block(self.embedding(rows.xyz), rows.xyz, tables[0][:, :EMBEDDING_NEIGHBORS])
        levels, skips, parents = [rows], [x], []
        for stage, grid in enumerate(GRID):
            rows, parent = levels[-1].pooled(grid)
            x = segment_reduce(self.down[stage](x), parent, len(rows.xyz), "amax")
            tables.append(rows.neighbors(NEIGHBORS))
            for block in self.encoder[stage]:
                x = block(x, rows.xyz, tables[-1])
            levels.append(rows)
            skips.append(x)
            parents.append(parent)
        for stage in reversed(range(len(GRID))):
            x = self.up[stage](x)[parents[stage]] + self.skip[stage](skips[stage])
            for block in self.decoder[stage]:
                x = block(x, levels[stage].xyz, tables[stage])
        return x


def _stages(channels: list[int], groups: tuple[int, ...], depth: int) -> Any:
    """A list of blocks per level."""
    levels = zip(channels, groups, strict=True)
    return nn.ModuleList(nn.ModuleList(Block(c, g) for _ in range(depth)) for c, g in levels)


class Block(nn.Module):
    """A residual block of Linear, attention, Linear, each with a batch norm."""

    def __init__(self, channels: int, groups: int):
        super().__init__()
        self.first = linear_norm(channels, channels, bias=False)
        self.attention = GroupedVectorAttention(channels, groups)
        self.norm = nn.BatchNorm1d(channels)
        self.last = nn.Sequential(nn.Linear(channels, channels, bias=False), nn.BatchNorm1d(channels))

    def forward(self, x: Tensor, xyz: Tensor, neighbors: Tensor) -> Tensor:
        output = self.attention(self.first(x), xyz, neighbors)
        return (x + self.last(self.norm(output).relu())).relu()


class GroupedVectorAttention(nn.Module):
    """Wu et al., Point Transformer V2, Eq. 4 to 6: a weight for each neighbor and group of channels.

    missing_in_softmax: a missing neighbor counts as zeros at the row's own position, except in the last step.
    """

    missing_in_softmax = False

    def __init__(self, channels: int, groups: int):
        super().__init__()
        self.groups = groups
        self.query = linear_norm(channels, channels, bias=True)
        self.key = linear_norm(channels, channels, bias=True)
        self.value = nn.Linear(channels, channels)
        self.position = nn.ModuleList([linear_norm(3, channels, bias=True), nn.Linear(channels, channels)])
        self.group_weight = nn.Parameter(torch.empty(channels).uniform_(-1, 1) / channels**0.5)
        self.weight = nn.Sequential(nn.BatchNorm1d(groups), nn.ReLU(), nn.Linear(groups, groups))

    def forward(self, x: Tensor, xyz: Tensor, neighbors: Tensor) -> Tensor:
        """x (M, C), xyz (M, 3), neighbors (M, k), -1 for a missing one -> (M, C)."""
        exists = neighbors >= 0
        # existing neighbors in one list, so that batch norms see no others
        row, slot = (exists | self.missing_in_softmax).nonzero(as_tuple=True)
        neighbor = neighbors[row, slot]
        offset = (xyz[neighbor] - xyz[row]).masked_fill(neighbor[:, None] < 0, 0)
        bias = self.position[1](self.position[0](offset))
        # relation = key - query + bias, summed within groups; keys and queries before they are copied to neighbors
        key, query = self._summed(self.key(x)), self._summed(self.query(x))
        all_values = self.value(x)
        if self.missing_in_softmax:
            # a row of zeros at the end, which the index -1 reads
            key, all_values = (nn.functional.pad(rows, (0, 0, 0, 1)) for rows in (key, all_values))
        scores = self.weight(key[neighbor] - query[row] + self._summed(bias))
        weight = scores.new_full((*neighbors.shape, self.groups), -torch.inf).index_put((row, slot), scores).softmax(1)
        weight = weight * exists[..., None]
        value = (all_values[neighbor] + bias).unflatten(1, (self.groups, -1))
        weighted_values = (value * weight[row, slot][..., None]).flatten(1)
        return torch.zeros_like(x).index_add(0, row, weighted_values)

    def _summed(self, values: Tensor) -> Tensor:
        """(..., C) -> (..., G): weighted sums within each group, as a product with a block-diagonal matrix."""
        width = len(self.group_weight) // self.groups
        group = torch.arange(self.groups, device=values.device).repeat_interleave(width)
        return values @ (nn.functional.one_hot(group, self.groups) * self.group_weight[:, None]).to(values.dtype)
