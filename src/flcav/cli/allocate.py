"""`flcav allocate`: samples, edge rounds and cloud rounds per task under both uplink budgets (MLGRA)."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from flcav.optimization.allocation import Allocation
    from flcav.optimization.problem import Problem
    from flcav.optimization.vehicles import VehicleShare

    Shares = Mapping[str, Sequence[VehicleShare]]


def register(app: typer.Typer) -> None:
    """Add the command to `app`."""
    app.command("allocate")(allocate)


def allocate(
    problem: Path = typer.Argument(
        ..., help="YAML: budgets, sizes, limits and learning curves of every task; or a three-layer graph."
    ),
    as_json: bool = typer.Option(False, "--json", help="Print one JSON object."),
    out: Path | None = typer.Option(None, "--out", help="Write a page about the plan (HTML): where megabytes go, why."),
) -> None:
    """Split both uplink budgets over tasks and training stages so that the weighted error is least."""
    from flcav.optimization import allocation
    from flcav.optimization.graph import read_problem
    from flcav.optimization.vehicles import vehicle_shares

    asked = read_problem(problem)
    try:
        plan = allocation.allocate(asked)
        shares = vehicle_shares(asked, plan.tasks)
    except allocation.Infeasible as error:
        if as_json:
            typer.echo(json.dumps({"status": "infeasible", "message": str(error)}))
        raise
    if out is not None:
        from flcav.experiments.plan_page import plan_page
        from flcav.files import write_bytes

        write_bytes(out, plan_page(asked, plan, shares).encode())
    if as_json:
        typer.echo(json.dumps(_as_json(plan, shares)))
    else:
        _show(asked, plan)
        _show_vehicles(shares)


def _as_json(plan: "Allocation", shares: "Shares") -> dict:
    values = dataclasses.asdict(plan)
    for task in values["tasks"]:
        if task["name"] in shares:
            task["vehicles"] = [dataclasses.asdict(share) for share in shares[task["name"]]]
    values["tasks"] = [_given(task, "upper_error", "members") for task in values["tasks"]]
    for name in ("used_mb", "marginal_error_per_gb"):
        values[name] = {link.removesuffix("_mb"): number for link, number in values[name].items()}
    return _given(values, "note", "warnings")


def _given(values: dict, *optional: str) -> dict:
    """Return `values` without those of `optional` that say nothing."""
    return {name: value for name, value in values.items() if name not in optional or value}


def _show(problem: "Problem", plan: "Allocation") -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("task", *("samples", "edge rounds", "cloud rounds", "error", "wireless MB", "wireline MB"))
    for task in plan.tasks:
        counts = (str(task.samples), str(task.edge_rounds), str(task.cloud_rounds))
        table.add_row(
            task.name, *counts, f"{task.predicted_error:.4f}", f"{task.wireless_mb:.1f}", f"{task.wireline_mb:.1f}"
        )
    console = Console()
    console.print(table)
    console.print(f"weighted error {plan.objective:.6g}, {plan.status} (proven within {plan.gap:.2%})")
    budgets = problem.budgets_mb
    for link, used, budget, rate in (
        ("wireless", plan.used_mb.wireless_mb, budgets.wireless, plan.marginal_error_per_gb.wireless_mb),
        ("wireline", plan.used_mb.wireline_mb, budgets.wireline, plan.marginal_error_per_gb.wireline_mb),
    ):
        console.print(f"{link}: {used:.1f} of {budget:.6g} MB; 1000 MB more would save about {rate:.4f} of error")


def _show_vehicles(shares: "Shares") -> None:
    from rich.console import Console
    from rich.table import Table

    if not shares:
        return
    table = Table("task", "vehicle", "samples", "rounds joined", "wireless MB")
    for task, own in shares.items():
        for share in own:
            cells = (str(share.samples), str(len(share.rounds)), f"{share.wireless_mb:.1f}")
            table.add_row(task, share.vehicle, *cells)
    Console().print(table)
