"""Points of learning curves: the accuracy reached after numbers of samples, edge rounds and cloud rounds.

Tables of two forms are read:

- Long: `task, stage, resource, accuracy[, weight]`. A row gives the resource of its stage. Stages follow one another,
  so its other resources are the largest of each earlier stage, and 0 of each later one.
- Joint: `[task,] samples, edge_rounds, cloud_rounds, accuracy[, weight][, run][, seed]`, as flcav's runs write it.

Either may have `error`, which is 1 - accuracy, in place of `accuracy`. Columns may have other names that people give
them (`NAMES`), in any case, and percentages are taken. Of the three numbers of a joint table one is enough: the others
are then 0. Whatever is taken so is told in the history's `warnings`. A row that equals an earlier one in every column
was logged twice, and is no second measurement: it is left out. Rows of the same resources with another accuracy, run or
seed stay.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np
import pyarrow.csv
from numpy.typing import ArrayLike, NDArray

from flcav.config import InputError, shorten
from flcav.geometry.arrays import Array
from flcav.interface.notebook import Displayed
from flcav.interface.wording import describe_number, hint_share
from flcav.optimization.curves.curves import STAGES
from flcav.storage.columns import find_columns
from flcav.storage.records import read_csv

Table = Mapping[str, Sequence[str | float | None]]  # columns by name

LONG = ("task", "stage", "resource", "accuracy")
JOINT = ("samples", "edge_rounds", "cloud_rounds", "accuracy")
NAMES: Mapping[str, Sequence[str]] = {  # other names of a column, as `find_columns` reads them
    "task": ("task_name",),
    "stage": ("phase",),
    "resource": ("resources", "amount"),
    "samples": (
        *("sample", "n", "n_samples", "num_samples", "number_of_samples", "nr_of_samples", "no_of_samples", "size"),
        *("train_samples", "training_samples", "samples_uploaded", "uploaded_samples", "labelled_samples"),
        *("labeled_samples", "train_size", "training_size", "training_set_size", "dataset_size", "data_size"),
        *("images", "training_images", "train_images", "frames", "examples", "num_examples"),
    ),
    "edge_rounds": (
        *("edge_round", "edge", "edge_fl_rounds", "rounds", "round", "n_rounds", "num_rounds", "number_of_rounds"),
        *("fl_rounds", "fl_round", "communication_rounds", "communication_round", "comm_rounds", "server_round"),
    ),
    "cloud_rounds": ("cloud_round", "cloud", "cloud_fl_rounds", "global_rounds", "global_round"),
    "accuracy": (
        *("acc", "test_accuracy", "test_acc", "val_accuracy", "val_acc", "validation_accuracy", "mean_accuracy"),
        *("top1", "top_1", "score", "ap", "ap50", "map", "map50", "map_50", "miou", "iou", "f1", "f1_score"),
    ),
    "error": ("err", "error_rate", "test_error", "val_error", "validation_error"),
    "weight": ("weights",),
    "run": ("run_id", "run_name"),
    "seed": ("random_seed",),
}
LEAST, MOST = 1e-9, 1e9  # allowed size of a number other than 0
ARTICLE = resources.files("flcav.optimization") / "data" / "article_history.csv"
ROUNDED = 1.01e-3  # largest deviation from 1 of accuracy + error, both rounded to three digits


@dataclass(frozen=True)
class History(Displayed):
    """The points of a task's learning curve."""

    resources: Array  # (n, 3) samples, edge rounds, cloud rounds
    accuracy: Array  # (n,) 0 ... 1
    weight: Array  # (n,) of each point's squared residual in a fit
    runs: tuple[str, ...] = ()  # (n,) run of each point; empty where the history does not name runs
    seeds: tuple[str, ...] = ()  # (n,) seed of each point's run; runs of one seed share frames
    repeats: int = 0  # rows of the table that are left out, as they equal an earlier one in every column
    taken: tuple[str, ...] = ()  # how columns of other names were read, and missing ones filled, a sentence each

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return a sentence on each column that was read by another name or filled, and on rows that are left out."""
        if not self.repeats:
            return self.taken
        rows = "1 row repeats" if self.repeats == 1 else f"{self.repeats} rows repeat"
        return (*self.taken, f"{rows} an earlier one in every column and count{'s' * (self.repeats == 1)} once")

    def select(self, chosen: NDArray[np.bool_]) -> "History":
        """Return the points that are true in `chosen` (n,)."""
        runs, seeds = (tuple(name for name, taken in zip(names, chosen) if taken) for names in (self.runs, self.seeds))
        own = self.resources[chosen], self.accuracy[chosen], self.weight[chosen]
        return History(*own, runs, seeds, taken=self.taken)


def load_history(path: Path | str) -> History:
    """Return the history of a task in a CSV file; raises `InputError` where it holds none, or several."""
    table = read_csv(path)
    histories = parse_histories(table.to_pydict(), str(path), Path(path).stem)
    if len(histories) != 1:
        names = ", ".join(histories) or "none"
        raise InputError(f"{path}: a history of one task is wanted, and it has those of {names}")
    return next(iter(histories.values()))


def article_histories() -> dict[str, History]:
    """Return the histories of Wang et al., IEEE Network 37(3), 2023, Fig. 3a, by task."""
    with ARTICLE.open("rb") as file:
        return parse_histories(pyarrow.csv.read_csv(file).to_pydict(), str(ARTICLE), "")


def parse_histories(columns: Table, origin: str, unnamed: str) -> dict[str, History]:
    """Return the histories of all tasks, by name, from a table in either form.

    `unnamed` is the task's name in a table without a column `task`. Raises `InputError` naming `origin`, the row (from
    1), the field and the value where a column is missing or a value is invalid.
    """
    given = {"error": "accuracy", "accuracy": "error"}  # the one stands for the other, and no third column does
    others = {other for name, other in given.items() if name in columns and other not in columns}
    columns, taken = find_columns(columns, {key: names for key, names in NAMES.items() if key not in others}, origin)
    columns = _with_accuracy(columns, origin)
    joint = "stage" not in columns
    counts = [name for name in JOINT[:3] if name in columns]
    for name in (*(() if counts else JOINT[:1]), "accuracy") if joint else LONG[1:]:
        if name not in columns:
            raise InputError(
                f"{origin}: column '{name}' is missing; a history has {', '.join(LONG)}, or {', '.join(JOINT)}, of "
                f"whose numbers one is enough; error may stand for accuracy; found {', '.join(columns) or 'none'}"
            )
    if joint and (absent := [name for name in JOINT[:3] if name not in counts]):
        columns = {**columns, **{name: [0.0] * len(columns["accuracy"]) for name in absent}}
        taken = (
            *taken,
            f"no {' and no '.join(absent)} in the table: 0 in every row, and the curve says nothing of them",
        )
    accuracy = _numbers(columns, "accuracy", origin, most=1.0)
    weight = _numbers(columns, "weight", origin) if "weight" in columns else np.ones(len(accuracy))
    amounts = np.column_stack([_numbers(columns, name, origin) for name in (JOINT[:3] if joint else ("resource",))])
    for row, stage in enumerate(columns.get("stage", ()), start=1):
        if stage not in STAGES:
            raise InputError(f"{origin}: row {row}: stage = {stage!r} must be one of {', '.join(STAGES)}")
    for name in ("task", "run", "seed"):
        for row, value in enumerate(columns.get(name, ()), start=1):
            if value is None or value != value or not str(value).strip():
                raise InputError(f"{origin}: row {row}: {name} is empty: a row names its {name}, or the table has none")
    names = [str(name) for name in columns.get("task", [unnamed] * len(accuracy))]
    histories = {}
    whole = list(zip(*columns.values(), strict=True))
    for task in dict.fromkeys(names):
        logged = [row for row, name in enumerate(names) if name == task]
        rows = sorted({whole[row]: row for row in reversed(logged)}.values())
        spent = amounts[rows]
        if not joint:
            spent = accumulate_resources([str(columns["stage"][row]) for row in rows], spent[:, 0])
        runs, seeds = (
            tuple(str(columns[name][row]) for row in rows) if name in columns else () for name in ("run", "seed")
        )
        histories[task] = History(spent, accuracy[rows], weight[rows], runs, seeds, len(logged) - len(rows), taken)
    return histories


def _with_accuracy(columns: Table, origin: str) -> Table:
    """Return `columns` with accuracies, computed from the errors where there are none.

    Raises `InputError` where accuracy and error are both given and do not sum to 1.
    """
    if "error" not in columns:
        return columns
    error = _numbers(columns, "error", origin, most=1.0)
    if "accuracy" not in columns:
        return {**columns, "accuracy": (1 - error).tolist()}
    accuracy = _numbers(columns, "accuracy", origin, most=1.0)
    for row in np.flatnonzero(np.abs(accuracy + error - 1) > ROUNDED):
        raise InputError(
            f"{origin}: row {row + 1}: accuracy = {accuracy[row]:g} and error = {error[row]:g} do not sum to 1"
        )
    return columns


def accumulate_resources(stage: Sequence[str], resource: ArrayLike) -> Array:
    """Return samples, edge rounds and cloud rounds (n, 3) of a long table's rows.

    Each row has its stage's `resource` (n,), the largest of each earlier stage, and 0 of each later one.
    """
    amounts = np.asarray(resource, dtype=np.float64)
    number = np.array([STAGES.index(name) for name in stage])
    largest = [amounts[number == s].max(initial=0.0) for s in range(3)]
    of_stage = np.where(number[:, None] == np.arange(3), amounts[:, None], 0.0)
    return np.where(np.arange(3) < number[:, None], largest, of_stage)


def _numbers(columns: Table, name: str, origin: str, most: float = MOST) -> Array:
    """Return column `name` as (n,) numbers from 0 to `most`; raises `InputError` naming the first that is not."""
    values = np.empty(len(columns[name]))
    for row, value in enumerate(columns[name]):
        try:
            values[row] = np.nan if value is None else float(value)  # pyright: ignore[reportArgumentType]
        except (TypeError, ValueError, OverflowError):
            values[row] = np.nan
        if not (values[row] == 0 or LEAST <= values[row] <= most):
            wanted = f"must be a number from 0 to {most:g}"
            if value is None or (isinstance(value, str) and not value.strip()):
                raise InputError(f"{origin}: row {row + 1}: {name} is empty, and {wanted}")
            if 0 < values[row] < LEAST:
                wanted = f"must be 0, or a number from {LEAST:g} to {most:g}"
            if most == 1:
                wanted += hint_share(values[row])
            if isinstance(value, str):
                wanted = describe_number(value, name)
            raise InputError(f"{origin}: row {row + 1}: {name} = {shorten(value)} {wanted}")
    return values
