from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flcav.config import parse_config
from flcav.fusion.average import Navigation, Sighting
from flcav.geometry import Boxes, inverse, pose, yaw_of
from flcav.planner.inputs import read_given
from flcav.reproductions.fig3b.run import ZONE_M, TownCover, _count_zones, cover_town, list_kinds
from flcav.reproductions.fig4.run import EDGES_M, find_range
from flcav.reproductions.road_average.run import Errors, apply_errors, measure_residual
from flcav.reproductions.road_detector.run import _Frames, fit_threshold, score_town
from flcav.reproductions.sensor_ranges.run import EDGES_M as SENSOR_EDGES_M
from flcav.reproductions.sensor_ranges.run import SHARED, LidarModel, SensorRanges
from flcav.runs.provenance import provenance
from flcav.sensors.rig import RIGS, Rig
from flcav.sources.recipe import Recipe
from flcav.world.map.town import load_town

EXACT = Navigation(0.01, 0.001)


def sightings(spins: int) -> list[Sighting]:
    return [
        Sighting(agent, 0.5 * spin, pose(10.0 * n, 0, 0, 0.3), Boxes.empty(), navigation=EXACT if n else None)
        for spin in range(spins)
        for n, agent in enumerate(("pole1", "cav0", "cav1"))
    ]


