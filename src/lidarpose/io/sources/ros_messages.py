"""ROS messages: their types here, and functions that decode them with the library rosbags."""

from collections.abc import Callable
from functools import cache
from itertools import product
from typing import Any

import numpy as np

from lidarpose.errors import needs_extra
from lidarpose.io.files import FormatError, shorten
from lidarpose.io.point_times import time_column, times_of_column
from lidarpose.io.sources import livox, ouster, velodyne

CLOUD_TYPES = ("sensor_msgs/msg/PointCloud2", "sensor_msgs/PointCloud2")
TRANSFORM_TYPES = ("tf2_msgs/msg/TFMessage", "tf2_msgs/TFMessage", "tf/tfMessage")
TEXT_TYPES = ("std_msgs/msg/String", "std_msgs/String")
# types of messages that are frames
FRAME_TYPES = (*CLOUD_TYPES, *livox.TYPES, *velodyne.SCAN_TYPES)
# data types of a PointField
_DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
# names of the fields in which drivers publish a point's beam
_RING = ("ring", "channel", "line", "laser_id")


@cache
def decoders() -> dict[str, Callable[[bytes, str], Any]]:
    """The function that decodes messages, for each encoding."""
    with needs_extra("reading a ROS recording"):
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    ros1, ros2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
    ros1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TRANSFORM_TYPES[0]))
    definitions = velodyne.SCAN_DEFINITIONS | {ouster.PACKET_TYPES[0]: ouster.PACKET_DEFINITION}
    for store, (name, definition) in product((ros1, ros2), definitions.items()):
        store.register(get_types_from_msg(definition, name))
    return {"cdr": ros2.deserialize_cdr, "ros1": ros1.deserialize_ros1}


def _is_within(field: Any, point_step: int) -> bool:
    """Whether a PointField has a known type and lies within a point."""
    size = np.dtype(_DATATYPES.get(field.datatype, "f8")).itemsize
    return field.datatype in _DATATYPES and field.offset + size <= point_step


def decode_cloud(cloud: Any) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
    """The points (n, 3) of a PointCloud2, float64, and the ring (n,) and the time (n,) of each if it has one.

    Fields may lie anywhere in a point, in any number type and either byte order; rows may be padded.

    Raises:
        FormatError: The cloud has no x, y, z, or its layout does not fit its data.
    """
    names = {field.name.lower(): field for field in reversed(cloud.fields)}
    ring = next((name for name in _RING if name in names), None)
    field_names = ["x", "y", "z", *([ring] if ring else [])]
    if not {"x", "y", "z"} <= names.keys():
        actual = shorten(", ".join(names)) or "none"
        raise FormatError("fields x, y, z in a PointCloud2", actual, "choose another topic")
    order = ">" if cloud.is_bigendian else "<"
    for name in field_names:
        if not _is_within(field := names[name], cloud.point_step):
            actual = f"datatype {field.datatype} at byte {field.offset} of {cloud.point_step}"
            raise FormatError(f"the field {name} within a point", actual, "record it again")
    time_index = time_column(list(names))
    time = None if time_index is None else list(names)[time_index]
    field_names += [time] if time and _is_within(names[time], cloud.point_step) else []
    formats = [order + _DATATYPES[names[name].datatype] for name in field_names]
    offsets = [names[name].offset for name in field_names]
    point = np.dtype({"names": field_names, "formats": formats, "offsets": offsets, "itemsize": cloud.point_step})
    row_bytes = cloud.width * cloud.point_step
    row_step = cloud.row_step
    if row_step < row_bytes or row_step * (cloud.height - 1) + row_bytes > len(cloud.data):
        # many drivers do not set the row step, or set it to the size of the whole cloud
        row_step = row_bytes
    if row_bytes * cloud.height > len(cloud.data):
        layout = f"{cloud.height} rows of {cloud.width} points of {cloud.point_step} bytes"
        raise FormatError(layout, f"{len(cloud.data)} bytes", "the cloud is cut off")
    shape, strides = (cloud.height, cloud.width), (row_step, cloud.point_step)
    rows = np.ndarray(shape, point, cloud.data, strides=strides) if cloud.width * cloud.height else np.empty(0, point)
    points = np.stack([rows[name].ravel().astype(np.float64) for name in "xyz"], axis=-1)
    times = None
    if time in field_names:
        times = times_of_column(rows[time].ravel().astype(np.float64), list(names))
    if ring is None:
        return points, None, times
    with np.errstate(invalid="ignore"):
        return points, rows[ring].ravel().astype(np.int64), times
