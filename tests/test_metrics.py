"""MPJPE, PA-MPJPE, PCK, acceleration, calibration: definitions, properties, errors; the released code's arithmetic."""

import itertools
import pickle
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st

from lidarpose import metrics
from lidarpose.errors import InputError
from lidarpose.eval.metric_rows import METRICS, SUMMARIES
from lidarpose.geometry import axis_angle_to_matrix, similarity_align
from lidarpose.inference.results import PersonPose, Poses
from lidarpose.sample import Pose
from lidarpose.skeleton import SKELETONS, as_skeleton

REFERENCE = Path(__file__).parent / "parity" / "metrics.npz"
DISTANCES = (metrics.mpjpe, metrics.pa_mpjpe, metrics.pck)
quick = settings(max_examples=40, deadline=None)
seeds = st.integers(0, 2**32 - 1)


def drawn(seed, n=3, joints=14, noise=0.1):
    """pred, true (n, joints, 3) m, visible (n, joints), with at least one visible joint per person."""
    rng = np.random.default_rng(seed)
    true = rng.normal(size=(n, joints, 3)) * 0.4
    visible = rng.random((n, joints)) < 0.7
    visible[np.arange(n), rng.integers(joints, size=n)] = True
    return true + rng.normal(size=true.shape) * noise, true, visible


def blanked(true, visible):
    """The truth, with NaN for unlabeled joints."""
    return np.where(visible[..., None], true, np.nan)


# ---- properties


@quick
@given(seeds, st.integers(1, 5), st.sampled_from(["human15", "waymo14"]))
def test_root_mpjpe_ignores_translations_alone(seed, n, name):
    skeleton = as_skeleton(name)
    pred, true, visible = drawn(seed, n, len(skeleton))
    root = [skeleton.index(joint) for joint in (("pelvis",) if name == "human15" else ("left_hip", "right_hip"))]
    visible[:, root] = True
    score = metrics.root_mpjpe(pred, true, visible, skeleton=name)
    moved = pred + np.random.default_rng(seed).normal(size=(n, 1, 3))
    assert metrics.root_mpjpe(moved, true, visible, skeleton=skeleton) == pytest.approx(score, abs=1e-6)
    # the slow twin: one joint at a time
    errors = np.full(visible.shape, np.nan)
    for i, j in zip(*np.nonzero(visible), strict=True):
        offsets = [joints[i, j] - sum(joints[i, k] for k in root) / len(root) for joints in (pred, true)]
        errors[i, j] = 1e3 * np.sqrt(((offsets[0] - offsets[1]) ** 2).sum())
    assert score == pytest.approx(np.nanmean(np.nanmean(errors, 1)))
    # people without the root are skipped
    visible[0, root[-1]] = False
    assert metrics.root_mpjpe(pred, true, visible, skeleton=name).skipped == 1
    with pytest.raises(InputError, match="human15 has 15 joints, got 3"):
        metrics.root_mpjpe(pred[:, :3], true[:, :3], skeleton="human15")


@quick
@given(seeds, st.integers(1, 5), st.floats(0.2, 5), st.booleans())
def test_pa_mpjpe_ignores_similarities_but_not_mirrors(seed, n, scale, masked):
    pred, true, visible = drawn(seed, n)
    visible[:, :3] = True
    visible = visible if masked else None
    rng = np.random.default_rng(seed)
    R = np.swapaxes(axis_angle_to_matrix(rng.normal(size=(n, 3))), 1, 2)
    moved, exact = (scale * joints @ R + rng.normal(size=(n, 1, 3)) * 5 for joints in (pred, true))
    assert metrics.pa_mpjpe(moved, true, visible) == pytest.approx(metrics.pa_mpjpe(pred, true, visible), abs=1e-6)
    assert metrics.pa_mpjpe(exact, true, visible) == pytest.approx(0, abs=1e-6)
    assert metrics.pa_mpjpe(true * [1, -1, 1], true) > 10


