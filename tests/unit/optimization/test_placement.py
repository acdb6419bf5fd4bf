"""Placement against every subset of the poles."""

from itertools import combinations, product
from math import comb

import numpy as np
import pytest

from flcav.config import InputError
from flcav.optimization.placement import cheapest, solve
from flcav.optimization.placement.baselines import place_at_random, place_by_score
from flcav.optimization.placement.cheapest import cover_share
from flcav.optimization.placement.place import find_seen, place
from flcav.optimization.placement.solve import Candidates, coverage, find_candidates, place_budget, place_count
from flcav.world.map.town import load_town


def drawn(seed: int):
    rng = np.random.default_rng(seed)
    errors, poles = rng.uniform(0, 100, (60, 3)) * [1, 1, 0.1], rng.uniform(0, 100, (9, 3)) * [1, 1, 0.1]
    return errors, poles, rng.uniform(0.1, 2, 60)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("count", [1, 2, 4])
def test_exact_is_the_best_of_all_subsets_and_greedy_within_its_guarantee(seed, count):
    errors, poles, weight = drawn(seed)
    within = np.linalg.norm(errors[None] - poles[:, None], axis=2) <= 30
    best = max(weight[within[list(chosen)].any(axis=0)].sum() for chosen in combinations(range(9), count))
    exact = place(errors, poles, 30, count, weight=weight)
    greedy = place(errors, poles, 30, count, weight=weight, method="greedy")
    assert exact.optimal
    assert exact.covered_weight == pytest.approx(best, rel=1e-9)
    assert exact.upper_bound == pytest.approx(best, rel=1e-9)
    assert (1 - 1 / np.e) * best <= greedy.covered_weight <= best + 1e-9
    assert greedy.upper_bound >= best - 1e-9
    for found in (exact, greedy):
        reached = within[list(found.chosen)].any(axis=0)
        assert found.covered == reached.sum()
        assert found.covered_weight == pytest.approx(weight[reached].sum())
        assert len(set(found.chosen)) == count


def test_coverage_is_a_ball_with_its_surface():
    errors = [[3.0, 4.0, 0.0], [3.0, 4.0, 0.1], [0.0, 0.0, 5.0]]
    assert coverage(errors, [[0.0, 0.0, 0.0]], 5.0).tolist() == [[True, False, True]]


def test_ties_go_to_the_earlier_pole():
    poles = np.zeros((5, 3))
    assert place([[1.0, 0, 0]], poles, 2.0, 2).chosen == (0, 1)
    assert place([[1.0, 0, 0]], poles, 2.0, 2, method="greedy").chosen == (0, 1)


def test_nothing_within_range_covers_nothing():
    found = place([[100.0, 0, 0]], np.zeros((3, 3)), 2.0, 2)
    assert (found.chosen, found.covered, found.covered_weight, found.optimal) == ((0, 1), 0, 0.0, True)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"errors": np.zeros((0, 3))}, "errors"),
        ({"errors": [[0.0, np.nan, 0.0]]}, "errors: row 1"),
        ({"poles": np.zeros((3, 2))}, "poles"),
        ({"range_m": -5.0}, "range"),
        ({"count": 4}, "count = 4"),
        ({"count": 0}, "count = 0"),
        ({"weight": [-1.0]}, "weight"),
        ({"method": "magic"}, "magic"),
    ],
)
def test_bad_input_is_one_sentence(change, named):
    arguments = {"errors": np.zeros((1, 3)), "poles": np.zeros((3, 3)), "range_m": 5.0, "count": 1} | change
    with pytest.raises(InputError, match=named):
        place(**arguments)


RANGES = np.array([45.0, 18.0, 30.0])  # not in their order
SENSOR_COST = np.array([4.0, 1.0, 2.1])


def priced(seed: int, poles: int = 5) -> tuple[Candidates, np.ndarray, np.ndarray]:
    """Return candidates, whether each error is within each sensor's range of each pole (P, S, E), and costs (P, S)."""
    rng = np.random.default_rng(seed)
    errors, sites = rng.uniform(0, 100, (60, 3)) * [1, 1, 0.1], rng.uniform(0, 100, (poles, 3)) * [1, 1, 0.1]
    weight, of_pole = rng.uniform(0.1, 2, 60), rng.uniform(0.5, 1.5, poles)
    within = np.linalg.norm(errors[None] - sites[:, None], axis=2)[:, None] <= RANGES[:, None]
    candidates = find_candidates(errors, sites, RANGES, weight=weight, pole_cost=of_pole, sensor_cost=SENSOR_COST)
    return candidates, within, of_pole[:, None] + SENSOR_COST


