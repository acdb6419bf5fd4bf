"""Robust plans, baselines, importance, the area, and plans that go on from what was spent."""

from collections.abc import Sequence

import numpy as np
import pytest
from made_problems import parsed, written

from flcav.config import InputError, parse_config
from flcav.network.ledger import LINKS, Ledger, LedgerEntry, LinkMegabytes
from flcav.network.plan import MessageSizes, price
from flcav.optimization.allocation.allocate import (
    TaskAllocation,
    allocate,
    resolve_problem,
    weighted_error,
)
from flcav.optimization.allocation.baselines import BASELINES, baseline
from flcav.optimization.allocation.replanning import PlanState, condition_problem
from flcav.optimization.solvers.area import area
from flcav.optimization.solvers.instance import Infeasible, stage_plan

LIMITS = {"samples": [20, 900], "edge_rounds": [0, 12], "cloud_rounds": [0, 8]}


def banded(seed: int, tasks: int, model: str) -> dict:
    """Return a problem whose upper bands fall more slowly than its curves."""
    values = written(seed, tasks, model, LIMITS)
    for task, other in zip(values["tasks"], written(seed + 1, tasks, model, LIMITS)["tasks"]):
        task["upper"] = other["curve"] | {"floor": 0.1}
    return values


@pytest.mark.parametrize(("seed", "model"), [(0, "additive"), (1, "additive"), (2, "effective"), (1, "federated")])
def test_a_robust_plan_is_best_for_the_bands_and_never_better_for_the_curves(seed, model):
    values = banded(seed, 3, model)
    nominal, robust = allocate(parsed(values)), allocate(parsed(values | {"robust": True}))
    plain = parsed(values)
    predicted = sum(t.weight * got.predicted_error for t, got in zip(plain.tasks, robust.tasks))
    assert predicted >= nominal.objective * (1 - 1e-9)
    assert robust.objective == pytest.approx(
        sum(t.weight * (got.upper_error or 0) for t, got in zip(plain.tasks, robust.tasks))
    )
    nominal_by_bands = sum(
        t.weight * float(t.upper.error(got.samples, got.edge_rounds, got.cloud_rounds))
        for t, got in zip(plain.tasks, nominal.tasks)
        if t.upper is not None
    )
    assert robust.objective <= nominal_by_bands * (1 + 1e-9)
    assert [t.upper_error for t in nominal.tasks] == [None] * 3


def test_an_unknown_baseline_is_refused_by_name():
    with pytest.raises(InputError, match="baseline 'best': unknown; known baselines: equal-stages, equal-tasks"):
        baseline(parsed(written(1, 1, "additive", LIMITS)), "best")


@pytest.mark.slow
@pytest.mark.parametrize("name", BASELINES)
@pytest.mark.parametrize(
    ("tasks", "model", "k"),
    [(1, "additive", 1), (3, "effective", 1), (3, "federated", 1), (2, "shared", 2), (5, "additive", 0)],
)
@pytest.mark.parametrize("objective", ["weighted", "max-min"])
def test_no_baseline_is_better_than_the_optimum_or_over_budget(name, tasks, model, k, objective):
    problem = parsed(written(tasks, tasks, model, LIMITS, k=k) | {"objective": objective})
    optimum, compared = allocate(problem), baseline(problem, name)
    assert optimum.lower_bound is not None
    assert compared.objective >= optimum.lower_bound * (1 - 1e-9)
    assert compared.used_mb.wireless_mb <= problem.budgets_mb.wireless * (1 + 1e-9)
    assert compared.used_mb.wireline_mb <= problem.budgets_mb.wireline * (1 + 1e-9)
    for task, got in zip(problem.tasks, compared.tasks):
        for field in ("samples", "edge_rounds", "cloud_rounds"):
            low, high = getattr(task.limits, field)
            assert low <= getattr(got, field) <= high


def test_equal_stages_spends_a_third_of_the_wireless_link_on_each_stage():
    values = written(
        0, 1, "additive", {"samples": [0, 10**6], "edge_rounds": [0, 10**6], "cloud_rounds": [0, 10**6]}, 1e6
    )
    values["budgets_mb"]["wireline"] = 1e9
    (got,) = baseline(parsed(values), "equal-stages").tasks
    task = parsed(values).tasks[0]
    per_round = task.model_mb * sum(task.edge_groups)
    spent = np.array([got.samples * task.sample_mb, got.edge_rounds * per_round, got.cloud_rounds * per_round])
    assert spent == pytest.approx(np.full(3, 1e6 / 3), rel=1e-3)


def test_max_throughput_gets_most_messages_through():
    problem = parsed(written(3, 3, "additive", LIMITS))

    def messages(plans: Sequence[TaskAllocation]) -> int:
        groups = [task.edge_groups for task in problem.tasks]
        return sum(
            plan.samples + (plan.edge_rounds + plan.cloud_rounds) * sum(own) + plan.cloud_rounds * len(own)
            for plan, own in zip(plans, groups)
        )

    most = messages(baseline(problem, "max-throughput").tasks)
    assert all(most >= messages(baseline(problem, name).tasks) * (1 - 1e-3) for name in BASELINES)
    assert most >= messages(allocate(problem).tasks) * (1 - 1e-3)


def test_weights_from_importance_are_what_is_lost_without_a_task():
    values: dict = written(1, 3, "additive", LIMITS)
    values["performance"] = 0.8
    for number, without in enumerate((0.5, 0.7, 0.9)):
        values["tasks"][number]["performance_without"] = without
    weights = [task.weight for task in resolve_problem(parsed(values)).tasks]
    assert weights == pytest.approx([0.75, 0.25, 0.0])
    plan = allocate(parsed(values))
    least = plan.tasks[2]
    assert (least.samples, least.edge_rounds, least.cloud_rounds) == (20, 0, 0)


