"""Acquisition conditions: merged sensors, accumulated frames, inverted mounts, sparse sensors, crowded crops."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from lidarpose.body.pose_prior.activities import KINDS, UNUSUAL, unusual_mix
from lidarpose.errors import InputError
from lidarpose.geometry import rotation_about
from lidarpose.lidar.presets import sensor
from lidarpose.sample import SEEN, Box, LabeledSample
from lidarpose.skeleton import BODY26
from lidarpose.synth import generator, simulate as simulate_module
from lidarpose.synth.acquisition import MOST_FRAMES, Acquisition, draw_acquisition
from lidarpose.synth.bodies import draw_bodies, draw_moving_bodies
from lidarpose.synth.generator import BLOCK, Generator
from lidarpose.synth.noise import box_of_two
from lidarpose.synth.place import draw_place
from lidarpose.synth.scene import SCENES
from lidarpose.synth.simulate import simulate
from lidarpose.synth.views import with_views
from lidarpose.train.augment import Augmentation, add_disturbances, augmented

SEED = 11
WILD, WIDE = SCENES["wild"], SCENES["wide"]
# flat ground, no masked points, no slope, no clothes
CLEAN = replace(
    SCENES["paper"],
    sensors=("os1-64",),
    noise=replace(SCENES["paper"].noise, mask=0.0),
    slope=0.0,
    clothes=0.0,
    distance=(4.0, 8.0),
)
SHARES = ("merged", "accumulated", "inverted", "integration", "sparse", "crowded")


def drawn(config, acquisition, bodies, row, block=None, seed=0):
    """A random scene without sensor noise."""
    scene = generator._draw_scene(
        config, bodies, row, block or bodies, row, 1.0, np.random.default_rng(seed), acquisition
    )
    exact = {"conditions": replace(scene.conditions, sigma=0.0, bias=0.0, intensity_dropout=0.0)}
    views = tuple(replace(view, scene=replace(view.scene, **exact)) for view in scene.views)
    return replace(scene, **exact, views=views)


def walkers(count):
    """Moving bodies that walk and end at the origin."""
    everybody = draw_moving_bodies(None, 0.0, 40, MOST_FRAMES, np.random.default_rng(3), to_last=True)
    return [one for one in everybody if one.kinds[0] == "walk" and one.joints[0, 0, 0] < -0.3][:count]


# --- shares of conditions


def test_people_without_conditions_equal_those_of_plain_scene():
    wide, wild = Generator(scene=replace(WIDE, unusual=0.0, box_window=0.0, apart=0.0)), Generator(scene=WILD)
    held = 0
    for index in range(64):
        person, same = wide.person(SEED, index), wild.person(SEED, index)
        if person.sample.conditions:
            held += 1
        else:
            np.testing.assert_array_equal(person.sample.points, same.sample.points)
            assert repr(person.facts) == repr(same.facts)
        assert not same.sample.conditions
        # no conditions at hard=0
        assert not wide.person(SEED, index, hard=0.0).sample.conditions
    assert 8 < held < 35
    again = pickle.loads(pickle.dumps(wide))
    for index in (BLOCK + 1, 5):
        np.testing.assert_array_equal(again.person(SEED, index).sample.points, wide.person(SEED, index).sample.points)


def test_unusual_poses_apply_to_clips_and_accumulated_frames():
    everybody = WIDE.changed(["unusual=1", "accumulated=0.5"])
    usual = {name for name, weight in zip(KINDS, UNUSUAL, strict=True) if not weight}
    generator = Generator(scene=everybody, measure=False)
    people = [generator.person(SEED, index).sample for index in range(24)]
    assert any("accumulated" in sample.conditions for sample in people)
    for block in (generator._bodies(SEED, 0), *generator._acquisitions(SEED, 0)[1].values()):
        assert not usual & set(block.kinds)
    assert len(generator.clip(SEED, 2, frames=3)) == 3
    shared = draw_bodies(None, 0.0, 2000, SEED, 0, moving=False, mix=unusual_mix(WIDE.unusual)).kinds
    assert 0.25 < np.mean([kind not in usual for kind in shared]) < 0.35


def test_draw_acquisition_matches_configured_shares():
    draws = np.random.default_rng(0).random((4000, generator.ACQUISITION_DRAWS))
    for hard in (1.0, 0.5):
        found = [name for one in draws for name in draw_acquisition(WIDE.eased(hard), one).conditions]
        shares = {name: found.count(name) / len(draws) for name in set(found)}
        # accumulated and integrated are drawn only if not merged; a fifth of the sensors are rosettes, a third of the
        # integration times are 0.1 s
        expected = {"merged": 0.06, "accumulated": 0.056, "inverted": 0.08, "sparse": 0.12, "crowded": 0.05}
        expected["integrated"] = 0.5 * 0.2 * 2 / 3 * 0.94 * 0.94 * (1 - 0.12 * hard)
        assert shares == pytest.approx({name: hard * share for name, share in expected.items()}, abs=0.012)
    counts = [len(draw_acquisition(replace(WILD, merged=1.0), one).sensors) for one in draws]
    assert set(counts) == {2, 3, 4}
    frames = [draw_acquisition(replace(WILD, accumulated=1.0), one) for one in draws]
    assert {one.frames for one in frames} == {2, 3, 4, 5} and max(one.speed for one in frames) < 15
    assert np.mean([one.speed > 0 for one in frames]) == pytest.approx(0.5, abs=0.03)


@pytest.mark.long
@pytest.mark.parametrize("name", SHARES)
def test_share_of_one_applies_condition_to_all_people(name):
    config = WILD.changed((f"{name}=1",))
    if name == "integration":
        config = replace(config, sensors=("livox-mid360",))
    people = [Generator(scene=config).person(SEED, index) for index in range(12 if name == "integration" else 6)]
    word = "integrated" if name == "integration" else name
    held = [word in person.sample.conditions for person in people]
    # a frame of a rosette has one of three integration times
    assert all(held) if name != "integration" else 3 < sum(held) < 12
    for person in people:
        sample, facts = person.sample, person.facts
        assert sample.source.split("/")[2] == facts.sensor and 0 < facts.visible <= 1
        assert sample.box.contains(sample.points, margin=1e-4).all()
        if name == "sparse":
            assert sensor(facts.sensor).rows <= 32 and facts.distance < 25.5
        if name == "merged":
            assert 2.5 < facts.distance < 15.5
    with pytest.raises(InputError, match=f"{name} must be between 0 and 1"):
        WILD.changed((f"{name}=1.5",))


# --- several sensors


@pytest.mark.long
def test_merged_clouds_cover_far_side_of_body():
    def far_side(config):
        """Mean share of the trunk's points behind its center, seen from the first sensor."""
        shares = []
        for index in range(30):
            sample = Generator(scene=config, measure=False).person(SEED, index).sample
            joints = sample.pose.joints
            middle = (joints[0] + joints[BODY26.index("neck")]) / 2
            trunk = sample.points[np.isin(sample.part, [1 + BODY26.index(f"spine{k}") for k in (1, 2, 3)])]
            away = middle[:2] / np.linalg.norm(middle[:2])
            shares.append(((trunk - middle)[:, :2] @ away > 0.06).mean())
        return np.mean(shares)

    single, merged = far_side(CLEAN), far_side(replace(CLEAN, merged=1.0))
    assert single < 0.08 and merged > 0.25


