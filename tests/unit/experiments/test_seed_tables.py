"""Tables and picture of several seeds, from the committed results of the demo."""

from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from flcav.report.charts import figures
from flcav.report.seed_tables import draw_seeds, tables
from flcav.runs.analysis.summary import count_claims
from flcav.runs.results.run import Run, Summary
from flcav.statistics.estimates import Estimate
from flcav.statistics.verdicts import HELD, NOT_HELD, UNDECIDED

DEMO = Path(__file__).parents[3] / "reproductions" / "runs" / "demo"


@pytest.fixture(scope="module")
def demo() -> Run:
    return Run.load(DEMO)


def test_claims_are_counted_over_the_seeds_that_decide_them(demo: Run) -> None:
    first, *rest = demo.findings
    ways = (HELD, NOT_HELD, UNDECIDED, HELD)
    runs = [replace(demo, findings=(replace(first, verdict=way), *rest)) for way in ways]
    claim = count_claims(runs)[0]
    assert (claim.held, claim.did_not_hold, claim.undecided) == (2, 1, 1)
    assert claim.describe().endswith("(primary claim): held in 2 of 4 seeds, did not hold in 1, undecided in 1")


def test_a_row_has_what_the_run_reached_claimed_and_cost(demo: Run) -> None:
    other = replace(demo, recipe=demo.recipe.model_copy(update={"seed": 2}))
    heads, _, *rows = tables([demo, other], Summary((1, 2), (), (), ()))["seeds"].split("\n")
    names = [cell.strip() for cell in heads.strip("|").split("|")]
    last = dict(zip(names, [cell.strip() for cell in rows[1].strip("|").split("|")], strict=True))
    joint = [each for each in demo.differences if each.regions]
    assert [each.name for each in joint] == [name for name in names if name.startswith("grid and ring")]
    for each in joint:
        assert last[each.name] == f"{each.estimate.describe(sign=True)} held"
    trained = [test for test in demo.tested if (test.arm, test.stage) == ("main", "edge")]
    assert last["edge"] == f"{sum(sum(test.trainings) for test in trained) / 6:.3f}"
    assert last["seed"] == "2"
    assert last["wireless MB"] == f"{demo.arms['main'].links['wireless'].used_mb:.1f}"


def test_the_picture_has_a_row_per_seed_and_claim(demo: Run) -> None:
    other = replace(demo, recipe=demo.recipe.model_copy(update={"seed": 2}))
    heights = [Image.open(BytesIO(draw_seeds(runs))).height for runs in ([demo], [demo, other])]
    assert heights[1] > heights[0]


def test_the_picture_of_seeds_counts_intervals_beyond_0() -> None:
    gains = {"seed 1": Estimate(0.1, 0.05, 0.15), "seed 2": Estimate(0.02, -0.01, 0.05)}
    costs = {"seed 1": Estimate(-0.1, -0.15, -0.05), "seed 2": Estimate(-0.2, -0.3, -0.1)}
    left, right = figures.seeds({"a claim": gains, "the price": costs}).axes
    assert left.get_xlabel() == "above 0 in 1 of 2 intervals (95 %)"
    assert right.get_xlabel() == "below 0 in 2 of 2 intervals (95 %)"
    assert [0.05, 0.15] in [np.asarray(line.get_xdata()).tolist() for line in left.get_lines()]
