"""Writes the tables of the README, docs/results.md, evaluate.md, method.md and the model cards, from docs/scores.

    python benchmarks/results.py --collect runs/ablations     # runs' scores.json into docs/scores/ablations.json
    python benchmarks/results.py --curve RUN               # a run of paper-small into docs/scores
    python benchmarks/results.py                              # docs/scores -> the tables of the pages
    python benchmarks/results.py --check                      # exit code 1 if they differ

docs/scores/paper is the output of `lidarpose paper`, NAME.json that of `lidarpose evaluate NAME bench`, NAME-2.json the
same for bench-2, NAME-unknown.json with `--sensor-unknown`, and stability/NAME.json the additional output with
`--stability`; NAME-own.json are scores on 1,000 people of the paper's scene. heldout.json is of goal_tables.py. The
other files are the output of the benchmarks with the same names.

A table stands between `<!-- table NAME -->` and `<!-- end -->`; the text around it is not changed.
"""

import argparse
import json
import re
import sys
from collections.abc import Callable
from functools import lru_cache, partial
from itertools import pairwise
from pathlib import Path

import ablation_tables as changed
import goal_tables as aimed
import speed_tables as timed
import stability_tables as disturbed
from ablation_tables import figures, own_lines
from ablations import VARIANTS
from against_paper import WAYS

from lidarpose.eval.scores import BASELINE, MetricRow, Scores, read_scores
from lidarpose.eval.table import published
from lidarpose.io.atomic import write_atomic
from lidarpose.io.files import content_digest, lined_json
from lidarpose.models import BUNDLED, DEFAULT, VERIFIER, bundled_path, weights_file
from lidarpose.models.checkpoint import load_checkpoint, parameter_count, read_header, runs_of
from lidarpose.paper.markdown import cost_lines, result_lines
from lidarpose.train.run_dir import read_log

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
SCORES = DOCS / "scores"
PAGES = (
    ROOT / "README.md",
    *(DOCS / f"{page}.md" for page in ("results", "evaluate", "method", "recordings")),
    *(DOCS / "cards" / f"{name}.md" for name in (*BUNDLED, "detector")),
)
# the networks that find people
FINDING = ("detector", VERIFIER)
RUNS = "ablations"
# number of people in the longer runs that repeat the first studies
LONGER = 98_304
# the name of plain people in heldout.py
_PLAIN = "upright, whole, uncluttered"
_MARKED = re.compile(r"(<!-- table ([^>]+?) -->\n).*?(<!-- end -->)", re.S)
# scores of detectors trained with other seeds, and the rows of their table: words, set, false positives per scan, group
_DETECTOR_SEEDS = ("detector-seed-2", "detector-seed-3")
_SEED_ROWS = (
    ("frozen scenes, all", "heldout", "0.3", "all", "all"),
    ("frozen scenes, all", "heldout", "1", "all", "all"),
    ("frozen scenes, all", "heldout", "3", "all", "all"),
    ("10 to 19 points", "heldout", "1", "points", "10 to 20"),
    ("20 to 49 points", "heldout", "1", "points", "20 to 50"),
    ("50 points and more", "heldout", "1", "points", "50 and more"),
    ("indoors, 50 points and more", "heldout", "1", "kind, 50 points and more", "indoors"),
    ("riders and wheelchairs", "heldout", "1", "mounted, all", "all"),
    ("three labeled sweeps", "real", "0.3", "all", "all"),
    ("three labeled sweeps", "real", "1", "all", "all"),
)
# studies that share one table
_MORE = ("levels", "mask", "scene", "motion", "network", "steps")


def table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """A Markdown table."""
    lines = [header, ("---",) * len(header), *rows]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def _longest() -> dict[int, dict[str, float]]:
    """The figures of the released `tiny`, by the number of people in all its training runs."""
    scores = {name: figure["value"] for name, figure in figures(_scored("tiny").results[0]).items()}
    return {sum(entry["people_seen"] for entry in runs_of(read_header(bundled_path("tiny")).card)): scores}


