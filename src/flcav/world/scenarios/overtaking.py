"""Script of oncoming overtaking: an oncoming car overtakes a slow one in the ego's lane."""

import math
from collections.abc import Generator
from typing import NamedTuple

from flcav.geometry import rotate
from flcav.world.scenarios.manoeuvres import ease, shape_of
from flcav.world.scenarios.scenario import Scenario
from flcav.world.scenarios.stage import STEP_S, Spot, Stage, State, braking_m

KIND = "car.sedan"
BEHIND_M = 4.0  # gap between the bumpers before the car pulls out
AHEAD_M = 3.0  # gap between the bumpers before the car moves back
TAKES_S = 5.5  # estimated duration of the manoeuvre, after which oncoming vehicles can still stop
WITHIN_M = 70.0  # largest additional distance of the ego
STREETS = 4  # number of edges of the ego's route on which the overtaken vehicle may be oncoming
ROOM_M = 42.0  # least length of lane ahead of the overtaken vehicle
SLOW = 3.0  # speed to which the overtaken vehicle slows down [m/s]
FAST = 17.0  # largest speed of the overtaken vehicle before [m/s]
ROLLS = 1.0  # least speed of the ego [m/s]
FASTER = 8.0  # speed of the car relative to the slowed vehicle [m/s]
GAINS_MPS2, SLOWS_MPS2 = 4.5, 2.5  # acceleration of the car; deceleration of both
SHARPEST = math.radians(25.0)  # largest angle of the car to its lane
STANDS_M = 2.0  # gap at which the car stops behind a queue
SWINGS_S = 1.8  # duration of a lane change
WAY_M = (4.0, 12.0, 20.0, 28.0)  # distances ahead of the car of places for which oncoming traffic brakes
OUT = 0.6  # share of the lane change after which the car accelerates
NEIGHBOUR_M = 4.8  # least distance between the fronts of the car and of other vehicles before the manoeuvre
SEEN_STEPS = 60  # steps before the present over which this distance is checked


class Overtaking(NamedTuple):
    """The roles of an oncoming overtaking."""

    slow: str  # the vehicle that is overtaken
    spot: Spot  # its place at the casting


def cast_overtaking(stage: Stage, scenario: Scenario) -> Overtaking | None:
    """Return a vehicle oncoming to an ego, with no vehicle close behind and room to be overtaken, if any."""
    for ego in stage.egos(scenario):
        if stage.state(ego)[3] < ROLLS:
            continue
        ahead = [stage.net.edges[edge] for edge in stage.list_remaining_edges(ego)[:STREETS]]
        oncoming = {(edge.end, edge.start) for edge in ahead}
        for name in stage.sumo.vehicle.getIDList():
            spot = stage.spot(name)
            if name.startswith("cav") or not spot or spot.left < ROOM_M or stage.state(name)[3] > FAST:
                continue
            if spot.lane.kind != "driving" or len(spot.edge.lanes_of("driving")) > 1:
                continue
            follows_on_lane = spot.along > stage.sumo.vehicle.getLength(name) + BEHIND_M + 1.0
            if (
                (spot.edge.start, spot.edge.end) not in oncoming
                or not follows_on_lane
                or stage.find_leader(name, _takes_m(stage.state(name)[3]))
            ):
                continue
            if _meets(stage.state(name), stage.state(ego)) and _way_is_free(stage, name) and _alone(stage, name):
                return Overtaking(name, spot)
    return None


def _meets(one: State, other: State) -> bool:
    """Return whether two vehicles approach head-on, with enough road in between to overtake `one`."""
    dx, dy = other[0] - one[0], other[1] - one[1]
    # SUMO's angles are clockwise from north
    (x, y), (other_x, other_y) = (rotate(0.0, 1.0, -math.radians(state[2])) for state in (one, other))
    facing = dx * x + dy * y > 0.0 > dx * other_x + dy * other_y
    beyond_m = math.hypot(dx, dy) - _takes_m(one[3]) - braking_m(other[3])
    return facing and 0.0 <= beyond_m <= WITHIN_M and one[3] > SLOW / 2


