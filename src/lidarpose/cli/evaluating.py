"""`lidarpose evaluate` and `table`."""

import argparse
import shlex
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from types import SimpleNamespace

from lidarpose.cli.terminal import add_command, flag, option_names, tell
from lidarpose.errors import InputError
from lidarpose.models import BUNDLED, DEFAULT
from lidarpose.progress import Progress

# options of `evaluation.run`
_OPTIONS = """
--protocol NAME = clean  clean (default), or dapt: crops and centers from labels, as in the released code
--split NAME  split to score, or all (default: test, else val, else all)
--skeleton NAME  score the joints of this skeleton (default: the dataset's)
--limit N  score only N people (detector: N scans), evenly spaced
--seed N = 0  random seed for displaced boxes and intervals (default 0)
--device NAME = cpu  cpu (default), or cuda (backend torch)
--backend NAME  onnx or torch, as in lidarpose predict
--decode NAME = window  as in lidarpose predict; the released code uses dark
--tta N = 1  test-time augmentation: passes per person, 1 (default) to 8; protocol clean only
--stability  also perturb the points and draw the curves
--legacy  also score with the released code's arithmetic
--sensor-unknown  hide the sensor's position
"""
# those of `_OPTIONS` that also apply to the detector
_OF_BOTH = ("limit", "seed", "sensor_unknown")
# the name that selects the detector instead of a network, and the detector's own options
DETECTOR = "detector"
_DETECTOR = """
--scans DIR&  a folder of SCAN.json of labeled people beside SCAN.pcd, .bin, .ply, .npy or another; may be repeated
--method NAME  detector (default), scorer: without poses, or baselines: pose, candidates
--detector FILE  ONNX file of a detector (default: the bundled one)
--range M  ignore people farther from the sensor, m (default 40)
--network NAME  compare poses in detected and in labeled boxes: a checkpoint (default small), or none
--pictures DIR  draw the highest-scoring false positives and the missed people into DIR
"""
_EVALUATE = f"""
score a checkpoint on datasets
Prints metrics and writes scores.json, poses.parquet and pictures into a folder.
$ lidarpose evaluate small bench
$ lidarpose evaluate small prepared/waymo --out scores/waymo
$ lidarpose evaluate detector --scans labeled --pictures look
<weights> CHECKPOINT  {", ".join(BUNDLED)}, a checkpoint, an exported .onnx, or detector: people detection in whole
 scans
<datasets> DATASET*  a folder written by prepare or synth, bench or bench-2; of detector heldout (default without
 --scans)
{_OPTIONS}
--out DIR  a new or empty folder (default evaluation/NAME, numbered)
[evaluate detector]
{_DETECTOR}
"""
_TABLE = """
show scores beside the paper's Table 1
Shows scores.json files beside the figures printed in the paper, by protocol.
$ lidarpose table evaluation/small
<scores> FILE|DIR*  scores.json files, or folders that contain one
--format NAME = markdown  markdown (default) or json
--out FILE  write to FILE (default: print)
"""
_TABLE_SUFFIXES = {"markdown": (".md", ".markdown", ".txt"), "json": (".json",)}
# groups of rows printed to the terminal; the others are only in scores.json
_SHOWN = (
    *("condition", "family", "sensor", "plain", "joints", "body", "joint"),
    *("distance, m", "points", "hidden share", "points near the joint"),
)
# metrics that are printed for these groups; for all people together, all metrics are printed
_GROUP_METRICS = ("mpjpe", "turned_round", "pck_10cm")
_TITLES = {
    **{"mpjpe": "MPJPE", "pa_mpjpe": "PA-MPJPE", "pck3": "PCK-3", "pck5": "PCK-5"},
    "root_mpjpe": "MPJPE relative to the root",
    **{"turned_round": "facing flipped (> 90 deg)", "pem": "PEM", "oks_ap": "OKS-AP", "auroc": "AUROC"},
    **{"pck_10cm": "within 10 cm", "mpjpe_p95": "95th percentile of people's errors"},
    **{"person_auroc": "AUROC of person", "second_person_auroc": "AUROC of a second person"},
}
# names of conditions in files -> as printed
_CONDITIONS = {"company": "second person", "crop": "poor box"}


def add(commands) -> None:
    """Adds the commands to the parser's."""
    evaluate = add_command(commands, "evaluate", _evaluate, _EVALUATE)
    evaluate.set_defaults(defaults={name: evaluate.get_default(name) for name in option_names(_OPTIONS + _DETECTOR)})
    add_command(commands, "table", _table, _TABLE)


