"""Waymo Open Dataset, Perception, version 1.4 (1.3.0 and later have keypoints): frames as protobuf in TFRecords.

    ROOT/{training,validation}/segment-NAME_with_camera_labels.tfrecord

Read without TensorFlow: the required fields are declared here, protobuf skips all others. Source:
waymo-research/waymo-open-dataset dataset.proto, label.proto, protos/keypoint.proto, protos/vector.proto.

A TFRecord file is a sequence of records: length (uint64, little-endian), its checksum (uint32), data, its checksum. A
checksum is the CRC-32C of the bytes, rotated right by 15 bits, plus a constant.
"""

import reprlib
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose.data.readers import waymo_frames as frames
from lidarpose.data.readers.base import BAD_REST, Skipped
from lidarpose.errors import InputError, MissingExtra
from lidarpose.io.files import file_error, unreadable
from lidarpose.sample import LabeledSample

try:
    import google_crc32c
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
    from google.protobuf.message import DecodeError
except ImportError:
    raise MissingExtra("reading Waymo", "synth") from None

SPLITS = ("training", "validation")

# Protobuf needs up to twenty times the bytes of a repeated field, so messages larger than any frame needs are rejected
# before parsing. Frames have about 5 MB; images of the top laser 64 x 2650 pixels of up to 6 values; shapes 3 sizes.
_LARGEST_FRAME = 1 << 25
_LARGEST_IMAGE = 4 << 24
_LARGEST_SHAPE = 1 << 16

# message -> its fields that are read, as name:number:type; "*" marks repeated fields. The data of a matrix is packed
# according to dataset.proto: its bytes are the array
_MESSAGES = {
    "Frame": "context:1:Context timestamp_micros:2:int64 pose:3:Transform lasers:5:*Laser laser_labels:6:*Label",
    "Context": "name:1:bytes laser_calibrations:3:*LaserCalibration",
    "Transform": "transform:1:*double",
    "LaserCalibration": "name:1:int64 beam_inclinations:2:*double beam_inclination_min:3:double "
    "beam_inclination_max:4:double extrinsic:5:Transform",
    "Laser": "name:1:int64 ri_return1:2:RangeImage ri_return2:3:RangeImage",
    "RangeImage": "range_image_compressed:2:bytes range_image_pose_compressed:4:bytes",
    "MatrixFloat": "data:1:bytes shape:2:bytes",
    "Shape": "dims:1:*int64",
    "Label": "box:1:Box type:3:int64 id:4:bytes num_lidar_points_in_box:7:int64 laser_keypoints:8:LaserKeypoints",
    "Box": "center_x:1:double center_y:2:double center_z:3:double width:4:double length:5:double height:6:double "
    "heading:7:double",
    "LaserKeypoints": "keypoint:1:*LaserKeypoint",
    "LaserKeypoint": "type:1:int64 keypoint_3d:2:Keypoint3d",
    "Keypoint3d": "location_m:1:Vec3d visibility:2:Visibility",
    "Vec3d": "x:1:double y:2:double z:3:double",
    "Visibility": "is_occluded:1:bool",
}


def _message_classes() -> dict[str, Any]:
    """The class of each message, in a separate descriptor pool: Waymo's generated code may also be loaded."""
    file = descriptor_pb2.FileDescriptorProto(name="waymo.proto", package="waymo", syntax="proto2")
    field_proto = descriptor_pb2.FieldDescriptorProto
    for message, fields in _MESSAGES.items():
        message_proto = file.message_type.add(name=message)
        for name, number, kind in (field.split(":") for field in fields.split()):
            label = field_proto.LABEL_REPEATED if kind.startswith("*") else field_proto.LABEL_OPTIONAL
            kind = kind.removeprefix("*")
            if kind in _MESSAGES:
                type_options = {"type": field_proto.TYPE_MESSAGE, "type_name": f".waymo.{kind}"}
            else:
                type_options = {"type": getattr(field_proto, f"TYPE_{kind.upper()}")}
            message_proto.field.add(name=name, number=int(number), label=label, **type_options)
    pool = descriptor_pool.DescriptorPool()
    pool.AddSerializedFile(file.SerializeToString())
    return {name: message_factory.GetMessageClass(pool.FindMessageTypeByName(f"waymo.{name}")) for name in _MESSAGES}


_CLASSES = _message_classes()


def parse(message: str, data: bytes, largest: int) -> Any:
    """Parses a message of `_MESSAGES`. Raises InputError if it has over `largest` bytes, is truncated or damaged."""
    if len(data) > largest:
        raise InputError(f"message {message} has {len(data):,} bytes, more than {largest:,}: damaged or not Waymo's")
    try:
        return _CLASSES[message].FromString(data)
    except DecodeError:
        raise InputError(f"message {message} is cut off or damaged") from None


def parts(root: Path) -> list[str]:
    """The TFRecord files, as paths below the root; may be empty."""
    paths = (path for split in SPLITS for path in (root / split).glob("*.tfrecord"))
    return sorted(path.relative_to(root).as_posix() for path in paths)


