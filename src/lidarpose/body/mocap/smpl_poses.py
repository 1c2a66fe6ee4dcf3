"""SMPL's axis-angle poses on the shipped body, without SMPL: AMASS, SLOPER4D, LiDARHuman26M.

Both bodies have the same 24 joints and a T-pose at rest; SMPL's faces +z with y up and its left along +x. With C the
rotation from SMPL's rest frame to the level frame, and W from the recording's world to the level frame,

    R_level[j] = C R_smpl[j] C^-1        R_level[root] = W R_smpl[root] C^-1

SMPL's pelvis is at `trans` plus its rest position, which only SMPL's own model file defines. `Motion.translation` lacks
this offset, a constant per person of about 0.24 m along the recording's y axis. Shapes, fingers and faces are not used.

AMASS: npz of `poses` (N, 156 or 165; 66 and 72 are read too) or `root_orient` (N, 3) and `pose_body` (N, 63), rad;
`trans` (N, 3) m; `mocap_framerate` or `mocap_frame_rate`; z up. Source: Mahmood et al. 2019, README for the layout.

SLOPER4D: <sequence>_labels.pkl with `framerate`, and for `first_person` and `second_person` `pose` (n, 72) rad and
`trans` (n, 3) m, world, z up; the refined `opt_pose` and `opt_trans` are preferred. Source: Dai et al. 2023, the
published loader.

LiDARHuman26M: a folder with one JSON file per frame, labels/3d/pose/<sequence>/<frame>.json, with `pose` (72) rad and
`trans` (3) m in the sensor's frame. Source: LiDARCap, Li et al. 2022, the data set's page and published loaders.

LIPD, FreeMotion, NoiseMotion: pickles of a list of dicts as in `data.readers.corpora`, with `gt` (72 or (3, 72) rad,
the middle one is used) and `T_1` or `trans` (3) m, or LIPD's `gt_joint` (24, 3) m if there are no poses. All entries
with the same `seq_path` or `motion_id`, in order, form a clip.
"""

import os
import reprlib
import warnings
from collections import Counter
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose.body.mocap.leveling import leveling
from lidarpose.body.mocap.motion import Motion, is_of, join, standing_axis, usable_clips
from lidarpose.body.mocap.retarget import motion_from_joints
from lidarpose.body.rig import forward_kinematics, mean_adult_joints
from lidarpose.errors import InputError
from lidarpose.geometry import UP_AXES, axis_angle_to_matrix, rotation_from_up
from lidarpose.io.files import FRAME_NUMBER, file_error, folders_below, read_json
from lidarpose.io.npz import read_npz
from lidarpose.io.pickles import load_pickle
from lidarpose.skeleton import SMPL24

_R_LEVEL_SMPL = UP_AXES["y"]
# larger rotations mean that the unit is degrees, rad
_MOST_TURN = 4 * np.pi
# largest distance of a position from the recording's origin, m
_FARTHEST = 1e5

_RATES = ("mocap_framerate", "mocap_frame_rate", "fps")
_BODY = 66  # the root and 21 body joints, 3 numbers each; then SMPL has two hands, the others fingers
_SMPL = 72
_PEOPLE = ("first_person", "second_person")
# number of shape coefficients that are read
_BETAS = 10
# frames per second of the LiDAR of LiDARHuman26M's labels
LIDARHUMAN26M_FPS = 10.0
_POSE_FILE = "a JSON file with pose and trans"


