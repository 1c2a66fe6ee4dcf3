"""Point clouds in ROS recordings: sensor_msgs/PointCloud2, Livox's CustomMsg and packets of Velodyne and Ouster sensors
in MCAP, ROS 1 bags and rosbag2's SQLite files.

Messages are decoded with the library rosbags. The sensor pose comes from the recording's transforms (tf), if they
connect the clouds' frame to a world frame.
"""

from bisect import bisect_left
from collections import deque
from collections.abc import Iterator
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose.errors import InputError
from lidarpose.geometry import quaternion_to_matrix, rigid_transform
from lidarpose.io.files import FormatError, file_error, shorten, unreadable
from lidarpose.io.sources import livox, ouster_bag, velodyne
from lidarpose.io.sources.containers import (
    McapFile,
    Message,
    RecordFile,
    Ros1File,
    SqliteFile,
    Topic,
    all_messages,
    unpacked_message,
)
from lidarpose.io.sources.folders import natural_key
from lidarpose.io.sources.frame import LazyFrame, ReadingOptions, Recording, Sweep
from lidarpose.io.sources.ros_messages import CLOUD_TYPES, FRAME_TYPES, TRANSFORM_TYPES, decode_cloud, decoders

_FILES: dict[str, type[RecordFile] | type[SqliteFile]] = {".mcap": McapFile, ".bag": Ros1File, ".db3": SqliteFile}
# fixed frames; the first is preferred (REP 105)
_WORLDS = ("map", "world", "odom")
# frames of the vehicle or the world, whose origin is not the sensor position
_NO_SENSORS = (*_WORLDS, "earth", "base_link", "base_footprint", "base")

# ns; the sensor pose is interpolated only between transforms that are not farther apart
_MAX_GAP = 10**9
# clouds wait for transforms that are recorded after them: maximum number of waiting clouds, and maximum wait, ns
_MAX_WAITING, _MAX_WAIT = 16, 10**9
# m; no sensor is farther from the origin of its world
_MAX_PLAUSIBLE = 1e9
# minimum norm of a valid quaternion
_MIN_NORM = 1e-3
# maximum number of transforms stored for each frame
_MAX_KEPT = 1000


def open_recording(path: Path, options: ReadingOptions) -> Recording:
    """Opens a .mcap, .bag or .db3 file, or a folder that rosbag2 wrote.

    By default, the topic is the one with most clouds, or if there are none, those with packets of an Ouster sensor.

    Raises:
        InputError: The recording does not exist, has no point clouds, or does not have the topic.
        MissingExtra: The library that decodes messages is not installed.
    """
    files = [path]
    if path.is_dir():
        files = sorted((file for file in path.iterdir() if file.suffix.lower() in _FILES), key=natural_key)
        if not files:
            packed_file = next(path.glob("*.zstd"), None)
            remedy = f"; unpack {packed_file.name} first (unzstd)" if packed_file else "; was it copied completely?"
            raise file_error(path, f"expected a recording's {' or '.join(_FILES)} files in this folder{remedy}")
    return open_parts(str(path), files, options)


def open_parts(name: str, files: list[Path], options: ReadingOptions) -> Recording:
    """Opens consecutive files of one recording. Raises the same errors as `open_recording`."""
    decoders()
    opened_files = [_open_file(file) for file in files]
    return ouster_bag.open_packets(name, opened_files, options) or BagRecording(name, opened_files, options)


def _open_file(path: Path) -> RecordFile | SqliteFile:
    try:
        return _FILES[path.suffix.lower()](path)
    except FormatError as problem:
        raise file_error(path, problem) from None
    except OSError as error:
        raise unreadable(path, error) from None


