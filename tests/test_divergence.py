from dataclasses import replace

import numpy as np
import pytest
from raycast_meshes import body, ground, join
from reference.raycast_reference import cast_ray_list_reference, merge_echoes_reference, window_ranges, window_rays

from lidarpose.errors import InputError
from lidarpose.lidar.presets import sensor
from lidarpose.lidar.raycast import footprint, scan
from lidarpose.lidar.scan_kernels import strongest_echo
from lidarpose.synth.environment.mesh import box


def wall(x: float, y: tuple[float, float], z: tuple[float, float] = (-3, 3)):
    """A rectangle that faces the sensor at x m."""
    return np.array([[x, b, c] for b, c in ((y[0], z[0]), (y[1], z[0]), (y[1], z[1]), (y[0], z[1]))]), ground(1, 0)[1]


def person(distance: float, height: float, seed: int = 0):
    vertices, faces = body(np.random.default_rng(seed))
    quad = ground(1.0, 0)
    return join((vertices + [distance, 0.2, 0.9 - height], faces), (quad[0] + [distance, 0, -height], quad[1]))


@pytest.mark.parametrize("name, sub_beams", [("vlp-16", 3), ("pandar64", 2), ("os1-64", 5)])
def test_divergent_scan_equals_reference(name, sub_beams):
    s = sensor(name)
    vertices, faces = person(7.0, s.height)
    got = scan(vertices, faces, s, divergence=0.006, sub_beams=sub_beams, pulse=0.4)
    beams = window_rays(got, s).reshape(-1, 3)
    pick = np.random.default_rng(0).permutation(len(beams))[:400]
    offsets, weights = footprint(0.006, sub_beams)
    azimuth, elevation = np.arctan2(beams[pick, 1], beams[pick, 0]), np.arcsin(beams[pick, 2])
    a = (azimuth[:, None, None] + offsets[:, None] + 0 * offsets).reshape(len(pick), -1)
    e = (elevation[:, None, None] + 0 * offsets[:, None] + offsets).reshape(len(pick), -1)
    rays = np.stack([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)], -1)
    distance, face = cast_ray_list_reference(vertices, faces, rays.reshape(-1, 3))
    want, want_face = merge_echoes_reference(
        distance.reshape(a.shape).astype(float), face.reshape(a.shape), weights.reshape(-1), pulse=0.4,
        range_max=s.range_max,
    )  # fmt: skip
    seen, seen_face = (image.reshape(-1)[pick] for image in window_ranges(got))
    hit = np.isfinite(want)
    assert np.array_equal(np.isfinite(seen), hit) and hit.sum() > 20
    assert np.abs(seen[hit] - want[hit]).max() < 1e-4 and (seen_face[hit] == want_face[hit]).mean() > 0.99


def test_one_sub_beam_equals_scan_without_divergence():
    s = sensor("pandar64")
    vertices, faces = person(6.0, s.height)
    want = scan(vertices, faces, s, margin=0.01)
    single = scan(vertices, faces, s, divergence=0.003, sub_beams=1)
    kept = np.isin(single.column + single.column0, want.column + want.column0)
    assert len(single.points) >= len(want.points)
    assert np.abs(single.points[kept][:50] - want.points[:50]).max() < 1e-5


def test_footprint_is_even_and_normalized():
    offsets, weights = footprint(0.003, 3)
    assert offsets == pytest.approx([-0.001, 0, 0.001]) and weights.sum() == pytest.approx(1)
    assert weights == pytest.approx(weights.T) and weights[1, 1] == weights.max()
    assert weights[0] == pytest.approx(weights[2])
    # a Gaussian that falls to 1/e^2 at half the divergence
    assert weights[1, 2] / weights[1, 1] == pytest.approx(np.exp(-2 * (0.001 / 0.0015) ** 2))


