"""NE (Zhang et al., "Neighborhood-Enhanced 3D Human Pose Estimation with Monocular LiDAR", AAAI 2024).

Like LiDARCap, with two further clouds per frame: the static background behind the person, and the frame's other points
around the person. Attention exchanges information among the three.
"""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarpose.models.baselines.baseline_config import CLOUDS, NeConfig
from lidarpose.models.baselines.lidarcap import (
    ClipOutputs,
    Clouds,
    PointNet2,
    StGcn,
    by_frame,
    forward_kinematics,
    rest_offsets,
)
from lidarpose.models.layers import DropPath
from lidarpose.sample import CLIP_FRAMES
from lidarpose.skeleton import SMPL24

WIDTH, HIDDEN, LAYERS = 512, 1024, 8


class Ne(nn.Module):
    """129.7 M parameters."""

    # tensors with one row per joint: none, since joints are always SMPL's
    per_joint = ()

    def __init__(self, config: NeConfig):
        super().__init__()
        self.config = config
        as_published = config.order_dependent_neighbors
        divisor = config.width_divisor
        width, hidden = WIDTH // divisor, HIDDEN // divisor
        self.encoders = nn.ModuleDict({name: PointNet2(width, divisor, as_published=as_published) for name in CLOUDS})
        stock_initialization = config.stock_initialization
        self.neighbors = _transformer(width, hidden, stock_initialization=stock_initialization)
        self.exchange = CloudExchange(width, hidden)
        self.norm = nn.LayerNorm(3 * width, eps=1e-6)
        self.clip = _transformer(3 * width, hidden, stock_initialization=stock_initialization)
        self.joints = nn.Linear(3 * width, 3 * len(SMPL24))
        self.shrink = nn.Linear(3 * width, hidden, bias=False)
        # its channels are the frames: clips have 16
        self.frame_norm = nn.BatchNorm1d(CLIP_FRAMES)
        self.widen = nn.Linear(hidden, hidden)
        self.rotations = StGcn(3 + hidden, divisor, stock_initialization=stock_initialization)
        if not stock_initialization:
            # joints start near those of a standing person: from elsewhere, the first training steps would be the same
            # for all frames, and would make the outputs of all frames equal
            nn.init.constant_(self.clip.layers[-1].norm2.weight, 0.1)
            self.joints.bias = nn.Parameter(_heights())

    def forward(self, clouds: Clouds) -> ClipOutputs:
        """clouds: each of `CLOUDS`, of B clips of 16 frames each."""
        return self.decode(by_frame(self.encode, clouds))

    def encode(self, clouds: Clouds) -> dict[str, Tensor]:
        """Features (F, C) of each cloud of F frames, each frame on its own."""
        return {name: self.encoders[name](*clouds[name]) for name in CLOUDS}

    def decode(self, features: dict[str, Tensor]) -> ClipOutputs:
        """features (B, 16, C)."""
        all_features = torch.cat([features[name] for name in CLOUDS], -1)
        person, background = features["person"], features["background"]
        neighbors = self.neighbors(features["neighbors"])
        if self.config.exchange_across_batch:
            context = self.exchange(*(x.transpose(0, 1) for x in (person, background, neighbors))).transpose(0, 1)
        else:
            context = self.exchange(person, background, neighbors)
        joints = self.joints(self.clip(self.norm(context))).unflatten(-1, (-1, 3))
        hidden = F.dropout(self.frame_norm(self.shrink(all_features)).relu(), 0.5, self.training)
        return ClipOutputs(joints=joints, rotations=self.rotations(joints, self.widen(hidden)))


class CloudExchange(nn.Module):
    """Person, background and neighbors (B, T, C) -> (B, T, 3 C): each as values, the other two as queries and keys."""

    def __init__(self, width: int, hidden: int):
        super().__init__()
        # of each of the three attentions: norms of query, key, value
        self.norms: Any = nn.ModuleList(
            nn.ModuleList(nn.LayerNorm(width, eps=1e-6) for _ in range(3)) for _ in range(3)
        )
        self.attention = nn.ModuleList(nn.MultiheadAttention(width, 8, batch_first=True) for _ in range(3))
        self.norm = nn.LayerNorm(3 * width, eps=1e-6)
        self.drop_path = DropPath(0.2)
        self.mlp = nn.Sequential(
            nn.Linear(3 * width, hidden), nn.GELU(), nn.Dropout(0.1), nn.Linear(hidden, 3 * width), nn.Dropout(0.1)
        )

    def forward(self, person: Tensor, background: Tensor, neighbors: Tensor) -> Tensor:
        person = person + self._attend(0, neighbors, background, person)
        neighbors = neighbors + self._attend(1, person, background, neighbors)
        background = background + self._attend(2, person, neighbors, background)
        x = torch.cat([person, neighbors, background], -1)
        return x + self.drop_path(self.mlp(self.norm(x)))

    def _attend(self, number: int, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        query, key, value = (norm(x) for norm, x in zip(self.norms[number], (query, key, value), strict=True))
        output = self.attention[number](query, key, value, need_weights=False)[0]
        return self.drop_path(F.dropout(output, 0.1, self.training))


def _heights() -> Tensor:
    """(72,) m: x, y = 0 and z of the mean adult's joints, standing, relative to the pelvis."""
    rest_joints = forward_kinematics(torch.eye(3).expand(len(SMPL24), 3, 3), rest_offsets(), SMPL24.parents)
    # in SMPL's frame, y is up
    return F.pad(rest_joints[:, 1:2], (2, 0)).flatten()


def _transformer(width: int, hidden: int, *, stock_initialization: bool) -> nn.TransformerEncoder:
    """Post-norm transformer layers.

    With PyTorch's initialization, the layers are copies of one layer that each average over the frames: most of what
    distinguishes frames is lost at the start, and a few training steps lose the rest.
    """

    def layer() -> nn.TransformerEncoderLayer:
        return nn.TransformerEncoderLayer(width, 4, hidden, dropout=0.1, activation="gelu", batch_first=True)

    encoder = nn.TransformerEncoder(layer(), LAYERS, enable_nested_tensor=False)
    if stock_initialization:
        return encoder
    encoder.layers = nn.ModuleList(layer() for _ in range(LAYERS))
    for encoder_layer in encoder.layers:
        attention: Any = encoder_layer.self_attn
        nn.init.zeros_(attention.out_proj.weight)
        nn.init.zeros_(encoder_layer.linear2.weight)
        # for frames that are all zero, as without neighbors, a norm's gradient would grow 300 times in each layer
        nn.init.uniform_(attention.out_proj.bias, -(width**-0.5), width**-0.5)
    return encoder
