"""`lidarpose prepare`: converts the raw files of a real dataset to Parquet shards, the format of synthetic people.

Each part (a sequence, a segment, a file) becomes one shard, with a second one of what was skipped and why. A complete
part is not read again: to read a repaired file, delete its two shards and run the same command.
"""

import hashlib
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from importlib import import_module
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose.data.dataset_card import CARD, DatasetCard, write_card
from lidarpose.data.readers.base import BAD_REST, Reader, Skipped
from lidarpose.data.rows import labeled_row
from lidarpose.data.shards import DatasetReader, open_dataset, read_rows, shard_path, shard_writer
from lidarpose.data.splits import SplitRule, split_rule
from lidarpose.data.writer import Counts, make_shards, open_folder
from lidarpose.errors import InputError, check_int, check_name, counted, first_names
from lidarpose.io.files import file_error, one_line
from lidarpose.progress import Progress
from lidarpose.sample import HIDDEN, SEEN, UNLABELED, LabeledSample
from lidarpose.skeleton import skeleton

# dataset -> module and class of its reader, and whether the reader takes the user's SMPL
READERS: dict[str, tuple[str, str, bool]] = {
    "humanm3": ("humanm3", "HumanM3", False),
    "lidarhuman26m": ("lidarhuman26m", "LidarHuman26M", True),
    "sloper4d": ("sloper4d", "Sloper4D", True),
    "waymo": ("waymo", "Waymo", False),
    "itop": ("itop", "Itop", False),
    "lipd": ("corpora", "Lipd", False),
    "freemotion": ("corpora", "FreeMotion", True),
    "noisemotion": ("corpora", "NoiseMotion", True),
}
# datasets whose frame is turned level unless the release's own frame is requested
_LEVELED = ("lidarhuman26m",)
# tables of a prepared dataset; people come last, since a part is complete once their shard exists
_TABLES = ("skipped", "labelled")
# number of people per update of the progress bar
_PROGRESS_STEP = 200
# columns of the shards that the summary reads
_SUMMARIZED = ("sequence", "frame", "split", "source", "joints", "joint_labels", "center")
# if the z component of the mean trunk direction is below this, z is not the up axis of the frame
_LEAST_UP = 0.7
# the center of a person's points is hardly ever this far from the mean of the joints, m
_FAR = 1.0


def reader(name: str, smpl: str | Path | None = None, *, level: bool = True) -> Reader:
    """The reader of a dataset, by its name in `READERS`. smpl: the user's SMPL model, a file or a folder of them;
    level: turn the frame level if the release's is not.

    Raises InputError for an unknown name, if SMPL is needed but missing or unreadable, if it is given but not needed,
    and if `level` is False for a dataset that is never turned.
    """
    check_name("dataset", name, READERS)
    module, kind, takes_smpl = READERS[name]
    if not level and name not in _LEVELED:
        raise InputError(f"{name} is not turned level, only {', '.join(_LEVELED)} is: omit --no-level")
    if smpl is not None and not takes_smpl:
        raise InputError(f"{name} has its own joints: omit the SMPL model")
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
    """Writes a dataset's people as Parquet shards into `out`, if they are missing, and returns the summary.

    name: one of `READERS`; root: the folder of its raw files; split: only people of that split ("train", "val",
    "test"), by default all; split_by: the published split to use, by default the user's own train.txt and test.txt in
    `root`, else the dataset's usual one; smpl: the user's SMPL model, a file or a folder with a file for each gender;
    level: turn lidarhuman26m's sequences level, False keeps the release's frame; workers: number of processes;
    progress: draw a bar on a terminal.

    The summary, also in out/dataset.json: people, skipped by reason with an example each, people by split and source,
    parts, and warnings. Raises InputError, one line, for a wrong root, name, split or SMPL model and for a folder that
    holds something else; MissingExtra without pyarrow.
    """
    check_int("workers", workers, least=1)
    root, out = Path(root), Path(out)
    source = reader(name, smpl, level=level)
    if not root.is_dir():
        raise file_error(root, f"is not a folder; expected the raw files of {name}")
    parts = list(source.parts(root))
    rule = split_rule(name, root, split_by, parts)
    absent_names = rule.absent(parts) if rule is not None else {}
    # if a single split is requested, missing names of other splits do not matter
    absent_names = {split_name: names for split_name, names in absent_names.items() if split in (None, split_name)}
    parts = _parts_of(name, parts, rule, split)
    for part in parts:
        source.check(root, part)
    card = _card(source, parts, rule, split)
    make = PartWriter(reader=source, root=root, out=out, parts=tuple(parts), rule=rule, only=split)
    with open_folder(out, card) as missing_shards:
        num_finished = len(parts) - len(missing_shards)
        # without the summary of an earlier run, which would be wrong until this run is finished
        if missing_shards or not (out / CARD).is_file():
            write_card(out, card)
        with Progress(len(parts), unit="parts", done=num_finished, shown=progress) as bar:
            people = 0
            for shards, new_people in make_shards(make, missing_shards, workers=workers):
                people, num_finished = people + new_people, num_finished + shards
                bar.update(num_finished, f"{people:,} people")
        summary = _summarize(open_dataset(out), parts=parts, absent_names=absent_names, rule=rule)
        write_card(out, replace(card, summary=summary))
    return summary