class BagRecording:
    """The clouds of a topic. A `Recording`; a frame is one message, with the time in its header.

    Args:
        files: the files of the recording, in order.
        options: without a topic, the one with most clouds is read.
    """

    def __init__(self, name: str, files: list[RecordFile | SqliteFile], options: ReadingOptions):
        self.name = name
        self.files = files
        topics: dict[str, Topic] = {}
        for file in files:
            for key, entry in file.topics.items():
                topics.setdefault(key, Topic(entry.type, entry.encoding)).count += entry.count
        self._notes = options.ignored("meta")
        self.topics = topics
        self.topic = self._choose(options.topic)
        self._transforms = {
            key for key, entry in topics.items() if entry.type in TRANSFORM_TYPES and entry.encoding in decoders()
        }
        self._world: str | None = None
        self._has_stamps = True
        self._num_frames = self._num_posed = 0
        # world frames that transforms connect with the clouds' frame at some time, if no cloud has a pose
        self._linked_worlds: list[str] = []
        self._damage: InputError | None = None

    def _choose(self, topic: str | None) -> str:
        clouds = {
            key: entry.count
            for key, entry in self.topics.items()
            if entry.type in FRAME_TYPES and entry.encoding in decoders()
        }
        if not clouds:
            topics = ", ".join(f"{key} ({entry.type}, {entry.encoding})" for key, entry in self.topics.items())
            expected = f"{CLOUD_TYPES[0]}, Livox's CustomMsg, {velodyne.SCAN_TYPES[0]} or Ouster's PacketMsg"
            problem = f"has no point clouds (expected a topic of {expected}); its topics are"
            raise file_error(self.name, f"{problem} {shorten(topics, 1000) or 'none'}")
        names = ", ".join(f"{key} ({count})" for key, count in clouds.items())
        if topic is not None and topic not in clouds:
            raise file_error(self.name, f"has no point clouds in the topic {topic!r}; topics with clouds: {names}")
        if topic is None:
            topic = max(clouds, key=clouds.__getitem__)
            if len(clouds) > 1:
                self._notes.append(
                    f"read the topic {topic}, which has the most clouds, of {names}: --topic (topic=) reads another"
                )
        return topic

    @property
    def count(self) -> int | None:
        return self.topics[self.topic].count or None

    @property
    def warnings(self) -> list[str]:
        lines = list(self._notes)
        if not self._has_stamps:
            lines.append("clouds without a time in their header: their recording times are used")
        if 0 < self._num_posed < self._num_frames:
            unposed_clouds = f"{self._num_frames - self._num_posed} of {self._num_frames} clouds"
            lines.append(f"{unposed_clouds} have no sensor pose in the frame {self._world}")
        elif self._num_frames and not self._num_posed and self._linked_worlds:
            problem = f"the transforms to {' and '.join(self._linked_worlds)} are of other times than the clouds"
            lines.append(f"no cloud has a sensor pose: {problem}")
        for file in self.files:
            if file.num_damaged:
                lines.append(f"{file.path.name}: {file.num_damaged} chunks are left out: one {file.damage}")
        return lines

    def lazy_frames(self, first: int = 0) -> Iterator[LazyFrame]:
        # the poses of clouds before `first` are computed, too, since they determine the world frame
        return islice(self._all_frames(), first, None)

    def _all_frames(self) -> Iterator[LazyFrame]:
        self._num_frames = self._num_posed = 0
        transforms = TransformTree()
        # clouds that wait for their sensor pose
        pending_clouds: deque[_Cloud] = deque()
        index = delay = 0
        for message in self._messages():
            if message.topic == self.topic:
                pending_clouds.append(_Cloud(index, message, self._decode(message), delay))
                index, delay = index + 1, pending_clouds[-1].recorded - pending_clouds[-1].stamp
            else:
                transforms.add(self._decode(message), is_static=message.topic.endswith("_static"))
            while pending_clouds:
                is_late = len(pending_clouds) > _MAX_WAITING or message.time - pending_clouds[0].recorded > _MAX_WAIT
                is_last = is_late or not self._transforms
                T_world_sensor = self._pose(transforms, pending_clouds[0], is_last)
                if T_world_sensor is None and not is_last:
                    break
                yield self._frame(pending_clouds.popleft(), T_world_sensor)
        for cloud in pending_clouds:
            yield self._frame(cloud, self._pose(transforms, cloud, True))
        if self._damage is not None:
            raise self._damage

    def _decode(self, message: Message) -> Any:
        """The content of a message, or the error of decoding it, of any type if it is damaged."""
        topic = self.topics[message.topic]
        data = unpacked_message(message.data)
        names = (CLOUD_TYPES, velodyne.SCAN_TYPES, TRANSFORM_TYPES)
        try:
            if topic.type in livox.TYPES:
                return livox.decode_cloud(data, topic.encoding)
            return decoders()[topic.encoding](data, next(types[0] for types in names if topic.type in types))
        except Exception as error:
            return error

    def _messages(self) -> Iterator[Message]:
        """Clouds and transforms of all files. After a damaged position, reading continues with the next file."""
        self._damage = None
        try:
            yield from all_messages(self.files, {self.topic, *self._transforms})
        except InputError as damage:
            self._damage = damage

    def _pose(self, transforms: "TransformTree", cloud: "_Cloud", is_last: bool) -> np.ndarray | None:
        """T_world_sensor at a cloud's time. The world is chosen once: the first of `_WORLDS`, or the next available one
        if the cloud cannot wait longer (`is_last`)."""
        poses = transforms.poses(cloud.frame_id, cloud.stamp)
        if self._world is None:
            available_worlds = [world for world in _WORLDS if world in poses]
            if available_worlds and (is_last or available_worlds[0] == _WORLDS[0]):
                self._world = available_worlds[0]
            elif is_last:
                self._linked_worlds = [world for world in _WORLDS if world in transforms.ancestors(cloud.frame_id)]
        return None if self._world is None else poses.get(self._world)

    def _frame(self, cloud: "_Cloud", T_world_sensor: np.ndarray | None) -> LazyFrame:
        self._has_stamps &= cloud.has_stamp
        self._num_frames += 1
        self._num_posed += T_world_sensor is not None
        return LazyFrame(f"{cloud.index:06d}", cloud.stamp / 1e9, partial(cloud.decode, T_world_sensor))


