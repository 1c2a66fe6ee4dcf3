"""Optimizers, learning-rate schedules, and the moving average of the weights."""

from math import cos, pi

import torch
from torch import nn

from lidarpose.models.posenet import PoseNet
from lidarpose.train.muon import Muon
from lidarpose.train.recipes import Recipe

# the released schedule begins at a tenth of its peak and ends at a thousandth
_FIRST, _LAST = 0.1, 1e-3
# vectors, embeddings and the layers of a `PoseNet` that end in metres or logits
_ENDS = ("anchors", "stem.voxel", "stem.view", "place", "anchor_view", "level_joints", "vote.residual", "part")
_ENDS += ("joint.heatmap", "joint.certainty")


def optimizers(network: nn.Module, recipe: Recipe) -> list[torch.optim.Optimizer]:
    """AdamW; with a muon_rate Muon besides, for the hidden matrices of a `PoseNet`."""
    if not recipe.muon_rate or not isinstance(network, PoseNet):
        # the paper's: torch's own settings
        return [torch.optim.AdamW(network.parameters(), lr=recipe.rate, weight_decay=recipe.decay, fused=True)]
    hidden, other = [], []
    for name, value in network.named_parameters():
        (other if value.ndim != 2 or any(end in name for end in _ENDS) else hidden).append(value)
    return [
        torch.optim.AdamW(other, lr=recipe.rate, betas=(0.9, 0.98), weight_decay=recipe.decay, fused=True),
        Muon(hidden, lr=recipe.muon_rate, weight_decay=recipe.decay, momentum=0.95),
    ]


def rate_factor(done: float, recipe: Recipe) -> float:
    """Share of the peak rate when `done` in [0, 1] of the run is over."""
    if recipe.schedule == "cosine":
        # torch's OneCycleLR: half a cosine up, half a cosine down
        if done < recipe.warmup:
            return _FIRST + (1 - _FIRST) * (1 - cos(pi * done / recipe.warmup)) / 2
        fallen = min((done - recipe.warmup) / max(1 - recipe.warmup, 1e-9), 1.0)
        return _LAST + (1 - _LAST) * (1 + cos(pi * fallen)) / 2
    if done < recipe.warmup:
        return max(done, recipe.warmup / 100) / recipe.warmup
    return 1.0 if done < 1 - recipe.cool or not recipe.cool else max((1 - done) / recipe.cool, 0.0)


def set_rates(made: list[torch.optim.Optimizer], recipe: Recipe, done: float) -> None:
    """Rates of all optimizers when `done` in [0, 1] of the run is over."""
    factor = rate_factor(done, recipe)
    for optimizer in made:
        rate = recipe.muon_rate if isinstance(optimizer, Muon) else recipe.rate
        for group in optimizer.param_groups:
            group["lr"] = rate * factor


@torch.no_grad()
def average(mean: dict[str, torch.Tensor], network: nn.Module, step: int, ema: float) -> None:
    """Moves the running mean of the weights towards the network's, faster while the run is young. In place."""
    keep = min(ema, (1 + step) / (10 + step))
    values = dict(network.named_parameters())
    torch._foreach_lerp_(list(mean.values()), [values[name] for name in mean], 1 - keep)
