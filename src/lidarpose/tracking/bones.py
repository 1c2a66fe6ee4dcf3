"""Bones that keep their length: estimated over a track, then kept in each frame.

Legend: T frames, J joints, E bones.
"""

import numpy as np

from lidarpose.skeleton import BODY26, Skeleton

# rounds over all bones, of a track and of a single frame
_ROUNDS, _LIVE_ROUNDS = 15, 3
# a joint's expected place is pulled towards where it may be elsewhere, which shortens bones: a squared length lacks so
# much of the ends' variance
_SHORT = 0.1
# frames count by the inverse variance to this power
_POWER = 2.0


def rigid_bones(skeleton: Skeleton) -> np.ndarray:
    """(E, 2) pairs of joints whose distance does not change when a person moves: bones that are bones of SMPL's tree
    too, and the hips; of skeletons with joints of other names the limbs that they share with it."""
    pairs = [(BODY26.joints[parent], child) for child, parent in zip(BODY26.joints, BODY26.parents, strict=True)]
    pairs = [*pairs[1:], ("left_hip", "right_hip"), ("nose", "head_center")]
    joint_index = {name: i for i, name in enumerate(skeleton.joints)}
    return np.array(
        [(joint_index[a], joint_index[b]) for a, b in pairs if a in joint_index and b in joint_index], int
    ).reshape(-1, 2)


def length_statistics(joints: np.ndarray, variance: np.ndarray, bones: np.ndarray) -> np.ndarray:
    """(..., E, 2) of joints (..., J, 3) m with variance (..., J) m^2: what a frame says of the squared length of each
    bone (E, 2), times its weight, and the weight. Sums over frames are what `lengths_of` takes."""
    squared = ((joints[..., bones[:, 0], :] - joints[..., bones[:, 1], :]) ** 2).sum(-1)
    end_variance = variance[..., bones[:, 0]] + variance[..., bones[:, 1]]
    weight = end_variance**-_POWER
    return np.stack([weight * (squared + _SHORT * end_variance), weight], -1)


def lengths_of(total: np.ndarray, bones: np.ndarray, flip: tuple[int, ...]) -> np.ndarray:
    """(E,) m: lengths of bones (E, 2), the same left and right, from a sum (E, 2) of `length_statistics`. flip: as in
    `Skeleton`."""
    bone_index = {frozenset(bone): i for i, bone in enumerate(bones.tolist())}
    mirror_index = [bone_index[frozenset((flip[a], flip[b]))] for a, b in bones.tolist()]
    squared, weight = (total + total[mirror_index]).T
    return np.sqrt(squared / weight)


def keep_lengths(joints: np.ndarray, variance: np.ndarray, bones: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Joints (..., J, 3) m moved so that bones (E, 2) have lengths (E,) m; those of large variance (..., J) move most
    (position-based dynamics: Mueller et al. 2007)."""
    joints = joints.copy()
    for _ in range(_ROUNDS if joints.ndim > 2 else _LIVE_ROUNDS):
        for (a, b), length in zip(bones.tolist(), lengths, strict=True):
            bone = joints[..., b, :] - joints[..., a, :]
            current_length = np.maximum(np.linalg.norm(bone, axis=-1), 1e-6)
            change = (
                bone * ((current_length - length) / current_length / (variance[..., a] + variance[..., b]))[..., None]
            )
            joints[..., a, :] += variance[..., a, None] * change
            joints[..., b, :] -= variance[..., b, None] * change
    return joints
