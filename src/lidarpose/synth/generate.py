"""(seed, i) -> one person as a LiDAR sees them: body, clothes, scene, cast, faults, crop.

Person i of a seed is the same whatever was asked for before and whoever asks: poses and shapes are drawn for blocks of
`BLOCK` people (vectorised, from the block's own generator), everything else from the person's own generator.
"""

from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np

from lidarpose.data import augment
from lidarpose.errors import InputError
from lidarpose.lidar.raycast import scan
from lidarpose.lidar.sensor import Sensor, sensor
from lidarpose.sample import Box, Pose, Sample, center_of
from lidarpose.skeleton import BODY26
from lidarpose.synth.bodies import Bodies, PoseBank, draw_bodies
from lidarpose.synth.mask import laser_mask
from lidarpose.synth.mesh import Mesh, union
from lidarpose.synth.scene import SceneConfig, draw_distance, draw_height, ground, occluder, surroundings

# people whose poses and shapes are drawn together
BLOCK = 64
# a person of fewer returns is drawn again, at most so many times, each time easier to see
LEAST_POINTS = 15
_TRIES = 8
# beams beyond the person's own silhouette that are cast, m: the crop may reach there
_AROUND = 0.3
# spread of the error that all points of a ring share, m
_RING_BIAS = 0.006


@dataclass(frozen=True, kw_only=True)
class Facts:
    """What is known of a synthetic person besides the sample. sensor; distance m; visible: share of the returns of the
    body alone that occluders, masks and the crop left; height_seen: share of the body's height between its lowest
    and highest return; clutter: share of the points that are neither body nor ground; upright: stands or walks."""

    sensor: str
    distance: float
    visible: float
    height_seen: float
    clutter: float
    upright: bool

    @property
    def plain(self) -> bool:
        """Upright, whole and uncluttered."""
        return self.upright and self.visible > 0.8 and self.height_seen > 0.85 and self.clutter < 0.05


@dataclass(frozen=True, kw_only=True)
class SyntheticPerson:
    """A sample with its true pose (body26, the sensor's frame) and parts, and the facts about it if asked for."""

    sample: Sample
    facts: Facts | None


