"""Simulated scans of a person's scene: placement in each frame, returns of the sensor, and labels of points."""

from dataclasses import replace

import numpy as np
import pytest
from walkers import HEADINGS, bone_distance, goer, strider

from lidarpose.errors import InputError
from lidarpose.geometry import rotation_about
from lidarpose.lidar.presets import sensor
from lidarpose.sample import Pose, Sample
from lidarpose.skeleton import BODY26
from lidarpose.synth import generator, noise, simulate as simulate_module
from lidarpose.synth.environment.mesh import Mesh, box, quad
from lidarpose.synth.generator import Generator
from lidarpose.synth.place import Place
from lidarpose.synth.props.prop import rigid_prop
from lidarpose.synth.scene import SCENES, scene_config
from lidarpose.synth.simulate import (
    ScanConditions,
    Scene,
    SimulatedScan,
    count_alone,
    draw_conditions,
    label_box,
    scan_background,
    simulate_scan,
)

SEED = 11
PAPER = SCENES["paper"]
NO_NOISE = replace(PAPER.noise, mask=0.0)
PLAIN = replace(PAPER, noise=NO_NOISE)
CLEAN = replace(PLAIN, distance=(4.0, 8.0))
DAPT = replace(PLAIN, noise=replace(NO_NOISE, dapt_compat=True))
SIZE = np.array([0.4, 0.6, 1.2])
PARTS = np.arange(1, 13, dtype=np.uint8)


def scene(device="dapt64", azimuth=0.4, mount=None, config=PLAIN, props=(), **conditions):
    """A scene for a box-shaped person 6 m from a sensor without noise, except for `conditions`."""
    feet = np.array([6 * np.cos(azimuth), 6 * np.sin(azimuth), -0.5])
    return Scene(
        config=config, sensor=sensor(device), conditions=ScanConditions(**conditions), background=[],
        place=Place(feet=feet, yaw=azimuth, distance=6.0, R_sensor_level=mount), props=list(props),
    )  # fmt: skip


def body(where):
    mesh = box(SIZE)
    return Mesh(where.place.of_body(mesh.vertices), mesh.faces, PARTS)


def scan(where, *things, seed=0):
    return simulate_scan(where, [body(where), *things], np.random.default_rng(seed))


def local(points, where):
    """Points in the frame of the box."""
    c, s = np.cos(where.place.yaw), np.sin(where.place.yaw)
    return (points.astype(float) - where.place.feet) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


@pytest.mark.parametrize("tilt", [0.0, 0.1, 0.3])
def test_points_lie_on_surface_for_any_mount(tilt):
    mount = rotation_about("x", 0.03) @ rotation_about("y", -tilt) if tilt else None
    where = scene("os1-64", 0.2, mount)
    seen = scan(where)
    assert len(seen.points) > 60 and seen.points.dtype == np.float32
    there = local(seen.points, where)
    assert np.abs((np.abs(there - [0, 0, SIZE[2] / 2]) - SIZE / 2).max(1)).max() < 1e-4
    # the side that faces the sensor
    assert np.median(there[:, 0]) == pytest.approx(-SIZE[0] / 2, abs=1e-4)
    # its two triangles
    assert len(np.unique(seen.part)) >= 2 and seen.part.min() >= 1


@pytest.mark.parametrize("dapt_compat", [True, False])
def test_range_noise_is_one_sided_with_dapt_compat(dapt_compat):
    where = scene(one_sided=0.02) if dapt_compat else scene(sigma=0.01)
    there = local(scan(where, seed=1).points, where)
    error = (there[:, 0] + SIZE[0] / 2)[np.abs(there[:, 1]) < 0.25]
    assert len(error) > 200
    if dapt_compat:
        assert error.min() > -1e-3 and error.max() < 0.0201 and error.mean() == pytest.approx(0.01, abs=0.002)
    else:
        assert abs(error.mean()) < 0.002 and error.std() == pytest.approx(0.01, abs=0.002)