def motion_from_smpl(
    path: object,
    pose: Any,
    trans: Any,
    *,
    name: str,
    fps: float,
    up: str | None,
    kind: str,
    number: np.ndarray | None = None,
) -> Motion:
    """The motion of one clip of SMPL poses.

    Args:
        pose: (F, 72) axis-angles, rad, the root first.
        trans: (F, 3) m, in a world with the up axis `up`, by default z.
        number: (F,) frame numbers in the recording, by default without gaps.

    Raises:
        InputError: For other shapes, angles in degrees, positions too far from the origin and, unless `up` is given,
            people upright along another axis than z. Give `up` for recordings of lying people.
    """
    R_level_world = rotation_from_up(up or "z")
    try:
        pose, trans = np.asarray(pose, float), np.asarray(trans, float)
    except (TypeError, ValueError, OverflowError, MemoryError):
        raise file_error(path, "pose and trans must be numbers in rows of equal length") from None
    if pose.ndim != 2 or pose.shape[1] != _SMPL or trans.shape != (len(pose), 3):
        raise file_error(path, f"{kind} needs pose (frames, 72) and trans (frames, 3), got {pose.shape}, {trans.shape}")
    is_usable = np.isfinite(pose).all(1) & np.isfinite(trans).all(1)
    clips = usable_clips(path, [name], [len(is_usable)], is_usable, fps, number)
    pose, trans = pose[is_usable].reshape(-1, 24, 3), trans[is_usable]
    with np.errstate(over="ignore"):
        max_angle, max_distance = np.linalg.norm(pose, axis=-1).max(), np.linalg.norm(trans, axis=-1).max()
    if max_angle > _MOST_TURN:
        raise file_error(
            path, f"pose has a rotation of {max_angle:.4g} rad; {kind} has axis-angles in radians, not degrees"
        )
    if max_distance > _FARTHEST:
        raise file_error(path, f"trans is {max_distance:.4g} m from the origin; expected meters")

    rotations = np.empty((len(pose), 24, 3, 3), np.float32)
    rotations[:, 1:] = _R_LEVEL_SMPL @ axis_angle_to_matrix(pose[:, 1:]) @ _R_LEVEL_SMPL.T
    root_rotations = axis_angle_to_matrix(pose[:, 0])
    rotations[:, 0] = R_level_world @ root_rotations @ _R_LEVEL_SMPL.T
    axis = standing_axis(root_rotations[..., 1])
    if up is None and axis not in ("z", None):
        remedy = f"give load_motion up={axis!r}, or up='z' if they lie"
        raise file_error(path, f"people stand or lie along {axis}, not z; {remedy}")
    return Motion(
        rotations=rotations, translation=(trans @ R_level_world.T).astype(np.float32), source=f"{kind}: {path}", **clips
    )


def load_amass(path: str | os.PathLike, *, up: str | None = None, fps: float | None = None) -> Motion:
    """The motion of an AMASS file as one clip, named after the file."""
    arrays, names = read_npz(
        path, ("poses", "root_orient", "pose_body", "trans", *_RATES), expected="an npz file of motion"
    )
    poses = arrays.get("poses")
    if poses is None and {"root_orient", "pose_body"} <= arrays.keys():
        parts = arrays["root_orient"], arrays["pose_body"]
        if [part.shape[1:] for part in parts] != [(3,), (63,)] or len(parts[0]) != len(parts[1]):
            raise file_error(
                path, f"needs root_orient (N, 3) and pose_body (N, 63), got {parts[0].shape}, {parts[1].shape}"
            )
        poses = np.concatenate(parts, 1)
    if poses is None or "trans" not in arrays:
        raise file_error(
            path,
            f"holds {', '.join(names) or 'nothing'}; an npz of motion needs poses (or root_orient and "
            "pose_body), trans and mocap_framerate (AMASS), or joints, clip, clip_start, clip_length and fps",
        )
    if poses.dtype.kind not in "iuf" or poses.ndim != 2 or poses.shape[1] < _BODY:
        raise file_error(path, f"poses must be numbers (N, 66 or more) as (N, 156), got {poses.dtype} {poses.shape}")
    if fps is None:
        fps = _frame_rate(path, next((arrays[key] for key in _RATES if key in arrays), None), _RATES[0])
    width = _SMPL if poses.shape[1] == _SMPL else _BODY
    pose = np.zeros((len(poses), _SMPL))
    pose[:, :width] = poses[:, :width]
    return motion_from_smpl(path, pose, arrays["trans"], name=Path(path).stem, fps=fps, up=up, kind="AMASS")


def _load_sloper4d(path: str | os.PathLike, labels: Any, up: str | None, fps: float | None) -> Motion:
    """The motion of SLOPER4D's labels: one clip for each person with poses, NAME_first and NAME_second."""
    if not isinstance(labels, dict):
        raise file_error(path, f"expected SLOPER4D's labels, a dict, got {type(labels).__name__}")
    motions = []
    for person in (p for p in _PEOPLE if isinstance(labels.get(p), dict)):
        pairs = [(labels[person].get(f"{prefix}pose"), labels[person].get(f"{prefix}trans")) for prefix in ("opt_", "")]
        pose_and_trans = next((pair for pair in pairs if pair[0] is not None and pair[1] is not None), None)
        if pose_and_trans is not None:
            rate = fps or _frame_rate(path, labels.get("framerate"), "framerate")
            name = f"{Path(path).stem}_{person.removesuffix('_person')}"
            number = _frame_numbers(labels.get("frame_num"), len(pose_and_trans[0]))
            about: dict[str, Any] = {"name": name, "fps": rate, "up": up, "kind": "SLOPER4D", "number": number}
            motions.append(motion_from_smpl(path, *pose_and_trans, **about))
    if not motions:
        keys = ", ".join(map(str, labels)) or "nothing"
        raise file_error(path, f"expected second_person with pose (n, 72) and trans (n, 3), got {keys}")
    return join(motions, source=f"SLOPER4D: {path}")


