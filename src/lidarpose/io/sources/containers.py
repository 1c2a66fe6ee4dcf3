"""Messages of MCAP, ROS 1 bag and rosbag2's SQLite files, in file order.

Files are read from the front, so that a file of a killed recorder is readable without the index at its end. Formats:
MCAP format specification; ROS bag format 2.0; rosbag2_storage_sqlite3.
"""

import bz2
import sqlite3
import struct
import sys
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from lidarpose.errors import InputError
from lidarpose.io.files import FormatError, check_unpacked, file_error, shorten, unreadable

_ZSTD = b"\x28\xb5\x2f\xfd"
_CUT_OFF = "is cut off: the part before the cut is read, if there is any"
# maximum bytes of a message in SQLite, and of a decompressed message
_MAX_MESSAGE = 2**28

_TABLES = "SELECT COUNT(*) FROM sqlite_master WHERE type = 'table' AND name IN ('messages', 'topics')"
_MESSAGES = "messages JOIN topics ON topic_id = topics.id"


class Message(NamedTuple):
    """A message as stored. time: ns, when it was recorded."""

    topic: str
    time: int
    data: bytes


@dataclass
class Topic:
    """type: name of the message type; encoding: "cdr", "ros1" or another; count: number of messages."""

    type: str
    encoding: str
    count: int = 0


def unpack(data: bytes, compression: str, size: int) -> bytes:
    """Unpacks a chunk to at most `size` bytes, or fewer if `data` is cut off. Raises FormatError."""
    decompressor: Any
    if compression == "bz2":
        decompressor = bz2.BZ2Decompressor()
    elif compression == "lz4":
        from lz4.frame import LZ4FrameDecompressor

        decompressor = LZ4FrameDecompressor()
    elif compression == "zstd":
        # rosbags installs lz4 and backports.zstd
        zstd = import_module("compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd")
        decompressor = zstd.ZstdDecompressor()
    else:
        raise FormatError("compression by lz4, zstd or bz2", shorten(compression), "convert the recording")
    try:
        return decompressor.decompress(data, max_length=size)
    except Exception as error:
        raise FormatError(f"cannot be unpacked ({shorten(str(error))})") from None


def unpacked_message(data: bytes) -> bytes:
    """A message's bytes, decompressed if rosbag2 compressed them. One that cannot be decompressed stays as it is, and
    decoding it fails later."""
    if data.startswith(_ZSTD):
        with suppress(FormatError):
            return unpack(data, "zstd", _MAX_MESSAGE)
    return data


class _Bytes:
    """The next `left` bytes of a file; reading more raises FormatError before anything is allocated."""

    def __init__(self, file: BinaryIO, left: int):
        self.file, self.left = file, left

    def checked(self, size: int) -> int:
        if not 0 <= size <= self.left:
            raise FormatError(_CUT_OFF)
        return size

    def take(self, size: int) -> bytes:
        data = self.file.read(self.checked(size))
        if len(data) != size:
            raise FormatError(_CUT_OFF)
        self.left -= size
        return data

    def skip(self, size: int) -> None:
        self.file.seek(self.checked(size), 1)
        self.left -= size

    def number(self, kind: str) -> int:
        return struct.unpack("<" + kind, self.take(struct.calcsize("<" + kind)))[0]

    def text(self) -> str:
        return _text(self.take(self.number("I")))


