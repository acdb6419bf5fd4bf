"""The lane-level map of every town, against its road net and what shapely says of polygons."""

import pickle
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.geometry import LineString, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.geometry.polygon import orient

from flcav.geometry import pose
from flcav.world.map.lanes import RASTER_LAYERS, fill_polygons, map_layers, rasterise
from flcav.world.map.layers import MapLayers, outline_paint
from flcav.world.map.roads import RoadNet, read_net
from flcav.world.map.town import TOWNS, Town, load_town


@pytest.fixture(scope="module", params=TOWNS)
def mapped(request: pytest.FixtureRequest) -> tuple[Town, RoadNet, MapLayers]:
    town = load_town(request.param)
    return town, read_net(town.net), map_layers(town)


def area(polygons: tuple[np.ndarray, ...]) -> BaseGeometry:
    return shapely.union_all([Polygon(outline) for outline in polygons])


def test_lanes_lead_on_from_where_they_end(mapped: tuple[Town, RoadNet, MapLayers]) -> None:
    _, net, layers = mapped
    by_id = {lane.id: lane for lane in layers.lanes}
    assert len(by_id) == len(layers.lanes) == sum(len(edge.lanes) for edge in net.edges.values())
    driving = [lane for lane in layers.lanes if lane.kind == "driving"]
    connected = {connection.start for connection in net.connections}
    assert {lane.id for lane in driving if lane.successors} == {lane.id for lane in driving} & connected
    assert np.mean([bool(lane.successors) for lane in driving]) > 0.95
    for lane in driving:
        for name in lane.successors:
            gap = np.hypot(*(by_id[name].centre_line[0] - lane.centre_line[-1]))
            assert gap < 2.0, (lane.id, name)  # SUMO's roundabouts shift lanes where they are entered


def test_paint_is_on_the_road_and_lines_stay_off_the_crossings(mapped: tuple[Town, RoadNet, MapLayers]) -> None:
    town, _, layers = mapped
    roads = area(town.roads)
    shapes = outline_paint(layers)
    assert {shape.layer for shape in shapes} >= {"marking", "crossing"}
    for shape in shapes:
        polygon = Polygon(shape.outline)
        assert polygon.is_valid
        assert polygon.exterior.is_ccw
        assert polygon.difference(roads).area < 0.02 * polygon.area + 0.01, shape.layer
    crossings = area(tuple(crossing.outline for crossing in layers.crossings))
    for marking in layers.markings:
        assert LineString(marking.line).intersection(crossings).length < 0.05


def test_stripes_lie_in_their_crossing_and_run_along_the_road(mapped: tuple[Town, RoadNet, MapLayers]) -> None:
    _, net, layers = mapped
    assert len(layers.crossings) == sum(edge.function == "crossing" for edge in net.edges.values())
    crossings = area(tuple(crossing.outline for crossing in layers.crossings))
    stripes = [Polygon(shape.outline) for shape in outline_paint(layers) if shape.layer == "crossing"]
    assert all(stripe.difference(crossings).area < 1e-6 for stripe in stripes)
    assert 0.4 < sum(stripe.area for stripe in stripes) / crossings.area < 0.65


def test_who_stops_or_gives_way_has_a_line_before_the_junction(mapped: tuple[Town, RoadNet, MapLayers]) -> None:
    _, net, layers = mapped
    lines = {
        kind: [LineString(row.line) for row in layers.markings if row.kind == kind]
        for kind in ("stop_line", "yield_line")
    }
    for edge in net.streets:
        driving = edge.lanes_of("driving")
        states = set(net.right_of_way.get(edge.id, ""))
        if not driving or not states:
            continue
        stops = net.junctions[edge.end].kind.startswith("traffic_light") or "s" in states
        kind = "stop_line" if stops else "yield_line" if states == {"m"} else None
        for lane in driving:
            way = LineString(lane.shape)
            crossed = [way.intersection(line) for line in lines[kind or "stop_line"] if way.intersects(line)]
            before = [float(way.length - way.project(at.centroid)) for at in crossed]
            last = [distance for distance in before if distance < 3.0]
            assert len(last) == (kind is not None), (edge.id, kind)


