"""`flcav allocate` and `flcav replan`: samples and rounds per task under both uplink budgets (MLGRA)."""

import dataclasses
import json
from collections.abc import Iterator, Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from flcav.cli.options import join_choices
from flcav.cli.terminal import Answer, answer_json
from flcav.interface.wording import plural

if TYPE_CHECKING:
    from rich.table import Table

    from flcav.optimization.allocation.allocate import Allocation
    from flcav.optimization.allocation.baselines import Baseline
    from flcav.optimization.allocation.budget_sweep import Saving
    from flcav.optimization.allocation.vehicles import Shares
    from flcav.optimization.problem import Problem

SHOWN = "#.2g"  # format of predictions: repeated trainings on the same frames differ in the second digit


class BaselineName(StrEnum):
    """Baseline plans."""

    equal_stages = "equal-stages"
    equal_tasks = "equal-tasks"
    max_throughput = "max-throughput"
    article = "article"


PROBLEM = typer.Argument(
    ..., help="YAML: budgets, sizes, limits and learning curves of every task; or a three-layer graph."
)
BASELINE = typer.Option(
    None, "--baseline", metavar="PLAN", help=f"A plan to compare with, in the same call: {join_choices(BaselineName)}."
)
PROGRESS = "YAML: what is spent and observed so far; the plan goes on from there."
VERIFY = typer.Option(
    False, "--verify", help="Recompute costs, objective and bound with no code of the solver; exit 1 if one is wrong."
)
THROUGHPUT = typer.Option(
    None,
    "--throughput",
    help="CSV of measured rates, in place of uplink_mbps: vehicle, time_s, mbps, and optionally link, wireless or "
    "wireline.",
)
OUT = typer.Option(None, "--out", help="Write a page about the plan (HTML): where megabytes go, why.")


@answer_json
def allocate(
    problem: Path = PROBLEM,
    baseline: BaselineName | None = BASELINE,
    progress: Path | None = typer.Option(None, "--progress", help=f"{PROGRESS} As `flcav replan`."),
    throughput: Path | None = THROUGHPUT,
    out: Path | None = OUT,
    verify: bool = VERIFY,
) -> Answer:
    """Split both uplink budgets over tasks and training stages to minimise the weighted error."""
    return _plan(problem, progress, baseline, throughput, out, verify)


@answer_json
def replan(
    problem: Path = PROBLEM,
    progress: Path = typer.Argument(..., help=PROGRESS),
    baseline: BaselineName | None = BASELINE,
    throughput: Path | None = THROUGHPUT,
    out: Path | None = OUT,
    verify: bool = VERIFY,
) -> Answer:
    """Plan the rest of a training that is under way, from what it has spent and reached; counts include what is done.

    Finished stages stay as they are, learning curves are scaled to pass through the accuracies reached, and what was
    not spent goes back to the budgets.
    """
    return _plan(problem, progress, baseline, throughput, out, verify)


def _plan(
    problem: Path,
    progress: Path | None,
    baseline: BaselineName | None,
    throughput: Path | None,
    out: Path | None,
    verify: bool,
) -> Answer:
    from rich.text import Text

    from flcav.config import read_config
    from flcav.optimization.allocation.baselines import baseline as compared
    from flcav.optimization.allocation.budget_sweep import compute_savings
    from flcav.optimization.allocation.fleet import allocate_fleet
    from flcav.optimization.allocation.replanning import PlanState, condition_problem
    from flcav.optimization.graph import load_problem, read_graph
    from flcav.optimization.solvers.instance import Infeasible
    from flcav.optimization.verification.allocation import verify_allocation
    from flcav.sources.recipe import find_recipe

    problem = find_recipe(problem)
    loaded = load_problem(problem)
    notes = ()
    if throughput is not None:
        from flcav.network.radio.measured import load_throughput
        from flcav.optimization.allocation.uploads import measure_links

        measured = load_throughput(throughput)
        loaded = measure_links(loaded, measured)
        means = ", ".join(f"{name} {measured.mean_mbps(name):.3g}" for name in measured.rates["wireless"])
        notes = (*measured.taken, f"{throughput}: mean wireless Mbit/s: {means}")
    if progress is not None:
        loaded = condition_problem(loaded, read_config(PlanState, progress))
    try:
        plan, shares = allocate_fleet(loaded)
    except Infeasible as error:
        yield {"status": "infeasible", "message": str(error)}
        raise
    more = compute_savings(loaded, plan)
    if out is not None:
        from flcav.optimization.allocation.comparison import compare_plan
        from flcav.report.pages.plan_page import plan_page
        from flcav.storage.files import write_bytes

        page = plan_page(compare_plan(loaded, plan, shares, more), read_graph(problem))
        write_bytes(out, page.encode())
    simpler = None if baseline is None else compared(loaded, baseline.value)
    verified = verify_allocation(loaded.model_dump_json(), json.dumps(_plain(plan))) if verify else None
    extra = {} if simpler is None else {"baseline": _plain(simpler)}
    extra |= {} if verified is None else {"verification": dataclasses.asdict(verified)}
    yield _as_json(plan, shares, more) | extra
    yield _table(plan)
    if any(task.accuracy_low is not None for task in plan.tasks):
        yield Text("In brackets: the band of the predicted accuracy.")
    yield from map(Text, (*_describe(loaded, plan, more), *notes))
    if shares:
        yield _table_vehicles(shares)
    if simpler is not None:
        yield _table(simpler)
        yield Text(_describe_baseline(simpler, plan))
    if verified is not None:
        yield from map(Text, verified.lines())
    if verified is not None and verified.faults:
        raise typer.Exit(1)


