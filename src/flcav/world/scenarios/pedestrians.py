"""Script of an occluded pedestrian, who runs into the road from behind a parked van."""

import math
from collections.abc import Generator
from typing import NamedTuple

from flcav.world.map.roads import Edge
from flcav.world.scenarios.manoeuvres import kerb_offset, shape_of
from flcav.world.scenarios.scenario import Scenario
from flcav.world.scenarios.stage import CAREFUL_MPS2, STEP_S, Spot, Stage

VAN, PEDESTRIAN = "van.high_van", "pedestrian.child"
FAST = 4.0  # least speed of the ego [m/s]
AHEAD_M = (22.0, 45.0)  # limits of the distance from the ego to the crossing
BEFORE_VAN_M = 0.9  # distance from the van's front bumper to the pedestrian's path
RUNS_AT = 2.6  # speed of the pedestrian [m/s]
NOTICED_S = 0.9  # the run begins this long, less the time to reach the lane, before the last moment to brake
WALK_ON_M = 1.5  # distance that the pedestrian walks beyond the far kerb
CLEAR_M = 2.2  # radius around the van's place in which no vehicle has been


class BehindVan(NamedTuple):
    """The roles of a pedestrian who runs out from behind a van."""

    ego: str  # the vehicle under test
    spot: Spot  # place of the ego at the casting
    along: float  # position of the crossing along the ego's lane [m]
    kinds: tuple[str, str]  # vehicle types of the van and the pedestrian


def cast_behind_van(stage: Stage, scenario: Scenario) -> BehindVan | None:
    """Return an ego in free flow on the rightmost lane, with room for a van at the kerb ahead, if any."""
    kinds = scenario.actors.get("van", VAN), scenario.actors.get("pedestrian", PEDESTRIAN)
    for ego in stage.free_egos(scenario):
        spot, speed = stage.spot(ego), stage.state(ego)[3]
        if not spot or speed < FAST or spot.lane is not spot.edge.lanes_of("driving")[0]:
            continue
        along = spot.along + min(max(AHEAD_M[0], 3.2 * speed), AHEAD_M[1])
        if along + 12.0 > spot.along + spot.left or stage.find_leader(ego, along - spot.along + 6.0):
            continue
        middle = along - BEFORE_VAN_M - shape_of(kinds[0]).length / 2
        x, y, _ = stage.point(spot.lane, middle, kerb_offset(spot.lane, kinds[0]))
        if stage.is_untouched(x, y, CLEAR_M):
            return BehindVan(ego, spot, along, kinds)
    return None


def run_out(stage: Stage, scenario: Scenario, roles: BehindVan) -> Generator[None, None, None]:
    """Let a pedestrian wait behind the van until the ego is near, then run across the street; traffic brakes.

    The pedestrian starts so that the ego can just stop. Van and pedestrian are there from the start of the traffic run.
    """
    lane = roles.spot.lane
    vehicle = stage.sumo.vehicle
    van, pedestrian = (stage.cast(kind) for kind in roles.kinds)
    hidden = kerb_offset(lane, roles.kinds[0])
    stands = stage.point(lane, roles.along - BEFORE_VAN_M, hidden)
    stage.place_from_start(van, *stands)
    stage.place_from_start(pedestrian, *_walker(stage, roles, hidden))
    at = hidden
    far = _far_kerb(stage, roles.spot.edge, lane.width) + WALK_ON_M
    running = False
    while True:
        yield
        stage.place(van, *stands, 0.0)
        gone = roles.ego not in vehicle.getIDList() or vehicle.getLaneID(roles.ego) != lane.id
        if not running and not gone:
            speed = stage.state(roles.ego)[3]
            brakes = speed**2 / (2 * CAREFUL_MPS2) + 0.45 * speed + 3.0
            to_lane = (-lane.width / 2 - hidden) / RUNS_AT
            distance = roles.along - vehicle.getLanePosition(roles.ego)
            running = distance < brakes + speed * max(NOTICED_S - to_lane, 0.0)
        crossing = running and at < far
        at = min(at + RUNS_AT * STEP_S, far) if running else at
        x, y, heading = _walker(stage, roles, at)
        stage.place(pedestrian, x, y, heading, RUNS_AT if crossing else 0.0)
        if crossing and at > -lane.width / 2 - 0.8:
            stage.brake_for([stage.point(lane, roles.along, at)[:2]], half_width_m=2.2)


def _walker(stage: Stage, roles: BehindVan, left: float) -> tuple[float, float, float]:
    """Return x, y [m] and heading [rad] of the pedestrian, `left` [m] to the left of the lane's middle, world frame."""
    x, y, heading = stage.point(roles.spot.lane, roles.along, left)
    return x, y, heading + math.pi / 2


def _far_kerb(stage: Stage, edge: Edge, width: float) -> float:
    """Return the lateral offset [m], left positive, of the far kerb from the middle of an edge's rightmost lane."""
    ours = sum(lane.width for lane in edge.lanes_of("driving"))
    back = [other for other in stage.net.streets if (other.start, other.end) == (edge.end, edge.start)]
    theirs = sum(lane.width for other in back[:1] for lane in other.lanes if lane.kind != "sidewalk")
    return ours - width / 2 + theirs
