"""What the baselines minimize, as their authors' code does; all weights are 1.

Legend: B people, N points, J joints, T frames.
"""

import torch
from torch import Tensor
from torch.nn import functional as F

from lidarpose.models.baselines.lidarcap import ClipOutputs, forward_kinematics
from lidarpose.models.baselines.lpformer import LpformerOutputs
from lidarpose.models.baselines.prn import PrnOutputs
from lidarpose.skeleton import SMPL24
from lidarpose.train.objectives.objective import Share, alone, at_least_one

# a point is labelled with the nearest joint within this distance, m
LABEL_RADIUS = 0.25


def point_labels(points: Tensor, valid: Tensor, joints: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """Labels (B, N): the number of the nearest joint with a label, J for background, -1 for padding; and the offsets
    (B, N, 3) m from the points to those joints.

    joints (B, J, 3) m, known (B, J).
    """
    distance = torch.cdist(points, joints).masked_fill(~known[:, None], torch.inf)
    nearest, joint = distance.min(-1)
    offsets = joints.gather(1, joint[..., None].expand(-1, -1, 3)) - points
    label = torch.where(nearest < LABEL_RADIUS, joint, joints.shape[1])
    return label.masked_fill(~valid, -1), offsets


def prn_losses(
    outputs: PrnOutputs, points: Tensor, valid: Tensor, joints: Tensor, known: Tensor, *, share: Share = alone
) -> dict[str, Tensor]:
    """Distances of refined and of voted joints, cross entropy of parts, distances of the points' offsets."""
    label, offset = point_labels(points, valid, joints, known)
    label, is_body = label[valid], label[valid] < joints.shape[1]
    missed = (outputs.offsets - offset[valid]).norm(dim=-1)[is_body]
    return {
        "joints": mean_distance(outputs.joints, joints, known, share),
        "vote": mean_distance(outputs.voted, joints, known, share),
        "part": _cross_entropy(outputs.parts, label, share),
        "offset": missed.sum() / at_least_one(share(is_body.sum())),
    }


def lpformer_losses(
    outputs: LpformerOutputs,
    points: Tensor,
    valid: Tensor,
    joints: Tensor,
    known: Tensor,
    *,
    second_softmax: bool = False,
    share: Share = alone,
) -> dict[str, Tensor]:
    """Distances of joints and cross entropy of parts. second_softmax: of probabilities instead of logits, as
    published."""
    label, _ = point_labels(points, valid, joints, known)
    parts = outputs.parts.softmax(-1) if second_softmax else outputs.parts
    return {
        # zero, of the head without a loss: processes that average gradients wait for all heads
        "joints": mean_distance(outputs.joints, joints, known, share) + 0 * outputs.visible.sum(),
        "part": _cross_entropy(parts[valid], label[valid], share),
    }


def clip_losses(outputs: ClipOutputs, rotations: Tensor, pelvis: Tensor, offsets: Tensor) -> dict[str, Tensor]:
    """LiDARCap's and NE's: mean square errors of rotations, of the joints that they lead to, and of the first stage's.

    rotations (B, T, 24, 3, 3), SMPL's; pelvis (B, T, 1, 3) m about the frame's center; offsets (24, 3) m: the skeleton
    at rest. Joints are of this one skeleton, prediction and truth alike, where the published code regresses them from
    posed vertices. The first stage's are about the frame's center, those of the rotations about the pelvis.
    """
    true = forward_kinematics(rotations, offsets, SMPL24.parents)
    posed = forward_kinematics(outputs.rotations, offsets, SMPL24.parents)
    return {
        "rotation": F.mse_loss(outputs.rotations, rotations),
        "joints": F.mse_loss(posed, true),
        "first": F.mse_loss(outputs.joints, pelvis + true),
    }


def mean_distance(joints: Tensor, true: Tensor, known: Tensor, share: Share = alone) -> Tensor:
    """m, over joints with a label."""
    distance = (joints - torch.where(known[..., None], true, 0.0)).norm(dim=-1)
    return (distance * known).sum() / at_least_one(share(known.sum()))


def _cross_entropy(logits: Tensor, label: Tensor, share: Share) -> Tensor:
    return F.cross_entropy(logits.float(), label, reduction="sum") / at_least_one(share(label.new_tensor(len(label))))
