"""Crops of objects without a person, and networks that predict whether a person is present."""

from dataclasses import replace

import numpy as np
import pytest

from lidarpose.errors import InputError
from lidarpose.lidar.presets import sensor
from lidarpose.sample import Sample
from lidarpose.skeleton import BODY26
from lidarpose.synth import objects, simulate
from lidarpose.synth.acquisition import Acquisition
from lidarpose.synth.environment.mesh import Mesh, box
from lidarpose.synth.environment.things import THINGS
from lidarpose.synth.generator import Generator
from lidarpose.synth.objects import LEAST_POINTS, draw_object
from lidarpose.synth.place import draw_place
from lidarpose.synth.scene import NoiseConfig, scene_config
from lidarpose.synth.simulate import ScanConditions, Scene, simulate_still
from lidarpose.synth.views import with_views
from lidarpose.train import data_loader
from lidarpose.train.augment import people_in, second_person_label
from lidarpose.train.data_loader import SyntheticSource
from lidarpose.train.recipes import Finetune, Pretrain
from lidarpose.train.setup import make_setup

WILD = scene_config("wild")


def test_draw_object_depends_only_on_seed_and_index():
    later = [draw_object(WILD, 5, index) for index in (2, 1, 0)]
    first = [draw_object(WILD, 5, index) for index in range(3)]
    for (a, kind), (b, same) in zip(first, reversed(later), strict=True):
        assert kind == same and a.source == b.source
        np.testing.assert_array_equal(a.points, b.points)
    assert not np.array_equal(first[0][0].points[:15], draw_object(WILD, 6, 0)[0].points[:15])


@pytest.mark.parametrize("left_out", [False, True])
def test_draw_object_has_no_person(left_out):
    kinds = set()
    for index in range(40):
        sample, kind = draw_object(WILD, 1, index, left_out=left_out)
        kinds.add(kind)
        assert kind == "clutter" or THINGS[kind].left_out is left_out
        assert len(sample.points) >= LEAST_POINTS and sample.pose is None and not sample.part.any()
        assert sample.box.contains(sample.points).all()
        assert (sample.box.size <= [1.2, 1.2, 2.2]).all()
    assert len(kinds) >= (4 if left_out else 10)


def test_draw_object_crops_surface_of_large_thing(monkeypatch):
    # its middle is farther from its surface than a box reaches
    monkeypatch.setattr(objects, "draw_thing", lambda name, rng: box((4.0, 4.0, 1.8)))
    for index in range(4):
        draw_object(replace(WILD, noise=NoiseConfig()), 1, index)


@pytest.mark.parametrize("name", ["merged", "accumulated", "inverted", "sparse"])
def test_draw_object_uses_scan_conditions_of_people(name):
    config = WILD.changed((f"{name}=1",))
    for index in range(4):
        sample, _ = draw_object(config, 1, index)
        assert sample.conditions == (name,)
        assert np.linalg.norm(sample.box.center[:2]) < config.distance[1]
    # `crowded` does not apply to objects and does not change their random draws
    sample, kind = draw_object(WILD.changed(("crowded=1",)), 1, 0)
    same, other = draw_object(WILD, 1, 0)
    assert not sample.conditions and kind == other
    np.testing.assert_array_equal(sample.points, same.points)


def test_beam_window_covers_crops_of_objects(monkeypatch):
    """A crop with an empty rim around the thing would reveal that no person is present."""
    scans = []
    monkeypatch.setattr(
        objects, "simulate_still", lambda *args, **options: scans.append((args, options)) or simulate_still(*args)
    )
    config = replace(scene_config("wide"), sensors=("os1-64",), distance=(3.0, 9.0)).changed(
        [f"{name}=0" for name in ("merged", "accumulated", "crowded", "integration", "sparse", "inverted")]
    )
    counts = []
    for index in range(16):
        scans.clear()
        sample, _ = draw_object(config, 1, index)
        (scene, thing, _), options = scans[-1]
        wider = replace(scene, config=replace(config, around=4.0))
        for view, window in ((scene, None), (scene, options["box"]), (wider, None)):
            hits, _ = simulate._cast(view, [thing, *scene.background], 0, box=window)
            counts.append(np.count_nonzero(sample.box.contains(scene.place.to_level(hits.points))))
    inside, window_inside, all_inside = np.sum(np.reshape(counts, (-1, 3)), 0)
    assert window_inside > 0.995 * all_inside > inside
    scans.clear()
    draw_object(WILD, 1, 0)
    assert scans[-1][1]["box"] is None


def test_synthetic_source_objects_get_difficulty_of_people(monkeypatch):
    """While people are still easy, several scans of objects would reveal that no person is present."""
    merged = WILD.changed(("merged=1",))
    easy, _ = draw_object(merged, 1, 0, hard=0.0)
    np.testing.assert_array_equal(easy.points, draw_object(WILD, 1, 0)[0].points)
    assert not easy.conditions and draw_object(merged, 1, 0, hard=1.0)[0].conditions == ("merged",)
    drawn = []
    monkeypatch.setattr(
        data_loader, "draw_object", lambda *args, hard: drawn.append(hard) or draw_object(*args, hard=hard)
    )
    for index in (0, 10, 40):
        SyntheticSource(scene="wild", seed=3, objects=1.0, easy=20.0, set=("sparse=0.5",)).example(index)
    assert drawn[0] == 0 and 0 < drawn[1] < 0.5 and 0 < drawn[2] < 1
    # without scan conditions, objects get no difficulty
    SyntheticSource(scene="wild", seed=3, objects=1.0, easy=20.0).example(10)
    assert drawn[3] is None


