"""Markdown tables and the picture of a recipe that was run with several seeds (`flcav run --seeds`)."""

from collections.abc import Sequence

import numpy as np

from flcav.report import style
from flcav.report.charts import figures
from flcav.report.run_tables import LABELS, judge_anew
from flcav.runs.analysis.costs import list_home_costs
from flcav.runs.recipe import MAIN, PRETRAIN
from flcav.runs.results.run import Run, Summary
from flcav.runs.results.tests import Difference
from flcav.statistics.estimates import Estimate
from flcav.storage.markdown import format_table
from flcav.storage.records import select


def tables(runs: Sequence[Run], summary: Summary) -> dict[str, str]:
    """Return Markdown by name: claims with the numbers of seeds that decide them, seeds, means over seeds, labels."""
    return {"claims": _claims(summary), "seeds": _seeds(runs), "means": _means(summary), "labels": _labels(runs)}


def _claims(summary: Summary) -> str:
    rows = [
        [each.question, each.place, each.kind or "", each.held, each.did_not_hold, each.undecided]
        for each in summary.claims
    ]
    return format_table(("claim", "region, task", "kind", "held", "did not hold", "undecided"), rows)


def _list_primary(run: Run) -> list[tuple[Difference, str]]:
    """Return the differences that a run's primary claims are of, each with its verdict; without any its first."""
    judged = list(zip(select(run.differences, arm=MAIN), judge_anew(run), strict=True))
    primary = [(each, finding.verdict) for each, finding in judged if finding.kind == "primary"]
    return primary or [(each, finding.verdict) for each, finding in judged[:1]]


def _seeds(runs: Sequence[Run]) -> str:
    """Return the measure of each seed after every stage, its primary claims, the cost at home, and bytes."""
    one, rows = runs[0], []
    stages = tuple(dict.fromkeys((PRETRAIN, *(each.stage for each in one.arms[MAIN].stages))))
    for run in runs:
        reached = [f"{_mean(run, stage):.3f}" for stage in stages]
        claims = [f"{each.estimate.describe(sign=True)} {verdict}" for each, verdict in _list_primary(run)]
        home = [each.difference.describe(sign=True) for each in list_home_costs(run)]
        used = (f"{use.used_mb:.1f}" for use in run.arms[MAIN].links.values())
        rows.append([run.recipe.seed, *reached, *claims, *home, *used])
    head = (
        "seed",
        *stages,
        *(each.name for each, _ in _list_primary(one)),
        *(f"{each.region}, {each.measure}: edge + cloud FL - pretrained" for each in list_home_costs(one)),
        *(f"{link} MB" for link in one.arms[MAIN].links),
    )
    return format_table(head, rows)


def _mean(run: Run, stage: str) -> float:
    """Return the mean of the measure over the run's trainings and the regions that federate."""
    tests = select(run.tested, arm=MAIN, stage=stage, region=run.recipe.with_role("federate"))
    return float(np.mean([np.mean(test.trainings) for test in tests]))


def _means(summary: Summary) -> str:
    rows = [
        [each.name, each.estimate.describe(sign=True), each.kind or "", each.judged.verdict if each.judged else ""]
        for each in summary.differences
    ]
    return format_table(("region, task: after - before", "mean over seeds", "kind", "verdict"), rows)


def _labels(runs: Sequence[Run]) -> str:
    """Return the quality of the labels of the first round in each region: mean over seeds, least and most."""
    rows = []
    for region in runs[0].recipe.with_role("federate"):
        stages = [stage for run in runs for stage in select(run.arms[MAIN].stages, region=region)]
        first = [stage.labels[0] for stage in stages if stage.labels]
        columns = ([getattr(quality, field) for quality in first] for field in LABELS.values())
        known = [[value for value in column if value is not None] for column in columns]
        cells = [f"{np.mean(own):.2f} ({min(own):.2f} to {max(own):.2f})" if own else "" for own in known]
        rows += [[region, sum(quality.targets for quality in first), *cells]] if first else []
    return format_table(("region", "objects", *LABELS), rows)


def draw_seeds(runs: Sequence[Run]) -> bytes:
    """Return a PNG of the differences of the primary claims, a row per seed."""
    panels: dict[str, dict[str, Estimate]] = {}
    for run in runs:
        for each, _ in _list_primary(run):
            panels.setdefault(each.name, {})[f"seed {run.recipe.seed}"] = each.estimate
    return style.png(figures.arms(panels, f"difference in {runs[0].tested[0].result.measure} (95 % interval)"))
