"""Datasets of people as Parquet shards: a folder with dataset.json and numbered .parquet files, see `data.schema`."""

import json
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lidarpose._version import __version__
from lidarpose.data.schema import INFO, TABLES, arrays_of, pyarrow, rows_of, sample_of, schema_of
from lidarpose.errors import InputError
from lidarpose.io.files import atomic_path, file_error, read_bytes, write_atomic
from lidarpose.sample import LabeledSample
from lidarpose.skeleton import BODY26, skeleton

SCHEMA = 1
CARD = "dataset.json"
SENSOR_FRAME = "level frame at the sensor: x forward, y left, z up"
# rows that are compressed together: what a writer and a reader must hold. A turn of 128 rings has up to 260,000 points
_ROW_GROUP = {"people": 500, "frames": 4, "labelled": 500, "skipped": 5000}


# one of what a dataset counts
_ONE = {"people": "person", "clips": "clip", "streets": "street", "parts": "part"}


def counted(count: int, what: str) -> str:
    """ "1 street", "1,200 people"."""
    return f"{count:,} {_ONE.get(what, what) if count == 1 else what}"


@dataclass(frozen=True, kw_only=True)
class DatasetCard:
    """What dataset.json says: settings, all that decides the content; count of persons, clips, streets or parts;
    per_shard; tables; skeleton's name; version of the package that wrote it; frame of points and joints; about: of a
    real dataset, its licence, quirks and parts; summary: what a finished one holds."""

    settings: dict[str, Any]
    count: int
    per_shard: int
    tables: tuple[str, ...]
    skeleton: str = BODY26.name
    version: str = __version__
    frame: str = SENSOR_FRAME
    about: dict[str, Any] = field(default_factory=dict)
    summary: dict[str, Any] | None = None

    @property
    def people(self) -> str:
        """The table of people: "people" of synthetic ones, "labelled" of real ones."""
        return "labelled" if "labelled" in self.tables else "people"

    @property
    def writer(self) -> str:
        """The command that writes such a dataset."""
        return "lidarpose prepare" if self.people == "labelled" else "lidarpose synth"

    @property
    def shards(self) -> int:
        """How many shards a table has."""
        return -(-self.count // self.per_shard)

    def size(self, shard: int) -> int:
        """How many persons, clips or streets a shard holds."""
        return min(self.per_shard, self.count - shard * self.per_shard)

    def to_json(self) -> str:
        named = {"schema": SCHEMA, "version": self.version, "count": self.count, "per_shard": self.per_shard}
        named |= {"tables": list(self.tables), "unit": "m", "frame": self.frame, "skeleton": self.skeleton}
        named |= {"joints": list(skeleton(self.skeleton).joints), "settings": self.settings}
        optional = {"about": self.about or None, "summary": self.summary}
        named |= {name: value for name, value in optional.items() if value is not None}
        return json.dumps(named, indent=2) + "\n"


def read_card(folder: str | Path) -> DatasetCard:
    """The card of a dataset's folder. Raises InputError where it is missing, damaged or of another schema."""
    path = Path(folder) / CARD
    if not path.is_file():
        raise file_error(folder, f"is no dataset: {CARD} is missing; write one with lidarpose synth or prepare")
    try:
        found = json.loads(read_bytes(path, expected="a dataset's card"))
        if found["schema"] != SCHEMA:
            version = found.get("version", "of the version that wrote it")
            problem = f"is of schema {found['schema']!r}, this lidarpose reads {SCHEMA}: install lidarpose {version}"
            raise file_error(path, problem)
        card = DatasetCard(
            settings=dict(found["settings"]),
            count=int(found["count"]),
            per_shard=int(found["per_shard"]),
            tables=tuple(map(str, found["tables"])),
            skeleton=str(found["skeleton"]),
            version=str(found["version"]),
            frame=str(found.get("frame", SENSOR_FRAME)),
            about=dict(found.get("about", {})),
            summary=None if found.get("summary") is None else dict(found["summary"]),
        )
    except InputError:
        raise
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        problem = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise file_error(path, f"is not a dataset's card ({problem})") from None
    if card.count < 1 or card.per_shard < 1 or not set(card.tables) <= set(TABLES):
        raise file_error(path, "is not a dataset's card: count, per_shard or tables make no sense")
    skeleton(card.skeleton)
    return card


def write_card(folder: str | Path, card: DatasetCard) -> None:
    """Writes dataset.json, whole or not at all."""
    write_atomic(Path(folder) / CARD, card.to_json())


def shard_path(folder: str | Path, table: str, shard: int) -> Path:
    return Path(folder) / f"{table}-{shard:05d}.parquet"


@contextmanager
def shard_writer(path: str | Path, table: str) -> Iterator[Callable[[dict[str, Any]], None]]:
    """Writes the rows of a table ("people", "frames", ...), whole or not at all; the same rows give the same bytes.

    Yields what adds a row, and holds a row group of them at a time. Raises InputError where the folder cannot be
    written, MissingExtra without pyarrow.
    """
    pa, parquet = pyarrow()
    schema = schema_of(pa, table)
    waiting: list[dict[str, Any]] = []

    def write() -> None:
        found = pa.Table.from_arrays(arrays_of(pa, table, waiting), schema=schema)
        writer.write_table(found, row_group_size=_ROW_GROUP[table])
        waiting.clear()

    def add(row: dict[str, Any]) -> None:
        waiting.append(row)
        if len(waiting) == _ROW_GROUP[table]:
            write()

    # a flipped bit in points would pass unnoticed
    options = {"compression": "zstd", "use_dictionary": False, "write_page_checksum": True}
    with atomic_path(path) as temporary, parquet.ParquetWriter(temporary, schema, **options) as writer:
        yield add
        if waiting:
            write()


def rows_of_shard(path: str | Path) -> int | None:
    """How many rows a shard says it holds; None where it is missing or damaged."""
    _, parquet = pyarrow()
    try:
        with parquet.ParquetFile(path) as file:
            return file.metadata.num_rows
    except Exception:
        # pyarrow raises many kinds for damaged files; what matters is that it is to be written again
        return None


def read_rows(path: str | Path, table: str, columns: tuple[str, ...] | None = None) -> Iterator[dict[str, Any]]:
    """The rows of a shard, list columns as numpy arrays; of `columns` alone where they are named, the others None.

    Raises InputError for a damaged file, and for a column that is missing or of another type.
    """
    pa, parquet = pyarrow()
    try:
        with parquet.ParquetFile(path, page_checksum_verification=True) as file:
            there = [name for name in TABLES[table] if name in file.schema_arrow.names]
            optional = INFO if table == "people" else ()
            missing = [name for name in TABLES[table] if name not in there and name not in optional]
            if missing:
                raise InputError(f"is no shard of {table}: the columns {', '.join(missing)} are missing")
            wanted = there if columns is None else [name for name in there if name in columns]
            for batch in file.iter_batches(batch_size=_ROW_GROUP[table], columns=wanted):
                yield from rows_of(pa, batch, table)
    except InputError as error:
        raise file_error(path, error) from None
    except (pa.ArrowException, OSError, ValueError, TypeError, AttributeError, MemoryError) as error:
        raise file_error(path, f"cannot be read as Parquet ({error}); delete it and make it again") from None


@dataclass(frozen=True, kw_only=True)
class DatasetReader:
    """A folder of shards, read as it is iterated: its samples in order. card: what dataset.json says."""

    folder: Path
    card: DatasetCard

    def path(self, shard: int, table: str | None = None) -> Path:
        """A shard of a table, by default that of people."""
        return shard_path(self.folder, table or self.card.people, shard)

    def written(self, table: str | None = None) -> list[int]:
        """Numbers of the shards of a table, by default that of people, that are there: no count in dataset.json makes
        this long."""
        name = re.compile(rf"{table or self.card.people}-(\d{{5,9}})\.parquet")
        numbers = (name.fullmatch(path.name) for path in self.folder.iterdir())
        return sorted(k for k in (int(number[1]) for number in numbers if number) if k < self.card.shards)

    def rows(self, table: str | None = None, shards: Iterable[int] | None = None) -> Iterator[dict[str, Any]]:
        """The rows of a table, of some shards or of all; see `TABLES`. By default those of people."""
        for shard in range(self.card.shards) if shards is None else shards:
            path = self.path(shard, table)
            if not path.is_file():
                again = f"run the same {self.card.writer} again"
                raise file_error(path, f"is missing: the dataset is not finished; {again}")
            yield from read_rows(path, table or self.card.people)

    def rows_of(self, table: str, shard: int) -> int:
        """How many rows a shard has. Raises InputError where it is missing or damaged."""
        path = self.path(shard, table)
        rows = rows_of_shard(path)
        if rows is None:
            problem = "is damaged" if path.exists() else "is missing: the dataset is not finished"
            raise file_error(path, f"{problem}; run the same {self.card.writer} again")
        return rows

    def __iter__(self) -> Iterator[LabeledSample]:
        return (self.sample(row) for row in self.rows())

    def samples(self, split: str | None = None) -> Iterator[LabeledSample]:
        """Everybody with what is labeled, or of a dataset of real people those of a split ("train", "val", "test").

        Raises InputError for a split of synthetic people, and for one that nobody is in.
        """
        if split is not None and self.card.people != "labelled":
            raise file_error(self.folder, f"holds synthetic people, which have no split {split!r}: leave it out")
        none = True
        for row in self.rows():
            if split is None or row["split"] == split:
                none = False
                yield self.sample(row)
        if none and split is not None:
            raise file_error(self.folder, f"has nobody in the split {split!r}; prepare says which splits it has")

    # the name until 0.2
    items = samples

    def sample(self, row: dict[str, Any]) -> LabeledSample:
        """The sample of a row of people. Raises InputError that names its shard and column for a row that is none."""
        try:
            return sample_of(row, self.card.skeleton, self.card.settings.get("what", "people"))
        except (ValueError, TypeError, AttributeError, KeyError) as error:
            number = row.get("index")
            shard = number is not None and self.path(number // self.card.per_shard)
            problem = f"row of index {number} is no sample: {error}; write it again"
            raise file_error(shard or self.folder, problem) from None


def open_dataset(folder: str | Path) -> DatasetReader:
    """A dataset that `lidarpose synth` or `prepare` wrote. Raises InputError for none, MissingExtra without pyarrow."""
    pyarrow()
    return DatasetReader(folder=Path(folder), card=read_card(folder))


def check_settings(folder: str | Path, found: DatasetCard, wanted: DatasetCard) -> None:
    """Raises InputError that names the settings in which a dataset differs from what is wanted."""
    old, new = (
        {"count": c.count, "per_shard": c.per_shard, "version": c.version, **c.settings} for c in (found, wanted)
    )
    differ = [
        f"{name} {json.dumps(old.get(name))} there, {json.dumps(new.get(name))} asked for"
        for name in sorted(old | new)
        if old.get(name) != new.get(name)
    ]
    if differ:
        problem = f"{folder} holds a dataset of other settings: {'; '.join(differ)}"
        raise InputError(f"{problem}; give another folder or the same settings")
