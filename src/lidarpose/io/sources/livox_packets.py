"""Captured packets of Livox sensors as frames of a tenth of a second.

Formats: Livox SDK Communication Protocol of the Mid-360 and the HAP, and of the sensors before them (Mid-40, Mid-70,
Avia, Horizon, Tele-15); all numbers are little-endian.
"""

import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from lidarpose.io.sources.frame import Sweep
from lidarpose.io.sources.lvx import DURATION, VERSIONS, decode_points
from lidarpose.io.sources.pcap import Datagram, PacketRecording

# headers: of the first protocol (version, data type), and of the second (version, bytes, number of points, data type)
_FIRST, _SECOND = struct.Struct("<B8xB8x"), struct.Struct("<BH2xH3xB25x")
# more packets than a sensor sends in a frame; version that packets of the first protocol state
_MOST_PACKETS = 2000
_FIRST_VERSION = 5


def points_layout(payload: bytes) -> tuple[int, np.dtype] | None:
    """The place of a packet's points and their layout; None for other packets."""
    if len(payload) <= _SECOND.size:
        return None
    version, kind = _FIRST.unpack_from(payload)
    layout = VERSIONS[1].layouts.get(kind)
    if version == _FIRST_VERSION and layout is not None:
        if len(payload) == _FIRST.size + VERSIONS[1].counts[kind] * layout.itemsize:
            return _FIRST.size, layout
    version, size, count, kind = _SECOND.unpack_from(payload)
    layout = VERSIONS[2].layouts.get(kind)
    if version == 0 and layout is not None and size == len(payload) == _SECOND.size + count * layout.itemsize:
        return _SECOND.size, layout
    return None


class LivoxRecording(PacketRecording):
    """A capture of a Livox sensor's packets; a frame's time is the time of capture."""

    def sweeps(self) -> Iterator[tuple[float, Callable[[], Sweep]]]:
        payloads: list[bytes] = []
        start = 0.0
        for packet in self.packets():
            if points_layout(packet.payload) is None:
                continue
            # a jump back in time begins a frame, too, as do more packets than a sensor sends, if times are not known
            if payloads and (not start <= packet.time < start + DURATION or len(payloads) >= _MOST_PACKETS):
                yield start, partial(_sweep, payloads)
                payloads = []
            start = start if payloads else packet.time
            payloads.append(packet.payload)
        if payloads:
            yield start, partial(_sweep, payloads)


def recording_of(path: Path, packets: Iterable[Datagram]) -> LivoxRecording | None:
    """The recording of the sensor that sent the first packet of points among the first packets of a capture, or None
    without any."""
    first_packet = next((packet for packet in packets if points_layout(packet.payload) is not None), None)
    if first_packet is None:
        return None
    recording = LivoxRecording(path, len(first_packet.payload))
    recording.flow = first_packet.flow
    return recording


def _sweep(payloads: Sequence[bytes]) -> Sweep:
    clouds = []
    for payload in payloads:
        if (place_and_layout := points_layout(payload)) is not None:
            place, layout = place_and_layout
            clouds.append(decode_points(np.frombuffer(payload, layout, offset=place)))
    return Sweep(points=np.concatenate(clouds), origin=np.zeros(3))
