"""Bones that keep their length: estimated over a track, then kept in each frame.

Legend: T frames, J joints, E bones.
"""

import numpy as np

from lidarpose.skeleton import BODY26, Skeleton

# rounds over all bones
_ROUNDS = 10
# a joint's expected place is pulled towards where it may be elsewhere, which shortens bones: share of the ends' variance
# that a squared length is short of
_SHORT = 0.1
# frames count by the inverse variance to this power
_POWER = 1.5


def rigid_bones(skeleton: Skeleton) -> np.ndarray:
    """(E, 2) pairs of joints whose distance does not change when a person moves: bones that are bones of SMPL's tree
    too, and the hips; of skeletons with joints of other names the limbs that they share with it."""
    pairs = [(BODY26.joints[parent], child) for child, parent in zip(BODY26.joints, BODY26.parents, strict=True)]
    pairs = [*pairs[1:], ("left_hip", "right_hip"), ("nose", "head_center")]
    at = {name: i for i, name in enumerate(skeleton.joints)}
    return np.array([(at[a], at[b]) for a, b in pairs if a in at and b in at], int).reshape(-1, 2)


def bone_lengths(joints: np.ndarray, variance: np.ndarray, bones: np.ndarray, flip: np.ndarray) -> np.ndarray:
    """(E,) m: lengths of bones (E, 2) over frames of joints (T, J, 3) m with variance (T, J) m^2, the same left and
    right. flip: as in `Skeleton`."""
    squared = ((joints[:, bones[:, 0]] - joints[:, bones[:, 1]]) ** 2).sum(-1)
    ends = variance[:, bones[:, 0]] + variance[:, bones[:, 1]]
    weight = ends**-_POWER
    total = weight.sum(0)
    lengths = np.sqrt((weight * (squared + _SHORT * ends)).sum(0) / total)
    sorted_bones = [tuple(sorted(bone)) for bone in bones.tolist()]
    across = [sorted_bones.index(tuple(sorted(pair))) for pair in flip[bones].tolist()]
    return (total * lengths + total[across] * lengths[across]) / (total + total[across])


def keep_lengths(joints: np.ndarray, variance: np.ndarray, bones: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Joints (..., J, 3) m moved so that bones (E, 2) have lengths (E,) m; those of large variance (..., J) move most
    (position-based dynamics: Mueller et al. 2007)."""
    joints = joints.copy()
    for _ in range(_ROUNDS):
        for (a, b), length in zip(bones.tolist(), lengths, strict=True):
            bone = joints[..., b, :] - joints[..., a, :]
            now = np.maximum(np.linalg.norm(bone, axis=-1), 1e-6)
            change = bone * ((now - length) / now / (variance[..., a] + variance[..., b]))[..., None]
            joints[..., a, :] += variance[..., a, None] * change
            joints[..., b, :] -= variance[..., b, None] * change
    return joints
