"""Bootstrap intervals of mean scores, over people or over whole sequences.

Percentile bootstrap (Efron & Tibshirani 1993, chapter 13). With clusters, whole clusters are drawn instead of people:
frames of one sequence show the same person in nearly the same pose, and drawing them one by one gives far too narrow
intervals. Intervals of few units are too narrow as well: of normal ones, 95 % intervals held the truth in 93 % of
trials with 20 units, in 90 % with 10, in 49 % with two.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lidarpose.errors import InputError, check_name
from lidarpose.eval.metrics.aggregate import AVERAGES, as_table, person_sums

# an evaluation states no interval of fewer people or clusters
LEAST_UNITS = 10
# random indices held in memory at once
_BLOCK = 1 << 21


@dataclass(frozen=True, kw_only=True)
class Interval:
    """low, high: ends, in the table's unit, NaN where nothing was drawn; level: share of draws between them; units: how
    many people or clusters were drawn from; repeats: how often."""

    low: float
    high: float
    level: float
    units: int
    repeats: int

    @property
    def stated(self) -> tuple[float, float] | tuple[None, None]:
        """low and high as an evaluation states them: None of fewer than `LEAST_UNITS`."""
        return (self.low, self.high) if self.units >= LEAST_UNITS else (None, None)


def interval(
    table: ArrayLike,
    rng: np.random.Generator,
    average: str = "person",
    *,
    clusters: ArrayLike | None = None,
    level: float = 0.95,
    repeats: int = 2000,
) -> Interval:
    """The interval of `mean` of a table (n, J) or (n,), by drawing people with replacement.

    Args:
        clusters: (n,) a label a person, sequence or subject, which are drawn whole. People without labeled joints are
            left out, as in the mean.
    """
    if not isinstance(rng, np.random.Generator):
        raise InputError(f"rng must be a numpy.random.Generator, such as default_rng(0), got {type(rng).__name__}")
    if not 0 < level < 1:
        raise InputError(f"level must lie between 0 and 1, got {level}")
    if repeats < 1:
        raise InputError(f"repeats must be 1 or more, got {repeats}")
    check_name("average", average, AVERAGES)
    table = as_table(table)
    if clusters is not None and np.shape(clusters) != (len(table),):
        raise InputError(f"clusters must be ({len(table)},), one label a person, got {np.shape(clusters)}")
    draws, units = bootstrap_means(table, rng, average, clusters=clusters, repeats=repeats)
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

    Both are drawn with the same people, so what is hard for both does not widen it.
    """
    first, second = as_table(first), as_table(second)
    if first.shape != second.shape or (np.isnan(first) != np.isnan(second)).any():
        raise InputError("tables to compare must be of the same people, with the same joints labeled")
    return interval(first - second, rng, average, clusters=clusters, level=level, repeats=repeats)


def bootstrap_means(
    table: np.ndarray, rng: np.random.Generator, average: str, *, clusters: ArrayLike | None, repeats: int
) -> tuple[np.ndarray, int]:
    """The means of `repeats` draws (repeats,), and how many units were drawn from; of nobody NaN and 0."""
    total, count = person_sums(table)
    seen = count > 0
    total, count = total[seen], count[seen]
    if average == "person":
        total, count = total / count, np.ones(len(count))
    if clusters is not None:
        labels, cluster = np.unique(np.asarray(clusters)[seen], return_inverse=True)
        total, count = (np.bincount(cluster, values, minlength=len(labels)) for values in (total, count))
    units = len(total)
    means = np.full(repeats, np.nan)
    at_once = max(1, _BLOCK // max(units, 1))
    for start in range(0, repeats if units else 0, at_once):
        drawn = rng.integers(units, size=(min(at_once, repeats - start), units))
        means[start : start + len(drawn)] = total[drawn].sum(1) / count[drawn].sum(1)
    return means, units
