"""`VerifierObjective`: trains a network that only tells whether a detection is a person, and whether it is mounted.

Legend: K detections of a batch of scans, G groups of them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarpose.models.config import NetworkConfig
from lidarpose.models.posenet import Batch
from lidarpose.train.detector.candidate_source import NOBODY
from lidarpose.train.detector.crop_source import CropExample
from lidarpose.train.objectives.detector_objective import average_precision, share_missed
from lidarpose.train.objectives.objective import BuiltNetwork, Share, at_least_one, one_process
from lidarpose.train.objectives.posenet_objective import training_voxels

# weight of the loss of "mounted": the person rides or sits in a wheelchair
MOUNTED = 0.5
# detections of similar size that are computed together: clouds are padded to the largest of their group
_GROUP = 32


@dataclass(frozen=True, kw_only=True)
class VerifierObjective(BuiltNetwork):
    """The objective of a `PoseNet` of which only `person` is used: the logits of a person and of a mounted one."""

    config: NetworkConfig

    def collate(self, examples: list[CropExample]) -> list[dict[str, np.ndarray]]:
        """G groups of the detections of all scans, sorted by size: the arrays of a `VoxelPyramid`, and "person" (K, 2)
        float32: whether the detection is a person, and a mounted one."""
        clouds = [cloud for example in examples for cloud in example.clouds]
        view = np.concatenate([example.view for example in examples])
        person = np.concatenate([example.person for example in examples]) != NOBODY
        mounted = np.concatenate([example.mounted for example in examples])
        labels = np.stack([person, mounted], 1).astype(np.float32)
        seeds = np.concatenate([example.seed + np.arange(example.size) for example in examples])
        if not clouds:
            # a cloud without label, so that a batch without detections has gradients, which are 0
            clouds, view, seeds = [np.zeros((1, 3), np.float32)], np.zeros((1, 5), np.float32), np.zeros(1, int)
        order = np.argsort([len(cloud) for cloud in clouds], kind="stable")
        groups = []
        for start in range(0, len(order), _GROUP):
            rows = order[start : start + _GROUP]
            pyramid = training_voxels([clouds[row] for row in rows], view[rows], seeds[rows], self.config)
            groups.append(pyramid.arrays() | {"person": labels[rows[: len(labels)]]})
        return groups

    def terms(
        self, network: Callable, arrays: list[dict], *, device: torch.device | str = "cpu", share: Share = one_process
    ) -> dict[str, Tensor]:
        """Cross entropy of "person" over the K detections, and of "mounted" over the people among them."""
        logits = torch.cat([self._logits(network, group, device) for group in arrays])
        labels = torch.cat([torch.as_tensor(group["person"]).to(device) for group in arrays])
        person, mounted = F.binary_cross_entropy_with_logits(logits, labels, reduction="none").unbind(1)
        is_person = labels[:, 0]
        return {
            "person": person.sum() / at_least_one(share(torch.ones_like(is_person).sum())),
            "mounted": MOUNTED * (mounted * is_person).sum() / at_least_one(share(is_person.sum())),
            "ap": average_precision(logits[:, 0].detach(), is_person > 0),
        }

    @torch.no_grad()
    def scores(self, network: Callable, example: CropExample, *, device: torch.device | str = "cpu") -> np.ndarray:
        """(K, 2) logits of the detections of a scan, in its order."""
        order = np.argsort([len(cloud) for cloud in example.clouds], kind="stable")
        logits = [self._logits(network, group, device).cpu().numpy() for group in self.collate([example])]
        return np.concatenate([*logits, np.zeros((0, 2))])[np.argsort(order)]

    def _logits(self, network: Callable, group: dict, device: torch.device | str) -> Tensor:
        return network(Batch.from_arrays(group, device)).person.float()[: len(group["person"])]


def missed_by_verifier(
    objective: VerifierObjective, network: nn.Module, examples: Sequence[CropExample], batch: int
) -> tuple[float, None]:
    """Percentage of the people among the detections that the verifier's score alone misses at
    `detector_objective.FALSE_PER_SCAN` false positives per scan. batch: not used."""
    device = next(network.parameters()).device
    logits = [objective.scores(network, example, device=device)[:, 0] for example in examples]
    people = [example.person for example in examples]
    return share_missed([(s, p, np.unique(p[p >= 0])) for s, p in zip(logits, people, strict=True)]), None
