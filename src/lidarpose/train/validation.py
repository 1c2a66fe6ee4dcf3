"""A run's validation: the same people every time, their mean error, and a picture of some of them."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import nn

from lidarpose.io.files import write_atomic
from lidarpose.skeleton import Skeleton
from lidarpose.train.example import Example
from lidarpose.train.recipes import Recipe
from lidarpose.train.run_dir import PICTURES
from lidarpose.train.setup import TrainSetup

# people in their own frames, predicted joints (N, 26, 3) m of body26, the skeleton to draw, a title -> PNG
Draw = Callable[[list[Example], np.ndarray, Skeleton, str], bytes]


class Validation:
    """draw: what makes the pictures, None for none; last: the error of the last validation in mm, None before."""

    def __init__(self, setup: TrainSetup, recipe: Recipe, folder: Path, draw: Draw | None = None):
        self.setup, self.recipe, self.folder, self.draw = setup, recipe, folder, draw
        self.last: float | None = None
        self._people: list[Example] | None = None

    def run(self, network: nn.Module, people: int, device: torch.device | str) -> float | None:
        """MPJPE in mm of a network in evaluation mode over the labelled joints that it has; None with nobody to
        validate on. people: seen so far, which names the picture."""
        if self._people is None:
            self._people = self.setup.validation()
        if not self._people:
            return None
        joints = self.predicted(network, self._people, device)
        true = np.stack([one.joints for one in self._people])
        # labelled, and of a joint that the network has; what is not finite though it should be, must be seen
        judged = ~np.isnan(true).any(-1) & ~np.isnan(joints).all((0, 2))
        self.last = float(np.linalg.norm(joints - true, axis=-1)[judged].mean() * 1e3)
        if self.recipe.pictures and self.draw is not None:
            self._drawn(joints, people)
        return self.last

    def predicted(self, network: nn.Module, people: list[Example], device: torch.device | str) -> np.ndarray:
        """(N, 26, 3) m."""
        size = self.recipe.batch
        parts = [people[k : k + size] for k in range(0, len(people), size)]
        return np.concatenate(
            [self.setup.task.joints(network, self.setup.task.collate(p), device=device) for p in parts]
        )

    def _drawn(self, joints: np.ndarray, people: int) -> None:
        chosen = np.unique(np.linspace(0, len(joints) - 1, min(self.recipe.pictures, len(joints))).astype(int))
        shown = [self._people[k] for k in chosen]
        picture = self.draw(shown, joints[chosen], self.setup.joints, f"after {people:,} people")
        write_atomic(self.folder / PICTURES / f"people-{people:09d}.png", picture)