def _parts_of(name: str, parts: list[str], rule: SplitRule | None, split: str | None) -> list[str]:
    """The parts that may contain people of the split. Raises InputError if there are none."""
    if split is None:
        return parts
    if rule is None:
        raise InputError(f"{name} has no split to choose {split!r} from: put train.txt and test.txt into its folder")
    check_name(f"split of {name} by {rule.name}", split, rule.sets)
    split_parts = [part for part in parts if not rule.by_part or rule.of_part(part) == split]
    if not split_parts:
        raise InputError(f"none of the {len(parts)} parts of {name} is in {split!r} by {rule.name}: {rule.source}")
    return split_parts


def _card(source: Reader, parts: list[str], rule: SplitRule | None, split: str | None) -> DatasetCard:
    # a digest: the names themselves would be too long for the error about different settings
    settings: dict[str, Any] = {"what": "parts", "dataset": source.name, "parts": _digest("\n".join(parts))}
    settings |= {"split": split, "split_by": rule and rule.name}
    about = {key: value for key, value in source.about.items() if key not in ("frame", "settings")}
    if rule is not None:
        about["split"] = f"{rule.name}: {rule.source}" + (f"; LEAKS: {rule.leaks}" if rule.leaks else "")
        if rule.name == "own":
            settings["lists"] = _digest(repr(sorted(rule.sets.items())))
    return DatasetCard(
        settings=settings | source.about["settings"],
        count=len(parts),
        per_shard=1,
        tables=_TABLES,
        skeleton=source.skeleton,
        frame=source.about["frame"],
        about=about | {"parts": parts},
    )


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "backslashreplace")).hexdigest()[:12]


@dataclass(frozen=True, kw_only=True)
class PartWriter:
    """Reads parts of a dataset and writes their shards: called with a part's number, yields counts of finished people.

    only: the split to keep, None for all; the rest as in `prepare`. Picklable.
    """

    reader: Reader
    root: Path
    out: Path
    parts: tuple[str, ...]
    rule: SplitRule | None
    only: str | None

    def __call__(self, number: int) -> Counts:
        people = 0
        skipped_writer, people_writer = (shard_writer(shard_path(self.out, table, number), table) for table in _TABLES)
        with people_writer as add_person, skipped_writer as add_skipped:
            for record in self._with_split(self.parts[number]):
                if isinstance(record, Skipped):
                    add_skipped({"index": number, "reason": record.reason, "where": record.where})
                elif self.only in (None, record.split):
                    add_person(labeled_row(record, index=number))
                    people += 1
                    if people % _PROGRESS_STEP == 0:
                        yield _PROGRESS_STEP
        yield people % _PROGRESS_STEP

    def _with_split(self, part: str) -> Iterator[LabeledSample | Skipped]:
        """All people of a part, with their splits."""
        records: Iterable[LabeledSample | Skipped] = self._read(part)
        splits: Iterator[str | None] = repeat(self.rule.of_part(part) if self.rule else None)
        if self.rule is not None and not self.rule.by_part:
            records = list(records)
            splits = iter(self.rule.of_chunks(part, sum(isinstance(record, LabeledSample) for record in records)))
        for record in records:
            yield replace(record, split=next(splits)) if isinstance(record, LabeledSample) else record

    def _read(self, part: str) -> Iterator[LabeledSample | Skipped]:
        """Like the reader, but an error ends the part and is recorded as skipped."""
        try:
            yield from self.reader.read(self.root, part)
        except InputError as error:
            yield Skipped(BAD_REST, f"{part}: {error}")
        except (OSError, ArithmeticError, LookupError, TypeError, ValueError, AttributeError) as error:
            # an unexpected error must not affect other parts; its type tells a bug in a reader from a bad file
            kind = type(error).__name__
            yield Skipped(f"{BAD_REST} ({kind})", one_line(f"{part}: {kind}: {error}"))


# ---- the summary: computed from the shards only, so that it does not depend on interruptions of the run


