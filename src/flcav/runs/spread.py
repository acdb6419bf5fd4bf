"""The spread of retraining: how a run's figures vary over trainings on the same frames with other random numbers.

Initial weights, the order of batches and augmentation are redrawn; recordings, the plan, uploaded samples and
roadside sensors stay. A run with `retrainings` measures the spread and writes it as a table (spread.csv), which the
recipe of another run names (`spread`), or the package holds. Runs of the same recipe on other kinds of processor are
further trainings, whose sensors are placed by the errors of those trainings' networks (tools/ship_spreads.py).
"""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TypeVar

from flcav.config import InputError
from flcav.runs.results.run import Run
from flcav.runs.results.tests import Difference, Test
from flcav.runs.tables import read_named_table
from flcav.statistics.estimates import Spread, measure_spread, pool_spreads, widen, widen_share

FigureT = TypeVar("FigureT", Test, Difference)
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
    sd: float  # standard deviation over trainings, in units of the measure
    trainings: int
    run: str


def test_key(task: str, region: str, arm: str, stage: str) -> Key:
    """Return the key of a test's measure in `Spreads`."""
    return task, region, arm, stage, "", ""


def figure_key(each: Test | Difference) -> Key:
    """Return the key of a test's measure, or of a difference, in `Spreads`."""
    arm, stage = (each.before_arm, each.before_stage) if isinstance(each, Difference) else ("", "")
    return each.task, each.region, each.arm, each.stage, arm, stage


def list_spreads(run: Run, name: str, further: Sequence[Run] = ()) -> list[SpreadRow]:
    """Return the spreads of all measures and differences of the run `name` with retrainings.

    `further`: runs of the same recipe, frames and test scenes, which count as one more training of every figure.
    """
    others = [list_figures(figure) for figure in further]
    rows = []
    for key, figure in list_figures(run).items():
        spread = measure_spread([*figure.trainings, *(other[key].trainings[0] for other in others)])
        if spread is not None:
            rows.append(SpreadRow(*key, spread.sd, spread.trainings, name))
    return rows


def list_figures(run: Run) -> dict[Key, Test | Difference]:
    """Return the tests and differences of a run by key, in this order."""
    return {figure_key(figure): figure for figure in (*run.tested, *run.differences)}


def widen_anew(run: Run, spreads: Spreads) -> Run:
    """Return a run of one training with its intervals widened by `spreads`, which may be newer than its results."""

    def anew(figure: FigureT) -> FigureT:
        spread = spreads.get(figure_key(figure))
        alone = figure.over_scenes
        widened = alone if spread is None else (widen_share if isinstance(figure, Test) else widen)(alone, spread)
        return replace(figure, estimate=widened, spread=spread)

    return replace(run, tested=tuple(map(anew, run.tested)), differences=tuple(map(anew, run.differences)))


def read_spreads(name: str, beside: Path) -> Spreads:
    """Read the spreads from a table of the package, or from a file in the folder `beside`, pooled over runs.

    Raises `InputError` where there is no such table, or a row is not a spread.
    """
    table = io.StringIO(read_named_table("spread", name, "spread", "spreads", beside))
    try:
        rows = list(csv.DictReader(table))
    except csv.Error as error:  # a cell beyond the size limit of the module csv
        raise InputError(f"{name}: not a CSV table ({error})") from None
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
    return {key: pool_spreads(measured) for key, measured in spreads.items()}