@quick
@given(seeds, st.integers(1, 5), st.sampled_from(metrics.AVERAGES))
def test_metrics_of_exact_predictions_order_and_missing_truth(seed, n, average):
    pred, true, visible = drawn(seed, n)
    rng = np.random.default_rng(seed)
    order, people = rng.permutation(14), rng.permutation(n)
    for metric in DISTANCES:
        score = metric(pred, true, visible, average=average)
        # the order of joints and people does not matter; unlabeled equals missing in the truth
        permuted = (array[people][:, order] for array in (pred, true, visible))
        for same in (metric(*permuted, average=average), metric(pred, blanked(true, visible), average=average)):
            assert same == pytest.approx(score, nan_ok=True) and same.__dict__ == score.__dict__
    visible[:, :3] = True
    for labels, dapt_compat in itertools.product((None, visible), (False, True)):
        scores = [metric(true, true, labels, dapt_compat) for metric in DISTANCES]
        assert scores == pytest.approx([0, 0, 100], abs=1e-9)
    assert metrics.acceleration_error(true[:, :, None], true[:, :, None], 10) == 0


@quick
@given(seeds, st.integers(1, 5))
def test_metric_tables_match_loops(seed, n):
    pred, true, visible = drawn(seed, n, noise=0.2)
    functions = (metrics.joint_errors, metrics.aligned_errors, metrics.joint_hits)
    # a joint is labeled only if all of its coordinates are
    errors, aligned, hits = (table(pred, np.where(visible[..., None], true, [0, np.nan, 0])) for table in functions)
    for i, seen in enumerate(visible):
        plain = np.linalg.norm(pred[i] - true[i], axis=1)
        np.testing.assert_allclose(errors[i][seen], plain[seen] * 1e3)
        np.testing.assert_array_equal(hits[i][seen], [100 if e < 0.3 * 0.5127067 else 0 for e in plain[seen]])
        if seen.sum() >= 3:
            moved = similarity_align(pred[i][seen], true[i][seen])
            np.testing.assert_allclose(aligned[i][seen], np.linalg.norm(moved - true[i][seen], axis=1) * 1e3, atol=1e-9)
        else:
            assert np.isnan(aligned[i]).all()
        assert np.isnan(np.stack([errors, aligned, hits])[:, i, ~seen]).all()


# ---- definitions


def test_metrics_average_over_people_or_joints():
    true = np.zeros((2, 4, 3))
    pred = true.copy()
    pred[0, :, 0], pred[1, :, 0] = 0.1, 0.4
    visible = [[1, 1, 1, 1], [1, 0, 0, 0]]
    for metric, of_people, of_joints in ((metrics.mpjpe, (100 + 400) / 2, (4 * 100 + 400) / 5), (metrics.pck, 50, 80)):
        assert metric(pred, true, visible) == pytest.approx(of_people)
        assert metric(pred, true, visible, average="joint") == pytest.approx(of_joints)


def test_pck_counts_joints_closer_than_threshold():
    true = np.zeros((1, 4, 3))
    pred = true.copy()
    pred[0, :, 2] = [0.153, 0.155, 0.256, 0.257]
    options = ({}, {"threshold": 0.5}, {"threshold": 0.5, "torso": 0.52})
    assert [metrics.pck(pred, true, **own) for own in options] == [25, 75, 100]
    pred[0, :, 2] = 0.25
    assert metrics.pck(pred, true, threshold=0.5, torso=0.5) == 0


def test_pa_mpjpe_skips_people_with_two_labels():
    pred, true, visible = drawn(3, n=4)
    visible[:] = True
    visible[2, 2:] = False
    score, others = metrics.pa_mpjpe(pred, true, visible), [0, 1, 3]
    assert score == pytest.approx(metrics.pa_mpjpe(pred[others], true[others])) and score.skipped == 1
    # three are enough
    visible[2, 2] = True
    assert metrics.pa_mpjpe(pred, true, visible).skipped == 0


