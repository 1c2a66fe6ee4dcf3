"""`lidarpose evaluate` and `table`."""

import argparse
import shlex
from collections.abc import Callable, Iterator
from contextlib import ExitStack

from lidarpose.cli.terminal import add_command, tell
from lidarpose.models import BUNDLED
from lidarpose.progress import Progress

# options of `evaluation.run` and their defaults, and those that are on or off
_DEFAULTS = {
    **{"protocol": "clean", "split": None, "skeleton": None, "limit": None, "seed": 0},
    **{"device": "cpu", "backend": None, "decode": "window", "tta": 1},
}
_SWITCHES = ("stability", "legacy", "sensor_unknown")
# groups of rows that the terminal shows; the others are in scores.json
_SHOWN = ("condition", "plain", "joints", "distance, m", "points", "hidden share")
# metrics of these groups that it shows, besides those of everybody
_GROUP_METRICS = ("mpjpe", "turned_round")
_TITLES = {
    **{"mpjpe": "MPJPE", "pa_mpjpe": "PA-MPJPE", "pck3": "PCK-3", "pck5": "PCK-5"},
    **{"turned_round": "facing flipped (> 90 deg)", "pem": "PEM", "oks_ap": "OKS-AP", "auroc": "AUROC"},
}


def add(commands) -> None:
    """Adds the commands to the parser's."""
    evaluate = add_command(
        commands,
        "evaluate",
        "score a checkpoint on datasets",
        "lidarpose evaluate small bench",
        "lidarpose evaluate small prepared/waymo --out scores/waymo",
        description="Prints metrics and writes scores.json, poses.parquet and pictures into a folder.",
    )
    evaluate.set_defaults(run=_evaluate)
    evaluate.add_argument(
        "weights", metavar="CHECKPOINT", help=f"{', '.join(BUNDLED)}, a checkpoint, or an exported .onnx"
    )
    evaluate.add_argument(
        "datasets", nargs="+", metavar="DATASET", help="a folder written by prepare or synth, or bench"
    )
    evaluate.add_argument(
        "--protocol",
        default="clean",
        metavar="NAME",
        help="clean (default), or dapt: crops and centers from labels, as in the released code",
    )
    evaluate.add_argument("--split", metavar="NAME", help="split to score, or all (default: test, else val, else all)")
    evaluate.add_argument(
        "--skeleton", metavar="NAME", help="score the joints of this skeleton (default: the dataset's)"
    )
    evaluate.add_argument("--limit", type=int, metavar="N", help="score only N people, evenly spread")
    evaluate.add_argument("--stability", action="store_true", help="also perturb the points and draw the curves")
    evaluate.add_argument("--legacy", action="store_true", help="also score with the released code's arithmetic")
    evaluate.add_argument("--sensor-unknown", action="store_true", help="hide the sensor's position from the network")
    evaluate.add_argument(
        "--seed", type=int, default=0, metavar="N", help="random seed for displaced boxes and intervals (default 0)"
    )
    evaluate.add_argument("--out", metavar="DIR", help="a new or empty folder (default evaluation/NAME, numbered)")
    evaluate.add_argument("--device", default="cpu", metavar="NAME", help="cpu (default), or cuda (backend torch)")
    evaluate.add_argument(
        "--decode", default="window", metavar="NAME", help="as in lidarpose predict; the released code uses dark"
    )
    evaluate.add_argument("--backend", metavar="NAME", help="onnx or torch, as in lidarpose predict")
    evaluate.add_argument(
        "--tta",
        type=int,
        default=1,
        metavar="N",
        help="test-time augmentation: average N predictions of each person, 1 (default) to 8; protocol clean only",
    )

    table = add_command(
        commands,
        "table",
        "show scores beside the paper's Table 1",
        "lidarpose table evaluation/small",
        description="Sets scores.json files beside the figures printed in the paper, by protocol.",
    )
    table.set_defaults(run=_table)
    table.add_argument("scores", nargs="*", metavar="FILE|DIR", help="scores.json files, or folders that contain one")
    table.add_argument("--format", default="markdown", metavar="NAME", help="markdown (default) or json")
    table.add_argument("--out", metavar="FILE", help="write to FILE (default: print)")


def _evaluate(options: argparse.Namespace) -> None:
    from lidarpose import evaluation

    folder = evaluation.new_folder(options.weights) if options.out is None else evaluation.check_folder(options.out)
    asked = {name: getattr(options, name) for name in (*_DEFAULTS, *_SWITCHES)}
    with ExitStack() as stack:
        run = evaluation.run(
            options.weights, options.datasets, command=_command(options), progress=_progress(stack), **asked
        )
    written = evaluation.write(run, folder)
    for result in run.scores.results:
        print("\n".join(_lines(result)))
    for study in run.studies:
        print("\n".join(_study(study)))
    tell(f"{', '.join(path.name for path in written)} -> {folder}")


