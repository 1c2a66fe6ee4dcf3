"""Reading a user's file and writing results so that a crash never leaves half a file.

Every failure that the user can cause is an `InputError` of one line that names the file and the remedy.
"""

import difflib
import errno
import hashlib
import json
import os
import re
import reprlib
import secrets
import stat
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from lidarpose.errors import InputError, MissingExtra

# a frame's number, as files are named and lines begin
FRAME_NUMBER = re.compile("[0-9]{1,12}")
# bytes: a name may have 255 on the usual file systems, of which the temporary name needs some itself
_MAX_KEPT_NAME = 100

# how the names of temporary files begin; with process ids in version 0.2
_TEMPORARY = r"\.(?:[0-9a-f]{16}|\d+-\d+)-"
# in a folder while a process writes there
LOCK = ".lock"

_REMEDIES = {
    errno.ENOSPC: "free some space or write to another disk",
    errno.EDQUOT: "free some of your quota or write to another disk",
    errno.EROFS: "the disk is read-only: write to another folder",
    errno.EACCES: "allow writing there or choose another folder",
    errno.EPERM: "allow writing there or choose another folder",
    errno.ENOTDIR: "a part of the path is a file: choose another folder",
    errno.EEXIST: "a part of the path is a file: choose another folder",
    errno.ENAMETOOLONG: "choose a shorter name",
}


# an archive may unpack to so many bytes, or to so many times its size: points take a tenth at the very least
_UNPACKED_BYTES, _UNPACKED_RATIO = 64 * 2**20, 32


class FormatError(Exception):
    """What is wrong with a file's content and what to do, without the file's name, which its reader adds.

    A whole sentence, or three parts: what was expected, what came, and the remedy.
    """

    def __init__(self, problem: str, came: object = None, remedy: str = ""):
        super().__init__(problem if came is None else f"expected {problem}, got {came}: {remedy}")


def shorten(text: str, limit: int = 80) -> str:
    """The text on one line of at most `limit` characters."""
    text = " ".join(text.split())
    return text if len(text) <= limit else text[: limit - 3] + "..."


def one_line(text: str) -> str:
    """The text as one line that any terminal can print: what would break the line or steer the terminal is escaped."""
    return encodable("".join(c if c.isprintable() else repr(c)[1:-1] for c in " ".join(text.splitlines())))


def encodable(text: str) -> str:
    """The text with what is no character, as names from a disk or from JSON may hold, escaped."""
    return text.encode("utf-8", "backslashreplace").decode()


def file_error(path: object, problem: object) -> InputError:
    """The error `PATH: PROBLEM` on one line that any terminal can print."""
    return InputError(one_line(f"{path or repr(path)}: {problem}"))


def unreadable(path: object, error: OSError) -> InputError:
    """The error for a file that the system does not let us read."""
    return file_error(path, f"cannot be read ({error.strerror or error}); check the path and its rights")


def listed(paths: str | os.PathLike | Iterable[str | os.PathLike]) -> list[str | os.PathLike]:
    """Paths or names as a list; one alone is one, not a list of letters. Raises InputError for anything else."""
    if isinstance(paths, bytes) or not isinstance(paths, str | os.PathLike | Iterable):
        raise InputError(f"expected a path, or several, got {type(paths).__name__}: name a file or folder")
    return [paths] if isinstance(paths, str | os.PathLike) else list(paths)


def check_not_input(out: str | os.PathLike, *inputs: object) -> None:
    """Raises InputError where the file to write is one of those that are read, by whatever name. Inputs that are no
    paths, or of files that are not there, do not count."""
    for source in inputs:
        is_same = False
        # a bare number, for one, would be taken for an open file's handle
        with suppress(OSError, TypeError, ValueError):
            is_same = os.path.samefile(out, os.fspath(source))  # type: ignore[call-overload]
        if is_same:
            raise file_error(out, "is itself what is read, and would be lost: name another file to write")


def content_digest(path: str | os.PathLike, *, expected: str) -> str:
    """The SHA-256 of a file, in hexadecimal digits. expected and errors: as of `read_bytes`."""
    return hashlib.sha256(read_bytes(path, expected=expected)).hexdigest()


