"""LiDARCap (Li et al. 2022): PointNet++ of each frame, a recurrent network for joints, a graph network for rotations.

A clip is 16 frames of 512 points; joints are those of SMPL, relative to each frame's center.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarpose.models.baselines.baseline_config import LidarcapConfig
from lidarpose.models.baselines.point_ops import ball_query, farthest_points, gather_points
from lidarpose.skeleton import SMPL24

# inputs of the networks of clips, by the name of the cloud: for each frame points (..., N, 3) m relative to its center,
# and valid (..., N) bool, at least one per frame
Clouds = dict[str, tuple[Tensor, Tensor]]
FEATURES = 1024
# offsets x, y, z of the joints from their parents, of the package's mean adult at rest, in SMPL's frame and order, m
_REST_OFFSETS = (
    (0, 0, 0), (0.075, -0.095, 0), (-0.075, -0.095, 0), (0, 0.1008, -0.0365), (0.0239, -0.3892, 0.0086),
    (-0.0239, -0.3892, 0.0086), (0, 0.1296, -0.0081), (0, -0.409, -0.0301), (0, -0.409, -0.0301), (0, 0.048, -0.0037),
    (0, -0.0511, 0.145), (0, -0.0511, 0.145), (0, 0.2015, 0.0388), (0.074, 0.1365, 0.0539), (-0.074, 0.1365, 0.0539),
    (0.0007, 0.0848, 0.0225), (0.111, -0.0316, -0.0051), (-0.111, -0.0316, -0.0051), (0.2513, 0, 0), (-0.2513, 0, 0),
    (0.2309, 0, 0), (-0.2308, 0, 0), (0.1054, 0, 0), (-0.1054, 0, 0),
)  # fmt: skip
# size of the graph convolutions' kernel in time, frames
TIME_KERNEL = 5


@dataclass(frozen=True, kw_only=True)
class ClipOutputs:
    """Of B clips of T frames: joints (B, T, 24, 3) m of the first stage; rotations (B, T, 24, 3, 3) of SMPL, each joint
    relative to its parent, the pelvis relative to the world."""

    joints: Tensor
    rotations: Tensor

    def posed(self) -> Tensor:
        """(B, T, 24, 3) m: the mean adult with these rotations, and with the first stage's pelvis."""
        offsets = rest_offsets().to(self.joints)
        return self.joints[:, :, :1] + forward_kinematics(self.rotations, offsets, SMPL24.parents)


class Lidarcap(nn.Module):
    """34.9 M parameters."""

    # tensors with one row per joint: none, since joints are always SMPL's
    per_joint = ()

    def __init__(self, config: LidarcapConfig):
        super().__init__()
        self.config = config
        divisor = config.width_divisor
        width = FEATURES // divisor
        self.encoder = PointNet2(width, divisor, as_published=config.order_dependent_neighbors)
        self.embed = nn.Linear(width, width)
        self.recurrent = nn.GRU(width, width, num_layers=2, batch_first=True, bidirectional=True)
        self.joints = nn.Linear(2 * width, 3 * len(SMPL24))
        self.rotations = StGcn(3 + width, divisor, stock_initialization=config.stock_initialization)

    def forward(self, clouds: Clouds) -> ClipOutputs:
        """clouds: of B clips of T frames each."""
        return self.decode(by_frame(self.encode, clouds))

    def encode(self, clouds: Clouds) -> dict[str, Tensor]:
        """Features (F, C) of F frames, each frame on its own."""
        return {"person": self.encoder(*clouds["person"])}

    def decode(self, encoded: dict[str, Tensor]) -> ClipOutputs:
        """encoded (B, T, C)."""
        features = encoded["person"]
        hidden = F.dropout(self.embed(features), 0.5, self.training).relu()
        joints = self.joints(self.recurrent(hidden)[0]).unflatten(-1, (-1, 3))
        return ClipOutputs(joints=joints, rotations=self.rotations(joints, features))


