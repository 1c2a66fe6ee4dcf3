"""ASF and AMC: Acclaim's skeleton (bones with directions and lengths) and its motion, as CMU's database has them.

A bone turns about its own axes: with A the rotation of its `axis` and M that of its numbers, both R_z R_y R_x where
the order is XYZ, its local rotation is A M A^-1; it goes from its parent's end, along its `direction` as turned by
its global rotation, for its `length`. Lengths are inches / 0.45 where `length` is 0.45, y is up.
Source: the format's description and CMU's database (mocap.cs.cmu.edu), its page on units.
"""

import os
import re
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lidarpose.body.mocap.joint_tree import JointTree, parse_numbers, tree_motion
from lidarpose.body.mocap.motion import Motion
from lidarpose.geometry import rotation_about
from lidarpose.io.files import file_error, read_bytes

# frames a second of CMU's database; an AMC file does not say its own
CMU_FPS = 120.0
_INCH = 0.0254
_CHANNELS = ("tx", "ty", "tz", "rx", "ry", "rz")
# SMPL's joints are at the ends of these bones; sides are filled in
_BONES = {"pelvis": "root", "neck": "thorax", "head": "upperneck"} | {
    f"{side}_{joint}": side[0] + bone
    for side in ("left", "right")
    for joint, bone in (
        ("hip", "hipjoint"), ("knee", "femur"), ("ankle", "tibia"), ("foot", "foot"),
        ("shoulder", "clavicle"), ("elbow", "humerus"), ("wrist", "radius"), ("hand", "hand"),
    )
}  # fmt: skip
_OPTIONAL = ("left_foot", "right_foot", "left_hand", "right_hand", "neck")
_FRAME = re.compile("[0-9]{1,12}")


def load_amc(path: str | os.PathLike, *, up: str | None = None, fps: float | None = None) -> Motion:
    """The motion of an AMC file as one clip, named as the file.

    Its skeleton is the ASF file of the same name, of the name up to the last `_` (02.asf for 02_01.amc), or the only
    one in the folder. fps: by default CMU's 120; up: by default y.
    """
    tree, values, unit_m = read_amc(path)
    matched = {joint: tree.names.index(bone) for joint, bone in _BONES.items() if bone in tree.names}
    positions = tree.positions(values)
    return tree_motion(
        path, tree, positions, fps=fps or CMU_FPS, up=up or "y", kind="AMC", unit_m=unit_m, matched=matched
    )


def read_amc(path: str | os.PathLike) -> tuple[JointTree, np.ndarray, float]:
    """The bones' ends as joints, of an AMC file and its ASF file, the frames of channels (F, C) of those that move,
    and meters of a number. Raises InputError."""
    path = Path(path)
    values = _motion(path)
    skeleton = _skeleton_of(path)
    tree, unit_m = read_asf(skeleton)
    unknown = sorted(values.keys() - set(tree.names))
    if unknown:
        raise file_error(path, f"moves {', '.join(unknown)[:80]}, which {skeleton.name} does not have; is it this one?")
    missing = [bone for joint, bone in _BONES.items() if bone not in tree.names and joint not in _OPTIONAL]
    if missing:
        raise file_error(skeleton, f"has no bone {', '.join(missing)} among {', '.join(sorted(tree.names))}")
    channels = [own if name in values else () for name, own in zip(tree.names, tree.channels, strict=True)]
    for name, own in zip(tree.names, channels, strict=True):
        if name in values and values[name].shape[1] != len(own):
            numbers = values[name].shape[1]
            raise file_error(path, f"{name} has {numbers} numbers a frame, its skeleton {len(own)} freedoms")
    moved = [values[name] for name in tree.names if name in values]
    return replace(tree, channels=channels), np.concatenate(moved, 1), unit_m


