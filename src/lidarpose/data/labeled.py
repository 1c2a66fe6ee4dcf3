"""Rows of the tables of people, "people" of synthetic and "labelled" of real ones, and the samples that they hold."""

from dataclasses import asdict
from typing import Any

import numpy as np

from lidarpose.data.schema import CENTERS, FACTS
from lidarpose.errors import InputError
from lidarpose.sample import SEEN, Box, LabeledSample, PersonInfo, Pose, Sample
from lidarpose.skeleton import BODY26, skeleton

# frames per second of synthetic clips and streets
_CLIP_HZ = 10


def person_row(
    sample: Sample, *, index: int, frame: int = 0, track: int = 0, facts: PersonInfo | None = None
) -> dict[str, Any]:
    """A row of the people table. The sample needs pose (body26), part, ring and box."""
    return {
        "index": index,
        "frame": frame,
        "track": track,
        **_common(sample),
        **(dict.fromkeys(FACTS) if facts is None else asdict(facts)),
    }


def labeled_row(sample: LabeledSample, *, index: int) -> dict[str, Any]:
    """A row of the table of real people. index: number of the part that the person is from. Raises InputError for a
    center without a column."""
    unknown = sorted(sample.centers.keys() - set(CENTERS))
    if unknown:
        raise InputError(f"centers have the names {', '.join(CENTERS)}, got {', '.join(unknown)}")
    return {
        "index": index,
        "sequence": sample.sequence,
        "frame": sample.frame,
        "track": sample.track,
        "time": sample.time,
        "split": sample.split,
        **_common(sample),
        "joint_labels": sample.joint_labels,
        **{f"center_{name}": sample.centers.get(name) for name in CENTERS},
        "distance": sample.distance if sample.sensor_known else None,
    }


def _common(sample: Sample) -> dict[str, Any]:
    box = sample.box
    return {
        "points": sample.points.ravel(),
        "part": sample.part,
        "ring": sample.ring,
        "joints": np.asarray(sample.pose.joints, np.float32).ravel(),
        "center": sample.center,
        "box_center": box and box.center,
        "box_size": box and box.size,
        "box_yaw": box and float(box.yaw),
        "source": sample.source,
        "frame_id": sample.frame_id,
    }


def sample_of(row: dict[str, Any], skeleton_name: str = BODY26.name, what: str = "people") -> LabeledSample:
    """The sample of a row, as `read_rows` gives it. what: as in the settings of the dataset's card.

    The id of the box is the track, of real people and in streets. All joints of synthetic people count as seen.
    """
    labels: dict[str, Any]
    if "joint_labels" in row:
        box_id = row["track"]
        labels = {
            "joint_labels": row["joint_labels"],
            "sequence": row["sequence"],
            "time": row["time"],
            "split": row["split"],
            "centers": {name: row[f"center_{name}"] for name in CENTERS if row[f"center_{name}"] is not None},
            "sensor_known": row["distance"] is not None,
        }
    else:
        box_id = row["track"] if what == "streets" else None
        labels = {
            "joint_labels": np.full(len(skeleton(skeleton_name)), SEEN, np.uint8),
            "sequence": str(row["index"]),
            "time": np.nan if what == "people" else row["frame"] / _CLIP_HZ,
            "info": PersonInfo(**{name: row[name] for name in FACTS if row[name] is not None}),
        }
    box = None
    if row["box_center"] is not None:
        box = Box(center=row["box_center"], size=row["box_size"], yaw=row["box_yaw"], id=box_id)
    pose = Pose(joints=row["joints"].reshape(-1, 3), skeleton=skeleton(skeleton_name), frame="sensor")
    return LabeledSample(
        points=row["points"].reshape(-1, 3),
        center=row["center"],
        part=row["part"],
        ring=row["ring"],
        pose=pose,
        box=box,
        source=row["source"],
        frame_id=row["frame_id"],
        frame=row["frame"],
        track=str(row["track"]),
        **labels,
    )
