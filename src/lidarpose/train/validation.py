"""A run's validation: the same samples every time, their mean error, and a picture of some of them."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import nn

from lidarpose.io.files import write_atomic
from lidarpose.sample import Pose
from lidarpose.skeleton import BODY26, Skeleton
from lidarpose.train.augment import Example
from lidarpose.train.recipes import Recipe
from lidarpose.train.run_dir import PICTURES
from lidarpose.train.setup import TrainSetup

# examples in their own frames, predicted joints (N, 26, 3) m of body26, the skeleton to draw, a title -> PNG
Draw = Callable[[list[Example], np.ndarray, Skeleton, str], bytes]


class Validation:
    """draw: what makes the pictures, None for none; last: the error of the last validation in mm, None before."""

    def __init__(self, setup: TrainSetup, recipe: Recipe, folder: Path, draw: Draw | None = None):
        self.setup, self.recipe, self.folder, self.draw = setup, recipe, folder, draw
        self.last: float | None = None
        self._examples: list[Example] | None = None

    def run(self, network: nn.Module, people: int, device: torch.device | str) -> float | None:
        """MPJPE in mm of a network in evaluation mode over the labelled joints that it has; None with no sample to
        validate on. people: seen so far, which names the picture."""
        if self._examples is None:
            self._examples = self.setup.validation()
        examples, size, task = self._examples, self.recipe.batch, self.setup.task
        if not examples:
            return None
        batches = [task.collate(examples[k : k + size]) for k in range(0, len(examples), size)]
        joints = np.concatenate([task.joints(network, batch, device=device) for batch in batches])
        true = np.stack([example.joints for example in examples])
        # labelled, and of a joint that the network has; what is not finite though it should be, must be seen
        counted = ~np.isnan(true).any(-1) & ~np.isnan(joints).all((0, 2))
        self.last = float(np.linalg.norm(joints - true, axis=-1)[counted].mean() * 1e3)
        if self.recipe.pictures and self.draw is not None:
            rows = np.unique(np.linspace(0, len(joints) - 1, min(self.recipe.pictures, len(joints))).astype(int))
            shown = [examples[k] for k in rows]
            picture = self.draw(shown, joints[rows], self.setup.joints, f"after {people:,} people")
            write_atomic(self.folder / PICTURES / f"people-{people:09d}.png", picture)
        return self.last


def draw_examples(examples: list[Example], joints: np.ndarray, skeleton: Skeleton, title: str) -> bytes:
    """A PNG of people in their own frames with predicted joints (N, 26, 3) m of body26, drawn in `skeleton`."""
    from lidarpose.viz.draw import Panel, draw_people

    def pose(joints: np.ndarray) -> Pose | None:
        # none where the skeleton's joints are not all known
        own = joints[BODY26.map_to(skeleton)]
        return None if np.isnan(own).any() else Pose(joints=own, skeleton=skeleton)

    panels = []
    for example, predicted in zip(examples, joints, strict=True):
        error = np.nanmean(np.linalg.norm(predicted - example.joints, axis=-1)) * 1e3
        label = f"{len(example.points)} points, {error:.0f} mm"
        panels.append(Panel(points=example.points, pose=pose(predicted), truth=pose(example.joints), label=label))
    return draw_people(panels, title=title)
