"""The cheapest roadside sensors that cover a share of the errors: the converse of budgeted maximum coverage.

Small instances are mixed-integer programs. Of large ones a choice is grown greedily, and reduced; the dual of the
relaxation bounds the cost from below: covered weight <= spare + price * cost, so that cost >= (target - spare) / price;
and so does the candidate that covers most weight per cost, since no choice covers more.
"""

from collections.abc import Sequence

import numpy as np

from flcav.config import InputError
from flcav.interface.wording import hint_share
from flcav.optimization.placement.greedy import extend_greedily
from flcav.optimization.placement.instance import TIE, CoverageInstance
from flcav.optimization.placement.program import bound_by_highs, minimise_cost
from flcav.optimization.placement.relaxation import Relaxation, bound_by, relax
from flcav.optimization.placement.solve import (
    SEARCHED,
    WHOLE,
    Candidates,
    Found,
    Method,
    Placement,
    certify,
    describe,
    improve,
    keep_candidates,
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
    instance, total = candidates.instance(), float(candidates.weight.sum())
    most = float(instance.weight.sum())
    if most < share * total * (1 - TIE) or not most:
        part = most / total if total else 0.0
        raise InputError(f"cover = {share:g}: sensors on all poles together cover only {part:.4g} of the errors")
    target = min(share * total, most) * (1 - TIE)
    found = minimise(instance, target, method)
    cost = float(instance.cost[found.chosen].sum())
    least = min(found.bound, cost)
    bound = bound_by_highs(instance, cost)[0] if instance.covers.nnz <= WHOLE else relax(instance, cost).bound
    certificate = certify(candidates, instance, found.root, _least_cost(found.root, target), found.search)
    optimal = cost <= least * (1 + TIE) + TIE
    return describe(candidates, found.chosen, bound, certificate, optimal), least


def minimise(instance: CoverageInstance, target: float, method: Method) -> Found:
    """Return the cheapest candidates that cover `target` of the weight, with a proven lower bound on their cost."""
    chosen = _drop(instance, target, extend_greedily(instance, np.inf, (), target))
    cost = float(instance.cost[chosen].sum())
    if method == "exact" and instance.covers.nnz <= WHOLE:
        best, least = minimise_cost(instance, target)
        chosen = chosen if best is None else best
        cost = float(instance.cost[chosen].sum())
        root = bound_by(instance, cost, bound_by_highs(instance, cost)[1], np.zeros(len(instance.cost)))
        return Found(chosen, least, root, least)
    root = relax(instance, cost)
    if method == "exact":
        for _ in range(CUTS):
            tried = improve(instance, cost * (1 - 1e-3), chosen[:0], root)
            if instance.value(tried) < target:
                break
            chosen = _drop(instance, target, tried)
            cost = float(instance.cost[chosen].sum())
        root = relax(instance, cost)
    densest = float((instance.covers @ instance.weight / np.maximum(instance.cost, NOTHING)).max())  # weight per cost
    by_dual = _least_cost(root, target)
    least = max(by_dual, target / densest)
    if method == "greedy" or cost <= least * (1 + TIE):
        return Found(chosen, least, root)
    rest = keep_candidates(instance, by_dual + root.loss / max(root.price, NOTHING) < cost * (1 - TIE))
    if rest.weight.sum() < target:
        return Found(chosen, cost, root, cost)
    if rest.covers.nnz > SEARCHED:
        return Found(chosen, least, root)
    best, bound = minimise_cost(rest, target, limited=True)
    if best is not None and instance.cost[best].sum() < cost:
        chosen, cost = best, float(instance.cost[best].sum())
    bound = max(least, min(bound, cost))
    return Found(chosen, bound, root, bound)


def _least_cost(root: Relaxation, target: float) -> float:
    """Return the cost below which, by the dual of `root`, no choice covers the weight `target`."""
    return (target - root.spare) / max(root.price, NOTHING)


def _drop(instance: CoverageInstance, target: float, chosen: Sequence[int]) -> list[int]:
    """Return the choice without those, the dearest first, that `target` does not need."""
    kept = list(chosen)
    for candidate in sorted(chosen, key=lambda each: -instance.cost[each]):
        others = [other for other in kept if other != candidate]
        if instance.value(others) >= target:
            kept = others
    return kept
