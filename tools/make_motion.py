r"""Creates the file of captured motion for `--motion` from downloaded motion capture archives.

    python tools/make_motion.py cmu/subjects --subjects 2 5 --out cmu_motion.npz

FOLDER (several may be given) is searched for .amc files with their .asf, .bvh and .npz files. The layout of the created
file is in `lidarpose.body.mocap.motion`: SMPL's 24 joints in meters, z up, at 10 frames per second. Positions are those
of the mean adult body with the captured motion; retargeting them once more moves a joint by 4 mm on average.

The bundled weights were trained on subjects 2, 5, 13 and 14 of the CMU database, bd and dg of HDM05 and the first third
of clips of eight people of ReActIdle, here in npz files with clips named 013_acted, 013_genuine, ...:

    python tools/make_motion.py FILES --subjects 2 5 13 14 bd dg 0 1 3 4 9 10 --without 014_acted 014_genuine \
        --first 0.3334 "*_acted" "*_genuine" --out wide_motion.npz

The benches use poses of CMU 6 and 7, HDM05 bk and ReActIdle 014 and 015: exclude these from training. This script
downloads nothing. Archives and the names of their clips:

    CMU         mocap.cs.cmu.edu, subjects/02/02.asf and 02_01.amc          002_01
    HDM05       resources.mpi-inf.mpg.de/HDM05, HDM_bd.asf and              bd_squat1Reps_001
                HDM_bd_squat1Reps_001_120.amc
    others      .bvh of any common skeleton                                 the file's name

A subject is the part of a clip's name before the first `_`; numbers may be given without leading zeros.
"""

import argparse
import io
import sys
from collections.abc import Iterable, Sequence
from contextlib import suppress
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np

from lidarpose.body.mocap import load_motion
from lidarpose.body.rig import forward_kinematics, mean_adult_joints
from lidarpose.errors import InputError
from lidarpose.io.atomic import write_atomic
from lidarpose.io.files import folders_below
from lidarpose.skeleton import SMPL24

SUFFIXES = (".amc", ".bvh", ".npz")
HZ = 10.0


def clip_name(name: str) -> str:
    """The clip name for a file name: 02_01 -> 002_01, HDM_bd_squat1Reps_001_120 -> bd_squat1Reps_001."""
    if name.startswith("HDM_"):
        name = name.removeprefix("HDM_").removesuffix("_120")
    subject, separator, rest = name.partition("_")
    return subject.zfill(3) + separator + rest if subject.isdecimal() else name


def is_of(name: str, subjects: list[str]) -> bool:
    """Whether a clip is of one of the subjects; True if no subjects are given."""
    subject_names = {subject.zfill(3) if subject.isdecimal() else subject for subject in subjects}
    return not subject_names or name.partition("_")[0] in subject_names


def read_clips(
    folders: list[Path],
    subjects: list[str],
    *,
    without: Sequence[str] = (),
    fps: float | None = None,
    up: str | None = None,
) -> dict[str, np.ndarray]:
    """Joints of the mean adult, by clip name.

    Args:
        folders: searched for files with `SUFFIXES`.
        subjects: subjects whose clips are read; all clips if empty.
        without: patterns of the names of clips that are left out, with all pieces of a clip that was cut.
        fps: frames per second of .amc files, which do not state it; None: 120, as in CMU and HDM05.
        up: the recordings' up axis; None: as determined by `load_motion`.

    Returns:
        (frames, 24, 3) float32 m each, z up, at `HZ` frames per second, sorted by name.

    Raises:
        InputError: a folder or a subject is missing, a file cannot be read, two clips have one name, or a pattern fits
            no clip.
    """
    names: list[str] = []
    clips: dict[str, np.ndarray] = {}
    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"{folder}: expected a folder of {', '.join(SUFFIXES)} files; give the unpacked archive")
        files = (directory / name for directory, names_there in folders_below(folder) for name in names_there)
        for path in sorted((path for path in files if path.suffix.lower() in SUFFIXES), key=Path.as_posix):
            # an npz file contains the names of its clips
            if path.suffix.lower() != ".npz" and not is_of(clip_name(path.stem), subjects):
                continue
            motion = load_motion(path, hz=HZ, fps=fps if path.suffix.lower() == ".amc" else None, up=up)
            for c, name in enumerate(map(clip_name, motion.names)):
                if not is_of(name, subjects):
                    continue
                names.append(name)
                if is_like(name, without):
                    continue
                if name in clips:
                    raise InputError(f"{path}: there are two clips {name}; give each recording once")
                frames = motion.frames(c)
                clips[name] = mean_adult(motion.rotations[frames], motion.translation[frames])
    missing_subjects = [subject for subject in subjects if not any(is_of(name, [subject]) for name in clips)]
    if missing_subjects or not clips:
        what = f"clip of subject {', '.join(missing_subjects)}" if missing_subjects else f"{', '.join(SUFFIXES)} file"
        raise InputError(f"{', '.join(map(str, folders))}: no {what} there")
    check_patterns("--without", without, names)
    return dict(sorted(clips.items()))


