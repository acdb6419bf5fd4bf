"""OpenDRIVE maps as others make them: left-hand traffic, circles, lone roads, gaps, and broken rules."""

import re
import xml.etree.ElementTree as ElementTree
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from shapely.affinity import scale
from shapely.geometry import LineString, Point, Polygon

from flcav.config import InputError
from flcav.world.map.lanes import map_layers
from flcav.world.map.parameters import GeoReference
from flcav.world.map.roads import Edge, RoadNet, read_net
from flcav.world.map.surfaces import cut_area, unite
from flcav.world.map.town import Town
from flcav.world.opendrive.document import describe_map, read_map
from flcav.world.opendrive.importing import ImportedTown, import_town
from flcav.world.opendrive.mending import mend_map
from flcav.world.opendrive.netconvert import mirror_map
from flcav.world.opendrive.objects.signs import find_signs
from flcav.world.static import TownPart, build_static_world
from flcav.world.traffic.demand import draw_tour, find_middles
from flcav.world.traffic.passages import find_driven, find_walked
from flcav.world.traffic.traffic import simulate

CROSS = Path(__file__).parents[3] / "data" / "cross.xodr"
OBJECTS = CROSS.with_name("cross_with_objects.xodr")

pytest.importorskip("sumo", reason="eclipse-sumo (the extra 'towns') is not installed")


def lines(net: RoadNet, sign: int, kind: str) -> list[LineString]:
    return [LineString(lane.shape * (1, sign)) for edge in net.edges.values() for lane in edge.lanes_of(kind)]


def write(root: ElementTree.Element, path: Path) -> Path:
    ElementTree.ElementTree(root).write(path)
    return path


@pytest.mark.slow
@pytest.mark.parametrize("name", ["one,two", "one;two", "${HOME}", "\N{GREEK SMALL LETTER LAMDA} .x", "-x"])
def test_names_of_folders_do_not_matter_to_netconvert(name: str, tmp_path: Path) -> None:
    plain, odd = tmp_path / "plain", tmp_path / name / "odd"
    for folder in (plain, odd):
        import_town(OBJECTS, folder)
    assert {path.name: path.read_bytes() for path in odd.iterdir()} == {
        path.name: path.read_bytes() for path in plain.iterdir()
    }


def test_left_hand_traffic_is_the_mirror_image(tmp_path: Path) -> None:
    root = read_map(OBJECTS)
    for geometry in root.iter("geometry"):  # the map at its origin, so that both towns are mirrored in the same axis
        geometry.set("x", str(float(geometry.attrib["x"]) - 458_000))
        geometry.set("y", str(float(geometry.attrib["y"]) - 5_428_000))
    right = import_town(write(root, tmp_path / "right.xodr"), tmp_path / "right").town
    mirror_map(root)
    left = import_town(write(root, tmp_path / "left.xodr"), tmp_path / "left").town
    one, other = read_net(right.net), read_net(left.net)
    assert (one.side, other.side) == (1, -1)
    for kind in ("driving", "sidewalk"):
        for line in lines(other, -1, kind):
            assert min(line.hausdorff_distance(known) for known in lines(one, 1, kind)) < 0.1
            start = Point(line.coords[0])
            assert min(start.distance(Point(known.coords[0])) for known in lines(one, 1, kind)) < 0.1
    for name in ("poles", "signs", "signals"):
        here, there = getattr(right, name), getattr(left, name)
        away = np.linalg.norm(here.position[:, None] - there.position * (1, -1, 1), axis=2)
        assert (away.min(axis=0) < 0.3).all(), name
    crossings = [[Polygon(row.outline) for row in map_layers(town).crossings] for town in (right, left)]
    assert len(crossings[0]) == len(crossings[1]) == 2
    for area in crossings[0]:
        mirrored = scale(area, 1, -1, origin=(0, 0))
        assert min(mirrored.symmetric_difference(other).area for other in crossings[1]) < 0.3
    assert len(left.parameters.parking) == len(right.parameters.parking) == 4
    trace = simulate(left, seed=1, cavs=1, times_s=np.array([20.0, 21.0]))
    _keeps_to_its_lanes(left, trace.position[:, np.char.startswith(trace.actor, "cav"), :2].reshape(-1, 2))