def test_merged_sensors_surround_and_hit_the_same_body():
    block = draw_bodies(None, 0.0, 8, SEED, 0)
    scene = drawn(CLEAN, Acquisition(sensors=("os1-64", "vlp-32c", "os1-64"), distance=(3.0, 15.0)), block, 2)
    angles = []
    for view in (*scene.views,):
        assert -1 <= view.lag <= 1 and 3 <= view.scene.place.distance <= 15
        # its frame has the axes of the first sensor's frame
        np.testing.assert_allclose(view.scene.place.feet + view.at, scene.place.feet, atol=1e-9)
        angles.append(np.arctan2(*-view.scene.place.feet[1::-1]))
    toward = np.arctan2(*-scene.place.feet[1::-1])
    assert np.sort(np.mod(np.array(angles) - toward, 2 * np.pi)) == pytest.approx([2.09, 4.19], abs=0.45)
    # without motion, all points lie on one body or on the ground
    still = replace(block, moved=lambda row: (block.vertices[row], block.joints[row]))
    scan = simulate(scene, still, 2, np.random.default_rng(0))
    body = scene.body_place.of_body(block.vertices[2])
    sight = [simulate(replace(scene, views=scene.views[:k]), still, 2, np.random.default_rng(0)) for k in range(3)]
    assert len(sight[0].points) < len(sight[1].points) < len(sight[2].points) == len(scan.points)
    on_body = scan.points[scan.part > 0]
    gap = np.linalg.norm(on_body[:, None] - body[None], axis=-1).min(1)
    # vertices are up to 5 cm apart
    assert gap.max() < 0.06
    np.testing.assert_allclose(scan.points[scan.part == 0, 2], scene.place.feet[2], atol=1e-3)


