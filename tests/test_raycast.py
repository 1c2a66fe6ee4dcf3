import concurrent.futures
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st
from raycast_meshes import assert_same, body, ground, join, soup, sphere
from reference.raycast_reference import (
    cast_ray_list_reference,
    cast_rays_reference,
    window_of,
    window_ranges,
    window_rays,
    window_reference,
)

from lidarpose.errors import InputError
from lidarpose.geometry import rotation_about
from lidarpose.lidar.presets import SENSORS, sensor
from lidarpose.lidar.raycast import cast_ray_list, cast_rays, scan, scan_pattern
from lidarpose.lidar.raycast_kernels import raster
from lidarpose.lidar.sensor import Sensor

PARITY = Path(__file__).parent / "parity" / "raycast.npz"
FULL_TURN = np.linspace(-np.pi, np.pi, 41)
# no beam in the horizontal plane, where the test meshes have edges
ALL_ELEVATIONS = np.linspace(-1.5, 1.5, 24)


SPINNING = [name for name, s in SENSORS.items() if isinstance(s, Sensor)]


@pytest.mark.long
@pytest.mark.parametrize("scene", range(6))
def test_cast_rays_matches_embree(scene):
    data = np.load(PARITY)
    vertices, azimuth, elevation = (data[f"{scene}_{name}"] for name in ("vertices", "azimuth", "elevation"))
    want = data[f"{scene}_range"], data[f"{scene}_face"]
    assert_same(cast_rays(vertices, data["faces"], azimuth, elevation), want)
    a, e = np.meshgrid(azimuth, elevation, indexing="ij")
    rays = np.stack([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)], -1).reshape(-1, 3)
    distance, face = cast_ray_list(vertices, data["faces"], rays)
    assert_same((distance.reshape(a.shape), face.reshape(a.shape)), want)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_raster_compiles_once_for_all_input_types(dtype):
    """All input types and functions share one compiled version; another one would take seconds."""
    vertices, faces = sphere()
    vertices = (vertices + [5.0, 0, 0]).astype(dtype)
    vertices.setflags(write=False)
    s = sensor("vlp-16")
    hits = scan(vertices, faces, s)
    assert len(hits.points) and len(scan(vertices, faces, s, divergence=0.003).points)
    cast_rays(vertices, faces, FULL_TURN, ALL_ELEVATIONS)
    assert len(raster.signatures) == 1


@pytest.mark.parametrize("name", [name for name in SPINNING if not SENSORS[name].origins])
@pytest.mark.parametrize("distance, azimuth", [(2.5, np.pi), (8.0, -np.pi + 1e-3), (20.0, 0.7)])
def test_scan_matches_reference(name, distance, azimuth):
    s = replace(sensor(name), range_min=0.0)
    rng = np.random.default_rng(3)
    person = body(rng)
    # rotated because the reference may miss rays along an edge
    person = person[0] @ rotation_about("z", 0.1234).T, person[1]
    there = np.array([np.cos(azimuth), np.sin(azimuth), 0]) * distance + [0, 0, 0.9 - s.height]
    vertices, faces = join((person[0] + there, person[1]), (ground(1.0, 0)[0] + there - [0, 0, 0.9], ground(1, 0)[1]))
    vertices = vertices.astype(np.float32)
    hits = scan(vertices, faces.astype(np.int32), s)
    assert window_of(hits) == window_reference(vertices, s)
    distances, face = window_ranges(hits)
    assert hits.points.dtype == np.float32 and (np.diff(hits.column * 1000 + hits.ring) > 0).all()
    rays = window_rays(hits, s)
    along = rays[hits.column, hits.ring - hits.row0] * np.linalg.norm(hits.points, axis=1, keepdims=True)
    np.testing.assert_allclose(hits.points, along, atol=1e-5)
    pick = rng.permutation(face.size)[:3000]
    want = cast_ray_list_reference(vertices, faces, rays.reshape(-1, 3)[pick])
    assert_same((distances.reshape(-1)[pick], face.reshape(-1)[pick]), want)
    if s.azimuth_offsets is None:
        azimuths = np.arctan2(rays[:, 0, 1], rays[:, 0, 0])
        grid = cast_rays(vertices, faces, azimuths, s.elevations[hits.row0 : hits.row0 + hits.rows])
        assert_same((distances, face), grid)
    if distance < 10:
        assert (face >= 0).sum() > 20


