"""The stage of scripted scenarios: queries and actions on a SUMO run, one step of 0.1 s at a time.

Vehicles of SUMO are simulated by it, and the traffic reacts to them. Props are moved only by scripts, and the traffic
brakes for them where a script requests it (`brake_for`). Egos, the vehicles under test, are SUMO's "cav0", "cav1", ...
"""

import math
from collections.abc import Iterator, Sequence, Set
from typing import Any, NamedTuple

import numpy as np

from flcav.geometry import rotate
from flcav.world.map.roads import Edge, Lane, RoadNet
from flcav.world.scenarios.scenario import NEAR_M, Scenario

State = tuple[float, float, float, float]  # SUMO's: front x, y [m], angle [deg clockwise from north], speed [m/s]
STEP_S = 0.1  # step of SUMO
ALERT = 0.1  # action step of vehicles in a scenario [s]: they decide at every step
CAREFUL_MPS2 = 4.5  # deceleration of drivers who brake for a prop
CROSSING = 0.5  # sine of the angle between headings from which on a path is crossed
Danger = Sequence[float]
"""A place to brake for: x, y, half width [m], cosine and sine of a crossing object's heading; 0, 0: all brake."""


class Spot(NamedTuple):
    """A vehicle's place on a street."""

    lane: Lane
    edge: Edge
    along: float  # distance from the start of the lane to its front [m]
    left: float  # distance from its front to the end of the lane [m]


