"""State carried between the frames of a recording: tracks, their last verification, and rejected positions."""

from dataclasses import replace
from typing import Any, NamedTuple, cast

import numpy as np

from lidarpose.geometry import inverse_transform, transform_points
from lidarpose.inference.known_places import KnownPlaces
from lidarpose.inference.results import PersonPose, Poses
from lidarpose.inference.scan import Scan
from lidarpose.recording.coordinates import FixedFrame, moved_yaw
from lidarpose.sample import Box, Pose
from lidarpose.tracking.live import LiveFilter
from lidarpose.tracking.tracker import MAX_LATE, Tracker, TrackState

# time, s, after which known people and rejected positions are verified again: spread over this interval, so that not
# all are due in the same frame
_TRUSTED = (1.6, 2.4)
# maximum time since a track was last seen, s, and maximum standard deviation of its position, m, for a known person;
# beyond them, the person is verified like any other detection
_RECENT, _MOST_DEVIATION = 0.5, 0.35
# search radius around the expected position of a track: constant part, m, and number of standard deviations
_NEAR, _NEAR_DEVIATIONS = 0.4, 3.0
# time, s, after which the verification of an unseen person is dropped
_FORGOTTEN = 10.0


class _Verified(NamedTuple):
    """The last verification of a track: time s; score and mounted: its results; offset (3,) m: from the box center to
    the pelvis, in the fixed frame."""

    time: float
    score: float
    mounted: bool | None
    offset: list[float]


