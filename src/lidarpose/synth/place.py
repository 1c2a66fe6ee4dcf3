"""Where a person stands before a sensor, and how the sensor is mounted.

Frames: the level frame at the sensor (z up, the ground under the person at z = -height), and the sensor's own frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from math import atan2, cos, hypot, pi, sin, tan

import numpy as np

from lidarpose.geometry import rotation_about
from lidarpose.lidar.ray_pattern import RayPattern
from lidarpose.lidar.sensor import Sensor
from lidarpose.synth.props import Prop
from lidarpose.synth.scene import SceneConfig

# approximate area of a standing adult's silhouette, m2: its solid angle from a distance of one meter
_SILHOUETTE = 0.55
# standard deviation of the logarithm of point counts: the 5 and 95 percent quantiles are the median / 5 and * 5, about
_COUNT_SPREAD = 0.95
# height range of an inverted sensor, m
_HANGS = (2.0, 5.0)
# share of people who may be cut by the edge of the sensor's field of view
_CUT = 0.05
# standard deviation of a mount's pitch and roll, rad, in scenes whose mounts vary
_MOUNT_TILT = np.radians(1.5)
# before a sensor tilted by more than the first, people stand at azimuths within +- the second, rad
_TILTED, _AHEAD = np.radians(10.0), np.radians(50.0)
# lasers whose elevations differ by less than this count as one elevation, rad
_SAME_ELEVATION = 1e-9
# people nearer than the first, m, stand on the sensor's own ground, which is at least the second below the sensor, m
_ON_OWN_GROUND, _LOWEST = 8.0, 0.1
# edges of a field of view steeper than this do not constrain the height, rad
_STEEPEST = np.radians(80.0)


@dataclass(frozen=True, kw_only=True)
class Place:
    """Where a person stands, in the level frame at the sensor: feet (3,) m, yaw rad, distance m (horizontal);
    R_sensor_level (3, 3): the mount, None if the sensor is level."""

    feet: np.ndarray
    yaw: float
    distance: float
    R_sensor_level: np.ndarray | None = None

    def on_props(self, props: Sequence[Prop]) -> "Place":
        """The place of a body with these props: above the ground by the largest lift of a prop."""
        lift = max((prop.lift for prop in props), default=0.0)
        return replace(self, feet=self.feet + [0, 0, lift]) if lift else self

    def of_body(self, points: np.ndarray) -> np.ndarray:
        """Points (n, 3) of a body at the origin, facing +x, transformed to this place in the level frame."""
        c, s = cos(self.yaw), sin(self.yaw)
        turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]], points.dtype)
        return points @ turn + self.feet.astype(points.dtype)

    def to_sensor(self, points: np.ndarray) -> np.ndarray:
        """Transforms points (n, 3) from the level frame to the sensor's."""
        return points if self.R_sensor_level is None else points @ self.R_sensor_level.T.astype(points.dtype)

    def to_level(self, points: np.ndarray) -> np.ndarray:
        """Transforms points (n, 3) from the sensor's frame to the level one."""
        return points if self.R_sensor_level is None else points @ self.R_sensor_level.astype(points.dtype)


def draw_place(
    config: SceneConfig, device: Sensor | RayPattern, tall: float, wide: float, nearer: float, rng: np.random.Generator,
    inverted: bool = False, recorded: np.ndarray | None = None,
) -> Place:  # fmt: skip
    """The place of a person `tall` m high, who reaches `wide` m to the sides. Paper: section "Scene sampling".

    `nearer` scales the distance, for another draw of a person with too few points; `inverted`: the sensor is mounted
    upside down; `recorded` (3,): x, y m and heading rad of a recording, kept instead of drawn ones.
    """
    distance = max(draw_distance(config, device, rng) * nearer, config.distance[0])
    azimuth_share, yaw, cut_draw = rng.random(3).tolist()
    azimuth = _azimuth(device, atan2(wide, distance), azimuth_share, cut_draw < _CUT or not config.mount)
    yaw = 2 * np.pi * yaw - np.pi
    if recorded is not None:
        x, y, yaw = recorded.astype(float).tolist()
        distance, azimuth = hypot(x, y), atan2(y, x)
    pitch, roll = 0.0 if inverted else device.tilt, 0.0
    if config.mount:
        pitch, roll = pitch + _MOUNT_TILT * rng.standard_normal(), _MOUNT_TILT * rng.standard_normal()
    R_sensor_level = rotation_about("x", roll) @ rotation_about("y", -pitch) if pitch or roll else None
    height = device.height
    if inverted:
        height = float(rng.uniform(*_HANGS))
        R_tilt = np.eye(3) if R_sensor_level is None else R_sensor_level
        R_sensor_level = rotation_about("x", pi) @ R_tilt @ _aim_inverted(device, distance, tall, height, azimuth)
    elif config.mount:
        height = draw_height(device, distance, tall, config.mount, pitch, azimuth, rng)
    return Place(
        feet=np.array([distance * cos(azimuth), distance * sin(azimuth), -height]),
        yaw=float(yaw),
        distance=float(distance),
        R_sensor_level=R_sensor_level,
    )


