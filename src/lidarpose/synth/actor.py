"""One person before they are put in a scene: the posed, clothed bodies of their frames."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lidarpose.body.pose_prior.activities import KINDS
from lidarpose.body.pose_prior.ground_contact import stand
from lidarpose.body.pose_prior.sampling import sample_clips
from lidarpose.body.rig import RestBody, load_rig
from lidarpose.body.shape import clothing, sample_people
from lidarpose.geometry import rotation_about
from lidarpose.synth.bodies import CLIP_HZ, Bodies, PoseBank, dressed, extents, strides

# how high a captured foot may be above its clip's lowest and still stand on the ground, m
_JUMP = 0.06


@dataclass(frozen=True, kw_only=True)
class Actor:
    """A person's frames in their own frame: the first on the origin, facing +x, the ground at z = 0.

    vertices (F, V, 3), joints (F, 26, 3) m; heading (F,) rad; extent (F): a frame's least and greatest x, y, z along
    its heading; moved(f): vertices (V, 3) and joints (26, 3) when the
    sensor's frame f ends, `bodies.FRAME_TIME` s after it begins; kind: what they do; faces (Q, 3), face_part (Q,).
    """

    vertices: np.ndarray
    joints: np.ndarray
    heading: tuple[float, ...]
    extent: tuple[tuple[list[float], list[float]], ...]
    moved: Callable[[int], tuple[np.ndarray, np.ndarray]]
    kind: str
    faces: np.ndarray
    face_part: np.ndarray

    @property
    def frames(self) -> int:
        return len(self.vertices)

    @classmethod
    def of_block(cls, bodies: Bodies, row: int) -> "Actor":
        """Somebody of a block, in one frame."""
        return cls(
            vertices=bodies.vertices[row : row + 1],
            joints=bodies.joints[row : row + 1],
            heading=(0.0,),
            extent=(bodies.extent[row],),
            moved=lambda frame: bodies.moved(row),
            kind=bodies.kinds[row],
            faces=bodies.faces,
            face_part=bodies.face_part,
        )


def draw_actor(
    bank: PoseBank | None, captured: float, frames: int, rng: np.random.Generator, *, clothes: float = 1.0
) -> Actor:
    """Somebody who moves, at 10 Hz: from the prior, or with a chance of `captured` from the clips of a bank.

    clothes: see `SceneConfig`.
    """
    rig = load_rig()
    found = bank.clip(frames + 1, rng) if bank is not None and rng.random() < captured else None
    if found is not None:
        (rotations, translation), kind, clearance = found, "captured", None
    else:
        drawn = sample_clips(rng, 1, frames=frames + 1, hz=CLIP_HZ)
        rotations, translation = drawn.rotations[0], drawn.translation[0] * np.float32([1, 1, 0])
        kind, clearance = KINDS[drawn.kind[0]], drawn.clearance[0]
    person = rig.rest(sample_people(rng, 1).coefficients)
    translation = translation * [*strides(person, [kind]).repeat(2), 1]
    rest = RestBody(vertices=np.repeat(person.vertices, frames + 1, 0), joints=np.repeat(person.joints, frames + 1, 0))
    worn = np.repeat(clothing(rng, 1) * np.float32(clothes), frames + 1, 0)
    vertices, joints, low, _ = dressed(rest, worn, rotations, translation)
    lowest = low[:, 2]
    if clearance is None:
        # the body is not as tall as who was captured: what is little above the lowest frame stands on the ground
        clearance = np.maximum(lowest - lowest.min() - _JUMP, 0)
    rise = stand(lowest, clearance)[:, None, None] * np.array([0, 0, 1], np.float32)
    vertices, joints = vertices + rise, joints + rise
    # where the pelvis's x axis points
    heading = np.arctan2(rotations[:frames, 0, 1, 0], rotations[:frames, 0, 0, 0])
    turned = vertices[:frames] @ rotation_about("z", heading).astype(np.float32)
    return Actor(
        vertices=vertices[:frames],
        joints=joints[:frames],
        heading=tuple(heading.tolist()),
        extent=extents(turned.min(1), turned.max(1)),
        moved=lambda frame: (vertices[frame + 1], joints[frame + 1]),
        kind=kind,
        faces=rig.faces,
        face_part=rig.face_part,
    )