def test_dapt_compat_casts_beams_at_seam_twice():
    at_seam, elsewhere = (
        [len(scan(scene(azimuth=azimuth, config=config)).points) for config in (PLAIN, DAPT)]
        for azimuth in (np.pi, 1.0)
    )
    # one column of a box 1.2 m tall at 5.8 m
    assert 20 < at_seam[1] - at_seam[0] < 50 and elsewhere[0] == elsewhere[1]


def test_occluder_hides_body_and_is_not_labeled():
    where = scene()
    feet = where.place.feet
    wall = box(np.array([0.1, 3.0, 0.6])).moved(feet * [0.6, 0.6, 1], where.place.yaw)
    ground = quad(1.0, np.zeros(2)).moved(feet)
    alone, seen = scan(where), scan(where, wall, ground)
    assert 0.2 < np.count_nonzero(seen.part) / len(alone.points) < 0.9
    assert np.count_nonzero(seen.part == 0) > 50
    # beams reach the body only above the edge of the wall
    assert seen.points[seen.part > 0][:, 2].min() > feet[2] + 0.55
    assert count_alone(where, body(where), 0) == len(alone.points)


def test_beam_divergence_widens_silhouette():
    lines, wide = (len(scan(scene("os1-128", divergence=d)).points) for d in (0.0, 0.003))
    assert lines < wide < 1.15 * lines


def test_mask_keeps_given_share_of_points():
    whole = len(scan(scene()).points)
    shares = [len(scan(scene(keep=0.6), seed=k).points) / whole for k in range(60)]
    assert np.mean(shares) == pytest.approx(0.6, abs=0.02) and np.std(shares) > 0.005


def test_draw_conditions_follows_preset_and_difficulty():
    rng, device, noise = np.random.default_rng(5), sensor("os1-64"), SCENES["wild"].noise
    paper = [draw_conditions(PAPER, device, rng) for _ in range(50)]
    assert {c.keep for c in paper} == {0.6} and {c.intensity_dropout for c in paper} == {0.0}
    assert {c.sigma for c in paper} == {device.range_sigma} and {c.divergence for c in paper} == {0.0}
    wild = [draw_conditions(SCENES["wild"], device, rng) for _ in range(600)]
    assert np.mean([c.keep < 1 for c in wild]) == pytest.approx(noise.mask, abs=0.06)
    assert min(c.keep for c in wild) >= noise.mask_keep[0]
    assert np.mean([c.divergence > 0 for c in wild]) == pytest.approx(noise.beam_divergence, abs=0.06)
    easy = [draw_conditions(SCENES["wild"].eased(0.0), device, rng) for _ in range(100)]
    assert {c.keep for c in easy} == {1.0}


def test_scan_window_has_margin_of_scene():
    def width(margin):
        where = scene(azimuth=0.0, config=replace(PLAIN, margin=margin))
        points = scan(where, quad(1.0, np.zeros(2)).moved(where.place.feet)).points
        return np.ptp(np.arctan2(points[:, 1], points[:, 0]))

    assert width(0.05) - width(0.0) == pytest.approx(0.1, abs=0.006)


def test_ground_window_includes_ground(monkeypatch):
    """Eq. 3: the window spans the angles of the vertices of body and ground; the mask uses the same window."""
    asked = []
    real = simulate_module.laser_mask
    monkeypatch.setattr(
        simulate_module, "laser_mask", lambda *window, **how: asked.append(window) or real(*window, **how)
    )
    device, windows = sensor("dapt64"), {}
    for config in (PLAIN, PLAIN.changed(("ground_window=1",))):
        where = scene(config=config, keep=0.999)
        ground = quad(1.0, np.array([0.05, 0.02])).moved(where.place.feet)
        where = replace(where, background=[ground])
        scan(where, ground)
        both = np.concatenate([body(where).vertices, ground.vertices if config.ground_window else ground.vertices[:0]])
        low, high = (
            end(np.stack([np.arctan2(both[:, 1], both[:, 0]), np.arctan2(both[:, 2], np.hypot(*both[:, :2].T))]), 1)
            for end in (np.min, np.max)
        )
        columns = (high[0] - low[0]) / device.azimuth_step
        rows = np.count_nonzero((device.elevations >= low[1]) & (device.elevations <= high[1]))
        (window,) = asked
        assert abs(window[0] - columns) <= 1 and window[1] == rows
        windows[config.ground_window] = asked.pop()
    assert windows[1.0][0] > 1.5 * windows[0.0][0]
    # the body has the same points, and the ground more
    alone, paper = (
        Generator(scene=PAPER.changed(("keep=1", f"ground_window={k}")), measure=False).person(SEED, 2).sample
        for k in (0, 1)
    )
    assert np.count_nonzero(alone.part) == np.count_nonzero(paper.part) > 20
    assert np.count_nonzero(paper.part == 0) > 1.5 * np.count_nonzero(alone.part == 0)


