"""Crops in which nobody is, and networks that say so."""

from dataclasses import replace

import numpy as np
import pytest

from lidarpose.errors import InputError
from lidarpose.sample import Sample
from lidarpose.skeleton import BODY26
from lidarpose.synth.environment.things import THINGS
from lidarpose.synth.generator import Generator
from lidarpose.synth.objects import LEAST_POINTS, draw_object
from lidarpose.synth.scene import scene_config
from lidarpose.train.augment import people_in
from lidarpose.train.data_loader import SyntheticSource
from lidarpose.train.recipes import Finetune, Pretrain
from lidarpose.train.setup import make_setup

WILD = scene_config("wild")


def test_an_object_is_a_function_of_its_number():
    later = [draw_object(WILD, 5, index) for index in (2, 1, 0)]
    first = [draw_object(WILD, 5, index) for index in range(3)]
    for (a, kind), (b, same) in zip(first, reversed(later), strict=True):
        assert kind == same and a.source == b.source
        np.testing.assert_array_equal(a.points, b.points)
    assert not np.array_equal(first[0][0].points[:15], draw_object(WILD, 6, 0)[0].points[:15])


@pytest.mark.parametrize("left_out", [False, True])
def test_objects_are_crops_of_things_without_a_person(left_out):
    kinds = set()
    for index in range(40):
        sample, kind = draw_object(WILD, 1, index, left_out=left_out)
        kinds.add(kind)
        assert kind == "clutter" or THINGS[kind].left_out is left_out
        assert len(sample.points) >= LEAST_POINTS and sample.pose is None and not sample.part.any()
        assert sample.box.contains(sample.points).all()
        assert (sample.box.size <= [1.2, 1.2, 2.2]).all()
    assert len(kinds) >= (4 if left_out else 10)


def test_sensors_that_reach_nothing_are_an_error():
    far = replace(WILD, sensors=("vlp-16",), distance=(300.0, 400.0), median_points=0)
    with pytest.raises(InputError, match="scene wild: no draw of 16 left 15 points on an object"):
        draw_object(far, 0, 0)


def test_a_share_of_the_examples_shows_nobody():
    source = SyntheticSource(scene="wild", seed=3, objects=0.3)
    examples = [source.example(index) for index in range(60)]
    nobody = [example for example in examples if example.person[0] == 0]
    assert 9 <= len(nobody) <= 27
    for example in nobody:
        assert np.isnan(example.joints).all() and (example.part == -1).all() and example.person[1] == 0
        assert example.joints.shape == (len(BODY26), 3)
    assert all(example.person[0] == 1 for example in examples if not np.isnan(example.joints).any())
    # without them every person is what they were, and nothing is said of who is there
    plain = SyntheticSource(scene="wild", seed=3)
    assert np.isnan(plain.example(0).person).all()


def test_networks_that_say_whether_somebody_is_there():
    setup = make_setup(Pretrain(objects=0.1, people=64))
    assert setup.objective.config.person and setup.network().person is not None
    assert not make_setup(Pretrain(people=64)).objective.config.person
    with pytest.raises(InputError, match="objects are for the package's own networks, of which paper is none"):
        make_setup(Pretrain(objects=0.1, size="paper"))
    with pytest.raises(InputError, match="objects must be a share, below 1, got 1"):
        Pretrain(objects=1)
    assert "objects" not in {name for name in Finetune.__dataclass_fields__}


def test_a_second_person_is_known_where_they_are_seen():
    crowded = replace(scene_config("wide"), crowded=1.0, company=0.0)
    source = SyntheticSource(scene="wild", seed=3, objects=0.01, set=("crowded=1",))
    two = [source.example(index).person[1] for index in range(40)]
    assert np.nansum(two) >= 20
    alone = SyntheticSource(scene="wild", seed=3, objects=0.01, set=("company=0",))
    assert not any(alone.example(index).person[1] for index in range(20))
    sample = Generator(scene=crowded, measure=False).person(3, 0).sample
    assert 0 < sample.second_person_points <= (sample.part == 0).sum()


def test_few_points_of_a_second_person_say_nothing():
    points = np.zeros((100, 3), np.float32)
    for others, due in ((0, 0.0), (9, np.nan), (14, np.nan), (15, 1.0), (60, 1.0)):
        sample = Sample(points=points, center=np.zeros(3), second_person_points=others)
        np.testing.assert_array_equal(people_in(sample), np.float32([1, due]))
