"""Trained triangles: areas with their intervals, paired gains, and the frames and counts of the film strips."""

from dataclasses import replace
from io import BytesIO
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from flcav.experiments.experiment import shrink_recipe
from flcav.geometry import Boxes
from flcav.perception.signs.predict import SignDetections
from flcav.perception.signs.samples import Sample
from flcav.reproductions.fig6b.run import RULES, TASKS, measure_area
from flcav.reproductions.plan_search.run import JOINT
from flcav.reproductions.triangle import run as triangle
from flcav.reproductions.triangle import strips
from flcav.reproductions.triangle.run import (
    ARMS,
    EXPERIMENT,
    TrainedTriangles,
    compare_triangles,
    draw_both,
    estimate_area,
    estimate_gain,
    find_test,
    tabulate_triangles,
)
from flcav.reproductions.triangle.strips import (
    Counted,
    Panel,
    draw_strip,
    faces_crossing,
    match_signs,
    place_window,
    show_cars,
    show_signs,
    spread_out,
    take_apart,
)
from flcav.runs.recipe import CLOUD, MAIN, load_run_recipe
from flcav.runs.results.plans import Plan, TaskPlan
from flcav.runs.results.tests import Tested as SavedTest
from flcav.runs.stages.graph import Graph
from flcav.sources.recipe import recipe_path
from flcav.statistics.estimates import Estimate
from flcav.world.map.town import load_town

RECIPE = load_run_recipe(recipe_path("runs/triangle"))
MEANS = {"most": (0.5, 0.08, 0.80), "equal": (0.6, 0.09, 0.81), MAIN: (0.62, 0.10, 0.81)}  # in the order of TASKS
TOWNS = {"grid": 0.1, "ring": -0.1}  # above the mean
HALF = 0.04  # of every interval


def about(mean: float, half: float = HALF) -> Estimate:
    return Estimate(mean, mean - half, mean + half)


def by_task(values: tuple[float, ...], half: float = HALF) -> dict[str, Estimate]:
    return {task: about(value, half) for task, value in zip(TASKS, values, strict=True)}


@pytest.fixture
def results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> TrainedTriangles:
    """Return the results of a run with the accuracies `MEANS` in the mean of both towns."""
    graph = Graph(RECIPE, Path())
    for rule, arm in ARMS.items():
        tasks = {
            task: TaskPlan(40 + number, 2, 1, 0.0, 0.0, 0.0, 0.0, predicted={CLOUD: value + 0.01})
            for number, (task, value) in enumerate(zip(TASKS, MEANS[arm], strict=True))
        }
        Plan("joint", tasks).save(tmp_path / graph.names.plan(arm))
        for (task, value), (town, shift) in product(zip(TASKS, MEANS[arm], strict=True), TOWNS.items()):
            tested = SavedTest(town, task, "", about(value + shift), {}, 80, 20)
            tested.save(find_test(graph, tmp_path, rule, town, task))

    def compare_tests(task: str, before: Path, after: Path, seed: int) -> Estimate:
        assert seed == RECIPE.seed
        return about(SavedTest.load(after).estimate.mean - SavedTest.load(before).estimate.mean, 0.02)

    monkeypatch.setattr(triangle, "compare_tests", compare_tests)
    return compare_triangles(graph, tmp_path, {"stop signs": {str(rule): Counted(1, 3, 2) for rule in RULES}})


def test_an_area_has_the_interval_of_many_draws() -> None:
    accuracy = by_task((0.6, 0.1, 0.9))
    area = estimate_area(accuracy)
    draws = np.random.default_rng(1).normal((0.6, 0.1, 0.9), HALF / 1.96, (200_000, 3))
    low, high = np.quantile(measure_area(draws), (0.025, 0.975))
    assert area.mean == pytest.approx((0.6 * 0.1 + 0.1 * 0.9 + 0.9 * 0.6) / 3)
    assert (area.low, area.high) == pytest.approx((low, high), abs=1e-3)


def test_a_gain_is_the_difference_of_the_areas_with_the_interval_of_paired_draws() -> None:
    one, other = (0.62, 0.12, 0.9), (0.5, 0.08, 0.85)
    gain = by_task(tuple(np.subtract(one, other)), 0.02)
    found = estimate_gain(by_task(one), by_task(other), gain)
    assert found.mean == pytest.approx(float(measure_area(np.array(one)) - measure_area(np.array(other))))
    draws = np.array(other) + np.random.default_rng(1).normal(np.subtract(one, other), 0.02 / 1.96, (200_000, 3))
    middle = np.quantile(measure_area(draws) - measure_area(np.array(other)), (0.025, 0.975))
    assert (found.low, found.high) == pytest.approx(tuple(middle), abs=2e-3)


