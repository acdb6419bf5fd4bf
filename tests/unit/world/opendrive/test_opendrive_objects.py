"""Crosswalks, signal heads, stop lines and parking spaces of an OpenDRIVE map in the town that is made of it."""

import shutil
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from shapely.geometry import LineString, Point, Polygon

from flcav.config import InputError
from flcav.statistics.streams import stream
from flcav.world.map.lanes import map_layers
from flcav.world.map.roads import read_net
from flcav.world.map.surfaces import make_footprint
from flcav.world.map.town import load_town
from flcav.world.materials import Material
from flcav.world.opendrive.importing import ImportedTown, import_town
from flcav.world.opendrive.objects.places import outline_object
from flcav.world.opendrive.road_surface import Road
from flcav.world.static import build_town_mesh, list_signs_and_signals
from flcav.world.traffic.demand import park
from flcav.world.traffic.passages import find_walked
from flcav.world.traffic.traffic import simulate

MAP = Path(__file__).parents[3] / "data" / "cross_with_objects.xodr"

pytest.importorskip("sumo", reason="eclipse-sumo (the extra 'towns') is not installed")


@pytest.fixture(scope="module")
def cross(tmp_path_factory: pytest.TempPathFactory) -> ImportedTown:
    return import_town(MAP, tmp_path_factory.mktemp("towns") / "cross")


def test_crossings_are_where_the_map_has_crosswalks(cross: ImportedTown) -> None:
    found = {
        (round(middle.x, 1), round(middle.y, 1)): crossing
        for crossing in map_layers(cross.town).crossings
        for middle in [Polygon(crossing.outline).centroid]
    }
    assert sorted(found) == [(0.0, 55.0), (11.5, 0.0)]  # of three at the junction and two across a street
    at_junction, across_street = Polygon(found[11.5, 0.0].outline), Polygon(found[0.0, 55.0].outline)
    assert at_junction.symmetric_difference(shapely.box(10.0, -3.5, 13.0, 3.5)).area < 0.3
    assert across_street.symmetric_difference(shapely.box(-3.5, 53.0, 3.5, 57.0)).area < 0.3
    assert any("Crosswalks of the map taken over: 2; left out: 1 (no place or outline)" in note for note in cross.notes)


def test_people_get_across_where_the_street_is_cut(cross: ImportedTown) -> None:
    net = read_net(cross.town.net)
    walked = [edge for edge in net.streets if edge.lanes_of("sidewalk")]
    north = [i for i, edge in enumerate(walked) if "2.end" in (edge.start, edge.end)]
    assert len(north) == 2
    assert find_walked(net, walked)[np.ix_(north, north)].all()
    areas = [Polygon(lane.shape) for edge in net.edges.values() for lane in edge.lanes if lane.kind == "walkingarea"]
    beside = [area for area in areas if area.distance(Point(0.0, 55.0)) < 6]
    assert [round(area.area) for area in beside] == [8, 8]  # 2 m of sidewalk by 4 m
    assert all(area.is_valid for area in beside)


def test_heads_stand_where_the_map_has_them(cross: ImportedTown) -> None:
    signals, net = cross.town.signals, read_net(cross.town.net)
    way = {way.light: way for way in net.connections if way.light}
    from_arm = {}
    for position, yaw, foot, light in list(zip(signals.position, signals.yaw, signals.foot, signals.link))[:-1]:
        lane = next(lane for edge in net.streets for lane in edge.lanes if lane.id == way[light].start)
        come = lane.shape[-1] - lane.shape[-2]
        facing = np.array([np.cos(yaw), np.sin(yaw)])
        assert facing @ come / np.hypot(*come) == pytest.approx(-1.0, abs=0.01)  # it is seen by those whom it stops
        assert way[light].turn == "s"
        from_arm[tuple(np.round(come / np.hypot(*come)).astype(int).tolist())] = (position, foot)
    np.testing.assert_allclose(from_arm[-1, 0][0], (12.0, 4.2, 2.7), atol=0.01)  # height with its post: 3.2 - 1/2
    np.testing.assert_allclose(from_arm[0, 1][0], (4.4, 13.0, 2.9), atol=0.01)  # beyond the junction, by a reference
    np.testing.assert_allclose(from_arm[0, -1][0], (-1.5, -9.0, 5.5), atol=0.01)  # above the road, 5 m + 1 m / 2
    np.testing.assert_allclose(from_arm[0, -1][1], (-4.0, -9.0), atol=0.3)  # its mast beside it
    assert len(from_arm) == 4  # the fourth arm has none in the map: placed by rule
    heads = cross.town.parameters.signals
    assert [head.controller for head in heads] == ["", "", "7", "7"]
    assert "Controllers with several of these heads: 1; switched alike here: 1." in cross.notes


