"""Waymo Open Dataset, Perception: people with laser keypoints. Version 2 as Parquet; version 1.4 is in `waymo_v1`.

    ROOT/{training,validation}/COMPONENT/SEGMENT.parquet

Six of the components are read: lidar_hkp and lidar_box (keypoints and boxes), lidar and lidar_pose (range images of
five lasers, two returns each, and the vehicle's pose at the time of each pixel of the top laser), lidar_calibration and
vehicle_pose. They are joined on their key columns. See docs/data.md for the frames of reference and the quirks.
Source: waymo-research/waymo-open-dataset src/waymo_open_dataset/v2.
"""

import shlex
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose.data.readers import waymo_frames as frames, waymo_v1
from lidarpose.data.readers.base import Reader, Skipped, entries, numbers
from lidarpose.data.readers.waymo_v1 import SPLITS
from lidarpose.data.shards import open_parquet, rows_of_shard
from lidarpose.errors import InputError
from lidarpose.io.files import file_error
from lidarpose.sample import LabeledSample
from lidarpose.skeleton import WAYMO14

COMPONENTS = ("lidar_hkp", "lidar_box", "lidar_calibration", "vehicle_pose", "lidar", "lidar_pose")
_BUCKET = "gs://waymo_open_dataset_v_2_0_1"

SEGMENT, TIME, LASER, OBJECT = (
    f"key.{name}" for name in ("segment_context_name", "frame_timestamp_micros", "laser_name", "laser_object_id")
)
# segment and timestamp; the second with the laser
FrameKey = tuple[str, int]
LaserKey = tuple[str, int, int]
# the values of the key columns, and all columns by name
Row = tuple[tuple, dict[str, Any]]
_IMAGE_KEYS = (SEGMENT, TIME, LASER)
# column chunks may be too large for memory, so files are read in pieces of this size
_LITTLE_MEMORY = {"buffer_size": 1 << 20, "pre_buffer": False}
_REMEDY = "fetch it again"

_KEYPOINTS = "[LiDARHumanKeypointsComponent].lidar_keypoints[*]"
_KEYPOINT_COLUMNS = tuple(
    f"{_KEYPOINTS}.{name}"
    for name in ("type", *(f"keypoint_3d.location_m.{x}" for x in "xyz"), "keypoint_3d.visibility.is_occluded")
)
_BOX_COLUMNS = tuple(
    f"[LiDARBoxComponent].box.{name}"
    for name in (*(f"{of}.{x}" for of in ("center", "size") for x in "xyz"), "heading")
)
_BOX_TYPE, _BOX_COUNT = "[LiDARBoxComponent].type", "[LiDARBoxComponent].num_lidar_points_in_box"
_EXTRINSIC = "[LiDARCalibrationComponent].extrinsic.transform"
_BEAMS = tuple(f"[LiDARCalibrationComponent].beam_inclination.{name}" for name in ("values", "min", "max"))
_VEHICLE_POSE = "[VehiclePoseComponent].world_from_vehicle.transform"
_RETURNS = ("[LiDARComponent].range_image_return1", "[LiDARComponent].range_image_return2")
_PIXEL_POSES = "[LiDARPoseComponent].range_image_return1"


class Waymo(Reader):
    """Reads either version, whichever the root holds."""

    name = "waymo"
    skeleton = WAYMO14.name

    def __init__(self):
        super().__init__(box_margin_m=frames.MARGIN)
        self.about["notes"] = [note.format(margin=frames.MARGIN) for note in self.about["notes"]]

    def parts(self, root: Path) -> list[str]:
        """Segments with keypoints of version 2 ("training/SEGMENT") or files of version 1 ("training/FILE.tfrecord").
        Raises InputError if there are both, neither, or if a component is missing."""
        files = waymo_v1.parts(root)
        folders = [f"{split}/{name}" for split in SPLITS for name in _components(root / split)]
        if files and folders:
            versions = f"{files[0]} is version 1, {folders[0]} is version 2"
            raise file_error(root, f"mixes versions of Waymo: {versions}; keep each in its own folder")
        if files or folders:
            return files or _segments(root)
        actual = f"got {entries(root)}"
        if root.name in SPLITS or _components(root):
            actual += f"; the root is likely {root.absolute().parent}"
        if any((root / "individual_files" / split).is_dir() for split in SPLITS):
            actual += f"; the root is likely {root / 'individual_files'}"
        raise self.wrong_root(root, actual)

    def read(self, root: Path, part: str) -> Iterator[LabeledSample | Skipped]:
        """All people with keypoints in a part, by time, then by track. Raises InputError if the labels cannot be read;
        if the range images cannot be read, all people are skipped."""
        if part.endswith(".tfrecord"):
            return waymo_v1.read(root, part)
        return _read_segment(root, part)


def _components(folder: Path) -> list[str]:
    return [name for name in COMPONENTS if (folder / name).is_dir()]


