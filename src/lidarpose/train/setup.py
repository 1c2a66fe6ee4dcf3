"""What a recipe means: the objective, the source of samples, the initial weights, and the validation samples."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from torch import nn

from lidarpose.data.shards import read_card
from lidarpose.errors import InputError, check_name
from lidarpose.io.files import file_error
from lidarpose.models import weights_path
from lidarpose.models.checkpoint import load_checkpoint
from lidarpose.models.config import SIZES, NetworkConfig, preset
from lidarpose.models.dapt.dapt_config import CONFIGS
from lidarpose.models.dapt.dapt_net import DaptNet
from lidarpose.models.posenet import PoseNet, expand_weights
from lidarpose.skeleton import HUMAN15, SMPL24, Skeleton, skeleton
from lidarpose.train.augment import Augmentation, Example, augmentation, augmented
from lidarpose.train.data_loader import MixedSource, Source, StoredSource, SyntheticSource
from lidarpose.train.objectives.dapt_objective import DaptObjective, pretraining_config, small
from lidarpose.train.objectives.dapt_transfer import transferred
from lidarpose.train.objectives.objective import Objective
from lidarpose.train.objectives.posenet_objective import PoseNetObjective
from lidarpose.train.recipes import PAPER, SMALL_PAPER, Finetune, Pretrain
from lidarpose.train.run_dir import folder_names
from lidarpose.train.torch_dataset import InMemoryDataset

# samples to validate on; synthetic ones are of a seed that no run learns from
VALIDATION = 256
_VALIDATION_SEED = 2**31 - 7
_NO_VALIDATION = (
    "nobody is left to validate on: no split val, and no sequence is held out (--hold-out, or too few of them)"
)
# of fewer sequences none is held out
_LEAST_SEQUENCES = 3


@dataclass(frozen=True, kw_only=True)
class TrainSetup:
    """people: how many samples are seen in all; validation: makes those to validate on, once, none for no validation;
    joints: the skeleton to draw them in; card: what the checkpoint says besides the recipe; warnings: for the user."""

    task: Objective
    source: Source
    people: int
    network: Callable[[], nn.Module]
    validation: Callable[[], list[Example]]
    joints: Skeleton
    card: dict
    warnings: tuple[str, ...] = ()


# the name in 0.2
Job = TrainSetup


def make_setup(recipe: Pretrain | Finetune, *, on_cpu: bool = True) -> TrainSetup:
    """on_cpu: where the network will run, which decides the layout of the paper's tables. Raises InputError, one line,
    where the recipe names what is not there."""
    layout = "ragged" if on_cpu else "padded"
    return _pretraining(recipe, layout) if isinstance(recipe, Pretrain) else _finetuning(recipe, layout)


def _pretraining(recipe: Pretrain, layout: str) -> TrainSetup:
    check_name("network size", recipe.size, (*SIZES, PAPER, SMALL_PAPER))
    card: dict = {"motion": None if recipe.motion is None else Path(recipe.motion).name}
    task: Objective
    if recipe.size in SIZES:
        config = preset(recipe.size)
        task = PoseNetObjective(config=config, bone=recipe.bone, symmetry=recipe.symmetry)
        network: Callable[[], nn.Module] = task.network
        if recipe.init:
            network, card["init_card"] = _expanded(recipe.init, config)
    else:
        paper = pretraining_config()
        task = DaptObjective(config=paper if recipe.size == PAPER else small(paper), stage="pretrain", layout=layout)
        network = task.network

    names = ("scene", "motion", "subjects", "captured", "strays", "noise")
    synthetic: dict[str, Any] = {name: getattr(recipe, name) for name in names}

    def validation() -> list[Example]:
        # as a user's cloud: centered on its points
        held_out = SyntheticSource(seed=_VALIDATION_SEED, refined=0.0, **synthetic)
        return [held_out.example(index) for index in range(VALIDATION)]

    warnings: tuple[str, ...] = ()
    source: Source
    if recipe.shards:
        _check_no_test(recipe.shards)
        dataset = InMemoryDataset.load(recipe.shards)
        source = StoredSource(
            dataset=dataset,
            seed=recipe.seed,
            augmentation=Augmentation(turn=1.0, flip=0.5),
            strays=recipe.strays,
            noise=recipe.noise,
        )
        warnings = _damage(dataset)
    else:
        source = SyntheticSource(seed=recipe.seed, easy=recipe.easy * recipe.people, **synthetic)
    return TrainSetup(
        task=task,
        source=source,
        people=recipe.people,
        network=network,
        validation=validation,
        joints=SMPL24 if recipe.size in SIZES else HUMAN15,
        card=card,
        warnings=warnings,
    )


def _check_no_test(shards: tuple[str, ...]) -> None:
    """Raises InputError for datasets of which a part is kept for testing: pre-training takes every sample."""
    for folder in shards:
        settings = read_card(folder).settings
        if settings.get("split_by") and settings.get("split") != "train":
            raise file_error(
                folder,
                f"has people for testing, by the split {settings['split_by']}, and pre-training takes everybody: "
                "prepare it with --split train, or learn from it by lidarpose finetune",
            )


def _expanded(init: str, config: NetworkConfig) -> tuple[Callable[[], nn.Module], dict]:
    """What makes a network of this configuration that begins as the weights named, and their card."""
    path = weights_path(init)
    smaller, header = load_checkpoint(path)
    if not isinstance(smaller, PoseNet):
        raise file_error(path, "holds the paper's network: --init names one of the package's own")
    # tried at once, so that an error comes before a folder is made
    expand_weights(smaller, config)
    return partial(expand_weights, smaller, config), header.card


def _damage(dataset: InMemoryDataset) -> tuple[str, ...]:
    """What is left out of a dataset, in a line."""
    if not dataset.damaged:
        return ()
    first, more = dataset.damaged[0], len(dataset.damaged) - 1
    return (f"left out {len(dataset.damaged)} damaged shards: {first}" + (f", and {more} more" if more else ""),)


def _finetuning(recipe: Finetune, layout: str) -> TrainSetup:
    path = weights_path(recipe.init)
    network, header = load_checkpoint(path)
    split = None if recipe.split == "all" else recipe.split
    kind = augmentation(recipe.augment)
    full = InMemoryDataset.load(recipe.data, split=split, interval=recipe.interval)
    held_out, watched = _held_out(recipe, split, full)
    dataset = full.without(held_out)
    source: Source = StoredSource(dataset=dataset, seed=recipe.seed, augmentation=kind)
    if recipe.mix:
        synthetic = SyntheticSource(scene=recipe.scene, seed=recipe.seed)
        source = MixedSource(main=source, other=synthetic, share=recipe.mix)
    joints = skeleton(dataset.skeleton)
    task, initial = _initial(recipe, network, joints, dataset.dataset, layout)

    def validation() -> list[Example]:
        if watched is None:
            return []
        # a box with a detector's errors where there is one, centered on the points
        quiet = Augmentation(released=kind.released, box=kind.box, refined=0.0)
        rows = np.unique(np.linspace(0, len(watched) - 1, min(VALIDATION, len(watched))).astype(int))
        return [augmented(watched.sample(k), quiet, np.random.default_rng([recipe.seed, k])) for k in rows]

    return TrainSetup(
        task=task,
        source=source,
        # those that are mixed in come on top
        people=max(round(recipe.epochs * len(dataset) / (1 - recipe.mix)), 1),
        network=initial,
        validation=validation,
        joints=joints,
        card={
            "init": path.name,
            "init_card": header.card,
            "data": folder_names(recipe.data),
            "held_out_sequences": list(held_out),
            "damaged": list(dataset.damaged),
        },
        warnings=_damage(dataset) + ((_NO_VALIDATION,) if watched is None else ()),
    )


def _held_out(
    recipe: Finetune, split: str | None, full: InMemoryDataset
) -> tuple[tuple[str, ...], InMemoryDataset | None]:
    """Sequences not to learn from, and what to validate on: the split val where there is one, else those sequences."""
    if split not in (None, "val"):
        # there may be no such split
        with suppress(InputError):
            return (), InMemoryDataset.load(recipe.data, split="val", interval=recipe.interval)
    if not recipe.hold_out or len(full.sequences) < _LEAST_SEQUENCES:
        return (), None
    number = max(round(recipe.hold_out * len(full.sequences)), 1)
    if number == len(full.sequences):
        raise InputError(f"hold_out = {recipe.hold_out} leaves nobody to learn from: lower it")
    return full.sequences[-number:], full.without(full.sequences[:-number])


def _initial(
    recipe: Finetune, network: PoseNet | DaptNet, joints: Skeleton, dataset: str, layout: str
) -> tuple[Objective, Callable[[], nn.Module]]:
    """The objective, and what makes the network with the weights that it begins with."""
    if isinstance(network, PoseNet):
        if not recipe.keep_anchors:
            raise InputError(
                "keep_anchors=false is for the paper's network, and --init names one of the package's own: name a "
                "checkpoint of pretrain --recipe paper, or leave --recipe paper and --keep-anchors away"
            )
        return PoseNetObjective(config=network.config, bone=recipe.bone, symmetry=recipe.symmetry), lambda: network
    recipe.check_no_lengths()
    fitting = [c for c in CONFIGS.values() if c.bins and set(c.joints) == set(joints.joints)]
    if not fitting:
        raise InputError(f"the paper's network has no configuration for the joints of {joints.name}")
    like, own = next((c for c in fitting if c.name == dataset), fitting[0]), network.config
    if recipe.keep_anchors and (own.joints, own.bins, own.ranges) == (like.joints, like.bins, like.ranges):
        # a network of this dataset already, as released ones are
        return DaptObjective(config=own, stage="finetune", layout=layout), lambda: network
    # the paper fine-tunes by heatmaps alone
    heads: dict[str, Any] = {"parts": 0, "coordinates": False, "auxiliary": False}
    config = replace(own, name=like.name, joints=like.joints, bins=like.bins, ranges=like.ranges, **heads)
    return (
        DaptObjective(config=config, stage="finetune", layout=layout),
        partial(transferred, network, config, keep_anchors=recipe.keep_anchors),
    )
