"""The towns, against what shapely says of their polygons."""

import pickle
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import shapely
from shapely.geometry import LineString, Polygon
from shapely.geometry.base import BaseGeometry

from flcav.config import InputError
from flcav.world.map import town as town_module
from flcav.world.map.parameters import CLUTTER
from flcav.world.map.roads import read_net
from flcav.world.map.surfaces import make_footprint
from flcav.world.map.town import TOWNS, Town, load_town


@pytest.fixture(scope="module", params=TOWNS)
def town(request: pytest.FixtureRequest) -> Town:
    return load_town(request.param)


def area(polygons: tuple[np.ndarray, ...]) -> BaseGeometry:
    return shapely.union_all([Polygon(outline) for outline in polygons])


def footprints(rows: np.ndarray) -> np.ndarray:
    return np.array([make_footprint(*row[:5]) for row in rows])


def test_ground_is_made_of_simple_disjoint_polygons(town: Town) -> None:
    for polygons in (town.roads, town.sidewalks):
        pieces = [Polygon(outline) for outline in polygons]
        assert all(piece.is_valid and piece.exterior.is_ccw for piece in pieces)
        assert sum(piece.area for piece in pieces) == pytest.approx(area(polygons).area, abs=0.1)
    assert area(town.roads).intersection(area(town.sidewalks)).area < 0.1


def test_every_lane_lies_on_its_surface(town: Town) -> None:
    surface = {"driving": town.roads, "parking": town.roads, "bicycle": town.roads, "sidewalk": town.sidewalks}
    for edge in read_net(town.net).streets:
        for lane in edge.lanes:
            strip = LineString(lane.shape).buffer(0.9 * lane.width / 2, cap_style="flat")
            assert strip.difference(area(surface[lane.kind])).area < 0.01 * strip.area, lane.id


def test_kerbs_run_between_road_and_sidewalk(town: Town) -> None:
    kerbs = shapely.union_all([LineString(line) for line in town.kerbs])
    for polygons in (town.roads, town.sidewalks):
        assert kerbs.difference(area(polygons).boundary.buffer(0.1)).length < 0.01 * kerbs.length
    shared = area(town.roads).boundary.intersection(area(town.sidewalks).buffer(0.05)).length
    assert kerbs.length == pytest.approx(shared, rel=0.03)


def test_buildings_stand_on_free_land_and_apart(town: Town) -> None:
    buildings = footprints(town.buildings)
    assert len(buildings) > 60
    ground = area((*town.roads, *town.sidewalks))
    assert not shapely.intersects(buildings, ground).any()
    near = shapely.STRtree(buildings).query(buildings, predicate="dwithin", distance=0.2)
    assert (near[0] == near[1]).all()


def test_clutter_and_trees_leave_room_to_drive_and_to_walk(town: Town) -> None:
    walked = [
        LineString(lane.shape).buffer(lane.width / 2, cap_style="flat")
        for edge in read_net(town.net).streets
        for lane in edge.lanes_of("sidewalk")
    ]
    closed = shapely.union_all([area(town.roads), *walked, *footprints(town.buildings)])
    assert {kind for kind, _ in town.clutter} <= set(CLUTTER)
    for _, rows in town.clutter:
        assert not shapely.intersects(footprints(rows), closed).any()
    assert not shapely.contains_xy(closed, *town.trees[:, :2].T).any()


def test_poles_stand_at_the_kerb_and_face_what_they_watch(town: Town) -> None:
    poles = town.poles
    net = read_net(town.net)
    assert len(poles.id) >= 3
    assert (np.diff(poles.id) > 0).all()
    mounts = shapely.points(poles.position[:, :2])
    assert (poles.position[:, 2] == 6.0).all()
    assert shapely.intersects(area(town.sidewalks), mounts).all()
    assert (shapely.distance(mounts, area(town.roads)) < 0.6).all()
    assert not shapely.intersects(shapely.union_all(footprints(town.buildings)), mounts).any()
    inside = shapely.union_all([Polygon(j.shape) for j in net.junctions.values() if len(j.shape) > 2])
    assert not shapely.intersects(inside, mounts).any()
    ahead = poles.position[:, :2] + 9.0 * np.stack((np.cos(poles.yaw), np.sin(poles.yaw)), axis=1)
    assert shapely.contains_xy(area(town.roads), *ahead.T).all()


def test_no_lamp_stands_in_the_view_of_a_sensor(town: Town) -> None:
    away = np.linalg.norm(town.lamps[:, None, :2] - town.poles.position[:, :2], axis=2)
    assert away.min() > 2.0


def test_kind_of_a_pole_fits_the_junction_it_watches(town: Town) -> None:
    net = read_net(town.net)
    for pole, kind in zip(sorted(town.parameters.poles, key=lambda pole: pole.id), town.poles.kind):
        end = net.edges[pole.edge].end
        arms = sum(edge.start == end for edge in net.streets)
        assert kind == "straight" or (end in net.roundabouts) == (kind == "roundabout")
        assert arms == {"cross": 4, "tee": 3}.get(kind, arms)


