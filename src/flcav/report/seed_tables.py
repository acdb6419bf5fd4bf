"""Markdown tables and picture of a recipe run with several seeds (`flcav run --seeds`)."""

from collections.abc import Sequence

import numpy as np

from flcav.report import style
from flcav.report.charts import figures
from flcav.report.run_tables import LABELS, judge_anew
from flcav.runs.analysis.claims import word_claim
from flcav.runs.analysis.costs import list_home_costs
from flcav.runs.arms import resolve_settings
from flcav.runs.recipe import MAIN, PRETRAIN
from flcav.runs.results.run import Run, Summary
from flcav.runs.results.tests import Difference
from flcav.statistics.estimates import Estimate
from flcav.storage.markdown import format_table
from flcav.storage.records import select


def tables(runs: Sequence[Run], summary: Summary) -> dict[str, str]:
    """Return Markdown tables by name: claims with their counts of verdicts, seeds, means over seeds, label quality."""
    return {"claims": _claims(summary), "seeds": _seeds(runs), "means": _means(summary), "labels": _labels(runs)}


def _claims(summary: Summary) -> str:
    rows = [
        [claim.question, claim.place, claim.kind or "", claim.held, claim.did_not_hold, claim.undecided]
        for claim in summary.claims
    ]
    return format_table(("claim", "region, task", "kind", "held", "did not hold", "undecided"), rows)


def _list_primary(run: Run) -> list[tuple[Difference, str]]:
    """Return the differences of a run's primary claims with their verdicts; the first difference without any."""
    judged = list(zip(select(run.differences, arm=MAIN), judge_anew(run), strict=True))
    primary = [(difference, finding.verdict) for difference, finding in judged if finding.kind == "primary"]
    return primary or [(difference, finding.verdict) for difference, finding in judged[:1]]


def _seeds(runs: Sequence[Run]) -> str:
    """Return a row per seed: the measure after every stage, primary claims, cost at home, and uplink [MB]."""
    one = runs[0]
    rows = []
    stages = tuple(dict.fromkeys((PRETRAIN, *(stage.stage for stage in one.arms[MAIN].stages))))
    for run in runs:
        reached = [f"{_mean(run, stage):.3f}" for stage in stages]
        claims = [f"{claim.estimate.describe(sign=True)} {verdict}" for claim, verdict in _list_primary(run)]
        home = [cost.difference.describe(sign=True) for cost in list_home_costs(run)]
        used = (f"{use.used_mb:.1f}" for use in run.arms[MAIN].links.values())
        rows.append([run.recipe.seed, *reached, *claims, *home, *used])
    head = (
        "seed",
        *stages,
        *(claim.name for claim, _ in _list_primary(one)),
        *(f"{cost.region}, {cost.measure}: edge + cloud FL - pretrained" for cost in list_home_costs(one)),
        *(f"{link} MB" for link in one.arms[MAIN].links),
    )
    return format_table(head, rows)


def _mean(run: Run, stage: str) -> float:
    """Return the mean of the measure over the run's trainings and federating regions."""
    tests = select(run.tested, arm=MAIN, stage=stage, region=run.recipe.with_role("federate"))
    return float(np.mean([np.mean(test.trainings) for test in tests]))


def _means(summary: Summary) -> str:
    rows = [
        [mean.name, mean.estimate.describe(sign=True), mean.kind or "", mean.judged.verdict if mean.judged else ""]
        for mean in summary.differences
    ]
    return format_table(("region, task: after - before", "mean over seeds", "kind", "verdict"), rows)


def _labels(runs: Sequence[Run]) -> str:
    """Return the label quality of the first round in each region: mean, least and greatest over seeds."""
    rows = []
    for region in runs[0].recipe.with_role("federate"):
        stages = [stage for run in runs for stage in select(run.arms[MAIN].stages, region=region)]
        first = [stage.labels[0] for stage in stages if stage.labels]
        columns = ([getattr(quality, field) for quality in first] for field in LABELS.values())
        known = [[value for value in column if value is not None] for column in columns]
        cells = [
            f"{np.mean(values):.2f} ({min(values):.2f} to {max(values):.2f})" if values else "" for values in known
        ]
        rows += [[region, sum(quality.targets for quality in first), *cells]] if first else []
    return format_table(("region", "objects", *LABELS), rows)


def draw_seeds(runs: Sequence[Run]) -> bytes:
    """Return a PNG of the differences of the primary claims and of the dearest cost at home, a row per seed.

    A claim of arms that do not differ up to its stage, in no seed, is left out if there are others.
    """
    panels: dict[str, dict[str, Estimate]] = {}
    settings = resolve_settings(runs[0].recipe)
    for run in runs:
        seed = f"seed {run.recipe.seed}"
        for difference, _ in _list_primary(run):
            claim = word_claim(difference, run.recipe, settings)
            panels.setdefault(f"{claim}:\n{run.tested[0].measure} in {difference.region}", {})[seed] = (
                difference.estimate
            )
    panels = {title: rows for title, rows in panels.items() if any(each.mean for each in rows.values())} or panels
    mean = {(row.region, row.task, row.measure): 0.0 for row in list_home_costs(runs[0])}
    for run in runs:
        for row in list_home_costs(run):
            mean[row.region, row.task, row.measure] += row.difference.mean / len(runs)
    if mean:
        dearest = min(mean, key=lambda key: mean[key])
        costs = {
            f"seed {run.recipe.seed}": row.difference
            for run in runs
            for row in list_home_costs(run)
            if (row.region, row.task, row.measure) == dearest
        }
        panels[f"The price, after cloud FL:\n{dearest[2]} at home in {dearest[0]}"] = costs
    return style.png(figures.seeds(panels))
