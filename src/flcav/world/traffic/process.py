"""The SUMO process, which makes the steps of recordings and of live worlds.

`serve` reads requests and writes an answer to each, JSON on a line. The first request of a run is its `Job`; the run is
a fork of this process, since libsumo holds one simulation per process and takes longer to load than a minute of
traffic. `{"step": Request}` makes a step, `{"record": {"steps": [...], "out": FILE}}` records the run into a file; the
answer is `States`, as at the start. `null` ends the run, and so does the answer `{"error": TEXT}`.
"""

import json
import os
import signal
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

from flcav.world.traffic.recording import record
from flcav.world.traffic.simulation import Job, Request, Simulation


def serve() -> None:
    """Make the run of each job that is read from stdin, in a fork."""
    import libsumo  # noqa: F401 - for the forks

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # left to the process that asks, which ends this one
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # where the process that asks is gone, end silently
    for line in sys.stdin.buffer:
        fork = os.fork()
        if not fork:
            try:
                _run(line)
                os._exit(0)
            finally:
                os._exit(1)
        if code := os.waitstatus_to_exitcode(os.waitpid(fork, 0)[1]):
            print(json.dumps({"error": f"exit code {code}"}), flush=True)


def _run(first: bytes) -> None:
    """Make the run of a job, from its first request to the last."""
    with os.fdopen(os.dup(1), "wb") as answers, tempfile.TemporaryFile("a+b", buffering=0) as said:
        os.dup2(said.fileno(), 1)  # SUMO's own output
        os.dup2(said.fileno(), 2)

        def answer(told: Mapping[str, object]) -> None:
            answers.write(json.dumps(told).encode() + b"\n")
            answers.flush()

        try:
            import libsumo

            job = Job(**json.loads(first))
            os.chdir(job.folder)  # in a path SUMO would take a comma for a separator, and ${...} for a variable
            simulation = Simulation(libsumo, job)
            answer(simulation.states())
            while request := json.loads(sys.stdin.buffer.readline() or "null"):
                said.truncate(0)
                if asked := request.get("record"):
                    record(simulation, asked["steps"], Path(asked["out"]))
                else:
                    simulation.step(Request(**request["step"]))
                answer(simulation.states())
            answer({})
        except BaseException as error:
            said.seek(0)
            words = said.read()[-500:].decode(errors="replace")
            answer({"error": f"{words}{type(error).__name__}: {error}"})
