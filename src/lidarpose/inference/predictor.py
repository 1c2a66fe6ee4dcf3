"""`load` a network and predict the poses of one or many point clouds, of any number type; clouds may be empty."""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Protocol, TypedDict, Unpack, overload

import numpy as np

from lidarpose.errors import InputError, check_int, check_name, needs_extra
from lidarpose.inference.backend import Backend, OnnxBackend, bundled_backend, exported_beside
from lidarpose.inference.cloud_predictor import CloudPredictor
from lidarpose.inference.inputs import Clips, as_origin, as_points, clip_times, is_many, times_of_clouds
from lidarpose.inference.pose_scan import pose_scan
from lidarpose.inference.results import PersonPose, Poses
from lidarpose.inference.scan import Scan, scan_of_array
from lidarpose.inference.tta import tta_transforms
from lidarpose.io.boxes import read_boxes
from lidarpose.io.files import file_error
from lidarpose.models import BUNDLED, DEFAULT, weights_name, weights_path
from lidarpose.models.checkpoint import read_header
from lidarpose.models.decode import decoder
from lidarpose.sample import PER_PERSON, Box, Pose
from lidarpose.skeleton import Skeleton
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


class Predictor(CloudPredictor):
    """A loaded network that predicts poses; made by `load`.

    `predict` and `predict_clip` check and clean their input. `outputs` is a single forward pass without checks.

    Args:
        backend: runs the network.
        name: name of the weights, reported in the attribute `model` and in results.
        decode: heatmap decoder, see `load`.
        tta: number of test-time augmentation transforms, see `load`.
    """

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
        poses = self.predict_clouds(clouds, origin, skeleton, progress, clips=clips, times=times)
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
        poses = self.predict_clouds(frame_clouds, as_origin(sensor_origin), skeleton, progress, clips=clips)
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
