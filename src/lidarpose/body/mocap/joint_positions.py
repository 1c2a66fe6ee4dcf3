"""Joint positions of people, in any unit, as the body's motion: clips of SMPL's joints, and what `joint_tree` makes."""

import os
from collections.abc import Sequence

import numpy as np

from lidarpose.body.mocap.motion import Motion, check_rate, load_clips, standing_axis, usable_clips
from lidarpose.body.mocap.retarget import SHORTEST_BONE, mean_adult_joints, retarget_positions, shortest_bone
from lidarpose.body.rig import forward_kinematics
from lidarpose.geometry import rotation_from_up, unit
from lidarpose.io.files import file_error
from lidarpose.skeleton import SMPL24

_J = {name: i for i, name in enumerate(SMPL24.joints)}
_HIPS = [_J["left_hip"], _J["right_hip"]]

# how many meters a file's number is: meters, centimeters, millimeters, inches, and CMU's unit (inches / 0.45)
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254, "inch/0.45": 0.0254 / 0.45}
# people are this much smaller or larger than the mean adult
_SMALLEST, _LARGEST = 0.4, 1.45
_TYPICAL = 0.85  # between children and tall adults: inches and centimeters must be told apart for both
_UNEVEN = 2.0  # legs whose lengths are further apart than this were not measured in one unit
_FASTEST = 50.0  # m/s
_FARTHEST = 1e5  # m


def load_clip_positions(path: str | os.PathLike, *, up: str | None = None, fps: float | None = None) -> Motion:
    """The motion of a clips file (`body.mocap.motion`); z is up unless `up` says otherwise."""
    clips = load_clips(path)
    spans = [np.arange(s, s + n) for s, n in zip(clips.start, clips.length, strict=True)]
    joints = clips.joints[np.concatenate([*spans, np.zeros(0, int)]).astype(int)]
    return motion_from_joints(
        path, joints, clips.names, clips.length, fps=fps or clips.fps, up=up or "z", kind="joint positions", unit_m=1.0
    )


def motion_from_joints(
    path: object,
    joints: np.ndarray,
    names: Sequence[str],
    length: Sequence[int] | np.ndarray,
    *,
    fps: float,
    up: str | None,
    kind: str,
    unit_m: float | None = None,
) -> Motion:
    """The body's motion after joint positions. Its hips go where theirs are: where the pelvis lies above the hips
    differs from skeleton to skeleton.

    Args:
        joints: (F, 24, 3) SMPL's joints in the file's unit and axes, NaN in frames without: these are left out, and
            those with a bone of no length.
        names, length: Of the clips, one after the other.
        up: The axis that is up, by default the one along which people stand, y where they do not stand.
        unit_m: Meters of a file's number, by default the unit that gives the person the most usual size.

    Raises:
        InputError: For sizes or speeds that people do not have, upside down, or with too many frames to leave out.
    """
    check_rate(path, fps)
    good = np.isfinite(joints).all((1, 2))
    if not good.any():
        raise file_error(path, "expected joints at finite positions, got no frame with any")
    with np.errstate(over="ignore", invalid="ignore"):
        joints = joints * meters_per_unit(path, joints[good], unit_m)
    if not np.abs(joints[good]).max() < _FARTHEST:
        raise file_error(path, "joints lie farther than 100 km from the origin; expected one unit throughout")
    joints = joints @ rotation_from_up(up or _up_axis(path, joints[good])).T
    good[good] = shortest_bone(joints[good])[0] > SHORTEST_BONE
    clips = usable_clips(path, names, length, good)
    joints = joints[good]
    _check_speed(path, joints, clips["start"], fps)
    rotations = retarget_positions(joints)
    body = mean_adult_joints()[None].astype(np.float32), rotations, np.zeros((len(joints), 3), np.float32)
    at_origin = forward_kinematics(SMPL24.parents, *body)[1]
    return Motion(
        rotations=rotations,
        translation=(joints[:, _HIPS].mean(1) - at_origin[:, _HIPS].mean(1)).astype(np.float32),
        fps=float(fps),
        source=f"{kind}: {path}",
        dropped=int((~good).sum()),
        **clips,
    )


def meters_per_unit(path: object, joints: np.ndarray, unit_m: float | None = None) -> float:
    """Meters of a number of SMPL's joints (F, 24, 3): the unit that gives the person the most usual size, or `unit_m`.
    Raises InputError where that is not a person's size, and for legs of different lengths."""
    left, right, trunk = (_median_length(joints, part) for part in ("left_", "right_", "trunk"))
    if not (np.isfinite([left, right, trunk]).all() and min(left, right, trunk) > 0):
        raise file_error(path, "the legs or the trunk have no length; expected the offsets of a person's bones")
    if max(left, right) > _UNEVEN * min(left, right):
        raise file_error(path, f"the left leg is {left:.4g} long, the right {right:.4g}; expected one unit throughout")
    rest = mean_adult_joints()[None]
    ratio = ((left + right) / 2 + trunk) / (_median_length(rest, "left_") + _median_length(rest, "trunk"))
    scale = unit_m or min(UNITS.values(), key=lambda m: abs(np.log(ratio * m / _TYPICAL)))
    if not _SMALLEST < ratio * scale < _LARGEST:
        remedy = f"known units are {', '.join(UNITS)}: scale the skeleton to one of them"
        if unit_m:
            remedy = f"a number is taken for {unit_m:.4g} m: scale the recording to that"
        raise file_error(path, f"the person is {ratio * scale:.3g} times as tall as an adult; {remedy}")
    return scale


def _median_length(joints: np.ndarray, part: str) -> float:
    """Median length of a leg, or of the trunk: the line hips -> neck -> head."""
    if part == "trunk":
        line = [joints[:, _HIPS[0]] / 2 + joints[:, _HIPS[1]] / 2, joints[:, _J["neck"]], joints[:, _J["head"]]]
    else:
        line = [joints[:, _J[part + name]] for name in ("hip", "knee", "ankle")]
    return float(sum(np.median(np.linalg.norm(b - a, axis=-1)) for a, b in zip(line, line[1:], strict=False)))


def _up_axis(path: object, joints: np.ndarray) -> str:
    axis = standing_axis(unit(joints[:, _J["neck"]] - joints[:, _HIPS].mean(1))) or "y"
    if axis.startswith("-"):
        remedy = f"give load_motion up={axis!r}, or up={axis[1:]!r} if they are upside down"
        raise file_error(path, f"people stand along {axis}; {remedy}")
    return axis


def _check_speed(path: object, joints: np.ndarray, start: np.ndarray, fps: float) -> None:
    """Raises InputError where people, joints (F, 24, 3) m, are faster than any; clips begin at frames `start`."""
    steps = np.linalg.norm(np.diff(joints[:, _J["pelvis"]], axis=0), axis=-1) * fps
    # from the end of a clip to the next is no step
    steps = np.delete(steps, start[start > 0] - 1)
    if len(steps) and np.median(steps) > _FASTEST:
        raise file_error(
            path, f"people move at {np.median(steps):.4g} m/s: are positions and bones in one unit, and is fps right?"
        )
