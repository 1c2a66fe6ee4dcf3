"""The paper's Table 1 together with the results of scores.json files."""

import json
from collections.abc import Callable, Iterator, Sequence
from importlib import resources
from os import PathLike
from typing import Any

from lidarpose.errors import InputError, counted
from lidarpose.eval.scores import BASELINE, OURS, RELEASED, Result, Scores, read_scores
from lidarpose.io.files import listed

TABLE_SCHEMA = "lidarpose.table/1"
FORMATS = ("markdown", "json")
# metrics of the table: title and unit
COLUMNS = {"mpjpe": ("MPJPE", "mm"), "pa_mpjpe": ("PA-MPJPE", "mm"), "pck3": ("PCK-3", "%"), "pck5": ("PCK-5", "%")}
# the paper leaves PA-MPJPE out where labels are missing
_WITHOUT_PA = ("waymo", "humanm3")
_BLOCKS = {
    "dapt": "Evaluated here, protocol dapt: crop and center from labels, as the released code. Nearest to the block "
    "above; the notes list the differences",
    "clean": "Evaluated here, protocol clean: a detector's box, and centers from the points and that box. Not "
    "comparable with the blocks above",
}
_OTHERS = "Evaluated here on sets that the paper does not have"


def published() -> dict[str, Any]:
    """The paper's results: source, note, datasets with their protocols, methods with their protocols and scores."""
    return json.loads((resources.files("lidarpose.eval") / "assets" / "published.json").read_text("utf-8"))


def table(paths: str | PathLike | Sequence[str | PathLike], *, format: str = "markdown") -> str:
    """The paper's Table 1 and the results of scores.json files; results of different protocols are in separate blocks.

    Args:
        paths: the files, or folders that hold one; our scores come only from these.
        format: "markdown" or "json".

    Raises:
        InputError: an unknown format, or a file that is not scores.json.
    """
    if format not in FORMATS:
        raise InputError(f"expected a table's format, {' or '.join(FORMATS)}, got {format!r}")
    entries = [entry for path in listed(paths) for entry in _entries(str(path), read_scores(path))]
    if format == "markdown":
        return _markdown(entries)
    units = {name: unit for name, (_, unit) in COLUMNS.items()}
    content = {"schema": TABLE_SCHEMA, "unit": units, "published": published(), "evaluated": entries}
    return json.dumps(content, indent=1) + "\n"


def _entries(path: str, scores: Scores) -> Iterator[dict[str, Any]]:
    """Yields the results of each method on each dataset. row: the method's name in the table; figures: metric -> value
    or None; note: remarks on the setting; path of the scores.json; weights: their digest, None for baselines."""
    digest = scores.weights.get("digest") or None
    for result in scores.results:
        setting = result.setting
        overall_rows = [row for row in result.lines if (row.group, row.of) == ("all", "all")]
        for method, arithmetic in dict.fromkeys((row.method, row.arithmetic) for row in result.lines):
            values = {
                row.figure: row.value for row in overall_rows if (row.method, row.arithmetic) == (method, arithmetic)
            }
            is_network = method == setting.method
            note_parts = [
                *_setting_words(result),
                "arithmetic of the released code, faults included" if arithmetic == RELEASED else "",
                "uses no points" if not is_network else f"weights {digest[:12]}" if digest else "",
                path,
            ]
            yield {
                "row": method if arithmetic == OURS else f"{method}, released arithmetic",
                **{name: getattr(setting, name) for name in ("kind", "dataset", "protocol")},
                "figures": {name: values.get(name) for name in COLUMNS},
                "note": "; ".join(filter(None, note_parts)),
                "path": path,
                "weights": digest if is_network else None,
            }


