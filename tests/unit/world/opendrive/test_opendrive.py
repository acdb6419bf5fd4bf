"""Towns from OpenDRIVE maps: a small one of our own, and CARLA's where they are at hand."""

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import shapely
from shapely.geometry import LineString, Point, Polygon

from flcav.config import InputError, read_config
from flcav.sources.recipe import Recipe
from flcav.world.map.lanes import map_layers
from flcav.world.map.parameters import TownParameters
from flcav.world.map.roads import read_net
from flcav.world.map.surfaces import make_footprint
from flcav.world.map.town import Town, load_town
from flcav.world.opendrive.document import read_map
from flcav.world.opendrive.georeference import inverse_mercator, locate_origin
from flcav.world.opendrive.importing import ImportedTown, import_town
from flcav.world.opendrive.objects.crossings import find_crosswalks
from flcav.world.opendrive.road_surface import Road
from flcav.world.traffic.traffic import simulate

CROSS = Path(__file__).parents[3] / "data" / "cross.xodr"
REAL = Path(os.environ.get("FLCAV_REAL_DATA", Path(__file__).parents[4].parent / "shared" / "data")) / "carla_maps"
CENTRE = (458_000.0, 5_428_000.0)  # of the cross, UTM 32

pytest.importorskip("sumo", reason="eclipse-sumo (the extra 'towns') is not installed")


@pytest.fixture(scope="module")
def cross(tmp_path_factory: pytest.TempPathFactory) -> ImportedTown:
    return import_town(CROSS, tmp_path_factory.mktemp("towns") / "cross")