def _summarize(
    dataset: DatasetReader, *, parts: list[str], absent_names: dict[str, list[str]], rule: SplitRule | None
) -> dict[str, Any]:
    """The summary of `prepare`: counts and warnings. absent_names: split -> missing sequences."""
    labels, splits, sources, reasons = Counter[int](), Counter[str](), Counter[str](), Counter[str]()
    examples: dict[str, str] = {}
    frames: set[tuple[str, int]] = set()
    trunks, offsets, part_rows, num_in_scans = [], [], [], 0
    names = skeleton(dataset.card.skeleton).joints
    joint_pairs = [[names.index(f"{side}_{joint}") for side in ("left", "right")] for joint in ("hip", "shoulder")]
    for shard, part in enumerate(parts):
        people, skipped_rows = 0, list(read_rows(dataset.path(shard, "skipped"), "skipped"))
        for row in read_rows(dataset.path(shard), "labelled", (*_SUMMARIZED, "neighbors")):
            is_incomplete = any(row[name] is None for name in _SUMMARIZED if name != "split")
            if is_incomplete or len(row["joints"]) != 3 * len(names):
                problem = "has a row that is not a sample; delete it and run the same command again"
                raise file_error(dataset.path(shard), problem)
            people += 1
            num_in_scans += row["neighbors"] is not None
            frames.add((row["sequence"], row["frame"]))
            splits[row["split"] or "none"] += 1
            sources[row["source"]] += 1
            labels.update(row["joint_labels"].tolist())
            joints = row["joints"].reshape(-1, 3)
            is_labeled = ~np.isnan(joints[:, 0])
            if is_labeled.any():
                offsets.append(float(np.linalg.norm(joints[is_labeled].mean(0) - row["center"])))
            hips, shoulders = (joints[pair].mean(0) for pair in joint_pairs)
            if not np.isnan(shoulders - hips).any():
                trunks.append((shoulders - hips) / max(float(np.linalg.norm(shoulders - hips)), 1e-6))
        for row in skipped_rows:
            reasons[row["reason"]] += 1
            examples.setdefault(row["reason"], row["where"])
        part_rows.append({"part": part, "people": people, "skipped": len(skipped_rows)})
    summary = {
        "people": sum(splits.values()),
        "frames": len(frames),
        "splits": dict(sorted(splits.items())),
        "sources": dict(sorted(sources.items())),
        "joints": {"seen": labels[SEEN], "hidden": labels[HIDDEN], "unlabelled": labels[UNLABELED]},
        "skipped": dict(reasons.most_common()),
        "skipped_first": examples,
        "trunk": [round(float(v), 3) for v in np.mean(trunks, 0)] if trunks else None,
        "joints_from_center_m": round(float(np.median(offsets)), 3) if offsets else None,
        "parts": part_rows,
        # of datasets with whole scans
        "without_scan": sum(splits.values()) - num_in_scans if num_in_scans else None,
    }
    return summary | {"warnings": _warnings(summary, absent_names, rule)}


def _warnings(summary: dict[str, Any], absent_names: dict[str, list[str]], rule: SplitRule | None) -> list[str]:
    lines, trunk, offset = [], summary["trunk"], summary["joints_from_center_m"]
    if not summary["people"]:
        lines.append("it has no people; see what was skipped")
    if trunk is not None and trunk[2] < _LEAST_UP:
        lines.append(f"people stand along {trunk} on average, expected z up: turn the dataset first")
    if offset is not None and offset > _FAR:
        problem = f"the median distance from joints to points is {offset:.2f} m"
        lines.append(f"{problem}: are labels and clouds from different releases?")
    if summary["without_scan"]:
        count = counted(summary["without_scan"], "person", "people")
        lines.append(f"the whole scans of {count} are missing or damaged: their neighbors are not known")
    empty_parts = [part["part"] for part in summary["parts"] if not part["people"]]
    if empty_parts and summary["people"]:
        lines.append(f"no people in {first_names(empty_parts, 5)}")
    if rule is not None:
        lines += [
            f"missing: {first_names(names, 5)} of {split} by {rule.name}" for split, names in absent_names.items()
        ]
        if rule.leaks:
            lines.append(f"the split {rule.name} leaks: {rule.leaks}")
    return lines


def summary_lines(summary: dict[str, Any]) -> list[str]:
    """The summary as lines for a terminal: people, skipped items by reason with an example, warnings."""
    splits = ", ".join(f"{split} {count:,}" for split, count in summary["splits"].items())
    lines = [f"{summary['people']:,} people in {summary['frames']:,} frames ({splits or 'none'})"]
    for reason, count in summary["skipped"].items():
        lines.append(f"skipped {count:,}: {reason} (first: {summary['skipped_first'][reason]})")
    return lines + [f"warning: {line}" for line in summary["warnings"]]
