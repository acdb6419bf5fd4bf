"""Predicted against realised gains: what is correlated with what, and the intervals of it."""

from collections.abc import Sequence
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from scipy.stats import spearmanr, t

from flcav.reproductions.placement.records import COVERAGE, EXPECTED, FRAMES, TRAFFIC, PoleGain, SeedGains
from flcav.reproductions.predictions.run import (
    PREDICTORS,
    VISIBLE,
    add_sight,
    average_poles,
    compare_with_sight,
    correlate,
    correlate_averages,
    count_in_sight,
    rank_plans,
)
from flcav.runs.recipe import load_run_recipe
from flcav.runs.tables import HistoryPoint
from flcav.sources.recipe import recipe_path
from flcav.world.map.town import load_town

SIZE, SEEDS = 7, 5


def draw_poles(rng: np.random.Generator) -> list[PoleGain]:
    """Return poles whose gain follows their errors, and less so the rest."""
    errors = rng.normal(size=SIZE)

    def predict(noise: float) -> list[float]:
        return (errors + noise * rng.normal(size=SIZE)).tolist()

    columns = dict(zip((COVERAGE, TRAFFIC, VISIBLE, EXPECTED), map(predict, (0.0, 4.0, 1.0, 0.2)), strict=True))
    gains = {frames: predict(0.8) for frames in FRAMES}
    return [
        PoleGain(
            pole,
            {name: column[pole] for name, column in columns.items()},
            {frames: column[pole] for frames, column in gains.items()},
        )
        for pole in range(SIZE)
    ]


@pytest.fixture(scope="module")
def regions() -> list[list[list[PoleGain]]]:
    """Return poles by region and seed."""
    rng = np.random.default_rng(4)
    return [[draw_poles(rng) for _ in range(SEEDS)] for _ in range(2)]


def spearman(poles: Sequence[PoleGain], name: str, frames: str) -> float:
    return cast("float", spearmanr([pole.predictors[name] for pole in poles], [pole.gain[frames] for pole in poles])[0])


def test_correlations_are_spearmans_in_the_mean_over_regions(regions: list[list[list[PoleGain]]]) -> None:
    first = [region[0] for region in regions]
    found = correlate(first)
    for name in PREDICTORS:
        for frames in FRAMES:
            assert found[name][frames] == pytest.approx(np.mean([spearman(poles, name, frames) for poles in first]))


def test_claims_are_of_the_lead_over_objects_in_sight(regions: list[list[list[PoleGain]]]) -> None:
    seeds = [correlate(at) for at in zip(*regions, strict=True)]
    claims = compare_with_sight(seeds)
    assert len(claims) == len(FRAMES)
    for frames in FRAMES:
        lead = [seed[COVERAGE][frames] - seed[VISIBLE][frames] for seed in seeds]
        claim = claims[f"gain {frames}: rank correlation with errors covered - with objects in sight"]
        assert claim.mean == pytest.approx(np.mean(lead))
        assert claim.sd == pytest.approx(np.std(lead, ddof=1))


def test_averages_are_correlated_with_the_jackknifes_interval_on_fishers_scale(
    regions: list[list[list[PoleGain]]],
) -> None:
    found = correlate_averages(regions)[EXPECTED][FRAMES[0]]

    def z(left_out: int | None) -> float:
        kept = [[own for number, own in enumerate(region) if number != left_out] for region in regions]
        means = [average_poles(region) for region in kept]
        return float(np.arctanh(np.mean([spearman(poles, EXPECTED, FRAMES[0]) for poles in means])))

    parts = [z(number) for number in range(SEEDS)]
    error = np.sqrt((SEEDS - 1) / SEEDS * np.sum((np.array(parts) - np.mean(parts)) ** 2))  # Efron, equation 3.6
    half = t.ppf(0.975, SEEDS - 1) * error
    assert (found.mean, found.low, found.high) == pytest.approx(
        (np.tanh(z(None)), *np.tanh([z(None) - half, z(None) + half]))
    )


def test_only_poles_of_all_seeds_are_averaged(regions: list[list[list[PoleGain]]]) -> None:
    one, other = regions[0][0], regions[0][1][1:]
    averaged = average_poles([one, other])
    assert [pole.pole for pole in averaged] == [pole.pole for pole in other]
    assert averaged[0].predictors[TRAFFIC] == pytest.approx(
        (one[1].predictors[TRAFFIC] + other[0].predictors[TRAFFIC]) / 2
    )


def test_no_more_is_in_sight_than_is_near_in_the_traffic_of_the_run() -> None:
    recipe = load_run_recipe(recipe_path("runs/placement"))
    few = recipe.sized_splits.model_copy(
        update={"registry": recipe.sized_splits.registry.model_copy(update={"scenes": 1, "spins": 1})}
    )
    recipe = recipe.model_copy(update={"splits": few})
    town = load_town("grid")
    seen = count_in_sight(recipe, "grid", 3, town, Path())
    assert list(seen) == town.poles.id.tolist()
    assert seen != count_in_sight(recipe, "grid", 4, town, Path())
    assert 0 < max(seen.values()) < len(town.poles.id) * 10
    gains = SeedGains(3, 0, {}, {}, (PoleGain(2, {COVERAGE: 1.0}, {}),), (), {})
    assert add_sight(gains, seen)[0].predictors == {COVERAGE: 1.0, VISIBLE: seen[2]}


def test_plans_are_ranked_by_the_curve_of_the_history() -> None:
    counts = [(60, 0, 0), (60, 2, 0), (60, 5, 0), (60, 10, 0)]

    def run(accuracy: Sequence[float]) -> list[HistoryPoint]:
        return [HistoryPoint("objects", *at, value, 1, "x", 1) for at, value in zip(counts, accuracy, strict=True)]

    ranked, off = rank_plans([run([0.5, 0.6, 0.7, 0.8]), run([0.8, 0.7, 0.6, 0.5])])
    assert ranked.mean == pytest.approx(0.0)
    assert ranked.sd == pytest.approx(np.sqrt(2))
    _, same = rank_plans([run([0.5, 0.6, 0.7, 0.8])])
    _, raised = rank_plans([run([0.6, 0.7, 0.8, 0.9])])
    assert same.mean == pytest.approx(raised.mean)
    assert off.mean > same.mean
