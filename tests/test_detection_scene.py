"""Scenes for training of the detector: owners of points, content of each family, determinism."""

import json
from collections import Counter
from importlib import resources

import numpy as np
import pytest
from walkers import strider

from lidarpose.errors import InputError
from lidarpose.lidar.presets import sensor
from lidarpose.lidar.raycast import scan
from lidarpose.lidar.sensor import Sensor
from lidarpose.synth.detection_people import PlacedPerson
from lidarpose.synth.detection_scan import _integrated
from lidarpose.synth.detection_scene import DetectionScene, detection_scene
from lidarpose.synth.environment.layouts import LAYOUTS, LEFT_OUT
from lidarpose.synth.environment.mesh import shape
from lidarpose.synth.environment.site import Mount, Site
from lidarpose.synth.environment.things import KINDS, THINGS
from lidarpose.synth.environment.traffic import with_windows
from lidarpose.synth.place import Place

LEFT_OUT_THINGS = {name for name, thing in THINGS.items() if thing.left_out}


@pytest.fixture(scope="module")
def train() -> list[DetectionScene]:
    return [detection_scene(5, index) for index in range(60)]


@pytest.fixture(scope="module")
def heldout() -> list[DetectionScene]:
    return [detection_scene(5, index, family="heldout") for index in range(30)]


def test_detection_scene_is_determined_by_seed_index_and_family(train):
    again, others = detection_scene(5, 3), [detection_scene(6, 3), detection_scene(5, 3, family="bench")]
    for name in ("points", "origin", "person", "thing", "joints", "mounted", "up"):
        np.testing.assert_array_equal(getattr(again, name), getattr(train[3], name))
    assert (again.sensor, again.kind, again.negatives) == (train[3].sensor, train[3].kind, train[3].negatives)
    for other in others:
        assert other.points.shape != again.points.shape or (other.points != again.points).any()


def test_detection_scene_boxes_contain_points_of_people(train, heldout):
    strays = people = 0
    for scene in [*train, *heldout]:
        count = len(scene.boxes)
        assert scene.points.dtype == np.float32 and scene.points.shape == (len(scene.person), 3)
        assert np.isfinite(scene.points).all() and scene.person.dtype == scene.thing.dtype == np.int16
        assert scene.person.min(initial=-1) >= -1 and scene.person.max(initial=-1) < count
        assert scene.thing.min(initial=-1) >= -1 and scene.thing.max(initial=-1) < len(KINDS)
        assert not ((scene.person >= 0) & (scene.thing >= 0)).any()
        assert scene.joints.shape == (count, 26, 3) and scene.mounted.shape == (count,)
        assert {KINDS[k] for k in np.unique(scene.thing) if k >= 0} <= set(scene.negatives)
        np.testing.assert_allclose(np.linalg.norm(scene.up), 1, atol=1e-6)
        for number, box in enumerate(scene.boxes):
            own = scene.points[scene.person == number]
            people += 1
            # clothes, hats and range noise exceed the tight box
            assert box.contains(own, 0.3).all()
            assert box.contains(scene.joints[number], 0.02).all()
            assert 0.3 < box.size[2] < 2.6 and box.id == number
        centers = np.array([box.center for box in scene.boxes]).reshape(-1, 3)
        gaps = np.linalg.norm(centers[:, None] - centers, axis=-1) + 9 * np.eye(count)
        # closer than people are placed, by half of a wide stride
        strays += int((gaps < 0.2).sum())
    # few people walk into each other
    assert people > 300 and strays < 0.01 * people


def test_training_scenes_exclude_left_out_kinds(train, heldout):
    for scene in train:
        assert scene.kind not in LEFT_OUT and not LEFT_OUT_THINGS & set(scene.negatives)
    assert set(LEFT_OUT) & {scene.kind for scene in heldout}
    assert set().union(*(scene.negatives for scene in heldout)) >= LEFT_OUT_THINGS


def test_scenes_contain_all_kinds_places_and_sensors(train, heldout):
    present = Counter(name for scene in train for name in scene.negatives)
    assert set(present) | LEFT_OUT_THINGS == set(KINDS)
    assert {scene.kind for scene in train} == set(
        "street, square, path, room, small room, car park, fragment".split(", ")
    )
    assert len({scene.sensor for scene in train}) >= 9
    seen = [np.bincount(scene.person[scene.person >= 0], minlength=len(scene.boxes)) for scene in train]
    # people are visible in most scenes, and some are riders
    assert np.mean([(counts >= 20).any() for counts in seen]) > 0.6
    assert sum(int(scene.mounted.sum()) for scene in train) > 20
    tilt = np.degrees([np.arccos(min(scene.up[2], 1.0)) for scene in train])
    assert np.median(tilt) < 2 and 15 < tilt.max() < 31
    assert 0 < np.mean([(scene.origin != 0).any() for scene in train]) < 0.6
    assert min(scene.height for scene in train) < 0.6 and max(scene.height for scene in train) > 3


