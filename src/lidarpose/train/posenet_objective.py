"""`PoseNetObjective`: what the loop must know of the package's own network."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lidarpose.models.config import NetworkConfig
from lidarpose.models.posenet import Batch, PoseNet, Targets
from lidarpose.models.voxelize import VoxelPyramid, voxelize
from lidarpose.train.example import Example
from lidarpose.train.losses import losses
from lidarpose.train.objective import Share, alone

# most fine voxels a person in training
MAX_VOXELS = 224


@dataclass(frozen=True, kw_only=True)
class PoseNetObjective:
    """A `Objective` of a `PoseNet` with this configuration. bone, symmetry: weights, see `losses`."""

    config: NetworkConfig
    bone: float = 0.0
    symmetry: float = 0.0

    def network(self) -> PoseNet:
        return PoseNet(self.config)

    def collate(self, examples: list[Example]) -> dict[str, np.ndarray]:
        """The arrays of a plan, and those of `Targets`."""
        tables = voxelize(
            np.concatenate([e.points for e in examples]),
            np.array([len(e.points) for e in examples]),
            grid=self.config.grid,
            max_voxels=MAX_VOXELS,
            view=np.stack([e.view for e in examples]),
            seeds=np.array([e.seed for e in examples]),
            neighbors=self.config.convolution > 0,
        )
        part = np.concatenate([e.part for e in examples]).astype(np.int64)
        joints, visible = np.stack([e.joints for e in examples]), np.stack([e.visible for e in examples])
        arrays = tables.arrays()
        del arrays["point_voxel"]
        return arrays | {
            "joints": joints,
            "known": ~np.isnan(joints).any(-1),
            "visible": visible,
            "part": _majority(tables, part, self.config.parts),
        }

    def terms(
        self, network: Callable, arrays: dict, *, device: torch.device | str = "cpu", share: Share = alone
    ) -> dict[str, Tensor]:
        outputs, targets = network(Batch.from_arrays(arrays, device)), Targets.from_arrays(arrays, device)
        return losses(outputs, targets, share=share, bone=self.bone, symmetry=self.symmetry)

    @torch.no_grad()
    def joints(self, network: Callable, arrays: dict, *, device: torch.device | str = "cpu") -> np.ndarray:
        return network(Batch.from_arrays(arrays, device)).joints().float().cpu().numpy()


def _majority(tables: VoxelPyramid, part: np.ndarray, parts: int) -> np.ndarray:
    """(B, N): the part most of a voxel's points are of; -1 where none is known and where there is no voxel."""
    shape = tables.fine.valid.shape
    told = (tables.point_voxel >= 0) & (part >= 0)
    votes = np.bincount(tables.point_voxel[told] * parts + part[told], minlength=shape[0] * shape[1] * parts)
    votes = votes.reshape(-1, parts)
    return np.where(votes.any(1), votes.argmax(1), -1).reshape(shape)
