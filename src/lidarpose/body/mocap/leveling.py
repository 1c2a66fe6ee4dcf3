"""The up axis of a frame, estimated from the people in it: for a sensor that was not mounted level."""

import numpy as np

from lidarpose.geometry import rotation_between, unit
from lidarpose.skeleton import SMPL24

# minimum number of frames with upright people for an estimate of the up axis
LEAST_FRAMES = 100
# error bounds of the estimate, rad: if people face different directions, and if all face about the same direction, so
# that a forward lean cannot be told from a tilted frame (captured clips have errors of at most 3 and 9 degrees)
_DOUBT, _MORE_DOUBT = np.radians(3.0), np.radians(10.0)
# people face the same direction if the mean of their unit forward vectors is longer than this
_ONE_WAY = 0.8
# frames in which the trunk deviates more than this from the current up estimate are left out, cosine
_UPRIGHT = np.cos(np.radians(45.0))
# number of iterations of the estimate
_ROUNDS = 4
# prior of the forward lean, as a tangent, for people who never turn around; its weight, as a share of all frames
_LEAN, _TRUST = 0.1, 0.1


def up_of_people(joints: np.ndarray) -> tuple[np.ndarray, float] | None:
    """The up axis, a unit vector (3,), of the frame of people's smpl24 joints (n, 24, 3) m, and its error bound, rad.

    It is the mean trunk direction without the forward lean, which is estimated as the component that turns with the
    people. None if fewer than `LEAST_FRAMES` of the people stand upright.
    """
    positions = {
        name: joints[:, SMPL24.index(name)] for name in ("left_hip", "right_hip", "left_shoulder", "right_shoulder")
    }
    trunk = unit(
        positions["left_shoulder"] + positions["right_shoulder"] - positions["left_hip"] - positions["right_hip"]
    )
    # the cross product of a person's left and up directions points forward
    forward = unit(np.cross(positions["left_hip"] - positions["right_hip"], trunk))
    up = unit(trunk.mean(0))
    for _ in range(_ROUNDS):
        is_upright = trunk @ up > _UPRIGHT
        if is_upright.sum() < LEAST_FRAMES:
            return None
        t, f = trunk[is_upright], forward[is_upright]
        # least-squares fit of t = up + lean * f, with a prior on the lean that decides if all face the same direction
        f_centered = f - f.mean(0)
        trust = _TRUST * len(f)
        lean = (((t - t.mean(0)) * f_centered).sum() + trust * _LEAN) / ((f_centered**2).sum() + trust)
        up = unit(t.mean(0) - lean * f.mean(0))
    return up, _MORE_DOUBT if np.linalg.norm(f.mean(0)) > _ONE_WAY else _DOUBT


def leveling(joints: np.ndarray) -> np.ndarray | None:
    """R_level_sensor (3, 3), the smallest rotation that makes z the up axis, from joints as in `up_of_people`; None if
    the frame is level within the error bound, or if too few people are upright."""
    estimate = up_of_people(joints)
    if estimate is None or estimate[0][2] > np.cos(estimate[1]):
        return None
    return rotation_between(estimate[0], np.array([0.0, 0.0, 1.0]))
