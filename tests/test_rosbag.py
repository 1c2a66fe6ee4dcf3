"""Point clouds of ROS recordings written with rosbags: containers, field layouts, transforms and damaged files."""

import json
import re
import struct
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from hostile_files import with_changed_bytes
from ouster_packets import decoded, expected_points, metadata, packets_of, ranges_of
from velodyne_packets import vlp16

from lidarpose.cli import main
from lidarpose.errors import InputError
from lidarpose.inference.background import is_static, learn_background
from lidarpose.io.files import FormatError
from lidarpose.io.sources import DamagedFrame, livox, open_source
from lidarpose.io.sources.ros_messages import decode_cloud
from lidarpose.recording.predict_recording import predict_recording

rosbags = pytest.importorskip("rosbags", reason="the extra recordings is not installed")
from rosbags.rosbag1 import Writer as Writer1  # noqa: E402
from rosbags.rosbag2 import (  # noqa: E402
    CompressionFormat,
    CompressionMode,
    StoragePlugin,
    Writer as Writer2,  # noqa: E402
)
from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: E402

ROS2, ROS1 = get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.ROS1_NOETIC)
TF = "tf2_msgs/msg/TFMessage"
ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))
CLOUD = "sensor_msgs/msg/PointCloud2"
START = 1_700_000_000 * 10**9
CODES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
XYZ = (("x", 0, "f4"), ("y", 4, "f4"), ("z", 8, "f4"))


def header(store, stamp, frame):
    types = store.types
    time = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
    more = {"seq": 0} if store is ROS1 else {}
    return types["std_msgs/msg/Header"](stamp=time, frame_id=frame, **more)


def cloud(
    points, *, store=ROS2, stamp=START, frame="lidar", fields=XYZ, step=16, big=False, height=1, pad=0, extra=None
):
    """A PointCloud2 of (n, 3) points, written value by value; `extra` fills the other fields."""
    types = store.types
    width = len(points) // height
    data = bytearray((width * step + pad) * height)
    values = {**dict(zip("xyz", np.asarray(points, dtype=float).T, strict=True)), **(extra or {})}
    for name, offset, kind in fields:
        letter = dict(zip(CODES, "bBhHiIfd", strict=True))[kind]
        for k, value in enumerate(values[name]):
            at = (k // width) * (width * step + pad) + (k % width) * step + offset
            struct.pack_into((">" if big else "<") + letter, data, at, value if letter in "fd" else int(value))
    return types[CLOUD](
        header=header(store, stamp, frame),
        height=height,
        width=width,
        fields=[
            types["sensor_msgs/msg/PointField"](name=name, offset=offset, datatype=CODES[kind], count=1)
            for name, offset, kind in fields
        ],
        is_bigendian=big,
        point_step=step,
        row_step=width * step + pad,
        data=np.frombuffer(bytes(data), np.uint8),
        is_dense=False,
    )


def transform(stamp, parent, child, translation, yaw=0.0, store=ROS2):
    types = store.types
    quaternion = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=np.sin(yaw / 2), w=np.cos(yaw / 2))
    vector = types["geometry_msgs/msg/Vector3"](*(float(value) for value in translation))
    placed = types["geometry_msgs/msg/Transform"](translation=vector, rotation=quaternion)
    stamped = types["geometry_msgs/msg/TransformStamped"](
        header=header(store, stamp, parent), child_frame_id=child, transform=placed
    )
    return types[TF](transforms=[stamped])


def write(path, messages, *, compression=None, empty=()):
    """Writes (topic, message, ns); the suffix selects the container; empty: topics of clouds without messages. Returns
    the path to open."""
    store = ROS1 if path.suffix == ".bag" else ROS2
    if path.suffix == ".bag":
        writer = Writer1(path)
        if compression:
            writer.set_compression(getattr(Writer1.CompressionFormat, compression.upper()))
    else:
        plugin = StoragePlugin.MCAP if path.suffix == ".mcap" else StoragePlugin.SQLITE3
        writer = Writer2(path.with_suffix(""), version=9, storage_plugin=plugin)
        if compression:
            is_message = path.suffix == ".db3" or "messages" in compression
            mode = CompressionMode.MESSAGE if is_message else CompressionMode.STORAGE
            writer.set_compression(mode, CompressionFormat.ZSTD)
    connections = {}
    with writer:
        for topic in empty:
            writer.add_connection(topic, CLOUD, typestore=store)
        for topic, message, time in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=store)
            serialize = store.serialize_ros1 if store is ROS1 else store.serialize_cdr
            writer.write(connections[topic], time, serialize(message, message.__msgtype__))
    return path if path.suffix == ".bag" else next(path.with_suffix("").glob(f"*{path.suffix}"))


