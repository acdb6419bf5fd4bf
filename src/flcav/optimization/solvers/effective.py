"""Least Lagrangian of effective-samples curves over whole samples and rounds, vectorised over tasks.

A task's error above its floor is

    weight a n^(-b),   n = `effective_samples` of x samples and t = y + k z rounds.

A cloud round costs as much as k edge rounds on the wireless link, and more on the wireline one. So among all (y, z)
with the same t the one with the fewest cloud rounds is optimal, and only the values of t are enumerated. For each of
them the best x has a closed form.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flcav.optimization.curves.curves import Effective, effective_samples
from flcav.optimization.solvers.rounding import outermost

Array = NDArray[np.float64]


@dataclass(frozen=True)
class EffectiveTasks:
    """The E tasks with effective-samples curves, and T choices of rounds each; a missing choice has infinite cost."""

    quantity: NDArray[np.intp]  # (E, 3) indices of samples, edge rounds, cloud rounds in the whole problem
    gain: Array  # (E, 1) weight * a
    b: Array  # (E, 1)
    alpha: Array  # (E, 1)
    group: Array  # (E, 1) beta * G
    k: int  # edge rounds per cloud round
    least: Array  # (E, 1) samples
    most: Array  # (E, 1) samples
    sample_cost: Array  # (E, 2) per link
    rounds: Array  # (E, T, 2) edge rounds, cloud rounds
    rounds_cost: Array  # (E, T, 2) per link

    def error(self, x: Array) -> Array:
        """Return the weighted errors (E,) above their floors at x (n,) of the whole problem."""
        own = x[self.quantity]
        t = own[:, 1] + self.k * own[:, 2]
        effective = effective_samples(own[:, 0], t, self.alpha[:, 0], self.group[:, 0])
        return self.gain[:, 0] * effective ** -self.b[:, 0]

    def minimise_lagrangian(self, multipliers: Array) -> tuple[Array, Array]:
        """Return the whole quantities (E, 3) of least error plus price at `multipliers` (2,), and the minima (E,)."""
        samples, value = self._best_samples(multipliers)
        best = np.argmin(value, axis=1)
        task = np.arange(len(best))
        chosen = np.concatenate((samples[task, best][:, None], self.rounds[task, best]), axis=1)
        return chosen, value[task, best]

    def tighten_bounds(self, multipliers: Array, slack: float) -> tuple[Array, Array]:
        """Return least and most quantities, (E, 3) each, of the choices within `slack` of a task's least Lagrangian.

        The Lagrangian is error plus price at `multipliers` (2,).
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
        """Return the best whole number of samples for each choice of rounds (E, T), and error plus price (E, T)."""
        price = (self.sample_cost @ multipliers)[:, None]
        with np.errstate(divide="ignore"):
            level = (self.gain * self.b * self.alpha / price) ** (1 / (self.b + 1))
        ideal = (level - self._effective(0.0)) / self.alpha
        below = np.clip(np.floor(np.minimum(ideal, self.most)), self.least, self.most)
        above = np.minimum(below + 1, self.most)
        values = self._value(below, multipliers), self._value(above, multipliers)
        return np.where(values[0] <= values[1], below, above), np.minimum(*values)

    def _value(self, samples: Array, multipliers: Array) -> Array:
        price = (self.sample_cost @ multipliers)[:, None]
        error = self.gain * self._effective(samples) ** -self.b
        with np.errstate(invalid="ignore"):
            rounds = self.rounds_cost @ multipliers
        return error + price * samples + np.where(np.isinf(self.rounds_cost[:, :, 0]), np.inf, rounds)

    def _effective(self, samples: Array | float) -> Array:
        """Return the effective samples (E, T) of each choice of rounds with `samples` (E, T)."""
        return effective_samples(samples, self.rounds[:, :, 0] + self.k * self.rounds[:, :, 1], self.alpha, self.group)


def build_effective_tasks(
    numbers: Sequence[int], weights: Sequence[float], curves: Sequence[Effective], k: int, low: Array, high: Array,
    cost: Array,
) -> EffectiveTasks:  # fmt: skip
    """Return the tasks with effective-samples `curves` and `weights`, and their choices of rounds.

    `numbers` are the tasks' indices in a problem of N tasks with bounds `low` and `high` (3N,) and `cost` (3N, 2); `k`
    is the number of edge rounds per cloud round.
    """
    quantity = 3 * np.array(numbers)[:, None] + np.arange(3)
    choices = [_rounds(low[q], high[q], k) for q in quantity]
    rounds = np.zeros((len(numbers), max(map(len, choices)), 2))
    rounds_cost = np.full(rounds.shape, np.inf)
    for row, (own, q) in enumerate(zip(choices, quantity)):
        rounds[row, : len(own)] = own
        rounds_cost[row, : len(own)] = own @ cost[q[1:]]
    numbers_of = [(w * c.a, c.b, c.alpha, c.beta * c.group_samples) for w, c in zip(weights, curves)]
    gain, b, alpha, group = np.array(numbers_of).T[:, :, None]
    least, most = low[quantity[:, :1]], high[quantity[:, :1]]
    sample_cost = cost[quantity[:, 0]]
    return EffectiveTasks(quantity, gain, b, alpha, group, k, least, most, sample_cost, rounds, rounds_cost)


def _rounds(low: Array, high: Array, k: int) -> Array:
    """Return the choices of edge and cloud rounds (T, 2): for each t = y + k z the one with the fewest cloud rounds."""
    if k == 0:
        edge = np.arange(low[1], high[1] + 1)
        return np.column_stack((edge, np.full(len(edge), low[2])))
    t = np.arange(low[1] + k * low[2], high[1] + k * high[2] + 1)
    cloud = np.maximum(np.ceil((t - high[1]) / k), low[2])
    edge = t - k * cloud
    return np.column_stack((edge, cloud))[edge >= low[1]]
