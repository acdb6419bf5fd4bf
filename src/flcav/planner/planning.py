"""An allocation plan for budgets that a page asks about, with what more of them buys and equal shares beside it."""

from dataclasses import asdict

from flcav.config import InputError, Json
from flcav.optimization.allocation.allocate import Allocation
from flcav.optimization.allocation.baselines import Baseline, baseline
from flcav.optimization.allocation.budget_sweep import compute_savings
from flcav.optimization.allocation.fleet import allocate_fleet
from flcav.optimization.allocation.problem_file import MEASURES, explain_objective
from flcav.optimization.problem import Problem
from flcav.optimization.solvers.instance import Infeasible

BESIDE = "equal-stages"  # the plan that splits budgets equally


def with_budgets(problem: Problem, wireless_mb: float, wireline_mb: float, horizon_s: float | None) -> Problem:
    """Return the problem with other budgets [MB] and time [s]; None leaves its time as it is."""
    budgets = problem.budgets_mb.model_copy(update={"wireless": wireless_mb, "wireline": wireline_mb})
    return problem.model_copy(
        update={"budgets_mb": budgets, "horizon_s": problem.horizon_s if horizon_s is None else horizon_s}
    )


def describe_problem(problem: Problem, name: str) -> dict[str, Json]:
    """Return what the page's sliders begin with."""
    return {
        "name": name,
        "wireless_mb": problem.budgets_mb.wireless,
        "wireline_mb": problem.budgets_mb.wireline,
        "horizon_s": problem.horizon_s,
        "measure": MEASURES[problem.objective],
        "more_is_better": problem.objective == "area",
        "tasks": [task.name for task in problem.tasks],
    }


def plan_budgets(problem: Problem) -> dict[str, Json]:
    """Return the plan of a problem with equal shares beside it, or the sentence that says why there is none."""
    try:
        plan, _ = allocate_fleet(problem)
    except Infeasible as error:
        return {"infeasible": str(error)}
    try:
        equal = baseline(problem, BESIDE)
    except (Infeasible, InputError):
        equal = None
    beside = None if equal is None else {"objective": equal.objective, "note": equal.note, "tasks": _describe(equal)}
    return {
        "objective": plan.objective,
        "said": explain_objective(problem, plan.objective),
        "gap": plan.gap,
        "status": plan.status,
        "used_mb": [plan.used_mb.wireless_mb, plan.used_mb.wireline_mb],
        "busy_s": plan.busy_s,
        "warnings": [*filter(None, (plan.note, *plan.warnings))],
        "tasks": _describe(plan),
        "equal": beside,
    }


def _describe(plan: Allocation | Baseline) -> list[Json]:
    return [
        {
            "name": task.name,
            "samples": task.samples,
            "edge_rounds": task.edge_rounds,
            "cloud_rounds": task.cloud_rounds,
            "accuracy": max(1 - task.predicted_error, 0.0),
            "low": task.accuracy_low,
            "high": task.accuracy_high,
            "told": task.describe_accuracy(),
            "mb": [task.wireless_mb, task.wireline_mb],
        }
        for task in plan.tasks
    ]


def plan_more(problem: Problem) -> dict[str, Json]:
    """Return what 10 % and 50 % more of one budget at a time buys, each solved anew."""
    try:
        plan, _ = allocate_fleet(problem)
    except Infeasible as error:
        return {"infeasible": str(error)}
    return {"savings": [asdict(saving) for saving in compute_savings(problem, plan)]}