def test_divergence_widens_silhouettes_by_half_its_angle():
    s = replace(sensor("os1-128"), range_max=200.0)
    pole = wall(15.0, (-0.02, 0.02))
    thin, wide = scan(*pole, s, margin=0.01), scan(*pole, s, divergence=0.006, sub_beams=5)
    assert len(np.unique(thin.column)) == 1 and len(np.unique(wide.column)) == 3
    # points are on the axes of beams, at the range of the pole
    assert 0.02 < np.abs(wide.points[:, 1]).max() < 0.02 + 15 * 0.003
    assert wide.points[:, 0] == pytest.approx(15.0, abs=0.01)


@pytest.mark.parametrize("gap, mixed", [(0.5, True), (2.0, False)])
def test_edges_mix_surfaces_within_pulse_length(gap, mixed):
    s = sensor("os1-128")
    vertices, faces = join(wall(10.0, (-0.5, 0.003)), wall(10.0 + gap, (-0.5, 0.5)))
    x = scan(vertices, faces, s, divergence=0.003, sub_beams=5).points[:, 0]
    between = (x > 10.02) & (x < 10 + gap - 0.02)
    assert between.any() == mixed and (x < 10.01).any() and (x > 10 + gap - 0.01).any()
    # rays without divergence mix nothing
    x = scan(vertices, faces, s).points[:, 0]
    assert not ((x > 10.02) & (x < 10 + gap - 0.02)).any()


def test_strongest_echo_wins_and_faint_echoes_are_lost():
    def echo(distance, weights, farthest=np.inf):
        distance = np.array(distance)
        return strongest_echo(distance, np.array(weights), np.empty(len(distance), np.int64), 0.75, farthest)

    # a thread at 10 m in front of a wall at 20 m, by its share of the power; the index is that of the nearest surface
    for share in (0.1, 0.3):
        thread_wins = share / 10**2 > (1 - share) / 20**2
        assert echo([20.0, 10.0], [1 - share, share]) == ((10.0, 1) if thread_wins else (20.0, 0))
    # alone, its share of the power determines its maximum range
    for farthest, seen in ((10 / np.sqrt(0.2) + 0.1, True), (10 / np.sqrt(0.2) - 0.1, False)):
        assert (echo([np.inf, 10.0], [0.8, 0.2], farthest)[1] >= 0) == seen
    # surfaces in steps below the pulse length give one echo, at the mean range weighted by received power
    distance, nearest = echo([10.6, 10.0, 11.2], [0.5, 0.25, 0.25])
    power = np.array([0.5, 0.25, 0.25]) / np.square([10.6, 10.0, 11.2])
    assert nearest == 1 and distance == pytest.approx((power * [10.6, 10.0, 11.2]).sum() / power.sum())
    assert echo([np.inf, np.inf], [0.5, 0.5]) == (np.inf, -1)


# --- sensors with several origins

AV2 = sensor("av2")


def box_at(azimuth):
    place = np.array([7 * np.cos(azimuth), 7 * np.sin(azimuth), -1.9])
    return box((0.4, 0.6, 1.7)).moved(place, 0.3)


@pytest.mark.parametrize("azimuth", [0.7, np.pi, -3.1])
def test_scan_beams_start_at_own_origin(azimuth):
    body = box_at(azimuth)
    hits = scan(body.vertices, body.faces, AV2)
    assert len(hits.points) > 150
    heights = AV2.origin_heights[hits.ring]
    assert set(heights) == {0.0, -0.11}
    beams = hits.points.astype(float) - np.stack([0 * heights, 0 * heights, heights], -1)
    np.testing.assert_allclose(
        np.arctan2(beams[:, 2], np.hypot(beams[:, 0], beams[:, 1])), AV2.elevations[hits.ring], atol=1e-6
    )
    azimuths = -np.pi + (hits.column + hits.column0) * AV2.azimuth_step + AV2.azimuth_shifts[hits.ring]
    away = np.arctan2(beams[:, 1], beams[:, 0]) - azimuths
    np.testing.assert_allclose(np.mod(away + np.pi, 2 * np.pi), np.pi, atol=1e-5)
    # the reference, one origin at a time
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


