"""Learning histories (CSV) of earlier runs, which learning curves are fitted to."""

import io
from dataclasses import dataclass
from pathlib import Path

import pyarrow.csv

from flcav.config import InputError
from flcav.optimization.curves.history import History, parse_histories
from flcav.pipeline.tables import read_table


@dataclass(frozen=True)
class HistoryPoint:
    """A point of the learning history that a run writes: what a task spent, and the score it reached."""

    task: str
    samples: int
    edge_rounds: int
    cloud_rounds: int
    accuracy: float
    weight: int  # validation frames
    run: str
    seed: int


def read_history(task: str, name: str, beside: Path) -> str:
    """Return the text of a task's learning history (CSV): one of the package by its name, or a file below `beside`.

    Raises `InputError` where there is no such table, or it has no rows of the task.
    """
    text = read_table(f"tasks.{task}.history", name, "history", "histories", beside)
    parse_history(task, text, name)
    return text


def parse_history(task: str, text: str, origin: str) -> History:
    """Return the task's points in a history (CSV); raises `InputError`, naming `origin`, where there are none."""
    try:
        table = pyarrow.csv.read_csv(io.BytesIO(text.encode()))
    except pyarrow.ArrowInvalid as error:
        raise InputError(f"{origin}: not a CSV table ({error})") from None
    found = parse_histories(table.to_pydict(), origin, task)
    if task not in found:
        raise InputError(f"tasks.{task}.history: {origin} has no rows of '{task}', but of {', '.join(found)}")
    return found[task]


def load_history(name: str) -> History:
    """Return the package's learning history of the task `name`."""
    return parse_history(name, read_history(name, name, Path()), name)