def _frame_numbers(labels: Any, count: int) -> np.ndarray | None:
    """SLOPER4D's frame_num (F,) as numbers that follow each other except where frames are missing, which is where a
    step is over twice the usual one; None unless it has `count` rising numbers."""
    try:
        number = np.array(labels, float)
    except (TypeError, ValueError):
        return None
    steps = np.diff(number) if number.shape == (count,) else np.zeros(1)
    if not (len(steps) and (steps > 0).all()):
        return None
    return np.cumsum(np.append(0, 1 + (steps > 2 * np.median(steps))))


def load_pkl(path: str | os.PathLike, *, up: str | None = None, fps: float | None = None) -> Motion:
    """The motion of a pickle: SLOPER4D's labels, or a corpus of LIPD, FreeMotion or NoiseMotion."""
    content = load_pickle(path)
    return (_load_corpus if isinstance(content, list) else _load_sloper4d)(path, content, up, fps)


def _load_corpus(path: str | os.PathLike, entries: list, up: str | None, fps: float | None) -> Motion:
    """One clip for each sequence of a corpus's entries. Malformed entries are skipped, and entries with only joints if
    any entry has a pose. Raises InputError if no entry remains."""
    # of each clip's entries: pose, position, and number in the sequence, which skipped entries have, too
    clips: dict[str, list[tuple[np.ndarray, np.ndarray, int]]] = {}
    counts: Counter[str] = Counter()
    entries = [entry for entry in entries if isinstance(entry, dict)]
    # clips in which any entry has a position: there, entries without one are skipped
    placed = {_clip_of(path, entry) for entry in entries if _position(entry) is not None}
    key = "gt" if any(entry.get("gt") is not None for entry in entries) else "gt_joint"
    for entry in entries:
        name = _clip_of(path, entry)
        counts[name] += 1
        try:
            pose = np.asarray(entry[key], float)
            position = _position(entry)
            trans = np.asarray(np.zeros(3) if position is None and name not in placed else position, float).reshape(3)
            # the middle one of NoiseMotion's three poses, as in its reader
            pose = pose.reshape(-1, _SMPL)[pose.size // _SMPL // 2]
        except (KeyError, TypeError, ValueError, OverflowError, IndexError):
            continue
        clips.setdefault(name, []).append((pose, trans, counts[name]))
    if not clips:
        raise file_error(path, "expected LIPD's, FreeMotion's or NoiseMotion's dicts with gt (72) or gt_joint (24, 3)")
    rate, length = fps or LIDARHUMAN26M_FPS, [len(frames) for frames in clips.values()]
    poses, positions, numbers = map(
        np.array, zip(*(frame for frames in clips.values() for frame in frames), strict=True)
    )
    if key == "gt_joint":
        joints = poses.reshape(-1, 24, 3) + positions[:, None]
        about: dict[str, Any] = {"fps": rate, "up": up, "kind": "LIPD", "unit_m": 1.0, "number": numbers}
        return motion_from_joints(path, joints, list(clips), length, **about)
    # the published loaders do not define the up axis
    finite_poses = poses[np.isfinite(poses).all(1)]
    up = up or standing_axis(axis_angle_to_matrix(finite_poses[:, :3])[..., 1]) or "z"
    ends = np.cumsum(length)
    spans = [slice(end - count, end) for end, count in zip(ends, length, strict=True)]
    motions = [
        motion_from_smpl(
            path, poses[span], positions[span], name=name, fps=rate, up=up, kind="a corpus", number=numbers[span]
        )
        for name, span in zip(clips, spans, strict=True)
    ]
    return join(motions, source=f"corpus: {path}")


def _clip_of(path: str | os.PathLike, entry: dict) -> str:
    """The name of a corpus entry's clip."""
    return str(entry.get("seq_path", entry.get("motion_id", Path(path).stem)))


def _position(entry: dict) -> Any:
    """A corpus entry's position in the first LiDAR's frame, None if it has none."""
    return next((entry[name] for name in ("T_1", "trans") if entry.get(name) is not None), None)


def load_betas(path: str | os.PathLike, subjects: Sequence[str] = ()) -> np.ndarray:
    """The distinct body shapes (n, 10) in a motion file, or in all files of a folder and its subfolders: `beta` of
    LiDARHuman26M's files and SLOPER4D's labels, `betas` of AMASS files. n is 0 if there are no shapes.

    subjects: only people of whose clips the names start with one of them, see `Motion.of`.
    """
    path = Path(path)
    files = [path]
    if path.is_dir():
        files = sorted(directory / name for directory, names in folders_below(path) for name in names)
    rows: list[np.ndarray] = []

    def is_wanted(clip: str) -> bool:
        return not subjects or any(is_of(clip, subject) for subject in subjects)

    for file in files:
        # the clip's name, as `load_motion` gives it
        clip = file.stem if file == path else file.relative_to(path).with_suffix("").as_posix()
        if file.suffix.lower() == ".json" and FRAME_NUMBER.fullmatch(file.stem):
            sequence = clip if file == path else path.stem if file.parent == path else clip.rpartition("/")[0]
            if is_wanted(sequence):
                # `load_motion` warns of damaged files in folders
                with nullcontext() if file == path else suppress(InputError):
                    content = read_json(file, expected=_POSE_FILE)
                    rows.append(_first_betas(content.get("beta") if isinstance(content, dict) else None))
        elif file.suffix.lower() == ".npz" and is_wanted(clip):
            rows.append(_first_betas(read_npz(file, ("betas",), expected="an npz file of motion")[0].get("betas")))
        elif file.suffix.lower() == ".pkl" and isinstance(labels := load_pickle(file), dict):
            people = (p for p in _PEOPLE if is_wanted(f"{clip}_{p.removesuffix('_person')}"))
            rows += [_first_betas(labels[p].get("beta")) for p in people if isinstance(labels.get(p), dict)]
    return np.unique(np.concatenate([np.zeros((0, _BETAS)), *rows]), axis=0)


def _first_betas(value: object) -> np.ndarray:
    """The first ten numbers of `value` (1, 10); (0, 10) if it does not have ten finite numbers."""
    try:
        betas = np.asarray(value, float).ravel()[:_BETAS]
    except (TypeError, ValueError):
        betas = np.zeros(0)
    return betas[None] if len(betas) == _BETAS and np.isfinite(betas).all() else np.zeros((0, _BETAS))


def _frame_rate(path: object, rate: object, key: str) -> float:
    try:
        return float(np.asarray(rate).item())
    except (TypeError, ValueError, OverflowError):
        raise file_error(path, f"does not give its frame rate as one number ({key}); give load_motion fps=") from None


def pose_files(folder: Path) -> list[Path]:
    """The JSON files of a folder whose names are frame numbers, in the order of the numbers."""
    return sorted((p for p in folder.glob("*.json") if FRAME_NUMBER.fullmatch(p.stem)), key=lambda p: int(p.stem))


def load_lidarhuman26m(path: str | os.PathLike, *, up: str | None = None, fps: float | None = None) -> Motion:
    """The motion of a folder of numbered pose files, or of a single file. A missing number or, with a warning, a
    damaged file ends a clip.

    The sensor's frame is tilted as it was mounted: unless `up` is given, the sequence is turned level by one rotation,
    as `lidarpose prepare` does. up="z" keeps the frame.
    """
    path = Path(path)
    files = pose_files(path) if path.is_dir() else [path]
    read: dict[Path, tuple[np.ndarray, np.ndarray]] = {}
    damaged: list[InputError] = []
    for file in files:
        try:
            read[file] = _read_pose_file(file)
        except InputError as error:
            damaged.append(error)
    if not read:
        raise damaged[0]
    if damaged:
        warnings.warn(f"left out {len(damaged)} of {len(files)} pose files: {damaged[0]}", stacklevel=2)
    poses, trans = zip(*read.values(), strict=True)
    number = np.array([int(file.stem) for file in read]) if path.is_dir() else None
    fps = fps or LIDARHUMAN26M_FPS
    motion = motion_from_smpl(path, poses, trans, name=path.stem, fps=fps, up=up, kind="LiDARHuman26M", number=number)
    return _leveled(motion) if up is None else motion


def _leveled(motion: Motion) -> Motion:
    """The motion in a level frame, if its people show that its own is tilted."""
    origin = np.zeros((len(motion.rotations), 3))
    joints = forward_kinematics(SMPL24.parents, mean_adult_joints()[None], motion.rotations, origin)[1]
    R_level_sensor = leveling(joints)
    if R_level_sensor is None:
        return motion
    rotations = motion.rotations.copy()
    rotations[:, 0] = R_level_sensor @ rotations[:, 0]
    translation = (motion.translation @ R_level_sensor.T).astype(np.float32)
    return replace(motion, rotations=rotations, translation=translation)


def _read_pose_file(path: Path) -> tuple[np.ndarray, np.ndarray]:
    content = read_json(path, expected=_POSE_FILE)
    try:
        pose, trans = (np.asarray(content[key], float).ravel() for key in ("pose", "trans"))
    except (TypeError, KeyError, IndexError, ValueError, OverflowError):
        pose = trans = np.zeros(0)
    if len(pose) != _SMPL or len(trans) != 3:
        raise file_error(path, f"expected pose (72 numbers) and trans (3 numbers), got {reprlib.repr(content)}")
    return pose, trans
