"""Synthesized streets: positions of people, labels of points, and samples of people."""

import json
from dataclasses import replace

import numpy as np
import pytest
from walkers import HEADINGS, goer, strider

from lidarpose.errors import InputError
from lidarpose.lidar.presets import sensor
from lidarpose.sample import Box
from lidarpose.skeleton import BODY26
from lidarpose.synth import street as module
from lidarpose.synth.environment.mesh import quad
from lidarpose.synth.place import Place
from lidarpose.synth.street import Street, StreetFrame, samples, street

FRAMES = 4
RNG = np.random.default_rng


@pytest.fixture(scope="module")
def scenes():
    return [street(7, index, frames=FRAMES) for index in range(6)]


def test_street_depends_only_on_seed_and_index(scenes):
    again = street(7, 2, frames=FRAMES)
    for a, b in zip(scenes[2].frames, again.frames, strict=True):
        for name in ("points", "ring", "person", "part", "joints"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
        assert [box.id for box in a.boxes] == [box.id for box in b.boxes]
    other = street(8, 2, frames=1).frames[0]
    assert other.points.shape != again.frames[0].points.shape or (other.points != again.frames[0].points).any()


def test_street_frames_are_full_turns_of_sensor(scenes):
    device = sensor("os1-128")
    for scene in scenes:
        assert len(scene.frames) == FRAMES and scene.sensor == "os1-128"
        for frame in scene.frames:
            n, people = len(frame.points), len(frame.boxes)
            assert frame.points.dtype == np.float32 and frame.points.shape == (n, 3)
            assert np.isfinite(frame.points).all() and frame.joints.shape == (people, 26, 3)
            assert frame.ring.shape == frame.person.shape == frame.part.shape == (n,)
            assert -1 <= frame.person.min() and frame.person.max() < people
            # houses and ground in all directions: despite dropout more than a quarter of the beams return
            assert 0.25 * device.columns * device.rows < n <= device.columns * device.rows
            # exactly the points of people have a body part
            np.testing.assert_array_equal(frame.part > 0, frame.person >= 0)
            # points of a ring lie on its cone
            elevation = np.arctan2(frame.points[:, 2], np.hypot(*frame.points[:, :2].T))
            np.testing.assert_allclose(elevation, device.elevations[frame.ring], atol=2e-4)
        frame = scene.frames[0]
        assert frame.points[:, 2].min() == pytest.approx(-scene.height, abs=0.12)
        # people stand on the road or on a curb
        bottoms = np.array([box.center[2] - box.size[2] / 2 + 0.05 + scene.height for box in frame.boxes])
        assert ((bottoms > -0.02) & (bottoms < 0.18)).all()


def test_person_points_are_in_box_and_near_joints(scenes):
    seen = 0
    for frame in (frame for scene in scenes for frame in scene.frames):
        for track, box in enumerate(frame.boxes):
            own = frame.points[frame.person == track]
            assert box.id == track and 0.5 < box.size[2] < 2.4
            assert box.contains(frame.joints[track], margin=0.05).all()
            # range noise may move a few points outside
            if len(own) > 10:
                assert box.contains(own, margin=0.03).mean() > 0.98
                nearest = np.linalg.norm(own[:, None] - frame.joints[track], axis=-1).min(1)
                assert np.quantile(nearest, 0.95) < 0.4
                seen += 1
    assert seen > 30


def test_people_keep_distance_and_walk_smoothly(scenes):
    moved = []
    for scene in scenes:
        pelvis = np.stack([frame.joints[:, 0] for frame in scene.frames])
        for frame in pelvis:
            gaps = np.linalg.norm(frame[:, None, :2] - frame[None, :, :2], axis=-1)
            assert (gaps[~np.eye(len(frame), dtype=bool)] > 0.7).all()
            assert (np.linalg.norm(frame[:, :2], axis=-1) > 1.4).all()
        step = np.linalg.norm(np.diff(pelvis, axis=0), axis=-1)
        # no jumps between frames at 10 Hz
        assert step.max() < 0.7
        moved.append(step.mean())
    assert np.mean(moved) > 0.03


def test_street_has_requested_number_of_people():
    counts = {len(street(2, index, people=(1, 3), sensor="vlp-16").frames[0].boxes) for index in range(8)}
    assert counts <= {1, 2, 3} and len(counts) > 1
    # people who walk for a long time may leave the sidewalk
    frames = street(4, 0, people=(2, 2), frames=60, sensor="vlp-16").frames
    assert len(frames) == 60 and len(frames[0].boxes) == 2


def test_street_without_people_has_only_background(monkeypatch):
    monkeypatch.setattr(module, "_PLACE_TRIES", 0)
    scene = street(3, 1)
    frame = scene.frames[0]
    assert len(frame.points) > 1000 and (frame.person == -1).all() and not frame.part.any()
    assert frame.joints.shape == (0, 26, 3) and frame.boxes == () and samples(scene, RNG(0)) == []


def test_samples_are_cropped_by_noisy_boxes_and_keep_track(scenes):
    pairs = samples(scenes[0], RNG(3))
    assert pairs and len({(number, sample.box.id) for number, sample in pairs}) == len(pairs)
    for number, sample in pairs:
        frame = scenes[0].frames[number]
        truth = frame.boxes[sample.box.id]
        assert sample.frame_id == f"{number}/{truth.id}"
        assert sample.box.contains(sample.points).all()
        assert np.count_nonzero(sample.part) >= 15
        assert 0 < np.linalg.norm(sample.box.center - truth.center) < 0.5
        assert sample.pose.skeleton is BODY26
        np.testing.assert_array_equal(sample.pose.joints, frame.joints[truth.id])
        # all points of the scene within the crop, including those of others
        assert len(sample.points) == sample.box.contains(frame.points).sum()
    again = samples(scenes[0], RNG(3))
    np.testing.assert_array_equal(pairs[0][1].box.center, again[0][1].box.center)
    assert (samples(scenes[0], RNG(4))[0][1].box.center != pairs[0][1].box.center).any()


@pytest.mark.parametrize(
    ("change", "words"),
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
def test_street_rejects_invalid_arguments(change, words):
    with pytest.raises(InputError, match=words) as caught:
        street(**{"seed": 1, "index": 0, **change})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["livox-mid360", "livox-avia", "vlp-16"])
def test_street_works_with_every_kind_of_sensor(name):
    seen = 0
    for index in range(3):
        for frame in street(9, index, sensor=name, frames=2).frames:
            assert np.isfinite(frame.points).all() and len(frame.points) > 1000
            seen += (frame.person >= 0).sum()
            for track, box in enumerate(frame.boxes):
                own = frame.points[frame.person == track]
                # a rosette frame smears people who walk
                assert len(own) == 0 or box.contains(own, margin=0.3).mean() > 0.95
    assert seen > 100


def test_street_works_with_sensors_of_user(tmp_path):
    for name, fields in (
        ("many", {"elevations_deg": np.linspace(-30, 30, 400).tolist(), "columns": 256}),
        ("down", {"elevations_deg": np.linspace(-20, 20, 32).tolist(), "columns": 512, "tilt_deg": 20}),
    ):
        path = tmp_path / f"{name}.json"
        path.write_text(json.dumps(fields))
        scene, again = (street(7, 1, sensor=str(path)) for _ in range(2))
        points = scene.frames[0].points
        np.testing.assert_array_equal(points, again.frames[0].points)
        assert np.isfinite(points).all() and np.abs(points).max() < 300
        # level for any tilt; more rings than the 256 for which errors are always drawn
        assert points[:, 2].min() == pytest.approx(-scene.height, abs=0.15)
        assert name == "down" or scene.frames[0].ring.max() > 256


# --- simple bodies

WALKER = Place(feet=np.array([5.0, 2.0, -1.5]), yaw=0.7, distance=5.4)


def test_pedestrian_has_activity_of_streets(monkeypatch):
    kinds = iter(["sit", "cycle", "lie", "run", "walk"])
    monkeypatch.setattr(module, "draw_moving_bodies", lambda *arguments: [replace(goer(), kinds=(next(kinds),) * 3)])
    assert module._draw_pedestrian(4, RNG(0)).kinds[0] == "run"


def test_people_on_sidewalks_head_along_street():
    plan = module.StreetPlan(road=3.0, front=7.0, kerb=0.1, sensor_y=0.5, height=1.8, turn=0.4, ahead=False)
    places = [module._draw_start(plan, goer(still=True), RNG(seed))[0] for seed in range(60)]
    along = [abs(np.cos(place.yaw - plan.turn)) for place in places if place.feet[2] > -plan.height + 0.05]
    assert len(along) > 35 and min(along) > 0.95


def test_rosette_pattern_continues_in_next_frame():
    still, walker = quad(20.0, np.zeros(2)).moved((0, 0, -1.2)), (goer(still=True), replace(WALKER, yaw=0.0))
    turn = (sensor("livox-avia"), still, [walker])
    first, second = (module._scan_turn(*turn, frame, np.zeros(256, np.float32), RNG(0)).points for frame in (0, 1))
    assert first.shape != second.shape or np.abs(first - second).max() > 0.01


def test_rosette_joints_and_box_are_at_middle_of_frame():
    nobody, place = quad(0.1, np.zeros(2)).moved((0, 0, -30)), replace(WALKER, yaw=0.0)
    turn = (sensor("livox-avia"), nobody, [(strider([0.4, 0.0, 0.0]), place)])
    frame = module._scan_turn(*turn, 0, np.zeros(256, np.float32), RNG(0))
    # the visible back is a plane, smeared by half a step in both directions
    back = frame.points[:, 0] - (frame.joints[0, 0, 0] - 0.15)
    back = back[np.abs(back) < 0.25]
    assert len(back) > 100 and abs(back.mean()) < 0.03 and np.ptp(back) > 0.3
    np.testing.assert_allclose(frame.boxes[0].center[:2], place.feet[:2], atol=1e-4)


def test_sample_parts_are_of_its_own_person():
    rng = RNG(0)
    centers = np.array([[6.0, 0.0, -0.8], [6.0, 0.45, -0.8]])
    points = np.concatenate([c + rng.uniform(-0.2, 0.2, (40, 3)) for c in centers]).astype(np.float32)
    frame = StreetFrame(
        points=points, ring=np.zeros(80, np.int32), person=np.repeat([0, 1], 40).astype(np.int16),
        part=np.repeat([4, 9], 40).astype(np.uint8),
        boxes=tuple(Box(center=c, size=[0.8, 0.8, 1.0], yaw=0.0, id=k) for k, c in enumerate(centers)),
        joints=np.tile(centers[:, None], (1, 26, 1)).astype(np.float32),
    )  # fmt: skip
    (_, first), (_, second) = samples(Street(frames=(frame,), sensor="os1-128", height=1.7), rng)
    for sample, own in ((first, 4), (second, 9)):
        assert set(sample.part) == {0, own} and np.count_nonzero(sample.part) <= 40 < len(sample.part)


@pytest.mark.parametrize("frame", range(3))
def test_street_box_is_aligned_with_person(frame):
    box, bodies = module._label((goer(), WALKER), frame, 4), goer()
    np.testing.assert_allclose(box.size, [0.4, 1.0, 1.8], atol=1e-4)
    for part in (bodies.vertices[frame], bodies.joints[frame]):
        assert box.id == 4 and box.contains(WALKER.of_body(part)).all()
    assert abs((box.yaw - WALKER.yaw - HEADINGS[frame] + np.pi) % (2 * np.pi) - np.pi) < 1e-6
