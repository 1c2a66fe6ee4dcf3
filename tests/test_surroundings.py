"""Random surroundings of a person: positions and frequency of objects, occlusion, and the ground."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from lidarpose.lidar.raycast import cast_rays
from lidarpose.synth.environment.mesh import shape, union
from lidarpose.synth.environment.surroundings import ground, occluder, surroundings
from lidarpose.synth.scene import SCENES

RNG = np.random.default_rng
FEET = np.array([8.0, 3.0, -1.5])
ALWAYS = replace(SCENES["wild"], clutter=1.0, occluder=1.0)
places = st.tuples(st.floats(1.5, 40), st.floats(-np.pi, np.pi), st.floats(0.4, 3))


def feet_at(place):
    distance, azimuth, height = place
    return np.array([distance * np.cos(azimuth), distance * np.sin(azimuth), -height])


def test_difficulty_zero_has_no_surroundings():
    easy, rng = SCENES["wild"].eased(0.0), RNG(2)
    assert all(occluder(easy, FEET, 1.7, rng) is None for _ in range(50))
    assert all(surroundings(easy, FEET, 0.4, rng) == [] for _ in range(50))
    assert all(len(ground(easy, FEET, rng).faces) == 2 for _ in range(50))
    # results depend only on the random generator
    for call in (lambda rng: ground(ALWAYS, FEET, rng), lambda rng: occluder(ALWAYS, FEET, 1.7, rng)):
        for seed in range(30):
            np.testing.assert_array_equal(call(RNG(seed)).vertices, call(RNG(seed)).vertices)
    assert len({len(surroundings(ALWAYS, FEET, 0.4, RNG(seed))) for seed in range(60)}) == 3


@pytest.mark.parametrize("hard", [0.5, 1.0])
def test_object_frequency_follows_config_and_difficulty(hard):
    wild, rng = SCENES["wild"].eased(hard), RNG(3)
    before = np.mean([occluder(wild, FEET, 1.7, rng) is not None for _ in range(1500)])
    assert before == pytest.approx(wild.occluder * hard, abs=0.04)
    beside = np.mean([len(surroundings(wild, FEET, 0.4, rng)) > 0 for _ in range(1500)])
    assert beside == pytest.approx(wild.clutter * hard, abs=0.05)


def gap_to(mesh, feet):
    """Horizontal distance from the feet to the nearest point of a mesh's triangles."""
    a, b, c = (mesh.vertices[mesh.faces[:, k], :2].astype(float) - feet[:2] for k in range(3))
    share = np.linspace(0, 1, 60)[:, None, None]
    return min(np.linalg.norm(u + share * (v - u), axis=-1).min() for u, v in ((a, b), (b, c), (c, a)))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), places, st.floats(0.3, 1.0))
def test_surroundings_stand_on_ground_near_person(seed, place, radius):
    feet = feet_at(place)
    for mesh in surroundings(ALWAYS, feet, radius, RNG(seed)):
        assert np.isfinite(mesh.vertices).all() and mesh.faces.max() < len(mesh.vertices)
        assert mesh.vertices[:, 2].min() >= feet[2] - 1e-4
        assert gap_to(mesh, feet) < radius + 0.9
        assert len(mesh.faces) <= 160


def test_most_objects_keep_distance_from_person():
    rng, gaps, kinds = RNG(5), [], set()
    for _ in range(300):
        for mesh in surroundings(ALWAYS, FEET, 0.4, rng):
            gaps.append(gap_to(mesh, FEET))
            kinds.add((len(mesh.vertices), len(mesh.faces)))
    # luggage touches the person; other objects keep a distance, except some that are shifted sideways
    assert np.mean(np.array(gaps) < 0.35) < 0.25
    assert np.mean(np.array(gaps) < 0.9) > 0.7
    assert len(kinds) > 15


@settings(max_examples=80, deadline=None)
@given(st.integers(0, 2**32 - 1), places, st.floats(0.9, 2.0))
def test_occluder_stands_between_sensor_and_person(seed, place, tall):
    feet = feet_at(place)
    mesh = occluder(ALWAYS, feet, tall, RNG(seed))
    ahead = mesh.vertices[:, :2] @ feet[:2] / (feet[:2] @ feet[:2])
    assert 0.0 < ahead.min() and ahead.max() < 1.35
    assert 0.3 < np.median(ahead) < 1.1
    # leaves are placed one by one, so the lowest leaf of a hedge may be above the ground
    leaves = len(mesh.vertices) == 3 * len(mesh.faces)
    assert -1e-5 < mesh.vertices[:, 2].min() - feet[2] < (0.5 if leaves else 1e-5)