@pytest.mark.parametrize("yaw", [0.0, 0.8, 4.0])
def test_label_box_encloses_body_with_margin(yaw):
    corners = np.array([[x, y, z] for x in (-0.2, 0.4) for y in (-0.3, 0.3) for z in (0.0, 1.7)])
    label = label_box(corners @ rotation_about("z", yaw).T + [5.0, 2.0, -1.0], yaw, 3)
    np.testing.assert_allclose(label.size, [0.7, 0.7, 1.8])
    np.testing.assert_allclose(label.center, rotation_about("z", yaw) @ [0.1, 0, 0.85] + [5.0, 2.0, -1.0])
    assert label.yaw == pytest.approx((yaw + np.pi) % (2 * np.pi) - np.pi) and label.id == 3


def test_scan_background_shows_static_meshes_behind_person():
    where = scene()
    feet = where.place.feet
    wall, other = (box(np.array([0.1, 4.0, 2.0])).moved(feet * [k, k, 1], where.place.yaw) for k in (1.5, 1.2))
    ground = quad(1.0, np.zeros(2)).moved(feet)
    where = replace(where, background=[ground, wall, other], still=2)
    points = scan_background(where, body(where), 0)
    depth = local(points, where)[:, 0]
    # only the ground is in front of the wall: the other person, the last mesh, is not static
    is_ground = np.abs(points[:, 2] - feet[2]) < 1e-3
    assert np.abs(depth[~is_ground] - 2.95).max() < 0.01 and (~is_ground).sum() > 500
    # the window is a degree wider than the body on each side
    azimuth, body_azimuth = (np.arctan2(xyz[:, 1], xyz[:, 0]) for xyz in (points, body(where).vertices))
    np.testing.assert_allclose(
        np.degrees([azimuth.min() - body_azimuth.min(), azimuth.max() - body_azimuth.max()]), [-1, 1], atol=0.15
    )


# --- people and their surroundings


def test_points_of_other_people_are_not_labeled():
    maker, strangers = Generator(scene=replace(CLEAN, company=1.0, margin=0.1), measure=False), 0
    for index in range(12):
        sample = maker.person(SEED, index).sample
        own = sample.points[sample.part > 0].astype(float)
        assert bone_distance(own, sample.pose.joints, BODY26.bones).min(1).max() < 0.32
        above = sample.points[sample.part == 0][:, 2] > sample.pose.joints[:, 2].min() + 0.4
        strangers += np.count_nonzero(above) > 10
    assert strangers >= 6


def test_difficulty_zero_disables_occlusion_and_noise():
    def config(share):
        wild = replace(SCENES["wild"], sensors=("os1-64",), distance=(4.0, 8.0), company=share, carry=share)
        return replace(wild, noise=replace(wild.noise, clutter=share, missing_part=share))

    never, always = (Generator(scene=config(share), measure=False) for share in (0.0, 1.0))
    differ = 0
    for index in range(4):
        a, b = (maker.person(SEED, index, hard=0.0).sample for maker in (never, always))
        np.testing.assert_array_equal(a.points, b.points)
        np.testing.assert_array_equal(a.part, b.part)
        differ += len(always.person(SEED, index, hard=1.0).sample.points) != len(b.points)
    assert differ >= 2