def test_third_of_people_in_training_do_not_stand(train, heldout):
    low, of_heldout = (
        np.mean([kind in ("sit", "crouch", "kneel", "bend") for scene in scenes for kind in scene.activities])
        for scenes in (train, heldout)
    )
    assert 0.26 < low < 0.4 and of_heldout < low - 0.05


def test_label_of_long_frame_is_at_middle_of_extrapolated_motion():
    step = np.array([0.1, -0.05, 0.02])
    bodies, place = strider(step), Place(feet=np.zeros(3), yaw=0.0, distance=1.0)
    person = PlacedPerson(bodies=bodies, row=0, place=place, props=[])
    # three steps, the vertical one without the extrapolated two
    motion = step * [3, 3, 1]
    vertices, joints = person.label(0.3)
    np.testing.assert_allclose(joints, bodies.joints[0] + motion / 2, atol=1e-6)
    np.testing.assert_allclose(vertices, np.concatenate([bodies.vertices[0], bodies.vertices[0] + motion]), atol=1e-6)


def test_integrated_rosette_spreads_frames_over_time():
    azimuth, _, time, _ = _integrated("livox-avia", 3).rays(0)
    parts = [sensor("livox-avia").rays(number) for number in range(3)]
    np.testing.assert_array_equal(azimuth, np.concatenate([part[0] for part in parts]))
    # each frame fills its own third of the time
    np.testing.assert_array_equal((3 * time).astype(int), np.repeat(range(3), [len(part[0]) for part in parts]))
    assert 0 <= time.min() < 0.01 and 0.99 < time.max() < 1


def test_with_windows_lets_beams_into_some_cars():
    beam = Sensor(name="beam", elevations=np.zeros(1), azimuth_step=np.pi / 90, range_max=20.0)
    depths = []
    for number in range(30):
        car, angle = shape("car", 4.4, 1.8, 1.5), 0.3 * number
        mesh = with_windows(car.moved((20.0, -30.0, 2.0), angle), np.random.default_rng(number))
        mesh = mesh.moved((-20.0, 30.0, -2.0)).moved((0.0, 0.0, 0.0), -angle)
        # added surfaces are inside the car
        np.testing.assert_allclose(
            [mesh.vertices.min(0), mesh.vertices.max(0)], [car.vertices.min(0), car.vertices.max(0)], atol=1e-4
        )
        # from the side, at the height of the windows
        points = scan(mesh.moved((0.0, 6.0, -1.2)).vertices, mesh.faces, beam).points
        depths += (points[:, 1] - 5.1).tolist()
    # some beams hit glass, others seats, heads or the far window
    assert sum(depth < 0.35 for depth in depths) > 100 and sum(depth > 0.4 for depth in depths) > 20


def test_with_windows_keeps_other_vehicles():
    van = shape("van", 5.0, 2.0, 2.0)
    assert with_windows(van, np.random.default_rng(0)) is van


def test_site_level_follows_road_and_curb():
    road = Sensor(name="beam", elevations=np.zeros(1), azimuth_step=np.pi / 2, range_max=20.0)
    mount = Mount(height=2.0, R_sensor_level=np.eye(3), turn=0.0, view=(0.0, np.pi))
    kerbs = []
    for number in range(20):
        layout = LAYOUTS["street"](np.random.default_rng(number))
        site, y = Site(layout, road, mount), layout.sensor[1]
        ground = next(mesh for name, mesh in site.items if name == "ground").vertices
        for offset in (-0.3, 0.3, -1.9, 1.9):
            for side in (-1, 1):
                place = np.array([0.0, side * (layout.road + offset) - y])
                # the ground's row of vertices that is nearest in y on the same side of the curb
                is_same_side = (np.abs(ground[:, 1] + y) > layout.road + 0.01) == (offset > 0)
                rows = ground[is_same_side]
                expected = rows[np.argmin(np.abs(rows[:, 1] - place[1])), 2]
                assert site.level(place) == pytest.approx(expected, abs=1e-6)
        kerbs.append(layout.areas[0][4])
    assert max(kerbs) > 0.1 and min(kerbs) == 0


@pytest.mark.parametrize("wrong", [{"seed": -1}, {"index": 1.5}, {"family": "test"}])
def test_detection_scene_rejects_invalid_arguments(wrong):
    with pytest.raises(InputError):
        detection_scene(**({"seed": 1, "index": 0} | wrong))


@pytest.mark.parametrize("row", [0, 77, 202])
def test_frozen_heldout_scenes_are_reproduced(row):
    frozen = json.loads(resources.files("lidarpose.eval").joinpath("assets/detector-heldout-1.json").read_text())
    assert frozen["indices"] == list(range(240)) and set(frozen["left_out"]) == LEFT_OUT_THINGS | set(LEFT_OUT)
    scene = detection_scene(frozen["seed"], frozen["indices"][row], family=frozen["family"])
    assert (scene.kind, scene.sensor) == (frozen["kinds"][row], frozen["sensors"][row])
    assert scene.points_digest() == frozen["sha256"][row]
