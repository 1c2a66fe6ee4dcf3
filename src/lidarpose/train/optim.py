"""Optimizers, learning-rate schedules, and the moving average of the weights."""

from collections.abc import Iterable, Sequence
from math import cos, pi
from typing import Any

import torch
from torch import Tensor, nn

from lidarpose.models.dapt.dapt_net import DaptNet
from lidarpose.models.posenet import PoseNet
from lidarpose.train.recipes import PoseRecipe, Recipe

# the released schedule begins at a tenth of its peak rate and ends at a thousandth
_FIRST, _LAST = 0.1, 1e-3
# parameters of a `PoseNet` that Muon does not step: vectors, embeddings, and layers that output meters or logits
_ENDS = (
    *("anchors", "stem.voxel", "stem.view", "place", "anchor_view", "level_joints", "vote.residual", "part"),
    *("joint.heatmap", "joint.certainty", "person"),
)
# the layers of the paper's network that output heatmaps, one per axis
_HEATMAPS = tuple(f"heads.query.fcs.{axis}.fc2." for axis in range(3))
# Muon's Newton-Schulz iteration
_COEFFICIENTS, _ITERATIONS, _EPS = (3.4445, -4.775, 2.0315), 5, 1e-7


def optimizers(network: nn.Module, recipe: Recipe) -> list[torch.optim.Optimizer]:
    """The recipe's AdamW or Adam; for a `PoseNet` and a nonzero muon_rate AdamW, and Muon for the hidden matrices."""
    betas: Any = recipe.betas
    settings: dict[str, Any] = {"lr": recipe.rate, "weight_decay": recipe.decay, "fused": True}
    if not (isinstance(network, PoseNet) and isinstance(recipe, PoseRecipe) and recipe.muon_rate):
        optimizer_class = torch.optim.Adam if recipe.optimizer == "adam" else torch.optim.AdamW
        # the paper uses torch's default betas
        return [optimizer_class(_groups(network, recipe), betas=betas or (0.9, 0.999), **settings)]
    hidden_matrices: list[nn.Parameter] = []
    other_parameters: list[nn.Parameter] = []
    for name, value in network.named_parameters():
        (other_parameters if value.ndim != 2 or any(end in name for end in _ENDS) else hidden_matrices).append(value)
    return [
        torch.optim.AdamW(other_parameters, betas=betas or (0.9, 0.98), **settings),
        Muon(hidden_matrices, lr=recipe.muon_rate, weight_decay=recipe.decay, momentum=0.95),
    ]


def _groups(network: nn.Module, recipe: Recipe) -> list[dict[str, Any]]:
    """Parameter groups; heatmap layers form their own group if their rate differs: `times` the recipe's rate."""
    times = recipe.heatmap_rate if isinstance(recipe, PoseRecipe) and isinstance(network, DaptNet) else 1.0
    if times == 1:
        return [{"params": list(network.parameters())}]
    parameters = dict(network.named_parameters())
    heatmaps = [value for name, value in parameters.items() if name.startswith(_HEATMAPS)]
    rest = [value for name, value in parameters.items() if not name.startswith(_HEATMAPS)]
    groups: list[dict[str, Any]] = [{"params": rest}, {"params": heatmaps, "lr": times * recipe.rate, "times": times}]
    return [group for group in groups if group["params"]]


def rate_factor(done: float, recipe: Recipe) -> float:
    """Share of the peak rate after the fraction `done` in [0, 1] of the run."""
    if recipe.schedule in ("constant", "reduce-on-plateau"):
        return 1.0
    if recipe.schedule == "cosine":
        # torch's OneCycleLR: half a cosine up, half a cosine down
        if done < recipe.warmup:
            return _FIRST + (1 - _FIRST) * (1 - cos(pi * done / recipe.warmup)) / 2
        fall = min((done - recipe.warmup) / max(1 - recipe.warmup, 1e-9), 1.0)
        return _LAST + (1 - _LAST) * (1 + cos(pi * fall)) / 2
    if done < recipe.warmup:
        return max(done, recipe.warmup / 100) / recipe.warmup
    return 1.0 if done < 1 - recipe.cool or not recipe.cool else max((1 - done) / recipe.cool, 0.0)


