"""Sensors with several origins."""

from dataclasses import replace

import numpy as np
import pytest
from reference.raycast_reference import cast_ray_list_reference

from lidarpose.errors import InputError
from lidarpose.lidar.presets import sensor
from lidarpose.lidar.raycast import scan, scan_divergent
from lidarpose.synth.environment.mesh import box

AV2 = sensor("av2")


def mesh(azimuth):
    place = np.array([7 * np.cos(azimuth), 7 * np.sin(azimuth), -1.9])
    return box((0.4, 0.6, 1.7)).moved(place, 0.3)


@pytest.mark.parametrize("azimuth", [0.7, np.pi, -3.1])
def test_beams_leave_from_their_own_origin(azimuth):
    body = mesh(azimuth)
    hits = scan(body.vertices, body.faces, AV2)
    assert len(hits.points) > 150
    heights = AV2.origin_heights[hits.ring]
    assert set(heights) == {0.0, -0.11} and AV2.heads is AV2.origins
    beams = hits.points.astype(float) - np.stack([0 * heights, 0 * heights, heights], -1)
    np.testing.assert_allclose(
        np.arctan2(beams[:, 2], np.hypot(beams[:, 0], beams[:, 1])), AV2.elevations[hits.ring], atol=1e-6
    )
    azimuths = -np.pi + (hits.column + hits.column0) * AV2.azimuth_step + AV2.azimuth_shifts[hits.ring]
    away = np.arctan2(beams[:, 1], beams[:, 0]) - azimuths
    np.testing.assert_allclose(np.mod(away + np.pi, 2 * np.pi), np.pi, atol=1e-5)
    # the slow twin, an origin at a time
    for height in (0.0, -0.11):
        own = heights == height
        moved = body.vertices - np.float32([0, 0, height])
        distance, _ = cast_ray_list_reference(moved, body.faces, beams[own])
        np.testing.assert_allclose(distance, np.linalg.norm(beams[own], axis=1), atol=1e-4)
    # in order, inside the window
    key = hits.column.astype(np.int64) * 100 + hits.ring
    assert (np.diff(key) > 0).all()
    assert hits.column.max() < hits.columns and hits.row0 <= hits.ring.min()
    assert hits.ring.max() < hits.row0 + hits.rows


def test_origins_at_one_height_are_one_sensor():
    body = mesh(1.1)
    together = scan(body.vertices, body.faces, replace(AV2, origin_heights=None))
    apart = scan(body.vertices, body.faces, replace(AV2, origin_heights=np.zeros(64)))
    np.testing.assert_array_equal(apart.ring, together.ring)
    np.testing.assert_allclose(apart.points, together.points, atol=1e-6)


def test_divergent_beams_of_several_origins():
    body = mesh(1.1)
    lines, wide = scan(body.vertices, body.faces, AV2), scan_divergent(body.vertices, body.faces, AV2, divergence=0.003)
    assert len(lines.points) < len(wide.points) < 1.2 * len(lines.points)


def test_nothing_seen_and_wrong_heights():
    far = mesh(0.2).moved(np.array([0, 0, 500.0]))
    assert len(scan(far.vertices, far.faces, AV2).points) == 0
    with pytest.raises(InputError, match="origin_heights must be"):
        replace(AV2, origin_heights=np.zeros(3))
    with pytest.raises(InputError, match="origin_heights must be a list of finite heights in meters"):
        replace(AV2, origin_heights=np.full(64, np.nan))
