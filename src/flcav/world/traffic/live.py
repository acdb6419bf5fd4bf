"""The traffic of a live world: SUMO's actors, interpolated between SUMO's steps, and the traffic lights.

Traffic lights follow the programs of a SUMO net, phases of fixed durations that repeat, unless they are overridden.
Format: https://sumo.dlr.de/docs/Simulation/Traffic_Lights.html
"""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flcav.config import InputError, read_xml, shorten
from flcav.geometry import heading_vectors, left_vectors, wrap_angle
from flcav.statistics.streams import derive_seed, stream
from flcav.world.dynamics.obstacles import TownGround
from flcav.world.dynamics.vehicle import VEHICLES
from flcav.world.map.roads import read_net
from flcav.world.map.town import Town
from flcav.world.scenarios.stage import STEP_S
from flcav.world.shapes import SHAPES
from flcav.world.snapshot import NOBODY, Actors
from flcav.world.traffic.bridges import find_footing
from flcav.world.traffic.client import Sumo, write_job
from flcav.world.traffic.demand import list_vehicle_types, park, write_demand
from flcav.world.traffic.simulation import Body, StepRequest, TrafficJob
from flcav.world.traffic.traffic import number_of

FILL_S = 20.0  # time by which all actors have departed
WARM_UP_S = 30.0  # time of SUMO at the start of a live world
TOUR_S = 900.0  # least duration of a vehicle's tour, after which it departs again
SLOW_MPS = 1.0  # traffic brakes for a slower vehicle anywhere in its way, and for a faster one in its lane
DANGERS = (-0.4, 0.0, 0.4)  # places to brake for, in body lengths from the centre
SOON_S = 0.7  # look-ahead time for crossing vehicles
BERTH_M = 1.0  # half width of a passing vehicle


def write_live_job(town: Town, folder: Path, *, seed: int, vehicles: int, pedestrians: int) -> TrafficJob:
    """Write the files of a live world's run into `folder`; return its job.

    Raises `InputError` as `write_demand` does.
    """
    parameters = town.parameters.model_copy(update={"vehicles": vehicles, "pedestrians": pedestrians})
    net = read_net(town.net)
    try:
        demand = write_demand(net, parameters, seed=seed, cavs=0, from_s=0.0, until_s=TOUR_S, fill_s=FILL_S)
    except InputError as error:
        raise InputError(f"{town.name}: {error}") from None
    return write_job(folder, town.net, demand, derive_seed(seed, "sumo"))._replace(
        again=vehicles + len(demand.followers),
        edge=next((edge.id for edge in net.streets if edge.lanes_of("driving")), ""),
        steps=round(WARM_UP_S / STEP_S),
    )


