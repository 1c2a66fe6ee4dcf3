"""Plain meshes: closed, outward, moved without touching their parts."""

import numpy as np
import pytest

from lidarpose.synth.environment.mesh import Mesh, box, prism, quad, union


def volume(mesh):
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(float) for k in range(3))
    return (np.cross(a, b) * c).sum() / 6


def test_a_box_is_closed_and_faces_outwards():
    mesh = box(np.array([2.0, 3.0, 4.0]))
    assert volume(mesh) == pytest.approx(24, rel=1e-6)
    np.testing.assert_allclose(mesh.vertices.min(0), [-1, -1.5, 0])
    edges = [tuple(sorted(e)) for f in mesh.faces.tolist() for e in ((f[0], f[1]), (f[1], f[2]), (f[2], f[0]))]
    assert all(edges.count(e) == 2 for e in set(edges))


def test_a_prism_stands_on_the_origin():
    mesh = prism(0.5, 2.0, sides=40)
    assert mesh.vertices[:, 2].min() == 0 and mesh.vertices[:, 2].max() == 2
    # open at the bottom, which lies in the plane of the origin and adds nothing to the integral
    assert volume(mesh) == pytest.approx(np.pi * 0.25 * 2, rel=0.01)


def test_meshes_move_and_join_without_touching_their_parts():
    a, b = quad(1.0, np.zeros(2)), box(np.ones(3))
    kept = a.vertices.copy()
    moved = a.moved(np.array([1.0, 2, 3]), np.pi / 2)
    np.testing.assert_allclose(moved.vertices[0], [1 + 1, 2 - 1, 3], atol=1e-6)
    both = union([moved, b])
    np.testing.assert_array_equal(both.faces[2:], b.faces + 4)
    np.testing.assert_array_equal(both.vertices[4:], b.vertices)
    np.testing.assert_array_equal(a.vertices, kept)
    assert isinstance(both, Mesh) and both.faces.dtype == np.int32
