"""The SUMO process of a live world: traffic that is stepped from outside, and reacts to what is driven there.

`serve` reads requests and writes answers, a JSON object on a line each. The first request of a world starts SUMO in a
fork of this process, since libsumo holds one simulation per process and is slow to load; an empty line ends it. Each
further request has the vehicles under control (`bodies`: name, type, length and width [m], SUMO's front x, y [m], angle
[deg] and speed [m/s]), the places to brake for (`dangers`: x, y, half width [m], cosine and sine of the heading of what
crosses, 0 and 0 for what anyone brakes for), the `lights` that changed, and the vehicles that a collision has stopped
(`halted`). SUMO then makes a step of `STEP_S`.
"""

import json
import os
import signal
import sys
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from flcav.world.scenarios.stage import State, braking_m
from flcav.world.traffic.sumo_process import STEP_S, Walkers, start_sumo

OWN = "own:"  # begins the names of vehicles under control
NEAR_LANE_M = 5.0  # a vehicle under control is on a lane whose middle is so near, else off the road
CROSSING = 0.5  # sine of the angle from which on somebody's way is crossed
HALT_STEPS = round(5.0 / STEP_S)  # for so long a vehicle stands after a collision


class LiveTraffic:
    """A SUMO run with vehicles that are controlled from outside."""

    def __init__(self, sumo: Any, job: dict[str, Any]) -> None:
        """Start SUMO with the net, routes and seed of the `job`, and make its `steps` with its own traffic alone."""
        start_sumo(sumo, Path(job["net"]), Path(job["routes"]), job["seed"])
        self.sumo = sumo
        self.walkers = Walkers(STEP_S)
        self._followers: dict[str, tuple[str, str, list[str]]] = job["followers"]
        self._next = job["next"]  # number of the next vehicle that enters
        self._tours: dict[str, tuple[str, list[str]]] = {}  # of SUMO's vehicles: type and edges
        self._own: set[str] = set()
        self._halted: dict[str, int] = {}  # vehicle -> steps that it still stands
        self._braking: set[str] = set()
        self._drives = bool(job["edge"])
        if self._drives:
            sumo.route.add("own", [job["edge"]])
        for _ in range(job["steps"]):
            self._step()

    def step(self, request: dict[str, Any]) -> dict[str, Any]:
        """Make a step with what is under control, and return the states of SUMO's own vehicles and pedestrians."""
        for light, state in request["lights"].items():
            self.sumo.trafficlight.setRedYellowGreenState(light, state)
        self._mirror(request["bodies"] if self._drives else [])
        for name in request["halted"]:
            if name in self._tours:
                self.sumo.vehicle.setSpeed(name, 0.0)
                self._halted[name] = HALT_STEPS
        self._brake(request["dangers"])
        self._step()
        return self.states()

    def states(self) -> dict[str, Any]:
        """Return type, and front x, y [m], angle [deg] and speed [m/s], of SUMO's vehicles and pedestrians by name."""
        vehicle = self.sumo.vehicle
        out: dict[str, tuple[str, *State]] = {}
        for name in vehicle.getIDList():
            if name not in self._own:
                state = (*vehicle.getPosition(name), vehicle.getAngle(name), vehicle.getSpeed(name))
                out[name] = (self._tours[name][0], *state)
        for name, state in self.walkers.states.items():
            out[name] = (self.sumo.person.getTypeID(name).partition("@")[0], *state)
        return out

    def _step(self) -> None:
        """Make a step; vehicles that have arrived are followed by the next one, or set out again."""
        sumo = self.sumo
        sumo.simulationStep()
        for name in sumo.simulation.getDepartedIDList():
            if name not in self._own:
                kind = sumo.vehicle.getTypeID(name).partition("@")[0]
                self._tours[name] = kind, list(sumo.vehicle.getRoute(name))
        for name in sumo.simulation.getArrivedIDList():
            self._halted.pop(name, None)
            self._own.discard(name)
            if name in self._tours:
                kind, edges = self._tours.pop(name)
                follower = f"veh{self._next}"
                if name in self._followers:
                    follower, kind, edges = self._followers[name]
                else:
                    self._next += 1
                sumo.route.add(follower, edges)
                sumo.vehicle.add(follower, follower, kind, departPos="base", departSpeed="max", departLane="best")
        for name, left in list(self._halted.items()):
            if left > 1:
                self._halted[name] = left - 1
            else:
                del self._halted[name]
                sumo.vehicle.setSpeed(name, -1.0)
        people = sumo.person.getIDList()
        self.walkers.follow(
            {
                name: (*sumo.person.getPosition(name), sumo.person.getAngle(name), sumo.person.getSpeed(name))
                for name in people
            }
        )

    def _brake(self, dangers: list[list[float]]) -> None:
        """Let vehicles brake for the `dangers` ahead, and let those go that need not any more."""
        vehicle = self.sumo.vehicle
        names = [name for name in vehicle.getIDList() if name not in self._own and name not in self._halted]
        if names and (dangers or self._braking):
            x, y = np.array([vehicle.getPosition(name) for name in names]).T
            turned = np.pi / 2 - np.radians([vehicle.getAngle(name) for name in names])
            reach = np.array([braking_m(vehicle.getSpeed(name)) for name in names])[:, None]
            at_x, at_y, half, heading_x, heading_y = np.array(dangers, np.float64).reshape(-1, 5).T
            dx, dy = at_x - x[:, None], at_y - y[:, None]
            cos, sin = np.cos(turned)[:, None], np.sin(turned)[:, None]
            ahead, left = dx * cos + dy * sin, dy * cos - dx * sin
            crosses = (np.abs(heading_y * cos - heading_x * sin) > CROSSING) | (heading_x**2 + heading_y**2 < 0.5)
            brakes = (crosses & (ahead > -1.0) & (ahead < reach) & (np.abs(left) < half)).any(axis=1)
            for name, brake in zip(names, brakes.tolist()):
                if brake:
                    vehicle.setActionStepLength(name, STEP_S)
                    vehicle.setSpeed(name, 0.0)
                elif name in self._braking:
                    vehicle.setSpeed(name, -1.0)
            self._braking = {name for name, brake in zip(names, brakes.tolist()) if brake}

    def _mirror(self, bodies: list[list[Any]]) -> None:
        """Place the vehicles under control; those that are not among `bodies` any more leave."""
        vehicle = self.sumo.vehicle
        names = {OWN + row[0] for row in bodies}
        for name in sorted(self._own - names):
            vehicle.remove(name)
        self._own &= names
        for name, kind, length, width, x, y, angle, speed in bodies:
            name = OWN + name
            if name not in self._own:
                vehicle.add(name, "own", typeID=kind)
                vehicle.setLength(name, length)
                vehicle.setWidth(name, width)
                vehicle.setSpeedMode(name, 0)
                self._own.add(name)
            vehicle.moveToXY(name, "", -1, x, y, angle, keepRoute=2, matchThreshold=NEAR_LANE_M)
            vehicle.setPreviousSpeed(name, speed)


def serve() -> None:
    """Run the world of each request that is read from stdin in a fork, until the line that ends it."""
    import libsumo  # noqa: F401 - for the forks

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # left to the process that asks, which ends this one
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # where the process that asks is gone, end silently
    for line in sys.stdin.buffer:
        fork = os.fork()
        if not fork:
            _run(line)
        os.waitpid(fork, 0)


def _run(first: bytes) -> NoReturn:
    """Run one world; a failure is answered, and ends it."""
    answers = os.fdopen(os.dup(1), "wb")
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)  # SUMO's own output
    os.dup2(nowhere, 2)

    def answer(told: dict[str, Any]) -> None:
        answers.write(json.dumps(told).encode() + b"\n")
        answers.flush()

    try:
        import libsumo

        traffic = LiveTraffic(libsumo, json.loads(first))
        answer(traffic.states())
        while len(line := sys.stdin.buffer.readline()) > 1:
            answer(traffic.step(json.loads(line)))
    except BaseException as error:
        answer({"error": f"{type(error).__name__}: {error}"})
        sys.stdin.buffer.readline()
    finally:
        os._exit(0)
