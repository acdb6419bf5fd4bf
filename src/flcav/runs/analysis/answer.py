"""The answer of a run to its question, whether vehicles can teach a network towns that it has never seen."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from flcav.interface.wording import describe_megabytes
from flcav.network.ledger import LINKS
from flcav.runs.analysis.costs import list_home_costs
from flcav.runs.analysis.findings import OVER_EDGE, OVER_PRETRAINING
from flcav.runs.recipe import CLOUD, EDGE, MAIN, PRETRAIN
from flcav.runs.results.run import Run
from flcav.runs.results.tests import Difference, FoundCount, HomeCost, RunFinding
from flcav.statistics.estimates import Estimate, average_estimates
from flcav.statistics.verdicts import HELD, NOT_HELD
from flcav.storage.records import select

PRICE = ", at a price"
BEFORE = {EDGE: (PRETRAIN, OVER_PRETRAINING), CLOUD: (EDGE, OVER_EDGE)}  # stage: the one before, and the question
NUMBERS = ("no", "one", "two", "three", "four", "five", "six")

Claimed = tuple[Difference, RunFinding]  # a difference of the run itself, and the verdict on it


@dataclass(frozen=True)
class Answer:
    """A word or two that follow from the verdicts, and the sentences behind them, the first with the gain."""

    word: str
    sentences: tuple[str, ...]


def tell_answer(run: Run) -> Answer | None:
    """Return the answer by the verdicts on edge FL against pretraining; None where a run has no such claim.

    A claim on the mean over regions counts in place of those of the regions. The price is a measure that fell in a town
    of pretraining, by more than its 95 % interval.
    """
    claims = {task: found for task in run.recipe.tasks if (found := select_claims(run, task, EDGE))}
    if not claims:
        return None
    verdicts = {finding.verdict for found in claims.values() for _, finding in found}
    home = list_home_costs(run)
    if HELD in verdicts:
        word = "Yes" if verdicts == {HELD} else "In part"
        word += PRICE if any(map(fell, home)) else ""
    else:
        word = "No" if verdicts == {NOT_HELD} else "This run cannot tell"
    regions = {task: tuple(region for each, _ in found for region in each.places) for task, found in claims.items()}
    sentences = [*_tell_edge(run, regions), *_tell_cloud(run, regions)]
    sentences += _tell_home(home)
    return Answer(word, tuple(sentences))


def fell(cost: HomeCost) -> bool:
    """Return whether a measure fell at home by more than its interval."""
    return (cost.difference.high or 0.0) < 0


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


def select_claims(run: Run, task: str, stage: str) -> list[Claimed]:
    """Return the claims that a stage is better than the one before, if there is one, of the mean over regions."""
    before, question = BEFORE[stage]
    verdicts = {finding.place: finding for finding in select(run.findings, question=question)}
    found = [
        (each, verdicts[place])
        for each in select(run.differences, arm=MAIN, before_arm=MAIN, stage=stage, before_stage=before, task=task)
        if (place := f"{each.region}, {each.task}") in verdicts
    ]
    return [claimed for claimed in found if claimed[0].regions is not None] or found


def _tell_edge(run: Run, regions: Mapping[str, tuple[str, ...]]) -> Iterator[str]:
    """Yield a sentence on edge FL of all tasks in the regions of their claims: counts, or else the measure."""
    told = []
    for task, places in regions.items():
        before, after = (_sum_counts(run, task, stage, places) for stage in (PRETRAIN, EDGE))
        if before is not None and after is not None:
            right = f"{before.found:.0f} → {after.found:.0f} of {after.targets} {after.noun} found"
            if before.false is not None and after.false is not None:
                right += f" and {before.false:.0f} → {after.false:.0f} false"
        else:
            means = [_average(run, task, stage, places) for stage in (PRETRAIN, EDGE)]
            right = f"{_measure(run, task)} of {task} {means[0]:.3f} → {means[1]:.3f}"
        told.append(f"{right}, for {describe_megabytes(_sent(run, task, EDGE, ('wireless',)))} of radio")
    places = max(regions.values(), key=len)
    count = NUMBERS[len(places)] if len(places) < len(NUMBERS) else len(places)
    noun = f"{_name_places(run, places)}{'' if len(places) == 1 else 's'}"
    yield f"In {count} unseen {noun}: {'; '.join(told)}."


def _name_places(run: Run, regions: Iterable[str]) -> str:
    """Return what regions are: towns, unless one of them has recordings of its own."""
    return "region" if any(run.recipe.regions[name].data for name in regions) else "town"


def _tell_cloud(run: Run, regions: Mapping[str, tuple[str, ...]]) -> Iterator[str]:
    """Yield a sentence on the network for all towns of each task, where there is one."""
    told, sent = [], 0.0
    for task, places in regions.items():
        if not select(run.tested, arm=MAIN, stage=CLOUD, task=task, region=places):
            continue
        sent += _sent(run, task, CLOUD, LINKS)
        last = _sum_counts(run, task, CLOUD, places)
        if last is not None:
            told.append(f"finds {last.found:.0f}{'' if last.false is None else f', {last.false:.0f} false'}")
        else:
            told.append(f"has {_measure(run, task)} {_average(run, task, CLOUD, places):.3f}")
    if told:
        everywhere = f"One network for all {_name_places(run, run.recipe.regions)}s"
        yield f"{everywhere}, averaged by the cloud for {describe_megabytes(sent)} more, {', '.join(told)}."


def _tell_home(home: Sequence[HomeCost]) -> Iterator[str]:
    """Yield a sentence for each town of pretraining: what fell by more than its interval, else the main measures."""
    for region in dict.fromkeys(row.region for row in home):
        rows = select(home, region=region)
        shown = [row for row in rows if fell(row)] or list({row.task: row for row in reversed(rows)}.values())
        changes = [
            f"{row.measure}{f' of {row.task}' if len({each.task for each in rows}) > 1 else ''} "
            f"{row.before:.3f} → {row.after:.3f}"
            for row in shown
        ]
        yield f"At home in {region}, that network {'loses' if any(map(fell, shown)) else 'has'} {', '.join(changes)}."


def _sum_counts(run: Run, task: str, stage: str, regions: tuple[str, ...]) -> FoundCount | None:
    """Return the counts of the run itself after a stage, summed over regions; None where one is not known."""
    rows = select(run.counts or (), arm=MAIN, stage=stage, task=task, region=regions)
    if len(rows) != len(regions):
        return None
    false = [row.false for row in rows if row.false is not None]
    return FoundCount(
        *(MAIN, stage, " and ".join(regions), task, rows[0].noun),
        targets=sum(row.targets for row in rows),
        found=sum(row.found for row in rows),
        false=sum(false) if len(false) == len(rows) else None,
        trainings=rows[0].trainings,
    )


def _average(run: Run, task: str, stage: str, regions: tuple[str, ...]) -> float:
    tests = select(run.tested, arm=MAIN, stage=stage, task=task, region=regions)
    return float(np.mean([test.estimate.mean for test in tests]))


def _measure(run: Run, task: str) -> str:
    return select(run.tested, task=task)[0].measure


def _sent(run: Run, task: str, stage: str, links: Sequence[str]) -> float:
    """Return the uplink traffic [MB] of a stage of a task on links."""
    return sum(row.mb for row in select(run.arms[MAIN].spent, task=task, stage=stage, link=links))
