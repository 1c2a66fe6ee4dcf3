"""Results of an evaluation: rows, each one metric of one group with its protocol; and scores.json."""

import math
from dataclasses import asdict, dataclass, fields
from os import PathLike
from pathlib import Path
from types import NoneType
from typing import Any

from lidarpose._version import __version__
from lidarpose.errors import InputError
from lidarpose.io.files import file_error, lined_json, read_json

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
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
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
