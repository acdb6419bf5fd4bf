"""The answer of a run to its question, whether vehicles can teach a network towns that it has never seen."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from flcav.network.ledger import LINKS
from flcav.runs.analysis.costs import list_home_costs
from flcav.runs.analysis.findings import OVER_EDGE, OVER_PRETRAINING
from flcav.runs.recipe import CLOUD, EDGE, MAIN, PRETRAIN
from flcav.runs.results.run import Run
from flcav.runs.results.tests import Difference, RunFinding, Test
from flcav.statistics.estimates import Estimate, average_estimates
from flcav.statistics.verdicts import HELD, NOT_HELD, signed
from flcav.storage.records import select

PRICE = ", at a price"
BEFORE = {EDGE: (PRETRAIN, OVER_PRETRAINING), CLOUD: (EDGE, OVER_EDGE)}  # stage: the one before, and the question

Claimed = tuple[Difference, RunFinding]  # a difference of the run itself, and the verdict on it


@dataclass(frozen=True)
class Answer:
    """A word or two that follow from the verdicts, and the sentences behind them."""

    word: str
    sentences: tuple[str, ...]


def tell_answer(run: Run) -> Answer | None:
    """Return the answer by the verdicts on edge FL against pretraining; None where a run has no such claim.

    A claim on the mean over regions counts in place of those of the regions. The price is a measure that fell in a town
    of pretraining, by more than its 95 % interval.
    """
    claims = {task: found for task in run.recipe.tasks if (found := _select_claims(run, task, EDGE))}
    if not claims:
        return None
    verdicts = {finding.verdict for found in claims.values() for _, finding in found}
    home = list_home_costs(run)
    if HELD in verdicts:
        word = "Yes" if verdicts == {HELD} else "In part"
        word += PRICE if any((row.difference.high or 0.0) < 0 for row in home) else ""
    else:
        word = "No" if verdicts == {NOT_HELD} else "This run cannot tell"
    sentences = [
        sentence
        for task, found in claims.items()
        for sentence in _tell(run, task, found, _select_claims(run, task, CLOUD))
    ]
    for region in dict.fromkeys(row.region for row in home):
        rows = select(home, region=region)
        changes = [f"{row.measure} of {row.task} from {row.before:.3f} to {row.after:.3f}" for row in rows]
        sentences.append(f"In {region}, where it was pretrained, federated learning took {' and '.join(changes)}.")
    return Answer(word, tuple(sentences))


@dataclass(frozen=True)
class StageMean:
    """A measure of a task after a stage, as the mean over the regions that federate and over trainings."""

    task: str
    network: str
    measure: str
    estimate: Estimate
    regions: tuple[str, ...]


def list_stage_means(run: Run) -> list[StageMean]:
    """Return the measure of each task after each stage."""
    means = []
    for task in run.recipe.tasks:
        for stage in (PRETRAIN, EDGE, CLOUD):
            tests = select(run.tested, arm=MAIN, stage=stage, task=task, region=run.recipe.with_role("federate"))
            if tests:
                regions = tuple(test.region for test in tests)
                estimate = average_estimates([test.estimate for test in tests])
                means.append(StageMean(task, tests[0].network, tests[0].measure, estimate, regions))
    return means


def _select_claims(run: Run, task: str, stage: str) -> list[Claimed]:
    """Return the claims that a stage is better than the one before, if there is one, of the mean over regions."""
    before, question = BEFORE[stage]
    verdicts = {finding.place: finding for finding in select(run.findings, question=question)}
    found = [
        (each, verdicts[place])
        for each in select(run.differences, arm=MAIN, before_arm=MAIN, stage=stage, before_stage=before, task=task)
        if (place := f"{each.region}, {each.task}") in verdicts
    ]
    return [claimed for claimed in found if claimed[0].regions is not None] or found


def _tell(run: Run, task: str, claims: Sequence[Claimed], later: Sequence[Claimed]) -> Iterator[str]:
    """Yield sentences on the stages of a task, by the claims of edge FL and those of cloud FL."""
    for each, finding in claims:
        before, after = (
            select(run.tested, arm=MAIN, stage=stage, task=task, region=each.places) for stage in (PRETRAIN, EDGE)
        )
        low, high = each.estimate.low, each.estimate.high
        interval = "" if low is None or high is None else f", 95 % interval {signed(low)} to {signed(high)}"
        yield (
            f"In {each.region}, edge FL took {after[0].measure} of {task} from {_average(before):.3f} to "
            f"{_average(after):.3f} ({finding.verdict}: {signed(each.estimate.mean)}{interval})."
        )
    yield f"This took {_sent(run, task, EDGE)} of uplink."
    if later:
        regions = tuple(region for each, _ in claims for region in each.places)
        mean = _average(select(run.tested, arm=MAIN, stage=CLOUD, task=task, region=regions))
        verdicts = ", ".join(f"{finding.verdict} in {each.region}" for each, finding in later)
        mean_of = "it" if len(claims) == 1 else "their mean"
        yield f"Cloud FL took {mean_of} to {mean:.3f} ({verdicts}), for {_sent(run, task, CLOUD)} more."


def _average(tests: Sequence[Test]) -> float:
    return float(np.mean([test.estimate.mean for test in tests]))


def _sent(run: Run, task: str, stage: str) -> str:
    mb = sum(row.mb for row in select(run.arms[MAIN].spent, task=task, stage=stage, link=LINKS))
    return f"{mb:.1f} MB"
