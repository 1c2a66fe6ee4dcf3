"""Where a person stands and what stands around: the paper's scene sampling, and a wilder one.

A scene is laid out in the sensor's frame: sensor at the origin, z up. The ground under the person lies at -height.
"""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from lidarpose.errors import InputError, unknown_name
from lidarpose.lidar.sensor import Sensor, sensor
from lidarpose.synth.mesh import Mesh, box, prism, quad


@dataclass(frozen=True, kw_only=True)
class SceneConfig:
    """How scenes are drawn. Probabilities unless a unit is named; `hard` scales all that makes a person hard to see.

    name; distance: nearest and farthest, m; median_points: of the law of point counts, 0 = distance uniform as in the
    paper; slope: standard deviation of the ground's tilt, rad; mask: laser-level mask; keep:
    least share of patches it keeps; occluder: something coherent in front; clutter: things near the person, a second
    person among them; noise: stray points; crop_jitter: error of the crop box, m.
    """

    name: str
    sensors: tuple[str, ...]
    distance: tuple[float, float]
    median_points: float
    slope: float
    mask: float
    keep: float
    occluder: float
    clutter: float
    noise: float
    crop_jitter: float
    hard: float = 1.0

    def __post_init__(self):
        if not 0 <= self.hard <= 1:
            raise InputError(f"SceneConfig.hard must be between 0 (easy) and 1 (full), got {self.hard}")

    def eased(self, hard: float) -> "SceneConfig":
        """The same scenes at a difficulty of `hard` in [0, 1]."""
        return replace(self, hard=hard)


SCENES = {
    # Paper: r in [4, 20] m, a tilted square of ground, r_keep 0.6; its noise clusters are from the released code
    "paper": SceneConfig(
        name="paper",
        sensors=("dapt64",),
        distance=(4.0, 20.0),
        median_points=0,
        slope=np.radians(5.0),
        mask=1.0,
        keep=0.6,
        occluder=0.0,
        clutter=0.0,
        noise=0.5,
        crop_jitter=0.0,
    ),
    # sensors, counts and crops as users have them: 50 to 900 points a person, boxes of real detectors
    "wild": SceneConfig(
        name="wild",
        sensors=(
            "dapt64",
            "vlp-32c",
            "os1-128",
            "os1-64",
            "hdl-64e",
            "hdl-32e",
            "vlp-16",
            "waymo-top",
            "pandar64",
            "av2",
        ),
        distance=(2.0, 40.0),
        median_points=260,
        slope=np.radians(3.0),
        mask=0.3,
        keep=0.55,
        occluder=0.25,
        clutter=0.35,
        noise=0.1,
        crop_jitter=0.08,
    ),
}


def scene_config(name: str) -> SceneConfig:
    """The named scene preset: paper or wild."""
    if name not in SCENES:
        raise unknown_name("scene", name, SCENES)
    return SCENES[name]


# a standing adult fills about this much of a sphere seen from one metre (silhouette, m2)
_SILHOUETTE = 0.55
# log-normal spread of point counts about the median: 5 to 95 percent are a factor of about 5
_COUNT_SPREAD = 0.95


def draw_distance(config: SceneConfig, device: Sensor, rng: np.random.Generator) -> float:
    """Horizontal distance to the person in metres.

    Paper: uniform. Else the distance at which this sensor returns a log-normal number of points.
    """
    near, far = config.distance
    if config.median_points == 0:
        return float(rng.uniform(near, far))
    count = config.median_points * np.exp(rng.normal(0, _COUNT_SPREAD))
    return float(np.clip(np.sqrt(_SILHOUETTE / (count * _beam(device.name))), near, far))


@cache
def _beam(name: str) -> float:
    """Solid angle that a beam of the sensor stands for, where its rings lie closest, sr."""
    device = sensor(name)
    return device.azimuth_step * float(np.median(np.diff(device.elevations)))


