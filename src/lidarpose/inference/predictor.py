"""`load` a network and `predict` poses: of files, and of clouds of any number type, one or many, empty ones too."""

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy as np

from lidarpose.errors import InputError, check_int, check_name, missing_extra
from lidarpose.geometry import UP_AXES, rotation_from_up
from lidarpose.inference.backend import Backend, OnnxBackend, estimates, exported_beside
from lidarpose.inference.checks import (
    UPSIDE_DOWN,
    company_warning,
    looks_unsure,
    oversize_warning,
    unit_warning,
    upside_down_warning,
)
from lidarpose.inference.inputs import (
    Clips,
    as_origin,
    as_points,
    candidates,
    clean,
    clip_times,
    is_few,
    only_returns,
)
from lidarpose.inference.results import PersonPose, Poses, first_names
from lidarpose.inference.scan import Scan, pose_scan, read_scan, up_text
from lidarpose.inference.tta import TTATransform, apply, average, invert, tta_transforms
from lidarpose.io.boxes import read_boxes
from lidarpose.io.files import file_error
from lidarpose.models import BUNDLED, DEFAULT, weights_path
from lidarpose.models.checkpoint import read_header
from lidarpose.models.decode import decoder
from lidarpose.models.voxelize import WINDOW
from lidarpose.progress import Progress
from lidarpose.sample import MIN_POINTS, PER_JOINT, PER_PERSON, Box, Pose, center_of
from lidarpose.skeleton import SMPL24, Skeleton
from lidarpose.skeleton import skeleton as skeleton_of
from lidarpose.tracking.clip import TrackPoses
from lidarpose.tracking.live import follow
from lidarpose.tracking.smoothing import smooth

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from lidarpose.inference.detection import KnownPlaces, Places, Search

BACKENDS = ("onnx", "torch")
# default number of test-time augmentation passes
TTA = 4
# passes: the second is centered on the pelvis that the first estimated
PASSES = 2
# a file of less than this across is taken for a crop, m
CROP_SIZE = 4.0
# to which the center of the second pass is rounded, m: backends differ by less than a micrometer, which must not move a
# point to another voxel
_CENTER_DECIMALS = 2
_CENTER_STEP = 10**-_CENTER_DECIMALS


def load(
    weights: str | os.PathLike = DEFAULT,
    *,
    device: str = "cpu",
    backend: str | None = None,
    decode: str = "window",
    compile: bool = False,
    threads: int | None = None,
    tta: int = TTA,
) -> "Predictor":
    """The bundled network, or the checkpoint or exported file at a path, ready to predict.

    backend: "onnx" (ONNX Runtime, on the CPU) or "torch"; None takes onnx for bundled weights and .onnx files, torch
    for other paths and devices. decode: how heatmaps are read, "window" (the mean about the mode), "argmax" or "dark"
    (the released DAPT code's); where two peaks are equally high, rounding decides. compile: by `torch.compile`, backend
    torch only. threads: of ONNX Runtime, None for all processors; backend onnx only. tta: test-time augmentation, the
    number of transforms of each person (1 to 8), averaged. A person costs one pass to center the cloud and one for each
    transform, so 1 takes two passes, 4 take five. Raises InputError for an unknown name, a file that is no checkpoint,
    or a device that is not there; MissingExtra where torch is needed and not installed.
    """
    decoder(decode)
    tta_transforms(tta)
    if threads is not None:
        threads = check_int("threads", threads, least=1)
    if backend is not None:
        check_name("backend", backend, BACKENDS)
    path = weights_path(weights)
    bundled = os.fspath(weights) in BUNDLED
    exported = path.suffix.lower() == ".onnx"
    if backend is None:
        elsewhere = device != "cpu" or compile
        backend = "onnx" if exported or bundled and not elsewhere else "torch"
    if backend == "torch":
        if exported:
            raise file_error(path, "torch runs a .safetensors file, not .onnx: name the one that it was made from")
        if threads is not None:
            raise InputError("threads are of the backend onnx: for torch call torch.set_num_threads")
        chosen = _torch_backend(path, device, compile)
    else:
        if device != "cpu" or compile:
            asked = "torch.compile" if compile else f"device {device!r}"
            raise InputError(f"{asked} needs the backend torch and a .safetensors file, got the backend onnx")
        if bundled:
            path = path.with_suffix(".onnx")
        chosen = OnnxBackend(path, threads=threads) if bundled or exported else exported_beside(path, threads=threads)
    return Predictor(chosen, name=path.stem, decode=decode, tta=tta)