def _segments(root: Path) -> list[str]:
    """The segments that have keypoints; other segments need no further files."""
    parts = []
    for split in SPLITS:
        folder, url = root / split, f"{_BUCKET}/{split}"
        if not _components(folder):
            continue
        missing_components = [name for name in COMPONENTS if not any((folder / name).glob("*.parquet"))]
        if missing_components:
            names = missing_components[0] if len(missing_components) == 1 else f"{{{','.join(missing_components)}}}"
            command = f"gcloud storage cp -r {url}/{names} {shlex.quote(f'{folder}/')}"
            raise file_error(folder, f"lacks {', '.join(missing_components)}; fetch with: {command}")
        # a damaged file is also a part: reading it reports the error
        labels = sorted((folder / "lidar_hkp").glob("*.parquet"))
        segments = [path.stem for path in labels if rows_of_shard(path) != 0]
        for name in COMPONENTS:
            missing_segments = [segment for segment in segments if not (folder / name / f"{segment}.parquet").is_file()]
            if missing_segments:
                command = (
                    f"gcloud storage cp {url}/{name}/{missing_segments[0]}.parquet {shlex.quote(f'{folder / name}/')}"
                )
                problem = f"lacks {len(missing_segments)} of the {len(segments)} segments with keypoints"
                remedy = f"fetch the first with: {command} (or remove unwanted segments from lidar_hkp)"
                raise file_error(folder / name, f"{problem}; {remedy}")
        parts += [f"{split}/{segment}" for segment in segments]
    if not parts:
        raise file_error(root, "has no segment with laser keypoints: only some have them; fetch all of lidar_hkp")
    return sorted(parts)


def _read_segment(root: Path, part: str) -> Iterator[LabeledSample | Skipped]:
    split, _, segment = part.partition("/")
    files = {name: root / split / name / f"{segment}.parquet" for name in COMPONENTS}
    labels = []
    for number, (key, row) in enumerate(table(files["lidar_hkp"], (SEGMENT, TIME, OBJECT), _KEYPOINT_COLUMNS)):
        if None in key:
            where = f"{part}: row {number} of lidar_hkp lacks its segment, its time or its person"
            yield Skipped(frames.BAD_LABEL, where)
        else:
            labels.append((key, row))
    frames_by_key = _frames(files, labels)
    try:
        _add_images(files, frames_by_key)
    except InputError as error:
        for frame in frames_by_key.values():
            frame.fail(frames.BAD_IMAGE, str(error))
    for frame_key in sorted(frames_by_key):
        yield from frames_by_key[frame_key].samples()


def _frames(files: dict[str, Path], labels: list[Row]) -> dict[FrameKey, frames.Frame]:
    """The frames that have keypoints, with boxes, calibrations and poses joined to them."""
    boxes = dict(table(files["lidar_box"], (SEGMENT, TIME, OBJECT), (*_BOX_COLUMNS, _BOX_TYPE), (_BOX_COUNT,)))
    poses = dict(table(files["vehicle_pose"], (SEGMENT, TIME), (_VEHICLE_POSE,)))
    calibrations: dict[str, dict[int, frames.Calibration]] = {}
    for (segment, laser), row in table(files["lidar_calibration"], (SEGMENT, LASER), (_EXTRINSIC,), _BEAMS):
        try:
            calibrations.setdefault(segment, {})[laser] = _calibration(laser, row)
        except InputError as error:
            raise file_error(files["lidar_calibration"], error) from None
    frames_by_key: dict[FrameKey, frames.Frame] = {}
    for key, row in labels:
        segment, time, _ = key
        if (segment, time) not in frames_by_key:
            frames_by_key[segment, time] = frames.Frame(
                sequence=segment,
                timestamp=time,
                start=min((t for s, t in poses if s == segment and t is not None), default=time),
                people=[],
                calibrations=calibrations.get(segment, {}),
            )
        frames_by_key[segment, time].people.append(_person(key[2], row, boxes.get(key)))
    for frame_key, frame in frames_by_key.items():
        pose = poses.get(frame_key, {}).get(_VEHICLE_POSE)
        try:
            frame.T_world_vehicle = None if pose is None else frames.transform(pose, "the vehicle's pose")
        except InputError as error:
            frame.fail(frames.BAD_FRAME, str(error))
    return frames_by_key


def _calibration(laser: int, row: dict[str, Any]) -> frames.Calibration:
    values, low, high = (row[name] for name in _BEAMS)
    name = f"beam inclinations of laser {laser}"
    return frames.Calibration(
        laser=laser,
        T_vehicle_laser=frames.transform(row[_EXTRINSIC], f"the extrinsic of laser {laser}"),
        inclinations=numbers("lidar_calibration", values, (-1,), name, finite=False) if values else None,
        low=low,
        high=high,
    )


