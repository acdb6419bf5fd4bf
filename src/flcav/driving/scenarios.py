"""Scenarios of closed-loop drives: a route in a town, its traffic and weather, and an event that requires braking.

A scenario and a seed determine a drive: the seed draws the route, the traffic and the moment of the event.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Annotated, Literal

import numpy as np

from flcav.config import InputError, shorten
from flcav.driving.scripts import Pose, Script, ScriptPlayer, write_script
from flcav.driving.seen import EGO, WEATHER_SPEED
from flcav.geometry import Array, heading_vectors, left_vectors, wrap_angle
from flcav.interface.wording import plural, suggest
from flcav.statistics.streams import derive_seed, stream
from flcav.storage.records import LEFT_OUT, WHERE_TRUE
from flcav.world.commands import Controls, Drive, Push, Remove, Spawn, Walk
from flcav.world.live import LiveWorld, Settings
from flcav.world.map.roads import Route, draw_route, read_net
from flcav.world.map.town import TOWNS, Town, load_town
from flcav.world.scenarios.scenario import Kind
from flcav.world.weather import WEATHERS, Weather, find_nearest_class

Event = Literal["none", "walker", "stalled", "braking"]

CAR = ("car", 3)  # category and shape of the ego vehicle
ROUTE_M = 500.0  # length of a drawn route
SHORTEST_M = 250.0  # least length of a route after its start
TRIES = 200  # of drawing a route
LEAST_M = 60.0  # the same, where the start or a place is given
BEFORE_M = 40.0  # a drive begins so far before the given place
REACHES_M = (3.0, 8.0, 15.0, 35.0)  # greatest distance from the route to the place or start, tried in this order
SAME_RAD = np.pi / 4  # greatest difference between the headings of a start and of the route
DT_S = 0.1  # step of the closed loop
WALKER_MPS = 1.6
STALLED_S = 14.0  # for which a broken-down car stands
BRAKES_MPS2 = 6.0  # deceleration of the car ahead
LEAD = "lead"


@dataclass(frozen=True)
class DrivingScenario:
    """Driving scenario: town, traffic, event and weather; a seed makes it a drive."""

    name: str
    town: str
    event: Event
    weather: str  # a class of the weather task
    traffic: int  # number of SUMO's vehicles
    pedestrians: int
    sky: Annotated[Weather | None, LEFT_OUT] = None  # weather parameters; None: drawn from the class
    place: Annotated[tuple[float, float] | None, LEFT_OUT] = None  # x, y that the route passes by [m]
    start: Annotated[Pose | None, LEFT_OUT] = None  # x, y [m] and yaw [rad] where the ego vehicle sets out
    speed: Annotated[float, WHERE_TRUE] = 0.0  # initial speed of the ego vehicle [m/s]
    case: Annotated[Kind | None, LEFT_OUT] = None  # corner case, in addition to the event
    scripts: Annotated[tuple[Script, ...], WHERE_TRUE] = ()  # of an OpenSCENARIO file, in addition to the event

    def with_sky(self, sky: Weather) -> "DrivingScenario":
        """Return the scenario in a weather; at night its class is `night` unless that of its rain or fog is slower."""
        day = find_nearest_class(sky.model_copy(update={"sun_elevation_deg": 45.0}) if sky.night else sky)
        slow = sky.night and WEATHER_SPEED[day] >= WEATHER_SPEED["night"]
        return replace(self, sky=sky, weather="night" if slow else day)

    def at_night(self) -> "DrivingScenario":
        """Return the scenario at night, with the same rain and visibility."""
        sun = {name: getattr(WEATHERS["night"], name) for name in ("sun_elevation_deg", "sun_azimuth_deg")}
        sky = (self.sky or WEATHERS[self.weather]).model_copy(update=sun)
        return replace(self.with_sky(sky), name=f"{self.name}-night")

    def line(self) -> str:
        """Return the scenario in words."""
        events = [self.event if self.event != "none" else "", self.case or "", "script" if self.scripts else ""]
        details, sky = "", self.sky
        if sky is not None:
            rain = f"rain {sky.rain_mm_h:.1f} mm/h"
            sight = f"sight {sky.visibility_m:.0f} m"
            details = f" (sun {sky.sun_elevation_deg:.0f} deg, {rain}, {sight})"
        happens = " and ".join(filter(None, events)) or "no event"
        around = f"{plural(self.traffic, 'vehicle')}, {plural(self.pedestrians, 'pedestrian')}"
        return f"{self.name}: {self.town}, {happens}, {self.weather}{details}, {around}"


def list_scenarios() -> tuple[DrivingScenario, ...]:
    """Return the scenarios of the package: every town with each event in clear weather, and in rain or fog in turn."""
    bad = ("fog", "heavy_rain")
    events: tuple[Event, ...] = ("none", "walker", "stalled", "braking")
    scenarios = []
    for (i, town), (j, event) in product(enumerate(TOWNS), enumerate(events)):
        for weather in ("clear", bad[(i + j) % 2]):
            scenarios.append(DrivingScenario(f"{town}-{event}-{weather}", town, event, weather, 25, 8))
    return tuple(scenarios)


def find_scenarios(names: Sequence[str]) -> tuple[DrivingScenario, ...]:
    """Return the package's scenarios of these names, or all without names; raises `InputError` for an unknown name."""
    known = {scenario.name: scenario for scenario in list_scenarios()}
    if odd := [name for name in names if name not in known]:
        raise InputError(
            f"scenario {shorten(odd[0])}: neither a file, nor one of flcav{suggest(odd[0], known)}; `flcav drive "
            "--list` names them"
        )
    return tuple(known[name] for name in names) or list_scenarios()


