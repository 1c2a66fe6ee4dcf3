"""UDP datagrams in packet captures: pcap of either byte order and time resolution, and pcapng.

Formats: draft-ietf-opsawg-pcap, draft-ietf-opsawg-pcapng, RFC 791 and 8200 (fragments), RFC 768.
"""

import os
import struct
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple, Protocol

from lidarpose.errors import InputError
from lidarpose.io.files import FormatError, file_error, unreadable
from lidarpose.io.sources.frame import LazyFrame, Sweep

# magic of a pcap file: byte order, ticks per second
_MAGIC = {
    b"\xd4\xc3\xb2\xa1": ("<", 1e6),
    b"\xa1\xb2\xc3\xd4": (">", 1e6),
    b"\x4d\x3c\xb2\xa1": ("<", 1e9),
    b"\xa1\xb2\x3c\x4d": (">", 1e9),
}
_PCAPNG = b"\x0a\x0d\x0d\x0a"
# descriptions of interfaces and packets; other blocks hold names, keys and notes
_READ_BLOCKS = (1, 6)
# bytes; captures have no larger packets
_MAX_PACKET = 2**20
# maximum number of incomplete datagrams that wait for fragments, and maximum bytes of a datagram
_MAX_PENDING, _MAX_DATAGRAM = 64, 65535
# fragments further apart, s, are of two datagrams, whose numbers repeat after a minute or less. Source: RFC 791
_MAX_AGE = 15.0
_VLAN = (0x8100, 0x88A8, 0x9100)
# link type: offset of the EtherType in its header, and the header's length; raw IP has no header
_ETHERNET = 1
_LINKS = {_ETHERNET: (12, 14), 113: (14, 16), 276: (0, 20), 0: (None, 4), 108: (None, 4), 101: (None, 0)}
_LINKS |= dict.fromkeys((12, 14, 228, 229), (None, 0))
_IP = (0x0800, 0x86DD)


class Datagram(NamedTuple):
    """The payload of one UDP datagram. time: s, of the capture; flow: source address and destination port."""

    time: float
    flow: tuple[bytes, int]
    payload: bytes


class Capture:
    """The UDP datagrams of a capture, iterable repeatedly.

    num_cut: number of datagrams that were captured only in part or without all fragments, since iterating last began.

    Raises:
        InputError: The file is not a capture; while iterating, where the file is cut off or damaged.
    """

    def __init__(self, path: Path):
        self.path = path
        self.num_cut = 0
        with self._open() as file:
            magic = file.read(4)
        if magic not in _MAGIC and magic != _PCAPNG:
            raise file_error(path, "is not a packet capture: expected pcap or pcapng, saved by tcpdump or Wireshark")
        self._read = _read_pcapng if magic == _PCAPNG else _read_pcap

    def _open(self) -> BinaryIO:
        try:
            return open(self.path, "rb")
        except OSError as error:
            raise unreadable(self.path, error) from None

    def __iter__(self) -> Iterator[Datagram]:
        self.num_cut = 0
        # time of the first fragment, and by offset the fragments and whether others follow
        pending: dict[tuple, tuple[float, dict[int, tuple[bytes, bool]]]] = {}
        damage = None
        with self._open() as file:
            try:
                for time, link, packet in self._read(file):
                    datagram = self._datagram(time, _ip_packet(packet, link), pending)
                    if datagram is not None:
                        yield datagram
            except FormatError as problem:
                damage = file_error(self.path, problem)
        self.num_cut += len(pending)
        if damage is not None:
            raise damage

    def _datagram(self, time: float, ip: memoryview, pending: dict) -> Datagram | None:
        """The datagram that a packet contains or completes, or None."""
        part = _udp_part(ip)
        if part is None:
            return None
        source, key, offset, has_more, data, length = part
        if len(data) >= length:
            if offset or has_more:
                data = self._reassembled(time, key, offset, has_more, bytes(data), pending)
            if len(data) < 8:
                return None
            _, port, size = struct.unpack_from(">HHH", data)
            # segmentation offload leaves the size 0; in some captures it is that of the first fragment only
            size = len(data) if not size or ((offset or has_more) and size < len(data)) else size
            if size <= len(data):
                return Datagram(time, (source, port), bytes(data[8:size]))
        self.num_cut += 1
        return None

    def _reassembled(self, time: float, key: tuple, offset: int, has_more: bool, data: bytes, pending: dict) -> bytes:
        """The whole datagram if this fragment was the last missing one, else empty bytes."""
        first_time, parts = pending.setdefault(key, (time, {}))
        if abs(time - first_time) > _MAX_AGE:
            # another datagram with the same number, after a fragment of the first one was lost
            self.num_cut += 1
            parts = {}
            pending[key] = time, parts
        parts[offset] = data, has_more
        size = sum(len(part) for part, _ in parts.values())
        last_offset = max(parts)
        last, has_more = parts[last_offset]
        if not has_more and last_offset + len(last) == size <= _MAX_DATAGRAM:
            del pending[key]
            return b"".join(parts[offset][0] for offset in sorted(parts))
        if size > _MAX_DATAGRAM or len(pending) > _MAX_PENDING:
            # fragments overlap, or the oldest datagram is given up
            pending.pop(key if size > _MAX_DATAGRAM else next(iter(pending)))
            self.num_cut += 1
        return b""