def strays(**networks: str) -> str:
    """The increase of errors by clusters of stray points, for networks by the name of their study. Rows say what they
    are of if they are not all of one dataset and version."""
    sources = {name: disturbed.source(name) for name in networks}
    if len(set(sources.values())) > 1:
        networks = {name: f"{what} ({sources[name]})" for name, what in networks.items()}
    header = ("", "undisturbed, mm", *(f"two of {amount} points" for amount in disturbed.amounts(next(iter(networks)))))
    return table(header, [(what, *disturbed.strays(name)) for name, what in networks.items()])


@lru_cache
def _read(name: str) -> dict:
    """The output of a benchmark."""
    return json.loads((SCORES / f"{name}.json").read_text())


@lru_cache
def _scored(model: str) -> Scores:
    """The scores of a bundled model on lidarpose-bench."""
    return read_scores(SCORES / f"{model}.json")


def shipped(model: str, group: str) -> str:
    """MPJPE of a bundled model by groups of people or joints."""
    rows = []
    for line in own_lines(_scored(model).results[0]):
        if line.group in group.split("+") and line.figure == "mpjpe":
            rows.append((changed.WORDS.get(line.of, line.of), f"{line.value:.1f}", _interval(line), f"{line.people:,}"))
    return table((group.split("+")[-1], "MPJPE mm", "95 %", "people"), rows)


def _interval(line: MetricRow) -> str:
    return "" if line.low is None else f"[{line.low:.1f}, {line.high:.1f}]"


def _cell(line: MetricRow) -> str:
    """The value, and its interval if it has one."""
    return f"{line.value:.1f} {_interval(line)}".rstrip()


def _figure(file: str, of: str, figure: str) -> str:
    """A figure of all people or of a group in the scores of a file, with its interval if it has one."""
    lines = (x for x in own_lines(_scored(file).results[0]) if x.figure == figure)
    return _cell(next(x for x in lines if of in (x.group, x.of)))


def headline(bench: str, **files: str) -> str:
    """The main figures of several networks on a bench. files: column title -> name of the scores."""
    figure_by_title = {
        "MPJPE, mm": ("all", "mpjpe"),
        "95th percentile of people's errors, mm": ("all", "mpjpe_p95"),
        "PA-MPJPE, mm": ("all", "pa_mpjpe"),
        "PCK-3, %": ("all", "pck3"),
        "upright, whole, uncluttered, 100 points: MPJPE, mm": ("plain", "mpjpe"),
        "joints without a point within 15 cm: mean error, mm": ("0 to 1", "mpjpe"),
        "with 1 to 4 points": ("1 to 5", "mpjpe"),
        "with 5 to 19 points": ("5 to 20", "mpjpe"),
        "with 20 points and more": ("20 and more", "mpjpe"),
        "facing > 90 deg off, of people of 100 points and more, %": ("100 and more", "turned_round"),
        "facing > 90 deg off, of people of 20 to 100 points, %": ("20 to 100", "turned_round"),
        "confidence: calibration error, %": ("all", "calibration_error"),
        "confidence: AUROC, %": ("all", "auroc"),
    }
    rows = []
    for name, (of, figure) in figure_by_title.items():
        rows.append((name, *(_figure(file, of, figure) for file in files.values())))
    return table((bench, *files), rows)


_MEAN_POSE = f"{BASELINE}mean pose, true facing"
# the bundled models, and the previous default model
_FIRST = {"`tiny`": "tiny", "`small` of 0.2.0": "small-before", "`small`": "small"}
_SECOND = {"`tiny`": "tiny-2", "`small` of 0.2.0": "small-2-before", "`small`": "small-2"}
_CONDITIONS = ("clean", "cluttered", "company", "crop", "occluded")


def _mpjpe(file: str, method: str) -> dict[tuple[str, str], MetricRow]:
    """MPJPE rows of a method, by group and entry of the group."""
    lines = _scored(file).results[0].lines
    mpjpe_lines = (x for x in lines if (x.method, x.figure, x.arithmetic) == (method, "mpjpe", "lidarpose"))
    return {(line.group, line.of): line for line in mpjpe_lines}