def _as_json(plan: "Allocation", shares: "Shares", more: "Sequence[Saving]") -> dict[str, Any]:
    values = _plain(plan) | {"savings": [dataclasses.asdict(saving) for saving in more]}
    for task in values["tasks"]:
        if task["name"] in shares:
            task["vehicles"] = [dataclasses.asdict(share) for share in shares[task["name"]]]
    return values


def _plain(plan: "Allocation | Baseline") -> dict[str, Any]:
    """Return a plan as a JSON object, with links by name and without empty optional fields."""
    values = dataclasses.asdict(plan)
    for task in values["tasks"]:
        for name in ("accuracy_low", "accuracy_high"):
            if task[name] is None:
                del task[name]
    values["tasks"] = [
        _given(task, "upper_error", "members", "called", "local_steps", "form", "network", "annotation")
        for task in values["tasks"]
    ]
    for name in ("used_mb", "marginal_error_per_gb"):
        if name in values:
            values[name] = {link.removesuffix("_mb"): number for link, number in values[name].items()}
    return _given(values, "busy_s", "annotation_s", "note", "warnings", "certificate")


def _given(values: dict[str, Any], *optional: str) -> dict[str, Any]:
    return {name: value for name, value in values.items() if name not in optional or value}


def _describe(problem: "Problem", plan: "Allocation", more: "Sequence[Saving]") -> Iterator[str]:
    from flcav.optimization.allocation.problem_file import MEASURES, explain_objective

    measure = MEASURES[problem.objective]
    for task in plan.tasks:
        if task.called is not None:
            told = plural(task.called, "vehicle")
            yield (f"{task.name}: {told} at most of each edge server in its edge rounds")
        if chosen := task.describe_choices():
            yield f"{task.name}: {chosen}"
    curves = "the fitted curves" if len(plan.tasks) > 1 else "the fitted curve"
    yield (f"{measure} {plan.objective:{SHOWN}}, {plan.status} for {curves} ({_proven(plan.gap)})")
    yield (f"{measure.capitalize()}: {explain_objective(problem, plan.objective)}")
    verb = "adds" if problem.objective == "area" else "saves"
    for link in ("wireless", "wireline"):
        used = getattr(plan.used_mb, f"{link}_mb")
        budget = getattr(problem.budgets_mb, link)
        yield (f"{link}: {used:.1f} of {budget:.6g} MB")
        for saving in (saving for saving in more if saving.link == link):
            saved = f"{saving.saved:{SHOWN}}" if saving.saved else "nothing"
            larger = f"{saving.added:.0%} more ({saving.added_mb:.6g} MB)"
            yield (f"  {larger}, solved anew: {verb} {saved} ({_proven(saving.gap)})")
    if plan.busy_s is not None:
        yield (f"time: {plan.busy_s:.1f} of {problem.horizon_s:.6g} s on the busiest vehicle")
    if plan.annotation_s is not None:
        yield (f"annotation: {plan.annotation_s:.1f} of {problem.annotation_s:.6g} s")
    yield from filter(None, (plan.note, *plan.warnings))


def _proven(gap: float | None) -> str:
    return "no certificate" if gap is None else f"proven within {gap:.2%}"


def _describe_baseline(simpler: "Baseline", plan: "Allocation") -> str:
    note = f" ({simpler.note})" if simpler.note else ""
    one, other = f"{simpler.objective:{SHOWN}}", f"{plan.objective:{SHOWN}}"
    apart = f", {abs(plan.objective - simpler.objective):{SHOWN}} apart" if one == other else ""
    return f"{simpler.name}: {one}{note}; the plan above: {other}{apart}"


def _table(plan: "Allocation | Baseline") -> "Table":
    from rich.table import Table

    table = Table("task", *("samples", "edge rounds", "cloud rounds", "accuracy", "wireless MB", "wireline MB"))
    for task in plan.tasks:
        counts = (str(task.samples), str(task.edge_rounds), str(task.cloud_rounds))
        sent = (f"{task.wireless_mb:.1f}", f"{task.wireline_mb:.1f}")
        table.add_row(task.name, *counts, task.describe_accuracy(), *sent)
        for member in task.members:
            table.add_row(f"  {member.name}", "", "", "", f"{max(1 - member.predicted_error, 0):.2f}", "", "")
    return table


def _table_vehicles(shares: "Shares") -> "Table":
    from rich.table import Table

    table = Table("task", "vehicle", "samples", "rounds joined", "wireless MB", "busy s")
    for task, of_task in shares.items():
        for share in of_task:
            cells = (str(share.samples), str(len(share.rounds)), f"{share.wireless_mb:.1f}", f"{share.busy_s:.1f}")
            table.add_row(task, share.vehicle, *cells)
    return table
