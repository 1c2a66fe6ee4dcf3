"""Whole streets: who stands where, whose points are whose, and what a sample of them holds."""

import json

import numpy as np
import pytest

from lidarpose.errors import InputError
from lidarpose.lidar.presets import sensor
from lidarpose.skeleton import BODY26
from lidarpose.synth.street import samples, street

FRAMES = 4


@pytest.fixture(scope="module")
def scenes():
    return [street(7, index, frames=FRAMES) for index in range(6)]


def test_a_street_is_a_function_of_seed_and_index(scenes):
    again = street(7, 2, frames=FRAMES)
    for a, b in zip(scenes[2].frames, again.frames, strict=True):
        for name in ("points", "ring", "person", "part", "joints"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
        assert [box.id for box in a.boxes] == [box.id for box in b.boxes]
    other = street(8, 2, frames=1).frames[0]
    assert other.points.shape != again.frames[0].points.shape or (other.points != again.frames[0].points).any()


def test_frames_are_turns_of_the_sensor(scenes):
    device = sensor("os1-128")
    for scene in scenes:
        assert len(scene.frames) == FRAMES and scene.sensor == "os1-128"
        for frame in scene.frames:
            n, people = len(frame.points), len(frame.boxes)
            assert frame.points.dtype == np.float32 and frame.points.shape == (n, 3)
            assert np.isfinite(frame.points).all()
            assert frame.ring.shape == frame.person.shape == frame.part.shape == (n,)
            assert frame.joints.shape == (people, 26, 3)
            assert -1 <= frame.person.min() and frame.person.max() < people
            # houses and ground all around, but for dropout: more than a quarter of the beams come back
            assert 0.25 * device.columns * device.rows < n <= device.columns * device.rows
            # parts are people's and people are of parts
            np.testing.assert_array_equal(frame.part > 0, frame.person >= 0)
            # what a ring returned lies on its cone
            elevation = np.arctan2(frame.points[:, 2], np.hypot(*frame.points[:, :2].T))
            np.testing.assert_allclose(elevation, device.elevations[frame.ring], atol=2e-4)


def test_the_ground_is_below_the_sensor_and_people_stand_on_it(scenes):
    for scene in scenes:
        frame = scene.frames[0]
        assert frame.points[:, 2].min() == pytest.approx(-scene.height, abs=0.12)
        for box in frame.boxes:
            bottom = box.center[2] - box.size[2] / 2 + 0.05 + scene.height
            # on the road or on a kerb
            assert -0.02 < bottom < 0.18


def test_points_of_a_person_are_in_their_box_and_near_their_bones(scenes):
    seen = 0
    for scene in scenes:
        for frame in scene.frames:
            for track, box in enumerate(frame.boxes):
                own = frame.points[frame.person == track]
                assert box.id == track
                # range noise may carry a few out
                if len(own) > 10:
                    assert box.contains(own, margin=0.03).mean() > 0.98
                    nearest = np.linalg.norm(own[:, None] - frame.joints[track], axis=-1).min(1)
                    assert np.quantile(nearest, 0.95) < 0.4
                    seen += 1
                assert box.contains(frame.joints[track], margin=0.05).all()
                assert 0.5 < box.size[2] < 2.4
    assert seen > 30


def test_people_keep_apart_and_walk_on(scenes):
    moved = []
    for scene in scenes:
        pelvis = np.stack([frame.joints[:, 0] for frame in scene.frames])
        for frame in pelvis:
            gaps = np.linalg.norm(frame[:, None, :2] - frame[None, :, :2], axis=-1)
            assert (gaps[~np.eye(len(frame), dtype=bool)] > 0.7).all()
            assert (np.linalg.norm(frame[:, :2], axis=-1) > 1.4).all()
        step = np.linalg.norm(np.diff(pelvis, axis=0), axis=-1)
        # nobody jumps: 10 Hz
        assert step.max() < 0.7
        moved.append(step.mean())
    assert np.mean(moved) > 0.03


def test_how_many_people_is_asked_for():
    assert len(street(1, 0, people=(1, 1)).frames[0].boxes) == 1
    counts = {len(street(2, index, people=(2, 4)).frames[0].boxes) for index in range(8)}
    assert counts <= {2, 3, 4} and len(counts) > 1


def test_a_street_without_anybody_has_points_and_no_people(monkeypatch):
    monkeypatch.setattr("lidarpose.synth.street._PLACE_TRIES", 0)
    scene = street(3, 1)
    frame = scene.frames[0]
    assert len(frame.points) > 1000 and (frame.person == -1).all() and not frame.part.any()
    assert frame.joints.shape == (0, 26, 3) and frame.boxes == () and samples(scene, np.random.default_rng(0)) == []


def test_who_walks_for_long_may_leave_the_pavement():
    frames = street(4, 0, people=(2, 2), frames=60).frames
    assert len(frames) == 60 and len(frames[0].boxes) == 2


def test_samples_are_cropped_by_boxes_with_errors_and_know_their_track(scenes):
    found = samples(scenes[0], np.random.default_rng(3))
    assert found and len({(number, sample.box.id) for number, sample in found}) == len(found)
    for number, sample in found:
        frame = scenes[0].frames[number]
        truth = frame.boxes[sample.box.id]
        assert sample.frame_id == f"{number}/{truth.id}"
        assert sample.box.contains(sample.points).all()
        assert np.count_nonzero(sample.part) >= 15
        assert 0 < np.linalg.norm(sample.box.center - truth.center) < 0.5
        assert sample.pose.skeleton is BODY26
        np.testing.assert_array_equal(sample.pose.joints, frame.joints[truth.id])
        # all points of the scene within the crop, whoever they belong to
        assert len(sample.points) == sample.box.contains(frame.points).sum()
    again = samples(scenes[0], np.random.default_rng(3))
    np.testing.assert_array_equal(found[0][1].box.center, again[0][1].box.center)
    assert (samples(scenes[0], np.random.default_rng(4))[0][1].box.center != found[0][1].box.center).any()


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (dict(people=(0, 3)), "people must be"),
        (dict(people=(5, 3)), "people must be"),
        (dict(people=3), "people must be"),
        (dict(people=(1.5, 3)), "people must be"),
        (dict(frames=0), "frames must be a whole number of at least 1"),
        (dict(seed=-1), "seed must be a whole number"),
        (dict(index=0.5), "index must be a whole number"),
        (dict(sensor="os1-182"), "unknown sensor"),
    ],
)
def test_what_cannot_be_drawn_is_said_in_a_line(given, words):
    with pytest.raises(InputError, match=words) as caught:
        street(**{"seed": 1, "index": 0, **given})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["livox-mid360", "livox-avia", "vlp-16"])
