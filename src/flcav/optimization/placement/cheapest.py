"""The cheapest roadside sensors that cover a share of the errors: the converse of budgeted maximum coverage.

Small instances are mixed-integer programs. For large ones a choice is grown greedily, then reduced. Two lower bounds on
the cost hold: from the dual of the relaxation, covered weight <= spare + price * cost, so that
cost >= (target - spare) / price; and from the candidate of greatest weight per cost, since no choice covers more per
cost.
"""

from collections.abc import Sequence
from fractions import Fraction
from math import ceil, inf, nextafter

import numpy as np

from flcav.config import InputError
from flcav.interface.wording import hint_share
from flcav.optimization.placement.enumeration import ENUMERATED, find_better
from flcav.optimization.placement.greedy import extend_greedily
from flcav.optimization.placement.instance import TIE, UNIT, CoverageInstance, as_float, common_unit
from flcav.optimization.placement.program import is_coarse, is_wide, minimise_cost
from flcav.optimization.placement.relaxation import EPS, Relaxation, relax
from flcav.optimization.placement.solve import (
    NEARLY,
    SEARCHED,
    WHOLE,
    Candidates,
    Found,
    Method,
    Placement,
    bound_at,
    certify,
    describe,
    improve,
    keep_candidates,
    lower_to,
)

NOTHING = 1e-300  # in place of 0, to divide by
CUTS = 40  # times that a choice is tried to be made at less cost


def cover_share(candidates: Candidates, share: float, *, method: Method = "exact") -> tuple[Placement, float]:
    """Return the cheapest placement that covers `share` of the errors' weight, and a proven lower bound on its cost.

    `upper_bound` of the placement is the most weight that its cost can cover; `optimal` is whether its cost is proven
    least. Raises `InputError` where the share is not in (0, 1], or all candidates together cover less.
    """
    if not 0 < share <= 1:
        raise InputError(
            f"cover = {share}: must be a share of the errors, more than 0 and at most 1{hint_share(share)}"
        )
    instance, total = candidates.instance(), sum(candidates.worth.tolist())
    most = sum(instance.worth.tolist())
    target = ceil(Fraction(repr(float(share))) * total)
    if most < target or not most:
        part = f"{most / total if total else 0.0:.4g}"
        if total and float(part) >= share:
            part = f"a weight of {as_float(most):.15g} of {as_float(total):.15g}"
        raise InputError(f"cover = {share:g}: sensors on all poles together cover only {part} of the errors")
    found = minimise(instance, target, method)
    price = instance.cost_of(found.chosen)
    cost = as_float(price)
    least, limit = min(found.bound, cost), nextafter(cost, inf)
    bound = (bound_at if instance.covers.nnz <= WHOLE else relax)(instance, limit).bound
    bound = lower_to(instance, bound, found.chosen)
    certificate = certify(candidates, instance, found.root, _least_cost(found.root, target), found.search)
    return describe(candidates, found.chosen, bound, certificate, least == cost), least


