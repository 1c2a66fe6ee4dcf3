"""`DaptNet`: the paper's network. A Point Transformer V3 U-Net whose decoder feeds joint anchors, level by level.

Legend: B people, M voxels of all people at a level, concatenated, N voxels per person at most, J joints, C channels, A
anchor channels, W heatmap bins, P parts.

Modules have the names of the released weights, so that these load by name.

Stale convolutions. In the released code a sparse tensor is not updated after each block and each unpooling: the
convolution of every later block reads the previous block's last branch instead of the sum, and the first convolution of
a decoder stage reads the skip alone. Weights trained this way need it (`config.stale_convolution`); new weights are
trained without it.
"""

from collections import OrderedDict
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarpose.errors import InputError
from lidarpose.models.baselines.point_transformer_v2 import Rows
from lidarpose.models.baselines.prn import PrnNeck
from lidarpose.models.dapt.dapt_config import DaptConfig
from lidarpose.models.dapt.point_transformer_v3 import Perceptron, RowNorm, Stage, SubmanifoldConvolution
from lidarpose.models.dapt.voxel_tables import Level, Tables, build_tables
from lidarpose.models.layers import mean_bin

# number of layers of the neck that reads the finest level alone
FINEST_LAYERS = 4


class MultiDensityExchange(nn.Module):
    """Multi-density exchange: anchors (B, J, A) attend to each other, then to the voxels of one level.

    Paper: A_{m-1} = MDE_m(A_m, f_m). A stock post-norm decoder layer with anchors as targets and voxels as memory. It
    is one-way: voxels never attend to anchors. As in the released code, and unlike the paper's text, widths that differ
    are matched by Linear and norm, and the coarsest level is not read.
    """

    def __init__(self, channels: int, voxel_channels: int, out_channels: int, heads: int, dropout: float):
        super().__init__()
        self.fc_in = _aligned(channels, voxel_channels)
        self.transformer = nn.TransformerDecoderLayer(
            voxel_channels, heads, 4 * voxel_channels, dropout, batch_first=True
        )
        self.fc_out = _aligned(voxel_channels, out_channels)

    def forward(self, anchors: Tensor, rows: Tensor, level: Level) -> Tensor:
        anchors = self.fc_in(anchors)
        anchors = self.transformer(anchors, rows[level.slots], memory_key_padding_mask=~level.valid)
        return self.fc_out(anchors)


class FinestNeck(nn.Module):
    """Stock post-norm decoder layers, anchors (B, J, C) as targets, the voxels of level 0 as memory; then a LayerNorm.

    Paper: Table 3, anchors without MDE.
    """

    def __init__(self, channels: int, heads: int, dropout: float):
        super().__init__()
        layer = nn.TransformerDecoderLayer(channels, heads, 4 * channels, dropout, batch_first=True)
        self.transformer = nn.TransformerDecoder(layer, FINEST_LAYERS, nn.LayerNorm(channels))

    def forward(self, anchors: Tensor, rows: Tensor, level: Level) -> Tensor:
        return self.transformer(anchors, rows[level.slots], memory_key_padding_mask=~level.valid)


def _aligned(channels: int, out_channels: int) -> nn.Module:
    if channels == out_channels:
        return nn.Identity()
    return nn.Sequential(nn.Linear(channels, out_channels), nn.LayerNorm(out_channels))


# ---- the network


@dataclass(frozen=True, kw_only=True)
class DaptOutputs:
    """Raw results in the person's frame; None if the network lacks the head.

    anchors (B, J, A) after the neck; logits_x, logits_y, logits_z (B, J, W) heatmaps; inter (B, J, 3) m, joints of the
    auxiliary head; points (M, C) features of the voxels of level 0; parts (M, P) logits, 0 = background, for the neck
    prn (M, J + 1) of the nearest joint; coordinates (B, J, 3) m, joints of the coordinate head, or refined ones of prn;
    voted (B, J, 3) m, joints of prn before refinement; low, step: position of bin 0 and spacing of bins, m.
    """

    anchors: Tensor | None
    points: Tensor
    logits_x: Tensor | None
    logits_y: Tensor | None
    logits_z: Tensor | None
    inter: Tensor | None
    parts: Tensor | None
    coordinates: Tensor | None
    low: tuple[float, ...]
    step: tuple[float, ...]
    voted: Tensor | None = None

    def joints(self) -> Tensor:
        """(B, J, 3) m, differentiable: the windowed mean of the heatmaps, as `decode.window`; else the coordinates."""
        if self.logits_x is None:
            # a network has at least one of the two heads
            return cast("Tensor", self.coordinates)
        heatmaps = cast("tuple[Tensor, Tensor, Tensor]", (self.logits_x, self.logits_y, self.logits_z))
        axes = [mean_bin(h) * step + low for h, low, step in zip(heatmaps, self.low, self.step, strict=True)]
        return torch.stack(axes, -1)