def every_choice(candidates: Candidates, within: np.ndarray, cost: np.ndarray) -> np.ndarray:
    """Return cost and covered weight (C, 2) of every choice of no or one sensor on each pole."""
    found = []
    for kinds in product(range(-1, 3), repeat=len(cost)):
        on = [(pole, kind) for pole, kind in enumerate(kinds) if kind >= 0]
        reached = np.any([within[each] for each in on], axis=0) if on else np.zeros(within.shape[2], bool)
        found.append((sum(cost[each] for each in on), candidates.weight[reached].sum()))
    return np.array(found)


@pytest.fixture(params=["small", "large"])
def size(request, monkeypatch):
    """Solved as a small instance is, or as a large one: by its dual, fixing, and the program of what remains."""
    if request.param == "large":
        monkeypatch.setattr(solve, "WHOLE", 0)
        monkeypatch.setattr(cheapest, "WHOLE", 0)


@pytest.mark.usefixtures("size")
@pytest.mark.parametrize("seed", range(2))
def test_a_budget_buys_the_best_of_all_choices(seed):
    candidates, within, cost = priced(seed)
    choices = every_choice(candidates, within, cost)
    for budget in (2.7, 6.0, 11.0):
        best = choices[choices[:, 0] <= budget, 1].max()
        exact = place_budget(candidates, budget)
        greedy = place_budget(candidates, budget, method="greedy")
        assert exact.optimal
        assert exact.covered_weight == pytest.approx(best, rel=1e-9)
        assert (1 - 1 / np.e) / 2 * best <= greedy.covered_weight <= best + 1e-9
        assert greedy.upper_bound >= best - 1e-9
        for found in (exact, greedy):
            on = list(zip(found.chosen, found.sensors, strict=True))
            assert len({pole for pole, _ in on}) == len(on)
            assert found.cost == pytest.approx(sum(cost[each] for each in on))
            assert found.cost <= budget + 1e-9
            seen = np.sum([within[each] for each in on], axis=0)
            assert found.covered_weight == pytest.approx(candidates.weight[seen > 0].sum())
            alone = [candidates.weight[within[each] & (seen == 1)].sum() for each in on]
            assert found.marginal_gain == pytest.approx(alone)


@pytest.mark.usefixtures("size")
@pytest.mark.parametrize("seed", range(2))
def test_a_share_is_covered_by_the_cheapest_of_all_choices(seed):
    candidates, within, cost = priced(seed)
    choices = every_choice(candidates, within, cost)
    for share in (0.2, 0.5, 0.65):
        enough = choices[:, 1] >= share * candidates.weight.sum()
        if not enough.any():
            with pytest.raises(InputError, match="together cover only"):
                cover_share(candidates, share)
            continue
        least = choices[enough, 0].min()
        found, bound = cover_share(candidates, share)
        assert found.optimal
        assert found.cost == pytest.approx(least)
        assert bound == pytest.approx(least)
        assert found.covered_weight >= share * candidates.weight.sum() * (1 - 1e-8)
        assert found.upper_bound >= choices[choices[:, 0] <= found.cost + 1e-9, 1].max() - 1e-9
        greedy, below = cover_share(candidates, share, method="greedy")
        assert 0.3 * least < below - 1e-9 <= least <= greedy.cost + 1e-9


@pytest.mark.usefixtures("size")
def test_a_count_takes_the_best_sensors_whatever_they_cost():
    candidates, within, _ = priced(7)
    best = max(candidates.weight[within[list(poles)].any(axis=(0, 1))].sum() for poles in combinations(range(5), 2))
    found = place_count(candidates, 2)
    assert (found.covered_weight, found.optimal) == (pytest.approx(best), True)


