"""Recording engines on this machine: in this process, or in a pool of processes."""

import contextlib
import multiprocessing
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

from flcav.dataset.recording.jobs import Engine, Job, perform
from flcav.machine.processes import exit_with_parent, start_server
from flcav.machine.threads import use_threads
from flcav.sources.source import Source

POLL_S = 0.2

_job: Any = None  # in a worker process: source, folder, and the shared counter of written frames


@contextlib.contextmanager
def start_processes(source: Source, work: Path, jobs: int, wrote: Callable[[int], None]) -> Iterator[Engine]:
    """Yield an engine of `jobs` processes that perform jobs of `source` below the folder `work`.

    It calls `wrote` with the number of frames written so far. A single one is this process; more are child
    processes of one thread each, which end with this one, even if it is killed.
    """
    if jobs == 1:
        yield _InProcessEngine(source, work, wrote)
        return
    context = start_server()
    written = context.Value("q", 0)
    with (
        ProcessPoolExecutor(jobs, mp_context=context, initializer=_begin, initargs=(source, work, written)) as pool,
        _children_end_on_error(),
    ):
        yield _PoolEngine(jobs, pool, lambda: wrote(written.value))


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
    """An engine on a process pool."""

    def __init__(self, slots: int, pool: ProcessPoolExecutor, report: Callable[[], None]) -> None:
        self.slots, self._pool, self._report = slots, pool, report
        self._tasks: dict[Future[None], Job] = {}

    def submit(self, task: Job) -> None:
        self._tasks[self._pool.submit(_perform, task)] = task

    def wait(self) -> list[Job]:
        done: set[Future[None]] = set()
        while not done:
            done, _ = wait(self._tasks, timeout=POLL_S, return_when=FIRST_COMPLETED)
            self._report()
        for future in done:
            _raise_failure(future)
        return [self._tasks.pop(future) for future in done]


def _raise_failure(future: Future[None]) -> None:
    try:
        future.result()
    except BrokenProcessPool:
        raise OSError("a worker was killed from outside, most often for want of memory: try fewer jobs") from None


def _begin(source: Source, work: Path, written: Any) -> None:
    global _job
    _job = source, work, written
    use_threads(1)
    exit_with_parent()


def _perform(task: Job) -> None:
    source, work, written = _job

    def count_frame() -> None:
        with written.get_lock():
            written.value += 1

    perform(source, task, work, count_frame)


@contextlib.contextmanager
def _children_end_on_error() -> Iterator[None]:
    before = set(multiprocessing.active_children())
    try:
        yield
    except BaseException:
        for child in set(multiprocessing.active_children()) - before:
            child.terminate()
        raise
