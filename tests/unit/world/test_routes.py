"""Routes through the lanes of a town, against shapely."""

import numpy as np
import pytest
from shapely.geometry import LineString, Point

from flcav.config import InputError
from flcav.world.map.roads import RoadNet, Route, draw_route, read_net
from flcav.world.map.town import PACKAGED, load_town
from flcav.world.traffic.live import read_light_programs


@pytest.fixture(scope="module")
def net() -> RoadNet:
    return read_net(load_town("grid").net)


@pytest.fixture(scope="module")
def route(net: RoadNet) -> Route:
    return draw_route(net, np.random.default_rng(3), 500.0)


@pytest.mark.parametrize("town", PACKAGED[:4])
@pytest.mark.parametrize("seed", range(3))
def test_a_route_is_one_smooth_line_on_driving_lanes(town: str, seed: int):
    net = read_net(load_town(town).net)
    route = draw_route(net, np.random.default_rng(seed), 300.0)
    assert route.length_m >= 300.0
    assert (np.diff(route.along) > 0).all()
    lanes = [lane for edge in net.edges.values() for lane in edge.lanes_of("driving")]
    drawn = {tuple(point) for lane in lanes for point in lane.shape.tolist()}
    assert {tuple(point) for point in route.points.tolist()} <= drawn
    headings = route.at(np.arange(0.0, route.length_m, 2.0))[:, 2]
    assert np.abs(np.angle(np.exp(1j * np.diff(headings)))).max() < 1.2
    assert set(route.speed.tolist()) <= {lane.speed for lane in lanes}


def test_places_on_a_route_are_those_of_shapely(route: Route):
    line = LineString(route.points)
    assert route.length_m == pytest.approx(line.length)
    for along in np.linspace(0.0, route.length_m, 37):
        x, y, heading = route.at(along)
        assert Point(x, y).distance(line.interpolate(along)) < 1e-6
        aside = x - 0.5 * np.sin(heading), y + 0.5 * np.cos(heading)
        found, left = route.project(*aside, along)
        assert left == pytest.approx(line.distance(Point(aside)), abs=1e-6)
        assert found == pytest.approx(along, abs=0.6)
        assert route.project(2 * x - aside[0], 2 * y - aside[1], along)[1] < 0
    assert route.limit(0.0) == route.speed[0]


def test_the_lights_on_a_route_are_those_before_its_junctions(route: Route, net: RoadNet):
    links = {f"{p.junction}:{i}" for p in read_light_programs(load_town("grid").net) for i in range(len(p.states[0]))}
    assert route.stops
    for along, link in route.stops:
        assert link in links
        (way,) = {way.start for way in net.connections if way.light == link}
        end = next(lane for edge in net.edges.values() for lane in edge.lanes if lane.id == way).shape[-1]
        np.testing.assert_allclose(route.at(along)[:2], end, atol=1e-6)


def test_the_same_stream_draws_the_same_route(route: Route, net: RoadNet):
    again = draw_route(net, np.random.default_rng(3), 500.0)
    np.testing.assert_array_equal(again.points, route.points)
    assert again.stops == route.stops


def test_a_net_without_lanes_is_refused():
    with pytest.raises(InputError, match="no driving lane is longer than 20 m"):
        draw_route(RoadNet({}, {}, frozenset(), {}, ()), np.random.default_rng(0), 100.0)
