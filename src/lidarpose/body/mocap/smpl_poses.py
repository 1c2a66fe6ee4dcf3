"""SMPL's axis-angle poses on the shipped body, without SMPL.

Both bodies have the same 24 joints and rest in a T-pose; SMPL's looks along +z with y up and its left along +x. With
C the change of axes from SMPL's rest pose to the house's, and W from the recording's world to the house's,

    R_house[j] = C R_smpl[j] C^-1        R_house[root] = W R_smpl[root] C^-1
"""

import numpy as np

from lidarpose.body.mocap.motion import Motion
from lidarpose.body.mocap.segments import cut
from lidarpose.geometry import UP_AXES, axis_angle_to_matrix, rotation_from_up
from lidarpose.io.files import file_error

_TO_HOUSE = UP_AXES["y"]
# rotations beyond this are degrees, rad
_MOST_TURN = 4 * np.pi
# nobody is as far from the origin of a recording, m
_FARTHEST = 1e5
# mean share of the trunk along an axis from which people are said to stand along it
_STANDS = 0.7


def smpl_motion(
    path: object,
    pose: np.ndarray,
    trans: np.ndarray,
    *,
    name: str,
    fps: float,
    up: str | None,
    kind: str,
    number: np.ndarray | None = None,
) -> Motion:
    """One clip of SMPL poses: pose (F, 72) rad, the root first, trans (F, 3) m, world with the axis `up` upwards, z
    where nobody says.

    SMPL's pelvis is at `trans` plus its rest position, which only SMPL's own file knows: a constant of the person,
    about 0.24 m along the recording's y axis, is missing from `Motion.translation`. number (F,) numbers the frames.
    Raises InputError for other shapes, for degrees, for far-off positions, and, unless `up` is said, where people do
    not stand along z: those whose `up` is said may lie.
    """
    world = rotation_from_up(up or "z")
    pose, trans = (_numbers(path, value, what) for value, what in ((pose, "pose"), (trans, "trans")))
    if pose.ndim != 2 or pose.shape[1] != 72 or trans.shape != (len(pose), 3):
        raise file_error(path, f"{kind} needs pose (frames, 72) and trans (frames, 3), got {pose.shape}, {trans.shape}")
    if not 0 < fps < np.inf:
        raise file_error(path, f"the frame rate must be above 0, got {fps}; give load_motion fps=")
    good = np.isfinite(pose).all(1) & np.isfinite(trans).all(1)
    names, start, length = cut(path, name, good, number)
    pose, trans = pose[good].reshape(-1, 24, 3), trans[good]
    with np.errstate(over="ignore"):
        most, far = np.linalg.norm(pose, axis=-1).max(), np.linalg.norm(trans, axis=-1).max()
    if most > _MOST_TURN:
        raise file_error(path, f"pose has a turn of {most:.4g} rad; {kind} has axis-angles in radians, not degrees")
    if far > _FARTHEST:
        raise file_error(path, f"trans is {far:.4g} m from the origin; expected metres")

    rotations = np.empty((len(pose), 24, 3, 3), np.float32)
    rotations[:, 1:] = _TO_HOUSE @ axis_angle_to_matrix(pose[:, 1:]) @ _TO_HOUSE.T
    root = axis_angle_to_matrix(pose[:, 0])
    rotations[:, 0] = world @ root @ _TO_HOUSE.T
    if up is None:
        _check_upright(path, root[..., 1].mean(0))
    return Motion(
        rotations=rotations,
        translation=(trans @ world.T).astype(np.float32),
        names=names,
        start=start,
        length=length,
        fps=float(fps),
        source=f"{kind}: {path}",
        dropped=int((~good).sum()),
    )


def _check_upright(path: object, trunk: np.ndarray) -> None:
    """Raises InputError where the mean direction of the trunk lies along another axis than z."""
    axis = int(np.abs(trunk).argmax())
    stands = "xyz"[axis]
    if stands != "z" and abs(trunk[axis]) > _STANDS:
        stands = f"-{stands}" if trunk[axis] < 0 else stands
        raise file_error(path, f"people stand along {stands}, not z; give load_motion up={stands!r}")


def _numbers(path: object, value: object, what: str) -> np.ndarray:
    try:
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError, OverflowError, MemoryError):
        raise file_error(path, f"{what} must be numbers in rows of equal length") from None
