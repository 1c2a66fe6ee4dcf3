from dataclasses import fields, replace

import numpy as np
import pytest
from raycast_meshes import body, ground, join, soup

from lidarpose.errors import InputError
from lidarpose.lidar.beam_divergence import cast_wide_ray_list, footprint, scan_wide, spread
from lidarpose.lidar.presets import sensor
from lidarpose.lidar.raycast import Hits, cast_ray_list, scan
from lidarpose.lidar.raycast_reference import cast_ray_list_reference, merge_echoes_reference
from lidarpose.lidar.sensor import Window


def wall(x: float, y: tuple[float, float], z: tuple[float, float] = (-3, 3)):
    """A rectangle that faces the sensor at x m."""
    return np.array([[x, b, c] for b, c in ((y[0], z[0]), (y[1], z[0]), (y[1], z[1]), (y[0], z[1]))]), ground(1, 0)[1]


def person(distance: float, height: float, seed: int = 0):
    vertices, faces = body(np.random.default_rng(seed))
    quad = ground(1.0, 0)
    return join((vertices + [distance, 0.2, 0.9 - height], faces), (quad[0] + [distance, 0, -height], quad[1]))


@pytest.mark.parametrize("name, sub_beams", [("vlp-16", 3), ("pandar64", 2), ("os1-64", 5)])
def test_same_as_reference(name, sub_beams):
    s = sensor(name)
    vertices, faces = person(7.0, s.height)
    got = scan_wide(vertices, faces, s, divergence=0.006, sub_beams=sub_beams, pulse=0.4)
    window = Window(column0=got.column0, columns=got.columns, row0=got.row0, rows=got.rows)
    azimuth = s.azimuths(window)
    elevation = np.broadcast_to(s.elevations[window.row0 : window.row0 + window.rows], azimuth.shape)
    pick = np.random.default_rng(0).permutation(azimuth.size)[:400]
    offsets, weights = footprint(0.006, sub_beams)
    a = (azimuth.reshape(-1)[pick, None, None] + offsets[:, None] + 0 * offsets).reshape(len(pick), -1)
    e = (elevation.reshape(-1)[pick, None, None] + 0 * offsets[:, None] + offsets).reshape(len(pick), -1)
    rays = np.stack([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)], -1)
    distance, face = cast_ray_list_reference(vertices, faces, rays.reshape(-1, 3))
    want, want_face = merge_echoes_reference(
        distance.reshape(a.shape).astype(float), face.reshape(a.shape), weights.reshape(-1), pulse=0.4,
        range_max=s.range_max,
    )  # fmt: skip
    seen, seen_face = np.full(azimuth.shape, np.inf), np.full(azimuth.shape, -1)
    seen[got.column, got.ring - got.row0] = np.linalg.norm(got.points, axis=1)
    seen_face[got.column, got.ring - got.row0] = got.face
    seen, seen_face = seen.reshape(-1)[pick], seen_face.reshape(-1)[pick]
    hit = np.isfinite(want)
    assert np.array_equal(np.isfinite(seen), hit) and hit.sum() > 20
    assert np.abs(seen[hit] - want[hit]).max() < 1e-4 and (seen_face[hit] == want_face[hit]).mean() > 0.99


@pytest.mark.parametrize("sub_beams", [1, 4])
def test_wide_rays_same_as_reference(sub_beams):
    rng = np.random.default_rng(1)
    vertices, faces = soup(rng, 40, 3.0, 0.5)
    moved, rays, time = vertices + rng.normal(0, 0.3, vertices.shape), rng.normal(size=(300, 3)), rng.random(300)
    rays[:2] = [[0, 0, 1], [0, 0, -2]]
    got = cast_wide_ray_list(
        vertices, faces, rays, divergence=0.05, sub_beams=sub_beams, range_max=9, moved=moved, time=time
    )
    offsets, weights = footprint(0.05, sub_beams)
    many = spread(rays, offsets)
    late = np.repeat(time, many.shape[1])
    distance, face = cast_ray_list_reference(vertices, faces, many.reshape(-1, 3), moved=moved, time=late)
    want = merge_echoes_reference(
        distance.reshape(300, -1).astype(float), face.reshape(300, -1), weights.reshape(-1), pulse=0.75, range_max=9
    )
    assert np.array_equal(got[1], want[1]) and (got[1] >= 0).any() and (got[1] < 0).any()
    assert got[0][got[1] >= 0] == pytest.approx(want[0][got[1] >= 0], abs=1e-4)


def test_no_divergence_is_the_plain_scan():
    s = sensor("pandar64")
    vertices, faces = person(6.0, s.height)
    got = scan_wide(vertices, faces, s, divergence=0.0, margin=0.01)
    want = scan(vertices, faces, s, margin=0.01)
    assert all(np.array_equal(getattr(got, f.name), getattr(want, f.name)) for f in fields(Hits))
    # one sub-beam is the beam's axis, but for the window
    one = scan_wide(vertices, faces, s, divergence=0.003, sub_beams=1, cull=np.arange(len(faces)) < len(faces) - 2)
    kept = np.isin(one.column + one.column0, want.column + want.column0)
    assert len(one.points) >= len(want.points) and np.abs(one.points[kept][:50] - want.points[:50]).max() < 1e-5
    rays = np.random.default_rng(0).normal(size=(50, 3))
    for a, b in zip(cast_wide_ray_list(vertices, faces, rays, divergence=0), cast_ray_list(vertices, faces, rays),
                    strict=True):  # fmt: skip
        assert np.array_equal(a, b)


