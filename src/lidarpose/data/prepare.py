"""`lidarpose prepare`: the raw files of a real dataset into the Parquet shards that synthetic people come in.

One shard a part (a sequence, a segment, a file), with what was skipped and why beside it. A part that is whole is not
read again: to have a repaired file read, delete its two shards and run the same command.
"""

import hashlib
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from importlib import import_module
from itertools import repeat
from pathlib import Path
from typing import Any

from lidarpose.data.readers.base import Reader, Skipped
from lidarpose.data.schema import labeled_row
from lidarpose.data.shards import CARD, DatasetCard, open_dataset, shard_path, shard_writer, write_card
from lidarpose.data.splits import SplitRule, split_rule
from lidarpose.data.summary import summarize
from lidarpose.data.writer import Counts, locked, make_shards, open_folder
from lidarpose.errors import InputError, check_name
from lidarpose.io.files import file_error, one_line
from lidarpose.progress import Progress
from lidarpose.sample import LabeledSample

# dataset -> module and class of its reader, and whether that takes the user's SMPL
READERS: dict[str, tuple[str, str, bool]] = {
    "humanm3": ("humanm3", "HumanM3", False),
    "lidarhuman26m": ("lidarhuman26m", "LidarHuman26M", True),
    "sloper4d": ("sloper4d", "Sloper4D", True),
    "waymo": ("waymo", "Waymo", False),
    "lipd": ("corpora", "Lipd", False),
    "freemotion": ("corpora", "FreeMotion", True),
    "noisemotion": ("corpora", "NoiseMotion", True),
}
# whose frame is turned level unless somebody wants the release's own
_LEVELED = ("lidarhuman26m",)
# tables of such a dataset; the people's last, since a part is whole once they are there
_TABLES = ("skipped", "labelled")
# why the people of a part, or those after a fault in it, are left out
_REST = "the rest of a part cannot be read"
# how many people between two tellings of progress
_TOLD = 200


def reader(name: str, smpl: str | Path | None = None, *, level: bool = True) -> Reader:
    """The reader of a dataset, by its name in `READERS`. smpl: the user's SMPL model, a file or a folder of them;
    level: turn the frame level where the release's is not.

    Raises InputError for an unknown name, where SMPL is needed and not given or cannot be read, where it is given and
    not needed, and where the release's frame is asked for and there is no other.
    """
    check_name("dataset", name, READERS)
    module, kind, takes_smpl = READERS[name]
    if not level and name not in _LEVELED:
        raise InputError(f"{name} is not turned level, only {', '.join(_LEVELED)} is: leave --no-level away")
    if smpl is not None and not takes_smpl:
        raise InputError(f"{name} has joints of its own: leave the SMPL model out")
    options: dict[str, Any] = {"smpl": smpl} if takes_smpl else {}
    options |= {"level": level} if name in _LEVELED else {}
    return getattr(import_module(f"lidarpose.data.readers.{module}"), kind)(**options)


def prepare(
    name: str,
    root: str | Path,
    out: str | Path,
    *,
    split: str | None = None,
    split_by: str | None = None,
    smpl: str | Path | None = None,
    level: bool = True,
    workers: int = 1,
    progress: bool = True,
) -> dict[str, Any]:
    """Writes a dataset's people as Parquet shards into `out`, or what is missing of them, and returns the summary.

    name: one of `READERS`; root: the folder of its raw files; split: only people of that split ("train", "val",
    "test"), by default all; split_by: the published split to go by, by default the user's own train.txt and test.txt in
    `root`, else the dataset's usual one; smpl: the user's SMPL model, a file or a folder of one for each gender;
    level: turn lidarhuman26m's sequences level, False keeps the release's frame; workers: processes; progress: draw a
    bar on a terminal.

    The summary, also in out/dataset.json: people, skipped by reason with an example each, people by split and source,
    parts, and warnings. Raises InputError, one line, for a wrong root, name, split or SMPL model and for a folder that
    holds something else; MissingExtra without pyarrow.
    """
    if workers < 1:
        raise InputError(f"expected at least 1 worker, got {workers}")
    root, out = Path(root), Path(out)
    source = reader(name, smpl, level=level)
    if not root.is_dir():
        raise file_error(root, f"is no folder; expected the raw files of {name}")
    parts = list(source.parts(root))
    rule = split_rule(name, root, split_by, parts)
    absent = rule.absent(parts) if rule is not None else {}
    parts = _of_split(name, parts, rule, split)
    card = _card(source, parts, rule, split)
    missing = open_folder(out, card)
    make = PartWriter(reader=source, root=root, out=out, parts=tuple(parts), rule=rule, only=split)
    there = len(parts) - len(missing)
    with locked(out):
        # the summary of a run that is not over would be wrong
        if missing or not (out / CARD).is_file():
            write_card(out, card)
        with Progress(len(parts), unit="parts", done=there, shown=progress) as shown:
            people = 0
            for shards, more in make_shards(make, missing, workers=workers):
                people, there = people + more, there + shards
                shown.update(there, f"{people:,} people")
        summary = summarize(open_dataset(out), parts=parts, absent=absent, rule=rule)
        write_card(out, replace(card, summary=summary))
    return summary


