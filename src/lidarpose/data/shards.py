"""Datasets of people as Parquet shards: a folder with dataset.json and numbered .parquet files, see `data.rows`.

Any Parquet reader opens the shards (pandas, DuckDB, Hugging Face datasets, Ray, ...).
"""

import os
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose.data.dataset_card import DatasetCard, read_card
from lidarpose.data.rows import TABLES, Column, check_lengths, sample_of
from lidarpose.errors import InputError, MissingExtra
from lidarpose.io.atomic import atomic_path
from lidarpose.io.files import encodable, file_error
from lidarpose.sample import LabeledSample

# rows per row group, which writers and readers hold in memory. A revolution of 128 rings has up to 260,000 points
_ROW_GROUP = {"people": 500, "frames": 4, "labelled": 500, "skipped": 5000}


def pyarrow():
    """pyarrow and pyarrow.parquet. Raises MissingExtra without them."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise MissingExtra("reading and writing Parquet", "synth") from None
    return pyarrow, pyarrow.parquet


def _arrow_type(pa, column: Column):
    value = pa.bool_() if column.type == "bool" else getattr(pa, column.type)()
    return value if column.shape is None else pa.list_(value)


def to_arrow(pa, table: str, rows: list[dict[str, Any]]):
    """Rows as an Arrow table."""
    schema = pa.schema([(name, _arrow_type(pa, column)) for name, column in TABLES[table].items()])
    arrays = []
    for name, column in TABLES[table].items():
        values = [row[name] for row in rows]
        if column.type == "string":
            values = [v if v is None else encodable(v) for v in values]
        elif column.shape is not None:
            values = [v if v is None else np.asarray(v, column.type).ravel() for v in values]
        arrays.append(pa.array(values, schema.field(name).type))
    return pa.Table.from_arrays(arrays, schema=schema)


def _rows_of(pa, batch, table: str) -> Iterator[dict[str, Any]]:
    """The rows of a record batch with lists as numpy arrays; None if a value is null or its column is missing. Raises
    InputError that names the column if its type is wrong."""
    columns: dict[str, Any] = {}
    for name, column in TABLES[table].items():
        if name not in batch.schema.names:
            columns[name] = [None] * batch.num_rows
            continue
        values = batch.column(name)
        # for tables of people, `sample_of` checks nulls and names the row
        if table in ("frames", "skipped") and values.null_count and not column.optional:
            raise InputError(f"column {name} has nulls, expected {column.text}")
        try:
            values = values.cast(_arrow_type(pa, column))
        except pa.ArrowException:
            raise InputError(f"column {name} is {values.type}, expected {column.text}") from None
        if column.shape is None:
            columns[name] = values.to_pylist()
            continue
        if values.flatten().null_count:
            raise InputError(f"column {name} has nulls in its lists, expected {column.text}")
        columns[name] = [cell.values.to_numpy() if cell.is_valid else None for cell in values]
    for values in zip(*columns.values(), strict=True):
        row = dict(zip(columns, values, strict=True))
        if table == "frames":
            check_lengths(row, table)
        yield row


def shard_path(folder: str | Path, table: str, shard: int) -> Path:
    return Path(folder) / f"{table}-{shard:05d}.parquet"


@contextmanager
def shard_writer(path: str | Path, table: str) -> Iterator[Callable[[dict[str, Any]], None]]:
    """Writes the rows of a table ("people", "frames", ...) atomically; the same rows give the same bytes.

    Yields a function that adds a row, and buffers one row group. Raises InputError if the folder cannot be written,
    MissingExtra without pyarrow.
    """
    pa, parquet = pyarrow()
    buffer: list[dict[str, Any]] = []

    def flush() -> None:
        writer.write_table(to_arrow(pa, table, buffer), row_group_size=_ROW_GROUP[table])
        buffer.clear()

    def add(row: dict[str, Any]) -> None:
        buffer.append(row)
        if len(buffer) == _ROW_GROUP[table]:
            flush()

    # with checksums: a flipped bit in points would go unnoticed
    options = {"compression": "zstd", "use_dictionary": False, "write_page_checksum": True}
    schema = to_arrow(pa, table, []).schema
    # pyarrow is given files: it takes a path with a colon for a URI, and cannot encode every file name
    with (
        atomic_path(path) as temporary,
        pa.OSFile(os.fsencode(temporary), "wb") as file,
        parquet.ParquetWriter(file, schema, **options) as writer,
    ):
        yield add
        if buffer:
            flush()


@contextmanager
def open_parquet(path: str | Path, remedy: str, **options: Any) -> Iterator[Any]:
    """An open Parquet file. Any error with it in the block becomes an InputError of one line that names the file."""
    pa, parquet = pyarrow()
    try:
        with pa.OSFile(os.fsencode(path)) as source, parquet.ParquetFile(source, **options) as file:
            yield file
    except InputError as error:
        raise file_error(path, error) from None
    except FileNotFoundError:
        raise file_error(path, "is missing") from None
    except (pa.ArrowException, OSError, ValueError, TypeError, AttributeError, KeyError, MemoryError) as error:
        raise file_error(path, f"cannot be read as Parquet ({error}); {remedy}") from None


def rows_of_shard(path: str | Path) -> int | None:
    """The number of rows in a shard's metadata; None if it is missing or damaged."""
    with suppress(InputError), open_parquet(path, "") as file:
        return file.metadata.num_rows
    return None


