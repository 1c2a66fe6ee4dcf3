"""Blocks of Point Transformer V3 as in DAPT's released code: convolutions over voxels, patch attention, pooling.

Legend: M voxels of all people at a level, concatenated, C channels, Q patches, K voxels per patch at most, H heads, D
channels per head. Modules have the names of the released weights. Stale convolutions: see `dapt_net`.
"""

from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarpose.models.dapt.voxel_tables import Level, Neighbors
from lidarpose.models.layers import DropPath, attend

# eps and momentum of the released code's batch norms
_EPS, _MOMENTUM = 1e-3, 0.01


class RowNorm(nn.BatchNorm1d):
    """Batch norm over rows (M, C); a single row has no variance and is normalized by the running statistics."""

    def __init__(self, channels: int, eps: float = _EPS, momentum: float = _MOMENTUM):
        super().__init__(channels, eps=eps, momentum=momentum)

    def forward(self, rows: Tensor) -> Tensor:
        if self.training and rows.shape[0] > 1:
            return super().forward(rows)
        return F.batch_norm(rows, self.running_mean, self.running_var, self.weight, self.bias, eps=self.eps)


class SubmanifoldConvolution(nn.Module):
    """A convolution that reads and writes only occupied cells.

    out[p] = sum over taps k of weight[:, k] @ rows[p + k - middle] + bias. weight (C', k, k, k, C) over x, y, z.
    """

    def __init__(self, channels: int, out_channels: int, kernel: int, *, bias: bool):
        super().__init__()
        self.weight = nn.Parameter(torch.empty(out_channels, kernel, kernel, kernel, channels))
        self.bias = nn.Parameter(torch.zeros(out_channels)) if bias else None
        bound = (kernel**3 * channels) ** -0.5
        nn.init.uniform_(self.weight, -bound, bound)

    def forward(self, rows: Tensor, near: Neighbors[Tensor]) -> Tensor:
        """rows (M, C) -> (M, C')."""
        # unbound once: if sliced tap by tap, the gradient of each slice would have the size of the whole weight
        weights = self.weight.flatten(1, 3).unbind(1)
        out = F.linear(rows, weights[len(weights) // 2], self.bias)
        if near.table is not None:
            # row number M marks an empty cell, and the middle tap, which is computed above: these taps read the voxel's
            # own row, set to zero. If they shared one zero row, it would be read so often that its gradient takes most
            # of a training step on a GPU
            count, width = near.table.shape
            is_empty = near.table == count
            own = torch.arange(count, device=rows.device)[:, None]
            index = torch.where(is_empty, own, near.table).flatten()
            neighbor_rows = rows.index_select(0, index).view(count, width, -1).masked_fill(is_empty[..., None], 0)
            neighbor_rows = neighbor_rows.flatten(1)
            return out + F.linear(neighbor_rows, self.weight.flatten(1))
        # all three are set if there is no table
        all_sources, all_targets, pairs = cast("tuple[Tensor, Tensor, Tensor]", (near.source, near.target, near.counts))
        # one gather and one sum for all taps: their gradients pass over the rows once, not once a tap
        neighbor_rows = rows.index_select(0, all_sources).split(pairs.tolist())
        terms = [F.linear(tap, weight) for weight, tap in zip(weights, neighbor_rows, strict=True) if len(tap)]
        if terms:
            out = out.index_add(0, all_targets, torch.cat(terms))
        return out


class PatchAttention(nn.Module):
    """Attention among the voxels of a patch: full attention for a person with no more voxels than a patch."""

    def __init__(self, channels: int, heads: int):
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(channels, 3 * channels)
        self.proj = nn.Linear(channels, channels)

    def forward(self, rows: Tensor, level: Level[Tensor], order: int) -> Tensor:
        """rows (M, C) -> (M, C), patches along the `order`-th curve."""
        qkv = self.qkv(rows)
        if level.patch_slots is not None:
            order = order % level.patch_slots.shape[0]
            blocks = qkv[level.patch_slots[order]].unflatten(-1, (3, self.heads, -1))
            # set together with patch_slots
            place = cast("Tensor", level.patch_place)[order]
            output = self._attend(blocks, level.patch_valid).flatten(0, 1)[place]
            return self.proj(output)
        sequence = level.sequence[order % level.sequence.shape[0]]
        # with one patch per person, rows are already in the order of the patches
        is_sorted = level.patch_lengths.shape == level.lengths.shape
        qkv = (qkv if is_sorted else qkv[sequence]).unflatten(-1, (3, self.heads, -1))
        lengths = level.patch_lengths.tolist()
        if len(set(lengths)) == 1:
            output = self._attend(qkv.unflatten(0, (len(lengths), -1)), None).flatten(0, 1)
        else:
            output = torch.cat([self._attend(patch[None], None)[0] for patch in qkv.split(lengths)])
        return self.proj(output if is_sorted else torch.empty_like(output).index_copy(0, sequence, output))

    @staticmethod
    def _attend(qkv: Tensor, mask: Tensor | None) -> Tensor:
        """qkv (Q, K, 3, H, D), mask (Q, K) True for valid keys, None if all are -> (Q, K, H * D)."""
        query, key, value = qkv.permute(2, 0, 3, 1, 4)
        mask = None if mask is None else mask[:, None, None]
        return attend(query, key, value, mask).transpose(1, 2).flatten(2)


class Perceptron(nn.Module):
    """Linear, GELU, Linear."""

    def __init__(self, channels: int, hidden: int, out_channels: int):
        super().__init__()
        self.fc1 = nn.Linear(channels, hidden)
        self.fc2 = nn.Linear(hidden, out_channels)

    def forward(self, rows: Tensor) -> Tensor:
        return self.fc2(F.gelu(self.fc1(rows)))


class Block(nn.Module):
    """Convolution as position encoding, attention and feed-forward, each a residual branch; pre-norm.

    In the released code, the next block's convolution does not read the sum at the end of a block, but the last branch.
    """

    def __init__(self, channels: int, heads: int, mlp_ratio: int, drop_path: float, order: int):
        super().__init__()
        self.order = order
        self.cpe = nn.Sequential(
            SubmanifoldConvolution(channels, channels, 3, bias=True),
            nn.Linear(channels, channels),
            nn.LayerNorm(channels),
        )
        self.norm1 = nn.Sequential(nn.LayerNorm(channels))
        self.attn = PatchAttention(channels, heads)
        self.norm2 = nn.Sequential(nn.LayerNorm(channels))
        self.mlp = nn.Sequential(Perceptron(channels, mlp_ratio * channels, channels))
        self.drop_path = DropPath(drop_path)

    def forward(self, rows: Tensor, stale: Tensor, level: Level) -> tuple[Tensor, Tensor]:
        """rows (M, C) and the convolution's input (M, C), either the rows or the stale branch -> rows, last branch."""
        convolution, mix, norm = self.cpe
        rows = rows + norm(mix(convolution(stale, level.near)))
        rows = rows + self.drop_path(self.attn(self.norm1(rows), level, self.order))
        branch = self.drop_path(self.mlp(self.norm2(rows)))
        return rows + branch, branch


class Stage(nn.Module):
    """The blocks of one level and the transition to it: `down` from the finer level or `up` from the coarser one.

    drops: drop probability of each block; finer: channels of the level to pool; coarser: channels of the level to
    unpool and of the encoder's rows at this level.
    """

    def __init__(
        self,
        channels: int,
        heads: int,
        mlp_ratio: int,
        drops: list[float],
        *,
        finer: int = 0,
        coarser: tuple[int, int] | None = None,
    ):
        super().__init__()
        self.depth = len(drops)
        blocks = [Block(channels, heads, mlp_ratio, drop, order) for order, drop in enumerate(drops)]
        if finer:
            self.down = Pooling(finer, channels)
        if coarser is not None:
            self.up = Unpooling(*coarser, channels)
        for k, block in enumerate(blocks):
            self.add_module(f"block{k}", block)

    def blocks(self, rows: Tensor, stale: Tensor, level: Level, *, stale_convolution: bool) -> Tensor:
        """rows (M, C) -> (M, C); `stale` is the input of the first convolution if convolutions are stale."""
        for k in range(self.depth):
            block = getattr(self, f"block{k}")
            rows, stale = block(rows, stale if stale_convolution else rows, level)
        return rows


class Pooling(nn.Module):
    """Pools rows of a level to the voxels of the next: Linear, the maximum of the children, norm, GELU."""

    def __init__(self, channels: int, out_channels: int):
        super().__init__()
        self.proj = nn.Linear(channels, out_channels)
        self.norm = nn.Sequential(RowNorm(out_channels))

    def forward(self, rows: Tensor, children: Tensor) -> Tensor:
        return F.gelu(self.norm(self.proj(rows)[children].max(1).values))


class Unpooling(nn.Module):
    """Rows of the coarser level, copied to their children, plus the encoder's rows of this level."""

    def __init__(self, channels: int, skip_channels: int, out_channels: int):
        super().__init__()
        self.proj = nn.Sequential(nn.Linear(channels, out_channels), RowNorm(out_channels), nn.GELU())
        self.proj_skip = nn.Sequential(nn.Linear(skip_channels, out_channels), RowNorm(out_channels), nn.GELU())

    def forward(self, coarse: Tensor, skip: Tensor, parent: Tensor) -> tuple[Tensor, Tensor]:
        """The sum (M, C), and the skip alone, which the released code's first convolution reads."""
        skip = self.proj_skip(skip)
        return skip + self.proj(coarse)[parent], skip
