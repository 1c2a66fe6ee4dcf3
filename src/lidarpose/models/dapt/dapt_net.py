"""`DaptNet`: the paper's network. A Point Transformer V3 U-Net whose decoder feeds joint anchors, level by level.

Legend: B people, M voxels of all people at level 0, J joints, C channels, A anchor channels, W heatmap bins, P parts.

The legacy switch. In the released code a sparse tensor is not brought up to date after each block and each unpooling:
the convolution of every later block reads the block's last branch instead of the sum, and the first one of a decoder
stage reads the skip alone. Weights trained with that flow need it (`config.legacy`); new ones are trained without.
"""

from collections import OrderedDict
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarpose.errors import InputError
from lidarpose.models.dapt.blocks import (
    Block,
    Exchange,
    Perceptron,
    Pooling,
    RowNorm,
    Stage,
    SubmanifoldConvolution,
    Unpooling,
)
from lidarpose.models.dapt.dapt_config import DaptConfig
from lidarpose.models.dapt.voxel_tables import Level, Neighbors, Tables, build_tables
from lidarpose.models.layers import mean_bin


@dataclass(frozen=True, kw_only=True)
class DaptBatch:
    """What the network reads of `Tables`, as tensors."""

    features: Tensor
    stem: Neighbors[Tensor]
    levels: tuple[Level[Tensor], ...]

    @classmethod
    def from_tables(
        cls, tables: Tables, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32
    ) -> "DaptBatch":
        return cls(
            features=torch.as_tensor(tables.features).to(device, dtype),
            stem=_to_tensors(tables.stem, device),
            levels=_to_tensors(tables.levels, device),
        )


@dataclass(frozen=True, kw_only=True)
class DaptOutputs:
    """Raw results in the person's frame; None where the network has no such head.

    anchors (B, J, A) after the last exchange; logits_x, logits_y, logits_z (B, J, W) heatmaps; inter (B, J, 3) m, the
    auxiliary head's joints; points (M, C) features of the voxels of level 0; parts (M, P) logits, 0 = not body;
    coordinates (B, J, 3) m, the coordinate head's joints; low, step: where bin 0 lies and how far apart bins are, m.
    """

    anchors: Tensor
    points: Tensor
    logits_x: Tensor | None
    logits_y: Tensor | None
    logits_z: Tensor | None
    inter: Tensor | None
    parts: Tensor | None
    coordinates: Tensor | None
    low: tuple[float, ...]
    step: tuple[float, ...]

    def joints(self) -> Tensor:
        """(B, J, 3) m, differentiable: the heatmaps' windowed mean, as `decode.window`; else the coordinates."""
        if self.logits_x is None:
            # a network has the one head or the other
            return cast("Tensor", self.coordinates)
        heatmaps = cast("tuple[Tensor, Tensor, Tensor]", (self.logits_x, self.logits_y, self.logits_z))
        axes = [mean_bin(h) * step + low for h, low, step in zip(heatmaps, self.low, self.step, strict=True)]
        return torch.stack(axes, -1)


