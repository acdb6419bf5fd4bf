"""Worker processes that end with the process that started them, and a session on a Ray cluster."""

import contextlib
import logging
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Iterator
from multiprocessing import forkserver
from multiprocessing.context import BaseContext
from types import ModuleType
from typing import Any

from flcav.config import InputError
from flcav.interface.extras import format_install_command
from flcav.machine.threads import VARIABLES, threads_of_children

_STARTING = threading.Lock()  # of the fork server: only one thread at a time changes the environment
STORE_BYTES = 128_000_000  # object store of a Ray started here: only jobs and pieces of files pass through it


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
def ray_session(jobs: int, asked: str = "--engine ray") -> Iterator[ModuleType]:
    """Yield the module `ray`, connected to the cluster of RAY_ADDRESS or, without it, to a local one of `jobs` CPUs.

    Its workers compute on one thread each. Raises `InputError` where Ray is not installed; `asked` is what needs it.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # without it, Ray prints a warning
    try:
        import ray  # pyright: ignore[reportMissingImports]: an extra
    except ImportError:
        raise InputError(f"{asked} needs Ray, which is not installed: {format_install_command('ray')}") from None
    variables: dict[str, str] = dict.fromkeys(VARIABLES, "1")
    local: dict[str, Any] = {}
    if "RAY_ADDRESS" not in os.environ:
        local = {"num_cpus": jobs, "object_store_memory": STORE_BYTES, "include_dashboard": False}
        variables["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))  # workers find modules as this process does
    ray.init(
        **local,
        runtime_env={"env_vars": variables},
        log_to_driver=False,
        logging_level=logging.ERROR,
    )
    try:
        yield ray
    finally:
        ray.shutdown()