@pytest.mark.parametrize("name", [name for name in SPINNING if not SENSORS[name].origins])
def test_scan_window_matches_reference(name):
    s = sensor(name)
    for i in range(25):
        rng = np.random.default_rng(i)
        azimuth, distance = rng.uniform(-np.pi, np.pi), rng.choice([0.0, 0.8, 2.0, 5.0, 12.0, 25.0])
        there = [distance * np.cos(azimuth), distance * np.sin(azimuth), 0.9 - s.height]
        vertices, faces = body(rng)
        hits = scan(vertices + there, faces[:0], s, margin=0.001 * i)
        assert window_of(hits) == window_reference(vertices + there, s, margin=0.001 * i) and len(hits.face) == 0
    # -pi and +pi are one column; a body around the sensor gets all columns; a body above the sensor gets no rows
    behind = scan(np.array([[-1.0, -0.01, 0], [-1.0, 0.01, 0]]), faces[:0], s)
    assert behind.column0 + behind.columns > s.columns and behind.columns < 12
    assert scan(vertices, faces[:0], s).columns == s.columns
    assert scan(vertices + [1.0, 0, 90.0], faces[:0], s).rows == 0


@pytest.mark.parametrize(
    "mesh",
    [
        soup(np.random.default_rng(0), 60, 3.0, 1.0),
        soup(np.random.default_rng(1), 60, 0.5, 2.0),
        soup(np.random.default_rng(2), 200, 2.0, 0.2),
        soup(np.random.default_rng(3), 10, 0.1, 30.0),
        ground(30.0, -1.7),
        ground(30.0, 0.3),
        ground(2.0, -1.2, x=-6.0),
        join(ground(5.0, -1.0), body(np.random.default_rng(4))),
        sphere(6, radius=3.0),
    ],
    ids=["soup", "near", "small", "wide", "ground", "ceiling", "quad behind", "inside a body", "inside a sphere"],
)
def test_full_turn_matches_reference(mesh):
    # rotated randomly so that no beam runs along an edge
    turn = np.linalg.qr(np.random.default_rng(9).normal(size=(3, 3)))[0]
    for vertices in (mesh[0], mesh[0] @ turn + 1e-3):
        azimuth = FULL_TURN[:-1] + 0.0123
        want = cast_rays_reference(vertices, mesh[1], azimuth, ALL_ELEVATIONS)
        assert (want[1] >= 0).any()
        assert_same(cast_rays(vertices, mesh[1], azimuth, ALL_ELEVATIONS), want)
        rays = np.random.default_rng(5).normal(size=(800, 3))
        assert_same(cast_ray_list(vertices, mesh[1], rays), cast_ray_list_reference(vertices, mesh[1], rays))


@pytest.mark.long
@settings(deadline=None, max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1), spread=st.floats(0.05, 20), size=st.floats(0.01, 10), count=st.integers(1, 40),
    speed=st.floats(0, 5),
)  # fmt: skip
def test_random_triangles_match_reference(seed, spread, size, count, speed):
    rng = np.random.default_rng(seed)
    mesh = soup(rng, count, spread, size)
    azimuth, elevation = rng.uniform(-7, 7, 19), rng.uniform(-1.57, 1.57, 17)
    assert_same(cast_rays(*mesh, azimuth, elevation), cast_rays_reference(*mesh, azimuth, elevation))
    rays, time = rng.normal(size=(80, 3)), rng.random(80)
    still = cast_ray_list(*mesh, rays)
    assert_same(still, cast_ray_list_reference(*mesh, rays))
    for options in ({"time": time}, {"moved": mesh[0], "time": time}):
        for a, b in zip(cast_ray_list(*mesh, rays, **options), still, strict=True):
            np.testing.assert_array_equal(a, b)
    motion = {"moved": mesh[0] + rng.normal(0, speed, mesh[0].shape), "time": time}
    assert_same(cast_ray_list(*mesh, rays, **motion), cast_ray_list_reference(*mesh, rays, **motion))


COORDINATE = st.one_of(st.sampled_from([0.0, 1.0, -1.0, 1e-30, 5e-324, -5e-324]), st.floats(-1e3, 1e3, width=32))