class _Cloud:
    """A message with a cloud.

    recorded: ns, when it was recorded; stamp: ns, when it was measured according to its header, or `recorded` if the
    header has no time. For a damaged message, stamp is `delay` ns before `recorded`, like that of the previous cloud.
    """

    def __init__(self, index: int, message: Message, content: Any, delay: int):
        self.index = index
        self.recorded = message.time
        self.content = content
        header = getattr(content, "header", None)
        self.frame_id = header.frame_id.lstrip("/") if header else ""
        stamp = header.stamp.sec * 10**9 + header.stamp.nanosec if header else 0
        self.has_stamp = stamp > 0 or header is None
        self.stamp = stamp if stamp > 0 else message.time - (0 if header else delay)

    def decode(self, T_world_sensor: np.ndarray | None) -> Sweep:
        if isinstance(self.content, Exception):
            reason = shorten(f"{type(self.content).__name__}: {self.content}")
            raise FormatError(f"cannot be decoded as a point cloud: the message is damaged ({reason})")
        ring: np.ndarray | None
        times: np.ndarray | None = None
        if isinstance(self.content, livox.LivoxCloud):
            points, ring, times = self.content.points, self.content.ring, self.content.times
        elif hasattr(self.content, "packets"):
            points, ring = velodyne.decode_scan(self.content.packets)
        else:
            points, ring, times = decode_cloud(self.content)
        is_unknown = self.frame_id in _NO_SENSORS
        origin = None if is_unknown else np.zeros(3)
        return Sweep(
            points=points, T_world_sensor=T_world_sensor, origin=origin, is_origin_unknown=is_unknown, ring=ring,
            point_times=times,
        )  # fmt: skip


class TransformTree:
    """The transforms between frames in the part of a recording that has been read."""

    def __init__(self):
        # child -> parent, times ns (empty for a static transform), and (translation m, quaternion x y z w) at each time
        self._edges: dict[str, tuple[str, list[int], list[np.ndarray]]] = {}

    def add(self, message: Any, *, is_static: bool) -> None:
        """Adds the transforms of a TFMessage; implausible ones are ignored."""
        for transform_stamped in getattr(message, "transforms", ()):
            child, parent = transform_stamped.child_frame_id.lstrip("/"), transform_stamped.header.frame_id.lstrip("/")
            t, q = transform_stamped.transform.translation, transform_stamped.transform.rotation
            placement = np.array([t.x, t.y, t.z, q.x, q.y, q.z, q.w])
            # false for NaN
            is_plausible = np.abs(placement).max() < _MAX_PLAUSIBLE and np.linalg.norm(placement[3:]) > _MIN_NORM
            if not is_plausible or child == parent:
                continue
            placement[3:] /= np.linalg.norm(placement[3:])
            time = transform_stamped.header.stamp.sec * 10**9 + transform_stamped.header.stamp.nanosec
            known_parent, times, placements = self._edges.get(child, (parent, [], []))
            if is_static or known_parent != parent or not times:
                times, placements = [], []
            k = bisect_left(times, time)
            if not is_static:
                times.insert(k, time)
            placements.insert(k, placement)
            self._edges[child] = parent, times[-_MAX_KEPT:], placements[-_MAX_KEPT:]

    def ancestors(self, frame: str) -> list[str]:
        """The frame and those that transforms of any time connect it with, towards the root."""
        frames = [frame]
        while frames[-1] in self._edges and (parent := self._edges[frames[-1]][0]) not in frames:
            frames.append(parent)
        return frames

    def poses(self, frame: str, time: int) -> dict[str, np.ndarray]:
        """T_parent_frame (4, 4) of the frame in itself and in each of its ancestors, at a time in ns. Ancestors beyond
        a transform that is unknown at that time are left out."""
        poses = {frame: np.eye(4)}
        T = np.eye(4)
        while frame in self._edges:
            parent, times, placements = self._edges[frame]
            step = _between(times, placements, time) if times else _matrix(placements[0])
            # stops at an unknown transform, and at a cycle in the tree
            if step is None or parent in poses:
                break
            T = step @ T
            poses[parent] = T
            frame = parent
        return poses


def _between(times: list[int], placements: list[np.ndarray], time: int) -> np.ndarray | None:
    """The transform at a time, interpolated between two known ones, or None."""
    k = bisect_left(times, time)
    if k < len(times) and times[k] == time:
        return _matrix(placements[k])
    if not 0 < k < len(times) or times[k] - times[k - 1] > _MAX_GAP:
        return None
    share = (time - times[k - 1]) / (times[k] - times[k - 1])
    previous, following = placements[k - 1], placements[k].copy()
    # q and -q are the same rotation; over such a short time linear interpolation is close to spherical
    following[3:] *= np.sign(previous[3:] @ following[3:]) or 1.0
    return _matrix((1 - share) * previous + share * following)


def _matrix(placement: np.ndarray) -> np.ndarray:
    """The transform (4, 4) of a translation and a quaternion x y z w of any norm."""
    return rigid_transform(quaternion_to_matrix(np.roll(placement[3:], 1)), placement[:3])
