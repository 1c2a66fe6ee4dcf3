"""Files of captured motion, whatever their format, as the body's rotations: `load_motion`.

    format           what it reads
    clips            .npz of this package's joint positions (see `body.mocap.motion`); retargeted
    amass            .npz of SMPL, SMPL+H or SMPL-X poses
    bvh              .bvh of any skeleton whose joints have usual names; retargeted
    amc              .amc beside its .asf; retargeted
    sloper4d         SLOPER4D's _labels.pkl
    corpus           .pkl of LIPD, FreeMotion or NoiseMotion
    lidarhuman26m    a folder of numbered pose .json files
A folder is searched for all of these.
"""

import hashlib
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from lidarpose.body.mocap.motion import Motion, join
from lidarpose.body.mocap.retarget import load_clip_positions
from lidarpose.body.mocap.skeleton_files import load_amc, load_bvh
from lidarpose.body.mocap.smpl_poses import load_amass, load_lidarhuman26m, load_pkl, pose_files
from lidarpose.errors import check_name
from lidarpose.geometry import UP_AXES
from lidarpose.io.files import content_digest, file_error, read_bytes
from lidarpose.io.npz import read_npz


def load_npz(path: str | os.PathLike, *, up: str | None = None, fps: float | None = None) -> Motion:
    """The motion of an npz file: this package's clips of joint positions, or AMASS's."""
    names = read_npz(path, (), expected="an npz file of motion")[1]
    return (load_clip_positions if "joints" in names else load_amass)(path, up=up, fps=fps)


# the suffix of a format's files, and how they are read
FORMATS: dict[str, Callable[..., Motion]] = {
    ".npz": load_npz,
    ".bvh": load_bvh,
    ".amc": load_amc,
    ".pkl": load_pkl,
    ".json": load_lidarhuman26m,
}
# what lies beside the motion in AMASS's folders and holds none
_NO_MOTION = ("shape.npz", "stagei.npz")


def load_motion(
    path: str | os.PathLike, *, up: str | None = None, fps: float | None = None, hz: float | None = None
) -> Motion:
    """Reads the motion of a file, or of all files in a folder and its folders, as rotations of the shipped body.

    Rotation formats (AMASS, LiDARHuman26M, SLOPER4D, corpora) keep every turn; the others are retargeted by positions.
    Frames that are not finite are left out; `Motion.dropped` counts them.

    Args:
        path: A folder's clips are named by their paths in it, and get the lowest rate among its files unless `hz` is
            given.
        up: The axis of the recording that is up, "x", "y" or "z", with a minus where it points down, by default the
            format's (BVH: the one people stand along).
        fps: The recording's frames a second, by default the file's.
        hz: Resample each file to so many frames a second.

    Raises:
        InputError: Naming the file, for everything that cannot be read.
    """
    if up is not None:
        check_name("up axis", up, UP_AXES)
    for name, rate in (("fps", fps), ("hz", hz)):
        if rate is not None and not 0 < rate < float("inf"):
            raise file_error(path, f"{name} must be frames a second, above 0, got {rate}")
    try:
        path = Path(path)
        whole_folder = path.is_dir()
    except (TypeError, ValueError) as error:
        raise file_error(repr(path), f"expected the path of a file or folder of motion ({error})") from None
    sources = _sources(path) if whole_folder else [path]
    if not sources:
        raise file_error(path, f"holds no file of motion; read are {', '.join(FORMATS)} in it or its folders")
    motions = []
    for source in sources:
        motion = _loader(source)(source, up=up, fps=fps)
        motion = motion if hz is None else motion.resampled(hz)
        motions.append(replace(motion, names=tuple(_name_in_folder(name, source, path) for name in motion.names)))
    return join(motions, source=f"{len(motions)} files: {path}") if whole_folder else motions[0]


def _loader(path: Path) -> Callable[..., Motion]:
    suffix = ".json" if path.is_dir() else path.suffix.lower()
    if suffix not in FORMATS:
        expected = f"a file of motion, one of {', '.join(FORMATS)}, or a folder of them"
        # says whether there is such a file at all
        read_bytes(path, expected=expected)
        raise file_error(path, f"expected {expected}: convert it, or give it the suffix of its format")
    return FORMATS[suffix]


def _sources(folder: Path) -> list[Path]:
    """Files of motion in a folder and its folders, and its folders of pose files, in the order of their names."""
    sources = []
    for directory, _, names in os.walk(folder):
        files = [Path(directory, name) for name in names if not name.lower().endswith(_NO_MOTION)]
        sources += [file for file in files if file.suffix.lower() in FORMATS.keys() - {".json"}]
        if pose_files(Path(directory)):
            sources.append(Path(directory))
    return sorted(sources)


def digest(path: str | os.PathLike) -> str:
    """16 hexadecimal digits that tell one recording from another: of a file its content's, of a folder those of the
    files of motion in it and its folders and of the skeletons beside them. Raises InputError."""
    path = Path(path)
    if not path.is_dir():
        return content_digest(path, expected="motion")[:16]
    files = sorted(Path(directory, name) for directory, _, names in os.walk(path) for name in names)
    files = [file for file in files if file.suffix.lower() in (*FORMATS, ".asf")]
    lines = [f"{file.relative_to(path).as_posix()} {content_digest(file, expected='motion')}" for file in files]
    return hashlib.sha256("\n".join(lines).encode("utf-8", "surrogateescape")).hexdigest()[:16]


def _name_in_folder(name: str, source: Path, folder: Path) -> str:
    """A clip's name with the place of its file in the folder that is read: 02_01 of 02/02_01.bvh -> 02/02_01."""
    if source == folder:
        return name
    stem = source.name if source.is_dir() else source.stem
    prefix = source.relative_to(folder).with_name(stem).as_posix()
    return prefix + name.removeprefix(stem) if name.startswith(stem) else f"{prefix}/{name}"
