"""Lower bounds that a dual proves of a plan's objective, rounded outward.

By weak duality (Everett 1963), for any multipliers l >= 0 of the budgets B and over whole samples and rounds,

    weighted error >= sum_tasks min { error + l cost } - l B;
    largest error  >= e, if sum_tasks min { l cost : error <= e } > l B, or a task never comes down to e.

Each is true whatever floating point did: costs are exact, and powers and sums are lowered by more than they can be
wrong. Of NumPy's powers x^(-b) an error of 8 + 4 b units of 2^-50 is allowed for, that of x included.
"""

from collections.abc import Sequence
from math import floor, fsum, inf, nextafter
from typing import Any

import numpy as np

from flcav.optimization.verification.tasks import (
    STAGES,
    Array,
    Data,
    VerifiedTask,
    drift_part,
    error,
    held_samples,
    least_cost,
)

Powers = list[tuple[float, float, float, Any]]  # gain, b, alpha, shift of gain (alpha x + shift)^(-b)

SUMS = 1 - 2.0**-45  # of a sum of few terms, none negative: less than its rounding leaves of it
BELOW = 1 - 1e-9  # of a level: choices whose error just reaches it, or rounds to it, are not below this


def bound_weighted(tasks: Sequence[VerifiedTask], multipliers: Array, budgets: Array, k: int) -> float:
    """Return the least Lagrangian at the `multipliers` (L,): no plan within the `budgets` (L,) has less error."""
    least, left = [], budgets - least_cost(tasks)
    for task in tasks:
        ranges, prices = _afford(task, left), (task.unit @ multipliers).astype(float)
        merged, (weight, curve) = ranges[2][1] > 0, task.curves[0]
        paid = float(task.once @ multipliers) * merged
        paid += fsum(w * (own["floor"] + own.get("merge", 0.0) * merged) for w, own in task.curves)
        if curve["model"] == "additive":
            for stage, price, (low, high) in zip(STAGES, prices, ranges):
                decays = [(w * own[stage]["a"], own[stage]["b"], 1.0, own[stage]["x0"]) for w, own in task.curves]
                paid += float(_bound_convex([each for each in decays if each[0] > 0], price, low, high))
        else:
            y, z = _pair(ranges)
            powers: Powers = [(weight * curve["a"], curve["b"], curve["alpha"], held_samples(curve, y, z, k))]
            rounds = weight * drift_part(curve, z) + prices[1] * y + prices[2] * z
            paid += float(np.min(_bound_convex(powers, prices[0], *ranges[0]) + rounds))
        least.append(paid * SUMS)
    return nextafter(fsum((*least, -nextafter(float(multipliers @ budgets), inf))), -inf)


def bound_largest(tasks: Sequence[VerifiedTask], prices: Array, level: float, budgets: Array, k: int) -> float:
    """Return `level` times `BELOW` if keeping to that costs more than the `budgets` (L,) at `prices` (L,), else 0."""
    least, left = [], budgets - least_cost(tasks)
    for task in tasks:
        ranges, of_unit = _afford(task, left), (task.unit @ prices).astype(float)
        y, z = _pair(ranges)
        low, high = (np.full(len(y), float(edge)) for edge in (ranges[0][0], ranges[0][1] + 1))
        most = high[0]
        while np.any(low < high):  # the fewest samples that may suffice
            x = np.floor((low + high) / 2)
            worst = np.max([error(own, (x, y, z), k) * (1 - _margin(own)) for _, own in task.curves], axis=0)
            low, high = np.where(worst <= level * BELOW, low, x + 1), np.where(worst <= level * BELOW, x, high)
        cost = low * of_unit[0] + y * of_unit[1] + z * of_unit[2] + (z > 0) * float(task.once @ prices)
        least.append(float(np.min(np.where(low < most, cost, inf))) * SUMS)
    return level * BELOW if fsum(least) * SUMS > nextafter(float(prices @ budgets), inf) else 0.0


def _afford(task: VerifiedTask, left: Array) -> list[tuple[int, int]]:
    """Return the limits, with the most at what is `left` (L,) when all else is at its least."""
    rooms = [min((floor(a / c) for a, c in zip(left, unit) if c > 0), default=inf) for unit in task.unit]
    return [(low, int(min(high, low + room))) for (low, high), room in zip(task.limits, rooms)]


def _bound_convex(powers: Powers, price: float, low: int, high: int) -> Array:
    """Return a lower bound of sum_p gain (alpha x + shift)^(-b) + price x over whole x, elementwise.

    It is that of the tangents at the first x from which on the sum does not fall, and at the x before.
    """
    rounding = max((_rounding(b) for _, b, _, _ in powers), default=2.0**-45)

    def at(x: Array) -> tuple[Array, Array]:
        bases = [(gain, b, alpha, np.asarray(alpha * x + shift)) for gain, b, alpha, shift in powers]
        value = sum((gain * base**-b for gain, b, _, base in bases), price * x)
        return value, sum((gain * b * alpha * base ** (-b - 1) for gain, b, alpha, base in bases), 0.0 * x)

    with np.errstate(divide="ignore", invalid="ignore"):
        first, last = (np.full(np.shape(powers[0][3]) if powers else (), float(edge)) for edge in (low, high))
        while np.any(first < last):
            x = np.floor((first + last) / 2)
            beyond = (first < last) & (at(x)[1] > price)  # where it is found, it stays
            first, last = np.where(beyond, x + 1, first), np.where(beyond, last, x)
        bounds = []
        for x, edge, side in ((first, high, 1), (np.maximum(first - 1, low), low, -1)):
            value, fall = at(x)
            slope = np.minimum(side * (price - fall) - rounding * (price + fall), 0.0)  # away from x, if it falls
            bounds.append(value * (1 - rounding) + np.where(x == edge, 0.0, slope * (edge - x) * side))
    return np.minimum(*bounds)


def _pair(ranges: Sequence[tuple[int, int]]) -> list[Array]:
    """Return every pair of edge and cloud rounds, as two arrays."""
    return [each.ravel() for each in np.meshgrid(*(np.arange(low, high + 1.0) for low, high in ranges[1:]))]


def _rounding(b: float) -> float:
    return (8 + 4 * b) * 2.0**-50


def _margin(curve: Data) -> float:
    stages = [curve[stage] for stage in STAGES if stage in curve] or [curve]
    return max(_rounding(each["b"]) for each in stages)
