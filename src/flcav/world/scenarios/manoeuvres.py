"""Scripts of manoeuvres: cutting in, and running a red light."""

import math
from collections.abc import Generator
from typing import NamedTuple

from flcav.world.map.roads import Lane
from flcav.world.scenarios.scenario import Scenario
from flcav.world.scenarios.stage import STEP_S, Spot, Stage
from flcav.world.shapes import SHAPES, Shape

CLOSE_M = 7.0  # largest gap between the bumpers at a cut-in
NARROW_M = 1.5  # least gap between the bumpers at a cut-in
NEXT_M = (-6.0, 16.0)  # limits of the gap from the ego to a vehicle on the next lane that may cut in
FALLS_BACK_S = 5.0  # longest time in which that vehicle adjusts its gap
MOVES_OVER_S = 2.2  # duration of the lane change
FAST = 4.0  # least speed of the ego, of the vehicle on the next lane and of a moving runner [m/s]
TOO_FAST = 15.0  # speed above which the ego could not brake for a car from the kerb [m/s]
ROOM_M = 45.0  # least length of lane ahead for a car from the kerb
NEXT_ROOM_M = 30.0  # least length of lane ahead for a car from the next lane
KERB_GAP_M = 0.25  # gap between a standing vehicle and the lane
CLEAR_M = 2.0  # radius around the place of the car from the kerb in which no vehicle has been
DEFAULT_CAR = "car.hatchback"
LIGHT_M = (6.0, 45.0)  # distance of a moving runner from the stop line
SEEN_M = 70.0  # largest distance of a runner from the ego
IMPATIENT_S = 8.0  # least waiting time of a waiting runner
RUNS_AT = 9.0  # least speed over the stop line [m/s]
TURN = 6  # index of the direction in SUMO's links; vehicles that turn right do not run the light
IGNORES_LIGHTS = 7  # SUMO's speed mode: safe gap and physical limits, but no traffic light and no right of way
NORMAL = 31  # SUMO's default speed mode


class CutIn(NamedTuple):
    """The roles of a cut-in."""

    ego: str  # the vehicle under test
    spot: Spot  # place of the ego at the casting
    neighbour: str | None  # vehicle on the next lane that cuts in; None: a new car pulls out from the kerb


def cast_cut_in(stage: Stage, scenario: Scenario) -> CutIn | None:
    """Return an ego with a free lane ahead, and a vehicle on the next lane or free space at the kerb, if any."""
    for ego in stage.free_egos(scenario):
        spot = stage.spot(ego)
        if not spot or stage.state(ego)[3] < FAST or spot.left < NEXT_ROOM_M or stage.find_leader(ego, 15.0):
            continue
        neighbour = _beside(stage, spot)
        if neighbour is not None:
            return CutIn(ego, spot, neighbour)
        if spot.left < ROOM_M or stage.state(ego)[3] > TOO_FAST or stage.find_leader(ego, 25.0):
            continue
        kind = scenario.actors.get("car", DEFAULT_CAR)
        x, y, _ = stage.point(spot.lane, _stands_at(spot, kind), kerb_offset(spot.lane, kind))
        if spot.lane is spot.edge.lanes_of("driving")[0] and stage.is_untouched(x, y, CLEAR_M):
            return CutIn(ego, spot, None)
    return None


def cut_in(stage: Stage, scenario: Scenario, roles: CutIn) -> Generator[None, None, None]:
    """Change into the ego's lane, close ahead of the ego and a little slower."""
    if roles.neighbour is None:
        yield from _pull_out(stage, scenario, roles)
        return
    vehicle = stage.sumo.vehicle
    name = roles.neighbour
    stage.take(name)
    vehicle.setLaneChangeMode(name, 0)
    lane = int(roles.spot.lane.id.rpartition("_")[2])
    close = False
    for _ in range(round((FALLS_BACK_S + 2 * MOVES_OVER_S) / STEP_S)):
        if roles.ego in vehicle.getIDList():
            gap = vehicle.getLanePosition(name) - vehicle.getLength(name) - vehicle.getLanePosition(roles.ego)
            passes = gap < NARROW_M and not close
            vehicle.setSpeed(name, max((1.3 if passes else 0.8) * vehicle.getSpeed(roles.ego), 3.0))
            if NARROW_M <= gap <= CLOSE_M and not close:
                close = True
                vehicle.changeLane(name, lane, 20.0)
        yield
    vehicle.setSpeed(name, -1.0)
    vehicle.setLaneChangeMode(name, 1621)


