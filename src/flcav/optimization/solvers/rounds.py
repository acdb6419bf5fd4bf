"""The choices of edge and cloud rounds of a task, for solvers that enumerate them."""

import numpy as np

from flcav.config import InputError
from flcav.geometry.arrays import Array

MOST_CHOICES = 1_000_000  # pairs of rounds of one task


def pair_rounds(low: Array, high: Array, reason: str, task: str) -> Array:
    """Return all pairs of edge and cloud rounds (C, 2) of `task` with quantities from `low` (3,) to `high` (3,).

    Raises `InputError`, with the `reason` for enumerating them, where there are more than `MOST_CHOICES`.
    """
    pairs = int(np.prod(high[1:] - low[1:] + 1))
    if pairs > MOST_CHOICES:
        raise InputError(
            f"{reason} tries every pair of edge and cloud rounds, and task {task!r} has {pairs}: "
            f"set limits that leave at most {MOST_CHOICES}"
        )
    edge, cloud = (np.arange(low[stage], high[stage] + 1) for stage in (1, 2))
    return np.stack(np.meshgrid(edge, cloud, indexing="ij"), axis=-1).reshape(-1, 2)


def fewest_cloud_rounds(low: Array, high: Array, k: int) -> Array:
    """Return the choices of edge and cloud rounds (T, 2) that have the fewest cloud rounds for each t = y + k z.

    For a curve that depends on t alone no other choice is better, as long as a cloud round costs no less than k edge
    rounds under any budget. `low` and `high` (3,) are the least and most of the quantities.
    """
    if k == 0:
        edge = np.arange(low[1], high[1] + 1)
        return np.column_stack((edge, np.full(len(edge), low[2])))
    t = np.arange(low[1] + k * low[2], high[1] + k * high[2] + 1)
    cloud = np.maximum(np.ceil((t - high[1]) / k), low[2])
    edge = t - k * cloud
    return np.column_stack((edge, cloud))[edge >= low[1]]
