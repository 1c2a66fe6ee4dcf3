"""Waymo Open Dataset, Perception, version 1.4 (1.3.2 and later have keypoints): frames as protobuf in TFRecords.

    ROOT/{training,validation}/segment-NAME_with_camera_labels.tfrecord

Read without TensorFlow and without generated code, by the numbers of the fields that are needed. Source:
waymo-research/waymo-open-dataset dataset.proto, label.proto, protos/keypoint.proto, protos/vector.proto.
"""

import reprlib
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from lidarpose.data.readers.base import Skipped
from lidarpose.data.readers.protobuf import Message
from lidarpose.data.readers.tfrecord import records
from lidarpose.data.readers.waymo_frames import (
    BAD_FRAME,
    BAD_IMAGE,
    BAD_REST,
    MARGIN,
    Calibration,
    Frame,
    LabelledPerson,
    about,
    is_image,
    person,
    transform,
)
from lidarpose.errors import InputError
from lidarpose.io.files import file_error
from lidarpose.sample import LabeledSample
from lidarpose.skeleton import WAYMO14

SPLITS = ("training", "validation")

# numbers of fields, by message
_FRAME_CONTEXT, _FRAME_TIME, _FRAME_POSE, _FRAME_LASERS, _FRAME_LABELS = 1, 2, 3, 5, 6
_CONTEXT_NAME, _CONTEXT_LASERS = 1, 3
_CALIBRATION_LASER, _CALIBRATION_BEAMS, _CALIBRATION_LOW, _CALIBRATION_HIGH, _CALIBRATION_EXTRINSIC = 1, 2, 3, 4, 5
_TRANSFORM_VALUES = 1
_LASER_NAME, _LASER_RETURNS = 1, (2, 3)
_IMAGE_COMPRESSED, _IMAGE_POSES = 2, 4
_MATRIX_DATA, _MATRIX_SHAPE, _SHAPE_SIZES = 1, 2, 1
_LABEL_BOX, _LABEL_TYPE, _LABEL_ID, _LABEL_COUNT, _LABEL_KEYPOINTS = 1, 3, 4, 7, 8
# center x, y, z, length, width, height, heading: width comes before length
_BOX = (1, 2, 3, 5, 4, 6, 7)
_KEYPOINTS_EACH = 1
_KEYPOINT_TYPE, _KEYPOINT_3D = 1, 2
_3D_PLACE, _3D_VISIBILITY, _VISIBILITY_OCCLUDED = 1, 2, 1
_PLACE = (1, 2, 3)

# a range image of the top laser has 64 x 2650 pixels; what is far larger is damaged
_MOST_VALUES = 1 << 24


class WaymoV1:
    """Reads version 1.4. A part is a file. margin: how far around the labelled box points are taken, m."""

    name = "waymo"
    skeleton = WAYMO14.name

    def __init__(self, *, margin: float = MARGIN):
        self.margin = margin
        self.about = about(margin)

    def parts(self, root: Path) -> list[str]:
        """The files, as paths below the root. Raises InputError where there are none."""
        found = [path.relative_to(root).as_posix() for split in SPLITS for path in (root / split).glob("*.tfrecord")]
        if not found:
            raise file_error(root, "has no training/*.tfrecord or validation/*.tfrecord")
        return sorted(found)

    def read(self, root: Path, part: str) -> Iterator[LabeledSample | Skipped]:
        """Everybody with keypoints in a file, frame by frame. After a damaged record the rest is given up."""
        start = None
        try:
            for number, data in enumerate(records(root / part)):
                try:
                    frame = _frame(Message(data), start, self.margin)
                except InputError as error:
                    yield Skipped(reason=BAD_FRAME, where=f"{part}: record {number}: {error}")
                    continue
                start = frame.start
                yield from frame.found()
        except InputError as error:
            yield Skipped(reason=BAD_REST, where=f"{part}: {error}")


