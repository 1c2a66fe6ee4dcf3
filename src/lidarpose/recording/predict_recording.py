"""`predict_recording`: the people of every frame of a folder or recording, posed and, if asked, joined over time."""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import Any, TypedDict, Unpack

import numpy as np

from lidarpose.errors import InputError
from lidarpose.geometry import rotation_from_up, up_text
from lidarpose.inference.detection import DetectedScan, detect_places, least_score, other_up_axis, search_options
from lidarpose.inference.inputs import as_origin, as_points, only_returns
from lidarpose.inference.predict_scan import check_choice, check_up, is_wide, predict_scan, predictor_of
from lidarpose.inference.predictor import Predictor
from lidarpose.inference.results import Poses
from lidarpose.inference.scan import Scan
from lidarpose.io.sources import DamagedFrame, Frame, FrameSource, open_source
from lidarpose.io.sources.frame import DEFAULT_RATE
from lidarpose.models import DEFAULT
from lidarpose.recording.frame_boxes import FrameBoxes
from lidarpose.recording.known_people import KnownPeople
from lidarpose.skeleton import Skeleton

SCHEMA = "lidarpose.recording/1"


@dataclass(frozen=True, kw_only=True, eq=False)
class FramePoses:
    """The people of one frame.

    Args:
        index: of the frame, see `Frame`.
        id: of the frame.
        time: of the frame, s.
        poses: in the sensor's frame; with tracks the people's ids are those of their tracks. Nobody in a damaged frame.
        T_world_sensor: (4, 4) m, None where it is not known.
        error: why the frame could not be read or posed, None for a good one.
    """

    index: int
    id: str
    time: float | None
    poses: Poses
    T_world_sensor: np.ndarray | None = None
    is_tracked: bool = False
    error: str | None = None

    def to_dict(self) -> dict[str, Any]:
        """A line of NAME.poses.jsonl: the keys of poses.json but for its times, and those of the frame."""
        document = self.poses.to_dict()
        del document["timing_ms"]
        people = []
        for person, entry in zip(self.poses, document.pop("people"), strict=True):
            people.append(entry | {"track": person.id if self.is_tracked else None, "filled": False})
        T_world_sensor = None if self.T_world_sensor is None else self.T_world_sensor.tolist()
        frame_entry = {
            "schema": SCHEMA,
            "frame": self.index,
            "id": self.id,
            "time": self.time,
            "T_world_sensor": T_world_sensor,
        }
        return document | frame_entry | {"people": people, "error": self.error}


class PosingOptions(TypedDict, total=False):
    """How the frames of a recording are posed, see `FramePredictor`."""

    boxes: "str | os.PathLike | Mapping[Any, Any] | None"
    calib: str | os.PathLike | None
    crop: bool
    find: bool
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
    """Poses of the people of each frame of a recording, one frame after the other.

    Sources are read in another thread, one frame ahead; who leaves early does not wait for it.

    Args:
        source: files, folders or recordings as `open_source` takes them, with columns, topic, meta, rate, start, end
            and every; or a source, or any iterable of `Frame`, as of a running sensor, whose arrays may be used again
            for the next frame.
        **posing: how frames are posed: boxes, calib, crop, find, min_score, max_range, max_people, background,
            sensor_origin, skeleton, up, track, live and model. boxes as of `FrameBoxes`; track: people are joined over
            time, and people known need no verification; live: with tracks, whose poses are made steady by the past
            alone; the others as in `predict`. Whether the frames are crops of one person is decided by the first one.

    Yields:
        `FramePoses`, of damaged frames too.

    Raises:
        InputError: options that contradict each other, a source that cannot be read at all, and after the last frame
            boxes of which no frame had any.
    """
    if unknown := set(posing) - set(PosingOptions.__annotations__):
        raise TypeError(f"predict_recording() got an unexpected keyword argument {min(unknown)!r}")
    choice: dict[str, Any] = {"rate": rate, "start": start, "end": end, "every": every}
    paths, frames = _frames_among(source)
    name = getattr(source, "name", None)
    if frames is None:
        opened = open_source(paths, columns=columns, topic=topic, meta=meta, **choice)
        name, frames = opened.name, opened.frames()
    elif options := [option for option, value in choice.items() if value != (1 if option == "every" else None)]:
        raise InputError(f"{options[0]} is for paths, got frames: give it to open_source, or leave frames out yourself")
    predictor = FramePredictor(columns=columns, topic=topic, meta=meta, name=name, **posing)
    return predictor.predict_all(frames)


def _frames_among(source: Any) -> tuple[Any, Iterator[Frame | DamagedFrame] | None]:
    """The paths that are given as a source, or the frames of one or of an iterable."""
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


