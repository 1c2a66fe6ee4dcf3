"""Training objectives and losses of the baselines, as in their authors' code; all loss weights are 1.

`BaselineObjective`: single-frame baselines, PRN and LPFormer; `ClipObjective`: clip baselines, LiDARCap and NE.
Legend: B people or clips, N points, J joints of the network, T frames of a clip.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from lidarpose.geometry import axis_angle_to_matrix
from lidarpose.models.baselines.baseline_config import LidarcapConfig, LpformerConfig, PrnConfig, pad_clouds, pad_frames
from lidarpose.models.baselines.lidarcap import ClipOutputs, Clouds, forward_kinematics, rest_offsets
from lidarpose.models.baselines.lpformer import LpformerOutputs
from lidarpose.models.baselines.prn import PrnOutputs
from lidarpose.models.checkpoint import build
from lidarpose.models.voxelize import WINDOW
from lidarpose.skeleton import BODY26, SMPL24
from lidarpose.train.augment import ClipExample, Example
from lidarpose.train.objectives.objective import BuiltNetwork, Share, at_least_one, in_body26, on_device, one_process

# a point is labeled with the nearest joint within this distance, m
LABEL_RADIUS = 0.25
_COLUMNS = BODY26.map_to(SMPL24)


@dataclass(frozen=True, kw_only=True)
class BaselineObjective(BuiltNetwork):
    """The `Objective` of a `Prn` or `Lpformer` with this configuration."""

    config: PrnConfig | LpformerConfig

    def collate(self, examples: list[Example]) -> dict[str, np.ndarray]:
        """The arrays of `pad_clouds`; joints (B, J, 3) float32 m about "middle", NaN if unlabeled; radius (B,) float32
        m within which points belong to a joint."""
        seeds = [example.seed for example in examples]
        view = np.stack([example.view for example in examples])
        arrays = pad_clouds([example.points for example in examples], view, self.config, seeds)
        joints = np.stack([example.joints for example in examples])[:, self.config.columns]
        scale = [example.scale if self.config.labels_before_scaling else 1.0 for example in examples]
        radius = LABEL_RADIUS * np.array(scale, np.float32)
        return arrays | {"joints": joints - arrays["middle"][:, None], "radius": radius}

    def terms(
        self, network: Callable, arrays: dict, *, device: torch.device | str = "cpu", share: Share = one_process
    ) -> dict[str, Tensor]:
        """`frame_losses`; unlabeled joints have no effect."""
        tensors = on_device(arrays, device)
        points, valid = tensors["points"], tensors["valid"]
        is_labeled = tensors["joints"].isfinite().all(-1)
        joints = torch.where(is_labeled[..., None], tensors["joints"], 0)
        outputs = network(points, valid, tensors["center"])
        labels = point_labels(points, valid, joints, is_labeled, tensors["radius"])
        terms = frame_losses(self.config, outputs, valid, joints, is_labeled, labels, share)
        return terms | {"mpjpe": mean_distance(outputs.joints.detach(), joints, is_labeled, share)}

    @torch.no_grad()
    def joints(self, network: Callable, arrays: dict, *, device: torch.device | str = "cpu") -> np.ndarray:
        points, valid, center = (torch.as_tensor(arrays[name]).to(device) for name in ("points", "valid", "center"))
        joints = in_body26(network(points, valid, center).joints, self.config.columns)
        return joints + arrays["middle"][:, None]


@dataclass(frozen=True, kw_only=True)
class ClipObjective(BuiltNetwork):
    """The `Objective` of a `Lidarcap` or `Ne` with this configuration."""

    config: LidarcapConfig

    def collate(self, examples: list[ClipExample]) -> dict[str, np.ndarray]:
        """For each cloud, NAME (B, T, N, 3): points in m about the frames' centers, and NAME_valid (B, T, N); joints
        (B, T, 24, 3) m about the same centers, NaN if unlabeled; rotations (B, T, 24, 3, 3), SMPL's."""
        shape = len(examples), len(examples[0].frames)
        arrays: dict[str, np.ndarray] = {}
        for number, name in enumerate(self.config.clouds):
            clouds = [cloud for example in examples for cloud in example.clouds[name]]
            seeds = [frame.seed + number for example in examples for frame in example.frames]
            window = WINDOW if name == "person" else np.inf
            points, valid = pad_frames(clouds, self.config, seeds, window=window)
            arrays |= {name: points.reshape(*shape, -1, 3), f"{name}_valid": valid.reshape(*shape, -1)}
        joints = np.stack([frame.joints[_COLUMNS] for example in examples for frame in example.frames])
        rotations = axis_angle_to_matrix(np.stack([example.rotations for example in examples])).astype(np.float32)
        return arrays | {"joints": joints.reshape(*shape, -1, 3), "rotations": rotations}

    def _clouds(self, arrays: dict, device: torch.device | str) -> Clouds:
        tensors = on_device(arrays, device)
        return {name: (tensors[name], tensors[f"{name}_valid"]) for name in self.config.clouds}

    def terms(
        self, network: Callable, arrays: dict, *, device: torch.device | str = "cpu", share: Share = one_process
    ) -> dict[str, Tensor]:
        """`clip_losses`; all clips have the same numbers of frames and joints, so the mean of the processes' means is
        the mean of all."""
        outputs = network(self._clouds(arrays, device))
        joints, rotations = (torch.as_tensor(arrays[name]).to(device) for name in ("joints", "rotations"))
        is_labeled = joints.isfinite().all(-1)
        terms = clip_losses(outputs, rotations, joints[:, :, :1], rest_offsets().to(device))
        return terms | {"mpjpe": mean_distance(outputs.posed().detach(), joints, is_labeled)}

    @torch.no_grad()
    def joints(self, network: Callable, arrays: dict, *, device: torch.device | str = "cpu") -> np.ndarray:
        return in_body26(network(self._clouds(arrays, device)).posed().flatten(0, 1), _COLUMNS)


