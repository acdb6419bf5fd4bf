"""Vehicles that stop for good: one that breaks down, and two that crash."""

import math
from collections.abc import Generator
from typing import NamedTuple

from flcav.world.scenarios.scenario import Scenario
from flcav.world.scenarios.stage import STEP_S, Stage

AHEAD_M = (6.0, 60.0)  # a vehicle that breaks down is so far ahead
STREETS = 3  # on one of so many streets of the way
STANDS_BEFORE_M = 15.0  # a junction, at least
MOVES = 3.0  # [m/s] at least
ROLLS_OUT_S = 2.5  # and takes so long to stop
SEEN_M = 70.0  # a crash is as near as this
APART_M = (4.0, 25.0)  # before it, the two are so far apart
ROOM_M = 50.0  # and have so much of their lane left
FAST = 5.0  # at least [m/s]
BRAKES_MPS2 = 6.5  # the first one, sharply
OVERLAP_M = 0.05  # how far metal gives way
TWIST = (math.radians(5.0), math.radians(-3.0))  # how far they are turned by it: who ran into it, and whom
TWIST_S = 0.4


def cast_stalled(stage: Stage, scenario: Scenario) -> str | None:
    """Return the nearest moving vehicle ahead of one under test, in its lane or on the next streets of its way."""
    found: list[tuple[float, str]] = []
    for ego in stage.egos(scenario):
        spot, way = stage.spot(ego), stage.onward(ego)[1:STREETS]
        for name in stage.sumo.vehicle.getIDList():
            other = stage.spot(name)
            if name.startswith("cav") or not spot or not other or other.left < STANDS_BEFORE_M:
                continue
            in_lane = other.lane is spot.lane and other.along > spot.along
            apart_m = math.dist(stage.state(name)[:2], stage.state(ego)[:2])
            gap_m = apart_m - stage.sumo.vehicle.getLength(name)
            on_way = in_lane or (other.edge.id in way and other.lane.kind == "driving")
            if on_way and AHEAD_M[0] <= gap_m <= AHEAD_M[1] and stage.state(name)[3] > MOVES:
                found.append((gap_m, name))
    return min(found)[1] if found else None


def stall(stage: Stage, scenario: Scenario, victim: str) -> Generator[None, None, None]:
    """Roll out and stand; drive on after `lasts_s`."""
    stage.take(victim)
    stage.sumo.vehicle.slowDown(victim, 0.0, ROLLS_OUT_S)
    for _ in range(round(ROLLS_OUT_S / STEP_S)):
        yield
    stage.sumo.vehicle.setSpeed(victim, 0.0)
    if scenario.lasts_s is not None:
        for _ in range(round(scenario.lasts_s / STEP_S)):
            yield
        stage.sumo.vehicle.setSpeed(victim, -1.0)


class Pair(NamedTuple):
    """Who runs into whom."""

    behind: str
    ahead: str


def cast_crash(stage: Stage, scenario: Scenario) -> Pair | None:
    """Return two vehicles that follow each other near one under test."""
    egos = stage.egos(scenario)
    for behind in stage.sumo.vehicle.getIDList():
        near = any(math.dist(stage.state(behind)[:2], stage.state(ego)[:2]) <= SEEN_M for ego in egos)
        ahead = stage.leader(behind, APART_M[1]) if near and not behind.startswith("cav") else None
        if ahead is None or ahead[0].startswith("cav") or ahead[1] < APART_M[0]:
            continue
        spot, other = stage.spot(behind), stage.spot(ahead[0])
        if not spot or not other or spot.lane is not other.lane or spot.left < ROOM_M or other.left < ROOM_M / 2:
            continue
        heavy = all(not stage.sumo.vehicle.getTypeID(name).startswith("bicycle") for name in (behind, ahead[0]))
        if heavy and min(stage.state(behind)[3], stage.state(ahead[0])[3]) >= FAST:
            return Pair(behind, ahead[0])
    return None


def crash(stage: Stage, scenario: Scenario, pair: Pair) -> Generator[None, None, None]:
    """Have the first brake sharply and the second notice nothing; then both stand, turned a little."""
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
