"""Lane centres and heights of OpenDRIVE maps, by CARLA's reader and by ASAM's quality checker."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from conftest import Peer
from lanes import MAPS, REAL, TILTED, compare_reading, compare_town

from flcav.world.opendrive.document import read_map
from flcav.world.opendrive.road_surface import Road

CLOSE_M = 0.015  # of lane centres and heights
NEAR_M = 0.04  # of lanes of the town: SUMO's are polylines, of points a metre apart in curves
TAPERED = "multi_intersections"  # two of its streets lose a lane midway; SUMO's lanes keep their width along a street


@pytest.fixture(scope="module")
def lanes(peer: Callable[[str], Peer]) -> dict[str, list[list]]:
    if not MAPS:
        pytest.skip(f"no maps in {REAL}: they are not part of the project")
    return peer("carla").read(*MAPS)


def test_lane_centres_and_heights_are_carlas(lanes: dict[str, list[list]]) -> None:
    for path, rows in lanes.items():
        plan, rise = compare_reading(Path(path), rows)
        assert plan.max() < CLOSE_M, path
        assert rise.max(initial=0.0) < CLOSE_M, path


def test_lanes_of_the_town_are_carlas(lanes: dict[str, list[list]], tmp_path: Path) -> None:
    for path, rows in lanes.items():
        streets, junctions = compare_town(Path(path), rows, tmp_path / Path(path).stem)
        assert np.quantile(streets, 0.95) < CLOSE_M, path
        assert junctions.max(initial=0.0) < NEAR_M, path
        assert streets.max() < NEAR_M or TAPERED in path, path


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
