"""`Tracker`: joins the boxes of people over time, so that each person keeps one id.

A Kalman filter per person holds position and velocity, with independent axes, for all people at once. Boxes are
assigned to people with the least total cost. The heading is smoothed separately, since angles wrap.

Legend: N tracks, B boxes.
"""

import reprlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from lidarpose.errors import InputError, check_finite, check_int
from lidarpose.sample import Box
from lidarpose.tracking.assignment import assign

# a frame up to this much earlier than the one before, s, is late; a larger difference means that the clock was set back
MAX_LATE = 0.3
# standard deviation of the center of a box of score 1, m, along x, y and z; its square is divided by the score, but not
# by less than _LEAST_SCORE: measured on detected boxes
POSITION_SD, _LEAST_SCORE = np.array([0.12, 0.12, 0.2]), 0.05
# standard deviation of the velocity of a new track, m/s, and of its change within one second, m/s, which grows with the
# square root of time
SPEED_SD, SPEED_CHANGE = np.array([1.2, 1.2, 0.2]), np.array([0.7, 0.7, 0.15])
# a box farther from the predicted position is not assigned: squared Mahalanobis distance, 99.9 % of a chi-square
# distribution with three degrees of freedom
_GATE = 16.3
# a box is not assigned to a track of too uncertain position either: bound of -2 log likelihood, less a constant
_LEAST_LIKELY = 8.0
# a weak box this near to one that is not weak is a duplicate, m
_REPEATED = 0.5
# time constant with which heading and size follow the boxes, s
_SMOOTHING = 0.5
# a track seen only once, with a score below _SURE, is dropped after _UNSURE_GAP s
_SURE, _UNSURE_GAP = 0.6, 0.6
# maximum time that weak boxes alone continue a track, as a multiple of `max_gap`: what they show may be something else
_MOST_WEAK = 1.5


@dataclass(frozen=True, kw_only=True, eq=False)
class TrackState:
    """An expected person: id of the track; center (3,) and size (3,) m, yaw rad of the box; age: seconds since the
    person was last seen; position_sd: standard deviation of the center on a horizontal axis, m; velocity (3,) m/s, None
    if the person was seen only once."""

    id: int
    center: np.ndarray
    size: np.ndarray
    yaw: float
    age: float
    position_sd: float
    velocity: np.ndarray | None = None


@dataclass(kw_only=True, eq=False)
class _Tracks:
    """All tracks: id (N,), -1 without an id yet; state (N, 3, 2): position m and velocity m/s along x, y, z; covariance
    (N, 3, 2, 2); heading (N, 2): mean of cos and sin of yaw; size (N, 3) m; age (N,) s since last seen, weak_age (N,) s
    since last seen in a box that is not weak; sightings (N,); sure (N,) bool: seen twice, or with a high score."""

    id: np.ndarray
    state: np.ndarray
    covariance: np.ndarray
    heading: np.ndarray
    size: np.ndarray
    age: np.ndarray
    weak_age: np.ndarray
    sightings: np.ndarray
    sure: np.ndarray

    def __len__(self) -> int:
        return len(self.id)

    @property
    def is_expected(self) -> np.ndarray:
        """(N,) bool: tracks with an id that were seen twice or with a high score."""
        return self.sure & (self.id >= 0)

    def take(self, rows: np.ndarray) -> "_Tracks":
        return _Tracks(**{field.name: getattr(self, field.name)[rows] for field in fields(self)})

    def joined(self, other: "_Tracks") -> "_Tracks":
        names = [field.name for field in fields(self)]
        return _Tracks(**{name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in names})

    def after(self, seconds: float) -> "_Tracks":
        """The tracks predicted for later: constant velocity, changed by white noise."""
        transition = np.array([[1.0, seconds], [0.0, 1.0]])
        # integrals of white noise in acceleration
        noise = np.array([[seconds**3 / 3, seconds**2 / 2], [seconds**2 / 2, seconds]])
        later_tracks = self.take(np.arange(len(self)))
        later_tracks.state = self.state @ transition.T
        later_tracks.covariance = transition @ self.covariance @ transition.T + noise * SPEED_CHANGE[:, None, None] ** 2
        later_tracks.age, later_tracks.weak_age = self.age + seconds, self.weak_age + seconds
        return later_tracks


