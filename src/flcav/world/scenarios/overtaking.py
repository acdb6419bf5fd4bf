"""An oncoming car overtakes and comes towards one in one's own lane."""

import math
from collections.abc import Generator
from typing import NamedTuple

from flcav.world.scenarios.manoeuvres import ease, length_of
from flcav.world.scenarios.scenario import Scenario
from flcav.world.scenarios.stage import STEP_S, Spot, Stage

KIND = "car.sedan"
BEHIND_M = 5.0  # bumper to bumper, before it pulls out
AHEAD_M = 4.0  # and before it moves back
MEETS_M = (45.0, 120.0)  # how far away the vehicle under test is then
ASIDE_M = 9.0  # and at most so far off its line
ROOM_M = 62.0  # of lane for the manoeuvre
SLOW = 3.0  # [m/s] what is overtaken is slow
FASTER = 7.0  # [m/s] by so much it is overtaken
GAINS_MPS2 = 3.5
SWINGS_S = 1.8  # from one lane to the other
OPPOSITE = math.radians(150.0)  # at least, between headings


class Overtaking(NamedTuple):
    """Who is overtaken where."""

    slow: str
    spot: Spot


def cast_overtaking(stage: Stage, scenario: Scenario) -> Overtaking | None:
    """Return somebody oncoming to a vehicle under test, with nobody behind and room ahead."""
    for ego in stage.egos(scenario):
        x, y, angle, speed = stage.state(ego)
        heading = math.radians(90.0 - angle)
        for name in stage.sumo.vehicle.getIDList() if speed > SLOW else ():
            spot = stage.spot(name)
            if name.startswith("cav") or not spot or spot.left < ROOM_M or len(spot.edge.lanes_of("driving")) > 1:
                continue
            to_x, to_y, their_angle, their_speed = stage.state(name)
            dx, dy = to_x - x, to_y - y
            ahead = dx * math.cos(heading) + dy * math.sin(heading)
            aside = -dx * math.sin(heading) + dy * math.cos(heading)
            turned = abs((their_angle - angle + 180.0) % 360.0 - 180.0)
            meets = MEETS_M[0] <= ahead <= MEETS_M[1] and 0.0 < aside < ASIDE_M and math.radians(turned) > OPPOSITE
            if meets and their_speed > SLOW / 2 and not stage.leader(name, 40.0) and _alone(stage, name, spot):
                return Overtaking(name, spot)
    return None


def _alone(stage: Stage, name: str, spot: Spot) -> bool:
    """Say whether nobody follows close behind, so that somebody could have all along."""
    behind = BEHIND_M + stage.sumo.vehicle.getLength(name)
    trail = dict(stage.trail(name, behind))
    if stage.step not in trail:
        return False
    for other, states in stage.past.items():
        if other != name:
            for step, (x, y, _, _) in states:
                at = trail.get(step)
                if at is not None and math.hypot(at[0] - x, at[1] - y) < 5.5 and step > stage.step - 150:
                    return False
    return True


def overtake(stage: Stage, scenario: Scenario, roles: Overtaking) -> Generator[None, None, None]:
    """Follow the slow one, pull out, pass, move back, and drive on as anybody; oncoming traffic brakes."""
    vehicle, slow, lane = stage.sumo.vehicle, roles.slow, roles.spot.lane
    kind = scenario.actors.get("car", KIND)
    name, length = stage.cast(kind), length_of(kind)
    slow_length = vehicle.getLength(slow)
    for step, (x, y, angle, speed) in stage.trail(slow, BEHIND_M + slow_length):
        stage.place(name, x, y, math.radians(90.0 - angle), speed, step)
    stage.take(slow)
    vehicle.slowDown(slow, SLOW, 1.5)
    at = vehicle.getLanePosition(slow) - slow_length - BEHIND_M
    speed, out, back = stage.state(slow)[3], 0.0, 0.0
    while back < 1.0:
        yield
        ahead_of = vehicle.getLanePosition(slow) if vehicle.getLaneID(slow) == lane.id else at - length
        passed = at - length > ahead_of + AHEAD_M
        speed = min(speed + GAINS_MPS2 * STEP_S, SLOW + FASTER)
        at += speed * STEP_S
        out = min(out + STEP_S / SWINGS_S, 1.0)
        back = back + STEP_S / SWINGS_S if passed and out >= 1.0 else back
        share, rate = ease(out if back == 0.0 else 1.0 - min(back, 1.0))
        turn = math.atan2(lane.width * rate / SWINGS_S, speed) * (1 if back == 0.0 else -1)
        x, y, heading = stage.point(lane, at, lane.width * share)
        stage.place(name, x, y, heading + turn, speed)
        reach_x, reach_y, _ = stage.point(lane, at + 8.0, lane.width)
        stage.brake_for(reach_x, reach_y, half_width_m=1.5)
    stage.drive_on()
    stage.enter(name, kind, (lane, min(at, roles.spot.along + roles.spot.left - 1.0)), stage.onward(slow), speed)
    vehicle.setSpeed(slow, -1.0)
