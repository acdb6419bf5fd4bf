"""Roads of OpenDRIVE maps that contradict themselves: gaps, elements out of order, widths that are none."""

import copy
import os
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
from shapely.geometry import LineString, Point

from flcav.config import InputError
from flcav.world.map.roads import RoadNet, read_net
from flcav.world.opendrive.document import describe_map, read_map
from flcav.world.opendrive.importing import ImportedTown, import_town
from flcav.world.opendrive.mending import MOST_TOLD, mend_roads
from flcav.world.opendrive.reference_line import ReferenceLine, list_pieces, shorten_geometry
from flcav.world.opendrive.road_surface import Road

pytest.importorskip("sumo", reason="eclipse-sumo (the extra 'towns') is not installed")

REAL = Path(os.environ.get("FLCAV_REAL_DATA", Path(__file__).parents[4].parent / "shared" / "data")) / "found4" / "maps"
LINE = "<line/>"


def geometry(s: float, x: float, length: float, *, y: float = 0.0, hdg: float = 0.0, shape: str = LINE) -> str:
    return f'<geometry s="{s}" x="{x}" y="{y}" hdg="{hdg}" length="{length}">{shape}</geometry>'


def lane(number: int, *widths: str, kind: str = "driving") -> str:
    return f'<lane id="{number}" type="{kind}">{"".join(widths)}</lane>'


def width(s: float, a: float, b: float = 0.0, c: float = 0.0, *, tag: str = "width") -> str:
    return f'<{tag} sOffset="{s}" a="{a}" b="{b}" c="{c}" d="0"/>'


def section(right: str, left: str = "", s: float = 0.0) -> str:
    centre = '<center><lane id="0" type="none"/></center>'
    return f'<laneSection s="{s}"><left>{left}</left>{centre}<right>{right}</right></laneSection>'


TWO_WAY = section(lane(-1, width(0, 3.5)), lane(1, width(0, 3.5)))


def road(view: str, *, lanes: str = TWO_WAY, length: float = 100.0, more: str = "") -> str:
    view = f"<planView>{view}</planView>{more}<lanes>{lanes}</lanes>"
    return (
        '<OpenDRIVE><header revMajor="1" revMinor="6"/>'
        f'<road id="r1" length="{length}" junction="-1"><type s="0" type="town"/>{view}</road></OpenDRIVE>'
    )


def read(text: str, folder: Path) -> ElementTree.Element:
    path = folder / "map.xodr"
    path.write_text(text)
    return read_map(path)


def mend(text: str, folder: Path) -> tuple[ElementTree.Element, tuple[str, ...]]:
    root = read(text, folder)
    return root, mend_roads(root)


def import_text(text: str, folder: Path) -> tuple[ImportedTown, RoadNet]:
    (folder / "map.xodr").write_text(text)
    imported = import_town(folder / "map.xodr", folder / "town")
    return imported, read_net(imported.town.net)


def place(root: ElementTree.Element, s: np.ndarray) -> np.ndarray:
    """Return x, y, heading (N, 3) of the first road of a mended map."""
    return ReferenceLine(root[1]).at(s)


HALVES = {  # halves of a street of 100 m along the x axis that do not meet -> largest gap, along s or in plan
    "short": (geometry(0, 0, 49.6) + geometry(50, 50, 50), 0.4),
    "long": (geometry(0, 0, 50.4) + geometry(50, 50, 50), 0.4),
    "back": (geometry(0, 0, 50) + geometry(50, 49.5, 50), 0.5),
    "aside": (geometry(0, 0, 50) + geometry(50, 50, 50, y=0.9), 0.9),
    "jumps in s": (geometry(0, 0, 49.5) + geometry(50, 49.5, 50), 0.5),
}