def _setting_words(result: Result) -> Iterator[str]:
    setting, no_pose = result.setting, result.counts["without a pose"]
    split = setting.split
    if split != "none" and setting.split_source:
        split += f" ({setting.split_source})"
    limit_text = "" if setting.limit is None else f", evenly picked from {setting.total:,}"
    num_left_out = sum(entry["count"] for reason, entry in result.skipped.items() if reason.startswith("people"))
    yield f"{setting.dataset}: protocol {setting.protocol}"
    yield f"center: {setting.centring}"
    yield f"crop: {setting.crop}"
    yield f"split: {split}{', which leaks: ' + setting.leaks if setting.leaks else ''}"
    yield f"{result.counts['people']:,} people{limit_text}"
    yield f"{len(setting.joints)} joints{' (' + setting.not_judged + ')' if setting.not_judged else ''}"
    yield "" if setting.sensor == "known" else f"sensor position {setting.sensor}"
    yield f"{no_pose:,} without a pose, not counted" if no_pose else ""
    yield f"{num_left_out:,} left out" if num_left_out else ""
    damaged = result.skipped.get("damaged shards")
    yield f"{counted(damaged['count'], 'damaged shard')} left out, with an unknown number of people" if damaged else ""


def _markdown(entries: list[dict[str, Any]]) -> str:
    paper = published()
    notes: list[str] = []

    def mark(note: str) -> str:
        if note not in notes:
            notes.append(note)
        return f"[{notes.index(note) + 1}]"

    titles = {kind: info["title"] for kind, info in paper["datasets"].items()}
    marked_titles = {
        k: f"{titles[k]} {mark(f'{titles[k]}: ' + info['protocol'])}" for k, info in paper["datasets"].items()
    }
    rows = []
    for method in paper["methods"]:
        name = method["method"]
        cells = {
            (kind, m): f"{value:.2f}" for kind, figures in method["figures"].items() for m, value in figures.items()
        }
        rows.append((f"{name} {mark(name + ': ' + method['protocol'])}" if method["protocol"] else name, cells))
    lines = [f"**Published**: {paper['source']}; {paper['note']}", "", *_grid(marked_titles, rows)]
    for protocol, title in _BLOCKS.items():
        if block_entries := [entry for entry in entries if entry["protocol"] == protocol and entry["kind"] in titles]:
            lines += ["", f"**{title}.**", "", *_grid(titles, _rows(block_entries, "kind", mark))]
    if other_entries := [entry for entry in entries if entry["kind"] not in titles]:
        columns = {entry["dataset"]: entry["dataset"] for entry in other_entries}
        lines += ["", f"**{_OTHERS}.**", "", *_grid(columns, _rows(other_entries, "dataset", mark))]
    lines += ["", "mm and percent; lower MPJPE and higher PCK are better.", ""]
    return "\n".join([*lines, *(f"[{k}] {note}  " for k, note in enumerate(notes, 1))]) + "\n"


def _rows(entries: list[dict[str, Any]], by: str, mark: Callable[[str], str]) -> list[tuple[str, dict]]:
    """Rows of (name, cells): one per method and weights, and another one for a second result in the same column.

    Args:
        by: what a column stands for, "kind" or "dataset".
    """
    rows: list[tuple[tuple[str, str | None], dict]] = []
    for entry in entries:
        key, column = (entry["row"].replace(BASELINE, "baseline: "), entry["weights"]), entry[by]
        cells = next((cells for row_key, cells in rows if row_key == key and (column, "mpjpe") not in cells), None)
        if cells is None:
            rows.append((key, cells := {}))
        for name, value in entry["figures"].items():
            cells[column, name] = "-" if value is None else f"{value:.2f}"
        cells[column, "mpjpe"] += f" {mark(entry['note'])}"
    return [(name, cells) for (name, _), cells in rows]


def _grid(columns: dict[str, str], rows: list[tuple[str, dict]]) -> list[str]:
    heads = [(kind, name) for kind in columns for name in COLUMNS if not (name == "pa_mpjpe" and kind in _WITHOUT_PA)]
    lines = ["| | " + " | ".join(f"{columns[kind]} {COLUMNS[name][0]}" for kind, name in heads) + " |"]
    lines.append("|---" * (len(heads) + 1) + "|")
    return lines + [f"| {name} | " + " | ".join(cells.get(head, "-") for head in heads) + " |" for name, cells in rows]