@settings(deadline=None, max_examples=80)
@example(
    vertices=[(0.0, 1.0, 0.0), (0.0, 0.0, 5e-324), (1.0, 0.0, 0.0)],
    faces=[(0, 1, 2)],
    azimuth=[0.0],
    elevation=[3.8742073780626264e-22],
)  # triangle through the sensor
@given(
    vertices=st.lists(st.tuples(COORDINATE, COORDINATE, COORDINATE), min_size=3, max_size=8),
    faces=st.lists(st.tuples(*[st.integers(0, 7)] * 3), max_size=6),
    azimuth=st.lists(st.floats(-10, 10), max_size=5),
    elevation=st.lists(st.floats(-np.pi / 2, np.pi / 2), max_size=5),
)
def test_degenerate_meshes_give_valid_ranges_and_faces(vertices, faces, azimuth, elevation):
    faces = np.array(faces, int).reshape(-1, 3) % len(vertices)
    distance, face = cast_rays(np.array(vertices), faces, azimuth, elevation)
    assert distance.shape == face.shape == (len(azimuth), len(elevation))
    assert not np.isnan(distance).any() and (distance > 0).all()
    assert ((face >= 0) == np.isfinite(distance)).all() and (face < max(1, len(faces))).all()
    rays = [v for v in vertices if np.linalg.norm(v) > 0]
    distance, face = cast_ray_list(np.array(vertices), faces, np.array(rays).reshape(-1, 3))
    assert not np.isnan(distance).any() and (distance > 0).all() and ((face >= 0) == np.isfinite(distance)).all()


def test_closed_meshes_have_no_holes():
    vertices, faces = sphere(24)
    azimuth, elevation = np.linspace(-0.13, 0.13, 700), np.linspace(-0.13, 0.13, 600)
    # at 5 m, a sphere of radius 1 m has an angular radius of 0.2 rad: all beams hit, and below also beams on vertices
    for shift in ([5, 0, 0], [-5, 0, 0], [0.3, 4.9, 0.1]):
        turned = azimuth + np.arctan2(shift[1], shift[0])
        assert (cast_rays(vertices * 1.02 + shift, faces, turned, elevation)[1] >= 0).all()
    moved = vertices + [5, 0, 0]
    azimuth = np.unique(np.arctan2(moved[:, 1], moved[:, 0]))
    elevation = np.unique(np.arctan2(moved[:, 2], np.hypot(moved[:, 0], moved[:, 1])))
    _, face = cast_rays(moved, faces, azimuth[np.abs(azimuth) < 0.13], elevation[np.abs(elevation) < 0.13])
    assert (face >= 0).all() and face.size > 10_000


@pytest.mark.parametrize("shift", [(0, 0, 0), (0.3, 0.2, 0.1), (0.7, -0.6, 0.0)])
def test_closed_mesh_has_no_holes_from_inside(shift):
    vertices, faces = sphere(12)
    azimuth, elevation = np.linspace(-np.pi, np.pi, 700), np.linspace(-np.pi / 2, np.pi / 2, 301)
    distance, _ = cast_rays(vertices + shift, faces, azimuth, elevation)
    assert np.isfinite(distance).all() and distance.max() < 2.1
    # beam planes through edges and vertices
    azimuth = np.arctan2(vertices[:, 1] + shift[1], vertices[:, 0] + shift[0])
    assert np.isfinite(cast_rays(vertices + shift, faces, azimuth, elevation)[0]).all()
    directions = np.random.default_rng(0).normal(size=(20_000, 3))
    assert np.isfinite(cast_ray_list(vertices + shift, faces, directions)[0]).all()
    # rays through the vertices themselves
    assert np.isfinite(cast_ray_list(vertices + shift, faces, vertices + shift)[0]).all()


def test_moving_closed_mesh_has_no_holes():
    # rays from inside at random times, some of them through vertices
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    vertices, moved = corners * 2 + [0.1, 0, 0], corners @ rotation_about("x", 0.7).T * 3 + [0.2, 0.1, -0.1]
    rng = np.random.default_rng(2)
    time = rng.random(20_000)
    rays = rng.normal(size=(20_000, 3))
    corner = rng.integers(0, 4, 2000)
    rays[:2000] = vertices[corner] + time[:2000, None] * (moved - vertices)[corner]
    assert (cast_ray_list(vertices, faces, rays, moved=moved, time=time)[1] >= 0).all()


