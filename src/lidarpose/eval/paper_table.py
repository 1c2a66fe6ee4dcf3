"""The paper's Table 1 with what was evaluated here beside it, as Markdown or JSON.

Published figures are a file of their own (`assets/published.json`) with source and protocol; ours come from scores.json
files alone. What was found by different protocols stands in different blocks: the figures do not compare.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from lidarpose.errors import InputError
from lidarpose.eval.protocols import PROTOCOLS
from lidarpose.eval.scores import OURS, RELEASED, Result, Scores, read_scores
from lidarpose.io.files import listed

SCHEMA = "lidarpose.table/1"
FORMATS = ("markdown", "json")
FIGURES = {"mpjpe": "MPJPE", "pa_mpjpe": "PA-MPJPE", "pck3": "PCK-3", "pck5": "PCK-5"}
# the paper leaves PA-MPJPE out where labels are missing
_WITHOUT_PA = ("waymo", "humanm3")
_BLOCKS = {
    "dapt": "Evaluated here, protocol dapt: crop and center from labels, as the released code. Nearest to the block "
    "above; the notes tell what differs",
    "clean": "Evaluated here, protocol clean: a detector's box and a center from the points alone. Not comparable with "
    "the blocks above",
}
_OTHERS = "Evaluated here on sets that the paper does not have"


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One result in the table. row: the method's name there; note: what the reader must know of it; figures: name ->
    value or None; digest of the weights, "" of floors; path of the scores.json."""

    row: str
    kind: str
    dataset: str
    protocol: str
    figures: dict[str, float | None]
    note: str
    digest: str
    path: str


def published() -> dict[str, Any]:
    """The paper's figures: source, note, datasets with their protocols, methods with theirs and their figures."""
    return json.loads((resources.files("lidarpose.eval") / "assets" / "published.json").read_text("utf-8"))


def table(paths: Sequence[str | Path], *, format: str = "markdown") -> str:
    """The table of scores.json files, or of folders that hold one. Raises InputError for an unknown format and for a
    file that is none."""
    if format not in FORMATS:
        raise InputError(f"expected a table's format, {' or '.join(FORMATS)}, got {format!r}")
    entries = [entry for path in listed(paths) for entry in _entries(str(path), read_scores(path))]
    return _markdown(entries) if format == "markdown" else _json(entries)


def _entries(path: str, scores: Scores) -> Iterator[Entry]:
    for result in scores.results:
        methods = dict.fromkeys((line.method, line.arithmetic) for line in result.lines)
        for method, arithmetic in methods:
            own = method == result.setting.method
            found = {
                line.figure: line.value
                for line in result.lines
                if (line.method, line.arithmetic, line.group, line.of) == (method, arithmetic, "all", "all")
            }
            yield Entry(
                row=method if arithmetic == OURS else f"{method}, released arithmetic",
                kind=result.setting.kind,
                dataset=result.setting.dataset,
                protocol=result.setting.protocol,
                figures={name: found.get(name) for name in FIGURES},
                note=_note(path, scores, result, method if own else None, arithmetic),
                digest=str(scores.weights.get("digest") or "") if own else "",
                path=path,
            )


def _note(path: str, scores: Scores, result: Result, method: str | None, arithmetic: str) -> str:
    setting, counts = result.setting, result.counts
    people = f"{counts['people']:,} people"
    if setting.limit is not None:
        people += f", evenly picked from {setting.total:,}"
    split = setting.split
    if split != "none":
        split += f" ({setting.split_source})" if setting.split_source else ""
    words = [
        f"{setting.dataset}: protocol {setting.protocol}",
        f"center: {setting.centring}",
        f"crop: {setting.crop}",
        f"split: {split}{', which leaks: ' + setting.leaks if setting.leaks else ''}",
        people,
        f"{len(setting.joints)} joints{' (' + setting.not_judged + ')' if setting.not_judged else ''}",
    ]
    if setting.sensor != "known":
        words.append(f"the sensor's place is {setting.sensor}")
    if counts["without a pose"]:
        words.append(f"{counts['without a pose']:,} without a pose, not counted")
    if left := sum(entry["count"] for reason, entry in result.skipped.items() if reason.startswith("people")):
        words.append(f"{left:,} left out")
    if arithmetic == RELEASED:
        words.append("arithmetic of the released code, faults included")
    if method is None:
        words.append("knows no points")
    elif scores.weights.get("digest"):
        words.append(f"weights {scores.weights['digest'][:12]}")
    return "; ".join([*words, path])