class KnownPeople:
    """Tracks the people of a recording frame by frame.

    Args:
        up: up axis of the points, as in `predict`.
        least_score: minimum score to start a track; lower-scoring people only continue tracks.
        live: whether to smooth poses using past frames only.
    """

    def __init__(self, *, up: str, least_score: float, live: bool):
        self.fixed = FixedFrame(up)
        self.live = live
        self._least_score = least_score
        self._tracker = Tracker()
        self._verified: dict[int, _Verified] = {}
        # x, y, z m in the fixed frame, and time s
        self._rejected = np.zeros((0, 4))
        self._filters: dict[int, tuple[float, LiveFilter]] = {}

    def expected(self, time: float, T_fixed_sensor: np.ndarray) -> KnownPlaces:
        """Expected positions of people in the next frame, in the sensor frame; people who need no verification come
        first."""
        T_sensor_fixed = inverse_transform(T_fixed_sensor)
        states = sorted(self._tracker.predicted(time), key=lambda state: not self._is_trusted(state, time))
        boxes, pelvises = [], []
        for state in states:
            if self._is_trusted(state, time):
                verification, size = self._verified[state.id], np.maximum(state.size, 0.1)
                center = transform_points(T_sensor_fixed, state.center)
                yaw = moved_yaw(state.yaw, T_sensor_fixed, None, self.fixed.R_upright)
                boxes.append(
                    Box(center=center, size=size, yaw=yaw, score=verification.score, mounted=verification.mounted)
                )
                pelvises.append(transform_points(T_sensor_fixed, state.center + verification.offset))
        elapsed = time - self._rejected[:, 3]
        # by their place, so that positions that were rejected together are not all due in the same frame
        trusted = _trusted(np.floor(100 * self._rejected[:, 0]))
        self._rejected = self._rejected[(elapsed >= 0) & (elapsed < trusted)]
        return KnownPlaces(
            boxes=boxes,
            pelvises=np.reshape(pelvises, (-1, 3)),
            tracks=transform_points(T_sensor_fixed, np.reshape([state.center for state in states], (-1, 3))),
            reach=np.array([_NEAR + _NEAR_DEVIATIONS * state.position_sd for state in states]),
            rejected=transform_points(T_sensor_fixed, self._rejected[:, :3]),
        )

    def _is_trusted(self, state: TrackState, time: float) -> bool:
        """Whether a track needs no verification."""
        verification = self._verified.get(state.id)
        if (
            verification is None
            or verification.score < self._least_score
            or not 0 <= time - verification.time < _trusted(state.id)
        ):
            return False
        return state.age <= _RECENT and state.position_sd <= _MOST_DEVIATION

    def update(self, time: float, scan: Scan, poses: Poses, T_fixed_sensor: np.ndarray) -> Poses:
        """Updates the tracks with a frame. Returns its people with track ids; the person of a crop has id 0."""
        if scan.boxes is None:
            people = tuple(replace(person, id=0) for person in poses)
        else:
            people = self._tracked(time, scan, poses, T_fixed_sensor)
        return replace(poses, people=self._steadied(time, people, T_fixed_sensor) if self.live else people)

    def _tracked(self, time: float, scan: Scan, poses: Poses, T_fixed_sensor: np.ndarray) -> tuple[PersonPose, ...]:
        if scan.rejected is not None:
            places = transform_points(T_fixed_sensor, scan.rejected)
            self._rejected = np.concatenate([self._rejected, np.insert(places, 3, time, axis=1)])
        # detected and given people all have boxes
        sensor_boxes = [cast(Box, person.box) for person in poses]
        pelvises = [person.pelvis for person in poses]
        is_verified = np.zeros(len(sensor_boxes), bool) if scan.verified is None else scan.verified
        if scan.verified is not None and scan.pelvises is not None:
            # the box of a known person, which is only expected, is moved with the predicted pelvis
            for i in np.flatnonzero(~scan.verified).tolist():
                pelvis = scan.pelvises[i] if pelvises[i] is None else pelvises[i]
                sensor_boxes[i] = replace(
                    sensor_boxes[i], center=(sensor_boxes[i].center + pelvis - scan.pelvises[i]).round(4)
                )
        boxes = [
            replace(
                box,
                center=transform_points(T_fixed_sensor, box.center),
                yaw=moved_yaw(box.yaw, T_fixed_sensor, self.fixed.R_upright),
            )
            for box in sensor_boxes
        ]
        # boxes are sorted by score
        num_strong = sum(box.score is None or box.score >= self._least_score for box in boxes)
        ids = self._tracker.update(time, boxes[:num_strong], boxes[num_strong:])
        for id, box, pelvis, is_new in zip(ids, boxes, pelvises, is_verified, strict=True):
            if is_new and id >= 0 and pelvis is not None and box.score is not None:
                offset = transform_points(T_fixed_sensor, pelvis) - box.center
                self._verified[id] = _Verified(time, box.score, box.mounted, offset.tolist())
        self._verified = {
            id: verification for id, verification in self._verified.items() if time - verification.time < _FORGOTTEN
        }
        # rotated to the axes of the sensor frame
        velocities = {
            state.id: state.velocity @ T_fixed_sensor[:3, :3]
            for state in self._tracker.predicted(time)
            if state.velocity is not None
        }
        people = zip(ids, poses, sensor_boxes, strict=True)
        return tuple(
            replace(person, id=id, box=replace(box, id=id), velocity=velocities.get(id))
            for id, person, box in people
            if id >= 0
        )

    def _steadied(self, time: float, people: tuple[PersonPose, ...], T_fixed_sensor: np.ndarray) -> tuple:
        """Smooths poses with the past of their tracks."""
        T_sensor_fixed = inverse_transform(T_fixed_sensor)
        gap = self._tracker.max_gap
        self._filters = {id: entry for id, entry in self._filters.items() if -MAX_LATE <= time - entry[0] <= gap}
        steady_people = []
        for person in people:
            if person.pose is not None and isinstance(person.id, int):
                latest_time, live_filter = self._filters.get(person.id) or (time, LiveFilter(person.skeleton))
                # a late frame is not smoothed
                if time >= latest_time:
                    joints = transform_points(T_fixed_sensor, person.pose.joints)
                    pose = cast(Pose, live_filter.update(time, replace(person.pose, joints=joints)))
                    self._filters[person.id] = time, live_filter
                    person = replace(person, pose=replace(pose, joints=transform_points(T_sensor_fixed, pose.joints)))
            steady_people.append(person)
        return tuple(steady_people)

    def state(self) -> dict[str, Any]:
        """The state after the frames so far, as JSON values."""
        return {
            "tracker": self._tracker.state(),
            "fixed": self.fixed.state(),
            "verified": self._verified,
            "rejected": self._rejected.tolist(),
            "filters": {id: [time, live_filter.state()] for id, (time, live_filter) in self._filters.items()},
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Resumes from the result of `state()`."""
        self._tracker = Tracker.from_state(state["tracker"])
        self.fixed.restore(state["fixed"])
        self._verified = {int(id): _Verified(*values) for id, values in state["verified"].items()}
        self._rejected = np.array(state["rejected"], float).reshape(-1, 4)
        self._filters = {
            int(id): (time, LiveFilter.from_state(filter_state))
            for id, (time, filter_state) in state["filters"].items()
        }


def _trusted(number: Any) -> Any:
    """Time, s, for which a verification remains valid. number: id of the track, or x of the rejected position in
    cm."""
    shortest, longest = _TRUSTED
    return shortest + (longest - shortest) * (number % 5) / 4
