"""Optimizer, learning-rate schedule, and the moving average of the weights."""

import torch
from torch import nn

from lidarpose.train.muon import Muon
from lidarpose.train.recipes import Pretrain

WARMUP = 0.02
# the last part of a run, in which the rate falls to nothing
COOL = 0.3
EMA = 0.999
WEIGHT_DECAY = 0.01


def optimizers(network: nn.Module, recipe: Pretrain) -> list[torch.optim.Optimizer]:
    """Muon for the hidden matrices, AdamW for vectors, embeddings and the layers that end in metres or logits."""
    ends = ("anchors", "stem.voxel", "stem.view", "place", "anchor_view", "level_joints", "vote.residual")
    ends += ("part", "joint.heatmap", "joint.certainty")
    hidden, other = [], []
    for name, value in network.named_parameters():
        is_end = value.ndim != 2 or any(end in name for end in ends)
        (other if is_end or not recipe.muon_rate else hidden).append(value)
    made = [torch.optim.AdamW(other, lr=recipe.rate, betas=(0.9, 0.98), weight_decay=WEIGHT_DECAY, fused=True)]
    if hidden:
        made.append(Muon(hidden, lr=recipe.muon_rate, weight_decay=WEIGHT_DECAY, momentum=0.95))
    return made


def rate_factor(done: float) -> float:
    """Share of the peak rate when `done` in [0, 1] of the run is over: a short rise, a plateau, a fall to zero."""
    if done < WARMUP:
        return max(done, WARMUP / 100) / WARMUP
    return 1.0 if done < 1 - COOL else max((1 - done) / COOL, 0.0)


@torch.no_grad()
def average(mean: dict[str, torch.Tensor], network: nn.Module, step: int) -> None:
    """Moves the running mean of the weights towards the network's, faster while the run is young. In place."""
    keep = min(EMA, (1 + step) / (10 + step))
    values = dict(network.named_parameters())
    torch._foreach_lerp_(list(mean.values()), [values[name] for name in mean], 1 - keep)
