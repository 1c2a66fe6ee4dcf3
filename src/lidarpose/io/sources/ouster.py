"""Packets of Ouster sensors as frames, decoded with the published packet formats and the sensor's metadata.

Formats and geometry: Ouster firmware user manual, "Lidar Data" and "Coordinate Frames and XYZ Calculation". With dual
returns, the first return of each pixel is used.
"""

import json
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose.errors import InputError
from lidarpose.io.files import FormatError, file_error, read_bytes, shorten
from lidarpose.io.sources.frame import Sweep
from lidarpose.io.sources.pcap import Datagram, Datagrams, PacketRecording

# bytes of a pixel, by profile. The range comes first: for RNG15 in 15 bits and steps of 8 mm, for others in 19 bits
# (LEGACY 20) and mm
_PIXEL_BYTES = {
    "LEGACY": 12,
    "RNG19_RFL8_SIG16_NIR16": 12,
    "RNG19_RFL8_SIG16_NIR16_DUAL": 16,
    "RNG19_RFL8_SIG16_NIR16_ZONE16": 12,
    "RNG19_RFL8_SIG16_ZONE16_DUAL": 16,
    "RNG19_RFL8_SIG16_NIR16_RGB16": 16,
    "RNG19_RFL8_SIG16_NIR16_RGB16_DUAL": 20,
    "RNG15_RFL8_NIR8": 4,
    "RNG15_RFL8_NIR8_DUAL": 8,
    "RNG15_RFL8_NIR8_ZONE16": 8,
    "RNG15_RFL8_WIN8": 4,
    "FUSA_RNG15_RFL8_NIR8_DUAL": 8,
}
# ROS packages of the driver, of different versions
_PACKAGES = ("ouster_sensor_msgs", "ouster_ros")
_MAX_COLUMNS, _MAX_BEAMS, _MAX_PACKET, _MAX_NUMBER = 4096, 256, 65507, 1e9
# lidar_to_sensor_transform, mm, of sensors whose metadata does not contain it
_LIDAR_TO_SENSOR = (-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 36.18, 0, 0, 0, 1)
# lidar_origin_to_beam_origin_mm of sensors whose metadata does not contain it, by product line, and of others
_BEAM_ORIGINS, _BEAM_ORIGIN = {"OS-0-": 27.67, "OS-1-": 15.806, "OS-2-": 13.762}, 12.163
_COLUMNS_PER_PACKET = 16
# messages of the ROS driver, each with one packet
PACKET_TYPES = tuple(f"{package}/{folder}PacketMsg" for package in _PACKAGES for folder in ("msg/", ""))
PACKET_DEFINITION = "uint8[] buf"
# number of datagrams that are searched for the port in the metadata
_NUM_PEEKED = 2000