def is_like(name: str, patterns: Sequence[str]) -> bool:
    """Whether a clip, or the clip of which it is a piece (NAME#2), fits a pattern."""
    whole_name = name.partition("#")[0]
    return any(fnmatchcase(n, clip_name(pattern)) for pattern in patterns for n in (name, whole_name))


def check_patterns(option: str, patterns: Sequence[str], names: Iterable[str]) -> None:
    """Raises InputError for a pattern that fits none of the clips."""
    useless = [pattern for pattern in patterns if not any(is_like(name, [pattern]) for name in names)]
    if useless:
        raise InputError(f"{option}: no clip is called {', '.join(useless)}; check the names")


def mean_adult(rotations: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """(frames, 24, 3) float32 m: the joints of the mean adult in these poses."""
    rest = mean_adult_joints()[None].astype(np.float32)
    return forward_kinematics(SMPL24.parents, rest, rotations, translation)[1].astype(np.float32)


def first_share(words: list[str]) -> float:
    """The share in `--first SHARE CLIP ...`. Raises InputError if the value is invalid."""
    if not words:
        return 1.0
    with suppress(ValueError):
        if 0 < float(words[0]) <= 1 and words[1:]:
            return float(words[0])
    raise InputError(f"--first: expected a share above 0 and at most 1, and clips, got {' '.join(words)}")


def save_clips(path: Path, clips: dict[str, np.ndarray]) -> None:
    length = np.array([len(joints) for joints in clips.values()])
    content = io.BytesIO()
    np.savez_compressed(
        content,
        joints=np.concatenate(list(clips.values())),
        joint_names=np.array(SMPL24.joints),
        clip=np.array(list(clips)),
        clip_start=np.cumsum(length) - length,
        clip_length=length,
        fps=np.array(HZ),
    )
    write_atomic(path, content.getvalue())


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER")
    parser.add_argument("--subjects", nargs="+", default=[], metavar="SUBJECT", help="default: everybody")
    parser.add_argument("--without", nargs="+", default=[], metavar="CLIP", help="clips to leave out; may have * and ?")
    first_help = "keep only the first share, above 0 and at most 1, of the frames of these clips"
    parser.add_argument("--first", nargs="+", default=[], metavar=("SHARE", "CLIP"), help=first_help)
    parser.add_argument("--fps", type=float, help="frames a second of .amc files (default: 120)")
    parser.add_argument("--up", help="up axis of the recordings (default: what their format says)")
    parser.add_argument("--out", required=True, type=Path, metavar="FILE.npz")
    args = parser.parse_args(arguments)
    try:
        share = first_share(args.first)
        clips = read_clips(args.folders, args.subjects, without=args.without, fps=args.fps, up=args.up)
        check_patterns("--first", args.first[1:], list(clips))
        clips = {
            name: joints[: max(int(share * len(joints)), 1)] if is_like(name, args.first[1:]) else joints
            for name, joints in clips.items()
        }
        save_clips(args.out, clips)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    frames = sum(map(len, clips.values()))
    print(f"{args.out}: {len(clips)} clips, {frames:,} frames at {HZ:g} a second")
    return 0


if __name__ == "__main__":
    sys.exit(main())