def readme() -> str:
    """The headline: the default network, the mean pose, and the paper's published figure on its own data."""
    by_group, mean_pose = _mpjpe(DEFAULT, DEFAULT), _mpjpe(DEFAULT, _MEAN_POSE)["all", "all"]
    network_line = by_group["all", "all"]
    near_joints = {
        "its joints with 20 points and more within 15 cm": by_group["points near the joint", "20 and more"],
        "its joints without a point within 15 cm": by_group["points near the joint", "0 to 1"],
    }
    dapt = next(method for method in published()["methods"] if method["method"] == "DAPT")["figures"]["waymo"]
    rows = [
        (
            f"**`{DEFAULT}`, the default, on `lidarpose-bench`**",
            f"**{network_line.value:.1f}** {_interval(network_line)}",
        ),
        *((words, _cell(line)) for words, line in near_joints.items()),
        ("the mean pose with the true facing, on the same people", f"{mean_pose.value:.1f}"),
        ("for context: the paper's network on Waymo, as printed, not run here", f"{dapt['mpjpe']:.1f}"),
    ]
    return table(("mean joint error, no alignment", "MPJPE, mm"), rows)


def conditions() -> str:
    """The default network by condition, with known and unknown sensor position, and the mean pose."""
    groups = [("all", "all"), *(("condition", name) for name in _CONDITIONS)]
    groups.append(("plain", f"{_PLAIN}, 100 points"))
    sources = {
        "sensor's position known": (DEFAULT, DEFAULT),
        "unknown": (f"{DEFAULT}-unknown", DEFAULT),
        "the mean pose with the true facing": (DEFAULT, _MEAN_POSE),
    }
    rows = []
    for name, source in sources.items():
        lines = _mpjpe(*source)
        rows.append((name, *(f"{lines[group].value:.1f}" for group in groups)))
    return table(("MPJPE, mm", *(changed.WORDS.get(of, of) for _, of in groups)), rows)


def second_bench(group: str) -> str:
    """MPJPE of the bundled models and the previous default on lidarpose-bench-2 by a group of people, in ascending
    order for the default."""
    scores = {name: _mpjpe(file, _scored(file).results[0].setting.method) for name, file in _SECOND.items()}
    lines = [line for key, line in scores["`small`"].items() if key[0] in ("all", group)]
    lines.sort(key=lambda line: (line.group != "all", line.value))
    rows = []
    for line in lines:
        cells = [_cell(score[line.group, line.of]) for score in scores.values()]
        rows.append((changed.WORDS.get(line.of, line.of), *cells, f"{line.people:,}"))
    return table((group, *(f"{name}, mm" for name in scores), "people"), rows)


def persons() -> str:
    """AUROC of the predictions `person` and `second_person` on lidarpose-bench-2, for networks that have them."""
    figure_by_title = {
        "`person`: people before objects": "person_auroc",
        "`second_person`: crops of two people before those of one": "second_person_auroc",
    }
    lines = {(model, line.figure): line for model in BUNDLED for line in own_lines(_scored(f"{model}-2").results[0])}
    models = [model for model in BUNDLED if (model, "person_auroc") in lines]
    # two decimals, since one would round up too far
    rows = [
        (what, *(f"{lines[model, figure].value:.2f}" for model in models)) for what, figure in figure_by_title.items()
    ]
    return table(("AUROC, %", *(f"`{model}`" for model in models)), rows)


