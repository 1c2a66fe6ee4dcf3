"""From a recipe to the objective, the source of samples, the network, and the validation samples.

To train another kind of network of `models.NETWORKS`, add its sizes to `networks.PRETRAINED`, its objective's settings
to `objective_of`, and its recipes to `recipes.RECIPES`.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from torch import nn

from lidarpose.arrays import evenly_spaced
from lidarpose.data.dataset_card import read_card
from lidarpose.errors import InputError
from lidarpose.io.files import file_error
from lidarpose.models import NETWORKS, weights_path
from lidarpose.models.baselines.baseline_config import BaselineConfig, LidarcapConfig
from lidarpose.models.checkpoint import load_checkpoint
from lidarpose.models.dapt.dapt_config import DaptConfig
from lidarpose.models.detector.detector import detector_path
from lidarpose.models.detector.detector_config import DetectorConfig
from lidarpose.models.expand import expand_weights
from lidarpose.models.posenet import PoseNet
from lidarpose.sample import CLIP_FRAMES
from lidarpose.skeleton import Skeleton, skeleton
from lidarpose.synth.scene import scene_config
from lidarpose.train.augment import Augmentation, ClipExample, Example, augmentation, augmented
from lidarpose.train.data_loader import BATCHES, ClipSource, MixedSource, Source, StoredSource, SyntheticSource
from lidarpose.train.detector.candidate_source import SceneSource, draw_candidates, scan_example, validation_scans
from lidarpose.train.detector.crop_source import draw_crops, scan_crops, validation_crops
from lidarpose.train.networks import (
    PRETRAINED,
    Config,
    check_rates,
    expanded_network,
    finetuned_network,
    initial_network,
    pretraining_network,
)
from lidarpose.train.objectives.detector_objective import DetectorObjective, missed_people
from lidarpose.train.objectives.objective import Objective
from lidarpose.train.objectives.verifier_objective import VerifierObjective, missed_by_verifier
from lidarpose.train.recipes import Finetune, PoseRecipe, Pretrain, Recipe, TrainDetector, TrainVerifier
from lidarpose.train.run_dir import folder_names
from lidarpose.train.scan_people import draw_person, populated_scan
from lidarpose.train.torch_dataset import InMemoryDataset
from lidarpose.train.validation import validate

# number of validation samples; synthetic ones use a seed that no run trains on
VALIDATION = 256
_VALIDATION_SEED = 2**31 - 7
_NO_VALIDATION = "no validation people: there is no split val, and there are too few sequences to hold one out"
_NOT_VALIDATED = "no validation people: none are held out from training (--hold-out)"
# no sequence is held out from fewer sequences than this
_LEAST_SEQUENCES = 3
# chunks between two uses of a scan: divisible by the usual numbers of workers
_LAG = 12
# how often a whole scan is used in pre-training, each time for one of its people
_SCAN_USES = 12
# share of crops without a person among the synthesized samples of fine-tuning, for networks with a person head
_OBJECTS = 0.2
# number of the first of them: pre-training with the same seed shows the people from 0 on
_FIRST_MIXED = 1 << 40


@dataclass(frozen=True, kw_only=True)
class TrainSetup:
    """All that the training loop needs for a run.

    people: total number of samples seen; validation: makes the validation samples, called once, empty for no
    validation; joints: the skeleton to draw them in, None for no pictures; card: entries of the checkpoint's card
    besides the recipe; warnings: for the user; frames: per example, each counts as one of `people`; unit: what `people`
    counts; epoch: how many of `people` make an epoch of the dataset, 0 if samples never repeat; validate: called with
    (objective, network, examples, batch), returns the error of a network in evaluation mode, in `error_unit`, and the
    joints to draw, if any.
    """

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
    epoch: int = 0
    validate: Callable[..., tuple[float, np.ndarray | None]] = validate
    error_unit: str = "mm"

    @property
    def task(self) -> Objective:
        """`objective` by its name in 0.2."""
        return self.objective


def Job(*, task: Objective, **settings: Any) -> TrainSetup:  # noqa: N802
    """`TrainSetup` by its name in 0.2."""
    return TrainSetup(objective=task, **settings)


def objective_of(config: Config, recipe: PoseRecipe, layout: str = "ragged") -> Objective:
    """The objective of a network: its entry in `models.NETWORKS`, with the settings of a recipe.

    layout: of the tables of the paper's network.
    """
    bone_weights = {"bone": recipe.bone, "symmetry": recipe.symmetry}
    # heatmaps are learned the same way in both stages
    stage = "finetune" if isinstance(config, DaptConfig) and config.bins else recipe.kind
    settings_by_kind: dict[str, dict] = {"pose": bone_weights, "dapt": {"stage": stage, "layout": layout}}
    settings = settings_by_kind.get(config.kind, {})
    check_prn_batch(config, recipe.batch)
    if settings is not bone_weights and any(bone_weights.values()):
        raise InputError("bone and symmetry are terms of the package's own networks: leave them at 0")
    return NETWORKS[config.kind].part("objective")(config=config, **settings)


def check_prn_batch(config: Any, batch: int) -> None:
    """Raises InputError for a batch of one person, of each process, for PRN or its neck."""
    if "prn" in (getattr(config, "kind", ""), getattr(config, "neck", "")) and batch < 2:
        raise InputError("batch must be at least 2 for prn (its batch norms see a few points per person), got 1")


def make_setup(recipe: Recipe, *, on_cpu: bool = True) -> TrainSetup:
    """The setup of a recipe's run.

    on_cpu: whether the network will run on a CPU, which decides the layout of the paper's tables. Raises InputError,
    one line, if the recipe names something that does not exist.
    """
    layout = "ragged" if on_cpu else "padded"
    if isinstance(recipe, TrainDetector):
        return _detection(recipe)
    if isinstance(recipe, TrainVerifier):
        return _verification(recipe)
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
        network = partial(deepcopy, trained)
        card["init_card"] = header.card
    return TrainSetup(
        objective=objective,
        source=_scene_source(recipe.seed, recipe.uses, recipe.batch, scan_example, draw_candidates),
        people=recipe.scenes * recipe.uses,
        network=network,
        validation=partial(validation_scans, _VALIDATION_SEED),
        joints=None,
        card=card,
        unit="scans",
        validate=missed_people,
        error_unit="missed",
    )


# parameters of a `PoseNet` that the output of its person head does not depend on
_OF_POSES = ("part.", "level_joints.", "joint.heatmap.", "vote.residual.", "vote.offset")


def _verification(recipe: TrainVerifier) -> TrainSetup:
    trained, header = load_checkpoint(weights_path(recipe.init))
    if not isinstance(trained, PoseNet):
        problem = f"expected one of the package's own networks for the verifier, got a network {header.network}"
        raise file_error(recipe.init, problem)
    config = replace(trained.config, size="verifier", person=True)

    def network() -> nn.Module:
        verifier = expand_weights(trained, config)
        assert verifier.person is not None
        # the person head is the only output used: its loss trains the whole network. Parameters that only poses need
        # are frozen; otherwise gradient averaging across processes would wait for their gradients
        verifier.person.detach_inputs = False
        for name, parameter in verifier.named_parameters():
            parameter.requires_grad_(not name.startswith(_OF_POSES))
        return verifier

    return TrainSetup(
        objective=VerifierObjective(config=config),
        source=_scene_source(recipe.seed, recipe.uses, recipe.batch, scan_crops, draw_crops),
        people=recipe.scenes * recipe.uses,
        network=network,
        validation=partial(validation_crops, _VALIDATION_SEED),
        joints=None,
        card={"init_card": header.card},
        unit="scans",
        validate=missed_by_verifier,
        error_unit="missed",
    )


def _scene_source(seed: int, uses: int, batch: float, load_scene: Callable, draw_example: Callable) -> SceneSource:
    """A source of scans for `batch` examples per step. Its lag is such that, for all usual numbers of workers, the
    worker that made a scan also makes the later examples of it."""
    lag = max(int(_LAG * BATCHES * batch) // uses, 1)
    return SceneSource(seed=seed, uses=uses, lag=lag, load_scene=load_scene, draw_example=draw_example)


def _pretraining(recipe: Pretrain, layout: str) -> TrainSetup:
    config, joints = pretraining_network(recipe)
    objective = objective_of(config, recipe, layout)
    network: Callable[[], nn.Module] = objective.network
    card: dict = {"motion": None if recipe.motion is None else Path(recipe.motion).name}
    if recipe.init:
        network, card["init_card"] = expanded_network(recipe.init, config)
    names = ("scene", "set", "motion", "subjects", "captured", "body", "strays", "noise", "objects")
    synthetic_settings: dict[str, Any] = {name: getattr(recipe, name) for name in names}

    def validation() -> Sequence[Example | ClipExample]:
        # centered on the points, like a user's cloud
        held_out_source = SyntheticSource(
            seed=_VALIDATION_SEED, pelvis_centered=0.0, **(synthetic_settings | {"objects": 0.0})
        )
        if isinstance(config, LidarcapConfig):
            clips = range(VALIDATION // config.frames)
            return [held_out_source.clip(index, trans_center=config.trans_center) for index in clips]
        return [held_out_source.example(index) for index in range(VALIDATION)]

    # counts only the people of this source
    easy_people = recipe.easy * recipe.people * (1 - recipe.whole_scans)
    source: Source = SyntheticSource(seed=recipe.seed, easy=easy_people, **synthetic_settings)
    if recipe.whole_scans:
        batch = recipe.batch * recipe.whole_scans
        other_source = _scene_source(recipe.seed, _SCAN_USES, batch, populated_scan, draw_person)
        source = MixedSource(main=source, other=other_source, share=recipe.whole_scans)
    setup = TrainSetup(
        objective=objective,
        source=source,
        people=recipe.people,
        network=network,
        validation=validation,
        joints=joints,
        card=card,
    )
    is_clip = isinstance(config, LidarcapConfig)
    if is_clip and not recipe.shards:
        raise InputError(f"{config.name} learns from clips: give a folder of lidarpose synth --clips by --shards")
    if is_clip and scene_config(recipe.scene).changed(recipe.set).recorded:
        raise InputError(f"{config.name} is validated on clips, and clips have no recorded positions: omit recorded=1")
    if not recipe.shards:
        return setup
    for folder in recipe.shards:
        _check_no_test(folder)
    dataset = InMemoryDataset.load(recipe.shards)
    turn_augmentation = Augmentation(turn=1.0, flip=0.5)
    noise = {"strays": recipe.strays, "noise": recipe.noise}
    if is_clip:
        return _of_clips(setup, replace(_clips(dataset, config, recipe), strays=recipe.strays, noise=recipe.noise))
    source = StoredSource(dataset=dataset, seed=recipe.seed, augmentation=turn_augmentation, **noise)
    # PRN and LPFormer derive a point's part from the nearest joint
    has_parts = config.neck != "prn" if isinstance(config, DaptConfig) else not isinstance(config, BaselineConfig)
    warnings = _left_out(dataset) + (_no_parts(dataset) if has_parts else ())
    return replace(setup, source=source, card=card | {"warnings": list(warnings)}, warnings=warnings)


def _check_no_test(folder: str) -> None:
    """Raises InputError for a dataset that contains test samples: pre-training uses every sample."""
    settings = read_card(folder).settings
    if settings.get("split_by") and settings.get("split") != "train":
        raise file_error(
            folder,
            f"contains test people, by the split {settings['split_by']}, and pre-training uses all people: "
            "prepare it with --split train, or train on it with lidarpose finetune",
        )


def _left_out(dataset: InMemoryDataset) -> tuple[str, ...]:
    """Warnings, a line each, about damaged shards that are left out and datasets that give no people."""
    lines = [f"{folder} has no labeled people for the training, see its splits" for folder in dataset.empty]
    if dataset.damaged:
        problem, count = dataset.damaged[0], len(dataset.damaged) - 1
        others = f", and {count} more" if count else ""
        lines.append(f"left out {len(dataset.damaged)} damaged shards: {problem}{others}")
    return tuple(lines)


def _no_parts(dataset: InMemoryDataset) -> tuple[str, ...]:
    """A warning if a dataset's points have no body parts, which half of the loss of pre-training needs."""
    folders = dict.fromkeys(str(reader.folder) for reader, _, _ in dataset.parts)
    with_parts = {str(r.folder) for r, rows, _ in dataset.parts if rows["part"].null_count < rows.num_rows}
    names = ", ".join(folder_names(folder for folder in folders if folder not in with_parts))
    if not names:
        return ()
    return (f"no point of {names} has a body part: the loss of parts (the paper's L_seg) is not used there",)