def test_random_placements_cover_what_their_expectation_says():
    errors, poles, weight = drawn(1)
    candidates = find_candidates(errors, poles, [30.0], weight=weight).at_unit_cost()
    times = coverage(errors, poles, 30).sum(axis=0)
    chance = 1 - np.array([comb(9 - int(near), 3) for near in times]) / comb(9, 3)
    found = place_at_random(candidates, 3.0, draws=2000)
    assert found.covered == pytest.approx(chance.sum(), rel=0.02)
    assert found.covered_weight == pytest.approx(chance @ weight, rel=0.02)


def test_conventional_placement_takes_the_best_scores_that_fit():
    candidates, within, cost = priced(3)
    score = np.zeros((5, 3))
    score[1, 2], score[1, 1], score[4, 0] = 9.0, 8.0, 1.0  # (pole, sensor by range)
    by_count = place_by_score(candidates.at_unit_cost(), score.ravel(), 2.0)
    assert (by_count.chosen, by_count.sensors) == ((1, 4), (0, 1))
    by_cost = place_by_score(candidates, score.ravel(), cost[1, 2] + cost[4, 1])
    assert (by_cost.chosen, by_cost.sensors) == ((1, 4), (2, 1))
    assert by_cost.covered == (within[1, 2] | within[4, 1]).sum()


def test_place_takes_kinds_of_sensors_budgets_shares_and_towns():
    town, rng = load_town("grid"), np.random.default_rng(3)
    poles = town.poles.position
    errors = poles[rng.integers(len(poles), size=40)] + np.c_[rng.normal(0, 25, (40, 2)), np.full(40, -4.0)]
    costs, ranges = rng.uniform(1, 3, len(poles)), [20.0, 60.0]
    priced = find_candidates(errors, poles, ranges, sensor_cost=[2, 5], pole_cost=costs)
    found = place(errors, poles, ranges, budget=20, sensor_cost=[2, 5], pole_cost=costs)
    assert found == place_budget(priced, 20)
    assert found.cost <= 20
    assert place(errors, poles, ranges, cover=0.5, sensor_cost=[2, 5], pole_cost=costs) == cover_share(priced, 0.5)[0]
    assert place(errors, poles, 60.0, 2) == place_count(find_candidates(errors, poles, [60.0]), 2)
    seen = place(errors, poles, 60.0, 2, town=town)
    visible = find_seen(errors, poles, 60.0, town, ())
    assert seen == place_count(find_candidates(errors, poles, [60.0], visible=visible), 2)
    assert seen.covered < place(errors, poles, 60.0, 2).covered
    for wrong in ({}, {"count": 1, "budget": 5.0}):
        with pytest.raises(InputError, match="one of count, budget and cover is wanted"):
            place(errors, poles, 60.0, **wrong)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"range_m": [], "count": 1}, "one kind at least"),
        ({"range_m": [40, 120], "sensor_cost": [1], "budget": 5}, "sensors: 2 costs are wanted, and there are 1"),
        ({"range_m": 40, "pole_cost": [1, 2], "budget": 5}, "poles: 1 costs are wanted, and there are 2"),
        ({"range_m": 40, "budget": 5}, "nothing has a cost"),
        ({"range_m": 40, "count": 1, "traces": [None]}, "traffic is in the way where the town"),
        ({"range_m": 40, "count": 1, "town": "atlantis"}, "unknown town 'atlantis'"),
        ({"range_m": 40, "count": 1, "town": "grid"}, "poles: row 1 lies at 9000, 9000, outside grid"),
    ],
)
def test_place_refuses_in_a_sentence_what_goes_together_with_nothing(given, said):
    with pytest.raises(InputError, match=said):
        place([[1e3, 1e3, 1]], [[9e3, 9e3, 3]], **given)


def test_place_refuses_errors_that_lie_on_no_map_of_the_town():
    with pytest.raises(InputError, match="errors: row 2 lies at 1000000, 0, far from grid"):
        place([[0, 0, 1], [1e6, 0, 1]], load_town("grid").poles.position, 40, 1, town="grid")


def test_place_takes_the_name_of_a_town():
    poles = load_town("grid").poles.position
    assert place(poles - [0, 0, 4], poles, 40.0, 2, town="grid") == place(
        poles - [0, 0, 4], poles, 40.0, 2, town=load_town("grid")
    )
