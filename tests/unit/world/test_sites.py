"""Candidate sites that are drawn along streets, and where sites are."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
import yaml
from scipy.spatial.distance import pdist

from flcav.config import InputError
from flcav.planner.inputs import find_sites
from flcav.world.geodesy import convert_to_geodetic, find_on_ground
from flcav.world.map.roads import read_net
from flcav.world.map.town import Town, load_town
from flcav.world.sites import MOUNT_M, draw_sites, list_street_names, locate_sites, measure_streets


@pytest.fixture(scope="module")
def bypassed(tmp_path_factory: pytest.TempPathFactory) -> Town:
    """The town `arterial`, whose fast road has no sidewalk, as motorways have none."""
    known, folder = load_town("arterial"), tmp_path_factory.mktemp("towns") / "bypassed"
    folder.mkdir()
    text = known.net.read_text()
    edges = re.findall(r'<edge id="[^"]*"[^>]* type="fast".*?</edge>', text, re.DOTALL)
    for edge in edges:
        text = text.replace(edge, edge.replace('allow="pedestrian"', 'disallow="all"'))
    (folder / "town.net.xml").write_text(text)
    settings = yaml.safe_load(known.net.with_name("town.yaml").read_text())
    fast = {edge.split('"')[1] for edge in edges}
    settings["poles"] = [pole for pole in settings["poles"] if pole["edge"] not in fast]
    (folder / "town.yaml").write_text(yaml.safe_dump(settings))
    return load_town(Path(folder))


@pytest.mark.parametrize("name", ["suburb", "ring", "hilly_grid"])
def test_sites_stand_beside_the_streets_at_even_distances(name: str):
    town = load_town(name)
    sites = draw_sites(town, 25.0)
    road = shapely.union_all([shapely.Polygon(part) for part in town.roads])
    apart = shapely.distance(road, shapely.points(sites[:, :2]))
    assert apart.min() > 0
    assert apart.max() < 3.0
    assert pdist(sites[:, :2]).min() > 12.5
    assert len(sites) == pytest.approx(measure_streets(town) / 25.0, rel=0.2)
    np.testing.assert_allclose(sites[:, 2] - town.grounds(sites[:, 0], sites[:, 1]), MOUNT_M)


def test_streets_without_poles_have_sites_and_the_note_says_so(bypassed: Town):
    known, sites = bypassed.poles, find_sites(bypassed)
    assert 0 < len(known.id) < len(sites.ids)
    assert sites.ids[: len(known.id)] == tuple(known.id)
    assert sites.ids[len(known.id)] == max(known.id) + 1
    lines = [
        shapely.LineString(edge.lanes_of("driving")[0].shape)
        for edge in read_net(bypassed.net).streets
        if edge.type == "fast"
    ]
    fast = shapely.union_all(lines)
    drawn = sites.xyz[len(known.id) :]
    assert shapely.distance(fast, shapely.points(drawn[:, :2])).max() < 5.0
    told = f"the {len(known.id)} poles of bypassed, and {len(drawn)} sites every 50 m along "
    assert re.fullmatch(rf"candidates: {told}\d\.\d km of its streets that have none", sites.note)
    every = find_sites(bypassed, 50.0)
    assert len(every.ids) > len(drawn)
    assert every.note == f"candidates: {len(every.ids)} sites every 50 m along the streets of bypassed"


def test_a_town_without_poles_has_sites_along_all_streets():
    town = load_town("suburb")
    none = replace(town.poles, id=np.zeros(0, np.int64), position=np.zeros((0, 3)), yaw=np.zeros(0), kind=())
    sites = find_sites(replace(town, poles=none))
    np.testing.assert_array_equal(sites.xyz, draw_sites(town, 50.0))
    assert sites.note.endswith("sites every 50 m along the streets of suburb, which has no poles of its own")
    with pytest.raises(InputError, match="--every 3: must be from 5 to 1000 m"):
        find_sites(town, 3.0)


def test_places_are_found_by_their_coordinates_and_streets():
    town = load_town("hilly_suburb")
    site = np.array([[30.0, 10.0, town.ground(30.0, 10.0) + 6.0]])
    (found,) = locate_sites(town, site)
    assert found.street == "Main Street"
    back = find_on_ground(town, found.latitude, found.longitude)
    np.testing.assert_allclose(back, site[0] - (0, 0, 6), atol=2e-3)
    latitude, longitude, _ = convert_to_geodetic(town.geo, site[0])
    assert (found.latitude, found.longitude) == (latitude, longitude)
    assert locate_sites(town, np.array([[0.0, 500.0, 0.0]]))[0].street is None
    assert set(list_street_names(town)) >= {"Main Street", "The Close"}