def test_cast_rays_accepts_angles_in_any_order():
    rng = np.random.default_rng(1)
    vertices, faces = soup(rng, 50, 3, 1)
    azimuth, elevation = FULL_TURN[:-1] + 0.01, ALL_ELEVATIONS
    a, e = rng.permutation(len(azimuth)), rng.permutation(len(elevation))
    distance, face = cast_rays(vertices, faces, azimuth, elevation)
    again, face_again = cast_rays(vertices, faces, azimuth[a] + 2 * np.pi * rng.integers(-2, 3, len(a)), elevation[e])
    assert (face_again == face[a][:, e]).all() and (face >= 0).any()
    assert again[face_again >= 0] == pytest.approx(distance[a][:, e][face_again >= 0], abs=1e-5)
    twice, _ = cast_rays(vertices, faces, np.repeat(azimuth, 2), np.repeat(elevation, 3))
    assert (twice == np.repeat(np.repeat(distance, 2, 0), 3, 1)).all()


def test_empty_input_gives_empty_output():
    vertices, faces = ground(1, -1)
    none = np.zeros((0, 3))
    assert cast_rays(vertices, faces, [], [0.1])[0].shape == (0, 1)
    assert cast_rays(vertices, faces, [0.1], [])[1].shape == (1, 0)
    for mesh in ((vertices, none.astype(int)), (none, none.astype(int))):
        assert np.isinf(cast_rays(*mesh, [0.0, 1.0], [0.0])[0]).all()
        assert cast_ray_list(*mesh, np.eye(3))[1].tolist() == [-1, -1, -1]
        assert len(scan(*mesh, sensor("vlp-16")).points) == 0
        assert len(scan_pattern(*mesh, sensor("livox-avia"), 0).points) == 0
    assert cast_ray_list(vertices, faces, none)[0].shape == (0,)


CORNERS, QUAD = ground(1, -1)
GRID = partial(cast_rays, azimuth=[0.1], elevation=[0.1])
RAYS = partial(cast_ray_list, directions=[[1.0, 0, 0]])
SCAN = partial(scan, sensor=sensor("vlp-16"))
WIDE = partial(scan, sensor=sensor("vlp-16"), divergence=0.003)


@pytest.mark.parametrize(
    "call, change, message",
    [
        (GRID, {"vertices": np.full((4, 3), np.nan)}, "vertices must be finite and below 1e.09 m, but 4 of 4"),
        (GRID, {"vertices": np.zeros((4, 2))}, r"vertices must be \(n, 3\)"),
        (GRID, {"vertices": "mesh.ply"}, "vertices must be an"),
        (GRID, {"faces": np.array([[0, 1, 4]])}, "faces must index the 4 vertices"),
        (GRID, {"faces": np.array([[0, -1, 2]])}, "faces must index the 4 vertices"),
        (GRID, {"faces": np.zeros((1, 4), int)}, r"faces must be \(F, 3\) integers"),
        (GRID, {"faces": np.zeros((1, 3))}, r"faces must be \(F, 3\) integers"),
        (GRID, {"azimuth": [np.inf]}, "azimuth must be a list of finite angles"),
        (GRID, {"azimuth": [[0.1]]}, "azimuth must be a list"),
        (GRID, {"azimuth": ["a"]}, "azimuth must be a list of finite angles in radians, got list"),
        (GRID, {"elevation": [-10.0, 10.0]}, "degrees"),
        (RAYS, {"directions": [[1, 0, 0], [0, 0, 0]]}, "number 1 is zero"),
        (RAYS, {"moved": CORNERS}, "need the rays' times"),
        (RAYS, {"moved": CORNERS[:3], "time": [0.5]}, r"have the shape of the vertices, \(4, 3\), got \(3, 3\)"),
        (RAYS, {"moved": CORNERS * np.nan, "time": [0.5]}, "moved must be finite"),
        (RAYS, {"moved": CORNERS, "time": [0.5, 0.6]}, r"time must be \(1,\), one per ray, got \(2,\)"),
        (RAYS, {"moved": CORNERS, "time": [1.5]}, "time must be within 0 and 1, .* got 1.5 for ray 0"),
        (RAYS, {"time": [np.nan]}, "time must be within 0 and 1"),
        (RAYS, {"time": "now"}, "time must be"),
        (SCAN, {"margin": np.nan}, "margin must be a finite angle"),
        (SCAN, {"vertices": CORNERS * [1, np.nan, 1]}, "vertices must be finite and below .* but 4 of 4"),
        (SCAN, {"window_vertices": np.full((2, 3), np.inf)}, "window_vertices must be finite"),
        (SCAN, {"faces": np.array([[0, 1, 10_000]], np.int32)}, "faces must index the 4 vertices .* 0 to 10000"),
        (SCAN, {"faces": np.array([[0, 1, -1]])}, "faces must index the 4 vertices from 0, got -1 to 1"),
        (WIDE, {"divergence": 3.0}, "divergence must be between 0 and 0.1 rad, got 3.0: is it in mrad"),
        (WIDE, {"divergence": np.nan}, "divergence must be"),
        (WIDE, {"sub_beams": 0}, "sub_beams must be a whole number from 1 to 15"),
        (WIDE, {"sub_beams": 2.5}, "sub_beams must be"),
        (WIDE, {"pulse": -1.0}, "pulse must be"),
    ],
)
def test_raycast_rejects_invalid_input(call, change, message):
    with pytest.raises(InputError, match=message):
        call(**{"vertices": CORNERS, "faces": QUAD, **change})