def test_occluder_hides_part_of_person():
    rng, hidden = RNG(7), []
    for _ in range(200):
        feet = feet_at((rng.uniform(3, 20), rng.uniform(-3, 3), rng.uniform(0.5, 2)))
        person = shape("pole", 0.22, 0.22, 1.7).moved(feet)
        heading, wide = np.arctan2(feet[1], feet[0]), np.arctan(0.25 / np.hypot(*feet[:2]))
        azimuth = heading + np.linspace(-wide, wide, 24)
        elevation = np.linspace(*np.arctan((feet[2] + np.array([0, 1.7])) / np.hypot(*feet[:2])), 30)
        scene = union([person, occluder(ALWAYS, feet, 1.7, rng)])
        _, face = cast_rays(scene.vertices, scene.faces, azimuth, elevation)
        alone = (cast_rays(person.vertices, person.faces, azimuth, elevation)[1] >= 0).sum()
        hidden.append(1 - ((face >= 0) & (face < len(person.faces))).sum() / alone)
    hidden = np.array(hidden)
    assert np.mean(hidden < 0.05) < 0.25 and np.mean(hidden > 0.9) < 0.08
    assert 0.2 < np.median(hidden) < 0.55


# --- the ground


@pytest.mark.parametrize("name", ["paper", "reference"])
def test_paper_ground_is_a_tilted_square(name):
    rng, tilts = RNG(1), []
    for _ in range(500):
        corners = ground(SCENES[name], FEET, rng).vertices.astype(float) - FEET
        assert len(corners) == 4
        np.testing.assert_allclose(np.abs(corners[:, :2]), 1.0, atol=1e-5)
        np.testing.assert_allclose(corners.mean(0), 0, atol=1e-5)
        normal = np.cross(corners[1] - corners[0], corners[3] - corners[0])
        tilts.append(np.arccos(normal[2] / np.linalg.norm(normal)))
    # the absolute value of a normal distribution with a deviation of 5 degrees
    assert np.degrees(np.mean(tilts)) == pytest.approx(5 * np.sqrt(2 / np.pi), abs=0.4)


def height_at(mesh, at):
    """Height m of the mesh's highest point at (x, y), measured with a beam from above."""
    lifted = mesh.vertices - np.array([*at, mesh.vertices[:, 2].max() + 1], np.float32)
    distance, _ = cast_rays(lifted, mesh.faces, np.zeros(1), np.array([-np.pi / 2]))
    return float(mesh.vertices[:, 2].max() + 1 - distance[0, 0])


def test_wild_ground_has_all_kinds_at_height_of_feet():
    rng, sizes, heights = RNG(6), [], []
    for _ in range(300):
        mesh = ground(ALWAYS, FEET, rng)
        sizes.append(len(mesh.faces))
        heights.append(height_at(mesh, FEET[:2] + [1e-3, 2e-3]) - FEET[2])
        assert np.abs(mesh.vertices[:, :2] - FEET[:2]).max() < 3 * np.sqrt(2) + 0.2
        assert np.abs(mesh.vertices[:, 2] - FEET[2]).max() < 1.5
    sizes, heights = np.array(sizes), np.array(heights)
    kinds = {"flat": sizes == 2, "kerb": sizes == 6, "grass": (sizes > 40) & (sizes < 83), "rough": sizes > 90}
    shares = {name: kind.mean() for name, kind in kinds.items()}
    assert shares["kerb"] == pytest.approx(0.35, abs=0.09) and shares["rough"] == pytest.approx(0.45, abs=0.09)
    assert shares["grass"] == pytest.approx(0.15, abs=0.07) and shares["flat"] > 0
    # the ground is at the height of the feet; grass may be higher
    assert np.abs(heights[~kinds["grass"]]).max() < 0.08
    assert np.abs(heights).max() < 0.25


def test_occluder_hides_left_and_right_equally_often():
    feet, config, sides = np.array([8.0, 0.0, -1.5]), replace(SCENES["wild"], occluder=1.0), []
    for seed in range(300):
        middle = occluder(config, feet, 1.7, np.random.default_rng(seed)).vertices[:, 1]
        # the occluder covers one side only
        if middle.min() > -0.3 or middle.max() < 0.3:
            sides.append(middle.mean() > 0)
    assert len(sides) > 60 and 0.35 < np.mean(sides) < 0.65
