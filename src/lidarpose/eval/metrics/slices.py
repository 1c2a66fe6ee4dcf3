"""Scores by distance, by number of points, by occlusion, or by any other number that each person has."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidarpose.errors import InputError
from lidarpose.eval.metrics.aggregate import Score, mean, table_of
from lidarpose.eval.metrics.bootstrap import Interval, interval

# edges of this project's own reports: metres, points a person, share of the body that is hidden
DISTANCE_EDGES = (0.0, 10.0, 20.0, 30.0, np.inf)
POINT_EDGES = (0, 50, 100, 200, 400, np.inf)
OCCLUSION_EDGES = (0.0, 0.1, 0.3, 0.5, 1.0)


@dataclass(frozen=True, kw_only=True)
class Slice:
    """People of one span of distance, points or occlusion: their score and, where asked for, its interval."""

    score: Score
    interval: Interval | None = None


def by_span(
    table: np.ndarray,
    values: np.ndarray,
    edges: Sequence[float],
    average: str = "person",
    *,
    rng: np.random.Generator | None = None,
    clusters: np.ndarray | None = None,
) -> dict[str, Slice]:
    """The mean of a table (n, J) or (n,) for people whose value lies between two edges: distance, points, occlusion.

    values (n,), one a person; edges (k,), rising: a span holds its lower edge, the last one its upper edge too. People
    who lie in no span, or whose value is NaN, come last as "elsewhere". rng: adds an interval to each; clusters (n,):
    see `interval`.
    """
    table = table_of(table)
    try:
        values, edges = np.asarray(values, float), np.asarray(edges, float)
    except (TypeError, ValueError):
        raise InputError("values and edges of slices must be numbers") from None
    if values.shape != (len(table),):
        raise InputError(f"values of slices must be ({len(table)},), one a person, got {values.shape}")
    if edges.ndim != 1 or len(edges) < 2 or not (np.diff(edges) > 0).all():
        raise InputError(f"edges of slices must be two or more rising numbers, got {edges.tolist()}")
    if clusters is not None and np.shape(clusters) != (len(table),):
        raise InputError(f"clusters must be ({len(table)},), one label a person, got {np.shape(clusters)}")
    which = np.searchsorted(edges, values, side="right") - 1
    which[values == edges[-1]] = len(edges) - 2
    out = {}
    for k, (low, high) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
        name = f"{low:g} and more" if np.isinf(high) else f"{low:g} to {high:g}"
        out[name] = which == k
    elsewhere = (which < 0) | (which > len(edges) - 2)
    if elsewhere.any():
        out["elsewhere"] = elsewhere

    def judged(rows):
        near = None
        if rng is not None:
            labels = None if clusters is None else np.asarray(clusters)[rows]
            near = interval(table[rows], rng, average, clusters=labels)
        return Slice(score=mean(table[rows], average), interval=near)

    return {name: judged(rows) for name, rows in out.items()}
