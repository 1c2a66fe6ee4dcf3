"""Clothes that stand away from the body: skirts, dresses and long coats that bridge the legs, hats and helmets.

An offset along the skin's normals (`body.rig.clothing`) cannot bridge the legs, so these are separate meshes. Their
faces have the part of the body that they hang on.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache
from math import hypot, pi

import numpy as np

from lidarpose.skeleton import BODY26
from lidarpose.synth.environment.mesh import Mesh

JOINT = {name: i for i, name in enumerate(BODY26.joints)}
Point = Sequence[float]
Points = list[Point]
# Girths of the shipped body's skin from lengths between its joints, m: weights of `_LENGTHS`, then a constant. Fitted
# to 1,500 people of `body.rig.sample_people`; residuals: back 3 mm, hip_side 4 mm, hip_front 7 mm, hip_back 5 mm.
_LENGTHS = (
    ("left_hip", "right_hip"), ("spine3", "left_collar"), ("head", "nose"), ("left_knee", "left_ankle"),
    ("left_shoulder", "left_elbow"), ("pelvis", "left_hip"),
)  # fmt: skip
_GIRTHS = {
    "back": (0.583, -1.599, 3.697, -0.311, 0.0, 0.0, -0.127),
    "hip_side": (1.737, 0.0, 0.0, -0.143, 0.0, 0.0, -0.012),
    "hip_front": (1.480, 0.0, 3.027, 0.0, -1.509, 0.0, -0.120),
    "hip_back": (2.250, 0.0, 2.298, -0.224, 0.0, -2.695, -0.098),
}


def girth(points: Points, name: str) -> float:
    """A girth of the body, m: `back` from spine3 to the skin behind it; `hip_side`, `hip_front` and `hip_back` from the
    middle of the hips to the skin. points: the 26 joints of BODY26."""
    *weights, constant = _GIRTHS[name]
    for (a, b), weight in zip(_LENGTHS, weights, strict=True):
        if weight:
            constant += weight * distance(points[JOINT[a]], points[JOINT[b]])
    return constant


def distance(a: Point, b: Point) -> float:
    return ((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2) ** 0.5


def middle(a: Point, b: Point) -> Point:
    return [(p + q) / 2 for p, q in zip(a, b, strict=True)]


def heading(points: Points) -> tuple[float, float]:
    """Horizontal unit vector x, y in the direction that the hips face."""
    left, right = points[JOINT["left_hip"]], points[JOINT["right_hip"]]
    x, y = left[1] - right[1], right[0] - left[0]
    length = max(hypot(x, y), 1e-6)
    return x / length, y / length


# --- skirts and coats

_SIDES = 14
_TURN = 2 * pi * np.arange(_SIDES) / _SIDES
# rings of a skirt: at the waist, around the hips, halfway down, at the hem
_RINGS = 4
# distance of cloth from the skin, m
_EASE = 0.015
# a leg's radius at the knee and below it, as a share of the thigh's
_KNEE, _CALF = 0.58, 0.6


@lru_cache
def _skirt_faces() -> np.ndarray:
    k = np.arange(_SIDES)
    n = (k + 1) % _SIDES
    faces = []
    for a in range(0, _SIDES * (_RINGS - 1), _SIDES):
        faces += [np.stack([a + _SIDES + k, a + _SIDES + n, a + n], 1), np.stack([a + _SIDES + k, a + n, a + k], 1)]
    return np.concatenate(faces).astype(np.int32)


@lru_cache
def _skirt_parts(below_knee: tuple[bool, ...]) -> np.ndarray:
    """1 + SMPL joint of each face: above the hips the pelvis, below them the thigh or, below the knee, the shank."""
    face_angle = _TURN[np.arange(_SIDES)] + pi / _SIDES
    is_left = np.sin(face_angle) > 0
    rows = []
    for row in range(_RINGS - 1):
        names = ("left_knee", "right_knee") if below_knee[row] else ("left_hip", "right_hip")
        part = (
            np.where(is_left, 1 + JOINT[names[0]], 1 + JOINT[names[1]]) if row else np.full(_SIDES, 1 + JOINT["pelvis"])
        )
        rows += [part, part]
    return np.concatenate(rows).astype(np.uint8)


def skirt(points: Points, u: list[float]) -> tuple[Callable[[Points], np.ndarray], Mesh, np.ndarray]:
    """A skirt, a dress or a long coat: (function from a pose to its vertices, its mesh, parts of its faces).

    u: four uniform numbers, for its length, flare, ease and whether it is a coat.
    """
    # length in units of the thigh, then of the shank: 1 is the knee, 2 the ankle
    hem = 0.35 + 1.35 * u[0] if u[3] < 0.6 else 0.5 + 0.7 * u[0]
    flare = 0.02 + 0.16 * u[1] ** 2 if u[3] < 0.6 else 0.01 + 0.05 * u[1]
    ease = _EASE + (0.02 * u[2] if u[3] < 0.6 else 0.01 + 0.025 * u[2])
    half_hem = hem / 2
    # a row of faces is below the knee if its middle is
    parts = _skirt_parts((False, half_hem / 2 > 1, (half_hem + hem) / 2 > 1))

    def vertices(points: Points) -> np.ndarray:
        x, y = heading(points)
        left, right = points[JOINT["left_hip"]], points[JOINT["right_hip"]]
        side, front, back = (girth(points, g) + ease for g in ("hip_side", "hip_front", "hip_back"))
        thigh = side - distance(left, right) / 2
        depth, forward_shift = (front + back) / 2, (front - back) / 2
        hips = middle(left, right)
        pelvis = points[JOINT["pelvis"]]
        half_axis = (max(side - depth, 0.0) * -y, max(side - depth, 0.0) * x, 0.0)
        hip_center = (hips[0] + forward_shift * x, hips[1] + forward_shift * y, hips[2])
        waist = (pelvis[0] + 0.8 * forward_shift * x, pelvis[1] + 0.8 * forward_shift * y, pelvis[2] + 0.04)
        rings: list[tuple[Point, Point, float]] = [(waist, half_axis, 0.92 * depth), (hip_center, half_axis, depth)]
        for level, share in ((half_hem, 0.5), (hem, 1.0)):
            legs = [_leg(points, name, level) for name in ("left", "right")]
            radius = thigh * (1 + (_KNEE - 1) * level if level < 1 else _CALF) + ease + flare * share
            half_distance = tuple((a - b) / 2 for a, b in zip(*legs, strict=True))
            rings.append((tuple(middle(*legs)), half_distance, max(radius, 0.6 * depth * (1 - 0.3 * level))))
        centers, halves, radii = (np.array(part) for part in zip(*rings, strict=True))
        directions = np.stack([x * np.cos(_TURN) - y * np.sin(_TURN), y * np.cos(_TURN) + x * np.sin(_TURN)], 1)
        # the hull of two circles: each vertex follows the leg on its side
        lengths = np.maximum(np.hypot(halves[:, 0], halves[:, 1]), 1e-6)
        side_weight = np.clip(2.5 * (halves[:, :2] / lengths[:, None]) @ directions.T, -1, 1)
        cloth = centers[:, None] + side_weight[..., None] * halves[:, None]
        cloth[..., :2] += (radii[:, None] * _FOLDS)[..., None] * directions
        cloth[..., 2] = np.maximum(cloth[..., 2], 0.02)
        return cloth.reshape(-1, 3).astype(np.float32)

    return vertices, Mesh(vertices(points), _skirt_faces()), parts


# factor on the radius of each ring's vertices: folds that deepen toward the hem
_FOLDS = 1 + np.array([0.0, 0.0, 0.03, 0.06])[:, None] * np.where(np.arange(_SIDES) % 2, 1, -1)


def _leg(points: Points, side: str, level: float) -> tuple[float, float, float]:
    """The point at `level` down a leg: 0 the hip, 1 the knee, 2 the ankle."""
    hip, knee, ankle = (points[JOINT[f"{side}_{name}"]] for name in ("hip", "knee", "ankle"))
    a, b, t = (hip, knee, level) if level < 1 else (knee, ankle, level - 1)
    return (a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1]), a[2] + t * (b[2] - a[2]))


# --- hats

# the skull relative to the middle of the head, as multiples of the distance from there to the nose: half its length,
# half its width, the height of the crown, and the forward offset of its middle
_SKULL = (0.89, 0.75, 1.08, 0.05)


def hat_frame(points: Points, edge: float) -> tuple[list[list[float]], Point]:
    """Rows and origin that put the mesh "hat" or "cap" on the head. edge: height of its rim, as a share of the way from
    the middle of the head to the crown."""
    nose, center, base = (points[JOINT[name]] for name in ("nose", "head_center", "head"))
    nose_axis = [a - b for a, b in zip(nose, center, strict=True)]
    up = [a - b for a, b in zip(center, base, strict=True)]
    size = max(distance(nose, center), 1e-6)
    # the direction to the nose is 10 degrees below the head's horizontal; up is made perpendicular to it
    nose_axis = [a / size for a in nose_axis]
    projection = sum(a * b for a, b in zip(nose_axis, up, strict=True))
    up = [a - projection * b for a, b in zip(up, nose_axis, strict=True)]
    norm = max(sum(a * a for a in up) ** 0.5, 1e-6)
    up = [a / norm for a in up]
    forward_axis = [0.985 * a + 0.17 * b for a, b in zip(nose_axis, up, strict=True)]
    up = [0.985 * b - 0.17 * a for a, b in zip(nose_axis, up, strict=True)]
    left = [
        up[1] * forward_axis[2] - up[2] * forward_axis[1],
        up[2] * forward_axis[0] - up[0] * forward_axis[2],
        up[0] * forward_axis[1] - up[1] * forward_axis[0],
    ]
    length, width, crown, forward = (size * s for s in _SKULL)
    rise = edge * crown
    rows = [[(length + _HAIR) * a for a in forward_axis], [(width + _HAIR) * a for a in left]]
    rows.append([(crown - rise + _HAIR) * a for a in up])
    origin = [c + forward * a + rise * u for c, a, u in zip(center, forward_axis, up, strict=True)]
    return rows, origin


# thickness of hair and hat, m
_HAIR = 0.02