class Datagrams(Protocol):
    """Recorded datagrams. num_cut: number of those that cannot be read, after iteration. Iteration raises InputError
    behind the last readable datagram of a damaged recording."""

    @property
    def num_cut(self) -> int: ...

    def __iter__(self) -> Iterator[Datagram]: ...


class PacketRecording(ABC):
    """A capture of one sensor's packets. A `Recording`; a frame is one revolution of the sensor.

    Args:
        path: the capture.
        packet_bytes: the size of the sensor's packets; by default those of the first flow with this size are read.
        datagrams: the packets if `path` is another recording.

    notes: warnings about how it was opened.
    """

    count = None

    def __init__(self, path: Path, packet_bytes: int, datagrams: Datagrams | None = None):
        self.name = str(path)
        self.capture: Datagrams = Capture(path) if datagrams is None else datagrams
        self.packet_bytes = packet_bytes
        self.flow: tuple[bytes, int] | None = None
        self.num_other = 0
        self.notes: list[str] = []
        self._damage: InputError | None = None

    @abstractmethod
    def sweeps(self) -> Iterator[tuple[float, Callable[[], Sweep]]]:
        """The time, s, of each revolution and a function that decodes it."""

    def packets(self) -> Iterator[Datagram]:
        """The sensor's packets, as far as the capture can be read."""
        self.num_other, self._damage, flow = 0, None, self.flow
        try:
            for datagram in self.capture:
                if len(datagram.payload) == self.packet_bytes:
                    flow = flow or datagram.flow
                    if datagram.flow == flow:
                        yield datagram
                    else:
                        self.num_other += 1
        except InputError as error:
            self._damage = error

    @property
    def warnings(self) -> list[str]:
        counts = {
            "packets are captured only in part and are left out": self.capture.num_cut,
            "lidar packets of another sensor are left out": self.num_other,
        }
        return self.notes + [f"{count} {problem}" for problem, count in counts.items() if count]

    def lazy_frames(self, first: int = 0) -> Iterator[LazyFrame]:
        for index, (time, decode) in enumerate(self.sweeps()):
            if index >= first:
                yield LazyFrame(f"{index:06d}", time, decode)
        if self._damage is not None:
            raise self._damage


def _take(file: BinaryIO, size: int) -> bytes:
    if not 0 <= size <= _MAX_PACKET:
        raise FormatError(f"is damaged at byte {file.tell()}: a packet of {size} bytes")
    data = file.read(size)
    if len(data) < size:
        raise FormatError("is cut off: the part before the cut is read")
    return data


def _skip(file: BinaryIO, size: int) -> None:
    start = file.tell()
    if size < 0:
        raise FormatError(f"is damaged at byte {start}: a block of {size} bytes")
    if start + size > file.seek(0, os.SEEK_END):
        raise FormatError("is cut off: the part before the cut is read")
    file.seek(start + size)


def _read_pcap(file: BinaryIO) -> Iterator[tuple[float, int, bytes]]:
    """(time, link type, packet) of each record."""
    order, ticks = _MAGIC[_take(file, 4)]
    link = struct.unpack(order + "I", _take(file, 20)[16:])[0] & 0xFFFF
    _check_link(link)
    while file.peek(1):  # type: ignore[attr-defined]
        seconds, fraction, size, _ = struct.unpack(order + "4I", _take(file, 16))
        yield seconds + fraction / ticks, link, _take(file, size)