def card(model: str) -> str:
    """How a bundled model was trained, from the card in its file."""
    path = bundled_path(model)
    card = read_header(path).card
    runs = runs_of(card)
    if _scored(model).weights["digest"] != content_digest(path, expected="a checkpoint"):
        raise SystemExit(f"docs/scores/{model}.json is of other weights: run lidarpose evaluate {model} bench")
    rows = [
        ("file", f"`{path.name}`, {path.stat().st_size / 1e6:.1f} MB in float16"),
        ("as ONNX", f"`{model}.onnx`, {bundled_path(model, '.onnx').stat().st_size / 1e6:.1f} MB"),
        ("command", f"`{card['command']}`"),
        ("seed", str(card["recipe"]["seed"])),
        ("people seen", _in_all(runs, "people_seen", ",")),
        ("hours", _in_all(runs, "hours", ".2f")),
        ("captured motion", f"{card['motion']}, subjects {', '.join(card['recipe'].get('subjects', ())) or 'all'}"),
    ]
    stages = [
        f"{run['recipe'].get('init', model)} ({previous_run['people_seen']:,} people)"
        for run, previous_run in pairwise(runs)
    ]
    if stages:
        rows.append(("started from", ", itself from ".join(stages)))
    if "note" in card:
        rows.append(("note", card["note"]))
    return table(("", ""), rows)


def finding_card(name: str) -> str:
    """How a network for detecting people was trained, from the card in its file."""
    path = weights_file(f"{name}.safetensors")
    runs = runs_of(read_header(path).card)
    onnx = path.with_suffix(".onnx")
    files = f"`{onnx.name}`, {onnx.stat().st_size / 1e6:.2f} MB; `{path.name}`, {path.stat().st_size / 1e6:.2f} MB"
    rows = [("files", files)]
    for run in runs:
        if "scans_seen" in run:
            rows.append(("command", f"`{run['command']}`"))
            rows.append(("scans shown, hours", f"{run['scans_seen']:,}, {run['hours']:.2f}"))
            rows.append(("people missed in validation", f"{run['validation_missed']:.1f} %"))
        else:
            rows.append(("begun with", f"weights of {run['people_seen']:,} people: `{run['command']}`"))
            break
    return table(("", ""), rows)


def progress(model: str) -> str:
    """The results of a bundled model's consecutive training runs, from the card in its file."""
    rows, people, hours = [], 0, 0.0
    for run in reversed(runs_of(read_header(bundled_path(model)).card)):
        people, hours = people + run["people_seen"], hours + run["hours"]
        scores = run.get("scores", {})
        held_out = (scores.get(f"sensor known, {group}", "- -").split()[1] for group in ("all", _PLAIN))
        # a run that was stopped early has no validation
        validation = f"{run['validation_mm']:.1f}" if "validation_mm" in run else "-"
        rows.append((f"`{run['recipe'].get('size', model)}`", f"{people:,}", f"{hours:.1f}", validation, *held_out))
    return table(("", "people in total", "hours", "validation mm", "`heldout.py` mm", "`heldout.py` plain mm"), rows)


def paper_small(what: str) -> str:
    """The long training of the paper's network at the small width: its "figures" beside those of the bundled networks,
    or its "curve"."""
    run = _read("paper-small-run")
    if what == "curve":
        rows = []
        for line in run["log"]:
            hours, error = line["seconds"] / 3600, 1e3 * line["mpjpe"]
            cells = f"{line['people']:,}", f"{hours:.2f}", f"{error:.0f}", f"{line['heatmap']:.1f}"
            rows.append((*cells, f"{line['validation_mm']:.0f}"))
        return table(("people", "hours", "training error, mm", "training loss", "validation, mm"), rows)
    cards = {name: runs_of(read_header(bundled_path(name)).card) for name in BUNDLED}
    people = {"paper-small": run["log"][-1]["people"]}
    people |= {name: sum(part["people_seen"] for part in runs) for name, runs in cards.items()}
    parameters = {"paper-small": run["parameters"]}
    parameters |= {name: parameter_count(bundled_path(name)) for name in BUNDLED}
    columns = {
        "bench: MPJPE, mm": ("", "all", "mpjpe"),
        "PA-MPJPE, mm": ("", "all", "pa_mpjpe"),
        "plain, mm": ("", "plain", "mpjpe"),
        "facing > 90 deg off, %": ("", "100 and more", "turned_round"),
        "the paper's scene: MPJPE, mm": ("-own", "all", "mpjpe"),
        "its facing > 90 deg off, %": ("-own", "100 and more", "turned_round"),
    }
    rows = []
    for name in people:
        cells = [f"`{name}`", f"{people[name]:,}", f"{parameters[name]:,}"]
        for suffix, of, figure in columns.values():
            cells.append(_figure(f"{name}{suffix}", of, figure))
        rows.append(tuple(cells))
    return table(("", "people in training", "parameters", *columns), rows)


