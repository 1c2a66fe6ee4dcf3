"""What a sensor returns of a few boxes."""

from dataclasses import replace

import numpy as np
import pytest

from lidarpose.geometry import rotation_about
from lidarpose.lidar.presets import sensor
from lidarpose.synth.environment.mesh import box, quad
from lidarpose.synth.placement import Place
from lidarpose.synth.scene import SCENES
from lidarpose.synth.simulate import Conditions, Layer, count_alone, draw_conditions, look

NO_FAULTS = replace(SCENES["paper"].faults, mask=0.0, stray=0.0)
PLAIN = replace(SCENES["paper"], faults=NO_FAULTS)
PERFECT = Conditions(sigma=0.0, bias=0.0, weak=0.0, divergence=0.0, keep=1.0, phase=0)
SIZE = np.array([0.4, 0.6, 1.2])
PARTS = np.arange(1, 13, dtype=np.uint8)


def place(azimuth=0.4, mount=None):
    feet = np.array([6 * np.cos(azimuth), 6 * np.sin(azimuth), -0.5])
    return Place(feet=feet, yaw=azimuth, distance=6.0, R_sensor_level=mount)


def body(where):
    mesh = box(SIZE)
    return Layer(vertices=where.of_body(mesh.vertices), faces=mesh.faces, part=PARTS)


def local(points, where):
    """In the box's own frame."""
    c, s = np.cos(where.yaw), np.sin(where.yaw)
    return (points.astype(float) - where.feet) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def surface_gap(points, where):
    p = local(points, where) - [0, 0, SIZE[2] / 2]
    outside = np.abs(p) - SIZE / 2
    return np.abs(outside.max(1))


@pytest.mark.parametrize("tilt", [0.0, 0.1, 0.3])
def test_points_lie_on_the_surface_whatever_the_mount(tilt):
    mount = rotation_about("x", 0.03) @ rotation_about("y", -tilt) if tilt else None
    where, device = place(0.2, mount), sensor("os1-64")
    seen = look([body(where)], device, where, PERFECT, PLAIN, np.random.default_rng(0))
    assert len(seen.points) > 60 and seen.points.dtype == np.float32
    assert surface_gap(seen.points, where).max() < 1e-4
    # the side that looks at the sensor
    assert np.median(local(seen.points, where)[:, 0]) == pytest.approx(-SIZE[0] / 2, abs=1e-4)
    # its two triangles
    assert len(np.unique(seen.part)) >= 2 and seen.part.min() >= 1


def test_the_released_noise_is_one_sided_and_the_symmetric_one_is_not():
    where, device = place(), sensor("dapt64")
    released = replace(PLAIN, faults=replace(NO_FAULTS, released=True))
    for config, conditions in ((released, PERFECT), (PLAIN, replace(PERFECT, sigma=0.01))):
        seen = look([body(where)], device, where, conditions, config, np.random.default_rng(1))
        error = local(seen.points, where)[:, 0] + SIZE[0] / 2
        error = error[np.abs(local(seen.points, where)[:, 1]) < 0.25]
        assert len(error) > 200
        if config is released:
            assert error.min() > -1e-3 and error.max() < 0.0201 and error.mean() == pytest.approx(0.01, abs=0.002)
        else:
            assert abs(error.mean()) < 0.002 and error.std() == pytest.approx(0.01, abs=0.002)


def test_the_released_code_casts_the_seam_s_beams_twice():
    where, device = place(np.pi), sensor("dapt64")
    released = replace(PLAIN, faults=replace(NO_FAULTS, released=True))
    counts = [
        len(look([body(where)], device, where, PERFECT, config, np.random.default_rng(2)).points)
        for config in (PLAIN, released)
    ]
    # one column of a box 1.2 m tall at 5.8 m
    assert 20 < counts[1] - counts[0] < 50
    elsewhere = place(1.0)
    counts = [
        len(look([body(elsewhere)], device, elsewhere, PERFECT, config, np.random.default_rng(2)).points)
        for config in (PLAIN, released)
    ]
    assert counts[0] == counts[1]