def test_an_area_without_an_interval_of_a_task_has_none() -> None:
    area = estimate_area({**by_task((0.6, 0.1, 0.9)), "signs": Estimate(0.1, None, None)})
    assert (area.low, area.high) == (None, None)


def test_plans_are_compared_after_the_cloud_round_in_the_mean_of_both_towns(results: TrainedTriangles) -> None:
    for rule, arm in ARMS.items():
        own = results.triangles[rule]
        assert [own.accuracy[task].mean for task in TASKS] == pytest.approx(MEANS[arm])
        low, high = own.accuracy["objects"].low, own.accuracy["objects"].high
        assert low is not None
        assert high is not None
        assert high - low == pytest.approx(2 * HALF / np.sqrt(2))
        assert own.predicted_area == pytest.approx(float(measure_area(np.array(MEANS[arm]) + 0.01)))
        assert own.plan["signs"] == (41, 2, 1)
    joint, equal = results.triangles[JOINT], results.triangles["equal-stages"]
    gain = results.gains["equal-stages"]
    assert gain.predicted == pytest.approx(joint.predicted_area - equal.predicted_area)
    assert gain.area.mean == pytest.approx(joint.area.mean - equal.area.mean)
    assert gain.accuracy["weather"].mean == pytest.approx(0.0)
    low, high = gain.accuracy["objects"].low, gain.accuracy["objects"].high
    assert (low, high) == pytest.approx((0.02 - 0.02 / np.sqrt(2), 0.02 + 0.02 / np.sqrt(2)))


def test_rules_that_share_a_training_do_not_differ() -> None:
    graph = Graph(RECIPE, Path())
    graph.names = SimpleNamespace(stage=lambda *_: "one", test=lambda step, town: f"{step}-{town}")  # pyright: ignore[reportAttributeAccessIssue]
    assert triangle.subtract_accuracy(graph, Path(), "equal-stages", "weather") == Estimate(0.0, 0.0, 0.0)


def test_tables_and_picture_have_the_results(results: TrainedTriangles) -> None:
    tables = tabulate_triangles(results)
    assert "| joint | signs | 41/2/1 | 0.110 | 0.100 (0.072 to 0.128) |" in tables["triangles"]
    assert results.gains["max-throughput"].area.describe(sign=True) in tables["gains"]
    assert "| stop signs | joint | 1 | 3 | 2 |" in tables["strips"]
    assert Image.open(BytesIO(draw_both(results))).width > 1000
    again = TrainedTriangles.from_json(EXPERIMENT.encode(results), "again")
    assert again.sentences() == results.sentences()


def test_the_arms_are_the_rules_of_the_recipe_and_differ_in_nothing_else() -> None:
    assert {ARMS[rule] for rule in RULES} == {MAIN, *RECIPE.arms}
    assert all(RECIPE.arms[ARMS[rule]].plan == rule for rule in RULES if rule != JOINT)
    assert not any(arm.placement or arm.federation or arm.labels or arm.training for arm in RECIPE.arms.values())
    assert RECIPE.replan == "none"


def test_frames_are_the_best_of_different_scenes_before_any_second_one() -> None:
    scenes = {1: "a", 2: "a", 3: "b", 4: "b", 5: "c"}
    values = {1: 5.0, 2: 9.0, 3: 2.0, 4: 1.0, 5: 2.0}
    assert take_apart(values, scenes, 2) == [2, 3]
    assert take_apart(values, scenes, 3) == [2, 3, 5]
    assert take_apart(values, scenes, 4) == [1, 2, 3, 5]
    assert take_apart({4: 1.0}, scenes, 3) == [4]


def test_frames_are_spread_from_the_least_to_the_largest() -> None:
    values = {1: 5.0, 2: 9.0, 3: 2.0, 4: 1.0, 5: 7.0}
    assert spread_out(values, 3) == [4, 1, 2]
    assert spread_out(values, 2) == [4, 2]
    assert spread_out({7: 1.0, 8: 0.5}, 3) == [8, 7]
    assert spread_out({}) == []


