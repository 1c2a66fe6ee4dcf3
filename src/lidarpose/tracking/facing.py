"""The direction that a person faces, corrected over a whole track.

Front and back look alike in a point cloud: sometimes a network flips a person, so that left and right are exchanged.
Each frame has two hypotheses, as predicted and with left and right exchanged; the best path through them is found.

Legend: T frames, J joints.
"""

import numpy as np

from lidarpose.skeleton import Skeleton

# log odds that a frame is not flipped, per unit of the mean confidence of its joints
_SURE = 6.0
# confidence if the network does not predict it
_CONFIDENCE = 0.6
# cost of flipping a frame relative to the one before: a person cannot turn around within a tenth of a second, and the
# cost falls by a factor of e with each further half second; times in s
_TURN, _TURN_STEP, _TURN_TIME = 40.0, 0.1, 0.5
# joints whose left-right pairs define the axis across the body
_ACROSS = ("hip", "shoulder")
# maximum log odds for walking forwards rather than backwards; at this speed, m/s, they are 71 % (1 / sqrt 2) of it
_FORWARD, _WALK = 0.3, 0.7


def swapped_frames(
    times: np.ndarray, joints: np.ndarray, variance: np.ndarray, confidence: np.ndarray | None, skeleton: Skeleton
) -> np.ndarray:
    """(T,) bool: the frames in which left and right must be exchanged.

    times (T,) s; joints (T, J, 3) m, all seen; variance (T, J) m^2; confidence (T, J) or None.
    """
    flip = np.array(skeleton.flip)
    frame_confidence = np.full(len(times), _CONFIDENCE) if confidence is None else confidence.mean(1)
    log_odds = _SURE * frame_confidence + _forward_log_odds(times, joints, skeleton)
    # joints on the midline are their own mirror image: their difference is 0
    similarity = _cosine_similarity(joints - joints[:, flip], variance + variance[:, flip])
    turn_cost = _TURN * np.minimum(1.0, np.exp((_TURN_STEP - np.diff(times)) / _TURN_TIME)) * similarity
    costs, backpointers = np.array([0.0, log_odds[0]]), np.zeros((len(times), 2), int)
    for row in range(1, len(times)):
        # [state before, state now]
        total = costs[:, None] + turn_cost[row - 1] * (1 - np.eye(2))
        backpointers[row] = total.argmin(0)
        costs = total.min(0) + [0, log_odds[row]]
    is_swapped = np.zeros(len(times), bool)
    state = int(costs.argmin())
    for row in range(len(times))[::-1]:
        is_swapped[row] = state
        state = backpointers[row, state]
    return is_swapped


def _cosine_similarity(offsets: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """(T - 1,) in [-1, 1]: similarity of a frame's right-to-left vectors (T, J, 3) m to those of the one before."""
    weight = 1 / np.sqrt(variance[1:] * variance[:-1])
    product = (weight * (offsets[1:] * offsets[:-1]).sum(-1)).sum(-1)
    previous_square, current_square = ((weight * (part**2).sum(-1)).sum(-1) for part in (offsets[:-1], offsets[1:]))
    return product / np.maximum(np.sqrt(previous_square * current_square), 1e-12)


def _forward_log_odds(times: np.ndarray, joints: np.ndarray, skeleton: Skeleton) -> np.ndarray:
    """(T,) log odds that a frame is not flipped, from the direction in which the person moves."""
    pairs = [(name, f"right_{part}") for name in skeleton.joints if (part := name.removeprefix("left_")) in _ACROSS]
    if not pairs or len(times) < 2:
        return np.zeros(len(times))
    x, y = sum(joints[:, skeleton.index(a), :2] - joints[:, skeleton.index(b), :2] for a, b in pairs).T
    velocity = np.gradient(np.median(joints[..., :2], 1), times, axis=0)
    speed = (velocity[:, 0] * y - velocity[:, 1] * x) / np.maximum(np.hypot(x, y), 1e-6)
    return _FORWARD * speed / np.hypot(speed, _WALK)
