"""Bridges of OpenDRIVE maps: decks, what drives on them and below them, and what they look like."""

import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from shapely import contains_xy

from flcav.config import InputError
from flcav.world.map.relief import Deck, Relief
from flcav.world.map.roads import read_net
from flcav.world.map.signals import Signals
from flcav.world.map.town import Poles, Signs, Town, lift_town
from flcav.world.materials import Material
from flcav.world.opendrive.heights import BRIDGE_M, Borders, find_bridges, sample_heights
from flcav.world.opendrive.importing import import_town
from flcav.world.opendrive.streets import SIDEWALK_M
from flcav.world.scene import Scene
from flcav.world.static import DECK_M, ROOM_M, TownPart, build_static_world
from flcav.world.trace import Trace
from flcav.world.traffic.bridges import find_footing
from flcav.world.traffic.traffic import simulate

HALF_M, RISE = 80.0, 0.075  # of two streets: from where they cross to their ends, and the slope of the upper one


def street(name: str, shape: str, length: float, links: str = "||", profile: str = "") -> str:
    """Return a road with a lane in each direction; `links`: of the road, of lane 1, of lane -1."""
    own, *lanes = links.split("|")
    left, right = (
        f'<lane id="{number}" type="driving"><link>{link}</link><width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane>'
        for number, link in zip((1, -1), lanes)
    )
    return (
        f'<road id="{name}" length="{length}" junction="-1"><link>{own}</link><type s="0" type="town"/><planView>'
        f'<geometry s="0" length="{length}" {shape}</geometry></planView>{profile}<lanes><laneSection s="0"><left>'
        f'{left}</left><center><lane id="0" type="none"/></center><right>{right}</right></laneSection></lanes></road>'
    )


def crossing() -> ElementTree.Element:
    """Return a street along x at height 0, one along y that passes 6 m above it, and a bow between their ends.

    None has a sidewalk, which the import therefore adds to all of them.
    """
    profile = (
        f'<elevationProfile><elevation s="0" a="0" b="{RISE}" c="0" d="0"/>'
        f'<elevation s="{HALF_M}" a="{RISE * HALF_M}" b="{-RISE}" c="0" d="0"/></elevationProfile>'
    )

    def link(end: str, road: str, contact: str, lanes: tuple[int, int]) -> str:
        own = f'<{end} elementType="road" elementId="{road}" contactPoint="{contact}"/>'
        return "|".join((own, *(f'<{end} id="{lane}"/>' for lane in lanes)))

    before, after = link("predecessor", "1", "end", (1, -1)), link("successor", "2", "end", (-1, 1))
    bow = "|".join(one + other for one, other in zip(before.split("|"), after.split("|")))
    lower = street("1", f'x="{-HALF_M}" y="0" hdg="0"><line/>', 2 * HALF_M, link("successor", "3", "start", (1, -1)))
    upper = street(
        "2",
        f'x="0" y="{-HALF_M}" hdg="{np.pi / 2}"><line/>',
        2 * HALF_M,
        link("successor", "3", "end", (-1, 1)),
        profile,
    )
    arc = street("3", f'x="{HALF_M}" y="0" hdg="0"><arc curvature="{1 / HALF_M}"/>', 1.5 * np.pi * HALF_M, bow)
    return ElementTree.fromstring(f'<OpenDRIVE><header revMajor="1" revMinor="6"/>{lower}{upper}{arc}</OpenDRIVE>')


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Town:
    pytest.importorskip("sumo", reason="eclipse-sumo (the extra 'towns') is not installed")
    folder = tmp_path_factory.mktemp("bridge")
    ElementTree.ElementTree(crossing()).write(folder / "map.xodr")
    imported = import_town(folder / "map.xodr", folder / "town")
    assert "Bridges, on which roads pass above others: 1." in imported.notes
    return imported.town


@pytest.fixture(scope="module")
def trace(town: Town) -> Trace:
    return simulate(town, seed=3, cavs=4, times_s=np.arange(20.0, 50.0, 0.5).round(1))


def deck_of(town: Town) -> Deck:
    assert town.relief is not None
    (deck,) = town.relief.decks
    return deck