def _in_all(runs: list[dict], name: str, form: str) -> str:
    """A number of the last run, and its sum over all runs."""
    last_value = f"{runs[0][name]:{form}}"
    return last_value if len(runs) == 1 else f"{last_value}; over all runs {sum(run[name] for run in runs):{form}}"


def extras(model: str) -> str:
    """Effects of test-time augmentation; see test_time.py."""
    rows = []
    report = _read("test_time")[model]
    usual_entry = next(entry for entry in report["ways"] if entry["usual"])
    for entry in report["ways"]:
        cost = entry["ms"] / usual_entry["ms"]
        figures = [f"{entry['figures'][name]['value']:.1f}" for name in ("all", "plain", "cluttered", "occluded")]
        flipped = f"{entry['figures']['turned round']['value']:.1f} %"
        rows.append((entry["what"], *figures, flipped, f"{entry['ms']:.1f}", f"{cost:.1f}"))
    head = ("", "MPJPE mm", "plain", "cluttered", "occluded", changed.WORDS["turned round"], "ms a person", "cost")
    return table(head, rows)


def visibility() -> str:
    """Conditions compared with equally occluded clean people; see visibility.py."""
    rows = []
    for model, rows_of_model in _read("visibility").items():
        for entry in rows_of_model:
            ratio = f"{entry['ratio']:.2f} [{entry['low']:.2f}, {entry['high']:.2f}]"
            mm, clean = f"{entry['mm']:.1f}", f"{entry['clean']:.1f}"
            condition = changed.WORDS.get(entry["condition"], entry["condition"])
            rows.append((f"`{model}`", condition, mm, clean, ratio, str(entry["people"])))
    return table(("", "condition", "MPJPE mm", "clean, equally hidden: mm", "ratio", "people"), rows)


# fewest points of the people of the first table of real ones
_REAL = 50


def real(*, is_few: bool = False) -> str:
    """Figures of real people of `_REAL` points and more, or of fewer; see real.py."""
    rows = [
        (
            entry["sweep"].removeprefix("sweep_"),
            entry["person"],
            str(entry["points"]),
            f"{entry['distance']:.1f}",
            f"{entry['turn']:.0f} deg",
            f"{entry['turn_of_four']:.0f} deg",
            f"{100 * entry['near']:.0f} %",
            f"{entry['lean']:.0f} deg",
            f"{entry['confidence']:.2f}",
            f"{entry['is_person']:.2f}",
            "not detected" if entry["to_detected"] is None else f"{entry['to_detected']:.0f}",
        )
        for entry in _read("real")["people"]
        if (entry["points"] < _REAL) == is_few
    ]
    header = ("sweep", "person", "points", "distance m", "facing relative to the box", "the same, `--tta 4`")
    header += ("points within 15 cm of a bone", "trunk lean", "confidence", "`person`", "detected pose, mm away")
    return table(header, rows)


def clips() -> str:
    """Smoothed poses of clips; see clips.py."""
    rows = []
    for name, scores in _read("clips")["ways"].items():
        cells = [name]
        for figure in ("mpjpe", "acceleration"):
            reduction, low, high = scores[f"{figure}_less"]
            cells.append(
                f"{scores[figure]['value']:.1f}"
                + (f" (-{reduction:.0f} % [{low:.0f}, {high:.0f}])" if reduction else "")
            )
        turned = f"{scores['turned_clips_of_these']} of {scores['clips_mostly_right']}"
        rows.append((*cells, f"{scores['pa_mpjpe']:.1f}", turned, f"{scores['bone_deviation']:.1f}"))
    header = ("", "MPJPE mm", "acceleration error, mm a frame squared", "PA-MPJPE mm")
    return table((*header, "clips with a flipped frame", "bone lengths, deviation mm"), rows)


