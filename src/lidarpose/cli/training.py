"""`lidarpose pretrain`, `finetune`, `train-detector` and `train-verifier`."""

import argparse
import os
import shlex
from collections.abc import Callable
from dataclasses import Field, fields
from pathlib import Path
from typing import Any

from lidarpose.cli.terminal import KEEP, add_command, add_options, flag, names, scene_changes
from lidarpose.errors import InputError
from lidarpose.train.recipes import TYPES, Finetune, PoseRecipe, Pretrain, Recipe, TrainDetector, TrainVerifier

_RUN = """
 The run folder holds config.json, log.jsonl, model.safetensors, best.safetensors, state.safetensors to resume from,
 and for pose networks pictures of validation people. After an interruption, --resume continues with the same losses.
 Several processes: `torchrun --nproc_per_node N -m lidarpose COMMAND ...`, with the run folder named."""
_PRETRAIN = f"""
train a network on synthesized people
Trains on people synthesized during training, or on shards.{_RUN.replace("COMMAND", "pretrain")}
$ lidarpose pretrain --people 300000
$ lidarpose pretrain runs/pretrain-001 --resume
"""
_FINETUNE = f"""
fine-tune a network on datasets that prepare wrote
Trains on labeled people; each dataset supervises the joints that it labels.{_RUN.replace("COMMAND", "finetune")}
$ lidarpose finetune humanm3 --epochs 20
$ lidarpose finetune --out runs/finetune-001 --resume
<data> DATASET*  folders written by lidarpose prepare; with --resume the run's own
"""
_DETECTOR = f"""
train the network that detects people in whole scans
Trains on scans synthesized during training.{_RUN.replace("COMMAND", "train-detector")}
$ lidarpose train-detector --scenes 20000
$ lidarpose train-detector runs/train-detector-001 --resume
$ lidarpose train-detector runs/train-detector-001 --calibrate 300 --scans labeled
--calibrate N  no training: write RUN/detector.onnx, its scores calibrated on N synthesized scans with objects that are
 held out of training
--scans DIR  with --calibrate: labeled real scans, as for evaluate detector; the default threshold then gives at most
 one false positive a scan there, too
"""
_VERIFIER = f"""
train the verifier, which rejects the detector's false positives
Trains on detections of the bundled detector in synthesized scans.{_RUN.replace("COMMAND", "train-verifier")}
$ lidarpose train-verifier --scenes 5000
$ lidarpose train-verifier runs/train-verifier-001 --resume
"""
# functions that parse a setting from text, by type; other types stay text
_BOOLS = {"true": True, "false": False}
_PARSERS: dict[Any, Callable] = {
    int: int,
    float: float,
    float | None: float,
    bool: _BOOLS.__getitem__,
    tuple[str, ...]: names,
    tuple[float, ...]: names,
}


_TEXTS: dict[type[Recipe], str] = {
    Pretrain: _PRETRAIN,
    Finetune: _FINETUNE,
    TrainDetector: _DETECTOR,
    TrainVerifier: _VERIFIER,
}


def add(commands) -> None:
    """Adds the commands to the parser's."""
    for kind, text in _TEXTS.items():
        _add(add_command(commands, kind.kind, _train, text), kind)


