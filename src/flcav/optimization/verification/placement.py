"""Verification of a placement of sensors: coverage, cost and dual bound recomputed from positions and certificate.

It shares no code with the solvers. By weak duality, for any 0 <= u <= w of the errors and any price l >= 0, every
choice within a budget B, with at most one sensor per pole, has

    covered weight <= sum_e (w_e - u_e) + l B + sum_poles max(0, max_sensors (sum_covered u_e - l cost)),

so that covering a weight W costs at least (W - all terms but l B) / l; and at least W / (most weight per cost of a
sensor). Sums of the dual are correctly rounded, then outward. Costs and covered weights are exact, of the decimals by
which floats are written, and so are distances where they decide; sums of weights, or of costs, differ by a multiple of
their greatest common divisor, so that a bound closer than that to the choice proves it optimal, too.
"""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from fractions import Fraction
from math import fsum, gcd, inf, lcm, nextafter

import numpy as np
from numpy.typing import NDArray

from flcav.geometry.arrays import Array
from flcav.optimization.verification.record import Verification, exact, judge_claims

NOTHING = Fraction(1, 10**300)  # in place of 0, to divide by
ROUNDING = 1e-14  # relative to the sum: of floats that bounds are stated with
PLACES = "the positions, weights and ranges, and what each pole sees, where that is given"
SEARCH = "the search above the dual (the solver's word): that nothing better than {:.9g} exists"
UPPER = "the linear program's word that this cost covers at most {:.9g}"


@dataclass(frozen=True)
class PlacementProblem:
    """A placement problem, with one of the limits `count`, `budget` and `cover`; positions in the world frame."""

    errors: Array  # (E, 3) [m]
    weight: Array  # (E,)
    poles: Array  # (P, 3) [m]
    ranges_m: Array  # (S,) [m]
    cost: Array | NDArray[np.object_]  # (P, S) of a sensor and its pole: floats, or `Fraction`
    count: int | None = None  # sensors
    budget: float | None = None
    cover: float | None = None  # share of the weight
    visible: NDArray[np.bool_] | None = None  # (P, E) whether a pole sees an error; None: all do


def find_reached(asked: PlacementProblem) -> list[list[NDArray[np.intp]]]:
    """Return the indices of the errors that each sensor covers, by pole and sensor."""
    covered: list[list[NDArray[np.intp]]] = []
    for number, pole in enumerate(asked.poles):
        squared = ((asked.errors - pole) ** 2).sum(axis=1)
        covered.append([])
        for range_m in asked.ranges_m.tolist():
            inside = squared <= range_m**2
            doubt = 1e-12 * range_m * (range_m + float(np.abs(pole).max()))
            for error in np.flatnonzero(np.abs(squared - range_m**2) <= doubt).tolist():
                apart = (exact(asked.errors[error, axis]) - exact(asked.poles[number, axis]) for axis in range(3))
                inside[error] = sum(each**2 for each in apart) <= exact(range_m) ** 2
            covered[-1].append(np.flatnonzero(inside if asked.visible is None else inside & asked.visible[number]))
    return covered


def verify_placement(asked: PlacementProblem, placed_json: str, least: float | None = None) -> Verification:
    """Return the verification of a `Placement` as JSON text; `least` is the stated bound on the cost, with `cover`."""
    placed = json.loads(placed_json)
    reached, proof, weight, upper = find_reached(asked), placed["certificate"], asked.weight, placed["upper_bound"]
    u, price, on = (
        np.asarray(proof["values"], np.float64),
        exact(proof["price"]),
        [*zip(placed["chosen"], placed["sensors"])],
    )
    covered = np.unique(np.concatenate([np.zeros(0, np.intp), *(reached[pole][sensor] for pole, sensor in on)]))
    decimals = [*map(exact, weight.tolist())]
    prices = asked.cost.tolist()
    cost = sum((exact(prices[pole][sensor]) for pole, sensor in on), Fraction(0))
    value = sum((decimals[each] for each in covered), Fraction(0))
    limit = exact(asked.budget) if asked.budget is not None else Fraction(asked.count or 0) or cost
    spare, densest = _sum_up((*weight, *-u)) + _sum_up(weight) / 2**52, Fraction(0)
    for covers, row in zip(reached, prices):
        paid = [Fraction(1) if asked.count else exact(each) for each in row]
        spare += max(Fraction(0), *(_sum_up(u[each]) - price * c for each, c in zip(covers, paid)))
        densest = max(densest, *(_sum_up(weight[each]) / max(c, NOTHING) for each, c in zip(covers, paid)))
    most, trusted, search = nextafter(float(spare + price * limit), inf), [PLACES], proof["search"]
    claims = {
        "one sensor a pole": len(set(placed["chosen"])) == len(on) and asked.count in (None, len(on)),
        "the cost": abs(placed["cost"] - cost) <= ROUNDING * cost,
        "the limit": bool(asked.count) or cost <= limit,
        "the errors covered": len(covered) == placed["covered"] and placed["covered_weight"] == float(value),
        "the dual": bool(price >= 0 and np.all((u >= 0) & (u <= weight))),
    }
    if asked.cover is None:

        def proves(stated: float) -> bool:
            above = most <= stated + ROUNDING * fsum(weight)
            return above or (stated >= float(value) and most < value + _unit(decimals))

        claims["the dual's bound"], proven = proves(proof["bound"]), proves(upper)
        claims["the upper bound"] = upper >= float(value) and (
            proven or (search is not None and _at_most(search, upper))
        )
        claims["whether it is optimal"] = placed["optimal"] == (upper <= float(value))
        trusted += [SEARCH.format(upper)] * (not proven)
        beyond = value + _unit(decimals)
        excluded = float(beyond) if upper <= float(value) < float(f"{most:.9g}") and most < beyond else None
        return judge_claims(float(value), [cost], most, claims, trusted, excluded)
    target = exact(asked.cover) * sum(decimals, Fraction(0))
    stated_least = inf if least is None else least
    by_dual = max(float((target - spare) / max(price, NOTHING)) if target > spare else 0.0, 0.0)
    fewest = max(by_dual, float(target / max(densest, NOTHING)))
    below = cost - _unit(exact(each) for row in prices for each in row)
    proven = _at_most(stated_least, fewest) or fewest > below
    claims["the share"] = value >= target
    claims["the dual's bound"] = _at_most(proof["bound"], by_dual)
    claims["the bound on the cost"] = _at_most(stated_least, float(cost)) and (
        proven or _at_most(stated_least, search or 0.0)
    )
    claims["whether it is optimal"] = placed["optimal"] == (stated_least >= placed["cost"])
    claims["the upper bound"] = upper >= float(value)
    trusted += [SEARCH.format(stated_least)] * (not proven) + [UPPER.format(upper)] * (not _at_most(most, upper))
    whole = stated_least >= placed["cost"] and float(f"{fewest:.9g}") < float(cost) and fewest > below
    excluded = float(below) if whole else None
    return judge_claims(float(cost), [cost], min(fewest, float(cost)), claims, trusted, excluded)


def _sum_up(values: Iterable[float]) -> Fraction:
    return Fraction(nextafter(fsum(values), inf))


def _unit(decimals: Iterable[Fraction]) -> Fraction:
    """Return the greatest common divisor: sums of the decimals differ by a multiple of it, or not at all."""
    fractions = [*decimals]
    whole = lcm(*(each.denominator for each in fractions))
    return Fraction(gcd(*(int(each * whole) for each in fractions)), whole)


def _at_most(one: float, other: float) -> bool:
    return one <= other + ROUNDING * abs(other)
