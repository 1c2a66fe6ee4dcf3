"""Ablations: the same network trained in the same way on the same number of people, with one change at a time.

    python benchmarks/ablations.py --list
    python benchmarks/ablations.py --motion cmu_motion.npz --people 24576 --out runs/ablations
    python benchmarks/ablations.py --motion cmu_motion.npz --people 24576 --seeds 1,2 base pooled "heatmaps alone"

Each run trains `tiny` without convolutions (its design at the time of the first run) on `--people` synthesized people
and evaluates it on lidarpose-bench, cloud-centered, with known sensor position. With `--init FILE` it continues from
trained weights with a learning rate that decays for most of the run. This compares training people with less noise;
variants with another network are left out then. Finished runs are not repeated. A run's figures are written to
OUT/NAME-PEOPLE-SEED/scores.json, which `results.py` reads. With the same seed all variants train on the same people in
the same order, except those that change the people.
"""

import argparse
import json
import math
import os
import shutil
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path

import numpy as np
import torch
from ablation_networks import Uncounted, Unplaced, pooled, reading
from ablation_objectives import (
    HardestPeople,
    MirroredPairs,
    PointJoints,
    Taught,
    VariantObjective,
    grown,
    with_local_refinement,
    with_point_joints,
)
from ablation_tables import figures
from stored import digest, is_stored, write_note
from torch import nn

from lidarpose import evaluation
from lidarpose._version import __version__
from lidarpose.inference.predictor import Predictor
from lidarpose.inference.torch_backend import TorchBackend
from lidarpose.io.atomic import write_atomic
from lidarpose.models.checkpoint import Header, SafetensorsFile, load_checkpoint, read_header
from lidarpose.models.config import SIZES, NetworkConfig
from lidarpose.models.expand import expand_weights
from lidarpose.models.posenet import PoseNet
from lidarpose.synth.generator import BLOCK, Generator
from lidarpose.synth.scene import SCENES, SceneConfig
from lidarpose.train.augment import Example
from lidarpose.train.data_loader import SyntheticSource
from lidarpose.train.loop import train
from lidarpose.train.recipes import Pretrain, recipe
from lidarpose.train.setup import TrainSetup, make_setup

_WILD = SCENES["wild"]


@dataclass(frozen=True)
class Variant:
    """One change. study: the table that lists it; network: creates the network from its configuration; config, recipe:
    changed entries of `NetworkConfig` and `Pretrain`; scene: the scene of the people; objective: the minimized
    objective; kinds: whether people in hard poses are drawn more often, see `HardKindsSource`."""

    study: str
    what: str
    network: Callable[[NetworkConfig], nn.Module] = PoseNet
    size: str = "tiny"
    config: dict = field(default_factory=dict)
    recipe: dict = field(default_factory=dict)
    scene: SceneConfig = _WILD
    objective: type[VariantObjective] = VariantObjective
    kinds: bool = False


