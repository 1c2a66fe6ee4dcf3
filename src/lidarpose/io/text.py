"""Text formats: finds the columns x, y and z, and reads text files with pandas and the bodies of ascii PCD and PLY."""

import csv
import io
import itertools
import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from lidarpose.io.files import FormatError, shorten
from lidarpose.io.point_times import time_column
from lidarpose.sample import JOINT_COLUMNS

# a table of at most this many rows and more than this many columns has a point per column
FEW_ROWS, _MANY_COLUMNS = 5, 50
# a first column that counts at least this many rows is a row number, not x
_FEWEST_COUNTED = 20
# how the usual exports write a missing value, in lower or upper case
_MISSING = ("", "na", "n/a", "nan", "-nan", "+nan", "null", "none", "<na>")
# how Microsoft's libraries begin NaN and infinity, after the sign
_MICROSOFT = ("nan(", "NaN(", "NAN(", "1.#")
# .pts and other formats begin with the number of points; CloudCompare also writes it after the header
_COUNT = r"""(?x) \A ([ \t]* (?: // | \# )? [ \t]* "? [A-Za-z] [^\n]* \n)? [0-9]{1,18} [ \t]* \n
    (?= [ \t]* (?: // | [-+.\d] \S* (?: [ \t,;]+ [-+.\d] \S* ){2} ))"""


def pick_xyz(names: Sequence[str]) -> list[int]:
    """The positions of x, y and z among column names, in lower or upper case, with or without a unit."""
    plain_names = _plain(names)
    if not has_xyz(names):
        actual = shorten(" ".join(names)) or "none"
        raise FormatError("columns x, y and z", actual, "export or rename x, y, z")
    return [plain_names.index(axis) for axis in "xyz"]


# selects columns by their names
PickColumns = Callable[[Sequence[str]], list[int]]


def pick_xyz_and_time(names: Sequence[str]) -> list[int]:
    """The positions of x, y and z among column names, and that of the points' times if there is one."""
    time = time_column(names)
    return pick_xyz(names) + ([] if time is None else [time])


def has_xyz(names: Sequence[str]) -> bool:
    """Whether x, y and z are among column names."""
    return {"x", "y", "z"} <= set(_plain(names))


def _plain(names: Sequence[str]) -> list[str]:
    """Column names in lower case, without units ("x [m]"); the axis names of ParaView and VeloView, and those of the
    first return of Ouster's SDK, as x, y and z."""
    plain_names = []
    for name in names:
        name = re.sub(r" ?[\[(]m[\])]$", "", name.strip().lower())
        axis = re.fullmatch(r"points(?:_m_xyz)?:([0-2])", name)
        plain_names.append("xyz"[int(axis[1])] if axis else name)
    if "x" not in plain_names and {"x1", "y1", "z1"} <= set(plain_names):
        plain_names = [name.removesuffix("1") if name in ("x1", "y1", "z1") else name for name in plain_names]
    return plain_names


def numbered(columns: int) -> tuple[str, ...]:
    """Default names for unnamed columns."""
    return ("x", "y", "z", *(f"column_{i}" for i in range(4, columns + 1)))


def is_transposed(shape: tuple[int, ...]) -> bool:
    """Whether an array of this shape (rows, columns) has a point per column: no format has that many values per
    point."""
    return len(shape) == 2 and 3 <= shape[0] <= FEW_ROWS and shape[1] > _MANY_COLUMNS


def is_image(shape: tuple[int, ...]) -> bool:
    """Whether an array of this shape (rows, columns) may be a depth image: it is too wide for points."""
    return len(shape) == 2 and shape[0] > FEW_ROWS and shape[1] > _MANY_COLUMNS


def parse_count(text: str, what: str) -> int:
    """A whole number in a header, of at most 18 digits."""
    if not re.fullmatch(r"[0-9]{1,18}", text):
        raise FormatError(f"a whole number as the header's {what}", f"{shorten(text)!r}", "export it again")
    return int(text)


def check_bytes(data: bytes, start: int, size: int, num_points: int) -> None:
    """Raises FormatError if fewer than `size` bytes follow `start`."""
    if len(data) - start < size:
        num_bytes = max(len(data) - start, 0)
        raise FormatError(f"is cut off: expected {size} bytes for {num_points} points, got {num_bytes}; copy it again")


def parse_rows(text: str, num_rows: int, columns: list[int], num_cells: int, *, skip: int = 0) -> np.ndarray:
    """The c given columns, (n, c), of `num_rows` lines with `num_cells` numbers each, after `skip` other lines.

    Blank lines do not count. Raises FormatError if there are fewer lines, and for the first line that does not fit.
    """
    lines = (" ".join(line.split()) for line in io.StringIO(_with_plain_nan(text)))
    rows = list(itertools.islice(filter(None, lines), skip, skip + num_rows))
    if len(rows) < num_rows:
        raise FormatError(f"is cut off: expected {num_rows} points, got {len(rows)}; copy or export it again")
    for number, row in enumerate(rows, 1):
        if row.count(" ") + 1 != num_cells:
            actual = f"{row.count(' ') + 1} in {shorten(row)!r} on line {number} of the points"
            raise FormatError(f"{num_cells} values per row, as the header says", actual, "export it again")
    try:
        return np.loadtxt(rows, np.float64, comments=None, usecols=columns, ndmin=2)
    except ValueError as error:
        raise _wrong_line(rows, columns, error, where=" of the points") from None


