"""Training with people of whole scans: crops, labels, and the share in pre-training."""

import pickle

import numpy as np
import pytest

from lidarpose.errors import InputError
from lidarpose.inference.verification import AROUND
from lidarpose.skeleton import BODY26
from lidarpose.synth.detection_scene import detection_scene
from lidarpose.train import scan_people
from lidarpose.train.augment import UNKNOWN_PART, visible_joints
from lidarpose.train.data_loader import MixedSource
from lidarpose.train.detector.candidate_source import SceneSource, scene_to_search
from lidarpose.train.recipes import Pretrain
from lidarpose.train.scan_people import LEAST_POINTS, draw_person, person_example, populated_scan
from lidarpose.train.setup import make_setup

SEED = 4
LEFT, RIGHT = (BODY26.index(f"{side}_shoulder") for side in ("left", "right"))
PELVIS = BODY26.index("pelvis")


@pytest.fixture(scope="module")
def scan():
    """A scan with people close together."""
    scans = [scan_people.scan_people(SEED, number) for number in range(12)]
    return min((scan for scan in scans if len(scan.boxes) > 3), key=lambda scan: np.sort(scan.neighbors)[2])


def examples(scan, count):
    people = np.arange(count) % len(scan.boxes)
    return [(k, person_example(scan, k, np.random.default_rng([9, i]))) for i, k in enumerate(people.tolist())]


def test_scan_people_have_points_and_surroundings():
    number = next(n for n in range(9) if len(detection_scene(SEED, n).boxes) > 4)
    scene, scan = scene_to_search(SEED, number, "train")[0], scan_people.scan_people(SEED, number)
    counts = np.bincount(scene.person[scene.person >= 0], minlength=len(scene.boxes))
    assert {box.id for box in scan.boxes} <= set(np.flatnonzero(counts >= LEAST_POINTS).tolist())
    for box, cloud, owner, joints in zip(scan.boxes, scan.clouds, scan.owners, scan.joints, strict=True):
        assert (np.abs(cloud[:, :2] - box.center[:2]) < AROUND).all() and len(cloud) <= 6000
        assert LEAST_POINTS <= (owner == 1).sum() <= counts[box.id]
        assert box.contains(joints[None, PELVIS])[0] and box.contains(cloud[owner == 1]).mean() > 0.95
    again = scan_people.scan_people(SEED, number)
    assert all(np.array_equal(a, b) for a, b in zip(scan.clouds, again.clouds, strict=True))


def test_crop_labels_person_and_background(scan):
    second, mirrored = [], []
    for person, example in examples(scan, 120):
        assert (example.part == UNKNOWN_PART).sum() >= min(LEAST_POINTS, (scan.owners[person] == 1).sum()) > 0
        assert set(np.unique(example.part)) <= {UNKNOWN_PART, 0} and len(example.part) == len(example.points)
        # the body changes only by a scale
        true = scan.joints[person].astype(float)
        lengths = [np.linalg.norm(joints[LEFT] - joints[RIGHT]) for joints in (true, example.joints)]
        assert lengths[1] == pytest.approx(lengths[0] * example.scale, rel=1e-5)
        assert 0.9 < example.scale < 1.1 and np.linalg.norm(example.joints[PELVIS]) < 1.5
        side = np.cross(true[LEFT] - true[RIGHT], true[PELVIS + 1] - true[PELVIS])
        after = example.joints.astype(float)
        turned = np.cross(after[LEFT] - after[RIGHT], after[PELVIS + 1] - after[PELVIS])
        mirrored.append(np.sign(side[1]) != np.sign(turned[1]))
        assert example.person[0] == 1
        second.append(example.person[1])
        # the view direction is a unit vector if the sensor is known
        assert example.view[4] == 0 or np.linalg.norm(example.view[:3]) == pytest.approx(1)
    assert 0.3 < np.mean(mirrored) < 0.7 and np.nanmax(second) == 1


def test_mirroring_includes_sensor_and_visibility(scan, monkeypatch):
    monkeypatch.setattr(scan_people, "_NOISE", 0.0)
    monkeypatch.setattr(scan_people, "_SCALE", 0.0)
    num_mirrored = 0
    for person, example in examples(scan, 60):
        joints, points = example.joints.astype(float), example.points.astype(float)
        is_visible = visible_joints(joints, points[example.part == UNKNOWN_PART])
        assert (example.visible == is_visible).mean() > 0.95
        if not example.view[4]:
            continue
        sensor = example.view[:3].astype(float) * np.exp(example.view[3])
        true_distances = np.linalg.norm(scan.joints[person].astype(float) - scan.origin, axis=1)
        distances = np.linalg.norm(joints - sensor, axis=1)
        is_mirrored = not np.allclose(distances, true_distances, atol=2e-3)
        num_mirrored += is_mirrored
        np.testing.assert_allclose(
            distances[list(BODY26.flip)] if is_mirrored else distances, true_distances, atol=2e-3
        )
    assert num_mirrored > 5


def test_example_depends_only_on_its_index():
    source = SceneSource(seed=SEED, uses=3, lag=2, load_scene=populated_scan, draw_example=draw_person)
    first = [source.example(index) for index in range(8)]
    alone = pickle.loads(pickle.dumps(source)).example(7)
    assert np.array_equal(first[7].points, alone.points) and first[7].seed == alone.seed
    assert len({example.seed for example in first}) == 8


def test_scan_without_people_is_skipped(monkeypatch, scan):
    empty = scan_people.ScanPeople(
        clouds=[], owners=[], boxes=[], joints=np.zeros((0, 26, 3)), neighbors=np.zeros(0), origin=None
    )
    asked = []

    def people(seed, number):
        asked.append(number)
        return scan if len(asked) > 2 else empty

    monkeypatch.setattr(scan_people, "scan_people", people)
    assert populated_scan(SEED, 5) is scan
    assert len(set(asked)) == 3 and asked[0] == 5
    monkeypatch.setattr(scan_people, "scan_people", lambda *_: empty)
    with pytest.raises(InputError, match=f"^16 scenes of seed {SEED}, from number 5 on, have no people"):
        populated_scan(SEED, 5)


def test_whole_scans_are_a_share_of_pretraining(monkeypatch):
    setup = make_setup(Pretrain(whole_scans=0.25, people=64))
    assert isinstance(setup.source, MixedSource) and setup.source.share == 0.25
    assert setup.source.other.load_scene is populated_scan
    with pytest.raises(InputError, match="whole_scans are for the package's own networks: omit whole_scans or prn"):
        make_setup(Pretrain(whole_scans=0.1, size="prn"))
    with pytest.raises(InputError, match="whole_scans are made during training: omit whole_scans or shards"):
        make_setup(Pretrain(whole_scans=0.1, shards=("somewhere",)))
    with pytest.raises(InputError, match="whole_scans must be a share, below 1, got 1"):
        Pretrain(whole_scans=1)
