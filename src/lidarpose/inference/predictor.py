"""`load` a network and predict the poses of one or many point clouds, of any number type; clouds may be empty."""

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Protocol, TypedDict, Unpack, overload

import numpy as np

from lidarpose.errors import InputError, check_int, check_name, first_names, needs_extra
from lidarpose.inference.backend import Backend, OnnxBackend, bundled_backend, exported_beside
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
from lidarpose.inference.inputs import (
    Clips,
    as_origin,
    as_points,
    clean,
    clip_times,
    distinct,
    is_few,
    is_many,
    only_returns,
    times_of_clouds,
)
from lidarpose.inference.newest import newest_points
from lidarpose.inference.results import PersonPose, Poses
from lidarpose.inference.scan import Scan, pose_scan, scan_of_array
from lidarpose.inference.tta import tta_transforms
from lidarpose.io.boxes import read_boxes
from lidarpose.io.files import file_error
from lidarpose.models import BUNDLED, DEFAULT, weights_name, weights_path
from lidarpose.models.checkpoint import read_header
from lidarpose.models.decode import decoder
from lidarpose.models.voxelize import WINDOW
from lidarpose.sample import MIN_POINTS, PER_PERSON, Box, Pose
from lidarpose.skeleton import SMPL24, Skeleton, as_skeleton
from lidarpose.tracking.clip import TrackPoses
from lidarpose.tracking.live import filter_track
from lidarpose.tracking.smoothing import smooth

if TYPE_CHECKING:
    import torch
    from numpy.typing import ArrayLike

BACKENDS = ("onnx", "torch")
# default number of test-time augmentation passes
TTA = 1


def load(
    weights: str | os.PathLike = DEFAULT,
    *,
    device: "str | torch.device | None" = "cpu",
    backend: str | None = None,
    decode: str = "window",
    compile: bool = False,
    threads: int | None = None,
    tta: int = TTA,
) -> "Predictor":
    """Loads a pose network and returns a `Predictor`.

    Args:
        weights: name of bundled weights, or path of a checkpoint (.safetensors) or an exported file (.onnx).
        device: "cpu", or, with the torch backend, any torch device such as "cuda". None means "cpu".
        backend: "onnx" (ONNX Runtime on the CPU) or "torch". None selects onnx for bundled weights on the CPU and for
            .onnx files, and torch otherwise.
        decode: how joint positions are read from heatmaps: "window" (mean around the mode), "argmax", or "dark" (the
            refinement of the released DAPT code). If two peaks are equally high, rounding decides between them.
        compile: whether to compile the network with `torch.compile`. Torch backend only.
        threads: number of threads over which people are distributed. ONNX backend only. None means the number of
            processors available to the process, at most 8 and at most the environment variable OMP_NUM_THREADS.
        tta: number of test-time augmentation transforms per person, 1 to 8. Their poses are averaged with the pose of
            the first pass, which centers the cloud. Each person costs the first pass and one pass per transform, so
            `tta=1` takes two passes and `tta=4` takes five.

    Returns:
        A `Predictor`.

    Raises:
        InputError: an unknown name, a file that is not a checkpoint, or a device that is not available.
        MissingExtra: torch is needed but not installed.
    """
    path = check_settings(weights, backend=backend, decode=decode, tta=tta)
    device = "cpu" if device is None else str(device)
    if threads is not None:
        threads = check_int("threads", threads, least=1)
    is_bundled, is_exported = os.fspath(weights) in BUNDLED, path.suffix.lower() == ".onnx"
    is_plain = device == "cpu" and not compile
    if backend is None:
        backend = "onnx" if is_exported or is_bundled and is_plain else "torch"
    if backend == "torch":
        if is_exported:
            raise file_error(path, "torch runs a .safetensors file, not .onnx: give the file that it was exported from")
        if threads is not None:
            raise InputError("threads is an option of the backend onnx: for torch call torch.set_num_threads")
        network_backend = _torch_backend(path, device, compile)
    elif not is_plain:
        option = "torch.compile" if compile else f"device {device!r}"
        raise InputError(f"{option} needs the backend torch and a .safetensors file, got the backend onnx")
    elif is_bundled and threads is None:
        # the verification of detections runs the same network: share its session
        network_backend = bundled_backend(path.stem)
    elif is_bundled or is_exported:
        network_backend = OnnxBackend(path if is_exported else path.with_suffix(".onnx"), threads=threads)
    else:
        network_backend = exported_beside(path, threads=threads)
    if not network_backend.header.config.poses:
        raise file_error(path, "contains a detection network: give the weights of a pose network")
    return Predictor(network_backend, name=weights_name(path), decode=decode, tta=tta)


