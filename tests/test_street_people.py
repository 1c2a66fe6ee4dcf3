"""People in streets: who passes by, whose parts points are, how boxes lie."""

from dataclasses import replace

import numpy as np
import pytest
from walkers import HEADINGS, goer

from lidarpose.lidar.presets import sensor
from lidarpose.sample import Box
from lidarpose.synth import street
from lidarpose.synth.environment.mesh import quad
from lidarpose.synth.street import Street, StreetFrame, _Walker, samples


def test_who_passes_by_does_what_people_do_in_streets(monkeypatch):
    kinds = iter(["sit", "cycle", "lie", "run", "walk"])
    monkeypatch.setattr(street, "draw_moving_body", lambda *given: replace(goer(), kinds=(next(kinds),) * 3))
    assert street._draw_pedestrian(4, np.random.default_rng(0)).kinds[0] == "run"


def test_a_rosette_goes_on_with_its_pattern_in_a_street():
    where = motionless_street()
    first, second = (where(frame).points for frame in (0, 1))
    assert first.shape != second.shape or np.abs(first - second).max() > 0.01


def motionless_street():
    actor = goer(still=True)
    walker = _Walker(body=actor, start=np.array([5.0, 0.0, -1.2]), yaw=0.0)
    still = quad(20.0, np.zeros(2)).moved((0, 0, -1.2))
    ring_error = np.zeros(256, np.float32)
    return lambda frame: street._scan_turn(
        sensor("livox-avia"), still, [walker], frame, ring_error, np.random.default_rng(0)
    )


def test_the_parts_of_a_street_s_sample_are_its_own_person_s():
    rng = np.random.default_rng(0)
    centers = np.array([[6.0, 0.0, -0.8], [6.0, 0.45, -0.8]])
    points = np.concatenate([c + rng.uniform(-0.2, 0.2, (40, 3)) for c in centers]).astype(np.float32)
    frame = StreetFrame(
        points=points, ring=np.zeros(80, np.int32), person=np.repeat([0, 1], 40).astype(np.int16),
        part=np.repeat([4, 9], 40).astype(np.uint8),
        boxes=tuple(Box(center=c, size=[0.8, 0.8, 1.0], yaw=0.0, id=k) for k, c in enumerate(centers)),
        joints=np.tile(centers[:, None], (1, 26, 1)).astype(np.float32),
    )  # fmt: skip
    found = samples(Street(frames=(frame,), sensor="os1-128", height=1.7), rng)
    assert len(found) == 2
    for (_, sample), own in zip(found, (4, 9), strict=True):
        assert set(sample.part) == {0, own}
        assert np.count_nonzero(sample.part) <= 40 < len(sample.part)


@pytest.mark.parametrize("frame", range(3))
def test_a_street_s_box_lies_along_its_person(frame):
    actor, yaw = goer(), 0.7
    walker = _Walker(body=actor, start=np.array([5.0, 2.0, -1.5]), yaw=yaw)
    vertices = walker.placed(actor.vertices[frame])
    found = walker.box(vertices, frame, 4)
    np.testing.assert_allclose(found.size, [0.4, 1.0, 1.8], atol=1e-4)
    assert found.id == 4 and found.contains(vertices).all() and found.contains(walker.placed(actor.joints[frame])).all()
    assert abs((found.yaw - yaw - HEADINGS[frame] + np.pi) % (2 * np.pi) - np.pi) < 1e-6
