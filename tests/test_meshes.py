"""Meshes of scenes: closed surfaces, sizes, transforms with parts, and beams through openings."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scripts import load_script
from walkers import piece_volumes

from lidarpose.lidar.raycast import cast_rays
from lidarpose.synth.environment import mesh as shapes
from lidarpose.synth.environment.mesh import Mesh, box, boxes, quad, shape, shipped_meshes, union

RNG = np.random.default_rng

# name -> mesh, its extent in x, y, z (None: not given by its arguments)
SIZED = {
    "pole": (shape("pole", 0.1, 0.1, 3.0), (None, None, 3.0)),
    "wheeled bin": (shape("wheeled bin", 0.6, 0.6, 1.1), (0.6, 0.6, 1.1)),
    "wall": (shapes.wall(3.0, 2.5, thick=0.2), (0.2, 3.0, 2.5)),
    "wall with a window": (shapes.wall(3.0, 2.5, opening=(-0.5, 0.7, 0.9, 2.0)), (0.2, 3.0, 2.5)),
    "wall with a door": (shapes.wall(3.0, 2.5, opening=(-0.5, 0.7, 0.0, 2.0)), (0.2, 3.0, 2.5)),
    "bench": (shape("bench", 1.0, 1.6), (None, 1.6, 0.86)),
    "bench without back": (shape("bench without back", 1.0, 1.6), (0.42, 1.6, 0.46)),
    "table": (shape("table", 0.8, 1.4, 0.75), (0.8, 1.4, 0.75)),
    "sign": (shapes.sign(2.2, 0.6), (None, 0.6, 2.2)),
    "traffic cone": (shape("traffic cone", 0.7, 0.7, 0.7), (0.35, 0.35, 0.7)),
    "car": (shape("car", 4.3, 1.8, 1.5), (4.3, 1.8, 1.5)),
    "van": (shape("van", 5.2, 2.0, 2.2), (5.2, 2.0, 2.2)),
    "bonnet": (shape("bonnet", 1.0, 1.7, 0.9), (1.0, None, 0.9)),
    "rail fence": (shapes.rail_fence(3.0, 1.0, 3), (0.06, None, 1.0)),
    "lattice fence": (shapes.lattice_fence(2.4, 1.2, 0.12, 0.03), (0.0, 2.4, 1.2)),
    "foliage": (shapes.foliage((0.8, 1.5, 1.2), 100, 0.1, RNG(0)), (None, None, None)),
    "grass": (shapes.grass(0.6, 0.2, 60, RNG(0)), (None, None, None)),
}


# open at the bottom, like prisms, or made of single triangles
OPEN = {"pole", "wheeled bin", "sign", "traffic cone", "lattice fence", "foliage", "grass", "bench without back"}


@pytest.fixture(scope="module")
def maker():
    return load_script("tools/make_meshes.py")


@pytest.mark.parametrize("name", SIZED)
def test_shapes_stand_on_origin_and_have_given_size(name):
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
    # roughly above the origin
    assert (low[:2] <= 0.05).all() and (high[:2] >= -0.05).all()
    if name not in OPEN:
        assert open_edges(mesh) == [] and volume(mesh) > 0


def open_edges(mesh):
    """Edges that are not shared by exactly two faces in opposite directions."""
    edges = [(a, b) for f in mesh.faces.tolist() for a, b in ((f[0], f[1]), (f[1], f[2]), (f[2], f[0]))]
    return [e for e in edges if edges.count(e) != 1 or (e[1], e[0]) not in edges]


def volume(mesh):
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(float) for k in range(3))
    return (np.cross(a, b) * c).sum() / 6


@pytest.mark.parametrize("name", sorted(set(shipped_meshes()) - {"traffic cone", "pole", "sign post"}))
def test_shipped_meshes_are_closed_outward_and_have_few_faces(name):
    mesh = shipped_meshes()[name]
    assert open_edges(mesh) == [] and mesh.faces.max() == len(mesh.vertices) - 1
    assert min(piece_volumes(mesh)) > 0
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces].astype(float), 1, 0)
    assert len(mesh.faces) <= (300 if name in ("wheelchair", "bicycle") else 160)
    assert mesh.vertices.dtype == np.float32 and mesh.faces.dtype == np.int32
    # no faces of zero area
    assert np.linalg.norm(np.cross(b - a, c - a), axis=-1).min() > 1e-7


def test_shipped_meshes_match_make_meshes(maker):
    made, shipped = maker.meshes(), shipped_meshes()
    assert list(made) == list(shipped)
    for name, mesh in made.items():
        np.testing.assert_array_equal(mesh.faces, shipped[name].faces)
        # sines differ between machines
        np.testing.assert_allclose(mesh.vertices, shipped[name].vertices, atol=1e-6)


def test_box_loft_and_prism_have_expected_volume(maker):
    mesh = box(np.array([2.0, 3.0, 4.0]))
    assert volume(mesh) == pytest.approx(24, rel=1e-6) and open_edges(mesh) == []
    np.testing.assert_allclose(mesh.vertices.min(0), [-1, -1.5, 0])
    two = boxes(np.array([[0, 0, 0], [3, 0, 1]]), np.array([[1, 1, 1], [1, 2, 3]]))
    assert volume(two) == pytest.approx(7) and open_edges(two) == []
    np.testing.assert_allclose(two.vertices.max(0), [3.5, 1, 4])
    wedge = maker.loft((0.0, 0.5, 0.5, 0.0, 1.0), (2.0, 0.5, 0.5, 0.0, 0.5))
    assert open_edges(wedge) == [] and volume(wedge) == pytest.approx(1.5)
    # open at the bottom, which is in the plane of the origin and adds nothing to the volume
    for top, share in ((0.0, 1 / 3), (1.0, 1.0)):
        mesh = maker.prism(40, top=top).scaled((0.5, 0.5, 2.0))
        assert mesh.vertices[:, 2].min() == 0 and mesh.vertices[:, 2].max() == 2
        assert volume(mesh) == pytest.approx(share * np.pi * 0.25 * 2, rel=0.01)


def test_mesh_moved_and_union_keep_part_and_later():
    a, b = quad(1.0, np.zeros(2)), box(np.ones(3))
    before = a.vertices.copy()
    moved = a.moved(np.array([1.0, 2, 3]), np.pi / 2)
    np.testing.assert_allclose(moved.vertices[0], [1 + 1, 2 - 1, 3], atol=1e-6)
    both = union([moved, b])
    np.testing.assert_array_equal(both.faces[2:], b.faces + 4)
    np.testing.assert_array_equal(both.vertices[4:], b.vertices)
    np.testing.assert_array_equal(a.vertices, before)
    assert isinstance(both, Mesh) and both.faces.dtype == np.int32 and both.part is None and both.later is None
    person = Mesh(b.vertices, b.faces, part=np.full(12, 7, np.uint8), later=b.vertices + 1)
    both = union([person, a])
    np.testing.assert_array_equal(both.part, [7] * 12 + [0] * 2)
    np.testing.assert_array_equal(both.later, np.concatenate([person.vertices + 1, a.vertices]))
    np.testing.assert_array_equal(person.moved((1, 0, 0)).part, person.part)


def test_cached_meshes_are_not_changed_by_callers():
    first = shape("car", 4.0, 1.8, 1.5)
    first.moved(np.array([1.0, 2, 3]), 0.4).vertices[:] = 0
    first.vertices[:, 2] += 1
    np.testing.assert_allclose(shape("car", 4.0, 1.8, 1.5).vertices[:, 2].min(), 0, atol=1e-6)
    with pytest.raises(ValueError, match="read-only"):
        shipped_meshes()["car"].vertices[:] = 0
    union([shape("pole"), quad(1.0, np.zeros(2))]).vertices[:] = 9
    assert shape("pole").vertices.max() == 1.0
    np.testing.assert_array_equal(box(np.ones(3)).faces, box(np.ones(3) * 2).faces)


def hit_share(mesh, distance=6.0):
    """Share of the beams within the extent of a mesh at `distance` m that hit it."""
    there = mesh.moved(np.array([distance, 0, -0.5]))
    y, z = np.abs(mesh.vertices[:, 1]).max() * 0.95, mesh.vertices[:, 2].max()
    azimuth = np.linspace(-1, 1, 90) * np.arctan(y / distance)
    elevation = np.arctan((np.linspace(0.03, 0.97, 60) * z - 0.5) / distance)
    distances, _ = cast_rays(there.vertices, there.faces, azimuth, elevation)
    return np.isfinite(distances).mean()


def test_cast_rays_passes_fences_and_foliage_but_not_walls():
    assert hit_share(shapes.wall(2.0, 1.5)) > 0.97
    assert 0.1 < hit_share(shapes.lattice_fence(2.4, 1.2, 0.12, 0.03)) < 0.5
    assert 0.05 < hit_share(shapes.rail_fence(3.0, 1.0, 3)) < 0.4
    thin, thick = (hit_share(shapes.foliage((0.8, 1.0, 1.0), n, 0.12, RNG(0))) for n in (40, 120))
    assert 0.15 < thin < thick < 0.9
    whole, holed = (hit_share(shapes.wall(2.0, 2.0)), hit_share(shapes.wall(2.0, 2.0, opening=(-0.5, 0.5, 0.5, 1.5))))
    assert whole - holed == pytest.approx(0.25, abs=0.06)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 120), st.floats(0.3, 2), st.floats(0.02, 0.2))
def test_foliage_stays_near_its_ellipsoid(seed, leaves, size, leaf):
    mesh = shapes.foliage((size, size / 2, 1.5 * size), leaves, leaf, RNG(seed))
    assert len(mesh.faces) == leaves
    beyond = np.abs(mesh.vertices - [0, 0, 0.75 * size]) - np.array([size, size / 2, 1.5 * size]) / 2
    assert beyond.max() < 4 * leaf and mesh.vertices[:, 2].min() >= 0


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 100), st.floats(0.1, 1), st.floats(0.02, 0.3))
def test_grass_stays_on_its_disk(seed, blades, radius, height):
    mesh = shapes.grass(radius, height, blades, RNG(seed))
    assert len(mesh.faces) == blades
    assert np.hypot(*mesh.vertices[:, :2].T).max() < radius + 0.12
    assert 0 <= mesh.vertices[:, 2].min() and mesh.vertices[:, 2].max() <= height + 1e-6


def test_mesh_transforms_apply_to_later_vertices():
    vertices = np.random.default_rng(0).normal(size=(3, 3)).astype(np.float32)
    faces = np.array([[0, 1, 2]], np.int32)
    mesh, later = Mesh(vertices, faces, None, vertices + 1), Mesh(vertices + 1, faces)
    turn = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]
    for change in (
        lambda m: m.moved((1, 2, 3), 0.3),
        lambda m: m.moved((1, 2, 3)),
        lambda m: m.scaled((1, 2, 3)),
        lambda m: m.placed(turn, (4, 5, 6)),
    ):
        np.testing.assert_allclose(change(mesh).later, change(later).vertices, atol=1e-6)
        assert change(later).later is None