def test_score_of_no_people_is_nan_and_score_is_float():
    pred, true, _ = drawn(0)
    for metric, average in itertools.product(DISTANCES, metrics.AVERAGES):
        score = metric(pred, true, np.zeros((3, 14)), average=average)
        assert np.isnan(score) and (score.people, score.joints, score.skipped) == (0, 0, 3)
    assert np.isnan(metrics.mpjpe(np.empty((0, 14, 3)), np.empty((0, 14, 3))))
    score = metrics.mpjpe(*drawn(1))
    back = pickle.loads(pickle.dumps(score))
    assert back == score and back.people == score.people == 3
    assert f"{score:.1f}" == f"{float(score):.1f}" and isinstance(score, float)


def test_metrics_accept_lists_single_people_and_leading_axes():
    arrays = drawn(7, n=6)
    copies = [array.copy() for array in arrays]
    score = metrics.mpjpe(*arrays)
    assert metrics.mpjpe(*(array.tolist() for array in arrays)) == score
    assert metrics.mpjpe(*(array.reshape(2, 3, *array.shape[1:]) for array in arrays)) == score
    single = metrics.mpjpe(*(array[0] for array in arrays))
    assert single == pytest.approx(metrics.mpjpe(*(array[:1] for array in arrays))) and single.people == 1
    metrics.pa_mpjpe(*arrays)
    for before, after in zip(copies, arrays, strict=True):
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
        ({"visible": np.ones((3, 13))}, r"visible must be \(3, 14\), one per joint, got \(3, 13\)"),
        ({"visible": np.full((3, 14), 2)}, "codes > 0"),
        ({"visible": np.full((3, 14), np.nan)}, "bool, or 0 and 1"),
        ({"pred": [[[0, 0, 0]], [[0, 0]]]}, "pred must hold numbers, in lists of equal length"),
        ({"average": "persons"}, "did you mean person"),
        ({"legacy": True, "average": "joint"}, "averages over people"),
    ],
)
@pytest.mark.parametrize("metric", DISTANCES)
def test_metrics_reject_bad_input_in_one_line(metric, change, message):
    arguments = dict(zip(("pred", "true", "visible"), drawn(0), strict=True))
    with pytest.raises(InputError, match=message) as caught:
        metric(**arguments | change)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name, value", [("threshold", 0), ("torso", np.nan)])
def test_pck_rejects_bad_threshold_and_torso(name, value):
    with pytest.raises(InputError, match=f"{name} must be a positive number"):
        metrics.pck(*drawn(0), **{name: value})


# ---- acceleration


def test_acceleration_error_of_known_motion():
    rng = np.random.default_rng(0)
    time = np.arange(8) / 20
    true = rng.normal(size=(3, 8, 5, 3))
    # uniform motion has no error, free fall that of its acceleration
    even = true + (rng.normal(size=(3, 1, 5, 3)) + time[:, None, None] * [1.0, 2, 3])
    assert metrics.acceleration_error(even, true, 20) == pytest.approx(0, abs=1e-6)
    falling = true + 0.5 * 9.81 * time[:, None, None] ** 2 * [0, 0, 1.0]
    assert metrics.acceleration_error(falling, true, 20) == pytest.approx(9810)
    assert np.isnan(metrics.acceleration_error(true[:0], true[:0], 20))
    assert metrics.acceleration_error(falling, true, 1) == pytest.approx(9810 / 400)
    assert metrics.acceleration_error(falling[0], true[0], 20) == pytest.approx(9810)


