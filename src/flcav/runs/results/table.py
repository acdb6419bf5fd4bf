"""The results of a run as one long table, a row per number: `results.csv`, from which charts are drawn."""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from flcav.runs.results.run import Run
from flcav.statistics.estimates import Estimate
from flcav.storage.records import write_any_table

UNITS = {"mb": "MB", "bytes": "byte", "s": "s", "seconds": "s", "m": "m"}  # by the last word of a quantity


@dataclass(frozen=True, kw_only=True)
class Row:
    """A number of a run's results with its 95 % interval, and where it was measured; what does not apply is empty."""

    arm: str = ""
    stage: str = ""
    region: str = ""  # or several, as in "grid and ring"
    task: str = ""
    measure: str = ""  # on test frames, such as AP50
    minus: str = ""  # of a paired difference: arm/stage of the test that is subtracted
    training: int | None = None  # number of a retraining, from 2; None: the first training, or all together
    round: int | None = None  # from 1 in its stage; 0: before the first
    server: str = ""  # of a round: region of the edge server, or "cloud"
    quantity: str  # names of the fields of results.json that lead to it, such as "arms.stages.records.loss"
    value: float
    low: float | None = None  # lower end of the interval; None: there is none
    high: float | None = None  # upper end of the interval
    unit: str = ""

    @property
    def estimate(self) -> Estimate:
        """The number with its interval."""
        return Estimate(self.value, self.low, self.high)


PLACES = ("arm", "stage", "region", "task", "measure", "minus", "round", "server")  # columns that records have
MAPPINGS = {"arms": "arm", "tasks": "task"}  # columns that are keys of a mapping, by its field
# Columns that are positions in a list, and the number of the first, by its field.
SERIES = {"retrained": ("training", 2), "losses": ("round", 1), "validated": ("round", 1)}
NAMES = ("link", "pole", "model", "returns", "condition", "after")  # fields that distinguish the records of a list


def save_table(run: Run, folder: Path) -> None:
    """Write the long table of a run to results.csv in `folder` atomically; cells that do not apply are empty."""
    rows = tabulate(run)
    columns = {field.name: [getattr(row, field.name) for row in rows] for field in fields(Row)}
    write_any_table(pa.table(columns), folder / "results.csv")


def tabulate(run: Run) -> tuple[Row, ...]:
    """Return a row per number in the results of a run, without its recipe; no two rows differ in value alone."""
    return tuple(_melt(run, ""))


def _melt(value: Any, quantity: str, **at: Any) -> Iterator[Row]:
    """Yield a row per number in a record, list or mapping; for a list of names a row with their count.

    `at`: columns that are known from the enclosing records.
    """
    name = quantity.rpartition(".")[2]
    if isinstance(value, int | float | Estimate) and not isinstance(value, bool):
        known = value if isinstance(value, Estimate) else Estimate(value, None, None)
        unit = UNITS.get(name.rpartition("_")[2], "")
        yield Row(quantity=quantity, value=known.mean, low=known.low, high=known.high, unit=unit, **at)
    elif isinstance(value, Mapping):
        for key, item in value.items():
            place = MAPPINGS.get(name)
            yield from _melt(item, quantity if place else f"{quantity}.{key}", **({**at, place: key} if place else at))
    elif is_dataclass(value):
        at |= _find_place(value)
        for field in fields(value):
            if field.name not in (*PLACES, *NAMES):
                yield from _melt(getattr(value, field.name), f"{quantity}.{field.name}".lstrip("."), **at)
    elif isinstance(value, tuple):
        yield from _melt_list(value, quantity, at)


def _melt_list(values: tuple[Any, ...], quantity: str, at: dict[str, Any]) -> Iterator[Row]:
    column, first = SERIES.get(quantity.rpartition(".")[2], ("", 0))
    if values and isinstance(values[0], str):
        yield from _melt(len(values), quantity, **at)
    seen = Counter[str]()
    for item in values if column or is_dataclass(next(iter(values), None)) else ():
        names = [str(getattr(item, name)) for name in NAMES if getattr(item, name, None) is not None]
        place = repr((_find_place(item), names))
        if seen[place] and not column:  # nothing else distinguishes it from an earlier one
            names.append(str(seen[place] + 1))
        yield from _melt(item, ".".join((quantity, *names)), **(at | ({column: first + seen[place]} if column else {})))
        seen[place] += 1


def _find_place(record: Any) -> dict[str, Any]:
    """Return the columns that are fields of a record."""
    return {name: value for name in PLACES if (value := getattr(record, name, None)) is not None}
