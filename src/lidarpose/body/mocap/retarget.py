"""Joint positions of any captured skeleton, in any unit -> motion of the body: rotations of its 24 bones.

A body part's frame F (3, 3), columns its axes, is built from positions alone, in the same way for the source and the
rest pose. The bone's global rotation is then G = F_source F_rest^-1, and its local one R = G_parent^-1 G.

The rest pose of `rig`: T-pose, x forward, y left, z up; G_root = R_root, G_j = G_parent R_j,
position_j = position_parent + G_parent (rest_j - rest_parent).
"""

import os
from collections.abc import Sequence

import numpy as np

from lidarpose.body.mocap.motion import Motion, load_clips, standing_axis, usable_clips
from lidarpose.body.rig import forward_kinematics, mean_adult_joints
from lidarpose.geometry import axis_angle_to_matrix, rotation_between, rotation_from_up, rotation_vector, unit
from lidarpose.io.files import file_error
from lidarpose.skeleton import SMPL24

# bend (sine of the angle between the bones) below which a hinge's normal is ignored, and above which it has full weight
_BEND_FADE = (0.10, 0.35)
# extra bend (sine) in the wrong direction that still counts as hyperextension; a hip rotates less than a shoulder
_KNEE_OVERSTRETCH, _ELBOW_OVERSTRETCH = 0.25, 0.07
# collars closer together than this fraction of the shoulder distance are treated as one point
_LEAST_COLLAR_WIDTH = 0.15
# shorter bones have no usable direction, m
_SHORTEST_BONE = 1e-4

# meters per unit of a file: meters, centimeters, millimeters, inches, and CMU's unit (inches / 0.45)
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254, "inch/0.45": 0.0254 / 0.45}
# limits of a person's size relative to the mean adult
_SMALLEST, _LARGEST = 0.4, 1.45
_TYPICAL = 0.85  # between children and tall adults, to distinguish inches from centimeters for both
_UNEVEN = 2.0  # a larger ratio of the leg lengths means that the legs are not in one unit
_FASTEST = 50.0  # m/s
_FARTHEST = 1e5  # m

_ARM, _LEG = ("shoulder", "elbow", "wrist", "hand"), ("hip", "knee", "ankle", "foot")
_J = {name: i for i, name in enumerate(SMPL24.joints)}
_HIPS = [_J["left_hip"], _J["right_hip"]]
# pairs of joints whose directions define the frames
_LINES = [("spine3", "neck"), ("right_hip", "left_hip"), ("right_shoulder", "left_shoulder")]
for _side in ("left", "right"):
    for _chain in (("collar", *_ARM), _LEG):
        _LINES += [(f"{_side}_{a}", f"{_side}_{b}") for a, b in zip(_chain, _chain[1:], strict=False)]


def load_clip_positions(path: str | os.PathLike, *, up: str | None = None, fps: float | None = None) -> Motion:
    """The motion of a clips file (`body.mocap.motion`); z is up unless `up` says otherwise."""
    joints, names, length, file_fps = load_clips(path)
    fps = fps or file_fps
    return motion_from_joints(path, joints, names, length, fps=fps, up=up or "z", kind="joint positions", unit_m=1.0)


