"""Towns as OpenDRIVE maps, read back by CARLA's own reader and by ElementTree."""

import xml.etree.ElementTree as ElementTree

import pytest

from flcav.world.map.roads import read_net
from flcav.world.map.town import load_town
from flcav.world.opendrive.exporting import export_town


@pytest.fixture(scope="module", params=["grid", "ring"])
def exported(request: pytest.FixtureRequest) -> tuple[str, str]:
    """Return a town's name, and its map."""
    return request.param, export_town(load_town(request.param))


def test_carla_drives_on_driving_lanes_alone(exported: tuple[str, str]) -> None:
    """Routes of its planner fail where a lane for bicycles follows a driving lane; few lanes end without another."""
    carla = pytest.importorskip("carla", reason="needs the extra 'carla'")
    town = carla.Map(*exported)
    ways = town.get_topology()
    assert len(ways) > 80
    assert {end.lane_type for way in ways for end in way} == {carla.LaneType.Driving}
    places = town.generate_waypoints(10.0)
    follow = [place.next(8.0) for place in places]
    assert {each.lane_type for found in follow for each in found} == {carla.LaneType.Driving}
    assert sum(not found for found in follow) < 0.02 * len(places)
    assert {each.lane_type for place in places for each in place.previous(8.0)} <= {carla.LaneType.Driving}


def test_crosswalks_end_where_they_began_as_carla_reads_them(exported: tuple[str, str]) -> None:
    carla = pytest.importorskip("carla", reason="needs the extra 'carla'")
    points = [(point.x, point.y) for point in carla.Map(*exported).get_crosswalks()]
    assert points
    assert len(points) % 5 == 0
    assert all(points[start] == pytest.approx(points[start + 4]) for start in range(0, len(points), 5))


def test_lanes_are_changed_over_broken_lines_alone(exported: tuple[str, str]) -> None:
    marks = list(ElementTree.fromstring(exported[1]).iter("roadMark"))
    told = {(mark.get("type"), mark.get("laneChange")) for mark in marks}
    assert told <= {("solid", "none"), ("broken", "both"), ("none", None)}
    assert ("solid", "none") in told


def test_every_driving_lane_of_the_net_is_one_of_the_map(exported: tuple[str, str]) -> None:
    name, text = exported
    net = read_net(load_town(name).net)
    roads = [road for road in ElementTree.fromstring(text).iterfind("road") if road.get("junction") == "-1"]
    lanes = sum(lane.get("type") == "driving" for road in roads for lane in road.iter("lane"))
    assert lanes == sum(len(edge.lanes_of("driving")) for edge in net.streets)
