"""Runs a table and writes it: each cell's result, its cost, and the mean pose's error for comparison."""

import json
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose._version import __version__
from lidarpose.body.mocap import load_motion
from lidarpose.data.dataset_card import CARD
from lidarpose.errors import InputError, LidarPoseError, counted
from lidarpose.eval.dataset import EvalSample, open_eval_dataset
from lidarpose.eval.metrics import aggregate
from lidarpose.eval.predictions import read_poses
from lidarpose.eval.protocols import DAPT, check_protocol
from lidarpose.eval.scores import FILE, Result, read_scores
from lidarpose.eval.table import COLUMNS
from lidarpose.io.atomic import write_atomic
from lidarpose.io.files import content_digest, read_json
from lidarpose.models.checkpoint import load_checkpoint, runs_of
from lidarpose.paper.cells import PROTOCOL, Cell, Options, Table, Target, cells
from lidarpose.paper.markdown import ROOT, markdown
from lidarpose.paper.steps import (
    CELLS,
    POSES,
    Execute,
    Step,
    StepFailed,
    begin_out,
    is_done,
    last_entry,
    length_of,
    run_steps,
)
from lidarpose.paper.tables import target_text
from lidarpose.sample import MIN_POINTS, center_of

SCHEMA = "lidarpose.paper/1"
# a network whose error is not lower than the mean pose's by this share has not been trained enough to compare
_UNDERTRAINED = 0.2
# maximum number of people that the mean pose is computed from
_MEAN_POSE = 5_000
# options of steps whose values are files or folders of the user
_FILES = ("--motion", "--body", "--shards")
# the file of an evaluation's studies of perturbed points
_STUDIES = "stability.json"


def run_table(
    table: Table, options: Options, out: Path, chosen: Sequence[str], execute: Execute, tell: Any
) -> dict[str, Any]:
    """Runs the unfinished cells of a table in the chosen rows, by default in all, rewrites the table after each, and
    returns it. The written table has all rows.

    A failed cell is reported and recorded, and the other cells are still run. A cell whose results exist is done, even
    if it was run elsewhere.
    """
    begin_out(out)
    all_cells, chosen_cells = cells(table, options), cells(table, options, chosen)
    for warning in check_targets(chosen_cells):
        tell(warning)
    failures: dict[int, str] = {}
    content: dict[str, Any] = {}
    for k, cell in enumerate(all_cells):
        if cell not in chosen_cells:
            continue
        if cell.evaluation is not None and not _is_there(table, cell.evaluation, out):
            try:
                run_steps(cell.evaluation, out, execute, tell)
            except StepFailed as error:
                failures[k] = str(error)
                tell(f"{cell.row}, {cell.column}: failed: {error}")
        content = write_table(table, options, out, failures, chosen=chosen)
    return content


def check_targets(selected: Sequence[Cell]) -> list[str]:
    """Warnings, a line each, about real sets; before hours of training. Raises InputError, one line, if one cannot be
    trained on, or scored under the protocol, or if a file that a step reads is missing."""
    warnings = []
    words = [step.words for cell in selected if cell.evaluation for step in cell.evaluation.all()]
    files = {str(value): option for step in words for option, value in pairwise(step) if option in _FILES}
    for file, option in files.items():
        if not Path(file).exists():
            raise InputError(f"{file}: no such file or folder, for {option}")
    options = [dict(pairwise(map(str, step))) for step in words]
    # read here, too: without these clips, a row would end after hours of others
    for motion, subjects in dict.fromkeys((o["--motion"], o.get("--subjects")) for o in options if "--motion" in o):
        clips = load_motion(motion)
        if subjects:
            clips.of(tuple(subjects.split(",")))
    for train in dict.fromkeys(cell.target.train for cell in selected if cell.evaluation is not None):
        if isinstance(train, str):
            open_eval_dataset(train, split="train", limit=1)
    for test in dict.fromkeys(cell.target.test for cell in selected if cell.evaluation is not None):
        if isinstance(test, str):
            dataset = open_eval_dataset(test)
            check_protocol(PROTOCOL, dataset)
            if dataset.settings.get("level"):
                warnings.append(f"{test}: sequences out of level were turned; as in the paper: prepare with --no-level")
    return warnings