def _person(track: str, label: dict[str, Any], box: dict[str, Any] | None) -> frames.LabeledPerson | frames.Problem:
    kinds, *coordinates, is_occluded = (label[name] or [] for name in _KEYPOINT_COLUMNS)
    if len({len(kinds), len(is_occluded), *map(len, coordinates)}) > 1:
        return frames.Problem(frames.BAD_LABEL, "its lists have different lengths", track)
    try:
        positions = numbers("lidar_hkp", coordinates, (3, -1), "keypoints", finite=False)
        keypoints = zip(kinds, positions.T, is_occluded, strict=True)
        if box is None:
            return frames.person(track, keypoints, None)
        values = numbers("lidar_box", [box[name] for name in _BOX_COLUMNS], (7,), "a box", finite=False)
        return frames.person(track, keypoints, values, box[_BOX_TYPE], box[_BOX_COUNT])
    except InputError as error:
        return frames.Problem(frames.BAD_LABEL, str(error), track)


def _add_images(files: dict[str, Path], frames_by_key: dict[FrameKey, frames.Frame]) -> None:
    """Adds the range images to their frames, one row at a time."""
    needed_keys = {key for key, frame in frames_by_key.items() if frame.wanted}
    if not needed_keys:
        return
    pose_keys = {key for key, _ in table(files["lidar_pose"], _IMAGE_KEYS)}
    poses = images(files["lidar_pose"], (_PIXEL_POSES,), needed_keys)
    # both files usually have the same order of frames; then it never holds more than one image
    pending_poses: dict[LaserKey, np.ndarray | None] = {}
    for key, returns in images(files["lidar"], _RETURNS, needed_keys):
        while key in pose_keys and key not in pending_poses:
            pose_key, (image,) = next(poses, (key, [None]))
            pending_poses[pose_key] = image
        pixel_poses, frame = pending_poses.pop(key, None), frames_by_key[key[:2]]
        for return_number, image in enumerate(returns, 1):
            if image is not None and not image.size:
                frame.fail(frames.BAD_IMAGE, f"the values of laser {key[2]} do not fit their shape")
            elif image is not None:
                frame.add(key[2], return_number, image[..., 0], pixel_poses)


# ---- rows of Parquet files, read with little memory: range images one row at a time. Columns are selected by name and
# rows by key, so that order, row groups, number types and extra columns do not matter


def table(
    path: Path, keys: tuple[str, ...], columns: tuple[str, ...] = (), optional: tuple[str, ...] = ()
) -> list[Row]:
    """All rows: the values of the key columns, and all columns by name, None if an optional column is missing or a
    value is null. Raises InputError for a damaged file and missing columns."""
    with open_parquet(path, _REMEDY, **_LITTLE_MEMORY) as file:
        _check(file, (*keys, *columns))
        names = [name for name in (*keys, *columns, *optional) if name in file.schema_arrow.names]
        values = file.read(columns=names, use_threads=False).to_pydict()
        if LASER in values:
            values[LASER] = list(map(int, values[LASER]))
        rows = (dict(zip(names, row, strict=True)) for row in zip(*(values[name] for name in names), strict=True))
        return [(tuple(row[name] for name in keys), dict.fromkeys(optional) | row) for row in rows]


def images(
    path: Path, columns: tuple[str, ...], wanted: Collection[FrameKey]
) -> Iterator[tuple[LaserKey, list[np.ndarray | None]]]:
    """Range images (H, W, C) float32 of wanted frames, row by row in the file's order, one image per column.

    columns: names without the suffixes `.values` and `.shape`. An image is None if it is missing, and empty if its
    values do not fit its shape. Raises InputError for a damaged file and missing columns.
    """
    names = tuple(f"{column}.{part}" for column in columns for part in ("values", "shape"))
    keys, first_row = [key for key, _ in table(path, _IMAGE_KEYS)], 0
    with open_parquet(path, _REMEDY, **_LITTLE_MEMORY) as file:
        _check(file, names)
        for group in range(file.num_row_groups):
            group_keys = keys[first_row : first_row + file.metadata.row_group(group).num_rows]
            first_row += len(group_keys)
            last_row = max((k for k, key in enumerate(group_keys) if key[:2] in wanted), default=-1)
            # lazy: a group is not read before its first batch is requested
            batches = file.iter_batches(batch_size=1, row_groups=[group], columns=names, use_threads=False)
            for key, batch in zip(group_keys[: last_row + 1], batches, strict=False):
                if key[:2] in wanted:
                    cells = [batch.column(name)[0] for name in names]
                    yield key, [_image(*pair) for pair in zip(cells[::2], cells[1::2], strict=True)]


def _image(values, shape) -> np.ndarray | None:
    if not values.is_valid or not shape.is_valid:
        return None
    flat = values.values.to_numpy(zero_copy_only=False).astype(np.float32, copy=False)
    size = shape.as_py()
    if not frames.is_image(size, len(flat)):
        return np.zeros((0, 0, 0), np.float32)
    return flat.reshape(size)


def _check(file, columns: tuple[str, ...]) -> None:
    missing_columns = [name for name in columns if name not in file.schema_arrow.names]
    if missing_columns:
        raise InputError(f"has no column {missing_columns[0]}: is it from this component of Waymo v2.0?")
