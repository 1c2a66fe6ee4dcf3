"""Writing files atomically, so that a crash never leaves a partial file, and locks of folders.

Every failure that the user can cause is an `InputError` of one line that names the file and the remedy.
"""

import errno
import os
import re
import secrets
import stat
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from lidarpose.errors import InputError, MissingExtra
from lidarpose.io.files import file_error

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
    first_part = re.split(r"[/\\]", os.fsdecode(path))[0]
    if first_part.startswith("~") and not os.path.lexists(first_part):
        # a folder of that name would be created, and removing it by `rm -r ~` empties the home folder
        raise file_error(path, f"{first_part} was not replaced with the home folder; give the whole path")
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