# ---- losses


def point_labels(
    points: Tensor, valid: Tensor, joints: Tensor, known: Tensor, radius: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Labels (B, N): the index of the nearest labeled joint, J for background, -1 for padding and for points that may
    belong to a joint without a label; and the offsets (B, N, 3) m from the points to the nearest joints.

    joints (B, J, 3) m; known (B, J): whether a joint is labeled; radius (B,) m, None for `LABEL_RADIUS`.
    """
    bound = LABEL_RADIUS if radius is None else radius[:, None]
    distance = torch.cdist(points, joints).masked_fill(~known[:, None], torch.inf)
    nearest, joint = distance.min(-1)
    offsets = joints.gather(1, joint[..., None].expand(-1, -1, 3)) - points
    # where a joint has no label, background is unknown
    other = torch.where(known.all(1, keepdim=True), joints.shape[1], -1)
    label = torch.where(nearest < bound, joint, other)
    return label.masked_fill(~valid, -1), offsets


def frame_losses(
    config: PrnConfig | LpformerConfig,
    outputs: PrnOutputs | LpformerOutputs,
    valid: Tensor,
    joints: Tensor,
    known: Tensor,
    labels: tuple[Tensor, Tensor],
    share: Share,
) -> dict[str, Tensor]:
    """Distances of joints and cross entropy of parts; for PRN also errors of voted joints and of points' offsets.

    labels: see `point_labels`.
    """
    label, offset = labels
    label, distance = label[valid], mean_distance(outputs.joints, joints, known, share)
    if isinstance(outputs, LpformerOutputs):
        assert isinstance(config, LpformerConfig)
        if config.divide_by_all_joints:
            distance = distance * at_least_one(share(known.sum())) / share(torch.ones_like(known).sum())
        # with `second_softmax`, the cross entropy is of probabilities instead of logits, as published
        parts = (outputs.parts.softmax(-1) if config.second_softmax else outputs.parts)[valid]
        # adds zero times the head without a loss: gradient averaging across processes waits for all heads
        return {"joints": distance + 0 * outputs.visible.sum(), "part": _cross_entropy(parts, label, share)}
    is_body = (label >= 0) & (label < joints.shape[1])
    offset_error = (outputs.offsets - offset[valid]).norm(dim=-1)[is_body]
    return {
        "joints": distance,
        "vote": mean_distance(outputs.voted, joints, known, share),
        "part": _cross_entropy(outputs.parts, label, share),
        "offset": offset_error.sum() / at_least_one(share(is_body.sum())),
    }


def clip_losses(outputs: ClipOutputs, rotations: Tensor, pelvis: Tensor, offsets: Tensor) -> dict[str, Tensor]:
    """LiDARCap's and NE's losses: mean squared errors of rotations, of joints posed by them, and of first-stage joints.

    rotations (B, T, 24, 3, 3), SMPL's; pelvis (B, T, 1, 3) m about the frame's center; offsets (24, 3) m: the skeleton
    at rest. Joints of both prediction and truth are of this one skeleton; the published code regresses them from posed
    vertices. The first stage's joints are about the frame's center, posed joints about the pelvis.
    """
    true_joints = forward_kinematics(rotations, offsets, SMPL24.parents)
    posed_joints = forward_kinematics(outputs.rotations, offsets, SMPL24.parents)
    return {
        "rotation": F.mse_loss(outputs.rotations, rotations),
        "joints": F.mse_loss(posed_joints, true_joints),
        "first": F.mse_loss(outputs.joints, pelvis + true_joints),
    }


def mean_distance(joints: Tensor, true: Tensor, known: Tensor, share: Share = one_process) -> Tensor:
    """Mean distance in m over labeled joints."""
    distance = (joints - torch.where(known[..., None], true, 0.0)).norm(dim=-1)
    return (distance * known).sum() / at_least_one(share(known.sum()))


def _cross_entropy(logits: Tensor, label: Tensor, share: Share) -> Tensor:
    count = at_least_one(share((label >= 0).sum()))
    return F.cross_entropy(logits.float(), label, reduction="sum", ignore_index=-1) / count


# ---- initial weights


@torch.no_grad()
def with_joints(trained: Any, config: PrnConfig | LpformerConfig) -> Any:
    """A network of `config` with the weights of a trained network of the same kind; weights of joints that the trained
    one lacks are random."""
    network: Any = build(config)
    old_joints = trained.config.joints
    state = trained.state_dict()
    # the last row is background, if the parameter has one
    rows = {name: row for row, name in enumerate((*old_joints, ""))}
    pairs = [(k, rows[name]) for k, name in enumerate((*config.joints, "")) if name in rows]
    for name, value in network.state_dict().items():
        if not name.startswith(network.per_joint):
            value.copy_(state[name])
            continue
        new_rows, old_rows = zip(*(pair for pair in pairs if pair[0] < len(value)), strict=True)
        value[list(new_rows)] = state[name][list(old_rows)]
    return network