def moved() -> str:
    """Joint distances of real people between two sweeps; see real.py."""
    tracks = [entry for entry in _read("real")["tracks"] if entry["points"] >= _REAL]
    rows = [(entry["person"], f"{entry['mm']:.0f}") for entry in tracks]
    return table(("person", "mean over joints, mm"), rows)


def detector(dataset: str, *groups: str) -> str:
    """Recall of people in whole scans at given false positives per scan; see `lidarpose evaluate detector`."""
    result = next(candidate for candidate in _read("detector")["results"] if candidate["dataset"] == dataset)
    rows = [row for row in result["rows"] if row["figure"] == "recall" and row["group"] in groups]
    cells: dict[tuple[str, str], dict[str, str]] = {}
    for row in rows:
        # older scores may have an interval of zero width
        ends = "" if row["low"] == row["high"] else f" [{row['low']:.0f}, {row['high']:.0f}]"
        value = "" if row["value"] is None else f"{row['value']:.1f}{ends}"
        name = row["group"] if row["of"] == "all" else f"{row['group']}: {row['of']}"
        cells.setdefault((name, f"{row['count']:,}"), {})[row["at"]] = value
    header = ("recall, % (false people a scan)", "people", *result["thresholds"])
    return table(header, [(*key, *(row_cells[at] for at in result["thresholds"])) for key, row_cells in cells.items()])


def detector_seeds() -> str:
    """Recall of the bundled detector and of others trained with other seeds; see `lidarpose evaluate detector`."""
    results_by_file = {file: _read(file)["results"] for file in ("detector", *_DETECTOR_SEEDS)}
    rows = []
    for words, dataset, at, group, of in _SEED_ROWS:
        values, counts = [], set()
        for results in results_by_file.values():
            result = next(candidate for candidate in results if candidate["dataset"] == dataset)
            recall_rows = (row for row in result["rows"] if row["figure"] == "recall")
            row = next(row for row in recall_rows if (row["at"], row["group"], row["of"]) == (at, group, of))
            values.append(row["value"])
            counts.add(f"{row['count']:,}")
        rows.append((words, at, *counts, *(f"{value:.1f}" for value in (*values, sum(values) / len(values)))))
    seeds = [name.removeprefix("detector-").replace("-", " ") for name in _DETECTOR_SEEDS]
    return table(("recall, %", "false people a scan", "people", "bundled", *seeds, "mean"), rows)


def detected_boxes() -> str:
    """Poses in detected boxes compared with poses in labeled boxes; see `lidarpose evaluate detector`."""
    result = next(candidate for candidate in _read("detector")["results"] if candidate["dataset"] == "heldout")
    figures = {name: f"mpjpe_{name}" for name in ("found", "given", "difference")}
    rows = []
    for at, words in (("1", "one false person a scan"), ("default", "the default score")):
        row_by_figure = {row["figure"]: row for row in result["rows"] if row["at"] == at}
        cells = [row_by_figure[figure] for figure in figures.values()]
        values = [f"{cell['value']:.1f} [{cell['low']:.1f}, {cell['high']:.1f}]" for cell in cells]
        rows.append((words, f"{cells[0]['count']:,}", *values))
    return table(("people found at", "people", "MPJPE in found boxes, mm", "in labeled boxes", "difference"), rows)


def background() -> str:
    """Detected people with and without a learned background; see background.py."""
    rows = [
        (
            "the default" if row["score"] is None else f"{row['score']:g}",
            row["background"],
            f"{row['false'] / row['frames']:.2f}",
            f"{row['moving_found']} of {row['moving']}",
            f"{row['found']} of {row['people']}",
        )
        for row in _read("background")["rows"]
    ]
    header = ("least score", "background", "false people a scan", "who move are found", "all are found")
    return table(header, rows)


