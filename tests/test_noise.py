"""Noise of points, laser grids and boxes: determinism and statistics."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from reference.sensor_noise import intensity_loss, lose_returns_reference

from lidarpose.geometry import rotation_about, unit
from lidarpose.lidar.presets import sensor
from lidarpose.lidar.raycast import Hits
from lidarpose.sample import Box
from lidarpose.synth import noise
from lidarpose.synth.environment.mesh import Mesh
from lidarpose.synth.noise import draw_box, laser_mask
from lidarpose.synth.noise_kernels import lose_returns
from lidarpose.synth.place import Place
from lidarpose.synth.scene import SCENES
from lidarpose.synth.simulate import REACH, ScanConditions, add_sensor_noise

RNG = np.random.default_rng
seeds = st.integers(0, 2**32 - 1)


def calls(n):
    """n points, their parts, and every augmentation by name, as a function of the generator."""
    rng = RNG(0)
    points, part = np.array([8.0, 1, 0]) + rng.normal(0, 0.4, (n, 3)), rng.integers(0, 25, n).astype(np.uint8)
    return (points, part), {
        "random_keep": lambda rng: noise.random_keep(n, share=0.2, rng=rng),
        "half_space_keep": lambda rng: noise.half_space_keep(points, most=0.9, rng=rng),
        "direction_mask": lambda rng: noise.direction_mask(points, keep=0.6, rng=rng),
        "part_removal": lambda rng: noise.part_removal(part, rng=rng),
        "jitter": lambda rng: noise.jitter(points, sigma=0.01, clip=0.02, rng=rng),
        "dapt_clusters": lambda rng: noise.dapt_clusters(points.mean(0), rng=rng),
        "noise_clusters": lambda rng: noise.noise_clusters(points.mean(0), most=150, rng=rng),
    }


@pytest.mark.parametrize("name", calls(1)[1])
def test_noise_functions_keep_input_and_are_deterministic(name):
    arrays, functions = calls(200)
    before = [array.copy() for array in arrays]
    first, again, other = (functions[name](RNG(seed)) for seed in (1, 1, 2))
    for array, copy in zip(arrays, before, strict=True):
        np.testing.assert_array_equal(array, copy)
    np.testing.assert_array_equal(first, again)
    assert first.shape != other.shape or (first != other).any()
    # empty input is allowed
    if "clusters" not in name:
        assert len(calls(0)[1][name](RNG(0))) == 0


@pytest.mark.parametrize("most", [0, 1, 100])
def test_noise_clusters_are_one_or_two_small_blobs(most):
    center, rng, sizes = np.array([3.0, -7, 0.5]), RNG(6), []
    for _ in range(400):
        clutter = noise.noise_clusters(center, most=most, rng=rng)
        sizes.append(len(clutter))
        assert clutter.shape[1:] == (3,) and len(clutter) <= 2 * most
        assert (np.abs(clutter - center) <= np.array([0.4, 0.4, 0.8]) + 0.3).all()
        # the blob of the first point is within its diameter; all other points belong to the second blob
        left = clutter
        for _ in range(2):
            left = left[np.linalg.norm(left - left[:1], axis=1) > 0.6]
        assert len(left) == 0
    # one or two blobs of 0 to `most` points
    assert np.mean(sizes) == pytest.approx(0.75 * most, rel=0.12) and max(sizes) >= 1.1 * most


@settings(max_examples=60, deadline=None)
@given(seeds, st.lists(st.integers(0, 24), max_size=60))
def test_part_removal_removes_exactly_one_present_part(seed, part):
    part = np.array(part, np.uint8)
    keep = noise.part_removal(part, rng=RNG(seed))
    assert keep.dtype == bool and keep.shape == part.shape
    gone = set(part[~keep])
    assert len(gone) == part.any() and 0 not in gone and not set(part[keep]) & gone


def test_part_removal_draws_uniformly_over_parts():
    part, rng = np.array([0, 3, 3, 3, 7, 24], np.uint8), RNG(7)
    first = [int(part[~noise.part_removal(part, rng=rng)][0]) for _ in range(300)]
    assert sorted(set(first)) == [3, 7, 24] and first.count(3) / 300 == pytest.approx(1 / 3, abs=0.1)


def test_jitter_is_normal_and_clipped():
    points = np.zeros((20000, 3))
    step = noise.jitter(points, sigma=0.005, clip=0.02, rng=RNG(8))
    np.testing.assert_allclose(step.std(0), 0.005, rtol=0.03)
    np.testing.assert_allclose(step.mean(0), 0, atol=2e-4)
    cut = noise.jitter(points, sigma=0.05, clip=0.02, rng=RNG(8))
    assert np.abs(cut).max() == 0.02
    assert (np.abs(cut) == 0.02).mean() == pytest.approx(0.689, abs=0.02)


# --- lost returns


def facing(points, degrees):
    """Normals at an angle of `degrees` to the beams of points (n, 3)."""
    beam = unit(points)
    angle = np.radians(degrees)
    return np.cos(angle) * beam + np.sin(angle) * unit(np.cross(beam, [0, 0, 1]))


def test_intensity_loss_follows_range_equation():
    near, far = np.array([[5.0, 0, 0]]), np.array([[60.0, 0, 0]])
    assert intensity_loss(far, facing(far, 0), range_max=120)[0] == pytest.approx(0.5)
    assert intensity_loss(near, facing(near, 60), range_max=120)[0] < 1e-3
    # power decreases with range and with angle of incidence
    ranges, angles = np.linspace(1, 80, 20)[:, None] * [1.0, 0, 0], np.linspace(0, 90, 20)
    by_range = intensity_loss(ranges, facing(ranges, 30), range_max=100)
    by_angle = [intensity_loss(far, facing(far, angle), range_max=100)[0] for angle in angles]
    assert (np.diff(by_range) > 0).all() and (np.diff(by_angle) > 0).all() and by_angle[-1] <= 1
    # equal power: a quarter of the range at an angle with cosine 1/16
    slanted = intensity_loss(near * 4, facing(near, np.degrees(np.arccos(1 / 16))), range_max=100)
    assert slanted[0] == pytest.approx(intensity_loss(near * 16, facing(near, 0), range_max=100)[0])


def test_random_keep_removes_given_share():
    assert noise.random_keep(20000, share=0.3, rng=RNG(11)).mean() == pytest.approx(0.7, abs=0.015)
    assert noise.random_keep(50, share=0.0, rng=RNG(11)).all()


# --- sensor noise and its compiled routine


def surface(seed, n=300):
    """A mesh of random triangles about 8 m away, and hits on n of its faces."""
    rng = RNG(seed)
    corners = np.array([8.0, 1, 0]) + rng.normal(0, 0.5, (40, 3, 3))
    mesh = Mesh(corners.reshape(-1, 3).astype(np.float32), np.arange(120, dtype=np.int32).reshape(40, 3))
    face = rng.integers(0, 40, n).astype(np.int32)
    weight = rng.dirichlet(np.ones(3), n)
    points = (mesh.vertices[mesh.faces[face]] * weight[..., None]).sum(1).astype(np.float32)
    ring = rng.integers(0, 64, n).astype(np.int32)
    return mesh, Hits(points=points, face=face, column=face, ring=ring, columns=0, rows=0, column0=0, row0=0)


@pytest.mark.long
@settings(max_examples=60, deadline=None)
@given(seeds, st.floats(0, 0.9), st.floats(0, 1), st.floats(1, 300))
def test_lose_returns_matches_reference(seed, dropout, weak, range_max):
    mesh, hits = surface(seed)
    rng = RNG(seed)
    keep, chance = rng.random(len(hits.face)) < 0.8, rng.random(len(hits.face))
    error = rng.normal(0, 0.03, len(hits.face))
    losses = dict(dropout=dropout, intensity_dropout=weak, range_max=range_max)
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces[hits.face]].astype(float), 1, 0)
    normals = unit(np.cross(b - a, c - a))
    slow, slow_kept = lose_returns_reference(hits.points.astype(float), normals, keep, error, chance, **losses)
    fast, fast_kept = lose_returns(
        *(hits.points, hits.face, mesh.vertices, mesh.faces, keep, error, chance, dropout, weak, REACH * range_max)
    )
    np.testing.assert_array_equal(fast_kept, slow_kept)
    np.testing.assert_allclose(fast, slow, atol=2e-6)
    # a surface of zero area returns nothing if weak returns are lost
    flat = np.full_like(mesh.vertices, 5.0), mesh.faces, np.ones_like(keep), error, np.full_like(chance, 0.99)
    assert len(lose_returns(hits.points, hits.face, *flat, 0.0, 1.0, 50.0)[0]) == 0


PERFECT = replace(sensor("os1-64"), dropout=0.0, range_max=100.0)


def test_add_sensor_noise_of_perfect_sensor_is_identity():
    mesh, hits = surface(1)
    copy = hits.points.copy()
    moved, kept = add_sensor_noise(hits, mesh, PERFECT, ScanConditions(), RNG(0))
    np.testing.assert_array_equal(kept, np.arange(len(copy)))
    np.testing.assert_allclose(moved, copy, atol=1e-6)
    np.testing.assert_array_equal(hits.points, copy)
    empty = replace(hits, points=hits.points[:0], face=hits.face[:0], ring=hits.ring[:0])
    noisy = ScanConditions(sigma=0.1, bias=0.1, intensity_dropout=1.0, one_sided=0.1)
    points, kept = add_sensor_noise(empty, mesh, replace(PERFECT, dropout=0.5), noisy, RNG(0))
    assert points.shape == (0, 3) and kept.shape == (0,)


def test_add_sensor_noise_has_configured_range_errors():
    mesh, hits = surface(2, n=20000)

    def error(**noise):
        moved, _ = add_sensor_noise(hits, mesh, PERFECT, ScanConditions(**noise), RNG(3))
        return np.linalg.norm(moved.astype(float), axis=1) - np.linalg.norm(hits.points.astype(float), axis=1)

    own = error(sigma=0.02)
    assert own.std() == pytest.approx(0.02, rel=0.03) and abs(own.mean()) < 6e-4
    shared = error(bias=0.01)
    of_ring = np.array([shared[hits.ring == r].mean() for r in range(64)])
    np.testing.assert_allclose(shared, of_ring[hits.ring], atol=2e-6)
    assert of_ring.std() == pytest.approx(0.01, rel=0.3)
    outwards = error(one_sided=0.02)
    assert outwards.min() > -2e-6 and outwards.max() < 0.0201
    assert outwards.mean() == pytest.approx(0.01, rel=0.03)


def test_intensity_dropout_is_half_at_half_range_max():
    """Of surfaces that face the sensor; see `REACH`."""
    vertices = np.array([[50, -1, -1], [50, 1, -1], [50, 0, 2]], np.float32)
    mesh, count = Mesh(vertices, np.array([[0, 1, 2]], np.int32)), 4000
    zeros = np.zeros(count, np.int32)
    points = np.tile(np.float32([50, 0, 0]), (count, 1))
    wall = Hits(points=points, face=zeros, column=zeros, ring=zeros, columns=0, rows=0, column0=0, row0=0)
    points, _ = add_sensor_noise(wall, mesh, PERFECT, ScanConditions(intensity_dropout=1.0), RNG(0))
    assert len(points) / count == pytest.approx(0.5, abs=0.03)


# --- clutter points, cuts, masks without a grid


def test_dapt_clusters_match_released_distribution():
    center = np.array([3.0, -7, 0.5])
    draws = [noise.dapt_clusters(center, rng=RNG(seed)) for seed in range(300)]
    sizes = np.array([len(d) for d in draws])
    assert sizes.mean() == pytest.approx(149, rel=0.06) and sizes.max() > 200
    assert all((np.abs(d - center) <= np.array([0.7, 0.7, 1.1])).all() for d in draws)
    # uniform in radius and polar angle: half of the points are within half the radius, more than in a uniform ball
    lone = [d for d in draws if 40 < len(d)]
    spread = np.concatenate([np.linalg.norm(d[:20] - np.median(d[:20], 0), axis=1) for d in lone])
    assert np.median(spread) < 0.19 and spread.max() > 0.25


@settings(max_examples=60, deadline=None)
@given(seeds, st.floats(0, 0.9), st.integers(1, 200))
def test_half_space_keep_leaves_some_points(seed, most, n):
    rng = RNG(seed)
    keep = noise.half_space_keep(rng.normal(size=(n, 3)), most=most, rng=rng)
    assert keep.shape == (n,) and keep.any() and (most > 0 or keep.all())


def test_half_space_keep_cuts_straight_edge_up_to_share():
    # for a sphere, the centers of both sides of a plane are on its normal
    points = unit(RNG(0).normal(size=(4000, 3)))
    keep = noise.half_space_keep(points, most=0.9, rng=RNG(12))
    assert 0.05 < (~keep).mean() < 0.95
    along = points @ unit(points[keep].mean(0) - points[~keep].mean(0))
    assert along[~keep].max() - along[keep].min() < 0.12
    # a plane cuts the same share of a sphere's surface as of its extent
    rng = RNG(1)
    lost = np.array([1 - noise.half_space_keep(points, most=0.4, rng=rng).mean() for _ in range(300)])
    assert lost.max() < 0.43 and lost.mean() == pytest.approx(0.2, abs=0.03) and lost.min() < 0.03


@settings(max_examples=80, deadline=None)
@given(seeds, st.floats(0, 0.9), st.floats(-3, 3))
def test_cut_box_is_inside_box_and_loses_one_side(seed, most, yaw):
    whole = Box(center=[4.0, 1, 0.2], size=[0.7, 0.9, 1.8], yaw=yaw, id="x")
    cut = noise.cut_box(whole, most=most, rng=RNG(seed))
    lost = 1 - cut.size / whole.size
    assert (lost >= -1e-12).all() and (lost > 1e-12).sum() <= 1 and lost.max() <= most + 1e-12
    assert cut.yaw == whole.yaw and cut.id == "x"
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    c, s = np.cos(yaw), np.sin(yaw)
    corners = cut.center + (signs * cut.size / 2) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    assert whole.contains(corners, margin=1e-9).all()
    # the other sides do not move
    assert not all(whole.contains(corner[None], margin=-1e-6)[0] for corner in corners)


def test_cut_box_cuts_feet_heads_and_sides():
    whole = Box(center=[4.0, 1, 0.2], size=[0.7, 0.9, 1.8], yaw=0.3)
    rng = RNG(5)
    cuts = [noise.cut_box(whole, rng=rng) for _ in range(600)]
    raised = np.mean([c.center[2] > 0.2 + 1e-9 for c in cuts])
    lowered = np.mean([c.center[2] < 0.2 - 1e-9 for c in cuts])
    assert raised == pytest.approx(1 / 3, abs=0.06) and lowered == pytest.approx(1 / 6, abs=0.05)


@settings(max_examples=60, deadline=None)
@given(seeds, st.floats(0, 1), st.floats(-np.pi, np.pi))
def test_direction_mask_keeps_share_in_patches(seed, keep, azimuth):
    rng = RNG(seed)
    angle = azimuth + rng.uniform(-0.1, 0.1, 4000)
    up = rng.uniform(-0.3, 0.3, 4000)
    beams = np.stack([np.cos(angle) * np.cos(up), np.sin(angle) * np.cos(up), np.sin(up)], 1) * 7
    kept = noise.direction_mask(beams, keep=keep, rng=rng)
    # 8 x 24 patches of equal numbers of beams, except at the rim
    assert kept.mean() == pytest.approx(keep, abs=0.06)
    if 0.2 < keep < 0.8:
        # neighboring beams are kept or removed together far more often than independent ones
        order = np.lexsort((up, (angle / 0.012).astype(int)))
        same = (kept[order][1:] == kept[order][:-1]).mean()
        assert same > keep**2 + (1 - keep) ** 2 + 0.15


def test_direction_mask_accepts_single_beams_and_lines():
    rng = RNG(0)
    assert noise.direction_mask(np.array([[1.0, 0, 0]]), keep=1.0, rng=rng).all()
    line = np.column_stack([np.ones(500), np.linspace(-0.2, 0.2, 500), np.zeros(500)])
    assert noise.direction_mask(line, keep=0.5, rng=rng).mean() == pytest.approx(0.5, abs=0.05)


# --- the laser-level mask of a grid


@settings(max_examples=80, deadline=None)
@given(seeds, st.integers(1, 90), st.integers(1, 70), st.floats(0, 1))
def test_laser_mask_has_square_patches_of_paper_size(seed, columns, rows, keep):
    mask = laser_mask(columns, rows, keep=keep, rng=RNG(seed))
    assert mask.shape == (columns, rows) and mask.dtype == bool
    patch = max(min(columns, rows) // 8, 1)
    cells = [mask[i : i + patch, j : j + patch] for i in range(0, columns, patch) for j in range(0, rows, patch)]
    assert all(cell.all() or not cell.any() for cell in cells)
    assert sum(cell.any() for cell in cells) == int(len(cells) * keep)


def test_laser_mask_keeps_share_of_beams():
    rng = RNG(5)
    for columns, rows in ((77, 61), (39, 27), (20, 9), (5, 30)):
        share = np.mean([laser_mask(columns, rows, keep=0.6, rng=rng).mean() for _ in range(300)])
        assert share == pytest.approx(0.6, abs=0.02)
    # a window without beams
    assert laser_mask(0, 0, keep=0.6, rng=RNG(0)).shape == (0, 0)


# --- boxes with the errors of detectors

BODY = np.array([[x, y, z] for x in (-0.2, 0.3) for y in (-0.35, 0.35) for z in (0.0, 1.7)], np.float32)
EXTENT = (BODY.min(0).tolist(), BODY.max(0).tolist())
WILD = SCENES["wild"].crop


PLACE = Place(feet=np.array([6.0, -2.0, -1.5]), yaw=0.7, distance=6.3)
EXACT = replace(WILD, jitter=1e-9, loose=0.0, cut=0.0)


def boxes(errors, rng, n, difficulty=1.0):
    return [draw_box(errors, difficulty, EXTENT, PLACE, rng) for _ in range(n)]


@settings(max_examples=50, deadline=None)
@given(seeds, st.floats(-3, 3), st.floats(-3, 3))
def test_draw_box_without_errors_contains_body(seed, yaw, heading):
    where = replace(PLACE, yaw=yaw)
    body = BODY @ rotation_about("z", heading).T
    box = draw_box(EXACT, 1.0, EXTENT, where, RNG(seed), heading=heading)
    local = (where.of_body(body) - box.center) @ rotation_about("z", box.yaw)
    # except the bottom edge, which may be above the soles
    assert (np.abs(local[:, :2]) <= box.size[:2] / 2 + 1e-5).all() and local[:, 2].max() <= box.size[2] / 2 + 1e-5
    assert (box.size[:2] < [0.5 + 0.26, 0.7 + 0.26]).all()


def test_draw_box_bottom_is_above_soles_or_below_ground():
    bottom = np.array([box.center[2] - box.size[2] / 2 + 1.5 for box in boxes(EXACT, RNG(0), 600)])
    assert 0.05 < (bottom > 0).mean() < 0.3 and 0.15 < (bottom < -0.15).mean() < 0.5
    assert bottom.min() > -0.5 and bottom.max() < 0.2


def test_draw_box_has_configured_errors():
    rng = RNG(1)
    yaw = np.array([box.yaw for box in boxes(replace(WILD, loose=0.0, cut=0.0), rng, 800)]) - PLACE.yaw
    assert abs(yaw.std() - WILD.jitter) < 0.01 and abs(yaw.mean()) < 0.01
    loose = boxes(WILD, rng, 800, difficulty=0.0)
    assert abs(np.mean([box.size[0] > 0.5 + 0.3 for box in loose]) - WILD.loose) < 0.04


def test_draw_box_jitter_is_halved_in_z():
    found = boxes(replace(EXACT, jitter=1.0), RNG(1), 800)
    center, top = np.array([box.center for box in found]), [box.center[2] + box.size[2] / 2 for box in found]
    np.testing.assert_allclose(center[:, :2].std(0), 1.0, atol=0.08)
    assert np.std(top) == pytest.approx(0.5, abs=0.05)


def test_draw_box_has_minimum_size():
    flat = ([-0.02, -0.01, 0.0], [0.02, 0.01, 0.1])
    sizes = [draw_box(EXACT, 1.0, flat, PLACE, RNG(seed)).size for seed in range(50)]
    assert np.min(sizes) == 0.4


def test_draw_box_cuts_increase_with_difficulty():
    rng, always = RNG(2), replace(EXACT, cut=1.0)
    easy, hard = (np.array([box.size for box in boxes(always, rng, 400, difficulty)]) for difficulty in (0.0, 1.0))
    assert easy[:, 2].min() > 1.5
    # a cut removes 15 % of the height or of a side on average, of the height in half of the cases
    lost = 1 - hard.mean(0) / easy.mean(0)
    assert 0.04 < lost[2] < 0.12 and 0.02 < lost[1] < 0.09 and 0.005 < lost[0] < 0.06


def test_draw_box_can_be_cut_or_loose_without_jitter():
    exact = replace(WILD, jitter=0.0, loose=0.0, cut=0.0)
    errors = {"none": exact, "cut": replace(exact, cut=1.0), "loose": replace(exact, loose=1.0)}
    sizes = {name: np.array([box.size for box in boxes(value, RNG(2), 200)]) for name, value in errors.items()}
    assert (sizes["none"] > 4).all() and (sizes["cut"] < 2.5).all()
    assert sizes["cut"].mean() < sizes["loose"].mean() - 0.2 and (sizes["loose"] < 4).all()


def test_draw_box_of_paper_scene_cuts_nothing():
    (box,) = boxes(SCENES["paper"].crop, RNG(3), 1)
    assert box.contains(PLACE.of_body(BODY.astype(float))).all() and (box.size > 4).all()