class Stage:
    """A SUMO run as scripts observe and change it."""

    def __init__(self, sumo: Any, net: RoadNet) -> None:
        """Start at the beginning of a run; `sumo` is the libsumo module."""
        self.sumo = sumo
        self.net = net
        self.step = 0
        self.props: dict[str, tuple[str, dict[int, State]]] = {}  # name -> vehicle type, state by step
        self.shifted: dict[
            str, tuple[float, float]
        ] = {}  # SUMO's vehicle -> displacement and rotation to the left [m, rad]
        self.past: dict[str, list[tuple[int, State]]] = {}  # SUMO's vehicle -> steps and states since its departure
        self.engaged: dict[str, int] = {}  # ego -> step until which it is not free
        self._edge_of = {lane.id: (edge, lane) for edge in net.edges.values() for lane in edge.lanes}
        self._brakes = Brakes(sumo.vehicle)
        self._dangers: list[Danger] = []  # of this step
        self._cast = 0

    def look(self) -> None:
        """Record the states of all vehicles of SUMO after a step."""
        self.step += 1
        for name in self.sumo.vehicle.getIDList():
            self.past.setdefault(name, []).append((self.step, self.state(name)))

    def state(self, name: str) -> State:
        """Return the state of a vehicle of SUMO."""
        vehicle = self.sumo.vehicle
        return (*vehicle.getPosition(name), vehicle.getAngle(name), vehicle.getSpeed(name))

    def egos(self, scenario: Scenario) -> list[str]:
        """Return the egos at which the scenario may happen now, by its `near` and `position`."""
        there = set(self.sumo.vehicle.getIDList())
        names = [scenario.near] if scenario.near else sorted(name for name in there if name.startswith("cav"))
        at = scenario.position
        return [
            name
            for name in names
            if name in there and (at is None or math.dist(self.sumo.vehicle.getPosition(name), at) <= NEAR_M)
        ]

    def free_egos(self, scenario: Scenario) -> list[str]:
        """Return the `egos` at which no scenario has begun recently: see `engaged`."""
        return [name for name in self.egos(scenario) if self.engaged.get(name, 0) <= self.step]

    def spot(self, name: str) -> Spot | None:
        """Return the place of a vehicle of SUMO on a street; None inside a junction."""
        edge_and_lane = self._edge_of.get(self.sumo.vehicle.getLaneID(name))
        if edge_and_lane is None or edge_and_lane[0].function != "normal":
            return None
        along = self.sumo.vehicle.getLanePosition(name)
        return Spot(edge_and_lane[1], edge_and_lane[0], along, self.sumo.lane.getLength(edge_and_lane[1].id) - along)

    def point(self, lane: Lane, along: float, left: float) -> tuple[float, float, float]:
        """Return x, y [m] and heading [rad], world frame, at `along` [m] of a lane, `left` [m] to the left of it.

        With left-hand traffic it is to the right: towards the middle of the road. Beyond its ends the lane is
        extended straight.
        """
        edge, index = lane.id.rpartition("_")[::2]
        length = self.sumo.lane.getLength(lane.id)
        inside = min(max(along, 0.0), length)
        low, high = max(inside - 1.0, 0.0), min(inside + 1.0, length)
        a, b = (self.sumo.simulation.convert2D(edge, at, int(index)) for at in (low, high))
        heading = math.atan2(b[1] - a[1], b[0] - a[0])
        x, y = self.sumo.simulation.convert2D(edge, inside, int(index))
        ahead_x, ahead_y = rotate(along - inside, 0.0, heading)
        aside_x, aside_y = rotate(0.0, self.net.side * left, heading)
        return x + ahead_x + aside_x, y + ahead_y + aside_y, heading

    def cast(self, kind: str) -> str:
        """Create a prop of a vehicle type, "category.shape", without a state yet; return its name."""
        name = f"scripted{self._cast}"
        self._cast += 1
        self.props[name] = (kind, {})
        return name

    def place(self, name: str, x: float, y: float, heading: float, speed: float, step: int | None = None) -> None:
        """Set the state of a prop now, or at an earlier `step`: x, y [m], heading [rad], speed [m/s]."""
        angle = 90.0 - math.degrees(heading)
        self.props[name][1][self.step if step is None else step] = (x, y, angle, speed)

    def place_from_start(self, name: str, x: float, y: float, heading: float) -> None:
        """Place a prop at x, y [m] with `heading` [rad], at rest, from the start of the run up to now."""
        for step in range(self.step + 1):
            self.place(name, x, y, heading, 0.0, step)

    def is_untouched(self, x: float, y: float, radius_m: float) -> bool:
        """Return whether no vehicle of SUMO has been within `radius_m` of x, y [m] since the start of the run."""
        return not any(
            math.hypot(state[0] - x, state[1] - y) < radius_m for states in self.past.values() for _, state in states
        )

    def enter(self, name: str, kind: str, spot: tuple[Lane, float], route: list[str], speed: float) -> None:
        """Insert a new vehicle of SUMO with its front at a place of a lane [m], even where another one is.

        `route` are its edges, `speed` is in [m/s].
        """
        vehicle = self.sumo.vehicle
        self.sumo.route.add(f"route of {name}", route)
        vehicle.add(name, f"route of {name}", typeID=kind)
        vehicle.moveTo(name, spot[0].id, spot[1])
        vehicle.setPreviousSpeed(name, speed)
        self.take(name)

    def take(self, name: str) -> None:
        """Let a vehicle of SUMO act at every step, so that it follows a script immediately."""
        self.sumo.vehicle.setActionStepLength(name, ALERT)

    def list_remaining_edges(self, name: str) -> list[str]:
        """Return the remaining edges of a vehicle's route, from the present one."""
        return list(self.sumo.vehicle.getRoute(name)[max(self.sumo.vehicle.getRouteIndex(name), 0) :])

    def find_leader(self, name: str, within_m: float) -> tuple[str, float] | None:
        """Return the vehicle ahead of a vehicle and the gap between their bumpers [m]; None beyond `within_m` [m]."""
        leader = self.sumo.vehicle.getLeader(name, within_m)
        if not leader or not leader[0]:
            return None
        gap = leader[1] + self.sumo.vehicle.getMinGap(name)
        return (leader[0], gap) if gap <= within_m else None

    def brake_for(self, places: Sequence[tuple[float, float]], half_width_m: float) -> None:
        """Add places x, y [m] for which vehicles brake in this step: see `react`."""
        self._dangers += [[x, y, half_width_m, 0.0, 0.0] for x, y in places]

    def react(self, careless: Set[str]) -> None:
        """Let vehicles brake for the places added in this step; the `careless` are left to their scripts."""
        self._brakes.apply(self._dangers, careless)
        self._dangers.clear()

    def gap_ahead(self, lane: Lane, along: float) -> float:
        """Return the gap [m] from a place of a lane [m] to the rear of the next vehicle on it; inf if there is none."""
        vehicle = self.sumo.vehicle
        places = [
            (vehicle.getLanePosition(name), vehicle.getLength(name))
            for name in self.sumo.lane.getLastStepVehicleIDs(lane.id)
        ]
        return min((front - length - along for front, length in places if front > along), default=math.inf)

    def seen(self, name: str, state: State) -> State:
        """Return the recorded state of a vehicle of SUMO: with the displacement and rotation of its script."""
        if name not in self.shifted:
            return state
        left, turn = self.shifted[name]
        x, y, angle, speed = state
        aside_x, aside_y = rotate(0.0, self.net.side * left, math.radians(90.0 - angle))
        return x + aside_x, y + aside_y, angle - self.net.side * math.degrees(turn), speed

    def trail(self, name: str, behind_m: float) -> Iterator[tuple[int, State]]:
        """Yield steps and states of a follower on a vehicle's path, `behind_m` [m] behind it from front to front.

        Steps before the vehicle has travelled that far are left out.
        """
        states = self.past[name]
        at = np.array([state[:2] for _, state in states])
        done = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(at, axis=0).T))))
        angles = np.unwrap([state[2] for _, state in states], period=360.0)
        for (step, state), travelled in zip(states, done):
            if travelled >= behind_m:
                x, y, angle = (np.interp(travelled - behind_m, done, values) for values in (*at.T, angles))
                yield step, (float(x), float(y), float(angle), state[3])