def test_merged_double_rate_sensors_give_two_scans():
    block = draw_bodies(None, 0.0, 8, SEED, 0)
    names = ("os1-64", "vlp-32c", "livox-mid360")
    once, twice = (
        drawn(replace(CLEAN, double_rate=share), Acquisition(sensors=names, distance=(3.0, 15.0)), block, 2)
        for share in (0.0, 1.0)
    )
    assert [view.scene.sensor.name for view in once.views] == ["vlp-32c", "livox-mid360"]
    assert [view.scene.sensor.name for view in twice.views] == ["vlp-32c", "vlp-32c", "livox-mid360"]
    first, second, rosette = twice.views
    assert abs(first.lag - second.lag) == pytest.approx(0.5) and max(abs(first.lag), abs(second.lag)) <= 1
    assert (
        first.scene.sensor is second.scene.sensor
        and first.scene.sensor.columns * 2 == once.views[0].scene.sensor.columns
    )
    assert rosette.scene.sensor is once.views[1].scene.sensor
    # the two scans have about as many points on the person as the single one
    counts = []
    for scene in (once, twice):
        scene = replace(scene, views=tuple(view for view in scene.views if view.scene.sensor.name == "vlp-32c"))
        counts.append((simulate(scene, block, 2, np.random.default_rng(0)).part > 0).sum())
    assert counts[1] == pytest.approx(counts[0], rel=0.3)


def test_scene_meshes_move_body_by_lag():
    block = draw_bodies(None, 0.0, 64, SEED, 0)
    row = block.kinds.index("walk")
    scene = drawn(CLEAN, Acquisition(), block, row)
    now, half, before = (scene.meshes(block, row, lag)[0].vertices for lag in (0.0, 0.5, -1.0))
    then = scene.body_place.of_body(block.moved(row)[0])
    np.testing.assert_allclose(half, (now + then) / 2, atol=1e-5)
    np.testing.assert_allclose(before, 2 * now - then, atol=1e-5)
    assert np.abs(half - now).max() > 0.02


# --- several frames


@pytest.mark.parametrize("speed", [0.0, 10.0])
def test_accumulated_frames_smear_only_moving_people(speed):
    wider = []
    for bodies in walkers(4):
        scene = drawn(CLEAN, Acquisition(sensors=("os1-64",), frames=5, speed=speed), bodies, MOST_FRAMES - 1)
        assert [view.earlier for view in scene.views] == [1, 2, 3, 4]
        np.testing.assert_allclose([view.at[0] for view in scene.views], -speed / 10 * np.arange(1, 5), atol=1e-9)
        one = simulate(replace(scene, views=()), bodies, MOST_FRAMES - 1, np.random.default_rng(0))
        scan = simulate(scene, bodies, MOST_FRAMES - 1, np.random.default_rng(0))
        # points of the last frame are those of the single scan
        np.testing.assert_array_equal(scan.points[: len(one.points)], one.points)
        np.testing.assert_allclose(scan.points[scan.part == 0, 2], scene.place.feet[2], atol=1e-3)
        ahead = rotation_about("z", scene.place.yaw)[:, 0]
        wide = [np.ptp(found.points[found.part > 0] @ ahead) for found in (one, scan)]
        way = bodies.joints[-1, 0, 0] - bodies.joints[0, 0, 0]
        wider.append((wide[1] - wide[0]) / way)
    assert np.mean(wider) > 0.4


