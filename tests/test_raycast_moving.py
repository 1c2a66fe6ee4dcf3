import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from raycast_meshes import assert_same, soup
from reference.raycast_reference import cast_ray_list_reference

from lidarpose.errors import InputError
from lidarpose.geometry import rotation_about
from lidarpose.lidar.raycast import cast_ray_list

TETRAHEDRON = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], float)
TETRAHEDRON_FACES = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])


@settings(deadline=None, max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), spread=st.floats(0.1, 10), size=st.floats(0.05, 5), speed=st.floats(0, 5))
def test_moving_soups_same_as_reference(seed, spread, size, speed):
    rng = np.random.default_rng(seed)
    vertices, faces = soup(rng, int(rng.integers(1, 30)), spread, size)
    moved, rays, time = vertices + rng.normal(0, speed, vertices.shape), rng.normal(size=(80, 3)), rng.random(80)
    got = cast_ray_list(vertices, faces, rays, moved=moved, time=time)
    assert_same(got, cast_ray_list_reference(vertices, faces, rays, moved=moved, time=time))


def test_each_ray_meets_the_mesh_of_its_own_time():
    rng = np.random.default_rng(0)
    vertices = TETRAHEDRON @ rotation_about("z", 0.3).T + [6, 0, 0]
    moved = TETRAHEDRON @ rotation_about("z", 0.6).T * 1.2 + [3, 2, 1]
    rays = rng.normal(0, 0.3, (600, 3)) + [1, 0.2, 0.1]
    time = rng.integers(0, 5, 600) / 4
    distance, face = cast_ray_list(vertices, TETRAHEDRON_FACES, rays, moved=moved, time=time)
    for t in np.unique(time):
        at = time == t
        still = cast_ray_list(vertices + t * (moved - vertices), TETRAHEDRON_FACES, rays[at])
        assert_same((distance[at], face[at]), still)
        assert (still[1] >= 0).sum() > 10
    # the ends do not see the same
    assert not np.array_equal(face >= 0, cast_ray_list(vertices, TETRAHEDRON_FACES, rays)[1] >= 0)


def test_no_motion_changes_nothing():
    rng = np.random.default_rng(1)
    vertices, rays, time = rng.normal(0, 3, (90, 3)), rng.normal(size=(500, 3)), rng.random(500)
    faces = rng.permutation(90).reshape(30, 3)
    still = cast_ray_list(vertices, faces, rays)
    for other in (cast_ray_list(vertices, faces, rays, time=time),
                  cast_ray_list(vertices, faces, rays, moved=vertices, time=time)):  # fmt: skip
        assert np.array_equal(other[0], still[0]) and np.array_equal(other[1], still[1])


def test_a_moving_closed_mesh_has_no_holes():
    # from inside, at any time, through vertices too
    vertices, moved = TETRAHEDRON * 2 + [0.1, 0, 0], TETRAHEDRON @ rotation_about("x", 0.7).T * 3 + [0.2, 0.1, -0.1]
    rng = np.random.default_rng(2)
    time = rng.random(20_000)
    rays = rng.normal(size=(20_000, 3))
    corner = rng.integers(0, 4, 2000)
    rays[:2000] = vertices[corner] + time[:2000, None] * (moved - vertices)[corner]
    assert (cast_ray_list(vertices, TETRAHEDRON_FACES, rays, moved=moved, time=time)[1] >= 0).all()


@pytest.mark.parametrize(
    "motion, message",
    [
        ({"moved": TETRAHEDRON}, "need the rays' times"),
        ({"moved": TETRAHEDRON[:3], "time": [0.5]}, r"moved must hold the vertices once more, \(4, 3\), got \(3, 3\)"),
        ({"moved": TETRAHEDRON * np.nan, "time": [0.5]}, "moved must be finite"),
        ({"moved": TETRAHEDRON, "time": [0.5, 0.6]}, r"time must be \(1,\), one a ray, got \(2,\)"),
        ({"moved": TETRAHEDRON, "time": [1.5]}, "time must be within 0 and 1, .* got 1.5 for ray 0"),
        ({"time": [np.nan]}, "time must be within 0 and 1"),
        ({"time": "now"}, "time must be"),
    ],
)
def test_bad_motion_says_what_is_wrong(motion, message):
    with pytest.raises(InputError, match=message):
        cast_ray_list(TETRAHEDRON, TETRAHEDRON_FACES, [[1.0, 0, 0]], **motion)
