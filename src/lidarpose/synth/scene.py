"""How scenes are drawn: a configuration, its presets, and where a person stands before a sensor.

A scene is laid out in a level frame at the sensor: sensor at the origin, z up. The ground under the person lies at
-height.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from functools import lru_cache
from math import atan2, cos, inf, pi, sin, tan
from typing import Any

import numpy as np

from lidarpose.errors import InputError, check_name
from lidarpose.geometry import rotation_about
from lidarpose.lidar.presets import sensor
from lidarpose.lidar.ray_pattern import RayPattern
from lidarpose.lidar.sensor import Sensor


class RandomStream(IntEnum):
    """Second word of a generator's seed, (seed, stream, index): what is drawn for one never shifts another.

    Values must not change: every dataset and bench was made with them. 5 has two uses: boxes in datasets of streets and
    stored people in training, which never share a sample. 9 and 10 are the training loop's, of torch.
    """

    BLOCK = 0
    PERSON = 1
    SYNTHETIC_AUGMENTATION = 2
    CLIP = 3
    STREET = 4
    STREET_BOXES = 5
    STORED_AUGMENTATION = 5
    EPOCH_ORDER = 6
    BATCH_ORDER = 8
    INITIAL_WEIGHTS = 9
    TRAINING_STEP = 10
    DETECTION = 11
    CANDIDATES = 12
    ACQUISITION = 13
    MOTION = 14
    OBJECT = 15


@dataclass(frozen=True, kw_only=True)
class NoiseConfig:
    """What goes wrong with returns. Probabilities unless a unit is named; each is off by default.

    Args:
        mask: laser-level mask, which keeps a share of the patches between the two of `mask_keep`.
        clutter: clusters of points that no surface returned, at most `most_clutter` points each.
        missing_part: one body part's returns are gone.
        intensity_dropout: how much of what grazes a surface or is far may be lost.
        beam_divergence: beams of 1.5 to 3 mrad instead of lines, so that silhouettes fatten and edges give mixed
            ranges (spinning sensors only).
        sigma: the sensor's range noise is multiplied by a factor between the two.
        ring_bias: standard deviation of an error that a ring's points share, between the two, m.
        dapt_compat: what the released code does instead: ranges 0 to 2 cm too long, clutter by its own law, the
            beams at +-pi twice.
    """

    mask: float = 0.0
    mask_keep: tuple[float, float] = (0.6, 0.6)
    clutter: float = 0.0
    most_clutter: int = 149
    missing_part: float = 0.0
    intensity_dropout: float = 0.0
    beam_divergence: float = 0.0
    sigma: tuple[float, float] = (1.0, 1.0)
    ring_bias: tuple[float, float] = (0.0, 0.0)
    dapt_compat: bool = False


@dataclass(frozen=True, kw_only=True)
class CropErrors:
    """How wrong a crop's box is. jitter m: standard deviation of its center (and, in rad, of its yaw); loose: share
    of boxes far too large, as drawn by hand; cut: share of boxes that lose the feet, the head or a side."""

    jitter: float = 0.0
    loose: float = 0.0
    cut: float = 0.0


@dataclass(frozen=True, kw_only=True)
class SceneConfig:
    """How scenes are drawn. Probabilities unless a unit is named.

    Args:
        name: of the preset, part of each sample's source.
        sensors: names or files of tables, each as often as it stands there.
        distance: nearest and farthest, m.
        median_points: of the law of point counts; 0: distance uniform as in the paper.
        mount: standard deviation of the sensor's height, m; 0: its own height whether the person fits or not.
        slope: standard deviation of the ground's tilt, rad.
        margin: how much farther than the body beams are cast, rad.
        around: the same, m.
        clutter: things near the person.
        occluder: something in front.
        company: a second person in or before the crop.
        carry: how often something is carried or used, relative to the street's habit.
        merged: the cloud of 2 to 4 sensors around the person, see `Acquisition`; this and the next five hold for single
            people only, clips have none of them.
        accumulated: 2 to 5 frames of somebody who moves in one cloud.
        inverted: sensors mounted upside down, 2 to 5 m above the ground.
        integration: rosettes that collect 0.1, 0.2 or 0.5 s, each as often.
        sparse: sensors of 16 and 32 rings at a uniform distance of up to 25 m.
        crowded: crops that hold a second person besides the one whom the box's center is nearer to.
        noise: what goes wrong with returns.
        crop: errors of the crop's box.
        recorded: 1: captured people stay where they were recorded, as without the paper's scene sampling; 0: they are
            placed at random.
        clothes: how far cloth and hair stand off the skin, relative to the street's; 0: bare.
        hard: difficulty in [0, 1]; scales what hides a person or spoils their crop, not the sensor's own noise.
            Whatever it is, boxes jitter and the field of view ends.
    """

    name: str
    sensors: tuple[str, ...]
    distance: tuple[float, float]
    median_points: float = 0
    mount: float = 0.0
    slope: float
    margin: float = 0.0
    around: float = 0.0
    clutter: float = 0.0
    occluder: float = 0.0
    company: float = 0.0
    carry: float = 0.0
    merged: float = 0.0
    accumulated: float = 0.0
    inverted: float = 0.0
    integration: float = 0.0
    sparse: float = 0.0
    crowded: float = 0.0
    noise: NoiseConfig
    crop: CropErrors = CropErrors()
    recorded: float = 0.0
    clothes: float = 1.0
    hard: float = 1.0

    def __post_init__(self):
        if not 0 <= self.hard <= 1:
            raise InputError(f"SceneConfig.hard must be between 0 (easy) and 1 (full), got {self.hard}")
        if not self.sensors:
            raise InputError("SceneConfig.sensors must name at least one sensor, got none")

    @property
    def varied(self) -> bool:
        """Whether people may be seen otherwise than in one scan of an upright sensor."""
        return any((self.merged, self.accumulated, self.inverted, self.integration, self.sparse, self.crowded))

    def eased(self, hard: float) -> "SceneConfig":
        """The same scenes at a difficulty of `hard` in [0, 1]."""
        return replace(self, hard=hard)

    def changed(self, settings: Sequence[str]) -> "SceneConfig":
        """The same scenes but for some fields, each given as "name=value": of the scene, its noise or its crops; two
        ends as "distance=4:12"; the noise's clutter is "noise.clutter". "keep=R" is the paper's r_keep: every sample is
        masked and keeps a share R. Raises InputError for what is no field or no value of it.
        """
        scene = self
        for setting in settings:
            scene = _changed(scene, *setting.partition("=")[::2])
        return scene


# fields that are between 0 and 1
_SHARES = frozenset(
    "clutter occluder company merged accumulated inverted integration sparse crowded recorded hard mask mask_keep "
    "missing_part intensity_dropout beam_divergence dapt_compat loose cut".split()
)


def _changed(scene: SceneConfig, name: str, text: str) -> SceneConfig:
    """The scene with one field changed, see `SceneConfig.changed`."""
    groups: dict[str, Any] = {"": scene, "noise": scene.noise, "crop": scene.crop}
    known: dict[str, tuple[str, str]] = {"keep": ("noise", "mask_keep")}
    for group, config in groups.items():
        for field in fields(config):
            if isinstance(getattr(config, field.name), int | float | tuple) and field.name != "sensors":
                # two have a field clutter
                known[f"{group}.{field.name}" if field.name in known else field.name] = (group, field.name)
    check_name("setting of the scene", name, known)
    group, field_name = known[name]
    before = getattr(groups[group], field_name)
    try:
        numbers = [float(part) for part in text.split(":")]
        fits = len(numbers) in ((1, 2) if isinstance(before, tuple) else (1,)) and all(0 <= n < inf for n in numbers)
        if not fits or numbers[0] > numbers[-1]:
            raise ValueError
    except ValueError:
        expected = "a number or two, LOW:HIGH" if isinstance(before, tuple) else "a number"
        raise InputError(f"expected {name}={expected}, at least 0, got {name}={text}") from None
    if field_name in _SHARES and numbers[-1] > 1:
        raise InputError(f"{name} must be between 0 and 1, got {text}")
    value = (numbers[0], numbers[-1]) if isinstance(before, tuple) else type(before)(numbers[0])
    changes: dict[str, Any] = {field_name: value} | ({"mask": 1.0} if name == "keep" else {})
    if not group:
        return replace(scene, **changes)
    return replace(scene, **{group: replace(groups[group], **changes)})


# --- how a cloud is acquired

# sensors of few rings, and how far away people are who are seen by them, m
_SPARSE, _SPARSE_FAR = ("vlp-16", "hdl-32e", "vlp-32c"), 25.0
# sensors that are merged: how many, how far from the person, m, and how often they are of one model
_MERGED, _MERGED_AWAY, _ONE_MODEL = (2, 4), (3.0, 15.0), 0.5
# frames added up: how many, and the sensor's speed, m/s, in the half of cases in which it drives
_FRAMES, _FASTEST = (2, 5), 15.0
_INTEGRATED = (1, 2, 5)
# height of a sensor that hangs, m
_HANGS = (2.0, 5.0)
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


SINGLE_SCAN = Acquisition()
# a person's frames that may be added up: the last one is that of the pose
MOST_FRAMES = _FRAMES[1]


def draw_acquisition(config: SceneConfig, draws: np.ndarray) -> Acquisition:
    """The acquisition that `draws` (ACQUISITION_DRAWS,), uniform in [0, 1), decide on; merged ones have one frame."""
    merged, accumulated, integration, inverted, sparse, crowded, several, drives, speed, *devices = draws.tolist()
    hard = float(config.hard)
    names, distance, frames, moving, conditions = config.sensors, None, 1, 0.0, []
    if sparse < config.sparse * hard:
        names, distance = _SPARSE, (config.distance[0], min(config.distance[1], _SPARSE_FAR))
        conditions.append("sparse")
    drawn = [names[int(device * len(names))] for device in devices]
    sensors = drawn[:1]
    if merged < config.merged * hard:
        count = _between(_MERGED, several)
        sensors = sensors * count if drives < _ONE_MODEL else drawn[:count]
        distance = _MERGED_AWAY
        conditions.append("merged")
    elif accumulated < config.accumulated * hard:
        frames, moving = _between(_FRAMES, several), speed * _FASTEST if drives < 0.5 else 0.0
        conditions.append("accumulated")
    elif integration < config.integration * hard and getattr(sensor(sensors[0]), "duration", 0):
        frames = _INTEGRATED[int(several * len(_INTEGRATED))]
        conditions += ["integrated"] * (frames > 1)
    conditions += ["inverted"] * (hangs := inverted < config.inverted * hard)
    conditions += ["crowded"] * (two := crowded < config.crowded * hard)
    if not conditions:
        return SINGLE_SCAN
    return Acquisition(
        sensors=tuple(sensors), frames=frames, speed=moving, inverted=hangs, crowded=two, distance=distance,
        conditions=tuple(conditions),
    )  # fmt: skip


def _between(ends: tuple[int, int], share: float) -> int:
    """The whole number at a share in [0, 1) of those from the one to the other."""
    return ends[0] + int(share * (ends[1] - ends[0] + 1))


# Paper: section "Scene sampling": r in [4, 20] m, a tilted square of ground, the effective window without a margin,
# s_p and r_keep of "Laser-level masking". Clusters of noise are named only among its stability tests.
_PAPER = SceneConfig(
    name="paper",
    sensors=("dapt64",),
    distance=(4.0, 20.0),
    slope=np.radians(5.0),
    noise=NoiseConfig(mask=1.0),
)

SCENES = {
    "paper": _PAPER,
    # where the released code departs from the paper: 5 to 20 m, 1.8 degrees about the body, ranges 0 to 2 cm too
    # long, clusters of noise in half of the samples, in half of them one body part gone, the seam's beams twice
    "reference": replace(
        _PAPER,
        name="reference",
        distance=(5.0, 20.0),
        margin=np.radians(1.8),
        noise=NoiseConfig(mask=1.0, clutter=0.5, missing_part=0.5, dapt_compat=True),
    ),
    # sensors, counts and crops as users have them: 50 to 900 points a person, boxes of real detectors
    "wild": SceneConfig(
        name="wild",
        sensors=(
            *("dapt64", "vlp-32c", "os1-128", "os1-64", "hdl-64e", "hdl-32e", "vlp-16", "waymo-top", "pandar64", "av2"),
            *("os0-128", "os1-128"),
            # one in five is a rosette
            *("livox-mid360", "livox-avia", "livox-mid100"),
        ),
        distance=(1.5, 40.0),
        median_points=260,
        mount=0.3,
        slope=np.radians(3.0),
        around=0.3,
        clutter=0.35,
        occluder=0.28,
        company=0.15,
        carry=1.0,
        noise=NoiseConfig(
            mask=0.3,
            mask_keep=(0.55, 1.0),
            clutter=0.08,
            most_clutter=90,
            missing_part=0.1,
            intensity_dropout=0.9,
            beam_divergence=0.2,
            # measured on VLP-32C sweeps: 5 to 7 mm along a ring, 10 to 15 mm between rings of one object
            sigma=(0.2, 1.0),
            ring_bias=(0.004, 0.016),
        ),
        crop=CropErrors(jitter=0.08, loose=0.125, cut=0.15),
    ),
}


# clouds of several scans, hung sensors, few rings and two people in one crop besides
SCENES["wide"] = replace(
    SCENES["wild"],
    name="wide",
    merged=0.06,
    accumulated=0.06,
    inverted=0.08,
    integration=0.5,
    sparse=0.12,
    crowded=0.05,
)


def scene_config(name: str) -> SceneConfig:
    """The named scene preset: paper, reference, wild or wide."""
    check_name("scene", name, SCENES)
    return SCENES[name]


# --- where a person stands, and how the sensor is mounted

# a standing adult fills about this much of a sphere seen from one meter (silhouette, m2)
_SILHOUETTE = 0.55
# log-normal spread of point counts about the median: 5 to 95 percent are a factor of about 5
_COUNT_SPREAD = 0.95
# share of people whom the edge of the sensor's field of view may cut
_CUT = 0.05
# standard deviation of a mount's pitch and roll, rad, in scenes whose mounts vary
_MOUNT_TILT = np.radians(1.5)
# a sensor tilted by more than this looks at people ahead of it, within this azimuth, rad
_TILTED, _AHEAD = np.radians(10.0), np.radians(50.0)
# lasers nearer than this share one elevation, rad
_SAME_ELEVATION = 1e-9
# edges of a field of view steeper than this leave room for anybody, rad
_STEEPEST = np.radians(80.0)


@dataclass(frozen=True, kw_only=True)
class Place:
    """Where somebody stands, in the level frame at the sensor: feet (3,) m, yaw rad, distance m (horizontal);
    R_sensor_level (3, 3): the mount, None where the sensor is level."""

    feet: np.ndarray
    yaw: float
    distance: float
    R_sensor_level: np.ndarray | None = None

    def of_body(self, points: np.ndarray) -> np.ndarray:
        """Points (n, 3) of a body that faces +x on the origin, where it stands: in the level frame."""
        c, s = cos(self.yaw), sin(self.yaw)
        turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]], points.dtype)
        return points @ turn + self.feet.astype(points.dtype)

    def to_sensor(self, points: np.ndarray) -> np.ndarray:
        """Points (n, 3) of the level frame in the sensor's."""
        return points if self.R_sensor_level is None else points @ self.R_sensor_level.T.astype(points.dtype)

    def to_level(self, points: np.ndarray) -> np.ndarray:
        """Points (n, 3) of the sensor's frame in the level one."""
        return points if self.R_sensor_level is None else points @ self.R_sensor_level.astype(points.dtype)


