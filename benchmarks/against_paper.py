"""Our recipe compared with our implementation of the paper's network and recipe, at equal parameters and people.

    python benchmarks/against_paper.py --motion cmu_motion.npz --out runs/ablations

The paper's design has the size of `tiny`: voxels of 4, 8 and 16 cm, 1 + 1 + 1 encoder and 1 + 1 decoder blocks. Half of
the people are used to train coordinates and parts (its pre-training), half to train heatmaps (its fine-tuning, here on
synthesized people). Our recipe, "ours", is `base` of `ablations.py`, and these runs use the same scores.json format and
tables. Each run is evaluated with the released decoding and with ours, and the better result counts; on the bench, and
on people of the paper's own scene in other poses.
"""

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import ablations
from ablation_tables import BASE, OWN_SCENE, figures
from ablations import arguments, each, record
from torch import nn

from lidarpose import evaluation
from lidarpose.cli import main as lidarpose
from lidarpose.inference.predictor import load
from lidarpose.models.checkpoint import load_checkpoint
from lidarpose.models.dapt.dapt_config import DaptConfig
from lidarpose.train.loop import train
from lidarpose.train.objectives.dapt_objective import DaptObjective, finetuning_config, pretraining_config, small
from lidarpose.train.objectives.dapt_transfer import transferred
from lidarpose.train.recipes import Pretrain, recipe
from lidarpose.train.run_dir import MODEL
from lidarpose.train.setup import make_setup


@dataclass(frozen=True)
class Way:
    """How the paper's network is trained. scene: the scene of the training people; rates: learning rates of the two
    stages; anchors: whether anchors are kept between the stages; recipe: changes of the recipe; one_stage: all people
    train heatmaps, at the second rate; dropout: of the neck, 0.1, and stochastic depth of 0.1; else none and 0.05, as
    in the package's reduced sizes."""

    what: str
    scene: str = "paper"
    rates: tuple[float, float] = (3e-4, 5e-4)
    anchors: bool = False
    recipe: dict | None = None
    one_stage: bool = False
    dropout: bool = True


OURS = "ours"
# of the paper's heatmaps: the released one and ours
DECODINGS: tuple[str, ...] = ("dark", "window")
# people of the paper's own scene
OWN_PEOPLE = 1000
_FASTER: dict[str, Any] = {"rates": (2e-3, 2e-3), "anchors": True, "recipe": {"ema": 0.99, "clip": 1.0}}
_HEATMAPS: dict[str, Any] = _FASTER | {"recipe": _FASTER["recipe"] | {"heatmap_rate": 10.0}}
_ONE_STAGE: dict[str, Any] = {
    "scene": "wild",
    "rates": (0.0, 2e-3),
    "recipe": {"warmup": 0.1, "clip": 35.0, "decay": 0.01, "heatmap_rate": 10.0},
    "one_stage": True,
}
WAYS = {
    "paper": Way("the paper's network and recipe"),
    "paper, faster": Way(
        "the paper's network, rates of 2e-3, anchors kept, gradients clipped, mean of weights", **_FASTER
    ),
    "paper, wild": Way("the paper's network, rates of 2e-3, on our people", scene="wild", **_FASTER),
    "paper, heatmaps": Way(
        "the paper's network, the same rates, ten times that in the last layer of heatmaps", **_HEATMAPS
    ),
    "paper, heatmaps, no dropout": Way(
        "the paper's network, these rates, no dropout in the neck and less stochastic depth", **_HEATMAPS, dropout=False
    ),
    "paper, one stage": Way(
        "the paper's network, heatmaps alone in one stage and one cycle, the same rates, on our people", **_ONE_STAGE
    ),
    "paper, one stage, no dropout": Way(
        "the paper's network, this one stage on our people, no dropout in the neck and less stochastic depth",
        **_ONE_STAGE,
        dropout=False,
    ),
    OURS: Way("ours: `tiny` without convolutions", scene="wild"),
}


def sized(config: DaptConfig, dropout: bool) -> DaptConfig:
    """The paper's design at the size of `tiny`."""
    regularization: dict[str, Any] = {"anchor_dropout": 0.1, "drop_path": 0.1} if dropout else {}
    return replace(
        small(config),
        name=f"tiny-{config.name}",
        encoder_depths=(1, 1, 1),
        encoder_channels=(24, 32, 64),
        encoder_heads=(2, 2, 4),
        decoder_channels=(32, 32),
        decoder_heads=(4, 4),
        anchor_channels=(32, 32, 32),
        **regularization,
    )