class SumoTraffic:
    """SUMO's traffic in a town, in a SUMO process that it occupies until it is closed."""

    def __init__(self, town: Town, ground: TownGround, *, seed: int, vehicles: int, pedestrians: int) -> None:
        """Start after the warm-up. Raises `InputError` as `write_demand` does, `RuntimeError` where SUMO fails."""
        self.ticks = 0  # steps of SUMO since the start
        self._actors = NOBODY  # those present before and after SUMO's present step, at their last poses
        self._ground, self._town = ground, town
        self._kinds = {name: (category, shape) for name, category, shape in list_vehicle_types()}
        self._lights: dict[str, str] = {}
        self._gone: list[str] = []  # actors removed since the last step of SUMO
        with tempfile.TemporaryDirectory(prefix="flcav_live_") as folder:
            job = write_live_job(town, Path(folder), seed=seed, vehicles=vehicles, pedestrians=pedestrians)
            self._sumo = Sumo(job)
        self._after = self._before = self._sumo.begun
        self.advance(NOBODY, {}, [])

    def advance(self, bodies: Actors, lights: Mapping[str, str], halted: Sequence[str]) -> None:
        """Advance SUMO by a step, in which its traffic reacts to the controlled `bodies`.

        `lights` are the state letters of the links, by junction. Vehicles that are `halted` stop for a while. Raises
        `RuntimeError` where SUMO fails.
        """
        changed = {name: state for name, state in lights.items() if self._lights.get(name) != state}
        self._lights |= changed
        request = StepRequest(_list_vehicles(bodies), _list_dangers(bodies), changed, halted, self._gone)
        self._before, self._after = self._after, self._sumo.step(request)
        self._gone = []
        self.ticks += 1
        self._line_up()

    def remove(self, name: str) -> None:
        """Remove a vehicle or pedestrian, without replacement."""
        del self._before[name]
        self._gone.append(name)
        self._line_up()

    def _line_up(self) -> None:
        """Select the actors that are present both before and after SUMO's present step."""
        names = sorted((name for name in self._before if name in self._after), key=number_of)
        self._ends = tuple(
            np.array([state[name][1:] for name in names], np.float64).reshape(-1, 4)
            for state in (self._before, self._after)
        )
        if tuple(names) != self._actors.name:
            self._recast(names)

    def at(self, time_s: float) -> Actors:
        """Return the actors at a time since the start [s] within SUMO's present step, interpolated linearly.

        Times must ascend, since an actor stays on a bridge, or below it, by its last height.
        """
        share = time_s / STEP_S - (self.ticks - 1)
        first, last = self._ends
        turn = wrap_angle(np.radians(first[:, 2] - last[:, 2]))
        yaw = np.pi / 2 - np.radians(first[:, 2]) + share * turn
        speed = first[:, 3] + share * (last[:, 3] - first[:, 3])
        ahead = heading_vectors(yaw)
        middle = first[:, :2] + share * (last[:, :2] - first[:, :2]) - self._actors.size[:, :1] / 2 * ahead
        yaw_rate = turn / STEP_S
        walks = self._walks[:, None]
        velocity = np.where(walks, (last[:, :2] - first[:, :2]) / STEP_S, speed[:, None] * ahead)
        gain = (last[:, 3] - first[:, 3])[:, None] / STEP_S * ahead + (speed * yaw_rate)[:, None] * left_vectors(yaw)
        position = np.column_stack((middle, self._actors.position[:, 2]))
        z, tilt = self._ground.stand(position, yaw, self._actors.size, self._walks)
        climb = -speed * np.tan(tilt[:, 0])
        self._actors = self._actors._replace(
            position=np.column_stack((middle, z)),
            yaw=wrap_angle(yaw),
            velocity=np.column_stack((velocity, climb)),
            acceleration=np.column_stack((np.where(walks, 0.0, gain), np.zeros(len(z)))),
            yaw_rate=yaw_rate,
            tilt=tilt,
        )
        return self._actors

    def _recast(self, names: Sequence[str]) -> None:
        """Set up these actors; new ones are on the ground, or on the bridge that their lane leads over."""
        kinds = [self._kinds[self._after[name][0]] for name in names]
        size = np.array([SHAPES[category][shape][1:] for category, shape in kinds], np.float64).reshape(-1, 3)
        count = len(names)
        front = self._ends[0][:, :2]
        turned = np.pi / 2 - np.radians(self._ends[0][:, 2])
        position = np.column_stack((front - size[:, :1] / 2 * heading_vectors(turned), np.full(count, np.nan)))
        known = dict(zip(self._actors.name, self._actors.position[:, 2].tolist()))
        position[:, 2] = [known.get(name, np.nan) for name in names]
        relief = self._town.relief
        new = np.flatnonzero(np.isnan(position[:, 2]))
        if relief is not None and relief.decks and len(new):
            centre = position[None, new, :2]
            yaw = turned[None, new]
            footing = find_footing(relief, self._town.net, centre, yaw)
            position[new, 2] = footing(centre[..., 0], centre[..., 1])[0]
        self._actors = Actors(
            name=tuple(names),
            category=tuple(category for category, _ in kinds),
            shape=np.array([shape for _, shape in kinds], np.int64),
            size=size,
            position=position,
            yaw=turned,
            velocity=np.zeros((count, 3)),
            acceleration=np.zeros((count, 3)),
            yaw_rate=np.zeros(count),
            tilt=np.zeros((count, 2)),
        )
        self._walks = np.array([category == "pedestrian" for category, _ in kinds], np.bool_)

    def close(self) -> None:
        """End SUMO's run."""
        self._sumo.close()


def _list_vehicles(bodies: Actors) -> list[Body]:
    """Return the vehicles among `bodies` as rows of a request."""
    front = bodies.position[:, :2] + bodies.size[:, :1] / 2 * heading_vectors(bodies.yaw)
    angle = (90.0 - np.degrees(bodies.yaw)) % 360.0
    speed = np.linalg.norm(bodies.velocity[:, :2], axis=1)
    numbers = np.column_stack((bodies.size[:, :2], front, angle, speed)).tolist()
    kinds = zip(bodies.name, bodies.category, bodies.shape.tolist(), numbers)
    return [
        (name, f"{category}.{SHAPES[category][shape].name}", row)
        for name, category, shape, row in kinds
        if category in VEHICLES
    ]


