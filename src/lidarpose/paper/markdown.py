"""A table as a page in Markdown: results, their cost, and the commands of each cell."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose.eval.table import COLUMNS
from lidarpose.paper.cells import Cell, Table, row_key

_LEGEND = (
    "MPJPE in mm, the mean over seeds; in brackets the 95 % interval over people, or for several seeds the lowest and "
    "highest value. *undertrained*: not 20 % better than the mean pose at the protocol's center; nothing can be "
    "concluded from it. *Against* a row: the mean difference over the same people, where both rows have poses."
)
# appended if the paper's printed values are shown
_PRINTED = (
    " In parentheses the paper's values, not run here: those of LiDARCap and NE are relative to the root, "
    "without shapes; that of LPFormer on Waymo is for detected boxes."
)
# on the same people the mean pose's error varies by less, mm, unless it was made from a few training people
_SAME_PEOPLE = 0.5
# a metric of newer cells, and the rows whose printed values are in it
ROOT, _ROOT_ROWS = "root_mpjpe", ("LiDARCap", "NE")


def markdown(content: dict[str, Any]) -> str:
    """A table as a page: the results, the cost of each cell, and the commands."""
    entries = content["cells"]
    # fine-tuning on real sets takes whole epochs
    stages = "a stage of training" if content["target"].startswith("stand-in") else "of pre-training"
    budget = f"Budget: {content['people']:,} people {stages}"
    budget += f", {content['hours']:g} hours a row" if content["hours"] else ""
    printed = _PRINTED if any(entry["published"] is not None for entry in entries) else ""
    lines = [f"# {content['title']}", "", f"Target: {content['target']}. {budget}. {_LEGEND}{printed}", ""]
    lines += result_lines(content)
    lines += ["", *_note_lines(entries), "## Cells", "", *cost_lines(content)]
    return "\n".join([*lines, "", "## Commands", "", *_commands(entries)]) + "\n"


def result_lines(content: dict[str, Any]) -> list[str]:
    """A table's rows and columns, laid out as in the paper."""
    entries = content["cells"]
    columns, rows = (list(dict.fromkeys(entry[name] for entry in entries)) for name in ("column", "row"))
    lines = _grid(["", *columns])
    for row in rows:
        row_entries = [[e for e in entries if (e["row"], e["column"]) == (row, column)] for column in columns]
        lines.append(_line([row, *map(_cell_text, row_entries)]))
    return lines


def _note_lines(entries: list[dict[str, Any]]) -> list[str]:
    """The notes of the evaluations, each once with the columns that it applies to, and one for a column whose mean
    poses tell that its people may not be the same."""
    columns: dict[str, list[str]] = {}
    mean_poses: dict[str, list[float]] = {}
    for entry in entries:
        for note in entry.get("notes", ()):
            columns.setdefault(note, []).append(entry["column"])
        if entry["state"] == "done" and entry["mean_pose"] is not None:
            mean_poses.setdefault(entry["column"], []).append(entry["mean_pose"])
    for column, errors in mean_poses.items():
        if max(errors) - min(errors) > _SAME_PEOPLE:
            note = f"mean poses of {min(errors):.1f} to {max(errors):.1f} mm: the rows may score different people"
            columns.setdefault(note, []).append(column)
    return [*(f"- {', '.join(dict.fromkeys(names))}: {note}" for note, names in columns.items()), *[""][: len(columns)]]


def cost_lines(content: dict[str, Any], *, finished: bool = False) -> list[str]:
    """Result and cost of each cell, or of each finished one; with columns for the error relative to the root, and for
    the difference to the reference row, if any cell has one."""
    entries = [entry for entry in content["cells"] if not finished or entry["state"] == "done"]
    heads = "row, column, seed, MPJPE, PA, PCK-3, PCK-5, mean pose, people seen, hours, people/s in training, size"
    columns, lines = [*heads.split(", "), "parameters", "state"], [_cost(entry) for entry in entries]
    optional = [(ROOT, "relative to the root", _root_text)]
    # tables written by older versions have no reference, and then no differences
    optional.append(("difference", f"against {content.get('reference')}", _difference_text))
    for name, head, text in optional:
        if any(entry.get(name) is not None for entry in entries):
            columns.insert(4, head)
            for entry, line in zip(entries, lines, strict=True):
                line.insert(4, text(entry))
    return [*_grid(columns), *map(_line, lines)]


