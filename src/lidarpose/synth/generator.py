"""(seed, i) -> one person as a LiDAR sees them: body, scene, scan, sample.

Person i of a seed does not depend on the order of calls or on the process: poses and shapes are drawn for blocks of
`BLOCK` people (vectorized, from the block's own generator), everything else from the person's own generator.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import cast

import numpy as np

from lidarpose.body.pose_prior.activities import unusual_mix
from lidarpose.body.rig import Rig
from lidarpose.body.smpl import smpl_axis_angles
from lidarpose.data.clips import window_points
from lidarpose.errors import InputError, check_int
from lidarpose.geometry import rotation_about
from lidarpose.lidar.presets import sensor
from lidarpose.sample import CLIP_FRAMES, Box, PersonInfo, Pose, Sample, center_of
from lidarpose.skeleton import BODY26
from lidarpose.synth import noise
from lidarpose.synth.acquisition import ACQUISITION_DRAWS, MOST_FRAMES, SINGLE_SCAN, Acquisition, draw_acquisition
from lidarpose.synth.bodies import CLIP_HZ, Bodies, PoseBank, draw_bodies, draw_moving_bodies
from lidarpose.synth.environment.mesh import Mesh
from lidarpose.synth.environment.surroundings import ground, occluder, surroundings
from lidarpose.synth.place import Place, draw_place
from lidarpose.synth.props import POSED_WITH_A_PROP, draw_props
from lidarpose.synth.scene import RandomStream, SceneConfig, scene_config
from lidarpose.synth.simulate import (
    Scene,
    SimulatedScan,
    count_alone,
    draw_conditions,
    looks,
    scan_background,
    simulate,
    simulate_scan,
)
from lidarpose.synth.views import with_views

# number of people whose poses and shapes are drawn together
BLOCK = 256
# a person with fewer returns is redrawn, each time easier to see; at most `_TRIES` draws
LEAST_POINTS = 15
_TRIES = 8


@dataclass(frozen=True, kw_only=True, eq=False)
class SyntheticPerson:
    """A sample with its true pose (body26, level frame at the sensor) and parts; its facts, None if not measured."""

    sample: Sample
    facts: PersonInfo | None


@dataclass(frozen=True, kw_only=True)
class Generator:
    """Synthetic people. May be pickled.

    Args:
        scene: a configuration, or the name of a preset.
        bank: captured poses.
        captured: share of poses from `bank`, the rest from the prior.
        rig: the body, None: the shipped one.
        measure: also compute the facts, which costs a second ray cast; the sample is the same either way.
        redraw: True: a person with fewer than `LEAST_POINTS` points is redrawn, each time easier to see. False: the
            first draw is used, even without points.
    """

    scene: SceneConfig | str
    bank: PoseBank | None = None
    captured: float = 0.0
    rig: Rig | None = None
    measure: bool = True
    redraw: bool = True

    def __post_init__(self):
        if isinstance(self.scene, str):
            object.__setattr__(self, "scene", scene_config(self.scene))
        if self.captured and self.bank is None:
            raise InputError("Generator.captured needs a bank of captured poses, got none")
        if not 0 <= self.captured <= 1:
            raise InputError(f"Generator.captured must be a share in [0, 1], got {self.captured}")
        if self.config.recorded and not self.captured:
            needed = "give its file by --motion" if self.bank is None else "ask for --captured above 0"
            raise InputError(f"recorded=1 keeps the positions of captured motion: {needed}")
        multi_frame_fields = [name for name in ("accumulated", "integration") if getattr(self.config, name)]
        settings = " and ".join(f"{name}=0" for name in multi_frame_fields)
        if self.config.recorded and multi_frame_fields:
            raise InputError(
                f"recorded=1 keeps the positions of single frames, and combined frames have none: set {settings}"
            )
        if multi_frame_fields and self.captured == 1 and not len(self.bank.clips.window_starts(MOST_FRAMES + 1)):
            raise InputError(
                f"{self.bank.clips.source}: no clip lasts {MOST_FRAMES / CLIP_HZ:g} s, which combined frames need: "
                f"give longer motion, or set {settings}"
            )
        # an unknown sensor raises here rather than at the first person
        self._bodies  # noqa: B018

    def __getstate__(self) -> dict:
        # the caches of blocks are not pickled
        return {name: value for name, value in vars(self).items() if name not in ("_bodies", "_acquisitions")}

    @property
    def config(self) -> SceneConfig:
        """The scene's configuration, whether it was given as such or by name."""
        return cast("SceneConfig", self.scene)

    @cached_property
    def _mix(self) -> dict[str, float] | None:
        """The mix of activities of poses that are not captured."""
        return unusual_mix(self.config.unusual)

    @cached_property
    def _bodies(self) -> Callable[[int, int], Bodies]:
        """(seed, block) -> its bodies."""
        # whether a scan takes time does not depend on where a person stands
        moving = bool(self.config.merged) or any(
            len(looks(sensor(name), np.zeros(3))) > 1 for name in self.config.sensors
        )
        # neighboring indices share a block; two blocks suffice for sequential access across their border
        draw_block = partial(
            draw_bodies, self.bank, self.captured, BLOCK, moving=moving, clothes=self.config.clothes, mix=self._mix,
            rig=self.rig, clear_limbs=bool(self.config.clear_limbs),
        )  # fmt: skip
        return lru_cache(maxsize=2)(draw_block)

    @cached_property
    def _acquisitions(self) -> Callable[[int, int], tuple[np.ndarray, dict[int, Bodies]]]:
        """(seed, block) -> the draws (BLOCK, ACQUISITION_DRAWS) in [0, 1) for its people's acquisitions, and, by row,
        the moving bodies of people who may have several frames."""

        def draw(seed: int, block: int) -> tuple[np.ndarray, dict[int, Bodies]]:
            draws = np.random.default_rng([seed, RandomStream.ACQUISITION, block]).random((BLOCK, ACQUISITION_DRAWS))
            # includes every person who has several frames at any difficulty
            hard_config = replace(self.config, hard=1.0, merged=0.0, sparse=0.0)
            rows = [row for row in range(BLOCK) if draw_acquisition(hard_config, draws[row]).frames > 1]
            rng = np.random.default_rng([seed, RandomStream.MOTION, block])
            moving = draw_moving_bodies(
                self.bank, self.captured, len(rows), MOST_FRAMES, rng, clothes=self.config.clothes,
                tempo=self.config.tempo, to_last=True, mix=self._mix, rig=self.rig,
                clear_limbs=bool(self.config.clear_limbs),
            )  # fmt: skip
            return draws, dict(zip(rows, moving, strict=True))

        return lru_cache(maxsize=2)(draw)

    def person(self, seed: int, index: int, *, hard: float | None = None) -> SyntheticPerson:
        """Person `index` of `seed`, at the scene's difficulty or at `hard` in [0, 1]."""
        seed, index = check_int("seed", seed, least=0), check_int("index", index, least=0)
        rng = np.random.default_rng([seed, RandomStream.PERSON, index])
        block, row = self._bodies(seed, index // BLOCK), index % BLOCK
        bodies, body_row, acquisition = block, row, SINGLE_SCAN
        if self.config.varied:
            draws, moving = self._acquisitions(seed, index // BLOCK)
            acquisition = draw_acquisition(self.config if hard is None else self.config.eased(hard), draws[row])
            if acquisition.frames > 1:
                bodies, body_row = moving[row], MOST_FRAMES - 1
        return self._observe(bodies, [body_row], block, row, rng, hard, acquisition=acquisition)[0]

    def clip(
        self, seed: int, index: int, *, frames: int = CLIP_FRAMES, hard: float | None = None
    ) -> list[SyntheticPerson]:
        """Clip `index` of `seed`: `frames` samples at 10 Hz of one moving person; things and the sensor do not move.
        Frames in which the person has no returns have samples without points. Samples have the fields that clip
        networks need: the pose's rotations, the pelvis position, and the two clouds around the person."""
        if self.config.recorded:
            raise InputError("clips have no recorded positions: set recorded=0")
        frames = check_int("a clip's frames", frames, least=1)
        seed, index = check_int("seed", seed, least=0), check_int("index", index, least=0)
        if self.captured == 1 and self.bank is not None and not len(self.bank.clips.window_starts(frames)):
            needed = f"{frames} frames, {(frames - 1) / CLIP_HZ:g} s"
            raise InputError(f"{self.bank.clips.source}: no clip lasts {needed}: give longer motion, or lower captured")
        rng = np.random.default_rng([seed, RandomStream.CLIP, index])
        bodies = draw_moving_bodies(
            self.bank, self.captured, 1, frames, rng, clothes=self.config.clothes, tempo=self.config.tempo,
            mix=self._mix, rig=self.rig, clear_limbs=bool(self.config.clear_limbs),
        )[0]  # fmt: skip
        block, row = self._bodies(seed, index // BLOCK), index % BLOCK
        return self._observe(bodies, range(frames), block, row, rng, hard, in_clip=True)

    def _observe(
        self,
        bodies: Bodies,
        rows: Sequence[int],
        block: Bodies,
        row: int,
        rng: np.random.Generator,
        hard: float | None,
        *,
        in_clip: bool = False,
        acquisition: Acquisition = SINGLE_SCAN,
    ) -> list[SyntheticPerson]:
        """A person's frames, `rows` of `bodies`. While the person has fewer than `LEAST_POINTS` points, the scene is
        redrawn, easier each time; after the last try, the draw with the most points is used, if it has any. A second
        person is any body of `block` other than `row`."""
        config = self.config if hard is None else self.config.eased(hard)
        best_draw, most_points = None, 0.0
        draw = _draw_clip_frame if in_clip else _draw_sample
        for attempt in range(_TRIES if self.redraw else 1):
            if attempt and config.recorded:
                # the recorded place may be outside the field of view of the acquisition's sensors
                acquisition = SINGLE_SCAN
            eased_config = config.eased(config.hard * (1 - attempt / (_TRIES - 1))) if attempt else config
            scene = _draw_scene(eased_config, bodies, rows[0], block, row, 0.8**attempt, rng, acquisition)
            samples = [draw(scene, bodies, k, frame, rng) for frame, k in enumerate(rows)]
            # half of a clip's frames have at least this many points
            points = float(np.median([np.count_nonzero(_truth(sample)[0]) for sample in samples]))
            if points > most_points or not self.redraw:
                best_draw, most_points = (scene, samples), points
            if points >= LEAST_POINTS:
                break
        if best_draw is None:
            raise InputError(
                f"scene {config.name}: none of {_TRIES} draws left a point on a person, with sensors such as "
                f"{scene.sensor.name}: does its range include people at {config.distance[0]:g} to "
                f"{config.distance[1]:g} m?"
            )
        scene, samples = best_draw
        return [
            SyntheticPerson(sample=sample, facts=_measure(sample, scene, bodies, k, frame) if self.measure else None)
            for frame, (k, sample) in enumerate(zip(rows, samples, strict=True))
        ]


def _draw_scene(
    config: SceneConfig, bodies: Bodies, first_row: int, block: Bodies, row: int, nearer: float,
    rng: np.random.Generator, acquisition: Acquisition = SINGLE_SCAN,
) -> Scene:  # fmt: skip
    """Paper: section "Scene sampling". `nearer` scales the distance, so that each attempt moves the person nearer."""
    sensors = acquisition.sensors[:1] or (config.sensors[rng.integers(len(config.sensors))],)
    device = sensor(sensors[0])
    low, high = bodies.extent[first_row]
    height, reach = high[2], max(-low[0], -low[1], high[0], high[1])
    place_config = acquisition.placing(config)
    recorded = bodies.places[first_row] if config.recorded and bodies.places is not None else None
    recorded = recorded if recorded is not None and np.isfinite(recorded).all() else None
    place = draw_place(place_config, device, height, reach, nearer, rng, acquisition.inverted, recorded)
    background = [ground(config, place.feet, rng), *surroundings(config, place.feet, reach, rng)]
    if (occluder_mesh := occluder(config, place.feet, height, rng)) is not None:
        background.append(occluder_mesh)
    still_count = len(background)
    if (rng.random() < config.company * config.hard) or acquisition.crowded:
        first_body = place.of_body(bodies.vertices[first_row]) if config.apart else None
        background.append(_second_person(block, row, place, rng, close=acquisition.crowded, first_body=first_body))
    props = []
    kind = bodies.kinds[first_row]
    # props that a person sits on, rides or pushes do not depend on the difficulty
    if rng.random() < config.carry * (1.0 if kind in POSED_WITH_A_PROP else config.hard):
        props = draw_props(rng, kind=kind, joints=bodies.joints[first_row])
    conditions = draw_conditions(config, device, rng)
    scene = Scene(
        config=config,
        sensor=device,
        place=place,
        conditions=conditions,
        background=background,
        props=props,
        still=still_count,
        acquisition=acquisition,
    )
    return with_views(scene, place_config, height, reach, nearer, rng)


# part that marks a second person's points until they are counted
_OTHER = 255
# probability that a second person stands between the sensor and the first one; else beside the first one
_BEFORE = 0.3
# distance between the two people, beside and in front, m
_BESIDE, _NEARER = (0.4, 1.0), (0.4, 2.5)
# distance between two people in a crowded crop, m
_CLOSE = (0.35, 0.8)
# size, m, and number per side of the grid cells in which two bodies are compared, viewed along the line between them
_CELL, _CELLS = 0.08, 48


def _second_person(
    block: Bodies, row: int, place: Place, rng: np.random.Generator, *, close: bool, first_body: np.ndarray | None
) -> Mesh:
    """Another body of the block, an arm's length away or between the sensor and the person. close: always beside, at
    `_CLOSE`; first_body: (V, 3) m, the person's vertices: the other body is moved away until the two do not overlap;
    None: it is not moved."""
    other_row = (row + rng.integers(1, len(block.vertices))) % len(block.vertices)
    before_draw, gap, angle, lateral_share, yaw = rng.random(5)
    direction = place.feet[:2] / max(np.hypot(*place.feet[:2]), 1e-6)
    if before_draw < _BEFORE and not close:
        # no nearer to the sensor than a third of the person's distance
        distance = min(_NEARER[0] + gap * (_NEARER[1] - _NEARER[0]), 0.67 * place.distance)
        shift = -distance * direction + (lateral_share - 0.5) * np.array([-direction[1], direction[0]])
    else:
        least_distance, most_distance = _CLOSE if close else _BESIDE
        distance = least_distance + gap * (most_distance - least_distance)
        shift = distance * np.array([np.cos(2 * np.pi * angle), np.sin(2 * np.pi * angle)])
    other_place = Place(feet=place.feet + [*shift, 0], yaw=2 * np.pi * yaw, distance=place.distance)
    vertices = other_place.of_body(block.vertices[other_row])
    if first_body is not None:
        vertices = _moved_clear(vertices, first_body, place.feet, shift / max(np.hypot(*shift), 1e-6))
    return Mesh(vertices, block.faces, np.full(len(block.faces), _OTHER, np.uint8))


def _moved_clear(vertices: np.ndarray, body: np.ndarray, feet: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Vertices (V, 3) m, moved along the unit vector `direction` (2,) until they are beyond a `body` (W, 3) with its
    feet at `feet` (3,), in every cell of a grid viewed along `direction`."""
    across = np.array([-direction[1], direction[0]])
    reach = np.full((2, _CELLS * _CELLS), -np.inf)
    for sign, points, row in ((1, body, 0), (-1, vertices, 1)):
        offset = points.astype(float) - feet
        # the grid is centered on the body
        cells = np.stack([offset[:, :2] @ across / _CELL + _CELLS / 2, offset[:, 2] / _CELL + 2], 1)
        columns, rows = cells.astype(int).clip(0, _CELLS - 1).T
        np.maximum.at(reach[row], rows * _CELLS + columns, sign * (offset[:, :2] @ direction))
    overlap = max(float(reach.sum(0).max()), 0.0)
    return vertices + (overlap * np.array([*direction, 0.0])).astype(np.float32)


def _draw_sample(scene: Scene, bodies: Bodies, row: int, frame: int, rng: np.random.Generator) -> Sample:
    box = _box(scene, bodies, row, rng) if scene.config.box_window else None
    return _crop(scene, bodies, row, simulate(scene, bodies, row, rng, frame=frame, box=box), rng, box)


def _draw_clip_frame(scene: Scene, bodies: Bodies, row: int, frame: int, rng: np.random.Generator) -> Sample:
    """Like `_draw_sample`, with the pose's rotations and the clouds around the person."""
    meshes = scene.meshes(bodies, row)
    box = _box(scene, bodies, row, rng) if scene.config.box_window else None
    scan = simulate_scan(scene, meshes, rng, frame=frame, box=box)
    sample = _crop(scene, bodies, row, scan, rng, box)
    other_points = scan.points[~cast("Box", sample.box).contains(scan.points)]
    return replace(
        sample,
        rotations=_smpl_pose(scene.body_place, bodies, row),
        translation=cast("Pose", sample.pose).joints[0],
        background=window_points(scan_background(scene, meshes[0], frame), sample.points),
        neighbors=window_points(other_points, sample.points),
    )


def _smpl_pose(place: Place, bodies: Bodies, row: int) -> np.ndarray:
    """(24, 3) float32 rad, as in `Sample`."""
    axis_angles = smpl_axis_angles(bodies.rotations[row, None], rotation_about("z", place.yaw))
    return axis_angles[0].astype(np.float32)


def _box(scene: Scene, bodies: Bodies, row: int, rng: np.random.Generator) -> Box:
    """A box with a detector's errors; in crowded crops it holds both people."""
    config, place = scene.config, scene.body_place
    box = noise.draw_box(config.crop, config.hard, _extent(scene, bodies, row, rng), place, rng, bodies.heading[row])
    if scene.acquisition.crowded:
        body_vertices = place.of_body(bodies.vertices[row])
        box = noise.box_of_two(box, body_vertices, scene.background[-1].vertices, rng)
    return box


def _crop(
    scene: Scene, bodies: Bodies, row: int, scan: SimulatedScan, rng: np.random.Generator, box: Box | None = None
) -> Sample:
    """The sample of a scan's points in a box; None: the box is drawn here, after the scan."""
    config, acquisition = scene.config, scene.acquisition
    box = _box(scene, bodies, row, rng) if box is None else box
    points, ring, part, times = scan.points, scan.ring, scan.part, scan.time
    clutter_draw, part_draw = rng.random(2)
    if clutter_draw < config.noise.clutter * config.hard:
        if config.noise.dapt_compat:
            clusters = noise.dapt_clusters(box.center, rng=rng)
        else:
            most_points = min(config.noise.most_clutter, 20 + len(points) // 2)
            clusters = noise.noise_clusters(box.center, most=most_points, rng=rng)
        points = np.concatenate([points, clusters.astype(np.float32)])
        ring = np.concatenate([ring, np.full(len(clusters), -1, ring.dtype)])
        part = np.concatenate([part, np.zeros(len(clusters), np.uint8)])
        if times is not None:
            # evenly over the scans
            rows = np.arange(len(clusters)) * len(times) // max(len(clusters), 1)
            times = np.concatenate([times, times[rows] if len(times) else np.zeros(len(clusters), np.float32)])
    is_inside = box.contains(points)
    points, ring, part = points[is_inside], ring[is_inside], part[is_inside]
    times = None if times is None else times[is_inside]
    other_count = int(np.count_nonzero(part == _OTHER))
    part = np.where(part == _OTHER, np.uint8(0), part)
    if part_draw < config.noise.missing_part * config.hard:
        keep_mask = noise.part_removal(part, rng=rng)
        points, ring, part = points[keep_mask], ring[keep_mask], part[keep_mask]
        times = None if times is None else times[keep_mask]
    return Sample(
        points=points,
        # if the crop holds two people, the box's center tells which one is meant
        center=center_of(points) if len(points) and not acquisition.crowded else box.center,
        part=part,
        ring=ring,
        point_times=times,
        pose=Pose(joints=scene.body_place.of_body(bodies.joints[row]), skeleton=BODY26, frame="sensor"),
        box=box,
        second_person_points=other_count,
        source=acquisition.source(config.name, scene.sensor.name),
    )


def _extent(scene: Scene, bodies: Bodies, row: int, rng: np.random.Generator) -> tuple[list[float], list[float]]:
    """The extent for drawing a box, as in `Bodies.extent`: the body's or, for several frames, in half of the cases that
    of the bodies of all frames."""
    if scene.acquisition.frames == 1 or rng.random() < 0.5:
        return bodies.extent[row]
    vertices = bodies.vertices[row + 1 - scene.acquisition.frames : row + 1].reshape(-1, 3)
    vertices = vertices @ rotation_about("z", bodies.heading[row])
    return vertices.min(0).tolist(), vertices.max(0).tolist()


# points this close to the soles count as ground, not as clutter, m
_GROUND = 0.1


def _truth(sample: Sample) -> tuple[np.ndarray, Pose]:
    """Part and pose; synthetic samples always have both."""
    return cast("tuple[np.ndarray, Pose]", (sample.part, sample.pose))


def _measure(sample: Sample, scene: Scene, bodies: Bodies, row: int, frame: int) -> PersonInfo:
    """The facts of a sample, see `PersonInfo`."""
    low, high = bodies.extent[row]
    alone_count = sum(count_alone(view, meshes[0], k) for view, meshes, k, _ in scene.scans(bodies, row, frame))
    part, pose = _truth(sample)
    body_points = sample.points[part > 0]
    is_clutter = (part == 0) & (sample.points[:, 2] > float(scene.place.feet[2]) + _GROUND)
    return PersonInfo(
        sensor=scene.sensor.name,
        kind=bodies.kinds[row],
        distance=float(np.hypot(*pose.joints[0, :2])),
        visible=min(len(body_points) / max(alone_count, 1), 1.0),
        height_seen=float(np.ptp(body_points[:, 2])) / max(high[2] - low[2], 1e-6) if len(body_points) else 0.0,
        clutter=float(is_clutter.mean()) if len(is_clutter) else 0.0,
        upright=_is_upright(pose.joints),
    )


def _is_upright(joints: np.ndarray) -> bool:
    """Whether a person stands or walks: the trunk is within 35 degrees of vertical, and a hip is above its ankle by
    more than four fifths of the leg's length."""
    pelvis, neck = joints[BODY26.index("pelvis")], joints[BODY26.index("neck")]
    if (neck - pelvis)[2] < np.cos(np.radians(35)) * np.linalg.norm(neck - pelvis):
        return False
    for side in ("left", "right"):
        hip, knee, ankle = (joints[BODY26.index(f"{side}_{name}")] for name in ("hip", "knee", "ankle"))
        leg = np.linalg.norm(hip - knee) + np.linalg.norm(knee - ankle)
        if (hip - ankle)[2] > 0.8 * leg:
            return True
    return False
