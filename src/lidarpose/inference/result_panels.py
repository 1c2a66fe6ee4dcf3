"""What the pictures of a result show: a panel for each person, level, and the scan seen from above."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from lidarpose.errors import counted
from lidarpose.geometry import UP_AXES, axes_from_above, rotation_from_up, rotation_of_boxes
from lidarpose.sample import Box, person_note
from lidarpose.viz.bird_eye import LONGEST_NAME, ScanPanel
from lidarpose.viz.draw import shortened
from lidarpose.viz.person_view import Panel, joined_poses

if TYPE_CHECKING:
    from lidarpose.inference.results import PersonPose, Poses

# characters of the longest id for which names beside each other can be read
_SHORT_ID = 6


def panels_of(poses: "Poses") -> tuple[list[Panel], ScanPanel | None]:
    """The panels to draw: one per person, and the scan around them if there is one."""
    upright_people = [_upright(person, poses.up) for person in poses.people]
    ids = _ids_in_scan(poses)
    panels = [
        Panel(
            points=p.points,
            pose=p.pose,
            label=person_label(_card_id(person.id, id), person.score, person.mounted),
            box=p.box,
            distance=_distance(person, poses.origin),
            note=person_note(person.pose, is_scored=person.score is not None),
            num_points=person.num_points,
        )
        for p, person, id in zip(upright_people, poses.people, ids, strict=True)
    ]
    return panels, None if poses.scan is None else _from_above(poses, upright_people, ids)


def _ids_in_scan(poses: "Poses") -> list[str | int | None]:
    """The ids that are drawn in a scan: those of the people, or numbers from 1 if ids are too long to be read beside
    each other."""
    ids = [person.id for person in poses.people]
    is_numbered = poses.scan is not None and len(ids) > 1 and max(len(str(id)) for id in ids) > _SHORT_ID
    return list(range(1, len(ids) + 1)) if is_numbered else ids


def _card_id(id: str | int | None, id_in_scan: str | int | None) -> str | int | None:
    """The id on a card, after the one in the scan if that is another one."""
    return id_in_scan if id is None or str(id) == str(id_in_scan) else f"{id_in_scan}: {id}"


def _distance(person: "PersonPose", origin: np.ndarray | None) -> float:
    """Distance of the person from the sensor, m; NaN without points or if the sensor position is unknown."""
    if origin is None or not len(person.points):
        return np.nan
    return float(np.linalg.norm(np.median(person.points, 0) - origin))


def _from_above(poses: "Poses", people: "list[PersonPose]", ids: Sequence[str | int | None]) -> ScanPanel:
    """The scan with `people`, which are in the level frame (z up), and the ids that are drawn beside them."""
    assert poses.scan is not None
    R_level_input = rotation_from_up(poses.up)
    posed = [person for person in people if person.has_pose]
    label = counted(len(people), "person", "people") if people else "no people"
    if len(posed) < len(people):
        label += f", {len(posed)} with a pose"
    return ScanPanel(
        points=poses.scan @ R_level_input.T,
        boxes=[
            # also boxes without an id have that of their card
            _level_box(replace(box, id=id), poses.up)
            for person, id in zip(poses.people, ids, strict=True)
            if (box := person.box) is not None
        ],
        poses=joined_poses([(person.joints, person.confidence) for person in posed], poses.skeleton),
        names=[
            "" if id is None else shortened(str(id), LONGEST_NAME)
            for person, id in zip(people, ids, strict=True)
            if person.has_pose
        ],
        label=label,
        sensor=None if poses.origin is None else tuple((R_level_input @ poses.origin)[:2].tolist()),
        axes=axes_from_above(poses.up),
    )


def _upright(person: "PersonPose", up: str) -> "PersonPose":
    """The person rotated to z up for drawing. The box is dropped if `up` is a direction, since it would be drawn
    tilted."""
    R_level_input = rotation_from_up(up)
    pose, box = person.pose, person.box if up in UP_AXES else None
    return replace(
        person,
        points=person.points @ R_level_input.T,
        pose=pose and replace(pose, joints=pose.joints @ R_level_input.T),
        box=box and _level_box(box, up),
    )


def _level_box(box: Box, up: str) -> Box:
    """A box of the input rotated to z up. If `up` is a direction, the box keeps its size and is drawn upright."""
    R_level_input = rotation_from_up(up)
    # the inverse of how `detect` writes the headings of a tilted scan
    R_boxes_level = rotation_of_boxes(up) @ R_level_input.T
    x, y = np.linalg.solve(R_boxes_level[:2, :2], [np.cos(box.yaw), np.sin(box.yaw)])
    return replace(box, center=R_level_input @ box.center, yaw=float(np.arctan2(y, x)))


def person_label(id: str | int | None, score: float | None, mounted: bool | None) -> str:
    """The label of a person in pictures: the id, the score if there is one, and whether the person rides."""
    words = [] if id is None else [str(id)]
    words += [] if score is None else [f"score {score:.2f}"]
    return " · ".join([*words, "rides"] if mounted else words)
