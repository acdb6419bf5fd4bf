"""Exact search for a better choice: enumeration of all choices close enough to a dual bound, in integers.

With duals u_j of groups and a price l, the bound exceeds the covered weight of a choice by exactly the sum of these
non-negative terms: for each pole, its largest net value less that of the sensor chosen, where a sensor's net value is
the sum of the u_j that it covers less l times its cost; u_j for each repeated covering of a group; w_j - u_j for each
group that is not covered; l times the unspent budget. A depth-first search therefore prunes every node where the sum
exceeds the difference between the bound and the wanted weight: reduced-cost fixing (Nemhauser and Wolsey, "Integer and
Combinatorial Optimization", 1988, sec. II.5), at every node.
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
    """Return the best choice that the search in integers finds, and whether it proves that none is better.

    `rest` holds the candidates among which a better choice may exist; `relaxed` is any dual solution of it.
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
    """Return a choice within `budget` that covers the weight `wanted`, both exact, and whether the search is complete.

    None after a complete search proves that there is no such choice. `relaxed` is any dual solution of the instance.
    """
    kinds = instance.sensors
    worth = instance.worth.tolist()
    price = instance.price.tolist()
    # Duals and price become integers, scaled by 2^bits, so that deviations add up without rounding.
    bits = PRECISION + (max(0, ceil(-log2(relaxed.price))) if relaxed.price > 0 else 0)
    rate = int(relaxed.price * 2.0**PRECISION * 2 ** (bits - PRECISION))
    weight = [each << bits for each in worth]
    dual = [min(_scale(u, bits), w) for u, w in zip(relaxed.dual.tolist(), weight, strict=True)]
    covered = [instance.covered_by(k).tolist() for k in range(len(price))]
    net = [sum(dual[j] for j in groups) - rate * cost for groups, cost in zip(covered, price, strict=True)]
    most = [max(0, *net[first : first + kinds]) for first in range(0, len(net), kinds)]
    slack = sum(weight) - sum(dual) + rate * budget + sum(most) - (wanted << bits)

    masks = [sum(1 << j for j in groups) for groups in covered]
    options: list[list[tuple[int, int]]] = []  # by pole, ascending by loss: loss and candidate, -1 for no sensor
    for pole, best in enumerate(most):
        choices = [(best, -1), *((best - net[k], k) for k in range(pole * kinds, (pole + 1) * kinds))]
        options.append(sorted(each for each in choices if each[0] <= slack))
    if slack < 0 or not all(options):
        return None, True
    options = sorted(
        (choices for choices in options if [k for _, k in choices] != [-1]), key=lambda choices: -choices[-1][0]
    )
    later = [0]  # bit mask of the groups that the poles from here on can cover
    for choices in reversed(options):
        later.append(later[-1] | _unite(masks[k] for _, k in choices if k >= 0))
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
