"""Turned and mirrored people: everything moves together, and their targets are the turned and mirrored targets."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lidarpose.data.views import MIRROR, mirrored, turned
from lidarpose.geometry import rotation_about
from lidarpose.model.heads import bin_centers, encode
from lidarpose.model.presets import preset
from lidarpose.sample import Sample
from lidarpose.skeleton import BODY26, SMPL24
from lidarpose.synth.generate import Generator
from lidarpose.synth.scene import SCENES
from lidarpose.train.example import example
from lidarpose.train.losses import SIGMA
from lidarpose.train.pose_task import PoseTask

turns = st.floats(-7, 7)


@cache
def people():
    maker = Generator(scene=SCENES["wild"])
    return [maker.person(11, index) for index in range(6)]


def samples():
    return [person.sample for person in people()]


def assert_same(a, b, atol=1e-4):
    np.testing.assert_allclose(a.points, b.points, atol=atol)
    np.testing.assert_allclose(a.pose.joints, b.pose.joints, atol=atol)
    np.testing.assert_allclose(a.center, b.center, atol=atol)
    np.testing.assert_array_equal(a.part, b.part)
    np.testing.assert_allclose(a.box.center, b.box.center, atol=atol)
    assert np.cos(a.box.yaw - b.box.yaw) == pytest.approx(1)


@settings(max_examples=20, deadline=None)
@given(turns)
def test_there_and_back(yaw):
    for sample in samples():
        assert_same(turned(turned(sample, yaw), -yaw), sample)
        assert_same(mirrored(mirrored(sample)), sample)
        # a mirror turns the other way
        assert_same(mirrored(turned(sample, yaw)), turned(mirrored(sample), -yaw))


@settings(max_examples=20, deadline=None)
@given(turns)
def test_distances_stay_and_left_becomes_right(yaw):
    left, right = BODY26.index("left_wrist"), BODY26.index("right_wrist")
    for sample in samples():
        apart = np.linalg.norm(sample.points[:, None] - sample.pose.joints, axis=-1)
        there = turned(sample, yaw)
        np.testing.assert_allclose(np.linalg.norm(there.points[:, None] - there.pose.joints, axis=-1), apart, atol=1e-4)
        image = mirrored(sample)
        seen = np.linalg.norm(image.points[:, None] - image.pose.joints, axis=-1)
        np.testing.assert_allclose(seen[:, right], apart[:, left], atol=1e-4)
        np.testing.assert_allclose(seen[:, BODY26.index("head")], apart[:, BODY26.index("head")], atol=1e-4)
        for name in SMPL24.joints:
            other = SMPL24.joints[SMPL24.flip[SMPL24.index(name)]]
            np.testing.assert_array_equal(
                sample.part == 1 + SMPL24.index(name), image.part == 1 + SMPL24.index(other), err_msg=name
            )
        # the box holds what it held, but for points that rounding moves across its face
        for moved in (there, image):
            same = moved.box.contains(moved.points) == sample.box.contains(sample.points)
            assert same.mean() > 0.99


def test_what_is_told_of_a_joint_stays_with_it_in_a_mirror():
    sample, rng = samples()[0], np.random.default_rng(0)
    told = {name: rng.random(26) for name in ("confidence", "spread", "visible")} | {"in_range": rng.random(26) < 0.5}
    image = mirrored(replace(sample, pose=replace(sample.pose, **told))).pose
    for name, values in told.items():
        for j, other in enumerate(BODY26.flip):
            assert getattr(image, name)[other] == values[j], (name, BODY26.joints[j])


@pytest.mark.parametrize("seed", range(4))
def test_the_targets_of_a_mirrored_person_are_mirrored_targets(seed):
    flip = list(BODY26.flip)
    for person in people():
        image = mirrored(person.sample)
        a, b = (example(p, np.random.default_rng(seed)) for p in (person.sample, image))
        # the guess of the pelvis is drawn without regard to mirrors: compare from the pelvis
        np.testing.assert_allclose(b.joints - b.joints[0], ((a.joints - a.joints[0]) @ MIRROR)[flip], atol=1e-4)
        np.testing.assert_allclose(b.points - b.joints[0], (a.points - a.joints[0]) @ MIRROR, atol=1e-4)
        one, other = (PoseTask(config=preset("tiny")).collate([e]) for e in (a, b))
        assert (one["visible"][0, flip] == other["visible"][0]).all()


@settings(max_examples=30, deadline=None)
@given(turns, st.floats(-0.3, 0.3))
def test_heatmaps_go_with_their_joints(yaw, offset):
    """The heatmap of a mirrored joint is read backwards along y, and as it was along x and z."""
    at = np.array([offset, 0.1, -0.2]) @ rotation_about("z", yaw).T
    bins = 80
    there, back = (encode(torch.tensor(v), SIGMA, bins) for v in (at, at @ MIRROR))
    torch.testing.assert_close(back[0], there[0])
    torch.testing.assert_close(back[1], there[1].flip(-1), atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(back[2], there[2])
    assert (bin_centers(bins) @ there[1].float()).item() == pytest.approx(at[1], abs=1e-3)


def test_what_a_sample_lacks_stays_lacking_and_nothing_is_changed():
    bare = Sample(points=np.ones((3, 3), np.float32), center=np.zeros(3))
    for moved in (turned(bare, 1.0), mirrored(bare)):
        assert moved.pose is None and moved.part is None and moved.box is None
    assert (bare.points == 1).all()
    empty = mirrored(Sample(points=np.zeros((0, 3), np.float32), center=np.zeros(3), part=np.zeros(0, np.uint8)))
    assert empty.points.shape == (0, 3) and empty.part.shape == (0,)
