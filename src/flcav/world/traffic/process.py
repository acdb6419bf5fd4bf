"""The SUMO process, which makes the steps of recordings and of live worlds, and the recorded states.

`serve_traffic` reads requests and writes their answers, one line of JSON each. The first request of a run is its
`TrafficJob`; the run is a fork of this process, since libsumo holds one simulation per process and takes longer to load
than a minute of traffic. `{"step": StepRequest}` makes a step,
`{"record": {"steps": [...], "out": FILE}}` records the run into a file; the answer is `States`, as at the start. `null`
ends the run, and so does the answer `{"error": TEXT}`.
"""

import json
import os
import signal
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from flcav.arrays import Array, Words
from flcav.world.traffic.simulation import Simulation, States, StepRequest, TrafficJob


def serve_traffic() -> None:
    """Run the jobs that are read from stdin in forks."""
    import libsumo  # noqa: F401 - for the forks

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # left to the parent process, which ends this one
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # end silently if the parent process is gone
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
    """Run a job, from its first request to the last."""
    with os.fdopen(os.dup(1), "wb") as answers, tempfile.TemporaryFile("a+b", buffering=0) as said:
        os.dup2(said.fileno(), 1)  # SUMO's own output
        os.dup2(said.fileno(), 2)

        def answer(message: Mapping[str, object]) -> None:
            answers.write(json.dumps(message).encode() + b"\n")
            answers.flush()

        try:
            import libsumo

            job = TrafficJob(**json.loads(first))
            os.chdir(job.folder)  # in a path SUMO would take a comma for a separator, and ${...} for a variable
            simulation = Simulation(libsumo, job)
            answer(simulation.states())
            while request := json.loads(sys.stdin.buffer.readline() or "null"):
                said.truncate(0)
                if recording := request.get("record"):
                    record_traffic(simulation, recording["steps"], Path(recording["out"]))
                else:
                    simulation.step(StepRequest(**request["step"]))
                answer(simulation.states())
            answer({})
        except BaseException as error:
            said.seek(0)
            words = said.read()[-500:].decode(errors="replace")
            answer({"error": f"{words}{type(error).__name__}: {error}"})


class RecordedTraffic(NamedTuple):
    """The states of A actors and J signalised junctions at T instants."""

    id: Words  # (A,)
    type: Words  # (A,) SUMO's vehicle types
    state: Array  # (T, A, 4) SUMO's front x, y [m], angle [deg], speed [m/s]; NaN where absent
    light: Words  # (J,) junctions
    light_state: Words  # (T, J) state letters of a junction's links
    events: Words  # () scenarios that have happened, as JSON


def record_traffic(simulation: Simulation, steps: Sequence[int], out: Path) -> None:
    """Simulate up to the last of `steps` (T,), ascending, and write the `RecordedTraffic` at these steps to `out`."""
    lights = simulation.sumo.trafficlight
    director = simulation.director
    junctions, now = lights.getIDList(), 0
    seen: list[States] = []
    letters: list[list[str]] = []
    for step in steps:
        while now < step:
            simulation.advance()
            now += 1
        seen.append(simulation.states())
        letters.append([lights.getRedYellowGreenState(junction) for junction in junctions])
    if director:
        for states, step in zip(seen, steps):  # only now, since a script may place a prop at earlier steps
            states |= {name: (kind, *state) for name, kind, state in director.props(step)}
    kinds = {name: actor_state[0] for states in seen for name, actor_state in states.items()}
    column = {name: i for i, name in enumerate(kinds)}
    state = np.full((len(steps), len(kinds), 4), np.nan)
    for row, states in zip(state, seen):
        row[[column[name] for name in states]] = np.array([actor_state[1:] for actor_state in states.values()]).reshape(
            -1, 4
        )
    recorded = RecordedTraffic(
        id=np.array(list(kinds), dtype=np.str_),
        type=np.array(list(kinds.values()), dtype=np.str_),
        state=state,
        light=np.array(junctions, dtype=np.str_),
        light_state=np.array(letters, dtype=np.str_).reshape(len(steps), len(junctions)),
        events=np.array(json.dumps([event._asdict() for event in director.events] if director else [])),
    )
    np.savez(out, **recorded._asdict())