@pytest.mark.parametrize("azimuth", [0.7, np.pi])
def test_scan_window_of_each_origin_holds_body(azimuth):
    body = box_at(azimuth)
    # points along the edges, since the window is that of vertices
    share = np.linspace(0, 1, 40)[:, None, None]
    corners = body.vertices[body.faces]
    edges = (corners + share[:, :, None] * (np.roll(corners, 1, 1) - corners)).reshape(-1, 3)
    own = scan(body.vertices, body.faces, AV2, window_vertices=edges)
    wide = scan(body.vertices, body.faces, AV2, window_vertices=edges, margin=0.1)
    np.testing.assert_array_equal(own.points, wide.points)
    np.testing.assert_array_equal((own.column + own.column0) % AV2.columns, (wide.column + wide.column0) % AV2.columns)
    assert own.rows < wide.rows and own.columns < wide.columns


def test_scan_columns_match_azimuths_for_several_origins():
    body, step = box_at(1.1), np.array([0.3, -0.3, 0.0])
    both = np.concatenate([body.vertices, body.vertices + step])
    hits = scan(body.vertices, body.faces, AV2, window_vertices=both, moved=body.vertices + step)
    azimuths = -np.pi + (hits.column + hits.column0) * AV2.azimuth_step + AV2.azimuth_shifts[hits.ring]
    np.testing.assert_allclose(np.arctan2(hits.points[:, 1], hits.points[:, 0]), azimuths, atol=1e-5)
    # windows of the two origins start in different columns, in either order
    body = box_at(2.0)
    for first in (-1, 1):
        offsets = 0.4 * first * np.sign(AV2.ring_lags - 0.1) * AV2.azimuth_step
        apart = replace(AV2, azimuth_offsets=offsets)
        hits = scan(body.vertices, body.faces, apart)
        azimuths = -np.pi + (hits.column + hits.column0) * apart.azimuth_step + apart.azimuth_shifts[hits.ring]
        np.testing.assert_allclose(np.arctan2(hits.points[:, 1], hits.points[:, 0]), azimuths, atol=1e-5)
        assert hits.column.min() >= 0


def test_scan_with_equal_origins_equals_single_origin():
    body = box_at(1.1)
    together = scan(body.vertices, body.faces, replace(AV2, origin_heights=None))
    apart = scan(body.vertices, body.faces, replace(AV2, origin_heights=np.zeros(64)))
    np.testing.assert_array_equal(apart.ring, together.ring)
    np.testing.assert_allclose(apart.points, together.points, atol=1e-6)


def test_scan_rings_with_lag_hit_moved_mesh():
    body, step = box_at(1.1), np.array([0.0, 0.3, 0.0])
    both = np.concatenate([body.vertices, body.vertices + step])
    hits = scan(body.vertices, body.faces, AV2, window_vertices=both, moved=body.vertices + step)
    for way, lag in ((0.0, 0.0), (1.0, 0.5)):
        still = scan(body.vertices + way * step, body.faces, AV2, window_vertices=both)
        own, there = AV2.ring_lags[hits.ring] == lag, AV2.ring_lags[still.ring] == lag
        np.testing.assert_array_equal(hits.ring[own], still.ring[there])
        np.testing.assert_allclose(hits.points[own], still.points[there], atol=1e-5)
        assert own.sum() > 80


def test_scan_rings_can_lag_at_one_origin():
    body = box_at(1.1)
    flat = replace(AV2, origin_heights=None)
    assert [share for _, share, _, _ in flat.origins] == [0.0, 1.0] and flat.lag == 0.5
    assert sum(len(rings) for _, _, _, rings in flat.origins) == flat.rows
    with pytest.raises(InputError, match="moved must have the shape of the vertices"):
        scan(body.vertices, body.faces, flat, moved=np.zeros((3, 3)))


def test_divergent_scan_of_several_origins_adds_few_points():
    body = box_at(1.1)
    lines, wide = scan(body.vertices, body.faces, AV2), scan(body.vertices, body.faces, AV2, divergence=0.003)
    assert len(lines.points) < len(wide.points) < 1.2 * len(lines.points)
    far = body.moved(np.array([0, 0, 500.0]))
    assert len(scan(far.vertices, far.faces, AV2).points) == 0
