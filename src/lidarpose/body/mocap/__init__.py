"""Reads captured motion of any supported format as rotations of the body: `load_motion`.

    format           files
    clips            .npz of this package's joint positions (see `body.mocap.motion`); retargeted
    amass            .npz of SMPL, SMPL+H or SMPL-X poses
    bvh              .bvh of any skeleton with common joint names; retargeted
    amc              .amc, its .asf beside it or in the folder above; retargeted
    sloper4d         SLOPER4D's _labels.pkl
    corpus           .pkl of LIPD, FreeMotion or NoiseMotion
    lidarhuman26m    a folder of numbered pose .json files
Folders are searched recursively for all of these, also through links.
"""

import hashlib
import os
from collections.abc import Callable
from dataclasses import replace
from numbers import Real
from pathlib import Path

from lidarpose.body.mocap.motion import Motion, join
from lidarpose.body.mocap.retarget import load_clip_positions
from lidarpose.body.mocap.skeleton_files import load_amc, load_bvh
from lidarpose.body.mocap.smpl_poses import load_amass, load_lidarhuman26m, load_pkl, pose_files
from lidarpose.errors import check_name
from lidarpose.geometry import UP_AXES
from lidarpose.io.files import content_digest, file_error, folders_below, read_bytes
from lidarpose.io.npz import read_npz


def load_npz(path: str | os.PathLike, *, up: str | None = None, fps: float | None = None) -> Motion:
    """The motion of an npz file: this package's clips of joint positions, or AMASS's."""
    names = read_npz(path, (), expected="an npz file of motion")[1]
    return (load_clip_positions if "joints" in names else load_amass)(path, up=up, fps=fps)


# suffix of a format's files -> loader
FORMATS: dict[str, Callable[..., Motion]] = {
    ".npz": load_npz,
    ".bvh": load_bvh,
    ".amc": load_amc,
    ".pkl": load_pkl,
    ".json": load_lidarhuman26m,
}
# files without motion in the folders of AMASS and SLOPER4D
_NO_MOTION = ("shape.npz", "stagei.npz", "_labels_mask.pkl")


def load_motion(
    path: str | os.PathLike, *, up: str | None = None, fps: float | None = None, hz: float | None = None
) -> Motion:
    """Reads the motion of a file, or of all files in a folder and its subfolders, as rotations of the shipped body.

    Rotation formats (AMASS, LiDARHuman26M, SLOPER4D, corpora) keep all rotations, including twist; the others are
    retargeted from positions. Frames with non-finite values are dropped; `Motion.dropped` counts them.

    Args:
        path: A file or folder. A folder's clips are named by their paths in it, and are resampled to the lowest rate
            among its files unless `hz` is given.
        up: Up axis of the recording, "x", "y" or "z", with a minus if the axis points down; by default the format's
            (BVH: the axis along which people stand).
        fps: Frames per second of the recording, by default the file's.
        hz: Resample each file to this number of frames per second.

    Raises:
        InputError: For anything that cannot be read; names the file.
    """
    if up is not None:
        check_name("up axis", up, UP_AXES)
    for name, rate in (("fps", fps), ("hz", hz)):
        if rate is not None and not (isinstance(rate, Real) and 0 < rate < float("inf")):
            raise file_error(path, f"{name} must be frames per second, above 0, got {rate!r}")
    try:
        path = Path(path)
        whole_folder = path.is_dir()
    except (TypeError, ValueError) as error:
        raise file_error(repr(path), f"expected the path of a motion file or folder ({error})") from None
    sources = _sources(path) if whole_folder else [path]
    if not sources:
        raise file_error(path, f"has no motion file; expected {', '.join(FORMATS)} in it or its folders")
    motions = []
    for source in sources:
        motion = _loader(source)(source, up=up, fps=fps)
        motion = motion if hz is None else motion.resampled(hz)
        motions.append(replace(motion, names=tuple(_name_in_folder(name, source, path) for name in motion.names)))
    return join(motions, source=f"{len(motions)} files: {path}") if whole_folder else motions[0]


def _loader(path: Path) -> Callable[..., Motion]:
    suffix = ".json" if path.is_dir() else path.suffix.lower()
    if suffix not in FORMATS:
        expected = f"a motion file, one of {', '.join(FORMATS)}, or a folder of them"
        # raises its own error if there is no such file
        read_bytes(path, expected=expected)
        raise file_error(path, f"expected {expected}: convert it, or give it the suffix of its format")
    return FORMATS[suffix]


def _sources(folder: Path) -> list[Path]:
    """Motion files in a folder and its subfolders, and those of its folders that hold pose files, sorted by path."""
    sources = []
    for directory, names in folders_below(folder):
        files = [directory / name for name in names if not name.lower().endswith(_NO_MOTION)]
        sources += [file for file in files if file.suffix.lower() in FORMATS.keys() - {".json"}]
        if pose_files(directory):
            sources.append(directory)
    # SLOPER4D's labels are refined from the recordings in the folder beside them
    refined_folders = {source.parent / "mocap_data" for source in sources if source.name.endswith("_labels.pkl")}
    sources = [source for source in sources if source.parent not in refined_folders]
    # on Windows, paths themselves are compared without case
    return sorted(sources, key=Path.as_posix)


def digest(path: str | os.PathLike) -> str:
    """Digest of a recording, 16 hexadecimal digits: of a file's content, or of all motion files and skeletons (.asf) in
    a folder and its subfolders. Raises InputError."""
    path = Path(path)
    if not path.is_dir():
        return content_digest(path, expected="motion")[:16]
    files = [directory / name for directory, names in folders_below(path) for name in names]
    files = sorted((file for file in files if file.suffix.lower() in (*FORMATS, ".asf")), key=Path.as_posix)
    lines = [f"{file.relative_to(path).as_posix()} {content_digest(file, expected='motion')}" for file in files]
    return hashlib.sha256("\n".join(lines).encode("utf-8", "surrogateescape")).hexdigest()[:16]


def _name_in_folder(name: str, source: Path, folder: Path) -> str:
    """A clip's name with its file's path in the folder that is read: 02_01 of 02/02_01.bvh -> 02/02_01."""
    if source == folder:
        return name
    stem = source.name if source.is_dir() else source.stem
    prefix = source.relative_to(folder).with_name(stem).as_posix()
    return prefix + name.removeprefix(stem) if name.startswith(stem) else f"{prefix}/{name}"