def store_of(suffix):
    return ROS1 if suffix == ".bag" else ROS2


def points_of(k, n=40):
    """Points (n, 3) m of frame k, exactly representable in float32."""
    return np.random.default_rng(k).normal(scale=10, size=(n, 3)).astype(np.float32).astype(float)


def clouds(suffix, count=6, n=40):
    """Clouds at 10 Hz, recorded 20 ms after their stamps."""
    return [
        (
            "/points",
            cloud(points_of(k, n), store=store_of(suffix), stamp=START + k * 10**8),
            START + k * 10**8 + 2 * 10**7,
        )
        for k in range(count)
    ]


CONTAINERS = [
    (".mcap", None),
    (".mcap", "zstd"),
    (".mcap", "zstd, messages"),
    (".db3", None),
    (".db3", "zstd"),
    (".bag", None),
    (".bag", "bz2"),
    (".bag", "lz4"),
]


@pytest.mark.parametrize("suffix, compression", CONTAINERS)
def test_every_container_format_is_read(tmp_path, suffix, compression):
    source = open_source(write(tmp_path / f"drive{suffix}", clouds(suffix), compression=compression))
    for _ in range(2):
        frames = list(source)
        assert [frame.id for frame in frames] == [f"{k:06d}" for k in range(6)] and source.count == 6
        assert np.allclose([frame.time - START / 1e9 for frame in frames], np.arange(6) / 10, atol=1e-6)
        for k, frame in enumerate(frames):
            assert np.array_equal(frame.points, points_of(k)) and frame.T_world_sensor is None
            assert np.array_equal(frame.origin, np.zeros(3)) and frame.ring is None
    assert [frame.index for frame in source.frames(4)] == [4, 5] and not source.warnings
    assert open_source(source.name, meta="a.json").warnings[0].endswith("does not have are ignored: meta")


@pytest.mark.parametrize("has_chunk", [True, False])
def test_mcap_without_index_is_read(tmp_path, has_chunk):
    """As written by streaming recorders: lz4 chunks or no chunks, no summary, ROS 1 messages."""

    def record(op, content):
        return struct.pack("<BQ", op, len(content)) + content

    def text(value):
        return struct.pack("<I", len(value)) + value.encode()

    records = record(3, struct.pack("<H", 7) + text("sensor_msgs/PointCloud2") + text("ros1msg") + text(""))
    records += record(4, struct.pack("<HH", 3, 7) + text("/points") + text("ros1") + text(""))
    for k in range(4):
        message = ROS1.serialize_ros1(cloud(points_of(k), store=ROS1, stamp=START + k), CLOUD)
        records += record(5, struct.pack("<HIQQ", 3, k, START + k, START + k) + bytes(message))
    if has_chunk:
        lz4 = pytest.importorskip("lz4.frame")
        packed = lz4.compress(records)
        head = struct.pack("<QQQI", START, START + 3, len(records), 0) + text("lz4")
        records = record(6, head + struct.pack("<Q", len(packed)) + packed)
    magic = b"\x89MCAP0\r\n"
    data = magic + record(1, text("") + text("by hand")) + records + record(15, bytes(4)) + record(2, bytes(20)) + magic
    (tmp_path / "a.mcap").write_bytes(data)
    source = open_source(tmp_path / "a.mcap")
    assert source.count == 4 and not source.warnings
    for k, frame in enumerate(source):
        assert np.array_equal(frame.points, points_of(k))


@pytest.mark.parametrize("suffix", [".mcap", ".bag"])
def test_impossible_position_of_index_is_ignored(tmp_path, suffix):
    path = write(tmp_path / f"drive{suffix}", clouds(suffix))
    data = bytearray(path.read_bytes())
    at = len(data) - 28 if suffix == ".mcap" else data.index(b"index_pos=") + len(b"index_pos=")
    data[at : at + 8] = b"\xff" * 8
    path.write_bytes(data)
    assert len(list(open_source(path))) == 6


def test_ros2_folder_includes_all_its_files(tmp_path):
    file = write(tmp_path / "drive.mcap", clouds(".mcap"))
    second = write(tmp_path / "next.mcap", clouds(".mcap", 3))
    second.rename(file.with_name("drive_10.mcap"))
    file.rename(file.with_name("drive_2.mcap"))
    source = open_source(tmp_path / "drive")
    assert source.count == 9 and len(list(source)) == 9
    (tmp_path / "drive" / "metadata.yaml").unlink()
    assert len(list(open_source(tmp_path / "drive"))) == 9


