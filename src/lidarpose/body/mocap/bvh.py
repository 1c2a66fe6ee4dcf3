"""BVH: a tree of joints with offsets and channels, then a line of numbers a frame.

A joint's rotation is the product of its rotation channels in the order they are listed, in degrees; channels of
position stand in for its offset. Units, the up axis and the rest pose are not in the file: see `tree`.
Source: the format as published with Biovision's motion data (Meredith and Maddock 2001).
"""

import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lidarpose.body.mocap.joint_tree import END, Tree, tree_motion
from lidarpose.body.mocap.motion import Motion
from lidarpose.geometry import rotation_about
from lidarpose.io.files import file_error, read_bytes

_CHANNELS = {f"{axis}{kind}": (kind, axis.lower()) for axis in "XYZ" for kind in ("position", "rotation")}
_CHANNELS = {name.lower(): value for name, value in _CHANNELS.items()}


@dataclass(kw_only=True)
class _Joint:
    name: str
    parent: int
    offset: np.ndarray | None = None
    channels: list[tuple[str, str]] = field(default_factory=list)


def load_bvh(path: str | os.PathLike, *, up: str | None = None, fps: float | None = None) -> Motion:
    """The motion of a BVH file as one clip, named as the file. up: by default the axis people stand along."""
    lines = _lines(read_bytes(path, expected="a BVH file").decode("utf-8-sig", "replace"))
    if not lines or lines[0].upper() != "HIERARCHY":
        raise file_error(path, f"a BVH file starts with HIERARCHY, got {lines[0][:40] if lines else 'nothing'!r}")
    motion = next((i for i, line in enumerate(lines) if line.upper() == "MOTION"), None)
    if motion is None:
        raise file_error(path, "has no MOTION part; was it copied completely?")
    joints = _hierarchy(path, lines[1:motion])
    if not any(joint.channels for joint in joints):
        raise file_error(path, "no joint has CHANNELS, so nobody moves: was it exported with its motion?")
    values, rate = _frames(path, lines[motion + 1 :], sum(len(joint.channels) for joint in joints))
    if fps is None and rate is None:
        raise file_error(path, "has no frame time above 0 (Frame Time: seconds); give load_motion fps=")
    tree = Tree(
        names=[joint.name for joint in joints],
        parents=[joint.parent for joint in joints],
        positions=_positions(joints, values),
    )
    return tree_motion(path, tree, name=Path(path).stem, fps=fps or rate, up=up, kind="BVH")


def _lines(text: str) -> list[str]:
    """Lines with something on them; braces stand alone."""
    lines = (line.strip() for line in text.replace("{", "\n{\n").replace("}", "\n}\n").splitlines())
    return [line for line in lines if line]


def _hierarchy(path: object, lines: list[str]) -> list[_Joint]:
    joints: list[_Joint] = []
    stack: list[int] = []  # the joints whose braces are open
    pending = None  # a joint whose brace is still to come
    for line in lines:
        words = line.split()
        key = words[0].upper()
        if key in ("ROOT", "JOINT", "END"):
            if pending is not None or (key == "ROOT") != (not stack):
                raise file_error(path, f"{line[:60]!r} stands where it cannot; joints are nested in braces of one ROOT")
            if key == "ROOT" and joints:
                raise file_error(path, "has several ROOTs; save one person a file")
            parent = stack[-1] if stack else -1
            name = joints[parent].name + END if key == "END" else line[len(words[0]) :].strip()
            pending = _Joint(name=name, parent=parent)
        elif key == "{":
            if pending is None:
                raise file_error(path, "has a { without a joint before it")
            stack.append(len(joints))
            joints.append(pending)
            pending = None
        elif key == "}":
            if not stack:
                raise file_error(path, "has a } too many")
            if joints[stack[-1]].offset is None:
                raise file_error(path, f"joint {joints[stack[-1]].name} has no OFFSET")
            stack.pop()
        elif key == "OFFSET" and stack and pending is None:
            joints[stack[-1]].offset = _offset(path, joints[stack[-1]].name, words[1:])
        elif key == "CHANNELS" and stack and pending is None:
            joints[stack[-1]].channels = _channels(path, joints[stack[-1]].name, words[1:])
        else:
            raise file_error(path, f"expected ROOT, JOINT, End Site, OFFSET, CHANNELS or a brace, got {line[:60]!r}")
    if stack or pending is not None or not joints:
        raise file_error(path, "the HIERARCHY is not complete; was the file copied completely?")
    return joints


