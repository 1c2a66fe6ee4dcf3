"""Any captured skeleton -> SMPL's 24 joints, by the names and the tree of its joints.

What a skeleton has under another name is found; a spine that is cut differently is cut anew, at the shares of the
line hips -> neck at which the shipped body has its spine's joints; and what only ends a limb (hand, foot, collar) is
made up where it is missing. The rest is needed.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from lidarpose.body.mocap.motion import Motion
from lidarpose.body.mocap.positions import played
from lidarpose.body.mocap.retarget import SHORTEST_BONE, mean_adult_joints, shortest_bone
from lidarpose.body.mocap.segments import cut
from lidarpose.body.mocap.units import check_speed, metres_of
from lidarpose.geometry import rotation_from_up, unit
from lidarpose.io.files import file_error
from lidarpose.skeleton import SMPL24

_J = {name: i for i, name in enumerate(SMPL24.joints)}
_SPINE = ("spine1", "spine2", "spine3")
# a spine's joints nearer than this share of the line hips -> neck are one joint
_SAME_JOINT = 0.02

# names of joints, without side, the more telling first; the same word may mean two joints ("foot"): each joint is
# used once, in this order. Left and right:
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
_MADE_UP = ("foot", "hand", "collar")
_PREFIX = re.compile(r"mixamorig\d*|bip\d+|biped|character\d*|def|[mf]|avg|smpl")  # what exporters put in front
_WORDS = frozenset(word for known in _SIDED.values() for word in known)
_SIDES = ("left", "right")
# ends of limbs that have no name are called after their parent, with this behind
END = " (end)"

_STANDS = 0.7  # mean share of the trunk along the axis that is taken for up


@dataclass(frozen=True, kw_only=True)
class Tree:
    """Joints of a source: names (N,), parents (N,) -1 for the root, parents before children; positions (F, N, 3) in
    its own unit and axes. Frames that are no numbers are NaN."""

    names: Sequence[str]
    parents: Sequence[int]
    positions: np.ndarray


def tree_motion(
    path: object,
    tree: Tree,
    *,
    name: str,
    fps: float,
    up: str | None,
    kind: str,
    unit_m: float | None = None,
    found: dict[str, int] | None = None,
) -> Motion:
    """One clip of any skeleton as the body plays it.

    up: the axis that is up, by default the one along which people stand (y where they do not stand); unit_m: metres
    of a file's number, by default the unit that gives the person the most usual size; found: joints of the
    tree by SMPL's names, where names are not to be guessed. Raises InputError for a skeleton that is nobody's.
    """
    if not 0 < fps < np.inf:
        raise file_error(path, f"the frame rate must be above 0, got {fps}; give load_motion fps=")
    found = match_joints(path, tree.names, tree.parents) if found is None else found
    good = np.isfinite(tree.positions).all((1, 2))
    cut(path, name, good)
    with np.errstate(over="ignore", invalid="ignore"):
        joints = smpl_joints(tree, found, tree.positions[good])
        joints = joints * metres_of(path, joints, unit_m)
        if not np.abs(joints).max() < 1e5:
            raise file_error(path, "joints lie farther than 100 km from the origin; expected one unit throughout")
    joints = joints @ rotation_from_up(up or _upwards(path, joints)).T
    length, which = shortest_bone(joints)
    if (length <= SHORTEST_BONE).all():
        raise file_error(path, f"{which[0]} has no length; every limb needs a length to have a direction")
    good[good] = length > SHORTEST_BONE
    joints = joints[length > SHORTEST_BONE]
    names, start, count = cut(path, name, good)
    check_speed(path, joints, start, fps)
    rotations, translation = played(joints)
    return Motion(
        rotations=rotations,
        translation=translation,
        names=names,
        start=start,
        length=count,
        fps=float(fps),
        source=f"{kind}: {path}",
        dropped=int((~good).sum()),
    )


def match_joints(path: object, names: Sequence[str], parents: Sequence[int]) -> dict[str, int]:
    """SMPL's joints, as far as there are any, without the spine. Raises InputError naming what is missing."""
    central, sided = {}, {side: {} for side in _SIDES}
    for i, name in enumerate(names):
        side, word = _word(name)
        (sided[side] if side else central).setdefault(word, i)
    found: dict[str, int] = {}
    for side, words in sided.items():
        used: set[int] = set()
        for joint, known in _SIDED.items():
            i = next((words[word] for word in known if word in words and words[word] not in used), None)
            if i is not None:
                used.add(i)
                found[f"{side}_{joint}"] = i
    for joint, known in _CENTRAL.items():
        i = next((central[word] for word in known if word in central), None)
        if i is not None:
            found[joint] = i
    ends = {parents[i]: i for i, name in enumerate(names) if name.endswith(END)}
    for side in sided:
        for tip, base in (("foot", "ankle"), ("hand", "wrist")):
            if f"{side}_{tip}" not in found and found.get(f"{side}_{base}") in ends:
                found[f"{side}_{tip}"] = ends[found[f"{side}_{base}"]]
    needed = [j for j in SMPL24.joints if j not in (*_SPINE, "pelvis", "neck") and not j.endswith(_MADE_UP)]
    missing = [joint for joint in needed if joint not in found]
    if missing:
        listed = ", ".join(n for n in names if not n.endswith(END))
        raise file_error(
            path,
            f"found no joint for {', '.join(missing)} among {listed or 'no joints'}; needed are left and right "
            "hip/UpLeg, knee/Leg, ankle/Foot, shoulder/Arm, elbow/ForeArm, wrist/Hand, and Head",
        )
    return found


