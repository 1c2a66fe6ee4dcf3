"""What an evaluation says: lines, one a figure, each with the protocol that it was found by; and scores.json."""

import json
import math
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from lidarpose._version import __version__
from lidarpose.errors import InputError
from lidarpose.io.files import file_error, read_bytes

SCHEMA = "lidarpose.scores/1"
FILE = "scores.json"
# whose arithmetic: this package's, or the paper's released code's, see docs/evaluate.md
OURS, RELEASED = "lidarpose", "released"


@dataclass(frozen=True, kw_only=True)
class Setting:
    """How a dataset was judged. dataset: what it is called; kind: the raw dataset's name, "synth" or "bench"; method:
    what predicted; protocol, centring, crop, split in words; split_source and leaks of the split, "" where there is
    nothing to say; joints that were judged; not_judged: joints of the dataset, or asked for, that were not, and why;
    sensor: "known", "unknown" or "of some people"; people of whom so many were `limit`ed to; clusters: intervals draw
    whole sequences; seed of boxes and intervals."""

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
    def told(self) -> str:
        """Protocol, centring, split and limit, for a line: "clean · points alone · split test"."""
        split = "no split" if self.split == "none" else f"split {self.split}{', leaks' if self.leaks else ''}"
        words = [self.protocol, self.centring, split]
        if self.limit is not None:
            words.append(f"{self.limit:,} of {self.total:,} people")
        return " · ".join(words)


@dataclass(frozen=True, kw_only=True)
class Line:
    """One figure.

    method; figure: its name, "mpjpe"; group and of: of whom or of what, ("all", "all"), ("joints", "wrists"),
    ("distance, m", "0 to 10"); value in `unit`, None where nobody could be judged; low, high: ends of the 95 %
    interval, None where there is none; people, joints that it is of (of oks_ap and turned_round, one a person);
    skipped: people without a labelled joint; no_pose: people for whom the network had no answer; arithmetic;
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
    """One dataset's lines. counts: people judged, frames of clips, without pose; skipped: reason -> count and the first
    one; notes: what the reader must know."""

    setting: Setting
    counts: dict[str, int]
    skipped: dict[str, dict]
    notes: tuple[str, ...]
    lines: tuple[Line, ...]

    def line(self, figure: str, group: str = "all", of: str = "all", **more: str) -> Line:
        """The line of a figure, of the network itself unless `method` or `arithmetic` say otherwise. Raises InputError
        where there is none."""
        wanted = {"method": self.setting.method, "arithmetic": OURS} | more
        wanted |= {"figure": figure, "group": group, "of": of}
        for line in self.lines:
            if all(getattr(line, name) == value for name, value in wanted.items()):
                return line
        raise InputError(f"{self.setting.dataset} has no line {', '.join(map(str, wanted.values()))}")


@dataclass(frozen=True, kw_only=True)
class Scores:
    """The content of scores.json. weights: name, digest (SHA-256) and what else the checkpoint tells; command: what was
    run; seed; results, one a dataset; version of the package."""

    weights: dict[str, Any]
    command: str
    seed: int
    results: tuple[Result, ...]
    version: str = __version__

    def to_json(self) -> str:
        """One line of text a figure."""
        head = {"schema": SCHEMA, "version": self.version, "command": self.command, "seed": self.seed}
        head |= {"unit": {"mm": "millimetres", "%": "percent"}, "weights": self.weights}
        rows = ",\n".join(f" {json.dumps(key)}: {json.dumps(value)}" for key, value in head.items())
        results = ",\n".join(map(_result_json, self.results))
        return f'{{\n{rows},\n "results": [\n{results}\n ]\n}}\n'


def scores_path(path: str | Path) -> Path:
    """scores.json itself, of a file or of a folder that holds one."""
    path = Path(path)
    return path / FILE if path.is_dir() else path


def read_scores(path: str | Path) -> Scores:
    """scores.json, or that of a folder. Raises InputError for a file that is none."""
    path = scores_path(path)
    try:
        found = json.loads(read_bytes(path, expected=f"{FILE} of lidarpose evaluate"))
        if found["schema"] != SCHEMA:
            raise file_error(
                path,
                f"is of schema {found['schema']!r}, this lidarpose reads {SCHEMA}: evaluate again, or use the "
                "lidarpose version that wrote it",
            )
        weights = dict(found["weights"])
        if not isinstance(weights.get("digest") or "", str):
            raise TypeError("the digest of the weights is no text")
        return Scores(
            weights=weights,
            command=str(found["command"]),
            seed=int(found["seed"]),
            results=tuple(map(_result_of, found["results"])),
            version=str(found["version"]),
        )
    except InputError:
        raise
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        problem = f"{error} is missing" if isinstance(error, KeyError) else error
        raise file_error(path, f"is no {FILE} of lidarpose evaluate ({problem})") from None


def number(value: float) -> float | None:
    """A figure as it is written: NaN is None."""
    return None if math.isnan(value) else float(value)


def _result_json(result: Result) -> str:
    lines = ",\n".join(f"    {json.dumps(asdict(line))}" for line in result.lines)
    head = {"setting": asdict(result.setting), "counts": result.counts, "skipped": result.skipped}
    head["notes"] = list(result.notes)
    rows = ",\n".join(f"   {json.dumps(key)}: {json.dumps(value)}" for key, value in head.items())
    return f'  {{\n{rows},\n   "lines": [\n{lines}\n   ]\n  }}'


def _result_of(found: dict[str, Any]) -> Result:
    setting = dict(found["setting"])
    setting["joints"] = tuple(setting["joints"])
    for field in fields(Setting):
        if field.type is str and not isinstance(setting[field.name], str):
            raise TypeError(f"{field.name} is no text")
    return Result(
        setting=Setting(**setting),
        counts=dict(found["counts"]),
        skipped=dict(found["skipped"]),
        notes=tuple(found["notes"]),
        lines=tuple(Line(**line) for line in found["lines"]),
    )