def _list_dangers(bodies: Actors) -> list[list[float]]:
    """Return the places to brake for, now and `SOON_S` later: x, y, half width [m], cosine and sine of the heading.

    The heading of walkers, props and vehicles that hardly move is 0, 0: all vehicles brake for them; for moving ones,
    only those whose way they cross.
    """
    moves = np.isin(bodies.category, VEHICLES) & (np.linalg.norm(bodies.velocity[:, :2], axis=1) >= SLOW_MPS)
    heading = heading_vectors(bodies.yaw)
    along = bodies.size[:, :1] * heading
    places = [
        bodies.position[:, :2] + share * along + time_s * bodies.velocity[:, :2]
        for share in DANGERS
        for time_s in (0.0, SOON_S)
    ]
    row = np.column_stack((BERTH_M + bodies.size[:, 1] / 2, moves[:, None] * heading))
    return np.column_stack((np.concatenate(places), np.tile(row, (len(places), 1)))).tolist()


def stand_parked(town: Town, ground: TownGround, seed: int) -> Actors:
    """Return the vehicles parked along a town's streets, which are those of a recording with this seed."""
    cars = park(read_net(town.net), town.parameters, stream(seed, "parked")) if town.net.exists() else []
    if not cars:
        return NOBODY
    count = len(cars)
    size = np.array([SHAPES[car.category][car.shape][1:] for car in cars], np.float64)
    position = np.array([(car.x, car.y, np.nan) for car in cars])
    yaw = np.array([car.yaw for car in cars])
    position[:, 2], tilt = ground.stand(position, yaw, size, np.zeros(count, np.bool_))
    still = np.zeros((count, 3))
    return Actors(
        *(tuple(f"parked{i}" for i in range(count)), tuple(car.category for car in cars)),
        *(np.array([car.shape for car in cars], np.int64), size, position, yaw, still, still, np.zeros(count), tilt),
    )


LETTERS = frozenset("GgyruosO")  # SUMO's states of a link


@dataclass(frozen=True)
class LightProgram:
    """The traffic light program of a junction."""

    junction: str
    durations_s: tuple[float, ...]  # per phase [s]
    states: tuple[str, ...]  # per phase, one of `LETTERS` per link
    offset_s: float  # time at which the first phase begins [s]

    def at(self, time_s: float) -> str:
        """Return the state letters of the links at a time [s]."""
        left = (time_s - self.offset_s) % sum(self.durations_s)
        for duration, state in zip(self.durations_s, self.states):
            if left < duration - 1e-6:
                return state
            left -= duration
        return self.states[0]


class TrafficLights:
    """The traffic lights of a town, which follow their programs unless they are set or frozen."""

    def __init__(self, programs: tuple[LightProgram, ...], time_s: float) -> None:
        """Start the programs at a time [s]."""
        self.frozen = False
        self._programs = {program.junction: program for program in programs}
        self._time_s = time_s
        self._set: dict[str, str] = {}

    def advance(self, dt_s: float) -> None:
        """Advance the programs by `dt_s` [s], unless they are frozen."""
        if not self.frozen:
            self._time_s += dt_s

    def states(self) -> dict[str, str]:
        """Return the state letters of the links, by junction."""
        return {name: self._set.get(name) or program.at(self._time_s) for name, program in self._programs.items()}

    def set(self, junction: str, state: str | None) -> None:
        """Set the state letters of a junction, or return it to its program (None). Raises `InputError` if invalid."""
        if junction not in self._programs:
            raise InputError(f"light {shorten(junction)}: the town has no such junction with lights")
        if state is None:
            self._set.pop(junction, None)
            return
        links = len(self._programs[junction].states[0])
        if len(state) != links or not set(state) <= LETTERS:
            letters = "".join(sorted(LETTERS))
            raise InputError(f"light {shorten(junction)}: {shorten(state)} must be {links} of the letters {letters}")
        self._set[junction] = state


def read_light_programs(net: Path) -> tuple[LightProgram, ...]:
    """Read the first program of every signalised junction; none without a net file.

    Phases of traffic-actuated programs have their nominal durations. Raises `InputError` for a damaged net.
    """
    if not net.exists():
        return ()
    programs: dict[str, LightProgram] = {}
    try:
        for row in read_xml(net, "a SUMO net").iterfind("tlLogic"):
            name = row.attrib["id"]
            phases = row.findall("phase")
            durations = tuple(float(phase.attrib["duration"]) for phase in phases)
            states = tuple(phase.attrib["state"] for phase in phases)
            if not 0 < sum(durations) < 1e6 or len({len(state) for state in states}) != 1:
                raise ValueError(f"the phases of light {name}")
            programs.setdefault(name, LightProgram(name, durations, states, float(row.get("offset", "0"))))
    except (LookupError, ValueError) as error:
        raise InputError(f"{net}: not a SUMO net ({type(error).__name__}: {error})") from None
    return tuple(programs[name] for name in sorted(programs))
