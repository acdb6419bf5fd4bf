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
    """Return Markdown by name: findings (a list), tests, differences, plan, budgets, sensors, labels, what cloud rounds
    do, rounds of vehicles on a network, spread of retraining.

    Findings are judged again by the current rules and the current table of the spread of retraining, so that older
    results are judged like newer ones.
    """
    if run.recipe.spread is not None and not run.recipe.retrainings:
        run = widen_anew(run, read_spreads(run.recipe.spread, Path()))
    judged = judge_anew(run)
    own = {
        "findings": format_bullets(f"*{each.question}* **{each.decision}**. {each.sentence}" for each in judged),
        "tests": _tests(run),
        "differences": _differences(run),
        "plan": _plan(run),
        "budgets": _budgets(run),
        "home": _home(run),
        **cloud_tables(run),
    }
    own |= {"sensors": _sensors(run)} if any(each.chosen for each in run.arms[MAIN].placed) else {}
    own |= {"labels": labels} if (labels := _labels(run)) else {}
    own |= {} if run.recipe.federation.network is None else {"rounds": _rounds(run)}
    return own | {"spread": _spread(run)} if run.recipe.retrainings else own


def judge_anew(run: Run) -> tuple[RunFinding, ...]:
    """Return the findings of a run's results by the present rules; those that it was saved with may be older."""
    settings = resolve_settings(run.recipe)
    caveats = {task: LABEL_SOURCES[kind].caveat for task, kind in settings[MAIN].labels.items()}
    return findings(run.differences, run.tested, run.arms, settings, run.recipe, caveats)


def _tests(run: Run) -> str:
    """Return each task's measure with its interval in every region, a column per arm and stage."""
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
    """Return what federated learning costs in the towns of pretraining."""
    rows = [
        [
            *(each.region, each.task, each.measure, f"{each.before:.3f}", f"{each.after:.3f}"),
            each.difference.describe(sign=True) + ("" if each.difference.low is not None else ", no interval"),
            each.trainings,
        ]
        for each in list_home_costs(run)
    ]
    heads = ("town of pretraining", "task", "measure", "pretrained", "after FL", "difference", "trainings")
    return format_table(heads, rows)


def _differences(run: Run) -> str:
    rows = [[each.name, each.estimate.describe(sign=True)] for each in run.differences]
    return format_table(("region, task: after - before", "difference"), rows)


def _spread(run: Run) -> str:
    """Return how each measure and difference varies over the run's trainings on the same frames."""
    figures = {each.name: each.trainings for each in (*run.tested, *run.differences)}
    rows = [
        [name, f"{np.mean(values):.3f}", f"{np.std(values, ddof=1):.4f}", f"{min(values):.3f}", f"{max(values):.3f}"]
        for name, values in figures.items()
        if len(values) > 1
    ]
    return format_table(("figure", "mean", "sd of retraining", "least", "most"), rows)


def _plan(run: Run) -> str:
    """Return every plan of each task: when it was made, from which score on validation frames, and what it predicts."""
    rows = []
    made = {None: "before the run", PRETRAIN: "after stage I", EDGE: "after stage II"}
    for task in run.recipe.tasks:
        for plan in run.arms[MAIN].plans:
            own = plan.tasks[task]
            if own.predicted is None and plan.after is not None:
                continue
            source = "fixed by hand" if own.predicted is None else f"planned: {own.predicted['cloud']:.3f}"
            reached = f"{plan.reached[task]:.3f}" if plan.reached else ""
            counts = (own.samples, own.edge_rounds, own.cloud_rounds)
            sizes = (f"{mb:.3f}" for mb in (own.sample_mb, own.model_mb))
            megabytes = (f"{own.wireless_mb:.1f}", f"{own.wireline_mb:.1f}")
            rows.append([task, made[plan.after], reached, *counts, *sizes, *megabytes, source])
    header = ("samples", "edge rounds", "cloud rounds", "sample MB", "network MB", "wireless MB", "wireline MB")
    return format_table(("task", "made", "reached", *header, "predicted"), rows)


def _budgets(run: Run) -> str:
    """Return the traffic of both uplinks [MB]: budget, planned, used, and each task's part of what was used."""
    main, rows = run.arms[MAIN], []
    for link in LINKS:
        use = main.links[link]
        whole = (f"{mb:.1f}" for mb in (use.budget_mb, use.planned_mb, use.used_mb))
        rows.append([link, *whole, *(f"{main.sent_mb(task, link):.1f}" for task in main.plan.tasks)])
    return format_table(("uplink", "budget MB", "planned MB", "used MB", *main.plan.tasks), rows)


def _rounds(run: Run) -> str:
    """Return each vehicle's rounds on the radio network: planned, combined, failed with reasons, and their time [s]."""
    main, rows = run.arms[MAIN], []
    for task, plan in main.plan.tasks.items():
        records = [record for stage in select(main.stages, task=task) for record in stage.records or ()]
        rounds = [record for record in records if record.server != CLOUD]
        asked = {*(plan.joins or ()), *(name for each in rounds for name in (*each.clients, *each.failed))}
        for name in sorted(asked):
            region, _, vehicle = name.partition("/")
            held = select(rounds, server=region)
            joined = [each for each in held if name in each.clients or name in each.failed]
            lost = Counter(each.failed[name] for each in joined if name in each.failed)
            rows.append(
                [
                    *(task, name, f"{run.recipe.speeds(region).get(vehicle, 1.0):g}"),
                    len(held) if plan.joins is None else len(plan.joins[name]),
                    sum(name in each.clients for each in joined),
                    ", ".join(f"{times} {reason}" for reason, times in lost.items()),
                    f"{sum(each.seconds or 0.0 for each in joined):.1f}",
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
    settings, rows, kinds = resolve_settings(run.recipe), [], []
    for name, arm in run.arms.items():
        for stage in arm.stages:
            own = stage.labels or ()
            for quality in dict.fromkeys((*own[:1], *own[-1:])):
                counts = quality.round, quality.labels, quality.targets
                known = quality.by_returns or ()  # missing in older results
                kinds = kinds or [f"recall from {each.returns} returns" for each in known]
                shares = [getattr(quality, field) for field in LABELS.values()]
                shares += [each.found / each.targets if each.targets else None for each in known]
                cells = ["" if share is None else f"{share:.2f}" for share in shares]
                rows.append([stage.region, settings[name].labels[stage.task], *counts, *cells])
    heads = ("region", "labels", "before round", "number", "objects", *LABELS, *kinds)
    return format_table(heads, rows) if rows else None


def _sensors(run: Run) -> str:
    rows = []
    for each in run.arms[MAIN].placed:
        chosen, covered = ", ".join(map(str, each.chosen)), f"{each.covered} of {each.errors}"
        rows.append([each.region, len(each.poles), chosen, covered, each.densest])
    return format_table(("region", "candidate poles", "chosen", "errors covered", "densest traffic"), rows)
