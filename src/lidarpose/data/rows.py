"""Rows of datasets: the columns of their tables, and conversion between samples and rows.

A row of people-*.parquet is one synthetic person in one frame:

    index, frame, track     number of the person, clip or street in the dataset; its frame; person in a street
    points                  x, y, z of all points, flattened, m: reshape to (n, 3); in the level frame at the sensor,
                            x forward, y left, z up
    part, ring              one per point: 0 = background, 1 + j = the bone of SMPL-24's joint j; the beam, or
                            -1 for a point of none
    point_times             s, relative to the pose, of the points of several scans; null for a single scan
    joints                  x, y, z of the joints named in dataset.json, m
    center                  origin of the person's own frame, computed from the points
    box_center, box_size, box_yaw    a detector's box: m, m, rad
    source, frame_id        as in `Sample`
    rotations, translation, background, neighbors    as in `Sample`, for networks of clips; null if unknown
    sensor, kind, ...       the fields of `PersonInfo`; null if not measured

Datasets of real people, written by `lidarpose prepare`, have one part of the raw files (a sequence, a file) per shard:
labelled-*.parquet (columns as above, except that index is the number of the part) with

    sequence, time, split   of the raw dataset; s since the start of the sequence; train, val, test or null
    track                   text; the person in the sequence
    joints                  NaN if a joint is not labeled
    joint_labels            one per joint: 0 not labeled, 1 hidden or uncertain, 2 seen
    center_trans, ...       other origins that published protocols use, m; null if there is none
    distance                of the center from the sensor, m; null if the sensor position is unknown

and skipped-*.parquet: what was left out, with `reason` and `where`.

Streets also have frames-*.parquet: full revolutions of the sensor, with the person of every point, and for all P people
in the street, visible or not, track (P,), box (P, 7: center, size, yaw) and joints (P, J, 3), flattened.
"""

import math
import re
from dataclasses import asdict, fields
from typing import Any, NamedTuple

import numpy as np

from lidarpose.errors import InputError
from lidarpose.sample import FARTHEST, SEEN, Box, LabeledSample, PersonInfo, Pose, Sample
from lidarpose.skeleton import BODY26, SMPL24, skeleton

# names of origins that published protocols use; each has a column center_NAME
CENTERS = ("trans", "box", "joints_box")
# frames per second of synthetic clips and streets
_CLIP_HZ = 10


class Column(NamedTuple):
    """A column. type: Arrow's; shape: of a flattened list, None for a single value; text: both, as written below;
    optional: may be null."""

    text: str
    type: str
    shape: tuple[str, ...] | None
    optional: bool


def _columns(text: str) -> dict[str, Column]:
    matches = (re.fullmatch(r"(\w+):((\w+)(?:\[(.+)\])?(\?)?)", word) for word in text.split())
    return {
        match[1]: Column(match[2], match[3], tuple(match[4].split(",")) if match[4] else None, bool(match[5]))
        for match in matches
        if match
    }


# name:type[shape] for n points, J joints, P people; "?": null if unknown, and may be missing in older shards.
# A column with the name of a field of `LabeledSample` or `PersonInfo` holds that field
_BOX = "box_center:float64[3]? box_size:float64[3]? box_yaw:float64?"
_CLIP = "rotations:float32[24,3]? translation:float64[3]? background:float32[b,3]? neighbors:float32[k,3]?"
TABLES = {
    "people": _columns(f"""
        index:int64 frame:int32 track:int32
        points:float32[n,3] part:uint8[n]? ring:int32[n]? joints:float32[J,3] center:float64[3] {_BOX}
        source:string frame_id:string point_times:float32[n]? sensor:string? kind:string? distance:float32?
        visible:float32? height_seen:float32? clutter:float32? upright:bool? {_CLIP}"""),
    "frames": _columns("""
        index:int64 frame:int32 sensor:string points:float32[n,3] ring:int32[n] person:int16[n] part:uint8[n]
        track:int16[P] box:float64[P,7] joints:float32[P,26,3]"""),
    "labelled": _columns(f"""
        index:int64 sequence:string frame:int64 track:string time:float64 split:string?
        points:float32[n,3] part:uint8[n]? ring:int32[n]? joints:float32[J,3] joint_labels:uint8[J] center:float64[3]
        center_trans:float64[3]? center_box:float64[3]? center_joints_box:float64[3]? {_BOX} distance:float32?
        source:string frame_id:string {_CLIP}"""),
    "skipped": _columns("index:int64 reason:string where:string"),
}
_CLIP_COLUMNS = tuple(_columns(_CLIP))
_FIELDS = {info.name for info in fields(LabeledSample)}
_INFO = tuple(info.name for info in fields(PersonInfo))