def _root_text(entry: dict[str, Any]) -> str:
    return "-" if entry.get(ROOT) is None else f"{entry[ROOT]:.1f}"


def _difference_text(entry: dict[str, Any]) -> str:
    if "difference" not in entry:
        return "-"
    low, high = entry["difference_low"], entry["difference_high"]
    return f"{entry['difference']:+.1f}" + ("" if low is None else f" [{low:+.1f}, {high:+.1f}]")


def plan(table: Table, selected: Sequence[Cell], out: Path, problem: Any) -> str:
    """The commands of each cell as a page, each command in full at its first occurrence.

    Args:
        problem: function of a command's words that returns the parser's complaint, "" for none.
    """
    entries, printed_names = [], set[str]()
    for cell in selected:
        steps = list(cell.evaluation.all()) if cell.evaluation else []
        reason = cell.why or next(filter(None, (problem(step.command(out)) for step in steps)), "")
        entry = {"row": cell.row, "column": cell.column, "seed": cell.seed, "reason": reason}
        entry["commands"] = [
            f"{step.name}, as above" if step.name in printed_names else step.line(out) for step in steps
        ]
        printed_names.update(step.name for step in steps)
        entries.append(entry | {"state": "not possible" if reason else "done"})
    rows = ", ".join(dict.fromkeys(row_key(cell.row) for cell in selected))
    return "\n".join([f"# {table.title}", "", f"Rows for --rows: {rows}.", "", *_commands(entries)]) + "\n"


def _commands(entries: list[dict[str, Any]]) -> list[str]:
    lines = _grid(["row", "column", "seed", "commands"])
    for entry in entries:
        commands = "<br>".join(f"`{command}`" for command in entry["commands"])
        if entry["state"] != "done":
            commands = "<br>".join(filter(None, (commands, f"*{entry['state']}: {entry['reason']}*")))
        lines.append(_line([entry["row"], entry["column"], str(entry["seed"]), commands.replace("|", "\\|")]))
    return lines


def _cell_text(entries: list[dict[str, Any]]) -> str:
    done_entries = [entry for entry in entries if entry["state"] == "done" and entry["mpjpe"] is not None]
    published_text = next((f" (paper {e['published']:.1f})" for e in entries if e["published"] is not None), "")
    if not done_entries:
        first_entry = entries[0]
        return (
            f"{first_entry['state']}: {first_entry['reason']}{published_text}"
            if first_entry["state"] != "not run"
            else f"not run{published_text}"
        )
    values = [entry["mpjpe"] for entry in done_entries]
    ends = (done_entries[0]["low"], done_entries[0]["high"]) if len(done_entries) == 1 else (min(values), max(values))
    interval = "" if ends[0] is None else f" [{ends[0]:.1f}, {ends[1]:.1f}]"
    seeds = f", {len(done_entries)} of {len(entries)} seeds" if len(entries) > 1 else ""
    undertrained_text = ", *undertrained*" if any(entry["undertrained"] for entry in done_entries) else ""
    root_values = [entry[ROOT] for entry in done_entries if entry.get(ROOT) is not None]
    if published_text and root_values and done_entries[0]["row"] in _ROOT_ROWS:
        published_text = f"; {np.mean(root_values):.1f} relative to the root{published_text}"
    return f"{np.mean(values):.1f}{interval}{seeds}{undertrained_text}{published_text}"


def _cost(entry: dict[str, Any]) -> list[str]:
    cell_words = [entry["row"], entry["column"], str(entry["seed"])]
    if entry["state"] != "done":
        return [*cell_words, *["-"] * 10, entry["state"]]
    figures = ["-" if entry[name] is None else f"{entry[name]:.1f}" for name in (*COLUMNS, "mean_pose")]
    speed = "-" if entry["people_per_second"] is None else f"{entry['people_per_second']:.1f}"
    # tables written by older versions have no sizes
    cost = [f"{entry['people_seen']:,}", f"{entry['hours']:.2f}", speed, entry.get("size", "-")]
    cost.append(f"{entry['parameters']:,}")
    return [*cell_words, *figures, *cost, "undertrained" if entry["undertrained"] else "done"]


def _line(words: Sequence[str]) -> str:
    return f"| {' | '.join(words)} |"


def _grid(heads: Sequence[str]) -> list[str]:
    return [_line(heads), "|---" * len(heads) + "|"]
