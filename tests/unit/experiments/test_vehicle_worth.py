"""A vehicle's worth: what the test loses without it, and how scores rank it, by hand."""

from typing import Any

import numpy as np
import pytest
from scipy.stats import spearmanr, t

from flcav.reproductions.vehicle_worth.run import (
    AGAIN,
    AMOUNT,
    FULL,
    LABELS,
    NOVELTY,
    OBJECTS,
    TOTAL,
    FleetWorth,
    NetworkScore,
    VehicleWorth,
    WorthResult,
    average_ranks,
    draw_worth,
    summarise,
    worth_tables,
)
from flcav.storage.records import from_json, to_json

LOSSES = ((1.3, 1.2), (1.0, 1.1), (1.9, 1.7), (1.4, 1.5))  # without each vehicle, by training; with all 1.1 and 1.0
SAMPLES, DISTANCE, NOVELTIES = (20, 10, 40, 15), (0.2, 0.5, 0.1, 0.4), (0.1, 0.3, 0.4, 0.2)


def spearman(one: Any, other: Any) -> float:
    return float(np.asarray(spearmanr(one, other))[0])


@pytest.fixture(scope="module")
def fleet() -> FleetWorth:
    vehicles = tuple(
        VehicleWorth(samples, {"fog": samples}, far, new, 0.5, tuple(NetworkScore(loss, 0.5) for loss in losses))
        for samples, far, new, losses in zip(SAMPLES, DISTANCE, NOVELTIES, LOSSES, strict=True)
    )
    return FleetWorth(NetworkScore(2.0, 0.3), (NetworkScore(1.1, 0.6), NetworkScore(1.0, 0.7)), vehicles)


@pytest.fixture(scope="module")
def results(fleet: FleetWorth) -> WorthResult:
    return summarise({"1": fleet, "2": fleet, "3": fleet}, FULL)


def test_a_vehicle_brings_what_the_test_loses_without_it(fleet: FleetWorth) -> None:
    assert fleet.worth() == pytest.approx([0.2, 0.0, 0.75, 0.4])
    assert fleet.worth(1) == pytest.approx([0.2, 0.1, 0.7, 0.5])
    assert fleet.accuracy() == pytest.approx([0.15] * 4)


def test_scores_rank_by_spearman_and_one_that_is_the_same_for_all_ranks_nobody(fleet: FleetWorth) -> None:
    assert fleet.rank(AMOUNT) == pytest.approx(spearman(SAMPLES, fleet.worth()))
    assert fleet.rank(LABELS) == pytest.approx(spearman(DISTANCE, fleet.worth()) * -1)
    assert fleet.rank(NOVELTY) == pytest.approx(spearman(NOVELTIES, fleet.worth()))
    assert fleet.rank(TOTAL) == fleet.rank(AMOUNT)  # of equal qualities
    assert fleet.rank(OBJECTS) is None
    assert fleet.rank(AGAIN) == pytest.approx(spearman(fleet.worth(0), fleet.worth(1)))


def test_ranks_are_averaged_on_fisher_s_scale() -> None:
    ranks = [0.5, 0.7, 0.2, 0.6]
    mean, error = np.mean(ranks), np.std(ranks, ddof=1) / 2
    half = t.ppf(0.975, 3) * error / (1 - mean**2)  # the slope of the inverse hyperbolic tangent
    ends = np.tanh([np.arctanh(mean) - half, np.arctanh(mean) + half])
    found = average_ranks(ranks)
    assert (found.mean, found.low, found.high) == pytest.approx((mean, *ends))
    assert average_ranks([0.5]).low is None


def test_results_are_read_back_tabulated_and_drawn(results: WorthResult) -> None:
    assert from_json(WorthResult, to_json(results, WorthResult), "result.json") == results
    tables = worth_tables(results)
    assert f"| {OBJECTS} | undefined, the same for all vehicles |" in tables["ranks"]
    assert tables["vehicles"].count("\n") == 1 + 12
    assert "| 1, cav2 | 40 | 1 | 0.10 | 0.400 | 0.50 | +0.750 | +0.150 |" in tables["vehicles"]
    assert draw_worth(results).startswith(b"\x89PNG")
