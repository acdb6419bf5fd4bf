"""Ledger entries of earlier steps, and the tasks' shares of the budgets."""

from collections.abc import Mapping

from flcav.network.ledger import Budget, Ledger, LedgerEntry
from flcav.pipeline.results import LEDGER, Plan
from flcav.pipeline.stages import region_budget, share_budget
from flcav.pipeline.steps import Work


def share_plan_budget(plan: Plan, budget_mb: tuple[float, float], task: str) -> Budget:
    """Return the share of both budgets [MB wireless, wireline] that a plan gives to a task."""
    planned = {name: (own.wireless_mb, own.wireline_mb) for name, own in plan.tasks.items()}
    return share_budget(Budget(*budget_mb), planned, task)


def read_entries(work: Work, *steps: str) -> list[LedgerEntry]:
    """Return the ledger entries of several steps, one after another."""
    return [entry for step in steps for entry in Ledger.load(work.inputs[step] / LEDGER).entries]


def open_region_book(
    work: Work,
    task: str,
    region: str,
    plan: str,
    pretrained: str,
    vehicles: Mapping[str, int],
    budget_mb: tuple[float, float],
) -> Ledger:
    """Return an empty ledger of a region's stage II, with its share of what stage I left."""
    whole = share_plan_budget(Plan.load(work.inputs[plan]), budget_mb, task)
    return Ledger(region_budget(Ledger(whole, read_entries(work, pretrained)), vehicles, region))
