"""Clouds in Livox's own ROS message, CustomMsg, which livox_ros_driver and livox_ros_driver2 publish for SLAM.

Formats: CustomMsg.msg and CustomPoint.msg of Livox-SDK/livox_ros_driver2; ROS 1 serialization; CDR (OMG DDSI-RTPS 10).
"""

import struct
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np

from lidarpose.io.files import FormatError
from lidarpose.io.point_times import times_of_column

_PACKAGES = ("livox_ros_driver2", "livox_ros_driver", "livox_interfaces")
TYPES = tuple(f"{package}/{folder}CustomMsg" for package in _PACKAGES for folder in ("msg/", ""))
_FIELDS = ("time", "xyz", "reflectivity", "tag", "line")
# bytes of a point; in CDR the next one begins at a multiple of 4
_POINT, _POINT_CDR = 19, 20


@dataclass(frozen=True, kw_only=True, eq=False)
class LivoxCloud:
    """points (n, 3) float64 m; ring (n,): each point's laser; times (n,) s, see `times_of_column`; header: as of a ROS
    message, with stamp and frame_id."""

    points: np.ndarray
    ring: np.ndarray
    times: np.ndarray | None
    header: SimpleNamespace


def decode_cloud(data: bytes, encoding: str) -> LivoxCloud:
    """The cloud in a message with the encoding "cdr" or "ros1".

    Raises:
        FormatError: The message is cut off. struct.error: it is cut off before its points.
    """
    is_cdr = encoding == "cdr"
    order = ">" if is_cdr and not data[1] & 1 else "<"
    # CDR begins with four bytes that name its byte order
    body = data[4:] if is_cdr else data
    position = 0

    def take(kind: str) -> int:
        nonlocal position
        size = struct.calcsize(kind)
        position += -position % size if is_cdr else 0
        position += size
        return struct.unpack_from(order + kind, body, position - size)[0]

    if not is_cdr:
        # ROS 1 counts messages
        take("I")
    stamp = SimpleNamespace(sec=take("i"), nanosec=take("I"))
    name_size = take("I")
    frame_id = body[position : position + name_size].rstrip(b"\0").decode("utf-8", "replace")
    position += name_size
    # time of the first point, number of points, LiDAR, three reserved bytes
    for kind in "QIBBBB":
        take(kind)
    count = take("I")
    size = _POINT_CDR if is_cdr else _POINT
    if len(body) - position < size * (count - 1) + _POINT * (count > 0):
        raise FormatError(f"{count} points of {size} bytes", f"{len(body) - position} bytes", "the cloud is cut off")
    formats = [order + "u4", (order + "f4", 3), "u1", "u1", "u1"]
    point = np.dtype({"names": _FIELDS, "formats": formats, "offsets": (0, 4, 16, 17, 18), "itemsize": size})
    # the last point may lack the padding
    rows = np.ndarray(count, point, body + b"\0", position)
    header = SimpleNamespace(stamp=stamp, frame_id=frame_id)
    times = times_of_column(rows["time"].astype(np.float64), ["offset_time"])
    ring = rows["line"].astype(np.int64)
    return LivoxCloud(points=rows["xyz"].astype(np.float64), ring=ring, times=times, header=header)