def draw_place(
    config: SceneConfig, device: Sensor | RayPattern, tall: float, wide: float, nearer: float, rng: np.random.Generator,
    inverted: bool = False,
) -> Place:  # fmt: skip
    """Somebody `tall` m, who reaches `wide` m to the sides, before a sensor. Paper: section "Scene sampling".

    `nearer` scales the distance, for another try at somebody of whom too little was seen; `inverted`: the sensor hangs
    upside down.
    """
    distance = max(draw_distance(config, device, rng) * nearer, config.distance[0])
    ahead, yaw, escape = rng.random(3).tolist()
    azimuth = _azimuth(device, atan2(wide, distance), ahead, escape < _CUT or not config.mount)
    pitch, roll = 0.0 if inverted else device.tilt, 0.0
    if config.mount:
        pitch, roll = pitch + _MOUNT_TILT * rng.standard_normal(), _MOUNT_TILT * rng.standard_normal()
    mount = rotation_about("x", roll) @ rotation_about("y", -pitch) if pitch or roll else None
    height = device.height
    if inverted:
        height = float(rng.uniform(*_HANGS))
        level = np.eye(3) if mount is None else mount
        mount = rotation_about("x", pi) @ level @ _aim_inverted(device, distance, tall, height, azimuth)
    elif config.mount:
        height = draw_height(device, distance, tall, config.mount, pitch, azimuth, rng)
    return Place(
        feet=np.array([distance * cos(azimuth), distance * sin(azimuth), -height]),
        yaw=float(2 * np.pi * yaw - np.pi),
        distance=float(distance),
        R_sensor_level=mount,
    )