def predict(
    path: str | os.PathLike,
    *,
    boxes: "str | os.PathLike | dict | Box | list | tuple | np.ndarray | None" = None,
    calib: str | os.PathLike | None = None,
    crop: bool = False,
    find: bool = False,
    min_score: float | None = None,
    max_range: float | None = None,
    max_people: int | None = None,
    background: "str | os.PathLike | Sequence | np.ndarray | None" = None,
    sensor_origin: tuple[float, float, float] | str | None = None,
    skeleton: str | None = None,
    up: str | Sequence[float] = "z",
    columns: int | None = None,
    model: "Predictor | str | os.PathLike | Callable[[], Predictor]" = DEFAULT,
    progress: bool = False,
) -> Poses:
    """Poses of the people in a point file, in the file's own frame.

    boxes: whatever `read_boxes` takes (a JSON file, a KITTI label, rows, a `Box` or several), their length and width
    level, their height and yaw along and about the up axis (the file's z where `up` is a direction); calib: of a KITTI
    label, None for `../calib/N.txt` beside it; crop: the file is one person already; find: people are searched for,
    with min_score, max_range (None: 40 m), max_people and background as in `detect`. With neither, a file of less than
    4 m across is taken as a crop, and in any other people are searched for. sensor_origin: (x, y, z) m in the file's
    frame, or "unknown"; None means unknown for a crop and 0, 0, 0 else. skeleton: a name, or None for smpl24, or for
    the network's own where it has other joints. up: the file's up axis, "z", "y" or "x", with a minus where it points
    down ("-y": cameras), or for a sensor mounted askew the direction that is up, (x, y, z) or "x,y,z" in the file's
    frame. columns: values a row of a .bin; model: a predictor, what `load` takes (with its defaults), or a function
    that gives the predictor when it is needed. Raises InputError, one line that says what to do.
    """
    options = (min_score, max_range, max_people, background)
    check_choice(boxes, crop, find or any(option is not None for option in options))
    _check_path(path)
    started = time.perf_counter()
    rotation_from_up(up)
    scan = Scan(
        points=np.zeros((0, 3)),
        boxes=None if boxes is None else read_boxes(boxes, calib=calib),
        origin=as_origin(sensor_origin),
        up=up_text(up),
    )
    scan = read_scan(scan, path, columns)
    find = find or boxes is None and not crop and is_wide(scan)
    if sensor_origin is None and (find or boxes is not None):
        scan = replace(scan, origin=np.zeros(3))
    read = time.perf_counter()
    search = None
    if find:
        from lidarpose.inference.detection import search_options

        search = search_options(*options, columns)
    # loaded once the input has proved readable
    _, poses = predict_scan(scan, lambda: predictor_of(model), search=search, skeleton=skeleton, progress=progress)
    return replace(poses, timing_ms={"read": (read - started) * 1e3} | poses.timing_ms)


def predictor_of(model: "Predictor | str | os.PathLike | Callable[[], Predictor]") -> "Predictor":
    """What `predict` takes as its model, ready to use."""
    return model if isinstance(model, Predictor) else model() if callable(model) else load(model)


def predict_scan(
    scan: "Scan | Places",
    model: "Callable[[], Predictor]",
    *,
    search: "Search | None" = None,
    known: "KnownPlaces | None" = None,
    skeleton: str | None = None,
    progress: bool = False,
) -> tuple[Scan, Poses]:
    """The steps of one scan: people are searched for where `search` is given, else they are the scan's boxes or its
    crop; then everybody is posed.

    Args:
        scan: or one in which people were detected already.
        model: loads the network, once people were searched for.
        known: as of `find_people`.

    Returns:
        The scan as it was searched, and the poses, whose `timing_ms` has "find", "load", "crop" and "predict".
    """
    started = time.perf_counter()
    times = {}
    if search is not None:
        from lidarpose.inference.detection import detect_places, verify_people

        places = detect_places(scan, search) if isinstance(scan, Scan) else scan
        scan = verify_people(places, search, known)
        times["find"] = time.perf_counter() - started
    assert isinstance(scan, Scan)
    searched = time.perf_counter()
    predictor = model()
    times["load"] = time.perf_counter() - searched
    poses = pose_scan(scan, predictor, skeleton=skeleton, progress=progress)
    return scan, replace(poses, timing_ms={name: seconds * 1e3 for name, seconds in times.items()} | poses.timing_ms)