class DaptNet(nn.Module):
    """Paper: "Density-aware pose transformer". A pure function of `Tables` of tensors."""

    def __init__(self, config: DaptConfig):
        super().__init__()
        self.config = config
        self.backbone = _Backbone(config)
        width = config.anchor_width
        heads: dict[str, nn.Module] = {}
        if config.bins:
            heads["query"] = HeatmapHead(width, config)
        if config.neck == "prn":
            heads["prn"] = PrnNeck(width, len(config.joints), config.anchor_heads, config.anchor_dropout)
        elif config.coordinates:
            # the released files hold only one of the two anchor heads, under the same name
            heads["coordinate" if config.bins else "query"] = coordinate_head(width, 3)
        if config.auxiliary:
            heads["inter_feat"] = coordinate_head(config.encoder_channels[-1], 3 * len(config.joints))
        if config.parts:
            heads["feat"] = part_head(config.decoder_channels[0], config.parts)
        self.heads = nn.ModuleDict(heads)

    def forward(self, batch: Tables[Tensor]) -> DaptOutputs:
        config, heads = self.config, self.heads
        anchors, points, bottleneck = self.backbone(batch)
        x, y, z = heads["query"](anchors) if config.bins else (None, None, None)
        parts = heads["feat"](points) if config.parts else None
        voted = coordinates = None
        if config.neck == "prn":
            lengths = batch.levels[0].lengths
            person = torch.repeat_interleave(torch.arange(len(lengths), device=lengths.device), lengths)
            prn = heads["prn"](points, Rows(xyz=batch.features, person=person, count=lengths))
            coordinates, voted, parts = prn.joints, prn.voted, prn.parts
        elif config.coordinates:
            coordinates = heads["coordinate" if config.bins else "query"](anchors)
        return DaptOutputs(
            anchors=anchors,
            points=points,
            logits_x=x,
            logits_y=y,
            logits_z=z,
            inter=heads["inter_feat"](bottleneck).unflatten(-1, (-1, 3)) if config.auxiliary else None,
            parts=parts,
            coordinates=coordinates,
            low=tuple(config.low.tolist()),
            step=tuple(config.step.tolist()),
            voted=voted,
        )

    def batch(self, clouds: list[np.ndarray], *, layout: str | None = None) -> Tables[Tensor]:
        """Tables of clouds (n, 3) m, each in its person's frame, on the network's device and in its precision.

        layout: as in `build_tables`; None selects the faster one for the device.
        """
        parameter = next(self.parameters())
        layout = layout or ("ragged" if parameter.device.type == "cpu" else "padded")
        return to_tensors(build_tables(clouds, self.config, layout=layout), parameter.device, parameter.dtype)

    def outputs(self, clouds: list[np.ndarray]) -> dict[str, np.ndarray]:
        """Raw results, in evaluation mode, of people's clouds (n, 3) m, each in its person's frame.

        By name, if the network has the head: anchors, logits_x, logits_y, logits_z, inter, coordinates, voted, and for
        all points in the given order point_feat_last (points, C) and parts (points, P); float32. A cloud may be of any
        float or integer type and may be empty. Raises InputError for anything else.
        """
        clouds = [_cloud(cloud, k) for k, cloud in enumerate(clouds)]
        # without clouds, one empty cloud gives the shapes; its results are removed
        batch = self.batch(clouds or [np.zeros((0, 3), np.float32)])
        was_training = self.training
        self.eval()
        try:
            with torch.inference_mode():
                results = self(batch)
        finally:
            self.train(was_training)
        names = ("anchors", "logits_x", "logits_y", "logits_z", "inter", "coordinates", "voted")
        outputs = {name: value[: len(clouds)] for name in names if (value := getattr(results, name)) is not None}
        outputs["point_feat_last"] = results.points[batch.point_voxel]
        if results.parts is not None:
            outputs["parts"] = results.parts[batch.point_voxel]
        return {name: value.float().cpu().numpy() for name, value in outputs.items()}


