"""Scripts of breakdowns: a stalled vehicle, and a rear-end crash."""

import math
from collections.abc import Generator
from typing import NamedTuple

from flcav.world.scenarios.scenario import Scenario
from flcav.world.scenarios.stage import STEP_S, Stage

AHEAD_M = (6.0, 60.0)  # limits of the gap from the ego to a stalling vehicle
STREETS = 3  # number of edges of the ego's route, with the present one, on which the vehicle may be
STANDS_BEFORE_M = 15.0  # least distance of a stalling vehicle from the end of its lane
MOVES = 3.0  # least speed of a stalling vehicle [m/s]
ROLLS_OUT_S = 2.5  # time in which it comes to a stop
SEEN_M = 70.0  # largest distance of a crash from the ego
APART_M = (4.0, 25.0)  # limits of the gap between the two vehicles before a crash
ROOM_M = 50.0  # least length of lane ahead of the rear vehicle of a crash; half of it for the front one
FAST = 5.0  # least speed of both vehicles [m/s]
BRAKES_MPS2 = 6.5  # deceleration of the front vehicle
OVERLAP_M = 0.05  # overlap of the two vehicles after the crash
TWIST = (math.radians(5.0), math.radians(-3.0))  # yaw by which the crash turns the rear and the front vehicle
TWIST_S = 0.4  # time in which it turns them


def cast_stalled(stage: Stage, scenario: Scenario) -> str | None:
    """Return the nearest moving vehicle ahead of an ego, in its lane or on its next edges; None if there is none."""
    candidates: list[tuple[float, str]] = []
    for ego in stage.egos(scenario):
        spot, way = stage.spot(ego), stage.list_remaining_edges(ego)[1:STREETS]
        for name in stage.sumo.vehicle.getIDList():
            other = stage.spot(name)
            if name.startswith("cav") or not spot or not other or other.left < STANDS_BEFORE_M:
                continue
            in_lane = other.lane is spot.lane and other.along > spot.along
            apart_m = math.dist(stage.state(name)[:2], stage.state(ego)[:2])
            gap_m = apart_m - stage.sumo.vehicle.getLength(name)
            on_way = in_lane or (other.edge.id in way and other.lane.kind == "driving")
            if on_way and AHEAD_M[0] <= gap_m <= AHEAD_M[1] and stage.state(name)[3] > MOVES:
                candidates.append((gap_m, name))
    return min(candidates)[1] if candidates else None


def stall(stage: Stage, scenario: Scenario, victim: str) -> Generator[None, None, None]:
    """Slow the victim to a stop; let it continue after `scenario.lasts_s`, if given."""
    stage.take(victim)
    stage.sumo.vehicle.slowDown(victim, 0.0, ROLLS_OUT_S)
    for _ in range(round(ROLLS_OUT_S / STEP_S)):
        yield
    stage.sumo.vehicle.setSpeed(victim, 0.0)
    if scenario.lasts_s is not None:
        for _ in range(round(scenario.lasts_s / STEP_S)):
            yield
        stage.sumo.vehicle.setSpeed(victim, -1.0)


class CrashPair(NamedTuple):
    """The two vehicles of a rear-end crash."""

    behind: str
    ahead: str


def cast_crash(stage: Stage, scenario: Scenario) -> CrashPair | None:
    """Return two moving motor vehicles, one behind the other in one lane, near an ego; None if there are none."""
    egos = stage.egos(scenario)
    for behind in stage.sumo.vehicle.getIDList():
        near = any(math.dist(stage.state(behind)[:2], stage.state(ego)[:2]) <= SEEN_M for ego in egos)
        ahead = stage.find_leader(behind, APART_M[1]) if near and not behind.startswith("cav") else None
        if ahead is None or ahead[0].startswith("cav") or ahead[1] < APART_M[0]:
            continue
        spot, other = stage.spot(behind), stage.spot(ahead[0])
        if not spot or not other or spot.lane is not other.lane or spot.left < ROOM_M or other.left < ROOM_M / 2:
            continue
        heavy = all(not stage.sumo.vehicle.getTypeID(name).startswith("bicycle") for name in (behind, ahead[0]))
        if heavy and min(stage.state(behind)[3], stage.state(ahead[0])[3]) >= FAST:
            return CrashPair(behind, ahead[0])
    return None


def crash(stage: Stage, scenario: Scenario, pair: CrashPair) -> Generator[None, None, None]:
    """Brake the front vehicle sharply without reaction of the rear one; after the impact both stop, slightly turned."""
    vehicle = stage.sumo.vehicle
    for name in pair:
        stage.take(name)
        vehicle.setSpeedMode(name, 0)
        vehicle.setLaneChangeMode(name, 0)
    speed, ahead_speed = (stage.state(name)[3] for name in pair)
    speed = max(speed, FAST)
    while True:
        ahead_speed = max(ahead_speed - BRAKES_MPS2 * STEP_S, 0.0)
        gap = vehicle.getLanePosition(pair.ahead) - vehicle.getLength(pair.ahead) - vehicle.getLanePosition(pair.behind)
        gap += ahead_speed * STEP_S
        hit = gap <= speed * STEP_S
        vehicle.setSpeed(pair.ahead, ahead_speed)
        vehicle.setSpeed(pair.behind, (gap + OVERLAP_M) / STEP_S if hit else speed)
        yield
        if hit:
            break
    for name in pair:
        vehicle.setSpeed(name, 0.0)
    steps = round(TWIST_S / STEP_S)
    for i in range(steps):
        for name, turn in zip(pair, TWIST):
            stage.shifted[name] = (0.0, turn * (i + 1) / steps)
        yield