def test_actors_are_on_the_deck_or_below_it_by_their_street(town: Town, trace: Trace) -> None:
    deck = deck_of(town)
    x, y, z = np.moveaxis(trace.position, 2, 0)
    inside = contains_xy(deck.outline.buffer(-1.0), x, y)
    assert trace.tilt is not None
    vehicle = inside & (trace.category != "pedestrian")
    crossing = np.abs(np.sin(trace.yaw)) > 0.7  # along y
    assert (vehicle & crossing).sum() >= 5
    assert (vehicle & ~crossing).sum() >= 5
    on = vehicle & crossing
    np.testing.assert_allclose(z[on], RISE * (HALF_M - np.abs(y[on])), atol=0.2)
    np.testing.assert_allclose(z[vehicle & ~crossing], 0.0, atol=0.05)
    np.testing.assert_allclose(np.abs(trace.tilt[..., 0][on & (np.abs(y) > 4)]), np.arctan(RISE), atol=0.02)
    way = np.abs(np.diff(z, axis=0)[trace.present[1:] & trace.present[:-1]])
    assert way.max() < 1.0  # in half a second: nobody jumps from one street to the other


def test_pedestrians_on_added_sidewalks_are_on_the_deck_or_below_it(town: Town) -> None:
    assert town.relief is not None
    assert all(edge.lanes_of("sidewalk") for edge in read_net(town.net).streets)
    along, beside = np.linspace(-20.0, 20.0, 81), np.full(81, 3.5 + SIDEWALK_M / 2)
    walks = [(side * beside, along) for side in (1, -1)] + [(along, side * beside) for side in (1, -1)]
    centre = np.stack([np.column_stack(walk) for walk in walks], axis=1)  # two above, two below
    yaw = np.broadcast_to([np.pi / 2, -np.pi / 2, 0.0, np.pi], centre.shape[:2])
    heights = find_footing(town.relief, town.net, centre, yaw)(*np.moveaxis(centre, 2, 0))
    near = np.abs(along) < 7
    top = RISE * (HALF_M - np.abs(along[near]))
    np.testing.assert_allclose(heights[near, :2], np.stack((top, top), axis=1), atol=0.05)
    np.testing.assert_allclose(heights[:, 2:], 0.0, atol=0.05)


def test_who_turns_aside_below_a_deck_stays_below(town: Town) -> None:
    assert town.relief is not None
    centre = np.column_stack((np.linspace(-30.0, 30.0, 61), np.full(61, -1.75)))[:, None]
    yaw = np.where(np.abs(centre[..., 0]) < 1.5, np.pi / 3, 0.0)  # for a moment along the lanes of the deck
    heights = find_footing(town.relief, town.net, centre, yaw)(centre[..., 0], centre[..., 1])
    np.testing.assert_allclose(heights, 0.0, atol=0.05)


def test_who_waits_beside_a_deck_may_pass_over_it(town: Town) -> None:
    assert town.relief is not None
    passing = np.column_stack((np.full(17, -1.75), np.arange(8.0, -9.0, -1.0)))
    centre = np.concatenate((np.full((100, 2), (-6.0, 8.5)), passing))[:, None]
    yaw = np.repeat([0.0, -np.pi / 2], (100, 17))[:, None]
    heights = find_footing(town.relief, town.net, centre, yaw)(centre[..., 0], centre[..., 1])
    top = RISE * (HALF_M - np.abs(passing[1:-1, 1]))
    np.testing.assert_allclose(heights[101:-1, 0], top, atol=0.05)


def test_points_are_above_the_deck_or_above_the_ground_below_it(town: Town) -> None:
    assert town.relief is not None
    top = RISE * (HALF_M - 1.0)
    points = np.array([(0.0, -1.0, top + z) for z in (1.5, -0.02, 0.0)] + [(0.0, -1.0, 2.0), (0.0, -1.0, 0.0)])
    np.testing.assert_allclose(town.relief.above(points), (1.5, -0.02, 0.0, 2.0, 0.0), atol=0.01)


def test_rays_meet_the_deck_from_above_and_from_below(town: Town, trace: Trace) -> None:
    scene, down = Scene(town, trace), np.array([[0.0, 0.0, -1.0]], np.float32)
    pose = np.eye(4)
    pose[:3, 3] = 0.5, 2.0, 20.0
    (fall,) = scene.cast(pose, down).distance
    pose[2, 3] = 2.5
    (rise,) = scene.cast(pose, -down).distance
    top = RISE * (HALF_M - 2.0)
    assert 20.0 - fall == pytest.approx(top, abs=0.05) or fall < 20.0 - top  # or what drives there
    assert 2.5 + rise == pytest.approx(top - DECK_M[1], abs=0.05)
    world = build_static_world(town)
    assert set(world.mesh.material[world.part == TownPart.DECK]) == {Material.ROAD, Material.WALL}


