"""The claims of a run as rows of one table, in the words of a colleague."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from flcav.runs.analysis.findings import NAMES, judge_differences, word_arm
from flcav.runs.arms import Setting, resolve_settings
from flcav.runs.recipe import EDGE, MAIN, RunRecipe
from flcav.runs.results.run import Run
from flcav.runs.results.tests import Difference
from flcav.statistics.estimates import Estimate
from flcav.statistics.verdicts import ESTIMATE
from flcav.storage.records import select


@dataclass(frozen=True)
class ClaimRow:
    """A claim with the paired difference behind it, on the same test frames and trainings."""

    claim: str
    place: str  # region, or regions of a mean
    task: str
    kind: str | None  # primary | secondary; None: the recipe names no primary claims
    measure: str
    before: float  # mean over regions and trainings
    after: float
    change: Estimate  # with its 95 % interval
    verdict: str  # held | did not hold | undecided | estimate
    needs: str  # what would decide it, as in "needs about 7 trainings on 37 scenes"; empty where it is decided
    sentence: str  # the finding in full


def list_claims(run: Run) -> list[ClaimRow]:
    """Return the claims of a run and its estimates of losses, in the order of its findings."""
    settings = resolve_settings(run.recipe)
    judged = judge_differences(run.differences, run.tested, run.arms, settings, run.recipe)
    rows = []
    for found, finding in zip(judged, run.findings, strict=False):
        each = found.difference
        open_ = finding.verdict not in (ESTIMATE,) and found.judged is not None
        rows.append(
            ClaimRow(
                claim=word_claim(each, run.recipe, settings, loss=found.asked.kind == "loss"),
                place=each.region,
                task=each.task,
                kind=finding.kind,
                measure=select(run.tested, task=each.task)[0].measure,
                before=_mean(run, each, each.before_arm, each.before_stage),
                after=_mean(run, each, each.arm, each.stage),
                change=each.estimate,
                verdict=finding.verdict,
                needs=found.judged.tell_needs("trainings") if open_ and found.judged else "",
                sentence=finding.sentence,
            )
        )
    return rows


def word_claim(each: Difference, recipe: RunRecipe, settings: Mapping[str, Setting], *, loss: bool = False) -> str:
    """Return a claim in words: what is better than what; of a loss to an upper bound what it is against."""
    ours = NAMES[each.stage]
    ours = ours[0].upper() + ours[1:]
    if each.before_arm == MAIN:
        if each.stage == EDGE:
            return f"{ours} beats the pretrained network"
        if each.before_stage == EDGE:
            return f"{ours} adds to edge FL"
        home = recipe.regions[each.region].role == "pretrain"
        return f"{ours} helps {'at home' if home else 'where no vehicle learned'}, too"
    other = word_arm(settings[MAIN], settings[each.before_arm], recipe, each)
    return f"{ours} against {other}, an upper bound" if loss else f"{ours} beats {other}"


def _mean(run: Run, each: Difference, arm: str, stage: str) -> float:
    """Return the mean over regions of one side of a difference; arms share tests with the run itself."""
    tests = [
        (select(run.tested, arm=arm, stage=stage, task=each.task, region=region)
         or select(run.tested, arm=MAIN, stage=stage, task=each.task, region=region))[0]
        for region in each.places
    ]  # fmt: skip
    return float(np.mean([test.estimate.mean for test in tests]))