def spread_scenarios(count: int) -> tuple[DrivingScenario, ...]:
    """Return a number of scenarios that cycle through towns, events and weathers."""
    known = list_scenarios()
    step = 7  # coprime to their number: it goes through all
    return tuple(known[(step * i) % len(known)] for i in range(count))


def find_start(route: Route, wanted: tuple[float, ...], reach_m: float) -> float | None:
    """Return the distance [m] along a route at which a drive begins; None where the route does not fit.

    `wanted` is either a place x, y [m], which the drive passes after `BEFORE_M`, or its initial pose x, y [m] and yaw
    [rad], in the world frame. The route has to come within `reach_m` [m] of it.
    """
    marks = np.arange(0.0, route.length_m, 1.0)
    poses: Array = route.at(marks)
    away = np.hypot(*(poses[:, :2] - wanted[:2]).T)
    if len(wanted) > 2:
        away = np.where(np.abs(wrap_angle(poses[:, 2] - wanted[2])) < SAME_RAD, away, np.inf)
    nearest = int(away.argmin())
    begins = float(marks[nearest]) - (BEFORE_M if len(wanted) == 2 else 0.0)
    return begins if away[nearest] < reach_m and begins >= 0 else None


class StagedScenario:
    """A running scenario: the world with the ego vehicle at the start of its route, and the event's actors."""

    def __init__(self, scenario: DrivingScenario, seed: int) -> None:
        """Start the world and place the actors; raises `InputError` where there is no room for the ego vehicle."""
        self.scenario = scenario
        self.town: Town = load_town(scenario.town)
        self.world = LiveWorld(
            self.town,
            Settings(
                seed=derive_seed(seed, "traffic", scenario.name),
                traffic=scenario.traffic,
                pedestrians=scenario.pedestrians,
                dt_s=DT_S,
                remembers=False,
            ),
        )
        try:
            self.route, self.start_m = self._set_out(stream(seed, "route", scenario.name))
            self._random = stream(seed, "event", scenario.name)
            self._at_m = self.start_m + float(self._random.uniform(45.0, 75.0))
            self._phase, self._since_s = "waits", 0.0
            self._prepare()
            scripts = list(scenario.scripts)
            if scenario.case is not None:
                scripts.append(write_script(scenario.case, self.route.limit(self.start_m)))
            self._player = ScriptPlayer(self.world, scripts, self.route, self.start_m) if scripts else None
        except BaseException:
            self.world.close()
            raise

    def act(self, along_m: float, speed: float) -> None:
        """Advance the event by a step; the ego vehicle is at `along_m` [m] of its route and drives at `speed` [m/s]."""
        if self._player is not None:
            at_x, at_y, _ = self.world.snapshot.trace.position[0, self.world.snapshot.row(EGO)].tolist()
            self._player.act((at_x, at_y), DT_S)
        match self.scenario.event:
            case "walker":
                self._walk(along_m, speed)
            case "stalled":
                if self._phase == "stands" and self.world.snapshot.time_s > STALLED_S:
                    self.world.apply(Remove(LEAD))
                    self._phase = "gone"
            case "braking":
                self._lead()
            case "none":
                pass

    def _set_out(self, random: np.random.Generator) -> tuple[Route, float]:
        net, wanted = read_net(self.town.net), self.scenario.start or self.scenario.place
        for reach_m in [0.0] * TRIES if wanted is None else np.repeat(REACHES_M, TRIES).tolist():
            route = draw_route(net, random, ROUTE_M)
            along = float(random.uniform(8.0, 15.0)) if wanted is None else find_start(route, wanted, reach_m)
            if along is None or route.length_m < along + (SHORTEST_M if wanted is None else LEAST_M):
                continue
            x, y, yaw = route.at(along).tolist()
            car = Spawn(EGO, *CAR, x, y, yaw)
            if not self.world.find_obstruction(car):
                self.world.apply(car)
                if self.scenario.speed:
                    forward = heading_vectors(yaw) * self.scenario.speed
                    self.world.apply(Push(EGO, (float(forward[0]), float(forward[1]), 0.0)))
                return route, along
        where = "" if wanted is None else f" on a lane through {wanted[0]:.0f}, {wanted[1]:.0f}"
        raise InputError(f"{self.scenario.name}: {self.town.name} has no room for the car{where}")

    def _prepare(self) -> None:
        event = self.scenario.event
        if event == "walker":
            x, y = self._beside(self._at_m, -4.0)
            self._phase = "waits" if self._spawn(Spawn("walker", "pedestrian", 2, x, y)) else "gone"
        elif event in ("stalled", "braking"):
            at = self._at_m if event == "stalled" else self.start_m + 18.0
            x, y, yaw = self.route.at(at).tolist()
            self._phase = "stands" if self._spawn(Spawn(LEAD, *CAR, x, y, yaw)) else "gone"
            self._at_m = at
            self._after_m = at + float(self._random.uniform(60.0, 110.0))

    def _spawn(self, command: Spawn) -> bool:
        """Spawn an actor if there is room; return whether there was."""
        if self.world.find_obstruction(command):
            return False
        self.world.apply(command)
        return True

    def _beside(self, along_m: float, left_m: float) -> tuple[float, float]:
        place = self.route.at(along_m)
        x, y = (place[:2] + left_m * left_vectors(place[2])).tolist()
        return x, y

    def _walk(self, along_m: float, speed: float) -> None:
        """Let the walker cross when the ego vehicle is near for its speed, and stop on the far side."""
        if self._phase == "waits" and 0 < self._at_m - along_m < max(3.2 * speed, 8.0):
            across = left_vectors(self.route.at(self._at_m)[2]) * WALKER_MPS
            self.world.apply(Walk("walker", (float(across[0]), float(across[1]))))
            self._phase, self._since_s = "walks", self.world.snapshot.time_s
        elif self._phase == "walks" and self.world.snapshot.time_s - self._since_s > 8.0 / WALKER_MPS:
            self.world.apply(Walk("walker", (0.0, 0.0)))
            self._phase = "gone"

    def _lead(self) -> None:
        """Let the car ahead drive along the route, brake hard, and leave after five seconds."""
        if self._phase == "gone":
            return
        snapshot = self.world.snapshot
        row = snapshot.row(LEAD)
        x, y, _ = snapshot.trace.position[0, row].tolist()
        yaw = float(snapshot.trace.yaw[0, row])
        self._at_m, _ = self.route.project(x, y, self._at_m)
        speed = float(np.hypot(*snapshot.trace.velocity[0, row, :2]))
        if self._phase == "stands" and snapshot.time_s > 1.0:
            self._phase = "drives"
        if self._phase == "drives" and self._at_m > self._after_m:
            self._phase, self._since_s = "brakes", snapshot.time_s
        if (
            self._phase == "brakes" and snapshot.time_s - self._since_s > 5.0
        ) or self._at_m > self.route.length_m - 30.0:
            self.world.apply(Remove(LEAD))
            self._phase = "gone"
            return
        aim = self.route.at(self._at_m + 4.0 + 0.4 * speed)
        ahead, left = (aim[:2] - (x, y)) @ np.stack((heading_vectors(yaw), left_vectors(yaw)), axis=1)
        steer = float(np.arctan(2 * 3.0 * left / (ahead**2 + left**2)) / np.radians(70.0))
        wanted = 0.0 if self._phase in ("brakes", "stands") else 0.8 * self.route.limit(self._at_m)
        pedal = -BRAKES_MPS2 / 8.0 if self._phase == "brakes" else (wanted - speed) / 2
        self.world.apply(
            Drive(LEAD, Controls(max(min(pedal, 1.0), 0.0), max(min(steer, 1.0), -1.0), max(min(-pedal, 1.0), 0.0)))
        )