class RecordFile(ABC):
    """A file of records, some of which are chunks of records.

    topics: by name; num_damaged, damage: number of chunks that could not be read since reading last began, and the
    reason.

    Raises:
        FormatError: The file has another format, or is damaged before its first topic.
    """

    MAGIC: bytes

    def __init__(self, path: Path):
        self.path = path
        self.topics: dict[str, Topic] = {}
        self.num_damaged, self.damage = 0, ""
        # names of topics by channel id, kept from the index: the chunk that names them may be damaged
        self._channels: dict[Any, str] = {}
        # only for MCAP: names of types by schema id
        self._schemas: dict[int, str] = {}
        with open(path, "rb") as file:
            if file.read(len(self.MAGIC)) != self.MAGIC:
                raise FormatError(f"is not a {path.suffix} file, despite its name; convert or rename it")
            if self._has_index(file):
                return
            try:
                for kind, topic, *_ in self._by_topic(file):
                    self.topics[topic].count += kind == "message"
            except FormatError:
                # ignored here: `messages` raises it again where the readable part ends
                if not self.topics:
                    raise FormatError("is cut off or damaged before its first message; record it again") from None

    def _has_index(self, file: BinaryIO) -> bool:
        """Reads the topics from the index at the end of the file. Returns whether the file has one."""
        try:
            start = self._index_start(file)
            for kind, topic, count, *_ in self._by_topic(file, start) if start else ():
                self.topics[topic].count += count if kind == "count" else 0
        except (FormatError, struct.error):
            self.topics.clear()
            self._channels.clear()
        return any(topic.count for topic in self.topics.values())

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """The messages of the given topics. Raises FormatError at a damaged position, after the messages before it."""
        self.num_damaged = 0
        with open(self.path, "rb") as file:
            for kind, topic, *content in self._by_topic(file):
                if kind == "message" and topic in topics:
                    time, size, stream = content
                    yield Message(topic, time, stream.take(size))

    def _by_topic(self, file: BinaryIO, start: int = 0) -> Iterator[tuple]:
        """Messages and counts of `_records` from byte `start` on, with the topic instead of the id. Fills `topics`."""
        start = start or len(self.MAGIC)
        size = file.seek(0, 2)
        file.seek(min(start, size))
        try:
            for kind, channel, *content in self._records(_Bytes(file, max(size - start, 0))):
                if kind == "channel":
                    self._channels[channel], *types = content
                    self.topics.setdefault(self._channels[channel], Topic(*types))
                elif channel in self._channels:
                    yield kind, self._channels[channel], *content
        except (struct.error, IndexError) as error:
            raise FormatError(f"is damaged ({error}): the part before the damage is read") from None

    def _chunk(self, stream: _Bytes, compression: str, size: int, unpacked_size: int) -> Iterator[tuple]:
        """The records of a chunk up to a damaged one; none if it cannot be unpacked."""
        is_cut = size > stream.left
        size, start = min(size, stream.left), stream.file.tell()
        chunk = _Bytes(stream.file, size)
        try:
            if compression not in ("", "none"):
                check_unpacked(size, unpacked_size)
                content = unpack(chunk.take(size), compression, unpacked_size)
                chunk = _Bytes(BytesIO(content), len(content))
            yield from self._records(chunk, is_chunk=True)
        except (FormatError, struct.error, IndexError) as problem:
            if not is_cut:
                reason = str(problem) if isinstance(problem, FormatError) else f"is damaged ({problem})"
                self.num_damaged, self.damage = self.num_damaged + 1, reason
        stream.file.seek(start)
        stream.skip(size)
        if is_cut:
            raise FormatError(_CUT_OFF)

    @abstractmethod
    def _index_start(self, file: BinaryIO) -> int:
        """The byte at which the index begins, 0 if there is none."""

    @abstractmethod
    def _records(self, stream: _Bytes, is_chunk: bool = False) -> Iterator[tuple]:
        """Records, also those in chunks: ("channel", id, topic, type, encoding), ("count", id, messages), and
        ("message", id, time ns, size, stream). Bytes that the caller does not take from the stream are skipped."""


class McapFile(RecordFile):
    MAGIC = b"\x89MCAP0\r\n"
    _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _STATISTICS, _DATA_END = 2, 3, 4, 5, 6, 11, 15

    def _index_start(self, file):
        # the footer record and the magic after it
        file.seek(max(file.seek(0, 2) - 37, 0))
        footer = file.read()
        is_whole = footer.endswith(self.MAGIC) and footer[0] == self._FOOTER
        return struct.unpack_from("<Q", footer, 9)[0] if is_whole else 0

    def _records(self, stream, is_chunk=False):
        while stream.left:
            op, size = stream.number("B"), stream.number("Q")
            bytes_after = stream.left - size
            if op in (self._FOOTER, self._DATA_END):
                return
            if op == self._CHUNK and not is_chunk:
                *_, unpacked_size, _ = struct.unpack("<QQQI", stream.take(28))
                compression, size = stream.text(), stream.number("Q")
                yield from self._chunk(stream, compression, size, unpacked_size)
                continue
            if op == self._SCHEMA:
                number = stream.number("H")
                self._schemas[number] = stream.text()
            elif op == self._CHANNEL:
                channel, schema = stream.number("H"), stream.number("H")
                yield "channel", channel, stream.text(), self._schemas.get(schema, "no type"), stream.text()
            elif op == self._STATISTICS:
                stream.take(42)
                for channel, count in struct.iter_unpack("<HQ", stream.take(stream.number("I"))):
                    yield "count", channel, count
            elif op == self._MESSAGE:
                channel, _, time, _ = struct.unpack("<HIQQ", stream.take(22))
                yield "message", channel, time, stream.checked(size - 22), stream
            stream.skip(stream.left - bytes_after)
        if not is_chunk:
            raise FormatError(_CUT_OFF)