def motion_from_joints(
    path: object,
    joints: np.ndarray,
    names: Sequence[str],
    length: Sequence[int] | np.ndarray,
    *,
    fps: float,
    up: str | None,
    kind: str,
    unit_m: float | None = None,
    number: np.ndarray | None = None,
) -> Motion:
    """The body's motion from joint positions. The middle of the hips is matched, not the pelvis: the pelvis's position
    relative to the hips differs between skeletons.

    Args:
        joints: (F, 24, 3) SMPL's joints in the file's unit and axes, NaN in frames without joints. Such frames and
            frames with a bone of zero length are dropped.
        names, length: Names and lengths of the clips, which follow each other in `joints`.
        up: The up axis, by default the axis along which people stand, or y if they do not stand.
        unit_m: Meters per unit of the file, by default the unit that gives the most typical body size.
        number: (F,) frame numbers in the recording, by default without gaps.

    Raises:
        InputError: For implausible sizes or speeds, upside-down people, or too many unusable frames.
    """
    is_usable = np.isfinite(joints).all((1, 2))
    if not is_usable.any():
        raise file_error(path, "expected finite joint positions, got none in any frame")
    with np.errstate(over="ignore", invalid="ignore"):
        joints = joints * meters_per_unit(path, joints[is_usable], unit_m)
    if not np.abs(joints[is_usable]).max() < _FARTHEST:
        raise file_error(path, "joints lie farther than 100 km from the origin; expected one unit throughout")
    joints = joints @ rotation_from_up(up or _up_axis(path, joints[is_usable])).T
    is_usable[is_usable] = _shortest_bone(joints[is_usable]) > _SHORTEST_BONE
    clips = usable_clips(path, names, length, is_usable, fps, number)
    joints = joints[is_usable]
    _check_speed(path, joints, clips["length"], fps)
    rotations = retarget_positions(joints)
    body = mean_adult_joints()[None].astype(np.float32), rotations, np.zeros((len(joints), 3), np.float32)
    origin_joints = forward_kinematics(SMPL24.parents, *body)[1]
    translation = _hips_of_mean_adult(joints, clips["length"]) - origin_joints[:, _HIPS].mean(1)
    return Motion(rotations=rotations, translation=translation.astype(np.float32), source=f"{kind}: {path}", **clips)


def _hips_of_mean_adult(joints: np.ndarray, length: Sequence[int]) -> np.ndarray:
    """The middle of the hips (F, 3) m of joints (F, 24, 3) m; each clip's path is scaled about its middle by the mean
    adult's leg length over the recorded person's: with the same rotations and other legs, feet would slide."""
    mean_length = _leg_length(mean_adult_joints()[None])
    hips = joints[:, _HIPS].mean(1)
    for end, count in zip(np.cumsum(length), length, strict=True):
        path = hips[end - count : end, :2]
        path[:] = path.mean(0) + (path - path.mean(0)) * (mean_length / _leg_length(joints[end - count : end]))
    return hips


def _leg_length(joints: np.ndarray) -> float:
    """Median length of both legs, m."""
    return (_median_length(joints, "left_") + _median_length(joints, "right_")) / 2


def meters_per_unit(path: object, joints: np.ndarray, unit_m: float | None = None) -> float:
    """Meters per unit of SMPL's joints (F, 24, 3): `unit_m`, or the unit that gives the most typical body size.
    Raises InputError for implausible body sizes and for legs of different lengths."""
    left, right, trunk = (_median_length(joints, part) for part in ("left_", "right_", "trunk"))
    if not (np.isfinite([left, right, trunk]).all() and min(left, right, trunk) > 0):
        raise file_error(path, "the legs or the trunk have no length; expected the offsets of a person's bones")
    if max(left, right) > _UNEVEN * min(left, right):
        raise file_error(path, f"the left leg is {left:.4g} long, the right {right:.4g}; expected one unit throughout")
    rest_joints = mean_adult_joints()[None]
    ratio = ((left + right) / 2 + trunk) / (_median_length(rest_joints, "left_") + _median_length(rest_joints, "trunk"))
    scale = unit_m or min(UNITS.values(), key=lambda m: abs(np.log(ratio * m / _TYPICAL)))
    if not _SMALLEST < ratio * scale < _LARGEST:
        remedy = f"known units are {', '.join(UNITS)}: scale the skeleton to one of them"
        if unit_m:
            remedy = f"a number is read as {unit_m:.4g} m: scale the recording to that"
        raise file_error(path, f"the person is {ratio * scale:.3g} times as tall as an adult; {remedy}")
    return scale