def is_wide(scan: Scan) -> bool:
    """Whether the scan is larger than a crop of one person."""
    # a map of 10^8 points is not turned for nothing
    upright = scan.points if scan.up in UP_AXES else scan.clouds()[0]
    return bool(np.ptp(upright, axis=0).max() >= CROP_SIZE)


def check_choice(boxes: object, crop: bool, searched: bool) -> None:
    """Raises InputError where it is said in two ways who is in the file."""
    if boxes is not None and crop:
        raise InputError("expected boxes or a crop, got both: a crop is one person already, so leave the boxes away")
    if searched and (boxes is not None or crop):
        options = "find, min score, range, max people and background"
        raise InputError(f"{options} are for people who are searched for: leave them away with boxes or a crop")


def _check_path(path: object) -> None:
    if not isinstance(path, str | os.PathLike):
        kind = type(path).__name__
        raise InputError(
            f"expected the path of a point file, got {kind}: for points use lidarpose.load().predict(points)"
        )


def _torch_backend(path: Path, device: str, compile: bool) -> Backend:
    # a bad file is an error even where torch is not installed
    read_header(path)
    try:
        from lidarpose.inference.torch_backend import torch_backend
    except ModuleNotFoundError as error:
        raise missing_extra(error, f"running {path.name} with torch") from None
    return torch_backend(path, device=device, compile=compile)


