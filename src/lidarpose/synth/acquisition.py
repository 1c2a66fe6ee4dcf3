"""How a person's cloud is acquired: one scan of an upright sensor, or several of several ones, or otherwise."""

from dataclasses import dataclass, replace

import numpy as np

from lidarpose.lidar.presets import sensor
from lidarpose.synth.scene import SceneConfig

# sensors of few rings, and how far away people are who are seen by them, m
_SPARSE, _SPARSE_FAR = ("vlp-16", "hdl-32e", "vlp-32c"), 25.0
# sensors that are merged: how many, how far from the person, m, and how often they are of one model
_MERGED, _MERGED_AWAY, _ONE_MODEL = (2, 4), (3.0, 15.0), 0.5
# frames added up: how many, and the sensor's speed, m/s, in the half of cases in which it drives
_FRAMES, _FASTEST = (2, 5), 15.0
_INTEGRATED = (1, 2, 5)
# numbers in [0, 1) that decide on an acquisition
ACQUISITION_DRAWS = 13


@dataclass(frozen=True, kw_only=True)
class Acquisition:
    """How a person's cloud is acquired, by default in one scan of an upright sensor.

    Args:
        sensors: names; those after the first stand around the person too, and all scans are merged. None: one of the
            scene's sensors, drawn with the scene.
        frames: scans at 10 Hz that are added up in the frame of the last one, which the pose is of.
        speed: of the sensor along its x axis meanwhile, m/s; what stands still agrees all the same.
        inverted, crowded: as in `SceneConfig`.
        distance: nearest and farthest, m, uniform; None: by the scene.
        conditions: names of what holds: merged, accumulated, integrated, inverted, sparse, crowded.
    """

    sensors: tuple[str, ...] = ()
    frames: int = 1
    speed: float = 0.0
    inverted: bool = False
    crowded: bool = False
    distance: tuple[float, float] | None = None
    conditions: tuple[str, ...] = ()

    def source(self, scene: str, sensor: str) -> str:
        """`Sample.source` of a scene and a sensor of these names; `Sample.conditions` reads it."""
        return "/".join(("synth", scene, sensor, *filter(None, ["+".join(self.conditions)])))

    def placing(self, config: SceneConfig) -> SceneConfig:
        """The scene as far as it says where somebody stands."""
        return replace(config, distance=self.distance, median_points=0) if self.distance else config


SINGLE_SCAN = Acquisition()
# a person's frames that may be added up: the last one is that of the pose
MOST_FRAMES = _FRAMES[1]


def draw_acquisition(config: SceneConfig, draws: np.ndarray) -> Acquisition:
    """The acquisition that `draws` (ACQUISITION_DRAWS,), uniform in [0, 1), decide on; merged ones have one frame."""
    merged, accumulated, integration, inverted, sparse, crowded, number, variant, speed, *devices = draws.tolist()
    hard = float(config.hard)
    names, distance, frames, sensor_speed, conditions = config.sensors, None, 1, 0.0, []
    if sparse < config.sparse * hard:
        names, distance = _SPARSE, (config.distance[0], min(config.distance[1], _SPARSE_FAR))
        conditions.append("sparse")
    candidates = [names[int(device * len(names))] for device in devices]
    sensors = candidates[:1]
    if merged < config.merged * hard:
        count = _between(_MERGED, number)
        sensors = sensors * count if variant < _ONE_MODEL else candidates[:count]
        distance = _MERGED_AWAY
        conditions.append("merged")
    elif accumulated < config.accumulated * hard:
        frames, sensor_speed = _between(_FRAMES, number), speed * _FASTEST if variant < 0.5 else 0.0
        conditions.append("accumulated")
    elif integration < config.integration * hard and getattr(sensor(sensors[0]), "duration", 0):
        frames = _INTEGRATED[int(number * len(_INTEGRATED))]
        conditions += ["integrated"] * (frames > 1)
    conditions += ["inverted"] * (is_inverted := inverted < config.inverted * hard)
    conditions += ["crowded"] * (is_crowded := crowded < config.crowded * hard)
    if not conditions:
        return SINGLE_SCAN
    return Acquisition(
        sensors=tuple(sensors), frames=frames, speed=sensor_speed, inverted=is_inverted, crowded=is_crowded,
        distance=distance, conditions=tuple(conditions),
    )  # fmt: skip


def _between(ends: tuple[int, int], share: float) -> int:
    """The whole number at a share in [0, 1) of those from the one to the other."""
    return ends[0] + int(share * (ends[1] - ends[0] + 1))
