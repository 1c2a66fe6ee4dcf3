"""Bootstrap intervals of mean figures, over people or over whole sequences.

Percentile bootstrap (Efron & Tibshirani 1993, chapter 13). With labels the clusters are drawn, not the people: frames
of one sequence show the same person in nearly the same pose: drawing them one by one gives far too narrow intervals.
Intervals of few units are too narrow as well: of normal ones, 95 % intervals held the truth in 93 % of trials with 20
units, in 90 % with 10, in 49 % with two.
"""

from dataclasses import dataclass

import numpy as np

from lidarpose.errors import InputError
from lidarpose.eval.metrics.aggregate import checked_average, person_sums, table_of

# an evaluation states no interval of fewer people or clusters
LEAST_UNITS = 10
# draws held in memory at once
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
    table: np.ndarray,
    rng: np.random.Generator,
    average: str = "person",
    *,
    clusters: np.ndarray | None = None,
    level: float = 0.95,
    repeats: int = 2000,
) -> Interval:
    """The interval of `scores.mean` of a table (n, J) or (n,), by drawing people with replacement.

    rng: seeds it; clusters (n,): a label a person, sequence or subject: these are drawn whole; people without labelled
    joints are left out, as in the mean.
    """
    low, high = _checked(level, repeats)
    draws, units = draw_means(table, rng, average, clusters=clusters, repeats=repeats)
    ends = np.quantile(draws, [low, high]) if len(draws) else (np.nan, np.nan)
    return Interval(low=float(ends[0]), high=float(ends[1]), level=level, units=units, repeats=repeats)


def paired_interval(
    first: np.ndarray,
    second: np.ndarray,
    rng: np.random.Generator,
    average: str = "person",
    *,
    clusters: np.ndarray | None = None,
    level: float = 0.95,
    repeats: int = 2000,
) -> Interval:
    """The interval of mean(first) - mean(second): two models' tables of the same people with the same labels.

    Both are drawn with the same people, so what is hard for both does not widen it.
    """
    first, second = table_of(first), table_of(second)
    if first.shape != second.shape or (np.isnan(first) != np.isnan(second)).any():
        raise InputError("tables to compare must be of the same people, with the same joints labelled")
    return interval(first - second, rng, average, clusters=clusters, level=level, repeats=repeats)


def draw_means(
    table: np.ndarray, rng: np.random.Generator, average: str, *, clusters: np.ndarray | None = None, repeats: int
) -> tuple[np.ndarray, int]:
    """The means of `repeats` draws (repeats,), none where nobody has a label, and how many units were drawn from."""
    if not isinstance(rng, np.random.Generator):
        raise InputError(f"rng must be a numpy.random.Generator, such as default_rng(0), got {type(rng).__name__}")
    total, count = person_sums(table_of(table))
    seen = count > 0
    if checked_average(average) == "person":
        total, count = total / np.maximum(count, 1), seen.astype(float)
    if clusters is not None:
        labels = np.asarray(clusters)
        if labels.shape != seen.shape:
            raise InputError(f"clusters must be ({len(seen)},), one label a person, got {labels.shape}")
        names, of = np.unique(labels[seen], return_inverse=True)
        total, count = (np.bincount(of, v[seen], minlength=len(names)) for v in (total, count))
    else:
        total, count = total[seen], count[seen]
    units = len(total)
    if not units:
        return np.empty(0), 0
    means = np.empty(repeats)
    at_once = max(1, _BLOCK // units)
    for start in range(0, repeats, at_once):
        drawn = rng.integers(units, size=(min(at_once, repeats - start), units))
        means[start : start + len(drawn)] = total[drawn].sum(1) / count[drawn].sum(1)
    return means, units


def _checked(level: float, repeats: int) -> tuple[float, float]:
    if not 0 < level < 1:
        raise InputError(f"level must lie between 0 and 1, got {level}")
    if repeats < 1:
        raise InputError(f"repeats must be 1 or more, got {repeats}")
    return (1 - level) / 2, (1 + level) / 2