@pytest.mark.parametrize(("frames", "sensors"), [(5, ("os1-64",)), (1, ("os1-64", "hdl-32e", "os0-128"))])
def test_simulate_still_has_object_in_one_place_for_all_scans(frames, sensors):
    config = replace(scene_config("paper"), sensors=sensors[:1], slope=0.0, noise=NoiseConfig())
    acquisition = Acquisition(sensors=sensors, frames=frames, speed=10.0, distance=(6.0, 8.0))
    rng = np.random.default_rng(2)
    place = draw_place(acquisition.placing(config), sensor(sensors[0]), 2.0, 0.5, 1.0, rng)
    ground = Mesh(np.zeros((3, 3), np.float32), np.zeros((0, 3), np.int32))
    scene = Scene(
        config=config, sensor=sensor(sensors[0]), place=place, conditions=ScanConditions(),
        background=[ground], props=[], acquisition=acquisition,
    )  # fmt: skip
    scene = with_views(scene, acquisition.placing(config), 2.0, 0.5, 1.0, rng)
    views = (replace(view, scene=replace(view.scene, conditions=ScanConditions())) for view in scene.views)
    scene = replace(scene, views=tuple(views))
    # an upright disk, its center 1 m above the feet
    angle = np.linspace(0, 2 * np.pi, 25)[:-1]
    upright = place.feet + np.column_stack([0.8 * np.cos(angle), np.zeros(24), 1.0 + 0.8 * np.sin(angle)])
    faces = np.array([(0, k, k + 1) for k in range(1, 23)], np.int32)
    disk = Mesh(upright.astype(np.float32), faces, np.ones(len(faces), np.uint8))
    alone = simulate_still(replace(scene, views=()), disk, np.random.default_rng(0))
    every = simulate_still(scene, disk, np.random.default_rng(0))
    assert len(every.points) > 1.5 * len(alone.points) > 30
    assert np.abs(every.points[:, 1] - place.feet[1]).max() < 0.02
    assert (np.linalg.norm(every.points - place.feet - [0, 0, 1.0], axis=1) < 0.83).all()


def test_draw_object_rejects_scene_out_of_range():
    far = replace(WILD, sensors=("vlp-16",), distance=(300.0, 400.0), median_points=0)
    with pytest.raises(InputError, match="scene wild: none of 16 draws left 15 points on an object"):
        draw_object(far, 0, 0)


def test_synthetic_source_has_share_of_objects():
    source = SyntheticSource(scene="wild", seed=3, objects=0.3)
    examples = [source.example(index) for index in range(60)]
    nobody = [example for example in examples if example.person[0] == 0]
    assert 9 <= len(nobody) <= 27
    for example in nobody:
        assert np.isnan(example.joints).all() and (example.part == -1).all() and example.person[1] == 0
        assert example.joints.shape == (len(BODY26), 3)
    assert all(example.person[0] == 1 for example in examples if not np.isnan(example.joints).any())
    # disturbed as people are
    clean, noisy = (SyntheticSource(scene="wild", seed=3, objects=0.99, noise=noise).example(0) for noise in (0.0, 1.0))
    assert clean.person[0] == noisy.person[0] == 0 and len(clean.points) == len(noisy.points)
    assert not np.array_equal(clean.points, noisy.points)
    # without objects the number of people is unknown
    plain = SyntheticSource(scene="wild", seed=3)
    assert np.isnan(plain.example(0).person).all()


def test_pretrain_with_objects_adds_person_head():
    setup = make_setup(Pretrain(objects=0.1, people=64))
    assert setup.objective.config.person and setup.network().person is not None
    assert not make_setup(Pretrain(people=64)).objective.config.person
    with pytest.raises(InputError, match="objects are for the package's own networks, and paper is not one of them"):
        make_setup(Pretrain(objects=0.1, size="paper"))
    with pytest.raises(InputError, match="objects must be a share, below 1, got 1"):
        Pretrain(objects=1)
    assert "objects" not in {name for name in Finetune.__dataclass_fields__}


def test_synthetic_source_labels_visible_second_person():
    crowded = replace(scene_config("wide"), crowded=1.0, company=0.0)
    source = SyntheticSource(scene="wild", seed=3, objects=0.01, set=("crowded=1",))
    two = [source.example(index).person[1] for index in range(40)]
    assert np.nansum(two) >= 20
    alone = SyntheticSource(scene="wild", seed=3, objects=0.01, set=("company=0",))
    assert not any(alone.example(index).person[1] for index in range(20))
    sample = Generator(scene=crowded, measure=False).person(3, 0).sample
    assert 0 < sample.second_person_points <= (sample.part == 0).sum()


def test_people_in_is_unknown_for_few_points_of_second_person():
    points = np.zeros((100, 3), np.float32)
    for others, due in ((0, 0.0), (9, np.nan), (14, np.nan), (15, 1.0), (60, 1.0)):
        sample = Sample(points=points, center=np.zeros(3), second_person_points=others)
        np.testing.assert_array_equal(people_in(sample), np.float32([1, due]))
    # at least a tenth of the points
    for others, due in ((29, np.nan), (30, 1.0)):
        assert second_person_label(others, 300) == pytest.approx(due, nan_ok=True)
