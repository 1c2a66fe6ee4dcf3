"""Checks that the readers of point files share, made before a library decodes or allocates anything."""

import re

# characters of a file or of a library's message that an error shows
_MAX_SHOWN = 80
# a table of so few rows and so many columns holds points as columns
FEW_ROWS, _MANY_COLUMNS = 5, 50


class Problem(Exception):
    """What is wrong with a file and what to do, without the file's name, which `read_points` adds."""


def shorten(text: str, limit: int = _MAX_SHOWN) -> str:
    """The text on one line of at most `limit` characters."""
    text = " ".join(text.split())
    return text if len(text) <= limit else text[: limit - 3] + "..."


def pick_xyz(names) -> list[int]:
    """The positions of x, y and z among column names, in any case."""
    low = [name.strip().lower() for name in names]
    if not {"x", "y", "z"} <= set(low):
        came = shorten(" ".join(names)) or "none"
        raise Problem(f"expected columns x, y and z, got {came}: export or rename x, y, z")
    return [low.index(axis) for axis in "xyz"]


def numbered(columns: int) -> tuple[str, ...]:
    """The names of columns that have none."""
    return ("x", "y", "z", *(f"column_{i}" for i in range(4, columns + 1)))


def is_transposed(shape: tuple[int, ...]) -> bool:
    """Whether an array of this shape (rows, columns) holds points as columns: no format has so many values a point."""
    return len(shape) == 2 and 3 <= shape[0] <= FEW_ROWS and shape[1] > _MANY_COLUMNS


def parse_count(text: str, what: str) -> int:
    """A number of a header, at most 18 digits."""
    if not re.fullmatch(r"[0-9]{1,18}", text):
        raise Problem(f"expected a whole number as the header's {what}, got {shorten(text)!r}: export it again")
    return int(text)


def need_bytes(data: bytes, start: int, size: int, count: int) -> None:
    """Refuses a file in which fewer than `size` bytes follow `start`."""
    if len(data) - start < size:
        came = max(len(data) - start, 0)
        raise Problem(f"is cut off: expected {size} bytes for {count} points, got {came}; copy it again")
