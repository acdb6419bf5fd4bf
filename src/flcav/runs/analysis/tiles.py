"""The numbers at the top of a run's report: gain, gain over a control, megabytes of the budgets, and cost at home."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from flcav.interface.wording import describe_megabytes, plural
from flcav.runs.analysis.answer import fell, select_claims
from flcav.runs.analysis.costs import list_home_costs
from flcav.runs.analysis.findings import NAMES
from flcav.runs.recipe import CENTRAL, EDGE, MAIN, PRETRAIN
from flcav.runs.results.run import Run
from flcav.runs.results.tests import Difference, RunFinding
from flcav.statistics.estimates import Estimate
from flcav.statistics.verdicts import signed
from flcav.storage.records import select


@dataclass(frozen=True)
class Tile:
    """A number with what it is of, and with a verdict where it is claimed."""

    title: str
    value: str
    note: str
    verdict: str | None = None


def list_tiles(run: Run) -> list[Tile]:
    """Return the tiles of a run, task by task: gains, megabytes of the budgets, and the costs at home."""
    tiles = [tile for task in run.recipe.tasks for tile in (*_tell_gain(run, task), *_tell_control(run, task))]
    return [*tiles, *_tell_megabytes(run), *_tell_home(run)]


def _tell_gain(run: Run, task: str) -> Iterator[Tile]:
    """Yield the gain of edge FL: the claim on the mean over regions, or the mean with the claims of all regions."""
    claims = select_claims(run, task, EDGE)
    if not claims:
        return
    each = replace(claims[0][0], regions=tuple(region for one, _ in claims for region in one.places))
    before, after = (_mean(run, MAIN, stage, each) for stage in (PRETRAIN, EDGE))
    verdicts = {finding.verdict for _, finding in claims}
    notes = [tell_change(each.estimate)]
    if len(claims) > 1:
        notes = [f"{one.region} {tell_change(one.estimate)}" for one, _ in claims]
        if len(verdicts) > 1:
            notes = [f"{note} {finding.verdict}" for note, (_, finding) in zip(notes, claims, strict=True)]
    title = f"{_measure(run, each)} in {' and '.join(each.places)}{_of(run, task)}"
    value = f"{before:.3f} → {after:.3f}"
    yield Tile(title, value, ", ".join(notes), verdicts.pop() if len(verdicts) == 1 else None)


def _tell_control(run: Run, task: str) -> Iterator[Tile]:
    """Yield the difference to the first arm that trains centrally on the uploads, for as many steps."""
    for each, finding in _list_controls(run, task)[:1]:
        reached = _mean(run, each.before_arm, each.before_stage, each)
        title = f"As many steps without FL{_of(run, task)}"
        yield Tile(title, f"{reached:.3f}", f"FL minus it: {tell_change(each.estimate)}", finding.verdict)


def _list_controls(run: Run, task: str) -> list[tuple[Difference, RunFinding]]:
    """Return the differences of edge FL to arms of more pretraining, those of the mean over regions first."""
    arms = [name for name, arm in run.recipe.arms.items() if arm.central == "pretrain"]
    verdicts = dict(zip(select(run.differences, arm=MAIN), run.findings, strict=False))
    found = [
        (each, verdicts[each])
        for each in select(run.differences, arm=MAIN, before_arm=arms, before_stage=CENTRAL, stage=EDGE, task=task)
        if each in verdicts
    ]
    return sorted(found, key=lambda row: row[0].regions is None)


def _tell_megabytes(run: Run) -> Iterator[Tile]:
    """Yield the megabytes of the first link with its budget, by stage, and those of the others."""
    main = run.arms[MAIN]
    (link, first), *others = main.links.items()
    rest = [f"{name}: {use.used_mb:.0f} of {use.budget_mb:.0f} MB" for name, use in others]
    sums = {stage: sum(row.mb for row in select(main.spent, link=link, stage=stage)) for stage in NAMES}
    vehicles = sum(each.clients for each in select(main.stages, stage=EDGE, task=next(iter(run.recipe.tasks))))
    names = NAMES | {EDGE: f"{NAMES[EDGE]} of {plural(vehicles, 'vehicle')}"}
    parts = ", ".join(f"{describe_megabytes(mb)} {names[stage]}" for stage, mb in sums.items() if mb)
    sent = f"{first.used_mb:.0f} of {first.budget_mb:.0f} MB"
    yield Tile("Radio, all vehicles and stages", sent, "; ".join((parts, *rest)))


def _tell_home(run: Run) -> Iterator[Tile]:
    """Yield for each town of pretraining the measure that fell most beyond its interval, or else the first."""
    home = list_home_costs(run)
    for region in dict.fromkeys(row.region for row in home):
        rows = sorted(
            select(home, region=region), key=lambda row: (not fell(row), row.difference.mean if fell(row) else 0)
        )
        first, *others = rows
        rest = [f"{row.measure} {row.before:.3f} → {row.after:.3f}" for row in others[:1]]
        title = f"{first.measure} at home, in {region}{_of(run, first.task)}"
        note = f"{tell_change(first.difference)}{''.join(f'; {told}' for told in rest)}"
        yield Tile(title, f"{first.before:.3f} → {first.after:.3f}", note)


def tell_change(change: Estimate) -> str:
    """Return a difference with its interval in words: "+0.060 (+0.033 to +0.085)"."""
    ends = "" if change.low is None or change.high is None else f" ({signed(change.low)} to {signed(change.high)})"
    return f"{signed(change.mean)}{ends}"


def _mean(run: Run, arm: str, stage: str, each: Difference) -> float:
    tests = select(run.tested, arm=arm, stage=stage, task=each.task, region=each.places)
    return float(np.mean([test.estimate.mean for test in tests]))


def _measure(run: Run, each: Difference) -> str:
    return select(run.tested, task=each.task)[0].measure


def _of(run: Run, task: str) -> str:
    return f": {task}" if len(run.recipe.tasks) > 1 else ""