def test_the_head_for_pedestrians_shows_the_light_of_its_crossing(cross: ImportedTown) -> None:
    signals, net = cross.town.signals, read_net(cross.town.net)
    assert signals.walkers == 1
    np.testing.assert_allclose(signals.position[-1], (12.0, 5.0, 2.15), atol=0.01)  # height with its post: 2.5 - 0.7/2
    assert np.degrees(signals.yaw[-1]) == pytest.approx(270.0, abs=1.0)  # across the road, whose other side is south
    way = next(way for way in net.connections if way.light == signals.link[-1])
    (crossing,) = [edge for edge in net.edges.values() if edge.lanes[0].id == way.end]
    assert crossing.function == "crossing"
    assert np.abs(crossing.lanes[0].shape[:, 0] - 11.5).max() < 0.1  # that across the eastern road
    things = list_signs_and_signals(cross.town)
    assert things.kind[-1] == "walker_signal"
    mesh = build_town_mesh(cross.town)
    shown = set(mesh.material[things.face == len(things) - 1].tolist())
    assert shown == {Material.TRIM, Material.LENS_RED, Material.LENS_GREEN}


def test_parking_spaces_are_road_with_lines_and_vehicles(cross: ImportedTown) -> None:
    spaces = cross.town.parameters.parking
    assert sorted(space.x for space in spaces) == pytest.approx([-58, -52, -46, -40])
    roads = shapely.union_all([Polygon(outline) for outline in cross.town.roads])
    lines = [LineString(marking.line) for marking in map_layers(cross.town).markings]
    net = read_net(cross.town.net)
    parked = [car for seed in range(20) for car in park(net, cross.town.parameters, stream(seed, "parked"))]
    assert 20 < len(parked) < 70  # of 80 places
    for space in spaces:
        outline = shapely.box(space.x - 2.75, 8.0 - 1.2, space.x + 2.75, 8.0 + 1.2)
        assert roads.intersection(outline).area > 0.95 * outline.area
        assert sum(line.length for line in lines if outline.contains(line)) == pytest.approx(2 * (5.5 + 2.4), abs=1.0)
    places = {(round(car.x), round(car.y)) for car in parked}
    assert places == {(round(space.x), 8) for space in spaces}
    assert all(abs(np.sin(car.yaw)) < 0.1 for car in parked)
    note = next(note for note in cross.notes if note.startswith("Parking"))
    for reason in ("1 (no place or size of a parking space)", "1 (on a lane for vehicles)", "1 (on a sidewalk)"):
        assert reason in note


def test_buildings_trees_and_fences_of_the_map_stand_there(cross: ImportedTown) -> None:
    town = cross.town  # the road with them leads southwards from (0, -10): its left is in the east
    assert town.buildings.shape == (1, 6)  # a map with buildings has no others
    x, y, yaw, length, width, height = town.buildings[0]
    house = make_footprint(x, y, yaw, length, width)
    assert house.symmetric_difference(shapely.box(-35.0, -80.0, -25.0, -60.0)).area < 0.1
    assert height == 9.0
    np.testing.assert_allclose(town.trees, [(12.0, -40.0, 6.0, 1.5), (14.0, -50.0, 6.0, 1.5), (16.0, -60.0, 6.0, 1.5)])
    fence = next(rows for kind, rows in town.clutter if kind == "fence")
    outline = shapely.union_all([make_footprint(*row[:5]) for row in fence])
    assert outline.symmetric_difference(shapely.box(8.9, -80.0, 9.1, -70.0)).area < 0.01
    np.testing.assert_allclose(fence[:, 5], 1.0 - (fence[:, 1] + 70.0) / 10.0, atol=0.01)  # it rises from 1 m to 2 m
    note = next(note for note in cross.notes if note.startswith("Buildings, plants"))
    assert note.endswith("taken over: 5; left out: 1 (no place or size); left out: 1 (on a lane or sidewalk).")
    others = [make_footprint(*row[:5]) for kind, rows in town.clutter if kind != "fence" for row in rows]
    assert not any(other.intersects(house) for other in others)


