"""The proof of placement by learning: its geometry, its statistics, and what it makes of gains by pole."""

from collections.abc import Sequence

import numpy as np
import pytest
from scipy.stats import spearmanr, t
from shapely.geometry import Point

from flcav.experiments.placement.run import (
    COVERAGE,
    NEAR,
    TOWN,
    TRAFFIC,
    ChoiceGain,
    PlacementProof,
    PoleGain,
    SeedGains,
    choose_near,
    describe_overlaps,
    list_overlaps,
    overlap_of_circles,
    plan_half_width,
    summarise_gains,
)
from flcav.experiments.placement.tables import tables
from flcav.optimization.curves.held_out import rank_correlation
from flcav.pipeline.recipe import load_run_recipe
from flcav.sources.recipe import recipe_path
from flcav.world.map.town import load_town

RECIPE = load_run_recipe(recipe_path("runs/placement"))


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


def test_every_pole_of_the_town_has_an_arm_and_circles_overlap_by_less_than_half() -> None:
    poles = load_town("arterial").poles.id.tolist()
    assert [arm.placement["poles"][0] for arm in RECIPE.arms.values() if arm.placement["rule"] == "fixed"] == poles
    pairs = list_overlaps(RECIPE)
    assert [pair.poles for pair in pairs] == [(1, 3), (2, 6)]
    assert pairs[0].overlap < 0.5
    assert "1 and 3 by 6%" in describe_overlaps(pairs, 40.0)


def seed(number: int, gains: Sequence[float], chosen: Sequence[float]) -> SeedGains:
    """Return gains of poles that cover 3, 2 and 1 errors, and of one sensor by VRCSP, traffic and chance."""
    poles = tuple(
        PoleGain(pole, 4 - pole, 1.0 + pole % 3, {TOWN: gain, NEAR: 2 * gain})
        for pole, gain in enumerate(gains, start=1)
    )
    choices = tuple(
        ChoiceGain(rule, 1, (), {TOWN: gain, NEAR: 2 * gain})
        for rule, gain in zip(("VRCSP", "traffic density", "random"), chosen)
    )
    correlation = {COVERAGE: {TOWN: 1.0, NEAR: 0.5}, TRAFFIC: {TOWN: 0.0, NEAR: 0.0}}
    start = {TOWN: 0.4, NEAR: 0.3}
    return SeedGains(number, 6, start, start, poles, choices, correlation)


def test_means_over_seeds_and_the_spread_of_two_poles() -> None:
    seeds = seed(1, [0.06, 0.02, 0.0], [0.06, 0.02, 0.03]), seed(2, [0.02, 0.02, 0.02], [0.02, 0.02, 0.02])
    results = summarise_gains(RECIPE, seeds)
    assert results.gain["1, VRCSP"][TOWN].mean == pytest.approx(0.04)
    assert set(results.advantage) == {"1, traffic density", "1, random"}
    assert results.advantage["1, traffic density"][TOWN].mean == pytest.approx((0.04 + 0.0) / 2)
    assert results.advantage["1, random"][NEAR].mean == pytest.approx(2 * (0.03 + 0.0) / 2)
    pairs = [(0.06 - 0.02, 0.0), (0.06 - 0.0, 0.0), (0.02 - 0.0, 0.0)]  # of both seeds
    assert results.pair_sd[TOWN] == pytest.approx(np.mean([np.var(each, ddof=1) for each in pairs]) ** 0.5)
    assert results.correlation[COVERAGE][NEAR].mean == 0.5
    again = PlacementProof.from_json(results.as_json(), "result.json")
    assert tables(again) == tables(results)
    assert "| 1 | VRCSP | +0.040" in tables(results)["rules"]
    assert any("VRCSP gains +0.020" in sentence for sentence in results.sentences())


def test_one_seed_has_no_interval() -> None:
    results = summarise_gains(RECIPE, (seed(1, [0.06, 0.02, 0.0], [0.06, 0.02, 0.03]),))
    assert results.seeds_wanted == {TOWN: None, NEAR: None}
    assert results.advantage["1, random"][TOWN].low is None
