"""The claims of a run as rows of one table, in the words of a colleague."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from flcav.runs.analysis.findings import judge_differences
from flcav.runs.arms import Setting, resolve_settings
from flcav.runs.recipe import ALL, CENTRAL, CLOUD, EDGE, MAIN, MORE_EDGE, PRETRAIN, RunRecipe
from flcav.runs.results.run import Run
from flcav.runs.results.tests import Difference
from flcav.statistics.estimates import Estimate
from flcav.statistics.verdicts import ESTIMATE
from flcav.storage.records import select

NAMES = {
    PRETRAIN: "Pretraining",
    EDGE: "Edge FL",
    CLOUD: "Cloud FL",
    CENTRAL: "Central training",
    MORE_EDGE: "Further edge FL",
}
BY_TASK = ("labels", "plan")  # settings whose fields are tasks
LONGEST = 60  # characters of the settings of an arm that are named; the name of others is


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
    if each.before_arm == MAIN:
        if each.stage == EDGE:
            return f"{ours} beats the pretrained network"
        if each.before_stage == EDGE:
            return f"{ours} adds to edge FL"
        home = recipe.regions[each.region].role == "pretrain"
        return f"{ours} helps {'at home' if home else 'where no vehicle learned'}, too"
    other = word_arm(settings[MAIN], settings[each.before_arm], recipe, each)
    return f"{ours} against {other}, an upper bound" if loss else f"{ours} beats {other}"


def word_arm(main: Setting, other: Setting, recipe: RunRecipe, each: Difference) -> str:
    """Return what an arm is, in words: its training, its poles, its labels, or else its settings or its name."""
    if other.central == "pretrain":
        return "central training for as many steps"
    if other.central == "federate":
        return "central training on the true labels of its vehicles"
    if other.central == ALL:
        return "central training on the true labels of all towns"
    if main.placement.rule != other.placement.rule:
        poles = {"none": "no pole", "densest": "the pole with the densest traffic", "random": "a random pole"}
        if other.placement.rule in poles:
            return poles[other.placement.rule]
    if (main.labels[each.task], other.labels[each.task]) == ("road", "ideal-road"):
        return "labels of an ideal road detector"
    told = ", ".join(_list_settings(recipe.arms[other.name].model_dump(exclude_unset=True, mode="json")))
    return f"the same with {told}" if 0 < len(told) <= LONGEST else f"the arm {other.name}"


def _list_settings(given: Mapping[str, Any], outer: str = "") -> Iterator[str]:
    """Yield the settings of an arm as "name value", without those of which stages and regions it has.

    A setting by task, such as the labels, has its name in place of the task's.
    """
    for name, value in given.items():
        if isinstance(value, Mapping) and value:
            yield from _list_settings(value, name)
        elif name not in ("stages", "regions"):
            told = outer if outer in BY_TASK else name
            listed = ", ".join(map(str, value)) if isinstance(value, list) else value
            yield told.replace("_", " ") if value in ({}, True) else f"{told.replace('_', ' ')} {listed}"


def _mean(run: Run, each: Difference, arm: str, stage: str) -> float:
    """Return the mean over regions of one side of a difference; arms share tests with the run itself."""
    tests = [
        (select(run.tested, arm=arm, stage=stage, task=each.task, region=region)
         or select(run.tested, arm=MAIN, stage=stage, task=each.task, region=region))[0]
        for region in each.places
    ]  # fmt: skip
    return float(np.mean([test.estimate.mean for test in tests]))
