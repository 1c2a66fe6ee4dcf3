"""Messages of MCAP, ROS 1 bag and rosbag2's SQLite files, in the order of the file.

Files are walked from the front: what a killed recorder left is read without the index at its end. Formats: MCAP format
specification; ROS bag format 2.0; rosbag2_storage_sqlite3.
"""

import bz2
import sqlite3
import struct
import sys
from collections.abc import Collection, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from lidarpose.io.files import FormatError, check_unpacked, shorten

_ZSTD = b"\x28\xb5\x2f\xfd"
_CUT_OFF = "is cut off: what was recorded up to there is read"
# bytes of a message in SQLite, packed or not
_MAX_MESSAGE = 2**28

_TABLES = "SELECT COUNT(*) FROM sqlite_master WHERE type = 'table' AND name IN ('messages', 'topics')"
_MESSAGES = "messages JOIN topics ON topic_id = topics.id"


class Message(NamedTuple):
    """A message as it is stored. time: ns, when it was recorded."""

    topic: str
    time: int
    data: bytes


@dataclass
class Topic:
    """type: name of the messages' type; encoding: "cdr", "ros1" or another; count: messages."""

    type: str
    encoding: str
    count: int = 0


def unpack(data: bytes, compression: str, size: int) -> bytes:
    """A chunk unpacked to at most `size` bytes; to fewer where `data` is cut off. Raises FormatError."""
    decompressor: Any
    if compression == "bz2":
        decompressor = bz2.BZ2Decompressor()
    elif compression == "lz4":
        from lz4.frame import LZ4FrameDecompressor

        decompressor = LZ4FrameDecompressor()
    elif compression == "zstd":
        # both come with rosbags
        zstd = import_module("compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd")
        decompressor = zstd.ZstdDecompressor()
    else:
        raise FormatError("compression by lz4, zstd or bz2", shorten(compression), "convert the recording")
    try:
        return decompressor.decompress(data, max_length=size)
    except Exception as error:
        raise FormatError(f"cannot be unpacked ({shorten(str(error))})") from None


class _Bytes:
    """Bytes of a file up to an end; none are asked for that are not there."""

    def __init__(self, file: BinaryIO, left: int):
        self.file, self.left = file, left

    def take(self, size: int) -> bytes:
        data = self.file.read(size) if 0 <= size <= self.left else b""
        if len(data) != size:
            raise FormatError(_CUT_OFF)
        self.left -= size
        return data

    def skip(self, size: int) -> None:
        if not 0 <= size <= self.left:
            raise FormatError(_CUT_OFF)
        self.file.seek(size, 1)
        self.left -= size

    def number(self, kind: str) -> int:
        return struct.unpack("<" + kind, self.take(struct.calcsize("<" + kind)))[0]

    def text(self) -> str:
        return self.take(self.number("I")).decode("utf-8", "replace")


class RecordFile:
    """A file of records, some of which are chunks of records.

    topics: by name; num_damaged, damage: chunks that could not be unpacked since reading last began, and why.

    Raises:
        FormatError: Another file, or damaged before its first topic.
    """

    MAGIC: bytes

    def __init__(self, path: Path):
        self.path = path
        self.topics: dict[str, Topic] = {}
        self.num_damaged, self.damage = 0, ""
        with open(path, "rb") as file:
            if file.read(len(self.MAGIC)) != self.MAGIC:
                raise FormatError(f"is no {path.suffix} file, though its name says so; convert or rename it")
            with suppress(FormatError, struct.error):
                if self._read_index(file, path.stat().st_size):
                    return
            self.topics.clear()
            try:
                for topic, *_ in self._walk(self._stream(file)):
                    self.topics[topic].count += 1
            except FormatError:
                # told where the messages end
                if not self.topics:
                    raise FormatError("is cut off or damaged before its first message; record it anew") from None

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """Those of some topics. Raises FormatError where the file is damaged; what is before it has come."""
        self.num_damaged = 0
        with open(self.path, "rb") as file:
            for topic, time, size, stream in self._walk(self._stream(file)):
                if topic in topics:
                    yield Message(topic, time, stream.take(size))

    def _stream(self, file: BinaryIO, start: int = 0) -> _Bytes:
        """The file from the first record on, or from another one."""
        start = start or len(self.MAGIC)
        size = file.seek(0, 2)
        file.seek(start)
        return _Bytes(file, max(size - start, 0))

    def _unpacked(self, stream: _Bytes, compression: str, size: int, unpacked: int) -> Iterator[tuple]:
        """The records of a compressed chunk. One that cannot be unpacked costs itself."""
        is_cut = size > stream.left
        packed = stream.take(min(size, stream.left))
        try:
            check_unpacked(len(packed), unpacked)
            content = unpack(packed, compression, unpacked)
            yield from self._records(_Bytes(BytesIO(content), len(content)), is_chunk=True)
        except FormatError as problem:
            if not is_cut:
                self.num_damaged, self.damage = self.num_damaged + 1, str(problem)
        if is_cut:
            raise FormatError(_CUT_OFF)

    def _read_index(self, file: BinaryIO, size: int) -> bool:
        """Fills `topics` from the index at the end; False if there is none."""
        raise NotImplementedError

    def _records(self, stream: _Bytes, is_chunk: bool = False) -> Iterator[tuple]:
        """(kind, what its header says, size, stream) of each record, those of chunks too. What of the `size` bytes is
        not taken from the stream is skipped."""
        raise NotImplementedError

    def _walk(self, stream: _Bytes) -> Iterator[tuple[str, int, int, _Bytes]]:
        """(topic, time, size, stream) of each message, whose data may be taken from the stream."""
        raise NotImplementedError


