"""Packets of Velodyne sensors as frames, decoded with the library velodyne-decoder."""

from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose.errors import needs_extra
from lidarpose.io.files import FormatError, file_error, shorten
from lidarpose.io.sources.frame import Sweep
from lidarpose.io.sources.pcap import Datagram, PacketRecording

PACKET_BYTES = 1206
# messages of the ROS driver: the packets of a turn
SCAN_TYPES = ("velodyne_msgs/msg/VelodyneScan", "velodyne_msgs/VelodyneScan")
SCAN_DEFINITIONS = {
    "velodyne_msgs/msg/VelodynePacket": f"builtin_interfaces/Time stamp\nuint8[{PACKET_BYTES}] data",
    SCAN_TYPES[0]: "std_msgs/Header header\nVelodynePacket[] packets",
}
# column of the ring in the decoder's rows
_RING = 6
# number of packets that are checked for a model number in their last bytes
_NUM_PEEKED = 5


class VelodyneRecording(PacketRecording):
    """A capture of a Velodyne sensor's packets; a frame's time is the time of capture.

    The packets name the model, whose beam angles are used; an HDL-64E sends its own calibration in its packets.
    """

    def __init__(self, path: Path):
        with needs_extra("reading a Velodyne recording"):
            import velodyne_decoder
        super().__init__(path, PACKET_BYTES)
        self._library = velodyne_decoder
        self._num_damaged = self._num_lost = 0
        self._reason = ""

    @property
    def warnings(self) -> list[str]:
        counts = {
            "packets are not from the sensor's model and are left out": self._num_damaged,
            f"turns cannot be decoded: {self._reason}": self._num_lost,
        }
        return [f"{count} {problem}" for problem, count in counts.items() if count] + super().warnings

    def _model(self) -> tuple[Any, bytes]:
        """The library's configuration, and the last bytes of each packet if they are the model number, else none."""
        config = self._library.Config()
        ends = Counter(packet.payload[-2:] for packet in islice(self.packets(), _NUM_PEEKED))
        if len(ends) <= 2:
            return config, ends.most_common(1)[0][0]
        # the last bytes vary: they are pieces of an HDL-64E's calibration
        try:
            config.model, config.calibration = self._calibration()
        except Exception as error:
            reason = shorten(str(error))
            problem = f"is from an HDL-64E, but has no calibration in it ({reason}); record it for longer"
            raise file_error(self.name, problem) from None
        return config, b""

    def _calibration(self) -> tuple[Any, Any]:
        """Model and calibration that an HDL-64E sends in the last bytes of its packets. Raises ValueError."""
        import yaml

        hdl64e, models = self._library.hdl64e, self._library.Model
        content = hdl64e.status_info_to_calib_dict(hdl64e.read_status_info(packet.payload for packet in self.packets()))
        laser_ids = [laser["laser_id"] for laser in content["lasers"]]
        if content["status"]["Calibration Time"] is None or laser_ids != list(range(len(laser_ids))):
            raise ValueError("calibration not set in the sensor")
        model = models.HDL64E_S2 if content["status"]["Model"] == "S2" else models.HDL64E_S3
        return model, self._library.Calibration.from_string(yaml.dump(content))

    def sweeps(self) -> Iterator[tuple[float, Callable[[], Sweep]]]:
        config, end = self._model()
        self._num_damaged = self._num_lost = num_turns = 0
        decoder = self._library.StreamDecoder(config)
        packets = (packet for packet in self.packets() if self._is_of_model(packet, end))
        calls = (partial(decoder.decode, packet.time, packet.payload) for packet in packets)
        for decode in chain(calls, [decoder.finish]):
            try:
                turn = decode(False)
            except Exception as error:
                self._num_lost, self._reason = self._num_lost + 1, shorten(str(error))
                continue
            if turn is not None:
                num_turns += 1
                yield turn[0].host, partial(_sweep, turn[1])
        if self._num_lost and not num_turns:
            raise file_error(self.name, f"expected packets of a Velodyne model that can be decoded: {self._reason}")

    def _is_of_model(self, packet: Datagram, end: bytes) -> bool:
        is_whole = packet.payload.endswith(end)
        self._num_damaged += not is_whole
        return is_whole


def decode_scan(packets: list[Any]) -> tuple[np.ndarray, np.ndarray]:
    """The points (n, 3) m, float64, and the ring (n,) of each in the packets of a `SCAN_TYPES` message.

    Raises:
        MissingExtra: The library that decodes packets is not installed.
        FormatError: They are packets of another sensor, or of an HDL-64E, whose calibration is not in one message.
    """
    with needs_extra("reading packets of a Velodyne sensor"):
        import velodyne_decoder
    times = [packet.stamp.sec + packet.stamp.nanosec / 1e9 for packet in packets]
    packet_type, vector_type = velodyne_decoder.VelodynePacket, velodyne_decoder.PacketVector
    try:
        _, rows = velodyne_decoder.ScanDecoder(velodyne_decoder.Config()).decode(
            vector_type(packet_type(time, packet.data) for time, packet in zip(times, packets, strict=True))
        )
    except Exception as error:
        expected, remedy = "packets of a Velodyne model that names itself", "record the driver's PointCloud2"
        raise FormatError(expected, shorten(str(error)), remedy) from None
    return _points_and_ring(rows)


def _sweep(rows: np.ndarray) -> Sweep:
    points, ring = _points_and_ring(rows)
    return Sweep(points=points, origin=np.zeros(3), ring=ring)


def _points_and_ring(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return rows[:, :3].astype(np.float64), rows[:, _RING].astype(np.int64)
