"""Blocks of posed, clothed bodies for the generator."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidarpose.body.clips import load_clips
from lidarpose.body.motion import sample_rotations
from lidarpose.body.person import clothing, sample_people
from lidarpose.body.retarget import retarget_positions, without_yaw
from lidarpose.body.rig import load_rig, pose_bodies, vertex_normals
from lidarpose.errors import InputError
from lidarpose.geometry import axis_angle_to_matrix
from lidarpose.skeleton import SMPL24

# spread of the small turns that make two draws of one captured pose differ, rad
_VARIATION = 0.06
_MIRROR = np.diag([1.0, -1.0, 1.0])


@dataclass(frozen=True, kw_only=True)
class PoseBank:
    """Captured poses: local rotations (n, 24, 3, 3) float32, facing +x, in the rest frame of `body.rig`."""

    rotations: np.ndarray

    @classmethod
    def from_clips(cls, path: str | Path, subjects: tuple[str, ...]) -> "PoseBank":
        """Clips of an npz of joint positions (see `body.clips`) whose names begin with one of `subjects`."""
        clips = load_clips(path).of(subjects)
        if len(clips.joints) == 0:
            raise InputError(f"{path}: no clip of subject {', '.join(subjects)}")
        return cls(rotations=without_yaw(retarget_positions(clips.joints)).astype(np.float32))


@dataclass(frozen=True, kw_only=True)
class Bodies:
    """Posed, clothed bodies that face +x with their lowest point at z = 0: vertices (n, V, 3), joints (n, 26, 3) m;
    faces (F, 3), face_part (F,) as in `body.rig`."""

    vertices: np.ndarray
    joints: np.ndarray
    faces: np.ndarray
    face_part: np.ndarray


def draw_bodies(bank: PoseBank | None, captured: float, count: int, seed: int, block: int) -> Bodies:
    """The `count` bodies of a block; a function of (seed, block) and of where poses come from."""
    rng = np.random.default_rng([seed, 0, block])
    rig = load_rig()
    rotations = sample_rotations(rng, count).rotations
    if bank is not None:
        drawn = _vary(bank.rotations[rng.integers(len(bank.rotations), size=count)], rng)
        rotations = np.where((rng.random(count) < captured)[:, None, None, None], drawn, rotations)
    rest = rig.rest(sample_people(rng, count).coefficients)
    vertices, joints = pose_bodies(rig, rest, rotations, np.zeros((count, 3), np.float32))
    vertices = vertices + clothing(rng, rig, count)[..., None] * vertex_normals(rig.faces, vertices)
    lift = np.array([0, 0, 1], np.float32) * vertices[..., 2].min(1)[:, None, None]
    return Bodies(
        vertices=(vertices - lift).astype(np.float32),
        joints=joints - lift,
        faces=rig.faces,
        face_part=rig.face_part,
    )


def _vary(rotations: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Captured rotations (n, 24, 3, 3), each bone turned a little at random, and half of the people mirrored."""
    turned = rotations @ axis_angle_to_matrix(rng.normal(0, _VARIATION, rotations.shape[:2] + (3,)))
    across = _MIRROR @ turned[:, list(SMPL24.flip)] @ _MIRROR
    return np.where((rng.random(len(rotations)) < 0.5)[:, None, None, None], across, turned).astype(np.float32)