def _keeps_to_its_lanes(town: Town, at: np.ndarray) -> None:
    roads = [Polygon(outline) for outline in town.roads]
    for place in at:
        assert min(road.distance(Point(place)) for road in roads) < 0.1


def circles() -> ElementTree.Element:
    """Return a ring road whose two directions do not meet, without sidewalks."""
    lane = '<lane id="{}" type="driving"><link><predecessor id="{}"/><successor id="{}"/></link>'
    width = '<width sOffset="0" a="3" b="0" c="0" d="0"/></lane>'
    return ElementTree.fromstring(
        '<OpenDRIVE><header revMajor="1" revMinor="4"/><road id="1" length="300" junction="-1"><link>'
        '<predecessor elementType="road" elementId="1" contactPoint="end"/>'
        '<successor elementType="road" elementId="1" contactPoint="start"/></link><type s="0" type="rural"/>'
        '<planView><geometry s="0" x="0" y="0" hdg="0" length="300"><arc curvature="0.0209439510"/></geometry>'
        "</planView>"
        f'<lanes><laneSection s="0"><left>{lane.format(1, 1, 1)}{width}</left>'
        '<center><lane id="0" type="none"/></center>'
        f"<right>{lane.format(-1, -1, -1)}{width}</right></laneSection></lanes></road></OpenDRIVE>"
    )


def test_a_circle_without_junctions_is_driven(tmp_path: Path) -> None:
    imported = import_town(write(circles(), tmp_path / "ring.xodr"), tmp_path / "ring")
    assert not any("sidewalks" in note for note in imported.notes)
    net = read_net(imported.town.net)
    edges = list(net.streets)
    reach = find_driven(net, edges)
    for i, edge in enumerate(edges):
        assert {edges[j].id.startswith("-") for j in np.flatnonzero(reach[i])} == {edge.id.startswith("-")}
    trace = simulate(imported.town, seed=1, cavs=1, times_s=np.array([20.0, 30.0]))
    assert trace.present[:, trace.actor == "cav0"].all()


def test_shoulders_of_a_cars_width_are_for_parking(tmp_path: Path) -> None:
    root = circles()
    road = root.find("road/type")
    assert road is not None
    road.set("type", "town")
    for side, number, width in (("left", "2", "6"), ("right", "-2", "2.5")):
        lanes = root.find(f"road/lanes/laneSection/{side}")
        assert lanes is not None
        lane = ElementTree.SubElement(lanes, "lane", {"id": number, "type": "shoulder"})
        ElementTree.SubElement(lane, "width", {"sOffset": "0", "a": width, "b": "0", "c": "0", "d": "0"})
        if side == "left":
            lanes.insert(0, lanes[-1])
            del lanes[-1]
    net = read_net(import_town(write(root, tmp_path / "ring.xodr"), tmp_path / "ring").town.net)
    found = {(lane.kind, lane.width) for edge in net.streets for lane in edge.lanes}
    assert found == {("sidewalk", 2.0), ("driving", 3.0), ("parking", 2.5), ("shoulder", 6.0)}


def chain(*names: str) -> list[Edge]:
    """Return edges without lanes that matter, 50 m apart."""
    from flcav.world.map.roads import Lane

    return [
        Edge(name, "normal", "", "", "street", (Lane(f"{name}_0", "driving", np.full((2, 2), 50.0 * i), 3.0, 10.0),))
        for i, name in enumerate(names)
    ]


