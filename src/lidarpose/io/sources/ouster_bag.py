"""Packets of Ouster sensors in ROS recordings."""

from collections import Counter
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
    file `meta`, else the last text in a topic whose name ends in "metadata", if possible beside the packets' topic."""
    topics = {key: entry for file in files for key, entry in file.topics.items() if entry.encoding in decoders()}
    counts = Counter({key: sum(file.topics[key].count for file in files if key in file.topics) for key in topics})
    packet_topics = {key for key, entry in topics.items() if entry.type in ouster.PACKET_TYPES}
    # recorders store topics without messages, too; in a damaged file, all counts may be 0
    has_packets = any(counts[key] for key in packet_topics)
    has_clouds = any(entry.type in FRAME_TYPES and (counts[key] or not has_packets) for key, entry in topics.items())
    if options.topic is not None or has_clouds:
        packet_topics &= {options.topic}
    if not packet_topics:
        return None
    if options.meta is not None:
        datagrams = MessageDatagrams(files, {key: topics[key].encoding for key in packet_topics})
        return ouster.OusterRecording(Path(name), options.meta, datagrams=datagrams)
    text_topics = {key for key, entry in topics.items() if entry.type in TEXT_TYPES and key.endswith("metadata")}
    # by topic
    texts: dict[str, str] = {}
    with suppress(InputError):
        for message in all_messages(files, text_topics):
            # a damaged text is no metadata
            with suppress(Exception):
                decode = decoders()[topics[message.topic].encoding]
                texts[message.topic] = decode(unpacked_message(message.data), TEXT_TYPES[0]).data
    if not texts:
        problem = "has packets of an Ouster sensor, but no topic with its metadata"
        raise file_error(name, f"{problem}: give the sensor's JSON file (--meta)")
    notes = []
    own_texts = {_namespace(key): text for key, text in texts.items()}
    if namespaces := sorted({_namespace(key) for key in packet_topics} & set(own_texts)):
        content = own_texts[namespaces[0]]
        packet_topics = {key for key in packet_topics if _namespace(key) == namespaces[0]}
        if len(namespaces) > 1:
            others = ", ".join(namespaces[1:])
            notes = [f"read the sensor {namespaces[0]}, not {others}: give the topic of its packets to read another"]
    else:
        content = list(texts.values())[-1]
    datagrams = MessageDatagrams(files, {key: topics[key].encoding for key in packet_topics})
    recording = ouster.OusterRecording(Path(name), Path(name), content=content, datagrams=datagrams)
    recording.notes += notes
    return recording


def _namespace(topic: str) -> str:
    """A topic without its last part, in which a driver's topics of one sensor agree."""
    return topic.rpartition("/")[0]


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
