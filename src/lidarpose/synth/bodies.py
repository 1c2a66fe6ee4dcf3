"""Posed, clothed bodies for the generator: blocks of single poses, and clips of one moving person."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import ceil
from pathlib import Path

import numpy as np

from lidarpose.body.mocap import load_motion
from lidarpose.body.mocap.motion import Motion, facing_x
from lidarpose.body.mocap.smpl_poses import load_betas
from lidarpose.body.pose_prior.activities import KINDS
from lidarpose.body.pose_prior.clearance import cleared
from lidarpose.body.pose_prior.sampling import sample_clips, sample_rotations
from lidarpose.body.rig import RestBody, Rig, clothing, load_rig, mean_adult_joints, pose_bodies
from lidarpose.body.smpl import load_body
from lidarpose.errors import InputError, MissingExtra
from lidarpose.geometry import axis_angle_to_matrix, rotation_about
from lidarpose.skeleton import SMPL24
from lidarpose.synth.scene import RandomStream

try:
    from lidarpose.body.rig_kernels import dress_people
except ImportError as error:  # pragma: no cover - numba is an optional extra
    raise MissingExtra("synthesis", "synth") from error

# duration of a frame, s; `moved` bodies are this much later
FRAME_TIME = 0.1
# frame rate of clips
CLIP_HZ = 10.0
# captured motion of a higher frame rate is resampled to this one
_MOST_HZ = 30.0
# standard deviation of the random bone rotations that make two draws of one captured pose differ, rad
_VARIATION = 0.06
_MIRROR = np.diag([1.0, -1.0, 1.0])
# number of shapes drawn for a user's body if the motion has no shapes
_SHAPES = 256
# a captured body whose lowest point is at most this far above the lowest of its clip stands on the ground, m
_JUMP = 0.06
# if the median distance of people from a recording's origin is in the range `_SENSED`, the origin is the LiDAR, as in
# LiDARHuman26M; other recordings are of rooms or walks, and their median position is moved to `_AHEAD` m ahead of the
# sensor
_SENSED, _AHEAD = (4.0, 40.0), 12.0


def smpl_rig(body: str | Path, motion: str | Path | None = None, subjects: tuple[str, ...] = ()) -> Rig:
    """The user's SMPL, SMPL+H or SMPL-X file as the body for synthesis.

    Args:
        body: the file.
        motion: a file or folder of motion; its people's shapes are used, of a folder those of the subjects, see
            `load_betas`. If there are none, `_SHAPES` shapes are drawn from a normal distribution.
        subjects: by default all.
    """
    betas = np.zeros((0, 1)) if motion is None else load_betas(motion, subjects)
    if not len(betas):
        betas = np.clip(np.random.default_rng(0).normal(size=(_SHAPES, 10)), -2, 2)
    model = load_body(body)
    return model.rig(betas[:, : model.shape_count])


@dataclass(frozen=True, kw_only=True)
class PoseBank:
    """Captured poses in the rest frame of `body.rig`: local rotations (n, 24, 3, 3) float32, facing +x; moved
    (n, 24, 3, 3), the rotations `FRAME_TIME` s later, and step (n, 3) m, the translation until then (see
    `Motion.pairs`); places (n, 3): where they were recorded relative to a sensor at the origin, x, y m and heading
    rad; clips: the motion that they are from."""

    rotations: np.ndarray
    moved: np.ndarray
    step: np.ndarray
    places: np.ndarray
    clips: Motion

    @classmethod
    def of_motion(cls, motion: Motion) -> "PoseBank":
        """All poses of a motion whose clip continues for `FRAME_TIME` s. Raises InputError if there is none."""
        rotations, moved, step = motion.pairs(FRAME_TIME)
        if not len(rotations):
            raise InputError(f"{motion.source}: no clip lasts {FRAME_TIME:g} s")
        places = motion.places(FRAME_TIME)
        if not _SENSED[0] <= np.median(np.hypot(places[:, 0], places[:, 1])) <= _SENSED[1]:
            places[:, :2] += np.array([_AHEAD, 0.0], np.float32) - np.median(places[:, :2], 0)
        return cls(rotations=rotations, moved=moved, step=step, places=places, clips=motion.resampled(CLIP_HZ))

    @classmethod
    def from_clips(cls, path: str | Path, subjects: tuple[str, ...] | None = None) -> "PoseBank":
        """Reads a file or folder of motion in any format of `body.mocap`: the clips whose names begin with one of
        `subjects`, by default all."""
        motion = load_motion(path)
        # a higher frame rate adds hardly any different poses
        motion = motion.resampled(_MOST_HZ) if motion.fps > _MOST_HZ else motion
        return cls.of_motion(motion.of(subjects) if subjects else motion)

    def clip(
        self, frames: int, rng: np.random.Generator, *, tempo: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Rotations (frames, 24, 3, 3) and pelvis positions (frames, 3) m of a random clip at `CLIP_HZ`, starting above
        the origin, facing +x; None if no clip is long enough. tempo: see `SceneConfig`; if no clip is long enough for
        the drawn speed, the original speed is used."""
        speed = np.exp(rng.uniform(-tempo, tempo)) if tempo else 1.0
        length = ceil((frames - 1) * speed) + 1
        starts = self.clips.window_starts(length)
        if not len(starts):
            speed, length, starts = 1.0, frames, self.clips.window_starts(frames)
        if not len(starts):
            return None
        start = starts[rng.integers(len(starts))]
        clip = self.clips.cut(np.arange(start, start + length)).resampled(CLIP_HZ / speed)
        rotations, translation = facing_x(clip.rotations[None, :frames], clip.translation[None, :frames])
        rotations, (translation,) = _vary(rotations, rng, translation)
        return rotations[0], translation[0]