def offsets(errors: Errors, spins: int = 400) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return offsets in position (S, 2), heading [deg] (S,) and time (S,) of cav0."""
    told = sightings(spins)
    arrived = apply_errors(told, errors, np.random.default_rng(3))
    pairs = [(a, b) for a, b in zip(told, arrived) if a.agent == "cav0"]
    place = np.array([b.world_from_agent[:2, 3] - a.world_from_agent[:2, 3] for a, b in pairs])
    turn = np.degrees([yaw_of(inverse(a.world_from_agent) @ b.world_from_agent) for a, b in pairs])
    return place, turn, np.array([b.time_s - a.time_s for a, b in pairs])


def test_white_errors_are_drawn_anew_and_constant_ones_once() -> None:
    place, turn, late = offsets(Errors(position_m=0.5, heading_deg=2.0))
    np.testing.assert_allclose(place.std(axis=0), 0.5, rtol=0.1)
    assert turn.std() == pytest.approx(2.0, rel=0.1)
    assert not late.any()
    place, turn, late = offsets(Errors(constant_m=0.5, clock_s=0.2))
    assert place.std(axis=0).max() < 1e-9
    assert np.abs(place[0]).min() > 0
    assert late.std() < 1e-9
    assert late[0] != 0


def test_residuals_are_the_mean_errors_of_vehicles_alone() -> None:
    true = sightings(2)
    told = [
        replace(each, world_from_agent=each.world_from_agent @ pose(0.3, -0.4, 0, -0.1), time_s=each.time_s - 0.2)
        if each.agent == "cav0"
        else each
        for each in true
    ]
    found = measure_residual(true, told)  # cav0's, and cav1's, which has none
    assert found.position_cm == pytest.approx(25)
    assert found.heading_deg == pytest.approx(np.degrees(0.05))
    assert found.clock_ms == pytest.approx(100)
    moved = [replace(each, world_from_agent=pose(9, 9, 0, 1)) if each.navigation is None else each for each in told]
    assert measure_residual(true, moved) == found


def test_road_sensors_are_surveyed_and_messages_of_all_are_lost() -> None:
    told = sightings(400)
    arrived = apply_errors(told, Errors(position_m=0.5, clock_s=0.3), np.random.default_rng(0))
    assert [each for each in arrived if each.navigation is None] == [each for each in told if each.navigation is None]
    left = apply_errors(told, Errors(loss=0.25), np.random.default_rng(0))
    assert len(left) / len(told) == pytest.approx(0.75, abs=0.04)
    assert {each.agent for each in left} == {"pole1", "cav0", "cav1"}


def cars(*places, score=None):
    rows = np.array([[x, y, 0.8, 4.4, 1.8, 1.6, 0.0] for x, y in places]).reshape(-1, 7)
    return Boxes.from_array(rows, "car", score)


FRAMES = _Frames(
    scene=["a", "b"],
    found=[cars((5, 0), (20, 0), (45, 0), score=[0.9, 0.8, 0.95]), cars((5, 0.2), (12, 8), score=[0.75, 0.6])],
    targets=[cars((5, 0), (12, 0)), cars((5, 0))],
    neutral=[cars((20, 0)), Boxes.empty()],
    place=[np.zeros(2), np.zeros(2)],
)


def test_recall_is_of_near_cars_and_neutral_and_far_detections_do_not_count() -> None:
    score = score_town("t", False, FRAMES, threshold=0.5)
    assert (score.cars, score.detections) == (3, 3)
    assert score.recall.mean == pytest.approx(2 / 3)
    assert score.precision.mean == pytest.approx(2 / 3)
    stricter = score_town("t", False, FRAMES, threshold=0.7)
    assert stricter.precision.mean == 1
    assert sum(cars for cars, _ in stricter.by_distance) == 3


def test_the_threshold_is_the_lowest_score_that_is_precise_enough() -> None:
    assert fit_threshold([FRAMES]) == 0.75
    assert fit_threshold([replace(FRAMES, targets=[Boxes.empty()] * 2)]) == 1.0


def test_zones_count_errors_around_poles_per_hectare_and_per_frame() -> None:
    town = load_town("suburb")
    at = town.poles.position[0]
    east = np.array((1.0, 0.0, 0.0))
    errors = np.stack((at, at + (ZONE_M - 1) * east, at + (ZONE_M + 1) * east))
    zones = _count_zones(town, errors, at[None, :2], np.zeros(len(town.poles.id)))
    assert (zones[0].pole, zones[0].errors, zones[0].per_frame) == (int(town.poles.id[0]), 2, 2.0)
    assert zones[0].per_hectare == pytest.approx(2 / (np.pi * 0.09))
    assert zones[-1].per_frame is None


def test_a_range_ends_with_the_last_interval_in_which_enough_cars_are_found() -> None:
    cars, none = (10,) * (len(EDGES_M) - 1), (0,) * (len(EDGES_M) - 4)
    assert find_range(EDGES_M, cars, (10, 8, 7, *none)) == EDGES_M[2]  # though 25 of 30 are found up to the third
    assert find_range(EDGES_M, cars, (2, 7, 8, *none)) == EDGES_M[3]  # few right below the sensor
    assert find_range(EDGES_M, cars, (0,) * (len(EDGES_M) - 1)) == 0.0


def test_the_sensors_of_a_range_are_read_by_the_placement(tmp_path: Path) -> None:
    intervals = len(SENSOR_EDGES_M) - 1
    cars, all_to_20 = (10,) * intervals, (10,) * 4 + (0,) * (intervals - 4)
    models = (
        LidarModel("few", 16, (0,) * intervals, 0.0),
        LidarModel("many", 64, all_to_20, find_range(SENSOR_EDGES_M, cars, all_to_20)),
    )
    assert models[1].range_m == 20.0
    results = SensorRanges(8, cars, models, provenance())
    files = {name: tmp_path / f"{name}.csv" for name in ("errors", "poles", "sensors")}
    files["errors"].write_text("x,y,z\n1,2,0\n")
    files["poles"].write_text("id,x,y,z\n1,0,0,6\n")
    files["sensors"].write_bytes(results.sensors_csv())
    given = read_given(files["errors"], files["poles"], files["sensors"], None, [])
    assert (given.names, given.ranges_m.tolist(), given.sensor_cost.tolist()) == (("many",), [20.0], [4.0])
    assert SensorRanges.from_json(results.as_json(), "result.json") == results


def test_sensor_models_are_those_of_a_rig() -> None:
    recipe = parse_config(Recipe, {**SHARED, "town": "grid", "seed": 1}, "ranges")
    assert isinstance(recipe.pole_rig, Rig)
    channels = {name: each.settings.channels for name, each in recipe.pole_rig.lidars.items()}
    assert channels == {"pole_16": 16, "pole_32": 32, "pole_64": 64, "pole_128": 128, "hdl32e": 32, "os1_128": 128}
    assert recipe.pole_rig.lidars["pole_64"] == RIGS["lidar_pole"].lidars["lidar"]


def test_a_town_takes_as_many_sensors_as_its_errors_are_spread() -> None:
    town = load_town("grid")
    near = dict(zip(town.poles.id.tolist(), town.poles.position, strict=True))
    errors = np.array([near[2], near[2], near[3], near[9], [900.0, 900.0, 0.0]])  # the last out of reach
    found = cover_town(town, errors, 30.0)
    assert (found.errors, found.poles) == (5, 9)
    assert found.shares[:4] == (0.4, pytest.approx(0.6), 0.8, 0.8)
    assert found.wanted == (1, 2, 3)
    assert [found.count_for_reached(share) for share in (0.5, 0.75, 0.9, 1.0)] == [1, 2, 3, 3]
    straight = [number for number, kind in zip(town.poles.id.tolist(), town.poles.kind) if kind == "straight"]
    assert found.kinds["straight"] == pytest.approx(3 / len(straight))
    assert cover_town(town, errors[[0, 4]], 30.0).wanted == (1, 1, None)
    other = TownCover("ring", 4, 2, (0.5, 1.0), (1, 1, 2), {"tee": 0.1, "straight": 9.0})
    assert list_kinds([found, other]) == ["tee", "cross", "straight"]
