"""What more or less budget would bring: the plan solved again over a grid of budgets (the Pareto front)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from flcav.network.plan import Price
from flcav.optimization.allocation import Allocation, Infeasible, allocate
from flcav.optimization.problem import Problem

FACTORS = (0.25, 0.35, 0.5, 0.7, 0.85, 1.0, 1.25, 1.6, 2.0)
LINKS = ("wireless", "wireline")


@dataclass(frozen=True)
class BudgetPoint:
    """The best plan at some budgets."""

    factor: float  # of the problem's own budgets, on the links that were scaled
    budgets_mb: Price
    objective: float
    marginal_error_per_gb: Price


def budget_sweep(
    problem: Problem,
    scaled: Sequence[str] = LINKS,
    factors: Sequence[float] = FACTORS,
    solve: Callable[[Problem], Allocation] = allocate,
) -> tuple[BudgetPoint, ...]:
    """Return the best plan's error at each of `factors` times the budgets of the `scaled` links, where there is one."""
    points = []
    for factor in factors:
        budgets = {link: getattr(problem.budgets_mb, link) * (factor if link in scaled else 1.0) for link in LINKS}
        changed = problem.model_copy(update={"budgets_mb": problem.budgets_mb.model_copy(update=budgets)})
        try:
            plan = solve(changed)
        except Infeasible:
            continue
        points.append(BudgetPoint(factor, Price(*budgets.values()), plan.objective, plan.marginal_error_per_gb))
    return tuple(points)