@pytest.mark.parametrize("dapt_compat", [False, True])
def test_clutter_points_are_unlabeled_and_follow_preset(dapt_compat, monkeypatch):
    laws = {False: "noise_clusters", True: "dapt_clusters"}
    monkeypatch.setattr(noise, laws[dapt_compat], lambda center, rng, **more: center + rng.uniform(-0.1, 0.1, (7, 3)))
    monkeypatch.setattr(noise, laws[not dapt_compat], None)
    scenes = [replace(CLEAN, noise=replace(NO_NOISE, clutter=share, dapt_compat=dapt_compat)) for share in (0.0, 1.0)]
    for index in range(3):
        bare, cluttered = (Generator(scene=scene, measure=False).person(SEED, index).sample for scene in scenes)
        assert len(cluttered.points) == len(bare.points) + 7 and len(cluttered.ring) == len(cluttered.part)
        np.testing.assert_array_equal(cluttered.points[cluttered.part > 0], bare.points[bare.part > 0])


# --- moving people in clips


def at_the_hip(points):
    x, y, z = points[0]
    return [[1, 0, 0], [0, 1, 0], [0, 0, 1]], [x, y, z]


CLOTH = rigid_prop("cloth", box((0.1, 0.1, 0.1)), at_the_hip, face_part=np.full(12, 5, np.uint8))
STAND = rigid_prop("stand", box((0.1, 0.1, 0.1)), at_the_hip, lift=0.25)


def test_props_move_with_person_and_only_clothes_are_labeled():
    actor, where = goer(), scene(props=[CLOTH, STAND])
    for frame in range(3):
        person, cloth, thing = where.meshes(actor, frame)
        np.testing.assert_array_equal(person.part, actor.face_part)
        np.testing.assert_array_equal(cloth.part, CLOTH.face_part)
        assert thing.part is None
        hip = where.body_place.of_body(actor.joints[frame][:1])[0] + [0, 0, 0.05]
        for mesh in (cloth, thing):
            np.testing.assert_allclose(mesh.vertices.mean(0), hip, atol=1e-5)


def test_body_is_lifted_by_highest_prop():
    low = rigid_prop("low", box((0.1, 0.1, 0.1)), at_the_hip, lift=0.1)
    where = scene(props=[CLOTH, low, STAND])
    np.testing.assert_allclose(where.body_place.feet, where.place.feet + [0, 0, 0.25])


@pytest.mark.parametrize("props", [(), (STAND,)], ids=["on the ground", "lifted"])
def test_pose_box_and_body_of_frame_agree(props):
    tight = replace(PAPER, crop=replace(SCENES["wild"].crop, jitter=1e-9, loose=0.0, cut=0.0))
    actor, where = goer(), scene(config=tight, props=props)
    for frame, heading in enumerate(HEADINGS):
        person = where.meshes(actor, frame)[0].vertices
        seen = SimulatedScan(points=person, ring=np.zeros(8, np.int32), part=np.ones(8, np.uint8))
        for seed in range(4):
            sample = generator._crop(where, actor, frame, seen, np.random.default_rng(seed))
            assert abs((sample.box.yaw - where.place.yaw - heading + np.pi) % (2 * np.pi) - np.pi) < 1e-6
            assert (sample.box.size[:2] < [0.3 + 0.26, 0.9 + 0.26]).all()
            # the bottom of the box may lie above the soles
            assert sample.box.contains(person + [0, 0, 0.3] * (person[:, 2:] < 0.2)).all()
            joints = where.place.of_body(actor.joints[frame]) + [0, 0, 0.25 if props else 0.0]
            np.testing.assert_allclose(sample.pose.joints, joints, atol=1e-5)


