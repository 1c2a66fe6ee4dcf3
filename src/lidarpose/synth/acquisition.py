"""How a person's cloud is acquired: in one scan of an upright sensor, or merged, accumulated, inverted and so on."""

from dataclasses import dataclass, replace

import numpy as np

from lidarpose.lidar.presets import sensor
from lidarpose.synth.scene import SceneConfig

# sensors with few rings, and the maximum distance of people from them, m
_SPARSE, _SPARSE_FAR = ("vlp-16", "hdl-32e", "vlp-32c"), 25.0
# merged sensors: their number, their distance from the person, m, and the probability that all are of one model
_MERGED, _MERGED_AWAY, _ONE_MODEL = (2, 4), (3.0, 15.0), 0.5
# accumulated frames: their number, and the sensor's maximum speed, m/s, in the half of the cases in which it moves
_FRAMES, _FASTEST = (2, 5), 15.0
# numbers of frames that a rosette integrates
_INTEGRATED = (1, 2, 5)
# uniform numbers in [0, 1) that determine an acquisition
ACQUISITION_DRAWS = 13


@dataclass(frozen=True, kw_only=True)
class Acquisition:
    """How a person's cloud is acquired, by default in one scan of an upright sensor.

    Args:
        sensors: names. If there are several, they stand around the person and their scans are merged. Empty: one of
            the scene's sensors, drawn with the scene.
        frames: number of scans at 10 Hz that are accumulated in the frame of the last one; the pose is of that frame.
        speed: of the sensor along its x axis during these scans, m/s. The scans are compensated for it, so static
            objects stay aligned.
        inverted, crowded: as in `SceneConfig`.
        distance: minimum and maximum distance of the person, m, drawn uniformly; None: by the scene.
        conditions: names of the conditions that apply: merged, accumulated, integrated, inverted, sparse, crowded.
    """

    sensors: tuple[str, ...] = ()
    frames: int = 1
    speed: float = 0.0
    inverted: bool = False
    crowded: bool = False
    distance: tuple[float, float] | None = None
    conditions: tuple[str, ...] = ()

    def source(self, scene: str, sensor: str) -> str:
        """`Sample.source` for the names of a scene and a sensor; `Sample.conditions` parses it."""
        return "/".join(("synth", scene, sensor, *filter(None, ["+".join(self.conditions)])))

    def placing(self, config: SceneConfig) -> SceneConfig:
        """The configuration from which the person's place is drawn: the scene's, with this acquisition's distance."""
        return replace(config, distance=self.distance, median_points=0) if self.distance else config


SINGLE_SCAN = Acquisition()
# maximum number of a person's frames that are accumulated; the pose is of the last one
MOST_FRAMES = _FRAMES[1]


def draw_acquisition(config: SceneConfig, draws: np.ndarray) -> Acquisition:
    """The acquisition for `draws` (ACQUISITION_DRAWS,), uniform in [0, 1); merged acquisitions have one frame."""
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
    """The integer at `share` in [0, 1) of the range from ends[0] to ends[1], both included."""
    return ends[0] + int(share * (ends[1] - ends[0] + 1))