def read_bytes(path: str | os.PathLike, *, expected: str, most: int | None = None) -> bytes:
    """The content of a regular, non-empty file of at most `most` bytes; `expected` says what it should be ("a JSON
    file", ...).

    Raises InputError for a missing, empty, too large or unreadable file, a folder, a device or a pipe.
    """
    try:
        # a bare number would be taken for an open file's handle
        path = os.fspath(path)
        mode, size = os.stat(path).st_mode, os.stat(path).st_size
        if stat.S_ISDIR(mode):
            raise file_error(path, f"expected {expected}, got a folder; name one file in it")
        if not stat.S_ISREG(mode):
            raise file_error(path, f"expected {expected}, got a device or pipe; save it as a file first")
        if most is not None and size > most:
            limit = f"{most / 2**30:g} GiB are read at most: split it first"
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
    if not data:
        raise file_error(path, f"is empty; expected {expected}: was it copied completely?")
    return data


def read_json(path: str | os.PathLike, *, expected: str) -> Any:
    """The content of a JSON file. expected and errors: as of `read_bytes`; what is no JSON is an InputError too."""
    data = read_bytes(path, expected=expected)
    try:
        return json.loads(data.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise file_error(path, f"is not JSON ({error}); was it copied completely?") from None


def lined_json(document: dict[str, Any], list_key: str, *inner_keys: str, indent: str = "") -> str:
    """A document as JSON: a line for each key and for each entry of the list at `list_key`, which with an inner key is
    itself such a document."""
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
    """Raises FormatError where so many packed bytes would unpack to more than a file of real data does.

    The environment variable LIDARPOSE_MAX_UNPACKED raises the number of bytes that are unpacked in any case.
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
    """What to do about a missing file: the nearest name in its folder, or that the folder itself is missing."""
    if not path:
        return "; give its name"
    folder, name = os.path.split(os.path.abspath(os.fsdecode(path)))
    try:
        names = os.listdir(folder)
    except OSError:
        return f"; the folder {folder} does not exist either"
    if name in names:
        return "; it is a link to what is not there"
    matches = difflib.get_close_matches(name, names, n=1, cutoff=0.7)
    return f"; did you mean {matches[0]}?" if matches else "; check the path"


def check_writable(path: str | os.PathLike) -> None:
    """Raises InputError where `atomic_path` would, for what is known long before there is something to write. Leaves
    nothing behind."""
    with suppress(_Abandoned), atomic_path(path):
        raise _Abandoned


class _Abandoned(Exception):
    """Nothing is to be written after all."""


def check_suffix(path: str | os.PathLike, *suffixes: str) -> None:
    """Raises InputError where a file's name says another format than it gets."""
    try:
        name = os.fsdecode(path).lower()
    except TypeError as error:
        raise file_error(repr(path), f"expected the path of a file to write ({error})") from None
    if not name.endswith(suffixes):
        raise file_error(path, f"is to hold {suffixes[0][1:].upper()}: give a name that ends in {suffixes[0]}")


@contextmanager
def atomic_path(path: str | os.PathLike) -> Iterator[Path]:
    """Yields a temporary path in the folder of `path`; it becomes `path` when the block ends well.

    The temporary name ends in the last part of `path`'s name, suffix included, so that libraries which choose a
    format by the suffix work. Any exception in the block removes the temporary file, and the folders made for it,
    and leaves an older file at `path` as it was. A link is followed. Missing parent folders are created.

    Raises InputError where the folder cannot be written, is full, or `path` is a folder or a device.
    """
    try:
        target = Path(os.path.realpath(path))
    except (OSError, TypeError, ValueError) as error:
        raise file_error(repr(path), f"expected the path of a file to write ({error})") from None
    mode = None
    with suppress(OSError):
        mode = target.stat().st_mode
        if stat.S_ISDIR(mode):
            raise file_error(path, "is a folder; give the name of a file to write")
        # replacing a device such as /dev/null by a file would break the machine when run as root
        if not stat.S_ISREG(mode):
            raise file_error(path, "is a device or pipe; give the name of a file to write")

    new_folders: list[Path] = []
    # a character that is cut in two is left out
    name_end = target.name.encode("utf-8", "ignore")[-_MAX_KEPT_NAME:].decode("utf-8", "ignore")
    # random: containers on one disk have the same process ids
    temporary = target.parent / f".{secrets.token_hex(8)}-{name_end}"
    try:
        for folder in (*reversed(target.parent.parents), target.parent):
            if not folder.is_dir():
                folder.mkdir(exist_ok=True)
                new_folders.append(folder)
        # made at once, so that a folder without write access is known before hours of work go into the block
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666 if mode is None else 0o600))
    except OSError as error:
        _remove(temporary, new_folders)
        raise write_error(path, target.parent, error) from None
    try:
        yield temporary
        with open(temporary, "r+b") as file:
            os.fsync(file.fileno())
        if mode is not None:
            # whoever may not read the old content may not read the new
            with suppress(OSError):
                os.chmod(temporary, stat.S_IMODE(mode))
        os.replace(temporary, target)
    except BaseException as error:
        _remove(temporary, new_folders)
        if isinstance(error, OSError) and _is_about(error, temporary):
            raise write_error(path, target.parent, error) from None
        raise
    _sync_folder(target.parent)


