"""Detection of people: the ground under a scan, proposals, and the network's inputs at candidates."""

import pickle
import tracemalloc
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, strategies as st
from reference.detector_reference import context_reference, fine_reference, range_reference, suppress_near_reference

from lidarpose.geometry import rotation_about
from lidarpose.models.detector import proposals
from lidarpose.models.detector.candidates import SceneIndex, suppress_near
from lidarpose.models.detector.ground import estimate_ground, estimate_up, without_ground
from lidarpose.models.detector.proposals import columns, heights_above, propose
from lidarpose.models.detector.render import CandidateAugmentation, render
from lidarpose.synth.street import street
from lidarpose.train.detector.candidate_source import draw_augmentation

ORIGIN = np.zeros(3)


def plane(*, slope=(0.0, 0.0), height=-1.8, reach=20.0, step=0.25, noise=0.02, seed=0):
    """Points of a sloping plane around the sensor."""
    side = np.arange(-reach, reach, step)
    x, y = (values.ravel() for values in np.meshgrid(side, side))
    rng = np.random.default_rng(seed)
    return np.stack([x, y, height + slope[0] * x + slope[1] * y + rng.normal(0, noise, len(x))], 1)


def column(x, y, *, ground=-1.8, height=1.75, count=150, radius=0.2, seed=1):
    """Points of an upright cylinder with a narrow head, similar to a person."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, 2 * np.pi, count)
    z = ground + rng.uniform(0.02, height, count)
    radius = np.where(z > ground + height - 0.25, radius / 2, radius)
    return np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle), z], 1)


def sitter(x, y, *, ground=-1.8):
    """Points of a sitting person who faces -x: body, lap and legs."""
    lap = box([x - 0.4, y - 0.15, ground + 0.4], [x, y + 0.15, ground + 0.55], count=40)
    legs = box([x - 0.45, y - 0.15, ground + 0.05], [x - 0.35, y + 0.15, ground + 0.45], count=30)
    return np.concatenate([column(x, y, ground=ground + 0.45, height=0.85, count=80), lap, legs])


def box(low, high, *, count=2000, seed=2):
    """Points on the sides and the top of an upright box."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(low, high, (count, 3))
    axis = rng.choice([0, 1, 2], count)
    points[np.arange(count), axis] = np.where(
        (axis == 2) | (rng.random(count) < 0.5), np.array(high)[axis], np.array(low)[axis]
    )
    return points


def nearest(centers, x, y):
    return np.hypot(centers[:, 0] - x, centers[:, 1] - y).min(initial=np.inf)


@pytest.fixture(scope="module")
def scene():
    frame = street(5, 0, sensor="hdl-32e", people=(8, 12)).frames[0]
    # noise, because rays at regular angles are on the borders of cells
    points = frame.points + np.random.default_rng(0).normal(0, 0.01, frame.points.shape)
    return frame, points, estimate_ground(points, ORIGIN)


# --- ground


@pytest.mark.parametrize("height", [-0.3, -1.8, -6.0])
@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.12, -0.05), (0.0, 0.25)])
def test_estimate_ground_of_plane_with_objects(height, slope):
    points = plane(slope=slope, height=height)
    on_it = [
        box([4, -1, height + 8 * slope[0]], [8, 1, height + 1.5 + 8 * slope[0]]),
        column(-6, 2, ground=height - 6 * slope[0] + 2 * slope[1]),
    ]
    ghosts = np.array([[3.0, 9, height - 4], [3.1, 9, height - 4.02]])
    ground = estimate_ground(np.concatenate([points, *on_it, ghosts]), ORIGIN)
    at = np.array([[0.0, 0], [6, 0], [-6, 2], [3, 9], [-15, -15]])
    assert np.abs(ground.at(at) - (height + at @ slope)).max() < 0.2


def test_estimate_ground_extrapolates_plane():
    points = plane(slope=(0.05, 0.0))
    away = np.hypot(points[:, 0], points[:, 1])
    ring = points[(away > 7) & (away < 15)]
    hood = box([0.5, -0.8, -1.0], [2.2, 0.8, -0.8])
    ground = estimate_ground(np.concatenate([ring, hood]), ORIGIN)
    at = np.array([[0.0, 0], [1.5, 0], [3, 3]])
    assert np.abs(ground.at(at) - (-1.8 + 0.05 * at[:, 0])).max() < 0.15
    # constant beyond the border
    np.testing.assert_allclose(ground.at(np.array([[1000.0, 0]])), ground.at(np.array([[500.0, 0]])))


