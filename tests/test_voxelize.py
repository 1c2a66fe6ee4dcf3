"""Voxels, levels and padding, compared with a reference implementation based on dictionaries."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from reference.voxelize_reference import voxelize_reference

from lidarpose.errors import InputError
from lidarpose.models.voxelize import WINDOW, view_features, voxelize

seeds = st.integers(0, 2**32 - 1)
people = st.lists(st.integers(0, 90), min_size=1, max_size=4)
GRID = 0.06


def crowd(seed, lengths, spread=0.5, dtype=np.float32):
    """Points of people, some of them outside the window."""
    rng = np.random.default_rng(seed)
    points = rng.normal(0, spread, (sum(lengths), 3))
    # as in a scan of a surface, many points share a voxel
    points = np.where(rng.random(len(points))[:, None] < 0.5, np.round(points, 1), points)
    return (points + rng.normal(0, 0.01, points.shape)).astype(dtype), np.array(lengths, int)


def assert_pyramids_agree(a, b):
    left, right = ({"point_voxel": p.point_voxel} | p.arrays() for p in (a, b))
    assert left.keys() == right.keys()
    # deviation is the root of a difference of squares: for one point per voxel only rounding errors remain
    tolerance = {"deviation": 1e-6, "offset": 1e-4}
    for name, value in left.items():
        assert value.dtype == right[name].dtype, name
        atol = tolerance.get(name, 2e-6) if value.dtype.kind == "f" else 0
        np.testing.assert_allclose(value, right[name], atol=atol, rtol=1e-7 if atol else 0, err_msg=name, strict=True)


@settings(max_examples=60, deadline=None)
@given(seeds, people, st.sampled_from([0.03, 0.06, 0.11]), st.sampled_from([1, 7, 40, 384]), st.booleans())
def test_voxelize_matches_reference(seed, lengths, grid, most, random):
    points, lengths = crowd(seed, lengths, spread=np.random.default_rng(seed).choice([0.1, 0.5, 1.2]))
    view = np.random.default_rng(seed).normal(size=(len(lengths), 5))
    kwargs = {"grid": grid, "max_voxels": most, "view": view, "neighbors": bool(seed % 2)}
    kwargs |= {"seeds": seed + np.arange(len(lengths)) if random else None}
    assert_pyramids_agree(voxelize(points, lengths, **kwargs), voxelize_reference(points, lengths, **kwargs))


@settings(max_examples=40, deadline=None)
@given(seeds, people)
def test_voxel_levels_are_consistent(seed, lengths):
    points, lengths = crowd(seed, lengths)
    tables = voxelize(points, lengths, grid=GRID, max_voxels=30)
    for level, above in ((tables.fine, tables.mid), (tables.mid, tables.coarse)):
        counts = np.where(level.valid, np.exp(level.log_count), 0)
        for b in range(len(lengths)):
            parent = level.parent[b][level.valid[b]]
            # every parent has a child, and its count and mean are those of its children
            assert set(parent) == set(np.flatnonzero(above.valid[b]))
            for k in np.flatnonzero(above.valid[b]):
                mine = level.valid[b] & (level.parent[b] == k)
                assert np.exp(above.log_count[b, k]) == pytest.approx(counts[b, mine].sum(), rel=1e-5)
                mean = (level.position[b, mine] * counts[b, mine, None]).sum(0) / counts[b, mine].sum()
                np.testing.assert_allclose(above.position[b, k], mean, atol=1e-5)
            # padding is at the end
            assert (np.diff(level.valid[b].astype(int)) <= 0).all()
    for name, value in tables.arrays().items():
        if name.startswith("fine.") or name in ("deviation", "offset"):
            assert not value[~tables.fine.valid].any(), name


@settings(max_examples=40, deadline=None)
@given(seeds, people)
def test_voxelize_ignores_batch_and_order_of_points(seed, lengths):
    points, lengths = crowd(seed, lengths)
    before = points.copy(), lengths.copy()
    tables = voxelize(points, lengths, grid=GRID, max_voxels=30)
    together, rng = tables.arrays(), np.random.default_rng(seed)
    for b, end in enumerate(np.cumsum(lengths)):
        rows = slice(end - lengths[b], end)
        order = rng.permutation(lengths[b])
        single = voxelize(points[rows][order], lengths[b : b + 1], grid=GRID, max_voxels=30)
        slot = tables.point_voxel[rows] - b * tables.fine.valid.shape[1]
        np.testing.assert_array_equal(np.where(tables.point_voxel[rows] < 0, -1, slot)[order], single.point_voxel)
        for name, value in single.arrays().items():
            if name != "view":
                width = value.shape[1]
                np.testing.assert_allclose(together[name][b, :width], value[0], atol=1e-6, err_msg=name)
                assert not together[name][b, width:].any()
    # inputs are not modified
    np.testing.assert_array_equal(points, before[0])
    np.testing.assert_array_equal(lengths, before[1])


def test_voxel_neighbors_are_the_27_adjacent_cells():
    axis = np.arange(8) * GRID + GRID / 2 - 4 * GRID
    cube = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)
    tables = voxelize(cube, np.array([len(cube)]), grid=GRID, max_voxels=999, neighbors=True)
    assert tables.fine.neighbors is None
    # 4 x 4 x 4 mid voxels: a corner has 8 of the 27 cells, an inner one all
    filled = (tables.mid.neighbors[0] < 64).sum(1)
    np.testing.assert_array_equal(
        np.sort(filled), np.sort([a * b * c for a in (2, 3, 3, 2) for b in (2, 3, 3, 2) for c in (2, 3, 3, 2)])
    )
    np.testing.assert_array_equal(tables.mid.neighbors[0, :, 13], np.arange(64))
    # the first axis varies slowest: entry 22 is one step along x
    ahead = tables.mid.neighbors[0, :, 22]
    step = tables.mid.position[0, ahead[ahead < 64]] - tables.mid.position[0, ahead < 64]
    np.testing.assert_allclose(step, np.tile([2 * GRID, 0, 0], (48, 1)), atol=1e-6)


def test_point_voxel_maps_points_to_their_voxel():
    points, lengths = crowd(3, [200, 150], spread=0.9)
    tables = voxelize(points, lengths, grid=GRID, max_voxels=384)
    inside = (np.abs(points) < WINDOW).all(1)
    np.testing.assert_array_equal(tables.point_voxel >= 0, inside)
    row = tables.fine.position.reshape(-1, 3)[tables.point_voxel[inside]]
    assert np.abs(row - points[inside]).max() < GRID
    owner = tables.point_voxel[inside] // tables.fine.valid.shape[1]
    np.testing.assert_array_equal(owner, np.repeat([0, 1], lengths)[inside])
    # stray points of any size are outside, without a warning
    strays = [[0, 0, 0], [1e30, 0, 0], [np.nan, 0, 0], [0, -np.inf, 0], [2.0, 0, 0], [-1.9999, 0, 0]]
    tables = voxelize(np.array(strays, np.float32), np.array([6]), grid=GRID, max_voxels=9)
    assert (tables.point_voxel >= 0).tolist() == [True, False, False, False, False, True]


@pytest.mark.parametrize("copies", [3, 7])
def test_deviation_of_equal_points_is_zero(copies):
    points, _ = crowd(0, [50], dtype=float)
    apart = np.unique(np.floor(points / GRID), axis=0, return_index=True)[1]
    points = points[apart].repeat(copies, 0)
    pyramid = voxelize(points, np.array([len(points)]), grid=GRID, max_voxels=1000)
    assert (pyramid.deviation >= 0).all() and pyramid.deviation.max() < 1e-6


def test_voxelize_accepts_empty_people_and_single_points():
    none = voxelize(np.zeros((0, 3), np.float32), np.zeros(2, int), grid=GRID, max_voxels=9)
    assert none.fine.valid.shape == (2, 1) and not none.fine.valid.any() and not none.coarse.valid.any()
    point = np.array([[0.07, -0.01, 0.5]], np.float32)
    one = voxelize(point, np.array([0, 1, 0]), grid=GRID, max_voxels=9)
    np.testing.assert_array_equal(one.fine.valid[:, 0], [False, True, False])
    for level in (one.fine, one.mid, one.coarse):
        np.testing.assert_allclose(level.position[1, 0], point[0], atol=1e-7)
        assert level.log_count[1, 0] == 0
    np.testing.assert_allclose(one.offset[1, 0], point[0] / GRID - [1, -1, 8] - 0.5, atol=1e-4)
    assert not one.deviation.any()
    outside = voxelize(point + 5, np.array([1]), grid=GRID, max_voxels=9)
    assert not outside.fine.valid.any() and outside.point_voxel.tolist() == [-1]


def test_voxelize_rejects_too_fine_grid():
    points = np.array([[-1.99, 0, 0], [1.99, 1.99, -1.99]])
    assert voxelize(points, np.array([2]), grid=WINDOW / 128, max_voxels=9).fine.valid.sum() == 2
    with pytest.raises(InputError, match="grid must be at least"):
        voxelize(points, np.array([2]), grid=0.01, max_voxels=9)


@pytest.mark.parametrize("random", [False, True])
def test_thinning_keeps_small_people_and_covers_large_ones(random):
    small, large = crowd(1, [20])[0], crowd(2, [3000], spread=0.5)[0]
    numbers = np.array([3, 4]) if random else None
    tables = voxelize(np.concatenate([small, large]), np.array([20, 3000]), grid=GRID, max_voxels=100, seeds=numbers)
    assert tables.fine.valid[1].sum() == 100 and tables.fine.valid.shape == (2, 100)
    assert tables.fine.valid[0].sum() == voxelize(small, np.array([20]), grid=GRID, max_voxels=100).fine.valid.sum()
    # kept voxels cover the whole person: within three standard errors of 100 draws with a spread of 0.5 m
    np.testing.assert_allclose(tables.fine.position[1].mean(0), large.mean(0), atol=0.15)
    np.testing.assert_allclose(tables.fine.position[1].std(0), large.std(0), rtol=0.21)
    # independent of other people in the batch
    alone = voxelize(large, np.array([3000]), grid=GRID, max_voxels=100, seeds=None if numbers is None else numbers[1:])
    np.testing.assert_array_equal(alone.fine.position[0], tables.fine.position[1])


def test_view_features_point_to_sensor():
    center, origin = np.array([3.0, 4.0, -1.0]), np.array([0.0, 0, -1])
    view = view_features(center, origin)
    assert view.dtype == np.float32
    np.testing.assert_allclose(center + view[:3] * np.exp(view[3]), origin, atol=1e-5)
    assert view[4] == 1 and np.exp(view[3]) == pytest.approx(5, rel=1e-5)
    np.testing.assert_array_equal(view_features(center, None), np.zeros(5))
    # ranges are at least 10 cm
    np.testing.assert_allclose(view_features(center, center + [0.02, 0, 0]), [0.2, 0, 0, np.log(0.1), 1], atol=1e-6)
    np.testing.assert_allclose(view_features(center, center), [0, 0, 0, np.log(0.1), 1], atol=1e-6)
