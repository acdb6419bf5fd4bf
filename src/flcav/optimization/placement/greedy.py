"""The lazy greedy algorithm for budgeted maximum coverage, and local search by exchanges.

A candidate's gain only falls as others are chosen, so that a candidate whose earlier gain is too small need not be
recomputed (Minoux 1978). With unit costs the greedy choice covers at least 1 - 1/e of the optimum (Nemhauser, Wolsey
and Fisher 1978; e is Euler's number here); by gain over cost, or the best single candidate if that covers more, at
least (1 - 1/e) / 2 (Khuller, Moss and Naor 1999). One sensor per pole weakens neither: ranges are nested, so that a
longer one replaces a shorter one on its pole, for the difference in cost.
"""

import heapq
from collections.abc import Iterable, Iterator, Sequence
from itertools import combinations

import numpy as np

from flcav.optimization.placement.instance import TIE, CoverageInstance, reach

NOTHING = 1e-12  # the least cost that a gain is divided by
TRIALS = 1000  # exchanges tried at most


def choose_greedily(instance: CoverageInstance, budget: float) -> list[int]:
    """Return the greedy choice by gain over cost within `budget`, or the best single candidate extended, if better.

    Ascending; ties go to the earliest candidate. Here and below `budget` is an integer multiple of `UNIT`, or infinite.
    """
    chosen = extend_greedily(instance, budget, ())
    single = np.where(instance.price <= budget, instance.covers @ instance.weight, 0.0)
    best = int(np.argmax(single))
    if single[best] > instance.value(chosen) * (1 + TIE):
        return extend_greedily(instance, budget, (best,))
    return chosen


def extend_greedily(
    instance: CoverageInstance, budget: float, chosen: Iterable[int], target: float = np.inf
) -> list[int]:
    """Return `chosen` with candidates of greatest gain over cost added while they fit into `budget`, ascending.

    Ends where no candidate adds weight, or where the weight `target` is covered.
    """
    kinds = instance.sensors
    cost = instance.cost
    exact = instance.price
    on = {candidate // kinds: candidate for candidate in chosen}
    left = np.where(reach(instance.covers, [*on.values()]), 0.0, instance.weight)
    missing = target - (instance.weight.sum() - left.sum())
    held = np.zeros(len(cost) // kinds)  # cost of what each pole carries: taken down, it is saved
    held[[*on]] = cost[[*on.values()]]
    spent = instance.cost_of(on.values())

    def price(candidate: int) -> int:
        carried = on.get(candidate // kinds)
        return exact[candidate] - (0 if carried is None else exact[carried])

    def fits(candidate: int) -> bool:
        return spent + price(candidate) <= budget

    def rate(candidate: int) -> float:
        gain = float(left[instance.covered_by(candidate)].sum())
        return gain / max(float(cost[candidate] - held[candidate // kinds]), NOTHING)

    gains = instance.covers @ left
    prices = cost - np.repeat(held, kinds)
    rates = gains / np.maximum(prices, NOTHING)
    useful = np.array([k for k in np.flatnonzero(gains > 0).tolist() if fits(k)], np.int64)
    heap = list(zip((-rates[useful]).tolist(), useful.tolist(), strict=True))
    heapq.heapify(heap)
    while missing > 0:
        met: list[tuple[float, int]] = []
        top = 0.0
        while heap and -heap[0][0] >= top * (1 - TIE):
            candidate = heapq.heappop(heap)[1]
            now = rate(candidate) if fits(candidate) else 0.0
            if now > 0:
                met.append((now, candidate))
                top = max(top, now)
        if not met:
            break
        best = min(candidate for now, candidate in met if now >= top * (1 - TIE))
        for now, candidate in met:
            if candidate != best:
                heapq.heappush(heap, (-now, candidate))
        spent += price(best)
        on[best // kinds] = best
        held[best // kinds] = cost[best]
        groups = instance.covered_by(best)
        missing -= float(left[groups].sum())
        left[groups] = 0.0
        for longer in range(best + 1, (best // kinds + 1) * kinds):  # cheaper now: the shorter one is taken down
            heapq.heappush(heap, (-rate(longer), longer))
    return sorted(on.values())


def exchange(instance: CoverageInstance, budget: float, chosen: Sequence[int]) -> list[int]:
    """Return `chosen` improved by exchanges: one or two are removed and the rest extended, while that covers more."""
    best = list(chosen)
    value = instance.value(chosen)
    trials = 0
    improves = True
    while improves:
        improves = False
        for kept in _without(best):
            trials += 1
            if trials > TRIALS:
                return best
            tried = extend_greedily(instance, budget, kept)
            covered = instance.value(tried)
            if covered > value * (1 + TIE):
                best, value, improves = tried, covered, True
                break
    return best


def _without(chosen: Sequence[int]) -> Iterator[list[int]]:
    """Yield `chosen` without one, then without two of its candidates."""
    for number in (1, 2):
        for out in combinations(chosen, number):
            yield [candidate for candidate in chosen if candidate not in out]