class Predictor:
    """A network ready to use. `predict` checks its input; `outputs` is one plain pass. model: as in results."""

    def __init__(self, backend: Backend, *, name: str, decode: str = "window", tta: int = 1):
        self.backend = backend
        self.header = backend.header
        self.skeleton = backend.header.skeleton
        self.model: dict[str, str | int] = {
            "name": name,
            "version": self.header.version,
            "backend": backend.name,
            "decode": decode,
        }
        if tta > 1:
            self.model["tta"] = tta
        self._decoder, self._tta, self._passes = decoder(decode), tta_transforms(tta), PASSES
        # the middle of a person: the pelvis, or half way between the hips where the skeleton has none
        root = ("pelvis",) if "pelvis" in self.skeleton.joints else ("left_hip", "right_hip")
        self._root = [self.skeleton.index(joint) for joint in root]

    def in_skeleton(self, name: str | None) -> Skeleton:
        """A skeleton by name; None is smpl24 where the network has its joints, else the network's own.

        Raises InputError for an unknown name, or one of a joint that the network lacks.
        """
        own = self.skeleton
        if name is None:
            return SMPL24 if set(SMPL24.joints) <= set(own.joints) else own
        wanted = skeleton_of(name)
        own.map_to(wanted)
        return wanted

    def __repr__(self) -> str:
        return f"Predictor({self.model['name']!r}, {self.skeleton.name}, {self.backend.name}, tta={len(self._tta)})"

    @overload
    def predict(  # type: ignore[overload-overlap]
        self,
        points: "Sequence[ArrayLike]",
        *,
        boxes: None = None,
        sensor_origin: "np.ndarray | Sequence[float] | str | None" = None,
        skeleton: str | None = None,
        progress: bool = False,
        clips: Clips | None = None,
    ) -> Poses: ...

    @overload
    def predict(
        self,
        points: "ArrayLike",
        *,
        boxes: None = None,
        sensor_origin: "np.ndarray | Sequence[float] | str | None" = None,
        skeleton: str | None = None,
        progress: bool = False,
    ) -> PersonPose: ...

    @overload
    def predict(
        self,
        points: "ArrayLike",
        *,
        find: Literal[True],
        sensor_origin: "np.ndarray | Sequence[float] | str | None" = None,
        skeleton: str | None = None,
        progress: bool = False,
    ) -> Poses: ...

    @overload
    def predict(
        self,
        points: "ArrayLike",
        *,
        boxes: "str | os.PathLike | dict | Box | list | tuple | np.ndarray",
        sensor_origin: "np.ndarray | Sequence[float] | str | None" = None,
        skeleton: str | None = None,
        progress: bool = False,
    ) -> Poses: ...

    def predict(
        self, points, *, boxes=None, find=False, sensor_origin=None, skeleton=None, progress=False, clips=None
    ) -> PersonPose | Poses:
        """One cloud (n, 3+) -> `PersonPose`; a list of clouds, or one with boxes or find -> `Poses`, in their order.

        points: x, y, z in meters, z up, any frame, each cloud one person, ground and clutter allowed; more columns are
        ignored, those of tables and records are taken by name. boxes: the people of a whole scan, as in
        `lidarpose.predict`; find: they are searched for, as by `lidarpose.detect`, whose result is for `boxes` where
        anything about the search is to be chosen. sensor_origin (3,) m: where the sensor stood in that frame, or
        "unknown"; None means 0, 0, 0 with boxes and find, and unknown without. skeleton: see `in_skeleton`. clips:
        which of a list's clouds are frames of one person, for networks of clips, by default none: a cloud then fills a
        clip. A cloud of under 5 different points gets a result without joints and a warning. Raises InputError for
        arrays of another shape or type.
        """
        wanted = self.in_skeleton(skeleton)
        if clips is not None and getattr(self.backend, "frames", 1) == 1:
            raise InputError(f"clips are for networks of clips, {self.model['name']} reads single frames")
        if find and boxes is not None:
            raise InputError("find is for people who are searched for: leave it away with boxes")
        if boxes is not None or find:
            cloud, notes = only_returns(as_points(points))
            origin = np.zeros(3) if sensor_origin is None else as_origin(sensor_origin)
            given = None if boxes is None else read_boxes(boxes)
            scan = Scan(points=cloud, boxes=given, origin=origin, warnings=tuple(notes))
            if find:
                from lidarpose.inference.detection import Search, find_people

                scan = find_people(scan, Search())
            return pose_scan(scan, self, skeleton=skeleton, progress=progress)
        origin = as_origin(sensor_origin)
        if not _is_many(points):
            return self._people([as_points(points)], origin, wanted, False)[0]
        clouds = [as_points(cloud, f"points[{i}]") for i, cloud in enumerate(points)]
        people = self._people(clouds, origin, wanted, progress, clips)
        return Poses(people=tuple(people), skeleton=wanted, model=self.model)

    def predict_clip(
        self,
        clouds: "Sequence[ArrayLike]",
        times: "Sequence[float] | np.ndarray | None" = None,
        sensor_origin: "np.ndarray | Sequence[float] | str | None" = None,
        skeleton: str | None = None,
        live: bool = False,
        progress: bool = False,
    ) -> Poses:
        """One person through frames: steady poses, as many as clouds, whose ids are the frames' numbers.

        clouds: (n, 3+) m each, of one person in a frame of coordinates that stays where it is, as in `predict`; one
        without points is a frame in which the person was not seen, whose joints are filled in within gaps of up to 2 s.
        times (T,) s, each later than the one before; None: ten frames a second. live: each pose from its own frame and
        those before only, as it would come from a running sensor. Raises InputError as `predict` does, and for other
        times.
        """
        wanted = self.in_skeleton(skeleton)
        if not _is_many(clouds):
            raise InputError("predict_clip: expected a list of clouds, one a frame, got one cloud: use predict")
        seconds = clip_times(times, len(clouds))
        clips = Clips.of_run(len(clouds)) if len(clouds) and getattr(self.backend, "frames", 1) > 1 else None
        each = [as_points(cloud, f"clouds[{i}]") for i, cloud in enumerate(clouds)]
        people = self._people(each, as_origin(sensor_origin), wanted, progress, clips)
        track = TrackPoses.of_poses(seconds, [person.pose for person in people], wanted)
        steady = follow(track) if live else smooth(track).poses()
        frames = [
            replace(person, id=i, pose=pose, warnings=_steady_warnings(person, pose))
            for i, (person, pose) in enumerate(zip(people, steady, strict=True))
        ]
        return Poses(people=tuple(frames), skeleton=wanted, model=self.model)

    def predict_about(
        self, clouds: Sequence[np.ndarray], centers: np.ndarray, origin: np.ndarray | None, skeleton: str | None = None
    ) -> Poses:
        """As `predict` of clouds (n, 3) m, each of one person alone whose pelvis is nearly known, centers (N, 3) m: the
        pass that would find it is spared."""
        wanted = self.in_skeleton(skeleton)
        people = self._people(list(clouds), origin, wanted, False, centers=centers)
        return Poses(people=tuple(people), skeleton=wanted, model=self.model)

    def _people(self, clouds, origin, wanted, progress, clips=None, centers=None) -> list[PersonPose]:
        cleaned = [clean(cloud) for cloud in clouds]
        usable = {}
        for i, (points, notes) in enumerate(cleaned):
            if is_few(points):
                points_of = "points" if len(points) < MIN_POINTS else "different points"
                notes.append(f"no pose: under {MIN_POINTS} {points_of}")
            else:
                usable[i] = points
        if centers is not None:
            rows = list(usable)
            about = self._all_poses(list(usable.values()), origin, progress, np.round(centers[rows], _CENTER_DECIMALS))
            best = {i: (pose, usable[i]) for i, pose in zip(rows, about, strict=True) if pose is not None}
        elif clips is None:
            best = self._best_poses(usable, origin, progress)
        else:
            best = self._clip_poses(usable, origin, clips.usable(np.isin(np.arange(len(clouds)), list(usable))))
        poses: list[Pose | None] = [None] * len(clouds)
        doubtful: list[int] = []
        for i in usable:
            points, notes = cleaned[i]
            unit = unit_warning(np.ptp(points, axis=0), what="the person")
            if i not in best:
                few = f"no pose: under {MIN_POINTS} points within {WINDOW:.0f} m of the person's middle"
                notes += filter(None, (unit, few))
                continue
            pose, part = best[i]
            poses[i] = wanted_pose = pose.to(wanted)
            notes += filter(None, (unit, company_warning(pose), _range_warning(wanted_pose)))
            if unit:
                continue
            if warning := oversize_warning(points, pose):
                notes.append(warning)
            elif looks_unsure(pose, part):
                doubtful.append(i)
        # a second look at the few whose pose looks unsure; where pelvises are known people were seen upright before
        doubtful = doubtful if centers is None else []
        flipped = [best[i][1] * UPSIDE_DOWN for i in doubtful]
        flipped_poses = self._all_poses(flipped, None if origin is None else origin * UPSIDE_DOWN, False)
        for i, turned in zip(doubtful, flipped_poses, strict=True):
            if warning := upside_down_warning(best[i][0], turned):
                cleaned[i][1].append(warning)
        return [
            PersonPose(pose=pose, skeleton=wanted, points=points, warnings=tuple(notes), model=self.model)
            for pose, (points, notes) in zip(poses, cleaned, strict=True)
        ]

    def _best_poses(
        self, clouds: dict[int, np.ndarray], origin: np.ndarray | None, progress: bool
    ) -> dict[int, tuple[Pose, np.ndarray]]:
        """By person the pose, where there is one, and what of the cloud (n, 3) m it is of: the surest candidate."""
        # a person's first candidate is the whole cloud
        parts = [(i, part) for i, points in clouds.items() for part in candidates(points)]
        best: dict[int, tuple[Pose, np.ndarray]] = {}
        for (i, part), pose in zip(parts, self._all_poses([part for _, part in parts], origin, progress), strict=True):
            if pose is not None and (i not in best or _surer(pose, best[i][0])):
                best[i] = pose, part
        return best

    def _clip_poses(
        self, clouds: dict[int, np.ndarray], origin: np.ndarray | None, clips: Clips
    ) -> dict[int, tuple[Pose, np.ndarray]]:
        """The same of frames that are read in clips."""
        best: dict[int, tuple[Pose, np.ndarray]] = {}
        for rows, clip in clips.batches(self.backend.batch):
            poses = self._poses([clouds[row] for row in rows], origin, clip)
            best |= {
                row: (pose, clouds[row]) for row, pose in zip(rows.tolist(), poses, strict=True) if pose is not None
            }
        return best

    def _all_poses(
        self, clouds: list[np.ndarray], origin: np.ndarray | None, progress: bool, centers: np.ndarray | None = None
    ) -> list[Pose | None]:
        """The pose of each cloud (n, 3) m in batches; centers (N, 3) m: as of `_poses`. People of like size go
        together: a batch costs as much as if all were its largest."""
        poses: list[Pose | None] = [None] * len(clouds)
        order = sorted(range(len(clouds)), key=lambda k: len(clouds[k]))
        with Progress(len(clouds), unit="clouds", shown=progress) as shown:
            for start in range(0, len(clouds), self.backend.batch):
                batch = order[start : start + self.backend.batch]
                about = None if centers is None else centers[batch]
                answers = self._poses([clouds[k] for k in batch], origin, centers=about)
                for k, pose in zip(batch, answers, strict=True):
                    poses[k] = pose
                shown.update(start + len(batch))
        return poses

    def _poses(
        self,
        clouds: list[np.ndarray],
        origin: np.ndarray | None,
        clip: Clips | None = None,
        centers: np.ndarray | None = None,
    ) -> list[Pose | None]:
        """The pose of each cloud (n, 3) m, None where too little of it is near its middle. clip: of frames of clips;
        centers (N, 3) m: of the pelvises, where they need not be found."""
        passes = self._passes if centers is None else 1
        if centers is None:
            centers = np.stack([center_of(points) for points in clouds])
        for _ in range(passes - 1):
            root = self.outputs(clouds, centers, origin, clip).joints[:, self._root].mean(1)
            # an answer that is no number stays one
            centers = centers + np.round(np.clip(root, -WINDOW / 2, WINDOW / 2) / _CENTER_STEP) * _CENTER_STEP
        estimated = self._augmented(clouds, centers, origin, clip)
        poses: list[Pose | None] = []
        for k, points in enumerate(clouds):
            near = (np.abs(points - centers[k]) < WINDOW).all(1).sum()
            if near < MIN_POINTS or not np.isfinite(estimated.joints[k]).all():
                poses.append(None)
                continue
            values = {name: getattr(estimated, name) for name in (*PER_JOINT, *PER_PERSON)}
            of_person: dict[str, Any] = {name: value[k] for name, value in values.items() if value is not None}
            poses.append(replace(estimated, joints=estimated.joints[k] + centers[k], **of_person))
        return poses

    def outputs(
        self, clouds: list[np.ndarray], centers: np.ndarray, origin: np.ndarray | None, clip: Clips | None = None
    ) -> Pose:
        """What the network says of clouds (n, 3) m seen about centers (B, 3), from a sensor at origin (3,) or None;
        clip: of networks of clips, which of the clouds are frames of one person."""
        return self._transformed(TTATransform(), clouds, centers, origin, clip)

    def _augmented(
        self, clouds: list[np.ndarray], centers: np.ndarray, origin: np.ndarray | None, clip: Clips | None = None
    ) -> Pose:
        """The mean of what the network says under each transform."""
        return average([self._transformed(transform, clouds, centers, origin, clip) for transform in self._tta])

    def _transformed(
        self,
        transform: TTATransform,
        clouds: list[np.ndarray],
        centers: np.ndarray,
        origin: np.ndarray | None,
        clip: Clips | None = None,
    ) -> Pose:
        about, view = apply(transform, clouds, centers, origin)
        seen: dict[str, Any] = {}
        if clip is not None:
            seen["clip"] = clip.mapped(lambda around: apply(transform, around, centers, origin)[0])
        return invert(estimates(self.backend.run(about, view, **seen), self._decoder, self.skeleton), transform)