def read(root: Path, part: str) -> Iterator[LabeledSample | Skipped]:
    """All people with keypoints in a file, frame by frame. Everything after a damaged record is skipped."""
    start = None
    try:
        for number, data in enumerate(records(root / part)):
            try:
                frame = _frame(parse("Frame", data, _LARGEST_FRAME), start)
            except InputError as error:
                yield Skipped(frames.BAD_FRAME, f"{part}: record {number}: {error}")
                continue
            start = frame.start
            yield from frame.samples()
    except InputError as error:
        yield Skipped(BAD_REST, f"{part}: {error}")


def records(path: Path) -> Iterator[bytes]:
    """The records of a TFRecord file, one in memory at a time. Raises InputError if one is truncated or damaged: the
    following ones cannot be found, since each record determines where the next begins."""
    try:
        size = path.stat().st_size
        with open(path, "rb") as file:
            number = 0
            while head := file.read(12):
                if len(head) < 12:
                    raise file_error(path, f"is cut off in record {number}; copy it again")
                length = int.from_bytes(head[:8], "little")
                if _masked_checksum(head[:8]) != int.from_bytes(head[8:], "little"):
                    problem = "is not a TFRecord file" if number == 0 else f"is damaged at record {number}"
                    raise file_error(path, f"{problem} (the checksum of a length is wrong); copy it again")
                if file.tell() + length + 4 > size:
                    raise file_error(path, f"is cut off in record {number}; copy it again")
                data, checksum = file.read(length), file.read(4)
                if _masked_checksum(data) != int.from_bytes(checksum, "little"):
                    raise file_error(path, f"is damaged in record {number} (its checksum is wrong); copy it again")
                yield data
                number += 1
    except OSError as error:
        raise unreadable(path, error) from None


def _masked_checksum(data: bytes) -> int:
    crc = google_crc32c.value(data)
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF


def _frame(message: Any, start: int | None) -> frames.Frame:
    """A frame with its range images. start: timestamp of the segment's first frame, None if it is this one.

    Raises InputError if its labels cannot be read.
    """
    name = message.context.name.decode("utf-8", "replace")
    if not name or not message.HasField("timestamp_micros"):
        raise InputError("is not a frame of Waymo's perception dataset: it has no segment or no time")
    frame = frames.Frame(
        sequence=name,
        timestamp=message.timestamp_micros,
        start=message.timestamp_micros if start is None else start,
        people=[_person(label) for label in message.laser_labels if label.HasField("laser_keypoints")],
        calibrations={},
    )
    if frame.people:
        frame.calibrations = {laser.name: _calibration(laser) for laser in message.context.laser_calibrations}
        if message.HasField("pose"):
            frame.T_world_vehicle = frames.transform(message.pose.transform, "the vehicle's pose")
    for laser in message.lasers if frame.wanted else ():
        try:
            # pixel poses are stored with the first return and apply to both returns
            poses = _matrix(laser.ri_return1.range_image_pose_compressed)
            for return_number, image in enumerate((laser.ri_return1, laser.ri_return2), 1):
                if (values := _matrix(image.range_image_compressed)) is not None:
                    frame.add(laser.name, return_number, values[..., 0], poses)
        except InputError as error:
            frame.fail(frames.BAD_IMAGE, str(error))
    return frame


def _person(label: Any) -> frames.LabeledPerson | frames.Problem:
    keypoints, box, num_points = [], None, None
    for keypoint in label.laser_keypoints.keypoint:
        if keypoint.keypoint_3d.HasField("location_m"):
            location = keypoint.keypoint_3d.location_m
            keypoints.append(
                (keypoint.type, (location.x, location.y, location.z), keypoint.keypoint_3d.visibility.is_occluded)
            )
    if label.HasField("box"):
        b = label.box
        box = (b.center_x, b.center_y, b.center_z, b.length, b.width, b.height, b.heading)
    if label.HasField("num_lidar_points_in_box"):
        num_points = label.num_lidar_points_in_box
    return frames.person(label.id.decode("utf-8", "replace"), keypoints, box, label.type, num_points)


def _calibration(laser: Any) -> frames.Calibration:
    beams = np.array(laser.beam_inclinations)
    return frames.Calibration(
        laser=laser.name,
        T_vehicle_laser=frames.transform(laser.extrinsic.transform, f"the extrinsic of laser {laser.name}"),
        inclinations=beams if len(beams) else None,
        low=laser.beam_inclination_min if laser.HasField("beam_inclination_min") else None,
        high=laser.beam_inclination_max if laser.HasField("beam_inclination_max") else None,
    )


def _matrix(compressed: bytes) -> np.ndarray | None:
    """A zlib-compressed MatrixFloat -> (H, W, C) float32; None if it is missing."""
    if not compressed:
        return None
    inflate = zlib.decompressobj()
    try:
        content = inflate.decompress(compressed, _LARGEST_IMAGE)
    except zlib.error as error:
        raise InputError(f"a range image cannot be decompressed ({error})") from None
    if not inflate.eof:
        raise InputError("a range image is cut off or too large")
    matrix = parse("MatrixFloat", content, _LARGEST_IMAGE)
    sizes = list(parse("Shape", matrix.shape, _LARGEST_SHAPE).dims)
    count, remainder = divmod(len(matrix.data), 4)
    if remainder or not frames.is_image(sizes, count):
        raise InputError(f"a range image has {count} values, its stated shape is {reprlib.repr(sizes)}")
    return np.frombuffer(matrix.data, "<f4").reshape(sizes)
