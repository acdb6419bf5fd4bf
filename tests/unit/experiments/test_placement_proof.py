"""The proof of placement by learning: its geometry, its statistics, and what it makes of gains by pole."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.stats import spearmanr, t
from shapely.geometry import Point

from flcav.experiments.experiment import import_map
from flcav.fusion.road import TRAINED_IN, RoadView
from flcav.geometry import Boxes, pose
from flcav.optimization.curves.held_out import rank_correlation
from flcav.perception.errors import FALSE_POSITIVE, MISS, PerceptionError
from flcav.perception.objects.model import second_tiny
from flcav.perception.outcomes import Outcomes
from flcav.reproductions.placement import records
from flcav.reproductions.placement import run as placement_run
from flcav.reproductions.placement.records import (
    ADDED,
    COVERAGE,
    EXPECTED,
    NEAR,
    PREDICTORS,
    TOWN,
    TRAFFIC,
    ChoiceGain,
    PlacementProof,
    PoleGain,
    SeedGains,
    describe_claims,
    list_claims,
    spread_over_scenes,
)
from flcav.reproductions.placement.run import (
    RECALL,
    choose_near,
    count_added_labels,
    describe_overlaps,
    expect_labels,
    list_overlaps,
    list_regions,
    overlap_of_circles,
    plan_half_width,
    summarise_gains,
)
from flcav.reproductions.placement.tables import tables
from flcav.runs.frames import Frames
from flcav.runs.recipe import load_run_recipe
from flcav.sensors.frame import Annotations, Calibration, Frame
from flcav.sources.recipe import recipe_path
from flcav.statistics.verdicts import judge_means
from flcav.world.map.town import load_town

RECIPE = load_run_recipe(recipe_path("runs/placement"))
BOTH = ("grid", "quarter")
RANGES = Path(__file__).parents[3] / "reproductions/sensor_ranges/result.json"


@pytest.fixture(scope="module")
def beside(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the imported town of the recipe."""
    folder = tmp_path_factory.mktemp("towns")
    import_map("quarter", folder)
    return folder


@pytest.mark.parametrize("apart", [0.0, 10.0, 37.0, 69.0, 80.0, 200.0])
def test_overlap_is_the_area_that_two_circles_share(apart: float) -> None:
    circle = Point(0, 0).buffer(40.0, quad_segs=512)
    shared = circle.intersection(Point(apart, 0).buffer(40.0, quad_segs=512)).area / circle.area
    assert overlap_of_circles(apart, 40.0) == pytest.approx(shared, abs=1e-4)


def test_rank_correlation_is_spearmans_and_nothing_where_nothing_is_ordered() -> None:
    rng = np.random.default_rng(1)
    for _ in range(5):
        one, other = rng.integers(0, 5, 9), rng.normal(size=9)
        assert rank_correlation(one, other) == pytest.approx(spearmanr(one, other)[0])
    assert rank_correlation([1, 2, 3], [5, 5, 5]) == 0.0


def test_half_of_the_frames_have_most_errors_around() -> None:
    rng = np.random.default_rng(2)
    places, errors = rng.uniform(-50, 50, (9, 2)), rng.uniform(-50, 50, (40, 3))
    near = choose_near(places, errors, 20.0)
    counts = np.array([sum(np.hypot(*(error[:2] - place)) <= 20 for error in errors) for place in places])
    assert near.sum() == 5
    assert counts[near].min() >= counts[~near].max()


def test_seeds_are_planned_for_students_interval() -> None:
    seeds = plan_half_width(0.03)
    assert seeds is not None
    for number, wide in ((seeds, False), (seeds - 1, True)):
        assert (t.ppf(0.975, number - 1) * 0.03 / number**0.5 > 0.02) is np.bool_(wide)


def test_every_pole_has_an_arm_and_circles_overlap_by_less_than_half_in_towns_new_to_the_road_detector(
    beside: Path,
) -> None:
    assert list_regions(RECIPE) == BOTH
    assert not set(BOTH) & set(TRAINED_IN)
    for region in BOTH:
        arms = [arm for arm in RECIPE.arms.values() if arm.placement["rule"] == "fixed"]
        chosen = [arm.placement["poles"][0] for arm in arms if region in (arm.regions or BOTH)]
        assert chosen == load_town(region, beside).poles.id.tolist()
    pairs = {region: list_overlaps(RECIPE, region, beside) for region in BOTH}
    assert [pairs[region][0].poles for region in BOTH] == [(1, 9), (3, 7)]
    assert max(pair.overlap for own in pairs.values() for pair in own) < 0.5
    grid, quarter = describe_overlaps(pairs | {"quarter": ()}, 40.0)
    assert "grid: circles of 40 m around candidate poles that overlap: 1 and 9 by 43%, 2 and 4 by 24%" in grid
    assert quarter == "quarter: no two circles of 40 m around candidate poles overlap"