class Ros1File(RecordFile):
    MAGIC = b"#ROSBAG V2.0\n"
    _MESSAGE, _BAG, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 5, 6, 7

    def _index_start(self, file):
        stream = _Bytes(file, file.seek(0, 2))
        file.seek(len(self.MAGIC))
        return int.from_bytes(_fields(stream.take(stream.number("I"))).get(b"index_pos", b""), "little")

    def _records(self, stream, is_chunk=False):
        while stream.left:
            header, size = _fields(stream.take(stream.number("I"))), stream.number("I")
            bytes_after = stream.left - size
            op, channel = header.get(b"op", b"\0")[0], header.get(b"conn")
            if op == self._CHUNK and not is_chunk:
                compression = _text(header.get(b"compression", b"none"))
                # a killed recorder leaves the size 0 in its last chunk: the records then follow as those of the file
                unpacked_size = int.from_bytes(header.get(b"size", b""), "little")
                yield from self._chunk(stream, compression, size, unpacked_size)
                continue
            if op == self._CONNECTION:
                type_ = _fields(stream.take(size)).get(b"type", b"no type")
                yield "channel", channel, _text(header.get(b"topic", b"")), _text(type_), "ros1"
            elif op == self._CHUNK_INFO:
                for channel, count in struct.iter_unpack("<4sI", stream.take(size)):
                    yield "count", channel, count
            elif op == self._MESSAGE:
                seconds, nanoseconds = struct.unpack("<II", header.get(b"time", b"")[:8].ljust(8, b"\0"))
                yield "message", channel, seconds * 10**9 + nanoseconds, stream.checked(size), stream
            stream.skip(stream.left - bytes_after)


def _text(data: bytes) -> str:
    return data.decode("utf-8", "replace")


def _fields(data: bytes) -> dict[bytes, bytes]:
    """The fields in the header of a ROS 1 record."""
    stream = _Bytes(BytesIO(data), len(data))
    fields = {}
    while stream.left:
        name, _, value = stream.take(stream.number("I")).partition(b"=")
        fields[name] = value
    return fields


class SqliteFile:
    """A file of rosbag2's SQLite storage. topics, num_damaged, damage, messages and errors: as in `RecordFile`."""

    def __init__(self, path: Path):
        self.path = path
        self.num_damaged, self.damage = 0, ""
        self.topics: dict[str, Topic] = {}
        # raises OSError for an unreadable file, which SQLite does not distinguish from a damaged one
        path.open("rb").close()
        try:
            with closing(self._connect()) as connection:
                self._read_topics(connection)
        except sqlite3.Error as error:
            raise FormatError(f"is not a rosbag2 recording ({shorten(str(error))}); record it again") from None

    def _read_topics(self, connection: sqlite3.Connection) -> None:
        tables = connection.execute(_TABLES).fetchone()[0]
        if tables != 2:
            raise FormatError("the tables messages and topics of rosbag2", f"{tables} of them", "record it again")
        for name, type_, encoding in connection.execute("SELECT name, type, serialization_format FROM topics"):
            self.topics[str(name)] = Topic(str(type_), str(encoding))
        counts = f"SELECT name, COUNT(*) FROM {_MESSAGES} GROUP BY name"
        # ignored here: `messages` reports a damaged file
        with suppress(sqlite3.Error):
            for name, count in connection.execute(counts):
                self.topics[str(name)].count = count

    def _connect(self) -> sqlite3.Connection:
        # immutable, so that SQLite writes nothing next to the file, unless the recorder left its journal (-wal)
        mode = "ro" if self.path.with_name(self.path.name + "-wal").exists() else "ro&immutable=1"
        # a recording may be opened in one thread and read further in another, but never in both at the same time
        address = f"{self.path.absolute().as_uri()}?mode={mode}"
        connection = sqlite3.connect(address, uri=True, check_same_thread=False)
        # otherwise SQLite rejects a file that is shorter than its header says
        connection.execute("PRAGMA writable_schema=ON")
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MAX_MESSAGE)
        connection.text_factory = _text
        return connection

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        placeholders = ", ".join("?" * len(topics))
        query = f"SELECT name, timestamp, data FROM {_MESSAGES} WHERE name IN ({placeholders}) ORDER BY messages.id"
        try:
            with closing(self._connect()) as connection:
                for name, time, data in connection.execute(query, tuple(topics)):
                    data = data if isinstance(data, bytes) else b""
                    yield Message(str(name), time if isinstance(time, int) else 0, data)
        except sqlite3.Error as error:
            raise FormatError(f"is damaged ({shorten(str(error))}): the part before the damage is read") from None


def all_messages(files: Iterable[RecordFile | SqliteFile], topics: set[str]) -> Iterator[Message]:
    """The messages of all files, in order. After a damaged position, reading continues with the next file; the last
    damage is raised at the end, as InputError."""
    damage: InputError | None = None
    for file in files:
        try:
            yield from file.messages(topics)
        except FormatError as problem:
            damage = file_error(file.path, problem)
        except OSError as error:
            damage = unreadable(file.path, error)
    if damage is not None:
        raise damage
