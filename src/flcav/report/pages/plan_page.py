"""HTML page of a plan: transfers, budgets and their sweep, comparison with simpler plans, and vehicles."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import networkx as nx

from flcav.network.ledger import LinkMegabytes
from flcav.network.plan import StagePlan, price
from flcav.optimization.allocation.allocate import Allocation, TaskAllocation, resolve_problem, settle_plan
from flcav.optimization.allocation.budget_sweep import LINKS, BudgetPoint
from flcav.optimization.allocation.comparison import PlanComparison
from flcav.optimization.allocation.problem_file import CURVE, MEASURES, STEPS, TERMS, explain_objective
from flcav.optimization.allocation.vehicles import Shares, trains
from flcav.optimization.problem import AllocationTask, Problem
from flcav.report import style
from flcav.report.charts import curves, plans
from flcav.report.pages import html

STAGES = {"samples": "samples", "edge_rounds": "edge rounds", "cloud_rounds": "cloud rounds"}
SHOWN = 6  # number of tasks with separate colours; the others are drawn together
BETTER = {  # effect of more megabytes on the objective
    "weighted": {"verb": "lower the weighted error", "gain": "weighted error saved"},
    "max-min": {"verb": "lower the largest error", "gain": "largest error saved"},
    "area": {"verb": "raise the area", "gain": "area gained"},
}
BASELINE_NAMES = {
    "equal-stages": "equal shares for every stage",
    "equal-tasks": "equal shares for every task",
    "max-throughput": "most messages, whatever they teach",
    "article": "the continuous optimum, rounded down",
}


def plan_page(compared: PlanComparison, graph: nx.Graph | None = None) -> str:
    """Return the page as self-contained HTML; `graph` is the three-layer graph of the problem, if it has one."""
    results = plan_results(compared)
    pictures = {
        "megabytes": plans.megabytes(results["parts"], results["links"]),
        "budgets": plans.best_by_budget(compared.sweeps, results["measure"]["name"]),
    }
    if graph is not None:
        pictures["layers"] = curves.three_layers(graph)
    return html.render(results, {name: style.png(figure) for name, figure in pictures.items()}, "plan.html.j2")


def plan_results(compared: PlanComparison) -> dict[str, Any]:
    """Return the numbers and sentences of the page, for its template."""
    problem, plan = compared.problem, compared.plan
    links = {
        link: {
            "budget_mb": getattr(problem.budgets_mb, link),
            "used_mb": getattr(plan.used_mb, f"{link}_mb"),
            "share": getattr(plan.used_mb, f"{link}_mb") / getattr(problem.budgets_mb, link),
            "more": [asdict(saving) for saving in compared.savings if saving.link == link],
        }
        for link in LINKS
    }
    tasks = [
        {
            **asdict(row),
            "accuracy": row.describe_accuracy(),
            "rounds": row.describe_choices(),
            "weight": task.weight,
            "vehicles": sum(task.edge_groups),
        }
        for task, row in zip(resolve_problem(settle_plan(problem, plan.tasks)).tasks, plan.tasks, strict=True)
    ]
    values = {
        "measure": {"name": MEASURES[problem.objective], "kind": problem.objective, **BETTER[problem.objective]},
        "objective": plan.objective,
        "lower_bound": plan.lower_bound,
        "gap": plan.gap,
        "status": plan.status,
        "k": problem.edge_rounds_per_cloud_round,
        "tasks": tasks,
        "links": links,
        "parts": _parts(problem, plan),
        "vehicles": _vehicles(problem, compared.shares),
        "horizon_s": problem.horizon_s,
        "trains": trains(problem),
        "robust": problem.robust,
        "note": plan.note,
        "warnings": plan.warnings,
        "words": {"steps": STEPS, "curve": CURVE, "terms": _terms(problem, plan)},
        "others": [
            {"name": BASELINE_NAMES[other.name], "objective": other.objective, "note": other.note}
            for other in compared.baselines
        ],
    }
    return values | {"sentences": _sentences(values, compared.sweeps["both links"])}


def _terms(problem: Problem, plan: Allocation) -> dict[str, str]:
    """Return the terms that the page defines, with their definitions."""
    measure = MEASURES[problem.objective]
    saved = "gained" if problem.objective == "area" else "saved"
    terms = {"error": TERMS["error"], measure: explain_objective(problem, plan.objective), "budget": TERMS["budget"]}
    terms[saved] = TERMS["saved"]
    used = (
        ["band"] * any(row.accuracy_low is not None for row in plan.tasks)
        + ["up to"] * problem.robust
        + ["proven"] * (plan.lower_bound is not None)
    )
    return terms | {name: TERMS[name] for name in used}


def _parts(problem: Problem, plan: Allocation) -> list[plans.StageTraffic]:
    """Return megabytes by link, task and stage; tasks beyond the `SHOWN` largest are one part."""
    ordered = sorted(plan.tasks, key=lambda row: -(row.wireless_mb + row.wireline_mb))
    shown = {row.name for row in ordered[: SHOWN if len(ordered) > SHOWN + 1 else len(ordered)]}
    others = f"{len(ordered) - len(shown)} other tasks"
    totals: dict[tuple[str, str, str], float] = {}
    for task, row in zip(settle_plan(problem, plan.tasks).tasks, plan.tasks, strict=True):
        for stage, cost in _stage_prices(problem, task, row).items():
            for link in LINKS:
                key = (link, row.name if row.name in shown else others, stage)
                totals[key] = totals.get(key, 0.0) + getattr(cost, f"{link}_mb")
    return [{"link": link, "task": task, "stage": stage, "mb": mb} for (link, task, stage), mb in totals.items()]


def _stage_prices(problem: Problem, task: AllocationTask, row: TaskAllocation) -> dict[str, LinkMegabytes]:
    none = StagePlan(0, 0, 0, task.edge_groups, problem.edge_rounds_per_cloud_round, row.called)
    return {name: price(replace(none, **{field: getattr(row, field)}), task.sizes) for field, name in STAGES.items()}


def _vehicles(problem: Problem, shares: Shares) -> list[dict[str, Any]]:
    """Return a row per vehicle: samples and rounds of all tasks, uplink [MB], and time of sending and training [s]."""
    rows: dict[str, dict[str, Any]] = {}
    for task in problem.tasks:
        for share in shares.get(task.name, ()):
            mbps = None if task.uplink_mbps is None else task.uplink_mbps[share.vehicle].wireless
            empty = {"vehicle": share.vehicle, "mbps": mbps, "mb": 0.0, "busy_s": 0.0, "parts": []}
            row = rows.setdefault(share.vehicle, empty)
            row["mb"] += share.wireless_mb
            row["busy_s"] += share.busy_s
            row["parts"].append({"task": task.name, "samples": share.samples, "rounds": len(share.rounds)})
    most = {task: max(len(share.rounds) for share in of_task) for task, of_task in shares.items()}
    for row in rows.values():
        row["missed"] = sum(most[part["task"]] - part["rounds"] for part in row["parts"])
    return list(rows.values())


def _sentences(values: Mapping[str, Any], both: Sequence[BudgetPoint]) -> dict[str, str]:
    return {
        "proof": _proof(values),
        "links": " ".join(_link(name, link, values["measure"]["verb"]) for name, link in values["links"].items()),
        "stages": _stages(values["parts"]),
        "budgets": _budgets(values["measure"]["name"], values["objective"], both),
        "others": _others(values),
        "vehicles": _stragglers(values["vehicles"], values["horizon_s"], values["trains"]),
    }


def _proof(values: Mapping[str, Any]) -> str:
    if values["lower_bound"] is None:
        return "Nothing is proven of it: it is the best of several local optima."
    bound = f"no plan within these budgets has less than {values['lower_bound']:.4g}"
    near = f", and this one has at most {100 * values['gap']:.2g} % more" if values["gap"] > 1e-9 else ""
    return f"This is proven for the fitted curves: {bound}{near}."


def _link(name: str, link: Mapping[str, Any], verb: str) -> str:
    """Return the sentence on the use of a budget and on the gain of a larger one."""
    used = f"{link['used_mb']:,.0f} of {link['budget_mb']:,.0f} MB of the {name} budget are used"
    if not any(step["saved"] for step in link["more"]):
        most = max(step["added"] for step in link["more"])
        return f"{used}; up to {most:.0%} more of it would not {verb}."
    by = " or ".join(f"{step['saved']:.2g} ({step['added']:.0%} more)" for step in link["more"])
    return f"{used}; more of it would {verb} by {by}."


def _others(values: Mapping[str, Any]) -> str:
    """Return the sentence that compares the plan with the best of the simpler plans that are feasible."""
    larger = values["measure"]["kind"] == "area"
    carried = [other for other in values["others"] if other["note"] is None]
    if not carried:
        return "None of the simpler plans can be carried out: they know the budgets alone, not what each vehicle sends."
    best = (max if larger else min)(carried, key=lambda other: other["objective"])
    behind = (values["objective"] - best["objective"]) * (1 if larger else -1)
    name = f"The best of the simpler plans is “{best['name']}”"
    if behind > 0:
        return f"{name}, with {best['objective']:.4g}: {behind / values['objective']:.2%} behind this plan."
    return f"{name}, with {best['objective']:.4g}: no worse than this plan."


def _stages(parts: Sequence[Mapping[str, Any]]) -> str:
    sentences = []
    for link in LINKS:
        by_stage: dict[str, float] = {}
        for part in parts:
            if part["link"] == link:
                by_stage[part["stage"]] = by_stage.get(part["stage"], 0.0) + part["mb"]
        total = sum(by_stage.values())
        split = ", ".join(f"{mb / total:.0%} {stage}" for stage, mb in by_stage.items() if mb > 0)
        sentences.append(f"Of what goes over the {link} link: {split}." if total else f"Nothing goes over {link}.")
    return " ".join(sentences)


def _budgets(measure: str, objective: float, both: Sequence[BudgetPoint]) -> str:
    at = {point.factor: point.objective for point in both}
    half = "With half of both budgets no plan fits the limits"
    if 0.5 in at:
        half = f"With half of both budgets the {measure} would be {at[0.5]:.4f}"
    return f"{half}; with these it is {objective:.4f}; with double, {at[2.0]:.4f}."


def _stragglers(vehicles: Sequence[Mapping[str, Any]], horizon_s: float | None, trains: bool) -> str:
    if not vehicles:
        return ""
    missing = [row for row in vehicles if row["missed"]]
    slowest = max(vehicles, key=lambda row: row["busy_s"])
    of, whose, cause = "links", "link is that of", "its link cannot carry them"
    if trains:
        of, whose, cause = "vehicles", "vehicle is", "its time is too short for them"
    within = f", within the {horizon_s:,.0f} s that {of} may be busy" if horizon_s is not None else ""
    busy = f"The busiest {whose} {slowest['vehicle']}: {slowest['busy_s']:,.0f} s{within}."
    if not missing:
        return f"Every vehicle joins every round. {busy}"
    names = ", ".join(f"{row['vehicle']} ({row['missed']})" for row in missing)
    return f"Rounds that a vehicle leaves out because {cause}: {names}. {busy}"
