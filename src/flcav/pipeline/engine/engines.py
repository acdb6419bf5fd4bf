"""Execution engines: the protocol of an engine, and worker processes on this machine."""

import contextlib
import gc
import multiprocessing
import os
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from flcav.config import Config
from flcav.interface.progress import Report
from flcav.machine.locks import only_writer
from flcav.machine.processes import exit_with_parent, start_server
from flcav.machine.threads import use_threads
from flcav.pipeline.engine.step import Record, Step, Work, read_value, write_done, write_started
from flcav.pipeline.provenance import Provenance, provenance

KILLED = "a step's process was killed from outside, most often for want of memory"
_queue: Any = None  # in a worker process: `Workers.reports`


@dataclass(frozen=True)
class Workers:
    """The workers for the steps of one folder."""

    submit: Callable[[Step, Record], Future[Any]]  # -> future value of the step
    reports: Any  # queue of (step, done, total, note)
    lent: bool = False  # whether a step can have several: it starts processes where the other workers are


class Engine(Protocol):
    """An executor of steps: processes, or a cluster."""

    def hands(self, folder: Path, jobs: int) -> contextlib.AbstractContextManager[Workers]:
        """Return a context of `jobs` workers for the steps in `folder`; leaving it by an exception stops them."""
        ...

    def stop(self) -> None:
        """Stop all workers of all folders."""
        ...


class Processes:
    """Worker processes of one thread each on this machine; they end with this process, however it ends."""

    @contextlib.contextmanager
    def hands(self, folder: Path, jobs: int) -> Iterator[Workers]:
        """Yield `jobs` processes; raises `OSError` where one was killed."""
        context = start_server()
        queue = context.Queue()
        made_by, started = replace(provenance(), threads=1), (queue, {**os.environ})
        with ProcessPoolExecutor(jobs, mp_context=context, initializer=_start, initargs=started) as pool:
            try:
                yield Workers(partial(_submit, pool, folder, made_by), queue, lent=True)
            except BrokenProcessPool:
                raise OSError(KILLED) from None
            except BaseException:
                for process in list(pool._processes.values()):  # of this pool alone: other runs may have theirs
                    process.terminate()
                raise

    def stop(self) -> None:
        """Terminate the processes."""
        for process in multiprocessing.active_children():
            process.terminate()


def perform(step: Step, folder: Path, record: Record, made_by: Provenance, report: Report) -> Any:
    """Execute a step in its folder below `folder`, where those it needs lie too; write its record, return its value."""
    own = folder / step.name
    with only_writer(own):  # as long as this process lives, which the one that asked may not
        own.mkdir(parents=True, exist_ok=True)
        report(0, 1, "")
        write_started(own, record)
        needs = {name: folder / name for name in step.needs}
        value = step.run(Work(own, needs, report), **step.arguments, **step.means)
        write_done(own, record, value, asdict(replace(made_by, seed=find_seed(step.arguments))))
        return read_value(own)


def find_seed(arguments: Any) -> int | None:
    """Return the seed among a step's arguments, or that of one of them, such as a recipe; None without one."""
    values: Any = dict(arguments) if isinstance(arguments, Mapping | Config) else getattr(arguments, "__dict__", {})
    if isinstance(seed := values.get("seed"), int):
        return seed
    return next((seed for each in values.values() if (seed := find_seed(each)) is not None), None)


def _start(queue: Any, variables: Mapping[str, str]) -> None:
    """Begin a worker; `variables`: the environment of the process that asks, which may differ from the server's."""
    global _queue
    _queue = queue
    os.environ.update(variables)
    gc.freeze()  # modules stay: the collector of cyclic garbage need not look at them again and again
    exit_with_parent()
    use_threads(1)


def _submit(pool: ProcessPoolExecutor, folder: Path, made_by: Provenance, step: Step, record: Record) -> Future[Any]:
    return pool.submit(_perform, step, folder, record, made_by)


def _perform(step: Step, folder: Path, record: Record, made_by: Provenance) -> Any:
    def report(done: int, total: int, note: str = "") -> None:
        _queue.put((step.name, done, total, note))

    return perform(step, folder, record, made_by, report)
