"""The page about a plan: everything it shows, computed from the problem and the plan."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import networkx as nx

from flcav.network.plan import MessageSizes, Price, StagePlan, price
from flcav.optimization.allocation import Allocation, TaskPlan
from flcav.optimization.baselines import baseline
from flcav.optimization.budget_sweep import FACTORS, LINKS, BudgetPoint, budget_sweep
from flcav.optimization.problem import Problem, Task
from flcav.optimization.vehicles import VehicleShare
from flcav.report import html, layers_chart, plan_charts, style

STAGES = {"samples": "samples", "edge_rounds": "edge rounds", "cloud_rounds": "cloud rounds"}
SHOWN = 6  # tasks with a colour of their own; the others are drawn as one
COARSE = (0.5, 1.0, 2.0)  # budgets that are tried where a plan takes seconds
MEASURES = {  # what the objective is called, and what more megabytes do to it
    "weighted": {
        "short": "error",
        "title": "predicted error",
        "better": "lower the error",
        "gain": "error saved",
    },
    "max-min": {
        "short": "largest error",
        "title": "largest predicted error",
        "better": "lower the largest error",
        "gain": "largest error saved",
    },
    "area": {
        "short": "area",
        "title": "area of the predicted accuracies",
        "better": "raise the area",
        "gain": "area gained",
    },
}
OTHERS = {
    "equal-stages": "equal shares for every stage",
    "equal-tasks": "equal shares for every task",
    "max-throughput": "most messages, whatever they teach",
    "article": "the continuous optimum, rounded down",
}
Shares = Mapping[str, Sequence[VehicleShare]]


def plan_page(problem: Problem, plan: Allocation, shares: Shares, graph: nx.Graph | None = None) -> str:
    """Return the page as HTML that needs nothing but itself; `graph`: what the problem was made from, if it was."""
    results = plan_results(problem, plan, shares)
    measure = results["measure"]
    pictures = {
        "megabytes": plan_charts.megabytes(results["parts"], results["links"]),
        "budgets": plan_charts.best_by_budget(results["sweep"], measure["short"]),
        "marginal": plan_charts.marginal_values(results["sweep"]["both links"], results["links"], measure["gain"]),
    }
    if graph is not None:
        pictures["layers"] = layers_chart.three_layers(graph)
    return html.render(results, {name: style.png(figure) for name, figure in pictures.items()}, "plan.html.j2")


def plan_results(problem: Problem, plan: Allocation, shares: Shares) -> dict[str, Any]:
    """Return what the page shows: numbers and sentences."""
    scaled = {"both links": LINKS, "wireless alone": ("wireless",), "wireline alone": ("wireline",)}
    factors = COARSE if problem.objective == "area" else FACTORS
    sweep = {name: budget_sweep(problem, links, factors) for name, links in scaled.items()}
    links = {
        link: {
            "budget_mb": getattr(problem.budgets_mb, link),
            "used_mb": getattr(plan.used_mb, f"{link}_mb"),
            "share": getattr(plan.used_mb, f"{link}_mb") / getattr(problem.budgets_mb, link),
            "marginal": getattr(plan.marginal_error_per_gb, f"{link}_mb"),
        }
        for link in LINKS
    }
    weights = sum(task.weight for task in problem.tasks)
    tasks = [
        {**asdict(row), "weight": task.weight, "vehicles": sum(task.edge_groups)}
        for task, row in zip(problem.tasks, plan.tasks, strict=True)
    ]
    values = {
        "measure": MEASURES[problem.objective] | {"kind": problem.objective},
        "objective": plan.objective,
        "lower_bound": plan.lower_bound,
        "gap": plan.gap,
        "status": plan.status,
        "weights": weights,
        "k": problem.edge_rounds_per_cloud_round,
        "tasks": tasks,
        "links": links,
        "parts": _parts(problem, plan),
        "sweep": {name: [asdict(point) for point in points] for name, points in sweep.items()},
        "vehicles": _vehicles(problem, shares),
        "horizon_s": problem.horizon_s,
        "robust": problem.robust,
        "note": plan.note,
        "warnings": plan.warnings,
        "others": [
            {"name": name, "objective": baseline(problem, key).objective}
            for key, name in OTHERS.items()
            if len(tasks) > 1 or key != "equal-tasks"
        ],
    }
    return values | {"sentences": _sentences(values, sweep["both links"])}


def _parts(problem: Problem, plan: Allocation) -> list[dict[str, Any]]:
    """Return megabytes by link, task and stage; tasks beyond the `SHOWN` largest are one."""
    ordered = sorted(plan.tasks, key=lambda row: -(row.wireless_mb + row.wireline_mb))
    shown = {row.name for row in ordered[: SHOWN if len(ordered) > SHOWN + 1 else len(ordered)]}
    others = f"{len(ordered) - len(shown)} other tasks"
    totals: dict[tuple[str, str, str], float] = {}
    for task, row in zip(problem.tasks, plan.tasks, strict=True):
        for stage, cost in _stage_prices(problem, task, row).items():
            for link in LINKS:
                key = (link, row.name if row.name in shown else others, stage)
                totals[key] = totals.get(key, 0.0) + getattr(cost, f"{link}_mb")
    return [{"link": link, "task": task, "stage": stage, "mb": mb} for (link, task, stage), mb in totals.items()]


def _stage_prices(problem: Problem, task: Task, row: TaskPlan) -> dict[str, Price]:
    sizes, k = MessageSizes(task.sample_mb, task.model_mb), problem.edge_rounds_per_cloud_round
    none = StagePlan(0, 0, 0, task.edge_groups, k)
    return {name: price(replace(none, **{field: getattr(row, field)}), sizes) for field, name in STAGES.items()}


def _vehicles(problem: Problem, shares: Shares) -> list[dict[str, Any]]:
    """Return a row per vehicle: what it uploads and joins for all tasks, and how long its wireless link is busy."""
    rows: dict[str, dict[str, Any]] = {}
    for task in problem.tasks:
        for share in shares.get(task.name, ()):
            mbps = (task.uplink_mbps or {})[share.vehicle].wireless
            row = rows.setdefault(share.vehicle, {"vehicle": share.vehicle, "mbps": mbps, "mb": 0.0, "parts": []})
            row["mb"] += share.wireless_mb
            row["parts"].append({"task": task.name, "samples": share.samples, "rounds": len(share.rounds)})
    most = {task: max(len(share.rounds) for share in own) for task, own in shares.items()}
    for row in rows.values():
        row["busy_s"] = 8 * row["mb"] / row["mbps"]
        row["missed"] = sum(most[part["task"]] - part["rounds"] for part in row["parts"])
    return list(rows.values())


def _sentences(values: Mapping[str, Any], both: Sequence[BudgetPoint]) -> dict[str, str]:
    return {
        "proof": _proof(values),
        "links": " ".join(_link(name, link, values["measure"]["better"]) for name, link in values["links"].items()),
        "stages": _stages(values["parts"]),
        "budgets": _budgets(values["measure"]["short"], values["objective"], both),
        "others": _others(values),
        "vehicles": _stragglers(values["vehicles"], values["horizon_s"]),
    }


def _proof(values: Mapping[str, Any]) -> str:
    if values["lower_bound"] is None:
        return "Nothing is proven of it: it is the best of several local optima."
    bound = f"no plan within these budgets has less than {values['lower_bound']:.6g}"
    near = f", and this one has at most {100 * values['gap']:.2g} % more" if values["gap"] > 0 else ""
    return f"This is proven: {bound}{near}."


def _link(name: str, link: Mapping[str, Any], better: str) -> str:
    used = f"{link['used_mb']:,.0f} of {link['budget_mb']:,.0f} MB of the {name} budget are used"
    if link["marginal"] > 0:
        return f"{used}; 1,000 MB more would {better} by about {link['marginal']:.2g}."
    return f"{used}; more of it would not {better}."


def _others(values: Mapping[str, Any]) -> str:
    """Return how the plan compares with the best of the simpler ones."""
    larger = values["measure"]["kind"] == "area"
    best = (max if larger else min)(values["others"], key=lambda other: other["objective"])
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


def _stragglers(vehicles: Sequence[Mapping[str, Any]], horizon_s: float | None) -> str:
    if not vehicles:
        return ""
    missing = [row for row in vehicles if row["missed"]]
    slowest = max(vehicles, key=lambda row: row["busy_s"])
    within = f", within the {horizon_s:,.0f} s that links may be busy" if horizon_s is not None else ""
    busy = f"The busiest link is that of {slowest['vehicle']}: {slowest['busy_s']:,.0f} s{within}."
    if not missing:
        return f"Every vehicle joins every round. {busy}"
    names = ", ".join(f"{row['vehicle']} ({row['missed']})" for row in missing)
    return f"Rounds that a vehicle leaves out because its link cannot carry them: {names}. {busy}"
