"""What a recipe comes to: the task, where people come from, the weights to begin with, whom to validate on."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from torch import nn

from lidarpose.data.shards import read_card
from lidarpose.errors import InputError, check_name
from lidarpose.io.files import file_error
from lidarpose.models.checkpoint import Header
from lidarpose.models.config import SIZES, NetworkConfig, preset
from lidarpose.models.dapt.dapt_config import CONFIGS
from lidarpose.models.expand import expand_weights
from lidarpose.models.posenet import PoseNet
from lidarpose.skeleton import HUMAN15, SMPL24, Skeleton, skeleton
from lidarpose.train.augment import Augmentation, augmentation, augmented
from lidarpose.train.example import Example
from lidarpose.train.labeled_dataset import InMemoryDataset
from lidarpose.train.objective import Objective
from lidarpose.train.posenet_objective import PoseNetObjective
from lidarpose.train.recipes import PAPER, SMALL_PAPER, Finetune, Pretrain, Recipe
from lidarpose.train.run_dir import folder_names
from lidarpose.train.sources import MixedSource, Source, StoredSource, SyntheticSource

# people to validate on; synthesized ones are of a seed that no run learns from
VALIDATION = 256
_VALIDATION_SEED = 2**31 - 7
_UNWATCHED = "nobody is left to validate on: no split val, and no sequence is held out (--hold-out, or too few of them)"
# of fewer sequences none is held out
_LEAST_SEQUENCES = 3


@dataclass(frozen=True, kw_only=True)
class TrainSetup:
    """people: how many are seen in all; validation: whom to validate on, made once, none for nobody; joints: the
    skeleton to draw them in; card: what the checkpoint tells besides the recipe; warnings: lines for the user."""

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


def make_setup(recipe: Recipe, *, on_cpu: bool = True) -> TrainSetup:
    """on_cpu: where the network will run, which decides the layout of the paper's tables. Raises InputError, one line,
    where the recipe names what is not there."""
    setup = _pretraining(recipe) if isinstance(recipe, Pretrain) else _finetuning(recipe)
    if isinstance(setup.task, PoseNetObjective) or on_cpu:
        return setup
    return replace(setup, task=replace(setup.task, layout="padded"))


def _pretraining(recipe: Pretrain) -> TrainSetup:
    if recipe.size in (PAPER, SMALL_PAPER):
        from lidarpose.train.dapt_objective import DaptObjective, pretraining_config, small

        config = pretraining_config()
        task = DaptObjective(config=config if recipe.size == PAPER else small(config), stage="pretrain")
    else:
        check_name("network size", recipe.size, (*SIZES, PAPER, SMALL_PAPER))
        task = PoseNetObjective(config=preset(recipe.size), bone=recipe.bone, symmetry=recipe.symmetry)
    names = ("scene", "motion", "subjects", "captured", "strays", "noise")
    scene = {name: getattr(recipe, name) for name in names}
    warnings: tuple[str, ...] = ()
    if recipe.shards:
        _check_no_test(recipe.shards)
        dataset = InMemoryDataset.load(recipe.shards)
        worse = {"strays": recipe.strays, "noise": recipe.noise}
        source = StoredSource(dataset=dataset, seed=recipe.seed, augmentation=Augmentation(turn=1.0, flip=0.5), **worse)
        warnings = _about(dataset)
    else:
        source = SyntheticSource(seed=recipe.seed, easy=recipe.easy * recipe.people, **scene)

    def validation() -> list[Example]:
        # as a user's cloud: centered on its points
        held_out = SyntheticSource(seed=_VALIDATION_SEED, refined=0.0, **scene)
        return [held_out.example(index) for index in range(VALIDATION)]

    joints = SMPL24 if isinstance(task, PoseNetObjective) else HUMAN15
    card = {"motion": None if recipe.motion is None else Path(recipe.motion).name}
    network = task.network
    if recipe.init:
        network, card["init_card"] = _expanded(recipe.init, task.config)
    return TrainSetup(
        task=task,
        source=source,
        people=recipe.people,
        network=network,
        validation=validation,
        joints=joints,
        card=card,
        warnings=warnings,
    )


def _check_no_test(shards: tuple[str, ...]) -> None:
    """Raises InputError for people of whom some are kept for testing: pre-training takes everybody."""
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
    from lidarpose.models import weights_path
    from lidarpose.models.checkpoint import load_checkpoint

    path = weights_path(init)
    smaller, header = load_checkpoint(path)
    if not isinstance(smaller, PoseNet):
        raise file_error(path, "holds the paper's network: --init names one of the package's own")
    # tried at once, so that what does not fit is told before a folder is made
    expand_weights(smaller, config)
    return partial(expand_weights, smaller, config), header.card


def _about(dataset: InMemoryDataset) -> tuple[str, ...]:
    """What is left out of a dataset, in a line."""
    if not dataset.damaged:
        return ()
    first, more = dataset.damaged[0], len(dataset.damaged) - 1
    return (f"left out {len(dataset.damaged)} damaged shards: {first}" + (f", and {more} more" if more else ""),)


def _finetuning(recipe: Finetune) -> TrainSetup:
    from lidarpose.models import weights_path
    from lidarpose.models.checkpoint import load_checkpoint

    path = weights_path(recipe.init)
    network, header = load_checkpoint(path)
    split = None if recipe.split == "all" else recipe.split
    kind = augmentation(recipe.augment)
    everybody = InMemoryDataset.load(recipe.data, split=split, interval=recipe.interval)
    held_out, watched = _held_out(recipe, split, everybody)
    dataset = everybody.without(held_out)
    people = StoredSource(dataset=dataset, seed=recipe.seed, augmentation=kind)
    source: Source = people
    if recipe.mix:
        other = SyntheticSource(scene=recipe.scene, seed=recipe.seed)
        source = MixedSource(main=people, other=other, share=recipe.mix)
    joints = skeleton(dataset.skeleton)
    task, begun = _begun(recipe, network, header, joints, dataset.dataset)

    def validation() -> list[Example]:
        # a box with a detector's errors where people have one, centered on the points
        quiet = Augmentation(released=kind.released, box=kind.box, refined=0.0)
        rows = np.unique(np.linspace(0, len(watched) - 1, min(VALIDATION, len(watched))).astype(int)) if watched else ()
        return [augmented(watched.sample(k), quiet, np.random.default_rng([recipe.seed, k])) for k in rows]

    return TrainSetup(
        task=task,
        source=source,
        # those that are mixed in come on top
        people=max(round(recipe.epochs * len(dataset) / (1 - recipe.mix)), 1),
        network=begun,
        validation=validation,
        joints=joints,
        card={
            "init": path.name,
            "init_card": header.card,
            "data": folder_names(recipe.data),
            "held_out_sequences": list(held_out),
            "damaged": list(dataset.damaged),
        },
        warnings=_about(dataset) + (() if watched else (_UNWATCHED,)),
    )


def _held_out(
    recipe: Finetune, split: str | None, everybody: InMemoryDataset
) -> tuple[tuple[str, ...], InMemoryDataset | None]:
    """Sequences not to learn from, and whom to validate on: the split val where there is one, else those sequences."""
    if split not in (None, "val"):
        # there may be no such split
        with suppress(InputError):
            return (), InMemoryDataset.load(recipe.data, split="val", interval=recipe.interval)
    if not recipe.hold_out or len(everybody.sequences) < _LEAST_SEQUENCES:
        return (), None
    number = max(round(recipe.hold_out * len(everybody.sequences)), 1)
    if number == len(everybody.sequences):
        raise InputError(f"hold_out = {recipe.hold_out} leaves nobody to learn from: lower it")
    learned, held_out = everybody.sequences[:-number], everybody.sequences[-number:]
    return held_out, everybody.without(learned)


def _begun(
    recipe: Finetune, network: nn.Module, header: Header, joints: Skeleton, dataset: str
) -> tuple[Objective, Callable[[], nn.Module]]:
    """The task and the network with the weights that it begins with."""
    if header.network == "pose":
        if not recipe.keep_anchors:
            raise InputError(
                "keep_anchors=false is for the paper's network, and --init names one of the package's own: name a "
                "checkpoint of pretrain --recipe paper, or leave --recipe paper and --keep-anchors away"
            )
        return PoseNetObjective(config=header.config, bone=recipe.bone, symmetry=recipe.symmetry), lambda: network
    from lidarpose.train.dapt_objective import DaptObjective, transferred

    recipe.check_no_lengths()
    alike = [c for c in CONFIGS.values() if c.bins and set(c.joints) == set(joints.joints)]
    if not alike:
        raise InputError(f"the paper's network has no configuration for the joints of {joints.name}")
    like = next((c for c in alike if c.name == dataset), alike[0])
    own = header.config
    if recipe.keep_anchors and (own.joints, own.bins, own.ranges) == (like.joints, like.bins, like.ranges):
        # a network of this dataset already, as released ones are
        return DaptObjective(config=own, stage="finetune"), lambda: network
    # the paper fine-tunes by heatmaps alone
    config = replace(
        header.config,
        name=like.name,
        joints=like.joints,
        bins=like.bins,
        ranges=like.ranges,
        parts=0,
        coordinates=False,
        auxiliary=False,
    )
    return (
        DaptObjective(config=config, stage="finetune"),
        lambda: transferred(network, config, keep_anchors=recipe.keep_anchors),
    )