def tilted() -> str:
    """Detected people with a tilted sensor and on slopes; see tilted.py."""
    rows = [
        (row["scene"], *(f"{row[name]:.1f}" for name in ("all", "many_points", "default")), f"{row['false']:.2f}")
        for row in _read("tilted")["rows"]
    ]
    header = ("scenes", "all", "50 points and more", "the same at the default score", "false people a scan there")
    return table(header, rows)


def calibration() -> str:
    """Calibration of confidence and visibility; see calibration.py."""
    rows = [(entry["what"], f"{entry['ece']:.3f}", f"{entry['auroc']:.3f}") for entry in _read("calibration")["stated"]]
    return table(("", "expected calibration error", "AUROC"), rows)


def spread() -> str:
    """Predicted `spread` compared with true errors; see calibration.py."""
    report = _read("calibration")
    rows = [
        (entry["of"], f"{entry['share']:.1f} %", f"{entry['stated']:.1f}", f"{entry['true']:.1f}")
        for entry in report["spread"]
    ]
    rows.append(("rank correlation of the two", "", "", f"{report['rank']:.2f}"))
    return table(("`spread`", "joints", "predicted, mm", "true, mm"), rows)


def rejection(model: str) -> str:
    report = _read("test_time")[model]["rejection"]
    rows = [(f"{entry['kept']:.0f} %", f"{entry['people']:.1f}", f"{entry['joints']:.1f}") for entry in report]
    return table(
        ("kept", "people with the highest mean confidence: mm", "joints with the highest confidence: mm"), rows
    )


def _labels(variant: str) -> dict[str, str]:
    """The study and the description of a variant."""
    if variant in WAYS:
        return {"study": "paper", "what": WAYS[variant].what}
    return {"study": VARIANTS[variant].study, "what": VARIANTS[variant].what}


def tracks() -> str:
    """Tracking on streets of ten people; see tracks.py."""
    names = ("idf1", "hota", "mota", "recall", "precision")
    rows = [
        (row["boxes"], row["by"], *(f"{row[name]:.3f}" for name in names), str(row["switches"]))
        for row in _read("tracks")["rows"]
    ]
    return table(("boxes", "numbered by", "IDF1", "HOTA", "MOTA", "recall", "precision", "switches"), rows)


def paper(name: str) -> str:
    """A table of the paper on synthesized people, and the cost of its finished cells; see `lidarpose paper`."""
    content = _read(f"paper/{name}")
    return "\n".join([*result_lines(content), "", *cost_lines(content, finished=True), ""])