class Tracker:
    """Assigns track ids to the boxes of people, which are in one fixed frame (z up; the world frame if known).

    `jumps_back` counts the frames whose time was earlier than the one before.

    Args:
        max_gap: how long a person may be unseen and keep the id, s.

    Raises:
        InputError: max_gap is not a positive number.
    """

    def __init__(self, *, max_gap: float = 2.0):
        check_finite("max_gap", max_gap)
        if max_gap <= 0:
            raise InputError(f"max_gap must be seconds, more than 0, got {max_gap!r}")
        self.max_gap = float(max_gap)
        self.jumps_back = 0
        self._time: float | None = None
        self._next_id = 0
        self._tracks = _of_boxes([])

    def update(self, time: float, boxes: Sequence[Box], weak_boxes: Sequence[Box] = ()) -> list[int]:
        """Assigns the boxes of a frame to tracks.

        Args:
            time: s, from any origin. A time earlier than the last one is counted in `jumps_back`; if it is earlier by
                more than `max_gap`, all tracks are dropped.
            boxes: of all people that are seen.
            weak_boxes: detections of low score: they continue tracks, alone for at most 1.5 times `max_gap`, but do not
                start any.

        Returns:
            The track id of each of `boxes`: a known person's, or the next new one, from 0; ids are never reused. Then
            the ids of `weak_boxes`, -1 without a track that has an id.

        Raises:
            InputError: time is not a finite number, or boxes are not `Box` objects; the tracks stay as they were.
        """
        boxes, weak_boxes = (_checked(own) for own in (boxes, weak_boxes))
        detections = _of_boxes([*boxes, *weak_boxes])
        tracks = self._elapsed(time)
        is_weak = np.arange(len(detections)) >= len(boxes)
        ids = np.full(len(detections), -1)
        kept_rows = np.flatnonzero(~_repeats(detections, is_weak))
        detections, is_weak = detections.take(kept_rows), is_weak[kept_rows]
        rows, columns = assign(_costs(tracks, detections))
        _correct(tracks, rows, detections, columns)
        tracks.weak_age[rows[~is_weak[columns]]] = 0
        new_rows = np.setdiff1d(np.arange(len(detections)), columns)
        track_rows = np.empty(len(detections), int)
        track_rows[columns], track_rows[new_rows] = rows, len(tracks) + np.arange(len(new_rows))
        tracks = tracks.joined(detections.take(new_rows))
        # tracks of weak boxes alone get no id yet, but keep these boxes from being assigned to other tracks
        new_tracks = track_rows[~is_weak & (tracks.id[track_rows] < 0)]
        tracks.id[new_tracks] = self._next_id + np.arange(len(new_tracks))
        self._next_id += len(new_tracks)
        self._tracks = tracks
        ids[kept_rows] = tracks.id[track_rows]
        return ids.tolist()

    def predicted(self, time: float) -> list[TrackState]:
        """The people expected at a time, s, not before the last frame's: those seen twice or with a high score."""
        check_finite("time", time)
        seconds = 0.0 if self._time is None else max(time - self._time, 0.0)
        if seconds > self.max_gap:
            return []
        tracks = self._tracks.after(seconds)
        tracks = tracks.take((tracks.age <= self.max_gap) & self._is_supported(tracks) & tracks.is_expected)
        deviations = np.sqrt(tracks.covariance[:, :2, 0, 0].max(1))
        return [
            TrackState(
                id=int(tracks.id[i]),
                center=tracks.state[i, :, 0],
                size=tracks.size[i],
                yaw=float(np.arctan2(tracks.heading[i, 1], tracks.heading[i, 0])),
                age=float(tracks.age[i]),
                position_sd=float(deviations[i]),
                velocity=tracks.state[i, :, 1] if tracks.sightings[i] > 1 else None,
            )
            for i in range(len(tracks))
        ]

    def state(self) -> dict[str, Any]:
        """The complete state of the tracker, for JSON."""
        tracks = {field.name: getattr(self._tracks, field.name).tolist() for field in fields(_Tracks)}
        names = ("max_gap", "jumps_back")
        settings = {name: getattr(self, name) for name in names}
        return settings | {"time": self._time, "next_id": self._next_id, "tracks": tracks}

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> "Tracker":
        """The tracker restored from its `state()`. Raises InputError for anything else."""
        try:
            tracker = cls(max_gap=state["max_gap"])
            tracker.jumps_back = check_int("jumps_back", state["jumps_back"], least=0)
            tracker._next_id = check_int("next_id", state["next_id"], least=0)
            if (time := state["time"]) is not None:
                check_finite("time", time)
                tracker._time = float(time)
            empty_tracks = tracker._tracks
            tracker._tracks = _Tracks(
                **{
                    name: np.array(values, getattr(empty_tracks, name).dtype).reshape(
                        -1, *getattr(empty_tracks, name).shape[1:]
                    )
                    # states of earlier versions have no weak_age
                    for name, values in ({"weak_age": state["tracks"]["age"]} | state["tracks"]).items()
                }
            )
            if len({len(getattr(tracker._tracks, field.name)) for field in fields(_Tracks)}) > 1:
                raise ValueError("tracks: columns of unequal length")
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise InputError(
                f"expected the state of a tracker, got {reprlib.repr(state)} ({type(error).__name__}: {error}): give "
                "what Tracker.state() returned"
            ) from None
        return tracker

    def _elapsed(self, time: float) -> _Tracks:
        """The tracks predicted for `time`, without those that were unseen for too long."""
        check_finite("time", time)
        seconds = 0.0 if self._time is None else float(time) - self._time
        if seconds < 0:
            self.jumps_back += 1
        # a frame that comes late does not set the clock back
        if self._time is None or not -MAX_LATE <= seconds < 0:
            self._time = float(time)
        # a large jump back means another recording
        if abs(seconds) > self.max_gap:
            return _of_boxes([])
        tracks = self._tracks.after(max(seconds, 0.0))
        # at low frame rates, a track seen in the previous frame is kept for this one
        gap = np.where(tracks.is_expected, self.max_gap, min(self.max_gap, max(_UNSURE_GAP, seconds)))
        return tracks.take((tracks.age <= gap) & self._is_supported(tracks))

    def _is_supported(self, tracks: _Tracks) -> np.ndarray:
        """(N,) bool: tracks that have not been continued by weak boxes alone for too long."""
        return tracks.weak_age <= _MOST_WEAK * self.max_gap


