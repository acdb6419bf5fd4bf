"""The spread of retraining: how a run's figures vary over trainings on the same frames with other random numbers.

Initial weights, the order of batches and augmentation are drawn anew; recordings, the plan, uploaded samples and
roadside sensors stay. A run with `retrainings` measures the spread and writes it as a table (spread.csv), which the
recipe of another run names (`spread`), or the package holds.
"""

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path

from flcav.config import InputError
from flcav.intervals import Spread, pool_spreads
from flcav.pipeline.results.run import Run
from flcav.pipeline.results.tests import Difference
from flcav.pipeline.tables import read_table

Key = tuple[str, str, str, str, str, str]  # task, region, arm, stage, and of a difference the arm and stage before
Spreads = Mapping[Key, Spread]


@dataclass(frozen=True)
class SpreadRow:
    """The spread of a measure, or of a difference, as a row of the table."""

    task: str
    region: str
    arm: str
    stage: str
    before_arm: str  # empty for a measure
    before_stage: str  # empty for a measure
    sd: float
    trainings: int
    run: str


def test_key(task: str, region: str, arm: str, stage: str) -> Key:
    """Return the key of a test's measure."""
    return task, region, arm, stage, "", ""


def difference_key(each: Difference) -> Key:
    """Return the key of a difference."""
    return each.task, each.region, each.arm, each.stage, each.before_arm, each.before_stage


def list_spreads(run: Run, name: str) -> list[SpreadRow]:
    """Return what a run with retrainings measured; `name` is the run's."""
    tests = [(test_key(each.task, each.region, each.arm, each.stage), each.spread) for each in run.tested]
    both = [*tests, *((difference_key(each), each.spread) for each in run.differences)]
    return [SpreadRow(*key, spread.sd, spread.trainings, name) for key, spread in both if spread is not None]


def read_spreads(name: str, beside: Path) -> Spreads:
    """Return the spreads in a table of the package, or in a file below `beside`; those of several runs are pooled.

    Raises `InputError` where there is no such table, or a row is not a spread.
    """
    rows = csv.DictReader(io.StringIO(read_table("spread", name, "spread", "spreads", beside)))
    spreads: dict[Key, list[Spread]] = {}
    for number, row in enumerate(rows, start=1):
        if missing := [field.name for field in fields(SpreadRow) if row.get(field.name) is None]:
            raise InputError(f"{name}: row {number}: column '{missing[0]}' is missing")
        try:
            spread = Spread(float(row["sd"]), int(row["trainings"]))
        except ValueError:
            raise InputError(f"{name}: row {number}: sd and trainings must be numbers") from None
        if not (0 <= spread.sd < 1 and spread.trainings >= 2):
            raise InputError(f"{name}: row {number}: sd must be from 0 to 1, trainings 2 or more")
        key = (row["task"], row["region"], row["arm"], row["stage"], row["before_arm"], row["before_stage"])
        spreads.setdefault(key, []).append(spread)
    return {key: pool_spreads(own) for key, own in spreads.items()}
