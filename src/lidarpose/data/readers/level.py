"""How far a standing sensor's frame is out of level, told by the people who walk before it."""

import numpy as np

from lidarpose.geometry import rotation_between, unit
from lidarpose.skeleton import SMPL24

# fewer frames say too little
LEAST_FRAMES = 100
# what the estimate may err by, rad: where people turn round, and where they all face about one way, so that leaning
# forwards looks like a frame out of level (of captured clips at most 3 and 9 degrees)
_DOUBT, _MORE_DOUBT = np.radians(3.0), np.radians(10.0)
# length of the mean of all that people face, beyond which they face one way
_ONE_WAY = 0.8
# who bends further than this away from what is up so far is left out, cosine
_UPRIGHT = np.cos(np.radians(45.0))
_ROUNDS = 4
# people lean forwards by about this much, as a tangent, where nobody turns round to show it; how many frames that is
# worth, as a share of all
_LEAN, _TRUST = 0.1, 0.1


def up_of_people(joints: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Which way is up, (3,) of length 1, in a frame in which people's smpl24 joints (n, 24, 3) m are given, and by what
    angle, rad, that may be wrong.

    The mean of the trunks, less what people lean forwards, which is found as the part that turns with them. None where
    fewer than `LEAST_FRAMES` of the people stand upright.
    """
    at = {name: joints[:, SMPL24.index(name)] for name in ("left_hip", "right_hip", "left_shoulder", "right_shoulder")}
    trunk = unit(at["left_shoulder"] + at["right_shoulder"] - at["left_hip"] - at["right_hip"])
    # a person's left times their up is forwards
    forward = unit(np.cross(at["left_hip"] - at["right_hip"], trunk))
    up = unit(trunk.mean(0))
    for _ in range(_ROUNDS):
        upright = trunk @ up > _UPRIGHT
        if upright.sum() < LEAST_FRAMES:
            return None
        t, f = trunk[upright], forward[upright]
        # t = up + lean * f: a line through both, drawn towards the usual lean where everybody faces one way
        turned = f - f.mean(0)
        trust = _TRUST * len(f)
        lean = (((t - t.mean(0)) * turned).sum() + trust * _LEAN) / ((turned**2).sum() + trust)
        up = unit(t.mean(0) - lean * f.mean(0))
    return up, _MORE_DOUBT if np.linalg.norm(f.mean(0)) > _ONE_WAY else _DOUBT


def leveling(joints: np.ndarray) -> np.ndarray | None:
    """R_level_sensor (3, 3), the smallest rotation that makes z up, from people's joints as `up_of_people` takes them;
    None where the frame is as level as can be told, or too few people say what is up."""
    found = up_of_people(joints)
    if found is None:
        return None
    up, doubt = found
    if up[2] > np.cos(doubt):
        return None
    return rotation_between(up, np.array([0.0, 0.0, 1.0]))
