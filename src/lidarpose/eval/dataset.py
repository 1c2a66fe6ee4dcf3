"""People to be judged: of a folder that `lidarpose prepare` or `synth` wrote, or of lidarpose-bench."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Protocol

import numpy as np

from lidarpose.data.shards import DatasetReader, open_dataset, read_rows, rows_of_shard, shard_path
from lidarpose.errors import InputError, whole
from lidarpose.eval.bench import NAME, PLAIN_POINTS, Bench, load_bench, plain
from lidarpose.io.files import file_error
from lidarpose.sample import HIDDEN, SEEN, UNLABELED, Box, is_plain
from lidarpose.skeleton import BODY26, HUMAN15, Skeleton, skeleton

# the word for the set that ships with the package
BENCH = "bench"
# the word for everybody, whatever split
EVERYBODY = "all"
# splits that are judged where none is named, the first that there is. Waymo's papers report on its validation folder
_JUDGED_SPLITS = ("test", "val")
# joints by which synthetic people are judged, where nobody asks for others
_SYNTHETIC = HUMAN15


@dataclass(frozen=True, kw_only=True)
class Person:
    """One person in one frame.

    shard, row: where in the dataset; points (n, 3) m; joints (J, 3) m, NaN where not labelled; labels (J,): UNLABELED,
    HIDDEN or SEEN; box or None; centers: see `Item`; sensor_known: the frame's origin is the sensor; sequence, frame,
    track, time s; distance m, hidden (share of the body, of synthetic people), both NaN where unknown; sensor,
    condition, poses: "" where the dataset does not tell; plain: upright, whole, uncluttered, 100 points; moving: a
    frame of a clip that is judged for motion alone.
    """

    shard: int
    row: int
    points: np.ndarray
    joints: np.ndarray
    labels: np.ndarray
    box: Box | None = None
    centers: dict[str, np.ndarray] = field(default_factory=dict)
    sensor_known: bool = True
    sequence: str
    frame: int
    track: str
    time: float
    distance: float
    hidden: float
    sensor: str = ""
    condition: str = ""
    poses: str = ""
    plain: bool = False
    moving: bool = False


class People(Protocol):
    """Somebody's dataset, opened. name; kind: the raw dataset's name, "synth" or "bench"; skeleton of the joints;
    judged: the joints that are judged by default; split: name or "none"; split_by and split_source: of the split, ""
    where there is none; leaks; level: sequences out of level were turned; count: people who are judged; total: of how
    many; limit as asked for; clusters: people of one `sequence` are not independent; skipped: reason -> how many and
    the first, of the last reading."""

    name: str
    kind: str
    skeleton: Skeleton
    judged: Skeleton
    split: str
    split_by: str
    split_source: str
    leaks: str
    level: bool
    count: int
    total: int
    limit: int | None
    clusters: bool
    skipped: dict[str, dict]

    def __iter__(self) -> Iterator[Person]: ...


def open_people(dataset: str | Path, *, split: str | None = None, limit: int | None = None) -> People:
    """A dataset's people: those of `split`, "all" for everybody; None: test, else val, else everybody where there is no
    split. limit: only so many, evenly spread. Raises InputError for what is no dataset, a split that nobody is in, and
    a dataset whose shards are missing or all damaged; MissingExtra without pyarrow."""
    if limit is not None:
        limit = whole("limit", limit, least=1, hint=" person")
    if not isinstance(dataset, str | PathLike):
        raise InputError(f"expected a dataset to judge, {BENCH} or the path of a folder, got {dataset!r}")
    if str(dataset) == BENCH:
        return BenchPeople.open(split, limit)
    return FolderPeople.open(Path(dataset), split, limit)


def note(skipped: dict[str, dict], reason: str, where: str, count: int = 1) -> None:
    """Counts somebody or something left out."""
    entry = skipped.setdefault(reason, {"count": 0, "first": where})
    entry["count"] += count


def spread(total: int, limit: int | None) -> np.ndarray:
    """Indices of `limit` of `total` people, each in the middle of an equal share; of everybody without a limit."""
    count = total if limit is None else min(limit, total)
    return (2 * np.arange(count) + 1) * total // (2 * max(count, 1))


# ---- folders


@dataclass(frozen=True, kw_only=True)
class FolderPeople:
    """A folder of shards. wanted: shard -> its rows to judge; damaged: what could not even be opened. See `People`."""

    dataset: DatasetReader
    name: str
    kind: str
    skeleton: Skeleton
    judged: Skeleton
    split: str
    split_by: str
    split_source: str
    leaks: str
    level: bool
    total: int
    limit: int | None
    wanted: dict[int, np.ndarray]
    damaged: dict[str, dict]
    skipped: dict[str, dict] = field(default_factory=dict)

    @classmethod
    def open(cls, folder: Path, split: str | None, limit: int | None) -> "FolderPeople":
        dataset = open_dataset(folder)
        card, damaged = dataset.card, {}
        synthetic = card.people != "labelled"
        if synthetic and split not in (None, EVERYBODY):
            raise file_error(folder, f"holds synthetic people, which have no splits, got {split!r}: leave --split out")
        splits = _splits(dataset, damaged)
        there = sorted({name for names in splits.values() for name in names if name})
        if not splits:
            first = next(iter(damaged.values()))["first"]
            raise InputError(f"none of the {card.shards} shards of {folder} can be read; the first: {first}")
        if split is None:
            split = next((name for name in _JUDGED_SPLITS if name in there), EVERYBODY)
            if split == EVERYBODY and there:
                raise file_error(folder, f"has nobody in test or val, only in {', '.join(there)}: say --split NAME")
        rows = {
            shard: np.array([k for k, name in enumerate(names) if split in (EVERYBODY, name)], int)
            for shard, names in splits.items()
        }
        total = sum(map(len, rows.values()))
        if not total:
            known = ", ".join(there) or "no splits"
            raise file_error(folder, f"has nobody in the split {split!r}; there are {known}: say one with --split")
        about = str(card.about.get("split", ""))
        text, _, leaks = about.partition("; LEAKS: ")
        own = card.settings.get("split_by") or ""
        return cls(
            dataset=dataset,
            name=folder.resolve().name,
            kind="synth" if synthetic else str(card.settings.get("dataset", "labelled")),
            skeleton=skeleton(card.skeleton),
            judged=_SYNTHETIC if synthetic else skeleton(card.skeleton),
            split="none" if synthetic or not there else split,
            split_by=own,
            split_source=text.removeprefix(f"{own}: "),
            leaks=leaks,
            level=bool(card.settings.get("level")),
            total=total,
            limit=limit if limit is not None and limit < total else None,
            wanted=_limited(rows, total, limit),
            damaged=damaged,
        )

    @property
    def count(self) -> int:
        return sum(map(len, self.wanted.values()))

    @property
    def clusters(self) -> bool:
        return self.kind != "synth" or self.dataset.card.settings.get("what") != "people"

    def __iter__(self) -> Iterator[Person]:
        table = self.dataset.card.people
        person = self._synthetic if table == "people" else self._labelled
        self.skipped.clear()
        self.skipped.update({reason: dict(entry) for reason, entry in self.damaged.items()})
        for shard, wanted in self.wanted.items():
            if not len(wanted):
                continue
            path = shard_path(self.dataset.folder, table, shard)
            try:
                # a shard that turns out to be damaged half way is left out as a whole
                rows = list(read_rows(path, table))
            except InputError as error:
                note(self.skipped, "damaged shards", f"{error}")
                note(self.skipped, "people of damaged shards", path.name, len(wanted))
                continue
            for k in wanted:
                if k >= len(rows):
                    continue
                try:
                    yield person(shard, int(k), rows[k])
                except InputError as error:
                    note(self.skipped, "rows that are no sample", f"{path.name}, row {k}: {error}")

    def _labelled(self, shard: int, k: int, row: dict) -> Person:
        item = self.dataset.sample(row)
        known = row["distance"] is not None
        return Person(
            shard=shard,
            row=k,
            points=item.sample.points,
            joints=item.sample.pose.joints,
            labels=item.joint_labels,
            box=item.sample.box,
            centers=item.centers,
            sensor_known=known,
            sequence=item.sequence,
            frame=item.frame,
            track=item.track,
            time=item.time,
            distance=row["distance"] if known else np.nan,
            hidden=np.nan,
        )

    def _synthetic(self, shard: int, k: int, row: dict) -> Person:
        sample = self.dataset.sample(row)
        alone = self.dataset.card.settings.get("what") == "people"
        # nothing is known of people in streets
        measured = ("distance", "visible", "clutter")
        distance, visible, clutter = (np.nan if row[name] is None else row[name] for name in measured)
        return Person(
            shard=shard,
            row=k,
            points=sample.points,
            joints=sample.pose.joints,
            labels=np.full(len(self.skeleton), SEEN, np.uint8),
            box=sample.box,
            sequence=str(row["index"]),
            frame=row["frame"],
            track=str(row["track"]),
            # clips and streets are at 10 Hz
            time=np.nan if alone else row["frame"] / 10,
            distance=distance,
            hidden=1 - visible,
            sensor=row["sensor"] or "",
            plain=len(sample.points) >= PLAIN_POINTS and bool(is_plain(bool(row["upright"]), visible, clutter)),
        )


def _splits(dataset: DatasetReader, damaged: dict[str, dict]) -> dict[int, list[str | None]]:
    """Shard -> the split of each row. Damaged shards are left out and counted; raises InputError for a missing one."""
    table, found = dataset.card.people, {}
    for shard in range(dataset.card.shards):
        path = shard_path(dataset.folder, table, shard)
        if not path.is_file():
            raise file_error(path, f"is missing: the dataset is not finished; run the same {dataset.card.writer} again")
        try:
            if table == "labelled":
                found[shard] = [row["split"] for row in read_rows(path, table, ("split",))]
            else:
                rows = rows_of_shard(path)
                if rows is None:
                    raise file_error(path, "cannot be read as Parquet; delete it and make it again")
                found[shard] = [None] * rows
        except InputError as error:
            note(damaged, "damaged shards", str(error))
    return found


def _limited(rows: dict[int, np.ndarray], total: int, limit: int | None) -> dict[int, np.ndarray]:
    chosen, first, out = spread(total, limit), 0, {}
    for shard, own in rows.items():
        here = chosen[(chosen >= first) & (chosen < first + len(own))] - first
        out[shard] = own[here]
        first += len(own)
    return out


# ---- the set that ships


@dataclass(frozen=True, kw_only=True)
class BenchPeople:
    """lidarpose-bench: its people alone, and without a limit the frames of its clips for motion. See `People`."""

    bench: Bench
    rows: np.ndarray
    limit: int | None
    name: str = NAME
    kind: str = BENCH
    skeleton: Skeleton = BODY26
    judged: Skeleton = _SYNTHETIC
    split: str = "none"
    split_by: str = ""
    split_source: str = ""
    leaks: str = ""
    level: bool = False
    clusters: bool = False
    skipped: dict[str, dict] = field(default_factory=dict)

    @classmethod
    def open(cls, split: str | None, limit: int | None) -> "BenchPeople":
        if split not in (None, EVERYBODY):
            raise InputError(f"{NAME} is one test set without splits, got {split!r}: leave --split out")
        bench = load_bench()
        limit = limit if limit is not None and limit < len(bench.people) else None
        rows = bench.people[spread(len(bench.people), limit)]
        if limit is None:
            rows = np.concatenate([rows, *bench.clips])
        return cls(bench=bench, rows=rows, limit=limit)

    @property
    def total(self) -> int:
        return len(self.bench.people)

    @property
    def count(self) -> int:
        return self.total if self.limit is None else self.limit

    def __iter__(self) -> Iterator[Person]:
        columns = self.bench.columns
        plain_rows = plain(self.bench)
        for k in self.rows.tolist():
            clip, frame = int(columns["clip"][k]), int(columns["frame"][k])
            box = columns["box"][k]
            yield Person(
                shard=0,
                row=k,
                points=self.bench.points[k],
                joints=self.bench.joints[k],
                labels=np.full(len(BODY26), SEEN, np.uint8),
                box=Box(center=box[:3], size=box[3:6], yaw=float(box[6])),
                sequence=f"clip {clip}" if clip >= 0 else str(k),
                frame=frame,
                track="0",
                time=frame / 10 if clip >= 0 else np.nan,
                distance=float(columns["distance"][k]),
                hidden=float(1 - columns["visible"][k]),
                sensor=str(columns["sensor"][k]),
                condition=str(columns["condition"][k]),
                poses=str(columns["poses"][k]),
                plain=bool(plain_rows[k]),
                moving=clip >= 0,
            )


def hidden_share(labels: np.ndarray) -> np.ndarray:
    """labels (n, J) -> (n,): the share of each person's labelled joints that are hidden; NaN where nobody's joint is
    labelled so, since then nothing was said about it."""
    if not (labels == HIDDEN).any():
        return np.full(len(labels), np.nan)
    count = (labels != UNLABELED).sum(1)
    return np.where(count > 0, (labels == HIDDEN).sum(1) / np.maximum(count, 1), np.nan)