def _frame(message: Message, start: int | None, margin: float) -> Frame:
    """A frame with the points of its people. start: timestamp of the file's first frame, None where it is this one.

    Raises InputError where its labels cannot be read.
    """
    context, time = message.message(_FRAME_CONTEXT), message.integer(_FRAME_TIME)
    name = None if context is None else context.text(_CONTEXT_NAME)
    if not name or time is None:
        raise InputError("is no frame of Waymo's perception dataset: it has no segment or no time")
    people = [_person(label) for label in message.messages(_FRAME_LABELS) if _LABEL_KEYPOINTS in label]
    frame = Frame(
        sequence=name,
        timestamp=time,
        start=time if start is None else start,
        people=people,
        calibrations=_calibrations(context) if people else {},
        T_world_vehicle=_transform(message.message(_FRAME_POSE), "the vehicle's pose") if people else None,
        margin=margin,
    )
    for laser in message.messages(_FRAME_LASERS) if frame.wanted else ():
        try:
            _add_images(frame, laser)
        except InputError as error:
            frame.fail(BAD_IMAGE, str(error))
    return frame


def _person(label: Message) -> LabelledPerson:
    box = label.message(_LABEL_BOX)
    keypoints = []
    for keypoint in label.message(_LABEL_KEYPOINTS).messages(_KEYPOINTS_EACH):
        found = keypoint.message(_KEYPOINT_3D)
        place = None if found is None else found.message(_3D_PLACE)
        if place is None:
            continue
        visibility = found.message(_3D_VISIBILITY)
        hidden = visibility is not None and bool(visibility.integer(_VISIBILITY_OCCLUDED))
        # numbers that are zero may be left out
        keypoints.append((keypoint.integer(_KEYPOINT_TYPE) or 0, [place.double(n) or 0.0 for n in _PLACE], hidden))
    return person(
        label.text(_LABEL_ID) or "",
        keypoints,
        None if box is None else [box.double(n) or 0.0 for n in _BOX],
        label.integer(_LABEL_TYPE) or 0,
        label.integer(_LABEL_COUNT),
    )


def _transform(message: Message | None, what: str) -> np.ndarray | None:
    return None if message is None else transform(message.doubles(_TRANSFORM_VALUES), what)


def _calibrations(context: Message) -> dict[int, Calibration]:
    found = {}
    for one in context.messages(_CONTEXT_LASERS):
        laser, beams = one.integer(_CALIBRATION_LASER) or 0, one.doubles(_CALIBRATION_BEAMS)
        extrinsic = _transform(one.message(_CALIBRATION_EXTRINSIC), f"the extrinsic of laser {laser}")
        low, high = one.double(_CALIBRATION_LOW), one.double(_CALIBRATION_HIGH)
        if extrinsic is None or not len(beams) and (low is None or high is None):
            raise InputError(f"the calibration of laser {laser} lacks its extrinsic or its beam inclinations")
        found[laser] = Calibration(
            laser=laser, T_vehicle_laser=extrinsic, inclinations=beams if len(beams) else None, low=low, high=high
        )
    return found


def _add_images(frame: Frame, message: Message) -> None:
    """Adds both returns of a laser; the pixels' poses are beside the first."""
    laser = message.integer(_LASER_NAME) or 0
    first, *_ = returns = [message.message(n) for n in _LASER_RETURNS]
    poses = None if first is None else _matrix(first.data(_IMAGE_POSES))
    for which, image in enumerate(returns, 1):
        values = None if image is None else _matrix(image.data(_IMAGE_COMPRESSED))
        if values is not None:
            frame.add(laser, which, values[..., 0], poses)


def _matrix(compressed: memoryview | None) -> np.ndarray | None:
    """A zlib-compressed MatrixFloat -> (H, W, C) float32; None where there is none."""
    if not compressed:
        return None
    inflate = zlib.decompressobj()
    try:
        content = inflate.decompress(compressed, 4 * _MOST_VALUES)
    except zlib.error as error:
        raise InputError(f"a range image cannot be decompressed ({error})") from None
    if not inflate.eof:
        raise InputError("a range image is cut off, or far larger than any")
    message = Message(content)
    values, shape = message.floats(_MATRIX_DATA), message.message(_MATRIX_SHAPE)
    sizes = [] if shape is None else shape.integers(_SHAPE_SIZES)
    if not is_image(sizes, len(values)):
        raise InputError(f"a range image of {len(values)} values says it is {reprlib.repr(sizes)}")
    return values.reshape(sizes)