def _skeleton_of(path: Path) -> Path:
    folder = {file.name.lower(): file for file in path.parent.iterdir() if file.suffix.lower() == ".asf"}
    for stem in (path.stem, path.stem.rpartition("_")[0], path.stem.partition("_")[0]):
        if f"{stem}.asf".lower() in folder:
            return folder[f"{stem}.asf".lower()]
    if len(folder) == 1:
        return next(iter(folder.values()))
    raise file_error(
        path,
        f"an AMC file needs its skeleton: put {path.stem.partition('_')[0]}.asf or {path.stem}.asf beside it"
        + (f" (there are {', '.join(sorted(folder))})" if folder else ""),
    )


def _lines(path: Path, expected: str) -> list[list[str]]:
    text = read_bytes(path, expected=expected).decode("utf-8-sig", "replace")
    return [line.split() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]


class _Bone(NamedTuple):
    """offset (3,) in the parent's axes, bone (3,) in its own, axis (3, 3), and its channels."""

    offset: np.ndarray
    bone: np.ndarray
    axis: np.ndarray
    channels: tuple[str, ...]


def read_asf(path: Path) -> tuple[JointTree, float]:
    """The bones of an ASF file, the root first, as joints at their ends, and meters of a number. Raises InputError."""
    sections: dict[str, list[list[str]]] = {}
    section: list[list[str]] = []
    for words in _lines(path, "an ASF file"):
        if words[0].startswith(":"):
            section = sections.setdefault(words[0].lower(), [])
            words = words[1:]
        if words:
            section.append(words)
    needed = (":root", ":bonedata", ":hierarchy")
    missing = [name for name in needed if name not in sections]
    if missing:
        raise file_error(path, f"an ASF file has {', '.join(needed)}; {', '.join(missing)} is missing")
    units = {words[0].lower(): words[1] for words in sections.get(":units", []) if len(words) > 1}
    length = parse_numbers(path, "length of :units", [units.get("length", "0.45")], 1)[0]
    if not 1e-6 < length < 1e6:
        raise file_error(path, f"length of :units must be above 0, got {length}")
    angle = units.get("angle", "deg").lower()
    if angle not in ("deg", "rad", "degrees", "radians"):
        raise file_error(path, f"angle of :units must be deg or rad, got {angle[:40]!r}")
    degrees = angle.startswith("deg")
    bones = {"root": _root(path, sections[":root"], degrees)} | _bones(path, sections[":bonedata"], degrees)
    parent_of = _hierarchy(path, sections[":hierarchy"], bones)
    names = list(parent_of)
    tree = JointTree(
        names=names,
        parents=[names.index(parent) if parent else -1 for parent in parent_of.values()],
        offsets=np.array([bones[name].offset for name in names]),
        bones=np.array([bones[name].bone for name in names]),
        axes=np.array([bones[name].axis for name in names]),
        channels=[bones[name].channels for name in names],
        fixed_axes=True,
        degrees=degrees,
    )
    return tree, _INCH / length


def _root(path: Path, lines: list[list[str]], degrees: bool) -> _Bone:
    stored = {words[0].lower(): words[1:] for words in lines}
    channels = tuple(word.lower() for word in stored.get("order", _CHANNELS))
    if sorted(channels) != sorted(_CHANNELS):
        raise file_error(path, f"order of :root must be TX TY TZ RX RY RZ in any order, got {' '.join(channels)[:60]}")
    angles = [*stored.get("orientation", "000"), (stored.get("axis") or ["XYZ"])[0]]
    return _Bone(
        offset=parse_numbers(path, "position of :root", list(stored.get("position", "000")), 3),
        bone=np.zeros(3),
        axis=_rotation(path, "root", angles, degrees),
        channels=channels,
    )


def _bones(path: Path, lines: list[list[str]], degrees: bool) -> dict[str, _Bone]:
    bones: dict[str, _Bone] = {}
    stored: dict[str, list[str]] | None = None
    for words in lines:
        key = words[0].lower()
        if key == "begin":
            stored = {}
        elif key == "end":
            if not stored or not stored.get("name"):
                raise file_error(path, "a bone of :bonedata has no name, or an end without begin")
            name = stored["name"][0]
            if name in bones or name == "root":
                raise file_error(path, f"has the bone {name} twice")
            bones[name] = _bone(path, name, stored, degrees)
            stored = None
        elif stored is not None:
            stored.setdefault(key, words[1:])
    if stored is not None:
        raise file_error(path, ":bonedata stops inside a bone; was it copied completely?")
    return bones