def by_frame(encode: Callable[[Clouds], dict[str, Tensor]], clouds: Clouds) -> dict[str, Tensor]:
    """Features (B, T, C) of the frames of clips, from a function that encodes frames."""
    shape = clouds["person"][0].shape[:2]
    features = encode({name: (points.flatten(0, 1), valid.flatten(0, 1)) for name, (points, valid) in clouds.items()})
    return {name: value.unflatten(0, shape) for name, value in features.items()}


class PointNet2(nn.Module):
    """PointNet++ on coordinates alone: points (B, N, 3), valid (B, N) -> (B, C); divisor: see `LidarcapConfig`."""

    def __init__(self, channels: int, divisor: int = 1, *, as_published: bool = False):
        super().__init__()
        a, b, c, d = (width // divisor for width in (64, 128, 256, 512))
        self.local = nn.ModuleList(
            [
                SetAbstraction(256, 0.2, (3, a, a, b), as_published=as_published),
                SetAbstraction(128, 0.4, (3 + b, b, b, c), as_published=as_published),
            ]
        )
        self.all = _perceptron((3 + c, c, d, channels))

    def forward(self, points: Tensor, valid: Tensor) -> Tensor:
        features = points[..., :0]
        for layer in self.local:
            points, valid, features = layer(points, valid, features)
        rows = torch.cat([points, features], -1)
        values = self.all(rows[valid])
        lowest = values.new_full((*valid.shape, values.shape[-1]), -torch.inf)
        return lowest.masked_scatter(valid[..., None], values).amax(1)


class SetAbstraction(nn.Module):
    """Features of centers from at most 32 points within a radius (m) of each."""

    def __init__(self, centers: int, radius: float, channels: tuple[int, ...], *, as_published: bool = False):
        super().__init__()
        self.centers, self.radius, self.as_published = centers, radius, as_published
        self.layers = _perceptron(channels)

    def forward(self, points: Tensor, valid: Tensor, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        count = self.centers if self.as_published else min(self.centers, points.shape[1])
        center_index = farthest_points(points, valid, count, as_published=self.as_published)
        centers = gather_points(points, center_index)
        index = ball_query(centers, points, valid, self.radius, 32, as_published=self.as_published)
        offsets = gather_points(points, index) - centers[:, :, None]
        rows = torch.cat([offsets, gather_points(features, index)], -1)
        is_center = torch.ones_like(center_index, dtype=torch.bool)
        if not self.as_published:
            # a small cloud repeats a center, or has copies of a point, of which a large batch would choose one; copies
            # would count in the statistics of batch norms, and displace other neighbors in the next layer
            x, y, z = (axis[:, :, None] == axis[:, None] for axis in centers.unbind(-1))
            is_center = ~(x & y & z).tril(-1).any(2)
        values = self.layers(rows[is_center].flatten(0, 1)).unflatten(0, (-1, rows.shape[2])).amax(1)
        center_features = values.new_zeros((*is_center.shape, values.shape[-1]))
        return centers, is_center, center_features.masked_scatter(is_center[..., None], values)


class StGcn(nn.Module):
    """Spatial and temporal graph convolutions over SMPL's tree -> a rotation of each joint in each frame."""

    def __init__(self, channels: int, divisor: int, *, stock_initialization: bool = False):
        super().__init__()
        self.norm = nn.BatchNorm1d(channels * len(SMPL24))
        widths = (channels, 256 // divisor, 128 // divisor, 64 // divisor)
        self.layers = nn.ModuleList(GraphLayer(widths[k], widths[k + 1], first=k == 0) for k in range(len(widths) - 1))
        self.output = nn.Conv2d(widths[-1], 6, 1)
        if not stock_initialization:
            # start near the identity, as most joints are near it: from elsewhere, training takes several times as long
            self.output.bias = nn.Parameter(torch.eye(3)[:, :2].flatten())

    def forward(self, joints: Tensor, features: Tensor) -> Tensor:
        """joints (B, T, J, 3), features (B, T, C) -> (B, T, J, 3, 3)."""
        joint_count = joints.shape[2]
        x = torch.cat([joints, features[:, :, None].expand(-1, -1, joint_count, -1)], -1)
        # the norm's channels are the joints' channels, joint by joint
        x = self.norm(x.flatten(2).transpose(1, 2)).unflatten(1, (joint_count, -1)).permute(0, 2, 3, 1)
        for layer in self.layers:
            x = layer(x)
        return rotations_from_6d(self.output(x).permute(0, 2, 3, 1))


class GraphLayer(nn.Module):
    """(B, C, T, J) -> (B, C', T, J). first: without dropout and without residual."""

    def __init__(self, in_channels: int, out_channels: int, *, first: bool):
        super().__init__()
        graph = tree_partition(SMPL24.parents)
        self.graph: Tensor
        self.register_buffer("graph", graph, persistent=False)
        self.edge = nn.Parameter(torch.ones_like(graph))
        self.space = nn.Conv2d(in_channels, len(graph) * out_channels, 1)
        self.time = nn.Sequential(
            nn.BatchNorm2d(out_channels),
            nn.ReLU(),
            nn.Conv2d(out_channels, out_channels, (TIME_KERNEL, 1), padding=(TIME_KERNEL // 2, 0)),
            nn.BatchNorm2d(out_channels),
            nn.Dropout(0.0 if first else 0.5),
        )
        self.residual = (
            None if first else nn.Sequential(nn.Conv2d(in_channels, out_channels, 1), nn.BatchNorm2d(out_channels))
        )

    def forward(self, x: Tensor) -> Tensor:
        features = self.space(x).unflatten(1, (len(self.graph), -1))
        y = self.time(torch.einsum("bkctv,kvw->bctw", features, self.graph * self.edge))
        return (y if self.residual is None else y + self.residual(x)).relu()


def tree_partition(parents: tuple[int, ...]) -> Tensor:
    """(3, J, J) weights from joint v to joint w, by kind of v: w itself; neighbors as far from the root or farther;
    neighbors nearer to it. Each column is divided by the joint's number of neighbors, including itself."""
    joints = len(parents)
    depth = [0] * joints
    weights = torch.zeros(3, joints, joints)
    weights[0] = torch.eye(joints)
    for joint, parent in enumerate(parents):
        if parent >= 0:
            depth[joint] = depth[parent] + 1
            weights[1, joint, parent] = 1
            weights[2, parent, joint] = 1
    return weights / weights.sum((0, 1))


def rotations_from_6d(numbers: Tensor) -> Tensor:
    """(..., 6), a 3x2 matrix row by row -> (..., 3, 3): its columns, orthonormalized, and their cross product."""
    first, second = numbers.unflatten(-1, (3, 2)).unbind(-1)
    x = F.normalize(first, dim=-1)
    y = F.normalize(second - (x * second).sum(-1, keepdim=True) * x, dim=-1)
    return torch.stack([x, y, torch.linalg.cross(x, y)], -1)


def rest_offsets() -> Tensor:
    """(24, 3) m: the mean adult's joints from their parents at rest, in SMPL's frame."""
    return torch.tensor(_REST_OFFSETS)


def forward_kinematics(rotations: Tensor, offsets: Tensor, parents: tuple[int, ...]) -> Tensor:
    """rotations (..., J, 3, 3), offsets (J, 3) m of each joint from its parent at rest -> joints (..., J, 3) m,
    relative to the first one."""
    world_rotations: list[Tensor] = []
    joints: list[Tensor] = []
    for joint, parent in enumerate(parents):
        rotation = rotations[..., joint, :, :]
        if parent < 0:
            world_rotations.append(rotation)
            joints.append(torch.zeros_like(rotation[..., 0]))
        else:
            joints.append(joints[parent] + world_rotations[parent] @ offsets[joint])
            world_rotations.append(world_rotations[parent] @ rotation)
    return torch.stack(joints, -2)


def _perceptron(channels: tuple[int, ...]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for in_channels, out_channels in zip(channels, channels[1:], strict=False):
        layers += [nn.Linear(in_channels, out_channels, bias=False), nn.BatchNorm1d(out_channels), nn.ReLU()]
    return nn.Sequential(*layers)