@quick
@given(seeds, st.sampled_from(metrics.AVERAGES))
def test_acceleration_error_matches_loop(seed, average):
    rng = np.random.default_rng(seed)
    pred, true = rng.normal(size=(2, 3, 6, 4, 3))
    visible = rng.random((3, 6, 4)) < 0.8
    each = [[], [], []]
    for i, t, j in itertools.product(range(3), range(1, 5), range(4)):
        if visible[i, t - 1 : t + 2, j].all():
            a, b = (x[i, t - 1, j] - 2 * x[i, t, j] + x[i, t + 1, j] for x in (pred, true))
            each[i].append(np.linalg.norm(a - b) * 1e5)
    seen = [errors for errors in each if errors]
    joints = np.concatenate(seen) if seen else [np.nan]
    wanted = np.mean([np.mean(errors) for errors in seen] if seen and average == "person" else joints)
    score = metrics.acceleration_error(pred, true, 10, visible, average=average)
    assert score == pytest.approx(wanted, nan_ok=True) and (score.people, score.skipped) == (len(seen), 3 - len(seen))


@pytest.mark.parametrize(
    "shape, rate, message",
    [
        ((2, 2, 5, 3), 10, "3 frames or more, got 2"),
        ((5, 3), 10, r"\(..., frames, joints, 3\)"),
        ((2, 4, 5, 3), 0, "rate must be"),
    ],
)
def test_acceleration_error_rejects_bad_shape_and_rate(shape, rate, message):
    with pytest.raises(InputError, match=message):
        metrics.acceleration_error(np.zeros(shape), np.zeros(shape), rate)


# ---- confidence


def test_calibration_error_by_hand():
    # confidence 0.95 with 50 % hits, confidence 0.15 with 15 % hits
    confidence = np.array([0.95] * 4 + [0.15] * 20)
    hit = np.array([1, 1, 0, 0] + [1] * 3 + [0] * 17)
    assert metrics.calibration_error(confidence, hit) == pytest.approx(0.45 * 4 / 24)
    assert metrics.calibration_error([1.0, 0.0], [True, False]) == 0
    # a confidence of 1 is in the last bin, not in the first
    assert metrics.calibration_error([1.0, 0.05], [False, True]) == pytest.approx((1 + 0.95) / 2)
    assert np.isnan(metrics.calibration_error([], []))


@quick
@given(seeds)
def test_auroc_is_share_of_ordered_pairs(seed):
    rng = np.random.default_rng(seed)
    score, hit = rng.integers(0, 6, 30), rng.random(30) < 0.5
    hit[:2] = [True, False]
    order = [(a > b) + 0.5 * (a == b) for a in score[hit] for b in score[~hit]]
    assert metrics.auroc(score, hit) == pytest.approx(np.mean(order))


@pytest.mark.parametrize(
    ("metric", "stated", "hit", "options", "message"),
    [
        (metrics.auroc, [0.5, 0.1], [1, 1], {}, "needs hits and misses, got 2 hits and 0 misses"),
        (metrics.auroc, [0.5, np.nan], [1, 0], {}, "score must hold numbers, got NaN in 1 of 2"),
        (metrics.auroc, [0.5, 0.1], [1, 0, 1], {}, r"hit must be \(2,\), one per score, got \(3,\)"),
        (metrics.auroc, [[0.5], [0.1]], [[1], [0]], {}, r"score must be \(n,\), got \(2, 1\)"),
        (metrics.auroc, ["a", "b"], [1, 0], {}, "score must hold numbers"),
        (metrics.calibration_error, [np.nan], [1], {}, "confidence must hold numbers, got NaN"),
        (metrics.calibration_error, [95.0, 15.0], [1, 0], {}, "within 0 and 1, got 15 to 95"),
        (metrics.calibration_error, [0.5], [0.5], {}, "hit must be bool, or 0 and 1"),
        (metrics.calibration_error, [0.5], [1, 0], {}, "one per confidence"),
        (metrics.calibration_error, [0.5], [1], {"bins": 0}, "bins must be a whole number"),
    ],
)
def test_confidence_metrics_reject_bad_input(metric, stated, hit, options, message):
    with pytest.raises(InputError, match=message):
        metric(stated, hit, **options)


# ---- arithmetic of the released code: dapt_compat reproduces its faults, the default does not have them


