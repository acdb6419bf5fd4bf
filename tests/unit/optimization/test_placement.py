"""Placement against every subset of the poles."""

from itertools import combinations

import numpy as np
import pytest

from flcav.config import InputError
from flcav.optimization.placement.solve import coverage, place


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
