"""Muon, with matrices of one shape stepped together.

The optimizer and its constants are those of `torch.optim.Muon` (Jordan et al. 2024, as in torch 2.9), which goes
through the matrices one by one in bfloat16: on a CPU a tenth of a small network's step. Here matrices of one shape are
stacked and orthogonalized in one batch, in their own type. A test holds the two together.
"""

from collections.abc import Iterable

import torch
from torch import Tensor

COEFFICIENTS = (3.4445, -4.775, 2.0315)
STEPS = 5
EPS = 1e-7


class Muon(torch.optim.Optimizer):
    """Momentum whose update is orthogonalized, for matrices (2-D parameters) alone."""

    def __init__(self, matrices: Iterable[Tensor], *, lr: float, weight_decay: float = 0.1, momentum: float = 0.95):
        matrices = list(matrices)
        for matrix in matrices:
            if matrix.ndim != 2:
                raise ValueError(f"Muon steps matrices, got a parameter of shape {tuple(matrix.shape)}")
        super().__init__(matrices, {"lr": lr, "weight_decay": weight_decay, "momentum": momentum})

    @torch.no_grad()
    def step(self, closure=None) -> None:
        """One step of every matrix that has a gradient."""
        if closure is not None:
            raise ValueError("Muon takes no closure")
        for group in self.param_groups:
            alike: dict[tuple, list[Tensor]] = {}
            for matrix in group["params"]:
                if matrix.grad is not None:
                    alike.setdefault((matrix.shape, matrix.device, matrix.dtype), []).append(matrix)
            for matrices in alike.values():
                self._step(matrices, group)

    def _step(self, matrices: list[Tensor], group: dict) -> None:
        for matrix in matrices:
            if not self.state[matrix]:
                self.state[matrix]["momentum_buffer"] = torch.zeros_like(matrix)
        buffers = [self.state[matrix]["momentum_buffer"] for matrix in matrices]
        gradients = [matrix.grad for matrix in matrices]
        torch._foreach_lerp_(buffers, gradients, 1 - group["momentum"])
        # Nesterov: look one step ahead
        ahead = torch._foreach_lerp(gradients, buffers, group["momentum"])
        update = orthogonalized(torch.stack(ahead))
        rows, columns = matrices[0].shape
        torch._foreach_mul_(matrices, 1 - group["lr"] * group["weight_decay"])
        torch._foreach_add_(matrices, list(update.unbind()), alpha=-group["lr"] * max(1, rows / columns) ** 0.5)


def orthogonalized(matrices: Tensor) -> Tensor:
    """matrices (K, M, N) -> (K, M, N): their singular values brought near 1 by a Newton-Schulz iteration."""
    tall = matrices.shape[1] > matrices.shape[2]
    x = matrices.mT if tall else matrices
    x = x / x.norm(dim=(1, 2), keepdim=True).clamp(min=EPS)
    a, b, c = COEFFICIENTS
    for _ in range(STEPS):
        gram = x @ x.mT
        x = torch.baddbmm(x, torch.baddbmm(gram, gram, gram, beta=b, alpha=c), x, beta=a)
    return x.mT if tall else x