def test_with_views_keeps_moving_sensor_away_from_person():
    (bodies,) = walkers(1)
    scene = drawn(CLEAN, Acquisition(sensors=("os1-64",), frames=5, speed=15.0), bodies, MOST_FRAMES - 1)
    for feet in ([-3.0, 0.2, -1.0], [3.0, 0.2, -1.0], [-3.0, 2.0, -1.0]):
        moved = replace(scene, place=replace(scene.place, feet=np.array(feet)))
        views = with_views(moved, CLEAN, 1.8, 0.5, 1.0, np.random.default_rng(0)).views
        assert min(view.scene.place.distance for view in views) > 1.5


def test_draw_moving_bodies_to_last_ends_at_origin():
    first, last = (
        draw_moving_bodies(None, 0.0, 6, 4, np.random.default_rng(4), to_last=to_last) for to_last in (False, True)
    )
    for a, b in zip(first, last, strict=True):
        assert b.heading[-1] == 0 and a.heading[0] == pytest.approx(0, abs=0.2)
        np.testing.assert_allclose(b.joints[-1, 0, :2], 0, atol=1e-5)
        # the same motion, rotated and translated
        turn = rotation_about("z", a.heading[-1])
        way = (a.joints - a.joints[-1, 0] * [1, 1, 0]) @ turn
        np.testing.assert_allclose(b.joints, way, atol=1e-4)


@pytest.mark.parametrize("frames", [2, 5])
def test_integration_multiplies_points_by_frames(frames):
    block = draw_bodies(None, 0.0, 16, SEED, 0)
    still = replace(
        block,
        vertices=block.vertices[:1].repeat(MOST_FRAMES, 0),
        joints=block.joints[:1].repeat(MOST_FRAMES, 0),
        moved=lambda row: (block.vertices[0], block.joints[0]),
    )
    counts = np.zeros(2)
    for seed in range(6):
        config = replace(CLEAN, sensors=("livox-mid360",), distance=(2.0, 5.0))
        acquisition = Acquisition(sensors=config.sensors, frames=frames)
        scene = drawn(config, acquisition, still, MOST_FRAMES - 1, block, seed)
        for k, one in enumerate((replace(scene, views=()), scene)):
            scan = simulate(one, still, MOST_FRAMES - 1, np.random.default_rng(0))
            counts[k] += np.count_nonzero(scan.part)
    assert counts[1] / counts[0] == pytest.approx(frames, rel=0.1)


# --- mounts


@pytest.mark.parametrize("name", ["vlp-32c", "hdl-64e", "livox-mid360", "livox-avia"])
def test_draw_place_inverted_flips_and_aims_sensor(name):
    device = sensor(name)
    for seed in range(40):
        rng = np.random.default_rng(seed)
        place = draw_place(replace(CLEAN, distance=(3.0, 12.0)), device, 1.7, 0.3, 1.0, rng, inverted=True)
        assert 2 <= -place.feet[2] <= 5
        # its z axis points down, possibly tilted toward the person
        R = place.R_sensor_level
        assert np.linalg.det(R) == pytest.approx(1) and R[2, 2] < 0
        azimuth = np.arctan2(place.feet[1], place.feet[0])
        elevation = []
        for height in (0.0, 0.85, 1.7):
            x, y, z = place.to_sensor((place.feet + [0, 0, height])[None])[0]
            elevation.append(np.arctan2(z, np.hypot(x, y)))
        # higher points are on lower rings
        assert elevation[0] > elevation[1] > elevation[2]
        middle = (device.elevations[0] + device.elevations[-1]) / 2
        fits = device.elevations[0] - 1e-9 <= elevation[2] and elevation[0] <= device.elevations[-1] + 1e-9
        # the elevation is approximate, because a pitch does not change all elevations equally
        assert fits or elevation[1] == pytest.approx(middle, abs=0.12)
        # left and right are exchanged, also if the sensor is pitched toward the person
        direction = R @ [np.cos(azimuth), np.sin(azimuth), 0]
        np.testing.assert_allclose(direction[:2] / np.hypot(*direction[:2]), [np.cos(azimuth), -np.sin(azimuth)])


