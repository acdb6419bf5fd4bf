"""Scenes rendered by several processes at once."""

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

from flcav.dataset.scenes import write_scene
from flcav.sources.source import Source

POLL_S = 0.2
_THREADS = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")  # read when a library is first loaded

_written: Any = None  # in a worker: the count of frames that all workers share


def write_scenes(source: Source, scenes: Sequence[str], work: Path, jobs: int, wrote: Callable[[int], None]) -> None:
    """Write each of `scenes` below `work`; calls `wrote` with the frames written so far.

    One job works in this process. More are processes of their own, which end with this one however it ends.
    """
    if jobs == 1 or len(scenes) < 2:
        count = 0

        def count_frame() -> None:
            nonlocal count
            count += 1
            wrote(count)

        for scene in scenes:
            write_scene(source, scene, work, count_frame)
        return

    context = multiprocessing.get_context("spawn")
    written = context.Value("q", 0)
    jobs = min(jobs, len(scenes))
    with (
        _threads_per_process(max(1, (os.cpu_count() or 1) // jobs)),
        ProcessPoolExecutor(jobs, mp_context=context, initializer=_begin, initargs=(written,)) as pool,
        _children_end_on_error(),
    ):
        pending = {pool.submit(_write_scene, source, scene, work) for scene in scenes}
        while pending:
            done, pending = wait(pending, timeout=POLL_S, return_when=FIRST_EXCEPTION)
            wrote(written.value)
            for future in done:
                _raise_failure(future)


def _raise_failure(future: Future[None]) -> None:
    try:
        future.result()
    except BrokenProcessPool:
        raise OSError("a worker was killed from outside, most often for want of memory: try fewer jobs") from None


def _begin(written: Any) -> None:
    global _written
    _written = written
    end_with_parent()


def end_with_parent() -> None:
    """In a worker: leave Ctrl-C, which reaches the whole group, to the parent, and end when it has, however it did."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_exit_after_parent, daemon=True).start()


def _exit_after_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _write_scene(source: Source, scene: str, work: Path) -> None:
    write_scene(source, scene, work, _count_frame)


def _count_frame() -> None:
    with _written.get_lock():
        _written.value += 1


@contextlib.contextmanager
def _children_end_on_error() -> Iterator[None]:
    before = set(multiprocessing.active_children())
    try:
        yield
    except BaseException:
        for child in set(multiprocessing.active_children()) - before:
            child.terminate()
        raise


@contextlib.contextmanager
def _threads_per_process(count: int) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, str(count)))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