def _bone(path: Path, name: str, stored: dict[str, list[str]], degrees: bool) -> _Bone:
    missing = [key for key in ("direction", "length") if key not in stored]
    if missing:
        raise file_error(path, f"bone {name} has no {', '.join(missing)}")
    direction = parse_numbers(path, f"direction of {name}", stored["direction"], 3)
    length = parse_numbers(path, f"length of {name}", stored["length"], 1)[0]
    channels = tuple(word.lower() for word in stored.get("dof", []))
    unknown = [word for word in channels if word not in _CHANNELS]
    if unknown:
        raise file_error(path, f"bone {name} has the freedom {unknown[0][:40]!r}; known are {', '.join(_CHANNELS)}")
    with np.errstate(over="ignore"):
        size = np.linalg.norm(direction)
        bone = direction / size * length if 0 < size < np.inf else np.zeros(3)
    axis = _rotation(path, name, stored.get("axis", ["0", "0", "0"]), degrees)
    return _Bone(offset=np.zeros(3), bone=bone, axis=axis, channels=channels)


def _rotation(path: Path, name: str, words: list[str], degrees: bool) -> np.ndarray:
    """(3, 3) of three angles and their order, by default XYZ: about x first."""
    order = words[3].lower() if len(words) > 3 else "xyz"
    if sorted(order) != ["x", "y", "z"]:
        raise file_error(path, f"axis of {name} must have an order such as XYZ, got {order[:40]!r}")
    angles = parse_numbers(path, f"axis of {name}", words[:3], 3)
    rotation = np.eye(3)
    for axis, angle in zip(order, np.radians(angles) if degrees else angles, strict=True):
        rotation = rotation_about(axis, angle) @ rotation
    return rotation


def _hierarchy(path: Path, lines: list[list[str]], bones: dict[str, _Bone]) -> dict[str, str]:
    """The parent of each bone, "" of the root; parents come before children."""
    parent_of: dict[str, str] = {}
    for words in lines:
        if words[0].lower() in ("begin", "end") and len(words) == 1:
            continue
        unknown = [word for word in words if word not in bones]
        if unknown:
            raise file_error(path, f":hierarchy names {unknown[0][:40]!r}, which :bonedata does not have")
        for child in words[1:]:
            if child in parent_of or child == "root":
                raise file_error(path, f":hierarchy has {child} twice")
            parent_of[child] = words[0]
    order = ["root"]
    for name in order:
        order += [child for child, parent in parent_of.items() if parent == name]
    loose = [name for name in bones if name not in order]
    if loose:
        raise file_error(path, f"{', '.join(loose)[:80]} hangs from nothing in :hierarchy")
    return {name: parent_of.get(name, "") for name in order}


def _motion(path: Path) -> dict[str, np.ndarray]:
    """Of each bone that moves: its numbers (F, n)."""
    frames: list[dict[str, list[str]]] = []
    for words in _lines(path, "an AMC file"):
        if words[0].startswith(":"):
            continue
        if len(words) == 1 and _FRAME.fullmatch(words[0]):
            frames.append({})
        elif not frames:
            raise file_error(path, f"an AMC file has numbered frames of bones, got {' '.join(words)[:60]!r}")
        else:
            frames[-1][words[0]] = words[1:]
    if not frames or not frames[0]:
        raise file_error(path, "holds no frame of motion, or one that moves no bone")
    lengths = {name: len(words) for name, words in frames[0].items()}
    for k, frame in enumerate(frames, 1):
        if {name: len(words) for name, words in frame.items()} != lengths:
            raise file_error(
                path, f"frame {k} of {len(frames)} lacks numbers that the first one has; was it copied completely?"
            )
    return {
        name: parse_numbers(path, f"numbers of {name}", [word for frame in frames for word in frame[name]])
        .reshape(len(frames), -1)
        for name in lengths
    }  # fmt: skip