@pytest.fixture(scope="module", params=["Town02", "Town10HD"])
def carla(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> ImportedTown:
    path = REAL / f"{request.param}.xodr"
    if not path.exists():
        pytest.skip(f"{path} is not there: CARLA's maps are not part of the project")
    return import_town(path, tmp_path_factory.mktemp("towns") / request.param)


def test_the_cross_is_as_drawn(cross: ImportedTown) -> None:
    net = read_net(cross.town.net)
    assert len(list(net.streets)) == 8
    junction = max(net.junctions.values(), key=lambda junction: len(junction.shape))
    np.testing.assert_allclose(junction.centre, (0.0, 0.0), atol=1.0)
    for edge in net.streets:
        (lane,) = edge.lanes_of("driving")
        assert lane.width == pytest.approx(3.5)
        assert lane.speed == pytest.approx(50 / 3.6, abs=0.01)
        assert edge.lanes_of("sidewalk")[0].width == pytest.approx(2.0)  # the map has none: grown
    east = LineString([(10, 0), (70, 0)])
    sides = [LineString(edge.lanes_of("driving")[0].shape).distance(east.centroid) for edge in net.streets]
    assert sorted(sides)[:2] == pytest.approx([1.75, 1.75], abs=0.05)
    parameters = read_config(TownParameters, cross.town.net.parent / "town.yaml")
    assert parameters.source is not None
    assert parameters.source.offset_m == (-CENTRE[0], -CENTRE[1])
    assert any("sidewalks" in note for note in cross.notes)


def test_lanes_of_a_junction_are_its_connecting_roads(cross: ImportedTown) -> None:
    lanes = [lane for edge in read_net(cross.town.net).edges.values() for lane in edge.lanes_of("driving")]
    streets = shapely.STRtree([LineString(lane.shape) for lane in lanes if len(lane.shape) > 1])
    connecting = [row for row in read_map(CROSS).iterfind("road") if row.get("junction", "-1") != "-1"]
    assert len(connecting) == 12
    for row in connecting:
        road = Road(row)
        s = np.linspace(0.0, road.length, 10)
        (number,) = [int(lane.attrib["id"]) for lane in row.iter("lane") if lane.get("type") == "driving"]
        centre = road.point(s, np.array([road.lane_centre(at, number) for at in s]))[:, :2] - CENTRE
        away = streets.query_nearest(shapely.points(centre), return_distance=True, all_matches=False)[1]
        assert away.max() < 0.05, road.id


def test_the_origin_is_where_utm_says(cross: ImportedTown) -> None:
    geo = cross.town.geo
    assert (geo.latitude_deg, geo.longitude_deg) == pytest.approx((49.003466532, 8.425737458), abs=1e-8)  # by PROJ 9.4
    assert inverse_mercator(0.0, 0.0, 49.0, 8.4, 1.0) == pytest.approx((49.0, 8.4), abs=1e-12)
    metre = inverse_mercator(1.0, 1.0, 49.0, 8.4, 1.0)  # radii of curvature at 49 degrees: 6 372 031 m and 6 390 333 m
    assert metre[0] - 49.0 == pytest.approx(np.degrees(1 / 6_371_945), rel=1e-3)
    assert metre[1] - 8.4 == pytest.approx(np.degrees(1 / (6_390_333 * np.cos(np.radians(49.0)))), rel=1e-4)
    south = locate_origin("+proj=utm +zone=33 +south +datum=WGS84", 500_000.0, 10_000_000.0)
    assert south is not None
    assert (south.latitude_deg, south.longitude_deg) == pytest.approx((0.0, 15.0), abs=1e-9)
    assert locate_origin("+proj=lcc +lat_1=49", 0.0, 0.0) is None
    assert locate_origin("", 0.0, 0.0) is None


def test_a_recipe_names_the_folder(cross: ImportedTown) -> None:
    folder = str(cross.town.net.parent)
    assert Recipe(town=folder).town == folder
    again = load_town(folder)
    assert again.name == "cross"
    np.testing.assert_array_equal(again.buildings, cross.town.buildings)


def test_the_same_map_gives_the_same_town(cross: ImportedTown, tmp_path: Path) -> None:
    again = import_town(CROSS, tmp_path / "cross")
    for name in ("town.net.xml", "town.yaml"):
        assert (again.town.net.parent / name).read_bytes() == (cross.town.net.parent / name).read_bytes()


def furnished(town: Town) -> None:
    roads = shapely.union_all([Polygon(outline) for outline in town.roads])
    walks = shapely.union_all([Polygon(outline) for outline in town.sidewalks])
    assert roads.intersection(walks).area < 0.5
    for row in town.buildings:
        assert not make_footprint(*row[:5]).intersects(roads.union(walks).buffer(-0.05))
    on_foot = shapely.contains_xy(walks.buffer(0.1), *town.poles.position[:, :2].T)
    assert on_foot.all()
    assert town.poles.id.tolist() == list(range(1, len(town.poles.id) + 1))
    layers = map_layers(town)
    assert {marking.kind for marking in layers.markings} >= {"dashed"}
    assert layers.crossings


class Flow(NamedTuple):
    """How traffic got on."""

    slowest_third: float  # mean speed of vehicles in the slowest third of the time [m/s]
    gone: float  # by all but the slowest tenth of vehicles, over the time that passed [m/s]
    walking: float  # mean speed of people [m/s]


def flow(town: Town, until_s: int) -> Flow:
    """Return how traffic gets on from the first minute to `until_s`."""
    trace = simulate(town, seed=3, cavs=2, times_s=np.arange(60.0, until_s, 2.0))
    vehicle = np.char.startswith(trace.actor, "veh") | np.char.startswith(trace.actor, "cav")
    speed = np.linalg.norm(trace.velocity, axis=2)
    thirds = np.array_split(speed[:, vehicle], 3)
    gone = np.nansum(np.linalg.norm(np.diff(trace.position[:, vehicle], axis=0), axis=2), axis=0)
    walking = speed[:, np.char.startswith(trace.actor, "ped")]
    return Flow(
        slowest_third=min(float(np.nanmean(third)) for third in thirds),
        gone=float(np.percentile(gone, 10)) / (until_s - 60.0),
        walking=float(np.nanmean(walking)),
    )


def test_the_cross_is_furnished_and_its_traffic_flows(cross: ImportedTown) -> None:
    furnished(cross.town)
    assert sorted(set(cross.town.poles.kind)) == ["cross", "straight"]
    got_on = flow(cross.town, 200)
    assert got_on.slowest_third > 2.0
    assert got_on.gone > 0.8
    assert 0.5 < got_on.walking < 1.7


def test_crosswalks_and_signal_heads_of_carlas_towns(carla: ImportedTown) -> None:
    crosswalks, heads = {"Town02": (0, 24), "Town10HD": (16, 17)}[carla.town.name]
    known = find_crosswalks(read_map(REAL / f"{carla.town.name}.xodr"), (0.0, 0.0)).found
    assert (len(known), len(carla.town.parameters.signals)) == (crosswalks, heads)
    lines = [LineString(crossing.centre_line) for crossing in map_layers(carla.town).crossings]
    assert not crosswalks or len(lines) == crosswalks
    for crosswalk in known:
        assert min(line.distance(Point(crosswalk.centre)) for line in lines) < 0.2


def test_carlas_town_is_furnished(carla: ImportedTown) -> None:
    town = carla.town
    furnished(town)
    assert len(town.buildings) > 60
    assert len(town.poles.id) >= 8
    assert len(town.signs.kind) >= 10
    assert len(town.signals.link) >= 15
    lights = [junction for junction in read_net(town.net).junctions.values() if junction.kind == "traffic_light"]
    assert len(lights) == {"Town02": 8, "Town10HD": 5}[town.name]
    x_low, y_low, x_high, y_high = town.bounds
    assert x_high - x_low < 320
    if town.name == "Town02":  # its header: west -33.8, south -332.9, east 220, north -79.1, with its sidewalks
        assert (x_low, y_low, x_high, y_high) == pytest.approx((-33.8, -332.9, 220.0, -79.1), abs=5.0)


@pytest.mark.slow
def test_traffic_flows_in_carlas_town(carla: ImportedTown) -> None:
    got_on = flow(carla.town, 660)
    assert got_on.slowest_third > 2.0
    assert got_on.gone > 0.8
    assert 0.5 < got_on.walking < 1.7


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("not xml at all", "not an OpenDRIVE map"),
        ("<net/>", "its root is <net>"),
        ("<OpenDRIVE/>", "has no <road>"),
        ('<OpenDRIVE><header revMajor="2"/></OpenDRIVE>', "version '2' is not supported"),
        ('<OpenDRIVE><header revMajor="1"/></OpenDRIVE>', "has no <road>"),
        ('<OpenDRIVE><header revMajor="1" revMinor="4"/><road id="1" length="x"/></OpenDRIVE>', "OpenDRIVE"),
        (CROSS.read_text().replace('type="driving"', 'type="border"'), "no road with a lane for driving"),
        (CROSS.read_text()[:6000], "not an OpenDRIVE map"),
    ],
)
def test_bad_maps_get_one_sentence_and_leave_nothing(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "map.xodr"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        import_town(path, tmp_path / "new" / "folders" / "town")
    assert "\n" not in str(caught.value)
    assert [found.name for found in tmp_path.iterdir()] == ["map.xodr"]


def test_nothing_is_overwritten(cross: ImportedTown, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is there already"):
        import_town(CROSS, cross.town.net.parent)
    with pytest.raises(InputError, match="is a file; a town needs a folder"):
        import_town(CROSS, cross.town.net / "folder" / "town")
    with pytest.raises(InputError, match="no such file"):
        read_map(tmp_path / "none.xodr")
