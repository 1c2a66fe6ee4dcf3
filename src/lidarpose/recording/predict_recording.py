"""`predict_recording`: poses of the people in each frame of a folder or recording, optionally tracked over time."""

import atexit
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from queue import SimpleQueue
from typing import Any, TypedDict, TypeVar, Unpack

import numpy as np

from lidarpose.errors import InputError
from lidarpose.geometry import rotation_from_up, up_text
from lidarpose.inference.detection import DetectedScan, detect_places, least_score, search_options
from lidarpose.inference.inputs import as_origin
from lidarpose.inference.predict_scan import SAME_AXIS, check_choice, check_up, is_whole, predict_scan, predictor_of
from lidarpose.inference.predictor import Predictor
from lidarpose.inference.results import Poses
from lidarpose.inference.scan import Scan, scan_of_array
from lidarpose.inference.single_scan import why_nobody
from lidarpose.io.sources import DamagedFrame, Frame, FrameSource, open_source
from lidarpose.io.sources.frame import DEFAULT_RATE
from lidarpose.models import DEFAULT
from lidarpose.recording.frame_boxes import FrameBoxes
from lidarpose.recording.known_people import KnownPeople
from lidarpose.skeleton import Skeleton

SCHEMA = "lidarpose.recording/1"
# s; maximum wait at the end of the program for the frame that is being read
_MAX_WAIT = 5.0
# points of a frame that decides whether the frames are crops of one person, and of a whole scan that decides after
# smaller crops: a crop may have a stray point
_ENOUGH, _WHOLE = 100, 1000
_Item = TypeVar("_Item")


@dataclass(frozen=True, kw_only=True, eq=False)
class FramePoses:
    """The poses of the people in one frame of a recording.

    Args:
        index: number of the frame, see `Frame`.
        id: name of the frame.
        time: time of the frame, s, None if unknown.
        poses: poses in the sensor frame. With tracking, the ids of people are those of their tracks. Empty for a
            damaged frame.
        T_world_sensor: (4, 4) m, the sensor pose, None if unknown.
        is_tracked: whether people are tracked over time.
        error: the reason why the frame could not be read or posed, None if there was no error.
    """

    index: int
    id: str
    time: float | None
    poses: Poses
    T_world_sensor: np.ndarray | None = None
    is_tracked: bool = False
    error: str | None = None

    def to_dict(self) -> dict[str, Any]:
        """A line of NAME.poses.jsonl: the keys of `Poses.to_dict` except "timing_ms", and those of the frame."""
        document = self.poses.to_dict()
        del document["timing_ms"]
        people = []
        for person, entry in zip(self.poses, document.pop("people"), strict=True):
            velocity = None if person.velocity is None else person.velocity.round(4).tolist()
            track = person.id if self.is_tracked else None
            people.append(entry | {"track": track, "velocity": velocity, "filled": False})
        T_world_sensor = None if self.T_world_sensor is None else self.T_world_sensor.tolist()
        origin = self.poses.origin
        frame_entry = {
            "schema": SCHEMA,
            "frame": self.index,
            "id": self.id,
            "time": self.time,
            "T_world_sensor": T_world_sensor,
            "sensor_origin": None if origin is None else np.asarray(origin, float).round(4).tolist(),
        }
        return document | frame_entry | {"people": people, "error": self.error}


class PosingOptions(TypedDict, total=False):
    """Options for posing the frames of a recording, see `predict_recording`."""

    boxes: "str | os.PathLike | Mapping[Any, Any] | None"
    calib: str | os.PathLike | None
    crop: bool
    find: bool | None
    min_score: float | None
    max_range: float | None
    max_people: int | None
    background: "str | os.PathLike | Sequence | np.ndarray | None"
    sensor_origin: "np.ndarray | Sequence[float] | str | None"
    skeleton: str | Skeleton | None
    up: str | Sequence[float] | None
    track: bool
    live: bool
    model: "Predictor | str | os.PathLike | Callable[[], Predictor]"