def recorded_place(place: Place, recorded: np.ndarray) -> Place:
    """`place` with x, y m and heading rad of a recording (3,) instead of random ones."""
    x, y, yaw = recorded.astype(float)
    return replace(place, feet=np.array([x, y, place.feet[2]]), yaw=float(yaw), distance=float(np.hypot(x, y)))


def _azimuth(device: Sensor | RayPattern, half_width: float, share: float, cut: bool) -> float:
    """Uniform over the sensor's field of view, with the whole person inside it unless it may `cut` them."""
    low, high = (-np.pi, np.pi) if isinstance(device, Sensor) else device.azimuths
    if abs(device.tilt) > _TILTED:
        low, high = max(low, -_AHEAD), min(high, _AHEAD)
    if high - low < 2 * np.pi - 1e-6 and not cut:
        half_width = min(half_width, (high - low) / 2)
        low, high = low + half_width, high - half_width
    return float(low + share * (high - low))


def draw_distance(config: SceneConfig, device: Sensor | RayPattern, rng: np.random.Generator) -> float:
    """Horizontal distance to the person in meters.

    Paper: uniform. Else the distance at which this sensor returns a log-normal number of points.
    """
    near, far = config.distance
    if config.median_points == 0:
        return float(rng.uniform(near, far))
    count = config.median_points * np.exp(rng.normal(0, _COUNT_SPREAD))
    return float(min(max(np.sqrt(_SILHOUETTE / (count * _beam(device))), near), far))


