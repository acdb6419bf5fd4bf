"""Lane centres and heights of OpenDRIVE maps, by CARLA's reader and by ASAM's quality checker."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import shapely
from conftest import Peer
from shapely.geometry import LineString

from flcav.world.map.relief import Relief
from flcav.world.map.roads import read_net
from flcav.world.opendrive.document import read_map
from flcav.world.opendrive.heights import sample_heights
from flcav.world.opendrive.importing import import_town
from flcav.world.opendrive.road_surface import Road

REAL = Path(os.environ.get("FLCAV_REAL_DATA", Path(__file__).parents[2].parent / "shared" / "data"))
MAPS = sorted([*REAL.glob("carla_maps/*.xodr"), *REAL.glob("opendrive/*.xodr")])
CLOSE_M = 0.015  # of lane centres and heights
TILTED = "velodrome"  # CARLA takes no superelevation


@pytest.fixture(scope="module")
def lanes(peer: Callable[[str], Peer]) -> dict[str, list[list]]:
    if not MAPS:
        pytest.skip(f"no maps in {REAL}: they are not part of the project")
    return peer("carla").read(*MAPS)


def test_lane_centres_and_heights_are_carlas(lanes: dict[str, list[list]]) -> None:
    for path, rows in lanes.items():
        root = read_map(Path(path))
        roads = {row.get("id"): Road(row) for row in root.iterfind("road")}
        points = sample_heights(root, Path("map")).points
        for road, lane, s, *centre, _ in rows:
            found = roads[road].point(np.array([s]), np.array([roads[road].lane_centre(s, lane)]))[0]
            assert np.hypot(*(found[:2] - centre[:2])) < CLOSE_M, path
        if TILTED not in path:
            centres = np.array([row[3:6] for row in rows])
            ground = Relief(points).heights(*centres[:, :2].T) if len(points) else np.zeros(len(centres))
            assert np.abs(ground - centres[:, 2]).max() < CLOSE_M, path


def test_lanes_of_the_town_are_carlas(lanes: dict[str, list[list]], tmp_path: Path) -> None:
    for path, rows in lanes.items():
        town = import_town(Path(path), tmp_path / Path(path).stem).town
        source = town.parameters.source
        assert source is not None
        streets = [LineString(lane.shape) for edge in read_net(town.net).streets for lane in edge.lanes_of("driving")]
        at = [
            shapely.Point(x + source.offset_m[0], y + source.offset_m[1]) for *_, x, y, _, inside in rows if not inside
        ]
        away = shapely.STRtree(streets).query_nearest(at, return_distance=True, all_matches=False)[1]
        assert np.quantile(away, 0.9) < CLOSE_M, path  # the others lie where a street gives way to its junction


def test_superelevation_is_the_checkers(peer: Callable[[str], Peer]) -> None:
    path = REAL / "opendrive" / f"{TILTED}.xodr"
    if not path.exists():
        pytest.skip(f"{path} is not there: it is not part of the project")
    roads = {row.get("id"): Road(row) for row in read_map(path).iterfind("road")}
    for road, s, t, x, y, z in peer("asam_qc").read(path):
        base = roads[road].point(np.array([s]), np.array([0.0]))[0]
        away = np.sign(t) * np.hypot(x - base[0], y - base[1])  # t as seen in plan
        found = roads[road].point(np.array([s]), np.array([away]))[0]
        np.testing.assert_allclose(found, (x, y, z), atol=CLOSE_M)
