"""What every reader of a dataset yields and offers, and what readers of raw files share.

A dataset's raw files fall into parts, each read on its own (a sequence, a segment, a file): that is what processes
share out, and what is written as one shard. What is known of each dataset is in data/datasets.json.
"""

import json
import os
import re
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from lidarpose.errors import InputError
from lidarpose.io.files import file_error, read_bytes
from lidarpose.io.point_cloud import read_points
from lidarpose.sample import LabeledSample, within_reach

_NUMBER = re.compile("[0-9]{1,12}")


@dataclass(frozen=True)
class Skipped:
    """What was left out: reason, the same words for the same reason, and where."""

    reason: str
    where: str


class Reader(ABC):
    """Reads a dataset's raw files. about: what is recorded with a prepared dataset: the frame of its points, its
    licence, its quirks, and the `settings` that decide its content."""

    name: ClassVar[str]
    skeleton: ClassVar[str]

    def __init__(self, **settings: Any):
        known = _datasets()[self.name]
        self.about: dict[str, Any] = {
            key: known[key] for key in ("frame", "sensor_known", "licence", "get", "notes") if key in known
        }
        self.about["settings"] = settings

    @abstractmethod
    def parts(self, root: Path) -> list[str]:
        """Names of what can be read on its own, sorted. Raises InputError, one line, where the root is incomplete."""

    @abstractmethod
    def read(self, root: Path, part: str) -> Iterator[LabeledSample | Skipped]:
        """Everybody in one part, in an order that never changes."""

    def wrong_root(self, root: Path, got: str = "") -> InputError:
        """The error for a folder that is not the dataset's root. got: by default what is in the folder."""
        known = _datasets()[self.name]
        there = got or f"got {entries(root)}"
        problem = (
            f"is not the root of {known['title']}: expected {known['expected']}, {there}; get it at {known['get']}"
        )
        return file_error(root, problem)


@cache
def _datasets() -> dict[str, dict[str, Any]]:
    return json.loads((files("lidarpose.data") / "datasets.json").read_text("utf-8"))


def entries(folder: Path) -> str:
    """The first names in a folder, for messages."""
    return ", ".join(sorted(path.name for path in folder.iterdir())[:6]) or "nothing"


def numbered(folder: Path, suffix: str) -> dict[int, list[Path]]:
    """The files of a folder that are numbered, whatever the number of digits: number -> its files, in order."""
    found: dict[int, list[Path]] = {}
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if path.suffix.lower() == suffix and _NUMBER.fullmatch(path.stem):
            found.setdefault(int(path.stem), []).append(path)
    return dict(sorted(found.items()))


def read_json(path: Path, expected: str) -> dict:
    """A JSON file that holds an object. Raises InputError where it does not."""
    data = read_bytes(path, expected=expected)
    try:
        content = json.loads(data.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise file_error(path, f"is not JSON ({error}); was it copied completely?") from None
    if not isinstance(content, dict):
        raise file_error(path, f"expected {expected}, got {type(content).__name__}")
    return content


def numbers(path: object, value: object, shape: tuple[int, ...], what: str, *, finite: bool = True) -> np.ndarray:
    """The value as float64 of a shape, -1 for any length; a flat list will do. Raises InputError otherwise.

    finite: refuse NaN and infinity. path and what: for the message.
    """
    if value is None:
        raise file_error(path, f"{what} is missing; expected numbers {shape}")
    try:
        array = np.asarray(value, float)
        array = array if array.ndim == len(shape) else array.reshape(shape)
    except (TypeError, ValueError, OverflowError):
        raise file_error(path, f"{what} must be numbers {shape}, got other things or rows of unequal length") from None
    if any(n not in (-1, m) for n, m in zip(shape, array.shape, strict=True)):
        raise file_error(path, f"{what} must be {shape}, got {array.shape}")
    if finite and not np.isfinite(array).all():
        raise file_error(path, f"{what} has values that are no numbers")
    return array


def read_cloud(path: Path) -> np.ndarray:
    """x y z (n, 3) float64 of a file, without points out of reach; n = 0 where it says itself that it holds none.
    Raises InputError."""
    try:
        points = read_points(path).points
        return points[within_reach(points)]
    except InputError:
        # written for a person who was not seen; a file that is cut off says more points than it has
        if _says_empty(path):
            return np.zeros((0, 3))
        raise


def as_cloud(path: object, value: object) -> np.ndarray:
    """x y z (n, 3) float64 of an array or a flat list, without points out of reach or that are no numbers. Raises
    InputError, since rows of another length would be read shifted. path: for the message."""
    if isinstance(value, np.ndarray) and value.ndim > 2:
        raise file_error(path, f"a cloud must be (n, 3), got {value.shape}")
    points = numbers(path, value, (-1, 3), "a cloud", finite=False)
    return points[within_reach(points)]


def find_below(root: Path, path: str) -> Path | None:
    """The cloud that a path of another machine means: the longest end of it that is in the root."""
    names = [name for name in re.split(r"[/\\]", path) if name not in ("", ".", "..")]
    for k in range(len(names)):
        # False, too, for a name that no disk can hold
        if os.path.isfile(root / Path(*names[k:])):
            return root / Path(*names[k:])
    return None


def _says_empty(path: Path) -> bool:
    with suppress(OSError):
        # a pipe would be waited for
        if os.path.isfile(path):
            with open(path, "rb") as file:
                return re.search(rb"^(element vertex|POINTS) +0\s*$", file.read(4096), re.MULTILINE) is not None
    return False
