"""The losses of the paper's network, equation by equation. All in float32, whatever precision the network uses.

Legend: B people, J joints of the network, M voxels of level 0, W heatmap bins, P parts.

The paper's hats denote the ground truth in Eq. 7 and the prediction in Eq. 8 and 10: a divergence of the prediction
from the truth would need the logarithm of labels that are zero. The released code reads them the same way. Where it
differs from the paper, `LOSS_FAULTS` of the configuration reproduce it.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from lidarpose.models.dapt.dapt_config import DaptConfig
from lidarpose.models.dapt.dapt_net import DaptOutputs
from lidarpose.train.objectives.objective import Share, at_least_one, one_process

# width of a heatmap's target, bins
SIGMA = 2.0
# lambda_reg and lambda_seg of the paper
REGRESSION, SEGMENTATION = 0.5, 1.0
# weight of the released code's auxiliary head, which the paper does not have
AUXILIARY = 0.2


@dataclass(frozen=True, kw_only=True)
class DaptTargets:
    """Targets of the losses.

    joints (B, J, 3) m in the network's order, finite even if unlabeled; weight (B, J): v_i of the paper, 1 if a joint
    is labeled, else 0; part (M,) int64, -1 if unknown, None if no loss needs parts.
    """

    joints: Tensor
    weight: Tensor
    part: Tensor | None = None


def pretraining(
    outputs: DaptOutputs, targets: DaptTargets, config: DaptConfig, *, share: Share = one_process
) -> dict[str, Tensor]:
    """Paper: Eq. 9, L_pre = lambda_reg L_reg + lambda_seg L_seg, for the coordinate head and the part head.

    Terms "regression" and "segmentation", and "mpjpe" of the coordinates for the log; share: see `objective`. The neck
    prn has these losses in both stages, with the term "vote" of its voted joints and weights of 1, which are ours; none
    are published.
    """
    coordinates, voted, parts, part = outputs.coordinates, outputs.voted, outputs.parts, targets.part
    assert coordinates is not None and parts is not None and part is not None
    if config.ignore_background:
        part = part.masked_fill(part == 0, -1)
    people, labels, voxels = _divisors(targets, share, (part >= 0).sum())
    regression = distance_loss(coordinates, targets, people, squared=config.squared_distance)
    terms = {"regression": REGRESSION * regression if voted is None else regression}
    if voted is not None:
        terms["vote"] = distance_loss(voted, targets, people, squared=config.squared_distance)
    return terms | {
        "segmentation": SEGMENTATION * segmentation_loss(parts.float(), part, voxels),
        "mpjpe": _mpjpe(coordinates.float(), targets, labels),
    }


def finetuning(
    outputs: DaptOutputs, targets: DaptTargets, config: DaptConfig, *, share: Share = one_process
) -> dict[str, Tensor]:
    """Paper: Eq. 10, L_ft = L_hm, for the heatmaps only; with `auxiliary_loss` also for the auxiliary head.

    Terms "heatmap" or "regression", "auxiliary", and "mpjpe" of the joints for the log; share: see `objective`.
    """
    people, labels = _divisors(targets, share)
    joints, squared = outputs.joints(), config.squared_distance
    if outputs.logits_x is None:
        terms = {"regression": distance_loss(joints, targets, people, squared=squared)}
    elif config.unnormalized_heatmaps:
        terms = {"heatmap": released_heatmap_loss(outputs, targets, labels)}
    else:
        terms = {"heatmap": heatmap_loss(outputs, targets, people)}
    if config.auxiliary_loss:
        assert outputs.inter is not None
        terms["auxiliary"] = AUXILIARY * distance_loss(outputs.inter, targets, people, squared=squared)
    return terms | {"mpjpe": _mpjpe(joints.float(), targets, labels)}


def distance_loss(joints: Tensor, targets: DaptTargets, people: Tensor, *, squared: bool = False) -> Tensor:
    """Paper: Eq. 7, sum_i ||J_i - J^_i||_2 v_i / sum_i v_i, averaged over people with a label.

    joints (B, J, 3) m; people: the number of people with a label; squared: m2, as in the released code.
    """
    difference, weight = joints.float() - targets.joints, targets.weight
    distance = difference.square().sum(-1) if squared else difference.norm(dim=-1)
    return ((distance * weight).sum(1) / at_least_one(weight.sum(1))).sum() / people


def segmentation_loss(logits: Tensor, part: Tensor, voxels: Tensor) -> Tensor:
    """Paper: Eq. 8, the cross entropy of P = K + 1 classes, including 0 = background, with one point per voxel.

    logits (M, P); part (M,), -1 if unknown; voxels: the number of voxels with a known part. The paper's sum over a
    cloud's points is a mean over `voxels` here, as in the released code, so that its weight does not depend on a
    person's number of points.
    """
    return F.cross_entropy(logits, part, ignore_index=-1, reduction="sum") / voxels


def heatmap_loss(outputs: DaptOutputs, targets: DaptTargets, people: Tensor) -> Tensor:
    """Paper: Eq. 10, sum over x, y, z and joints of D_KL(h || h^), averaged over people with a label.

    The sum is over labeled joints (the K + 1 of the paper's sum counts a joint that does not exist). people: the number
    of people with a label.
    """
    loss = torch.zeros((), device=people.device)
    for logits, place in _heatmaps(outputs, targets):
        log_truth = log_gaussian(place, logits.shape[-1])
        divergence = log_truth.exp() * (log_truth - logits.log_softmax(-1))
        loss = loss + (divergence.sum(-1) * targets.weight).sum()
    return loss / people


def released_heatmap_loss(outputs: DaptOutputs, targets: DaptTargets, labels: Tensor) -> Tensor:
    """The released code's loss of heatmaps: targets of peak 1 that do not sum to 1, averaged over bins and joints.

    So the weight of an axis falls with its number of bins, and that of a joint beyond the range fades. labels: the
    number of labeled joints.
    """
    loss = torch.zeros((), device=labels.device)
    for logits, place in _heatmaps(outputs, targets):
        truth = (-0.5 * _bins_from(place, logits.shape[-1]).square()).exp()
        divergence = F.kl_div(logits.log_softmax(-1), truth, reduction="none")
        loss = loss + (divergence.mean(-1) * targets.weight).sum()
    return loss / labels


def _heatmaps(outputs: DaptOutputs, targets: DaptTargets) -> Iterator[tuple[Tensor, Tensor]]:
    """Of each axis the logits (B, J, W) and the joints' true positions (B, J) in bins."""
    heatmaps = (outputs.logits_x, outputs.logits_y, outputs.logits_z)
    for k, (logits, low, step) in enumerate(zip(heatmaps, outputs.low, outputs.step, strict=True)):
        assert logits is not None
        yield logits.float(), (targets.joints[..., k] - low) / step


def log_gaussian(place: Tensor, bins: int) -> Tensor:
    """place (...) in bins -> (..., W): logarithm of a Gaussian centered on it, `SIGMA` bins wide, that sums to 1.

    A joint beyond the range is assigned to the outermost bin, where decoding reports it as out of range
    (`decode.out_of_range`).
    """
    return (-0.5 * _bins_from(place.clamp(0, bins - 1), bins).square()).log_softmax(-1)


def _bins_from(place: Tensor, bins: int) -> Tensor:
    """place (...) in bins -> (..., W): each bin's distance to it, in widths `SIGMA`."""
    return (torch.arange(bins, device=place.device) - place[..., None]) / SIGMA


def _mpjpe(joints: Tensor, targets: DaptTargets, labels: Tensor) -> Tensor:
    """Mean distance over labeled joints, m."""
    return ((joints.detach() - targets.joints).norm(dim=-1) * targets.weight).sum() / labels


def _divisors(targets: DaptTargets, share: Share, *extra_counts: Tensor) -> tuple[Tensor, ...]:
    """The number of people with a label, the number of labels, and extra counts, reduced by `share` in one call."""
    counts = ((targets.weight.sum(1) > 0).sum(), targets.weight.sum(), *extra_counts)
    return at_least_one(share(torch.stack([count.float() for count in counts]))).unbind()