def test_estimate_ground_finds_indoor_floor():
    floor = plane(reach=4, height=-1.1, step=0.1)
    things = [
        plane(reach=4, height=1.5, step=0.1),
        box([0, 0, -0.4], [1.6, 0.8, -0.35]),
        box([-3, 1, -1.1], [-1, 2, -0.6]),
    ]
    hidden = (floor[:, 0] > 0) & (floor[:, 0] < 1.6) & (floor[:, 1] > 0) & (floor[:, 1] < 0.8)
    ground = estimate_ground(np.concatenate([floor[~hidden], *things]), ORIGIN)
    assert np.abs(ground.at(np.array([[0.8, 0.4], [-2, 1.5], [0, -2]])) + 1.1).max() < 0.12


@pytest.mark.parametrize("spread", [0.0, 0.05])
def test_estimate_ground_ignores_small_patch_far_below(spread):
    """As mirrored by a shiny floor, or seen through a stairwell."""
    patch = np.stack(np.meshgrid(np.linspace(2.1, 3.9, 4), np.linspace(2.1, 3.9, 4), [-3.8]), -1).reshape(-1, 3)
    patch[:, 2] += np.random.default_rng(0).uniform(-spread, spread, len(patch))
    points = np.concatenate([plane(reach=8, height=-1.1, step=0.2), patch])
    xy = np.array([[1.0, 1.0], [5.0, 4.0], [-4.0, 2.0]])
    assert np.abs(estimate_ground(points, ORIGIN).at(xy) + 1.1).max() < 0.05
    # a floor of the same depth as wide as a room is there
    lower = plane(reach=3, height=-3.8, step=0.2) + [20, 0, 0]
    assert np.abs(estimate_ground(np.concatenate([points, lower]), ORIGIN).at(np.array([[20.0, 0.0]])) + 3.8) < 0.05


@pytest.mark.parametrize("drop", [0.8, 1.5, 3.0])
def test_estimate_ground_reaches_to_an_edge(drop):
    points = plane(reach=20, height=-1.8)
    points[points[:, 0] > 6, 2] -= drop
    ground = estimate_ground(points, ORIGIN)
    np.testing.assert_allclose(ground.at(np.array([[4.5, 0.0], [4.5, 8.0], [0.0, 0.0]])), -1.8, atol=0.05)
    np.testing.assert_allclose(ground.at(np.array([[9.0, 0.0], [15.0, 5.0]])), -1.8 - drop, atol=0.05)


def test_estimate_ground_is_none_without_ground():
    rng = np.random.default_rng(0)
    assert estimate_ground(np.zeros((0, 3)), ORIGIN) is None
    assert estimate_ground(rng.uniform(-10, 10, (1, 3)), ORIGIN) is None
    assert estimate_ground(rng.uniform(-15, 15, (4000, 3)), None) is None
    cloud = column(3, 0)
    stand_in = without_ground(cloud)
    assert np.abs(stand_in.at(cloud[:, :2]) + 1.8).max() < 0.15
    assert without_ground(np.zeros((0, 3))).at(np.zeros((2, 2))).tolist() == [0, 0]


def test_estimate_ground_moves_with_points(scene):
    _, points, ground = scene
    shift = np.array([7.0, -3.0, 2.0])
    moved = estimate_ground(points + shift, ORIGIN + shift)
    xy = points[::50, :2]
    np.testing.assert_allclose(moved.at(xy + shift[:2]), ground.at(xy) + 2, atol=0.02)
    R = rotation_about("z", np.pi / 2)
    turned = estimate_ground(points @ R.T, ORIGIN)
    assert np.median(np.abs(turned.at(xy @ R[:2, :2].T) - ground.at(xy))) < 0.02


def test_estimate_up_accepts_slope_at_bound():
    x, y = (values.ravel().astype(float) for values in np.meshgrid(np.arange(-10, 11), np.arange(-10, 11)))
    points = np.stack([x, y, np.nextafter(0.9, 0) * x], 1).repeat(3, axis=0)
    up = estimate_up(points)
    assert up is not None and np.allclose(up, [-0.669, 0, 0.743], atol=1e-3)