def _read_pcapng(file: BinaryIO) -> Iterator[tuple[float, int, bytes]]:
    order = "<"
    # link type, ticks per second and offset, s, of each interface
    interfaces: list[tuple[int, float, int]] = []
    while file.peek(1):  # type: ignore[attr-defined]
        kind = _take(file, 4)
        if kind == _PCAPNG:
            size, magic = _take(file, 4), _take(file, 4)
            order = "<" if magic == b"\x4d\x3c\x2b\x1a" else ">"
            interfaces = []
            _take(file, struct.unpack(order + "I", size)[0] - 12)
            continue
        (size,) = struct.unpack(order + "I", _take(file, 4))
        (number,) = struct.unpack(order + "I", kind)
        if number not in _READ_BLOCKS:
            _skip(file, size - 8)
            continue
        body = _take(file, size - 8)[:-4]
        if number == 1 and len(body) >= 8:
            link = struct.unpack_from(order + "H", body)[0]
            interfaces.append((link, *_clock(body[8:], order)))
        elif number == 6 and len(body) >= 20:
            interface, high, low, size, _ = struct.unpack_from(order + "5I", body)
            if interface < len(interfaces):
                link, ticks, offset = interfaces[interface]
                if link in _LINKS:
                    yield offset + (high * 2**32 + low) / ticks, link, body[20 : 20 + size]
                elif not any(other in _LINKS for other, *_ in interfaces):
                    _check_link(link)


def _clock(options: bytes, order: str) -> tuple[float, int]:
    """Ticks per second and offset, s, of an interface's times, from its options."""
    ticks, seconds, position = 1e6, 0, 0
    while position + 5 <= len(options):
        code, size = struct.unpack_from(order + "HH", options, position)
        if code == 9:
            value = options[position + 4]
            ticks = 2.0 ** (value & 127) if value & 128 else 10.0**value
        elif code == 14 and position + 12 <= len(options):
            (seconds,) = struct.unpack_from(order + "q", options, position + 4)
        position += 4 + (size + 3) // 4 * 4
    return ticks, seconds


def _check_link(link: int) -> None:
    if link not in _LINKS:
        raise FormatError(
            "a capture of Ethernet, Linux cooked or raw IP packets", f"link type {link}", "capture it again"
        )


def _ip_packet(packet: bytes, link: int) -> memoryview:
    """The IP packet in a link-layer packet; empty if that has another content."""
    type_offset, start = _LINKS[link]
    view = memoryview(packet)
    if type_offset is not None:
        kind = int.from_bytes(view[type_offset : type_offset + 2])
        while kind in _VLAN:
            kind = int.from_bytes(view[start + 2 : start + 4])
            start += 4
        if kind not in _IP:
            return view[:0]
    return view[start:]


def _udp_part(ip: memoryview):
    """(source, key, offset, whether more fragments follow, data, data length in the header) of an IP packet with UDP,
    else None."""
    version = ip[0] >> 4 if ip else 0
    if version == 4 and len(ip) >= 20:
        start, kind, addresses = (ip[0] & 15) * 4, ip[9], bytes(ip[12:20])
        total, number, flags = struct.unpack_from(">HHH", ip, 2)
        # network cards with segmentation offload leave the length 0
        total = total or len(ip)
        offset, has_more = (flags & 0x1FFF) * 8, bool(flags & 0x2000)
    elif version == 6 and len(ip) >= 40:
        start, kind, addresses = 40, ip[6], bytes(ip[8:40])
        total = 40 + int.from_bytes(ip[4:6])
        offset, has_more, number = 0, False, 0
        if kind == 44 and len(ip) >= 48:
            kind, flags, number = ip[40], *struct.unpack_from(">HI", ip, 42)
            start, offset, has_more = 48, flags & 0xFFF8, bool(flags & 1)
    else:
        return None
    if kind != 17 or start < 20:
        return None
    return addresses[: len(addresses) // 2], (addresses, number), offset, has_more, ip[start:total], total - start