def tables() -> dict[str, Callable[[], str]]:
    """The functions that create the tables, by table name."""
    all_runs = [run | _labels(run["variant"]) for run in _read(RUNS)]
    runs, later_runs = (
        [run for run in all_runs if bool(run["begun"]) == is_continued] for is_continued in (False, True)
    )
    longer_runs = [run for run in runs if run["people"] == LONGER]
    studies = {name: (runs, {name}) for name in {run["study"] for run in runs}}
    studies |= {
        "more": (runs, _MORE),
        "longer": (longer_runs, {run["study"] for run in longer_runs} - {"paper"}),
        "continued": (later_runs, None),
    }
    makers = {
        f"study {name}": lambda arguments=arguments: table(*changed.study(*arguments))
        for name, arguments in studies.items()
    }
    makers["noise"], makers["noise continued"] = partial(changed.noise, runs), partial(changed.noise, later_runs)
    makers["scaling"] = lambda: table(*changed.scaling(runs, _longest()))
    makers["against the paper"] = lambda: table(*changed.against_paper(runs))
    makers["speed"] = lambda: table(*timed.medians(_read("speed")))
    makers["speed ratios"] = lambda: table(*timed.ratios(_read("speed")["targets"]))
    makers |= {"calibration": calibration, "spread": spread, "real moved": moved, "clips": clips}
    for group in ("points", "kind", "sensor", "activity", "condition", "distance, m", "height", "tilt"):
        recall_groups = (
            ("all", "points", "mounted, all") if group == "points" else (group, f"{group}, 50 points and more")
        )
        makers |= {
            f"detector {name} by {group}": partial(detector, name, *recall_groups) for name in ("heldout", "real")
        }
    makers |= {
        "visibility": visibility,
        "real": real,
        "real few": partial(real, is_few=True),
        "tracks": tracks,
        "detected boxes": detected_boxes,
    }
    makers |= {"background": background, "tilted": tilted, "detector seeds": detector_seeds} | {
        f"{name} card": partial(finding_card, name) for name in FINDING
    }
    makers |= {f"paper {path.stem}": partial(paper, path.stem) for path in sorted((SCORES / "paper").glob("*.json"))}
    makers["headline"] = partial(headline, "lidarpose-bench", **_FIRST)
    makers["headline bench-2"] = partial(headline, "lidarpose-bench-2", **_SECOND)
    makers |= {"readme": readme, "conditions": conditions}
    makers |= {
        f"bench-2 by {group}": partial(second_bench, group) for group in ("condition", "poses", "family", "sensor")
    }
    makers["bench-2 persons"] = persons
    makers |= {f"paper-small {what}": partial(paper_small, what) for what in ("figures", "curve")}
    makers["paper fig7 curves"] = lambda: table(*disturbed.networks("fig7"))
    makers["stability"] = lambda: table(("", "undisturbed", *5 * ("",)), disturbed.curves(DEFAULT))
    makers["stability sensors"] = lambda: table(("sensor", "points", "MPJPE mm"), disturbed.sensors(DEFAULT))
    makers["stability ends"] = lambda: table(("", "mean, mm", "deviation"), disturbed.ends(DEFAULT))
    makers |= {"goals": lambda: table(*aimed.goals()), "heldout": lambda: table(*aimed.heldout())}
    makers |= {"point times": lambda: table(*aimed.point_times())}
    makers |= {"point times scans": lambda: table(*aimed.whole_scans())}
    makers["strays"] = partial(
        strays,
        paper="the paper's design, faster rates, 98,304 people",
        ours="ours: `tiny` without convolutions, 98,304 people",
        often="the same, stray points around three people in five in training",
        small="`small` as it ships",
    )
    for model in BUNDLED:
        makers |= {f"{model} card": partial(card, model), f"{model} progress": partial(progress, model)}
        groups = dict.fromkeys(["all+condition", *(line.group for line in own_lines(_scored(model).results[0]))])
        makers |= {f"{model} by {group}": partial(shipped, model, group) for group in groups}
        makers |= {f"{model} extras": partial(extras, model), f"{model} rejection": partial(rejection, model)}
    return makers


def written(page: str) -> str:
    """The page with regenerated tables. Raises KeyError for an unknown table."""
    makers = tables()
    return _MARKED.sub(lambda match: match[1] + "\n" + makers[match[2]]() + "\n" + match[3], page)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--collect", type=Path, metavar="DIR", help="folder of runs whose scores are added")
    parser.add_argument("--curve", type=Path, metavar="RUN", help="folder of a run of paper-small to store")
    parser.add_argument("--check", action="store_true", help="write nothing, say whether the page is up to date")
    options = parser.parse_args()
    if options.collect:
        runs, path = changed.collect(options.collect, _read(RUNS)), SCORES / f"{RUNS}.json"
        write_atomic(path, "[\n" + ",\n".join(json.dumps(run) for run in runs) + "\n]\n")
        print(f"{len(runs)} runs -> {path}")
        return
    if options.curve:
        network, header = load_checkpoint(options.curve / "model.safetensors")
        count = sum(value.numel() for value in network.parameters())
        log = [line for line in read_log(options.curve) if "validation_mm" in line]
        content = {"command": header.card["command"], "parameters": count, "log": log}
        write_atomic(SCORES / "paper-small-run.json", lined_json(content, "log") + "\n")
        return
    for path in PAGES:
        page = path.read_text()
        new_page = written(page)
        if options.check and new_page != page:
            sys.exit(f"{path.name} is not what docs/scores say: run benchmarks/results.py")
        if not options.check:
            write_atomic(path, new_page)


if __name__ == "__main__":
    main()
