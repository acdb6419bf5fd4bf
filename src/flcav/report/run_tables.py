"""Markdown tables of a run's results."""

from collections import Counter
from pathlib import Path

import numpy as np

from flcav.federation.state import FAILED
from flcav.network.ledger import LINKS
from flcav.report.cloud_rounds import cloud_tables
from flcav.runs.analysis.costs import list_home_costs
from flcav.runs.analysis.findings import findings
from flcav.runs.arms import resolve_settings
from flcav.runs.label_sources import LABEL_SOURCES
from flcav.runs.recipe import CLOUD, EDGE, MAIN, PRETRAIN
from flcav.runs.results.run import Run
from flcav.runs.results.tests import RunFinding
from flcav.runs.spread import read_spreads, widen_anew
from flcav.storage.markdown import format_bullets, format_table
from flcav.storage.records import select


def tables(run: Run) -> dict[str, str]:
    """Return Markdown by name: findings (a list), and tables of tests, differences, plan, budgets, sensors and labels.

    There are further tables of cloud rounds, of vehicles' rounds on a network, and of the spread of retraining, if the
    run has them. Findings are judged by the current rules and spread of retraining, so that older results are judged
    like newer ones.
    """
    if run.recipe.spread is not None and not run.recipe.retrainings:
        run = widen_anew(run, read_spreads(run.recipe.spread, Path()))
    judged = judge_anew(run)
    markdown = {
        "findings": format_bullets(
            f"*{finding.question}* **{finding.decision}**. {finding.sentence}" for finding in judged
        ),
        "tests": _tests(run),
        "differences": _differences(run),
        "plan": _plan(run),
        "budgets": _budgets(run),
        "home": _home(run),
        **cloud_tables(run),
    }
    markdown |= {"sensors": _sensors(run)} if any(placed.chosen for placed in run.arms[MAIN].placed) else {}
    markdown |= {"labels": labels} if (labels := _labels(run)) else {}
    markdown |= {} if run.recipe.federation.network is None else {"rounds": _rounds(run)}
    return markdown | {"spread": _spread(run)} if run.recipe.retrainings else markdown


def judge_anew(run: Run) -> tuple[RunFinding, ...]:
    """Return the findings of a run's results by the current rules, in place of those saved with the run."""
    settings = resolve_settings(run.recipe)
    caveats = {task: LABEL_SOURCES[kind].caveat for task, kind in settings[MAIN].labels.items()}
    return findings(run.differences, run.tested, run.arms, settings, run.recipe, caveats)


def _tests(run: Run) -> str:
    """Return the tests: a row per task and region, with the measure and its interval after every arm and stage."""
    columns = list(dict.fromkeys(test.network for test in run.tested))
    rows = []
    for task in run.recipe.tasks:
        for region, settings in run.recipe.regions.items():
            tests = select(run.tested, task=task, region=region)
            reached = {test.network: test.estimate.describe() for test in tests}
            one = tests[0].result
            place = [task, f"{region} ({settings.role})", one.measure, f"{one.frames} / {one.scenes}"]
            rows.append([*place, *(reached.get(column, "") for column in columns)])
    return format_table(("task", "region (role)", "measure", "frames / scenes", *columns), rows)


def _home(run: Run) -> str:
    """Return the change of each measure in the towns of pretraining by federated learning."""
    rows = [
        [
            *(cost.region, cost.task, cost.measure, f"{cost.before:.3f}", f"{cost.after:.3f}"),
            cost.difference.describe(sign=True) + ("" if cost.difference.low is not None else ", no interval"),
            cost.trainings,
        ]
        for cost in list_home_costs(run)
    ]
    heads = ("town of pretraining", "task", "measure", "pretrained", "after FL", "difference", "trainings")
    return format_table(heads, rows)


def _differences(run: Run) -> str:
    rows = [[difference.name, difference.estimate.describe(sign=True)] for difference in run.differences]
    return format_table(("region, task: after - before", "difference"), rows)


def _spread(run: Run) -> str:
    """Return mean and spread of each measure and difference over the run's trainings, on the same frames."""
    figures = {figure.name: figure.trainings for figure in (*run.tested, *run.differences)}
    rows = [
        [name, f"{np.mean(values):.3f}", f"{np.std(values, ddof=1):.4f}", f"{min(values):.3f}", f"{max(values):.3f}"]
        for name, values in figures.items()
        if len(values) > 1
    ]
    return format_table(("figure", "mean", "sd of retraining", "least", "most"), rows)