# ---- Markdown


def _markdown(entries: list[Entry]) -> str:
    known = published()
    notes: list[str] = []
    lines = [f"**Published**: {known['source']}; {known['note']}", ""]
    rows = []
    columns = {kind: told["title"] for kind, told in known["datasets"].items()}
    marked = {
        kind: f"{told['title']} {_mark(notes, f'{columns[kind]}: ' + told['protocol'])}"
        for kind, told in known["datasets"].items()
    }
    for method in known["methods"]:
        mark = f" {_mark(notes, method['method'] + ': ' + method['protocol'])}" if method["protocol"] else ""
        cells = {(kind, name): _cell(found.get(name)) for kind, found in method["figures"].items() for name in FIGURES}
        rows.append((f"{method['method']}{mark}", cells))
    lines += _grid(marked, rows)
    for protocol in reversed(PROTOCOLS):
        own = [entry for entry in entries if entry.protocol == protocol and entry.kind in columns]
        if own:
            lines += ["", f"**{_BLOCKS[protocol]}.**", ""]
            lines += _grid(columns, _rows(own, notes, lambda entry: entry.kind))
    others = [entry for entry in entries if entry.kind not in columns]
    if others:
        names = {entry.dataset: entry.dataset for entry in others}
        lines += ["", f"**{_OTHERS}.**", "", *_grid(names, _rows(others, notes, lambda entry: entry.dataset))]
    lines += ["", "mm and percent; lower MPJPE and higher PCK are better.", ""]
    return "\n".join([*lines, *(f"[{k}] {note}  " for k, note in enumerate(notes, 1))]) + "\n"


def _mark(notes: list[str], note: str) -> str:
    if note not in notes:
        notes.append(note)
    return f"[{notes.index(note) + 1}]"


def _cell(value: float | None, mark: str = "") -> str:
    return "-" if value is None else f"{value:.2f} {mark}".rstrip()


def _rows(entries: list[Entry], notes: list[str], column) -> list[tuple[str, dict]]:
    """Rows of (name, cells): one a method and its weights; another one where a dataset comes twice."""
    rows: list[tuple[tuple[str, str], dict]] = []
    for entry in entries:
        key, place = (entry.row, entry.digest), column(entry)
        cells = next((cells for own, cells in rows if own == key and not any(p == place for p, _ in cells)), None)
        if cells is None:
            cells = {}
            rows.append((key, cells))
        mark = _mark(notes, entry.note)
        found = entry.figures.items()
        cells |= {(place, name): _cell(value, mark if name == "mpjpe" else "") for name, value in found}
    return [(name, cells) for (name, _), cells in rows]


def _grid(columns: dict[str, str], rows: list[tuple[str, dict]]) -> list[str]:
    heads = [(kind, name) for kind in columns for name in FIGURES if not (name == "pa_mpjpe" and kind in _WITHOUT_PA)]
    lines = ["| | " + " | ".join(f"{columns[kind]} {FIGURES[name]}" for kind, name in heads) + " |"]
    lines.append("|---" * (len(heads) + 1) + "|")
    return lines + [f"| {name} | " + " | ".join(cells.get(head, "-") for head in heads) + " |" for name, cells in rows]


# ---- JSON


def _json(entries: list[Entry]) -> str:
    own = [
        {name: getattr(entry, name) for name in ("row", "kind", "dataset", "protocol", "figures", "note", "path")}
        | {"weights": entry.digest or None}
        for entry in entries
    ]
    found = {"schema": SCHEMA, "unit": {"mpjpe": "mm", "pa_mpjpe": "mm", "pck3": "%", "pck5": "%"}}
    return json.dumps(found | {"published": published(), "evaluated": own}, indent=1) + "\n"