def test_the_area_is_that_of_the_polygon_and_has_no_certificate():
    assert area(np.ones(3)) == pytest.approx(3 * np.sqrt(3) / 4)
    assert area(np.ones(4)) == pytest.approx(2.0)
    values = written(2, 3, "additive", LIMITS)
    plan = allocate(parsed(values | {"objective": "area"}))
    accuracy = 1 - np.array([task.predicted_error for task in plan.tasks])
    assert plan.objective == pytest.approx(area(accuracy))
    assert (plan.lower_bound, plan.gap) == (None, None)
    assert plan.note is not None
    assert "no certificate" in plan.note
    for objective in ("weighted", "max-min"):
        other = allocate(parsed(values | {"objective": objective}))
        assert plan.objective >= area(1 - np.array([task.predicted_error for task in other.tasks])) * (1 - 1e-9)


def test_a_plan_beyond_the_measured_range_says_so():
    values = written(0, 1, "additive", LIMITS)
    values["tasks"][0]["measured"] = {"samples": 10}
    (warning,) = allocate(parsed(values)).warnings
    assert "samples are beyond the 10" in warning


def test_replanning_keeps_within_the_budgets_whatever_is_observed():
    problem = parsed(written(7, 2, "additive", {"samples": [20, 900], "edge_rounds": [1, 12], "cloud_rounds": [1, 8]}))
    stages = ("samples", "edge_rounds", "cloud_rounds")
    ledger = Ledger(LinkMegabytes(problem.budgets_mb.wireless, problem.budgets_mb.wireline))
    rng = np.random.default_rng(0)
    plan, done = allocate(problem), {task.name: [0, 0, 0] for task in problem.tasks}

    def send(task, stage, count):
        counts = [0, 0, 0]
        counts[stage] = count
        cost = price(stage_plan(problem, task, counts), MessageSizes(task.sample_mb, task.model_mb))
        for link in LINKS:
            if mb := getattr(cost, f"{link}_mb"):
                ledger.enter(LedgerEntry(stages[stage], task.name, link, "up", 0, "all", round(mb * 1e6)))
        done[task.name][stage] += count

    for stage, field in enumerate(stages):
        while any(getattr(p, field) > done[p.name][stage] for p in plan.tasks):
            for task, planned in zip(problem.tasks, plan.tasks):
                left = getattr(planned, field) - done[task.name][stage]
                if left > 0:
                    send(task, stage, left if stage == 0 else 1)
            observed = {
                task.name: dict(zip(stages, done[task.name]))
                | {"accuracy": 1 - min(1.0, float(task.curve.error(*done[task.name])) * rng.uniform(0.5, 1.5))}
                for task in problem.tasks
            }
            plan = allocate(condition_problem(problem, parse_config(PlanState, {"tasks": observed}, "progress")))
    for planned in plan.tasks:
        assert [getattr(planned, field) for field in stages] == done[planned.name]
    assert ledger.used_mb("wireless") <= problem.budgets_mb.wireless
    assert ledger.used_mb("wireline") <= problem.budgets_mb.wireline


def test_curves_pass_through_what_was_observed_and_stages_that_are_over_stay():
    problem = parsed(written(1, 2, "shared", LIMITS))
    progress = PlanState.model_validate(
        {
            "tasks": {"t0": {"samples": 300, "edge_rounds": 2, "accuracy": 0.6}},
            "used_mb": {"wireless": 900, "wireline": 500},
        }
    )
    left = condition_problem(problem, progress)
    assert float(left.tasks[0].curve.error(300, 2, 0)) == pytest.approx(0.4)
    assert left.tasks[1] == problem.tasks[1]
    assert left.tasks[0].limits.samples == (300, 300)
    assert left.tasks[0].limits.edge_rounds == (2, 12)
    task = problem.tasks[0]
    cost = price(stage_plan(problem, task, (300, 2, 0)), MessageSizes(task.sample_mb, task.model_mb))
    assert left.budgets_mb.wireless == pytest.approx(problem.budgets_mb.wireless - 900 + cost.wireless_mb)
    plan = allocate(condition_problem(problem, progress))
    assert (plan.tasks[0].samples, plan.tasks[0].edge_rounds >= 2) == (300, True)


def test_progress_that_cannot_be_is_refused():
    problem = parsed(written(1, 1, "additive", LIMITS))
    for values, said in (
        ({"tasks": {"other": {"samples": 30}}}, "'other'"),
        ({"tasks": {"t0": {"samples": 30}}, "used_mb": {"wireless": 1e9, "wireline": 0}}, "progress.used_mb.wireless"),
    ):
        with pytest.raises(InputError, match=said):
            condition_problem(problem, PlanState.model_validate(values))
    with pytest.raises(Infeasible, match="wireless"):
        allocate(condition_problem(problem, PlanState.model_validate({"tasks": {"t0": {"samples": 10**6}}})))


def test_the_weighted_error_of_a_cluster_is_the_mean_of_its_members_by_weight():
    problem = parsed(written(3, 2, "shared", LIMITS))
    plan = allocate(problem)
    for task, got in zip(problem.tasks, plan.tasks):
        weights = [learner.weight for learner in task.learners]
        assert sum(weights) == pytest.approx(task.weight)
        assert np.average([m.predicted_error for m in got.members], weights=weights) == pytest.approx(
            got.predicted_error
        )
    assert plan.objective == pytest.approx(weighted_error(problem, plan.tasks))