@lru_cache(maxsize=64)
def _beam(device: Sensor | RayPattern) -> float:
    """Solid angle that a beam of the sensor stands for (where its rings lie closest), sr. Where most lasers share their
    elevations, those of one elevation share the gap to the next."""
    if isinstance(device, Sensor):
        gaps = np.diff(device.elevations)
        gap = np.median(gaps) if len(gaps) else 0.0
        if gap < _SAME_ELEVATION:
            gaps = gaps[gaps > _SAME_ELEVATION]
            gap = np.median(gaps) if len(gaps) else np.radians(1.0)
            gap *= (len(gaps) + 1) / len(device.elevations)
        return device.azimuth_step * float(gap)
    width = device.azimuths[1] - device.azimuths[0]
    return float(width * np.diff(np.sin(device.elevations))[0] / len(device.frame(0).directions))


def _aim_inverted(
    device: Sensor | RayPattern, distance: float, tall: float, height: float, azimuth: float
) -> np.ndarray:
    """(3, 3) turn of a sensor before it is mounted upside down, `height` m above the ground: none where its fan, which
    is mirrored, holds the whole person; else its middle is tilted to theirs."""
    low, high = -device.elevations[-1], -device.elevations[0]
    feet, head = atan2(-height, distance), atan2(tall - height, distance)
    if low <= feet and head <= high:
        return np.eye(3)
    down = (low + high - feet - head) / 2
    return rotation_about("z", azimuth) @ rotation_about("y", -down) @ rotation_about("z", -azimuth)


def draw_height(
    device: Sensor | RayPattern, distance: float, tall: float, spread: float, pitch: float, azimuth: float,
    rng: np.random.Generator, cut: float = _CUT,
) -> float:  # fmt: skip
    """Height of the sensor above the person's ground in meters, jittered for mounts and slopes.

    Where the person of `tall` m would reach out of the sensor's fan although there is room for them, the height is
    moved until they fit, but for a share `cut` of people. `spread` m is the height's standard
    deviation, `pitch` rad tilts the fan down at azimuth 0, `azimuth` rad is the person's.
    """
    mount, slope = rng.standard_normal(2).tolist()
    height = device.height + spread * mount + 0.02 * slope * distance
    down = pitch * cos(azimuth)
    edges = [min(max(device.elevations[end] - down, -_STEEPEST), _STEEPEST) for end in (0, -1)]
    low, high = distance * tan(edges[0]), distance * tan(edges[1])
    if rng.random() < cut:
        return float(height)
    if high - low <= tall:
        # taller than the fan: the middle of the fan looks at the middle of the person
        return float(tall / 2 - (low + high) / 2)
    # feet, at -height, not below the fan; head, at tall - height, not above it
    return float(min(max(height, tall - high), -low))