def test_recall_by_distance_is_that_of_the_measured_ranges() -> None:
    measured = json.loads(RANGES.read_text())
    found = next(model["found"] for model in measured["models"] if model["name"] == "pole_64")
    np.testing.assert_allclose(RECALL, np.array(found) / np.array(measured["cars"]), atol=0.005)


def test_expected_labels_are_seen_misses_with_returns_by_recall(small_town, standing) -> None:
    def error(x: float, y: float, kind: str = MISS, returns: int = 7) -> PerceptionError:
        return PerceptionError(x, y, 0.8, 1.0, kind, "Car", returns, 0.0, "s", f"{x},{y}")

    house = np.array([[20.0, 0.0, 0.0, 10.0, 10.0, 10.0]])  # x 15-25, y -5-5, 10 m high
    hidden, seen, far = error(38.0, 0.0), error(-38.0, 0.0), error(0.0, 48.0)
    out = [error(-8.0, 0.0, FALSE_POSITIVE), error(-9.0, 0.0, returns=0), error(0.0, -70.0)]
    sites = np.array([(0.0, 0.0, 6.0), (-90.0, 0.0, 6.0), (900.0, 0.0, 6.0)])
    town = small_town(buildings=house)
    found = expect_labels(town, [], [hidden, seen, far, *out], sites)
    np.testing.assert_allclose(found, (0.86 + 0.29, 0.05, 0.0))  # 38 and 48 m from the first pole, 52 m from the second
    assert expect_labels(town, [], out[:1], sites).tolist() == [0.0] * 3
    van = standing([("van0", "van", 0, -12.0, 0.0, np.pi / 2)])
    low = np.array([(0.0, 0.0, 1.5)])
    np.testing.assert_allclose(expect_labels(town, [van], [seen, far], low), (0.29,))


def cars(*places: tuple[float, float], z: float = 0.8) -> Boxes:
    return Boxes.from_array(np.array([(x, y, z, 4.4, 1.8, 1.6, 0.0) for x, y in places]).reshape(-1, 7), "car")


def test_labels_really_added_are_road_boxes_with_returns_that_the_vehicle_lacks(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found, missed, unseen, far = (10.0, 2.0), (20.0, -3.0), (15.0, 9.0), (230.0, -3.0)
    rng = np.random.default_rng(0)
    hits = [np.c_[rng.uniform(-0.7, 0.7, (20, 2)) + place, rng.uniform(-1.4, -0.4, 20)] for place in (found, missed)]
    sweep = np.c_[np.concatenate(hits), np.full(40, 0.3)].astype(np.float32)
    nothing = Annotations(
        np.zeros(0, np.str_), Boxes.empty(), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0)
    )
    mounts = Calibration({"lidar": pose(0, 0, 1.8)})
    frames = [
        Frame("s", 0, 0.0, agent, pose(x, 0), mounts, mounts, {"lidar": sweep}, nothing)
        for agent, x in (("cav0", 0.0), ("cav1", 210.0))
    ]
    keys = [SimpleNamespace(scene="s", index=0, agent=agent) for agent in ("cav0", "cav1", "pole3", "pole7")]
    data = SimpleNamespace(
        keys=keys, frame=lambda i: frames[i], world_from_agent=lambda i: frames[i].world_from_agent, town=lambda: None
    )
    split = Frames(cast(Any, data), (0, 1), {3: (2,), 7: (3,)})
    told = {3: cars(found, missed, unseen), 7: cars((210.0 + 10.0, 2.0), far)}

    def views(
        split: Frames, poles: list[int], trained: bool, spins: set[tuple[str, int]]
    ) -> dict[tuple[str, int], dict[int, RoadView]]:
        assert trained
        grid = np.zeros((1, 1), bool)
        return {spin: {poles[0]: RoadView(told[poles[0]], np.zeros(2), grid, grid)} for spin in spins}

    own = replace(cars((10.5, 2.2), z=-1.0), label=np.array(["Car"]))  # of both vehicles, in the LiDAR's frame
    monkeypatch.setattr(placement_run, "road_views", views)
    monkeypatch.setattr(placement_run, "detect_in", lambda network, frames, score_threshold: [own])
    network: Any = SimpleNamespace(config=second_tiny().config)
    places = {3: np.array((5.0, 5.0, 6.0)), 7: np.array((215.0, 5.0, 6.0))}
    assert count_added_labels(network, 0.5, split, (0, 1), places) == {3: 1, 7: 1}  # `missed`; `far`, 20 m from cav1
    assert count_added_labels(network, 0.5, split, (0,), places) == {3: 1, 7: 0}


