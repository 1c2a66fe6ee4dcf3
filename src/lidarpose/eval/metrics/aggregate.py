"""From joint errors to scores: means, bootstrap intervals, groups of joints, spans of people, calibration.

A table is (n, J), one row per person and one column per joint, in millimeters or percent, or (n,) for one value per
person. NaN means that there is nothing to score: a joint without a label.

Intervals are percentile bootstraps (Efron & Tibshirani 1993, chapter 13). With clusters, whole clusters are drawn
instead of people: frames of one sequence show the same person in nearly the same pose, and drawing them one by one
gives far too narrow intervals. Intervals of few units are too narrow as well: for normally distributed values, 95 %
intervals covered the truth in 93 % of trials with 20 units, in 90 % with 10, in 49 % with two.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike

from lidarpose.arrays import to_numpy
from lidarpose.errors import InputError, check_int, check_name
from lidarpose.inference.results import Poses
from lidarpose.skeleton import Skeleton, as_skeleton

# ways to average: "person", over people the mean of each person's joints; "joint", over all joints alike
AVERAGES = ("person", "joint")
_LIMB_JOINTS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
# the groups that the paper and Waymo report (head to ankles), and groups for the joints that only SMPL has
GROUPS = {
    "head": ("head", "nose", "head_center"),
    **{f"{name}s": (f"left_{name}", f"right_{name}") for name in _LIMB_JOINTS},
    "trunk": ("pelvis", "spine1", "spine2", "spine3", "neck", "left_collar", "right_collar"),
    "hands": ("left_hand", "right_hand"),
    "feet": ("left_foot", "right_foot"),
}
# edges of spans in this project's reports: meters, points per person, share of the body that is hidden
DISTANCE_EDGES = (0.0, 10.0, 20.0, 30.0, np.inf)
POINT_EDGES = (0, 50, 100, 200, 400, np.inf)
OCCLUSION_EDGES = (0.0, 0.1, 0.3, 0.5, 1.0)
# an evaluation reports no interval for fewer people or clusters
LEAST_UNITS = 10
# random indices held in memory at once
_BLOCK = 1 << 21


# ---- validation of arguments


def as_numbers(name: str, value: ArrayLike | Poses) -> np.ndarray:
    """An array of floats, NaN where masked; of `Poses`, the joints. Raises InputError for other content or lists of
    unequal length."""
    value = value.to_numpy() if isinstance(value, Poses) else value
    try:
        value = list(map(to_numpy, value)) if isinstance(value, list | tuple) else to_numpy(value)
        return np.asarray(value, float)
    except (TypeError, ValueError):
        raise InputError(f"{name} must hold numbers, in lists of equal length") from None


def as_flags(name: str, value: ArrayLike, shape: tuple[int, ...], *, of: str = "joint") -> np.ndarray:
    """A bool array of a shape, from bool or 0 and 1, False where masked. Raises InputError for anything else.

    Args:
        of: what each flag belongs to, for the error message.
    """
    flags = as_numbers(name, np.ma.filled(value, 0) if isinstance(value, np.ma.MaskedArray) else value)
    if flags.shape != shape:
        raise InputError(f"{name} must be {shape}, one per {of}, got {flags.shape}")
    if not ((flags == 0) | (flags == 1)).all():
        raise InputError(f"{name} must be bool, or 0 and 1; of other codes pass a comparison, such as codes > 0")
    return flags == 1


def as_table(table: ArrayLike) -> np.ndarray:
    """A table as (n, J) float. Raises InputError for another shape or infinite entries."""
    table = as_numbers("a table of scores", table)
    if table.ndim not in (1, 2):
        raise InputError(f"a table of scores must be (people, joints) or (people,), got {table.shape}")
    if np.isinf(table).any():
        raise InputError("a table of scores must be finite, or NaN where a joint has no label; got infinity")
    return table[:, None] if table.ndim == 1 else table


def check_positive(name: str, value: float) -> None:
    """Raises InputError unless `value` is a positive, finite number."""
    if not (isinstance(value, Real) and np.isfinite(value) and value > 0):
        raise InputError(f"{name} must be a positive number, got {value!r}")


def _cluster_labels(clusters: ArrayLike | None, count: int) -> np.ndarray | None:
    if clusters is not None and np.shape(clusters) != (count,):
        raise InputError(f"clusters must be ({count},), one label per person, got {np.shape(clusters)}")
    if clusters is None:
        return None
    labels = np.asarray(clusters)
    try:
        np.unique(labels)
    except TypeError:
        # labels of several types, such as text and None for missing ones, cannot be sorted
        return np.array([repr(label) for label in labels.tolist()])
    return labels


# ---- means


class Score(float):
    """A score in millimeters or percent with the number of people and joints behind it.

    people: number of people averaged over; joints: number of their labeled joints; skipped: people without anything to
    score, who are excluded. The score of no people is NaN.
    """

    people: int
    joints: int
    skipped: int

    def __new__(cls, value: float, *, people: int = 0, joints: int = 0, skipped: int = 0):
        score = super().__new__(cls, value)
        score.people, score.joints, score.skipped = people, joints, skipped
        return score


def mean(table: ArrayLike, average: str = "person", *, empty: float | None = None) -> Score:
    """The mean of a table (n, J) or (n,).

    Args:
        average: "person", the mean over people of the mean over each person's labeled joints; "joint", the mean over
            all labeled joints of all people, so that people with more labeled joints weigh more.
        empty: the value of a person without labeled joints in the mean over people; None excludes these people and
            counts them as skipped.
    """
    check_name("average", average, AVERAGES)
    if average == "joint" and empty is not None:
        raise InputError('empty is for average="person": people without labeled joints have no effect on the other')
    total, count = _person_sums(as_table(table))
    is_counted = count > 0 if empty is None else np.ones(len(count), bool)
    person_means = np.where(count > 0, total / np.maximum(count, 1), np.nan if empty is None else empty)
    people, joints = int(is_counted.sum()), int(count.sum())
    value = np.nan
    if people:
        value = total.sum() / joints if average == "joint" else person_means[is_counted].mean()
    return Score(value, people=people, joints=joints, skipped=len(count) - people)


def _person_sums(table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Table (n, J) -> (n,) sum over each person's labeled joints, (n,) number of these."""
    is_labeled = ~np.isnan(table)
    return np.where(is_labeled, table, 0.0).sum(1), is_labeled.sum(1)


