"""(seed, i) -> a crop without a person: an object that stands where a person might, cropped like a person.

These are the negatives for training and evaluating networks that decide whether a crop shows a person.
"""

from dataclasses import replace

import numpy as np

from lidarpose.errors import InputError, check_int
from lidarpose.lidar.presets import sensor
from lidarpose.sample import Box, Sample, center_of
from lidarpose.synth import noise
from lidarpose.synth.acquisition import ACQUISITION_DRAWS, SINGLE_SCAN, Acquisition, draw_acquisition
from lidarpose.synth.environment.mesh import Mesh
from lidarpose.synth.environment.surroundings import ground, surroundings
from lidarpose.synth.environment.things import THINGS, draw_thing
from lidarpose.synth.place import Place, draw_place
from lidarpose.synth.scene import RandomStream, SceneConfig
from lidarpose.synth.simulate import Scene, draw_conditions, simulate_still
from lidarpose.synth.views import with_views

# minimum number of points in an object's crop, and the maximum number of draws, each nearer to the sensor
LEAST_POINTS = 15
_TRIES = 16
# boxes: range of length and width, range of height, and standard deviation of their center's offset, m
_WIDE, _TALL, _OFF = (0.5, 1.2), (1.0, 2.2), 0.2
# probability that a box does not stand on the ground: it shows part of something larger or higher
_RAISED = 0.3
# probability of clusters of points without a thing, and the maximum number of points in a cluster
_CLUTTER, _MOST_CLUTTER = 0.05, 200
# maximum half width of a thing for placing it before the sensor, m: larger ones need not be inside its field of view
_REACH = 1.0


def draw_object(
    config: SceneConfig, seed: int, index: int, *, left_out: bool = False, hard: float | None = None
) -> tuple[Sample, str]:
    """Object `index` of `seed`, scanned like the scene's people, including by several sensors or in several frames.

    Args:
        config: scenes: sensors, distances, surroundings, noise.
        left_out: True: a thing of the kinds held out from training; False: of the other kinds.
        hard: the difficulty in [0, 1] for drawing the acquisition, as in `Generator.person`; None: the scene's. All
            else has the scene's difficulty.

    Returns:
        The sample (level frame at the sensor, parts 0, no pose) and the kind of thing, a name of `THINGS` or "clutter".

    Raises:
        InputError: no draw left enough points, for example because the distances exceed the sensors' range.
    """
    seed, index = check_int("seed", seed, least=0), check_int("index", index, least=0)
    rng = np.random.default_rng([seed, RandomStream.OBJECT, index])
    acquisition = SINGLE_SCAN
    if config.varied:
        draws = np.random.default_rng([seed, RandomStream.OBJECT_ACQUISITION, index]).random(ACQUISITION_DRAWS)
        eased_config = config if hard is None else config.eased(hard)
        acquisition = draw_acquisition(replace(eased_config, crowded=0.0), draws)
    weights = {name: thing.outdoors + thing.indoors for name, thing in THINGS.items() if thing.left_out is left_out}
    probability = np.array(list(weights.values())) / sum(weights.values())
    for attempt in range(_TRIES):
        is_clutter = rng.random() < _CLUTTER and not attempt
        name = "clutter" if is_clutter else str(rng.choice(list(weights), p=probability))
        sample = _draw_sample(config, name, acquisition, 0.85**attempt, rng)
        if len(sample.points) >= LEAST_POINTS:
            return sample, name
    raise InputError(
        f"scene {config.name}: none of {_TRIES} draws left {LEAST_POINTS} points on an object; does the range of its "
        f"sensors include {config.distance[0]:g} to {config.distance[1]:g} m?"
    )


def _draw_sample(
    config: SceneConfig, name: str, acquisition: Acquisition, nearer: float, rng: np.random.Generator
) -> Sample:
    """A crop around a thing; it may have no points."""
    (sensor_name,) = acquisition.sensors[:1] or (config.sensors[rng.integers(len(config.sensors))],)
    device, place_config = sensor(sensor_name), acquisition.placing(config)
    thing = draw_thing(name, rng) if name in THINGS else Mesh(np.zeros((3, 3), np.float32), np.zeros((0, 3), np.int32))
    low, high = thing.vertices.min(0), thing.vertices.max(0)
    reach = float(min(max(-low[0], -low[1], high[0], high[1], 0.2), _REACH))
    height = float(np.clip(high[2], 0.5, 2.0))
    place = draw_place(place_config, device, height, reach, nearer, rng, acquisition.inverted)
    thing_mesh = Mesh(place.of_body(thing.vertices), thing.faces, np.ones(len(thing.faces), np.uint8))
    background = [ground(config, place.feet, rng), *surroundings(config, place.feet, reach, rng)]
    scene = Scene(
        config=config, sensor=device, place=place, conditions=draw_conditions(config, device, rng),
        background=background, props=[], acquisition=acquisition,
    )  # fmt: skip
    window_box = _box_of_crops(thing, place) if config.box_window else None
    scene = with_views(scene, place_config, height, reach, nearer, rng)
    scan = simulate_still(scene, thing_mesh, rng, box=window_box)
    points, ring = scan.points, scan.ring
    center = place.feet + [0, 0, 1.0]
    thing_points = scan.points[scan.part > 0]
    if not len(thing_points) and name in THINGS:
        points, ring = points[:0], ring[:0]
    elif name not in THINGS or rng.random() < config.noise.clutter * config.hard:
        clusters = noise.noise_clusters(center, most=_MOST_CLUTTER, rng=rng).astype(np.float32)
        points = np.concatenate([points, clusters])
        ring = np.concatenate([ring, np.full(len(clusters), -1, ring.dtype)])
    if len(thing_points):
        center = thing_points[rng.integers(len(thing_points))].astype(float)
    box = _draw_box(center, float(place.feet[2]), rng)
    is_inside = box.contains(points)
    points, ring = points[is_inside], ring[is_inside]
    return Sample(
        points=points,
        center=center_of(points) if len(points) else box.center,
        part=np.zeros(len(points), np.uint8),
        ring=ring,
        box=box,
        source=acquisition.source(config.name, device.name),
    )


def _box_of_crops(thing: Mesh, place: Place) -> Box:
    """A box around nearly all boxes that `_draw_box` could draw around points of a thing, level frame."""
    low, high = thing.vertices.min(0).astype(float), thing.vertices.max(0).astype(float)
    across = np.sqrt(2) * _WIDE[1] + 4 * _OFF
    center = place.of_body(((low + high) / 2)[None])[0]
    return Box(center=center, size=high - low + [across, across, 2 * _TALL[1]], yaw=place.yaw)


def _draw_box(middle: np.ndarray, floor: float, rng: np.random.Generator) -> Box:
    """A box of a person's size around `middle` (3,) m, like a false positive of a detector; floor: z of the ground."""
    size = np.array([*rng.uniform(*_WIDE, 2), rng.uniform(*_TALL)])
    center = middle + [*(_OFF * rng.standard_normal(2)), 0]
    raised_draw, below_share = rng.random(2)
    bottom = middle[2] - below_share * size[2] if raised_draw < _RAISED else floor + 0.05 * rng.standard_normal()
    center[2] = bottom + size[2] / 2
    return Box(center=center, size=size, yaw=float(rng.uniform(-np.pi, np.pi)))