def test_footprint_is_even_and_whole():
    offsets, weights = footprint(0.003, 3)
    assert offsets == pytest.approx([-0.001, 0, 0.001]) and weights.sum() == pytest.approx(1)
    assert (
        weights == pytest.approx(weights.T)
        and weights[1, 1] == weights.max()
        and weights[0] == pytest.approx(weights[2])
    )
    rays = spread(np.array([[1.0, 0, 0], [0, 0, 5.0], [3.0, 4.0, -1.0]]), offsets)
    angle = np.arctan2(np.linalg.norm(np.cross(rays, rays[:, 4:5]), axis=-1), (rays * rays[:, 4:5]).sum(-1))
    assert angle[:, [1, 3, 5, 7]] == pytest.approx(np.full((3, 4), 0.001), rel=1e-4)


def test_silhouettes_grow_by_half_the_divergence():
    s = replace(sensor("os1-128"), range_max=200.0)
    pole = wall(15.0, (-0.02, 0.02))
    thin, wide = scan(*pole, s, margin=0.01), scan_wide(*pole, s, divergence=0.006, sub_beams=5)
    assert len(np.unique(thin.column)) == 1 and len(np.unique(wide.column)) == 3
    # on the beams' axes, at the pole's range
    assert 0.02 < np.abs(wide.points[:, 1]).max() < 0.02 + 15 * 0.003 and wide.points[:, 0] == pytest.approx(
        15.0, abs=0.01
    )


@pytest.mark.parametrize("gap, mixed", [(0.5, True), (2.0, False)])
def test_edges_mix_what_the_pulse_cannot_tell_apart(gap, mixed):
    s = sensor("os1-128")
    vertices, faces = join(wall(10.0, (-0.5, 0.003)), wall(10.0 + gap, (-0.5, 0.5)))
    x = scan_wide(vertices, faces, s, divergence=0.003, sub_beams=5).points[:, 0]
    between = (x > 10.02) & (x < 10 + gap - 0.02)
    assert between.any() == mixed and (x < 10.01).any() and (x > 10 + gap - 0.01).any()
    # nothing is mixed by rays without width
    x = scan(vertices, faces, s).points[:, 0]
    assert not ((x > 10.02) & (x < 10 + gap - 0.02)).any()


def test_the_strongest_echo_wins_and_faint_ones_are_lost():
    ray = [[1.0, 0, 0]]
    # a thread covers a fifth of the beam, the wall behind the rest
    thread, behind = wall(10.0, (-0.003, 0.003)), wall(20.0, (-1, 1))
    wide = {"divergence": 0.003, "sub_beams": 15}
    distance, face = cast_wide_ray_list(*join(thread, behind), ray, **wide)
    power = np.exp(-2 * ((np.arange(15) - 7) * 0.2 / 1.5) ** 2)
    share = power[np.abs((np.arange(15) - 7) * 0.0002) <= 0.0003].sum() / power.sum()
    nearer_wins = share / 10**2 > (1 - share) / 20**2
    assert distance[0] == pytest.approx(10.0 if nearer_wins else 20.0, abs=1e-3) and face[0] // 2 == (not nearer_wins)
    # alone, it is seen as far as its share of the power reaches
    for range_max, seen in ((10 / np.sqrt(share) + 0.1, True), (10 / np.sqrt(share) - 0.1, False)):
        assert np.isfinite(cast_wide_ray_list(*thread, ray, range_max=range_max, **wide)[0][0]) == seen
    # the face is that of the echo's nearest surface
    tilted = join(wall(10.3, (-1, 1)), wall(10.0, (-0.001, 0.001)))
    assert cast_wide_ray_list(*tilted, ray, **wide)[1][0] >= 2


@pytest.mark.parametrize(
    "change, message",
    [
        ({"divergence": 3.0}, "divergence must be between 0 and 0.1 rad, got 3.0: is it in mrad"),
        ({"divergence": np.nan}, "divergence must be"),
        ({"sub_beams": 0}, "sub_beams must be a whole number from 1 to 15"),
        ({"sub_beams": 2.5}, "sub_beams must be"),
        ({"pulse": -1.0}, "pulse must be"),
        ({"margin": np.nan}, "margin must be"),
        ({"window_vertices": np.full((2, 3), np.nan)}, "window_vertices must be finite"),
    ],
)
def test_bad_widths_say_what_is_wrong(change, message):
    with pytest.raises(InputError, match=message):
        scan_wide(*wall(5.0, (-1, 1)), sensor("vlp-16"), **{"divergence": 0.003, **change})
    with pytest.raises(InputError, match="range_max"):
        cast_wide_ray_list(*wall(5.0, (-1, 1)), [[1.0, 0, 0]], divergence=0.003, range_max=-1)


@pytest.mark.parametrize("sub_beams", [2, 3])
def test_bad_wide_rays_are_counted_as_they_were_given(sub_beams):
    mesh, wide = wall(5.0, (-1, 1)), {"divergence": 0.003, "sub_beams": sub_beams}
    with pytest.raises(InputError, match="directions must be longer than 0, but number 1 is zero"):
        cast_wide_ray_list(*mesh, [[1.0, 0, 0], [0, 0, 0]], **wide)
    with pytest.raises(InputError, match=r"time must be \(1,\), one a ray, got \(2,\)"):
        cast_wide_ray_list(*mesh, [[1.0, 0, 0]], time=[0.0, 1.0], **wide)
