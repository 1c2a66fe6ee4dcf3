"""LPFormer for crops, as LiDAR-HMR rebuilt it (Ye et al. 2024): a 3D convolutional network on occupancy, a transformer.

The original detects people in whole sweeps, and reads features of its detector; its code is not public.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarpose.models.baselines.baseline_config import LpformerConfig
from lidarpose.models.baselines.prn import BareAttention

# half the side of the occupancy grid, and the limit to which points are clamped when features are sampled, m
HALF, REACH = 1.0, 1.1


@dataclass(frozen=True, kw_only=True)
class LpformerOutputs:
    """joints (B, J, 3) m; visible (B, J, 2) logits; parts (B, N, J + 1) logits, the last one background."""

    joints: Tensor
    visible: Tensor
    parts: Tensor


class Lpformer(nn.Module):
    """4.81 M parameters."""

    # tensors with one row per joint, in order, and some with one more row for background
    per_joint = ("joint", "parts.3.")

    def __init__(self, config: LpformerConfig):
        super().__init__()
        self.config = config
        self.grid = config.grid
        joints, divisor = len(config.joints), config.width_divisor
        # twice as fast on CPUs as channels first if there are few channels
        self.volume = V2V(divisor).to(memory_format=torch.channels_last_3d)  # type: ignore[call-overload]
        widths = [6 + 32 // divisor, 1024 // divisor, 512 // divisor, 256 // divisor]
        self.token = nn.Sequential(*map(nn.Linear, widths, widths[1:]))
        width = widths[-1]
        self.joint = nn.Parameter(torch.randn(joints, width))
        dropout = config.attention_dropout
        self.attention = nn.ModuleList(BareAttention(width, heads=8, dropout=dropout) for _ in range(4))
        # no activation between the last two layers, as published
        self.xy, self.z, self.visible = (
            nn.Sequential(nn.Linear(width, 16), nn.ReLU(), nn.Linear(16, 8), nn.Linear(8, size)) for size in (2, 1, 2)
        )
        self.parts = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, 16), nn.Linear(16, joints + 1))

    def forward(self, points: Tensor, valid: Tensor, center: Tensor | None = None) -> LpformerOutputs:
        """points (B, N, 3) m relative to the middle of their extent, valid (B, N) bool; center (B, 3) m: the middle
        relative to the sensor, used with `sensor_position`, by default 0."""
        volume = self.volume(self.occupancy(points, valid))
        # grid_sample expects x as the last axis of the volume, and first in the positions
        place = points.clamp(-REACH, REACH)[:, :, None, None]
        local_features = F.grid_sample(volume, place, align_corners=False)[..., 0, 0].transpose(1, 2)
        absolute_points = points
        if self.config.sensor_position and center is not None:
            absolute_points = points + center[:, None]
        tokens = self.token(torch.cat([absolute_points, points, local_features], -1))
        joints = self.joint.expand(len(points), -1, -1)
        tokens = torch.cat([joints, tokens], 1)
        mask = torch.cat([valid.new_ones(joints.shape[:2]), valid], 1)
        for layer in self.attention:
            tokens = layer(tokens, mask)
        joint_tokens, point_tokens = tokens[:, : joints.shape[1]], tokens[:, joints.shape[1] :]
        return LpformerOutputs(
            joints=torch.cat([self.xy(joint_tokens), self.z(joint_tokens)], -1),
            visible=self.visible(joint_tokens),
            parts=self.parts(point_tokens),
        )

    def occupancy(self, points: Tensor, valid: Tensor) -> Tensor:
        """(B, 1, grid z, grid y, grid x): 1 for cells with points; points beyond the grid count in its border cells."""
        cell = ((points / HALF + 1) * 0.5 * self.grid).floor().long().clamp(0, self.grid - 1)
        person = torch.arange(len(points), device=points.device)[:, None].expand_as(valid)
        volume = points.new_zeros(len(points), 1, self.grid, self.grid, self.grid)
        x, y, z = cell[valid].unbind(1)
        volume[person[valid], 0, z, y, x] = 1
        return volume


class V2V(nn.Module):
    """Moon et al. 2018, two levels deep: occupancy (B, 1, G, G, G) -> 32 channels. 3.24 M parameters. divisor: see
    `LpformerConfig`."""

    def __init__(self, divisor: int = 1):
        super().__init__()
        stem, fine, middle, coarse = (width // divisor for width in (16, 32, 64, 128))
        self.stem = nn.Sequential(_conv(1, stem, 7), Residual(stem, fine))
        self.skips = nn.ModuleList([Residual(fine, fine), Residual(middle, middle)])
        self.down = nn.ModuleList([Residual(fine, middle), Residual(middle, coarse)])
        self.middle = nn.Sequential(Residual(coarse, coarse), Residual(coarse, coarse))
        self.up = nn.ModuleList([_up(middle, fine), _up(coarse, middle)])
        self.after = nn.ModuleList([nn.Identity(), Residual(middle, middle)])
        self.last = nn.Conv3d(fine, fine, 1)
        for module in self.modules():
            if isinstance(module, nn.Conv3d | nn.ConvTranspose3d):
                nn.init.normal_(module.weight, 0, 0.001)
                assert module.bias is not None
                nn.init.zeros_(module.bias)

    def forward(self, volume: Tensor) -> Tensor:
        x = self.stem(volume)
        skips = []
        for skip, down in zip(self.skips, self.down, strict=True):
            skips.append(skip(x))
            x = down(F.max_pool3d(x, 2))
        x = self.middle(x)
        for level in (1, 0):
            x = self.after[level](self.up[level](x) + skips[level])
        return self.last(x)


class Residual(nn.Module):
    def __init__(self, in_channels: int, out_channels: int):
        super().__init__()
        last_layers = [nn.Conv3d(out_channels, out_channels, 3, padding=1), nn.BatchNorm3d(out_channels)]
        self.branch = nn.Sequential(_conv(in_channels, out_channels, 3), *last_layers)
        self.skip: nn.Module = nn.Identity()
        if in_channels != out_channels:
            self.skip = nn.Sequential(nn.Conv3d(in_channels, out_channels, 1), nn.BatchNorm3d(out_channels))

    def forward(self, x: Tensor) -> Tensor:
        return (self.branch(x) + self.skip(x)).relu()


def _conv(in_channels: int, out_channels: int, size: int) -> nn.Sequential:
    conv = nn.Conv3d(in_channels, out_channels, size, padding=size // 2)
    return nn.Sequential(conv, nn.BatchNorm3d(out_channels), nn.ReLU())


def _up(in_channels: int, out_channels: int) -> nn.Sequential:
    conv = nn.ConvTranspose3d(in_channels, out_channels, 2, stride=2)
    return nn.Sequential(conv, nn.BatchNorm3d(out_channels), nn.ReLU())
