"""What a recipe means: the objective, the source of samples, the initial weights, and the validation samples.

To train a further kind of network of `models.NETWORKS`: its sizes in `PRETRAINED`, its objective's settings in
`objective_of`, its recipes in `recipes.RECIPES`.
"""

import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from lidarpose.data.shards import read_card
from lidarpose.errors import InputError, check_name
from lidarpose.io.files import file_error
from lidarpose.models import NETWORKS, weights_path
from lidarpose.models.baselines.baseline_config import (
    BaselineConfig,
    LidarcapConfig,
    LpformerConfig,
    NeConfig,
    PrnConfig,
)
from lidarpose.models.checkpoint import build, load_checkpoint
from lidarpose.models.config import SIZES, NetworkConfig
from lidarpose.models.dapt.dapt_config import CONFIGS, DaptConfig
from lidarpose.models.detector.detector import detector_path
from lidarpose.models.detector.detector_config import DetectorConfig
from lidarpose.models.posenet import PoseNet, expand_weights
from lidarpose.skeleton import HUMAN15, SMPL24, Skeleton, skeleton
from lidarpose.train.augment import Augmentation, ClipExample, Example, augmentation, augmented
from lidarpose.train.data_loader import BATCHES, ClipSource, MixedSource, Source, StoredSource, SyntheticSource
from lidarpose.train.detector.candidate_source import CandidateSource, validation_scans
from lidarpose.train.objectives.baseline_objective import with_joints
from lidarpose.train.objectives.dapt_objective import REDUCED, finetuning_config, pretraining_config
from lidarpose.train.objectives.dapt_transfer import transferred
from lidarpose.train.objectives.detector_objective import DetectorObjective, missed_people
from lidarpose.train.objectives.objective import Objective
from lidarpose.train.recipes import (
    MODELS,
    PAPER,
    RANDOM,
    Finetune,
    PoseRecipe,
    Pretrain,
    Recipe,
    TrainDetector,
)
from lidarpose.train.run_dir import folder_names
from lidarpose.train.torch_dataset import InMemoryDataset
from lidarpose.train.validation import validate

# samples to validate on; synthetic ones are of a seed that no run learns from
VALIDATION = 256
_VALIDATION_SEED = 2**31 - 7
_NO_VALIDATION = (
    "nobody is left to validate on: no split val, and no sequence is held out (--hold-out, or too few of them)"
)
# of fewer sequences none is held out
_LEAST_SEQUENCES = 3
# chunks of a run between two times that a scan is shown: divides by the usual numbers of workers
_LAG = 12
# share of objects among the synthesized people of fine-tuning, for a network that says whether somebody is there
_OBJECTS = 0.2


Config = NetworkConfig | DaptConfig | BaselineConfig

