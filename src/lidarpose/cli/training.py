"""`lidarpose pretrain` and `finetune`."""

import argparse
from dataclasses import replace
from pathlib import Path


def add(commands) -> None:
    """Adds the commands to the parser's."""
    pretrain = commands.add_parser(
        "pretrain",
        help="train a network on synthesized people",
        description="Trains into the folder RUN: config.json, log.jsonl, state.safetensors, model.safetensors.",
    )
    pretrain.set_defaults(run=_pretrain)
    pretrain.add_argument("folder", metavar="RUN", help="a new folder; with --resume that of a run that was stopped")
    pretrain.add_argument("--resume", action="store_true", help="go on with a run that was stopped")
    pretrain.add_argument("--size", metavar="NAME", help="of the network: tiny (default), small or base")
    pretrain.add_argument("--scene", metavar="NAME", help="wild or paper")
    pretrain.add_argument("--people", type=int, metavar="N", help="people seen in all")
    pretrain.add_argument("--easy", type=float, metavar="SHARE", help="of the run in which difficulty rises to full")
    pretrain.add_argument("--batch", type=int, metavar="N", help="people a step")
    pretrain.add_argument("--rate", type=float, metavar="R", help="peak learning rate")
    pretrain.add_argument("--motion", metavar="FILE", help="captured motion to take poses from")
    pretrain.add_argument(
        "--subjects", metavar="A,B", help="those of its clips to learn from, by the first part of names"
    )
    pretrain.add_argument("--captured", type=float, metavar="SHARE", help="share of poses from the clips")
    pretrain.add_argument("--seed", type=int, metavar="N")
    pretrain.add_argument("--workers", type=int, metavar="N", help="generator processes")


def _pretrain(options: argparse.Namespace) -> None:
    from lidarpose.train.loop import pretrain
    from lidarpose.train.recipes import default

    names = ("size", "scene", "people", "easy", "batch", "rate", "motion", "captured", "seed", "workers")
    changes = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    if options.subjects is not None:
        changes["subjects"] = tuple(options.subjects.split(","))
    words = [f"--{name} {','.join(value) if isinstance(value, tuple) else value}" for name, value in changes.items()]
    command = " ".join(["lidarpose pretrain", Path(options.folder).name, *words])
    path = pretrain(replace(default(), **changes), options.folder, resume=options.resume, command=command)
    print(path)