def draw_height(device: Sensor, distance: float, tall: float, *, rng: np.random.Generator, cut: float = 0.05) -> float:
    """Height of the sensor above the person's ground in metres, jittered for mounts and slopes.

    Where the person of `tall` m would reach out of the sensor's fan although there is room for them, the height is
    moved until they fit, but for a share `cut` of people.
    """
    height = device.height + rng.normal(0, 0.3) + rng.normal(0, 0.02) * distance
    low, high = distance * np.tan(device.elevations[[0, -1]])
    if rng.random() < cut:
        return float(height)
    if high - low <= tall:
        # taller than the fan: the middle of the fan looks at the middle of the person
        return float(tall / 2 - (low + high) / 2)
    # feet, at -height, not below the fan; head, at tall - height, not above it
    return float(np.clip(height, tall - high, -low))


def ground(config: SceneConfig, rng: np.random.Generator) -> Mesh:
    """The ground about the person: a tilted square. Paper: half width 1 m; wild: 3 m."""
    tilt, heading = rng.normal(0, config.slope), rng.uniform(-np.pi, np.pi)
    half = 1.0 if config.name == "paper" else 3.0
    return quad(half, np.tan(tilt) * np.array([np.cos(heading), np.sin(heading)]))


def surroundings(config: SceneConfig, feet: np.ndarray, radius: float, rng: np.random.Generator) -> list[Mesh]:
    """Things near a person who stands at feet (3,) m and reaches `radius` m to the sides; none of them a person."""
    things = []
    if rng.random() >= config.clutter * config.hard:
        return things
    for _ in range(rng.integers(1, 4)):
        angle, gap = rng.uniform(-np.pi, np.pi), radius + rng.uniform(0.05, 0.6)
        place = feet + gap * np.array([np.cos(angle), np.sin(angle), 0])
        yaw = rng.uniform(-np.pi, np.pi)
        kind = rng.choice(4)
        if kind == 0:
            things.append(prism(rng.uniform(0.02, 0.15), rng.uniform(0.8, 3)).moved(place))
        elif kind == 1:
            things.append(box(rng.uniform([0.2, 0.2, 0.2], [0.9, 0.5, 1.1])).moved(place, yaw))
        elif kind == 2:
            away = feet + (gap + 0.3) * np.array([np.cos(angle), np.sin(angle), 0])
            things.append(box([0.1, rng.uniform(1, 4), rng.uniform(0.5, 3)]).moved(away, angle))
        else:
            # hand luggage and what lies about: touches the body
            near = feet + rng.uniform(0.6, 1.0) * radius * np.array([np.cos(angle), np.sin(angle), 0])
            lift = [0, 0, rng.uniform(0, 0.9)]
            things.append(box(rng.uniform(0.12, [0.5, 0.3, 0.5])).moved(near + lift, yaw))
    return things


def occluder(config: SceneConfig, feet: np.ndarray, tall: float, rng: np.random.Generator) -> Mesh | None:
    """Something between the sensor and the person that hides a side, the legs or a strip of them, or None."""
    if rng.random() >= config.occluder * config.hard:
        return None
    share = rng.uniform(0.5, 0.85)
    place = feet * [share, share, 1]
    across = np.array([-feet[1], feet[0], 0]) / max(np.hypot(feet[0], feet[1]), 1e-6)
    heading = float(np.arctan2(feet[1], feet[0]))
    # what lies between is seen larger; sizes are given at the person and shrunk
    line_of_feet = feet[2] * share
    kind = rng.choice(3)
    if kind == 0:
        # a bonnet, a hedge, a counter: hides up to the hips
        top = line_of_feet + share * tall * rng.uniform(0.15, 0.5)
        size = [0.3, 3.0 * share, max(top - feet[2], 0.1)]
        return box(size).moved(place, heading)
    if kind == 1:
        # the edge of a wall or a van: hides one side
        edge = rng.uniform(-0.05, 0.25) * share
        side = rng.choice([-1, 1])
        return box([0.2, 1.5, tall + 2]).moved(place + side * (edge + 0.75) * across, heading)
    # a pole, a trunk, a passer-by
    shift = rng.normal(0, 0.2) * share
    return prism(rng.uniform(0.05, 0.2) * share, tall + 2).moved(place + shift * across)