class FramePredictor:
    """Poses the frames of a recording in their order, and knows what the frames before said of people.

    Args:
        name: of the recording, for reports.
        others: as of `predict_recording`.
    """

    def __init__(
        self,
        *,
        boxes: "str | os.PathLike | Mapping[Any, Any] | None" = None,
        calib: str | os.PathLike | None = None,
        crop: bool = False,
        find: bool = False,
        min_score: float | None = None,
        max_range: float | None = None,
        max_people: int | None = None,
        background: "str | os.PathLike | Sequence | np.ndarray | None" = None,
        sensor_origin: "np.ndarray | Sequence[float] | str | None" = None,
        skeleton: str | Skeleton | None = None,
        up: str | Sequence[float] | None = "z",
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
        check_choice(boxes, crop, is_searched, calib)
        up = "z" if up is None else up
        rotation_from_up(up)
        self.up, self.name, self.skeleton = up_text(up), name, skeleton
        self.boxes = None if boxes is None else FrameBoxes(boxes, calib=calib)
        self._origin = sensor_origin if sensor_origin is None else (as_origin(sensor_origin),)
        # whether the frames are crops: None before the first one
        self._is_crop = True if crop else False if is_searched or boxes is not None else None
        # whether any frame was searched
        self._was_searched = False
        self._search = search_options(*search_arguments, columns, topic, meta)
        self._model = model
        self._loaded: Predictor | None = None
        self.live, self.people = live, None
        if track or live:
            # boxes that are given are all people
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
        """The skeleton of the poses."""
        return self.predictor.in_skeleton(self.skeleton)

    def check_boxes(self, last: tuple[int, str] | None) -> None:
        """Raises InputError where no frame up to the last one, index and id, had boxes, though some were given."""
        if self.boxes is not None and last is not None:
            self.boxes.check_used(last[1])

    def predict_all(self, frames: Iterator[Frame | DamagedFrame]) -> Iterator[FramePoses]:
        """The people of the next frames; while one is posed the one after is read and searched."""

        def prepare() -> tuple[Frame | DamagedFrame, Scan | DetectedScan | InputError] | None:
            frame = next(frames, None)
            return None if frame is None else (frame, self._prepared(frame))

        last = None
        pool = ThreadPoolExecutor(1)
        try:
            future = pool.submit(prepare)
            while (prepared_frame := future.result()) is not None:
                future = pool.submit(prepare)
                last = prepared_frame[0].index, prepared_frame[0].id
                yield self._predicted(*prepared_frame)
        finally:
            # the next frame of a running sensor may never come
            pool.shutdown(wait=False, cancel_futures=True)
        self.check_boxes(last)

    def predict(self, frame: Frame | DamagedFrame) -> FramePoses:
        """The people of the next frame."""
        return self._predicted(frame, self._prepared(frame))

    def _prepared(self, frame: Frame | DamagedFrame) -> Scan | DetectedScan | InputError:
        """What depends on no other frame: the scan, searched where people are searched for; or what is wrong."""
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
                if not len(poses) and (hint := other_up_axis(prepared_scan, self._search)):
                    poses = replace(poses, warnings=(*poses.warnings, hint))
            if people is not None:
                poses = people.update(time, scan, poses, T_fixed_sensor)
        except InputError as error:
            return frame_poses(poses=no_poses, error=str(error))
        return frame_poses(poses=replace(poses, source=self.name))

    def _scan(self, frame: Frame) -> Scan:
        # a copy: results keep points, and a driver may fill the same array with the next frame
        points, notes = only_returns(as_points(frame.points))
        scan = Scan(points=points, up=self.up)
        if self.boxes is not None:
            boxes = self.boxes.of(frame)
            if boxes is None:
                notes += ["no boxes are given for this frame"]
            else:
                check_up(boxes, self.up)
            scan = replace(scan, boxes=boxes or [])
        elif self._is_crop is None and len(points):
            self._is_crop = not is_wide(scan)
        if self._origin is not None:
            (origin,) = self._origin
        else:
            origin = np.zeros(3) if frame.origin is None and not self._is_crop else frame.origin
        return replace(scan, origin=origin, warnings=(*frame.warnings, *notes))

    def state(self) -> dict[str, Any]:
        """What the frames so far said, as JSON holds it."""
        people = None if self.people is None else self.people.state()
        boxes_used = self.boxes is not None and self.boxes.was_used
        search_state = {"is_crop": self._is_crop, "was_searched": self._was_searched}
        return search_state | {"boxes_used": boxes_used, "people": people}

    def restore(self, state: dict[str, Any]) -> None:
        """Goes on where the predictor whose `state()` this is would."""
        self._is_crop, self._was_searched = state["is_crop"], state["was_searched"]
        if self.boxes is not None:
            self.boxes.was_used = state["boxes_used"]
        if self.people is not None:
            self.people.restore(state["people"])
