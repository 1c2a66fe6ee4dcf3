"""Any captured skeleton: forward kinematics of a file's joint tree, and SMPL's 24 joints matched by name.

Joints are matched by the names that exporters commonly use. A spine without three distinct joints is resampled: its
joints go to the shipped body's fractions of the line hips -> neck. Missing hands, feet, collars, neck and pelvis are
estimated. All other joints are required.
"""

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose.body.mocap.motion import Motion, usable_clips
from lidarpose.body.mocap.retarget import motion_from_joints
from lidarpose.body.rig import mean_adult_joints
from lidarpose.geometry import rotation_about, unit
from lidarpose.io.files import file_error
from lidarpose.skeleton import SMPL24

_J = {name: i for i, name in enumerate(SMPL24.joints)}
_SPINE = ("spine1", "spine2", "spine3")
# spine joints closer than this fraction of the line hips -> neck count as one joint
_SAME_JOINT = 0.02

# names of joints without the side, the most specific first. A word may mean two joints ("foot"): each joint of the file
# is used once, in this order. Joints that exist left and right:
_SIDED = {
    "hip": ("upleg", "thigh", "upperleg", "femur", "hip"),
    "knee": ("knee", "lowerleg", "lowleg", "shin", "calf", "leg", "tibia"),
    "ankle": ("ankle", "foot"),
    "foot": ("toebase", "toe", "toes", "toe0", "ball", "foot"),
    "shoulder": ("upperarm", "uparm", "arm", "humerus", "shldr", "shoulder"),
    "elbow": ("elbow", "forearm", "lowerarm", "lowarm"),
    "wrist": ("wrist", "hand"),
    "hand": (
        "handmiddle1", "middle1", "middle01", "middle", "finger2", "fingerbase", "fingers", "inhandmiddle",
        "handindex1", "index1", "index01", "finger0", "hand",
    ),
    "collar": ("collar", "clavicle", "shoulder"),
}  # fmt: skip
_CENTRAL = {
    "pelvis": ("hips", "hip", "pelvis", "root"),
    "neck": ("neck", "neck1", "neck01", "lowerneck"),
    "head": ("head", "head1", "skull"),
}
_ESTIMATED = ("foot", "hand", "collar")
_PREFIX = re.compile(r"mixamorig\d*|bip\d+|biped|character\d*|def|[mf]|avg|smpl")  # prefixes of exporters
_WORDS = frozenset(word for words in _SIDED.values() for word in words)
_SIDES = ("left_", "right_")
# suffix of unnamed ends of limbs, which are named after their parent
END = " (end)"


@dataclass(kw_only=True)
class Joint:
    """A joint of a file, in the file's unit and axes.

    parent: index in the tree's list, -1 for the root; offset (3,): from the parent's position, in the parent's axes;
    channels: the channels of a frame in order, "tx", "ty", "tz" for translations, "rx", "ry", "rz" for rotations;
    bone (3,): added to the offset, in the joint's own axes; axes (3, 3): axes of the channels' rotations. With axes,
    successive rotations are about fixed axes (ASF), without, about rotated axes (BVH).
    """

    name: str
    parent: int = -1
    offset: Any = None
    channels: Sequence[str] = ()
    bone: np.ndarray | None = None
    axes: np.ndarray | None = None


@dataclass(frozen=True, kw_only=True)
class JointTree:
    """N joints, parents before children; degrees: whether rotations are in degrees, else in radians."""

    joints: Sequence[Joint]
    degrees: bool = True

    @property
    def names(self) -> list[str]:
        """Names (N,) of the joints."""
        return [joint.name for joint in self.joints]

    @property
    def parents(self) -> list[int]:
        """Parents (N,) of the joints, -1 for the root."""
        return [joint.parent for joint in self.joints]

    def positions(self, values: np.ndarray) -> np.ndarray:
        """Joint positions (F, N, 3) for frames of channels (F, C), all joints' channels in order; NaN in frames with
        non-finite values."""
        is_finite = np.isfinite(values).all(1)
        columns = iter(values[is_finite].T)
        count = int(is_finite.sum())
        rotations: list[np.ndarray] = []
        joint_positions: list[np.ndarray] = []
        for joint in self.joints:
            rotation = np.broadcast_to(np.eye(3), (count, 3, 3))
            offset = np.repeat(joint.offset[None], count, 0)
            for channel, value in zip(joint.channels, columns, strict=False):
                if channel[0] == "t":
                    offset[:, "xyz".index(channel[1])] += value
                    continue
                channel_rotation = rotation_about(channel[1], np.radians(value) if self.degrees else value)
                rotation = rotation @ channel_rotation if joint.axes is None else channel_rotation @ rotation
            if joint.axes is not None:
                rotation = joint.axes @ rotation @ joint.axes.T
            with np.errstate(over="ignore", invalid="ignore"):
                if joint.parent >= 0:
                    offset = (rotations[joint.parent] @ offset[..., None])[..., 0]
                    rotation = rotations[joint.parent] @ rotation
                if joint.bone is not None:
                    offset = rotation @ joint.bone + offset
                joint_positions.append(joint_positions[joint.parent] + offset if joint.parent >= 0 else offset)
            rotations.append(rotation)
        positions = np.full((len(values), len(self.joints), 3), np.nan)
        positions[is_finite] = np.stack(joint_positions, 1)
        return positions