def own_scene(options: argparse.Namespace) -> Path:
    """People of the scene `paper` in poses of held-out subjects and of the prior; made once per `--out`."""
    folder = Path(options.out) / "own"
    if not folder.exists():
        people = ["--scene", "paper", "-n", str(OWN_PEOPLE), "--seed", "77", "--captured", "0.5", "--workers", "1"]
        motion = ["--motion", options.motion, "--subjects", options.held_out]
        if lidarpose(["synth", *people, *motion, "--out", str(folder)]):
            raise SystemExit(f"{folder}: could not be made")
    return folder


def run(options: argparse.Namespace, name: str, seed: int, folder: Path) -> dict:
    """Trains and evaluates on the bench and on the paper's own scene; returns the `ablations.record`."""
    if name == OURS:
        scores = ablations.run(options, BASE, seed, folder) | {"variant": OURS}
        model, decodings = folder / MODEL, ("window",)
    else:
        scores, model = run_paper(options, name, seed, folder)
        decodings = DECODINGS
    own = best_figures(model, decodings, str(own_scene(options)))["all"]
    return scores | {"figures": scores["figures"] | {OWN_SCENE: own}}


def best_figures(model: Path, decodings: Sequence[str], dataset: str) -> dict[str, dict[str, float]]:
    """The figures of weights on a dataset by the decoding with the lowest error."""
    results = [evaluation.run(load(model, decode=decode, tta=1), [dataset]).scores.results[0] for decode in decodings]
    return min(map(figures, results), key=lambda scores: scores["all"]["value"])


def run_paper(options: argparse.Namespace, name: str, seed: int, folder: Path) -> tuple[dict, Path]:
    """Runs both stages of the paper's network and the evaluation on the bench; returns the record and the weights."""
    variant, people = WAYS[name], options.people
    start, process_start = time.perf_counter(), time.process_time()
    subjects = tuple(options.subjects.split(","))
    changes = {"size": "paper-small", "motion": options.motion, "subjects": subjects}
    changes |= {"people": people if variant.one_stage else people // 2}
    changes |= {"workers": 0, "pictures": 0, "validate": people, "scene": variant.scene} | (variant.recipe or {})
    # pre-training has no heatmaps
    heatmap_rate = changes.pop("heatmap_rate", 1.0)
    changes |= {"strays": 0.2, "noise": 0.15} if variant.scene == "wild" else {}
    settings = recipe(Pretrain, "paper", **changes, seed=seed, rate=variant.rates[0])
    finetuning = DaptObjective(config=sized(finetuning_config("humanm3"), variant.dropout), stage="finetune")
    make_network: Callable[[], nn.Module] = finetuning.network
    if not variant.one_stage:
        pretraining = DaptObjective(config=sized(pretraining_config(), variant.dropout), stage="pretrain")
        setup = replace(make_setup(settings), objective=pretraining, network=pretraining.network)
        trained_network, _ = load_checkpoint(train(settings, folder / "pretrain", setup=setup))
        make_network = partial(transferred, trained_network, finetuning.config, keep_anchors=variant.anchors)
    # another seed, so that the people differ from those of the first half
    later = {"seed": seed + 1_000, "rate": variant.rates[1], "head": "heatmaps", "heatmap_rate": heatmap_rate}
    settings = replace(settings, **later)
    setup = replace(make_setup(settings), objective=finetuning, network=make_network)
    model = train(settings, folder / "finetune", setup=setup)
    durations = {"seconds": time.perf_counter() - start, "processor_seconds": time.process_time() - process_start}
    scores = record(
        name,
        seed,
        people,
        begun=0,
        parameters=sum(value.numel() for value in load_checkpoint(model)[0].parameters()),
        **durations,
        figures=best_figures(model, DECODINGS, "bench"),
    )
    return scores, model


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(map(repr, WAYS))}; default: all")
    arguments(parser, required=True)
    parser.add_argument("--held-out", default="006,007", help="subjects of the poses on the paper's own scene")
    parser.set_defaults(init="")
    options = parser.parse_args()
    for name in options.names:
        if name not in WAYS:
            parser.error(f"no way {name!r}: one of {', '.join(map(repr, WAYS))}")
    each(options.names or WAYS, options, partial(run, options))


if __name__ == "__main__":
    main()