LAYOUTS = {
    "plain": {},
    "doubles": dict(fields=(("x", 0, "f8"), ("y", 8, "f8"), ("z", 16, "f8")), step=24),
    "big-endian": dict(big=True),
    "padded rows": dict(height=4, pad=10),
    "unaligned, any order": dict(
        fields=(("z", 1, "f4"), ("intensity", 5, "u1"), ("y", 6, "f8"), ("x", 14, "f4")), step=19
    ),
    "ring": dict(fields=(*XYZ, ("intensity", 12, "f4"), ("ring", 16, "u2")), step=22),
    "ring of another name, all odd": dict(
        fields=(("line", 0, "u1"), ("x", 3, "f8"), ("y", 11, "f4"), ("z", 15, "f4")), step=21, big=True, height=2, pad=3
    ),
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_decode_cloud_reads_all_field_layouts(name):
    points = points_of(3)
    points[[2, 5]] = np.nan
    ring = np.arange(len(points)) % 128
    message = cloud(points, **LAYOUTS[name], extra={key: ring for key in ("ring", "line", "intensity")})
    got, got_ring, got_times = decode_cloud(ROS2.deserialize_cdr(ROS2.serialize_cdr(message, CLOUD), CLOUD))
    assert np.array_equal(got, points, equal_nan=True)
    assert np.array_equal(got_ring, ring) if "ring" in name else got_ring is None
    assert got_times is None


@pytest.mark.parametrize("row_step", [0, 10, 40 * 16])
def test_decode_cloud_ignores_row_steps_that_do_not_fit(row_step):
    """As published by drivers that leave it 0, or set it to the number of points or to the size of the whole cloud."""
    message = cloud(points_of(3), height=4)
    message.row_step = row_step
    assert np.array_equal(decode_cloud(message)[0], points_of(3))
    message.data = message.data[:-1]
    with pytest.raises(FormatError, match="cut off"):
        decode_cloud(message)


LIVOX_POINT = "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line"
LIVOX = "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\nCustomPoint[] points"
for livox_store in (ROS1, ROS2):
    livox_store.register(get_types_from_msg(LIVOX_POINT, "livox_ros_driver2/msg/CustomPoint"))
    livox_store.register(get_types_from_msg(LIVOX, "livox_ros_driver2/msg/CustomMsg"))


def livox_message(points, store, stamp, frame="livox_frame"):
    types = store.types
    custom_points = [
        types["livox_ros_driver2/msg/CustomPoint"](k, *map(float, xyz), reflectivity=5, tag=16, line=k % 4)
        for k, xyz in enumerate(points)
    ]
    head = header(store, stamp, frame)
    rest = {"timebase": 7, "point_num": len(points), "lidar_id": 1, "rsvd": np.zeros(3, np.uint8)}
    return types["livox_ros_driver2/msg/CustomMsg"](header=head, **rest, points=custom_points)


@pytest.mark.parametrize("frame", ["livox", "livox_frame"])
@pytest.mark.parametrize("suffix", [".mcap", ".db3", ".bag"])
def test_livox_messages_become_frames(tmp_path, suffix, frame):
    store = store_of(suffix)
    messages = [
        ("/livox/lidar", livox_message(points_of(k, 39 + k), store, START + k * 10**8, frame), START + k * 10**8)
        for k in range(3)
    ]
    source = open_source(write(tmp_path / f"walk{suffix}", messages))
    frames = list(source)
    assert source.count == len(frames) == 3 and not source.warnings
    for k, sweep in enumerate(frames):
        assert np.array_equal(sweep.points, points_of(k, 39 + k)) and sweep.time == START / 1e9 + k / 10
        assert np.array_equal(sweep.ring, np.arange(39 + k) % 4) and np.array_equal(sweep.origin, np.zeros(3))


def test_decode_livox_refuses_cut_and_reads_big_endian_messages():
    name = "livox_ros_driver2/msg/CustomMsg"
    message = livox_message(points_of(1), ROS2, START)
    for is_little in (True, False):
        data = bytes(ROS2.serialize_cdr(message, name, little_endian=is_little))
        assert np.array_equal(livox.decode_cloud(data, "cdr").points, points_of(1))
        with pytest.raises(FormatError, match="cut off"):
            livox.decode_cloud(data[:-4], "cdr")
    empty = bytes(ROS1.serialize_ros1(livox_message([], ROS1, START), name))
    assert livox.decode_cloud(empty, "ros1").points.shape == (0, 3)


SCAN = "velodyne_msgs/msg/VelodyneScan"
for velodyne_store in (ROS1, ROS2):
    velodyne_store.register(
        get_types_from_msg("time stamp\nuint8[1206] data", "velodyne_msgs/msg/VelodynePacket")
        | get_types_from_msg("std_msgs/Header header\nVelodynePacket[] packets", SCAN)
    )


def velodyne_message(packets, store, stamp):
    types = store.types
    times = [header(store, stamp + 1_330_000 * k, "").stamp for k in range(len(packets))]
    packet_type = types["velodyne_msgs/msg/VelodynePacket"]
    packets = [
        packet_type(stamp=time, data=np.frombuffer(data, np.uint8)) for time, data in zip(times, packets, strict=True)
    ]
    return types[SCAN](header=header(store, stamp, "velodyne"), packets=packets)


@pytest.mark.parametrize("suffix", [".mcap", ".db3", ".bag"])
def test_velodyne_packets_of_messages_become_frames(tmp_path, suffix):
    pytest.importorskip("velodyne_decoder", reason="the extra recordings is not installed")
    store = store_of(suffix)
    turns = [[vlp16(k * 480 % 36000, k * 1330, distance) for k in range(75)] for distance in (5000, 2500)]
    turns.append([bytes(1206)] * 75)
    messages = [
        ("/velodyne_packets", velodyne_message(packets, store, START + k * 10**8), START + k * 10**8)
        for k, packets in enumerate(turns)
    ]
    source = open_source(write(tmp_path / f"walk{suffix}", messages))
    first, second, damaged = list(source)
    assert source.count == 3 and isinstance(damaged, DamagedFrame)
    for k, (sweep, distance) in enumerate([(first, 10), (second, 5)]):
        assert np.allclose(np.linalg.norm(sweep.points, axis=1), distance, atol=0.1)
        assert sorted(np.unique(sweep.ring)) == list(range(16)) and sweep.time == START / 1e9 + k / 10
        assert len(sweep.points) == 75 * 12 * 32 and np.array_equal(sweep.origin, np.zeros(3))


PACKET = "ouster_sensor_msgs/msg/PacketMsg"
for ouster_store in (ROS1, ROS2):
    ouster_store.register(get_types_from_msg("uint8[] buf", PACKET))


def ouster_messages(store, *, text):
    """Two turns of an Ouster sensor, packet by packet, among packets of its IMU, and its metadata."""
    types = store.types
    payloads = packets_of([7, 8])
    times = [START + k * 10**6 for k in range(len(payloads))]
    packet_type = types[PACKET]
    messages = [
        ("/ouster/lidar_packets", packet_type(buf=np.frombuffer(payload, np.uint8)), time)
        for payload, time in zip(payloads, times, strict=True)
    ]
    messages.append(("/ouster/imu_packets", packet_type(buf=np.zeros(48, np.uint8)), START + 10**7))
    if text:
        messages.append(("/ouster/metadata", types["std_msgs/msg/String"](data=text), START))
    return messages


@pytest.mark.parametrize("suffix", [".mcap", ".db3", ".bag"])
def test_ouster_packets_of_messages_become_frames(tmp_path, suffix):
    text = json.dumps(metadata())
    source = open_source(write(tmp_path / f"walk{suffix}", ouster_messages(store_of(suffix), text=text)))
    frames = list(source)
    assert len(frames) == 2 and source.warnings == ()
    for frame, number in zip(frames, (7, 8), strict=True):
        np.testing.assert_allclose(decoded(frame), expected_points(ranges_of(number)), atol=1e-9)
    # the metadata may be in a file
    path = write(tmp_path / f"no{suffix}", ouster_messages(store_of(suffix), text=""))
    (tmp_path / "meta.json").write_text(text)
    assert len(list(open_source(path, meta=tmp_path / "meta.json"))) == 2
    with pytest.raises(InputError, match=r"no topic with its metadata: give the sensor's JSON file \(--meta\)"):
        open_source(path)
    # clouds come first, but the topic of the packets can be named
    both = [*clouds(suffix, count=2), *ouster_messages(store_of(suffix), text=text)]
    path = write(tmp_path / f"both{suffix}", both)
    assert len(next(iter(open_source(path))).points) == 40
    (first, _) = open_source(path, topic="/ouster/lidar_packets")
    assert np.array_equal(first.points, frames[0].points)
    with pytest.raises(InputError, match="expected lidar packets of"):
        open_source(path, topic="/ouster/imu_packets")


def test_two_ouster_sensors_are_decoded_with_their_own_metadata(tmp_path):
    left = ouster_messages(ROS2, text=json.dumps(metadata()))
    right = ouster_messages(
        ROS2, text=json.dumps(metadata(beam_azimuth_angles=[90.0] * len(metadata()["beam_azimuth_angles"])))
    )
    messages = [
        (topic.replace("/ouster", f"/{name}"), content, time)
        for name, sensor in (("left", left), ("right", right))
        for topic, content, time in sensor
    ]
    path = write(tmp_path / "two.mcap", messages)
    source = open_source(path)
    for frame, number in zip(source, (7, 8), strict=True):
        np.testing.assert_allclose(decoded(frame), expected_points(ranges_of(number)), atol=1e-9)
    assert any("read the sensor /left, not /right: give the topic" in line for line in source.warnings)
    named, other = (list(open_source(path, topic=f"/{name}/lidar_packets"))[0].points for name in ("left", "right"))
    assert np.array_equal(named, list(source)[0].points) and not np.allclose(named, other)


@pytest.mark.parametrize("suffix", [".mcap", ".db3"])
def test_topic_without_clouds_does_not_hide_packets(tmp_path, suffix):
    messages = ouster_messages(store_of(suffix), text=json.dumps(metadata()))
    path = write(tmp_path / f"walk{suffix}", messages, empty=("/costmap",))
    assert len(list(open_source(path))) == 2


def test_transforms_of_other_times_are_named(tmp_path):
    """As of a sensor whose clock counts from its start."""
    moves = [("/tf", transform(START + k * 10**8, "map", "lidar", (k, 0, 0)), START + k * 10**8) for k in range(6)]
    own = [("/p", cloud(points_of(k), stamp=50 * 10**9 + k * 10**8), START + k * 10**8) for k in range(6)]
    source = open_source(write(tmp_path / "a.mcap", sorted([*moves, *own], key=lambda message: message[2])))
    assert [frame.T_world_sensor for frame in source] == [None] * 6
    assert source.warnings == ("no cloud has a sensor pose: the transforms to map are of other times than the clouds",)


def test_folder_of_scans_may_have_metadata_yaml(tmp_path):
    (tmp_path / "metadata.yaml").write_text("sensor: OS1")
    for name in "ab":
        np.save(tmp_path / f"{name}.npy", points_of(1))
    assert len(list(open_source(tmp_path, rate=10))) == 2


def test_invalid_returns_are_dropped_with_their_rings(tmp_path):
    points = points_of(1)
    points[3], points[7] = np.nan, 0
    fields = (*XYZ, ("ring", 12, "u2"))
    message = cloud(points, fields=fields, extra={"ring": np.arange(len(points))}, stamp=0)
    source = open_source(write(tmp_path / "a.mcap", [("/points", message, START)]))
    (frame,) = source
    rest = np.delete(np.arange(len(points)), [3, 7])
    assert np.array_equal(frame.points, points[rest]) and np.array_equal(frame.ring, rest)
    # without a stamp, the recording time is used
    assert frame.time == START / 1e9 and "their recording times" in source.warnings[0]


@pytest.mark.parametrize("suffix", [".mcap", ".db3", ".bag"])
def test_topic_can_be_selected_and_is_listed(tmp_path, suffix):
    store = store_of(suffix)
    rare = [("/rear/points", cloud(points_of(9), store=store), START)]
    path = write(tmp_path / f"two{suffix}", rare + clouds(suffix))
    source = open_source(path)
    assert len(list(source)) == 6
    assert "/points (6)" in source.warnings[0] and "/rear/points (1)" in source.warnings[0]
    source = open_source(path, topic="/rear/points")
    assert np.array_equal(next(iter(source)).points, points_of(9)) and not source.warnings
    with pytest.raises(InputError, match=r"'/front'; topics with clouds: .*/points \(6\)"):
        open_source(path, topic="/front")

    text = store.types["std_msgs/msg/String"](data="hello")
    path = write(tmp_path / f"none{suffix}", [("/chatter", text, START), ("/other", text, START)])
    with pytest.raises(InputError, match="no point clouds.*/chatter .*String.*/other") as error:
        open_source(path)
    assert "\n" not in str(error.value)


def test_background_is_learned_from_selected_topic(tmp_path, capsys):
    messages = clouds(".mcap") + [("/rear", cloud(points_of(9) + 90), START + k * 10**8) for k in range(3)]
    path = str(write(tmp_path / "two.mcap", messages))
    assert is_static(points_of(9) + 90, learn_background(path, topic="/rear")).all()
    frame = next(predict_recording(path, topic="/rear", background=path))
    assert "no people found off the background, on which 100% of the points lie" in str(frame.poses.warnings)
    words = ["--topic", "/rear", "--background", path, "--out", str(tmp_path / "a.jsonl")]
    assert main(["predict", path, *words]) == 0
    assert "no people found off the background, on which 100% of the points lie" in capsys.readouterr().err


@pytest.mark.parametrize("suffix", [".mcap", ".bag"])
def test_sensor_poses_come_from_transforms(tmp_path, suffix):
    """A vehicle drives along a line and turns; transforms are recorded after the clouds to which they apply."""
    store = store_of(suffix)
    messages = [("/tf_static", transform(0, "base_link", "lidar", (1, 0, 2), np.pi / 2, store), START - 1)]
    for k in range(12):
        time = START + k * 10**8 - 5 * 10**7
        messages.append(("/tf", transform(time, "odom", "base_link", (k, 0, 0), 0.1 * k, store), time + 15 * 10**7))
        messages.append(("/tf", transform(time, "map", "odom", (0, 5, 0), 0.0, store), time + 15 * 10**7))
    messages = sorted(messages + clouds(suffix, 10), key=lambda message: message[2])
    source = open_source(write(tmp_path / f"drive{suffix}", messages))
    frames = list(source)
    assert len(frames) == 10 and source.count == 10
    for k, frame in enumerate(frames):
        yaw = 0.1 * (k + 0.5)
        x, y = k + 0.5 + np.cos(yaw), 5 + np.sin(yaw)
        assert np.allclose(frame.T_world_sensor[:3, 3], [x, y, 2], atol=2e-3)
        heading = yaw + np.pi / 2
        assert np.allclose(frame.T_world_sensor[:2, 0], [np.cos(heading), np.sin(heading)], atol=2e-3)
    assert [frame.index for frame in source.frames(7)] == [7, 8, 9]


def test_resumed_recording_keeps_world_frame(tmp_path):
    """`odom` is known from cloud 15 on; `map`, which is preferred, from cloud 25 on."""
    messages = clouds(".mcap", 40)
    for k in range(15, 40):
        time = START + k * 10**8
        messages.append(("/tf", transform(time, "odom", "lidar", (k, 0, 0)), time))
        if k >= 25:
            messages.append(("/tf", transform(time, "map", "odom", (1000, 0, 0)), time))
    path = write(tmp_path / "drive.mcap", sorted(messages, key=lambda message: message[2]))
    for first in (15, 30):
        places = [frame.T_world_sensor[0, 3] for frame in open_source(path).frames(first)]
        assert places == list(range(first, 40))


@pytest.mark.parametrize(
    "names", [("drive_0.mcap", "drive_1.mcap"), ("a_2024-05-01-10-00-00_0.bag", "a_2024-05-01-10-00-02_1.bag")]
)
def test_split_recording_without_metadata_is_joined(tmp_path, names):
    """The static transform of the sensor is in the first file only."""
    folder = tmp_path / "drive"
    folder.mkdir()
    for part, name in enumerate(names):
        suffix = Path(name).suffix
        messages = clouds(suffix, 20)[10 * part : 10 * part + 10]
        for k in range(10 * part, 10 * part + 10):
            time = START + k * 10**8
            messages.append(("/tf", transform(time, "odom", "base", (k, 0, 0), store=store_of(suffix)), time))
        if not part:
            placed = transform(START, "base", "lidar", (0, 0, 2), store=store_of(suffix))
            messages.append(("/tf_static", placed, START - 1))
        write(tmp_path / f"{part}{suffix}", sorted(messages, key=lambda message: message[2])).rename(folder / name)
    for source in (open_source(folder), open_source(str(folder / "*"))):
        assert [frame.T_world_sensor[0, 3] for frame in source] == list(range(20)) and not source.warnings
    # an empty part is left out
    (folder / names[1]).write_bytes(b"")
    source = open_source(folder)
    assert len(list(source)) == 10 and "left out: " in source.warnings[0]


def test_sensor_pose_is_none_without_transform_chain(tmp_path):
    gone = ("/tf", transform(START, "map", "base_link", (0, 0, 0)), START)
    far = [("/tf", transform(START + t, "odom", "lidar", (t / 1e9, 0, 0)), START + t) for t in (0, 10**8, 5 * 10**9)]
    circle = [
        ("/tf", transform(START, a, b, (0, 0, 0)), START) for a, b in (("lidar", "a"), ("a", "b"), ("b", "lidar"))
    ]
    wild = [
        ("/tf", transform(START + t, "map", "lidar", at), START) for t, at in enumerate(((1e300, 0, 0), (np.nan, 0, 0)))
    ]
    wild[0][1].transforms[0].transform.rotation.__dict__.update(z=1e200)
    for k, (transforms, num_posed) in enumerate((([gone], 0), (far, 2), (circle, 0), (wild, 0))):
        path = write(tmp_path / f"{k}.mcap", sorted([*transforms, *clouds(".mcap")], key=lambda message: message[2]))
        source = open_source(path)
        poses = [frame.T_world_sensor for frame in source]
        assert [pose is not None for pose in poses] == [i < num_posed for i in range(6)]
        assert len(source.warnings) == (num_posed > 0)

    # clouds without a frame id
    nameless = [("/p", cloud(points_of(k), stamp=START + k, frame=""), START + k) for k in range(2)]
    source = open_source(write(tmp_path / "nameless.mcap", nameless))
    assert [frame.T_world_sensor for frame in source] == [None, None] and not source.warnings

    # a cloud that is already in the world frame; the sensor's position is unknown
    (frame,) = open_source(write(tmp_path / "map.mcap", [("/p", cloud(points_of(1), frame="/map"), START)]))
    assert np.array_equal(frame.T_world_sensor, np.eye(4)) and frame.origin is None and frame.is_origin_unknown


@pytest.mark.long
@pytest.mark.parametrize("suffix, compression", CONTAINERS)
def test_truncated_recording_keeps_complete_frames(tmp_path, suffix, compression):
    path = write(tmp_path / f"drive{suffix}", clouds(suffix, 40, 2000), compression=compression)
    data = path.read_bytes()
    most = 0
    for share in (0.02, 0.3, 0.6, 0.9, 0.999):
        path.write_bytes(data[: int(share * len(data))])
        try:
            frames = list(open_source(path))
        except InputError as error:
            # bz2 compresses blocks of 900 kB
            assert "\n" not in str(error) and share < (0.7 if compression == "bz2" else 0.5)
            continue
        whole = [frame for frame in frames if not isinstance(frame, DamagedFrame)]
        for k, frame in enumerate(whole):
            assert np.array_equal(frame.points, points_of(k, 2000))
        assert len(whole) >= most and len(frames) - len(whole) <= 1 and (len(whole) == 40 or len(frames) > len(whole))
        most = len(whole)
    assert most >= 35


@pytest.mark.parametrize("suffix", [".mcap", ".db3", ".bag"])
def test_damaged_bytes_lose_frames_only(tmp_path, suffix):
    path = write(tmp_path / f"drive{suffix}", clouds(suffix, 8))
    data = path.read_bytes()
    random = np.random.default_rng(5)
    for broken in with_changed_bytes(data, random, 20):
        path.write_bytes(broken)
        try:
            frames = list(open_source(path))
        except InputError as error:
            assert "\n" not in str(error)
        else:
            assert all(isinstance(frame, DamagedFrame) or np.isfinite(frame.points).all() for frame in frames)


@pytest.mark.parametrize("suffix, compression", [(".mcap", None), (".mcap", "zstd"), (".bag", None), (".bag", "lz4")])
def test_damaged_first_chunk_loses_only_itself(tmp_path, suffix, compression):
    """Even if only that chunk names the topic, and if the size of a record in it is damaged."""
    path = write(tmp_path / f"drive{suffix}", clouds(suffix, 6, 30_000), compression=compression)
    data = bytearray(path.read_bytes())
    if suffix == ".mcap":
        at = data.index(b"zstd") + 12 if compression else data.index(b"[]\x05") + 3
    else:
        at = data.index(b"op=\x05") + 100 if compression else data.index(b"op=\x02") - 8
    data[at : at + 8] = b"\xaa" * 8
    path.write_bytes(data)
    source = open_source(path)
    frames = list(source)
    assert len(frames) == 3 and source.count == 6
    for k, frame in enumerate(frames, 3):
        assert np.array_equal(frame.points, points_of(k, 30_000))
    assert re.fullmatch(r"drive\w*\.\w+: 1 chunks are left out: one .*", *source.warnings)


def test_clouds_with_inconsistent_layout_are_damaged_frames(tmp_path):
    good = cloud(points_of(0))
    broken = []
    for change in (
        dict(data=good.data[:-1]),
        dict(width=2**31),
        dict(height=3, row_step=1),
        dict(point_step=6),
        dict(fields=good.fields[:2]),
    ):
        message = cloud(points_of(0))
        for name, value in change.items():
            object.__setattr__(message, name, value)
        broken.append(message)
    messages = [("/points", message, START + k) for k, message in enumerate([*broken, good])]
    *damaged, last = open_source(write(tmp_path / "a.db3", messages))
    assert all(isinstance(frame, DamagedFrame) and "\n" not in frame.error for frame in damaged) and len(damaged) == 5
    assert np.array_equal(last.points, points_of(0))


def test_damaged_message_gets_time_of_sensor_clock(tmp_path):
    """The clock of the sensor starts at power-on."""
    boot = [("/points", cloud(points_of(k), stamp=5 * 10**9 + k * 10**8), START + k * 10**8) for k in range(8)]
    path = write(tmp_path / "a.mcap", boot)
    data = path.read_bytes()
    at = -1
    for _ in range(4):
        at = data.index(b"lidar\0", at + 1)
    # corrupt the length of the frame id
    path.write_bytes(data[: at - 4] + b"\xff\xff\xff\x7f" + data[at:])
    source = open_source(path, end=0.5)
    frames = list(source)
    assert [isinstance(frame, DamagedFrame) for frame in frames] == [k == 3 for k in range(6)]
    # the type of the error tells a bug from a damaged message
    assert re.fullmatch(r"cannot be decoded .*: the message is damaged \(\w+Error: .+\)", frames[3].error)
    np.testing.assert_allclose([frame.time for frame in frames], 5 + np.arange(6) / 10)
    assert not source.warnings


def test_mcap_chunk_above_size_limit_is_skipped(tmp_path):
    path = write(tmp_path / "drive.mcap", clouds(".mcap"), compression="zstd")
    data = bytearray(path.read_bytes())
    at = data.index(b"\x04\x00\x00\x00zstd") - 12
    struct.pack_into("<Q", data, at, 2**40)
    path.write_bytes(data)
    with pytest.raises(InputError, match="no frames"):
        open_source(path)


def test_open_source_rejects_invalid_recordings(tmp_path):
    for suffix in (".mcap", ".db3", ".bag"):
        for content in (b"", b"nothing of the kind" * 9):
            path = Path(tmp_path / f"a{suffix}")
            path.write_bytes(content)
            with pytest.raises(InputError) as error:
                open_source(path)
            assert "\n" not in str(error.value) and path.name in str(error.value)
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "metadata.yaml").write_text("")
    with pytest.raises(InputError, match="expected a recording's .mcap"):
        open_source(tmp_path / "folder")