def predict_recording(
    source: "str | os.PathLike | Iterable[str | os.PathLike] | FrameSource | Iterable[Frame | DamagedFrame]",
    *,
    columns: int | None = None,
    topic: str | None = None,
    meta: str | os.PathLike | None = None,
    rate: float | None = None,
    start: float | None = None,
    end: float | None = None,
    every: int = 1,
    **posing: Unpack[PosingOptions],
) -> Iterator[FramePoses]:
    """Predicts the poses of the people in each frame of a recording, frame by frame.

    Frames are read and searched in another thread, one frame ahead. Stopping early does not wait for that thread.

    Args:
        source: paths of files, folders or recordings, see `open_source`; or a frame source; or any iterable of `Frame`,
            for example from a running sensor, which may reuse its arrays for the next frame.
        columns: number of values per row of .bin files, see `open_source`.
        topic: the topic or scene to read from a recording, see `open_source`.
        meta: JSON file of an Ouster sensor, see `open_source`.
        rate: frames per second for sources without times, or to override times in file names, see `open_source`. This
            and the next three options are for paths only.
        start: start of the part to read, in seconds from the first frame.
        end: end of the part to read, in seconds from the first frame.
        every: read only every n-th frame.
        **posing: options for posing. `boxes` takes a folder, a file or a mapping with the boxes of each frame, see
            `FrameBoxes`. `track=True` tracks people over time; known people are then not verified in each frame.
            `live=True` tracks people and smooths their poses using past frames only. `up=None` means what `boxes`
            state, else z. `calib`, `crop`, `find`, `min_score`, `max_range`, `max_people`, `background`,
            `sensor_origin`, `skeleton` and `model` are as in `predict`, except that the first frame of at least 100
            points decides whether all frames are crops of one person (smaller crops before a whole scan are posed as
            crops), and that a frame's own `origin` takes the place of `sensor_origin=None`.

    Yields:
        `FramePoses` of each frame, including damaged frames. The warnings of the first include those about the source,
        if it is given by paths.

    Raises:
        InputError: options that exclude each other, a source that cannot be read, or, after the last frame, `boxes` of
            which no frame had any.
    """
    if unknown := set(posing) - set(PosingOptions.__annotations__):
        raise TypeError(f"predict_recording() got an unexpected keyword argument {min(unknown)!r}")
    choice: dict[str, Any] = {"rate": rate, "start": start, "end": end, "every": every}
    reading: dict[str, Any] = {"columns": columns, "topic": topic, "meta": meta}
    paths, frames = _frames_among(source)
    name, opened = getattr(source, "name", None), None
    if frames is None:
        opened = open_source(paths, **reading, **choice)
        name, frames = opened.name, opened.frames()
    else:
        # scans of the background are read, too
        refused = choice if posing.get("background") is not None else choice | reading
        if options := [option for option, value in refused.items() if value != (1 if option == "every" else None)]:
            raise InputError(f"{options[0]} is for paths, got frames: give it to open_source, or filter the frames")
    predictor = FramePredictor(**reading, name=name, **posing)
    results = predictor.predict_all(frames)
    return results if opened is None else _with_warnings(results, opened)


def _with_warnings(results: Iterator[FramePoses], source: FrameSource) -> Iterator[FramePoses]:
    """The results, the first with the warnings about the source."""
    if (first := next(results, None)) is not None:
        poses = first.poses
        yield replace(first, poses=replace(poses, warnings=(*source.warnings, *poses.warnings)))
    yield from results


def _frames_among(source: Any) -> tuple[Any, Iterator[Frame | DamagedFrame] | None]:
    """Splits a source into paths, and frames if it is a frame source or an iterable of frames; the other one is
    None."""
    if hasattr(source, "frames") and hasattr(source, "name"):
        return None, source.frames()
    if isinstance(source, str | bytes | os.PathLike) or not isinstance(source, Iterable):
        return source, None
    items = iter(source)
    first = next(items, "")
    if isinstance(first, Frame | DamagedFrame):
        return None, chain([first], items)
    if not isinstance(first, str | os.PathLike):
        kind = type(first).__name__
        raise InputError(f"source: expected paths or frames, got {kind}: make a lidarpose.Frame of each scan")
    return [first, *items] if first else [], None


