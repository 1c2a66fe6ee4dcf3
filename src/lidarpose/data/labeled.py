"""Rows of the table "labelled": people of a real dataset with what was labelled, as `lidarpose prepare` writes them."""

from typing import Any

import numpy as np

from lidarpose.data.readers.base import Item
from lidarpose.data.schema import CENTERS
from lidarpose.errors import InputError
from lidarpose.sample import Box, Pose, Sample
from lidarpose.skeleton import skeleton


def labelled_row(item: Item, *, index: int, split: str | None = None, sensor_known: bool = True) -> dict[str, Any]:
    """A row. index numbers the part that the person is from; split: train, val, test or None; sensor_known: whether
    the frame's origin is the sensor, else no distance is told. Raises InputError for a center without a column."""
    sample = item.sample
    unknown = sorted(item.centers.keys() - set(CENTERS))
    if unknown:
        raise InputError(f"centers have the names {', '.join(CENTERS)}, got {', '.join(unknown)}")
    box = sample.box
    return {
        "index": index,
        "sequence": item.sequence,
        "frame": item.frame,
        "track": item.track,
        "time": item.time,
        "split": split,
        "points": sample.points.ravel(),
        "part": sample.part,
        "ring": sample.ring,
        "joints": np.asarray(sample.pose.joints, np.float32).ravel(),
        "joint_labels": item.joint_labels,
        "center": sample.center,
        **{f"center_{name}": item.centers.get(name) for name in CENTERS},
        "box_center": box and box.center,
        "box_size": box and box.size,
        "box_yaw": box and float(box.yaw),
        "distance": float(np.linalg.norm(sample.center)) if sensor_known else None,
        "source": sample.source,
        "frame_id": sample.frame_id,
    }


def item_of(row: dict[str, Any], skeleton_name: str) -> Item:
    """The item of a row, as `shards.read_rows` gives it. A box's id is the track."""
    joints = row["joints"].reshape(-1, 3)
    box = None
    if row["box_center"] is not None:
        box = Box(center=row["box_center"], size=row["box_size"], yaw=row["box_yaw"], id=row["track"])
    sample = Sample(
        points=row["points"].reshape(-1, 3),
        center=row["center"],
        part=row["part"],
        ring=row["ring"],
        pose=Pose(joints=joints, skeleton=skeleton(skeleton_name), frame="sensor"),
        box=box,
        source=row["source"],
        frame_id=row["frame_id"],
    )
    return Item(
        sample=sample,
        joint_labels=row["joint_labels"],
        sequence=row["sequence"],
        frame=row["frame"],
        track=row["track"],
        time=row["time"],
        centers={name: row[f"center_{name}"] for name in CENTERS if row[f"center_{name}"] is not None},
    )