@pytest.mark.parametrize("name", HALVES)
def test_a_gap_of_up_to_a_metre_is_closed_and_told(name: str, tmp_path: Path) -> None:
    view, gap_m = HALVES[name]
    root, notes = mend(road(view), tmp_path)
    told = f"Road 'r1': at s = 50 m its geometry begins {gap_m:.2g} m from where the one before it ends: joined."
    assert notes == (told,)
    s = np.linspace(0.0, 100.0, 2001)
    line = place(root, s)
    steps = np.hypot(*np.diff(line[:, :2], axis=0).T)
    assert steps.max() < 0.06  # of 0.05: no jump
    assert (np.diff(line[:, 0]) > 0).all()  # and never back
    untouched = 50 - 10 * gap_m
    before = s < untouched - 0.1
    np.testing.assert_allclose(line[before, :2], np.stack((s, 0 * s), axis=1)[before], atol=1e-9)
    first = root[1].find("planView")[-1]  # pyright: ignore[reportOptionalSubscript]
    x, y = float(first.attrib["x"]), float(first.attrib["y"])
    np.testing.assert_allclose(line[s >= 50, :2], np.stack((x + s - 50, y + 0 * s), axis=1)[s >= 50], atol=1e-9)


@pytest.mark.parametrize(
    ("view", "message"),
    [
        (geometry(0, 0, 101) + geometry(50, 50, 50), r"'r1' is 100 m long, and its geometry 151 m"),
        (geometry(0, 0, 51.5) + geometry(50, 50, 49.5), r"at s = 50 m begins 1.5 m from where the one before it ends"),
        (geometry(0, 0, 50) + geometry(50, 55, 50, y=4), r"at s = 50 m begins 6.4 m from where the one before it ends"),
        (geometry(0, 0, 50) + geometry(50, 50, 50, hdg=1.57), r"at s = 50 m turns by 90° at once, at most 60° .*9\.2"),
        (geometry(50, 50, 50, y=2) + geometry(0, 0, 50), r"at s = 50 m begins 2 m from where the one before"),
        (geometry(2, 0, 100), r"at s = 2 m begins 2 m from its beginning"),
        (geometry(0, 0, 0), r"is 100 m long, and its geometry 0 m"),
        (geometry(0, 0, -100), r"a <geometry> has the length -100 m"),
        ("", r"road 'r1' has no <geometry>"),
    ],
)
def test_geometry_that_does_not_follow_on_is_refused(view: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read(road(view), tmp_path)
    assert "\n" not in str(caught.value)


def test_a_kink_is_told(tmp_path: Path) -> None:
    view = geometry(0, 0, 50) + geometry(50, 50, 50, hdg=0.5)
    _, notes = mend(road(view), tmp_path)
    assert notes == ("Road 'r1': at s = 50 m its geometry turns by 29° at once.",)
    assert mend(road(geometry(0, 0, 50) + geometry(50, 50.01, 50, hdg=0.05)), tmp_path)[1] == ()


def test_objects_and_lanes_of_a_mended_road_are_where_the_file_says(tmp_path: Path) -> None:
    pole = '<objects><object type="pole" id="8" s="{}" t="7" height="6"/></objects>'
    text = road(HALVES["short"][0]).replace("</road>", pole.format(80) + "</road>")
    imported, net = import_text(text, tmp_path)
    np.testing.assert_allclose(imported.town.posts, [(80, 7, 6)], atol=1e-3)
    driven = [LineString(lane.shape) for edge in net.streets for lane in edge.lanes_of("driving")]
    for x in np.linspace(1.0, 99.0, 40):
        for y in (-1.75, 1.75):
            assert min(line.distance(Point(x, y)) for line in driven) < 0.02
    assert any("at s = 50 m" in note for note in imported.notes)


def integrate(curvature, s: np.ndarray) -> np.ndarray:
    """Return x, y (N, 2) of a curve from the origin along x, by the midpoint rule."""
    fine = np.linspace(0.0, s[-1], 20_001)
    middle = (fine[1:] + fine[:-1]) / 2
    step = fine[1]
    turn = np.cumsum(curvature(middle)) * step
    heading = np.concatenate(([0.0], turn))[:-1] + curvature(middle) * step / 2
    at = np.concatenate(([[0.0, 0.0]], np.cumsum(np.stack((np.cos(heading), np.sin(heading)), axis=1) * step, axis=0)))
    return np.stack([np.interp(s, fine, column) for column in at.T], axis=1)


@pytest.mark.parametrize("pieces", [1, 2])
def test_a_spiral_cut_short_goes_the_same_way(pieces: int) -> None:
    row = ElementTree.fromstring(geometry(0, 0, 80, shape='<spiral curvStart="-0.01" curvEnd="0.04"/>'))
    lengths = (60.0, 33.0)[:pieces]
    for each in lengths:
        shorten_geometry(row, each)
    length = lengths[-1]
    s = np.linspace(0.0, length, 50)
    np.testing.assert_allclose(
        list_pieces([row])[0].at(s)[:, :2], integrate(lambda at: -0.01 + 0.05 * at / 80, s), atol=1e-4
    )


U, V = (1.0, 2.0, -0.3), (0.0, 0.4, 0.1)  # coefficients of p, p^2, p^3 where p goes to 1, as shares of the length


def cubic(length: float, said: str, by: str) -> str:
    """Return a <paramPoly3> whose parameter goes to 1, or to its length; `said` is its pRange."""
    scale = 1.0 if by == "normalized" else 1.0 / length
    rows = {
        f"{name}{axis}": value * LENGTH * scale**i
        for axis, own in (("U", U), ("V", V))
        for i, (name, value) in enumerate(zip("bcd", own), 1)
    }
    values = " ".join(f'{name}="{value}"' for name, value in rows.items())
    return f'<paramPoly3 aU="0" aV="0" {values} {said}/>'


LENGTH = 40.0


def test_cubics_by_arc_length_and_by_share_are_the_same_curve(tmp_path: Path) -> None:
    p = np.linspace(0.0, 1.0, 100_001)
    curve = LENGTH * np.stack([np.polyval([*own[::-1], 0.0], p) for own in (U, V)], axis=1)
    length = float(np.hypot(*np.diff(curve, axis=0).T).sum())
    for said, by in (
        ('pRange="normalized"', "normalized"),
        ('pRange="arcLength"', "arcLength"),
        ("", "normalized"),
        ("", "arcLength"),
        ('pRange="arclength"', "arcLength"),
        ('pRange="normalized"', "arcLength"),
        ('pRange="arcLength"', "normalized"),
    ):
        view = geometry(0, 0, length, shape=cubic(length, said, by))
        root = read(road(view, length=length), tmp_path)
        mend_roads(root)
        np.testing.assert_allclose(place(root, p[::10_000] * length)[:, :2], curve[::10_000], atol=1e-6)
        shape = root.find(".//paramPoly3")
        assert shape is not None
        assert shape.get("pRange") == by  # so that netconvert draws the same
        row = root.find(".//geometry")
        assert row is not None
        shorten_geometry(row, 0.7 * length)
        np.testing.assert_allclose(
            list_pieces([row])[0].at(np.array([0.3, 0.7]) * length)[:, :2], curve[[30_000, 70_000]], atol=1e-6
        )


def test_a_cubic_of_another_length_is_refused(tmp_path: Path) -> None:
    shape = '<paramPoly3 aU="0" bU="60" cU="0" dU="0" aV="0" bV="0" cV="0" dV="0"/>'
    with pytest.raises(InputError, match=r"its <paramPoly3> at s = 0 m is 60 m long, and says 100 m .*9\.2"):
        read(road(geometry(0, 0, 100, shape=shape)), tmp_path)


@pytest.mark.parametrize(
    "shape",
    ['<arc curvature="0"/>', '<spiral curvStart="0.01" curvEnd="0.01"/>', '<spiral curvStart="0" curvEnd="0"/>'],
)
def test_arcs_of_no_curvature_and_spirals_of_one_are_driven(shape: str, tmp_path: Path) -> None:
    text = road(geometry(0, 0, 90, shape=shape), length=90).replace(' junction="-1"', "")
    _, net = import_text(text, tmp_path)
    bend = 0.01 if "0.01" in shape else 0.0
    middle = integrate(lambda at: bend + 0 * at, np.linspace(0.0, 90.0, 10))
    driven = [LineString(lane.shape) for edge in net.streets for lane in edge.lanes_of("driving")]
    assert len(driven) == 2
    for point in middle[1:-1]:
        assert [line.distance(Point(point)) for line in driven] == pytest.approx([1.75, 1.75], abs=0.03)


def test_a_cubic_by_arc_length_without_a_word_is_driven(tmp_path: Path) -> None:
    length = 60.0
    shape = '<paramPoly3 aU="0" bU="1" cU="0" dU="0" aV="0" bV="0" cV="0" dV="0"/>'
    _, net = import_text(road(geometry(0, 0, length, shape=shape), length=length), tmp_path)
    assert [LineString(edge.lanes_of("driving")[0].shape).length for edge in net.streets] == pytest.approx(
        [60, 60], abs=0.1
    )


PROFILES = (
    '<elevationProfile><elevation s="0" a="0" b="0" c="0" d="0"/><elevation s="60" a="1" b="0" c="0" d="0"/>'
    '</elevationProfile><lateralProfile><superelevation s="0" a="0" b="0" c="0" d="0"/>'
    '<superelevation s="50" a="0.02" b="0" c="0" d="0"/></lateralProfile>'
)


def test_everything_along_a_road_is_sorted(tmp_path: Path) -> None:
    offsets = '<laneOffset s="0" a="0" b="0" c="0" d="0"/><laneOffset s="60" a="2" b="0" c="0" d="0"/>'
    marks = '<roadMark sOffset="0" type="solid"/><roadMark sOffset="5" type="broken"/>'
    limits = '<speed sOffset="0" max="10"/><speed sOffset="40" max="5"/>'
    right = lane(-1, width(0, 3), width(30, 5), marks, limits) + lane(-2, width(0, 3))
    lanes = offsets + section(right, lane(1, width(0, 3))) + section(lane(-1, width(0, 4)), s=70)
    text = road(geometry(0, 0, 50) + geometry(50, 50, 50), lanes=lanes, more=PROFILES)
    sorted_root, notes = mend(text, tmp_path)
    assert notes == ()
    root = ElementTree.fromstring(text)
    for parent in [*root.iter()]:
        if parent.tag in ("planView", "elevationProfile", "lateralProfile", "lanes", "left", "right", "lane"):
            parent[:] = parent[::-1]
    (tmp_path / "other.xodr").write_text(ElementTree.tostring(root, encoding="unicode"))
    root = read_map(tmp_path / "other.xodr")
    notes = mend_roads(root)
    assert any("'r1': its <laneOffset> elements were not in the order of s" in note for note in notes)
    assert any("'r1', lane -1: its <width> elements were not" in note for note in notes)
    one, other = (Road(each[1]) for each in (sorted_root, root))
    s = np.linspace(0.0, 100.0, 101)
    for t in (-2.0, 0.0, 1.0):
        np.testing.assert_allclose(one.point(s, t + 0 * s), other.point(s, t + 0 * s))
    assert [one.borders(at) for at in s] == [other.borders(at) for at in s]
    for name in ("roadMark", "speed", "lane", "laneSection", "geometry", "elevation", "superelevation"):
        assert [row.attrib for row in root.iter(name)] == [row.attrib for row in sorted_root.iter(name)], name


def test_what_has_no_length_is_left_out(tmp_path: Path) -> None:
    view = geometry(0, 0, 50) + geometry(50, 9, 0, hdg=1.6) + geometry(50, 50, 50)
    lanes = (
        section(lane(-1, width(0, 3))) + section(lane(-1, width(0, 2)), s=40) + section(lane(-1, width(0, 4)), s=40.0)
    )
    root, notes = mend(road(view, lanes=lanes), tmp_path)
    assert notes == (
        "Road 'r1': left out, the <geometry> of no length at s = 50 m.",
        "Road 'r1': left out, the <laneSection> of no length at s = 40 m.",
    )
    np.testing.assert_allclose(place(root, np.array([50.0, 75.0]))[:, :2], [(50, 0), (75, 0)])
    assert [Road(root[1]).borders(s)[-1] for s in (39.0, 41.0)] == [-3, -4]


DIP = (3.0, -0.12, 0.0011)  # a + b s + c s^2: below zero from 38.8 m to 70.3 m


def test_a_width_below_zero_is_cut_at_zero(tmp_path: Path) -> None:
    lanes = section(lane(-1, width(0, 3.5)) + lane(-2, width(0, *DIP)), lane(1, width(0, 3.5)))
    root, notes = mend(road(geometry(0, 0, 100), lanes=lanes), tmp_path)
    assert notes == ("Road 'r1', lane -2: its width falls to -0.27 m: cut at zero.",)
    s = np.linspace(0.0, 100.0, 401)[:-1]
    expected = np.maximum(np.polyval(DIP[::-1], s), 0.0)
    starts = np.array([float(row.attrib["sOffset"]) for row in root.findall(".//lane[@id='-2']/width")])
    rows = [[float(row.attrib[name]) for name in "abcd"] for row in root.findall(".//lane[@id='-2']/width")]
    own = np.searchsorted(starts, s, side="right") - 1
    found = [np.polyval(rows[i][::-1], at - starts[i]) for i, at in zip(own, s)]
    np.testing.assert_allclose(found, expected, atol=1e-9)
    roots = np.sort(np.roots(DIP[::-1]))
    assert {float(round(start, 6)) for start in starts} >= {round(float(at), 6) for at in roots}


def test_a_lane_that_narrows_to_nothing_ends_there_for_traffic(tmp_path: Path) -> None:
    lanes = section(lane(-1, width(0, 3.5)) + lane(-2, width(0, *DIP)), lane(1, width(0, 3.5)))
    _, net = import_text(road(geometry(0, 0, 100), lanes=lanes), tmp_path)
    outer = [
        lane.shape[:, 0]
        for edge in net.streets
        for lane in edge.lanes_of("driving")
        if lane.shape[0, 1] < -4 and lane.shape[0, 0] < lane.shape[-1, 0]
    ]
    (along,) = outer
    assert along.max() < 16  # wider than 1.8 m up to s = 11.2 m; netconvert rounds the corner


@pytest.mark.parametrize("widths", [(), (width(0, -3.5),), (width(0, 0.0),), (width(0, 0.0), width(50, -1))])
def test_a_driving_lane_without_a_positive_width_is_left_out(widths: tuple[str, ...], tmp_path: Path) -> None:
    lanes = section(lane(-1, width(0, 3)) + lane(-2, *widths) + lane(-3, width(0, 4)), lane(1, width(0, 3.5)))
    imported, net = import_text(road(geometry(0, 0, 100), lanes=lanes), tmp_path)
    assert "Road 'r1', lane -2: left out, it has no positive width." in imported.notes
    right = [(lane.width, float(lane.shape[0, 1])) for edge in net.streets for lane in edge.lanes_of("driving")]
    np.testing.assert_allclose(sorted(right), [(3.0, -1.5), (3.5, 1.75), (4.0, -5.0)], atol=0.02)


def test_borders_and_lanes_in_any_order_are_drawn(tmp_path: Path) -> None:
    right = lane(-2, width(0, -7, tag="border")) + lane(-1, width(0, -3, tag="border"))
    left = lane(1, width(0, 2.5)) + lane(2, width(0, 6.5, tag="border"))
    _, net = import_text(road(geometry(0, 0, 100), lanes=section(right, left)), tmp_path)
    found = [(lane.width, float(lane.shape[0, 1])) for edge in net.streets for lane in edge.lanes_of("driving")]
    np.testing.assert_allclose(sorted(found), [(2.5, 1.25), (3.0, -1.5), (4.0, -5.0), (4.0, 4.5)], atol=0.02)


@pytest.mark.parametrize(
    ("limit", "note"),
    [
        ('max="50" unit="furlong"', "left out, its speed limit of 50 'furlong' (known units: m/s, km/h, mph)."),
        ('max="130"', "left out, its speed limit of 130 m/s, which is none."),
        ('max="-5" unit="km/h"', "left out, its speed limit of -5 km/h, which is none."),
        ('max="50" unit="mph"', ""),
        ('max="no limit"', ""),
    ],
)
def test_a_limit_that_is_none_is_told(limit: str, note: str, tmp_path: Path) -> None:
    text = road(geometry(0, 0, 100)).replace('type="town"/>', f'type="town"><speed {limit}/></type>')
    root, notes = mend(text, tmp_path)
    assert notes == ((f"Road 'r1': {note}",) if note else ())
    assert describe_map(root).roads["r1"].speed == (pytest.approx(22.352) if "mph" in limit else None)
    own = lane(-1, width(0, 3.5), f'<speed sOffset="0" {limit}/>')
    _, notes = mend(road(geometry(0, 0, 100), lanes=section(own)), tmp_path)
    assert notes == ((f"Road 'r1', lane -1: {note}",) if note else ())


def test_of_many_changes_some_are_told(tmp_path: Path) -> None:
    text = road(geometry(0, 0, 100), lanes=section(lane(-1) + lane(-2, width(0, 3.5))))
    one = re.search("<road.*</road>", text)
    assert one is not None
    many = "".join(one[0].replace('id="r1"', f'id="{i}"') for i in range(20))
    _, notes = mend(text.replace(one[0], many), tmp_path)
    assert len(notes) == MOST_TOLD + 1
    assert notes[-1] == f"... and {20 - MOST_TOLD} more changes like the last one."


def test_mended_maps_are_not_mended_again(tmp_path: Path) -> None:
    lanes = section(lane(-1, width(30, 3), width(0, 3.5)) + lane(-2, width(0, *DIP)), lane(1))
    root, notes = mend(road(HALVES["short"][0], lanes=lanes), tmp_path)
    assert len(notes) == 4
    again = copy.deepcopy(root)
    assert mend_roads(again) == ("Road 'r1', lane 1: left out, it has no positive width.",)
    assert ElementTree.tostring(again) == ElementTree.tostring(root)


@pytest.mark.skipif(not REAL.exists(), reason="the maps are not part of the project")
@pytest.mark.parametrize(
    ("name", "told"),
    {
        "big_obj": "at s = 50 m begins 51 m from",
        "gap_xy": "at s = 50 m begins 6.4 m from",
        "gap_s": "at s = 50 m its geometry begins 0.4 m from",
        "overlap_b": "at s = 50 m its geometry begins 0.4 m from",
        "negwidth": "lane -2: left out",
        "nowidth": "lane -1: left out",
        "polyneg2": "lane -2: its width falls to -0.27 m",
        "laneoffset_unsorted": "<laneOffset> elements were not in the order",
        "unsorted": "lane -1: its <width> elements were not in the order",
        "zerogeom": "<geometry> of no length at s = 50 m",
        "speed_bad": "50 'furlong'",
    }.items(),
)
def test_maps_that_were_wrong_in_silence(name: str, told: str) -> None:
    try:
        said = " ".join(mend_roads(read_map(REAL / f"{name}.xodr")))
    except InputError as error:
        said = str(error)
    assert told in said