def test_inverted_sensor_points_are_on_rings_and_upright():
    device = sensor("vlp-32c")
    block = draw_bodies(None, 0.0, 8, SEED, 0)
    scene = drawn(replace(CLEAN, sensors=("vlp-32c",)), Acquisition(inverted=True), block, 3)
    scan = simulate(scene, block, 3, np.random.default_rng(0))
    x, y, z = scene.place.to_sensor(scan.points.astype(float)).T
    np.testing.assert_allclose(np.arctan2(z, np.hypot(x, y)), device.elevations[scan.ring], atol=1e-5)
    body = scan.points[scan.part > 0]
    head, foot = (body[np.isin(scan.part[scan.part > 0], parts), 2] for parts in ([16], [8, 9, 11, 12]))
    assert head.min() > foot.max()
    # the lowest ring hits the highest points
    ring = scan.ring[scan.part > 0]
    assert np.corrcoef(ring, body[:, 2])[0, 1] < -0.9


# --- two people in one crop


@pytest.mark.long
def test_crowded_crops_keep_center_of_labeled_person():
    others = []
    for index in range(40):
        sample = Generator(scene=replace(WILD, crowded=1.0), measure=False).person(SEED, index).sample
        np.testing.assert_array_equal(sample.center, sample.box.center)
        others.append(np.count_nonzero(sample.part == 0))
        worse = add_disturbances(sample, strays=1.0, noise=1.0, rng=np.random.default_rng(index))
        assert worse is not sample
        np.testing.assert_array_equal(worse.center, sample.center)
        stored = LabeledSample(
            **{name: getattr(sample, name) for name in ("points", "center", "box", "source")},
            part=sample.part.astype(np.int16),
            pose=replace(sample.pose, visible=np.ones(26, np.float32)),
            joint_labels=np.full(26, SEEN, np.uint8),
        )
        shown = augmented(stored, Augmentation(pelvis_centered=0.0), np.random.default_rng(index))
        np.testing.assert_allclose(shown.joints, sample.pose.joints - sample.center, atol=1e-5)
    assert np.median(others) > 40


def seen_in(scene, block, row, box, window, **changes):
    """Number of beams that hit the second person, and of hits inside a box."""
    wider = replace(scene, config=replace(scene.config, **changes))
    hits, mesh = simulate_module._cast(wider, wider.meshes(block, row), 0, box=window)
    is_inside = box.contains(scene.place.to_level(hits.points))
    return np.count_nonzero(mesh.part[hits.face] == generator._OTHER), np.count_nonzero(is_inside)


@pytest.mark.parametrize("name", ["os1-64", "livox-mid360"])
@pytest.mark.parametrize("crowded", [True, False])
def test_beam_window_covers_box_and_second_person(name, crowded):
    block = draw_bodies(None, 0.0, 32, SEED, 0, moving=False)
    calm = replace(
        WIDE, sensors=(name,), distance=(3.0, 9.0), median_points=0, company=0.0, crop=replace(WIDE.crop, loose=1.0)
    )
    counts = []
    for row in range(16):
        scene = drawn(calm, Acquisition(sensors=(name,), crowded=crowded), block, row, seed=row)
        box = generator._box(scene, block, row, np.random.default_rng(row))
        windows = [(None, {}), (box, {}), (None, {"around": 3.0})]
        counts.append([seen_in(scene, block, row, box, window, **changes) for window, changes in windows])
    (others, inside), (window_others, window_inside), (all_others, all_inside) = np.sum(counts, 0)
    assert window_others == all_others and (all_others > 500) == crowded
    assert window_inside > 0.995 * all_inside > inside


