"""`PoseEstimator`: predicts poses from the points of people, in batches, with a first pass that finds the pelvis and
with test-time augmentation.

Legend: N clouds, B clouds of a batch.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lidarpose.inference.backend import Backend, estimates
from lidarpose.inference.inputs import Clips, is_few
from lidarpose.inference.tta import IDENTITY, MIRRORED, TTATransform, apply, average, invert, tta_transforms
from lidarpose.models.config import NetworkConfig
from lidarpose.models.decode import decoder
from lidarpose.models.voxelize import WINDOW
from lidarpose.progress import Progress
from lidarpose.sample import MIN_POINTS, PER_JOINT, PER_PERSON, Pose, center_of, known_values

# decimals, in m, to which the centers of the second pass are rounded: backends differ by less than a micrometer, which
# must not move a point to another voxel
_CENTER_DECIMALS = 2
_CENTER_STEP = 10**-_CENTER_DECIMALS
# `second_person` above which a cloud shows two people
_TWO_PEOPLE = 0.2
# pelvises farther apart than this, m, are of different people; the same for the pelvis and the center of the box
_SAME_PERSON = 0.2
# mean confidence above which a pose is not repeated about the box center, and the fraction of another pose's confidence
# that is enough for a pose beside a second person
_SURE, _LESS_SURE = 0.7, 0.5
# the weight of the pose of a person's newest points, relative to that of all points, and the maximum horizontal
# distance of these points from the pelvis, m
_NEWEST_WEIGHT, _REACH = 3.0, 1.25


class PoseEstimator:
    """Runs a network and decodes its outputs into poses.

    The first pass finds the pelvis, on which the following passes are centered. With the package's own networks, the
    first pass sees the person mirrored and its pose is averaged with the others, which is nearly as good as a separate
    mirrored pass. The paper's networks are run as released.

    Args:
        backend: runs the network.
        decode: heatmap decoder, see `load`.
        tta: number of test-time augmentation transforms, see `load`.
    """

    def __init__(self, backend: Backend, *, decode: str = "window", tta: int = 1):
        self.backend, self.header, self.skeleton = backend, backend.header, backend.header.skeleton
        self._decoder, self._tta = decoder(decode), tta_transforms(tta)
        # whether the pose of the first pass is averaged with the others, and the transform of the first pass
        self._averaged = self.header.network == NetworkConfig.kind
        self._first = MIRRORED if self._averaged else IDENTITY
        # whether the centers of boxes affect poses
        self.uses_box_centers = self._averaged
        self._middle = list(self.skeleton.middle)

    def _pelvis_of(self, pose: Pose) -> np.ndarray:
        """(..., 3) m: the pelvis of poses of the network, or the middle of the hips if its skeleton has none."""
        return pose.joints[..., self._middle, :].mean(-2)

    def outputs(
        self, clouds: list[np.ndarray], centers: np.ndarray, origin: np.ndarray | None, clip: Clips | None = None
    ) -> Pose:
        """A single forward pass.

        Args:
            clouds: B clouds (n, 3) m.
            centers: (B, 3) m, the origins of the persons' frames.
            origin: (3,) m, the sensor position, None if unknown.
            clip: for networks that read clips: which clouds are frames of the same person.

        Returns:
            Poses of B people relative to `centers`.
        """
        return self._transformed(IDENTITY, clouds, centers, origin, clip)

    def _transformed(self, transform: TTATransform, clouds, centers, origin, clip) -> Pose:
        local_clouds, view = apply(transform, clouds, centers, origin)
        options: dict[str, Any] = {}
        if clip is not None:
            options["clip"] = clip.mapped(lambda surroundings: apply(transform, surroundings, centers, origin)[0])
        return invert(
            estimates(self.backend.run(local_clouds, view, **options), self._decoder, self.skeleton), transform
        )

    def poses(
        self,
        clouds: Sequence[np.ndarray],
        origin: np.ndarray | None,
        *,
        clips: Clips | None = None,
        centers: np.ndarray | None = None,
        first_centers: np.ndarray | None = None,
        box_centers: np.ndarray | None = None,
        progress: bool = False,
    ) -> list[Pose | None]:
        """Poses of N clouds.

        Args:
            clouds: N clouds (n, 3) m.
            origin: (3,) m, the sensor position, None if unknown.
            clips: for networks that read clips: which clouds are frames of the same person.
            centers: (N, 3) m, approximate pelvis positions; with them, the first pass is skipped.
            first_centers: (N, 3) m, centers of the first pass; None means the middle of each cloud.
            box_centers: (N, 3) m; they tell which person is meant where a cloud shows two or the pose is uncertain.
            progress: whether to show a progress bar.

        Returns:
            One pose per cloud; None if too few points are near the center, or if the cloud is in no window of `clips`.
        """
        poses: list[Pose | None] = [None] * len(clouds)
        # by parameter of `_batch`
        given_places = {"centers": centers, "first_centers": first_centers, "box_centers": box_centers}
        places = {name: place for name, place in given_places.items() if place is not None}
        count = 0
        with Progress(len(clouds), unit="clouds", shown=progress) as bar:
            for rows, clip in self._batches(clouds, clips):
                batch_places = {name: place[rows] for name, place in places.items()}
                batch_poses = self._batch([clouds[row] for row in rows], origin, clip, **batch_places)
                for row, pose in zip(rows, batch_poses, strict=True):
                    poses[row] = pose
                count += len(rows)
                bar.update(count)
        return poses

    def _batches(
        self, clouds: Sequence[np.ndarray], clips: Clips | None
    ) -> Iterator[tuple[Sequence[int], Clips | None]]:
        """Yields the rows of each batch of clouds, with the clips of these rows. Clouds of similar size share a batch,
        since a batch costs as much as if all its clouds were as large as the largest."""
        count = self.backend.batch
        if clips is not None:
            yield from ((rows.tolist(), clip) for rows, clip in clips.batches(count))
            return
        order = sorted(range(len(clouds)), key=lambda row: len(clouds[row]))
        yield from ((order[start : start + count], None) for start in range(0, len(order), count))

    def _batch(
        self,
        clouds: list[np.ndarray],
        origin: np.ndarray | None,
        clip: Clips | None,
        centers: np.ndarray | None = None,
        first_centers: np.ndarray | None = None,
        box_centers: np.ndarray | None = None,
    ) -> list[Pose | None]:
        first_passes: list[Pose] = []
        if centers is not None:
            centers = np.round(centers, _CENTER_DECIMALS)
        else:
            centers = np.stack([center_of(points) for points in clouds]) if first_centers is None else first_centers
            first_passes = [self._transformed(self._first, clouds, centers, origin, clip)]
            if box_centers is not None and self._averaged and first_passes[0].confidence is not None:
                centers, first_passes = self._passes_about_boxes(clouds, centers, box_centers, origin, first_passes[0])
            root = self._pelvis_of(first_passes[0])
            # NaN stays NaN
            shift = np.round(np.clip(root, -WINDOW / 2, WINDOW / 2) / _CENTER_STEP) * _CENTER_STEP
            centers = centers + shift
            first_passes = [replace(pose, joints=pose.joints - shift[:, None]) for pose in first_passes]
        tta_poses = [self._transformed(transform, clouds, centers, origin, clip) for transform in self._tta]
        mean_pose = average([*tta_poses, *first_passes] if self._averaged else tta_poses)
        poses: list[Pose | None] = []
        for k, points in enumerate(clouds):
            near_count = (np.abs(points - centers[k]) < WINDOW).all(1).sum()
            if near_count < MIN_POINTS or not np.isfinite(mean_pose.joints[k]).all():
                poses.append(None)
                continue
            values = {name: value[k] for name, value in known_values(mean_pose, *PER_JOINT, *PER_PERSON).items()}
            poses.append(replace(mean_pose, joints=mean_pose.joints[k] + centers[k], **values))
        return poses

    def averaged_with_newest(
        self, poses: Sequence[Pose], newest_clouds: Sequence[np.ndarray], origin: np.ndarray | None
    ) -> list[Pose]:
        """Poses of N people from all points of several scans, averaged with those from each person's newest points,
        where there is one: the older points show where a moving person was.

        Args:
            poses: of all points.
            newest_clouds: N clouds (n, 3) m, see `newest_points`.
            origin: (3,) m, the sensor position, None if unknown.
        """
        pelvises = [self._pelvis_of(pose) for pose in poses]
        # a cloud may hold more than the person
        pairs = zip(newest_clouds, pelvises, strict=True)
        clouds = [cloud[np.hypot(*(cloud - pelvis)[:, :2].T) < _REACH] for cloud, pelvis in pairs]
        rows = [row for row, cloud in enumerate(clouds) if not is_few(cloud)]
        averaged = list(poses)
        if rows:
            box_centers = np.stack([pelvises[row] for row in rows])
            newest_poses = self.poses([clouds[row] for row in rows], origin, box_centers=box_centers)
            for row, newest_pose in zip(rows, newest_poses, strict=True):
                if newest_pose is not None:
                    averaged[row] = average([poses[row], newest_pose], (1.0, _NEWEST_WEIGHT))
        return averaged

    def _passes_about_boxes(
        self,
        clouds: list[np.ndarray],
        centers: np.ndarray,
        box_centers: np.ndarray,
        origin: np.ndarray | None,
        first_pass: Pose,
    ) -> tuple[np.ndarray, list[Pose]]:
        """Repeats the first pass about the box centers where it may have posed another person than the box is about:
        where it saw two people, is uncertain, or found the pelvis far from the box center.

        Returns:
            The centers (B, 3), and the poses about them: the first passes, in which the repeated pass replaces one that
            posed another person, and the repeated passes that agree, with confidence 0 where there is none.
        """
        confidence, pelvis = _mean_confidence(first_pass), centers + self._pelvis_of(first_pass)
        shows_two = _shows_two(first_pass)
        distance = np.hypot(*(pelvis - box_centers)[:, :2].T)
        rows = np.flatnonzero(shows_two | (distance > _SAME_PERSON) | (confidence < _SURE))
        if not len(rows):
            return centers, [first_pass]
        new_centers = np.round(box_centers[rows], _CENTER_DECIMALS)
        repeated = self._transformed(self._first, [clouds[row] for row in rows], new_centers, origin, None)
        new_confidence, new_pelvis = _mean_confidence(repeated), new_centers + self._pelvis_of(repeated)
        is_apart = np.linalg.norm(new_pelvis - pelvis[rows], axis=1) > _SAME_PERSON
        # beside another person a correct pose may be less certain than that of the other
        required = np.where(_shows_two(repeated), _LESS_SURE, 1.0) * confidence[rows]
        is_other = shows_two[rows] | (is_apart & (new_confidence > required))
        centers = centers.copy()
        centers[rows[is_other]] = new_centers[is_other]
        repeated = replace(repeated, joints=repeated.joints + (new_centers - centers[rows])[:, None])
        first_values, repeated_values = {}, {}
        for name, value in known_values(first_pass, "joints", *PER_JOINT, *PER_PERSON).items():
            first_values[name], repeated_values[name] = value.copy(), value.copy()
            first_values[name][rows[is_other]] = getattr(repeated, name)[is_other]
            repeated_values[name][rows] = getattr(repeated, name)
        is_unused = np.ones(len(clouds), bool)
        is_unused[rows] = is_other | is_apart
        repeated_values["confidence"][is_unused] = 0.0
        return centers, [replace(first_pass, **values) for values in (first_values, repeated_values)]


def _mean_confidence(pose: Pose) -> np.ndarray:
    assert pose.confidence is not None
    return pose.confidence.mean(1)


def _shows_two(pose: Pose) -> np.ndarray:
    """(B,) bool: whether clouds show two people; False if the network does not predict it."""
    return np.zeros(len(pose.joints), bool) if pose.second_person is None else pose.second_person > _TWO_PEOPLE
