"""From errors of joints to one score. Tables are plain arrays.

A table is (n, J), a row a person and a column a joint, in millimeters or percent, or (n,) for a value of the whole
person. NaN stands where there is nothing to score: a joint without a label.
"""

import numpy as np
from numpy.typing import ArrayLike

from lidarpose.errors import InputError, check_name

# how people and joints are averaged: over people the mean of each one's joints, or over all joints alike
AVERAGES = ("person", "joint")


class Score(float):
    """A score in millimeters or percent with the number of people and joints behind it.

    people: how many it is a mean of; joints: how many labeled joints of theirs; skipped: people without anything to
    score, who are not part of it. A score of nobody is NaN.
    """

    people: int
    joints: int
    skipped: int

    def __new__(cls, value: float, *, people: int = 0, joints: int = 0, skipped: int = 0):
        score = super().__new__(cls, value)
        score.people, score.joints, score.skipped = people, joints, skipped
        return score


def as_table(table: ArrayLike) -> np.ndarray:
    """A table as (n, J) float; raises InputError for another shape or for infinite entries."""
    try:
        table = np.asarray(table, float)
    except (TypeError, ValueError):
        raise InputError("a table of scores must hold numbers, rows of equal length") from None
    if table.ndim not in (1, 2):
        raise InputError(f"a table of scores must be (people, joints) or (people,), got {table.shape}")
    if np.isinf(table).any():
        raise InputError("a table of scores must be finite, or NaN where a joint has no label; got infinity")
    return table[:, None] if table.ndim == 1 else table


def person_sums(table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Table (n, J) -> (n,) sum over each person's labeled joints, (n,) their number."""
    labeled = ~np.isnan(table)
    return np.where(labeled, table, 0.0).sum(1), labeled.sum(1)


def mean(table: ArrayLike, average: str = "person", *, empty: float | None = None) -> Score:
    """The mean of a table (n, J) or (n,).

    Args:
        average: "person", the mean over people of the mean over each one's labeled joints; "joint", the mean over all
            labeled joints of everybody, so that who has more of them weighs more.
        empty: what a person without labeled joints counts as in the mean over people; None leaves these people out
            and counts them as skipped.
    """
    check_name("average", average, AVERAGES)
    total, count = person_sums(as_table(table))
    seen = count > 0
    if average == "joint":
        if empty is not None:
            raise InputError('empty is for average="person": people without labeled joints add none to the other')
        value = total.sum() / count.sum() if seen.any() else np.nan
    else:
        each = np.where(seen, total / np.maximum(count, 1), np.nan if empty is None else empty)
        each = each if empty is not None else each[seen]
        value = each.mean() if len(each) else np.nan
    people = len(seen) if empty is not None else int(seen.sum())
    return Score(value, people=people, joints=int(count.sum()), skipped=len(seen) - people)
