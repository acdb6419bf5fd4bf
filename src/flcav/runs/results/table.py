"""The results of a run as one long table, a row per number: `results.csv`, and what charts are drawn from."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from flcav.network.ledger import BYTES_PER_MB
from flcav.runs.recipe import MAIN, PRETRAIN
from flcav.runs.registry import RunRows
from flcav.runs.results.run import ArmResult, Run
from flcav.runs.results.tests import Difference, Test
from flcav.runs.results.training import FederatedRound, StageResult
from flcav.statistics.estimates import Estimate
from flcav.storage.records import write_any_table

TABLE = "results.csv"  # in the folder of a run
SCORE = "validation.score"  # quantity: a task's measure on validation frames
UNITS = {"mb": "MB", "bytes": "byte", "s": "s", "seconds": "s", "m": "m"}  # by the last word of a quantity's name


@dataclass(frozen=True, kw_only=True)
class Row:
    """A number of a run with its 95 % interval, and where it was measured; fields that do not apply are empty."""

    arm: str = ""
    stage: str = ""  # pretrain | edge | more-edge | cloud | central; of a plan: after which it was made
    region: str = ""  # or several, as in "grid and ring"
    task: str = ""
    training: int | None = None  # from 1; None: the mean over the run's trainings, or what they share
    round: int | None = None  # from 1 in its stage; 0: before the first
    server: str = ""  # of a round: region of the edge server, or "cloud"
    minus: str = ""  # of a paired difference: arm/stage of the test that is subtracted
    quantity: str  # name of a measure on test frames, such as "AP50", or group and name, such as "round.loss"
    value: float
    low: float | None = None
    high: float | None = None
    unit: str = ""

    @property
    def estimate(self) -> Estimate:
        """Return the number with its interval."""
        return Estimate(self.value, self.low, self.high)


KEYS = {"arm", "stage", "region", "task", "round", "server"}  # fields of records that are fields of their rows


def save_table(run: Run, folder: Path) -> None:
    """Write the long table of a run to results.csv in `folder`, atomically; an empty cell: the field does not apply."""
    rows, names = tabulate(run), [field.name for field in fields(Row)]
    write_any_table(pa.table({name: [getattr(row, name) for row in rows] for name in names}), folder / TABLE)


def tabulate(run: Run) -> tuple[Row, ...]:
    """Return a row for each number of a run; no two rows differ in value alone."""
    return (*_list_tests(run), *_list_validations(run), *_list_stages(run), *_list_costs(run))


def _list_tests(run: Run) -> Iterator[Row]:
    """Yield measures on test frames and paired differences: their means over trainings, and each training's value."""
    measures = {test.task: test.result.measure for test in run.tested}
    for test in run.tested:
        at = {name: getattr(test, name) for name in ("arm", "stage", "region", "task")}
        yield from _melt({**test.result.numbers, "frames": test.result.frames, "scenes": test.result.scenes}, **at)
        yield from _list_trainings(test, test.result.estimate, measures[test.task], **at)
    for each in run.differences:
        at = {name: getattr(each, name) for name in ("arm", "stage", "region", "task")}
        minus = f"{each.before_arm}/{each.before_stage}"
        yield from _list_trainings(each, each.over_scenes, measures[each.task], minus=minus, **at)


def _list_trainings(each: Test | Difference, first: Estimate, measure: str, **at: str) -> Iterator[Row]:
    """Yield a measure or difference in all trainings; `first`: of the first training, its interval over scenes."""
    yield from _melt({measure: each.estimate, f"{measure}.spread": each.spread}, **at)
    for number, value in enumerate((first, *each.retrained), start=1):
        yield from _melt({measure: value}, training=number, **at)


def _list_validations(run: Run) -> Iterator[Row]:
    towns = " + ".join(run.recipe.with_role("pretrain"))
    for trained in run.pretrained:
        at = {"arm": MAIN, "stage": PRETRAIN, "region": towns, "task": trained.task, "training": 1}
        for number, validated in enumerate(trained.validated, start=1):
            yield from _melt(validated, "validation.", round=number, **at)
    for watched in run.watched:
        at = {"arm": MAIN, "stage": watched.stage, "region": watched.region, "task": watched.task, "training": 1}
        for scored in watched.rounds:
            yield from _melt(scored, "validation.", **at)


