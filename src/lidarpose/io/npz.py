"""NumPy's files, without running anything that is pickled in them and without memory for what they only announce.

https://numpy.org/doc/stable/reference/generated/numpy.lib.format.html
"""

import io
import math
import os
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import IO, Literal

import numpy as np

from lidarpose.io.files import FormatError, check_unpacked, file_error, read_bytes, shorten
from lidarpose.io.text import check_bytes

# how numpy compresses
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
# bytes of a header, of which numpy reads 10,000
_LONGEST_HEADER = 2**14


def read_npz(
    path: str | os.PathLike, wanted: Iterable[str], *, expected: str
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Arrays of an npz file, without running anything that is pickled in it.

    Args:
        wanted: Names of the arrays to read; those that are missing are left out.
        expected: As of `read_bytes`.

    Returns:
        The arrays by name, and all names in the file, sorted.

    Raises:
        InputError: For a missing, damaged or truncated file, Python objects among the arrays, too large a file.
    """
    data = read_bytes(path, expected=expected)
    try:
        with open_npz(data) as (archive, members):
            present_names = [name for name in wanted if name in members]
            contents = unpack(archive, [members[name] for name in present_names], len(data))
            # copied, since what lies in a file's bytes cannot be written to
            arrays = {name: load_array(content).copy() for name, content in zip(present_names, contents, strict=True)}
            return arrays, sorted(members)
    except FormatError as problem:
        raise file_error(path, problem) from None
    except MemoryError:
        raise file_error(path, "does not fit in memory; split it first") from None


@contextmanager
def open_npz(data: bytes):
    """Yields the archive in a file's bytes and its members by the names of arrays; raises FormatError."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = [member for member in archive.infolist() if member.filename.endswith(".npy")]
            # numpy writes no others, and zipfile unpacks them without bounds
            if other_members := [member for member in members if member.compress_type not in _METHODS]:
                actual = f"another compression of {shorten(other_members[0].filename)}"
                raise FormatError("an npz that is stored or deflated", actual, "save it with numpy.savez_compressed")
            yield archive, {member.filename.removesuffix(".npy"): member for member in members}
    except (FormatError, MemoryError):
        raise
    # zipfile and zlib raise many kinds for a damaged archive
    except Exception as error:
        reason = shorten(str(error))
        raise FormatError(
            "an npz of plain arrays", f"a damaged or cut off one ({reason})", "was it copied completely?"
        ) from None


def unpack(archive: zipfile.ZipFile, members: list[zipfile.ZipInfo], size: int) -> Iterator[bytes]:
    """The content of each member of an archive of `size` bytes, of no more bytes than are announced; raises
    FormatError where those are too many."""
    packed_size = min(size, sum(member.compress_size for member in members))
    check_unpacked(packed_size, sum(member.file_size for member in members))
    for member in members:
        with archive.open(member) as file:
            # read() would unpack everything before it looks at the announced size
            yield file.read(max(member.file_size, 1))


def member_header(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> tuple[tuple[int, ...], np.dtype]:
    """(shape, dtype) of a member, of which no more is unpacked."""
    with archive.open(member) as file:
        return array_header(io.BytesIO(file.read(_LONGEST_HEADER)))[:2]


def array_header(file: IO[bytes]) -> tuple[tuple[int, ...], np.dtype, Literal["C", "F"]]:
    """(shape, dtype, order) of a .npy stream, which is left at its first value."""
    try:
        version = np.lib.format.read_magic(file)
        # version 3 differs from 2 by the characters that field names may have
        read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, is_fortran, dtype = read_header(file)
        return shape, dtype, "F" if is_fortran else "C"
    except Exception as error:
        reason = shorten(str(error))
        raise FormatError("a NumPy .npy header", f"another or a damaged one ({reason})", "save it again") from None


def load_array(data: bytes) -> np.ndarray:
    """The array in a .npy file's bytes; nothing is unpickled, and the size is checked before the values are read."""
    file = io.BytesIO(data)
    shape, dtype, order = array_header(file)
    if dtype.hasobject:
        raise FormatError("plain arrays of numbers", "dtype object", "save a float array with numpy.save")
    if any(n < 0 for n in shape) or not dtype.itemsize:
        raise FormatError("an array (n, 3+)", f"the shape {shape}", "save it again")
    check_bytes(data, file.tell(), math.prod(shape) * dtype.itemsize, shape[0] if shape else 1)
    return np.ndarray(shape, dtype, data, file.tell(), order=order)
