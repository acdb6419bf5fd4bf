"""Stepped traffic: a SUMO run, the same for recordings and for live worlds, that reacts to controlled vehicles.

A step of `STEP_S` executes a `StepRequest`: the controlled vehicles are placed, SUMO's vehicles brake for obstacles in
their way, and then all move. A recording has no controlled vehicles.

The speed of pedestrians is limited. In SUMO's "striping" model they jump: up to three stripes aside in one step, and
from one end of a junction's corner to the other if they wait for one crossing and another turns green. Here a
pedestrian who falls behind follows the path of SUMO's pedestrian at no more than `HURRY_MPS` until caught up. This is
causal: later steps are not used.
"""

import math
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from flcav.world.scenarios.director import Director
from flcav.world.scenarios.scenario import Scenario
from flcav.world.scenarios.stage import STEP_S, Brakes, Danger, State

OWN = "own:"  # prefix of the names of controlled vehicles
NEAR_LANE_M = 5.0  # a controlled vehicle farther from all lanes' centre lines is off the road
HALT_STEPS = round(5.0 / STEP_S)  # steps for which a vehicle stops after a collision
NET, ROUTES = "town.net.xml", "town.rou.xml"

States = dict[str, tuple[str, float, float, float, float]]
"""By name of a vehicle or pedestrian: SUMO's type, front x, y [m], angle [deg clockwise from north], speed [m/s]."""

Body = tuple[str, str, Sequence[float]]
"""A controlled vehicle: name, SUMO's type; length, width, front x, y [m], angle [deg], speed [m/s]."""


class TrafficJob(NamedTuple):
    """Inputs of a run; its folder has SUMO's files `NET` and `ROUTES`."""

    folder: str
    seed: int
    followers: Mapping[str, tuple[str, str, list[str]]]  # by predecessor: name, type, edges of the successor
    again: int | None = None  # number from which vehicles without successor depart again; None: they do not
    edge: str = ""  # a route for the controlled vehicles; without one, SUMO ignores them
    scenarios: Sequence[Mapping[str, object]] = ()  # as JSON
    steps: int = 0  # number of steps at the start


class StepRequest(NamedTuple):
    """External inputs of a step."""

    bodies: Sequence[Body] = ()  # controlled vehicles
    dangers: Sequence[Danger] = ()  # places to brake for
    lights: Mapping[str, str] = {}  # state letters of junctions' links that have changed
    halted: Sequence[str] = ()  # vehicles that a collision has stopped
    gone: Sequence[str] = ()  # SUMO's vehicles and pedestrians to be removed without replacement