def _is_there(table: Table, evaluation: Step, out: Path) -> bool:
    """Whether a cell's results exist, for a figure with all that it is drawn from."""
    is_drawn = table.name.startswith("fig")
    return _path(evaluation, out).is_file() and (not is_drawn or can_be_drawn(table.name, evaluation, out))


def can_be_drawn(name: str, evaluation: Step, out: Path) -> bool:
    """Whether everything exists that a cell of fig5, fig7 or fig8 is drawn from: the curves are part of the cell's
    results, the poses of fig5 only of the evaluation's own folder."""
    return is_done(evaluation, out) if name == "fig5" else stability_study(evaluation, out) is not None


def write_table(
    table: Table,
    options: Options,
    out: Path,
    failed: dict[int, str] | None = None,
    *,
    chosen: Sequence[str] = (),
    update: bool = False,
) -> dict[str, Any]:
    """Writes OUT/TABLE.json and OUT/TABLE.md from the existing results, and the JSON of each finished cell.

    Args:
        failed: number of a cell -> its error.
        chosen: rows that are meant to have all seeds, by default all; others have the first, and what was run.
        update: raise InputError instead of replacing a table with finished cells, if with these options none is.
    """
    failed, all_cells, chosen_cells = failed or {}, cells(table, options), cells(table, options, chosen)
    path = out / f"{table.name}.json"
    earlier = _earlier_cells(path)
    entries = [_entry(cell, out, failed.get(k, ""), earlier) for k, cell in enumerate(all_cells)]
    for cell, entry in zip(all_cells, entries, strict=True):
        entry |= _difference(cell, _reference(table, cell, all_cells), out) if entry["state"] == "done" else {}
    is_meant = [cell in chosen_cells or not cell.seed for cell in all_cells]
    entries = [
        entry for entry, is_kept in zip(entries, is_meant, strict=True) if is_kept or entry["state"] != "not run"
    ]
    content = {
        "schema": SCHEMA,
        "version": __version__,
        "table": table.name,
        "title": table.title,
        "target": target_text(table, options),
        "people": options.people,
        "hours": options.hours,
        "reference": table.reference,
        "cells": entries,
    }
    if update and not _finished(entries):
        count = _finished(earlier)
        if count:
            problem = f"{path} has {counted(count, 'finished cell')}, none of them run with these options"
            raise InputError(f"{problem}: repeat --data, --people, --size and the others of the command that ran them")
    write_atomic(path, json.dumps(content, indent=1) + "\n")
    write_atomic(out / f"{table.name}.md", markdown(content))
    return content


def _earlier_cells(path: Path) -> list[dict[str, Any]]:
    """The cells of a table as written before; none if it is missing or damaged, since it is made from other files."""
    try:
        return read_json(path, expected="a table")["cells"] if path.is_file() else []
    except (LidarPoseError, LookupError, TypeError):
        return []


def _finished(entries: Sequence[dict[str, Any]]) -> int:
    return sum(entry["state"] == "done" for entry in entries)


