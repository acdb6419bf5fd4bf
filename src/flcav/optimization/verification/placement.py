"""Verification of a placement of sensors: coverage, cost and dual bound recomputed from positions and certificate.

Nothing of it is the solvers'. By weak duality, for any 0 <= u <= w of the errors and any price l >= 0, each choice
within a budget B, at most one sensor a pole, has

    covered weight <= sum_e (w_e - u_e) + l B + sum_poles max(0, max_sensors (sum_covered u_e - l cost)),

so that covering a weight W costs at least (W - all but l B) / l; and at least W / (most weight per cost of a sensor).
Sums are correctly rounded, then outward; costs are exact, of the decimals that floats are written with, and so are
distances where they decide.
"""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from fractions import Fraction
from math import fsum, inf, nextafter

import numpy as np
from numpy.typing import NDArray

from flcav.optimization.verification.record import NEAR, Verification, exact, judge, near

Array = NDArray[np.float64]
NOTHING = Fraction(1, 10**300)  # in place of 0, to divide by
PLACES = "the positions, weights and ranges, and what each pole sees, where that is given"
SEARCH = "the search above the dual (HiGHS' word): that nothing better than {:.9g} exists"
UPPER = "the linear program's word that this cost covers at most {:.9g}"


@dataclass(frozen=True)
class PlacementProblem:
    """A placement problem: one of `count`, `budget` and `cover` is given."""

    errors: Array  # (E, 3) [m]
    weight: Array  # (E,)
    poles: Array  # (P, 3) [m]
    ranges_m: Array  # (S,)
    cost: Array  # (P, S) of a sensor and its pole
    count: int | None = None  # sensors
    budget: float | None = None
    cover: float | None = None  # share of the weight
    visible: NDArray[np.bool_] | None = None  # (P, E) whether a pole sees an error; None: all do


def find_reached(asked: PlacementProblem) -> list[list[NDArray[np.intp]]]:
    """Return the numbers of the errors that each sensor on each pole covers, by pole and sensor."""
    found: list[list[NDArray[np.intp]]] = []
    for number, pole in enumerate(asked.poles):
        squared = ((asked.errors - pole) ** 2).sum(axis=1)
        found.append([])
        for range_m in asked.ranges_m.tolist():
            inside = squared <= range_m**2
            for error in np.flatnonzero(np.abs(squared - range_m**2) <= 1e-12 * range_m**2).tolist():
                apart = (exact(asked.errors[error, axis]) - exact(asked.poles[number, axis]) for axis in range(3))
                inside[error] = sum(each**2 for each in apart) <= exact(range_m) ** 2
            found[-1].append(np.flatnonzero(inside if asked.visible is None else inside & asked.visible[number]))
    return found


def verify_placement(asked: PlacementProblem, placed_json: str, least: float | None = None) -> Verification:
    """Return the verification of a `Placement` as JSON text, with `cover` also of the bound `least` on its cost."""
    placed = json.loads(placed_json)
    reached, proof, weight, upper = find_reached(asked), placed["certificate"], asked.weight, placed["upper_bound"]
    u, price, on = (
        np.asarray(proof["values"], np.float64),
        exact(proof["price"]),
        [*zip(placed["chosen"], placed["sensors"])],
    )
    covered = np.unique(np.concatenate([reached[pole][sensor] for pole, sensor in on]))
    cost, value = sum((exact(float(asked.cost[each])) for each in on), Fraction(0)), fsum(weight[covered])
    limit = exact(asked.budget) if asked.budget is not None else Fraction(asked.count or 0) or cost
    spare, densest = _sum_up((*weight, *-u)), Fraction(0)
    for own, prices in zip(reached, asked.cost.tolist()):
        paid = [Fraction(1) if asked.count else exact(each) for each in prices]
        spare += max(Fraction(0), *(_sum_up(u[each]) - price * c for each, c in zip(own, paid)))
        densest = max(densest, *(_sum_up(weight[each]) / max(c, NOTHING) for each, c in zip(own, paid)))
    most, trusted, search = nextafter(float(spare + price * limit), inf), [PLACES], proof["search"]
    claims = {
        "one sensor a pole": len(set(placed["chosen"])) == len(on) and asked.count in (None, len(on)),
        "the cost": near(float(cost), placed["cost"]),
        "the limit": bool(asked.count) or cost <= limit * (1 + Fraction(NEAR)),
        "the errors covered": len(covered) == placed["covered"] and near(value, placed["covered_weight"]),
        "the dual": bool(price >= 0 and np.all((u >= 0) & (u <= weight))),
    }
    if asked.cover is None:
        claims["the dual's bound"] = _at_most(most, proof["bound"])
        claims["the upper bound"] = _at_most(value, upper) and _at_most(
            most if search is None else min(most, search), upper
        )
        claims["whether it is optimal"] = placed["optimal"] == _at_most(upper, value)
        trusted += [SEARCH.format(upper)] * (not _at_most(most, upper))
        return judge(value, [cost], most, claims, trusted)
    target, told = exact(asked.cover) * _sum_up(weight) * (1 - Fraction(NEAR)), inf if least is None else least
    by_dual = float((target - spare) / max(price, NOTHING))
    fewest = max(by_dual, float(target / max(densest, NOTHING)), 0.0)
    claims["the share"] = _at_most(float(target), value)
    claims["the dual's bound"] = _at_most(proof["bound"], by_dual)
    claims["the bound on the cost"] = _at_most(told, float(cost)) and _at_most(told, max(fewest, search or 0.0))
    claims["whether it is optimal"] = placed["optimal"] == _at_most(float(cost), told)
    claims["the upper bound"] = _at_most(value, upper)
    trusted += [SEARCH.format(told)] * (not _at_most(told, fewest)) + [UPPER.format(upper)] * (
        not _at_most(most, upper)
    )
    return judge(float(cost), [cost], min(fewest, float(cost)), claims, trusted)


def _sum_up(values: Iterable[float]) -> Fraction:
    return Fraction(nextafter(fsum(values), inf))


def _at_most(one: float, other: float) -> bool:
    return one <= other + NEAR * (1 + abs(other))
