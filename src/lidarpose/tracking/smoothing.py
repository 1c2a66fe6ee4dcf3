"""Smoothing of a person's poses over a track: `smooth` for recordings, from all frames."""

from dataclasses import replace

import numpy as np

from lidarpose.sample import CONFIDENCE_RADIUS, known_values
from lidarpose.tracking.bones import keep_lengths, length_statistics, lengths_of, rigid_bones
from lidarpose.tracking.clip import TrackPoses
from lidarpose.tracking.facing import swapped_frames
from lidarpose.tracking.motion_model import learn_process_noise, smooth_joints, usual_process_noise

# frames are weighted by Student's t with this many degrees of freedom: a frame that is off as a whole hardly counts
_FREEDOM = 1.0
# rounds of weighting frames, and the number of last rounds before each of which the process noise is learned
_ROUNDS, _LEARNED = 6, 3
# process noise of the first rounds, as a multiple of the usual one: with less, fast motion of the whole body looks like
# frames that are off
_FIRST_SCALE = 10.0
# spread if the network does not predict it, and lower bound of a predicted spread, m
_SPREAD, _LEAST_SPREAD = 0.08, 0.005
# a joint's weight is its spread to the power of -3, which works better than -2; at this spread, m, both are equal
_USUAL_SPREAD = 0.06
# the spread of a smoothed joint combines these multiples of the path's standard deviation and of the frames' spread
_PATH, _COMMON = 2.5, 0.8
# bones are not measured with fewer frames
LEAST_FRAMES = 3
# gaps up to MAX_GAP are filled in; in longer ones, and before and after a track, only frames this near to a seen one, s
MAX_GAP, _MAX_BEYOND = 2.0, 0.5
# after this time, s, nothing is known of the earlier motion; variances of longer steps exceed the precision of floats
_LONGEST_STEP = 60.0


def smooth(track: TrackPoses) -> TrackPoses:
    """The same track smoothed: facing corrected, joints on smooth paths, bones of constant length.

    Frames in which the person was not seen are filled in within gaps of up to `MAX_GAP` s, and within half a second of
    a frame with the person. They have a correspondingly larger spread, `visible` 0 and `filled` true.
    """
    is_seen = track.seen
    if not is_seen.any():
        return track
    track = with_facing_corrected(track)
    steps = np.diff(track.times, prepend=track.times[:1])
    times, usual = np.cumsum(np.minimum(steps, _LONGEST_STEP)), usual_process_noise(track.skeleton)
    spread = known_spread(track.spread, is_seen, len(usual))
    precision = precisions(spread)
    # relative to the first position, which keeps the numbers small
    origin = track.joints[is_seen][0].mean(0)
    joints = np.where(is_seen[:, None, None], track.joints - origin, 0.0)
    weight = np.ones((len(times), 1))
    process_noise = np.broadcast_to(_FIRST_SCALE * usual, precision.shape)
    for k in range(_ROUNDS):
        if k >= _ROUNDS - _LEARNED:
            process_noise = learn_process_noise(times, joints, precision * weight, usual)
        path, variance = smooth_joints(times, joints, precision * weight, process_noise)
        weight = frame_weights(path - joints, precision)
    bones = rigid_bones(track.skeleton)
    if is_seen.sum() >= LEAST_FRAMES and len(bones):
        statistics = length_statistics(joints[is_seen], spread[is_seen] ** 2, bones).sum(0)
        lengths = lengths_of(statistics, bones, track.skeleton)
        path = keep_lengths(path, variance, bones, lengths)
    return filled_in(track, path + origin, steady_spread(variance, (spread**-2).sum(0) / is_seen.sum()))


def known_spread(spread: np.ndarray | None, seen: np.ndarray, count: int) -> np.ndarray:
    """(T, J) m: spread (T, J), or a default if None, for frames seen (T,) bool; infinite for the others."""
    spread = np.full((len(seen), count), _SPREAD) if spread is None else spread
    return np.where(seen[:, None], np.maximum(spread, _LEAST_SPREAD), np.inf)


def precisions(spread: np.ndarray) -> np.ndarray:
    """Spreads m -> precisions 1/m^2, the weights of the joints."""
    return _USUAL_SPREAD * spread**-3


def steady_spread(variance: np.ndarray, mean_precision: np.ndarray) -> np.ndarray:
    """(..., J) m: the expected distance from the truth of smoothed joints whose paths have this variance m^2 per axis.

    Errors that all frames of a person share cannot be smoothed away: mean_precision (J,) 1/m^2, mean inverse square of
    the frames' spread.
    """
    return np.sqrt(_PATH**2 * variance + _COMMON**2 / mean_precision)


def with_facing_corrected(track: TrackPoses) -> TrackPoses:
    """A track with corrected facing: left and right are exchanged in the flipped frames, if the skeleton has
    both."""
    if not track.skeleton.is_two_sided:
        return track
    rows = np.flatnonzero(track.seen)
    variance = known_spread(track.spread, track.seen, len(track.skeleton))[rows] ** 2
    confidence = None if track.confidence is None else track.confidence[rows]
    flipped_rows = rows[swapped_frames(track.times[rows], track.joints[rows], variance, confidence, track.skeleton)]
    flip = np.array(track.skeleton.flip)
    values = known_values(track, "joints", "spread", "visible", "confidence")
    for name, value in values.items():
        values[name] = value.copy()
        values[name][flipped_rows] = value[flipped_rows][:, flip]
    return replace(track, **values, swapped=np.isin(np.arange(len(track)), flipped_rows))


def frame_weights(offset: np.ndarray, precision: np.ndarray, freedom: float = _FREEDOM) -> np.ndarray:
    """(..., 1): the weight of a frame whose joints are off by (..., J, 3) m with precision (..., J) 1/m^2."""
    squared_error = ((offset**2).sum(-1) * precision).mean(-1, keepdims=True)
    return (freedom + 3) / (freedom + squared_error)


def likely_hit(spread: np.ndarray) -> np.ndarray:
    """The probability that a joint with this spread, m, is within `CONFIDENCE_RADIUS`, for Rayleigh distances."""
    return 1 - np.exp(-np.pi / 4 * (CONFIDENCE_RADIUS / spread) ** 2)


def filled_in(given: TrackPoses, joints: np.ndarray, spread: np.ndarray) -> TrackPoses:
    """A track with smoothed joints (T, J, 3) m and spread (T, J) m where it was seen or may be filled in."""
    is_seen, times = given.seen, given.times
    rows = np.flatnonzero(is_seen)
    next_index = np.searchsorted(rows, np.arange(len(is_seen)))
    previous_index = np.searchsorted(rows, np.arange(len(is_seen)), side="right") - 1
    time_since = np.where(previous_index >= 0, times - times[rows[previous_index.clip(0)]], np.inf)
    time_until = np.where(next_index < len(rows), times[rows[next_index.clip(0, len(rows) - 1)]] - times, np.inf)
    is_known = is_seen | (time_since + time_until <= MAX_GAP) | (np.minimum(time_since, time_until) <= _MAX_BEYOND)
    is_filled = is_known & ~is_seen
    spread = np.where(is_known[:, None], spread, np.nan)
    visible = None if given.visible is None else np.where(is_filled[:, None], 0.0, given.visible)
    confidence = None
    if given.confidence is not None:
        confidence = np.where(is_filled[:, None], likely_hit(spread), given.confidence)
    joints = np.where(is_known[:, None, None], joints, np.nan)
    return replace(given, joints=joints, spread=spread, visible=visible, confidence=confidence, filled=is_filled)