@pytest.mark.parametrize("dapt_compat", [True, False])
def test_metrics_match_released_code(dapt_compat):
    with np.load(REFERENCE) as file:
        reference = dict(file)
    # everyone is labeled and the batch is large: the faults have no effect and both agree
    pred, true, visible = reference["pred"], reference["gt"], reference["vis"]
    scores = {
        "mpjpe_vis": metrics.mpjpe(pred, true, visible, dapt_compat) / 1e3,
        "mpjpe_full": metrics.mpjpe(pred, true, dapt_compat=dapt_compat) / 1e3,
        "pa_full": metrics.pa_mpjpe(pred, true, legacy=dapt_compat) / 1e3,
        "pck30_vis": metrics.pck(pred, true, visible, legacy=dapt_compat) / 100,
        "pck50_vis": metrics.pck(pred, true, visible, dapt_compat, threshold=0.5) / 100,
    }
    assert scores == pytest.approx({name: float(reference[name]) for name in scores}, abs=1e-6)
    # labels and thresholds make a difference
    assert abs(scores["mpjpe_vis"] - scores["mpjpe_full"]) > 1e-3 < abs(scores["pck30_vis"] - scores["pck50_vis"])


def test_dapt_compat_unlabeled_people_have_zero_error_and_nan_pck():
    true = np.zeros((2, 2, 3))
    pred, visible = true + [0.1, 0, 0], [[1, 1], [0, 0]]
    assert metrics.mpjpe(pred, true, visible, dapt_compat=True) == pytest.approx(50)
    ours = metrics.mpjpe(pred, true, visible)
    assert ours == pytest.approx(100) and (ours.people, ours.joints, ours.skipped) == (1, 2, 1)
    pred, true, visible = drawn(4, n=4)
    visible[:], visible[1], others = True, False, [0, 2, 3]
    theirs = metrics.pa_mpjpe(pred, true, visible, dapt_compat=True)
    assert theirs == pytest.approx(0.75 * metrics.pa_mpjpe(pred, true, visible)) and theirs.people == 4
    assert np.isnan(metrics.pck(pred, true, visible, dapt_compat=True))
    ours = metrics.pck(pred, true, visible)
    assert ours == pytest.approx(metrics.pck(pred[others], true[others])) and ours.skipped == 1


def test_by_group_with_empty_zero_halves_error_of_sparse_labels():
    rng = np.random.default_rng(0)
    true = rng.normal(size=(4000, 14, 3))
    table = metrics.joint_errors(true + [0, 0.1, 0], true, rng.random((4000, 14)) < 0.3)
    theirs, ours = metrics.by_group(table, "waymo14", empty=0.0), metrics.by_group(table, "waymo14")
    for name in ("wrists", "ankles", "head"):
        # 1 - 0.7^2 of the people have at least one label
        assert theirs[name] == pytest.approx(51, abs=3) and ours[name] == pytest.approx(100)
        assert ours[name].people + ours[name].skipped == theirs[name].people == 4000
    assert theirs["all"] > 99


def transposed_procrustes(source, target):
    """The reference's alignment of one person's (D, N) columns, following its equations."""
    s, t = source - source.mean(1, keepdims=True), target - target.mean(1, keepdims=True)
    u, d, vt = np.linalg.svd(s @ t.T)
    z = np.eye(len(u))
    z[-1, -1] = np.sign(np.linalg.det(u @ vt))
    rotation = vt.T @ z @ u.T
    scale = np.trace(rotation @ s @ t.T) / (s**2).sum()
    return scale * rotation @ s + target.mean(1, keepdims=True)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5])
def test_dapt_compat_alignment_transposes_two_and_three_people(n):
    pred, true, _ = drawn(n, n, noise=0.05)
    turned = n in (2, 3)
    pairs = [(a, b) if turned else (a.T, b.T) for a, b in zip(pred, true, strict=True)]
    moved = np.stack([aligned if turned else aligned.T for aligned in (transposed_procrustes(*pair) for pair in pairs)])
    theirs, ours = metrics.pa_mpjpe(pred, true, dapt_compat=True), metrics.pa_mpjpe(pred, true)
    assert theirs == pytest.approx(np.linalg.norm(moved - true, axis=-1).mean() * 1e3)
    assert theirs < 0.4 * ours if turned else theirs == pytest.approx(ours)


