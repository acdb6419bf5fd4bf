"""Counts, ratios, tables and picture of the failure search."""

from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from flcav.odd.sampling import SampledScenario
from flcav.odd.scenery import ScenarioPlace
from flcav.odd.searching import Failure, Searched, TriedFrame
from flcav.reproductions.failure_search.run import (
    RULES,
    SOBOL,
    FailureSearchResult,
    Found,
    failure_search_tables,
    mean_ratio,
    summarise,
)
from flcav.storage.records import from_json
from flcav.world.weather import Weather

PLACE = ScenarioPlace("ring", "none", "none", 0.0, 0.0, (0.0, 0.0), 0.0, (0.0, 0.0, 0.0), 0)
SAMPLE = SampledScenario(PLACE, "crash", Weather(), {}, "car", 50.0)


def scenario(*cells: str) -> Searched:
    """Return a scenario of two frames, the first with a failure in each of the cells."""
    failures = tuple(Failure("frame", (cell,), 9.0, 30) for cell in cells)
    return Searched(SAMPLE, 1, (TriedFrame(("none",), failures), TriedFrame(("none",), ())))


@pytest.fixture(scope="module")
def results() -> FailureSearchResult:
    plain, better = [scenario("a"), scenario("a")], [scenario("a", "b"), scenario("b", "c")]
    searched = {rule: [plain, plain] for rule in RULES} | {"failures": [better, [*better[:1], scenario("d", "e")]]}
    return summarise(searched)


def test_failures_in_one_cell_are_not_distinct(results: FailureSearchResult) -> None:
    assert results.found["failures"][0] == Found(frames=4, failing=2, failures=4, growth=(2, 3))
    assert results.found[SOBOL][0].growth == (1, 1)
    assert results.together == {"sobol": 1, "path": 1, "failures": 5}


def test_the_ratio_is_the_geometric_mean_with_its_interval(results: FailureSearchResult) -> None:
    ratio = results.ratios["failures / sobol"]
    assert ratio.mean == pytest.approx(np.sqrt(3 * 4))
    half = 12.706 * np.std(np.log([3, 4]), ddof=1) / np.sqrt(2)  # Student's t of one degree of freedom
    assert (ratio.low, ratio.high) == pytest.approx((ratio.mean / np.exp(half), ratio.mean * np.exp(half)), rel=1e-3)
    none = replace(results.found[SOBOL][0], growth=(0, 0))
    assert mean_ratio([results.found["failures"][0]], [none]).mean == 6.0


def test_results_are_told_drawn_and_read_back(results: FailureSearchResult) -> None:
    assert from_json(FailureSearchResult, results.as_json(), "result.json") == results
    tables = failure_search_tables(results)
    assert "| search | 4 | 2.0 | 4.0 | 2.0 | 3.500 (" in tables["found"]
    assert tables["ratios"].count("\n") == 4
    assert results.sentences()[-3].startswith("failures / sobol: 3.464 (")
    with Image.open(BytesIO(results.picture())) as picture:
        assert picture.format == "PNG"
