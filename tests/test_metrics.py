"""MPJPE, PA-MPJPE, PCK, acceleration, calibration: definitions, properties, what they say of wrong input."""

import pickle
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidarpose import metrics
from lidarpose.errors import InputError
from lidarpose.geometry import axis_angle_to_matrix, similarity_align

quick = settings(max_examples=40, deadline=None)
seeds = st.integers(0, 2**32 - 1)


def drawn(seed, n=3, joints=14, noise=0.1):
    """pred, true (n, joints, 3) m, visible (n, joints): at least one joint a person."""
    rng = np.random.default_rng(seed)
    true = rng.normal(size=(n, joints, 3)) * 0.4
    visible = rng.random((n, joints)) < 0.7
    visible[np.arange(n), rng.integers(joints, size=n)] = True
    return true + rng.normal(size=true.shape) * noise, true, visible


# ---- properties


@quick
@given(seeds, st.integers(1, 5), st.floats(0.2, 5), st.booleans())
def test_pa_is_blind_to_similarities(seed, n, scale, masked):
    pred, true, visible = drawn(seed, n)
    visible[:, :3] = True
    visible = visible if masked else None
    rng = np.random.default_rng(seed)
    rotation = axis_angle_to_matrix(rng.normal(size=(n, 3)))
    moved = scale * pred @ np.swapaxes(rotation, 1, 2) + rng.normal(size=(n, 1, 3)) * 5
    assert metrics.pa_mpjpe(moved, true, visible) == pytest.approx(metrics.pa_mpjpe(pred, true, visible), abs=1e-6)
    exact = scale * true @ np.swapaxes(rotation, 1, 2) + rng.normal(size=(n, 1, 3)) * 5
    assert metrics.pa_mpjpe(exact, true, visible) == pytest.approx(0, abs=1e-6)
    # not to mirrors
    assert metrics.pa_mpjpe(true * [1, -1, 1], true) > 10


@quick
@given(seeds, st.integers(1, 5), st.booleans())
def test_exact_predictions_score_nothing(seed, n, legacy):
    _, true, visible = drawn(seed, n)
    visible[:, :3] = True
    for labels in (None, visible):
        assert metrics.mpjpe(true, true, labels, legacy) == 0
        assert metrics.pa_mpjpe(true, true, labels, legacy) == pytest.approx(0, abs=1e-9)
        assert metrics.pck(true, true, labels, legacy) == 100
    assert metrics.acceleration_error(true[:, :, None], true[:, :, None], 10) == 0


@quick
@given(seeds, st.integers(1, 5), st.sampled_from(metrics.AVERAGES))
def test_the_order_of_joints_and_people_does_not_matter(seed, n, average):
    pred, true, visible = drawn(seed, n)
    rng = np.random.default_rng(seed)
    order, people = rng.permutation(14), rng.permutation(n)
    for metric in (metrics.mpjpe, metrics.pa_mpjpe, metrics.pck):
        turned = [array[people][:, order] for array in (pred, true, visible)]
        before, after = metric(pred, true, visible, average=average), metric(*turned, average=average)
        assert after == pytest.approx(before, nan_ok=True) and after.__dict__ == before.__dict__


@quick
@given(seeds, st.integers(1, 5))
def test_nan_truth_and_hidden_joints_are_one(seed, n):
    pred, true, visible = drawn(seed, n)
    blank = np.where(visible[..., None], true, np.nan)
    for metric in (metrics.mpjpe, metrics.pa_mpjpe, metrics.pck):
        a, b = metric(pred, true, visible), metric(pred, blank)
        assert a == pytest.approx(b, nan_ok=True) and a.__dict__ == b.__dict__


