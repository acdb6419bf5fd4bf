"""Additive curves whose first cloud round costs accuracy: planted curves, and plans against trying every plan."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_problems import LIMITS, SMALL, parsed, searched, written

from flcav.config import InputError
from flcav.optimization.allocation.allocate import allocate
from flcav.optimization.allocation.baselines import BASELINES, baseline
from flcav.optimization.allocation.replanning import PlanState, condition_problem
from flcav.optimization.curves.bands import bootstrap_bands, fit_upper_curve
from flcav.optimization.curves.curves import Additive
from flcav.optimization.curves.fitting import fit_additive
from flcav.optimization.solvers.branches import MOST_BRANCHING
from flcav.optimization.solvers.instance import Infeasible

DECAYS = {
    "pretrain": {"a": 2.0, "b": 0.5},
    "edge": {"a": 0.3, "b": 0.4, "x0": 1.0},
    "cloud": {"a": 0.1, "b": 1.0, "x0": 1.0},
}


def planted(**values: Any) -> Additive:
    return Additive.model_validate({**DECAYS, **values})


def measured(curve: Additive, noise: float, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Return samples, rounds and accuracies of four runs, each with edge rounds and then cloud rounds."""
    grid = [(x, *rounds) for x in (40, 160, 640, 2560) for rounds in [(y, 0) for y in range(7)]]
    grid += [(x, 6, z) for x in (40, 160, 640, 2560) for z in range(1, 6)]
    x, y, z = np.array(grid, dtype=float).T
    error = 2.0 * x**-0.5 + 0.3 * (y + 1) ** -0.4 + 0.1 / (z + 1) + curve.merge * (z >= 1)
    return x, y, z, 1 - error - noise * np.random.default_rng(seed).normal(0, 1, len(grid))


def test_the_first_cloud_round_costs_and_later_ones_cost_no_more() -> None:
    with_cost, without = planted(merge=0.07), planted()
    z = np.arange(5)
    np.testing.assert_allclose(with_cost.error(40, 2, z) - without.error(40, 2, z), [0, 0.07, 0.07, 0.07, 0.07])
    assert str(with_cost).endswith(" + 0.07 [z > 0]")


@pytest.mark.parametrize("merge", [0.0, 0.06])
def test_a_planted_cost_is_recovered_and_none_is_found_where_there_is_none(merge: float) -> None:
    found = fit_additive(*measured(planted(merge=merge), 1e-4)).curve
    assert found.merge == pytest.approx(merge, abs=2e-3)
    after = [float(found.error(160, 6, z)) for z in (0, 1, 5)]
    assert after == pytest.approx([float(planted(merge=merge).error(160, 6, z)) for z in (0, 1, 5)], abs=1e-3)


def test_a_cost_is_not_fitted_to_a_single_cloud_round() -> None:
    x, y, z, accuracy = measured(planted(merge=0.06), 1e-4)
    kept = z <= 1
    assert fit_additive(x[kept], y[kept], z[kept], accuracy[kept]).curve.merge == 0


def test_bands_and_the_upper_curve_have_the_cost() -> None:
    curve = planted(merge=0.06)
    found = fit_additive(*measured(curve, 0.003))
    band = bootstrap_bands(found, repeats=20)
    assert band is not None
    asked = np.array([[160.0, 6.0, 0.0], [160.0, 6.0, 1.0], [160.0, 6.0, 5.0]])
    low, high = band.between(asked)
    truth = curve.error(*asked.T)
    assert np.all((low - 0.005 <= truth) & (truth <= high + 0.005))
    upper = fit_upper_curve(found, band)
    assert isinstance(upper, Additive)
    assert upper.merge > 0
    assert np.all(upper.error(*asked.T) >= high - 1e-9)


