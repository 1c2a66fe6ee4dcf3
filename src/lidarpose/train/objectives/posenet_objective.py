"""`PoseNetObjective`: the losses of the package's own network.

Legend: B people, J joints, N fine voxels, W heatmap bins, P parts.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from lidarpose.models.config import BIN, NetworkConfig
from lidarpose.models.layers import encode
from lidarpose.models.posenet import Batch, Outputs, Targets
from lidarpose.models.voxelize import VoxelPyramid, voxelize
from lidarpose.sample import CONFIDENCE_RADIUS
from lidarpose.skeleton import BODY26
from lidarpose.train.augment import Example
from lidarpose.train.objectives.objective import BuiltNetwork, Share, at_least_one, majority_part, one_process

# maximum number of fine voxels per person in training
MAX_VOXELS = 224
# loss weights; distances are in meters, so a weight of 10 brings 10 cm to order one
VOTE, JOINTS, LEVEL, HEATMAP, PART, CONFIDENCE, SPREAD, VISIBLE = 10.0, 5.0, 2.0, 0.25, 0.25, 0.1, 0.05, 0.05
# weight of the person head, whose loss has no effect on the rest of the network
PERSON = 1.0
# width of the heatmap's target, m: 1.2 bins
SIGMA = 0.036
# bones as pairs (parent, child), and pairs of left and right bones
_BONES = torch.tensor(BODY26.bones)
_PAIRS = torch.tensor(
    [
        (k, BODY26.bones.index((BODY26.flip[a], BODY26.flip[b])))
        for k, (a, b) in enumerate(BODY26.bones)
        if BODY26.joints[b].startswith("left_") and (BODY26.flip[a], BODY26.flip[b]) in BODY26.bones
    ]
)


def training_voxels(
    clouds: list[np.ndarray], view: np.ndarray, seeds: np.ndarray, config: NetworkConfig
) -> VoxelPyramid:
    """The voxels of examples' clouds (n, 3) m, at most `MAX_VOXELS` fine ones each; view (B, 5); seeds (B,): for the
    random draws."""
    return voxelize(
        np.concatenate(clouds),
        np.array([len(cloud) for cloud in clouds]),
        grid=config.grid,
        max_voxels=MAX_VOXELS,
        view=view,
        seeds=seeds,
        neighbors=config.convolution > 0,
    )


@dataclass(frozen=True, kw_only=True)
class PoseNetObjective(BuiltNetwork):
    """The `Objective` of a `PoseNet` with this configuration. bone, symmetry: weights, see `losses`."""

    config: NetworkConfig
    bone: float = 0.0
    symmetry: float = 0.0

    def collate(self, examples: list[Example]) -> dict[str, np.ndarray]:
        """The arrays of a `VoxelPyramid`, and those of `Targets`."""
        clouds, view, seeds = ([getattr(e, name) for e in examples] for name in ("points", "view", "seed"))
        pyramid = training_voxels(clouds, np.stack(view), np.array(seeds), self.config)
        part = np.concatenate([e.part for e in examples]).astype(np.int64)
        valid = pyramid.fine.valid
        part = majority_part(pyramid.point_voxel, part, voxels=valid.size, parts=self.config.parts)
        joints = np.stack([e.joints for e in examples])
        return pyramid.arrays() | {
            "joints": joints,
            "known": ~np.isnan(joints).any(-1),
            "visible": np.stack([e.visible for e in examples]),
            "part": part.reshape(valid.shape),
            "person": np.stack([e.person for e in examples]),
        }

    def terms(
        self, network: Callable, arrays: dict, *, device: torch.device | str = "cpu", share: Share = one_process
    ) -> dict[str, Tensor]:
        outputs, targets = network(Batch.from_arrays(arrays, device)), Targets.from_arrays(arrays, device)
        return losses(outputs, targets, share=share, bone=self.bone, symmetry=self.symmetry)

    @torch.no_grad()
    def joints(self, network: Callable, arrays: dict, *, device: torch.device | str = "cpu") -> np.ndarray:
        return network(Batch.from_arrays(arrays, device)).joints().float().cpu().numpy()


def losses(
    outputs: Outputs, targets: Targets, *, share: Share = one_process, bone: float = 0.0, symmetry: float = 0.0
) -> dict[str, Tensor]:
    """Weighted loss terms by name; their sum is minimized. "mpjpe" (meters) is for the log only.

    Joint terms are means over labeled joints; share: see `objective`; bone, symmetry: weights of terms on the lengths
    of bones whose ends are labeled, and on the length difference of left and right bones, labeled or not. Paper: L_reg
    is here the mean distance of votes, of decoded joints and of the coarser levels' joints (the released code squares
    it); L_hm a cross entropy against normalized targets with equal weights of the axes; L_seg has background as a
    class.
    """
    is_labeled = targets.known.float()
    truth = torch.where(targets.known[..., None], targets.joints, 0.0)
    labels = at_least_one(share(is_labeled.sum()))
    # labeled joints whose visibility is known
    visibility = targets.visible.float()
    has_visibility = is_labeled * ~visibility.isnan()

    def over(value: Tensor, count: Tensor) -> Tensor:
        return value / at_least_one(share(count))

    def mean(value: Tensor) -> Tensor:
        return (value.float() * is_labeled).sum() / labels

    error = (outputs.joints().float() - truth).norm(dim=-1)
    distance = error.detach()
    is_hit = (distance < CONFIDENCE_RADIUS).to(truth.dtype)
    log_spread = outputs.log_spread.float()
    part = F.cross_entropy(outputs.part.float().flatten(0, 1), targets.part.flatten(), ignore_index=-1, reduction="sum")
    visible_loss = _binary(outputs.visible, visibility.nan_to_num(0.0))
    terms = {
        "joints": JOINTS * mean(error),
        "level": LEVEL * sum((mean((j.float() - truth).norm(dim=-1)) for j in outputs.level_joints), torch.zeros(())),
        "part": PART * over(part, (targets.part >= 0).sum().float()),
        "confidence": CONFIDENCE * mean(_binary(outputs.confidence, is_hit)),
        # negative log-likelihood of an exponential distribution; its mean, exp(log_spread), fits the expected distance
        "spread": SPREAD * mean(log_spread + distance * torch.exp(-log_spread)),
        "visible": VISIBLE * over((visible_loss * has_visibility).sum(), has_visibility.sum()),
        "mpjpe": mean(distance),
    }
    if outputs.has_votes:
        terms["vote"] = VOTE * mean((outputs.vote.float() - truth).norm(dim=-1))
    if outputs.person is not None:
        has_person_label = (~targets.person.isnan()).float()
        person_loss = _binary(outputs.person, targets.person.nan_to_num(0.0)) * has_person_label
        terms["person"] = PERSON * over(person_loss.sum(), has_person_label.sum())
    bins = outputs.heatmap.shape[-1]
    if bins:
        offset = truth - outputs.vote.detach().float()
        is_in_range = (offset.abs() < bins * BIN / 2).to(truth.dtype) * is_labeled[..., None]
        cross_entropy = -(encode(offset, SIGMA, bins) * outputs.heatmap.float().log_softmax(-1)).sum(-1)
        terms["heatmap"] = HEATMAP * (cross_entropy * is_in_range).sum() / at_least_one(share(is_in_range.sum()))
    if bone or symmetry:
        terms |= _lengths(outputs.joints().float(), truth, is_labeled, share, bone, symmetry)
    return terms


def _lengths(
    joints: Tensor, truth: Tensor, is_labeled: Tensor, share: Share, bone: float, symmetry: float
) -> dict[str, Tensor]:
    """Mean errors of bone lengths, and mean length differences between the two sides, weighted."""
    parent, child = _BONES.to(joints.device).unbind(1)
    length = (joints[:, parent] - joints[:, child]).norm(dim=-1)
    terms = {}
    if bone:
        has_length = is_labeled[:, parent] * is_labeled[:, child]
        length_error = (length - (truth[:, parent] - truth[:, child]).norm(dim=-1)).abs() * has_length
        terms["bone"] = bone * length_error.sum() / at_least_one(share(has_length.sum()))
    if symmetry:
        left, right = _PAIRS.to(joints.device).unbind(1)
        difference = (length[:, left] - length[:, right]).abs()
        terms["symmetry"] = symmetry * difference.sum() / at_least_one(share(torch.ones_like(difference).sum()))
    return terms


def _binary(logit: Tensor, truth: Tensor) -> Tensor:
    return F.binary_cross_entropy_with_logits(logit.float(), truth, reduction="none")