@quick
@given(seeds, st.integers(1, 5))
def test_tables_against_loops(seed, n):
    pred, true, visible = drawn(seed, n, noise=0.2)
    errors, aligned, hits = (
        table(pred, true, visible) for table in (metrics.joint_errors, metrics.aligned_errors, metrics.joint_hits)
    )
    for i in range(n):
        seen = visible[i]
        plain = np.linalg.norm(pred[i] - true[i], axis=1)
        np.testing.assert_allclose(errors[i][seen], plain[seen] * 1e3)
        np.testing.assert_array_equal(hits[i][seen], [100 if e < 0.3 * 0.5127067 else 0 for e in plain[seen]])
        if seen.sum() >= 3:
            moved = similarity_align(pred[i][seen], true[i][seen])
            np.testing.assert_allclose(aligned[i][seen], np.linalg.norm(moved - true[i][seen], axis=1) * 1e3, atol=1e-9)
        else:
            assert np.isnan(aligned[i]).all()
        assert np.isnan(np.stack([errors, aligned, hits])[:, i, ~seen]).all()


def test_a_label_needs_all_coordinates_and_its_flag():
    pred, true, visible = drawn(0)
    true[0, 3, 1] = np.nan
    visible[0, 3:5] = [True, False]
    for table in (metrics.joint_errors, metrics.aligned_errors, metrics.joint_hits):
        visible[0, 3] = True
        found = table(pred, true, visible)
        assert np.isnan(found[0, 3:5]).all() and not np.isnan(found[0]).all()
        visible[0, 3] = False
        np.testing.assert_array_equal(found, table(pred, true, visible))


# ---- definitions


def test_both_averages():
    true = np.zeros((2, 4, 3))
    pred = true.copy()
    pred[0, :, 0], pred[1, :, 0] = 0.1, 0.4
    visible = [[1, 1, 1, 1], [1, 0, 0, 0]]
    assert metrics.mpjpe(pred, true, visible) == pytest.approx((100 + 400) / 2)
    assert metrics.mpjpe(pred, true, visible, average="joint") == pytest.approx((4 * 100 + 400) / 5)
    assert metrics.pck(pred, true, visible) == 50
    assert metrics.pck(pred, true, visible, average="joint") == 80


def test_pck_is_nearer_than_the_threshold():
    true = np.zeros((1, 4, 3))
    pred = true.copy()
    pred[0, :, 2] = [0.153, 0.155, 0.256, 0.257]
    assert metrics.pck(pred, true) == 25
    assert metrics.pck(pred, true, threshold=0.5) == 75
    assert metrics.pck(pred, true, threshold=0.5, torso=0.52) == 100
    pred[0, :, 2] = 0.25
    assert metrics.pck(pred, true, threshold=0.5, torso=0.5) == 0


def test_people_with_two_labels_are_not_aligned():
    pred, true, visible = drawn(3, n=4)
    visible[:] = True
    visible[2, 2:] = False
    score = metrics.pa_mpjpe(pred, true, visible)
    keep = [0, 1, 3]
    assert score == pytest.approx(metrics.pa_mpjpe(pred[keep], true[keep])) and score.skipped == 1
    # three are enough
    visible[2, 2] = True
    assert metrics.pa_mpjpe(pred, true, visible).skipped == 0


def test_a_score_of_nobody_is_nan_and_says_so():
    pred, true, _ = drawn(0)
    for metric in (metrics.mpjpe, metrics.pa_mpjpe, metrics.pck):
        for average in metrics.AVERAGES:
            score = metric(pred, true, np.zeros((3, 14)), average=average)
            assert np.isnan(score) and (score.people, score.joints, score.skipped) == (0, 0, 3)
    assert np.isnan(metrics.mpjpe(np.empty((0, 14, 3)), np.empty((0, 14, 3))))


def test_scores_are_numbers_that_travel():
    score = metrics.mpjpe(*drawn(1))
    back = pickle.loads(pickle.dumps(score))
    assert back == score and back.people == score.people == 3
    assert f"{score:.1f}" == f"{float(score):.1f}" and isinstance(score, float)


