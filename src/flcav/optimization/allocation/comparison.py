"""Comparison of a plan with other plans of its problem: scaled budgets, one larger budget, and simpler methods."""

from collections.abc import Mapping
from dataclasses import dataclass

from flcav.optimization.allocation.allocate import Allocation
from flcav.optimization.allocation.baselines import BASELINES, Baseline, baseline
from flcav.optimization.allocation.budget_sweep import FACTORS, LINKS, BudgetPoint, Saving, sweep_budgets
from flcav.optimization.allocation.vehicles import Shares
from flcav.optimization.problem import Problem

SCALED = {"both links": LINKS, "wireless alone": ("wireless",), "wireline alone": ("wireline",)}
COARSE = (0.5, 1.0, 2.0)  # budget factors where a plan takes seconds: without a certificate, or by links


@dataclass(frozen=True)
class PlanComparison:
    """A plan, its split over the vehicles, and what it is compared with."""

    problem: Problem
    plan: Allocation
    shares: Shares
    savings: tuple[Saving, ...]
    sweeps: Mapping[str, tuple[BudgetPoint, ...]]  # by name in `SCALED`
    baselines: tuple[Baseline, ...]


def compare_plan(problem: Problem, plan: Allocation, shares: Shares, savings: tuple[Saving, ...]) -> PlanComparison:
    """Solve `problem` at multiples of its budgets and by every baseline; return the results with its `plan`.

    For a problem with one task "equal-tasks" is left out. Raises `Infeasible` as `baseline` does.
    """
    factors = FACTORS if plan.note is None else COARSE
    sweeps = {name: sweep_budgets(problem, plan, links, factors) for name, links in SCALED.items()}
    names = [name for name in BASELINES if len(problem.tasks) > 1 or name != "equal-tasks"]
    return PlanComparison(problem, plan, shares, savings, sweeps, tuple(baseline(problem, name) for name in names))
