"""npz files of motion: AMASS (SMPL, SMPL+H or SMPL-X poses) and this package's own clips of joint positions.

AMASS: `poses` (N, 156 or 165; 66 and 72 are read too) or `root_orient` (N, 3) and `pose_body` (N, 63), radians;
`trans` (N, 3) m; `mocap_framerate` or `mocap_frame_rate`; z up. Betas, gender, fingers and faces are not used.
Source: AMASS (Mahmood et al. 2019), its README on the layout.
"""

import io
import os
from pathlib import Path

import numpy as np

from lidarpose.body.mocap.motion import Motion, archive, load_clips
from lidarpose.body.mocap.positions import positions_motion
from lidarpose.body.mocap.smpl_poses import smpl_motion
from lidarpose.io.files import file_error, read_bytes

_RATES = ("mocap_framerate", "mocap_frame_rate", "fps")
_BODY = 66  # the root and SMPL's 21 joints of the body, 3 numbers each; SMPL has two hands more, the others fingers
_SMPL = 72
_KEYS = ("poses", "root_orient", "pose_body", "trans", *_RATES)


def load_npz(path: str | os.PathLike, *, up: str | None = None, fps: float | None = None) -> Motion:
    """Motion of an npz file, AMASS's or own clips (see `body.mocap.motion`); z is up unless `up` says otherwise."""
    data = read_bytes(path, expected="an npz file of motion")
    with archive(path):
        loaded = np.load(io.BytesIO(data), allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            raise file_error(path, "is a single array, not an npz of motion")
        with loaded as file:
            names = set(file.files)
            stored = {key: file[key] for key in _KEYS if key in names and "joints" not in names}
    if "joints" in names:
        return positions_motion(path, load_clips(path), up=up, fps=fps)
    return _amass(path, names, stored, up=up, fps=fps)


def _amass(
    path: object, names: set[str], stored: dict[str, np.ndarray], *, up: str | None, fps: float | None
) -> Motion:
    poses = stored.get("poses")
    if poses is None and {"root_orient", "pose_body"} <= names:
        parts = [stored["root_orient"], stored["pose_body"]]
        shapes = [part.shape[1:] for part in parts]
        if shapes != [(3,), (63,)] or len(parts[0]) != len(parts[1]):
            raise file_error(
                path, f"needs root_orient (N, 3) and pose_body (N, 63), got {parts[0].shape}, {parts[1].shape}"
            )
        poses = np.concatenate(parts, 1) if all(part.dtype.kind in "iuf" for part in parts) else parts[0]
    if poses is None or "trans" not in names:
        raise file_error(
            path,
            f"holds {', '.join(sorted(names)) or 'nothing'}; an npz of motion needs poses (or root_orient and "
            "pose_body), trans and mocap_framerate (AMASS), or joints, clip, clip_start, clip_length and fps",
        )
    if poses.dtype.kind not in "iuf" or poses.ndim != 2 or poses.shape[1] < _BODY:
        raise file_error(path, f"poses must be numbers (N, 66 or more) as (N, 156), got {poses.dtype} {poses.shape}")
    if fps is None:
        rate = next((stored[key] for key in _RATES if key in names), None)
        if rate is None:
            raise file_error(path, "does not say its frame rate (mocap_framerate); give load_motion fps=")
        if rate.size != 1 or rate.dtype.kind not in "iuf":
            raise file_error(
                path, f"the frame rate must be one number, got {rate.dtype} {rate.shape}; give load_motion fps="
            )
        fps = float(rate.item())
    kept = _SMPL if poses.shape[1] == _SMPL else _BODY
    pose = np.zeros((len(poses), _SMPL))
    pose[:, :kept] = poses[:, :kept]
    return smpl_motion(path, pose, stored["trans"], name=Path(path).stem, fps=fps, up=up, kind="AMASS")