@dataclass(frozen=True, kw_only=True)
class Generator:
    """Synthetic people of one scene configuration. captured: share of poses from `bank`, the rest from the prior;
    measure: also find the facts, which costs a second cast. The sample is the same either way."""

    scene: SceneConfig
    bank: PoseBank | None = None
    captured: float = 0.0
    measure: bool = True

    def __post_init__(self):
        if self.captured and self.bank is None:
            raise InputError("Generator.captured needs a bank of captured poses, got none")
        # neighbours share a block; two suffice for a reader that crosses from one to the next
        drawn = lru_cache(maxsize=2)(partial(draw_bodies, self.bank, self.captured, BLOCK))
        object.__setattr__(self, "_bodies", drawn)

    def person(self, seed: int, index: int, *, hard: float | None = None) -> SyntheticPerson:
        """Person `index` of `seed`, at the scene's difficulty or at `hard` in [0, 1]."""
        rng = np.random.default_rng([seed, 1, index])
        scene = self.scene if hard is None else self.scene.eased(hard)
        return observe(scene, self._bodies(seed, index // BLOCK), index % BLOCK, rng, measure=self.measure)


def observe(
    config: SceneConfig, bodies: Bodies, row: int, rng: np.random.Generator, *, measure: bool = True
) -> SyntheticPerson:
    """Body `row` of a block, placed, cast, spoiled and cropped; drawn anew while hardly anything of it is seen."""
    for attempt in range(_TRIES):
        eased = config.eased(config.hard * (1 - attempt / _TRIES))
        device = sensor(config.sensors[rng.integers(len(config.sensors))])
        placed = _place(eased, bodies, row, device, attempt, rng)
        cast = _cast(eased, bodies, row, placed, device, rng)
        sample = _crop(eased, bodies.vertices[row], placed, cast, device, rng)
        if sample is not None:
            facts = _facts(sample, bodies, placed, device) if measure else None
            return SyntheticPerson(sample=sample, facts=facts)
    raise InputError(f"scene {config.name}: no draw of {_TRIES} left {LEAST_POINTS} points on a person")


@dataclass(frozen=True, kw_only=True)
class _Placed:
    """A body in the sensor's frame: vertices (V, 3), joints (26, 3), feet (3,) m, yaw rad, distance and tall m."""

    vertices: np.ndarray
    joints: np.ndarray
    feet: np.ndarray
    yaw: float
    distance: float
    tall: float


def _place(config: SceneConfig, bodies: Bodies, row: int, device: Sensor, attempt: int, rng) -> _Placed:
    """Paper: section "Scene sampling". A person too far to be seen comes nearer with every attempt."""
    distance = max(draw_distance(config, device, rng) * 0.8**attempt, config.distance[0])
    azimuth, yaw = rng.uniform(-np.pi, np.pi, 2)
    tall = float(bodies.vertices[row, :, 2].max())
    height = device.height if config.name == "paper" else draw_height(device, distance, tall, rng=rng)
    feet = np.array([distance * np.cos(azimuth), distance * np.sin(azimuth), -height])
    return _Placed(
        vertices=_turned(bodies.vertices[row], yaw) + feet,
        joints=_turned(bodies.joints[row], yaw) + feet,
        feet=feet,
        yaw=yaw,
        distance=distance,
        tall=tall,
    )


def _turned(points: np.ndarray, yaw: float) -> np.ndarray:
    c, s = np.cos(yaw), np.sin(yaw)
    return points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


@dataclass(frozen=True, kw_only=True)
class _Cast:
    """Points (n, 3) m with their faults, ring (n,), part (n,), 0 for all that is not body."""

    points: np.ndarray
    ring: np.ndarray
    part: np.ndarray


def _cast(config: SceneConfig, bodies: Bodies, row: int, placed: _Placed, device: Sensor, rng) -> _Cast:
    body = Mesh(placed.vertices, bodies.faces)
    meshes = [body, ground(config, rng).moved(placed.feet)]
    wide = float(np.abs(placed.vertices[:, :2] - placed.feet[:2]).max())
    others = surroundings(config, placed.feet, wide, rng)
    if rng.random() < config.clutter * config.hard / 3:
        others.append(_passer_by(bodies, row, placed, rng))
    thing = occluder(config, placed.feet, placed.tall, rng)
    scene = union(meshes + others + ([] if thing is None else [thing]))
    around = np.arctan(_AROUND / placed.distance) if config.name != "paper" else 0.0
    hits = scan(scene.vertices, scene.faces, device, window_vertices=placed.vertices, margin=around)
    # the body's faces come first
    on_body = hits.face < len(bodies.faces)
    part = np.zeros(len(on_body), np.uint8)
    part[on_body] = bodies.face_part[hits.face[on_body]]
    keep = rng.random(len(part)) >= device.dropout
    keep &= augment.grazing_keep(
        hits.points, _normals(scene, hits.face), strength=rng.uniform(0, 0.9) * (config.name != "paper"), rng=rng
    )
    if rng.random() < (config.mask if config.name == "paper" else config.mask * config.hard):
        share = config.keep if config.name == "paper" else rng.uniform(config.keep, 1)
        keep &= laser_mask(hits.columns, hits.rows, keep=share, rng=rng)[hits.column, hits.ring - hits.row0]
    points = augment.range_noise(
        hits.points[keep].astype(np.float64),
        hits.ring[keep],
        sigma=device.range_sigma * rng.uniform(0.5, 1.5),
        bias=_RING_BIAS * rng.random(),
        rng=rng,
    )
    return _Cast(points=points, ring=hits.ring[keep], part=part[keep])


def _passer_by(bodies: Bodies, row: int, placed: _Placed, rng) -> Mesh:
    """Another body of the block, an arm's length away."""
    other = (row + rng.integers(1, len(bodies.vertices))) % len(bodies.vertices)
    angle, gap = rng.uniform(-np.pi, np.pi), rng.uniform(0.45, 1.0)
    shift = placed.feet + gap * np.array([np.cos(angle), np.sin(angle), 0])
    return Mesh(_turned(bodies.vertices[other], rng.uniform(-np.pi, np.pi)) + shift, bodies.faces)


def _normals(scene: Mesh, face: np.ndarray) -> np.ndarray:
    a, b, c = np.moveaxis(scene.vertices[scene.faces[face]], 1, 0)
    normal = np.cross(b - a, c - a)
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)


def _crop(config: SceneConfig, body: np.ndarray, placed: _Placed, cast: _Cast, device: Sensor, rng) -> Sample | None:
    """The points in a box as a detector draws it; None where too few of them are the person's."""
    box = _box(config, body, placed, rng)
    points, ring, part = cast.points, cast.ring, cast.part
    if rng.random() < config.noise * (1 if config.name == "paper" else config.hard):
        stray = augment.noise_clusters(box.center, most=min(150, 20 + len(points) // 2), rng=rng)
        points = np.concatenate([points, stray])
        ring = np.concatenate([ring, np.zeros(len(stray), ring.dtype)])
        part = np.concatenate([part, np.zeros(len(stray), np.uint8)])
    inside = box.contains(points)
    if rng.random() < 0.1 * config.hard:
        inside &= augment.part_removal(part, rng=rng)
    points, ring, part = points[inside].astype(np.float32), ring[inside], part[inside]
    if np.count_nonzero(part) < LEAST_POINTS:
        return None
    return Sample(
        points=points,
        center=center_of(points),
        part=part,
        ring=ring,
        pose=Pose(joints=placed.joints.astype(np.float32), skeleton=BODY26, frame="sensor"),
        box=box,
        source=f"synth/{config.name}/{device.name}",
    )


# points this close to the soles count as ground, not as clutter, m
_GROUND = 0.1


def _facts(sample: Sample, bodies: Bodies, placed: _Placed, device: Sensor) -> Facts:
    alone = len(scan(placed.vertices, bodies.faces, device).points)
    seen = sample.points[sample.part > 0]
    clutter = (sample.part == 0) & (sample.points[:, 2] > placed.feet[2] + _GROUND)
    return Facts(
        sensor=device.name,
        distance=placed.distance,
        visible=min(len(seen) / max(alone, 1), 1.0),
        height_seen=float(np.ptp(seen[:, 2])) / max(float(np.ptp(placed.vertices[:, 2])), 1e-6),
        clutter=float(clutter.mean()),
        upright=_upright(placed.joints),
    )


def _box(config: SceneConfig, body: np.ndarray, placed: _Placed, rng) -> Box:
    """The person's extent along their own heading, with the errors of a detector's box: center, size, yaw; its bottom
    now above the soles, now in the ground. One in eight is loose, as a crop drawn by hand."""
    low, high = body.min(0), body.max(0)
    error = config.crop_jitter
    grown = rng.uniform(0.0, 0.2, 3) * (error > 0) + 0.05
    if error and rng.random() < 0.125:
        grown = grown + rng.uniform(0.1, 0.8)
    middle = (low + high) / 2 + rng.normal(0, error, 3) * [1, 1, 0.5]
    return Box(
        center=_turned(middle[None], placed.yaw)[0] + placed.feet,
        size=np.maximum(high - low + grown, 0.4),
        yaw=placed.yaw + rng.normal(0, error),
    )


def _upright(joints: np.ndarray) -> bool:
    """Stands or walks: trunk within 35 degrees of upright, and a knee at least at three quarters of its leg's reach."""
    pelvis, neck = joints[BODY26.index("pelvis")], joints[BODY26.index("neck")]
    if (neck - pelvis)[2] < np.cos(np.radians(35)) * np.linalg.norm(neck - pelvis):
        return False
    for side in ("left", "right"):
        hip, knee, ankle = (joints[BODY26.index(f"{side}_{name}")] for name in ("hip", "knee", "ankle"))
        leg = np.linalg.norm(hip - knee) + np.linalg.norm(knee - ankle)
        if (hip - ankle)[2] > 0.8 * leg:
            return True
    return False