def tree_motion(
    path: str | os.PathLike,
    tree: JointTree,
    values: np.ndarray,
    *,
    fps: float,
    up: str | None,
    kind: str,
    unit_m: float | None = None,
    matched: dict[str, int] | None = None,
    number: np.ndarray | None = None,
) -> Motion:
    """The motion of one clip of any skeleton, named after the file.

    Args:
        values: Frames of channels (F, C), in the file's unit and axes; non-finite frames are dropped.
        up: The up axis, by default the axis along which people stand, or y if they do not stand.
        unit_m: Meters per unit of the file, by default the unit that gives the most typical body size.
        matched: SMPL joint name -> index in the tree; by default found by `match_joints`.
        number: (F,) frame numbers in the recording, by default without gaps.

    Raises:
        InputError: For a skeleton without the joints of a person, and as `motion_from_joints` does.
    """
    matched = match_joints(path, tree.names, tree.parents) if matched is None else matched
    positions = tree.positions(values)
    name, is_finite = Path(path).stem, np.isfinite(positions).all((1, 2))
    usable_clips(path, [name], [len(is_finite)], is_finite, fps, number)
    joints = np.full((len(is_finite), 24, 3), np.nan)
    with np.errstate(over="ignore", invalid="ignore"):
        joints[is_finite] = smpl_joints(tree.parents, matched, positions[is_finite])
    about: dict[str, Any] = {"fps": fps, "up": up, "unit_m": unit_m, "number": number}
    return motion_from_joints(path, joints, [name], [len(is_finite)], kind=kind, **about)


def match_joints(path: object, names: Sequence[str], parents: Sequence[int]) -> dict[str, int]:
    """SMPL joint name -> index of each joint found, without the spine. Raises InputError for missing required ones."""
    by_word: dict[tuple[str, str], int] = {}
    for i, name in enumerate(names):
        by_word.setdefault(_side_and_word(name), i)
    indices: dict[str, int] = {}
    for side, words_by_joint in (("left_", _SIDED), ("right_", _SIDED), ("", _CENTRAL)):
        for joint, words in words_by_joint.items():
            candidates = (by_word.get((side, word)) for word in words)
            index = next((i for i in candidates if i is not None and i not in indices.values()), None)
            if index is not None:
                indices[side + joint] = index
    ends = {parents[i]: i for i, name in enumerate(names) if name.endswith(END)}
    for tip, base in (("foot", "ankle"), ("hand", "wrist")):
        for side in _SIDES:
            if side + tip not in indices and indices.get(side + base) in ends:
                indices[side + tip] = ends[indices[side + base]]
    required_joints = [j for j in SMPL24.joints if j not in (*_SPINE, "pelvis", "neck") and not j.endswith(_ESTIMATED)]
    missing_joints = [joint for joint in required_joints if joint not in indices]
    if missing_joints:
        name_list = ", ".join(n for n in names if not n.endswith(END))
        raise file_error(
            path,
            f"has no joint for {', '.join(missing_joints)} among {name_list or 'no joints'}; expected left and right "
            "hip/UpLeg, knee/Leg, ankle/Foot, shoulder/Arm, elbow/ForeArm, wrist/Hand, and Head",
        )
    return indices