def test_lists_single_people_and_leading_shapes():
    pred, true, visible = drawn(7, n=6)
    whole = metrics.mpjpe(pred, true, visible)
    assert metrics.mpjpe(pred.tolist(), true.tolist(), visible.tolist()) == whole
    shaped = [array.reshape(2, 3, *array.shape[1:]) for array in (pred, true, visible)]
    assert metrics.mpjpe(*shaped) == whole
    one = metrics.mpjpe(pred[0], true[0], visible[0])
    assert one == pytest.approx(metrics.mpjpe(pred[:1], true[:1], visible[:1])) and one.people == 1
    given = [array.copy() for array in (pred, true, visible)]
    metrics.pa_mpjpe(pred, true, visible)
    for before, after in zip(given, (pred, true, visible), strict=True):
        np.testing.assert_array_equal(before, after)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"pred": np.zeros((3, 13, 3))}, r"both be \(..., joints, 3\), got \(3, 13, 3\) and \(3, 14, 3\)"),
        ({"pred": np.zeros((3, 14, 2)), "true": np.zeros((3, 14, 2))}, r"\(..., joints, 3\)"),
        ({"pred": np.zeros(3), "true": np.zeros(3)}, r"\(..., joints, 3\)"),
        ({"pred": np.zeros((3, 0, 3)), "true": np.zeros((3, 0, 3)), "visible": None}, r"\(..., joints, 3\)"),
        ({"pred": np.full((3, 14, 3), np.nan)}, "pred must be finite, got NaN or infinity in 42 joints"),
        ({"true": np.full((3, 14, 3), np.inf)}, "true must be finite, or NaN where"),
        ({"visible": np.ones((3, 13))}, r"visible must be \(3, 14\), one a joint, got \(3, 13\)"),
        ({"visible": np.full((3, 14), 2)}, "codes > 0"),
        ({"visible": np.full((3, 14), np.nan)}, "bool, or 0 and 1"),
        ({"pred": [[[0, 0, 0]], [[0, 0]]]}, "pred must hold numbers, in lists of equal length"),
    ],
)
@pytest.mark.parametrize("metric", [metrics.mpjpe, metrics.pa_mpjpe, metrics.pck])
def test_wrong_input_gets_one_line(metric, change, message):
    pred, true, visible = drawn(0)
    with pytest.raises(InputError, match=message) as caught:
        metric(**({"pred": pred, "true": true, "visible": visible} | change))
    assert "\n" not in str(caught.value)


def test_wrong_options_get_one_line():
    pred, true, _ = drawn(0)
    with pytest.raises(InputError, match="did you mean person"):
        metrics.mpjpe(pred, true, average="persons")
    with pytest.raises(InputError, match="averages over people"):
        metrics.mpjpe(pred, true, legacy=True, average="joint")
    with pytest.raises(InputError, match="threshold must be a positive number"):
        metrics.pck(pred, true, threshold=0)
    with pytest.raises(InputError, match="torso must be a positive number"):
        metrics.pck(pred, true, torso=np.nan)


# ---- acceleration


def test_acceleration_of_a_known_fault():
    rng = np.random.default_rng(0)
    time = np.arange(8) / 20
    true = rng.normal(size=(3, 8, 5, 3))
    # what moves evenly costs nothing, what falls costs its acceleration
    even = true + (rng.normal(size=(3, 1, 5, 3)) + time[:, None, None] * [1.0, 2, 3])
    assert metrics.acceleration_error(even, true, 20) == pytest.approx(0, abs=1e-6)
    falling = true + 0.5 * 9.81 * time[:, None, None] ** 2 * [0, 0, 1.0]
    assert metrics.acceleration_error(falling, true, 20) == pytest.approx(9810)
    assert metrics.acceleration_error(falling, true, 1) == pytest.approx(9810 / 400)
    assert metrics.acceleration_error(falling[0], true[0], 20) == pytest.approx(9810)


@quick
@given(seeds, st.sampled_from(metrics.AVERAGES))
def test_acceleration_against_a_loop(seed, average):
    rng = np.random.default_rng(seed)
    pred, true = rng.normal(size=(2, 3, 6, 4, 3))
    visible = rng.random((3, 6, 4)) < 0.8
    each = []
    for i in range(3):
        found = []
        for t in range(1, 5):
            for j in range(4):
                if visible[i, t - 1 : t + 2, j].all():
                    a, b = (x[i, t - 1, j] - 2 * x[i, t, j] + x[i, t + 1, j] for x in (pred, true))
                    found.append(np.linalg.norm(a - b) * 1e5)
        each.append(found)
    seen = [found for found in each if found]
    whole = np.concatenate(seen) if seen else [np.nan]
    wanted = np.mean([np.mean(found) for found in seen] if seen and average == "person" else whole)
    score = metrics.acceleration_error(pred, true, 10, visible, average=average)
    assert score == pytest.approx(wanted, nan_ok=True) and (score.people, score.skipped) == (len(seen), 3 - len(seen))