def _surer(pose: Pose, best: Pose) -> bool:
    """Of a network without confidence the first pose, that of the whole cloud, is kept."""
    if pose.confidence is None or best.confidence is None:
        return False
    return bool(pose.confidence.mean() > best.confidence.mean())


def _range_warning(pose: Pose) -> str | None:
    if pose.in_range is None or pose.in_range.all():
        return None
    names = [name for name, inside in zip(pose.skeleton.joints, pose.in_range, strict=True) if not inside]
    return f"at the end of the heatmap's range, so perhaps farther out than given: {first_names(names)}"


def _steady_warnings(person: PersonPose, pose: Pose | None) -> tuple[str, ...]:
    """What is to be said of a frame of a clip whose pose became another."""
    if person.pose is not None or pose is None:
        return person.warnings
    return ("filled in from other frames: the person was not seen in this one",)


def _is_many(points) -> bool:
    """A list of clouds, rather than one cloud, be it written as a list of rows."""
    if isinstance(points, list | tuple):
        return len(points) == 0 or not _is_row(points[0])
    return getattr(points, "ndim", 0) == 3


def _is_row(value) -> bool:
    """One point: a flat list or array of numbers. Anything ragged is none, and what is empty is a cloud."""
    if isinstance(value, list | tuple):
        flat = not any(isinstance(entry, list | tuple) or getattr(entry, "ndim", 0) for entry in value)
    else:
        # records are a cloud
        flat = getattr(value, "ndim", 0) == 1 and not getattr(getattr(value, "dtype", None), "names", None)
    return flat and len(value) > 0
