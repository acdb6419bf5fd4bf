"""Curves whose cloud rounds bring other regions' samples, or cost accuracy: brute force and planted curves."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_problems import SMALL, parsed, searched, written
from test_fleet import best_carried, fleet, problem

from flcav.config import InputError
from flcav.optimization.allocation.allocate import allocate
from flcav.optimization.allocation.budget_sweep import compute_savings
from flcav.optimization.allocation.fleet import allocate_fleet
from flcav.optimization.allocation.replanning import PlanState, condition_problem
from flcav.optimization.curves.bands import bootstrap_bands, fit_upper_curve
from flcav.optimization.curves.curves import Federated
from flcav.optimization.curves.fitting import fit, fit_federated
from flcav.optimization.curves.history import History
from flcav.optimization.solvers import rounds

PLANTED = {"floor": 0.0, "a": 1.2, "b": 0.4, "alpha": 0.1, "beta": 0.3, "group_samples": (600.0, 200.0, 400.0)}


def planted(**values: Any) -> Federated:
    return Federated.model_validate({"model": "federated"} | PLANTED | values)


def by_hand(curve: Federated, x: np.ndarray, y: np.ndarray, z: np.ndarray, k: int) -> np.ndarray:
    """Return the error (n,) by the formula written out for each point."""
    total, regions = sum(curve.group_samples), len(curve.group_samples)
    errors = []
    for samples, edge, cloud in zip(x, y, z):
        t = edge + k * cloud
        own = total / regions * t / (t + 1)
        others = curve.gamma * total * (regions - 1) / regions * cloud / (cloud + 1)
        drift = curve.drift * cloud / (cloud + 1) if curve.drift > 0 else -curve.drift / (cloud + 1)
        errors.append(curve.floor + curve.a * (curve.alpha * samples + curve.beta * (own + others)) ** -curve.b + drift)
    return np.array(errors)


def measured(curve: Federated, noise: float, k: int = 2, seed: int = 0) -> dict[str, Any]:
    """Return a history of the curve, of three pretrainings, each with edge rounds and then cloud rounds."""
    grid = [(x, y, 0) for x in (80, 320, 1280) for y in range(9)]
    grid += [(x, y, z) for x in (80, 320, 1280) for y in (2, 8) for z in range(1, 7)]
    x, y, z = np.array(grid, dtype=float).T
    error = by_hand(curve, x, y, z, k) + noise * np.random.default_rng(seed).normal(0, 1, len(grid))
    return {"samples": x, "edge_rounds": y, "cloud_rounds": z, "accuracy": 1 - error}


@pytest.mark.parametrize("drift", [-0.05, 0.0, 0.05])
@pytest.mark.parametrize("k", [0, 1, 3])
def test_the_error_is_that_of_the_formula(drift: float, k: int) -> None:
    curve = planted(floor=0.02, gamma=0.7, drift=drift)
    x, y, z = (grid.ravel() for grid in np.meshgrid([10.0, 900.0], [0.0, 4.0], [0.0, 1.0, 5.0]))
    np.testing.assert_allclose(curve.error(x, y, z, k), by_hand(curve, x, y, z, k), rtol=1e-12)


def test_the_drift_is_the_change_by_endless_cloud_rounds_and_the_floor_is_never_passed() -> None:
    for drift in (-0.03, 0.04):
        curve = planted(drift=drift, beta=0.0, floor=0.01)
        before, after = (float(curve.error(1e6, 0, z)) for z in (0, 10**8))
        assert after - before == pytest.approx(drift, abs=1e-8)
        assert min(before, after) >= 0.01


@pytest.mark.parametrize("gamma", [0.0, 0.8])
@pytest.mark.parametrize("drift", [-0.04, 0.0, 0.04])
def test_a_planted_curve_is_recovered_and_its_form_is_chosen(gamma: float, drift: float) -> None:
    curve = planted(gamma=gamma, drift=drift)
    found = fit_federated(**measured(curve, 1e-5), group_samples=curve.group_samples, k=2).curve
    assert (found.a, found.b) == pytest.approx((1.2, 0.4), rel=0.02)
    assert found.beta == pytest.approx(0.3, rel=0.02)
    assert found.gamma == pytest.approx(gamma, abs=0.02)
    assert found.drift == pytest.approx(drift, abs=1e-3)
    assert (found.gamma == 0, found.drift == 0, found.floor == 0) == (gamma == 0, drift == 0, True)


def test_the_plain_form_is_chosen_for_most_noisy_histories_of_one() -> None:
    """AICc adds a needless parameter in a minority of histories: P(chi^2 > 2) = .16 for each of three."""
    curve = planted()
    kept = 0
    for seed in range(12):
        found = fit_federated(**measured(curve, 0.01, seed=seed), group_samples=curve.group_samples, k=2).curve
        kept += found.drift == 0
        assert abs(found.drift) < 0.03
    assert kept >= 7


def test_bands_and_the_upper_curve_are_of_the_same_form() -> None:
    curve = planted(gamma=0.8, drift=0.03)
    found = fit_federated(**measured(curve, 0.005), group_samples=curve.group_samples, k=2)
    band = bootstrap_bands(found, repeats=20, k=2)
    assert band is not None
    asked = np.array([[320.0, 4.0, 2.0], [320.0, 8.0, 6.0]])
    low, high = band.between(asked)
    truth = curve.error(*asked.T, k=2)
    assert np.all((low - 0.01 <= truth) & (truth <= high + 0.01))
    upper = fit_upper_curve(found, band)
    assert isinstance(upper, Federated)
    assert np.all(upper.error(*asked.T, k=2) >= high - 1e-3)


def test_what_the_history_cannot_tell_is_refused() -> None:
    told = measured(planted(), 0.0)
    points = History(np.stack([told[name] for name in ("samples", "edge_rounds", "cloud_rounds")], axis=1),
                     told["accuracy"], np.ones(len(told["accuracy"])))  # fmt: skip
    for held in (0.0, 700.0, (700.0,), (0.0, 0.0)):
        with pytest.raises(InputError, match="--group-samples of each region"):
            fit(points, model="federated", group_samples=held)
    edge = points.resources[:, 2] == 0
    never = History(points.resources[edge], points.accuracy[edge], points.weight[edge])
    with pytest.raises(InputError, match="cloud rounds of the history never vary"):
        fit(never, model="federated", group_samples=(700, 700))


@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    tasks=st.integers(1, 3),
    objective=st.sampled_from(("weighted", "max-min")),
    budget=st.floats(60, 600),
    k=st.integers(0, 2),
)
def test_plans_are_the_best_of_all_and_bounds_never_above(
    seed: int, tasks: int, objective: str, budget: float, k: int
) -> None:
    values = written(seed, tasks, "federated", SMALL, budget, k) | {"objective": objective}
    best, plan = searched(values), allocate(parsed(values))
    assert plan.lower_bound is not None
    assert plan.lower_bound <= best * (1 + 1e-9)
    assert plan.objective == pytest.approx(best, rel=1e-8)
    assert plan.status == "optimal"


def one_task(**curve: Any) -> dict[str, Any]:
    values = written(3, 1, "federated", {"samples": [1, 100], "edge_rounds": [0, 90], "cloud_rounds": [0, 10]}, 4000.0)
    values["tasks"][0]["curve"] |= {"beta": 0.5, "group_samples": [900, 900], "gamma": 1.0, "drift": 0.0} | curve
    return values


def test_a_cloud_round_is_bought_where_it_pays_and_not_where_it_costs() -> None:
    def cloud_rounds(**curve: Any) -> int:
        return allocate(parsed(one_task(**curve))).tasks[0].cloud_rounds

    assert cloud_rounds() > 0
    assert cloud_rounds(gamma=0.0) == 0
    assert cloud_rounds(gamma=0.0, drift=-0.05) > 0
    assert cloud_rounds(drift=1.0) == 0


@pytest.mark.parametrize("objective", ["weighted", "max-min"])
def test_a_drift_that_costs_leaves_the_cloud_link_idle_whatever_its_budget(objective: str) -> None:
    values: dict[str, Any] = one_task(drift=0.5) | {"objective": objective}
    for factor in (1, 100):
        values["budgets_mb"] = {link: factor * mb for link, mb in values["budgets_mb"].items()}
        plan = allocate(parsed(values))
        assert plan.tasks[0].cloud_rounds == 0
        assert plan.objective == pytest.approx(searched(values), rel=1e-9)


@pytest.mark.slow
def test_the_area_and_what_more_budget_saves_work_with_it() -> None:
    values = written(5, 3, "federated", SMALL, 200.0)
    area, weighted = (allocate(parsed(values | {"objective": name})) for name in ("area", "weighted"))
    assert area.lower_bound is None
    assert area.objective > 0
    for each in compute_savings(parsed(values), weighted):
        budgets = values["budgets_mb"]
        more = searched(values | {"budgets_mb": budgets | {each.link: budgets[each.link] * (1 + each.added)}})
        assert each.objective == pytest.approx(more, rel=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("model", "more"), [("federated", {}), ("additive", {"merge": 0.05})])
def test_links_of_vehicles_limit_such_plans_too(seed: int, model: str, more: dict[str, float]) -> None:
    rng = np.random.default_rng(seed)
    curve = written(seed, 1, model)["tasks"][0]["curve"] | more
    asked = problem([{"uplink_mbps": fleet(*rng.uniform(1, 6, 3)), "curve": curve}], horizon_s=25.0)
    plan, _ = allocate_fleet(asked)
    best = best_carried(asked)
    assert plan.lower_bound is not None
    assert plan.lower_bound <= best * (1 + 1e-9)
    assert best * (1 - 1e-9) <= plan.objective <= best * 1.05


def test_replanning_goes_through_what_was_observed() -> None:
    asked = parsed(written(2, 1, "federated", SMALL, 900.0))
    state = PlanState.model_validate({"tasks": {"t0": {"samples": 4, "edge_rounds": 2, "accuracy": 0.4}}})
    left = condition_problem(asked, state)
    assert float(left.tasks[0].curve.error(4, 2, 0)) == pytest.approx(0.6)
    ratio = 0.6 / float(asked.tasks[0].curve.error(4, 2, 0))
    assert float(left.tasks[0].curve.error(4, 3, 2)) == pytest.approx(
        ratio * float(asked.tasks[0].curve.error(4, 3, 2))
    )
    assert allocate(condition_problem(asked, state)).tasks[0].samples == 4


def test_more_pairs_of_rounds_than_can_be_tried_are_refused_in_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rounds, "MOST_CHOICES", 10)
    with pytest.raises(InputError, match=r"a federated curve tries every pair .* task 't0' has 20: .* at most 10"):
        allocate(parsed(written(0, 1, "federated", SMALL, 5000.0)))
