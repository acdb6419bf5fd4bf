"""Ledger entries of earlier steps, and the shares of tasks and regions in the budgets."""

from collections.abc import Mapping

import numpy as np

from flcav.network.ledger import Budget, Ledger, LedgerEntry
from flcav.pipeline.engine import Work
from flcav.pipeline.recipe import Budgets
from flcav.pipeline.results.plans import Plan
from flcav.pipeline.results.saved import LEDGER


def share_budget(budget: Budget, planned: Mapping[str, tuple[float, float]], task: str) -> Budget:
    """Return a task's share of both budgets, in proportion to its planned traffic [MB wireless, wireline].

    Shares are rounded down to bytes, so that their sum never exceeds the budget.
    """
    parts = []
    for link, whole_mb in enumerate((budget.wireless_mb, budget.wireline_mb)):
        total = sum(each[link] for each in planned.values())
        share = planned[task][link] / total if total else 1 / len(planned)
        parts.append(whole_mb if len(planned) == 1 else np.floor(share * whole_mb * 1e6) / 1e6)
    return Budget(*map(float, parts))


def share_plan_budget(plan: Plan, budgets_mb: Budgets, task: str) -> Budget:
    """Return the share of both budgets that a plan gives to a task."""
    planned = {name: (own.wireless_mb, own.wireline_mb) for name, own in plan.tasks.items()}
    return share_budget(Budget(budgets_mb.wireless, budgets_mb.wireline), planned, task)


def region_budget(stage_one: Ledger, vehicles: Mapping[str, int], region: str) -> Budget:
    """Return the budget of a region's stage II: its share, by vehicles, of the wireless budget that stage I left."""
    share = vehicles[region] / sum(vehicles.values())
    return Budget(share * stage_one.left_mb("wireless"), 0.0)


def read_entries(work: Work, *steps: str) -> list[LedgerEntry]:
    """Return the ledger entries of several steps, one after another."""
    return [entry for step in steps for entry in Ledger.load(work.inputs[step] / LEDGER).entries]


def open_region_book(work: Work, share: Budget, pretrained: str, vehicles: Mapping[str, int], region: str) -> Ledger:
    """Return an empty ledger of a region's stage II; `share`: the task's in both budgets, before stage I.

    `pretrained` is the step of stage I, `vehicles` the number of each federating region.
    """
    return Ledger(region_budget(Ledger(share, read_entries(work, pretrained)), vehicles, region))
