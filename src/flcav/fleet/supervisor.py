"""Supervisor of a fleet's processes, which are forks of a process with all imports done, restarted when they end.

They end with the supervisor. A process that ends at once is restarted with increasing delay, up to half a minute, so
that a node that was refused, for its clock or its certificate, comes back once that is corrected.
"""

import contextlib
import ctypes
import json
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from flcav.storage.files import write_bytes

PROCESSES, LOGS = "processes.json", "logs"
TICK_S, LONGEST_S, ENDING_S = 0.1, 30.0, 5.0
STEADY_S = 10.0  # run time after which a process restarts without delay [s]
FLOWER = {
    "FLWR_TELEMETRY_ENABLED": "0",
    "FLWR_DISABLE_UPDATE_CHECK": "1",
    "RAY_USAGE_STATS_ENABLED": "0",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
}
PR_SET_PDEATHSIG = 1  # prctl(2)


@dataclass
class _Supervised:
    do: Callable[[], None]
    pid: int = 0
    started: float = 0.0
    pause_s: float = 0.0
    starts: int = 0


def supervise(
    folder: Path,
    processes: Mapping[str, Callable[[], None]],
    later: Mapping[str, Callable[[], None]] = {},
    is_up: Callable[[], bool] = lambda: True,
) -> None:
    """Run `processes`, by name, until this process receives SIGTERM or SIGINT, and those of `later` once `is_up`.

    `is_up` is called about ten times a second. Output goes to `folder`/logs, process ids to `folder`/processes.json.
    This process must have a single thread, since it forks.
    """
    ended = False

    def end(*_: object) -> None:
        nonlocal ended
        ended = True

    before = {number: signal.signal(number, end) for number in (signal.SIGTERM, signal.SIGINT)}
    all_ = {name: _Supervised(do) for name, do in processes.items()}
    waiting = dict(later)
    changed = False
    try:
        while not ended:
            changed |= _reap(all_)
            for name, process in all_.items():
                if not process.pid and time.monotonic() >= process.started + process.pause_s:
                    process.pid = _fork(folder, name, process.do)
                    process.started = time.monotonic()
                    process.starts += 1
                    changed = True
            if changed:
                status = {name: {"pid": process.pid, "starts": process.starts} for name, process in all_.items()}
                changed = not _write(folder / PROCESSES, json.dumps(status).encode())
            if is_up() and waiting:
                all_ |= {name: _Supervised(do) for name, do in waiting.items()}
                waiting = {}
            time.sleep(TICK_S)
    finally:
        _end(all_)
        (folder / PROCESSES).unlink(missing_ok=True)
        for number, handler in before.items():  # further signals while this process ends are ignored
            signal.signal(number, signal.SIG_IGN if ended else handler)


def read_processes(folder: Path) -> dict[str, int]:
    """Return the ids of the running processes supervised in `folder`, by name."""
    try:
        return {
            name: process["pid"]
            for name, process in json.loads((folder / PROCESSES).read_bytes()).items()
            if process["pid"]
        }
    except FileNotFoundError:
        return {}


def _write(path: Path, data: bytes) -> bool:
    """Write a status file for other processes; return whether that succeeded."""
    try:
        write_bytes(path, data)
    except OSError:
        return False
    return True


def _reap(all_: Mapping[str, _Supervised]) -> bool:
    """Note the processes that have ended; return whether there are any."""
    changed = False
    for process in all_.values():
        if process.pid and os.waitpid(process.pid, os.WNOHANG)[0]:
            steady = time.monotonic() - process.started > STEADY_S
            process.pause_s = 0.0 if steady else min(max(2 * process.pause_s, 1.0), LONGEST_S)
            process.pid = 0
            changed = True
    return changed


def _end(all_: Mapping[str, _Supervised]) -> None:
    for how in (signal.SIGTERM, signal.SIGKILL):
        for process in all_.values():
            if process.pid:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(process.pid, how)
        end = time.monotonic() + ENDING_S
        while any(process.pid for process in all_.values()) and time.monotonic() < end:
            _reap(all_)
            time.sleep(0.02)


def end_with_parent(parent: int, how: signal.Signals) -> None:
    """Let this fork of `parent` receive a signal when that ends (Linux); exit if it has ended already."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, how)
    if os.getppid() != parent:
        os._exit(1)


def _fork(folder: Path, name: str, do: Callable[[], None]) -> int:
    parent = os.getpid()
    child = os.fork()
    if child:
        return child
    code = 1
    try:
        end_with_parent(parent, signal.SIGTERM)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, signal.SIG_DFL)
        base = folder / LOGS / name
        base.parent.mkdir(parents=True, exist_ok=True)
        log = os.open(base.with_suffix(".log"), os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
        for stream in (1, 2):
            os.dup2(log, stream)
        sys.stdout, sys.stderr = os.fdopen(1, "w", buffering=1), os.fdopen(2, "w", buffering=1)
        os.environ.update(FLOWER)
        os.environ["FLWR_HOME"] = str(folder / "flower" / name)
        do()
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        with contextlib.suppress(BaseException):  # also on a full disk this process must end here
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code & 255)
