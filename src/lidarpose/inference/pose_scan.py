"""Poses of the people of a scan, in its frame, with warnings."""

import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import count

import numpy as np

from lidarpose.inference.checks import check_scan, origin_warning, unit_warning
from lidarpose.inference.cloud_predictor import CloudPredictor
from lidarpose.inference.inputs import distinct
from lidarpose.inference.results import PersonPose, Poses
from lidarpose.inference.scan import Scan
from lidarpose.sample import Box
from lidarpose.skeleton import Skeleton


def pose_scan(
    scan: Scan, predictor: CloudPredictor, *, skeleton: str | Skeleton | None = None, progress: bool = False
) -> Poses:
    """Poses of the scan's people in the input frame, with warnings; `timing_ms` has "crop", "predict" and
    "per_person"."""
    start = time.perf_counter()
    clouds = [distinct(cloud) for cloud in scan.clouds()]
    crop_end = time.perf_counter()
    warnings = list(scan.warnings)
    if warning := origin_warning(scan):
        warnings.append(warning)
        scan = replace(scan, origin=None)
    origin = scan.level_origin
    if scan.boxes:
        pelvises = None if scan.pelvises is None else scan.pelvises @ scan.R_level_input.T
        if pelvises is not None and scan.verified is not None:
            # people who were found in this scan get all passes
            pelvises = np.where(scan.verified[:, None], np.nan, pelvises)
        box_centers = np.stack([scan.R_level_input @ box.center for box in scan.boxes])
        is_scored = all(box.score is not None for box in scan.boxes)
        newest_clouds = scan.with_newest().newest_clouds()
        level_poses = predictor.predict_in(
            *(clouds, origin, skeleton, progress),
            pelvises=pelvises, box_centers=box_centers, is_scored=is_scored, newest_clouds=newest_clouds,
        )  # fmt: skip
    else:
        # a crop, or no boxes at all
        times = [scan.point_times] if scan.boxes is None else []
        level_poses = predictor.predict_clouds(scan.clouds(), origin, skeleton, progress, times=times)
    predict_ms = (time.perf_counter() - crop_end) * 1e3
    level_poses = replace(level_poses, people=_named(level_poses, scan.boxes))
    warnings += check_scan(scan, level_poses)
    people = [_in_input(person, scan) for person in level_poses]
    if scan.boxes is None:
        # warnings from reading a crop belong to its person
        people = [replace(people[0], warnings=tuple(dict.fromkeys((*scan.warnings, *people[0].warnings))))]
        warnings = warnings[len(scan.warnings) :]
    per_person = predict_ms / max(sum(person.has_pose for person in people), 1)
    return replace(
        level_poses,
        people=tuple(people),
        source=scan.source,
        warnings=tuple(warnings),
        timing_ms={"crop": (crop_end - start) * 1e3, "predict": predict_ms, "per_person": per_person},
        up=scan.up,
        # the surroundings of the boxes, for drawing
        scan=None if scan.boxes is None else scan.points,
        origin=scan.origin,
    )


def _named(people: Sequence[PersonPose], boxes: list[Box] | None) -> tuple[PersonPose, ...]:
    """People with the ids of their boxes. A box without an id gets its index, or the next free number if another box
    has that id."""
    if boxes is None:
        return (replace(people[0], id=0),)
    box_ids = {box.id for box in boxes}
    free_ids = (number for number in count(len(boxes)) if number not in box_ids)
    named_people = []
    for i, (person, box) in enumerate(zip(people, boxes, strict=True)):
        id = box.id if box.id is not None else next(free_ids) if i in box_ids else i
        # if the box is in wrong units, the scan's warnings say so; warnings about its crop would be misleading
        is_misfit = person.has_pose and unit_warning(box.size, what="it")
        named_people.append(replace(person, id=id, box=box, warnings=() if is_misfit else person.warnings))
    return tuple(named_people)


def _in_input(person: PersonPose, scan: Scan) -> PersonPose:
    R_level_input = scan.R_level_input
    pose = person.pose and replace(person.pose, joints=person.pose.joints @ R_level_input)
    pelvis = None if person.pelvis is None else person.pelvis @ R_level_input
    # a box taken out of the result keeps the up axis
    box = person.box and person.box.with_up(scan.up)
    return replace(person, pose=pose, pelvis=pelvis, box=box, points=person.points @ R_level_input, up=scan.up)