def smpl_joints(tree: Tree, found: dict[str, int], positions: np.ndarray) -> np.ndarray:
    """SMPL's joints (F, 24, 3) of a tree's positions (F, N, 3), in the same unit and axes."""
    joints = np.zeros((len(positions), 24, 3))
    for joint, i in found.items():
        joints[:, _J[joint]] = positions[:, i]
    hips = (joints[:, _J["left_hip"]] + joints[:, _J["right_hip"]]) / 2
    shoulders = (joints[:, _J["left_shoulder"]] + joints[:, _J["right_shoulder"]]) / 2
    if "neck" not in found:
        joints[:, _J["neck"]] = shoulders
    if "pelvis" not in found:
        joints[:, _J["pelvis"]] = hips
    spine = _spine(tree, found, hips, joints[:, _J["neck"]], positions)
    for joint, value in zip(_SPINE, spine, strict=True):
        joints[:, _J[joint]] = value
    ahead = np.cross(joints[:, _J["left_hip"]] - hips, joints[:, _J["neck"]] - hips)
    rest = mean_adult_joints()
    foot_share, hand_share = (_reach(rest, chain) for chain in (("knee", "ankle", "foot"), ("elbow", "wrist", "hand")))
    for side in ("left", "right"):
        elbow, wrist, knee, ankle = (joints[:, _J[f"{side}_{n}"]] for n in ("elbow", "wrist", "knee", "ankle"))
        if f"{side}_collar" not in found:
            joints[:, _J[f"{side}_collar"]] = joints[:, _J["neck"]]
        hand, foot = joints[:, _J[f"{side}_hand"]], joints[:, _J[f"{side}_foot"]]
        if f"{side}_hand" not in found or _short(hand - wrist, wrist - elbow):
            joints[:, _J[f"{side}_hand"]] = wrist + hand_share * (wrist - elbow)
        if f"{side}_foot" not in found or _short(foot - ankle, ankle - knee):
            shank = ankle - knee
            across = ahead - (ahead * unit(shank)).sum(-1, keepdims=True) * unit(shank)
            length = foot_share * np.linalg.norm(shank, axis=-1, keepdims=True)
            joints[:, _J[f"{side}_foot"]] = ankle + length * unit(across)
    return joints


def _spine(
    tree: Tree, found: dict[str, int], hips: np.ndarray, neck: np.ndarray, positions: np.ndarray
) -> list[np.ndarray]:
    """Spine1-3 (F, 3): the three joints between pelvis and neck, or where our body's lie along the line of the joints
    that are there."""
    between: list[int] = []
    i = found.get("neck", found["head"])
    while (i := tree.parents[i]) >= 0 and i != found.get("pelvis"):
        between.insert(0, i)
    line = np.stack([hips, *(positions[:, i] for i in between), neck])
    bones = np.median(np.linalg.norm(np.diff(line, axis=0), axis=-1), axis=1)
    if len(between) == 3 and (bones[1:] > _SAME_JOINT * bones.sum()).all():
        return [positions[:, i] for i in between]
    rest = mean_adult_joints()
    ours = np.stack([rest[[_J["left_hip"], _J["right_hip"]]].mean(0), *(rest[_J[s]] for s in (*_SPINE, "neck"))])
    shares = np.cumsum(np.linalg.norm(np.diff(ours, axis=0), axis=-1))
    along = np.concatenate([[0], np.cumsum(bones)])
    at = shares[:3] / shares[3] * along[-1]
    k = np.clip(np.searchsorted(along, at, side="right") - 1, 0, len(bones) - 1)
    part = (at - along[k]) / np.maximum(bones[k], 1e-12)
    return [line[n] + p * (line[n + 1] - line[n]) for n, p in zip(k, part, strict=True)]


def _upwards(path: object, joints: np.ndarray) -> str:
    hips = (joints[:, _J["left_hip"]] + joints[:, _J["right_hip"]]) / 2
    trunk = unit(joints[:, _J["neck"]] - hips).mean(0)
    axis = int(np.abs(trunk).argmax())
    if trunk[axis] < -_STANDS:
        stands = "xyz"[axis]
        remedy = f"give load_motion up='-{stands}', or up={stands!r} if they are upside down"
        raise file_error(path, f"people stand along -{stands}; {remedy}")
    return "xyz"[axis] if trunk[axis] > _STANDS else "y"


def _reach(rest: np.ndarray, chain: Iterable[str]) -> float:
    a, b, c = (rest[_J[f"left_{name}"]] for name in chain)
    return float(np.linalg.norm(c - b) / np.linalg.norm(b - a))


def _short(bone: np.ndarray, whole: np.ndarray) -> bool:
    """Whether a limb's last bone is too short for its direction to be of use."""
    return bool(np.median(np.linalg.norm(bone, axis=-1)) < _SAME_JOINT * np.median(np.linalg.norm(whole, axis=-1)))


def _word(name: str) -> tuple[str | None, str]:
    """Side and plain word of a joint's name: "mixamorig:LeftUpLeg" and "Bip01 L_up_leg" -> ("left", "upleg")."""
    plain = re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=^[LR])(?=[A-Z][a-z])", "_", name.rpartition(":")[2])
    parts = [part for part in re.split(r"[^a-z0-9]+", plain.lower()) if part]
    while len(parts) > 1 and _PREFIX.fullmatch(parts[0]):
        parts.pop(0)
    for side in _SIDES:
        for part in (side, side[0]):
            if part in parts and len(parts) > 1:
                parts.remove(part)
                return side, "".join(parts)
    word = "".join(parts)
    for side in _SIDES:
        for part in (side, side[0]):
            if word.startswith(part) and word.removeprefix(part) in _WORDS:
                return side, word.removeprefix(part)
    return None, word
