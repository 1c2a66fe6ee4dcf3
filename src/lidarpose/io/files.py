"""Reading a user's file, and writing results atomically, so that a crash never leaves a partial file.

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

# a frame number, as in file names and at the beginning of lines
FRAME_NUMBER = re.compile("[0-9]{1,12}")
# bytes of the target's name kept in the temporary name: usual file systems allow 255 in all, and the prefix needs some
_MAX_KEPT_NAME = 100

# prefix of the names of temporary files; version 0.2 used process ids
_TEMPORARY = r"\.(?:[0-9a-f]{16}|\d+-\d+)-"
# this file exists in a folder while a process writes there
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


def read_bytes(path: str | os.PathLike, *, expected: str, most: int | None = None) -> bytes:
    """The content of a regular, non-empty file of at most `most` bytes.

    `expected` describes the file in error messages ("a JSON file", ...).

    Raises InputError for a missing, empty, too large or unreadable file, a folder, a device or a pipe.
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
    if not data:
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


def check_writable(path: str | os.PathLike) -> None:
    """Raises InputError if `atomic_path` would, to be called long before the content is ready. Leaves no files."""
    with suppress(_Abandoned), atomic_path(path):
        raise _Abandoned


class _Abandoned(Exception):
    """Ends the block of `atomic_path` without writing the file."""


def check_suffix(path: str | os.PathLike, *suffixes: str) -> None:
    """Raises InputError if a file's suffix does not match the format that is written to it."""
    try:
        name = os.fsdecode(path).lower()
    except TypeError as error:
        raise file_error(repr(path), f"expected the path of a file to write ({error})") from None
    if not name.endswith(suffixes):
        # .htm is no format of its own
        formats = " or ".join(s[1:].upper() for s in suffixes if not any(t != s and t.startswith(s) for t in suffixes))
        raise file_error(path, f"is written as {formats}: give a name that ends in {' or '.join(suffixes)}")


@contextmanager
def atomic_path(path: str | os.PathLike) -> Iterator[Path]:
    """Yields a temporary path in the folder of `path`, which is renamed to `path` when the block ends without an error.

    The temporary name ends in the last part of `path`'s name, including the suffix, so that libraries that choose a
    format by the suffix work. Any exception in the block removes the temporary file and the folders created for it,
    and leaves an older file at `path` unchanged. Links are followed. Missing parent folders are created.

    Raises InputError if the folder is not writable or the disk is full, or if `path` is a folder or a device.
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
        # replacing a device such as /dev/null with a file would break the machine when run as root
        if not stat.S_ISREG(mode):
            raise file_error(path, "is a device or pipe; give the name of a file to write")

    new_folders: list[Path] = []
    # a multi-byte character that the cut splits is dropped
    name_end = target.name.encode("utf-8", "ignore")[-_MAX_KEPT_NAME:].decode("utf-8", "ignore")
    # a random name, since containers that share a disk may have the same process ids
    temporary = target.parent / f".{secrets.token_hex(8)}-{name_end}"
    try:
        for folder in (*reversed(target.parent.parents), target.parent):
            if not folder.is_dir():
                folder.mkdir(exist_ok=True)
                new_folders.append(folder)
        # created now, so that a missing write permission is reported before hours of work in the block
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666 if mode is None else 0o600))
    except OSError as error:
        _remove(temporary, new_folders)
        raise write_error(path, target.parent, error) from None
    try:
        yield temporary
        with open(temporary, "r+b") as file:
            os.fsync(file.fileno())
        if mode is not None:
            # the new file keeps the permissions of the old one
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
    """Writes `data` (text as UTF-8) to `path` in one step: readers see either the old or the new content.

    Creates missing parent folders. Raises InputError as `atomic_path` does.
    """
    content = data.encode("utf-8") if isinstance(data, str) else data
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write(content)


def write_all_atomic(contents: Mapping[Path, bytes]) -> None:
    """Writes several files, either all of them or none; they are put in place in their order. Raises InputError as
    `atomic_path` does."""
    with ExitStack() as stack:
        # the stack puts the last file in place first
        for path, content in reversed(list(contents.items())):
            stack.enter_context(atomic_path(path)).write_bytes(content)


def is_unused(folder: Path, names: str) -> bool:
    """Whether a folder is missing, or contains only files that killed processes left: locks, and temporary files for
    names that match the regular expression `names`."""
    return (
        not folder.exists()
        or folder.is_dir()
        and all(path.name == LOCK or re.fullmatch(_TEMPORARY + names, path.name) for path in folder.iterdir())
    )


@contextmanager
def locked(folder: Path, names: str, *, busy: str, wait: float = 0.0) -> Iterator[None]:
    """Locks a folder against writing by other processes, and removes temporary files that killed processes left.

    Missing folders are created, and removed at the end if they are still empty. The lock of a
    killed process does not block others. On file systems without locks nothing is locked.

    Args:
        names: A regular expression for the names of the files that are written there and in subfolders.
        busy: The error message if another process holds the lock for longer than `wait` seconds.

    Raises:
        InputError: The folder is in use or not writable.
        MissingExtra: filelock is not installed.
    """
    lock = _file_lock(folder / LOCK)
    new_folders = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    if not _acquired(lock, wait):
        raise file_error(folder, busy)
    try:
        _remove_leftovers(folder, names)
        yield
        _remove_leftovers(folder, names)
    finally:
        # Windows does not delete open files
        with suppress(OSError):
            (folder / LOCK).unlink()
        lock.release()
        for path in new_folders:
            with suppress(OSError):
                path.rmdir()


@contextmanager
def exclusive_lock(path: Path, on_busy: Callable[[], None]) -> Iterator[None]:
    """Holds the lock file `path`, after waiting for other processes to release it.

    The folder must exist, and the lock file is not removed; otherwise like `locked`.

    Args:
        on_busy: Called before waiting for another process.

    Raises:
        InputError: The file is not writable.
        MissingExtra: filelock is not installed.
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
    """Whether the lock could be acquired within `wait` seconds, without limit below 0; True on file systems without
    locks."""
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
    """Whether an error in the block of `atomic_path` came from writing the temporary file."""
    names = {os.fsdecode(n) for n in (error.filename, error.filename2) if isinstance(n, str | bytes | os.PathLike)}
    return str(temporary) in names or error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG)


def write_error(path: object, folder: Path, error: OSError) -> InputError:
    """The error for a file that cannot be written into a folder, with the remedy."""
    remedy = _REMEDIES.get(error.errno or 0, "choose another folder")
    return file_error(path, f"cannot write into the folder {folder} ({error.strerror or error}); {remedy}")


def _remove(temporary: Path, new_folders: list[Path]) -> None:
    with suppress(OSError):
        temporary.unlink()
    for folder in reversed(new_folders):
        with suppress(OSError):
            folder.rmdir()


def _sync_folder(folder: Path) -> None:
    """Flushes the folder to disk, so that the new file name survives a power failure (not supported on Windows)."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