@pytest.mark.parametrize("degrees", [0, 6, 18, 30])
def test_estimate_up_detects_tilted_cloud(scene, degrees):
    points = scene[1]
    R = rotation_about("y", np.radians(degrees)) @ rotation_about("z", 0.7)
    up = estimate_up(points @ R.T, ORIGIN)
    if degrees < 10:
        assert up is None
    else:
        assert np.degrees(np.arccos(up @ R[:, 2])) < 2


def test_estimate_up_is_none_without_points():
    assert estimate_up(np.zeros((0, 3)), ORIGIN) is None


# --- proposals


def test_propose_finds_people_of_street(scene):
    frame, points, ground = scene
    centers = propose(points, ground)
    counts = np.bincount(frame.person[frame.person >= 0], minlength=len(frame.boxes))
    seen = [box for box, count in zip(frame.boxes, counts, strict=True) if count >= 10]
    assert len(seen) >= 4
    assert all(nearest(centers, *box.center[:2]) < 0.5 for box in seen)
    np.testing.assert_allclose(centers[:, 2], ground.at(centers[:, :2]))


@pytest.mark.parametrize(
    ("points", "places"),
    [
        ([column(5, 0), column(5, 0.5, seed=3)], [(5, 0), (5, 0.5)]),
        ([column(5, 0), column(5, 0.4, seed=3)], [(5, 0), (5, 0.4)]),
        ([column(5, 0), column(5.4, 0.05, seed=3)], [(5, 0), (5.4, 0.05)]),
        ([column(5, 0), box([5.35, -4, -1.8], [5.6, 4, 1.5], count=6000)], [(5, 0)]),
        ([column(5, 0, height=0.95, count=40)], [(5, 0)]),
        ([column(5, 0), box([5.25, -4, -1.8], [5.5, 4, 1.5], count=6000)], [(5, 0)]),
        ([column(9, 1, height=1.3, radius=0.3, count=30)], [(9, 1)]),
        ([sitter(5, 0), box([4.8, -1, -1.8], [5.25, 1, -1.35], count=200)], [(5, 0)]),
        ([column(9, 1, count=7)], [(9, 1)]),
        # a head above a hedge
        ([column(9, 1, ground=-0.4, height=0.25, count=15, radius=0.1)], [(9, 1)]),
    ],
    ids=["pair", "close", "behind", "wall", "child", "touching", "sitting", "bench", "few", "head"],
)
def test_propose_finds_people_near_others_and_objects(points, places):
    points = np.concatenate([plane(), *points])
    centers = propose(points, estimate_ground(points, ORIGIN))
    assert [nearest(centers, *place) < 0.25 for place in places] == [True] * len(places)


def test_propose_rejects_wall_and_finds_person_in_front_of_it():
    wall = box([6, -10, -1.8], [6.2, 10, 2.5], count=30_000)
    points = np.concatenate([plane(), wall, column(5.5, 3)])
    ground = estimate_ground(points, ORIGIN)
    places, _ = columns(points, heights_above(points, ground))
    centers = propose(points, ground)
    assert len(centers) < 0.5 * len(places)
    assert nearest(centers, 5.5, 3) < 0.3


@pytest.mark.parametrize("gap", [0.5, 0.55, 0.6, 0.65])
def test_propose_finds_all_people_in_row(gap):
    """From a distance, people side by side look like a wall."""
    places = gap * np.arange(-2, 3)
    points = np.concatenate([plane(), *[column(10, y, seed=k) for k, y in enumerate(places)]])
    centers = propose(points, estimate_ground(points, ORIGIN))
    assert max(nearest(centers, 10, y) for y in places) < 0.15


def test_propose_is_empty_for_bare_ground_and_no_points():
    points = plane()
    ground = estimate_ground(points, ORIGIN)
    assert propose(points, ground).shape == (0, 3)
    assert propose(np.zeros((0, 3)), ground).shape == (0, 3)


def test_propose_ignores_order_and_moves_with_points(scene, monkeypatch):
    _, points, ground = scene
    centers = propose(points, ground)
    order = np.random.default_rng(0).permutation(len(points))
    np.testing.assert_array_equal(propose(points[order], ground), centers)
    shift = np.array([30.0, -20.0, 0.0])
    moved = propose(points + shift, estimate_ground(points + shift, shift))
    # borders of cells are whole decimeters: rounding may move single points to the next cell
    gaps = [nearest(moved - shift, *center[:2]) for center in centers]
    assert np.mean(np.array(gaps) < 0.05) > 0.95
    monkeypatch.setattr(proposals, "_MOST", 7)
    np.testing.assert_array_equal(propose(points, ground), centers[:7])