def _of_split(name: str, parts: list[str], rule: SplitRule | None, split: str | None) -> list[str]:
    """The parts in which people of the split may be. Raises InputError where there are none."""
    if split is None:
        return parts
    if rule is None:
        raise InputError(f"{name} has no split to choose {split!r} from: put train.txt and test.txt into its folder")
    check_name(f"split of {name} by {rule.name}", split, rule.sets)
    kept = [part for part in parts if not rule.by_part or rule.of_part(part) == split]
    if not kept:
        raise InputError(f"none of the {len(parts)} parts of {name} is in {split!r} by {rule.name}: {rule.source}")
    return kept


def _card(source: Reader, parts: list[str], rule: SplitRule | None, split: str | None) -> DatasetCard:
    # the names themselves would fill the line that says what differs
    digest = hashlib.sha256("\n".join(parts).encode("utf-8", "backslashreplace")).hexdigest()[:12]
    settings: dict[str, Any] = {"what": "parts", "dataset": source.name, "parts": digest}
    settings |= {"split": split, "split_by": None if rule is None else rule.name}
    about = {key: value for key, value in source.about.items() if key not in ("frame", "settings")}
    if rule is not None:
        about["split"] = f"{rule.name}: {rule.source}" + (f"; LEAKS: {rule.leaks}" if rule.leaks else "")
        if rule.name == "own":
            settings["lists"] = hashlib.sha256(repr(sorted(rule.sets.items())).encode()).hexdigest()[:12]
    return DatasetCard(
        settings=settings | source.about["settings"],
        count=len(parts),
        per_shard=1,
        tables=_TABLES,
        skeleton=source.skeleton,
        frame=source.about["frame"],
        about=about | {"parts": parts},
    )


@dataclass(frozen=True, kw_only=True)
class PartWriter:
    """Reads parts of a dataset and writes their shards: called with a part's number, yields counts of people as they
    are done. only: the split to keep, None for all; the rest as in `prepare`. May be pickled."""

    reader: Reader
    root: Path
    out: Path
    parts: tuple[str, ...]
    rule: SplitRule | None
    only: str | None

    def __call__(self, number: int) -> Counts:
        people = 0
        with ExitStack() as stack:
            add = {
                table: stack.enter_context(shard_writer(shard_path(self.out, table, number), table))
                for table in reversed(_TABLES)
            }
            for found in self._found(self.parts[number]):
                if isinstance(found, Skipped):
                    add["skipped"]({"index": number, "reason": found.reason, "where": found.where})
                elif self.only in (None, found.split):
                    add["labelled"](labeled_row(found, index=number))
                    people += 1
                    if people % _TOLD == 0:
                        yield _TOLD
        yield people % _TOLD

    def _found(self, part: str) -> Iterator[LabeledSample | Skipped]:
        """Everybody in a part, with the split."""
        found: Iterable[LabeledSample | Skipped] = self._read(part)
        splits: Iterator[str | None] = repeat(None if self.rule is None else self.rule.of_part(part))
        if self.rule is not None and not self.rule.by_part:
            found = list(found)
            splits = iter(self.rule.of_chunks(part, sum(isinstance(one, LabeledSample) for one in found)))
        for one in found:
            yield replace(one, split=next(splits)) if isinstance(one, LabeledSample) else one

    def _read(self, part: str) -> Iterator[LabeledSample | Skipped]:
        """As the reader, but a part that turns out to be unreadable ends there, which is counted."""
        try:
            yield from self.reader.read(self.root, part)
        except InputError as error:
            yield Skipped(_REST, f"{part}: {error}")
        except (OSError, ArithmeticError, LookupError, TypeError, ValueError, AttributeError) as error:
            # what no reader foresaw must not cost the other parts; its kind tells a mistake in a reader from a bad file
            kind = type(error).__name__
            yield Skipped(f"{_REST} ({kind})", one_line(f"{part}: {kind}: {error}"))
