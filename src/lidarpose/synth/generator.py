"""(seed, i) -> one person as a LiDAR sees them: body, clothes, scene, cast, faults, crop.

Person i of a seed is the same whatever was asked for before and whoever asks: poses and shapes are drawn for blocks of
`BLOCK` people (vectorized, from the block's own generator), everything else from the person's own generator.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial

import numpy as np

from lidarpose.data.synthetic_info import Facts, facts_of
from lidarpose.errors import InputError, whole
from lidarpose.lidar.presets import sensor
from lidarpose.lidar.ray_pattern import RayPattern
from lidarpose.lidar.sensor import Sensor
from lidarpose.sample import Pose, Sample
from lidarpose.skeleton import BODY26
from lidarpose.synth import noise
from lidarpose.synth.actor import Actor, draw_actor
from lidarpose.synth.bodies import Bodies, PoseBank, draw_bodies
from lidarpose.synth.crop import draw_box
from lidarpose.synth.crop_kernels import center_of_cells, crop_points
from lidarpose.synth.environment.surroundings import ground, occluder, surroundings
from lidarpose.synth.placement import Place, draw_place
from lidarpose.synth.props.draw_props import Prop, draw_props
from lidarpose.synth.scene import SceneConfig, scene_config
from lidarpose.synth.simulate import Conditions, Layer, Returns, count_alone, draw_conditions, look

# people whose poses and shapes are drawn together
BLOCK = 256
# a person of fewer returns is drawn again, so often at most, each time easier to see
LEAST_POINTS = 15
_TRIES = 8
# frames of a clip
CLIP_FRAMES = 16


@dataclass(frozen=True, kw_only=True, eq=False)
class SyntheticPerson:
    """A sample with its true pose (body26, the level frame at the sensor) and parts, and the facts if asked for."""

    sample: Sample
    facts: Facts | None


@dataclass(frozen=True, kw_only=True)
class Generator:
    """Synthetic people of one scene configuration, or of a named one. captured: share of poses from `bank`, the rest
    from the prior; measure: also find the facts, which costs a second cast: the sample is the same either way; redraw:
    somebody of whom hardly anything is seen is drawn again, each time easier to see; else they stay as they are,
    without points too. May be pickled."""

    scene: SceneConfig | str
    bank: PoseBank | None = None
    captured: float = 0.0
    measure: bool = True
    redraw: bool = True

    def __post_init__(self):
        if isinstance(self.scene, str):
            object.__setattr__(self, "scene", scene_config(self.scene))
        if self.captured and self.bank is None:
            raise InputError("Generator.captured needs a bank of captured poses, got none")
        if not 0 <= self.captured <= 1:
            raise InputError(f"Generator.captured must be a share in [0, 1], got {self.captured}")
        # at once: an unknown sensor is told here
        self._bodies  # noqa: B018

    def __getstate__(self) -> dict:
        # blocks that are remembered stay where they are
        return {name: value for name, value in vars(self).items() if name != "_bodies"}

    @cached_property
    def _bodies(self) -> Callable[[int, int], Bodies]:
        """(seed, block) -> its bodies."""
        moving = any(isinstance(sensor(name), RayPattern) for name in self.scene.sensors)
        # neighbours share a block; two suffice for a reader that crosses from one to the next
        drawn = partial(draw_bodies, self.bank, self.captured, BLOCK, moving=moving, clothes=self.scene.clothes)
        return lru_cache(maxsize=2)(drawn)

    def person(self, seed: int, index: int, *, hard: float | None = None) -> SyntheticPerson:
        """Person `index` of `seed`, at the scene's difficulty or at `hard` in [0, 1]."""
        seed, index = whole("seed", seed, least=0), whole("index", index, least=0)
        rng = np.random.default_rng([seed, 1, index])
        bodies = self._bodies(seed, index // BLOCK)
        return self._observed(Actor.of_block(bodies, index % BLOCK), bodies, index % BLOCK, rng, hard)[0]

    def clip(
        self, seed: int, index: int, *, frames: int = CLIP_FRAMES, hard: float | None = None
    ) -> list[SyntheticPerson]:
        """Clip `index` of `seed`: one person who moves, `frames` samples at 10 Hz; things and sensor stay where they
        are. Frames in which nothing of the person is seen have samples without points."""
        frames = whole("a clip's frames", frames, least=1)
        seed, index = whole("seed", seed, least=0), whole("index", index, least=0)
        rng = np.random.default_rng([seed, 3, index])
        actor = draw_actor(self.bank, self.captured, frames, rng, clothes=self.scene.clothes)
        return self._observed(actor, self._bodies(seed, index // BLOCK), index % BLOCK, rng, hard)

    def _observed(
        self, actor: Actor, bodies: Bodies, row: int, rng: np.random.Generator, hard: float | None
    ) -> list[SyntheticPerson]:
        """The actor's frames; all is drawn anew, each time easier to see, while hardly anything of them is seen. Others
        come from `bodies`. After the last try the best one counts, if it has any points at all."""
        scene = self.scene if hard is None else self.scene.eased(hard)
        best, most = None, 0.0
        for attempt in range(_TRIES if self.redraw else 1):
            eased = scene.eased(scene.hard * (1 - attempt / (_TRIES - 1))) if attempt else scene
            stage = _draw_stage(eased, actor, bodies, row, 0.8**attempt, rng)
            seen = [_sample(eased, stage, actor, frame, rng) for frame in range(actor.frames)]
            # of the middle frame: half of a clip's frames have more
            points = float(np.median([np.count_nonzero(sample.part) for sample in seen]))
            if points > most or not self.redraw:
                best, most = (eased, stage, seen), points
            if points >= LEAST_POINTS:
                break
        if best is None:
            raise InputError(
                f"scene {scene.name}: no draw of {_TRIES} left a point on a person, with sensors such as "
                f"{stage.device.name}: does its range hold people at {scene.distance[0]:g} to {scene.distance[1]:g} m?"
            )
        eased, stage, seen = best
        facts = [None] * len(seen)
        if self.measure:
            facts = [_facts(eased, sample, stage, actor, frame) for frame, sample in enumerate(seen)]
        return [SyntheticPerson(sample=s, facts=f) for s, f in zip(seen, facts, strict=True)]


@dataclass(frozen=True, kw_only=True)
class _Stage:
    """What stays while a person moves: sensor, place, things (level frame), what they carry."""

    device: Sensor | RayPattern
    place: Place
    conditions: Conditions
    things: list[Layer]
    props: list[Prop]

    @property
    def lifted(self) -> Place:
        """Where the body is: above the ground by what it stands on."""
        lift = max((prop.lift for prop in self.props), default=0.0)
        return replace(self.place, feet=self.place.feet + [0, 0, lift]) if lift else self.place


def _draw_stage(
    config: SceneConfig, actor: Actor, bodies: Bodies, row: int, nearer: float, rng: np.random.Generator
) -> _Stage:
    """Paper: section "Scene sampling". A person too far to be seen comes nearer with every attempt."""
    device = sensor(config.sensors[rng.integers(len(config.sensors))])
    low, high = actor.extent[0]
    tall, wide = high[2], max(-low[0], -low[1], high[0], high[1])
    place = draw_place(config, device, tall, wide, nearer, rng)
    things = [ground(config, place.feet, rng), *surroundings(config, place.feet, wide, rng)]
    front = occluder(config, place.feet, tall, rng)
    if front is not None:
        things.append(front)
    layers = [Layer.still(thing) for thing in things]
    if rng.random() < config.company * config.hard:
        layers.append(_company(bodies, row, place, rng))
    props = []
    if rng.random() < config.carry * config.hard:
        props = draw_props(rng, kind=actor.kind, joints=actor.joints[0])
    return _Stage(
        device=device, place=place, conditions=draw_conditions(config, device, rng), things=layers, props=props
    )


# a second person: how often before the first one, as seen by the sensor; else beside
_BEFORE = 0.3
_BESIDE, _NEARER = (0.4, 1.0), (0.4, 2.5)


def _company(bodies: Bodies, row: int, place: Place, rng: np.random.Generator) -> Layer:
    """Another body of the block, an arm's length away or between the sensor and the person."""
    other = (row + rng.integers(1, len(bodies.vertices))) % len(bodies.vertices)
    before, gap, angle, aside, yaw = rng.random(5)
    ahead = place.feet[:2] / max(np.hypot(*place.feet[:2]), 1e-6)
    if before < _BEFORE:
        # not nearer to the sensor than a third of the way
        near = min(_NEARER[0] + gap * (_NEARER[1] - _NEARER[0]), 0.67 * place.distance)
        shift = -near * ahead + (aside - 0.5) * np.array([-ahead[1], ahead[0]])
    else:
        reach = _BESIDE[0] + gap * (_BESIDE[1] - _BESIDE[0])
        shift = reach * np.array([np.cos(2 * np.pi * angle), np.sin(2 * np.pi * angle)])
    there = Place(feet=place.feet + [*shift, 0], yaw=2 * np.pi * yaw, distance=place.distance, R_sensor_level=None)
    return Layer(vertices=there.of_body(bodies.vertices[other]), faces=bodies.faces)


def _sample(config: SceneConfig, stage: _Stage, actor: Actor, frame: int, rng: np.random.Generator) -> Sample:
    layers = _layers(stage, actor, frame)
    returns = look(layers, stage.device, stage.place, stage.conditions, config, rng, frame=frame)
    return _crop(config, stage, actor, frame, returns, rng)


def _layers(stage: _Stage, actor: Actor, frame: int) -> list[Layer]:
    """The body first, then what it carries, then the rest."""
    place, moving = stage.lifted, isinstance(stage.device, RayPattern) and stage.device.duration > 0
    joints = actor.joints[frame]
    moved_vertices = moved_joints = None
    if moving:
        moved_vertices, moved_joints = actor.moved(frame)
        moved_vertices = place.of_body(moved_vertices)
    layers = [
        Layer(
            vertices=place.of_body(actor.vertices[frame]),
            faces=actor.faces,
            moved=moved_vertices,
            part=actor.face_part,
        )
    ]
    for prop in stage.props:
        mesh = prop.place(joints)
        moved = place.of_body(prop.place(moved_joints).vertices) if moving else None
        part = prop.face_part
        layers.append(Layer(vertices=place.of_body(mesh.vertices), faces=mesh.faces, moved=moved, part=part))
    return layers + stage.things


def _crop(
    config: SceneConfig, stage: _Stage, actor: Actor, frame: int, returns: Returns, rng: np.random.Generator
) -> Sample:
    """The points in a box as a detector draws it."""
    faults, hard = config.faults, config.hard
    box = draw_box(config.crop, hard, actor.extent[frame], stage.lifted, rng, heading=actor.heading[frame])
    points, ring, part = returns.points, returns.ring, returns.part
    stray, missing = rng.random(2)
    if stray < faults.stray * hard:
        if faults.released:
            blobs = noise.reference_clusters(box.center, rng=rng)
        else:
            blobs = noise.noise_clusters(box.center, most=min(faults.most_stray, 20 + len(points) // 2), rng=rng)
        points = np.concatenate([points, blobs.astype(np.float32)])
        ring = np.concatenate([ring, np.zeros(len(blobs), ring.dtype)])
        part = np.concatenate([part, np.zeros(len(blobs), np.uint8)])
    points, ring, part = crop_points(points, ring, part, box)
    if missing < faults.missing * hard:
        kept = noise.part_removal(part, rng=rng)
        points, ring, part = points[kept], ring[kept], part[kept]
    return Sample(
        points=points,
        center=center_of_cells(points) if len(points) else box.center,
        part=part,
        ring=ring,
        pose=Pose(joints=stage.lifted.of_body(actor.joints[frame]), skeleton=BODY26, frame="sensor"),
        box=box,
        source=f"synth/{config.name}/{stage.device.name}",
    )


def _facts(config: SceneConfig, sample: Sample, stage: _Stage, actor: Actor, frame: int) -> Facts:
    body = _layers(stage, actor, frame)[0]
    low, high = actor.extent[frame]
    return facts_of(
        sample,
        sensor=stage.device.name,
        kind=actor.kind,
        distance=float(np.hypot(*sample.pose.joints[0, :2])),
        alone=count_alone(body, stage.device, stage.place, stage.conditions, config, frame),
        soles=float(stage.place.feet[2]),
        tall=high[2] - low[2],
    )
