"""The pooled comparison of both rules of placement: which seeds count, and how often."""

from math import comb
from pathlib import Path

import pytest

from flcav.reproductions.pole_rules.run import DENSEST, Study, compare_rules, pool_seeds, read_studies, tabulate_rules
from flcav.runs.recipe import load_run_recipe
from flcav.sources.recipe import recipe_path

REPRODUCTIONS = Path(__file__).parents[3] / "reproductions"
STUDIES = {
    "one": Study("grid", {1: 0.2, 2: 0.1, 3: 0.0, 4: 0.02}),
    "other": Study("grid", {1: -0.1, 2: -0.3, 5: 0.01}),
    "elsewhere": Study("ring", {1: 0.3}),
}


def test_a_seed_that_studies_share_counts_once_by_its_mean() -> None:
    assert pool_seeds(STUDIES) == {
        ("grid", 1): pytest.approx(0.05),
        ("grid", 2): pytest.approx(-0.1),
        ("grid", 3): 0.0,
        ("grid", 4): 0.02,
        ("grid", 5): 0.01,
        ("ring", 1): 0.3,
    }


def test_signs_are_those_of_seeds_with_two_poles_and_both_claims_are_corrected() -> None:
    results = compare_rules(STUDIES, {61: 0.02, 62: 0.03, 63: 0.04}, {})
    assert (results.above, results.below) == (7, 1)
    assert results.sign_p == pytest.approx(2 * (comb(8, 0) + comb(8, 1)) / 2**8)
    assert results.fresh.mean == pytest.approx(0.03)
    own = results.fresh.p_value()
    assert own is not None
    assert own < results.sign_p
    assert results.corrected == pytest.approx((2 * own, max(2 * own, results.sign_p)))
    assert results.verdicts() == ("undecided", "undecided")


def test_the_recipe_differs_in_the_rule_alone_and_claims_that_it_matters() -> None:
    recipe = load_run_recipe(recipe_path("runs/poles"))
    arm = recipe.arms[DENSEST]
    assert (recipe.placement.rule, arm.placement, recipe.primary_claims) == ("vrcsp", {"rule": "densest"}, (DENSEST,))
    assert not any((arm.labels, arm.training, arm.federation))
    assert recipe.placement.count == 1


def test_a_mean_below_nothing_did_not_hold() -> None:
    results = compare_rules({}, {seed: -0.02 - 0.0001 * seed for seed in range(61, 71)}, {})
    assert results.verdicts() == ("did not hold", "did not hold")


def test_committed_studies_are_read_with_the_numbers_of_their_pages() -> None:
    studies = read_studies(REPRODUCTIONS)
    means = {name: sum(own.differences.values()) / len(own.differences) for name, own in studies.items()}
    assert means["distillation, grid"] == pytest.approx(0.019, abs=5e-4)
    assert means["demo_arms, grid"] == pytest.approx(0.011, abs=5e-4)
    assert means["retraining, grid"] == pytest.approx(0.009, abs=5e-4)
    assert means["placement, grid"] == pytest.approx(0.083, abs=5e-4)
    assert means["placement, quarter"] == pytest.approx(-0.010, abs=5e-4)
    assert "| placement, quarter | 8 | 7 | 0 | 1 |" in tabulate_rules(compare_rules(studies, {61: 0.1}, {}))["studies"]