def parse_text(data: bytes, pick: PickColumns = pick_xyz) -> tuple[np.ndarray, tuple[str, ...]]:
    """The picked columns (n, c) and the column names; raises FormatError."""
    text = re.sub(_COUNT, r"\1\n", _with_plain_nan(decode(data)))
    names, num_skipped, has_header, separator, decimal = _find_columns(text)
    # comments, but not in quotes; lines with only a comment would count as rows without values; the lookbehind keeps
    # the regular expression from starting at every blank of a long run
    text = re.sub(r"(?m)^[ \t]+$", "", re.sub(r'("[^"\n]*")|(?<![ \t])[ \t]*#.*', r"\1", text))
    parts = text.split("\n", num_skipped)
    # pandas supports only double quotes, so single quotes around cells are removed, but not those within a cell
    body = re.sub(r"(?<![^,;\s])'|'(?![^,;\s])", "", parts[num_skipped]) if len(parts) > num_skipped else ""
    # finds decimal commas that the first line does not show: 1e-05 there and 0,5 on a later line
    if separator != "," and "," in body:
        # blanks allowed within a cell, except those that could be a separator: a long run would be matched in many ways
        edge, blanks = separator or r"[ \t]", {None: "", "\t": " *"}.get(separator, r"[ \t]*")
        if re.search(rf"(?m)(?:^|{edge}){blanks}[-+]?\d*,\d+(?:[eE][-+]?\d+)?{blanks}(?:{edge}|$)", body):
            decimal = ","
    if has_header:
        _check_width(body, names, separator, num_skipped)
    style: dict[str, Any] = {"separator": separator, "decimal": decimal, "num_skipped": num_skipped}
    points = _read_csv(body, pick(names), **style)
    if names == numbered(len(names)) and len(names) > 3 and _is_counter(points[:, 0]):
        names = ("row", *numbered(len(names) - 1))
        points = _read_csv(body, pick(names), **style)
    if not has_header and is_transposed((len(points), len(names))):
        actual = f"{len(points)} lines of {len(names)} values"
        raise FormatError("a line of x y z for each point", actual, "save its transpose")
    return points, tuple(names)


def _with_plain_nan(text: str) -> str:
    """The text with the forms of NaN and infinity that Microsoft's libraries write, -nan(ind) and 1.#QNAN, as nan."""
    # a search for plain words is ten times faster
    if not any(word in text for word in _MICROSOFT):
        return text
    return re.sub(r"[-+]?(?:nan\(\w*\)|1\.#(?:QNAN|SNAN|IND|INF)\w*)", "nan", text, flags=re.I)


def _find_columns(text: str) -> tuple[Sequence[str], int, bool, str | None, str]:
    """(names of the columns, lines before the first row, whether a header names them, separator, decimal mark)."""
    num_skipped, comment, lines = 0, "", io.StringIO(text)
    for line in lines:
        first_line = line.split("#")[0].strip()
        if first_line:
            break
        comment = line.lstrip("# \t").strip() or comment
        num_skipped += 1
    else:
        raise FormatError("has no points; expected lines of x y z: was it saved completely?")
    separator, decimal = _separator(first_line)
    # CloudCompare starts its header with slashes
    cells = _split(first_line.removeprefix("//").strip(), separator)
    where = f"on line {num_skipped + 1}, {shorten(first_line)!r}"
    if names := _pandas_names(cells, next(lines, ""), separator):
        return names, num_skipped + 1, True, separator, decimal
    if not all(_is_number(cell, decimal) for cell in cells):
        if set(JOINT_COLUMNS) <= set(cells):
            raise FormatError("points", "a table of joints, as lidarpose predict writes it", "give the file of points")
        if not has_xyz(cells):
            raise FormatError("numbers, or a header with x, y and z", f"neither {where}", "export or rename x, y, z")
        return cells, num_skipped + 1, True, separator, decimal
    if len(cells) < 3:
        raise FormatError("at least 3 columns x y z", f"{len(cells)} {where}", "export x, y and z")
    # a comment above the rows is their header if it has as many words, among them x, y and z, as numpy.savetxt writes
    for mark in (None, ",", ";"):
        words = _split(comment, mark)
        if len(words) == len(cells) and has_xyz(words):
            return words, num_skipped, False, separator, decimal
        if mark and len(words) == len(cells) > 3 and not any(_is_number(word, decimal) for word in words):
            # names of other columns: the first three need not be x, y and z
            pick_xyz(words)
    return numbered(len(cells)), num_skipped, False, separator, decimal