class DaptNet(nn.Module):
    """Paper: "Density-aware pose transformer". A pure function of a `DaptBatch`; parameters bear the released names."""

    def __init__(self, config: DaptConfig):
        super().__init__()
        self.config = config
        self.backbone = _Backbone(config)
        width = config.anchor_channels[0]
        heads: dict[str, nn.Module] = {}
        if config.bins:
            heads["query"] = HeatmapHead(width, config)
        if config.coordinates:
            # the released files hold one of the two heads of an anchor, under one name
            heads["coordinate" if config.bins else "query"] = coordinate_head(width, 3)
        if config.auxiliary:
            heads["inter_feat"] = coordinate_head(config.encoder_channels[-1], 3 * len(config.joints))
        if config.parts:
            heads["feat"] = part_head(config.decoder_channels[0], config.parts)
        self.heads = nn.ModuleDict(heads)

    def forward(self, batch: DaptBatch) -> DaptOutputs:
        config, heads = self.config, self.heads
        anchors, points, bottleneck = self.backbone(batch)
        x = y = z = inter = coordinates = None
        if config.bins:
            x, y, z = heads["query"](anchors)
        if config.coordinates:
            coordinates = heads["coordinate" if config.bins else "query"](anchors)
        if config.auxiliary:
            inter = heads["inter_feat"](bottleneck).unflatten(-1, (-1, 3))
        return DaptOutputs(
            anchors=anchors,
            points=points,
            logits_x=x,
            logits_y=y,
            logits_z=z,
            inter=inter,
            parts=heads["feat"](points) if config.parts else None,
            coordinates=coordinates,
            low=tuple(config.low.tolist()),
            step=tuple(config.step.tolist()),
        )

    def batch(
        self, clouds: list[np.ndarray], *, layout: str | None = None, rng: np.random.Generator | None = None
    ) -> DaptBatch:
        """Clouds (n, 3) m, each in its person's frame, as the network's device and precision read them.

        layout and rng as in `tables.build_tables`; None takes the layout that suits the device.
        """
        return self._tensors(build_tables(clouds, self.config, layout=layout or self._layout(), rng=rng))

    def outputs(self, clouds: list[np.ndarray]) -> dict[str, np.ndarray]:
        """Raw results, in evaluation mode, of people's clouds (n, 3) m, each in its person's frame.

        By name, where the network has the head: anchors, logits_x, logits_y, logits_z, inter, coordinates, and of all
        points in the order given point_feat_last (points, C) and parts (points, P); float32. A cloud may be of any
        float type and may be empty. Raises InputError for anything else.
        """
        clouds = [_cloud(cloud, k) for k, cloud in enumerate(clouds)]
        # nobody: the shapes of somebody, cut to none
        tables = build_tables(clouds or [np.zeros((0, 3), np.float32)], self.config, layout=self._layout())
        was_training = self.training
        self.eval()
        try:
            with torch.inference_mode():
                out = self(self._tensors(tables))
        finally:
            self.train(was_training)
        names = ("anchors", "logits_x", "logits_y", "logits_z", "inter", "coordinates")
        outputs = {name: _array(getattr(out, name))[: len(clouds)] for name in names if getattr(out, name) is not None}
        outputs["point_feat_last"] = _array(out.points)[tables.point_voxel]
        if out.parts is not None:
            outputs["parts"] = _array(out.parts)[tables.point_voxel]
        return outputs

    def _layout(self) -> str:
        return "ragged" if self.backbone.keypoint_embedding.device.type == "cpu" else "padded"

    def _tensors(self, tables: Tables) -> DaptBatch:
        anchors = self.backbone.keypoint_embedding
        return DaptBatch.from_tables(tables, anchors.device, anchors.dtype)


class _Backbone(nn.Module):
    """Encoder, decoder with an exchange after each of its stages."""

    def __init__(self, config: DaptConfig):
        super().__init__()
        self.legacy = config.legacy
        widths, last = config.encoder_channels, len(config.encoder_depths) - 1
        self.embedding = nn.Module()
        self.embedding.stem = nn.Sequential()
        self.embedding.stem.add_module("conv", SubmanifoldConvolution(3, widths[0], 5, bias=False))
        self.embedding.stem.add_module("norm", RowNorm(widths[0]))

        drops = iter(np.linspace(0, config.drop_path, sum(config.encoder_depths)).tolist())
        self.enc = nn.Module()
        for s, depth in enumerate(config.encoder_depths):
            blocks = _blocks(widths[s], config.encoder_heads[s], [next(drops) for _ in range(depth)], config)
            down = Pooling(widths[s - 1], widths[s]) if s else None
            self.enc.add_module(f"enc{s}", Stage(blocks, down=down))

        drops = iter(np.linspace(0, config.drop_path, sum(config.decoder_depths)).tolist())
        wide = (*config.decoder_channels, widths[-1])
        stages, exchanges = [], []
        for s, depth in enumerate(config.decoder_depths):
            # within a stage the first block drops most
            rates = [next(drops) for _ in range(depth)][::-1]
            blocks = _blocks(wide[s], config.decoder_heads[s], rates, config)
            stages.append(Stage(blocks, up=Unpooling(wide[s + 1], widths[s], wide[s])))
            anchor_in, anchor_out = config.anchor_channels[s + 1], config.anchor_channels[s]
            exchanges.append(Exchange(anchor_in, wide[s], anchor_out, config.anchor_heads, config.anchor_dropout))
        self.dec = nn.Module()
        for s in reversed(range(last)):
            self.dec.add_module(f"dec{s}", stages[s])
            self.dec.add_module(f"dec_ke{s}", exchanges[s])
        # small random numbers where the released code begins at zero
        self.keypoint_embedding = nn.Parameter(torch.randn(len(config.joints), config.anchor_channels[-1]) * 0.02)

    def forward(self, batch: DaptBatch) -> tuple[Tensor, Tensor, Tensor]:
        """Anchors (B, J, A), level 0's rows (M, C), and the bottleneck's maximum over each person (B, C')."""
        stem: Any = self.embedding.stem
        rows = F.gelu(stem.norm(stem.conv(batch.features, batch.stem)))
        skips = []
        for s, level in enumerate(batch.levels):
            stage = getattr(self.enc, f"enc{s}")
            if s:
                rows = stage.down(rows, batch.levels[s - 1].children)
            rows = stage.blocks(rows, rows, level, legacy=self.legacy)
            skips.append(rows)
        # rows of a person are repeated in its empty slots, which a maximum does not notice
        bottleneck = rows[batch.levels[-1].slots].amax(1)

        anchors = self.keypoint_embedding.expand(bottleneck.shape[0], -1, -1)
        for s in reversed(range(len(batch.levels) - 1)):
            level, stage = batch.levels[s], getattr(self.dec, f"dec{s}")
            rows, skip = stage.up(rows, skips[s], level.parent)
            rows = stage.blocks(rows, skip, level, legacy=self.legacy)
            anchors = getattr(self.dec, f"dec_ke{s}")(anchors, rows, level)
        return anchors, rows, bottleneck


