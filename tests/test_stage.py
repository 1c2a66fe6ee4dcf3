"""What stands where in a person's scene, frame by frame, and whose points are whose."""

from dataclasses import replace

import numpy as np
import pytest
from walkers import HEADINGS, goer

from lidarpose.lidar.presets import sensor
from lidarpose.sample import Sample
from lidarpose.skeleton import BODY26
from lidarpose.synth import generator, noise
from lidarpose.synth.environment.mesh import box
from lidarpose.synth.generator import Generator
from lidarpose.synth.placement import Place
from lidarpose.synth.props.attachment import fixed
from lidarpose.synth.scene import SCENES, scene_config
from lidarpose.synth.simulate import Conditions, Returns

SEED = 11
PAPER = SCENES["paper"]
NO_FAULTS = replace(PAPER.faults, mask=0.0)
CLEAN = replace(PAPER, faults=NO_FAULTS, distance=(4.0, 8.0))


def bone_gap(points, joints):
    """(n,) m: from points (n, 3) to the nearest bone."""
    a, b = joints[[p for p, _ in BODY26.bones]], joints[[c for _, c in BODY26.bones]]
    along = b - a
    t = ((points[:, None] - a) * along).sum(-1) / np.maximum((along**2).sum(-1), 1e-9)
    return np.linalg.norm(points[:, None] - a - np.clip(t, 0, 1)[..., None] * along, axis=-1).min(1)


def test_another_person_in_the_crop_is_not_this_one():
    maker, strangers = Generator(scene=replace(CLEAN, company=1.0, margin=0.1), measure=False), 0
    for index in range(12):
        sample = maker.person(SEED, index).sample
        own = sample.points[sample.part > 0].astype(float)
        assert bone_gap(own, sample.pose.joints).max() < 0.32
        above = sample.points[sample.part == 0][:, 2] > sample.pose.joints[:, 2].min() + 0.4
        strangers += np.count_nonzero(above) > 10
    assert strangers >= 6


def test_easy_people_have_nothing_of_what_hides_or_spoils():
    def scene(share):
        wild = replace(SCENES["wild"], sensors=("os1-64",), distance=(4.0, 8.0), company=share, carry=share)
        return replace(wild, faults=replace(wild.faults, stray=share, missing=share))

    never, always = (Generator(scene=scene(share), measure=False) for share in (0.0, 1.0))
    differ = 0
    for index in range(4):
        a, b = (maker.person(SEED, index, hard=0.0).sample for maker in (never, always))
        np.testing.assert_array_equal(a.points, b.points)
        np.testing.assert_array_equal(a.part, b.part)
        differ += len(always.person(SEED, index, hard=1.0).sample.points) != len(b.points)
    assert differ >= 2


@pytest.mark.parametrize("released", [False, True])
def test_stray_points_are_nobody_s_and_of_the_preset_s_law(released, monkeypatch):
    laws = {False: "noise_clusters", True: "reference_clusters"}
    monkeypatch.setattr(noise, laws[released], lambda center, rng, **more: center + rng.uniform(-0.1, 0.1, (7, 3)))
    monkeypatch.setattr(noise, laws[not released], None)
    scenes = [replace(CLEAN, faults=replace(NO_FAULTS, stray=share, released=released)) for share in (0.0, 1.0)]
    for index in range(3):
        bare, strayed = (Generator(scene=scene, measure=False).person(SEED, index).sample for scene in scenes)
        assert len(strayed.points) == len(bare.points) + 7 and len(strayed.ring) == len(strayed.part)
        np.testing.assert_array_equal(strayed.points[strayed.part > 0], bare.points[bare.part > 0])


# --- a person who turns and goes, in clips


def at_the_hip(points):
    x, y, z = points[0]
    return [[1, 0, 0], [0, 1, 0], [0, 0, 1]], [x, y, z]


CLOTH = fixed("cloth", box((0.1, 0.1, 0.1)), at_the_hip, face_part=np.full(12, 5, np.uint8))
STAND = fixed("stand", box((0.1, 0.1, 0.1)), at_the_hip, lift=0.25)


