"""Writes the lines of a recording to NAME.poses.jsonl, .csv or .parquet, completely or not at all."""

import json
import os
from collections.abc import Iterable, Iterator
from itertools import chain, islice
from pathlib import Path
from typing import Any

from lidarpose.errors import needs_extra
from lidarpose.inference.results import csv_quoting
from lidarpose.io.atomic import atomic_path
from lidarpose.io.files import encodable
from lidarpose.sample import JOINT_COLUMNS

FORMATS = ("jsonl", "csv", "parquet")
# number of frames whose rows are written at a time
_ROWS_OF = 200
_VELOCITY = ("velocity_x", "velocity_y", "velocity_z")
_COLUMNS = ("frame", "frame_id", "time", "person", "id", "track", "filled", *JOINT_COLUMNS, "coordinates", *_VELOCITY)
_TEXT_COLUMNS = ("id", "frame_id", "joint", "coordinates")


def write_result(path: Path, lines: Iterable[dict[str, Any]]) -> None:
    """Writes lines in the format given by the file's suffix, one of `FORMATS`, completely or not at all.

    Raises InputError if the file cannot be written, MissingExtra for Parquet without pyarrow.
    """
    suffix = path.suffix.lower()
    with atomic_path(path) as temporary:
        if suffix == ".jsonl":
            with open(temporary, "w", encoding="utf-8") as file:
                file.writelines(json.dumps(line) + "\n" for line in lines)
        elif suffix == ".csv":
            for number, table in enumerate(_tables(lines)):
                mode, quoting = "a" if number else "w", csv_quoting((*table["id"], *table["frame_id"]))
                table.to_csv(temporary, index=False, mode=mode, header=not number, quoting=quoting)
        else:
            _write_parquet(temporary, lines)


def check_format(path: Path) -> None:
    """Raises MissingExtra if the format cannot be written; called before any work is done."""
    if path.suffix.lower() == ".parquet":
        with needs_extra("writing Parquet", "synth"):
            import pyarrow.parquet  # noqa: F401


def _write_parquet(path: Path, lines: Iterable[dict[str, Any]]) -> None:
    import pyarrow
    import pyarrow.parquet

    tables = (pyarrow.Table.from_pandas(table, preserve_index=False) for table in _tables(lines))
    first_table = next(tables)
    with (
        pyarrow.OSFile(os.fsencode(path), "wb") as file,
        pyarrow.parquet.ParquetWriter(file, first_table.schema) as writer,
    ):
        for table in chain([first_table], tables):
            writer.write_table(table)


def _tables(lines: Iterable[dict[str, Any]]) -> Iterator[Any]:
    """Yields tables with one row per frame, person and joint, each for some frames, all with the same column types; at
    least one table, which may be empty."""
    import pandas

    remaining = iter(lines)
    chunk, is_first = list(islice(remaining, _ROWS_OF)), True
    while chunk or is_first:
        table = pandas.DataFrame([row for line in chunk for row in _rows(line)], columns=list(_COLUMNS))
        for name in _TEXT_COLUMNS:
            table[name] = table[name].astype("string")
        types = {"frame": "int64", "person": "int64", "track": "Int64", "filled": "bool"}
        types |= {"in_range": "boolean", "mounted": "boolean"}
        float_columns = set(_COLUMNS) - set(types) - set(_TEXT_COLUMNS)
        yield table.astype(types | dict.fromkeys(float_columns, "float64"))
        chunk, is_first = list(islice(remaining, _ROWS_OF)), False


def _rows(line: dict[str, Any]) -> Iterator[tuple]:
    joints, frame_id = line["skeleton"]["joints"], encodable(line["id"])
    for number, person in enumerate(line["people"]):
        if person["joints"] is None:
            continue
        id = None if person["id"] is None else encodable(str(person["id"]))
        person_cells = (number, id, person["track"], person["filled"])
        joint_values = [person[name] or [None] * len(joints) for name in ("confidence", "spread", "visible")]
        # a network without per-joint outputs has no in_range either
        is_known = any(person[name] for name in ("confidence", "spread", "visible"))
        person_values = (
            person["person"],
            person["second_person"],
            person["score"],
            person["mounted"],
            line.get("coordinates", "sensor"),
            *(person.get("velocity") or [None] * 3),
        )
        for j, name in enumerate(joints):
            in_range = name not in person["out_of_range"] if is_known else None
            values = (*(value[j] for value in joint_values), in_range, *person_values)
            yield line["frame"], frame_id, line["time"], *person_cells, name, *person["joints"][j], *values
