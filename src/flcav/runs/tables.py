"""CSV tables that a recipe names, from the package or a user's file: learning histories, spreads of retraining."""

import csv
from collections.abc import Sequence
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

from flcav.config import InputError, read_file, shorten
from flcav.runs.recipe import find_path
from flcav.storage.files import atomic_path
from flcav.storage.records import read_csv

if TYPE_CHECKING:
    from _typeshed import DataclassInstance
import io
from dataclasses import dataclass

from flcav.optimization.curves.history import History, parse_histories


def read_named_table(field: str, name: str, noun: str, folder: str, beside: Path) -> str:
    """Read the text of a table: one of the package by its name, in `folder`, or a file in the folder `beside`.

    Raises `InputError`, naming the recipe's `field` and the kind of table (`noun`), where there is none.
    """
    packaged = resources.files("flcav.runs") / folder
    known = sorted(entry.name.removesuffix(".csv") for entry in packaged.iterdir() if ".csv" in entry.name)
    if name in known:
        return (packaged / f"{name}.csv").read_text(encoding="utf-8-sig")
    path = find_path(name, beside)
    if path is None or not path.is_file():
        raise InputError(
            f"{field}: {shorten(name)} is no {noun} of the package ({', '.join(known)}), and no file beside the "
            f"recipe, in {beside.absolute()}"
        )
    try:
        return read_file(path).decode("utf-8-sig")
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"{path}: not a CSV table ({error})") from None


def append_records(path: Path, records: Sequence["DataclassInstance"]) -> None:
    """Append records to the table at `path`, a column per field; numbers are rounded to 5 decimals.

    Earlier rows of the same `run`, a field of the records, are replaced.
    """
    if not records:
        return
    held: list[dict[str, str]] = []
    if path.exists():
        with path.open(newline="", encoding="utf-8-sig") as file:
            held = list(csv.DictReader(file))
    rows = [{name: _cell(value) for name, value in asdict(record).items()} for record in records]
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows([*(row for row in held if row.get("run") not in {new["run"] for new in rows}), *rows])


def _cell(value: object) -> str:
    return str(round(value, 5)) if isinstance(value, float) else str(value)


@dataclass(frozen=True)
class HistoryPoint:
    """A point of a learning history: samples and rounds that a task spent, and the score it reached."""

    task: str
    samples: int
    edge_rounds: int
    cloud_rounds: int
    accuracy: float  # validation score in [0, 1]
    weight: int  # number of validation frames
    run: str
    seed: int


def read_history(task: str, name: str, beside: Path) -> str:
    """Read the text of a task's learning history (CSV): one of the package, or a file in the folder `beside`.

    Raises `InputError` where there is no such table, or it has no rows of the task.
    """
    text = read_named_table(f"tasks.{task}.history", name, "history", "histories", beside)
    parse_history(task, text, name)
    return text


def parse_history(task: str, text: str, origin: str) -> History:
    """Parse a task's points from a history (CSV); raises `InputError`, naming `origin`, where there are none."""
    table = read_csv(io.BytesIO(text.encode()), origin=origin)
    found = parse_histories(table.to_pydict(), origin, task)
    if task not in found:
        raise InputError(f"tasks.{task}.history: {origin} has no rows of '{task}', but of {', '.join(found)}")
    return found[task]


def load_known_history(name: str) -> History:
    """Load the package's learning history of the task `name`."""
    return parse_history(name, read_history(name, name, Path()), name)