def _median_length(joints: np.ndarray, part: str) -> float:
    """Median length of a leg, or of the trunk: the line hips -> neck -> head."""
    if part == "trunk":
        line = [joints[:, _HIPS[0]] / 2 + joints[:, _HIPS[1]] / 2, joints[:, _J["neck"]], joints[:, _J["head"]]]
    else:
        line = [joints[:, _J[part + name]] for name in ("hip", "knee", "ankle")]
    return float(sum(np.median(np.linalg.norm(b - a, axis=-1)) for a, b in zip(line, line[1:], strict=False)))


def _up_axis(path: object, joints: np.ndarray) -> str:
    axis = standing_axis(unit(joints[:, _J["neck"]] - joints[:, _HIPS].mean(1))) or "y"
    if axis.startswith("-"):
        remedy = f"give load_motion up={axis!r}, or up={axis[1:]!r} if they are upside down"
        raise file_error(path, f"people stand along {axis}; {remedy}")
    return axis


def _check_speed(path: object, joints: np.ndarray, length: np.ndarray, fps: float) -> None:
    """Raises InputError for an implausible median speed of joints (F, 24, 3) m in clips of `length` (C,) frames."""
    steps = np.linalg.norm(np.diff(joints[:, _J["pelvis"]], axis=0), axis=-1) * fps
    # drop the steps between clips
    steps = np.delete(steps, np.cumsum(length)[:-1] - 1)
    if len(steps) and np.median(steps) > _FASTEST:
        raise file_error(
            path, f"people move at {np.median(steps):.4g} m/s: are positions and bones in one unit, and is fps right?"
        )


def retarget_positions(joints: np.ndarray) -> np.ndarray:
    """Local rotations that give the mean adult the pose of captured joints.

    The source's heading stays in the root (`without_yaw` removes it). Positions do not determine the twist of the head
    about the neck or of a straight limb: these follow the parent, except that a straight leg follows its foot.

    Args:
        joints: (n, 24, 3) m, SMPL's joints in SMPL's order, z up, finite, any heading, any bone lengths above 0.

    Returns:
        (n, 24, 3, 3) float32, in the rest frame of `body.rig`.
    """
    joints = np.asarray(joints, float)
    rest_joints = mean_adult_joints()[None]

    global_rotations = np.empty((len(joints), 24, 3, 3))  # G
    trunk = _trunk(joints, rest_joints)
    for name, rotation in zip(("pelvis", "spine1", "spine2", "spine3"), trunk, strict=True):
        global_rotations[:, _J[name]] = rotation
    pelvis, torso = trunk[0], trunk[3]

    shoulders = np.zeros((len(joints), 3))  # middle of the body's own shoulders, relative to spine3
    for side, sign in (("left", 1.0), ("right", -1.0)):
        collar = _swing(torso, f"{side}_collar", f"{side}_shoulder", joints, rest_joints)
        # elbows bend about -z (left) or +z (right) at rest, knees about +y
        arm, leg = ([f"{side}_{name}" for name in chain] for chain in (_ARM, _LEG))
        arm_turns = _limb(collar, arm, np.array([0.0, 0.0, -sign]), _ELBOW_OVERSTRETCH, joints, rest_joints)
        leg_turns = _limb(pelvis, leg, np.array([0.0, 1.0, 0.0]), _KNEE_OVERSTRETCH, joints, rest_joints)
        for name, rotation in zip((f"{side}_collar", *arm, *leg), (collar, *arm_turns, *leg_turns), strict=True):
            global_rotations[:, _J[name]] = rotation
        shoulders += _carried(torso, _bone(rest_joints, "spine3", f"{side}_collar")) / 2
        shoulders += _carried(collar, _bone(rest_joints, f"{side}_collar", f"{side}_shoulder")) / 2
    global_rotations[:, _J["neck"]] = global_rotations[:, _J["head"]] = _head(torso, shoulders, joints, rest_joints)

    local_rotations = global_rotations.copy()
    parents = np.array(SMPL24.parents[1:])
    local_rotations[:, 1:] = np.swapaxes(global_rotations[:, parents], -1, -2) @ global_rotations[:, 1:]
    return local_rotations.astype(np.float32)