def _plan(run: Run) -> str:
    """Return the plans of each task: when they were made, from which validation score, and the predicted score."""
    rows = []
    made = {None: "before the run", PRETRAIN: "after stage I", EDGE: "after stage II"}
    for task in run.recipe.tasks:
        for plan in run.arms[MAIN].plans:
            planned = plan.tasks[task]
            if planned.predicted is None and plan.after is not None:
                continue
            source = "fixed by hand" if planned.predicted is None else f"planned: {planned.predicted['cloud']:.3f}"
            reached = f"{plan.reached[task]:.3f}" if plan.reached else ""
            counts = (planned.samples, planned.edge_rounds, planned.cloud_rounds)
            sizes = (f"{mb:.3f}" for mb in (planned.sample_mb, planned.model_mb))
            megabytes = (f"{planned.wireless_mb:.1f}", f"{planned.wireline_mb:.1f}")
            rows.append([task, made[plan.after], reached, *counts, *sizes, *megabytes, source])
    header = ("samples", "edge rounds", "cloud rounds", "sample MB", "network MB", "wireless MB", "wireline MB")
    return format_table(("task", "made", "reached", *header, "predicted"), rows)


def _budgets(run: Run) -> str:
    """Return the traffic of both uplinks [MB]: budget, planned, used, and used by each task."""
    main = run.arms[MAIN]
    rows = []
    for link in LINKS:
        use = main.links[link]
        whole = (f"{mb:.1f}" for mb in (use.budget_mb, use.planned_mb, use.used_mb))
        rows.append([link, *whole, *(f"{main.sent_mb(task, link):.1f}" for task in main.plan.tasks)])
    return format_table(("uplink", "budget MB", "planned MB", "used MB", *main.plan.tasks), rows)


def _rounds(run: Run) -> str:
    """Return the rounds of each vehicle on the network: planned, aggregated, failed with reasons, and duration [s]."""
    main = run.arms[MAIN]
    rows = []
    for task, plan in main.plan.tasks.items():
        records = [record for stage in select(main.stages, task=task) for record in stage.records or ()]
        rounds = [record for record in records if record.server != CLOUD]
        clients = {*(plan.joins or ()), *(name for record in rounds for name in (*record.clients, *record.failed))}
        for name in sorted(clients):
            region, _, vehicle = name.partition("/")
            held = select(rounds, server=region)
            joined = [record for record in held if name in record.clients or name in record.failed]
            lost = Counter(record.failed[name] for record in joined if name in record.failed)
            rows.append(
                [
                    *(task, name, f"{run.recipe.speeds(region).get(vehicle, 1.0):g}"),
                    len(held) if plan.joins is None else len(plan.joins[name]),
                    sum(name in record.clients for record in joined),
                    ", ".join(f"{times} {reason}" for reason, times in lost.items()),
                    f"{sum(record.seconds or 0.0 for record in joined):.1f}",
                ]
            )
    header = ("task", "vehicle", "speed", "rounds planned", "combined", FAILED, "time of its rounds, s")
    return format_table(header, rows)


LABELS = {  # heading -> field of `LabelQuality`
    "precision": "precision",
    "recall": "recall",
    "of the right ones, at IoU .7": "tight",
    "centre off by m": "offset_m",
    "size off by m": "size_m",
}


def _labels(run: Run) -> str | None:
    """Return the quality of the labels of edge FL before the first round and, if they are renewed, before the last."""
    settings = resolve_settings(run.recipe)
    rows, kinds = [], []
    for name, arm in run.arms.items():
        for stage in arm.stages:
            qualities = stage.labels or ()
            for quality in dict.fromkeys((*qualities[:1], *qualities[-1:])):
                counts = quality.round, quality.labels, quality.targets
                known = quality.by_returns or ()  # missing in older results
                kinds = kinds or [f"recall from {part.returns} returns" for part in known]
                shares = [getattr(quality, field) for field in LABELS.values()]
                shares += [part.found / part.targets if part.targets else None for part in known]
                cells = ["" if share is None else f"{share:.2f}" for share in shares]
                rows.append([stage.region, settings[name].labels[stage.task], *counts, *cells])
    heads = ("region", "labels", "before round", "number", "objects", *LABELS, *kinds)
    return format_table(heads, rows) if rows else None


def _sensors(run: Run) -> str:
    rows = []
    for placed in run.arms[MAIN].placed:
        chosen = ", ".join(map(str, placed.chosen))
        covered = f"{placed.covered} of {placed.errors}"
        rows.append([placed.region, len(placed.poles), chosen, covered, placed.densest])
    return format_table(("region", "candidate poles", "chosen", "errors covered", "densest traffic"), rows)
