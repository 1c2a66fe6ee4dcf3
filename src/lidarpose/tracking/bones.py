"""Bones of constant length: estimated over a track, then enforced in each frame.

Legend: T frames, J joints, E bones.
"""

import numpy as np

from lidarpose.skeleton import BODY26, Skeleton

# passes over all bones, for a track and for a single frame
_ROUNDS, _LIVE_ROUNDS = 15, 3
# predicted joints are pulled towards their other possible positions, which shortens bones: a squared length is too
# small by this multiple of the variance of its ends
_SHORT = 0.1
# frames are weighted by the inverse variance to this power
_POWER = 2.0


def rigid_bones(skeleton: Skeleton) -> np.ndarray:
    """(E, 2) pairs of joints with a constant distance when a person moves: the bones of body26's tree, the hips, and
    the nose with the center of the head; those whose joints the skeleton has, by name."""
    pairs = [(BODY26.joints[parent], child) for child, parent in zip(BODY26.joints, BODY26.parents, strict=True)]
    pairs = [*pairs[1:], ("left_hip", "right_hip"), ("nose", "head_center")]
    joint_index = {name: i for i, name in enumerate(skeleton.joints)}
    return np.array(
        [(joint_index[a], joint_index[b]) for a, b in pairs if a in joint_index and b in joint_index], int
    ).reshape(-1, 2)


def length_statistics(joints: np.ndarray, variance: np.ndarray, bones: np.ndarray) -> np.ndarray:
    """(..., E, 2) from joints (..., J, 3) m with variance (..., J) m^2: for each bone (E, 2) of a frame, the weighted
    squared length and the weight. `lengths_of` takes their sums over frames."""
    squared = ((joints[..., bones[:, 0], :] - joints[..., bones[:, 1], :]) ** 2).sum(-1)
    end_variance = variance[..., bones[:, 0]] + variance[..., bones[:, 1]]
    weight = end_variance**-_POWER
    return np.stack([weight * (squared + _SHORT * end_variance), weight], -1)


def lengths_of(total: np.ndarray, bones: np.ndarray, skeleton: Skeleton) -> np.ndarray:
    """(E,) m: lengths of bones (E, 2), equal for left and right if the skeleton has both, from a sum (E, 2) of
    `length_statistics`."""
    flip = skeleton.flip if skeleton.is_two_sided else range(len(skeleton))
    bone_index = {frozenset(bone): i for i, bone in enumerate(bones.tolist())}
    mirror_index = [bone_index[frozenset((flip[a], flip[b]))] for a, b in bones.tolist()]
    squared, weight = (total + total[mirror_index]).T
    return np.sqrt(squared / weight)


def keep_lengths(joints: np.ndarray, variance: np.ndarray, bones: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Moves joints (..., J, 3) m so that bones (E, 2) have lengths (E,) m; joints of large variance (..., J) move most
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
