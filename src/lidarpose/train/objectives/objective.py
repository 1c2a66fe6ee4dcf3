"""What the training loop must know of a kind of network: how examples become arrays, and arrays losses.

Legend: B people, J joints of body26.
"""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from lidarpose.skeleton import BODY26
from lidarpose.train.augment import UNKNOWN_PART

# terms that are logged and not minimized: mean error of decoded joints, m; average precision, 0 to 1
LOGGED = ("mpjpe", "ap")
# a sum over this process's people -> that over all processes', divided by their number. Gradients are averaged over
# processes, so what is divided by it is the mean over all samples of the step, however they are shared out
Share = Callable[[Tensor], Tensor]


def one_process(count: Tensor) -> Tensor:
    """The `Share` of a single process."""
    return count


class Objective(Protocol):
    """A kind of network to train. Is pickled into the loader's workers, so it holds settings and no tensors."""

    @property
    def config(self) -> Any: ...

    def network(self) -> nn.Module:
        """A new network, its weights drawn from torch's global generator."""
        ...

    def collate(self, examples: list[Any]) -> Any:
        """Examples of a batch, one or more, of clips `ClipExample`s, as what `terms` reads: numpy arrays, in a dict or
        a dataclass. Random draws for an example are from a generator of `Example.seed` alone, so none depends on its
        batch mates."""
        ...

    def terms(
        self, network: Callable, arrays: Any, *, device: torch.device | str = "cpu", share: Share = one_process
    ) -> dict[str, Tensor]:
        """Each weighted loss term by name; their sum is minimized. Those of `LOGGED`, detached, are no part of it.
        network: called as the network itself, be it wrapped."""
        ...


class PoseObjective(Objective, Protocol):
    """A kind of network that predicts joints."""

    def joints(self, network: Callable, arrays: Any, *, device: torch.device | str = "cpu") -> np.ndarray:
        """Decoded joints (B, J, 3) m of body26 in each person's frame, NaN where the network has no such joint."""
        ...


def on_device(arrays: dict[str, np.ndarray], device: torch.device | str) -> dict[str, Tensor]:
    """Arrays as tensors there."""
    return {name: torch.as_tensor(array).to(device) for name, array in arrays.items()}


def in_body26(joints: Tensor, columns: Sequence[int] | np.ndarray) -> np.ndarray:
    """Joints (B, J, 3) that are these columns of body26 -> (B, 26, 3) float32, NaN in all others."""
    out = np.full((len(joints), len(BODY26), 3), np.nan, np.float32)
    out[:, columns] = joints.float().cpu().numpy()
    return out


def total(terms: dict[str, Tensor]) -> Tensor:
    """The sum of the weighted terms."""
    return torch.stack([value for name, value in terms.items() if name not in LOGGED]).sum()


def at_least_one(count: Tensor) -> Tensor:
    """1 for a sum over nothing; the share of one among several processes may be below 1 and stays."""
    return torch.where(count > 0, count, torch.ones_like(count))


def majority_part(voxel: np.ndarray, part: np.ndarray, *, voxels: int, parts: int) -> np.ndarray:
    """voxel (n,) of each point, negative for none; part (n,), negative where unknown -> (voxels,) int64: the part that
    most points of a voxel are of, the first of equals; -1 where none is known."""
    is_known = (voxel >= 0) & (part >= 0)
    votes = np.bincount(voxel[is_known] * parts + part[is_known], minlength=voxels * parts).reshape(-1, parts)
    return np.where(votes.any(1), votes.argmax(1), UNKNOWN_PART)
