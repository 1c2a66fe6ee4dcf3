"""Text files of captured skeletons: BVH, and Acclaim's ASF (skeleton) with AMC (motion), as in CMU's database.

A BVH file has a tree of joints with offsets and channels, then one line of numbers per frame. A joint's rotation is the
product of its rotation channels in the listed order, in degrees; position channels replace its offset. The file does
not give the unit, the up axis or the rest pose: see `joint_tree`.
Source: the format as published with Biovision's motion data (Meredith and Maddock 2001).

An ASF bone rotates about its own axes: with A the rotation of its `axis` and M that of its channels, both R_z R_y R_x
for the order XYZ, its local rotation is A M A^-1. The bone starts at its parent's end and extends by its `length` along
its `direction`, rotated by its global rotation. A unit is 1 / L inches, where L is `length` of :units (0.45 in CMU's
files); y is up.
Source: the format's description and CMU's database (mocap.cs.cmu.edu), its page on units.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose.body.mocap.joint_tree import END, Joint, JointTree, tree_motion
from lidarpose.body.mocap.motion import Motion
from lidarpose.geometry import rotation_about
from lidarpose.io.files import FRAME_NUMBER, file_error, read_bytes

_BVH_CHANNELS = {
    f"{axis}{kind}": kind[0].replace("p", "t") + axis for axis in "xyz" for kind in ("position", "rotation")
}
_ASF_CHANNELS = ("tx", "ty", "tz", "rx", "ry", "rz")
# frames per second of CMU's database; an AMC file does not give its rate
CMU_FPS = 120.0
_INCH = 0.0254
# SMPL's joints and the bones at whose ends they are
_BONES = {"pelvis": "root", "neck": "thorax", "head": "upperneck"} | {
    f"{side}_{joint}": side[0] + bone
    for side in ("left", "right")
    for joint, bone in (
        ("hip", "hipjoint"), ("knee", "femur"), ("ankle", "tibia"), ("foot", "foot"),
        ("shoulder", "clavicle"), ("elbow", "humerus"), ("wrist", "radius"), ("hand", "hand"),
    )
}  # fmt: skip
_OPTIONAL = ("left_foot", "right_foot", "left_hand", "right_hand", "neck")


def load_bvh(path: str | os.PathLike, *, up: str | None = None, fps: float | None = None) -> Motion:
    """The motion of a BVH file as one clip, named after the file. up: by default the axis along which people stand;
    give it for recordings of people who lie."""
    tree, values, rate = read_bvh(path)
    rate = fps or rate
    if rate is None:
        raise file_error(path, "has no frame time above 0 (Frame Time: seconds); give load_motion fps=")
    return tree_motion(path, tree, values, fps=rate, up=up, kind="BVH")


def load_amc(path: str | os.PathLike, *, up: str | None = None, fps: float | None = None) -> Motion:
    """The motion of an AMC file as one clip, named after the file.

    Its skeleton is the ASF file with the same name or with the name up to its last or first `_` (02.asf for 02_01.amc),
    else the only ASF file in the folder. fps: by default CMU's 120; up: by default y.
    """
    tree, values, number, unit_m = read_amc(path)
    indices = {joint: tree.names.index(bone) for joint, bone in _BONES.items() if bone in tree.names}
    about: dict[str, Any] = {"fps": fps or CMU_FPS, "up": up or "y", "unit_m": unit_m, "number": number}
    return tree_motion(path, tree, values, kind="AMC", matched=indices, **about)


def _numbers(path: object, what: str, words: Sequence[str], count: int | None = None) -> np.ndarray:
    """Words of a text file as floats; with `count`, that many finite ones. Raises an InputError that names `what`."""
    try:
        numbers = np.array(words, float)
    except ValueError:
        numbers = np.zeros(0)
    if not len(numbers) or (count is not None and (len(numbers) != count or not np.isfinite(numbers).all())):
        expected = f"{count} finite numbers" if count else "numbers"
        raise file_error(path, f"{what} must be {expected}, got {' '.join(words)[:60]!r}")
    return numbers


def _read_text(path: str | os.PathLike, expected: str) -> str:
    return read_bytes(path, expected=expected).decode("utf-8-sig", "replace")


# BVH


def read_bvh(path: str | os.PathLike) -> tuple[JointTree, np.ndarray, float | None]:
    """Joints of a BVH file, frames of channels (F, C), and frames per second, None if not given. Raises InputError."""
    text = _read_text(path, "a BVH file").replace("{", "\n{\n").replace("}", "\n}\n")
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    if not lines or lines[0].upper() != "HIERARCHY":
        raise file_error(path, f"a BVH file starts with HIERARCHY, got {lines[0][:40] if lines else 'nothing'!r}")
    motion_index = next((i for i, line in enumerate(lines) if line.upper() == "MOTION"), None)
    if motion_index is None:
        raise file_error(path, "has no MOTION part; was it copied completely?")
    tree = JointTree(joints=_bvh_joints(path, lines[1:motion_index]))
    channel_count = sum(len(joint.channels) for joint in tree.joints)
    if not channel_count:
        raise file_error(path, "no joint has CHANNELS, so nothing moves: was it exported with its motion?")
    return tree, *_bvh_frames(path, lines[motion_index + 1 :], channel_count)


def _bvh_joints(path: object, lines: list[str]) -> list[Joint]:
    joints: list[Joint] = []
    open_joints: list[int] = []
    awaits_brace = False
    for line in lines:
        key, *words = line.split()
        key = key.upper()
        is_inside = open_joints and not awaits_brace
        joint = joints[open_joints[-1]] if is_inside else None
        if key in ("JOINT", "END") and joint or (key == "ROOT" and not joints):
            name = joint.name + END if joint and key == "END" else line[len(key) :].strip()
            joints.append(Joint(name=name, parent=open_joints[-1] if joint else -1))
            awaits_brace = True
        elif key == "{" and awaits_brace:
            open_joints.append(len(joints) - 1)
            awaits_brace = False
        elif joint and key == "}":
            if joint.offset is None:
                raise file_error(path, f"joint {joint.name} has no OFFSET")
            joint.offset = np.where([f"t{axis}" in joint.channels for axis in "xyz"], 0, joint.offset)
            open_joints.pop()
        elif joint and key == "OFFSET":
            joint.offset = _numbers(path, f"OFFSET of {joint.name}", words, 3)
        elif joint and key == "CHANNELS":
            joint.channels = _bvh_channels(path, joint.name, words)
        else:
            expected = "one ROOT, and in its braces OFFSET, CHANNELS, JOINT and End Site"
            raise file_error(path, f"{line[:60]!r} is in a wrong place; expected {expected}")
    if open_joints or awaits_brace or not joints:
        raise file_error(path, "the HIERARCHY is not complete; was the file copied completely?")
    return joints


def _bvh_channels(path: object, name: str, words: list[str]) -> list[str]:
    if not words or words[0] != str(len(words) - 1):
        raise file_error(path, f"CHANNELS of {name} must be a count and as many names, got {' '.join(words)[:60]!r}")
    unknown_channels = [word for word in words[1:] if word.lower() not in _BVH_CHANNELS]
    if unknown_channels:
        raise file_error(
            path, f"{name} has the channel {unknown_channels[0]!r}; expected Xposition, Zrotation or similar"
        )
    return [_BVH_CHANNELS[word.lower()] for word in words[1:]]


def _bvh_frames(path: object, lines: list[str], channel_count: int) -> tuple[np.ndarray, float | None]:
    """Values (F, channel_count), and frames per second or None."""
    header = {key.strip().lower(): value for key, _, value in (line.partition(":") for line in lines[:2])}
    if list(header) != ["frames", "frame time"]:
        raise file_error(path, "MOTION must begin with Frames: and Frame Time:; was it copied completely?")
    if not header["frames"].strip().isdecimal():
        raise file_error(path, f"Frames: must be a whole number of 0 or more, got {header['frames'][:40]!r}")
    try:
        seconds = float(header["frame time"])
    except ValueError:
        seconds = 0.0
    values = _numbers(path, "the frames of MOTION", " ".join(lines[2:]).split())
    if len(values) != int(header["frames"]) * channel_count:
        expected = f"{header['frames'].strip()[:20]} frames of {channel_count} numbers"
        raise file_error(path, f"expected {expected}, got {len(values)} numbers; was it copied completely?")
    # a frame time near 0 would give an infinite rate
    return values.reshape(-1, channel_count), 1 / seconds if 1e-6 < seconds < np.inf else None


# ASF and AMC


def read_amc(path: str | os.PathLike) -> tuple[JointTree, np.ndarray, np.ndarray | None, float]:
    """Reads an AMC file and its ASF file: the bones' ends as joints, frames of channels (F, C) of the bones that move,
    numbers (F,) of the frames, None if they do not rise, and meters per unit. Raises InputError."""
    path = Path(path)
    values, number = _amc_frames(path)
    skeleton = _skeleton_of(path)
    tree, unit_m = read_asf(skeleton)
    unknown_bones = sorted(values.keys() - set(tree.names))
    if unknown_bones:
        raise file_error(
            path, f"moves {', '.join(unknown_bones)[:80]}, which {skeleton.name} does not have; is this its skeleton?"
        )
    missing_bones = [bone for joint, bone in _BONES.items() if bone not in tree.names and joint not in _OPTIONAL]
    if missing_bones:
        raise file_error(skeleton, f"has no bone {', '.join(missing_bones)} among {', '.join(sorted(tree.names))}")
    for joint in tree.joints:
        if joint.name not in values:
            joint.channels = ()
        elif values[joint.name].shape[1] != len(joint.channels):
            numbers, freedoms = values[joint.name].shape[1], len(joint.channels)
            raise file_error(
                path, f"{joint.name} has {numbers} numbers per frame, its skeleton {freedoms} degrees of freedom"
            )
    return tree, np.concatenate([values[name] for name in tree.names if name in values], 1), number, unit_m


def _skeleton_of(path: Path) -> Path:
    """The ASF file whose name begins the AMC file's, as 02.asf of 02_01.amc or HDM_bd.asf of HDM_bd_walk_120.amc, or
    the only one beside it, or one in the folder above. Raises InputError."""
    words = path.stem.split("_")
    stems = ["_".join(words[:count]) for count in range(len(words), 0, -1)]
    skeletons = _skeletons_in(path.parent)
    skeleton = _first_of(skeletons, stems)
    if skeleton is None and len(skeletons) == 1:
        skeleton = next(iter(skeletons.values()))
    # HDM05's cut clips lie in a folder for each movement below the skeletons
    skeleton = skeleton or _first_of(_skeletons_in(path.parent / ".."), stems)
    if skeleton is None:
        hint = f" (there are {', '.join(f'{name}.asf' for name in sorted(skeletons))})" if skeletons else ""
        expected = f"{'_'.join(words[:2]) if words[0] == 'HDM' else words[0]}.asf or {path.stem}.asf"
        raise file_error(path, f"an AMC file needs its skeleton: put {expected} beside it{hint}")
    return skeleton


def _skeletons_in(folder: Path) -> dict[str, Path]:
    return {file.stem.lower(): file for file in folder.glob("*") if file.suffix.lower() == ".asf"}


def _first_of(skeletons: dict[str, Path], stems: list[str]) -> Path | None:
    return next((skeletons[stem.lower()] for stem in stems if stem.lower() in skeletons), None)


def _words_of_lines(path: Path, expected: str) -> list[list[str]]:
    lines = _read_text(path, expected).splitlines()
    return [line.split() for line in lines if line.strip() and not line.lstrip().startswith("#")]


def read_asf(path: Path) -> tuple[JointTree, float]:
    """Bones of an ASF file as joints at their ends, the root first, and meters per unit. Raises InputError."""
    sections: dict[str, list[list[str]]] = {}
    section: list[list[str]] = []
    for words in _words_of_lines(path, "an ASF file"):
        if words[0].startswith(":"):
            section = sections.setdefault(words[0].lower(), [])
            words = words[1:]
        if words:
            section.append(words)
    required_sections = (":root", ":bonedata", ":hierarchy")
    missing_sections = [name for name in required_sections if name not in sections]
    if missing_sections:
        raise file_error(
            path, f"an ASF file has {', '.join(required_sections)}; {', '.join(missing_sections)} is missing"
        )
    units = {words[0].lower(): words[1] for words in sections.get(":units", []) if len(words) > 1}
    length = _numbers(path, "length of :units", [units.get("length", "0.45")], 1)[0]
    if not 1e-6 < length < 1e6:
        raise file_error(path, f"length of :units must be above 0, got {length}")
    angle = units.get("angle", "deg").lower()
    if angle not in ("deg", "rad", "degrees", "radians"):
        raise file_error(path, f"angle of :units must be deg or rad, got {angle[:40]!r}")
    degrees = angle.startswith("deg")
    bones = {"root": _root(path, {words[0].lower(): words[1:] for words in sections[":root"]}, degrees)}
    for name, properties in _bone_data(path, sections[":bonedata"]):
        if name in bones:
            raise file_error(path, f"has the bone {name} twice")
        bones[name] = _bone(path, name, properties, degrees)
    return JointTree(joints=_in_tree_order(path, sections[":hierarchy"], bones), degrees=degrees), _INCH / length


def _root(path: Path, properties: dict[str, list[str]], degrees: bool) -> Joint:
    channels = tuple(word.lower() for word in properties.get("order", _ASF_CHANNELS))
    if sorted(channels) != sorted(_ASF_CHANNELS):
        raise file_error(path, f"order of :root must be TX TY TZ RX RY RZ in any order, got {' '.join(channels)[:60]}")
    offset = _numbers(path, "position of :root", list(properties.get("position", "000")), 3)
    axes = _rotation(path, "root", [*properties.get("orientation", "000"), *properties.get("axis", [])[:1]], degrees)
    return Joint(name="root", parent=-1, offset=offset, channels=channels, bone=np.zeros(3), axes=axes)


def _bone_data(path: Path, lines: list[list[str]]) -> list[tuple[str, dict[str, list[str]]]]:
    """Names and properties of the bones; the first occurrence of a keyword counts."""
    bones: list[tuple[str, dict[str, list[str]]]] = []
    properties: dict[str, list[str]] | None = None
    for key, *words in lines:
        key = key.lower()
        if key == "begin":
            properties = {}
        elif key == "end":
            if not properties or not properties.get("name"):
                raise file_error(path, "a bone of :bonedata has no name, or an end without begin")
            bones.append((properties["name"][0], properties))
            properties = None
        elif properties is not None:
            properties.setdefault(key, words)
    if properties is not None:
        raise file_error(path, ":bonedata stops inside a bone; was it copied completely?")
    return bones


def _bone(path: Path, name: str, properties: dict[str, list[str]], degrees: bool) -> Joint:
    missing_keys = [key for key in ("direction", "length") if key not in properties]
    if missing_keys:
        raise file_error(path, f"bone {name} has no {', '.join(missing_keys)}")
    direction = _numbers(path, f"direction of {name}", properties["direction"], 3)
    length = _numbers(path, f"length of {name}", properties["length"], 1)[0]
    channels = tuple(word.lower() for word in properties.get("dof", []))
    unknown_channels = [word for word in channels if word not in _ASF_CHANNELS]
    if unknown_channels:
        raise file_error(
            path,
            f"bone {name} has the degree of freedom {unknown_channels[0][:40]!r}; known are {', '.join(_ASF_CHANNELS)}",
        )
    with np.errstate(over="ignore"):
        norm = np.linalg.norm(direction)
        bone = direction / norm * length if 0 < norm < np.inf else np.zeros(3)
    axes = _rotation(path, name, properties.get("axis", list("000")), degrees)
    return Joint(name=name, offset=np.zeros(3), channels=channels, bone=bone, axes=axes)


def _rotation(path: Path, name: str, words: list[str], degrees: bool) -> np.ndarray:
    """Rotation matrix (3, 3) from three angles and their order, by default XYZ (about x first)."""
    order = words[3].lower() if len(words) > 3 else "xyz"
    if sorted(order) != ["x", "y", "z"]:
        raise file_error(path, f"axis of {name} must have an order such as XYZ, got {order[:40]!r}")
    angles = _numbers(path, f"axis of {name}", words[:3], 3)
    rotation = np.eye(3)
    for axis, angle in zip(order, np.radians(angles) if degrees else angles, strict=True):
        rotation = rotation_about(axis, angle) @ rotation
    return rotation


def _in_tree_order(path: Path, lines: list[list[str]], bones: dict[str, Joint]) -> list[Joint]:
    """The bones with their parents set, parents before children."""
    parent_of: dict[str, str] = {}
    for parent, *children in lines:
        if parent.lower() in ("begin", "end") and not children:
            continue
        unknown_bones = [word for word in (parent, *children) if word not in bones]
        if unknown_bones:
            raise file_error(path, f":hierarchy names {unknown_bones[0][:40]!r}, which :bonedata does not have")
        for child in children:
            if child in parent_of or child == "root":
                raise file_error(path, f":hierarchy has {child} twice")
            parent_of[child] = parent
    order = ["root"]
    for k, name in enumerate(order):
        children = [child for child, parent in parent_of.items() if parent == name]
        for child in children:
            bones[child].parent = k
        order += children
    orphan_bones = [name for name in bones if name not in order]
    if orphan_bones:
        raise file_error(path, f"{', '.join(orphan_bones)[:80]}: no parent in :hierarchy")
    return [bones[name] for name in order]


def _amc_frames(path: Path) -> tuple[dict[str, np.ndarray], np.ndarray | None]:
    """Channel values (F, n) of each bone that moves, and the numbers (F,) of the frames, None if they do not rise."""
    frames: list[dict[str, list[str]]] = []
    numbers: list[int] = []
    for words in _words_of_lines(path, "an AMC file"):
        if words[0].startswith(":"):
            continue
        if len(words) == 1 and FRAME_NUMBER.fullmatch(words[0]):
            frames.append({})
            numbers.append(int(words[0]))
        elif not frames:
            raise file_error(path, f"an AMC file has numbered frames of bones, got {' '.join(words)[:60]!r}")
        else:
            frames[-1][words[0]] = words[1:]
    if not frames or not frames[0]:
        raise file_error(path, "has no frames, or a first frame that moves no bone")
    lengths = {name: len(words) for name, words in frames[0].items()}
    for k, frame in enumerate(frames, 1):
        if {name: len(words) for name, words in frame.items()} != lengths:
            raise file_error(
                path, f"frame {k} of {len(frames)} lacks numbers that the first one has; was it copied completely?"
            )
    values = {}
    for name in lengths:
        words = [word for frame in frames for word in frame[name]]
        values[name] = _numbers(path, f"numbers of {name}", words).reshape(len(frames), -1)
    do_rise = all(a < b for a, b in zip(numbers, numbers[1:], strict=False))
    return values, np.array(numbers, float) if do_rise else None
