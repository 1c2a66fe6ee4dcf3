"""The network of a recipe: its configuration and its initial weights."""

import json
from collections.abc import Callable
from contextlib import suppress
from copy import deepcopy
from dataclasses import fields, replace
from functools import partial
from typing import Any

import torch
from torch import nn

from lidarpose.errors import InputError, check_name
from lidarpose.io.files import file_error
from lidarpose.models import weights_path
from lidarpose.models.baselines.baseline_config import (
    BaselineConfig,
    LidarcapConfig,
    LpformerConfig,
    NeConfig,
    PrnConfig,
)
from lidarpose.models.checkpoint import build, load_checkpoint
from lidarpose.models.config import SIZES, NetworkConfig
from lidarpose.models.dapt.dapt_config import CONFIGS, FAULTS, DaptConfig
from lidarpose.models.expand import expand_weights
from lidarpose.models.posenet import PoseNet
from lidarpose.skeleton import HUMAN15, SMPL24, Skeleton
from lidarpose.train.objectives.baseline_objective import with_joints
from lidarpose.train.objectives.dapt_objective import REDUCED, finetuning_config, pretraining_config
from lidarpose.train.objectives.dapt_transfer import transferred
from lidarpose.train.recipes import MODELS, PAPER, RANDOM, Finetune, Pretrain

Config = NetworkConfig | DaptConfig | BaselineConfig
# options of the paper's network besides the faults of the released code
_OPTIONS = ("anchor_dropout",)

# by size: the configuration of a network before fine-tuning, and the skeleton in which validation people are drawn
PRETRAINED: dict[str, tuple[Any, Skeleton]] = {
    **{size: (config, SMPL24) for size, config in SIZES.items()},
    PAPER: (pretraining_config(), HUMAN15),
    **{size: (reduce_config(pretraining_config()), HUMAN15) for size, reduce_config in REDUCED.items()},
    "prn": (PrnConfig(), HUMAN15),
    "lpformer": (LpformerConfig(), HUMAN15),
    "lidarcap": (LidarcapConfig(), SMPL24),
    "ne": (NeConfig(), SMPL24),
    # each trains on 200,000 people within one to two hours on one core, the tiny ones within one hour
    "prn-small": (PrnConfig(width_divisor=4, most_points=128), HUMAN15),
    "prn-tiny": (PrnConfig(width_divisor=8, most_points=128, attention_dropout=0.0), HUMAN15),
    "lpformer-small": (LpformerConfig(width_divisor=4, most_points=128, grid=16, attention_dropout=0.0), HUMAN15),
    "lpformer-tiny": (LpformerConfig(width_divisor=8, most_points=128, grid=16, attention_dropout=0.0), HUMAN15),
    "lidarcap-small": (LidarcapConfig(width_divisor=8, most_points=128), SMPL24),
    "lidarcap-tiny": (LidarcapConfig(width_divisor=8, most_points=64), SMPL24),
    "ne-small": (NeConfig(width_divisor=8, most_points=128), SMPL24),
    "ne-tiny": (NeConfig(width_divisor=8, most_points=64), SMPL24),
}


def networks() -> list[dict[str, Any]]:
    """Name, size, joints, frames and number of parameters of every network, by model, then by parameters; no weights
    are loaded."""
    rows = []
    for name, sizes in MODELS.items():
        for size in sizes:
            config = PRETRAINED[size][0]
            with torch.device("meta"):
                parameters = sum(value.numel() for value in build(config).parameters())
            frames = getattr(config, "frames", 1)
            counts = {"joints": len(config.joints), "frames": frames, "parameters": parameters}
            rows.append({"name": name, "size": size} | counts)
    return sorted(rows, key=lambda row: (list(MODELS).index(row["name"]), row["parameters"]))