def write_atomic(path: str | os.PathLike, data: bytes | str) -> None:
    """Writes `data` (text as UTF-8) to `path` in one step: readers see the old content or the new, never a part.

    Creates missing parent folders. Raises InputError as `atomic_path` does.
    """
    content = data.encode("utf-8") if isinstance(data, str) else data
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write(content)


def write_all_atomic(contents: Mapping[Path, bytes]) -> None:
    """Writes several files, all of them or none. Raises InputError as `atomic_path` does."""
    with ExitStack() as stack:
        for path, content in contents.items():
            stack.enter_context(atomic_path(path)).write_bytes(content)


def is_unused(folder: Path, names: str) -> bool:
    """Whether a folder is missing, or holds nothing but what killed processes left of files with such names (a regular
    expression)."""
    return (
        not folder.exists()
        or folder.is_dir()
        and all(path.name == LOCK or re.fullmatch(_TEMPORARY + names, path.name) for path in folder.iterdir())
    )


@contextmanager
def locked(folder: Path, names: str, *, busy: str, wait: float = 0.0) -> Iterator[None]:
    """Keeps other processes from writing into a folder, and removes what killed ones left of files.

    The folder is made, and removed again where nothing came into it. A process that was killed keeps nobody out. A file
    system that knows no locks goes without.

    Args:
        names: Of the files that are written there and in its subfolders, a regular expression.
        busy: What to say where another process holds the lock for longer than `wait` seconds.

    Raises:
        InputError: Where the folder is in use, or cannot be written.
        MissingExtra: Without filelock.
    """
    lock = _file_lock(folder / LOCK)
    is_new = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    if not _acquired(lock, wait):
        raise file_error(folder, busy)
    try:
        _remove_leftovers(folder, names)
        yield
        _remove_leftovers(folder, names)
    finally:
        # Windows does not let go of a file that is open
        with suppress(OSError):
            (folder / LOCK).unlink()
        lock.release()
        if is_new:
            with suppress(OSError):
                folder.rmdir()


@contextmanager
def exclusive_lock(path: Path, on_busy: Callable[[], None]) -> Iterator[None]:
    """Keeps other processes from what a file in a folder that is there stands for, and waits until they are done. The
    file stays; else as `locked`.

    Args:
        on_busy: Called before another process is waited for.

    Raises:
        InputError: Where the file cannot be written.
        MissingExtra: Without filelock.
    """
    lock = _file_lock(path)
    if not _acquired(lock, 0.0):
        on_busy()
        _acquired(lock, -1)
    try:
        yield
    finally:
        lock.release()


def _file_lock(path: Path) -> Any:
    try:
        from filelock import FileLock
    except ImportError:
        raise MissingExtra("writing a dataset or a run", "synth") from None
    check_writable(path)
    return FileLock(path)


def _acquired(lock: Any, wait: float) -> bool:
    """Whether a lock is held within so many seconds, below 0 for any number; True where the file system knows none."""
    from filelock import Timeout

    try:
        with suppress(NotImplementedError):
            lock.acquire(timeout=wait)
    except Timeout:
        return False
    except OSError as error:
        path = Path(lock.lock_file)
        raise write_error(path, path.parent, error) from None
    return True


def _remove_leftovers(folder: Path, names: str) -> None:
    for path in folder.rglob(".*"):
        if re.fullmatch(_TEMPORARY + names, path.name):
            path.unlink(missing_ok=True)


def _is_about(error: OSError, temporary: Path) -> bool:
    """Whether an error of the block came from writing the temporary file, not from something else it did."""
    names = {os.fsdecode(n) for n in (error.filename, error.filename2) if isinstance(n, str | bytes | os.PathLike)}
    return str(temporary) in names or error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG)


def write_error(path: object, folder: Path, error: OSError) -> InputError:
    """The error of a file that cannot be written into a folder, with what to do."""
    remedy = _REMEDIES.get(error.errno or 0, "choose another folder")
    return file_error(path, f"cannot write into the folder {folder} ({error.strerror or error}); {remedy}")


def _remove(temporary: Path, new_folders: list[Path]) -> None:
    with suppress(OSError):
        temporary.unlink()
    for folder in reversed(new_folders):
        with suppress(OSError):
            folder.rmdir()


def _sync_folder(folder: Path) -> None:
    """Makes the new name itself survive a power cut, where the system can (not on Windows)."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