class HeatmapHead(nn.Module):
    """Paper: "Heatmap decoder for joints". Three perceptrons, one an axis, shared by all joints."""

    def __init__(self, channels: int, config: DaptConfig):
        super().__init__()
        self.fcs = nn.ModuleList(Perceptron(channels, channels, bins) for bins in config.bins)
        # kept in the released files, read by nobody here: the configuration knows the ranges exactly
        self.register_buffer("coord_range", torch.tensor(config.ranges))
        self.register_buffer("joint_wise_weight", torch.ones(len(config.joints)))

    def forward(self, anchors: Tensor) -> tuple[Tensor, ...]:
        return tuple(fc(anchors) for fc in self.fcs)


def coordinate_head(channels: int, out_channels: int) -> nn.Sequential:
    """Paper: the decoder D_reg of anchors; also the released code's auxiliary head of the bottleneck."""
    return nn.Sequential(OrderedDict(fc=Perceptron(channels, channels, out_channels)))


def part_head(channels: int, parts: int) -> nn.Sequential:
    """Paper: the decoder D_seg of points. The released code's batch norm here is torch's own, eps 1e-5."""
    norm = RowNorm(channels, eps=1e-5, momentum=0.1)
    layers = nn.Sequential(nn.Linear(channels, channels), norm, nn.GELU(), nn.Linear(channels, parts))
    return nn.Sequential(OrderedDict(fc=layers))


def _blocks(channels: int, heads: int, drops: list[float], config: DaptConfig) -> list[Block]:
    return [Block(channels, heads, config.mlp_ratio, drop, order) for order, drop in enumerate(drops)]


def _cloud(cloud: np.ndarray, number: int) -> np.ndarray:
    cloud = np.asarray(cloud)
    if cloud.ndim != 2 or cloud.shape[1] != 3 or cloud.dtype.kind not in "fiu":
        raise InputError(
            f"cloud {number}: expected numbers of shape (n, 3), x y z in meters, got {cloud.dtype} of {cloud.shape}"
        )
    return np.ascontiguousarray(cloud, np.float32)


def _array(values: Tensor) -> np.ndarray:
    return values.float().cpu().numpy()


def _to_tensors(value: Any, device: torch.device | str) -> Any:
    """A record of arrays as the same record of tensors."""
    if isinstance(value, np.ndarray):
        return torch.as_tensor(value).to(device)
    if isinstance(value, tuple):
        return tuple(_to_tensors(part, device) for part in value)
    if is_dataclass(value) and not isinstance(value, type):
        return replace(
            value, **{field.name: _to_tensors(getattr(value, field.name), device) for field in fields(value)}
        )
    return value