@dataclass(frozen=True, kw_only=True)
class Bodies:
    """Posed, clothed bodies: a block of n people in one frame, or n frames of one person.

    Coordinates are the body's own: in a block, people face +x with their lowest point at z = 0; in a sequence, the
    first frame is at the origin and faces +x, with the ground at z = 0.

    Args:
        vertices: (n, V, 3) float32 m.
        joints: (n, 26, 3) float32 m, BODY26.
        rotations: (n, 24, 3, 3) as in `body.rig`.
        kinds: (n,) activities, names of `body.pose_prior.activities.KINDS`.
        heading: (n,) rad.
        extent: (n,), minimum and maximum x, y, z in axes aligned with the heading, m.
        faces, face_part: (Q, 3) and (Q,) as in `body.rig`.
        moved: row -> vertices (V, 3) and joints (26, 3) of a body `FRAME_TIME` s later.
        places: (n, 3), where captured poses were recorded, see `PoseBank`; NaN for other poses; None without a bank.
    """

    vertices: np.ndarray
    joints: np.ndarray
    rotations: np.ndarray
    kinds: tuple[str, ...]
    heading: tuple[float, ...]
    extent: tuple[tuple[list[float], list[float]], ...]
    faces: np.ndarray
    face_part: np.ndarray
    moved: Callable[[int], tuple[np.ndarray, np.ndarray]]
    places: np.ndarray | None = None

    def between(self, row: int, share: float) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (V, 3) and joints (26, 3) m of a body after a `share` of `FRAME_TIME`, linearly interpolated;
        extrapolated if below 0 or above 1."""
        if share == 0:
            return self.vertices[row], self.joints[row]
        end_state = self.moved(row)
        if share == 1:
            return end_state
        vertices, joints = (
            start_array + np.float32(share) * (end_array - start_array)
            for start_array, end_array in zip((self.vertices[row], self.joints[row]), end_state, strict=True)
        )
        return vertices, joints


def draw_bodies(
    bank: PoseBank | None,
    captured: float,
    count: int,
    seed: int,
    block: int,
    *,
    moving: bool = True,
    clothes: float = 1.0,
    mix: dict[str, float] | None = None,
    rig: Rig | None = None,
    clear_limbs: bool = False,
) -> Bodies:
    """The bodies of a block; a function of (seed, block) and of the pose source.

    Args:
        bank: captured poses, or None; captured: share of the poses that come from it.
        count: number of bodies.
        moving: whether bodies move within a frame; False is faster.
        clothes, mix: see `SceneConfig` and `sample_rotations`; rig: the body, None: the shipped one.
        clear_limbs: see `SceneConfig`; the poses `FRAME_TIME` s later get the same correction.
    """
    rng = np.random.default_rng([seed, RandomStream.BLOCK, block])
    rig = load_rig() if rig is None else rig
    prior = sample_rotations(rng, count, mix=mix, dt=FRAME_TIME if moving else 0.0)
    poses, step, kinds = np.stack([prior.rotations, prior.moved], 1), prior.step, np.array(KINDS)[prior.kind]
    places = None
    if bank is not None:
        bank_rows = rng.integers(len(bank.rotations), size=count)
        bank_poses, (bank_step,) = _vary(
            np.stack([bank.rotations[bank_rows], bank.moved[bank_rows]], 1), rng, bank.step[bank_rows, None]
        )
        is_captured = rng.random(count) < captured
        poses = np.where(is_captured[:, None, None, None, None], bank_poses if moving else bank_poses[:, :1], poses)
        step = np.where(is_captured[:, None], bank_step[:, 0] if moving else 0, step)
        kinds = np.where(is_captured, "captured", kinds)
        places = np.where(is_captured[:, None], bank.places[bank_rows], np.nan)
    rest_bodies, cloth_offsets = rig.draw_people(rng, count), clothing(rng, count, rig) * np.float32(clothes)
    if clear_limbs and bank is not None:
        poses = cleared(rig, rest_bodies, cloth_offsets, poses, np.flatnonzero(is_captured), is_clip=False)
    vertices, joints, low, high = _dressed(
        rig, rest_bodies, cloth_offsets, poses[:, 0], np.zeros((count, 3), np.float32)
    )
    lift = low[:, 2].copy()
    for heights in (vertices[..., 2], joints[..., 2]):
        heights -= lift[:, None]
    low[:, 2], high[:, 2] = 0, high[:, 2] - lift
    step = step * _stride_ratio(rest_bodies, kinds)

    # called twice for each frame: for its start and its end
    @lru_cache(maxsize=1)
    def moved(row: int) -> tuple[np.ndarray, np.ndarray]:
        rows = slice(row, row + 1)
        person = RestBody(vertices=rest_bodies.vertices[rows], joints=rest_bodies.joints[rows])
        vertices, joints, _, _ = _dressed(rig, person, cloth_offsets[rows], poses[rows, 1], step[rows])
        lift_vector = np.array([0, 0, lift[row]], np.float32)
        return vertices[0] - lift_vector, joints[0] - lift_vector

    return Bodies(
        vertices=vertices,
        joints=joints,
        rotations=poses[:, 0],
        kinds=tuple(kinds.tolist()),
        heading=(0.0,) * count,
        extent=_extents(low, high),
        faces=rig.faces,
        face_part=rig.face_part,
        moved=moved,
        places=places,
    )


def draw_moving_bodies(
    bank: PoseBank | None,
    captured: float,
    count: int,
    frames: int,
    rng: np.random.Generator,
    *,
    clothes: float = 1.0,
    tempo: float = 0.0,
    to_last: bool = False,
    mix: dict[str, float] | None = None,
    rig: Rig | None = None,
    clear_limbs: bool = False,
) -> list[Bodies]:
    """The frames of `count` moving people, at `CLIP_HZ`.

    Args:
        bank: captured poses, or None.
        captured: probability of a clip from the bank instead of one from the prior.
        clothes, tempo, mix, clear_limbs: see `SceneConfig` and `sample_clips`.
        to_last: the last frame, instead of the first, is at the origin and faces +x.
        rig: the body, None: the shipped one.
    """
    rig = load_rig() if rig is None else rig
    clips = [
        bank.clip(frames + 1, rng, tempo=tempo) if bank is not None and rng.random() < captured else None
        for _ in range(count)
    ]
    is_captured = np.array([clip is not None for clip in clips], bool)
    if prior_count := clips.count(None):
        prior_clips = sample_clips(rng, prior_count, frames=frames + 1, hz=CLIP_HZ, mix=mix)
        flat_translation = prior_clips.translation * np.array([1, 1, 0], np.float32)
        prior_motion = zip(
            prior_clips.rotations,
            flat_translation,
            [KINDS[kind] for kind in prior_clips.kind],
            prior_clips.clearance,
            strict=True,
        )
    # in the order of the draws, so that no person's source depends on their place in the block
    motion: list[tuple[np.ndarray, np.ndarray, str, np.ndarray | None]]
    motion = [next(prior_motion) if clip is None else (*clip, "captured", None) for clip in clips]
    people = rig.draw_people(rng, count)
    cloth_offsets = clothing(rng, count, rig) * np.float32(clothes)
    if clear_limbs and prior_count < count:
        rotations = np.stack([clip_rotations for clip_rotations, *_ in motion])
        rotations = cleared(rig, people, cloth_offsets, rotations, np.flatnonzero(is_captured), is_clip=True)
        motion = [(clip_rotations, *rest) for clip_rotations, (_, *rest) in zip(rotations, motion, strict=True)]
    return [
        _moving_body(
            rig,
            RestBody(vertices=people.vertices[k : k + 1], joints=people.joints[k : k + 1]),
            cloth_offsets[k : k + 1],
            *clip_motion,
            to_last=to_last,
        )
        for k, clip_motion in enumerate(motion)
    ]


def _moving_body(
    rig: Rig, person: RestBody, cloth_offsets: np.ndarray, rotations: np.ndarray, translation: np.ndarray, kind: str,
    clearance: np.ndarray | None, *, to_last: bool,
) -> Bodies:  # fmt: skip
    """One person's F frames from the motion of F + 1: rotations (F + 1, 24, 3, 3), translation (F + 1, 3) m; clearance
    (F + 1,) m, see `sampling.DrawnClips`, None for captured motion."""
    frames = len(rotations) - 1
    # heading of the pelvis's x axis
    yaw = np.arctan2(rotations[:, 0, 1, 0], rotations[:, 0, 0, 0])
    if to_last:
        rotation = rotation_about("z", -yaw[frames - 1]).astype(np.float32)
        rotations = np.concatenate([(rotation @ rotations[:, 0])[:, None], rotations[:, 1:]], 1)
        translation = (translation - translation[frames - 1] * [1, 1, 0]) @ rotation.T
        yaw = yaw - yaw[frames - 1]
    translation = translation * [*_stride_ratio(person, [kind]).repeat(2), 1]
    rest_bodies = RestBody(
        vertices=np.repeat(person.vertices, frames + 1, 0), joints=np.repeat(person.joints, frames + 1, 0)
    )
    cloth_offsets = np.repeat(cloth_offsets, frames + 1, 0)
    vertices, joints, low, _ = _dressed(rig, rest_bodies, cloth_offsets, rotations, translation)
    lowest_z = low[:, 2]
    if clearance is None:
        # the body is not as tall as the captured person: frames little above the lowest one stand on the ground
        clearance = np.maximum(lowest_z - lowest_z.min() - _JUMP, 0)
    rise = (clearance - lowest_z)[:, None, None] * np.array([0, 0, 1], np.float32)
    vertices, joints = vertices + rise, joints + rise
    aligned_vertices = vertices[:frames] @ rotation_about("z", yaw[:frames]).astype(np.float32)
    return Bodies(
        vertices=vertices[:frames],
        joints=joints[:frames],
        rotations=rotations[:frames],
        kinds=(kind,) * frames,
        heading=tuple(yaw[:frames].tolist()),
        extent=_extents(aligned_vertices.min(1), aligned_vertices.max(1)),
        faces=rig.faces,
        face_part=rig.face_part,
        moved=lambda frame: (vertices[frame + 1], joints[frame + 1]),
    )


def _stride_ratio(rest_bodies: RestBody, kinds: Sequence[str]) -> np.ndarray:
    """(n, 1) float32: factor for each person's translation. Motion has the strides of a mean adult (that of SMPL files
    the recorded person's); they are scaled with the length of the legs, or feet would slide. 1 for cyclists."""
    mean_length = _leg_length(mean_adult_joints()[None])
    is_cycling = np.array([kind == "cycle" for kind in kinds])
    return np.where(is_cycling, 1.0, _leg_length(rest_bodies.joints) / mean_length)[:, None].astype(np.float32)


