"""`Batch`: a plan as tensors, and the targets that training adds. Tensors only."""

from dataclasses import dataclass

import numpy as np
import torch

from lidarpose.models.voxelize import Plan


@dataclass(frozen=True, kw_only=True)
class LevelTensors:
    """One level of `plan.Level` as tensors: position (B, N, 3), log_count (B, N), valid (B, N), parent (B, N), and
    neighbours (B, N, 27) where the network convolves."""

    position: torch.Tensor
    log_count: torch.Tensor
    valid: torch.Tensor
    parent: torch.Tensor
    neighbours: torch.Tensor | None = None


@dataclass(frozen=True, kw_only=True)
class Batch:
    """What the network reads; see `plan.Plan` for the shapes."""

    fine: LevelTensors
    mid: LevelTensors
    coarse: LevelTensors
    deviation: torch.Tensor
    offset: torch.Tensor
    view: torch.Tensor

    @classmethod
    def from_plan(cls, plan: Plan, device: torch.device | str = "cpu") -> "Batch":
        return cls.from_arrays(plan.arrays(), device)

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray], device: torch.device | str = "cpu") -> "Batch":
        def tensor(name: str) -> torch.Tensor:
            return torch.as_tensor(arrays[name]).to(device)

        def level(name: str) -> LevelTensors:
            return LevelTensors(
                position=tensor(f"{name}.position"),
                log_count=tensor(f"{name}.log_count"),
                valid=tensor(f"{name}.valid"),
                parent=tensor(f"{name}.parent"),
                neighbours=tensor(f"{name}.neighbours") if f"{name}.neighbours" in arrays else None,
            )

        return cls(
            fine=level("fine"),
            mid=level("mid"),
            coarse=level("coarse"),
            deviation=tensor("deviation"),
            offset=tensor("offset"),
            view=tensor("view"),
        )


@dataclass(frozen=True, kw_only=True)
class Targets:
    """What training compares with.

    joints (B, J, 3) m in the person's frame; known (B, J) bool: false where the truth is not known, for a dataset that
    labels some of the skeleton's joints; visible (B, J): 1 where some point lies near the joint, 0 where none does, NaN
    where that is not known, see `train.example.seen`; part (B, F) int64, the majority part of each fine voxel's points,
    -1 where padded or unknown.
    """

    joints: torch.Tensor
    known: torch.Tensor
    visible: torch.Tensor
    part: torch.Tensor

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray], device: torch.device | str = "cpu") -> "Targets":
        return cls(
            **{name: torch.as_tensor(arrays[name]).to(device) for name in ("joints", "known", "visible", "part")}
        )
