"""Placements of decimals against every choice in fractions: what fits, what is covered, and what is claimed of it."""

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from fractions import Fraction
from itertools import product

import numpy as np
import pytest

from flcav.config import InputError
from flcav.optimization.placement import cheapest, solve
from flcav.optimization.placement.cheapest import cover_share
from flcav.optimization.placement.instance import find_covered
from flcav.optimization.placement.place import place
from flcav.optimization.placement.solve import Candidates, Placement, find_candidates, place_budget, place_count
from flcav.optimization.verification.placement import PlacementProblem, verify_placement

Pairs = list[tuple[int, int]]


def exact(number: float) -> Fraction:
    return Fraction(repr(float(number)))


DRAWS: tuple[Callable[[np.random.Generator, int], np.ndarray], ...] = (
    lambda rng, n: rng.choice([1e9, 1.0], n),
    lambda rng, n: 10.0 ** rng.integers(-9, 10, n),
    lambda rng, n: np.round(rng.uniform(0.01, 1, n), int(rng.integers(1, 5))),
    lambda rng, n: rng.uniform(0.1, 2, n),
    lambda rng, n: rng.choice([0.1, 0.2, 0.3, 1e-7], n),
    lambda rng, n: np.exp(rng.uniform(-20, 20, n)),
    lambda _, n: np.ones(n),
)


def draw(rng: np.random.Generator, count: int) -> np.ndarray:
    values = DRAWS[rng.integers(len(DRAWS))](rng, count)
    return np.where(rng.random(count) < 0.3, 0.0, values) if rng.random() < 0.3 else values


class Drawn:
    """A drawn problem, with the exact cost and covered weight of every choice of no or one sensor on each pole."""

    def __init__(self, seed: int) -> None:
        self.rng = rng = np.random.default_rng(seed)
        poles, errors, kinds = (int(rng.integers(least, end)) for least, end in ((2, 6), (2, 14), (1, 4)))
        self.errors = np.c_[rng.integers(0, 100, (errors, 2)), np.ones(errors)].astype(float)
        self.poles = np.c_[rng.integers(0, 100, (poles, 2)), np.full(poles, 6)].astype(float)
        self.ranges = rng.choice([20.0, 30.0, 45.0, 60.0], kinds, replace=False)
        weight = draw(rng, errors)
        self.weight = weight if weight.any() else np.ones(errors)
        of_pole, of_sensor = draw(rng, poles), draw(rng, kinds)
        squared = ((self.errors[None] - self.poles[:, None]) ** 2).sum(axis=2)  # whole numbers
        self.within = squared[:, None] <= self.ranges[:, None] ** 2
        self.cost = np.array([[exact(a) + exact(b) for b in of_sensor] for a in of_pole], dtype=object)
        self.candidates = find_candidates(
            self.errors, self.poles, self.ranges, weight=self.weight, pole_cost=of_pole, sensor_cost=of_sensor
        )
        chosen = [
            [(pole, kind) for pole, kind in enumerate(each) if kind >= 0]
            for each in product(range(-1, kinds), repeat=poles)
        ]
        self.choices = [(self.cost_of(on), self.worth_of(on), len(on)) for on in chosen]

    def cost_of(self, on: Pairs) -> Fraction:
        return sum((self.cost[each] for each in on), Fraction(0))

    def worth_of(self, on: Pairs) -> Fraction:
        covered = np.any([self.within[each] for each in on], axis=0) if on else np.zeros(len(self.weight), bool)
        return sum(map(exact, self.weight[covered]), Fraction(0))

    def check(self, placed: Placement, best: Fraction, **limit: float) -> Pairs:
        """Check a placement of most weight, and return its pairs of pole and sensor."""
        on = list(zip(placed.chosen, placed.sensors, strict=True))
        worth = self.worth_of(on)
        assert placed.covered_weight == float(worth) <= float(best) <= placed.upper_bound
        assert placed.certificate is not None
        assert placed.certificate.bound >= float(best)
        assert worth == best or not placed.optimal
        asked = PlacementProblem(self.errors, self.weight, self.poles, self.ranges, self.cost, **limit)  # pyright: ignore[reportArgumentType]
        assert not verify_placement(asked, json.dumps(asdict(placed))).faults
        return on