class _Backbone(nn.Module):
    """Encoder, decoder, and the anchors, which read the voxels after each decoder stage or after the last one alone."""

    def __init__(self, config: DaptConfig):
        super().__init__()
        self.stale_convolution, self.neck = config.stale_convolution, config.neck
        widths = config.encoder_channels
        self.embedding = nn.Module()
        stem = OrderedDict(conv=SubmanifoldConvolution(3, widths[0], 5, bias=False), norm=RowNorm(widths[0]))
        self.embedding.stem = nn.Sequential(stem)
        self.enc = nn.Module()
        for s, drops in enumerate(_drop_rates(config.encoder_depths, config.drop_path)):
            finer = widths[s - 1] if s else 0
            self.enc.add_module(
                f"enc{s}", Stage(widths[s], config.encoder_heads[s], config.mlp_ratio, drops, finer=finer)
            )

        up_widths = (*config.decoder_channels, widths[-1])
        stages: list[Stage] = []
        necks: dict[int, nn.Module] = {}
        for s, drops in enumerate(_drop_rates(config.decoder_depths, config.drop_path)):
            coarser = up_widths[s + 1], widths[s]
            # within a decoder stage, the first block has the highest rate
            stages.append(Stage(up_widths[s], config.decoder_heads[s], config.mlp_ratio, drops[::-1], coarser=coarser))
            anchor_in, anchor_out = config.anchor_channels[s + 1], config.anchor_channels[s]
            if self.neck == "mde":
                necks[s] = MultiDensityExchange(
                    anchor_in, up_widths[s], anchor_out, config.anchor_heads, config.anchor_dropout
                )
            elif self.neck == "finest" and s == 0:
                necks[s] = FinestNeck(up_widths[0], config.anchor_heads, config.anchor_dropout)
        self.dec = nn.Module()
        for s in reversed(range(len(stages))):
            self.dec.add_module(f"dec{s}", stages[s])
            if s in necks:
                self.dec.add_module(f"dec_ke{s}", necks[s])
        if necks:
            width = config.anchor_channels[-1] if self.neck == "mde" else up_widths[0]
            scale = 0.0 if config.zero_anchors else 0.02
            self.keypoint_embedding = nn.Parameter(torch.randn(len(config.joints), width) * scale)

    def forward(self, batch: Tables[Tensor]) -> tuple[Tensor | None, Tensor, Tensor]:
        """Anchors (B, J, A) or None; rows (M, C) of level 0; the bottleneck's maximum over each person (B, C')."""
        stem: Any = self.embedding.stem
        rows = F.gelu(stem.norm(stem.conv(batch.features, batch.stem)))
        skips = []
        for s, level in enumerate(batch.levels):
            stage = getattr(self.enc, f"enc{s}")
            if s:
                rows = stage.down(rows, batch.levels[s - 1].children)
            rows = stage.blocks(rows, rows, level, stale_convolution=self.stale_convolution)
            skips.append(rows)
        # empty slots repeat rows of the same person, which does not change the maximum
        bottleneck = rows[batch.levels[-1].slots].amax(1)

        anchors = None if self.neck == "prn" else self.keypoint_embedding.expand(bottleneck.shape[0], -1, -1)
        for s in reversed(range(len(batch.levels) - 1)):
            level, stage = batch.levels[s], getattr(self.dec, f"dec{s}")
            rows, skip = stage.up(rows, skips[s], level.parent)
            rows = stage.blocks(rows, skip, level, stale_convolution=self.stale_convolution)
            if hasattr(self.dec, f"dec_ke{s}"):
                anchors = getattr(self.dec, f"dec_ke{s}")(anchors, rows, level)
        return anchors, rows, bottleneck


class HeatmapHead(nn.Module):
    """Paper: "Heatmap decoder for joints". Three perceptrons, one per axis, shared by all joints."""

    def __init__(self, channels: int, config: DaptConfig):
        super().__init__()
        self.fcs = nn.ModuleList(Perceptron(channels, channels, bins) for bins in config.bins)
        # part of the released files, not used by the network: the configuration has the exact ranges
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


def _drop_rates(depths: tuple[int, ...], max_rate: float) -> list[list[float]]:
    """Drop rates of each stage's blocks, rising from 0 to `max_rate` over all stages."""
    rates = np.linspace(0, max_rate, sum(depths))
    return [stage.tolist() for stage in np.split(rates, np.cumsum(depths)[:-1])]


def _cloud(cloud: np.ndarray, number: int) -> np.ndarray:
    cloud = np.asarray(cloud)
    if cloud.ndim != 2 or cloud.shape[1] != 3 or cloud.dtype.kind not in "fiu":
        raise InputError(
            f"cloud {number}: expected numbers of shape (n, 3), x y z in meters, got {cloud.dtype} of {cloud.shape}"
        )
    return np.ascontiguousarray(cloud, np.float32)


def to_tensors(record: Any, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32) -> Any:
    """A record of arrays as the same record of tensors, with floats as `dtype`."""
    if isinstance(record, np.ndarray):
        return torch.as_tensor(record).to(device, dtype if record.dtype.kind == "f" else None)
    if isinstance(record, tuple):
        return tuple(to_tensors(part, device, dtype) for part in record)
    if is_dataclass(record) and not isinstance(record, type):
        parts = {field.name: to_tensors(getattr(record, field.name), device, dtype) for field in fields(record)}
        return replace(record, **parts)
    return record
