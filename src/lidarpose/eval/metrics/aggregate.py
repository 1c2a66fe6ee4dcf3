"""From figures of joints to one figure. Tables are plain arrays.

A table is (n, J), one row a person, one column a joint, in millimetres or percent, or (n,) for a figure of the whole
person. NaN stands where there is nothing to judge: a joint without a label.
"""

import numpy as np

from lidarpose.errors import InputError, check_name

# how people and joints are averaged: over people the mean of each one's joints, or over all joints alike
AVERAGES = ("person", "joint")


class Score(float):
    """A figure in millimetres or percent that knows what it is a mean of.

    people: how many it was taken over; joints: how many labelled joints of theirs; skipped: people without anything to
    judge, who are not part of it. A score of nobody is NaN.
    """

    people: int
    joints: int
    skipped: int

    def __new__(cls, value: float, *, people: int = 0, joints: int = 0, skipped: int = 0):
        score = super().__new__(cls, value)
        score.people, score.joints, score.skipped = people, joints, skipped
        return score


def table_of(table: np.ndarray) -> np.ndarray:
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
    """Table (n, J) -> (n,) sum over each person's labelled joints, (n,) their number."""
    known = ~np.isnan(table)
    return np.where(known, table, 0.0).sum(1), known.sum(1)


def checked_average(average: str) -> str:
    """The name of an average; raises InputError for an unknown one."""
    check_name("average", average, AVERAGES)
    return average


def mean(table: np.ndarray, average: str = "person", *, empty: float | None = None) -> Score:
    """The mean of a table (n, J) or (n,).

    average: "person", the mean over people of the mean over each one's labelled joints; "joint", the mean over all
    labelled joints of everybody, so that who has more of them weighs more. empty: what a person without labelled
    joints counts as in the mean over people; None leaves these people out and counts them.
    """
    total, count = person_sums(table_of(table))
    seen = count > 0
    if checked_average(average) == "joint":
        if empty is not None:
            raise InputError('empty is for average="person": people without labelled joints add none to the other')
        value = total.sum() / count.sum() if seen.any() else np.nan
    else:
        each = np.where(seen, total / np.maximum(count, 1), np.nan if empty is None else empty)
        each = each if empty is not None else each[seen]
        value = each.mean() if len(each) else np.nan
    people = len(seen) if empty is not None else int(seen.sum())
    return Score(value, people=people, joints=int(count.sum()), skipped=len(seen) - people)