# of the scene `wild`, those with the largest errors of `small` on bench-2
HARD_SENSORS = ("livox-mid100", "livox-mid360", "vlp-16", "hdl-32e", "vlp-32c")
_CALM = replace(_WILD, clutter=0.0, company=0.0, occluder=0.0, noise=replace(_WILD.noise, clutter=0.0))
VARIANTS = {
    "base": Variant("base", "`tiny` without convolutions"),
    # the six most important studies
    "pooled": Variant("anchors", "joints from pooled features, votes", network=pooled),
    "pooled, heatmaps alone": Variant(
        "anchors", "joints from pooled features, heatmaps alone", network=pooled, config={"heatmap": "full"}
    ),
    "heatmaps alone": Variant("heads", "heatmaps over the whole person, as in the paper", config={"heatmap": "full"}),
    "votes alone": Variant("heads", "votes, no heatmaps", config={"heatmap": "none"}),
    "no curriculum": Variant("curriculum", "full difficulty from the first person on", recipe={"easy": 0.0}),
    "curriculum 30 %": Variant("curriculum", "difficulty rises over 30 % of the run", recipe={"easy": 0.3}),
    "easy only": Variant("curriculum", "nobody is made hard to see", scene=replace(_WILD, hard=0.0)),
    "bare": Variant("people", "bare bodies, nothing carried", scene=replace(_WILD, clothes=0.0, carry=0.0)),
    "no clutter": Variant("people", "no clutter, occluders, second person or stray returns", scene=_CALM),
    "strays often": Variant("people", "stray points around three people in five", recipe={"strays": 0.6}),
    "nothing disturbed": Variant("people", "no added stray points or blur", recipe={"strays": 0.0, "noise": 0.0}),
    "objects": Variant(
        "person",
        "one crop in twelve shows an object, and a head predicts `person`",
        config={"person": True},
        recipe={"objects": 1 / 12},
    ),
    "grid 4 cm": Variant("grid", "voxels of 4, 8 and 16 cm", config={"grid": 0.04, "max_voxels": 512}),
    "grid 8 cm": Variant("grid", "voxels of 8, 16 and 32 cm", config={"grid": 0.08}),
    "grid 10 cm": Variant("grid", "voxels of 10, 20 and 40 cm", config={"grid": 0.1}),
    # further studies
    "coarse alone": Variant("levels", "anchors read 24 cm alone", network=reading("coarse")),
    "fine alone": Variant("levels", "anchors read 6 cm alone", network=reading("fine")),
    "coarse and mid": Variant("levels", "anchors read 24 and 12 cm", network=reading("coarse", "mid")),
    "no mask": Variant("mask", "no laser-level masking", scene=replace(_WILD, noise=replace(_WILD.noise, mask=0.0))),
    "always mask": Variant(
        "mask",
        "two in three masked, 60 % kept; the paper masks everybody",
        scene=replace(_WILD, noise=replace(_WILD.noise, mask=1.0, mask_keep=(0.6, 0.6))),
    ),
    "paper's scene": Variant("scene", "the paper's scene", scene=SCENES["paper"]),
    "one sensor": Variant("scene", "the paper's sensor alone", scene=replace(_WILD, sensors=("dapt64",))),
    "prior alone": Variant("motion", "no captured poses", recipe={"captured": 0.0}),
    "captured alone": Variant("motion", "captured poses alone", recipe={"captured": 1.0}),
    "convolution": Variant("convolution", "convolutions of 16 channels before the blocks", config={"convolution": 16}),
    "no counts": Variant("network", "no point counts, no weighting by density", network=Uncounted),
    "no view": Variant("network", "neither the sensor's direction nor its distance", network=Unplaced),
    "no mean": Variant("network", "no running mean of the weights", recipe={"ema": 0.0}),
    "batch 32": Variant("steps", "batches of 32, twice the steps", recipe={"batch": 32}),
    "batch 128": Variant("steps", "batches of 128, half the steps", recipe={"batch": 128}),
    "AdamW": Variant("network", "AdamW for all weights, no Muon", recipe={"muon_rate": 0.0}),
    "deeper": Variant("size", "2 + 3 + 2 blocks instead of 1 + 1 + 1", config={"blocks": (2, 3, 2)}),
    # alternatives to training on more people
    "point joints": Variant(
        "losses", "every voxel says which joint is nearest to it, and where", with_point_joints, objective=PointJoints
    ),
    "local refinement": Variant(
        "losses",
        "local refinement: besides, votes are moved by the 16 nearest voxels",
        with_local_refinement,
        objective=PointJoints,
    ),
    "hardest people": Variant("losses", "the worst quarter of a batch counts five times", objective=HardestPeople),
    "hard kinds": Variant("losses", "hard activities drawn more often", kinds=True),
    "hard sensors": Variant(
        "losses",
        "the five hardest sensors drawn three times as often",
        scene=replace(_WILD, sensors=(*_WILD.sensors, *(2 * HARD_SENSORS))),
    ),
    "mirrored pairs": Variant(
        "losses", "half the people, each with their mirror image, which must agree", objective=MirroredPairs
    ),
    "taught": Variant("losses", "half of the losses against the poses of `small`", objective=Taught),
    "small": Variant("size", "`small` without convolutions: 2 + 2 + 2 blocks, wider", size="small"),
}