def test_a_cross_road_is_ahead_of_who_drives_towards_it() -> None:
    town = load_town("grid")
    pole = town.poles.position[town.poles.kind.index("cross")]
    pose = np.eye(4)
    pose[:3, 3] = pole - (20.0, 5.0, pole[2])
    assert faces_crossing(pose, town)
    away = pose.copy()
    away[:2, :2] *= -1
    away[:2, 3] = pole[:2] + np.array((-6.0, 200.0))
    assert not faces_crossing(away, town)


def make_sample() -> Sample:
    picture = np.full((384, 640, 3), 90, np.uint8)
    boxes = np.array([[300.0, 100, 330, 130], [400, 100, 420, 120], [500, 300, 510, 310]])
    return Sample(picture, boxes, np.array([0, 1, 1]), np.array([[10.0, 10, 14, 14]]))


def make_signs() -> SignDetections:
    """Return a hit, a sign of another class, one on an ignored sign, and one on nothing."""
    box = np.array([[301.0, 101, 331, 131], [400, 100, 420, 120], [9, 9, 15, 15], [100, 100, 120, 120]])
    return SignDetections(box, np.array([0, 0, 0, 1]), np.array([0.9, 0.8, 0.7, 0.6]))


def test_signs_are_found_by_class_and_overlap_and_small_ones_are_left_out() -> None:
    assert match_signs(make_signs(), make_sample()).tolist() == [0, -1, -2, -1]
    assert show_signs(make_sample(), make_signs(), stop=0).counted == Counted(found=1, targets=2, false=1)


def test_what_is_beside_the_window_is_neither_shown_nor_counted() -> None:
    sample = make_sample()
    small = replace(sample, boxes=np.array([[300.0, 100, 310, 110], [400, 100, 420, 120], [500, 300, 510, 310]]))
    found = replace(
        make_signs(), box=np.array([[300.0, 100, 310, 110], [340, 100, 360, 120], [9, 9, 15, 15], [90, 90, 99, 99]])
    )
    assert show_signs(small, found, stop=0).counted == Counted(found=1, targets=1, false=1)


def test_the_window_is_around_the_sign_as_wide_as_its_size_asks_and_inside_the_picture() -> None:
    assert place_window(np.array([300.0, 100, 320, 120]), (640, 384)) == pytest.approx((190, 38, 430, 182))
    assert place_window(np.array([300.0, 100, 310, 110]), (640, 384)) == pytest.approx((245, 69, 365, 141))
    assert place_window(np.array([0.0, 0, 5, 5]), (640, 384)) == pytest.approx((0, 0, 100, 60))
    assert place_window(np.array([635.0, 379, 640, 384]), (640, 384)) == pytest.approx((540, 324, 640, 384))


def cars(*x: float, score: float | None = None) -> Boxes:
    size = np.tile((4.0, 2.0, 1.5), (len(x), 1))
    center = np.column_stack((x, np.zeros(len(x)), np.full(len(x), -1.0)))
    found = Boxes(center, size, np.zeros(len(x)), np.full(len(x), "Car"))
    return found if score is None else replace(found, score=np.full(len(x), score))


def test_cars_are_found_missed_and_false_and_neutral_ones_left_out() -> None:
    points = np.random.default_rng(0).uniform(-20, 20, (50, 4)).astype(np.float32)
    frame: Any = SimpleNamespace(
        lidar={"lidar": points}, agent_from_sensor={"lidar": np.eye(4)}, world_from_sensor=lambda _: np.eye(4)
    )
    panel = show_cars(frame, cars(10, 30, 40, score=0.5), cars(10.2, 20), cars(40), load_town("grid"))
    assert panel.counted == Counted(found=1, targets=2, false=1)
    drawn = draw_strip({rule: [panel, panel] for rule in RULES}, 1.0)
    assert drawn.counted == dict.fromkeys(RULES, Counted(found=2, targets=4, false=2))
    assert Image.open(BytesIO(drawn.picture)).width == 1000


def test_a_strip_of_no_frames_is_empty() -> None:
    strip = draw_strip({str(rule): [] for rule in RULES}, 1.0)
    assert strip.counted == dict.fromkeys(RULES, Counted(0, 0, 0))


def test_a_trial_trains_every_task_for_few_steps() -> None:
    quick = shrink_recipe(RECIPE)
    assert {quick.training_of(task).steps for task in TASKS} == {12}
    assert all(quick.tasks[task].history for task in TASKS)


def test_strips_are_as_wide_as_they_are_read() -> None:
    panel: Panel = show_signs(make_sample(), make_signs(), stop=0)
    assert Image.open(BytesIO(draw_strip({JOINT: [panel] * strips.SHOWN}, 0.6).picture)).width == 1000