@pytest.mark.parametrize("window", [0.0, 1.0])
def test_beam_window_uses_sample_box_in_every_scan(window, monkeypatch):
    boxes, from_feet, cast = [], [], simulate_module._cast

    def recorded(scene, meshes, frame, *, margin=0.0, box=None):
        boxes.append(box)
        if box is not None:
            from_feet.append(box.center - scene.place.feet)
        return cast(scene, meshes, frame, margin=margin, box=box)

    monkeypatch.setattr(simulate_module, "_cast", recorded)
    config = replace(WIDE, **dict.fromkeys(SHARES, 0.0), box_window=window)
    merged, clips = (
        Generator(scene=replace(config, merged=share), measure=False, redraw=False) for share in (1.0, 0.0)
    )
    for draw in (lambda: [merged.person(SEED, 0)], lambda: clips.clip(SEED, 0, frames=2)):
        boxes.clear()
        from_feet.clear()
        drawn_boxes = [person.sample.box for person in draw()]
        window_boxes = [box for box in boxes if box is not None]
        assert len(boxes) > 1 and bool(window_boxes) == bool(window)
        # other sensors have the box in their own frames
        assert {tuple(box.size) for box in window_boxes} == {tuple(box.size) for box in drawn_boxes if window}
        assert not window or np.array_equal(window_boxes[0].center, drawn_boxes[0].center)
        if window and len(drawn_boxes) == 1:
            np.testing.assert_allclose(from_feet, [from_feet[0]] * len(from_feet), atol=1e-9)


@pytest.mark.long
def test_apart_separates_second_person_from_first():
    """Along the line between them, vertices of the second person are behind nearby vertices of the first."""
    block, depths, ways = draw_bodies(None, 0.0, 64, SEED, 0, moving=False), {}, []
    for apart in (0.0, 1.0):
        config, depths[apart] = replace(CLEAN, apart=apart), []
        for row in range(40):
            scene = drawn(config, Acquisition(sensors=("os1-64",), crowded=True), block, row, seed=row)
            body, other = scene.meshes(block, row)[0].vertices, scene.background[-1].vertices
            near = other[((other > body.min(0)) & (other < body.max(0))).all(1)]
            ahead = other.mean(0)[:2] - body.mean(0)[:2]
            beyond = [
                (point[:2] - body[np.linalg.norm(body - point, axis=1) < 0.06, :2].mean(0)) @ ahead
                for point in near
                if (np.linalg.norm(body - point, axis=1) < 0.06).any()
            ]
            # share of the second person's vertices inside the first person's surface
            depths[apart].append(np.mean(np.array(beyond) < 0) * len(beyond) / len(other) if beyond else 0.0)
            ways.append(other.mean(0))
    assert np.mean(np.array(depths[0.0]) > 0.02) > 0.15 and np.mean(np.array(depths[1.0]) > 0.02) < 0.03
    moved = np.linalg.norm(np.array(ways[40:]) - ways[:40], axis=1)
    # people without overlap stay in place, others move only a little
    assert np.median(moved) < 0.15 and moved.max() < 1.2 and (moved == 0).sum() > 5


def test_box_of_two_contains_both_with_center_nearer_first():
    rng, shares = np.random.default_rng(0), []
    for _ in range(300):
        body, other = (rng.uniform(-1, 1, (50, 3)) * [0.3, 0.4, 0.9] + [9, 3, 0] for _ in range(2))
        angle, apart = rng.uniform(-np.pi, np.pi), rng.uniform(0.35, 0.8)
        other += apart * np.array([np.cos(angle), np.sin(angle), 0])
        size = np.ptp(body, axis=0) + 0.1
        errors = rng.normal(0, 0.1, 3)
        box = Box(center=np.array([9, 3, 0]) + errors, size=size, yaw=rng.uniform(-3, 3))
        grown = box_of_two(box, body, other, rng)
        assert grown.contains(np.concatenate([body, other])).all() and grown.yaw == box.yaw
        middles = [(one.min(0) + one.max(0))[:2] / 2 for one in (body, other)]
        near, far = (np.linalg.norm(grown.center[:2] - middle) for middle in middles)
        assert near < far
        way = middles[1] - middles[0]
        shares.append((grown.center[:2] - middles[0]) @ way / (way @ way))
        assert (grown.size >= box.size).all()
    assert max(shares) <= 0.4 + 1e-9 and np.std(shares) > 0.05
