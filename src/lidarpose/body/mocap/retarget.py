"""Joint positions of any captured skeleton -> rotations of the body's 24 bones.

A body part's frame is built from positions alone, the same way in the source and in our rest pose: F (3, 3), columns
its axes. The bone's global rotation is then G = F_source F_rest^-1, and its local one R = G_parent^-1 G.

The rest pose of `rig`: T-pose, x forward, y left, z up; G_root = R_root, G_j = G_parent R_j,
position_j = position_parent + G_parent (rest_j - rest_parent).
"""

from functools import cache

import numpy as np

from lidarpose.errors import InputError
from lidarpose.geometry import axis_angle_to_matrix, rotation_about, rotation_between, unit
from lidarpose.skeleton import SMPL24

# bend (sine of the angle between the bones) under which a hinge's normal counts for nothing, and over which for all
_BEND_FADE = (0.10, 0.35)
# how much more bend the other way round is taken for a joint stretched too far: a hip turns less than a shoulder
_KNEE_OVERSTRETCH, _ELBOW_OVERSTRETCH = 0.25, 0.07
# collars nearer to each other than this share of the shoulders' distance are taken for a single point
_LEAST_COLLAR_WIDTH = 0.15
_ADULT = 18  # years
# bones under this have no direction, m
SHORTEST_BONE = 1e-4

_ARM, _LEG = ("shoulder", "elbow", "wrist", "hand"), ("hip", "knee", "ankle", "foot")
_J = {name: i for i, name in enumerate(SMPL24.joints)}
# the lines whose directions the frames are made of
_LINES = [("spine3", "neck"), ("right_hip", "left_hip"), ("right_shoulder", "left_shoulder")]
for _side in ("left", "right"):
    for _chain in (("collar", *_ARM), _LEG):
        _LINES += [(f"{_side}_{a}", f"{_side}_{b}") for a, b in zip(_chain, _chain[1:], strict=False)]


def retarget_positions(joints: np.ndarray, rest: np.ndarray | None = None) -> np.ndarray:
    """Local rotations that give the body the pose of captured joints.

    The heading of the source stays in the root (`without_yaw` removes it). The twist of the head about the neck and of
    a straight limb cannot be seen in positions: they follow the parent (a straight leg follows its foot).

    Args:
        joints: (n, 24, 3) m, SMPL's joints in SMPL's order, z up, any facing and any bone lengths.
        rest: (24, 3) m, the joints of the T-pose to be turned, by default the mean adult's.

    Returns:
        (n, 24, 3, 3) float32, in the rest frame of `body.rig`.

    Raises:
        InputError: For another shape, values that are not finite and limbs without length.
    """
    joints = np.asarray(joints, float)
    if joints.ndim != 3 or joints.shape[1:] != (24, 3):
        raise InputError(f"joints must be (n, 24, 3), SMPL's joints in meters, got {joints.shape}")
    if not np.isfinite(joints).all():
        raise InputError("joints must be finite numbers; drop or fill the missing ones before retargeting")
    length, which = shortest_bone(joints)
    if (length <= SHORTEST_BONE).any():
        first = int(np.argmax(length <= SHORTEST_BONE))
        raise InputError(f"{which[first]} has no length in frame {first}: a bone without length has no direction")
    rest = np.asarray(mean_adult_joints() if rest is None else rest, float)[None]

    turn = np.empty((len(joints), 24, 3, 3))  # global rotations G
    trunk = _trunk(joints, rest)
    for name, value in zip(("pelvis", "spine1", "spine2", "spine3"), trunk, strict=True):
        turn[:, _J[name]] = value
    pelvis, torso = trunk[0], trunk[3]

    shoulders = np.zeros((len(joints), 3))  # ours, their middle seen from spine3
    for side, sign in (("left", 1.0), ("right", -1.0)):
        collar = _swing(torso, f"{side}_collar", f"{side}_shoulder", joints, rest)
        # elbows bend about -z (left) or +z (right) at rest, knees about +y
        arm, leg = ([f"{side}_{name}" for name in chain] for chain in (_ARM, _LEG))
        arm_turns = _limb(collar, arm, np.array([0.0, 0.0, -sign]), _ELBOW_OVERSTRETCH, joints, rest)
        leg_turns = _limb(pelvis, leg, np.array([0.0, 1.0, 0.0]), _KNEE_OVERSTRETCH, joints, rest)
        for name, value in zip((f"{side}_collar", *arm, *leg), (collar, *arm_turns, *leg_turns), strict=True):
            turn[:, _J[name]] = value
        shoulders += _carried(torso, _bone(rest, "spine3", f"{side}_collar")) / 2
        shoulders += _carried(collar, _bone(rest, f"{side}_collar", f"{side}_shoulder")) / 2
    turn[:, _J["neck"]] = turn[:, _J["head"]] = _head(torso, shoulders, joints, rest)

    local = turn.copy()
    parents = np.array(SMPL24.parents[1:])
    local[:, 1:] = np.swapaxes(turn[:, parents], -1, -2) @ turn[:, 1:]
    return local.astype(np.float32)


