"""Bridges of OpenDRIVE maps: decks, what drives on them and below them, and what they look like."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
from shapely import contains_xy

from flcav.config import InputError
from flcav.world.map.relief import Deck, Relief
from flcav.world.map.town import Town
from flcav.world.materials import Material
from flcav.world.opendrive.bridges import BRIDGE_M, Borders, find_bridges
from flcav.world.opendrive.importing import import_town
from flcav.world.scene import Scene
from flcav.world.static import DECK_M, Part, build_static_world
from flcav.world.trace import Trace
from flcav.world.traffic.traffic import simulate

HALF_M, RISE = 80.0, 0.075  # of two streets: from where they cross to their ends, and the slope of the upper one


def street(name: str, shape: str, length: float, links: str, profile: str = "") -> str:
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
    """Return a street along x at height 0, one along y that passes 6 m above it, and a bow between their ends."""
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
    walkers = inside & (trace.category == "pedestrian")
    known = np.minimum(np.abs(z), np.abs(z - RISE * (HALF_M - np.abs(y))))
    assert known[walkers].max(initial=0.0) < 0.3
    way = np.abs(np.diff(z, axis=0)[trace.present[1:] & trace.present[:-1]])
    assert way.max() < 1.0  # in half a second: nobody jumps from one street to the other


def test_rays_meet_the_deck_from_above_and_from_below(town: Town, trace: Trace) -> None:
    scene, down = Scene(town, trace), np.array([[0.0, 0.0, -1.0]], np.float32)
    pose = np.eye(4)
    pose[:3, 3] = 0.5, 2.0, 20.0
    (fall,) = scene.cast(pose, down).distance
    pose[2, 3] = 2.5
    (rise,) = scene.cast(pose, -down).distance
    top = RISE * (HALF_M - 2.0)
    assert 20.0 - fall == pytest.approx(top, abs=0.05) or fall < 20.0 - top  # or what drives there
    assert 2.5 + rise == pytest.approx(top - DECK_M, abs=0.05)
    world = build_static_world(town)
    assert set(world.mesh.material[world.part == Part.DECK]) == {Material.ROAD, Material.WALL}


def test_nothing_stands_on_or_under_a_deck(town: Town) -> None:
    area = deck_of(town).outline.buffer(1.0)
    for feet in (town.lamps, town.trees, town.poles.position, town.signs.position, *(rows for _, rows in town.clutter)):
        assert not contains_xy(area, *feet[:, :2].T).any()


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