def pretraining_network(recipe: Pretrain) -> tuple[Any, Skeleton]:
    """The configuration of a network to pre-train, and the skeleton in which validation people are drawn."""
    check_name("network size", recipe.size, PRETRAINED)
    config, joints = PRETRAINED[recipe.size]
    if recipe.objects:
        if not isinstance(config, NetworkConfig):
            raise InputError(
                f"objects are for the package's own networks, and {recipe.size} is not one of them: omit objects"
            )
        config = replace(config, person=True)
        if recipe.shards:
            raise InputError("objects are made during training, and shards have none: omit objects or shards")
    if recipe.whole_scans and (recipe.shards or not isinstance(config, NetworkConfig)):
        reason = "are made during training" if recipe.shards else "are for the package's own networks"
        raise InputError(f"whole_scans {reason}: omit whole_scans or {'shards' if recipe.shards else recipe.size}")
    if (recipe.neck, recipe.head, recipe.drop_path) != ("mde", "coordinates", None):
        config = _with_neck_and_head(recipe, config)
    check_rates(recipe, config)
    return _with_options(config, recipe.options), joints


def expanded_network(init: str, config: Config) -> tuple[Callable[[], nn.Module], dict]:
    """A factory for networks of `config` initialized with the weights `init`, and the card of these weights."""
    if not isinstance(config, NetworkConfig):
        raise InputError(f"init is for the package's own networks: {config.kind} starts from random weights")
    path = weights_path(init)
    small_network, header = load_checkpoint(path)
    if not isinstance(small_network, PoseNet) or not header.config.poses:
        raise file_error(
            path, f"contains the network {header.config.name}: --init needs one of the package's own pose networks"
        )
    # tried now, so that an error is raised before a run folder is made
    expand_weights(small_network, config)
    return partial(expand_weights, small_network, config), header.card


def initial_network(recipe: Finetune) -> tuple[Any, dict]:
    """The network that fine-tuning starts from, None for random weights, and its entries for the card."""
    if recipe.init == RANDOM:
        check_name("network size", recipe.size, PRETRAINED)
        return None, {"init": RANDOM, "init_card": {}}
    path = weights_path(recipe.init)
    trained, header = load_checkpoint(path)
    if not header.config.poses:
        raise file_error(
            path, f"contains the network {header.config.name}, which predicts no poses: give weights of a pose network"
        )
    if recipe.model and header.network != PRETRAINED[MODELS[recipe.model][0]][0].kind:
        raise file_error(path, f"contains the network {header.config.name}, not {recipe.model}: give another one")
    return trained, {"init": path.name, "init_card": header.card}


def finetuned_network(
    recipe: Finetune, trained: Any, joints: Skeleton, dataset: str
) -> tuple[Config, Callable[[], nn.Module]]:
    """The configuration for a dataset's joints, and a factory for the network with its initial weights.

    trained: the network to start from, None for random weights.
    """
    base_config = PRETRAINED[recipe.size][0] if trained is None else trained.config
    # keep_anchors for the package's own networks has its own error below, which says what to do instead
    dapt_settings = ("neck", "head", "keep_anchors") if isinstance(base_config, BaselineConfig) else ("neck", "head")
    for name in () if isinstance(base_config, DaptConfig) else dapt_settings:
        if getattr(recipe, name) != getattr(Finetune, name):
            raise InputError(f"{name} is an option of the paper's network, {base_config.name} has none: omit it")
    if isinstance(base_config, BaselineConfig):
        baseline = (
            base_config if isinstance(base_config, LidarcapConfig) else replace(base_config, joints=joints.joints)
        )
        config = _with_options(baseline, recipe.options)
        if trained is not None and config.width_divisor != base_config.width_divisor:
            raise InputError(f"--init has weights for width_divisor={base_config.width_divisor}: omit that option")
        return config, partial(build, config) if trained is None else partial(with_joints, trained, config)
    base_config = _with_options(base_config, recipe.options)
    if trained is not None and base_config != trained.config:
        raise InputError("--init has weights that were trained without these options: omit --options")
    if isinstance(base_config, NetworkConfig):
        if not recipe.keep_anchors and trained is not None:
            raise InputError(
                "keep_anchors=false is for the paper's network, and --init gives one of the package's own: give a "
                "checkpoint of pretrain --recipe paper, or omit --recipe paper and --keep-anchors"
            )
        return base_config, partial(PoseNet, base_config) if trained is None else partial(deepcopy, trained)
    if not dataset:
        # synthesized people have every joint; the paper's network keeps the joints of its pre-training
        joints = HUMAN15
    candidates = [c for c in CONFIGS.values() if c.bins and set(c.joints) == set(joints.joints)]
    if not candidates:
        raise InputError(f"the paper's network has no configuration for the joints of {joints.name}")
    template = next((c for c in candidates if c.name == dataset), candidates[0])
    if trained is None:
        base_config = _with_neck(replace(base_config, bins=(), ranges=(), coordinates=True), recipe.neck)
    # the paper fine-tunes with heatmaps only, in Table 3 also with coordinates; the neck prn has only coordinates
    coordinates = recipe.head == "coordinates" or base_config.neck == "prn"
    bins, ranges = ((), ()) if coordinates else (template.bins, template.ranges)
    is_same = (base_config.joints, base_config.bins, base_config.ranges) == (template.joints, bins, ranges)
    if trained is not None and recipe.keep_anchors and is_same and not (coordinates and base_config.parts):
        # the network already fits this dataset, as released ones do
        return base_config, partial(deepcopy, trained)
    heads: dict[str, Any] = {"parts": 0, "coordinates": coordinates, "auxiliary": base_config.auxiliary_loss}
    config = replace(base_config, name=template.name, joints=template.joints, bins=bins, ranges=ranges, **heads)
    if trained is None:
        return config, partial(build, config)
    return config, partial(transferred, trained, config, keep_anchors=recipe.keep_anchors)