def _takes_m(speed: float) -> float:
    """Return the length of road [m] for overtaking a vehicle at `speed` [m/s]."""
    return TAKES_S * max(SLOW + FASTER, speed)


def _way_is_free(stage: Stage, name: str) -> bool:
    """Return whether the oncoming lane is free over the length needed to overtake a vehicle, including braking."""
    x, y, angle, own_speed = stage.state(name)
    heading = math.radians(90.0 - angle)
    for other in stage.sumo.vehicle.getIDList():
        other_x, other_y, _, speed = stage.state(other)
        ahead, left = rotate(other_x - x, other_y - y, -heading)
        if -10.0 < ahead < _takes_m(own_speed) + braking_m(speed) and 1.0 < stage.net.side * left < 12.0:
            return False
    return True


def _alone(stage: Stage, name: str) -> bool:
    """Return whether a follower `BEHIND_M` behind a vehicle would recently have been `NEIGHBOUR_M` from all others."""
    behind = BEHIND_M + stage.sumo.vehicle.getLength(name)
    trail = dict(stage.trail(name, behind))
    if stage.step not in trail:
        return False
    for other, states in stage.past.items():
        if other != name:
            for step, (x, y, _, _) in states:
                at = trail.get(step)
                if at is not None and math.hypot(at[0] - x, at[1] - y) < NEIGHBOUR_M and step > stage.step - SEEN_STEPS:
                    return False
    return True


def overtake(stage: Stage, scenario: Scenario, roles: Overtaking) -> Generator[None, None, None]:
    """Let a new car follow the slow vehicle, pull out, pass and merge back into the traffic.

    Oncoming traffic brakes.
    """
    vehicle, slow, lane = stage.sumo.vehicle, roles.slow, roles.spot.lane
    kind = scenario.actors.get("car", KIND)
    name, length = stage.cast(kind), shape_of(kind).length
    way = stage.list_remaining_edges(slow)  # from this lane on; the slow vehicle may leave it first
    slow_length = vehicle.getLength(slow)
    for step, (x, y, angle, speed) in stage.trail(slow, BEHIND_M + slow_length):
        stage.place(name, x, y, math.radians(90.0 - angle), speed, step)
    stage.take(slow)
    room = roles.spot.along + roles.spot.left
    at = vehicle.getLanePosition(slow) - slow_length - BEHIND_M
    speed, out, back = stage.state(slow)[3], 0.0, 0.0
    top = max(SLOW + FASTER, speed)
    while back < 1.0:
        yield
        vehicle.setSpeed(slow, max(SLOW, stage.state(slow)[3] - SLOWS_MPS2 * STEP_S))
        on_lane = vehicle.getLaneID(slow) == lane.id and at < room - length
        passed = not on_lane or at - length > vehicle.getLanePosition(slow) + AHEAD_M
        faster = min(speed + GAINS_MPS2 * STEP_S, top)
        speed = faster if out >= OUT else min(faster, stage.state(slow)[3] + 0.5)
        if passed:
            speed = min(speed, math.sqrt(2 * SLOWS_MPS2 * max(stage.gap_ahead(lane, at) - STANDS_M, 0.0)))
        at += speed * STEP_S
        out = min(out + STEP_S / SWINGS_S, 1.0)
        back = back + STEP_S / SWINGS_S if passed and out >= 1.0 else back
        share, rate = ease(out if back == 0.0 else 1.0 - min(back, 1.0))
        turn = min(math.atan2(lane.width * rate / SWINGS_S, speed), SHARPEST) * (1 if back == 0.0 else -1)
        x, y, heading = stage.point(lane, at, lane.width * share)
        stage.place(name, x, y, heading + turn, speed)
        stage.brake_for([stage.point(lane, at + reach, lane.width)[:2] for reach in WAY_M], half_width_m=2.0)
    stage.enter(name, kind, (lane, min(at, room - 1.0)), way, speed)
    vehicle.setSpeed(slow, -1.0)