def _add(parser, kind: type[Recipe]) -> None:
    parser.set_defaults(kind=kind)
    folder_option = "--out:folder RUN" if kind is Finetune else "<folder> RUN?"
    recipe_help = "default, paper (as with --model dapt), paper-one-stage; prn, lpformer, lidarcap, ne, as with --model"
    recipe_help += "; other options override it"
    options = f"""
{folder_option}  run folder, new (default runs/{kind.kind}-001, -002, ...), or with --resume an existing one
--resume  continue an interrupted run (default: the latest)
--recipe NAME  {"default" if kind in (TrainDetector, TrainVerifier) else recipe_help}
--device NAME  cpu or cuda (default: a GPU if there is one)
--tracker NAME  also log to tensorboard or wandb, if installed
"""
    add_options(parser, options)
    # first the settings of this kind of training, then the common ones
    kind_group = parser.add_argument_group(kind.kind)
    common_group = parser.add_argument_group("optimizer and run")
    if issubclass(kind, PoseRecipe):
        add_options(kind_group, KEEP)
    common_names = {field.name for base in (Recipe, PoseRecipe) for field in fields(base)}
    for field in fields(kind):
        if field.name != "data":
            default = "" if field.default in (None, (), "") else f" ({_as_typed(field.default)})"
            (common_group if field.name in common_names else kind_group).add_argument(
                flag(field.name),
                dest=f"set_{field.name}",
                metavar=field.metadata.get("metavar") or TYPES[field.type][2],
                help=field.metadata["help"] + default,
            )


def _train(options: argparse.Namespace) -> None:
    from lidarpose.train.loop import train
    from lidarpose.train.recipes import model_of_size, recipe, recipe_of_model
    from lidarpose.train.run_dir import latest, read_config
    from lidarpose.train.validation import draw_examples

    kind: type[Recipe] = options.kind
    name = kind.kind
    changes: dict[str, Any] = {
        field.name: _parsed(field, text)
        for field in fields(kind)
        if (text := getattr(options, f"set_{field.name}", None)) is not None
    }
    if getattr(options, "calibrate", None) is not None:
        from lidarpose.train.detector.calibrate import calibrate

        other_options = [*changes, *(key for key in ("resume", "recipe", "device", "tracker") if getattr(options, key))]
        if other_options:
            problem = f"expected no other option than --scans, got {flag(other_options[0])}: omit it"
            raise InputError(f"--calibrate does not train: {problem}")
        print(calibrate(options.folder or latest(name), options.calibrate, labeled=options.scans))
        return
    if getattr(options, "scans", None) is not None:
        raise InputError(
            "--scans is for --calibrate: expected both, got only --scans: add --calibrate N or omit --scans"
        )
    if issubclass(kind, PoseRecipe) and (settings := scene_changes(options)):
        changes["set"] = settings
    if kind is Finetune and options.data:
        changes["data"] = tuple(options.data)
    folder = options.folder
    if options.resume:
        if options.recipe is not None:
            raise InputError("a run keeps its recipe: omit --recipe with --resume")
        folder = folder or latest(name)
        # a run keeps its recipe: only settings that are given again change
        run_recipe = kind(**(read_config(Path(folder), kind)[0].to_dict() | changes))
    else:
        # the published recipe of the model, unless a recipe is named
        model = changes.get("model") or model_of_size(changes.get("size", ""))
        recipe_name = options.recipe or recipe_of_model(kind, model)
        run_recipe = recipe(kind, recipe_name, **changes)
    words = [f"{flag(key)} {_as_typed(value)}" for key, value in changes.items() if key != "data"]
    words += [f"--recipe {options.recipe}"] * (options.recipe not in (None, "default"))
    words += ["--resume"] * options.resume
    dataset_names = [shlex.quote(Path(data).name) for data in changes.get("data", ())]
    command = " ".join(["lidarpose", name, *dataset_names, *words])
    environment = {"device": options.device, "tracker": options.tracker}
    path = train(run_recipe, folder, resume=options.resume, command=command, draw=draw_examples, **environment)
    if os.environ.get("RANK", "0") == "0":
        print(path)


def _parsed(field: Field, text: str) -> object:
    """The value of an option; a text of another type stays, and the recipe refuses it."""
    try:
        return _PARSERS.get(field.type, str)(text)
    except (KeyError, ValueError):
        return text


def _as_typed(value: Any) -> str:
    """A value as it is written after an option, of paths the name alone."""
    if isinstance(value, bool):
        return str(value).lower()
    parts = value if isinstance(value, tuple) else (str(value),)
    return shlex.quote(",".join(Path(part).name if "/" in part else part for part in parts))