def shortest_bone(joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of joints (n, 24, 3): the length (n,) m of the shortest line that retargeting needs, and which (n,) it is."""
    lengths = np.stack([np.linalg.norm(_bone(joints, a, b), axis=-1) for a, b in _LINES])
    which = lengths.argmin(0)
    return lengths.min(0), np.array([f"{a} -> {b}" for a, b in _LINES])[which]


def heading(rotations: np.ndarray) -> np.ndarray:
    """Yaw (n,) rad of poses (n, 24, 3, 3): the part of the root's rotation that is about z (swing-twist)."""
    root = rotations[:, 0]
    return np.arctan2(root[:, 1, 0] - root[:, 0, 1], root[:, 0, 0] + root[:, 1, 1])


def without_yaw(rotations: np.ndarray) -> np.ndarray:
    """The same poses (n, 24, 3, 3) with the root turned about z so that they face +x: `heading` is 0."""
    rotations = np.array(rotations)
    rotations[:, 0] = rotation_about("z", -heading(rotations)) @ rotations[:, 0]
    return rotations


@cache
def mean_adult_joints() -> np.ndarray:
    """(24, 3) m: the joints of the shipped body's mean adult in the T-pose, SMPL's order; read-only."""
    from lidarpose.body.rig import load_rig

    rig = load_rig()
    mean = rig.coefficients[rig.age >= _ADULT].mean(0, keepdims=True)
    joints = rig.rest(mean).joints[0, : len(SMPL24)].astype(float)
    joints.flags.writeable = False
    return joints


def _bone(joints: np.ndarray, start: str, end: str) -> np.ndarray:
    return joints[:, _J[end]] - joints[:, _J[start]]


def _frame(along: np.ndarray, hint: np.ndarray) -> np.ndarray:
    """Axes (n, 3, 3), columns: `along`, the part of `hint` across it, their cross product."""
    first = unit(along)
    second = unit(hint - (hint * first).sum(-1, keepdims=True) * first)
    return np.stack([first, second, np.cross(first, second)], -1)


def _turn(along: np.ndarray, hint: np.ndarray, rest_along: np.ndarray, rest_hint: np.ndarray) -> np.ndarray:
    return _frame(along, hint) @ np.swapaxes(_frame(rest_along, rest_hint), -1, -2)


def _middle(joints: np.ndarray, name: str) -> np.ndarray:
    return (joints[:, _J[f"left_{name}"]] + joints[:, _J[f"right_{name}"]]) / 2


def _carried(turn: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """turn (n, 3, 3) applied to offset (1, 3) -> (n, 3)."""
    return turn @ offset[0]


def _trunk(joints: np.ndarray, rest: np.ndarray) -> list[np.ndarray]:
    """Global rotations of pelvis and spine1-3: the bend is shared evenly, the line hips -> neck is the source's."""
    pelvis, torso = (frame(joints) @ np.swapaxes(frame(rest), -1, -2) for frame in (_pelvis_frame, _torso_frame))
    across = rotation_vector(np.swapaxes(pelvis, -1, -2) @ torso)
    turns = [pelvis, *(pelvis @ axis_angle_to_matrix(share * across) for share in (1 / 3, 2 / 3)), torso]
    # spines are curved and cut differently in every skeleton, the line from the hips to the neck is not
    line = _carried(pelvis, rest[:, _J["spine1"]] - _middle(rest, "hip"))
    for turn, start, end in zip(turns[1:], ("spine1", "spine2", "spine3"), ("spine2", "spine3", "neck"), strict=True):
        line = line + _carried(turn, _bone(rest, start, end))
    fix = rotation_between(line, joints[:, _J["neck"]] - _middle(joints, "hip"))
    return [fix @ turn for turn in turns]


def _head(torso: np.ndarray, shoulders: np.ndarray, joints: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """The neck's global rotation: the head in the source's direction from the middle of the shoulders.

    The bone neck -> head is too short and too differently cut for its own direction to be of use.
    """
    reach = np.linalg.norm(rest[:, _J["head"]] - _middle(rest, "shoulder"))
    head = shoulders + reach * unit(joints[:, _J["head"]] - _middle(joints, "shoulder"))
    neck = _carried(torso, _bone(rest, "spine3", "neck"))
    return rotation_between(_carried(torso, _bone(rest, "neck", "head")), head - neck) @ torso


def _pelvis_frame(joints: np.ndarray) -> np.ndarray:
    return _frame(_bone(joints, "right_hip", "left_hip"), joints[:, _J["spine3"]] - _middle(joints, "hip"))


def _torso_frame(joints: np.ndarray) -> np.ndarray:
    shoulders, collars = (_bone(joints, f"right_{name}", f"left_{name}") for name in ("shoulder", "collar"))
    width = np.linalg.norm(collars, axis=-1, keepdims=True) / np.linalg.norm(shoulders, axis=-1, keepdims=True)
    # the collars are rigid with the chest and the shoulders are not, but some skeletons put both collars in one point
    across = np.where(width > _LEAST_COLLAR_WIDTH, collars, shoulders)
    up = _bone(joints, "spine3", "neck")
    return _frame(up, across)


def _swing(parent: np.ndarray, start: str, end: str, joints: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """The parent's rotation (n, 3, 3) plus the smallest turn that gives the bone start -> end its direction."""
    return rotation_between(_carried(parent, _bone(rest, start, end)), _bone(joints, start, end)) @ parent


def _hinge(first: np.ndarray, second: np.ndarray, straight: np.ndarray, overstretch: float) -> np.ndarray:
    """The axis (n, 3) about which `second` is bent from `first`, `straight` where the joint is straight.

    A small bend the other way round than `straight` is a joint stretched too far; a larger one, over `overstretch`
    (a sine) more, is a limb that is rotated that far. In between the axis changes without a jump.
    """
    first, second, straight = unit(first), unit(second), unit(straight)
    normal = np.cross(first, second)
    # the sine falls again beyond a right angle, where the bend is as plain as can be
    bend = np.where((first * second).sum(-1) > 0, np.linalg.norm(normal, axis=-1), 1.0)[:, None]
    normal = unit(normal)
    against = np.clip(-(normal * straight).sum(-1, keepdims=True), 0, 1)
    low, high = _BEND_FADE
    weight = np.clip((bend - low - overstretch * against) / (high - low), 0, 1)
    # evenly from one to the other; where they are opposite, about the limb
    about = np.cross(straight, normal)
    sine = np.linalg.norm(about, axis=-1, keepdims=True)
    angle = np.arctan2(sine, (straight * normal).sum(-1, keepdims=True))
    about = np.where(sine > 1e-6, unit(about), first)
    return (axis_angle_to_matrix(weight * angle * about) @ straight[..., None])[..., 0]


def _limb(
    parent: np.ndarray, names: list[str], hinge: np.ndarray, overstretch: float, joints: np.ndarray, rest: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Global rotations of a limb's four joints, named; the last goes with the one before. parent (n, 3, 3): of what it
    hangs on; hinge (3,): the axis that its second joint bends about at rest; overstretch: see `_hinge`."""
    bones, rests = ([_bone(j, a, b) for a, b in zip(names[:-1], names[1:], strict=True)] for j in (joints, rest))
    straight = _swing(parent, names[0], names[1], joints, rest) @ hinge
    if names[0].endswith("hip"):
        # where the leg is straight its foot says about what; short where the foot is stretched along the shank
        straight = straight + 2 * np.cross(unit(bones[2]), unit(bones[1]))
    axis = _hinge(bones[0], bones[1], straight, overstretch)
    upper, lower = (_turn(bones[k], axis, rests[k], hinge[None]) for k in (0, 1))
    end = _swing(lower, names[2], names[3], joints, rest)
    return upper, lower, end, end


def rotation_vector(matrix: np.ndarray) -> np.ndarray:
    """The inverse of `axis_angle_to_matrix` for angles under pi. (n, 3, 3) -> (n, 3) rad."""
    skew = np.stack(
        [matrix[:, 2, 1] - matrix[:, 1, 2], matrix[:, 0, 2] - matrix[:, 2, 0], matrix[:, 1, 0] - matrix[:, 0, 1]], -1
    )
    sine = np.linalg.norm(skew, axis=-1, keepdims=True) / 2
    angle = np.arctan2(sine, (np.trace(matrix, axis1=1, axis2=2)[:, None] - 1) / 2)
    return unit(skew) * angle