def test_propose_is_thread_safe(scene):
    _, points, ground = scene
    clouds = [points, points[::2], points[::3], points[::5]] * 3
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda cloud: propose(cloud, ground), clouds))
    for cloud, centers in zip(clouds, together, strict=True):
        np.testing.assert_array_equal(centers, propose(cloud, ground))


def test_propose_finds_people_across_tiles():
    near = np.concatenate([plane(), column(5, 0)])
    # at a border of tiles, and far away
    places = [(0, 0), (64 * 3 - 6, 0), (500, 300)]
    points = np.concatenate([near + [x, y, 0] for x, y in places])
    centers = propose(points, estimate_ground(points))
    assert all(nearest(centers, x + 5, y) < 0.1 for x, y in places)
    assert len(centers) == 3


def test_tiles_contain_points_with_margin_of_one_meter():
    rng = np.random.default_rng(2)
    x, y = rng.uniform(-50, 300, (2, 4000)).astype(np.float32)
    covered = []
    for corner, (low, high), rows in proposals._tiles(x, y):
        is_inside = (x >= low[0] - 1) & (x < high[0] + 1) & (y >= low[1] - 1) & (y < high[1] + 1)
        assert (rows == np.flatnonzero(is_inside)).all() and (corner == low - 1).all() and (high == low + 64).all()
        covered.append(np.flatnonzero((x >= low[0]) & (x < high[0]) & (y >= low[1]) & (y < high[1])))
    assert (np.sort(np.concatenate(covered)) == np.arange(len(x))).all()


def test_tiles_accept_points_of_any_extent():
    x = np.repeat([0.0, 1e9, 3e15], 6)
    tiles = [rows for _, _, rows in proposals._tiles(x, x)]
    assert [rows.tolist() for rows in tiles] == np.arange(18).reshape(3, 6).tolist()


def test_columns_skips_only_tiles_without_dense_places(monkeypatch):
    rng = np.random.default_rng(3)
    scattered = np.column_stack([rng.uniform(0, 400, (6000, 2)), rng.uniform(0, 2.5, 6000)])
    points = np.concatenate([scattered, *(column(x, y, ground=0.0) for x, y in ((70, 333.5), (128, 192), (5, 5)))])
    skipping = columns(points, points[:, 2])
    monkeypatch.setattr(proposals, "_is_dense_somewhere", lambda x, y: True)
    everywhere = columns(points, points[:, 2])
    assert len(skipping[0]) >= 3
    for one, other in zip(skipping, everywhere, strict=True):
        np.testing.assert_array_equal(one, other)


# --- candidates


@pytest.mark.long
def test_render_matches_references(scene):
    _, points, ground = scene
    origin = np.array([0.3, -0.2, 0.1])
    heights = heights_above(points, ground)
    centers = propose(points, ground)
    chosen = SceneIndex(points, ground, origin).candidates(centers[::12])
    inputs = render(chosen)
    assert {name: array.shape[1:] for name, array in inputs.items()} == {
        "fine": (28, 24, 24),
        "range_view": (4, 28, 24),
        "context": (4, 20, 20),
        "scalars": (4,),
    }
    assert all(array.dtype == np.float32 for array in inputs.values())
    away = chosen.centers - origin
    scalars = [np.log(np.hypot(*away[:, :2].T)), -away[:, 2] / 4, np.log1p(chosen.count), np.ones(len(away))]
    np.testing.assert_allclose(inputs["scalars"], np.stack(scalars, 1), atol=1e-5)
    for k, center in enumerate(chosen.centers):
        away = center - origin
        assert chosen.distance[k] == pytest.approx(np.hypot(*away[:2]))
        R = rotation_about("z", -chosen.yaw[k])
        np.testing.assert_allclose(R @ [away[0], away[1], 0], [chosen.distance[k], 0, 0], atol=1e-9)
        local = (points - center) @ R.T
        near = local[(np.hypot(*local[:, :2].T) < 1.75) & (np.abs(local[:, 2] - 0.9) < 1.6)]
        if chosen.count[k] <= 1000:
            assert chosen.count[k] == len(near)
            # a point on the border of two cells may be in either
            assert np.mean(np.abs(fine_reference(near) - inputs["fine"][k]) > 1e-5) < 4e-4
            assert inputs["fine"][k].any()
        context = context_reference(points, heights, center, chosen.yaw[k])
        assert np.mean(np.abs(context - inputs["context"][k]) > 0.005) < 0.01
        seen = range_reference(points, origin, chosen, k)
        drawn = inputs["range_view"][k, 2] > 0
        # cells of the tables are up to 1.4 times smaller or larger than those of the image
        grown = np.pad(seen, 1)
        grown = np.stack([grown[i : i + 28, j : j + 24] for i in range(3) for j in range(3)]).any(0)
        assert np.mean(grown[drawn]) > 0.97
        assert drawn.sum() > 0.3 * seen.sum()
    assert len(pickle.dumps(chosen)) < 12_500 * len(chosen)


