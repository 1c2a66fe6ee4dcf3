"""The training loop's interface to a kind of network: how examples become arrays, and arrays become losses.

Legend: B people, J joints of body26.
"""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from lidarpose.models.checkpoint import build
from lidarpose.skeleton import BODY26
from lidarpose.train.augment import UNKNOWN_PART

# terms that are logged but not minimized: mean error of decoded joints, m; average precision, 0 to 1
LOGGED = ("mpjpe", "ap")
# maps a sum over this process's people to the sum over all processes, divided by the number of processes. Gradients are
# averaged over processes, so a loss divided by it is a mean over all samples of the step, however they are distributed
Share = Callable[[Tensor], Tensor]


def one_process(count: Tensor) -> Tensor:
    """The `Share` of a single process."""
    return count


class Objective(Protocol):
    """A kind of network to train. It is pickled into the loader's workers, so it holds settings and no tensors."""

    @property
    def config(self) -> Any: ...

    def network(self) -> nn.Module:
        """A new network with weights drawn from torch's global generator."""
        ...

    def collate(self, examples: list[Any]) -> Any:
        """Collates one or more examples (for clips `ClipExample`s) into the input of `terms`: numpy arrays in a dict or
        a dataclass. Random draws for an example use a generator seeded by `Example.seed` only, so they do not depend on
        the other examples of the batch."""
        ...

    def terms(
        self, network: Callable, arrays: Any, *, device: torch.device | str = "cpu", share: Share = one_process
    ) -> dict[str, Tensor]:
        """Weighted loss terms by name; their sum is minimized, except for those in `LOGGED`, which are detached.
        network: the network or a wrapper that is called the same way."""
        ...


class BuiltNetwork:
    """Base of objectives whose network is that of `models.NETWORKS` for their configuration."""

    config: Any

    def network(self) -> nn.Module:
        return build(self.config)


class PoseObjective(Objective, Protocol):
    """A kind of network that predicts joints."""

    def joints(self, network: Callable, arrays: Any, *, device: torch.device | str = "cpu") -> np.ndarray:
        """Decoded joints (B, J, 3) m of body26 in each person's frame, NaN for joints that the network lacks."""
        ...


def on_device(arrays: dict[str, np.ndarray], device: torch.device | str) -> dict[str, Tensor]:
    """The arrays as tensors on a device."""
    return {name: torch.as_tensor(array).to(device) for name, array in arrays.items()}


def in_body26(joints: Tensor, columns: Sequence[int] | np.ndarray) -> np.ndarray:
    """Joints (B, J, 3), `columns` of body26 -> (B, 26, 3) float32, NaN in all other columns."""
    out = np.full((len(joints), len(BODY26), 3), np.nan, np.float32)
    out[:, columns] = joints.float().cpu().numpy()
    return out


def total(terms: dict[str, Tensor]) -> Tensor:
    """The sum of the weighted terms."""
    return torch.stack([value for name, value in terms.items() if name not in LOGGED]).sum()


def at_least_one(count: Tensor) -> Tensor:
    """Replaces a count of 0 by 1 for division; counts between 0 and 1, shares of one process, are unchanged."""
    return torch.where(count > 0, count, torch.ones_like(count))


def majority_part(voxel: np.ndarray, part: np.ndarray, *, voxels: int, parts: int) -> np.ndarray:
    """voxel (n,) of each point, negative for none; part (n,), negative if unknown -> (voxels,) int64: the part of most
    points of a voxel, the lowest on ties; -1 if none is known."""
    is_known = (voxel >= 0) & (part >= 0)
    votes = np.bincount(voxel[is_known] * parts + part[is_known], minlength=voxels * parts).reshape(-1, parts)
    return np.where(votes.any(1), votes.argmax(1), UNKNOWN_PART)