def test_tours_go_only_where_there_is_a_way() -> None:
    from flcav.world.map.roads import LaneConnection

    edges = chain("a", "b", "c", "d")
    ways = [("a", "b"), ("b", "a"), ("b", "c"), ("d", "d")]  # c is a dead end, d a circle of its own
    net = RoadNet(
        {edge.id: edge for edge in edges},
        {},
        frozenset(),
        {},
        tuple(LaneConnection(f"{start}_0", f"{end}_0", "", "s", "") for start, end in ways),
    )
    reach = find_driven(net, edges)
    np.testing.assert_array_equal(reach, np.array([[1, 1, 1, 0], [1, 1, 1, 0], [0, 0, 0, 0], [0, 0, 0, 1]], bool))
    for seed in range(20):
        tour = draw_tour(edges, find_middles(edges), reach, np.ones(4), 500.0, np.random.default_rng(seed))
        assert tour[0] != "c"  # nobody starts where nothing follows
        assert "d" not in tour or set(tour) == {"d"}
        assert all(reach["abcd".index(one), "abcd".index(other)] for one, other in pairwise(tour))
    walked = find_walked(net, edges)  # no sidewalk leads anywhere
    np.testing.assert_array_equal(walked, np.eye(4, dtype=bool))


def test_gaps_are_mended() -> None:
    root = read_map(CROSS)
    road, junction = root.findall("road")[0], root.find("junction")
    assert junction is not None
    road.append(ElementTree.fromstring('<signals><signal id="1" s="1" t="2" type=""/></signals>'))
    junction[0].attrib.pop("connectingRoad")
    junction[1].set("incomingRoad", "77")
    before = len(junction)
    notes = mend_map(root)
    assert len(junction) == before - 2
    assert root.find("road/signals/signal").get("type") == "-1"  # pyright: ignore[reportOptionalMemberAccess]
    assert len(notes) == 2


def street(*right: str, before: str = "<OpenDRIVE>", length: float = 300) -> str:
    """Return a map of one straight road, whose lanes on the right have these children beside their width."""
    width = '<width sOffset="0" a="3.5" b="0" c="0" d="0"/>'
    lanes = "".join(f'<lane id="{-i - 1}" type="driving">{width}{more}</lane>' for i, more in enumerate(right))
    return (
        f'{before}<road id="300" length="{length}" junction="-1"><type s="0" type="town"/><planView>'
        f'<geometry s="0" x="0" y="0" hdg="0" length="{length}"><line/></geometry></planView><lanes>'
        f'<laneSection s="0"><center><lane id="0"/></center><right>{lanes}</right></laneSection></lanes>'
        "</road></OpenDRIVE>"
    )


def import_text(text: str, folder: Path) -> ImportedTown:
    folder.mkdir()
    (folder / "map.xodr").write_text(text)
    return import_town(folder / "map.xodr", folder / "town")


def test_optional_content_that_netconvert_requires_is_completed(tmp_path: Path) -> None:
    """A centre lane without a type, restrictions as elements, no header, a comment before the declaration: 1.8."""
    rule = '<access sOffset="0" rule="allow"><restriction type="{}"/><restriction type="{}"/></access>'
    declared = '<!-- of a library -->\n<?xml version="1.0"?>\n<OpenDRIVE><header revMajor="1" revMinor="8"/>'
    town = import_text(street("", rule.format("bus", "bicycle"), before=declared), tmp_path / "buses").town
    (edge,) = read_net(town.net).streets
    assert [lane.kind == "driving" for lane in edge.lanes] == [False, False, True]  # cars keep out of the bus lane
    town = import_text(street("", rule.format("passengerCar", "bus")), tmp_path / "cars").town
    (edge,) = read_net(town.net).streets
    assert [lane.kind == "driving" for lane in edge.lanes] == [False, True, True]
    with pytest.raises(InputError, match="has no road with a lane for driving"):
        import_text(street(rule.format("bus", "bicycle")), tmp_path / "none")


def test_contact_points_of_connections_follow_from_the_links(tmp_path: Path) -> None:
    text = CROSS.read_text()
    whole = import_text(text, tmp_path / "whole").town
    bare = re.sub(r'(<connection [^>]*?) contactPoint="[a-z]*"', r"\1", text)
    assert bare != text
    mended = import_text(bare, tmp_path / "bare").town
    assert read_net(whole.net).connections == read_net(mended.net).connections


