"""The command line: `lidarpose COMMAND`, also `python -m lidarpose`. Heavy imports stay inside the commands."""

import argparse
import os
import sys
from dataclasses import replace
from pathlib import Path

from lidarpose._version import __version__
from lidarpose.errors import InputError, LidarPoseError


def main(arguments: list[str] | None = None) -> int:
    """Runs one command. Returns 0, or 2 after one line on stderr where the input is at fault."""
    options = _parser().parse_args(arguments)
    try:
        options.run(options)
    except LidarPoseError as error:
        print(f"lidarpose: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("lidarpose: stopped", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # whoever read our output has enough; keep python from complaining at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="lidarpose", description="3D human pose from LiDAR.")
    parser.add_argument("--version", action="version", version=f"lidarpose {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    predict = commands.add_parser(
        "predict",
        help="poses of the people in a point file",
        description="Writes STEM.poses.json: the joints of every person, in the file's own frame, metres.",
    )
    predict.set_defaults(run=_predict)
    predict.add_argument("file", help=".pcd .ply .bin .npy .npz .csv .xyz .txt")
    predict.add_argument("--boxes", metavar="JSON", help='{"people": [{"center": [x,y,z], "size": [l,w,h], "yaw": r}]}')
    predict.add_argument("--crop", action="store_true", help="the file is one person already")
    predict.add_argument(
        "--sensor-origin", metavar="X,Y,Z", help="where the sensor stood, or unknown (with boxes: 0,0,0; crop: unknown)"
    )
    predict.add_argument("--skeleton", default="smpl24", metavar="NAME", help="smpl24 (default), human15, waymo14")
    predict.add_argument("--up", default="z", metavar="AXIS", help="the file's up axis: z (default), y or x")
    predict.add_argument("--columns", type=int, metavar="N", help="values a row of a .bin: 4 KITTI, 5 nuScenes")
    predict.add_argument("--out", default=".", metavar="DIR", help="folder for the results; - prints the JSON")
    predict.add_argument("--picture", action="store_true", help="also draw STEM.poses.png")
    predict.add_argument("--weights", default="tiny", metavar="NAME|FILE", help="bundled weights or a checkpoint")

    demo = commands.add_parser(
        "demo", help="people seen by three LiDARs, true and predicted", description="Writes a report to turn in 3D."
    )
    demo.set_defaults(run=_demo)
    demo.add_argument("--out", default="lidarpose-demo", metavar="DIR", help="folder (default lidarpose-demo)")
    demo.add_argument("--seed", type=int, default=7, metavar="N")
    demo.add_argument("--weights", default="tiny", metavar="NAME|FILE", help="bundled weights or a checkpoint")

    info = commands.add_parser("info", help="versions, device, bundled weights and what they score")
    info.set_defaults(run=_info)

    pretrain = commands.add_parser(
        "pretrain",
        help="train a network on synthesized people",
        description="Trains into the folder RUN: config.json, log.jsonl, state.safetensors, model.safetensors.",
    )
    pretrain.set_defaults(run=_pretrain)
    pretrain.add_argument("folder", metavar="RUN", help="a new folder; with --resume that of a run that was stopped")
    pretrain.add_argument("--resume", action="store_true", help="go on with a run that was stopped")
    pretrain.add_argument("--size", metavar="NAME", help="of the network: tiny")
    pretrain.add_argument("--scene", metavar="NAME", help="wild or paper")
    pretrain.add_argument("--people", type=int, metavar="N", help="people seen in all")
    pretrain.add_argument("--batch", type=int, metavar="N", help="people a step")
    pretrain.add_argument("--rate", type=float, metavar="R", help="peak learning rate")
    pretrain.add_argument("--motion", metavar="NPZ", help="captured clips to take poses from")
    pretrain.add_argument(
        "--subjects", metavar="A,B", help="those of its clips to learn from, by the first part of names"
    )
    pretrain.add_argument("--captured", type=float, metavar="SHARE", help="share of poses from the clips")
    pretrain.add_argument("--seed", type=int, metavar="N")
    pretrain.add_argument("--workers", type=int, metavar="N", help="generator processes")
    return parser


def _predict(options: argparse.Namespace) -> None:
    from lidarpose.infer.files import predict
    from lidarpose.infer.predictor import load

    poses = predict(
        options.file,
        boxes=options.boxes,
        crop=options.crop,
        sensor_origin=options.sensor_origin,
        skeleton=options.skeleton,
        up=options.up,
        columns=options.columns,
        model=lambda: load(options.weights),
        progress=sys.stderr.isatty(),
    )
    for warning in poses.warnings:
        print(f"lidarpose: warning: {warning}", file=sys.stderr)
    for person in poses:
        for warning in person.warnings:
            print(f"lidarpose: warning: person {person.id}: {warning}", file=sys.stderr)
    if options.out == "-":
        sys.stdout.write(poses.to_json())
        if not options.picture:
            return
    folder = Path("." if options.out == "-" else options.out)
    stem = Path(options.file).stem
    # drawn before anything is written: a failure leaves nothing half done
    picture = poses.picture(title=Path(options.file).name) if options.picture else None
    written = []
    if options.out != "-":
        written.append(folder / f"{stem}.poses.json")
        poses.save(written[-1])
    if picture is not None:
        from lidarpose.data.files import write_atomic

        written.append(folder / f"{stem}.poses.png")
        write_atomic(written[-1], picture)
    seen = sum(person.pose is not None for person in poses)
    where = " and ".join(map(str, written))
    milliseconds = poses.timing_ms["per_person"]
    print(f"{seen} of {len(poses)} people, {milliseconds:.0f} ms each -> {where}", file=sys.stderr)


def _demo(options: argparse.Namespace) -> None:
    from lidarpose.demo import run

    run(options.out, seed=options.seed, weights=options.weights)


def _info(options: argparse.Namespace) -> None:
    from lidarpose.infer.info import lines

    print("\n".join(lines()))


def _pretrain(options: argparse.Namespace) -> None:
    from lidarpose.train.loop import pretrain
    from lidarpose.train.recipes import default

    names = ("size", "scene", "people", "batch", "rate", "motion", "captured", "seed", "workers")
    changes = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    if options.subjects is not None:
        changes["subjects"] = tuple(options.subjects.split(","))
    if any(isinstance(value, int | float) and value < 0 for value in changes.values()):
        name = next(n for n, v in changes.items() if isinstance(v, int | float) and v < 0)
        raise InputError(f"--{name} must not be negative, got {changes[name]}")
    words = [f"--{name} {','.join(value) if isinstance(value, tuple) else value}" for name, value in changes.items()]
    command = " ".join(["lidarpose pretrain", Path(options.folder).name, *words])
    path = pretrain(replace(default(), **changes), options.folder, resume=options.resume, command=command)
    print(path)
