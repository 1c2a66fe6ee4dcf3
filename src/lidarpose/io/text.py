"""Points in text: files of lines decoded by pandas, and the lines of ascii PCD and PLY bodies."""

import csv
import io
import itertools
import re

import numpy as np

from lidarpose.io.headers import Problem, is_transposed, numbered, pick_xyz, shorten

# what stands in text for a value that is not there, in the usual exports, in any case
_MISSING = ("", "na", "n/a", "nan", "-nan", "+nan", "null", "none", "<na>")


def parse_text(data: bytes) -> tuple[np.ndarray, tuple[str, ...], tuple[str, ...]]:
    """x y z (n, 3), the names of the columns, and no warnings; raises Problem."""
    text = decode(data)
    skip, comment, first = 0, "", ""
    lines = io.StringIO(text)
    for line in lines:
        first = line.split("#")[0].strip()
        if first:
            break
        comment = line.lstrip("# \t").strip() or comment
        skip += 1
    else:
        raise Problem("has no points; expected lines of x y z: was it saved completely?")

    separator, decimal = _separator(first)
    # CloudCompare marks its header by slashes
    names = _split(first.removeprefix("//").strip(), separator)
    has_header = not all(_is_number(cell, decimal) for cell in names)
    if has_header:
        if not {"x", "y", "z"} <= {name.lower() for name in names}:
            raise Problem(
                f"expected numbers, or a header with x, y and z, on line {skip + 1}, got {shorten(first)!r}: "
                "export or rename x, y, z"
            )
    elif len(names) < 3:
        came = f"{len(names)} on line {skip + 1}, {shorten(first)!r}"
        raise Problem(f"expected at least 3 columns x y z, got {came}: export x, y and z")
    else:
        names = _names_above(comment, len(names))
    # lines that are blank but for a comment would count as rows without values; what is looked for behind keeps every
    # blank of a long run from being tried as the first
    text = re.sub(r"(?m)^[ \t]+$", "", re.sub(r"(?<![ \t])[ \t]*#.*", "", text))
    num_skipped = skip + has_header
    parts = text.split("\n", num_skipped)
    # pandas knows double quotes alone; within a number a quote is something else
    body = re.sub(r"(?<![^,;\s])'|'(?![^,;\s])", "", parts[num_skipped]) if len(parts) > num_skipped else ""
    # 1e-05 on the first line and 0,5 on a later one
    if separator != "," and "," in body:
        # blanks in a cell, none that could be its edge: in a long run of them each could be either
        edge, blanks = separator or r"[ \t]", {None: "", "\t": " *"}.get(separator, r"[ \t]*")
        if re.search(rf"(?m)(?:^|{edge}){blanks}[-+]?\d*,\d+(?:[eE][-+]?\d+)?{blanks}(?:{edge}|$)", body):
            decimal = ","
    if has_header:
        _check_width(body, names, separator, num_skipped)
    points = _parse_rows(body, pick_xyz(names), separator=separator, decimal=decimal, num_skipped=num_skipped)
    if not has_header and is_transposed((len(points), len(names))):
        raise Problem(f"expected a line of x y z for each point, got {len(points)} of {len(names)}: save its transpose")
    return points, tuple(names), ()


def _check_width(body: str, names: list[str], separator: str | None, num_skipped: int) -> None:
    """Raises Problem where the first row has more cells than the header names: which column is x nobody knows then."""
    for number, line in enumerate(io.StringIO(body), num_skipped + 1):
        if line.strip():
            cells = _split(line.strip(), separator)
            if any(cells[len(names) :]):
                raise Problem(
                    f"expected {len(names)} values a row, as its header names, got {len(cells)} on line {number}, "
                    f"{shorten(line)!r}: name every column, row numbers too, or leave them away"
                )
            return


def decode(data: bytes) -> str:
    """UTF-8 text whose lines end in \\n; raises Problem."""
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise Problem("expected text in UTF-8, got UTF-16: save it as UTF-8")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise Problem(f"expected text in UTF-8, got other bytes at {error.start}: save it as UTF-8") from None
    if "\x00" in text:
        raise Problem("expected text, got zero bytes: is it another format?")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def number_lines(text: str, num_rows: int, *, skip: int = 0) -> list[str]:
    """The `num_rows` lines after the first `skip`, leaving out blank ones, with single blanks between the cells.

    Raises Problem where there are fewer.
    """
    # a row takes two characters at least
    if 2 * (num_rows + skip) > len(text) + 1:
        raise Problem(f"is cut off: expected {num_rows} points, got less text than that; export it again")
    lines = (" ".join(line.split()) for line in io.StringIO(text))
    found = list(itertools.islice((line for line in lines if line), skip, skip + num_rows))
    if len(found) < num_rows:
        raise Problem(f"is cut off: expected {num_rows} points, got {len(found)}; copy or export it again")
    return found


def wrong_line(
    lines: list[str],
    columns: list[int],
    reason: object,
    *,
    separator: str | None = None,
    decimal: str = ".",
    num_skipped: int | None = None,
) -> Problem:
    """What to tell of lines that a library refused: the first one without numbers in `columns`, else its reason.

    num_skipped: lines of the file before these, None where only the points' own lines are counted.
    """
    for number, line in enumerate(lines, (num_skipped or 0) + 1):
        cells = _split(line.strip(), separator)
        if line.strip() and not all(i < len(cells) and _is_number(cells[i], decimal) for i in columns):
            came = f"{shorten(line)!r} on line {number}{' of the points' if num_skipped is None else ''}"
            return Problem(f"expected numbers for x, y and z, got {came}: correct that line")
    return Problem(f"expected rows of numbers ({shorten(str(reason))}): export it again")


def _parse_rows(text: str, columns: list[int], *, separator: str | None, decimal: str, num_skipped: int) -> np.ndarray:
    """The columns at three positions as (n, 3) float64; missing values are NaN. Separator None is any run of blanks."""
    import pandas as pd

    style = {"separator": separator, "decimal": decimal}
    try:
        frame = pd.read_csv(
            io.StringIO(text),
            header=None,
            sep=separator or r"\s+",
            usecols=sorted(columns),
            dtype=np.float64,
            skipinitialspace=True,
            decimal=decimal,
            # pandas knows only some of them, and tells cases apart
            na_values=[case(word) for case in (str.lower, str.upper, str.capitalize) for word in _MISSING],
            engine="c",
        )
    except pd.errors.EmptyDataError:
        return np.empty((0, 3))
    except ValueError as error:
        raise wrong_line(text.splitlines(), columns, error, num_skipped=num_skipped, **style) from None
    return frame[columns].to_numpy(np.float64)


def _split(line: str, separator: str | None) -> list[str]:
    cells = line.split(separator)
    if '"' in line:
        # a separator in quotes separates nothing
        line = " ".join(cells) if separator is None else line
        cells = next(csv.reader([line], delimiter=separator or " ", skipinitialspace=True))
    return [cell.strip().strip("\"'").strip() for cell in cells]


def _separator(line: str) -> tuple[str | None, str]:
    """(what separates the cells of a line, None for blanks; the decimal mark)."""
    if ";" in line:
        return ";", "," if "," in line else "."
    # 1,5 2,5 3,5 has its commas within the numbers, 1, 2, 3 after them
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


def _names_above(comment: str, count: int) -> tuple[str, ...]:
    """Column names from the comment above the numbers where it names as many with x, y and z, else the usual ones."""
    for separator in (None, ",", ";"):
        names = _split(comment, separator)
        if len(names) == count and {"x", "y", "z"} <= {name.lower() for name in names}:
            return tuple(names)
    return numbered(count)