# ---- intervals


@dataclass(frozen=True, kw_only=True)
class Interval:
    """low, high: ends, in the table's unit, NaN if there was nothing to draw; level: share of draws between them;
    units: number of people or clusters drawn from; repeats: number of draws."""

    low: float
    high: float
    level: float
    units: int
    repeats: int

    @property
    def stated(self) -> tuple[float, float] | tuple[None, None]:
        """low and high as an evaluation reports them; None for fewer than `LEAST_UNITS` units or if all draws are
        equal, such as 100 %: the interval would have no width."""
        return (self.low, self.high) if self.units >= LEAST_UNITS and self.low < self.high else (None, None)


def interval(
    table: ArrayLike,
    rng: np.random.Generator,
    average: str = "person",
    *,
    clusters: ArrayLike | None = None,
    level: float = 0.95,
    repeats: int = 2000,
) -> Interval:
    """The bootstrap interval of `mean` of a table (n, J) or (n,).

    Args:
        clusters: (n,) each person's sequence, subject or other label; people with the same label are drawn together.
            People without labeled joints are excluded, as in the mean.
    """
    if not isinstance(rng, np.random.Generator):
        raise InputError(f"rng must be a numpy.random.Generator, such as default_rng(0), got {type(rng).__name__}")
    check_positive("level", level)
    if not level < 1:
        raise InputError(f"level must lie between 0 and 1, got {level}")
    repeats = check_int("repeats", repeats, least=1)
    check_name("average", average, AVERAGES)
    table = as_table(table)
    draws, units = bootstrap_means(table, rng, average, clusters=_cluster_labels(clusters, len(table)), repeats=repeats)
    low, high = np.quantile(draws, [(1 - level) / 2, (1 + level) / 2]).tolist() if units else (np.nan, np.nan)
    return Interval(low=low, high=high, level=level, units=units, repeats=repeats)