def _azimuth(device: Sensor | RayPattern, half_width: float, share: float, may_cut: bool) -> float:
    """Azimuth at a `share` of the sensor's field of view; unless `may_cut`, the whole person is inside it."""
    low, high = (-np.pi, np.pi) if isinstance(device, Sensor) else device.azimuths
    if abs(device.tilt) > _TILTED:
        low, high = max(low, -_AHEAD), min(high, _AHEAD)
    if high - low < 2 * np.pi - 1e-6 and not may_cut:
        half_width = min(half_width, (high - low) / 2)
        low, high = low + half_width, high - half_width
    return float(low + share * (high - low))


def draw_distance(config: SceneConfig, device: Sensor | RayPattern, rng: np.random.Generator) -> float:
    """Horizontal distance to the person in meters.

    Paper: uniform. If `median_points` is set, the distance at which this sensor returns a log-normal number of points.
    """
    near, far = config.distance
    if config.median_points == 0:
        return float(rng.uniform(near, far))
    count = config.median_points * np.exp(rng.normal(0, _COUNT_SPREAD))
    return float(min(max(np.sqrt(_SILHOUETTE / (count * _beam(device))), near), far))


@lru_cache(maxsize=64)
def _beam(device: Sensor | RayPattern) -> float:
    """Solid angle per beam of the sensor (where its rings are densest), sr. If most lasers share their elevations, the
    gap to the next elevation is divided among the lasers of one elevation."""
    if isinstance(device, Sensor):
        gaps = np.diff(device.elevations)
        gap = np.median(gaps) if len(gaps) else 0.0
        if gap < _SAME_ELEVATION:
            gaps = gaps[gaps > _SAME_ELEVATION]
            gap = np.median(gaps) if len(gaps) else np.radians(1.0)
            gap *= (len(gaps) + 1) / len(device.elevations)
        return device.azimuth_step * float(gap)
    return float(device.field_of_view * np.diff(np.sin(device.elevations))[0] / len(device.frame(0).directions))


def _aim_inverted(
    device: Sensor | RayPattern, distance: float, person_height: float, height: float, azimuth: float
) -> np.ndarray:
    """(3, 3) rotation of a sensor before it is mounted upside down, `height` m above the ground: the identity if its
    inverted fan holds the whole person; else a pitch that points the middle of the fan at the middle of the person."""
    low, high = -device.elevations[-1], -device.elevations[0]
    feet, head = atan2(-height, distance), atan2(person_height - height, distance)
    if low <= feet and head <= high:
        return np.eye(3)
    pitch = (low + high - feet - head) / 2
    return rotation_about("z", azimuth) @ rotation_about("y", -pitch) @ rotation_about("z", -azimuth)


def draw_height(
    device: Sensor | RayPattern, distance: float, tall: float, spread: float, pitch: float, azimuth: float,
    rng: np.random.Generator, cut: float = _CUT,
) -> float:  # fmt: skip
    """Height of the sensor above the person's ground in meters, with random variation for mounts and slopes.

    Except for a share `cut` of people, the height is then changed so that the person, `tall` m high, fits in the
    sensor's fan or, if taller than the fan, is centered in it. `spread` m is the height's standard deviation, `pitch`
    rad tilts the fan down at azimuth 0, `azimuth` rad is the person's.
    """
    mount_normal, slope_normal = rng.standard_normal(2).tolist()
    height = device.height + spread * mount_normal + 0.02 * slope_normal * distance
    pitch_at_azimuth = pitch * cos(azimuth)
    edges = [min(max(device.elevations[end] - pitch_at_azimuth, -_STEEPEST), _STEEPEST) for end in (0, -1)]
    low, high = distance * tan(edges[0]), distance * tan(edges[1])
    if rng.random() >= cut:
        if high - low <= tall:
            # the person is taller than the fan: center the fan on the person
            height = tall / 2 - (low + high) / 2
        else:
            # feet, at -height, not below the fan; head, at tall - height, not above it
            height = min(max(height, tall - high), -low)
    return float(max(height, _LOWEST) if distance < _ON_OWN_GROUND else height)
