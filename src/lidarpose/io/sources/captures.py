"""Packet captures of all sensors: which sensor's packets a file has."""

from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import NoReturn

from lidarpose.errors import InputError
from lidarpose.io.files import file_error
from lidarpose.io.sources.frame import ReadingOptions
from lidarpose.io.sources.livox_packets import recording_of
from lidarpose.io.sources.ouster import OusterRecording
from lidarpose.io.sources.pcap import Capture, Datagram, PacketRecording
from lidarpose.io.sources.velodyne import PACKET_BYTES, VelodyneRecording

# first bytes of other vendors' packets with points
_OTHERS = {"Hesai": b"\xee\xff", "RoboSense": b"\x55\xaa"}
# number of packets that are searched for those of a known sensor
_NUM_TRIED = 2000


def open_recording(path: Path, options: ReadingOptions) -> PacketRecording:
    """Opens a capture of an Ouster sensor, or, if there is no metadata, of a Livox or Velodyne sensor.

    The Ouster metadata is the JSON file `meta`, else the one next to the capture with the same stem, or with the number
    that Ouster's recorder appends (STEM_0.json).

    Raises:
        InputError: The file is not a capture, is of another sensor, or is of an Ouster sensor without metadata.
        MissingExtra: The capture is of a Velodyne sensor, and the library that decodes it is not installed.
    """
    recording = _open(path, options.meta)
    recording.notes += options.ignored("topic")
    return recording


def _open(path: Path, meta: Path | None) -> PacketRecording:
    if meta is not None:
        return OusterRecording(path, meta)
    metadata_paths = (path.with_suffix(".json"), path.with_name(f"{path.stem}_0.json"))
    metadata = next((file for file in metadata_paths if file.exists()), None)
    if metadata is None:
        packets = _first_packets(path)
        return _without_metadata(path, packets) or _refuse(path, packets)
    try:
        return OusterRecording(path, metadata)
    except InputError:
        # the JSON file may belong to something else
        if (recording := _without_metadata(path, _first_packets(path))) is not None:
            return recording
        raise


def _first_packets(path: Path) -> list[Datagram]:
    """Raises InputError if the capture is damaged before its first datagram."""
    packets: list[Datagram] = []
    try:
        packets += islice(Capture(path), _NUM_TRIED)
    except InputError:
        if not packets:
            raise
    return packets


def _without_metadata(path: Path, packets: Sequence[Datagram]) -> PacketRecording | None:
    """The recording of a sensor whose packets need no metadata; None if no such sensor sent the first packets."""
    # Livox first: a Velodyne's packets have nothing but their size in common
    if (recording := recording_of(path, packets)) is not None:
        return recording
    return VelodyneRecording(path) if any(len(packet.payload) == PACKET_BYTES for packet in packets) else None


def _refuse(path: Path, packets: Sequence[Datagram]) -> NoReturn:
    payloads = [packet.payload for packet in packets]
    if not payloads:
        raise file_error(path, "has no UDP packets; expected packets of an Ouster, Velodyne or Livox sensor")
    for vendor, preamble in _OTHERS.items():
        if sum(payload.startswith(preamble) for payload in payloads) > len(payloads) / 4:
            problem = f"has packets of a {vendor} sensor; expected those of an Ouster, Velodyne or Livox sensor"
            raise file_error(path, f"{problem}: convert it to a ROS bag with {vendor}'s driver, or to .pcd files")
    problem = f"an Ouster recording needs its metadata {path.stem}.json beside it, or another file as --meta (meta=)"
    sizes = f"(a Velodyne's packets have {PACKET_BYTES} bytes, these have up to {max(map(len, payloads))})"
    raise file_error(path, f"{problem} {sizes}")