@dataclass(frozen=True, kw_only=True)
class SceneSource(SyntheticSource):
    """`SyntheticSource` for a scene without a name. It caches its people for the next variant that uses the same."""

    config: SceneConfig

    def example(self, index: int) -> Example:
        examples = _remembered(self)
        if index not in examples:
            examples[index] = super().example(index)
        return examples[index]

    @cached_property
    def _generator(self) -> Generator:
        return replace(super()._generator, scene=self.config)


# error of `small` on bench-2 by activity, relative to the easiest activity; 1.5 for activities not listed
KIND_WEIGHTS = {
    "lie": 3.5,
    "kneel": 2.5,
    "floor": 2.0,
    "cycle": 2.0,
    "run": 1.8,
    "squat": 1.8,
    "bend": 1.0,
    "idle": 1.0,
}


@dataclass(frozen=True, kw_only=True)
class HardKindsSource(SceneSource):
    """Selects one of two people, with odds given by the difficulty of their activities."""

    def example(self, index: int) -> Example:
        return super().example(self.chosen(index))

    def chosen(self, index: int) -> int:
        """The index of the person in example `index`."""
        pair = 2 * index, 2 * index + 1
        weights = [KIND_WEIGHTS.get(self.kind(k), 1.5) for k in pair]
        takes_first = np.random.default_rng([self.seed, index]).random() < weights[0] / sum(weights)
        return pair[0] if takes_first else pair[1]

    def kind(self, index: int) -> str:
        """The activity of person `index`."""
        block, row = divmod(index, BLOCK)
        return self._generator._bodies(self.seed, block).kinds[row]


@lru_cache(maxsize=1)
def _remembered(source: SceneSource) -> dict[int, Example]:
    """The cached examples of the last source only: making them takes a third of a run, caching them 6 KB each."""
    return {}


def keeps_network(variant: Variant) -> bool:
    """Whether trained weights of the usual network fit this variant's network, possibly after adding new layers."""
    is_usual = variant.network in (PoseNet, with_point_joints, with_local_refinement)
    return is_usual and not set(variant.config) - {"blocks", "channels"}


def configuration(variant: Variant, init: str) -> NetworkConfig:
    """The configuration of the variant's network: without convolutions, or with those of the initial weights."""
    convolution = read_header(init).config.convolution if init else 0
    return replace(SIZES[variant.size], **{"convolution": convolution} | variant.config)


def job(variant: Variant, settings: Pretrain) -> TrainSetup:
    """The training setup of a variant."""
    base_setup = make_setup(settings)
    config = configuration(variant, settings.init)
    objective = variant.objective(config=config, made=variant.network)
    values = {name: value for name, value in vars(base_setup.source).items() if not name.startswith("_")}
    values["scene"] = variant.scene.name
    if not variant.scene.hard:
        values["easy"] = math.inf
    if variant.kinds:
        # the indices run over twice as many people
        values["easy"] *= 2
    # the pairs or the teacher's arrays of an objective are only for training, so validation uses a plain objective
    plain_objective = VariantObjective(config=config, made=variant.network)
    network = objective.network
    if settings.init:
        trained_network = load_checkpoint(settings.init)[0]
        network = partial(expand_weights, trained_network, config)
        if variant.network is not PoseNet:
            network = partial(grown, trained_network, variant.network)
    source = HardKindsSource if variant.kinds else SceneSource
    return replace(
        base_setup,
        objective=objective,
        source=source(config=variant.scene, **values),
        network=network,
        validate=lambda _, *args: base_setup.validate(plain_objective, *args),
    )