def stage(device, *props):
    place = Place(feet=np.array([6.0, 1.0, -1.2]), yaw=0.7, distance=6.08, R_sensor_level=None)
    calm = Conditions(sigma=0.0, bias=0.0, weak=0.0, divergence=0.0, keep=1.0, phase=0)
    return generator._Stage(device=sensor(device), place=place, conditions=calm, things=[], props=list(props))


def test_clothes_are_the_person_s_and_things_are_not_and_both_go_along():
    actor, where = goer(), stage("dapt64", CLOTH, STAND)
    for frame in range(3):
        body, cloth, thing = generator._layers(where, actor, frame)
        np.testing.assert_array_equal(body.part, actor.face_part)
        np.testing.assert_array_equal(cloth.part, CLOTH.face_part)
        assert thing.part is None
        hip = where.lifted.of_body(actor.joints[frame][:1])[0] + [0, 0, 0.05]
        for layer in (cloth, thing):
            np.testing.assert_allclose(layer.vertices.mean(0), hip, atol=1e-5)


@pytest.mark.parametrize("props", [(), (STAND,)], ids=["on the ground", "lifted"])
def test_pose_box_and_body_of_a_frame_are_in_one_place(props):
    actor, where = goer(), stage("dapt64", *props)
    tight = replace(PAPER, crop=replace(SCENES["wild"].crop, jitter=1e-9, loose=0.0, cut=0.0))
    for frame, heading in enumerate(HEADINGS):
        body = generator._layers(where, actor, frame)[0].vertices
        returns = Returns(points=body, ring=np.zeros(8, np.int32), part=np.ones(8, np.uint8))
        for seed in range(4):
            sample = generator._crop(tight, where, actor, frame, returns, np.random.default_rng(seed))
            assert abs((sample.box.yaw - where.place.yaw - heading + np.pi) % (2 * np.pi) - np.pi) < 1e-6
            assert (sample.box.size[:2] < [0.3 + 0.26, 0.9 + 0.26]).all()
            # the bottom edge may lie above the soles
            assert sample.box.contains(body + [0, 0, 0.3] * (body[:, 2:] < -0.5)).all()
            joints = where.place.of_body(actor.joints[frame]) + [0, 0, 0.25 if props else 0.0]
            np.testing.assert_allclose(sample.pose.joints, joints, atol=1e-5)


def test_a_rosette_goes_on_with_its_pattern_from_frame_to_frame():
    actor, where = goer(still=True), stage("livox-avia")
    first, again, second = (
        generator._sample(CLEAN, where, actor, frame, np.random.default_rng(0)).points for frame in (0, 0, 1)
    )
    np.testing.assert_array_equal(first, again)
    assert len(second) > 50 and (first.shape != second.shape or np.abs(first - second).max() > 0.01)


# --- another try


def test_every_try_is_nearer_and_easier_and_the_best_counts(monkeypatch):
    seen, counts = [], iter([3, 9, 5, 0, 2, 8, 1, 4])

    def drawn(config, actor, bodies, row, nearer, rng):
        seen.append((config.hard, nearer))
        return len(seen) - 1

    def sample(config, stage, actor, frame, rng):
        count = next(counts)
        points = np.full((count, 3), stage, np.float32)
        return Sample(points=points, center=np.zeros(3), part=np.ones(count, np.uint8))

    monkeypatch.setattr(generator, "_draw_stage", drawn)
    monkeypatch.setattr(generator, "_sample", sample)
    person = Generator(scene=PAPER, measure=False).person(SEED, 0)
    np.testing.assert_allclose(seen, [(1 - k / 7, 0.8**k) for k in range(8)], atol=1e-12)
    assert len(person.sample.points) == 9 and (person.sample.points == 1).all()


def test_the_reference_preset_is_the_released_code_s():
    reference = scene_config("reference")
    faults = reference.faults
    assert reference.distance == (5.0, 20.0) and np.degrees(reference.margin) == pytest.approx(1.8)
    assert faults.released and (faults.stray, faults.missing, faults.mask, faults.keep) == (0.5, 0.5, 1.0, 0.6)