def test_what_stands_before_the_body_hides_it_and_is_no_part_of_it():
    where, device = place(), sensor("dapt64")
    wall = Layer.still(box(np.array([0.1, 3.0, 0.6])).moved(where.feet * [0.6, 0.6, 1], where.yaw))
    ground = Layer.still(quad(1.0, np.zeros(2)).moved(where.feet))
    alone = look([body(where)], device, where, PERFECT, PLAIN, np.random.default_rng(3))
    seen = look([body(where), wall, ground], device, where, PERFECT, PLAIN, np.random.default_rng(3))
    hidden = np.count_nonzero(seen.part) / len(alone.points)
    assert 0.2 < hidden < 0.9
    assert np.count_nonzero(seen.part == 0) > 50
    # no beam meets the body below the line over the wall's edge
    body_points = seen.points[seen.part > 0]
    assert body_points[:, 2].min() > where.feet[2] + 0.55
    assert count_alone(body(where), device, where, PERFECT, PLAIN, 0) == len(alone.points)


def test_wide_beams_fatten_the_silhouette():
    where, device = place(), sensor("os1-128")
    counts = [
        len(look([body(where)], device, where, replace(PERFECT, divergence=d), PLAIN, np.random.default_rng(0)).points)
        for d in (0.0, 0.003)
    ]
    assert counts[0] < counts[1] < 1.15 * counts[0]


def test_a_mask_keeps_its_share():
    where, device = place(), sensor("dapt64")
    whole = len(look([body(where)], device, where, PERFECT, PLAIN, np.random.default_rng(0)).points)
    shares = [
        len(look([body(where)], device, where, replace(PERFECT, keep=0.6), PLAIN, np.random.default_rng(k)).points)
        / whole
        for k in range(60)
    ]
    assert np.mean(shares) == pytest.approx(0.6, abs=0.02) and np.std(shares) > 0.005


def test_conditions_follow_the_preset_and_its_difficulty():
    rng, device = np.random.default_rng(5), sensor("os1-64")
    paper = [draw_conditions(SCENES["paper"], device, rng) for _ in range(50)]
    assert {c.keep for c in paper} == {0.6} and {c.weak for c in paper} == {0.0}
    assert {c.sigma for c in paper} == {device.range_sigma}
    wild = [draw_conditions(SCENES["wild"], device, rng) for _ in range(600)]
    assert np.mean([c.keep < 1 for c in wild]) == pytest.approx(SCENES["wild"].faults.mask, abs=0.06)
    assert min(c.keep for c in wild) >= SCENES["wild"].faults.keep
    assert np.mean([c.divergence > 0 for c in wild]) == pytest.approx(SCENES["wild"].faults.wide, abs=0.06)
    assert {c.divergence for c in paper} == {0.0}
    easy = [draw_conditions(SCENES["wild"].eased(0.0), device, rng) for _ in range(100)]
    assert {c.keep for c in easy} == {1.0}


def test_the_window_has_the_scene_s_margin():
    where = Place(feet=np.array([6.0, 0.0, -0.5]), yaw=0.0, distance=6.0, R_sensor_level=None)
    mesh = box((0.4, 0.6, 1.2))
    body = Layer(vertices=where.of_body(mesh.vertices), faces=mesh.faces, part=np.ones(12, np.uint8))
    ground = Layer.still(quad(1.0, np.zeros(2)).moved(where.feet))
    widths = []
    for margin in (0.0, 0.05):
        config = replace(PLAIN, margin=margin)
        seen = look([body, ground], sensor("dapt64"), where, PERFECT, config, np.random.default_rng(0))
        azimuth = np.arctan2(seen.points[:, 1], seen.points[:, 0])
        widths.append(np.ptp(azimuth))
    assert widths[1] - widths[0] == pytest.approx(0.1, abs=0.006)