class Brakes:
    """The braking of SUMO's vehicles for objects that SUMO does not know."""

    def __init__(self, vehicle: Any) -> None:
        """Start without braking vehicles; `vehicle` is libsumo's domain of vehicles."""
        self._vehicle = vehicle
        self._braking: set[str] = set()

    def apply(self, dangers: Sequence[Danger], careless: Set[str]) -> None:
        """Let vehicles brake for the dangers ahead, and release those that no longer need to; ignore the `careless`.

        A vehicle brakes for a place within its braking distance ahead and within the place's half width of its path.
        """
        vehicle = self._vehicle
        names = [name for name in vehicle.getIDList() if name not in careless] if dangers or self._braking else ()
        if not names:
            return
        x, y = np.array([vehicle.getPosition(name) for name in names]).T
        turned = np.pi / 2 - np.radians([vehicle.getAngle(name) for name in names])
        reach = np.array([braking_m(vehicle.getSpeed(name)) for name in names])[:, None]
        at_x, at_y, half, heading_x, heading_y = np.array(dangers, np.float64).reshape(-1, 5).T
        dx, dy = at_x - x[:, None], at_y - y[:, None]
        cos, sin = np.cos(turned)[:, None], np.sin(turned)[:, None]
        ahead, left = dx * cos + dy * sin, dy * cos - dx * sin
        crosses = (np.abs(heading_y * cos - heading_x * sin) > CROSSING) | (heading_x**2 + heading_y**2 < 0.5)
        brakes = (crosses & (ahead > -1.0) & (ahead < reach) & (np.abs(left) < half)).any(axis=1)
        now = {name for name, brake in zip(names, brakes.tolist()) if brake}
        for name in names:
            if name in now:
                vehicle.setActionStepLength(name, ALERT)
                vehicle.setSpeed(name, 0.0)
            elif name in self._braking:
                vehicle.setSpeed(name, -1.0)
        self._braking = now


def braking_m(speed: float) -> float:
    """Return the distance [m] from a prop at which a vehicle at `speed` [m/s] begins to brake."""
    return 4.0 + 0.7 * speed + speed**2 / (2 * CAREFUL_MPS2)
