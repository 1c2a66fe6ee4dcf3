"""Reading a user's file, and the errors that name it.

Every failure that the user can cause is an `InputError` of one line that names the file and the remedy.
"""

import difflib
import hashlib
import json
import os
import re
import reprlib
import stat
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from lidarpose.errors import InputError

# a frame number, as in file names and at the beginning of lines
FRAME_NUMBER = re.compile("[0-9]{1,12}")


# an archive may unpack to this many bytes or to this multiple of its size: real points compress to a tenth at best
_UNPACKED_BYTES, _UNPACKED_RATIO = 64 * 2**20, 32


class FormatError(Exception):
    """What is wrong with a file's content and what to do, without the file's name, which its reader adds.

    The message is a whole sentence, or has three parts: what was expected, what the file contains, and the remedy.
    """

    def __init__(self, problem: str, came: object = None, remedy: str = ""):
        super().__init__(problem if came is None else f"expected {problem}, got {came}: {remedy}")


def shorten(text: str, limit: int = 80) -> str:
    """The text on one line of at most `limit` characters."""
    text = " ".join(text.split())
    return text if len(text) <= limit else text[: limit - 3] + "..."


def one_line(text: str) -> str:
    """The text as one line that any terminal can print: line breaks and control characters are escaped."""
    return encodable("".join(c if c.isprintable() else repr(c)[1:-1] for c in " ".join(text.splitlines())))


def encodable(text: str) -> str:
    """The text with lone surrogates escaped, which file names and JSON may contain."""
    return text.encode("utf-8", "backslashreplace").decode()


def file_error(path: object, problem: object) -> InputError:
    """The error `PATH: PROBLEM` on one line that any terminal can print."""
    return InputError(one_line(f"{path or repr(path)}: {problem}"))


def unreadable(path: object, error: OSError) -> InputError:
    """The error for a file that the operating system refuses to read."""
    return file_error(path, f"cannot be read ({error.strerror or error}); check the path and its permissions")


def listed(paths: str | os.PathLike | Iterable[str | os.PathLike]) -> list[str | os.PathLike]:
    """Paths or names as a list; a single string is one path, not a list of letters. Raises InputError otherwise."""
    if isinstance(paths, bytes) or not isinstance(paths, str | os.PathLike | Iterable):
        raise InputError(f"expected one or more paths, got {type(paths).__name__}: give a file or folder")
    return [paths] if isinstance(paths, str | os.PathLike) else list(paths)


def folders_below(folder: Path) -> Iterator[tuple[Path, list[str]]]:
    """The folder and its subfolders, each with the names of its files. Links are followed, except to a folder that
    they lie in."""
    for directory, folders, names in os.walk(folder, followlinks=True):
        path = Path(directory)
        steps = path.relative_to(folder)
        above = {os.path.realpath(folder / step) for step in (steps, *steps.parents)}
        folders[:] = [name for name in folders if os.path.realpath(path / name) not in above]
        yield path, names


def common_folder(paths: Iterable[str | os.PathLike]) -> str | None:
    """The absolute path of the folder that holds all paths, or of the only one; None if they are on different drives of
    Windows."""
    try:
        return os.path.commonpath([os.path.abspath(path) for path in paths])
    except ValueError:
        return None


def check_not_input(out: str | os.PathLike, *inputs: object) -> None:
    """Raises InputError if the output file is one of the input files, also under another name. Inputs that are not
    paths, or whose files do not exist, are ignored."""
    for source in inputs:
        is_same = False
        # os.fspath rejects numbers, which samefile would take for open file descriptors
        with suppress(OSError, TypeError, ValueError):
            is_same = os.path.samefile(out, os.fspath(source))  # type: ignore[call-overload]
        if is_same:
            raise file_error(out, "is also an input file and would be overwritten: give another file to write")


def content_digest(path: str | os.PathLike, *, expected: str) -> str:
    """The SHA-256 of a file, in hexadecimal digits. expected and errors: as in `read_bytes`."""
    return hashlib.sha256(read_bytes(path, expected=expected)).hexdigest()