def test_acceleration_wants_sequences_and_a_rate():
    poses = np.zeros((2, 4, 5, 3))
    with pytest.raises(InputError, match="3 frames or more, got 2"):
        metrics.acceleration_error(poses[:, :2], poses[:, :2], 10)
    with pytest.raises(InputError, match=r"\(..., frames, joints, 3\)"):
        metrics.acceleration_error(poses[0, 0], poses[0, 0], 10)
    with pytest.raises(InputError, match="rate must be"):
        metrics.acceleration_error(poses, poses, 0)


# ---- confidence


def test_calibration_error_by_hand():
    # stated 0.95, right half of the time; stated 0.15, right as often as that
    confidence = np.array([0.95] * 4 + [0.15] * 20)
    hit = np.array([1, 1, 0, 0] + [1] * 3 + [0] * 17)
    assert metrics.calibration_error(confidence, hit) == pytest.approx(0.45 * 4 / 24)
    assert metrics.calibration_error([1.0, 0.0], [True, False]) == 0


@quick
@given(seeds)
def test_auroc_is_the_share_of_pairs_in_order(seed):
    rng = np.random.default_rng(seed)
    score, hit = rng.integers(0, 6, 30), rng.random(30) < 0.5
    hit[:2] = [True, False]
    order = [(a > b) + 0.5 * (a == b) for a in score[hit] for b in score[~hit]]
    assert metrics.auroc(score, hit) == pytest.approx(np.mean(order))
    with pytest.raises(InputError, match="hits and misses"):
        metrics.auroc(score, np.ones(30))


@pytest.mark.parametrize(
    ("figure", "stated", "hit", "message"),
    [
        (metrics.auroc, [0.5, np.nan], [1, 0], "score must hold numbers, got NaN in 1 of 2"),
        (metrics.auroc, [0.5, 0.1], [1, 0, 1], r"hit must be \(2,\), one a score, got \(3,\)"),
        (metrics.auroc, [[0.5], [0.1]], [[1], [0]], r"score must be \(n,\), got \(2, 1\)"),
        (metrics.auroc, ["a", "b"], [1, 0], "score must hold numbers"),
        (metrics.calibration_error, [np.nan], [1], "confidence must hold numbers, got NaN"),
        (metrics.calibration_error, [95.0, 15.0], [1, 0], "within 0 and 1, got 15 to 95"),
        (metrics.calibration_error, [0.5], [0.5], "hit must be bool, or 0 and 1"),
        (metrics.calibration_error, [0.5], [1, 0], "one a confidence"),
    ],
)
def test_confidence_that_is_none_is_refused(figure, stated, hit, message):
    with pytest.raises(InputError, match=message):
        figure(stated, hit)


def test_confidence_of_nobody_and_bins():
    assert np.isnan(metrics.calibration_error([], []))
    with pytest.raises(InputError, match="bins must be a whole number"):
        metrics.calibration_error([0.5], [1], bins=0)


def test_every_public_name_is_there():
    assert all(hasattr(metrics, name) for name in metrics.__all__) and metrics.__all__ == sorted(metrics.__all__)


def test_the_example_of_the_docs_runs():
    text = (Path(__file__).parents[1] / "docs" / "metrics.md").read_text()
    (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    names = {}
    exec(code, names)
    assert 40 < names["score"] < 60 and names["score"].people == 60


def test_the_docs_name_what_is_there():
    text = (Path(__file__).parents[1] / "docs" / "metrics.md").read_text()
    named = set(re.findall(r"(?:`|metrics\.)(\w+)\(", text)) | set(re.findall(r"`(\w+_\w+)`", text))
    assert len(named) > 12 and named <= set(metrics.__all__), named - set(metrics.__all__)