def test_wider_scan_window_adds_no_body_points():
    s = sensor("vlp-32c")
    person = body(np.random.default_rng(5))
    vertices = person[0] + [4, 3, -0.8]
    tight, wide = scan(vertices, person[1], s), scan(vertices, person[1], s, margin=0.2)
    # a wall behind the person does not widen the window
    room = join((vertices, person[1]), ground(5.0, -1.5))
    assert window_of(scan(*room, s, window_vertices=vertices)) == window_of(tight)
    assert len(tight.points) == len(wide.points) and wide.columns > tight.columns and wide.rows >= tight.rows
    assert (tight.points == wide.points).mean() > 0.5 and np.abs(tight.points - wide.points).max() < 1e-5


def test_scan_applies_range_limits_and_occlusion():
    far, near = ground(1.0, 0), ground(1.0, 0)
    up = np.array([[0, 0, 1], [0, 1, 0], [1, 0, 0]])
    vertices, faces = join((far[0] @ up + [10, 0, 0], far[1]), (near[0] @ up * 0.2 + [3, 0, 0], near[1]))
    s = replace(sensor("vlp-16"), range_max=9.0)
    assert set(scan(vertices, faces, sensor("vlp-16")).face) == {0, 1, 2, 3}
    only = scan(vertices, faces, s)
    assert set(only.face) == {2, 3} and np.linalg.norm(only.points, axis=1).max() < 3.1
    # the near surface is closer than range_min and still occludes the far one
    assert len(scan(vertices, faces, replace(s, range_min=4.0, range_max=20.0)).points) + len(only.points) == len(
        scan(vertices, faces, sensor("vlp-16")).points
    )


def test_scan_keeps_input_and_is_thread_safe():
    s = sensor("os1-128")
    vertices, faces = join(body(np.random.default_rng(6)), ground(2, -0.9))
    vertices = (vertices + [5, 1, -0.5]).astype(np.float32)
    kept = vertices.copy()
    first = scan(vertices, faces, s)
    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        for other in pool.map(lambda _: scan(vertices, faces, s), range(16)):
            assert (other.points == first.points).all() and (other.face == first.face).all()
    assert (vertices == kept).all()


def test_scan_inside_sphere_fills_full_window():
    vertices, faces = sphere(8, radius=4.0)
    s = Sensor(name="coarse", elevations=np.linspace(-1.2, 1.2, 30), azimuth_step=2 * np.pi / 360)
    hits = scan(vertices, faces, s)
    assert (hits.columns, hits.rows, len(hits.points)) == (360, 30, 360 * 30)
    radius = np.linalg.norm(hits.points, axis=1)
    assert 3.8 < radius.min() and radius.max() < 4.01
