"""LAS and LAZ, the formats of surveying. Source: ASPRS, LAS Specification 1.4 - R15, 2.4 to 2.6.

All point formats store the coordinates at the same place, so LAS needs no library. LAZ is unpacked by lazrs.
"""

import io
import struct

import numpy as np

from lidarpose.errors import needs_extra
from lidarpose.io.files import FormatError, check_unpacked
from lidarpose.io.text import PickColumns, check_bytes, pick_xyz

# header bytes of version 1.2 and older, and of 1.4, whose longer header has a 64-bit number of points
_HEADER, _HEADER_1_4 = 227, 375
_POINT_FORMATS = range(11)
# this bit of the point format's number is set if the points are compressed
_PACKED = 0x80
# user id and record id of the record that describes the compression
_LASZIP = (b"laszip encoded", 22204)
# size of the chunks in that record if they differ
_VARIABLE = b"\xff\xff\xff\xff"
# byte of the time in a point, and in a point of format 6 and later, which has a larger scan angle
_TIME_OFFSET, _LATER_TIME_OFFSET, _LATER = 20, 22, 6
_WITH_TIME, _WITH_COLOR = (1, 3, 4, 5, 6, 7, 8, 9, 10), (2, 3, 5, 7, 8, 10)


def parse_las(data: bytes, pick: PickColumns = pick_xyz) -> tuple[np.ndarray, tuple[str, ...]]:
    """The picked columns (n, c), x y z and perhaps the time, float64 in the file's units, and the column names; raises
    FormatError."""
    if len(data) < _HEADER or data[:4] != b"LASF":
        raise FormatError("a LAS header", f"an unknown or damaged one in {len(data)} bytes", "copy it again")
    version = tuple(data[24:26])
    start, _, kind, size, num_points = struct.unpack_from("<IIBHI", data, 96)
    scale, shift = np.split(np.frombuffer(data, "<f8", 6, 131), 2)
    if version >= (1, 4) and len(data) >= _HEADER_1_4:
        num_points = struct.unpack_from("<Q", data, 247)[0] or num_points
    is_packed, kind = bool(kind & _PACKED), kind & 0x3F
    if kind not in _POINT_FORMATS or size < 20:
        raise FormatError("point format 0 to 10", f"{kind} of {size} bytes", "export it as LAS 1.4")
    if not np.isfinite([scale, shift]).all() or not scale.all():
        raise FormatError("finite scales and offsets", [*scale, *shift], "export it again")
    if is_packed:
        check_unpacked(len(data), num_points * size)
        data, start = _unpack(data, start, size, num_points), 0
    check_bytes(data, start, num_points * size, num_points)
    names = ["x", "y", "z", "intensity", "classification"]
    names += ["gps_time"] * (kind in _WITH_TIME) + ["red", "green", "blue"] * (kind in _WITH_COLOR)
    steps: np.ndarray = np.ndarray((num_points, 3), "<i4", data, start, (size, 4))
    points = steps * scale + shift
    offset = _TIME_OFFSET if kind < _LATER else _LATER_TIME_OFFSET
    if len(pick(names)) == 3 or size < offset + 8:
        return points, tuple(names)
    times: np.ndarray = np.ndarray(num_points, "<f8", data, start + offset, size)
    return np.column_stack([points, times]), tuple(names)


class _Unseekable(io.RawIOBase):
    """A stream without seeking: lazrs then skips the chunk table, for which it would allocate the announced length."""

    def __init__(self, data: bytes):
        self._file = io.BytesIO(data)

    def readinto(self, buffer) -> int:
        return self._file.readinto(buffer)


def _check_chunk_table(data: bytes, start: int) -> None:
    """Raises FormatError if the chunk table has more chunks than the file has room for: lazrs would allocate them."""
    (table,) = struct.unpack_from("<q", data, start)
    if table == -1:
        # a writer that could not seek appended the position
        (table,) = struct.unpack_from("<q", data, len(data) - 8)
    if not start < table <= len(data) - 8 or struct.unpack_from("<I", data, table + 4)[0] > len(data) // 8:
        raise FormatError("is damaged or cut off: copy it again")


def _unpack(data: bytes, start: int, size: int, num_points: int) -> bytes:
    """The point records of a LAZ file, decompressed as in a LAS file. lazrs does not validate the sizes that a file
    announces, so this module does."""
    with needs_extra("reading .laz"):
        import lazrs
    offset = struct.unpack_from("<H", data, 94)[0]
    for _ in range(struct.unpack_from("<I", data, 100)[0]):
        if offset + 54 > min(start, len(data)):
            break
        user, record, length = struct.unpack_from("<16sHH", data, offset + 2)
        offset += 54 + length
        if (user.rstrip(b"\0"), record) == _LASZIP:
            points = bytearray(num_points * size)
            try:
                record_data = data[offset - length : offset]
                # type, size and version of each item of a point; lazrs prints a panic if they are not those of a point
                num_items = struct.unpack_from("<H", record_data, 32)[0]
                if sum(struct.unpack_from(f"<{3 * num_items}H", record_data, 34)[1::3]) != size:
                    raise ValueError("items of another size than the points")
                stream: io.IOBase = _Unseekable(data[start:])
                if record_data[12:16] == _VARIABLE:
                    # as in COPC: without the chunk table the chunks' numbers of points are unknown
                    _check_chunk_table(data, start)
                    stream = io.BytesIO(data)
                    stream.seek(start)
                lazrs.LasZipDecompressor(stream, record_data).decompress_many(points)
            # a damaged file may make lazrs panic, which raises an error that is not an Exception
            except BaseException as error:
                if isinstance(error, KeyboardInterrupt | SystemExit):
                    raise
                raise FormatError("is damaged or cut off: copy it again") from None
            return bytes(points)
    raise FormatError("is compressed, but has no LASzip record: was it written completely?")