class Simulation:
    """A SUMO run, step by step."""

    def __init__(self, sumo: Any, job: TrafficJob) -> None:
        """Start libsumo, the module `sumo`, in the job's folder, which is the working directory."""
        options = {
            "net-file": NET,
            "route-files": ROUTES,
            "seed": job.seed,
            "step-length": STEP_S,
            "default.action-step-length": 0.5,  # drivers decide twice a second: the simulation is three times as fast
            "lanechange.duration": 2,
            "time-to-teleport": -1,  # vehicles in a jam are not removed
            "collision.action": "none",
            "no-step-log": "true",
            "no-warnings": "true",
        }
        sumo.start(["sumo", *(part for name, value in options.items() for part in (f"--{name}", str(value)))])
        self.sumo = sumo
        scenarios = [Scenario.model_validate(scenario) for scenario in job.scenarios]
        self.director = Director(sumo, Path(NET), scenarios) if scenarios else None
        self._walkers = Walkers(STEP_S)
        self._brakes = Brakes(sumo.vehicle)
        self._followers, self._again = job.followers, job.again
        self._tours: dict[str, tuple[str, list[str]]] = {}  # SUMO's vehicle -> type and edges
        self._own: set[str] = set()
        self._halted: dict[str, int] = {}  # vehicle -> remaining steps of its stop
        self._drives = bool(job.edge)
        if self._drives:
            sumo.route.add("own", [job.edge])
        for _ in range(job.steps):
            self.advance()

    def step(self, request: StepRequest) -> None:
        """Make a step with these external inputs."""
        for light, state in request.lights.items():
            self.sumo.trafficlight.setRedYellowGreenState(light, state)
        for name in request.gone:
            self._remove(name)
        self._mirror(request.bodies if self._drives else ())
        for name in request.halted:
            if name in self._tours:
                self.sumo.vehicle.setSpeed(name, 0.0)
                self._halted[name] = HALT_STEPS
        self._brakes.apply(request.dangers, self._own | self._halted.keys())
        self.advance()

    def states(self) -> States:
        """Return the states of SUMO's vehicles and pedestrians, with displacements by scenarios."""
        seen = self.director.stage.seen if self.director else None
        out: States = {}
        for name in self.sumo.vehicle.getIDList():
            if name not in self._own:
                state = _state_of(self.sumo.vehicle, name)
                out[name] = (self._tours[name][0], *(seen(name, state) if seen else state))
        for name, state in self._walkers.states.items():
            out[name] = (_type_of(self.sumo.person, name), *state)
        return out

    def advance(self) -> None:
        """Advance by a step; vehicles that have arrived are replaced by their successors, or depart again."""
        sumo = self.sumo
        sumo.simulationStep()
        for name in sumo.simulation.getArrivedIDList():
            self._halted.pop(name, None)
            self._own.discard(name)
            if name in self._tours:
                self._follow(name, *self._tours.pop(name))
        for name, left in list(self._halted.items()):
            if left > 1:
                self._halted[name] = left - 1
            else:
                del self._halted[name]
                sumo.vehicle.setSpeed(name, -1.0)
        self._walkers.follow({name: _state_of(sumo.person, name) for name in sumo.person.getIDList()})
        if self.director:
            self.director.direct()
        for name in sumo.simulation.getDepartedIDList():  # including those that a script has inserted
            if name not in self._own:
                self._tours[name] = _type_of(sumo.vehicle, name), list(sumo.vehicle.getRoute(name))

    def _remove(self, name: str) -> None:
        """Remove a vehicle or pedestrian of SUMO, if it is still present."""
        self._halted.pop(name, None)
        if self._tours.pop(name, None) is not None:
            self.sumo.vehicle.remove(name)
        elif name in self._walkers.states:
            self.sumo.person.remove(name)

    def _follow(self, name: str, kind: str, edges: list[str]) -> None:
        """Insert the successor of a vehicle that has arrived, if there is one."""
        if name in self._followers:
            follower, kind, edges = self._followers[name]
        elif self._again is not None:
            follower = f"veh{self._again}"
            self._again += 1
        else:
            return
        self.sumo.route.add(follower, edges)
        self.sumo.vehicle.add(follower, follower, kind, departPos="base", departSpeed="max", departLane="best")

    def _mirror(self, bodies: Sequence[Body]) -> None:
        """Mirror the controlled vehicles in SUMO: place `bodies`, and remove vehicles that are no longer among them."""
        vehicle = self.sumo.vehicle
        names = {OWN + row[0] for row in bodies}
        for name in sorted(self._own - names):
            vehicle.remove(name)
        self._own &= names
        for body, kind, (length, width, x, y, angle, speed) in bodies:
            name = OWN + body
            if name not in self._own:
                vehicle.add(name, "own", typeID=kind)
                vehicle.setLength(name, length)
                vehicle.setWidth(name, width)
                vehicle.setSpeedMode(name, 0)
                self._own.add(name)
            vehicle.moveToXY(name, "", -1, x, y, angle, keepRoute=2, matchThreshold=NEAR_LANE_M)
            vehicle.setPreviousSpeed(name, speed)


def _state_of(domain: Any, name: str) -> State:
    """Return the state of a vehicle or pedestrian of SUMO."""
    return (*domain.getPosition(name), domain.getAngle(name), domain.getSpeed(name))


def _type_of(domain: Any, name: str) -> str:
    """Return the type of a vehicle or pedestrian, without the suffix of SUMO's copy for one vehicle, "type@vehicle"."""
    return domain.getTypeID(name).partition("@")[0]


HURRY_MPS = 2.5  # jogging speed; the pedestrians of the demand walk at no more than 1.7 m/s


class Walkers:
    """The pedestrians of a run: they follow SUMO's pedestrians with limited speed."""

    def __init__(self, step_s: float) -> None:
        """Start without pedestrians; `step_s` is the duration of a step [s]."""
        self.states: dict[str, State] = {}  # of the present pedestrians, in SUMO's order
        self._step_s = step_s
        self._behind: dict[str, deque[tuple[float, float]]] = {}  # path between a pedestrian and SUMO's

    def follow(self, targets: Mapping[str, State]) -> None:
        """Advance by one step, in which SUMO's pedestrians reach `targets`; others are removed."""
        self.states = {name: self._follow(name, target) for name, target in targets.items()}
        self._behind = {name: path for name, path in self._behind.items() if path and name in targets}

    def _follow(self, name: str, target: State) -> State:
        """Return `target`, or, if it is out of reach, the reached state on the path to it."""
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
