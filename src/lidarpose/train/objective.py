"""What the loop must know of a kind of network: how people become arrays, and arrays losses.

Legend: B people, J joints of body26.
"""

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from lidarpose.train.example import Example

# a sum over this process's people -> that over all processes', divided by their number. Gradients are averaged over
# processes, so what is divided by it is the mean over everybody of the step, however they are shared out
Share = Callable[[Tensor], Tensor]


def alone(count: Tensor) -> Tensor:
    """The `Share` of a single process."""
    return count


class Objective(Protocol):
    """A kind of network to train. Is pickled into the loader's workers, so it holds settings and no tensors."""

    config: Any

    def network(self) -> nn.Module:
        """A new network, its weights drawn from torch's global generator."""
        ...

    def collate(self, examples: list[Example]) -> Any:
        """Examples of a batch, one or more, as what `terms` reads: numpy arrays, in a dict or a dataclass. Random
        draws for a person are from a generator of `Example.seed` alone, so nobody depends on batch mates."""
        ...

    def terms(
        self, network: Callable, arrays: Any, *, device: torch.device | str = "cpu", share: Share = alone
    ) -> dict[str, Tensor]:
        """Each weighted loss term by name; their sum is minimized. "mpjpe" (m, of decoded joints, detached) is told
        and not part of it. network: called as the network itself, be it wrapped."""
        ...

    def joints(self, network: Callable, arrays: Any, *, device: torch.device | str = "cpu") -> np.ndarray:
        """Decoded joints (B, J, 3) m of body26 in each person's frame, NaN where the network has no such joint."""
        ...


def total(terms: dict[str, Tensor]) -> Tensor:
    """The sum of the weighted terms."""
    return torch.stack([value for name, value in terms.items() if name != "mpjpe"]).sum()
