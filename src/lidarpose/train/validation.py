"""A run's validation: the same people every time, their mean error, and a picture of some of them."""

from pathlib import Path

import numpy as np
import torch
from torch import nn

from lidarpose.data.files import atomic_path
from lidarpose.sample import Pose
from lidarpose.skeleton import BODY26, Skeleton
from lidarpose.train.example import Example
from lidarpose.train.job import Job
from lidarpose.train.recipes import Recipe
from lidarpose.train.runs import PICTURES


class Validation:
    """last: the error of the last one in mm, None before."""

    def __init__(self, job: Job, recipe: Recipe, folder: Path):
        self.job, self.recipe, self.folder = job, recipe, folder
        self.last: float | None = None
        self._people: list[Example] | None = None

    def run(self, network: nn.Module, people: int, device: torch.device | str) -> float | None:
        """MPJPE in mm of a network in evaluation mode over the labelled joints that it has; None with nobody to
        validate on. people: seen so far, which names the picture."""
        if self._people is None:
            self._people = self.job.validation()
        if not self._people:
            return None
        joints = self.predicted(network, self._people, device)
        true = np.stack([one.joints for one in self._people])
        self.last = float(np.nanmean(np.linalg.norm(joints - true, axis=-1)) * 1e3)
        if self.recipe.pictures:
            self._draw(joints, people)
        return self.last

    def predicted(self, network: nn.Module, people: list[Example], device: torch.device | str) -> np.ndarray:
        """(N, 26, 3) m."""
        size = self.recipe.batch
        parts = [people[k : k + size] for k in range(0, len(people), size)]
        return np.concatenate([self.job.task.joints(network, self.job.task.collate(p), device=device) for p in parts])

    def _draw(self, joints: np.ndarray, people: int) -> None:
        from lidarpose.view.picture import Panel, draw_people

        chosen = np.unique(np.linspace(0, len(joints) - 1, min(self.recipe.pictures, len(joints))).astype(int))
        panels = []
        for k in chosen:
            one = self._people[k]
            error = np.nanmean(np.linalg.norm(joints[k] - one.joints, axis=-1)) * 1e3
            panels.append(
                Panel(
                    points=one.points,
                    pose=_pose(joints[k], self.job.joints),
                    truth=_pose(one.joints, self.job.joints),
                    label=f"{len(one.points)} points, {error:.0f} mm",
                )
            )
        with atomic_path(self.folder / PICTURES / f"people-{people:09d}.png") as path:
            path.write_bytes(draw_people(panels, title=f"after {people:,} people"))


def _pose(joints: np.ndarray, skeleton: Skeleton) -> Pose | None:
    """joints (26, 3) of body26, or None where the skeleton's are not all known."""
    own = joints[BODY26.map_to(skeleton)]
    return None if np.isnan(own).any() else Pose(joints=own, skeleton=skeleton)
