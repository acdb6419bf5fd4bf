"""Client of the SUMO process, which is started with the first simulation and kept for the next."""

import atexit
import os
import subprocess
import sys
import threading
from pathlib import Path

SERVE = "flcav.world.traffic.sumo_process:serve"  # what that process runs
ROOT = str(Path(__file__).parents[3])  # where flcav is, installed or not

_lock = threading.Lock()
_process: tuple[int, subprocess.Popen[str]] | None = None  # with the id of its parent: a fork starts its own


def simulate_in(folder: Path) -> None:
    """Simulate the job in `folder`, see `sumo_process`; raises `RuntimeError` with SUMO's output where it fails."""
    with _lock:
        try:
            process = _running()
            assert process.stdin is not None
            assert process.stdout is not None
            process.stdin.write(f"{folder}\n")
            process.stdin.flush()
            code = process.stdout.readline().strip()
        except BrokenPipeError:
            code = ""
        except BaseException:
            _stop()  # or its answer would be taken for that to the next job
            raise
    if code != "0":
        if not code:
            _stop()
        said = folder / "said.txt"
        raise RuntimeError(said.read_text()[-500:].strip() if said.exists() else f"exit code {code}")


def start_server(serve: str) -> subprocess.Popen[str]:
    """Start a process that runs the function `serve`, "module:name", of flcav, with pipes to its input and output."""
    module, name = serve.split(":")
    code = f"import sys; sys.path.append({ROOT!r}); from {module} import {name}; {name}()"
    command = [sys.executable, "-P", "-c", code]  # -P: a user's json.py in the working directory is not imported
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def _running() -> subprocess.Popen[str]:
    """Return the SUMO process of this process; start it where there is none."""
    global _process
    if _process is None or _process[0] != os.getpid() or _process[1].poll() is not None:
        started = start_server(SERVE)
        _process = os.getpid(), started
    return _process[1]


@atexit.register
def _stop() -> None:
    """Kill the SUMO process, if this process started it."""
    global _process
    if _process is not None and _process[0] == os.getpid():
        _process[1].kill()
        _process[1].communicate()
        _process = None