def run(options: argparse.Namespace, name: str, seed: int, folder: Path) -> dict:
    """Trains and evaluates a variant; returns its `record`."""
    variant, people, init = VARIANTS[name], options.people, options.init
    subjects = tuple(options.subjects.split(","))
    changes = {"motion": options.motion, "subjects": subjects, "people": people, "seed": seed}
    changes |= {"workers": 0, "pictures": 0, "validate": people}
    changes |= {"init": init, "easy": 0.0, "cool": 0.9} if init else {}
    settings = recipe(Pretrain, **changes | variant.recipe)
    start, process_start = time.perf_counter(), time.process_time()
    setup = job(variant, settings)
    model = train(settings, folder, setup=setup)
    durations = {"seconds": time.perf_counter() - start, "processor_seconds": time.process_time() - process_start}
    network = setup.objective.network()
    network.load_state_dict(SafetensorsFile.open(model).load(network.state_dict()))
    predictor = Predictor(TorchBackend(network, Header(config=setup.objective.config, card={})), name=name)
    result = evaluation.run(predictor, ["bench"]).scores.results[0]
    return record(
        name,
        seed,
        people,
        begun=read_header(init).card["people_seen"] if init else 0,
        parameters=sum(value.numel() for value in network.parameters()),
        **durations,
        figures=figures(result),
    )


def record(name: str, seed: int, people: int, **more) -> dict:
    """The content of a scores.json, as `results.py` reads it."""
    head = {"version": __version__, "variant": name, "seed": seed, "people": people}
    return head | {key: round(value, 1) if isinstance(value, float) else value for key, value in more.items()}


def each(names: Iterable[str], options: argparse.Namespace, scored: Callable[[str, int, Path], dict]) -> None:
    """Runs each name with each seed that has no scores.json yet: scored(name, seed, folder) -> `record`.

    Exits if stored scores are of other motion, subjects or weights.
    """
    torch.set_num_threads(1)
    init = getattr(options, "init", "")
    of = {"motion": options.motion, "subjects": options.subjects, "init": digest(Path(init)) if init else ""}
    for seed in map(int, options.seeds.split(",")):
        for name in names:
            folder = Path(options.out) / f"{name.replace(' ', '-')}-{options.people}-{seed}"
            if is_stored(folder / "scores.json", of):
                continue
            shutil.rmtree(folder, ignore_errors=True)
            scores = scored(name, seed, folder)
            write_note(folder / "scores.json", of)
            write_atomic(folder / "scores.json", json.dumps(scores, indent=1) + os.linesep)
            summary = "  ".join(f"{key} {value['value']:.1f}" for key, value in scores["figures"].items())
            print(f"{name} {seed}: {summary}  ({scores['processor_seconds']:.0f} s)", flush=True)


def arguments(parser: argparse.ArgumentParser, **motion) -> None:
    """Adds the arguments of both benchmarks."""
    parser.add_argument("--motion", help="npz of clips, see lidarpose.body.mocap.motion", **motion)
    parser.add_argument("--subjects", default="002,005", help="of its clips, those to learn from")
    parser.add_argument("--people", type=int, default=24_576)
    parser.add_argument("--seeds", default="1")
    parser.add_argument("--out", default="runs/ablations")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help="default: all")
    parser.add_argument("--list", action="store_true", help="the variants, and nothing else")
    arguments(parser)
    parser.add_argument("--init", default="", metavar="FILE", help="trained weights to go on from; another --out then")
    options = parser.parse_args()
    if options.list:
        print("\n".join(f"{name:<24} {variant.what}" for name, variant in VARIANTS.items()))
        return
    if options.motion is None:
        parser.error("--motion is needed: the bench's poses are captured ones")
    for name in options.names:
        if name not in VARIANTS:
            parser.error(f"no variant {name!r}: see --list")
    names = [name for name in options.names or VARIANTS if not options.init or keeps_network(VARIANTS[name])]
    each(names, options, partial(run, options))


if __name__ == "__main__":
    main()
