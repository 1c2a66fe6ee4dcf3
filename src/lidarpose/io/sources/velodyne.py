"""Packets of Velodyne sensors as frames, by the library velodyne-decoder."""

from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose.errors import InputError, missing_extra
from lidarpose.io.files import file_error, shorten
from lidarpose.io.sources.frame import LazyFrame, Sweep
from lidarpose.io.sources.pcap import Capture

PACKET_BYTES = 1206
# columns of the decoder's rows
_RING = 6
# packets among which a Velodyne's are looked for, and those that tell whether their last bytes are a model's number
_NUM_TRIED, _NUM_PEEKED = 2000, 5


def open_recording(path: Path, *, topic: str | None = None) -> "VelodyneRecording":
    """Opens a capture of a Velodyne sensor.

    Raises:
        InputError: No capture, or of another sensor.
        MissingExtra: Without the library that decodes it.
    """
    sizes: list[int] = []
    try:
        sizes += (len(datagram.payload) for datagram in islice(Capture(path), _NUM_TRIED))
    except InputError:
        if not sizes:
            raise
    if PACKET_BYTES in sizes:
        return VelodyneRecording(path)
    if not sizes:
        raise file_error(path, "has no UDP packets; expected those of an Ouster or Velodyne sensor")
    problem = f"an Ouster recording needs its metadata {path.stem}.json beside it; save it from the sensor"
    raise file_error(path, f"{problem} (a Velodyne's packets have {PACKET_BYTES} bytes, these have up to {max(sizes)})")


class VelodyneRecording:
    """A capture of a Velodyne sensor's packets. A `Recording`; a frame is one turn of the sensor, and its time that of
    the capture.

    The packets name the model, and the model's own beam angles are taken; an HDL-64E sends its calibration along.
    """

    count = None

    def __init__(self, path: Path):
        try:
            import velodyne_decoder
        except ModuleNotFoundError as error:
            raise missing_extra(error, "reading a Velodyne recording") from None
        self.name = str(path)
        self.capture = Capture(path)
        self._library = velodyne_decoder
        self._num_damaged = self._num_other = self._num_lost = 0
        self._reason = ""

    @property
    def warnings(self) -> list[str]:
        counts = {
            "packets are captured in part only, and are left out": self.capture.num_cut,
            "packets are not of the sensor's model, and are left out": self._num_damaged,
            f"turns cannot be decoded: {self._reason}": self._num_lost,
            "packets of another sensor are left out": self._num_other,
        }
        return [f"{count} {what}" for what, count in counts.items() if count]

    def lazy_frames(self, first: int = 0) -> Iterator[LazyFrame]:
        index = -1
        for index, (time, rows) in enumerate(self._turns()):
            if index >= first:
                yield LazyFrame(f"{index:06d}", time, partial(_sweep, rows))
        if index < 0 and self._num_lost:
            raise file_error(self.name, f"expected packets of a Velodyne model that can be decoded: {self._reason}")

    def _model(self) -> tuple[Any, bytes | None]:
        """The library's configuration, and the last bytes of each packet where they are the model's number."""
        config = self._library.Config()
        packets = (datagram.payload for datagram in self.capture if len(datagram.payload) == PACKET_BYTES)
        ends = Counter(packet[-2:] for packet in islice(packets, _NUM_PEEKED))
        if len(ends) <= 2:
            return config, ends.most_common(1)[0][0]
        # pieces of an HDL-64E's calibration
        try:
            config.model, config.calibration = self._library.hdl64e.detect_hdl64e(self.name)
        except Exception as error:
            reason = shorten(str(error))
            problem = f"is of an HDL-64E whose calibration is not in it ({reason}); record it for longer"
            raise file_error(self.name, problem) from None
        return config, None

    def _turns(self) -> Iterator[tuple[float, np.ndarray]]:
        """(time of capture, rows of the library) of each turn."""
        config, end = self._model()
        self._num_damaged = self._num_other = self._num_lost = 0
        decoder, flow, damage = self._library.StreamDecoder(config), None, None
        try:
            for datagram in self.capture:
                if len(datagram.payload) != PACKET_BYTES:
                    continue
                flow = flow or datagram.flow
                self._num_other += datagram.flow != flow
                self._num_damaged += datagram.flow == flow and not datagram.payload.endswith(end or b"")
                if datagram.flow == flow and datagram.payload.endswith(end or b""):
                    yield from self._decoded(decoder.decode, datagram.time, datagram.payload)
        except InputError as error:
            damage = error
        yield from self._decoded(decoder.finish)
        if damage is not None:
            raise damage

    def _decoded(self, decode: Callable, *packet: Any) -> Iterator[tuple[float, np.ndarray]]:
        """The turn that a packet completes, if there is one and it can be decoded."""
        try:
            turn = decode(*packet, False)
        except Exception as error:
            self._num_lost, self._reason = self._num_lost + 1, shorten(str(error))
        else:
            if turn is not None:
                yield turn[0].host, turn[1]


def _sweep(rows: np.ndarray) -> Sweep:
    return Sweep(points=rows[:, :3].astype(np.float64), origin=np.zeros(3), ring=rows[:, _RING].astype(np.int64))
