"""NumPy files, read without unpickling anything and without allocating memory for sizes that are only announced.

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

# the compression methods that numpy uses
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
# bytes read for a header; numpy accepts headers of up to 10,000
_LONGEST_HEADER = 2**14


def read_npz(
    path: str | os.PathLike, wanted: Iterable[str], *, expected: str
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Reads arrays of an npz file, without unpickling anything.

    Args:
        wanted: Names of the arrays to read; missing ones are left out.
        expected: As in `read_bytes`.

    Returns:
        The arrays by name, and the sorted names of all arrays in the file.

    Raises:
        InputError: The file is missing, damaged, truncated or too large, or an array holds Python objects.
    """
    data = read_bytes(path, expected=expected)
    try:
        with open_npz(data) as (archive, members):
            present_names = [name for name in wanted if name in members]
            contents = unpack(archive, [members[name] for name in present_names], len(data))
            # copied, since arrays backed by the file's bytes are read-only
            arrays = {name: load_array(content).copy() for name, content in zip(present_names, contents, strict=True)}
            return arrays, sorted(members)
    except FormatError as problem:
        raise file_error(path, problem) from None
    except MemoryError:
        raise file_error(path, "does not fit in memory; split it first") from None


@contextmanager
def open_npz(data: bytes):
    """Yields the archive in a file's bytes and its members by array name; raises FormatError."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = [member for member in archive.infolist() if member.filename.endswith(".npy")]
            # numpy writes no other methods, and zipfile unpacks those without a size limit
            if other_members := [member for member in members if member.compress_type not in _METHODS]:
                actual = f"another compression of {shorten(other_members[0].filename)}"
                raise FormatError("an npz that is stored or deflated", actual, "save it with numpy.savez_compressed")
            yield archive, {member.filename.removesuffix(".npy"): member for member in members}
    except (FormatError, MemoryError):
        raise
    # zipfile and zlib raise many kinds of errors for a damaged archive
    except Exception as error:
        reason = shorten(str(error))
        raise FormatError(
            "an npz of plain arrays", f"a damaged or cut off one ({reason})", "was it copied completely?"
        ) from None


def unpack(archive: zipfile.ZipFile, members: list[zipfile.ZipInfo], size: int) -> Iterator[bytes]:
    """Yields the content of each member of an archive of `size` bytes, up to the announced number of bytes. Raises
    FormatError if too many are announced."""
    packed_size = min(size, sum(member.compress_size for member in members))
    check_unpacked(packed_size, sum(member.file_size for member in members))
    for member in members:
        with archive.open(member) as file:
            # read() without a size would unpack everything before it checks the announced size
            yield file.read(max(member.file_size, 1))


def member_header(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> tuple[tuple[int, ...], np.dtype]:
    """(shape, dtype) of a member; only its header is unpacked."""
    with archive.open(member) as file:
        return array_header(io.BytesIO(file.read(_LONGEST_HEADER)))[:2]


def array_header(file: IO[bytes]) -> tuple[tuple[int, ...], np.dtype, Literal["C", "F"]]:
    """(shape, dtype, order) of a .npy stream; afterwards the stream is positioned at the first value."""
    try:
        version = np.lib.format.read_magic(file)
        # version 3 differs from 2 only in the characters allowed in field names
        read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, is_fortran, dtype = read_header(file)
        return shape, dtype, "F" if is_fortran else "C"
    except Exception as error:
        reason = shorten(str(error))
        raise FormatError("a NumPy .npy header", f"an unknown or damaged one ({reason})", "save it again") from None


def load_array(data: bytes) -> np.ndarray:
    """The array in a .npy file's bytes; nothing is unpickled, and the size is checked before the values are read."""
    file = io.BytesIO(data)
    shape, dtype, order = array_header(file)
    if dtype.hasobject:
        raise FormatError("plain arrays of numbers", "dtype object", "save a float array with numpy.save")
    if any(n < 0 for n in shape) or not dtype.itemsize:
        raise FormatError("an array (n, 3+)", f"the shape {shape}", "save it again")
    check_bytes(data, file.tell(), math.prod(shape) * dtype.itemsize, shape[0] if shape else 1)
    try:
        return np.ndarray(shape, dtype, data, file.tell(), order=order)
    # too many dimensions, or an array of 0 values with a dimension that is too large or not an integer
    except (ValueError, TypeError, OverflowError):
        raise FormatError("an array (n, 3+)", f"the shape {shorten(str(shape))}", "save it again") from None