def _entry(cell: Cell, out: Path, failure: str, earlier: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """A cell as JSON. state: done, failed, not run or not possible; finished cells also have their results.

    failure: its error, now; earlier: the cells as written before, from which an earlier error is kept.
    """
    steps = list(cell.evaluation.all()) if cell.evaluation else []
    entry: dict[str, Any] = {"row": cell.row, "column": cell.column, "seed": cell.seed, "published": cell.published}
    entry["commands"] = [step.line(out) for step in steps]
    if cell.evaluation is None:
        return entry | {"state": "not possible", "reason": cell.why}
    if failure:
        return entry | {"state": "failed", "reason": failure}
    path = _path(cell.evaluation, out)
    if path.is_file():
        return entry | _without_study(read_json(path, expected="a cell's results"))
    if not is_done(cell.evaluation, out):
        for old in earlier:
            if old["state"] == "failed" and old["commands"] == entry["commands"]:
                return entry | {"state": "failed", "reason": old["reason"]}
        return entry | {"state": "not run", "reason": "its command was not run, or did not finish"}
    try:
        figures = {"state": "done"} | _figures(cell, cell.evaluation, out)
    except LidarPoseError as error:
        return entry | {"state": "failed", "reason": str(error)}
    write_atomic(path, json.dumps(figures, indent=1) + "\n")
    return entry | _without_study(figures)


def _without_study(results: dict[str, Any]) -> dict[str, Any]:
    """A cell's results without the curves of a figure, which no table shows."""
    return {name: value for name, value in results.items() if name != "stability"}


def _reference(table: Table, cell: Cell, all_cells: Sequence[Cell]) -> Cell | None:
    """The cell in the table's reference row with the same column and seed."""
    wanted = (table.reference, cell.column, cell.seed)
    return next((other for other in all_cells if (other.row, other.column, other.seed) == wanted), None)


def _difference(cell: Cell, reference: Cell | None, out: Path) -> dict[str, float | None]:
    """A cell's MPJPE minus the reference's on the same people, mm, and its 95 % interval over people or sequences, None
    for too few of them; empty for the reference itself, for different people, or if the poses of either are missing."""
    steps = [other.evaluation for other in (cell, reference) if other is not None and other.evaluation is not None]
    paths = [step.product(out) / POSES for step in steps]
    if len(set(paths)) < 2 or not all(path.is_file() for path in paths):
        return {}
    (first,), (second,) = (read_poses(path).values() for path in paths)
    if first.skeleton.joints != second.skeleton.joints or not np.array_equal(first.true, second.true, equal_nan=True):
        return {}
    # only people with a pose from both networks can be compared
    both = first.posed & second.posed
    errors, reference_errors = (people.select(both).errors() for people in (first, second))
    clustered = read_scores(paths[0].with_name(FILE)).results[0].setting.clusters
    clusters = first.sequence[both] if clustered else None
    ends = aggregate.paired_interval(errors, reference_errors, np.random.default_rng(0), clusters=clusters)
    value, (low, high) = aggregate.mean(errors - reference_errors), ends.stated
    return {"difference": value, "difference_low": low, "difference_high": high}


def _path(evaluation: Step, out: Path) -> Path:
    """The file of a cell's results, which exists once the cell is finished."""
    return out / CELLS / f"{evaluation.name}.json"


def stability_study(evaluation: Step, out: Path) -> dict[str, Any] | None:
    """The evaluation's study of perturbed points: from the cell's results, which may have been copied here, else from
    its own folder; None if there is none."""
    path = _path(evaluation, out)
    study = read_json(path, expected="a cell's results").get("stability") if path.is_file() else None
    path = evaluation.product(out) / _STUDIES
    if study is None and path.is_file() and is_done(evaluation, out):
        study = read_json(path, expected="a study of stability")["studies"][0]
    return study


def _figures(cell: Cell, evaluation: Step, out: Path) -> dict[str, Any]:
    """An evaluation's results, the cost of the training, and the mean pose's error on the same people."""
    result = read_scores(evaluation.product(out) / FILE).results[0]
    lengths = {step.line(out): length_of(step, out) for step in evaluation.all()}
    # for shortened trainings, the commands that were actually run
    commands = [" ".join([line, *length]) for line, length in lengths.items()]
    network, header = load_checkpoint(cell.training[-1].product(out))
    runs, entry = runs_of(header.card), last_entry(cell.training[-1].folder(out))
    row, study = result.line("mpjpe"), stability_study(evaluation, out)
    left_out = [
        f"not scored: {entry['count']:,} {reason}; {entry['first']}" for reason, entry in result.skipped.items()
    ]
    # of pre-training and fine-tuning
    warnings = dict.fromkeys(warning for run in runs for warning in run.get("warnings", ()))
    mean_pose = mean_pose_error(cell.target, result, out)
    return {
        **{name: _value(result, name) for name in (*COLUMNS, ROOT)},
        "low": row.low,
        "high": row.high,
        "people_scored": row.people,
        "joints": list(result.setting.joints),
        "protocol": result.setting.summary,
        "notes": [*result.notes, *left_out, *(f"training: {warning}" for warning in warnings)],
        "people_seen": sum(run.get("people_seen", 0) for run in runs),
        "hours": round(sum(run.get("hours", 0.0) for run in runs), 3),
        "people_per_second": round(entry["people"] / entry["seconds"], 1) if entry and entry["seconds"] else None,
        "size": cell.size,
        "parameters": sum(value.numel() for value in network.parameters()),
        "mean_pose": mean_pose,
        "undertrained": row.value is None or row.value > (1 - _UNDERTRAINED) * mean_pose,
        "scores": str(evaluation.product(out) / FILE),
        **({} if study is None else {"stability": study}),
        **({"commands": commands} if any(lengths.values()) else {}),
    }


def _value(result: Result, name: str) -> float | None:
    try:
        return result.line(name).value
    except LidarPoseError:
        # not every dataset has every metric
        return None


def mean_pose_error(target: Target, result: Result, out: Path) -> float:
    """MPJPE in mm of a baseline that predicts the mean skeleton of the training people about the protocol's center.

    It is scored on the people and joints of `result`. The center comes from labels or from a person's points,
    depending on the protocol.
    """
    folders = [str(part.product(out)) if isinstance(part, Step) else part for part in (target.train, target.test)]
    # real sets may be prepared again, and shards be damaged: the card's digest and the number of people tell them apart
    version = None
    if not isinstance(target.test, Step):
        digest = content_digest(Path(folders[1]) / CARD, expected="a dataset")
        version = f"{digest[:8]}-{result.setting.total}"
    # different budgets have different training people, but are scored on the same people
    learned = target.train.name if isinstance(target.train, Step) else None
    name = filter(None, (result.setting.dataset, str(len(result.setting.joints)), version, learned))
    path = out / CELLS / f"mean-pose-{'-'.join(name)}.json"
    if not path.is_file():
        split = None if isinstance(target.train, Step) else "train"
        train_offsets = [
            _offset(person, result) for person in open_eval_dataset(folders[0], split=split, limit=_MEAN_POSE)
        ]
        least = DAPT[result.setting.kind].least if result.setting.protocol == PROTOCOL else MIN_POINTS
        test_people = (person for person in open_eval_dataset(folders[1], split=None) if len(person.points) >= least)
        test_offsets = [_offset(person, result) for person in test_people]
        mean = np.nanmean(train_offsets, 0)
        errors = 1e3 * np.linalg.norm(np.array(test_offsets) - mean, axis=-1)
        error = aggregate.mean(errors)
        write_atomic(path, json.dumps({"mpjpe": round(error, 1), "people": len(test_offsets)}) + "\n")
    return read_json(path, expected="the error of the mean pose")["mpjpe"]


def _offset(person: EvalSample, result: Result) -> np.ndarray:
    """(J, 3) m: the scored joints relative to the protocol's center, NaN without a label or points."""
    sample, setting = person.sample, result.setting
    columns = [sample.skeleton.index(joint) for joint in setting.joints]
    is_labeled = (sample.joint_labels[columns] > 0)[:, None]
    center = center_of(person.points) if len(person.points) else np.full(3, np.nan)
    if setting.protocol == PROTOCOL:
        center = sample.centers.get(DAPT[setting.kind].center, np.full(3, np.nan))
    return np.where(is_labeled, sample.joints[columns] - center, np.nan)