class McapFile(RecordFile):
    MAGIC = b"\x89MCAP0\r\n"
    _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _STATISTICS, _DATA_END = 2, 3, 4, 5, 6, 11, 15

    def _read_index(self, file, size):
        # the footer, and the magic after it
        file.seek(max(size - 37, 0))
        footer = file.read()
        if not footer.endswith(self.MAGIC) or footer[0] != self._FOOTER:
            return False
        start = struct.unpack_from("<Q", footer, 9)[0]
        schemas: dict[int, str] = {}
        channels: dict[int, str] = {}
        for op, _, stream in self._records(self._stream(file, start)) if 0 < start < size else ():
            self._learn(op, stream, schemas, channels)
            if op == self._STATISTICS:
                stream.take(42)
                for channel, count in struct.iter_unpack("<HQ", stream.take(stream.number("I"))):
                    if channel in channels:
                        self.topics[channels[channel]].count += count
                return True
        return False

    def _records(self, stream, is_chunk=False):
        while stream.left:
            op, size = stream.number("B"), stream.number("Q")
            if op in (self._FOOTER, self._DATA_END):
                return
            if op == self._CHUNK and not is_chunk:
                stream.take(16)
                unpacked, _, compression, size = (
                    stream.number("Q"),
                    stream.number("I"),
                    stream.text(),
                    stream.number("Q"),
                )
                # records of a chunk that is not compressed follow as others do
                if compression:
                    yield from self._unpacked(stream, compression, size, unpacked)
                continue
            left = stream.left - size
            yield op, size, stream
            stream.skip(stream.left - left)
        if not is_chunk:
            raise FormatError(_CUT_OFF)

    def _learn(self, op: int, stream: _Bytes, schemas: dict[int, str], channels: dict[int, str]) -> None:
        """Takes a schema or a channel."""
        if op == self._SCHEMA:
            number = stream.number("H")
            schemas[number] = stream.text()
        elif op == self._CHANNEL:
            number, schema, topic, encoding = stream.number("H"), stream.number("H"), stream.text(), stream.text()
            channels[number] = topic
            self.topics.setdefault(topic, Topic(schemas.get(schema, "no type"), encoding))

    def _walk(self, stream):
        schemas: dict[int, str] = {}
        channels: dict[int, str] = {}
        for op, size, inner in self._records(stream):
            self._learn(op, inner, schemas, channels)
            if op == self._MESSAGE:
                channel, _, time, _ = struct.unpack("<HIQQ", inner.take(22))
                if channel in channels:
                    yield channels[channel], time, size - 22, inner


