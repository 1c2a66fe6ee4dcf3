"""What happens to points after the cast: pure functions with known statistics."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidarpose.data import augment
from lidarpose.geometry import unit

seeds = st.integers(0, 2**32 - 1)


def seen(n=4000, seed=0):
    """Points (n, 3) m about 8 m away, their rings, parts and outward normals."""
    rng = np.random.default_rng(seed)
    points = np.array([8.0, 1, 0]) + rng.normal(0, 0.4, (n, 3))
    return points, rng.integers(0, 32, n), rng.integers(0, 25, n).astype(np.uint8), unit(rng.normal(size=(n, 3)))


def calls(points, ring, part, normals):
    """Every augmentation by name, as a function of the generator."""
    return {
        "range_noise": lambda rng: augment.range_noise(points, ring, sigma=0.02, bias=0.006, rng=rng),
        "grazing_keep": lambda rng: augment.grazing_keep(points, normals, strength=0.8, rng=rng),
        "noise_clusters": lambda rng: augment.noise_clusters(points.mean(0), most=150, rng=rng),
        "part_removal": lambda rng: augment.part_removal(part, rng=rng),
        "jitter": lambda rng: augment.jitter(points, sigma=0.01, clip=0.02, rng=rng),
    }


@pytest.mark.parametrize("name", calls(*seen(1)))
def test_inputs_stay_as_they_are_and_the_generator_decides(name):
    given_arrays = seen(200)
    kept = [a.copy() for a in given_arrays]
    call = calls(*given_arrays)[name]
    first, again, other = (call(np.random.default_rng(seed)) for seed in (1, 1, 2))
    for array, copy in zip(given_arrays, kept, strict=True):
        np.testing.assert_array_equal(array, copy)
    np.testing.assert_array_equal(first, again)
    assert first.shape != other.shape or (first != other).any()


@pytest.mark.parametrize("name", ["range_noise", "grazing_keep", "part_removal", "jitter"])
def test_no_points_are_legal(name):
    call = calls(*(a[:0] for a in seen(1)))[name]
    assert len(call(np.random.default_rng(0))) == 0


def test_range_noise_lies_along_the_beam_and_is_symmetric():
    points, ring, _, _ = seen(20000)
    moved = augment.range_noise(points, ring, sigma=0.02, bias=0.0, rng=np.random.default_rng(3))
    np.testing.assert_allclose(unit(moved), unit(points), atol=1e-12)
    error = np.linalg.norm(moved, axis=1) - np.linalg.norm(points, axis=1)
    assert abs(error.mean()) < 4 * 0.02 / np.sqrt(len(error))
    assert error.std() == pytest.approx(0.02, rel=0.03)
    assert (error > 0).mean() == pytest.approx(0.5, abs=0.02)


def test_the_bias_of_range_noise_is_shared_by_a_ring():
    points, ring, _, _ = seen(2000)
    moved = augment.range_noise(points, ring, sigma=0.0, bias=0.01, rng=np.random.default_rng(4))
    error = np.linalg.norm(moved, axis=1) - np.linalg.norm(points, axis=1)
    of_ring = np.array([error[ring == r].mean() for r in range(32)])
    np.testing.assert_allclose(error, of_ring[ring], atol=1e-9)
    assert 0.006 < of_ring.std() < 0.015


def test_grazing_drops_only_what_grazes():
    points, _, _, _ = seen(5000)
    beam = unit(points)
    across = unit(np.cross(beam, [0, 0, 1]))
    rng = np.random.default_rng(5)
    assert augment.grazing_keep(points, beam, strength=1.0, rng=rng).all()
    assert augment.grazing_keep(points, -beam, strength=1.0, rng=rng).all()
    assert not augment.grazing_keep(points, across, strength=1.0, rng=rng).any()
    assert augment.grazing_keep(points, across, strength=0.3, rng=rng).mean() == pytest.approx(0.7, abs=0.03)
    assert augment.grazing_keep(points, across, strength=0.0, rng=rng).all()
    # at 45 degrees next to nothing is lost
    between = unit(beam + across)
    assert augment.grazing_keep(points, between, strength=1.0, rng=rng).mean() > 0.98


@settings(max_examples=60, deadline=None)
@given(seeds, st.integers(0, 150))
def test_noise_clusters_are_one_or_two_small_blobs(seed, most):
    center = np.array([3.0, -7, 0.5])
    stray = augment.noise_clusters(center, most=most, rng=np.random.default_rng(seed))
    assert stray.shape[1:] == (3,) and len(stray) <= 2 * most
    assert (np.abs(stray - center) <= np.array([0.4, 0.4, 0.8]) + 0.3).all()
    # the first point's blob is within its diameter, whatever is left is the other blob
    left = stray
    for _ in range(2):
        if len(left):
            left = left[np.linalg.norm(left - left[0], axis=1) > 0.6]
    assert len(left) == 0


def test_noise_clusters_of_both_kinds_and_sizes_occur():
    rng = np.random.default_rng(6)
    sizes = np.array([len(augment.noise_clusters(np.zeros(3), most=100, rng=rng)) for _ in range(400)])
    # the mean of one or two blobs of 0 to 100 points
    assert sizes.mean() == pytest.approx(75, rel=0.12)
    assert sizes.max() > 110 and sizes.min() < 10


@settings(max_examples=60, deadline=None)
@given(seeds, st.lists(st.integers(0, 24), max_size=60))
def test_part_removal_takes_exactly_one_part_that_is_there(seed, part):
    part = np.array(part, np.uint8)
    keep = augment.part_removal(part, rng=np.random.default_rng(seed))
    assert keep.dtype == bool and keep.shape == part.shape
    gone = set(part[~keep])
    if not part.any():
        assert keep.all()
    else:
        assert len(gone) == 1 and 0 not in gone
        assert not (set(part[keep]) & gone)


def test_part_removal_takes_every_part_in_turn():
    part = np.array([0, 3, 3, 7, 24], np.uint8)
    rng = np.random.default_rng(7)
    gone = [int(part[~augment.part_removal(part, rng=rng)][0]) for _ in range(300)]
    assert sorted(set(gone)) == [3, 7, 24]
    # parts alike, not points alike
    assert gone.count(3) / 300 == pytest.approx(1 / 3, abs=0.1)


def test_jitter_is_normal_and_cut():
    points = np.zeros((20000, 3))
    step = augment.jitter(points, sigma=0.005, clip=0.02, rng=np.random.default_rng(8))
    np.testing.assert_allclose(step.std(0), 0.005, rtol=0.03)
    np.testing.assert_allclose(step.mean(0), 0, atol=2e-4)
    cut = augment.jitter(points, sigma=0.05, clip=0.02, rng=np.random.default_rng(8))
    assert np.abs(cut).max() == 0.02
    assert (np.abs(cut) == 0.02).mean() == pytest.approx(0.689, abs=0.02)
