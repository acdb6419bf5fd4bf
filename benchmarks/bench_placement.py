"""Placement of sensors against HiGHS on the same instance, in one run and one thread; large instances with their gap.

Errors cluster along the streets of a city of 1.2 km, poles stand along them; three sensors, at most one a pole. The
reference is the mixed-integer program of the merged instance, solved by HiGHS alone to the same proven optimum.
"""

import argparse
import json
import time
from collections.abc import Callable

import numpy as np
from cpu_time import cpu_ms

from flcav.optimization.placement.cheapest import cover_share
from flcav.optimization.placement.instance import limit_in_units
from flcav.optimization.placement.program import maximise_coverage
from flcav.optimization.placement.solve import Candidates, Placement, find_candidates, place_budget, place_count

RANGES_M, SENSOR_COST = (35.0, 60.0, 95.0), (1.0, 2.2, 4.6)
REFERENCED = (3_000, 200, 15.0)  # errors, poles, budget
LARGE = (100_000, 1_000)


def draw_city(errors: int, poles: int, seed: int):
    """Return errors (E, 3) [m], their weights (E,), poles (P, 3) [m] and their costs (P,)."""
    rng = np.random.default_rng(seed)
    streets = np.arange(0, 1201, 100.0)

    def on_streets(count: int):
        along, street = rng.uniform(0, streets[-1], count), rng.choice(streets, count)
        return np.where((rng.random(count) < 0.5)[:, None], np.c_[along, street], np.c_[street, along])

    spots, share = on_streets(600), rng.pareto(1.2, 600) + 0.05
    spot = rng.choice(600, int(errors * 0.8), p=share / share.sum())
    rest = errors - len(spot)
    xy = np.r_[spots[spot] + rng.normal(0, 14, (len(spot), 2)), on_streets(rest) + rng.normal(0, 4, (rest, 2))]
    sites = np.c_[on_streets(poles) + rng.choice((-7.0, 7.0), (poles, 1)), rng.uniform(4, 8, poles)]
    return np.c_[xy, rng.uniform(0, 2, errors)], rng.lognormal(0, 0.8, errors), sites, rng.uniform(0.5, 1.5, poles)


def candidates_of(errors: int, poles: int, seed: int, kinds: slice = slice(None)) -> Candidates:
    """Return the candidates of a city, with the sensors `kinds`."""
    places, weight, sites, cost = draw_city(errors, poles, seed)
    return find_candidates(
        places, sites, RANGES_M[kinds], weight=weight, pole_cost=cost, sensor_cost=SENSOR_COST[kinds]
    )


def measure_once(solve: Callable[[], Placement]) -> dict[str, float]:
    """Return the CPU seconds of a call, and the gap between what it covers and its bound."""
    start = time.process_time()
    found = solve()
    seconds = time.process_time() - start
    return {
        "cpu_s": seconds,
        "covered_weight": found.covered_weight,
        "gap": found.upper_bound / found.covered_weight - 1,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    errors, poles, budget = REFERENCED
    small = candidates_of(errors, poles, arguments.seed)
    ours_ms, highs_ms = cpu_ms(
        (lambda: place_budget(small, budget), lambda: maximise_coverage(small.instance(), limit_in_units(budget))),
        repeats=1,
    )
    found, (_, reference) = place_budget(small, budget), maximise_coverage(small.instance(), limit_in_units(budget))
    figures = {
        "referenced": {
            "ours_ms": ours_ms,
            "highs_ms": highs_ms,
            "ratio": highs_ms / ours_ms,
            "difference": found.upper_bound / reference - 1,
        },
        "budget 60": measure_once(lambda: place_budget(candidates_of(*LARGE, arguments.seed), 60.0)),
        "budget 60, greedy": measure_once(
            lambda: place_budget(candidates_of(*LARGE, arguments.seed), 60.0, method="greedy")
        ),
        "count 20": measure_once(lambda: place_count(candidates_of(*LARGE, arguments.seed, slice(1, 2)), 20)),
        "cover .5": measure_once(lambda: cover_share(candidates_of(*LARGE, arguments.seed), 0.5)[0]),
    }
    if arguments.json:
        print(json.dumps(figures, indent=1))
        return
    row = figures["referenced"]
    print(
        f"{errors} errors, {poles} poles, budget {budget:g}: {row['ours_ms']:.0f} CPU-ms, HiGHS alone "
        f"{row['highs_ms']:.0f} ({row['ratio']:.1f} times); bounds differ by {row['difference']:.1e}"
    )
    print(f"{LARGE[0]} errors, {LARGE[1]} poles, all from positions on")
    for name, row in list(figures.items())[1:]:
        print(
            f"{name}: {row['cpu_s']:.2f} CPU-s, weight {row['covered_weight']:.1f}, proven gap {100 * row['gap']:.2f} %"
        )


if __name__ == "__main__":
    main()
