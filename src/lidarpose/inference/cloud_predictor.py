"""`CloudPredictor`: poses of clouds that each show one person, with warnings."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lidarpose.errors import first_names
from lidarpose.inference.backend import Backend
from lidarpose.inference.checks import (
    UPSIDE_DOWN,
    is_lying,
    looks_unsure,
    oversize_warning,
    person_count_warning,
    unit_warning,
    upside_down_warning,
)
from lidarpose.inference.crop_search import UNSURE, WIDE_IF_UNSURE, candidates, mean_confidence, select_pose
from lidarpose.inference.estimator import PoseEstimator
from lidarpose.inference.inputs import Clips, clean, distinct, is_few, only_returns
from lidarpose.inference.newest import newest_points
from lidarpose.inference.results import PersonPose, Poses
from lidarpose.models.voxelize import WINDOW
from lidarpose.sample import MIN_POINTS, Pose
from lidarpose.skeleton import SMPL24, Skeleton, as_skeleton


class CloudPredictor(PoseEstimator):
    """Predicts poses of people whose clouds are already checked.

    Args: see `Predictor`.
    """

    def __init__(self, backend: Backend, *, name: str, decode: str = "window", tta: int = 1):
        super().__init__(backend, decode=decode, tta=tta)
        self.model: dict[str, str | int] = {"name": name, "version": self.header.version, "backend": backend.name}
        self.model |= {"decode": decode} | ({"tta": tta} if tta > 1 else {})

    def in_skeleton(self, name: str | Skeleton | None) -> Skeleton:
        """The skeleton of predicted poses.

        Args:
            name: a skeleton or its name. None means smpl24, or the network's own skeleton if the network lacks joints
                of smpl24.

        Raises:
            InputError: an unknown name, or a skeleton with a joint that the network does not predict.
        """
        network_skeleton = self.skeleton
        if name is None:
            return SMPL24 if set(SMPL24.joints) <= set(network_skeleton.joints) else network_skeleton
        skeleton = as_skeleton(name)
        network_skeleton.map_to(skeleton)
        return skeleton

    def predict_clouds(
        self,
        clouds: Sequence[np.ndarray],
        origin: np.ndarray | None,
        skeleton: str | Skeleton | None = None,
        progress: bool = False,
        *,
        clips: Clips | None = None,
        times: Sequence[np.ndarray | None] | None = None,
    ) -> Poses:
        """Poses of clouds given by the user, without duplicate points, and with a warning for each cloud with rounded
        coordinates. Of people cropped from a scan, these belong to the scan. times: of each cloud's points, or None."""
        returns = [only_returns(cloud) for cloud in clouds]
        distinct_clouds = [points if is_few(points) else distinct(points) for points, _ in returns]
        newest_clouds = None
        if times is not None:
            pairs = zip(clouds, times, strict=True)
            newest_clouds = [newest_points(cloud, own, origin) for cloud, own in pairs]
        poses = self.predict_in(distinct_clouds, origin, skeleton, progress, clips=clips, newest_clouds=newest_clouds)
        people = zip(poses, returns, strict=True)
        people_with_notes = (replace(person, warnings=(*notes, *person.warnings)) for person, (_, notes) in people)
        return replace(poses, people=tuple(people_with_notes))

    def predict_in(
        self,
        clouds: Sequence[np.ndarray],
        origin: np.ndarray | None,
        skeleton: str | Skeleton | None = None,
        progress: bool = False,
        *,
        clips: Clips | None = None,
        pelvises: np.ndarray | None = None,
        box_centers: np.ndarray | None = None,
        newest_clouds: Sequence[np.ndarray | None] | None = None,
        is_scored: bool = False,
        check_upside_down: bool = True,
    ) -> Poses:
        """Like `predict` for a list of clouds (n, 3) m, with additional knowledge about them. Does not warn of rounded
        coordinates.

        Args:
            clips: as in `predict`, already checked.
            pelvises: (N, 3) m, approximate pelvis positions, NaN where unknown, of clouds that each show a single
                person. The first pass, which finds the pelvis, is then skipped.
            box_centers: (N, 3) m, centers of the boxes that cropped the clouds. They tell which person is meant where a
                cloud shows two people or the pose is uncertain.
            newest_clouds: for each cloud of several scans the newest of its points, see `newest_points`, else None.
                The paper's networks do not use them.
            is_scored: whether the boxes have scores, which rest on more than the points inside the box. Warnings that
                a cloud may not show a person are then suppressed.
            check_upside_down: whether to pose clouds with uncertain poses upside down as well, in order to warn of a
                wrong up axis. This costs as much as the pose itself.
        """
        target_skeleton = self.in_skeleton(skeleton)
        cleaned_clouds = [clean(cloud) for cloud in clouds]
        is_usable = np.array([not is_few(points) for points, _ in cleaned_clouds], bool)
        in_box = pelvises is not None or box_centers is not None
        is_placed = np.zeros(len(clouds), bool) if pelvises is None else np.isfinite(pelvises).all(1)
        best_poses = self._best(cleaned_clouds, is_usable, is_placed, origin, progress, clips, pelvises, box_centers)
        if newest_clouds is not None and self._averaged:
            newest = {i: cloud for i in best_poses if (cloud := newest_clouds[i]) is not None}
            averaged = self.averaged_with_newest([best_poses[i][0] for i in newest], list(newest.values()), origin)
            best_poses |= {i: (pose, best_poses[i][1]) for i, pose in zip(newest, averaged, strict=True)}
        poses: list[Pose | None] = [None] * len(clouds)
        unsure_rows: list[int] = []
        for i, (points, notes) in enumerate(cleaned_clouds):
            if not is_usable[i]:
                noun = "points" if len(points) < MIN_POINTS else "different points"
                notes.append(f"no pose: under {MIN_POINTS} {noun}")
                continue
            unit_note = unit_warning(np.ptp(points, axis=0), what="the person")
            if i not in best_poses:
                pose_note = f"no pose: under {MIN_POINTS} points within {WINDOW:.0f} m of the person's middle"
                notes += filter(None, (unit_note, pose_note))
                continue
            pose, part = best_poses[i]
            poses[i] = target_pose = pose.to(target_skeleton)
            # a known pelvis tells which person is meant
            count_note = None if is_placed[i] else person_count_warning(pose, in_box=in_box, is_scored=is_scored)
            notes += filter(None, (unit_note, count_note, _range_warning(target_pose)))
            if unit_note:
                continue
            if warning := oversize_warning(points, pose):
                notes.append(warning)
            elif not is_placed[i] and check_upside_down and looks_unsure(pose, part):
                unsure_rows.append(i)
        # detected people share one up axis: a few of many who look upside down are no sign of a wrong one
        least = len(best_poses) // 2 + 1 if is_scored else 1
        unsure_rows = unsure_rows if len(unsure_rows) >= least else []
        # pose the few uncertain clouds again upside down; if pelvises are known, people were upright in earlier frames
        flipped_clouds = [best_poses[i][1] * UPSIDE_DOWN for i in unsure_rows]
        flipped_poses = self.poses(flipped_clouds, None if origin is None else origin * UPSIDE_DOWN)
        # for lying people another up axis is possible; `check_scan` warns of it once for all people
        flipped_warnings = {
            i: warning
            for i, flipped_pose in zip(unsure_rows, flipped_poses, strict=True)
            if (warning := upside_down_warning(best_poses[i][0], flipped_pose)) and not is_lying(*best_poses[i])
        }
        if len(flipped_warnings) >= least:
            for i, warning in flipped_warnings.items():
                cleaned_clouds[i][1].append(warning)
        own_pelvises = {i: self._pelvis_of(pose) for i, (pose, _) in best_poses.items()}
        people = tuple(
            PersonPose(
                pose=poses[i],
                skeleton=target_skeleton,
                points=points,
                warnings=tuple(notes),
                model=self.model,
                pelvis=own_pelvises.get(i),
            )
            for i, (points, notes) in enumerate(cleaned_clouds)
        )
        return Poses(people=people, skeleton=target_skeleton, model=self.model)

    def _best(
        self, cleaned_clouds, is_usable, is_placed, origin, progress, clips, pelvises, box_centers
    ) -> dict[int, tuple[Pose, np.ndarray]]:
        """For each person with a pose, by index: the pose, and the part (n, 3) m of the cloud from which it was
        predicted. is_placed (N,) bool: whose pelvises are known."""
        if clips is not None:
            # clips index all clouds, so unusable clouds stay in the list
            clouds = [points for points, _ in cleaned_clouds]
            poses = self.poses(clouds, origin, clips=clips.usable(is_usable), progress=progress)
            return {i: (pose, clouds[i]) for i, pose in enumerate(poses) if pose is not None}

        def posed(parts: list[tuple[int, np.ndarray]], **places) -> list[tuple[int, Pose, np.ndarray]]:
            """(person, pose, part) of each part (person, cloud) that has a pose. places: see `poses`, by person."""
            values = {name: value[[i for i, _ in parts]] for name, value in places.items() if value is not None}
            poses = self.poses([part for _, part in parts], origin, progress=progress, **values) if parts else []
            return [(i, pose, part) for (i, part), pose in zip(parts, poses, strict=True) if pose is not None]

        clouds_by_person = {i: cleaned_clouds[i][0] for i in np.flatnonzero(is_usable).tolist()}
        placed = [(i, cloud) for i, cloud in clouds_by_person.items() if is_placed[i]]
        # the first candidate of a person is the whole cloud
        parts = [(i, part) for i, cloud in clouds_by_person.items() if not is_placed[i] for part in candidates(cloud)]
        answers = posed(parts, box_centers=box_centers)
        if box_centers is None:
            # a box tells which points are the person's; without one, ground and clutter may explain an unsure pose
            num_parts = Counter(i for i, _ in parts)
            answers += posed(
                [
                    (i, part)
                    for i, pose, cloud in answers
                    if num_parts[i] == 1 and 0 < mean_confidence(pose) < UNSURE
                    for part in candidates(cloud, WIDE_IF_UNSURE)[1:]
                ]
            )
        answers += posed(placed, centers=pelvises)
        poses_by_person: dict[int, list[tuple[Pose, np.ndarray]]] = {}
        for i, pose, part in answers:
            poses_by_person.setdefault(i, []).append((pose, part))
        return {
            i: select_pose(person_poses, None if box_centers is None else box_centers[i])
            for i, person_poses in poses_by_person.items()
        }


def _range_warning(pose: Pose) -> str | None:
    if pose.in_range is None or pose.in_range.all():
        return None
    names = [name for name, is_in_range in zip(pose.skeleton.joints, pose.in_range, strict=True) if not is_in_range]
    return f"at the edge of the heatmap's range, perhaps farther out than predicted: {first_names(names)}"
