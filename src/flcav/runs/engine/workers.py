"""Workers of steps: their common interface, and single-threaded processes on this machine."""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from flcav.config import Config
from flcav.interface.progress import Report
from flcav.machine.locks import only_writer
from flcav.machine.processes import process_pool, start_server
from flcav.runs.engine.step import Step, StepRecord, Work, read_value, write_done, write_started
from flcav.runs.provenance import Provenance, provenance

_process: Any = None  # in a worker process: provenance of its results, and `Workers.reports`


@dataclass(frozen=True)
class Workers:
    """The workers that perform the steps of one or several runs."""

    submit: Callable[[Path, Step, StepRecord], Future[Any]]  # folder of the run, step, record -> value of the step
    reports: Any  # queue of (folder of the run, name of the step, done, total, note)
    lent: bool = False  # whether a step can have several: it starts processes where the other workers are


@contextlib.contextmanager
def open_step_processes(jobs: int) -> Iterator[Workers]:
    """Yield `jobs` worker processes, which end with this one however it ends; raises `OSError` where one was killed."""
    reports = start_server().Queue()
    with process_pool(jobs, _begin, replace(provenance(), threads=1), reports) as pool:
        yield Workers(partial(pool.submit, _perform), reports, lent=True)


def perform(step: Step, folder: Path, record: StepRecord, made_by: Provenance, report: Report) -> Any:
    """Perform a step in its folder below `folder`, next to those it needs; write its record and return its value."""
    own_folder = folder / step.name
    with only_writer(own_folder):  # locked by this process, which may outlive the one that submitted the step
        own_folder.mkdir(parents=True, exist_ok=True)
        report(0, 1, "")
        write_started(own_folder, record)
        needs = {name: folder / name for name in step.needs}
        value = step.run(Work(own_folder, needs, report), **step.arguments, **step.means)
        write_done(own_folder, record, value, asdict(replace(made_by, seed=find_seed(step.arguments))))
        return read_value(own_folder)


def find_seed(arguments: Any) -> int | None:
    """Return the seed among a step's arguments, or that of one of them, such as a recipe; None without one."""
    values: Any = dict(arguments) if isinstance(arguments, Mapping | Config) else getattr(arguments, "__dict__", {})
    if isinstance(seed := values.get("seed"), int):
        return seed
    return next((seed for value in values.values() if (seed := find_seed(value)) is not None), None)


def _begin(made_by: Provenance, reports: Any) -> None:
    global _process
    _process = made_by, reports


def _perform(folder: Path, step: Step, record: StepRecord) -> Any:
    made_by, reports = _process
    return perform(
        step, folder, record, made_by, lambda done, total, note="": reports.put((folder, step.name, done, total, note))
    )
