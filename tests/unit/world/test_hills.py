"""The hilly towns: streets as in the level ones, slopes within bounds, camber, and a surface without holes."""

import numpy as np
import pytest

from flcav.world.map.roads import read_net
from flcav.world.map.town import HILLY, KERB_M, Town, load_town
from flcav.world.rays.embree import Solid
from flcav.world.static import GROUND_M, Part, build_static_world

STEEPEST, CAMBER = 0.12, 0.025


@pytest.fixture(scope="module", params=("hilly_suburb", "hilly_grid"))
def hilly(request: pytest.FixtureRequest) -> Town:
    return load_town(request.param)


def test_a_hilly_town_is_the_level_one_lifted(hilly: Town) -> None:
    level = load_town(HILLY[hilly.name])
    assert level.relief is None
    assert hilly.relief is not None
    assert hilly.net == level.net
    np.testing.assert_array_equal(hilly.buildings, level.buildings)
    lift = hilly.poles.position - level.poles.position
    np.testing.assert_allclose(lift[:, 2], hilly.relief.heights(*level.poles.position[:, :2].T))
    assert not lift[:, :2].any()
    assert np.ptp(hilly.relief.points[:, 2]) > 6


def test_streets_slope_and_fall_to_their_sides(hilly: Town) -> None:
    assert hilly.relief is not None
    grades, falls = [], []
    for edge in read_net(hilly.net).streets:
        line = edge.lanes_of("driving")[-1].shape
        start, end = line[0], line[-1]
        length = np.linalg.norm(end - start)
        ahead = (end - start) / length
        if len(line) > 2 or length < 45:
            continue
        right = np.array([ahead[1], -ahead[0]])
        crown = start + ahead * np.linspace(20, length - 20, 5)[:, None] - right * edge.lanes[-1].width / 2
        paved = sum(lane.width for lane in edge.lanes if lane.kind != "sidewalk")
        middle, left, aside = (
            hilly.relief.heights(*(crown + right * by).T) for by in (0.0, -0.95 * paved, 0.95 * paved)
        )
        grades.append(np.diff(middle) / np.linalg.norm(np.diff(crown, axis=0), axis=1))
        falls.append((middle - (left + aside) / 2) / (0.95 * paved))
    assert 0.03 < np.abs(np.concatenate(grades)).max() < STEEPEST
    assert np.median(np.concatenate(falls)) == pytest.approx(CAMBER, abs=0.004)


def test_ground_roads_and_sidewalks_close_a_hilly_towns_surface() -> None:
    town = load_town("hilly_suburb")
    world, relief = build_static_world(town), town.relief
    assert relief is not None
    low = np.isin(world.part, [Part.GROUND, Part.ROAD, Part.SIDEWALK])
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
    on_road = world.part[low][hits.face] == Part.ROAD
    assert np.abs(above[on_road]).max() < 0.005