@pytest.mark.parametrize(
    "changes",
    [
        # 7 bytes instead of 8 per connection; a field without a value and another field longer by one byte
        {b"\x01\x00\x00\x00\x08\x00\x00\x00\x00": b"\x01\x00\x00\x00\x07\x00\x00\x00\x00"},
        {b"\x04\x00\x00\x00op=\x06": b"\x03\x00\x00\x00op=", b"\x0a\x00\x00\x00count=": b"\x0b\x00\x00\x00count=\x00"},
    ],
    ids=["odd length", "no operation"],
)
def test_damaged_last_bag_record_keeps_earlier_frames(changes, tmp_path):
    path = write(tmp_path / "drive.bag", clouds(".bag"))
    # the chunk info record
    at = path.read_bytes().index(b"op=\x06") - 8
    start, info = path.read_bytes()[:at], path.read_bytes()[at:]
    for old, new in changes.items():
        assert info.count(old) == 1
        info = info.replace(old, new)
    path.write_bytes(start + info)
    *frames, last = open_source(path)
    assert isinstance(last, DamagedFrame) and "drive.bag: is damaged (" in last.error and "\n" not in last.error
    assert len(frames) == 6
    for k, frame in enumerate(frames):
        assert np.array_equal(frame.points, points_of(k))


def test_sqlite_recording_continues_in_another_thread(tmp_path):
    source = open_source(write(tmp_path / "drive.db3", clouds(".db3")))
    frames = source.frames(2)
    first = next(frames)
    with ThreadPoolExecutor(1) as pool:
        others = pool.submit(list, frames).result()
    for k, frame in enumerate([first, *others]):
        assert np.array_equal(frame.points, points_of(k + 2))
    assert len(others) == 3