def test_arrows_point_where_their_lane_may_go(mapped: tuple[Town, RoadNet, MapLayers]) -> None:
    town, net, layers = mapped
    assert bool(layers.arrows) == (town.name != "suburb")
    lanes = {lane.id: lane for edge in net.streets for lane in edge.lanes}
    for arrow in layers.arrows:
        turns = {connection.turn.lower() for connection in net.connections if connection.start == arrow.lane}
        words = {"s": "straight", "l": "left", "r": "right"}
        assert set(arrow.kind.split("_")) == {words[turn] for turn in turns - {"t"}}
        line = LineString(lanes[arrow.lane].shape)
        at = shapely.Point(arrow.x, arrow.y)
        assert line.distance(at) < 0.1
        ahead = line.interpolate(line.project(at) + 1.0)
        assert np.cos(np.arctan2(ahead.y - arrow.y, ahead.x - arrow.x) - arrow.yaw) > 0.97


def test_streets_of_two_directions_have_a_middle_line(mapped: tuple[Town, RoadNet, MapLayers]) -> None:
    _, net, layers = mapped
    lines = shapely.union_all([LineString(row.line) for row in layers.markings if row.kind in ("dashed", "solid")])
    for edge in net.streets:
        back = [other for other in net.streets if (other.start, other.end) == (edge.end, edge.start)]
        if len(back) == 1 and edge.type != "loop":
            inner = LineString(edge.lanes[-1].shape).offset_curve(edge.lanes[-1].width / 2)
            assert lines.distance(inner.interpolate(0.5, normalized=True)) < 4.6, (
                edge.id
            )  # at most a gap between dashes


def test_a_raster_says_what_shapely_says(mapped: tuple[Town, RoadNet, MapLayers]) -> None:
    town, net, layers = mapped
    centre = next(junction.centre for junction in net.junctions.values() if len(junction.shape) > 8)
    world_from_patch = pose(float(centre[0]), float(centre[1]), 0.0, 0.4)
    raster = rasterise(layers, world_from_patch, (40.0, 24.0), 0.4)
    assert raster.shape == (len(RASTER_LAYERS), 100, 60)
    rows, columns = np.mgrid[0:100, 0:60]
    x, y = 20.0 - (rows + 0.5) * 0.4, 12.0 - (columns + 0.5) * 0.4
    points = np.stack((x, y, 0 * x, 1 + 0 * x)).reshape(4, -1)
    world = (world_from_patch @ points)[:2]
    shapes = outline_paint(layers)
    expected = {
        "road": list(town.roads),
        "sidewalk": list(town.sidewalks),
        "crossing": [crossing.outline for crossing in layers.crossings],
        "stripe": [shape.outline for shape in shapes if shape.layer == "crossing"],
        "arrow": [shape.outline for shape in shapes if shape.layer == "arrow"],
    }
    for name, outlines in expected.items():
        polygons = shapely.union_all([Polygon(outline) for outline in outlines])
        inside = shapely.contains_xy(polygons, *world).reshape(100, 60)
        edge = shapely.dwithin(polygons.boundary, shapely.points(*world), 1e-6).reshape(100, 60)
        np.testing.assert_array_equal(raster[RASTER_LAYERS.index(name)][~edge], inside[~edge], err_msg=name)
    lines = raster[RASTER_LAYERS.index("marking")]
    assert lines.any()
    assert not (lines & ~raster[RASTER_LAYERS.index("road")]).any()


coordinate = st.floats(-3, 13, allow_nan=False).map(lambda v: round(v, 3) + 0.0001)


@settings(max_examples=150, deadline=None)
@given(st.lists(st.lists(st.tuples(coordinate, coordinate), min_size=3, max_size=8), min_size=1, max_size=4))
def test_filling_any_convex_polygons(outlines: list[list[tuple[float, float]]]) -> None:
    hulls = [shapely.MultiPoint(outline).convex_hull for outline in outlines]
    hulls = [orient(hull) for hull in hulls if isinstance(hull, Polygon) and hull.area > 1e-6]
    if not hulls:
        return
    rings = [np.asarray(hull.exterior.coords)[:-1] for hull in hulls]
    filled = fill_polygons(np.concatenate(rings), np.array([len(ring) for ring in rings]), (10, 9))
    rows, columns = np.mgrid[0:10, 0:9] + 0.5
    expected = shapely.contains_xy(shapely.union_all(hulls), rows, columns)
    near = shapely.dwithin(shapely.union_all([hull.boundary for hull in hulls]), shapely.points(rows, columns), 1e-7)
    np.testing.assert_array_equal(filled[~near], expected[~near])


def test_the_same_town_gives_the_same_map() -> None:
    one, other = (pickle.dumps(map_layers(load_town("ring"))) for _ in range(2))
    assert one == other
    assert Path(load_town("ring").net).name == "town.net.xml"