def test_a_low_deck_is_thinner(town: Town) -> None:
    assert town.relief is not None
    for lowered, thickness in ((1.0, RISE * HALF_M - 1.0 - ROOM_M), (3.0, DECK_M[0])):
        sections = [section - (0.0, 0.0, lowered) for section in deck_of(town).sections]
        low = replace(town, relief=Relief(town.relief.points, [Deck(sections)]))
        world = build_static_world(low)
        under = world.mesh.vertices[
            world.mesh.faces[(world.part == TownPart.DECK) & (world.mesh.material == Material.WALL)]
        ]
        middle = under[np.abs(under[..., 1]) < 0.3]
        assert middle[:, 2].min() == pytest.approx(RISE * HALF_M - lowered - thickness, abs=0.05)


def test_what_stands_on_or_under_a_deck_is_left_out(town: Town) -> None:
    assert town.relief is not None
    area = deck_of(town).outline.buffer(1.0)
    assert not contains_xy(area, *town.lamps[:, :2].T).any()
    near, far = (0.0, 5.0), (30.0, 30.0)
    feet = np.array((near, far))
    heads = np.column_stack((feet, (3.0, 3.0)))
    hedge = np.array([(0.0, 16.0, np.pi / 2, 20.0, 0.8, 1.0), (30.0, 16.0, np.pi / 2, 20.0, 0.8, 1.0)])
    filled = replace(
        town,
        relief=None,
        trees=np.column_stack((feet, (5.0, 5.0), (1.0, 1.0))),
        clutter=(("hedgerow", hedge),),
        lamps=heads,
        posts=heads,
        poles=Poles(np.array((1, 2)), heads, np.zeros(2), ("straight", "straight")),
        signs=Signs(heads, np.zeros(2), ("stop", "yield")),
        signals=Signals(heads[[1, 0, 1]], np.zeros(3), feet[[1, 0, 1]], ("a:0", "b:0", "c:0"), walkers=2),
    )
    left = lift_town(filled, town.relief)
    for rows in (left.trees, left.clutter[0][1], left.lamps, left.posts, left.poles.position, left.signs.position):
        np.testing.assert_array_equal(rows[:, 0], [30.0])
    assert left.poles.id.tolist() == [2]
    assert left.signs.kind == ("yield",)
    assert left.signals.link == ("a:0", "c:0")
    assert left.signals.walkers == 1
    np.testing.assert_array_equal(left.signals.foot, feet[[1, 1]])


def test_the_heights_of_a_town_keep_their_decks(town: Town, tmp_path: Path) -> None:
    assert town.relief is not None
    town.relief.save(tmp_path / "heights.parquet")
    again = Relief.load(tmp_path / "heights.parquet")
    np.testing.assert_array_equal(again.points, town.relief.points)
    for one, other in zip(again.decks[0].sections, deck_of(town).sections, strict=True):
        np.testing.assert_array_equal(one, other)
    thin = Relief(again.points, again.decks)
    thin.decks[0].sections = thin.decks[0].sections[:1]
    thin.save(tmp_path / "thin.parquet")
    with pytest.raises(InputError, match="not the heights of a town"):
        Relief.load(tmp_path / "thin.parquet")


def test_a_deck_is_where_a_road_is_high_above_another_and_crosses_it() -> None:
    def road(x: float, z: float, turned: bool) -> Borders:
        s = np.arange(-30.0, 31.0)
        ends = [np.column_stack((s, np.full(61, side) + x, np.full(61, z))) for side in (-3.0, 3.0)]
        return Borders(*(end[:, [1, 0, 2]] if turned else end for end in ends))

    ground = road(0.0, 0.0, False)
    (below, over) = find_bridges([ground, road(0.0, BRIDGE_M + 0.1, True)])
    assert not below.decks
    ((first, last),) = [(deck.start, deck.stop) for deck in over.decks]
    assert (first, last) == (30 - 7 - 1, 30 + 7 + 2)  # 3 m of road and 4 m clear of it on each side, rounded up
    for other in (road(0.0, BRIDGE_M - 0.1, True), road(8.0, 9.0, False)):
        assert not any(span.decks for span in find_bridges([ground, other]))


