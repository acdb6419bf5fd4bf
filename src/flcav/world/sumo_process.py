"""What the process beside this one does that simulates traffic, see `flcav.world.sumo`.

Each line that it reads names a folder with job.json; when out.npz and said.txt lie there, it answers with an exit code.
libsumo holds one simulation per process, and a second start silently replaces the first; so nobody imports it but here,
and each simulation is a fork of this process: loading libsumo takes longer than a minute of traffic.
"""

import json
import os
import signal
import sys
import traceback
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from flcav.world.scenarios.director import Director
from flcav.world.scenarios.scenario import Scenario
from flcav.world.scenarios.stage import State
from flcav.world.walking import Walkers

STEP_S = 0.1


def run(net: Path, routes: Path, seed: int, steps: list[int], out: Path, scenarios: list[Scenario]) -> None:
    """Simulate up to the last of `steps` (ascending, of 0.1 s) and write what was read at each to `out` (.npz).

    Arrays: `id`, `type` (A,); `row` (N, 2) instant and actor index; `state` (N, 4) SUMO's x, y [m], angle [deg
    clockwise from north] and speed [m/s]; `light` (J,) and `light_state` (T, J) letters of each light's links; `events`
    the scenarios that happened, as JSON.
    """
    import libsumo

    options = {
        "net-file": net,
        "route-files": routes,
        "seed": seed,
        "step-length": STEP_S,
        "default.action-step-length": 0.5,  # drivers decide twice a second: three times as fast
        "lanechange.duration": 2,
        "time-to-teleport": -1,  # nobody vanishes from a jam
        "collision.action": "none",
        "no-step-log": "true",
        "no-warnings": "true",
    }
    libsumo.start(["sumo", *(part for name, value in options.items() for part in (f"--{name}", str(value)))])
    director = Director(libsumo, net, scenarios) if scenarios else None
    walkers = Walkers(STEP_S)
    index: dict[str, int] = {}
    kinds: list[str] = []
    rows: list[tuple[int, int]] = []
    states: list[tuple[float, float, float, float]] = []
    lights = libsumo.trafficlight.getIDList()
    light_states: list[list[str]] = []
    now = 0

    def note(instant: int, name: str, kind: str, state: State) -> None:
        if name not in index:
            index[name] = len(kinds)
            kinds.append(kind.partition("@")[0])  # what SUMO makes of a type once somebody's is changed
        rows.append((instant, index[name]))
        states.append(state)

    def state_of(domain: Any, name: str) -> State:
        return (*domain.getPosition(name), domain.getAngle(name), domain.getSpeed(name))

    for instant, step in enumerate(steps):
        while now < step:
            libsumo.simulationStep()
            now += 1
            walkers.follow({name: state_of(libsumo.person, name) for name in libsumo.person.getIDList()})
            if director:
                director.direct()
        for name in libsumo.vehicle.getIDList():
            state = state_of(libsumo.vehicle, name)
            kind = libsumo.vehicle.getTypeID(name)
            note(instant, name, kind, director.stage.seen(name, state) if director else state)
        for name, state in walkers.states.items():
            note(instant, name, libsumo.person.getTypeID(name), state)
        light_states.append([libsumo.trafficlight.getRedYellowGreenState(light) for light in lights])
    libsumo.close()
    if director:
        for instant, step in enumerate(steps):  # only now: a script may say where somebody has been all along
            for prop in director.props(step):
                note(instant, *prop)
    np.savez(
        out,
        id=np.array(list(index), dtype=np.str_),
        type=np.array(kinds, dtype=np.str_),
        row=np.array(rows, dtype=np.int64).reshape(-1, 2),
        state=np.array(states, dtype=np.float64).reshape(-1, 4),
        light=np.array(lights, dtype=np.str_),
        light_state=np.array(light_states, dtype=np.str_).reshape(len(steps), len(lights)),
        events=np.array(json.dumps(director.events if director else [])),
    )


def serve() -> None:
    """Simulate the jobs whose folders are read, until there are no more."""
    import libsumo  # noqa: F401 - for the forks

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # is the matter of the process that asks, which ends this one
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # nobody waits for the answer any more: end without a word
    for line in sys.stdin:
        fork = os.fork()
        if not fork:
            _simulate(Path(line.rstrip("\n")))
        print(os.waitstatus_to_exitcode(os.waitpid(fork, 0)[1]), flush=True)


def _simulate(folder: Path) -> NoReturn:
    """Do the job in the folder, and end this process; what it and SUMO say goes into said.txt."""
    code = 1
    try:
        with (folder / "said.txt").open("w") as said:
            os.dup2(said.fileno(), sys.stdout.fileno())
            os.dup2(said.fileno(), sys.stderr.fileno())
        job = json.loads((folder / "job.json").read_text())
        scenarios = [Scenario.model_validate(scenario) for scenario in job["scenarios"]]
        run(Path(job["net"]), Path(job["routes"]), job["seed"], job["steps"], folder / "out.npz", scenarios)
        code = 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
