"""Assignment of rows to columns with the least total cost."""

from collections.abc import Callable
from functools import cache

import numpy as np


def assign(costs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The pairs with the least total cost, where a row or column without a pair costs 0: only negative costs pair.

    costs (N, B): inf for pairs that are not allowed. Returns rows (k,) ascending and their columns (k,).
    """
    clipped_costs = np.minimum(np.asarray(costs, float), 0.0)
    rows, columns = _solver()(clipped_costs)
    is_pair = clipped_costs[rows, columns] < 0
    return rows[is_pair], columns[is_pair]


@cache
def _solver() -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    try:
        from scipy.optimize import linear_sum_assignment
    except ImportError:
        return assign_plain
    return linear_sum_assignment


def assign_plain(costs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """As scipy's `linear_sum_assignment`, for finite costs (N, B): min(N, B) pairs, rows ascending.

    Source: Jonker and Volgenant 1987: each row in turn is assigned along the shortest augmenting path.
    """
    costs = np.asarray(costs, float)
    if costs.shape[0] > costs.shape[1]:
        columns, rows = assign_plain(costs.T)
        order = np.argsort(rows)
        return rows[order], columns[order]
    count, width = costs.shape
    row_price, column_price = np.zeros(count), np.zeros(width)
    row_of = np.full(width, -1)
    for start in range(count):
        # Dijkstra over columns: distance so far, the previous column, and whether it is settled
        distance, predecessor, is_settled = np.full(width, np.inf), np.full(width, -1), np.zeros(width, bool)
        row, column, min_distance = start, -1, 0.0
        while row >= 0:
            path_cost = min_distance + costs[row] - row_price[row] - column_price
            is_shorter = ~is_settled & (path_cost < distance)
            distance[is_shorter], predecessor[is_shorter] = path_cost[is_shorter], column
            column = int(np.where(is_settled, np.inf, distance).argmin())
            min_distance = distance[column]
            is_settled[column] = True
            row = int(row_of[column])
        assigned_columns = np.flatnonzero(is_settled & (row_of >= 0))
        row_price[start] += min_distance
        row_price[row_of[assigned_columns]] += min_distance - distance[assigned_columns]
        column_price[is_settled] -= min_distance - distance[is_settled]
        while column >= 0:
            previous = predecessor[column]
            row_of[column] = start if previous < 0 else row_of[previous]
            column = int(previous)
    columns = np.flatnonzero(row_of >= 0)
    order = np.argsort(row_of[columns])
    return row_of[columns][order], columns[order]
