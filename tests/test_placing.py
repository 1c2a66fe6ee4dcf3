"""Placement of people and sensors: within the field of view, at distances with realistic point counts."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from lidarpose.lidar.presets import SENSORS, sensor
from lidarpose.lidar.sensor import Sensor
from lidarpose.synth.place import draw_distance, draw_height, draw_place
from lidarpose.synth.scene import SCENES

WILD = SCENES["wild"]


@pytest.mark.parametrize("name", SCENES)
def test_draw_distance_stays_in_range(name):
    config, rng = SCENES[name], np.random.default_rng(0)
    for device in map(sensor, config.sensors):
        # a retry is nearer
        far, near = (
            draw_place(config, device, 1.7, 0.3, nearer, np.random.default_rng(5)).distance for nearer in (1.0, 0.5)
        )
        assert near == pytest.approx(max(far / 2, config.distance[0]))
        drawn = np.array([draw_distance(config, device, rng) for _ in range(300)])
        assert drawn.min() >= config.distance[0] and drawn.max() <= config.distance[1]
        if config.median_points == 0:
            assert drawn.mean() == pytest.approx(np.mean(config.distance), abs=1) and np.ptp(drawn) > 14


def test_draw_distance_counts_lasers_of_equal_elevation():
    """All sensors get the same number of points: with twice the beams, sqrt(2) farther."""
    elevations, step = np.radians(np.linspace(-15, 15, 16)), np.radians(0.2)
    once = Sensor(name="once", elevations=elevations, azimuth_step=step)
    twice = Sensor(
        name="twice",
        elevations=np.repeat(elevations, 2),
        azimuth_step=step,
        azimuth_offsets=np.tile([0.0, step / 2], 16),
    )
    config = replace(WILD, distance=(0.1, 1000.0))
    a, b = (draw_distance(config, device, np.random.default_rng(1)) for device in (once, twice))
    assert b == pytest.approx(a * np.sqrt(2), rel=1e-6)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(2, 40), st.floats(0.4, 2.1), st.floats(-0.3, 0.3), st.floats(-3, 3))
def test_draw_height_fits_person_into_field_of_view(seed, distance, tall, pitch, ahead):
    device = sensor("os1-128")
    height = draw_height(device, distance, tall, 0.3, pitch, ahead, np.random.default_rng(seed), cut=0.0)
    low, high = distance * np.tan(device.elevations[[0, -1]] - pitch * np.cos(ahead))
    if high - low > tall:
        # the head may be cut only if otherwise the feet were
        assert -height >= low - 1e-9
        assert tall - height <= max(high, low + tall) + 1e-9
    else:
        assert -height + tall / 2 == pytest.approx((low + high) / 2)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(1, 7.9), st.floats(0.4, 2.1), st.sampled_from(sorted(SENSORS)))
def test_draw_height_near_people_is_above_ground(seed, distance, tall, name):
    for cut in (0.0, 1.0):
        assert draw_height(sensor(name), distance, tall, 0.5, 0.0, 0.0, np.random.default_rng(seed), cut=cut) >= 0.1


@pytest.mark.parametrize("name", sorted(SENSORS))
def test_draw_place_rarely_cuts_people_by_field_of_view(name):
    """Counts people for whom the field of view is large enough."""
    device, rng = sensor(name), np.random.default_rng(3)
    body = np.array([[x, y, z] for x in (-0.2, 0.2) for y in (-0.3, 0.3) for z in (0.0, 0.9, 1.7)], np.float32)
    cut = total = 0
    for _ in range(400):
        place = draw_place(replace(WILD, distance=(6.0, 40.0)), device, 1.7, 0.3, 1.0, rng)
        points = place.to_sensor(place.of_body(body)).astype(float)
        azimuth = np.arctan2(points[:, 1], points[:, 0])
        elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
        low, high = device.elevations[0], device.elevations[-1]
        if place.distance * (np.tan(high) - np.tan(low)) < 2.2:
            continue
        inside = (elevation > low - 0.02) & (elevation < high + 0.02)
        if not isinstance(device, Sensor):
            inside &= (azimuth > device.azimuths[0] - 0.02) & (azimuth < device.azimuths[1] + 0.02)
        cut += not inside.all()
        total += 1
    assert total > 100 and cut / total < 0.09


def test_narrow_field_of_view_holds_whole_person():
    device, rng, sides = sensor("livox-avia"), np.random.default_rng(4), []
    for _ in range(400):
        place = draw_place(replace(WILD, distance=(5.0, 6.0)), device, 1.7, 1.2, 1.0, rng)
        sides.append(abs(np.arctan2(place.feet[1], place.feet[0])) + np.arctan2(1.2, place.distance))
    # about 5 percent may be cut
    assert np.mean(np.array(sides) > device.azimuths[1] + 1e-9) < 0.06


def test_draw_place_paper_sensor_is_level_at_fixed_height():
    rng = np.random.default_rng(1)
    azimuths = []
    for _ in range(200):
        place = draw_place(SCENES["paper"], sensor("dapt64"), 1.7, 0.3, 1.0, rng)
        assert place.feet[2] == -0.5 and place.R_sensor_level is None
        assert np.hypot(*place.feet[:2]) == pytest.approx(place.distance)
        azimuths.append(np.arctan2(place.feet[1], place.feet[0]))
    assert {int(a) for a in np.floor(np.array(azimuths) / (np.pi / 4))} == set(range(-4, 4))


@pytest.mark.parametrize("tilt", [0.0, 40.0])
def test_inverted_sensor_ignores_tilt_of_upright_mount(tilt):
    device, rng = replace(sensor("vlp-16"), tilt=np.radians(tilt)), np.random.default_rng(2)
    for _ in range(50):
        place = draw_place(replace(WILD, mount=0.0), device, 1.7, 0.3, 1.0, rng, inverted=True)
        assert 2 <= -place.feet[2] <= 5
        ends = place.to_sensor(place.feet + np.array([[0, 0, 0], [0, 0, 1.7]]))
        feet, head = np.arctan2(ends[:, 2], np.hypot(ends[:, 0], ends[:, 1]))
        # upside down, with the person inside the fan or centered in it
        low, high = device.elevations[[0, -1]]
        assert feet > head and ((low - 1e-9 <= head and feet <= high + 1e-9) or abs(feet + head - low - high) < 1e-6)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_place_to_sensor_and_to_level_are_inverse(seed):
    rng = np.random.default_rng(seed)
    place = draw_place(WILD, sensor("os1-128"), 1.7, 0.3, 1.0, rng)
    points = rng.normal(0, 3, (20, 3))
    np.testing.assert_allclose(place.to_level(place.to_sensor(points)), points, atol=1e-12)
    np.testing.assert_allclose(
        np.linalg.norm(place.to_sensor(points), axis=1), np.linalg.norm(points, axis=1), atol=1e-12
    )
    # the body's x axis points along its yaw
    step = place.of_body(np.array([[1.0, 0, 0]])) - place.of_body(np.zeros((1, 3)))
    np.testing.assert_allclose(step[0], [np.cos(place.yaw), np.sin(place.yaw), 0], atol=1e-12)


def test_draw_place_puts_people_ahead_of_tilted_sensor():
    device = replace(sensor("os1-128"), tilt=np.radians(45.0))
    rng = np.random.default_rng(2)
    elevations = []
    for _ in range(100):
        place = draw_place(replace(WILD, mount=1e-6), device, 1.7, 0.3, 1.0, rng)
        assert abs(np.arctan2(place.feet[1], place.feet[0])) <= np.radians(50) + 1e-9
        middle = place.to_sensor((place.feet + [0, 0, 0.85])[None])[0]
        elevations.append(np.arctan2(middle[2], np.hypot(middle[0], middle[1])))
    assert np.mean(np.abs(elevations) < np.radians(24)) > 0.9