def test_a_deck_goes_on_over_a_joint_of_roads() -> None:
    s, flat = np.arange(-30.0, 31.0), np.zeros(61)
    ground = Borders(*(np.column_stack((s, flat + side, flat)) for side in (-3.0, 3.0)))
    above = [np.column_stack((flat + side, s, flat + 6.0)) for side in (3.0, -3.0)]
    before, after = Borders(*(end[:26] for end in above)), Borders(*(end[25:] for end in above))  # they meet at y = -5
    _, first, second = find_bridges([ground, before, after])
    assert [s[:26][deck].tolist() for deck in first.decks] == [[-8.0, -7.0, -6.0, -5.0]]
    assert [(s[25:][deck][0], s[25:][deck][-1]) for deck in second.decks] == [(-5.0, 8.0)]


def test_a_road_has_a_bridge_over_itself() -> None:
    t = np.linspace(-1.6, 1.6, 200)
    line = np.column_stack((30 * (t**2 - 1), 30 * (t**3 - t), 3 * (t + 1.6)))  # at 0, 0 with t = -1 and with t = 1
    ahead = np.gradient(line[:, :2], axis=0)
    aside = 3 * np.column_stack((-ahead[:, 1], ahead[:, 0])) / np.linalg.norm(ahead, axis=1, keepdims=True)
    aside = np.column_stack((aside, np.zeros(200)))
    (span,) = find_bridges([Borders(line - aside, line + aside)])
    (deck,) = span.decks
    assert t[deck][0] < 1 < t[deck][-1]
    assert t[deck][0] > 0.6


def with_sidewalk() -> ElementTree.Element:
    """Return the crossing with a sidewalk along the lower street, so that none is added."""
    root = crossing()
    for lane in root.iterfind("road[@id='1']//lane[@id='1']"):
        lane.set("type", "sidewalk")
    return root


@pytest.mark.parametrize(
    ("make", "kind", "width"),
    [(crossing, "town", 7.0 + 2 * SIDEWALK_M), (crossing, "motorway", 7.0), (with_sidewalk, "town", 7.0)],
)
def test_a_deck_is_wider_where_sidewalks_are_added(make, kind: str, width: float) -> None:
    root = make()
    for row in root.iterfind("road[@id='2']/type"):
        row.set("type", kind)
    (deck,) = sample_heights(root, Path("map")).decks
    np.testing.assert_allclose([np.ptp(section[:, 0]) for section in deck], width, atol=1e-3)


@pytest.mark.parametrize("make", [crossing, with_sidewalk])
def test_a_road_without_a_width_has_no_deck(make) -> None:
    root = make()
    for width in root.iterfind("road[@id='2']//width"):
        width.set("a", "0")
    found = sample_heights(root, Path("map"))
    assert not found.decks
    assert Relief(found.points).heights(0.0, 0.0) == pytest.approx(0.0)


@pytest.mark.parametrize("degrees", [90, 45, 25])
def test_a_street_below_a_skewed_bridge_stays_level(degrees: int) -> None:
    turn = np.radians(degrees)
    level = '<elevationProfile><elevation s="0" a="6" b="0" c="0" d="0"/></elevationProfile>'
    lower = street("1", 'x="-150" y="0" hdg="0"><line/>', 300.0)
    start = f'x="{-100 * np.cos(turn)}" y="{-100 * np.sin(turn)}" hdg="{turn}"><line/>'
    upper = street("2", start, 200.0, profile=level)
    found = sample_heights(ElementTree.fromstring(f"<OpenDRIVE>{lower}{upper}</OpenDRIVE>"), Path("map"))
    relief = Relief(found.points)
    x, y = np.meshgrid(np.arange(-120.0, 120.5, 0.5), (-3.4, -1.7, 0.0, 1.7, 3.4))
    np.testing.assert_allclose(relief.heights(x, y), 0.0, atol=0.02)


def test_a_lane_that_is_wide_beyond_belief_has_few_points() -> None:
    root = crossing()
    for width in root.iterfind("road[@id='3']//width"):
        width.set("c", "0.05")  # to 7 km
    assert len(sample_heights(root, Path("map")).points) < 100_000