# by size: the configuration of a network before fine-tuning, and the skeleton in which its people are drawn
PRETRAINED: dict[str, tuple[Any, Skeleton]] = {
    **{size: (config, SMPL24) for size, config in SIZES.items()},
    PAPER: (pretraining_config(), HUMAN15),
    **{size: (reduced(pretraining_config()), HUMAN15) for size, reduced in REDUCED.items()},
    "prn": (PrnConfig(), HUMAN15),
    "lpformer": (LpformerConfig(), HUMAN15),
    "lidarcap": (LidarcapConfig(), SMPL24),
    "ne": (NeConfig(), SMPL24),
    # each sees 200,000 people within one or two hours of one core, of the tiny ones within one
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
    """name, size, joints, frames and parameters of every network, without its weights, a model's by parameters."""
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


@dataclass(frozen=True, kw_only=True)
class TrainSetup:
    """people: how many samples are seen in all; validation: makes those to validate on, once, none for no validation;
    joints: the skeleton to draw them in, None for no pictures; card: what the checkpoint says besides the recipe;
    warnings: for the user; frames: of an example, each of which counts as one of `people`; unit: what these are;
    validate: called with (objective, network, examples, batch), the error of a network in evaluation mode, in
    `error_unit`, and the joints to draw, if any."""

    objective: Objective
    source: Source
    people: int
    network: Callable[[], nn.Module]
    validation: Callable[[], Sequence[Any]]
    joints: Skeleton | None
    card: dict
    warnings: tuple[str, ...] = ()
    frames: int = 1
    unit: str = "people"
    validate: Callable[..., tuple[float, np.ndarray | None]] = validate
    error_unit: str = "mm"

    @property
    def task(self) -> Objective:
        """The name of `objective` in 0.2."""
        return self.objective


def Job(*, task: Objective, **settings: Any) -> TrainSetup:  # noqa: N802
    """`TrainSetup` by its name in 0.2."""
    return TrainSetup(objective=task, **settings)


def objective_of(config: Config, recipe: PoseRecipe, layout: str = "ragged") -> Objective:
    """What a network of a configuration minimizes: its entry in `models.NETWORKS`, by its settings of a recipe.
    layout: of the paper's tables."""
    lengths = {"bone": recipe.bone, "symmetry": recipe.symmetry}
    # what a baseline is shown beside what happens to examples
    shift = augmentation(recipe.augment).shift if isinstance(recipe, Finetune) else 0.0
    # heatmaps are learned the same way in both stages
    stage = "finetune" if isinstance(config, DaptConfig) and config.bins else recipe.kind
    of_kind: dict[str, dict] = {"pose": lengths, "dapt": {"stage": stage, "layout": layout}}
    of_kind |= dict.fromkeys(("prn", "lpformer"), {"shift": shift}) | dict.fromkeys(("lidarcap", "ne"), {})
    settings = of_kind[config.kind]
    if "prn" in (config.kind, getattr(config, "neck", "")) and recipe.batch < 2:
        raise InputError("batch must be at least 2 for prn, whose batch norms see a few points a person, got 1")
    if settings is not lengths and any(lengths.values()):
        raise InputError("bone and symmetry are terms of the package's own networks: leave them at 0")
    return NETWORKS[config.kind].part("objective")(config=config, **settings)


def make_setup(recipe: Recipe, *, on_cpu: bool = True) -> TrainSetup:
    """on_cpu: where the network will run, which decides the layout of the paper's tables. Raises InputError, one line,
    where the recipe names what is not there."""
    layout = "ragged" if on_cpu else "padded"
    if isinstance(recipe, TrainDetector):
        return _detection(recipe)
    if isinstance(recipe, Pretrain):
        return _pretraining(recipe, layout)
    assert isinstance(recipe, Finetune)
    return _finetuning(recipe, layout)


def _detection(recipe: TrainDetector) -> TrainSetup:
    objective = DetectorObjective(config=DetectorConfig())
    network: Callable[[], nn.Module] = objective.network
    card: dict = {}
    if recipe.init:
        path = detector_path(".safetensors") if recipe.init == "detector" else Path(recipe.init)
        trained, header = load_checkpoint(path)
        if header.config != objective.config:
            raise file_error(path, f"expected a detector as train-detector makes it, got a network {header.network}")
        network, card["init_card"] = partial(deepcopy, trained), header.card
    return TrainSetup(
        objective=objective,
        # a worker shows each scan again that it has made, for all usual numbers of workers
        source=CandidateSource(seed=recipe.seed, uses=recipe.uses, lag=_LAG * BATCHES * recipe.batch // recipe.uses),
        people=recipe.scenes * recipe.uses,
        network=network,
        validation=partial(validation_scans, _VALIDATION_SEED),
        joints=None,
        card=card,
        unit="scans",
        validate=missed_people,
        error_unit="missed",
    )


def _pretraining(recipe: Pretrain, layout: str) -> TrainSetup:
    check_name("network size", recipe.size, PRETRAINED)
    config, joints = PRETRAINED[recipe.size]
    config = _with_options(config, recipe.options)
    if recipe.objects:
        if not isinstance(config, NetworkConfig):
            raise InputError(
                f"objects are for the package's own networks, of which {recipe.size} is none: leave them away"
            )
        config = replace(config, person=True)
        if recipe.shards:
            raise InputError("objects are made during training, shards have none: leave either away")
    if (recipe.neck, recipe.head, recipe.drop_path) != ("mde", "coordinates", None):
        config = _switched(recipe, config)
    objective = objective_of(config, recipe, layout)
    network: Callable[[], nn.Module] = objective.network
    card: dict = {"motion": None if recipe.motion is None else Path(recipe.motion).name}
    if recipe.init:
        network, card["init_card"] = _expanded(recipe.init, config)
    names = ("scene", "set", "motion", "subjects", "captured", "body", "strays", "noise", "objects")
    synthetic: dict[str, Any] = {name: getattr(recipe, name) for name in names}

    def validation() -> Sequence[Example | ClipExample]:
        # as a user's cloud: centered on its points
        held_out = SyntheticSource(seed=_VALIDATION_SEED, refined=0.0, **(synthetic | {"objects": 0.0}))
        if isinstance(config, LidarcapConfig):
            clips = range(VALIDATION // config.frames)
            return [held_out.clip(index, trans_center=config.trans_center) for index in clips]
        return [held_out.example(index) for index in range(VALIDATION)]

    setup = TrainSetup(
        objective=objective,
        source=SyntheticSource(seed=recipe.seed, easy=recipe.easy * recipe.people, **synthetic),
        people=recipe.people,
        network=network,
        validation=validation,
        joints=joints,
        card=card,
    )
    is_clip = isinstance(config, LidarcapConfig)
    if is_clip and not recipe.shards:
        raise InputError(f"{config.name} learns from clips: name a folder of lidarpose synth --clips by --shards")
    if not recipe.shards:
        return setup
    for folder in recipe.shards:
        _check_no_test(folder)
    dataset = InMemoryDataset.load(recipe.shards)
    turned = Augmentation(turn=1.0, flip=0.5)
    noise = {"strays": recipe.strays, "noise": recipe.noise}
    if is_clip:
        return _of_clips(setup, replace(_clips(dataset, config, recipe), strays=recipe.strays, noise=recipe.noise))
    source = StoredSource(dataset=dataset, seed=recipe.seed, augmentation=turned, **noise)
    return replace(setup, source=source, warnings=_damage(dataset) + _no_parts(dataset))


def _switched(recipe: Pretrain, config: NetworkConfig | DaptConfig) -> DaptConfig:
    """The paper's network with the neck and the head that the recipe names."""
    if not isinstance(config, DaptConfig):
        raise InputError(
            f"neck, head and drop_path are of the paper's network: add --size {' or '.join(MODELS['dapt'])}"
        )
    if recipe.head == "heatmaps":
        if recipe.neck == "prn":
            raise InputError("the neck prn has coordinates and no heatmaps: leave --head away")
        heatmaps = finetuning_config("humanm3")
        config = REDUCED[recipe.size](heatmaps) if recipe.size in REDUCED else heatmaps
    drop_path = config.drop_path if recipe.drop_path is None else recipe.drop_path
    return _with_neck(replace(config, drop_path=drop_path), recipe.neck)


def _with_neck(config: DaptConfig, neck: str) -> DaptConfig:
    return replace(config, neck=neck, parts=0 if neck == "prn" else config.parts)


def _check_no_test(folder: str) -> None:
    """Raises InputError for a dataset of which a part is kept for testing: pre-training takes every sample."""
    settings = read_card(folder).settings
    if settings.get("split_by") and settings.get("split") != "train":
        raise file_error(
            folder,
            f"has people for testing, by the split {settings['split_by']}, and pre-training takes everybody: "
            "prepare it with --split train, or learn from it by lidarpose finetune",
        )


def _with_options(config: Any, options: tuple[str, ...]) -> Any:
    """A configuration with options NAME=VALUE (JSON or text), or NAME for true, of a baseline. Raises InputError for
    unknown ones."""
    if not options:
        return config
    if not isinstance(config, BaselineConfig):
        raise InputError(f"options are of the baselines' networks, {config.name} has none: leave --options away")
    known = [field.name for field in fields(config) if field.name != "joints"]
    changes: dict[str, Any] = {}
    for option in options:
        name, _, value = option.partition("=")
        check_name(f"option of {config.name}", name, known)
        changes[name] = value or True
        with suppress(ValueError):
            changes[name] = json.loads(value)
    return replace(config, **changes)


def _expanded(init: str, config: Config) -> tuple[Callable[[], nn.Module], dict]:
    """What makes a network of this configuration that begins as the weights named, and their card."""
    if not isinstance(config, NetworkConfig):
        raise InputError("init is for the package's own networks: the paper's begin at random")
    path = weights_path(init)
    smaller, header = load_checkpoint(path)
    if not isinstance(smaller, PoseNet):
        raise file_error(path, "holds a network of the paper: --init names one of the package's own")
    # tried at once, so that an error comes before a folder is made
    expand_weights(smaller, config)
    return partial(expand_weights, smaller, config), header.card


def _damage(dataset: InMemoryDataset) -> tuple[str, ...]:
    """What is left out of a dataset, in a line."""
    if not dataset.damaged:
        return ()
    first, more = dataset.damaged[0], len(dataset.damaged) - 1
    return (f"left out {len(dataset.damaged)} damaged shards: {first}" + (f", and {more} more" if more else ""),)


def _no_parts(dataset: InMemoryDataset) -> tuple[str, ...]:
    """A warning where points have no body parts, of which half of the loss of pre-training is."""
    if any(rows.num_rows and rows["part"].null_count < rows.num_rows for _, rows, _ in dataset.parts):
        return ()
    return ("no point of these datasets has a body part: the loss of parts (the paper's L_seg) is absent",)


def _finetuning(recipe: Finetune, layout: str) -> TrainSetup:
    trained, card = _initial(recipe)
    split = None if recipe.split == "all" else recipe.split
    kind = augmentation(recipe.augment)
    full = InMemoryDataset.load(recipe.data, split=split, interval=recipe.interval)
    held_out, watched = _held_out(recipe, split, full)
    dataset = full.without(held_out)
    joints = skeleton(dataset.skeleton)
    config, network = _finetuned(recipe, trained, joints, dataset.dataset)
    card |= {"data": folder_names(recipe.data), "held_out_sequences": list(held_out)}
    source: Source = StoredSource(dataset=dataset, seed=recipe.seed, augmentation=kind)
    if recipe.mix:
        synthetic = SyntheticSource(
            scene=recipe.scene, seed=recipe.seed, objects=_OBJECTS if getattr(config, "person", False) else 0.0
        )
        source = MixedSource(main=source, other=synthetic, share=recipe.mix)

    def validation() -> list[Example]:
        if watched is None:
            return []
        # a box with a detector's errors where there is one, centered on the points
        quiet = Augmentation(released=kind.released, box=kind.box, refined=0.0)
        rows = np.unique(np.linspace(0, len(watched) - 1, min(VALIDATION, len(watched))).astype(int))
        return [augmented(watched.sample(k), quiet, np.random.default_rng([recipe.seed, k])) for k in rows]

    setup = TrainSetup(
        objective=objective_of(config, recipe, layout),
        source=source,
        # those that are mixed in come on top
        people=max(round(recipe.epochs * len(dataset) / (1 - recipe.mix)), 1),
        network=network,
        validation=validation,
        joints=joints,
        card=card | {"damaged": list(dataset.damaged)},
        warnings=_damage(dataset) + ((_NO_VALIDATION,) if watched is None else ()),
    )
    if not isinstance(config, LidarcapConfig):
        return setup
    if recipe.mix or recipe.augment != "none":
        raise InputError(f"{config.name} learns from clips as they are: leave --mix at 0 and --augment at none")
    own = _clips(dataset, config, recipe)
    seen = None if watched is None else _clips(watched, config, recipe)
    people = max(round(recipe.epochs * len(own.clips)), 1) * config.frames
    watch = partial(seen.some, VALIDATION // config.frames) if seen is not None else list
    return replace(_of_clips(setup, own), people=people, validation=watch)


def _clips(dataset: InMemoryDataset, config: LidarcapConfig, recipe: Pretrain | Finetune) -> ClipSource:
    """The clips of a dataset. Raises InputError where it has none."""
    clips, skipped = dataset.clips()
    if not len(clips):
        reasons = "; ".join(f"{count:,} {reason}" for reason, count in skipped.items())
        raise InputError(
            f"{config.name} needs {config.frames} consecutive frames of a person with rotations, got none: {reasons}; "
            "lidarpose synth --clips writes some, and prepare of LiDARHuman26M and SLOPER4D"
        )
    return ClipSource(dataset=dataset, clips=clips, skipped=skipped, seed=recipe.seed, trans_center=config.trans_center)


def _of_clips(setup: TrainSetup, source: ClipSource) -> TrainSetup:
    """The setup that learns from clips instead."""
    config = setup.objective.config
    warnings = [f"left out {count:,} {reason}" for reason, count in source.skipped.items()]
    parts = source.dataset.parts
    if len(config.clouds) > 1 and all(rows["background"].null_count == rows.num_rows for _, rows, _ in parts):
        warnings.append(f"nothing is known of what stands about these people: {config.name} sees them alone")
    return replace(setup, source=source, frames=config.frames, warnings=(*setup.warnings, *warnings))


def _initial(recipe: Finetune) -> tuple[Any, dict]:
    """The network that fine-tuning goes on from, None for random weights, and what the card says of it."""
    if recipe.init == RANDOM:
        check_name("network size", recipe.size, PRETRAINED)
        return None, {"init": RANDOM, "init_card": {}}
    path = weights_path(recipe.init)
    trained, header = load_checkpoint(path)
    if not trained.config.joints:
        raise file_error(path, f"holds the network {header.network}, which poses nobody: name a checkpoint of another")
    if recipe.model and header.network != PRETRAINED[MODELS[recipe.model][0]][0].kind:
        raise file_error(path, f"holds the network {header.config.name}, not {recipe.model}: name a checkpoint of it")
    return trained, {"init": path.name, "init_card": header.card}


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


def _finetuned(
    recipe: Finetune, trained: Any, joints: Skeleton, dataset: str
) -> tuple[Config, Callable[[], nn.Module]]:
    """The configuration for a dataset's joints, and what makes the network with the weights that it begins with.
    trained: None for random weights."""
    own = PRETRAINED[recipe.size][0] if trained is None else trained.config
    if recipe.neck != "mde" and not isinstance(own, DaptConfig):
        raise InputError(f"neck is of the paper's network: give --size {' or '.join(MODELS['dapt'])}")
    if isinstance(own, BaselineConfig):
        named = own if isinstance(own, LidarcapConfig) else replace(own, joints=joints.joints)
        config = _with_options(named, recipe.options)
        if trained is not None and config.width_divisor != own.width_divisor:
            raise InputError(f"--init has weights for width_divisor={own.width_divisor}: leave that option away")
        return config, partial(build, config) if trained is None else partial(with_joints, trained, config)
    own = _with_options(own, recipe.options)
    if isinstance(own, NetworkConfig):
        if not recipe.keep_anchors and trained is not None:
            raise InputError(
                "keep_anchors=false is for the paper's network, and --init names one of the package's own: name a "
                "checkpoint of pretrain --recipe paper, or leave --recipe paper and --keep-anchors away"
            )
        return own, partial(PoseNet, own) if trained is None else lambda: trained
    if not dataset:
        # synthesized people have every joint; the paper's network those that it is pre-trained on
        joints = HUMAN15
    fitting = [c for c in CONFIGS.values() if c.bins and set(c.joints) == set(joints.joints)]
    if not fitting:
        raise InputError(f"the paper's network has no configuration for the joints of {joints.name}")
    like = next((c for c in fitting if c.name == dataset), fitting[0])
    if trained is None:
        own = _with_neck(replace(own, bins=(), ranges=(), coordinates=True), recipe.neck)
    # the paper fine-tunes by heatmaps alone, Table 3 by coordinates too; the neck prn knows no others
    coordinates = recipe.head == "coordinates" or own.neck == "prn"
    bins, ranges = ((), ()) if coordinates else (like.bins, like.ranges)
    same = (own.joints, own.bins, own.ranges) == (like.joints, bins, ranges)
    if trained is not None and recipe.keep_anchors and same and not (coordinates and own.parts):
        # a network of this dataset already, as released ones are
        return own, lambda: trained
    heads: dict[str, Any] = {"parts": 0, "coordinates": coordinates, "auxiliary": False}
    config = replace(own, name=like.name, joints=like.joints, bins=bins, ranges=ranges, **heads)
    if trained is None:
        return config, partial(build, config)
    return config, partial(transferred, trained, config, keep_anchors=recipe.keep_anchors)
