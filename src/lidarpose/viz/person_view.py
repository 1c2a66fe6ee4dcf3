"""A person to draw, and helpers shared by pictures and reports: facing, views, sides, captions."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeGuard

import numpy as np

from lidarpose.errors import InputError, counted
from lidarpose.geometry import rotation_about
from lidarpose.sample import MIN_POINTS, Box, Pose, facing
from lidarpose.skeleton import Skeleton


@dataclass(frozen=True, kw_only=True, eq=False)
class Panel:
    """One person to draw. Raises InputError on a wrong shape.

    Args:
        points: (n, 3) m, z up; n = 0 is allowed.
        pose, truth: predicted and true pose of one person in the points' frame, joints (J, 3) m; non-finite joints are
            not drawn.
        label: the name above the caption.
        part: (n,) int, 0 = background, 1 + j = the bone of SMPL-24's joint j: colors the points by side.
        box: drawn in pictures.
        distance: m, printed; by default from the frame's origin to the person; not printed if NaN.
        caption: the line under the person, by default the number of points, the distance and the mean confidence.
        forward: (3,) facing of the person, see `facing`; the views are aligned with it. By default that of the pose,
            else of the truth.
        note: what is doubtful, printed after the caption.
        num_points: number of points of a predicted person, which `points` may lack; by default that of `points`.
    """

    points: np.ndarray
    pose: Pose | None = None
    truth: Pose | None = None
    label: str = ""
    part: np.ndarray | None = None
    box: Box | None = None
    distance: float | None = None
    caption: str = ""
    forward: np.ndarray | None = None
    note: str | None = None
    num_points: int | None = None

    def __post_init__(self):
        if self.points.ndim != 2 or self.points.shape[1] != 3:
            raise InputError(f"Panel.points must be (n, 3) meters, got {self.points.shape}")
        if self.part is not None and self.part.shape != (len(self.points),):
            raise InputError(f"Panel.part must be ({len(self.points)},), one per point, got {self.part.shape}")
        for name, pose in (("pose", self.pose), ("truth", self.truth)):
            if pose is not None and pose.joints.ndim != 2:
                raise InputError(
                    f"Panel.{name} must hold one person, joints ({len(pose.skeleton)}, 3), got {pose.joints.shape}: "
                    "draw people one by one"
                )


def count_of(person: Panel) -> int:
    """The person's number of points."""
    return len(person.points) if person.num_points is None else person.num_points


def facing_of(person: Panel) -> np.ndarray | None:
    """The panel's `forward`, else `facing` of the predicted pose, else of the true one."""
    forward = facing(person.pose) if person.forward is None else person.forward
    return facing(person.truth) if forward is None else forward


def project(points: np.ndarray, *, seen_from: np.ndarray) -> np.ndarray:
    """Projects points (..., 3) m to a horizontal view: (..., 3) m = (right, up, towards the viewer).

    seen_from (3,) is the horizontal unit direction from the points to the viewer. In a front view, the person's left
    side is on the picture's right.
    """
    x, y, _ = seen_from
    return np.asarray(points, float) @ np.array([[-y, x, 0.0], [0, 0, 1], [x, y, 0]]).T


def view_directions(forward: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """The two `seen_from` of a person who faces `forward`: from the front, and from the person's right, so that the
    person faces the picture's right. Without a direction: from +x and from -y."""
    x, y, _ = (1.0, 0.0, 0.0) if forward is None else forward
    return np.array([x, y, 0.0]), np.array([y, -x, 0.0])


def side(joint: str) -> str:
    """ "left", "right" or "center", by the joint's name."""
    return next((s for s in ("left", "right") if joint.startswith(s + "_")), "center")


def bone_sides(skeleton: Skeleton) -> list[str]:
    """The side of each of `skeleton.bones`: the child's; "center" for a bone from one side to the other."""
    sides = [side(name) for name in skeleton.joints]
    return ["center" if {sides[a], sides[b]} == {"left", "right"} else sides[b] for a, b in skeleton.bones]


def bone_pairs(skeleton: Skeleton) -> np.ndarray:
    """`skeleton.bones` as (B, 2) indices."""
    return np.array(skeleton.bones, int).reshape(-1, 2)


def box_edges(box: Box) -> np.ndarray:
    """(12, 2, 3) m: the edges of a box."""
    corner = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * box.size / 2
    corner = corner @ rotation_about("z", box.yaw).T + box.center
    return np.array([corner[[i, i | bit]] for i in range(8) for bit in (1, 2, 4) if not i & bit])


def joined_poses(people: Sequence[tuple[np.ndarray, Any]], skeleton: Skeleton) -> Pose | None:
    """The poses of people in one, from joints (J, 3) m and confidence (J,), which may be None or empty, of each; None
    without people."""
    if not people:
        return None
    confidence = np.stack([values if values is not None and len(values) else np.ones(len(j)) for j, values in people])
    return Pose(joints=np.stack([joints for joints, _ in people]), skeleton=skeleton, confidence=confidence)


def confidences(pose: Pose) -> np.ndarray:
    """Confidences (J,) in [0, 1]; 1 if the pose has none."""
    if pose.confidence is None:
        return np.ones(len(pose.skeleton))
    return np.clip(np.nan_to_num(np.asarray(pose.confidence, float)), 0, 1)


def is_known(pose: Pose | None) -> TypeGuard[Pose]:
    """Whether there is a pose with at least one finite joint."""
    return pose is not None and bool(np.isfinite(pose.joints).all(-1).any())


def describe(person: Panel) -> str:
    """The line under a person: the caption, by default number of points, distance from the origin, mean confidence."""
    if person.caption:
        return person.caption
    words = [counted(count_of(person), "point")]
    distance = person.distance
    if distance is None:
        center = middle(person)
        distance = None if center is None else float(np.linalg.norm(center))
    if distance is not None and np.isfinite(distance):
        words.append(f"{distance:.1f} m")
    if is_known(person.pose) and person.pose.confidence is not None:
        words.append(f"confidence {confidences(person.pose).mean():.2f}")
    return " · ".join(filter(None, (*words, person.note)))


def missing_pose(person: Panel) -> str:
    """The note for a missing prediction; empty if there is a pose or none is expected."""
    # a labeled person of a dataset was never predicted
    if is_known(person.pose) or (person.pose is None and is_known(person.truth)):
        return ""
    if count_of(person) < MIN_POINTS:
        return f"no pose: under {MIN_POINTS} points"
    return "" if person.pose is None and person.num_points is None else "no pose"


def finite(points: np.ndarray) -> np.ndarray:
    """The finite points of points (n, 3)."""
    return points[np.isfinite(points).all(-1)]


def middle(person: Panel) -> np.ndarray | None:
    """Median position (3,) of the true, else the predicted joints, else of the points, which may be mostly background;
    None if there is no finite position."""
    clouds = [pose.joints for pose in (person.truth, person.pose) if pose is not None] + [person.points]
    for cloud in clouds:
        if len(cloud := finite(np.asarray(cloud, float))):
            return np.median(cloud, axis=0)
    return None
