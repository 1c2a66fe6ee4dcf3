"""ASF and AMC: Acclaim's skeleton (bones with directions and lengths) and its motion, as CMU's database has them.

A bone turns about its own axes: with A the rotation of its `axis` and M that of its numbers, both R_z R_y R_x where
the order is XYZ, its local rotation is A M A^-1; it goes from its parent's end, along its `direction` as turned by
its global rotation, for its `length`. Lengths are inches / 0.45 where `length` is 0.45, y is up.
Source: the format's description and CMU's database (mocap.cs.cmu.edu), its page on units.
"""

import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidarpose.body.mocap.joint_tree import Tree, tree_motion
from lidarpose.body.mocap.motion import Motion
from lidarpose.geometry import rotation_about
from lidarpose.io.files import file_error, read_bytes

# frames a second of CMU's database; an AMC file does not say its own
CMU_FPS = 120.0
_INCH = 0.0254
_ROOT_ORDER = ("TX", "TY", "TZ", "RX", "RY", "RZ")
_FREEDOMS = ("rx", "ry", "rz", "tx", "ty", "tz")
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


@dataclass(frozen=True, kw_only=True)
class _Bone:
    name: str
    offset: np.ndarray
    axis: np.ndarray
    freedoms: tuple[str, ...]


def load_amc(path: str | os.PathLike, *, up: str | None = None, fps: float | None = None) -> Motion:
    """The motion of an AMC file as one clip, named as the file.

    Its skeleton is the ASF file of the same name, of the name up to the last `_` (02.asf for 02_01.amc), or the only
    one in the folder. fps: by default CMU's 120; up: by default y.
    """
    path = Path(path)
    values = _motion(path)
    skeleton = _skeleton_of(path)
    bones, parents, scale, degrees = _skeleton(skeleton)
    known = {bone.name for bone in bones}
    unknown = sorted(values.keys() - known)
    if unknown:
        raise file_error(path, f"moves {', '.join(unknown)[:80]}, which {skeleton.name} does not have; is it this one?")
    missing = [b for j, b in _BONES.items() if b not in known and j not in _OPTIONAL]
    if missing:
        raise file_error(skeleton, f"has no bone {', '.join(missing)} among {', '.join(sorted(known))}")
    index = {bone.name: i for i, bone in enumerate(bones)}
    tree = Tree(
        names=[bone.name for bone in bones],
        parents=parents,
        positions=_positions(path, bones, parents, values, degrees),
    )
    found = {joint: index[bone] for joint, bone in _BONES.items() if bone in index}
    return tree_motion(
        path,
        tree,
        name=path.stem,
        fps=fps or CMU_FPS,
        up=up or "y",
        kind="AMC",
        unit_m=scale,
        found=found,
    )


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


def _numbers(path: Path, what: str, words: list[str], count: int | None = None) -> np.ndarray:
    try:
        value = np.array(words, float)
    except ValueError:
        value = np.zeros(0)
    if len(value) == 0 or (count is not None and len(value) != count):
        raise file_error(path, f"{what} must be {count or ''} numbers, got {' '.join(words)[:60]!r}".replace("  ", " "))
    return value


def _skeleton(path: Path) -> tuple[list[_Bone], list[int], float, bool]:
    """The bones, the root first and parents before children, their parents, metres of a number, and whether angles
    are in degrees."""
    sections: dict[str, list[list[str]]] = {}
    current = None
    for words in _lines(path, "an ASF file"):
        if words[0].startswith(":"):
            current = sections.setdefault(words[0].lower(), [])
            if words[1:]:
                current.append(words[1:])
        elif current is not None:
            current.append(words)
    needed = (":root", ":bonedata", ":hierarchy")
    missing = [name for name in needed if name not in sections]
    if missing:
        raise file_error(path, f"an ASF file has {', '.join(needed)}; {', '.join(missing)} is missing")
    units = {words[0].lower(): words[1] for words in sections.get(":units", []) if len(words) > 1}
    length = _numbers(path, "length of :units", [units.get("length", "0.45")], 1)[0]
    if not 1e-6 < length < 1e6:
        raise file_error(path, f"length of :units must be above 0, got {length}")
    angle = units.get("angle", "deg").lower()
    if angle not in ("deg", "rad", "degrees", "radians"):
        raise file_error(path, f"angle of :units must be deg or rad, got {angle[:40]!r}")
    degrees = angle.startswith("deg")
    bones = {"root": _root(path, sections[":root"], degrees)}
    for bone in _bones(path, sections[":bonedata"], degrees):
        if bone.name in bones:
            raise file_error(path, f"has the bone {bone.name} twice")
        bones[bone.name] = bone
    parent_of = _hierarchy(path, sections[":hierarchy"], bones)
    order = ["root"]
    for name in order:
        order += [child for child, parent in parent_of.items() if parent == name]
    loose = [name for name in bones if name not in order]
    if loose:
        raise file_error(path, f"{', '.join(loose)[:80]} hangs from nothing in :hierarchy")
    index = {name: i for i, name in enumerate(order)}
    parents = [-1, *(index[parent_of[name]] for name in order[1:])]
    return [bones[name] for name in order], parents, _INCH / length, degrees