def _checked(boxes: Iterable[Box]) -> list[Box]:
    box_list = list(boxes) if isinstance(boxes, Iterable) else None
    if box_list is None or not all(isinstance(box, Box) for box in box_list):
        raise InputError(f"expected a list of Box, got {reprlib.repr(boxes)}: convert it with lidarpose.read_boxes")
    return box_list


def _of_boxes(boxes: Sequence[Box]) -> _Tracks:
    """One new track per box, without an id: -1."""
    count = len(boxes)
    state = np.zeros((count, 3, 2))
    state[:, :, 0] = np.reshape([box.center for box in boxes], (-1, 3))
    yaw = np.array([box.yaw for box in boxes], float)
    scores = np.array([1.0 if box.score is None else box.score for box in boxes])
    covariance = np.zeros((count, 3, 2, 2))
    covariance[..., 0, 0] = POSITION_SD**2 / np.maximum(scores, _LEAST_SCORE)[:, None]
    covariance[..., 1, 1] = SPEED_SD**2
    return _Tracks(
        id=np.full(count, -1),
        state=state,
        covariance=covariance,
        heading=np.stack([np.cos(yaw), np.sin(yaw)], 1),
        size=np.reshape([box.size for box in boxes], (-1, 3)).astype(float),
        age=np.zeros(count),
        weak_age=np.zeros(count),
        sightings=np.ones(count, int),
        sure=scores >= _SURE,
    )


def _repeats(detections: _Tracks, is_weak: np.ndarray) -> np.ndarray:
    """(B,) bool: weak boxes near one that is not weak, which are duplicates of it."""
    places = detections.state[:, :2, 0]
    distances = np.linalg.norm(places[:, None] - places[~is_weak], axis=-1)
    return is_weak & (distances < _REPEATED).any(1)


def _costs(tracks: _Tracks, detections: _Tracks) -> np.ndarray:
    """(N, B): the cost of assigning a box to a track, below 0 if that is better than neither; inf if not allowed."""
    offset = detections.state[None, :, :, 0] - tracks.state[:, None, :, 0]
    variance = tracks.covariance[:, None, :, 0, 0] + detections.covariance[None, :, :, 0, 0]
    distance = (offset**2 / variance).sum(-1)
    cost = distance + np.log(variance).sum(-1) - _LEAST_LIKELY
    return np.where((distance < _GATE) & (cost < 0), cost, np.inf)


def _correct(tracks: _Tracks, rows: np.ndarray, detections: _Tracks, columns: np.ndarray) -> None:
    """The Kalman update of tracks `rows` with boxes `columns`, in place."""
    covariance = tracks.covariance[rows]
    variance = covariance[..., 0, 0] + detections.covariance[columns][..., 0, 0]
    gain = covariance[..., 0] / variance[..., None]
    offset = detections.state[columns, :, 0] - tracks.state[rows, :, 0]
    tracks.state[rows] += gain * offset[..., None]
    tracks.covariance[rows] -= gain[..., :, None] * gain[..., None, :] * variance[..., None, None]
    # the plain mean of the first few sightings, later a mean that favors the newest
    weight = np.maximum(1 - np.exp(-tracks.age[rows] / _SMOOTHING), 1 / (tracks.sightings[rows] + 1))[:, None]
    tracks.heading[rows] += weight * (detections.heading[columns] - tracks.heading[rows])
    tracks.size[rows] += weight * (detections.size[columns] - tracks.size[rows])
    tracks.age[rows] = 0
    tracks.sightings[rows] += 1
    tracks.sure[rows] = True