@pytest.mark.parametrize("origin", [ORIGIN, None], ids=["known", "unknown"])
def test_scene_index_pieces_match_candidates(scene, origin):
    _, points, ground = scene
    index, centers = SceneIndex(points, ground, origin), propose(points, ground)
    # of more than 1,000 points a part is stored
    centers = np.tile(centers[index.candidates(centers).count <= 1000], (9, 1))[:100]
    pieces = [render(piece) for piece in index.pieces(centers)]
    assert len(pieces) == 2
    for name, expected in render(index.candidates(centers)).items():
        np.testing.assert_array_equal(np.concatenate([piece[name] for piece in pieces]), expected)
    np.testing.assert_array_equal(index.yaws(centers), index.candidates(centers).yaw)


def test_candidates_thinning_ignores_order_of_points():
    """More than 1,000 points are thinned; in a driver's order, the rest would be from a few beams only."""
    rng = np.random.default_rng(3)
    cloud = np.concatenate([plane(), column(6, 0, count=8000)]).astype(np.float32)
    ground, center = estimate_ground(cloud, ORIGIN), np.array([[6.0, 0, -1.8]])
    drawn = []
    for order in (np.arange(len(cloud)), np.argsort(cloud[:, 2], kind="stable"), rng.permutation(len(cloud))):
        chosen = SceneIndex(cloud[order], ground, ORIGIN).candidates(center)
        assert chosen.sizes[0] == chosen.xyz.shape[1] <= 1000
        drawn.append({tuple(point) for point in chosen.xyz.T.tolist()})
    assert drawn[0] == drawn[1] == drawn[2]
    # in a search none is left out, so rounding changes little
    inputs = []
    for points in (cloud, cloud[rng.permutation(len(cloud))], cloud + np.float32(1e-6)):
        (piece,) = SceneIndex(points, ground, ORIGIN).pieces(center)
        assert piece.sizes[0] == piece.count[0] > 1000
        inputs.append(render(piece)["fine"])
    np.testing.assert_array_equal(inputs[0], inputs[1])
    assert np.mean(np.abs(inputs[0] - inputs[2]) > 1e-5) < 0.01


def test_render_range_view_shows_wall_before_and_behind():
    wall = np.stack(np.meshgrid(np.linspace(-3, 3, 400), np.linspace(-1.8, 2, 300)), -1).reshape(-1, 2)
    person = column(8, 0, count=400)
    for at, sign in ((5.0, -1), (10.0, 1)):
        points = np.concatenate([plane(), np.concatenate([np.full((len(wall), 1), at), wall], 1), person])
        ground = estimate_ground(points, ORIGIN)
        view = render(SceneIndex(points, ground, ORIGIN).candidates(np.array([[8.0, 0, -1.8]])))["range_view"][0]
        beside = view[:, 13:20, :6]
        assert (beside[2] > 0).mean() > 0.8
        distance = np.median(beside[0][beside[2] > 0]) * 4
        assert distance == pytest.approx(at - 8, abs=0.5) and np.sign(distance) == sign


def test_candidates_without_origin_keep_level_frame(scene):
    _, points, ground = scene
    centers = propose(points, ground)[:5]
    chosen = SceneIndex(points, ground, None).candidates(centers)
    inputs = render(chosen)
    assert not inputs["range_view"].any() and not inputs["scalars"][:, [0, 1, 3]].any()
    assert not chosen.yaw.any() and not chosen.distance.any()
    # equal to inputs with a dropped origin
    seen = SceneIndex(points, ground, ORIGIN).candidates(centers)
    dropped = render(seen, CandidateAugmentation(drop_origin=True, turn=seen.yaw))
    assert not dropped["range_view"].any() and not dropped["scalars"][:, [0, 1, 3]].any()
    assert np.mean(np.abs(dropped["fine"] - inputs["fine"]) > 1e-5) < 1e-3


