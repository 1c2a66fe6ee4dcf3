"""Background of a fixed sensor: static surfaces are learned, people who move or leave are not."""

import numpy as np
import pytest

from lidarpose.inference.background import is_static, learn_background
from lidarpose.synth.street import street


@pytest.fixture(scope="module")
def recording():
    """Two seconds of a street."""
    return street(5, 3, sensor="os1-64", people=(4, 6), frames=20).frames


def test_learn_background_separates_static_and_moving_points(recording):
    background = learn_background([frame.points for frame in recording])
    moved = [np.linalg.norm(a.center - b.center) for a, b in zip(recording[0].boxes, recording[-1].boxes, strict=True)]
    movers = [k for k, way in enumerate(moved) if way > 0.5]
    assert len(movers) >= 3
    for frame in recording[::5]:
        static = is_static(frame.points.astype(float), background)
        assert static[frame.person < 0].mean() > 0.98
        for k in movers:
            assert (~static)[frame.person == k].mean() > 0.6, k


def test_learn_background_accepts_one_array():
    wall = np.random.default_rng(0).uniform((5, -3, 0), (5.01, 3, 3), (400, 3))
    with pytest.warns(UserWarning, match="learned from 1 scan, so people in them become background"):
        np.testing.assert_array_equal(learn_background(wall), learn_background([wall]))


def test_learn_background_excludes_person_who_leaves(monkeypatch):
    rng = np.random.default_rng(0)
    wall = rng.uniform((5, -3, 0), (5.01, 3, 3), (4000, 3))
    person = rng.uniform((3, 0, 0), (3.4, 0.4, 1.7), (400, 3))
    scans = [np.concatenate([wall + rng.normal(0, 0.02, wall.shape), person]) for _ in range(14)]
    scans += [wall + rng.normal(0, 0.02, wall.shape) for _ in range(6)]
    background = learn_background(scans)
    assert is_static(wall, background).all() and not is_static(person, background).any()
    assert is_static(person, learn_background(scans[:12])).all()
    # of many scans, a subset that spans the first to the last is used
    monkeypatch.setattr("lidarpose.inference.background._MOST_SCANS", 5)
    few = learn_background(scans[8:14] + scans[14:] * 3)
    assert is_static(wall, few).all() and not is_static(person, few).any()
    empty, map_origin = np.zeros((0, 3)), np.array([5e5, 5e6, 0])
    assert not len(learn_background([empty, wall])) and not is_static(wall, empty).any()
    # an empty first scan does not tell where the others are
    assert is_static(wall + map_origin, learn_background([empty, *[wall + map_origin] * 8])).all()
    assert not is_static(person + map_origin, learn_background([empty, *[wall + map_origin] * 8])).any()
    assert learn_background([empty] * 6).shape == (0, 3)


def test_learned_points_are_in_the_middle_of_static_ones():
    cube = np.random.default_rng(0).uniform(0, 1.2, (40_000, 3))
    background = learn_background([cube + [7.0, 3.0, -1.0]] * 5)
    np.testing.assert_allclose(background.mean(0), [7.6, 3.6, -0.4], atol=0.02)
