"""Posed, clothed bodies for the generator: blocks of single poses, and clips of one person who moves."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidarpose.body.mocap import load_motion
from lidarpose.body.mocap.motion import Motion, facing_x
from lidarpose.body.mocap.retarget import mean_adult_joints
from lidarpose.body.pose_prior.activities import KINDS
from lidarpose.body.pose_prior.sampling import sample_rotations
from lidarpose.body.rig import RestBody, load_rig, pose_bodies
from lidarpose.body.shape import clothing, sample_people
from lidarpose.errors import InputError, MissingExtra
from lidarpose.geometry import axis_angle_to_matrix
from lidarpose.skeleton import SMPL24

try:
    from lidarpose.body.rig_kernels import dress_people
except ImportError as error:  # pragma: no cover - numba is an optional extra
    raise MissingExtra("synthesis", "synth") from error

# how long a rosette's frame lasts, s: how far bodies are moved on for it
FRAME_TIME = 0.1
# frames a second of clips
CLIP_HZ = 10.0
_MOST_HZ = 30.0
# spread of the small turns that make two draws of one captured pose differ, rad
_VARIATION = 0.06
_MIRROR = np.diag([1.0, -1.0, 1.0])


@dataclass(frozen=True, kw_only=True)
class PoseBank:
    """Captured poses in the rest frame of `body.rig`: local rotations (n, 24, 3, 3) float32, facing +x; moved
    (n, 24, 3, 3) and step (n, 3) m, `FRAME_TIME` s later (see `body.mocap.motion.Moves`); clips: their
    motion."""

    rotations: np.ndarray
    moved: np.ndarray
    step: np.ndarray
    clips: Motion

    @classmethod
    def of_motion(cls, motion: Motion) -> "PoseBank":
        """All poses of a motion that go on for `FRAME_TIME` s. Raises InputError where none does."""
        moves = motion.pairs(FRAME_TIME)
        if not len(moves.rotations):
            raise InputError(f"{motion.source}: no clip goes on for {FRAME_TIME:g} s")
        return cls(rotations=moves.rotations, moved=moves.moved, step=moves.step, clips=motion.resampled(CLIP_HZ))

    @classmethod
    def from_clips(cls, path: str | Path, subjects: tuple[str, ...] | None = None) -> "PoseBank":
        """A file or folder of motion of any format of `body.mocap`; the clips whose names begin with one of
        `subjects`, by default all."""
        motion = load_motion(path)
        # more frames a second are hardly more poses
        motion = motion.resampled(_MOST_HZ) if motion.fps > _MOST_HZ else motion
        return cls.of_motion(motion.of(subjects) if subjects else motion)

    def clip(self, frames: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray] | None:
        """Rotations (frames, 24, 3, 3) and the pelvis's place (frames, 3) m at `CLIP_HZ`, beginning over the origin,
        facing +x; None where no clip is so long."""
        windows = self.clips.windows(frames)
        if not len(windows):
            return None
        picked = windows[rng.integers(len(windows))][None]
        rotations, place = facing_x(self.clips.rotations[picked], self.clips.translation[picked])
        rotations, (place,) = _vary(rotations, rng, place)
        return rotations[0], place[0]


@dataclass(frozen=True, kw_only=True)
class Bodies:
    """Posed, clothed bodies that face +x with their lowest point at z = 0: vertices (n, V, 3), joints (n, 26, 3) m;
    kinds (n,) names of what they do ("captured" for poses of a bank); extent: see `extents`; faces (F, 3) and
    face_part (F,) as in `body.rig`.

    The rest is what `moved` needs: rest bodies, clothes (n, V) m, moved_rotations (n, 24, 3, 3), step (n, 3) m and
    lift (n,) m; None are moved_rotations and step of bodies that do not move.
    """

    vertices: np.ndarray
    joints: np.ndarray
    kinds: tuple[str, ...]
    extent: tuple[tuple[list[float], list[float]], ...]
    faces: np.ndarray
    face_part: np.ndarray
    rest: RestBody
    clothes: np.ndarray
    moved_rotations: np.ndarray | None
    step: np.ndarray | None
    lift: np.ndarray

    def moved(self, row: int) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (V, 3) and joints (26, 3) of body `row`, `FRAME_TIME` s later. Raises InputError where the block was
        drawn with moving=False."""
        if self.moved_rotations is None or self.step is None:
            raise InputError("these bodies do not move: draw them with moving=True")
        one = slice(row, row + 1)
        vertices, joints, _, _ = dressed(
            RestBody(vertices=self.rest.vertices[one], joints=self.rest.joints[one]),
            self.clothes[one],
            self.moved_rotations[one],
            self.step[one],
        )
        down = np.array([0, 0, self.lift[row]], np.float32)
        return vertices[0] - down, joints[0] - down