def costly(seed: int, tasks: int, model: str, *args: Any) -> dict[str, Any]:
    """Return a problem as a user writes it, in which every other task's first cloud round costs accuracy."""
    values: dict[str, Any] = written(seed, tasks, model, *args)
    rng = np.random.default_rng(seed)
    for task in values["tasks"][::2]:
        members = task["curve"].get("members")
        for curve in [member["curve"] for member in members] if members else [task["curve"]]:
            curve["merge"] = rng.uniform(0, 0.2)
    return values


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    tasks=st.integers(1, 3),
    model=st.sampled_from(("additive", "shared")),
    objective=st.sampled_from(("weighted", "max-min")),
    budget=st.floats(60, 600),
    k=st.integers(0, 2),
)
def test_plans_are_the_best_of_all_and_bounds_never_above(
    seed: int, tasks: int, model: str, objective: str, budget: float, k: int
) -> None:
    values = costly(seed, tasks, model, SMALL, budget, k) | {"objective": objective}
    best, plan = searched(values), allocate(parsed(values))
    assert plan.lower_bound is not None
    assert plan.lower_bound <= best * (1 + 1e-9)
    assert plan.objective == pytest.approx(best, rel=1e-8)
    assert plan.status == "optimal"


def test_cloud_rounds_are_bought_where_they_win_the_cost_back() -> None:
    def cloud_rounds(merge: float) -> int:
        values = written(3, 1, "additive", SMALL, 4000.0)
        values["tasks"][0]["curve"]["merge"] = merge
        return allocate(parsed(values)).tasks[0].cloud_rounds

    assert cloud_rounds(0.0) == cloud_rounds(1e-3) == 3
    assert cloud_rounds(1.0) == 0


@pytest.mark.parametrize("seed", range(4))
def test_baselines_are_no_better_than_the_plan_and_know_the_cost(seed: int) -> None:
    values = costly(seed, 2, "additive", SMALL, 300.0)
    plan = allocate(parsed(values))
    for name in BASELINES:
        found = baseline(parsed(values), name)
        assert found.objective >= plan.objective * (1 - 1e-9)
    dear = costly(seed, 2, "additive", SMALL, 300.0)
    for task in dear["tasks"]:
        task["curve"]["merge"] = 5.0
    for name in ("equal-stages", "equal-tasks", "article"):
        assert all(task.cloud_rounds == 0 for task in baseline(parsed(dear), name).tasks)


def test_the_area_is_that_of_the_better_branch() -> None:
    values: dict[str, Any] = written(5, 3, "additive", SMALL, 200.0) | {"objective": "area"}
    free = allocate(parsed(values)).objective
    for task in values["tasks"]:
        task["curve"]["merge"] = 0.5
    assert 0 < allocate(parsed(values)).objective <= free


def test_limits_decide_where_only_one_branch_is_left() -> None:
    values = costly(1, 1, "additive", SMALL, 600.0)
    values["tasks"][0]["curve"]["merge"] = 0.3
    values["tasks"][0]["limits"] = SMALL | {"cloud_rounds": [1, 3]}
    plan = allocate(parsed(values))
    assert plan.tasks[0].cloud_rounds >= 1
    assert plan.objective == pytest.approx(searched(values), rel=1e-9)
    values["budgets_mb"] = {"wireless": 1e-3, "wireline": 1e-3}
    with pytest.raises(Infeasible, match="the least that the limits allow"):
        allocate(parsed(values))


def test_too_many_such_tasks_are_refused() -> None:
    values = written(1, MOST_BRANCHING + 1, "additive", LIMITS)
    for task in values["tasks"]:
        task["curve"]["merge"] = 0.1
    with pytest.raises(InputError, match=f"in {MOST_BRANCHING + 1} tasks that may do without it: at most"):
        allocate(parsed(values))


def test_replanning_scales_the_cost_with_the_curve() -> None:
    values = written(2, 1, "additive", SMALL, 900.0)
    values["tasks"][0]["curve"]["merge"] = 0.1
    asked = parsed(values)
    state = PlanState.model_validate({"tasks": {"t0": {"samples": 4, "edge_rounds": 2, "accuracy": 0.4}}})
    left = condition_problem(asked, state).tasks[0].curve
    factor = 0.6 / float(asked.tasks[0].curve.error(4, 2, 0))
    assert float(left.error(4, 2, 0)) == pytest.approx(0.6)
    assert float(left.error(4, 2, 2)) == pytest.approx(factor * float(asked.tasks[0].curve.error(4, 2, 2)))
