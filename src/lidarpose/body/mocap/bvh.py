"""BVH: a tree of joints with offsets and channels, then a line of numbers a frame.

A joint's rotation is the product of its rotation channels in the order they are listed, in degrees; channels of
position stand in for its offset. Units, the up axis and the rest pose are not in the file: see `joint_tree`.
Source: the format as published with Biovision's motion data (Meredith and Maddock 2001).
"""

import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from lidarpose.body.mocap.joint_tree import END, JointTree, parse_numbers, tree_motion
from lidarpose.body.mocap.motion import Motion
from lidarpose.io.files import file_error, read_bytes

_CHANNELS = {f"{axis}{kind}": kind[0].replace("p", "t") + axis for axis in "xyz" for kind in ("position", "rotation")}


def load_bvh(path: str | os.PathLike, *, up: str | None = None, fps: float | None = None) -> Motion:
    """The motion of a BVH file as one clip, named as the file. up: by default the axis people stand along."""
    tree, values, rate = read_bvh(path)
    rate = fps or rate
    if rate is None:
        raise file_error(path, "has no frame time above 0 (Frame Time: seconds); give load_motion fps=")
    return tree_motion(path, tree, tree.positions(values), fps=rate, up=up, kind="BVH")


def read_bvh(path: str | os.PathLike) -> tuple[JointTree, np.ndarray, float | None]:
    """The joints of a BVH file, its frames of channels (F, C), and frames a second where it says. Raises InputError."""
    text = read_bytes(path, expected="a BVH file").decode("utf-8-sig", "replace")
    lines = [line.strip() for line in text.replace("{", "\n{\n").replace("}", "\n}\n").splitlines()]
    lines = [line for line in lines if line]
    if not lines or lines[0].upper() != "HIERARCHY":
        raise file_error(path, f"a BVH file starts with HIERARCHY, got {lines[0][:40] if lines else 'nothing'!r}")
    motion = next((i for i, line in enumerate(lines) if line.upper() == "MOTION"), None)
    if motion is None:
        raise file_error(path, "has no MOTION part; was it copied completely?")
    tree = _hierarchy(path, lines[1:motion])
    width = sum(map(len, tree.channels))
    if not width:
        raise file_error(path, "no joint has CHANNELS, so nothing moves: was it exported with its motion?")
    return tree, *_frames(path, lines[motion + 1 :], width)


def _hierarchy(path: object, lines: list[str]) -> JointTree:
    names: list[str] = []
    parents: list[int] = []
    # None until a joint's OFFSET is read
    offsets: list[Any] = []
    channels: list[Sequence[str]] = []
    open_joints: list[int] = []
    awaits_brace = False
    for line in lines:
        key, *words = line.split()
        key = key.upper()
        inside = open_joints and not awaits_brace
        if key in ("JOINT", "END") and inside or (key == "ROOT" and not names):
            parents.append(open_joints[-1] if inside else -1)
            names.append(names[parents[-1]] + END if key == "END" else line[len(key) :].strip())
            offsets.append(None)
            channels.append(())
            awaits_brace = True
        elif key == "{" and awaits_brace:
            open_joints.append(len(names) - 1)
            awaits_brace = False
        elif key == "}" and inside:
            joint = open_joints.pop()
            if offsets[joint] is None:
                raise file_error(path, f"joint {names[joint]} has no OFFSET")
        elif key == "OFFSET" and inside:
            offsets[open_joints[-1]] = parse_numbers(path, f"OFFSET of {names[open_joints[-1]]}", words, 3)
        elif key == "CHANNELS" and inside:
            channels[open_joints[-1]] = _channels(path, names[open_joints[-1]], words)
        else:
            expected = "one ROOT, and in its braces OFFSET, CHANNELS, JOINT and End Site"
            raise file_error(path, f"{line[:60]!r} stands where it cannot; expected {expected}")
    if open_joints or awaits_brace or not names:
        raise file_error(path, "the HIERARCHY is not complete; was the file copied completely?")
    moves = np.array([[f"t{axis}" in channel for axis in "xyz"] for channel in channels])
    return JointTree(names=names, parents=parents, offsets=np.where(moves, 0, offsets), channels=channels)


def _channels(path: object, name: str, words: list[str]) -> list[str]:
    if not words or words[0] != str(len(words) - 1):
        raise file_error(path, f"CHANNELS of {name} must be a count and as many names, got {' '.join(words)[:60]!r}")
    unknown = [word for word in words[1:] if word.lower() not in _CHANNELS]
    if unknown:
        raise file_error(path, f"{name} has the channel {unknown[0]!r}; known are Xposition, Zrotation and the like")
    return [_CHANNELS[word.lower()] for word in words[1:]]


def _frames(path: object, lines: list[str], width: int) -> tuple[np.ndarray, float | None]:
    """The values (F, width), and frames a second or None."""
    header = {key.strip().lower(): value for key, _, value in (line.partition(":") for line in lines[:2])}
    if list(header) != ["frames", "frame time"]:
        raise file_error(path, "MOTION must begin with Frames: and Frame Time:; was it copied completely?")
    if not header["frames"].strip().isdecimal():
        raise file_error(path, f"Frames: must be a whole number of 0 or more, got {header['frames'][:40]!r}")
    try:
        seconds = float(header["frame time"])
    except ValueError:
        seconds = 0.0
    values = parse_numbers(path, "the frames of MOTION", " ".join(lines[2:]).split())
    if len(values) != int(header["frames"]) * width:
        expected = f"{header['frames'].strip()[:20]} frames of {width} numbers"
        raise file_error(path, f"expected {expected}, got {len(values)} numbers; was it copied completely?")
    # a frame time of almost nothing would be an infinite rate
    return values.reshape(-1, width), 1 / seconds if 1e-6 < seconds < np.inf else None
