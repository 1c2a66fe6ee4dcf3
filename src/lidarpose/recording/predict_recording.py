"""`predict_recording`: the people of every frame of a folder or recording, posed and, if asked, joined over time.

Coordinates: the sensor's frame is that of a frame's points; the fixed frame is the world's where the sensor's poses are
known, else the sensor's with z up. Tracks live in the fixed frame.
"""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, cast

import numpy as np

from lidarpose.errors import InputError
from lidarpose.geometry import UP_AXES, rotation_from_up, transform_points
from lidarpose.inference.detection import KnownPlaces, Places, Search, detect_places, least_score, search_options
from lidarpose.inference.inputs import as_origin, only_returns
from lidarpose.inference.predictor import Predictor, check_choice, is_wide, predict_scan, predictor_of
from lidarpose.inference.results import PersonPose, Poses
from lidarpose.inference.scan import Scan
from lidarpose.io.sources import DamagedFrame, Frame, Source, open_source
from lidarpose.io.sources.frame import DEFAULT_RATE
from lidarpose.models import DEFAULT
from lidarpose.recording.frame_boxes import FrameBoxes
from lidarpose.sample import Box, Pose
from lidarpose.skeleton import Skeleton
from lidarpose.tracking.live import LiveFilter
from lidarpose.tracking.tracker import Tracker, TrackState

SCHEMA = "lidarpose.recording/1"
# a known person is verified anew after so many seconds, and a place that held nobody looked at: between the two, so
# that not all are due in one frame
_TRUSTED = (1.6, 2.4)
# who was not seen for longer, s, or may be farther off than this, m, is searched for like anybody else
_RECENT, _MOST_DEVIATION = 0.5, 0.35
# a detection within so many m, and standard deviations more, of where a track is expected may continue it
_NEAR, _NEAR_DEVIATIONS = 0.4, 3.0
# what is remembered of a person whom nobody sees, s
_FORGOTTEN = 10.0


