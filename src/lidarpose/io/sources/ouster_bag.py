"""Packets of Ouster sensors in ROS recordings."""

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from lidarpose.errors import InputError
from lidarpose.io.files import file_error
from lidarpose.io.sources import ouster
from lidarpose.io.sources.containers import RecordFile, SqliteFile, all_messages, unpacked_message
from lidarpose.io.sources.frame import ReadingOptions, Recording
from lidarpose.io.sources.pcap import Datagram
from lidarpose.io.sources.ros_messages import FRAME_TYPES, TEXT_TYPES, decoders


def open_packets(name: str, files: list[RecordFile | SqliteFile], options: ReadingOptions) -> Recording | None:
    """The packets of an Ouster sensor as a recording; None if there are none, or clouds instead. The metadata is the
    file `meta`, else the last text in a topic whose name ends in "metadata"."""
    topics = {key: entry for file in files for key, entry in file.topics.items() if entry.encoding in decoders()}
    has_clouds = any(entry.type in FRAME_TYPES for entry in topics.values())
    packet_topics = {key for key, entry in topics.items() if entry.type in ouster.PACKET_TYPES}
    if options.topic is not None or has_clouds:
        packet_topics &= {options.topic}
    if not packet_topics:
        return None
    datagrams = MessageDatagrams(files, {key: topics[key].encoding for key in packet_topics})
    if options.meta is not None:
        return ouster.OusterRecording(Path(name), options.meta, datagrams=datagrams)
    text_topics = {key for key, entry in topics.items() if entry.type in TEXT_TYPES and key.endswith("metadata")}
    texts = []
    with suppress(InputError):
        for message in all_messages(files, text_topics):
            # a damaged text is no metadata
            with suppress(Exception):
                decode = decoders()[topics[message.topic].encoding]
                texts.append(decode(unpacked_message(message.data), TEXT_TYPES[0]).data)
    if not texts:
        problem = "has packets of an Ouster sensor, but no topic with its metadata"
        raise file_error(name, f"{problem}: give the sensor's JSON file (--meta)")
    return ouster.OusterRecording(Path(name), Path(name), content=texts[-1], datagrams=datagrams)


class MessageDatagrams:
    """The packets in messages of some topics, as `Datagrams`. encodings: by topic."""

    def __init__(self, files: list[RecordFile | SqliteFile], encodings: dict[str, str]):
        self.files, self.encodings, self.num_cut = files, encodings, 0

    def __iter__(self) -> Iterator[Datagram]:
        self.num_cut = 0
        for message in all_messages(self.files, set(self.encodings)):
            try:
                decode = decoders()[self.encodings[message.topic]]
                payload = bytes(decode(unpacked_message(message.data), ouster.PACKET_TYPES[0]).buf)
            except Exception:
                self.num_cut += 1
                continue
            yield Datagram(message.time / 1e9, (message.topic.encode(), 0), payload)