def test_outlines_far_from_their_road_are_left_out() -> None:
    row = next(ElementTree.parse(MAP).getroot().iterfind("road"))
    corner = '<cornerRoad s="{}" t="{}"/>'
    outline = "".join(corner.format(s, t) for s, t in ((1, 0), (1, 1e9), (2, 1e9)))
    thing = ElementTree.fromstring(f'<object s="1" t="0"><outline>{outline}</outline></object>')
    assert outline_object(Road(row), thing) is None


def test_stop_lines_are_painted_where_the_map_has_them(cross: ImportedTown) -> None:
    lines = [marking for marking in map_layers(cross.town).markings if marking.kind == "stop_line"]
    painted = shapely.union_all([LineString(line.line).buffer(line.width_m / 2, cap_style="flat") for line in lines])
    known = [shapely.box(-3.5, 14.75, 0.0, 15.25), shapely.box(-12.25, -3.5, -11.75, 0.0)]
    before_crosswalk = shapely.box(13.35, 0.0, 13.85, 3.5)  # the map has the crosswalk, which ends at x = 13
    for place in (*known, before_crosswalk):
        assert painted.intersection(place.buffer(1.0)).symmetric_difference(place).area < 0.2
    assert len(lines) == 4  # the fourth arm's, by rule
    told = "Stop lines of the map taken over: 2; left out: 1 (no lane ends there); left out: 1 (no place or length)."
    assert told in cross.notes


def test_vehicles_stop_before_the_lines_of_the_map(cross: ImportedTown) -> None:
    town = replace(cross.town, parameters=cross.town.parameters.model_copy(update={"vehicles": 12}))
    trace = simulate(town, seed=1, cavs=0, times_s=np.arange(40.0, 100.0))
    forward = np.stack((np.cos(trace.yaw), np.sin(trace.yaw)), axis=-1)
    front = trace.position[..., :2] + forward * trace.size[:, :1] / 2
    moves = [name.startswith("veh") for name in trace.actor]
    stood = front[(np.linalg.norm(trace.velocity, axis=2) < 0.1) & moves]
    southward = stood[(np.abs(stood[:, 0] + 1.75) < 0.5) & (stood[:, 1] > 10.0) & (stood[:, 1] < 20.0)]
    westward = stood[(np.abs(stood[:, 1] - 1.75) < 0.5) & (stood[:, 0] > 10.0) & (stood[:, 0] < 18.0)]
    assert np.median(southward[:, 1]) == pytest.approx(16.0, abs=0.1)  # 1 m before the line, SUMO's usual gap
    assert len(westward) > 5
    assert westward[:, 0].min() > 13.0  # none on the crosswalk


def test_a_signal_of_no_light_is_refused(cross: ImportedTown, tmp_path: Path) -> None:
    folder = shutil.copytree(cross.town.net.parent, tmp_path / "town")
    text = (folder / "town.yaml").read_text()
    (folder / "town.yaml").write_text(text.replace("'10:4'", "'10:99'").replace('"10:4"', '"10:99"'))
    with pytest.raises(InputError, match="a signal shows '10:99', which is no light of the net"):
        load_town(folder)
    (folder / "town.yaml").write_text(text.replace("'3_1'", "'3_9'"))
    with pytest.raises(InputError, match="a stop line lies on '3_9', which is no lane of the net"):
        load_town(folder)