@dataclass(frozen=True, kw_only=True, eq=False)
class FramePoses:
    """The people of one frame.

    Args:
        index, id, time: of the frame, see `Frame`.
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
        world = None if self.T_world_sensor is None else self.T_world_sensor.tolist()
        own = {"schema": SCHEMA, "frame": self.index, "id": self.id, "time": self.time, "T_world_sensor": world}
        return document | own | {"people": people, "error": self.error}


def predict_recording(
    source: "str | os.PathLike | Sequence[str | os.PathLike] | Source",
    *,
    boxes: "str | os.PathLike | Mapping[Any, Any] | None" = None,
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
    topic: str | None = None,
    rate: float | None = None,
    start: float | None = None,
    end: float | None = None,
    every: int = 1,
    track: bool = False,
    live: bool = False,
    model: "Predictor | str | os.PathLike | Callable[[], Predictor]" = DEFAULT,
) -> Iterator[FramePoses]:
    """Poses of the people of each frame of a recording, one frame after the other.

    Args:
        source: files, folders or recordings as `open_source` takes them, with columns, topic, rate, start, end and
            every; or a source.
        boxes: see `FrameBoxes`; with calib as in `predict`.
        crop, find, min_score, max_range, max_people, background, sensor_origin, skeleton, up, model: as in `predict`.
            Whether the frames are crops of one person is decided by the first one.
        track: people are joined over time, and people known need no verification.
        live: with tracks, whose poses are made steady by the past alone.

    Yields:
        `FramePoses`, of damaged frames too.

    Raises:
        InputError: options that contradict each other, or a source that cannot be read at all.
    """
    if isinstance(source, str | os.PathLike) or isinstance(source, Sequence):
        source = open_source(source, columns=columns, topic=topic, rate=rate, start=start, end=end, every=every)
    steps = FramePredictor(
        boxes=boxes,
        calib=calib,
        crop=crop,
        find=find,
        search=(min_score, max_range, max_people, background),
        sensor_origin=sensor_origin,
        skeleton=skeleton,
        up=up,
        columns=columns,
        track=track,
        live=live,
        model=model,
        name=source.name,
    )
    return steps.predict_all(source.frames())


class FramePredictor:
    """Poses the frames of a recording in their order, and knows what the frames before said of people.

    Args:
        search: (min_score, max_range, max_people, background) as in `predict`.
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
        search: tuple[Any, Any, Any, Any] = (None, None, None, None),
        sensor_origin: tuple[float, float, float] | str | None = None,
        skeleton: str | None = None,
        up: str | Sequence[float] = "z",
        columns: int | None = None,
        track: bool = False,
        live: bool = False,
        model: "Predictor | str | os.PathLike | Callable[[], Predictor]" = DEFAULT,
        name: str | None = None,
    ):
        is_searched = find or any(option is not None for option in search)
        check_choice(boxes, crop, is_searched)
        rotation_from_up(up)
        self.up = up if isinstance(up, str) else ",".join(repr(float(value)) for value in up)
        self.name, self.skeleton, self.is_tracked, self.live = name, skeleton, track or live, live
        self.boxes = None if boxes is None else FrameBoxes(boxes, calib=calib)
        self._origin = sensor_origin if sensor_origin is None else (as_origin(sensor_origin),)
        # whether the frames are crops: None until the first one tells
        self._is_crop = True if crop else False if is_searched or boxes is not None else None
        self._search: Search = search_options(*search, columns)
        # boxes that are given are all people
        self._least_score = 0.0 if boxes is not None else least_score(self._search)
        self._model = model
        self._loaded: Predictor | None = None
        # what the frames before said
        self._tracker = Tracker()
        self._T_world_sensor: np.ndarray | None = None
        self._people: dict[int, _Person] = {}
        self._rejected = np.zeros((0, 4))
        self._filters: dict[int, tuple[float, LiveFilter]] = {}

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

        def prepare() -> tuple[Frame | DamagedFrame, Scan | Places | InputError] | None:
            frame = next(frames, None)
            return None if frame is None else (frame, self._prepared(frame))

        with ThreadPoolExecutor(1) as pool:
            pending = pool.submit(prepare)
            while (ready := pending.result()) is not None:
                pending = pool.submit(prepare)
                yield self._predicted(*ready)

    def predict(self, frame: Frame | DamagedFrame) -> FramePoses:
        """The people of the next frame."""
        return self._predicted(frame, self._prepared(frame))

    def _prepared(self, frame: Frame | DamagedFrame) -> Scan | Places | InputError:
        """What depends on no other frame: the scan, searched where people are searched for; or what is wrong."""
        if isinstance(frame, DamagedFrame):
            return InputError(frame.error)
        try:
            scan = self._scan(frame)
            return scan if self.boxes is not None or self._is_crop else detect_places(scan, self._search)
        except InputError as error:
            return error

    def _predicted(self, frame: Frame | DamagedFrame, prepared: Scan | Places | InputError) -> FramePoses:
        nobody = Poses(people=(), skeleton=self.wanted, model=self.predictor.model, source=self.name)
        of_frame = partial(FramePoses, index=frame.index, id=frame.id, time=frame.time, is_tracked=self.is_tracked)
        if isinstance(frame, DamagedFrame):
            return of_frame(poses=nobody, error=frame.error)
        T_fixed_sensor = self._to_fixed(frame.T_world_sensor)
        time = frame.index / DEFAULT_RATE if frame.time is None else frame.time
        try:
            if isinstance(prepared, InputError):
                raise prepared
            search = self._search if isinstance(prepared, Places) else None
            known = self._known(time, T_fixed_sensor) if self.is_tracked and search is not None else None
            scan, poses = predict_scan(
                prepared, lambda: self.predictor, search=search, known=known, skeleton=self.skeleton
            )
        except InputError as error:
            return of_frame(poses=nobody, T_world_sensor=frame.T_world_sensor, error=str(error))
        if self.is_tracked:
            poses = self._tracked(time, scan, poses, T_fixed_sensor)
        return of_frame(poses=replace(poses, source=self.name), T_world_sensor=frame.T_world_sensor)

    def _scan(self, frame: Frame) -> Scan:
        points, notes = only_returns(frame.points)
        scan = Scan(points=points, up=self.up)
        if self.boxes is not None:
            boxes = self.boxes.of(frame)
            notes += ["no boxes are given for this frame"] if boxes is None else []
            scan = replace(scan, boxes=boxes or [])
        elif self._is_crop is None and len(points):
            self._is_crop = not is_wide(scan)
        if self._origin is not None:
            (origin,) = self._origin
        else:
            origin = np.zeros(3) if frame.origin is None and not self._is_crop else frame.origin
        return replace(scan, origin=origin, warnings=(*frame.warnings, *notes))

    # ---- tracks

    def _to_fixed(self, T_world_sensor: np.ndarray | None) -> np.ndarray:
        """T_fixed_sensor (4, 4); of a frame without the sensor's pose, where others have it, the last one."""
        if T_world_sensor is not None:
            self._T_world_sensor = np.asarray(T_world_sensor, float)
        return fixed_from_sensor(self._T_world_sensor, self.up)

    def _known(self, time: float, T_fixed_sensor: np.ndarray) -> KnownPlaces:
        """Who is expected in this frame and was verified not long ago, in the sensor's frame."""
        T_sensor_fixed = np.linalg.inv(T_fixed_sensor)
        R_boxes_input = UP_AXES.get(self.up, UP_AXES["z"])
        boxes, pelvises, others = [], [], []
        states = []
        for state in self._tracker.predicted(time):
            person = self._people.get(state.id)
            if person is None or not self._is_trusted(state, person, time):
                others.append(state)
                continue
            states.append(state)
            center, size = state.center, np.maximum(state.size, 0.1)
            box = Box(center=center, size=size, yaw=state.yaw, score=person.score, mounted=person.mounted)
            boxes.append(_moved(box, T_sensor_fixed, np.eye(3), R_boxes_input))
            pelvises.append(transform_points(T_sensor_fixed, center + person.offset))
        states += others
        since = time - self._rejected[:, 3]
        self._rejected = self._rejected[(since >= 0) & (since < _trusted(np.arange(len(self._rejected))))]
        return KnownPlaces(
            boxes=boxes,
            pelvises=np.reshape(pelvises, (-1, 3)),
            tracks=transform_points(T_sensor_fixed, np.reshape([state.center for state in states], (-1, 3))),
            reach=np.array([_NEAR + _NEAR_DEVIATIONS * state.position_sd for state in states]),
            rejected=transform_points(T_sensor_fixed, self._rejected[:, :3]),
        )

    def _is_trusted(self, state: TrackState, person: "_Person", time: float) -> bool:
        """Whether somebody needs no verification."""
        is_recent = state.age <= _RECENT and state.position_sd <= _MOST_DEVIATION
        return is_recent and person.score >= self._least_score and 0 <= time - person.verified < _trusted(state.id)

    def _tracked(self, time: float, scan: Scan, poses: Poses, T_fixed_sensor: np.ndarray) -> Poses:
        """The people with the ids of their tracks, and what is remembered of them."""
        if self._is_crop:
            people = tuple(replace(person, id=0) for person in poses)
            return replace(poses, people=self._steadied(time, people, T_fixed_sensor) if self.live else people)
        if scan.rejected is not None:
            places = transform_points(T_fixed_sensor, scan.rejected)
            self._rejected = np.concatenate([self._rejected, np.insert(places, 3, time, axis=1)])
        R_boxes_input = UP_AXES.get(self.up, UP_AXES["z"])
        # whoever is searched for, or was given, has a box
        own = [cast(Box, person.box) for person in poses]
        pelvises = [_pelvis(person.pose) for person in poses]
        if scan.verified is not None and scan.pelvises is not None:
            # the box of somebody known goes with the pelvis
            for i in np.flatnonzero(~scan.verified).tolist():
                pelvis = scan.pelvises[i] if pelvises[i] is None else pelvises[i]
                own[i] = replace(own[i], center=(own[i].center + pelvis - scan.pelvises[i]).round(4))
        boxes = [_moved(box, T_fixed_sensor, R_boxes_input, np.eye(3)) for box in own]
        is_weak = [box.score is not None and box.score < self._least_score for box in boxes]
        # the surest are first
        strong = len(boxes) - sum(is_weak)
        ids = self._tracker.update(time, boxes[:strong], boxes[strong:])
        for i, (id, box, pelvis) in enumerate(zip(ids, boxes, pelvises, strict=True)):
            is_verified = scan.verified is not None and scan.verified[i]
            if is_verified and id >= 0 and pelvis is not None and box.score is not None:
                offset = transform_points(T_fixed_sensor, pelvis) - box.center
                self._people[id] = _Person(verified=time, score=box.score, mounted=box.mounted, offset=offset)
        self._people = {id: person for id, person in self._people.items() if time - person.verified < _FORGOTTEN}
        named = tuple(
            replace(person, id=id, box=replace(box, id=id))
            for id, person, box in zip(ids, poses, own, strict=True)
            if id >= 0
        )
        return replace(poses, people=self._steadied(time, named, T_fixed_sensor) if self.live else named)

    def _steadied(self, time: float, people: tuple[PersonPose, ...], T_fixed_sensor: np.ndarray) -> tuple:
        """Poses by the past of their tracks."""
        T_sensor_fixed = np.linalg.inv(T_fixed_sensor)
        gap = self._tracker.max_gap
        self._filters = {id: own for id, own in self._filters.items() if 0 <= time - own[0] <= gap}
        steady = []
        for person in people:
            if person.pose is None or not isinstance(person.id, int):
                steady.append(person)
                continue
            _, own = self._filters.get(person.id) or (time, LiveFilter(person.skeleton))
            pose = own.update(time, replace(person.pose, joints=transform_points(T_fixed_sensor, person.pose.joints)))
            pose = pose and replace(pose, joints=transform_points(T_sensor_fixed, pose.joints))
            self._filters[person.id] = time, own
            steady.append(replace(person, pose=pose or person.pose))
        return tuple(steady)

    # ---- going on

    def state(self) -> dict[str, Any]:
        """What the frames so far said, as JSON holds it."""
        own = {"is_crop": self._is_crop, "boxes_used": self.boxes is not None and self.boxes.was_used}
        if not self.is_tracked:
            return own
        world = None if self._T_world_sensor is None else self._T_world_sensor.tolist()
        return own | {
            "tracker": self._tracker.state(),
            "T_world_sensor": world,
            "people": {id: person.state() for id, person in self._people.items()},
            "rejected": self._rejected.tolist(),
            "filters": {id: [time, own.state()] for id, (time, own) in self._filters.items()},
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Goes on where the predictor whose `state()` this is would."""
        self._is_crop = state["is_crop"]
        if self.boxes is not None:
            self.boxes.was_used = state["boxes_used"]
        if not self.is_tracked:
            return
        self._tracker = Tracker.from_state(state["tracker"])
        world = state["T_world_sensor"]
        self._T_world_sensor = None if world is None else np.array(world)
        self._people = {int(id): _Person.from_state(own) for id, own in state["people"].items()}
        self._rejected = np.array(state["rejected"], float).reshape(-1, 4)
        self._filters = {int(id): (time, LiveFilter.from_state(own)) for id, (time, own) in state["filters"].items()}


@dataclass(frozen=True, kw_only=True, eq=False)
class _Person:
    """Of a track: time s of the last verification, the score and mounted that it gave; offset (3,) m of the pelvis from
    the box's center, in the fixed frame."""

    verified: float
    score: float
    mounted: bool | None
    offset: np.ndarray

    def state(self) -> list:
        return [self.verified, self.score, self.mounted, self.offset.tolist()]

    @classmethod
    def from_state(cls, state: list) -> "_Person":
        verified, score, mounted, offset = state
        return cls(verified=verified, score=score, mounted=mounted, offset=np.array(offset))


def fixed_from_sensor(T_world_sensor: np.ndarray | None, up: str) -> np.ndarray:
    """T_fixed_sensor (4, 4): to the world where the sensor's pose is known, else the sensor's frame with z up."""
    if T_world_sensor is not None:
        return T_world_sensor
    level = np.eye(4)
    level[:3, :3] = UP_AXES.get(up, UP_AXES["z"])
    return level


def _trusted(number: Any) -> Any:
    """For how long what was verified holds, s."""
    first, last = _TRUSTED
    return first + (last - first) * (number % 5) / 4


def _moved(box: Box, T: np.ndarray, R_upright_from: np.ndarray, R_upright_to: np.ndarray) -> Box:
    """The box in another frame. R_upright (3, 3): of each frame to the one in which its boxes stand along z."""
    heading = R_upright_from.T @ [np.cos(box.yaw), np.sin(box.yaw), 0.0]
    x, y, _ = R_upright_to @ T[:3, :3] @ heading
    return replace(box, center=transform_points(T, box.center), yaw=float(np.arctan2(y, x)))


def _pelvis(pose: Pose | None) -> np.ndarray | None:
    """(3,) m, or half way between the hips where the skeleton has none."""
    if pose is None:
        return None
    names = ("pelvis",) if "pelvis" in pose.skeleton.joints else ("left_hip", "right_hip")
    return pose.joints[[pose.skeleton.index(name) for name in names]].mean(0)
