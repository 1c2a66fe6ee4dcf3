"""Alternatives to training on more people: other losses and other selections of people, for `ablations.py`.

Legend: B people, J joints, N fine voxels, K voxels near a joint.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarpose.models import bundled_path
from lidarpose.models.checkpoint import load_checkpoint
from lidarpose.models.config import NetworkConfig
from lidarpose.models.layers import VoteHead
from lidarpose.models.posenet import Batch, Outputs, PoseNet, Targets
from lidarpose.skeleton import BODY26
from lidarpose.train.augment import FLIP_PART, Example
from lidarpose.train.objectives.baseline_objective import point_labels
from lidarpose.train.objectives.objective import Share, at_least_one, one_process
from lidarpose.train.objectives.posenet_objective import PoseNetObjective, losses

# number of voxels that refine a joint
NEAR = 16
# m: offsets of voxels from a joint are clipped to WIDEST; padding is farther than FAR
WIDEST, FAR = 2.0, 1e3
# weights of the losses of `PointJoints`, as for their counterparts in `posenet_objective`
LABEL, OFFSET = 0.25, 2.0
# weight of the distance between the poses of a person and of the person's mirror image
CONSISTENCY = 2.0
# share of a batch whose loss is averaged with the loss of the whole batch
HARDEST = 0.25
# terms of joints, for which a teacher's joints may replace the labels
_OF_JOINTS = ("joints", "level", "vote", "heatmap")
# prefix of the names of the mirror images' arrays
_IMAGE = "image."
_FLIP = list(BODY26.flip)
_ACROSS = np.array([1, -1, 1], np.float32)


@dataclass(frozen=True, kw_only=True)
class VariantObjective(PoseNetObjective):
    """`PoseNetObjective` for a network that may lack a component or have an additional one."""

    made: Callable[[NetworkConfig], nn.Module] = PoseNet

    def network(self) -> nn.Module:
        return self.made(self.config)


# ---- nearest joint of each point, and joints refined by nearby points


class LocalVoteHead(VoteHead):
    """A vote head with local refinement: each vote is moved by an offset predicted from the voxels nearest to it.

    Follows the refinement of PRN (LiDAR-HMR), whose points vote for their nearest joint.
    """

    def __init__(self, channels: int, voxel_channels: int, joints: int):
        super().__init__(channels, voxel_channels, joints)
        self.near_voxel = nn.Linear(voxel_channels, voxel_channels)
        self.near_place = nn.Linear(4, voxel_channels)
        self.near_anchor = nn.Linear(channels, voxel_channels)
        self.near_mix = nn.Sequential(nn.SiLU(), nn.Linear(voxel_channels, voxel_channels), nn.SiLU())
        self.near_score = nn.Linear(voxel_channels, 1)
        self.near_offset, self.near_feature = nn.Linear(voxel_channels, 3), nn.Linear(voxel_channels, voxel_channels)
        for layer in (self.near_offset, self.near_feature):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, anchors: Tensor, voxels: Tensor, position: Tensor, bias: Tensor) -> tuple[Tensor, Tensor]:
        vote, features = super().forward(anchors, voxels, position, bias)
        start = vote.detach()
        # the bias of padding makes its distance large
        distance, index = (torch.cdist(start, position) - bias[:, 0]).topk(min(NEAR, position.shape[1]), largest=False)
        people, n, _ = position.shape
        rows = (index + n * torch.arange(people, device=index.device)[:, None, None]).flatten()
        offset = position.flatten(0, 1)[rows].view(*index.shape, 3) - start[:, :, None]
        place = 10 * torch.cat([offset, distance[..., None]], -1).clamp(-WIDEST, WIDEST)
        voxel = self.near_voxel(voxels).flatten(0, 1)[rows].view(*index.shape, -1)
        hidden = self.near_mix(voxel + self.near_place(place) + self.near_anchor(anchors)[:, :, None])
        score = self.near_score(hidden).squeeze(-1).masked_fill(distance > FAR, -1e4)
        pooled = (score.softmax(-1)[..., None] * hidden).sum(-2)
        return vote + self.near_offset(pooled), features + self.near_feature(pooled)


def with_point_joints(config: NetworkConfig) -> PoseNet:
    """A network whose fine voxels also predict which joint is nearest to them, and the offset to it."""
    network = PoseNet(config)
    joints = len(network.skeleton)
    network.part = nn.Linear(config.channels[0], config.parts + joints + 1 + 3)
    return network


def with_local_refinement(config: NetworkConfig) -> PoseNet:
    """`with_point_joints`, with votes refined by nearby voxels."""
    network = with_point_joints(config)
    fine, mid, _ = config.channels
    network.vote = LocalVoteHead(mid, fine, len(network.skeleton))
    return network


@torch.no_grad()
def grown(network: PoseNet, made: Callable[[NetworkConfig], PoseNet]) -> PoseNet:
    """A network of one of the two kinds above with the weights of a trained network; new weights are random."""
    larger = made(network.config)
    state = larger.state_dict()
    for name, value in network.state_dict().items():
        # the parts are the first of each voxel's outputs
        state[name][: len(value)] = value
    larger.load_state_dict(state)
    return larger.train()


@dataclass(frozen=True, kw_only=True)
class PointJoints(VariantObjective):
    """Objective of networks `with_point_joints`, with additional losses: the cross entropy of each voxel's nearest
    joint and the error of the offset to it."""

    def terms(
        self, network: Callable, arrays: dict, *, device: torch.device | str = "cpu", share: Share = one_process
    ) -> dict[str, Tensor]:
        batch, targets = Batch.from_arrays(arrays, device), Targets.from_arrays(arrays, device)
        outputs = network(batch)
        count = outputs.vote.shape[1]
        part, label, offset = outputs.part.float().split([self.config.parts, count + 1, 3], -1)
        terms = losses(replace(outputs, part=part), targets, share=share)
        true = torch.where(targets.known[..., None], targets.joints, 0.0)
        nearest_joint, to_joint = point_labels(batch.fine.position, batch.fine.valid, true, targets.known)
        # voxels of objects near a joint get the class without a joint
        nearest_joint = nearest_joint.masked_fill((targets.part == 0) & batch.fine.valid, count).masked_fill(
            targets.part < 0, -1
        )
        label_entropy = F.cross_entropy(label.flatten(0, 1), nearest_joint.flatten(), ignore_index=-1, reduction="sum")
        is_body = (nearest_joint >= 0) & (nearest_joint < count)
        offset_error = ((offset - to_joint).norm(dim=-1) * is_body).sum()
        return terms | {
            "label": LABEL * label_entropy / at_least_one(share((nearest_joint >= 0).sum())),
            "offset": OFFSET * offset_error / at_least_one(share(is_body.sum())),
        }


# ---- hard examples


@dataclass(frozen=True, kw_only=True)
class HardestPeople(VariantObjective):
    """The mean of a batch's loss and the loss of the quarter of its people with the largest errors. Each of these
    people has five times the weight of another person."""

    def terms(
        self, network: Callable, arrays: dict, *, device: torch.device | str = "cpu", share: Share = one_process
    ) -> dict[str, Tensor]:
        outputs, targets = network(Batch.from_arrays(arrays, device)), Targets.from_arrays(arrays, device)
        person_error = (
            (outputs.joints().detach().float() - targets.joints).norm(dim=-1).where(targets.known, 0.0).sum(1)
        )
        hardest_rows = person_error.topk(max(round(HARDEST * len(person_error)), 1)).indices
        all_losses = losses(outputs, targets, share=share)
        hard_losses = losses(of_people(outputs, hardest_rows), of_people(targets, hardest_rows), share=share)
        terms = {name: (value + hard_losses[name]) / 2 for name, value in all_losses.items()}
        return terms | {"mpjpe": all_losses["mpjpe"]}


def of_people(tensors: Any, rows: Tensor) -> Any:
    """The `Outputs` or `Targets` of the given people of a batch."""

    def taken(value: Any) -> Any:
        if isinstance(value, tuple):
            return tuple(map(taken, value))
        return value[rows] if isinstance(value, Tensor) else value

    return replace(tensors, **{field.name: taken(getattr(tensors, field.name)) for field in fields(tensors)})


# ---- a person and their mirror image


@dataclass(frozen=True, kw_only=True)
class MirroredPairs(VariantObjective):
    """Every second person of a batch is replaced with the mirror image of the person before, and a loss pulls the two
    poses together. The number of people that pass through the network is unchanged."""

    def collate(self, examples: list[Example]) -> dict[str, np.ndarray]:
        originals = examples[::2]
        return super().collate([*originals, *map(mirrored, originals)])

    def terms(
        self, network: Callable, arrays: dict, *, device: torch.device | str = "cpu", share: Share = one_process
    ) -> dict[str, Tensor]:
        outputs, targets = network(Batch.from_arrays(arrays, device)), Targets.from_arrays(arrays, device)
        straight, image = outputs.joints().float().chunk(2)
        image = mirrored_joints(image)
        is_labeled = targets.known.float().chunk(2)[0]
        distance = ((straight - image).norm(dim=-1) * is_labeled).sum() / at_least_one(share(is_labeled.sum()))
        return losses(outputs, targets, share=share) | {"consistency": CONSISTENCY * distance}


def mirrored(example: Example) -> Example:
    """The person mirrored at the plane y = 0 of the person's frame."""
    return replace(
        example,
        points=example.points * _ACROSS,
        part=FLIP_PART[example.part + 1],
        joints=example.joints[_FLIP] * _ACROSS,
        visible=example.visible[_FLIP],
        view=example.view * np.array([1, -1, 1, 1, 1], np.float32),
    )


