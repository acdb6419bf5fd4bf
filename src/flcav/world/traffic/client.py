"""Client of the SUMO process, which is reused for the next run."""

import atexit
import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from flcav.world.traffic.demand import Demand
from flcav.world.traffic.simulation import NET, ROUTES, States, StepRequest, TrafficJob

SERVE = "flcav.world.traffic.process:serve_traffic"  # entry point of the process
ROOT = str(Path(__file__).parents[3])  # folder that contains flcav, installed or not

_idle: list[tuple[int, subprocess.Popen[str]]] = []  # processes without a run, with the id of their parent


def write_job(folder: Path, net: Path, demand: Demand, seed: int) -> TrafficJob:
    """Write the files of a run, which must exist until it has begun, into `folder`; return its job."""
    (folder / NET).symlink_to(net.absolute())
    (folder / ROUTES).write_text(demand.routes, encoding="utf-8")
    return TrafficJob(str(folder.absolute()), seed, demand.followers)


class Sumo:
    """A SUMO run in a child process, which it occupies until it is closed."""

    def __init__(self, job: TrafficJob, failure: str = "SUMO failed") -> None:
        """Start a run. Raises `RuntimeError`, beginning with `failure`, where SUMO fails, now or later."""
        self._failure = failure
        self._process: subprocess.Popen[str] | None = _take_process()
        self.begun: States = self._ask(job._asdict())

    def step(self, request: StepRequest) -> States:
        """Advance by a step with these external inputs; return the states after it."""
        return self._ask({"step": request._asdict()})

    def record(self, steps: Sequence[int], out: Path) -> None:
        """Record a run that has not made a step yet: see `process.record_traffic`."""
        self._ask({"record": {"steps": steps, "out": str(out.absolute())}})

    def close(self) -> None:
        """End the run; its process is reused for the next one."""
        if self._process is not None:
            with contextlib.suppress(RuntimeError):
                self._ask(None)
                _idle.append((os.getpid(), self._process))
            self._process = None

    def _ask(self, request: Any) -> dict[str, Any]:
        """Send a request, and return its answer."""
        if self._process is None:
            raise RuntimeError("the live world is closed")
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            self._process.stdin.write(json.dumps(request) + "\n")
            self._process.stdin.flush()
            line = self._process.stdout.readline()
        except BrokenPipeError:
            line = ""
        except BaseException:
            self._kill()  # otherwise its answer would be mistaken for that to the next request
            raise
        answer = json.loads(line) if line else {"error": "its process has ended"}
        if "error" in answer:
            self._kill()
            raise RuntimeError(f"{self._failure}: {answer['error']}".strip())
        return answer

    def _kill(self) -> None:
        if self._process is not None:
            _end(self._process)
            self._process = None


def _take_process() -> subprocess.Popen[str]:
    """Return an idle SUMO process, or start one; a fork of this process does not share its processes."""
    with contextlib.suppress(IndexError):  # there is none, or another thread has taken it
        while True:
            parent, process = _idle.pop()
            if parent == os.getpid() and process.poll() is None:
                return process
    module, name = SERVE.split(":")
    code = f"import sys; sys.path.append({ROOT!r}); from {module} import {name}; {name}()"
    command = [sys.executable, "-P", "-c", code]  # -P: a user's json.py in the working directory is not imported
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


@atexit.register
def _stop() -> None:
    """Kill the idle processes that this process started."""
    for parent, process in _idle:
        if parent == os.getpid():
            _end(process)
    _idle.clear()


def _end(process: subprocess.Popen[str]) -> None:
    """Kill a process; its run ends by itself at its next answer."""
    with contextlib.suppress(BrokenPipeError), process:
        process.kill()