@pytest.mark.parametrize("lag", [0.0, -0.4])
def test_rosette_pose_is_at_middle_of_frame(lag):
    actor = strider([0.3, 0.1, 0.0])
    at_once, over_time = (
        scene(name, 0.16, config=CLEAN, props=[CLOTH]).meshes(actor, 0, lag) for name in ("dapt64", "livox-avia")
    )
    assert len(over_time) == 2 and all(mesh.later is None for mesh in at_once)
    c, s = np.cos(0.16), np.sin(0.16)
    for there, mesh in zip(at_once, over_time, strict=True):
        np.testing.assert_allclose((mesh.vertices + mesh.later) / 2, there.vertices, atol=1e-5)
        way = np.broadcast_to([c * 0.3 - s * 0.1, s * 0.3 + c * 0.1, 0.0], mesh.vertices.shape)
        np.testing.assert_allclose(mesh.later - mesh.vertices, way, atol=1e-5)
    stood = scene("dapt64", 0.16, config=CLEAN).meshes(actor, 0)[0].vertices.mean(0)
    np.testing.assert_allclose(at_once[0].vertices.mean(0) - stood, lag * way[0], atol=1e-5)


@pytest.mark.parametrize("name", ["livox-avia", "livox-mid360", "livox-mid100"])
def test_rosette_points_are_centered_on_pose(name):
    actor = strider([0.3, 0.0, 0.0])
    where = scene(name, 0.16, config=CLEAN)
    points = np.concatenate(
        [simulate_scan(where, where.meshes(actor, 0), np.random.default_rng(0), frame=k).points for k in range(4)]
    )
    # the visible back of a person who walks away is a plane, smeared by half a step in both directions
    along = local(points, where)[:, 0] + 0.15
    back = along[np.abs(along) < 0.16]
    assert len(back) > 300 and abs(back.mean()) < 0.02 and np.ptp(back) > 0.08


@pytest.mark.parametrize("azimuth", [0.5, -0.5, 2.6, -2.6])
def test_stacked_sensors_see_person_half_a_turn_apart(azimuth):
    """The lower sensor is half a turn late on one side and early on the other; the pose is at the middle time."""
    actor, step = strider([0.4, 0.0, 0.0]), 0.4
    where = scene("av2", azimuth, config=CLEAN)
    scan_result = simulate_scan(where, where.meshes(actor, 0), np.random.default_rng(0))
    # the back of a person who walks away: each sensor sees a plane
    along = local(scan_result.points, where)[:, 0] + 0.15
    is_late = where.sensor.ring_lags[scan_result.ring] > 0
    first, second = (np.median(along[own & (np.abs(along) < 0.14)]) for own in (~is_late, is_late))
    assert min(is_late.sum(), (~is_late).sum()) > 50
    side = 1 if azimuth < 0 else -1
    assert (first, second) == pytest.approx((-side * step / 4, side * step / 4), abs=0.01)
    twice = replace(where, sensor=replace(where.sensor, turn_time=0.05))
    quick, slow = (
        np.ptp([np.mean(v[:, :2], 0) for v in (m.vertices, m.later)], axis=0)
        for m in (twice.meshes(actor, 0)[0], where.meshes(actor, 0)[0])
    )
    np.testing.assert_allclose(2 * quick, slow, atol=1e-5)


@pytest.mark.parametrize("left", [0.0, 1.0])
def test_stacked_sensors_order_follows_person_across_seam(left):
    """Behind the sensor, the lower sensor is half a turn late on one side of its x axis and early on the other."""
    where, actor, way = scene("av2", 3.1, config=CLEAN), strider([0.4, 0.0, 0.0]), np.float32([0.0, left, 0.0])
    aside = replace(
        actor,
        vertices=actor.vertices + way,
        joints=actor.joints + way,
        moved=lambda frame: tuple(array + way for array in actor.moved(frame)),
    )
    mesh, pelvis = where.meshes(aside, 0)[0], where.place.of_body(aside.joints[0, :1])[0]
    assert (pelvis[1] < 0) == bool(left)
    # the person walks away from the sensor, along -x
    assert (mesh.later[:, 0].mean() < mesh.vertices[:, 0].mean()) == bool(left)