def check_settings(weights: str | os.PathLike, *, backend: str | None, decode: str, tta: int) -> Path:
    """Checks the settings of `load` without loading anything; returns the path of the weights. Raises InputError."""
    decoder(decode)
    tta_transforms(tta)
    if backend is not None:
        check_name("backend", backend, BACKENDS)
    return weights_path(weights)


def _torch_backend(path: Path, device: str, compile: bool) -> Backend:
    # report a bad file even if torch is not installed
    read_header(path)
    with needs_extra(f"running {path.name} with torch"):
        from lidarpose.inference.torch_backend import torch_backend
    return torch_backend(path, device=device, compile=compile)


class _Array(Protocol):
    """An array of numpy, torch or pandas. Unlike `ArrayLike` it excludes lists, which would make the overloads of
    `predict` ambiguous."""

    def __array__(self) -> np.ndarray: ...


_Cloud = _Array | Sequence[Sequence[float]]


class _Options(TypedDict, total=False):
    sensor_origin: "np.ndarray | Sequence[float] | str | None"
    skeleton: str | Skeleton | None
    progress: bool
    point_times: "ArrayLike | Sequence[ArrayLike | None] | None"


class Predictor(PoseEstimator):
    """A loaded network that predicts poses; made by `load`.

    `predict` and `predict_clip` check and clean their input. `outputs` is a single forward pass without checks.

    Args:
        backend: runs the network.
        name: name of the weights, reported in the attribute `model` and in results.
        decode: heatmap decoder, see `load`.
        tta: number of test-time augmentation transforms, see `load`.
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

    def __repr__(self) -> str:
        return f"Predictor({self.model['name']!r}, {self.skeleton.name}, {self.backend.name}, tta={len(self._tta)})"

    @overload
    def predict(
        self,
        points: Sequence[_Cloud],
        *,
        boxes: None = None,
        find: Literal[False] = False,
        clips: Clips | None = None,
        **options: Unpack[_Options],
    ) -> Poses: ...

    @overload
    def predict(
        self, points: _Cloud, *, boxes: None = None, find: Literal[False] = False, **options: Unpack[_Options]
    ) -> PersonPose: ...

    @overload
    def predict(self, points: _Cloud, *, find: Literal[True], **options: Unpack[_Options]) -> Poses: ...

    @overload
    def predict(
        self,
        points: _Cloud,
        *,
        boxes: "str | os.PathLike | dict | Box | list | tuple | np.ndarray | Poses",
        **options: Unpack[_Options],
    ) -> Poses: ...

    def predict(
        self,
        points,
        *,
        boxes=None,
        find=False,
        sensor_origin=None,
        skeleton=None,
        progress=False,
        clips=None,
        point_times=None,
    ) -> PersonPose | Poses:
        """Predicts the pose of one person, of several people, or of all people in a scan.

        Args:
            points (array or list of arrays): a cloud (n, 3+) of x, y, z in meters, in any frame with z up; or a list of
                such clouds. Without `boxes` and `find`, each cloud shows one person and may include ground and
                clutter. Further columns are ignored; tables and record arrays are read by column name. A cloud with
                fewer than 5 distinct points yields a result without joints and with a warning. Arrays (a, b, 3) are
                rejected because they may be one scan or several people.
            boxes (any input of `read_boxes`): boxes of the people in `points`, which then is a whole scan. If the boxes
                state an up axis, it is used instead of z.
            find (bool): whether to detect people in `points`, which then is a whole scan, with the default settings
                of `lidarpose.detect`. For other settings, call `detect` and pass its result as `boxes`.
            sensor_origin (array or str): (3,) m, the sensor position in the frame of the points, or "unknown". None
                means 0, 0, 0 with `boxes` or `find`, and unknown otherwise.
            skeleton (str or Skeleton): the skeleton of the result, see `in_skeleton`.
            progress (bool): whether to show a progress bar.
            clips (Clips): for networks that read clips: which clouds of a list are frames of the same person. By
                default each cloud is repeated to fill a clip.
            point_times (array, or list of arrays for a list of clouds): (n,) s from any zero, when each point was
                measured, for clouds of several scans, as in `lidarpose.predict`. A list may contain None.

        Returns:
            A `PersonPose` for one cloud; `Poses` for a list of clouds, or with `boxes` or `find`. `Poses` has the order
            of the clouds or boxes; detected people have the order of their scores, highest first.

        Raises:
            InputError: an array of unsupported shape or type, or options that exclude each other.
        """
        self.in_skeleton(skeleton)
        if clips is not None and getattr(self.backend, "frames", 1) == 1:
            raise InputError(f"clips are for networks that read clips, {self.model['name']} reads single frames")
        if find and boxes is not None:
            raise InputError("find is an option of the detection: omit it with boxes")
        if clips is not None and (find or boxes is not None):
            raise InputError("clips need a list of clouds, each of one person: omit clips with boxes or find")
        if boxes is not None or find:
            origin = np.zeros(3) if sensor_origin is None else as_origin(sensor_origin)
            input_boxes = None if boxes is None else read_boxes(boxes)
            up = "z" if input_boxes is None else input_boxes.up
            scan = Scan(points=np.zeros((0, 3)), boxes=input_boxes, origin=origin, up=up)
            scan = scan_of_array(scan, points, point_times)
            if find:
                from lidarpose.inference.detection import Search
                from lidarpose.inference.single_scan import search_alone

                scan = search_alone(scan, Search())
            return pose_scan(scan, self, skeleton=skeleton, progress=progress)
        origin = as_origin(sensor_origin)
        is_one = not is_many(points)
        clouds = [as_points(points)] if is_one else [as_points(cloud, f"points[{i}]") for i, cloud in enumerate(points)]
        clips = None if clips is None else clips.checked(len(clouds))
        times = times_of_clouds([points] if is_one else points, clouds, [point_times] if is_one else point_times)
        poses = self._predict_clouds(clouds, origin, skeleton, progress, clips, times)
        return poses.people[0] if is_one else poses

    def predict_clip(
        self,
        clouds: "Sequence[ArrayLike]",
        times: "Sequence[float] | np.ndarray | None" = None,
        sensor_origin: "np.ndarray | Sequence[float] | str | None" = None,
        skeleton: str | Skeleton | None = None,
        live: bool = False,
        progress: bool = False,
    ) -> Poses:
        """Predicts temporally smoothed poses of one person over a sequence of frames.

        Args:
            clouds: one cloud (n, 3+) m per frame, as in `predict`, all in the same fixed coordinate frame. An empty
                cloud is a frame in which the person was not seen; its joints are filled in within gaps of up to 2 s.
            times: (T,) s, strictly increasing. None means ten frames per second.
            sensor_origin: sensor position in the same frame, as in `predict`.
            skeleton: the skeleton of the result, see `in_skeleton`.
            live: whether to compute each pose from the current and earlier frames only, as with a running sensor.
            progress: whether to show a progress bar.

        Returns:
            `Poses` with one entry per frame, whose id is the index of the frame.

        Raises:
            InputError: as in `predict`, or times that are not strictly increasing seconds.
        """
        self.in_skeleton(skeleton)
        if not is_many(clouds) and getattr(clouds, "ndim", 0) != 3:
            raise InputError("predict_clip: expected a list of clouds, one per frame, got one cloud: use predict")
        seconds = clip_times(times, len(clouds))
        clips = Clips.of_run(len(clouds)) if len(clouds) and getattr(self.backend, "frames", 1) > 1 else None
        frame_clouds = [as_points(cloud, f"clouds[{i}]") for i, cloud in enumerate(clouds)]
        poses = self._predict_clouds(frame_clouds, as_origin(sensor_origin), skeleton, progress, clips)
        track = TrackPoses.of_poses(seconds, [person.pose for person in poses], poses.skeleton)
        is_swapped: np.ndarray = np.zeros(len(track), bool)
        if live:
            steady_poses = filter_track(track)
        else:
            steady_track = smooth(track)
            assert steady_track.swapped is not None
            steady_poses, is_swapped = steady_track.poses(), steady_track.swapped
        frames = [
            replace(person, id=i, pose=_with_frame_values(person, pose, swap), warnings=_steady_warnings(person, pose))
            for i, (person, pose, swap) in enumerate(zip(poses, steady_poses, is_swapped.tolist(), strict=True))
        ]
        return replace(poses, people=tuple(frames))

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

    def _predict_clouds(self, clouds, origin, skeleton, progress, clips, times=None) -> Poses:
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


def _with_frame_values(person: PersonPose, pose: Pose | None, is_swapped: bool) -> Pose | None:
    """The smoothed pose with the values of its frame that are not smoothed: the per-person probabilities and which
    joints are in range. Filled-in frames have none. is_swapped: whether left and right were exchanged."""
    if pose is None or person.pose is None:
        return pose
    in_range = person.pose.in_range
    if in_range is not None and is_swapped:
        in_range = in_range[list(pose.skeleton.flip)]
    return replace(pose, in_range=in_range, **{name: getattr(person.pose, name) for name in PER_PERSON})


def _steady_warnings(person: PersonPose, pose: Pose | None) -> tuple[str, ...]:
    """The warnings of a clip's frame after smoothing."""
    if person.pose is not None or pose is None:
        return person.warnings
    return ("filled in from other frames: the person was not seen in this one",)