def test_every_kind_of_sensor_sees_streets(name):
    seen = 0
    for index in range(3):
        for frame in street(9, index, sensor=name, frames=2).frames:
            assert np.isfinite(frame.points).all() and len(frame.points) > 1000
            seen += (frame.person >= 0).sum()
            for track, box in enumerate(frame.boxes):
                own = frame.points[frame.person == track]
                # a rosette smears who walks on
                assert len(own) == 0 or box.contains(own, margin=0.3).mean() > 0.95
    assert seen > 100


def test_a_sensor_of_any_number_of_rings_has_errors_of_centimetres(tmp_path):
    path = tmp_path / "many.json"
    path.write_text(json.dumps({"elevations_deg": np.linspace(-30, 30, 400).tolist(), "columns": 256}))
    frame = street(0, 0, sensor=str(path)).frames[0]
    assert frame.ring.max() > 256
    assert np.isfinite(frame.points).all() and np.abs(frame.points).max() < 300
    again = street(0, 0, sensor=str(path)).frames[0]
    np.testing.assert_array_equal(frame.points, again.points)


def test_a_street_before_a_tilted_sensor_is_level(tmp_path):
    path = tmp_path / "down.json"
    path.write_text(json.dumps({"elevations_deg": np.linspace(-20, 20, 32).tolist(), "columns": 512, "tilt_deg": 20}))
    scene = street(7, 1, sensor=str(path))
    assert scene.frames[0].points[:, 2].min() == pytest.approx(-scene.height, abs=0.15)
