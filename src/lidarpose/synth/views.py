"""The scans that are added to a scene's own: from other sensors around the person, or from earlier frames."""

from dataclasses import replace

import numpy as np

from lidarpose.geometry import rotation_about
from lidarpose.lidar.presets import sensor
from lidarpose.lidar.sensor import Sensor
from lidarpose.synth.bodies import CLIP_HZ
from lidarpose.synth.place import draw_place
from lidarpose.synth.scene import SceneConfig
from lidarpose.synth.simulate import Scene, View, draw_conditions

# maximum deviation of merged sensors from equal angles around the person, rad
_OFF_ANGLE = 0.4
# if a person behind the sensor is nearer than this to its x axis, the sensor moves along -x instead of +x, m
_BESIDE_LANE = 1.5


def with_views(
    scene: Scene, placing: SceneConfig, height: float, reach: float, nearer: float, rng: np.random.Generator
) -> Scene:
    """The scene with the scans that its acquisition adds. Arguments: as in `draw_place`."""
    if len(scene.acquisition.sensors) > 1:
        return replace(scene, views=_merged_views(scene, placing, height, reach, nearer, rng))
    return replace(scene, views=_earlier_views(scene)) if scene.acquisition.frames > 1 else scene


def _merged_views(
    scene: Scene, place_config: SceneConfig, height: float, reach: float, nearer: float, rng: np.random.Generator
) -> tuple[View, ...]:
    """The other sensors around a person, each with its own rotation, mount and noise, up to a tenth of a second before
    or after the first one, some at twice their normal rate. Arguments: as in `draw_place`."""
    names, feet, views = scene.acquisition.sensors, scene.place.feet, []
    for k, name in enumerate(names[1:], 1):
        device = sensor(name)
        sensor_place = draw_place(place_config, device, height, reach, nearer, rng, scene.acquisition.inverted)
        angle, lag = rng.uniform(-1, 1, 2).tolist()
        # direction from this sensor to the person in the first sensor's frame
        heading = np.arctan2(feet[1], feet[0]) + 2 * np.pi * k / len(names) + _OFF_ANGLE * angle
        turn = rotation_about("z", heading - np.arctan2(sensor_place.feet[1], sensor_place.feet[0]))
        position = feet - turn @ sensor_place.feet
        rate, lags = scene.config.double_rate, [lag]
        # an odd number of columns cannot be halved
        if isinstance(device, Sensor) and device.columns % 2 == 0 and rate > 0 and rng.random() < rate:
            device = replace(device, azimuth_step=2 * device.azimuth_step, turn_time=device.turn_time / 2)
            lags.append(lag - 0.5 if lag > 0 else lag + 0.5)
        mount = turn.T if sensor_place.R_sensor_level is None else sensor_place.R_sensor_level @ turn.T
        view_scene = scene.seen_from(
            position,
            place=replace(scene.place, R_sensor_level=mount),
            sensor=device,
            conditions=draw_conditions(scene.config, device, rng),
        )
        views += [View(scene=view_scene, at=position, lag=view_lag) for view_lag in lags]
    return tuple(views)


def _earlier_views(scene: Scene) -> tuple[View, ...]:
    """The frames before the last, each from the position of the sensor at that time."""
    feet, views = scene.place.feet, []
    # along +x, it could have driven through a person behind it
    forward = -1 if feet[0] < 0 and abs(feet[1]) < _BESIDE_LANE else 1
    for earlier in range(1, scene.acquisition.frames):
        position = np.array([-forward * scene.acquisition.speed * earlier / CLIP_HZ, 0, 0])
        views.append(View(scene=scene.seen_from(position), at=position, earlier=earlier))
    return tuple(views)
