"""Worker processes that end with the process that started them."""

import contextlib
import gc
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import forkserver
from multiprocessing.context import BaseContext
from typing import TypeVarTuple

from flcav.machine.threads import threads_of_children, use_threads

Arguments = TypeVarTuple("Arguments")

KILLED = "a worker was killed from outside, most often for want of memory: try fewer jobs"

_STARTING = threading.Lock()  # of the fork server: only one thread at a time changes the environment


def start_server() -> BaseContext:
    """Start the fork server of this process, if there is none, and return the context that makes workers of it.

    The server is a process of one thread that imports the modules of flcav that this process has now; a worker is a
    fork of it, so that many workers import them once. Where it cannot start, each worker is a process that imports them
    itself (spawn).
    """
    modules = [name for name in [*sys.modules] if name.partition(".")[0] == "flcav"]
    with _STARTING, threads_of_children(1):
        multiprocessing.set_forkserver_preload(modules)
        try:
            forkserver.ensure_running()
        except OSError:  # its socket is in the folder of temporary files, whose path may be too long for one
            return multiprocessing.get_context("spawn")
    return multiprocessing.get_context("forkserver")


def exit_with_parent() -> None:
    """Make this worker process ignore Ctrl-C, which the parent handles, and exit when the parent has ended."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_exit_after_parent, daemon=True).start()


def _exit_after_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextlib.contextmanager
def process_pool(
    jobs: int, begin: Callable[[*Arguments], None], *arguments: *Arguments
) -> Iterator[ProcessPoolExecutor]:
    """Yield a pool of `jobs` worker processes of one thread each, in which `begin(*arguments)` is called first.

    They have the environment of this process and end with it, however it ends; an exception ends them at once. Raises
    `OSError` where one was killed.
    """
    started = ({**os.environ}, begin, arguments)
    with ProcessPoolExecutor(jobs, mp_context=start_server(), initializer=_begin, initargs=started) as pool:
        try:
            yield pool
        except BrokenProcessPool:
            raise OSError(KILLED) from None
        except BaseException:
            for process in list(pool._processes.values()):
                process.terminate()
            raise


def _begin(variables: Mapping[str, str], begin: Callable[[*Arguments], None], arguments: tuple[*Arguments]) -> None:
    """Begin a worker; `variables`: the environment of the process that asks, which may differ from the server's."""
    os.environ.update(variables)
    gc.freeze()  # modules stay: the collector of cyclic garbage need not look at them again and again
    exit_with_parent()
    use_threads(1)
    begin(*arguments)
