"""Recording engines: this process, a pool of processes, or actors on the machines of a Ray cluster."""

import contextlib
import os
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

from flcav.dataset.recording.jobs import Engine, Job, Part, perform
from flcav.machine.processes import process_pool, start_server
from flcav.machine.ray_engine import actor_pool
from flcav.sources.source import Isolated, Source

POLL_S = 0.2

_job: Any = None  # in a worker process: source, folder, and the shared counter of written frames


@contextlib.contextmanager
def start_processes(source: Source, work: Path, jobs: int, wrote: Callable[[int], None]) -> Iterator[Engine]:
    """Yield an engine of `jobs` processes that perform jobs of `source` below the folder `work`.

    It calls `wrote` with the number of frames written so far. A single one is this process, unless the source is
    `Isolated`; others are child processes of one thread each, which end with this one, even if it is killed.
    """
    if jobs == 1 and not isinstance(source, Isolated):
        yield _InProcessEngine(source, work, wrote)
        return
    written = start_server().Value("q", 0)
    with process_pool(jobs, _begin, source, work, written) as pool:
        try:
            yield _PoolEngine(jobs, lambda task: pool.submit(_perform, task), lambda _: wrote(written.value))
        except BrokenProcessPool:
            if isinstance(source, Isolated):
                raise OSError(source.explain_end()) from None
            raise


@contextlib.contextmanager
def start_actors(source: Source, work: Path, jobs: int, wrote: Callable[[int], None]) -> Iterator[Engine]:
    """Yield an engine of `jobs` Ray actors that perform jobs of `source` below the folder `work`.

    The folder must be on storage shared by all machines, and flcav installed on each. RAY_ADDRESS names the cluster;
    without it, Ray is started on this machine. It calls `wrote` with the number of frames written so far, as parts are
    completed. Raises `InputError` where Ray is not installed.
    """
    with actor_pool(jobs, _Recorder, source, work.absolute()) as pool:
        yield _PoolEngine(jobs, lambda task: pool.lend(lambda actor: actor.call(_Recorder.perform, task)), wrote)


class _InProcessEngine:
    """An engine that performs jobs in sequence in this process."""

    slots = 1

    def __init__(self, source: Source, work: Path, wrote: Callable[[int], None]) -> None:
        self._source, self._work, self._wrote = source, work, wrote
        self._tasks: deque[Job] = deque()
        self._count = 0

    def submit(self, task: Job) -> None:
        self._tasks.append(task)

    def wait(self) -> list[Job]:
        task = self._tasks.popleft()
        perform(self._source, task, self._work, self._count_frame)
        return [task]

    def _count_frame(self) -> None:
        self._count += 1
        self._wrote(self._count)


class _PoolEngine:
    """An engine on a pool of workers; calls `wrote` with the frames of the parts that are completed."""

    def __init__(self, slots: int, start: Callable[[Job], Future[None]], wrote: Callable[[int], None]) -> None:
        self.slots, self._start, self._wrote = slots, start, wrote
        self._tasks: dict[Future[None], Job] = {}
        self._count = 0

    def submit(self, task: Job) -> None:
        self._tasks[self._start(task)] = task

    def wait(self) -> list[Job]:
        done: set[Future[None]] = set()
        while not done:
            done, _ = wait(self._tasks, timeout=POLL_S, return_when=FIRST_COMPLETED)
            self._count += sum(task.frames for each in done if isinstance(task := self._tasks[each], Part))
            self._wrote(self._count)
        for future in done:
            future.result()
        return [self._tasks.pop(future) for future in done]


def _begin(*job: Any) -> None:
    global _job
    _job = job
    if isinstance(job[0], Isolated):
        silent = os.open(os.devnull, os.O_WRONLY)
        for stream in (1, 2):  # what its library prints; errors are returned
            os.dup2(silent, stream)


def _perform(task: Job) -> None:
    source, work, written = _job

    def count_frame() -> None:
        with written.get_lock():
            written.value += 1

    perform(source, task, work, count_frame)


class _Recorder:
    """A Ray actor that performs jobs in sequence; its source keeps the scene that it built last."""

    def __init__(self, source: Source, work: Path) -> None:
        self._source, self._work = source, work

    def perform(self, task: Job) -> None:
        if not self._work.is_dir():
            raise OSError(
                f"{self._work}: not seen from {os.uname().nodename}; record into storage that all nodes share"
            )
        perform(self._source, task, self._work, lambda: None)