def person_row(
    sample: Sample, *, index: int, frame: int = 0, track: int = 0, info: PersonInfo | None = None
) -> dict[str, Any]:
    """A row of the people table. The sample needs pose (body26), part, ring and box."""
    measured: dict[str, Any] = dict.fromkeys(_INFO) if info is None else asdict(info)
    return _sample_columns(sample, "people") | measured | {"index": index, "frame": frame, "track": track}


def labeled_row(sample: LabeledSample, *, index: int) -> dict[str, Any]:
    """A row of the table of real people. index: number of the person's part. Raises InputError for a center that has no
    column."""
    unknown_names = sorted(sample.centers.keys() - set(CENTERS))
    if unknown_names:
        raise InputError(f"names of centers must be {', '.join(CENTERS)}, got {', '.join(unknown_names)}")
    centers = {f"center_{name}": center for name, center in sample.centers.items()}
    distance = sample.distance if sample.sensor_known else None
    return _sample_columns(sample, "labelled") | centers | {"index": index, "distance": distance}


def _sample_columns(sample: Sample, table: str) -> dict[str, Any]:
    if sample.pose is None:
        raise InputError(f"a row of the table {table} needs a sample with a pose")
    row = {name: getattr(sample, name, None) for name in TABLES[table]} | {"joints": sample.pose.joints}
    return row | {f"box_{name}": getattr(sample.box, name, None) for name in ("center", "size", "yaw")}


def sample_of(row: dict[str, Any], skeleton_name: str = BODY26.name, what: str = "people") -> LabeledSample:
    """The sample of a row from `read_rows`. what: as in the settings of the dataset's card.

    For real people and in streets, the id of the box is the track. All joints of synthetic people are labeled `SEEN`.
    Raises InputError that names the column for an invalid row.
    """
    dataset_skeleton = skeleton(skeleton_name)
    is_real = "joint_labels" in row
    _check_row(row, "labelled" if is_real else "people", len(dataset_skeleton))
    values = {name: row[name] for name in row.keys() & _FIELDS} | {"track": str(row["track"])}
    if is_real:
        values["centers"] = {name: row[f"center_{name}"] for name in CENTERS if row[f"center_{name}"] is not None}
        values["sensor_known"] = row["distance"] is not None
    else:
        values["joint_labels"] = np.full(len(dataset_skeleton), SEEN, np.uint8)
        values["sequence"] = str(row["index"])
        values["time"] = np.nan if what == "people" else row["frame"] / _CLIP_HZ
        values["info"] = PersonInfo(**{name: row[name] for name in _INFO if row[name] is not None})
    if row["box_center"] is not None:
        track = row["track"] if is_real or what == "streets" else None
        values["box"] = Box(center=row["box_center"], size=row["box_size"], yaw=row["box_yaw"], id=track)
    for name in ("points", "rotations", "background", "neighbors"):
        values[name] = None if row[name] is None else row[name].reshape(-1, 3)
    return LabeledSample(
        **values, pose=Pose(joints=row["joints"].reshape(-1, 3), skeleton=dataset_skeleton, frame="sensor")
    )


def _check_row(row: dict[str, Any], table: str, joints: int) -> None:
    """Raises InputError for a null in a required column, lists of wrong lengths, and invalid values."""
    for name, column in TABLES[table].items():
        if row[name] is None and not column.optional:
            raise InputError(f"column {name} is null, expected {column.text}")
    if len({row[name] is None for name in ("box_center", "box_size", "box_yaw")}) > 1:
        raise InputError("columns box_center, box_size, box_yaw: some are null, expected all or none")
    check_lengths(row, table, joints)
    clip_columns = [name for name in _CLIP_COLUMNS if row[name] is not None]
    timed_columns = ["point_times"] if row.get("point_times") is not None else []
    for name in ("points", "center", *clip_columns, *timed_columns):
        if not np.isfinite(row[name]).all():
            raise InputError(f"column {name} has values that are not finite numbers")
    # a joint may be NaN
    for name in ("points", "center", "joints", *clip_columns):
        if (np.abs(row[name]) > FARTHEST).any():
            raise InputError(f"column {name} has values beyond {FARTHEST:g} m")
    if row["part"] is not None and row["part"].max(initial=0) > len(SMPL24):
        raise InputError(f"column part has values above {len(SMPL24)}, expected 0 or 1 + a joint of SMPL-24")


def check_lengths(row: dict[str, Any], table: str, joints: int = 0) -> None:
    """Raises InputError for lists of inconsistent lengths. The first list of points or of people sets their number."""
    sizes = {"J": joints}
    for name, column in TABLES[table].items():
        if column.shape is None or row[name] is None:
            continue
        dimension, *item_shape = column.shape
        item_size = math.prod(map(int, item_shape))
        count = int(dimension) if dimension.isdecimal() else sizes.setdefault(dimension, len(row[name]) // item_size)
        if len(row[name]) != count * item_size:
            expected = f"{count * item_size}: {column.text} with {dimension} = {count}"
            raise InputError(f"column {name} has {len(row[name])} values, expected {expected}")
