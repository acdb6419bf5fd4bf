"""Final mean, backward and forward transfer of a learner of a sequence of tasks.

`scores` (T + 1, T) has the score on each of T tasks, in the order of learning: row 0 before the first of them, row i
after task i. Source: Lopez-Paz and Ranzato, "Gradient Episodic Memory for Continual Learning", NeurIPS 2017, equations
2 to 4. There the first row is of random weights; here it is of the network that learning starts with.
"""

import numpy as np
from numpy.typing import ArrayLike

from flcav.arrays import Array


def compute_final_mean(scores: ArrayLike) -> float:
    """Return the mean score over all tasks after the last; raises ValueError for scores of a wrong shape."""
    return float(_check(scores)[-1].mean())


def compute_backward_transfer(scores: ArrayLike) -> float:
    """Return the mean change of the score on a task by all later ones, negative for forgetting; raises ValueError."""
    table = _check(scores)
    learned = np.diagonal(table[1:])
    return float((table[-1] - learned)[:-1].mean())


def compute_forward_transfer(scores: ArrayLike) -> float:
    """Return the mean change of the score on a task by all earlier ones, before it is learned; raises ValueError."""
    table = _check(scores)
    before = np.diagonal(table[:-1])
    return float((before - table[0])[1:].mean())


def _check(scores: ArrayLike) -> Array:
    """Return the table; raises ValueError where it is not (T + 1, T) of two tasks or more."""
    table = np.asarray(scores, np.float64)
    if table.ndim != 2 or table.shape[1] < 2 or table.shape[0] != table.shape[1] + 1:
        raise ValueError(f"scores of shape {table.shape}, expected (T + 1, T) of T >= 2 tasks")
    return table