def test_render_is_invariant_to_rotation_about_sensor(scene):
    _, points, ground = scene
    centers = propose(points, ground)
    centers = centers[np.hypot(*centers[:, :2].T) > 8][:20]
    R = rotation_about("z", np.pi / 2)
    turned = render(SceneIndex(points @ R.T, estimate_ground(points @ R.T, ORIGIN), ORIGIN).candidates(centers @ R.T))
    plain = render(SceneIndex(points, ground, ORIGIN).candidates(centers))
    assert np.mean(np.abs(turned["fine"] - plain["fine"]) > 1e-5) < 1e-3
    assert np.mean(np.abs(turned["range_view"] - plain["range_view"]) > 0.02) < 0.02
    np.testing.assert_allclose(turned["scalars"], plain["scalars"], atol=0.02)


def test_duplicate_points_do_not_change_candidates(scene):
    _, points, ground = scene
    centers = propose(points, ground)
    twice = np.repeat(points, 2, 0)
    again = columns(twice, heights_above(twice, ground))[0]
    assert all(nearest(again, *center[:2]) < 0.35 for center in centers)
    one, two = (render(SceneIndex(p, ground, ORIGIN).candidates(centers[-20:])) for p in (points, twice))
    assert ((one["fine"] > 0) == (two["fine"] > 0)).mean() > 0.999


def test_candidate_augmentation_moves_points_and_labels_alike():
    rng = np.random.default_rng(4)
    change = CandidateAugmentation(turn=0.3, mirror=True, scale=1.05, shift=(0.06, -0.04))
    ball = rng.normal(0, 0.03, (300, 3)) + [0.4, 0.3, 1.0]
    points = np.concatenate([plane(), ball + [6, 0, -1.8]])
    chosen = SceneIndex(points, estimate_ground(points, ORIGIN), ORIGIN).candidates(np.array([[6.0, 0, -1.8]]))
    fine = render(chosen, change)["fine"][0]
    high = fine[10:]
    middle = (np.argwhere(high > 0) * high[high > 0][:, None]).sum(0) / high.sum()
    expected = change.apply(np.array([[0.4, 0.3]]))[0]
    np.testing.assert_allclose((middle[1:] - 11.5) / 10, expected, atol=0.04)
    assert (middle[0] + 10.5) / 10 - 0.5 == pytest.approx(1.05, abs=0.04)
    # by hand: mirror, turn, scale, shift
    x, y = 0.4, -0.3
    x, y = np.cos(0.3) * x - np.sin(0.3) * y, np.sin(0.3) * x + np.cos(0.3) * y
    np.testing.assert_allclose(expected, [1.05 * x + 0.06, 1.05 * y - 0.04])


def test_render_augments_candidates_independently(scene):
    _, points, ground = scene
    chosen = SceneIndex(points, ground, ORIGIN).candidates(propose(points, ground)[:6])
    changes = draw_augmentation(np.random.default_rng(1), 6)
    together = render(chosen, changes)
    alone = render(chosen.take([3]), replace(changes, **{name: values[3:4] for name, values in vars(changes).items()}))
    for name, values in together.items():
        np.testing.assert_allclose(values[3], alone[name][0], atol=1e-6)
    unchanged = render(chosen, CandidateAugmentation())
    for name, values in render(chosen).items():
        np.testing.assert_allclose(unchanged[name], values, atol=0.005)
    # a shift of 0.2 m to the left moves the view past a candidate by two cells
    shifted = render(chosen, CandidateAugmentation(shift=(0.5, 0.2)))["range_view"]
    np.testing.assert_allclose(shifted[..., 2:], unchanged["range_view"][..., :-2], atol=1e-6)
    half = render(chosen, CandidateAugmentation(keep=0.5, seed=np.arange(6)))
    assert 0.3 < (half["fine"] > 0).sum() / (unchanged["fine"] > 0).sum() < 0.9


def test_render_accepts_no_points_and_no_candidates():
    ground = estimate_ground(plane(), ORIGIN)
    empty = SceneIndex(np.zeros((0, 3)), ground, ORIGIN)
    nobody = empty.candidates(np.zeros((0, 3)))
    assert len(nobody) == 0
    for augmentation in (None, CandidateAugmentation(), draw_augmentation(np.random.default_rng(0), 0)):
        assert render(nobody, augmentation)["fine"].shape == (0, 28, 24, 24)
    alone = empty.candidates(np.array([[4.0, 1, -1.8]]))
    assert alone.count[0] == 0 and not render(alone)["fine"].any()
    outside = SceneIndex(plane(), ground, ORIGIN).candidates(np.array([[400.0, 100, -1.8]]))
    assert outside.count[0] == 0 and not render(outside)["context"].any()


