"""Columns of the tables in a dataset's shards, and how they go into Arrow and out of it.

A column's type is that of a value, or of the values of a list (in brackets). Lists are flattened arrays; where a table
says so, a list or a value may be null.
"""

from collections.abc import Iterator
from dataclasses import fields
from typing import Any

import numpy as np

from lidarpose.errors import MissingExtra
from lidarpose.sample import PersonInfo

Kind = str | list[str]

# a field more is a column more, which older shards have not
FACTS = {info.name: {str: "string", float: "float32", bool: "bool"}[info.type] for info in fields(PersonInfo)}

_PEOPLE: dict[str, Kind] = {
    "index": "int64",
    "frame": "int32",
    "track": "int32",
    "points": ["float32"],
    "part": ["uint8"],
    "ring": ["int32"],
    "joints": ["float32"],
    "center": ["float64"],
    "box_center": ["float64"],
    "box_size": ["float64"],
    "box_yaw": "float64",
    "source": "string",
    "frame_id": "string",
    **FACTS,
}
_FRAMES: dict[str, Kind] = {
    "index": "int64",
    "frame": "int32",
    "sensor": "string",
    "points": ["float32"],
    "ring": ["int32"],
    "person": ["int16"],
    "part": ["uint8"],
    "track": ["int16"],
    "box": ["float64"],
    "joints": ["float32"],
}
# origins that published protocols use, by name: a column center_NAME each
CENTERS = ("trans", "box", "joints_box")
_LABELLED: dict[str, Kind] = {
    "index": "int64",
    "sequence": "string",
    "frame": "int64",
    "track": "string",
    "time": "float64",
    "split": "string",
    "points": ["float32"],
    "part": ["uint8"],
    "ring": ["int32"],
    "joints": ["float32"],
    "joint_labels": ["uint8"],
    "center": ["float64"],
    **{f"center_{name}": ["float64"] for name in CENTERS},
    "box_center": ["float64"],
    "box_size": ["float64"],
    "box_yaw": "float64",
    "distance": "float32",
    "source": "string",
    "frame_id": "string",
}
_SKIPPED: dict[str, Kind] = {"index": "int64", "reason": "string", "where": "string"}

TABLES = {"people": _PEOPLE, "frames": _FRAMES, "labelled": _LABELLED, "skipped": _SKIPPED}


def pyarrow():
    """pyarrow and pyarrow.parquet. Raises MissingExtra without them."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise MissingExtra("reading and writing Parquet", "synth") from None
    return pyarrow, pyarrow.parquet


def schema_of(pa, table: str):
    """The Arrow schema of a table."""
    return pa.schema([(name, _type(pa, kind)) for name, kind in TABLES[table].items()])


def arrays_of(pa, table: str, rows: list[dict[str, Any]]) -> list:
    """A table's columns of some rows, as Arrow arrays."""
    return [_column(pa, [row[name] for row in rows], kind) for name, kind in TABLES[table].items()]


def rows_of(batch, table: str) -> Iterator[dict[str, Any]]:
    """The rows of a record batch, lists as numpy arrays; None where a value is null or its column is missing."""
    columns: dict[str, Any] = {}
    for name, kind in TABLES[table].items():
        if name not in batch.schema.names:
            columns[name] = [None] * batch.num_rows
            continue
        column = batch.column(batch.schema.get_field_index(name))
        if isinstance(kind, str):
            columns[name] = column.to_pylist()
        else:
            flat = column.flatten().to_numpy(zero_copy_only=False).astype(kind[0], copy=False)
            ends = np.asarray(column.offsets) - column.offsets[0].as_py()
            there = column.is_valid().to_pylist()
            columns[name] = [flat[a:b] if ok else None for a, b, ok in zip(ends[:-1], ends[1:], there, strict=True)]
    for k in range(batch.num_rows):
        yield {name: values[k] for name, values in columns.items()}


def _column(pa, values: list, kind: Kind):
    if kind == "string":
        # names from a disk or from JSON may hold what is no character
        values = [value if value is None else value.encode("utf-8", "backslashreplace").decode() for value in values]
    if isinstance(kind, str):
        return pa.array(values, _type(pa, kind))
    null = [value is None for value in values]
    flat = [np.zeros(0, kind[0]) if v is None else np.asarray(v, kind[0]).ravel() for v in values]
    offsets = np.zeros(len(flat) + 1, np.int32)
    np.cumsum([len(v) for v in flat], out=offsets[1:])
    joined = np.concatenate(flat) if flat else np.zeros(0, kind[0])
    mask = pa.array(null) if any(null) else None
    return pa.ListArray.from_arrays(pa.array(offsets), pa.array(joined), mask=mask)


def _type(pa, kind: Kind):
    if isinstance(kind, list):
        return pa.list_(_type(pa, kind[0]))
    return pa.bool_() if kind == "bool" else getattr(pa, kind)()