def read_bytes(path: str | os.PathLike, *, expected: str, most: int | None = None, may_be_empty: bool = False) -> bytes:
    """The content of a regular file of at most `most` bytes.

    `expected` describes the file in error messages ("a JSON file", ...).

    Raises InputError for a missing, empty (unless `may_be_empty`), too large or unreadable file, a folder, a device or
    a pipe.
    """
    try:
        # os.fspath rejects numbers, which stat and open would take for open file descriptors
        path = os.fspath(path)
        mode, size = os.stat(path).st_mode, os.stat(path).st_size
        if stat.S_ISDIR(mode):
            raise file_error(path, f"expected {expected}, got a folder; give a file in it")
        if not stat.S_ISREG(mode):
            raise file_error(path, f"expected {expected}, got a device or pipe; save it as a file first")
        if most is not None and size > most:
            limit = f"expected at most {most / 2**30:g} GiB: split it first"
            raise file_error(path, f"has {size / 2**30:.1f} GiB, {limit}")
        with open(path, "rb") as file:
            data = file.read()
    except InputError:
        raise
    except FileNotFoundError:
        hint = "; the standard input is not read, save it as a file first" if path == "-" else _nearest(path)
        raise file_error(path, f"no such file; expected {expected}{hint}") from None
    except OSError as error:
        raise unreadable(path, error) from None
    except MemoryError:
        raise file_error(path, "does not fit in memory; split it first") from None
    except (TypeError, ValueError) as error:
        raise file_error(reprlib.repr(path), f"expected the path of {expected} ({error})") from None
    if not data and not may_be_empty:
        raise file_error(path, f"is empty; expected {expected}: was it copied completely?")
    return data


def read_json(path: str | os.PathLike, *, expected: str) -> Any:
    """The content of a JSON file. expected and errors: as in `read_bytes`; invalid JSON is an InputError, too."""
    data = read_bytes(path, expected=expected)
    try:
        # as bytes: json then detects the Unicode encoding
        return json.loads(data)
    except (ValueError, RecursionError) as error:
        raise file_error(path, f"is not JSON ({error}); was it copied completely?") from None


def lined_json(document: dict[str, Any], list_key: str, *inner_keys: str, indent: str = "") -> str:
    """A document as JSON: one line for each key and for each entry of the list at `list_key`. If inner keys are given,
    each entry is itself formatted so, with the first of them as its `list_key`."""
    lines = []
    for key, value in document.items():
        text = json.dumps(value)
        if key == list_key and value:
            inner_indent = indent + "  "
            entries = [lined_json(v, *inner_keys, indent=inner_indent) if inner_keys else json.dumps(v) for v in value]
            text = "[\n" + ",\n".join(inner_indent + entry for entry in entries) + f"\n{indent} ]"
        lines.append(f"{indent} {json.dumps(key)}: {text}")
    return "{\n" + ",\n".join(lines) + f"\n{indent}}}"


def check_unpacked(packed: int, unpacked: int) -> None:
    """Raises FormatError if `packed` bytes would unpack to more bytes than a file of real data does.

    The environment variable LIDARPOSE_MAX_UNPACKED sets the number of bytes that may be unpacked from a file of any
    size.
    """
    limit = os.environ.get("LIDARPOSE_MAX_UNPACKED", str(_UNPACKED_BYTES))
    if not (limit.isascii() and limit.isdecimal()):
        raise FormatError(f"expected a number of bytes in LIDARPOSE_MAX_UNPACKED, got {shorten(limit)!r}: correct it")
    if unpacked > max(int(limit), _UNPACKED_RATIO * packed):
        raise FormatError(
            f"expected at most {limit} bytes or {_UNPACKED_RATIO} times its size when unpacked, got {unpacked} from "
            f"{packed}: if you trust it, set the environment variable LIDARPOSE_MAX_UNPACKED={unpacked}"
        )


def _nearest(path: str | os.PathLike) -> str:
    """A hint about a missing file: the most similar name in its folder, or that the folder itself is missing."""
    if not path:
        return "; give its name"
    folder, name = os.path.split(os.path.abspath(os.fsdecode(path)))
    try:
        names = os.listdir(folder)
    except OSError:
        return f"; the folder {folder} does not exist either"
    if name in names:
        return "; it is a link to a missing file"
    matches = difflib.get_close_matches(name, names, n=1, cutoff=0.7)
    return f"; did you mean {matches[0]}?" if matches else "; check the path"