def plateau_factor(losses: Sequence[float], rate: float) -> float:
    """Share of the peak rate after epochs with these mean losses: it falls by a tenth after two consecutive epochs that
    each improve the loss by less than 1 %. Source: LiDARCap's ReduceLROnPlateau. Its lower bound of 3e-8 is left out,
    since torch omits reductions by less than 1e-8: a rate stays above 9e-8."""
    optimizer = torch.optim.SGD([torch.zeros(1)], lr=rate)
    scheduler = torch.optim.lr_scheduler.ReduceLROnPlateau(optimizer, factor=0.9, patience=1, threshold=0.01)
    for loss in losses:
        scheduler.step(loss)
    return optimizer.param_groups[0]["lr"] / rate


def set_rates(optimizers: list[torch.optim.Optimizer], recipe: Recipe, factor: float) -> None:
    """Sets the rates of all optimizers to a share `factor` of their peaks."""
    for optimizer in optimizers:
        rate = recipe.muon_rate if isinstance(optimizer, Muon) and isinstance(recipe, PoseRecipe) else recipe.rate
        for group in optimizer.param_groups:
            group["lr"] = rate * factor * group.get("times", 1.0)


@torch.no_grad()
def average(mean: dict[str, Tensor], network: nn.Module, step: int, ema: float) -> None:
    """Moves the running mean of the weights toward the network's weights, faster early in the run. In place."""
    decay = min(ema, (1 + step) / (10 + step))
    parameters = dict(network.named_parameters())
    torch._foreach_lerp_(list(mean.values()), [parameters[name] for name in mean], 1 - decay)


class Muon(torch.optim.Optimizer):
    """Momentum with an orthogonalized update, for matrices (2-D parameters) only; equal shapes are batched.

    The optimizer and its constants are those of `torch.optim.Muon` (Jordan et al. 2024, as in torch 2.9), which steps
    matrices one by one in bfloat16: on a CPU that takes a tenth of a small network's step. Here matrices of equal shape
    are stacked and orthogonalized in one batch, in their own dtype. A test checks that the two agree.
    """

    def __init__(self, matrices: Iterable[Tensor], *, lr: float, weight_decay: float = 0.1, momentum: float = 0.95):
        matrices = list(matrices)
        for matrix in matrices:
            if matrix.ndim != 2:
                raise ValueError(f"Muon updates matrices, got a parameter of shape {tuple(matrix.shape)}")
        super().__init__(matrices, {"lr": lr, "weight_decay": weight_decay, "momentum": momentum})

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]  # torch's takes closures and floats
        """Steps every matrix that has a gradient."""
        if closure is not None:
            raise ValueError("Muon takes no closure")
        for group in self.param_groups:
            matrices_by_shape: dict[tuple, list[Tensor]] = {}
            for matrix in group["params"]:
                if matrix.grad is not None:
                    matrices_by_shape.setdefault((matrix.shape, matrix.device, matrix.dtype), []).append(matrix)
            for matrices in matrices_by_shape.values():
                self._step(matrices, group)

    def _step(self, matrices: list[Tensor], group: dict) -> None:
        for matrix in matrices:
            if not self.state[matrix]:
                self.state[matrix]["momentum_buffer"] = torch.zeros_like(matrix)
        buffers = [self.state[matrix]["momentum_buffer"] for matrix in matrices]
        gradients = [matrix.grad for matrix in matrices if matrix.grad is not None]
        torch._foreach_lerp_(buffers, gradients, 1 - group["momentum"])
        # Nesterov: look one step ahead
        lookahead = torch._foreach_lerp(gradients, buffers, group["momentum"])
        update = orthogonalized(torch.stack(lookahead))
        rows, columns = matrices[0].shape
        torch._foreach_mul_(matrices, 1 - group["lr"] * group["weight_decay"])
        torch._foreach_add_(matrices, list(update.unbind()), alpha=-group["lr"] * max(1, rows / columns) ** 0.5)


def orthogonalized(matrices: Tensor) -> Tensor:
    """matrices (K, M, N) -> (K, M, N): their singular values brought near 1 by a Newton-Schulz iteration."""
    is_tall = matrices.shape[1] > matrices.shape[2]
    x = matrices.mT if is_tall else matrices
    x = x / x.norm(dim=(1, 2), keepdim=True).clamp(min=_EPS)
    a, b, c = _COEFFICIENTS
    for _ in range(_ITERATIONS):
        gram = x @ x.mT
        x = torch.baddbmm(x, torch.baddbmm(gram, gram, gram, beta=b, alpha=c), x, beta=a)
    return x.mT if is_tall else x
