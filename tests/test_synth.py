"""Synthetic people: the same for a seed, and right in space."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidarpose.errors import InputError
from lidarpose.lidar.sensor import sensor
from lidarpose.sample import center_of
from lidarpose.skeleton import BODY26, SMPL24
from lidarpose.synth.bodies import draw_bodies
from lidarpose.synth.generate import BLOCK, LEAST_POINTS, Generator
from lidarpose.synth.mask import laser_mask
from lidarpose.synth.mesh import Mesh, box, prism, quad, union
from lidarpose.synth.scene import SCENES, draw_distance, draw_height, ground, occluder, scene_config, surroundings

SEED = 11
# no mask, no noise, nothing in between: all that a dense sensor sees of a person
CLEAN = replace(SCENES["paper"], mask=0.0, noise=0.0, hard=0.0, distance=(4.0, 8.0))


@cache
def people(scene, count=96):
    maker = Generator(scene=CLEAN if scene == "clean" else SCENES[scene])
    return tuple(maker.person(SEED, index) for index in range(count))


def assert_same(a, b):
    np.testing.assert_array_equal(a.points, b.points)
    np.testing.assert_array_equal(a.part, b.part)
    np.testing.assert_array_equal(a.ring, b.ring)
    np.testing.assert_array_equal(a.center, b.center)
    np.testing.assert_array_equal(a.pose.joints, b.pose.joints)
    np.testing.assert_array_equal(a.box.center, b.box.center)
    assert a.source == b.source


# --- the same for a seed


@pytest.mark.parametrize("scene", ["paper", "wild"])
def test_a_person_is_the_same_alone_in_any_order_and_from_another_generator(scene):
    known = people(scene)
    maker = Generator(scene=SCENES[scene])
    # back and forth over the border of two blocks, other seeds in between
    for index in (BLOCK + 3, 0, 95, BLOCK - 1, 0):
        maker.person(SEED + 1, index)
        assert_same(maker.person(SEED, index).sample, known[index].sample)
    assert_same(Generator(scene=SCENES[scene]).person(SEED, 70).sample, known[70].sample)


@pytest.mark.parametrize("scene", ["paper", "wild"])
def test_measuring_does_not_change_the_sample(scene):
    maker = Generator(scene=SCENES[scene], measure=False)
    for index in range(0, 96, 9):
        person = maker.person(SEED, index)
        assert person.facts is None
        assert_same(person.sample, people(scene)[index].sample)


def test_difficulty_asked_for_leaves_the_others_alone():
    maker = Generator(scene=SCENES["wild"])
    easy = maker.person(SEED, 5, hard=0.0)
    assert easy.facts.distance > 0
    assert_same(maker.person(SEED, 5).sample, people("wild")[5].sample)
    assert_same(maker.person(SEED, 5, hard=1.0).sample, people("wild")[5].sample)
    with pytest.raises(InputError, match="between 0"):
        maker.person(SEED, 5, hard=1.5)


def test_other_seeds_and_other_indices_are_other_people():
    maker = Generator(scene=SCENES["wild"])
    seen = {maker.person(seed, index).sample.points.tobytes() for seed in (1, 2, 3) for index in (0, 1, BLOCK)}
    assert len(seen) == 9


def test_a_block_of_bodies_is_a_function_of_its_seed_and_stands_on_the_ground():
    a, b, c = (draw_bodies(None, 0.0, 12, seed, 4) for seed in (1, 1, 2))
    np.testing.assert_array_equal(a.vertices, b.vertices)
    assert np.abs(a.vertices - c.vertices).max() > 0.1
    np.testing.assert_allclose(a.vertices[..., 2].min(1), 0, atol=1e-6)
    assert a.vertices.dtype == np.float32 and a.joints.shape == (12, 26, 3)


# number of points, z of the box's center, and head in the sensor's frame: of seed 11 in the wild scene
GOLDEN = {
    0: (247, -0.5919, [-3.0442, 1.7429, -0.0531]),
    1: (92, -1.0725, [1.1803, -5.7819, -0.7829]),
    2: (76, -1.1190, [13.3545, -8.1668, -0.5889]),
    33: (240, -0.3993, [8.3292, 1.0055, 0.2552]),
    70: (392, -0.0502, [2.7070, -2.3354, 0.7513]),
}


def test_five_people_by_seed():
    for index, (count, height, head) in GOLDEN.items():
        sample = people("wild")[index].sample
        assert len(sample.points) == pytest.approx(count, abs=2)
        assert sample.box.center[2] == pytest.approx(height, abs=1e-3)
        np.testing.assert_allclose(sample.pose.joints[BODY26.index("head")], head, atol=1e-3)


# --- right in space


@pytest.mark.parametrize("scene", ["paper", "wild", "clean"])
def test_samples_are_whole(scene):
    for person in people(scene):
        sample = person.sample
        assert sample.pose.skeleton is BODY26 and sample.pose.frame == "sensor"
        assert np.isfinite(sample.points).all() and np.isfinite(sample.pose.joints).all()
        assert np.count_nonzero(sample.part) >= LEAST_POINTS and sample.part.max() <= len(SMPL24)
        assert sample.box.contains(sample.points, margin=1e-4).all()
        np.testing.assert_array_equal(sample.center, center_of(sample.points))
        kind, name, device = sample.source.split("/")
        assert kind == "synth" and device in SCENES[name].sensors and device == person.facts.sensor
        assert 0 <= sample.ring.min() and sample.ring.max() < len(sensor(device).elevations)


def bone_distance(points, joints, bones):
    """(n, bones) distances of points (n, 3) to segments."""
    a, b = joints[[p for p, _ in bones]], joints[[c for _, c in bones]]
    along = b - a
    t = ((points[:, None] - a) * along).sum(-1) / np.maximum((along**2).sum(-1), 1e-9)
    return np.linalg.norm(points[:, None] - a - np.clip(t, 0, 1)[..., None] * along, axis=-1)


def test_the_skeleton_lies_inside_the_points():
    gaps = []
    for person in people("clean"):
        sample = person.sample
        body = sample.points[sample.part > 0].astype(float)
        gap = bone_distance(body, sample.pose.joints, BODY26.bones).min(1)
        assert gap.max() < 0.25
        gaps.append(gap.mean())
        # seen from the sensor the surface lies before the bones
        low, high = body.min(0) - 0.3, body.max(0) + 0.3
        main = sample.pose.joints[: len(SMPL24)]
        assert ((main > low) & (main < high)).all(1).mean() > 0.75
    assert 0.04 < np.mean(gaps) < 0.12


def test_seen_surfaces_lie_before_the_bones():
    nearer = []
    for person in people("clean"):
        sample = person.sample
        chest = sample.part == 1 + SMPL24.index("spine3")
        if np.count_nonzero(chest) > 20:
            joint = sample.pose.joints[SMPL24.index("spine3")]
            nearer.append(np.linalg.norm(sample.points[chest], axis=1).mean() < np.linalg.norm(joint))
    assert len(nearer) > 30 and np.mean(nearer) > 0.9


def test_feet_stand_on_the_ground():
    feet = [BODY26.index(f"{side}_foot") for side in ("left", "right")]
    height = sensor("dapt64").height
    upright = 0
    for person in people("clean"):
        # the paper's sensor stands at a fixed height above the soles
        above = person.sample.pose.joints[:, 2] + height
        assert -0.01 < above.min() < 0.2
        assert above.max() < 2.6
        body = person.sample.points[person.sample.part > 0, 2] + height
        assert body.min() > -0.1
        if person.facts.upright:
            upright += 1
            assert above[feet].min() < 0.16
            assert above[BODY26.index("head")] > 0.6
    assert upright > 30


@pytest.mark.parametrize("name", ["hand", "wrist", "elbow", "knee", "ankle", "foot", "hip", "shoulder"])
def test_parts_carry_the_name_of_the_nearer_side(name):
    right = total = 0
    for person in people("clean") + people("wild"):
        sample = person.sample
        ends = {side: sample.pose.joints[BODY26.index(f"{side}_{name}")] for side in ("left", "right")}
        # crossed or clasped limbs say nothing
        if np.linalg.norm(ends["left"] - ends["right"]) < (0.08 if name == "hip" else 0.25):
            continue
        for side, other in (("left", "right"), ("right", "left")):
            points = sample.points[sample.part == 1 + SMPL24.index(f"{side}_{name}")]
            near, far = (np.linalg.norm(points - ends[s], axis=1) for s in (side, other))
            right += np.count_nonzero(near < far)
            total += len(points)
    assert total > 100
    # a thigh is long: crossed legs bring it to the other hip
    assert right / total > (0.94 if name == "hip" else 0.97)


def test_a_part_lies_about_the_bones_of_its_joint():
    of_joint = {j: [] for j in range(len(SMPL24))}
    for person in people("clean"):
        joints = person.sample.pose.joints
        for j, gaps in of_joint.items():
            points = person.sample.points[person.sample.part == 1 + j]
            bones = [bone for bone in BODY26.bones if j in bone]
            if len(points):
                gaps.append(bone_distance(points.astype(float), joints, bones).min(1))
    for j, gaps in of_joint.items():
        gap = np.concatenate(gaps)
        assert np.quantile(gap, 0.98) < (0.3 if "spine" in SMPL24.joints[j] else 0.2), SMPL24.joints[j]


def test_left_is_left():
    """A person who stands upright and looks along +x' has the left hip at +y'."""
    nose, neck = BODY26.index("nose"), BODY26.index("head")
    count = 0
    for person in people("clean") + people("wild"):
        joints = person.sample.pose.joints
        ahead, up = joints[nose] - joints[neck], joints[BODY26.index("neck")] - joints[0]
        hips = joints[BODY26.index("left_hip")] - joints[BODY26.index("right_hip")]
        if person.facts.upright:
            count += np.cross(up, ahead) @ hips > 0
    assert count > 0.9 * sum(p.facts.upright for p in people("clean") + people("wild"))


def test_facts_say_what_is_seen():
    clean, wild, paper = (people(name) for name in ("clean", "wild", "paper"))
    assert all(p.facts.visible > 0.9 for p in clean)
    assert any(p.facts.plain for p in clean)
    # the mask keeps about 0.6 of the beams, and cuts nothing else in the paper's scene
    assert np.mean([p.facts.visible for p in paper]) == pytest.approx(0.6, abs=0.04)
    for person in (*clean, *wild, *paper):
        facts = person.facts
        assert 0 < facts.visible <= 1 and 0 <= facts.clutter < 1 and 0 < facts.height_seen < 1.3
    assert np.mean([p.facts.plain for p in wild]) < np.mean([p.facts.plain for p in clean])


def test_the_paper_s_distances():
    """Paper: uniform between 4 and 20 m. Somebody of too few returns comes nearer, so the far end thins a little."""
    distance = np.array([p.facts.distance for p in people("paper")])
    assert distance.min() >= 4 and distance.max() <= 20
    joints = np.array([p.sample.pose.joints[0, :2] for p in people("paper")])
    np.testing.assert_allclose(np.linalg.norm(joints, axis=1), distance, atol=1.0)
    azimuth = np.arctan2(joints[:, 1], joints[:, 0])
    assert {int(a) for a in np.floor(azimuth / (np.pi / 4))} == set(range(-4, 4))


# --- scenes


@pytest.mark.parametrize("name", SCENES)
def test_distances_keep_their_range(name):
    config, rng = SCENES[name], np.random.default_rng(0)
    for device in map(sensor, config.sensors):
        drawn = np.array([draw_distance(config, device, rng) for _ in range(300)])
        assert drawn.min() >= config.distance[0] and drawn.max() <= config.distance[1]
        if name == "paper":
            assert drawn.mean() == pytest.approx(12, abs=1) and np.ptp(drawn) > 15


def test_the_paper_s_preset_is_the_paper_s():
    paper = scene_config("paper")
    assert (paper.distance, paper.keep, paper.mask, paper.sensors) == ((4.0, 20.0), 0.6, 1.0, ("dapt64",))
    device = sensor("dapt64")
    assert len(device.elevations) == 64 and device.columns in (2649, 2650)
    corners = ground(paper, np.random.default_rng(0)).vertices
    np.testing.assert_allclose(np.abs(corners[:, :2]), 1.0, atol=1e-6)
    with pytest.raises(InputError, match="unknown scene 'papr'"):
        scene_config("papr")


def test_the_ground_tilts_as_configured():
    rng = np.random.default_rng(1)
    tilts = []
    for _ in range(400):
        corners = ground(SCENES["paper"], rng).vertices.astype(float)
        normal = np.cross(corners[1] - corners[0], corners[3] - corners[0])
        tilts.append(np.arccos(normal[2] / np.linalg.norm(normal)))
        np.testing.assert_allclose(corners.mean(0), 0, atol=1e-6)
    # the absolute value of a normal law of 5 degrees
    assert np.degrees(np.mean(tilts)) == pytest.approx(5 * np.sqrt(2 / np.pi), abs=0.4)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(2, 40), st.floats(0.4, 2.1))
def test_a_sensor_is_mounted_so_that_the_person_fits(seed, distance, tall):
    device = sensor("os1-128")
    height = draw_height(device, distance, tall, rng=np.random.default_rng(seed), cut=0.0)
    low, high = distance * np.tan(device.elevations[[0, -1]])
    if high - low > tall:
        # the head may be cut only where the feet would be
        assert -height >= low - 1e-9
    else:
        assert -height + tall / 2 == pytest.approx((low + high) / 2)


def test_easy_scenes_hold_nothing_but_the_person():
    easy, rng = SCENES["wild"].eased(0.0), np.random.default_rng(2)
    feet = np.array([8.0, 3.0, -1.5])
    assert all(occluder(easy, feet, 1.7, rng) is None for _ in range(50))
    assert all(surroundings(easy, feet, 0.4, rng) == [] for _ in range(50))
    hard = [occluder(SCENES["wild"], feet, 1.7, rng) for _ in range(400)]
    assert np.mean([thing is not None for thing in hard]) == pytest.approx(SCENES["wild"].occluder, abs=0.07)


def test_occluders_stand_between_sensor_and_person_on_the_ground():
    rng, feet = np.random.default_rng(3), np.array([8.0, 3.0, -1.5])
    always = replace(SCENES["wild"], occluder=1.0)
    for _ in range(200):
        vertices = occluder(always, feet, 1.7, rng).vertices
        middle = vertices.mean(0)
        assert 0.4 < middle[:2] @ feet[:2] / (feet[:2] @ feet[:2]) < 0.95
        assert vertices[:, 2].min() == pytest.approx(feet[2], abs=1e-5)


def test_surroundings_are_near_and_no_person():
    rng, feet = np.random.default_rng(4), np.array([8.0, 3.0, -1.5])
    always = replace(SCENES["wild"], clutter=1.0)
    counts = []
    for _ in range(100):
        things = surroundings(always, feet, 0.4, rng)
        counts.append(len(things))
        for thing in things:
            assert np.linalg.norm(thing.vertices[:, :2].mean(0) - feet[:2]) < 1.6
            assert thing.vertices[:, 2].min() >= feet[2] - 1e-5
    assert set(counts) == {1, 2, 3}


# --- meshes


def volume(mesh):
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(float) for k in range(3))
    return (np.cross(a, b) * c).sum() / 6


def test_a_box_is_closed_and_faces_outwards():
    mesh = box(np.array([2.0, 3.0, 4.0]))
    assert volume(mesh) == pytest.approx(24, rel=1e-6)
    np.testing.assert_allclose(mesh.vertices.min(0), [-1, -1.5, 0])
    edges = [tuple(sorted(e)) for f in mesh.faces.tolist() for e in ((f[0], f[1]), (f[1], f[2]), (f[2], f[0]))]
    assert all(edges.count(e) == 2 for e in set(edges))


def test_a_prism_stands_on_the_origin():
    mesh = prism(0.5, 2.0, sides=40)
    assert mesh.vertices[:, 2].min() == 0 and mesh.vertices[:, 2].max() == 2
    # open at the bottom, which lies in the plane of the origin and adds nothing to the integral
    assert volume(mesh) == pytest.approx(np.pi * 0.25 * 2, rel=0.01)


def test_meshes_move_and_join_without_touching_their_parts():
    a, b = quad(1.0, np.zeros(2)), box(np.ones(3))
    kept = a.vertices.copy()
    moved = a.moved(np.array([1.0, 2, 3]), np.pi / 2)
    np.testing.assert_allclose(moved.vertices[0], [1 + 1, 2 - 1, 3], atol=1e-6)
    both = union([moved, b])
    np.testing.assert_array_equal(both.faces[2:], b.faces + 4)
    np.testing.assert_array_equal(both.vertices[4:], b.vertices)
    np.testing.assert_array_equal(a.vertices, kept)
    assert isinstance(both, Mesh) and both.faces.dtype == np.int32


# --- the laser-level mask


@settings(max_examples=80, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 90), st.integers(1, 70), st.floats(0, 1))
def test_the_mask_is_made_of_square_patches_of_the_paper_s_size(seed, columns, rows, keep):
    mask = laser_mask(columns, rows, keep=keep, rng=np.random.default_rng(seed))
    assert mask.shape == (columns, rows) and mask.dtype == bool
    patch = max(min(columns, rows) // 8, 1)
    kept = total = 0
    for i in range(0, columns, patch):
        for j in range(0, rows, patch):
            cell = mask[i : i + patch, j : j + patch]
            assert cell.all() or not cell.any()
            kept += cell.any()
            total += 1
    assert kept == int(total * keep)


def test_the_mask_keeps_about_its_share_of_the_beams():
    rng = np.random.default_rng(5)
    for columns, rows in ((77, 61), (39, 27), (20, 9), (5, 30)):
        share = np.mean([laser_mask(columns, rows, keep=0.6, rng=rng).mean() for _ in range(300)])
        assert share == pytest.approx(0.6, abs=0.02)


def test_the_mask_of_a_window_without_beams_is_empty():
    assert laser_mask(0, 0, keep=0.6, rng=np.random.default_rng(0)).shape == (0, 0)