def _evaluate(options: argparse.Namespace) -> None:
    from lidarpose import evaluation

    if options.weights == DETECTOR:
        return _evaluate_detector(options)
    if detector_flags := [f"--{name}" for name in option_names(_DETECTOR) if getattr(options, name) is not None]:
        raise InputError(
            f"{detector_flags[0]} is an option of lidarpose evaluate detector, got the network {options.weights}: "
            "omit it"
        )
    folder = evaluation.new_folder(options.weights) if options.out is None else evaluation.check_folder(options.out)
    settings = {name: getattr(options, name) for name in option_names(_OPTIONS)}
    with ExitStack() as stack:
        progress = _progress(stack)
        run = evaluation.run(
            options.weights, options.datasets, command=_command(options), progress=progress, **settings
        )
    paths = evaluation.write(run, folder)
    for result in run.scores.results:
        print("\n".join(_lines(result)))
    for study in run.studies:
        print("\n".join(_study(study)))
    tell(f"{', '.join(path.name for path in paths)} -> {folder}")


def _evaluate_detector(options: argparse.Namespace) -> None:
    from lidarpose import evaluation
    from lidarpose.eval.detector.evaluate_detector import run_detector, write_detector
    from lidarpose.eval.detector.labeled_scans import HELDOUT

    for name in option_names(_OPTIONS):
        if name not in _OF_BOTH and getattr(options, name) != options.defaults[name]:
            raise InputError(f"{flag(name)} is an option for pose networks, got the detector: omit it")
    if others := [dataset for dataset in options.datasets if dataset != HELDOUT]:
        raise InputError(f"expected {HELDOUT} or nothing as the detector's dataset, got {others[0]}: use --scans")
    folder = evaluation.new_folder(f"{DETECTOR}.onnx") if options.out is None else evaluation.check_folder(options.out)
    pictures = None if options.pictures is None else evaluation.check_folder(options.pictures)
    settings = {name: value for name in _OF_BOTH if (value := getattr(options, name)) is not None}
    settings |= {"method": options.method or DETECTOR, "max_range": 40.0 if options.range is None else options.range}
    network = {None: DEFAULT, "none": None}.get(options.network, options.network)
    with ExitStack() as stack:
        progress = _progress(stack, unit="scans")
        results, sets = run_detector(
            heldout=bool(options.datasets) or not options.scans,
            folders=options.scans or (),
            network=network,
            weights=options.detector,
            progress=progress,
            **settings,
        )
    run_info = {"command": _command(options), **settings, "detector": options.detector, "network": network}
    paths = write_detector(results, sets, folder, run_info, pictures)
    for result in results:
        print("\n".join(_detector_lines(result)))
    tell(f"{', '.join(path.name for path in paths)} -> {folder}{'' if pictures is None else f', {pictures}'}")


def _detector_lines(result) -> Iterator[str]:
    """A table of recall by operating point and group, and the other figures."""
    import pandas

    rows = pandas.DataFrame(result.rows)
    records = [SimpleNamespace(**row) for row in result.rows]
    rows["cell"] = [f"{_value(row)} {_interval_text(row)}".rstrip() for row in records]
    recall = rows[rows.figure == "recall"].set_index(["group", "of", "count", "at"]).cell.unstack(sort=False)
    recall.columns = [f"at {at} (score {score:.2f})" for at, score in result.thresholds.items()]
    yield f"{result.dataset}: {result.scans:,} scans; recall, %, at this many false positives per scan:"
    yield recall.to_string()
    if result.changed:
        yield f"  note: {result.changed:,} scenes differ from the frozen ones: not comparable with other scores"
    for row in rows[(rows.figure != "recall") & rows["at"].isin(["", "1", "default"])].itertuples():
        words = (row.figure.replace("_", " "), row.at and f"at {row.at}", row.group, row.of if row.of != "all" else "")
        yield f"  {' '.join(filter(None, words))}: {row.cell} {row.unit}"
    for kind, count in result.things.items():
        yield f"  false positives at 1 per scan: {count:,} {kind}"


def _table(options: argparse.Namespace) -> None:
    from lidarpose import evaluation
    from lidarpose.io.atomic import check_suffix, write_atomic
    from lidarpose.io.files import check_not_input

    if options.out is not None:
        check_not_input(options.out, *map(evaluation.scores_path, options.scores))
    text = evaluation.table(options.scores, format=options.format)
    if options.out is None:
        print(text, end="")
    else:
        check_suffix(options.out, *_TABLE_SUFFIXES[options.format])
        write_atomic(options.out, text)
        print(options.out)