@pytest.fixture(params=["small", "large"])
def size(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.param == "large":
        monkeypatch.setattr(solve, "WHOLE", 0)
        monkeypatch.setattr(cheapest, "WHOLE", 0)


@pytest.mark.usefixtures("size")
@pytest.mark.parametrize("seed", range(12))
def test_placements_within_limits_are_the_best_of_every_choice_exactly(seed: int) -> None:
    drawn = Drawn(seed)
    costs = sorted({cost for cost, _, count in drawn.choices if count})
    budgets = [float(costs[k]) for k in drawn.rng.integers(len(costs), size=2)] + [round(0.6 * float(costs[-1]), 3)]
    for budget in budgets:
        best = max(worth for cost, worth, _ in drawn.choices if cost <= exact(budget))
        if costs[0] > exact(budget):
            with pytest.raises(InputError, match="the cheapest sensor on a pole costs"):
                place_budget(drawn.candidates, budget)
            continue
        exactly = place_budget(drawn.candidates, budget)
        assert exactly.optimal
        for placed in (exactly, place_budget(drawn.candidates, budget, method="greedy")):
            assert drawn.cost_of(drawn.check(placed, best, budget=budget)) <= exact(budget)
    count = int(drawn.rng.integers(1, len(drawn.poles) + 1))
    placed = place_count(drawn.candidates, count)
    assert placed.optimal
    best = max(worth for _, worth, number in drawn.choices if number <= count)
    assert len(drawn.check(placed, best, count=count)) == count


@pytest.mark.slow
@pytest.mark.usefixtures("size")
@pytest.mark.parametrize("seed", range(12))
def test_shares_are_covered_at_the_least_cost_of_every_choice_exactly(seed: int) -> None:
    drawn = Drawn(seed)
    total = sum(map(exact, drawn.weight), Fraction(0))
    worths = sorted({float(worth / total) for _, worth, _ in drawn.choices if worth}) or [1.0]
    for share in (worths[drawn.rng.integers(len(worths))], 0.7, 1.0):
        target = exact(share) * total
        enough = [cost for cost, worth, _ in drawn.choices if worth >= target]
        if not enough:
            with pytest.raises(InputError, match="together cover only"):
                cover_share(drawn.candidates, share)
            continue
        placed, least = cover_share(drawn.candidates, share)
        on = list(zip(placed.chosen, placed.sensors, strict=True))
        assert drawn.worth_of(on) >= target
        assert (drawn.cost_of(on), placed.optimal) == (min(enough), True)
        assert least <= float(min(enough))
        greedy, below = cover_share(drawn.candidates, share, method="greedy")
        assert drawn.worth_of(list(zip(greedy.chosen, greedy.sensors, strict=True))) >= target
        assert below <= float(min(enough))


def apart(costs: list[float]) -> tuple[list[list[float]], list[list[float]], list[float]]:
    """Return an error below each of as many poles, 100 m apart, and what the poles cost."""
    return [[100.0 * k, 0, 1] for k in range(len(costs))], [[100.0 * k, 0, 6] for k in range(len(costs))], costs


@pytest.mark.parametrize("method", ["exact", "greedy"])
@pytest.mark.parametrize(
    ("costs", "budget", "covered"),
    [
        ([0.1, 0.2, 0.3], 0.6, 3),  # .1 + .2 + .3 of floats is more than .6
        ([0.1, 0.2, 0.3, 1e-9], 0.6, 3),
        ([0.1, 0.2, 0.3, 1e-7], 0.6, 3),
        ([0.1] * 10, 1.0, 10),
        ([1e9, 1.0], 1e9, 1),
        ([1e9, 1e-9], 1e9, 1),
        ([0.0, 0.0, 1e-9], 0.0, 2),
    ],
)
def test_a_budget_is_what_decimals_sum_to(
    costs: list[float], budget: float, covered: int, method: solve.Method
) -> None:
    errors, poles, pole_cost = apart(costs)
    placed = place(errors, poles, 20, budget=budget, pole_cost=pole_cost, method=method)
    assert placed.covered == covered
    assert sum(exact(costs[pole]) for pole in placed.chosen) <= exact(budget)


def test_a_light_error_beside_heavy_ones_is_not_lost() -> None:
    errors, poles = [[0.0, 0, 1], [100, 0, 1], [100, 0, 1]], [[0.0, 0, 6], [100, 0, 6]]
    for light in (1.0, 1e-3, 1e-9):
        placed = place(errors, poles, 20, 1, weight=[1e9, 1e9, light])
        assert (placed.chosen, placed.optimal) == ((1,), True)


def test_all_errors_are_not_covered_where_a_light_one_is_not() -> None:
    with pytest.raises(InputError, match=r"together cover only a weight of 1000000000 of 1000000000\.1 of the errors"):
        place([[0, 0, 1], [900, 0, 1]], [[0, 0, 6], [100, 0, 6]], 20, cover=1.0, weight=[1e9, 0.1])


def tampered(costs: list[float], budget: float, **change: object) -> tuple[str, ...]:
    """Return the faults of the placement of all poles, as if it were within the budget."""
    errors, poles, pole_cost = apart(costs)
    placed = place(errors, poles, 20, budget=float(sum(map(exact, costs))), pole_cost=pole_cost)
    worth, ranges = np.ones(len(costs)), np.array([20.0])
    asked = PlacementProblem(
        np.array(errors, float), worth, np.array(poles, float), ranges, np.array(pole_cost)[:, None], budget=budget
    )
    return verify_placement(asked, json.dumps(asdict(replace(placed, **change)))).faults  # pyright: ignore[reportArgumentType]


def test_the_verifier_finds_what_is_beyond_a_budget_and_below_a_sum() -> None:
    assert tampered([0.1, 0.2, 0.3], 0.6) == ()
    assert "the limit" in tampered([0.1, 0.2, 0.3, 1e-7], 0.6)
    assert "the limit" in tampered([1e9, 1.0], 1e9)
    assert "the errors covered" in tampered([0.1, 0.2], 0.3, covered_weight=2 + 1e-9)
    assert "the upper bound" in tampered([0.1, 0.2], 0.3, upper_bound=2 - 1e-9)
    assert "whether it is optimal" in tampered([0.1, 0.2], 0.3, upper_bound=2 + 1e-9)


def test_an_error_at_a_range_of_decimals_is_covered() -> None:
    sites = np.array([[1.0, 0, 0], [1e6, 0, 0]])
    errors = np.array([[1.1, 0, 0], [1.1000001, 0, 0], [1000000.1, 0, 0]])  # 1.1 - 1 of floats is more than .1
    assert find_covered(errors, sites, [0.1]).toarray().tolist() == [[1, 0, 0], [0, 0, 1]]


def test_nothing_that_covers_anything_fits() -> None:
    candidates: Candidates = find_candidates([[0, 0, 1]], [[0, 0, 6], [500, 0, 6]], [20.0], pole_cost=[5, 1])
    placed = place_budget(candidates, 1.0)
    assert (placed.chosen, placed.covered, placed.optimal) == ((), 0, True)