def read_rows(path: str | Path, table: str, columns: tuple[str, ...] | None = None) -> Iterator[dict[str, Any]]:
    """The rows of a shard with list columns as numpy arrays; if `columns` are given, all others are None.

    Raises InputError for a damaged file, and for a column that is missing or has the wrong type.
    """
    pa, _ = pyarrow()
    with open_parquet(path, "delete it and make it again", page_checksum_verification=True) as file:
        names = file.schema_arrow.names
        missing_columns = [name for name, column in TABLES[table].items() if name not in names and not column.optional]
        if missing_columns:
            raise InputError(f"is not a shard of {table}: the columns {', '.join(missing_columns)} are missing")
        column_names = [name for name in TABLES[table] if name in names and (columns is None or name in columns)]
        for batch in file.iter_batches(batch_size=_ROW_GROUP[table], columns=column_names):
            yield from _rows_of(pa, batch, table)


@dataclass(frozen=True, kw_only=True)
class DatasetReader:
    """A folder of shards, read lazily by iteration: its samples in order. card: the contents of dataset.json."""

    folder: Path
    card: DatasetCard

    def path(self, shard: int, table: str | None = None) -> Path:
        """The path of a shard of a table, by default the table of people."""
        return shard_path(self.folder, table or self.card.people, shard)

    def written(self, table: str | None = None) -> list[int]:
        """Numbers of the existing shards of a table, by default the table of people. Lists the folder, so a wrong large
        count in dataset.json costs no time."""
        name = re.compile(rf"{table or self.card.people}-(\d{{5,9}})\.parquet")
        numbers = (name.fullmatch(path.name) for path in self.folder.iterdir())
        return sorted(k for k in (int(number[1]) for number in numbers if number) if k < self.card.shards)

    def rows(self, table: str | None = None, shards: Iterable[int] | None = None) -> Iterator[dict[str, Any]]:
        """The rows of a table, by default that of people, in some shards or in all; see `TABLES`."""
        for shard in range(self.card.shards) if shards is None else shards:
            path = self.path(shard, table)
            if not path.is_file():
                raise self._unfinished(path)
            yield from read_rows(path, table or self.card.people)

    def rows_of(self, table: str, shard: int) -> int:
        """Number of rows of a shard. Raises InputError if it is missing or damaged."""
        path = self.path(shard, table)
        rows = rows_of_shard(path)
        if rows is None:
            raise self._unfinished(path)
        return rows

    def _unfinished(self, path: Path) -> InputError:
        problem = "is damaged" if path.exists() else "is missing: the dataset is not finished"
        return file_error(path, f"{problem}; run the same {self.card.writer} again")

    def __iter__(self) -> Iterator[LabeledSample]:
        return (self.sample(row) for row in self.rows())

    def samples(self, split: str | None = None) -> Iterator[LabeledSample]:
        """All samples with their labels; of real people optionally those of a split ("train", "val", "test").

        Raises InputError for a split of synthetic people, and for an empty split.
        """
        if split is not None and self.card.people != "labelled":
            raise file_error(self.folder, f"has synthetic people, which have no split {split!r}: omit the split")
        is_empty = True
        for row in self.rows():
            if split is None or row["split"] == split:
                is_empty = False
                yield self.sample(row)
        if is_empty and split is not None:
            raise file_error(self.folder, f"has no people in the split {split!r}; lidarpose prepare lists its splits")

    # the method's name until 0.2
    items = samples

    def sample(self, row: dict[str, Any]) -> LabeledSample:
        """The sample of a row of people. Raises InputError that names the shard and the column for an invalid row."""
        try:
            return sample_of(row, self.card.skeleton, self.card.settings.get("what", "people"))
        except (ValueError, TypeError, AttributeError, KeyError) as error:
            number = row.get("index")
            path = self.folder if number is None else self.path(number // self.card.per_shard)
            raise file_error(path, f"row with index {number} is not a sample: {error}; write it again") from None


def open_dataset(folder: str | Path) -> DatasetReader:
    """Opens a dataset that `lidarpose synth` or `prepare` wrote. Raises InputError if the folder is not a dataset,
    MissingExtra without pyarrow."""
    pyarrow()
    return DatasetReader(folder=Path(folder), card=read_card(folder))
