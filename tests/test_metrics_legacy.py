"""The released code's figures, and its faults by hand-made cases: legacy=True has them, the default does not."""

from pathlib import Path

import numpy as np
import pytest

from lidarpose import metrics
from lidarpose.errors import InputError

REFERENCE = Path(__file__).parent / "parity" / "metrics.npz"


def drawn(seed, n=3, noise=0.1):
    """pred, true (n, 14, 3) m, visible (n, 14) with 30 % missing."""
    rng = np.random.default_rng(seed)
    true = rng.normal(size=(n, 14, 3)) * 0.4
    return true + rng.normal(size=true.shape) * noise, true, rng.random((n, 14)) < 0.7


@pytest.fixture(scope="module")
def reference():
    with np.load(REFERENCE) as file:
        return dict(file)


@pytest.mark.parametrize("legacy", [True, False])
def test_figures_of_the_reference(reference, legacy):
    # everybody has a label and the batch is large, so that faults do not show and both are one
    pred, true, visible = reference["pred"], reference["gt"], reference["vis"]
    found = {
        "mpjpe_vis": metrics.mpjpe(pred, true, visible, legacy) / 1e3,
        "mpjpe_full": metrics.mpjpe(pred, true, legacy=legacy) / 1e3,
        "pa_full": metrics.pa_mpjpe(pred, true, legacy=legacy) / 1e3,
        "pck30_vis": metrics.pck(pred, true, visible, legacy) / 100,
        "pck50_vis": metrics.pck(pred, true, visible, legacy, threshold=0.5) / 100,
    }
    assert found == pytest.approx({name: float(reference[name]) for name in found}, abs=1e-6)
    # the figures tell labelled joints from all, and one threshold from the other
    assert abs(found["mpjpe_vis"] - found["mpjpe_full"]) > 1e-3 < abs(found["pck30_vis"] - found["pck50_vis"])


def test_legacy_counts_who_has_no_label_as_free_of_error():
    true = np.zeros((2, 2, 3))
    pred = true + [0.1, 0, 0]
    visible = [[1, 1], [0, 0]]
    assert metrics.mpjpe(pred, true, visible, legacy=True) == pytest.approx(50)
    ours = metrics.mpjpe(pred, true, visible)
    assert ours == pytest.approx(100)
    assert (ours.people, ours.joints, ours.skipped) == (1, 2, 1)


def test_legacy_halves_the_error_of_a_pair_of_joints_labelled_at_30_percent():
    rng = np.random.default_rng(0)
    true = rng.normal(size=(4000, 14, 3))
    table = metrics.joint_errors(true + [0, 0.1, 0], true, rng.random((4000, 14)) < 0.3)
    legacy, ours = metrics.by_group(table, "waymo14", empty=0.0), metrics.by_group(table, "waymo14")
    for name in ("wrists", "ankles", "head"):
        # 1 - 0.7^2 of the people have one label or two
        assert legacy[name] == pytest.approx(51, abs=3) and ours[name] == pytest.approx(100)
        assert ours[name].people + ours[name].skipped == legacy[name].people == 4000
    assert legacy["all"] > 99


def test_legacy_pck_is_nan_as_soon_as_one_person_has_no_label():
    pred, true, visible = drawn(0)
    visible[1] = False
    assert np.isnan(metrics.pck(pred, true, visible, legacy=True))
    ours = metrics.pck(pred, true, visible)
    assert ours == pytest.approx(metrics.pck(pred[[0, 2]], true[[0, 2]], visible[[0, 2]])) and ours.skipped == 1


def transposed_procrustes(source, target):
    """The reference's alignment of (D, N) columns, one person: as its equations read."""
    s, t = source - source.mean(1, keepdims=True), target - target.mean(1, keepdims=True)
    u, d, vt = np.linalg.svd(s @ t.T)
    z = np.eye(len(u))
    z[-1, -1] = np.sign(np.linalg.det(u @ vt))
    rotation = vt.T @ z @ u.T
    scale = np.trace(rotation @ s @ t.T) / (s**2).sum()
    return scale * rotation @ s + target.mean(1, keepdims=True)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5])
def test_legacy_alignment_turns_two_and_three_people_on_their_side(n):
    pred, true, _ = drawn(n, n, noise=0.05)
    pairs = zip(pred, true, strict=True)
    if n in (2, 3):
        moved = np.stack([transposed_procrustes(a, b) for a, b in pairs])
    else:
        moved = np.stack([transposed_procrustes(a.T, b.T).T for a, b in pairs])
    legacy = metrics.pa_mpjpe(pred, true, legacy=True)
    assert legacy == pytest.approx(np.linalg.norm(moved - true, axis=-1).mean() * 1e3)
    ours = metrics.pa_mpjpe(pred, true)
    assert legacy < 0.4 * ours if n in (2, 3) else legacy == pytest.approx(ours)


def test_legacy_alignment_counts_who_has_no_label_as_free_of_error():
    pred, true, visible = drawn(4, n=4)
    visible[:] = True
    visible[1] = False
    legacy = metrics.pa_mpjpe(pred, true, visible, legacy=True)
    assert legacy == pytest.approx(0.75 * metrics.pa_mpjpe(pred, true, visible)) and legacy.people == 4


def test_legacy_alignment_takes_joints_without_label():
    pred, true, visible = drawn(5, n=6)
    visible[:, :4] = [True, True, True, False]
    worse = pred.copy()
    worse[:, 3] += 2
    assert metrics.pa_mpjpe(worse, true, visible) == pytest.approx(metrics.pa_mpjpe(pred, true, visible))
    assert metrics.pa_mpjpe(worse, true, visible, legacy=True) > 1.2 * metrics.pa_mpjpe(pred, true, visible)
    with pytest.raises(InputError, match="must hold no NaN"):
        metrics.pa_mpjpe(pred, np.where(visible[..., None], true, np.nan), legacy=True)