def seed(number: int, gains: Sequence[float], chosen: Sequence[float]) -> SeedGains:
    """Return gains of poles that cover 3, 2 and 1 errors, and of one sensor by VRCSP, traffic and chance."""
    poles = tuple(
        PoleGain(
            pole,
            {COVERAGE: 4 - pole, TRAFFIC: 1.0 + pole % 3, EXPECTED: 2.5, ADDED: pole},
            {TOWN: gain, NEAR: 2 * gain},
        )
        for pole, gain in enumerate(gains, start=1)
    )
    choices = tuple(
        ChoiceGain(rule, 1, (), {TOWN: gain, NEAR: 2 * gain})
        for rule, gain in zip(("VRCSP", "traffic density", "random"), chosen)
    )
    correlation = {each: {TOWN: 1.0 - order, NEAR: 0.5} for order, each in enumerate(PREDICTORS)}
    start = {TOWN: 0.4, NEAR: 0.3}
    return SeedGains(number, 6, start, start, poles, choices, correlation)


def test_means_over_seeds_and_the_spread_of_two_poles(beside: Path) -> None:
    seeds = seed(1, [0.06, 0.02, 0.0], [0.06, 0.02, 0.03]), seed(2, [0.02, 0.02, 0.02], [0.02, 0.02, 0.02])
    results = summarise_gains(RECIPE, {"grid": seeds}, beside)
    own = results.regions["grid"]
    assert own.means == results.pooled
    assert own.means.gain["1, VRCSP"][TOWN].mean == pytest.approx(0.04)
    assert set(own.means.advantage) == {"1, traffic density", "1, random"}
    assert own.means.advantage["1, traffic density"][TOWN].mean == pytest.approx((0.04 + 0.0) / 2)
    assert own.means.advantage["1, random"][NEAR].mean == pytest.approx(2 * (0.03 + 0.0) / 2)
    pairs = [(0.06 - 0.02, 0.0), (0.06 - 0.0, 0.0), (0.02 - 0.0, 0.0)]  # of both seeds
    assert own.pair_sd[TOWN] == pytest.approx(np.mean([np.var(each, ddof=1) for each in pairs]) ** 0.5)
    assert own.means.correlation[COVERAGE][NEAR].mean == 0.5
    assert own.scene_sd is None
    drawn = tuple(replace(each, scene_sd={TOWN: sd, NEAR: 0.1}) for each, sd in zip(seeds, (0.01, 0.07)))
    told = summarise_gains(RECIPE, {"grid": drawn}, beside)
    assert told.regions["grid"].scene_sd == {TOWN: pytest.approx(0.05), NEAR: pytest.approx(0.1)}
    assert "| grid | all over the town | 0.031 | 0.050 | 12 |" in tables(told)["spread"]
    again = PlacementProof.from_json(results.as_json(), "result.json")
    assert tables(again) == tables(results)
    assert "| grid | 1 | VRCSP | +0.040" in tables(results)["rules"]
    assert all(f"| grid | {name} |" in tables(results)["correlation"] for name in PREDICTORS)
    assert any("VRCSP gains +0.020" in sentence for sentence in results.sentences())