def _pandas_names(cells: list[str], next_line: str, separator: str | None) -> tuple[str, ...]:
    """Names of the columns if the first line is a header as pandas writes it for an array: 0,1,2, after an empty cell
    if the rows have numbers; else none. Without the empty cell it may be the point 0, 1, 2: it is a header if the next
    line has decimals."""
    has_row_numbers = not cells[0]
    numbers = cells[1:] if has_row_numbers else cells
    has_decimals = re.search(r"\d\.\d" if separator == "," else r"\d[.,]\d", next_line)
    if len(numbers) < 3 or numbers != [str(i) for i in range(len(numbers))] or not (has_row_numbers or has_decimals):
        return ()
    return ("row",) * has_row_numbers + numbered(len(numbers))


def _is_counter(column: np.ndarray) -> bool:
    """Whether a column without a name counts the rows, from 0 or 1."""
    count = len(column)
    return count >= _FEWEST_COUNTED and column[0] in (0, 1) and np.array_equal(column, column[0] + np.arange(count))


def _check_width(body: str, names: Sequence[str], separator: str | None, num_skipped: int) -> None:
    """Raises FormatError if the first row has more cells than the header has names: any of them could be x then."""
    for number, line in enumerate(io.StringIO(body), num_skipped + 1):
        if line.strip():
            cells = _split(line.strip(), separator)
            if any(cells[len(names) :]):
                raise FormatError(
                    f"{len(names)} values per row, as its header says",
                    f"{len(cells)} on line {number}, {shorten(line)!r}",
                    "name every column, also row numbers, or omit them",
                )
            return


def decode(data: bytes) -> str:
    """Decodes UTF-8 text and converts its line endings to \\n; raises FormatError."""
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise FormatError("text in UTF-8", "UTF-16", "save it as UTF-8")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FormatError("text in UTF-8", f"an invalid byte at {error.start}", "save it as UTF-8") from None
    if "\x00" in text:
        raise FormatError("text", "zero bytes", "is it another format?")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _wrong_line(
    lines: list[str],
    columns: list[int],
    reason: object,
    *,
    separator: str | None = None,
    decimal: str = ".",
    num_skipped: int = 0,
    where: str = "",
) -> FormatError:
    """The error for lines that a library rejected: names the first line without numbers in `columns`, else its
    reason."""
    for number, line in enumerate(lines, num_skipped + 1):
        cells = _split(line.strip(), separator)
        if line.strip() and not all(i < len(cells) and _is_number(cells[i], decimal) for i in columns):
            actual = f"{shorten(line)!r} on line {number}{where}"
            return FormatError("numbers for x, y and z", actual, "correct that line")
    return FormatError(f"expected rows of numbers ({shorten(str(reason))}): export it again")


def _read_csv(text: str, columns: list[int], *, separator: str | None, decimal: str, num_skipped: int) -> np.ndarray:
    """The c given columns as (n, c) float64; missing values are NaN. Separator None means any run of blanks."""
    import pandas as pd

    style: dict[str, Any] = {"separator": separator, "decimal": decimal}
    try:
        frame = pd.read_csv(
            io.StringIO(text),
            header=None,
            sep=separator or r"\s+",
            usecols=sorted(columns),
            dtype=np.float64,
            skipinitialspace=True,
            decimal=decimal,
            # pandas recognizes only some of them, and is case-sensitive
            na_values=[case(word) for case in (str.lower, str.upper, str.capitalize) for word in _MISSING],
            engine="c",
        )
    except pd.errors.EmptyDataError:
        return np.empty((0, len(columns)))
    except ValueError as error:
        raise _wrong_line(text.splitlines(), columns, error, num_skipped=num_skipped, **style) from None
    if '"' in text and len(frame) < sum(1 for line in io.StringIO(text) if line.strip()):
        raise FormatError("a point per line", "a quoted cell over several lines", "remove the quote without a partner")
    return frame[columns].to_numpy(np.float64)


def _split(line: str, separator: str | None) -> list[str]:
    cells = line.split(separator)
    if '"' in line:
        # a separator in quotes does not separate cells
        line = " ".join(cells) if separator is None else line
        cells = next(csv.reader([line], delimiter=separator or " ", skipinitialspace=True))
    return [cell.strip().strip("\"'").strip() for cell in cells]


def _separator(line: str) -> tuple[str | None, str]:
    """(separator of the cells in a line, None for blanks; decimal mark)."""
    if ";" in line:
        return ";", "," if "," in line else "."
    # in 1,5 2,5 3,5 the commas are decimal marks, in 1, 2, 3 they are separators
    words = line.split()
    if "," in line and len(words) >= 3 and all(re.fullmatch(r"[-+]?\d+(,\d+)?([eE][-+]?\d+)?", w) for w in words):
        return None, ","
    if "," in line:
        return ",", "."
    return ("\t" if line.count("\t") >= 2 else None), "."


def _is_number(cell: str, decimal: str) -> bool:
    if cell.lower() in _MISSING:
        return True
    try:
        float(cell.replace(decimal, "."))
    except ValueError:
        return False
    return "_" not in cell