def _offset(path: object, name: str, words: list[str]) -> np.ndarray:
    try:
        offset = np.array(words, float)
    except ValueError:
        offset = np.zeros(0)
    if offset.shape != (3,) or not np.isfinite(offset).all():
        raise file_error(path, f"OFFSET of {name} must be three numbers, got {' '.join(words)[:60]!r}")
    return offset


def _channels(path: object, name: str, words: list[str]) -> list[tuple[str, str]]:
    if not words or words[0] != str(len(words) - 1):
        raise file_error(path, f"CHANNELS of {name} must be a count and as many names, got {' '.join(words)[:60]!r}")
    unknown = [word for word in words[1:] if word.lower() not in _CHANNELS]
    if unknown:
        raise file_error(path, f"{name} has the channel {unknown[0]!r}; known are Xposition, Zrotation and the like")
    return [_CHANNELS[word.lower()] for word in words[1:]]


def _frames(path: object, lines: list[str], width: int) -> tuple[np.ndarray, float | None]:
    """The values (F, width), and frames a second or None."""
    head = dict(zip(("frames", "frame time"), (line.partition(":") for line in lines[:2]), strict=False))
    for name, (key, colon, _) in head.items():
        if key.strip().lower() != name or not colon:
            raise file_error(path, f"MOTION must begin with Frames: and Frame Time:, got {key[:40]!r}")
    if len(head) < 2:
        raise file_error(path, "MOTION must begin with Frames: and Frame Time:; was it copied completely?")
    try:
        count = int(head["frames"][2])
    except ValueError:
        count = -1
    if count < 0:
        raise file_error(path, f"Frames: must be a whole number of 0 or more, got {head['frames'][2][:40]!r}")
    try:
        seconds = float(head["frame time"][2])
    except ValueError:
        seconds = 0.0
    try:
        values = np.array(" ".join(lines[2:]).split(), float)
    except ValueError as error:
        raise file_error(path, f"MOTION must hold numbers ({error})") from None
    if len(values) != count * width:
        raise file_error(
            path,
            f"expected {count} frames of {width} numbers, got {len(values)} numbers; was it copied completely?",
        )
    # a frame time of almost nothing would be an infinite rate
    return values.reshape(count, width), 1 / seconds if 1e-6 < seconds < np.inf else None


def _positions(joints: list[_Joint], values: np.ndarray) -> np.ndarray:
    """Where the joints are, (F, N, 3); NaN in frames with values that are no numbers."""
    positions = np.full((len(values), len(joints), 3), np.nan)
    good = np.isfinite(values).all(1)
    values = values[good]
    turned, at, column = [], [], 0
    for joint in joints:
        turn = np.broadcast_to(np.eye(3), (len(values), 3, 3))
        offset = np.repeat(joint.offset[None], len(values), 0)
        for kind, axis in joint.channels:
            value = values[:, column]
            column += 1
            if kind == "position":
                offset[:, "xyz".index(axis)] = value
            else:
                turn = turn @ rotation_about(axis, np.radians(value))
        if joint.parent < 0:
            turned.append(turn)
            at.append(offset)
        else:
            with np.errstate(over="ignore", invalid="ignore"):
                at.append(at[joint.parent] + (turned[joint.parent] @ offset[..., None])[..., 0])
            turned.append(turned[joint.parent] @ turn)
    positions[good] = np.stack(at, 1)
    return positions