def test_the_draw_of_scenes_moves_two_poles_apart_as_far_as_their_scenes_differ(monkeypatch) -> None:
    reached = np.random.default_rng(3).uniform(0, 1, (3, 20))  # of three poles in each scene
    scenes = np.array([f"s{number:02d}" for number in range(20)])

    def measure(outcomes: Outcomes, times: np.ndarray) -> np.ndarray:
        return times @ outcomes.arrays["reached"] / times.sum(axis=1)

    monkeypatch.setattr(records, "OBJECTS", SimpleNamespace(measure=measure))
    tested = [Outcomes(scenes, {"reached": own}) for own in reached]
    counted = {TOWN: np.ones(20, dtype=bool), NEAR: np.arange(20) < 19}
    found = spread_over_scenes(tested, counted, 1)
    pairs = [np.var(reached[one] - reached[other]) / 20 for one, other in ((0, 1), (0, 2), (1, 2))]
    assert found[TOWN] == pytest.approx(np.mean(pairs) ** 0.5, rel=0.05)
    assert found[NEAR] > 0
    assert spread_over_scenes([tested[0], tested[0]], counted, 1) == {TOWN: 0.0, NEAR: 0.0}
    assert spread_over_scenes(tested[:1], counted, 1) == {TOWN: 0.0, NEAR: 0.0}


def test_regions_of_a_seed_are_pooled_before_seeds(beside: Path) -> None:
    grid = seed(1, [0.06, 0.02, 0.0], [0.06, 0.02, 0.03]), seed(2, [0.02, 0.02, 0.02], [0.02, 0.02, 0.02])
    quarter = seed(1, [0.1, 0.0, 0.0], [0.1, 0.0, 0.03]), seed(2, [0.04, 0.0, 0.02], [0.04, 0.0, 0.02])
    results = summarise_gains(RECIPE, {"grid": grid, "quarter": quarter}, beside)
    gain = results.pooled.gain["1, VRCSP"][TOWN]
    of_seeds = [(0.06 + 0.1) / 2, (0.02 + 0.04) / 2]
    assert (gain.mean, gain.seeds) == (pytest.approx(np.mean(of_seeds)), 2)
    assert gain.sd == pytest.approx(np.std(of_seeds, ddof=1))
    assert [results.regions[region].town for region in BOTH] == list(BOTH)
    assert "| mean over regions | 1 | VRCSP | +0.055" in tables(results)["rules"]
    assert {f"{each} {region}" for each in ("poles", "seeds", "overlaps") for region in BOTH} < set(tables(results))


def test_claims_are_of_means_over_regions_and_judged_together(beside: Path) -> None:
    def of_seed(number: int, gains: Sequence[float], chosen: Sequence[float], **correlation: float) -> SeedGains:
        told = {name: {TOWN: rho, NEAR: 0.5} for name, rho in correlation.items()}
        found = seed(number, gains, chosen)
        return replace(found, correlation={**found.correlation, COVERAGE: told["covered"], TRAFFIC: told["traffic"]})

    poles = [0.06, 0.02, 0.0]
    grid = tuple(of_seed(i, poles, [0.06 + i / 1e3, 0.02, 0.03], covered=0.8 + i / 1e3, traffic=0.1) for i in range(3))
    quarter = tuple(of_seed(i, poles, [0.04, 0.02 - i / 1e2, 0.03], covered=0.6, traffic=i / 10) for i in range(3))
    results = summarise_gains(RECIPE, {"grid": grid, "quarter": quarter}, beside)
    claims = list_claims(results)
    assert len(claims) == 2 * (1 + 1 + 2)  # for both kinds of test frames
    beyond = claims[f"gain {TOWN}: rank correlation with errors covered - with traffic density"]
    assert beyond.mean == pytest.approx(np.mean([(0.8 + i / 1e3 - 0.1 + 0.6 - i / 10) / 2 for i in range(3)]))
    told = judge_means(claims)
    first = told[f"gain {TOWN}: rank correlation with errors covered"]
    p = claims[f"gain {TOWN}: rank correlation with errors covered"].p_value(0.0)
    assert p is not None
    assert first.p is not None
    assert (first.verdict, first.family) == ("held", 8)
    assert first.p > p
    assert f"gain {TOWN}, sensors 1: VRCSP - random" in claims
    assert f"gain {TOWN}, sensors 1: VRCSP - random: +0.021" in " ".join(describe_claims(results))
    assert "| held |" in tables(results)["claims"]


def test_one_seed_has_no_interval(beside: Path) -> None:
    results = summarise_gains(RECIPE, {"grid": (seed(1, [0.06, 0.02, 0.0], [0.06, 0.02, 0.03]),)}, beside)
    assert results.regions["grid"].seeds_wanted == {TOWN: None, NEAR: None}
    assert results.pooled.advantage["1, random"][TOWN].low is None
