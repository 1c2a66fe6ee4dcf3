"""Joint groups, slices, bootstrap intervals of tables."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from lidarpose import metrics
from lidarpose.errors import InputError
from lidarpose.eval.metrics import aggregate
from lidarpose.eval.metrics.aggregate import LEAST_UNITS
from lidarpose.skeleton import HUMAN15, SKELETONS, WAYMO14

quick = settings(max_examples=40, deadline=None)
seeds = st.integers(0, 2**32 - 1)


def drawn(seed, n=30, joints=14, labeled=0.6):
    rng = np.random.default_rng(seed)
    return np.where(rng.random((n, joints)) < labeled, rng.gamma(2, 30, (n, joints)), np.nan)


def slow_mean(table, average):
    rows = [[v for v in row if not np.isnan(v)] for row in table]
    rows = [row for row in rows if row]
    if not rows:
        return np.nan
    return np.mean([np.mean(row) for row in rows]) if average == "person" else np.mean([v for row in rows for v in row])


# ---- groups


@pytest.mark.parametrize("name", SKELETONS)
def test_each_joint_has_one_group(name):
    groups = metrics.joint_groups(name)
    assert list(groups)[-1] == "all" and len(groups["all"]) == len(SKELETONS[name])
    together = np.concatenate([index for group, index in groups.items() if group != "all"])
    assert sorted(together) == list(range(len(SKELETONS[name])))
    # a group has both sides of a joint or neither
    for index in groups.values():
        assert {SKELETONS[name].flip[j] for j in index} == set(index)


def test_joint_groups_of_waymo14_match_the_paper():
    groups = {name: [WAYMO14.joints[j] for j in index] for name, index in metrics.joint_groups(WAYMO14).items()}
    assert list(groups) == ["head", "shoulders", "elbows", "wrists", "hips", "knees", "ankles", "all"]
    assert set(groups["head"]) == {"nose", "head_center"} and groups["knees"] == ["left_knee", "right_knee"]


@quick
@given(seeds, st.sampled_from(metrics.AVERAGES))
def test_by_group_matches_loop(seed, average):
    table = drawn(seed, n=6, labeled=0.25)
    for name, score in metrics.by_group(table, "waymo14", average).items():
        part = table[:, metrics.joint_groups(WAYMO14)[name]]
        assert score == pytest.approx(slow_mean(part, average), nan_ok=True)
        assert score.people == sum(not np.isnan(row).all() for row in part) == 6 - score.skipped
        assert score.joints == (~np.isnan(part)).sum()


def test_by_group_with_empty_and_custom_groups():
    table = drawn(0, joints=15)
    table[:, [HUMAN15.index("left_wrist"), HUMAN15.index("right_wrist")]] = np.nan
    scores = metrics.by_group(table, HUMAN15)
    assert np.isnan(scores["wrists"]) and (scores["wrists"].people, scores["wrists"].skipped) == (0, 30)
    assert np.isfinite(scores["all"])
    legs = metrics.by_group(table, HUMAN15, groups={"left leg": ("left_hip", "left_knee", "left_ankle")})
    assert list(legs) == ["left leg", "all"] and legs["left leg"].joints < scores["all"].joints


def sliced(**change):
    return lambda: metrics.by_span(**{"table": drawn(0), "values": np.ones(30), "edges": (0, 2)} | change)


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: metrics.by_group(drawn(0), "human15"), "human15 has 15 columns, one per joint, got 14"),
        (lambda: metrics.by_group(drawn(0), "waymo"), "unknown skeleton 'waymo'"),
        (lambda: metrics.mean(np.zeros((1, 2, 3))), r"\(people, joints\) or \(people,\), got \(1, 2, 3\)"),
        (lambda: metrics.mean([np.inf]), "got infinity"),
        (lambda: metrics.mean([[1, 2], [3]]), "lists of equal length"),
        (lambda: metrics.mean([1.0], "joint", empty=0.0), 'empty is for average="person"'),
        (lambda: metrics.interval([1.0, 2], 0), "numpy.random.Generator"),
        (lambda: metrics.interval([1.0, 2], np.random.default_rng(0), clusters=[0]), r"clusters must be \(2,\)"),
        (lambda: metrics.interval([1.0, 2], np.random.default_rng(0), level=95), "level must lie between"),
        (lambda: metrics.interval([1.0, 2], np.random.default_rng(0), repeats=0), "repeats must be"),
        (sliced(values=np.zeros(29)), r"values of slices must be \(30,\), one per person, got \(29,\)"),
        (sliced(edges=(0, 0, 1)), "two or more increasing numbers"),
        (sliced(edges=(0,)), "two or more increasing numbers"),
        (sliced(values=["near"] * 30), "values of slices must hold numbers"),
        (sliced(clusters=np.zeros(3)), r"clusters must be \(30,\)"),
    ],
)
def test_scores_reject_invalid_tables_and_options(call, message):
    with pytest.raises(InputError, match=message):
        call()


# ---- slices


@quick
@given(seeds, st.sampled_from(metrics.AVERAGES))
def test_by_span_matches_loop(seed, average):
    rng = np.random.default_rng(seed)
    table = drawn(seed, labeled=0.2)
    distance = np.round(rng.uniform(-2, 45, 30))
    distance[:3] = [np.nan, 10, 40]
    slices = metrics.by_span(table, distance, (0, 10, 20, 40), average)
    counted = 0
    for name, low, high in (("0 to 10", 0, 10), ("10 to 20", 10, 20), ("20 to 40", 20, 40.1)):
        rows = table[[low <= d < high for d in distance]]
        score = slices[name].score
        assert score == pytest.approx(slow_mean(rows, average), nan_ok=True)
        assert score.people + score.skipped == len(rows) and slices[name].interval is None
        counted += len(rows)
    assert list(slices)[-1] == "elsewhere"
    assert slices["elsewhere"].score.people + slices["elsewhere"].score.skipped == 30 - counted > 0


@pytest.mark.parametrize(
    "edges, values, people",
    [
        (metrics.DISTANCE_EDGES, [0, 3, 10, 39, 1000], {"0 to 10": 2, "10 to 20": 1, "20 to 30": 0, "30 and more": 2}),
        (metrics.POINT_EDGES, [0, 49, 50, 400, 10**6], [2, 1, 0, 0, 2]),
        (metrics.OCCLUSION_EDGES, [0, 0.05, 0.1, 0.6, 1.0], [2, 1, 0, 2]),
    ],
)
def test_report_edges_cover_all_people(edges, values, people):
    slices = metrics.by_span(np.arange(5.0), values, edges)
    counts = {name: part.score.people for name, part in slices.items()}
    assert counts == people or list(counts.values()) == people
    assert all(np.isnan(part.score) == (part.score.people == 0) for part in slices.values())


def test_by_span_keeps_spans_of_large_numbers_apart():
    values, edges = np.arange(1_000_000, 1_000_004), [1_000_000, 1_000_001, 1_000_002, 1_000_004]
    slices = metrics.by_span(np.array([10.0, 20, 30, 40]), values, edges)
    assert {name: span.score for name, span in slices.items()} == {
        "1000000 to 1000001": 10, "1000001 to 1000002": 20, "1000002 to 1000004": 35
    }  # fmt: skip


def test_by_span_computes_interval_of_each_slice():
    table, distance, sequence = drawn(1), np.repeat([5.0, 15.0], 15), np.arange(30) // 5
    slices = metrics.by_span(table, distance, (0, 10, 20), rng=np.random.default_rng(0), clusters=sequence)
    assert slices["0 to 10"].interval == metrics.interval(table[:15], np.random.default_rng(0), clusters=sequence[:15])
    for part in slices.values():
        assert part.interval.units == 3 and part.interval.low <= part.score <= part.interval.high


# ---- intervals


def slow_means(table, rng, average, clusters, repeats):
    """Direct bootstrap: draw whole clusters, join their people, take the mean."""
    rows = [row for row in range(len(table)) if not np.isnan(table[row]).all()]
    names = sorted({clusters[row] for row in rows})
    members = [[row for row in rows if clusters[row] == name] for name in names]
    means = []
    for _ in range(repeats):
        drawn = [row for k in rng.integers(len(names), size=len(names)) for row in members[k]]
        means.append(slow_mean(table[drawn], average))
    return means


@quick
@given(seeds, st.sampled_from(metrics.AVERAGES), st.booleans())
def test_bootstrap_means_match_loop(seed, average, clustered):
    table = drawn(seed, n=12, joints=3, labeled=0.4)
    table[0] = 1.0
    clusters = np.random.default_rng(seed).integers(4, size=12) if clustered else np.arange(12)
    fast, units = aggregate.bootstrap_means(
        table, np.random.default_rng(seed), average, clusters=clusters if clustered else None, repeats=20
    )
    np.testing.assert_allclose(fast, slow_means(table, np.random.default_rng(seed), average, clusters, 20))
    assert units == len({c for c, row in zip(clusters, table, strict=True) if not np.isnan(row).all()})


def test_interval_does_not_depend_on_block_size(monkeypatch):
    table = drawn(2)
    whole = metrics.interval(table, np.random.default_rng(0))
    monkeypatch.setattr(aggregate, "_BLOCK", 100)
    assert metrics.interval(table, np.random.default_rng(0)) == whole
    assert metrics.interval(table, np.random.default_rng(1)) != whole


def test_interval_width_matches_theory():
    values = np.random.default_rng(0).normal(100, 20, 400)
    found = metrics.interval(values, np.random.default_rng(0))
    half = 1.96 * values.std() / 20
    assert found.low == pytest.approx(values.mean() - half, abs=0.3)
    assert found.high == pytest.approx(values.mean() + half, abs=0.3)
    empty = metrics.interval(np.full((4, 3), np.nan), np.random.default_rng(0))
    assert np.isnan([empty.low, empty.high]).all() and empty.units == 0
    narrow = metrics.interval(values, np.random.default_rng(0), level=0.5)
    assert found.low < narrow.low < narrow.high < found.high


@pytest.mark.parametrize("units, least, most", [(2, 40, 60), (LEAST_UNITS, 80, 94), (20, 88, 97)])
def test_interval_coverage_with_few_units(units, least, most):
    """With few units the coverage is too low; therefore no interval is stated for them."""
    held = 0
    for seed in range(400):
        values = np.random.default_rng(seed).normal(100, 20, units)
        found = metrics.interval(values, np.random.default_rng(seed), repeats=500)
        held += found.low <= 100 <= found.high
    assert least < held / 4 < most


@pytest.mark.parametrize("units, is_stated", [(9, False), (10, True)])
def test_interval_stated_requires_ten_units(units, is_stated):
    found = metrics.interval(np.arange(float(units)), np.random.default_rng(0), repeats=100)
    assert found.units == units and (found.stated == ((found.low, found.high) if is_stated else (None, None)))


def test_interval_without_width_is_not_stated():
    for value in (0.0, 100.0):
        found = metrics.interval(np.full(30, value), np.random.default_rng(0))
        assert found.low == found.high == value and found.stated == (None, None)
    found = metrics.interval(np.append(np.full(29, 100.0), 0.0), np.random.default_rng(0))
    assert found.stated == (found.low, found.high)


def test_clusters_widen_interval():
    rng = np.random.default_rng(0)
    sequence = np.repeat(np.arange(20), 50)
    values = rng.normal(100, 20, 20)[sequence] + rng.normal(0, 2, 1000)
    people = metrics.interval(values, np.random.default_rng(0))
    whole = metrics.interval(values, np.random.default_rng(0), clusters=sequence)
    assert whole.units == 20 and people.units == 1000
    # 50 strongly correlated frames per sequence make it about sqrt(50) times as wide
    assert 5 < (whole.high - whole.low) / (people.high - people.low) < 9
    names = np.array([f"seq{k}" for k in sequence])
    assert metrics.interval(values, np.random.default_rng(0), clusters=names).units == 20


def test_paired_interval_cancels_common_variation():
    first = np.random.default_rng(0).normal(100, 30, 300)
    second = first - 2 + np.random.default_rng(1).normal(0, 1, 300)
    found = metrics.paired_interval(first, second, np.random.default_rng(0))
    assert found.low < (first - second).mean() < found.high < found.low + 0.3
    alone = metrics.interval(first, np.random.default_rng(0))
    assert alone.high - alone.low > 5
    with pytest.raises(InputError, match="same joints labeled"):
        metrics.paired_interval(first, np.where(first > 100, np.nan, second), np.random.default_rng(0))