def test_ids_of_roads_and_junctions_may_be_any_text(tmp_path: Path) -> None:
    text = CROSS.read_text()
    whole = import_text(text, tmp_path / "whole").town
    named = re.sub(
        r'(<road [^>]*?\bid|incomingRoad|connectingRoad|"road" elementId)="(\d+)"', r'\1="A&amp;B #\2"', text
    )
    named = re.sub(r'((?:<junction [^>]*?\bid|junction|"junction" elementId)=)"10"', r'\1"J, 10"', named)
    assert named.count("A&amp;B") > 40
    assert named.count("J, 10") > 10
    town = import_text(named, tmp_path / "named").town
    for kind in ("driving", "sidewalk"):
        one, other = (lines(read_net(each.net), 1, kind) for each in (whole, town))
        assert {line.wkt for line in one} == {line.wkt for line in other}


def test_lanes_and_direct_junctions_that_lack_something_are_told() -> None:
    lanes = '<lanes><laneSection><left><lane id="1"/></left><center><lane id="0"/></center></laneSection></lanes>'
    junction = '<junction id="5" type="direct"><connection id="0" incomingRoad="1" linkedRoad="2"/></junction>'
    root = ElementTree.fromstring(f'<OpenDRIVE><road id="1">{lanes}</road><road id="2"/>{junction}</OpenDRIVE>')
    assert mend_map(root) == (
        "Connections of direct junctions: 1; their lanes are joined by where they lie.",
        "Lanes without a type, closed to traffic: 1.",
    )
    assert [lane.get("type") for lane in root.iter("lane")] == ["none", "none"]


def test_streets_that_end_at_the_edge_of_a_map_stay_busy(tmp_path: Path) -> None:
    """Vehicles leave at the end of a one-way street, others enter; CAVs drive while they record."""
    town = import_text(street("", length=2000), tmp_path / "oneway").town
    early, late = (simulate(town, seed=1, cavs=2, times_s=np.round(t0 + np.arange(100) / 10, 1)) for t0 in (60, 400))
    for trace in (early, late):
        driving = np.char.startswith(trace.actor, "cav") | np.char.startswith(trace.actor, "veh")
        assert trace.present[:, np.char.startswith(trace.actor, "cav")].all()
        busy = trace.present[:, driving].sum(axis=1) / (2 + town.parameters.vehicles)
        assert busy.min() >= 0.75  # some wait for a gap behind a bicycle
        assert busy.max() <= 1.0
    assert not set(early.actor[np.char.startswith(early.actor, "veh")]) & set(late.actor)  # all others by then
    again = simulate(town, seed=1, cavs=2, times_s=late.time_s)
    np.testing.assert_array_equal(again.position, late.position)
    with pytest.raises(InputError, match=r"drive for 141 s, and its longest way out of the 2000 m of lanes takes 120"):
        simulate(town, seed=1, cavs=1, times_s=np.arange(60.0, 200.0))


def test_short_streets_are_driven_slowly(tmp_path: Path) -> None:
    """One-way streets, on which nobody can turn: at the limit of 50 km/h one of 24 m takes less than two seconds."""
    imported = import_text(street("", length=24), tmp_path / "short")
    assert "No vehicles: the map has 24 m of lanes open to cars." in imported.notes
    for seed in (1, 2):
        for times_s in (np.array([60.0]), 60.0 + np.arange(10)):
            trace = simulate(imported.town, seed=seed, cavs=1, times_s=times_s)
            (cav,) = np.flatnonzero(np.char.startswith(trace.actor, "cav"))
            assert trace.present[:, cav].all()
            x = trace.position[:, cav, 0]
            assert (x > 0).all()
            assert (x < 24).all()
            assert (np.diff(x) > 0.5).all()
    with pytest.raises(InputError, match=r"drive for 32 s, .* of the 24 m of lanes takes 1.44 s, and 17.4 s at 1 m/s"):
        simulate(imported.town, seed=1, cavs=1, times_s=60.0 + np.arange(31))


