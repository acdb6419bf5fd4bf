"""The process that SUMO runs in: steps, pedestrians' motion, and the state after each."""

import json
import math
import os
import signal
import sys
import traceback
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from flcav.world.scenarios.director import Director
from flcav.world.scenarios.scenario import Scenario
from flcav.world.scenarios.stage import State

HURRY_MPS = 2.5  # a jog; SUMO's pedestrians walk at no more than 1.7 m/s


class Walkers:
    """All pedestrians of a run, followed step by step."""

    def __init__(self, step_s: float) -> None:
        """Begin with nobody; steps last `step_s`."""
        self.states: dict[str, State] = {}  # of those there now, in SUMO's order
        self._step_s = step_s
        self._behind: dict[str, deque[tuple[float, float]]] = {}  # path that SUMO's pedestrian has walked alone

    def follow(self, targets: Mapping[str, State]) -> None:
        """Take a step in which SUMO's pedestrians come to `targets`, and those who are not in it leave."""
        self.states = {name: self._follow(name, target) for name, target in targets.items()}
        self._behind = {name: path for name, path in self._behind.items() if path and name in targets}

    def _follow(self, name: str, target: State) -> State:
        """Return `target`, or, if it is out of reach, a state on the way with angle and speed of the motion."""
        if name not in self.states:
            return target
        path = self._behind.setdefault(name, deque())
        path.append(target[:2])
        start_x, start_y = x, y = self.states[name][:2]
        left = HURRY_MPS * self._step_s
        while path:
            to_x, to_y = path[0]
            distance = math.hypot(to_x - x, to_y - y)
            if distance > left:
                x, y = x + (to_x - x) * left / distance, y + (to_y - y) * left / distance
                moved_x, moved_y = x - start_x, y - start_y
                return x, y, math.degrees(math.atan2(moved_x, moved_y)), math.hypot(moved_x, moved_y) / self._step_s
            left -= distance
            x, y = path.popleft()
        return target


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
