"""Plans trained apart: which runs are made, what their history is, and how well predictions order what they reached."""

import numpy as np
import pytest
from scipy.stats import spearmanr

from flcav.config import InputError
from flcav.experiments.experiment import check_recipe
from flcav.reproductions.plan_ranking import run as ranking
from flcav.reproductions.plan_ranking.run import (
    PLANS,
    TrainedPlan,
    collect_history,
    list_recipes,
    list_rivals,
    rank_plans,
)
from flcav.runs.recipe import CLOUD, EDGE, PRETRAIN, load_run_recipe
from flcav.sources.recipe import recipe_path

RECIPE = load_run_recipe(recipe_path("runs/plan_ranking"))
PREDICTED = {EDGE: np.array([0.5, 0.6, 0.7, 0.8]), CLOUD: np.array([0.4, 0.5, 0.6, 0.7])}
REACHED = {"1": (0.40, 0.45, 0.62, 0.60), "2": (0.52, 0.50, 0.61, 0.70)}
COSTS = (10.0, 12.0, 40.0, 50.0)


def make_plan(number: int, reached: float) -> TrainedPlan:
    counts = (40, 1 + number, 1)
    stages = {PRETRAIN: 0.3, EDGE: reached + 0.05, CLOUD: reached}
    return TrainedPlan(
        counts, COSTS[number], {stage: {"grid": ap + 0.1, "ring": ap - 0.1} for stage, ap in stages.items()}
    )


SEEDS = {seed: tuple(make_plan(number, ap) for number, ap in enumerate(row)) for seed, row in REACHED.items()}


def test_every_plan_of_every_seed_is_a_run_of_the_same_recipe_but_for_its_counts() -> None:
    recipes = list_recipes(RECIPE, PLANS, [3, 4])
    assert len(recipes) == 2 * 12 == len(set(recipes))
    for name, recipe in recipes.items():
        plan = recipe.tasks["objects"].plan
        assert plan is not None
        assert name == f"seed{recipe.seed}-{plan.samples}-{plan.edge_rounds}-{plan.cloud_rounds}"
        same = recipe.tasks["objects"].model_copy(update={"plan": RECIPE.tasks["objects"].plan})
        assert recipe.model_copy(update={"seed": RECIPE.seed, "tasks": {"objects": same}}) == RECIPE


def test_the_recipe_is_that_of_the_history_but_for_its_frames() -> None:
    planned = load_run_recipe(recipe_path("runs/allocation_tracks"))
    assert planned.tasks["objects"].history == ranking.HISTORY
    assert (RECIPE.training, RECIPE.regions, RECIPE.placement) == (planned.training, planned.regions, planned.placement)


def test_rivals_cost_alike() -> None:
    assert list_rivals(COSTS) == ((0, 1), (2, 3))
    assert list_rivals((10.0, 13.0, 13.1)) == ((0, 1), (1, 2))


def test_orders_are_compared_within_each_seed() -> None:
    results = rank_plans(SEEDS, PREDICTED, {})
    each = [float(np.asarray(spearmanr(PREDICTED[CLOUD], row))[0]) for row in REACHED.values()]
    assert results.claims[ranking.RANKED].mean == pytest.approx(np.mean(each))
    assert results.rivals == ((0, 1), (2, 3))
    assert results.claims[ranking.RIGHT].mean == pytest.approx(0.0)  # one pair of each seed is in the right order
    assert results.of_means == pytest.approx(1.0)
    assert results.plans[2].reached[EDGE].mean == pytest.approx(0.665)
    off = [np.array(row) - PREDICTED[CLOUD] for row in REACHED.values()]
    assert results.gain_error.mean == pytest.approx(np.mean([np.abs(row - row.mean()).mean() for row in off]))


def test_the_history_has_each_network_once() -> None:
    history = collect_history(SEEDS, ["grid"])
    assert history.resources.shape == (2 * (1 + 4 + 4), 3)
    pretrained = (history.resources[:, 1:] == 0).all(axis=1)
    assert np.allclose(history.accuracy[pretrained], 0.4)
    last = (history.resources == (40, 4, 1)).all(axis=1)
    assert history.accuracy[last].tolist() == pytest.approx([0.70, 0.80])
    assert set(history.seeds) == {"1", "2"}
    assert np.allclose(collect_history(SEEDS, ["grid", "ring"]).accuracy, history.accuracy - 0.1)


def test_a_curve_is_finite_and_rises_with_rounds() -> None:
    predicted = ranking.predict(PLANS)
    assert predicted[EDGE].shape == predicted[CLOUD].shape == (12,)
    for samples in range(3):
        after = predicted[EDGE][4 * samples : 4 * samples + 4]
        assert (np.diff(after) > 0).all()


def test_results_of_another_recipe_are_refused_by_name() -> None:
    held = RECIPE.model_dump(mode="json", exclude={"seed"}) | {"budgets_mb": {"wireless": 1.0, "wireline": 1.0}}
    with pytest.raises(InputError, match=r"of another recipe than recipes/runs/plan_ranking\.yaml"):
        check_recipe({"recipe": held}, "plan_ranking", "result.json")