def draw_bodies(
    bank: PoseBank | None,
    captured: float,
    count: int,
    seed: int,
    block: int,
    *,
    moving: bool = True,
    clothes: float = 1.0,
) -> Bodies:
    """The `count` bodies of a block; a function of (seed, block) and of where poses come from. Unless `moving`, they
    cannot be `moved`; clothes: see `SceneConfig`."""
    rng = np.random.default_rng([seed, 0, block])
    rig = load_rig()
    prior = sample_rotations(rng, count, dt=FRAME_TIME if moving else 0.0)
    rotations, moved, step = prior.rotations, prior.moved, prior.step
    kinds = np.array(KINDS)[prior.kind]
    if bank is not None:
        picked = rng.integers(len(bank.rotations), size=count)
        both, (way,) = _vary(np.stack([bank.rotations[picked], bank.moved[picked]], 1), rng, bank.step[picked, None])
        chosen = rng.random(count) < captured
        mask = chosen[:, None, None, None]
        rotations = np.where(mask, both[:, 0], rotations)
        if moving:
            moved, step = np.where(mask, both[:, 1], moved), np.where(chosen[:, None], way[:, 0], step)
        kinds = np.where(chosen, "captured", kinds)
    rest = rig.rest(sample_people(rng, count).coefficients)
    worn = clothing(rng, count) * np.float32(clothes)
    vertices, joints, low, high = dressed(rest, worn, rotations, np.zeros((count, 3), np.float32))
    lift = low[:, 2].copy()
    vertices[..., 2] -= lift[:, None]
    joints[..., 2] -= lift[:, None]
    low[:, 2], high[:, 2] = 0, high[:, 2] - lift
    return Bodies(
        vertices=vertices,
        joints=joints,
        kinds=tuple(kinds.tolist()),
        extent=extents(low, high),
        faces=rig.faces,
        face_part=rig.face_part,
        rest=rest,
        clothes=worn,
        moved_rotations=moved if moving else None,
        step=step * strides(rest, kinds) if moving else None,
        lift=lift,
    )


def strides(rest: RestBody, kinds: Sequence[str]) -> np.ndarray:
    """(n, 1) float32: how long the steps of people (n) are beside the mean adult's, whose way all motion has: as their
    legs, or feet would slide. Cyclists' are as long."""
    mean = _legs(mean_adult_joints()[None])
    rolls = np.array([kind == "cycle" for kind in kinds])
    return np.where(rolls, 1.0, _legs(rest.joints) / mean)[:, None].astype(np.float32)


def _legs(joints: np.ndarray) -> np.ndarray:
    """(n,) m: from the left hip over the knee to the ankle."""
    hip, knee, ankle = (joints[:, SMPL24.index(f"left_{name}")] for name in ("hip", "knee", "ankle"))
    return np.linalg.norm(hip - knee, axis=-1) + np.linalg.norm(knee - ankle, axis=-1)


def dressed(
    rest: RestBody, clothes: np.ndarray, rotations: np.ndarray, translation: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (n, V, 3) and joints (n, 26, 3) m of posed bodies whose clothes stand off (n, V) m; the vertices' least
    and greatest x, y, z (n, 3)."""
    rig = load_rig()
    vertices, joints = pose_bodies(rig, rest, rotations, translation)
    low, high = np.empty((len(vertices), 3), np.float32), np.empty((len(vertices), 3), np.float32)
    dress_people(rig.faces, vertices, clothes, low, high)
    return vertices, joints, low, high


def extents(low: np.ndarray, high: np.ndarray) -> tuple[tuple[list[float], list[float]], ...]:
    """Of each of the bodies, whose least and greatest x, y, z are low and high (n, 3) m: these, as lists."""
    return tuple(zip(low.tolist(), high.tolist(), strict=True))


def _vary(
    rotations: np.ndarray, rng: np.random.Generator, *ways: np.ndarray
) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """Captured rotations (n, F, 24, 3, 3) and ways (n, F, 3): each bone of a person turned a little at random, the same
    in all F frames, and half of the people mirrored."""
    turned = rotations @ axis_angle_to_matrix(rng.normal(0, _VARIATION, (len(rotations), 1, len(SMPL24), 3)))
    across = _MIRROR @ turned[:, :, list(SMPL24.flip)] @ _MIRROR
    flipped = rng.random(len(rotations)) < 0.5
    varied = np.where(flipped[:, None, None, None, None], across, turned).astype(np.float32)
    return varied, tuple(np.where(flipped[:, None, None], way @ _MIRROR, way).astype(np.float32) for way in ways)
