"""A person's poses made steady over a track: `smooth` for recordings, from all frames."""

from dataclasses import replace

import numpy as np

from lidarpose.sample import CONFIDENCE_RADIUS
from lidarpose.tracking.clip import TrackPoses
from lidarpose.tracking.motion_model import learn_strength, smooth_joints, strengths

# frames are trusted by Student's t of so many degrees of freedom: a frame that is off as a whole hardly counts
_FREEDOM = 1.0
# rounds of weighing frames; the strength of motion is learned before each of the last
_ROUNDS, _LEARNED = 6, 3
_FIRST_SCALE = 3.0
# spread where the network does not say, and the least that is believed, m
_SPREAD, _LEAST_SPREAD = 0.08, 0.005
# longer gaps, and what is before and after a track, are filled in next to seen frames only, s
MAX_GAP, _MAX_BEYOND = 2.0, 0.5


def smooth(track: TrackPoses) -> TrackPoses:
    """The same track made steady. Frames that were not seen are filled in within gaps of up to `MAX_GAP` s, and
    within half a second of a frame that was, with a spread that says so, `visible` 0 and `filled` true."""
    seen = track.seen
    if not seen.any():
        return track
    times, joints, usual = track.times, track.joints, strengths(track.skeleton)
    origin = joints[seen][0].mean(0)
    joints = np.where(seen[:, None, None], joints - origin, 0.0)
    precision = precisions(track.spread, seen, len(usual))
    weight = np.ones((len(times), 1))
    strength = np.broadcast_to(_FIRST_SCALE * usual, precision.shape)
    for k in range(_ROUNDS):
        if k >= _ROUNDS - _LEARNED:
            strength = learn_strength(times, joints, precision * weight, usual)
        path, variance = smooth_joints(times, joints, precision * weight, strength)
        weight = frame_weights(path - joints, precision)
    return filled_in(track, path + origin, 1.6 * np.sqrt(variance))


def precisions(spread: np.ndarray | None, seen: np.ndarray, count: int) -> np.ndarray:
    """(T, J) 1/m^2 of spreads (T, J) m, or None; 0 where not seen (T,)."""
    spread = np.full((len(seen), count), _SPREAD) if spread is None else spread
    return np.where(seen[:, None], np.maximum(np.where(seen[:, None], spread, 1.0), _LEAST_SPREAD) ** -2, 0.0)


def frame_weights(offset: np.ndarray, precision: np.ndarray) -> np.ndarray:
    """(..., 1): how far a frame is trusted whose joints are off by (..., J, 3) m with precision (..., J) 1/m^2."""
    off = ((offset**2).sum(-1) * precision).mean(-1, keepdims=True)
    return (_FREEDOM + 3) / (_FREEDOM + off)


def likely_hit(spread: np.ndarray) -> np.ndarray:
    """The probability that a joint of that spread m is within `CONFIDENCE_RADIUS`, if its distance is Rayleigh's."""
    return 1 - np.exp(-np.pi / 4 * (CONFIDENCE_RADIUS / spread) ** 2)


def filled_in(given: TrackPoses, joints: np.ndarray, spread: np.ndarray) -> TrackPoses:
    """A track with smoothed joints (T, J, 3) m and spread (T, J) m where it was seen or may be filled in."""
    seen, times = given.seen, given.times
    rows = np.flatnonzero(seen)
    after = np.searchsorted(rows, np.arange(len(seen)))
    before = np.searchsorted(rows, np.arange(len(seen)), side="right") - 1
    since = np.where(before >= 0, times - times[rows[before.clip(0)]], np.inf)
    until = np.where(after < len(rows), times[rows[after.clip(0, len(rows) - 1)]] - times, np.inf)
    known = seen | (since + until <= MAX_GAP) | (np.minimum(since, until) <= _MAX_BEYOND)
    filled = known & ~seen
    spread = np.where(known[:, None], spread, np.nan)
    visible = None if given.visible is None else np.where(filled[:, None], 0.0, given.visible)
    confidence = None
    if given.confidence is not None:
        confidence = np.where(filled[:, None], likely_hit(spread), given.confidence)
    joints = np.where(known[:, None, None], joints, np.nan)
    return replace(given, joints=joints, spread=spread, visible=visible, confidence=confidence, filled=filled)