def _command(options: argparse.Namespace) -> str:
    """What was asked for, as it would be typed."""
    words, switches = ["lidarpose", "evaluate", options.weights, *options.datasets], []
    for name, default in options.defaults.items():
        value = getattr(options, name)
        if value is True:
            switches.append(flag(name))
        elif value != default:
            words += [
                word for part in (value if isinstance(value, list) else [value]) for word in (flag(name), str(part))
            ]
    return shlex.join([*words, *switches])


def _progress(stack: ExitStack, unit: str = "people") -> Callable[[str, int, int], None]:
    """progress(dataset, done, total), which shows one dataset after the other; `stack` ends the last."""
    bars: dict[str, Progress] = {}

    def progress(dataset: str, done: int, total: int) -> None:
        if dataset not in bars:
            stack.close()
            bars[dataset] = stack.enter_context(Progress(total or None, unit=unit, label=dataset))
        bars[dataset].update(done)

    return progress


def _lines(result) -> Iterator[str]:
    """The result for a terminal: the headline figure, its protocol, then all figures: of everybody, by condition,
    joint, distance, points, hidden share, points near the joint."""
    setting, counts = result.setting, result.counts
    mpjpe = result.line("mpjpe")
    headline = f"MPJPE {_value(mpjpe)} mm {_interval_text(mpjpe)}".rstrip()
    yield f"{setting.dataset}: {headline}, {mpjpe.people:,} of {counts['people']:,} people · {setting.method}"
    yield f"  {setting.summary} · {len(setting.joints)} joints"
    split = setting.split + (f" ({setting.split_source})" if setting.split_source else "")
    yield f"  center: {setting.centring}; crop: {setting.crop}; split {split}; sensor position {setting.sensor}"
    for note in result.notes:
        yield f"  note: {note}"
    if counts["without a pose"]:
        exception = " except PEM" if any(row.figure == "pem" for row in result.lines) else ""
        yield f"  without a pose, and in no metric{exception}: {counts['without a pose']:,} people"
    for reason, entry in result.skipped.items():
        yield f"  skipped {entry['count']:,}: {reason} (first: {entry['first']})"
    rows = [(_named(row, setting), row) for row in result.lines if _is_shown(row)]
    name_width = max(len(name) for name, _ in rows)
    yield f"  {'':<{name_width}}{'value':>8}  {'95 % interval':<16}{'people':>8}"
    for name, row in rows:
        yield f"  {name:<{name_width}}{_value(row):>8}  {_interval_text(row):<16}{row.people:>8,}"


def _is_shown(row) -> bool:
    return row.group == "all" or row.group in _SHOWN and row.figure in _GROUP_METRICS and row.arithmetic == "lidarpose"


def _named(row, setting) -> str:
    words = _TITLES.get(row.figure, row.figure.replace("_", " "))
    if row.group == "plain":
        words += f", {row.of}"
    elif row.group != "all":
        value = _CONDITIONS.get(row.of, row.of) if row.group == "condition" else row.of
        words += f", {row.group.removesuffix(', m')} {value}{' m' if row.group.endswith(', m') else ''}"
    if row.arithmetic != "lidarpose":
        words += ", released arithmetic"
    if row.method != setting.method:
        words = f"baseline {row.method.removeprefix('floor: ')}: {words}"
    return f"{words}, {row.unit}"


def _value(row) -> str:
    return "-" if row.value is None else f"{row.value:.1f}"


def _interval_text(row) -> str:
    return "" if row.low is None else f"[{row.low:.1f}, {row.high:.1f}]"


def _study(study) -> Iterator[str]:
    yield f"{study.setting.method} perturbed: MPJPE in mm of {study.who} · {study.setting.summary}"
    for curve in study.curves:
        points = (
            f"{p.label}: {'-' if p.mpjpe is None else f'{p.mpjpe:.1f}'}"
            + f" ({p.no_pose} without pose)" * (p.no_pose > 0)
            for p in curve.points
        )
        yield f"  {curve.title:<38} {'  '.join(points)}"
    for end in study.ends:
        yield f"  {end.group} of the worst {end.worst:,} people: {end.mean:.1f} mm, deviation {end.deviation:.1f}"
    for note in study.notes:
        yield f"  note: {note}"
