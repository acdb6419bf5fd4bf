"""What more or less budget would bring: the plan solved anew at other budgets (the Pareto front).

Plans are in whole samples and rounds, so the objective falls in steps: what a larger budget saves is solved for, not
extrapolated from the derivative at this one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from flcav.network.plan import Price
from flcav.optimization.allocation.allocate import Allocation, Infeasible, relative_gap
from flcav.optimization.allocation.problem import Problem
from flcav.optimization.fleet import allocate_fleet

FACTORS = (0.25, 0.35, 0.5, 0.7, 0.85, 1.0, 1.25, 1.6, 2.0)
LINKS = ("wireless", "wireline")
ROUNDING = 1e-12  # relative: equal plans whose errors are added in another order
ADDED = (0.1, 0.5)  # shares of a budget that are added to it


@dataclass(frozen=True)
class BudgetPoint:
    """The best plan at some budgets."""

    factor: float  # of the problem's own budgets, on the links that were scaled
    budgets_mb: Price
    objective: float
    lower_bound: float | None  # proven: no plan within these budgets has less; none for the area
    gap: float | None  # (objective - lower_bound) / lower_bound


@dataclass(frozen=True)
class Saving:
    """What the plan solved anew with more of one link's budget brings."""

    link: str
    added: float  # share of the budget
    added_mb: float
    objective: float
    lower_bound: float | None
    gap: float | None
    saved: float  # by how much the objective is less than this plan's; of an area: by how much it is more


def budget_sweep(
    problem: Problem, plan: Allocation, scaled: Sequence[str] = LINKS, factors: Sequence[float] = FACTORS
) -> tuple[BudgetPoint, ...]:
    """Return the best plan at each of `factors` times the budgets of the `scaled` links, where there is one.

    `plan` is the one of the problem's own budgets. A plan of a smaller budget is one of a larger budget too: it stands
    where solving anew finds no better one, as it may where vehicles' own links limit the plans.
    """
    points: list[BudgetPoint] = []
    best: Allocation | None = None
    for factor in sorted(factors):
        budgets = {link: getattr(problem.budgets_mb, link) * (factor if link in scaled else 1.0) for link in LINKS}
        changed = problem.model_copy(update={"budgets_mb": problem.budgets_mb.model_copy(update=budgets)})
        try:
            found = plan if factor == 1 else allocate_fleet(changed)[0]
        except Infeasible:
            if best is None:
                continue
            found = replace(best, lower_bound=None)
        best = found if best is None else _better(problem, best, found)
        lower = None if found.lower_bound is None else min(found.lower_bound, best.objective)
        gap = None if lower is None else relative_gap(best.objective, lower)
        points.append(BudgetPoint(factor, Price(*budgets.values()), best.objective, lower, gap))
    return tuple(points)


def savings(problem: Problem, plan: Allocation) -> tuple[Saving, ...]:
    """Return what a tenth and a half more of each link's budget bring to `plan`, each solved anew."""
    found = []
    for link in LINKS:
        points = budget_sweep(problem, plan, (link,), (1.0, *(1 + added for added in ADDED)))
        for added, point in zip(ADDED, points[1:], strict=True):
            more_mb = added * getattr(problem.budgets_mb, link)
            saved = abs(plan.objective - point.objective)
            saved = saved if saved > ROUNDING * abs(plan.objective) else 0.0
            found.append(Saving(link, added, more_mb, point.objective, point.lower_bound, point.gap, saved))
    return tuple(found)


def _better(problem: Problem, one: Allocation, other: Allocation) -> Allocation:
    return (max if problem.objective == "area" else min)(one, other, key=lambda plan: plan.objective)
