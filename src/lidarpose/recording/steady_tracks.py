"""Smooths the poses of all tracks in the lines of a recording."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from lidarpose.geometry import inverse_transform, rotation_of_boxes, transform_points
from lidarpose.inference.results import facing_entry
from lidarpose.recording.coordinates import FixedFrame, rounded_points
from lidarpose.sample import Pose, known_values
from lidarpose.skeleton import Skeleton
from lidarpose.tracking.clip import TrackPoses
from lidarpose.tracking.smoothing import smooth
from lidarpose.tracking.tracker import MAX_LATE

# values smoothed besides the joints, and their decimals
_SMOOTHED = {"spread": 4, "visible": 3, "confidence": 3}


def smoothed_lines(
    lines: Callable[[], Iterator[dict[str, Any]]], up: str, skeleton: Skeleton, *, are_boxes_given: bool = False
) -> Iterator[dict[str, Any]]:
    """The lines with all tracks smoothed, and with people added in frames in which they were occluded.

    Args:
        lines: returns an iterator over the lines from the first; called twice.
        up: up axis of the points, as in `predict`.
        skeleton: skeleton of the poses.
        are_boxes_given: whether the boxes are the user's, which are not changed.
    """
    times: list[float] = []
    to_fixed: list[np.ndarray] = []
    # by track and row of the lines, in the fixed frame
    tracks: dict[int, dict[int, Pose]] = {}
    fixed = FixedFrame(up)
    for row, line in enumerate(lines()):
        to_fixed.append(fixed.from_sensor(line["T_world_sensor"]))
        # a damaged frame contains no people, and its time may be wrong
        times.append(np.nan if line["time"] is None or line["error"] is not None else line["time"])
        for person in line["people"]:
            if person["joints"] is not None:
                joints = transform_points(to_fixed[-1], np.array(person["joints"]))
                values: dict[str, Any] = {
                    name: np.array(person[name], np.float32) for name in _SMOOTHED if person[name]
                }
                pose = Pose(joints=joints, skeleton=skeleton, **values)
                tracks.setdefault(person["track"], {})[row] = pose
    steady_poses: list[dict[int, tuple[Pose, bool, bool]]] = [{} for _ in times]
    for id in list(tracks):
        for row, pose, is_filled, is_swapped in _steady(tracks.pop(id), np.array(times)):
            steady_poses[row][id] = pose, is_filled, is_swapped
    for line, people, T_fixed_sensor in zip(lines(), steady_poses, to_fixed, strict=True):
        T_sensor_fixed = inverse_transform(T_fixed_sensor)
        entries = {
            id: _entry(pose, T_sensor_fixed, line["up"]) | {"filled": is_filled}
            for id, (pose, is_filled, _) in people.items()
        }
        swapped = {id for id, (_, _, is_swapped) in people.items() if is_swapped}
        people.clear()
        R_boxes_sensor = None if are_boxes_given else rotation_of_boxes(line["up"])
        line_people = [
            _unswapped(person, skeleton, entries[person["track"]]["facing"], R_boxes_sensor)
            if person["track"] in swapped
            else person
            for person in line["people"]
        ]
        yield line | {"people": list(_with_steady(line_people, entries))}


def _unswapped(
    person: dict[str, Any], skeleton: Skeleton, facing: list | None, R_boxes_sensor: np.ndarray | None
) -> dict[str, Any]:
    """A person whose left and right were exchanged: with the other side's joints out of range, and the box, if it was
    fitted to the pose, turned by half a turn if it is opposite to `facing` (3,), the smoothed one.

    R_boxes_sensor: `rotation_of_boxes` of the sensor frame, None for boxes that were not fitted to poses.
    """
    joints, box = skeleton.joints, person["box"]
    others = {name: joints[skeleton.flip[k]] for k, name in enumerate(joints)}
    if box is not None and facing is not None and R_boxes_sensor is not None:
        x, y, _ = R_boxes_sensor @ facing
        if x * np.cos(box["yaw"]) + y * np.sin(box["yaw"]) <= 0:
            yaw = (box["yaw"] + 2 * np.pi) % (2 * np.pi) - np.pi
            box = box | {"yaw": round(float(yaw), 4)}
    return person | {"box": box, "out_of_range": [others.get(name, name) for name in person["out_of_range"]]}


def _steady(poses: dict[int, Pose], times: np.ndarray) -> Iterator[tuple[int, Pose, bool, bool]]:
    """Yields the smoothed poses of a track in temporal order: row, pose, whether it was filled in, and whether left and
    right were exchanged. times: s, of all rows."""
    rows = np.arange(min(poses), max(poses) + 1)
    rows = rows[np.isfinite(times[rows])]
    skeleton = next(iter(poses.values())).skeleton
    # after the clock was set back, the rest is smoothed separately
    for run in np.split(rows, np.flatnonzero(np.diff(times[rows]) < -MAX_LATE) + 1):
        # frames that come late, or have the same time as another, are not smoothed
        run = run[times[run] > np.maximum.accumulate(np.concatenate([[-np.inf], times[run]]))[:-1]]
        track = smooth(TrackPoses.of_poses(times[run], [poses.get(row) for row in run.tolist()], skeleton))
        assert track.swapped is not None
        for i, row in enumerate(run.tolist()):
            if (pose := track.pose(i)) is not None:
                yield row, pose, row not in poses, bool(track.swapped[i])


def _entry(pose: Pose, T_sensor_fixed: np.ndarray, up: str) -> dict[str, Any]:
    """The entries of a line for a smoothed pose. up: up axis of the sensor frame."""
    values = {
        name: value.astype(np.float32).astype(float).round(_SMOOTHED[name]).tolist()
        for name, value in known_values(pose, *_SMOOTHED).items()
    }
    joints = rounded_points(T_sensor_fixed, pose.joints)
    return values | {"joints": joints, "facing": facing_entry(replace(pose, joints=np.array(joints)), up)}


def _with_steady(people: list[dict[str, Any]], entries: dict[int, dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """The people of a line with their smoothed values, then the occluded people that were added."""
    for person in people:
        entry = entries.pop(person["track"], {})
        if entry.get("filled"):
            # the pose comes from other frames
            entry["warnings"] = [text for text in person["warnings"] if not text.startswith("no pose")]
        yield person | entry
    for id, entry in sorted(entries.items()):
        person_entry: dict[str, Any] = {"id": id, "num_points": 0}
        person_entry |= dict.fromkeys(("box", "score", "mounted", "person", "second_person", "joints", "velocity"))
        person_entry |= {name: [] for name in ("confidence", "spread", "visible", "out_of_range", "warnings")}
        yield person_entry | {"track": id} | entry