def _root(path: Path, lines: list[list[str]], degrees: bool) -> _Bone:
    stored = {words[0].lower(): words[1:] for words in lines}
    order = tuple(word.upper() for word in stored.get("order", _ROOT_ORDER))
    if sorted(order) != sorted(_ROOT_ORDER):
        raise file_error(path, f"order of :root must be TX TY TZ RX RY RZ in any order, got {' '.join(order)[:60]}")
    offset = _finite(path, "position of :root", stored.get("position", ["0"] * 3))
    angles = _finite(path, "orientation of :root", stored.get("orientation", ["0"] * 3))
    axis = _rotation(path, "root", angles, (stored.get("axis") or ["XYZ"])[0], degrees)
    return _Bone(name="root", offset=offset, axis=axis, freedoms=tuple(word.lower() for word in order))


def _bones(path: Path, lines: list[list[str]], degrees: bool) -> list[_Bone]:
    bones, current = [], None
    for words in lines:
        key = words[0].lower()
        if key == "begin":
            current = {}
        elif key == "end":
            if current is None or "name" not in current or not current["name"]:
                raise file_error(path, "a bone of :bonedata has no name, or an end without begin")
            bones.append(_bone(path, current, degrees))
            current = None
        elif current is not None:
            current.setdefault(key, words[1:])
    if current is not None:
        raise file_error(path, ":bonedata stops inside a bone; was it copied completely?")
    return bones


def _bone(path: Path, stored: dict[str, list[str]], degrees: bool) -> _Bone:
    name = stored["name"][0]
    missing = [key for key in ("direction", "length") if key not in stored]
    if missing:
        raise file_error(path, f"bone {name} has no {', '.join(missing)}")
    direction = _finite(path, f"direction of {name}", stored["direction"])
    length = _finite(path, f"length of {name}", stored["length"], 1)[0]
    axis = stored.get("axis", ["0", "0", "0", "XYZ"])
    angles = _finite(path, f"axis of {name}", axis[:3])
    freedoms = tuple(word.lower() for word in stored.get("dof", []))
    unknown = [word for word in freedoms if word not in _FREEDOMS]
    if unknown:
        raise file_error(path, f"bone {name} has the freedom {unknown[0][:40]!r}; known are {', '.join(_FREEDOMS)}")
    with np.errstate(over="ignore"):
        size = np.linalg.norm(direction)
        offset = direction / size * length if 0 < size < np.inf else np.zeros(3)
    return _Bone(
        name=name,
        offset=offset,
        axis=_rotation(path, name, angles, axis[3] if len(axis) > 3 else "XYZ", degrees),
        freedoms=freedoms,
    )


def _finite(path: Path, what: str, words: list[str], count: int = 3) -> np.ndarray:
    value = _numbers(path, what, words, count)
    if not np.isfinite(value).all():
        raise file_error(path, f"{what} must be finite, got {' '.join(words)[:60]}")
    return value


def _rotation(path: Path, name: str, angles: np.ndarray, order: str, degrees: bool) -> np.ndarray:
    if sorted(order.upper()) != ["X", "Y", "Z"]:
        raise file_error(path, f"axis of {name} must have an order such as XYZ, got {order[:40]!r}")
    turn = np.eye(3)
    for letter, angle in zip(order.lower(), np.radians(angles) if degrees else angles, strict=True):
        turn = rotation_about(letter, angle) @ turn
    return turn


def _hierarchy(path: Path, lines: list[list[str]], bones: dict[str, _Bone]) -> dict[str, str]:
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
    return parent_of


_FRAME = re.compile("[0-9]{1,12}")


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
    if not frames:
        raise file_error(path, "holds no frame of motion")
    values = {}
    for name, words in frames[0].items():
        for k, frame in enumerate(frames):
            if len(frame) != len(frames[0]) or len(frame.get(name, ())) != len(words):
                raise file_error(
                    path, f"frame {k + 1} of {len(frames)} lacks numbers of {name} or others; was it copied completely?"
                )
        values[name] = _numbers(path, f"numbers of {name}", [word for frame in frames for word in frame[name]])
        values[name] = values[name].reshape(len(frames), -1)
    return values


def _positions(
    path: Path, bones: list[_Bone], parents: list[int], values: dict[str, np.ndarray], degrees: bool
) -> np.ndarray:
    """Ends of the bones (F, N, 3); NaN in frames with values that are no numbers."""
    if not values:
        raise file_error(path, "moves no bone")
    good = np.all([np.isfinite(value).all(1) for value in values.values()], 0)
    count = int(good.sum())
    turned, at = [], []
    for bone, parent in zip(bones, parents, strict=True):
        moved = values.get(bone.name)
        if moved is not None and moved.shape[1] != len(bone.freedoms):
            raise file_error(
                path, f"{bone.name} has {moved.shape[1]} numbers a frame, its skeleton {len(bone.freedoms)} freedoms"
            )
        turn, shift = np.broadcast_to(np.eye(3), (count, 3, 3)), np.zeros((count, 3))
        for k, freedom in enumerate(bone.freedoms if moved is not None else ()):
            value = moved[good, k]
            if freedom[0] == "t":
                shift[:, "xyz".index(freedom[1])] = value
            else:
                turn = rotation_about(freedom[1], np.radians(value) if degrees else value) @ turn
        turn = bone.axis @ turn @ bone.axis.T
        with np.errstate(over="ignore", invalid="ignore"):
            if parent < 0:
                turned.append(turn)
                at.append(bone.offset + shift)
            else:
                turned.append(turned[parent] @ turn)
                bone_way = turned[-1] @ bone.offset + (turned[parent] @ shift[..., None])[..., 0]
                at.append(at[parent] + bone_way)
    positions = np.full((len(good), len(bones), 3), np.nan)
    positions[good] = np.stack(at, 1)
    return positions
