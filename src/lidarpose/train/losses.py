"""What training minimizes.

Legend: B people, J joints, N fine voxels, W heatmap bins, P parts.
"""

import torch
from torch import Tensor
from torch.nn import functional as F

from lidarpose.models.config import BIN
from lidarpose.models.layers import encode
from lidarpose.models.posenet import Outputs, Targets
from lidarpose.sample import CONFIDENCE_RADIUS
from lidarpose.skeleton import BODY26
from lidarpose.train.objective import Share, alone

# weights; distances are in metres, so a weight of 10 brings 10 cm to order one
VOTE, JOINTS, LEVEL, HEATMAP, PART, CONFIDENCE, SPREAD, VISIBLE = 10.0, 5.0, 2.0, 0.25, 0.25, 0.1, 0.05, 0.05
# width of the heatmap's target: 1.2 bins
SIGMA = 0.036


# bones as pairs (parent, child), and pairs of bones that mirror each other
_BONES = torch.tensor(BODY26.bones)
_PAIRS = torch.tensor(
    [
        (k, BODY26.bones.index((BODY26.flip[a], BODY26.flip[b])))
        for k, (a, b) in enumerate(BODY26.bones)
        if BODY26.joints[b].startswith("left_") and (BODY26.flip[a], BODY26.flip[b]) in BODY26.bones
    ]
)


def losses(
    outputs: Outputs, targets: Targets, *, share: Share = alone, bone: float = 0.0, symmetry: float = 0.0
) -> dict[str, Tensor]:
    """Each term, weighted, by name; their sum is what is minimized. "mpjpe" (metres) is for the log alone.

    All are means over the joints whose truth is known; share: see `task`; bone, symmetry: weights of terms on the
    lengths of bones whose ends are known, and on the difference of left and right ones, known or not. Paper: L_reg is
    here the mean distance of votes, of decoded joints and of the coarser levels' joints (the released code squares it);
    L_hm a cross entropy against normalized targets, axes alike; L_seg with background as a class.
    """
    known = targets.known.float()
    true = torch.where(targets.known[..., None], targets.joints, 0.0)
    labels = _at_least_one(share(known.sum()))

    def mean(value: Tensor) -> Tensor:
        return (value.float() * known).sum() / labels

    error = (outputs.joints().float() - true).norm(dim=-1)
    missed = error.detach()
    hit = (missed < CONFIDENCE_RADIUS).to(true.dtype)
    log_spread = outputs.log_spread.float()
    terms = {
        "joints": JOINTS * mean(error),
        "level": LEVEL * sum(mean((joint.float() - true).norm(dim=-1)) for joint in outputs.level_joints),
        "part": PART * _part(outputs.part, targets.part, share),
        "confidence": CONFIDENCE * mean(_binary(outputs.confidence, hit)),
        # log-likelihood of an exponential law: its mean, exp(log_spread), becomes the expected distance
        "spread": SPREAD * mean(log_spread + missed * torch.exp(-log_spread)),
        "visible": VISIBLE * _visible(outputs.visible, targets.visible.float(), known, share),
        "mpjpe": mean(missed),
    }
    if outputs.has_votes:
        terms["vote"] = VOTE * mean((outputs.vote.float() - true).norm(dim=-1))
    bins = outputs.heatmap.shape[-1]
    if bins:
        offset = true - outputs.vote.detach().float()
        reached = (offset.abs() < bins * BIN / 2).to(true.dtype) * known[..., None]
        cross = -(encode(offset, SIGMA, bins) * outputs.heatmap.float().log_softmax(-1)).sum(-1)
        terms["heatmap"] = HEATMAP * (cross * reached).sum() / _at_least_one(share(reached.sum()))
    if bone or symmetry:
        terms |= _lengths(outputs.joints().float(), true, known, share, bone, symmetry)
    return terms


def _lengths(
    joints: Tensor, true: Tensor, known: Tensor, share: Share, bone: float, symmetry: float
) -> dict[str, Tensor]:
    """Mean errors of bones' lengths, and mean differences between the two sides."""
    parent, child = _BONES.to(joints.device).unbind(1)
    length = (joints[:, parent] - joints[:, child]).norm(dim=-1)
    terms = {}
    if bone:
        both = known[:, parent] * known[:, child]
        missed = (length - (true[:, parent] - true[:, child]).norm(dim=-1)).abs() * both
        terms["bone"] = bone * missed.sum() / _at_least_one(share(both.sum()))
    if symmetry:
        left, right = _PAIRS.to(joints.device).unbind(1)
        uneven = (length[:, left] - length[:, right]).abs()
        terms["symmetry"] = symmetry * uneven.sum() / _at_least_one(share(torch.ones_like(uneven).sum()))
    return terms


def _at_least_one(count: Tensor) -> Tensor:
    """What a sum over nobody is divided by."""
    return torch.where(count > 0, count, torch.ones_like(count))


def _visible(logit: Tensor, visible: Tensor, known: Tensor, share: Share) -> Tensor:
    """Over labelled joints of which it is known whether they are seen."""
    told = known * ~visible.isnan()
    value = _binary(logit, visible.nan_to_num(0.0)) * told
    return value.sum() / _at_least_one(share(told.sum()))


def _binary(logit: Tensor, truth: Tensor) -> Tensor:
    return F.binary_cross_entropy_with_logits(logit.float(), truth, reduction="none")


def _part(logits: Tensor, part: Tensor, share: Share) -> Tensor:
    """Cross entropy over the voxels whose part is known, 0 where none is."""
    total = F.cross_entropy(logits.float().flatten(0, 1), part.flatten(), ignore_index=-1, reduction="sum")
    return total / _at_least_one(share((part >= 0).sum().float()))
