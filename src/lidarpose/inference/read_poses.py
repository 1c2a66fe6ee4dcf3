"""Reads the poses that `predict` and `Poses.save` wrote."""

import json
import os
from typing import Any

import numpy as np

from lidarpose.geometry import rotation_from_up
from lidarpose.inference.results import SCHEMA, PersonPose, Poses
from lidarpose.io.boxes import read_boxes
from lidarpose.io.files import FormatError, file_error, read_bytes
from lidarpose.sample import Pose
from lidarpose.skeleton import SKELETONS, Skeleton

# optional values per joint, as written; joints out of range are written by name
_PER_JOINT = ("confidence", "spread", "visible")
# names of the schemas: of one scan, and of a line of a recording
_SCHEMAS = (SCHEMA.partition("/")[0], "lidarpose.recording")
_EXPECTED = f"poses, JSON of the schema {SCHEMA}"


def read_poses(source: str | os.PathLike | dict[str, Any]) -> Poses:
    """Reads the poses of a .poses.json file, as `lidarpose predict` and `Poses.save` write it.

    Args:
        source: the file; or its decoded content, or a decoded line of a recording's .poses.jsonl.

    Returns:
        `Poses` in the frame of the scan. Points are not stored, so `PersonPose.points` is empty; `num_points` is their
        number. Values are rounded as in the file.

    Raises:
        InputError: one line that names the file and the problem.
    """
    name = "poses" if isinstance(source, dict) else source
    data = b"" if isinstance(source, dict) else read_bytes(source, expected="a file of poses")
    try:
        return _poses(source if isinstance(source, dict) else _parse(data, source))
    except FormatError as problem:
        raise file_error(name, problem) from None
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        # also InputError, of values that poses and boxes do not allow
        reason = f"without {error}" if isinstance(error, KeyError) else str(error)
        raise file_error(name, f"expected {_EXPECTED}, got a damaged document ({reason}): write it again") from None


def _parse(data: bytes, path: str | os.PathLike) -> Any:
    try:
        return json.loads(data.decode("utf-8-sig", "replace"))
    except (ValueError, RecursionError) as error:
        if os.fsdecode(path).lower().endswith(".jsonl"):
            remedy = "call it with each line, decoded by json.loads"
            raise FormatError(f"expected {_EXPECTED}, got one document per line: {remedy}") from None
        raise FormatError(f"expected {_EXPECTED}, got something else ({error}): give a .poses.json file") from None


def _poses(document: Any) -> Poses:
    schema = document.get("schema") if isinstance(document, dict) else None
    if not isinstance(schema, str) or schema.partition("/")[0] not in _SCHEMAS:
        actual = f"the schema {schema}" if schema else "a document without it"
        raise FormatError(f"expected {_EXPECTED}, got {actual}: give a file that lidarpose predict wrote")
    skeleton = stated_skeleton(document["skeleton"])
    up, model = str(document.get("up", "z")), dict(document["model"])
    rotation_from_up(up)
    people = [_person(entry, skeleton, up, model) for entry in document["people"]]
    return Poses(
        people=tuple(people),
        skeleton=skeleton,
        source=document["source"],
        model=model,
        warnings=tuple(map(str, document["warnings"])),
        timing_ms=dict(document.get("timing_ms", {})),
        up=up,
    )


def stated_skeleton(stated: dict[str, Any]) -> Skeleton:
    """The skeleton of a document: the package's own of that name, joints and bones, else the user's, from its bones."""
    name, joints = stated["name"], tuple(stated["joints"])
    known = SKELETONS.get(name)
    if known is not None and known.joints == joints and known.bones == tuple(map(tuple, stated["bones"])):
        return known
    parents, extra_bones = [-1] * len(joints), []
    for start, end in stated["bones"]:
        if end > start and parents[end] < 0:
            parents[end] = start
        else:
            extra_bones.append((start, end))
    return Skeleton(name=name, joints=joints, parents=tuple(parents), extra_bones=tuple(extra_bones))


def _person(entry: dict[str, Any], skeleton: Skeleton, up: str, model: dict) -> PersonPose:
    box = None if entry["box"] is None else read_boxes([entry])[0].with_up(up)
    pose = None
    if entry["joints"] is not None:
        values: dict[str, Any] = {name: np.array(entry[name], float) for name in _PER_JOINT if entry[name]}
        values |= {name: np.float64(entry[name]) for name in ("person", "second_person") if entry[name] is not None}
        if any(entry[name] for name in _PER_JOINT):
            # networks without heatmaps have no such values
            values["in_range"] = np.array([joint not in entry["out_of_range"] for joint in skeleton.joints])
        pose = Pose(joints=np.array(entry["joints"], float), skeleton=skeleton, **values)
    return PersonPose(
        pose=pose,
        skeleton=skeleton,
        points=np.zeros((0, 3)),
        stored_points=int(entry["num_points"]),
        id=entry["id"],
        box=box,
        warnings=tuple(map(str, entry["warnings"])),
        model=model,
        up=up,
        # recordings of older versions have none
        velocity=None if entry.get("velocity") is None else np.array(entry["velocity"], float).reshape(3),
    )