def _list_stages(run: Run) -> Iterator[Row]:
    """Yield the numbers of stages, their rounds, labels and statistics, those of retrainings included."""
    for name, arm in run.arms.items():
        for training, stage in _number_stages(arm, len(run.recipe.tasks)):
            at = {"arm": name, "stage": stage.stage, "task": stage.task, "training": training}
            yield from _melt(stage, "stage.", **at)
            for record in stage.records or ():
                numbers = {"samples": record.samples, **list_scalars(record), "divergence": record.divergence}
                yield from _melt(numbers, "round.", round=record.round, server=record.server, **at)
            for labels in stage.labels or ():
                by_returns = {f"{each.returns}_returns": each for each in labels.by_returns or ()}
                where = {"round": labels.round, "region": stage.region or "", **at}
                yield from _melt({**vars(labels), **by_returns}, "labels.", **where)
            for scores in stage.statistics or ():
                yield from _melt(scores, "statistics.", **at)


def _number_stages(arm: ArmResult, tasks: int) -> Iterator[tuple[int, StageResult]]:
    yield from ((1, stage) for stage in arm.stages)
    yield from ((2 + number // tasks, stage) for number, stage in enumerate(arm.retrained or ()))


def list_scalars(record: FederatedRound) -> dict[str, float]:
    """Return the numbers of a round by name."""
    numbers = {
        "loss": record.loss,
        "clients": float(len(record.clients)),
        "failed": float(len(record.failed)),
        "uplink_mb": record.up_bytes / BYTES_PER_MB,
        "downlink_mb": record.down_bytes / BYTES_PER_MB,
        "epsilon": record.epsilon,
        "seconds": record.seconds,
    }
    return {name: value for name, value in numbers.items() if value is not None}


def _list_costs(run: Run) -> Iterator[Row]:
    """Yield plans, budgets, traffic, sensors, privacy, costs, shares of closed gaps, and the numbers of extras."""
    for name, arm in run.arms.items():
        for plan in arm.plans:
            for task, own in plan.tasks.items():
                yield from _melt(own, "plan.", arm=name, stage=plan.after or "", task=task)
        yield from _melt({"budget": arm.links, "privacy": arm.privacy}, arm=name)
        for spent in arm.spent:
            yield from _melt({f"sent.{spent.link}_mb": spent.mb}, arm=name, stage=spent.stage, task=spent.task)
        for placed in arm.placed:
            yield from _melt(placed, "placed.", arm=name)
        for test in arm.regional or ():
            where = {"region": test.region, "task": test.task}
            yield from _melt({f"regional.{test.measure}.{test.model}": test.estimate}, arm=name, **where)
    for cost in run.costs or ():
        yield from _melt(cost, "cost.")
    for home in run.home or ():
        yield from _melt(home, f"home.{home.measure}.", arm=MAIN)
    yield from _melt({"gap_closed": run.gap_closed})
    for extra in fields(RunRows):
        for row in getattr(run, extra.name) or ():
            yield from _melt(row, f"{extra.name}.")


def _melt(record: Any, group: str = "", **at: Any) -> Iterator[Row]:
    """Yield a row for each number in a record or mapping, and in those within it, by dotted names below `group`."""
    values = (
        dict(record)
        if isinstance(record, Mapping)
        else {each.name: getattr(record, each.name) for each in fields(record)}
    )
    at = {**at, **{name: value for name in KEYS & values.keys() if (value := values.pop(name)) is not None}}
    for name, value in values.items():
        unit = UNITS.get(name.rpartition("_")[2], "")
        if isinstance(value, Estimate):
            yield Row(quantity=group + name, value=value.mean, low=value.low, high=value.high, unit=unit, **at)
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield Row(quantity=group + name, value=value, unit=unit, **at)
        elif isinstance(value, Mapping) or is_dataclass(value):
            yield from _melt(value, f"{group}{name}.", **at)
