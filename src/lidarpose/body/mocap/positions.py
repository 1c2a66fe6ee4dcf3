"""Joint positions on the shipped body: clips of SMPL's joints in metres."""

import numpy as np

from lidarpose.body.mocap.motion import Clips, Motion
from lidarpose.body.mocap.retarget import SHORTEST_BONE, mean_adult_joints, retarget_positions, shortest_bone
from lidarpose.body.mocap.segments import cut
from lidarpose.body.mocap.units import check_speed, metres_of
from lidarpose.body.rig import forward_kinematics
from lidarpose.geometry import rotation_from_up
from lidarpose.skeleton import SMPL24

_HIPS = [SMPL24.index("left_hip"), SMPL24.index("right_hip")]


def positions_motion(path: object, clips: Clips, *, up: str | None = None, fps: float | None = None) -> Motion:
    """Clips of joint positions as the body plays them. The body's hips go where the clips' are: where the pelvis lies
    above them differs from skeleton to skeleton. Raises InputError for people of no one's size or speed, as where the
    positions are not in metres."""
    joints = clips.joints @ rotation_from_up(up or "z").T
    good = shortest_bone(joints)[0] > SHORTEST_BONE
    parts = [
        cut(path, name, good[s : s + n])
        for name, s, n in zip(clips.names, clips.start, clips.length, strict=True)
        if n > 0
    ]
    chosen = [np.arange(s, s + n)[good[s : s + n]] for s, n in zip(clips.start, clips.length, strict=True)]
    frames = np.concatenate([*chosen, np.zeros(0, int)]).astype(int)
    length = np.concatenate([*(part[2] for part in parts), np.zeros(0, int)]).astype(int)
    start, fps = np.cumsum(length) - length, float(fps or clips.fps)
    if len(frames):
        metres_of(path, joints[frames], 1.0)
        check_speed(path, joints[frames], start, fps)
    rotations, translation = played(joints[frames])
    return Motion(
        rotations=rotations,
        translation=translation,
        names=tuple(name for part in parts for name in part[0]),
        start=start,
        length=length,
        fps=fps,
        source=f"joint positions: {path}",
        dropped=int(clips.length.sum() - len(frames)),
    )


def played(joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joint positions (F, 24, 3) m -> the body's rotations (F, 24, 3, 3) and pelvis (F, 3), float32."""
    rotations = retarget_positions(joints)
    at_origin = forward_kinematics(
        SMPL24.parents, mean_adult_joints()[None].astype(np.float32), rotations, np.zeros((len(joints), 3), np.float32)
    )[1]
    return rotations, (joints[:, _HIPS].mean(1) - at_origin[:, _HIPS].mean(1)).astype(np.float32)