def paired_interval(
    first: ArrayLike,
    second: ArrayLike,
    rng: np.random.Generator,
    average: str = "person",
    *,
    clusters: ArrayLike | None = None,
    level: float = 0.95,
    repeats: int = 2000,
) -> Interval:
    """The interval of mean(first) - mean(second): two models' tables of the same people with the same labels.

    Each draw takes the same people from both tables, so people that are hard for both do not widen the interval.
    """
    first, second = as_table(first), as_table(second)
    if first.shape != second.shape or (np.isnan(first) != np.isnan(second)).any():
        raise InputError("tables to compare must be of the same people, with the same joints labeled")
    return interval(first - second, rng, average, clusters=clusters, level=level, repeats=repeats)


def bootstrap_means(
    table: np.ndarray, rng: np.random.Generator, average: str, *, clusters: np.ndarray | None, repeats: int
) -> tuple[np.ndarray, int]:
    """(repeats,) means of the draws, and the number of units drawn from; without any, NaN and 0."""
    total, count = _person_sums(table)
    has_label = count > 0
    total, count = total[has_label], count[has_label]
    if average == "person":
        total, count = total / count, np.ones(len(count))
    if clusters is not None:
        labels, cluster = np.unique(clusters[has_label], return_inverse=True)
        total, count = (np.bincount(cluster, values, minlength=len(labels)) for values in (total, count))
    units = len(total)
    means = np.full(repeats, np.nan)
    block_size = max(1, _BLOCK // max(units, 1))
    for start in range(0, repeats if units else 0, block_size):
        indices = rng.integers(units, size=(min(block_size, repeats - start), units))
        means[start : start + len(indices)] = total[indices].sum(1) / count[indices].sum(1)
    return means, units


# ---- groups of joints


def joint_groups(of: Skeleton | str, groups: Mapping[str, Sequence[str]] = GROUPS) -> dict[str, np.ndarray]:
    """Group -> indices of its joints in the skeleton, by name. Groups without such a joint are left out; "all" is last.

    Args:
        of: a skeleton or its name.
    """
    of = as_skeleton(of)
    indices = {
        name: np.array([of.index(joint) for joint in joints if joint in of.joints], int)
        for name, joints in groups.items()
    }
    return {name: index for name, index in indices.items() if len(index)} | {"all": np.arange(len(of))}


def by_group(
    table: ArrayLike,
    of: Skeleton | str,
    average: str = "person",
    *,
    groups: Mapping[str, Sequence[str]] = GROUPS,
    empty: float | None = None,
) -> dict[str, Score]:
    """`mean` of a table (n, J) for each joint group of the skeleton; NaN for a group without any label."""
    table, of = as_table(table), as_skeleton(of)
    if table.shape[1] != len(of):
        raise InputError(f"a table of {of.name} has {len(of)} columns, one per joint, got {table.shape[1]}")
    return {name: mean(table[:, index], average, empty=empty) for name, index in joint_groups(of, groups).items()}


# ---- spans of people: distance, number of points, occlusion or any other number per person


@dataclass(frozen=True, kw_only=True)
class Slice:
    """The people in one span of distance, points or occlusion: their score and, if requested, its interval."""

    score: Score
    interval: Interval | None = None


def span_rows(values: np.ndarray, edges: Sequence[float] | np.ndarray) -> dict[str, np.ndarray]:
    """Span -> (n,) bool: values (n,) in it. A span includes its lower edge; the last one also its upper edge."""
    rows, texts = {}, [f"{edge:g}" for edge in edges]
    if len(set(texts)) < len(texts):
        texts = [f"{edge:.17g}" for edge in edges]
    for low, high, low_text, high_text in zip(edges[:-1], edges[1:], texts[:-1], texts[1:], strict=True):
        name = f"{low_text} and more" if np.isinf(high) else f"{low_text} to {high_text}"
        rows[name] = (values >= low) & ((values < high) | ((values == high) & (high == edges[-1])))
    return rows


def by_span(
    table: ArrayLike,
    values: ArrayLike,
    edges: ArrayLike,
    average: str = "person",
    *,
    rng: np.random.Generator | None = None,
    clusters: ArrayLike | None = None,
) -> dict[str, Slice]:
    """The mean of a table (n, J) or (n,) for each span of a value: distance, points, occlusion.

    Args:
        values: (n,) one per person.
        edges: (k,) increasing; see `span_rows`. People in no span, or whose value is NaN, come last as "elsewhere".
        rng: if given, each span gets an interval.
        clusters: (n,), see `interval`.
    """
    table = as_table(table)
    values, edges = as_numbers("values of slices", values), as_numbers("edges of slices", edges)
    if values.shape != (len(table),):
        raise InputError(f"values of slices must be ({len(table)},), one per person, got {values.shape}")
    if edges.ndim != 1 or len(edges) < 2 or not (np.diff(edges) > 0).all():
        raise InputError(f"edges of slices must be two or more increasing numbers, got {edges.tolist()}")
    labels = _cluster_labels(clusters, len(table))
    spans = span_rows(values, edges)
    is_elsewhere = ~np.any(list(spans.values()), axis=0)
    if is_elsewhere.any():
        spans["elsewhere"] = is_elsewhere
    slices = {}
    for name, rows in spans.items():
        row_clusters = None if labels is None else labels[rows]
        row_interval = None if rng is None else interval(table[rows], rng, average, clusters=row_clusters)
        slices[name] = Slice(score=mean(table[rows], average), interval=row_interval)
    return slices


# ---- calibration of confidence, and how well it ranks hits before misses


def calibration_error(confidence: ArrayLike, hit: ArrayLike, *, bins: int = 10) -> float:
    """Expected calibration error, 0 to 1: weighted mean gap between confidence (n,) and share of hits (n,) over bins of
    equal width; NaN for empty arrays.

    Args:
        confidence: (n,) 0 to 1.
        hit: (n,) bool or 0/1.
        bins: number of bins.

    Raises:
        InputError: for NaN and other values: leave out what is not known.
    """
    bins = check_int("bins", bins, least=1)
    confidence = _without_nan("confidence", confidence)
    if not ((confidence >= 0) & (confidence <= 1)).all():
        raise InputError(f"confidence must be within 0 and 1, got {confidence.min():g} to {confidence.max():g}")
    hit = as_flags("hit", hit, confidence.shape, of="confidence")
    if not len(confidence):
        return float("nan")
    index = np.minimum((confidence * bins).astype(int), bins - 1)
    confidence_sums, hit_counts = np.bincount(index, confidence, bins), np.bincount(index, hit, bins)
    return float(np.abs(confidence_sums - hit_counts).sum() / len(confidence))


def auroc(score: ArrayLike, hit: ArrayLike) -> float:
    """Area under the ROC curve, 0 to 1, of scores (n,) for hits (n,): how well the score ranks hits before misses.

    Args:
        score: (n,) any numbers, higher is more confident.
        hit: (n,) bool or 0/1.

    Raises:
        InputError: for NaN, which has no rank, and if hits or misses are missing.
    """
    score = _without_nan("score", score)
    hit = as_flags("hit", hit, score.shape, of="score")
    positives, negatives = int(hit.sum()), int((~hit).sum())
    if not positives or not negatives:
        raise InputError(f"AUROC needs hits and misses, got {positives} hits and {negatives} misses")
    _, inverse, counts = np.unique(score, return_inverse=True, return_counts=True)
    # ties get the mean of their ranks
    rank = (np.cumsum(counts) - (counts - 1) / 2)[inverse]
    return float((rank[hit].sum() - positives * (positives + 1) / 2) / (positives * negatives))


def _without_nan(name: str, values: ArrayLike) -> np.ndarray:
    values = as_numbers(name, values)
    if values.ndim != 1:
        raise InputError(f"{name} must be (n,), got {values.shape}: pass values.ravel()")
    if num_nan := int(np.isnan(values).sum()):
        raise InputError(
            f"{name} must hold numbers, got NaN in {num_nan} of {len(values)}: leave these and their hits out"
        )
    return values
