"""Results of an evaluation: rows, each one metric of one group with its protocol; scores.json; and the paper's Table 1
together with the results of such files.
"""

import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from importlib import resources
from os import PathLike
from pathlib import Path
from types import NoneType
from typing import Any

from lidarpose._version import __version__
from lidarpose.errors import InputError
from lidarpose.io.files import file_error, lined_json, listed, read_json

SCHEMA = "lidarpose.scores/1"
# top-level keys of scores.json besides its results, and their types
_HEAD: dict[str, Any] = {"version": str, "command": str, "seed": int, "weights": dict}
FILE = "scores.json"
# arithmetic: of this package, or of the paper's released code, see docs/evaluate.md
OURS, RELEASED = "lidarpose", "released"
# prefix of the name of a method that uses no points; displayed as "baseline"
BASELINE = "floor: "


@dataclass(frozen=True, kw_only=True)
class Setting:
    """How a dataset was scored, under the keys of scores.json.

    dataset: its name; kind: the raw dataset's name, "synth" or "bench"; method: the network or baseline; protocol,
    centring (how people are centered), crop, split in words; split_source and leaks of the split, "" if there are none;
    joints that were scored; not_judged: joints of the dataset, or requested ones, that were not scored, and why;
    sensor: "known", "unknown" or "of some people"; total: people of which `limit` were scored, None for all; clusters:
    intervals resample whole sequences; seed of boxes and intervals.
    """

    dataset: str
    kind: str
    method: str
    protocol: str
    centring: str
    crop: str
    split: str
    split_source: str
    leaks: str
    joints: tuple[str, ...]
    not_judged: str
    sensor: str
    total: int
    limit: int | None
    clusters: bool
    seed: int

    @property
    def summary(self) -> str:
        """Protocol, centering, split and limit in a few words: "clean · points alone · split test"."""
        split = "no split" if self.split == "none" else f"split {self.split}{', leaks' if self.leaks else ''}"
        parts = [self.protocol, self.centring, split]
        if self.limit is not None:
            parts.append(f"{self.limit:,} of {self.total:,} people")
        return " · ".join(parts)

    # the name until 0.2
    told = summary


@dataclass(frozen=True, kw_only=True)
class MetricRow:
    """One metric of one group, under the keys of scores.json.

    method; figure: the metric's name, "mpjpe"; group, of: the group of people or joints, ("all", "all"), ("joints",
    "wrists"), ("distance, m", "0 to 10"); value in `unit`, None if there is nothing to score; low, high: ends of the
    95 % interval, None without one; people, joints behind the value (for oks_ap and turned_round, joints counts one per
    person); skipped: people without a labeled joint; no_pose: people for whom the network gave no pose; arithmetic;
    protocol, centring, split, limit: as in `Setting`.
    """

    method: str
    figure: str
    group: str
    of: str
    value: float | None
    unit: str
    low: float | None = None
    high: float | None = None
    people: int
    joints: int
    skipped: int
    no_pose: int = 0
    arithmetic: str = OURS
    protocol: str
    centring: str
    split: str
    limit: int | None


@dataclass(frozen=True, kw_only=True)
class Result:
    """One dataset's rows (`lines`, as in scores.json). counts: people scored, frames of clips, people without a pose;
    skipped: reason -> count and the first one; notes: remarks that the reader needs to interpret the scores."""

    setting: Setting
    counts: dict[str, int]
    skipped: dict[str, dict]
    notes: tuple[str, ...]
    lines: tuple[MetricRow, ...]

    def line(self, figure: str, group: str = "all", of: str = "all", **more: str) -> MetricRow:
        """The row of a metric, of the network itself unless `method` or `arithmetic` is given. Raises InputError if
        there is none."""
        keys = {"method": self.setting.method, "arithmetic": OURS} | more
        keys |= {"figure": figure, "group": group, "of": of}
        for row in self.lines:
            if all(getattr(row, name) == value for name, value in keys.items()):
                return row
        figures = ", ".join(dict.fromkeys(row.figure for row in self.lines))
        wanted = ", ".join(map(str, keys.values()))
        raise InputError(f"{self.setting.dataset} has no row {wanted}: figures are {figures}")


@dataclass(frozen=True, kw_only=True)
class Scores:
    """The content of scores.json. weights: name, digest (SHA-256) and other metadata of the checkpoint; command: the
    command line; seed; results, one per dataset; version of the package."""

    weights: dict[str, Any]
    command: str
    seed: int
    results: tuple[Result, ...]
    version: str = __version__

    def to_json(self) -> str:
        """The text of scores.json, with one line per row."""
        content: dict[str, Any] = {"schema": SCHEMA, "unit": {"mm": "millimeters", "%": "percent"}}
        content |= {name: getattr(self, name) for name in _HEAD}
        content["results"] = [asdict(result) for result in self.results]
        return lined_json(content, "results", "lines") + "\n"


def scores_path(path: str | PathLike) -> Path:
    """The path of scores.json, given the file or its folder."""
    path = Path(path)
    return path / FILE if path.is_dir() else path


def read_scores(path: str | PathLike) -> Scores:
    """Reads scores.json, given the file or its folder. Raises InputError for any other file."""
    path = scores_path(path)
    content = read_json(path, expected=f"{FILE} of lidarpose evaluate")
    try:
        if (schema := content["schema"]) == SCHEMA:
            head = {name: kind(content[name]) for name, kind in _HEAD.items()}
            if not isinstance(head["weights"].get("digest") or "", str):
                raise TypeError("the digest of the weights is not text")
            return Scores(**head, results=tuple(map(_result, content["results"])))
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        problem = f"{error} is missing" if isinstance(error, KeyError) else error
        raise file_error(path, f"is not a {FILE} of lidarpose evaluate ({problem})") from None
    remedy = "evaluate again, or use the lidarpose version that wrote it"
    raise file_error(path, f"is of schema {schema!r}, this lidarpose reads {SCHEMA}: {remedy}")


def _result(content: dict[str, Any]) -> Result:
    setting = dict(content["setting"])
    setting["joints"] = tuple(setting["joints"])
    for field in fields(Setting):
        if field.type is str and not isinstance(setting[field.name], str):
            raise TypeError(f"{field.name} is not text")
    counts, skipped = dict(content["counts"]), dict(content["skipped"])
    numbers = {name: counts[name] for name in ("people", "without a pose")} | {"total": setting["total"]}
    numbers |= {"limit": 0 if setting["limit"] is None else setting["limit"]}
    numbers |= {f"count of {reason}": entry["count"] for reason, entry in skipped.items()}
    for name, value in numbers.items():
        if type(value) is not int:
            raise TypeError(f"{name} is not a whole number")
    return Result(
        setting=Setting(**setting),
        counts=counts,
        skipped=skipped,
        notes=tuple(content["notes"]),
        lines=tuple(map(_row, content["lines"])),
    )


def _row(content: dict[str, Any]) -> MetricRow:
    row = MetricRow(**content)
    for field in fields(MetricRow):
        value = getattr(row, field.name)
        if field.type is str and not isinstance(value, str):
            raise TypeError(f"{field.name} is not text")
        if field.name in ("value", "low", "high") and type(value) not in (int, float, NoneType):
            raise TypeError(f"{field.name} is not a number")
    return row


def number(value: float) -> float | None:
    """A value for JSON: NaN becomes None."""
    return None if math.isnan(value) else float(value)


# ---- the paper's Table 1 together with results of this package

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