def mirrored_joints(joints: Tensor) -> Tensor:
    """joints (B, J, 3) m, mirrored at the same plane."""
    return joints[:, _FLIP] * torch.as_tensor(_ACROSS, device=joints.device)


# ---- a teacher


@dataclass(frozen=True, kw_only=True)
class Taught(VariantObjective):
    """Half of the weight of the losses on joints is for the joints of a bundled network, the mean of its predictions
    for the person and for the mirror image."""

    teacher: str = "small"

    def collate(self, examples: list[Example]) -> dict[str, np.ndarray]:
        config = _teacher(self.teacher).config
        assert config.grid == self.config.grid
        arrays = PoseNetObjective(config=config).collate(examples)
        image_arrays = PoseNetObjective(config=config).collate([mirrored(example) for example in examples])
        return arrays | {_IMAGE + name: value for name, value in image_arrays.items()}

    def terms(
        self, network: Callable, arrays: dict, *, device: torch.device | str = "cpu", share: Share = one_process
    ) -> dict[str, Tensor]:
        teacher, targets = _teacher(self.teacher).to(device), Targets.from_arrays(arrays, device)
        image_arrays = {name.removeprefix(_IMAGE): value for name, value in arrays.items() if name.startswith(_IMAGE)}
        batch = Batch.from_arrays(arrays, device)
        with torch.no_grad():
            teacher_answers = (
                teacher(batch).joints(),
                mirrored_joints(teacher(Batch.from_arrays(image_arrays, device)).joints()),
            )
            teacher_joints = (teacher_answers[0].float() + teacher_answers[1].float()) / 2
        outputs: Outputs = network(batch)
        terms = losses(outputs, targets, share=share)
        teacher_losses = losses(outputs, replace(targets, joints=teacher_joints), share=share)
        return terms | {name: (terms[name] + teacher_losses[name]) / 2 for name in _OF_JOINTS if name in terms}


@lru_cache(maxsize=1)
def _teacher(name: str) -> PoseNet:
    network = load_checkpoint(bundled_path(name))[0]
    assert isinstance(network, PoseNet)
    return network.eval().requires_grad_(False)
