"""What training minimizes.

Legend: B people, J joints, N fine voxels, W heatmap bins, P parts.
"""

import torch
from torch import Tensor
from torch.nn import functional as F

from lidarpose.model.batch import Targets
from lidarpose.model.heads import WINDOW, Outputs, encode

# weights; distances are in metres, so a weight of 10 brings 10 cm to order one
VOTE, JOINTS, LEVEL, HEATMAP, PART, CONFIDENCE, SPREAD = 10.0, 5.0, 2.0, 0.25, 0.25, 0.1, 0.05
# width of the heatmap's target: 1.2 bins
SIGMA = 0.036
# an error under this counts as a hit for the confidence, metres
HIT = 0.1


def losses(outputs: Outputs, targets: Targets) -> dict[str, Tensor]:
    """Each term, weighted, by name; their sum is what is minimized. "mpjpe" (metres) is for the log alone.

    Paper: L_reg is here the mean distance of votes, of decoded joints and of the coarser levels' joints (the released
    code squares it); L_hm a cross entropy against normalized targets, axes alike; L_seg with background as a class.
    """
    true = targets.joints
    joints = outputs.joints()
    error = (joints - true).norm(dim=-1)
    offset = true - outputs.vote.detach()
    reached = (offset.abs() < WINDOW).to(true.dtype)
    cross = -(encode(offset, SIGMA) * outputs.heatmap.log_softmax(-1)).sum(-1)
    missed = error.detach()
    hit = (missed < HIT).to(true.dtype)
    level = sum((joint - true).norm(dim=-1).mean() for joint in outputs.level_joints)
    return {
        "vote": VOTE * (outputs.vote - true).norm(dim=-1).mean(),
        "joints": JOINTS * error.mean(),
        "level": LEVEL * level,
        "heatmap": HEATMAP * (cross * reached).sum() / reached.sum().clamp(min=1),
        "part": PART * F.cross_entropy(outputs.part.flatten(0, 1), targets.part.flatten(), ignore_index=-1),
        "confidence": CONFIDENCE * F.binary_cross_entropy_with_logits(outputs.confidence, hit),
        # log-likelihood of an exponential law: its mean, exp(log_spread), becomes the expected distance
        "spread": SPREAD * (outputs.log_spread + missed * torch.exp(-outputs.log_spread)).mean(),
        "mpjpe": missed.mean(),
    }


def total(terms: dict[str, Tensor]) -> Tensor:
    """The sum of the weighted terms."""
    return torch.stack([value for name, value in terms.items() if name != "mpjpe"]).sum()
