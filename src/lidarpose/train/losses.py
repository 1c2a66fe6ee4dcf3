"""What training minimizes.

Legend: B people, J joints, N fine voxels, W heatmap bins, P parts.
"""

import torch
from torch import Tensor
from torch.nn import functional as F

from lidarpose.model.batch import Targets
from lidarpose.model.heads import Outputs, encode
from lidarpose.model.presets import BIN

# weights; distances are in metres, so a weight of 10 brings 10 cm to order one
VOTE, JOINTS, LEVEL, HEATMAP, PART, CONFIDENCE, SPREAD, VISIBLE = 10.0, 5.0, 2.0, 0.25, 0.25, 0.1, 0.05, 0.05
# width of the heatmap's target: 1.2 bins
SIGMA = 0.036
# an error under this counts as a hit for the confidence, metres
HIT = 0.1


def losses(outputs: Outputs, targets: Targets) -> dict[str, Tensor]:
    """Each term, weighted, by name; their sum is what is minimized. "mpjpe" (metres) is for the log alone.

    All are means over the joints whose truth is known. Paper: L_reg is here the mean distance of votes, of decoded
    joints and of the coarser levels' joints (the released code squares it); L_hm a cross entropy against normalized
    targets, axes alike; L_seg with background as a class.
    """
    known = targets.known.to(outputs.vote.dtype)
    true = torch.where(targets.known[..., None], targets.joints, 0.0)

    def mean(value: Tensor) -> Tensor:
        return (value * known).sum() / known.sum().clamp(min=1)

    error = (outputs.joints() - true).norm(dim=-1)
    missed = error.detach()
    hit = (missed < HIT).to(true.dtype)
    terms = {
        "joints": JOINTS * mean(error),
        "level": LEVEL * sum(mean((joint - true).norm(dim=-1)) for joint in outputs.level_joints),
        "part": PART * _part(outputs.part, targets.part),
        "confidence": CONFIDENCE * mean(_binary(outputs.confidence, hit)),
        # log-likelihood of an exponential law: its mean, exp(log_spread), becomes the expected distance
        "spread": SPREAD * mean(outputs.log_spread + missed * torch.exp(-outputs.log_spread)),
        "visible": VISIBLE * mean(_binary(outputs.visible, targets.visible.to(true.dtype))),
        "mpjpe": mean(missed),
    }
    if outputs.has_votes:
        terms["vote"] = VOTE * mean((outputs.vote - true).norm(dim=-1))
    bins = outputs.heatmap.shape[-1]
    if bins:
        offset = true - outputs.vote.detach()
        reached = (offset.abs() < bins * BIN / 2).to(true.dtype) * known[..., None]
        cross = -(encode(offset, SIGMA, bins) * outputs.heatmap.log_softmax(-1)).sum(-1)
        terms["heatmap"] = HEATMAP * (cross * reached).sum() / reached.sum().clamp(min=1)
    return terms


def _binary(logit: Tensor, truth: Tensor) -> Tensor:
    return F.binary_cross_entropy_with_logits(logit, truth, reduction="none")


def _part(logits: Tensor, part: Tensor) -> Tensor:
    """Cross entropy over the voxels whose part is known, 0 where none is."""
    total = F.cross_entropy(logits.flatten(0, 1), part.flatten(), ignore_index=-1, reduction="sum")
    return total / (part >= 0).sum().clamp(min=1)


def total(terms: dict[str, Tensor]) -> Tensor:
    """The sum of the weighted terms."""
    return torch.stack([value for name, value in terms.items() if name != "mpjpe"]).sum()
