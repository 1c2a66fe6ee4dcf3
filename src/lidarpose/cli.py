"""The command line: `lidarpose COMMAND`, also `python -m lidarpose`. Heavy imports stay inside the commands."""

import argparse
import os
import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from lidarpose._version import __version__
from lidarpose.errors import LidarPoseError, missing_extra

# options whose value may start with a minus sign, which argparse would take for another option
_SIGNED = ("--sensor-origin",)
# people named by a warning that several share
_MOST_NAMED = 3


def main(arguments: list[str] | None = None) -> int:
    """Runs one command. Returns 0, or 2 after one line on stderr where the input is at fault."""
    options = _parser().parse_args(_joined(sys.argv[1:] if arguments is None else arguments))
    try:
        options.run(options)
        if sys.stdout is not None:
            sys.stdout.flush()
    except BrokenPipeError:
        # whoever read our output has enough; keep python from complaining at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except ModuleNotFoundError as error:
        extra = "export" if options.command == "export" else None
        told = missing_extra(error, f"`lidarpose {options.command}`", extra)
        if not isinstance(told, LidarPoseError):
            raise
        return _failed(told)
    except (LidarPoseError, OSError) as error:
        return _failed(error)
    except KeyboardInterrupt:
        print("lidarpose: stopped", file=sys.stderr)
        return 130
    return 0


def _failed(error: Exception) -> int:
    print(f"lidarpose: error: {error}", file=sys.stderr)
    return 2


class _Parser(argparse.ArgumentParser):
    def error(self, message: str):
        """One line, as for every other wrong input."""
        self.exit(2, f"lidarpose: error: {message}; see {self.prog} --help\n")


