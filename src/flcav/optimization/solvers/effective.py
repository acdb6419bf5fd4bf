"""Minimisation of the Lagrangian of curves over effective samples, in integers, vectorised over tasks.

A task's error above its floor is

    weight (a n^(-b) + drift part of z),   n = alpha x + own (1 - 1 / (p t + 1)) + others (1 - 1 / (p z + 1)),

with x samples, t = y + k z rounds, z cloud rounds and the curve's pace p. Where cloud rounds bring more than edge
rounds, or cost less (labels are sent before each edge round), every pair (y, z) is tried; for other `Effective` curves,
and for `Federated` ones whose cloud rounds bring nothing, only the pair with the fewest cloud rounds for each t. For a
given pair the best x has a closed form. No step needs the error to be convex in the rounds, or to decrease with them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flcav.geometry.arrays import Array
from flcav.optimization.curves.curves import Effective, Federated, drift_part, effective_samples
from flcav.optimization.solvers.rounding import outermost
from flcav.optimization.solvers.rounds import fewest_cloud_rounds, pair_rounds
from flcav.optimization.solvers.separable import BUDGET_SLACK


@dataclass(frozen=True)
class EffectiveTasks:
    """E tasks with curves over effective samples, and T choices of rounds for each; a missing choice costs infinity."""

    quantity: NDArray[np.intp]  # (E, 3) indices of samples, edge rounds, cloud rounds in the whole problem
    gain: Array  # (E, 1) weight * a
    b: Array  # (E, 1)
    alpha: Array  # (E, 1)
    own: Array  # (E, 1) worth of the samples held in a task's region
    others: Array  # (E, 1) worth of the samples held in the other regions
    drift: Array  # (E, 1) weight * drift
    pace: Array  # (E, 1) rounds of the history that one is worth
    k: int  # edge rounds per cloud round
    least: Array  # (E, 1) samples
    most: Array  # (E, 1) samples
    sample_cost: Array  # (E, L) under each budget
    rounds: Array  # (E, T, 2) edge rounds, cloud rounds
    rounds_cost: Array  # (E, T, L) under each budget

    def error(self, x: Array) -> Array:
        """Return the weighted errors (E,) above their floors at x (n,) of the whole problem."""
        counts = x[self.quantity][:, None]
        return self._error(counts[..., 0], counts[..., 1:])[:, 0]

    def minimise_lagrangian(self, multipliers: Array) -> tuple[Array, Array]:
        """Return the integers (E, 3) of least error plus price at `multipliers` (L,), and the minima (E,)."""
        samples, value = self._best_samples(multipliers)
        best = np.argmin(value, axis=1)
        task = np.arange(len(best))
        chosen = np.concatenate((samples[task, best][:, None], self.rounds[task, best]), axis=1)
        return chosen, value[task, best]

    def tighten_bounds(self, multipliers: Array, slack: float) -> tuple[Array, Array]:
        """Return least and most quantities, (E, 3) each, of the choices within `slack` of a task's least Lagrangian.

        The Lagrangian is error plus price at `multipliers` (L,).
        """
        samples, value = self._best_samples(multipliers)
        limit = value.min(axis=1, keepdims=True) + slack
        kept = value <= limit

        def good(count: Array) -> NDArray[np.bool_]:
            return self._value(count, multipliers) <= limit

        outer = [outermost(good, samples, np.broadcast_to(edge, samples.shape)) for edge in (self.least, self.most)]
        low = np.where(kept, outer[0], np.inf).min(axis=1)
        high = np.where(kept, outer[1], -np.inf).max(axis=1)
        least = np.where(kept[:, :, None], self.rounds, np.inf).min(axis=1)
        most = np.where(kept[:, :, None], self.rounds, -np.inf).max(axis=1)
        return np.column_stack((low, least)), np.column_stack((high, most))

    def _best_samples(self, multipliers: Array) -> tuple[Array, Array]:
        """Return the best integer number of samples for each choice of rounds (E, T), and error plus price (E, T)."""
        price = (self.sample_cost @ multipliers)[:, None]
        # At the stationary point the marginal gain of a sample equals its price.
        with np.errstate(divide="ignore"):
            level = (self.gain * self.b * self.alpha / price) ** (1 / (self.b + 1))
        ideal = (level - self._effective(0.0, self.rounds)) / self.alpha
        below = np.clip(np.floor(np.minimum(ideal, self.most)), self.least, self.most)
        above = np.minimum(below + 1, self.most)
        values = self._value(below, multipliers), self._value(above, multipliers)
        return np.where(values[0] <= values[1], below, above), np.minimum(*values)

    def _value(self, samples: Array, multipliers: Array) -> Array:
        price = (self.sample_cost @ multipliers)[:, None]
        with np.errstate(invalid="ignore"):
            rounds = self.rounds_cost @ multipliers
        spent = price * samples + np.where(np.isinf(self.rounds_cost[:, :, 0]), np.inf, rounds)
        return self._error(samples, self.rounds) + spent

    def _error(self, samples: Array, rounds: Array) -> Array:
        """Return the weighted errors (E, T) above the floors after `samples` (E, T) and `rounds` (E, T, 2)."""
        power = self.gain * self._effective(samples, rounds) ** -self.b
        return power + drift_part(rounds[..., 1], self.drift) if self.drift.any() else power

    def _effective(self, samples: Array | float, rounds: Array) -> Array:
        """Return the effective samples (E, T) of `samples` (E, T) and `rounds` (E, T, 2)."""
        t = self.pace * (rounds[..., 0] + self.k * rounds[..., 1])
        held = effective_samples(samples, t, self.alpha, self.own)
        return effective_samples(held, self.pace * rounds[..., 1], 1.0, self.others) if self.others.any() else held


@dataclass(frozen=True)
class EffectiveTask:
    """A task whose curve is over effective samples."""

    number: int  # index of the task in the problem
    name: str
    weight: float
    curve: Effective | Federated


def build_effective_tasks(
    tasks: Sequence[EffectiveTask], k: int, low: Array, high: Array, cost: Array
) -> EffectiveTasks:
    """Return the `tasks` in arrays, with their choices of rounds.

    The problem has N tasks with bounds `low` and `high` (3N,) and `cost` (3N, L), and `k` edge rounds per cloud round.
    Raises `InputError` where a `Federated` curve has more pairs of rounds than can be tried.
    """
    numbers = [task.number for task in tasks]
    quantity = 3 * np.array(numbers)[:, None] + np.arange(3)
    choices = [_choices(task, low[q], high[q], k, cost[q]) for task, q in zip(tasks, quantity)]
    rounds = np.zeros((len(numbers), max(map(len, choices)), 2))
    rounds_cost = np.full((*rounds.shape[:2], cost.shape[1]), np.inf)
    for row, (pairs, q) in enumerate(zip(choices, quantity)):
        rounds[row, : len(pairs)] = pairs
        rounds_cost[row, : len(pairs)] = pairs @ cost[q[1:]]
    rows = [
        (task.weight * task.curve.a, task.curve.b, task.curve.alpha, *_held(task), task.curve.pace) for task in tasks
    ]
    gain, b, alpha, own, others, drift, pace = np.array(rows).T[:, :, None]
    least, most = low[quantity[:, :1]], high[quantity[:, :1]]
    sample_cost = cost[quantity[:, 0]]
    worth = (gain, b, alpha, own, others, drift, pace)
    return EffectiveTasks(quantity, *worth, k, least, most, sample_cost, rounds, rounds_cost)


def _held(task: EffectiveTask) -> tuple[float, float, float]:
    """Return the worth of the samples held in the task's region and in the others, and the weighted drift."""
    curve = task.curve
    if isinstance(curve, Federated):
        return curve.own, curve.others, task.weight * curve.drift
    return curve.beta * curve.group_samples, 0.0, 0.0


def _choices(task: EffectiveTask, low: Array, high: Array, k: int, cost: Array) -> Array:
    if isinstance(task.curve, Federated) and (task.curve.others > 0 or task.curve.drift < 0):
        return pair_rounds(low, high, "a federated curve", task.name)
    if np.any(k * cost[1] > cost[2] * (1 + BUDGET_SLACK)):
        return pair_rounds(low, high, "an edge round that costs labels ('labels_mb')", task.name)
    return fewest_cloud_rounds(low, high, k)
