from pathlib import Path

import numpy as np
import pytest
import shapely

from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.fusion.road import (
    OFF_ROAD_M,
    ROAD,
    TRAINED_IN,
    flatten_ground,
    keep_on_surface,
    load_road_network,
    road_detector,
)
from flcav.geometry import Boxes, inverse, pose, transform_points
from flcav.perception.agents import frame_reader
from flcav.perception.objects.samples import select_fitting_frames
from flcav.perception.objects.task import OBJECTS
from flcav.perception.weights import LICENCE, find_shipped, read_card
from flcav.reproductions.road_detector.run import detect_frames, score_town
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe
from flcav.world.map.relief import Relief


@pytest.fixture(scope="module")
def roadside(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder: Path = tmp_path_factory.mktemp("roadside") / "data"
    recipe = Recipe(town="grid", seed=5, scenes=3, spins_per_scene=4, every_s=6.0, warmup_s=30.0, cavs=1, poles=(6,))
    record(EmbeddedSource(recipe), folder)
    return Dataset.open(folder)


def test_the_detector_finds_most_cars_around_a_pole_it_has_not_seen(roadside: Dataset) -> None:
    score = score_town("grid", False, detect_frames(roadside))
    assert score.cars > 10
    assert score.recall.mean > 0.6  # backgrounds of three scenes hold some parked cars
    assert score.precision.mean > 0.8


def test_a_network_of_foregrounds_sees_a_pole_without_its_background_and_vehicles_whole(roadside: Dataset) -> None:
    network = load_road_network()
    read = frame_reader(roadside, network.config.foreground)
    for number, key in enumerate(roadside.keys[:4]):
        whole, seen = roadside.frame(number).lidar["lidar"], read(number).lidar["lidar"]
        if key.agent.startswith("cav"):
            np.testing.assert_array_equal(seen, whole)
        else:
            assert 0 < len(seen) < 0.2 * len(whole)


def test_it_fits_poles_and_no_vehicle(roadside: Dataset) -> None:
    fitting = select_fitting_frames(roadside, load_road_network().config)
    assert {roadside.keys[number].agent for number in fitting} == {"pole6"}


def test_boxes_are_in_the_world_with_scores_and_variances(roadside: Dataset) -> None:
    number = roadside.select(agents={"pole6"})[-1]
    found = road_detector(roadside, 0.7)(number)
    near = np.linalg.norm(found.center[:, :2] - roadside.world_from_agent(number)[:2, 3], axis=1)
    assert near.max() < 60
    assert found.score is not None
    assert found.score.min() >= 0.7
    assert found.variance is not None
    assert set(found.label) == {"car"}


def test_on_a_slope_points_are_as_high_as_above_level_ground() -> None:
    corners = np.array([(x, y) for x in (-100.0, 100.0) for y in (-100.0, 100.0)])
    relief = Relief(np.column_stack((corners, 0.1 * corners[:, 0] - 0.05 * corners[:, 1] + 7)))
    world_from_lidar = pose(10.0, 20.0, 13.0, yaw=0.4)  # 6 m above the ground there
    places = np.array([[30.0, 20.0, 1.5], [-15.0, -5.0, 0.0], [10.0, 20.0, 6.0]])  # x, y, height above the ground
    ground = 0.1 * places[:, 0] - 0.05 * places[:, 1] + 7
    world = np.column_stack((places[:, :2], ground + places[:, 2]))
    points = np.column_stack((transform_points(inverse(world_from_lidar), world), [0.1, 0.2, 0.3])).astype(np.float32)
    flat = flatten_ground(points, world_from_lidar, relief)
    np.testing.assert_allclose(flat[:, 2], places[:, 2] - 6.0, atol=1e-5)
    np.testing.assert_array_equal(flat[:, [0, 1, 3]], points[:, [0, 1, 3]])


@pytest.mark.slow
def test_cars_on_slopes_are_found_and_stand_on_the_road(tmp_path: Path) -> None:
    shared = {"seed": 5, "scenes": 3, "spins_per_scene": 2, "every_s": 6.0, "warmup_s": 30.0, "cavs": 0}
    record(EmbeddedSource(Recipe.model_validate({"town": "hilly_grid", "poles": (6,), **shared})), tmp_path / "data")
    data = Dataset.open(tmp_path / "data")
    score = score_town("hilly_grid", False, detect_frames(data))
    assert score.recall.mean > 0.6
    assert score.precision.mean > 0.8
    town, found = data.town(), [road_detector(data)(number) for number in range(len(data))]
    assert town is not None
    assert town.relief is not None
    for boxes in found:
        stand = boxes.center[:, 2] - boxes.size[:, 2] / 2
        np.testing.assert_allclose(stand, town.relief.heights(*boxes.center[:, :2].T), atol=0.3)


def test_what_lies_off_the_drivable_surface_is_left_out() -> None:
    surface = shapely.box(0, 0, 10, 4)
    rows = [[x, 2, 0.8, 4.4, 1.8, 1.6, 0] for x in (5.0, 10 + OFF_ROAD_M - 0.1, 10 + OFF_ROAD_M + 0.1)]
    assert keep_on_surface(Boxes.from_array(np.array(rows), "car"), surface).center[:, 0].tolist() == [5.0, 10.4]


def test_its_card_says_that_it_was_trained_elsewhere() -> None:
    card = read_card(find_shipped(OBJECTS, ROAD))
    assert sorted(str(entry.recipe["town"]) for entry in card.data) == list(TRAINED_IN)
    assert card.network == "road"
    assert card.licence == LICENCE
    path = find_shipped(OBJECTS, ROAD)
    assert path.with_suffix(".md").read_text(encoding="utf-8") == card.markdown()
