"""Scores by joint group, and by distance, number of points, occlusion or any other number that each person has."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lidarpose.errors import InputError
from lidarpose.eval.metrics.aggregate import Score, as_table, mean
from lidarpose.eval.metrics.bootstrap import Interval, interval
from lidarpose.skeleton import Skeleton, skeleton

# the groups that the paper and Waymo report (head to ankles), and groups for the joints that only SMPL has
GROUPS = {
    "head": ("head", "nose", "head_center"),
    "shoulders": ("left_shoulder", "right_shoulder"),
    "elbows": ("left_elbow", "right_elbow"),
    "wrists": ("left_wrist", "right_wrist"),
    "hips": ("left_hip", "right_hip"),
    "knees": ("left_knee", "right_knee"),
    "ankles": ("left_ankle", "right_ankle"),
    "trunk": ("pelvis", "spine1", "spine2", "spine3", "neck", "left_collar", "right_collar"),
    "hands": ("left_hand", "right_hand"),
    "feet": ("left_foot", "right_foot"),
}
# edges of this project's own reports: meters, points a person, share of the body that is hidden
DISTANCE_EDGES = (0.0, 10.0, 20.0, 30.0, np.inf)
POINT_EDGES = (0, 50, 100, 200, 400, np.inf)
OCCLUSION_EDGES = (0.0, 0.1, 0.3, 0.5, 1.0)


@dataclass(frozen=True, kw_only=True)
class Slice:
    """People of one span of distance, points or occlusion: their score and, where asked for, its interval."""

    score: Score
    interval: Interval | None = None


def joint_groups(of: Skeleton | str, groups: Mapping[str, Sequence[str]] = GROUPS) -> dict[str, np.ndarray]:
    """Group -> indices of its joints in the skeleton, by name; groups without a joint there are left out, "all" is
    last. of: a skeleton or its name."""
    of = skeleton(of) if isinstance(of, str) else of
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
    """`mean` of a table (n, J) for each joint group of the skeleton. A group that nobody has a label in is NaN."""
    table = as_table(table)
    of = skeleton(of) if isinstance(of, str) else of
    if table.shape[1] != len(of):
        raise InputError(f"a table of {of.name} has {len(of)} columns, one a joint, got {table.shape[1]}")
    return {name: mean(table[:, index], average, empty=empty) for name, index in joint_groups(of, groups).items()}


def span_rows(values: np.ndarray, edges: Sequence[float] | np.ndarray) -> dict[str, np.ndarray]:
    """Span -> (n,) bool: whose value (n,) lies in it. A span holds its lower edge, the last one its upper edge too."""
    rows = {}
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        name = f"{low:g} and more" if np.isinf(high) else f"{low:g} to {high:g}"
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
    """The mean of a table (n, J) or (n,) for people whose value lies between two edges: distance, points, occlusion.

    Args:
        values: (n,) one a person.
        edges: (k,) rising; see `span_rows`. People in no span, or whose value is NaN, come last as "elsewhere".
        rng: adds an interval to each span.
        clusters: (n,), see `interval`.
    """
    table = as_table(table)
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
    spans = span_rows(values, edges)
    elsewhere = ~np.any(list(spans.values()), axis=0)
    slices = {}
    for name, rows in spans.items() if not elsewhere.any() else (spans | {"elsewhere": elsewhere}).items():
        labels = None if clusters is None else np.asarray(clusters)[rows]
        drawn = None if rng is None else interval(table[rows], rng, average, clusters=labels)
        slices[name] = Slice(score=mean(table[rows], average), interval=drawn)
    return slices
