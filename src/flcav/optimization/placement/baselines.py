"""Conventional placements: by a score of each candidate, such as its traffic, and at random."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flcav.geometry.arrays import Array
from flcav.optimization.placement.instance import TIE, as_float
from flcav.optimization.placement.solve import Candidates, Placement, describe
from flcav.statistics.streams import stream

DRAWS = 200


@dataclass(frozen=True)
class ExpectedCoverage:
    """Mean coverage of random placements."""

    covered: float  # errors
    covered_weight: float


def place_by_score(candidates: Candidates, score: Array, budget: float) -> Placement:
    """Return the placement of the candidates with the greatest `score` (P * S,) over cost that fit into `budget`.

    Overlap is ignored; ties go to the earlier candidate. With unit costs the budget is a number of sensors. Nothing is
    proven: `upper_bound` is the covered weight.
    """
    order = np.argsort(-score / np.maximum(candidates.cost, TIE), kind="stable")
    chosen = _fill(candidates, order, budget)
    return describe(candidates, chosen, bound=0.0, optimal=False)


def place_at_random(candidates: Candidates, budget: float, draws: int = DRAWS, seed: int = 0) -> ExpectedCoverage:
    """Return the mean coverage of `draws` random placements, each filled in random order within `budget`."""
    random = stream(seed, "random-placements")
    errors, weight = np.zeros(draws), np.zeros(draws)
    for draw in range(draws):
        chosen = _fill(candidates, random.permutation(len(candidates.cost)), budget)
        covered = np.bincount(candidates.covers[chosen].indices, minlength=len(candidates.weight)) > 0
        errors[draw], weight[draw] = covered.sum(), candidates.weight[covered].sum()
    return ExpectedCoverage(float(errors.mean()), float(weight.mean()))


def _fill(candidates: Candidates, order: NDArray[np.int64], budget: float) -> list[int]:
    """Return the candidates, taken in `order`, that fit into the remaining budget, one per pole, ascending."""
    price, spent, taken = candidates.price.tolist(), 0, {}
    cheapest = min(price)
    for candidate in order.tolist():
        if as_float(spent + cheapest) > budget:
            break
        pole = candidate // candidates.sensors
        if pole not in taken and as_float(spent + price[candidate]) <= budget:
            taken[pole] = candidate
            spent += price[candidate]
    return sorted(taken.values())