def smpl_joints(parents: Sequence[int], matched: dict[str, int], positions: np.ndarray) -> np.ndarray:
    """SMPL's joints (F, 24, 3) from a tree's positions (F, N, 3), in the same unit and axes."""
    joints = {joint: positions[:, i] for joint, i in matched.items()}
    hips = (joints["left_hip"] + joints["right_hip"]) / 2
    joints.setdefault("neck", (joints["left_shoulder"] + joints["right_shoulder"]) / 2)
    joints.setdefault("pelvis", hips)
    joints |= zip(_SPINE, _spine(parents, matched, hips, joints["neck"], positions), strict=True)
    forward = np.cross(joints["left_hip"] - hips, joints["neck"] - hips)
    for side in _SIDES:
        elbow, wrist, knee, ankle = (joints[side + name] for name in ("elbow", "wrist", "knee", "ankle"))
        joints.setdefault(f"{side}collar", joints["neck"])
        hand, foot = joints.get(f"{side}hand"), joints.get(f"{side}foot")
        if hand is None or _is_short(hand - wrist, wrist - elbow):
            joints[f"{side}hand"] = wrist + _length_ratio("elbow", "wrist", "hand") * (wrist - elbow)
        if foot is None or _is_short(foot - ankle, ankle - knee):
            shank = ankle - knee
            foot_direction = forward - (forward * unit(shank)).sum(-1, keepdims=True) * unit(shank)
            foot_length = _length_ratio("knee", "ankle", "foot") * np.linalg.norm(shank, axis=-1, keepdims=True)
            joints[f"{side}foot"] = ankle + foot_length * unit(foot_direction)
    return np.stack([joints[name] for name in SMPL24.joints], 1)


def _spine(
    parents: Sequence[int], matched: dict[str, int], hips: np.ndarray, neck: np.ndarray, positions: np.ndarray
) -> list[np.ndarray]:
    """Spine1-3 (F, 3): the three joints between pelvis and neck if they are distinct, else points at the shipped body's
    fractions of the polyline through the existing joints."""
    spine_joints: list[int] = []
    i = matched.get("neck", matched["head"])
    while (i := parents[i]) >= 0 and i != matched.get("pelvis"):
        spine_joints.insert(0, i)
    line = np.stack([hips, *(positions[:, i] for i in spine_joints), neck])
    bones = np.median(np.linalg.norm(np.diff(line, axis=0), axis=-1), axis=1)
    if len(spine_joints) == 3 and (bones[1:] > _SAME_JOINT * bones.sum()).all():
        return [positions[:, i] for i in spine_joints]
    rest_joints = mean_adult_joints()
    body_line = np.stack(
        [rest_joints[[_J["left_hip"], _J["right_hip"]]].mean(0), *(rest_joints[_J[s]] for s in (*_SPINE, "neck"))]
    )
    shares = np.cumsum(np.linalg.norm(np.diff(body_line, axis=0), axis=-1))
    arc_length = np.concatenate([[0], np.cumsum(bones)])
    joint_arc_length = shares[:3] / shares[3] * arc_length[-1]
    k = np.clip(np.searchsorted(arc_length, joint_arc_length, side="right") - 1, 0, len(bones) - 1)
    fraction = (joint_arc_length - arc_length[k]) / np.maximum(bones[k], 1e-12)
    return [line[n] + p * (line[n + 1] - line[n]) for n, p in zip(k, fraction, strict=True)]


def _length_ratio(start: str, middle: str, end: str) -> float:
    """Length of the bone middle -> end divided by that of start -> middle, on the shipped body."""
    a, b, c = (mean_adult_joints()[_J[f"left_{name}"]] for name in (start, middle, end))
    return float(np.linalg.norm(c - b) / np.linalg.norm(b - a))


def _is_short(bone: np.ndarray, limb: np.ndarray) -> bool:
    """Whether a limb's last bone is too short for its direction to be usable."""
    return bool(np.median(np.linalg.norm(bone, axis=-1)) < _SAME_JOINT * np.median(np.linalg.norm(limb, axis=-1)))


def _side_and_word(name: str) -> tuple[str, str]:
    """Side and normalized word of a joint's name: "mixamorig:LeftUpLeg" and "Bip01 L_up_leg" -> ("left_", "upleg")."""
    snake_case = re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=^[LR])(?=[A-Z][a-z])", "_", name.rpartition(":")[2])
    parts = [part for part in re.split(r"[^a-z0-9]+", snake_case.lower()) if part]
    while len(parts) > 1 and _PREFIX.fullmatch(parts[0]):
        parts.pop(0)
    marks = [(side, mark) for side in _SIDES for mark in (side[:-1], side[0])]
    for side, mark in marks:
        if mark in parts and len(parts) > 1:
            parts.remove(mark)
            return side, "".join(parts)
    word = "".join(parts)
    for side, mark in marks:
        if word.startswith(mark) and word.removeprefix(mark) in _WORDS:
            return side, word.removeprefix(mark)
    return "", word