def test_where_nobody_can_drive_is_told(tmp_path: Path) -> None:
    imported = import_text(street("", length=7), tmp_path / "short")
    with pytest.raises(
        InputError, match=r"town: a vehicle would have to drive for .* of the 7 m of lanes takes 0.42 s"
    ):
        simulate(imported.town, seed=1, cavs=1, times_s=np.array([60.0]))


def test_who_comes_and_leaves_moves_as_recorded(tmp_path: Path) -> None:
    town = import_text(street("", length=300), tmp_path / "oneway").town
    trace = simulate(town, seed=1, cavs=0, times_s=np.round(60 + np.arange(250) / 10, 1))
    others = np.char.startswith(trace.actor, "veh")
    assert 0 < trace.present[:, others].any(axis=0).sum() > trace.present[0, others].sum()  # some came later
    moved = np.diff(trace.position[..., :2], axis=0)
    expected = (trace.velocity[1:, :, :2] + trace.velocity[:-1, :, :2]) / 2 * 0.1
    away = np.linalg.norm(moved - expected, axis=2)
    assert np.nanmax(away[:, others]) < 0.3


def test_a_cav_goes_on_where_the_streets_past_poles_end(tmp_path: Path) -> None:
    """Beyond the only street with a candidate pole is a dead end to turn in."""
    lanes = '<lane id="-1" type="driving"><width sOffset="0" a="3.5" b="-0.1" c="0" d="0"/></lane>'
    back = '<left><lane id="1" type="driving"><width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane></left><center>'
    text = street("", length=100).replace("<center>", back)
    old = text[text.index('<lane id="-1"') : text.index("</right>")]
    town = import_text(text.replace(old, lanes), tmp_path / "narrowing").town
    trace = simulate(town, seed=1, cavs=1, times_s=60.0 + np.arange(3))
    assert trace.present[:, trace.actor == "cav0"].all()


