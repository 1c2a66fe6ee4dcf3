"""Assignment of rows to columns with the least total cost."""

import numpy as np


def assign(costs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The pairs with the least total cost, where a row or column without a pair costs 0: only negative costs pair.

    costs (N, B): inf for pairs that are not allowed. Returns rows (k,) ascending and their columns (k,).
    """
    from scipy.optimize import linear_sum_assignment

    clipped_costs = np.minimum(np.asarray(costs, float), 0.0)
    rows, columns = linear_sum_assignment(clipped_costs)
    is_pair = clipped_costs[rows, columns] < 0
    return rows[is_pair], columns[is_pair]
