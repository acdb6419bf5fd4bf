"""Sensitivity to the budgets: the optimal objective at multiples of the budgets (a Pareto front), each solved anew.

Plans are in integers, so that the objective falls in steps: the gain of a larger budget is computed, not extrapolated
from the derivative at the present one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from flcav.network.ledger import LinkMegabytes
from flcav.optimization.allocation.allocate import Allocation, relative_gap
from flcav.optimization.allocation.fleet import allocate_fleet
from flcav.optimization.problem import Problem
from flcav.optimization.solvers.instance import Infeasible

FACTORS = (0.25, 0.35, 0.5, 0.7, 0.85, 1.0, 1.25, 1.6, 2.0)  # of the problem's budgets
LINKS = ("wireless", "wireline")
ROUNDING = 1e-12  # relative difference of equal objectives whose errors are added in another order
ADDED = (0.1, 0.5)  # shares of a budget that are added to it


@dataclass(frozen=True)
class BudgetPoint:
    """The optimal objective at a pair of budgets."""

    factor: float  # of the problem's budgets, on the links that were scaled
    budgets_mb: LinkMegabytes
    objective: float
    lower_bound: float | None  # proven: no plan within these budgets has less; None for the area
    gap: float | None  # (objective - lower_bound) / lower_bound


@dataclass(frozen=True)
class Saving:
    """The gain of the plan solved with more of one link's budget."""

    link: str  # one of `LINKS`
    added: float  # share of the budget
    added_mb: float
    objective: float  # with the larger budget
    lower_bound: float | None
    gap: float | None
    saved: float  # by how much the objective is less than this plan's; of an area: by how much it is more


def sweep_budgets(
    problem: Problem, plan: Allocation, scaled: Sequence[str] = LINKS, factors: Sequence[float] = FACTORS
) -> tuple[BudgetPoint, ...]:
    """Return the optimal objective at `factors`, ascending, times the budgets of the `scaled` links.

    Factors whose budgets allow no plan are left out. `plan` is the plan at the problem's budgets (factor 1). The plan
    of a smaller budget is kept where solving again finds no better one, as may happen where the vehicles' links limit
    plans: it fits the larger budget, too.
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
        points.append(BudgetPoint(factor, LinkMegabytes(*budgets.values()), best.objective, lower, gap))
    return tuple(points)


def compute_savings(problem: Problem, plan: Allocation) -> tuple[Saving, ...]:
    """Return the gains over `plan` from 10 % and from 50 % more budget on one link at a time, each solved anew."""
    found = []
    for link in LINKS:
        points = sweep_budgets(problem, plan, (link,), (1.0, *(1 + added for added in ADDED)))
        for added, point in zip(ADDED, points[1:], strict=True):
            more_mb = added * getattr(problem.budgets_mb, link)
            saved = abs(plan.objective - point.objective)
            saved = saved if saved > ROUNDING * abs(plan.objective) else 0.0
            found.append(Saving(link, added, more_mb, point.objective, point.lower_bound, point.gap, saved))
    return tuple(found)


def _better(problem: Problem, one: Allocation, other: Allocation) -> Allocation:
    return (max if problem.objective == "area" else min)(one, other, key=lambda plan: plan.objective)