def _one_ahead(items: Iterator[_Item]) -> Iterator[_Item]:
    """The items, each made in another thread while the one before it is used."""
    requests: SimpleQueue[bool] = SimpleQueue()
    made: SimpleQueue[tuple[_Item | None, BaseException | None]] = SimpleQueue()

    def work() -> None:
        while requests.get():
            try:
                made.put((next(items, None), None))
            except BaseException as error:
                made.put((None, error))
        atexit.unregister(end)

    def end() -> None:
        requests.put(False)
        thread.join(_MAX_WAIT)

    # a daemon, since the next frame of a running sensor may never come; but a daemon in native code at the end of the
    # interpreter aborts the process, so the end waits a moment for it
    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    atexit.register(end)
    requests.put(True)
    try:
        while True:
            item, error = made.get()
            if error is not None:
                raise error
            if item is None:
                return
            requests.put(True)
            yield item
    finally:
        requests.put(False)


class FramePredictor:
    """Poses the frames of a recording in order, with the state carried from earlier frames.

    Args:
        name: name of the recording, for reports.
        others: as in `predict_recording`.
    """

    def __init__(
        self,
        *,
        boxes: "str | os.PathLike | Mapping[Any, Any] | None" = None,
        calib: str | os.PathLike | None = None,
        crop: bool = False,
        find: bool | None = None,
        min_score: float | None = None,
        max_range: float | None = None,
        max_people: int | None = None,
        background: "str | os.PathLike | Sequence | np.ndarray | None" = None,
        sensor_origin: "np.ndarray | Sequence[float] | str | None" = None,
        skeleton: str | Skeleton | None = None,
        up: str | Sequence[float] | None = None,
        columns: int | None = None,
        topic: str | None = None,
        meta: str | os.PathLike | None = None,
        track: bool = False,
        live: bool = False,
        model: "Predictor | str | os.PathLike | Callable[[], Predictor]" = DEFAULT,
        name: str | None = None,
    ):
        search_arguments = (min_score, max_range, max_people, background)
        is_searched = find or any(option is not None for option in search_arguments)
        check_choice(boxes, crop, is_searched, calib, find=find)
        self.boxes = None if boxes is None else FrameBoxes(boxes, calib=calib)
        # without `up`, boxes that state their up direction determine it: all along one axis, but each frame its own
        self._has_up = up is not None
        if up is None:
            up = "z" if self.boxes is None else self.boxes.up_axis()
        rotation_from_up(up)
        self.up, self.name, self.skeleton = up_text(up), name, skeleton
        self._origin = sensor_origin if sensor_origin is None else (as_origin(sensor_origin),)
        # whether the frames are crops, None until the first frame with points; and whether that is final
        is_crop = crop or (find is False and boxes is None)
        self._is_crop = True if is_crop else False if is_searched or boxes is not None else None
        self._is_decided = self._is_crop is not None
        # whether any frame was searched
        self._was_searched = False
        self._search = search_options(*search_arguments, columns, topic, meta, up=up if self._has_up else None)
        self._model = model
        self._loaded: Predictor | None = None
        self.live, self.people = live, None
        if track or live:
            # given boxes all count as people, whatever their score
            threshold = 0.0 if boxes is not None else least_score(self._search)
            self.people = KnownPeople(up=self.up, least_score=threshold, live=live)

    @property
    def is_tracked(self) -> bool:
        return self.people is not None

    @property
    def predictor(self) -> Predictor:
        if self._loaded is None:
            self._loaded = predictor_of(self._model)
        return self._loaded

    @property
    def wanted(self) -> Skeleton:
        """The skeleton of the predicted poses."""
        return self.predictor.in_skeleton(self.skeleton)

    def check_boxes(self, last: tuple[int, str] | None) -> None:
        """Raises InputError if boxes were given but no frame had any. last: index and id of the last frame."""
        if self.boxes is not None and last is not None:
            self.boxes.check_used(last[1])

    def predict_all(self, frames: Iterator[Frame | DamagedFrame]) -> Iterator[FramePoses]:
        """Poses the next frames. While one frame is posed, the following one is read and searched."""
        last = None
        for frame, scan in _one_ahead((frame, self._prepared(frame)) for frame in frames):
            last = frame.index, frame.id
            yield self._predicted(frame, scan)
        self.check_boxes(last)

    def _prepared(self, frame: Frame | DamagedFrame) -> Scan | DetectedScan | InputError:
        """The steps that do not depend on other frames: returns the scan, with detections if people are searched for,
        or the error."""
        if isinstance(frame, DamagedFrame):
            return InputError(frame.error)
        try:
            scan = self._scan(frame)
            return scan if self.boxes is not None or self._is_crop else detect_places(scan, self._search)
        except InputError as error:
            return error

    def _predicted(self, frame: Frame | DamagedFrame, prepared_scan: Scan | DetectedScan | InputError) -> FramePoses:
        no_poses = Poses(people=(), skeleton=self.wanted, model=self.predictor.model, source=self.name)
        frame_poses = partial(FramePoses, index=frame.index, id=frame.id, time=frame.time, is_tracked=self.is_tracked)
        if isinstance(frame, DamagedFrame):
            return frame_poses(poses=no_poses, error=frame.error)
        frame_poses.keywords["T_world_sensor"] = frame.T_world_sensor
        people, known_places = self.people, None
        T_fixed_sensor = np.eye(4) if people is None else people.fixed.from_sensor(frame.T_world_sensor)
        time = frame.index / DEFAULT_RATE if frame.time is None else frame.time
        try:
            if isinstance(prepared_scan, InputError):
                raise prepared_scan
            search = self._search if isinstance(prepared_scan, DetectedScan) else None
            if people is not None and search is not None:
                known_places = people.expected(time, T_fixed_sensor)
            scan, poses = predict_scan(
                prepared_scan, lambda: self.predictor, search=search, known=known_places, skeleton=self.skeleton
            )
            if isinstance(prepared_scan, DetectedScan) and not self._was_searched:
                self._was_searched = True
                if not len(poses):
                    poses = replace(poses, warnings=why_nobody(prepared_scan, self._search, poses.warnings))
            if people is not None:
                poses = people.update(time, scan, poses, T_fixed_sensor)
        except InputError as error:
            return frame_poses(poses=no_poses, error=str(error))
        return frame_poses(poses=replace(poses, source=self.name))

    def _scan(self, frame: Frame) -> Scan:
        # `scan_of_array` copies: results keep the points, and a driver may write the next frame into the same array
        scan = scan_of_array(Scan(points=np.zeros((0, 3)), up=self.up), frame.points, frame.point_times)
        points, notes = scan.points, list(scan.warnings)
        if self.boxes is not None:
            boxes = self.boxes.of(frame)
            if boxes is None:
                notes += ["no boxes are given for this frame"]
            elif self._has_up:
                check_up(boxes, self.up)
            else:
                check_up(boxes, self.up, most=SAME_AXIS)
                scan = replace(scan, up=boxes.up if boxes.has_up else self.up)
            scan = replace(scan, boxes=boxes or [])
        elif not self._is_decided and len(points):
            looks_whole = is_whole(scan)
            if not (self._is_crop and looks_whole and len(points) < _WHOLE):
                self._is_crop, self._is_decided = not looks_whole, len(points) >= _ENOUGH
        if self._origin is not None:
            (origin,) = self._origin
        else:
            is_unknown = self._is_crop or frame.is_origin_unknown
            origin = np.zeros(3) if frame.origin is None and not is_unknown else frame.origin
        return replace(scan, origin=origin, warnings=(*frame.warnings, *notes))

    def state(self) -> dict[str, Any]:
        """The state after the frames so far, as JSON values."""
        people = None if self.people is None else self.people.state()
        boxes_by = None if self.boxes is None else self.boxes.matched_by
        search_state = {"is_crop": self._is_crop, "is_decided": self._is_decided, "was_searched": self._was_searched}
        return search_state | {"boxes_by": boxes_by, "people": people}

    def restore(self, state: dict[str, Any]) -> None:
        """Resumes from the result of `state()`."""
        self._is_crop, self._was_searched = state["is_crop"], state["was_searched"]
        # states of earlier versions are final
        self._is_decided = state.get("is_decided", self._is_crop is not None)
        if self.boxes is not None:
            self.boxes.matched_by = state["boxes_by"]
        if self.people is not None:
            self.people.restore(state["people"])
