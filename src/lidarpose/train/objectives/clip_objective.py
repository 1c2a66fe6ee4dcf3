"""`ClipObjective`: what the loop must know of the networks of clips, LiDARCap and NE.

Legend: B clips, T frames of each.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from lidarpose.geometry import axis_angle_to_matrix
from lidarpose.models.baselines.baseline_config import LidarcapConfig, pad_frames
from lidarpose.models.baselines.lidarcap import Clouds, rest_offsets
from lidarpose.models.checkpoint import build
from lidarpose.models.voxelize import WINDOW
from lidarpose.skeleton import BODY26, SMPL24
from lidarpose.train.augment import ClipExample
from lidarpose.train.objectives.baseline_losses import clip_losses, mean_distance
from lidarpose.train.objectives.objective import Share, alone, in_body26

_COLUMNS = BODY26.map_to(SMPL24)


@dataclass(frozen=True, kw_only=True)
class ClipObjective:
    """The `Objective` of a `Lidarcap` or `Ne` with this configuration."""

    config: LidarcapConfig

    def network(self) -> nn.Module:
        return build(self.config)

    def collate(self, examples: list[ClipExample]) -> dict[str, np.ndarray]:
        """Of each cloud NAME points (B, T, N, 3) m about the frames' centers and NAME_valid (B, T, N); joints
        (B, T, 24, 3) m about them, NaN without a label; rotations (B, T, 24, 3, 3), SMPL's."""
        shape = len(examples), len(examples[0].frames)
        arrays: dict[str, np.ndarray] = {}
        for number, name in enumerate(self.config.clouds):
            points, valid = pad_frames(
                [cloud for example in examples for cloud in example.clouds[name]],
                resample_with_replacement=self.config.resample_with_replacement,
                seeds=[frame.seed + number for example in examples for frame in example.frames],
                window=WINDOW if name == "person" else np.inf,
                most_points=self.config.most_points,
            )
            arrays |= {name: points.reshape(*shape, -1, 3), f"{name}_valid": valid.reshape(*shape, -1)}
        joints = np.stack([frame.joints[_COLUMNS] for example in examples for frame in example.frames])
        rotations = axis_angle_to_matrix(np.stack([example.rotations for example in examples])).astype(np.float32)
        return arrays | {"joints": joints.reshape(*shape, -1, 3), "rotations": rotations}

    def _clouds(self, arrays: dict, device: torch.device | str) -> Clouds:
        tensors = {name: torch.as_tensor(array).to(device) for name, array in arrays.items()}
        return {name: (tensors[name], tensors[f"{name}_valid"]) for name in self.config.clouds}

    def terms(
        self, network: Callable, arrays: dict, *, device: torch.device | str = "cpu", share: Share = alone
    ) -> dict[str, Tensor]:
        """`baseline_losses.clip_losses`; clips all have as many frames and joints, so means of processes are means of
        all."""
        outputs = network(self._clouds(arrays, device))
        joints, rotations = (torch.as_tensor(arrays[name]).to(device) for name in ("joints", "rotations"))
        known = joints.isfinite().all(-1)
        terms = clip_losses(outputs, rotations, joints[:, :, :1], rest_offsets().to(device))
        return terms | {"mpjpe": mean_distance(outputs.posed().detach(), joints, known)}

    @torch.no_grad()
    def joints(self, network: Callable, arrays: dict, *, device: torch.device | str = "cpu") -> np.ndarray:
        return in_body26(network(self._clouds(arrays, device)).posed().flatten(0, 1), _COLUMNS)
