"""What a script sees of a SUMO run and can do to it, one step of 0.1 s at a time.

Some actors are SUMO's, and the traffic reacts to them; some are props that only scripts move, and the traffic brakes
for them where a script says so (`brake_for`). A state is SUMO's: front x, y [m], angle [deg clockwise from north],
speed [m/s].
"""

import math
from collections.abc import Iterator, Sequence, Set
from typing import Any, NamedTuple

import numpy as np

from flcav.world.map.roads import Edge, Lane, RoadNet
from flcav.world.scenarios.scenario import NEAR_M, Scenario

State = tuple[float, float, float, float]
STEP_S = 0.1
ALERT = 0.1  # [s] a vehicle on stage decides at every step
CAREFUL_MPS2 = 4.5  # how hard drivers brake for a prop


class Spot(NamedTuple):
    """A vehicle's place on a street."""

    lane: Lane
    edge: Edge
    along: float  # of its front [m]
    left: float  # to the end of the lane [m]


class Stage:
    """A SUMO run with scripts in it."""

    def __init__(self, sumo: Any, net: RoadNet) -> None:
        """Stand at the start of a run; `sumo` is the libsumo module."""
        self.sumo = sumo
        self.net = net
        self.step = 0
        self.props: dict[str, tuple[str, dict[int, State]]] = {}  # name -> vehicle type, state by step
        self.shifted: dict[str, tuple[float, float]] = {}  # SUMO's vehicle -> metres to the left, radians to the left
        self.past: dict[str, list[tuple[int, State]]] = {}
        self.engaged: dict[str, int] = {}  # vehicle under test -> step up to which a scenario has it to itself
        self._edge_of = {lane.id: (edge, lane) for edge in net.edges.values() for lane in edge.lanes}
        self._braking: set[str] = set()
        self._dangers: list[tuple[float, float, float]] = []  # x, y, half width [m] of this step
        self._cast = 0

    def look(self) -> None:
        """Take note of where everybody is after a step."""
        self.step += 1
        for name in self.sumo.vehicle.getIDList():
            self.past.setdefault(name, []).append((self.step, self.state(name)))

    def state(self, name: str) -> State:
        """Return the state of a vehicle of SUMO."""
        vehicle = self.sumo.vehicle
        return (*vehicle.getPosition(name), vehicle.getAngle(name), vehicle.getSpeed(name))

    def egos(self, scenario: Scenario) -> list[str]:
        """Return the vehicles under test near which the scenario may happen now."""
        there = set(self.sumo.vehicle.getIDList())
        names = [scenario.near] if scenario.near else sorted(name for name in there if name.startswith("cav"))
        at = scenario.position
        return [
            name
            for name in names
            if name in there and (at is None or math.dist(self.sumo.vehicle.getPosition(name), at) <= NEAR_M)
        ]

    def free_egos(self, scenario: Scenario) -> list[str]:
        """Return those of `egos` before whom nothing else happens now."""
        return [name for name in self.egos(scenario) if self.engaged.get(name, 0) <= self.step]

    def spot(self, name: str) -> Spot | None:
        """Return a vehicle's place on a street; None inside a junction."""
        found = self._edge_of.get(self.sumo.vehicle.getLaneID(name))
        if found is None or found[0].function != "normal":
            return None
        along = self.sumo.vehicle.getLanePosition(name)
        return Spot(found[1], found[0], along, self.sumo.lane.getLength(found[1].id) - along)

    def point(self, lane: Lane, along: float, left: float) -> tuple[float, float, float]:
        """Return x, y and heading [rad] at a place of a lane, `left` metres to the left of its middle."""
        edge, index = lane.id.rpartition("_")[::2]
        length = self.sumo.lane.getLength(lane.id)
        inside = min(max(along, 0.0), length)
        low, high = max(inside - 1.0, 0.0), min(inside + 1.0, length)
        a, b = (self.sumo.simulation.convert2D(edge, at, int(index)) for at in (low, high))
        heading = math.atan2(b[1] - a[1], b[0] - a[0])
        x, y = self.sumo.simulation.convert2D(edge, inside, int(index))
        on = along - inside
        return (
            x + on * math.cos(heading) - left * math.sin(heading),
            y + on * math.sin(heading) + left * math.cos(heading),
            heading,
        )

    def cast(self, kind: str) -> str:
        """Return the name of a new actor of a vehicle type, "category.shape"."""
        name = f"scripted{self._cast}"
        self._cast += 1
        self.props[name] = (kind, {})
        return name

    def place(self, name: str, x: float, y: float, heading: float, speed: float, step: int | None = None) -> None:
        """Put a prop somewhere now, or at an earlier step."""
        angle = 90.0 - math.degrees(heading)
        self.props[name][1][self.step if step is None else step] = (x, y, angle, speed)

    def stood(self, name: str, x: float, y: float, heading: float) -> None:
        """Have a prop stand somewhere from the start of the run up to now."""
        for step in range(self.step + 1):
            self.place(name, x, y, heading, 0.0, step)

    def untouched(self, x: float, y: float, radius_m: float) -> bool:
        """Say whether no vehicle has ever been within `radius_m` of a place."""
        return not any(
            math.hypot(state[0] - x, state[1] - y) < radius_m for states in self.past.values() for _, state in states
        )

    def enter(self, name: str, kind: str, spot: tuple[Lane, float], route: list[str], speed: float) -> None:
        """Put a new vehicle into the traffic, its front at a place of a lane, whoever is there."""
        vehicle = self.sumo.vehicle
        self.sumo.route.add(f"route of {name}", route)
        vehicle.add(name, f"route of {name}", typeID=kind)
        vehicle.moveTo(name, spot[0].id, spot[1])
        vehicle.setPreviousSpeed(name, speed)
        self.take(name)

    def take(self, name: str) -> None:
        """Have a vehicle of SUMO's obey at every step."""
        self.sumo.vehicle.setActionStepLength(name, ALERT)

    def onward(self, name: str) -> list[str]:
        """Return the rest of a vehicle's route, from the edge it is on."""
        return list(self.sumo.vehicle.getRoute(name)[max(self.sumo.vehicle.getRouteIndex(name), 0) :])

    def leader(self, name: str, within_m: float) -> tuple[str, float] | None:
        """Return who drives ahead in one's lane, and the gap between the bumpers [m]; None further away than asked."""
        found = self.sumo.vehicle.getLeader(name, within_m)
        if not found or not found[0]:
            return None
        gap = found[1] + self.sumo.vehicle.getMinGap(name)
        return (found[0], gap) if gap <= within_m else None

    def brake_for(self, places: Sequence[tuple[float, float]], half_width_m: float) -> None:
        """Have everybody brake in this step who drives towards one of the places and could not stop before it later."""
        self._dangers += [(x, y, half_width_m) for x, y in places]

    def react(self, careless: Set[str]) -> None:
        """Have everybody brake for what this step's scripts asked for, and drive on who needs not any more.

        Those who are `careless` do neither: scripts move them.
        """
        x, y, half_width_m = np.array(self._dangers, np.float64).reshape(-1, 3).T
        self._dangers.clear()
        for name in set(self.sumo.vehicle.getIDList()) - careless:
            front_x, front_y, angle, speed = self.state(name)
            heading = math.radians(90.0 - angle)
            dx, dy = x - front_x, y - front_y
            ahead = dx * math.cos(heading) + dy * math.sin(heading)
            aside = np.abs(-dx * math.sin(heading) + dy * math.cos(heading))
            if ((ahead > -1.0) & (ahead < braking_m(speed)) & (aside < half_width_m)).any():
                self.take(name)
                self.sumo.vehicle.setSpeed(name, 0.0)
                self._braking.add(name)
            elif name in self._braking:
                self.sumo.vehicle.setSpeed(name, -1.0)
                self._braking.discard(name)

    def gap_ahead(self, lane: Lane, along: float) -> float:
        """Return how far it is from a place of a lane to the next vehicle's tail on it; inf where there is none [m]."""
        vehicle = self.sumo.vehicle
        places = [
            (vehicle.getLanePosition(name), vehicle.getLength(name))
            for name in self.sumo.lane.getLastStepVehicleIDs(lane.id)
        ]
        return min((front - length - along for front, length in places if front > along), default=math.inf)

    def seen(self, name: str, state: State) -> State:
        """Return a vehicle's state as it is to be recorded: with what a script shifts it by."""
        if name not in self.shifted:
            return state
        left, turn = self.shifted[name]
        x, y, angle, speed = state
        heading = math.radians(90.0 - angle)
        return x - left * math.sin(heading), y + left * math.cos(heading), angle - math.degrees(turn), speed

    def trail(self, name: str, behind_m: float) -> Iterator[tuple[int, State]]:
        """Iterate over the states of somebody who has always followed a vehicle at a distance along its path."""
        states = self.past[name]
        at = np.array([state[:2] for _, state in states])
        done = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(at, axis=0).T))))
        angles = np.unwrap([state[2] for _, state in states], period=360.0)
        for (step, state), travelled in zip(states, done):
            if travelled >= behind_m:
                x, y, angle = (np.interp(travelled - behind_m, done, values) for values in (*at.T, angles))
                yield step, (float(x), float(y), float(angle), state[3])


def braking_m(speed: float) -> float:
    """Return how far before a prop somebody at `speed` [m/s] begins to brake."""
    return 4.0 + 0.7 * speed + speed**2 / (2 * CAREFUL_MPS2)
