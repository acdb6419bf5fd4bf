"""Exact search for a better choice: every choice whose deviation from a dual bound is small enough, in whole numbers.

With duals u_j of groups and a price l, the bound exceeds the covered weight of any choice by exactly the sum of these,
none of which is negative: for each pole its largest net value less that of its sensor, where a sensor's is the u_j it
covers less l times its cost; u_j for each time that a group is covered again; w_j - u_j of each group that is not
covered; l times what is left of the budget. A search by depth therefore leaves out what exceeds the difference between
the bound and the weight that is wanted: reduced-cost fixing (Nemhauser and Wolsey, "Integer and Combinatorial
Optimization", 1988, sec. II.5), at every node.
"""

from collections.abc import Iterable
from math import ceil, log2

from flcav.optimization.placement.instance import DECIMALS, CoverageInstance
from flcav.optimization.placement.relaxation import Relaxation

ENUMERATED = 6000  # covered pairs up to which choices are enumerated
NODES = 50_000  # of the search tree at most
PRECISION = 40  # bits of the price, and of duals beyond `UNIT`


def improve_exactly(
    instance: CoverageInstance, rest: CoverageInstance, relaxed: Relaxation, budget: int, chosen: list[int]
) -> tuple[list[int], bool]:
    """Return the best choice that the search in whole numbers finds, and whether it proves that none is better.

    `rest`: the candidates of which a better choice is, with any dual, `relaxed`.
    """
    if rest.covers.nnz > ENUMERATED:
        return chosen, False
    while True:
        better, ended = find_better(rest, relaxed, budget, instance.worth_of(chosen) + 1)
        if better is None:
            return chosen, ended
        chosen = better


def find_better(
    instance: CoverageInstance, relaxed: Relaxation, budget: int, wanted: int
) -> tuple[list[int] | None, bool]:
    """Return a choice within `budget` that covers `wanted` weight, both exact, and whether the search has ended.

    None after a search that has ended: there is no such choice. `relaxed`: any dual of the instance.
    """
    kinds, worth, price = instance.sensors, instance.worth.tolist(), instance.price.tolist()
    bits = PRECISION + (max(0, ceil(-log2(relaxed.price))) if relaxed.price > 0 else 0)
    rate = int(relaxed.price * 2.0**PRECISION * 2 ** (bits - PRECISION))
    weight = [each << bits for each in worth]
    dual = [min(_scale(u, bits), w) for u, w in zip(relaxed.dual.tolist(), weight, strict=True)]
    covered = [instance.covered_by(k).tolist() for k in range(len(price))]
    net = [sum(dual[j] for j in own) - rate * cost for own, cost in zip(covered, price, strict=True)]
    most = [max(0, *net[first : first + kinds]) for first in range(0, len(net), kinds)]
    slack = sum(weight) - sum(dual) + rate * budget + sum(most) - (wanted << bits)

    masks = [sum(1 << j for j in own) for own in covered]
    options: list[list[tuple[int, int]]] = []  # by pole, the least loss first: loss and candidate, -1 for none
    for pole, best in enumerate(most):
        own = [(best, -1), *((best - net[k], k) for k in range(pole * kinds, (pole + 1) * kinds))]
        options.append(sorted(each for each in own if each[0] <= slack))
    if slack < 0 or not all(options):
        return None, True
    options = sorted((own for own in options if [k for _, k in own] != [-1]), key=lambda own: -own[-1][0])
    later = [0]  # groups that poles from each on can cover
    for own in reversed(options):
        later.append(later[-1] | _unite(masks[k] for _, k in own if k >= 0))
    later.reverse()
    everything = (1 << len(weight)) - 1

    def lose(missing: int) -> int:
        return sum(weight[j] - dual[j] for j in _list_bits(missing))

    start = everything & ~later[0]
    stack: list[tuple[int, int, int, int, int, tuple[int, ...]]] = [(0, 0, start, lose(start), 0, ())]
    for _ in range(NODES):
        if not stack:
            return None, True
        depth, has, lost, off, spent, chosen = stack.pop()
        if depth == len(options):
            if sum(worth[j] for j in _list_bits(has)) >= wanted:
                return sorted(chosen), True
            continue
        for loss, k in reversed(options[depth]):
            mask, cost = (masks[k], price[k]) if k >= 0 else (0, 0)
            if spent + cost > budget:
                continue
            now = has | mask
            gone = everything & ~(now | later[depth + 1] | lost)
            deviation = off + loss + sum(dual[j] for j in _list_bits(has & mask)) + lose(gone)
            if deviation <= slack:
                taken = (*chosen, k) if k >= 0 else chosen
                stack.append((depth + 1, now, lost | gone, deviation, spent + cost, taken))
    return None, not stack


def _scale(value: float, bits: int) -> int:
    above, below = value.as_integer_ratio()
    return (above * 10**DECIMALS << bits) // below


def _unite(masks: Iterable[int]) -> int:
    found = 0
    for mask in masks:
        found |= mask
    return found


def _list_bits(mask: int) -> list[int]:
    found = []
    while mask:
        low = mask & -mask
        found.append(low.bit_length() - 1)
        mask ^= low
    return found