def _finetuning(recipe: Finetune, layout: str) -> TrainSetup:
    trained, card = initial_network(recipe)
    _check_clip_options(recipe, PRETRAINED[recipe.size][0] if trained is None else trained.config)
    split = None if recipe.split == "all" else recipe.split
    kind = augmentation(recipe.augment)
    full_dataset = InMemoryDataset.load(recipe.data, split=split, interval=recipe.interval)
    held_out_sequences, held_out_dataset = _held_out(recipe, split, full_dataset)
    dataset = full_dataset.without(held_out_sequences)
    joints = skeleton(dataset.skeleton)
    config, network = finetuned_network(recipe, trained, joints, dataset.dataset)
    check_rates(recipe, config)
    card |= {"data": folder_names(recipe.data), "held_out_sequences": list(held_out_sequences)}
    source: Source = StoredSource(dataset=dataset, seed=recipe.seed, augmentation=kind)
    if recipe.mix:
        objects = _OBJECTS if getattr(config, "person", False) else 0.0
        synthetic_source = SyntheticSource(
            scene=recipe.scene, set=recipe.set, seed=recipe.seed, objects=objects, first=_FIRST_MIXED
        )
        source = MixedSource(main=source, other=synthetic_source, share=recipe.mix)

    def validation() -> list[Example]:
        if held_out_dataset is None:
            return []
        # cropped by a box with a detector's errors, if there is a box, and centered on the points
        cropping = Augmentation(released=kind.released, box=kind.box, pelvis_centered=0.0)
        rows = evenly_spaced(len(held_out_dataset), VALIDATION)
        return [augmented(held_out_dataset.sample(k), cropping, np.random.default_rng([recipe.seed, k])) for k in rows]

    warnings = _left_out(dataset)
    no_validation = _NO_VALIDATION if recipe.hold_out else _NOT_VALIDATED
    setup = TrainSetup(
        objective=objective_of(config, recipe, layout),
        source=source,
        # synthesized samples that are mixed in come on top
        people=max(round(recipe.epochs * len(dataset) / (1 - recipe.mix)), 1),
        epoch=max(round(len(dataset) / (1 - recipe.mix)), 1),
        network=network,
        validation=validation,
        joints=joints,
        card=card | {"damaged": list(dataset.damaged), "warnings": list(warnings)},
        warnings=warnings + ((no_validation,) if held_out_dataset is None else ()),
    )
    if not isinstance(config, LidarcapConfig):
        return setup
    clip_source = _clips(dataset, config, recipe)
    held_out_clips = None if held_out_dataset is None else _clips(held_out_dataset, config, recipe)
    people = max(round(recipe.epochs * len(clip_source.clips)), 1) * config.frames
    clip_validation = (
        partial(held_out_clips.validation_clips, VALIDATION // config.frames) if held_out_clips is not None else list
    )
    epoch = len(clip_source.clips) * config.frames
    return replace(_of_clips(setup, clip_source), people=people, epoch=epoch, validation=clip_validation)


def _check_clip_options(recipe: Finetune, config: Config) -> None:
    """Raises InputError for options that networks of clips, or of single frames, do not have."""
    if not isinstance(config, LidarcapConfig):
        if recipe.shift_windows:
            raise InputError(f"shift_windows is for clip networks, {config.name} reads single frames: omit it")
    elif recipe.mix or recipe.augment not in ("none", "turn"):
        raise InputError(f"{config.name} learns from clips: leave --mix at 0, and --augment at none or turn")


def _clips(dataset: InMemoryDataset, config: LidarcapConfig, recipe: Pretrain | Finetune) -> ClipSource:
    """The clips of a dataset. Raises InputError if it has none."""
    shift = isinstance(recipe, Finetune) and recipe.shift_windows
    clips, skipped = dataset.clips(following=CLIP_FRAMES - 1 if shift else 0)
    if not len(clips):
        raise InputError(
            f"{config.name} needs frames of people with rotations, got {skipped.total():,} without: "
            "use lidarpose synth --clips, or lidarpose prepare of LiDARHuman26M or SLOPER4D"
        )
    return ClipSource(
        dataset=dataset,
        clips=clips,
        skipped=skipped,
        seed=recipe.seed,
        trans_center=config.trans_center,
        turn=isinstance(recipe, Finetune) and recipe.augment == "turn",
        normalize=config.normalize_in_training,
    )


def _of_clips(setup: TrainSetup, source: ClipSource) -> TrainSetup:
    """The setup changed to learn from clips."""
    config = setup.objective.config
    warnings = [f"left out {count:,} {reason}" for reason, count in source.skipped.items()]
    parts = source.dataset.parts
    if len(config.clouds) > 1 and all(rows["background"].null_count == rows.num_rows for _, rows, _ in parts):
        warnings.append(f"the surroundings of these people are not known: {config.name} sees only the people")
    card = setup.card | {"warnings": [*setup.card.get("warnings", ()), *warnings]}
    return replace(setup, source=source, frames=config.frames, card=card, warnings=(*setup.warnings, *warnings))


def _held_out(
    recipe: Finetune, split: str | None, dataset: InMemoryDataset
) -> tuple[tuple[str, ...], InMemoryDataset | None]:
    """Held-out sequences, and the validation dataset: `validation_split`, else the split val if it exists, else those
    sequences; none if `hold_out` is 0."""
    if recipe.validation_split:
        if split in (None, recipe.validation_split):
            problem = f"validation_split {recipe.validation_split!r} is trained on: give another --split, or omit it"
            raise InputError(problem)
        return (), InMemoryDataset.load(recipe.data, split=recipe.validation_split, interval=recipe.interval)
    if not recipe.hold_out:
        return (), None
    if split not in (None, "val"):
        # the dataset may have no split val
        with suppress(InputError):
            return (), InMemoryDataset.load(recipe.data, split="val", interval=recipe.interval)
    if len(dataset.sequences) < _LEAST_SEQUENCES:
        return (), None
    count = max(round(recipe.hold_out * len(dataset.sequences)), 1)
    if count == len(dataset.sequences):
        raise InputError(f"hold_out = {recipe.hold_out} leaves no people for training: lower it")
    return dataset.sequences[-count:], dataset.without(dataset.sequences[:-count])