def _joined(arguments: list[str]) -> list[str]:
    """`--sensor-origin -1,0,2` as `--sensor-origin=-1,0,2`."""
    joined: list[str] = []
    for argument in arguments:
        if joined and joined[-1] in _SIGNED and argument.startswith("-") and argument[1:2] in tuple("0123456789."):
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="lidarpose", description="3D human pose from LiDAR.")
    parser.add_argument("--version", action="version", version=f"lidarpose {__version__}")
    commands = parser.add_subparsers(title="commands", dest="command", required=True, metavar="COMMAND")

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
    predict.add_argument(
        "--skeleton", metavar="NAME", help="smpl24, human15, waymo14 or body26 (default smpl24, or the network's own)"
    )
    predict.add_argument("--up", default="z", metavar="AXIS", help="the file's up axis: z (default), y or x")
    predict.add_argument("--columns", type=int, metavar="N", help="values a row of a .bin: 4 KITTI, 5 nuScenes")
    predict.add_argument("--out", default=".", metavar="DIR", help="folder for the results; - prints the JSON")
    predict.add_argument("--picture", action="store_true", help="also draw STEM.poses.png")
    predict.add_argument(
        "--weights", default="tiny", metavar="NAME|FILE", help="bundled weights, a checkpoint or an exported .onnx"
    )
    predict.add_argument(
        "--backend",
        metavar="NAME",
        help="onnx or torch (default onnx for bundled weights and .onnx, torch for .safetensors and other devices)",
    )
    predict.add_argument("--device", default="cpu", metavar="NAME", help="cpu (default), or cuda with torch")
    predict.add_argument(
        "--decode", default="window", metavar="NAME", help="how heatmaps are read: window (default), argmax or dark"
    )

    demo = commands.add_parser(
        "demo", help="people seen by three LiDARs, true and predicted", description="Writes a report to turn in 3D."
    )
    demo.set_defaults(run=_demo)
    demo.add_argument("--out", default="lidarpose-demo", metavar="DIR", help="folder (default lidarpose-demo)")
    demo.add_argument("--seed", type=int, default=7, metavar="N")
    demo.add_argument("--weights", default="tiny", metavar="NAME|FILE", help="bundled weights or a checkpoint")

    synth = commands.add_parser(
        "synth",
        help="write synthesized people as Parquet shards",
        description="Writes OUT/dataset.json and Parquet shards of people with their true poses. Stopped or killed, "
        "the same command goes on; the same settings give the same bytes.",
    )
    synth.set_defaults(run=_synth)
    synth.add_argument("--out", required=True, metavar="DIR", help="a new folder, or that of a run that was stopped")
    synth.add_argument("-n", "--count", type=int, required=True, metavar="N", help="people, clips or streets")
    synth.add_argument("--scene", default="wild", metavar="NAME", help="wild (default), paper or reference")
    synth.add_argument(
        "--sensor", metavar="A,B", help="sensors or files of their tables (default: the scene's); see lidarpose sensors"
    )
    synth.add_argument("--seed", type=int, default=0, metavar="N")
    synth.add_argument("--hard", type=float, default=1.0, metavar="H", help="difficulty from 0 (easy) to 1 (default)")
    synth.add_argument("--workers", type=int, default=1, metavar="N", help="processes (default 1)")
    synth.add_argument("--motion", metavar="FILE", help="captured motion to take poses from: a file or a folder")
    synth.add_argument("--subjects", metavar="A,B", help="those of its clips to use, by the first part of names")
    synth.add_argument("--captured", type=float, metavar="SHARE", help="of poses from the clips (default 0.5)")
    synth.add_argument("--per-shard", type=int, metavar="N", help="people (2000), clips (125) or streets (2) a file")
    several = synth.add_mutually_exclusive_group()
    several.add_argument("--clips", action="store_true", help="clips of 16 frames at 10 Hz instead of single people")
    several.add_argument("--scenes", action="store_true", help="whole streets of several walking people")

    prepare = commands.add_parser(
        "prepare",
        help="write a real dataset's people as Parquet shards",
        description="Reads the raw files of a public dataset and writes OUT/dataset.json and Parquet shards. Stopped "
        "or killed, the same command goes on.",
    )
    prepare.set_defaults(run=_prepare)
    prepare.add_argument(
        "dataset", metavar="NAME", help="humanm3, lidarhuman26m, sloper4d, waymo, lipd, freemotion or noisemotion"
    )
    prepare.add_argument("root", metavar="RAW", help="the folder of its raw files")
    prepare.add_argument("out", metavar="OUT", help="a new folder, or that of a run that was stopped")
    prepare.add_argument("--split", metavar="NAME", help="only people of train, val or test")
    prepare.add_argument(
        "--split-by", metavar="NAME", help="a published split (default: RAW/train.txt and test.txt, else the usual one)"
    )
    prepare.add_argument(
        "--smpl", metavar="FILE|DIR", help="your SMPL model, for lidarhuman26m, sloper4d, freemotion, noisemotion"
    )
    prepare.add_argument("--workers", type=int, default=1, metavar="N", help="processes (default 1)")

    sensors = commands.add_parser("sensors", help="the simulated sensors", description="Lists the sensors by name.")
    sensors.set_defaults(run=_sensors)

    view = commands.add_parser(
        "view", help="draw people of a dataset", description="Draws a contact sheet of a dataset that synth wrote."
    )
    view.set_defaults(run=_view)
    view.add_argument("folder", metavar="DIR", help="a dataset's folder")
    view.add_argument("-n", "--count", type=int, default=24, metavar="N", help="people, evenly spread (default 24)")
    view.add_argument("--html", action="store_true", help="a page to turn them in 3D instead of a picture")
    view.add_argument("--out", metavar="FILE", help="default DIR.png or DIR.html, in the current folder")

    info = commands.add_parser("info", help="versions, device, bundled weights and what they score")
    info.set_defaults(run=_info)

    export = commands.add_parser(
        "export",
        help="weights as ONNX or as a torch.export program",
        description="Writes a checkpoint as one file of another format, for any number of people and points.",
    )
    export.set_defaults(run=_export)
    export.add_argument("weights", nargs="?", default="tiny", metavar="NAME|FILE", help="default tiny")
    export.add_argument("--format", default="onnx", metavar="NAME", help="onnx (default) or torch (a .pt2 program)")
    export.add_argument("--out", metavar="FILE", help="default STEM.onnx or STEM.pt2, in the current folder")

    take = commands.add_parser(
        "import",
        help="released DAPT weights as a checkpoint",
        description="Writes the weights that DAPT's authors released, as safetensors, as a checkpoint that predict "
        "takes.",
    )
    take.set_defaults(run=_import)
    take.add_argument("file", help="their .safetensors")
    take.add_argument("out", metavar="OUT", help="the checkpoint to write (.safetensors)")
    take.add_argument(
        "--config", metavar="NAME", help="waymo, humanm3, lidarhuman26m, sloper4d or pretrain (default: as FILE says)"
    )

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
    return parser