def check_rates(recipe: Pretrain | Finetune, config: Config) -> None:
    """Raises InputError for a learning rate of layers that the network does not have, and for Adam in place of Muon."""
    if recipe.heatmap_rate != 1 and not (isinstance(config, DaptConfig) and config.bins):
        raise InputError(f"heatmap_rate is for the paper's network with heatmaps, {config.name} has none: omit it")
    if recipe.muon_rate not in (0, type(recipe).muon_rate) and not isinstance(config, NetworkConfig):
        raise InputError(f"muon_rate is for the package's own networks, {config.name} is not one of them: omit it")
    if recipe.optimizer != "adamw" and recipe.muon_rate and isinstance(config, NetworkConfig):
        raise InputError(f"{config.name} is trained by Muon and AdamW: omit --optimizer, or add --muon-rate 0")


def _with_options(config: Any, options: tuple[str, ...]) -> Any:
    """A configuration with options NAME=VALUE (JSON or text), or NAME for true.

    Options are fields of a baseline's configuration; for the paper's network faults of the released code, and the
    dropout of its neck. Raises InputError for unknown ones.
    """
    if not options:
        return config
    if isinstance(config, NetworkConfig):
        raise InputError(f"options are for the paper's networks, {config.name} has none: omit --options")
    is_baseline = isinstance(config, BaselineConfig)
    names = [field.name for field in fields(config) if field.name != "joints"] if is_baseline else [*FAULTS, *_OPTIONS]
    changes: dict[str, Any] = {}
    for option in options:
        name, _, value = option.partition("=")
        check_name(f"option of {config.name}", name, names)
        changes[name] = value or True
        with suppress(ValueError):
            changes[name] = json.loads(value)
    config = replace(config, **changes)
    # where heatmaps are learned in one stage, so is the auxiliary head
    is_one_stage = isinstance(config, DaptConfig) and bool(config.bins) and config.auxiliary_loss
    return replace(config, auxiliary=True) if is_one_stage else config


def _with_neck_and_head(recipe: Pretrain, config: NetworkConfig | DaptConfig) -> DaptConfig:
    """The paper's network with the recipe's neck, head and drop_path."""
    if not isinstance(config, DaptConfig):
        raise InputError(
            f"neck, head and drop_path are options of the paper's network: add --size {' or '.join(MODELS['dapt'])}"
        )
    if recipe.head == "heatmaps":
        if recipe.neck == "prn":
            raise InputError("the neck prn has coordinates and no heatmaps: omit --head")
        heatmaps = finetuning_config("humanm3")
        config = REDUCED[recipe.size](heatmaps) if recipe.size in REDUCED else heatmaps
    drop_path = config.drop_path if recipe.drop_path is None else recipe.drop_path
    return _with_neck(replace(config, drop_path=drop_path), recipe.neck)


def _with_neck(config: DaptConfig, neck: str) -> DaptConfig:
    return replace(config, neck=neck, parts=0 if neck == "prn" else config.parts)
