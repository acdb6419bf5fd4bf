"""The hilly towns: streets as in the level ones, slopes within bounds, camber, and a surface without holes."""

import numpy as np
import pytest

from flcav.world.map.relief import Relief
from flcav.world.map.roads import read_net
from flcav.world.map.town import HILLS, KERB_M, TOWNS, load_town
from flcav.world.rays.embree import Solid
from flcav.world.static import GROUND_M, TownPart, build_static_world

STEEPEST, CAMBER = 0.12, 0.025


def test_a_hilly_town_is_the_level_one_lifted() -> None:
    hilly, level = load_town("hilly_suburb"), load_town("suburb")
    assert level.relief is None
    assert hilly.relief is not None
    assert (hilly.name, hilly.net) == ("hilly_suburb", level.net)
    np.testing.assert_array_equal(hilly.buildings, level.buildings)
    lift = hilly.poles.position - level.poles.position
    np.testing.assert_allclose(lift[:, 2], hilly.relief.heights(*level.poles.position[:, :2].T))
    assert not lift[:, :2].any()


@pytest.mark.parametrize("name", TOWNS)
def test_streets_slope_and_fall_to_their_sides(name: str) -> None:
    folder = load_town("suburb").net.parents[1] / name
    relief = Relief.load(folder / HILLS)
    grades, falls = [], []
    for edge in read_net(folder / "town.net.xml").streets:
        line = edge.lanes[-1].shape
        ahead = np.diff(line, axis=0)
        length = np.linalg.norm(ahead, axis=1)
        at = int(length.argmax())
        if length[at] < 45:
            continue
        ahead = ahead[at] / length[at]
        right = np.array([ahead[1], -ahead[0]])
        crown = line[at] + ahead * np.linspace(20, length[at] - 20, 5)[:, None] - right * edge.lanes[-1].width / 2
        paved = sum(lane.width for lane in edge.lanes if lane.kind != "sidewalk")
        middle, left, aside = (relief.heights(*(crown + right * by).T) for by in (0.0, -0.95 * paved, 0.95 * paved))
        grades.append(np.diff(middle) / np.linalg.norm(np.diff(crown, axis=0), axis=1))
        falls.append((middle - (left + aside) / 2) / (0.95 * paved))
    assert np.ptp(relief.points[:, 2]) > 6
    assert 0.02 < np.abs(np.concatenate(grades)).max() < STEEPEST
    assert np.median(np.concatenate(falls)) == pytest.approx(CAMBER, abs=0.004)


def test_ground_roads_and_sidewalks_close_a_hilly_towns_surface() -> None:
    town = load_town("hilly_suburb")
    world, relief = build_static_world(town), town.relief
    assert relief is not None
    low = np.isin(world.part, [TownPart.GROUND, TownPart.ROAD, TownPart.SIDEWALK])
    x0, y0, x1, y1 = town.bounds
    places = np.random.default_rng(3).uniform((x0, y0), (x1, y1), (20_000, 2))
    eye = np.eye(4)
    eye[:3, 3] = (x0 + x1) / 2, (y0 + y1) / 2, 80.0
    rays = np.column_stack((places, relief.heights(*places.T))) - eye[:3, 3]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    hits = Solid(world.mesh.vertices, world.mesh.faces[low]).trace(eye, rays.astype(np.float32))
    assert (hits.face >= 0).all()
    at = eye[:3, 3] + hits.distance[:, None].astype(np.float64) * rays
    above = at[:, 2] - relief.heights(*at[:, :2].T)
    assert (above > GROUND_M - 0.005).all()
    assert (above < KERB_M + 0.015).all()
    on_road = world.part[low][hits.face] == TownPart.ROAD
    assert np.abs(above[on_road]).max() < 0.005
