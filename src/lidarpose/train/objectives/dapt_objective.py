"""`DaptObjective`: the training objective of the paper's network, in either of its stages.

Legend: B people, J joints of the network, M voxels of level 0.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lidarpose.errors import InputError, check_name
from lidarpose.models.dapt.dapt_config import PARTS, RELEASED_FAULTS, DaptConfig, named_config
from lidarpose.models.dapt.dapt_net import to_tensors
from lidarpose.models.dapt.voxel_tables import LAYOUTS, Tables, build_tables
from lidarpose.train.augment import UNKNOWN_PART, Example
from lidarpose.train.objectives.dapt_losses import DaptTargets, finetuning, pretraining
from lidarpose.train.objectives.objective import BuiltNetwork, Share, in_body26, majority_part, one_process
from lidarpose.train.recipes import DEEP_PAPER, SMALL_PAPER, TINY_PAPER

STAGES = ("pretrain", "finetune")
# names of the heads' outputs
_HEADS = ("logits_x", "logits_y", "logits_z", "inter", "parts", "coordinates")
# for the neck prn, a voxel belongs to a joint within this distance, m, as in the released code
PRN_RADIUS = 0.1


@dataclass(frozen=True, kw_only=True)
class DaptArrays:
    """A batch of people.

    tables: the network's inputs; joints (B, J, 3) float32 m in the network's order, NaN if unlabeled; part (M,) int64:
    the part of most of a voxel's points, -1 if none is known; for the neck prn 1 + the index of the joint nearest to
    the voxel, 0 for background; None in fine-tuning with other necks.
    """

    tables: Tables
    joints: np.ndarray
    part: np.ndarray | None

    def targets(self, device: torch.device | str) -> DaptTargets:
        is_labeled = np.isfinite(self.joints).all(-1)
        return DaptTargets(
            joints=torch.as_tensor(np.where(is_labeled[..., None], self.joints, 0)).to(device),
            weight=torch.as_tensor(is_labeled.astype(np.float32)).to(device),
            part=None if self.part is None else torch.as_tensor(self.part).to(device),
        )


@dataclass(frozen=True, kw_only=True)
class DaptObjective(BuiltNetwork):
    """The `Objective` of a `DaptNet` with this configuration.

    stage: "pretrain", which needs coordinates and parts, or "finetune", which learns heatmaps, or coordinates if the
    network has no heatmaps; the neck prn learns the same in both. layout: of the tables, "ragged" for CPUs and "padded"
    for accelerators. Heads that a stage does not use get a gradient of zero. Raises InputError if the configuration
    lacks a head.
    """

    config: DaptConfig
    stage: str
    layout: str = "ragged"

    def __post_init__(self):
        config = self.config
        check_name("stage of training", self.stage, STAGES)
        check_name("layout", self.layout, LAYOUTS)
        if self.stage == "pretrain" and config.neck != "prn" and not (config.coordinates and config.parts == PARTS):
            raise InputError(
                f"pre-training needs coordinates and {PARTS} parts, {config.name} has coordinates={config.coordinates} "
                f"and parts={config.parts}: see pretraining_config"
            )

    def collate(self, examples: list[Example]) -> DaptArrays:
        """Collates a batch; one random point per voxel is kept, as in the released code, drawn with the sample's seed.

        So no cloud depends on the other samples of its batch, nor on the order of its points. For clouds of more than
        `config.patch` voxels, the space-filling curves are shuffled with all seeds of the batch; smaller clouds use
        full attention, whatever the curve. A voxel's part is that of most of its points; the released code takes the
        part of the point that is kept.
        """
        samples = [_thinned(example, self.config.grid) for example in examples]
        tables = build_tables(
            [points for points, _ in samples],
            self.config,
            layout=self.layout,
            rng=np.random.default_rng([example.seed for example in examples]),
        )
        # the last entry is for the placeholder of an empty cloud
        part = np.concatenate([*(part for _, part in samples), [UNKNOWN_PART]])
        joints = np.stack([example.joints for example in examples])[:, self.config.columns].astype(np.float32)
        if self.config.neck == "prn":
            nearest_labels = nearest_joints(tables.features, np.repeat(joints, tables.levels[0].lengths, axis=0))
            labels: np.ndarray | None = np.where(tables.kept < 0, UNKNOWN_PART, nearest_labels)
        else:
            labels = part[tables.kept] if self.stage == "pretrain" else None
        return DaptArrays(tables=tables, joints=joints, part=labels)

    def terms(
        self, network: Callable, arrays: DaptArrays, *, device: torch.device | str = "cpu", share: Share = one_process
    ) -> dict[str, Tensor]:
        """`dapt_losses.pretraining` or `finetuning`. A labeled joint's weight is 1, whether visible or not, as
        in the released code."""
        outputs, targets = network(to_tensors(arrays.tables, device)), arrays.targets(device)
        losses = pretraining if self.config.neck == "prn" or self.stage == "pretrain" else finetuning
        terms = losses(outputs, targets, self.config, share=share)
        # adds zero times every head's output: gradient averaging across processes waits for all heads, used or not
        first_term = next(iter(terms))
        heads = [value for name in _HEADS if (value := getattr(outputs, name)) is not None]
        terms[first_term] = sum((value.float().sum() * 0 for value in heads), terms[first_term])
        return terms

    @torch.no_grad()
    def joints(self, network: Callable, arrays: DaptArrays, *, device: torch.device | str = "cpu") -> np.ndarray:
        """Joints decoded from the heatmaps; in pre-training, those of the coordinate head, which it trains."""
        outputs = network(to_tensors(arrays.tables, device))
        joints = outputs.coordinates if self.stage == "pretrain" else outputs.joints()
        return in_body26(joints, self.config.columns)


_MENDED: dict[str, Any] = dict.fromkeys(RELEASED_FAULTS, False)


def pretraining_config() -> DaptConfig:
    """The paper's network before fine-tuning, with the released code's faults fixed."""
    return replace(named_config("pretrain"), **_MENDED)


def finetuning_config(dataset: str) -> DaptConfig:
    """The paper's network for a dataset, with the released code's faults fixed and without an auxiliary head.

    dataset: waymo, humanm3, lidarhuman26m or sloper4d. Raises InputError for another name.
    """
    return replace(named_config(dataset), auxiliary=False, **_MENDED)


def small(config: DaptConfig) -> DaptConfig:
    """The same design, joints and heads with a fortieth of the weights and levels of 4, 8 and 16 cm, for CPUs.

    Less stochastic depth, and no dropout in the neck: with them pre-training takes a quarter more people to learn the
    facing, and attention with dropout has no fast implementation on CPUs.
    """
    return replace(
        config,
        name=f"small-{config.name}",
        encoder_depths=(1, 1, 2),
        encoder_channels=(32, 48, 96),
        encoder_heads=(2, 3, 6),
        decoder_depths=(1, 1),
        decoder_channels=(48, 64),
        decoder_heads=(3, 4),
        anchor_channels=(48, 64, 64),
        strides=(2, 2),
        anchor_dropout=0.0,
        grid=0.04,
        drop_path=0.05,
    )


def tiny(config: DaptConfig) -> DaptConfig:
    """The same with a hundredth of the weights, two heads in the neck, and levels of 6, 12 and 24 cm."""
    return replace(
        small(config),
        name=f"tiny-{config.name}",
        encoder_depths=(1, 1, 1),
        encoder_channels=(16, 32, 64),
        encoder_heads=(1, 2, 4),
        decoder_channels=(32, 48),
        decoder_heads=(2, 3),
        anchor_channels=(32, 48, 48),
        anchor_heads=2,
        grid=0.06,
    )


def deep(config: DaptConfig) -> DaptConfig:
    """The same width as `tiny` with the published number of levels, 2, 4, 8, 16 and 32 cm: anchors read four of them,
    by four exchanges, as the finest one is read by four layers without MDE."""
    return replace(
        tiny(config),
        name=f"deep-{config.name}",
        encoder_depths=(1, 1, 1, 1, 1),
        encoder_channels=(16, 24, 32, 48, 64),
        encoder_heads=(1, 2, 2, 3, 4),
        decoder_depths=(1, 1, 1, 1),
        decoder_channels=(32, 32, 48, 48),
        decoder_heads=(2, 2, 3, 3),
        anchor_channels=(32, 32, 48, 48, 48),
        strides=(2, 2, 2, 2),
        grid=0.02,
    )


# reduced sizes by name
REDUCED = {SMALL_PAPER: small, TINY_PAPER: tiny, DEEP_PAPER: deep}


def nearest_joints(points: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """points (M, 3) m, joints (M, J, 3) m of each point's person, NaN if unknown -> (M,) int64: 1 + the index of the
    nearest joint within `PRN_RADIUS`, 0 for background, -1 for points that may belong to a joint without a label."""
    distance = np.linalg.norm(joints - points[:, None], axis=-1)
    is_known = np.isfinite(distance)
    distance = np.where(is_known, distance, np.inf)
    # where a joint has no label, background is unknown
    other = np.where(is_known.all(1), 0, UNKNOWN_PART)
    return np.where(distance.min(1) < PRN_RADIUS, 1 + distance.argmin(1), other)


def _thinned(example: Example, grid: float) -> tuple[np.ndarray, np.ndarray]:
    """A random point of each voxel (m, 3), and the part of most of the voxel's points (m,).

    The cells are those of `build_tables`, which then finds one point in each.
    """
    points = np.asarray(example.points, np.float32).reshape(-1, 3)
    part = np.asarray(example.part, np.int64)
    if len(part) != len(points) or part.size and part.max() >= PARTS:
        max_part = part.max() if part.size else "none"
        raise InputError(
            f"each of {len(points)} points needs a part below {PARTS}, got {len(part)}, the highest {max_part}"
        )
    cells = np.floor(points / grid)
    order = np.lexsort((*points.T, *cells.T))
    cells = cells[order]
    is_start = np.ones(len(cells), bool)
    is_start[1:] = (cells[1:] != cells[:-1]).any(1)
    starts = np.flatnonzero(is_start)
    counts = np.diff(starts, append=len(cells))
    rows = order[starts + (np.random.default_rng(example.seed).random(len(starts)) * counts).astype(np.int64)]
    return points[rows], majority_part(np.cumsum(is_start) - 1, part[order], voxels=len(starts), parts=PARTS)