def _table(options: argparse.Namespace) -> None:
    from lidarpose import evaluation
    from lidarpose.io.files import check_apart, write_atomic

    if options.out is not None:
        check_apart(options.out, *map(evaluation.scores_path, options.scores))
    text = evaluation.table(options.scores, format=options.format)
    if options.out is None:
        print(text, end="")
    else:
        write_atomic(options.out, text)
        print(options.out)


def _command(options: argparse.Namespace) -> str:
    """What was asked for, as it would be typed."""
    words = ["lidarpose", "evaluate", options.weights, *options.datasets]
    for name, default in _DEFAULTS.items():
        if (value := getattr(options, name)) != default:
            words += [f"--{name}", str(value)]
    words += [f"--{name.replace('_', '-')}" for name in _SWITCHES if getattr(options, name)]
    return shlex.join(words)


def _progress(stack: ExitStack) -> Callable[[str, int, int], None]:
    """progress(dataset, done, total), which shows one dataset after the other; `stack` ends the last."""
    shown: dict[str, Progress] = {}

    def progress(dataset: str, done: int, total: int) -> None:
        if dataset not in shown:
            stack.close()
            shown[dataset] = stack.enter_context(Progress(total or None, unit="people", label=dataset))
        shown[dataset].update(done)

    return progress


def _lines(result) -> Iterator[str]:
    """The result for a terminal: everybody first, then by condition, joint, distance, points, hidden share."""
    setting, counts = result.setting, result.counts
    yield f"{setting.dataset}: {counts['people']:,} people, {len(setting.joints)} joints, {setting.method}"
    yield f"  protocol {setting.protocol}; center: {setting.centring}; crop: {setting.crop}"
    split = setting.split + (f" ({setting.split_source})" if setting.split_source else "")
    yield f"  split {split}; sensor position {setting.sensor}"
    for note in result.notes:
        yield f"  note: {note}"
    if counts["without a pose"]:
        but = " but PEM" if any(line.figure == "pem" for line in result.lines) else ""
        yield f"  without a pose, and in no metric{but}: {counts['without a pose']:,} people"
    for reason, entry in result.skipped.items():
        yield f"  skipped {entry['count']:,}: {reason} (first: {entry['first']})"
    shown = [line for line in result.lines if _is_shown(line)]
    names = [_named(line, setting) for line in shown]
    wide = max(map(len, names), default=0)
    yield f"  {'':<{wide}}{'value':>8}  {'95 % interval':<16}{'people':>8}"
    for name, line in zip(names, shown, strict=True):
        yield f"  {name:<{wide}}{_value(line):>8}  {_ends(line):<16}{line.people:>8,}  {setting.summary}"


def _is_shown(line) -> bool:
    return (
        line.group == "all" or line.group in _SHOWN and line.figure in _GROUP_METRICS and line.arithmetic == "lidarpose"
    )


def _named(line, setting) -> str:
    words = _TITLES.get(line.figure, line.figure.replace("_", " "))
    if line.group == "plain":
        words += f", {line.of}"
    elif line.group != "all":
        words += f", {line.group.removesuffix(', m')} {line.of}{' m' if line.group.endswith(', m') else ''}"
    if line.arithmetic != "lidarpose":
        words += ", released arithmetic"
    if line.method != setting.method:
        words = f"baseline {line.method.removeprefix('floor: ')}: {words}"
    return f"{words}, {line.unit}"


def _value(line) -> str:
    return "-" if line.value is None else f"{line.value:.1f}"


def _ends(line) -> str:
    return "" if line.low is None else f"[{line.low:.1f}, {line.high:.1f}]"


def _study(study) -> Iterator[str]:
    yield f"{study.setting.method} perturbed: MPJPE in mm of {study.who} · {study.setting.summary}"
    for curve in study.curves:
        points = (f"{p.label}: {'-' if p.mpjpe is None else f'{p.mpjpe:.1f}'}" for p in curve.points)
        yield f"  {curve.title:<38} {'  '.join(points)}"
    for end in study.ends:
        yield f"  {end.group} of the worst {end.worst:,}: {end.mean:.1f} mm, deviation {end.deviation:.1f}"
    for note in study.notes:
        yield f"  note: {note}"