def _shortest_bone(joints: np.ndarray) -> np.ndarray:
    """Length (n,) m of the shortest bone that retargeting needs, for joints (n, 24, 3)."""
    return np.min([np.linalg.norm(_bone(joints, a, b), axis=-1) for a, b in _LINES], axis=0)


def _bone(joints: np.ndarray, start: str, end: str) -> np.ndarray:
    return joints[:, _J[end]] - joints[:, _J[start]]


def _frame(axis: np.ndarray, hint: np.ndarray) -> np.ndarray:
    """Frames (n, 3, 3), columns: `axis`, the component of `hint` perpendicular to it, and their cross product."""
    first_axis = unit(axis)
    second_axis = unit(hint - (hint * first_axis).sum(-1, keepdims=True) * first_axis)
    return np.stack([first_axis, second_axis, np.cross(first_axis, second_axis)], -1)


def _turn(axis: np.ndarray, hint: np.ndarray, rest_axis: np.ndarray, rest_hint: np.ndarray) -> np.ndarray:
    return _frame(axis, hint) @ np.swapaxes(_frame(rest_axis, rest_hint), -1, -2)


def _middle(joints: np.ndarray, name: str) -> np.ndarray:
    return (joints[:, _J[f"left_{name}"]] + joints[:, _J[f"right_{name}"]]) / 2