def test_candidates_thins_dense_places():
    person = np.concatenate([column(5, 0, count=200_000), plane(reach=8)])
    scene = SceneIndex(person, estimate_ground(person, ORIGIN), ORIGIN)
    chosen = scene.candidates(np.array([[5.0, 0, -1.8]]))
    assert chosen.sizes[0] <= 1000 < chosen.count[0] < 100_000
    # the whole body is kept
    x, y, z = chosen.xyz * 5e-4
    height = z[np.hypot(x, y) < 0.3]
    assert height.max() > 1.7 and np.diff(np.sort(height)).max() < 0.1


def test_candidates_count_points_around_them(scene):
    _, points, ground = scene
    places, _ = columns(points, heights_above(points, ground))
    centers = np.concatenate([places, ground.at(places)[:, None]], 1)
    candidates = SceneIndex(points, ground, ORIGIN).candidates(centers)
    for center, count in zip(candidates.centers[::10], candidates.count[::10], strict=True):
        offset = points - center
        is_near = (np.hypot(offset[:, 0], offset[:, 1]) < 1.75) & (offset[:, 2] > -0.7) & (offset[:, 2] < 2.5)
        assert abs(count - is_near.sum()) <= 1


def test_suppress_near_removes_weaker_of_close_places():
    rng = np.random.default_rng(0)
    centers, strength = rng.uniform(0, 3, (200, 3)), rng.permutation(200)
    kept = suppress_near(centers, strength, 0.25)
    assert kept.tolist() == suppress_near_reference(centers, strength, 0.25)
    assert 20 < len(kept) < 200
    # a removed place does not remove others
    row = np.array([[0.0, 0], [0.2, 0], [0.4, 0]])
    assert suppress_near(row, np.array([3.0, 2, 1]), 0.25).tolist() == [0, 2]
    assert len(suppress_near(np.zeros((0, 3)), np.zeros(0), 0.25)) == 0


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 60), step=st.sampled_from([0.0, 0.0625, 0.25]))
def test_suppress_near_matches_reference(seed, count, step):
    """On a grid, pairs are exactly at the radius."""
    rng = np.random.default_rng(seed)
    centers, strength = rng.uniform(-2, 2, (count, 3)), rng.integers(0, 20, count)
    if step:
        centers = np.round(centers / step) * step
    assert suppress_near(centers, strength, 0.25).tolist() == suppress_near_reference(centers, strength, 0.25)


def test_suppress_near_memory_grows_with_pairs():
    rng = np.random.default_rng(0)
    centers, strength = rng.uniform(0, 300, (3000, 2)), rng.normal(size=3000)
    tracemalloc.start()
    suppress_near(centers, strength, 0.15)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2e6


@pytest.mark.parametrize("shift", [(-3000.0, -3000.0), (3000.0, 0.0), (-20_000.0, 5000.0)])
def test_candidates_do_not_depend_on_coordinate_origin(scene, shift):
    """A scan in map coordinates, far from zero, has the same candidates as one centered on the sensor."""
    _, points, ground = scene
    offset = np.array([*shift, 0.0])
    centers = propose(points, ground)[:20]
    here = SceneIndex(points, ground, ORIGIN).candidates(centers)
    moved_points = points + offset
    moved_ground = replace(ground, corner=ground.corner + offset[:2])
    there = SceneIndex(moved_points, moved_ground, ORIGIN + offset).candidates(centers + offset)
    np.testing.assert_allclose(there.count, here.count, atol=1)
    assert (there.contexts != here.contexts).mean() < 0.01


def test_estimate_ground_of_slope_far_from_coordinate_origin():
    slope = plane()
    slope[:, 2] += 0.2 * slope[:, 0]
    for x in (-300.0, 0.0, 300.0):
        offset = np.array([x, 0.0, 0.0])
        ground = estimate_ground(slope + offset, ORIGIN + offset)
        assert ground is not None
        np.testing.assert_allclose(ground.at(np.array([[x + 5.0, 0.0]])), -1.8 + 1.0, atol=0.1)