def minimise(instance: CoverageInstance, target: int, method: Method) -> Found:
    """Return the cheapest candidates that cover the exact weight `target`, with a lower bound on their cost."""
    chosen = _drop(instance, target, extend_greedily(instance, np.inf, (), as_float(target) * (1 + TIE)))
    price = instance.cost_of(chosen)
    if method == "exact" and instance.covers.nnz <= WHOLE:
        if is_wide(instance.price.tolist()) or is_wide(instance.worth.tolist()):
            chosen, ended = _cheapen_exactly(instance, target, chosen)
            if ended:
                cost = as_float(instance.cost_of(chosen))
                return Found(chosen, cost, bound_at(instance, cost), cost)
        best, least = minimise_cost(instance, target)
        chosen = min((chosen, best or chosen), key=instance.cost_of)
        root = bound_at(instance, as_float(instance.cost_of(chosen)))
        return _close(instance, instance, target, chosen, root, least)
    root = relax(instance, as_float(price))
    if method == "exact":
        for _ in range(CUTS):  # try a budget .1 % lower, as long as the target is still reached
            tried = improve(instance, price * 999 // 1000, chosen[:0], root)
            if not _reaches(instance, tried, target):
                break
            chosen = _drop(instance, target, tried)
            price = instance.cost_of(chosen)
        root = relax(instance, as_float(price))
    cost = as_float(price)
    gain = instance.covers @ instance.weight * (1 + EPS * (np.diff(instance.covers.indptr) + 8))
    densest = float((gain / np.maximum(instance.cost, NOTHING)).max())  # weight per cost
    by_dual = _least_cost(root, target)
    least = max(by_dual, as_float(target) * (1 - 4 * EPS) / densest)
    if method == "greedy" or cost <= least:
        return Found(chosen, _raise_to(instance, least, price), root)
    rest = keep_candidates(instance, by_dual + root.loss / max(root.price, NOTHING) < cost * (1 + TIE))
    if rest.covers.nnz > SEARCHED:
        return Found(chosen, _raise_to(instance, least, price), root)
    if sum(rest.worth.tolist()) < target:
        return Found(chosen, cost, root, cost)
    best, bound = minimise_cost(rest, target, limited=True)
    chosen = min((chosen, best or chosen), key=instance.cost_of)
    return _close(instance, rest, target, chosen, root, max(least, bound), least)


def _close(
    instance: CoverageInstance,
    rest: CoverageInstance,
    target: int,
    chosen: list[int],
    root: Relaxation,
    claimed: float,
    proven: float = 0.0,
) -> Found:
    """Return `chosen`, or a cheaper choice, with the greatest proven lower bound on the cost (see `solve._close`)."""
    proven = max(proven, _least_cost(root, target))
    prices = instance.price.tolist()
    worth = instance.worth.tolist()
    cost = as_float(instance.cost_of(chosen))
    if is_coarse(prices) and is_coarse(worth) and claimed > cost - as_float(common_unit(prices)) / 2:
        return Found(chosen, cost, root, cost)
    if claimed >= cost * (1 - NEARLY):
        chosen, ended = _cheapen_exactly(rest, target, chosen)
        cost = as_float(instance.cost_of(chosen))
        if ended:
            return Found(chosen, cost, root, cost)
    if is_wide(prices) or is_wide(worth):
        return Found(chosen, proven, root)
    bound = max(proven, min(claimed, cost))
    return Found(chosen, cost if bound >= cost * (1 - TIE) else bound, root, bound)


def _cheapen_exactly(rest: CoverageInstance, target: int, chosen: list[int]) -> tuple[list[int], bool]:
    """Return the cheapest choice that the search in integers finds, and whether it proves that none is cheaper."""
    if rest.covers.nnz > ENUMERATED:
        return chosen, False
    while True:
        cost = rest.cost_of(chosen)
        better, ended = find_better(rest, bound_at(rest, as_float(cost)), cost - 1, target)
        if better is None:
            return chosen, ended
        chosen = better


def _raise_to(instance: CoverageInstance, bound: float, cost: int) -> float:
    """Return the exact `cost` as a float where `bound` excludes every smaller sum of costs; else `bound`."""
    if bound < as_float(cost) * (1 - TIE):
        return bound
    return as_float(cost) if Fraction(bound) / UNIT > cost - common_unit(instance.price.tolist()) else bound


def _least_cost(root: Relaxation, target: int) -> float:
    """Return the least cost at which, by the dual of `root`, a choice may cover the exact weight `target`."""
    if root.price <= 0:
        return 0.0
    return max(0.0, nextafter(float((target * UNIT - Fraction(root.spare)) / Fraction(root.price)), -inf))


def _reaches(instance: CoverageInstance, chosen: Sequence[int], target: int) -> bool:
    """Return whether the chosen candidates cover the exact weight `target`; floats decide where they clearly can."""
    value, wanted = instance.value(chosen), as_float(target)
    if abs(value - wanted) > TIE * wanted:
        return value > wanted
    return instance.worth_of(chosen) >= target


def _drop(instance: CoverageInstance, target: int, chosen: Sequence[int]) -> list[int]:
    """Return the choice without the candidates, the most expensive first, that `target` does not need."""
    kept = list(chosen)
    for candidate in sorted(chosen, key=lambda each: -instance.cost[each]):
        others = [other for other in kept if other != candidate]
        if _reaches(instance, others, target):
            kept = others
    return kept