def test_dapt_compat_alignment_uses_unlabeled_joints():
    pred, true, visible = drawn(5, n=6)
    visible[:, :4] = [True, True, True, False]
    worse = pred.copy()
    worse[:, 3] += 2
    assert metrics.pa_mpjpe(worse, true, visible) == pytest.approx(metrics.pa_mpjpe(pred, true, visible))
    theirs = [metrics.pa_mpjpe(own, true, visible, dapt_compat=True) for own in (pred, worse)]
    assert theirs[1] > 1.2 * theirs[0]
    with pytest.raises(InputError, match="must hold no NaN"):
        metrics.pa_mpjpe(pred, blanked(true, visible), dapt_compat=True)


# ---- public interface


def test_metrics_docs_are_complete_and_example_runs():
    assert all(hasattr(metrics, name) for name in metrics.__all__) and metrics.__all__ == sorted(metrics.__all__)
    text = (Path(__file__).parents[1] / "docs" / "evaluate.md").read_text("utf-8")
    for name in (*METRICS, *SUMMARIES):
        assert re.search(rf"`{name.partition('@')[0]}[`@]", text), name
    text = text[text.index("\n## Metrics") :]
    (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    names = {}
    exec(code, names)
    assert 40 < names["score"] < 60 and names["score"].people == 60
    named = set(re.findall(r"(?:`|metrics\.)(\w+)\(", text)) | set(re.findall(r"`(\w+_\w+)`", text))
    known = {*metrics.__all__, "dapt_compat", "turned_round"}
    assert len(named) > 12 and named <= known, named - known


def test_metrics_ignore_masked_joints():
    true = np.zeros((6, 15, 3))
    pred, mask = true + 0.01, np.zeros(true.shape, bool)
    pred[:, 0] += 5
    mask[:, 0] = True
    visible = np.ma.array(np.ones((6, 15)), mask=mask[..., 0])
    masked = np.ma.array(true, mask=mask)
    for arguments in ((masked,), (list(masked),), (true, visible)):
        assert metrics.mpjpe(pred, *arguments) == pytest.approx(17.32, abs=0.01)
    with_gradient = torch.tensor(pred[:, 1:], requires_grad=True)
    assert metrics.mpjpe(with_gradient, true[:, 1:]) == pytest.approx(17.32, abs=0.01)


@pytest.mark.parametrize("options", [{"repeats": 1.5}, {"repeats": True}, {"level": "x"}, {"level": 1.0}])
def test_interval_rejects_bad_options(options):
    with pytest.raises(InputError, match=next(iter(options))):
        metrics.interval(np.ones(9), np.random.default_rng(0), **options)


def test_interval_accepts_missing_cluster_labels():
    table, rng = np.arange(6.0), np.random.default_rng(0)
    some = metrics.interval(table, rng, clusters=["a", None, "b", "b", "a", None])
    assert some.units == 3
    # numbers are sorted as numbers, not as text
    units = np.repeat(np.arange(12), 2)
    intervals = [
        metrics.interval(np.arange(24.0) ** 2, np.random.default_rng(0), clusters=c) for c in (units, units + 100)
    ]
    assert intervals[0] == intervals[1]


def test_metrics_take_poses_as_predicted():
    joints = np.random.default_rng(0).normal(size=(2, 15, 3))
    skeleton = SKELETONS["human15"]
    people = tuple(
        PersonPose(pose=Pose(joints=own, skeleton=skeleton), points=np.zeros((9, 3)), skeleton=skeleton)
        for own in joints
    )
    poses = Poses(people=people, skeleton=skeleton)
    assert metrics.mpjpe(poses, joints + [0, 0, 0.01]) == pytest.approx(10)
