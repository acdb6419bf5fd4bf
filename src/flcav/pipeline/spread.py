"""The spread of retraining: how a run's figures vary over trainings on the same frames with other random numbers.

Initial weights, the order of batches and augmentation are drawn anew; recordings, the plan, uploaded samples and
roadside sensors stay. A run with `retrainings` measures the spread and writes it as a table (spread.csv), which the
recipe of another run names (`spread`), or the package holds.
"""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

from flcav.config import InputError
from flcav.intervals import Spread
from flcav.pipeline.results import Difference, Run, Test
from flcav.pipeline.tables import read_table

KEY = ("task", "region", "arm", "stage", "before_arm", "before_stage")  # the last two: empty for a measure
COLUMNS = (*KEY, "sd", "trainings", "run")
Spreads = Mapping[tuple[str, ...], Spread]  # by the values of `KEY`


def test_key(task: str, region: str, arm: str, stage: str) -> tuple[str, ...]:
    """Return the key of a test's measure."""
    return task, region, arm, stage, "", ""


def spread_rows(run: Run, name: str) -> list[dict[str, str]]:
    """Return the rows, by `COLUMNS`, of what a run with retrainings measured; `name` is the run's."""

    def row(key: Sequence[str], of: Test | Difference) -> dict[str, str]:
        assert of.spread is not None
        return dict(zip(COLUMNS, (*key, f"{of.spread.sd:.5f}", str(of.spread.trainings), name), strict=True))

    tests = [row(test_key(each.task, each.region, each.arm, each.stage), each) for each in run.tested if each.retrained]
    return tests + [row(difference_key(each), each) for each in run.differences if each.retrained]


def difference_key(each: Difference) -> tuple[str, ...]:
    """Return the key of a difference."""
    return each.task, each.region, each.arm, each.stage, each.before_arm, each.before_stage


def read_spreads(name: str, beside: Path) -> Spreads:
    """Return the spreads in a table of the package, or in a file below `beside`.

    Raises `InputError` where there is no such table, or a row is not a spread.
    """
    rows = csv.DictReader(io.StringIO(read_table("spread", name, "spread", "spreads", beside)))
    spreads: dict[tuple[str, ...], Spread] = {}
    for number, row in enumerate(rows, start=1):
        if missing := [column for column in COLUMNS if row.get(column) is None]:
            raise InputError(f"{name}: row {number}: column '{missing[0]}' is missing")
        try:
            spread = Spread(float(row["sd"]), int(row["trainings"]))
        except ValueError:
            raise InputError(f"{name}: row {number}: sd and trainings must be numbers") from None
        if not (0 <= spread.sd < 1 and spread.trainings >= 2):
            raise InputError(f"{name}: row {number}: sd must be from 0 to 1, trainings 2 or more")
        spreads[tuple(row[column] for column in KEY)] = spread
    return spreads