class OusterFormat:
    """The layout of a sensor's packets and the directions of its beams, from the sensor's metadata: a JSON file, or its
    content.

    columns: columns of a frame; columns_per_packet: columns of a packet; beams: beams of a column; window: first and
    last column that is sent; serial: the sensor's serial number or None; packet: dtype of a packet with `columns`, each
    with `time` ns, `id`, `status` and `pixels` (beams,), which have a `range`.

    Raises:
        InputError: The file is not a sensor's metadata.
    """

    def __init__(self, path: Path, content: bytes | str | None = None):
        data = read_bytes(path, expected="the sensor's metadata (JSON)", most=2**24) if content is None else content
        try:
            metadata = json.loads(data)
            if not isinstance(metadata, dict):
                raise FormatError("an object", type(metadata).__name__, "save the sensor's metadata again")
            self._parse(_flat(metadata))
        except FormatError as problem:
            raise file_error(path, problem) from None
        except (ValueError, TypeError, OverflowError, RecursionError) as error:
            reason = shorten(str(error))
            raise file_error(path, f"cannot be read as an Ouster sensor's metadata ({reason}); save it again") from None

    def _parse(self, metadata: dict[str, Any]) -> None:
        altitude, azimuth = (
            np.deg2rad(_numbers(metadata, f"beam_{name}_angles")).ravel() for name in ("altitude", "azimuth")
        )
        self.beams = len(altitude)
        mode = str(metadata.get("lidar_mode", "")).partition("x")[0]
        self.columns = _whole(metadata, "columns_per_frame", _MAX_COLUMNS, mode)
        self.columns_per_packet = _whole(metadata, "columns_per_packet", _MAX_COLUMNS, _COLUMNS_PER_PACKET)
        pixels = _whole(metadata, "pixels_per_column", _MAX_BEAMS, self.beams)
        if not len(altitude) == len(azimuth) == pixels:
            actual = f"{len(altitude)} altitudes and {len(azimuth)} azimuths"
            raise FormatError(f"beam angles of {pixels} beams", actual, "save the sensor's metadata again")
        first, last = metadata.get("column_window") or (0, self.columns - 1)
        self.window = min(max(int(first), 0), self.columns - 1), min(max(int(last), 0), self.columns - 1)
        self.port, self.serial = metadata.get("udp_port_lidar"), metadata.get("prod_sn")

        self.profile = str(metadata.get("udp_profile_lidar", "LEGACY"))
        if self.profile not in _PIXEL_BYTES:
            raise FormatError(
                f"a udp_profile_lidar of {', '.join(_PIXEL_BYTES)}", self.profile, "record it with one of these"
            )
        self.is_legacy = self.profile == "LEGACY"
        self.is_fusa = "FUSA" in (metadata.get("header_type"), self.profile[:4])
        self.packet = self._packet_type()
        if self.packet.itemsize > _MAX_PACKET:
            raise FormatError("packets that fit a datagram", f"{self.packet.itemsize} bytes", "save the metadata again")
        self._aim(metadata, altitude, azimuth)

    def _packet_type(self) -> np.dtype:
        is_short = "RNG15" in self.profile
        self.unit = 8 if is_short else 1
        self.mask = 0x7FFF if is_short else 0xFFFFF if self.is_legacy else 0x7FFFF
        number = "<u2" if is_short else "<u4"
        pixel = np.dtype({"names": ["range"], "formats": [number], "itemsize": _PIXEL_BYTES[self.profile]})
        column: list[tuple] = [("time", "<u8"), ("id", "<u2"), ("status", "<u2"), ("pixels", pixel, self.beams)]
        if self.is_legacy:
            column[2:] = [("frame", "<u2"), ("encoder", "<u4"), ("pixels", pixel, self.beams), ("status", "<u4")]
        columns = ("columns", column, self.columns_per_packet)
        return np.dtype([columns] if self.is_legacy else [("header", "V32"), columns, ("footer", "V32")])

    def _aim(self, metadata: dict[str, Any], altitude: np.ndarray, azimuth: np.ndarray) -> None:
        """Computes directions (columns, beams, 3) and starts (columns, 3) m of the beams in the sensor frame. A
        measured range is `reach` mm longer than the distance from the start."""
        beam_to_lidar = _numbers(metadata, "beam_to_lidar_transform", np.eye(4)).reshape(4, 4)
        radial_offset, vertical_offset = beam_to_lidar[0, 3], beam_to_lidar[2, 3]
        if "beam_to_lidar_transform" not in metadata:
            product = str(metadata.get("prod_line", ""))
            default = next((mm for name, mm in _BEAM_ORIGINS.items() if product.startswith(name)), _BEAM_ORIGIN)
            radial_offset = float(_numbers(metadata, "lidar_origin_to_beam_origin_mm", default))
        self.reach = float(np.hypot(radial_offset, vertical_offset))
        T_sensor_lidar = _numbers(metadata, "lidar_to_sensor_transform", _LIDAR_TO_SENSOR).reshape(4, 4)
        R, self.origin = T_sensor_lidar[:3, :3], T_sensor_lidar[:3, 3] / 1000
        encoder = 2 * np.pi * (1 - np.arange(self.columns) / self.columns)
        heading = encoder[:, None] - azimuth
        cos_altitude = np.cos(altitude)
        rays = [
            np.cos(heading) * cos_altitude,
            np.sin(heading) * cos_altitude,
            np.broadcast_to(np.sin(altitude), heading.shape),
        ]
        self.directions = np.stack(rays, axis=-1) @ R.T / 1000
        starts = [
            radial_offset * np.cos(encoder),
            radial_offset * np.sin(encoder),
            np.full(self.columns, vertical_offset),
        ]
        self.starts = np.stack(starts, axis=-1) @ R.T / 1000 + self.origin

    def header(self, packet: bytes) -> tuple[int, int | None]:
        """A packet's frame id, and the sensor's serial number if the packet contains it."""
        id_offset, size, serial_offset = (10, 2, None) if self.is_legacy else (4, 4, 11) if self.is_fusa else (2, 2, 7)
        frame_id = int.from_bytes(packet[id_offset : id_offset + size], "little")
        return frame_id, None if serial_offset is None else int.from_bytes(
            packet[serial_offset : serial_offset + 5], "little"
        )

    def num_sent(self, step: int = 1) -> int:
        """Number of columns that are sent in a full revolution, or of groups of `step` columns."""
        first, last = (column // step for column in self.window)
        total = -(-self.columns // step)
        return last - first + 1 if self.window[0] <= self.window[1] else min(total - first + last + 1, total)

    def decode(self, packets: list[bytes]) -> Sweep:
        """The sweep in a frame's packets; ring is the beam number, from the top."""
        columns = np.frombuffer(b"".join(packets), self.packet)["columns"].reshape(-1)
        columns = columns[(columns["status"] & 1 == 1) & (columns["id"] < self.columns)]
        # duplicate packets are used once
        ids, first_indices = np.unique(columns["id"], return_index=True)
        ranges = (columns["pixels"]["range"][first_indices] & self.mask).astype(np.int64) * self.unit
        (returns,) = np.nonzero(ranges.ravel())
        column, beam = np.divmod(returns, self.beams)
        points = self.directions[ids[column], beam]
        points *= (ranges.ravel()[returns] - self.reach)[:, None]
        points += self.starts[ids[column]]
        num_missing = self.num_sent() - len(ids)
        warnings = (f"{num_missing} of {self.num_sent()} columns are missing",) if num_missing > 0 else ()
        return Sweep(points=points, origin=self.origin, ring=beam, warnings=warnings)


class _Trimmed:
    """Packets in messages without the spare byte that older drivers leave behind them."""

    def __init__(self, datagrams: Datagrams, packet_bytes: int):
        self._datagrams, self._packet_bytes = datagrams, packet_bytes

    @property
    def num_cut(self) -> int:
        return self._datagrams.num_cut

    def __iter__(self) -> Iterator[Datagram]:
        for datagram in self._datagrams:
            has_spare = len(datagram.payload) == self._packet_bytes + 1
            yield datagram._replace(payload=datagram.payload[:-1]) if has_spare else datagram


class OusterRecording(PacketRecording):
    """A capture of an Ouster sensor's packets, decoded with the sensor's metadata.

    Args:
        path: the capture, or another recording.
        metadata: the sensor's JSON file, or the recording that contains it.
        content: of the JSON file, if it is in a recording.
        datagrams: the packets, if they are in another recording.
    """

    def __init__(self, path: Path, metadata: Path, *, content: str | None = None, datagrams: Datagrams | None = None):
        self.metadata = metadata
        self.format = OusterFormat(metadata, content)
        size = self.format.packet.itemsize
        super().__init__(path, size, None if datagrams is None else _Trimmed(datagrams, size))
        self.flow = self._find_flow()
        self._num_lost = self._num_sent = 0
        self._serial: int | None = None

    def _find_flow(self) -> tuple[bytes, int]:
        """The flow whose packets are read: best of the sensor and to the port that the metadata states, else of the
        sensor, else to the port, else the first with lidar packets."""
        sizes: Counter[int] = Counter()
        flow, best = None, -1
        # a capture that is cut off raises InputError at its end
        with suppress(InputError):
            for k, datagram in enumerate(self.capture):
                sizes[len(datagram.payload)] += 1
                if len(datagram.payload) == self.packet_bytes:
                    serial = self.format.header(datagram.payload)[1]
                    is_own = serial is None or not self.format.serial or str(serial) == str(self.format.serial)
                    match = 2 * is_own + (datagram.flow[1] == self.format.port or not self.format.port)
                    if match > best:
                        flow, best = datagram.flow, match
                if best == 3 or flow and k >= _NUM_PEEKED:
                    break
        if flow is None:
            size = f"lidar packets of {self.packet_bytes} bytes"
            expected = f"{size} ({self.format.profile}, {self.format.beams} beams, according to {self.metadata})"
            actual = ", ".join(f"{count} of {size}" for size, count in sorted(sizes.items())[:5]) or "no UDP packets"
            raise file_error(self.name, f"expected {expected}, got {actual}: is that the metadata of this recording?")
        return flow

    @property
    def warnings(self) -> list[str]:
        lines = []
        if self._num_lost:
            lines.append(f"{self._num_lost} of {self._num_sent} lidar packets were lost")
        lines += super().warnings
        if self._serial and str(self.format.serial or self._serial) != str(self._serial):
            serial = f"{self._serial}, {self.metadata} is from {self.format.serial}"
            lines.append(f"the packets are from the sensor {serial}: its beam directions may differ")
        return lines

    def sweeps(self) -> Iterator[tuple[float, Callable[[], Sweep]]]:
        has_clock = None
        for capture_time, packets in self._packets_of_turns():
            clock = np.frombuffer(packets[0], self.format.packet)["columns"]["time"]
            clock = clock[clock > 0]
            has_clock = bool(len(clock)) if has_clock is None else has_clock
            time = float(clock[0]) / 1e9 if has_clock and len(clock) else capture_time
            yield time, partial(self.format.decode, packets)

    def _packets_of_turns(self) -> Iterator[tuple[float, list[bytes]]]:
        """(time of capture, packets) of each revolution of the sensor."""
        self._num_lost = self._num_sent = 0
        packets_per_turn = self.format.num_sent(self.format.columns_per_packet)
        packets: list[bytes] = []
        current_id = previous_id = None
        start_time, num_turns = 0.0, 0
        for datagram in self.packets():
            frame_id, self._serial = self.format.header(datagram.payload)
            # a late packet of the previous revolution, which has already counted it as lost
            if frame_id == previous_id:
                continue
            if packets and (frame_id != current_id or len(packets) >= 2 * packets_per_turn):
                # losses are not counted in the first and the last revolution: the capture has only a part of them
                if num_turns:
                    self._num_sent += packets_per_turn
                    self._num_lost += max(packets_per_turn - len(packets), 0)
                yield start_time, packets
                num_turns += 1
                previous_id = current_id if frame_id != current_id else None
                packets = []
            if not packets:
                start_time = datagram.time
            current_id = frame_id
            packets.append(datagram.payload)
        if packets:
            yield start_time, packets


def _flat(metadata: dict[str, Any]) -> dict[str, Any]:
    """The keys of all sections in one dict: newer sensors group into sections what older ones have at the top level."""
    sections = [_flat(value) for value in metadata.values() if isinstance(value, dict)]
    top_level = {key: value for key, value in metadata.items() if not isinstance(value, dict)}
    return {key: value for section in (*sections, top_level) for key, value in section.items()}


def _numbers(metadata: dict[str, Any], key: str, default: Any = None) -> np.ndarray:
    if key not in metadata and default is None:
        raise FormatError(f"has no {key}: expected an Ouster sensor's metadata; save it from the sensor")
    values = np.asarray(metadata.get(key, default), dtype=np.float64)
    if not (np.abs(values) < _MAX_NUMBER).all():
        raise FormatError(f"finite numbers in {key}", "others", "save the sensor's metadata again")
    return values


def _whole(metadata: dict[str, Any], key: str, maximum: int, default: Any) -> int:
    value = int(metadata.get(key, default))
    if not 1 <= value <= maximum:
        raise FormatError(f"{key} from 1 to {maximum}", value, "save the sensor's metadata again")
    return value
