"""Rows of Waymo v2's Parquet files, with little memory: of range images one row at a time.

Columns are picked by name and rows by key, so that their order, their row groups, the width of numbers, and further
columns such as pandas' `index` do not matter.
"""

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose.data.readers.waymo_frames import LASERS, is_image
from lidarpose.data.schema import pyarrow
from lidarpose.errors import InputError
from lidarpose.io.files import file_error

SEGMENT, TIME, LASER, OBJECT = (
    f"key.{name}" for name in ("segment_context_name", "frame_timestamp_micros", "laser_name", "laser_object_id")
)
# segment and timestamp; and the laser
FrameKey = tuple[str, int]
LaserKey = tuple[str, int, int]
# what is read of a file at once: its column chunks are larger than a machine's memory should have to hold
_BUFFER = 1 << 20


def count_rows(path: Path) -> int | None:
    """How many rows a file says it has; None where it is damaged."""
    try:
        with _opened(path) as file:
            return file.metadata.num_rows
    except InputError:
        return None


def table(path: Path, columns: tuple[str, ...], optional: tuple[str, ...] = ()) -> list[dict[str, Any]]:
    """All rows of a small file; None where an optional column is missing or a value null. Raises InputError."""
    with _opened(path) as file:
        there = [name for name in (*columns, *optional) if name in file.schema_arrow.names]
        _check(path, columns, there)
        found = file.read(columns=there, use_threads=False).to_pydict()
        if LASER in found:
            found[LASER] = [_laser(path, name) for name in found[LASER]]
        empty = dict.fromkeys(optional)
        return [empty | dict(zip(found, row, strict=True)) for row in zip(*found.values(), strict=True)]


def laser_keys(path: Path, wanted: Collection[FrameKey]) -> set[LaserKey]:
    """The keys of a file of range images that are of wanted frames. Raises InputError."""
    with _opened(path) as file:
        groups = range(file.num_row_groups)
        return {key for group in groups for key in _keys(path, file, group) if key[:2] in wanted}


def images(
    path: Path, columns: tuple[str, ...], wanted: Collection[FrameKey]
) -> Iterator[tuple[LaserKey, list[np.ndarray | None]]]:
    """Range images (H, W, C) float32 of wanted frames, row by row in the file's order, one a column.

    columns: what `.values` and `.shape` follow. An image is None where there is none, and empty where its values do not
    fit its shape. Raises InputError for a damaged file and missing columns.
    """
    names = tuple(f"{column}.{part}" for column in columns for part in ("values", "shape"))
    with _opened(path) as file:
        _check(path, names, file.schema_arrow.names)
        for group in range(file.num_row_groups):
            keys = _keys(path, file, group)
            rows = [k for k, key in enumerate(keys) if key[:2] in wanted]
            if not rows:
                continue
            first = 0
            for batch in file.iter_batches(batch_size=1, row_groups=[group], columns=names, use_threads=False):
                for k in range(batch.num_rows):
                    if keys[first + k][:2] in wanted:
                        cells = [batch.column(name)[k] for name in names]
                        yield keys[first + k], [_image(*pair) for pair in zip(cells[::2], cells[1::2], strict=True)]
                first += batch.num_rows
                if first > rows[-1]:
                    break


def _image(values, shape) -> np.ndarray | None:
    if not values.is_valid or not shape.is_valid:
        return None
    flat = values.values.to_numpy(zero_copy_only=False).astype(np.float32, copy=False)
    size = shape.as_py()
    if not is_image(size, len(flat)):
        return np.zeros((0, 0, 0), np.float32)
    return flat.reshape(size)


def _keys(path: Path, file, group: int) -> list[LaserKey]:
    _check(path, (SEGMENT, TIME, LASER), file.schema_arrow.names)
    found = file.read_row_group(group, columns=[SEGMENT, TIME, LASER], use_threads=False).to_pydict()
    lasers = [_laser(path, name) for name in found[LASER]]
    return list(zip(found[SEGMENT], found[TIME], lasers, strict=True))


def _laser(path: Path, name: int | str) -> int:
    """A laser's number, from its number or its name."""
    if isinstance(name, str) and not name.isdecimal():
        if name not in LASERS:
            raise file_error(path, f"names the laser {name!r}; known are {', '.join(LASERS)}")
        return LASERS[name]
    return int(name)


def _check(path: Path, needed: tuple[str, ...], there: Collection[str]) -> None:
    missing = [name for name in needed if name not in there]
    if missing:
        raise file_error(path, f"has no column {missing[0]}: is it of this component of Waymo v2.0?")


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """An open file. Whatever goes wrong with it in the block is an InputError."""
    pa, parquet = pyarrow()
    try:
        with parquet.ParquetFile(path, buffer_size=_BUFFER, pre_buffer=False) as file:
            yield file
    except InputError:
        raise
    except FileNotFoundError:
        raise file_error(path, "is missing") from None
    except (pa.ArrowException, OSError, ValueError, TypeError, AttributeError, KeyError, MemoryError) as error:
        raise file_error(path, f"cannot be read as Parquet ({error}); fetch it again") from None