def _predict(options: argparse.Namespace) -> None:
    from lidarpose.data.files import atomic_path
    from lidarpose.infer.files import predict
    from lidarpose.infer.predictor import load

    choices = {"backend": options.backend, "device": options.device, "decode": options.decode}
    poses = predict(
        options.file,
        boxes=options.boxes,
        crop=options.crop,
        sensor_origin=options.sensor_origin,
        skeleton=options.skeleton,
        up=options.up,
        columns=options.columns,
        # loaded once the input has proved readable
        model=lambda: load(options.weights, **choices),
        progress=sys.stderr is not None and sys.stderr.isatty(),
    )
    file = Path(options.file)
    to_stdout = options.out == "-"
    stem = Path("." if to_stdout else options.out) / file.stem
    outputs: dict[str, bytes] = {}
    if not to_stdout:
        outputs[f"{stem}.poses.json"] = poses.to_json().encode()
    if options.picture:
        outputs[f"{stem}.poses.png"] = poses.picture(title=file.name)
    # all of them or none
    with ExitStack() as stack:
        for path, content in outputs.items():
            stack.enter_context(atomic_path(path)).write_bytes(content)
    if to_stdout:
        print(poses.to_json(), end="")
    for line in _warnings(poses):
        print(f"lidarpose: warning: {line}", file=sys.stderr)
    seen = sum(person.pose is not None for person in poses)
    where = f" -> {' and '.join(outputs)}" if outputs else ""
    print(f"{seen} of {len(poses)} people, {poses.timing_ms['per_person']:.0f} ms each{where}", file=sys.stderr)


def _warnings(poses) -> list[str]:
    """The input's warnings, and each of the people's once with the ids of those it is about."""
    shared: dict[str, list[str]] = {}
    for person in poses:
        for warning in person.warnings:
            shared.setdefault(warning, []).append(str(person.id))
    lines = list(poses.warnings)
    for warning, ids in shared.items():
        more = f" and {len(ids) - _MOST_NAMED} more" if len(ids) > _MOST_NAMED else ""
        who = "person" if len(ids) == 1 else "people"
        lines.append(f"{who} {', '.join(ids[:_MOST_NAMED])}{more}: {warning}")
    return lines


def _demo(options: argparse.Namespace) -> None:
    from lidarpose.demo import run

    run(options.out, seed=options.seed, weights=options.weights)


def _synth(options: argparse.Namespace) -> None:
    from lidarpose.synth.write import Job, write_dataset

    job = Job(
        what="clips" if options.clips else "streets" if options.scenes else "people",
        count=options.count,
        scene=options.scene,
        sensors=None if options.sensor is None else _names(options.sensor),
        seed=options.seed,
        hard=options.hard,
        motion=options.motion,
        subjects=None if options.subjects is None else _names(options.subjects),
        captured=options.captured,
        per_shard=options.per_shard,
    )
    with ExitStack() as stack:
        progress = _bar(stack, unit=f" {job.what}") if sys.stderr is not None and sys.stderr.isatty() else None
        made = write_dataset(job, options.out, workers=options.workers, progress=progress)
    kept = "" if made == job.count else f", {job.count - made:,} were there"
    print(f"{made:,} {job.what} made{kept} -> {options.out}", file=sys.stderr)


def _bar(stack: ExitStack, *, unit: str) -> Callable[[int, int], None]:
    """progress(done, total) that draws a bar with rate and time left; `stack` closes it."""
    from tqdm import tqdm

    bar = None

    def progress(done: int, total: int) -> None:
        nonlocal bar
        if bar is None:
            # what stood there before is not this run's speed
            bar = stack.enter_context(tqdm(total=total, initial=done, unit=unit, smoothing=0.1))
        bar.update(done - bar.n)

    return progress


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


def _sensors(options: argparse.Namespace) -> None:
    from lidarpose.lidar.tables import listing

    print("\n".join(listing()))


def _view(options: argparse.Namespace) -> None:
    from lidarpose.view.sheet import draw_dataset

    print(draw_dataset(options.folder, count=options.count, html=options.html, out=options.out))


def _info(options: argparse.Namespace) -> None:
    from lidarpose.infer.info import lines

    print("\n".join(lines()))


def _prepare(options: argparse.Namespace) -> None:
    from lidarpose.data.prepare import prepare
    from lidarpose.data.summary import lines_of

    summary = prepare(
        options.dataset,
        options.root,
        options.out,
        split=options.split,
        split_by=options.split_by,
        smpl=options.smpl,
        workers=options.workers,
    )
    for line in lines_of(summary):
        print(line, file=sys.stderr)


def _export(options: argparse.Namespace) -> None:
    from lidarpose.infer.predictor import weights_path
    from lidarpose.model.export import FORMATS, export

    path = weights_path(options.weights)
    out = options.out or path.stem + FORMATS.get(options.format, "")
    export(path, out, format=options.format)
    print(f"{path.name} -> {out} ({Path(out).stat().st_size / 1e6:.2f} MB)", file=sys.stderr)


def _import(options: argparse.Namespace) -> None:
    from lidarpose.model.checkpoint import import_released

    header = import_released(options.file, options.out, config=options.config)
    print(f"{header.config.name}, joints of {header.skeleton.name} -> {options.out}", file=sys.stderr)


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
