"""The SUMO process: simulation of jobs, and pedestrians of limited speed.

`serve` reads a folder with `job.json` from each line of its input, and answers with an exit code when `out.npz` and
`said.txt` are there. libsumo holds one simulation per process, and a second start silently replaces the first.
Therefore only this process imports it, and each simulation is a fork of this process: loading libsumo takes longer than
a minute of traffic.

`Walkers` limits the speed of pedestrians. In SUMO's "striping" model they jump: up to three stripes aside in one step,
and from one end of a junction's corner to the other where they wait for one crossing and another turns green. Here a
pedestrian who falls behind follows the path of SUMO's pedestrian at no more than `HURRY_MPS` until caught up. Nothing
of later steps is used.
"""

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

HURRY_MPS = 2.5  # jogging speed; the pedestrians of the demand walk at no more than 1.7 m/s
STEP_S = 0.1


class Walkers:
    """The pedestrians of a run, with limited speed: they follow SUMO's pedestrians step by step."""

    def __init__(self, step_s: float) -> None:
        """Start without pedestrians; `step_s` is the duration of a step [s]."""
        self.states: dict[str, State] = {}  # of those present now, in SUMO's order
        self._step_s = step_s
        self._behind: dict[str, deque[tuple[float, float]]] = {}  # path between a pedestrian and SUMO's

    def follow(self, targets: Mapping[str, State]) -> None:
        """Advance by one step, in which SUMO's pedestrians reach `targets`; those not among them leave."""
        self.states = {name: self._follow(name, target) for name, target in targets.items()}
        self._behind = {name: path for name, path in self._behind.items() if path and name in targets}

    def _follow(self, name: str, target: State) -> State:
        """Return `target`, or where it is out of reach the state on the path to it, with its own angle and speed."""
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


def start_sumo(sumo: Any, net: Path, routes: Path, seed: int) -> None:
    """Start libsumo, the module `sumo`, with the demand in the file `routes`."""
    options = {
        "net-file": net,
        "route-files": routes,
        "seed": seed,
        "step-length": STEP_S,
        "default.action-step-length": 0.5,  # drivers decide twice a second: the simulation is three times as fast
        "lanechange.duration": 2,
        "time-to-teleport": -1,  # vehicles in a jam are not removed
        "collision.action": "none",
        "no-step-log": "true",
        "no-warnings": "true",
    }
    sumo.start(["sumo", *(part for name, value in options.items() for part in (f"--{name}", str(value)))])


def run_sumo(
    net: Path,
    routes: Path,
    followers: Mapping[str, tuple[str, str, list[str]]],
    seed: int,
    steps: list[int],
    out: Path,
    scenarios: list[Scenario],
) -> None:
    """Simulate up to the last of `steps` (T,), ascending, of 0.1 s each, and write the states at these to `out` (.npz).

    When a vehicle has left that has one of the `followers` (name, type, edges), that one enters.

    Arrays: `id` and `type` (A,) of each actor; `row` (N, 2) instant and actor of each state; `state` (N, 4) SUMO's
    front x, y [m], angle [deg clockwise from north] and speed [m/s]; `light` (J,) and `light_state` (T, J) letters of
    each light's links; `events`, the scenarios that took place, as JSON.
    """
    import libsumo

    start_sumo(libsumo, net, routes, seed)
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
            kinds.append(kind.partition("@")[0])  # "type@vehicle" is SUMO's copy of a type for one vehicle
        rows.append((instant, index[name]))
        states.append(state)

    def state_of(domain: Any, name: str) -> State:
        return (*domain.getPosition(name), domain.getAngle(name), domain.getSpeed(name))

    for instant, step in enumerate(steps):
        while now < step:
            libsumo.simulationStep()
            now += 1
            for name in libsumo.simulation.getArrivedIDList() if followers else ():
                if name in followers:
                    follower, kind, edges = followers[name]
                    libsumo.route.add(follower, edges)
                    libsumo.vehicle.add(
                        follower, follower, kind, departPos="base", departSpeed="max", departLane="best"
                    )
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
        for instant, step in enumerate(steps):  # only now, since a script may place a prop at earlier steps
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
        events=np.array(json.dumps([event._asdict() for event in director.events] if director else [])),
    )


def serve() -> None:
    """Simulate the job in each folder that is read from stdin, each in a fork; print its exit code to stdout."""
    import libsumo  # noqa: F401 - for the forks

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # left to the process that asks, which ends this one
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # where the process that asks is gone, end silently
    for line in sys.stdin:
        fork = os.fork()
        if not fork:
            _simulate(Path(line.rstrip("\n")))
        print(os.waitstatus_to_exitcode(os.waitpid(fork, 0)[1]), flush=True)


def _simulate(folder: Path) -> NoReturn:
    """Simulate the job in the folder, and end this process; its output and SUMO's go to `said.txt`."""
    code = 1
    try:
        with (folder / "said.txt").open("w") as said:
            os.dup2(said.fileno(), sys.stdout.fileno())
            os.dup2(said.fileno(), sys.stderr.fileno())
        job = json.loads((folder / "job.json").read_text())
        scenarios = [Scenario.model_validate(scenario) for scenario in job["scenarios"]]
        os.chdir(folder)  # in a path SUMO would take a comma for a separator, and ${...} for a variable
        net, routes = Path("linked.net.xml"), Path("linked.rou.xml")
        net.symlink_to(job["net"])
        routes.symlink_to(job["routes"])
        run_sumo(net, routes, job["followers"], job["seed"], job["steps"], Path("out.npz"), scenarios)
        code = 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