@pytest.mark.parametrize("azimuth", [0.5, -0.5])
def test_scan_window_covers_moving_body(azimuth):
    counts = []
    for margin in (0.0, 0.1):
        where = scene("av2", azimuth, config=replace(CLEAN, margin=margin, around=0.0))
        where = replace(where, sensor=replace(where.sensor, dropout=0.0))
        meshes = where.meshes(strider([1.0, 1.0, 0.0]), 0)
        counts.append(len(simulate_scan(where, meshes, np.random.default_rng(0)).points))
    assert counts[0] == counts[1] > 100


def test_bodies_of_stacked_sensors_move_within_frame():
    bodies = Generator(scene=replace(CLEAN, sensors=("av2",)))._bodies(SEED, 0)
    row = bodies.kinds.index("walk")
    assert bodies.between(row, 0.25)[1][0, 0] - bodies.joints[row, 0, 0] > 0.01


def test_rosette_pattern_continues_in_next_frame():
    actor, where = goer(still=True), scene("livox-avia", 0.16, config=CLEAN)
    first, again, second = (
        generator._draw_sample(where, actor, frame, frame, np.random.default_rng(0)).points for frame in (0, 0, 1)
    )
    np.testing.assert_array_equal(first, again)
    assert len(second) > 50 and (first.shape != second.shape or np.abs(first - second).max() > 0.01)


def test_clutter_counts_unlabeled_points_above_ground(monkeypatch):
    monkeypatch.setattr(generator, "count_alone", lambda scene, body, frame: 8)
    # the soles are at -0.5 m, the body is 1.7 m tall
    z = np.array([-0.5, -0.45, 0.1, 0.6, 0.1, 0.9, 0.4, -0.375], np.float32)
    part = np.array([0, 0, 0, 0, 1, 2, 3, 4], np.uint8)
    pose = Pose(joints=np.zeros((26, 3)), skeleton=BODY26)
    sample = Sample(points=np.stack([0 * z + 5, 0 * z, z], 1), center=np.zeros(3), part=part, pose=pose)
    info = generator._measure(sample, scene(), goer(), 0, 0)
    assert info.clutter == 2 / 8 and info.visible == 4 / 8 and info.height_seen == pytest.approx(0.75)
    assert info.sensor == "dapt64" and info.kind == "walk" and not info.upright


# --- further attempts


def test_generator_retries_nearer_and_easier_and_keeps_best(monkeypatch):
    seen, counts = [], iter([3, 9, 5, 0, 2, 8, 1, 4])

    def draw_scene(config, bodies, first, block, row, nearer, rng, acquisition):
        seen.append((config.hard, nearer))
        return len(seen) - 1

    def draw_sample(attempt, bodies, row, frame, rng):
        count = next(counts)
        points = np.full((count, 3), attempt, np.float32)
        return Sample(points=points, center=np.zeros(3), part=np.ones(count, np.uint8))

    monkeypatch.setattr(generator, "_draw_scene", draw_scene)
    monkeypatch.setattr(generator, "_draw_sample", draw_sample)
    person = Generator(scene=PAPER, measure=False).person(SEED, 0)
    np.testing.assert_allclose(seen, [(1 - k / 7, 0.8**k) for k in range(8)], atol=1e-12)
    assert len(person.sample.points) == 9 and (person.sample.points == 1).all()


def test_scene_presets_match_paper_and_released_code():
    paper, reference = (scene_config(name) for name in ("paper", "reference"))
    assert (paper.distance, paper.sensors) == ((4.0, 20.0), ("dapt64",)) and reference.distance == (5.0, 20.0)
    assert np.degrees([paper.margin, reference.margin]) == pytest.approx([0, 1.8])
    for config, clutter in ((paper, 0.0), (reference, 0.5)):
        assert (config.noise.mask, config.noise.mask_keep) == (1.0, (0.6, 0.6))
        assert config.noise.clutter == config.noise.missing_part == clutter
        assert config.noise.dapt_compat == bool(clutter)
    assert sensor("dapt64").rows == 64 and sensor("dapt64").columns in (2649, 2650)
    with pytest.raises(InputError, match="unknown scene 'papr'"):
        scene_config("papr")