def _leg_length(joints: np.ndarray) -> np.ndarray:
    """(n,) m: length from the left hip via the knee to the ankle."""
    hip, knee, ankle = (joints[:, SMPL24.index(f"left_{name}")] for name in ("hip", "knee", "ankle"))
    return np.linalg.norm(hip - knee, axis=-1) + np.linalg.norm(knee - ankle, axis=-1)


def _dressed(
    rig: Rig, rest_bodies: RestBody, clothes: np.ndarray, rotations: np.ndarray, translation: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (n, V, 3) and joints (n, 26, 3) m of posed bodies whose clothes are offset from the skin by (n, V) m;
    the vertices' minimum and maximum x, y, z (n, 3)."""
    vertices, joints = pose_bodies(rig, rest_bodies, rotations, translation)
    low, high = np.empty((len(vertices), 3), np.float32), np.empty((len(vertices), 3), np.float32)
    dress_people(rig.faces, vertices, clothes, low, high)
    return vertices, joints, low, high


def _extents(low: np.ndarray, high: np.ndarray) -> tuple[tuple[list[float], list[float]], ...]:
    return tuple(zip(low.tolist(), high.tolist(), strict=True))


def _vary(
    rotations: np.ndarray, rng: np.random.Generator, *translations: np.ndarray
) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """Captured rotations (n, F, 24, 3, 3) and translations (n, F, 3) with a small random rotation of each bone, the
    same in all F frames of a person, and half of the people mirrored."""
    perturbed_rotations = rotations @ axis_angle_to_matrix(
        rng.normal(0, _VARIATION, (len(rotations), 1, len(SMPL24), 3))
    )
    mirrored_rotations = _MIRROR @ perturbed_rotations[:, :, list(SMPL24.flip)] @ _MIRROR
    is_mirrored = rng.random(len(rotations)) < 0.5
    varied_rotations = np.where(is_mirrored[:, None, None, None, None], mirrored_rotations, perturbed_rotations).astype(
        np.float32
    )
    return varied_rotations, tuple(
        np.where(is_mirrored[:, None, None], translation @ _MIRROR, translation).astype(np.float32)
        for translation in translations
    )