def test_signs_face_the_traffic_they_address(town: Town) -> None:
    signs = town.signs
    assert set(signs.kind) <= {"stop", "yield", "speed_30", "speed_60", "speed_90"}
    lanes = [LineString(lane.shape) for edge in read_net(town.net).streets for lane in edge.lanes_of("sidewalk")]
    tree = shapely.STRtree(lanes)
    for (x, y, _), yaw in zip(signs.position, signs.yaw):
        line = lanes[int(tree.nearest(shapely.Point(x, y)))]
        at = line.project(shapely.Point(x, y))
        a, b = line.interpolate(max(at - 0.3, 0)), line.interpolate(at + 0.3)
        driving = np.arctan2(b.y - a.y, b.x - a.x)
        assert np.cos(yaw - driving) < -0.95


def test_everything_is_within_bounds(town: Town) -> None:
    x_min, y_min, x_max, y_max = town.bounds
    assert max(x_max - x_min, y_max - y_min) < 430
    for x, y in (
        town.buildings[:, :2].T,
        town.lamps[:, :2].T,
        town.poles.position[:, :2].T,
        town.signs.position[:, :2].T,
    ):
        assert ((x > x_min) & (x < x_max) & (y > y_min) & (y < y_max)).all()


def test_same_files_same_town(town: Town) -> None:
    town_module._build_town.cache_clear()
    assert pickle.dumps(load_town(town.name)) == pickle.dumps(town)


def test_a_town_is_built_once_and_anew_where_a_file_changed(tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    shutil.copytree(load_town("ring").net.parent, folder)
    first = load_town(folder)
    assert load_town(folder) is first
    path = folder / "town.yaml"
    path.write_text(path.read_text().replace("vehicles: 40", "vehicles: 39"))
    assert load_town(folder).parameters.vehicles == 39


def test_all_situations_occur() -> None:
    kinds = {kind for name in ("grid", "ring") for kind in load_town(name).poles.kind}
    assert kinds == {"straight", "cross", "tee", "roundabout"}
    grid = load_town("grid").poles
    assert grid.id.tolist() == list(range(1, 10))
    assert grid.kind[7] == "straight"


def test_every_kind_of_sign_and_lights_stand_in_arterial() -> None:
    town = load_town("arterial")
    assert set(town.signs.kind) == {"stop", "yield", "speed_30", "speed_60", "speed_90"}
    assert len(town.signals.link) >= 15


def test_suburb_is_aligned_with_the_axes_and_grid_is_not() -> None:
    def aligned(name: str) -> float:
        lines = [edge.lanes[-1].shape for edge in read_net(load_town(name).net).streets]
        steps = np.concatenate([np.diff(line, axis=0) for line in lines])
        angle = np.arctan2(*steps.T)
        off = np.abs((angle + np.pi / 4) % (np.pi / 2) - np.pi / 4)
        return float(np.average(off < np.radians(3), weights=np.hypot(*steps.T)))

    assert aligned("suburb") > 0.9
    assert aligned("grid") < 0.1


def test_unknown_town_names_the_known_ones() -> None:
    with pytest.raises(InputError, match=r"'atlantis'.*suburb, grid, ring"):
        load_town("atlantis")


def test_a_folder_is_a_town(tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    shutil.copytree(load_town("ring").net.parent, folder)
    assert load_town(folder).name == "mine"
    assert load_town(str(folder)).buildings.shape == load_town("ring").buildings.shape


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("edge: x_re", "edge: nowhere", "pole 1 stands on 'nowhere'"),
        ("  outer:", "  inner:", "lacks the street type 'outer'"),
        ("vehicles: 40", "vehicles: -1", "vehicles"),
        ("car: 0.58", "tank: 0.58", "tank"),
        ("setback_m: [1.0, 4.0]", "setback_m: [4.0, 1.0]", "low <= high"),
        ("id: 2", "id: 1", "pole ids must differ"),
        ("vehicles: 40", "vehicles: 40\nlorries: 3", "unknown field 'lorries'"),
    ],
)
def test_bad_parameters_are_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    folder = tmp_path / "mine"
    shutil.copytree(load_town("ring").net.parent, folder)
    text = (folder / "town.yaml").read_text()
    assert old in text
    (folder / "town.yaml").write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=message):
        load_town(folder)


@pytest.mark.parametrize("text", ["<roads/>", "not xml"])
def test_a_file_that_is_no_net_is_named(tmp_path: Path, text: str) -> None:
    folder = tmp_path / "mine"
    shutil.copytree(load_town("ring").net.parent, folder)
    (folder / "town.net.xml").write_text(text)
    with pytest.raises(InputError, match="not a SUMO net"):
        load_town(folder)


@pytest.mark.parametrize(
    ("pattern", "change", "message"),
    [
        (r'(<edge id="[^:"]+" from="[^"]+" to=)"[^"]+"', r'\1"cav9"', "no junction has the id 'cav9'"),
        (r'(<connection [^>]*toLane=)"\d+"', r'\1"77"', "no lane has the id '.*_77'"),
        (r'(<connection [^>]*via=)"[^"]+"', r'\1":none_0"', "no lane has the id ':none_0'"),
    ],
)
def test_what_a_net_names_is_in_it(tmp_path: Path, pattern: str, change: str, message: str) -> None:
    folder = tmp_path / "mine"
    shutil.copytree(load_town("ring").net.parent, folder)
    text, count = re.subn(pattern, change, (folder / "town.net.xml").read_text(), count=1)
    assert count == 1
    (folder / "town.net.xml").write_text(text)
    with pytest.raises(InputError, match=message):
        load_town(folder)