class Ros1File(RecordFile):
    MAGIC = b"#ROSBAG V2.0\n"
    _MESSAGE, _BAG, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 5, 6, 7

    def _read_index(self, file, size):
        _, header, *_ = next(self._records(self._stream(file)), (0, {}))
        start = int.from_bytes(header.get(b"index_pos", b""), "little")
        if not 0 < start < size:
            return False
        connections: dict[bytes, str] = {}
        for op, header, size, stream in self._records(self._stream(file, start)):
            self._learn(op, header, size, stream, connections)
            if op == self._CHUNK_INFO:
                for connection, count in struct.iter_unpack("<4sI", stream.take(size)):
                    if connection in connections:
                        self.topics[connections[connection]].count += count
        return True

    def _records(self, stream, is_chunk=False):
        while stream.left:
            header, size = _fields(stream.take(stream.number("I"))), stream.number("I")
            op = header.get(b"op", b"\0")[0]
            if op == self._CHUNK and not is_chunk:
                # records of a chunk that is not compressed follow as others do
                compression = header.get(b"compression", b"none").decode("latin-1")
                if compression != "none":
                    unpacked = int.from_bytes(header.get(b"size", b""), "little")
                    yield from self._unpacked(stream, compression, size, unpacked)
                continue
            left = stream.left - size
            yield op, header, size, stream
            stream.skip(stream.left - left)

    def _learn(self, op: int, header: dict, size: int, stream: _Bytes, connections: dict[bytes, str]) -> None:
        """Takes a connection."""
        if op == self._CONNECTION:
            topic = header.get(b"topic", b"").decode("utf-8", "replace")
            type_ = _fields(stream.take(size)).get(b"type", b"no type").decode("utf-8", "replace")
            connections[header.get(b"conn", b"")] = topic
            self.topics.setdefault(topic, Topic(type_, "ros1"))

    def _walk(self, stream):
        connections: dict[bytes, str] = {}
        for op, header, size, inner in self._records(stream):
            self._learn(op, header, size, inner, connections)
            topic = connections.get(header.get(b"conn", b""))
            if op == self._MESSAGE and topic is not None:
                seconds, nanoseconds = struct.unpack("<II", header.get(b"time", b"").ljust(8, b"\0")[:8])
                yield topic, seconds * 10**9 + nanoseconds, size, inner


def _fields(data: bytes) -> dict[bytes, bytes]:
    """The fields of a ROS 1 record's header."""
    stream = _Bytes(BytesIO(data), len(data))
    fields = {}
    while stream.left:
        name, _, value = stream.take(stream.number("I")).partition(b"=")
        fields[name] = value
    return fields


class SqliteFile:
    """A file of rosbag2's SQLite storage. topics, num_damaged, damage, messages and errors: as of `RecordFile`."""

    def __init__(self, path: Path):
        self.path = path
        self.num_damaged, self.damage = 0, ""
        self.topics: dict[str, Topic] = {}
        with closing(self._connect()) as connection:
            try:
                tables = connection.execute(_TABLES).fetchone()[0]
                if tables != 2:
                    raise FormatError(
                        "the tables messages and topics of rosbag2", f"{tables} of them", "record it anew"
                    )
                for name, type_, encoding in connection.execute("SELECT name, type, serialization_format FROM topics"):
                    self.topics[str(name)] = Topic(str(type_), str(encoding))
            except sqlite3.Error as error:
                raise FormatError(f"is no recording of rosbag2 ({shorten(str(error))}); record it anew") from None
            counts = f"SELECT name, COUNT(*) FROM {_MESSAGES} GROUP BY name"
            # of a damaged file the messages tell
            with suppress(sqlite3.Error):
                for name, count in connection.execute(counts):
                    self.topics[str(name)].count = count

    def _connect(self) -> sqlite3.Connection:
        # unless a recorder left its journal, nothing is written beside the file
        mode = "ro" if self.path.with_name(self.path.name + "-wal").exists() else "ro&immutable=1"
        connection = sqlite3.connect(f"{self.path.absolute().as_uri()}?mode={mode}", uri=True)
        # a file that is shorter than its header says is refused otherwise
        connection.execute("PRAGMA writable_schema=ON")
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MAX_MESSAGE)
        connection.text_factory = lambda text: text.decode("utf-8", "replace")
        return connection

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        marks = ", ".join("?" * len(topics))
        query = f"SELECT name, timestamp, data FROM {_MESSAGES} WHERE name IN ({marks}) ORDER BY messages.id"
        try:
            with closing(self._connect()) as connection:
                for name, time, data in connection.execute(query, tuple(topics)):
                    data = data if isinstance(data, bytes) else b""
                    if data.startswith(_ZSTD):
                        # what cannot be unpacked cannot be decoded either
                        with suppress(FormatError):
                            data = unpack(data, "zstd", _MAX_MESSAGE)
                    yield Message(str(name), time if isinstance(time, int) else 0, data)
        except sqlite3.Error as error:
            raise FormatError(f"is damaged ({shorten(str(error))}): what is before that is read") from None
