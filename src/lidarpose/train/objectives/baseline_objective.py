"""`BaselineObjective`: what the loop must know of the baselines of single frames, PRN and LPFormer.

Legend: B people, J joints of the network.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from lidarpose.models.baselines.baseline_config import LpformerConfig, PrnConfig, pad_clouds
from lidarpose.models.checkpoint import build
from lidarpose.train.augment import Example
from lidarpose.train.objectives.baseline_losses import lpformer_losses, mean_distance, prn_losses
from lidarpose.train.objectives.objective import Share, alone, in_body26


@dataclass(frozen=True, kw_only=True)
class BaselineObjective:
    """The `Objective` of a `Prn` or `Lpformer` with this configuration. shift: largest step, m, by which a person is
    moved along x, y and z alike, after the middle of their extent was subtracted; LiDAR-HMR's is 0.2."""

    config: PrnConfig | LpformerConfig
    shift: float = 0.0

    def network(self) -> nn.Module:
        return build(self.config)

    def collate(self, examples: list[Example]) -> dict[str, np.ndarray]:
        """The arrays of `pad_clouds`; joints (B, J, 3) float32 m about the middle, NaN without a label; shift (B,)."""
        seeds = [example.seed for example in examples]
        arrays = pad_clouds(
            [example.points for example in examples],
            np.stack([example.view for example in examples]),
            resample_with_replacement=self.config.resample_with_replacement,
            seeds=seeds,
            most_points=self.config.most_points,
        )
        joints = np.stack([example.joints for example in examples])[:, self.config.columns]
        shift = [np.random.default_rng([seed, 1]).uniform(-self.shift, self.shift) for seed in seeds]
        return arrays | {"joints": joints - arrays["middle"][:, None], "shift": np.array(shift, np.float32)}

    def terms(
        self, network: Callable, arrays: dict, *, device: torch.device | str = "cpu", share: Share = alone
    ) -> dict[str, Tensor]:
        """`baseline_losses.prn_losses` or `lpformer_losses`, people moved by their shift; joints without a label teach
        nothing."""
        read = {name: torch.as_tensor(array).to(device) for name, array in arrays.items()}
        shift, valid = read["shift"][:, None, None], read["valid"]
        points = (read["points"] + shift).masked_fill(~valid[..., None], 0)
        known = read["joints"].isfinite().all(-1)
        joints = torch.where(known[..., None], read["joints"] + shift, 0)
        outputs = network(points, valid, read["center"])
        truth: tuple[Any, ...] = (points, valid, joints, known)
        if isinstance(self.config, PrnConfig):
            terms = prn_losses(outputs, *truth, share=share)
        else:
            terms = lpformer_losses(outputs, *truth, second_softmax=self.config.second_softmax, share=share)
        return terms | {"mpjpe": mean_distance(outputs.joints.detach(), joints, known, share)}

    @torch.no_grad()
    def joints(self, network: Callable, arrays: dict, *, device: torch.device | str = "cpu") -> np.ndarray:
        points, valid, center = (torch.as_tensor(arrays[name]).to(device) for name in ("points", "valid", "center"))
        own = in_body26(network(points, valid, center).joints, self.config.columns)
        return own + arrays["middle"][:, None]


@torch.no_grad()
def with_joints(trained: Any, config: PrnConfig | LpformerConfig) -> Any:
    """A network of a configuration with the weights of a trained one of its kind; of joints that the trained one lacks
    they are random."""
    network: Any = build(config)
    before = trained.config.joints
    state = trained.state_dict()
    # background is the last row where there is one
    rows = {name: row for row, name in enumerate((*before, ""))}
    pairs = [(k, rows[name]) for k, name in enumerate((*config.joints, "")) if name in rows]
    for name, value in network.state_dict().items():
        if not name.startswith(network.per_joint):
            value.copy_(state[name])
            continue
        own, other = zip(*(pair for pair in pairs if pair[0] < len(value)), strict=True)
        value[list(own)] = state[name][list(other)]
    return network