def _beside(stage: Stage, ego: Spot) -> str | None:
    """Return a moving vehicle on a neighbouring lane whose gap from the ego is within `NEXT_M`, if any."""
    driving = list(ego.edge.lanes_of("driving"))
    here = driving.index(ego.lane) if ego.lane in driving else -9
    for name in stage.sumo.vehicle.getIDList():
        spot = stage.spot(name)
        if name.startswith(("cav", "scripted")) or not spot or spot.edge is not ego.edge or spot.lane not in driving:
            continue
        gap = spot.along - stage.sumo.vehicle.getLength(name) - ego.along
        if abs(driving.index(spot.lane) - here) == 1 and NEXT_M[0] <= gap <= NEXT_M[1] and stage.state(name)[3] > FAST:
            return name
    return None


def _stands_at(ego: Spot, kind: str) -> float:
    """Return the position along the lane [m] of the front of a car at the kerb, `CLOSE_M` ahead of the ego."""
    return ego.along + CLOSE_M + shape_of(kind).length


def kerb_offset(lane: Lane, kind: str) -> float:
    """Return the lateral offset [m], left positive, of a vehicle parked at the right side of a lane from its middle."""
    return -(lane.width / 2 + KERB_GAP_M + shape_of(kind).width / 2)


def _pull_out(stage: Stage, scenario: Scenario, roles: CutIn) -> Generator[None, None, None]:
    """Let a car at the kerb pull out ahead of the ego and continue in the traffic."""
    kind = scenario.actors.get("car", DEFAULT_CAR)
    name, lane, along = stage.cast(kind), roles.spot.lane, _stands_at(roles.spot, kind)
    aside = kerb_offset(lane, kind)
    stage.place_from_start(name, *stage.point(lane, along, aside))
    speed = 0.7 * stage.state(roles.ego)[3]
    stage.enter(name, kind, (lane, along), stage.list_remaining_edges(roles.ego), 1.0)
    steps = round(MOVES_OVER_S / STEP_S)
    for i in range(steps):
        left, rate = ease(i / steps)
        moving = max(stage.state(name)[3], 1.0)
        turn = math.atan2(-aside * rate / MOVES_OVER_S, moving)
        stage.shifted[name] = (aside * (1 - left), min(turn, math.radians(25.0)))
        stage.sumo.vehicle.setSpeed(name, speed * min(1.0, 0.3 + i / steps))
        yield
    del stage.shifted[name]
    stage.sumo.vehicle.setSpeed(name, -1.0)


class Runner(NamedTuple):
    """The roles of a red-light running: the vehicle, and the id of the traffic light."""

    name: str
    light: str


def cast_runner(stage: Stage, scenario: Scenario) -> Runner | None:
    """Return the first vehicle at a red light near an ego, still moving or waiting for `IMPATIENT_S`, if any."""
    egos = stage.egos(scenario)
    for name in stage.sumo.vehicle.getIDList():
        lights, ways = stage.sumo.vehicle.getNextTLS(name), stage.sumo.vehicle.getNextLinks(name)
        if not lights or not ways or name.startswith("cav") or not stage.spot(name) or ways[0][TURN] in "rR":
            continue
        light, _, distance, state = lights[0]
        near = any(math.dist(stage.state(name)[:2], stage.state(ego)[:2]) <= SEEN_M for ego in egos)
        first = stage.find_leader(name, distance + 12.0) is None
        moving = LIGHT_M[0] <= distance <= LIGHT_M[1] and stage.state(name)[3] > FAST
        waited = stage.sumo.vehicle.getWaitingTime(name) > IMPATIENT_S
        if near and first and state == "r" and (moving or waited):
            return Runner(name, light)
    return None


def run_the_light(stage: Stage, scenario: Scenario, runner: Runner) -> Generator[None, None, None]:
    """Cross the stop line on red; one second later, obey lights and right of way again."""
    vehicle = stage.sumo.vehicle
    name = runner.name
    stage.take(name)
    vehicle.setSpeedMode(name, IGNORES_LIGHTS)
    vehicle.setSpeed(name, max(RUNS_AT, stage.state(name)[3]))
    while name in vehicle.getIDList() and any(light[0] == runner.light for light in vehicle.getNextTLS(name)[:1]):
        yield
    for _ in range(round(1.0 / STEP_S)):
        yield
    if name in vehicle.getIDList():
        vehicle.setSpeedMode(name, NORMAL)
        vehicle.setSpeed(name, -1.0)


def shape_of(kind: str) -> Shape:
    """Return the shape of a vehicle type, "category.shape"."""
    category, _, name = kind.partition(".")
    return next(shape for shape in SHAPES[category] if shape.name == name)


def ease(share: float) -> tuple[float, float]:
    """Return the smoothstep 3 s² - 2 s³ and its derivative, with s the elapsed share of a manoeuvre's time."""
    return share**2 * (3 - 2 * share), 6 * share * (1 - share)