def _carried(rotation: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """rotation (n, 3, 3) applied to offset (1, 3) -> (n, 3)."""
    return rotation @ offset[0]


def _trunk(joints: np.ndarray, rest_joints: np.ndarray) -> list[np.ndarray]:
    """Global rotations of pelvis and spine1-3: the bend is distributed evenly, hips -> neck points as in the source."""
    pelvis, torso = (frame(joints) @ np.swapaxes(frame(rest_joints), -1, -2) for frame in (_pelvis_frame, _torso_frame))
    bend = rotation_vector(np.swapaxes(pelvis, -1, -2) @ torso)
    rotations = [pelvis, *(pelvis @ axis_angle_to_matrix(share * bend) for share in (1 / 3, 2 / 3)), torso]
    # skeletons differ in the curvature and joints of the spine, but not in the line from the hips to the neck
    hips_to_neck = _carried(pelvis, rest_joints[:, _J["spine1"]] - _middle(rest_joints, "hip"))
    for rotation, start, end in zip(
        rotations[1:], ("spine1", "spine2", "spine3"), ("spine2", "spine3", "neck"), strict=True
    ):
        hips_to_neck = hips_to_neck + _carried(rotation, _bone(rest_joints, start, end))
    correction = rotation_between(hips_to_neck, joints[:, _J["neck"]] - _middle(joints, "hip"))
    return [correction @ rotation for rotation in rotations]


def _head(torso: np.ndarray, shoulders: np.ndarray, joints: np.ndarray, rest_joints: np.ndarray) -> np.ndarray:
    """Global rotation of the neck that puts the head in the source's direction from the middle of the shoulders.

    The bone neck -> head is too short, and its ends differ too much between skeletons, for its direction to be usable.
    """
    head_distance = np.linalg.norm(rest_joints[:, _J["head"]] - _middle(rest_joints, "shoulder"))
    head = shoulders + head_distance * unit(joints[:, _J["head"]] - _middle(joints, "shoulder"))
    neck = _carried(torso, _bone(rest_joints, "spine3", "neck"))
    return rotation_between(_carried(torso, _bone(rest_joints, "neck", "head")), head - neck) @ torso


def _pelvis_frame(joints: np.ndarray) -> np.ndarray:
    return _frame(_bone(joints, "right_hip", "left_hip"), joints[:, _J["spine3"]] - _middle(joints, "hip"))


def _torso_frame(joints: np.ndarray) -> np.ndarray:
    shoulders, collars = (_bone(joints, f"right_{name}", f"left_{name}") for name in ("shoulder", "collar"))
    width_ratio = np.linalg.norm(collars, axis=-1, keepdims=True) / np.linalg.norm(shoulders, axis=-1, keepdims=True)
    # the collars are rigid with the chest, the shoulders are not; but some skeletons have both collars at one point
    lateral_axis = np.where(width_ratio > _LEAST_COLLAR_WIDTH, collars, shoulders)
    up = _bone(joints, "spine3", "neck")
    return _frame(up, lateral_axis)


def _swing(parent: np.ndarray, start: str, end: str, joints: np.ndarray, rest_joints: np.ndarray) -> np.ndarray:
    """The parent's rotation (n, 3, 3) and then the smallest one that gives the bone start -> end its direction."""
    return rotation_between(_carried(parent, _bone(rest_joints, start, end)), _bone(joints, start, end)) @ parent


def _hinge(upper: np.ndarray, lower: np.ndarray, straight_axis: np.ndarray, overstretch: float) -> np.ndarray:
    """The axis (n, 3) about which `lower` is bent from `upper`; `straight_axis` if the joint is straight.

    A small bend against the direction of `straight_axis` is hyperextension. If it is larger by more than `overstretch`
    (a sine), the limb is really rotated that far. In between, the axis changes continuously.
    """
    upper, lower, straight_axis = unit(upper), unit(lower), unit(straight_axis)
    normal = np.cross(upper, lower)
    # beyond a right angle the sine decreases although the bend is unambiguous: use 1
    bend_sine = np.where((upper * lower).sum(-1) > 0, np.linalg.norm(normal, axis=-1), 1.0)[:, None]
    normal = unit(normal)
    opposition = np.clip(-(normal * straight_axis).sum(-1, keepdims=True), 0, 1)
    low, high = _BEND_FADE
    weight = np.clip((bend_sine - low - overstretch * opposition) / (high - low), 0, 1)
    # interpolate evenly between the two axes; if they are opposite, rotate about the upper bone
    rotation_axis = np.cross(straight_axis, normal)
    sine = np.linalg.norm(rotation_axis, axis=-1, keepdims=True)
    angle = np.arctan2(sine, (straight_axis * normal).sum(-1, keepdims=True))
    rotation_axis = np.where(sine > 1e-6, unit(rotation_axis), upper)
    return (axis_angle_to_matrix(weight * angle * rotation_axis) @ straight_axis[..., None])[..., 0]


def _limb(
    parent: np.ndarray,
    names: list[str],
    hinge: np.ndarray,
    overstretch: float,
    joints: np.ndarray,
    rest_joints: np.ndarray,
) -> tuple[np.ndarray, ...]:
    """Global rotations of a limb's four joints `names`; the last equals the third. parent (n, 3, 3): rotation of the
    limb's parent; hinge (3,): bend axis of the second joint at rest; overstretch: see `_hinge`."""
    bones, rest_bones = (
        [_bone(j, a, b) for a, b in zip(names[:-1], names[1:], strict=True)] for j in (joints, rest_joints)
    )
    straight_axis = _swing(parent, names[0], names[1], joints, rest_joints) @ hinge
    if names[0].endswith("hip"):
        # the foot gives the axis of a straight leg; the product is short if the foot points along the shank
        straight_axis = straight_axis + 2 * np.cross(unit(bones[2]), unit(bones[1]))
    axis = _hinge(bones[0], bones[1], straight_axis, overstretch)
    upper, lower = (_turn(bones[k], axis, rest_bones[k], hinge[None]) for k in (0, 1))
    end = _swing(lower, names[2], names[3], joints, rest_joints)
    return upper, lower, end, end