@pytest.mark.parametrize("name", ["a.b", "my town", "-x", "x" * 65])
def test_names_that_no_frame_can_have_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="the folder's name must be letters, digits, - and _"):
        import_town(CROSS, tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_limits_that_are_not_finite_are_left_out() -> None:
    limits = "".join(f'<speed sOffset="0" max="{text}"/>' for text in ("nan", "inf", "13.9", "no limit"))
    lane = f'<right><lane id="-1" type="driving">{limits}</lane></right>'
    road = f'<road id="1"><type s="0">{limits}</type><lanes><laneSection>{lane}'
    root = ElementTree.fromstring(f"<OpenDRIVE>{road}</laneSection></lanes></road></OpenDRIVE>")
    assert mend_map(root) == ("Speed limits that are not finite, left out: 4.",)
    assert [row.get("max") for row in root.iter("speed")] == ["13.9", "no limit"] * 2


def test_roads_that_are_linked_across_a_country_are_refused(tmp_path: Path) -> None:
    one = street("")
    link = '<link><{} elementType="road" elementId="{}" contactPoint="{}"/></link>'
    road = one[one.index("<road") : one.index("</OpenDRIVE>")].replace("<lanes>", "{}<lanes>")
    road = re.sub(r"(<lane id=\"-1\"[^>]*>)", r"\1<link><{} id='-1'/></link>", road).replace("{}<lanes>", "<lanes>")
    first = road.format("successor").replace("<type", link.format("successor", 301, "start") + "<type")
    second = road.format("predecessor").replace("<type", link.format("predecessor", 300, "end") + "<type")
    second = second.replace('id="300"', 'id="301"').replace('x="0"', 'x="100000"')
    path = tmp_path / "map.xodr"
    path.write_text(f"<OpenDRIVE>{first}{second}</OpenDRIVE>")
    with pytest.raises(InputError, match=r"roads that are linked lie apart: .* to join 0\.\d+ km of roads .*10\.3\)"):
        import_town(path, tmp_path / "town")


def test_a_geo_reference_of_no_place_is_told(tmp_path: Path) -> None:
    path = tmp_path / "map.xodr"
    path.write_text(CROSS.read_text().replace("+zone=32", "+zone=99"))
    imported = import_town(path, tmp_path / "town")
    assert "+zone=99 +datum=WGS84 +units=m +no_defs' is none of +proj=tmerc, +proj=utm and +proj=merc on" in " ".join(
        imported.notes
    )
    assert imported.town.geo == GeoReference()


def test_streets_that_lie_a_country_apart_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "map.xodr"
    path.write_text(OBJECTS.read_text().replace('y="5428010.0000"', 'y="1000"', 1))
    with pytest.raises(InputError, match="its streets lie more than 500 km from their middle"):
        import_town(path, tmp_path / "town")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('length="60.0000"', 'length="nan"', r"road '1': <geometry> needs a number as 'length', not 'nan' .*9\.2"),
        ('length="60.0000"', 'length="6"', r"road '1' is 90 m long, and its geometry 36 m .*9\.2"),
        ('<arc curvature="0.02"/>', "", r"a <geometry> needs one of line, arc"),
        ('id="2" junction', 'id="1" junction', r"each road needs an id of its own, and two have '1' .*10\.1\)"),
        ('revMajor="1"', 'revMajor="2"', "version '2' is not supported"),
        ("<junction ", '<include file="more.xodr"/><junction ', "includes other files, which are not read"),
        ("<OpenDRIVE", "<RoadNetwork", r"root is <RoadNetwork>, expected <OpenDRIVE>: OpenDRIVE 1.8, 6\.4"),
        ("<lanes>", '<lanes><laneOffset s="x"/>', r"<laneOffset> needs a number as 's', not 'x' .*11\.4\)"),
        ("<junction ", '<junction id="10"/><junction ', r"each junction needs an id of its own.*12\.2\)"),
        ('<lane id="1" type', '<lane id="2" type', r"road '1': its left lanes are not numbered one by one .*11\.1"),
        ('a="3.5"', 'a="3500"', r"a lane is 3500 m wide"),
        ('<laneSection s="0">', '<laneSection s="">', r"<laneSection> needs a number as 's', not '' .*11\.3"),
        ('x="458010.0000"', 'x="1e12"', r"road '1' begins more than 10000 km from the origin"),
    ],
)
def test_a_broken_rule_is_told_with_its_clause(old: str, new: str, message: str, tmp_path: Path) -> None:
    text = CROSS.read_text().replace("</OpenDRIVE>", f"</{new.removeprefix('<') if 'Network' in new else 'OpenDRIVE'}>")
    assert old in text
    path = tmp_path / "map.xodr"
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=message) as caught:
        read_map(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_most_roads_say_on_which_side_traffic_keeps() -> None:
    root = read_map(CROSS)
    assert not describe_map(root).left_hand
    mirror_map(root)
    assert describe_map(root).left_hand
    mirror_map(root)
    assert ElementTree.tostring(root.findall("road")[1][2]) == ElementTree.tostring(
        read_map(CROSS).findall("road")[1][2]
    )


def test_areas_that_defeat_exact_overlay_are_snapped(monkeypatch: pytest.MonkeyPatch) -> None:
    import shapely

    exact = shapely.difference

    def fails(one, other, grid_size=None):
        if grid_size is None:
            raise shapely.GEOSException("no overlay")
        return exact(one, other, grid_size=grid_size)

    monkeypatch.setattr(shapely, "difference", fails)
    assert cut_area(shapely.box(0, 0, 2, 2), shapely.box(1, 0, 3, 2)).area == pytest.approx(2.0)
    assert unite([shapely.box(0, 0, 1, 1), shapely.box(1, 0, 2, 1)]).area == pytest.approx(2.0)


LIMITS = {  # attributes of a sign -> its kind, or why it is left out
    'value="30"': "speed_30",
    'value="60" unit="km/h"': "speed_60",
    'value="25" unit="m/s"': "speed_90",
    'value="50"': "a limit of 50 km/h, which no sign shows",
    'value="20" unit="mph"': "a limit of 32 km/h, which no sign shows",
    'value="60" unit="furlongs"': "a limit without a number",
    'value=""': "a limit without a number",
    'value="nan"': "a limit without a number",
    'value="-1"': "a limit without a number",
    'value="1e300" unit="mph"': "a limit without a number",
    'subtype="56"': "a limit without a number",
    "": "a limit without a number",
}


@pytest.mark.parametrize("attributes", LIMITS)
def test_a_limit_that_no_sign_shows_is_left_out_with_the_reason(attributes: str) -> None:
    root = read_map(CROSS)
    signal = f'<signal id="1" s="20" t="-5" type="274" orientation="+" {attributes}/>'
    next(root.iterfind("road")).append(ElementTree.fromstring(f"<signals>{signal}</signals>"))
    describe_map(root)
    signs = find_signs(root, (-458_000.0, -5_428_000.0))
    assert signs.limits
    if LIMITS[attributes].startswith("speed"):
        assert [sign.kind for sign in signs.found] == [LIMITS[attributes]]
        assert not signs.left
    else:
        assert (signs.found, dict(signs.left)) == ((), {LIMITS[attributes]: 1})


def test_a_town_whose_limits_are_left_out_has_no_invented_ones(tmp_path: Path) -> None:
    root = read_map(CROSS)
    assert "speed_60" in import_town(CROSS, tmp_path / "by_rule").town.signs.kind  # of streets of 50 km/h
    signal = '<signal id="1" s="20" t="-5" type="274" value="50" orientation="+"/>'
    next(root.iterfind("road")).append(ElementTree.fromstring(f"<signals>{signal}</signals>"))
    imported = import_town(write(root, tmp_path / "map.xodr"), tmp_path / "town")
    assert "Signs of the map taken over: 0; left out: 1 (a limit of 50 km/h, which no sign shows)." in imported.notes
    assert not any(kind.startswith("speed") for kind in imported.town.signs.kind)


def test_signs_and_poles_of_the_map_stand_where_it_says(tmp_path: Path) -> None:
    root = read_map(CROSS)
    for road in root.findall("road")[:1]:
        road.append(
            ElementTree.fromstring(
                '<signals><signal id="1" s="20" t="-5" type="206" orientation="-" zOffset="1.9" height="0.8"/>'
                '<signal id="2" s="30" t="-5" type="274" value="60" orientation="+"/>'
                '<signal id="3" s="30" t="-5" type="274" value="many"/>'
                '<signal id="4" s="400" t="0" type="206"/><signal id="5" s="9" t="0" type="306"/>'
                '<signal id="6" s="9" t="0" type="1000001" dynamic="yes"/>'
                '<signal id="7" s="9" t="0" type="294"/></signals>'
            )
        )
        road.append(
            ElementTree.fromstring(
                '<objects><object id="1" type="pole" s="10" t="6" height="3"><repeat s="10" length="20" distance="10" '
                'tStart="6" tEnd="8"/></object><object id="2" type="pole" s="1" t="1"/></objects>'
            )
        )
    imported = import_town(write(root, tmp_path / "map.xodr"), tmp_path / "town")
    town = imported.town
    told = "left out: 1 (a limit without a number); left out: 1 (no place on the road); left out: 1 (of the type '306')"
    assert f"Signs of the map taken over: 2; {told}." in imported.notes
    assert "Poles of the map taken over: 3; left out: 1 (no height of a pole)." in imported.notes
    assert sorted(town.signs.kind) == ["speed_60", "stop"]
    stop = town.signs.kind.index("stop")
    np.testing.assert_allclose(town.signs.position[stop], (30.0, -5.0, 2.3), atol=1e-3)  # the road begins at (10, 0)
    np.testing.assert_allclose(np.cos(town.signs.yaw[[stop, 1 - stop]]), (1, -1), atol=1e-6)
    np.testing.assert_allclose(town.posts, ((20, 6, 3), (30, 7, 3), (40, 8, 3)), atol=1e-3)
    poles = build_static_world(town).part == TownPart.POLE
    assert poles.any()
