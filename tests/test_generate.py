"""Synthetic people: determinism and spatial correctness."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from walkers import bone_distance

from lidarpose.body.rig import sample_people
from lidarpose.errors import InputError
from lidarpose.lidar.presets import sensor
from lidarpose.lidar.sensor import Sensor
from lidarpose.sample import center_of
from lidarpose.skeleton import BODY26, SMPL24
from lidarpose.synth import generator
from lidarpose.synth.bodies import draw_bodies, draw_moving_bodies
from lidarpose.synth.generator import BLOCK, LEAST_POINTS, Generator
from lidarpose.synth.scene import SCENES

SEED = 11
# no mask and no occluders: everything that a dense sensor sees of a person
CLEAN = replace(SCENES["paper"], noise=replace(SCENES["paper"].noise, mask=0.0), hard=0.0, distance=(4.0, 8.0))


@cache
def people(scene, count=96):
    maker = Generator(scene=CLEAN if scene == "clean" else SCENES[scene])
    return tuple(maker.person(SEED, index) for index in range(count))


def assert_same(a, b):
    for name in ("points", "part", "ring", "center"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    np.testing.assert_array_equal(a.pose.joints, b.pose.joints)
    np.testing.assert_array_equal(a.box.center, b.box.center)
    assert a.source == b.source


# --- determinism


@pytest.mark.parametrize("scene", ["paper", "wild"])
def test_generator_person_depends_only_on_seed_and_index(scene):
    known = Generator(scene=SCENES[scene], measure=False)
    maker = Generator(scene=SCENES[scene])
    # both ways across the border of two blocks, with other seeds in between
    for index in (BLOCK + 3, 0, 95, BLOCK - 1, 0):
        maker.person(SEED + 1, index)
        assert_same(maker.person(SEED, index).sample, known.person(SEED, index).sample)
    # facts do not change the sample
    for index in range(0, 96, 9):
        person = known.person(SEED, index)
        assert person.facts is None
        assert_same(person.sample, people(scene)[index].sample)


def test_generator_accepts_scene_names_and_numpy_integers():
    maker = Generator(scene="paper", measure=False)
    known = Generator(scene=SCENES["paper"], measure=False).person(SEED, 3)
    assert_same(maker.person(np.int64(SEED), np.int32(3)).sample, known.sample)
    for seed, index, word in ((-1, 0, "seed"), (0, -1, "index"), (0.5, 0, "seed"), ("1", 0, "seed")):
        with pytest.raises(InputError, match=f"^{word} must be a whole number of at least 0, got"):
            maker.person(seed, index)
    with pytest.raises(InputError, match="did you mean wild"):
        Generator(scene="wilt")
    with pytest.raises(InputError, match="must name at least one sensor"):
        replace(SCENES["wild"], sensors=())


@pytest.mark.parametrize(
    "changes, told",
    [
        ({"distance": (12, 4)}, r"SceneConfig.distance must be \(low, high\), got \(12, 4\)"),
        ({"distance": (np.nan, 3)}, "SceneConfig.distance must be two numbers of at least 0"),
        ({"distance": 5}, "SceneConfig.distance must be two numbers of at least 0, got 5"),
        ({"carry": "a"}, "SceneConfig.carry must be a number of at least 0, got 'a'"),
        ({"company": 2}, "SceneConfig.company must be a number from 0 to 1, got 2"),
        ({"slope": 5.0}, "SceneConfig.slope must be a number from 0 to 0.785 rad, got 5.0"),
    ],
)
def test_scene_config_rejects_invalid_values(changes, told):
    with pytest.raises(InputError, match=told):
        replace(SCENES["wild"], **changes)
    assert replace(SCENES["wild"], distance=[4, 12]).distance == (4, 12)
    with pytest.raises(InputError, match="noise must be a NoiseConfig"):
        replace(SCENES["wild"], noise=None)
    with pytest.raises(InputError, match="NoiseConfig.mask_keep must be two numbers from 0 to 1"):
        replace(SCENES["wild"].noise, mask_keep=(0.5, 1.5))


def test_generator_hard_argument_does_not_affect_other_people():
    maker = Generator(scene=SCENES["wild"])
    assert maker.person(SEED, 5, hard=0.0).facts.distance > 0
    for hard in (None, 1.0):
        assert_same(maker.person(SEED, 5, hard=hard).sample, people("wild")[5].sample)
    with pytest.raises(InputError, match="hard must be a number from 0 to 1, got 1.5"):
        maker.person(SEED, 5, hard=1.5)
    # different seeds and indices give different people
    points = {maker.person(seed, index).sample.points.tobytes() for seed in (1, 2, 3) for index in (0, 1, BLOCK)}
    assert len(points) == 9


def test_generator_adds_bicycles_and_seats_in_easy_scenes(monkeypatch):
    drawn, draw_scene = [], generator._draw_scene

    def spy(config, bodies, row, *others):
        scene = draw_scene(config, bodies, row, *others)
        drawn.append((bodies.kinds[row], {prop.name for prop in scene.props}))
        return scene

    monkeypatch.setattr(generator, "_draw_scene", spy)
    maker = Generator(scene=SCENES["wild"])
    kinds = maker._bodies(SEED, 0).kinds
    for row in [row for row, kind in enumerate(kinds) if kind in ("cycle", "sit")]:
        maker.person(SEED, row, hard=0.0)
    assert {kind for kind, _ in drawn} == {"cycle", "sit"}
    assert all("bicycle" in names for kind, names in drawn if kind == "cycle")
    seats = [bool(names & {"chair", "wheelchair"}) for kind, names in drawn if kind == "sit"]
    assert np.mean(seats) > 0.5


# --- spatial correctness


@pytest.mark.parametrize("scene", ["paper", "wild", "clean"])
def test_generator_samples_are_valid(scene):
    for person in people(scene):
        sample = person.sample
        assert sample.pose.skeleton is BODY26 and sample.pose.frame == "sensor"
        assert np.isfinite(sample.points).all() and np.isfinite(sample.pose.joints).all()
        assert np.count_nonzero(sample.part) >= LEAST_POINTS and sample.part.max() <= len(SMPL24)
        assert sample.box.contains(sample.points, margin=1e-4).all()
        np.testing.assert_array_equal(sample.center, center_of(sample.points))
        kind, name, device = sample.source.split("/")
        assert kind == "synth" and device in SCENES[name].sensors and device == person.facts.sensor
        beams = sensor(device)
        rings = beams.rows if isinstance(beams, Sensor) else beams.frame(0).line.max() + 1
        # points of clutter have no beam, and no part
        assert -1 <= sample.ring.min() and sample.ring.max() < rings and not sample.part[sample.ring < 0].any()


def test_generator_skeleton_is_inside_body_behind_surface():
    gaps, nearer = [], []
    for sample in (person.sample for person in people("clean")):
        body, joints = sample.points[sample.part > 0].astype(float), sample.pose.joints[: len(SMPL24)]
        gap = bone_distance(body, sample.pose.joints, BODY26.bones).min(1)
        assert np.quantile(gap, 0.99) < 0.28 and gap.max() < 0.32
        gaps.append(gap.mean())
        # seen from the sensor, the surface is in front of the bones
        low, high = body.min(0) - 0.3, body.max(0) + 0.3
        assert ((joints > low) & (joints < high)).all(1).mean() > 0.75
        chest = sample.part == 1 + SMPL24.index("spine3")
        if np.count_nonzero(chest) > 20:
            distance = np.linalg.norm(sample.points[chest], axis=1).mean()
            nearer.append(distance < np.linalg.norm(joints[SMPL24.index("spine3")]))
    assert 0.04 < np.mean(gaps) < 0.12
    assert len(nearer) > 30 and np.mean(nearer) > 0.9


def test_generator_feet_are_on_ground():
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
def test_generator_part_labels_match_nearer_side(name):
    right = total = 0
    for person in people("clean") + people("wild"):
        sample = person.sample
        ends = {side: sample.pose.joints[BODY26.index(f"{side}_{name}")] for side in ("left", "right")}
        # crossed or clasped limbs are ambiguous
        if np.linalg.norm(ends["left"] - ends["right"]) < (0.08 if name == "hip" else 0.25):
            continue
        for side, other in (("left", "right"), ("right", "left")):
            points = sample.points[sample.part == 1 + SMPL24.index(f"{side}_{name}")]
            near, far = (np.linalg.norm(points - ends[s], axis=1) for s in (side, other))
            right += np.count_nonzero(near < far)
            total += len(points)
    assert total > 100
    # crossed legs bring thighs and shanks close to the other side's joint
    assert right / total > (0.94 if name in ("hip", "knee") else 0.97)


def test_generator_part_points_are_near_their_bones():
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
        assert np.quantile(gap, 0.98) < (0.3 if "spine" in SMPL24.joints[j] else 0.21), SMPL24.joints[j]


def test_generator_left_hip_is_on_left_side():
    """A person who stands upright and looks along +x' has the left hip at +y'."""
    upright = [person.sample.pose.joints for person in people("clean") + people("wild") if person.facts.upright]
    at = {name: np.array(upright)[:, BODY26.index(name)] for name in ("nose", "head", "neck", "left_hip", "right_hip")}
    ahead, up = at["nose"] - at["head"], at["neck"] - np.array(upright)[:, 0]
    assert len(upright) > 60 and ((np.cross(up, ahead) * (at["left_hip"] - at["right_hip"])).sum(1) > 0).mean() > 0.9


def test_generator_facts_match_visibility_in_scenes():
    clean, wild, paper = (people(name) for name in ("clean", "wild", "paper"))
    assert all(p.facts.visible > 0.9 for p in clean)
    assert any(p.facts.plain for p in clean)
    # the mask keeps about 0.6 of the beams; the paper's scene hides nothing else
    assert np.mean([p.facts.visible for p in paper]) == pytest.approx(0.6, abs=0.04)
    for person in (*clean, *wild, *paper):
        facts = person.facts
        assert 0 < facts.visible <= 1 and 0 <= facts.clutter < 1 and 0 < facts.height_seen < 1.3
    assert np.mean([p.facts.plain for p in wild]) < np.mean([p.facts.plain for p in clean])


def test_paper_scene_distances():
    """Paper: uniform between 4 and 20 m. People with too few returns are moved nearer."""
    distance = np.array([p.facts.distance for p in people("paper")])
    assert 3.2 < distance.min() and distance.max() < 20.8
    # the centers of points and box are within half a body's width of that distance
    boxes = np.array([p.sample.box.center[:2] for p in people("paper")])
    points = np.array([np.median(p.sample.points[p.sample.part > 0], axis=0)[:2] for p in people("paper")])
    for places in (boxes, points):
        np.testing.assert_allclose(np.linalg.norm(places, axis=1), distance, atol=0.35)
    azimuth = np.arctan2(boxes[:, 1], boxes[:, 0])
    assert {int(a) for a in np.floor(azimuth / (np.pi / 4))} == set(range(-4, 4))


# --- clips


def test_generator_clip_is_one_moving_person():
    maker = Generator(scene=replace(SCENES["wild"], sensors=("os1-128",), distance=(4.0, 9.0)))
    lengths, steps = [], []
    for index in range(6):
        clip = maker.clip(SEED, index, frames=8)
        assert len(clip) == 8 and len({p.facts.kind for p in clip}) == 1
        joints = np.array([p.sample.pose.joints for p in clip])
        bones = np.array(BODY26.bones[: len(SMPL24) - 1])
        long = np.linalg.norm(joints[:, bones[:, 0]] - joints[:, bones[:, 1]], axis=-1)
        # constant bone lengths and human speeds
        np.testing.assert_allclose(long, np.broadcast_to(long[0], long.shape), atol=2e-3)
        steps.append(np.linalg.norm(np.diff(joints, axis=0), axis=-1).max())
        lengths.append(long[0].sum())
        for person in clip:
            assert person.sample.box.contains(person.sample.points, margin=1e-4).all()
    assert 0.01 < max(steps) < 1.2 and np.std(lengths) > 0.05
    other = Generator(scene=maker.scene)
    for a, b in zip(other.clip(SEED, 3, frames=8), maker.clip(SEED, 3, frames=8), strict=True):
        assert_same(a.sample, b.sample)
    with pytest.raises(InputError, match="at least 1"):
        maker.clip(SEED, 0, frames=0)


@pytest.mark.parametrize("which", [np.argmin, np.argmax], ids=["small", "tall"])
def test_draw_moving_bodies_feet_do_not_slide(which, monkeypatch):
    crowd = sample_people(np.random.default_rng(0), 200)
    one = crowd.coefficients[which(crowd.height)][None]
    monkeypatch.setattr("lidarpose.body.rig.sample_people", lambda rng, n: SimpleNamespace(coefficients=one))
    slides, walks = [], 0
    for seed in range(60):
        somebody = draw_moving_bodies(None, 0.0, 1, 8, np.random.default_rng(seed))[0]
        if somebody.kinds[0] == "walk":
            walks += 1
            feet = somebody.joints[:, [BODY26.index("left_foot"), BODY26.index("right_foot")], :2]
            # one foot stands at any time
            slides += np.linalg.norm(np.diff(feet, axis=0), axis=-1).min(1).tolist()
    assert walks > 3 and np.median(slides) < 0.02


def test_draw_bodies_moved_shifts_body_within_frame():
    """`moved` gives a person's pose at the end of a frame, for sensors that scan slowly."""
    block = draw_bodies(None, 0.0, BLOCK, SEED, 3)
    row = block.kinds.index("cycle") if "cycle" in block.kinds else block.kinds.index("walk")
    vertices, joints = block.moved(row)
    step = joints[0] - block.joints[row, 0]
    assert 0.02 < np.linalg.norm(step) < 0.6 and step[0] > 0.02
    assert vertices.shape == block.vertices[row].shape
    np.testing.assert_allclose(block.vertices[..., 2].min(1), 0, atol=1e-6)
    assert block.vertices.dtype == np.float32 and block.joints.shape == (BLOCK, 26, 3)
    still = draw_bodies(None, 0.0, BLOCK, SEED, 3, moving=False)
    np.testing.assert_allclose(still.moved(0)[0], still.vertices[0], atol=1e-5)
    np.testing.assert_allclose(still.vertices, block.vertices, atol=1e-5)
