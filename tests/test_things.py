"""Shapes of things: sizes, closedness, and that beams pass where they should."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidarpose.lidar.raycast import cast_rays
from lidarpose.synth.environment import obstacles
from lidarpose.synth.environment.mesh import box, boxes, cone, loft, prism, quad, union

RNG = np.random.default_rng

# name -> mesh, its extent in x, y, z (None: not given by its arguments)
SIZED = {
    "pole": (obstacles.pole(0.1, 3.0), (None, None, 3.0)),
    "wheeled_bin": (obstacles.wheeled_bin(0.6, 1.1), (0.6, 0.6, 1.1)),
    "wall": (obstacles.wall(3.0, 2.5, thick=0.2), (0.2, 3.0, 2.5)),
    "wall with a window": (obstacles.wall(3.0, 2.5, opening=(-0.5, 0.7, 0.9, 2.0)), (0.2, 3.0, 2.5)),
    "wall with a door": (obstacles.wall(3.0, 2.5, opening=(-0.5, 0.7, 0.0, 2.0)), (0.2, 3.0, 2.5)),
    "bench": (obstacles.bench(1.6), (None, 1.6, 0.86)),
    "bench without a back": (obstacles.bench(1.6, back=False), (0.42, 1.6, 0.46)),
    "table": (obstacles.table(0.8, 1.4, 0.75), (0.8, 1.4, 0.75)),
    "sign": (obstacles.sign(2.2, 0.6), (None, 0.6, 2.2)),
    "traffic_cone": (obstacles.traffic_cone(0.7), (0.35, 0.35, 0.7)),
    "car": (obstacles.car(4.3, 1.8, 1.5), (4.3, 1.8, 1.5)),
    "van": (obstacles.van(5.2, 2.0, 2.2), (5.2, 2.0, 2.2)),
    "bonnet": (obstacles.bonnet(1.7, 0.9, 1.0), (1.0, None, 0.9)),
    "rail_fence": (obstacles.rail_fence(3.0, 1.0, 3), (0.06, None, 1.0)),
    "lattice_fence": (obstacles.lattice_fence(2.4, 1.2, 0.12, 0.03), (0.0, 2.4, 1.2)),
    "foliage": (obstacles.foliage((0.8, 1.5, 1.2), 100, 0.1, RNG(0)), (None, None, None)),
    "grass": (obstacles.grass(0.6, 0.2, 60, RNG(0)), (None, None, None)),
}


@pytest.mark.parametrize("name", SIZED)
def test_things_stand_on_the_origin_and_have_their_size(name):
    mesh, extent = SIZED[name]
    assert mesh.vertices.dtype == np.float32 and mesh.faces.dtype == np.int32
    assert np.isfinite(mesh.vertices).all()
    assert mesh.faces.min() == 0 and mesh.faces.max() == len(mesh.vertices) - 1
    assert len(mesh.faces) <= 160
    assert mesh.vertices[:, 2].min() == pytest.approx(0, abs=0.02)
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    for axis, size in enumerate(extent):
        if size is not None:
            assert high[axis] - low[axis] == pytest.approx(size, rel=0.005, abs=1e-6)
    # over the origin, give or take
    assert (low[:2] <= 0.05).all() and (high[:2] >= -0.05).all()


def open_edges(mesh):
    """Edges that do not lie between two faces that run along it in opposite directions."""
    edges = [(a, b) for f in mesh.faces.tolist() for a, b in ((f[0], f[1]), (f[1], f[2]), (f[2], f[0]))]
    return [e for e in edges if edges.count(e) != 1 or (e[1], e[0]) not in edges]


def volume(mesh):
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(float) for k in range(3))
    return (np.cross(a, b) * c).sum() / 6


@pytest.mark.parametrize("name", ["wall", "wall with a window", "bench", "table", "car", "van", "bonnet", "rail_fence"])
def test_solid_things_are_closed_and_face_outwards(name):
    mesh = SIZED[name][0]
    assert open_edges(mesh) == []
    assert volume(mesh) > 0


def test_lofts_fill_their_cross_sections():
    wedge = loft(((0.0, 0.5, 0.5, 0.0, 1.0), (2.0, 0.5, 0.5, 0.0, 0.5)))
    assert open_edges(wedge) == []
    assert volume(wedge) == pytest.approx(1.5)


def test_boxes_and_prisms_join():
    two = boxes(np.array([[0, 0, 0], [3, 0, 1]]), np.array([[1, 1, 1], [1, 2, 3]]))
    assert volume(two) == pytest.approx(7) and open_edges(two) == []
    np.testing.assert_allclose(two.vertices.max(0), [3.5, 1, 4])
    assert volume(cone(0.5, 1.0, sides=40, top=0.0)) == pytest.approx(np.pi * 0.25 / 3, rel=0.01)


def test_what_is_built_once_is_not_changed_by_its_users():
    first = obstacles.car(4.0, 1.8, 1.5)
    moved = first.moved(np.array([1.0, 2, 3]), 0.4)
    moved.vertices[:] = 0
    first.vertices[:, 2] += 1
    np.testing.assert_allclose(obstacles.car(4.0, 1.8, 1.5).vertices[:, 2].min(), 0, atol=1e-6)
    pillar = prism(0.2, 1.0)
    union([pillar, quad(1.0, np.zeros(2))]).vertices[:] = 9
    assert prism(0.2, 1.0).vertices.max() == 1.0
    np.testing.assert_array_equal(box(np.ones(3)).faces, box(np.ones(3) * 2).faces)


def hit_share(mesh, distance=6.0):
    """Share of the beams within the extent of a thing at `distance` m that it returns."""
    there = mesh.moved(np.array([distance, 0, -0.5]))
    y, z = np.abs(mesh.vertices[:, 1]).max() * 0.95, mesh.vertices[:, 2].max()
    azimuth = np.linspace(-1, 1, 90) * np.arctan(y / distance)
    elevation = np.arctan((np.linspace(0.03, 0.97, 60) * z - 0.5) / distance)
    distances, _ = cast_rays(there.vertices, there.faces, azimuth, elevation)
    return np.isfinite(distances).mean()


def test_beams_pass_fences_and_leaves_and_no_wall():
    assert hit_share(obstacles.wall(2.0, 1.5)) > 0.97
    assert 0.1 < hit_share(obstacles.lattice_fence(2.4, 1.2, 0.12, 0.03)) < 0.5
    assert 0.05 < hit_share(obstacles.rail_fence(3.0, 1.0, 3)) < 0.4
    thin, thick = (hit_share(obstacles.foliage((0.8, 1.0, 1.0), n, 0.12, RNG(0))) for n in (40, 120))
    assert 0.15 < thin < thick < 0.9
    whole, holed = (
        hit_share(obstacles.wall(2.0, 2.0)),
        hit_share(obstacles.wall(2.0, 2.0, opening=(-0.5, 0.5, 0.5, 1.5))),
    )
    assert whole - holed == pytest.approx(0.25, abs=0.06)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 120), st.floats(0.3, 2), st.floats(0.02, 0.2))
def test_foliage_stays_about_its_ellipsoid(seed, leaves, size, leaf):
    mesh = obstacles.foliage((size, size / 2, 1.5 * size), leaves, leaf, RNG(seed))
    assert len(mesh.faces) == leaves
    beyond = np.abs(mesh.vertices - [0, 0, 0.75 * size]) - np.array([size, size / 2, 1.5 * size]) / 2
    assert beyond.max() < 4 * leaf and mesh.vertices[:, 2].min() >= 0


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 100), st.floats(0.1, 1), st.floats(0.02, 0.3))
def test_grass_stands_on_its_disc(seed, blades, radius, height):
    mesh = obstacles.grass(radius, height, blades, RNG(seed))
    assert len(mesh.faces) == blades
    assert np.hypot(*mesh.vertices[:, :2].T).max() < radius + 0.12
    assert 0 <= mesh.vertices[:, 2].min() and mesh.vertices[:, 2].max() <= height + 1e-6
